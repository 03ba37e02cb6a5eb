"""From recordings to a verdict: which effect fits best, and whether it predicts trials that were left out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.hypotheses.body_effects import Modulus
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.heldout import predict_all
from torchsoro.sim2real.inference.ranking import BELIEVED, FAINT, Candidate, rank, varied
from torchsoro.sim2real.inference.search import inflate_discrepancy, search, within

FOLDS = 4  # trials that are left out, one after the other


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What decides; from a batch of cases with known answers that was made for this.

    Attributes:
        alarm: Score and gain below which nothing is missing.
        margin: Of the score, within which two effects are not told apart: odds of twenty to one.
        rough: The same as a share of the score where bodies meet planes: there chi-squared has many local minima, and
            in which of them a search ends is chance.
        soft_side_margin: The same between a modulus and a soft side, whose motions differ little.
        covered: Times what noise and numerics explain, as believed, below which nothing is missing: all is within them.
        quiet: The same, without an effect, below which nothing is missing if none is believed.
        some: The same, above which an effect must take away ``part`` of it.
        part: The least share of the chi-squared.
        beyond: As ``quiet``, with the best effect, above which it leaves something.
        share: Of the chi-squared that the best effect takes away, below which what is left is of its own kind.
        lost: Largest error on trials left out, over that without an effect, at which an effect is believed.
        noisy: The same where noise and numerics explain most, or noise most of what is left of the trials left out
            without an effect, and the gain is above ``sure``.
        faint: Square of the error on trials left out without an effect, over that of the noise, below which it is
            mostly noise.
        sure: Such a gain; without anything missing it has never been found.
        worse: Times the error on trials left out of the effect that predicts them best, at which another is.
        near: By how much it may be larger in any case, even than ``lost``, over the error without an effect.
        left: Share of chi-squared that the best effect leaves, above which the form of the model explains the rest.
        equal: Rest that another effect leaves over that of the best, up to which they are then not told apart.
    """

    alarm: float = 40.0
    margin: float = 3.0
    rough: float = 0.45
    soft_side_margin: float = 10.0
    covered: float = 0.8
    quiet: float = 1.7
    some: float = 1.3
    part: float = 0.5
    beyond: float = 2.0
    share: float = 0.9
    lost: float = 0.85
    noisy: float = 0.95
    faint: float = 2.0
    sure: float = 200.0
    worse: float = 1.3
    near: float = 0.02
    left: float = 0.05
    equal: float = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What can be said.

    Attributes:
        kind: "explained", "nothing_missing", "unknown_physics" or "cannot_distinguish".
        problem: With the slips of markers that were found.
        null_model: The fit without any effect.
        ranking: The effects that were fitted, best first.
        chosen: The effects that explain the difference: one, or several that cannot be told apart.
        excess: What is left over what noise and numerics explain, for the best effect: 1 if nothing is left.
        heldout: Of trials that were left out, the error as believed and with the best effect [m].
    """

    kind: str
    problem: FitProblem
    null_model: Fit
    ranking: tuple[Candidate, ...]
    chosen: tuple[Candidate, ...] = field(default=())
    excess: float = 1.0
    heldout: dict[str, tuple[float, float]] = field(default_factory=dict)


def judge(
    problem: FitProblem,
    effects: Sequence[Hypothesis] | None = None,
    *,
    heldout: Sequence[Trial] = (),
    thresholds: Thresholds | None = None,
    budget: float = 600.0,
    report: Callable[[str], None] = print,
) -> Verdict:
    """Find what was left out.

    Args:
        problem: Recordings and twin.
        effects: What is thought of; the library if None.
        heldout: Trials that are only predicted. Without any, each of three or more is predicted from the others.
        thresholds: What decides.
        budget: Time that this may take on two cores, about [s]; sets how many searches are begun.
        report: Called with a line for each effect.
    """
    effects = problem.thought_of(library() if effects is None else effects)
    problem, null_model, best = search(problem, effects, budget, report)
    believed = within(problem, null_model)
    plain = rank(best, null_model, believed, problem.observation.deviations)
    start, plainly = null_model.chi2 / null_model.samples, believed / null_model.samples
    excess = min((c.fit.chi2 for c in plain), default=null_model.chi2) / null_model.samples
    own = problem
    problem, null_model, fits = inflate_discrepancy(problem, null_model, best, report)
    believed = believed if problem is own else within(problem, null_model)
    # What is explained, and what is left, is told by noise and the twin's own error alone.
    explained = {c.fit.name: c.explained for c in plain}
    found = [
        dataclasses.replace(c, explained=explained.get(c.fit.name, 0.0))
        for c in rank(fits, null_model, believed, problem.observation.deviations)
    ]
    found, errors, faint = _predicted(problem, null_model, found, heldout)
    for c in found:
        report(f"{c.fit.name}: {_line(c)}")
    t = thresholds or Thresholds()
    verdict = decide(problem, null_model, found, excess, t, start=start, plainly=plainly, faint=faint)
    shown = verdict.chosen[0].fit.name if verdict.chosen else "nothing"
    return dataclasses.replace(verdict, heldout=errors.get(shown, {}))


def number(value: float, unit: str) -> str:
    """A value with its unit."""
    return f"{value:.3g}" if unit == "1" else f"{value:.3g} {unit}"


def tell(fit: Fit) -> str:
    """Parameters in one line."""
    parts = []
    for effect, values in zip(fit.effects, fit.values, strict=True):
        parts += [f"{q.name} = {number(v, q.unit)}" for q, v in zip(effect.quantities, values, strict=False)]
        if effect.local:
            parts.append("at " + ", ".join(f"{1e3 * v:.1f}" for v in values[len(effect.quantities) :]) + " mm")
    return ", ".join(parts)


def _predicted(
    problem: FitProblem, null_model: Fit, found: list[Candidate], trials: Sequence[Trial]
) -> tuple[list[Candidate], dict[str, dict[str, tuple[float, float]]], float]:
    """The candidates near the best with their error on trials left out; by name, errors as believed and with it.

    Last the square of the error without an effect, over that of the noise.
    """
    near = [c for c in found if c.gain > FAINT and c.score > 0.5 * found[0].score][:3]
    fits = [null_model, *(c.fit for c in near)]
    if trials:
        folds = [(problem, fits, list(trials))]
    elif len(problem.trials) < 3 or not near:
        return found, {}, math.inf
    else:
        folds = []
        for i, trial in enumerate(problem.trials[:FOLDS]):
            where = problem.only([t for t in problem.trials if t is not trial])
            folds.append((where, [problem.without(fit, i) for fit in fits], [trial]))
    squares = np.zeros(len(fits))
    heldout: dict[str, dict[str, tuple[float, float]]] = {fit.name: {} for fit in fits}
    for where, (still, *others), trials in folds:
        # The null model is the setup with modulus and pressure within what is credible.
        mine = [dataclasses.replace(still, point=np.clip(still.point, -BELIEVED, BELIEVED)), *others]
        told = predict_all(where, mine, trials)
        believed = predict_all(where, mine[:1], trials, believed=True)[0]
        if not told[0] or not believed:
            return found, {}, math.inf
        for k, (fit, row) in enumerate(zip(mine, told, strict=True)):
            squares[k] += sum(p.total**2 for p in row) if row else math.inf
            heldout[fit.name] |= {b.trial: (b.total, p.total) for b, p in zip(believed, row, strict=False)}
    ratios = np.sqrt(squares / squares[0])
    ratio_of = {id(c): float(ratio) for c, ratio in zip(near, ratios[1:], strict=True)}
    noise = len(heldout[null_model.name]) * len(problem.experiment.setup.axes) * problem.noise**2
    found = [dataclasses.replace(c, heldout_ratio=ratio_of.get(id(c), math.nan)) for c in found]
    return found, heldout, float(squares[0]) / noise


def _modulus_and_soft_side(one: Fit, other: Fit) -> bool:
    """Whether one is the modulus, and the other how that varies over the body."""
    plain = [any(isinstance(e, Modulus) for e in f.effects) for f in (one, other)]
    uneven = [varied(f) > 0 for f in (one, other)]
    return (plain[0] and uneven[1]) or (plain[1] and uneven[0])


def _line(c: Candidate) -> str:
    """A candidate for the terminal."""
    heldout = "" if math.isnan(c.heldout_ratio) else f"held-out error ratio {c.heldout_ratio:.2f}, "
    return f"chi-squared {c.fit.chi2:.0f}, score {c.score:.1f}, {heldout}{tell(c.fit)}"


def decide(
    problem: FitProblem,
    null_model: Fit,
    found: Sequence[Candidate],
    excess: float,
    t: Thresholds,
    *,
    start: float,
    plainly: float = math.inf,
    faint: float = math.inf,
) -> Verdict:
    """The verdict on a ranking.

    Args:
        problem: That was fitted.
        null_model: Without an effect.
        found: Effects, best first.
        excess: Times what noise and numerics explain that the best leaves.
        t: What decides.
        start: As ``excess``, without an effect.
        plainly: The same, with modulus and pressure as believed.
        faint: Square of the error on trials left out without an effect, over that of the noise.
    """
    believed = [c for c in found if c.gain > t.alarm]
    if not all(math.isnan(c.heldout_ratio) for c in found):
        # Where most of an error is noise, even the truth takes little of it away.
        most = [t.noisy if (start < t.some or faint < t.faint) and c.gain > t.sure else t.lost for c in believed]
        least = min(
            (c.heldout_ratio for c, lost in zip(believed, most, strict=True) if c.heldout_ratio <= lost),
            default=-math.inf,
        )
        believed = [
            c
            for c, lost in zip(believed, most, strict=True)
            if c.heldout_ratio <= max(min(lost, t.worse * least), least + t.near)
        ]
    best = believed[0] if believed else None
    common = {"problem": problem, "null_model": null_model, "ranking": tuple(found), "excess": excess}
    little = best is not None and start > t.some and best.explained < t.part
    if best is None or best.score < t.alarm or little or plainly < t.covered:
        return Verdict(kind="nothing_missing" if start < t.quiet else "unknown_physics", **common)
    if excess > t.beyond and best.explained < t.share:
        return Verdict(kind="unknown_physics", **common)
    margin, others = t.margin, [c for c in believed if c is not best]
    if problem.experiment.setup.planes:
        margin = max(margin, t.rough * best.score)
        # A fit without a trial may end in another dent: that it predicts hardly better than nothing tells little.
        others += [c for c in found if c not in believed and c.gain > t.alarm and c.heldout_ratio > t.lost]
    unexplained = t.equal * (1 - best.explained) if 1 - best.explained > t.left else 0.0

    def indistinct(c: Candidate) -> bool:
        less = max(margin, t.soft_side_margin) if _modulus_and_soft_side(best.fit, c.fit) else margin
        return c.score > best.score - less or 1 - c.explained < unexplained

    close = (best, *filter(indistinct, others))
    kind = "explained" if len(close) == 1 else "cannot_distinguish"
    return Verdict(kind=kind, chosen=close, **common)
