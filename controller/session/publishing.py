"""The steps from solved frames to a signed, installed bundle, and from there to photographs of what plays."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from controller.arrays import FloatImage, save_arrays
from controller.bundle.format import Index
from controller.bundle.install import install, revision_floor
from controller.bundle.signing import ANYONE, Trust, load_signing_key
from controller.bundle.writer import NewAppearance, write_bundle
from controller.capture.brackets import merge_brackets
from controller.errors import UsageError
from controller.session import costs
from controller.session.capturing import bracket
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.shots import keep_if_lit, take_photograph
from controller.session.solving import read_solved
from controller.storage import sha256_of, write_atomically
from hal.deadline import Deadline
from hal.interfaces import BundleDisplay

PHOTO_BRACKET = (0.7, 5.0)
"""Exposures of an appearance's photograph, relative to the one at which its target's white fills the scale."""
PLAYBACK_RATE_HZ = 60.0


def bundle_display(rig: Rig) -> BundleDisplay:
    """The rig's display as one that plays bundles. Raises UsageError("display-plays-no-bundles")."""
    if not isinstance(rig.display, BundleDisplay):
        raise UsageError(
            "display-plays-no-bundles",
            what="This stage's display driver shows pictures but plays no bundles.",
            remedy='Use the driver "player" under [display] in stage.toml.',
        )
    return rig.display


Outputs = Mapping[str, tuple[str, tuple[int, int]]]
"""Output name and (width, height) by projector name."""


def publish_step(
    stage_folder: Path, outputs: Outputs, names: Sequence[str], *, stage: str, calibration: str, key: Path | None
) -> Step:
    """Write, sign and install the bundle of these appearances; its artefacts are the bundle and its figures.

    ``key``: the signing key's file (its public half beside it), or None for an unsigned bundle.
    """
    return Step(
        "publish",
        partial(_publish, stage_folder, dict(outputs), tuple(names), (stage, calibration), key),
        inputs={"names": " ".join(names), "key": "" if key is None else sha256_of(key)},
        after=tuple(f"appearance-{name}" for name in names),
        title="Publishing the signed bundle",
        weight=1,
    )


def _publish(
    folder: Path,
    outputs: Outputs,
    names: Sequence[str],
    identity: tuple[str, str],
    key: Path | None,
    context: Context,
) -> Sequence[Path]:
    built, slots = context.folder / "bundle.vel", folder / "bundles"
    write_solved(
        built, context.folder, outputs, names, stage=identity[0], calibration=identity[1],
        revision=next_revision(slots), key=key,
    )  # fmt: skip
    trusted = () if key is None else (bytes(load_signing_key(key).verify_key),)
    installed = install(built, slots, trusted=trusted, allow_unsigned=key is None)
    raw = sum(3 * width * height for _, (width, height) in outputs.values()) * len(names)
    size = built.stat().st_size
    figures = {"bytes": size, "ratio": raw / size, "file": installed.name}
    path = context.folder / "bundle.json"
    write_atomically(path, json.dumps(figures, indent=1).encode())
    return [path, built]


def next_revision(slots: Path, trust: Trust = ANYONE) -> int:
    """One more than those installed bundles of the folder ``slots`` that ``trust`` lets pass."""
    return revision_floor(slots, trust) + 1


def write_solved(
    path: Path,
    run: Path,
    outputs: Outputs,
    names: Sequence[str],
    *,
    stage: str,
    calibration: str,
    revision: int,
    key: Path | None,
    check: Callable[[], None] = lambda: None,
) -> Index:
    """Write the appearances that the folder ``run`` holds solved as a bundle at ``path``, signed with the key file.

    ``check`` is called before each appearance, to stop the work by raising.
    Raises WorkError("appearance-not-solved") and what ``write_bundle`` raises; ``path`` is then as it was.
    """

    def appearance(name: str) -> NewAppearance:
        check()
        solved = read_solved(run, name, tuple(outputs))
        frames = {outputs[projector][0]: frame for projector, frame in solved.frames.items()}
        return NewAppearance(name, frames, metadata={"mode": solved.figures["mode"], "exposure": solved.exposure})

    return write_bundle(
        path,
        stage=stage,
        calibration=calibration,
        created_unix_s=int(time.time()),
        outputs=[(output, *size) for output, size in outputs.values()],
        appearances=(appearance(name) for name in names),
        key=None if key is None else load_signing_key(key),
        revision=revision,
    )


