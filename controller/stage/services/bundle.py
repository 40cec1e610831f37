"""Operations on bundles: build, check, install, roll back, export; and signing keys."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.bundle import install as slots
from controller.bundle.describe import export_pictures
from controller.bundle.format import Index, valid_name
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, Trust, generate_key, load_public_key, unsigned_warning
from controller.config import Stage, load_stage
from controller.config.loader import FILE
from controller.core.errors import BundleError, UsageError
from controller.run.progress import Reporter
from controller.stage.artefacts.solved import is_solved
from controller.stage.sessions.calibrations import KEY_FILE, output_sizes, signing_key, stage_trust, usable_calibration
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.run import stage_lock
from controller.stage.steps.appearance.publishing import BundleTarget, publish_solved
from hal.deadline import Cancelled
from hal.notices import Level

BUNDLES = "bundles"
"""The stage's folder of installed bundles."""


def build(
    *,
    stage: Path,
    names: Sequence[str],
    out: Path | None,
    reporter: Reporter,
    cancel: threading.Event,
    live: bool = False,
) -> Mapping[str, Any]:
    """Write appearances solved with the latest calibration to a signed bundle, without installing it.

    ``names`` empty: the solved ones of stage.toml, in its order. The revision is one above that of the installed
    bundles, unless one of them is identical. ``live``: include the live-mode data.
    Raises UsageError("not-calibrated", "nothing-solved" or "no-signing-key"), and as ``publish_solved``.
    """
    checked = check_stage(stage)
    folder = checked.stage.folder
    with stage_lock(folder):
        run = usable_calibration(checked, reporter)
        chosen = tuple(dict.fromkeys(names)) or _solved(checked.stage, run)
        path, key = out or folder / "bundle.vel", signing_key(checked)
        reporter.say(f"Writing {len(chosen)} appearances.")
        if key is None:
            reporter.say(_warning(None, stage_trust(checked.stage))["warning"], Level.WARNING)
        name, trust = checked.stage.tables.stage.name, stage_trust(checked.stage)
        target = BundleTarget(folder, name, run.name, output_sizes(checked), key, trust)
        index = publish_solved(path, run, target, chosen, live=live, check=lambda: _check(cancel))
    signed = "not signed" if key is None else str(key)
    return {"file": str(path), "revision": index.revision, "appearances": ", ".join(chosen), "signed_with": signed}


def _solved(stage: Stage, run: Path) -> tuple[str, ...]:
    names = [table.name for table in stage.tables.appearances]
    solved = tuple(name for name in names if is_solved(run, name))
    if not solved:
        raise UsageError(
            "nothing-solved",
            what="No appearance of stage.toml is solved with the latest calibration.",
            remedy="Run `velatura appearance` on the stage first. It also builds and installs a bundle.",
        )
    return solved


def _check(cancel: threading.Event) -> None:
    if cancel.is_set():
        raise Cancelled


def verify(file: Path, *, stage: Path | None, trusted: Sequence[Path]) -> Mapping[str, Any]:
    """Check every byte of a bundle and its signature, with the stage's trusted keys or these public key files.

    With neither, the signature must fit the content, and "trusted" in the result is "not checked".
    Raises BundleError as ``Bundle.open`` and ``Bundle.verify`` do; UsageError("trust-twice").
    """
    if stage is not None and trusted:
        raise UsageError("trust-twice", what="Both --stage and --trusted were given.", remedy="Give only one of them.")
    trust = ANY_SIGNER
    accept: Callable[[Index], None] = _anything
    if stage is not None:
        loaded = load_stage(stage)
        trust, accept = stage_trust(loaded), _fits(loaded)
    elif trusted:
        trust = Trust(tuple(map(load_public_key, trusted)))
    with Bundle.open_trusted(file, trust) as bundle:
        bundle.verify()
        accept(bundle.index)
        signed_by = bundle.signed_by
    return {
        "file": str(file),
        "sound": True,
        "signed_by": None if signed_by is None else signed_by.hex(),
        "trusted": "not checked" if trust is ANY_SIGNER else True,
        **({} if trust is ANY_SIGNER else _warning(signed_by, trust)),
    }


def _anything(index: Index) -> None:
    """Without a stage, every intact bundle fits."""


def _fits(stage: Stage) -> Callable[[Index], None]:
    """Refuse a bundle for another stage or other outputs now; otherwise the player would refuse it later."""
    name = stage.tables.stage.name
    ours = {(output.name, output.width_px, output.height_px) for output in stage.tables.display.outputs}

    def accept(index: Index) -> None:
        if index.stage != name:
            raise BundleError(
                "bundle-other-stage",
                what=f"The bundle was made for the stage {index.stage!r}; this one is {name!r}.",
                remedy="Install it on that stage, or build one for this stage with 'velatura bundle build'.",
            )
        check_outputs(index, ours)

    return accept


