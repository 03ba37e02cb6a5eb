"""Where to begin a search: chi-squared that the linear response of an effect at its probe points promises."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.gauss_newton import Point
from torchsoro.sim2real.inference.likelihood import Likelihood
from torchsoro.sim2real.twin.twin import MarkerTrajectory

EXTRAPOLATED = 8.0  # times a probe point whose directions add up, up to which strength its response is taken as linear
WEAK_REACH = 0.6  # of a probe point's strength, up to which the response at a weaker one is taken as linear
AROUND = 0.5  # of a probe point's strength, by which a start may be weaker or stronger than that


def ranked_starts(
    problem: Likelihood,
    effect: Hypothesis,
    points: list[np.ndarray],
    linear: int,
    weak: float,
    motions: list[MarkerTrajectory],
    base: Point,
) -> list[tuple[float, np.ndarray]]:
    """Starts of searches for one effect, best first.

    Args:
        problem: What chi-squared is of.
        effect: Which.
        points: Its probe points, each with directions [D, K] in scales.
        linear: Number of the first of them, whose response is taken as linear from zero strength on.
        weak: Strength of these, over that of the others.
        motions: Of each trial, at all directions one after the other.
        base: Without the effect.

    Returns:
        Chi-squared that each promises, and the point to begin with, in scales; without those that break down.
    """
    low, high = problem.bounds((effect,))
    count, kinds = len(problem.common), len(effect.quantities)
    held = np.array([isinstance(e, type(effect)) for e, _ in problem.common])
    residual, slope = problem.prior_residual(base.at, held)
    prior = np.concatenate([slope, 1 / problem.observation.deviations])
    known = np.concatenate([np.where(slope > 0, residual / np.where(slope > 0, slope, 1), 0), base.errors])
    sound = np.all([m.sound for m in motions], axis=0)
    beside = problem.residual(motions, base.errors)
    ranked, at = [], 0
    if held.any():
        # The effect is a number of the setup without its prior: its response is known at the base.
        H = np.concatenate([np.concatenate([base.columns, base.J], 1), np.diag(prior)])
        target = np.concatenate([base.r, -prior * known])
        x = np.linalg.lstsq(H, target, rcond=None)[0]
        common, strength = base.at + x[:count], np.zeros(kinds)
        for i in np.flatnonzero(held):
            strength[0] = common[i] * problem.common[i][1] / effect.quantities[0].scale
            common[i] = 0.0
        left = float(((target - H @ x) ** 2).sum())
        ranked.append((left, np.clip(np.concatenate([common, strength]), low, high)))
    for number, directions in enumerate(points):
        n = len(directions)
        mine = range(at, at + n)
        at += n
        if not sound[list(mine)].all():
            continue
        slopes = base.r[:, None] - beside[:, mine]
        if number < linear:
            far = EXTRAPOLATED if effect.joint or effect.local else WEAK_REACH / weak
            begin, reach = base.r, _reach(directions[:, :kinds], low[count:], high[count:], far)
            offset = np.zeros(n)
        else:
            begin, reach, offset = beside[:, mine[0]], (np.array([-AROUND]), np.array([AROUND])), np.ones(1)
        J = np.concatenate([slopes, base.columns, base.J], 1)
        rows = np.concatenate([np.zeros((len(prior), n)), np.diag(prior)], 1)
        free = np.full(len(prior), np.inf)
        H = np.concatenate([J, rows])
        target = np.concatenate([begin, -prior * known])
        # A triangle of a few dozen unknowns stands for thousands of samples.
        scale = np.sqrt((H**2).sum(0)) + 1e-300
        ridge = np.concatenate([H / scale, 1e-4 * np.eye(len(scale))])
        root = np.asarray(np.linalg.qr(ridge, mode="r"))
        inner = np.linalg.solve(root.T, (H / scale).T @ target)
        found = lsq_linear(
            root,
            inner,
            bounds=(np.concatenate([reach[0], -free]) * scale, np.concatenate([reach[1], free]) * scale),
        )
        x = found.x / scale
        chi2 = 2 * float(found.cost) + float(target @ target - inner @ inner)
        strength = (offset + x[:n]) @ directions[:, :kinds]
        if not effect.joint and kinds > 1:
            # Only the first quantity is a strength; the others, as a relaxation time, do not grow with it.
            strength[1:] = directions[0, 1:kinds]
        common = base.at + x[n : n + count]
        for i in np.flatnonzero(held):  # the effect takes over the number that it stands for
            strength[0] += common[i] * problem.common[i][1] / effect.quantities[0].scale
            common[i] = 0.0
        share = np.abs(x[:n]) + 1e-9
        start = np.concatenate([common, strength, share @ directions[:, kinds:] / share.sum()])
        ranked.append((chi2, np.clip(start, low, high)))
    return sorted(ranked, key=lambda start: start[0])


def _reach(directions: np.ndarray, low: np.ndarray, high: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """How far directions may be scaled within bounds, and up to ``far`` times themselves."""
    least, most = [], []
    for d in directions:
        k = int(np.flatnonzero(d)[0])
        ends = sorted((low[k] / d[k], high[k] / d[k]))
        least.append(max(ends[0], -far))
        most.append(min(ends[1], far))
    return np.array(least), np.array(most)
