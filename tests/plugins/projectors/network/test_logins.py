"""Projectors on their own LAN port: logins, connections that end, sleeping networks. Real sockets."""

from __future__ import annotations

import re
import socket
import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import wakeonlan

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.registry import OpenContext
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS, login_of
from lab.emulated.projectors.boards_marked import PanasonicDzBoard
from lab.emulated.projectors.network import GATES, EmulatedNetworkProjector, JvcGate, JvcHashedGate, NtControlSha256Gate
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming
from plugins.projectors.network.driver import DRIVER, magic_packet, open_network_projector
from tests.plugins.conftest import each, hasty
from tests.plugins.projectors.switching import strikes_once_when_its_second_answer_is_lost

SOON = 30.0
NETWORK = [name for name in BOARDS if login_of(name)]
PLAIN = LampTiming(0.1, 0.2)
LOCKED = [name for name in NETWORK if login_of(name) != "none"]


def power(pair: Any) -> Power:
    return pair.driver.status(deadline=in_seconds(SOON)).power  # type: ignore[no-any-return]


@pytest.mark.parametrize("profile", LOCKED)
@pytest.mark.parametrize("given", [None, "wrong123"])
def test_a_missing_or_wrong_password_is_told_and_no_lamp_is_struck(
    open_network: Any, profile: str, given: str | None
) -> None:
    lamp = EmulatedLamp(PLAIN)
    settings = {} if given is None else {"password": given}

    def switch_on() -> None:
        pair = open_network(profile=profile, lamp=lamp, password="secret123", settings=settings)
        pair.driver.switch_on(deadline=in_seconds(SOON))

    with pytest.raises(DeviceRefused) as caught:
        switch_on()
    assert caught.value.code == "projector-password"
    assert "secret123" not in str(caught.value)
    assert lamp.strikes == 0


@pytest.mark.parametrize("profile", LOCKED)
def test_without_a_password_none_is_needed(open_network: Any, profile: str) -> None:
    assert power(open_network(profile=profile)) is Power.OFF


@pytest.mark.parametrize(
    ("profile", "gate"),
    [("panasonic-dz", NtControlSha256Gate), ("jvc", JvcGate), ("jvc", JvcHashedGate)],
)
def test_every_variant_of_a_login_is_passed(open_network: Any, profile: str, gate: Any) -> None:
    pair = open_network(profile=profile, gate=gate, password="secret123", settings={"password": "secret123"})
    assert power(pair) is Power.OFF


def test_no_tape_holds_the_password(open_network: Any) -> None:
    for profile in LOCKED:
        pair = open_network(profile=profile, name=profile, password="secret123", settings={"password": "secret123"})
        pair.driver.status(deadline=in_seconds(SOON))
        told = [file.read_text() for file in pair.stage.glob("*.tape")]
        assert told
        assert any("<" in text for text in told)
        assert not any("secret123" in text for text in told)


@pytest.mark.parametrize("profile", NETWORK)
def test_a_connection_that_ended_between_two_questions_is_opened_again(open_network: Any, profile: str) -> None:
    pair = open_network(profile=profile, edit=hasty)
    assert power(pair) is Power.OFF
    for _ in range(2):
        pair.emulator.hang_up()
        assert power(pair) is Power.OFF
    assert pair.emulator.connections >= 3


def test_a_cable_that_comes_back_is_waited_for(open_network: Any) -> None:
    def pulled(profile: str) -> None:
        pair = open_network(profile=profile, name=profile, edit=hasty)
        assert power(pair) is Power.OFF
        pair.emulator.unplug()
        threading.Timer(0.3, pair.emulator.replug).start()
        assert power(pair) is Power.OFF

    each(NETWORK, pulled)


@pytest.mark.parametrize("knob", ["silent", "garbage"])
def test_silence_and_noise_are_typed_errors_before_the_deadline(open_network: Any, knob: str) -> None:
    def bent(profile: str) -> None:
        pair = open_network(profile=profile, name=profile, edit=hasty)
        pair.emulator.faults.set(**{knob: True})
        until = in_seconds(60)
        with pytest.raises((DeviceTimeout, ProtocolError, DeviceGone)):
            pair.driver.status(deadline=until)
        assert not until.passed
        pair.emulator.faults.clear()
        assert power(pair) is Power.OFF

    each(NETWORK, bent)


def test_a_lost_acknowledgement_strikes_once(open_network: Any) -> None:
    def lost(profile: str) -> None:
        pair = open_network(profile=profile, name=profile, edit=hasty)
        assert power(pair) is Power.OFF
        strikes_once_when_its_second_answer_is_lost(pair)

    each(NETWORK, lost)


@pytest.mark.parametrize("profile", NETWORK)
def test_on_while_cooling_is_refused(open_network: Any, profile: str) -> None:
    lamp = EmulatedLamp(LampTiming(0.1, 20.0))
    lamp.warm_now()
    lamp.extinguish()
    pair = open_network(profile=profile, lamp=lamp, edit=hasty)
    with pytest.raises(DeviceRefused):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert lamp.strikes == 0


