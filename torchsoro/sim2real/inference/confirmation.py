"""Confirmation: whether what is told predicts trials that are left out better than nothing does."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from torchsoro.sim2real.inference.evidence import Linearised, Model, Posterior, leave_one_out
from torchsoro.sim2real.inference.least_squares import closest
from torchsoro.sim2real.inference.observed import Data, Motions, independent, size_of


def compared(data: Data, one: Posterior, other: Posterior, kappa: float) -> tuple[float, float]:
    """Gain in what trials that are left out are predicted with, and its standard error over trials.

    In ln predictive density; of one that leaves a discrepancy that matters, in -N ln r, r the root mean square that is
    left of a trial and N the independent numbers that this amounts to, as names are told. Its own measurement errors,
    such as its clock, are fitted to each trial by either. A single trial cannot be left out: then K/2 ln N is taken
    off for numbers of effects.

    Args:
        data: Recordings.
        one: The one that may be better.
        other: The other.
        kappa: Of whose inverse the likelihood is taken to the power; of no matter to sizes.
    """
    if one.matters:
        gain = np.array([_gain_by_size(data, one, other, trial) for trial in range(len(data.trials))])
    else:
        gain = leave_one_out(data, one, kappa) - leave_one_out(data, other, kappa)
    n = len(gain)
    return float(gain.sum()), float(math.sqrt(n * gain.var(ddof=1))) if n > 1 else math.inf


def _gain_by_size(data: Data, one: Posterior, other: Posterior, trial: int) -> float:
    """Gain in -N ln r of a trial that is left out, N as of the first."""
    alone = dataclasses.replace(data, trials=(data.trials[trial],))
    left = [_left_of(data, p.near, trial, alone) for p in (one, other)]
    mine, its = (math.hypot(size_of(r), data.noise) for r in left)
    count = independent(left[0])
    more = len(one.near.model.own) - len(other.near.model.own) if len(data.trials) == 1 else 0
    return count * math.log(its / mine) - 0.5 * more * math.log(count)


def _left_of(data: Data, near: Linearised, trial: int, alone: Data) -> Motions:
    """What is left of a trial by numbers from the others, and measurement errors of its own."""
    at = closest(data, near, but=trial if len(data.trials) > 1 else None).at
    free = [k for k in range(len(at)) if k not in near.model.simulated]
    still = Linearised(
        model=Model(effects=(), priors=tuple(near.model.priors[k] for k in free)),
        at=at[free],
        residuals=(near.left(at)[trial],),
        slopes=(near.slopes[trial][..., free],),
        numerics=near.numerics,
    )
    return still.left(closest(alone, still).at)
