"""Noise of recordings and error of the twin: their covariance, and residuals whitened by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from torchsoro.sim2real.data.recording import Recording

CORRELATION = 0.03  # correlation time of the twin's own error, and of the lasting part of the noise [s]
LASTING = 0.25  # share of the noise's variance that is correlated in time, until it is fitted (see ``lasting``)


@dataclass(frozen=True, kw_only=True, eq=False)
class Channel:
    """Samples of equal covariance, and the recursion that whitens them (a Kalman filter, see ``state_space``).

    Attributes:
        rows: Numbers of the samples that were seen [R].
        pairs: Marker and axis of each [P, 2].
        keep: What is left of the expectation since the sample before [R].
        gain: By which a sample changes the expectation [R].
        scale: One over the standard deviation of a sample about its expectation [R].
    """

    rows: np.ndarray
    pairs: np.ndarray
    keep: np.ndarray
    gain: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(
        cls, rows: np.ndarray, pairs: Sequence[tuple[int, int]], time: np.ndarray, white: float, slow: float
    ) -> Channel:
        """Of variances of white noise and of what is correlated, at times [R] s."""
        keep, gain, scale = np.zeros((3, len(rows)))
        variance, last = slow, float(time[0])
        for r, now in enumerate(time.tolist()):
            keep[r] = math.exp((last - now) / CORRELATION)
            variance, last = slow + keep[r] ** 2 * (variance - slow), now
            gain[r], scale[r] = variance / (variance + white), 1 / math.sqrt(variance + white)
            variance *= 1 - gain[r]
        return cls(rows=rows, pairs=np.array(pairs), keep=keep, gain=gain, scale=scale)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Of columns [P, R, C], ones of unit covariance."""
        return _innovations(np.ascontiguousarray(values, dtype=np.float64), self.keep, self.gain, self.scale)


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
        alike: dict[tuple[bytes, float], list[tuple[int, int]]] = {}
        for m, a in np.ndindex(*discretization.shape):
            rows = np.flatnonzero(recording.seen[:, m, a])
            if len(rows):
                alike.setdefault((rows.tobytes(), float(discretization[m, a])), []).append((m, a))
        self.channels: list[Channel] = []
        for (_, deviation), pairs in alike.items():
            rows = np.flatnonzero(recording.seen[:, *pairs[0]])
            white, slow = (1 - lasting) * noise**2, lasting * noise**2 + deviation**2
            self.channels.append(Channel.of(rows, pairs, recording.time[rows], white, slow))
        self.count = sum(len(c.rows) * len(c.pairs) for c in self.channels)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Residuals [T, M, A, ...] to [samples, ...] of unit covariance, if noise and twin are as stated."""
        parts = []
        for c in self.channels:
            picked = values[c.rows, c.pairs[:, :1], c.pairs[:, 1:]]
            parts.append(c.whiten(picked.reshape(*picked.shape[:2], -1)).reshape(-1, *values.shape[3:]))
        return np.concatenate(parts)


@numba.njit(cache=True)
def _innovations(values, keep, gain, scale):
    """Samples less what is expected of them, over the standard deviation of that."""
    found = np.empty_like(values)
    for p in range(values.shape[0]):
        mean = np.zeros(values.shape[2])
        for r in range(values.shape[1]):
            for c in range(values.shape[2]):
                mean[c] *= keep[r]
                left = values[p, r, c] - mean[c]
                mean[c] += gain[r] * left
                found[p, r, c] = scale[r] * left
    return found


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


def lasting_noise(white: float, lasting: float, interval: float) -> float:
    """Standard deviation of noise of which a share lasts [m], with the third differences of white noise of another.

    Args:
        white: Standard deviation of that white noise [m], as :func:`estimate_noise` finds it.
        lasting: Share of the variance that is correlated, 0 to 1.
        interval: Between samples [s].
    """
    kept = np.exp(-interval / CORRELATION * np.arange(1, 4))
    third = 20 - float(np.array([30, -12, 2]) @ kept)  # variance of a third difference of what is correlated
    return white * math.sqrt(20 / (20 * (1 - lasting) + lasting * third))
