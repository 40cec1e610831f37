"""Which extra of Velatura brings a package that is not installed, and how to say so.

Imports nothing beyond the standard library: it is used where hardly anything is installed.
"""

from __future__ import annotations

from typing import Final

from controller.core.errors import UsageError

EXTRAS: Final = {
    "controller": "calibrate a stage, make and play appearances: all commands but those below",
    "panel": "run a kiosk (velatura serve) with its panel and accounts",
    "bench": "emulated devices (velatura demo, emulate) and velatura plan",
    "gphoto2": "cameras through libgphoto2",
    "cluster": "solve on many machines (--scheduler)",
}
"""What each extra of pyproject.toml that a person installs into Velatura's own environment is for."""
_MODULES: Final = {
    "": "nacl numpy pyglet xxhash zstandard",
    "controller": "OpenEXR PIL StreamDeck cv2 cycler hid jinja2 llvmlite matplotlib numba pydantic pydantic_core rawpy"
    " rich scipy serial skimage tomlkit trimesh typer usb",
    "panel": "aiomqtt anyio argon2 multipart prometheus_client python_multipart starlette uvicorn",
    "bench": "embreex tifffile",
    "gphoto2": "gphoto2",
    "cluster": "dask distributed",
}
EXTRA_OF: Final = {module: extra for extra, modules in _MODULES.items() for module in modules.split()}
"""The extra of each module that this project imports from others; "" for what every installation has."""


def extra_missing(module: str) -> UsageError | None:
    """The error for a module that was not found; None where no extra brings it."""
    top = module.partition(".")[0]
    if top not in EXTRA_OF:
        return None
    extra = EXTRA_OF[top]
    return UsageError(
        "extra-missing",
        what=f"This needs the Python package that brings the module {top}, which is not installed.",
        remedy=f"Type {install_command(extra)} in Velatura's environment.",
    )


def install_command(extra: str) -> str:
    """What to type to install an extra."""
    return f'`pip install "velatura[{extra}]"`' if extra else "`pip install velatura`"
