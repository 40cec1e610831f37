"""``python -m controller.stage.hosts.conductor``: several players that serve as one, with the player's own protocol.

It gets the arguments of a player, and makes of each request one that all its players carry out at one moment of the
common clock. The players are on screens of this computer, or on others that run an agent.
"""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from controller.bundle.format import PlaylistEntry
from controller.bundle.reader import Bundle
from controller.bundle.signing import load_public_key
from controller.core.errors import BundleError, UsageError, VelaturaError, WorkError
from controller.core.storage import write_atomically
from controller.play.__main__ import parser
from controller.play.control.commands import SUFFIX, Commands, SavedRequest, Server
from controller.play.control.notify import Notifier
from controller.play.control.protocol import Suggested
from controller.play.frames import FrameFile, FrameSet, OutputSize, parse_outputs, parse_where
from controller.play.loop import Player
from controller.play.playlist import Playlist
from controller.play.presenting import Intervals, Outcome, PresentedSet, ResultCallback
from controller.stage.hosts.clock import HostClock
from controller.stage.hosts.remote import Remote, lost_host, opened_link
from controller.stage.hosts.screen import Screen, Setup
from hal.errors import CodedError

_STEP_S: Final = 0.25
LEAD_HERE_S: Final = 0.1
LEAD_S: Final = 1.0
"""From a request to its moment: long enough for a message that is lost and sent again."""
LEAD_SHOW_S: Final = 0.2
_ASKED_S: Final = 5.0
_LOST: Final = ("link-no-answer", "player-gone", "player-silent", "player-not-running", "superseded")
_MOST_CALLS: Final = 16
"""Of devices at once: one that hangs must not keep the others waiting."""
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


