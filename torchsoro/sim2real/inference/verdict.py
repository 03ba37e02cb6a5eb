"""From recordings to a verdict: ends of searches are weighed by evidence, and what follows is told of fits."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.hypotheses.supply_effects import PressureGain
from torchsoro.sim2real.inference import visible
from torchsoro.sim2real.inference.candidates import (
    at_mode,
    data_of,
    inferred,
    near,
    planes_moved,
    weigh,
    weighing_of,
    with_chance_of,
    with_noise_left,
)
from torchsoro.sim2real.inference.conclusion import Conclusion, conclude
from torchsoro.sim2real.inference.evidence import Posterior
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.heldout import Prediction, predictions
from torchsoro.sim2real.inference.isolability import Isolability, isolability
from torchsoro.sim2real.inference.least_squares import told
from torchsoro.sim2real.inference.observed import Data
from torchsoro.sim2real.inference.search import search
from torchsoro.sim2real.inference.starts import unconstrained
from torchsoro.sim2real.inference.weighing import CLOSE, Weighing, adjustment

FOLDS = 4  # trials that are left out, one after the other
NAMED = ("explained", "cannot_distinguish")  # verdicts that name effects
POLISHED = 4  # names that are linearised again where their posterior has its mode
HOPELESS = 40.0  # in ln evidence, behind the best: by more than that (up to 30) it rose in no look seen
ROUNDS = 3  # of that, at most
CLOSELY = (6, 3, 3)  # of rough motions, modes with an effect that are looked at closely, round by round
NOTHING = 2  # modes without an effect beside them
SAME_LOOK = 1e-3  # of a scale: looks whose simulated unknowns all differ by less are one


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """What may be missing, after the recordings.

    Attributes:
        fit: Where it is most probable.
        posterior: Near there.
        probability: Posterior, of its name, calibrated.
        size: Root mean square of the change of the motion by it [m].
        left: Root mean square of the least that it leaves of the recordings beyond noise and the twin's own error [m].
    """

    fit: Fit
    posterior: Posterior
    probability: float
    size: float
    left: float

    @property
    def name(self) -> str:
        """Of its effects, in the order of the alphabet."""
        return self.posterior.near.model.name


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What can be said.

    Attributes:
        kind: "explained", "cannot_distinguish", "nothing_missing", "cannot_tell" or "unknown_physics".
        problem: With the slips of markers that were found.
        null_model: The fit without any effect.
        ranking: What was weighed, most probable first.
        chosen: What explains the difference: one, or several that cannot be told apart.
        conclusion: What that follows from.
        before: Trials as believed, those that were held out last; without those whose simulations break down.
        after: The same trials by the fit that is shown.
        heldout: Of trials that were left out, the error as believed and with the best effect [m]; decides nothing.
    """

    kind: str
    problem: FitProblem
    null_model: Fit
    ranking: tuple[Candidate, ...]
    chosen: tuple[Candidate, ...] = ()
    conclusion: Conclusion
    before: tuple[Prediction, ...] = ()
    after: tuple[Prediction, ...] = ()
    heldout: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def best(self) -> Fit:
        """The fit that is shown: of what is most probable if effects are named, else that without an effect."""
        return self.chosen[0].fit if self.chosen else self.null_model

    @property
    def posterior(self) -> Posterior:
        """That of the same."""
        return self.chosen[0].posterior if self.chosen else self.conclusion.nothing


def judge(
    problem: FitProblem,
    effects: Sequence[Hypothesis] | None = None,
    *,
    tells: Isolability | None = None,
    heldout: Sequence[Trial] = (),
    budget: float = 600.0,
    report: Callable[[str], None] = print,
) -> Verdict:
    """Find what was left out.

    Args:
        problem: Recordings and twin.
        effects: What is thought of; the library if None.
        tells: Which of them the experiment can tell; found if None.
        heldout: Trials that are only predicted, once all is decided. Without any, of three or more each of the first
            four is predicted from the others.
        budget: Time that this may take on two cores, about [s]; sets how many searches are begun.
        report: Called with a line for each effect.
    """
    effects = problem.thought_of(library() if effects is None else effects)
    problem, null_model, ends = search(problem, effects, budget, report)
    return weighed(problem, effects, null_model, ends, tells=tells, heldout=heldout, report=report)


