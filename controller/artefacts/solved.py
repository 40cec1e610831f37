"""Files of solves in a run's folder: the base image, rendered targets, appearances.

The solver is imported only to read its values, because the kiosk looks for files while it plays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from controller.artefacts.kinds import StepKind
from controller.artefacts.names import json_path, npz_path, read_json, write_json
from controller.core.arrays import ByteImage, FloatImage, Mask, load_arrays, save_arrays
from controller.core.errors import WorkError

if TYPE_CHECKING:
    from controller.solve.bounded.solver import Solution
    from controller.solve.targets.values import Target

_SOLUTION = ("objective", "kkt", "iterations", "seconds", "converged")


@dataclass(frozen=True, slots=True)
class SolvedBase:
    """``base.npz`` and ``base.json``: the image (camera rows, columns, 3), linear light, and the frames that show it.

    ``solution.frames``: (rows, columns, 3) linear light in [0, 1] of each projector
    """

    image: FloatImage
    solution: Solution

    def write(self, run: Path, projectors: Sequence[str]) -> list[Path]:
        """``projectors``: in the order of the solution's frames."""
        frames = dict(zip((f"frame-{name}" for name in projectors), self.solution.frames, strict=True))
        arrays = npz_path(run, StepKind.BASE)
        save_arrays(arrays, {"image": self.image, "light": self.solution.light, **frames})
        figures = {key: getattr(self.solution, key) for key in _SOLUTION}
        return [arrays, write_json(json_path(run, StepKind.BASE), figures)]

    @classmethod
    def read(cls, run: Path, projectors: Sequence[str]) -> Self:
        """The frames in the order of ``projectors``."""
        from controller.solve.bounded.solver import Solution

        arrays = load_arrays(npz_path(run, StepKind.BASE))
        frames = tuple(arrays[f"frame-{name}"] for name in projectors)
        return cls(arrays["image"], Solution(frames=frames, light=arrays["light"], **read_base_figures(run)))


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
    from controller.solve.targets.values import Target

    arrays = load_arrays(npz_path(run, StepKind.TARGET, name))
    return Target(np.asarray(arrays["image"], np.float32), np.asarray(arrays["mask"], np.bool_))


@dataclass(frozen=True, slots=True)
class Solved:
    """``appearance-NAME.npz`` and ``.json``: an appearance's frames, its target, and the mask where it is reachable.

    ``frames``: 8-bit device frames by projector name, (rows, columns, 3)
    ``linear``: the same before dithering, linear light in [0, 1]
    ``target`` (camera rows, columns, 3): radiance in full scales per second; ``reachable`` (camera rows, columns)
    ``figures``: of the solve (docs/reference/report.md); ``exposure`` is the radiance of the target's white
    """

    frames: dict[str, ByteImage]
    linear: dict[str, FloatImage]
    target: FloatImage
    reachable: Mask
    figures: dict[str, object]

    @property
    def exposure(self) -> float:
        return float(str(self.figures["exposure"]))

    def write(self, run: Path, name: str) -> list[Path]:
        frames = {f"device-{projector}": frame for projector, frame in self.frames.items()}
        linear = {f"linear-{projector}": frame for projector, frame in self.linear.items()}
        arrays = npz_path(run, StepKind.APPEARANCE, name)
        save_arrays(arrays, {**frames, **linear, "target": self.target, "reachable": self.reachable})
        return [arrays, write_json(json_path(run, StepKind.APPEARANCE, name), self.figures)]


def is_solved(run: Path, name: str) -> bool:
    """Whether an appearance has been solved in the run."""
    return npz_path(run, StepKind.APPEARANCE, name).exists() and json_path(run, StepKind.APPEARANCE, name).exists()


def solved_figures_path(run: Path, name: str) -> Path:
    """The file whose bytes identify a solve of an appearance."""
    return json_path(run, StepKind.APPEARANCE, name)


def remove_solved(run: Path, name: str) -> None:
    """Remove an appearance from a run."""
    for path in (json_path(run, StepKind.APPEARANCE, name), npz_path(run, StepKind.APPEARANCE, name)):
        path.unlink(missing_ok=True)


def read_solved(run: Path, name: str, projectors: Sequence[str]) -> Solved:
    """Raises WorkError("appearance-not-solved") if there is none of that name."""
    if not is_solved(run, name):
        raise WorkError(
            "appearance-not-solved",
            what=f"The appearance {name} has not been solved in {run.name}.",
            remedy="Run `velatura appearance` on the stage first.",
        )
    arrays = load_arrays(npz_path(run, StepKind.APPEARANCE, name))
    figures: Mapping[str, object] = read_json(json_path(run, StepKind.APPEARANCE, name))
    # Runs from before journal format 2 have the frames by the projectors' names only.
    prefix = "device-" if all(f"device-{projector}" in arrays for projector in projectors) else ""
    return Solved(
        frames={projector: arrays[f"{prefix}{projector}"] for projector in projectors},
        linear={projector: arrays[f"linear-{projector}"] for projector in projectors},
        target=arrays["target"],
        reachable=arrays["reachable"],
        figures=dict(figures),
    )
