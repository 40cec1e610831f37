"""A projector profile for an emulated stage: the shipped commands with short times, as a file of the stage."""

from __future__ import annotations

import re
from importlib import resources

from hal.errors import PluginError
from plugins.emulated.projectors.lamp import LampTiming

_TIMING_S = {
    # An emulated projector answers at once, but the machine that it is emulated on may be loaded.
    "answer_s": 2.0,
    "late_s": 3.0,
    "command_s": 3.0,
    "confirm_s": 15.0,
    "interval_s": 0.005,
    "boot_interval_s": 0.05,
}


def quick_profile(lamp: LampTiming, *, base: str = "optoma-later", stable_s: float | None = None) -> str:
    """The TOML text of the shipped profile ``base`` with the times of an emulated lamp.

    ``stable_s`` is the time from strike to photometric stability (default: the warm-up time). Raises
    PluginError("profile-unchanged") if the shipped file lacks a key that must be shortened.
    """
    text = (resources.files("firmware_configs") / "projectors" / f"{base}.toml").read_text(encoding="utf-8")
    times = {
        **_TIMING_S,
        "warm_up_s": lamp.warm_up_s,
        "stable_s": max(lamp.warm_up_s, stable_s or 0.0),
        "cool_down_s": lamp.cool_down_s,
        "minimum_off_s": lamp.cool_down_s,
    }
    for key, seconds in times.items():
        text, count = re.subn(rf"(?m)^{key}\s*=\s*[0-9.]+.*$", f"{key} = {float(seconds)!r}", text)
        if count != 1:
            raise PluginError(
                "profile-unchanged",
                what=f"The shipped profile {base} does not set {key} once.",
                remedy="Reinstall velatura; the profile was changed.",
            )
    return f"# Written for an emulated stage: {base} with short times.\n{text}"
