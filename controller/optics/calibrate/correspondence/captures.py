"""The captures of one projector as the numeric steps take them: a mapping from a pattern's name to its photograph.

The mapping may load each photograph when it is asked for: every step asks once for each, so that a large stage need
never lie in memory as a whole. All photographs are linear, in one common unit (full scale at one exposure, or per
second), and hold NaN where they were saturated or not measured.

A plan with few pictures leaves out sinusoids that ``completed`` works out: white less the picture that is shown. A lamp
is never equally strong in two photographs, and white less a picture that is one per cent too bright is one per cent too
dark. Each picture is therefore first brought to the strength of white: over the camera pixels, the contrast of two
steps a quarter of a period apart lies on a circle, and its middle tells the lamp's strength in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, TypeAlias

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask, as_light
from controller.core.channels import every, finite
from controller.core.errors import CalibrationError
from controller.optics.capture.patterns import Pattern, PatternPlan
from controller.optics.capture.profile import CameraNoise

Captures: TypeAlias = Mapping[str, FloatImage]


def coloured(captures: Captures, name: str, shape: tuple[int, ...] | None = None) -> FloatImage:
    """The photograph of one pattern, checked against the ``shape`` (rows, columns) of the others.

    Raises CalibrationError("capture-missing", "capture-shape-wrong"), UsageError("image-not-light").
    """
    try:
        image = captures[name]
    except KeyError:
        raise CalibrationError(
            "capture-missing",
            what=f"The photograph of pattern {name} is missing.",
            remedy="Start the calibration again; it takes only the missing photographs.",
        ) from None
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or shape not in (None, image.shape[:2]):
        raise CalibrationError(
            "capture-shape-wrong",
            what=f"The photograph of pattern {name} has the shape {image.shape}, unlike the others.",
            remedy="Do not change the camera's picture size during a calibration, and take the photographs again.",
        )
    return as_light(image)


def grey(captures: Captures, name: str, shape: tuple[int, ...] | None = None) -> FloatImage:
    """As ``coloured``, the channels added up: (rows, columns) float32. Patterns that are grey lose nothing by this."""
    image = coloured(captures, name, shape)
    if image.ndim == 2:
        return image
    return np.asarray(cv2.transform(image, np.ones((1, 3), np.float32)), np.float32).reshape(image.shape[:2])


def inconsistent(why: str, remedy: str) -> CalibrationError:
    """The error for photographs that can't be of one scene, or not in this order."""
    return CalibrationError("captures-inconsistent", what=f"The pictures do not fit together: {why}.", remedy=remedy)


STILL_PX, BLUR_PX = 0.4, 7


def check_still(first: FloatImage, second: FloatImage, what: str) -> None:
    """Refuse pictures of one scene, (rows, columns) light up to a factor, between which the camera moved.

    Raises CalibrationError("captures-inconsistent").
    """
    a, b = (cv2.pyrDown(np.nan_to_num(one / np.nanmean(one)).astype(np.float32)) for one in (first, second))
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 6, 1e-7)
    start = np.eye(2, 3, dtype=np.float32)
    try:
        _, found = cv2.findTransformECC(a, b, start, cv2.MOTION_TRANSLATION, until, np.ones(a.shape, np.uint8), BLUR_PX)
    except cv2.error:
        return  # a picture without contrast shows no motion
    moved = 2 * float(np.hypot(*found[:, 2]))
    if moved > STILL_PX:
        raise inconsistent(
            f"the camera moved by {moved:.1f} px between {what}", "Fix the camera, and take the photographs again."
        )


LIT_SHARE: Final = 0.05
"""Of the 99th percentile of white: darker camera pixels add noise and stray light."""


def lit_pixels(white: FloatImage) -> Mask:
    """(rows, columns): where white (rows, columns, 3), less black, is known and bright in every channel."""
    known: Mask = finite(white)
    if not known.any():
        return known
    bright = np.percentile(white.reshape(-1, 3)[np.flatnonzero(known)[::7]], 99, axis=0)
    return np.asarray(known & every(white > LIT_SHARE * bright) & np.all(bright > 0))


SOME_PIXELS: Final = 200_000
FEWEST_PIXELS: Final = 2_000
"""Fewer tell no strength."""
ROUNDS, OUTLIER = 8, 5.0
"""Rounds of the fit; times the median deviation, from which a pixel is left out."""
MOST_FLICKER: Final = 0.03
"""A lamp that differs more from one photograph to the next is not stable; then it is not the lamp."""


