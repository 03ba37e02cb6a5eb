"""An explanation on disk: ``report.html`` for people, ``explanation.json`` for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.stats import norm

from torchsoro.document import Document
from torchsoro.sim2real.experiment import Trial
from torchsoro.sim2real.fit import Fit, Problem
from torchsoro.sim2real.heldout import Prediction
from torchsoro.sim2real.isolability import SAME, Isolability
from torchsoro.sim2real.likeness import SCORE
from torchsoro.sim2real.next_experiment import Proposal, advice
from torchsoro.sim2real.numerics import Numerics
from torchsoro.sim2real.verdict import Candidate, Verdict, correlation
from torchsoro.storage import atomic_write

FORM = 0.1  # of a number, that is due to an effect's form
LEVEL = 0.9
BELIEVED = 3.0  # standard deviations of a measurement error that are believed
RECORDED, NOMINAL, EXPLAINED = "#1f2933", "#b5651d", "#396ba3"


@dataclass(frozen=True, kw_only=True, eq=False)
class Explanation:
    """All that was found out about an experiment.

    Attributes:
        problem: Recordings and twin.
        numerics: The twin's own error.
        verdict: What can be said.
        before: All trials as believed, those that were fitted first.
        after: The same with the best effect, or with nothing where nothing is missing.
        heldout: Names of the trials that were only predicted.
        seconds: It took.
        isolability: What the experiment can tell, if that was asked.
        following: What could be recorded next, best first, where effects are not told apart.
    """

    problem: Problem
    numerics: Numerics
    verdict: Verdict
    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]
    heldout: tuple[str, ...]
    seconds: float
    isolability: Isolability | None = None
    following: tuple[Proposal, ...] = ()

    @property
    def best(self) -> Fit:
        """The fit that is shown: of the best effect, or of nothing."""
        return self.verdict.chosen[0].fit if self.verdict.chosen else self.verdict.nothing


def effect_rows(candidate: Candidate, weight: float, problem: Problem) -> list[dict[str, Any]]:
    """The effects of a candidate, as in explanation.json; intervals by the law of errors, within bounds."""
    wide, rows, scenario = float(norm.ppf((1 + LEVEL) / 2)), [], problem.scenarios[0]
    fit = candidate.fit
    spread = max(1.0, fit.misfit / fit.samples) * correlation(fit)
    for effect, values, covariance in zip(fit.effects, fit.values, fit.covariances, strict=True):
        count = len(effect.quantities)
        # Nature's form is not the hypothesis': of no number more is known than some share.
        logarithm = np.array([q.unit.startswith("ln ") for q in effect.quantities])
        own = np.where(logarithm, 1.0, values[:count])
        whole = spread * covariance[:count, :count] + np.diag((FORM * own) ** 2)
        steps = 1e-4 * np.array([q.scale for q in effect.quantities])
        told = effect.told(values[:count], scenario)
        ahead = [effect.told(values[:count] + step * np.eye(count)[k], scenario) for k, step in enumerate(steps)]
        parameters = {}
        for name, (value, unit) in told.items():
            slope = np.array([(a[name][0] - value) / step for a, step in zip(ahead, steps, strict=True)])
            half = wide * math.sqrt(max(float(slope @ whole @ slope), 0.0))
            parameters[name] = {"value": value, "low": value - half, "high": value + half, "unit": unit}
            for quantity in effect.quantities:
                if quantity.name == name:
                    parameters[name]["low"] = max(value - half, quantity.least * quantity.scale)
        place = effect.place(values, problem.twin)
        rows.append(
            {
                "name": effect.name,
                "parameters": parameters,
                "confidence": weight,
                "location_m": None if place is None else [float(v) for v in place],
                "time_window_s": None,
            }
        )
    return rows


def as_json(e: Explanation, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The content of explanation.json."""
    v, problem = e.verdict, e.problem
    scores = np.array([c.score for c in v.chosen])
    weights = np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum() if len(scores) else scores
    names = [m.name for m in problem.experiment.setup.markers]

    def errors(predictions: Sequence[Prediction]) -> dict[str, Any]:
        return {p.trial: {"all": p.total, **dict(zip(names, map(float, p.error), strict=True))} for p in predictions}

    return {
        "verdict": v.kind,
        "effects": effect_rows(v.chosen[0], float(weights[0]), problem) if v.chosen else [],
        "set": [c.fit.name for c in v.chosen],
        "ranking": [
            {
                "name": c.fit.name,
                "score": c.score,
                "explained": c.explained,
                "misfit": c.fit.misfit,
                "samples": c.fit.samples,
                "unknowns": c.fit.unknowns,
                "alike": correlation(c.fit),
                "heldout_over_nothing": None if math.isnan(c.kept) else c.kept,
                "effects": effect_rows(c, 0.0, problem),
            }
            for c in v.ranking
        ],
        "noise": {
            "standard_deviation_m": problem.noise,
            "numerics_m": {
                t.name: float(np.sqrt((n**2).mean())) for t, n in zip(problem.trials, problem.numerics, strict=True)
            },
            "edges_m": list(e.numerics.edges),
            "cells_through_thinnest_wall": list(e.numerics.walls),
            "excess": v.excess,
            "nothing": {"misfit": v.nothing.misfit, "samples": v.nothing.samples, "alike": correlation(v.nothing)},
        },
        "nuisance": {
            "ln_modulus": float(e.best.belief[0]),
            **({"ln_pressure": float(e.best.belief[1])} if len(e.best.belief) > 1 else {}),
            **dict(zip(problem.camera.names, map(float, e.best.errors), strict=True)),
        },
        "error_before": errors(e.before),
        "error_after": errors(e.after),
        "heldout": [{"trial": name, "before": b, "after": a} for name, (b, a) in v.heldout.items()],
        "isolability": None if e.isolability is None else e.isolability.as_json(),
        "next": [{"record": p.words, "alike": p.alike, "distance": p.distance} for p in e.following],
        "cost": {"simulations": problem.tally.simulations, "seconds": e.seconds},
        "version": version("torchsoro"),
        "settings": dict(settings),
    }


