"""Sound bundles of which something was changed afterwards are refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from nacl.signing import SigningKey

from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance
from controller.core.errors import BundleError
from tests.controller.bundle.conftest import write
from tests.controller.bundle.hostile import (
    index_place,
    refused,
)


def test_every_flipped_byte_of_header_index_and_signature_is_refused(
    signed: Path, unsigned: Path, key: SigningKey
) -> None:
    for file, trusted in ((signed, [bytes(key.verify_key)]), (unsigned, [])):
        data = file.read_bytes()
        start, _ = index_place(data)
        with file.open("r+b", buffering=0) as changed:
            for place in [*range(128), *range(start, len(data))]:
                changed.seek(place)
                changed.write(bytes([data[place] ^ 1 << place % 8]))
                with pytest.raises(BundleError):
                    Bundle.open(file, trusted=trusted, allow_unsigned=not trusted)
                changed.seek(place)
                changed.write(data[place : place + 1])
        assert file.read_bytes() == data


def test_flipped_payload_bytes_are_refused_padding_included(tmp_path: Path, unsigned: Path) -> None:
    data = unsigned.read_bytes()
    start, _ = index_place(data)
    for place in np.random.default_rng(1).integers(128, start, 400):
        changed = bytearray(data)
        changed[place] ^= 1 << int(place) % 8
        assert refused(tmp_path / "changed.vel", bytes(changed), allow_unsigned=True).code == "bundle-damaged"


def test_a_stripe_that_changed_since_it_was_installed_is_not_played(unsigned: Path) -> None:
    data = bytearray(unsigned.read_bytes())
    data[4096 + 9] ^= 16
    unsigned.write_bytes(data)
    with Bundle.open(unsigned, allow_unsigned=True) as bundle, pytest.raises(BundleError, match="checksum"):
        bundle.decode("noise", "left")


def test_every_truncation_is_refused(tmp_path: Path, unsigned: Path) -> None:
    data = unsigned.read_bytes()
    for length in [*range(0, 200), *range(200, len(data), 997), *range(len(data) - 200, len(data))]:
        refused(tmp_path / "short.vel", data[:length], allow_unsigned=True)
    refused(tmp_path / "long.vel", data + b"\0", allow_unsigned=True)


def test_only_our_signature_passes(signed: Path, unsigned: Path, key: SigningKey, tmp_path: Path) -> None:
    ours, other = bytes(key.verify_key), bytes(SigningKey(bytes(32)).verify_key)
    assert refused(signed, signed.read_bytes(), trusted=[other]).code == "bundle-untrusted"
    assert refused(signed, signed.read_bytes()).code == "bundle-untrusted"
    assert refused(unsigned, unsigned.read_bytes(), trusted=[ours]).code == "bundle-unsigned"
    forged = signed.read_bytes()[:-128] + other_block(signed, other)
    assert refused(tmp_path / "forged.vel", forged, trusted=[other]).code == "bundle-signature-wrong"
    assert refused(tmp_path / "forged.vel", forged, allow_unsigned=True).code == "bundle-signature-wrong"
    Bundle.open(signed, trusted=[other, ours]).close()
    # Where keys are listed, only what has no signature is allowed in addition, and no other signer.
    assert refused(signed, signed.read_bytes(), trusted=[other], allow_unsigned=True).code == "bundle-untrusted"
    Bundle.open(unsigned, trusted=[ours], allow_unsigned=True).close()


def other_block(signed: Path, public: bytes) -> bytes:
    block = signed.read_bytes()[-128:]
    return block[:8] + public + block[40:]


def test_a_newer_format_is_told_from_a_damaged_one(tmp_path: Path, unsigned: Path) -> None:
    data = bytearray(unsigned.read_bytes())
    data[8] = 4
    assert refused(tmp_path / "new.vel", bytes(data), allow_unsigned=True).code == "bundle-version"
    assert refused(tmp_path / "zip.vel", b"PK\3\4" + bytes(500), allow_unsigned=True).code == "bundle-foreign"


def test_a_truncation_at_every_part_s_edge_is_refused_even_with_a_header_to_match(tmp_path: Path, signed: Path,
                                                                                 key: SigningKey) -> None:  # fmt: skip
    data, trusted = signed.read_bytes(), [bytes(key.verify_key)]
    with Bundle.open(signed, trusted=trusted) as bundle:
        blobs = [blob for part in bundle.index.appearances for found in part.bands.values() for blob in found]
    start, length = index_place(data)
    edges = {0, 128, 4096, start, start + length, *(b.offset for b in blobs), *(b.offset + b.length for b in blobs)}
    for edge in sorted(edges):
        short = bytearray(data[:edge])
        refused(tmp_path / "short.vel", bytes(short), trusted=trusted)
        if edge >= 128:
            struct.pack_into("<QQQ", short, 16, max(edge - length - 128, 128), length, edge)
            refused(tmp_path / "short.vel", bytes(short), trusted=trusted)


def test_parts_of_two_signed_bundles_do_not_make_a_third(tmp_path: Path, key: SigningKey,
                                                        appearances: list[NewAppearance]) -> None:  # fmt: skip
    one = write(tmp_path / "one.vel", appearances, key).read_bytes()
    other = write(tmp_path / "other.vel", appearances[::-1], key).read_bytes()
    assert len(one) == len(other)
    start, length = index_place(one)
    assert (start, length) == index_place(other)
    cuts = [0, 128, start, start + length, len(one)]
    for taken in range(1, 15):
        parts = [(other if taken >> n & 1 else one)[cuts[n] : cuts[n + 1]] for n in range(4)]
        refused(tmp_path / "mixed.vel", b"".join(parts), trusted=[bytes(key.verify_key)])
