"""Time integration of a segment of the total-Lagrangian form on a CPU, sixteen lanes at a time, and its adjoint."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import local

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.compiled import remove_stale_code
from torchsoro.simulation.kernels.lane_adjoint import Sums, march_back
from torchsoro.simulation.kernels.lane_contact import PLANE
from torchsoro.simulation.kernels.lane_march import NEVER, SCRATCH, Case, Mesh, Work, march
from torchsoro.simulation.kernels.lane_points import MAXWELL, VOID_FRACTION, VOLUME
from torchsoro.simulation.kernels.lane_selfcontact import SelfContact
from torchsoro.simulation.kernels.lane_threads import SYNC
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.ops.chambers import air_volumes, chamber_means
from torchsoro.simulation.ops.divergence import outside, report
from torchsoro.simulation.ops.lane_gradients import (
    COEFFICIENTS,
    NOT_OF_GAS,
    PLANE_NUMBERS,
    PRONY,
    gather_gradients,
    node_shares,
    signs,
)
from torchsoro.simulation.ops.lane_selfcontact import fresh_contact, list_pairs, surface_contact
from torchsoro.simulation.ops.lanes import Lanes, lay_out
from torchsoro.simulation.ops.memory import kept_memory
from torchsoro.simulation.ops.once import once
from torchsoro.simulation.ops.scene import Inputs, Observe, ObserveMany, Scene
from torchsoro.simulation.ops.selfcontact import Surface
from torchsoro.simulation.threads import thread_count

_ROOM = 2**22  # numbers of samples that are observed at a time


_own = local()


def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads of the caller alone: those that march with several could wait for each other for ever."""
    if getattr(_own, "threads", 0) != threads:
        _own.threads, _own.pool = threads, ThreadPoolExecutor(threads)
    return _own.pool


def in_lanes(scene: Scene, like: Tensor) -> bool:
    """Whether a scene's simulations on the device of a tensor run in lanes."""
    return scene.lattice is not None and scene.lanes and not like.is_cuda


def numbers(t: Tensor) -> np.ndarray:
    """A tensor as a flat array, of one number at least."""
    flat = t.detach().contiguous().reshape(-1)
    return (flat if len(flat) else flat.new_zeros(16)).numpy()


def aligned(count: int, dtype: np.dtype) -> np.ndarray:
    """Zeros that begin with a cache line."""
    wide = np.zeros(count + LANES, dtype)
    first = -wide.ctypes.data % 64 // wide.itemsize
    return wide[first : first + count]


