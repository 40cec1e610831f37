"""What comes before a calibration: ``velatura plan``, ``init``, ``doctor`` and ``camera``."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console
from controller.cli.error_reports import DEVICE_FAILED, DONE
from controller.cli.groups import group, stage_folders, work
from controller.core.errors import UsageError

if TYPE_CHECKING:
    from controller.run.progress import Reporter


def plan(
    file: Annotated[
        Path, typer.Argument(metavar="PLAN.toml", help="Plan file: object, projectors, places, requirements.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for plan.html and plan.json (default: the plan file's folder).")
    ] = None,
    example: Annotated[bool, typer.Option("--example", help="Only write an example PLAN.toml.")] = False,
) -> None:
    """Plan where the projectors stand. Predicts detail, light, angle of incidence and focus on a mesh of the object."""
    if example:
        from controller.stage.services.plan import write_example

        console.show_result(write_example(file))
        return

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.plan import plan

        return plan(file=file, out=file.parent if out is None else out, reporter=reporter, cancel=cancel)

    work(do)


def init(
    stage: Annotated[Path, typer.Argument(metavar="STAGE", help="The folder to set up; created if missing.")],
    name: Annotated[str | None, typer.Option(help="Name of the object (default: you are asked).")] = None,
    focal_length_px: Annotated[
        float | None, typer.Option(help="Focal length in pixels of the camera picture.", min=1.0)
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask no questions; use the devices found.")] = False,
) -> None:
    """Find the devices, and write stage.toml and a signing key."""
    from controller.stage.services.setup import set_up

    def ask(question: str, suggestion: str) -> str:
        return suggestion if yes or console.as_json() else str(typer.prompt(question, default=suggestion))

    done = set_up(stage, name=name, focal_length_px=focal_length_px, ask=ask)
    console.show_result(done, "\n".join([*done["words"], f"Written: {done['file']}", f"Next: velatura doctor {stage}"]))


def doctor(
    stage: Annotated[
        Path | None,
        typer.Argument(
            metavar="[STAGE]",
            help="The stage's folder (without it: only list connected devices).",
            autocompletion=stage_folders,
        ),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write the devices found to STAGE/stage.toml.")] = False,
    outputs: Annotated[
        bool, typer.Option("--outputs", help="Switch the lamps on and find which output each projector shows.")
    ] = False,
    network: Annotated[
        str,
        typer.Option(
            "--network",
            metavar="INTERFACE",
            help="Also search for projectors on this network interface (such as eth0), or on all. Without it, "
            "nothing is sent except to the stage's own devices.",
        ),
    ] = "",
) -> int:
    """Test the devices with all lamps off, and tell what to repair."""
    from controller.run.signals import cancelled_by_signals
    from controller.stage.doctor.examine import examine
    from controller.stage.doctor.outputs import examine_outputs

    if stage is None and (write or outputs):
        raise UsageError(
            "stage-missing", what="No stage was given.", remedy="Give the folder of stage.toml, existing or new."
        )
    with cancelled_by_signals() as cancel, console.reporter() as reporter:
        examined = examine(stage=stage, write_it=write, reporter=reporter, cancel=cancel, network=network)
        if outputs and stage is not None:
            examined = examine_outputs(examined, stage=stage, reporter=reporter, cancel=cancel)
    console.show_result(examined.as_json(), examined.as_text())
    return DONE if examined.healthy else DEVICE_FAILED


IntrinsicsFile = Annotated[Path, typer.Option("--out", help="Output file; name it in [camera] of stage.toml.")]


def board(out: Annotated[Path, typer.Option(help="Output file (PNG) to print.")] = Path("board.png")) -> None:
    """Write a ChArUco board to print on A4 or larger, at any scale. Glue the print on a flat plate."""
    from controller.stage.services.camera import board as written

    console.show_result(written(out=out))


def calibrate(
    photographs: Annotated[
        list[Path], typer.Argument(metavar="PHOTOS...", help="10 to 15 photographs of the board at different tilts.")
    ],
    out: IntrinsicsFile = Path("camera-intrinsics.toml"),
) -> None:
    """Compute focal length, principal point and distortion, with uncertainties, from photographs of the board."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.camera import calibrate

        return calibrate(photographs=tuple(photographs), out=out, reporter=reporter, cancel=cancel)

    work(do)


def exif(
    photograph: Annotated[Path, typer.Argument(metavar="PHOTO", help="An unedited photograph from the camera.")],
    out: IntrinsicsFile = Path("camera-intrinsics.toml"),
) -> None:
    """Read the focal length from a photograph's EXIF data. This is quicker than the board, but less accurate."""
    from controller.stage.services.camera import from_exif

    console.show_result(from_exif(photograph=photograph, out=out))


CAMERA: Final = group(
    "camera",
    "Calibrate the camera's lens with a printed board. Do it once for each lens and zoom setting.",
    {"Commands": (board, calibrate, exif)},
)
