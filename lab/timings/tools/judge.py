"""Measured calibrations against the truth of their stages: figures by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.optics.calibrate.values import Metapixels, Radiometry
from controller.optics.calibrate.verify.grade import verify
from controller.optics.capture.pattern_frames import device_frame, frame
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.photographs import codes_of
from controller.stage.artefacts.projectors import Pixels
from controller.stage.steps.appearance.solving import random_pattern
from lab.timings.tools.alignment import similarity
from lab.timings.tools.stage import CalibratedStage
from lab.timings.tools.truth import Truth, developed, footprints, moments, window_around

SPACING_PX = 48
"""Between single pixels whose footprints are measured: the widest, on a wall behind the object, must not touch."""
OFFSETS = tuple((row, column) for row in (2, 14, 26, 38) for column in (3, 15, 27, 39))
DOTS_PX = 16
"""Between the lit pixels of the picture that columns of T are judged by."""
IN_FOCUS_PX = 0.40
"""Defocus up to this many projector px counts as in focus (the emulated lenses' best is 0.28 to 0.36)."""
EDGE_PX = 3
"""Camera pixels from any edge or fold that count as one surface in columns of T."""
GROSS_MM = 5.0
HEAD_ON = 1.3
"""Times the median slope of the map; a steeper one is grazing."""


def rms(values: Float64) -> float:
    """Root mean square of what is finite; NaN of nothing."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def radiometry_errors(truth: Truth, n: int, radiometry: Radiometry) -> dict[str, float]:
    """Largest errors of response (of full scale) and mixing."""
    return {
        "response": float(np.abs(radiometry.response - truth.response(n)).max()),
        "mixing": float(np.abs(radiometry.mixing - truth.mixing(n)).max()),
    }


def map_errors(truth: Truth, n: int, run: Path, *, without_offset: bool = False) -> dict[str, float]:
    """Decoded against true projector positions, projector px.

    ``without_offset``: the median is taken off, where red and blue do not lie on green, whose place the true one is
    """
    name = truth.bench.projectors[n].name
    measured = Pixels.read(run, name).projector_px.astype(np.float64)
    true = truth.projector_px(n)
    off = measured - true
    if without_offset:
        off -= np.nanmedian(off, axis=(0, 1))
    error = np.hypot(*np.moveaxis(off, 2, 0))
    seen = np.isfinite(error)
    gross = seen & (error > 1.0)
    slope = np.full(error.shape, np.inf)
    slope[1:, 1:] = np.hypot(np.diff(true, axis=1)[1:], np.diff(true, axis=0)[:, 1:]).max(axis=2)
    good = seen & truth.one_surface(n, 3) & (truth.blur_px(n) <= IN_FOCUS_PX)
    good &= slope <= HEAD_ON * float(np.nanmedian(slope[seen]))
    return {
        "map in focus px": rms(error[good]),
        "map px": rms(error[seen & ~gross]),
        "map gross": float(np.mean(gross[seen])),
    }


def metapixel_errors(truth: Truth, n: int, metapixels: Metapixels) -> dict[str, float]:
    """Centres and sigmas against the moments of single projector pixels rendered without noise, camera px."""
    mixed, blur = ~truth.one_surface(n, 0), truth.blur_px(n)
    rows = []
    for (down, across), share in footprints(truth, n, SPACING_PX, OFFSETS):
        for row, column in np.argwhere(metapixels.valid[down::SPACING_PX, across::SPACING_PX]):
            at = (down + SPACING_PX * row, across + SPACING_PX * column)
            centre = metapixels.centre_px[at].astype(np.float64)
            covariance = metapixels.covariance_px2[at].astype(np.float64)
            window = window_around(centre, covariance, share.shape)
            true = None if window is None else moments(share, window)
            if window is None or true is None:
                continue
            whole = not (mixed[window.rows, window.columns] & window.inside).any()
            x, y = round(float(centre[0])), round(float(centre[1]))
            area = np.sqrt(max(covariance[0] * covariance[2] - covariance[1] ** 2, 0))
            true_area = np.sqrt(max(true[2] * true[4] - true[3] ** 2, 1e-9))
            off = centre - true[:2]
            rows.append((*off, np.sqrt(area / true_area) - 1, blur[y, x], whole))
    table = np.array(rows, np.float64)
    inside = table[:, 4] > 0
    sharp = inside & (table[:, 3] <= IN_FOCUS_PX)
    soft = inside & (table[:, 3] > IN_FOCUS_PX)
    return {
        "centre in focus px": rms(table[sharp, :2]),
        "centre defocused px": rms(table[soft, :2]),
        "centre px": float(np.median(np.hypot(table[:, 0], table[:, 1]))),
        "judged": float(np.mean(inside)),
        "sigma": rms(table[inside, 2]),
        "sigma bias": float(np.median(table[inside, 2])),
    }


def pattern_errors(stage: CalibratedStage, truth: Truth) -> list[dict[str, float]]:
    """Predicted pictures of each projector against its photograph, and against pictures without noise.

    All of them with what other surfaces throw back, as the solves predict it.
    """
    calibrated = Calibrated(stage.run, stage.names)
    found = []
    for n, part in enumerate(calibrated.calibration.projectors):
        rows, columns = part.metapixels.valid.shape
        lit, clean = calibrated.transport.lit[n], noise_free(calibrated, truth, n)
        figures = random_errors(calibrated, n, clean)
        y, x = np.mgrid[0:rows, 0:columns]
        for name, on in (("chequers", (x + y) % 2), ("columns", (x // 2) % 2)):
            light = np.repeat(on.astype(np.float32)[..., None], 3, axis=2)
            predicted = predicted_light(calibrated, n, light)
            figures[name] = relative(predicted, clean((light * 255).astype(np.uint8)), lit)
        single = np.zeros((rows, columns, 3), np.uint8)
        single[3::DOTS_PX, 5::DOTS_PX] = 255
        predicted, real = predicted_light(calibrated, n, (single / 255).astype(np.float32)), clean(single)
        figures["column of T"] = relative(predicted, real, lit)
        figures["column of T, one surface"] = relative(predicted, real, lit & truth.one_surface(n, EDGE_PX))
        found.append(figures)
    return found


def noise_free(calibrated: Calibrated, truth: Truth, n: int) -> Callable[[ByteImage], FloatImage]:
    """What the camera would make of a device frame of projector ``n`` without noise, in the calibration's unit."""
    part, lit = calibrated.calibration.projectors[n], calibrated.transport.lit[n]
    white = truth.white(n)
    full = 1.02 * float(white.max())
    clean_white = developed(white, full)
    known = part.white if part.indirect is None else part.white + part.indirect
    unit = np.float32(known[lit].sum(dtype=np.float64) / clean_white[lit].sum(dtype=np.float64))
    return lambda shown: developed(truth.light(n, shown), full) * unit


def random_errors(calibrated: Calibrated, n: int, clean: Callable[[ByteImage], FloatImage]) -> dict[str, float]:
    """Of the grade's random pattern: its error, and the parts that prediction and photograph have in it."""
    part, black = calibrated.calibration.projectors[n], calibrated.calibration.black
    rows, columns = part.metapixels.valid.shape
    lit, pattern = calibrated.transport.lit[n], random_pattern((columns, rows))
    photograph = codes_of(part.name).by_name(calibrated.folder)[pattern.name].per_second()
    predicted = predicted_light(calibrated, n, frame(pattern, (columns, rows)))
    real = clean(device_frame(pattern, (columns, rows), part.radiometry.response))
    return {
        "random photographed": verify(predicted + black, photograph, black, lit).relative_rms,
        "random": relative(predicted, real, lit),
        "random noise": relative(photograph - black, real, lit),
    }


def predicted_light(calibrated: Calibrated, n: int, light: FloatImage) -> FloatImage:
    """(camera rows, columns, 3): what the camera sees of a linear frame of projector ``n``, thrown-back light in it."""
    direct, back = calibrated.transport.forward_part(n, light), calibrated.indirect_of(n, light)
    return direct if back is None else direct + back


def relative(predicted: FloatImage, seen: FloatImage, mask: Mask) -> float:
    """Rms difference over rms of ``seen``, both (rows, columns, 3), where finite within ``mask``."""
    use = mask & np.isfinite(predicted).all(axis=2) & np.isfinite(seen).all(axis=2)
    difference = predicted[use].astype(np.float64) - seen[use]
    return rms(difference) / rms(seen[use].astype(np.float64))


def geometry_errors(stage: CalibratedStage, truth: Truth) -> dict[str, float]:
    """Shape and poses against the truth. The measured camera frame is turned and scaled onto the true one by shape."""
    geometry = read_geometry(stage.run)
    measured, true = geometry.points_m.astype(np.float64), truth.points_m()
    both = np.isfinite(measured).all(axis=2) & np.isfinite(true).all(axis=2)
    a, b = measured[both], true[both]
    near = np.ones(len(a), np.bool_)
    for _ in range(4):
        scale, turn, move = similarity(a[near], b[near])
        off_mm = 1000 * np.linalg.norm(scale * a @ turn.T + move - b, axis=1)
        near = off_mm <= GROSS_MM
    turned, displaced = [], []
    camera = truth.bench.camera.pose
    for found, real in zip(geometry.projectors, truth.bench.projectors, strict=True):
        rotation = real.pose.rotation @ camera.rotation.T
        centre = camera.rotation @ (np.asarray(real.pose.position_m) - camera.position_m)
        measured_centre = -found.rotation.T @ found.translation_m
        apart = found.rotation @ turn.T @ rotation.T
        turned.append(float(np.degrees(Rotation.from_matrix(apart).magnitude())))
        displaced.append(1000 * float(np.linalg.norm(scale * turn @ measured_centre + move - centre)))
    return {
        "shape mm": rms(off_mm[near]),
        "shape gross": float(np.mean(~near)),
        "pose degrees": max(turned),
        "pose mm": max(displaced),
        "scale": abs(scale - 1),
    }
