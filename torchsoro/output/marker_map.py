"""A picture of a body from one side, with the places of its markers."""

from __future__ import annotations

import numpy as np

from torchsoro.output.canvas import canvas_of, pixels

PIXELS = 900  # of the longer edge


def marker_map(seen: np.ndarray, markers: dict[str, np.ndarray], axis: int, side: int, spacing: float) -> np.ndarray:
    """Draw what a camera sees, nearer parts lighter.

    Args:
        seen: Places of the material points that it sees [N, 3] m.
        markers: Places by name [3] m.
        axis: Along which it looks.
        side: +1 if it stands on the positive side of the body, -1 if on the other.
        spacing: Of the material points [m].

    Returns:
        The picture, uint8 [height, width, 3].
    """
    across = [a for a in range(3) if a != axis]
    first = seen[:, across].min(0)
    column = np.round((seen[:, across] - first) / spacing).astype(int)
    depth = np.full(column.max(0) + 1, np.nan)
    depth[tuple(column.T)] = side * seen[:, axis]
    begin = 1e3 * (first - spacing / 2)
    end = begin + 1e3 * spacing * np.array(depth.shape)
    # Seen from the positive side of y, or the negative one of x, the horizontal axis runs to the left.
    turned = side * (1 if axis == 1 else -1) > 0
    share = PIXELS / (end - begin).max()
    width, height = (end - begin) * share
    figure, canvas = canvas_of(round(width) + 120, round(height) + 110)
    axes = figure.add_axes((80 / (width + 120), 70 / (height + 110), width / (width + 120), height / (height + 110)))
    near, far = np.nanmax(depth), np.nanmin(depth)
    extent = (begin[0], end[0], begin[1], end[1])
    # The nearest parts are grey, not white as what is around the body.
    axes.imshow(depth.T, origin="lower", extent=extent, cmap="bone", vmin=far, vmax=near + 0.5 * (near - far))
    for name, place in markers.items():
        x, y = 1e3 * place[across]
        axes.plot(x, y, "o", color="#d62728", markersize=9, markeredgecolor="white")
        axes.annotate(
            name, (x, y), (8, 8), textcoords="offset points", color="#d62728", fontsize=13, fontweight="bold",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
        )  # fmt: skip
    if turned:
        axes.invert_xaxis()
    axes.set_xlabel(f"{'xyz'[across[0]]} [mm]")
    axes.set_ylabel(f"{'xyz'[across[1]]} [mm]")
    return pixels(canvas)
