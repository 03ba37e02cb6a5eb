"""Memory of a rollout for its gradient: all states, or checkpoints between which states are computed again."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchsoro.simulation.kernels.layout import LARGEST

MEMORY = {"cpu": 2 * 2**30, "cuda": 6 * 2**30}  # default budget by device, bytes
NODE_SHARE = 1.15  # bytes kept of particles and nodes, over those of the particles alone


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a rollout keeps for its gradient.

    Attributes:
        segment: Substeps between two kept states.
        keep: Keep every state of a segment in the forward pass, so that backward need not compute it again.
        memory: Memory of the plan [bytes].
    """

    segment: int
    keep: bool
    memory: int


def plan_checkpoints(
    *,
    steps: int,
    state_bytes: int,
    element_bytes: int,
    budget: int,
    binding: bool = True,
    node_share: float = NODE_SHARE,
) -> Plan:
    """Choose a plan within a memory budget: everything kept if it fits, else segments.

    Args:
        steps: Substeps of the rollout.
        state_bytes: Bytes of one state.
        element_bytes: Bytes of a number, 4 or 8.
        budget: Bytes.
        binding: Whether the budget may not be passed; else the plan that takes least, where none is within it.
        node_share: Bytes kept of a substep, over those of its state.

    Raises:
        ValueError: if no plan fits a binding budget; says the smallest budget that does.
    """
    each = int(state_bytes * node_share)
    most = max(1, LARGEST * element_bytes // state_bytes - 1)
    if each * (steps + 1) <= budget and steps <= most:
        return Plan(segment=steps, keep=True, memory=each * (steps + 1))
    # The fewest segments, as each costs the host some time; of equal length, which takes the least memory.
    plans, fewest = [], math.ceil(steps / most)
    for count in range(fewest, max(fewest, math.isqrt(steps) + 1) + 1):
        segment = math.ceil(steps / count)
        memory = state_bytes * count + each * (segment + 1)
        plans.append(Plan(segment=segment, keep=False, memory=memory))
        if memory <= budget:
            return plans[-1]
    least = min(plans, key=lambda plan: plan.memory)
    if not binding:
        return least
    raise ValueError(f"memory_budget = {budget / 2**20:.0f} MiB: wanted at least {least.memory / 2**20:.0f} MiB")
