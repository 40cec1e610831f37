"""Steps with the installed appearances: photograph each of them, and swap them at the display's rate.

Two exposure times, a long and a short one, are chosen for the results, and give one picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage
from controller.optics.capture.brackets import merge_brackets
from controller.optics.capture.demosaic import SensorLevels
from controller.optics.capture.linearity import RawExposure, exposure_ratio
from controller.optics.capture.profile import CameraProfile, load_profile
from controller.optics.capture.raw import is_jpeg, read_mosaic
from controller.optics.solve.result.refinement import FLOOR
from controller.run.runner import Context, Step
from controller.run.step_id import ShotId, StepId
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import TakenPhotograph
from controller.stage.artefacts.published import write_photograph, write_playback
from controller.stage.artefacts.solved import read_solved
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.capture.exposure import bracket
from controller.stage.steps.capture.photographs import photograph_series, take_photograph
from hal.deadline import Deadline

WANTED: Final = (0.7, 5.0)
"""Exposures of an appearance's photograph, relative to the one at which its target's white reaches full scale."""
BRIGHTEST_PERCENTILE: Final = 99.9
CLIPPED: Final = 0.9
"""Of full scale: what is expected to be brighter may clip."""
DARKEST: Final = 1e-6
"""Full scales per second: what has less light gets the longest exposure."""
LEAST_CERTAINTY: Final = 1e-30
SAMPLES: Final = 20_000
LONG: Final = 2.2, 9.0
"""In the same unit: a known exposure is taken for the longer photograph. With less, white's half is missing in it, and
with more hardly anything is well exposed in both."""


def speeds(
    white: float,
    available_s: Sequence[float],
    longest_s: float,
    profile: CameraProfile | None,
    *,
    light: FloatImage | None = None,
    shorter: int = 1,
) -> list[float]:
    """Exposures for what has ``white`` in full scales per second, rising: those ``WANTED``, the longer one known.

    With ``light``, about what is shown, the longer one is that with which all of them together have least noise: as
    short as the first where all of the light is about as bright.

    Parameters
    ----------
    profile : of the camera; without corrections in it, its exposures are what it says
    light : (pixels, 3) in full scales per second
    shorter : so many photographs have the first exposure
    """
    found = bracket(1 / white, WANTED, available_s, longest_s)
    known = _known(white, available_s, longest_s, profile)
    if light is not None and len(light):
        longer = [value for value in available_s if found[0] <= value <= min(LONG[1] / white, longest_s)]
        noise = _Noise(light, found[0], shorter, white, profile)
        return [found[0], min(known or longer or found[:1], key=noise.with_longer)]
    if not known or len(found) < 2:
        return found
    return [found[0], min(known, key=lambda value: abs(math.log(value * white / WANTED[1])))]


def brightest(light: FloatImage) -> float:
    """What a photograph of ``light`` (pixels, 3) must not clip, in full scales per second, above 0."""
    return max(float(np.percentile(channels.largest(light), BRIGHTEST_PERCENTILE)), DARKEST)


class _Noise:
    """The noise of ``light`` in ``shorter`` photographs of ``short_s`` and a longer one, of light and white."""

    def __init__(
        self, light: FloatImage, short_s: float, shorter: int, white: float, profile: CameraProfile | None
    ) -> None:
        self._light = np.maximum(light[:: max(1, len(light) // SAMPLES)].astype(np.float64), 0)
        self._noise = (profile or CameraProfile()).noise
        self._counted_over = self._light + FLOOR * white
        self._short = shorter * self._certainty(short_s)

    def _certainty(self, exposure_s: float) -> Float64:
        noise = self._noise.per_second(exposure_s)
        measured = exposure_s * self._light < CLIPPED
        return np.asarray(np.where(measured, 1 / (noise.shot * self._light + noise.read**2), 0))

    def with_longer(self, exposure_s: float) -> float:
        certainty = np.maximum(self._short + self._certainty(exposure_s), LEAST_CERTAINTY)
        return float(np.mean(1 / (np.sqrt(certainty) * self._counted_over)))


def _known(white: float, available_s: Sequence[float], longest_s: float, profile: CameraProfile | None) -> list[float]:
    """Exposures whose true times a camera's corrections have, and that suit the longer photograph."""
    if profile is None or not len(profile.exposures):
        return []
    low, high = (factor / white for factor in LONG)
    return [value for value in available_s if low <= value <= min(high, longest_s) and profile.knows(value)]