def lead(e: Explanation) -> str:
    """The answer in plain words."""
    v = e.verdict
    held = list(v.heldout.values())
    gain = ""
    if held:
        before, after = (math.sqrt(sum(x * x for x in column) / len(held)) for column in zip(*held, strict=True))
        gain = (
            f" On trials that were left out ({', '.join(v.heldout)}) the error is {1e3 * after:.2f} mm instead of "
            f"{1e3 * before:.2f} mm."
        )
    if v.kind == "nothing_missing":
        return (
            "Nothing is missing: clock, scale, marker places, modulus and pressure within their beliefs, and the error "
            f"of the simulation itself explain the difference.{gain}"
        )
    if v.kind == "unknown_physics":
        best = v.ranking[0] if v.ranking else None
        tried = (
            f" The best of what is known, {best.fit.name}, takes away {100 * best.explained:.0f} % of it."
            if best
            else ""
        )
        return f"Something is missing that is none of the known effects.{tried}{gain}"
    parts = "; ".join(_said(c, e.problem) for c in v.chosen)
    if v.kind == "cannot_distinguish":
        following = f" {advice(e.following)}" if advice(e.following) else ""
        return f"One of these is missing, and this recording cannot tell which: {parts}.{following}{gain}{_beyond(e)}"
    second = next((c for c in v.ranking if c is not v.chosen[0]), None)
    lost = ""
    if second is not None:
        lost = (
            f" Next best is {second.fit.name}, which takes away {100 * max(second.explained, 0):.0f} % of the "
            f"difference against {100 * v.chosen[0].explained:.0f} %."
        )
    return f"Missing is {parts}.{gain}{lost}{_beyond(e)}"


def _beyond(e: Explanation) -> str:
    """Measurement errors that are larger than can be believed: something else is hidden in them."""
    camera = e.problem.camera
    large = [
        f"{name} {value:.2g} (believed within {deviation:.2g})"
        for name, value, deviation in zip(camera.names, e.best.errors, camera.deviations, strict=True)
        if abs(value) > BELIEVED * deviation
    ]
    if not large:
        return ""
    return (
        " But the fit bends measurement errors further than can be believed, so that more is missing than this: "
        f"{', '.join(large)}. What is left over is {e.verdict.excess:.2g} times what noise and the simulation's own "
        "error explain; where and when is drawn below."
    )


def _said(candidate: Candidate, problem: Problem) -> str:
    parts = []
    for row in effect_rows(candidate, 0.0, problem):
        numbers = ", ".join(
            f"{name} {p['value']:.3g} {p['unit']} (90 %: {p['low']:.3g} to {p['high']:.3g})"
            for name, p in row["parameters"].items()
        )
        where = row["location_m"]
        place = "" if where is None else " at (" + ", ".join(f"{1e3 * x:.0f}" for x in where) + ") mm"
        parts.append(f"{row['name']}{place}: {numbers}")
    return " and ".join(parts)


