"""Detection of terminal flow: power laws of a liquid, which has no equilibrium modulus, at the slow end of a curve.

In the terminal zone of a liquid G' ~ w^2, G'' ~ w and J ~ t. In a critical gel G' and G'' follow one power below 1
(Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import linregress
from scipy.stats import t as student

from torchsoro.rheology.measured import Creep, Relaxation, Sweep

SPAN = 10.0  # factor of frequency or time over which the slopes are taken: the slowest decade
LEAST = 5  # smallest number of points of a slope
LEVEL = 0.95  # confidence level of the slopes
STORAGE_SLOPE = 1.0  # d ln G' / d ln w above which the curve ends in flow: solids and gels stay below
CREEP_SLOPE = 0.9  # d ln J / d ln t above which the curve ends in flow


@dataclass(frozen=True, kw_only=True)
class Slope:
    """Exponent of the power law of a modulus or compliance over the slowest decade.

    Attributes:
        value: Exponent.
        error: Half width of its 95 % confidence interval.
    """

    value: float
    error: float

    def __str__(self) -> str:
        """Value and half width."""
        return f"{self.value:.3g} +- {self.error:.1g}"


@dataclass(frozen=True, kw_only=True)
class Flow:
    """Terminal flow of a curve.

    Attributes:
        slopes: Exponents of storage and loss modulus over frequency, or of the compliance over time.
        viscosity: G'' / w or t / J [Pa s]: the zero-shear viscosity for data in shear, the elongational viscosity for
            data in tension.
        time: Mean relaxation time G' / (w G'') [s]; nan for creep.
    """

    slopes: tuple[Slope, ...]
    viscosity: float
    time: float

    @property
    def sentence(self) -> str:
        """Exponents and viscosity in words."""
        if len(self.slopes) == 1:
            how = (
                f"over the last decade of time the compliance follows the power {self.slopes[0]} of it (1 in a liquid)"
            )
        else:
            storage, loss = self.slopes
            how = (
                f"over the lowest decade of frequency the storage modulus follows the power {storage} of frequency and "
                f"the loss modulus the power {loss} (2 and 1 in a liquid; 0 for the storage modulus of a solid)"
            )
        return f"Terminal flow: {how}. A melt has no equilibrium modulus; its viscosity is {self.viscosity:.2g} Pa s. "


def terminal_flow(curve: Sweep | Relaxation | Creep) -> Flow | None:
    """Detect terminal flow at the slow end of a curve.

    Over the slowest decade, a sweep flows if the loss modulus exceeds the storage modulus and the exponent of the
    storage modulus is above 1 with 95 % confidence; creep, if the exponent of the compliance is above 0.9. Stress
    relaxation is not classified: the modulus of a solid with a small equilibrium modulus can fall equally fast.

    Args:
        curve: Measured curve or master curve.

    Returns:
        Exponents and viscosity; None without terminal flow, for stress relaxation, or for fewer than five points.
    """
    if isinstance(curve, Relaxation):
        return None
    if isinstance(curve, Creep):
        late = _slowest(1 / curve.time)
        if late is None:
            return None
        slope = _slope(curve.time[late], curve.compliance[late])
        viscosity = float(np.median(curve.time[late] / curve.compliance[late]))
        flows = slope.value - slope.error > CREEP_SLOPE
        return Flow(slopes=(slope,), viscosity=viscosity, time=float("nan")) if flows else None
    low = _slowest(curve.omega)
    if low is None or not (curve.loss[low] > curve.storage[low]).all():
        return None
    omega, storage, loss = curve.omega[low], curve.storage[low], curve.loss[low]
    slopes = _slope(omega, storage), _slope(omega, loss)
    if not slopes[0].value - slopes[0].error > STORAGE_SLOPE:
        return None
    viscosity, time = float(np.median(loss / omega)), float(np.median(storage / (omega * loss)))
    return Flow(slopes=slopes, viscosity=viscosity, time=time)


def _slowest(omega: np.ndarray) -> np.ndarray | None:
    """Indices of the slowest decade, at least ``LEAST`` points; None for fewer points."""
    order = np.argsort(omega)
    count = max(int((omega <= SPAN * omega.min()).sum()), LEAST)
    return order[:count] if len(omega) >= LEAST else None


def _slope(x: np.ndarray, y: np.ndarray) -> Slope:
    found: Any = linregress(np.log(x), np.log(y))
    quantile = float(student.ppf((1 + LEVEL) / 2, len(x) - 2))
    return Slope(value=float(found.slope), error=quantile * float(found.stderr))