def timed(taken: Sequence[TakenPhotograph]) -> list[TakenPhotograph]:
    """Photographs of one picture with their true exposures: those that are not known, by those that are.

    ``taken`` have the exposures of their ``profile`` where it knows them. Where no two overlap, nothing is changed.
    """
    profile = taken[0].profile if taken else None
    if profile is None or not len(profile.exposures) or is_jpeg(taken[0].path):
        return list(taken)
    true = {float(value) for value in profile.exposures[:, 1]}
    known = [one for one in taken if _listed(one.exposure_s, true)]
    if not known or len(known) == len(taken):
        return list(taken)
    sure = max(known, key=lambda one: one.exposure_s)
    times: dict[float, list[float]] = {}
    for one in taken:
        if not _listed(one.exposure_s, true):
            times.setdefault(one.exposure_s, []).append(_measured_s(one, sure, profile))
    return [replace(one, exposure_s=fmean(times[one.exposure_s])) if one.exposure_s in times else one for one in taken]


def _measured_s(one: TakenPhotograph, sure: TakenPhotograph, profile: CameraProfile) -> float:
    """Its exposure in seconds as the light says, compared with ``sure``."""
    (shorter, levels), (longer, _) = (
        _exposed(each, profile) for each in sorted((one, sure), key=lambda each: each.exposure_s)
    )
    ratio = exposure_ratio(shorter, longer, levels)
    return sure.exposure_s / ratio if one.exposure_s < sure.exposure_s else sure.exposure_s * ratio


def _exposed(one: TakenPhotograph, profile: CameraProfile) -> tuple[RawExposure, SensorLevels]:
    raw = read_mosaic(one.path, profile=profile)
    return RawExposure(raw.samples, one.exposure_s), raw.levels


def _listed(value: float, known: set[float]) -> bool:
    return any(math.isclose(value, one, rel_tol=1e-6) for one in known)


__all__ = ["brightest", "speeds", "timed"]


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
        what = ShownPicture(PLAYED, name, of, shown.at_s, solved.exposure, solved.target[solved.reachable])
        picture = photograph_hdr(rig, context, what, longest_s)
        paths.append(write_photograph(context.folder, StepKind.PHOTOGRAPH, name, picture))
    return paths


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """What is shown now and will be photographed in HDR.

    Parameters
    ----------
    kind, name : identify the photographs, together with a number for each
    of : names the picture, for the journal
    at_s : since when it is shown, on the display's clock
    white : the radiance of the target's white
    light : (pixels, 3), about what it shows; None: not known
    """

    kind: str
    name: str
    of: Mapping[str, str]
    at_s: float
    white: float
    light: FloatImage | None = None


def photograph_hdr(rig: Rig, context: Context, shown: ShownPicture, longest_s: float) -> FloatImage:
    """Photograph what is shown now in HDR: (rows, columns, 3) float32, full scales per second."""
    _, merged = take_hdr(rig, context, shown, longest_s)
    return np.asarray(np.nan_to_num(merged), np.float32)


def take_hdr(
    rig: Rig, context: Context, shown: ShownPicture, longest_s: float
) -> tuple[list[TakenPhotograph], FloatImage]:
    """As ``photograph_hdr``: the photographs, and their combination, NaN where it is too bright for all."""
    profile = load_profile(context.folder)
    exposures_s = speeds(shown.white, rig.acquirer.exposures_s(), longest_s, profile, light=shown.light)
    taken = take_bracket(rig, context, shown.kind, shown.name, exposures_s, shown_at_s=shown.at_s, of=shown.of)
    merged = merge_brackets(
        [photograph.measured() for photograph in taken], [photograph.exposure_s for photograph in taken]
    ).radiance
    return taken, merged


def take_bracket(
    rig: Rig, context: Context, kind: str, name: str, exposures_s: Sequence[float], *, shown_at_s: float,
    of: Mapping[str, str],
) -> list[TakenPhotograph]:  # fmt: skip
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
