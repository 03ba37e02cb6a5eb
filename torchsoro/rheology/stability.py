"""Moduli and stable steps of a solid with any number of Maxwell elements; the simulator's ``Prony`` takes five."""

from __future__ import annotations

import math

import numpy as np
import torch

from torchsoro.simulation.formulation import FormulationName
from torchsoro.simulation.material import Body, Solid
from torchsoro.simulation.stability import STABLE_COURANT, courant


def moduli_over(moduli: np.ndarray, times: np.ndarray, omega: np.ndarray, viscous: float = 0.0) -> np.ndarray:
    """Storage and loss modulus over the equilibrium modulus [2, n]; ``viscous`` is viscosity over that modulus [s]."""
    wt = omega[:, None] * times
    part = moduli * wt / (1 + wt * wt)
    return np.stack([1 + (part * wt).sum(-1), part.sum(-1) + viscous * omega])


def felt_share(times: np.ndarray, dt: float) -> np.ndarray:
    """Effective share of a modulus at time step dt: 2 b / (1 + a), a = exp(-dt / tau), b = (1 - a) tau / dt."""
    half = dt / (2 * times)
    return np.tanh(half) / half


def courant_number(
    solid: Solid, felt: float, *, dt: float, cell: float, formulation: FormulationName, viscosity: float = 0.0
) -> float:
    """Courant number of one particle of the solid with Maxwell elements of effective relative modulus ``felt``."""
    one = torch.ones(1, dtype=torch.float64)
    body = Body(
        position=torch.zeros(1, 3, dtype=torch.float64),
        mass=one * solid.density,
        volume=one,
        bulk=one * solid.bulk,
        shear=one * solid.shear * (1 + felt),
        chamber=torch.full((1,), -1, dtype=torch.int32),
        viscosity=one * viscosity,
    )
    return courant(body, None, dt=dt, cell=cell, formulation=formulation).number


def largest_step(
    solid: Solid,
    moduli: np.ndarray,
    times: np.ndarray,
    *,
    cell: float,
    formulation: FormulationName,
    viscosity: float = 0.0,
) -> float:
    """Largest stable step [s], by bisection in log time; as ``torchsoro.simulation.stability.stable_step``."""
    low, high = math.log(1e-15), 0.0
    while high - low > 1e-5:
        dt = math.exp((low + high) / 2)
        felt = float((moduli * felt_share(times, dt)).sum())
        ok = (
            courant_number(solid, felt, dt=dt, cell=cell, formulation=formulation, viscosity=viscosity)
            <= STABLE_COURANT
        )
        low, high = ((low + high) / 2, high) if ok else (low, (low + high) / 2)
    return math.exp(low)
