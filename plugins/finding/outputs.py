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
    r"^(\S{1,64}) connected (?:primary )?(?:(\d{1,5})x(\d{1,5})\+(\d{1,5})\+(\d{1,5})(?: \(0x\w+\))?([\w ]*))?",
    re.MULTILINE,
)
_TRANSFORM: Final = re.compile(r"^\tTransform:((?:\s+-?[\d.]+){9})", re.MULTILINE)
_UNSCALED: Final = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def find(wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """Connected outputs; empty without an X server, for example with frames in memory."""
    program = shutil.which("xrandr")
    if not os.environ.get("DISPLAY") or program is None:
        return []
    try:
        done = subprocess.run(  # noqa: S603 - a program of the system, without arguments from outside
            [program, "--verbose"], capture_output=True, text=True, errors="replace", check=False,
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
    """The connected outputs in the text of ``xrandr --query`` or ``--verbose``."""
    found: list[Found] = []
    places: dict[str, tuple[int, int, int, int]] = {}
    matches = list(_OUTPUT.finditer(text))
    for match, end in zip(matches, [*(other.start() for other in matches[1:]), len(text)], strict=True):
        name, width = printable(match[1]), match[2]
        if width is None:
            dark = Notice.warning(
                "output-off",
                f"Output {name} is connected, but it is switched off.",
                f"Switch it on with xrandr --output {name} --auto, and place it beside the others.",
            )
            found.append(Found("display", name, "output, off", identity=name, problems=(dark,)))
            continue
        wide, high, left, top = (int(match[number]) for number in range(2, 6))
        problems = []
        transform = _TRANSFORM.search(text, match.end(), end)
        scaled = transform is not None and [float(number) for number in transform[1].split()] != _UNSCALED
        if match[6].split() not in ([], ["normal"]) or scaled:
            problems.append(Notice.warning(
                "output-changed",
                f"Output {name} is {'scaled' if scaled else 'turned'} by the X server, which changes its pixels.",
                f"Run xrandr --output {name} --rotate normal --reflect normal --scale 1x1.",
            ))  # fmt: skip
        over = [other for other, (x, y, width_px, height_px) in places.items()
                if x < left + wide and left < x + width_px and y < top + high and top < y + height_px]  # fmt: skip
        if over:
            problems.append(Notice.warning(
                "output-overlaps", f"Output {name} shows the same part of the screen as {', '.join(over)}.",
                f"Place it beside them: xrandr --output {name} --right-of the last of the others.",
            ))  # fmt: skip
        places[name] = left, top, wide, high
        table = {"name": name, "width_px": wide, "height_px": high}
        what = f"output of {wide}x{high} at +{left}+{top}"
        found.append(
            Found("display", name, what, "display", "player", {"outputs": [table]}, name, problems=tuple(problems))
        )
    return found


FINDER: Final = Finder("display", find)
