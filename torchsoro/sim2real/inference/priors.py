"""Prior densities of the unknowns of a model, one dimension each.

An unknown is in the scale of its quantity (:class:`~torchsoro.sim2real.hypotheses.hypothesis.Quantity`), so that a
density of width one is that of a noticeable change.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit


@dataclass(frozen=True)
class Prior:
    """Student's t distribution about zero within bounds; normal with infinitely many degrees of freedom.

    With a bound at zero it is half of the distribution, and with ``scale`` infinite it is uniform between the bounds.
    The normal distribution of a logarithm is the log-normal of its quantity.

    Attributes:
        scale: Width.
        freedom: Degrees of freedom: how soon a value far off is believed, where data ask for it.
        low: Lower bound.
        high: Upper bound.

    Raises:
        ValueError: for a width that is not positive, bounds that are no interval, or a uniform prior without bounds.
    """

    scale: float
    _: KW_ONLY
    freedom: float = math.inf
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (self.scale > 0 and self.freedom > 0 and self.low < self.high):
            raise ValueError(
                f"scale = {self.scale:g}, freedom = {self.freedom:g}, low = {self.low:g}, high = {self.high:g}: "
                "wanted positive numbers, and low below high"
            )
        if math.isinf(self.scale) and not math.isfinite(self.high - self.low):
            raise ValueError(f"low = {self.low:g}, high = {self.high:g}: wanted finite bounds of a uniform prior")

    @cached_property
    def ln_mass(self) -> float:
        """Ln of the integral of the distribution within the bounds."""
        if math.isinf(self.scale):
            return math.log(self.high - self.low)
        low, high = self._shares
        return math.log(high - low)

    @cached_property
    def _shares(self) -> tuple[float, float]:
        """Of the whole distribution, below the bounds."""
        ends = np.array([self.low, self.high]) / self.scale
        low, high = ndtr(ends) if math.isinf(self.freedom) else stdtr(self.freedom, ends)
        return float(low), float(high)

    def quantile(self, u: np.ndarray) -> np.ndarray:
        """Values below which the distribution has shares u of its mass, 0 to 1."""
        if math.isinf(self.scale):
            return self.low + u * (self.high - self.low)
        low, high = self._shares
        share = low + u * (high - low)
        z = ndtri(share) if math.isinf(self.freedom) else stdtrit(self.freedom, share)
        return np.clip(self.scale * z, self.low, self.high)

    def ln_density(self, x: float) -> float:
        """Ln of the density at a value within the bounds."""
        if math.isinf(self.scale):
            return -self.ln_mass
        z, n = x / self.scale, self.freedom
        if math.isinf(n):
            ln_p = -0.5 * (z**2 + math.log(2 * math.pi))
        else:
            ln_p = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - 0.5 * math.log(n * math.pi)
            ln_p -= 0.5 * (n + 1) * math.log1p(z**2 / n)
        return ln_p - math.log(self.scale) - self.ln_mass

    def weight(self, x: float) -> float:
        """The w of -ln density = w x^2 / 2 + const near a value: the weight of iterated least squares."""
        if math.isinf(self.scale):
            return 0.0
        if math.isinf(self.freedom):
            return self.scale**-2
        return (self.freedom + 1) / (self.freedom * self.scale**2 + x**2)


def bounds(priors: tuple[Prior, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of unknowns [K]."""
    return np.array([p.low for p in priors]), np.array([p.high for p in priors])
