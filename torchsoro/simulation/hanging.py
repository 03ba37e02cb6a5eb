"""Hanging chains in the terms of the kernels: links, beads, and where these are at rest at first."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import Chain, load_amount

STABLE = 0.5  # radians that a bead between two links turns by in a step; 2 is the limit without damping
ROUNDS = 200  # of Newton's method, at most
STILL = 1e-6  # forces left on beads at rest, of their weight; without any, of that share of what doubles the length


def chain_numbers(
    chain: Chain, gravity: Tensor, dt: float, wide: Callable[[Tensor, int], Tensor]
) -> tuple[Tensor, int]:
    """Numbers of a chain in each simulation [B, CHAIN], see ``kernels.layout``, and its steps within one of the body.

    Args:
        chain: Which.
        gravity: At first [B, 3] m/s2.
        dt: Step of the body [s].
        wide: Broadcasts a tensor with so many axes that are not a batch to the batch.

    Raises:
        ValueError: for a number that is negative or not finite or requires a gradient, or a support or a length of zero
            where there is mass.
    """
    like, links = gravity, layout.CHAIN_BEADS + 1
    names = "length", "mass", "stiffness", "damping"
    given = [chain.support, *(getattr(chain, name) for name in names)]
    if torch.is_grad_enabled() and any(isinstance(t, Tensor) and t.requires_grad for t in given):
        raise ValueError("a Chain: no gradient, wanted numbers that require none, or torch.no_grad()")
    support = wide(chain.support.to(like), 1)
    length, mass, stiffness, damping = (
        wide(load_amount(f"{name} of a Chain", getattr(chain, name), like), 0) for name in names
    )
    there = mass > 0
    if not bool(torch.isfinite(support).all()) or bool((there & ~(support.norm(dim=-1) > 0)).any()):
        raise ValueError(f"support of a Chain = {support.tolist()}: wanted finite numbers, away from the body")
    if bool((there & ~((length > 0) & (stiffness > 0))).any()):
        raise ValueError("length, stiffness of a Chain: zero beside a mass, wanted more")
    rest, link = length / links, torch.where(there, stiffness * links, 0.0)
    bead = mass / layout.CHAIN_BEADS
    lightness = torch.where(there, 1 / torch.where(there, bead, 1.0), 0.0)
    beads = at_rest(support.double(), rest.double(), link.double(), (bead.unsqueeze(-1) * gravity).double()).to(like)
    scalars = torch.stack([rest, link, 2 * damping * (link * bead).sqrt(), lightness], -1)
    found = torch.cat([support, scalars, torch.where(there[:, None], beads.flatten(1), 0.0)], 1)
    fastest = 2 * math.sqrt(float((link * lightness).max()))
    return found, max(1, math.ceil(fastest * dt / STABLE))


def pull_at_rest(support: Tensor, length: Tensor, mass: Tensor, stiffness: Tensor, gravity: Tensor) -> Tensor:
    """Force that a chain at rest hands on to its free end [B, 3] N.

    Args:
        support: As seen from that end [B, 3] m.
        length: Unstretched [B] m.
        mass: [B] kg.
        stiffness: When taut [B] N/m.
        gravity: [B, 3] m/s2.
    """
    links = layout.CHAIN_BEADS + 1
    rest, link = length / links, stiffness * links
    first = at_rest(support, rest, link, (mass / layout.CHAIN_BEADS).unsqueeze(-1) * gravity)[:, 0]
    span = first.norm(dim=-1)
    return (link * (span - rest).clamp(min=0) / span.clamp(min=1e-12)).unsqueeze(-1) * first


def at_rest(support: Tensor, rest: Tensor, stiffness: Tensor, weight: Tensor) -> Tensor:
    """Beads [B, CHAIN_BEADS, 3] m in equilibrium between the origin and a support, by damped Newton steps.

    Args:
        support: [B, 3] m.
        rest: Length of a link [B] m.
        stiffness: Of a link [B] N/m.
        weight: Of a bead [B, 3] N.
    """
    count, n = len(support), layout.CHAIN_BEADS
    s = (torch.arange(1, n + 1, dtype=support.dtype) / (n + 1)).to(support.device)[:, None]
    heavy = weight.norm(dim=-1).clamp(min=1e-30)
    down = weight / heavy[:, None]
    sag = (((n + 1) * rest) ** 2 - (support**2).sum(-1)).clamp(min=0).sqrt() / 2
    x = s * support[:, None] + (4 * s * (1 - s)) * (sag[:, None] * down)[:, None]
    scale = torch.where(stiffness > 0, stiffness, 1.0)  # what has no stiffness has no mass either, and stays
    damping = scale
    ends = support.new_zeros(count, 1, 3)

    def energy(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        links = torch.diff(torch.cat([ends, x, support[:, None]], 1), dim=1)
        span = links.norm(dim=-1)
        stretch = (span - rest[:, None]).clamp(min=0)
        stored = 0.5 * stiffness * (stretch**2).sum(1) - (weight[:, None] * x).sum((1, 2))
        return stored, links, span

    stored, links, span = energy(x)
    for _ in range(ROUNDS):
        taut, safe = (span > rest[:, None]).to(x), span.clamp(min=1e-12)
        along = links / safe[..., None]
        pull = (stiffness[:, None] * taut * (span - rest[:, None]))[..., None] * along
        force = weight[:, None] + pull[:, 1:] - pull[:, :-1]
        if bool((force.flatten(1).norm(dim=1) <= STILL * n * (heavy + STILL * stiffness * rest)).all()):
            break
        outer = along[..., :, None] * along[..., None, :]
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        slack = (1 - rest[:, None] / safe)[..., None, None] * (eye - outer)
        K = (stiffness[:, None] * taut)[..., None, None] * (outer + slack)
        H = x.new_zeros(count, n, 3, n, 3)
        for i in range(n):
            H[:, i, :, i] += K[:, i] + K[:, i + 1]
            if i + 1 < n:
                H[:, i, :, i + 1] -= K[:, i + 1]
                H[:, i + 1, :, i] -= K[:, i + 1]
        H = H.reshape(count, 3 * n, 3 * n)
        ridge = damping[:, None, None] * torch.eye(3 * n, dtype=x.dtype, device=x.device)
        step = torch.linalg.solve(H + ridge, force.flatten(1)).view(count, n, 3)
        after, links_after, span_after = energy(x + step)
        better = after <= stored
        x = torch.where(better[:, None, None], x + step, x)
        links = torch.where(better[:, None, None], links_after, links)
        span = torch.where(better[:, None], span_after, span)
        stored = torch.where(better, after, stored)
        damping = torch.where(better, 0.3 * damping, 10 * damping).clamp(1e-12 * scale, 1e6 * scale)
    return x
