"""The largest stable step of a body, and the term that sets it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsoro.simulation.material import Body, Prony

# Waves blew up at 0.993 to 1.024 in all of 14 measured cases (0 to 5 elements, Poisson ratio 0 to 0.49, both
# transfers, cells of 1 to 4 mm): ``python recipes/validate/simulator.py stability``.
STABLE_COURANT = 0.98


@dataclass(frozen=True, kw_only=True)
class Courant:
    """How near a step is to the stability limit, and the term that sets it."""

    number: float
    term: str


def courant(
    body: Body,
    prony: Prony | None,
    *,
    dt: float,
    cell: float,
    formulation: Literal["updated", "total"] = "updated",
) -> Courant:
    """Courant number of a step, which is stable below one.

    - Updated form: dt / dx [(1.4 K)^2 + (1.25 mu_dt)^2]^(1/4) / sqrt(rho). The two factors are fitted to the limits of
      quadratic B-splines on a grid.
    - Total-Lagrangian form: dt / dx sqrt(9/8 max(3 K, 2 mu_dt) / rho). Near rest no body is unstable below one,
      whatever its densities, since no particle by itself is. Surfaces set the limit, where nodes have little mass: a
      lone particle reaches it, five projected random designs were stable up to 1.01 to 1.65, full cubes up to 1.4 to
      1.8, and the interior alone would be up to 1.7 to 3.0. A chamber counts with its fictitious shear
      modulus, not with its air, whose pressure is uniform.

    A Maxwell element counts in mu_dt with what the fastest oscillation, that changes sign at every step, feels of it:
    g b 2 / (1 + a), not g. In the total-Lagrangian form a viscosity eta counts likewise, with 2 eta / dt.

    All of this is near rest, where stiffening (``Body.stiffening``) has no part: it raises the stiffness at stretch
    only, to more than mu (1 + a x + b x^2) along the stretch. A body that is pulled far needs a smaller step, and more
    so if it stiffens: free blocks flung to a stretch of 2.5 to 2.8 in the total-Lagrangian form diverged at 0.95 and
    not at 0.6 of the limit without stiffening, at 0.4 and not at 0.25 with a = 0.1, b = 0.02.

    Args:
        body: Particles.
        prony: Maxwell elements of the solids.
        dt: Step [s].
        cell: Grid cell [m].
        formulation: Which form of the simulator.

    Raises:
        ValueError: if there is no such formulation.
    """
    if formulation not in ("updated", "total"):
        raise ValueError(f'formulation = {formulation!r}: wanted "updated" or "total"')
    air = body.chamber >= 0
    shares = torch.zeros(1) if prony is None or not prony.elements else prony.step_moduli(dt)
    factor = 1 + float(shares.sum(-1).max())
    solid = "elastic waves in the solid"
    if factor > 1:
        element = int(shares.reshape(-1, shares.shape[-1]).amax(0).argmax()) + 1
        solid += f", stiffened {factor:.3g} times, most by Maxwell element {element}"
    if formulation == "total":
        return _total_courant(body, factor, solid, dt / cell, dt)
    density = (body.mass / body.volume).detach()
    bulk = 1.4 * body.bulk.detach()
    shear = 1.25 * factor * torch.where(air, torch.zeros_like(body.shear), body.shear).detach()
    numbers = torch.sqrt(torch.hypot(bulk, shear) / density) * dt / cell
    found = {
        term: float(numbers[..., mask].max())
        for term, mask in ((solid, ~air), ("pressure waves in the gas", air))
        if bool(mask.any())
    }
    eta = body.viscosity
    if eta is not None and bool((eta > 0).any()):
        found["viscosity"] = float((eta.detach() / density).max()) * 4 * dt / cell**2
    term = max(found, key=lambda name: found[name])
    return Courant(number=found[term], term=term)


# At a point of the lattice, the sum of grad N_i (x) grad N_i / N_i over its 27 nodes is (2 + 1/2 + 2) / dx^2 I. So no
# motion u has |grad u|^2 > 4.5 / dx^2 sum_i N_i |u_i|^2 there, and omega^2, the stiffness over the mass of all points,
# is at most 4.5 / dx^2 times the largest max(3 K, 2 mu) / rho. A step is stable up to omega dt = 2.
_TOTAL_LAGRANGIAN = 4.5 / 4


def _total_courant(body: Body, factor: float, solid: str, ratio: float, dt: float) -> Courant:
    """:func:`courant` in the total-Lagrangian form, for dt / dx = ``ratio`` and mu_dt = ``factor`` mu."""
    air = body.chamber >= 0
    zero = torch.zeros((), dtype=body.bulk.dtype, device=body.bulk.device)
    density = (body.mass / body.volume).detach()
    bulk = torch.where(air, zero, body.bulk.detach())
    shear = torch.where(air, body.shear, factor * body.shear).detach()
    eta, zeta = (
        zero if v is None else torch.where(air, zero, v.detach()) * 2 / dt
        for v in (body.viscosity, body.volume_viscosity)
    )

    def numbers(bulk: Tensor, shear: Tensor) -> Tensor:
        return ratio * torch.sqrt(_TOTAL_LAGRANGIAN * torch.maximum(3 * bulk, 2 * shear) / density)

    both = numbers(bulk + zeta, shear + eta)
    worst = int(both.argmax())
    number = float(both.reshape(-1)[worst])
    if float(numbers(bulk, shear).expand(both.shape).reshape(-1)[worst]) ** 2 < number**2 / 2:
        return Courant(number=number, term="viscosity")
    in_air = bool(air.expand(both.shape).reshape(-1)[worst])
    return Courant(number=number, term="elastic waves of the chambers' fictitious shear modulus" if in_air else solid)


def stable_step(
    body: Body, prony: Prony | None, *, cell: float, formulation: Literal["updated", "total"] = "updated"
) -> float:
    """Largest stable step [s] of a body on a grid, by bisection (the stiffness depends on the step)."""
    low, high = 0.0, 1.0
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        ok = courant(body, prony, dt=middle, cell=cell, formulation=formulation).number <= STABLE_COURANT
        low, high = (middle, high) if ok else (low, middle)
    return low
