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
from torchsoro.simulation.ops.tiles import tables


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
    """The constants of a run, computed once for the same coefficients, Maxwell elements and planes."""
    given = [inputs.coefficients, inputs.prony, inputs.planes, inputs.attached]
    chambers = inputs.pressure.shape[2]

    def compute() -> Fixed:
        lattice, (c, prony, planes, attached) = scene.lattice, (t.detach() for t in given)
        assert lattice is not None
        nodal = lattice.nodal(c[:, layout.MASS], c[:, layout.DRAG], scene.dt, attached)
        chamber = chamber_means(scene, c, chambers)
        constants = numbers(lattice, scene.dt, scene.cell).to(c)
        return Fixed(
            tables=once(scene, "tables", [], lambda: Arena("integers", *_integers(scene, chambers))),
            nodal=nodal,
            chamber=chamber,
            arena=Arena("fixed", constants, c, prony, planes, nodal, chamber, scene.share),
        )

    return once(scene, "fixed", given, compute)


def _integers(scene: Scene, chambers: int) -> list[Tensor]:
    """In the order of ``layout.BUFFERS``."""
    assert scene.lattice is not None
    found = tables(scene.lattice, scene.kind, chambers)
    return [scene.kind, scene.plane_kind, *(torch.from_numpy(t.astype(np.int32)).to(scene.kind.device) for t in found)]
