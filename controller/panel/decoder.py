"""A process that decodes one uploaded picture: bytes on standard input, a new PNG on standard output.

Runs with ``python -I -S``, so that nothing starts with it; the folders of its libraries are arguments. It imports
nothing of the controller but its reader of pictures: its memory contains no secrets. Exit codes: 0 done; 3 not an
accepted picture, with the reason instead of a PNG; 4 too many pixels; any other: a crash or a limit of the system.
"""

from __future__ import annotations

import resource
import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path += [str(Path(__file__).parents[2]), *sys.argv[6:]]

import numpy as np

from controller.core import pictures
from controller.core.colour import Unsuitable
from controller.core.files import UnfitFile

NOT_A_PICTURE, TOO_MANY_PIXELS = 3, 4


def limit(memory_bytes: int, seconds: int) -> None:
    """Limit memory and processor time of this process; it then can't write files or start processes."""
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def decode(data: bytes, most_pixels: int, least_px: tuple[int, int] | None = None) -> bytes:
    """``data`` as a PNG in sRGB, upright, without metadata: 16 bits where it has them or its colours were converted.

    ``least_px`` (width, height): the picture may become smaller by a whole number, as long as it covers this size.
    Raises Unsuitable, UnfitFile.
    """
    import imagecodecs

    picture = pictures.decode(data, least_px=least_px, most_pixels=most_pixels)
    plain = picture.srgb() if picture.alpha is None else picture.with_alpha()
    # What is fitted next goes through a pipe once; packing it would take longer than all else.
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(plain), level=1 if least_px is None else 0))


def main() -> None:
    most_pixels, memory_bytes, seconds, wide, high = (int(argument) for argument in sys.argv[1:6])
    data = sys.stdin.buffer.read()
    pictures.prepare(data)
    limit(memory_bytes, seconds)
    try:
        png = decode(data, most_pixels, (wide, high) if wide else None)
    except UnfitFile:
        raise SystemExit(TOO_MANY_PIXELS) from None
    except (Unsuitable, MemoryError) as error:
        sys.stdout.write(
            str(error) if isinstance(error, Unsuitable) else "it is too large for the memory: scale it down"
        )
        sys.stdout.flush()
        raise SystemExit(NOT_A_PICTURE) from None
    sys.stdout.buffer.write(png)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
