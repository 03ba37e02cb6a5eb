"""Contact of a body with itself in lanes: what the kernels take, and the lists of pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels.lane_selfcontact import SelfContact, place_points
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.ops.lanes import Lanes
from torchsoro.simulation.ops.scene import Scene
from torchsoro.simulation.ops.selfcontact import REACH, Surface


def surface_contact(scene: Scene, coefficients: Tensor, lanes: Lanes) -> tuple[Surface | None, SelfContact]:
    """What the lanes' kernels know of contact of a body with itself; no points where it is off."""
    mesh, spacing = lanes.mesh, scene.cell / 2
    real = {torch.float32: np.float32, torch.float64: np.float64}[coefficients.dtype]
    none = np.zeros(0, real)
    contact = SelfContact(
        count=0,
        node=np.zeros(0, np.int64),
        weight=none,
        reference=none,
        stiffness=none,
        watched=none,
        reach=(REACH * spacing) ** 2,
        slack=0.0,
        **_room(lanes.groups, 0, 0, real),
        moved=np.zeros(0, np.int64),
    )
    if not scene.self_contact:
        return None, contact
    surface = Surface.of(scene, coefficients)
    shares, way = surface.watched(spacing)
    watched = np.zeros(mesh.component, real)
    for lane in range(mesh.unit):
        watched[lanes.nodes[: len(shares)].numpy() + lane] = shares
    wide = lanes.from_batch(surface.stiffness(coefficients, spacing))
    return surface, contact._replace(
        count=len(surface.points),
        node=lanes.nodes[surface.nodes].numpy().reshape(-1),
        weight=surface.weights.numpy().astype(real).reshape(-1),
        reference=surface.places.numpy().astype(real).reshape(-1),
        stiffness=wide.numpy().reshape(-1),
        watched=watched,
        slack=way**2,
    )


def _room(groups: int, count: int, component: int, real: type) -> dict[str, Any]:
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


def list_pairs(
    surface: Surface | None, contact: SelfContact, lanes: Lanes, spacing: float, states: np.ndarray, begin: int
) -> SelfContact:
    """Find the pairs of all bodies, whose displacements begin at a place of the kernels' states.

    Lanes that are simulations have a list in common.
    """
    if surface is None or not contact.count:
        return contact
    mesh, groups, count = lanes.mesh, lanes.groups, contact.count
    moved = states[begin : begin + groups * 6 * mesh.component].reshape(groups, 6, mesh.component)
    contact.listed[:] = moved[:, :3].reshape(-1)
    contact.nodal[:] = 0
    contact.moved[:] = 0
    places = contact.places.reshape(groups, count, 3, LANES)
    solid = contact.stiffness.reshape(groups, count, LANES) > 0
    found = []
    for g in range(groups):
        place_points(mesh, contact, states, g, begin + g * 6 * mesh.component)
        different = min(LANES, lanes.batch - LANES * g) if lanes.variations else 1
        rows = ((places[g, ..., lane], solid[g, ..., lane]) for lane in range(different))
        keys = [surface.pairs(np.ascontiguousarray(x), np.ascontiguousarray(there), spacing) for x, there in rows]
        found.append(np.unique(np.concatenate(keys)))
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
