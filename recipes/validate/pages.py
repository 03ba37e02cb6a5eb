"""The paper's Figs. 2, 3, 4, S3, S5 and S7 drawn from finished robots, a page each; nothing is simulated.

    python recipes/validate/pages.py runs/robots --out runs/pages

The folder holds a folder per robot, "walker", "slope30", "slope58" and "climber"; pages of one that is missing are
skipped. In each are a run's settings.json, design.npz and metrics.csv, and what was measured on the finished robot:
compare.json, a row per check with the path of its centre of gravity, and motion_<check>.npz, frames of every particle;
where one is missing, the panel says so. Panels have the paper's letters. A slope is turned, and an arrow g points down.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from torchsoro.command_line import plain_errors
from torchsoro.design.reading import read_settings
from torchsoro.design.robot import build
from torchsoro.output.archive import load_design
from torchsoro.output.delivery import drawn_planes
from torchsoro.output.page import DrawnMotion, Page, curve, curve_axes, legend, motion_of, pressure_trace
from torchsoro.output.scene import FULL, INK, REST, Camera, Scene, Shape, bounds_of
from torchsoro.storage import read_metrics

ROBOTS = ("walker", "slope30", "slope58", "climber")
WIDTH, MARGIN, CELL, DPI = 1760, 40, 336, 180
STYLES = ((REST, "-"), ("#3f8f63", (0, (6, 1.5))), ("#b5651d", (0, (3, 1.5))), (FULL, (0, (1, 1))))
INCLINES = {"design": ("flat", 0.0), "uphill_10": ("10 %", 0.1), "uphill_20": ("20 %", 0.2), "uphill_30": ("30 %", 0.3)}
STIFFNESSES = ("design", "double_modulus", "double_modulus_and_pressure")


class Found:
    """A finished robot's folder; ValueError if a file in it is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.settings = s = read_settings(path / "settings.json", device="cpu")
        self.along = 2 if s.robot == "climber" else 0
        self.robot = build(s)
        self.gamma = load_design(path / "design.npz", self.robot.domain).numpy()
        self.planes, self.slope = drawn_planes(self.robot), math.degrees(math.atan(s.slope))
        columns, rows = read_metrics(path / "metrics.csv", sys.maxsize)
        self.history = {column: np.array([row.get(column, math.nan) for row in rows]) for column in columns if rows}
        self.rows = self._compared(path / "compare.json")
        self._motions: dict[str, DrawnMotion | None] = {}

    def motion(self, check: str) -> DrawnMotion | None:
        """The frames of a check, ordered in time; None without a file."""
        if check not in self._motions:
            path = self.path / f"motion_{check}.npz"
            self._motions[check] = self._read(path) if path.is_file() else None
        return self._motions[check]

    def turns(self, motion: DrawnMotion) -> list[int]:
        """Frames at whole cycles of the pressure; the last one without any."""
        turns = (motion.time - self.settings.settle) * self.settings.frequency
        return [i for i, t in enumerate(turns) if t > -0.04 and abs(t - round(t)) < 0.04] or [len(turns) - 1]

    def course(self, check: str, duration: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
        """Time from the start of the actuation [S] s and way of the centre of gravity since then [S, 3] mm."""
        time, center = self.rows[check]["time"] - self.settings.settle, 1e3 * self.rows[check]["cog"]
        kept = (time >= -1e-9) & (time <= duration + 1e-6)
        return time[kept], center[kept] - center[kept][:1]

    def _read(self, path: Path) -> DrawnMotion:
        domain, keys = self.robot.domain, ("time", "pressure", "displacement", "gamma")
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                time, pressure, moved, gamma = (file[key].astype(float) for key in keys)
            # Void may be farther away than its numbers reach; the surface does not follow it.
            moved = np.where(np.isfinite(moved) | (gamma[:, None] >= 0.5), moved, 0.0)
            time, order = np.unique(time, return_index=True)
            frames = domain.positions.numpy() + 1e-3 * moved[order]
            return motion_of(domain, gamma, frames, time, pressure[order], self.planes, self.robot.direction, level=0.5)
        except (OSError, KeyError, IndexError, ValueError, BadZipFile) as error:
            shapes = f"time [S], pressure [S], displacement [S, {domain.count}, 3], gamma [{domain.count}]"
            raise ValueError(f"data: {path} holds no motion ({error}), wanted {shapes}") from error

    def _compared(self, path: Path) -> dict[str, dict[str, Any]]:
        if not path.is_file():
            return {}
        try:
            listed = json.loads(path.read_text(encoding="utf-8"))["rows"]
            rows = {str(row["check"]): row for row in listed if "error" not in row}  # one that broke down has no path
            for check, row in rows.items():
                row.update({key: np.array(row[key], dtype=float) for key in ("time", "cog")})
                row.update({key: float(row[key]) for key in ("L", "stride", "speed")})
                if row["time"].ndim != 1 or row["cog"].shape != (len(row["time"]), 3):
                    raise ValueError(f"{check}: {row['time'].shape} times and {row['cog'].shape} coordinates")
        except (OSError, ValueError, TypeError, KeyError) as error:
            wanted = "rows with check, L, stride, speed, time [S] and cog [S, 3]"
            raise ValueError(f"data: {path} holds no comparison ({error!r}), wanted {wanted}") from error
        return rows


# -------------------------------------------------------------------------------------------------------------- panels
def millimetres(length: float) -> str:
    """A length in m, without a minus before zero."""
    return f"{1e3 * length:z.1f} mm"


def pressure(motion: DrawnMotion) -> np.ndarray:
    """Of the frames [kPa]."""
    return np.zeros(len(motion.time)) if motion.pressure is None else motion.pressure


def draw(
    axes: Axes, found: Found, motion: DrawnMotion, chosen: list[int], camera: Camera, text: str, **view: Any
) -> None:
    """The body in one frame, with its pressure, or in several, side by side; the rest is for the scene."""
    axes.set_title(text, fontsize=8, color=INK, pad=3, linespacing=1.25)
    scene = Scene(axes, motion.shape.times(len(chosen)), camera, found.planes, along=found.along, **view)
    vertices, cavities = zip(*(motion.placed[i] for i in chosen), strict=True)
    scene.body.set_linewidth(0.6)  # wide enough to close the seams between triangles
    fill = float(np.clip(pressure(motion)[chosen[0]] / (1e-3 * found.settings.pressure), 0, 1))
    scene.show(np.concatenate(vertices), np.concatenate(cavities), fill if len(chosen) == 1 else None)
    if found.along == 2:  # the ruler's labels stand beside the left wall
        axes.set_xlim(axes.get_xlim()[0] - 11, axes.get_xlim()[1])


def at_rest(axes: Axes, found: Found, camera: Camera, text: str = "") -> None:
    """The finished shape, in mm from the chamber's centre."""
    axes.set_title(text, fontsize=8, color=INK, pad=3)
    domain, shape = found.robot.domain, Shape(found.robot.domain, found.gamma, 0.5)
    vertices, cavity = (part - 500 * np.array(domain.size) for part in shape.place(domain.positions.numpy()))
    scene = Scene(axes, shape, camera, (), bounds_of([vertices]), ruler=False)
    scene.body.set_linewidth(0.8)
    scene.show(vertices, cavity, None)


def iterations(page: Page, found: Found, camera: Camera, top: float, height: float) -> None:
    """The deformed body at the end of the actuation, for up to five designs at one scale."""
    page.head("A", "Shape in the course of the design, at the end of the actuation", MARGIN, top)
    s, final = found.settings, found.motion("design")
    steps = sorted(int(path.stem.rpartition("_")[2]) for path in found.path.glob("motion_iteration_[0-9]*.npz"))
    count = min(5 if final is None else 4, len(steps))
    views: list[tuple[str, DrawnMotion, int]] = []
    for step in (steps[i] for i in np.linspace(0, len(steps) - 1, count).round().astype(int)):
        if (motion := found.motion(f"iteration_{step}")) is not None:
            views.append((f"iteration {step}{reached(found, step)}", motion, len(motion.time) - 1))
    if final is not None:
        i = int((off := np.abs(final.time - s.settle - s.duration)).argmin())
        text = "finished" + (f" (at {final.time[i] - s.settle:.2f} s)" if off[i] * s.frequency > 0.04 else "")
        views.append((text + (f"\nL = {millimetres(row['L'])}" if (row := found.rows.get("design")) else ""), final, i))
    if not views:
        page.missing("There are no frames of any design.", MARGIN, top + 60)
        return
    boxes = np.stack([bounds_of([motion.placed[i][0]]) for _, motion, i in views])
    half = 0.5 * (boxes[:, 1] - boxes[:, 0]).max(axis=0)
    for column, ((text, motion, i), box) in enumerate(zip(views, boxes, strict=True)):
        axes = page.axes(MARGIN + column * CELL, top + 95, CELL - 12, height - 95)
        draw(axes, found, motion, [i], camera, text, bounds=box.mean(axis=0) + np.stack([-half, half]))


def reached(found: Found, step: int) -> str:
    """L of an iteration; in the climber's design loop it is that under the gravity of the iteration."""
    row, scale = found.rows.get(f"iteration_{step}"), 1.0
    known = dict(zip(found.history.get("iteration", ()), found.history.get("objective/L", ()), strict=False))
    if row is None and step in known:
        row, scale = {"L": known[step]}, found.settings.gravity_scale(step)
    return "" if row is None else f"\nL = {millimetres(row['L'])}" + (f" at {100 * scale:.0f} % g" if scale < 1 else "")


def histories(page: Page, found: Found, top: float, height: float) -> None:
    """L and C against the iteration."""
    s, history = found.settings, found.history
    rises = [k for k in range(1, len(history.get("iteration", ()))) if s.gravity_scale(k) != s.gravity_scale(k - 1)]
    page.head("B", f"Travel L and intermediate density C{'; gravity rises at each line' * bool(rises)}", MARGIN, top)
    if not {"objective/L", "constraint/C"} <= set(history):
        page.missing("There is no metrics.csv with objective/L and constraint/C.", MARGIN, top + 60)
        return
    panels = [page.axes(left, top + 55, 720, height - 125) for left in (135, 975)]
    for axes, k in itertools.product(panels, rises):
        axes.axvline(k, color="#c3cad3", lw=0.9)
    curve(panels[0], history["iteration"], 1e3 * history["objective/L"], REST)
    curve_axes(panels[0], "iteration", "L [mm]")
    curve(panels[1], history["iteration"], history["constraint/C"], STYLES[2][0])
    curve_axes(panels[1], "iteration", "C")
    panels[1].axhline(s.c_max, color=FULL, lw=1.0, ls=(0, (4, 2)), label=f"limit {s.c_max:g}")
    panels[1].set_ylim(0, 1.05 * max(np.nanmax(history["constraint/C"]), s.c_max))
    legend(panels[1], loc="upper right")


def gait(page: Page, found: Found, camera: Camera, letter: str, top: float, height: float) -> None:
    """The last whole cycle of the design loop: all eighths in two rows and the pressure, or on a slope half in one."""
    s, motion, row = found.settings, found.motion("design"), found.rows.get("design")
    reach = f"; L = {millimetres(row['L'])} in {s.duration:g} s" if row else ""
    page.head(letter, f"One cycle T: phase, pressure, and way since its start (dashed line){reach}", MARGIN, top)
    rows, cycles = 1 if camera.tilt else 2, math.floor(s.duration * s.frequency + 1e-9)
    phases = np.linspace(0, 1, 4 * rows + 1)
    off = np.ones((1, 1)) if motion is None else (motion.time[:, None] - s.settle) * s.frequency - cycles + 1 - phases
    if motion is None or cycles < 1 or (np.abs(off).min(axis=0) > 0.04).any():
        page.missing("There are no frames of a whole pressure cycle.", MARGIN, top + 60)
        return
    chosen = np.abs(off).argmin(axis=0).tolist()
    first, bounds, high = chosen[0], bounds_of([motion.placed[i][0] for i in chosen]), (height - 40) / rows
    for cell, (phase, i) in enumerate(zip(phases, chosen, strict=True)):
        axes = page.axes(MARGIN + cell % 5 * CELL, top + 95 + cell // 5 * high, CELL - 12, high - 60)
        way = millimetres(1e-3 * float(motion.travel[i] - motion.travel[first]))
        text = f"t/T = {phase:g}\n{pressure(motion)[i]:.0f} kPa, {way}"
        draw(axes, found, motion, [i], camera, text, bounds=bounds, start=float(motion.cog[first, found.along]))
    if rows == 2:
        axes = page.axes(MARGIN + 4 * CELL + 90, top + 160 + high, CELL - 110, high - 210)
        pressure_trace(axes, phases, pressure(motion)[chosen]).set_data(phases, pressure(motion)[chosen])
        axes.lines[-1].set(markersize=4, markeredgewidth=1.0)
        curve_axes(axes, "t/T", "pressure [kPa]")


def strips(page: Page, found: Found, top: float) -> None:
    """The walker on each incline after whole cycles, as often as it does not stand in its own way, at one scale."""
    moving = {check: found.motion(check) for check in INCLINES}
    ends = [motion.placed[i][0] for motion in moving.values() if motion for i in found.turns(motion)]
    for i, (check, motion) in enumerate(moving.items()):
        name, slope = INCLINES[check]
        left, high = MARGIN + i % 2 * 570, top + i // 2 * 330
        if motion is None:
            page.missing(f"{name}: there are no frames.", left, high)
            continue
        boxes = {i: bounds_of([motion.placed[i][0]])[:, 0] for i in found.turns(motion)}
        chosen: list[int] = []
        for count in range(len(boxes), 0, -1):
            chosen = [list(boxes)[j] for j in np.linspace(len(boxes) - 1, 0, count).round().astype(int)][::-1]
            if all(boxes[a][1] < boxes[b][0] for a, b in itertools.pairwise(chosen)):
                break
        text = name + (f", {1e3 * row['speed']:.1f} mm/s" if (row := found.rows.get(check)) else "")
        axes, start = page.axes(left, high, 560, 300), float(motion.cog[next(iter(boxes)), 0])
        camera, bounds = Camera(-90, 14, math.degrees(math.atan(slope))), bounds_of(ends)
        draw(axes, found, motion, chosen, camera, text, bounds=bounds, start=start, ruler=False)
        for j in chosen:
            right, upward, _ = camera.axes @ motion.placed[j][0].T
            time = motion.time[j] - found.settings.settle
            axes.text(right.mean(), upward.max() + 1, f"{time:.1f} s", ha="center", fontsize=8, color=INK)
        axes.set_ylim(axes.get_ylim()[0], axes.get_ylim()[1] + 5)


def columns(page: Page, found: Found, camera: Camera, top: float, height: float) -> None:
    """The climber after whole cycles, each in a view of its own on the same walls."""
    if (motion := found.motion("design")) is None:
        page.missing("There are no frames.", MARGIN, top)
        return
    whole, settle = found.turns(motion), found.settings.settle
    chosen = [whole[i] for i in np.linspace(0, len(whole) - 1, min(6, len(whole))).round().astype(int)]
    bounds, start = bounds_of([motion.placed[i][0] for i in chosen]), float(motion.cog[chosen[0], 2])
    for column, i in enumerate(chosen):
        axes = page.axes(MARGIN + column * 190, top, 180, height)
        draw(axes, found, motion, [i], camera, f"{motion.time[i] - settle:.1f} s", bounds=bounds, start=start)


def travels(page: Page, found: Found, checks: list[str], top: float, height: float) -> None:
    """Way along the travel against time, with the speeds."""
    if not set(checks) & set(found.rows):
        page.missing("There is no compare.json with a path.", 1290, top)
        return
    axes = page.axes(1290, top, 430, height)
    for check, (color, style) in zip(checks, STYLES, strict=False):
        if check in found.rows:
            time, way = found.course(check)
            text = f"{INCLINES[check][0]}: " * (len(checks) > 1) + f"{1e3 * found.rows[check]['speed']:.1f} mm/s"
            curve(axes, time, way[:, found.along], color, style, text)
    curve_axes(axes, "time from the start of the actuation [s]", "travel [mm]")
    legend(axes, loc="best", borderaxespad=0.2)


# --------------------------------------------------------------------------------------------------------------- pages
def locomotion(found: Found) -> Page:
    """Fig. 2 (walker) or Fig. 4 (climber): shapes, history, gait, and a longer way."""
    up = found.along == 2
    view, side = (Camera(-70, 12), Camera(-78, 8)) if up else (Camera(-65, 16), Camera(-78, 12))
    shapes, curves, cycle, long = (480, 340, 850, 560) if up else (390, 340, 700, 730)
    page, top = Page(WIDTH, shapes + curves + cycle + long + 70, DPI), 20
    iterations(page, found, view, top, shapes)
    histories(page, found, top := top + shapes + 10, curves)
    gait(page, found, side, "C", top := top + curves + 5, cycle)
    top += cycle + 20
    head = "Longer climb; dashed line: start" if up else "Longer walks; dashed line: start, ground lines every 5 mm"
    page.head("E", head, MARGIN, top)
    if up:
        columns(page, found, side, top + 80, long - 90)
    else:
        strips(page, found, top + 80)
    travels(page, found, ["design"] if up else list(INCLINES), top + 50, long - 130)
    return page


def slopes(both: dict[str, Found]) -> Page:
    """Fig. 3: the two robots for a slope, each at rest from three sides and in a cycle on its slope."""
    page, top = Page(WIDTH, 1940, DPI), 20
    for name, letters in (("slope30", "AB"), ("slope58", "CD")):
        if name not in both:
            page.head(letters[0], f"{name}: there is no finished robot", MARGIN, top)
            continue
        found = both[name]
        page.head(letters[0], f"Shape for a slope of {100 * found.settings.slope:.3g} %, at rest", MARGIN, top)
        angles = {"from the front": (-40, 20), "from the side": (-90, 0), "from below": (-60, -35)}
        for i, (text, angle) in enumerate(angles.items()):
            at_rest(page.axes(MARGIN + i * 560, top + 80, 550, 390), found, Camera(*angle), text)
        gait(page, found, Camera(-90, 14, found.slope), letters[1], top + 490, 450)
        top += 960
    return page


def centers(found: Found) -> Page:
    """Fig. S3 (walker) or Fig. S7 (climber): centre of gravity and mass over the iterations."""
    page, history = Page(WIDTH, 800, DPI), found.history
    page.head("a", "Centre of gravity at rest, on the finished shape", MARGIN, 20)
    page.head("b", "Centre of gravity and mass", 950, 20)
    if not {"cog/x", "cog/z", "mass"} <= set(history):
        page.missing("There is no metrics.csv with cog/x, cog/z and mass.", MARGIN, 80)
        return page
    step, mass, x, z = history["iteration"], *(1e3 * history[name] for name in ("mass", "cog/x", "cog/z"))
    z = z - 500 * found.settings.size[2]
    axes = page.axes(MARGIN + 60, 80, 760, 600)
    at_rest(axes, found, Camera(-90, 0))
    axes.set_axis_on()
    axes.axhspan(*axes.get_ylim(), color="white", alpha=0.55, zorder=8, lw=0)
    path = [((x[i], z[i]), (x[i + 1], z[i + 1])) for i in range(len(step) - 1)]
    lines = LineCollection(path, array=step[1:], cmap="viridis", lw=1.8, zorder=9, capstyle="round")
    axes.add_collection(lines)
    for i, marker, text in ((0, "o", "first iteration"), (-1, "s", "last iteration")):
        axes.plot(x[i], z[i], marker, ms=5, mfc="white", mec=INK, mew=1.2, zorder=10, label=text)
    axes.plot(0, 0, "+", color=INK, ms=9, mew=1.2, zorder=11, label="chamber's centre")
    curve_axes(axes, "x [mm]", "z [mm]")
    legend(axes, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, handlelength=1.2)
    bar = page.figure.colorbar(lines, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label("iteration", color=INK, fontsize=8.5)
    bar.ax.tick_params(labelsize=8, colors=INK)
    panels = [page.axes(1040, 80, 660, 340), page.axes(1040, 450, 660, 230)]
    for panel, values, (color, style), text in zip((0, 0, 1), (x, z, mass), STYLES, "xzm", strict=False):
        curve(panels[panel], step, values, color, style, text)
    curve_axes(panels[0], "", "x, z [mm]")
    panels[0].tick_params(labelbottom=False)
    curve_axes(panels[1], "iteration", "mass [g]")
    legend(panels[0], loc="best")
    return page


def stiffness(found: Found) -> Page:
    """Fig. S5: the centre of gravity with other moduli and pressures."""
    page = Page(WIDTH, 760, DPI)
    page.head("", "Centre of gravity from the start of the actuation, with other moduli and pressures", MARGIN, 20)
    panels = [page.axes(140, 80, 700, 500), page.axes(1000, 80, 700, 235), page.axes(1000, 345, 700, 235)]
    for check, (color, style) in zip(STIFFNESSES, STYLES, strict=False):
        name, row = "original" if check == "design" else check.replace("_", " "), found.rows.get(check)
        if row is None:
            curve(panels[0], np.zeros(0), np.zeros(0), color, style, f"{name}: no path in compare.json")
            continue
        time, way = found.course(check, found.settings.duration)
        text = f"{name}: L = {millimetres(row['L'])}, stride {millimetres(row['stride'])}"
        for panel, along, up in zip(panels, (way[:, 0], time, time), way[:, [2, 0, 2]].T, strict=True):
            curve(panel, along, up, color, style, text)
    for axes, x, y in zip(panels, ("x [mm]", "", "time [s]"), ("z [mm]", "x [mm]", "z [mm]"), strict=True):
        curve_axes(axes, x, y)
    panels[1].tick_params(labelbottom=False)
    legend(panels[0], loc="upper left", bbox_to_anchor=(-0.02, -0.14))
    return page


def main(data: tyro.conf.Positional[Path], out: Path = Path("runs/pages")) -> list[Path]:
    """Draw the pages; returns what was written.

    Args:
        data: Folder with the robots' folders walker, slope30, slope58 and climber, of which any may be missing.
        out: Folder for the pages fig2.png, fig3.png, fig4.png, figS3.png, figS5.png, figS7.png.

    Raises:
        ValueError: if there is no such folder, there is no finished robot in it, or a file is damaged.
    """
    files = ("settings.json", "design.npz")
    lost = {name: [data / name / file for file in files if not (data / name / file).is_file()] for name in ROBOTS}
    found = {name: Found(data / name) for name in ROBOTS if not lost[name]}
    if not found:
        raise ValueError(f"data: there is no {lost['walker'][0]}, nor another finished robot; wanted one at least")
    out.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    robots, drawn = ("walker",) * 3 + ("climber",) * 2, (locomotion, centers, stiffness, locomotion, centers)
    for name, robot, page in zip(("fig2", "figS3", "figS5", "fig4", "figS7"), robots, drawn, strict=True):
        if robot in found:
            written.append(page(found[robot]).save(out / f"{name}.png"))
        else:
            print(f"{name}.png: skipped, there is no {lost[robot][0]}")
    if {"slope30", "slope58"} & set(found):
        written.append(slopes(found).save(out / "fig3.png"))
    else:
        print(f"fig3.png: skipped, there is no {lost['slope30'][0]} and no {lost['slope58'][0]}")
    print("\n".join(f"wrote {path}" for path in written))
    return written


if __name__ == "__main__":
    with plain_errors():
        tyro.cli(main, description=__doc__)
