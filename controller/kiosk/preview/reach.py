"""How much of a target the projectors can make, and what the object will look like, before anything is solved."""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import ByteImage, FloatImage, Mask, load_arrays
from controller.core.storage import write_atomically
from controller.kiosk.store.targets import fitted, png_size
from controller.kiosk.values import Reach
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.check import Checked

if TYPE_CHECKING:
    from controller.kiosk.preview.preview_light import PreviewLight
    from controller.optics.solve.reach.feasibility import Feasibility
    from controller.optics.solve.request import Aim
    from controller.optics.solve.targets.values import Target

LONGEST_PX: Final = 960
"""The longer side."""


def write_picture(path: Path, rgb: ByteImage, seen: Mask) -> None:
    """``rgb`` (rows, columns, 3) where ``seen``, with black around it; the file's ending says how it is encoded."""
    import cv2

    from controller.stage.report.pictures import crop_around

    box = crop_around(seen)
    cut: npt.NDArray[np.uint8] = np.where(seen[..., None], rgb, 0).astype(np.uint8)[box.rows, box.columns, ::-1]
    scale = LONGEST_PX / max(cut.shape[:2])
    if scale < 1:
        size_px = (max(1, round(cut.shape[1] * scale)), max(1, round(cut.shape[0] * scale)))
        cut = np.asarray(cv2.resize(cut, size_px, interpolation=cv2.INTER_AREA), np.uint8)
    write_atomically(path, cv2.imencode(path.suffix, cut)[1].tobytes())


FOLDER, KEPT = "kiosk/feasibility", 20
FIGURES: Final = "reach.json"
FILES: Final = {"target": "target.jpg", "result": "result.jpg", "map": "map.png"}
BRIGHT, DARK, COLOURFUL, UNLIT = (240, 179, 90), (90, 140, 255), (216, 96, 190), (58, 60, 66)
"""Colours of the map, as in the page's legend: too bright, too dark, too saturated, and not lit or not asked for."""
ALIKE: Final = 2.0
"""CIEDE2000 below which a result looks like its target; 1 can just be seen side by side."""
_one_at_a_time = threading.Lock()


def reach(checked: Checked, target: Path) -> Reach:
    """Shares of the visible object, and three pictures of it; kept until target, calibration or settings change.

    Raises UsageError("not-calibrated", "target-unreadable"), WorkError("no-light", "no-space").
    """
    run = finished_calibration(checked.stage.folder)
    folder, about = kept_at(checked, run, target)
    with _one_at_a_time:
        if (known := _kept(folder, about)) is not None:
            return known
        _keep_newest(folder.parent, KEPT - 1)
        found = _made(checked, run, target, folder)
        write_atomically(folder / FIGURES, json.dumps({"of": about, "shares": _shares(found)}).encode())
        return found


def kept_at(checked: Checked, run: Path, target: Path) -> tuple[Path, dict[str, Any]]:
    """The folder of a target's previews, and what they depend on: others are made where it differs."""
    solve = repr(checked.stage.tables.solve)
    about = {"run": run.name, "changed_ns": target.stat().st_mtime_ns, "solve": solve}
    return checked.stage.folder / FOLDER / target.stem[:64], about


def _shares(found: Reach) -> dict[str, float]:
    return {key: value for key, value in asdict(found).items() if key != "pictures"}


def _kept(folder: Path, about: dict[str, Any]) -> Reach | None:
    pictures = {name: folder / file for name, file in FILES.items()}
    try:
        content = json.loads((folder / FIGURES).read_text())
        if content["of"] != about or not all(file.is_file() for file in pictures.values()):
            return None
        return Reach(**content["shares"], pictures=pictures)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _made(checked: Checked, run: Path, target: Path, folder: Path) -> Reach:
    from controller.kiosk.preview.preview_light import preview_light
    from controller.optics.solve.reach.feasibility import with_less_light
    from controller.optics.solve.request import aim_at
    from controller.optics.solve.result.metrics import visible_object
    from controller.stage.steps.appearance.solving import options_of

    light = preview_light(checked.stage.folder, run, checked.names)
    wanted = _wanted(light, target)
    aim = aim_at(light.drive, light.black, light.indirect, wanted.image, options_of(checked.stage.tables.solve))
    lit = light.drive.mask
    seen = visible_object(lit)
    folder.mkdir(parents=True, exist_ok=True)
    grey, alike = _drawn(folder, light, aim, seen)
    kinds = kinds_of(aim.asked_possible, lit & wanted.mask, alike)
    write_picture(folder / FILES["map"], map_of(kinds, grey), seen)
    area = max(1, int(seen.sum()))
    share = {name: float((mask & seen).sum() / area) for name, mask in kinds.items()}
    pictures = {name: folder / file for name, file in FILES.items()}
    _, less, less_share = with_less_light(
        light.drive, wanted, light.black, exposure=aim.exposure, indirect=light.indirect
    )
    return Reach(
        share["share"], share["too_bright"], share["too_dark"], share["too_colourful"], pictures, round(light.step),
        light=less, light_share=less_share, held_back=float(aim.figures["held_back"] or 1),
    )  # fmt: skip


