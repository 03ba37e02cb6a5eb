"""Recordings as the decision sees them: places of markers over time, and how far they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchsoro.sim2real.inference.decision import MATTERS
from torchsoro.sim2real.inference.noise import LASTING

STILL = 0.1  # of the mean motion: least amplitude of a discrepancy along an axis without motion

Motions = tuple[np.ndarray, ...]  # of each trial, as recorded [T, M, A] m


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialData:
    """One recorded trial; nothing in it changes.

    Attributes:
        name: Of the trial.
        time: [T] s.
        position: [T, M, A] m; not a number where a sample was lost.
    """

    name: str
    time: np.ndarray
    position: np.ndarray

    def __post_init__(self) -> None:
        """Keep copies that cannot be written to."""
        if self.position.ndim != 3 or self.time.shape != self.position.shape[:1]:
            raise ValueError(
                f"trial {self.name}: time and position of shapes {self.time.shape} and {self.position.shape}, "
                "wanted [T] and [T, M, A]"
            )
        if len(never := np.argwhere(~np.isfinite(self.position).any(0))):
            marker, axis = never[0]
            raise ValueError(f"trial {self.name}: marker {marker} has no sample along axis {axis}, wanted some of each")
        for name in ("time", "position"):
            value = np.array(getattr(self, name), dtype=np.float64)
            value.setflags(write=False)
            object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """The trials that decide. Trials that are only predicted are not among them, and reach no decision.

    Attributes:
        trials: Recordings.
        noise: Standard deviation of a sample's noise [m].
        lasting: Share of its variance that lasts from sample to sample.
    """

    trials: tuple[TrialData, ...]
    noise: float
    lasting: float = LASTING

    @cached_property
    def motions(self) -> tuple[np.ndarray, ...]:
        """Root mean square of the motion about its mean, of each trial [A, M] m."""
        return tuple(np.sqrt(np.nanmean((t.position - np.nanmean(t.position, 0)) ** 2, 0).T) for t in self.trials)

    @cached_property
    def amplitudes(self) -> tuple[np.ndarray, ...]:
        """Of a discrepancy with s = 1 in each trial [A, M] m: the motion, and a little of its mean where none is."""
        return tuple(np.hypot(motion, STILL * self.size) for motion in self.motions)

    @cached_property
    def size(self) -> float:
        """Root mean square of the motion over trials, markers and axes [m]."""
        return float(np.sqrt(np.mean(np.square(self.motions))))

    @cached_property
    def shares(self) -> tuple[float, float]:
        """Of the motion, between which the prior of a discrepancy that matters is uniform in ln s.

        From what does not matter to all of it, what is lasting included: the displacement from the first sample.
        """
        away = np.concatenate([_moved(t.position).ravel() for t in self.trials])
        return MATTERS, max(1.0, float(np.sqrt(np.nanmean(away**2))) / self.size)


def _moved(position: np.ndarray) -> np.ndarray:
    """Displacements [T, M, A] m from the first sample of each marker that was not lost."""
    first = np.isfinite(position).argmax(0)
    return position - np.take_along_axis(position, first[None], 0)


def size_of(values: Sequence[np.ndarray]) -> float:
    """Root mean square over all samples [m]."""
    return float(np.sqrt(np.nanmean(np.concatenate([v.ravel() for v in values]) ** 2)))


def independent(left: Motions) -> float:
    """Number of independent values that residuals [T, M, A] of each trial amount to.

    A covariance of eigenvalues l is worth (sum l)^2 / sum l^2 values. With C channels of covariance K and N samples,
    whose correlation at a lag of k samples is rho_k over all channels, that is

        N_eff = n N / (1 + 2 sum_k (1 - k/N) (rho_k^2 - e_k)),    n = (tr K)^2 / tr K^2,

    where e_k = (1 - k/N) / (n N) is what rho_k^2 is on average where samples are independent.
    """
    found = 0.0
    for r in left:
        x = np.nan_to_num(r).reshape(len(r), -1)
        count, K = len(x), x.T @ x
        channels = float(np.trace(K)) ** 2 / max(float((K**2).sum()), 1e-300)
        spectrum = np.abs(np.fft.rfft(x, 2 * count, axis=0)) ** 2
        rho = np.fft.irfft(spectrum.sum(1))[1:count] / max(float(np.trace(K)), 1e-300)
        share = 1 - np.arange(1, count) / count
        lasting = 1 + 2 * float((share * (rho**2 - share / max(channels * count, 1.0))).sum())
        found += channels * count / max(lasting, 1.0)
    return max(found, 1.0)
