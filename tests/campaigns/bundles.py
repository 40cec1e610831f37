"""Damage to a signed bundle: every bit of header, index and signature, so many random bits of the rest, every length.

``python -m tests.campaigns.bundles 100000`` flips that many payload bits; a short one is part of every test run. Each
damaged file must be refused with a BundleError: at opening, or when it is verified as an installation does.
"""

from __future__ import annotations

import os
import struct
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nacl.signing import SigningKey

from controller.bundle.format import OutputLayout, PlaylistEntry
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, NewLive, Packing, write_bundle
from controller.core.errors import BundleError

KEY = SigningKey(bytes(range(32)))
TRUSTED = [bytes(KEY.verify_key)]
OUTPUTS = (("left", 61, 40), ("right", 48, 36))
HEADER_BYTES, BLOCK_BYTES = 128, 128


@dataclass(slots=True)
class Outcome:
    """How many damaged files there were of each kind, what got through, and the longest refusal in seconds."""

    counts: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)
    slowest_s: float = 0.0

    @property
    def holds(self) -> bool:
        """Whether every damaged file was refused, each in less than 100 ms of processor time."""
        return not self.wrong and self.slowest_s < 0.1


def write(path: Path) -> None:
    """A signed bundle with noise, a ramp, a thumbnail and a live section; its tiles LZ4, which is the younger codec."""
    random = np.random.default_rng(1)
    noise = {name: random.integers(0, 256, (rows, columns, 3), dtype=np.uint8) for name, columns, rows in OUTPUTS}
    rising = np.arange(40, dtype=np.uint8)[:, None, None]
    ramp = {name: np.tile(rising[:rows], (1, columns, 3)) for name, columns, rows in OUTPUTS}
    write_bundle(
        path,
        NewBundle(
            stage="s",
            calibration="c",
            created_unix_s=0,
            outputs=OUTPUTS,
            schedule=[PlaylistEntry("ramp", 900, 9)],
            live=NewLive((5, 4), {"gain": random.random((4, 5, 3)).astype(np.float16)}),
        ),
        key=KEY,
        appearances=[NewAppearance("noise", noise), NewAppearance("ramp", ramp, b"\x89PNG\r\n\x1a\n" + bytes(99))],
        packing=Packing(tuple(OutputLayout(name, columns, rows, 16, 9) for name, columns, rows in OUTPUTS), "lz4"),
    )


def run(flips: int, seed: int = 1, *, every: int = 1) -> Outcome:
    """``flips`` payload bits; of the other damages every ``every``-th."""
    outcome = Outcome()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bundle.vel"
        write(path)
        data = path.read_bytes()
        start, length = struct.unpack_from("<QQ", data, 16)
        handle = os.open(path, os.O_RDWR)
        try:
            guarded = [*range(HEADER_BYTES), *range(start, start + length + BLOCK_BYTES)]
            for number in range(0, 8 * len(guarded), every):
                place = guarded[number // 8]
                _flip(handle, path, data, place, number % 8, outcome, "header, index and signature")
            payload = np.random.default_rng(seed).integers(8 * HEADER_BYTES, 8 * start, flips)
            for bit in payload:
                _flip(handle, path, data, int(bit) // 8, int(bit) % 8, outcome, "payload")
            for size in range(len(data) - 1, -1, -every):
                os.ftruncate(handle, size)
                _refused(path, f"cut to {size} bytes", outcome, "truncation")
        finally:
            os.close(handle)
    return outcome


def _flip(handle: int, path: Path, data: bytes, place: int, bit: int, outcome: Outcome, kind: str) -> None:
    os.pwrite(handle, bytes([data[place] ^ 1 << bit]), place)
    _refused(path, f"bit {bit} of byte {place} flipped", outcome, kind)
    os.pwrite(handle, data[place : place + 1], place)


def _refused(path: Path, what: str, outcome: Outcome, kind: str) -> None:
    outcome.counts[kind] = outcome.counts.get(kind, 0) + 1
    began = time.process_time()
    try:
        with Bundle.open(path, trusted=TRUSTED) as bundle:
            bundle.verify()
    except BundleError:
        outcome.slowest_s = max(outcome.slowest_s, time.process_time() - began)
    else:
        outcome.wrong.append(what)


def main() -> int:
    """The exit code is 0 where every damaged file was refused."""
    began = time.monotonic()
    outcome = run(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
    for kind, count in outcome.counts.items():
        print(f"{kind:<28} {count:>8}")
    for what in outcome.wrong[:20]:
        print(f"WRONG: {what} and not refused")
    verdict = "holds" if outcome.holds else "DOES NOT HOLD"
    print(f"{verdict}, slowest {1000 * outcome.slowest_s:.1f} ms, {time.monotonic() - began:.0f} s")
    return 0 if outcome.holds else 1


if __name__ == "__main__":
    sys.exit(main())
