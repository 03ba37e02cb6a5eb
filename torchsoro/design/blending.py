"""From density to a body whose particles are shares of design, wall and air, as of chambers whose place is designed."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsoro.design.density import VOID_DRAG, simp, void_share
from torchsoro.design.domain import Domain
from torchsoro.design.placement import Membership
from torchsoro.simulation.formulation import AIR
from torchsoro.simulation.material import Body, Gas, Number, Solid


def solid_shares(
    gamma: Tensor, membership: Membership, *, epsilon: Number = 1e-5, power: Number = 3.0
) -> tuple[Tensor, Tensor]:
    """What mass and moduli of each particle are over the solid's, by its wall and by what is designed [..., N] each.

    Shares of a wall count in proportion, so that a wall is as stiff between two lattice planes as on them; what is
    designed counts by :func:`torchsoro.design.density.simp`.

    Args:
        gamma: Density of the particles [..., N], walls included.
        membership: Shares of design, wall and air, in the type of ``gamma``.
        epsilon: See :func:`torchsoro.design.density.simp`.
        power: Likewise.
    """
    designed = membership.design * simp(membership.designed(gamma), epsilon=epsilon, power=power)
    return membership.wall.expand_as(designed), designed


def fill_blended(
    domain: Domain,
    gamma: Tensor,
    membership: Membership,
    *,
    solid: Solid,
    gas: Gas,
    void_range: tuple[Number, Number],
    epsilon: Number = 1e-5,
    power: Number = 3.0,
) -> Body:
    """Fill a domain with material by shares: :func:`torchsoro.design.density.fill` where all shares are 0 or 1.

    Every particle follows the law of solids and, by its density, that of void, which is that of the air's fictitious
    shear modulus, too. By its share of air it adds to the volume of its chamber and feels the chamber's pressure. The
    air has no viscosity, which the total-Lagrangian formulation does not know.

    Args:
        domain: Lattice.
        gamma: Density of every particle [..., N], walls included; differentiable. Air ignores its own.
        membership: Shares of design, wall and air.
        solid: The printed material.
        gas: The chambers' gas.
        void_range: See :func:`torchsoro.design.density.fill`.
        epsilon: See :func:`torchsoro.design.density.simp`.
        power: Likewise.

    Returns:
        A body on gamma's device and in its precision, for the total-Lagrangian formulation.
    """
    like = {"dtype": gamma.dtype, "device": gamma.device}
    member = membership.to(gamma)
    scale = torch.stack(solid_shares(gamma, member, epsilon=epsilon, power=power)).sum(0)

    def number(value: Number) -> Tensor:
        return torch.as_tensor(value, **like)

    # As of the regions, a density that is given for air does not count.
    void = void_share(member.wall + member.design * member.designed(gamma), *void_range)
    matter = domain.volume * number(solid.density) * scale
    light = torch.as_tensor(gas.density, dtype=torch.float64).clamp(max=AIR).to(**like) * domain.volume
    laws = torch.stack([number(solid.linear_stiffening), number(solid.quadratic_stiffening)])
    stiffens = laws.requires_grad or bool(laws.any())
    return Body(
        position=domain.positions.to(**like),
        mass=matter + domain.volume * number(gas.density) * member.air,
        volume=torch.full((domain.count,), domain.volume, **like),
        bulk=number(solid.bulk) * scale,
        shear=number(solid.shear) * scale + number(gas.shear) * member.air,
        chamber=member.chamber,
        void_fraction=void,
        drag=VOID_DRAG * (light * member.air + matter * void),
        stiffening=laws.expand(domain.count, 2) if stiffens else None,
        air_share=member.air,
        share_stiffness=number(gas.stiffness).expand(domain.count),
    )
