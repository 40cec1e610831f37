"""How time and memory of a solve grow with the stage, from a sixteenth of the paper's size to twice it.

Each size is measured in a process of its own, for its peak memory. ``python -m lab.timings.solving.growth FRACTION`` is
that process; it prints one line of JSON.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

import numpy as np

from controller.optics.solve.appearance import base_image
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.transport import LightTransport, build_transport
from lab.timings import Row, at_most, peak_bytes
from lab.timings.tools.synthetic import CAMERA, PROJECTOR, synthetic_calibration

FRACTIONS: Final = {"small": (1 / 64, 1 / 16), "medium": (1 / 16, 1 / 8, 1 / 4), "paper": (1 / 16, 1 / 4, 1 / 2, 1, 2)}
SWEEPS: Final = 8
PICTURE: Final = Path("docs/pictures/growth.png")
EVEN: Final = 1.2


def measure(size: str) -> list[Row]:
    """Time of a sweep and memory by projector pixel, at fractions of the paper's number of pixels."""
    found = [_apart(fraction) for fraction in FRACTIONS[size]]
    rows = []
    for one in found:
        of, how = f"{one['fraction']:g} of paper", f"fastest of {SWEEPS}; peak {one['peak'] / 1e9:.2f} GB"
        rows.append(at_most(f"a sweep, {of}", one["ns"], None, unit="ns a projector pixel", how=how))
        rows.append(at_most(f"memory, {of}", one["bytes"], None, unit="bytes a projector pixel", how=how))
    for what, key in (("time", "ns"), ("memory", "bytes")):
        values = [one[key] for one in found]
        rows.append(at_most(f"{what} a pixel, most by least", max(values) / min(values), EVEN, unit="x", how=""))
    if size == "paper":
        _draw(found)
    return rows


def _apart(fraction: float) -> dict[str, float]:
    ran = subprocess.run(
        [sys.executable, "-m", "lab.timings.solving.growth", repr(fraction)], check=True, capture_output=True, text=True
    )
    result: dict[str, float] = json.loads(ran.stdout.splitlines()[-1])
    return result


def _sized(size: tuple[int, int], fraction: float) -> tuple[int, int]:
    rows, columns = (2 * round(side * math.sqrt(fraction) / 2) for side in size)
    return rows, columns


def one_size(fraction: float) -> dict[str, float]:
    """Build and solve at that part of the paper's pixels, after a tiny stage for which the compiled code is loaded."""
    _solved(1 / 1024)
    before = peak_bytes()
    transport, at = _solved(fraction)
    peak = peak_bytes()
    ns = 1e9 * float(np.diff(at).min()) / transport.pixels
    return {"fraction": fraction, "ns": ns, "bytes": (peak - before) / transport.pixels, "peak": peak}


def _solved(fraction: float) -> tuple[LightTransport, list[float]]:
    """The transport, and when each sweep ended."""
    calibration = synthetic_calibration(
        projector=_sized(PROJECTOR["paper"], fraction), camera=_sized(CAMERA["paper"], fraction)
    )
    transport = build_transport(calibration)
    at: list[float] = []
    image = base_image(calibration, "white")
    solve_bounded(
        transport,
        image,
        calibration.black,
        SolveSettings(tolerance=0, most_iterations=SWEEPS + 1),
        SolveContext(progress=lambda iteration, kkt: at.append(time.perf_counter())),
    )
    return transport, at


def _draw(found: list[dict[str, float]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3), constrained_layout=True)
    of_paper = [one["fraction"] for one in found]
    for axis, key, title in zip(
        axes, ("ns", "bytes"), ("a sweep, ns a projector pixel", "memory, bytes a projector pixel"), strict=True
    ):
        values = [one[key] for one in found]
        axis.axhspan(min(values), EVEN * min(values), color="0.9", label="20 % above the least")
        axis.semilogx(of_paper, values, "o-", base=2)
        axis.set(title=title, xlabel="pixels, of the paper's", ylim=(0, 1.15 * max(*values, EVEN * min(values))))
        axis.set_xticks(of_paper, [f"1/{1 / part:g}" if part < 1 else f"{part:g}" for part in of_paper])
        axis.legend(loc="lower right")
    figure.savefig(PICTURE, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    print(json.dumps(one_size(float(sys.argv[1]))))
