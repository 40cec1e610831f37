"""A douser in stage.toml: what a run does with it, and which tables are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.core.errors import UsageError
from controller.stage.sessions.check import check_stage
from hal.errors import DeviceGone
from hal.registry import Drivers
from lab.emulated.projectors.dousers import dmx_nodes
from plugins.dousers.sacn_douser import DRIVER
from plugins.emulated.core.truth import DouserTruth
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from tests.controller.stage.sessions.run_models import STAGE, Models
from tests.waiting import wait_for

DOUSER = """\
[projectors.douser]
driver = "sacn"
address = "127.0.0.1:9"
universe = 1
channel = 12
travel_s = 0
"""


def stage(folder: Path, table: str) -> Models:
    """Its second projector has the table."""
    models = Models(folder)
    (folder / "stage.toml").write_text(STAGE.replace('port = "B"\n', f'port = "B"\n{table}'))
    models.drivers = Drivers((*models.drivers.list, DRIVER))
    return models


def test_a_run_opens_it_for_its_work_and_closes_it_at_the_end(tmp_path: Path) -> None:
    told: list[tuple[str, bool]] = []
    lamps = {"right": EmulatedLamp(LampTiming(0.0, 0.0))}
    truth = DouserTruth(0, 1, 12, "right", 0.0)
    (node,) = dmx_nodes([truth], lamps, lambda name, is_open: told.append((name, is_open)))
    with node:
        models = stage(tmp_path, DOUSER.replace("127.0.0.1:9", node.address))
        seen: list[object] = []

        def work(context: object) -> tuple[Path, ...]:
            wait_for(lambda: told != [])
            seen.append((list(told), [lamp.lit for lamp in models.lamps.values()]))
            return ()

        models.run(work)
        assert seen == [([("right", True)], [True, True])]
        wait_for(lambda: told == [("right", True), ("right", False)])


def test_no_lamp_is_struck_behind_a_douser_that_can_not_be_opened(tmp_path: Path) -> None:
    models = stage(tmp_path, DOUSER)
    with pytest.raises(DeviceGone) as caught:
        models.run()
    assert caught.value.code == "douser-gone"
    assert not any(lamp.lit for lamp in models.lamps.values())


@pytest.mark.parametrize(
    ("right", "wrong", "line", "word"),
    [
        ('"sacn"', '"dmx"', 14, "not a douser driver"),
        ("universe = 1", "universe = 0", 16, "universe"),
        ("channel = 12\n", "", 13, "channel"),
        ("travel_s", "travels", 18, "travels"),
    ],
)
def test_a_wrong_table_is_refused_with_its_line(tmp_path: Path, right: str, wrong: str, line: int, word: str) -> None:
    models = stage(tmp_path, DOUSER.replace(right, wrong))
    with pytest.raises(UsageError) as caught:
        check_stage(tmp_path, drivers=models.drivers)
    assert f"line {line}" in caught.value.what
    assert word in caught.value.what
