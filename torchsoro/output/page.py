"""What a movie and a summary page share: the checked motion, and the panels that tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from torchsoro.output.canvas import canvas_of, pixels
from torchsoro.output.levelset import as_array
from torchsoro.output.scene import FAINT, FULL, INK, PRESSURE, REST, Camera, PlaneTuple, Scene, Shape, bounds_of
from torchsoro.storage import atomic_write

if TYPE_CHECKING:
    from torchsoro.design.domain import Domain


def check_frames(domain: Domain, frames: Any) -> np.ndarray:
    """Frames as float64 [S, N, 3], or a ValueError."""
    frames = as_array(frames)
    if frames.ndim != 3 or frames.shape[1:] != (domain.count, 3) or not len(frames):
        raise ValueError(f"frames: got shape {frames.shape}, want [S, {domain.count}, 3] with at least one frame")
    if not np.isfinite(frames).all():
        raise ValueError("frames: got positions that are not finite, want numbers in m")
    return frames.astype(float)


def _series(name: str, values: Any, count: int) -> np.ndarray:
    array = as_array(values).astype(float)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: got shape {array.shape}, want one finite number per frame, ({count},)")
    return array


def check_planes(planes: Sequence[PlaneTuple]) -> None:
    """Refuse what does not describe a plane."""
    for plane in planes:
        if len(plane) != 3 or plane[0] not in (0, 1, 2) or plane[2] not in (-1, 1) or not math.isfinite(plane[1]):
            raise ValueError(f"planes: got {tuple(plane)}, want (axis 0, 1 or 2; position in m; side +1 or -1)")


@dataclass(frozen=True)
class DrawnMotion:
    """Checked input of a movie or a summary; lengths in mm, pressure in kPa, time in s."""

    shape: Shape
    placed: list[tuple[np.ndarray, np.ndarray | None]]
    bounds: np.ndarray
    time: np.ndarray
    pressure: np.ndarray | None
    cog: np.ndarray
    path: np.ndarray
    along: int
    travel: np.ndarray

    def fill(self, index: int) -> float | None:
        """Pressure of a frame as a share of the largest."""
        if self.pressure is None:
            return None
        return float(np.clip(self.pressure[index] / max(self.pressure.max(), 1e-9), 0, 1))


def motion_of(
    domain: Domain,
    gamma: Any,
    frames: Any,
    time: Any,
    pressure: Any,
    planes: Sequence[PlaneTuple],
    direction: Any,
    level: float,
    displacement: Any | None = None,
) -> DrawnMotion:
    """Check the arrays of a movie or a summary, and deform the body in every frame.

    Travel is along ``displacement`` [S, 3] in m, or else that of the densities' centre from the first frame on.
    """
    check_planes(planes)
    if sorted(abs(float(c)) for c in direction) != [0.0, 0.0, 1.0]:
        raise ValueError(f"direction: got {tuple(direction)}, want a unit vector along an axis, such as (1, 0, 0)")
    moved = check_frames(domain, frames)
    times = _series("time", time, len(moved))
    if (np.diff(times) <= 0).any():
        raise ValueError(
            f"time: got no increase after frame {int(np.argmax(np.diff(times) <= 0))}, want increasing times in s"
        )
    kilopascal = None if pressure is None else _series("pressure", pressure, len(moved)) * 1e-3
    shape = Shape(domain, gamma, level)
    placed = [shape.place(frame) for frame in moved]
    weight = as_array(gamma).astype(float) * as_array(domain.design)
    weight = weight if weight.sum() > 0 else np.ones(domain.count)
    cog = (np.einsum("sni,n->si", moved, weight) / weight.sum() - shape.origin) * 1e3
    along = int(np.argmax(np.abs(direction)))
    moved = cog - cog[0] if displacement is None else 1e3 * as_array(displacement).astype(float)
    if moved.shape != cog.shape or not np.isfinite(moved).all():
        raise ValueError(f"displacement: got shape {moved.shape}, want finite lengths in m of shape {cog.shape}")
    travel = moved @ np.asarray(direction, dtype=float)
    return DrawnMotion(shape, placed, bounds_of([v for v, _ in placed]), times, kilopascal, cog, moved, along, travel)


class Page:
    """A white page of so many pixels for lettered panels; places are in pixels from its upper left corner."""

    def __init__(self, width: int, height: int, dpi: int = 100) -> None:
        self.width, self.height, self.dpi = width, height, dpi
        self.figure, self.canvas = canvas_of(width, height, dpi)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """A panel."""
        place = (left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(place)

    def write(self, text: str, left: float, top: float, size: float = 9.0, **style: Any) -> None:
        """Text that begins here."""
        style = {"va": "top", "color": INK, **style}
        self.figure.text(left / self.width, 1 - top / self.height, text, fontsize=size, **style)

    def head(self, letter: str, text: str, left: float, top: float) -> None:
        """Letter and heading of a panel."""
        self.write(letter, left, top, 13, weight="bold")
        self.write(text, left + (0.25 * self.dpi if letter else 0), top + 0.03 * self.dpi, 9.5)

    def missing(self, text: str, left: float, top: float) -> None:
        """A line instead of a panel."""
        self.write(text, left, top, 8.5, style="italic", color=FAINT)

    def save(self, path: Path) -> Path:
        """Write a PNG, which is there whole or not at all."""
        with atomic_write(path) as file:
            Image.fromarray(pixels(self.canvas)).save(file, format="PNG", dpi=(self.dpi, self.dpi))
        return path


def pressure_trace(axes: Axes, time: np.ndarray, pressure: np.ndarray) -> Any:
    """The pressure over time, coloured by itself; returns the movable dot."""
    points = np.stack([time, pressure], axis=1)
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=PRESSURE,
        norm=Normalize(0, max(pressure.max(), 1e-9)),
        lw=1.8,
    )
    lines.set_array(0.5 * (pressure[1:] + pressure[:-1]))
    axes.add_collection(lines)
    axes.fill_between(time, pressure, color="#e9dfe8", lw=0)
    axes.set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1e-3)
    axes.set_ylim(min(0.0, 1.1 * pressure.min()), max(1e-3, 1.15 * pressure.max()))
    axes.set_ylabel("kPa", color=INK, fontsize=9)
    plain(axes)
    return axes.plot([], [], "o", ms=7, mfc="white", mec=INK, mew=1.6, zorder=5, clip_on=False)[0]


def last_cycle(motion: DrawnMotion, period: float | None, first: float | None = None) -> tuple[float, float]:
    """Start and end of the last whole cycle; cycles count from ``first``, or else from where the pressure rises."""
    time, pressure = motion.time, motion.pressure
    if first is not None and period is not None and time[-1] >= first + period * (1 - 1e-6):
        start = first + (math.floor((time[-1] - first) / period + 1e-6) - 1) * period
        return start, min(start + period, float(time[-1]))
    rises = np.zeros(0)
    if pressure is not None and pressure.max() > 0:
        high = pressure > 0.5 * pressure.max()
        rises = time[1:][high[1:] & ~high[:-1]]
        if period is None and len(rises) > 1:
            period = float(np.diff(rises).mean())
    if period is None or period > time[-1] - time[0]:
        return float(time[0]), float(time[-1])
    slack = 1e-6 + (time[-1] - time[0]) / max(len(time) - 1, 1)
    whole = rises[rises + period <= time[-1] + slack]
    start = float(whole[-1]) if len(whole) else float(time[-1] - period)
    return start, min(start + period, float(time[-1]))


def path_panels(
    figure: Figure, motion: DrawnMotion, cycle: tuple[float, float], scenarios: np.ndarray | None = None
) -> None:
    """Travel over time, and the path of the centre of gravity or the travel in each scenario [S] m."""
    over = figure.add_axes((0.735, 0.74, 0.24, 0.175))
    over.axvspan(*cycle, color="#eef1f4", lw=0)
    over.plot(motion.time, motion.travel, color=INK, lw=1.8)
    over.set_xlim(motion.time[0], motion.time[-1] if len(motion.time) > 1 else motion.time[0] + 1e-3)
    over.set_xlabel("time [s]", color=INK)
    over.set_ylabel("travel [mm]", color=INK)
    plain(over)
    heading(over, "travel of the centre of gravity")
    if motion.pressure is not None:
        beside = over.twinx()
        beside.fill_between(motion.time, motion.pressure, color=FULL, alpha=0.13, lw=0)
        beside.set_ylim(0, max(1e-3, 3.0 * motion.pressure.max()))
        beside.set_axis_off()
    path = figure.add_axes((0.735, 0.48, 0.24, 0.175))
    if scenarios is not None:
        scenario_panel(path, 1e3 * scenarios)
        return
    flat = 0 if motion.along == 2 else motion.along
    points = motion.path[:, [flat, 2]]
    value = motion.time if motion.pressure is None else motion.pressure
    if len(points) > 1:
        lines = LineCollection(
            list(np.stack([points[:-1], points[1:]], axis=1)),
            cmap="viridis" if motion.pressure is None else PRESSURE,
            lw=2.2,
        )
        lines.set_array(0.5 * (value[1:] + value[:-1]))
        path.add_collection(lines)
        bar = figure.colorbar(lines, ax=path, pad=0.02, fraction=0.05)
        bar.set_label("time [s]" if motion.pressure is None else "pressure [kPa]", color=INK, fontsize=9)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
        bar.ax.tick_params(labelsize=8, colors=INK)
    path.plot(*points[0], "o", color=INK, ms=5)
    path.plot(*points[-1], ">" if motion.along != 2 else "^", color=INK, ms=6)
    span = max(float(np.ptp(points, axis=0).max()), 1e-3)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = np.maximum(np.ptp(points, axis=0) * 0.62, 0.08 * span)
    path.set_xlim(middle[0] - reach[0], middle[0] + reach[0])
    path.set_ylim(middle[1] - reach[1], middle[1] + reach[1])
    path.locator_params(axis="x", nbins=6)
    path.set_xlabel(f"{'xyz'[flat]} [mm]", color=INK)
    path.set_ylabel("z [mm]", color=INK)
    plain(path)
    heading(path, "path of the centre of gravity")


def scenario_panel(axes: Axes, travel: np.ndarray) -> None:
    """Travel in each scenario [S] mm, from the least to the largest; a cross where the simulation broke down."""
    ordered = np.sort(travel)  # NaN last
    place = np.arange(1, len(ordered) + 1)
    known = np.isfinite(ordered)
    axes.bar(place[known], ordered[known], color=REST, width=0.8)
    axes.plot(place[~known], np.zeros((~known).sum()), "x", color="#a33b3b", ms=6)
    if known.any():
        mean = ordered[known].mean()
        axes.axhline(mean, color=INK, lw=1.2, ls="--")
        axes.text(0.4, mean, f" mean {mean:.2f}", va="bottom", fontsize=9, color=INK)
    axes.axhline(0, color=INK, lw=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0.2, len(ordered) + 0.8)
    axes.set_xlabel("scenarios, by travel", color=INK)
    axes.set_ylabel("L [mm]", color=INK)
    plain(axes)
    heading(axes, "travel in each scenario")


def gait_panels(
    figure: Figure, motion: DrawnMotion, planes: Sequence[PlaneTuple], camera: Camera, cycle: tuple[float, float]
) -> None:
    """Six snapshots from the beginning to the end of a cycle, all in one frame, and where they lie on the pressure."""
    count = 6
    picked = [int(np.argmin(np.abs(motion.time - t))) for t in np.linspace(*cycle, count)]
    bounds = bounds_of([motion.placed[i][0] for i in picked])
    width = 0.965 / count
    # Seen more from the side than the other views: the panels are small and the travel lies in the page.
    azimuth = camera.azimuth + (0.5 * (-90 - camera.azimuth) if -90 < camera.azimuth < 0 else 0)
    camera = Camera(azimuth, 0.75 * camera.elevation, camera.tilt)
    start = float(motion.cog[picked[0], motion.along])
    for column, i in enumerate(picked):
        view = figure.add_axes((0.018 + column * width, 0.125, width * 0.985, 0.245))
        scene = Scene(view, motion.shape, camera, planes, bounds, along=motion.along, start=start)
        scene.show(*motion.placed[i], motion.fill(i))
        phase = (motion.time[i] - cycle[0]) / max(cycle[1] - cycle[0], 1e-12)
        advance = motion.travel[i] - motion.travel[picked[0]]
        fill = motion.fill(i)
        color = INK if fill is None else PRESSURE(fill)
        title = f"t/T = {phase:z.2f}   {advance:+.2f} mm"
        view.set_title(title, fontsize=10, color=color, pad=2, weight="bold")
    figure.text(
        0.03,
        0.405,
        "gait in the last whole cycle of length T, shaded above, and its advance since t = 0 "
        "(dashed: centre of gravity at that time)",
        fontsize=11,
        color=INK,
        weight="bold",
    )
    if motion.pressure is None:
        return
    trace = figure.add_axes((0.06, 0.05, 0.915, 0.06))
    pressure_trace(trace, motion.time, motion.pressure)
    trace.plot(
        motion.time[picked], motion.pressure[picked], "o", ms=7, mfc="white", mec=INK, mew=1.6, zorder=5, clip_on=False
    )
    trace.set_xlabel("time [s]", color=INK, labelpad=1)


def history_panel(
    axes: Axes,
    values: np.ndarray,
    color: str,
    label: str,
    head: str,
    limit: float | None = None,
    chosen: int | None = None,
) -> None:
    """A quantity over the iterations, counted from 0, with a dot at the ``chosen`` one, or the last.

    Numbers that are not finite are left out.
    """
    iterations = np.flatnonzero(np.isfinite(values))
    values = values[iterations]
    at = len(values) - 1 if chosen is None else int(np.searchsorted(iterations[:-1], chosen))
    axes.plot(iterations, values, color=color, lw=1.9)
    axes.plot(iterations[at], values[at], "o", color=color, ms=5)
    axes.set_ylabel(label, color=INK)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    plain(axes)
    heading(axes, head)
    if limit is not None:
        axes.axhline(limit, color=FULL, lw=1.2, ls=(0, (4, 2)))
        axes.set_ylim(0, 1.15 * max(limit, float(values.max())))
        share = limit / axes.get_ylim()[1]
        axes.text(0.02, share + 0.02, f"limit {limit:g}", transform=axes.transAxes, color=FULL, fontsize=9)


def curve(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, style: Any = "-", text: str | None = None) -> None:
    """A line for the legend, without the values that are missing."""
    known = np.isfinite(y)
    axes.plot(x[known], y[known], color=color, ls=style, lw=1.4, label=text)


def curve_axes(axes: Axes, x: str, y: str) -> None:
    """The axes of curves: their names, and whole numbers for iterations."""
    plain(axes)
    axes.set_xlabel(x, color=INK, fontsize=8.5, labelpad=2)
    axes.set_ylabel(y, color=INK, fontsize=8.5)
    axes.tick_params(labelsize=8)
    if x == "iteration":
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def legend(axes: Axes, **style: Any) -> None:
    """The names of the curves, without a frame."""
    axes.legend(fontsize=8, frameon=False, labelcolor=INK, **{"handlelength": 2.6, **style})


def heading(axes: Axes, text: str) -> None:
    """A bold title at the left."""
    axes.set_title(text, loc="left", fontsize=11, color=INK, weight="bold", pad=6)


def plain(axes: Axes) -> None:
    """Few lines: left and bottom only, a faint grid."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    axes.grid(color="#e6eaee", lw=0.7)
    axes.set_axisbelow(True)
