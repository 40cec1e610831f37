"""Solves of a whole house: Dask's own scheduler and worker, by the certificates and in the hours that a kiosk gives."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from controller.core.errors import WorkError
from controller.kiosk.house import workers
from controller.kiosk.house.workers import BEFORE_S, may_solve, say_closed, work
from controller.kiosk.state import KioskState, NextEvent
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.bounded.engine import Processor
from controller.stage import cluster as cluster_module
from controller.stage.cluster import Cluster, connected
from controller.stage.link import peers
from controller.stage.link.membership import Authority, Membership, join, requested
from controller.stage.link.peers import keep_peer, peer, scheduler_at, tls_files
from controller.stage.steps.appearance.cluster_solve import answering_on
from controller.stage.steps.appearance.solving import AppearanceRequest
from tests.controller.stage.cluster.test_cluster import CALIBRATION, OPTIONS, assert_same, here, picture, transport
from tests.ports import free_port
from tests.waiting import wait_for

NOW_S = 1.8e9


@pytest.mark.parametrize(
    ("state", "what", "in_s", "may"),
    [
        ("off", "opens", BEFORE_S + 1, True),
        ("off", "opens", BEFORE_S - 1, False),
        ("off", "drift check", 1.0, True),
        ("cooling", "opens", 9e9, False),
        ("playing", "closes", 9e9, False),
        ("fault", "opens", 9e9, False),
    ],
)
def test_a_computer_solves_for_others_while_its_stage_is_closed_and_does_not_open_soon(
    state: str, what: str, in_s: float, may: bool
) -> None:
    now = KioskState(1, "knight", state, "", NOW_S, next_event=NextEvent(what, NOW_S + in_s))
    assert may_solve(now, NOW_S) is may


@contextlib.contextmanager
def working(folder: Path) -> Iterator[None]:
    """What the service does."""
    cancel = threading.Event()
    thread = threading.Thread(target=work, args=(folder, cancel))
    thread.start()
    try:
        yield
    finally:
        cancel.set()
        thread.join()


def joined(house: Authority, name: str, folder: Path) -> Path:
    endpoints = () if name == "house" else ("tls/127.0.0.1:7447",)
    keep_peer(folder, Membership(folder, name, house.name, endpoints), lambda asked: house.peers().certify(asked, name))
    return folder


def doubled(value: int) -> int:
    return 2 * value


def refused(folder: Path) -> str:
    there = peer(folder)
    assert there is not None
    if (address := scheduler_at(there)) is None:
        return "nobody listens"
    with pytest.raises(WorkError) as caught, connected(address, timeout_s=5, workers_s=0, tls=tls_files(there)):
        pass
    return caught.value.code


def solved_until_it_opens(stage: Path, knight: Path, cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """An appearance of the stage without a scheduler, before its worker is ended and after."""
    monkeypatch.setattr(peers, "runtime_path", lambda stage: stage)
    shutil.copytree(knight / "peer", peers.peer_folder(stage) / "peer")
    light = StageLight(transport(), CALIBRATION.black)
    calibrated: Any = SimpleNamespace(engine=Processor(), transport=transport(), calibration=CALIBRATION,
                                      reflected=None, light=light, folder=stage)  # fmt: skip
    said: list[str] = []
    context: Any = SimpleNamespace(advance=lambda done, note: said.append(note), check=lambda: None,
                                   reporter=SimpleNamespace(say=said.append))  # fmt: skip
    request = AppearanceRequest("warm", "Warm", lambda: picture(0), {})
    with answering_on(None, calibrated, [request], stage) as answering:
        assert_same(answering(request, OPTIONS, context), here(0))
        assert said == ["1 workers"]
        say_closed(knight, False)
        wait_for(lambda: cluster.workers == 0)
        monkeypatch.setattr(cluster_module, "WORKERS_S", 0.3)
        assert_same(answering(request, OPTIONS, context), here(0))
        assert any(line.endswith("Warm is solved here.") for line in said)
        monkeypatch.setattr(cluster_module, "WORKERS_S", 60.0)
    with answering_on(None, calibrated, [request], stage) as answering:
        assert_same(answering(request, OPTIONS, context), here(0))


@pytest.mark.slow
def test_closed_stages_solve_for_their_house_and_for_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    for module in (peers, workers):
        monkeypatch.setattr(module, "PORT", port)
    monkeypatch.setattr(workers, "YOUNG_S", 3600.0)  # a kiosk says it again and again
    city, other = Authority(tmp_path / "city", "City"), Authority(tmp_path / "other", "Other")
    house, knight = joined(city, "house", tmp_path / "house"), joined(city, "knight", tmp_path / "knight")
    there = peer(knight)
    assert there is not None
    assert scheduler_at(there) is None
    with working(house), working(knight):
        wait_for(lambda: scheduler_at(there) is not None)
        assert refused(knight) == "no-workers", "the stage is open"
        say_closed(knight, True)
        with connected(str(scheduler_at(there)), tls=tls_files(there)) as cluster:
            assert cluster.submit(doubled, 21).result() == 42
            solved_until_it_opens(tmp_path, knight, cluster, monkeypatch)
            say_closed(knight, True)
            assert refused(joined(other, "vase", tmp_path / "vase")) == "scheduler-unreachable"
            # The certificate by which it belongs to the house is another one, which can't serve.
            key, asked = requested()
            place = Membership(tmp_path / "bust" / "peer", "bust", "City", there.endpoints)
            join(place, key, city.admit(asked, "bust", ""), (city.folder / "authority.pem").read_bytes())
            assert refused(tmp_path / "bust") == "scheduler-unreachable"
            with pytest.raises(WorkError), connected(str(scheduler_at(there)), timeout_s=5):  # with none
                pass
            say_closed(knight, False)
            wait_for(lambda: cluster.workers == 0)
        # Who was removed has no valid certificate any more: the scheduler starts with those of another authority.
        shutil.copytree(knight, tmp_path / "before")
        city.remove("bust")
        joined(city, "house", house)
        joined(city, "knight", knight)
        wait_for(lambda: refused(knight) == "no-workers")
        assert refused(tmp_path / "before") == "scheduler-unreachable"
