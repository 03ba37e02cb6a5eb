"""Evidence of a model that is linear near its mode, with unknowns within bounds (Laplace's approximation).

For a recording y, a prediction that is h + J (x - x0) near x0, errors of covariance C and priors p(x):

    ln Z = ln p(y | x*) + ln p(x*) + (x* - m)' H (x* - m) / 2 + K/2 ln 2 pi - 1/2 ln det H + ln P(low < x < high),

where x* is the mode within the bounds, H = J' C^-1 J + diag w is minus the second derivative of the log posterior
there, m its mode if there were no bounds, and P the probability of the bounds under N(m, H^-1). It is exact for a
linear prediction with normal priors, one bound included.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr

from torchsoro.sim2real.inference.priors import Prior, bounds
from torchsoro.sim2real.inference.state_space import Gram

NEAR = 8.0  # standard deviations from a mode, beyond which a bound takes nothing away
FLAT = 1e-4  # weight of a uniform prior over the squared inverse of its width, so that H can be inverted
ROUNDS = 30  # of iterated least squares, at most
LN_TWO_PI = math.log(2 * math.pi)


@dataclass(frozen=True, kw_only=True, eq=False)
class Mode:
    """The posterior near one of its modes.

    Attributes:
        at: The mode, within the bounds [K].
        covariance: Of the unknowns, if there were no bounds [K, K].
        ln_evidence: Integral of likelihood times prior near this mode.
        ln_likelihood: At the mode.
    """

    at: np.ndarray
    covariance: np.ndarray
    ln_evidence: float
    ln_likelihood: float


def posterior(gram: Gram, at: np.ndarray, priors: Sequence[Prior]) -> Mode:
    """Mode, covariance and evidence from products of the residual and the derivatives.

    Args:
        gram: Of the columns [r, J], r the residual at ``at``, J the derivatives of the prediction there [N, 1 + K].
        at: Where these were taken [K].
        priors: Of the unknowns.
    """
    priors = tuple(priors)
    low, high = bounds(priors)
    r2, b, A = float(gram.product[0, 0]), gram.product[0, 1:], gram.product[1:, 1:]
    pull = b + A @ at  # J' C^-1 (r + J x0)
    floor = np.array([FLAT / (p.high - p.low) ** 2 if math.isinf(p.scale) else 0.0 for p in priors])
    x = np.clip(at, low, high)
    for _ in range(ROUNDS):
        weight = np.array([p.weight(v) for p, v in zip(priors, x, strict=True)])
        before, x = x, _bounded(A + np.diag(weight + floor), pull, low, high)
        if np.abs(x - before).max(initial=0.0) < 1e-9 * (1 + np.abs(x).max(initial=0.0)):
            break
    weight = np.array([p.weight(v) for p, v in zip(priors, x, strict=True)])
    H = A + np.diag(weight + floor)
    covariance = np.linalg.inv(H)
    free = covariance @ pull
    step = x - at
    ln_likelihood = -0.5 * (r2 - 2 * float(b @ step) + float(step @ A @ step) + gram.ln_det + gram.count * LN_TWO_PI)
    ln_prior = sum(p.ln_density(v) for p, v in zip(priors, x, strict=True))
    off = x - free
    ln_evidence = (
        ln_likelihood
        + ln_prior
        + 0.5 * float(off @ H @ off)
        + 0.5 * (len(x) * LN_TWO_PI - float(np.linalg.slogdet(H)[1]))
        + ln_box(free, covariance, low, high)
    )
    return Mode(at=x, covariance=covariance, ln_evidence=ln_evidence, ln_likelihood=ln_likelihood)


def _bounded(H: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The least of x' H x / 2 - pull' x within bounds."""
    x = np.linalg.solve(H, pull)
    if ((x >= low) & (x <= high)).all():
        return x
    scale = 1 / np.sqrt(np.diag(H))
    root = np.linalg.cholesky(H * np.outer(scale, scale)).T
    found = lsq_linear(root, np.linalg.solve(root.T, pull * scale), bounds=(low / scale, high / scale), tol=1e-12)
    return np.clip(found.x * scale, low, high)


def ln_box(mean: np.ndarray, covariance: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Ln of the probability of a box under a normal distribution.

    One dimension after the other, the rest conditioned on the truncated moments (Mendell and Elston 1974): exact for
    one bounded dimension and for independent ones.

    Args:
        mean: [K].
        covariance: [K, K].
        low: [K].
        high: [K].
    """
    deviation = np.sqrt(np.diag(covariance))
    tight = np.flatnonzero((low > mean - NEAR * deviation) | (high < mean + NEAR * deviation))
    mean, covariance = mean[tight].copy(), covariance[np.ix_(tight, tight)].copy()
    low, high, ln_p = low[tight], high[tight], 0.0
    left = list(range(len(tight)))
    while left:
        each = [_truncated(mean[i], covariance[i, i], low[i], high[i]) for i in left]
        k = int(np.argmin([p for p, _, _ in each]))  # what is cut most first
        i, (ln_part, middle, variance) = left.pop(k), each[k]
        ln_p += ln_part
        share = covariance[:, i] / covariance[i, i]
        mean = mean + share * (middle - mean[i])
        covariance = covariance + np.outer(share, share) * (variance - covariance[i, i])
    return ln_p


def _truncated(mean: float, variance: float, low: float, high: float) -> tuple[float, float, float]:
    """Ln of the mass of a normal distribution within bounds, and mean and variance of what is there."""
    deviation = math.sqrt(variance)
    a, b = (low - mean) / deviation, (high - mean) / deviation
    side = 1.0
    if a > 0:  # by the lower tail, which keeps its digits
        a, b, side = -b, -a, -1.0
    top, bottom = float(log_ndtr(b)), float(log_ndtr(a))
    ln_p = top + (math.log1p(-math.exp(bottom - top)) if bottom > -math.inf else 0.0)
    upper, lower = (math.exp(-0.5 * (z * z + LN_TWO_PI) - ln_p) if math.isfinite(z) else 0.0 for z in (b, a))
    shift = lower - upper
    spread = 1 + (a * lower if lower else 0.0) - (b * upper if upper else 0.0) - shift**2
    return ln_p, mean + side * deviation * shift, variance * min(max(spread, 1e-12), 1.0)
