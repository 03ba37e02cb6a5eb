"""Consistency of measured curves with linear viscoelasticity, checked before superposition and fit.

Storage and loss modulus of a linear material satisfy the Kramers-Kronig relations: one non-negative relaxation spectrum
gives both. The least residual of any spectrum on an isothermal curve is a convex problem solved in milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchsoro.rheology.leastsquares import floor
from torchsoro.rheology.measured import Creep, Relaxation, Sweep
from torchsoro.rheology.residuals import relative_residuals

BEYOND = 100.0  # factor by which relaxation times may exceed the data window
LEAST = 5  # smallest number of points of all curves; fewer determine neither an element nor the noise
POINTS = 200  # largest number of points of a curve that are evaluated
SWAPPED = 0.5  # ratio of residuals with and without exchanged moduli below which they are reported as exchanged
POOR = 0.15  # root mean square of relative residuals from which on a fit is reported as poor
HOPELESS = 0.5  # root mean square of relative residuals from which on a curve is refused
AXIS = (1e-30, 1e30)  # valid range of frequency [rad/s] or time [s]; master curves span some 30 decades
MODULUS = (1e-9, 1.3e12)  # valid range [Pa]; the upper end is diamond's Young's modulus


def residual(curve: Sweep | Relaxation | Creep) -> float:
    """Root mean square of the relative residuals of the best non-negative spectrum; 0 for fewer than three points."""
    if len(getattr(curve, curve.axis)) < 3:
        return 0.0
    curve = _thinned(curve)
    problem = relative_residuals(curve, True)
    window = (problem.window[0] / BEYOND, problem.window[1] * BEYOND)
    return math.sqrt(floor(replace(problem, window=window)).error / len(problem.target))


def check_curves(where: str, curves: Sequence[Sweep] | Sequence[Relaxation] | Sequence[Creep]) -> None:
    """Refuse curves that are inconsistent with a linear viscoelastic material.

    Args:
        where: Origin of the curves for messages, such as the file.
        curves: Isothermal curves.

    Raises:
        ValueError: for fewer than five points; frequencies, times or moduli outside ``AXIS`` and ``MODULUS``; storage
            and loss modulus that are consistent only when exchanged; relative residuals of the best spectrum above
            ``HOPELESS`` (root mean square).
    """
    count = sum(len(getattr(curve, curve.axis)) for curve in curves)
    if count < LEAST:
        raise ValueError(f"{where}: {count} points, wanted at least {LEAST}")
    for curve in curves:
        at = f"{where}: the curve at {curve.temperature:.4g} deg C" if math.isfinite(curve.temperature) else where
        moduli = 1 / curve.compliance if isinstance(curve, Creep) else getattr(curve, curve.ordinates[0])
        axis = getattr(curve, curve.axis)
        for name, values, (least, most) in ((curve.axis, axis, AXIS), ("modulus", moduli, MODULUS)):
            if not (least <= values.min() and values.max() <= most):
                raise ValueError(
                    f"{at}: {name} from {values.min():.3g} to {values.max():.3g}, wanted from {least:g} to {most:g} "
                    "in SI units: are the units right? Declare them with --units"
                )
        if isinstance(curve, Sweep) and (zero := np.flatnonzero(curve.loss <= 0)).size:
            raise ValueError(
                f"{at}: loss modulus {curve.loss[zero[0]]:g} Pa at {curve.omega[zero[0]]:g} rad/s, wanted positive, as "
                "residuals are relative: leave the row out"
            )
        found = residual(curve)
        if found <= POOR:
            continue
        if isinstance(curve, Sweep):
            other = residual(replace(curve, storage=curve.loss, loss=curve.storage))
            if other < SWAPPED * found:
                raise ValueError(
                    f"{at}: no relaxation spectrum has this storage and loss modulus (residual {found:.0%}), one has "
                    f"them the other way round ({other:.0%}); wanted storage and loss in their own columns: are they "
                    "swapped? Name them with --columns"
                )
        if found > HOPELESS:
            raise ValueError(
                f"{at}: the best of all relaxation spectra misses the values by {found:.0%} (root mean square of "
                "relative residuals); wanted measurements of one linear viscoelastic material"
            )


def poor(error: float, values: int) -> str:
    """A remark on a fit of so many values with this sum of squared relative residuals; empty for a good fit."""
    rms = math.sqrt(error / values)
    if rms <= POOR:
        return ""
    return f"Poor fit: the Maxwell elements miss the measured values by {rms:.0%} (rms of the relative residuals). "


def _thinned(curve: Sweep | Relaxation | Creep) -> Sweep | Relaxation | Creep:
    """Curve reduced to at most ``POINTS`` points at equal index spacing."""
    names = (curve.axis, *curve.ordinates)
    count = len(getattr(curve, curve.axis))
    keep = np.unique(np.linspace(0, count - 1, min(count, POINTS)).round().astype(int))
    return replace(curve, **{name: getattr(curve, name)[keep] for name in names})
