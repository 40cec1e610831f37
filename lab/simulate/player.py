"""A simulated player: a process that starts, hangs and dies, and answers the requests of the player's protocol."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from controller.bundle.format import Index
from controller.bundle.install import CURRENT, MOST_FAILED_STARTS, CountedStart, Starts
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, Trust, load_public_key
from controller.core.errors import VelaturaError, WorkError
from controller.play.control import protocol
from controller.play.control.launch import PlayerSettings
from hal.codecs import player as player_codec
from hal.deadline import Deadline
from lab.simulate.disk import Disk
from lab.simulate.scheduler import Scheduler

TROUBLES: Final = ("slow", "doubles", "torn", "garbles", "loses", "reorders")
UNHEARD: Final = ("slow", "garbles", "loses")
"""Those of which some answers are none, or come too late."""
END_S: Final = 5.0


class Screen:
    """What the projectors show, and the process that makes it. ``trouble``: of its answers, or empty."""

    def __init__(self, scheduler: Scheduler, disk: Disk, rng: random.Random) -> None:
        self.scheduler, self.disk, self.rng = scheduler, disk, rng
        self.process: SimulatedPlayer | None = None
        self.trouble, self.hung = "", False
        self.late = False
        """Whether the computer is so busy with work that some answers come late."""
        self.no_server = False
        """Whether the X server is away."""
        self.unplugged: set[str] = set()
        """Outputs whose cable is out."""
        self.dies_at_start = self.dies_at_play = 0
        self.number = 0
        self.vain_starts: dict[str, int] = {}
        """Starts in a row with a bundle that were asked for a picture, or never got so far, and showed none."""
        self.violations: list[tuple[str, str]] = []
        """What it did against an invariant of the kiosk: its name, and how."""

    @property
    def appearance(self) -> str:
        """What is to be seen; empty: black."""
        process = self.process
        gone = self.no_server or process is None or not process.alive
        return "" if gone or process is None or process.showing != "appearance" else process.appearance

    @property
    def serves(self) -> bool:
        """Whether the player runs, and answers as it should."""
        process = self.process
        fails = self.hung or self.late or bool(self.trouble)
        return process is not None and process.alive and process.is_ready and not fails

    def apply_trouble(self) -> None:
        """Asked seldom, it would leave two questions in a row unanswered only once in hours."""
        self.scheduler.brisk = "player" if self.late or self.trouble in UNHEARD else ""

    def lose_server(self) -> None:
        """The X server ends, and its clients with it. One that hangs does not notice, but its window is gone, too."""
        self.no_server = True
        if self.process is not None:
            self.process.showing, self.process.appearance = "black", ""
            if not self.hung:
                self.process.kill()

    def why_dark(self, outputs: Sequence[tuple[str, int, int]]) -> str:
        """Why a player with these outputs can't start, or nothing: as ``play.display.window.WindowOutput``."""
        if self.no_server:
            return "The player found no display: no X server answers."
        if self.unplugged >= {name for name, _, _ in outputs}:
            return f"The X server has no output {outputs[0][0]}; it has none."
        return ""

    def launch(self, runtime: Path, settings: PlayerSettings) -> SimulatedPlayer:
        """Start one in the place of the one that runs."""
        before = self.process
        if before is not None and before.alive:
            self.scheduler.sleep(END_S if self.hung else 0.2)
            before.terminate()
        self.hung = False
        self.number += 1
        self.process = SimulatedPlayer(self, settings)
        return self.process

    def connect(self, path: Path, deadline: Deadline) -> Any:
        """As ``hal.player.connected``."""
        process = self.process
        if process is None or not process.alive or self.scheduler.now_s < process.ready_at_s:
            raise ConnectionRefusedError
        return Connection(self, process)


