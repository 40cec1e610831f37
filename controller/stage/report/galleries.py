"""Galleries of the reports: where a calibration's prediction is wrong and why, and direct and indirect light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage, load_arrays
from controller.optics.calibrate.values import Calibration
from controller.stage.artefacts.calibrated import all_views, share_above
from controller.stage.artefacts.grade import PICTURE, parts_of
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.solved import DIFFERS
from controller.stage.report import plots
from controller.stage.report.page import Gallery, ReportPicture
from controller.stage.report.pictures import ERROR_SCALE_DELTA_E, Crop, crop_around, read_picture, to_screen

SHOWN: Final = 3
"""Reasons of a projector, the most important first."""
TEXT: Final = (
    "A random pattern was predicted and photographed. Colours show where the two differ by more than 5 % "
    "of the light nearby, and the likely reason; grey is good."
)


def causes_gallery(run: Path, verification: Mapping[str, Any], camera: tuple[int, ...]) -> tuple[Gallery, ...]:
    """One picture for each projector of the graded ``run``; nothing for a run from before there was such a map.

    ``verification``: ``read_grade_figures(run)``; ``camera``: (rows, columns) of its picture
    """
    whole = read_picture(run / PICTURE)
    if whole is None:
        return ()
    parts = parts_of(whole, len(verification), camera)
    pictures = tuple(
        ReportPicture(
            f"{name}: {100 * row['relative_rms']:.2f} % error",
            part,
            large=True,
            points=tuple(reason["sentence"] for reason in row.get("reasons", [])[:SHOWN]),
        )
        for (name, row), part in zip(verification.items(), parts, strict=True)
    )
    return (("Where the calibration has errors, and why", TEXT, pictures),)


BRIGHTER: Final = 4.0
"""Indirect light is shown so many times brighter than direct light, or it would be black on most screens."""
MOST_PERCENT: Final = 50.0
FAINT: Final = 0.01
"""Of the usual light: a share of less says nothing."""


def whites(calibration: Calibration) -> tuple[FloatImage, FloatImage]:
    """(rows, columns, 3) direct and indirect light of all projectors at white, without the black image."""
    nothing = np.zeros_like(calibration.black)
    direct = sum((part.white for part in calibration.projectors), start=nothing)
    parts = [part.indirect for part in calibration.projectors if part.indirect is not None]
    return direct, np.asarray(sum(parts, start=nothing), np.float32)


def light_gallery(calibration: Calibration, crop: Crop) -> tuple[Gallery, ...]:
    """The gallery; none where no indirect light was found that counts."""
    if all(part.indirect is None for part in calibration.projectors):
        return ()
    direct, indirect = whites(calibration)
    mask = calibration.object_mask
    whole = direct + indirect
    usual = float(np.percentile(whole[mask], 99)) if mask.any() else 1.0

    def screen(light: FloatImage) -> ByteImage:
        cut = np.ascontiguousarray(light[crop.rows, crop.columns])
        return to_screen(cut, calibration.camera_to_xyz, white=max(usual, 1e-12))

    seen, thrown = channels.total(whole), channels.total(indirect)
    known = mask & (seen > FAINT * float(np.median(seen[mask]) if mask.any() else 0))
    share = np.where(known, 100 * thrown / np.maximum(seen, 1e-12), np.nan).astype(np.float32)
    middle, high = (float(np.nanpercentile(share, q)) for q in (50, 95)) if known.any() else (0.0, 0.0)
    field = plots.field(share[crop.rows, crop.columns], "% of the light seen", least=0, most=MOST_PERCENT)
    text = (
        "All projectors at white. Light that other surfaces throw back has no contrast under fine patterns. So the "
        "calibration's photographs distinguish it. "
        f"It is {middle:.0f} % of the object's light at the median, {high:.0f} % at the 95th percentile."
    )
    pictures = (
        ReportPicture("Direct light", screen(direct), "what the projectors make"),
        ReportPicture("Indirect light", screen(np.float32(BRIGHTER) * indirect), f"{BRIGHTER:g} times as bright"),
        ReportPicture("Share of indirect light", field),
    )
    return (("Direct and indirect light", text, pictures),)


GLOSS: Final = (
    "Each map is of what several cameras see. Where paint shines, they see different light at one place, and an "
    "appearance is right from one side at most. Where an appearance asks for different colours, the object shows one "
    "between."
)


def views_gallery(run: Path, projectors: Sequence[str]) -> tuple[Gallery, ...]:
    """By how much the views of a run differ, in the object's own light and in each appearance; none for one view."""
    calibrated = all_views(run, projectors)
    views = calibrated.views()
    if len(views) == 1:
        return ()
    calibration = calibrated.calibration
    white, mask = whites(calibration)[0], calibration.object_mask
    usual = float(np.percentile(channels.mean(white)[mask], 99)) if mask.any() else 1.0
    found = calibrated.differences(white, mask, max(usual, 1e-12))
    maps = {} if found is None else {"white light": [view.part(found) for view in views]}
    for file in sorted(run.glob(f"{StepKind.APPEARANCE}-*.npz")):
        own = [
            load_arrays(view.folder / file.name).get(DIFFERS) for view in views if (view.folder / file.name).exists()
        ]
        if len(own) == len(views) and all(one is not None for one in own):
            maps[file.stem.partition("-")[2]] = own
    pictures = []
    for what, parts in maps.items():
        for name, view, one in zip(calibrated.names, views, parts, strict=True):
            crop = crop_around(view.part(mask))
            cut = plots.field(one[crop.rows, crop.columns], "CIEDE2000", least=0, most=ERROR_SCALE_DELTA_E)
            pictures.append(ReportPicture(f"{what}, view {name}", cut))
    shares = {what: share_above(np.concatenate([one.ravel() for one in parts])) for what, parts in maps.items()}
    told = ", ".join(f"{what} {100 * share:.0f} %" for what, share in shares.items())
    return (("Where views differ", f"{GLOSS} They differ clearly on so much of it: {told}.", tuple(pictures)),)
