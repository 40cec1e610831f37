"""Warps as pictures for other programs: ST maps, and MPCDI 2.0 for media servers.

The red and green of an ST map (OpenEXR) say where in another picture each pixel's colour comes from. MPCDI has warps
and poses of projectors in the profiles 2d, 3d and sl (shader lamps).
Sources: VESA's MPCDI standard as its public reference library and Christie's notes explain it. A file is a ZIP archive
with mpcdi.xml and, for each projector, maps of its size: PFM with floats, rows from the bottom to the top, and PNG.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.storage import write_atomically
from controller.optics.calibrate.values import Pinhole
from controller.optics.capture.linear_files import exr_bytes
from controller.stage.artefacts.names import safe_name
from controller.stage.exchange.content import Content

_MAPS_README: Final = """ST maps of a Velatura stage. All are OpenEXR files with 32-bit floats.

PROJECTOR-from-camera.exr  has the projector's size and says where in the camera's picture each projector pixel lies:
                           it warps a picture as seen from the camera into the projector's own.
camera-from-PROJECTOR.exr  has the camera's size and says where in the projector's picture each camera pixel looks.

R is s, 0 at the left border of the picture and 1 at its right border. G is t, 0 at the lower border and 1 at the upper
border. A is 1 where the place is known and 0 elsewhere; B is 0.

A warp moves a picture of one projector to its place. It knows nothing of how bright and in which colour the projector
lights the object, nor of the other projectors whose light falls on the same place. Pictures for superimposed
projectors come from `velatura appearance`, and can't be had by these maps alone.
"""


def write_maps(content: Content, folder: Path) -> dict[str, int]:
    """Write two maps for each projector, and README.txt; a map of measured places only where the run has them.

    Raises WorkError("no-space", "cannot-write").
    """
    written = 0
    for n, (name, metapixels) in enumerate(zip(content.names, content.metapixels(), strict=True)):
        plain = safe_name(name)
        known = metapixels.valid & np.isfinite(metapixels.centre_px).all(axis=2)
        places = np.where(known[..., None], metapixels.centre_px, np.float32(np.nan))
        write_atomically(folder / f"{plain}-from-camera.exr", st_map(places, content.camera_px))
        written += 1
        seen = content.seen_px[n]
        if seen is not None:
            write_atomically(folder / f"camera-from-{plain}.exr", st_map(seen, content.sizes_px[n]))
            written += 1
    write_atomically(folder / "README.txt", _MAPS_README.encode())
    return {"maps": written}


def st_map(places_px: FloatImage, size_px: tuple[int, int]) -> bytes:
    """An EXR file of (rows, columns, 2) places x, y in a picture of ``size_px`` (width, height); NaN: unknown."""
    known = np.isfinite(places_px).all(axis=2)
    s = (places_px[..., 0] + np.float32(0.5)) / np.float32(size_px[0])
    t = 1 - (places_px[..., 1] + np.float32(0.5)) / np.float32(size_px[1])
    red, green = np.where(known, s, np.float32(0)), np.where(known, t, np.float32(0))
    return exr_bytes({"R": red, "G": green, "B": np.zeros_like(red), "A": np.asarray(known, np.float32)})


DATE: Final = "1980-01-01 00:00:00"
"""The earliest that a ZIP archive can name: the same calibration gives the same bytes."""
BUFFER: Final = "stage"
_MPCDI_README: Final = """\
MPCDI 2.0 files of a Velatura stage. Each has one region for each projector, named as on the stage.

stage-2d.mpcdi  profile 2d: for each projector pixel the place in the camera's picture, 0 to 1 from the left and from
                the top. The picture to be shown is one as seen from the camera.
