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
from controller.core.arrays import FloatImage, moved_to_file
from controller.core.errors import UsageError
from controller.optics.calibrate.photometry.reflectance import reflectance_everywhere
from controller.optics.solve.reach.feasibility import exposures, with_less_light
from controller.optics.solve.targets.files import read_large_picture
from controller.optics.solve.targets.registration import Points, Registration, carried, register
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
    """A restoration, registered once. ``made`` raises UsageError as ``register``.

    ``carried``: the views in which the picture lies by the object's shape, because it was not matched there
    """

    def __init__(self, file: Path, options: Mapping[str, Any], calibrated: Calibrated) -> None:
        options = dict(options)
        self._file, self._colour, self._calibrated = file, options.pop("colour", None), calibrated
        self._look = RestorationLook(**options)
        self._brightness = self._look.share_of_white()
        self.carried: list[str] = []

    @functools.cached_property
    def made(self) -> tuple[Target, list[Registration]]:
        """The target of all views, and how the picture lies in each."""
        calibrated, look = self._calibrated, self._look
        mask, parts = calibrated.transport.object_mask, [view.part for view in calibrated.views()]
        rows, columns = (2 * max(part(mask).shape[axis] for part in parts) for axis in (0, 1))
        light, by = read_large_picture(self._file, self._colour, (columns, rows))
        picture = np.where(light[..., 3:] > 0, light[..., :3], np.nan) if light.shape[2] == 4 else light
        if look.margin == "leave-out":
            picture = without_margin(picture)
        own = np.where(mask[..., None], calibrated.reflectance, np.nan)
        points = [((x + 0.5) / by - 0.5, (y + 0.5) / by - 0.5, right, down) for x, y, right, down in look.points]
        registrations = self._registered(picture, [part(own) for part in parts], points)
        folder, targets = calibrated.folder, []
        for view, part, registration in zip(calibrated.each(), parts, registrations, strict=True):
            everywhere = reflectance_everywhere(view.calibration, part(own))
            to_xyz = view.calibration.camera_to_xyz
            targets.append(restored(picture, registration, everywhere, part(mask), look, to_xyz))
        exposure = None
        if self._brightness is not None:
            whites = channels.mean(calibrated.transport.reach()) / channels.mean(own)
            exposure = self._brightness * float(np.nanmedian(whites))
        image = moved_to_file(calibrated.joined([target.image for target in targets]), folder)
        whole = replace(
            targets[0], image=image, mask=calibrated.joined([target.mask for target in targets]), exposure=exposure
        )
        return whole, [replace(one, position_px=moved_to_file(one.position_px, folder)) for one in registrations]

    def _registered(self, picture: FloatImage, own: Sequence[FloatImage], points: Points) -> list[Registration]:
        """In each view, whose reflectance is ``own``. ``points`` are places in the first one."""
        calibrated, laid, errors = self._calibrated, dict[int, Registration](), dict[int, UsageError]()
        by_others: dict[int, Registration] = {}
        by_shape = bool(points) and calibrated.known_geometry is not None
        for n, reflectance in enumerate(own[:1] if by_shape else own):
            try:
                laid[n] = register(picture, reflectance, points if n == 0 else ())
            except UsageError as error:
                if len(own) == 1 or by_shape or error.code != "restoration-not-matched":
                    raise
                errors[n] = error
        for n in set(range(len(own))) - set(laid):
            seen = [(laid[m], calibrated.places_in(n, m)) for m in laid]
            from_others = [carried(one, places_px) for one, places_px in seen if places_px is not None]
            if not from_others:
                why, name = errors[n], calibrated.names[n]
                raise UsageError("restoration-not-matched", what=f"View {name}: {why.what}", remedy=why.remedy)
            by_others[n] = max(from_others, key=lambda one: int(one.matched.sum()))
        self.carried = [calibrated.names[n] for n in sorted(by_others)]
        return [(laid | by_others)[n] for n in range(len(own))]

    def figures(self, share: float) -> dict[str, Any]:
        """As of ``Registered``. ``share``: see ``SolveOptions``"""
        (target, registrations), light = self.made, self._calibrated.light
        drive, exposure = light.levels(), target.exposure
        if exposure is None:
            exposure, _ = exposures(drive, target.image, light.black, share, indirect=light.indirect)
        share, less, then_share = with_less_light(
            drive, target, light.black, exposure=exposure, indirect=light.indirect
        )
        residual = np.concatenate([one.residual_px[np.isfinite(one.residual_px)] for one in registrations])
        middle, most = np.percentile(residual, (50, 95)) if residual.size else (None, None)
        matched, inside = (
            sum(int(mask.sum()) for mask in masks)
            for masks in zip(*((one.matched, one.inside) for one in registrations), strict=True)
        )
        return {
            "turned_degrees": registrations[0].turned_degrees, "by_points": registrations[0].by_points,
            "residual_px": middle, "residual_px_p95": most, "matched_share": matched / max(1, inside),
            "share": share, "light": less, "then_share": then_share, "carried": self.carried,
        }  # fmt: skip


def registered_text(figures: Mapping[str, Any]) -> str:
    """The figures of a ``Registered`` in sentences."""
    text = "The picture lies on the object"
    if abs(figures["turned_degrees"]) >= TURNED_DEGREES:
        text += f", turned by {figures['turned_degrees']:.0f} degrees"
    if figures["by_points"]:
        text += ", by its points alone: picture and object have too little in common"
    if figures.get("carried"):
        text += f". In view {' and '.join(figures['carried'])} it lies by the object's shape, as seen from another view"
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
        folders = (context.folder, *calibrated.folders[1:])
        residuals = [one.residual_px.astype(np.float16) for one in restoration.made[1]]
        return [
            path
            for folder, residual in zip(folders, residuals, strict=True)
            for path in Registered(about, figures, residual).write(folder, name)
        ]

    return AppearanceRequest(name, TITLE, lambda: restoration.made[0], about, prepare, REGISTER_S, "Registering")
