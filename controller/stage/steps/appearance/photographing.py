"""Steps with the installed appearances: photograph each of them, and swap them at the display's rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.capture.brackets import merge_brackets
from controller.optics.capture.profile import load_profile
from controller.run.runner import Context, Step
from controller.run.step_id import ShotId, StepId
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import Taken
from controller.stage.artefacts.published import write_photograph, write_playback
from controller.stage.artefacts.solved import read_solved
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.appearance.exposure_times import speeds, timed
from controller.stage.steps.capture.photographs import photograph_series, take_photograph
from hal.deadline import Deadline

PLAYED = "played"
"""The kind of the photographs of appearances."""
PLAYBACK_RATE_HZ = 60.0


def photograph_step(rig: Rig, names: Sequence[str], *, longest_exposure_s: float) -> Step:
    """Play each appearance of the installed bundle and photograph it in HDR."""
    return Step(
        StepId(StepKind.PHOTOGRAPH),
        partial(_photograph, rig, tuple(names), longest_exposure_s),
        after=(StepId(StepKind.PUBLISH),),
        title="Photographing the installed appearances",
        weight=photographs_s(rig, names),
    )


def photographs_s(rig: Rig, names: Sequence[str]) -> float:
    """Cost in seconds of showing and photographing these appearances (``steps.costs``)."""
    return 3 * len(names) * costs.shot_s(costs.scale(projector.size_px for projector in rig.projectors))


def _photograph(rig: Rig, names: Sequence[str], longest_s: float, context: Context) -> Sequence[Path]:
    display = rig.bundle_display()
    bundle = display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
    projectors = [projector.name for projector in rig.projectors]
    paths = []
    for number, name in enumerate(names):
        context.advance(number / len(names), name)
        solved = read_solved(context.folder, name, projectors)
        shown = display.play(name, deadline=context.deadline.within(20))
        of = {"bundle": bundle, "appearance": name}
        picture = photograph_hdr(
            rig, context, PLAYED, name, solved.exposure, longest_s, shown_at_s=shown.at_s, of=of,
            light=solved.target[solved.reachable],
        )  # fmt: skip
        paths.append(write_photograph(context.folder, StepKind.PHOTOGRAPH, name, picture))
    return paths


def photograph_hdr(
    rig: Rig, context: Context, kind: str, name: str, white: float, longest_s: float, *, shown_at_s: float,
    of: Mapping[str, str], light: FloatImage | None = None,
) -> FloatImage:  # fmt: skip
    """Photograph what is shown now in HDR: (rows, columns, 3) float32, full scales per second.

    ``kind`` and ``name`` identify the photographs, together with a number for each. ``white`` is the radiance of
    the target's white; ``of`` names the picture shown, for the journal; ``light`` (pixels, 3) is about what it shows.
    """
    _, merged = take_hdr(rig, context, kind, name, white, longest_s, shown_at_s=shown_at_s, of=of, light=light)
    return np.asarray(np.nan_to_num(merged), np.float32)


def take_hdr(
    rig: Rig, context: Context, kind: str, name: str, white: float, longest_s: float, *, shown_at_s: float,
    of: Mapping[str, str], light: FloatImage | None = None,
) -> tuple[list[Taken], FloatImage]:  # fmt: skip
    """As ``photograph_hdr``: the photographs, and their combination, NaN where it is too bright for all."""
    exposures_s = speeds(white, rig.acquirer.exposures_s(), longest_s, load_profile(context.folder), light=light)
    taken = take_bracket(rig, context, kind, name, exposures_s, shown_at_s=shown_at_s, of=of)
    merged = merge_brackets(
        [photograph.measured() for photograph in taken], [photograph.exposure_s for photograph in taken]
    ).radiance
    return taken, merged


def take_bracket(
    rig: Rig, context: Context, kind: str, name: str, exposures_s: Sequence[float], *, shown_at_s: float,
    of: Mapping[str, str],
) -> list[Taken]:  # fmt: skip
    """Photographs of what is shown now, in this order, with their true exposures; the rest as ``photograph_hdr``."""
    with photograph_series(rig, context) as series:
        for number, exposure_s in enumerate(exposures_s):
            identity = ShotId(kind, f"{name}-{number}")
            series.add(take_photograph(rig, context, identity, exposure_s, shown_at_s=shown_at_s, of=of))
    return timed(series.taken)


def playback_step(rig: Rig, names: Sequence[str], *, seconds: float) -> Step:
    """Swap the appearances at the display's rate, and measure how regular the swaps are."""
    return Step(
        StepId(StepKind.PLAYBACK),
        partial(_playback, rig, tuple(names), seconds),
        title="Swapping appearances 60 times a second",
        weight=seconds + 0.5,
        always=True,
    )


def _playback(rig: Rig, names: Sequence[str], seconds: float, context: Context) -> Sequence[Path]:
    display = rig.bundle_display()
    deadline: Deadline = context.deadline.within(seconds + 60)
    display.load_bundle(rig.stage / "bundles" / "current", deadline=deadline)
    items = [(name, 1 / PLAYBACK_RATE_HZ) for name in names]
    rounds = max(1, round(seconds * PLAYBACK_RATE_HZ / len(names)))
    before = display.playing(deadline=deadline)
    began = display.play_sequence(items, repeat=rounds, rate_hz=PLAYBACK_RATE_HZ, deadline=deadline)
    while (now := display.playing(deadline=deadline)).running:
        context.advance(min(0.99, (now.swaps - before.swaps) / (rounds * len(names))))
        deadline.sleep(0.2)
    display.stop(deadline=deadline)
    swaps = now.swaps - before.swaps
    figures = {
        "swaps": swaps,
        "swaps_per_s": (swaps - 1) / max(now.presented_at_s - began.at_s, 1e-9),
        "interval_p50_ms": None if now.interval_p50_s is None else 1000 * now.interval_p50_s,
        "interval_p99_ms": None if now.interval_p99_s is None else 1000 * now.interval_p99_s,
        "late": now.late,
        "rss_bytes": now.rss_bytes,
    }
    return [write_playback(context.folder, figures)]
