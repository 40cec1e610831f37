"""A backup every night: made once, read back, restored on another folder; and what is said where that fails."""

from __future__ import annotations

import gzip
import zlib
from datetime import UTC, datetime
from pathlib import Path

import pytest

from controller.config.models import BackupTable
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.kiosk.backup import AGAIN_S, NightlyBackup, copied, places
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import EventLog
from hal.notices import Notice
from tests.controller.kiosk.vase import TEXT, vase

NIGHT_S = datetime(2026, 5, 4, 4, 31, tzinfo=UTC).timestamp()
DAY_S = 86_400.0


class Nights:
    """A stage, a folder for backups, and a clock that is set by hand."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        self.stage, self.to = vase(folder / "stage"), folder / "stick"
        self.table = BackupTable(folder=str(self.to), keep=keep)
        self.log = EventLog(self.stage / EventLog.FILE, durable=False)
        self.now_s, self.busy = NIGHT_S, False
        self.backup = NightlyBackup(
            self.stage, lambda: self.table, lambda: "UTC", self.log, busy=lambda: self.busy, wall=lambda: self.now_s
        )

    def at(self, seconds: float) -> list[str]:
        """What lies in the folder after a step at so many seconds after the first night."""
        self.now_s = NIGHT_S + seconds
        self.backup.step()
        return sorted(path.name for path in self.to.iterdir()) if self.to.exists() else []

    @property
    def codes(self) -> list[str]:
        return [row.code for row in self.log.after(0)]


def test_one_backup_a_night_the_oldest_go_and_another_machine_restores_it(tmp_path: Path) -> None:
    nights = Nights(tmp_path)
    nights.to.mkdir()
    (nights.to / "holiday.tar.gz").write_bytes(b"somebody else's")
    assert nights.at(-120) == ["holiday.tar.gz"], "not before its time"
    nights.busy = True
    assert nights.at(0) == ["holiday.tar.gz"], "not while a job writes what would be copied"
    nights.busy = False
    assert nights.at(60) == ["holiday.tar.gz", "velatura-20260504.tar.gz"]
    made = (nights.to / "velatura-20260504.tar.gz").stat().st_ino
    nights.at(600)
    assert (nights.to / "velatura-20260504.tar.gz").stat().st_ino == made
    assert nights.codes == ["backup-same-disk"], "a folder on the stage's own disk is a half of a backup, which is said"
    nights.at(DAY_S)
    assert nights.at(2 * DAY_S) == ["holiday.tar.gz", "velatura-20260505.tar.gz", "velatura-20260506.tar.gz"]
    assert not list((nights.stage / archive.FOLDER).iterdir()), "the kiosk's own disk does not fill"
    blank = tmp_path / "blank"
    blank.mkdir()
    archive.restore(blank, nights.to / "velatura-20260506.tar.gz")
    assert (blank / "stage.toml").read_text() == TEXT
    assert not (blank / "keys").exists()
    nights.log.close()


def test_a_file_that_the_settings_name_and_that_is_gone_is_told_once_a_night(tmp_path: Path) -> None:
    nights = Nights(tmp_path)
    nights.to.mkdir()
    (nights.stage / "appearances/glass.png").unlink()
    for seconds in (0, 60, 120):
        assert nights.at(seconds) == ["velatura-20260504.tar.gz"]
    assert nights.codes.count("backup-incomplete") == 1
    nights.at(DAY_S)
    assert nights.codes.count("backup-incomplete") == 2
    assert "appearances/glass.png" in next(row.text for row in nights.log.after(0) if row.code == "backup-incomplete")
    nights.log.close()


def test_a_missing_disk_is_a_failure_that_stays_in_sight_until_somebody_has_seen_it(
    tmp_path: Path,
) -> None:
    nights = Nights(tmp_path)
    nights.at(0)
    nights.at(60)
    (failure,) = nights.log.failures
    assert (failure.code, failure.level) == ("backup-failed", "error")
    assert "does not exist" in failure.text
    nights.to.mkdir()
    assert nights.at(120) == [], "not all the time"
    assert nights.at(60 + AGAIN_S) == ["velatura-20260504.tar.gz"]
    nights.log.close()


def test_backups_of_a_clock_that_was_years_ahead_go_first_and_its_pause_is_no_trap(tmp_path: Path) -> None:
    nights = Nights(tmp_path)
    nights.at(365 * DAY_S)  # there is no folder yet: it fails
    nights.to.mkdir()
    assert nights.at(365 * DAY_S + AGAIN_S) == ["velatura-20270504.tar.gz"]
    nights.at(366 * DAY_S)
    nights.to.rename(tmp_path / "away")
    nights.at(367 * DAY_S)
    (tmp_path / "away").rename(nights.to)
    assert nights.at(0) == ["velatura-20260504.tar.gz", "velatura-20270505.tar.gz"], "the clock was corrected"
    assert nights.at(DAY_S) == ["velatura-20260504.tar.gz", "velatura-20260505.tar.gz"]
    nights.table = BackupTable(folder=str(nights.to), keep=2, at="24:00")
    assert nights.at(2 * DAY_S - 4 * 3600) == ["velatura-20260505.tar.gz", "velatura-20260506.tar.gz"]
    nights.log.close()


class Elsewhere:
    """A place that works, or does not."""

    name = "ssh"

    def __init__(self) -> None:
        self.stored: list[str] = []
        self.works = False

    def store(self, source: Path, day: str, keep: int) -> Notice:
        if not self.works:
            raise WorkError("backup-unreachable", what="The server is off.", remedy="Switch it on.")
        self.stored.append(day)
        return Notice("backup-made", "It was sent.")


def test_a_place_that_fails_holds_up_no_other_and_is_tried_again(tmp_path: Path) -> None:
    nights, elsewhere = Nights(tmp_path), Elsewhere()
    nights.to.mkdir()
    nights.backup = NightlyBackup(
        nights.stage, lambda: nights.table, lambda: "UTC", nights.log, busy=lambda: False, wall=lambda: nights.now_s,
        places=lambda stage, table: (elsewhere, *places(stage, table)),
    )  # fmt: skip
    assert nights.at(0) == ["velatura-20260504.tar.gz"]
    nights.at(AGAIN_S + 1)
    assert nights.codes == ["backup-failed", "backup-same-disk"], "one message, however often it is tried"
    elsewhere.works = True
    nights.at(2 * AGAIN_S + 2)
    nights.at(3 * AGAIN_S)
    assert elsewhere.stored == ["20260504"]
    nights.at(DAY_S)
    assert elsewhere.stored == ["20260504", "20260505"]
    with pytest.raises(UsageError, match="names no place"):
        NightlyBackup(tmp_path, BackupTable, lambda: "UTC", nights.log, busy=lambda: False).now()
    nights.log.close()


def test_stage_toml_names_the_places(tmp_path: Path) -> None:
    key = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIExample"
    table = BackupTable(
        folder="there", usb="STICK", ssh="ssh://me@nas.local:2222/backups", ssh_key_file="keys/b", ssh_host_key=key
    )
    assert [place.name for place in places(tmp_path, table)] == ["folder", "usb", "ssh"]
    for wrong in ("nas.local:/backups", "ssh://nas.local/backups", 'ssh://me@nas/"', "ssh://me@-oProxyCommand/"):
        with pytest.raises(ValueError, match="ssh"):
            BackupTable(ssh=wrong)


@pytest.mark.parametrize("how", ["cut", "a wrong checksum", "no settings"])
def test_what_does_not_read_back_as_a_backup_gets_no_name(tmp_path: Path, how: str) -> None:
    stage = vase(tmp_path / "stage")
    if how == "no settings":
        (stage / "stage.toml").unlink()
    source = archive.backup(stage)
    data = bytearray(source.read_bytes())
    if how == "cut":
        del data[len(data) * 2 // 3 :]
    elif how == "a wrong checksum":
        data[-8] ^= 16
    source.write_bytes(data)
    target = tmp_path / "velatura-20260504.tar.gz"
    target.write_bytes(b"the one of before")
    with pytest.raises(VelaturaError):
        copied(source, target)
    assert target.read_bytes() == b"the one of before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stage", target.name]


def test_a_bit_that_flips_anywhere_is_noticed_before_anything_is_replaced(tmp_path: Path) -> None:
    stage = vase(tmp_path / "stage")
    sound = archive.backup(stage).read_bytes()
    settings, bad = (stage / "stage.toml").read_bytes(), tmp_path / "bad.tar.gz"
    start = 10 + sound[10:].index(b"\0") + 1  # Before it is the name in gzip's header, which no one reads.
    judged = 0
    for place in range(start, len(sound), 3):
        data = bytearray(sound)
        data[place] ^= 1 << place % 8
        if _content(bytes(data)) == _content(sound):
            continue  # Some bits mean nothing, as which of many zeros a zero is copied from.
        judged += 1
        bad.write_bytes(data)
        with pytest.raises(UsageError, match="damaged"):
            archive.check_backup(bad)
        with pytest.raises(UsageError, match="damaged"):
            archive.restore(stage, bad)
    assert judged > 150
    assert (stage / "stage.toml").read_bytes() == settings


def _content(data: bytes) -> bytes:
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        return b""


def test_a_sound_backup_passes_and_others_do_not(tmp_path: Path) -> None:
    archive.check_backup(archive.backup(vase(tmp_path / "stage")))
    (tmp_path / "b.tar.gz").write_bytes(b"nothing")
    with pytest.raises(UsageError, match="not a backup"):
        archive.check_backup(tmp_path / "b.tar.gz")
