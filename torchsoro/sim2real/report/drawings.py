"""Pictures of an explanation: markers over time, mismatch over time and on the body, forces that would be needed."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.inference.force_map import ForceMap
from torchsoro.sim2real.inference.heldout import Prediction
from torchsoro.sim2real.inference.isolability import Isolability
from torchsoro.sim2real.inference.phases import DEPARTURE, Mismatch, together
from torchsoro.sim2real.report.words import probability

RECORDED, NOMINAL, EXPLAINED = "#1f2933", "#b5651d", "#396ba3"
PLACE, BODY = "#a3154a", "#52606d"
EDGES = 400  # of a body, that are drawn at most
LEAST_RANGE = 0.15  # of the widest panel's range, that any panel shows
AXES = ("#c0392b", "#2e8b57", "#2c5aa0")
BARS = 10  # of probabilities, that are drawn at most
BANDS = ("#e9eef4", "#f8f4ea")  # of phases, in turn


def draw_trial(trial: Trial, believed: np.ndarray, explained: np.ndarray) -> Figure:
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
        panel.plot(recording.time, curves[1, :, m, a], "-", lw=1.2, color=NOMINAL, label="believed")
        panel.plot(recording.time, curves[2, :, m, a], "-", lw=1.6, color=EXPLAINED, label="explained")
        panel.plot(recording.time, curves[0, :, m, a], ".", ms=2.5, color=RECORDED, label="recorded")
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


def draw_mismatch(mismatches: Sequence[Mismatch], trials: Sequence[Trial], after: str) -> Figure:
    """Distance of each trial's simulations over time, phases as bands; ``after`` names the second line."""
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
        for values, color, label in ((m.before, NOMINAL, "believed"), (m.after, EXPLAINED, after)):
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
    setup: Setup,
    before: Sequence[Prediction],
    after: Sequence[Prediction],
    places: Sequence[tuple[str, np.ndarray]],
    forces: ForceMap | None,
    said: str,
) -> Figure:
    """Markers on the body in space, coloured by their distance from the recording, with places of effects and forces.

    ``said`` is what the second picture shows.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    at, low, size = (1e3 * np.array(v) for v in ([m.at for m in setup.markers], setup.origin, setup.size))
    values = [1e3 * np.sqrt(np.mean([p.error**2 for p in all_], axis=0)) for all_ in (before, after)]
    most = max(float(values[0].max()), float(values[1].max()), 1e-6)
    panels, points = [], None
    for k, title in enumerate(("believed", said)):
        panel: Any = figure.add_subplot(1, 2, k + 1, projection="3d")
        panels.append(panel)
        panel.patch.set_visible(False)  # which would cover the other's label
        for edge in _outline(setup):
            panel.plot(*(1e3 * edge.T), color=BODY, lw=1.3)
        for box in setup.clamps:
            one, other = (np.clip(1e3 * np.array(corner), low, low + size) for corner in box)
            ends = itertools.product(*zip(one, other, strict=True))
            panel.scatter(*np.array(list(ends)).T, marker="s", s=14, color="0.3", depthshade=False)
        points = panel.scatter(
            *at.T, c=values[k], s=60, cmap="viridis_r", vmin=0, vmax=most, edgecolors="0.2", lw=0.6, depthshade=False
        )
        if len(at) <= 12:
            for marker, place in zip(setup.markers, at, strict=True):
                panel.text(*(place + 0.03 * size.max()), marker.name, fontsize=7)
        panel.set_title(title, fontsize=9)
        # A thin body would be a line at its true proportions.
        panel.set_box_aspect(np.maximum(size, 0.25 * size.max()), zoom=0.85)  # its labels lie outside
        panel.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
        panel.tick_params(labelsize=6)
        panel.locator_params(nbins=4)
    for name, place in places:
        panels[1].scatter(*(1e3 * place), marker="x", s=90, color=PLACE, lw=2.5, depthshade=False, label=name)
    needed = [] if forces is None else forces.needed
    for n in needed[:3]:
        arrow = 0.35 * size.max() * n.force / np.linalg.norm(needed[0].force)
        label = f"{np.linalg.norm(n.force):.2g} N, trial {n.trial}"
        panels[0].quiver(*(1e3 * n.place), *arrow, color=PLACE, lw=2, label=label)
    for panel, shown in zip(panels, (needed, places), strict=True):
        if shown:
            panel.legend(fontsize=7, loc="upper left")
    assert points is not None
    figure.colorbar(points, ax=panels, shrink=0.7, label="distance [mm]")
    return figure


def _outline(setup: Setup) -> np.ndarray:
    """Edges of the body, or of its box where it has too many [E, 2, 3] m."""
    if setup.surface is not None and len(setup.surface.edges) <= EDGES:
        return setup.surface.edges
    pairs = itertools.combinations(itertools.product((0, 1), repeat=3), 2)
    ends = [pair for pair in pairs if np.abs(np.subtract(*pair)).sum() == 1]
    return np.array(setup.origin) + np.array(setup.size) * np.array(ends)


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


def draw_probabilities(found: Mapping[str, float]) -> Figure:
    """Bars of posterior probabilities by name, the most probable first."""
    leading = sorted(found.items(), key=lambda item: -item[1])[:BARS]
    figure = Figure(figsize=(6.5, 0.6 + 0.28 * len(leading)), layout="constrained")
    panel: Axes = figure.subplots()
    bars = panel.barh([name for name, _ in leading], [100 * p for _, p in leading], color=EXPLAINED)
    panel.bar_label(bars, labels=[probability(p) for _, p in leading], padding=3, fontsize=8)
    panel.invert_yaxis()
    panel.set_xlim(0, 125)
    panel.set_xlabel("probability [%]", fontsize=8)
    panel.tick_params(labelsize=8)
    return figure
