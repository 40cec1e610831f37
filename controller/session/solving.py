"""The steps from a calibration to frames: transport, the base, and every appearance."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from controller.arrays import ByteImage, FloatImage, Mask, load_arrays, save_arrays
from controller.calibrate.values import Calibration
from controller.capture.patterns import Pattern, PatternKind, plan_patterns
from controller.errors import UsageError, WorkError
from controller.session import costs
from controller.session.calibrating import read_calibration
from controller.session.edging import edged
from controller.session.progress import Level
from controller.session.runner import Context, Step
from controller.solve.appearance import Base, BaseChoice, base_image, prepare_base, solve_base
from controller.solve.bounded import Solution
from controller.solve.dither import to_device
from controller.solve.drive import Drive
from controller.solve.request import Answer, SolveOptions, answer
from controller.solve.targets import Target
from controller.storage import write_atomically
from controller.transport import LightTransport


@dataclass(frozen=True, slots=True)
class Wish:
    """An appearance to be made: ``target`` gives its picture, reflectance-like, and where it says something.

    ``inputs`` are the hashes of what the target is made from; ``prepare``, where there is one, is a step's work before
    the solving, for targets that take long, and ``prepare_s`` what it costs.
    """

    name: str
    title: str
    target: Callable[[], Target]
    inputs: dict[str, str]
    prepare: Callable[[Context], Sequence[Path]] | None = None
    prepare_s: float = 0.0


def base_choice(name: str) -> BaseChoice:
    """The base image that a person typed. Raises UsageError("base-unknown")."""
    known: tuple[BaseChoice, ...] = get_args(BaseChoice)
    for choice in known:
        if choice == name:
            return choice
    raise UsageError(
        "base-unknown", what=f"There is no base image called {name}.", remedy=f"Choose one of {', '.join(known)}."
    )


class Calibrated:
    """The calibration of a run and its transport, read when they are first needed and kept while steps need them."""

    def __init__(self, folder: Path, projectors: Sequence[str]) -> None:
        self.folder = folder
        self.projectors = tuple(projectors)
        self._calibration: Calibration | None = None
        self._transport: LightTransport | None = None
        self._base: Base | None = None
        self._drive: Drive | None = None

    @property
    def camera_px(self) -> tuple[int, int] | None:
        """(width, height) of the camera's picture; None before the geometry is known."""
        figures = self.folder / "geometry.json"
        if not figures.exists():
            return None
        width, height = json.loads(figures.read_text())["camera"]["size_px"]
        return int(width), int(height)

    @property
    def calibration(self) -> Calibration:
        if self._calibration is None:
            self._calibration = read_calibration(self.folder, self.projectors)
        return self._calibration

    @property
    def transport(self) -> LightTransport:
        if self._transport is None:
            self._transport = edged(LightTransport.build(self.calibration), self.folder)
        return self._transport

    @property
    def base(self) -> Base:
        """The solved base image. Read from ``base.npz``, which the step ``base`` wrote."""
        if self._base is None:
            arrays = load_arrays(self.folder / "base.npz")
            figures = json.loads((self.folder / "base.json").read_text())
            solution = Solution(
                frames=tuple(arrays[f"frame-{name}"] for name in self.projectors), light=arrays["light"], **figures
            )
            self._base = prepare_base(self.transport, arrays["image"], self.calibration.black, solution)
        return self._base

    @property
    def drive(self) -> Drive:
        if self._drive is None:
            self._drive = Drive(self.transport)
        return self._drive

    def keep_base(self, base: Base) -> None:
        self._base = base


def solve_steps(
    calibrated: Calibrated,
    wishes: Sequence[Wish],
    options: SolveOptions,
    after: Sequence[str],
    scale: float = 1.0,
    *,
    answering: Answering | None = None,
) -> list[Step]:
    """Solve the base, then each wish.

    ``after``: the steps whose artefacts are read; ``scale``: the stage's size, see ``session.costs``; ``answering``
    makes the appearances elsewhere.
    """
    steps = [
        Step(
            "base",
            partial(_solve_base, calibrated, options),
            inputs=options.base_inputs(),
            after=tuple(after),
            title="Solving the base image",
            weight=costs.BASE_S * scale,
        ),
    ]
    for wish in wishes:
        before = (*after, "base")
        if wish.prepare is not None:
            steps.append(
                Step(
                    f"target-{wish.name}",
                    wish.prepare,
                    inputs=wish.inputs,
                    after=tuple(after),
                    title=f"Rendering {wish.title}",
                    weight=wish.prepare_s * scale,
                )
            )
            before = (*before, f"target-{wish.name}")
        steps.append(
            Step(
                f"appearance-{wish.name}",
                partial(_solve_appearance, calibrated, wish, options, answering),
                inputs={**options.inputs(), **wish.inputs},
                after=before,
                title=f"Solving {wish.title}",
                weight=costs.APPEARANCE_S * scale,
            )
        )
    return steps