def weighed(
    problem: FitProblem,
    effects: Sequence[Hypothesis],
    null_model: Fit,
    ends: Sequence[Fit],
    *,
    tells: Isolability | None = None,
    heldout: Sequence[Trial] = (),
    report: Callable[[str], None] = print,
) -> Verdict:
    """The verdict on ends of searches.

    Args:
        problem: That was fitted.
        effects: That were thought of.
        null_model: The fit without an effect.
        ends: Fits of effects, and others without one.
        tells: See :func:`judge`.
        heldout: The same.
        report: The same.
    """
    names = len({e.name for e in effects})
    believed = dataclasses.replace(
        null_model, point=np.clip(null_model.point, -1, 1), errors=np.zeros_like(null_model.errors)
    )
    strained = [believed] if np.abs(null_model.point).max(initial=0.0) > 1 else []
    simpler = [*_as_beliefs(problem, null_model, ends), *_as_simpler(problem, effects, ends)]
    begun = [null_model, *strained, *simpler, *_as_pairs(problem, effects, ends), *ends]
    models = near(problem, begun)
    problem = with_noise_left(problem, models)
    data, known = data_of(problem), inferred(problem, begun, models)
    weighing = weighing_of(problem, [p for _, p in known], names)
    best = weighing.leading
    leading = at_mode(problem, _fit_of(known, best), told(data, best))
    moved = {}
    if problem.touches and not problem.rough and best.near.model.effects:
        moved = planes_moved(problem, leading)
        problem = with_chance_of(problem, moved)
    for k in range(ROUNDS):
        # Among many valleys, or once it is seen to scatter, evidence changes by as much as it is divided by.
        behind = HOPELESS * (weighing.kappa if problem.many_valleys or weighing.scattered else 1.0)
        far = _looked_at_again(weighing, behind, k) if problem.rough else _far(weighing, behind)
        if not far:
            break
        ends = [leading if p is best else at_mode(problem, _fit_of(known, p), told(data, p)) for p in far]
        again = weigh(problem, ends, closely=True, moved=moved)
        if not problem.rough and (back := _halfway(known, far, ends, again)):
            again += weigh(problem, back)
        sound = {p.near.model.name for _, p in again}
        if not problem.rough:  # what breaks down there, too, stays as it was
            known = [one for one in known if one[1] not in far or one[1].near.model.name not in sound]
        elif k == 0:  # evidence with errors that were told otherwise is no measure
            known = [one for one in known if one[1].near.model.name not in sound]
        known += again
        weighing = weighing_of(problem, [p for _, p in known], names)
    tells = tells or isolability(problem, effects)
    while True:
        verdict = _concluded(problem, known, weighing, tells, report)
        folds = _folds(verdict, data, weighing.kappa) if not heldout else ()
        ahead = predictions(problem, verdict.best, heldout, folds)
        if ahead.before or not verdict.chosen:
            return dataclasses.replace(verdict, before=ahead.before, after=ahead.after, heldout=ahead.left_out)
        broken = verdict.chosen[0].name
        report(f"{broken}: breaks down where it is most probable")
        known = [one for one in known if one[1].near.model.name != broken]
        weighing = weighing_of(problem, [p for _, p in known], names)


