"""Evidence of a model that is linear near its mode, with unknowns within bounds (Laplace's approximation).

For a recording y, a prediction that is h + J (x - x0) near x0, errors of covariance C and priors p(x):

    ln Z = ln p(y | x*) + ln p(x*) + (x* - m)' H (x* - m) / 2 + K/2 ln 2 pi - 1/2 ln det H + ln P(low < x < high),

where x* is the mode within the bounds, H = J' C^-1 J + diag w is minus the second derivative of the log posterior
there (for Student's t, w is the weight of iterated least squares, which is larger), m its mode if there were no bounds,
and P the probability of the bounds under N(m, H^-1). It is exact for a linear prediction with normal priors, one bound
included.

Far outside of the bounds, P is tiny, and no approximation of it is good enough. Unknowns that the recording presses
against a bound, where ln p falls by g per unit away from it, are integrated from there one by one,

    int_0^inf exp(-g d - S d^2 / 2) dd = sqrt(pi / 2 S) erfcx(g / sqrt(2 S)),

S being the second derivative with the others at their best, and the others with these at their bounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear
from scipy.special import erfcx, roots_legendre

from torchsoro.sim2real.inference.priors import Prior, bounds
from torchsoro.sim2real.inference.state_space import Gram

PRESSED = 3.0  # standard deviations that an unknown would go beyond a bound, above which it is integrated from there
NEAR = 8.0  # standard deviations from a mode, beyond which a bound takes nothing away
FLAT = 1e-4  # weight of a uniform prior over the squared inverse of its width, so that H can be inverted
EDGE = 1e-6  # of a standard deviation, within which an unknown is at its bound
ROUNDS = 30  # of iterated least squares, at most
PATIENT = 10  # times the number of unknowns: changes of the set of those at bounds, at most
SWEEPS = 50  # of expectation propagation, at most
SETTLED = 1e-9  # change of ln P in one, below which it is done
LN_TWO_PI = math.log(2 * math.pi)
NOTHING_LEFT = 40.0  # in ln of a density below its top, where a quadrature ends
NODES, WEIGHTS = roots_legendre(64)  # of that; twelve digits of a whole normal distribution


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
    step = x - at
    ln_likelihood = -0.5 * (r2 - 2 * float(b @ step) + float(step @ A @ step) + gram.ln_det + gram.count * LN_TWO_PI)
    ln_prior = sum(p.ln_density(v) for p, v in zip(priors, x, strict=True))
    return Mode(
        at=x,
        covariance=np.linalg.inv(H),
        ln_evidence=ln_likelihood + ln_prior + _ln_volume(H, pull, x, low, high),
        ln_likelihood=ln_likelihood,
    )


def _ln_volume(H: np.ndarray, pull: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Ln of the integral within bounds of exp of what pull' x - x' H x / 2 is above its value at the mode x there."""
    slope = pull - H @ x
    stiff = np.diag(H)
    pressed = np.where(slope > 0, x >= high, x <= low) & (np.abs(slope) > PRESSED * np.sqrt(stiff))
    free = np.flatnonzero(~pressed)
    inner = H[np.ix_(free, free)]
    covariance = np.linalg.inv(inner)
    mean = x[free] + covariance @ slope[free]
    off = x[free] - mean
    found = 0.5 * float(off @ inner @ off) + 0.5 * (len(free) * LN_TWO_PI - float(np.linalg.slogdet(inner)[1]))
    found += ln_box(mean, covariance, low[free], high[free])
    for k in np.flatnonzero(pressed):
        across = H[k, free]
        bend = math.sqrt(H[k, k] - float(across @ covariance @ across))
        away = abs(slope[k]) / bend / math.sqrt(2)
        found += math.log(float(erfcx(away)) * math.sqrt(0.5 * math.pi) / bend)
    return found


