"""The steps that check the devices and measure the camera: delay, JPEG response, noise, limits, bad pixels."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.core.errors import TroubleCode, UsageError
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.capture.acquire import Shot
from controller.optics.capture.jpeg_response import measure_response, nominal_response
from controller.optics.capture.latency import LONGEST_S, measure_latency
from controller.optics.capture.linear_files import is_linear
from controller.optics.capture.linearity import (
    RawExposure,
    black_offset,
    camera_faults,
    check_series,
    common_limit,
    find_hot,
    true_exposures,
)
from controller.optics.capture.pixel_response import response_spread, some_rows
from controller.optics.capture.profile import CameraProfile, measure_noise
from controller.optics.capture.raw import (
    RawMosaic,
    is_jpeg,
    read_jpeg_values,
    read_mosaic,
    read_photograph,
    read_samples,
)
from controller.optics.solve.memory_need import calibration_peak_bytes, check_memory, planned_size, solve_peak_bytes
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.camera import Delay, Exposures, write_camera_figures, write_response_figures
from controller.stage.artefacts.kinds import StepKind, white_of
from controller.stage.artefacts.names import CAPTURES
from controller.stage.artefacts.photographs import BLACK, CAMERA_RESPONSE, TakenPhotograph, light_of, white_bracket
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.capture.exposure import White, white_exposures
from controller.stage.steps.capture.photographs import Planned, take_all
from controller.stage.steps.troubles import tell
from hal.notices import Level
from hal.runtime.compute import free_bytes

Size = tuple[int, int]


def device_checks(rig: Rig, prior: CameraPrior) -> list[Step]:
    """The step that compares the outputs of stage.toml with the display's, and reads one photograph.

    Warns of a RAW file without colour matrix or black level. Raises UsageError("display-outputs-differ"),
    ("camera-intrinsics-wrong-size") where the lens file is for another size, WorkError("memory-too-small") where a
    calibration or a solve of that size certainly does not fit, and as ``read_photograph``.
    """
    wanted = {projector.output: projector.size_px for projector in rig.projectors}

    def check(context: Context) -> Sequence[Path]:
        shown = rig.display.outputs(deadline=context.deadline.within(20))
        _check_outputs(wanted, {output.name: (output.width_px, output.height_px) for output in shown})
        file, _ = rig.acquirer.photograph(
            "device-checks", rig.acquirer.exposures_s()[0], context.folder, shown_at_s=time.monotonic(),
            deadline=context.deadline.within(60), wait_s=0.0,
        )  # fmt: skip
        try:
            size_px, missing = _read(file.path)
        finally:
            file.path.unlink(missing_ok=True)
        if missing:
            context.reporter.say(missing, Level.WARNING)
        size, free = planned_size(size_px, list(wanted.values())), free_bytes()
        needs = (solve_peak_bytes(size), "The solve"), (calibration_peak_bytes(size), "The calibration")
        context.reporter.say(check_memory(max(needs)[0], free, max(needs)[1]))
        if prior.size_px not in (None, size_px):
            raise _wrong_lens(prior.size_px or size_px, size_px)
        return ()

    inputs = {"size": repr(prior.size_px), "outputs": repr(sorted(wanted.items()))}
    title = "Checking the display's outputs and a photograph"
    return [Step(StepId("device-checks"), check, inputs=inputs, title=title, weight=1.0)]


def _check_outputs(wanted: dict[str, Size], shown: dict[str, Size]) -> None:
    for name, size_px in wanted.items():
        if shown.get(name) != size_px:
            found = shown.get(name)
            theirs = "does not have it" if found is None else f"says {found[0]} x {found[1]}"
            raise UsageError(
                "display-outputs-differ",
                what=f"Output {name} has {size_px[0]} x {size_px[1]} pixels in stage.toml, but the display {theirs}.",
                remedy="Correct [[display.outputs]] in stage.toml, or the settings of the display.",
            )


def _read(path: Path) -> tuple[Size, str]:
    """(width, height), and a sentence about what the file does not say; raises where it can't be read."""
    missing = ""
    if is_jpeg(path):
        taken = np.asarray(read_jpeg_values(path), np.float32)
    elif is_linear(path):
        taken = read_samples(path)[0]
    else:
        mosaic = read_mosaic(path)
        taken = mosaic.samples.astype(np.float32)
        lacks = ["colour matrix"] * (mosaic.camera_to_xyz is None) + ["black level"] * (not mosaic.levels.black.any())
        if lacks:
            missing = (
                f"The camera's RAW files have no {' and no '.join(lacks)}. "
                "See 'What the files must say' on the page Cameras of the documentation."
            )
    return (taken.shape[1], taken.shape[0]), missing


def _wrong_lens(lens: Size, taken: Size) -> UsageError:
    return UsageError(
        "camera-intrinsics-wrong-size",
        what=f"The lens file is for pictures of {lens[0]} x {lens[1]} pixels, but the camera's have"
        f" {taken[0]} x {taken[1]}.",
        remedy="Use the camera settings of `velatura camera calibrate`, or calibrate the lens again.",
    )