def _concluded(
    problem: FitProblem,
    known: Sequence[tuple[Fit, Posterior]],
    weighing: Weighing,
    tells: Isolability,
    report: Callable[[str], None],
) -> Verdict:
    """The verdict that follows from what was weighed, without what it predicts."""
    data = weighing.data
    # Where no search has ended with an effect, the responses tell how far the twin's error may pass for one.
    kappa = weighing.kappa if weighing.groups else adjustment(data, weighing.null, tells.changes)
    asked = data, weighing.null, tells.changes, kappa, weighing.names
    weak = visible.too_weak(data, weighing.null, tells, kappa, weighing.names)
    found = conclude(weighing, visible.limit(*asked), visible.remedies(*asked), too_weak=weak)
    ranking = [
        Candidate(
            fit=at_mode(problem, _fit_of(known, c.best), told(data, c.best)),
            posterior=c.best,
            probability=found.calibrated.get(c.name, 0.0),
            size=c.size,
            left=c.left,
        )
        for c in found.candidates
    ]
    ranking.sort(key=lambda c: -c.probability)  # in the order of evidence where they are alike
    by_name = {c.name: c for c in ranking}
    for name, probability in sorted(found.calibrated.items(), key=lambda item: -item[1]):
        report(f"{name}: probability {probability:.3g}" + (f", {tell(by_name[name].fit)}" if name in by_name else ""))
    return Verdict(
        kind=found.kind,
        problem=problem,
        null_model=at_mode(problem, _fit_of(known, found.nothing), told(data, found.nothing)),
        ranking=tuple(ranking),
        chosen=tuple(by_name[name] for name in found.chosen) if found.kind in NAMED else (),
        conclusion=found,
    )


def _as_beliefs(problem: FitProblem, null_model: Fit, ends: Sequence[Fit]) -> list[Fit]:
    """Fits without an effect, where effects are that are a stated number within its tolerance."""
    found = []
    for fit in ends:
        for k, (stated, tolerance) in enumerate(problem.common):
            off = fit.values[0][0] / tolerance if fit.effects else np.inf
            if len(fit.effects) == 1 and isinstance(fit.effects[0], type(stated)) and abs(off) <= 1:
                point = np.where(np.arange(len(problem.common)) == k, off, fit.point[: len(problem.common)])
                found.append(dataclasses.replace(null_model, point=point, errors=fit.errors))
    return found


def _as_pairs(problem: FitProblem, effects: Sequence[Hypothesis], ends: Sequence[Fit]) -> list[Fit]:
    """Ends of searches with a stated number that is not credible, as pairs of the effect and that number as another.

    A search among pairs does not keep them, as they leave the same.
    """
    alone = [fit for fit in ends if len(fit.effects) == 1]
    return [
        dataclasses.replace(fit, effects=both, point=point)
        for fit in alone
        for both, point in unconstrained(problem, effects, fit)
    ]


def _as_simpler(problem: FitProblem, effects: Sequence[Hypothesis], ends: Sequence[Fit]) -> list[Fit]:
    """Where an effect that others extend comes nearest to these, as its own search may have ended elsewhere."""
    found, known = [], len(problem.common)
    for fit in ends:
        if len(fit.effects) == 2:
            found += _alone(problem, fit)
        if len(fit.effects) != 1:
            continue
        for simple in fit.effects[0].simpler(fit.values[0]):
            plain = next((e for e in effects if e.name == simple.name), None)
            if plain is None or not simple.values[0]:
                continue
            own, stated = simple.values / problem.scales((plain,))[known:], fit.point[:known].copy()
            for k, (belief, tolerance) in enumerate(problem.common):
                if isinstance(belief, PressureGain):
                    stated[k] += simple.ln_pressure / tolerance
                if isinstance(plain, type(belief)):  # one number by two names, of which the effect's moves
                    own[0] += stated[k] * tolerance / plain.quantities[0].scale
                    stated[k] = 0.0
            found.append(dataclasses.replace(fit, effects=(plain,), point=np.concatenate([stated, own])))
    return found