def random_pattern(size_px: tuple[int, int]) -> Pattern:
    """The pattern on which a calibration is graded."""
    return plan_patterns(size_px).of_kind(PatternKind.RANDOM)[0]


def _solve_base(calibrated: Calibrated, options: SolveOptions, context: Context) -> Sequence[Path]:
    black = calibrated.calibration.black
    image = base_image(calibrated.calibration, "white" if options.base == "high-pass" else options.base)
    base = solve_base(
        calibrated.transport, image, black, smoothness=options.smoothness, progress=_watched(context)
    )  # fmt: skip
    calibrated.keep_base(base)
    solution = base.solution
    arrays, path = context.folder / "base.npz", context.folder / "base.json"
    frames = {f"frame-{name}": values for name, values in zip(calibrated.projectors, solution.frames, strict=True)}
    save_arrays(arrays, {"image": image, "light": solution.light, **frames})
    figures = {key: getattr(solution, key) for key in ("objective", "kkt", "iterations", "seconds", "converged")}
    write_atomically(path, json.dumps(figures, indent=1).encode())
    return [arrays, path]


def _watched(context: Context) -> Callable[[int, float], None]:
    """Tells the run how far a solve is, whose end is not known; a stop takes hold in it."""

    def progress(iteration: int, kkt: float) -> None:
        context.advance(1 - 1 / (1 + iteration / 60), f"iteration {iteration}")

    return progress


Answering = Callable[[Wish, SolveOptions, Context], Answer]
"""Makes an appearance, here or elsewhere."""


def _answer_here(calibrated: Calibrated, wish: Wish, options: SolveOptions, context: Context) -> Answer:
    return answer(
        calibrated.transport,
        calibrated.base,
        calibrated.calibration.black,
        wish.target(),
        options,
        drive=calibrated.drive,
        progress=_watched(context),
    )


def _solve_appearance(
    calibrated: Calibrated, wish: Wish, options: SolveOptions, answering: Answering | None, context: Context
) -> Sequence[Path]:
    began_s = time.perf_counter()
    made = (answering or partial(_answer_here, calibrated))(wish, options, context)
    device = device_frames(calibrated.calibration, made.frames)
    arrays = context.folder / f"appearance-{wish.name}.npz"
    linear = {f"linear-{name}": values for name, values in zip(calibrated.projectors, made.frames, strict=True)}
    save_arrays(arrays, {**device, **linear, "target": made.target, "reachable": made.reachable})
    if made.figures["advice"] is not None:
        context.reporter.say(f"{wish.title}: {made.figures['advice']}", Level.WARNING)
    figures = {
        "name": wish.name,
        "title": wish.title,
        **made.figures,
        "seconds_with_target": time.perf_counter() - began_s,
    }
    path = context.folder / f"appearance-{wish.name}.json"
    write_atomically(path, json.dumps(figures, indent=1).encode())
    return [arrays, path]


def device_frames(calibration: Calibration, frames: Sequence[FloatImage]) -> dict[str, ByteImage]:
    """8-bit frames by projector name, dithered, each projector at another place of the dither's tile."""
    return {
        part.name: to_device(values, part.radiometry, phase=(17 * n, 29 * n))
        for n, (part, values) in enumerate(zip(calibration.projectors, frames, strict=True))
    }


@dataclass(frozen=True, slots=True)
class Solved:
    """What an appearance step left: device frames by projector, the target radiance, and where it is reachable."""

    frames: dict[str, ByteImage]
    target: FloatImage
    reachable: Mask
    exposure: float
    figures: dict[str, object]


def read_solved(folder: Path, name: str, projectors: Sequence[str]) -> Solved:
    """Raises WorkError("appearance-not-solved") if there is none of that name."""
    arrays, figures = folder / f"appearance-{name}.npz", folder / f"appearance-{name}.json"
    if not (arrays.exists() and figures.exists()):
        raise WorkError(
            "appearance-not-solved",
            what=f"The appearance {name} has not been solved in {folder.name}.",
            remedy="Run `velatura appearance` on the stage first.",
        )
    loaded, content = load_arrays(arrays), json.loads(figures.read_text())
    frames = {projector: loaded[projector] for projector in projectors}
    return Solved(frames, loaded["target"], loaded["reachable"], float(content["exposure"]), content)


__all__ = ["Calibrated", "SolveOptions", "Solved", "Wish", "device_frames", "read_solved", "solve_steps"]
