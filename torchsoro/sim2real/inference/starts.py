"""Where searches begin: probe points by linear responses, and points at which chi-squared itself is simulated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.decision import BELIEVED
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.gauss_newton import Point
from torchsoro.sim2real.inference.likelihood import Request
from torchsoro.sim2real.twin.twin import Twin

FAINT = 4.0  # gain in log-likelihood below which an effect is not worth a fit
STARTS = 3  # searches of each effect, from probe points that differ; and one of each other form of it
EARLY_ABOVE = (
    3.0  # chi-squared over its expectation, above which searches begin with the first part of the trials, or try pairs
)
SCREENED = 4  # points of each effect there, at which chi-squared itself is simulated; of a local one four times as many
PLACES = 16  # within the tolerances of what is stated, from the best of which the null model begins among many valleys
FIRST = 2  # of them

Task = tuple[tuple[Hypothesis, ...], np.ndarray | None]  # effects, and where to begin a search
Look = tuple[float, Hypothesis, np.ndarray]  # chi-squared that an effect leaves, or promises to, at a point


def probe_points(problem: FitProblem, null_model: Fit, effects: Sequence[Hypothesis]) -> list[Look]:
    """What each effect's looks would leave, and where to begin a search; from nothing, and from what is believed."""
    bases = [problem.base(null_model)]
    if null_model.chi2 > EARLY_ABOVE * null_model.samples:
        bases.append(problem.base())
    found = []
    for base in bases:
        for effect, ranked in zip(effects, problem.probe(effects, base), strict=True):
            found += [(chi2, effect, start) for chi2, start in ranked]
    return found


def likely(looks: Sequence[Look], null_model: Fit, most: int) -> list[Task]:
    """Where to begin searches: each effect that promises something at its best look; then other forms, and other looks.

    Looks at one form are others where they differ.
    """
    unit = max(1.0, null_model.chi2 / null_model.samples) * correlation(null_model)
    strained = np.abs(null_model.point).max(initial=0.0) > 1  # so that much is taken up that it should not be
    first: list[Task] = []
    more: list[Task] = []
    known: dict[str, list[tuple[type[Hypothesis], np.ndarray]]] = {}
    for chi2, effect, start in sorted(looks, key=lambda look: look[0]):
        faint = null_model.chi2 - chi2 < 2 * FAINT * unit
        if faint and null_model.chi2 < 2 * null_model.samples and not strained:
            continue
        mine, form = known.setdefault(effect.name, []), type(effect)
        if form in [f for f, _ in mine]:
            if len(mine) >= STARTS:
                continue
            scale = np.where(np.abs(start) > 1, np.abs(start), 1.0)
            if any((np.abs(start - k) / scale).max() <= 0.4 for f, k in mine if f is form):
                continue
        (more if mine else first).append(((effect,), start))
        mine.append((form, start))
    return [*first, *more][:most]


def unconstrained(problem: FitProblem, effects: Sequence[Hypothesis], fit: Fit) -> list[Task]:
    """Starts with a stated number as an effect, where a fit of one effect or none needs it far beyond its tolerance."""
    found: list[Task] = []
    known = len(problem.common)
    for k, (stated, tolerance) in enumerate(problem.common):
        for released in effects:
            if type(released) is not type(stated) or abs(fit.point[k]) <= BELIEVED:
                continue
            if released.name in [e.name for e in fit.effects]:
                continue
            rest = np.where(np.arange(known) == k, 0.0, fit.point[:known])
            own = dict.fromkeys(fit.effects, fit.point[known:])
            own[released] = fit.point[[k]] * tolerance / released.quantities[0].scale
            both = tuple(e for e in effects if e in own)
            found.append((both, np.concatenate([rest, *(own[e] for e in both)])))
    return found


def screened(
    problem: FitProblem, null_model: Fit, effects: Sequence[Hypothesis], base: Point | None = None
) -> list[Look]:
    """Chi-squared of each effect at evenly spread points, where the effect stands in for what is stated, and beside it.

    In turn, modulus and pressure are as stated, and as they explain most by themselves.

    Args:
        problem: Recordings and twin.
        null_model: The fit without an effect.
        effects: Which.
        base: Without an effect, to whose motions is added what points change with larger cells; if None, each point is
            simulated as it is.
    """
    stated = np.stack([np.zeros_like(null_model.point), null_model.point])
    started = []
    for effect in effects:
        points = spread(problem.twin, effect)
        turn = np.arange(len(points)) // len(effect.starts) % 2
        started += [(effect, np.concatenate([stated[k], x])) for k, x in zip(turn, points, strict=True)]
    return looked_at(problem, started, base)


