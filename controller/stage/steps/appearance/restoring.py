"""The request for a restoration: its picture is registered first, and what can be shown of it is said."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.config.models import SolveTable
from controller.core import channels
from controller.core.arrays import moved_to_file
from controller.optics.calibrate.photometry.reflectance import reflectance_everywhere
from controller.optics.solve.reach.feasibility import exposures, with_less_light
from controller.optics.solve.targets.files import read_large_picture
from controller.optics.solve.targets.registration import Registration, register
from controller.optics.solve.targets.restoration import RestorationLook, restored, without_margin
from controller.optics.solve.targets.values import Target
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import Registered
from controller.stage.steps.appearance.solving import AppearanceRequest

TITLE: Final = "Restored"
REGISTER_S: Final = 5.0
TURNED_DEGREES: Final = 2.0
WHOLE: Final = 0.995


class Restoration:
    """A restoration, registered once. ``made`` raises UsageError as ``register``."""

    def __init__(self, file: Path, options: Mapping[str, Any], calibrated: Calibrated) -> None:
        options = dict(options)
        self._file, self._colour, self._calibrated = file, options.pop("colour", None), calibrated
        self._look = RestorationLook(**options)
        self._brightness = self._look.share_of_white()

    @functools.cached_property
    def made(self) -> tuple[Target, Registration]:
        calibrated, look = self._calibrated, self._look
        mask = calibrated.transport.object_mask
        rows, columns = mask.shape
        light, by = read_large_picture(self._file, self._colour, (2 * columns, 2 * rows))
        picture = np.where(light[..., 3:] > 0, light[..., :3], np.nan) if light.shape[2] == 4 else light
        if look.margin == "leave-out":
            picture = without_margin(picture)
        own = np.where(mask[..., None], calibrated.reflectance, np.nan)
        points = [((x + 0.5) / by - 0.5, (y + 0.5) / by - 0.5, right, down) for x, y, right, down in look.points]
        registration = register(picture, own, points)
        everywhere = reflectance_everywhere(calibrated.calibration, own)
        target = restored(picture, registration, everywhere, mask, look, calibrated.calibration.camera_to_xyz)
        exposure = None
        if self._brightness is not None:
            whites = channels.mean(calibrated.transport.reach()) / channels.mean(own)
            exposure = self._brightness * float(np.nanmedian(whites))
        folder = calibrated.folder
        kept = replace(registration, position_px=moved_to_file(registration.position_px, folder))
        return replace(target, image=moved_to_file(target.image, folder), exposure=exposure), kept

    def figures(self, share: float) -> dict[str, Any]:
        """As of ``Registered``. ``share``: see ``SolveOptions``"""
        (target, registration), light = self.made, self._calibrated.light
        drive, exposure = light.levels(), target.exposure
        if exposure is None:
            exposure, _ = exposures(drive, target.image, light.black, share, indirect=light.indirect)
        share, less, then_share = with_less_light(
            drive, target, light.black, exposure=exposure, indirect=light.indirect
        )
        residual = registration.residual_px[np.isfinite(registration.residual_px)]
        middle, most = np.percentile(residual, (50, 95)) if residual.size else (None, None)
        matched = float(registration.matched.sum() / max(1, registration.inside.sum()))
        return {
            "turned_degrees": registration.turned_degrees, "by_points": registration.by_points,
            "residual_px": middle, "residual_px_p95": most, "matched_share": matched,
            "share": share, "light": less, "then_share": then_share,
        }  # fmt: skip


def registered_text(figures: Mapping[str, Any]) -> str:
    """The figures of a ``Registered`` in sentences."""
    text = "The picture lies on the object"
    if abs(figures["turned_degrees"]) >= TURNED_DEGREES:
        text += f", turned by {figures['turned_degrees']:.0f} degrees"
    if figures["by_points"]:
        text += ", by its points alone: picture and object have too little in common"
    if figures["residual_px"] is not None:
        off, most = figures["residual_px"], figures["residual_px_p95"]
        text += f". It is off by {off:.1f} camera pixels (median; 95 %: {most:.1f})"
    if figures["matched_share"] < WHOLE:
        text += f". {100 * figures['matched_share']:.0f} % of it was matched; the rest of the object stays as it is"
    text += f". At the light that is asked for {100 * figures['share']:.0f} % of it can be shown"
    if figures["light"] < WHOLE:
        text += f", and {100 * figures['then_share']:.0f} % at {100 * figures['light']:.0f} % of this light"
    return f"{text}."


def restoration_request(
    name: str, file: Path, options: Mapping[str, Any], calibrated: Calibrated, solve: SolveTable, inputs: dict[str, str]
) -> AppearanceRequest:
    """Registered at once, if there is a calibration that it was not registered on before. Raises as ``register``."""
    restoration = Restoration(file, options, calibrated)
    about = {**inputs, "share": repr(solve.exposure_share)}
    known = Registered.read(calibrated.base_folder, name)
    if calibrated.camera_px is not None and (known is None or known.about != about):
        _ = restoration.made

    def prepare(context: Context) -> Sequence[Path]:
        figures = restoration.figures(solve.exposure_share)
        context.reporter.say(f"{name}: {registered_text(figures)}")
        residual = restoration.made[1].residual_px.astype(np.float16)
        return Registered(about, figures, residual).write(context.folder, name)

    return AppearanceRequest(name, TITLE, lambda: restoration.made[0], about, prepare, REGISTER_S, "Registering")
