"""``python -m controller.stage.hosts.conductor``: several players that serve as one, with the player's own protocol.

It gets the arguments of a player, and makes of each request one that all its players carry out at one moment of the
common clock. The players are on screens of this computer, or on others that run an agent.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from controller.bundle.reader import Bundle
from controller.bundle.signing import load_public_key
from controller.core.errors import BundleError, UsageError, VelaturaError, WorkError
from controller.core.storage import write_atomically
from controller.play.__main__ import parser
from controller.play.control import protocol
from controller.play.control.commands import SUFFIX, Client, Server
from controller.play.control.notify import Notifier, log
from controller.play.display.identification import identification
from controller.play.frames import FrameFile, FrameSet, OutputSize, parse_outputs, parse_where
from controller.play.playlist import Playlist
from controller.play.presenting import Intervals
from controller.stage.hosts.clock import HostClock
from controller.stage.hosts.remote import Remote
from controller.stage.hosts.screen import BEHIND, Pictures, Screen, Setup, State
from hal.codecs import player as codec
from hal.errors import CodedError

_STEP_S: Final = 0.25
LEAD_HERE_S: Final = 0.1
LEAD_S: Final = 1.0
"""From a request to its moment: long enough for a message that is lost and sent again."""
LEAD_SHOW_S: Final = 0.2
_ASKED_S: Final = 5.0
_LIVE: Final = "live-not-on-hosts"


_WAITED: Final = 8192
"""So many moments are remembered while some player has not reported them."""


class Skew:
    """Of ``count`` players: their presentations by the moment that was due, compared once all have reported it.

    ``mixed``: moments at which not all showed the same. A moment that a player never reports is none that counts.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._waiting: OrderedDict[int, dict[int, tuple[float, str | None]]] = OrderedDict()
        self._apart = Intervals()
        self.compared = self.mixed = self.unmatched = 0

    def add(self, number: int, reports: Sequence[tuple[float, float, str | None]]) -> None:
        """Reports of the player of this number: due, presented (seconds of the common clock) and what."""
        for due_s, at_s, appearance in reports:
            due = round(due_s * 1e5)
            told = self._waiting.setdefault(due, {})
            told[number] = at_s, appearance
            if len(told) == self._count:
                del self._waiting[due]
                moments = [moment for moment, _ in told.values()]
                self._apart.add(max(moments) - min(moments))
                self.compared += 1
                self.mixed += len({what for _, what in told.values()}) > 1
        while len(self._waiting) > _WAITED:
            self._waiting.popitem(last=False)
            self.unmatched += 1

    def figures(self) -> dict[str, Any]:
        """As a status has them."""
        return {
            "compared": self.compared,
            "mixed": self.mixed,
            "skew_p50_s": self._apart.percentile(50),
            "skew_p99_s": self._apart.percentile(99),
            "skew_most_s": self._apart.percentile(100),
        }


@dataclass(slots=True)
class Part:
    """One player: ``names`` of its outputs, and what it said last. ``host``: "" for this computer."""

    host: str
    player: Screen | Remote
    names: tuple[str, ...]
    state: State = field(default_factory=State)


