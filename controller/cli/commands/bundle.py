"""``velatura bundle``: signed files with everything that a kiosk plays."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console
from controller.cli.running import Json, StageFolder, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter

SUMMARY: Final = "Build, sign, check and install bundles. A bundle is one file with everything that a kiosk plays."

BundleFile = Annotated[Path, typer.Argument(metavar="FILE", help="A bundle file (.vel).")]


def _show(found: Mapping[str, Any], *, as_json: bool) -> None:
    """The result. For people, a warning in it goes to standard error, so that a pipe does not hide it."""
    if not as_json and "warning" in found:
        typer.secho(f"WARNING: {found['warning']}", err=True, bold=True, fg="red")
        found = {key: value for key, value in found.items() if key != "warning"}
    console.show_result(found, as_json=as_json)


def build(
    stage: StageFolder,
    names: Annotated[list[str] | None, typer.Argument(help="Appearances (default: all solved ones).")] = None,
    out: Annotated[Path | None, typer.Option(help="Output file (default: STAGE/bundle.vel).")] = None,
    live: Annotated[bool, typer.Option("--live", help="Include live-mode data (larger).")] = False,
    as_json: Json = False,
) -> None:
    """Write the latest solved appearances to a bundle, signed with the stage's key, with the next revision number."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.bundle import build

        return build(stage=stage, names=tuple(names or ()), out=out, live=live, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


def inspect(file: BundleFile, as_json: Json = False) -> None:
    """Show the content of a bundle. The signature is not checked."""
    from controller.bundle.describe import as_text, describe
    from controller.bundle.reader import Bundle
    from controller.bundle.signing import ANY_SIGNER

    with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
        found = describe(bundle)
    console.show_result(found if as_json else as_text(found), as_json=as_json)


def verify(
    file: BundleFile,
    stage: Annotated[Path | None, typer.Option(help="Check with the keys that this stage trusts.")] = None,
    trusted: Annotated[list[Path] | None, typer.Option(help="A trusted public key file; can be repeated.")] = None,
    as_json: Json = False,
) -> None:
    """Check every byte of a bundle and its signature. --stage or --trusted also checks who signed it."""
    from controller.stage.services.bundle import verify as verified

    _show(verified(file, stage=stage, trusted=tuple(trusted or ())), as_json=as_json)


def diff(
    one: Annotated[Path, typer.Argument(metavar="A", help="A bundle.")],
    other: Annotated[Path, typer.Argument(metavar="B", help="Another.")],
    as_json: Json = False,
) -> None:
    """Show the differences between two bundles: identity, outputs, appearances."""
    from controller.bundle.describe import differences, differences_as_text
    from controller.bundle.reader import Bundle
    from controller.bundle.signing import ANY_SIGNER

    with Bundle.open_trusted(one, ANY_SIGNER) as first, Bundle.open_trusted(other, ANY_SIGNER) as second:
        found = differences(first, second)
    console.show_result(found if as_json else differences_as_text(found), as_json=as_json)


def sign(
    file: BundleFile,
    key: Annotated[Path, typer.Option(help="A secret key file made by `velatura keys`.")],
    as_json: Json = False,
) -> None:
    """Check every byte of a bundle and sign it with this key. An existing signature is replaced."""
    from controller.bundle.signing import load_signing_key
    from controller.bundle.writer import sign_bundle

    signed_by = sign_bundle(file, load_signing_key(key))
    console.show_result({"file": file, "signed_by": signed_by.hex()}, as_json=as_json)


def install(file: BundleFile, stage: StageFolder, as_json: Json = False) -> None:
    """Install a bundle that the stage trusts. The previous bundle is kept for rollback."""
    from controller.stage.services.bundle import install as installed

    _show(installed(file, stage=stage), as_json=as_json)


def rollback(stage: StageFolder, as_json: Json = False) -> None:
    """Go back to the previously installed bundle."""
    from controller.stage.services.bundle import rollback as rolled_back

    _show(rolled_back(stage), as_json=as_json)


def export(
    file: BundleFile,
    out: Annotated[Path, typer.Option(help="An empty or new folder.")],
    as_json: Json = False,
) -> None:
    """Write every frame as a PNG picture, with an index.json. The signature is not checked."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.bundle import export

        return export(file=file, out=out, reporter=reporter, cancel=cancel)

    work(do, as_json=as_json)


COMMANDS: Final[tuple[Callable[..., Any], ...]] = (
    build,
    inspect,
    verify,
    diff,
    sign,
    install,
    rollback,
    export,
)
