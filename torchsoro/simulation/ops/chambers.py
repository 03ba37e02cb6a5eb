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
        V, K = chamber_air(scene, coefficients, c)
        whole = pairwise_sum(V)
        rows.append(torch.stack([pairwise_sum(V * K) / whole, whole], -1).unsqueeze(1))
    return torch.cat(rows, 1)


def air_volumes(scene: Scene, coefficients: Tensor) -> Tensor:
    """Reference volume of air that each particle of a chamber holds [B, N]; without meaning for others."""
    volume = coefficients[:, layout.VOLUME]
    return volume * coefficients[:, layout.AIR_SHARE] if scene.shared else volume


def chamber_air(scene: Scene, coefficients: Tensor, c: int) -> tuple[Tensor, Tensor]:
    """Volumes of the air in a chamber and its stiffness, by particle [B, n]."""
    gas = scene.gas(c)
    stiffness = layout.AIR_STIFFNESS if scene.shared else layout.BULK
    return air_volumes(scene, coefficients[..., gas]), coefficients[:, stiffness, gas]


def chamber_air_adjoint(
    scene: Scene, coefficients: Tensor, c: int, V_bar: Tensor, K_bar: Tensor, found: Tensor
) -> None:
    """Adjoint of :func:`chamber_air`: adds the gradients by the coefficients to ``found``."""
    gas = scene.gas(c)
    if not scene.shared:
        found[:, layout.VOLUME, gas] += V_bar
        found[:, layout.BULK, gas] += K_bar
        return
    found[:, layout.VOLUME, gas] += V_bar * coefficients[:, layout.AIR_SHARE, gas]
    found[:, layout.AIR_SHARE, gas] += V_bar * coefficients[:, layout.VOLUME, gas]
    found[:, layout.AIR_STIFFNESS, gas] += K_bar


def chamber_adjoint(scene: Scene, coefficients: Tensor, chamber: Tensor, bar: Tensor) -> Tensor:
    """Gradient by the coefficients, from that by :func:`chamber_means`, which were ``chamber``."""
    found = torch.zeros_like(coefficients)
    for c in range(chamber.shape[1]):
        V, K = chamber_air(scene, coefficients, c)
        k, whole = chamber[:, c, :1], chamber[:, c, 1:]
        k_bar, whole_bar = bar[:, c, :1], bar[:, c, 1:]
        chamber_air_adjoint(scene, coefficients, c, k_bar * (K - k) / whole + whole_bar, k_bar * V / whole, found)
    return found
