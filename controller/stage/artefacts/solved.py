"""Files of solves in a run's folder: the base image, rendered targets, appearances.

The solver is imported only to read its values, because the kiosk looks for files while it plays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask, load_arrays, save_arrays
from controller.core.errors import UsageError, WorkError
from controller.core.storage import sha256_of
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, npz_path, read_json, stem, write_json

if TYPE_CHECKING:
    from controller.optics.solve.bounded.equations import Solution
    from controller.optics.solve.result.refinement import ModelError
    from controller.optics.solve.targets.values import Target

_SOLUTION = ("objective", "kkt", "iterations", "seconds", "converged")


DIFFERS: Final = "differs"
"""The name of ``Solved.differs`` in the file."""


@dataclass(frozen=True, slots=True)
class SolvedBase:
    """``base.npz`` and ``base.json``: the image (camera rows, columns, 3) and the frames that show it.

    ``solution.frames``: (rows, columns, 3) linear light in [0, 1] of each projector
    """

    image: FloatImage
    solution: Solution

    def write(self, run: Path, projectors: Sequence[str]) -> list[Path]:
        """``projectors``: in the order of the solution's frames."""
        frames = dict(zip((f"frame-{name}" for name in projectors), self.solution.frames, strict=True))
        arrays = npz_path(run, StepKind.BASE)
        save_arrays(arrays, {"image": self.image, **frames})
        figures = {key: getattr(self.solution, key) for key in _SOLUTION}
        return [arrays, write_json(json_path(run, StepKind.BASE), figures)]

    @classmethod
    def read(cls, run: Path, projectors: Sequence[str]) -> Self:
        """The frames in the order of ``projectors``."""
        from controller.optics.solve.bounded.equations import Solution

        arrays = load_arrays(npz_path(run, StepKind.BASE))
        frames = tuple(arrays[f"frame-{name}"] for name in projectors)
        return cls(arrays["image"], Solution(frames=frames, **read_base_figures(run)))


def has_base(run: Path) -> bool:
    """Whether the base image was solved."""
    return json_path(run, StepKind.BASE).exists()


def read_base_figures(run: Path) -> Any:
    """Figures of the base image's solve: objective, KKT residual, iterations, seconds, converged."""
    return read_json(json_path(run, StepKind.BASE))


def render_folder(run: Path, name: str) -> Path:
    """The folder of Blender's files for an appearance's target."""
    return run / f"render-{name}"


def write_target(run: Path, name: str, target: Target) -> Path:
    """``target-NAME.npz``: a rendered target's picture, like reflectance, and the mask of its valid pixels."""
    path = npz_path(run, StepKind.TARGET, name)
    save_arrays(path, {"image": target.image, "mask": target.mask})
    return path


def read_target(run: Path, name: str) -> Target:
    """The content of ``write_target``."""
    from controller.optics.solve.targets.values import Target

    arrays = load_arrays(npz_path(run, StepKind.TARGET, name))
    return Target(np.asarray(arrays["image"], np.float32), np.asarray(arrays["mask"], np.bool_))


@dataclass(frozen=True, slots=True)
class Registered:
    """``registration-NAME.json`` and ``.npz``: how a restoration's picture lies on the object.

    ``about``: what it depends on; ``figures``: turned_degrees, residual_px and residual_px_p95 (camera pixels, None
    where nothing can be measured), by_points, matched_share of the picture's place, ``carried`` (views that it was
    carried to by the shape), and what ``with_less_light`` gives
    ``residual_px`` (rows, columns) float16: NaN where it can't be measured
    """

    about: Mapping[str, str]
    figures: Mapping[str, Any]
    residual_px: npt.NDArray[np.float16]

    def write(self, run: Path, name: str) -> Sequence[Path]:
        arrays, figures = (path(run, "registration", name) for path in (npz_path, json_path))
        save_arrays(arrays, {"residual_px": self.residual_px})
        return [arrays, write_json(figures, {"about": dict(self.about), **self.figures})]

    @classmethod
    def read(cls, run: Path, name: str) -> Registered | None:
        """None without one, or with a damaged one."""
        try:
            figures = read_json(json_path(run, "registration", name))
            return cls(figures.pop("about"), figures, load_arrays(npz_path(run, "registration", name))["residual_px"])
        except (OSError, ValueError, KeyError, AttributeError, UsageError):
            return None


@dataclass(frozen=True, slots=True)
class RequestedTarget:
    """A target as it was asked for: radiance (rows, columns, 3); where it is reachable, and where it says something."""

    target: FloatImage
    reachable: Mask
    valid: Mask


