"""Where the interpreter is that runs the emulator of ``pjlink-advance``: it needs Python 3.13 or later."""

from __future__ import annotations

import os
import shutil
import subprocess
from functools import cache
from typing import Final

NOTICE: Final = (
    "No Python >= 3.13 with pjlink-advance is at hand (PJLINK_ADVANCE_PYTHON names one): our driver was not run "
    "against its emulator; docs/how-to/emulated-devices.md says how."
)


@cache
def pjlink_advance_python() -> str:
    """A Python that has the package; "" if none is available."""
    named = os.environ.get("PJLINK_ADVANCE_PYTHON")
    for name in [named] if named else ["python3.13", "python3.14"]:
        if not (path := shutil.which(name)):
            continue
        tried = subprocess.run([path, "-c", "import pjlink_advance.emulator"], capture_output=True, check=False)
        if tried.returncode == 0:
            return path
    return ""
