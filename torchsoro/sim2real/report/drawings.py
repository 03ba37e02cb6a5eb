"""Pictures of an explanation: markers over time, mismatch over time, the body, forces that would be needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.inference.force_map import ForceMap
from torchsoro.sim2real.inference.isolability import Isolability
from torchsoro.sim2real.inference.phases import DEPARTURE, Mismatch, together
from torchsoro.sim2real.report.body import BodyMotion
from torchsoro.sim2real.report.improvement import Worst

RECORDED, NOMINAL, EXPLAINED = "#1f2933", "#b5651d", "#396ba3"
PLACE, SURROUNDINGS = "#a3154a", "#7b8794"
CLOSE = 0.15  # of a body's picture, up to which a distance in it is shown closer
LEAST_RANGE = 0.15  # of the widest panel's range, that any panel shows
AXES = ("#c0392b", "#2e8b57", "#2c5aa0")
BANDS = ("#e9eef4", "#f8f4ea")  # of phases, in turn


def _course(panel: Axes, time: np.ndarray, curves: np.ndarray, said: str) -> None:
    """A coordinate as recorded, as believed and as explained [3, T] mm; ``said`` names the last."""
    panel.plot(time, curves[1], "-", lw=1.2, color=NOMINAL, label="believed")
    panel.plot(time, curves[2], "-", lw=1.6, color=EXPLAINED, label=said)
    panel.plot(time, curves[0], ".", ms=2.5, color=RECORDED, label="recorded")


def draw_worst(trial: Trial, believed: np.ndarray, explained: np.ndarray, worst: Worst, said: str) -> Figure:
    """The coordinates of the marker that is the furthest off, with two simulations [T, M, A] m."""
    recording = trial.recording
    assert recording is not None
    figure = Figure(figsize=(9, 2.5), layout="constrained")
    count = len(recording.axes)
    panels: Any = figure.subplots(1, count, squeeze=False)
    curves = 1e3 * np.stack([recording.position, believed, explained])[:, :, worst.marker]
    half = 0.54 * float(np.nanmax(np.nanmax(curves, (0, 1)) - np.nanmin(curves, (0, 1))))
    for a, panel in enumerate(panels[0]):
        _course(panel, recording.time, curves[..., a], said)
        middle = float(np.nanmin(curves[..., a]) + np.nanmax(curves[..., a])) / 2
        panel.set_ylim(middle - half, middle + half)  # all at one scale
        panel.axvline(worst.time, color=PLACE, lw=1.0, ls="--", label="furthest off")
        panel.set_title(f"{trial.setup.markers[worst.marker].name}, {'xyz'[recording.axes[a]]} [mm]", fontsize=9)
        panel.set_xlabel("time [s]", fontsize=8)
        panel.tick_params(labelsize=8)
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8, frameon=False
    )
    return figure


def _legend(figure: Figure, panel: Axes) -> None:
    """Names of a panel's lines above all panels."""
    names = panel.get_legend_handles_labels()
    figure.legend(*names, loc="outside upper center", ncols=5, fontsize=8, frameon=False)


def draw_trial(trial: Trial, believed: np.ndarray, explained: np.ndarray, said: str) -> Figure:
    """Each marker's recorded coordinates over time, with two simulations [T, M, A] m.

    No panel shows less than a share of the widest one's range, so that noise does not look like motion.
    """
    recording = trial.recording
    assert recording is not None
    names = [m.name for m in trial.setup.markers]
    count, axes = len(names), recording.axes
    high = 1.2 + 1.25 * count
    figure = Figure(figsize=(9, high))
    panels: Any = figure.subplots(count, len(axes), sharex=True, squeeze=False)
    # By hand: the layout engine takes longer for dozens of panels than to draw them.
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.5 / high, top=1 - 0.65 / high, wspace=0.2, hspace=0.14)
    curves = 1e3 * np.stack([recording.position, believed, explained])
    low, top = np.nanmin(curves, axis=(0, 1)), np.nanmax(curves, axis=(0, 1))
    half = 0.54 * np.maximum(top - low, LEAST_RANGE * float((top - low).max()))
    for m, a in np.ndindex(count, len(axes)):
        panel: Axes = panels[m, a]
        _course(panel, recording.time, curves[:, :, m, a], said)
        middle = (low[m, a] + top[m, a]) / 2
        panel.set_ylim(middle - half[m, a], middle + half[m, a])
        panel.locator_params(axis="y", nbins=4)
        panel.tick_params(labelsize=7.5)
        if a == 0:
            panel.set_ylabel(f"{names[m]} [mm]", fontsize=9)
        if m == 0:
            panel.set_title("xyz"[axes[a]], fontsize=10)
        if m == count - 1:
            panel.set_xlabel("time [s]", fontsize=9)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="upper right", ncols=3, fontsize=9, frameon=False)
    return figure


