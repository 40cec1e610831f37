"""Keeps the player running and showing what is wanted: a watchdog with back-off, in a thread of its own."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from controller.bundle.install import Starts, before_it, chosen, is_readable
from controller.core.errors import VelaturaError
from controller.kiosk.decide.interfaces import BLACK, PlayerView, Showing
from controller.kiosk.supervisors.on_screen_text import notice, outputs_of, put
from controller.kiosk.values import Turn
from controller.kiosk.world import READY_S, Process, launched
from controller.play.control.launch import AttachedPlayer, PlayerSettings
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, ProtocolError
from hal.notices import Level, Notice
from hal.player import PlayerClient

MOST_MISSES: Final = 2
"""Unanswered questions in a row after which a player counts as hung."""
REFUSED_MORE: Final = 2
"""So many more where the connection fails: a player that is about to end refuses it, too."""
LONGER: Final = (1, 2, 4, 8)
"""So many times as many questions, by how often it was ended in the last ``REMEMBERED_S``."""
REMEMBERED_S: Final = 300.0


class Patience:
    """Counts the questions in a row that a player left unanswered, and its ends because of that.

    A player whose answers are late or lost, because the computer is busy for example, may show its picture all the
    time. Each end makes that black, and if it did not help, the next one will not either.
    """

    def __init__(self) -> None:
        self._misses = 0
        self._ends_s: deque[float] = deque(maxlen=len(LONGER) - 1)

    def begins(self) -> None:
        """The player was started, or it answered."""
        self._misses = 0

    def ends(self, now_s: float, *, as_wanted: bool, refused: bool = False) -> bool:
        """Count one more question without an answer; whether the player is to be ended.

        ``as_wanted``: it showed what it should when it answered last. Where it did not, nothing speaks for waiting.
        """
        self._misses += 1
        lately = sum(now_s - end_s < REMEMBERED_S for end_s in self._ends_s)
        most = MOST_MISSES * (LONGER[lately] if as_wanted else 1) + REFUSED_MORE * refused
        if self._misses < most:
            return False
        self._ends_s.append(now_s)
        return True


ANSWER_S: Final = 0.8
HEALTHY_S: Final = 20.0
"""A player that ran for so long is started again at once when it dies."""
BACK_OFF_S: Final = (0.0, 0.0, 0.0, 1.0, 2.0, 5.0, 15.0, 30.0)
PUT_S: Final = 5.0
FADE_AWAITED_S: Final = 3.0
NOTICE_TURN_S: Final = 10.0
"""On an object that all projectors light, the text of several at once could not be read."""
AGAIN_S: Final = 60.0
"""After this time without a picture, a player without the installed bundle is started with it again."""
OUTPUT_GONE: Final = "output-gone"
"""The code of a player's problem that is one of its outputs, and not its own."""
STARTS_WITH_BUNDLE: Final = 6
"""Starts in a row without a picture after which the player is started without the installed bundle: it shows black.

More than after which it goes back to the bundle before by itself (``bundle.fallback``), because a picture may have been
on the outputs that was not seen here.
"""


@dataclass(slots=True)
class PlayerRun:
    """What is known of one run of the player, from its start to its end.

    ``with_bundle``: it was started with the installed bundle; ``dark``: it has shown no picture yet; ``hello``: its
    answer when it was ready; ``bundles``: the loaded ones by the identity that it tells; ``reached``: what was wanted
    when it answered last, which may be nothing, in a tuple, None: it has not answered yet; ``turns``: what it was asked
    to show in turn; ``skipped``: people know that it left an appearance out; ``identified`` and ``noticed``: the names
    of the outputs, or which output shows which lines, are on the outputs now. Times in seconds that only go up:
    ``looked_back_s``: when an earlier bundle was looked for.
    """

    with_bundle: bool = True
    dark: bool = True
    started_at_s: float = 0.0
    looked_back_s: float = 0.0
    hello: dict[str, Any] = field(default_factory=dict)
    bundles: dict[str, Path] = field(default_factory=dict)
    reached: tuple[Showing | None] | None = None
    turns: tuple[Turn, ...] | None = None
    skipped: bool = False
    identified: bool = False
    noticed: tuple[int, tuple[str, ...]] | None = None


