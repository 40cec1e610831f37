"""Results of a comparison: one JSON file with every score, and a page with tables and pictures made from it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.optics.solve.result.metrics import TITLES, as_table
from controller.stage.report.pictures import crop_around
from lab.compare.entries import TARGET
from lab.compare.evaluation import TARGETS, Evaluation
from lab.study.output.drawing import LabelledPicture, encoded_webp, screen, strip
from lab.study.output.keeping import plain
from lab.study.output.pages import markdown
from lab.study.subject.subject import ReachableTarget, Subject

FORMAT: Final = 1
RESULTS, PAGE, PICTURES = "comparison.json", "README.md", "pictures"

INTRODUCTION: Final = """\
Each method measured the same emulated stages with photographs of its own patterns, then made frames for the same
targets. These frames were then shown and photographed. Nothing knows the true values of a stage. The bench's
optics share no code with the controller.

Error: CIEDE2000, median / 95 % of the pixels. *In reach*: where Velatura's calibration says that the projectors can
make the target. *All lit pixels*: where some projector lights the object. *Whole visible object*: also where none does.
FLIP: its mean over all lit pixels, where flip-evaluator is installed. Photographs: every exposure until the last
target's frames were made; those that score the frames are not counted. Seconds: to measure the stage, and to make the
frames of a target; they depend on the computer and its load."""


def as_content(evaluation: Evaluation) -> dict[str, Any]:
    """One method on one scene, for the JSON file."""
    failed = None if evaluation.failed is None else {"code": evaluation.failed.code, "what": evaluation.failed.what}
    return {
        "photographs": evaluation.photographs,
        "seconds": evaluation.seconds,
        "failed": failed,
        "targets": {
            score.target: {
                "seconds": score.seconds,
                "failed": None if score.failed is None else {"code": score.failed.code, "what": score.failed.what},
                "pixels": as_table(dict(score.pixels)) if score.pixels else None,
                "flip": score.flip,
            }
            for score in evaluation.scores
        },
    }


def save_pictures(
    folder: Path, name: str, subject: Subject, targets: Mapping[str, ReachableTarget], evaluation: Evaluation
) -> list[Path]:
    """Crops of the method's photographs as a screen shows them, ``NAME-TARGET.png``, and of the targets."""
    crop = crop_around(subject.mask)
    matrix, paths = subject.calibration.camera_to_xyz, []
    shown = {target: wanted.radiance for target, wanted in targets.items()}
    photographs = {score.target: score.photograph for score in evaluation.scores if score.photograph is not None}
    for who, images in ((TARGET, shown), (name, photographs)):
        for target, image in images.items():
            picture = screen(image, matrix, targets[target].white, crop)
            ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
            assert ok
            paths.append(folder / f"{who}-{target}.png")
            write_atomically(paths[-1], bytes(data.tobytes()))
    return paths


