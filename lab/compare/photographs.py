"""Real photographs as a stage: projected pictures and what a camera saw of them, in folders as of public data sets.

Nothing can be projected on such a stage any more. So a method learns from the pairs in ``train``, then gets
the photographs in ``test`` and says what was projected: what it would project to see that photograph again, of
which one answer is known to be right (Huang and Ling, "End-to-end projector photometric compensation", CVPR 2019).
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.colour import Unsuitable, srgb_to_linear
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.pictures import read_picture_file
from controller.core.storage import write_atomically
from controller.optics.capture.raw import SRGB_TO_XYZ
from controller.optics.solve.result.metrics import colour_difference
from controller.run.progress import Reporter
from hal.deadline import Cancelled
from lab.compare.entries import Entry
from lab.compare.learned import Pair
from lab.study.output.drawing import LabelledPicture, encoded_webp, strip
from lab.study.output.keeping import plain
from lab.study.output.pages import markdown
from lab.study.subject.likeness import structural_similarity

RESULTS, PAGE, STRIP = "photographs.json", "photographs.md", "photographs.webp"
PHOTOGRAPHED: Final = Path("cam") / "raw"
PROJECTED: Final = (Path("prj"), Path("prj_share"), Path())
"""In the set-up's folder or in one above it, which several set-ups share."""
ABOVE: Final = 4
ENDINGS: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
FEWEST: Final = 8


@dataclass(frozen=True, slots=True)
class Answered:
    """How near a method's answers are to what was projected, means over all test pictures.

    ``psnr_db``, ``rmse`` (of 0 to 1) and ``ssim`` of sRGB values; ``delta_e00_median``, ``delta_e00_p95``: CIEDE2000
    """

    psnr_db: float
    rmse: float
    ssim: float
    delta_e00_median: float
    delta_e00_p95: float


@dataclass(frozen=True)
class PairFolder:
    """``learned.Pairs`` of files: ``projected`` and ``photographed``, of the same names in both folders."""

    projected: Path
    photographed: Path
    check: Callable[[], None] = lambda: None
    """Called before each pair is read."""

    @cached_property
    def _files(self) -> tuple[Mapping[str, Path], Mapping[str, Path]]:
        return _pictures(self.projected), _pictures(self.photographed)

    @cached_property
    def names(self) -> Sequence[str]:
        """Raises UsageError("pairs-unequal", "pairs-missing")."""
        shown, seen = self._files
        alone = sorted({*shown} ^ {*seen})
        if alone:
            raise UsageError(
                "pairs-unequal",
                what=f"{alone[0]} and {len(alone) - 1} more are in {self.projected} or {self.photographed} alone.",
                remedy="Give a picture and its photograph the same name in both folders, and remove what has no other.",
            )
        if len(shown) < FEWEST:
            raise UsageError(
                "pairs-missing",
                what=f"{self.photographed} has {len(shown)} photographs.",
                remedy=f"Name a folder with at least {FEWEST} pairs to learn from, and as many to judge by.",
            )
        return sorted(shown)

    @cached_property
    def _sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        shown, seen = self._pair(self.names[0])
        return (shown.shape[1], shown.shape[0]), (seen.shape[1], seen.shape[0])

    @property
    def projector_px(self) -> tuple[int, int]:
        return self._sizes[0]

    @property
    def camera_px(self) -> tuple[int, int]:
        return self._sizes[1]

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Pair]:
        """Raises UsageError("pairs-unreadable", "pairs-unequal")."""
        for name in self.names:
            self.check()
            shown, seen = self._pair(name)
            for one, size in ((shown, self.projector_px), (seen, self.camera_px)):
                if (one.shape[1], one.shape[0]) != size:
                    raise UsageError(
                        "pairs-unequal",
                        what=f"{name} has {one.shape[1]}x{one.shape[0]} pixels, and others have {size[0]}x{size[1]}.",
                        remedy="Use pictures of one size, and photographs of one size.",
                    )
            yield shown, seen

    def _pair(self, name: str) -> Pair:
        shown, seen = self._files
        return _read(shown[name]), _read(seen[name])


def pair_folders(folder: Path) -> tuple[PairFolder, PairFolder]:
    """The pairs to learn from and those to judge by. Raises UsageError("pairs-missing", "pairs-unequal").

    ``folder``: a set-up, with photographs in ``cam/raw/train`` and ``cam/raw/test``. The projected pictures are in its
    ``prj/train`` and ``prj/test``, or in ``train`` and ``test`` (also ``prj_share/train``) of a folder above it.
    """
    folder = folder.resolve()
    seen = [folder / PHOTOGRAPHED / part for part in ("train", "test")]
    places = [above / kind for above in (folder, *folder.parents[:ABOVE]) for kind in PROJECTED]
    whole = [place for place in places if (place / "train").is_dir() and (place / "test").is_dir()]
    if not all(one.is_dir() for one in seen) or not whole:
        raise UsageError(
            "pairs-missing",
            what=f"{folder} is no set-up of projected pictures and photographs.",
            remedy="Name the folder with cam/raw/train and cam/raw/test, in or beside a folder with train and test.",
        )
    learn, judge = (PairFolder(whole[0] / one.name, one) for one in seen)
    for pairs in (learn, judge):
        assert pairs.names
    if (learn.projector_px, learn.camera_px) != (judge.projector_px, judge.camera_px):
        raise UsageError(
            "pairs-unequal",
            what=f"The pictures of {learn.photographed} and {judge.photographed} differ in size.",
            remedy="Use pictures of one size, and photographs of one size.",
        )
    return learn, judge


