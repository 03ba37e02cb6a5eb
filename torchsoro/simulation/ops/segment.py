"""Time integration of a segment of the updated form and its adjoint: buffers, active boxes, launches, divergence.

A segment is cut into chunks of at most 64 substeps. Each has one active box, the nodes that its particles can reach,
so that only those nodes are computed; where a particle leaves the box early, the chunk is repeated step by step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.kernels import backward, forward, layout
from torchsoro.simulation.kernels.warp import WARP
from torchsoro.simulation.ops.launch import capture
from torchsoro.simulation.ops.scene import Inputs, Observe, Scene
from torchsoro.simulation.runtime import init

CHUNK = 64  # most substeps of an active box
MARGIN = 2  # cells around the particles' nodes in the active box
GPU_ROWS = 256  # rows that GPU threads share for sums over particles or nodes
CPU_LANES = 8  # over all simulations; fixed, so that the bits do not depend on the number of cores
FEW_NODES = 20_000  # one thread passes over so many nodes in the time that it takes to wake a second


@dataclass(eq=False)
class Chunk:
    """Substeps with one active box: its lowest nodes [B, 3], its size in nodes, and its node velocities if kept.

    On a GPU also the order in which threads take the particles.
    """

    first: int
    steps: int
    low: Tensor
    size: tuple[int, int, int]
    node: Tensor
    before: Tensor
    order: Tensor

    @property
    def nodes(self) -> int:
        """Nodes of the active box."""
        return self.size[0] * self.size[1] * self.size[2]


class SegmentIntegrator:
    """One segment: ``forward`` from a state to all states (or the last two), ``backward`` along the kept ones.

    Args:
        scene: Constant data.
        inputs: The segment's tensors.
        first: Number of the first substep in the whole run, for messages.
        samples: Substeps to observe, counted within the segment.
    """

    def __init__(self, scene: Scene, inputs: Inputs, *, first: int, samples: tuple[int, ...]) -> None:
        self.scene, self.inputs, self.first, self.samples = scene, inputs, first, samples
        self.checked = False
        self.steps = inputs.gravity.shape[0]
        like = inputs.coefficients
        init(like.device)
        self.gpu = like.is_cuda
        self.batch, _, self.count = like.shape
        self.elements = inputs.prony.shape[1]
        self.components = layout.state_components(self.elements)
        per_simulation = max(1, CPU_LANES // self.batch)
        padded = -(-self.count // WARP) * WARP
        self.lanes = padded if self.gpu else min(self.count, per_simulation)
        self.rows = GPU_ROWS if self.gpu else self.lanes
        self.numbers = like.new_tensor([scene.dt, scene.cell, 1 / scene.cell, scene.blend])
        self.flags = torch.zeros(2, dtype=torch.int32, device=like.device)
        self.clock = torch.zeros(3, dtype=torch.int32, device=like.device)
        self.zeroed: dict[str, Tensor] = {}
        self.chunks: list[Chunk] = []

    def forward(self, start: Tensor, *, keep: bool, observe: Observe) -> Tensor:
        """Advance the state [B, S, N] over the segment.

        Args:
            start: State before the first substep.
            keep: Keep all states and the adjoint's nodal quantities instead of the last two states.
            observe: Called with each sampled substep and its state.

        Returns:
            States [T + 1, B, S, N], or [2, B, S, N] of which ``T % 2`` is the last.

        Raises:
            SimulationDiverged: if a particle leaves the analysis box, collapses or is no longer finite.
        """
        ring = self.steps + 1 if keep else 2
        states = start.new_empty(ring, *start.shape)
        states[0] = start
        if 0 in self.samples:
            observe(0, states[0])
        if not self._inside(states[0]):
            self._report(0, states[0], states[0])
        first, single_until = 0, 0
        while first < self.steps:
            before = states[first % ring].clone()
            chunk = self._chunk(first, before, 1 if first < single_until else CHUNK, keep)
            seen: list[tuple[int, Tensor]] = []
            whole = self._advance(chunk, states, lambda k, state, seen=seen: seen.append((k, state.clone())))
            if whole:
                for k, state in seen:
                    observe(k, state)
                if keep:
                    self.chunks.append(chunk)
                first += chunk.steps
            elif chunk.steps == 1:
                self._report(first, before, states[(first + 1) % ring])
            else:
                states[first % ring] = before
                single_until = first + chunk.steps
        return states

    def record(self, states: Tensor) -> tuple[Tensor, ...]:
        """The memory of ``forward(keep=True)``, which :meth:`restore` takes, as five tensors.

        They are the states, the node velocities of all chunks, those before forces (FLIP), the order of particles
        (CUDA), and a table of integers on the CPU: first substep, steps, size, and lowest nodes of each chunk.
        """
        chunks = [self.chunks.pop(0) for _ in range(len(self.chunks))]
        empty, order = states.new_empty(0), self.flags[:0]
        table = [[c.first, c.steps, *c.size, *c.low.flatten().tolist()] for c in chunks]
        return (
            states,
            torch.cat([empty, *(c.node for c in chunks)]),
            torch.cat([empty, *(c.before for c in chunks)]),
            torch.cat([order, *(c.order.flatten() for c in chunks)]),
            torch.tensor(table, dtype=torch.int64).reshape(len(chunks), 5 + 3 * self.batch),
        )

    def restore(self, record: Sequence[Tensor]) -> Tensor:
        """Take over what another integrator of the same segment recorded, for ``backward``; returns all states."""
        states, nodes, befores, orders, table = record
        at = [0, 0, 0]
        for first, steps, nx, ny, nz, *low in table.tolist():
            size = steps * self.batch * nx * ny * nz
            lengths = (
                size * layout.NODE,
                size * layout.BEFORE if self.scene.blend > 0 else 0,
                self.batch * self.lanes if self.gpu else 0,
            )
            node, before, order = (
                whole[start : start + length]
                for whole, start, length in zip((nodes, befores, orders), at, lengths, strict=True)
            )
            at = [start + length for start, length in zip(at, lengths, strict=True)]
            corner = self.flags.new_tensor(low).view(self.batch, 3)
            self.chunks.append(Chunk(first, steps, corner, (nx, ny, nz), node, before, order))
        return states

    def backward(self, states: Tensor, bar: Tensor, add: Observe, *, wanted: frozenset[str]) -> dict[str, Tensor]:
        """Carry the gradient by the last state back to the first, in place.

        Args:
            states: All states, from ``forward(keep=True)``.
            bar: Gradient by the last state [B, S, N]; holds the one by the first state afterwards.
            add: Called with each sampled substep and ``bar``, to add the gradient by its observations.
            wanted: Names of the inputs whose gradient is wanted; that by the Maxwell elements costs extra.

        Returns:
            Gradients by the fields of ``Inputs``, under their names.
        """
        i = self.inputs
        rows, steps, batch = self.rows, self.steps, self.batch
        sums = {
            "coefficients": torch.zeros_like(i.coefficients),
            "prony": bar.new_zeros(rows, batch, self.elements, layout.PRONY),
            "pressure": bar.new_zeros(steps + 1, rows, batch, i.pressure.shape[2]),
            "gravity": bar.new_zeros(steps, rows, batch, 3),
            "force": bar.new_zeros(steps, rows, batch, i.force.shape[2], 3),
            "planes": bar.new_zeros(rows, batch, i.planes.shape[1], layout.PLANE),
            "origin": bar.new_zeros(rows, batch, 3),
        }
        if self.steps in self.samples:
            add(self.steps, bar)
        for chunk in reversed(self.chunks):
            self._retreat(chunk, states, bar, sums, add, "prony" in wanted)
        by_time = ("pressure", "gravity", "force")
        return {name: s if name == "coefficients" else s.sum(1 if name in by_time else 0) for name, s in sums.items()}

    def _chunk(self, first: int, state: Tensor, longest: int, keep: bool) -> Chunk:
        """The active box around the particles, and the substeps that it is expected to last."""
        cell = self.scene.cell
        x = state[:, : layout.VELOCITY] - self.inputs.origin.unsqueeze(-1)
        low = torch.floor(x.amin(-1) / cell - 0.5).to(torch.int32) - MARGIN
        high = torch.floor(x.amax(-1) / cell - 0.5).to(torch.int32) + MARGIN
        nx, ny, nz = (int(n) + 3 for n in (high - low).amax(0).tolist())
        travel = float(state[:, layout.VELOCITY : layout.AFFINE].abs().max()) * self.scene.dt / cell
        steps = min(longest, self.steps - first, max(1, int(MARGIN / 2 / travel)) if travel > 0 else longest)
        slots = steps if keep else 1
        node = state.new_empty(slots * self.batch * nx * ny * nz * layout.NODE)
        flip = node.numel() // layout.NODE * layout.BEFORE if self.scene.blend > 0 else 0
        order = cell_order(x / cell, self.lanes) if self.gpu else low[:0]
        return Chunk(first, steps, low.contiguous(), (nx, ny, nz), node, state.new_empty(flip), order)

    def _zeros(self, name: str, size: int) -> Tensor:
        """A buffer that every chunk leaves all zero, made larger where needed."""
        if name not in self.zeroed or self.zeroed[name].numel() < size:
            self.zeroed[name] = self.numbers.new_zeros(size)
        return self.zeroed[name]

    def _serial_nodes(self, chunk: Chunk) -> bool:
        return not self.gpu and self.batch * chunk.nodes < FEW_NODES

    def _tensors(self, chunk: Chunk, states: Tensor, scratch: Tensor) -> list[Tensor]:
        i, s = self.inputs, self.scene
        new = states.new_empty(self.batch * chunk.nodes * layout.NODE_NEW)
        parts = 1 if self.gpu else self.lanes
        flip = self._zeros("before", parts * self.batch * chunk.nodes * layout.BEFORE if s.blend > 0 else 0)
        return [
            *(self.clock, self.numbers, states, i.coefficients, s.kind, chunk.order),
            *(i.prony, i.pressure, i.gravity, i.force),
            *(s.share, i.planes, s.plane_kind, i.origin, chunk.low, scratch, chunk.node, flip),
            *(chunk.before, new, self.flags),
        ]

    def _sizes(self, chunk: Chunk) -> list[int]:
        groups, planes = self.scene.share.shape[0], self.scene.plane_kind.shape[0]
        chambers = self.inputs.pressure.shape[2]
        return [
            *(self.batch, self.count, self.lanes, self.components, self.elements, chambers, groups),
            *(int(self.scene.springs or self.scene.drags), planes, *chunk.size, chunk.first, chunk.steps),
        ]

    def _advance(self, chunk: Chunk, states: Tensor, observe: Observe) -> bool:
        """Run a chunk; False if a particle left the active box or the analysis box, collapsed or is not finite."""
        parts = 1 if self.gpu else self.lanes
        scratch = self._zeros("grid", parts * self.batch * chunk.nodes * layout.NODE)
        slots = chunk.node.numel() // (self.batch * chunk.nodes * layout.NODE)
        launch = capture(
            forward.substep,
            self.gpu,
            self._serial_nodes(chunk),
            self.scene.stiffens,
            *_flat(self._tensors(chunk, states, scratch)),
            *self._sizes(chunk),
            states.shape[0],
            slots,
        )
        self.clock[layout.NOW] = done = -1
        wanted = [k - chunk.first for k in self.samples if chunk.first < k <= chunk.first + chunk.steps]
        for stop in sorted({*wanted, chunk.steps}):
            launch(stop - done)
            done = stop
            if stop in wanted:
                observe(chunk.first + stop, states[(chunk.first + stop) % states.shape[0]])
        last = states[(chunk.first + chunk.steps) % states.shape[0]]
        if not bool(self.flags.any()) and bool(torch.isfinite(last).all()) and self._inside(last):
            return True
        self.flags.zero_()
        self.zeroed.clear()
        return False

    def _retreat(
        self, chunk: Chunk, states: Tensor, bar: Tensor, sums: dict[str, Tensor], add: Observe, prony: bool
    ) -> None:
        parts = 1 if self.gpu else self.lanes
        scratch = self._zeros("adjoint", parts * self.batch * chunk.nodes * layout.ADJOINT_NEW)
        node_bar = bar.new_empty(self.batch * chunk.nodes * layout.NODE)
        before_bar = bar.new_empty(self.batch * chunk.nodes * layout.BEFORE)
        launch = capture(
            backward.substep_adjoint,
            self.gpu,
            self._serial_nodes(chunk),
            self.scene.stiffens,
            *_flat([*self._tensors(chunk, states, scratch), bar, node_bar, before_bar, *sums.values()]),
            *self._sizes(chunk),
            chunk.nodes if self.gpu else self.lanes,
            self.rows,
            int(prony),
        )
        self.clock[layout.NOW] = chunk.steps - 1
        at = chunk.steps
        # The gradient by a sampled state enters after the pass that leaves the rest of it in ``bar``.
        for stop in sorted({0, *(k - chunk.first for k in self.samples)}, reverse=True):
            if 0 <= stop < chunk.steps:
                launch(at - stop)
                at = stop
                if chunk.first + stop in self.samples:
                    add(chunk.first + stop, bar)
        launch(1)

    def _inside(self, state: Tensor) -> bool:
        """Whether every particle keeps its three nodes per axis in the analysis box."""
        x = state[:, : layout.VELOCITY]
        edge = self.scene.cell
        low = x.new_tensor(self.scene.low).view(1, 3, 1) + edge
        high = x.new_tensor(self.scene.high).view(1, 3, 1) - edge
        return bool(((x > low) & (x < high)).all())

    def _report(self, first: int, before: Tensor, after: Tensor) -> None:
        """Raise ``SimulationDiverged`` for the first particle of ``after`` that violates a bound."""
        x = after[:, : layout.VELOCITY]
        finite = torch.isfinite(after).all(1)
        F = after[:, layout.DEFORMATION : layout.HISTORY].reshape(self.batch, 3, 3, self.count).permute(0, 3, 1, 2)
        J = torch.where(self.scene.kind.unsqueeze(0) < 0, torch.linalg.det(F), F[..., 0, 0])
        low, high = (x.new_tensor(c).view(1, 3, 1) for c in (self.scene.low, self.scene.high))
        inside = ((x > low + self.scene.cell) & (x < high - self.scene.cell)).all(1)
        moved = (x - before[:, : layout.VELOCITY]).abs().amax(1) / self.scene.cell
        smaller = "a smaller time step, a lower pressure or stiffer void (epsilon)"
        larger = "a larger analysis box, or a shorter run"
        # If only the kernel's rounding finds J <= 0, and torch's does not, the most compressed particle is reported.
        lowest = torch.zeros_like(finite).view(-1).index_fill(0, J.view(-1).argmin(), True).view_as(finite)
        cases = (
            (~finite, "the state is not finite", "J", J, smaller),
            (J <= 0, "the volume ratio is not positive", "J", J, smaller),
            (moved > 1, "it moved by more than a cell in one step", "cells", moved, smaller),
            (~inside, "about to leave the analysis box", "farthest coordinate in m", x.abs().amax(1), larger),
            (lowest, "the volume ratio is hardly positive", "J", J, smaller),
        )
        for bad, quantity, label, value, remedy in cases:
            if bool(bad.any()):
                b, p = (int(n) for n in bad.nonzero()[0])
                step = self.first + first + 1
                raise SimulationDiverged(
                    step=step,
                    time=step * self.scene.dt,
                    particle=p,
                    quantity=f"{quantity} ({label} = {float(value[b, p]):.4g})",
                    batch=b,
                    remedy=remedy,
                )


def cell_order(x: Tensor, length: int) -> Tensor:
    """Particles in the order of their lowest nodes, so that neighbouring threads add to the same ones.

    Within a cell they go by z, so that this holds for longer while they move along z.

    Args:
        x: Positions [B, 3, N] in cells.
        length: At least N.

    Returns:
        int32 [B, length]; -1 fills up.
    """
    place = torch.floor((x - 0.5) * x.new_tensor([1.0, 1.0, 8.0]).unsqueeze(-1)).long()
    place -= place.amin(-1, keepdim=True)
    size = place.amax((0, 2)) + 1
    key = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    order = torch.argsort(key, dim=-1, stable=True).to(torch.int32)
    return torch.nn.functional.pad(order, (0, length - order.shape[1]), value=-1)


def _flat(tensors: list[Tensor]) -> list[Tensor]:
    """One-dimensional views; an empty tensor has no address to hand over, so that a single number stands for it.

    Detached, as Taichi compiles a kernel anew for every pattern of tensors that require gradients.
    """
    return [t.detach().view(-1) if t.numel() else t.new_zeros(1) for t in tensors]