def encoded(content: Mapping[str, Any]) -> bytes:
    """JSON with numbers that are not finite as null."""
    return (json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def update_leaderboard(out: Path, size: str, rows: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Take over rows (scene, seed, method and ``as_content``) into ``out``'s JSON file; others stay. The content.

    Raises UsageError("benchmark-unreadable").
    """
    path = out / RESULTS
    kept: dict[tuple[str, int, str], Any] = {}
    if path.exists():
        try:
            before = json.loads(path.read_bytes())
            kept = {_key(row): row for row in before["results"] if before["format"] == FORMAT}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(
                "benchmark-unreadable",
                what=f"{path} can't be read as results of a comparison ({error}).",
                remedy="Remove the file; the same command writes it again from the finished work.",
            ) from error
    kept.update({_key(row): row for row in rows})
    content = {"format": FORMAT, "size": size, "results": [kept[key] for key in sorted(kept, key=lambda key: key[:2])]}
    write_atomically(path, encoded(content))
    return content


def _key(row: Mapping[str, Any]) -> tuple[str, int, str]:
    return str(row["scene"]), int(row["seed"]), str(row["method"])


def strips(out: Path, results: Sequence[Mapping[str, Any]], pictures: Callable[[str, int], Path]) -> None:
    """Write ``pictures/SCENE-SEED-TARGET.webp``: the target and each method's photograph of it.

    ``pictures``: the folder with the pictures of a scene and seed, as ``save_pictures`` leaves them
    """
    (out / PICTURES).mkdir(parents=True, exist_ok=True)
    for scene, seed in _stages(results):
        names = [str(row["method"]) for row in results if (row["scene"], row["seed"]) == (scene, seed)]
        for target in TARGETS:
            files = {name: pictures(scene, seed) / f"{name}-{target}.png" for name in (TARGET, *names)}
            panels = [LabelledPicture(name, _read(file)) for name, file in files.items() if file.exists()]
            if panels:
                write_atomically(out / PICTURES / _strip_name(scene, seed, target),
                                 encoded_webp(strip(panels, columns=3)))  # fmt: skip


def write_page(out: Path, content: Mapping[str, Any], about: Mapping[str, str], scenes: Mapping[str, str]) -> Path:
    """Write the page of all results in ``content``; ``about`` methods and ``scenes``: in a line each."""
    results = content["results"]
    listed = [f"- **{name}**: {text}." for name, text in about.items()]
    parts = ["# Comparison of methods", INTRODUCTION, f"Size {content['size']}.", "## Methods", "\n".join(listed)]
    parts += ["## All targets", "Means over the targets of a scene.", _overall(results)]
    for scene, seed in _stages(results):
        rows = [row for row in results if (row["scene"], row["seed"]) == (scene, seed)]
        parts += [f"## {scene}, seed {seed}", f"Scene: {scenes.get(scene, scene)}.", _scene_table(rows)]
        for target, text in TARGETS.items():
            name = _strip_name(scene, seed, target)
            if (out / PICTURES / name).exists():
                parts.append(f"![{target}]({PICTURES}/{name})\n\n*{target}: {text}.*")
    parts.append(f"Every figure: [{RESULTS}]({RESULTS}).")
    page = out / PAGE
    write_atomically(page, ("\n\n".join(parts) + "\n").encode())
    return page


def _overall(results: Sequence[Mapping[str, Any]]) -> str:
    columns = ("scene", "seed", "method", "photographs", *TITLES.values(), "FLIP", "targets made")
    rows = []
    for row in results:
        made = [one for one in row["targets"].values() if one["pixels"] is not None]
        cells = [_mean([one["pixels"][key] for one in made]) for key in TITLES]
        flips = [one["flip"] for one in made if one["flip"] is not None]
        flip = f"{np.mean(flips):.3f}" if flips and len(flips) == len(made) else ""
        note = f"{len(made)}" if row["failed"] is None else f"none: {row['failed']['code']}"
        rows.append((row["scene"], row["seed"], row["method"], row["photographs"], *cells, flip, note))
    return markdown(columns, rows)


def _scene_table(results: Sequence[Mapping[str, Any]]) -> str:
    columns = ("target", "method", *TITLES.values(), "in reach leaves out", "FLIP", "seconds")
    rows = []
    for target in TARGETS:
        for row in results:
            one = row["targets"].get(target)
            if one is None or one["failed"] is not None:
                failed = (one or row)["failed"]
                reason = "" if failed is None else f"{failed['code']}: {failed['what']}"
                rows.append((target, row["method"], reason, "", "", "", "", ""))
                continue
            cells = [_pair(one["pixels"][key]) for key in TITLES]
            left_out = f"{one['pixels']['in_reach']['left_out_share']:.1%}"
            rows.append(
                (target, row["method"], *cells, left_out, one["flip"], f"{row['seconds']:.0f} + {one['seconds']:.0f}")
            )
    return markdown(columns, rows)


def _pair(one: Mapping[str, Any]) -> str:
    return "" if one["delta_e00_median"] is None else f"{one['delta_e00_median']:.2f} / {one['delta_e00_p95']:.1f}"


def _mean(sets: Sequence[Mapping[str, Any]]) -> str:
    keys = ("delta_e00_median", "delta_e00_p95")
    known = [one for one in sets if one["delta_e00_median"] is not None]
    return _pair({key: float(np.mean([one[key] for one in known])) for key in keys}) if known else ""


def _stages(results: Sequence[Mapping[str, Any]]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((str(row["scene"]), int(row["seed"])) for row in results))


def _strip_name(scene: str, seed: int, target: str) -> str:
    return f"{scene}-{seed}-{target}.webp"


def _read(path: Path) -> ByteImage:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None
    return np.ascontiguousarray(np.asarray(image, np.uint8)[..., ::-1])
