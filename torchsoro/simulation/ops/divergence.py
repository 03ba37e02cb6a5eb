"""Where a simulation of the total-Lagrangian form has gone wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs, Scene


def outside(scene: Scene, inputs: Inputs, state: Tensor) -> Tensor:
    """Points outside of the analysis box, void excepted [B, points], of a state [B, 3 nodes or more]."""
    lattice = _lattice(scene)
    x = _points(lattice, _nodes(lattice, state))
    matter = (scene.kind != layout.ABSENT) & (inputs.coefficients[:, layout.VOID_FRACTION] < 1)
    sides = enumerate(zip(scene.low, scene.high, strict=True))
    within = [(x[:, a] > low) & (x[:, a] < high) for a, (low, high) in sides]
    return matter & ~(within[0] & within[1] & within[2])


def report(scene: Scene, inputs: Inputs, step: int, state: Tensor) -> None:
    """Raise ``SimulationDiverged`` for the first point that violates a bound after so many substeps of the run."""
    lattice = _lattice(scene)
    d = _nodes(lattice, state)
    J = torch.linalg.det(lattice.gradient(d).permute(0, 3, 1, 2) + torch.eye(3).to(state))
    mixed = scene.kind <= layout.ENCLOSES
    tangled = (scene.kind >= 0) | (mixed & (inputs.coefficients[:, layout.AIR_SHARE] > 0))
    solid = ((scene.kind == -1) | mixed) & (inputs.coefficients[:, layout.VOID_FRACTION] == 0)
    x = _points(lattice, d)
    there = scene.kind != layout.ABSENT
    smaller = "a smaller time step, a lower pressure or a higher void fraction"
    lowest = torch.where(solid, J, torch.inf)
    lowest = torch.zeros_like(solid).view(-1).index_fill(0, lowest.view(-1).argmin(), True).view_as(solid)
    cases = (
        (~torch.isfinite(J) & there, "the state is not finite", "J", J, smaller),
        ((J <= 0) & solid, "the volume ratio is not positive", "J", J, smaller),
        (
            (J <= 0) & tangled,
            "the chamber is tangled inside",
            "J",
            J,
            "a larger fictitious shear modulus in the chamber (Gas.shear) or a lower pressure",
        ),
        (
            outside(scene, inputs, state),
            "about to leave the analysis box",
            "farthest coordinate in m",
            x.abs().amax(1),
            "a larger analysis box, or a shorter run",
        ),
        (lowest, "the volume ratio is hardly positive", "J", J, smaller),
    )
    for bad, quantity, label, value, remedy in cases:
        if bool(bad.any()):
            b, p = (int(n) for n in bad.nonzero()[0])
            index = lattice.index
            raise SimulationDiverged(
                step=step,
                time=step * scene.dt,
                particle=p if index is None else int((index == p).nonzero()[0]),
                quantity=f"{quantity} ({label} = {float(value[b, p]):.4g})",
                batch=b,
                remedy=remedy,
            )


def _lattice(scene: Scene) -> Lattice:
    assert scene.lattice is not None
    return scene.lattice


def _nodes(lattice: Lattice, state: Tensor) -> Tensor:
    """Displacements [B, 3, nodes] m."""
    return state[:, : 3 * lattice.nodes].reshape(len(state), 3, lattice.nodes)


def _points(lattice: Lattice, d: Tensor) -> Tensor:
    """Places of the points [B, 3, points] m, from the displacements of the nodes."""
    return lattice.to_points(d, "mark") + lattice.on("places", d).T
