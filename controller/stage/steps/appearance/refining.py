"""The steps that photograph solved frames, correct them, keep the better ones, and say what limits the result."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask, summed
from controller.core.errors import WorkError
from controller.optics.capture.brackets import merge_brackets
from controller.optics.capture.profile import load_profile
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import APPEARANCE_TOLERANCE, SolveSettings
from controller.optics.solve.memory_need import check_memory, refine_peak_bytes, stage_size
from controller.optics.solve.result.common_causes import Cause, CommonCauses, common_causes, equations
from controller.optics.solve.result.refinement import (
    ModelError,
    PhotographedError,
    RefinedStage,
    ResultPhotograph,
    corrected_target,
    gain,
    model_error,
    photographed_error,
    refusal,
    solve_again,
    trusted_pixels,
    without_flicker,
)
from controller.run.journal import Journal
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.camera import inherit_camera
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import IndirectFigures
from controller.stage.artefacts.solved import (
    Refining,
    RequestedTarget,
    Solved,
    of_asked,
    read_solved,
    solving_digest,
    write_causes,
    write_refined,
)
from controller.stage.artefacts.views import view_folder
from controller.stage.rig.rig import Rig
from controller.stage.rig.shared_display import frames_digest
from controller.stage.steps import costs
from controller.stage.steps.appearance.photographing import brightest, speeds, take_bracket
from controller.stage.steps.appearance.solving import device_frames
from hal.deadline import Cancelled
from hal.errors import CodedError, DeviceError
from hal.notices import Level
from hal.runtime.compute import free_bytes

WORSE: Final = "the last correction was no better"
ENOUGH: Final = "the rest is noise"
CONFIRMED: Final = 0.25
"""A photograph confirms a correction that reaches more than this share of what it promised."""

NO_FILE: Final = "camera-no-file"


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """``photographs``: so many correct results at most, 0 to 9; ``smoothness`` of eq. 3; ``longest_exposure_s``."""

    photographs: int
    smoothness: float
    longest_exposure_s: float

    @property
    def last(self) -> int:
        """The number of the photograph that corrects nothing and confirms what the others made."""
        return self.photographs + 1

    def inputs(self) -> dict[str, str]:
        """What a correction depends on, as the journal compares it."""
        return {"smoothness": repr(self.smoothness), "longest_exposure_s": repr(self.longest_exposure_s)}


def refine_steps(
    rig: Rig,
    calibrated: Calibrated,
    titles: Mapping[str, str],
    options: RefineOptions,
    *,
    after: Mapping[str, StepId] | None = None,
) -> list[Step]:
    """The steps for these appearances, title by name, that are solved on ``calibrated``; none for 0 photographs.

    ``after``: the step of the same run that solves each; None where they were solved before. Then what was photographed
    on another day is not continued.
    """
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    steps: list[Step] = []
    last: list[StepId] = []
    for name, title in titles.items() if options.photographs else ():
        before = (after[name],) if after is not None else ()
        inputs = {"calibration": calibrated.folder.name, **options.inputs()}
        if after is None:
            inputs |= {"day": time.strftime("%Y-%m-%d"), "solved": solving_digest(calibrated.folder, name)}
        for number in range(1, options.last + 1):
            one = StepId(StepKind.REFINE, item=f"{number}-{name}")
            steps.append(
                Step(
                    one,
                    partial(_refine, rig, calibrated, name, number, options),
                    inputs=inputs,
                    after=before,
                    title=f"Refining {title}, photograph {number}",
                    weight=3 * costs.shot_s(scale) + costs.APPEARANCE_S * scale,
                )
            )
            before = (one,)
        last += before
        steps.append(
            Step(
                StepId(StepKind.REFINED, item=name),
                partial(_keep, calibrated, name, options),
                inputs=inputs,
                after=before,
                title=f"Keeping the better frames of {title}",
                weight=0.2,
            )
        )
    if len(last) > 1:
        steps.append(causes_step(calibrated, tuple(titles), options.last, after=last))
    return steps


def _refine(
    rig: Rig, calibrated: Calibrated, name: str, number: int, options: RefineOptions, context: Context
) -> Sequence[Path]:
    if number == 1:
        need = refine_peak_bytes(stage_size(calibrated.calibration))
        context.reporter.say(check_memory(need, free_bytes(), f"Refining {name}"))
    solved = _solved(calibrated, name)
    if number == 1:
        state = Refining(solved.linear, None, None)
    else:
        state = Refining.read(context.folder, name, number - 1, calibrated.projectors)
    if not state.ended and (number < options.last or state.is_corrected):
        refinement = _Refinement(rig, calibrated, solved, name, options, context)
        state = refinement.photograph_and_correct(state, number)
    return state.write(context.folder, name, number)


def _solved(calibrated: Calibrated, name: str) -> Solved:
    """The appearance as it was solved for all views, in the units of the first."""
    views = calibrated.views()
    solved = [read_solved(folder, name, calibrated.projectors) for folder in calibrated.folders]
    if len(solved) == 1:
        return solved[0]

    def joined(of: Callable[[Solved], Any], *, light: bool = False) -> Any:
        gains = [view.gain if light else None for view in views]
        images = [of(one) if gain is None else of(one) * gain for one, gain in zip(solved, gains, strict=True)]
        return calibrated.joined(images)

    asked = RequestedTarget(
        joined(lambda one: one.requested.target, light=True),
        joined(lambda one: one.requested.reachable),
        joined(lambda one: one.requested.valid),
    )
    target = joined(lambda one: one.target, light=True)
    return replace(solved[0], target=target, reachable=joined(lambda one: one.reachable), asked=asked)


@dataclass(frozen=True, slots=True)
class _Refinement:
    """Photographs an appearance's frames, judges the photograph, and solves the frames again."""

    rig: Rig
    calibrated: Calibrated
    solved: Solved
    name: str
    options: RefineOptions
    context: Context

    def photograph_and_correct(self, state: Refining, number: int) -> Refining:
        """Take photograph ``number``, of ``state.frames``; judge it, and solve again if that is worth it.

        Returns the state after it: with only one more row of figures if the photograph was refused, or, after the last
        one, with the frames that were confirmed; ended if the frames are no better than those before, or if what is
        left is noise; else with corrected frames.
        """
        is_last = number == self.options.last
        predicted = self._predicted(state.frames)
        mask = self.solved.reachable & self.calibrated.calibration.object_mask
        views = self._see(state.frames, predicted, mask, number)
        if all(view.refused for view in views):
            frames = state.best if is_last and state.best is not None else state.frames
            refused = {"refused": "; ".join(dict.fromkeys(view.refused for view in views))}
            return replace(state, frames=frames, photographs=(*state.photographs, refused))
        trusted = self.calibrated.joined([view.trusted for view in views])
        causes = self._equations(state, self._joined([view.taken for view in views]), predicted, trusted)
        photograph = self._joined([view.steady for view in views])
        error = self._error(photograph.radiance, trusted)
        row = {"delta_e00_median": error.median, "delta_e00_p95": error.p95, "delta_e00_mean": error.mean,
               "asked_median": self._of_asked(photograph.radiance, trusted),
               "left_out_share": 1 - float(trusted.sum()) / max(int(mask.sum()), 1)}  # fmt: skip
        state = replace(state, photographs=(*state.photographs, row), equations=causes)
        seen, left = model_error(photograph, predicted, trusted), error.map
        judged = self._judge(state, error, seen)
        if judged.ended or is_last:
            return judged
        if state.seen is not None:
            seen = state.seen.then(seen)
            left = self._error(predicted + seen.light, seen.known).map
        return self._solve_again(replace(judged, seen=seen), seen, left, predicted)

    def _judge(self, state: Refining, error: PhotographedError, seen: ModelError) -> Refining:
        """Keep the frames just photographed, or the better ones before them.

        ``error``: of the photograph; ``seen``: of the model by it. Frames are better only if their photograph is, and
        if it says so of the frames before them, too: light that has passed by speaks for its correction. With a
        projector that was moved, a correction promises much and reaches little.
        """
        if state.best is None or state.error is None:
            return replace(state, best=state.frames, error=error.map, seen=None)
        earlier = [self._error(self._predicted(frames) + seen.light, seen.known).map
                   for frames in (state.best, self.solved.linear)]  # fmt: skip
        better = min((gain(one, error.map) for one in (state.error, *earlier)), key=lambda one: one.mean)
        if better.mean > CONFIRMED * state.promised:
            ended = "" if better.worth_it else ENOUGH
            return replace(state, best=state.frames, error=error.map, ended=ended, seen=None)
        first = gain(*earlier).mean > 0
        rows = [{**row, "kept": False} if "refused" not in row and (n == len(state.photographs) - 1 or (first and n))
                else row for n, row in enumerate(state.photographs)]  # fmt: skip
        frames = self.solved.linear if first else state.best
        return replace(state, frames=frames, photographs=tuple(rows), ended=WORSE, seen=None)

    def _equations(
        self, state: Refining, photograph: ResultPhotograph, predicted: FloatImage, trusted: Mask
    ) -> Float64:
        """What this photograph and the earlier ones say of common causes."""
        frames = self._in_order(state.frames)
        error = np.where(trusted[..., None], photograph.radiance - predicted, 0).astype(np.float32)
        terms = equations(self.calibrated.transport, frames, error, self._stage, trusted)
        return terms if state.equations is None else terms + state.equations

    def _solve_again(self, state: Refining, seen: ModelError, left: FloatImage, predicted: FloatImage) -> Refining:
        """``state`` with frames of a corrected target, if the transport says that these are worth it.

        ``seen``: the model's error; ``left``: the error (CIEDE2000) of the present frames where ``seen`` is known.
        """
        self.context.advance(0.4, "solving again")
        transport, black = self.calibrated.transport, self.calibrated.calibration.black
        stage = self._stage
        images = (self.solved.target, seen.light, seen.sigma, stage.black, stage.white)
        corrected = self.calibrated.joined([
            corrected_target(target, ModelError(light, sigma), RefinedStage(dark, white))
            for target, light, sigma, dark, white in (map(view.part, images) for view in self.calibrated.views())
        ])  # fmt: skip
        indirect = predicted - black - transport.forward(self._in_order(state.frames))
        frames = solve_again(
            self.calibrated.light,
            self.solved.target - indirect,
            corrected - indirect,
            SolveSettings(self.options.smoothness, start=self._in_order(state.frames), tolerance=APPEARANCE_TOLERANCE),
            SolveContext(
                self.calibrated.engine,
                progress=lambda iteration, kkt: self.context.advance(1 - 0.6 / (1 + iteration / 60)),
            ),
            exposure=self.solved.exposure,
        )
        new = dict(zip(self.calibrated.projectors, frames, strict=True))
        expected = self._error(self._predicted(new) + seen.light, seen.known)
        if not gain(left, expected.map).worth_it:
            return replace(state, ended=ENOUGH)
        row = {**state.photographs[-1], "expected_median": expected.median}
        return replace(state, frames=new, photographs=(*state.photographs[:-1], row))

    @property
    def _stage(self) -> RefinedStage:
        calibration = self.calibrated.calibration
        white = summed([part.white for part in calibration.projectors])
        indirect = [part.indirect for part in calibration.projectors if part.indirect is not None]
        white = white + np.sum(indirect, axis=0, dtype=np.float32)
        return RefinedStage(calibration.black, np.maximum(white, 0))

    @property
    def _flicker(self) -> list[float]:
        measured = [IndirectFigures.read(self.calibrated.folder, name) for name in self.calibrated.projectors]
        return [0.0 if figures is None else figures.flicker for figures in measured]

    def _error(self, radiance: FloatImage, mask: Mask) -> PhotographedError:
        matrix = self.calibrated.calibration.camera_to_xyz
        return photographed_error(radiance, self.solved.target, matrix, self.solved.exposure, mask)

    def _of_asked(self, radiance: FloatImage, mask: Mask) -> float | None:
        """The median error against what was asked for, where that is in reach; None where nothing is."""
        asked, calibration = self.solved.requested, self.calibrated.calibration
        mask = mask & asked.reachable
        if not mask.any():
            return None
        matrix, white = calibration.camera_to_xyz, self.solved.exposure
        return photographed_error(radiance, asked.target, matrix, white, mask).median

    def _predicted(self, frames: Mapping[str, FloatImage]) -> FloatImage:
        light = self.calibrated.predicted_light(self._in_order(frames))
        return np.asarray(light + self.calibrated.calibration.black, np.float32)

    def _parts(self, frames: Mapping[str, FloatImage]) -> list[FloatImage]:
        """The light of each projector in ``_predicted``."""
        transport, indirect = self.calibrated.transport, self.calibrated.reflected
        direct = [transport.forward_part(n, frame) for n, frame in enumerate(self._in_order(frames))]
        return direct if indirect is None else [one + indirect.forward(one) for one in direct]

    def _in_order(self, frames: Mapping[str, FloatImage]) -> list[FloatImage]:
        return [frames[projector] for projector in self.calibrated.projectors]

    def _see(
        self, frames: Mapping[str, FloatImage], predicted: FloatImage, mask: Mask, number: int
    ) -> list[_SeenResult]:
        """Show ``frames``, ``predicted`` by the transport, and photograph them with each view's camera.

        A view without a photograph that can be used is not corrected. A fault of the first camera, or of a lamp, is
        raised.
        """
        shown = device_frames(self.calibrated.calibration, self._in_order(frames))
        presented_s = self.rig.acquirer.show(self.rig.on_outputs(shown), deadline=self.context.deadline)
        parts, stage, digest, seen = self._parts(frames), self._stage, frames_digest(shown), []
        for name, view in zip(self.calibrated.names, self.calibrated.views(), strict=True):
            of_view = RefinedStage(view.part(stage.black), view.part(stage.white))
            expected = _Expected(view.part(predicted), of_view, view.part(mask), [view.part(part) for part in parts])
            light = view.own_light(predicted)[expected.mask if expected.mask.any() else ...].reshape(-1, 3)
            try:
                taken = self._photograph(self._rig_of(name), name, light, number, presented_s, digest)
            except (DeviceError, WorkError) as error:
                self._raise_if_for_all(error, name)
                one = expected.unseen(error.what)
            else:
                one = expected.judged(taken if view.gain is None else taken.times(view.gain), self._flicker)
            self._tell_if_refused(name, one)
            seen.append(one)
        return seen

    @property
    def _own_view(self) -> str:
        """The view of the rig's own camera."""
        names = self.calibrated.names
        return self.rig.view if self.rig.view in names else names[0]

    def _rig_of(self, view: str) -> Rig:
        """With the camera of a view. Raises WorkError ``camera-no-file`` where that is not there."""
        if view == self._own_view:
            return self.rig
        for other in self.rig.others:
            if other.name == view:
                return self.rig.seen_by(other)
        absent = self.rig.absent.get(view)
        what = "no camera stands there now." if absent is None else absent.what
        raise WorkError(NO_FILE, what=what, remedy="See to the camera, and run the same command again.")

    def _raise_if_for_all(self, error: CodedError, view: str) -> None:
        """Raise what concerns more than the camera of one view that is not the first."""
        of_work = isinstance(error, WorkError) and error.code != NO_FILE
        if isinstance(error, Cancelled) or view == self._own_view or of_work:
            raise error
        self.rig.check_light(deadline=self.context.deadline)

    def _tell_if_refused(self, view: str, seen: _SeenResult) -> None:
        if seen.refused:
            where = f" from view {view}" if len(self.calibrated.names) > 1 else ""
            text = f"A photograph of {self.name}{where} was not used: {seen.refused.removesuffix('.')}."
            self.context.reporter.say(text, Level.WARNING)

    def _joined(self, views: Sequence[ResultPhotograph]) -> ResultPhotograph:
        """One photograph of each view's."""
        images = ([getattr(one, part.name) for one in views] for part in fields(ResultPhotograph))
        return ResultPhotograph(*(self.calibrated.joined(own) for own in images))

    def _photograph(
        self, rig: Rig, view: str, light: FloatImage, number: int, presented_s: float, frames: str
    ) -> ResultPhotograph:
        """Photograph what is shown since ``presented_s`` in HDR with the camera of a view, in its own units.

        ``light`` (pixels, 3): about what it sees; ``frames``: their digest
        """
        n = self.calibrated.names.index(view)
        folder = view_folder(self.context.folder, view) if n else self.context.folder
        folder.mkdir(parents=True, exist_ok=True)
        if folder != self.calibrated.folders[n]:
            inherit_camera(self.calibrated.folders[n], folder)
        available_s, profile = rig.acquirer.exposures_s(), load_profile(folder)
        longest_s = self.options.longest_exposure_s
        wanted_s = speeds(brightest(light), available_s, longest_s, profile, light=light, shorter=2)
        with Journal(folder) if n else contextlib.nullcontext(self.context.journal) as journal:
            taken = take_bracket(
                rig, replace(self.context, folder=folder, journal=journal), StepKind.REFINE, f"{number}-{self.name}",
                (*wanted_s, wanted_s[0]), shown_at_s=presented_s, of={"frames": frames},
            )  # fmt: skip
        exposures_s = [one.exposure_s for one in taken]
        images = [one.measured() for one in taken]
        noise = taken[0].profile.noise if taken[0].profile is not None else None
        merged = merge_brackets(images, exposures_s, noise=noise)
        first, last = (images[n] / np.float32(exposures_s[n]) for n in (0, -1))
        return ResultPhotograph(merged.radiance, merged.sigma, first, last)


