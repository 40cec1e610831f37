"""Loads the wheel with libgphoto2."""

from __future__ import annotations

from typing import Any

from hal.errors import PluginError


def load_library() -> Any:
    """The wheel's module. Raises PluginError("gphoto2-missing")."""
    try:
        import gphoto2
    except ImportError as error:
        raise PluginError(
            "gphoto2-missing",
            what=f"The library for this camera is not installed ({error}).",
            remedy="Install it into Velatura's environment: pip install 'velatura[gphoto2]'.",
        ) from error
    return gphoto2