stage-3d.mpcdi  profile 3d: the same places in the frustum of an ideal camera (without a lens's distortion), whose
                angles the region names. The eye is the camera.
stage-sl.mpcdi  profile sl (shader lamps): for each projector pixel the point that it lights, in metres. frustum and
                coordinateFrame are the projector's own pose and lens: x right, y up, z back from the camera, which is
                the origin. The distortion map says where each pixel is in the ideal frustum, 0 to 1 from the left and
                from the top.

Unknown places are NaN in the PFM files and 0 in the alpha map, which is 1 (white) elsewhere.

A superimposed solve is more than a warp. These files move a picture to its place on each projector, and no more. They
know nothing of the surface's paint, of each projector's brightness and colours, nor of the other projectors that light
the same place: several of them at once make it too bright, and their alpha maps do not share the light out. Pictures
for superimposed projectors come from `velatura appearance`.
"""
_AXES: Final = {"yaw": (0.0, -1.0, 0.0), "pitch": (1.0, 0.0, 0.0), "roll": (0.0, 0.0, -1.0)}
"""Which way down, right and forward are: y is up, the camera looks along -z."""
_TO_Y_UP: Final = np.diag([1.0, -1.0, -1.0])
"""From the calibration's frame: x right, y down, z forward."""


@dataclass(frozen=True, slots=True)
class _Region:
    """``warp`` (rows, columns, 3) float32, NaN where unknown; ``angles``, ``position_m`` where a profile has them."""

    name: str
    warp: FloatImage
    unit: str = ""
    origin: str = ""
    angles: Mapping[str, float] | None = None
    position_m: tuple[float, float, float] | None = None
    distortion: FloatImage | None = None


def write_mpcdi(content: Content, folder: Path) -> dict[str, int]:
    """Write a file for each profile, and README.txt. Raises WorkError("no-space", "cannot-write")."""
    camera = content.geometry.camera
    places = [
        np.where(one.valid[..., None] & np.isfinite(one.centre_px), one.centre_px, np.float32(np.nan))
        for one in content.metapixels()
    ]
    flat = [_Region(name, _in_picture(one, camera.size_px)) for name, one in zip(content.names, places, strict=True)]
    view = _frustum(camera, np.eye(3))
    seen = [
        _Region(name, _in_frustum(one, camera), angles=view) for name, one in zip(content.names, places, strict=True)
    ]
    lamps = [
        _lamp(name, one, content.geometry.points_m, own)
        for name, one, own in zip(content.names, places, content.geometry.projectors, strict=True)
    ]
    for profile, regions in (("2d", flat), ("3d", seen), ("sl", lamps)):
        write_atomically(folder / f"stage-{profile}.mpcdi", _archive(profile, regions, camera.size_px))
    write_atomically(folder / "README.txt", _MPCDI_README.encode())
    return {"files": 3, "regions": len(flat)}


def _lamp(name: str, places: FloatImage, points_m: FloatImage, own: Pinhole) -> _Region:
    """Each pixel's point on the surface, and the projector's pose with y up."""
    far = cv2.remap(
        points_m, places[..., 0], places[..., 1], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan, np.nan, np.nan),
    )  # fmt: skip
    points = np.asarray(far @ _TO_Y_UP.astype(np.float32), np.float32)
    points[~np.isfinite(points).all(axis=2)] = np.nan
    rows, columns = places.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float32)
    position = _TO_Y_UP @ (-own.rotation.T @ own.translation_m)
    return _Region(
        name, points, "m", "centerOfMass", _frustum(own, own.rotation), (position[0], position[1], position[2]),
        _in_frustum(pixels, own),
    )  # fmt: skip


def _frustum(own: Pinhole, rotation: Float64) -> dict[str, float]:
    """Degrees: yaw to the right, then pitch up, then roll clockwise as the projector sees it; the edges' angles."""
    right, _, forward = (_TO_Y_UP @ row for row in rotation)
    yaw = math.atan2(forward[0], -forward[2])
    level = np.array([math.cos(yaw), 0.0, math.sin(yaw)])
    above = np.cross(level, forward)
    width, height = own.size_px
    (fx, _, cx), (_, fy, cy) = own.matrix[0], own.matrix[1]
    radians = {
        "yaw": yaw, "pitch": math.asin(max(-1.0, min(1.0, float(forward[1])))),
        "roll": math.atan2(-float(right @ above), float(right @ level)),
        "rightAngle": math.atan((width - 0.5 - cx) / fx), "leftAngle": math.atan((-0.5 - cx) / fx),
        "upAngle": math.atan((cy + 0.5) / fy), "downAngle": -math.atan((height - 0.5 - cy) / fy),
    }  # fmt: skip
    return {key: math.degrees(value) for key, value in radians.items()}


