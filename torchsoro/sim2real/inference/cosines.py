"""Detectability of effects and cosines between them, from whitened responses.

The response of an effect is the change that it makes in a recording. Whitened by the noise, and projected off the
responses of measurement errors, modulus and pressure under their priors, its squared length is the gain in chi-squared,
and the cosine between two responses says how much of one effect another can imitate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, nnls, root_scalar

SCORE = 40.0  # squared length of a whitened response at which an effect is detectable
FARTHEST = 1e4  # strength over the largest that was simulated, above which an effect counts as not detectable

PriorResidual = Callable[[np.ndarray], np.ndarray]  # residuals [C] by the priors of the common unknowns at values [C]


def cleared(changes: np.ndarray, nuisances: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Changes less what nuisances with Gaussian priors take up.

    Args:
        changes: Whitened [N, K].
        nuisances: Whitened change by each nuisance [N, L].
        slopes: One over the standard deviation of each nuisance [L], positive.

    Returns:
        The rest [N + L, K]; the last rows are the cost of the nuisances. The squared length of a column is its
        generalised least-squares chi-squared.
    """
    padded = np.concatenate([changes, np.zeros((len(slopes), changes.shape[1]))])
    basis, _ = np.linalg.qr(np.concatenate([nuisances, np.diag(slopes)]))
    return padded - basis @ (basis.T @ padded)


def imitation(change: np.ndarray, directions: np.ndarray, free: np.ndarray) -> float:
    """Cosine of the angle between a change and the cone of directions, 0 to 1.

    Args:
        change: [N].
        directions: That add up [N, D].
        free: Whether each may also be taken backwards, bool [D].
    """
    lengths, size = np.linalg.norm(directions, axis=0), float(np.linalg.norm(change))
    some = lengths > 1e-12 * max(size, 1e-300)
    if not size or not some.any():
        return 0.0
    unit = directions[:, some] / lengths[some]
    _, off = nnls(np.concatenate([unit, -unit[:, free[some]]], 1), change / size)
    return math.sqrt(max(1 - off**2, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """Whitened changes by one effect.

    Attributes:
        paths: Alternatives: strengths, in scales, from the smallest on [S], and changes at them [N, S].
        cones: Alternatives: what the effect can do at all, as directions that add up [N, D], and which of them may be
            taken backwards, bool [D].
        either: Whether strengths of both signs are possible.
    """

    paths: tuple[tuple[np.ndarray, np.ndarray], ...]
    cones: tuple[tuple[np.ndarray, np.ndarray], ...]
    either: bool


def settle(change: np.ndarray, common: np.ndarray, prior_residual: PriorResidual) -> tuple[float, np.ndarray]:
    """The rest of a change that the common unknowns cannot take up under their priors.

    Args:
        change: [N].
        common: Change by each of them [N, C].
        prior_residual: Of their values.

    Returns:
        Length of the rest, prior residuals included, and slopes [C] of the Gaussian priors that cost as much there.
    """
    basis, root = np.linalg.qr(common)
    inner = basis.T @ change
    rest = float(change @ change - inner @ inner)
    slight = prior_residual(np.full(common.shape[1], 1e-3)) / 1e-3
    start = np.linalg.lstsq(np.concatenate([root, np.diag(slight)]), np.append(inner, 0 * slight), rcond=None)[0]
    found = least_squares(lambda x: np.append(inner - root @ x, prior_residual(x)), np.clip(start, -1.5, 1.5))
    x = np.where(np.abs(found.x) < 1e-3, 1e-3, found.x)
    return math.sqrt(max(rest, 0.0) + 2 * float(found.cost)), np.abs(prior_residual(x) / x)


def first_seen(
    strengths: np.ndarray, changes: np.ndarray, common: np.ndarray, prior_residual: PriorResidual, score: float
) -> tuple[float, np.ndarray]:
    """The strength at which an effect is detectable, and its response there, interpolated between simulations.

    Args:
        strengths: In scales, from the smallest on [S].
        changes: At each [N, S].
        common: Change by each common unknown [N, C].
        prior_residual: Of their values.
        score: Squared length at which a response is detectable.
    """
    at = np.append(0.0, strengths)
    known = np.concatenate([np.zeros((len(changes), 1)), changes], 1)

    def change(s: float) -> np.ndarray:
        if s > at[-1]:
            return known[:, -1] * s / at[-1]
        k = max(int(np.searchsorted(at, s)), 1)
        share = (s - at[k - 1]) / (at[k] - at[k - 1])
        return (1 - share) * known[:, k - 1] + share * known[:, k]

    def above(s: float) -> float:
        return settle(change(s), common, prior_residual)[0] - math.sqrt(score)

    low = 0.0
    for high in (*strengths, *(strengths[-1] * np.geomspace(10, FARTHEST, 4))):
        if above(high) > 0:
            s = float(root_scalar(above, bracket=(low, high), rtol=1e-3).root)
            return s, change(s)
        low = float(high)
    return math.inf, known[:, -1]


def compare(
    responses: Sequence[Response], common: np.ndarray, prior_residual: PriorResidual, score: float = SCORE
) -> tuple[np.ndarray, np.ndarray]:
    """Strengths from which effects are detectable, and cosines between them.

    Args:
        responses: Of E effects, without what measurement errors take up.
        common: Change by each common unknown [N, C].
        prior_residual: Of their values.
        score: Squared length at which a response is detectable.

    Returns:
        Strengths at which they are detectable [E], in scales, infinite for one that never is; and how much of the
        change by effect i at that strength effect j can imitate [E, E], 0 to 1.
    """
    count = len(responses)
    detectable, cosines = np.full(count, np.inf), np.eye(count)
    for i, mine in enumerate(responses):
        seen = [first_seen(*path, common, prior_residual, score) for path in mine.paths]
        if not seen:
            continue
        detectable[i], change = min(seen, key=lambda s: s[0])
        if not math.isfinite(detectable[i]):
            continue
        slopes = settle(change, common, prior_residual)[1]
        left = cleared(change[:, None], common, slopes)[:, 0]
        for j, other in enumerate(responses):
            signs = (1, -1) if mine.either or other.either else (1,)
            for directions, free in other.cones if j != i else ():
                cone = cleared(directions, common, slopes)
                cosines[i, j] = max(cosines[i, j], *(imitation(sign * left, cone, free) for sign in signs))
    return detectable, cosines
