"""What can be concluded from probabilities: the smallest set of candidates with most of them.

Probabilities are of what is missing, whether it matters or not, and that of an effect that is too weak to be seen is
told beside that of nothing. In the set, what changes the motion by less than matters goes by its name where nothing is
not credible beside it and trials left out are predicted better with it; else it counts as nothing. So does what the
second of two effects adds to the first. Where something is missing, and the first of the set predicts trials left out
surely worse than nothing does, no name of the set is it.

All this holds if one of the models does. Of names that were most probable in former sealed batches some were wrong, the
more of them the more they left: with the odds WRONG exp(WRONG_BY_LEFT x), x = left / sqrt(noise^2 + error^2 +
(change / 10)^2). Calibrated, so much of a name's probability, up to a half, is that of what is unknown. No verdict
changes by that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from statistics import NormalDist

from torchsoro.sim2real.inference.decision import (
    CREDIBLE,
    MATTERS,
    MISSING,
    UNEXPLAINED,
    VISIBLE,
    WRONG,
    WRONG_BY_LEFT,
)
from torchsoro.sim2real.inference.evidence import Posterior, compared
from torchsoro.sim2real.inference.weighing import NOTHING, UNKNOWN, UNSEEN, Candidate, Weighing, apart


@dataclass(frozen=True, kw_only=True, eq=False)
class Conclusion:
    """What can be said.

    Attributes:
        kind: "explained", "cannot_distinguish", "nothing_missing", "cannot_tell" or "unknown_physics".
        chosen: Names in the credible set.
        credible: That set, most probable first, with what is no effect.
        probabilities: Posterior, of nothing, of what is too weak to be seen, of what is unknown, and of each name,
            whether it matters or not.
        calibrated: The same, with the doubt in names that former batches leave.
        candidates: Effects and pairs, most probable first.
        nothing: The model without an effect.
        left: What that one leaves of the recordings, its beliefs within tolerances, see :func:`remainder` [m].
        kappa: To the power of whose inverse the likelihood was taken.
        limit: Change of the motion that would have been seen [m].
        matters: Change of the motion that has to be seen [m].
        motion: Root mean square of the motion over markers and axes [m].
        partly: Whether the best candidate leaves a discrepancy that matters.
        predictive: Gain of the best candidate in ln predictive density of trials left out, and its standard error.
        remedies: For "cannot_tell": what would make it tellable.
    """

    kind: str
    chosen: tuple[str, ...]
    credible: tuple[str, ...]
    probabilities: dict[str, float]
    calibrated: dict[str, float]
    candidates: tuple[Candidate, ...]
    nothing: Posterior
    left: float
    kappa: float
    limit: float
    matters: float
    motion: float
    partly: bool = False
    predictive: tuple[float, float] = (0.0, math.inf)
    remedies: dict[str, float] = field(default_factory=dict)


def conclude(
    weighing: Weighing, limit: float, remedies: dict[str, float] | None = None, *, too_weak: float = 0.5
) -> Conclusion:
    """The conclusion from evidence.

    Args:
        weighing: Of all that was fitted.
        limit: Change of the motion that would have been seen [m].
        remedies: By what, and with which factor, the limit would come to what matters.
        too_weak: Share of the prior of what is missing that would not have been seen.
    """
    data, null = weighing.data, weighing.null
    probabilities, candidates = weighing.candidates()
    least = MATTERS * data.size
    matters = max(least, VISIBLE * data.noise)
    names, left = {c.name: c for c in candidates}, max(weighing.unexplained, data.noise)

    def foretells(c: Candidate, d: Candidate) -> bool:
        return compared(data, c.best, d.best, weighing.kappa)[0] > 0

    shares = {NOTHING: probabilities[NOTHING], UNKNOWN: probabilities[UNKNOWN]}
    told, small = dict(shares), []
    for c in candidates:
        counted, called = _meaning(c, names, left, data.noise, least, null.near.numerics.size, foretells)
        shares[counted] = shares.get(counted, 0.0) + c.probability
        told[called] = told.get(called, 0.0) + c.probability
        if called == NOTHING:
            small.append(c.name)
    told = weighing.beside_nothing(told, {name: names[name].probability for name in small})

    @cache
    def gain(name: str) -> tuple[float, float]:
        if name not in names:
            return 0.0, math.inf
        return compared(data, names[name].best, weighing.bounded, weighing.kappa)

    chosen = _credible(told)
    predictive = gain(chosen[0])
    if NOTHING in chosen or predictive[0] <= 0:
        chosen = _credible(shares)
        predictive = gain(chosen[0])
    if NOTHING not in chosen and predictive[0] < -NormalDist().inv_cdf(CREDIBLE) * predictive[1]:
        told[UNKNOWN] += sum(told.pop(name, 0.0) for name in chosen if name != UNKNOWN)
        chosen = [UNKNOWN]
    # Without an effect that is seen there is none, or it is too weak.
    none = (1 - MISSING) / (1 - MISSING + MISSING * too_weak)
    told |= {NOTHING: none * told[NOTHING], UNSEEN: (1 - none) * told[NOTHING]}
    if chosen[0] == UNKNOWN:
        kind = "unknown_physics"
    elif chosen == [NOTHING]:
        kind = "nothing_missing" if limit <= matters else "cannot_tell"
    elif NOTHING in chosen or predictive[0] <= 0:
        kind = "cannot_tell"
    else:
        kind = "explained" if len(chosen) == 1 else "cannot_distinguish"
    return Conclusion(
        kind=kind,
        chosen=tuple(n for n in chosen if n not in (NOTHING, UNKNOWN)),
        credible=tuple(chosen),
        probabilities=told,
        calibrated=_calibrated(told, names, data.noise),
        candidates=tuple(candidates),
        nothing=null,
        left=left,
        kappa=weighing.kappa,
        limit=limit,
        matters=matters,
        motion=data.size,
        partly=chosen[0] in names and names[chosen[0]].best.matters,
        predictive=predictive,
        remedies=(remedies or {}) if kind == "cannot_tell" else {},
    )


def _doubt(c: Candidate, noise: float) -> float:
    """Probability that a name is wrong that is the most probable, by how often former ones were that left as much."""
    left = c.left / math.hypot(noise, c.best.near.numerics.size, c.size / 10)
    odds = WRONG * math.exp(min(WRONG_BY_LEFT * left, 100.0))
    return min(odds / (1 + odds), 0.5)


def _calibrated(told: dict[str, float], names: dict[str, Candidate], noise: float) -> dict[str, float]:
    """Probabilities in which what a name leaves counts against it."""
    found = dict(told)
    for name in names.keys() & told.keys():
        lost = found[name] * _doubt(names[name], noise)
        found[name] -= lost
        found[UNKNOWN] += lost
    return found


def _credible(probabilities: dict[str, float]) -> list[str]:
    """The smallest set of names with most of the probability, most probable first."""
    chosen: list[str] = []
    for name in sorted(probabilities, key=lambda name: -probabilities[name]):
        chosen.append(name)
        if sum(probabilities[n] for n in chosen) >= CREDIBLE:
            break
    return chosen


def _meaning(
    c: Candidate,
    names: dict[str, Candidate],
    left: float,
    noise: float,
    least: float,
    error: float,
    foretells: Callable[[Candidate, Candidate], bool],
) -> tuple[str, str]:
    """What a candidate counts as, and what its probability is told of.

    What does not matter counts as nothing, also as one of two. Its probability is told all the same, unless the twin
    may err by as much. What leaves much, more than noise and than the twin may err, is not missing where evidence is
    for a discrepancy.

    Args:
        c: The candidate.
        names: All of them.
        left: What is left without an effect [m].
        noise: Its standard deviation [m].
        least: Change of the motion that matters [m].
        error: What the twin may err by without an effect [m].
        foretells: Whether the first of two predicts trials that are left out better than the second.
    """
    own = c.best.near.numerics.size

    def sure(d: Candidate) -> bool:
        return c.probability > CREDIBLE * (c.probability + d.probability)

    # An extension that moves as what it extends, as far as it matters, adds nothing; nor does one that does so as
    # far as the twin tells, unless evidence is for it. But it stands for a stated number that is not credible.
    model = c.best.near.model
    simpler = [names[n] for n in model.simpler if n in names and names[n].credible]
    plain = [d for d in simpler if apart(c.best, d.best) < (least if sure(d) else max(least, own))]
    name = max(plain, key=lambda d: d.ln_evidence).name if plain else c.name
    # What a second effect adds is told as an effect by itself is.
    pair = len(model.effects) > 1
    adds = pair and all(sure(d) and apart(c.best, d.best) > own and foretells(c, d) for d in plain)
    called = c.name if adds else name
    unexplained = c.best.matters and c.left > max(UNEXPLAINED * left, noise, error, own)
    if c.size < max(least, own):
        # An extension that adds nothing to what moves the body by less than the twin may err is no more than that.
        seen = min(c.size, names[called].size) >= own
        return NOTHING, called if seen and not unexplained else NOTHING
    if unexplained:
        return UNKNOWN, UNKNOWN
    if c.left > max(c.size, own):
        # It moves less than what it leaves: not it is missing, but what else there is, if that is seen.
        return (UNKNOWN, UNKNOWN) if left > noise else (NOTHING, called)
    return name, called
