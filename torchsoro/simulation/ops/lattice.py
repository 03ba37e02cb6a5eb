"""The reference lattice of the total-Lagrangian form: where particles lie on it, and sums over it in plain torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.axis import Axis
from torchsoro.simulation.ops.axis_sums import PARTICLES, summed
from torchsoro.simulation.ops.inertia import Matching

# The centre of the matter that a node outside of a face carries is 3/4 of a cell away, the face half a cell.
_DEPTH = 0.25
_OFF = 1e-3  # how far a particle may be from its place, in particle spacings

_uniform = lru_cache(maxsize=256)(Axis.uniform)  # one axis, so one set of matrices, for equal arguments


@lru_cache(maxsize=256)
def _gaps(axis: Axis, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Of each node along an axis: middle, depth, span, the ways to the next and from the last one [5, nodes] m."""
    gaps = np.diff(axis.places)
    rows = np.stack([axis.centers, _DEPTH * axis.spans, axis.spans, np.append(gaps, 1.0), np.append(1.0, gaps)])
    return torch.from_numpy(rows).to(dtype=dtype, device=device)


@dataclass(frozen=True, kw_only=True, eq=False)
class Walls:
    """Points on the walls of hollow chambers, which hold no gas particles; float64.

    The pressure of a chamber acts on the body at a wall point by -p N_i (t1 x t2) dA on node i, with the tangents
    t1, t2 along the two axes that follow the normal one (cyclically); its volume is the sum of x . (t1 x t2) dA / 3.

    Attributes:
        nodes: int64 [W, 27] of each point.
        values: [W, 27, 3] their weights, and slopes along the two axes [1/m].
        places: [W, 3] m in the undeformed body.
        axes: int64 [W], axis that the wall is normal to.
        areas: [W] m2, positive if the chamber is on the lower side.
        chambers: int64 [W], number of the hollow chamber, from 0 on; in pressures they follow those of gas particles.
    """

    nodes: Tensor
    values: Tensor
    places: Tensor
    axes: Tensor
    areas: Tensor
    chambers: Tensor

    @cached_property
    def key(self) -> bytes:
        """What tells walls from others."""
        return b"".join(getattr(self, f.name).numpy().tobytes() for f in fields(self))

    @cached_property
    def count(self) -> int:
        """Number of hollow chambers."""
        return int(self.chambers.max()) + 1

    @cached_property
    def volume(self) -> Tensor:
        """Of each chamber in the undeformed body [hollow] m3."""
        along = self.places.gather(1, self.axes[:, None])[:, 0]
        return self.areas.new_zeros(self.count).index_add(0, self.chambers, self.areas * along / 3)

    def enclosed(self, d: Tensor) -> Tensor:
        """Volume of each chamber [..., hollow] m3, with displacements of the nodes [..., 3, nodes] m."""
        x, a, b = self._along(d)
        parts = (x * torch.linalg.cross(a, b)).sum(-1) * self.areas.to(d) / 3
        mine = self.chambers.unsqueeze(1) == torch.arange(self.count)
        return (parts.unsqueeze(-1) * mine.to(d)).sum(-2)  # in an order that CUDA keeps, unlike ``index_add``

    def enclosed_adjoint(self, d: Tensor, bar: Tensor) -> Tensor:
        """What each wall point adds to the gradient by its nodes [B, 3, W, 27], from that by :meth:`enclosed`."""
        x, a, b = self._along(d)
        by_volume = bar[:, self.chambers.to(d.device)] * self.areas.to(d) / 3
        sides = torch.stack([torch.linalg.cross(*pair) for pair in ((a, b), (b, x), (x, a))], -1)
        return torch.einsum("bwck,wnk,bw->bcwn", sides, self.values.to(d), by_volume)

    def _along(self, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Places of the points [..., W, 3] m, and their tangents."""
        moved = torch.einsum("...cwn,wnk->k...wc", d[..., self.nodes.to(d.device)], self.values.to(d))
        turned = torch.eye(3).to(d)[torch.stack([self.axes + 1, self.axes + 2]) % 3]
        return self.places.to(d) + moved[0], turned[0] + moved[1], turned[1] + moved[2]


@dataclass(frozen=True, kw_only=True, eq=False)
class Faces:
    """Outer faces of a body whose outermost nodes lie on them; float64.

    Attributes:
        touches: bool [nodes], which nodes meet planes.
        ends: [3, 2, nodes] m2, area of the body on the lower and the upper end of each axis, as shares of nodes.
        front: [nodes, 3] m2, area of the body across each axis, the mean of both sides, as shares of nodes.
    """

    touches: Tensor
    ends: Tensor
    front: Tensor

    def facing(self, normals: Tensor) -> Tensor:
        """Area of the nodes on the face that faces planes with normals [..., 3] most [..., nodes] m2."""
        axis = normals.abs().argmax(-1)
        upper = normals.gather(-1, axis.unsqueeze(-1)).squeeze(-1) < 0
        return self.ends.to(normals.device)[axis, upper.long()]


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """A box of 2 x 2 x 2 points per cell around a body, and its nodes.

    Attributes:
        axes: Along x, y, z.
        index: int64 [N], the point of each particle; None if there is one for each, in the same order.
        walls: Of hollow chambers; None if there are none.
        faces: Where nodes meet planes, if they lie on the body's faces; None for a surface that is found by the mass
            around each node, see :meth:`nodal`.
    """

    axes: tuple[Axis, Axis, Axis]
    index: Tensor | None = None
    walls: Walls | None = None
    faces: Faces | None = None

    @classmethod
    def uniform(
        cls,
        points: tuple[int, int, int],
        low: tuple[float, float, float],
        cell: float,
        index: Tensor | None = None,
    ) -> Lattice:
        """Cubic cells with an edge of ``cell`` [m] from a lower corner [m] on, with nodes in front of all faces.

        Args:
            points: Points along x, y, z; even numbers.
            low: Lower corner [m].
            cell: Edge of a cell [m].
            index: As the attribute.
        """
        x, y, z = (_uniform(a, cell, n // 2) for a, n in zip(low, points, strict=True))
        return cls(axes=(x, y, z), index=index)

    @classmethod
    def around(cls, position: Tensor, cell: float) -> Lattice:
        """The lattice of an undeformed body.

        Args:
            position: [N, 3] m, on a lattice of two particles per cell and axis, parallel to the axes.
            cell: [m].

        Raises:
            ValueError: if the particles are not on such a lattice, or two share a place.
        """
        x = position.detach().double()
        h = cell / 2
        low = x.amin(0) - h / 2
        place = (x - low) / h - 0.5
        whole = place.round().long()
        # From the middle of all, lest the lowest particle's rounding counts.
        off = place - whole
        off = (off - off.mean(0)).abs().amax(1)
        if bool((off > _OFF).any()):
            worst = int(off.argmax())
            raise ValueError(
                f"body.position: particle {worst} at {tuple(x[worst].tolist())} m is {float(off[worst]):.2g} spacings "
                f"off its place, wanted an undeformed lattice of spacing {h:g} m (half a cell) parallel to the axes "
                "for the total-Lagrangian formulation"
            )
        counts = (whole.amax(0) + 1).tolist()
        nx, ny, nz = (n + n % 2 for n in counts)
        index = (whole[:, 0] * ny + whole[:, 1]) * nz + whole[:, 2]
        if len(torch.unique(index)) < len(index):
            raise ValueError("body.position: two particles share a lattice place, wanted one particle for each")
        every = len(index) == nx * ny * nz and bool((index == torch.arange(len(index), device=x.device)).all())
        a, b, c = low.tolist()
        return cls.uniform((nx, ny, nz), (a, b, c), cell, None if every else index)

    def check(self, position: Tensor) -> None:
        """Refuse a body whose particles [N, 3] m do not lie at the lattice's ``places``, but for a shift of the whole.

        Raises:
            ValueError: naming the first particle that is elsewhere.
        """
        places = self.particles
        if len(position) != len(places):
            raise ValueError(f"body.position: {len(position)} particles, wanted the {len(places)} of the lattice")
        off = position.detach().to(places) - places
        off = (off - off.mean(0)).abs().amax(1)
        if bool((off > _OFF * self.cell).any()):
            worst = int(off.argmax())
            raise ValueError(
                f"body.position: particle {worst} at {tuple(position[worst].tolist())} m, wanted its place in the "
                f"lattice, {tuple(places[worst].tolist())} m"
            )

    @cached_property
    def particles(self) -> Tensor:
        """Places of the particles [N, 3] m, float64."""
        return self.places if self.index is None else self.places[self.index.cpu()]

    @property
    def points(self) -> tuple[int, int, int]:
        """Points along x, y, z."""
        x, y, z = (2 * a.cells for a in self.axes)
        return x, y, z

    @property
    def count(self) -> int:
        """Number of points."""
        return math.prod(self.points)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y, z."""
        x, y, z = (a.nodes for a in self.axes)
        return x, y, z

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return math.prod(self.shape)

    @cached_property
    def cell(self) -> float:
        """Edge of the largest cell [m]."""
        return max(float(a.widths.max()) for a in self.axes)

    def spread(self, values: Tensor, empty: float = 0.0) -> Tensor:
        """From particles to points: [..., N] to [..., points], differentiable."""
        if self.index is None:
            return values
        wide = values.new_full((*values.shape[:-1], self.count), empty)
        return wide.index_copy(-1, self.index, values)

    @cached_property
    def places(self) -> Tensor:
        """Reference places of the particles of all points [points, 3] m, float64."""
        return _mesh(*(a.inside(PARTICLES).reshape(-1) for a in self.axes))

    @cached_property
    def node_places(self) -> Tensor:
        """Reference places of the nodes [nodes, 3] m, float64."""
        return _mesh(*(a.places for a in self.axes))

    def inside(self, low: Sequence[float], high: Sequence[float]) -> Tensor:
        """Which nodes lie in a box [m], bool [nodes]."""
        begin, end = (torch.tensor(corner, dtype=torch.float64) for corner in (low, high))
        rounding = _OFF * self.cell / 2
        return ((self.node_places > begin - rounding) & (self.node_places < end + rounding)).all(-1)

    @cached_property
    def _node_spreads(self) -> Tensor:
        """What sum_i N_i x_i^2 has more than x^2, by node and axis [nodes, 3] m2, float64."""
        return _mesh(*(a.spreads for a in self.axes))

    @cached_property
    def _areas(self) -> Tensor:
        """Area of the nodes across each axis [3, nodes] m2, float64."""
        x, y, z = _mesh(*(a.lengths for a in self.axes)).unbind(1)
        return torch.stack([y * z, x * z, x * y])

    def facing(self, normals: Tensor) -> Tensor:
        """Area of the nodes across the axis that planes with normals [..., 3] face most [..., nodes] m2."""
        if self.faces is not None:
            return self.faces.facing(normals).to(normals)
        return self.on("_areas", normals)[normals.abs().argmax(-1)]

    @cached_property
    def _copies(self) -> dict[tuple[str, torch.dtype, torch.device], Tensor]:
        return {}

    def on(self, name: str, like: Tensor) -> Tensor:
        """The attribute with a name in the type and on the device of a tensor, copied there once: a copy waits."""
        key = name, like.dtype, like.device
        if key not in self._copies:
            self._copies[key] = getattr(self, name).to(like)
        return self._copies[key]

    def to_nodes(self, values: Tensor, kind: str = "weight", along: tuple[int, str] | None = None) -> Tensor:
        """Sum over points, with weights or another kind of matrix (and one more along an axis): [..., nodes]."""
        return summed(values, self.axes, self._kinds(kind, along), "nodes").reshape(*values.shape[:-1], self.nodes)

    def to_points(self, values: Tensor, kind: str = "weight", along: tuple[int, str] | None = None) -> Tensor:
        """Sum over nodes, likewise: [..., nodes] to [..., points]."""
        return summed(values, self.axes, self._kinds(kind, along), "points").reshape(*values.shape[:-1], self.count)

    def _kinds(self, kind: str, along: tuple[int, str] | None) -> list[str]:
        return [along[1] if along and a == along[0] else kind for a in range(3)]

    def nodal(self, mass: Tensor, drag: Tensor, dt: float, attached: Tensor | None = None) -> Tensor:
        """What kernels need to know of the nodes.

        Args:
            mass: Of the points [B, points] kg.
            drag: Drag coefficient of the points [B, points] N s/m.
            dt: Substep [s].
            attached: Mass and drag coefficient attached to the nodes [B, 2, nodes], or [B, 2, 0] or None for none.

        Returns:
            [B, 5, nodes], differentiable: mass in kg; the way from the node to the surface of the matter that it
            carries, along x, y, z, as share of that to the next node (zero if the lattice has ``faces``); what drag,
            taken implicitly, leaves of its velocity in a substep.
        """
        lumped = self.to_nodes(mass)
        there = lumped > 0
        safe = torch.where(there, lumped, torch.ones_like(lumped))
        none = torch.zeros_like(lumped)
        ways = [none] * 3
        if self.faces is None:
            ways = [torch.where(there, self._reach(mass, safe, axis)[0], none) for axis in range(3)]
        more, sink = (none, none) if attached is None or not attached.shape[2] else attached.unbind(1)
        heavy = safe + more
        factor = heavy / (heavy + dt * self.to_nodes(drag))
        # A node without the body's matter cannot move what is attached to it.
        whole = self._matching(lumped).matched.to(mass) + torch.where(there, more, none)
        if sink is not none:
            moved = torch.where(there, whole, torch.ones_like(whole))
            factor = factor * moved / (moved + dt * sink)
        return torch.stack([whole, *ways, factor], 1)

    def _reach(self, mass: Tensor, total: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """The reaches of :meth:`nodal` along an axis, the centre of mass from the node [m], and d reach / d centre.

        A node of which the matter fills all that its spline covers, or half of it, reaches nowhere.
        """
        shape = [1, 1, 1]
        shape[axis] = -1
        middle, depth, span, up, down = (
            row.view(shape).expand(self.shape).reshape(-1) for row in _gaps(self.axes[axis], total.dtype, total.device)
        )
        center = self.to_nodes(mass, along=(axis, "moment")) / total
        off = center - middle
        gap = torch.where(off > 0, up, down)
        beyond = off.abs() - depth - 1e-6 * span
        return (
            torch.sign(off) * torch.relu(beyond) / gap,
            center,
            torch.where(beyond > 0, 1 / gap, torch.zeros_like(off)),
        )

    def _matching(self, lumped: Tensor) -> Matching:
        """Lumped masses of the nodes [B, nodes], with the body's moments of inertia."""
        like = lumped.double()
        return Matching.of(like, self.on("node_places", like), self.on("_node_spreads", like))

    def nodal_mass(self, mass: Tensor) -> Tensor:
        """Masses of the nodes [B, nodes] kg, from those of the points [B, points]: the first of :meth:`nodal`."""
        return self.matching(mass).matched.to(mass)

    def matching(self, mass: Tensor) -> Matching:
        """How :meth:`nodal_mass` finds them."""
        return self._matching(self.to_nodes(mass))

    def nodal_mass_adjoint(self, masses: Matching, bar: Tensor) -> Tensor:
        """Gradient by the masses of the points, from that by those of the nodes and how they were found."""
        return self.to_points(masses.adjoint(bar).to(bar))

    def nodal_adjoint(
        self, mass: Tensor, drag: Tensor, dt: float, attached: Tensor, bar: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients by mass and drag [B, points] and ``attached``, from that by :meth:`nodal` [B, 5, nodes]."""
        lumped = self.to_nodes(mass)
        there, none = lumped > 0, torch.zeros_like(lumped)
        more, sink = attached.unbind(1) if attached.shape[2] else (none, none)
        safe = torch.where(there, lumped, torch.ones_like(lumped))
        heavy, resistance, factor_bar = safe + more, dt * self.to_nodes(drag), bar[:, 4]
        whole_bar, attached_bar = torch.where(there, bar[:, 0], none), torch.zeros_like(attached)
        if attached.shape[2]:
            whole = self._matching(lumped).matched.to(mass) + more
            moved = torch.where(there, whole, torch.ones_like(whole))
            left = heavy / (heavy + resistance) * factor_bar / (moved + dt * sink) ** 2
            factor_bar = factor_bar * moved / (moved + dt * sink)
            whole_bar = whole_bar + torch.where(there, left * dt * sink, none)
            attached_bar = torch.stack([whole_bar, -dt * left * moved], 1)
        by_factor = factor_bar / (heavy + resistance) ** 2
        by_heavy = by_factor * resistance
        if attached.shape[2]:
            attached_bar[:, 0] += by_heavy
        total_bar = self._matching(lumped).adjoint(whole_bar).to(mass) + torch.where(there, by_heavy, none)
        mass_bar = torch.zeros_like(mass)
        for axis in range(3) if self.faces is None else ():
            _, center, slope = self._reach(mass, safe, axis)
            moment_bar = torch.where(there, bar[:, 1 + axis] * slope / safe, torch.zeros_like(lumped))
            total_bar = total_bar - moment_bar * center
            mass_bar += self.to_points(moment_bar, along=(axis, "moment"))
        return mass_bar + self.to_points(total_bar), self.to_points(-dt * by_factor * heavy), attached_bar

    def gradient(self, field: Tensor) -> Tensor:
        """Gradient at all places of quadrature of a nodal vector field: [B, 3, nodes] to [B, 3, 3, points]."""
        return torch.stack([self.to_points(field, along=(axis, "slope")) for axis in range(3)], 2)

    def stencil(self, points: Tensor, *, place: float) -> tuple[Tensor, Tensor, Tensor]:
        """Nodes of some points, their weights, and slopes.

        Args:
            points: int64 [P].
            place: ``QUADRATURE`` or ``PARTICLES``.

        Returns:
            int64 [P, 27]; [P, 27]; [P, 3, 27] in 1/m.
        """
        at = [p.numpy() for p in torch.unravel_index(points.cpu(), self.points)]
        tables = [axis.tabulate(place) for axis in self.axes]
        weights, slopes = zip(
            *(tuple(t.reshape(-1, 3)[p] for t in pair) for pair, p in zip(tables, at, strict=True)), strict=True
        )
        found = self._products(np.stack([p // 2 for p in at], -1), weights, slopes)
        nodes, weight, slope = (torch.from_numpy(a) for a in found)
        return nodes, weight, slope

    def splines(self, x: np.ndarray, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes [P, 27] of places [P, 3] m, weights, and slopes [P, 3, 27]; in given cells, or in those around them."""
        if cells is None:
            cells = np.stack([a.cell(x[:, i]) for i, a in enumerate(self.axes)], -1)
        weights, slopes = zip(*(a.at(x[:, i], cells[:, i]) for i, a in enumerate(self.axes)), strict=True)
        return self._products(cells, weights, slopes)

    def _products(self, cells: np.ndarray, weights, slopes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes of cells [P, 3], and products of the weights [P, 3] of each axis, and with one axis' slopes."""
        x, y, z = (a.first[cells[:, i]] for i, a in enumerate(self.axes))
        _, my, mz = self.shape
        three = np.arange(3)
        offsets = ((three[:, None, None] * my + three[None, :, None]) * mz + three[None, None, :]).reshape(-1)

        def product(*rows: np.ndarray) -> np.ndarray:
            return np.einsum("pi,pj,pk->pijk", *rows).reshape(len(cells), 27)

        by_axis = [product(*(slopes[a] if a == axis else weights[a] for a in range(3))) for axis in range(3)]
        return ((x * my + y) * mz + z)[:, None] + offsets, product(*weights), np.stack(by_axis, 1)

    def project(self, values: Tensor, present: Tensor) -> Tensor:
        """Nodal values of a vector field that is known at the particles: exact for an affine field.

        Args:
            values: [B, points, 3].
            present: bool [points], where there is a particle.

        Returns:
            [B, 3, nodes], by least squares.
        """
        like = values.double()
        where, nodes = self.places.to(like), self.node_places.to(like)
        middle = where[present].mean(0)
        arms = torch.cat([torch.ones_like(where[:, :1]), (where - middle) / self.cell], 1)
        held = arms[present]
        affine = torch.linalg.lstsq(held.T @ held, torch.eye(4).to(like), driver="gelsd" if not like.is_cuda else None)
        fit = affine.solution @ held.T @ like[:, present]
        rest = torch.where(present[:, None], like - arms @ fit, torch.zeros_like(like)).transpose(1, 2)
        node_arms = torch.cat([torch.ones_like(nodes[:, :1]), (nodes - middle) / self.cell], 1)
        found = (node_arms @ fit).transpose(1, 2) + self.to_nodes(rest, "back")
        return found.to(values.dtype)


def _mesh(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Tensor:
    return torch.from_numpy(np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3))


def numbers(lattice: Lattice, dt: float, cell: float) -> Tensor:
    """What kernels need to know of a lattice, float64: substep, size of a cell for contact, then axis by axis.

    Of an axis: three weights and three slopes [1/m] for each point; the places of the particles and of the nodes [m].
    """
    rows = [np.array([dt, cell])]
    for axis in lattice.axes:
        table = np.concatenate([t.reshape(-1, 3) for t in axis.table], 1)
        rows += [table.reshape(-1), axis.inside(PARTICLES).reshape(-1), axis.places]
    return torch.from_numpy(np.concatenate(rows))
