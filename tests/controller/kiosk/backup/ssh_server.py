"""OpenSSH's own server on this machine, as an ordinary user, and a line to it that can be cut.

Needs Debian's package openssh-server (.ci/system-packages); a machine without it fails here.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

from tests.ports import free_port
from tests.waiting import wait_for


def make_key(path: Path) -> Path:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(path)], check=True)
    return path


class SshServer:
    """``folder``: what it serves; ``key_file``: who it lets in; ``host_key``: its own public key, two words."""

    def __init__(self, place: Path) -> None:
        place.mkdir()
        self.folder, self._place, self.port = place / "their backups", place, free_port()
        self.folder.mkdir()
        self.key_file = make_key(place / "ours")
        own = make_key(place / "host")
        self.host_key = " ".join(own.with_suffix(".pub").read_text().split()[:2])
        shutil.copy(self.key_file.with_suffix(".pub"), place / "let in")
        (place / "config").write_text(
            f"Port {self.port}\nListenAddress 127.0.0.1\nHostKey {own}\nPidFile none\nUsePAM no\nStrictModes no\n"
            f'AuthorizedKeysFile "{place / "let in"}"\nPasswordAuthentication no\nKbdInteractiveAuthentication no\n'
            "PermitRootLogin prohibit-password\nSubsystem sftp internal-sftp\n"
        )

    def address(self, port: int | None = None) -> str:
        folder = str(self.folder).replace(" ", "%20")
        return f"ssh://{getpass.getuser()}@127.0.0.1:{port or self.port}{folder}"

    def names(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())

    @contextlib.contextmanager
    def running(self, *, largest_file: int | None = None) -> Iterator[None]:
        """``largest_file``: bytes after which its disk takes no more of a file."""
        if os.geteuid() == 0:
            Path("/run/sshd").mkdir(exist_ok=True)
        program = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")
        assert program, "install openssh-server (.ci/system-packages)"
        command = [program, "-D", "-e", "-f", str(self._place / "config")]
        if largest_file is not None:
            command = ["prlimit", f"--fsize={largest_file}", *command]
        before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        with (self._place / "log").open("wb") as log:
            # A write that is refused must not end it, as a full disk would not.
            process = subprocess.Popen(command, stderr=log, restore_signals=False)
        signal.signal(signal.SIGXFSZ, before)
        try:
            wait_for(lambda: _answers(self.port))
            yield
        finally:
            process.terminate()
            process.wait()


def _answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1) as line:
        return line.recv(4) == b"SSH-"
    return False


class CutLine:
    """A line to ``port`` that is cut after so many bytes from the client."""

    def __init__(self, port: int, after: int) -> None:
        self._to, self._after = port, after
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._ends: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._serve)]

    def __enter__(self) -> CutLine:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        # A thread that waits on a socket is woken by its end, and not by its close.
        for one in (self._listener, *self._ends):
            _end(one)
        for thread in self._threads:
            thread.join()
        for one in (self._listener, *self._ends):
            one.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self._ends.append(client)
                server = socket.create_connection(("127.0.0.1", self._to))
                self._ends.append(server)
                for way in ((server, client, None), (client, server, self._after)):
                    thread = threading.Thread(target=self._pass, args=way)
                    self._threads.append(thread)
                    thread.start()

    def _pass(self, source: socket.socket, sink: socket.socket, left: int | None) -> None:
        with contextlib.suppress(OSError):
            while (data := source.recv(65_536)) and (left is None or left > 0):
                sink.sendall(data)
                left = None if left is None else left - len(data)
        for one in (source, sink):
            _end(one)


def _end(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