@dataclass(frozen=True, slots=True)
class _Expected:
    """What a view should see, by the model, in the units of all views.

    ``light`` (rows, columns, 3), of which each projector gives one of ``parts``; ``mask``: where it is judged
    """

    light: FloatImage
    stage: RefinedStage
    mask: Mask
    parts: Sequence[FloatImage]

    def unseen(self, why: str) -> _SeenResult:
        """Without a photograph."""
        nothing = ResultPhotograph(*(np.full_like(self.light, np.nan),) * 4)
        return _SeenResult(nothing, nothing, np.zeros_like(self.mask), why)

    def judged(self, taken: ResultPhotograph, flicker: Sequence[float]) -> _SeenResult:
        """What of a photograph counts; ``flicker`` of each projector."""
        trusted = trusted_pixels(taken, self.light, self.stage, self.mask, self.parts)
        refused = refusal(taken, self.light, self.stage, self.mask, trusted)
        if refused:
            return replace(self.unseen(refused), taken=taken)
        steady = without_flicker(taken, self.light, self.parts, self.stage, trusted, flicker)
        return _SeenResult(taken, steady, trusted, "")


@dataclass(frozen=True, slots=True)
class _SeenResult:
    """What a view's photograph of a result says, in the units of all views.

    ``taken``, and ``steady``: without flicker; both NaN where there is nothing
    ``trusted`` (rows, columns): its pixels that count; ``refused``: why none does, else ""
    """

    taken: ResultPhotograph
    steady: ResultPhotograph
    trusted: Mask
    refused: str