def _bounded(H: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The least of x' H x / 2 - pull' x within bounds."""
    x = np.linalg.solve(H, pull)
    if ((x >= low) & (x <= high)).all():
        return x
    scale = 1 / np.sqrt(np.diag(H))
    root = np.linalg.cholesky(H * np.outer(scale, scale)).T
    wanted = solve_triangular(root.T, pull * scale, lower=True)
    limits = low / scale, high / scale
    found = lsq_linear(root, wanted, bounds=limits, method="bvls", tol=1e-12, max_iter=PATIENT * len(x))
    # Bounds are reached but for the rounding of the scale.
    x = np.where(found.x * scale - low < EDGE * scale, low, found.x * scale)
    return np.where(high - x < EDGE * scale, high, x)


def ln_box(mean: np.ndarray, covariance: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Ln of the probability of a box under a normal distribution, by expectation propagation.

    Each interval is replaced by the Gaussian that makes the same of the distribution under all the others (Cunningham,
    Hennig and Lacoste-Julien 2011): exact for one bounded dimension and for independent ones.

    Args:
        mean: [K].
        covariance: [K, K].
        low: [K].
        high: [K].
    """
    deviation = np.sqrt(np.diag(covariance))
    tight = np.flatnonzero((low > mean - NEAR * deviation) | (high < mean + NEAR * deviation))
    if not len(tight):
        return 0.0
    # In deviations from the mean.
    scale = deviation[tight]
    K = covariance[np.ix_(tight, tight)] / np.outer(scale, scale)
    a, b = ((edge[tight] - mean[tight]) / scale for edge in (low, high))
    if len(tight) == 1:
        return _truncated(0.0, 1.0, a[0], b[0])[0]
    tau, nu = np.zeros(len(tight)), np.zeros(len(tight))
    inverse, ln_det = np.linalg.inv(K), float(np.linalg.slogdet(K)[1])
    found = -math.inf
    for _ in range(SWEEPS):
        unit = 1 / np.sqrt(np.diag(inverse) + tau)
        P = (inverse + np.diag(tau)) * np.outer(unit, unit)
        S = np.linalg.inv(P) * np.outer(unit, unit)
        spread = np.diag(S)
        # Of the cavity: its precision, which bounds of others can only raise, and that times its mean.
        precision = np.maximum(1 / spread - tau, 1.0)
        pull = S @ nu / spread - nu
        cut = [_truncated(p / q, 1 / q, *edges) for p, q, *edges in zip(pull, precision, a, b, strict=True)]
        ln_z, middle, variance = np.array(cut).T
        shift = (pull + nu) ** 2 / (precision + tau) - pull**2 / precision
        ln_factors = ln_z + 0.5 * (np.log1p(tau / precision) - shift)
        before, found = found, float(ln_factors.sum() + 0.5 * (nu @ S @ nu - _ln_det(P, unit) - ln_det))
        if abs(found - before) < SETTLED:
            break
        tau = np.maximum(1 / variance - precision, 0.0)
        nu = middle / variance - pull
    return found


def _ln_det(scaled: np.ndarray, unit: np.ndarray) -> float:
    """Ln of the determinant of a matrix that was scaled on both sides."""
    return float(np.linalg.slogdet(scaled)[1]) - 2 * float(np.log(unit).sum())


def _truncated(mean: float, variance: float, low: float, high: float) -> tuple[float, float, float]:
    """Ln of the mass of a normal distribution within bounds, and mean and variance of what is there.

    By quadrature from where it is most probable as far as there is mass: differences of its integral, and of moments
    from its own mean, lose their digits in narrow intervals and far out.
    """
    deviation = math.sqrt(variance)
    a, b, width = (low - mean) / deviation, (high - mean) / deviation, (high - low) / deviation
    top = max(a, 0.0) if b > 0 else b
    reach = 2 * NOTHING_LEFT / (math.sqrt(top**2 + 2 * NOTHING_LEFT) + abs(top))
    begin = 0.0 if a > 0 else -min(reach, -a if b > 0 else width)
    end = 0.0 if b <= 0 else min(reach, b if a <= 0 else width)
    away = begin + 0.5 * (end - begin) * (NODES + 1)
    mass = WEIGHTS * np.exp(-away * (top + 0.5 * away))
    whole = float(mass.sum())
    middle = float(mass @ away) / whole
    spread = float(mass @ (away - middle) ** 2) / whole
    ln_p = math.log(0.5 * (end - begin) * whole) - 0.5 * (top**2 + LN_TWO_PI)
    return ln_p, mean + deviation * (top + middle), variance * spread
