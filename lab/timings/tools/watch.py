"""``python -m lab.timings.tools.watch FILE SETS SECONDS DIGEST...``: read a memory output from outside.

Ready when it prints a line; the result is one more line of JSON. DIGEST: of each whole set that may be shown, in hex.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xxhash

from plugins.emulated.optics.outputs import FrameReader


def digest(frames: Mapping[str, npt.NDArray[np.uint8]]) -> str:
    """Of a whole set: every output's pixels, in the order of their names."""
    found = xxhash.xxh3_128()
    for name in sorted(frames):
        found.update(np.ascontiguousarray(frames[name]).data)
    return found.hexdigest()


def main(path: str, sets: str, seconds: str, *known: str) -> None:
    """Read so many whole sets, or until the time is over; count those that are none of the known ones."""
    reader, whole = FrameReader(Path(path)), set(known)
    first = last = reader.latest()
    print(json.dumps({"ready": True}), flush=True)
    ends_s = time.monotonic() + float(seconds)
    read = mixed = 0
    while read < int(sets) and time.monotonic() < ends_s:
        found = reader.latest()
        if found is not None and found is not last:
            read += 1
            mixed += digest(found.frames) not in whole
            first, last = first or found, found
    passed = 0 if first is None or last is None else (last.sequence - first.sequence) // 2
    print(json.dumps({"read": read, "mixed": mixed, "passed": passed}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