def _keep(calibrated: Calibrated, name: str, options: RefineOptions, context: Context) -> Sequence[Path]:
    found = Refining.read(context.folder, name, options.last, calibrated.projectors)
    figures = _figures(found, options.photographs)
    linear = [found.frames[projector] for projector in calibrated.projectors]
    frames = device_frames(calibrated.calibration, linear)
    context.reporter.say(sentence(name, figures), Level.INFO if figures["before"] is not None else Level.WARNING)
    paths = [write_refined(folder, name, frames, found.frames, figures) for folder in calibrated.folders]
    return [path for of_view in paths for path in of_view]


def _figures(found: Refining, asked: int) -> dict[str, Any]:
    """What is reported: ``before`` and ``after``, medians of CIEDE2000 in the first and the last photograph kept.

    They are against what was aimed at; ``asked_before`` and ``asked_after`` against what was asked for.
    """
    kept = [row for row in found.photographs if "refused" not in row and row.get("kept", True)] or [{}]
    medians = {name: kept[n].get(key) for n, key, name in (
        (0, "delta_e00_median", "before"), (-1, "delta_e00_median", "after"),
        (0, "asked_median", "asked_before"), (-1, "asked_median", "asked_after"))}  # fmt: skip
    return {"asked": asked, **medians, "ended": found.ended, "photographs": list(found.photographs)}


