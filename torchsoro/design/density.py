"""From density to a body: interpolation between void and solid (Eq. 11), chambers filled with gas, void left out."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import torch
from torch import Tensor

from torchsoro.design.domain import Domain, Region
from torchsoro.simulation.formulation import AIR
from torchsoro.simulation.material import Body, Gas, Number, Solid, value_of


def simp(gamma: Tensor, *, epsilon: Number = 1e-5, power: Number = 3.0) -> Tensor:
    """Interpolation between void and solid, (1 - epsilon) gamma^power + epsilon (Eq. 11).

    Args:
        gamma: Density field in [0, 1], any shape.
        epsilon: What the void keeps, relative to the solid; a tensor may require grad.
        power: 3 in the paper, so that intermediate densities carry little; a tensor may require grad.

    Raises:
        ValueError: if epsilon is not in (0, 1) or power not positive.
    """
    share, exponent = value_of("epsilon", epsilon), value_of("power", power)
    if not 0 < share < 1:
        raise ValueError(f"epsilon = {share}: wanted more than 0 and less than 1")
    if not (math.isfinite(exponent) and exponent > 0):
        raise ValueError(f"power = {exponent}: wanted finite and positive")
    return (1 - epsilon) * gamma**power + epsilon


def thickened(gamma: Tensor, added: Tensor, power: float) -> Tensor:
    """The density of a design to which solid is added, so that its mass grows by that of the solid.

    Args:
        gamma: Density in [0, 1] [N].
        added: Share of each particle's cell that is filled with solid [N].
        power: Of :func:`simp`.

    Returns:
        Density [N], at most 1: (gamma^power + added)^(1 / power), and ``gamma`` itself where nothing is added.
    """
    return torch.where(added > 0, (gamma**power + added).clamp(max=1) ** (1 / power), gamma)


VOID_DRAG = 1e3  # drag over mass of void, and of the air in a chamber [1/s]


def fill(
    domain: Domain,
    gamma: Tensor,
    *,
    solid: Solid,
    gas: Gas | None = None,
    epsilon: Number = 1e-5,
    power: Number = 3.0,
    void_range: tuple[Number, Number] | None = None,
) -> Body:
    """Fill a domain with material: mass and moduli interpolated by density (Eq. 11), gas in the chambers.

    Stiffening is relative to the modulus, and so does not change with the density.

    Args:
        domain: Lattice and regions.
        gamma: Density of every particle [..., N]; differentiable. Gas particles and those outside of the body
            ignore theirs.
        solid: The printed material; its numbers may require grad.
        gas: The chambers' gas; the paper's if None. Its numbers may require grad.
        epsilon: See :func:`simp`.
        power: See :func:`simp`.
        void_range: Densities between which the stress goes over, smoothly, from the law of void to that of the solid.
            In a finite-strain law void of next to no stiffness is crushed and turned inside out; the law of void stands
            that. Void and chambers are slowed down, too, at ``VOID_DRAG`` times the mass of void or of air of at most
            ``AIR``, lest light outer ends crack like whips and the points of a chamber flutter. None for the solid's
            law everywhere.

    Returns:
        A body on gamma's device and in its precision.

    Raises:
        ValueError: if gamma's last axis is not the particles, or ``void_range`` is not two increasing densities.
    """
    if void_range is not None:
        low, high = (value_of("void_range", density) for density in void_range)
        if not 0 <= low < high <= 1:
            raise ValueError(f"void_range = {(low, high)}: wanted two increasing densities from 0 to 1")
    if gamma.shape[-1] != domain.count:
        raise ValueError(
            f"gamma: shape {tuple(gamma.shape)}, wanted [..., {domain.count}], one value for each particle"
        )
    gas = gas or Gas()
    like = {"dtype": gamma.dtype, "device": gamma.device}
    air = (domain.region == Region.GAS).to(gamma.device)
    if bool(domain.outside.any()):
        gamma = gamma.masked_fill(domain.outside.to(gamma.device), 0.0)
    scale = simp(gamma, epsilon=epsilon, power=power)
    zero = torch.zeros((), **like)
    void = None if void_range is None else torch.where(air, zero, void_share(gamma, *void_range))

    def number(value: Number) -> Tensor:
        return torch.as_tensor(value, **like)

    laws = torch.stack([number(solid.linear_stiffening), number(solid.quadratic_stiffening)])
    stiffening = torch.where(air[:, None], zero, laws) if laws.requires_grad or bool(laws.any()) else None
    mass = domain.volume * torch.where(air, number(gas.density), number(solid.density) * scale)
    light = torch.as_tensor(gas.density, dtype=torch.float64).clamp(max=AIR) * domain.volume
    return Body(
        position=domain.positions.to(**like),
        mass=mass,
        volume=torch.full((domain.count,), domain.volume, **like),
        bulk=torch.where(air, number(gas.stiffness), number(solid.bulk) * scale),
        shear=torch.where(air, number(gas.shear), number(solid.shear) * scale),
        chamber=domain.chamber.to(device=gamma.device, dtype=torch.int32),
        viscosity=torch.where(air, number(gas.viscosity), zero),
        volume_viscosity=torch.where(air, number(gas.volume_viscosity), zero),
        void_fraction=void,
        drag=None if void is None else VOID_DRAG * torch.where(air, light.to(**like), mass * void),
        stiffening=stiffening,
    )


def without_void(body: Body) -> tuple[Body, Tensor]:
    """Leave out the particles that follow the law of void alone: they carry next to nothing, but take as long.

    Args:
        body: As from :func:`fill` with ``void_range``, without a batch.

    Returns:
        The body of the others, and which those are, bool [N].
    """
    if body.void_fraction is None:
        return body, torch.ones_like(body.chamber, dtype=torch.bool)
    keep = body.void_fraction < 1
    if body.air_share is not None:
        keep = keep | (body.air_share > 0)
    return part(body, keep), keep


def part(body: Body, keep: Tensor) -> Body:
    """The particles of a body, without a batch, that are to be kept, bool [N]."""
    given = {field.name: value[keep] for field in fields(Body) if (value := getattr(body, field.name)) is not None}
    return replace(body, **given)


def void_share(gamma: Tensor, low: Number, high: Number) -> Tensor:
    """Share of the law of void at a density: a smooth step from 1 at the lower density to 0 at the upper."""
    x = ((gamma - low) / (high - low)).clamp(0, 1)
    return 1 - x * x * (3 - 2 * x)