def _wanted(light: PreviewLight, target: Path) -> Target:
    from controller.optics.solve.targets.files import load_target
    from controller.optics.solve.targets.values import Target

    rows, columns = light.drive.mask.shape
    if target.suffix == ".npz":
        # Rendered for these very samples, by ``scenes``.
        arrays = load_arrays(target)
        return Target(arrays["image"], arrays["mask"])
    if target.suffix.lower() == ".exr":
        # Rendered for this view already.
        whole = load_target(target, light.camera_px)
        return Target(
            _shrunk(whole.image, (columns, rows)), _shrunk(whole.mask.astype(np.float32), (columns, rows)) > 0.5
        )
    with tempfile.TemporaryDirectory() as scratch:
        small = Path(scratch) / "target.png"
        # Made small before its colours become light: on a whole picture that alone takes a second.
        picture = target.read_bytes()
        of_view = png_size(picture) == light.camera_px
        small.write_bytes(fitted(picture, (columns, rows), "stretch" if of_view else "fit"))
        return load_target(small, (columns, rows))


def _shrunk(image: FloatImage, size_px: tuple[int, int]) -> FloatImage:
    import cv2

    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.float32)


def kinds_of(possible: Feasibility, asked: Mask, alike: Mask) -> dict[str, Mask]:
    """Masks (rows, columns) that exclude each other, by the shares of ``Reach``; ``asked``: lit, and in the picture;
    ``alike``: no one sees that it is not quite in reach, as where the room has a little more light than a dark channel.
    """
    bright, dark = possible.too_bright, possible.too_dark
    reached = possible.reachable | alike
    out = asked & ~reached
    return {
        "share": asked & reached,
        "too_bright": out & bright & ~dark,
        "too_dark": out & dark & ~bright,
        "too_colourful": out & (bright == dark),
    }


def _drawn(folder: Path, of: PreviewLight, aim: Aim, seen: Mask) -> tuple[ByteImage, Mask]:
    """Write what was asked for and the expected result; returns the first one in grey, (rows, columns) uint8, and where
    the two look alike.
    """
    from controller.optics.solve.result.metrics import colour_difference
    from controller.stage.report.pictures import to_screen

    light: FloatImage = np.clip(aim.direct - of.black, 0, of.drive.reach)
    made = light if of.indirect is None else light + of.indirect.forward(light)
    out = seen & ~aim.asked_possible.reachable
    difference = colour_difference(of.black + made, aim.asked, of.camera_to_xyz, aim.exposure, out)
    asked, result = (to_screen(image, of.camera_to_xyz, white=aim.exposure) for image in (aim.asked, of.black + made))
    write_picture(folder / FILES["target"], asked, seen)
    write_picture(folder / FILES["result"], result, seen)
    return np.asarray(asked.mean(axis=2), np.uint8), out & (difference < ALIKE)


def map_of(kinds: dict[str, Mask], grey: ByteImage) -> ByteImage:
    """(rows, columns, 3) uint8: dimmed where it is in reach, a colour for each reason where it is not."""
    picture = np.full((*grey.shape, 3), UNLIT, np.uint8)
    picture[kinds["share"]] = (grey[kinds["share"]] // 2 + 40)[:, None]
    for name, colour in (("too_bright", BRIGHT), ("too_dark", DARK), ("too_colourful", COLOURFUL)):
        picture[kinds[name]] = colour
    return picture


def _keep_newest(folder: Path, most: int) -> None:
    """Each uploaded target gets its own pictures, so a kiosk would collect them for months."""
    if not folder.is_dir():
        return
    for _, old in sorted((entry.stat().st_mtime_ns, entry) for entry in folder.iterdir())[:-most]:
        if old.is_dir():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.unlink(missing_ok=True)