@dataclass(frozen=True, slots=True)
class Solved:
    """``appearance-NAME.npz`` and ``.json``: an appearance's frames, its target, and the mask where it is reachable.

    ``frames``: 8-bit device frames by projector name, (rows, columns, 3)
    ``linear``: the same before dithering, linear light in [0, 1]
    ``target`` (camera rows, columns, 3): radiance in full scales per second; ``reachable`` (camera rows, columns)
    ``figures``: of the solve (docs/reference/report.md); ``exposure`` is the radiance of the target's white
    ``asked``: before any adaptation; None where this is ``target``
    ``differs`` (camera rows, columns): by how much other views ask for something else there, CIEDE2000, or NaN
    """

    frames: dict[str, ByteImage]
    linear: dict[str, FloatImage]
    target: FloatImage
    reachable: Mask
    figures: dict[str, object]
    asked: RequestedTarget | None = None
    differs: FloatImage | None = None

    @property
    def exposure(self) -> float:
        return float(str(self.figures["exposure"]))

    @property
    def requested(self) -> RequestedTarget:
        """What results are judged by; of a run from before adaptation was recorded, all pixels say something."""
        if self.asked is not None:
            return self.asked
        return RequestedTarget(self.target, self.reachable, np.ones_like(self.reachable))

    def seen(self, part: Callable[[Any], Any], gain: FloatImage | None) -> Self:
        """The same for one of several views, in its own units; both: as of ``calibrated.View``."""
        if gain is None:
            return self
        asked = self.asked
        if asked is not None:
            asked = RequestedTarget(part(asked.target) / gain, part(asked.reachable), part(asked.valid))
        figures = {**self.figures, "exposure": self.exposure / float(gain.mean())}
        target, differs = part(self.target) / gain, None if self.differs is None else part(self.differs)
        reachable = part(self.reachable)
        return replace(self, target=target, reachable=reachable, asked=asked, figures=figures, differs=differs)

    def write(self, run: Path, name: str) -> list[Path]:
        frames = {**_named("device", self.frames), **_named("linear", self.linear)}
        arrays = npz_path(run, StepKind.APPEARANCE, name)
        asked = {} if self.asked is None else _named("asked", {
            "target": self.asked.target, "reachable": self.asked.reachable, "valid": self.asked.valid})  # fmt: skip
        if self.differs is not None:
            asked[DIFFERS] = self.differs
        save_arrays(arrays, {**frames, "target": self.target, "reachable": self.reachable, **asked})
        return [arrays, write_json(json_path(run, StepKind.APPEARANCE, name), self.figures)]


def is_solved(run: Path, name: str) -> bool:
    """Whether an appearance has been solved in the run."""
    return npz_path(run, StepKind.APPEARANCE, name).exists() and json_path(run, StepKind.APPEARANCE, name).exists()


def solved_figures_path(run: Path, name: str) -> Path:
    """The file whose bytes identify the frames of an appearance: the refined ones, if there are any."""
    return json_path(run, StepKind.REFINED if _is_refined(run, name) else StepKind.APPEARANCE, name)


def solving_digest(run: Path, name: str) -> str:
    """What identifies the solving of an appearance, whatever refined it. Raises FileNotFoundError."""
    return sha256_of(json_path(run, StepKind.APPEARANCE, name))


def remove_solved(run: Path, name: str) -> None:
    """Remove an appearance from a run."""
    for path in (json_path(run, StepKind.APPEARANCE, name), npz_path(run, StepKind.APPEARANCE, name)):
        path.unlink(missing_ok=True)
    remove_refined(run, name)


def write_refined(
    run: Path, name: str, frames: Mapping[str, ByteImage], linear: Mapping[str, FloatImage], figures: Mapping[str, Any]
) -> list[Path]:
    """``refined-NAME.npz`` and ``.json``: frames that replace those of the present solving, and how they were found."""
    arrays = npz_path(run, StepKind.REFINED, name)
    parts = {**_named("device", frames), **_named("linear", linear)}
    save_arrays(arrays, parts)
    content = {"of": solving_digest(run, name), "refined": dict(figures)}
    return [arrays, write_json(json_path(run, StepKind.REFINED, name), content)]


def remove_refined(run: Path, name: str) -> None:
    """Forget the refined frames of an appearance: those that were solved count again."""
    for path in (json_path(run, StepKind.REFINED, name), npz_path(run, StepKind.REFINED, name)):
        path.unlink(missing_ok=True)


def read_refining(run: Path, name: str) -> Any:
    """The figures of the refined frames (docs/reference/report.md); None where frames are as they were solved."""
    return read_json(json_path(run, StepKind.REFINED, name))["refined"] if _is_refined(run, name) else None


def of_asked(figures: Mapping[str, Any]) -> str:
    """What refining did to the error against what was asked for, for people; "" where it aimed at just that."""
    before, after = figures.get("asked_before"), figures.get("asked_after")
    if before is None or after is None:
        return ""
    of_aim, of_request = (
        f"{one:.2f} to {other:.2f}" for one, other in ((figures["before"], figures["after"]), (before, after))
    )
    return "" if of_request == of_aim else f", {of_request} against what was asked for,"


