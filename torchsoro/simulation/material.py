"""What a body is made of: solid, Prony series, gas, and the particles with their coefficients."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass

import torch
from torch import Tensor

# Table S1 of the paper: moduli relative to the instantaneous one, relaxation times in s.
_TABLE_S1_EQUILIBRIUM = 9.06e-4
_TABLE_S1 = ((6.36e-4, 2.73e-1), (2.09e-3, 7.56e-3), (1.27e-2, 2.09e-4), (1.25e-1, 5.77e-6), (8.59e-1, 1.59e-7))

# Least a / sqrt(b) of a law that stiffens by a x + b x^2 and whose stress falls nowhere: it is -1.49 for simple shear,
# -1.41 at the worst b for tension and compression, -1.32 for equibiaxial tension.
SOFTEST = 1.3

Number = float | Tensor  # a number, or a floating-point tensor without axes, which may require grad


@dataclass(frozen=True, kw_only=True)
class Solid:
    """Nearly incompressible solid, neo-Hookean (Eqs. 3-7) or Yeoh's; the defaults are the paper's printed resin.

    With stretch the shear modulus grows to mu (1 + a x + b x^2), x = I1b - 3 the first isochoric invariant less three:
    Yeoh's law with C10 = mu / 2, C20 = a mu / 4 and C30 = b mu / 6. Moduli are those at rest. Every number may be a
    tensor without axes; :func:`fill` carries its gradient to the particles.

    Attributes:
        youngs_modulus: Equilibrium Young's modulus [Pa].
        poisson_ratio: Poisson ratio, 0 to below 0.5.
        density: [kg/m3].
        linear_stiffening: a.
        quadratic_stiffening: b.

    Raises:
        ValueError: for a number that is not finite and positive, a Poisson ratio outside [0, 0.5), a tensor with axes
            or of integers, or stiffening with which some stretch makes the solid softer than it bears: b < 0, or
            a < -1.3 sqrt(b). Above that, tested for an incompressible solid, the stress grows with every stretch and
            shear.
    """

    youngs_modulus: Number = 0.44e6
    poisson_ratio: Number = 0.4
    density: Number = 1070.0
    linear_stiffening: Number = 0.0
    quadratic_stiffening: Number = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        _positive("youngs_modulus", self.youngs_modulus)
        _positive("density", self.density)
        poisson_ratio = value_of("poisson_ratio", self.poisson_ratio)
        if not 0 <= poisson_ratio < 0.5:
            raise ValueError(f"poisson_ratio = {poisson_ratio}: wanted at least 0 and less than 0.5")
        a, b = (value_of(name, getattr(self, name)) for name in ("linear_stiffening", "quadratic_stiffening"))
        if not (math.isfinite(a) and 0 <= b < math.inf and a >= -SOFTEST * math.sqrt(b)):
            raise ValueError(
                f"linear_stiffening, quadratic_stiffening = {a}, {b}: wanted a, b with b >= 0 and a >= -1.3 sqrt(b), "
                "or the stress falls at some stretch"
            )

    @property
    def shear(self) -> Number:
        """Equilibrium shear modulus mu [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def bulk(self) -> Number:
        """Bulk modulus K [Pa]."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))


@dataclass(frozen=True, kw_only=True)
class Gas:
    """Air in a chamber (Eqs. 9-10); the defaults are the paper's. Every number may be a tensor, as those of a solid.

    Attributes:
        stiffness: k [Pa]; 0 for a regulated supply, 0.14 MPa for sealed air.
        viscosity: Shear viscosity mu_v [Pa s], in the updated form; the total-Lagrangian one has none of a gas.
        volume_viscosity: zeta [Pa s], likewise.
        density: [kg/m3]; artificially high, as the updated form's stable step falls with its square root. The
            total-Lagrangian form stands ``formulation.AIR``, which is next to nothing.
        shear: Fictitious shear modulus of the chamber's points in the total-Lagrangian form [Pa], which keeps them
            apart: the pressure of a chamber is uniform, and air resists no distortion.

    Raises:
        ValueError: for a number that is not finite or negative (density: not positive), or a tensor with axes or of
            integers.
    """

    stiffness: Number = 0.14e6
    viscosity: Number = 1.83e-5
    volume_viscosity: Number = 0.0
    density: Number = 100.0
    shear: Number = 3e3

    def __post_init__(self) -> None:
        """Check the numbers."""
        _positive("density", self.density)
        for name in ("stiffness", "viscosity", "volume_viscosity", "shear"):
            value = value_of(name, getattr(self, name))
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

    def discrete(self, dt: float | Tensor) -> Tensor:
        """Numbers of the exact-exponential update [..., M, 3]: a = exp(-dt/tau), b = (1 - a) tau / dt, g.

        A step for each simulation is a tensor [..., 1].

        H <- a H + b (S_new - S_old) integrates Eq. 8 exactly for a strain that changes linearly in a step.
        """
        ratio = dt / self.times
        return torch.stack([torch.exp(-ratio), -torch.expm1(-ratio) / ratio, self.moduli.expand_as(ratio)], dim=-1)

    def storage_loss(self, omega: Tensor) -> tuple[Tensor, Tensor]:
        """Storage and loss modulus over the equilibrium modulus at angular frequencies [rad/s] (Eqs. 17a, 17b)."""
        wt = omega.unsqueeze(-1) * self.times
        part = self.moduli * wt / (1 + wt * wt)
        return 1 + (part * wt).sum(-1), part.sum(-1)

    def step_moduli(self, dt: float | Tensor) -> Tensor:
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
        shear: mu of a solid, of a gas its fictitious one (see :class:`Gas`) [..., N] Pa.
        chamber: int32 [N], -1 for solid, else the gas chamber's number.
        velocity: [..., N, 3] m/s; at rest if None.
        viscosity: [..., N] Pa s; 0 if None. Solids may have one too; that of a gas counts in the updated form only.
        volume_viscosity: [..., N] Pa s; 0 if None.
        void_fraction: Share of a solid's stress that comes from the law of void, which bears being turned inside out
            [..., N], 0 to 1; 0 if None. See :func:`fill`. At exactly 0 its gradient is the one-sided derivative. At
            exactly 1 it is zero, as of the steps of ``fill``: the solid's law, of which a particle of void has no
            histories, is left out there.
        drag: Drag coefficient [..., N] N s/m; 0 if None.
        stiffening: a and b of a solid, by which mu grows to mu (1 + a x + b x^2) at x = I1b - 3 (see :class:`Solid`)
            [..., N, 2], of any sign; 0 if None, which is neo-Hookean. The Maxwell elements stiffen alike.
        softening: Depth d and range r of a solid that is softer below its largest stretch so far (Mullins; Ogden and
            Roxburgh 1999): of mu only 1 - d erf(u / r) is left, where u is by how much x is less than its largest
            [..., 2]; none if None. Maxwell elements do not soften. Total formulation only.
        air_stiffness: Pressure that the air in each hollow chamber of the lattice loses as its volume doubles
            [..., hollow chambers] Pa; 0 if None. Hollow chambers hold no particles, and follow in number those that do.
            Total formulation only.
        air_share: Share of each particle's volume that is air of the chamber in ``chamber`` [..., N], 0 to 1. With it
            every particle follows the law of solids, whatever ``chamber`` says, and those of a chamber add their shares
            to its volume and feel its pressure by them. None where those of a chamber are gas altogether. Total
            formulation only.
        share_stiffness: k of that air [..., N] Pa; 0 if None.
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
    void_fraction: Tensor | None = None
    drag: Tensor | None = None
    stiffening: Tensor | None = None
    softening: Tensor | None = None
    air_stiffness: Tensor | None = None
    air_share: Tensor | None = None
    share_stiffness: Tensor | None = None

    @property
    def gas(self) -> Tensor:
        """Which particles are gas altogether, bool [N]."""
        return self.chamber >= 0 if self.air_share is None else torch.zeros_like(self.chamber, dtype=torch.bool)


def value_of(name: str, number: Number) -> float:
    """The value of a number; refuses what is none, or more than one."""
    if isinstance(number, Tensor):
        if number.ndim or not number.is_floating_point():
            raise ValueError(
                f"{name}: {number.dtype} of shape {tuple(number.shape)}, wanted a number, or a floating-point tensor "
                "without axes"
            )
        return float(number.detach())
    if isinstance(number, bool) or not isinstance(number, numbers.Real):
        raise ValueError(f"{name} = {number!r}: wanted a number")
    return float(number)


def _positive(name: str, number: Number) -> None:
    value = value_of(name, number)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} = {value}: wanted finite and positive")
