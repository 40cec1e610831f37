"""Play the installed bundle's appearances on a stage; for the command line and the kiosk."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from controller.bundle.format import Index
from controller.bundle.install import current
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.state_machine import Event
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from controller.stage.services.bundle import check_outputs
from controller.stage.sessions.calibrations import stage_trust
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LONGEST_RUN_S
from controller.stage.sessions.session import StageSession, StageWork
from hal.deadline import in_seconds

SHOWN_S: Final = 10.0
"""Default time for each of several appearances."""
_KEYS: Final = {"appearance", "seconds", "fade_s"}


@dataclass(frozen=True, slots=True)
class PlayedSequence:
    """Appearances one after the other: (name, seconds, fade_s) each; ``repeat`` rounds, 0: without end.

    ``for_s``: black after so many seconds; None: after the rounds.
    """

    items: tuple[tuple[str, float, float], ...]
    repeat: int
    for_s: float | None = None

    @property
    def whole_s(self) -> float:
        """Its duration, at most the longest that a run may take."""
        rounds_s = self.repeat * sum(seconds for _, seconds, _ in self.items) or LONGEST_RUN_S
        return min(rounds_s if self.for_s is None else self.for_s, LONGEST_RUN_S)


@dataclass(frozen=True, slots=True)
class PlayRequest:
    """What to show. No name: the playlist in the bundle. One name: for ``seconds``, or until stopped.

    Several names, or ``sequence`` (a file, see ``read_sequence``): each for ``seconds``, of which ``fade_s`` fade it
    in, ``repeat`` rounds, without end if 0.
    """

    names: Sequence[str] = ()
    sequence: Path | None = None
    seconds: float | None = None
    fade_s: float = 0.0
    repeat: int = 0


def play(
    request: PlayRequest, *, session: StageSession, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Switch the projectors on and show appearances of the installed bundle.

    Raises UsageError("nothing-installed", "nothing-to-play", "played-twice",
    "sequence-file-wrong", "fade-too-long" or "appearance-unknown"), and BundleError for a bundle that
    the stage does not trust or that was made for other outputs; always before a lamp is struck.
    """
    checked = check_stage(session.stage)
    installed = current(checked.stage.folder / "bundles")
    if installed is None:
        raise UsageError(
            "nothing-installed",
            what="No bundle is installed on this stage.",
            remedy="Run `velatura appearance` on it first.",
        )
    if request.names or request.sequence is not None:
        played_sequence = requested_sequence(request)
    else:
        trust = stage_trust(checked.stage)
        played_sequence = suggested_sequence(installed, trust, request.repeat, request.seconds)
    index = _checked_index(installed, checked, played_sequence)
    session.run(
        checked,
        StageWork("play", lambda rig, _: _playing(rig, played_sequence, index), plays=True),
        reporter=reporter,
        cancel=cancel,
    )
    played = list(dict.fromkeys(name for name, _, _ in played_sequence.items))
    return {"played": played[0] if len(played) == 1 else played}


def _checked_index(bundle: Path, checked: Checked, played_sequence: PlayedSequence) -> Index:
    """The index of a bundle that the stage trusts, that fits its outputs and has the given appearances."""
    with Bundle.open_trusted(bundle, stage_trust(checked.stage)) as opened:
        index = opened.index
    held = [appearance.name for appearance in index.appearances]
    for name, _, _ in played_sequence.items:
        if name not in held:
            raise UsageError(
                "appearance-unknown",
                what=f"The installed bundle has no appearance '{name[:64]}'.",
                remedy=f"Available: {', '.join(held) or 'none'}.",
            )
    outputs = checked.stage.tables.display.outputs
    check_outputs(index, {(output.name, output.width_px, output.height_px) for output in outputs})
    return index


def requested_sequence(request: PlayRequest) -> PlayedSequence:
    """The names or the file of ``request``. Raises UsageError("played-twice", "fade-too-long")."""
    names, sequence, seconds, fade_s = request.names, request.sequence, request.seconds, request.fade_s
    if names and sequence is not None:
        raise UsageError(
            "played-twice",
            what="Both appearances and a sequence were given.",
            remedy="Give names of appearances, or --sequence FILE.",
        )
    if sequence is not None:
        return read_sequence(sequence)
    if len(names) == 1:
        # The last picture of a sequence stays, so its duration does not matter.
        return PlayedSequence(((names[0], max(fade_s, 1.0), fade_s),), 1, LONGEST_RUN_S if seconds is None else seconds)
    each_s = SHOWN_S if seconds is None else seconds
    if fade_s > each_s:
        raise UsageError(
            "fade-too-long",
            what=f"The fade of {fade_s:g} s is longer than the {each_s:g} s for each appearance.",
            remedy="Give a shorter --fade or longer --seconds.",
        )
    return PlayedSequence(tuple((name, each_s, fade_s) for name in names), request.repeat)


