"""One player of this computer, as the conductor and the agents see it: started, asked, given pictures and the clock."""

from __future__ import annotations

import contextlib
import subprocess
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust, write_public_key
from controller.play.control.launch import SOCKET_NAME, PlayerProcess, PlayerSettings, end_leftover, hello
from controller.stage.hosts.clock import HostClock, printed
from hal.deadline import in_seconds
from hal.errors import CodedError
from hal.player import Inbox, PlayerClient
from hal.values import OutputInfo

ANSWER_S: Final = 2.0
MOST_MISSES: Final = 3
"""Questions in a row without an answer after which a player is started again."""
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
    """What a screen reports. ``reports``: presentations by the common clock, newest last; ``frame_lock``: as the
    function of this name says.
    """

    status: dict[str, Any] | None = None
    reports: tuple[tuple[float, float, str | None], ...] = ()
    frame_lock: bool = False


def frame_lock(display: str) -> bool:
    """Whether each graphics card of an X screen ("": the environment's) says that its refresh is locked to a common
    timing; False where there is no tool that tells. NVIDIA's is the only one.
    """
    where = [f"--ctrl-display={display}"] if display else []
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = printed(["nvidia-settings", *where, "--terse", "--query=FrameLockTiming"]).split()
        return bool(said) and set(said) == {"1"}
    return False


class Screen:
    """A player of this computer. ``display``: its X screen, "" for the environment's.

    It is what ``remote.Remote`` is for a player of another computer, which may be lost, and behind with a bundle.
    """

    host = progress = trouble = ""
    there, behind = True, False

    def __init__(self, folder: Path, clock: HostClock, *, display: str = "") -> None:
        self.folder, self._clock, self._display = folder, clock, display
        self.setup, self.state = Setup((), 60.0), State()
        self._player: PlayerProcess | None = None
        self._staged: dict[str, npt.NDArray[np.uint8]] = {}
        self._last: dict[str, Any] | None = None
        self._pid = self._reported = self._misses = 0
        self._locked = False

    @property
    def socket(self) -> Path:
        return self.folder / SOCKET_NAME

    def prepare(self, setup: Setup) -> None:
        """Have a player with this setup; one that has it already plays on. Raises WorkError("player-not-started")."""
        noted, text = self.folder / "setup", repr(sorted(asdict(setup).items())) + self._display
        self.setup = setup
        if noted.exists() and noted.read_text() == text:
            with contextlib.suppress(CodedError, OSError):
                self.ask({"op": "hello"})
                return
        self._start()
        noted.write_text(text)

    def _start(self) -> None:
        end_leftover(self.folder)
        if self._player is not None:
            self._player.terminate()
        self._player = PlayerProcess(self.folder, self._settings())
        self._player.wait_until_ready()

    def _settings(self) -> PlayerSettings:
        setup = self.setup
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        keys: dict[str, list[Path]] = {}
        for kind, hexed in (("trusted", setup.trusted), ("revoked", setup.revoked)):
            keys[kind] = [self.folder / f"{kind}-{number}.pub" for number in range(len(hexed))]
            for path, key in zip(keys[kind], hexed, strict=True):
                write_public_key(path, bytes.fromhex(key))
        return PlayerSettings(
            setup.outputs, self.folder / "out.frame" if setup.frames else None, where=setup.where, part=True,
            allow_unsigned=setup.allow_unsigned, rate_hz=setup.rate_hz, display=self._display,
            trusted=keys["trusted"], revoked=keys["revoked"],
        )  # fmt: skip

    def check(self, bundle: Path) -> None:
        """Raise BundleError unless the player will play this bundle."""
        Bundle.open_trusted(bundle, self.setup.trust()).close()

    def put(self, pictures: Pictures) -> None:
        """Make the pictures of the next ``show`` ready; one output after the other may come."""
        self._staged.update(pictures)

    def ask(self, request: Mapping[str, Any], *, within_s: float = ANSWER_S) -> dict[str, Any]:
        """The answer, with ``common_s``: when it was presented on the common clock. Raises CodedError."""
        request = dict(request)
        if request["op"] == "show":
            request["sequence"] = self._inbox_filled()
        elif "at" in request:
            self._last = request
        client = PlayerClient()
        try:
            answer = client.request(self.socket, request, in_seconds(within_s))
        finally:
            client.hang_up()
        if isinstance(at_s := answer.get("presented_at"), float):
            answer["common_s"] = at_s + self._clock.ahead_s
        return answer

    def _inbox_filled(self) -> int:
        path = Path(hello(self.socket, ANSWER_S)["inbox"])
        with contextlib.closing(Inbox(path, [OutputInfo(*output) for output in self.setup.outputs])) as inbox:
            staged, self._staged = self._staged, {}
            return inbox.put(staged)

    def step(self, keep_s: float) -> State:
        """Twice a second: keep the player running, give it the clock for ``keep_s``, and a new one what is due."""
        try:
            pid = int(self.ask({"op": "hello"})["pid"])
            if keep_s > 0 or pid != self._pid:
                clock = {"op": "clock", "ahead_s": self._clock.ahead_s, "then": self.setup.then}
                self.ask({**clock, "keep_s": max(0.001, keep_s)})
            if pid != self._pid:
                self._pid, self._reported, self._locked = pid, 0, frame_lock(self._display)
                if self._last is not None:
                    threading.Thread(target=self._again, args=(self._last,), daemon=True).start()
            rows = self.ask({"op": "reports", "after": self._reported})["reports"]
            self._reported = rows[-1][0] if rows else self._reported
            status = {key: value for key, value in self.ask({"op": "status"}).items() if key not in ("id", "ok")}
        except (CodedError, OSError):
            self._misses += 1
            if self._misses >= MOST_MISSES and self.setup.outputs:
                self._misses = 0
                with contextlib.suppress(CodedError, OSError):
                    self._start()
            return State()
        self._misses = 0
        return State(status, tuple((due, at, name) for _, due, at, name in rows), self._locked)

    def look(self) -> tuple[tuple[float, float, str | None], ...]:
        """A step, with the clock for as long as the setup says; new reports."""
        self.state = self.step(self.setup.keep_s)
        return self.state.reports

    def needs(self, request: Mapping[str, Any]) -> bool:
        """Whether it was not asked for this; one that an earlier conductor has left may play it all the same."""
        return self._last is None or self._last["at"] != request["at"]

    def bring(self, bundle: Path) -> None:
        """It is here."""

    def _again(self, request: dict[str, Any]) -> None:
        with contextlib.suppress(CodedError, OSError):
            self.ask(request)

    def end(self) -> None:
        """Black, and the player's end."""
        end_leftover(self.folder)
        if self._player is not None:
            self._player.terminate()
