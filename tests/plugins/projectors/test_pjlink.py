"""The PJLink driver against an emulated projector that misbehaves, over real TCP."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError, ProtocolError
from hal.registry import OpenContext
from hal.values import Power
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.projectors.pjlink import open_pjlink_projector
from tests.plugins.conftest import hasty

SOON = 30.0


def test_it_says_who_it_is_and_what_inputs_it_has(open_pjlink: Any) -> None:
    driver = open_pjlink().driver
    who = driver.identity(deadline=in_seconds(SOON))
    assert (who.maker, who.serial, who.firmware) == ("Velatura", "VE-0001", "1.0")
    assert driver.capabilities.inputs == ("11", "12", "31", "32")


def test_the_password_is_asked_and_checked(open_pjlink: Any) -> None:
    pair = open_pjlink(password="secret", settings={"password": "secret"})
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.OFF


@pytest.mark.parametrize("settings", [{}, {"password": "wrong"}])
def test_a_wrong_or_missing_password_is_refused_with_where_to_set_it(
    open_pjlink: Any, settings: dict[str, str]
) -> None:
    with pytest.raises(DeviceRefused) as caught:
        open_pjlink(password="secret", settings=settings)
    assert caught.value.code == "projector-password"
    assert "stage.toml" in caught.value.remedy
    assert "secret" not in str(caught.value)


def test_a_lost_answer_is_asked_again_once(open_pjlink: Any) -> None:
    pair = open_pjlink(edit=hasty)
    pair.emulator.faults.set(drop=1)
    assert pair.driver.status(deadline=in_seconds(SOON)).lamp_hours == 1200


def test_a_silent_projector_is_a_timeout_well_before_the_deadline(open_pjlink: Any) -> None:
    pair = open_pjlink(edit=hasty)
    pair.emulator.faults.set(silent=True)
    started = time.monotonic()
    with pytest.raises(DeviceTimeout) as caught:
        pair.driver.status(deadline=in_seconds(20))
    assert caught.value.code == "projector-no-answer"
    assert time.monotonic() - started < 15


@pytest.mark.parametrize(("interval", "wedged"), [("boot_interval_s = 0.4", False), ("boot_interval_s = 0.005", True)])
def test_a_booting_projector_is_asked_only_as_often_as_its_profile_says(
    open_pjlink: Any, tmp_path: Path, interval: str, wedged: bool
) -> None:
    timing, patience_s = LampTiming(20.0 if wedged else 1.0, 20.0), 2.0 if wedged else 30.0
    text = quick_profile(timing, base="pjlink").replace("boot_interval_s = 0.05", interval)
    (tmp_path / "paced.toml").write_text(text)
    pair = open_pjlink(settings={"profile": "paced.toml"}, lamp=EmulatedLamp(timing), wedges_below_s=0.02)
    with contextlib.suppress(DeviceTimeout):  # a wedged projector answers nothing any more
        pair.driver.switch_on(deadline=in_seconds(patience_s))
        for _ in range(3):
            pair.driver.status(deadline=in_seconds(patience_s))
    assert pair.emulator.wedged is wedged


def test_garbage_is_a_protocol_error(open_pjlink: Any) -> None:
    pair = open_pjlink()
    pair.emulator.faults.set(garbage=True)
    with pytest.raises(ProtocolError):
        pair.driver.status(deadline=in_seconds(SOON))


def test_a_starting_projector_that_answers_err3_is_busy(open_pjlink: Any) -> None:
    pair = open_pjlink()
    pair.emulator.faults.set(busy=True)
    with pytest.raises(DeviceBusy, match="ERR3"):
        pair.driver.status(deadline=in_seconds(SOON))


def test_on_while_cooling_is_refused_and_strikes_nothing(open_pjlink: Any) -> None:
    pair = open_pjlink()
    pair.driver.switch_on(deadline=in_seconds(SOON))
    pair.driver.switch_off(deadline=in_seconds(SOON))
    with pytest.raises(DeviceRefused) as caught:
        pair.driver.switch_on(deadline=in_seconds(SOON))
    assert caught.value.code == "projector-cooling"
    assert pair.emulator.lamp.strikes == 1


def test_trouble_is_told_in_words(open_pjlink: Any) -> None:
    pair = open_pjlink()
    pair.emulator.lamp.fail()
    with pytest.raises(DeviceRefused, match="ERR4"):
        pair.driver.switch_on(deadline=in_seconds(SOON))
    status = pair.driver.status(deadline=in_seconds(SOON))
    assert (status.power, status.faults) == (Power.FAULT, ("lamp-failed",))


def test_a_projector_that_left_the_network_is_gone_and_found_again(open_pjlink: Any) -> None:
    pair = open_pjlink()
    address = pair.emulator.address
    pair.emulator.stop()
    with pytest.raises(DeviceGone, match=address):
        pair.driver.status(deadline=in_seconds(SOON))


def test_a_projector_that_takes_one_program_at_a_time_is_told_as_that(tmp_path: Path) -> None:
    def hang_up() -> None:
        with contextlib.suppress(OSError):
            while True:
                other.accept()[0].close()

    with socket.create_server(("127.0.0.1", 0)) as other:
        threading.Thread(target=hang_up, daemon=True).start()
        table = {"address": f"127.0.0.1:{other.getsockname()[1]}"}
        with pytest.raises(DeviceGone) as caught:
            open_pjlink_projector(table, OpenContext(tmp_path), in_seconds(SOON))
        assert "Another program may be connected" in caught.value.remedy


def test_one_connection_serves_all_calls_and_a_restarted_projector_gets_another(open_pjlink: Any) -> None:
    pair = open_pjlink(password="secret", settings={"password": "secret"})
    for _ in range(3):
        pair.driver.status(deadline=in_seconds(SOON))
    pair.driver.switch_on(deadline=in_seconds(SOON))
    assert pair.emulator.connections == 1
    assert pair.emulator.heard.count(b"%1LAMP ?") <= 2, "counters are not asked each time"


def test_the_projector_may_close_idle_connections(open_pjlink: Any) -> None:
    pair = open_pjlink(idle_s=0.1)
    time.sleep(0.3)
    assert pair.driver.status(deadline=in_seconds(SOON)).power is Power.OFF


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"address": "projector:none"}, "address-wrong"),
        ({"address": 4352}, "setting-wrong"),
        ({"password": "x" * 33}, "setting-wrong"),
        ({"profile": "none"}, "profile-missing"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings: dict[str, Any], code: str, tmp_path: Path) -> None:
    with pytest.raises((PluginError, DeviceError)) as caught:
        open_pjlink_projector({"address": "127.0.0.1:1", **settings}, OpenContext(tmp_path), in_seconds(SOON))
    assert caught.value.code == code
