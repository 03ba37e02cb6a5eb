"""What the segments of a run of the total-Lagrangian form have in common: index tables, nodes, chambers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.arena import Arena
from torchsoro.simulation.ops.chambers import chamber_means
from torchsoro.simulation.ops.lattice import numbers
from torchsoro.simulation.ops.once import once
from torchsoro.simulation.ops.scene import Inputs, Scene
from torchsoro.simulation.ops.tiles import tables, tile_axes, tiles_of, wall_numbers


@dataclass(frozen=True, kw_only=True, eq=False)
class Fixed:
    """Constants of a run, which nobody writes to.

    Attributes:
        tables: Index tables of the kernels.
        nodal: See ``Lattice.nodal`` [B, NODAL, nodes].
        chamber: Mean air stiffness and reference volume of each chamber [B, chambers, CHAMBER].
        arena: The constants of the kernels.
    """

    tables: Arena
    nodal: Tensor
    chamber: Tensor
    arena: Arena


def fixed(scene: Scene, inputs: Inputs) -> Fixed:
    """The constants of a run, computed once for the same tensors."""
    names = ("coefficients", "prony", "planes", "attached", "softening", "fluid", "ties", "air", "chains")
    given = [getattr(inputs, name) for name in names]
    chambers = inputs.pressure.shape[2]

    def compute() -> Fixed:
        lattice, (c, prony, planes, attached, softening, fluid, ties, air, chains) = (
            scene.lattice,
            (t.detach() for t in given),
        )
        assert lattice is not None
        nodal = lattice.nodal(c[:, layout.MASS], c[:, layout.DRAG], scene.dt, attached)
        chamber = chamber_means(scene, c, scene.gas_chambers)
        if lattice.walls is not None:
            hollow = torch.stack([air, lattice.walls.volume.to(air).expand_as(air)], -1)
            chamber = torch.cat([chamber, hollow], 1)
        held = nodal
        if scene.held is not None:  # what has no mass keeps its state
            held = nodal.clone()
            held[:, layout.NODAL_MASS].masked_fill_(scene.held, 0)
        quadratic = c.new_zeros(0)
        if scene.immersed:
            assert lattice.faces is not None
            quadratic = lattice.faces.front.T.to(c) * fluid.view(-1, 1, 1) / 2
        none = c.new_zeros(0)
        return Fixed(
            tables=once(scene, "tables", [], lambda: Arena("integers", *_integers(scene, chambers, c))),
            nodal=nodal,
            chamber=chamber,
            arena=Arena(
                "fixed",
                *(numbers(lattice, scene.dt, scene.cell).to(c), c, prony, planes, held, chamber, scene.share),
                *(_areas(scene, planes), softening, quadratic),
                *(none if scene.tie_share is None else scene.tie_share.to(c), ties),
                none if scene.node_share is None else scene.node_share.to(c),
                *(torch.from_numpy(walls).to(c) for walls in wall_numbers(lattice)),
                *(torch.from_numpy(tile_axes(lattice, tiles_of(lattice, c))).to(c), chains),
            ),
        )

    return once(scene, "fixed", given, compute)


def _areas(scene: Scene, planes: Tensor) -> Tensor:
    """Area by which each node adheres to each plane [B, planes, nodes] m2, negative if it meets none."""
    lattice = scene.lattice
    assert lattice is not None
    sign = scene.plane_kind[:, layout.PLANE_SIGN, None].to(planes)
    found = lattice.facing(planes[..., layout.PLANE_NORMAL : layout.PLANE_NORMAL + 3] * sign)
    if lattice.faces is not None:
        found = found.masked_fill(~lattice.faces.touches.to(planes.device), -1.0)
    return found


def _integers(scene: Scene, chambers: int, like: Tensor) -> list[Tensor]:
    """In the order of ``layout.BUFFERS``."""
    assert scene.lattice is not None
    found = tables(scene.lattice, tiles_of(scene.lattice, like), scene.air, chambers)
    near = np.full(0 if scene.markers is None else scene.lattice.nodes, -1)
    if scene.markers is not None:
        near[scene.markers.near.cpu()] = np.arange(len(scene.markers.near))
    more = (torch.from_numpy(t.astype(np.int32)).to(scene.kind.device) for t in (*found, near))
    return [scene.kind, scene.plane_kind, *more]