class SimulatedPlayer:
    """See ``kiosk.supervisors.player_supervisor.Process``."""

    def __init__(self, screen: Screen, settings: PlayerSettings) -> None:
        self._screen, self._settings = screen, settings
        self.alive = True
        self.showing, self.appearance, self.brightness = "black", "", 1.0
        self.running = False
        self.loaded: Index | None = None
        self.identity = ""
        self.ready_at_s = screen.scheduler.now_s + screen.rng.uniform(0.3, 1.5)
        self.pid = screen.number
        self._start: CountedStart | None = None
        self._bundle = ""
        self._is_ready = self._asked = self._counted = False
        # Its display first: a start without one says nothing about the bundle, and is not counted.
        self._failed = screen.why_dark(settings.outputs) or self._load_first()
        if screen.dies_at_start > 0:
            screen.dies_at_start -= 1
            self._failed = self._failed or "it crashed."

    @property
    def socket(self) -> Path:
        return Path("player.sock")

    @property
    def is_ready(self) -> bool:
        self._get_ready()
        return self._is_ready

    def wait_until_ready(self, timeout_s: float = 8.0) -> dict[str, Any]:
        screen = self._screen
        screen.scheduler.sleep(min(timeout_s, self.ready_at_s - screen.scheduler.now_s))
        self._get_ready()
        if not self._is_ready or not self.alive:
            self.kill()
            raise WorkError("player-not-started", what=f"The player did not start: {self._failed or 'it is silent.'}",
                            remedy="Correct the cause.")  # fmt: skip
        outputs = [{"name": name, "width_px": w, "height_px": h} for name, w, h in self._settings.outputs]
        return {"bundle": self.identity or None, "inbox": "player.inbox", "outputs": outputs}

    def kill(self) -> None:
        if self.alive:
            self._get_ready()
            if self._asked or not self._is_ready:
                self._blame(1)
        self.alive = False

    def terminate(self) -> int:
        if self.alive and self._start is not None and not self._screen.hung:
            with self._screen.disk.untouched():
                self._start.ended()
            self.alive = False
        self.kill()
        return 0

    def _get_ready(self) -> None:
        """It does so by itself, whether the one that started it still runs or not."""
        screen = self._screen
        if self._is_ready or self._failed or screen.hung or screen.scheduler.now_s < self.ready_at_s or not self.alive:
            return
        self._is_ready = True
        if self._start is not None:
            with screen.disk.untouched():
                self._start.ready()

    def _blame(self, vain: int) -> None:
        if self._bundle and not self._counted:
            self._screen.vain_starts[self._bundle] = vain and self._screen.vain_starts.get(self._bundle, 0) + 1

    # -- bundles

    @property
    def _trust(self) -> Trust:
        return Trust(tuple(load_public_key(path) for path in self._settings.trusted), False, ())

    def _load_first(self) -> str:
        link = self._settings.bundle
        if link is None:
            return ""
        try:
            with self._screen.disk.untouched():
                if link.name == CURRENT and link.is_symlink():
                    before, known = link.resolve(), Starts.read(link.parent).bundle
                    self._start = CountedStart(link.parent, lambda _: None)
                    self._bundle = self._start.file.resolve().name
                    self._given_up(before, now=known != self._bundle)
                    self.load(self._start.file)
                elif link.exists():
                    self.load(link)
        except VelaturaError as error:
            return error.what
        return ""

    def _given_up(self, before: Path, *, now: bool) -> None:
        """Whether that was right, as far as it was. ``now``: by this start, if at all."""
        if now and self._bundle != before.name and not self._opens(self._bundle, before.parent):
            self._screen.violations.append(("bundle back", f"{self._bundle} plays again, and can't be read"))
        vain = self._screen.vain_starts.get(before.name, 0) if self._bundle != before.name else MOST_FAILED_STARTS
        if vain < MOST_FAILED_STARTS and before.is_file():
            how = f"the bundle {before.name} was given up after {vain} starts without a picture"
            self._screen.violations.append(("bundle kept", how))

    def _opens(self, name: str, folder: Path) -> bool:
        """Whether this bundle can be read, whatever its signature, as far as the disk can be."""
        try:
            Bundle.open_trusted(folder / name, ANY_SIGNER).close()
        except VelaturaError:
            return self._screen.disk.blind
        return True

    def load(self, path: Path) -> None:
        """Use this bundle from now on. Raises VelaturaError."""
        with self._screen.disk.untouched(), Bundle.open_trusted(path, self._trust) as bundle:
            bundle.verify()
            self.loaded, self.identity = bundle.index, path.resolve().name
        self.running = False

    # -- requests

    def pattern(self) -> None:
        """Show the frames of a job."""
        self.showing, self.appearance, self.running = "pattern", "", False

    def do(self, request: protocol.Request) -> tuple[dict[str, Any], float]:  # noqa: PLR0911 - one for each request
        """Its answer, and the seconds until it comes. Raises VelaturaError."""
        match request:
            case protocol.Status():
                return self._status(), 0.0
            case protocol.Play(appearance, fade_s, brightness):
                self._begin_to_play()
                self._show(appearance, brightness, running=False)
                return {}, fade_s
            case protocol.Sequence(incidents, _, _, brightness, first_fade_s):
                self._begin_to_play()
                for incident in incidents:
                    self._known(incident[0])
                self._show(incidents[0][0], brightness, running=True)
                return {}, incidents[0][2] if first_fade_s is None else first_fade_s
            case protocol.Stop(fade_s):
                self.showing, self.appearance, self.running = "black", "", False
                return {}, fade_s
            case protocol.Identify():
                self.showing, self.appearance, self.running = "identification", "", False
                return {}, 0.0
            case protocol.LoadBundle(path):
                self.load(Path(path))
                return {"bundle": self.identity}, 0.0
            case _:
                return {}, 0.0

    def _begin_to_play(self) -> None:
        screen, self._asked = self._screen, True
        if self._start is not None:
            with screen.disk.untouched():
                self._start.asked()
        if screen.dies_at_play > 0:
            screen.dies_at_play -= 1
            self.kill()
            raise BrokenPipeError

    def _known(self, name: str) -> None:
        if self.loaded is None or name not in [entry.name for entry in self.loaded.appearances]:
            raise WorkError("bundle-no-appearance", what=f"There is no appearance {name}.", remedy="Choose another.")

    def _show(self, name: str, brightness: float, *, running: bool) -> None:
        self._known(name)
        self.showing, self.appearance, self.brightness, self.running = "appearance", name, brightness, running
        if self._start is not None and not self._counted:
            self._blame(0)
            self._counted = True
            with self._screen.disk.untouched():
                # It writes in a thread of its own, for which this waits.
                self._start.shown()
                self._start.ended()

    def _status(self) -> dict[str, Any]:
        return {
            "bundle": self.identity or None, "showing": self.showing, "appearance": self.appearance or None,
            "brightness": self.brightness, "sequence_running": self.running, "skipped": 0, "warning": None,
            "missing_outputs": [name for name, _, _ in self._settings.outputs if name in self._screen.unplugged],
        }  # fmt: skip


