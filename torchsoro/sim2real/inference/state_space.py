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
EVEN = 1e-7  # of the interval between samples, by which it is the same
SETTLED = 1e-8  # change of gains and variances from sample to sample, below which they are kept


@dataclass(frozen=True, kw_only=True, eq=False)
class Process:
    """Ornstein-Uhlenbeck processes with one correlation time.

    Attributes:
        time: Correlation time [s].
        loading: Standard deviation with which each of K processes is seen at each marker [A, M, K] m; a process belongs
            to one axis.
        scale: Of the loading.
    """

    time: float
    loading: np.ndarray
    scale: float = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorModel:
    """Errors of one trial: white noise, and processes that last.

    Attributes:
        white: Standard deviation of white noise [A, M] m.
        processes: That are added to it.
    """

    white: np.ndarray
    processes: tuple[Process, ...] = ()

    def gram(self, chunks: Iterable[tuple[np.ndarray, np.ndarray]]) -> Gram:
        """Products of columns under the inverse of the covariance, of parts of a recording that follow each other.

        Args:
            chunks: Times [T] s, increasing, and columns [T, M, A, C] m of each part; a sample is lost where the first
                column is not a number.
        """
        axes, _ = self.white.shape
        rate = np.concatenate([np.zeros(0), *(np.full(p.loading.shape[2], 1 / p.time) for p in self.processes)])
        loading = np.concatenate([np.zeros((*self.white.shape, 0)), *(p.scale * p.loading for p in self.processes)], 2)
        # Each process begins with the variance that it has at all times.
        covariance = np.tile(np.eye(len(rate)), (axes, 1, 1))
        product, mean, last, ln_det, count = np.zeros((0, 0)), np.zeros((0, 0, 0)), -math.inf, 0.0, 0
        for time, values in chunks:
            if not product.size:
                columns = values.shape[-1]
                product, mean = np.zeros((columns, columns)), np.zeros((axes, columns, len(rate)))
            time, values = (np.ascontiguousarray(x, dtype=np.float64) for x in (time, values))
            seen = np.isfinite(values[..., 0])
            ln_det += _filter(time, values, seen, rate, loading, self.white**2, last, mean, covariance, product)
            count += int(seen.sum())
            last = float(time[-1])
        return Gram(product=product + np.tril(product, -1).T, ln_det=ln_det, count=count)

    def dense(self, time: np.ndarray, axis: int) -> np.ndarray:
        """The covariance of all samples along an axis [T M, T M] m2, of marker 0 at all times first; for short ones."""
        lag = np.abs(time[:, None] - time)
        found = np.kron(np.diag(self.white[axis] ** 2), np.eye(len(time)))
        for p in self.processes:
            found += p.scale**2 * np.kron(p.loading[axis] @ p.loading[axis].T, np.exp(-lag / p.time))
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


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _filter(time, values, seen, rate, loading, variance, last, mean, covariance, product):
    """Kalman filter of many columns along each axis; returns ln of the product of the innovations' variances.

    ``mean`` and ``covariance`` are changed, and to the lower triangle of ``product`` are added the products of the
    innovations over their standard deviations. Where samples follow each other evenly, gains settle; they are then
    kept, until the interval changes or a sample is lost.
    """
    rows, markers, axes, columns = values.shape
    ln_det = 0.0
    for a in range(axes):
        # A process that no marker sees would only cost time.
        some = np.zeros(len(rate), dtype=np.bool_)
        for m in range(markers):
            for k in range(len(rate)):
                some[k] |= loading[a, m, k] != 0.0
        used = np.flatnonzero(some)
        states = len(used)
        L, x, P = np.zeros((markers, states)), np.zeros((columns, states)), np.zeros((states, states))
        for i in range(states):
            L[:, i], x[:, i] = loading[a, :, used[i]], mean[a, :, used[i]]
            for j in range(states):
                P[i, j] = covariance[a, used[i], used[j]]
        keep, by, gain, white = np.zeros(states), np.zeros(states), np.zeros((markers, states)), np.zeros(columns)
        spread, root, ln_root = np.zeros(markers), np.zeros(markers), np.zeros(markers)
        before, lag, settled = last, math.inf, False
        for t in range(rows):
            same = lag < math.inf and abs(time[t] - before - lag) <= EVEN * lag
            if not same:
                lag = time[t] - before
                for i in range(states):
                    keep[i] = math.exp(-lag * rate[used[i]])
            before = time[t]
            for m in range(markers):
                same &= seen[t, m, a]
            settled &= same
            change = 0.0 if same else 1.0
            for c in range(columns):
                for i in range(states):
                    x[c, i] *= keep[i]
            if not settled:
                for i in range(states):
                    for j in range(states):
                        P[i, j] *= keep[i] * keep[j]
                    P[i, i] += 1.0 - keep[i] * keep[i]
            for m in range(markers):
                if not seen[t, m, a]:
                    continue
                if not settled:
                    by[:] = 0.0
                    for j in range(states):
                        if L[m, j] != 0.0:
                            for i in range(states):
                                by[i] += P[j, i] * L[m, j]
                    known, spread[m] = spread[m], variance[a, m]
                    for i in range(states):
                        spread[m] += L[m, i] * by[i]
                    root[m], ln_root[m] = math.sqrt(spread[m]), 0.5 * math.log(spread[m])
                    change = max(change, abs(known / spread[m] - 1.0))
                    for i in range(states):
                        share = by[i] / spread[m]
                        change = max(change, abs(share - gain[m, i]) * root[m])
                        gain[m, i] = share
                        for j in range(states):
                            P[i, j] -= share * by[j]
                for c in range(columns):
                    left = values[t, m, a, c]
                    for i in range(states):
                        left -= L[m, i] * x[c, i]
                    for i in range(states):
                        x[c, i] += gain[m, i] * left
                    white[c] = left / root[m]
                for c in range(columns):
                    for d in range(c + 1):
                        product[c, d] += white[c] * white[d]
                ln_det += 2.0 * ln_root[m]
            settled = settled or change < SETTLED
        for i in range(states):
            mean[a, :, used[i]] = x[:, i]
            for j in range(states):
                covariance[a, used[i], used[j]] = P[i, j]
    return ln_det
