"""The constants that shaders share with the processor's loops, from the one place where each is defined.

A shader names them without declaring them; ``declarations`` gives the lines that declare them.
A module of its own: `device` loads it, and the numeric packages behind it, with the first kernel only.
"""

from __future__ import annotations

import re
from typing import Final

from controller.optics.solve.bounded import equations, initial_estimate
from controller.optics.solve.gpu import records
from controller.optics.transport.windows import mosaic, profiles

CONSTANTS: Final[dict[str, str]] = {
    "BLOCK_PX": f"u32 = {initial_estimate.BLOCK_PX}",
    "RIDGE": f"f32 = {initial_estimate.RIDGE}",
    "LEAST_DETERMINANT": f"f32 = {initial_estimate.LEAST_DETERMINANT}",
    "MOST_STEPS": f"i32 = {initial_estimate.MOST_STEPS}",
    "SINGLE_MOST_HALVINGS": f"i32 = {initial_estimate.SINGLE_MOST_HALVINGS}",
    "SINGLE_CLOSE": f"f32 = {initial_estimate.SINGLE_CLOSE}",
    "LEVEL": f"f32 = {initial_estimate.LEVEL}",
    "EDGE_WEIGHT_STEPS": f"f32 = {equations.EDGE_WEIGHT_STEPS}",
    "GREEN": f"u32 = {mosaic.GREEN}",
    "MARGIN": f"i32 = {records.MARGIN}",
    "PHASE_BITS": f"u32 = {profiles.PHASE_BITS}",
    "PHASES": f"i32 = {profiles.PHASES}",
    "SHEAR_BITS": f"u32 = {profiles.SHEAR_BITS}",
    "SKEW_STEPS": f"i32 = {profiles.SKEW_STEPS}",
}
"""Type and value of each, as WGSL has them."""


def declarations(code: str) -> str:
    """A line for each of the constants that ``code`` names."""
    used = set(re.findall(r"\b[A-Z][A-Z_]+\b", code))
    return "".join(f"const {name}: {value};\n" for name, value in CONSTANTS.items() if name in used)
