"""``velatura bundle``: signed files with everything that a kiosk plays."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from controller.cli import console
from controller.cli.groups import StageFolder, appearance_names, group, stage_folders, work

if TYPE_CHECKING:
    from controller.run.progress import Reporter

BundleFile = Annotated[Path, typer.Argument(metavar="FILE", help="A bundle file (.vel).")]


def _show(result: Mapping[str, Any]) -> None:
    """The result. For people, a warning in it goes to standard error, so that a pipe does not hide it."""
    if not console.as_json() and "warning" in result:
        typer.secho(f"WARNING: {result['warning']}", err=True, bold=True, fg="red")
        result = {key: value for key, value in result.items() if key != "warning"}
    console.show_result(result)


def key(
    stage: StageFolder,
    name: Annotated[str, typer.Option(help="Name of the key; its file is STAGE/keys/NAME.key.")] = "stage",
) -> None:
    """Make a key to sign the stage's bundles, and show the lines for stage.toml to trust it."""
    from controller.stage.services.bundle import make_key

    made = make_key(stage, name)
    listed = ", ".join(f'"{key}"' for key in made["trusted_keys"])
    # A second table of the same name is not TOML.
    table = "[bundle]\n" if made["where"] == "add a table [bundle]" else ""
    text = (
        f"The key is {made['key']}: keep it secret. In {stage / 'stage.toml'}, {made['where']}:\n\n"
        f"{table}trusted_keys = [{listed}]"
    )
    console.show_result(made, text)


def build(
    stage: StageFolder,
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Appearances (default: all solved ones).", autocompletion=appearance_names),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output file (default: STAGE/bundle.vel).")] = None,
    live: Annotated[bool, typer.Option("--live", help="Include live-mode data (larger).")] = False,
) -> None:
    """Write the latest solved appearances to a bundle, signed with the stage's key, with the next revision number."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.bundle import build

        return build(stage=stage, names=tuple(names or ()), out=out, live=live, reporter=reporter, cancel=cancel)

    work(do)


def inspect(file: BundleFile) -> None:
    """Show the content of a bundle. The signature is not checked."""
    from controller.bundle.describe import as_text, describe
    from controller.bundle.reader import Bundle
    from controller.bundle.signing import ANY_SIGNER

    with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
        described = describe(bundle)
    console.show_result(described, as_text(described))


def verify(
    file: BundleFile,
    stage: Annotated[
        Path | None, typer.Option(help="Check with the keys that this stage trusts.", autocompletion=stage_folders)
    ] = None,
    trusted: Annotated[list[Path] | None, typer.Option(help="A trusted public key file; can be repeated.")] = None,
) -> None:
    """Check every byte of a bundle and its signature. --stage or --trusted also checks who signed it."""
    from controller.stage.services.bundle import verify as verified

    _show(verified(file, stage=stage, trusted=tuple(trusted or ())))


def diff(
    one: Annotated[Path, typer.Argument(metavar="A", help="A bundle.")],
    other: Annotated[Path, typer.Argument(metavar="B", help="Another.")],
) -> None:
    """Show the differences between two bundles: identity, outputs, appearances."""
    from controller.bundle.describe import differences, differences_as_text
    from controller.bundle.reader import Bundle
    from controller.bundle.signing import ANY_SIGNER

    with Bundle.open_trusted(one, ANY_SIGNER) as first, Bundle.open_trusted(other, ANY_SIGNER) as second:
        changes = differences(first, second)
    console.show_result(changes, differences_as_text(changes))


def sign(
    file: BundleFile, key: Annotated[Path, typer.Option(help="A secret key file made by `velatura bundle key`.")]
) -> None:
    """Check every byte of a bundle and sign it with this key. An existing signature is replaced."""
    from controller.bundle.signing import load_signing_key
    from controller.bundle.writer import sign_bundle

    signed_by = sign_bundle(file, load_signing_key(key))
    console.show_result({"file": file, "signed_by": signed_by.hex()})


def install(file: BundleFile, stage: StageFolder) -> None:
    """Install a bundle that the stage trusts. The previous bundle is kept for rollback."""
    from controller.stage.services.bundle import install as installed

    _show(installed(file, stage=stage))


def rollback(stage: StageFolder) -> None:
    """Go back to the previously installed bundle."""
    from controller.stage.services.bundle import rollback as rolled_back

    _show(rolled_back(stage))


def export(file: BundleFile, out: Annotated[Path, typer.Option(help="An empty or new folder.")]) -> None:
    """Write every frame as a PNG picture, with an index.json. The signature is not checked."""

    def do(reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
        from controller.stage.services.bundle import export

        return export(file=file, out=out, reporter=reporter, cancel=cancel)

    work(do)


BUNDLE: Final = group(
    "bundle",
    "Build, sign, check and install bundles. A bundle is one file with everything that a kiosk plays.",
    {"Commands": (key, build, inspect, verify, diff, sign, install, rollback, export)},
)
