"""Noise of recordings and error of the twin: their covariance, and residuals whitened by it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from torchsoro.sim2real.data.recording import Recording

CORRELATION = 0.03  # correlation time of the twin's own error, and of the lasting part of the noise [s]
LASTING = 0.25  # share of the noise's variance that is correlated in time


class NoiseModel:
    """Covariance of residuals: noise, a share of it correlated in time, and the twin's own error, wholly correlated.

    Args:
        recording: Of the trial.
        noise: Standard deviation of the noise [m].
        discretization: That of the twin's own error, by marker and axis [M, A] m.
        lasting: Share of the noise's variance that is correlated.
    """

    def __init__(
        self, recording: Recording, noise: float, discretization: np.ndarray, lasting: float = LASTING
    ) -> None:
        lag = np.abs(recording.time[:, None] - recording.time[None, :])
        correlation = np.exp(-lag / CORRELATION)
        self.channels: list[tuple[np.ndarray, list[tuple[int, int]], np.ndarray]] = []
        known: dict[tuple[bytes, float], int] = {}
        for m, a in np.ndindex(*discretization.shape):
            rows = np.flatnonzero(recording.seen[:, m, a])
            if not len(rows):
                continue
            key = rows.tobytes(), float(discretization[m, a])
            if key in known:
                self.channels[known[key]][1].append((m, a))
                continue
            known[key] = len(self.channels)
            slow = lasting * noise**2 + discretization[m, a] ** 2
            covariance = (1 - lasting) * noise**2 * np.eye(len(rows)) + slow * correlation[np.ix_(rows, rows)]
            root = np.linalg.cholesky(covariance)
            self.channels.append((rows, [(m, a)], solve_triangular(root, np.eye(len(rows)), lower=True)))
        self.count = sum(len(rows) * len(pairs) for rows, pairs, _ in self.channels)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Residuals [T, M, A, ...] to [samples, ...] of unit covariance, if noise and twin are as stated."""
        parts = []
        for rows, pairs, inverse in self.channels:
            v = np.stack([values[rows, m, a] for m, a in pairs])
            flat = inverse @ v.reshape(len(pairs), len(rows), -1)
            parts.append(flat.reshape(-1, *values.shape[3:]))
        return np.concatenate(parts)


def estimate_noise(recordings: Sequence[Recording]) -> float:
    """Standard deviation of the noise [m], from third differences of the quieter half of the samples.

    Motion that is smooth over four samples drops out of a third difference, noise does not: its variance is 20 times
    that of a sample.
    """
    found = []
    for r in recordings:
        third = np.diff(r.position, 3, axis=0)
        third = third[np.isfinite(third)]
        if len(third):
            found.append(np.abs(third))
    pooled = np.sort(np.concatenate(found))
    # Where a normal distribution has its lower quartile of absolute values; motion fills the upper part.
    return float(np.quantile(pooled, 0.25)) / 0.3186 / math.sqrt(20.0)
