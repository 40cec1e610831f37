"""A backup every night, to each place that stage.toml names; it counts only once it was read back.

The places are a folder, a USB stick that is found by its label or UUID, and a server that speaks SFTP: the system's
`sftp` does that work, so that its keys and ciphers are those that Debian cares for.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final, Protocol
from urllib.parse import unquote, urlsplit

from controller.config.models import BackupTable
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.storage import sha256_of, sync_folder
from controller.core.text import printable
from controller.kiosk.schedule import zone_of
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import EventLog
from hal.notices import Level, Notice

LONGEST_S: Final = 6 * 3600.0
QUIET_S: Final = 15
"""A server that says nothing for four times this is given up."""
_CAUSES: Final = (
    (re.compile(r"host key verification failed|no matching host key|identification has changed", re.IGNORECASE),
     "backup-host-key", "is not the one whose key stage.toml has",
     "If it has a new key, write that as ssh_host_key under [backup]. Otherwise somebody may be in between."),
    (re.compile(r"permission denied \(|too many authentication|bad permissions|invalid format", re.IGNORECASE),
     "backup-login-refused", "refuses the log-in",
     "Check the user in ssh, and that the server knows the public key of ssh_key_file. Other users "
     "must not be able to read that file."),
    (re.compile(r"connection (refused|timed out|closed|reset)|could not resolve|no route|unreachable|lost connection"
                r"|closed by remote host|broken pipe|not responding|timed out", re.IGNORECASE),
     "backup-unreachable", "can't be reached, or the connection was lost",
     "Check the network, and that the server is on. It is tried again."),
    (re.compile(r"no such file|not found", re.IGNORECASE),
     "backup-folder-missing", "does not have the folder for backups", "Make it, or correct ssh under [backup]."),
)  # fmt: skip


class Server:
    """``address``: ssh://USER@HOST[:PORT]/FOLDER; ``key_file``: a private key without a passphrase; ``host_key``: the
    server's public key, as its file in /etc/ssh has it. Without both it stores nothing, and says so.
    """

    name = "ssh"

    def __init__(
        self, address: str, key_file: Path | None, host_key: str | None, *, longest_s: float = LONGEST_S
    ) -> None:
        parts = urlsplit(address)
        self._user, self._host, self._port = parts.username or "", parts.hostname or "", parts.port or 22
        self._folder = unquote(parts.path).rstrip("/") or "/"
        self._key_file, self._host_key, self._longest_s = key_file, host_key, longest_s

    def store(self, source: Path, day: str, keep: int) -> Notice:
        """As ``Place.store``. Raises WorkError with one of the codes of ``_CAUSES``, or "backup-server-failed"."""
        if self._key_file is None or self._host_key is None:
            raise UsageError("backup-ssh-incomplete", what="The backup by SSH needs a key and the key of the server.",
                             remedy="Add ssh_key_file and ssh_host_key under [backup].")  # fmt: skip
        if not self._key_file.is_file():
            remedy = "Make it as the user velatura: ssh-keygen -t ed25519 -N '' -f FILE"
            what = f"The key {self._key_file.name} for the backup does not exist."
            raise UsageError("backup-key-missing", what=what, remedy=remedy)
        name = NAME.format(day)
        part = f".{name}.part"
        with tempfile.TemporaryDirectory(prefix=".back-", dir=source.parent) as folder:
            back = Path(folder) / name
            self._sftp(
                f'put "{source}" "{self._at(part)}"',
                f'-chmod 600 "{self._at(part)}"',
                f'get "{self._at(part)}" "{back}"',
            )
            if sha256_of(back) != sha256_of(source):
                raise WorkError("backup-differs", what=DIFFERS, remedy="Check the disk of the server.")
            archive.check_backup(back, source.parent)
        # What it says about the folder ends the command, so that nothing is renamed in a wrong one.
        listed = self._sftp(f'rename "{self._at(part)}" "{self._at(name)}"', f'ls -1 "{self._folder}"')
        ours = {word for line in listed if OURS.fullmatch(word := line.strip().rpartition("/")[2])}
        if old := _oldest(ours, name, keep):
            self._sftp(*(f'rm "{self._at(one)}"' for one in old))
        size_mb = source.stat().st_size / 1e6
        return Notice("backup-made", f"The backup {name} ({size_mb:.0f} MB) was sent to {self._host} and read back.")

    def _at(self, name: str) -> str:
        return f"{self._folder.rstrip('/')}/{name}"

    def _sftp(self, *commands: str) -> Sequence[str]:
        """Run these in one connection, up to the first that fails; returns the lines that it printed."""
        with tempfile.TemporaryDirectory() as folder:
            key = '"{}"'.format(str(self._key_file).replace("%", "%%"))
            known = Path(folder) / "known_hosts"
            # In this form for every port, because the alias stands for host and port.
            known.write_text(f"velatura-backup {self._host_key}\n")
            options = {
                "BatchMode": "yes", "StrictHostKeyChecking": "yes", "UserKnownHostsFile": str(known),
                "GlobalKnownHostsFile": "/dev/null", "HostKeyAlias": "velatura-backup", "IdentitiesOnly": "yes",
                "IdentityFile": key, "IdentityAgent": "none", "ConnectTimeout": str(QUIET_S),
                "ServerAliveInterval": str(QUIET_S), "ServerAliveCountMax": "4", "UpdateHostKeys": "no",
                "LogLevel": "ERROR",
            }  # fmt: skip
            words = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
            host = f"[{self._host}]" if ":" in self._host else self._host
            try:
                done = subprocess.run(  # noqa: S603 - words of ours, and of a checked table
                    ["sftp", "-F", "/dev/null", *words, "-P", str(self._port), "-b", "-", f"{self._user}@{host}"],  # noqa: S607
                    input="\n".join(commands) + "\n", capture_output=True, text=True, errors="replace", check=False,
                    timeout=self._longest_s,
                )  # fmt: skip
            except FileNotFoundError as error:
                raise WorkError("backup-no-sftp", what="This computer has no `sftp`.",
                                remedy="Install it: apt install openssh-client") from error  # fmt: skip
            except subprocess.TimeoutExpired as error:
                raise self._failed("the connection timed out") from error
        if done.returncode:
            # Its own `ssh` may end first, and then it ends by this signal and says nothing.
            lost = "broken pipe" if done.returncode == -signal.SIGPIPE else ""
            raise self._failed(f"{done.stderr}\n{lost}")
        return [line for line in done.stdout.splitlines() if not line.startswith("sftp> ")]

    def _failed(self, said: str) -> WorkError:
        for pattern, code, what, remedy in _CAUSES:
            if pattern.search(said):
                return WorkError(code, what=f"The server {self._host} for backups {what}.", remedy=remedy)
        last = printable((said.strip().splitlines() or ["no reason"])[-1])[:200]
        return WorkError(
            "backup-server-failed",
            what=f"The server {self._host} for backups did not take the backup: {last}",
            remedy="Check the free space there, and that the user may write to the folder.",
        )


NAME: Final = "velatura-{}.tar.gz"
OURS: Final = re.compile(r"velatura-[0-9]{8}\.tar\.gz")
DIFFERS: Final = "The backup reads back differently from what was written."
_STICK: Final = "Plug the stick in, and check [backup] in stage.toml. It has to be mounted: `findmnt` lists what is."
_BY: Final = ("dev/disk/by-label", "dev/disk/by-uuid")


class Place(Protocol):
    """Where backups go. ``name`` tells it from the others, and is stable."""

    @property
    def name(self) -> str: ...

    def store(self, source: Path, day: str, keep: int) -> Notice:
        """Store the backup ``source`` of a day (20260504), read it back, and remove all of ours but the newest
        ``keep``; returns what to tell. Raises WorkError, UsageError("not-a-backup") and OSError; nothing that was there
        is lost then.
        """


def _oldest(names: Iterable[str], newest: str, keep: int) -> Sequence[str]:
    """All but the newest ``keep``. Those of days after ``newest`` count as oldest: the clock was ahead then."""
    return sorted(names, key=lambda name: (name <= newest, name))[:-keep]


class Folder:
    """A folder. A missing one is never made: it is the mount point of a disk that is not there."""

    name = "folder"

    def __init__(self, folder: Path, stage: Path) -> None:
        self._folder, self._stage = folder, stage

    def store(self, source: Path, day: str, keep: int) -> Notice:
        """As ``Place.store``."""
        folder = self._folder
        if not folder.is_dir():
            raise WorkError("backup-folder-missing", what=f"The folder for backups, {folder}, does not exist.",
                            remedy="Plug the disk in, mount it, or correct [backup] in stage.toml.")  # fmt: skip
        copy = copied(source, folder / NAME.format(day))
        ours = {path.name for path in folder.iterdir() if OURS.fullmatch(path.name)}
        for old in _oldest(ours, copy.name, keep):
            (folder / old).unlink()
        text = f"The backup {copy.name} ({copy.stat().st_size / 1e6:.0f} MB) was made and read back."
        if folder.stat().st_dev == self._stage.stat().st_dev:
            remedy = "It is on the same disk as the stage. Choose a folder on another disk."
            return Notice("backup-same-disk", text, remedy, Level.WARNING)
        return Notice("backup-made", text)


class Stick:
    """A USB stick by the label or UUID of its file system, wherever it is mounted. ``root``: below it lie /dev and
    /proc (for tests).
    """

    name = "usb"

    def __init__(self, label: str, stage: Path, root: Path = Path("/")) -> None:
        self._label, self._stage, self._root = label, stage, root

    def store(self, source: Path, day: str, keep: int) -> Notice:
        """As ``Place.store``. Raises WorkError("backup-stick-missing") as well."""
        stored = Folder(self._mounted(), self._stage).store(source, day, keep)
        return Notice(stored.code, f"{stored.what} It is on the USB stick {self._label}.", stored.remedy, stored.level)

    def _mounted(self) -> Path:
        device = next((link.resolve() for link in self._links() if _unescaped(link.name) == self._label), None)
        if device is None:
            raise WorkError(
                "backup-stick-missing", what=f"The USB stick {self._label} is not plugged in.", remedy=_STICK
            )
        for line in (self._root / "proc/self/mountinfo").read_text().splitlines():
            before, _, after = line.partition(" - ")
            words, source = before.split(), after.split()[1:2]
            if len(words) > 4 and source and self._root / source[0].lstrip("/") == device:
                return Path(_octal(words[4]))
        raise WorkError(
            "backup-stick-not-mounted", what=f"The USB stick {self._label} is plugged in, but not mounted.",
            remedy=_STICK,
        )  # fmt: skip

    def _links(self) -> list[Path]:
        return [link for folder in _BY for link in sorted((self._root / folder).glob("*"))]


def _unescaped(name: str) -> str:
    r"""A label as udev writes it into a file's name, with \x20 for a space."""
    data = re.sub(rb"\\x([0-9a-f]{2})", lambda found: bytes([int(found[1], 16)]), os.fsencode(name))
    return data.decode("utf-8", "replace")


