"""Courant numbers of a step in both formulations, and the terms that set them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoro.simulation.loads import Attached
from torchsoro.simulation.material import Prony

# Waves blew up at 0.993 to 1.024 in all of 14 measured cases (0 to 5 elements, Poisson ratio 0 to 0.49, both
# transfers, cells of 1 to 4 mm): ``python recipes/validate/simulator.py stability``.
STABLE_COURANT = 0.98

# Explicit volume viscosity zeta of a cube of 8^3 particles blew up, within 400 steps, at zeta dt / (rho cell^2) = 0.39
# where waves do not count, at 0.146 where the square of their Courant number is 0.6.
DILATION = 2.6


@dataclass(frozen=True, kw_only=True)
class Courant:
    """How near a step is to the stability limit, and the term that sets it."""

    number: float
    term: str


def updated_courant(attached: Attached, prony: Prony | None, dt: float, cell: float) -> Courant:
    """Courant number of a step in the updated form; see ``stability.courant``."""
    body = attached.body
    air = body.gas
    factor, solid = _stiffened(prony, dt, body.shear.detach())
    density = (body.mass / body.volume).detach()
    bulk = 1.4 * body.bulk.detach()
    shear = 1.25 * factor * torch.where(air, torch.zeros_like(body.shear), body.shear).detach()
    squares = torch.hypot(bulk, shear) / density * (dt / cell) ** 2
    springs, drag = _of_springs(attached, dt), _of_drag(attached, dt)
    zeta = torch.zeros_like(density) if body.volume_viscosity is None else body.volume_viscosity.detach()
    spread = DILATION * zeta / density * dt / cell**2
    all_of_it = squares + springs + drag + spread
    square, place = _largest(all_of_it)
    waves = "pressure waves in the gas" if _at(air, all_of_it, place) else solid
    terms = ((waves, squares), ("springs", springs), ("drag", drag), ("volume viscosity", spread))
    parts = {name: _at(part, all_of_it, place) for name, part in terms}
    found = {max(parts, key=lambda name: parts[name]): square**0.5}
    eta = body.viscosity
    if eta is not None and bool((eta > 0).any()):
        found["viscosity"] = float((eta.detach() / density).max()) * 4 * dt / cell**2
    term = max(found, key=lambda name: found[name])
    return Courant(number=found[term], term=term)


# At a point of the lattice, the sum of grad N_i (x) grad N_i / N_i over its 27 nodes is (2 + 1/2 + 2) / dx^2 I. So no
# motion u has |grad u|^2 > 4.5 / dx^2 sum_i N_i |u_i|^2 there, and omega^2, the stiffness over the mass of all points,
# is at most 4.5 / dx^2 times the largest max(3 K, 2 mu) / rho. A step is stable up to omega dt = 2.
UNIFORM = 4.5


def total_courant(attached: Attached, prony: Prony | None, dt: float, steep: float) -> Courant:
    """Courant number of a step in the total-Lagrangian form; see ``stability.courant``.

    Args:
        attached: The body with its loads.
        prony: Maxwell elements.
        dt: [s].
        steep: The largest sum of N'^2 / N along an axis of the lattice [1/m2]; ``UNIFORM`` / cell^2 of uniform cells.
    """
    body = attached.body
    factor, solid = _stiffened(prony, dt, body.shear.detach())
    air = body.gas
    if body.air_share is not None and body.void_fraction is not None:  # whose law of void knows no Maxwell elements
        air = (body.air_share.detach() > 0) & (body.void_fraction.detach() == 1)
    zero = torch.zeros((), dtype=body.bulk.dtype, device=body.bulk.device)
    density = (body.mass / body.volume).detach()
    bulk = torch.where(air, zero, body.bulk.detach())
    shear = torch.where(air, body.shear, factor * body.shear).detach()
    eta, zeta = (
        zero if v is None else torch.where(air, zero, v.detach()) * 2 / dt
        for v in (body.viscosity, body.volume_viscosity)
    )

    def squares(bulk: Tensor, shear: Tensor) -> Tensor:
        return dt**2 * steep / 4 * torch.maximum(3 * bulk, 2 * shear) / density

    springs = _of_springs(attached, dt)
    all_of_it = squares(bulk + zeta, shear + eta) + springs
    square, place = _largest(all_of_it)
    elastic = _at(squares(bulk, shear), all_of_it, place)
    of_springs = _at(springs, all_of_it, place)
    waves = "elastic waves of the chambers' fictitious shear modulus" if _at(air, all_of_it, place) else solid
    parts = {waves: elastic, "springs": of_springs, "viscosity": square - elastic - of_springs}
    return Courant(number=square**0.5, term=max(parts, key=lambda name: parts[name]))


def _stiffened(prony: Prony | None, dt: float, like: Tensor) -> tuple[Tensor, str]:
    """mu_dt / mu [..., 1], and the words for what sets a limit by waves in the solid."""
    shares = torch.zeros(1) if prony is None or not prony.elements else prony.step_moduli(dt)
    factor = 1 + shares.sum(-1, keepdim=True).to(like)
    most, solid = float(factor.max()), "elastic waves in the solid"
    if most > 1:
        element = int(shares.reshape(-1, shares.shape[-1]).amax(0).argmax()) + 1
        solid += f", stiffened {most:.3g} times, most by Maxwell element {element}"
    return factor, solid


def _of_springs(attached: Attached, dt: float) -> Tensor:
    """What springs add to the square of the Courant number [..., N]."""
    if attached.spring is None:
        return torch.zeros_like(attached.body.mass.detach())
    return (attached.spring / attached.body.mass).detach() * dt**2 / 4


def _of_drag(attached: Attached, dt: float) -> Tensor:
    """What explicit drag adds to the square of the Courant number [..., N]."""
    if attached.drag is None:
        return torch.zeros_like(attached.body.mass.detach())
    return (attached.drag / attached.body.mass).detach() * dt / 2


def _largest(squares: Tensor) -> tuple[float, int]:
    """The largest of [..., N], and its place in the flattened tensor."""
    place = int(squares.argmax())
    return float(squares.reshape(-1)[place]), place


def _at(values: Tensor, like: Tensor, place: int) -> float:
    """The number at a place of the flattened tensor, of values that broadcast to its shape."""
    return float(torch.broadcast_tensors(values, like)[0].reshape(-1)[place])
