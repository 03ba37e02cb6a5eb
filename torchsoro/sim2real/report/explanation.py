"""An explanation: what was found, and as the content of ``explanation.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm, truncnorm

from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.force_map import ForceMap
from torchsoro.sim2real.inference.heldout import Prediction
from torchsoro.sim2real.inference.isolability import Isolability
from torchsoro.sim2real.inference.likelihood import STATED
from torchsoro.sim2real.inference.next_experiment import Proposal
from torchsoro.sim2real.inference.phases import Mismatch
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inference.verdict import Verdict
from torchsoro.sim2real.report.body import BodyMotion
from torchsoro.sim2real.report.improvement import Improvement, Worst
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.version import VERSION

LEVEL = 0.9  # probability that an interval is to hold the truth
# Standard deviation of a place by the form of the model, over the body's size; as Hypothesis.model_form_deviation of a
# parameter.
PLACE_DEVIATION = 0.07


@dataclass(frozen=True, kw_only=True, eq=False)
class Explanation:
    """All that was found out about an experiment.

    Attributes:
        problem: Recordings and twin.
        discretization: The twin's own error.
        verdict: What can be said.
        before: Predictions of all trials by the setup as stated, those that were fitted first.
        after: The same with the best effect, or by the null model where no effect is chosen.
        heldout: Names of the trials that were only predicted.
        seconds: Wall time of the explanation.
        drawn: Of each trial, what the setup as stated would have recorded by the clock of ``after`` [T, M, A] m; the
            recordings of ``before`` if empty.
        isolability: Which effects the experiment can detect and tell apart, if that was asked.
        following: Trials that could be recorded next, best first, where effects are not told apart.
        mismatches: Of each trial, where and when the recording leaves the simulation.
        forces: That would explain the difference where no effect does.
        hints: What is likely to be a mistake in the data, a line each.
        worst: Where and when a recording is the furthest from what was believed.
        body: The body in that trial.
    """

    problem: FitProblem
    discretization: DiscretizationError
    verdict: Verdict
    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]
    heldout: tuple[str, ...]
    seconds: float
    drawn: tuple[np.ndarray, ...] = ()
    isolability: Isolability | None = None
    following: tuple[Proposal, ...] = ()
    mismatches: tuple[Mismatch, ...] = ()
    forces: ForceMap | None = None
    hints: tuple[str, ...] = ()
    worst: Worst | None = None
    body: BodyMotion | None = None

    @property
    def best(self) -> Fit:
        """The fit that is shown: of the best effect, or the null model."""
        return self.verdict.best

    @property
    def own_error(self) -> float:
        """Root mean square over markers and axes of the simulation's error that its correction leaves [m]."""
        return float(np.sqrt((self.verdict.posterior.near.numerics.amplitude**2).mean()))

    @property
    def improvement(self) -> Improvement | None:
        """On trials that were left out, or where there is none on those of the fit; None without any."""
        fitted = {b.trial: (b.total, a.total) for b, a in zip(self.before, self.after, strict=True)}
        trials = self.verdict.heldout or fitted
        if not trials:
            return None
        axes = len(self.problem.experiment.setup.axes)
        floor = math.sqrt(axes) * math.hypot(self.problem.noise, self.own_error)
        return Improvement(trials=trials, heldout=bool(self.verdict.heldout), floor=floor)


def effect_rows(fit: Fit, weight: float, problem: FitProblem) -> list[dict[str, Any]]:
    """The effects of a fit, as in explanation.json.

    Intervals come from the covariance of the fit, widened by the model-form standard deviation, through the slopes of
    the reported quantities. Of a quantity that is the exponential of an unknown the interval is symmetric in its
    logarithm; any other holds the middle 90 % of a normal distribution, or of its part that is
    possible. That of a place does not reach beyond the body.

    Args:
        fit: Of one effect or several.
        weight: Posterior probability, 0 to 1.
        problem: That was fitted.
    """
    wide, rows = float(norm.ppf((1 + LEVEL) / 2)), []
    origin, size = (np.array(v) for v in (problem.twin.setup.origin, problem.twin.setup.size))
    # What is relative to the modulus is to that which was found.
    found = sum(float(v[0]) for e, v in zip(fit.effects, fit.values, strict=True) if isinstance(e, Modulus))
    stiffer = math.exp(fit.ln_factors.get(STATED[Modulus], 0.0) + found)
    for effect, values, covariance in zip(fit.effects, fit.values, fit.covariances, strict=True):
        count = len(effect.quantities)
        scenario = next(s for s in problem.scenarios if effect.applies(s, problem.twin))
        scenario = scenario.replace(youngs_modulus=stiffer * scenario.youngs_modulus)
        logarithm = np.array([q.unit.startswith("ln ") for q in effect.quantities])
        own = np.where(logarithm, 1.0, values[:count])
        whole = covariance[:count, :count] + np.diag((effect.model_form_deviation * own) ** 2)
        steps = 1e-4 * np.array([q.scale for q in effect.quantities])
        reported = effect.reported(values[:count], scenario, problem.twin)
        beside = values[:count] + np.diag(steps)
        ahead = [effect.reported(row, scenario, problem.twin) for row in beside]
        parameters = {}
        for name, (value, unit) in reported.items():
            slope = np.array([(a[name][0] - value) / step for a, step in zip(ahead, steps, strict=True)])
            deviation = math.sqrt(max(float(slope @ whole @ slope), 0.0))
            if name in effect.ratios and value > 0:
                ratio = math.exp(min(wide * deviation / value, 50.0))
                low, high = value / ratio, value * ratio
            else:
                low, high = _possible(value, deviation, _limits(effect, name, scenario, problem.twin))
            parameters[name] = {"value": value, "low": low, "high": high, "unit": unit}
        place = effect.place(values, problem.twin)
        within = wide * np.sqrt(np.diag(covariance)[count:] + (PLACE_DEVIATION * size[: 3 * effect.local]) ** 2)
        if effect.local and place is not None:  # no farther than to the other end of the body
            within = np.minimum(within, np.maximum(place - origin, origin + size - place))
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


