"""Processes of a torchrun that share a run: process 0 decides and writes, the others simulate what it asks for.

Torch is imported where it is used, as a process chooses its GPU before CUDA starts.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torchsoro.errors import SimulationDiverged

if TYPE_CHECKING:
    from torch import Tensor

# How long one process waits for another [s]: the longest that process 0 may write pictures, or a simulation may last.
# A process that dies is noticed at once, by its connections.
PATIENCE = 3600
_TEXT = 2048  # bytes of a message


def world_size() -> int:
    """Number of processes that torchrun has started; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def take_gpu() -> None:
    """Let this process see one GPU of the host's, by its number among the host's processes. Before CUDA starts."""
    if world_size() == 1:
        return
    local = int(os.environ.get("LOCAL_RANK", "0"))
    listed = [one for one in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if one]
    os.environ["CUDA_VISIBLE_DEVICES"] = listed[local % len(listed)] if listed else str(local)


@dataclass(frozen=True)
class Processes:
    """Those of a run; by default this one alone.

    Attributes:
        rank: Number of this one.
        world: Number of all.
    """

    rank: int = 0
    world: int = 1

    def deal(self, count: int) -> list[range]:
        """Numbers 0 to ``count`` - 1 in consecutive parts, one for each process, that differ in length by one at most.

        Raises:
            ValueError: if there are more processes than numbers.
        """
        if count < self.world:
            raise ValueError(f"nproc-per-node = {self.world} processes in all: wanted at most scenarios = {count}")
        cuts = [count * k // self.world for k in range(self.world + 1)]
        return [range(cuts[k], cuts[k + 1]) for k in range(self.world)]

    def broadcast(self, values: Tensor) -> Tensor:
        """The tensor of process 0; that of the others is overwritten."""
        if self.world > 1:
            import torch.distributed

            values = values.contiguous()
            with _lost():
                torch.distributed.broadcast(values, 0)
        return values

    def gather(self, values: Tensor, parts: Sequence[range]) -> Tensor:
        """Rows of all processes, in their order.

        Args:
            values: Rows of this one [n, ...].
            parts: Numbers of the rows of each, see :meth:`deal`.
        """
        if self.world == 1:
            return values
        import torch
        import torch.distributed

        most = max(map(len, parts))
        mine = values.new_zeros(most, *values.shape[1:])
        mine[: len(values)] = values
        found = [torch.empty_like(mine) for _ in parts]
        with _lost():
            if values.is_cuda:  # NCCL would wait for a process that has died, gloo does not
                torch.distributed.all_gather([torch.zeros(1) for _ in parts], torch.zeros(1))
            torch.distributed.all_gather(found, mine)
        return torch.cat([one[: len(part)] for one, part in zip(found, parts, strict=True)])

    def agree(self, text: str) -> bool:
        """Whether all processes have the same text."""
        if self.world == 1:
            return True
        import torch

        mine = torch.frombuffer(bytearray(hashlib.sha256(text.encode()).digest()), dtype=torch.uint8)[None]
        return bool((self.gather(mine, [range(1)] * self.world) == mine).all())

    def first_error(self, error: SimulationDiverged | None) -> SimulationDiverged | None:
        """The error of the first process that has one; all get the same."""
        if self.world == 1:
            return error
        import torch

        names = ("step", "time", "particle", "quantity", "batch", "remedy")
        text = b"" if error is None else json.dumps({name: getattr(error, name) for name in names}).encode()
        mine = torch.zeros(1, _TEXT, dtype=torch.uint8)
        mine[0, : len(text)] = torch.frombuffer(bytearray(text), dtype=torch.uint8) if text else mine[0, :0]
        for row in self.gather(mine, [range(1)] * self.world):
            if found := bytes(row.tolist()).rstrip(b"\0"):
                return SimulationDiverged(**json.loads(found))
        return None


@contextlib.contextmanager
def joined(cuda: bool) -> Iterator[Processes]:
    """Meet the other processes of the torchrun, if there is one, and leave them at the end.

    Args:
        cuda: Whether tensors are on GPUs, which then talk by NCCL; others do by gloo.
    """
    if world_size() == 1:
        yield Processes()
        return
    import datetime

    import torch.distributed

    from torchsoro.simulation.threads import set_threads, thread_count

    set_threads(max(1, thread_count() // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))
    backend = "cpu:gloo,cuda:nccl" if cuda else "gloo"
    torch.distributed.init_process_group(backend, timeout=datetime.timedelta(seconds=PATIENCE))
    try:
        yield Processes(rank=torch.distributed.get_rank(), world=torch.distributed.get_world_size())
    finally:
        torch.distributed.destroy_process_group()


@contextlib.contextmanager
def _lost() -> Iterator[None]:
    """Say in one line that another process has ended.

    Raises:
        ConnectionError: instead of what torch.distributed raises.
    """
    try:
        yield
    except RuntimeError as error:
        raise ConnectionError(
            "a process that shares the scenarios has ended or does not answer; every iteration that was saved is "
            "whole: go on with --resume, on any number of processes up to that of the scenarios"
        ) from error
