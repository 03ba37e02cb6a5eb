"""Covariance in time of what separates a simulation from a recording, as a state-space model.

Each error is a sum of Ornstein-Uhlenbeck processes, seen by the markers through loadings, and white noise:

    y(t)[m] = sum_k  L[m, k] x_k(t) + w[m] n(t),     cov(x_k(t), x_k(t')) = exp(-|t - t'| / tau_k)

Since each x_k is a Markov process, the innovations of the Kalman filter are the recording times the inverse of the
Cholesky factor of its covariance, in a time that grows with the number of samples and not with its cube (Kalman 1960;
Hartikainen and Sarkka 2010). Times may be uneven, and samples may be lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numba
import numpy as np

ROWS = 20_000  # that are filtered at once, which bounds the memory for a long recording


@dataclass(frozen=True, kw_only=True, eq=False)
class Process:
    """Ornstein-Uhlenbeck processes with one correlation time.

    Attributes:
        time: Correlation time [s].
        loading: Standard deviation with which each of K processes is seen at each marker [A, M, K] m; a process belongs
            to one axis.
    """

    time: float
    loading: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorModel:
    """Errors of one trial: white noise, and processes that last.

    Attributes:
        white: Standard deviation of white noise [A, M] m.
        processes: That are added to it.
    """

    white: np.ndarray
    processes: tuple[Process, ...] = ()

    def whiten(self, time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Innovations of columns over their standard deviation.

        Args:
            time: [T] s, increasing.
            values: Columns [T, M, A, C] m; a sample is lost where the first column is not a number.

        Returns:
            Columns [N, C] of unit covariance, and ln of the determinant of the covariance of the N samples.
        """
        parts, ln_det = [], 0.0
        for axis in range(values.shape[2]):
            one = Filter(self, axis)
            _, white, ln_part = one.advance(one.start(values.shape[-1]), time, values[:, :, axis])
            parts.append(white)
            ln_det += ln_part
        return np.concatenate(parts), ln_det

    def gram(self, chunks: Iterable[tuple[np.ndarray, np.ndarray]]) -> Gram:
        """Products of columns under the inverse of the covariance, of parts of a recording that follow each other.

        Args:
            chunks: Times [T] s and columns [T, M, A, C] m of each part.
        """
        filters: list[Filter] = []
        states: list[State] = []
        product, ln_det, count = np.zeros((0, 0)), 0.0, 0
        for time, values in chunks:
            if not filters:
                filters = [Filter(self, axis) for axis in range(values.shape[2])]
                states = [one.start(values.shape[-1]) for one in filters]
                product = np.zeros((values.shape[-1],) * 2)
            for axis, one in enumerate(filters):
                states[axis], white, ln_part = one.advance(states[axis], time, values[:, :, axis])
                product += white.T @ white
                ln_det += ln_part
                count += len(white)
        return Gram(product=product, ln_det=ln_det, count=count)

    def dense(self, time: np.ndarray, axis: int) -> np.ndarray:
        """The covariance of all samples along an axis [T M, T M] m2, of marker 0 at all times first; for short ones."""
        lag = np.abs(time[:, None] - time)
        found = np.kron(np.diag(self.white[axis] ** 2), np.eye(len(time)))
        for p in self.processes:
            found += np.kron(p.loading[axis] @ p.loading[axis].T, np.exp(-lag / p.time))
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Gram:
    """What a Gaussian likelihood needs of N samples: products of columns, and a determinant.

    Attributes:
        product: X' C^-1 X of columns X [N, C].
        ln_det: ln det C.
        count: N.
    """

    product: np.ndarray
    ln_det: float
    count: float

    def __add__(self, other: Gram) -> Gram:
        """Of samples whose errors are independent of these."""
        return Gram(
            product=self.product + other.product,
            ln_det=self.ln_det + other.ln_det,
            count=self.count + other.count,
        )


def integrated(gram: Gram, count: int) -> Gram:
    """The same where samples also differ by unknown amounts of the last columns, of unit variance each.

    For C + D D' in place of C (Woodbury; Sylvester), with K = I + D' C^-1 D:

        X' (C + D D')^-1 X = X' C^-1 X - X' C^-1 D K^-1 D' C^-1 X,    ln det (C + D D') = ln det C + ln det K.

    Args:
        gram: Of columns [X, D].
        count: Number of columns of D.
    """
    if not count:
        return gram
    A, B, G = gram.product[:-count, :-count], gram.product[:-count, -count:], gram.product[-count:, -count:]
    root = np.linalg.cholesky(np.eye(count) + G)
    taken = np.linalg.solve(root, B.T)
    ln_det = gram.ln_det + 2 * float(np.log(np.diag(root)).sum())
    return Gram(product=A - taken.T @ taken, ln_det=ln_det, count=gram.count)


