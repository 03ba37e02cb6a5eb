"""Residual mismatch between neighbouring isothermal curves after time-temperature shifting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """Mismatch of two neighbouring curves after the shift.

    Attributes:
        cold: Temperature of the colder curve [deg C].
        hot: Temperature of the hotter curve [deg C].
        step: log10 a_T of the colder minus that of the hotter curve [decades].
        step_error: Standard error of ``step`` [decades].
        common: Range of frequency or time covered by both curves; negative for a gap [decades].
        mismatch: Root-mean-square difference of log10 of their moduli over that range [decades]; nan for a gap.
        quality: Ratio of the root-mean-square difference to that expected from the noise: about 1 if the curves
            superpose, well above 1 if they do not; nan for a gap.
    """

    cold: float
    hot: float
    step: float
    step_error: float
    common: float
    mismatch: float
    quality: float


def distance(
    moduli: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], noise: np.ndarray, i: int
) -> tuple[float, float, float]:
    """Common range, mismatch and quality of curves i and i + 1, as of :class:`Overlap`.

    The points of each curve are compared with the linear interpolation between the points of the other.

    Args:
        moduli: For each modulus: log10 of the shifted frequency, log10 of the shifted modulus, index of the curve [n].
        noise: Noise standard deviation of each modulus [decades].
        i: Index of the first curve.
    """
    squares, ratios, common = [], [], -np.inf
    for (x, y, curve), sigma in zip(moduli, noise, strict=True):
        order = np.argsort(x, kind="stable")
        ends = [(x[order][curve[order] == k], y[order][curve[order] == k]) for k in (i, i + 1)]
        common = max(common, min(e[0][-1] for e in ends) - max(e[0][0] for e in ends))
        for (x1, y1), (x2, y2) in (ends, ends[::-1]):
            inside = (x1 >= x2[0]) & (x1 <= x2[-1])
            above = np.clip(np.searchsorted(x2, x1[inside]), 1, len(x2) - 1)
            w = (x1[inside] - x2[above - 1]) / (x2[above] - x2[above - 1])
            apart = y1[inside] - (1 - w) * y2[above - 1] - w * y2[above]
            squares.append(apart**2)
            ratios.append(apart**2 / (sigma**2 * (1 + w**2 + (1 - w) ** 2)))
    together = [np.concatenate(values) for values in (squares, ratios)]
    mismatch, quality = (float(np.sqrt(values.mean())) if len(values) else float("nan") for values in together)
    return float(common), mismatch, quality