def write(e: Explanation, trials: Sequence[Trial], out: Path, settings: Mapping[str, Any]) -> None:
    """Write report.html and explanation.json.

    Args:
        e: What was found.
        trials: All, in the order of ``e.before``.
        out: Folder, which exists.
        settings: How it was asked for.
    """
    data = as_json(e, settings)
    with atomic_write(out / "explanation.json") as file:
        file.write((json.dumps(data, indent=2) + "\n").encode())
    page = Document(e.problem.experiment.setup.title or "Explanation", lead(e))
    page.section("Recorded, believed, explained")
    for trial, before, after in zip(trials, e.before, e.after, strict=True):
        kept = ", not used for the fit" if trial.name in e.heldout else ""
        caption = f"Trial {trial.name}{kept}: markers as recorded, as believed, and as explained."
        page.figure(draw_trial(trial, before, after), caption)
    page.section("Where and when")
    page.figure(draw_where(e, trials), "Mismatch before and after: on the body by marker, and over time.")
    page.section("What was considered")
    considered = [
        {
            "effect": c.fit.name,
            "score": c.score,
            "of the difference [%]": 100 * c.explained,
            "misfit / samples": c.fit.misfit / c.fit.samples,
            "parameters": _said(c, e.problem),
        }
        for c in e.verdict.ranking
    ]
    if considered:
        page.table(considered, "Score: gain in ln of the likelihood, studentised, less what the parameters are worth.")
    if e.isolability is not None:
        page.section("What this experiment can tell")
        write_isolability(page, e.isolability)
    page.section("Errors")
    page.table(
        [
            {
                "trial": b.trial,
                "before [mm]": 1e3 * b.total,
                "after [mm]": 1e3 * a.total,
                "used": b.trial not in e.heldout,
            }
            for b, a in zip(e.before, e.after, strict=True)
        ],
        "Root mean square over markers, in space.",
    )
    page.section("What is not physics")
    noise = data["noise"]
    page.text(
        f"Noise {1e3 * noise['standard_deviation_m']:.3f} mm. The simulation's own error, from twins with cells of "
        f"{', '.join(f'{1e3 * s:.2f}' for s in e.numerics.edges)} mm: "
        + ", ".join(f"{1e3 * value:.3f} mm in trial {name}" for name, value in noise["numerics_m"].items())
        + f". {e.numerics.walls[0]} cells through the thinnest wall, corrected by a twin with {e.numerics.walls[1]}."
    )
    deviations = dict(zip(e.problem.camera.names, e.problem.camera.deviations, strict=True))
    page.table(
        [
            {"measurement error": name, "fitted": value, "believed within": deviations.get(name)}
            for name, value in data["nuisance"].items()
        ]
    )
    page.text(f"{e.problem.tally.simulations} simulations, {e.seconds:.0f} s, torchsoro {data['version']}.")
    page.save(out / "report.html")


def write_isolability(page: Document, found: Isolability) -> None:
    """What would be seen, and what looks alike."""
    alike = found.confused()
    page.table(
        [
            {
                "effect": name,
                "quantity": quantity,
                "seen from": value if math.isfinite(value) else None,
                "unit": unit,
                "may pass for it": ", ".join(b for a, b in alike if a == name),
            }
            for name, (quantity, unit), value in zip(found.effects, found.quantities, found.detectable, strict=True)
        ],
        f"By times, markers and noise alone: the strength from which on an effect stands out (score {SCORE:g}), beside "
        f"measurement errors, modulus and pressure; and what else can make {100 * SAME:.0f} % of its change.",
    )
    caption = "How much of the change that the effect of a row makes, that of a column can imitate."
    page.figure(draw_alike(found), caption)


def draw_alike(found: Isolability) -> Figure:
    """A heat map of what looks alike."""
    count = len(found.effects)
    figure = Figure(figsize=(3.2 + 0.36 * count, 2.2 + 0.3 * count), layout="constrained")
    panel: Axes = figure.subplots()
    image = panel.imshow(found.alike, vmin=0, vmax=1, cmap="Blues", aspect="auto")
    for i, j in np.ndindex(count, count):
        if i != j and found.alike[i, j] > 0.5:
            color = "white" if found.alike[i, j] > 0.7 else "black"
            panel.text(j, i, f"{found.alike[i, j]:.2f}", ha="center", va="center", fontsize=6, color=color)
    panel.set_xticks(range(count), found.effects, rotation=90, fontsize=7)
    panel.set_yticks(range(count), found.effects, fontsize=7)
    figure.colorbar(image, ax=panel, shrink=0.8)
    return figure