def _limits(effect: Hypothesis, name: str, scenario: Scenario, twin: Twin) -> tuple[float, float]:
    """Between which a reported quantity can be."""
    ranges = {q.name: (q.least * q.scale, q.most * q.scale) for q in effect.quantities}
    if len(ranges) == 1:  # of which what is reported is a monotone function
        ((low, high),) = ranges.values()
        one, other = (effect.reported(np.array([end]), scenario, twin)[name][0] for end in (low, high))
        return min(one, other), max(one, other)
    low, high = ranges.get(name, (-math.inf, math.inf))
    return max(low, 0.0) if name in effect.nonnegative else low, min(high, 1.0) if name == "fraction" else high


def _possible(value: float, deviation: float, limits: tuple[float, float]) -> tuple[float, float]:
    """The middle 90 % of a normal distribution, of its part within limits where it reaches beyond them."""
    wide = float(norm.ppf((1 + LEVEL) / 2)) * deviation
    if limits[0] <= value - wide and value + wide <= limits[1]:
        return value - wide, value + wide
    least, most = ((limit - value) / deviation for limit in limits)
    low, high = truncnorm.ppf([(1 - LEVEL) / 2, (1 + LEVEL) / 2], least, most)
    if low >= 0:  # the value is so near to a limit that the interval begins there
        low, high = least, truncnorm.ppf(LEVEL, least, most)
    elif high <= 0:
        low, high = truncnorm.ppf(1 - LEVEL, least, most), most
    return max(value + deviation * float(low), limits[0]), min(value + deviation * float(high), limits[1])


def as_json(e: Explanation, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The content of explanation.json."""
    v, problem, c = e.verdict, e.problem, e.verdict.conclusion
    names = [m.name for m in problem.experiment.setup.markers]

    def errors(predictions: Sequence[Prediction]) -> dict[str, Any]:
        return {p.trial: {"all": p.total, **dict(zip(names, map(float, p.error), strict=True))} for p in predictions}

    return {
        "verdict": v.kind,
        "effects": effect_rows(v.chosen[0].fit, v.chosen[0].probability, problem) if v.chosen else [],
        "set": list(c.chosen),
        "partly": c.partly,
        "probabilities": c.calibrated,
        "ranking": [
            {
                "name": x.name,
                "probability": x.probability,
                "ln_evidence": x.posterior.ln_evidence,
                "change_m": x.size,
                "unexplained_m": x.left,
                "unknowns": x.fit.unknowns,
                "effects": effect_rows(x.fit, x.probability, problem),
            }
            for x in v.ranking
        ],
        "visible": {
            "limit_m": c.limit if math.isfinite(c.limit) else None,
            "matters_m": c.matters,
            "remedies": c.remedies,
        },
        "predictive": {
            "gain": c.predictive[0],
            "standard_error": c.predictive[1] if math.isfinite(c.predictive[1]) else None,
        },
        "noise": {
            "standard_deviation_m": problem.noise,
            "lasting_share": problem.lasting,
            "simulation_m": e.own_error,
            "evidence_divided_by": c.kappa,
            "motion_m": c.motion,
            "edges_m": list(e.discretization.edges),
            "cells_through_thinnest_wall": list(e.discretization.walls),
        },
        "nuisance": {
            **e.best.ln_factors,
            **dict(zip(problem.observation.names, map(float, e.best.errors), strict=True)),
        },
        "error_before": errors(e.before),
        "error_after": errors(e.after),
        "improvement": None if e.improvement is None else _improved(e.improvement),
        "worst": None if e.worst is None else _apart(e.worst, e),
        "mismatch": {m.trial: _parted(m) for m in e.mismatches},
        "force_map": None if e.forces is None else _needed(e.forces),
        "heldout": [{"trial": name, "before": b, "after": a} for name, (b, a) in v.heldout.items()],
        "isolability": None if e.isolability is None else e.isolability.as_json(),
        "hints": list(e.hints),
        "next": [{"record": p.words, "alike": p.cosine, "distance": p.distance} for p in e.following],
        "cost": {"simulations": problem.tally.simulations, "seconds": e.seconds},
        "version": VERSION,
        "settings": dict(settings),
    }


def _improved(found: Improvement) -> dict[str, Any]:
    """The numbers of the first screen, as in explanation.json."""
    return {
        "heldout": found.heldout,
        "trials": list(found.trials),
        "believed_m": found.believed,
        "explained_m": found.explained,
        "floor_m": found.floor,
    }


def _apart(worst: Worst, e: Explanation) -> dict[str, Any]:
    """Where and when a recording is the furthest from what was believed, as in explanation.json."""
    return {
        "trial": e.before[worst.trial].trial,
        "marker": e.problem.experiment.setup.markers[worst.marker].name,
        "time_s": worst.time,
        "believed_m": worst.believed,
        "explained_m": worst.explained,
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
        "misfit_of_each_place": f.chi2s.tolist(),
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
