"""From recordings to a verdict: screen all effects, fit the likely ones, and say what can be said."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchsoro.errors import SimulationDiverged
from torchsoro.sim2real.fit import Fit, Problem
from torchsoro.sim2real.hypothesis import Hypothesis
from torchsoro.sim2real.library import library

KEPT = 5  # effects that are fitted, of those that look best
STARTS = 2  # of each, from looks that differ
MARGIN = 6.0  # of the score, within which two effects are not told apart
ALARM = 12.0  # of the score, below which nothing is missing
ENOUGH = 0.5  # of the misfit that an explanation takes away, at least
BEYOND = 4.0  # times what noise and numerics explain, above which something is left


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """An effect and how well it does.

    Attributes:
        fit: The best of it.
        score: What it gains in ln of the likelihood, studentised, less what its parameters are worth.
        explained: Share of the misfit beyond noise and numerics that it takes away.
    """

    fit: Fit
    score: float
    explained: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What can be said.

    Attributes:
        kind: "explained", "nothing_missing", "unknown_physics" or "cannot_distinguish".
        nothing: The fit without any effect.
        ranking: The effects that were fitted, best first.
        chosen: The effects that explain the difference: one, or several that cannot be told apart.
        excess: What is left over what noise and numerics explain, for the best effect: 1 if nothing is left.
    """

    kind: str
    nothing: Fit
    ranking: tuple[Candidate, ...]
    chosen: tuple[Candidate, ...] = field(default=())
    excess: float = 1.0


def judge(
    problem: Problem, effects: Sequence[Hypothesis] | None = None, *, report: Callable[[str], None] = print
) -> Verdict:
    """Find what was left out.

    Args:
        problem: Recordings and twin.
        effects: What is thought of; the library if None.
        report: Called with a line for each effect.
    """
    effects = [
        effect
        for effect in (library() if effects is None else effects)
        if any(effect.applies(scenario, problem.twin) for scenario in problem.scenarios)
    ]
    nothing = problem.fit(rounds=8)
    report(f"nothing: misfit {nothing.misfit:.0f} of {nothing.samples} samples")
    bases = [problem.base()]
    if nothing.misfit < 0.8 * bases[0].misfit:
        bases.append(problem.base(nothing))
    looks: list[tuple[float, Hypothesis, np.ndarray]] = []
    for effect in effects:
        mine: list[tuple[float, np.ndarray]] = []
        for base in bases:
            try:
                mine += problem.look(effect, base)
            except SimulationDiverged as error:
                report(f"{effect.name}: {error}")
        looks += [(misfit, effect, start) for misfit, start in mine]
        if mine:
            report(f"{effect.name}: would leave {min(m for m, _ in mine):.0f}")
    found = []
    for effect, starts in _likely(looks):
        best: Fit | None = None
        for start in starts:
            try:
                fit = problem.fit([effect], start, errors=nothing.errors, rounds=20)
            except SimulationDiverged as error:
                report(f"{effect.name}: {error}")
                continue
            best = fit if best is None or fit.misfit < best.misfit else best
        if best is not None:
            found.append(rate(best, nothing))
            report(f"{effect.name}: misfit {best.misfit:.0f}, {tell(best)}")
    found.sort(key=lambda c: -c.score)
    return decide(nothing, found)


def _likely(
    looks: Sequence[tuple[float, Hypothesis, np.ndarray]],
) -> list[tuple[Hypothesis, list[np.ndarray]]]:
    """The effects that look best, and where to begin: at the best look, and at the best one elsewhere or otherwise."""
    likely: dict[str, tuple[Hypothesis, list[np.ndarray]]] = {}
    for _, effect, start in sorted(looks, key=lambda look: look[0]):
        if effect.name not in likely and len(likely) < KEPT:
            likely[effect.name] = (effect, [start])
        elif effect.name in likely and len(likely[effect.name][1]) < STARTS:
            scale = np.where(np.abs(start) > 1, np.abs(start), 1.0)
            known = likely[effect.name][1]
            if all((np.abs(start - k) / scale).max() > 0.4 for k in known):
                known.append(start)
    return list(likely.values())


def tell(fit: Fit) -> str:
    """Parameters in one line."""
    parts = []
    for effect, values in zip(fit.effects, fit.values, strict=True):
        parts += [f"{q.name} = {v:.3g} {q.unit}" for q, v in zip(effect.quantities, values, strict=False)]
        if effect.local:
            parts.append("at " + ", ".join(f"{1e3 * v:.1f}" for v in values[len(effect.quantities) :]) + " mm")
    return ", ".join(parts)


def rate(fit: Fit, nothing: Fit) -> Candidate:
    """Score an effect.

    Residuals of a wrong model are neither white nor of the variance that was thought: the gain in misfit counts in
    units of what is left, and neighbouring samples that are alike count once.
    """
    inflation = correlation(fit)
    count = fit.samples / inflation
    spread = max(1.0, fit.misfit / fit.samples)
    gain = (nothing.misfit - fit.misfit) / (2 * spread * inflation)
    explained = (nothing.misfit - fit.misfit) / max(nothing.misfit - fit.samples, 1.0)
    return Candidate(fit=fit, score=gain - 0.5 * fit.unknowns * math.log(count), explained=min(explained, 1.0))


def correlation(fit: Fit) -> float:
    """How many neighbouring samples of the whitened residual say the same."""
    above = below = 0.0
    for r in fit.whitened:
        above += float(r[1:] @ r[:-1])
        below += float(r @ r)
    rho = min(max(above / max(below, 1e-300), 0.0), 0.98)
    return (1 + rho) / (1 - rho)


def decide(nothing: Fit, found: Sequence[Candidate]) -> Verdict:
    """The verdict on a ranking."""
    best = found[0] if found else None
    excess = nothing.misfit / nothing.samples
    if best is None or best.score < ALARM:
        unseen = best is None or excess < BEYOND
        return Verdict(
            kind="nothing_missing" if unseen else "unknown_physics",
            nothing=nothing,
            ranking=tuple(found),
            excess=excess,
        )
    left = best.fit.misfit / best.fit.samples
    if left > BEYOND and best.explained < 1 - ENOUGH / 2:
        return Verdict(kind="unknown_physics", nothing=nothing, ranking=tuple(found), excess=left)
    close = tuple(c for c in found if c.score > best.score - MARGIN)
    kind = "explained" if len(close) == 1 else "cannot_distinguish"
    return Verdict(kind=kind, nothing=nothing, ranking=tuple(found), chosen=close, excess=left)