def suggested_sequence(bundle: Path, trust: Trust, repeat: int, seconds: float | None) -> PlayedSequence:
    """The playlist in a bundle. ``seconds``: replaces each item's time; a fade is at most as long.

    Raises UsageError("nothing-to-play") for a bundle without playlist, and BundleError as ``Bundle.open``.
    """
    with Bundle.open_trusted(bundle, trust) as opened:
        hints = opened.index.schedule
    if not hints:
        raise UsageError(
            "nothing-to-play",
            what="No appearances and no sequence were given, and the installed bundle has no playlist.",
            remedy="Give names of appearances, or --sequence FILE.",
        )
    lasting = [(hint.appearance, seconds or hint.duration_ms / 1000, hint.fade_ms / 1000) for hint in hints]
    return PlayedSequence(tuple((name, shown_s, min(fade_s, shown_s)) for name, shown_s, fade_s in lasting), repeat)


def read_sequence(path: Path) -> PlayedSequence:
    """Read a sequence from a TOML file: ``repeat`` (0: without end), and a table [[item]] for each appearance.

    An item has ``appearance``, ``seconds`` and optionally ``fade_s``, at most its seconds. Raises
    UsageError("sequence-file-wrong").
    """
    try:
        tables = tomllib.loads(read_text(path))
    except OSError as error:
        raise _wrong(path, f"it can't be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise _wrong(path, f"it is not TOML ({error})") from error
    items, repeat = tables.get("item"), tables.get("repeat", 0)
    if tables.keys() - {"item", "repeat"} or not isinstance(items, list) or not items:
        raise _wrong(path, "it needs [[item]] tables; its only other key is repeat")
    if type(repeat) is not int or repeat < 0:
        raise _wrong(path, "repeat must be a whole number from 0")
    return PlayedSequence(tuple(_item(path, number, table) for number, table in enumerate(items, start=1)), repeat)


def _item(path: Path, number: int, table: Any) -> tuple[str, float, float]:
    if not isinstance(table, dict) or table.keys() - _KEYS or not isinstance(table.get("appearance"), str):
        raise _wrong(path, f"item {number} needs appearance; its only other keys are seconds and fade_s")
    seconds, fade_s = table.get("seconds", SHOWN_S), table.get("fade_s", 0.0)
    if any(type(value) not in (int, float) for value in (seconds, fade_s)) or not 0 <= fade_s <= seconds or not seconds:
        raise _wrong(path, f"in item {number}, seconds must be above 0, and fade_s from 0 to seconds")
    return table["appearance"], float(seconds), float(fade_s)


def _wrong(path: Path, detail: str) -> UsageError:
    return UsageError(
        "sequence-file-wrong",
        what=f"The sequence {path} can't be used: {detail}.",
        remedy='Write repeat = 0, then for each appearance: [[item]], appearance = "...", seconds = 10, fade_s = 1.',
    )


def _playing(rig: Rig, played_sequence: PlayedSequence, index: Index) -> Sequence[Step]:
    shown = rig.bundle_display().outputs(deadline=in_seconds(20))
    check_outputs(index, {(output.name, output.width_px, output.height_px) for output in shown})
    title = " and ".join(dict.fromkeys(name for name, _, _ in played_sequence.items))
    return [
        Step(StepId("play"), partial(_show, rig, played_sequence), title=f"Playing {title}",
             enter=Event.PLAY, leave=Event.PAUSE, always=True)
    ]  # fmt: skip


def _show(rig: Rig, played_sequence: PlayedSequence, context: Context) -> Sequence[Path]:
    display = rig.bundle_display()
    display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
    # A fade answers at its end.
    patience_s = 20 + played_sequence.items[0][2]
    display.play_sequence(
        played_sequence.items, repeat=played_sequence.repeat, deadline=context.deadline.within(patience_s)
    )
    whole_s = played_sequence.whole_s
    until = in_seconds(whole_s)
    while not until.passed:
        context.advance(0.0 if whole_s >= LONGEST_RUN_S else 1 - until.left_s() / whole_s)
        context.deadline.sleep(min(0.5, until.left_s()))
    display.stop(deadline=context.deadline.within(20))
    return ()