class Connection:
    """As far as ``PlayerClient`` uses a socket: lines of JSON, on which things go wrong."""

    def __init__(self, screen: Screen, process: SimulatedPlayer) -> None:
        self._screen, self._process = screen, process
        self._coming: list[tuple[float, bytes]] = []
        self._timeout_s = 1.0

    def settimeout(self, seconds: float) -> None:
        self._timeout_s = seconds

    def close(self) -> None:
        self._coming.clear()

    def sendall(self, data: bytes) -> None:
        screen, process = self._screen, self._process
        screen.scheduler.check()
        if not process.alive or process is not screen.process:
            raise BrokenPipeError
        if screen.hung:
            return
        ticket, request = protocol.parse_request(data.rstrip(b"\n"))
        delay_s = 0.0
        try:
            answer, delay_s = process.do(request)
            line = player_codec.answer_line(ticket, answer)
        except VelaturaError as error:
            line = player_codec.error_line(ticket, error)
        self._send(line, screen.scheduler.now_s + delay_s + screen.rng.uniform(0.001, 0.02))

    def _send(self, line: bytes, at_s: float) -> None:
        rng, trouble = self._screen.rng, self._screen.trouble or "slow" * self._screen.late
        troubled = trouble and rng.random() < 0.4
        pieces: list[tuple[float, bytes]] = [(at_s, line)]
        if troubled:
            half = len(line) // 2
            made: dict[str, Callable[[], list[tuple[float, bytes]]]] = {
                "slow": lambda: [(at_s + rng.uniform(0.3, 3.0), line)],
                "doubles": lambda: [(at_s, line), (at_s + rng.uniform(0.0, 1.0), line)],
                "torn": lambda: [(at_s, line[:half]), (at_s + rng.uniform(0.0, 1.0), line[half:])],
                "garbles": lambda: [(at_s, b"{" + line)],
                "loses": list,
                "reorders": lambda: [(at_s + 0.05, line), (at_s, json.dumps({"id": 0, "ok": True}).encode() + b"\n")],
            }
            pieces = made[trouble]()
        self._coming = sorted([*self._coming, *pieces], key=lambda piece: piece[0])

    def recv(self, _: int) -> bytes:
        scheduler, ends_s = self._screen.scheduler, self._screen.scheduler.now_s + self._timeout_s
        if self._coming and self._coming[0][0] <= ends_s:
            scheduler.sleep(self._coming[0][0] - scheduler.now_s)
        else:
            scheduler.sleep(ends_s - scheduler.now_s)
            raise TimeoutError
        if not self._process.alive:
            return b""
        return self._coming.pop(0)[1]
