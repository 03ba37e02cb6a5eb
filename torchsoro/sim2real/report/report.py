"""An explanation on disk: ``report.html`` for people, ``explanation.json`` for programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from torchsoro.output.document import Document
from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.cosines import SCORE
from torchsoro.sim2real.inference.discretization import Numerics
from torchsoro.sim2real.inference.fit import Fit, Problem
from torchsoro.sim2real.inference.force_map import ForceMap
from torchsoro.sim2real.inference.heldout import Prediction
from torchsoro.sim2real.inference.isolability import SAME, Isolability
from torchsoro.sim2real.inference.next_experiment import Proposal, advice
from torchsoro.sim2real.inference.phases import Mismatch
from torchsoro.sim2real.inference.ranking import Candidate, correlation
from torchsoro.sim2real.inference.verdict import Verdict, number
from torchsoro.sim2real.report.drawings import draw_alike, draw_body, draw_forces, draw_mismatch, draw_trial
from torchsoro.storage import atomic_write

LEVEL = 0.9
BELIEVED = 3.0  # standard deviations of a measurement error that are believed
PLACE = 0.07  # of the body's size, that a place may be off, as ``Hypothesis.form`` of a parameter
BROKEN = 1e3  # error on trials left out over that without an effect, where that breaks down: JSON knows no infinity


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
        mismatches: Where and when each trial and its simulation part.
        forces: That would be needed where no effect fits.
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
    mismatches: tuple[Mismatch, ...] = ()
    forces: ForceMap | None = None

    @property
    def best(self) -> Fit:
        """The fit that is shown: of the best effect, or of nothing."""
        return self.verdict.chosen[0].fit if self.verdict.chosen else self.verdict.nothing


def effect_rows(fit: Fit, weight: float, problem: Problem) -> list[dict[str, Any]]:
    """The effects of a fit, as in explanation.json; intervals by the law of errors, within bounds."""
    wide, rows = float(norm.ppf((1 + LEVEL) / 2)), []
    spread, size = max(1.0, fit.misfit / fit.samples) * correlation(fit), np.array(problem.twin.setup.size)
    for effect, values, covariance in zip(fit.effects, fit.values, fit.covariances, strict=True):
        count = len(effect.quantities)
        scenario = next(s for s in problem.scenarios if effect.applies(s, problem.twin))
        logarithm = np.array([q.unit.startswith("ln ") for q in effect.quantities])
        own = np.where(logarithm, 1.0, values[:count])
        whole = spread * covariance[:count, :count] + np.diag((effect.form * own) ** 2)
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
        within = wide * np.sqrt(spread * np.diag(covariance)[count:] + (PLACE * size[: 3 * effect.local]) ** 2)
        rows.append(
            {
                "name": effect.name,
                "parameters": parameters,
                "confidence": weight,
                "location_m": None if place is None else [float(v) for v in place],
                "location_within_m": [float(v) for v in within] or None,
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
        "effects": effect_rows(v.chosen[0].fit, float(weights[0]), problem) if v.chosen else [],
        "set": [c.fit.name for c in v.chosen],
        "ranking": [
            {
                "name": c.fit.name,
                "score": c.score,
                "explained": c.explained,
                "misfit": c.fit.misfit,
                "samples": c.fit.samples,
                "unknowns": c.fit.unknowns,
                "gain": c.gain,
                "alike": correlation(c.fit),
                "heldout_over_nothing": None if math.isnan(c.kept) else min(c.kept, BROKEN),
                "effects": effect_rows(c.fit, 0.0, problem),
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
        "mismatch": {m.trial: _parted(m) for m in e.mismatches},
        "force_map": None if e.forces is None else _needed(e.forces),
        "heldout": [{"trial": name, "before": b, "after": a} for name, (b, a) in v.heldout.items()],
        "isolability": None if e.isolability is None else e.isolability.as_json(),
        "next": [{"record": p.words, "alike": p.alike, "distance": p.distance} for p in e.following],
        "cost": {"simulations": problem.tally.simulations, "seconds": e.seconds},
        "version": version("torchsoro"),
        "settings": dict(settings),
    }


def _parted(m: Mismatch) -> dict[str, Any]:
    """A trial's mismatch, as in explanation.json; in units of what noise and numerics explain."""

    def numbers(row: np.ndarray) -> dict[str, float | None]:
        return {name: None if math.isnan(v) else float(v) for name, v in zip(m.markers, row, strict=True)}

    return {
        "starts_s": m.start,
        "phase": None if m.phase is None else m.phase.name,
        "worst_marker": m.marker,
        "phases": [
            {"name": p.name, "start_s": p.start, "end_s": p.end, "before": numbers(b), "after": numbers(a)}
            for p, b, a in zip(m.phases, m.by_phase(), m.by_phase(after=True), strict=True)
        ],
    }


