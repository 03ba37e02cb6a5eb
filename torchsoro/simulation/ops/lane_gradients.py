"""Gradients by the inputs of a segment in lanes, from what its kernels have summed by point and by node."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.lane_adjoint import Sums
from torchsoro.simulation.kernels.lane_contact import PLANE
from torchsoro.simulation.kernels.lane_march import Case
from torchsoro.simulation.kernels.lane_points import (
    ATTACHED,
    BULK,
    NUMBERS,
    VISCOSITY,
    VOID_FRACTION,
    VOLUME_VISCOSITY,
)
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.ops.chambers import chamber_adjoint, chamber_means
from torchsoro.simulation.ops.lanes import Lanes
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs, Scene

# Coefficients of the points in the order of ``lane_points``.
COEFFICIENTS = (
    *(layout.VOLUME, layout.BULK, layout.SHEAR, layout.VOID_FRACTION, layout.STIFFENING, layout.STIFFENING + 1),
    *(layout.VISCOSITY, layout.VOLUME_VISCOSITY),
)
NOT_OF_GAS = (BULK, VISCOSITY, VOLUME_VISCOSITY)  # of which gas has none here
PRONY = [layout.PRONY_MODULUS, layout.PRONY_GAIN, layout.PRONY_DECAY]  # of an element, likewise
# Numbers of a plane in the order of ``lane_contact``; normal and offset count with the plane's sign.
PLANE_NUMBERS = [
    *(layout.PLANE_NORMAL + c for c in range(3)),
    *(layout.PLANE_OFFSET, layout.PLANE_FRICTION, layout.PLANE_ADHESION, layout.PLANE_REACH),
    *(layout.PLANE_AT_REST, layout.PLANE_SLOW),
]


def signs(scene: Scene, like: Tensor) -> Tensor:
    """By which the numbers of planes count: normal and offset with the plane's sign [planes, PLANE]."""
    sign = scene.plane_kind[:, layout.PLANE_SIGN, None].to(like)
    return torch.cat([sign] * 4 + [torch.ones_like(sign)] * 5, 1)


def node_shares(scene: Scene, lattice: Lattice, like: Tensor) -> Tensor:
    """Each node's share of the forces [forces, nodes]."""
    more = [] if scene.node_share is None else [scene.node_share.to(like)]
    return torch.cat([lattice.to_nodes(scene.share.to(like)), *more])