def photograph_step(rig: Rig, names: Sequence[str], *, longest_exposure_s: float) -> Step:
    """Play each appearance of the installed bundle and photograph it in HDR."""
    return Step(
        "photograph",
        partial(_photograph, rig, tuple(names), longest_exposure_s),
        after=("publish",),
        title="Photographing what plays",
        weight=photographs_s(rig, names),
    )


def photographs_s(rig: Rig, names: Sequence[str]) -> float:
    """What showing and photographing these appearances costs (``session.costs``)."""
    return 3 * len(names) * costs.shot_s(costs.scale(projector.size_px for projector in rig.projectors))


def _photograph(rig: Rig, names: Sequence[str], longest_s: float, context: Context) -> Sequence[Path]:
    display = bundle_display(rig)
    bundle = display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
    projectors = [projector.name for projector in rig.projectors]
    paths = []
    for number, name in enumerate(names):
        context.advance(number / len(names), name)
        exposure = read_solved(context.folder, name, projectors).exposure
        shown = display.play(name, deadline=context.deadline.within(20))
        of = {"bundle": bundle, "appearance": name}
        picture = photograph_hdr(rig, context, f"played-{name}", exposure, longest_s, shown_at_s=shown.at_s, of=of)
        path = context.folder / f"photograph-{name}.npz"
        save_arrays(path, {"photograph": picture})
        paths.append(path)
    return paths


def photograph_hdr(
    rig: Rig, context: Context, name: str, white: float, longest_s: float, *, shown_at_s: float, of: Mapping[str, str]
) -> FloatImage:
    """Photograph what is shown now in HDR: (rows, columns, 3) float32, full scales per second.

    ``white`` is the radiance of the target's white; ``of`` names what is shown, for the journal.
    """
    taken = [
        take_photograph(rig, context, f"{name}-{number}", exposure_s, shown_at_s=shown_at_s, of=of)
        for number, exposure_s in enumerate(bracket(1 / white, PHOTO_BRACKET, rig.acquirer.exposures_s(), longest_s))
    ]
    keep_if_lit(rig, context, taken)
    merged = merge_brackets([one.read().measured() for one in taken], [one.exposure_s for one in taken]).radiance
    return np.asarray(np.nan_to_num(merged), np.float32)


def playback_step(rig: Rig, names: Sequence[str], *, seconds: float) -> Step:
    """Swap the appearances as fast as a display does, and measure how evenly they come."""
    return Step(
        "playback",
        partial(_playback, rig, tuple(names), seconds),
        title="Swapping appearances 60 times a second",
        weight=seconds + 0.5,
        always=True,
    )


def _playback(rig: Rig, names: Sequence[str], seconds: float, context: Context) -> Sequence[Path]:
    display = bundle_display(rig)
    deadline: Deadline = context.deadline.within(seconds + 60)
    display.load_bundle(rig.stage / "bundles" / "current", deadline=deadline)
    items = [(name, 1 / PLAYBACK_RATE_HZ) for name in names]
    rounds = max(1, round(seconds * PLAYBACK_RATE_HZ / len(names)))
    before = display.playing(deadline=deadline)
    began = display.play_sequence(items, repeat=rounds, rate_hz=PLAYBACK_RATE_HZ, deadline=deadline)
    while (now := display.playing(deadline=deadline)).running:
        context.advance(min(0.99, (now.swaps - before.swaps) / (rounds * len(names))))
        deadline.sleep(0.2)
    display.stop(deadline=deadline)
    swaps = now.swaps - before.swaps
    figures = {
        "swaps": swaps,
        "swaps_per_s": (swaps - 1) / max(now.presented_at_s - began.at_s, 1e-9),
        "interval_p50_ms": None if now.interval_p50_s is None else 1000 * now.interval_p50_s,
        "interval_p99_ms": None if now.interval_p99_s is None else 1000 * now.interval_p99_s,
        "late": now.late,
        "rss_bytes": now.rss_bytes,
    }
    path = context.folder / "playback.json"
    write_atomically(path, json.dumps(figures, indent=1).encode())
    return [path]