class LaneIntegrator:
    """One segment in lanes: the counterpart of ``total.TotalSegmentIntegrator``.

    Args:
        scene: Constant data; its tensors by particle are by point of the lattice here.
        inputs: The segment's tensors, likewise.
        first: Number of the first substep in the whole run, for messages.
        samples: Substeps to observe, counted within the segment.
    """

    def __init__(self, scene: Scene, inputs: Inputs, *, first: int, samples: tuple[int, ...]) -> None:
        assert scene.lattice is not None
        remove_stale_code()
        self.scene, self.inputs, self.first, self.samples = scene, inputs, first, samples
        self.lattice, self.checked = scene.lattice, False
        self.steps = inputs.gravity.shape[0]
        like = inputs.coefficients
        self.batch, self.elements = like.shape[0], inputs.prony.shape[1]
        self.lanes: Lanes = lay_out(scene.lattice, scene.kind, scene.air, self.batch, like.dtype)
        self.mesh: Mesh = self.lanes.mesh
        self.history = 6 * self.elements + scene.softens
        # Nodes whose motion is observed; all if None.
        self.near = scene.markers.near if scene.only_markers and scene.markers is not None else None
        constants = [like, inputs.prony, inputs.planes, inputs.softening, inputs.fluid, inputs.ties]
        constants += [inputs.chains, inputs.air, inputs.attached]
        self.nodal, case, self.surface, self.contact = once(scene, "case", constants, self._constants)
        self.case = case._replace(**self._supply())

    def _constants(self) -> tuple[Tensor, Case, Surface | None, SelfContact]:
        """What the segments of a run have in common: all but what acts over time."""
        c, attached = self.inputs.coefficients.detach(), self.inputs.attached.detach()
        self.nodal = self.lattice.nodal(c[:, layout.MASS], c[:, layout.DRAG], self.scene.dt, attached)
        return self.nodal, self._case(), *surface_contact(self.scene, c, self.lanes)

    def _supply(self) -> dict[str, np.ndarray]:
        """What acts over time, for the kernels."""
        i, lanes = self.inputs, self.lanes
        pressure = i.pressure[:, :, : self.mesh.chambers]
        named = {"pressure": pressure, "gravity": i.gravity, "force": i.force}
        return {name: numbers(lanes.from_batch(t, 1)) for name, t in named.items()}

    def _gas(self, values: Tensor) -> Tensor:
        """Volumes of the gas in each pair of a block and a chamber [groups, pairs, 8, 16]."""
        V = self.lanes.from_points(values.unsqueeze(1))[:, :, :, 0]
        return torch.where(self.lanes.holds(self.scene.air), V[:, self.lanes.pairs[:, 0]], 0.0)

    def _coefficients(self) -> Tensor:
        """Numbers of the points: gas counts as void that only shears; what is absent as void without volume."""
        c = self.inputs.coefficients[:, COEFFICIENTS].clone()
        gas = self.scene.kind >= 0
        c[:, VOID_FRACTION, gas] = 1
        for row in NOT_OF_GAS:
            c[:, row, gas] = 0
        c[:, VOLUME, self.scene.kind == layout.ABSENT] = 0
        c[:, VOID_FRACTION, self.scene.kind == layout.ABSENT] = 1
        found = self.lanes.from_points(c)
        if self.lanes.absent:
            void_fraction = found[:, :, :, VOID_FRACTION]
            void_fraction.masked_fill_(~self.lanes._there, 1.0)
        return found

    def _attached(self) -> Tensor:
        """Stiffness of springs, and the way of each anchor from the particle's place [groups, blocks, 8, 4, 16]."""
        c = self.inputs.coefficients
        if not self.scene.springs:
            return c.new_zeros(0)
        places = self.lattice.places.T.to(c)
        ways = c[:, layout.ANCHOR : layout.ANCHOR + 3] - places
        there = self.scene.kind != layout.ABSENT
        return self.lanes.from_points(torch.cat([c[:, layout.SPRING : layout.SPRING + 1], ways], 1) * there)

    def _case(self) -> Case:
        i, s, lanes = self.inputs, self.scene, self.lanes
        like = i.coefficients
        mass, faces, walls = self.nodal[:, :1], self.lattice.faces, self.lattice.walls
        there = mass > 0
        moves = there if s.held is None else there & ~s.held
        inverse = torch.where(there, 1 / torch.where(there, mass, 1.0), 0.0)
        numbered = i.planes[..., PLANE_NUMBERS] * signs(s, like)
        elastic = s.plane_kind[:, layout.PLANE_ELASTIC].bool()
        ways = torch.einsum("bcn,bkc->bkn", self.nodal[:, 1:4], numbered[..., :3])
        far, area = (ways > 0).to(like), self.lattice.facing(numbered[..., :3])
        touches = torch.ones_like(mass[0])
        if faces is not None:
            far = torch.ones_like(far)
            touches = faces.touches.to(like).unsqueeze(0)
        shares = lanes.from_common_nodes(node_shares(s, self.lattice, like))
        ties = like.new_zeros(self.batch, 0, self.lattice.nodes) if s.tie_share is None else s.tie_share.to(like)
        none = np.zeros(0, numbers(like).dtype)
        quadratic = none
        if s.immersed:
            assert faces is not None
            quadratic = numbers(lanes.from_nodes(faces.front.T.to(like) * i.fluid.view(-1, 1, 1) / 2))
        air = chamber_means(s, like, s.gas_chambers)
        if walls is not None:
            hollow = torch.stack([i.air, walls.volume.to(like).expand_as(i.air)], -1)
            air = torch.cat([air, hollow], 1)
        prony = i.prony[..., PRONY]
        prony = torch.cat([prony, prony[..., 1:2] * (1 - prony[..., 2:])], -1)
        assert prony.shape[-1] == MAXWELL
        return Case(
            dt=float(s.dt),
            groups=lanes.groups,
            elements=self.elements,
            history=self.history,
            flags=(bool(s.stiffens), bool(s.softens), bool(s.viscous), False, bool(s.springs)),
            numbers=numbers(self._coefficients()),
            attached=numbers(self._attached()),
            gas=numbers(self._gas(air_volumes(s, like))),
            maxwell=numbers(lanes.from_batch(prony)),
            softening=numbers(lanes.from_batch(i.softening)),
            inverse_mass=numbers(lanes.from_nodes(inverse)),
            moves=numbers(lanes.from_nodes(moves.to(like))),
            drag_factor=numbers(lanes.from_nodes(self.nodal[:, 4:])),
            reach=numbers(lanes.from_nodes(self.nodal[:, 1:4])),
            air=numbers(lanes.from_batch(air)),
            share=shares.numpy(),
            share_there=(shares.view(len(shares), self.mesh.component // LANES, LANES) != 0).any(-1).numpy(),
            pressure=none,
            gravity=none,
            force=none,
            force_start=self._starts(),
            tie_share=lanes.from_nodes(ties).numpy().reshape(-1),
            tie_stiffness=lanes.from_batch(i.ties).numpy().reshape(-1),
            chains=numbers(lanes.from_batch(i.chains)),
            chain_steps=s.chain_steps,
            quadratic=quadratic,
            plane_numbers=numbers(lanes.from_batch(numbered)),
            plane_stick=s.plane_kind[:, layout.PLANE_STICK].bool().numpy(),
            plane_elastic=elastic.numpy(),
            keeps=bool(elastic.any()),
            area=numbers(lanes.from_nodes(area)),
            far=numbers(lanes.from_nodes(far)),
            touches=lanes.from_common_nodes(touches)[0].numpy(),
            spacing=float(s.cell),
        )

    def _starts(self) -> np.ndarray:
        """First substep at which each force acts, counted within the segment; -1 for one that changes in time."""
        starts = self.scene.force_start
        if starts is None:
            return np.full(self.scene.forces, -1)
        return np.maximum(np.array(starts, np.int64) - self.first, 0)

    def _march(self, work: Work, kernel, *settings) -> list:
        """Run a kernel on all threads."""
        threads = len(work.collapsed) // 8
        if threads == 1:
            return [kernel(self.mesh, self.case, work, 0, 1, *settings)]
        pool = _pool(threads - 1)
        others = [
            pool.submit(kernel, self.mesh, self.case, work, rank, threads, *settings) for rank in range(1, threads)
        ]
        mine = kernel(self.mesh, self.case, work, 0, threads, *settings)
        return [mine, *(o.result() for o in others)]

    def forward(self, start: Tensor, *, keep: bool, observe: ObserveMany) -> Tensor:
        """Advance the state [B, L] over the segment; returns the last one [1, B, L]."""
        mesh, lanes, nodes, groups = self.mesh, self.lanes, self.lattice.nodes, self.lanes.groups
        ring, past = (self.steps + 1, self.steps + 1) if keep else (2, 1)
        size, points = 6 * mesh.component, len(mesh.block_at) * 128 * self.history
        states = kept_memory(start, ring, lanes.groups, size)
        histories = kept_memory(start, past, lanes.groups, points)
        states[0] = lanes.from_nodes(start[:, : 6 * nodes].view(self.batch, 6, nodes)).view(lanes.groups, size)
        if not keep:
            states[1] = states[0]
        else:
            self._clear_ends(states.view(ring, groups, 6, -1))
        if self.history:
            Z = start[:, 6 * nodes :].view(self.batch, self.history, self.lattice.count)
            histories[0] = lanes.from_points(Z).view(lanes.groups, points)
        at = np.full(self.steps + 1, -1)
        inner = [k for k in self.samples if k > 0]
        at[inner] = np.arange(len(inner))
        place = lanes.sixteens(self.near)
        seen = kept_memory(start, len(inner), lanes.groups, 6, LANES * (int(place.max()) + 1))
        slots = self.steps if keep else 1
        # Velocities before drag, which those after a substep do not tell.
        touching = slots if keep and (len(self.case.plane_stick) or self.case.quadratic.size) else 0
        pushed = kept_memory(start, touching, groups, 3, mesh.component)
        self._clear_ends(pushed)
        volumes = start.new_zeros(slots, groups, mesh.chambers, LANES)
        threads = thread_count()
        work = self._work(start, states, histories, pushed, volumes, (seen, at, place), threads)
        if 0 in self.samples:
            motion = start[:, : 6 * nodes].unflatten(1, (6, nodes))
            observe(0, start if self.near is None else motion[..., self.near].flatten(1))
        done, wide = 0, groups * size
        while done < self.steps and (self.scene.apart or work.collapsed.min() > done):
            work = self._listed(work, done % ring * wide)
            done = min(self._march(work, march, done, self.steps, ring, past, not self.scene.apart))
        self.kept = (states, histories, pushed, volumes)
        if done < self.steps:
            last = lanes.to_nodes(states[done % ring].view(groups, 6, -1)).reshape(self.batch, -1)
            report(self.scene, self.inputs, self.first + done, last)
        if self.near is not None and inner:
            observe(inner, lanes.to_some_nodes(seen, self.near).flatten(2))
            inner = []
        each = max(1, _ROOM // (self.batch * 6 * nodes))
        for first in range(0, len(inner), each):
            part = inner[first : first + each]
            wide = seen[first : first + each].movedim(0, 1).reshape(groups, -1, mesh.component)
            flat = lanes.to_nodes(wide).reshape(self.batch, len(part), -1).transpose(0, 1)
            for k, state in zip(part, flat, strict=True):
                self._check(k, state)
            observe(part, flat)
        end = self._joined(states[self.steps % ring], histories[self.steps % past])
        if self.steps not in self.samples:
            self._check(self.steps, end)
        return end.unsqueeze(0)

    def _listed(self, work: Work, state: int) -> Work:
        """With the pairs in contact in a state that begins at a place."""
        spacing = self.scene.cell / 2
        contact = list_pairs(self.surface, work.contact, self.lanes, spacing, work.states, state)
        return work._replace(contact=contact)

    def _check(self, step: int, state: Tensor) -> None:
        """Raise ``SimulationDiverged`` if a state is not finite or outside of the box."""
        if self.checked or self.scene.apart:
            return
        if not bool(torch.isfinite(state).all()) or bool(outside(self.scene, self.inputs, state).any()):
            report(self.scene, self.inputs, self.first + step, state)

    def _clear_ends(self, field: Tensor) -> None:
        """Zero what lies before and behind the nodes [..., component], which the kernels read but do not write."""
        field[..., : self.mesh.front] = 0
        field[..., self.mesh.front + self.mesh.planes * self.mesh.plane :] = 0

    def _work(self, like, states, histories, pushed, volumes, sampled, threads: int) -> Work:
        seen, at, place = sampled
        mesh, groups = self.mesh, self.lanes.groups
        items, size = len(mesh.item_plane), 9 * mesh.patch
        tasks = groups * items
        threads = max(1, min(threads, tasks))
        return Work(
            states=numbers(states),
            histories=numbers(histories),
            pushed=pushed.view(-1).numpy(),
            volumes=numbers(volumes),
            seen=numbers(seen),
            seen_at=at,
            seen_place=place,
            seen_width=seen.shape[-1],
            forces=numbers(like.new_zeros(tasks, size)),
            areas=numbers(like.new_zeros(tasks, mesh.chambers, size)),
            swept=numbers(like.new_zeros(tasks, mesh.chambers, LANES)),
            by_plane=numbers(like.new_zeros(groups, mesh.planes, mesh.chambers, LANES)),
            tension=np.zeros(3 * self.case.tie_stiffness.size, numbers(like).dtype),
            beads=np.zeros(layout.CHAIN_STATE * self.case.tie_stiffness.size, numbers(like).dtype),
            collapsed=np.full(8 * threads, NEVER),
            sync=np.zeros(SYNC, np.int64),
            scratch=aligned(threads * SCRATCH, numbers(like).dtype),
            contact=fresh_contact(self.contact, self.lanes, threads),
        )

    def _joined(self, state: Tensor, history: Tensor) -> Tensor:
        """A state [B, L] from its lanes."""
        lanes, mesh = self.lanes, self.mesh
        motion = lanes.to_nodes(state.view(lanes.groups, 6, mesh.component)).reshape(self.batch, -1)
        if not self.history:
            return motion
        blocks = len(mesh.block_at)
        Z = lanes.to_points(history.view(lanes.groups, blocks, 8, self.history, LANES), self.lattice.count)
        return torch.cat([motion, Z.reshape(self.batch, -1)], 1)

    def record(self, states: Tensor) -> tuple[Tensor, ...]:
        """The memory of ``forward(keep=True)``: states, histories, velocities before contact, volumes."""
        return (*(t.view(-1) for t in self.kept), states.new_empty(0, dtype=torch.int64))

    def restore(self, record: Sequence[Tensor]) -> LaneIntegrator:
        """Take over the record of another integrator of the same segment, for ``backward``; item k is a state."""
        mesh, groups, steps = self.mesh, self.lanes.groups, self.steps
        states, histories, pushed, volumes, _ = record
        points = len(mesh.block_at) * 128 * self.history
        self.kept = (
            states.view(steps + 1, groups, 6 * mesh.component),
            histories.view(steps + 1, groups, points),
            pushed.view(-1, groups, 3, mesh.component),
            volumes.view(steps, groups, mesh.chambers, LANES),
        )
        return self

    def __getitem__(self, k: int) -> Tensor:
        """Displacements and velocities of the nodes after k substeps [B, 6 nodes], from what is kept."""
        lanes = self.lanes
        kept = self.kept[0][k].view(lanes.groups, 6, self.mesh.component)
        return lanes.to_nodes(kept).reshape(self.batch, -1)

    def backward(self, states: object, bar: Tensor, add: Observe, *, wanted: frozenset[str]) -> dict[str, Tensor]:
        """Carry the gradient by the last state back to the first, in place; as ``TotalSegmentIntegrator.backward``.

        Args:
            states: Not needed: those of ``forward`` or ``restore`` are used.
            bar: Gradient by the last state [B, L], then by the first.
            add: Called with each sample and a tensor [B, L], to which it adds the gradient by the state there.
            wanted: Names of the tensors whose gradients are wanted.

        Returns:
            Gradients by the tensors of ``Inputs``.
        """
        lanes, mesh, steps = self.lanes, self.mesh, self.steps
        nodes, groups, blocks = self.lattice.nodes, lanes.groups, len(mesh.block_at)
        states, histories, pushed, volumes = self.kept
        at = np.full(steps + 1, -1)
        at[list(self.samples)] = np.arange(len(self.samples))
        seen = bar.new_zeros(len(self.samples), groups, 6, mesh.component)
        for k, row in zip(self.samples, seen, strict=True):
            given = torch.zeros_like(bar[:, : 6 * nodes])
            add(k, given)
            row.copy_(self._motion_bar(given))
        moving = self._motion_bar(bar)
        Z_bar = bar[:, 6 * nodes :].view(self.batch, self.history, self.lattice.count)
        history = lanes.from_points(Z_bar) if self.history else bar.new_zeros(16)
        if lanes.variations:  # lanes that repeat the last simulation have no part in it
            live = (torch.arange(groups * LANES) < self.batch).view(groups, 1, 1, 1, LANES)
            history = torch.where(live, history, 0.0) if self.history else history
        pulls = bar.new_zeros(1 + (steps if {"gravity", "force"} & wanted else 0), groups, 3, mesh.component)
        flags = (*self.case.flags[:3], "prony" in wanted, self.case.flags[4])
        self.case = self.case._replace(flags=flags)
        items, planes = len(mesh.item_plane), len(self.case.plane_stick)
        sums = Sums(
            *(numbers(t) for t in (moving, history, seen, pulls)),
            *(np.zeros(max(n, 16), self.case.numbers.dtype) for n in (
                2 * groups * 3 * mesh.component,
                groups * items * 9 * mesh.patch if flags[2] else 0,
                len(self.case.gas),
                16 * groups * mesh.chambers,
                len(self.case.numbers),
                len(self.case.attached),
                len(self.case.gas),
                groups * blocks * 48 * self.elements,
                groups * blocks * 32,
                groups * mesh.component,
                groups * mesh.component,
                len(self.case.quadratic),
                len(self.case.tie_stiffness),
                3 * groups * mesh.component,
                groups * planes * PLANE * mesh.component,
                len(self.case.air),
                16 * steps * groups * mesh.chambers,
            )),
        )  # fmt: skip
        sampled = bar.new_zeros(0), at, lanes.sixteens(None)
        work = self._work(bar, states, histories, pushed, volumes, sampled, thread_count())
        at, listed = steps - 1, False
        while at >= -1:
            work = self._listed(work, at * groups * 6 * mesh.component)
            at, listed = max(self._march(work, march_back, sums, at, listed, steps)), True
        first, found = gather_gradients(
            self.scene, self.inputs, lanes, self.case, self.nodal[:, :1], (moving, history, pulls, sums), wanted
        )
        if self.surface is not None:
            wide = torch.from_numpy(work.contact.stiffness_bar).view(groups, -1, LANES)
            stiffness_bar = lanes.summed(wide)
            coefficients = self.inputs.coefficients
            found["coefficients"] += self.surface.stiffness_adjoint(coefficients, self.scene.cell / 2, stiffness_bar)
        bar.copy_(first)
        return found

    def _motion_bar(self, bar: Tensor) -> Tensor:
        """Gradient by displacements and velocities in lanes [groups, 6, component]; none where lanes repeat."""
        lanes, nodes = self.lanes, self.lattice.nodes
        found = lanes.from_nodes(bar[:, : 6 * nodes].view(self.batch, 6, nodes))
        spare = lanes.groups * LANES - self.batch
        if lanes.variations and spare:
            found[-1].view(6, -1, LANES)[..., LANES - spare :] = 0
        return found
