"""Appearances on a real scheduler with two real workers, one of which may be killed."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from distributed import Client, Scheduler

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.request import AppearanceResult, SolveOptions, solve_appearance
from controller.optics.solve.targets.values import Target
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.planes import frame_planes
from controller.stage import cluster as cluster_module
from controller.stage.cluster import Cluster, StageData, connected
from controller.stage.steps.appearance.cluster_solve import SpreadAppearances
from lab.timings.tools.synthetic import synthetic_calibration
from tests.controller.stage.cluster.machines import Machines, machines

CALIBRATION = synthetic_calibration(projector=(34, 40), camera=(96, 120))
OPTIONS = SolveOptions(share=0.9, smoothness=0.001)


@cache
def transport() -> LightTransport:
    return build_transport(CALIBRATION)


def stage_data() -> StageData:
    return StageData(transport(), CALIBRATION.black)


def picture(number: int) -> Target:
    y, x = np.mgrid[0:96, 0:120].astype(np.float32)
    wave: FloatImage = 0.5 + 0.4 * np.sin(x / (3 + number)) * np.cos(y / (2 + number))
    return Target(np.repeat(wave[..., None], 3, 2).astype(np.float32), np.ones((96, 120), np.bool_))


def here(number: int) -> AppearanceResult:
    return solve_appearance(StageLight(transport(), CALIBRATION.black), picture(number), OPTIONS)


def assert_same(found: AppearanceResult, expected: AppearanceResult) -> None:
    np.testing.assert_array_equal(frame_planes(found.frames), frame_planes(expected.frames))
    np.testing.assert_array_equal(found.target, expected.target)
    np.testing.assert_array_equal(found.reachable, expected.reachable)
    ours, theirs = ({k: v for k, v in one.figures.items() if k != "seconds"} for one in (found, expected))
    assert ours == theirs


def slow(seconds: float, value: int) -> int:
    time.sleep(seconds)
    return value


def failing() -> int:
    raise WorkError("no-light", what="There is no light.", remedy="Switch it on.")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    with machines(tmp_path_factory.mktemp("cluster"), 2) as made:
        yield made


@pytest.fixture
def cluster(two: Machines) -> Iterator[Cluster]:
    with connected(two.address) as opened:
        ends_s = time.monotonic() + 30
        while opened.workers < 2:
            assert time.monotonic() < ends_s
            time.sleep(0.05)
        yield opened


def test_appearances_made_elsewhere_are_the_same_to_the_bit(cluster: Cluster) -> None:
    spread = SpreadAppearances(cluster, stage_data)
    for number in range(4):
        spread.begin(f"picture {number}", picture(number), OPTIONS)
    for number in range(4):
        assert_same(spread.answer(f"picture {number}", lambda: None), here(number))


def test_what_a_worker_refuses_is_told_as_it_would_be_here(cluster: Cluster) -> None:
    with pytest.raises(WorkError) as refused:
        cluster.submit(failing).result()
    assert (refused.value.code, refused.value.what, refused.value.remedy) == (
        "no-light", "There is no light.", "Switch it on.",
    )  # fmt: skip
    spread = SpreadAppearances(cluster, stage_data)
    black = replace(picture(0), image=np.zeros((96, 120, 3), np.float32))
    spread.begin("black", black, OPTIONS)
    with pytest.raises(VelaturaError) as unlit:
        spread.answer("black", lambda: None)
    assert unlit.value.code == "no-light"


def test_a_stop_takes_hold_while_waiting(cluster: Cluster) -> None:
    class Stopped(Exception):
        pass

    def check() -> None:
        raise Stopped

    began_s = time.monotonic()
    with pytest.raises(Stopped):
        cluster.submit(slow, 5.0, 1).result(check)
    assert time.monotonic() - began_s < 4.5


def test_a_worker_killed_in_the_middle_costs_time_and_nothing_else(tmp_path: Path) -> None:
    with machines(tmp_path, 2) as made, connected(made.address) as cluster:
        while cluster.workers < 2:
            time.sleep(0.05)
        spread = SpreadAppearances(cluster, stage_data)
        for number in range(6):
            spread.begin(f"picture {number}", picture(number), OPTIONS)
        threading.Timer(0.5, made.workers[0].kill).start()
        for number in range(6):
            assert_same(spread.answer(f"picture {number}", lambda: None), here(number))
        made.workers[0].wait()
        assert cluster.workers == 1


def test_when_all_workers_go_a_new_one_gets_everything_again_under_another_name(tmp_path: Path) -> None:
    # Under the same name, a worker that is still asking the lost one for it drops what is sent to it (distributed
    # 2026.8.0: "cancelled" to "memory"), and what needs it waits for good.
    with machines(tmp_path, 1) as made, connected(made.address) as cluster:
        spread = SpreadAppearances(cluster, stage_data)
        spread.begin("first", picture(1), OPTIONS)
        assert_same(spread.answer("first", lambda: None), here(1))
        before = stages_on(made.address)
        spread.begin("second", picture(2), OPTIONS)
        made.workers[0].kill()
        made.workers[0].wait()
        made.start_worker()
        spread.begin("third", picture(3), OPTIONS)
        for name, number in (("second", 2), ("third", 3)):
            assert_same(spread.answer(name, lambda: None), here(number))
        assert len(before) == len(stages_on(made.address) - before) == 1


def stages_on(address: str) -> set[str]:
    """The names under which a scheduler knows stages."""
    with Client(address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        return {key for key in client.run_on_scheduler(_keys) if key.startswith("velatura-stage-")}


def _keys(dask_scheduler: Scheduler) -> list[str]:
    return [str(key) for key in dask_scheduler.tasks]


def test_a_scheduler_without_workers_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_module, "WORKERS_S", 0.3)
    with machines(tmp_path, 0) as made, pytest.raises(WorkError) as refused, connected(made.address):
        pass
    assert refused.value.code == "no-workers"


def test_workers_with_other_code_are_refused(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_module, "code_digest", _another)
    with pytest.raises(UsageError) as refused:
        cluster.check_code()
    assert refused.value.code == "workers-differ"


_asked: list[int] = []


def _another() -> str:
    """Another digest in each process."""
    _asked.append(1)
    return f"{threading.get_native_id()}"


def test_a_scheduler_that_is_not_there_is_told_of() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with (
            pytest.raises(WorkError) as refused,
            connected(f"tcp://127.0.0.1:{taken.getsockname()[1]}", timeout_s=1),
        ):
            pass
    assert refused.value.code == "scheduler-unreachable"
    with pytest.raises(UsageError) as wrong, connected("somewhere"):
        pass
    assert wrong.value.code == "scheduler-address"


def test_without_the_extra_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(UsageError) as refused, connected("tcp://127.0.0.1:1"):
        pass
    assert refused.value.code == "extra-missing"
