"""Nikon's extensions of PTP: events, exposure times, image formats, live view. No I/O.

Source: the layouts that libgphoto2 (camlibs/ptp2) documents.
"""

from __future__ import annotations

from typing import Final

from hal.codecs.ptp.values import Buffer, Reader, broken

RAW: Final = 4
"""Value of COMPRESSION for RAW alone."""
RAW_AND_JPEG: Final = (7, 6, 5)
"""Values of COMPRESSION for RAW with a JPEG, the best JPEG first."""
JPEGS: Final = (2, 1, 0)
"""Values of COMPRESSION for a JPEG alone, the best first."""
_NO_TIME: Final = 0xFFFF_FFFD
"""Shutter values from here on mean bulb, time and flash synchronisation."""
_JPEG_START: Final = b"\xff\xd8\xff"
_LONGEST_HEADER: Final = 4096


def parse_events(data: Buffer) -> tuple[tuple[int, int], ...]:
    """(code, parameter) of each event in an answer to 90C7: a 16-bit count, then 16 and 32 bits for each."""
    read = Reader(data, "a list of events")
    count = read.number("H") if read.left else 0
    if count * 6 > read.left:
        raise broken(f"a list of {count} events with only {read.left} bytes for them")
    return tuple((read.number("H"), read.number("I")) for _ in range(count))


def parse_codes(data: Buffer) -> tuple[int, ...]:
    """The further properties of the body (answer to 90CA): a PTP array of u16."""
    return Reader(data, "a list of properties").array("H")


def seconds(value: int) -> float | None:
    """The exposure time of a shutter value (D100): numerator and denominator of 16 bits; None for bulb and the like."""
    above, below = value >> 16, value & 0xFFFF
    return above / below if 0 <= value < _NO_TIME and above and below else None


def parse_view(data: Buffer) -> bytes:
    """The JPEG in an answer to 9203, which follows a header of unknown length. Raises ProtocolError without one."""
    frame = bytes(data)
    start = frame.find(_JPEG_START, 0, _LONGEST_HEADER)
    if start < 0:
        raise broken("a frame of live view without a picture")
    return frame[start:]