def test_a_projector_that_greets_with_nothing_or_something_else_is_told(tmp_path: Path) -> None:
    for profile in LOCKED:
        for greeting in (b"", b"220 mail.example ESMTP\r\n", b"\xff\xfb\x01\xff\xfb\x03" + b"x" * 300):
            with socket.create_server(("127.0.0.1", 0)) as server:
                threading.Thread(target=_greet, args=(server, greeting), daemon=True).start()
                table = {"profile": profile, "address": f"127.0.0.1:{server.getsockname()[1]}"}
                with pytest.raises((DeviceGone, DeviceTimeout, ProtocolError)) as caught:
                    open_network_projector(table, OpenContext(tmp_path), in_seconds(1.0))
                assert caught.value.remedy


def _greet(server: socket.socket, greeting: bytes) -> None:
    client, _ = server.accept()
    with client:
        client.sendall(greeting)
        client.settimeout(5.0)
        while client.recv(100):
            pass


def test_an_open_that_is_cancelled_ends(tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    with socket.create_server(("127.0.0.1", 0)) as server:
        table = {"profile": "jvc", "address": f"127.0.0.1:{server.getsockname()[1]}"}
        with pytest.raises(Cancelled):
            open_network_projector(table, OpenContext(tmp_path), in_seconds(SOON, stop))


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"profile": "sanyo"}, "profile-not-network"),
        ({"profile": "pjlink"}, "profile-not-serial"),
        ({"profile": "epson-escvp21", "password": "seventeen letters"}, "setting-wrong"),
        ({"profile": "nec", "password": "none is known"}, "setting-wrong"),
        ({"profile": "jvc", "wake": "00:11:22"}, "setting-wrong"),
        ({"profile": "jvc", "address": "host:port"}, "address-wrong"),
    ],
)
def test_wrong_settings_are_found_without_a_device(tmp_path: Path, settings: dict[str, Any], code: str) -> None:
    assert DRIVER.check is not None
    with pytest.raises(DeviceError) as caught:
        DRIVER.check({"address": "127.0.0.1", **settings}, OpenContext(tmp_path))
    assert caught.value.code == code


def test_a_serial_line_refuses_a_profile_that_has_only_a_network_port(tmp_path: Path) -> None:
    from plugins.projectors.profile_files import read_settings

    with pytest.raises(PluginError, match="network"):
        read_settings({"profile": "sony-adcp", "port": "/dev/ttyS0"}, OpenContext(tmp_path))


def test_the_packet_that_wakes_is_that_of_wakeonlan() -> None:
    for address in ("00:1a:2b:3c:4d:5e", "00-1A-2B-3C-4D-5E", "001a2b3c4d5e"):
        assert magic_packet(address) == wakeonlan.create_magic_packet(address)


def test_a_network_that_sleeps_is_woken_and_no_lamp_is_struck(tmp_path: Path) -> None:
    lamp = EmulatedLamp(PLAIN)
    projector = EmulatedNetworkProjector(lamp, BOARDS["jvc"](lamp), gate=GATES["jvc"])
    projector.start()
    address = projector.address
    projector.unplug()
    heard: list[bytes] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))

        def sleeps() -> None:
            heard.append(ear.recv(200))
            projector.replug()

        thread = threading.Thread(target=sleeps, daemon=True)
        thread.start()
        to = f"127.0.0.1:{ear.getsockname()[1]}"
        table = {"profile": "jvc", "address": address, "wake": "00:1a:2b:3c:4d:5e", "wake_to": to}
        driver = open_network_projector(table, OpenContext(tmp_path), in_seconds(SOON))
        thread.join(5.0)
    try:
        assert heard == [wakeonlan.create_magic_packet("00:1a:2b:3c:4d:5e")]
        assert driver.status(deadline=in_seconds(SOON)).power is Power.OFF
        assert lamp.strikes == 0
    finally:
        driver.close()
        projector.stop()


def test_one_that_answers_gets_no_packet(open_network: Any) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(0.2)
        to = f"127.0.0.1:{ear.getsockname()[1]}"
        assert power(open_network(profile="jvc", settings={"wake": "00:1a:2b:3c:4d:5e", "wake_to": to})) is Power.OFF
        with pytest.raises(TimeoutError):
            ear.recv(200)


def test_a_panasonic_of_another_number_on_the_line_is_silent(open_serial: Any) -> None:
    board = partial(PanasonicDzBoard, number=b"07")
    pair = open_serial(profile="panasonic-dz", board=board, settings={"address": "07"}, edit=hasty)
    assert power(pair) is Power.OFF
    other = open_serial(profile="panasonic-dz", board=board, settings={"address": "08"}, name="other", edit=hasty)
    with pytest.raises(DeviceTimeout):
        other.driver.status(deadline=in_seconds(SOON))


def test_what_happens_in_a_jvc_that_ignores_a_command_shows_in_its_state(open_network: Any) -> None:
    pair = open_network(profile="jvc", edit=lambda text: re.sub("confirm_s = .*", "confirm_s = 0.5", hasty(text)))
    assert power(pair) is Power.OFF
    pair.emulator.lamp.overheat()
    with pytest.raises(DeviceError):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.lamp.phase is LampPhase.STANDBY
