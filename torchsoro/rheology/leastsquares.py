"""Fit of a Prony series with non-negative moduli by least squares of relative residuals, with profile likelihoods."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares, nnls

_PATIENCE = 4  # terms added without a lower BIC before the search ends
_FINE = 12  # relaxation times per decade of a grid that approximates a continuous spectrum


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Relative residuals of a Prony series: columns(tau) @ moduli + constant * equilibrium - target.

    Attributes:
        columns: Maps relaxation times [M] s to columns [n, M] 1/Pa and their derivatives with respect to ln(tau).
        constant: Column [n] 1/Pa of the equilibrium modulus, or several columns [n, c], placed before those of the
            terms; None without.
        target: Target values [n]: ones minus the relative contribution of a fixed equilibrium modulus.
        window: Shortest and longest relaxation time [s].
        curves: Number of concatenated curves of equal length in the residuals.
    """

    columns: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    constant: np.ndarray | None
    target: np.ndarray
    window: tuple[float, float]
    curves: int

    @property
    def first(self) -> int:
        """Number of columns that precede those of the terms."""
        return 0 if self.constant is None else self.constant[0].size

    def matrix(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Design matrix [n, first + M], and derivatives of the columns of the terms by ln(tau) [n, M]."""
        value, slope = self.columns(times)
        return (value if self.constant is None else np.column_stack([self.constant, value])), slope

    def grid(self, count: int) -> np.ndarray:
        """Relaxation times, logarithmically spaced over the window [count] s; its geometric mean for one."""
        low, high = np.log(self.window)
        return np.exp(np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """Least-squares fit with a given number of terms.

    Attributes:
        times: Relaxation times [M] s, ascending.
        values: Equilibrium modulus, if fitted, then moduli [first + M] Pa.
        error: Sum of the squared residuals.
        parameters: Effective number of parameters.
        weight: Weight of the second-difference penalty.
        bic: Bayesian information criterion, n ln(error / n) + parameters ln(n).
    """

    times: np.ndarray
    values: np.ndarray
    error: float
    parameters: float
    weight: float
    bic: float


def _found(problem: Problem, times: np.ndarray, values: np.ndarray, parameters: float, weight: float = 0.0) -> Found:
    error = float(((problem.matrix(times)[0] @ values - problem.target) ** 2).sum())
    n = len(problem.target)
    bic = n * math.log(max(error, 1e-20 * n) / n) + parameters * math.log(n)  # lower bound for noiseless data
    return Found(times=times, values=values, error=error, parameters=parameters, weight=weight, bic=bic)


def solve(matrix: np.ndarray, target: np.ndarray, hold: tuple[int, float] | None = None) -> np.ndarray:
    """Non-negative least squares; ``hold`` is the column and value of an unknown that is fixed."""
    if hold is not None:
        column, value = hold
        rest = solve(np.delete(matrix, column, axis=1), target - value * matrix[:, column])
        return np.insert(rest, column, value)
    norm = np.linalg.norm(matrix, axis=0)
    norm[norm == 0] = 1
    return nnls(matrix / norm, target, maxiter=100 * matrix.shape[1])[0] / norm if matrix.shape[1] else np.zeros(0)


def free(problem: Problem, elements: int | None) -> list[Found]:
    """Fits with optimised relaxation times for 1, 2, ... ``elements`` terms; if None, until the BIC stops falling.

    Each number of terms is started from the previous fit with one more relaxation time at the steepest descent of the
    error, and from logarithmically spaced times; the fit of the smaller error is retained.
    """
    fine = problem.grid(_fine(problem))
    columns = problem.columns(fine)[0]
    directions = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    found: list[Found] = []
    times = np.zeros(0)
    most = (len(problem.target) - problem.first - 1) // 2
    for count in range(1, (elements or most) + 1):
        matrix = problem.matrix(times)[0]
        rest = matrix @ solve(matrix, problem.target) - problem.target
        starts = (np.append(times, fine[np.argmin(rest @ directions)]), problem.grid(count + 2)[1:-1])
        found.append(min((_optimised(problem, start) for start in starts), key=lambda f: f.error))
        times = found[-1].times
        best = min(range(count), key=lambda i: found[i].bic)
        if elements is None and best < count - _PATIENCE:
            break
    return found


def _optimised(
    problem: Problem,
    start: np.ndarray,
    hold: tuple[int, float] | None = None,
    *,
    limits: tuple[np.ndarray, np.ndarray] | None = None,
    tolerance: float = 1e-9,
) -> Found:
    """Optimise relaxation times by variable projection of the moduli (Golub and Pereyra 1973, Kaufman 1975).

    ``limits`` are lower and upper bounds of ln(tau) [M]; the problem's window if None.
    """
    low, high = limits or np.log(problem.window)
    last: dict[bytes, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def state(log_times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        key = log_times.tobytes()
        if key not in last:
            last.clear()
            matrix, slope = problem.matrix(np.exp(log_times))
            last[key] = matrix, slope, solve(matrix, problem.target, hold)
        return last[key]

    def residual(log_times: np.ndarray) -> np.ndarray:
        matrix, _, values = state(log_times)
        return matrix @ values - problem.target

    def jacobian(log_times: np.ndarray) -> np.ndarray:
        matrix, slope, values = state(log_times)
        active = values > 0
        if hold is not None:
            active[hold[0]] = False
        basis = np.linalg.qr(matrix[:, active])[0]
        change = slope * values[problem.first :]
        return change - basis @ (basis.T @ change)

    inside = np.clip(np.log(start), low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    search: dict[str, Any] = {"bounds": (low, high), "ftol": tolerance, "xtol": tolerance, "gtol": 1e-12}
    best = least_squares(residual, inside, jac=jacobian, max_nfev=200, **search)  # pyright: ignore[reportArgumentType]
    order = np.argsort(best.x) if hold is None else np.arange(len(start))  # the fixed column is an index: no sorting
    values = state(best.x)[2]
    values = np.concatenate([values[: problem.first], values[problem.first :][order]])
    return _found(problem, np.exp(best.x[order]), values, 2 * len(start) + problem.first)


def fixed(problem: Problem, times: np.ndarray, weights: tuple[float, ...]) -> list[Found]:
    """Moduli at given relaxation times [M] s for each penalty weight (the first weight only for M < 3)."""
    matrix = problem.matrix(times)[0]
    found = []
    for weight in weights if len(times) > 2 else weights[:1]:
        below = weight * roughness(problem, times)
        values = solve(np.vstack([matrix, below]), np.concatenate([problem.target, np.zeros(len(below))]))
        used = values > 0
        normal = matrix[:, used].T @ matrix[:, used]
        both = normal + below[:, used].T @ below[:, used]
        parameters = float(np.trace(np.linalg.lstsq(both, normal, rcond=None)[0])) if used.any() else 0.0
        found.append(_found(problem, times, values, parameters, weight))
    return found


def roughness(problem: Problem, times: np.ndarray) -> np.ndarray:
    """Second-difference matrix of the moduli, columns scaled by their norms [max(M - 2, 0), first + M]."""
    count = len(times)
    rows = np.diff(np.eye(count), 2, axis=0) if count > 2 else np.zeros((0, count))
    rows = rows * np.linalg.norm(problem.columns(times)[0], axis=0)
    return np.column_stack([np.zeros((len(rows), problem.first)), rows])


def _fine(problem: Problem) -> int:
    return max(2, math.ceil(_FINE * math.log10(problem.window[1] / problem.window[0])) + 1)


def floor(problem: Problem) -> Found:
    """Least error over all non-negative spectra within the window, on a fine grid of relaxation times.

    The problem is convex: up to the grid spacing this is the lower bound for any number of terms.
    """
    times = problem.grid(_fine(problem))
    return fixed(problem, times, (0.0,))[0]


def inflation(problem: Problem, found: Found) -> float:
    """Variance inflation (1 + r) / (1 - r) for a lag-one correlation r of the residuals; 1 if r is insignificant."""
    rest = problem.matrix(found.times)[0] @ found.values - problem.target
    curves = rest.reshape(problem.curves, -1)
    total = float((curves**2).sum())
    correlation = float((curves[:, 1:] * curves[:, :-1]).sum()) / total if total > 0 else 0.0
    return (1 + correlation) / (1 - correlation) if correlation > 2 / math.sqrt(len(rest)) else 1.0


def profiles(problem: Problem, found: Found, rise: float, *, optimised: bool) -> Iterator[tuple[float, float]]:
    """Profile-likelihood interval of every unknown: both values at which the minimised error has risen by ``rise``.

    At each value of the unknown all other moduli are refitted, and, if ``optimised``, the relaxation times, each
    bounded by the geometric means with its neighbours. Without these bounds terms can exchange roles: the term of fixed
    modulus moves outside the data window, its neighbours replace it, and the interval is that of an unobserved term. A
    bound that is not reached is 0 or inf.
    """
    matrix = problem.matrix(found.times)[0]
    below = found.weight * roughness(problem, found.times)
    rows, target = np.vstack([matrix, below]), np.concatenate([problem.target, np.zeros(len(below))])
    least = float(((rows @ found.values - target) ** 2).sum())
    if rise < 1e-18 * len(target):  # data without noise
        yield from ((float(value), float(value)) for value in found.values)
        return
    middles = np.log(found.times[1:] * found.times[:-1]) / 2
    low, high = np.log(problem.window)
    limits = np.append(low, middles), np.append(middles, high)
    for column, value in enumerate(found.values):
        # With all other unknowns fixed the error rises by ``rise`` at this distance, a lower bound of the half width.
        near = math.sqrt(rise) / max(float(np.linalg.norm(rows[:, column])), 1e-300)
        ends = []
        for step in (-near, near):
            times = found.times  # warm start of the next evaluation

            def excess(at: float, column: int = column) -> float:
                nonlocal times
                if optimised:
                    there = _optimised(problem, times, (column, at), limits=limits, tolerance=1e-5)
                    times, error = there.times, there.error
                else:
                    error = float(((rows @ solve(rows, target, (column, at)) - target) ** 2).sum())
                return math.sqrt(max(error - least, 0.0) / rise) - 1

            ends.append(_end(excess, float(value), step))
        yield ends[0], ends[1]


def _end(excess: Callable[[float], float], value: float, step: float) -> float:
    """Root of ``excess``, about linear and -1 at ``value``: bracketing by doubled steps, then false position."""
    inner, below, outer = value, -1.0, value + step
    while True:
        outer = max(outer, 0.0)
        above = excess(outer)
        if above >= 0:
            break
        if outer == 0 or abs(outer - value) > 1e12 * abs(step):
            return outer if outer == 0 else math.inf
        inner, below, outer = outer, above, outer + 2 * (outer - inner)
    for _ in range(20):
        share = min(max(below / (below - above), 0.1), 0.9)
        middle = inner + share * (outer - inner)
        found = excess(middle)
        if abs(found) < 0.01:
            return middle
        if found < 0:
            inner, below = middle, found
        else:
            outer, above = middle, found
    return outer