def sentence(name: str, figures: Mapping[str, Any]) -> str:
    """What was achieved, in one line."""
    count = len(figures["photographs"])
    photographs = f"{count} photograph{'s' * (count != 1)}"
    if figures["before"] is None:
        return f"{name} was not refined: no photograph could be used ({photographs})."
    if count == 1 and figures["ended"]:
        return f"{name} needed no refinement: {figures['before']:.2f} (CIEDE2000 median), {photographs}."
    if count > 1 and all("refused" in row or not row.get("kept", True) for row in figures["photographs"][1:]):
        return f"{name} stays as it was: no photograph confirmed a correction ({photographs})."
    change = f"{figures['before']:.2f} to {figures['after']:.2f} (CIEDE2000 median)"
    return f"Refined {name}: {change}{of_asked(figures)} with {photographs}."


def causes_step(calibrated: Calibrated, names: Sequence[str], photographs: int, *, after: Sequence[StepId]) -> Step:
    """After the refining of these appearances, by at most so many photographs each."""
    return Step(
        StepId(StepKind.CAUSES),
        partial(_look, calibrated, tuple(names), photographs),
        after=tuple(after),
        title="Looking for common causes of the errors",
        weight=0.1,
    )


def _look(calibrated: Calibrated, names: Sequence[str], photographs: int, context: Context) -> Sequence[Path]:
    left = [Refining.read(context.folder, name, photographs, calibrated.projectors) for name in names]
    found = [one.equations for one in left if one.equations is not None and _confirmed(one)]
    causes = common_causes(found, len(calibrated.projectors)) if len(found) > 1 else CommonCauses((), 0.0)
    lines = sentences(causes, calibrated.projectors)
    for text in lines:
        context.reporter.say(text, Level.WARNING)
    rows = [
        {**asdict(cause), "projector": None if cause.projector is None else calibrated.projectors[cause.projector]}
        for cause in causes.causes
    ]
    return [write_causes(context.folder, {"share": causes.share, "causes": rows, "sentences": lines})]


