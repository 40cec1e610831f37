"""``velatura calibrate``, ``drift``, ``report`` and ``export``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from controller.cli import console
from controller.cli.groups import StageFolder, projector_names, work
from controller.core.errors import UsageError
from controller.stage.exchange.formats import FORMATS

if TYPE_CHECKING:
    from controller.run.progress import Reporter

AcceptGrade = Annotated[
    bool, typer.Option("--accept-grade", help="Accept a calibration below the grade in stage.toml.")
]
FormatName = Literal[
    "glb", "ply", "blender", "usd", "colmap", "colmap-binary", "opencv", "st-maps", "mpcdi", "transport", "dataset",
    "uv",
]  # fmt: skip
RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="A run's folder (STAGE/runs/...), or a stage for its newest run.")
]


@dataclass(frozen=True, slots=True)
class PatternChoice:
    """Which patterns a calibration photographs."""

    mode: Annotated[
        Literal["fast", "paper"],
        typer.Option(help="fast: sinusoids; paper: dots."),
    ] = "fast"
    dot_spacing: Annotated[
        str | None, typer.Option(help='Projector pixels between dots, or "auto" (from the blur).')
    ] = None
    photographs: Annotated[
        Literal["full", "few", "fewest"] | None,
        typer.Option(
            help="full; few (white instead of opposite pictures, code in colours); fewest (few, and no code where "
            "nothing moved). Default: from stage.toml."
        ),
    ] = None


def calibrate(
    stage: StageFolder,
    patterns: PatternChoice,
    quick: Annotated[bool, typer.Option("--quick", help="Redo only what changed since the last calibration.")] = False,
    projector: Annotated[
        str | None, typer.Option(help="Recalibrate only this projector.", autocompletion=projector_names)
    ] = None,
    view: Annotated[
        str | None, typer.Option(help="Photograph only from this place, and add it to the newest calibration.")
    ] = None,
    accept_grade: AcceptGrade = False,
) -> None:
    """Photograph patterns, and calibrate the stage. Continues an unfinished calibration."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.calibrate import calibrate
        from controller.stage.services.recalibrate import recalibrate
        from controller.stage.sessions.session import OwnSession
        from controller.stage.steps.modes import dot_options

        session = OwnSession(stage)
        if view is not None and (quick or projector is not None):
            raise UsageError(
                "view-alone", what="--view photographs everything from one place, so nothing can be left out.",
                remedy="Remove --quick and --projector.",
            )  # fmt: skip
        if quick or projector is not None:
            return recalibrate(
                session=session, accept_grade=accept_grade, projector=projector, photographs=patterns.photographs,
                reporter=reporter, cancel=cancel,
            )  # fmt: skip
        return calibrate(
            session=session, dots=dot_options(patterns.mode, patterns.dot_spacing), photographs=patterns.photographs,
            accept_grade=accept_grade, view=view, reporter=reporter, cancel=cancel,
        )  # fmt: skip

    work(do, stage=stage)


def drift(
    stage: StageFolder,
    skew: Annotated[bool, typer.Option("--skew", help="Measure also how far apart several computers change.")] = False,
) -> None:
    """Check whether anything moved or dimmed since the calibration. Takes a few photographs."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.recalibrate import check_drift
        from controller.stage.sessions.session import OwnSession

        return check_drift(
            session=OwnSession(stage), details=console.as_json(), reporter=reporter, cancel=cancel, skew=skew
        )

    work(do, stage=stage)


def report(
    run: RunFolder,
    out: Annotated[Path | None, typer.Option(help="Folder for the report (default: the run's folder).")] = None,
) -> None:
    """Write the report of a run again. The run is a calibration, photographs of appearances, or a demo."""
    from controller.stage.services.report import report_of

    console.show_result(report_of(run, out))


def export(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="Folder of a finished calibration (STAGE/runs/...), a stage for its newest one, or for transport a "
            "folder of pairs of pictures.",
        ),
    ],
    kind: Annotated[
        FormatName, typer.Option("--format", help="; ".join(f"{one.name}: {one.what}" for one in FORMATS) + ".")
    ] = "glb",
    out: Annotated[Path | None, typer.Option(help="Output file or folder (default: in the run's folder).")] = None,
    step: Annotated[
        int | None, typer.Option(help="Use every n-th camera pixel (default: at most 10^6 pixels).", min=1)
    ] = None,
    crop: Annotated[
        str | None, typer.Option(help="For transport: only X,Y,WIDTH,HEIGHT of the camera's picture.")
    ] = None,
    uv: Annotated[bool, typer.Option("--uv", help="Short for --format uv.")] = False,
) -> None:
    """Export a calibration for other programs. It has the object, views, warps, or the light transport."""
    from controller.stage.services.export import export as written

    console.show_result(written(run=run, kind="uv" if uv else kind, out=out, step=step, crop=crop))


def register(
    stage: StageFolder,
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="The object's mesh: OBJ, glTF (.glb), PLY or STL.")],
    unit: Annotated[
        Literal["mm", "cm", "m", "inch"] | None, typer.Option(help="Unit of the file's numbers (default: guessed).")
    ] = None,
    pairs: Annotated[
        Path | None, typer.Option(help="Pairs of points, where the mesh does not find its place by itself (JSON).")
    ] = None,
    limit: Annotated[
        float | None,
        typer.Option(
            help="Millimetres that mesh and object may differ (default: 2 % of the object's size).", min=0.001
        ),
    ] = None,
    fill: Annotated[
        bool, typer.Option("--fill", help="Take the shape from the mesh where no two projectors measured it.")
    ] = False,
) -> None:
    """Lay a known mesh on the calibrated object. Textures are painted on it, and it can fill what was not measured."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.register import MeshOrder, register

        order = MeshOrder(mesh, unit, pairs, limit, fill)
        return register(stage, order, reporter)

    work(do, stage=stage)