def _in_picture(places_px: FloatImage, size_px: tuple[int, int]) -> FloatImage:
    """(rows, columns, 3): 0 to 1 from the left and from the top; the third is unused, NaN."""
    shares = (places_px + np.float32(0.5)) / np.array(size_px, np.float32)
    return np.concatenate([shares, np.full((*shares.shape[:2], 1), np.nan, np.float32)], axis=2)


def _in_frustum(places_px: FloatImage, own: Pinhole) -> FloatImage:
    """As ``_in_picture``, in the picture that the lens would make without its distortion."""
    known = np.isfinite(places_px).all(axis=2)
    straight = np.full(places_px.shape, np.nan, np.float64)
    straight[known] = own.straightened(places_px[known].astype(np.float64))
    return _in_picture(straight.astype(np.float32), own.size_px)


def _archive(profile: str, regions: list[_Region], camera_px: tuple[int, int]) -> bytes:
    root = ElementTree.Element("MPCDI", profile=profile, geometry="2", color="1", date=DATE, version="2.0")
    display = ElementTree.SubElement(root, "display")
    size = {"xResolution": str(camera_px[0]), "yResolution": str(camera_px[1])} if profile != "sl" else {}
    buffer = ElementTree.SubElement(display, "buffer", {"id": BUFFER, **size})
    files = ElementTree.SubElement(root, "files")
    stored: dict[str, bytes] = {}
    for region in regions:
        _describe(buffer, region)
        stored |= _maps(ElementTree.SubElement(files, "fileset", region=region.name), region)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {"mpcdi.xml": text, **stored}.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _describe(buffer: ElementTree.Element, region: _Region) -> None:
    rows, columns = region.warp.shape[:2]
    place = {"x": "0.0", "y": "0.0", "xsize": "1.0", "ysize": "1.0"}
    own = ElementTree.SubElement(
        buffer, "region", {"id": region.name, "xResolution": str(columns), "yResolution": str(rows), **place}
    )
    if region.angles is not None:
        _values(ElementTree.SubElement(own, "frustum"), region.angles)
    if region.position_m is not None:
        frame = {f"pos{axis}": value for axis, value in zip("xyz", region.position_m, strict=True)}
        frame |= {f"{name}{axis}": v for name, arrow in _AXES.items() for axis, v in zip("xyz", arrow, strict=True)}
        _values(ElementTree.SubElement(own, "coordinateFrame"), frame)


def _maps(fileset: ElementTree.Element, region: _Region) -> dict[str, bytes]:
    plain = safe_name(region.name)
    unit = {"geometricUnit": region.unit, "originof3DData": region.origin} if region.unit else {}
    names = {"geometryWarpFile": f"{plain}-warp.pfm", "alphaMap": f"{plain}-alpha.png"}
    _texts(ElementTree.SubElement(fileset, "geometryWarpFile"),
           {"path": names["geometryWarpFile"], "interpolation": "linear", **unit})  # fmt: skip
    _texts(ElementTree.SubElement(fileset, "alphaMap"),
           {"path": names["alphaMap"], "componentDepth": "1", "bitDepth": "8", "gammaEmbedded": "1.0"})  # fmt: skip
    known: Mask = np.asarray(np.isfinite(region.warp[..., :2]).all(axis=2), np.bool_)
    stored = {names["geometryWarpFile"]: _pfm(region.warp), names["alphaMap"]: _png(known)}
    if region.distortion is not None:
        stored[f"{plain}-distortion.pfm"] = _pfm(region.distortion)
        _texts(ElementTree.SubElement(fileset, "distortionMap"), {"path": f"{plain}-distortion.pfm"})
    return stored


def _values(parent: ElementTree.Element, values: Mapping[str, float]) -> None:
    _texts(parent, {key: f"{value:.12f}" for key, value in values.items()})


def _texts(parent: ElementTree.Element, texts: Mapping[str, str]) -> None:
    for key, text in texts.items():
        ElementTree.SubElement(parent, key).text = text


def _pfm(values: FloatImage) -> bytes:
    rows, columns = values.shape[:2]
    return f"PF\n{columns} {rows}\n-1.0\n".encode() + np.ascontiguousarray(values[::-1], "<f4").tobytes()


def _png(known: Mask) -> bytes:
    done, data = cv2.imencode(".png", np.where(known, np.uint8(255), np.uint8(0)))
    assert done
    return bytes(data.tobytes())