def check_outputs(index: Index, ours: set[tuple[str, int, int]]) -> None:
    """Raises BundleError("bundle-outputs-differ") unless a bundle was made for ``ours``: (name, width, height) each.

    Empty ``ours``: only the display itself knows its outputs.
    """
    theirs = {(output.name, output.width_px, output.height_px) for output in index.outputs}
    if ours and theirs != ours:
        raise BundleError(
            "bundle-outputs-differ",
            what=f"The bundle was made for the outputs {_listed(theirs)}; this stage has {_listed(ours)}.",
            remedy="Calibrate and build again with these outputs, or restore the previous outputs.",
        )


def _listed(outputs: set[tuple[str, int, int]]) -> str:
    return ", ".join(f"{name} {width}x{height}" for name, width, height in sorted(outputs))


def install(file: Path, *, stage: Path) -> Mapping[str, Any]:
    """Install a bundle on the stage that it was made for, if the stage trusts it.

    Raises BundleError as ``bundle.install.install``, and ("bundle-other-stage" or "bundle-outputs-differ").
    """
    loaded = load_stage(stage)
    trust = stage_trust(loaded)
    installed = slots.install(
        file,
        loaded.folder / BUNDLES,
        trusted=trust.keys,
        allow_unsigned=trust.allow_unsigned,
        revoked=trust.revoked,
        accept=_fits(loaded),
    )
    return {"installed": str(installed), **_identity(installed, trust)}


def rollback(stage: Path) -> Mapping[str, Any]:
    """Go back to the previous bundle, if the stage still trusts it. Raises BundleError."""
    loaded = load_stage(stage)
    folder = loaded.folder / BUNDLES
    before, trust = slots.previous(folder), stage_trust(loaded)
    if before is not None:
        with Bundle.open_trusted(before, trust) as bundle:
            bundle.verify()
    installed = slots.rollback(folder)
    return {"installed": str(installed), **_identity(installed, trust)}


def _identity(file: Path, trust: Trust) -> dict[str, Any]:
    with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
        return {
            "revision": bundle.index.revision,
            "signed_by": "not signed" if bundle.signed_by is None else bundle.signed_by.hex(),
            "appearances": ", ".join(appearance.name for appearance in bundle.index.appearances),
            **_warning(bundle.signed_by, trust),
        }


def _warning(signed_by: bytes | None, trust: Trust) -> dict[str, str]:
    """``{"warning": ...}`` for an unsigned bundle, else nothing."""
    found = unsigned_warning(signed_by, trust)
    return {} if found is None else {"warning": f"{found.what} {found.remedy}"}


def export(*, file: Path, out: Path, reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
    """Write a bundle's frames as PNG pictures into the folder ``out``. Raises as ``export_pictures``."""

    def advance(done: float) -> None:
        _check(cancel)
        reporter.say(f"{100 * done:.0f} % of the pictures written.")

    with Bundle.open_trusted(file, ANY_SIGNER) as bundle:
        return {"folder": str(out), "pictures": export_pictures(bundle, out, advance)}


def make_key(stage: Path, name: str) -> dict[str, Any]:
    """Make STAGE/keys/NAME.key and NAME.key.pub. "trusted_keys" is the value for stage.toml, "where" its place.

    Raises UsageError("stage-missing", "key-exists" or "key-name"), and as ``load_stage`` where there is a stage.toml.
    """
    if not stage.is_dir():
        raise UsageError(
            "stage-missing",
            what=f"The folder {stage} does not exist.",
            remedy="Give the stage's folder, or create it first.",
        )
    if not valid_name(name):
        raise UsageError(
            "key-name", what=f"{name!r} is not a valid name for a key.", remedy="Use only letters, digits, - and _."
        )
    tables = load_stage(stage).tables if (stage / FILE).exists() else None
    trusted = [] if tables is None else list(tables.bundle.trusted_keys)
    where = "add a table [bundle]"
    if tables is not None and "bundle" in tables.model_fields_set:
        place = tables.bundle.place
        where = f"add to [bundle] in line {place.line()}"
        if "trusted_keys" in tables.bundle.model_fields_set:
            where = f"replace trusted_keys in line {place.line('trusted_keys')}"
    path = stage / Path(KEY_FILE).with_stem(name)
    path.parent.mkdir(mode=0o700, exist_ok=True)
    public = generate_key(path).hex()
    return {"key": str(path), "public": public, "trusted_keys": [*trusted, public], "where": where}
