"""Why correspondences give no geometry: what is wrong with the object, the lens or the captures, found in the data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from controller.core import channels
from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry import pose_initialisation as hypotheses
from controller.optics.calibrate.values import Correspondence

JUMP_PX = 2.0
"""Neighbouring camera pixels that see places this much farther apart on the projector's image than is usual."""
BROKEN_SHARE = 0.4
"""Of camera pixels beside a gap or a jump, from which on the surface itself explains what does not fit."""
_FACTORS = (2.0, 0.5, 4.0, 0.25, 8.0, 0.125)
_ANY_FOCAL_SIGMA = 0.3


def inconsistent(own: Correspondence, what: str) -> CalibrationError:
    """The error for correspondences of which too few fit one position; ``what`` says which, and ends the sentence.

    Captures between which something moved keep the surface in one piece; lace, leaves or hair do not.
    """
    broken = broken_share(own)
    if broken > BROKEN_SHARE:
        return CalibrationError(
            "surface-broken-up",
            what=f"{what[:-1]}: {broken:.0%} of the object's camera pixels lie beside a gap or an edge, as in lace.",
            remedy="Cover what is full of holes or hair-thin, or bring the camera nearer."
            " If the surface is in one piece, the pictures do not belong together: capture again.",
        )
    return CalibrationError(
        "correspondences-inconsistent",
        what=what,
        remedy="Check that nothing moved and no picture lagged behind its pattern, then capture again.",
    )


def broken_share(own: Correspondence) -> float:
    """The share of decoded camera pixels with a neighbour, right or below, that is not, or sees a far-off place."""
    valid = own.valid
    if not valid.any():
        return 0.0
    beside = np.zeros(valid.shape, np.int64)
    for axis in (0, 1):
        ahead, behind = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        one, other = tuple(behind), tuple(ahead)
        step = channels.length(own.projector_px[other] - own.projector_px[one])
        both = valid[one] & valid[other]
        usual = float(np.median(step[both])) if both.any() else 0.0
        beside[one] |= valid[one] & (~valid[other] | (np.nan_to_num(step) > usual + JUMP_PX))
    return float(beside[valid].mean())


def no_position(
    problem: ba.AdjustmentProblem,
    sizes_px: Sequence[tuple[int, int]],
    missing: Sequence[int],
    tick: Callable[[], None],
) -> CalibrationError:
    """The error where no position was found for the projectors ``missing``: the focal length, if another one gives any.

    ``problem`` with every projector's correspondences; ``sizes_px``: (width, height) of each projector.
    """
    first = missing[0] + 1
    focal = float(np.exp(problem.camera_prior[0]))
    for factor in _FACTORS:
        prior, sigma = problem.camera_prior.copy(), problem.camera_sigma.copy()
        prior[0], sigma[0] = np.log(factor * focal), _ANY_FOCAL_SIGMA
        other = replace(problem, camera_prior=prior, camera_sigma=sigma)
        pairs = (hypotheses.solve_pair(other, n, sizes_px[n], tick) for n in missing)
        if all(pair is not None and pair.candidates for pair in pairs):
            return CalibrationError(
                "camera-prior-contradicted",
                what=f"With a focal length of {focal:.0f} px no position of projector {first} explains the pictures;"
                f" with a {'longer' if factor > 1 else 'shorter'} one there is.",
                remedy="Check focal_length_px, or the file that intrinsics names, and that pictures are not cropped.",
            )
    return CalibrationError(
        "geometry-uncertain",
        what=f"No position with the object in front of it was found for projector {first}.",
        remedy="Let each projector see more of the object's depth, or move it farther from the camera's view axis.",
    )
