"""Time integration of a segment of the total-Lagrangian form and its adjoint: state, buffers, launches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import taichi as ti
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout, total, total_adjoint
from torchsoro.simulation.ops.arena import Arena, check_count
from torchsoro.simulation.ops.chambers import chamber_adjoint
from torchsoro.simulation.ops.divergence import outside, report
from torchsoro.simulation.ops.fixed import fixed
from torchsoro.simulation.ops.launch import capture
from torchsoro.simulation.ops.memory import empty_record
from torchsoro.simulation.ops.scene import Inputs, Observe, ObserveMany, Scene
from torchsoro.simulation.ops.tiles import tiles_of
from torchsoro.simulation.ops.total_selfcontact import TotalSelfContact
from torchsoro.simulation.runtime import init
from torchsoro.simulation.sums import pairwise_sum

CHUNK = 1024  # substeps between two checks for divergence
LAUNCH = 256  # substeps in a launch on a GPU, lest one that also drives a screen takes a large body's for hung
BLOCKS = 2  # of 256 threads that a multiprocessor runs at a time: Taichi asks for so many, at 128 registers a thread
TALLIES = 64  # shares in which sums over all nodes or points are taken
_NEVER = 2**31 - 1


_SUMS = ("coefficients", "prony", "pressure", "gravity", "force", "planes")  # those of inputs that come first


@lru_cache
def most_blocks(device: torch.device, shape: int, dtype: torch.dtype) -> int:
    """Blocks that a GPU runs at the same time. With more, those that run would wait for others for ever."""
    gpu = torch.cuda.get_device_properties(device)
    shared = 1024 + layout.SHAPES[shape].pad * dtype.itemsize + 4 * total.KEPT  # CUDA takes the kilobyte
    return min(BLOCKS, gpu.shared_memory_per_multiprocessor // shared) * gpu.multi_processor_count


def _features(scene: Scene) -> int:
    """What the kernels are compiled for, see ``layout``."""
    assert scene.lattice is not None
    there = {
        layout.LOADED: scene.viscous or scene.springs or len(scene.share) > 0,
        layout.STIFFENS: scene.stiffens,
        layout.SOFTENS: scene.softens,
        layout.IMMERSED: scene.immersed,
        layout.TIED: scene.tie_share is not None,
        layout.PUSHED_NODES: scene.node_share is not None,
        layout.HOLLOW: scene.lattice.walls is not None,
        layout.RECORDED: scene.only_markers and scene.markers is not None,
        layout.SHARED_AIR: scene.shared,
        layout.REPELLED: scene.self_contact,
    }
    return sum(feature for feature, on in there.items() if on)


class TotalSegmentIntegrator:
    """One segment: ``forward`` from a state to all states (or the last two), ``backward`` along the kept ones.

    The counterpart of ``segment.SegmentIntegrator``; the order of every sum is fixed, so that runs agree bit by bit.

    Args:
        scene: Constant data; its tensors by particle are by point of the lattice here.
        inputs: The segment's tensors, likewise.
        first: Number of the first substep in the whole run, for messages.
        samples: Substeps to observe, counted within the segment.

    Attributes:
        checked: Whether the segment has been found free of divergence before, so that ``forward`` need not look again.
    """

    def __init__(self, scene: Scene, inputs: Inputs, *, first: int, samples: tuple[int, ...]) -> None:
        assert scene.lattice is not None
        self.scene, self.inputs, self.first, self.samples = scene, inputs, first, samples
        self.lattice = scene.lattice
        self.steps = inputs.gravity.shape[0]
        like = inputs.coefficients
        init(like.device)
        self.gpu = like.is_cuda
        self.batch, self.points, self.nodes = like.shape[0], self.lattice.count, self.lattice.nodes
        self.elements, self.chambers = inputs.prony.shape[1], inputs.pressure.shape[2]
        self.planes, self.groups = inputs.planes.shape[1], scene.share.shape[0]
        self.history = 6 * self.elements + scene.softens
        self.features = _features(scene)
        common = fixed(scene, inputs)
        self.nodal, self.chamber, self.tables, self.fixed = common.nodal, common.chamber, common.tables, common.arena
        self.checked = False
        self.near = None if scene.markers is None or not scene.only_markers else scene.markers.near.to(like.device)
        self.watched = 0 if self.near is None else len(self.near)
        force, self.force_row = self._forces()
        self.supply = Arena("supply", inputs.pressure, inputs.gravity, force)
        self.tiles = tiles_of(self.lattice, like)
        tiles, chunks = self.tiles.count, -(-self.nodes // layout.TILE)
        # Of each tile, of each pair of a tile and a chamber that has points in it, and of the rates in each tile.
        self.wall_chunks = len(self.tables.views[layout.WALL_CHUNK - layout.KIND])
        self.wall_rows = len(self.tables.views[layout.WALL_COUNT - layout.KIND])
        in_chambers = len(self.tables.views[layout.SLOT_CHAMBER - layout.KIND]) + self.wall_chunks
        self.slots = tiles + in_chambers + tiles * int(scene.viscous)
        self.ties = inputs.ties.shape[1]
        items = self.batch * max(tiles + self.wall_chunks + self.ties, chunks)
        most = most_blocks(like.device, self.tiles.shape, like.dtype) if self.gpu else 0
        self.most, self.blocks = most, min(most, items)
        pads = 0 if self.gpu else items
        shapes = (self.batch, self.slots, self.tiles.of.slot), (self.batch, in_chambers), (pads, self.tiles.of.pad)
        vectors = self.batch, layout.WALL_VECTORS, self.wall_chunks * layout.TILE
        repulsion = self.batch, 3, self.nodes if scene.self_contact else 0
        beads = self.batch, self.ties if scene.chain_steps else 0, layout.CHAIN_STATE
        self.scratch = Arena.zeros("scratch", like, *shapes, (self.batch, self.ties, 3), vectors, repulsion, beads)
        self.kept = Arena.zeros("kept", like, (0,), (0,), (0,))

    def _started(self, steps: Tensor) -> Tensor:
        """Which of the forces that last once they act do so in these substeps of the segment [n, 1, forces, 1]."""
        return (self.first + steps[:, None] >= torch.tensor(self.scene.force_start)).view(len(steps), 1, -1, 1)

    def _forces(self) -> tuple[Tensor, Tensor]:
        """Forces [rows, B, forces, 3], and the row of each substep [steps]: few, where they last once they act."""
        force, starts, steps = self.inputs.force, self.scene.force_start, torch.arange(self.steps, dtype=torch.int32)
        if starts is None or not self.scene.forces:
            return force, steps
        begins = torch.tensor(sorted({0, *(s - self.first for s in starts if 0 < s - self.first < self.steps)}))
        return force * self._started(begins).to(force), torch.bucketize(steps, begins, right=True, out_int32=True) - 1

    def forward(self, start: Tensor, *, keep: bool, observe: ObserveMany) -> Tensor:
        """Advance the state [B, L] over the segment; as ``SegmentIntegrator.forward``."""
        ring, slots = (self.steps + 1, self.steps) if keep else (2, 1)
        # The kernels write no history at places without a particle.
        check_count("states", ring * start.numel())
        states = (start.new_empty if self.scene.absent is None else start.new_zeros)(ring, *start.shape)
        states[0] = start
        self.kept = Arena.zeros("kept", start, *self._kept(slots, len(self._recorded())))
        ints = self._ints([self.fixed, self.supply, self.kept, self.scratch], ring=ring, kept_ring=slots)
        march = self._march(
            *(total.total_march, total.total_substep, ints, self.fixed.buffer, self.supply.buffer, states.view(-1)),
            *(self.kept.buffer, self.scratch.buffer),
        )
        if self.scene.self_contact:
            march = self._with_contact(march, self._contact(states))
        if self.near is not None:  # simulations go on apart: kernels record their markers, and the host need not wait
            first = states[:1, :, : 6 * self.nodes].unflatten(2, (6, self.nodes)).index_select(3, self.near)
            march(0, self.steps)
            seen = self.kept.views[2]
            if self.samples:
                observe(list(self.samples), (torch.cat([first, seen]) if 0 in self.samples else seen).flatten(2))
            return states
        if 0 in self.samples:
            observe(0, states[0])
        now = 0
        while now < self.steps:
            before = None if keep or self.scene.apart else states[now % 2].clone()
            stop = min([self.steps, *(k for k in (now + CHUNK, *self.samples) if k > now and not self.checked)])
            march(now, stop)
            after = states[stop % ring]
            if not self.checked and self._wrong(ints, after):
                collapsed = int(ints[layout.COLLAPSED])
                if collapsed == _NEVER:
                    report(self.scene, self.inputs, self.first + stop, after)
                if before is not None:
                    states[now % 2] = before
                    march(now, collapsed)
                report(self.scene, self.inputs, self.first + collapsed, states[collapsed % ring])
            if stop in self.samples:
                observe(stop, after)
            now = stop
        return states

    def _wrong(self, ints: Tensor, state: Tensor) -> bool:
        """Whether a solid has collapsed, or a state is not finite or outside of the box; the host waits once."""
        if self.scene.apart:
            return False
        out = outside(self.scene, self.inputs, state)
        return bool((ints[layout.COLLAPSED] < _NEVER) | ~torch.isfinite(state).all() | out.any())

    def record(self, states: Tensor) -> tuple[Tensor, ...]:
        """The memory of ``forward(keep=True)``: the states, and quantities of every substep; ``RECORD`` tensors."""
        return states, self.kept.buffer, *empty_record(states)[2:]

    def restore(self, record: Sequence[Tensor]) -> Tensor:
        """Take over the record of another integrator of the same segment, for ``backward``; returns all states."""
        self.kept = Arena.over("kept", record[1], *self._kept(self.steps, 0))
        return record[0]

    def backward(self, states: Tensor, bar: Tensor, add: Observe, *, wanted: frozenset[str]) -> dict[str, Tensor]:
        """Carry the gradient by the last state back to the first, in place; as ``SegmentIntegrator.backward``."""
        i, steps, b, nodes, points = self.inputs, self.steps, self.batch, self.nodes, self.points
        tallies = TALLIES if {"gravity", "force"} & wanted else 0
        if self.scene.absent is not None:
            bar[:, 6 * nodes :].view(b, self.history, points).masked_fill_(self.scene.absent, 0)
        sums = Arena.zeros(
            "sums",
            bar,
            i.coefficients.shape,
            (b, self.elements, layout.PRONY, points if "prony" in wanted else 1),
            i.pressure.shape,
            (steps, tallies, b, 3),
            (steps, tallies, b, self.scene.forces, 3),
            (b, self.planes, layout.PLANE, nodes),
            self.nodal.shape,
            self.chamber.shape,
            (b, 2, points if self.scene.softens else 0),
            (b, 3, nodes if self.scene.immersed else 0),
            i.ties.shape,
        )
        shapes = (b, 3, nodes), (2, b, 3, nodes), (b, self.chambers), (b, points if self.chambers else 0)
        back = Arena.zeros("backward", bar, *shapes)
        arenas = [self.fixed, self.supply, self.kept, self.scratch, back, sums]
        ints = self._ints(arenas, want_prony="prony" in wanted, tallies=tallies)
        march = self._march(
            *(total_adjoint.total_march_adjoint, total_adjoint.total_substep_adjoint, ints),
            *(self.fixed.buffer, self.supply.buffer, states.view(-1), self.kept.buffer, self.scratch.buffer),
            *(bar.view(-1), back.buffer, sums.buffer),
            backward=True,
        )
        contact = self._contact(states, back.buffer) if self.scene.self_contact else None
        if contact is not None:
            march = self._with_contact(march, contact, backward=True)
        at = steps
        for stop in sorted({0, *self.samples}, reverse=True):
            if stop < at:
                march(stop, at)
                at = stop
            if stop in self.samples:
                add(stop, bar)
        march(-1, 0)
        found: dict[str, Tensor] = dict(zip(_SUMS, sums.views, strict=False))
        nodal_bar, chamber_bar, softening_bar, quadratic_bar, ties_bar = sums.views[len(_SUMS) :]
        mass, drag = i.coefficients[:, layout.MASS], i.coefficients[:, layout.DRAG]
        mass_bar, drag_bar, attached_bar = self.lattice.nodal_adjoint(mass, drag, self.scene.dt, i.attached, nodal_bar)
        gas = self.scene.gas_chambers
        by_chamber = chamber_adjoint(self.scene, i.coefficients, self.chamber[:, :gas], chamber_bar[:, :gas])
        found["coefficients"] = found["coefficients"] + by_chamber
        found["coefficients"][:, layout.MASS] += mass_bar
        found["coefficients"][:, layout.DRAG] += drag_bar
        found |= {name: pairwise_sum(found[name]) for name in ("prony", "planes")}
        found |= {name: pairwise_sum(found[name].movedim(1, -1)) for name in ("gravity", "force")}
        found["pressure"] = found["pressure"].clone()
        if self.scene.force_start is not None:
            found["force"] = (found["force"] * self._started(torch.arange(steps)).to(bar)).sum(0, keepdim=True)
        if self.scene.immersed:
            assert self.lattice.faces is not None
            found["fluid"] = torch.einsum("bcn,nc->b", quadratic_bar, self.lattice.faces.front.to(bar)) / 2
        found |= {"softening": pairwise_sum(softening_bar), "ties": ties_bar.clone()}
        found["air"] = chamber_bar[:, gas:, layout.CHAMBER_STIFFNESS].clone()
        if contact is not None:
            found["coefficients"] += contact.coefficients_bar()
        return {**found, "attached": attached_bar}

    def _contact(self, states: Tensor, back: Tensor | None = None) -> TotalSelfContact:
        """Contact of the bodies with themselves in a ring of states."""
        offset = self.scratch.offsets[layout.REPULSION - layout.PARTIALS]
        return TotalSelfContact(self.scene, self.inputs.coefficients, states, self.scratch.buffer, offset, back)

    def _with_contact(
        self, march: Callable[[int, int], None], contact: TotalSelfContact, backward: bool = False
    ) -> Callable[[int, int], None]:
        """A march that stops at each substep, for the forces before it, or after it for their adjoint."""

        def stop_and_go(first: int, last: int) -> None:
            for t in reversed(range(first, last)) if backward else range(first, last):
                if not backward:
                    contact.act(t)
                march(t, t + 1)
                if backward and t >= 0:
                    contact.act(t)

        return stop_and_go

    def _march(self, on_gpu, on_cpu, *buffers: Tensor, backward: bool = False) -> Callable[[int, int], None]:
        """A function that takes the substeps from its first number to before its second, or these back."""
        if self.gpu:
            real = ti.f64 if buffers[1].dtype == torch.float64 else ti.f32
            launch = capture(on_gpu, real, self.most, self.features, self.tiles.shape, 0, 0, 0, *buffers)
            arrivals = 0

            def go(first: int, last: int) -> None:
                nonlocal arrivals
                starts = range(first, last, LAUNCH)
                for start in reversed(starts) if backward else starts:
                    stop = min(start + LAUNCH, last)
                    launch(1, start, stop, arrivals)
                    arrivals += 2 * self.blocks * (stop - start)

            return go
        step = capture(on_cpu, self.features, self.tiles.shape, 0, *buffers)

        def march(first: int, last: int) -> None:
            for t in reversed(range(first, last)) if backward else range(first, last):
                step(1, t)

        return march

    def _ints(self, arenas: list[Arena], **more: int) -> Tensor:
        """The buffer of integers: clock, sizes, offset of each quantity in its buffer, then the index tables."""
        names = ("nx", "ny", "nz", "mx", "my", "mz", "tx", "ty", "tz")
        values = (*self.lattice.points, *self.lattice.shape, *self.tiles.counts)
        sizes = {
            **dict(zip(names, values, strict=True)),
            **{"batch": self.batch, "elements": self.elements, "chambers": self.chambers, "groups": self.groups},
            **{"springs": int(self.scene.springs), "viscous": int(self.scene.viscous), "planes": self.planes},
            **{"slots": self.slots, "blocks": self.blocks, "steps": self.steps, "histories": self.history},
            **{"faced": int(self.lattice.faces is not None), "ties": self.ties},
            **{"wall_chunks": self.wall_chunks, "wall_rows": self.wall_rows},
            **{"pushes": self.scene.forces - self.groups, "fluid": int(self.scene.immersed)},
            "chain_steps": self.scene.chain_steps,
            **{"watched": self.watched, "sample_at": layout.HEAD + len(self.tables.buffer)},
            **{"row_at": layout.HEAD + len(self.tables.buffer) + (self.steps if self.watched else 0)},
            **{name: int(value) for name, value in more.items()},
        }
        head = [_NEVER, 0, *(sizes.get(name, 0) for name in layout.SIZES)]
        given = {arena.name: arena.offsets for arena in [self.tables, *arenas]}
        for name, quantities in layout.BUFFERS.items():
            shift = layout.HEAD if name == "integers" else 0
            head += [shift + offset for offset in given.get(name, [0] * len(quantities))]
        assert len(head) == layout.HEAD
        values, samples = torch.tensor(head, dtype=torch.int32), self._recorded()
        of_step = torch.full((self.steps if self.watched else 0,), -1, dtype=torch.int32)
        of_step[[k - 1 for k in samples]] = torch.arange(len(samples), dtype=torch.int32)
        of_step = torch.cat([of_step, self.force_row])
        if self.gpu:  # from pinned memory, as the host would wait otherwise
            device = self.tables.buffer.device
            values, of_step = (t.pin_memory().to(device, non_blocking=True) for t in (values, of_step))
        return torch.cat([values, self.tables.buffer, of_step])

    def _recorded(self) -> list[int]:
        """Substeps after which kernels record the motion of what is near markers."""
        return [k for k in self.samples if k > 0 and self.watched]

    def _kept(self, slots: int, samples: int) -> tuple[tuple[int, ...], ...]:
        """Shapes of the quantities that are kept of every substep beside the states, and of what is recorded."""
        seen = samples, self.batch, 6, self.watched
        return (slots, self.batch, self.chambers), (slots, self.batch, 3, self.nodes), seen
