"""The process that decodes one uploaded picture and ends: bytes on its input, our own PNG on its output.

Runs as a file of its own with ``python -I``: it imports nothing of the controller, so there is nothing in its memory
to steal. Exit codes: 0 done; 3 not a picture that we take; 4 too many pixels. A crash, or a limit of the system, is
any other.
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


def limit(memory_bytes: int, seconds: int) -> None:
    """From now on this process has so much memory and processor time, and can write no file and start no process."""
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def decode(data: bytes, most_pixels: int) -> bytes:
    """``data`` as PNG: RGB, 8 bit, turned as its EXIF says, without any metadata. Raises ValueError, OSError,
    SyntaxError.

    Of 16 bits the higher ones are kept. A picture of floats, or of 32 bits, says nowhere what is white: ValueError.
    """
    from PIL import Image, ImageOps

    Image.MAX_IMAGE_PIXELS = None
    with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
        if picture.width * picture.height > most_pixels:
            raise SystemExit(TOO_MANY_PIXELS)
        plain = _eight_bits(ImageOps.exif_transpose(picture)).convert("RGB")
    # A fresh picture of the bare pixels: nothing else of the file can come along.
    clean = Image.frombytes("RGB", plain.size, plain.tobytes())
    out = io.BytesIO()
    clean.save(out, "PNG", compress_level=1)
    return out.getvalue()


def _eight_bits(picture: Image.Image) -> Image.Image:
    """Pillow itself would take every 16-bit grey above 255 for white."""
    from PIL import Image

    if picture.mode in ("I", "F"):
        raise ValueError(picture.mode)
    if not picture.mode.startswith("I;16"):
        return picture
    high = 0 if picture.mode == "I;16B" else 1
    return Image.frombytes("L", picture.size, picture.tobytes()[high::2])


def main() -> None:
    most_pixels, memory_bytes, seconds = (int(argument) for argument in sys.argv[1:4])
    warnings.simplefilter("ignore")
    from PIL import JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin  # noqa: F401 - before the limits

    limit(memory_bytes, seconds)
    data = sys.stdin.buffer.read()
    try:
        png = decode(data, most_pixels)
    except (ValueError, OSError, SyntaxError, MemoryError, EOFError, OverflowError):
        raise SystemExit(NOT_A_PICTURE) from None
    sys.stdout.buffer.write(png)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
