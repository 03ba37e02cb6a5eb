"""Sums in an order of their own: of a body, no bit depends on which others it is simulated with.

torch chooses the order of a sum, and of a product of matrices, by the shape of the whole tensor.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def pairwise_sum(values: Tensor) -> Tensor:
    """Sum over the last axis [..., n]: its halves are added until one number is left; zero of none."""
    if not values.shape[-1]:
        return values.sum(-1)
    while (count := values.shape[-1]) > 1:
        half = count // 2
        added = values[..., :half] + values[..., half : 2 * half]
        values = torch.cat([added, values[..., 2 * half :]], -1) if count % 2 else added
    return values[..., 0]


def one_by_one(function: Callable[..., Tensor], *bodies: Tensor) -> Tensor:
    """What a function of tensors [...] gives for each of a batch [B, ...], stacked."""
    return torch.stack([function(*each) for each in zip(*bodies, strict=True)])
