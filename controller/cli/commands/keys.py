"""``velatura keys``."""

from __future__ import annotations

from typing import Annotated

import typer

from controller.cli import console
from controller.cli.running import Json, StageFolder


def keys(
    stage: StageFolder,
    name: Annotated[str, typer.Option(help="Name of the key; its file is STAGE/keys/NAME.key.")] = "stage",
    as_json: Json = False,
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
    console.show_result(made if as_json else text, as_json=as_json)