def _needed(f: ForceMap) -> dict[str, Any]:
    """A force map, as in explanation.json; no deviation where a patch was not needed."""
    deviations = f.deviations.astype(object)
    deviations[~np.isfinite(f.deviations)] = None
    return {
        "trials": list(f.trials),
        "places_m": f.places.tolist(),
        "windows_s": f.windows.tolist(),
        "forces_n": f.forces.tolist(),
        "deviations_n": deviations.tolist(),
        "misfit_of_each_place": f.misfits.tolist(),
        "share": f.share,
        "simulated_share": f.simulated,
        "needed": [
            {
                "trial": n.trial,
                "place_m": n.place.tolist(),
                "force_n": n.force.tolist(),
                "start_s": n.start,
                "end_s": n.end,
            }
            for n in f.needed
        ],
        "words": str(f),
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
            f" The best of what is known, {_plain(best.fit.name)}, takes away {100 * best.explained:.0f} % of it."
            if best
            else ""
        )
        force = f" {e.forces}" if e.forces else ""
        return f"{_parting(e)}Something is missing that is none of the known effects.{tried}{gain}{force}"
    parts = "; ".join(_said(c, e.problem) for c in v.chosen)
    if v.kind == "cannot_distinguish":
        following = f" {advice(e.following)}".rstrip()
        which = f"One of these is missing, and this recording cannot tell which: {parts}."
        return f"{_parting(e)}{which}{following}{gain}{_beyond(e)}"
    second = next((c for c in v.ranking if c is not v.chosen[0]), None)
    lost = ""
    if second is not None:
        lost = (
            f" Next best is {_plain(second.fit.name)}, which takes away {100 * max(second.explained, 0):.0f} % of the "
            f"difference against {100 * v.chosen[0].explained:.0f} %, and leaves "
            f"{second.fit.misfit / v.chosen[0].fit.misfit:.3g} times the misfit."
        )
    return f"{_parting(e)}Missing is {parts}.{gain}{lost}{_beyond(e)}"


def _plain(name: str, unit: str = "") -> str:
    """A name without its unit and underscores."""
    suffix = re.sub(r"[ /]", "_", unit).lower()
    return name.removesuffix(f"_{suffix}").replace("_", " ")


def _parting(e: Explanation) -> str:
    """Where and when, in the trial in which it is first."""
    apart = [m for m in e.mismatches if m.where]
    if not apart:
        return ""
    first = min(apart, key=lambda m: m.start or 0.0)
    return f"Simulation and recording part in trial {first.trial} {first.where}. "


def _beyond(e: Explanation) -> str:
    """Measurement errors that are larger than can be believed: something else is hidden in them."""
    camera = e.problem.camera
    large = []
    for name, value, deviation in zip(camera.names, e.best.errors, camera.deviations, strict=True):
        if abs(value) > BELIEVED * deviation:
            unit = next((u for u in ("rad", "m", "s") if name.endswith(f"_{u}")), "1")
            large.append(f"{_plain(name, unit)} {number(value, unit)} (believed within {deviation:.2g})")
    if not large:
        return ""
    told = (
        " But the fit bends measurement errors further than can be believed, so that more is missing than this: "
        f"{', '.join(large)}."
    )
    if e.verdict.excess > 1:
        told += (
            f" What is left over is {e.verdict.excess:.2g} times what noise and the simulation's own error explain; "
            "where and when is drawn below."
        )
    return told


def _said(candidate: Candidate, problem: Problem) -> str:
    parts = []
    for row in effect_rows(candidate.fit, 0.0, problem):
        numbers = ", ".join(
            f"{_plain(name, p['unit'])} {number(p['value'], p['unit'])} (90 %: {p['low']:.3g} to {p['high']:.3g})"
            for name, p in row["parameters"].items()
        )
        place = ""
        if row["location_m"] is not None:
            within = [f" ± {1e3 * w:.0f}" for w in row["location_within_m"] or []] or [""] * 3
            at = [f"{1e3 * x:.0f}{w}" for x, w in zip(row["location_m"], within, strict=True)]
            place = f" at ({', '.join(at)}) mm"
        parts.append(f"{_plain(row['name'])}{place}: {numbers}")
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
    page.text(" ".join(map(str, e.mismatches)))
    after = "after" if e.verdict.chosen else "fitted without an effect"
    page.figure(
        draw_mismatch(e.mismatches, trials, after),
        "Mismatch over time before and after, in what noise and the simulation's own error explain, with the phases of "
        "each trial; where a pressure is supplied it is grey.",
    )
    places = [
        (row["name"], np.array(row["location_m"]))
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        if row["location_m"] is not None
    ]
    page.figure(
        draw_body(e.problem.experiment.setup, e.before, e.after, places, e.forces, after),
        "Mismatch on the body by marker, root mean square over all trials.",
    )
    if e.forces is not None:
        page.section("The force that would be needed")
        page.text(f"{e.forces} A force stands in for what is missing; it does not say what that is.")
        page.figure(
            draw_forces(e.forces, e.problem.experiment.setup),
            "Size of the force by place and time, and the components of the strongest, with standard deviations.",
        )
    page.section("What was considered")
    considered = [
        {
            "effect": c.fit.name,
            "changes": " and ".join(effect.seam for effect in c.fit.effects),
            "score": c.score,
            "of the difference [%]": 100 * c.explained,
            "misfit / samples": c.fit.misfit / c.fit.samples,
            "left out, after / before": "breaks down" if math.isinf(c.kept) else c.kept,
            "parameters": _said(c, e.problem),
        }
        for c in e.verdict.ranking
    ]
    if considered:
        page.table(
            considered,
            "Score: gain in ln of the likelihood, studentised, less what the parameters are worth. The highest is not "
            "believed if it predicts trials that were left out hardly better than no effect does, or much worse than "
            "another.",
        )
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
