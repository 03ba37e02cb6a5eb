"""From density to particle coefficients: solid, Prony series, gas, the filled body, and the step that they allow."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from torch import Tensor

from torchsoro.domain import Domain, Region

# Table S1 of the paper: moduli relative to the instantaneous one, relaxation times in s.
_TABLE_S1_EQUILIBRIUM = 9.06e-4
_TABLE_S1 = ((6.36e-4, 2.73e-1), (2.09e-3, 7.56e-3), (1.27e-2, 2.09e-4), (1.25e-1, 5.77e-6), (8.59e-1, 1.59e-7))

# Least a / sqrt(b) of a law that stiffens by a x + b x^2 and whose stress falls nowhere: it is -1.49 for simple shear,
# -1.41 at the worst b for tension and compression, -1.32 for equibiaxial tension.
SOFTEST = 1.3


@dataclass(frozen=True, kw_only=True)
class Solid:
    """Nearly incompressible solid, neo-Hookean (Eqs. 3-7) or Yeoh's; the defaults are the paper's printed resin.

    With stretch the shear modulus grows to mu (1 + a x + b x^2), x = I1b - 3 the first isochoric invariant less three:
    Yeoh's law with C10 = mu / 2, C20 = a mu / 4 and C30 = b mu / 6. Moduli are those at rest.

    Attributes:
        youngs_modulus: Equilibrium Young's modulus [Pa].
        poisson_ratio: Poisson ratio, 0 to below 0.5.
        density: [kg/m3].
        linear_stiffening: a.
        quadratic_stiffening: b.

    Raises:
        ValueError: for a number that is not finite and positive, a Poisson ratio outside [0, 0.5), or stiffening with
            which some stretch makes the solid softer than it bears: b < 0, or a < -1.3 sqrt(b). Above that, tested for
            an incompressible solid, the stress grows with every stretch and shear.
    """

    youngs_modulus: float = 0.44e6
    poisson_ratio: float = 0.4
    density: float = 1070.0
    linear_stiffening: float = 0.0
    quadratic_stiffening: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        _positive("youngs_modulus", self.youngs_modulus)
        _positive("density", self.density)
        if not 0 <= self.poisson_ratio < 0.5:
            raise ValueError(f"poisson_ratio = {self.poisson_ratio}: wanted at least 0 and less than 0.5")
        a, b = self.linear_stiffening, self.quadratic_stiffening
        if not (math.isfinite(a) and 0 <= b < math.inf and a >= -SOFTEST * math.sqrt(b)):
            raise ValueError(
                f"linear_stiffening, quadratic_stiffening = {a}, {b}: wanted a, b with b >= 0 and a >= -1.3 sqrt(b), "
                "or the stress falls at some stretch"
            )

    @property
    def shear(self) -> float:
        """Equilibrium shear modulus mu [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def bulk(self) -> float:
        """Bulk modulus K [Pa]."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))


@dataclass(frozen=True, kw_only=True)
class Gas:
    """Air in a chamber (Eqs. 9-10); the defaults are the paper's.

    Attributes:
        stiffness: k [Pa]; 0 for a regulated supply, 0.14 MPa for sealed air.
        viscosity: Shear viscosity mu_v [Pa s].
        volume_viscosity: zeta [Pa s].
        density: [kg/m3]; artificially high, as the updated form's stable step falls with its square root. The
            total-Lagrangian form stands ``AIR``, which is next to nothing.
        filler: Shear modulus of what keeps a chamber's points apart in the total-Lagrangian form, where the pressure
            is uniform and air has no stiffness of its own against distortion [Pa].

    Raises:
        ValueError: for a number that is not finite or negative (density: not positive).
    """

    stiffness: float = 0.14e6
    viscosity: float = 1.83e-5
    volume_viscosity: float = 0.0
    density: float = 100.0
    filler: float = 3e3

    def __post_init__(self) -> None:
        """Check the numbers."""
        _positive("density", self.density)
        for name in ("stiffness", "viscosity", "volume_viscosity", "filler"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} = {value}: wanted finite and at least 0")


@dataclass(frozen=True, kw_only=True, eq=False)
class Prony:
    """Maxwell elements beside the equilibrium spring: moduli *relative to the equilibrium modulus*.

    Attributes:
        moduli: g_i / g_inf [..., M], may require grad.
        times: Relaxation times tau_i [..., M] in s, may require grad.

    Raises:
        ValueError: for shapes that differ, more than five elements, negative moduli or times that are not positive.
    """

    moduli: Tensor
    times: Tensor

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        if self.moduli.shape != self.times.shape or self.moduli.ndim < 1 or self.moduli.shape[-1] > 5:
            raise ValueError(
                f"moduli, times: shapes {tuple(self.moduli.shape)} and {tuple(self.times.shape)}, "
                "wanted the same shape [..., M] with M from 0 to 5"
            )
        if not bool((torch.isfinite(self.moduli) & (self.moduli >= 0)).all()):
            raise ValueError(f"moduli = {self.moduli.tolist()}: wanted finite and at least 0")
        if not bool((torch.isfinite(self.times) & (self.times > 0)).all()):
            raise ValueError(f"times = {self.times.tolist()}: wanted finite and positive")

    @classmethod
    def paper(cls, elements: int = 3) -> Prony:
        """The first elements of the paper's Table S1, whose moduli are relative to the instantaneous modulus.

        Read literally against an equilibrium modulus of 0.44 MPa, the robot would collapse under its weight; so each
        is divided by the table's equilibrium entry.

        Raises:
            ValueError: if ``elements`` is not 0 to 5.
        """
        if elements not in range(6):
            raise ValueError(f"elements = {elements}: wanted 0 to 5, Table S1 has five")
        table = torch.tensor(_TABLE_S1[:elements], dtype=torch.float64).reshape(elements, 2)
        return cls(moduli=table[:, 0] / _TABLE_S1_EQUILIBRIUM, times=table[:, 1].clone())

    @property
    def elements(self) -> int:
        """Number of Maxwell elements."""
        return self.moduli.shape[-1]

    def discrete(self, dt: float) -> Tensor:
        """Numbers of the exact-exponential update [..., M, 3]: a = exp(-dt/tau), b = (1 - a) tau / dt, g.

        H <- a H + b (S_new - S_old) integrates Eq. 8 exactly for a strain that changes linearly in a step.
        """
        ratio = dt / self.times
        return torch.stack([torch.exp(-ratio), -torch.expm1(-ratio) / ratio, self.moduli], dim=-1)

    def storage_loss(self, omega: Tensor) -> tuple[Tensor, Tensor]:
        """Storage and loss modulus over the equilibrium modulus at angular frequencies [rad/s] (Eqs. 17a, 17b)."""
        wt = omega.unsqueeze(-1) * self.times
        part = self.moduli * wt / (1 + wt * wt)
        return 1 + (part * wt).sum(-1), part.sum(-1)

    def step_moduli(self, dt: float) -> Tensor:
        """What an oscillation that changes sign at every step of dt feels of each element [..., M]: g b 2 / (1 + a)."""
        a, b, g = self.discrete(dt).detach().unbind(-1)
        return g * b * 2 / (1 + a)


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Particles and their coefficients; every tensor but ``chamber`` may require grad and have a leading batch.

    Attributes:
        position: [..., N, 3] m.
        mass: [..., N] kg.
        volume: [..., N] m3, in the reference state.
        bulk: K of a solid, k of a gas [..., N] Pa.
        shear: mu of a solid, of a gas that of its filler (see :class:`Gas`) [..., N] Pa.
        chamber: int32 [N], -1 for solid, else the gas chamber's number.
        velocity: [..., N, 3] m/s; at rest if None.
        viscosity: [..., N] Pa s; 0 if None. Solids may have one too.
        volume_viscosity: [..., N] Pa s; 0 if None.
        filler: Share of a solid's stress that comes from the law of void, which can stand being turned inside out
            [..., N], 0 to 1; 0 if None. See :func:`fill`.
        drag: Drag coefficient [..., N] N s/m; 0 if None.
        stiffening: a and b of a solid, by which mu grows to mu (1 + a x + b x^2) at x = I1b - 3 (see :class:`Solid`)
            [..., N, 2], of any sign; 0 if None, which is neo-Hookean. The Maxwell elements stiffen alike.
    """

    position: Tensor
    mass: Tensor
    volume: Tensor
    bulk: Tensor
    shear: Tensor
    chamber: Tensor
    velocity: Tensor | None = None
    viscosity: Tensor | None = None
    volume_viscosity: Tensor | None = None
    filler: Tensor | None = None
    drag: Tensor | None = None
    stiffening: Tensor | None = None


def simp(gamma: Tensor, *, epsilon: float = 1e-5, power: float = 3.0) -> Tensor:
    """Interpolation between void and solid, (1 - epsilon) gamma^power + epsilon (Eq. 11).

    Args:
        gamma: Density field in [0, 1], any shape.
        epsilon: What the void keeps, relative to the solid.
        power: 3 in the paper, so that intermediate densities carry little.

    Raises:
        ValueError: if epsilon is not in (0, 1) or power not positive.
    """
    if not 0 < epsilon < 1:
        raise ValueError(f"epsilon = {epsilon}: wanted more than 0 and less than 1")
    _positive("power", power)
    return (1 - epsilon) * gamma**power + epsilon


VOID_DRAG = 1e3  # drag over mass of void, and of the air in a chamber [1/s]
# Density of air in the total-Lagrangian form [kg/m3]: of next to no weight, yet the filler's waves are slower than the
# solid's.
AIR = 3.0


def fill(
    domain: Domain,
    gamma: Tensor,
    *,
    solid: Solid,
    gas: Gas | None = None,
    epsilon: float = 1e-5,
    power: float = 3.0,
    filler: tuple[float, float] | None = None,
) -> Body:
    """Fill a domain with material: mass and moduli interpolated by density (Eq. 11), gas in the chambers.

    Stiffening is relative to the modulus, and so does not change with the density.

    Args:
        domain: Lattice and regions.
        gamma: Density of every particle [..., N]; differentiable. Gas particles ignore theirs.
        solid: The printed material.
        gas: The chambers' gas; the paper's if None.
        epsilon: See :func:`simp`.
        power: See :func:`simp`.
        filler: Densities between which the stress goes over, smoothly, from the law of void to that of the solid. In a
            finite-strain law void of next to no stiffness is crushed and turned inside out; the law of void stands
            that. Void and chambers are slowed down, too, at ``VOID_DRAG`` times the mass of void or of air of at most
            ``AIR``, lest light outer ends crack like whips and the filler of a chamber flutter. None for the solid's
            law everywhere.

    Returns:
        A body on gamma's device and in its precision.

    Raises:
        ValueError: if gamma's last axis is not the particles, or ``filler`` is not two increasing densities.
    """
    if filler is not None and not 0 <= filler[0] < filler[1] <= 1:
        raise ValueError(f"filler = {filler}: wanted two increasing densities from 0 to 1")
    if gamma.shape[-1] != domain.count:
        raise ValueError(
            f"gamma: shape {tuple(gamma.shape)}, wanted [..., {domain.count}], one value for each particle"
        )
    gas = gas or Gas()
    like = {"dtype": gamma.dtype, "device": gamma.device}
    air = (domain.region == Region.GAS).to(gamma.device)
    scale = simp(gamma, epsilon=epsilon, power=power)
    zero = torch.zeros((), **like)
    void = None if filler is None else torch.where(air, zero, _void(gamma, *filler))
    numbers = torch.tensor([solid.linear_stiffening, solid.quadratic_stiffening], **like)
    stiffening = torch.where(air[:, None], zero, numbers) if bool(numbers.any()) else None
    mass = domain.volume * torch.where(air, torch.tensor(gas.density, **like), solid.density * scale)
    return Body(
        position=domain.positions.to(**like),
        mass=mass,
        volume=torch.full((domain.count,), domain.volume, **like),
        bulk=torch.where(air, torch.tensor(gas.stiffness, **like), solid.bulk * scale),
        shear=torch.where(air, torch.tensor(gas.filler, **like), solid.shear * scale),
        chamber=domain.chamber.to(device=gamma.device, dtype=torch.int32),
        viscosity=torch.where(air, torch.tensor(gas.viscosity, **like), zero),
        volume_viscosity=torch.where(air, torch.tensor(gas.volume_viscosity, **like), zero),
        filler=void,
        drag=None if void is None else VOID_DRAG * torch.where(air, domain.volume * min(gas.density, AIR), mass * void),
        stiffening=stiffening,
    )


def without_void(body: Body) -> tuple[Body, Tensor]:
    """Leave out the particles that follow the law of void alone: they carry next to nothing, but take as long.

    Args:
        body: As from :func:`fill` with ``filler``, without a batch.

    Returns:
        The body of the others, and which those are, bool [N].
    """
    if body.filler is None:
        return body, torch.ones_like(body.chamber, dtype=torch.bool)
    keep = body.filler < 1
    return part(body, keep), keep


def part(body: Body, keep: Tensor) -> Body:
    """The particles of a body, without a batch, that are to be kept, bool [N]."""
    given = {field.name: value[keep] for field in fields(Body) if (value := getattr(body, field.name)) is not None}
    return replace(body, **given)


def _void(gamma: Tensor, low: float, high: float) -> Tensor:
    """Smooth step from 1 at the lower density to 0 at the upper."""
    x = ((gamma - low) / (high - low)).clamp(0, 1)
    return 1 - x * x * (3 - 2 * x)


# Waves blew up at 0.993 to 1.024 in all of 14 measured cases (0 to 5 elements, Poisson ratio 0 to 0.49, both
# transfers, cells of 1 to 4 mm): ``python recipes/validate.py stability``.
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
      1.8, and the interior alone would be up to 1.7 to 3.0. A chamber counts with the filler in it, not with its air,
      whose pressure is uniform.

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
    return Courant(number=number, term="elastic waves in the filler of the chambers" if in_air else solid)


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


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} = {value}: wanted finite and positive")
