"""``velatura camera``: calibrate the camera's lens with a printed board."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console
from controller.cli.running import Json, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter

SUMMARY: Final = "Calibrate the camera's lens with a printed board, once for each lens and zoom setting."

OutFile = Annotated[Path, typer.Option("--out", help="Output file; name it in [camera] of stage.toml.")]


def board(
    out: Annotated[Path, typer.Option(help="Output file (PNG) to print.")] = Path("board.png"), as_json: Json = False
) -> None:
    """Write a ChArUco board to print on A4 or larger, at any scale. Glue the print on a flat plate."""
    from controller.stage.services.camera import board as written

    console.show_result(written(out=out), as_json=as_json)


def calibrate(
    photographs: Annotated[
        list[Path], typer.Argument(metavar="PHOTOS...", help="10 to 15 photographs of the board at different tilts.")
    ],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Compute focal length, principal point and distortion, with uncertainties, from photographs of the board."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.camera import calibrate

        return calibrate(photographs=tuple(photographs), out=out, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def exif(
    photograph: Annotated[Path, typer.Argument(metavar="PHOTO", help="An unedited photograph from the camera.")],
    out: OutFile = Path("camera-intrinsics.toml"),
    as_json: Json = False,
) -> None:
    """Read the focal length from a photograph's EXIF data. This is quicker than the board, but less accurate."""
    from controller.stage.services.camera import from_exif

    console.show_result(from_exif(photograph=photograph, out=out), as_json=as_json)


COMMANDS: Final[tuple[Callable[..., Any], ...]] = (board, calibrate, exif)
