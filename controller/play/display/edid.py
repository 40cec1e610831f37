"""A projector's identification over its video cable (VESA E-EDID, base block). No I/O."""

from __future__ import annotations

from typing import Final

_HEAD: Final = bytes.fromhex("00ffffffffffff00")
_BLOCK_BYTES: Final = 128
_DESCRIPTORS: Final = (54, 72, 90, 108)
_SERIAL_TEXT: Final = b"\0\0\0\xff\0"


def serial_names(edid: bytes) -> tuple[str, ...]:
    """Names that distinguish a display from others of its kind; none where the block is damaged or empty.

    The serial number as text (descriptor FF), the number in the head, and this with the maker's letters before it,
    as "OTM-16843009".
    """
    block = edid[:_BLOCK_BYTES]
    if len(block) < _BLOCK_BYTES or not block.startswith(_HEAD) or sum(block) % 256:
        return ()
    names = []
    for start in _DESCRIPTORS:
        if block[start : start + 5] == _SERIAL_TEXT:
            text = block[start + 5 : start + 18].split(b"\n")[0].decode("ascii", "ignore").strip()
            names += [text] if text.isprintable() and text else []
    number = int.from_bytes(block[12:16], "little")
    if number:
        packed = int.from_bytes(block[8:10], "big")
        maker = "".join(chr(ord("@") + (packed >> shift & 31)) for shift in (10, 5, 0))
        names += [str(number), f"{maker}-{number}"]
    return tuple(names)
