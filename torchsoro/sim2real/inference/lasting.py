"""How much of a recording's noise lasts from sample to sample, and with that how large it is.

Third differences of a recording tell its white noise alone, see :mod:`torchsoro.sim2real.inference.noise`. What lasts,
as trackers drift, is seen in what a model leaves: independent from marker to marker and from axis to axis, unlike a
discrepancy or the twin's own error. It would else be taken for these, or taken up by effects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from torchsoro.sim2real.inference.evidence import FIRST, Posterior, ln_likelihood, ranges, restricted
from torchsoro.sim2real.inference.noise import lasting_noise
from torchsoro.sim2real.inference.observed import Data

SHARES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)  # that are tried
# Of the white noise that third differences tell, that are tried where it is not stated: fast motion adds to these.
LEVELS = (0.75, 0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1)


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

    def best(tried: Iterable[tuple[float, float]]) -> tuple[float, float]:
        """Of levels and shares, those with which what is left is most probable."""
        nonlocal x
        probable: dict[tuple[float, float], float] = {}
        for level, share in tried:
            given = _with(data, level, share, interval, stated)
            low, high = ranges(given, found.near.numerics)
            x = restricted(given, found.near, found.left, np.clip(x, low, high), low, high, FIRST)
            probable[level, share] = ln_likelihood(given, found.near, found.left, x)
        return max(probable, key=lambda which: probable[which])

    level, share = best((1.0, share) for share in SHARES)
    if not stated:
        level, share = best((level, share) for level in LEVELS)
        level, share = best((level, share) for share in SHARES)
    return _with(data, level, share, interval, stated)


def _with(data: Data, level: float, share: float, interval: float, stated: bool) -> Data:
    """Recordings with noise of which a share lasts, the white part of it so many times what was told."""
    noise = data.noise if stated else lasting_noise(level * data.noise, share, interval)
    return dataclasses.replace(data, noise=noise, lasting=share)
