"""Confirmation: whether what is told predicts trials that are left out better than nothing does."""

from __future__ import annotations

import math

from torchsoro.sim2real.inference.evidence import Posterior, leave_one_out
from torchsoro.sim2real.inference.observed import Data


def compared(data: Data, one: Posterior, other: Posterior, kappa: float) -> tuple[float, float]:
    """Gain in ln predictive density of trials left out, and its standard error over trials.

    By density even where sizes decide between names: what the other trials leave unknown widens it, while numbers that
    they do not tell would leave much of the trial by their size.

    Args:
        data: Recordings.
        one: The one that may be better.
        other: The other.
        kappa: Of whose inverse the likelihood is taken to the power.
    """
    gain = leave_one_out(data, one, kappa) - leave_one_out(data, other, kappa)
    n = len(gain)
    return float(gain.sum()), float(math.sqrt(n * gain.var(ddof=1))) if n > 1 else math.inf
