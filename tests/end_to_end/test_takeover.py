"""A lamp dies while the kiosk plays: the projectors that are left take over, on a real calibration."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.kiosk.api.control import call_kiosk
from controller.run.progress import Silent
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import read_solved
from controller.stage.services.calibrate import AppearanceOrder, make_appearances
from controller.stage.sessions.bench import BenchProcess
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import codes, copied, wait_for
from tests.end_to_end.program import Command

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
NAME, DEAD = "checkerboard", "above"
FAULTS = f"""
[[event]]
do = "lamp-failure"
device = "{DEAD}"
on_message = 12
"""


def shown(stage: Path) -> list[bool]:
    """Whether each output shows anything."""
    outputs = check_stage(stage).stage.tables.display.outputs
    data, at, lit = np.memmap(stage / "run" / "outputs.frame", np.uint8, "r"), 4096, []
    for output in outputs:
        size = output.width_px * output.height_px * 3
        lit.append(bool(np.any(data[at : at + size])))
        at += size + -size % 4096
    return lit


def error_of(seen: FloatImage, target: FloatImage, where: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> float:
    """rms of the difference at the best brightness over the target's rms: a dimmer stage is no error."""
    light, wanted = seen[where], target[where]
    gain = float((light * wanted).sum() / np.square(light).sum())
    return float(np.sqrt(np.square(gain * light - wanted).mean() / np.square(wanted).mean()))


def test_the_others_take_over_for_a_dead_lamp(finished_demo: FinishedDemo, tmp_path: Path) -> None:
    stage = copied(finished_demo.stage, tmp_path / "stage")
    head, *tables = (stage / "stage.toml").read_text().split("\n[[appearances]]\n")
    (table,) = (one for one in tables if f'"{NAME}"' in one)
    # One appearance is solved for the others, instead of all.
    (stage / "stage.toml").write_text(f"{head}\n[[appearances]]\n{table}")
    shutil.rmtree(stage / "bundles")
    make_appearances(
        AppearanceOrder(names=[NAME]), session=OwnSession(stage), reporter=Silent(), cancel=threading.Event()
    )
    (stage / "bench" / "dead.toml").write_text(FAULTS)
    bench = stage / "bench.toml"
    text = bench.read_text()
    assert 'scenario = ""' in text
    bench.write_text(text.replace('scenario = ""', 'scenario = "bench/dead.toml"'))
    with BenchProcess(stage, cancel=threading.Event()), Command("kiosk", "serve", stage, "--no-panel") as kiosk:
        wait_for(lambda: "takeover-solved" in codes(stage))
        wait_for(lambda: shown(stage) == [True, True, False])
        state = call_kiosk(stage, "status")
        assert (state["state"], state["playing"]) == ("degraded", NAME)
        assert kiosk.interrupt().code == 0
    run, names = finished_calibration(stage), check_stage(stage).names
    calibrated = Calibrated(run, names)
    black = calibrated.calibration.black
    whole, left = (
        read_solved(run, NAME, names),
        read_solved(run / "without" / DEAD, NAME, [n for n in names if n != DEAD]),
    )
    bent = {key: float(str(left.figures[key])) for key in ("reachable_share", "adapted_share")}
    assert bent["adapted_share"] >= bent["reachable_share"], "the target is adapted as stage.toml says"
    dark = np.zeros_like(whole.linear[DEAD])
    lit = np.logical_or.reduce([calibrated.transport.lit[number] for number, name in enumerate(names) if name != DEAD])
    where = lit & left.reachable & whole.reachable & calibrated.calibration.object_mask
    errors = []
    for frames in (left, whole):
        light = [dark if name == DEAD else frames.linear[name] for name in names]
        errors.append(error_of(calibrated.transport.forward(light) + black, left.target, where))
    assert errors[0] < 0.5 * errors[1], "frames solved for the others are no better than the old ones in its absence"
