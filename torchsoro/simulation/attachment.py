"""What acts on nodes of the total-Lagrangian form, in the operator's terms: loads, clamps, air, softening."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchsoro.simulation.hanging import chain_numbers
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import (
    Attached,
    Chain,
    Clamp,
    Drag,
    Force,
    PointMass,
    QuadraticDrag,
    Spring,
    group_shares,
    load_amount,
)
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs, Scene

_BESIDE = 1e-3  # of a cell, by which a body may lie off its lattice: rounding of its places


def load_tensors(attached: Attached) -> list[tuple[Tensor, int]]:
    """Tensors of what is not on particles, with the number of axes that are not a batch."""
    body = attached.body
    found = [(t, 1) for t in (body.softening, body.air_stiffness) if t is not None]
    for load in attached.more:
        amount = {PointMass: "mass", Drag: "coefficient", QuadraticDrag: "coefficient", Spring: "stiffness"}
        if type(load) in amount:
            found.append((torch.as_tensor(getattr(load, amount[type(load)])), 0))
        if isinstance(load, Chain):
            numbers = load.length, load.mass, load.stiffness, load.damping
            found += [(load.support, 1), *((torch.as_tensor(number), 0) for number in numbers)]
        share = getattr(load, "share", None)
        if share is not None:
            found.append((share, 1))
    return found


def refuse_nodes(attached: Attached) -> None:
    """Refuse what only the total-Lagrangian form has.

    Raises:
        ValueError: naming it.
    """
    body = attached.body
    given = {
        "body.softening": body.softening is not None,
        "body.air_stiffness": body.air_stiffness is not None,
        "body.air_share": body.air_share is not None,
        **{f"loads: {type(load).__name__} on nodes or means": True for load in attached.more},
    }
    for name in (name for name, there in given.items() if there):
        raise ValueError(f"{name}: which the updated formulation has not, wanted the total-Lagrangian formulation")


def on_nodes(
    scene: Scene, inputs: Inputs, attached: Attached, wide: Callable[[Tensor, int], Tensor]
) -> tuple[Scene, Inputs]:
    """A scene on its lattice and its inputs, with what acts on nodes.

    Args:
        scene: On its lattice.
        inputs: By point of it.
        attached: The body with its loads.
        wide: Broadcasts a tensor with so many axes that are not a batch to the batch.

    Raises:
        ValueError: for shares that are not of the lattice's nodes, a clamp that holds none, quadratic drag without
            known faces, or the air of chambers that are not there.
    """
    lattice, body, like = scene.lattice, attached.body, inputs.coefficients
    assert lattice is not None
    changes: dict[str, Tensor] = {}
    hollow = 0 if lattice.walls is None else lattice.walls.count
    if body.air_stiffness is not None or hollow:
        air = like.new_zeros(hollow) if body.air_stiffness is None else body.air_stiffness
        if air.shape[-1:] != (hollow,):
            raise ValueError(
                f"body.air_stiffness: shape {tuple(air.shape)}, wanted [..., {hollow}], as hollow chambers"
            )
        changes["air"] = wide(air, 1)
    if body.softening is not None:
        depth = body.softening[..., 0]
        scene = replace(scene, softens=depth.requires_grad or bool((depth != 0).any()))
        changes["softening"] = wide(body.softening, 1)
    weights, drags, shares, fluid, ties, means = [], [], [], [], [], []
    chains: list[Tensor] = []
    chain_steps = 0
    held = torch.zeros(lattice.nodes, dtype=torch.bool, device=like.device)
    for load in attached.more:
        if isinstance(load, QuadraticDrag):
            fluid.append(wide(load_amount("coefficient", load.coefficient, like), 0))
        elif isinstance(load, Clamp):
            held |= _inside(lattice, load).to(held.device)
        elif isinstance(load, Force):
            shares.append(_share(load, lattice, like))
        elif isinstance(load, Spring):
            ties.append(wide(load_amount("stiffness", load.stiffness, like), 0))
            means.append(wide(_share(load, lattice, like), 1))
            chains.append(like.new_zeros(len(like), layout.CHAIN))
        elif isinstance(load, Chain):
            ties.append(like.new_zeros(len(like)))
            means.append(wide(_share(load, lattice, like), 1))
            found, steps = chain_numbers(load, inputs.gravity[0], scene.dt, wide)
            chains.append(found)
            chain_steps = max(chain_steps, steps)
        else:
            name, kept = ("mass", weights) if isinstance(load, PointMass) else ("coefficient", drags)
            amount = wide(load_amount(name, getattr(load, name), like), 0)
            kept.append(amount.unsqueeze(-1) * wide(_share(load, lattice, like), 1))
    if weights or drags:
        none = [like.new_zeros(len(like), lattice.nodes)]
        changes["attached"] = torch.stack([sum(rows[1:], rows[0]) for rows in (weights or none, drags or none)], 1)
    if fluid:
        if lattice.faces is None:
            raise ValueError("loads: QuadraticDrag on a lattice without faces, wanted Total(lattice=...) with faces")
        changes["fluid"] = sum(fluid[1:], fluid[0])
        scene = replace(scene, immersed=True)
    if ties:
        changes["ties"] = torch.stack(ties, 1)
        scene = replace(scene, tie_share=torch.stack(means, 1), chain_steps=chain_steps)
        if chain_steps:
            changes["chains"] = torch.stack(chains, 1)
    if shares:
        scene = replace(scene, node_share=torch.stack(shares))
    if bool(held.any()):
        scene = replace(scene, held=held)
    return scene, replace(inputs, **changes)


def refuse_shifted(scene: Scene, x: Tensor, *, started: bool) -> None:
    """Refuse bodies beside their lattice where nodes have places of their own: a clamp, a spring of nodes, a start.

    Args:
        scene: On its lattice.
        x: Of the points [B, points, 3] m.
        started: Whether displacements of nodes are given.

    Raises:
        ValueError: for a simulation whose body lies elsewhere.
    """
    lattice = scene.lattice
    if lattice is None or not (started or scene.held is not None or scene.tie_share is not None):
        return
    present = scene.kind != layout.ABSENT
    off = (x.detach() - lattice.on("places", x))[:, present].mean(1).abs().amax(1)
    if bool((off > _BESIDE * scene.cell).any()):
        what = "a Start of nodes" if started else "a Clamp" if scene.held is not None else "a Spring of nodes"
        raise ValueError(
            f"body.position: {1e3 * float(off.max()):.3g} mm beside the lattice, wanted on it where there is {what}; "
            "by default the lattice is that of the first simulation"
        )


def held_still(scene: Scene, state: Tensor, *, continued: bool) -> Tensor:
    """A state [B, L] whose clamped nodes are at rest, and in their undeformed places unless it is of another run."""
    if scene.held is None or scene.lattice is None:
        return state
    nodes = scene.lattice.nodes
    still = torch.cat([scene.held & (not continued)] * 3 + [scene.held] * 3)
    return torch.cat([torch.where(still, 0.0, state[:, : 6 * nodes]), state[:, 6 * nodes :]], 1)


def _share(load: Force | PointMass | Spring | Chain | Drag, lattice: Lattice, like: Tensor) -> Tensor:
    """Each node's share of a load [..., nodes]."""
    if not isinstance(load, Chain) and load.particles is not None:
        count = lattice.count if lattice.index is None else len(lattice.index)
        group = group_shares(load.particles, load.share, count, like)
        return lattice.to_nodes(lattice.spread(group).reshape(-1, lattice.count)).reshape(*group.shape[:-1], -1)
    share = load.share
    assert share is not None
    if share.requires_grad:
        raise ValueError(f"share of a {type(load).__name__} on nodes: requires a gradient, wanted one without")
    if share.shape[-1:] != (lattice.nodes,) or not bool(((share.sum(-1) - 1).abs() < 1e-4).all()):
        raise ValueError(
            f"share of a {type(load).__name__}: shape {tuple(share.shape)}, sums {share.sum(-1).tolist()}, wanted "
            f"[..., {lattice.nodes}], of each node of the lattice, with sum 1"
        )
    if isinstance(load, Force) and share.ndim > 1:
        raise ValueError(f"share of a Force: shape {tuple(share.shape)}, of a batch, wanted [{lattice.nodes}]")
    return share.to(like)


def _inside(lattice: Lattice, clamp: Clamp) -> Tensor:
    """Which nodes a clamp holds, bool [nodes]."""
    held = lattice.inside(clamp.low, clamp.high)
    if not bool(held.any()):
        raise ValueError(f"Clamp: box {clamp.low}, {clamp.high} m, wanted one that holds a node of the lattice")
    return held