def _octal(path: str) -> str:
    r"""A path as the kernel writes it into mountinfo, with \040 for a space."""
    return os.fsdecode(re.sub(rb"\\([0-7]{3})", lambda found: bytes([int(found[1], 8)]), os.fsencode(path)))


def copied(source: Path, target: Path) -> Path:
    """Copy a backup, read the copy back from its disk, and only then give it its name.

    Raises UsageError("not-a-backup"), WorkError("backup-differs"), OSError; no ``target`` is left or changed then.
    """
    part = target.with_name(f".{target.name}.part")
    try:
        with source.open("rb") as content, part.open("wb") as file:
            # A disk for Windows has no modes, and refuses them.
            with contextlib.suppress(PermissionError):
                part.chmod(0o600)
            shutil.copyfileobj(content, file, 1 << 20)
            file.flush()
            os.fsync(file.fileno())
            # Otherwise the memory would be read back, and not the disk.
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        if sha256_of(part) != sha256_of(source):
            raise WorkError("backup-differs", what=DIFFERS, remedy="Replace the disk for backups.")
        archive.check_backup(part, source.parent)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(target.parent)
    return target


WINDOW_MIN: Final = 12 * 60
"""So late a backup may be made: a computer that is off at night makes it in the morning."""
AGAIN_S: Final = 1800.0


