"""Contact of a body with itself in the total-Lagrangian form: points of its surface, their stiffness, pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.lane_selfcontact import SelfContact, find_pairs, place_points, sort_points
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.ops.axis_sums import PARTICLES
from torchsoro.simulation.ops.lanes import Lanes
from torchsoro.simulation.ops.scene import Scene

# In spacings of the particles. Parts that just touch have their outermost particles one spacing apart, where a pressure
# of a quarter of Young's modulus acts (``laws.repulsion``); it begins at REACH, beyond which particles of one surface,
# whose squares have diagonals of 1.41, cannot slip between those of another. Nearer than APART in the undeformed body,
# particles belong to one part, as in ``simulation.selfcontact``: compressed to half they do not meet.
REACH, APART = 1.5, 3.0
# Pairs are listed up to so many spacings beyond the reach: again as soon as a node has gone half of that, which is
# every tenth of a second or so of a walker's gait. A larger one lists more pairs, a smaller one lists more often.
SKIN = 0.5
# Largest weight of a node in any point below which its way counts in proportion: nodes that carry a corner of the matter
# (weights of 3e-5 to 6e-3) swing by a spacing at a hundred times the speed of the body, and hardly move a point. That
# all ways count for less costs the others a tenth of theirs, which is found point by point.
LIGHT = 0.05
_ROUNDING = 0.99  # of the way that nodes may go, so that no pair is missed by a rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Points of the body's surface, walls of slots and chambers included.

    Attributes:
        points: int64 [P], of the lattice.
        nodes: int64 [P, 27], that move each.
        weights: [P, 27] of these, float64.
        places: [P, 3] m in the undeformed body, float64.
    """

    points: Tensor
    nodes: Tensor
    weights: Tensor
    places: Tensor

    @classmethod
    def of(cls, scene: Scene, coefficients: Tensor) -> Surface:
        """The points of a batch: matter, all but what lies in the middle of 27 points that are solid everywhere.

        Matter is what follows the solid's law at least in part (``VOID_FRACTION`` below 1), in any simulation.
        """
        lattice = scene.lattice
        assert lattice is not None
        void_fraction, solid = coefficients[:, layout.VOID_FRACTION].detach(), scene.kind == -1
        matter = solid & (void_fraction < 1).any(0)
        whole = (solid & (void_fraction == 0).all(0)).view(1, 1, *lattice.points)
        partly = torch.nn.functional.pad((~whole).to(torch.float32), (1,) * 6, value=1.0)
        buried = torch.nn.functional.max_pool3d(partly, 3, stride=1).reshape(-1) == 0
        points = (matter & ~buried).nonzero().squeeze(1).cpu()
        nodes, weights, _ = lattice.stencil(points, place=PARTICLES)
        return cls(points=points, nodes=nodes, weights=weights, places=lattice.places[points])

    def stiffness(self, coefficients: Tensor, spacing: float) -> Tensor:
        """Of each point [B, P] N/m: Young's modulus times spacing, times the share that follows the solid's law."""
        bulk, shear, solid = self._moduli(coefficients)
        return spacing * solid * 9 * bulk * shear / _positive(3 * bulk + shear)

    def stiffness_adjoint(self, coefficients: Tensor, spacing: float, bar: Tensor) -> Tensor:
        """Gradient by the coefficients, from that by :meth:`stiffness`."""
        bulk, shear, solid = self._moduli(coefficients)
        whole = _positive(3 * bulk + shear)
        found = torch.zeros_like(coefficients)
        at = self.points.to(coefficients.device)
        found[:, layout.BULK, at] = spacing * solid * 9 * (shear / whole) ** 2 * bar
        found[:, layout.SHEAR, at] = spacing * solid * 27 * (bulk / whole) ** 2 * bar
        found[:, layout.VOID_FRACTION, at] = -spacing * 9 * bulk * shear / whole * bar
        return found

    def _moduli(self, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows = coefficients.detach()[:, :, self.points.to(coefficients.device)]
        return rows[:, layout.BULK], rows[:, layout.SHEAR], 1 - rows[:, layout.VOID_FRACTION]


def _positive(x: Tensor) -> Tensor:
    """Where it is zero, one: of a point without moduli."""
    return torch.where(x > 0, x, torch.ones_like(x))


def surface_contact(scene: Scene, coefficients: Tensor, lanes: Lanes) -> tuple[Surface | None, SelfContact]:
    """What the lanes' kernels know of contact of a body with itself; no points where it is off."""
    surface = Surface.of(scene, coefficients) if scene.self_contact else None
    mesh, groups, spacing = lanes.mesh, lanes.groups, scene.cell / 2
    real = {torch.float32: np.float32, torch.float64: np.float64}[coefficients.dtype]
    count = 0 if surface is None else len(surface.points)
    reserve = 1.0
    stiffness, watched = np.zeros(LANES, real), np.zeros(LANES, real)
    node, weight, places = np.zeros(0, np.int64), np.zeros(0, real), np.zeros(0, real)
    if surface is not None:
        node = lanes.nodes[surface.nodes].numpy().reshape(-1)
        weight, places = (t.numpy().astype(real).reshape(-1) for t in (surface.weights, surface.places))
        wide = lanes.from_batch(surface.stiffness(coefficients, spacing))
        stiffness = np.zeros(max(wide.numel(), LANES), real)
        stiffness[: wide.numel()] = wide.numpy().reshape(-1)
        watched = np.zeros(mesh.component, real)
        most = np.zeros(mesh.component)
        np.maximum.at(most, node, weight)
        shares = most / np.maximum(most, LIGHT)
        for lane in range(mesh.unit):
            watched[lane:] += shares[: mesh.component - lane]
        if count:
            reserve = float((weight / shares[node]).reshape(count, 27).sum(1).max())
    return surface, SelfContact(
        count=count,
        node=node,
        weight=weight,
        reference=places,
        stiffness=stiffness,
        watched=watched,
        reach=(REACH * spacing) ** 2,
        slack=(_ROUNDING * SKIN / 2 / reserve * spacing) ** 2,
        **_room(groups, 0, 0, real),
        moved=np.zeros(0, np.int64),
    )


def _room(groups: int, count: int, component: int, real: type) -> dict[str, np.ndarray | int]:
    """What kernels write to, and the pairs."""
    wide = ("places", "pushes", "pulled")
    return {
        "listed": np.zeros(3 * groups * component, real),
        "first": np.zeros(groups * (count + 1), np.int64),
        "other": np.zeros(0, np.int64),
        "capacity": 0,
        "active": np.zeros(groups * count, np.int64),
        "actives": np.zeros(groups, np.int64),
        **{name: np.zeros(groups * count * 3 * LANES, real) for name in wide},
        "nodal": np.zeros(3 * groups * component, real),
        "stiffness_bar": np.zeros(groups * count * LANES, real),
    }


def fresh_contact(contact: SelfContact, lanes: Lanes, threads: int) -> SelfContact:
    """The same points without pairs, for so many threads, with room of its own."""
    room = _room(lanes.groups, contact.count, lanes.mesh.component if contact.count else 0, contact.weight.dtype.type)
    return contact._replace(**room, moved=np.zeros(8 * threads, np.int64))


def list_pairs(contact: SelfContact, lanes: Lanes, spacing: float, states: np.ndarray, begin: int) -> SelfContact:
    """Find the pairs of all bodies, whose displacements begin at a place of the kernels' states."""
    if not contact.count:
        return contact
    mesh, groups, count = lanes.mesh, lanes.groups, contact.count
    moved = states[begin : begin + groups * 6 * mesh.component].reshape(groups, 6, mesh.component)
    contact.listed[:] = moved[:, :3].reshape(-1)
    contact.nodal[:] = 0
    contact.moved[:] = 0
    found = []
    for g in range(groups):
        place_points(mesh, contact, states, g, begin + g * 6 * mesh.component)
        different = min(LANES, lanes.batch - LANES * g) if lanes.variations else 1
        found.append(np.unique(np.concatenate([_pairs(contact, g, lane, spacing) for lane in range(different)])))
    capacity = max(contact.capacity, *(len(keys) for keys in found))
    other = np.zeros((groups, capacity), np.int64)
    for g, keys in enumerate(found):
        first, second = np.divmod(keys, count)
        other[g, : len(keys)] = second
        contact.first[g * (count + 1) : (g + 1) * (count + 1)] = np.searchsorted(first, np.arange(count + 1))
        active = np.unique(np.concatenate([first, second]))
        contact.active[g * count : g * count + len(active)] = active
        contact.actives[g] = len(active)
    return contact._replace(other=other.reshape(-1), capacity=capacity)


def _pairs(contact: SelfContact, g: int, lane: int, spacing: float) -> np.ndarray:
    """Pairs of a body in one lane, as numbers in any order."""
    width, apart = (REACH + SKIN) * spacing, (APART * spacing) ** 2
    size = 2 ** math.ceil(math.log2(2 * contact.count))
    begin, order, of = (np.empty(n, np.int64) for n in (size + 1, contact.count, contact.count))
    here, keys = np.empty(3 * contact.count, contact.weight.dtype), np.empty(contact.count, np.int64)
    sort_points(contact, g, lane, width, size, begin, order, of, here)
    while (count := find_pairs(contact, width, apart, size, begin, order, here, keys)) > len(keys):
        keys = np.empty(count, np.int64)
    return keys[:count]