RESPONSE_STOPS = (-6, -5, -4, -3, -2, -1, 0, 1, 2)
"""Exposures of a JPEG camera's bracket series, relative to the one at which white is well exposed."""
BRIGHTNESS_OF_ALL = 0.7
"""Factor of a shorter exposure for white of all projectors together, so that nothing clips."""


def delay_step(rig: Rig, longest_exposure_s: float) -> Step:
    """``delay.json``: time from a picture's presentation until it is completely visible; the acquirer waits so long.

    It needs no stable light, and says at which exposure white of all projectors is certainly not clipped.
    """
    return Step(
        StepId(StepKind.DELAY),
        partial(_measure_delay, rig, longest_exposure_s),
        title="Measuring the display's delay",
        weight=5 * LONGEST_S,
        unsteady=True,
    )


def response_steps(rig: Rig) -> list[Step]:
    """The step ``camera-response`` for a camera without RAW; no step for other cameras."""
    if rig.camera.capabilities.raw:
        return []
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    return [
        Step(
            StepId(StepKind.CAMERA_RESPONSE),
            partial(_photograph_response, rig),
            after=(StepId(StepKind.EXPOSURE), StepId(StepKind.DELAY)),
            title="Measuring the camera's response",
            weight=costs.shot_s(scale) * len(RESPONSE_STOPS),
        )
    ]


def camera_step(rig: Rig) -> Step:
    """``camera.npz`` and ``camera.json``: the camera's noise and limits, from black and the projectors' whites."""
    names = [projector.name for projector in rig.projectors]
    response = () if rig.camera.capabilities.raw else (StepId(StepKind.CAMERA_RESPONSE),)
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    return Step(
        StepId(StepKind.CAMERA),
        partial(_measure_camera, names),
        after=(StepId(StepKind.BLACK), *map(white_of, names), *response),
        title="Measuring the camera's noise and limits",
        weight=0.3 * scale,
        calculates=True,
    )


def _exposure_of_all(rig: Rig, context: Context) -> float:
    """Exposure at which white of all projectors together is certainly not clipped."""
    shortest = min(exposure.base_s for exposure in Exposures.read(context.folder).values())
    return _at_most(rig.acquirer.exposures_s(), BRIGHTNESS_OF_ALL * shortest / len(rig.projectors))


def _at_most(available_s: Sequence[float], wanted_s: float) -> float:
    return max((value for value in available_s if value <= wanted_s), default=min(available_s))


def _measure_delay(rig: Rig, longest_s: float, context: Context) -> Sequence[Path]:
    found_s = white_exposures(rig, context, White(rig.projectors, "all projectors together"), longest_s, most=1)[0]
    exposure_s = _at_most(rig.acquirer.exposures_s(), BRIGHTNESS_OF_ALL * found_s)
    flats = [rig.on_outputs({}), rig.on_outputs({p.name: p.white() for p in rig.projectors})]
    shown: list[tuple[bool, float]] = []
    count = 0

    def look(white: bool, delay_s: float, *, before_s: float) -> FloatImage:
        """Each picture follows the other one, which has been shown long enough to be visible.

        The time in which that one was photographed counts, so that a slow camera needs no more.
        """
        nonlocal count
        context.advance(min(count / 10, 0.9), "display and camera")
        if before_s and (not shown or shown[-1][0] == white):
            shown.append((not white, rig.acquirer.show(flats[not white], deadline=context.deadline)))
        if before_s:
            context.deadline.sleep(max(0.0, shown[-1][1] + before_s - time.monotonic()))
        shot = Shot(f"delay-{count}", flats[white], exposure_s)
        presented = rig.acquirer.present_for(shot, deadline=context.deadline)
        shown.append((white, presented.at_s))
        file, _ = rig.acquirer.photograph(
            shot.name, exposure_s, context.folder / CAPTURES, shown_at_s=presented.at_s, deadline=context.deadline,
            wait_s=delay_s,
        )  # fmt: skip
        count += 1
        image = _provisional(file.path)
        file.path.unlink()
        return image

    with contextlib.nullcontext() if rig.seat is None else rig.seat.only(context.deadline):
        found = measure_latency(look)
    rig.check_light(deadline=context.deadline, stable=False)
    path = Delay(found.wait_s, found.delay_s, found.tries, exposure_s).write(context.folder)
    rig.acquirer.set_delay(found.wait_s)
    return [path]


def _provisional(path: Path) -> FloatImage:
    """A photograph linearised by the nominal response, before the camera's own is known."""
    return read_photograph(path, response=nominal_response()).measured()