def places(stage: Path, table: BackupTable) -> tuple[Place, ...]:
    """Where the backups of this stage go."""
    found: list[Place] = []
    if table.folder is not None:
        found.append(Folder(stage / table.folder, stage))
    if table.usb is not None:
        found.append(Stick(table.usb, stage))
    if table.ssh is not None:
        key_file = None if table.ssh_key_file is None else stage / table.ssh_key_file
        found.append(Server(table.ssh, key_file, table.ssh_host_key))
    return tuple(found)


class NightlyBackup:
    """``table`` and ``zone``: the settings and the schedule's time zone now; ``busy``: whether a job runs;
    ``places``: as the function.

    One thread calls ``step`` about twice a minute.
    """

    def __init__(
        self, stage: Path, table: Callable[[], BackupTable], zone: Callable[[], str], log: EventLog, *,
        busy: Callable[[], bool], wall: Callable[[], float] = time.time,
        places: Callable[[Path, BackupTable], Sequence[Place]] = places,
    ) -> None:  # fmt: skip
        self._stage, self._table, self._zone, self._log = stage, table, zone, log
        self._busy, self._wall, self._places = busy, wall, places
        self._again_at_s: dict[str, float] = {}
        self._failed_keys: set[str] = set()

    def step(self) -> None:
        """Make the backup of this day where it is due. One place that fails holds up no other."""
        table, now_s = self._table(), self._wall()
        now = datetime.fromtimestamp(now_s, zone_of(self._zone()))
        late_min = now.hour * 60 + now.minute - int(table.at[:2]) % 24 * 60 - int(table.at[3:])
        if not 0 <= late_min < WINDOW_MIN or self._busy():
            return
        done, day = self._log.done(), now.date().isoformat()
        due = {_key(place, day): place for place in self._places(self._stage, table)}
        due = {key: one for key, one in due.items() if key not in done and not self._pauses(one, now_s)}
        if not due:
            return
        lacks = archive.missing(self._stage)
        if lacks and day not in self._failed_keys:
            self._failed_keys.add(day)
            self._log.add(Notice("backup-incomplete", f"The backup can't hold everything. {lacks[0]}",
                                 "Put the file there, or correct the settings.", Level.WARNING))  # fmt: skip
        try:
            source = archive.backup(self._stage)
        except (VelaturaError, OSError) as error:
            for key, place in due.items():
                self._fail(key, place, error)
            return
        try:
            for key, place in due.items():
                try:
                    stored = place.store(source, f"{now:%Y%m%d}", table.keep)
                except (VelaturaError, OSError) as error:
                    self._fail(key, place, error)
                    continue
                self._log.mark_done(key, "made")
                self._log.add(stored)
        finally:
            source.unlink()

    def _pauses(self, place: Place, now_s: float) -> bool:
        """Whether a failure there was a short time ago; not if the clock was set back since."""
        return 0.0 < self._again_at_s.get(place.name, 0.0) - now_s <= AGAIN_S

    def now(self) -> None:
        """Make a backup wherever stage.toml says, whatever the time. Minutes.

        Raises UsageError("backup-nowhere"), and what the first place raises that fails.
        """
        table = self._table()
        found = self._places(self._stage, table)
        if not found:
            raise UsageError("backup-nowhere", what="stage.toml names no place for backups.",
                             remedy="Add folder, usb or ssh under [backup].")  # fmt: skip
        day = f"{datetime.fromtimestamp(self._wall(), zone_of(self._zone())):%Y%m%d}"
        source = archive.backup(self._stage)
        try:
            for place in found:
                try:
                    self._log.add(place.store(source, day, table.keep))
                except OSError as error:
                    raise _explained(error) from error
        finally:
            source.unlink()

    def _fail(self, key: str, place: Place, error: VelaturaError | OSError) -> None:
        self._again_at_s[place.name] = self._wall() + AGAIN_S
        if key not in self._failed_keys:
            # Once a day for each place: it is tried again many times.
            self._failed_keys.add(key)
            said = _explained(error) if isinstance(error, OSError) else error
            self._log.add_failure(Notice("backup-failed", f"No backup was made. {said.what}", said.remedy, Level.ERROR))


def _key(place: Place, day: str) -> str:
    return f"backup {day}" if place.name == Folder.name else f"backup {place.name} {day}"


def _explained(error: OSError) -> VelaturaError:
    return UsageError("backup-disk", what=f"The disk for backups can't be written to: {error.strerror}.",
                      remedy="Check the disk for backups and its free space.")  # fmt: skip
