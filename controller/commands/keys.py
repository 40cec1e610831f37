"""``velatura keys``."""

from __future__ import annotations

from typing import Annotated

import typer

from controller import console
from controller.commands.running import Json, StageFolder


def keys(
    stage: StageFolder,
    name: Annotated[str, typer.Option(help="The key's file is STAGE/keys/NAME.key.")] = "stage",
    as_json: Json = False,
) -> None:
    """Make the key that signs a stage's bundles, and show the lines for stage.toml that make the stage trust it."""
    from controller.bundle_services import make_key

    made = make_key(stage, name)
    toml = f"[bundle]\ntrusted_keys = [{', '.join(f'{key!r}' for key in made['trusted_keys'])}]".replace("'", '"')
    text = f"The key is {made['key']}: keep it secret. In {stage / 'stage.toml'}, write:\n\n{toml}"
    console.show_result(made if as_json else text, as_json=as_json)