def draw_trial(trial: Trial, before: Prediction, after: Prediction) -> Figure:
    """Each marker's recorded axes over time."""
    recording = trial.recording
    assert recording is not None
    names = [m.name for m in trial.setup.markers]
    count, axes = len(names), recording.axes
    figure = Figure(figsize=(11, 1.2 + 1.35 * count), layout="constrained")
    panels: Any = figure.subplots(count, len(axes), sharex=True, squeeze=False)
    for m, a in np.ndindex(count, len(axes)):
        panel: Axes = panels[m, a]
        panel.plot(recording.time, 1e3 * recording.place[:, m, a], ".", ms=2, color=RECORDED, label="recorded")
        panel.plot(recording.time, 1e3 * before.seen[:, m, a], "-", lw=1, color=NOMINAL, label="believed")
        panel.plot(recording.time, 1e3 * after.seen[:, m, a], "-", lw=1, color=EXPLAINED, label="explained")
        panel.tick_params(labelsize=7)
        if a == 0:
            panel.set_ylabel(f"{names[m]} [mm]", fontsize=8)
        if m == 0:
            panel.set_title("xyz"[axes[a]], fontsize=9)
        if m == count - 1:
            panel.set_xlabel("time [s]", fontsize=8)
    panels[0, 0].legend(fontsize=7)
    return figure


def draw_where(e: Explanation, trials: Sequence[Trial]) -> Figure:
    """Mismatch by marker on the body's side views, and over time with the pressure."""
    setup = e.problem.experiment.setup
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    halves: Any = figure.subfigures(2, 1)
    top, bottom = halves
    panels: Sequence[Axes] = top.subplots(1, 2)
    at = np.array([m.at for m in setup.markers])
    before = np.sqrt(np.mean([p.error**2 for p in e.before], axis=0))
    after = np.sqrt(np.mean([p.error**2 for p in e.after], axis=0))
    largest = max(float(before.max()), 1e-9)
    for panel, (i, j) in zip(panels, ((0, 2), (0, 1)), strict=True):
        low, size = np.array(setup.origin)[[i, j]], np.array(setup.size)[[i, j]]
        panel.add_patch(_rectangle(low * 1e3, size * 1e3))
        for number, (value, color) in enumerate(((before, NOMINAL), (after, EXPLAINED))):
            sizes = 20 + 600 * value / largest
            label = ("before", "after")[number]
            panel.scatter(1e3 * at[:, i], 1e3 * at[:, j], s=sizes, color=color, alpha=0.55, label=label)
        for c in e.verdict.chosen:
            for row in effect_rows(c, 0.0, e.problem):
                if row["location_m"] is not None:
                    place = 1e3 * np.array(row["location_m"])
                    panel.plot(place[i], place[j], "x", ms=11, mew=2.5, color="#a3154a", label=row["name"])
        panel.set(aspect="equal", xlabel=f"{'xyz'[i]} [mm]", ylabel=f"{'xyz'[j]} [mm]")
    panels[0].legend(fontsize=7)
    axes = bottom.subplots(1, len(trials), squeeze=False)[0]
    for panel, trial, one, other in zip(axes, trials, e.before, e.after, strict=True):
        recording = trial.recording
        assert recording is not None
        for p, color in ((one, NOMINAL), (other, EXPLAINED)):
            off = np.sqrt(np.nanmean(((recording.place - p.seen) ** 2).sum(-1), axis=1))
            panel.plot(recording.time, 1e3 * off, color=color, lw=1)
        panel.set(xlabel="time [s]", ylabel="off by [mm]", title=f"trial {trial.name}", yscale="log")
        if trial.pressure is not None:
            other_axis = panel.twinx()
            supply = trial.pressure.pressure.reshape(-1, len(trial.pressure.time))[0].numpy()
            other_axis.fill_between(trial.pressure.time.numpy(), supply / 1e3, color="0.85", zorder=0)
            other_axis.set_ylabel("pressure [kPa]", fontsize=8)
    return figure


def _rectangle(low: np.ndarray, size: np.ndarray) -> Rectangle:
    return Rectangle((float(low[0]), float(low[1])), float(size[0]), float(size[1]), fc="#e4e9ef", ec="0.6")
