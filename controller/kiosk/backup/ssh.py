"""A place for backups on a server that speaks SFTP. The system's `sftp` does the work, so that its keys and ciphers are
those that Debian cares for.
"""

from __future__ import annotations

import re
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from controller.core.errors import UsageError, WorkError
from controller.core.storage import sha256_of
from controller.core.text import printable
from controller.kiosk.backup.places import DIFFERS, NAME, OURS
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import Decision

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

    def store(self, source: Path, day: str, keep: int) -> Decision:
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
            self._sftp(f'put "{source}" "{self._at(part)}"', f'get "{self._at(part)}" "{back}"')
            if sha256_of(back) != sha256_of(source):
                raise WorkError("backup-differs", what=DIFFERS, remedy="Check the disk of the server.")
            archive.check_backup(back)
        # What it says about the folder ends the command, so that nothing is renamed in a wrong one.
        listed = self._sftp(f'rename "{self._at(part)}" "{self._at(name)}"', f'ls -1 "{self._folder}"')
        ours = sorted({word for line in listed if OURS.fullmatch(word := line.strip().rpartition("/")[2])})
        if old := ours[:-keep]:
            self._sftp(*(f'rm "{self._at(one)}"' for one in old))
        size_mb = source.stat().st_size / 1e6
        return Decision("backup-made", f"The backup {name} ({size_mb:.0f} MB) was sent to {self._host} and read back.")

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