class Conductor:
    """Several players as one. To ``play.control.commands`` it is a player: it has what ``play.loop.Player`` has.

    ``saved``: the file of what was agreed on last, which the next conductor continues.
    """

    def __init__(
        self, sizes: Sequence[OutputSize], players: Sequence[Screen | Remote], clock: HostClock, saved: Path,
        wake: Callable[[], None],
    ) -> None:  # fmt: skip
        self.sizes, self.rate_hz = tuple(sizes), players[0].setup.rate_hz
        self._players, self._clock, self._saved, self._wake = tuple(players), clock, saved, wake
        self.shown = FrameSet.black(sizes)
        self.bundle_identity: str | None = None
        self._bundle: Path | None = None
        self._suggests: Sequence[PlaylistEntry] = ()
        self._skew = Skew(len(players))
        self.request: dict[str, Any] | None = None
        self._last = PresentedSet(0, 0.0)
        self._pool = ThreadPoolExecutor(8 * len(players), thread_name_prefix="players")
        self._jobs = ThreadPoolExecutor(4, thread_name_prefix="requests")
        self._calls = ThreadPoolExecutor(_MOST_CALLS, thread_name_prefix="devices")
        self._results: deque[Callable[[], None]] = deque()
        self._agreeing, self._ended = threading.Lock(), threading.Event()
        self._leaving = False
        with contextlib.suppress(OSError, ValueError):
            self.request = json.loads(saved.read_bytes())

    def run(self, serve: Callable[[float], None], *, first: Callable[[], None]) -> None:
        """As ``Player.run``."""
        threading.Thread(target=self._keep, daemon=True).start()
        notifier = Notifier()
        notifier.ready()
        first()
        while not self._ended.is_set():
            serve(_STEP_S)
            while self._results:
                self._results.popleft()()
            notifier.alive()
        notifier.stopping()
        if not self._leaving:
            with contextlib.suppress(CodedError):
                self._agree({"op": "stop"}, LEAD_S)
            for player in self._players:
                player.end()

    def end(self, *, leaving: bool = False) -> None:
        """As ``Player.end``; ``leaving``: the players play on."""
        self._leaving = leaving
        self._ended.set()

    # -- what may be asked for, as of a player

    def load_bundle(self, path: Path) -> None:
        """Use this bundle from now on; it is brought to all computers. Raises BundleError."""
        with contextlib.closing(Bundle.open_trusted(path, self._players[0].setup.trust())) as bundle:
            self.bundle_identity, self._suggests = bundle.identity, bundle.index.schedule
        self._bundle = path.resolve()
        for player in self._players:
            player.bring(self._bundle)

    def suggested(self, repeat: int) -> Playlist:
        return Playlist.suggested(self._suggests, repeat)

    def play(
        self, playlist: Playlist, on_result: ResultCallback, *, rate_hz: float | None = None, brightness: float = 1.0,
        at_s: None = None, bundle: None = None,
    ) -> None:  # fmt: skip
        """At one moment on all players that are there, or on none.

        Raises BundleError("bundle-none"), WorkError("hosts-behind") while the bundle is on its way.
        """
        if self._bundle is None:
            raise BundleError("bundle-none", what="The players have no bundle to play.", remedy="Install one first.")
        if behind := [player.progress for player in self._there() if player.behind]:
            raise WorkError(
                "hosts-behind", what=f"The bundle is on its way: {', '.join(behind)}.", remedy="Wait until it is there."
            )
        request = {"op": "sequence", **playlist.request(), "rate_hz": rate_hz, "brightness": brightness}
        self._later(on_result, {**request, "bundle": str(self._bundle)}, LEAD_S)

    def stop(self, on_result: ResultCallback, *, fade_s: float = 0.0, at_s: None = None) -> None:
        self._later(on_result, {"op": "stop", "fade_s": fade_s}, LEAD_S)

    def show(self, frames: FrameSet, on_result: ResultCallback, *, showing: str = "pattern", at_s: None = None) -> None:
        """Pictures on all outputs, or on none if a player does not get its own."""
        self.shown = frames
        pictures = {size.name: image for size, image in zip(self.sizes, frames.pixels, strict=True)}
        self._later(on_result, {"op": "show"}, LEAD_SHOW_S, pictures)

    def live(self, path: Path, white: float | None) -> dict[str, Any]:
        raise UsageError(
            "live-not-on-hosts", what="A display of several screens or computers can't show live pictures.",
            remedy="Use outputs of one screen for live pictures.",
        )  # fmt: skip

    def withdraw(self) -> None:
        """What was agreed on stays agreed on until something else is."""

    def clock(self, ahead_s: float, keep_s: float | None, then: str) -> None:
        """Its players get this computer's."""

    def reports(self, after: int) -> list[list[Any]]:
        """Each player has its own."""
        return []

    def device(self, host: str, call: Mapping[str, Any], on_result: ResultCallback) -> bool:
        """As ``Player.device``; the agent of that computer answers."""
        there = next((player for player in self._players if isinstance(player, Remote) and player.host == host), None)
        if there is not None:
            self._calls.submit(self._work, on_result, partial(there.call, call))
        return there is not None

    def _later(
        self,
        on_result: ResultCallback,
        request: dict[str, Any],
        lead_s: float,
        pictures: Mapping[str, Any] | None = None,
    ) -> None:
        def agreed() -> PresentedSet:
            if pictures is not None:
                self._put(pictures)
            return self._agree(request, lead_s)

        self._jobs.submit(self._work, on_result, agreed)

    def _work(self, on_result: ResultCallback, work: Callable[[], Outcome]) -> None:
        try:
            outcome = work()
        except CodedError as error:
            outcome = WorkError(error.code, what=error.what, remedy=error.remedy)
        self._results.append(partial(on_result, outcome))
        self._wake()

    def _put(self, pictures: Mapping[str, Any]) -> None:
        if lost := self._lost():
            raise lost_host(", ".join(lost))
        own = [{name: pictures[name] for name in player.setup.names} for player in self._players]
        list(self._pool.map(lambda player, its: player.put(its), self._players, own))

    def _agree(self, request: dict[str, Any], lead_s: float) -> PresentedSet:
        """Let all do it at one moment; when all had it. A player that is lost is no error where it can catch up."""
        far = any(player.host for player in self._players)
        within_s = _ASKED_S + lead_s + float(request.get("fade_s") or 0)
        with self._agreeing:
            self.request = {**request, "at": self._clock.now_s() + (lead_s if far else LEAD_HERE_S)}
            jobs = [self._pool.submit(player.ask, self.request, within_s=within_s) for player in self._there()]
            if request["op"] != "show":
                with contextlib.suppress(VelaturaError, OSError):
                    write_atomically(self._saved, json.dumps(self.request).encode(), mode=0o600)
        moments = []
        for job in jobs:
            try:
                moments.append(float(job.result()["common_s"]))
            except CodedError as error:
                if request["op"] == "show" or error.code not in _LOST:
                    raise
        at_s = max(moments, default=self._clock.now_s()) - self._clock.ahead_s
        self._last = PresentedSet(self._last.sequence + 1, at_s)
        return self._last

    # -- what is seen of the players

    def _lost(self) -> list[str]:
        """Computers that do not answer."""
        return sorted({player.host for player in self._players if not player.there})

    def _there(self) -> list[Screen | Remote]:
        return [player for player in self._players if player.there]

    def _keep(self) -> None:
        while not self._ended.wait(_STEP_S):
            self.step()

    def step(self) -> None:
        """A few times a second: look at the clock and every player, and give one that has come back what is due."""
        self._clock.look()
        for number, player in enumerate(self._players):
            self._skew.add(number, player.look())
            if self._bundle is not None:
                player.bring(self._bundle)
            if self.request is not None and self.request["op"] != "show" and player.needs(self.request):
                self._pool.submit(self._catch_up, player, self.request)

    def _catch_up(self, player: Screen | Remote, request: dict[str, Any]) -> None:
        with contextlib.suppress(CodedError):
            player.ask(request, within_s=_ASKED_S)

    def status(self) -> dict[str, Any]:
        """As a player's, of all of them; ``lost_hosts``, and how far they are apart."""
        known = [player.state.status for player in self._players if player.state.status is not None]
        missing = [
            name
            for player in self._players
            for name in (player.setup.names if player.state.status is None else player.state.status["missing_outputs"])
        ]
        base = known[0] if known else _NOTHING
        return {
            **base,
            "sequence": self._last.sequence,
            "presented_at": self._last.at_s,
            "missing_outputs": missing,
            "late": sum(status["late"] for status in known),
            "skipped": sum(status["skipped"] for status in known),
            "bundle": self.bundle_identity or base["bundle"],
            "lost_hosts": self._lost(),
            "clock_troubles": {"": self._clock.trouble, **{player.host: player.trouble for player in self._players}},
            "frame_lock": all(player.state.frame_lock for player in self._players),
            **self._skew.figures(),
        }


