"""A copy of a finished stage on which a kiosk may work, and what the kiosk tells."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from controller.core.errors import VelaturaError
from controller.kiosk.api.control import call_kiosk
from tests import waiting
from tests.end_to_end.program import LONGEST_S
from tests.ports import free_port


def copied(stage: Path, to: Path) -> Path:
    """What is only ever replaced is linked; databases and mapped files are written to."""

    def keep(source: str, target: str) -> None:
        (os.link if source.endswith((".npz", ".dng")) else shutil.copy2)(source, target)

    left = shutil.ignore_patterns("run")
    copy = Path(shutil.copytree(stage, to, symlinks=True, copy_function=keep, ignore=left))
    with_ports_of_its_own(copy)
    return copy


def with_ports_of_its_own(stage: Path) -> Path:
    """``stage``, a copy: copies are served at the same time, by several workers."""
    bench, described = stage / "bench.toml", stage / "stage.toml"
    text, wanted = bench.read_text(), described.read_text()
    for line in re.findall(r"^(?:command|event)_port = \d+$", text, re.MULTILINE):
        name, _, old = line.partition(" = ")
        new = free_port()
        text = text.replace(line, f"{name} = {new}")
        wanted = re.sub(rf"(?<=:){old}\b", str(new), wanted)
    bench.write_text(text)
    described.write_text(wanted)
    return stage


def wait_for(what: Callable[[], bool]) -> None:
    waiting.wait_for(what, within_s=LONGEST_S, every_s=0.2)


def codes(stage: Path) -> list[str]:
    """Of the kiosk's events so far."""
    try:
        return [row["code"] for row in call_kiosk(stage, "events")]
    except VelaturaError:  # it is not there yet
        return []
