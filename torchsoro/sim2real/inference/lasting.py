"""How much of a recording's noise lasts from sample to sample, and with that how large it is.

Third differences of a recording tell its white noise alone, see :mod:`torchsoro.sim2real.inference.noise`. What lasts,
as trackers drift, is seen in what a model leaves: independent from marker to marker and from axis to axis, unlike a
discrepancy or the twin's own error. It would else be taken for these, or taken up by effects.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from torchsoro.sim2real.inference.evidence import FIRST, Posterior, ln_likelihood, ranges, restricted
from torchsoro.sim2real.inference.noise import lasting_noise
from torchsoro.sim2real.inference.observed import Data

SHARES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)  # that are tried


def with_lasting_noise(data: Data, found: Posterior, *, stated: bool) -> Data:
    """Recordings with the share of lasting noise with which what a model leaves is most probable.

    Args:
        data: Recordings; their noise as stated, or as third differences tell it.
        found: The model, after these recordings.
        stated: Whether the noise is stated, so that its share is fitted alone.
    """
    interval = float(np.median(np.concatenate([np.diff(t.time) for t in data.trials])))
    first = found.discrepancy
    x = np.log([max(first.share, 1e-12), first.time, first.twin])
    best, most = data, -math.inf
    for share in SHARES:
        noise = data.noise if stated else lasting_noise(data.noise, share, interval)
        tried = dataclasses.replace(data, noise=noise, lasting=share)
        low, high = ranges(tried, found.near.numerics)
        x = restricted(tried, found.near, found.left, np.clip(x, low, high), low, high, FIRST)
        ln_p = ln_likelihood(tried, found.near, found.left, x)
        if ln_p > most:
            best, most = tried, ln_p
    return best
