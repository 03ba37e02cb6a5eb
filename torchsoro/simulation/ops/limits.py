"""What only lanes simulate, and what has no gradient."""

from __future__ import annotations

from torchsoro.simulation.ops.scene import Inputs, Scene


def refuse_without_lanes(scene: Scene, inputs: Inputs) -> None:
    """Refuse what Taichi's kernels do not have.

    Raises:
        ValueError: naming it.
    """
    lattice = scene.lattice
    given = {
        "hollow chambers": lattice is not None and lattice.walls is not None,
        "faces of the lattice": lattice is not None and lattice.faces is not None,
        "softening": scene.softens,
        "quadratic drag": scene.immersed,
        "held nodes": scene.held is not None,
        "forces on nodes": scene.node_share is not None,
        "forces with one row for all substeps": scene.force_start is not None,
        "springs to a mean displacement": scene.tie_share is not None,
        "what is attached to nodes": inputs.attached.shape[2] > 0,
        "simulations that diverge apart": scene.apart,
    }
    for name in (name for name, there in given.items() if there):
        raise ValueError(f"{name}: wanted the total-Lagrangian formulation in lanes on a CPU, which alone has them")


def refuse_gradient(scene: Scene) -> None:
    """Refuse a gradient of what has no adjoint.

    Raises:
        ValueError: naming it.
    """
    if scene.apart:
        raise ValueError(
            "simulations that diverge apart: no gradient, wanted tensors that require none, or torch.no_grad()"
        )