def tempered(gram: Gram, kappa: float) -> Gram:
    """Of a likelihood to the power of 1 / kappa."""
    return Gram(product=gram.product / kappa, ln_det=gram.ln_det / kappa, count=gram.count / kappa)


def total(grams: Sequence[Gram]) -> Gram:
    """Of independent trials."""
    first, *rest = grams
    for gram in rest:
        first = first + gram
    return first


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """What a filter expects after the samples so far.

    Attributes:
        time: Of the last of them [s]; minus infinity before the first.
        mean: Of the processes, column by column [K, C].
        covariance: Of the processes [K, K].
    """

    time: float
    mean: np.ndarray
    covariance: np.ndarray


class Filter:
    """A Kalman filter of many columns along one axis.

    Args:
        model: Of the errors.
        axis: Number of the recorded axis.
    """

    def __init__(self, model: ErrorModel, axis: int) -> None:
        rates = [np.full(p.loading.shape[2], 1 / p.time) for p in model.processes]
        loadings = [p.loading[axis] for p in model.processes]
        loading = np.concatenate([np.zeros((len(model.white[axis]), 0)), *loadings], 1)
        # A process that no marker sees would only cost time.
        seen = loading.any(0)
        self.rate = np.concatenate([np.zeros(0), *rates])[seen]
        self.loading = np.ascontiguousarray(loading[:, seen])
        self.variance = model.white[axis] ** 2

    def start(self, columns: int) -> State:
        """Before the first sample: each process with the variance that it has at all times."""
        return State(time=-math.inf, mean=np.zeros((len(self.rate), columns)), covariance=np.eye(len(self.rate)))

    def advance(self, state: State, time: np.ndarray, values: np.ndarray) -> tuple[State, np.ndarray, float]:
        """State, innovations over their standard deviation [N, C], and the ln of the product of their variances.

        Args:
            state: After the samples so far.
            time: Of the next samples [T] s.
            values: Columns [T, M, C].
        """
        seen = np.isfinite(values[..., 0])
        found = np.zeros((int(seen.sum()), values.shape[-1]))
        mean, covariance = state.mean.copy(), state.covariance.copy()
        ln_det = _advance(
            np.ascontiguousarray(time, dtype=np.float64),
            np.ascontiguousarray(values, dtype=np.float64),
            seen,
            self.rate,
            self.loading,
            self.variance,
            state.time,
            mean,
            covariance,
            found,
        )
        return State(time=float(time[-1]), mean=mean, covariance=covariance), found, ln_det


@numba.njit(cache=True, nogil=True)
def _advance(time, values, seen, rate, loading, variance, last, mean, covariance, found):
    """Predict to each time and take in its samples one by one; ``mean`` and ``covariance`` are changed."""
    states, columns, markers = len(rate), values.shape[2], values.shape[1]
    keep, gain, left = np.zeros(states), np.zeros(states), np.zeros(columns)
    ln_det, row = 0.0, 0
    for t in range(len(time)):
        lag, last = time[t] - last, time[t]
        for i in range(states):
            keep[i] = math.exp(-lag * rate[i])
        for i in range(states):
            for j in range(states):
                covariance[i, j] *= keep[i] * keep[j]
            covariance[i, i] += 1.0 - keep[i] * keep[i]
            for c in range(columns):
                mean[i, c] *= keep[i]
        for m in range(markers):
            if not seen[t, m]:
                continue
            for c in range(columns):
                left[c] = values[t, m, c]
            for i in range(states):
                gain[i] = 0.0
            for j in range(states):
                seen_by = loading[m, j]
                if seen_by != 0.0:
                    for i in range(states):
                        gain[i] += covariance[i, j] * seen_by
                    for c in range(columns):
                        left[c] -= seen_by * mean[j, c]
            spread = variance[m]
            for i in range(states):
                spread += loading[m, i] * gain[i]
            ln_det += math.log(spread)
            root = math.sqrt(spread)
            for c in range(columns):
                found[row, c] = left[c] / root
            row += 1
            for i in range(states):
                share = gain[i] / spread
                for c in range(columns):
                    mean[i, c] += share * left[c]
                for j in range(states):
                    covariance[i, j] -= share * gain[j]
    return ln_det