def _confirmed(state: Refining) -> bool:
    """Whether the photograph of the first correction did not deny what led to it: that light may have passed by."""
    return all(row.get("kept", True) and "refused" not in row for row in state.photographs[1:2])


def sentences(found: CommonCauses, projectors: Sequence[str]) -> list[str]:
    """For people: each cause with how to correct the calibration; nothing where there is none."""
    if not found.causes:
        return []
    lines = [f"The appearances have {100 * found.share:.0f} % of their error (squared) in common."]
    for n, name in enumerate(projectors):
        of = [cause for cause in found.causes if cause.projector == n]
        colours = [cause for cause in of if cause.kind == "brightness"]
        if colours:
            darker, brighter = ([one for one in colours if (one.amount > 0) is up] for up in (False, True))
            changed = [
                f"{how} ({_by_colour(some)})" for how, some in (("darker", darker), ("brighter", brighter)) if some
            ]
            lines.append(
                f"Projector {name} is {' and '.join(changed)} than when it was calibrated. `velatura calibrate STAGE "
                "--quick` measures it again."
            )
        lines += [
            f"The response of projector {name} has changed (exponents {100 * cause.amount:+.0f} %). See whether its "
            f"picture mode was changed, or run `velatura calibrate STAGE --projector {name}`."
            for cause in of
            if cause.kind == "response"
        ]
    return lines + _of_all(found.causes)


