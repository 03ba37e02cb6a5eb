"""Marching a segment of the total-Lagrangian form forward and back: its state, its buffers, its launches."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.kernels import layout, total, total_adjoint
from torchsoro.simulation.ops.lattice import PARTICLES, QUADRATURE, Lattice, numbers, spline
from torchsoro.simulation.ops.launch import capture
from torchsoro.simulation.ops.segment import Inputs, Look, Scene
from torchsoro.simulation.runtime import init

CHUNK = 1024  # substeps between two looks at whether all is well
REPEATS = 2  # substeps in a launch on a GPU, forward; backward a launch takes less time than the substep
TALLIES = 64  # shares in which sums over all nodes or points are taken
_NEVER = 2**31 - 1


def total_state(lattice: Lattice, x: Tensor, v: Tensor, present: Tensor, elements: int) -> Tensor:
    """State of an undeformed body without history.

    Args:
        lattice: Where its particles lie.
        x: Positions of the points [B, points, 3] in m: the lattice's, moved as a whole.
        v: Velocities [B, points, 3] in m/s.
        present: bool [points], where there is a particle.
        elements: Number of Maxwell elements.

    Returns:
        State [B, L], differentiable by x (as a shift of the whole) and v.
    """
    shift = (x - lattice.places.to(x))[:, present].mean(1)
    d = shift.unsqueeze(-1).expand(-1, -1, lattice.nodes)
    rest = x.new_zeros(x.shape[0], 6 * elements * lattice.count)
    return torch.cat([d.flatten(1), lattice.project(v, present).flatten(1), rest], 1)


def total_observe(
    state: Tensor, weight: Tensor, coefficients: Tensor, pressure: Tensor, scene: Scene
) -> tuple[Tensor, ...]:
    """What is recorded of a state, as ``rollout.observe``, of which it is the twin."""
    lattice = scene.lattice
    assert lattice is not None
    batch, nodes = state.shape[0], lattice.nodes
    d, v = state[:, : 3 * nodes].view(batch, 3, nodes), state[:, 3 * nodes : 6 * nodes].view(batch, 3, nodes)
    places = lattice.places.to(state)
    at, how, _ = _stencil(scene, "probes", lambda: scene.probes, PARTICLES, state)
    share = weight / weight.sum(-1, keepdim=True)
    # With the weights of the nodes' masses, so that momentum is what forces gave it.
    nodal = lattice.to_nodes(share).unsqueeze(1)
    volumes, means = [state.new_zeros(batch, 0)], [state.new_zeros(batch, 0)]
    for c in range(pressure.shape[1]):
        gas = (scene.kind == c).nonzero().squeeze(1)
        where, _, slopes = _stencil(scene, f"chamber {c}", lambda gas=gas: gas, QUADRATURE, state)
        gradient = torch.einsum("bcpn,pan->bpca", d[:, :, where], slopes)
        J = torch.linalg.det(gradient + torch.eye(3).to(state))
        V = coefficients[:, layout.VOLUME, gas]
        k = (V * coefficients[:, layout.BULK, gas]).sum(-1) / V.sum(-1)
        volumes.append((V * J).sum(-1, keepdim=True))
        means.append((pressure[:, c] - k * (volumes[-1][:, 0] / V.sum(-1) - 1)).unsqueeze(-1))
    return (
        places[scene.probes] + (d[:, :, at] * how).sum(-1).transpose(1, 2),
        (v[:, :, at] * how).sum(-1).transpose(1, 2),
        share @ places + (nodal * d).sum(-1),
        (nodal * v).sum(-1),
        torch.cat(volumes, -1),
        torch.cat(means, -1),
    )


_SUMS = ("coefficients", "prony", "pressure", "gravity", "force", "planes")


class Arena:
    """Several tensors in one buffer, under one of the names of ``layout.BUFFERS``, in the order given there.

    Attributes:
        name: Of the buffer.
        buffer: All tensors, flat, one after the other; at least one number, as an empty tensor has no address.
        offsets: Where each begins.
        views: Each again, as part of the buffer.
    """

    def __init__(self, name: str, *tensors: Tensor) -> None:
        self.name = name
        assert len(tensors) == len(layout.BUFFERS[name])
        ends = list(itertools.accumulate(t.numel() for t in tensors))
        self.offsets = [0, *ends[:-1]]
        self.buffer = torch.cat([*(t.detach().reshape(-1) for t in tensors), tensors[0].new_zeros(1)])
        self.views = [
            self.buffer[start : start + t.numel()].view(t.shape) for start, t in zip(self.offsets, tensors, strict=True)
        ]


# What kernels look up, and which nodes observations need, for every scene that is in use.
_known: WeakKeyDictionary[Scene, dict[str, Any]] = WeakKeyDictionary()


def _tables(scene: Scene) -> Arena:
    """What the kernels look up, in the order of ``layout.BUFFERS``."""
    known = _known.setdefault(scene, {})
    if "tables" not in known:
        known["tables"] = Arena("integers", *_integers(scene))
    return known["tables"]


def _integers(scene: Scene) -> list[Tensor]:
    assert scene.lattice is not None
    kind, (nx, ny, nz), (mx, my, mz) = scene.kind, scene.lattice.points, scene.lattice.shape
    x, y, z = torch.meshgrid(*(torch.arange(n, device=kind.device) for n in (nx, ny, nz)), indexing="ij")
    corner = (((x // 2 * my + y // 2) * mz + z // 2) * 8 + 4 * (x % 2) + 2 * (y % 2) + z % 2).reshape(-1)
    gas = [(kind == c).nonzero().squeeze(1) for c in range(int(kind.max()) + 1)]
    members = torch.cat([kind.new_zeros(0).long(), *gas])
    rank = torch.zeros_like(kind).index_copy(0, members, torch.arange(len(members), device=kind.device).to(kind))
    filled = torch.tensor([0, *(len(g) for g in gas)]).cumsum(0)
    # Lines, sheets and nodes that have points of a chamber beside them.
    wx, wy, wz = (spline(n, QUADRATURE)[0].to(kind.device) for n in scene.lattice.points)
    near = [[kind.new_zeros(0, n)] for n in (nx * ny * mz, nx * my * mz, mx * my * mz)]
    for c in range(len(gas)):
        line = (kind == c).double().view(nx, ny, nz) @ wz
        sheet = torch.einsum("xyk,yj->xjk", line, wy)
        node = torch.einsum("xjk,xi->ijk", sheet, wx)
        for rows, row in zip(near, (line, sheet, node), strict=True):
            rows.append((row.reshape(1, -1) > 0).to(kind))
    return [kind, scene.plane_kind, corner.to(kind), rank, filled.to(kind), *map(torch.cat, near)]


def _stencil(scene: Scene, name: str, points: Callable[[], Tensor], place: float, like: Tensor) -> tuple[Tensor, ...]:
    """``Lattice.stencil``, remembered."""
    assert scene.lattice is not None
    known = _known.setdefault(scene, {})
    if name not in known:
        at, weights, slopes = scene.lattice.stencil(points(), place=place)
        known[name] = at.to(like.device), weights.to(like), slopes.to(like)
    return known[name]


class TotalMarch:
    """One segment: ``forward`` from a state to all states (or the last two), ``backward`` along the kept ones.

    The counterpart of ``march.March``; no sum is taken by two threads at once, so that two runs have the same bits.

    Args:
        scene: What stays the same; its tensors by particle are by point of the lattice here.
        inputs: The segment's tensors, likewise.
        first: Number of the first substep in the whole run, for messages.
        samples: Substeps to look at, counted within the segment.
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
        self.loaded = scene.viscous or scene.springs or self.groups > 0
        nx, ny, _ = self.lattice.points
        _, my, mz = self.lattice.shape
        self.lines, self.sheets = nx * ny * mz, nx * my * mz
        self.leaf = like.detach().requires_grad_()
        with torch.enable_grad():
            mass, drag = self.leaf[:, layout.MASS], self.leaf[:, layout.DRAG]
            self.nodal, self.chamber = self.lattice.nodal(mass, drag, scene.dt), self._chamber(self.leaf)
        self.tables = _tables(scene)
        self.fixed = Arena(
            "fixed",
            torch.tensor(numbers(self.lattice, scene.dt), dtype=torch.float64).to(like),
            *(like, inputs.prony, inputs.planes, self.nodal.detach(), self.chamber.detach(), scene.share),
        )
        self.supply = Arena("supply", inputs.pressure, inputs.gravity, inputs.force)
        b, c = self.batch, self.chambers
        self.gas = int((scene.kind >= 0).sum())
        self.scratch = Arena(
            "scratch",
            *(like.new_zeros(shape) for shape in self._sums(b)),
            *(like.new_zeros(shape) for shape in self._sums(b * c)),
            *(like.new_zeros(b, n) for n in (self.gas, c * layout.CHAMBER_PARTS, c * layout.CHAMBER_GROUPS)),
        )
        self.kept = Arena("kept", like.new_zeros(0), like.new_zeros(0))

    def forward(self, start: Tensor, *, keep: bool, look: Look) -> Tensor:
        """Advance the state [B, L] over the segment; as ``March.forward``."""
        ring, slots = (self.steps + 1, self.steps) if keep else (2, 1)
        # Places without a particle are never written.
        full = bool((self.scene.kind != layout.ABSENT).all())
        states = (start.new_empty if full else start.new_zeros)(ring, *start.shape)
        states[0] = start
        shapes = ((slots, self.batch, self.chambers), (slots, self.batch, 3, self.nodes))
        self.kept = Arena("kept", *(start.new_zeros(shape) for shape in shapes))
        ints = self._ints([self.fixed, self.supply, self.kept, self.scratch], ring=ring, kept_ring=slots)
        launch = capture(
            total.total_substep,
            REPEATS if self.gpu else 1,
            self.loaded,
            self.scene.stiffens,
            ints,
            *(self.fixed.buffer, self.supply.buffer, states.view(-1), self.kept.buffer, self.scratch.buffer),
        )
        if 0 in self.samples:
            look(0, states[0])
        now = 0
        while now < self.steps:
            before = None if keep else states[now % 2].clone()
            stop = min([self.steps, now + CHUNK, *(k for k in self.samples if k > now)])
            self._go(launch, ints, stop, stop - now)
            after = states[stop % ring]
            collapsed = int(ints[layout.COLLAPSED])
            if collapsed < _NEVER:
                if before is not None:
                    states[now % 2] = before
                    ints[layout.NOW] = now
                    self._go(launch, ints, collapsed, collapsed - now)
                self._report(collapsed, states[collapsed % ring])
            if not bool(torch.isfinite(after).all()) or bool(self._outside(after).any()):
                self._report(stop, after)
            if stop in self.samples:
                look(stop, after)
            now = stop
        return states

    def backward(self, states: Tensor, bar: Tensor, add: Look, *, wanted: frozenset[str]) -> dict[str, Tensor]:
        """Carry the gradient by the last state back to the first, in place; as ``March.backward``."""
        i, steps, b, nodes, points = self.inputs, self.steps, self.batch, self.nodes, self.points
        tallies = TALLIES if {"gravity", "force"} & wanted else 0
        bar[:, 6 * nodes :].view(b, 6 * self.elements, points)[..., self.scene.kind == layout.ABSENT] = 0
        sums = Arena(
            "sums",
            torch.zeros_like(i.coefficients),
            bar.new_zeros(b, self.elements, layout.PRONY, points if "prony" in wanted else 1),
            torch.zeros_like(i.pressure),
            bar.new_zeros(steps, tallies, b, 3),
            bar.new_zeros(steps, tallies, b, self.groups, 3),
            bar.new_zeros(b, self.planes, layout.PLANE, nodes),
            torch.zeros_like(self.nodal),
            torch.zeros_like(self.chamber),
        )
        back = Arena(
            "backward",
            *(bar.new_zeros(b, 3, nodes), bar.new_zeros(2, b, 3, nodes)),
            *(bar.new_zeros(shape) for shape in self._sums(b * self.loaded)),
            *(bar.new_zeros(b, self.chambers), bar.new_zeros(b, self.gas)),
        )
        arenas = [self.fixed, self.supply, self.kept, self.scratch, back, sums]
        ints = self._ints(arenas, want_prony="prony" in wanted, tallies=tallies)
        launch = capture(
            total_adjoint.total_substep_adjoint,
            1,
            self.loaded,
            self.scene.stiffens,
            ints,
            *(self.fixed.buffer, self.supply.buffer, states.view(-1), self.kept.buffer, self.scratch.buffer),
            *(bar.view(-1), back.buffer, sums.buffer),
        )
        ints[layout.NOW] = steps - 1
        at = steps
        for stop in sorted({0, *self.samples}, reverse=True):
            if stop < at:
                ints[layout.STOP] = stop
                launch(at - stop)
                at = stop
            if stop in self.samples:
                add(stop, bar)
        ints[layout.STOP] = -1
        launch(1)
        *views, nodal_bar, chamber_bar = sums.views
        found: dict[str, Tensor] = dict(zip(_SUMS, views, strict=True))
        pairs = [(t, g) for t, g in ((self.nodal, nodal_bar), (self.chamber, chamber_bar)) if t.numel()]
        outputs, given = zip(*pairs, strict=True)
        (derived,) = torch.autograd.grad(outputs, self.leaf, given)
        found["coefficients"] = found["coefficients"] + derived
        found |= {name: found[name].sum(-1) for name in ("prony", "planes")}
        found |= {name: found[name].sum(1) for name in ("gravity", "force")}
        found["pressure"] = found["pressure"].clone()
        return {**found, "origin": torch.zeros_like(i.origin)}

    def _go(self, launch, ints: Tensor, stop: int, steps: int) -> None:
        """Launch until the clock stands at ``stop``; substeps beyond it do nothing."""
        ints[layout.STOP] = stop
        launch(-(-steps // (REPEATS if self.gpu else 1)))

    def _ints(self, arenas: list[Arena], **more: int) -> Tensor:
        """The buffer of integers: clock, sizes, where each quantity begins, then its own quantities."""
        sizes = {
            **dict(zip(("nx", "ny", "nz"), self.lattice.points, strict=True)),
            **{"batch": self.batch, "elements": self.elements, "chambers": self.chambers, "groups": self.groups},
            **{"springs": int(self.scene.springs), "viscous": int(self.scene.viscous), "planes": self.planes},
            **{"steps": self.steps, **{name: int(value) for name, value in more.items()}},
        }
        head = [0, 0, 0, _NEVER, *(sizes.get(name, 0) for name in layout.SIZES)]
        given = {arena.name: arena.offsets for arena in [self.tables, *arenas]}
        for name, quantities in layout.BUFFERS.items():
            shift = layout.HEAD if name == "integers" else 0
            head += [shift + offset for offset in given.get(name, [0] * len(quantities))]
        assert len(head) == layout.HEAD
        return torch.cat([self.tables.buffer.new_tensor(head), self.tables.buffer])

    def _sums(self, blocks: int) -> tuple[tuple[int, int, int], ...]:
        """Shapes of what points hand on, and of its sums over lines and sheets."""
        pairs = ((layout.BUNDLE, self.points), (layout.LINE, self.lines), (layout.SHEET, self.sheets))
        return tuple((blocks, *pair) for pair in pairs)

    def _chamber(self, coefficients: Tensor) -> Tensor:
        """Mean air stiffness and reference volume of each chamber [B, chambers, 2]."""
        rows = [coefficients.new_zeros(self.batch, 0, layout.CHAMBER)]
        for c in range(self.chambers):
            gas = self.scene.kind == c
            V = coefficients[:, layout.VOLUME, gas]
            k = (V * coefficients[:, layout.BULK, gas]).sum(-1) / V.sum(-1)
            rows.append(torch.stack([k, V.sum(-1)], -1).unsqueeze(1))
        return torch.cat(rows, 1)

    def _nodes(self, state: Tensor) -> Tensor:
        """Displacements [B, 3, nodes] m."""
        return state[:, : 3 * self.lattice.nodes].view(self.batch, 3, self.lattice.nodes)

    def _places(self, state: Tensor) -> Tensor:
        """Where the particles are [B, 3, points] m."""
        return self.lattice.to_points(self._nodes(state), "mark") + self.lattice.places.T.to(state)

    def _outside(self, state: Tensor) -> Tensor:
        """Which points, but for void, are not in the analysis box [B, points]."""
        x = self._places(state)
        low, high = (x.new_tensor(c).view(1, 3, 1) for c in (self.scene.low, self.scene.high))
        matter = (self.scene.kind != layout.ABSENT) & (self.inputs.coefficients[:, layout.VOID_FRACTION] < 1)
        return matter & ~((x > low) & (x < high)).all(1)

    def _report(self, step: int, state: Tensor) -> None:
        """Say which point is wrong after so many substeps of the segment, and how."""
        F = self.lattice.gradient(self._nodes(state)).permute(0, 3, 1, 2) + torch.eye(3).to(state)
        J = torch.linalg.det(F)
        solid = (self.scene.kind == -1) & (self.inputs.coefficients[:, layout.VOID_FRACTION] == 0)
        x = self._places(state)
        there = self.scene.kind != layout.ABSENT
        smaller = "a smaller time step, a lower pressure or a higher void fraction"
        lowest = torch.where(solid, J, torch.inf)
        lowest = torch.zeros_like(solid).view(-1).index_fill(0, lowest.view(-1).argmin(), True).view_as(solid)
        cases = (
            (~torch.isfinite(J) & there, "the state is not finite", "J", J, smaller),
            ((J <= 0) & solid, "the volume ratio is not positive", "J", J, smaller),
            (
                (J <= 0) & (self.scene.kind >= 0),
                "the chamber is tangled inside",
                "J",
                J,
                "a larger fictitious shear modulus in the chamber (Gas.shear) or a lower pressure",
            ),
            (
                self._outside(state),
                "about to leave the analysis box",
                "farthest coordinate in m",
                x.abs().amax(1),
                "a larger analysis box, or a shorter run",
            ),
            (lowest, "the volume ratio is hardly positive", "J", J, smaller),
        )
        for bad, quantity, label, value, remedy in cases:
            if bool(bad.any()):
                b, p = (int(n) for n in bad.nonzero()[0])
                index = self.lattice.index
                raise SimulationDiverged(
                    step=self.first + step,
                    time=(self.first + step) * self.scene.dt,
                    particle=p if index is None else int((index == p).nonzero()[0]),
                    quantity=f"{quantity} ({label} = {float(value[b, p]):.4g})",
                    batch=b,
                    remedy=remedy,
                )
