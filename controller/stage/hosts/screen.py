"""One player of this computer, as the conductor and the agents see it: started, asked, given pictures and the clock."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust, write_public_key
from controller.core.errors import WorkError
from controller.play.control.launch import (
    SOCKET_NAME,
    AttachedPlayer,
    PlayerProcess,
    PlayerSettings,
    end_leftover,
    hello,
)
from controller.stage.hosts.clock import HostClock
from hal.codecs.player import accepted, parse_answer, request_line
from hal.deadline import in_seconds
from hal.errors import CodedError, DeviceGone, DeviceTimeout
from hal.player import Inbox, connected
from hal.values import OutputInfo

ANSWER_S: Final = 2.0
_SHOWS: Final = ("show", "play", "sequence", "stop")
Pictures = Mapping[str, npt.NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Setup:
    """What a player of several is started with; as ``PlayerSettings``, with keys in hex.

    ``frames``: it shows in memory; ``keep_s`` and ``then``: what it does without news of the conductor.
    """

    outputs: tuple[tuple[str, int, int], ...]
    rate_hz: float
    where: dict[str, str] = field(default_factory=dict)
    frames: bool = False
    trusted: tuple[str, ...] = ()
    revoked: tuple[str, ...] = ()
    allow_unsigned: bool = False
    keep_s: float = 3600.0
    then: str = "on"

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _, _ in self.outputs)

    def trust(self) -> Trust:
        trusted, revoked = (tuple(map(bytes.fromhex, keys)) for keys in (self.trusted, self.revoked))
        return Trust(trusted, self.allow_unsigned, revoked)


@dataclass(frozen=True, slots=True)
class State:
    """What a screen reports. ``reports``: presentations by the common clock, newest last."""

    status: dict[str, Any] | None = None
    reports: tuple[tuple[float, float, str | None], ...] = ()


class Screen:
    """A player of this computer. ``display``: its X screen, "" for the environment's."""

    host = progress = trouble = ""
    there, behind = True, False

    def __init__(self, folder: Path, clock: HostClock, *, display: str = "") -> None:
        self.folder, self._clock, self._display = folder, clock, display
        self.state = State()
        self.setup = Setup((), 60.0)
        self._player: PlayerProcess | AttachedPlayer | None = None
        self._staged: dict[str, npt.NDArray[np.uint8]] = {}
        self._order = threading.Lock()
        self._last: dict[str, Any] | None = None
        self._pid, self._reported = 0, 0
        self._start_at_s = 0.0

    @property
    def socket(self) -> Path:
        return self.folder / SOCKET_NAME

    def prepare(self, setup: Setup) -> None:
        """Have a player with this setup; one that has it already plays on. Raises WorkError("player-not-started")."""
        settings = self._settings(setup)
        noted = self.folder / "setup"
        text = repr(sorted(asdict(setup).items())) + self._display
        same = noted.exists() and noted.read_text() == text
        self.setup = setup
        if same and self._player is not None and self._player.alive:
            return
        left = _Left(self.socket)
        if same and left.alive:
            self._player = left
        else:
            end_leftover(self.folder)
            self._player = PlayerProcess(self.folder, settings)
            self._player.wait_until_ready()
        noted.write_text(text)

    def _settings(self, setup: Setup) -> PlayerSettings:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        keys = {kind: [self.folder / f"{kind}-{n}.pub" for n in range(len(getattr(setup, kind)))]
                for kind in ("trusted", "revoked")}  # fmt: skip
        for kind, paths in keys.items():
            for path, key in zip(paths, getattr(setup, kind), strict=True):
                write_public_key(path, bytes.fromhex(key))
        return PlayerSettings(
            setup.outputs, self.folder / "out.frame" if setup.frames else None, where=setup.where, part=True,
            trusted=keys["trusted"], revoked=keys["revoked"], allow_unsigned=setup.allow_unsigned,
            rate_hz=setup.rate_hz, display=self._display,
        )  # fmt: skip

    def check(self, bundle: Path) -> None:
        """Raise BundleError unless the player will play this bundle."""
        Bundle.open_trusted(bundle, self.setup.trust()).close()

    def put(self, pictures: Pictures) -> None:
        """Make the pictures of the next ``show`` ready; one output after the other may come."""
        self._staged.update(pictures)

    def ask(self, request: Mapping[str, Any], *, within_s: float = ANSWER_S) -> dict[str, Any]:
        """The answer, with ``common_s``: when it was presented on the common clock. Raises CodedError.

        Of what has a moment, nothing older is asked after something newer.
        """
        request = dict(request)
        with contextlib.ExitStack() as stack:
            with self._order:
                scheduled = "at" in request and request["op"] in _SHOWS
                if scheduled:
                    if self._last is not None and request["at"] < self._last["at"]:
                        raise WorkError("superseded", what="A later picture was agreed on.", remedy="Ask again.")
                    self._last = dict(request)
                channel = stack.enter_context(_opened(self.socket))
                if request["op"] == "show":
                    request["sequence"] = self._inbox_filled()
                deadline = in_seconds(within_s)
                channel.sendall(request_line(1, request))
            channel.settimeout(max(0.01, deadline.left_s()))
            try:
                line = stack.enter_context(channel.makefile("rb")).readline()
            except TimeoutError as error:
                raise DeviceTimeout(
                    "player-silent", what="The player did not answer in time.", remedy="It is asked again."
                ) from error
            answer = accepted(parse_answer(line)) if line else _gone()
        if isinstance(at_s := answer.get("presented_at"), float):
            answer["common_s"] = at_s + self._clock.ahead_s
        return answer

    def _inbox_filled(self) -> int:
        description = hello(self.socket, ANSWER_S)
        inbox = Inbox(Path(description["inbox"]), [OutputInfo(*output) for output in self.setup.outputs])
        staged, self._staged = self._staged, {}
        try:
            return inbox.put(staged)
        finally:
            inbox.close()

    def step(self, keep_s: float) -> State:
        """Twice a second: keep the player running, give it the clock for ``keep_s``, and a new one what is due."""
        if self._player is None or not self.setup.outputs:
            return State()
        try:
            if not self._player.alive:
                if time.monotonic() < self._start_at_s:
                    return State()
                self._start_at_s = time.monotonic() + 2
                self._player = None
                (self.folder / "setup").unlink(missing_ok=True)
                self.prepare(self.setup)
            clock = {"op": "clock", "ahead_s": self._clock.ahead_s, "then": self.setup.then}
            if keep_s > 0:
                self.ask({**clock, "keep_s": keep_s})
            pid = int(self.ask({"op": "hello"})["pid"])
            if pid != self._pid:
                if keep_s <= 0:
                    self.ask({**clock, "keep_s": 0.001})
                self._pid, self._reported = pid, 0
                if self._last is not None and self._last["op"] != "show":
                    threading.Thread(target=self._again, args=(self._last,), daemon=True).start()
            rows = self.ask({"op": "reports", "after": self._reported})["reports"]
            self._reported = rows[-1][0] if rows else self._reported
            status = {key: value for key, value in self.ask({"op": "status"}).items() if key not in ("id", "ok")}
            return State(status, tuple((due, at, name) for _, due, at, name in rows))
        except (CodedError, OSError, KeyError):
            return State()

    def look(self) -> tuple[tuple[float, float, str | None], ...]:
        """A step, with the clock for as long as the setup says; new reports."""
        self.state = self.step(self.setup.keep_s)
        return self.state.reports

    def needs(self, request: Mapping[str, Any]) -> bool:
        """Whether it was not asked for this; one that an earlier conductor has left may play it all the same."""
        return self._last is None or self._last["at"] < request["at"]

    def bring(self, bundle: Path) -> None:
        """It is here."""

    def _again(self, request: dict[str, Any]) -> None:
        with contextlib.suppress(CodedError, OSError):
            self.ask(request)

    def end(self) -> None:
        """Black, and the player's end."""
        if self._player is not None:
            with contextlib.suppress(CodedError, OSError):
                self.ask({"op": "stop"})
            end_leftover(self.folder)
            self._player.terminate()


class _Left(AttachedPlayer):
    """A player that a former conductor or agent has left."""

    def __init__(self, socket: Path) -> None:
        super().__init__(socket, socket.with_name("none"), None)
        with contextlib.suppress(WorkError):
            self.wait_until_ready(0.3)


def _opened(path: Path) -> Any:
    try:
        return connected(path, in_seconds(ANSWER_S))
    except OSError:
        return _gone()


def _gone() -> Any:
    raise DeviceGone("player-gone", what="The player of this screen does not run.", remedy="It is started again.")