class Conductor:
    """The players of a display as one. ``do`` carries out requests, one after the other, in threads of the caller."""

    def __init__(self, sizes: Sequence[OutputSize], parts: Sequence[Part], clock: HostClock, saved: Path) -> None:
        self.sizes, self._parts, self.clock, self._saved = tuple(sizes), tuple(parts), clock, saved
        self.skew = Skew(len(self._parts))
        self.bundle: Path | None = None
        self.identity: str | None = None
        self._request: dict[str, Any] | None = None
        self._sequence, self._presented_at = 0, 0.0
        self._pool = ThreadPoolExecutor(4 * len(self._parts) + 4, thread_name_prefix="part")
        self._agreeing = threading.Lock()
        self._remote = any(part.host for part in self._parts)
        with contextlib.suppress(OSError, ValueError, KeyError):
            saved_request = json.loads(saved.read_bytes())
            self.bundle = Path(saved_request["bundle"]) if "bundle" in saved_request else None
            self._request = saved_request

    # -- what may be asked for

    def load(self, path: Path, trust: Any) -> None:
        """Use this bundle from now on; it is brought to all computers. Raises BundleError."""
        with contextlib.closing(Bundle.open_trusted(path, trust)) as bundle:
            self.identity = bundle.identity
            self._playlist = bundle.index.schedule
        self.bundle = path.resolve()
        self._bring()

    def _bring(self) -> None:
        for part in self._parts:
            if isinstance(part.player, Remote) and self.bundle is not None:
                part.player.bring(self.bundle)

    def play(self, request: dict[str, Any]) -> dict[str, Any]:
        """``play`` or ``sequence`` at a moment, on all or on none of the players that are there.

        Raises BundleError("bundle-none"), WorkError("hosts-behind") while the bundle is on its way.
        """
        if self.bundle is None:
            raise BundleError("bundle-none", what="The players have no bundle to play.", remedy="Install one first.")
        behind = [
            part.player.progress for part in self._there() if isinstance(part.player, Remote) and part.player.behind
        ]
        if behind:
            raise WorkError(
                BEHIND, what=f"The bundle is on its way: {', '.join(behind)}.", remedy="Wait until it is there."
            )
        return self._agree({**request, "bundle": str(self.bundle)}, LEAD_S)

    def suggested(self, repeat: int) -> dict[str, Any]:
        """The request for the bundle's playlist."""
        if self.bundle is None or not self._playlist:
            Playlist.suggested((), 0)
        items = [[one.appearance, one.duration_ms / 1000, one.fade_ms / 1000] for one in self._playlist]
        return {"op": "sequence", "items": items, "repeat": repeat}

    def stop(self, fade_s: float) -> dict[str, Any]:
        return self._agree({"op": "stop", "fade_s": fade_s}, LEAD_S)

    def show(self, pictures: Pictures) -> dict[str, Any]:
        """Pictures on all outputs; nothing is shown unless every player has got its own. Raises CodedError."""
        if lost := self.lost():
            raise WorkError(
                "host-lost", what=f"No answer from the computer {', '.join(lost)}.",
                remedy="Check that it is on and its network; the others keep their picture.",
            )  # fmt: skip
        jobs = [
            self._pool.submit(part.player.put, {name: pictures[name] for name in part.names}) for part in self._parts
        ]
        for job in jobs:
            job.result()
        return self._agree({"op": "show"}, LEAD_SHOW_S, all_must=True)

    def _agree(self, request: dict[str, Any], lead_s: float, *, all_must: bool = False) -> dict[str, Any]:
        with self._agreeing:
            moment = self.clock.now_s() + (lead_s if self._remote else LEAD_HERE_S)
            request = {**request, "at": moment}
            self._request = request
            within_s = _ASKED_S + lead_s + float(request.get("fade_s") or 0)
            jobs = [self._pool.submit(part.player.ask, request, within_s=within_s) for part in self._there()]
        if request["op"] != "show":
            with contextlib.suppress(VelaturaError, OSError):
                write_atomically(self._saved, json.dumps(request).encode(), mode=0o600)
        return self._presented(jobs, all_must=all_must)

    def _presented(self, jobs: Sequence[Future[dict[str, Any]]], *, all_must: bool) -> dict[str, Any]:
        """When all had it. A player that refuses is an error; one that is lost is not, unless ``all_must`` have it."""
        moments, failed = [], []
        for job in jobs:
            try:
                moments.append(float(job.result()["common_s"]))
            except CodedError as error:
                lost = error.code in ("link-no-answer", "player-gone", "player-silent", "player-not-running")
                if all_must or not lost:
                    failed.append(error)
        if failed:
            raise failed[0]
        self._sequence += 1
        self._presented_at = max(moments, default=self.clock.now_s()) - self.clock.ahead_s
        return {"sequence": self._sequence, "presented_at": self._presented_at}

    # -- what is seen of the players

    def lost(self) -> list[str]:
        """Computers that do not answer."""
        return sorted({p.host for p in self._parts if isinstance(p.player, Remote) and not p.player.there})

    def _there(self) -> list[Part]:
        return [part for part in self._parts if not isinstance(part.player, Remote) or part.player.there]

    def step(self) -> None:
        """A few times a second: look at the clock and every player, and give one that has come back what is due."""
        self.clock.look()
        for number, part in enumerate(self._parts):
            player = part.player
            if isinstance(player, Screen):
                part.state = player.step(player.setup.keep_s)
                self.skew.add(number, part.state.reports)
                continue
            part.state = player.state
            self.skew.add(number, player.take_reports())
            if player.returned():
                log(f"The computer {part.host} is here.")
                if self.bundle is not None:
                    player.bring(self.bundle)
            if self._request is not None and self._request["op"] != "show" and player.needs(self._request):
                self._pool.submit(self._catch_up, player, self._request)

    def _catch_up(self, player: Remote, request: dict[str, Any]) -> None:
        with contextlib.suppress(CodedError):
            player.ask(request, within_s=_ASKED_S)

    def status(self) -> dict[str, Any]:
        """As a player's, of all of them; ``lost_hosts``, and how far they are apart."""
        states = [part.state.status for part in self._parts]
        known = [status for status in states if status is not None]
        missing = [name for part in self._parts for name in _missing(part)]
        base = dict(known[0]) if known else dict(_NOTHING)
        troubles = {part.host: part.player.trouble for part in self._parts if isinstance(part.player, Remote)}
        return {
            **base,
            "sequence": self._sequence,
            "presented_at": self._presented_at,
            "missing_outputs": missing,
            "late": sum(status["late"] for status in known),
            "skipped": sum(status["skipped"] for status in known),
            "bundle": self.identity or base["bundle"],
            "lost_hosts": self.lost(),
            "clock_troubles": {"": self.clock.trouble, **troubles} if self._remote else {},
            **self.skew.figures(),
        }