def gather_gradients(
    scene: Scene,
    inputs: Inputs,
    lanes: Lanes,
    case: Case,
    mass: Tensor,
    summed: tuple[Tensor, Tensor, Tensor, Sums],
    wanted: frozenset[str],
) -> tuple[Tensor, dict[str, Tensor]]:
    """Gradients by the first state and by the tensors of ``Inputs``.

    Args:
        scene: Of the segment.
        inputs: Of the segment.
        lanes: Of its bodies.
        case: Its numbers.
        mass: Of the nodes [B, 1, nodes] kg.
        summed: Gradient by displacements and velocities [groups, 6, component]; by histories [groups, blocks, 8,
            numbers, 16]; by the forces on the nodes, of the last substep and of each [1 + steps, groups, 3, component];
            what the kernels have summed.
        wanted: Names of the tensors whose gradients are wanted.
    """
    i, s, mesh, lattice = inputs, scene, lanes.mesh, scene.lattice
    assert lattice is not None
    moving, history, pulls, sums = summed
    batch, steps, elements = lanes.batch, i.gravity.shape[0], i.prony.shape[1]
    groups, blocks, points = lanes.groups, len(mesh.block_at), lattice.count
    c = i.coefficients

    def tensor(a: np.ndarray, *shape: int) -> Tensor:
        return torch.from_numpy(a[: math.prod(shape)]).view(shape)

    by_point = lanes.to_points(tensor(sums.numbers, groups, blocks, 8, NUMBERS, LANES), points)
    found = torch.zeros_like(c)
    gas = s.kind >= 0
    for row in (*NOT_OF_GAS, VOID_FRACTION):
        by_point[:, row, gas] = 0
    found[:, COEFFICIENTS] = by_point
    by_air = lanes.summed(tensor(sums.air, groups, mesh.chambers, layout.CHAMBER, LANES))
    if len(lanes.pairs):
        rows = tensor(sums.gas, groups, len(lanes.pairs), 8, LANES) * lanes.holds(s.air)
        wide = c.new_zeros(groups, blocks, 8, 1, LANES)
        wide[:, :, :, 0].index_add_(1, lanes.pairs[:, 0], rows)
        by_volume = lanes.to_points(wide, points)[:, 0]
        if s.shared:
            found[:, layout.AIR_SHARE] += by_volume * c[:, layout.VOLUME]
            by_volume = by_volume * c[:, layout.AIR_SHARE]
        found[:, layout.VOLUME] += by_volume
        means = chamber_means(s, c, s.gas_chambers)
        found += chamber_adjoint(s, c, means, by_air[:, : s.gas_chambers])
    if s.springs:
        attached = lanes.to_points(tensor(sums.attached, groups, blocks, 8, ATTACHED, LANES), points)
        found[:, layout.SPRING : layout.ANCHOR + 3] += attached
    nodal = torch.cat(
        [
            lanes.to_nodes(tensor(a, groups, n, mesh.component))
            for a, n in ((sums.mass, 1), (sums.reach, 3), (sums.drag_factor, 1))
        ],
        1,
    )
    mass_bar, drag_bar, attached_bar = lattice.nodal_adjoint(
        c[:, layout.MASS], c[:, layout.DRAG], s.dt, i.attached, nodal
    )
    found[:, layout.MASS] += mass_bar
    found[:, layout.DRAG] += drag_bar
    prony_bar = torch.zeros_like(i.prony)
    if elements and "prony" in wanted:
        by_element = tensor(sums.maxwell, groups, blocks, elements, len(PRONY), LANES).sum(1)
        prony_bar[..., PRONY] = lanes.to_batch(by_element)
    planes = s.plane_kind.shape[0]
    planes_bar = torch.zeros_like(i.planes)
    if planes:
        by_node = lanes.to_nodes(tensor(sums.planes, groups, planes * PLANE, mesh.component))
        by_plane = by_node.sum(-1).view(batch, planes, PLANE)
        planes_bar[..., PLANE_NUMBERS] = by_plane * signs(s, c)
    gravity_bar, force_bar = torch.zeros_like(i.gravity), torch.zeros_like(i.force)
    if {"gravity", "force"} & wanted:
        share, starts = node_shares(s, lattice, c), case.force_start
        for t in range(steps):
            pull = lanes.to_nodes(pulls[t + 1])
            gravity_bar[t] = (mass * pull).sum(-1)
            by_force = torch.einsum("bcn,gn->bgc", pull, share)
            force_bar[min(t, len(force_bar) - 1)] += by_force * torch.from_numpy(starts <= t).unsqueeze(1)
    fluid_bar = torch.zeros_like(i.fluid)
    if s.immersed:
        assert lattice.faces is not None
        by_area = lanes.to_nodes(tensor(sums.quadratic, groups, 3, mesh.component))
        fluid_bar = torch.einsum("bcn,nc->b", by_area, lattice.faces.front.to(c)) / 2
    by_block = tensor(sums.softening, groups, blocks, 2, LANES).sum(1)
    pressure_bar = torch.zeros_like(i.pressure)
    if mesh.chambers:
        by_step = tensor(sums.pressure, steps, groups, mesh.chambers, LANES)
        pressure_bar[:steps, :, : mesh.chambers] = lanes.summed(by_step, 1)
    history_bar = history.view(groups, blocks, 8, case.history, LANES) if case.history else None
    state_bar = lanes.to_nodes(moving).reshape(batch, -1)
    if history_bar is not None:
        state_bar = torch.cat([state_bar, lanes.to_points(history_bar, points).reshape(batch, -1)], 1)
    return state_bar, {
        "coefficients": found,
        "prony": prony_bar,
        "pressure": pressure_bar,
        "gravity": gravity_bar,
        "force": force_bar,
        "planes": planes_bar,
        "softening": lanes.to_batch(by_block),
        "fluid": fluid_bar,
        "ties": lanes.summed(tensor(sums.ties, groups, i.ties.shape[1], LANES)),
        "air": by_air[:, s.gas_chambers :, layout.CHAMBER_STIFFNESS].clone(),
        "attached": attached_bar,
    }