def draw_mismatch(mismatches: Sequence[Mismatch], trials: Sequence[Trial], said: str) -> Figure:
    """Distance of each trial's simulations over time, phases as bands; ``said`` names the second line."""
    figure = Figure(figsize=(9, 0.4 + 2.1 * len(mismatches)), layout="constrained")
    panels: Any = figure.subplots(len(mismatches), 1, squeeze=False)
    for panel, m, trial in zip(panels[:, 0], mismatches, trials, strict=True):
        for k, p in enumerate(m.phases):
            panel.axvspan(p.start, p.end, color=BANDS[k % 2], lw=0)
            wide = (p.end - p.start) / trial.setup.duration
            if wide > 0.02:
                panel.text(
                    (p.start + p.end) / 2,
                    0.97,
                    p.name,
                    transform=panel.get_xaxis_transform(),
                    ha="center",
                    va="top",
                    fontsize=7,
                    color="0.35",
                    rotation=0 if wide > 0.014 * len(p.name) / 2 else 90,
                )
        for values, color, label in ((m.before, NOMINAL, "believed"), (m.after, EXPLAINED, said)):
            panel.plot(m.time, np.maximum(together(values), 0.1), color=color, lw=1.2, label=label)
        panel.axhline(DEPARTURE, color="0.5", lw=0.8, ls=":")
        if m.start is not None:
            panel.axvline(m.start, color=PLACE, lw=1.2, label=f"departure, most at {m.marker}")
        panel.set(ylabel="standard deviations", yscale="log", xlim=(0, trial.setup.duration))
        top = panel.get_ylim()[1]
        panel.set_ylim(0.3, 4 * max(top, 3.0))  # room for the names of the phases
        panel.set_title(f"trial {m.trial}", fontsize=9, loc="left")
        panel.legend(fontsize=7, loc="lower right")
        panel.tick_params(labelsize=8)
        if trial.pressure is not None:
            beside = panel.twinx()
            supply = trial.pressure.pressure.reshape(-1, len(trial.pressure.time)).numpy()
            beside.plot(trial.pressure.time.numpy(), supply.T / 1e3, color="0.6", lw=0.8)
            most = max(float(np.abs(supply).max()) / 1e3, 1e-3)
            beside.set_ylim(min(0.0, float(supply.min()) / 1e3) - 0.05 * most, 1.8 * most)  # below the names
            beside.set_ylabel("pressure [kPa]", fontsize=8)
            beside.tick_params(labelsize=7)
    panels[-1, 0].set_xlabel("time [s]")
    return figure


