"""Confirmation: whether what is told predicts trials that are left out better than nothing does."""

from __future__ import annotations

import math

import numpy as np

from torchsoro.sim2real.inference.evidence import Posterior, leave_one_out
from torchsoro.sim2real.inference.least_squares import closest
from torchsoro.sim2real.inference.observed import Data, independent, size_of


def compared(data: Data, one: Posterior, other: Posterior, kappa: float) -> tuple[float, float]:
    """Gain in ln predictive density of trials left out, and its standard error over trials.

    Of one that leaves a discrepancy that matters, by the sizes of what is left of each trial, as names are told.

    Args:
        data: Recordings.
        one: The one that may be better.
        other: The other.
        kappa: Of whose inverse the likelihood is taken to the power.
    """
    if one.matters:
        gain = np.array([_gain_by_size(data, one, other, trial) for trial in range(len(data.trials))])
    else:
        gain = leave_one_out(data, one, kappa) - leave_one_out(data, other, kappa)
    n = len(gain)
    return float(gain.sum()), float(math.sqrt(n * gain.var(ddof=1))) if n > 1 else math.inf


def _gain_by_size(data: Data, one: Posterior, other: Posterior, trial: int) -> float:
    """Gain in ln likelihood of a trial that is left out, if what each leaves of it were white, by its size."""
    left = [(p.near.left(closest(data, p.near, but=trial).at)[trial],) for p in (one, other)]
    mine, its = (math.hypot(size_of(r), data.noise) for r in left)
    return independent(left[0]) * math.log(its / mine)
