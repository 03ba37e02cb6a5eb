"""Relative residuals between a relaxation or retardation spectrum and a measured curve."""

from __future__ import annotations

import math

import numpy as np

from torchsoro.rheology.leastsquares import Problem
from torchsoro.rheology.measured import Creep, Relaxation, Sweep


def relative_residuals(
    data: Sweep | Relaxation | Creep, equilibrium: bool | float, window: tuple[float, float] | None = None
) -> Problem:
    """Least-squares problem of Eq. 17c for a sweep, and its analogue for stress relaxation and creep.

    For creep the terms are J_k (1 - exp(-t / lambda_k)), preceded by the instantaneous compliance and, without an
    equilibrium modulus, the viscous flow t / eta.

    Args:
        data: Measured curve.
        equilibrium: Whether an equilibrium modulus is fitted, or its fixed value [Pa].
        window: Shortest and longest time constant of a term [s]; the range of the data if None.

    Raises:
        ValueError: for less than two points, a loss modulus of zero, or an equilibrium modulus that cannot be held.
    """
    axis = data.omega if isinstance(data, Sweep) else data.time
    if isinstance(data, Sweep):
        curves = (data.storage, data.loss)
    else:
        curves = (data.modulus if isinstance(data, Relaxation) else data.compliance,)
    measured = np.concatenate(curves)
    if len(axis) < 2:
        raise ValueError("data: one point, wanted at least 2")
    zero = np.flatnonzero(measured <= 0)
    if len(zero):
        at = f"loss modulus {measured[zero[0]]:g} Pa at {axis[zero[0] % len(axis)]:g} rad/s"
        raise ValueError(f"data: {at}, wanted positive, as the residuals are relative: leave the point out")
    if isinstance(data, Creep) and not isinstance(equilibrium, bool):
        raise ValueError(f"equilibrium = {equilibrium}: wanted True or False for creep")
    permanent = np.concatenate([np.ones(len(axis)), np.zeros(len(measured) - len(axis))]) / measured
    held = 0.0 if isinstance(equilibrium, bool) else float(equilibrium)
    if not (math.isfinite(held) and held >= 0):
        raise ValueError(f"equilibrium = {equilibrium}: wanted True, False or at least 0 Pa")

    def waves(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wt = axis[:, None] * times
        part = 1 / (1 + wt * wt)
        slope = np.concatenate([2 * wt * wt * part**2, wt * (1 - wt * wt) * part**2])
        return np.concatenate([wt * wt * part, wt * part]) / measured[:, None], slope / measured[:, None]

    def decays(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ratio = axis[:, None] / times
        value = np.exp(-ratio) / measured[:, None]
        return value, value * ratio

    def creeps(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = decays(times)
        return 1 / measured[:, None] - value, -slope

    constant = permanent if equilibrium is True else None
    if isinstance(data, Creep):
        constant = np.stack([permanent] if equilibrium else [permanent, axis / measured], axis=1)
    seen = (1 / axis[-1], 1 / axis[0]) if isinstance(data, Sweep) else (axis[0], axis[-1])
    return Problem(
        columns=waves if isinstance(data, Sweep) else decays if isinstance(data, Relaxation) else creeps,
        constant=constant,
        target=1 - held * permanent,
        window=window or (float(seen[0]), float(seen[1])),
        curves=len(curves),
    )
