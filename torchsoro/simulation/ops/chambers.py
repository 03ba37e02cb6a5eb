"""What the gas of each chamber of the total-Lagrangian form has in common, for both engines, and the adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.scene import Scene
from torchsoro.simulation.sums import pairwise_sum


def chamber_means(scene: Scene, coefficients: Tensor, chambers: int) -> Tensor:
    """Mean air stiffness and reference volume of each chamber [B, chambers, CHAMBER]."""
    rows = [coefficients.new_zeros(len(coefficients), 0, layout.CHAMBER)]
    for c in range(chambers):
        V, K = _air(scene, coefficients, c)
        whole = pairwise_sum(V)
        rows.append(torch.stack([pairwise_sum(V * K) / whole, whole], -1).unsqueeze(1))
    return torch.cat(rows, 1)


def _air(scene: Scene, coefficients: Tensor, c: int) -> tuple[Tensor, Tensor]:
    """Volumes and bulk moduli of the gas in a chamber [B, n]."""
    gas = scene.gas(c)
    return coefficients[:, layout.VOLUME, gas], coefficients[:, layout.BULK, gas]


def chamber_adjoint(scene: Scene, coefficients: Tensor, chamber: Tensor, bar: Tensor) -> Tensor:
    """Gradient by the coefficients, from that by :func:`chamber_means`, which were ``chamber``."""
    found = torch.zeros_like(coefficients)
    for c in range(chamber.shape[1]):
        gas, (V, K) = scene.gas(c), _air(scene, coefficients, c)
        k, whole = chamber[:, c, :1], chamber[:, c, 1:]
        k_bar, whole_bar = bar[:, c, :1], bar[:, c, 1:]
        found[:, layout.VOLUME, gas] = k_bar * (K - k) / whole + whole_bar
        found[:, layout.BULK, gas] = k_bar * V / whole
    return found