def compare_on_photographs(
    entered: Sequence[Entry], folder: Path, out: Path, reporter: Reporter, cancel: threading.Event
) -> Mapping[str, Any]:
    """Let each method learn, and judge its answers; the paths of the page and the JSON file, written after each method.

    Raises as ``pair_folders`` and ``PairFolder``, before any method learns, and Cancelled. What a method raises stands
    in the results.
    """
    learn, judge = pair_folders(folder)
    rows: list[dict[str, Any]] = []
    shown, seen = next(iter(judge))
    panels = [LabelledPicture("photograph", seen), LabelledPicture("was projected", shown)]
    out.mkdir(parents=True, exist_ok=True)
    for entry in entered:
        reporter.say(f"{entry.name} learns from {len(learn)} pairs, and answers {len(judge)} photographs.")
        row, first = _judged(entry, learn, judge, cancel)
        rows.append({"method": entry.name, "about": entry.about, **row})
        panels += [] if first is None else [LabelledPicture(entry.name, first)]
        content = {"folder": folder.name, "learned_from": len(learn), "judged_by": len(judge), "results": rows}
        write_atomically(out / RESULTS, (json.dumps(plain(content), indent=1, allow_nan=False) + "\n").encode())
        write_atomically(out / STRIP, encoded_webp(strip(panels, columns=3)))
        write_atomically(out / PAGE, _page(content).encode())
    return {"page": str(out / PAGE), "results": str(out / RESULTS)}


def _judged(
    entry: Entry, learn: PairFolder, judge: PairFolder, cancel: threading.Event
) -> tuple[dict[str, Any], ByteImage | None]:
    began_s = time.perf_counter()
    first: ByteImage | None = None
    found: list[Answered] = []

    def check() -> None:
        if cancel.is_set():
            raise Cancelled

    try:
        answer = entry.method(replace(learn, check=check))
        learned_s = time.perf_counter() - began_s
        for shown, seen in replace(judge, check=check):
            frame = np.array(answer(seen.copy()))
            if frame.shape != shown.shape or frame.dtype != np.uint8:
                raise WorkError(
                    "benchmark-frames-wrong",
                    what=f"The answer is {frame.shape} of {frame.dtype}, and not {shown.shape} of uint8.",
                    remedy="Return a picture for the projector, (rows, columns, 3) of uint8, red first.",
                )
            first = frame if first is None else first
            found.append(answered(frame, shown))
    except Cancelled:
        raise
    except UsageError:
        raise
    except Exception as error:  # noqa: BLE001 - another's code may raise anything, and the other methods continue
        check()
        code = error.code if isinstance(error, VelaturaError) else "benchmark-method-failed"
        what = error.what if isinstance(error, VelaturaError) else f"{type(error).__name__}: {error}"
        return {"failed": {"code": code, "what": what}}, None
    means = {key: float(np.mean([asdict(one)[key] for one in found])) for key in asdict(found[0])}
    spent_s = time.perf_counter() - began_s - learned_s
    return {"failed": None, "learn_s": learned_s, "answer_s": spent_s / len(found), **means}, first


def answered(frame: ByteImage, shown: ByteImage) -> Answered:
    """How near one answer is to what was projected, all pixels."""
    one, other = (np.asarray(picture / np.float32(255), np.float32) for picture in (frame, shown))
    square = float(np.mean(np.square(one - other, dtype=np.float64)))
    light, wanted = (srgb_to_linear(picture) for picture in (frame, shown))
    error = colour_difference(light, wanted, SRGB_TO_XYZ, 1.0, np.ones(shown.shape[:2], np.bool_))
    return Answered(
        psnr_db=math.inf if square == 0 else -10 * math.log10(square),
        rmse=math.sqrt(square),
        ssim=float(structural_similarity(one, other).mean()),
        delta_e00_median=float(np.median(error)),
        delta_e00_p95=float(np.percentile(error, 95)),
    )


def _page(content: Mapping[str, Any]) -> str:
    columns = ("method", "PSNR, dB", "RMSE", "SSIM", "CIEDE2000", "seconds")
    rows: list[tuple[Any, ...]] = []
    for row in content["results"]:
        if row["failed"] is not None:
            rows.append((row["method"], f"{row['failed']['code']}: {row['failed']['what']}", "", "", "", ""))
            continue
        error = f"{row['delta_e00_median']:.2f} / {row['delta_e00_p95']:.1f}"
        seconds = f"{row['learn_s']:.0f} + {row['answer_s']:.2g}"
        rows.append(
            (row["method"], f"{row['psnr_db']:.2f}", f"{row['rmse']:.4f}", f"{row['ssim']:.3f}", error, seconds)
        )
    listed = "\n".join(f"- **{row['method']}**: {row['about']}." for row in content["results"])
    return "\n\n".join([
        f"# Methods on photographs: {content['folder']}",
        f"Each method learned from {content['learned_from']} pairs, then said of {content['judged_by']} other "
        "photographs what was projected. Means over these; CIEDE2000: median / 95 % of the pixels. Seconds: to learn, "
        "and for an answer.",
        listed, markdown(columns, rows), f"![The first photograph, and the answers]({STRIP})",
        f"Every figure: [{RESULTS}]({RESULTS}).",
    ]) + "\n"  # fmt: skip


def _pictures(folder: Path) -> Mapping[str, Path]:
    return {file.stem: file for file in folder.iterdir() if file.suffix.lower() in ENDINGS}


def _read(path: Path) -> ByteImage:
    try:
        return read_picture_file(path).bytes_shown()
    except Unsuitable as error:
        raise UsageError(
            "pairs-unreadable", what=f"{path} can't be read ({error}).", remedy="Replace or remove it, in both folders."
        ) from error
