"""Everything that makes a target picture, in one place to import from.

A target is what the object should look like from the camera, relative to a white object in uniform light; how bright it
can become is decided by the solver's exposure.
"""

from controller.solve.relight import gloss, recolour, smooth_normals
from controller.solve.targets_files import PHOTOGRAPHS, check_picture, load_target, read_picture, shipped_photograph
from controller.solve.targets_patterns import WHITE_GREY, Colour, checkerboard, replace_pattern
from controller.solve.targets_values import Target, linear_to_srgb, srgb_to_linear, through_camera
from controller.solve.wrap import Mapping, ObjectSpace, object_space, painted, wrap_photograph

__all__ = [
    "PHOTOGRAPHS",
    "WHITE_GREY",
    "Colour",
    "Mapping",
    "ObjectSpace",
    "Target",
    "check_picture",
    "checkerboard",
    "gloss",
    "linear_to_srgb",
    "load_target",
    "object_space",
    "painted",
    "read_picture",
    "recolour",
    "replace_pattern",
    "shipped_photograph",
    "smooth_normals",
    "srgb_to_linear",
    "through_camera",
    "wrap_photograph",
]