_NOTHING: Final[Mapping[str, Any]] = {
    "swaps": 0, "showing": "black", "appearance": None, "brightness": 1.0, "live": None, "fading": False,
    "sequence_running": False, "late": 0, "skipped": 0, "interval_p50_s": None, "interval_p99_s": None,
    "interval_longest_s": None, "bundle": None, "signed_by": None, "warning": None, "reported": 0, "alone": False,
    "rss_bytes": 0,
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Conduct until a quit request or a signal; the exit code is as the player's."""
    options = parser().parse_args(arguments)
    try:
        with contextlib.ExitStack() as stack:
            return _run(options, stack)
    except VelaturaError as error:
        print(f"{error.what}\n{error.remedy}", file=sys.stderr)  # noqa: T201
        return error.exit_code


def _run(options: Any, stack: contextlib.ExitStack) -> int:
    sizes = parse_outputs(options.outputs)
    server = stack.enter_context(Server(options.socket))
    inbox = FrameFile(options.socket.with_name(options.socket.name + ".inbox"), sizes)
    stack.callback(inbox.path.unlink, missing_ok=True)
    clock = HostClock()
    players = _players(options, _setups(options, sizes), clock, stack)
    saved = options.socket.with_name(options.socket.name + SUFFIX)
    conductor = Conductor(sizes, players, clock, saved, server.wake)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1):
        signal.signal(number, lambda came, _: conductor.end(leaving=came == signal.SIGUSR1))
    first = Suggested(repeat=0) if options.suggested and conductor.request is None else None
    commands = Commands(cast("Player", conductor), server, inbox, SavedRequest(None), first=first)
    if options.bundle is not None and options.bundle.exists():
        conductor.load_bundle(options.bundle)
    conductor.run(commands.serve, first=commands.resume)
    return 0


def _setups(options: Any, sizes: Sequence[OutputSize]) -> dict[tuple[str, str], Setup]:
    """By computer ("": this one) and X screen."""
    hosts, where = parse_where(options.host, sizes), parse_where(options.where, sizes)
    places: dict[tuple[str, str], list[OutputSize]] = {}
    for size in sizes:
        host, _, screen = hosts.get(size.name, "").partition("/")
        places.setdefault((host, screen), []).append(size)
    trusted, revoked = (
        tuple(load_public_key(path).hex() for path in paths) for paths in (options.trusted, options.revoked)
    )
    seconds, then = options.alone.split(",")
    return {
        place: Setup(
            tuple((size.name, size.width_px, size.height_px) for size in its), options.rate,
            {size.name: where[size.name] for size in its if size.name in where}, options.frames is not None,
            trusted, revoked, options.allow_unsigned, float(seconds), then,
        )
        for place, its in places.items()
    }  # fmt: skip


def _players(
    options: Any, setups: Mapping[tuple[str, str], Setup], clock: HostClock, stack: contextlib.ExitStack
) -> list[Screen | Remote]:
    link = None
    if any(host for host, _ in setups):
        link = stack.enter_context(opened_link(options.keys, options.port))
    players: list[Screen | Remote] = []
    for number, ((host, screen), setup) in enumerate(setups.items()):
        if link is not None and host:
            its = {place[1]: one for place, one in setups.items() if place[0] == host}
            package = options.keys / "update.deb" if screen == next(iter(its)) else None
            players.append(Remote(link, host, screen, its, package))
        else:
            here = Screen(options.socket.parent / f"screen-{number}", clock, display=screen)
            here.prepare(setup)
            players.append(here)
    return players


if __name__ == "__main__":
    sys.exit(main())