def _is_refined(run: Path, name: str) -> bool:
    """An appearance that was solved again since has its new frames."""
    path = json_path(run, StepKind.REFINED, name)
    try:
        return (
            bool(read_json(path)["of"] == solving_digest(run, name)) and npz_path(run, StepKind.REFINED, name).exists()
        )
    except (OSError, ValueError, KeyError):
        return False


def _named(prefix: str, frames: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{prefix}-{projector}": frame for projector, frame in frames.items()}


def read_solved(run: Path, name: str, projectors: Sequence[str]) -> Solved:
    """An appearance with its present frames: those that were refined, where there are.

    Raises WorkError("appearance-not-solved") if there is none of that name.
    """
    if not is_solved(run, name):
        raise WorkError(
            "appearance-not-solved",
            what=f"The appearance {name} has not been solved in {run.name}.",
            remedy="Run `velatura appearance` on the stage first.",
        )
    arrays = load_arrays(npz_path(run, StepKind.APPEARANCE, name))
    figures: Mapping[str, object] = read_json(json_path(run, StepKind.APPEARANCE, name))
    target, reachable, asked = arrays["target"], arrays["reachable"], None
    if "asked-target" in arrays:
        asked = RequestedTarget(arrays["asked-target"], arrays["asked-reachable"], arrays["asked-valid"])
    if (refining := read_refining(run, name)) is not None:
        arrays = load_arrays(npz_path(run, StepKind.REFINED, name))
        figures = {**figures, "refined": refining}
    return Solved(
        frames={projector: arrays[f"device-{projector}"] for projector in projectors},
        linear={projector: arrays[f"linear-{projector}"] for projector in projectors},
        target=target,
        reachable=reachable,
        figures=dict(figures),
        asked=asked,
    )


@dataclass(frozen=True, slots=True)
class Refining:
    """``refine.NNN-NAME.npz`` and ``.json``: how far an appearance is after so many photographs of its results.

    ``frames``: to be photographed next, or shown; linear light by projector name
    ``best``: those photographed with the least error, and ``error`` (camera rows, columns) that error, CIEDE2000, NaN
    where not compared; None before the first photograph that counted
    ``photographs``: one row of figures for each; ``ended``: why there are no more, "" while there may be
    ``equations``: what they say of common causes (``solve.common_causes``), added; None before the first that counted
    ``seen``: the model's error by all of them, for the next one; None before the first that counted, and after the last
    """

    frames: dict[str, FloatImage]
    best: dict[str, FloatImage] | None
    error: FloatImage | None
    photographs: tuple[dict[str, Any], ...] = ()
    ended: str = ""
    equations: Float64 | None = None
    seen: ModelError | None = None

    @property
    def promised(self) -> float:
        """By how much the last correction was expected to make the median error smaller (CIEDE2000); 0 before it."""
        row = next((row for row in reversed(self.photographs) if "expected_median" in row), None)
        return 0.0 if row is None else float(row["delta_e00_median"] - row["expected_median"])

    @property
    def is_corrected(self) -> bool:
        """Whether ``frames`` are corrected ones that no photograph has confirmed."""
        best = self.best
        return best is not None and any(not np.array_equal(one, best[name]) for name, one in self.frames.items())

    def write(self, run: Path, name: str, number: int) -> list[Path]:
        arrays = _named("frame", self.frames)
        if self.best is not None and self.error is not None:
            arrays |= {**_named("best", self.best), "error": self.error}
        if self.equations is not None:
            arrays["equations"] = self.equations
        if self.seen is not None:
            arrays |= {"model-error": self.seen.light, "model-sigma": self.seen.sigma}
        path = run / f"{stem(StepKind.REFINE, name, part=number)}.json"
        save_arrays(path.with_suffix(".npz"), arrays)
        return [path.with_suffix(".npz"), write_json(path, {"photographs": self.photographs, "ended": self.ended})]

    @classmethod
    def read(cls, run: Path, name: str, number: int, projectors: Sequence[str]) -> Self:
        from controller.optics.solve.result.refinement import ModelError

        path = run / f"{stem(StepKind.REFINE, name, part=number)}.json"
        arrays, figures = load_arrays(path.with_suffix(".npz")), read_json(path)
        frames = {projector: arrays[f"frame-{projector}"] for projector in projectors}
        error = arrays.get("error")
        best = None if error is None else {projector: arrays[f"best-{projector}"] for projector in projectors}
        recorded = tuple(figures["photographs"]), str(figures["ended"])
        light = arrays.get("model-error")
        seen = None if light is None else ModelError(light, arrays["model-sigma"])
        return cls(frames, best, error, *recorded, arrays.get("equations"), seen)


def write_causes(run: Path, figures: Mapping[str, Any]) -> Path:
    """``causes.json``: why photographs of several appearances err alike (docs/how-to/appearances.md)."""
    return write_json(json_path(run, StepKind.CAUSES), figures)
