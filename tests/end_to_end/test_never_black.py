"""A kiosk that plays, and what it does, says and asks when something is damaged, full or changed by people."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.bundle.format import PlaylistEntry
from controller.bundle.install import CURRENT, install
from controller.bundle.signing import load_signing_key
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.config.loader import FILE
from controller.core.storage import runtime_folder
from controller.kiosk.api.control import call_kiosk
from controller.kiosk.schedule import WEEKDAYS
from controller.stage.sessions.calibrations import KEY_FILE, output_sizes
from controller.stage.sessions.check import check_stage
from tests.campaigns.mini_stage import prepare_mini
from tests.controller.kiosk.alerts.servers import MailServer, WebServer
from tests.controller.play.wire import Wire
from tests.end_to_end.kiosk import codes, wait_for
from tests.end_to_end.program import Command, lamps, processes_on, strikes
from tests.end_to_end.test_technician import devices

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
SHOWN_MS, FADE_MS = 1500, 500


def since_second_start(stage: Path) -> list[str]:
    """The events since then: that it plays may stand before or after its state."""
    found = codes(stage)
    starts = [number for number, code in enumerate(found) if code == "service-started"]
    return found[starts[1] :] if len(starts) == 2 else []


def install_bundle(stage: Path, revision: int, *names: str) -> Path:
    """A signed bundle of pictures that compress badly, so that damage meets them."""
    checked, random = check_stage(stage), np.random.default_rng(revision)
    outputs = list(output_sizes(checked).values())
    key = load_signing_key(stage / KEY_FILE)

    def frames() -> dict[str, Any]:
        return {name: random.integers(1, 255, (height, width, 3), np.uint8) for name, (width, height) in outputs}

    write_bundle(
        stage / "made.vel",
        NewBundle(
            stage="mini",
            calibration="none",
            created_unix_s=1_780_000_000 + revision,
            outputs=[(name, *size) for name, size in outputs],
            revision=revision,
            schedule=[PlaylistEntry(name, SHOWN_MS, FADE_MS) for name in names],
        ),
        appearances=[NewAppearance(name, frames()) for name in names],
        key=key,
    )
    return install(stage / "made.vel", stage / "bundles", trusted=[bytes(key.verify_key)])


def status(stage: Path) -> dict[str, Any]:
    return dict(call_kiosk(stage, "status"))


def until(stage: Path, so: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    found: list[dict[str, Any]] = []

    def look() -> bool:
        try:
            found.append(status(stage))
        except Exception:  # noqa: BLE001 - the service is being restarted
            return False
        return bool(so(found[-1]))

    wait_for(look)
    return found[-1]


def player_pid(stage: Path) -> int:
    with Wire(runtime_folder(stage) / "player.sock") as wire:
        return int(wire.ask("hello")["pid"])


def watched(stage: Path, seconds: float) -> list[dict[str, Any]]:
    """What the player says, again and again, with the time of each (``at_s``): under load they are uneven."""
    ends_s, seen = time.monotonic() + seconds, []
    with Wire(runtime_folder(stage) / "player.sock") as wire:
        while time.monotonic() < ends_s:
            seen.append({**wire.ask("status"), "at_s": time.monotonic()})
            time.sleep(0.02)
    return seen


def settled(stage: Path, appearance: str) -> bool:
    """Whether the player itself shows only this one: the kiosk says so as soon as it has asked for it."""
    with Wire(runtime_folder(stage) / "player.sock") as wire:
        now = wire.ask("status")
    return bool(now["appearance"] == appearance and not now["fading"])


def every_day(appearance: str) -> dict[str, Any]:
    """Hours without an end, in which this one is shown."""
    rows = [{"day": day, "opens": "00:00", "closes": "00:00", "appearance": appearance} for day in WEEKDAYS]
    return {"time_zone": "UTC", "rows": rows}


def playing(now: dict[str, Any]) -> bool:
    return now["state"] == "playing" and bool(now["playing"])


def test_appearances_in_turn_a_damaged_bundle_and_changed_settings(tmp_path: Path) -> None:
    stage = prepare_mini(tmp_path)
    install_bundle(stage, 1, "old-1", "old-2")
    newest = install_bundle(stage, 2, "new-1", "new-2", "new-3")
    with devices(stage), Command("kiosk", "serve", stage, "--no-panel") as kiosk:
        # The playlist, with its times and fades.
        assert until(stage, playing)["in_turn"] is True
        seen = watched(stage, 3.5 * SHOWN_MS / 1000)
        assert len({one["appearance"] for one in seen}) == 3
        share = np.average([one["fading"] for one in seen], weights=np.gradient([one["at_s"] for one in seen]))
        assert 0.1 < share < 0.7, "a third of the time one fades into the next"
        call_kiosk(stage, "play", name="new-2")
        until(stage, lambda now: now["playing"] == "new-2" and not now["in_turn"])
        wait_for(lambda: settled(stage, "new-2"))
        assert {one["appearance"] for one in watched(stage, 1.5 * SHOWN_MS / 1000)} == {"new-2"}
        call_kiosk(stage, "rotate")
        until(stage, lambda now: now["playing"] in ("new-1", "new-3"))
        # The schedule names one, and later all; without hours the stage is open, and says so.
        call_kiosk(stage, "set-schedule", **every_day("new-3"))
        until(stage, lambda now: now["playing"] == "new-3" and not now["in_turn"])
        call_kiosk(stage, "set-schedule", **every_day("*"))
        until(stage, lambda now: playing(now) and now["in_turn"])
        call_kiosk(stage, "set-schedule", time_zone="UTC", rows=[])
        now = until(stage, lambda now: playing(now) and now["next_event"] is None)
        assert "closed" not in now["reason"]

        # Settings: a comment restarts nothing, what a device is opened with restarts the devices, and no lamp.
        struck, pid, text = strikes(stage), player_pid(stage), call_kiosk(stage, "settings")
        assert call_kiosk(stage, "effect-of-settings", text=f"# a comment\n{text}") == ""
        call_kiosk(stage, "save-settings", text=f"# a comment\n{text}")
        assert call_kiosk(stage, "settings").startswith("# a comment")
        time.sleep(1.0)
        assert (strikes(stage), player_pid(stage), all(lamps(stage).values())) == (struck, pid, True)
        assert "service-ended" not in codes(stage)
        reopened = text.replace("iso = ", "iso = 1", 1)
        assert "The lamps stay lit" in call_kiosk(stage, "effect-of-settings", text=reopened)
        moved = text.replace('"left"', '"links"')
        assert "left" in call_kiosk(stage, "effect-of-settings", text=moved)
        assert "cools" in call_kiosk(stage, "effect-of-settings", text=moved)
        call_kiosk(stage, "save-settings", text=text.replace("\n[safety]\n", "\n[safety]\nminimum_off_s = 0.5\n"))
        wait_for(lambda: "playing" in since_second_start(stage))
        until(stage, playing)
        assert (strikes(stage), all(lamps(stage).values())) == (struck, True)
        assert any("User " in row["text"] for row in call_kiosk(stage, "events") if row["code"] == "done-by")

        # The newest bundle is damaged where only the pictures are, and its player dies soon after its start.
        data = bytearray(newest.read_bytes())
        data[4096 : len(data) * 9 // 10] = os.urandom(len(data) * 9 // 10 - 4096)
        newest.chmod(0o600)
        newest.write_bytes(data)
        os.kill(player_pid(stage), signal.SIGKILL)
        older = until(stage, lambda now: playing(now) and now["playing"].startswith("old"))
        assert any("the previous one" in warning for warning in older["warnings"]), older["warnings"]
        assert "bundle-older-plays" in codes(stage)
        assert (stage / "bundles" / CURRENT).resolve() != newest
        install_bundle(stage, 3, "third")
        until(stage, lambda now: now["playing"] == "third" and not now["warnings"])
        # A backup in the place of settings, calibration and appearances: no lamp is switched.
        call_kiosk(stage, "backup")
        (backup,) = (stage / "kiosk" / "archives").glob("backup-*")
        begun = codes(stage).count("service-started")
        call_kiosk(stage, "restore", backup=str(backup))
        wait_for(lambda: codes(stage).count("service-started") == begun + 1)
        until(stage, lambda now: now["playing"] == "third")
        assert (strikes(stage), all(lamps(stage).values())) == (struck, True)
        # As systemd ends it before it starts it again.
        kiosk.process.send_signal(signal.SIGUSR1)
        assert kiosk.outcome(timeout_s=180).code == 0
        assert (strikes(stage), all(lamps(stage).values())) == (struck, True)
    assert processes_on(stage) == []


def test_a_damaged_stage_toml_lamps_that_are_awaited_and_a_full_disk_are_said_as_what_they_are(tmp_path: Path) -> None:
    stage = prepare_mini(tmp_path)
    install_bundle(stage, 1, "one")
    good = (stage / FILE).read_text()
    with MailServer() as mail, WebServer() as web, devices(stage):
        alerts = (
            f'[alerts]\nmail_to = ["care@example.org"]\nmail_from = "kiosk@example.org"\nmail_host = "127.0.0.1"\n'
            f'mail_port = {mail.port}\nmail_security = "none"\nwebhook = "{web.address}"\n'
        )
        (stage / FILE).write_text(f"{good}\n{alerts}")
        with Command("kiosk", "serve", stage, "--no-panel", "--leave-lit") as kiosk:
            until(stage, playing)
            kiosk.interrupt()
        lines = (stage / FILE).read_text().count("\n")
        (stage / FILE).write_text((stage / FILE).read_text() + "[[projectors\n")
        with Command("kiosk", "serve", stage, "--no-panel") as kiosk:
            now = until(stage, playing)
            (warning,) = [one for one in now["warnings"] if "last good settings" in one]
            assert f"line {lines + 1}" in warning
            (stage / FILE).write_text(f"{good}\n{alerts}\n[disk]\nwarn_free_gb = 100000.0\n")
            now = until(stage, lambda now: not now["warnings"] and any(row["problem"] for row in now["devices"]))
            (disk,) = [row for row in now["devices"] if row["kind"] == "disk"]
            assert "are free on the disk" in disk["problem"]
            assert now["disk_free_bytes"] > 0
            call_kiosk(stage, "save-settings", text=f"{good}\n{alerts}")
            until(stage, lambda now: not any(row["problem"] for row in now["devices"]))

            # A job that waits for its lamps is shown, and can be cancelled.
            call_kiosk(stage, "stop")
            until(stage, lambda now: now["state"] == "off")
            call_kiosk(stage, "recalibrate", kind="full")
            now = until(stage, lambda now: now["job"] is not None and now["job"]["waits"])
            assert (now["job"]["name"], now["job"]["ended"]) == ("Full recalibration", False)
            call_kiosk(stage, "cancel")
            until(stage, lambda now: now["job"] is None)
            until(stage, lambda now: now["state"] == "off")

            # Nothing can be written: no lamp is switched on, and that is said once, of the disk.
            wait_for(lambda: all(not lit for lit in lamps(stage).values()))
            time.sleep(2.0)  # the lamps' minimum off time, on this bench
            before = call_kiosk(stage, "events")[-1]["number"]
            kiosk.limit_files_to(0)
            call_kiosk(stage, "start")
            now = until(stage, lambda now: now["state"] == "fault")
            assert now["reason"].count("disk") >= 1
            assert "lamp of" not in now["reason"]
            problems = {row["name"]: row["problem"] for row in now["devices"] if row["problem"]}
            wait_for(lambda: "disk-full" in codes(stage))
            assert set(problems) <= {"disk"}
            values = [value for row in now["devices"] for value in row["values"] if value["label"] == "Lamp"]
            assert "broken" not in {value["text"] for value in values}
            new = [row for row in call_kiosk(stage, "events") if row["number"] > before and row["level"] == "error"]
            assert sorted(row["code"] for row in new) == ["disk-full", "state"]
            assert not any(lamps(stage).values())
            wait_for(lambda: any("disk" in one for one in mail.bodies))
            wait_for(lambda: "disk-full" in {event["code"] for event in web.events})
            kiosk.limit_files_to(-1)
            call_kiosk(stage, "start")
            until(stage, playing)
            assert kiosk.interrupt().code == 0
    assert processes_on(stage) == []
