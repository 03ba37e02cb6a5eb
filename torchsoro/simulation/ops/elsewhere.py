"""Time integration on a GPU of a scene whose tensors are on a CPU: what many small bodies are assembled from stays."""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.memory import empty_record
from torchsoro.simulation.ops.scene import Inputs, ObserveMany, Scene
from torchsoro.simulation.ops.total import TotalSegmentIntegrator


class ElsewhereIntegrator(TotalSegmentIntegrator):
    """One segment on ``Scene.device``, forward only, between two copies.

    Args:
        scene: Constant data, of simulations that go on apart, of which only markers are recorded.
        inputs: The segment's tensors.
        first: Number of the first substep in the whole run.
        samples: Substeps to observe, counted within the segment.
    """

    def __init__(self, scene: Scene, inputs: Inputs, *, first: int, samples: tuple[int, ...]) -> None:
        assert scene.device is not None and scene.only_markers
        there = Inputs(**{f.name: getattr(inputs, f.name).to(scene.device) for f in fields(inputs)})
        super().__init__(moved(scene, scene.device), there, first=first, samples=samples)
        self.device = scene.device
        # Variations have other loads and laws each time, and a kernel that is compiled for others takes seconds.
        self.features |= layout.ANY_LOAD

    def forward(self, start: Tensor, *, keep: bool, observe: ObserveMany) -> Tensor:
        """Advance the state [B, L] over the segment; what is returned is where ``start`` is.

        What is observed is on the device: markers are fewer numbers than the nodes near them, and copies take time.
        """
        return super().forward(start.to(self.device), keep=keep, observe=observe).to(start.device)

    def record(self, states: Tensor) -> tuple[Tensor, ...]:
        """Nothing is kept."""
        return empty_record(states)


def moved(scene: Scene, device: torch.device) -> Scene:
    """A scene with its tensors on a device, as far as kernels read them."""
    changes: dict[str, Tensor | Lattice] = {}
    for name in ("kind", "share", "plane_kind", "probes", "held", "node_share", "tie_share"):
        if (value := getattr(scene, name)) is not None:
            changes[name] = value.to(device)
    lattice = scene.lattice
    if lattice is not None and lattice.index is not None:
        changes["lattice"] = replace(lattice, index=lattice.index.to(device))
    return replace(scene, **changes, device=None)