class PlayerSupervisor:
    """The player of a stage; see ``decide.interfaces.PlayerPort``.

    ``settings`` is asked at each start (the flag: with the installed bundle); ``tell`` hears what happens. ``notice``:
    lines of text that one projector after the other shows as long as nothing else is wanted than black. ``attach``:
    gets hold of a player that somebody else starts, instead of starting one with ``launch``.
    """

    def __init__(
        self,
        runtime: Path,
        settings: Callable[[bool], PlayerSettings],
        tell: Callable[[Notice], object],
        *,
        monotonic: Callable[[], float] = time.monotonic,
        attach: Callable[[PlayerSettings], AttachedPlayer] | None = None,
        launch: Callable[[Path, PlayerSettings], Process] = launched,
        channel: PlayerClient | None = None,
    ) -> None:
        self._runtime, self._settings, self._tell, self._monotonic = runtime, settings, tell, monotonic
        self.want: Showing | None = BLACK
        self.identifying = False
        self.notice: tuple[str, ...] = ()
        self._attach = attach
        self._launch = launch
        self._process: Process | None = None
        self._channel = channel or PlayerClient()
        self._view = PlayerView()
        self._patience, self._failed = Patience(), 0
        self._starts_without_picture, self._start_at_s = 0, 0.0
        self._run = PlayerRun()
        self._closed = False

    @property
    def view(self) -> PlayerView:
        return self._view

    def step(self) -> None:
        """Look once, and do what follows; blocks for a start at most."""
        if self._process is None:
            if self._monotonic() >= self._start_at_s:
                self._start()
            if self._process is None:
                return
        if not self._process.alive:
            self._restart(Notice("player-died", "The player ended unexpectedly.", "It is started again.", Level.ERROR))
            return
        try:
            self._follow(self._ask({"op": "status"}))
            self._patience.begins()
            if self._waits_in_vain():
                self._restart(_WITHOUT_BUNDLE)
        except DeviceTimeout:
            if self._ends_for_silence():
                self._restart(Notice("player-hung", "The player did not answer.", "It is started again.", Level.ERROR))
        except (DeviceGone, ProtocolError, KeyError):
            self._channel.hang_up()
            if self._ends_for_silence(refused=True):
                self._restart(
                    Notice("player-gone", "The player refused the connection.", "It is started again.", Level.ERROR)
                )
        except DeviceRefused as error:
            self._patience.begins()
            # It says why it can't show that, so it does answer: an end changes nothing.
            self._run.reached = (self.want,)
            problem = Notice(error.code, error.what, error.remedy, Level.ERROR)
            if error.code.startswith("bundle-") and self._starts_again():
                # Only starts are counted, and after three without a picture the player goes back to the bundle before.
                self._restart(problem)
            else:
                self._trouble(problem)

    def close(self) -> None:
        """Black, and the player's end, for good. One of somebody else runs on, and shows what is wanted last."""
        self._closed = True
        if self._attach is not None and self._process is not None and self.want == BLACK:
            # One that does not answer is its starter's to end.
            with contextlib.suppress(KeyError, DeviceError):
                self._ask({"op": "stop"}, 3.0)
        self._channel.hang_up()
        if (process := self._process) is not None:
            process.terminate()

    # -- starting

    def _start(self) -> None:
        try:
            failed = self._starts_without_picture
            run = self._run = PlayerRun(with_bundle=failed < STARTS_WITH_BUNDLE or failed % 2 == 0)
            self._process = self._player(self._settings(run.with_bundle))
            if self._closed:
                # While it was made ready: it would show its picture after the service's end.
                self._process.terminate()
                self._process = None
                return
            hello = self._process.wait_until_ready(READY_S)
        except (VelaturaError, OSError) as error:
            self._process = None
            self._failed += 1
            self._starts_without_picture += 1
            self._start_at_s = self._monotonic() + BACK_OFF_S[min(self._failed, len(BACK_OFF_S) - 1)]
            what, remedy = (error.what, error.remedy) if isinstance(error, VelaturaError) else (str(error), "")
            self._trouble(Notice("player-not-started", what, remedy or "It is tried again.", Level.ERROR))
            return
        self._patience.begins()
        run.started_at_s = run.looked_back_s = self._monotonic()
        run.hello = hello
        installed = self._settings(True).bundle
        if hello.get("bundle") and installed is not None:
            # The player may have gone back to the bundle before while it started.
            self._run.bundles[str(hello["bundle"])] = chosen(installed.parent) or installed.resolve()
        self._tell(Notice("player-started", "The player is running."))

    def _player(self, settings: PlayerSettings) -> Process:
        return self._launch(self._runtime, settings) if self._attach is None else self._attach(settings)

    def _restart(self, why: Notice) -> None:
        assert self._process is not None
        self._tell(why)
        self._channel.hang_up()
        if self._process.alive:
            # It had its time to answer; SIGTERM would be one more thing that it does not hear.
            self._process.kill()
        self._process.terminate()
        self._process = None
        healthy = self._monotonic() - self._run.started_at_s >= HEALTHY_S
        self._failed = 0 if healthy else self._failed + 1
        # One that died after it had shown its picture says nothing about the bundle.
        self._starts_without_picture += self._run.dark and self.want != BLACK
        self._start_at_s = self._monotonic() + BACK_OFF_S[min(max(self._failed - 1, 0), len(BACK_OFF_S) - 1)]
        self._view = replace(self._view, shown=None, problem=why, outputs=None, restarts=self._view.restarts + 1)
        if self._monotonic() >= self._start_at_s:
            self._start()

    def _ends_for_silence(self, *, refused: bool = False) -> bool:
        # While work shows pictures of its own nothing is wanted here, and an end would make its photographs black.
        as_wanted = self._run.reached == (self.want,)
        return self._patience.ends(self._monotonic(), as_wanted=as_wanted, refused=refused)

    # -- showing

    def _follow(self, status: dict[str, Any]) -> None:
        # First: a bundle that can't be read ends this step, and people need to know of the cable, too.
        self._see_outputs(status)
        path = self._run.bundles.get(str(status["bundle"]))
        name = status["appearance"] if status["showing"] == "appearance" else ""
        shown = BLACK if status["showing"] == "black" else None
        if name:
            shown = Showing(path, str(name), brightness=float(status["brightness"]))
        want = self.want
        if name:
            self._run.dark, self._starts_without_picture = False, 0
        if status["skipped"] and name and not self._run.skipped:
            # Once, because it comes round again and again.
            self._run.skipped = True
            self._tell(_SKIPPED)
        if self.identifying:
            if not self._run.identified:
                self._ask({"op": "identify"}, 3.0)
                self._run.identified = True
        elif want == BLACK and self.notice:
            self._tell_all()
        elif want is not None and (
            not self._is_shown(want, shown, status) or self._run.identified or self._run.noticed is not None
        ):
            self._run.identified, self._run.noticed = False, None
            self._put(want, path)
            shown = want
        if self._monotonic() - self._run.started_at_s >= HEALTHY_S:
            self._failed = 0
        outputs = self._view.outputs
        if outputs is None and self._view.problem is not None:
            self._tell(Notice("player-well", "The player shows what it should again."))
        self._run.reached = (want,)
        self._view = replace(self._view, shown=shown, problem=outputs, warning=self._warning(status))

    def _see_outputs(self, status: dict[str, Any]) -> None:
        outputs = _outputs_problem(status)
        if outputs is not None and outputs != self._view.outputs:
            self._tell(outputs)
        self._view = replace(self._view, outputs=outputs)

    def _is_shown(self, want: Showing, shown: Showing | None, status: dict[str, Any]) -> bool:
        running = bool(status["sequence_running"])
        if not want.in_turn:
            # What somebody else lets the player show in turn is not ours to end.
            return shown == want and not (running and self._run.turns)
        names = {name for name, _, _ in want.in_turn}
        same = shown is not None and shown.bundle == want.bundle and shown.appearance in names
        same = same and shown is not None and shown.brightness == want.brightness
        return running and same and self._run.turns in (None, want.in_turn)

    def _warning(self, status: dict[str, Any]) -> Notice | None:
        reported = status.get("warning")
        if reported is None:
            return None
        warning = Notice(str(reported["code"]), str(reported["what"]), str(reported["remedy"]), Level.WARNING)
        if self._view.warning != warning:
            self._tell(warning)
        return warning

    def _tell_all(self) -> None:
        outputs = outputs_of(self._run.hello)
        turn = int(self._monotonic() / NOTICE_TURN_S) % len(outputs)
        if self._run.noticed == (turn, self.notice) and not self._run.identified:
            return
        sequence = put(Path(self._run.hello["inbox"]), outputs, notice(outputs, self.notice, turn))
        self._ask({"op": "show", "sequence": sequence}, 3.0)
        self._run.identified, self._run.noticed = False, (turn, self.notice)

    def _put(self, want: Showing, loaded: Path | None) -> None:
        if not want.appearance or want.bundle is None:
            with contextlib.suppress(DeviceTimeout) if want.fade_s > FADE_AWAITED_S else contextlib.nullcontext():
                self._ask({"op": "stop", "fade_s": want.fade_s}, PUT_S)
            return
        if loaded != want.bundle:
            answer = self._ask({"op": "load-bundle", "path": str(want.bundle)}, 5.0)
            self._run.bundles[str(answer["bundle"])] = want.bundle
            self._run.skipped = False
        request: dict[str, Any] = {"op": "play", "appearance": want.appearance, "fade_s": want.fade_s}
        if want.in_turn:
            items = [list(turn) for turn in want.in_turn]
            request = {"op": "sequence", "items": items, "repeat": 0, "first_fade_s": want.fade_s}
        request["brightness"] = want.brightness
        # The answer comes when the picture has faded in; until then the status tells what comes.
        with contextlib.suppress(DeviceTimeout) if want.fade_s > FADE_AWAITED_S else contextlib.nullcontext():
            if self._ask(request, PUT_S)["ok"]:
                self._run.dark, self._starts_without_picture = False, 0
        self._run.turns = want.in_turn
        what = f"{len(want.in_turn)} appearances in turn" if want.in_turn else want.appearance
        self._tell(Notice("playing", f"The player shows {what}."))

    def _waits_in_vain(self) -> bool:
        """Whether it runs without the installed bundle, which can't be read, and there is another one to go back to.

        Its starts had another cause than the bundle, such as a display that came late, so none of them was counted.
        """
        want = self.want
        unread = want is not None and want.bundle is not None and not want.appearance
        return not self._run.with_bundle and self._run.dark and unread and self._earlier() is not None

    def _starts_again(self) -> bool:
        """Whether a player that can't load a bundle is to. One with a picture shows that of another bundle, such as one
        without some projectors; of the previous one it could show all.
        """
        if self._run.dark:
            return self._run.with_bundle or self._monotonic() - self._run.started_at_s > AGAIN_S
        installed, want = self._installed, self.want
        if installed is None or want is None or want.bundle != installed:
            return False
        return self._earlier() is not None and not is_readable(installed)

    @property
    def _installed(self) -> Path | None:
        link = self._settings(True).bundle
        return None if link is None else chosen(link.parent)

    def _earlier(self) -> Path | None:
        """Looked for once a minute: the bundle that can be gone back to from the installed one."""
        now_s, link = self._monotonic(), self._settings(True).bundle
        if link is None or now_s - self._run.looked_back_s < AGAIN_S:
            return None
        self._run.looked_back_s = now_s
        return before_it(link.parent, self._installed, Starts.read(link.parent))

    def _trouble(self, problem: Notice) -> None:
        if self._view.problem is None or self._view.problem.code != problem.code:
            self._tell(problem)
        if (outputs := self._view.outputs) is not None:
            problem = replace(problem, what=f"{problem.what} {outputs.what}",
                              remedy=f"{problem.remedy} {outputs.remedy}")  # fmt: skip
        self._view = replace(self._view, problem=problem, shown=None)

    def _ask(self, request: dict[str, Any], timeout_s: float = ANSWER_S) -> dict[str, Any]:
        """The answer, {"ok": False} for a request that a later one replaced. Raises as ``PlayerClient.request``."""
        assert self._process is not None
        try:
            return self._channel.request(self._process.socket, request, self._channel.within(timeout_s))
        except DeviceRefused as error:
            if error.code == "superseded":
                return {"ok": False}
            raise


def _outputs_problem(status: dict[str, Any]) -> Notice | None:
    """That outputs get no picture, although the player shows one."""
    if not (names := status.get("missing_outputs")):
        return None
    if len(names) == 1:
        what = f"The output {names[0]} of this computer is off, or not as it should be: its projector gets no picture."
    else:
        what = f"The outputs {', '.join(names)} of this computer are off, or not as they should be."
    remedy = (
        "Check the video cable, and that the projector is on. `velatura doctor` says if the output is turned, scaled, "
        "of another size or over another one. The picture comes back by itself."
    )
    if lost := status.get("lost_hosts"):
        what = f"The computer {', '.join(lost)} does not answer."
        remedy = "Check that it is on, and its network. Its outputs follow what was agreed on; the others play on."
    return Notice(OUTPUT_GONE, what, remedy, Level.ERROR)


_WITHOUT_BUNDLE: Final = Notice(
    "bundle-tried-again", "The installed bundle can't be read, and the player runs without it.",
    "It is started again, and goes back to the bundle before.", Level.WARNING,
)  # fmt: skip
_SKIPPED: Final = Notice(
    "appearance-skipped", "An appearance could not be read from the bundle, and was left out.",
    "Publish the appearances again.", Level.ERROR,
)  # fmt: skip
