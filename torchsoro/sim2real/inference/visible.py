"""Which changes of the motion would have been seen, and what would make smaller ones visible.

An effect changes the motion by a c, where c is its response as far as beliefs and measurement errors cannot imitate it,
of information I = c' C^-1 c. It comes to have more than the credible probability where

    a^2 I / (2 kappa) = ln(credible / (1 - credible)) + ln(names + 1) + ln(unseen / seen),

the last two its prior odds, see :mod:`torchsoro.sim2real.inference.weighing`.

The strength of what is missing is known to its order of magnitude at most. What share of it would not have been seen is
told with strengths spread evenly in their logarithm, from a tenth to ten times the width of the prior.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from torchsoro.sim2real.inference.decision import CREDIBLE, MATTERS, STRENGTH, VISIBLE
from torchsoro.sim2real.inference.evidence import Posterior, products
from torchsoro.sim2real.inference.isolability import Isolability
from torchsoro.sim2real.inference.observed import Data, Motions
from torchsoro.sim2real.inference.state_space import total
from torchsoro.sim2real.inference.weighing import LN_NOT_SEEN, LN_SEEN

FACTORS = (2.0, 4.0, 8.0, 16.0)  # by which an experiment or a twin may be made better


def limit(data: Data, null: Posterior, responses: Motions, kappa: float, names: int, *, trials: float = 1.0) -> float:
    """Root mean square of the change of the motion that would have been seen, for the median response [m].

    Args:
        data: Recordings.
        null: The model without an effect.
        responses: Change of the motion by each of E effects, of each trial [T, M, A, E].
        kappa: By which ln evidences are divided.
        names: Number of effects that can be named.
        trials: Times as many trials as there are.
    """
    size, least = _least(data, null, responses, kappa, names, trials)
    seen = np.isfinite(least)
    if not seen.any():
        return math.inf
    # What the twin may err by is not told, however well it is seen.
    return max(float(np.median((size * least)[seen])), null.near.numerics.size)


def too_weak(data: Data, null: Posterior, tells: Isolability, kappa: float, names: int) -> float:
    """Share of the prior of what is missing that would not have been seen, on average over effects.

    Of an effect that acts in several directions the median of these counts.

    Args:
        data: Recordings.
        null: The model without an effect.
        tells: Change of the motion by one noticeable change of each effect.
        kappa: By which ln evidences are divided.
        names: Number of effects that can be named.
    """
    size, least = _least(data, null, tells.changes, kappa, names)
    own = null.near.numerics.size
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.maximum(least, np.where(size > 0, own / size, np.inf))
    share = np.clip((np.log10(needed / STRENGTH) + 1) / 2, 0, 1)
    owners = np.array(tells.owners)
    # One that moves nothing that was recorded is not seen.
    each = [np.median(share[owners == name]) if name in owners else 1.0 for name in sorted(set(tells.effects))]
    return float(np.mean(each))


def _least(
    data: Data, null: Posterior, responses: Motions, kappa: float, names: int, trials: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square of each response that beliefs and measurement errors leave [m], and its least multiple seen."""
    near = null.near
    count = responses[0].shape[-1]
    columns = [
        # A sample that was lost tells nothing of a response either.
        np.concatenate([np.where(np.isfinite(r)[..., None], c, np.nan), J], -1)
        for r, c, J in zip(near.residuals, responses, near.slopes, strict=True)
    ]
    product = trials * total(products(data, near.numerics, null.discrepancy, columns)).product
    A, B, G = product[count:, count:], product[count:, :count], product[:count, :count]
    weight = np.diag([p.weight(x) for p, x in zip(near.model.priors, null.mode.at, strict=True)])
    taken = np.linalg.solve(A + weight, B)
    information = np.diag(G - B.T @ taken)
    left = np.concatenate([(c - J @ taken).reshape(-1, count) for c, J in zip(responses, near.slopes, strict=True)])
    needed = 2 * kappa * (math.log(CREDIBLE / (1 - CREDIBLE)) + math.log(names + 1) + LN_NOT_SEEN - LN_SEEN)
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(information > 0, np.sqrt(needed / information), np.inf)
    return np.sqrt((left**2).mean(0)), least


def remedies(data: Data, null: Posterior, responses: Motions, kappa: float, names: int) -> dict[str, float]:
    """What would make a change visible that matters, by the least factor of each that does alone.

    Args:
        data: Recordings.
        null: The model without an effect.
        responses: As of :func:`limit`.
        kappa: The same.
        names: The same.

    Returns:
        Factors, for "noise" (quieter markers), "twin" (a smaller error of the twin), "trials" (more of them), and
        "motion" (a larger one, as of a larger load); none where such a change is visible as it is.
    """

    def matters(size: float, noise: float) -> float:
        return max(MATTERS * size, VISIBLE * noise)

    found: dict[str, float] = {}
    now = limit(data, null, responses, kappa, names)
    if now <= matters(data.size, data.noise):
        return {}
    for factor in FACTORS:
        numerics = null.near.numerics.divided(factor)
        finer = dataclasses.replace(null, near=dataclasses.replace(null.near, numerics=numerics))
        quiet = dataclasses.replace(data, noise=data.noise / factor)
        # With a larger motion the twin errs by more, as responses grow: what is seen stays a share of it, or less.
        seen = max(now, factor * null.near.numerics.size)
        ways: Sequence[tuple[str, float, float]] = (
            ("noise", limit(quiet, null, responses, kappa, names), matters(data.size, quiet.noise)),
            ("twin", limit(data, finer, responses, 1 + (kappa - 1) / factor**2, names), matters(data.size, data.noise)),
            ("trials", limit(data, null, responses, kappa, names, trials=factor), matters(data.size, data.noise)),
            ("motion", seen, matters(factor * data.size, data.noise)),
        )
        for name, value, wanted in ways:
            if value <= wanted:
                found.setdefault(name, factor)
    return found
