"""A conductor, two agents and their players, linked by Zenoh on loopback: one display."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from controller.bundle.signing import write_public_key
from controller.kiosk.install.system import System
from controller.kiosk.install.update import OFFERED, Packages, status_of_player
from controller.stage.hosts.agent import Agent
from controller.stage.hosts.clock import HostClock, Tracking, tracking
from controller.stage.hosts.conductor import Skew
from controller.stage.hosts.remote import Remote, key
from controller.stage.hosts.screen import Screen, frame_lock
from controller.stage.link.membership import membership
from controller.stage.link.session import house_link, member_link
from controller.stage.link.transfer import PART_BYTES, Arrivals, Offer
from hal.deadline import in_seconds
from hal.errors import CodedError, DeviceError
from plugins.display.player import PlayerDisplay
from tests.campaigns.in_step import compared
from tests.controller.kiosk.install.test_update import KEY, debian_package
from tests.controller.play.conftest import write_noise
from tests.controller.play.wire import Frames, Wire, noise, same
from tests.controller.stage.hosts.computers import Computers, running
from tests.waiting import eventually


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Computers]:
    computers = Computers(tmp_path_factory.mktemp("three"), ["left", "right"], None)
    computers.bundle = write_noise(computers.folder / "b.vel", outputs=computers.outputs)
    with running(computers):
        yield computers


def test_one_display_of_three_computers(three: Computers) -> None:
    display = PlayerDisplay(three.socket, None)
    try:
        assert [output.name for output in display.outputs(deadline=in_seconds(5))] == ["here", "left", "right"]
        # A pattern comes whole to every output.
        pictures = noise(three.outputs, 11)
        display.show(pictures, deadline=in_seconds(10))
        for name, socket in three.players().items():
            assert same(Frames(socket.with_name("out.frame")).read(), {name: pictures[name]})
        # A list is in step, and its skew is a number.
        eventually(lambda: _played(display))
        eventually(lambda: display.status(deadline=in_seconds(5))["compared"] > 5)
        status = display.status(deadline=in_seconds(5))
        assert status["mixed"] == 0
        assert 0 < status["skew_p50_s"] < 0.5
        assert status["lost_hosts"] == status["missing_outputs"] == []
        assert status["frame_lock"] is False, "nothing here could tell"
        # A computer that is lost is named, and the others show no pattern without it. It plays on.
        three.kill("left")
        eventually(lambda: display.status(deadline=in_seconds(5))["lost_hosts"] == ["left"])
        with pytest.raises(DeviceError, match="left"):
            display.show(pictures, deadline=in_seconds(10))
        with Wire(three.players()["left"]) as wire:
            assert wire.ask("status")["sequence_running"]
        three.follow("left")
        eventually(lambda: display.status(deadline=in_seconds(5))["lost_hosts"] == [])
        # One that is set by 5 s is named, and the show is not moved.
        (three.place("right") / "clock").write_text("5")
        eventually(lambda: "set by +5.0" in display.status(deadline=in_seconds(5))["clock_troubles"]["right"])
        display.stop(deadline=in_seconds(10))
        assert not Frames(three.players()["right"].with_name("out.frame")).read()["right"].any()
    finally:
        display.close()


def test_no_swap_of_a_list_is_mixed(three: Computers) -> None:
    found = compared(three, 60, 0.05)
    assert found.mixed == 0
    assert found.compared >= 30, found


def _played(display: PlayerDisplay) -> bool:
    try:
        display.play_sequence([("0", 0.1), ("1", 0.1, 0.05), ("2", 0.1)], deadline=in_seconds(10))
    except DeviceError as error:
        if error.code != "hosts-behind":
            raise
        return False
    return True


# Bundles on their way


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "large.vel"
    path.write_bytes(np.random.default_rng(1).bytes(3 * PART_BYTES + 17))
    return path


def parts(path: Path, offer: Offer) -> list[bytes]:
    return [offer.part(path, number) for number in range(len(offer.parts))]


def test_a_bundle_comes_in_parts_and_after_a_cut_only_the_rest(tmp_path: Path, file: Path) -> None:
    checked: list[bytes] = []
    offer = Offer.of(file)
    sent = parts(file, offer)
    arrivals = Arrivals(tmp_path / "there", lambda path: checked.append(path.read_bytes()))
    assert arrivals.offered(offer) == (0, 1, 2, 3)
    arrivals.part(sent[2])
    arrivals.part(sent[0])
    # Another process, as after a power cut.
    arrivals = Arrivals(tmp_path / "there", lambda path: checked.append(path.read_bytes()))
    assert arrivals.offered(offer) == (1, 3)
    with pytest.raises(CodedError) as caught:
        arrivals.path(offer.name)
    assert caught.value.code == "file-not-here"
    arrivals.part(sent[3])
    arrivals.part(sent[1])
    assert checked == []
    assert arrivals.offered(offer) == ()
    assert checked == [file.read_bytes()]
    assert arrivals.path(offer.name).read_bytes() == file.read_bytes()


def test_a_part_that_is_damaged_or_of_another_bundle_is_refused(tmp_path: Path, file: Path) -> None:
    offer = Offer.of(file)
    sent = parts(file, offer)
    arrivals = Arrivals(tmp_path / "there", lambda path: None)
    with pytest.raises(CodedError, match="damaged"):
        arrivals.part(sent[0])
    arrivals.offered(offer)
    for wrong in (sent[0][:-1] + b"\0", b"\1" + sent[0][1:], sent[0][:32] + bytes((0, 0, 0, 9)), sent[0][:20]):
        with pytest.raises(CodedError, match="damaged"):
            arrivals.part(wrong)
    assert arrivals.offered(offer) == (0, 1, 2, 3)


def test_a_bundle_that_is_not_trusted_there_never_counts(tmp_path: Path, file: Path) -> None:
    def check(path: Path) -> None:
        raise CodedError("bundle-unsigned", what="It is not signed.", remedy="Sign it.")

    offer = Offer.of(file)
    arrivals = Arrivals(tmp_path / "there", check)
    arrivals.offered(offer)
    for part in parts(file, offer):
        arrivals.part(part)
    with pytest.raises(CodedError, match="not signed"):
        arrivals.offered(offer)
    assert list((tmp_path / "there").iterdir()) == []


# The program of the other computers


def test_an_update_is_brought_once_and_one_that_was_taken_back_is_said(tmp_path: Path) -> None:
    computers, root = Computers(tmp_path, ["left"], None), tmp_path / "root"
    computers.join()
    for place in ("opt", "etc/velatura/update-keys", "run/velatura"):
        (root / place).mkdir(parents=True)
    write_public_key(root / "etc/velatura/update-keys/house.pub", bytes(KEY.verify_key))
    system, offered = System(lambda line: None, root=root), root / OFFERED.relative_to("/")
    own = membership(tmp_path / "keys-left")
    assert own is not None
    with house_link(computers.authority, host="127.0.0.1", port=computers.port) as here, member_link(own) as there:
        remote = Remote(here, "left", "", {}, tmp_path / "update.deb")
        agent = Agent(there, "left", tmp_path / "bundles", HostClock(), lambda name: Screen(tmp_path, HostClock()))
        agent.updates = Packages(system, there, key("left", "program"))
        package = debian_package(tmp_path, "2").rename(tmp_path / "update.deb")

        def reported(so: Callable[[], bool]) -> bool:
            agent.step()
            return so()

        eventually(lambda: reported(offered.exists))
        assert offered.read_bytes() == package.read_bytes()
        assert status_of_player(system) == {"state": "off"}
        told = {"name": hashlib.sha256(package.read_bytes()).hexdigest(), "state": "failed", "why": "It is dark."}
        (root / "opt/velatura.update").write_text(json.dumps(told))
        offered.unlink()
        eventually(lambda: reported(lambda: remote.trouble == "Its update was taken back: It is dark."))
        # Nor does a conductor that starts later offer it.
        again = Remote(here, "left", "", {}, package)
        eventually(lambda: reported(lambda: again.trouble != ""))
        assert not offered.exists()


# Clocks


class Clocks:
    def __init__(self) -> None:
        self.wall_s, self.monotonic_s = 1.7e9, 50.0
        self.tracking: Tracking | None = Tracking(True, 0.0002)
        self.clock = HostClock(lambda: self.wall_s, lambda: self.monotonic_s, lambda: self.tracking)

    def later(self, seconds: float, *, step_s: float = 0.0) -> None:
        self.wall_s += seconds + step_s
        self.monotonic_s += seconds
        self.clock.look()


def test_a_clock_that_somebody_sets_is_not_followed_until_chrony_vouches_for_it() -> None:
    clocks = Clocks()
    clocks.tracking = Tracking(False, 0.5)
    clocks.later(10, step_s=5)
    assert clocks.clock.now_s() == pytest.approx(1.7e9 + 10)
    assert "set by +5.000 s" in clocks.clock.trouble
    clocks.tracking = Tracking(True, 0.0002)
    clocks.later(10)
    assert clocks.clock.now_s() == pytest.approx(1.7e9 + 25)
    assert clocks.clock.trouble == ""


def test_a_clock_that_is_set_and_set_back_moves_nothing() -> None:
    clocks = Clocks()
    clocks.tracking = None
    clocks.later(10, step_s=-5)
    assert clocks.clock.stepped_s == pytest.approx(-5)
    clocks.later(10, step_s=5)
    assert clocks.clock.stepped_s == 0
    assert clocks.clock.now_s() == pytest.approx(1.7e9 + 20)
    assert "chrony does not run" in clocks.clock.trouble


CHRONY = (
    "A29FC87B,ntp.example,3,1795985062.123,0.000012345,-0.000020000,0.000030000,-12.3,0.001,0.05,0.0124,0.0006,64.2,"
)


@pytest.mark.parametrize(
    ("printed", "expected"),
    [
        (CHRONY + "Normal\n", Tracking(True, 0.000012345 + 0.0062 + 0.0006)),
        (CHRONY + "Not synchronised\n", Tracking(False, 0.000012345 + 0.0062 + 0.0006)),
        ("", None),
        ("506 Cannot talk to daemon\n", None),
    ],
)
def test_what_chronyc_prints(printed: str, expected: Tracking | None) -> None:
    found = tracking(lambda command: printed)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert found.synchronised == expected.synchronised
        assert found.error_s == pytest.approx(expected.error_s)


def test_without_chrony_there_is_no_tracking() -> None:
    def missing(command: object) -> str:
        raise FileNotFoundError

    assert tracking(missing) is None


@pytest.mark.parametrize(
    ("says", "locked"),
    [
        ("echo 1; echo 1", True),
        ("echo 1; echo 0", False),
        ("exit 1", False),
        ("true", False),
        ("echo 1; exit 1", False),
    ],
)
def test_frame_lock_is_what_every_card_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: str, locked: bool
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    program = tmp_path / "nvidia-settings"
    program.write_text(
        f'#!/bin/sh\n[ "$*" = "--ctrl-display=:0.1 --terse --query=FrameLockTiming" ] || exit 1\n{says}\n'
    )
    program.chmod(0o755)
    assert frame_lock(":0.1") is locked
    assert not frame_lock("")
    program.unlink()
    assert not frame_lock(":0.1")


def test_skew_is_from_the_first_to_the_last_player_and_other_pictures_are_mixed() -> None:
    skew = Skew(2)
    skew.add(0, [(10.0, 10.001, "a"), (11.0, 11.0, "b")])
    assert skew.figures()["compared"] == 0
    skew.add(1, [(10.0, 10.003, "a"), (11.0, 11.0, "c"), (12.0, 12.0, "a")])
    figures = skew.figures()
    assert (figures["compared"], figures["mixed"]) == (2, 1)
    assert figures["skew_most_s"] == pytest.approx(0.002, rel=1e-3)
