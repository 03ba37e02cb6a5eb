"""Terminal flow: whether the slow end of a curve is that of a liquid, which has no equilibrium modulus.

At low frequency G' of a liquid falls as w^2 and G'' as w; at long times its compliance grows as t. No critical gel,
whose G' and G'' share one power below 1, reaches that (Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import linregress
from scipy.stats import t as student

from torchsoro.rheology.measured import Creep, Relaxation, Sweep

SPAN = 10.0  # factor of frequency or time over which the slopes are taken: the slowest decade
LEAST = 5  # points that a slope is taken of
LEVEL = 0.95  # of the intervals
STORAGE_SLOPE = 1.0  # d ln G' / d ln w above which no solid and no gel stays down to its low end
CREEP_SLOPE = 0.9  # d ln J / d ln t likewise


@dataclass(frozen=True, kw_only=True)
class Slope:
    """Power of frequency or time with which a modulus or compliance changes over the slowest decade.

    Attributes:
        value: Exponent.
        error: Half width of its 95 % interval.
    """

    value: float
    error: float

    def __str__(self) -> str:
        """Value and half width."""
        return f"{self.value:.3g} +- {self.error:.1g}"


@dataclass(frozen=True, kw_only=True)
class Flow:
    """A curve that ends in flow.

    Attributes:
        slopes: Of storage and loss modulus over frequency, or of the compliance over time.
        viscosity: Zero-shear viscosity, or a third of Trouton's in tension as measured: G'' / w or t / J [Pa s].
        time: Mean relaxation time G' / (w G''), which the recoverable strain takes [s]; nan of creep.
    """

    slopes: tuple[Slope, ...]
    viscosity: float
    time: float

    @property
    def sentence(self) -> str:
        """The finding in words."""
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
    """Find whether a curve's slow end is that of a liquid, as far as the data reach.

    A sweep ends in flow if its loss modulus exceeds the storage modulus there and the storage modulus' exponent is
    above 1 with 95 % confidence; creep if the compliance's is above 0.9. Of relaxation nothing is said: its modulus
    falls as fast in a solid that has an equilibrium modulus below what was measured.

    Args:
        curve: Measured, or a master curve.

    Returns:
        Exponents and viscosity; None if it does not flow, or for fewer than five points.
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
    """Indices of the slowest decade, or of the slowest points if it holds few; None for too few points."""
    order = np.argsort(omega)
    count = max(int((omega <= SPAN * omega.min()).sum()), LEAST)
    return order[:count] if len(omega) >= LEAST else None


def _slope(x: np.ndarray, y: np.ndarray) -> Slope:
    found: Any = linregress(np.log(x), np.log(y))
    quantile = float(student.ppf((1 + LEVEL) / 2, len(x) - 2))
    return Slope(value=float(found.slope), error=quantile * float(found.stderr))