def _alone(problem: FitProblem, pair: Fit) -> list[Fit]:
    """Each effect of a pair without the other, where that is hardly there."""
    known = len(problem.common)
    ends = np.cumsum([len(e.quantities) + 3 * e.local for e in pair.effects])
    parts = np.split(pair.point[known:], ends[:-1])
    hardly = [
        all(abs(x) < CLOSE for k, (q, x) in enumerate(zip(e.quantities, own, strict=False)) if not k or q.least >= 0)
        for e, own in zip(pair.effects, parts, strict=True)
    ]
    return [
        dataclasses.replace(pair, effects=(effect,), point=np.concatenate([pair.point[:known], own]))
        for k, (effect, own) in enumerate(zip(pair.effects, parts, strict=True))
        if any(hardly[:k] + hardly[k + 1 :]) and not hardly[k]
    ]


def _far(weighing: Weighing, behind: float) -> list[Posterior]:
    """Of what may still be told, modes that are far from where they were linearised."""
    leading = [modes[0] for modes in weighing.groups.values()][:POLISHED]
    asked = (weighing.null, *weighing.within_reach(leading, behind))
    return [p for p in asked if _moved(weighing.data, p, weighing.kappa)]


def _looked_at_again(weighing: Weighing, behind: float, before: int) -> list[Posterior]:
    """Modes of rough motions that are linearised again after so many rounds.

    Closely, as what leads is to be told apart; once more, to see how far evidence hangs on which node touches when; and
    again where that is what decides.
    """
    if before > 1 and not weighing.scattered:
        return []
    # At first, few effects have been looked at more than once, so that the best look at nothing counts, too.
    nothing = weighing.nulls if before else weighing.valleys
    if not weighing.within_reach(nothing[:1], behind):
        nothing = () if before else nothing[:1]  # what is left without an effect is shown in any case
    asked = [*nothing[:NOTHING], *weighing.within_reach(weighing.modes[: CLOSELY[before]], behind)]
    if weighing.best.near.model.effects and weighing.best not in asked:
        asked.append(weighing.best)  # which says whether sizes decide
    if not before:
        return asked
    # From where the last look leads, as the one in the middle has been followed before; the same again tells nothing.
    latest = [weighing.latest(p) for p in asked]
    return [p for p in latest if _off(weighing.data, p)[p.near.model.simulated].max(initial=0.0) > SAME_LOOK]


def _fit_of(known: Sequence[tuple[Fit, Posterior]], found: Posterior) -> Fit:
    """The fit near which a model was linearised."""
    return next(fit for fit, p in known if p.near is found.near)


def _halfway(
    known: Sequence[tuple[Fit, Posterior]],
    far: Sequence[Posterior],
    ends: Sequence[Fit],
    again: Sequence[tuple[Fit, Posterior]],
) -> list[Fit]:
    """Of modes whose simulation breaks down, the middle between them and where they were linearised."""
    sound = {p.near.model.name for _, p in again}
    lost = [(_fit_of(known, p), end) for p, end in zip(far, ends, strict=True) if p.near.model.name not in sound]
    return [
        dataclasses.replace(end, point=(fit.point + end.point) / 2, errors=(fit.errors + end.errors) / 2)
        for fit, end in lost
    ]


def _moved(data: Data, found: Posterior, kappa: float) -> bool:
    """Whether what is told is more than a standard deviation, worth kappa, from where its model was linearised."""
    return bool((_off(data, found) > np.sqrt(kappa * np.diag(found.mode.covariance))).any())


def _off(data: Data, found: Posterior) -> np.ndarray:
    """How far what is told is from where its model was linearised, by unknown."""
    return np.abs(told(data, found).at - found.near.at)


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


def _folds(verdict: Verdict, data: Data, kappa: float) -> list[Fit]:
    """What is shown, as it would be without one of the first trials, for each; none of fewer than three trials."""
    problem, best = verdict.problem, verdict.best
    if len(problem.trials) < 3:
        return []
    found = []
    for i in range(len(problem.trials[:FOLDS])):
        fit = at_mode(problem, best, told(data, verdict.posterior, kappa, but=i))
        found.append(dataclasses.replace(fit, errors=np.delete(fit.errors, i)))
    return found