def _missing(part: Part) -> Sequence[str]:
    status = part.state.status
    return part.names if status is None else status["missing_outputs"]


_NOTHING: Final[Mapping[str, Any]] = {
    "swaps": 0, "showing": "black", "appearance": None, "brightness": 1.0, "live": None, "fading": False,
    "sequence_running": False, "late": 0, "skipped": 0, "interval_p50_s": None, "interval_p99_s": None,
    "interval_longest_s": None, "bundle": None, "signed_by": None, "warning": None, "reported": 0, "alone": False,
    "rss_bytes": 0,
}  # fmt: skip


class Service:
    """The conductor behind the player's socket."""

    def __init__(
        self, conductor: Conductor, server: Server, inbox: FrameFile, hello: Mapping[str, Any], trust: Any
    ) -> None:
        self._conductor, self._server, self._inbox, self._trust = conductor, server, inbox, trust
        self._hello, self._notifier = dict(hello), Notifier()
        self._frames = FrameSet.black(conductor.sizes)
        self._jobs = ThreadPoolExecutor(4, thread_name_prefix="request")
        self._answers: list[tuple[Client, bytes]] = []
        self.ended = threading.Event()

    def run(self) -> None:
        threading.Thread(target=self._keep, daemon=True).start()
        self._notifier.ready()
        while not self.ended.is_set():
            for client, line in self._server.poll(_STEP_S):
                self._handle(client, line)
            while self._answers:
                self._server.send(*self._answers.pop(0))
            self._notifier.alive()
        self._notifier.stopping()

    def _keep(self) -> None:
        while not self.ended.wait(_STEP_S):
            self._conductor.step()

    def _handle(self, client: Client, line: bytes) -> None:
        ticket = None
        try:
            ticket, request = protocol.parse_request(line)
            values = self._at_once(request)
        except protocol.InvalidRequest as error:
            self._server.send(client, codec.error_line(error.ticket, error))
        except VelaturaError as error:
            self._server.send(client, codec.error_line(ticket, error))
        else:
            if values is not None:
                self._server.send(client, codec.answer_line(ticket, values))
            else:
                self._jobs.submit(self._later, client, ticket, request, line)

    def _at_once(self, request: protocol.Request) -> dict[str, Any] | None:
        """The answer of what needs no player, else None. A picture is copied out before the next is written."""
        match request:
            case protocol.Hello():
                return {**self._hello, "bundle": self._conductor.identity}
            case protocol.Status():
                return self._conductor.status()
            case protocol.LoadBundle(path):
                self._conductor.load(Path(path), self._trust)
                return {"bundle": self._conductor.identity}
            case protocol.Quit():
                self.ended.set()
                return {}
            case protocol.Live() | protocol.Clock() | protocol.Reports():
                raise UsageError(
                    _LIVE, what="A display of several screens or computers can't show live pictures.",
                    remedy="Use outputs of one screen for live pictures.",
                )  # fmt: skip
        return None

    def _later(self, client: Client, ticket: Any, request: protocol.Request, line: bytes) -> None:
        try:
            answer = codec.answer_line(ticket, self._do(request, line))
        except CodedError as error:
            answer = codec.error_line(ticket, error)
        self._answers.append((client, answer))
        self._server.wake()

    def _do(self, request: protocol.Request, line: bytes) -> dict[str, Any]:
        conductor = self._conductor
        match request:
            case protocol.Show():
                self._inbox.read(self._frames)
                return conductor.show(self._named(self._frames))
            case protocol.Identify():
                return conductor.show(self._named(identification(conductor.sizes)))
            case protocol.Stop(fade_s):
                return conductor.stop(fade_s)
            case protocol.Suggested(repeat):
                return conductor.play(conductor.suggested(repeat))
        plain = {name: value for name, value in json.loads(line).items() if name not in ("id", "at", "bundle")}
        return conductor.play(plain)

    def _named(self, frames: FrameSet) -> dict[str, Any]:
        return {size.name: image for size, image in zip(self._conductor.sizes, frames.pixels, strict=True)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Conduct until a quit request or a signal; the exit code is as the player's."""
    options = parser().parse_args(arguments)
    try:
        return _run(options)
    except VelaturaError as error:
        print(f"{error.what}\n{error.remedy}", file=sys.stderr)  # noqa: T201
        return error.exit_code


def _run(options: Any) -> int:
    sizes = parse_outputs(options.outputs)
    hosts, where = parse_where(options.host, sizes), parse_where(options.where, sizes)
    places: dict[tuple[str, str], list[OutputSize]] = {}
    for size in sizes:
        host, _, screen = hosts.get(size.name, "").partition("/")
        places.setdefault((host, screen), []).append(size)
    keys, revoked = ([load_public_key(path).hex() for path in paths] for paths in (options.trusted, options.revoked))
    seconds, then = options.alone.split(",")
    clock = HostClock()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(Server(options.socket))
        inbox = FrameFile(options.socket.with_name(options.socket.name + ".inbox"), sizes)
        stack.callback(inbox.path.unlink, missing_ok=True)
        link = None
        if any(host for host, _ in places):
            from controller.stage.hosts.remote import opened_link

            link = stack.enter_context(opened_link(options.keys, clock, options.port))
        setups = {
            place: Setup(
                tuple((size.name, size.width_px, size.height_px) for size in its), options.rate,
                {size.name: where[size.name] for size in its if size.name in where}, options.frames is not None,
                tuple(keys), tuple(revoked), options.allow_unsigned, float(seconds), then,
            )
            for place, its in places.items()
        }  # fmt: skip
        parts = []
        for number, ((host, screen), setup) in enumerate(setups.items()):
            names = tuple(name for name, _, _ in setup.outputs)
            if link is not None and host:
                all_of_it = {place[1]: its for place, its in setups.items() if place[0] == host}
                parts.append(Part(host, Remote(link, host, screen, all_of_it), names))
                continue
            here = Screen(options.socket.parent / f"screen-{number}", clock, display=screen)
            here.prepare(setup)
            parts.append(Part("", here, names))
        conductor = Conductor(sizes, parts, clock, options.socket.with_name(options.socket.name + SUFFIX))
        trust = parts[0].player.setup.trust()
        outputs = [{"name": s.name, "width_px": s.width_px, "height_px": s.height_px} for s in sizes]
        hello = {"player": "velatura", "protocol": codec.PROTOCOL, "minor": protocol.MINOR, "pid": os.getpid(),
                 "rate_hz": options.rate, "outputs": outputs, "inbox": str(inbox.path.resolve())}  # fmt: skip
        service = Service(conductor, server, inbox, hello, trust)
        leaving = _end_on_signals(service)
        if options.bundle is not None and options.bundle.exists():
            conductor.load(options.bundle, trust)
        service.run()
        if not leaving.is_set():
            with contextlib.suppress(CodedError):
                conductor.stop(0.0)
            for part in parts:
                if isinstance(part.player, Screen):
                    part.player.end()
    return 0


def _end_on_signals(service: Service) -> threading.Event:
    leaving = threading.Event()

    def end(number: int, _: object) -> None:
        if number == signal.SIGUSR1:
            leaving.set()
        service.ended.set()

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
        signal.signal(number, end)
    return leaving


if __name__ == "__main__":
    sys.exit(main())