def _of_all(causes: Sequence[Cause]) -> list[str]:
    lines = []
    for cause in causes:
        if cause.kind == "indirect" and cause.amount > 0:
            lines.append(
                f"{100 * cause.amount:.0f} % of the projectors' light comes back from the object and the room. Cover "
                "pale surfaces; photographs of the results correct the rest."
            )
        elif cause.kind == "indirect":
            lines.append(
                f"{-100 * cause.amount:.0f} % of the projectors' light no longer comes back from the object and the "
                "room. If something pale was taken away or covered, run `velatura calibrate STAGE`."
            )
        elif cause.kind == "focus" and cause.amount > 0:
            lines.append(
                "The pictures are less sharp than the calibration expects. See whether projectors and camera are in "
                "focus, and whether they were when the stage was calibrated; then run `velatura calibrate STAGE`."
            )
        elif cause.kind == "focus":
            lines.append(
                "The pictures are sharper than the calibration expects: something was out of focus when the stage was "
                "calibrated. Run `velatura calibrate STAGE`."
            )
    ambient = [cause for cause in causes if cause.kind == "ambient"]
    if ambient:
        advice = (
            "Make the room as dark as it was, or run `velatura calibrate STAGE`."
            if max(cause.amount for cause in ambient) > 0
            else "Keep the room so dark, and run `velatura calibrate STAGE`."
        )
        lines.append(
            f"The light in the room has changed, in parts of the projectors' light: {_by_colour(ambient)}. {advice}"
        )
    return lines


def _by_colour(causes: Sequence[Cause]) -> str:
    return ", ".join(f"{cause.colour} {100 * cause.amount:+.1f} %" for cause in causes)
