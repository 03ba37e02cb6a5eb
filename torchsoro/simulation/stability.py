"""The largest stable step of a body, and the term that sets it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchsoro.simulation.loads import Attached, Load, attach
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
    loads: Sequence[Load] = (),
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

    Springs of stiffness k on particles of mass m add dt^2 k / (4 m) to the square of the number, for no motion of the
    nodes stretches a particle's spring by more than the nodes around it move. Drag c, which the updated form takes
    explicitly, adds dt c / (2 m); the total-Lagrangian form takes it implicitly, at any step. Contact and adhesion only
    take speed away and set no limit.

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
        loads: What is attached; point masses make particles slower.

    Raises:
        ValueError: if there is no such formulation, or for bad loads.
    """
    _check(formulation)
    return _courant(attach(body, loads), prony, dt, cell, formulation)


def _check(formulation: str) -> None:
    if formulation not in ("updated", "total"):
        raise ValueError(f'formulation = {formulation!r}: wanted "updated" or "total"')


def _courant(attached: Attached, prony: Prony | None, dt: float, cell: float, formulation: str) -> Courant:
    """:func:`courant` of a body with its loads."""
    body = attached.body
    air = body.chamber >= 0
    shares = torch.zeros(1) if prony is None or not prony.elements else prony.step_moduli(dt)
    factor = 1 + float(shares.sum(-1).max())
    solid = "elastic waves in the solid"
    if factor > 1:
        element = int(shares.reshape(-1, shares.shape[-1]).amax(0).argmax()) + 1
        solid += f", stiffened {factor:.3g} times, most by Maxwell element {element}"
    if formulation == "total":
        return _total_courant(attached, factor, solid, dt / cell, dt)
    density = (body.mass / body.volume).detach()
    bulk = 1.4 * body.bulk.detach()
    shear = 1.25 * factor * torch.where(air, torch.zeros_like(body.shear), body.shear).detach()
    squares = torch.hypot(bulk, shear) / density * (dt / cell) ** 2
    springs, drag = _of_springs(attached, dt), _of_drag(attached, dt)
    all_of_it = squares + springs + drag
    square, place = _largest(all_of_it)
    waves = "pressure waves in the gas" if _at(air, all_of_it, place) else solid
    parts = {
        name: _at(part, all_of_it, place) for name, part in ((waves, squares), ("springs", springs), ("drag", drag))
    }
    found = {max(parts, key=lambda name: parts[name]): square**0.5}
    eta = body.viscosity
    if eta is not None and bool((eta > 0).any()):
        found["viscosity"] = float((eta.detach() / density).max()) * 4 * dt / cell**2
    term = max(found, key=lambda name: found[name])
    return Courant(number=found[term], term=term)


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
    return float(torch.broadcast_to(values, torch.broadcast_shapes(values.shape, like.shape)).reshape(-1)[place])


# At a point of the lattice, the sum of grad N_i (x) grad N_i / N_i over its 27 nodes is (2 + 1/2 + 2) / dx^2 I. So no
# motion u has |grad u|^2 > 4.5 / dx^2 sum_i N_i |u_i|^2 there, and omega^2, the stiffness over the mass of all points,
# is at most 4.5 / dx^2 times the largest max(3 K, 2 mu) / rho. A step is stable up to omega dt = 2.
_TOTAL_LAGRANGIAN = 4.5 / 4


def _total_courant(attached: Attached, factor: float, solid: str, ratio: float, dt: float) -> Courant:
    """:func:`courant` in the total-Lagrangian form, for dt / dx = ``ratio`` and mu_dt = ``factor`` mu."""
    body = attached.body
    air = body.chamber >= 0
    zero = torch.zeros((), dtype=body.bulk.dtype, device=body.bulk.device)
    density = (body.mass / body.volume).detach()
    bulk = torch.where(air, zero, body.bulk.detach())
    shear = torch.where(air, body.shear, factor * body.shear).detach()
    eta, zeta = (
        zero if v is None else torch.where(air, zero, v.detach()) * 2 / dt
        for v in (body.viscosity, body.volume_viscosity)
    )

    def squares(bulk: Tensor, shear: Tensor) -> Tensor:
        return ratio**2 * _TOTAL_LAGRANGIAN * torch.maximum(3 * bulk, 2 * shear) / density

    springs = _of_springs(attached, dt)
    all_of_it = squares(bulk + zeta, shear + eta) + springs
    square, place = _largest(all_of_it)
    elastic = _at(squares(bulk, shear), all_of_it, place)
    of_springs = _at(springs, all_of_it, place)
    waves = "elastic waves of the chambers' fictitious shear modulus" if _at(air, all_of_it, place) else solid
    parts = {waves: elastic, "springs": of_springs, "viscosity": square - elastic - of_springs}
    return Courant(number=square**0.5, term=max(parts, key=lambda name: parts[name]))


def stable_step(
    body: Body,
    prony: Prony | None,
    *,
    cell: float,
    formulation: Literal["updated", "total"] = "updated",
    loads: Sequence[Load] = (),
) -> float:
    """Largest stable step [s] of a body with its loads, by bisection (see :func:`courant`).

    Raises:
        ValueError: see :func:`courant`.
    """
    _check(formulation)
    attached = attach(body, loads)
    low, high = 0.0, 1.0
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        ok = _courant(attached, prony, middle, cell, formulation).number <= STABLE_COURANT
        low, high = (middle, high) if ok else (low, middle)
    return low