def looked_at(
    problem: FitProblem,
    started: Sequence[tuple[Hypothesis, np.ndarray]],
    base: Point | None = None,
    errors: np.ndarray | None = None,
) -> list[Look]:
    """Chi-squared of effects at points; without those that break down.

    Args:
        problem: Recordings and twin.
        started: Effects and points.
        base: See :func:`screened`.
        errors: Measurement errors; none if None.
    """
    points: dict[Hypothesis, list[np.ndarray]] = {}
    for effect, point in started:
        points.setdefault(effect, []).append(point)
    asked = [((effect,), np.stack(own)) for effect, own in points.items()]
    left = _simulated(problem, asked, np.zeros(len(problem.observation.deviations)) if errors is None else errors, base)
    return [
        (chi2, effects[0], own[k]) for (effects, own), at in zip(asked, left, strict=True) for k, chi2 in at.items()
    ]


def _simulated(
    problem: FitProblem, asked: Sequence[Request], errors: np.ndarray, base: Point | None = None
) -> list[dict[int, float]]:
    """Chi-squared at the points of each request by their number, without those that break down."""
    found = []
    for motions in problem.simulate(asked) if base is None else problem.responses(asked, base, roughly=True):
        sound = map(int, np.flatnonzero(np.all([m.sound for m in motions], axis=0)))
        found.append({k: problem.measure([m.alone(k) for m in motions], errors)[0] for k in sound})
    return found


def spread(twin: Twin, effect: Hypothesis) -> np.ndarray:
    """Evenly spread values of an effect [N, K] in scales.

    Strengths are half to twice those of its starts, components that add up both ways; places are anywhere in the body.

    Args:
        twin: The body.
        effect: Which.
    """
    kinds, starts = len(effect.quantities), np.array(effect.starts)
    low, high = np.array([[q.least, q.most] for q in effect.quantities]).T
    count = SCREENED * (4 if effect.local else 1)
    u = even_points(count, kinds + 3 * effect.local)
    if effect.joint:
        values = 4 * (u[:, :kinds] - 0.5) * starts.max(0)
    else:
        values = starts[np.arange(count) % len(starts)]
        # A second quantity that may be negative, as the logarithm of a time, is a shape and no strength.
        scaled = (low >= 0) | (np.arange(kinds) == 0)
        values = values * np.where(scaled, 2 ** (2 * u[:, :kinds] - 1), 1.0)
    values = np.clip(np.where(low >= 0, np.abs(values), values), low, high)
    if effect.local:
        origin, size = np.array(twin.setup.origin), np.array(twin.setup.size)
        values = np.concatenate([values, 10 * origin / size + 10 * u[:, kinds:]], 1)
    return values[np.sort(np.unique(values, axis=0, return_index=True)[1])]


def even_points(count: int, axes: int) -> np.ndarray:
    """Evenly spread points of the unit cube [N, K], of which none is a corner or the middle."""
    return torch.quasirandom.SobolEngine(axes).draw(count + 2, dtype=torch.float64).numpy()[2:]


def within_tolerances(problem: FitProblem) -> np.ndarray:
    """Evenly spread values of the stated numbers within their tolerances [N, K]; the first is what is stated."""
    even = torch.quasirandom.SobolEngine(len(problem.common)).draw(PLACES, dtype=torch.float64).numpy()
    return 2 * ((even + 0.5) % 1) - 1


def null_starts(problem: FitProblem) -> list[Task]:
    """Where the stated numbers, within their tolerances, leave the least, of evenly spread points."""
    points = within_tolerances(problem)
    (left,) = _simulated(problem, [((), points)], np.zeros(len(problem.observation.deviations)))
    return [((), points[k]) for k in sorted(left, key=lambda k: left[k])[:FIRST]]


def correlation(fit: Fit) -> float:
    """Correlation length of the whitened residual, in samples, from its lag-one autocorrelation."""
    above = below = 0.0
    for r in fit.whitened:
        above += float(r[1:] @ r[:-1])
        below += float(r @ r)
    rho = min(max(above / max(below, 1e-300), 0.0), 0.98)
    return (1 + rho) / (1 - rho)
