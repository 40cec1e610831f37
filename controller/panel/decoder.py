"""A process that decodes one uploaded picture: bytes on standard input, a new PNG on standard output.

Runs with ``python -I`` and imports nothing of the controller, so that its memory contains no secrets. Exit codes:
0 done; 3 not an accepted picture; 4 too many pixels; any other: a crash or a limit of the system.
"""

from __future__ import annotations

import io
import resource
import sys
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")
NOT_A_PICTURE, TOO_MANY_PIXELS = 3, 4
ORIENTATION, TURNED = 0x0112, 5
"""EXIF: how the camera was held, and the first value at which width is height."""


def limit(memory_bytes: int, seconds: int) -> None:
    """Limit memory and processor time of this process; it then can't write files or start processes."""
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def decode(data: bytes, most_pixels: int, least_px: tuple[int, int] | None = None) -> bytes:
    """``data`` as PNG: RGB, 8 bit, rotated by its EXIF data, without metadata. Raises ValueError, OSError,
    SyntaxError.

    ``least_px`` (width, height): the picture may become smaller by a whole number, as long as it covers this size.
    Of 16 bits the upper 8 are kept. Floats and 32 bits have no defined white: ValueError.
    """
    from PIL import Image, ImageOps

    Image.MAX_IMAGE_PIXELS = None
    with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
        if picture.width * picture.height > most_pixels:
            raise SystemExit(TOO_MANY_PIXELS)
        if least_px is not None and picture.format == "JPEG":
            # A JPEG's blocks are decoded at a half, a quarter or an eighth in a fraction of the time.
            picture.draft(None, least_px if picture.getexif().get(ORIENTATION, 1) < TURNED else least_px[::-1])
        plain = _eight_bits(ImageOps.exif_transpose(picture)).convert("RGB")
    if least_px is not None and (smaller := min(plain.width // least_px[0], plain.height // least_px[1])) > 1:
        plain = plain.reduce(smaller)
    # A new picture made only from the pixels, so that nothing else of the file is copied.
    clean = Image.frombytes("RGB", plain.size, plain.tobytes())
    out = io.BytesIO()
    # What is fitted next goes through a pipe once; packing it would take longer than all else.
    clean.save(out, "PNG", compress_level=1 if least_px is None else 0)
    return out.getvalue()


def _eight_bits(picture: Image.Image) -> Image.Image:
    """Pillow would clip 16-bit grey at 255."""
    from PIL import Image

    if picture.mode in ("I", "F"):
        raise ValueError(picture.mode)
    if not picture.mode.startswith("I;16"):
        return picture
    high = 0 if picture.mode == "I;16B" else 1
    return Image.frombytes("L", picture.size, picture.tobytes()[high::2])


def main() -> None:
    most_pixels, memory_bytes, seconds, wide, high = (int(argument) for argument in sys.argv[1:6])
    warnings.simplefilter("ignore")
    from PIL import JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin  # noqa: F401 - before the limits

    limit(memory_bytes, seconds)
    data = sys.stdin.buffer.read()
    try:
        png = decode(data, most_pixels, (wide, high) if wide else None)
    except (ValueError, OSError, SyntaxError, MemoryError, EOFError, OverflowError):
        raise SystemExit(NOT_A_PICTURE) from None
    sys.stdout.buffer.write(png)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
