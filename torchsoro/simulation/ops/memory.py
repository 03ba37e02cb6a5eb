"""Memory for what a rollout keeps for its gradient, used again by the next one.

A simulation writes hundreds of megabytes once and reads them once. Fresh memory costs a page fault for every page,
which takes longer than to compute what is written there.
"""

from __future__ import annotations

import math
import weakref

import numpy as np
import torch
from torch import Tensor

LINE = 64  # bytes of a cache line, with which memory begins
LARGE = 2**20  # bytes; smaller blocks come from the allocator's own pool
ROOM = 2**31  # bytes that wait here at most: what a rollout may keep on a CPU

_waiting: list[np.ndarray] = []


def kept_memory(like: Tensor, *shape: int) -> Tensor:
    """A tensor of the type of another on the CPU, not initialised; its memory comes back here when it is freed."""
    dtype = torch.empty(0, dtype=like.dtype).numpy().dtype
    count = math.prod(shape)
    size = count * dtype.itemsize
    if size < LARGE:
        return torch.empty(shape, dtype=like.dtype)
    fitting = [i for i, b in enumerate(_waiting) if size + LINE <= b.size <= 2 * size + LINE]
    block = _waiting.pop(min(fitting, key=lambda i: _waiting[i].size)) if fitting else np.empty(size + LINE, np.uint8)
    first = -block.ctypes.data % LINE
    mine = block[first : first + size].view(dtype)
    weakref.finalize(mine, _take_back, block).atexit = False
    return torch.from_numpy(mine).view(shape)


def _take_back(block: np.ndarray) -> None:
    _waiting.append(block)
    while sum(b.size for b in _waiting) > ROOM:
        _waiting.pop(0)


def empty_record(like: Tensor) -> tuple[Tensor, ...]:
    """A record of nothing, in the types of ``SegmentIntegrator.record``."""
    nothing = (like.new_empty(0) for _ in range(3))
    return *nothing, like.new_empty(0, dtype=torch.int32), torch.empty(0, dtype=torch.int64)
