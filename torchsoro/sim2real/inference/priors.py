"""Prior densities of the unknowns of a model, one dimension each.

An unknown is in the scale of its quantity (:class:`~torchsoro.sim2real.hypotheses.hypothesis.Quantity`), so that a
density of width one is that of a noticeable change.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

import numpy as np
from scipy.stats import norm, t


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

    @property
    def ln_mass(self) -> float:
        """Ln of the integral of the distribution within the bounds."""
        if math.isinf(self.scale):
            return math.log(self.high - self.low)
        ends = np.array([self.low, self.high]) / self.scale
        low, high = norm.cdf(ends) if math.isinf(self.freedom) else t.cdf(ends, self.freedom)
        return math.log(float(high) - float(low))

    def quantile(self, u: np.ndarray) -> np.ndarray:
        """Values below which the distribution has shares u of its mass, 0 to 1."""
        if math.isinf(self.scale):
            return self.low + u * (self.high - self.low)
        law = norm if math.isinf(self.freedom) else t(self.freedom)
        low, high = law.cdf(np.array([self.low, self.high]) / self.scale)
        return np.clip(self.scale * law.ppf(low + u * (high - low)), self.low, self.high)

    def ln_density(self, x: float) -> float:
        """Ln of the density at a value within the bounds."""
        if math.isinf(self.scale):
            return -self.ln_mass
        z = x / self.scale
        ln_p = norm.logpdf(z) if math.isinf(self.freedom) else t.logpdf(z, self.freedom)
        return float(ln_p) - math.log(self.scale) - self.ln_mass

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