def completed(captures: Captures, plan: PatternPlan) -> Captures:
    """The captures with the sinusoids that ``plan`` does not show; the same ones where it shows all.

    ``captures`` needs ``black`` and ``white``. The latest picture of a sinusoid stays in memory, because its opposite
    is asked for next.
    """
    return _Completed(captures, plan) if plan.computed else captures


def step_variance(light: FloatImage, noise: CameraNoise) -> FloatImage:
    """Variance of one of three steps that would be as certain as two with their opposites; same shape as ``light``.

    Two steps with white are 1.5 times as uncertain as three, white adds a quarter of its own variance, and the
    interpolation of a camera's colours takes away about as much as both add.
    """
    return np.asarray(np.float32(noise.shot) * np.maximum(light, 0) + np.float32(noise.read**2), np.float32)


class _Completed(Mapping[str, FloatImage]):
    def __init__(self, captures: Captures, plan: PatternPlan) -> None:
        self._captures = captures
        self._opposite = {pattern.name: pattern.opposite for pattern in plan.computed}
        self._prefix = {shown: shown.rpartition("-")[0] for shown in self._opposite.values()}
        self._plan = plan
        self._gains: dict[str, float] = {}
        self._latest: tuple[str, FloatImage] | None = None

    def __getitem__(self, name: str) -> FloatImage:
        shown = self._opposite.get(name)
        if shown is None:
            return self._steady(name) if name in self._prefix else self._captures[name]
        image = self._captures["white"] + self._captures["black"]
        image -= self._steady(shown)
        return np.asarray(image, np.float32)

    def __iter__(self) -> Iterator[str]:
        yield from self._captures
        yield from (name for name in self._opposite if name not in self._captures)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def _steady(self, name: str) -> FloatImage:
        """A picture as it would be had the lamp been as strong as at white."""
        if self._latest is not None and self._latest[0] == name:
            return self._latest[1]
        prefix = self._prefix[name]
        if name not in self._gains:
            shown = [pattern for pattern in self._plan.sinusoids(prefix) if not pattern.opposite]
            self._gains.update(self._strengths(shown))
        black = self._captures["black"]
        image = np.asarray(self._captures[name] - black, np.float32)
        image /= np.float32(self._gains[name])
        image += black
        self._latest = name, image
        return image

    def _strengths(self, shown: list[Pattern]) -> dict[str, float]:
        """How much stronger the lamp was in each step than at white."""
        black = grey(self._captures, "black")
        white = grey(self._captures, "white", black.shape) - black
        contrast = []
        with np.errstate(invalid="ignore", divide="ignore"):
            for pattern in shown:
                contrast.append(2 * (grey(self._captures, pattern.name, black.shape) - black) / white - 1)
        finite = white[np.isfinite(white)]
        bright = float(np.percentile(finite[:: max(1, finite.size // SOME_PIXELS)], 99)) if finite.size else np.inf
        use = (white > LIT_SHARE * bright) & np.logical_and.reduce([np.isfinite(one) for one in contrast])
        at = np.flatnonzero(use)
        if at.size < FEWEST_PIXELS:
            return {pattern.name: 1.0 for pattern in shown}
        at = at[:: max(1, at.size // SOME_PIXELS)]
        middle = _middle(np.stack([one.ravel()[at] for one in contrast]).astype(np.float64))
        return {pattern.name: 1 + float(off) for pattern, off in zip(shown, middle, strict=True)}


def _middle(contrast: Float64) -> Float64:
    """The middle of the circles that two steps' contrasts (2, pixels) lie on; of one step (1, pixels) the mean."""
    if len(contrast) == 1:
        return np.asarray(np.clip(contrast.mean(axis=1), -MOST_FLICKER, MOST_FLICKER), np.float64)
    square = (contrast**2).sum(axis=0)
    equations = np.stack([2 * contrast[0], 2 * contrast[1], np.ones_like(square)])
    circle = np.array([0.0, 0.0, float(np.median(square))])
    for _ in range(ROUNDS):
        off = np.abs(square - circle @ equations)
        # at the frame's border, and where two surfaces are seen, contrasts are off by far
        weight = np.clip(1 - (off / (OUTLIER * np.median(off) + 1e-9)) ** 2, 0, None)
        normal = (weight * equations) @ equations.T
        circle = np.linalg.lstsq(normal, equations @ (weight * square), rcond=None)[0]
    return np.asarray(np.clip(circle[:2], -MOST_FLICKER, MOST_FLICKER), np.float64)
