"""What has no gradient."""

from __future__ import annotations

from torchsoro.simulation.ops.scene import Scene


def refuse_gradient(scene: Scene) -> None:
    """Refuse a gradient of what has no adjoint.

    Raises:
        ValueError: naming it.
    """
    if scene.chain_steps:
        raise ValueError("a Chain: no gradient, wanted tensors that require none, or torch.no_grad()")
    if scene.apart:
        raise ValueError(
            "simulations that diverge apart: no gradient, wanted tensors that require none, or torch.no_grad()"
        )
