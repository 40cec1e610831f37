"""Computers of a display, as processes of this one: a conductor, and an agent with a player for each of the others.

``python -m tests.controller.stage.hosts.computers agent KEYS FOLDER [SKEW_S]`` is an agent whose wall clock is the
file FOLDER/clock ahead of this computer's, and which believes chrony where FOLDER/chrony exists.
"""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from controller.play.control.launch import end_serving
from controller.stage.hosts.agent import Agent
from controller.stage.hosts.clock import HostClock, Tracking
from controller.stage.hosts.remote import key
from controller.stage.hosts.screen import Screen
from controller.stage.link.joining import Joining, admit
from controller.stage.link.membership import Authority, membership
from controller.stage.link.session import member_link
from controller.stage.rig.elsewhere import DevicesHere
from tests.controller.play.wire import Wire


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def agent(keys: Path, folder: Path) -> None:
    """Until SIGTERM."""
    belongs = membership(keys)
    assert belongs is not None

    def wall() -> float:
        try:
            return time.time() + float((folder / "clock").read_text() or 0)
        except FileNotFoundError:
            return time.time()

    def track() -> Tracking:
        return Tracking((folder / "chrony").exists(), 0.001)

    clock = HostClock(wall, time.monotonic, track)
    with member_link(belongs) as link:
        one = Agent(link, belongs.name, folder / "bundles", clock, lambda name: Screen(folder / "screen", clock))
        one.devices = DevicesHere(folder, link, key(belongs.name, "device"))
        ended = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: ended.set())
        one.run(ended)


class Computers:
    """A conductor and the agents of ``names``, each with an output of its own name; "here" is on the conductor's."""

    def __init__(self, folder: Path, names: Sequence[str], bundle: Path | None, more: Sequence[str] = ()) -> None:
        self.folder, self.names, self.bundle, self.more = folder, list(names), bundle, list(more)
        self.port = free_port()
        self.authority = Authority(folder / "keys", "players")
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.address = "127.0.0.1"
        self.size = (40, 30)

    def join(self) -> None:
        for name in self.names:
            port = free_port()
            with Joining(self.folder / f"keys-{name}", name, host="127.0.0.1", port=port) as joining:
                admit(self.authority, f"127.0.0.1:{port}", joining.code, (f"tls/{self.address}:{self.port}",))
                joining.wait()

    @property
    def outputs(self) -> list[tuple[str, int, int]]:
        return [(name, *self.size) for name in ["here", *self.names]]

    def conduct(self) -> None:
        words = ["--outputs", ",".join(f"{name}:{width}x{height}" for name, width, height in self.outputs)]
        words += [word for name in self.names for word in ("--host", f"{name}={name}")]
        words += ["--frames", str(self.folder / "out.frame"), "--keys", str(self.folder / "keys")]
        words += ["--allow-unsigned", *([] if self.bundle is None else ["--bundle", str(self.bundle)]), *self.more]
        self._start("here", ["controller.play", "--socket", str(self.socket), "--port", str(self.port), *words])

    def follow(self, name: str) -> None:
        module = "tests.controller.stage.hosts.computers"
        self.place(name).mkdir(exist_ok=True)
        self._start(name, [module, "agent", str(self.folder / f"keys-{name}"), str(self.place(name))])

    def prefix(self, name: str) -> list[str]:
        """What a process of that computer is started with."""
        return []

    def _start(self, name: str, words: Sequence[str]) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [*self.prefix(name), sys.executable, "-m", *words], stdout=log, stderr=log
            )

    def place(self, name: str) -> Path:
        return self.folder / f"at-{name}"

    @property
    def socket(self) -> Path:
        return self.folder / "player.sock"

    def kill(self, name: str) -> None:
        self.processes[name].kill()
        self.processes[name].wait()

    def wire(self) -> Wire:
        return Wire(self.socket)

    def players(self) -> dict[str, Path]:
        """The sockets of the players."""
        there = {name: self.place(name) / "screen" / "player.sock" for name in self.names}
        return {"here": self.folder / "screen-0" / "player.sock", **there}

    def status(self) -> dict[str, Any]:
        with self.wire() as wire:
            return wire.ask("status")

    def end(self) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for path in self.players().values():
            end_serving(path)


@contextmanager
def running(computers: Computers) -> Iterator[Computers]:
    """All of them, until none is lost."""
    with ExitStack() as stack:
        computers.join()
        stack.callback(computers.end)
        computers.conduct()
        for name in computers.names:
            computers.follow(name)
        until_s = time.monotonic() + 40
        while not computers.socket.exists() or computers.status()["missing_outputs"]:
            assert time.monotonic() < until_s, "the computers do not find each other"
            time.sleep(0.1)
        yield computers


if __name__ == "__main__":
    agent(Path(sys.argv[2]), Path(sys.argv[3]))
