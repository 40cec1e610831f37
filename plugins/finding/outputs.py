"""Display outputs of the X server, from xrandr."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from typing import Final

from hal.codecs.ptp.values import printable
from hal.deadline import Deadline
from hal.errors import DeviceTimeout
from hal.finding import Finder, Found, SearchScope
from hal.notices import Notice

PATIENCE_S: Final = 5.0
_OUTPUT: Final = re.compile(
    r"^(\S{1,64}) connected (?:primary )?(?:(\d{1,5})x(\d{1,5})\+(\d{1,5})\+(\d{1,5}))?", re.MULTILINE
)


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Connected outputs; empty without an X server, for example with frames in memory."""
    program = shutil.which("xrandr")
    if not os.environ.get("DISPLAY") or program is None:
        return []
    try:
        done = subprocess.run(  # noqa: S603 - a program of the system, without arguments from outside
            [program, "--query"], capture_output=True, text=True, errors="replace", check=False,
            timeout=max(0.1, deadline.within(PATIENCE_S).left_s()),
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        raise DeviceTimeout(
            "display-no-answer",
            what="The X server did not list its outputs in time.",
            remedy="Check that the variable DISPLAY is set for the running X server.",
        ) from error
    return parse_outputs(done.stdout)


def parse_outputs(text: str) -> list[Found]:
    """The connected outputs in the text of ``xrandr --query``."""
    found = []
    for match in _OUTPUT.finditer(text):
        name, (width, height, left, top) = printable(match[1]), match.groups()[1:]
        if width is None:
            dark = Notice.warning(
                "output-off",
                f"Output {name} is connected, but it is switched off.",
                f"Switch it on with xrandr --output {name} --auto, and place it beside the others.",
            )
            found.append(Found("display", name, "output, off", identity=name, problems=(dark,)))
            continue
        table = {"name": name, "width_px": int(width), "height_px": int(height)}
        what = f"output of {width}x{height} at +{left}+{top}"
        found.append(Found("display", name, what, "display", "player", {"outputs": [table]}, name))
    return found


FINDER: Final = Finder("display", find)
