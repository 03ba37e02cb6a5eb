"""White figures without a display, and their pixels; a report needs no more, and nothing of robots and meshes."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def canvas_of(width: int, height: int, dpi: int = 100) -> tuple[Figure, FigureCanvasAgg]:
    """A white figure of so many pixels, without a display."""
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    return figure, FigureCanvasAgg(figure)


def pixels(canvas: FigureCanvasAgg) -> np.ndarray:
    """Draw, and return the picture as uint8 [height, width, 3]."""
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
