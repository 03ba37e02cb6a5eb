"""Several tensors in one buffer, as kernels of the total-Lagrangian form take them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout


def check_count(name: str, count: int) -> None:
    """Refuse a buffer of more numbers than kernels can index.

    Raises:
        ValueError: naming it.
    """
    if count > layout.LARGEST:
        raise ValueError(
            f"{name}: {count:.4g} numbers in a buffer, wanted at most {layout.LARGEST:.4g}: fewer simulations in a "
            "batch, samples or particles"
        )


class Arena:
    """Several tensors in one buffer, under one of the names of ``layout.BUFFERS``, in the order given there.

    Attributes:
        name: Of the buffer.
        buffer: All tensors, flat, one after the other; at least one number, as an empty tensor has no address.
        offsets: Where each begins.
        views: Each again, as part of the buffer.
    """

    def __init__(self, name: str, *tensors: Tensor) -> None:
        buffer = torch.cat([*(t.detach().reshape(-1) for t in tensors), tensors[0].new_zeros(1)])
        self._divide(name, buffer, [t.shape for t in tensors])

    @classmethod
    def zeros(cls, name: str, like: Tensor, *shapes: Sequence[int]) -> Arena:
        """Tensors of zeros of these shapes, and of the type of ``like``."""
        return cls.over(name, like.new_zeros(sum(map(math.prod, shapes)) + 1), *shapes)

    @classmethod
    def over(cls, name: str, buffer: Tensor, *shapes: Sequence[int]) -> Arena:
        """The tensors of these shapes in a buffer that exists."""
        arena = cls.__new__(cls)
        arena._divide(name, buffer, shapes)
        return arena

    def _divide(self, name: str, buffer: Tensor, shapes: Sequence[Sequence[int]]) -> None:
        assert len(shapes) == len(layout.BUFFERS[name])
        check_count(name, buffer.numel())
        ends = list(itertools.accumulate(math.prod(shape) for shape in shapes))
        self.name, self.buffer, self.offsets = name, buffer, [0, *ends[:-1]]
        self.views = [
            buffer[start:end].view(*shape) for start, end, shape in zip(self.offsets, ends, shapes, strict=True)
        ]
