"""Finds the extra of Velatura that contains a missing package.

Imports only the standard library, because it is used when packages are missing.
"""

from __future__ import annotations

from typing import Final

from controller.core.errors import UsageError

EXTRAS: Final = {
    "controller": "calibrate a stage, make and play appearances: all commands except those below",
    "panel": "run a kiosk (velatura kiosk serve) with its panel and accounts",
    "bench": "emulated devices (velatura demo, emulate) and velatura plan",
    "gphoto2": "cameras through libgphoto2",
    "mains": "mains by network: PDUs by SNMP, relays by Modbus",
    "building": "show control by OSC and sACN, dousers by sACN",
    "gpio": "keys on GPIO lines",
    "cluster": "solve on many machines (--scheduler)",
    "link": "a house of stages, and outputs of several computers",
    "ndi": "live targets by NDI",
    "gpu": "solve on a graphics processor",
}
"""Purpose of each extra of pyproject.toml that people install."""
_MODULES: Final = {
    "": "cramjam nacl numpy pyglet xxhash zstandard",
    "controller": "OpenEXR PIL StreamDeck cv2 cycler hid imagecodecs jinja2 llvmlite lz4 matplotlib numba"
    " pydantic pydantic_core pymediainfo rawpy rich scipy serial tifffile tomlkit trimesh typer usb",
    "panel": "aiomqtt anyio argon2 multipart prometheus_client python_multipart starlette uvicorn",
    "bench": "embreex",
    "gphoto2": "gphoto2",
    "mains": "pymodbus pysnmp",
    "building": "pythonosc sacn",
    "gpio": "gpiod",
    "cluster": "dask distributed",
    "link": "cryptography spake2 zenoh",
    "ndi": "cyndilib",
    "gpu": "wgpu",
}
EXTRA_OF: Final = {module: extra for extra, modules in _MODULES.items() for module in modules.split()}
"""The extra of each imported third-party module; "" for the base installation."""


def extra_missing(module: str) -> UsageError | None:
    """The error for a missing module; None if no extra contains it."""
    top = module.partition(".")[0]
    if top not in EXTRA_OF:
        return None
    extra = EXTRA_OF[top]
    return UsageError(
        "extra-missing",
        what=f"The Python module {top} is not installed.",
        remedy=f"Run {install_command(extra)} in Velatura's environment.",
    )


def install_command(extra: str) -> str:
    """The command that installs an extra."""
    return f'`pip install "velatura[{extra}]"`' if extra else "`pip install velatura`"