def draw_body(
    body: BodyMotion,
    setup: Setup,
    places: Sequence[tuple[str, np.ndarray]],
    forces: ForceMap | None,
    said: str,
) -> Figure:
    """The body when the recording is the furthest from what was believed, seen from a side, and the marker that is.

    Args:
        body: Its motion.
        setup: Of the trial.
        places: Of effects, with their names.
        forces: That would be needed, of which those of this trial are drawn.
        said: What the second simulation is.
    """
    one, other = view = side_view(body, setup)
    k, m = body.worst, body.marker
    recorded, (believed, explained) = body.recorded[k], body.markers[:, k]
    size = np.ptp(1e3 * np.concatenate([body.believed[k], body.explained[k]])[:, view], axis=0)
    apart = 1e3 * float(np.linalg.norm((recorded[m] - believed[m])[list(view)]))
    count = 1 if apart > CLOSE * size.max() else 2  # what is far off needs no closer look
    high = np.clip(9 / (1 + 0.6 * (count - 1)) * size[1] / size[0], 1.6, 4.2) + 1.0
    figure = Figure(figsize=(9, high), layout="constrained")
    panels: Any = figure.subplots(1, count, squeeze=False, width_ratios=(1.7, 1)[:count])
    whole, close = panels[0, 0], panels[0, -1]
    for panel in panels[0]:
        for surface, color in ((body.believed, NOMINAL), (body.explained, EXPLAINED)):
            polygons = 1e3 * surface[k][:, view][body.faces]
            panel.add_collection(PolyCollection(polygons, facecolors=color, edgecolors="none", alpha=0.1))
            width = 0.4 if body.faces.shape[1] == 4 else 0.15  # triangles are many
            panel.add_collection(PolyCollection(polygons, facecolors="none", edgecolors=color, lw=width, alpha=0.35))
        for there, color, label in ((believed, NOMINAL, "believed"), (explained, EXPLAINED, said)):
            ends = 1e3 * np.stack([recorded, there], 1)[..., view]
            panel.add_collection(LineCollection(list(ends), colors=color, lw=1.0))
            panel.plot(*(1e3 * there[:, view].T), "o", ms=5, mfc="white", mec=color, mew=1.4, label=label)
        panel.plot(*(1e3 * recorded[:, view].T), "o", ms=4, color=RECORDED, label="recorded")
        panel.set_aspect("equal")
        panel.set_xlabel(f"{'xyz'[one]} [mm]", fontsize=8)
        panel.tick_params(labelsize=8)
    whole.autoscale_view()
    whole.set_ylabel(f"{'xyz'[other]} [mm]", fontsize=8)
    _surroundings(whole, setup, view)
    for name, place in places:
        whole.plot(*(1e3 * body.moved(place)[list(view)]), "x", ms=9, mew=2.4, color=PLACE, label=name)
    needed = [] if forces is None else [n for n in forces.needed if n.trial == body.trial]
    for n in needed[:2]:
        ends = body.moved(n.place) + 0.3 * max(setup.size) / np.linalg.norm(needed[0].force) * np.outer((0, 1), n.force)
        begin, end = 1e3 * ends[:, view]
        whole.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "color": PLACE, "lw": 2})
        when = "throughout" if n.whole else f"{n.start:.2g} to {n.end:.2g} s"
        label = f"{np.linalg.norm(n.force):.2g} N, {when}"
        plate = {"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1}
        whole.annotate(label, end, xytext=(4, 4), textcoords="offset points", fontsize=7, color=PLACE, bbox=plate)
    whole.set_title(f"trial {body.trial} at {body.time[k]:.3g} s", fontsize=9)
    if count > 1:
        middle, half = 1e3 * (recorded[m] + believed[m])[list(view)] / 2, max(0.9 * apart, 0.02 * size.max())
        close.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        close.set_title(f"marker {setup.markers[m].name}", fontsize=9)
    _legend(figure, whole)
    return figure


def side_view(body: BodyMotion, setup: Setup) -> tuple[int, int]:
    """The axes across and up of a picture: without the one along which the worst marker is hardly off.

    Of several, the one along which the body is shortest is left out, but none that planes are normal to.
    """
    off = np.abs(body.recorded - body.markers[0])[body.worst, body.marker]
    off[[axis not in setup.axes for axis in range(3)]] = 0.0
    size = np.array(setup.size)
    for plane in setup.planes:
        size[int(np.argmax(np.abs(plane.normal)))] = np.inf
    hardly = off < max(0.3 * off.max(), 1.0001 * off.min(), 1e-12)
    left = min(np.flatnonzero(hardly), key=lambda axis: size[axis])
    one, other = (axis for axis in range(3) if axis != left)
    return one, other


def _surroundings(panel: Axes, setup: Setup, view: tuple[int, int]) -> None:
    """Clamps and planes, as far as the panel reaches."""
    across, up = panel.get_xlim(), panel.get_ylim()
    low, size = np.array(setup.origin), np.array(setup.size)
    for box in setup.clamps:
        begin, end = (1e3 * np.clip(corner, low - 0.02 * size, low + 1.02 * size)[list(view)] for corner in box)
        panel.add_patch(Rectangle(tuple(begin), *(end - begin), fc="0.8", ec=SURROUNDINGS, hatch="////", lw=0.8))
    for plane in setup.planes:
        normal = np.array(plane.normal)[list(view)]
        if np.linalg.norm(normal) > 0.99 * np.linalg.norm(plane.normal):
            x, y = (1e3 * plane.point[axis] for axis in view)
            panel.axline((x, y), (x - normal[1], y + normal[0]), color=SURROUNDINGS, lw=1.8)
    panel.set(xlim=across, ylim=up)


def draw_forces(forces: ForceMap, setup: Setup) -> Figure:
    """Size of the force by place and time for each trial; below, the components on the strongest patch."""
    count, longest = len(forces.trials), int(np.argmax(setup.size))
    figure = Figure(figsize=(max(5.5, min(11, 4.2 * count)), 5.2), layout="constrained")
    panels: Any = figure.subplots(2, count, squeeze=False, sharex="col")
    sizes = np.linalg.norm(forces.forces, axis=-1)
    half = 500 * setup.size[longest] / len(forces.places)
    middles = 1e3 * forces.places[:, longest]
    edges = np.append(middles - half, middles[-1] + half)
    mesh = None
    for t, name in enumerate(forces.trials):
        top, bottom = panels[:, t]
        mesh = top.pcolormesh(forces.windows[t], edges, sizes[t], cmap="magma_r", vmin=0, vmax=max(sizes.max(), 1e-12))
        top.set_title(f"trial {name}", fontsize=9)
        p = int(sizes[t].max(-1).argmax())
        for axis, color in enumerate(AXES):
            value, spread = forces.forces[t, p, :, axis], forces.deviations[t, p, :, axis]
            bottom.stairs(value, forces.windows[t], color=color, lw=1.6, label="xyz"[axis], baseline=None)
            if np.isfinite(spread).all():
                bottom.stairs(
                    value + spread, forces.windows[t], baseline=value - spread, fill=True, color=color, alpha=0.18, lw=0
                )
        bottom.axhline(0, color="0.7", lw=0.6)
        bottom.set_title(f"at {middles[p]:.0f} mm", fontsize=8)
        bottom.set_xlabel("time [s]", fontsize=8)
        for panel in (top, bottom):
            panel.tick_params(labelsize=7)
    reach = 1.1 * max(float(np.abs(forces.forces).max()), 1e-12)
    for panel in panels[1]:
        panel.set_ylim(-reach, reach)
    panels[0, 0].set_ylabel(f"{'xyz'[longest]} [mm]", fontsize=8)
    panels[1, 0].set_ylabel("force [N]", fontsize=8)
    panels[1, 0].legend(fontsize=7)
    assert mesh is not None
    figure.colorbar(mesh, ax=panels[0].tolist(), label="force [N]")
    return figure


def draw_cosines(found: Isolability) -> Figure:
    """A heat map of how much of each effect's change another can imitate."""
    names = [name.replace("_", " ") for name in found.effects]
    count = len(names)
    figure = Figure(figsize=(3.2 + 0.36 * count, 2.2 + 0.3 * count), layout="constrained")
    panel: Axes = figure.subplots()
    image = panel.imshow(found.cosines, vmin=0, vmax=1, cmap="Blues", aspect="auto")
    for i, j in np.ndindex(count, count):
        if i != j and found.cosines[i, j] > 0.5:
            color = "white" if found.cosines[i, j] > 0.7 else "black"
            panel.text(j, i, f"{found.cosines[i, j]:.2f}", ha="center", va="center", fontsize=7, color=color)
    panel.set_xticks(range(count), names, rotation=90, fontsize=8)
    panel.set_yticks(range(count), names, fontsize=8)
    figure.colorbar(image, ax=panel, shrink=0.8)
    return figure