def _photograph_response(rig: Rig, context: Context) -> Sequence[Path]:
    """The bracket series of the lit scene."""
    whites: Mapping[str, ByteImage] = {p.name: p.white() for p in rig.projectors}
    middle = _exposure_of_all(rig, context)
    available = rig.acquirer.exposures_s()
    wanted = {min(available, key=lambda value: abs(np.log2(value / middle) - stop)) for stop in RESPONSE_STOPS}
    plan = [Planned(str(number), lambda: whites, value) for number, value in enumerate(sorted(wanted))]
    paths = take_all(rig, context, plan, into=CAMERA_RESPONSE)
    taken = CAMERA_RESPONSE.read(context.folder)
    images = [read_jpeg_values(photograph.path) for photograph in taken]
    found = measure_response(images, [photograph.exposure_s for photograph in taken])
    saved = CameraProfile(response=found.table).save(context.folder)
    content = {"misfit": found.misfit, "seen": found.seen, "black": found.black, "photographs": len(images)}
    figures = write_response_figures(context.folder, content)
    return [*paths, saved, figures]


def _measure_camera(projectors: Sequence[str], context: Context) -> Sequence[Path]:
    black = BLACK.read(context.folder)
    series = [white_bracket(light_of(name).read(context.folder)) for name in projectors]
    faults: Mapping[TroubleCode, str] = {}
    if is_jpeg(black[0].path):
        profile, figures = _of_colours("jpeg", black, series)
    elif is_linear(black[0].path):
        profile, figures = _of_colours("linear", black, series)
    else:
        profile, figures, faults = _of_raw(black, series, context)
    path = write_camera_figures(context.folder, figures)
    return [profile.save(context.folder), path, tell(context, StepId(StepKind.CAMERA), faults)]


def _of_raw(
    black: Sequence[TakenPhotograph], whites: Sequence[Sequence[TakenPhotograph]], context: Context
) -> tuple[CameraProfile, dict[str, object], Mapping[TroubleCode, str]]:
    dark = [_exposed(one) for one in black]
    levels = dark[0][0].levels
    offset = black_offset([one for _, one in dark], levels)
    hot = find_hot([one for _, one in dark], levels)
    profile = CameraProfile(black_offset=offset, bad_px=hot)
    levels = replace(levels, black=levels.black + offset)
    found, ratios = [], []
    pairs = [tuple(_samples(one, profile) for one in black[:2])] if len(black) > 1 else []
    for number, series in enumerate(whites):
        context.advance(0.2 + 0.6 * number / len(whites), "linearity")
        if len(series) < 2:
            continue
        checked = check_series([_exposed(one)[1] for one in series], levels)
        found.append(checked)
        ratios.append((sorted(one.exposure_s for one in series), checked.ratios))
        ordered = sorted(series, key=lambda one: one.exposure_s)
        pairs.append((_samples(ordered[0], profile), _samples(ordered[1], profile)))
    clip = common_limit([one.clip for one in found])
    noise = measure_noise([(first, second) for first, second in pairs])
    profile = replace(profile, clip=clip, exposures=true_exposures(ratios))
    if noise is not None:
        profile = replace(profile, noise=noise.noise)
    lit = [[some_rows(_samples(one, profile)) for one in series] for series in whites]
    spread = response_spread(lit, levels.colours)
    faults = camera_faults(profile.exposures, len(hot), dark[0][1].samples.size, spread)
    figures = {
        "kind": "raw",
        "black_offset_steps": offset.tolist(),
        "hot_pixels": len(hot),
        "response_spread": spread,
        "clip": [[None if np.isinf(value) else float(value) for value in row] for row in clip],
        "exposure_ratios": [[one.nominal, one.ratios] for one in found],
        "worst_nonlinearity": max((one.worst for one in found), default=0.0),
        "noise": {"shot": profile.noise.shot, "read": profile.noise.read, "measured": noise is not None},
    }
    return profile, figures, faults


def _exposed(taken: TakenPhotograph) -> tuple[RawMosaic, RawExposure]:
    raw = read_mosaic(taken.path)
    return raw, RawExposure(raw.samples, taken.exposure_s)


def _samples(taken: TakenPhotograph, profile: CameraProfile) -> FloatImage:
    """Raw samples in full scale, NaN where clipped."""
    linear, clipped = read_mosaic(taken.path, profile=profile).linear()
    linear[clipped] = np.nan
    return linear


def _of_colours(
    kind: str, black: Sequence[TakenPhotograph], whites: Sequence[Sequence[TakenPhotograph]]
) -> tuple[CameraProfile, dict[str, object]]:
    """Measure only the noise: the response is known, and there is no black level and no mosaic."""
    profile = black[0].profile or CameraProfile()
    pairs = []
    for series in whites:
        ordered = sorted(series, key=lambda one: one.exposure_s)
        if len(ordered) > 1:
            first, second = (one.measured()[:, :, 1] for one in ordered[:2])
            pairs.append((first, second))
    noise = measure_noise(pairs)
    if noise is not None:
        profile = replace(profile, noise=noise.noise)
    figures: dict[str, object] = {
        "kind": kind,
        "noise": {"shot": profile.noise.shot, "read": profile.noise.read, "measured": noise is not None},
    }
    return profile, figures
