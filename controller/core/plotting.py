"""Figures of matplotlib and their pictures, without a window.

matplotlib is imported with the first figure, so that other code does not wait for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from controller.core.arrays import ByteImage


def figure_of(size_in: tuple[float, float], *, dpi: int, constrained: bool = False) -> Any:
    """An empty figure (width, height) in inches; ``constrained``: its parts do not overlap."""
    # Agg directly: pyplot would look for a window system, and keeps every figure in memory.
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from controller.core.lettering import register_for_plots

    mpl.rcParams["font.family"] = [register_for_plots(), "DejaVu Sans"]
    figure = Figure(figsize=size_in, dpi=dpi, layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


def picture_of(figure: Any) -> ByteImage:
    """(rows, columns, 3) uint8 RGB of a figure of ``figure_of``, whose background must be opaque."""
    figure.canvas.draw()
    return np.array(np.asarray(figure.canvas.buffer_rgba())[..., :3], np.uint8)
