"""What a model can explain of recordings whatever the form of the errors: by least squares.

Evidence takes the covariance of errors at its word. Where a discrepancy matters, or where the twin's error may lie
along any change of the motion, the size of what is left says more than its form.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from torchsoro.sim2real.inference.evidence import Linearised, Posterior, grams
from torchsoro.sim2real.inference.laplace import Mode, posterior
from torchsoro.sim2real.inference.observed import Data, independent, size_of
from torchsoro.sim2real.inference.state_space import Gram, tempered, total

SETTLED = 5  # rounds in which the size of what is left and its weight agree to a percent


def told(data: Data, found: Posterior, kappa: float = 1.0, but: int | None = None) -> Mode:
    """The numbers of a model that are told and predicted with; s, tau and c are those of all trials.

    They are the most probable ones. But where a discrepancy matters, these leave to it what they might explain: then
    they are those of :func:`closest`, which predict better.

    Args:
        data: Recordings.
        found: A model after all of them.
        kappa: See :func:`~torchsoro.sim2real.inference.evidence.adjusted`.
        but: Number of a trial that is left out.
    """
    near = found.near
    if found.matters:
        return dataclasses.replace(found.mode, at=closest(data, near, but).at)
    if but is None:
        return found.mode
    parts = [tempered(g, kappa) for i, g in enumerate(grams(data, near, found.discrepancy)) if i != but]
    return posterior(total(parts), near.at, near.model.priors)


def _alike(near: Linearised, error: float) -> list[Gram]:
    """Products of residual and slopes of each trial, with independent errors of one size [m] in all samples."""
    found = []
    for residual, slopes in zip(near.residuals, near.slopes, strict=True):
        seen = np.isfinite(residual)
        X = np.concatenate([residual[seen][:, None], slopes[seen]], 1) / error
        found.append(Gram(product=X.T @ X, ln_det=2 * len(X) * math.log(error), count=len(X)))
    return found


def closest(data: Data, near: Linearised, but: int | None = None) -> Mode:
    """The mode by least squares: errors of all samples are alike, and as large as what is left.

    They count as the independent values that they amount to, so that beliefs and measurement errors stay what they may
    be where what is left is large and lasts.

    Args:
        data: Recordings.
        near: A model near a point.
        but: Number of a trial that is left out.
    """
    kept = [i for i in range(len(data.trials)) if i != but]
    at = near.at
    for _ in range(SETTLED):
        left = tuple(r for i, r in enumerate(near.left(at)) if i in kept)
        parts = _alike(near, max(size_of(left), data.noise))
        whole = total([parts[i] for i in kept])
        mode = posterior(tempered(whole, max(whole.count / independent(left), 1.0)), near.at, near.model.priors)
        at = mode.at
    return mode


def ln_evidence_within(data: Data, near: Linearised, error: float, count: float) -> float:
    """Ln of the evidence of a model where an error may lie along any change of the motion.

    Args:
        data: Recordings.
        near: A model near a point.
        error: Its size, root mean square [m].
        count: Independent numbers that all samples amount to, each the mean of so many with their noise.
    """
    samples = sum(int(np.isfinite(r).sum()) for r in near.residuals)
    each = max(samples / count, 1.0)
    whole = total(_alike(near, math.hypot(error, data.noise / math.sqrt(each))))
    return posterior(tempered(whole, each), near.at, near.model.priors).ln_evidence
