"""Sixteen variations of a twin at a time, on the CPU's kernels of the simulator."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.lane_contact import PLANE
from torchsoro.simulation.kernels.lane_march import NEVER, SCRATCH, Case, Mesh, Work, march
from torchsoro.simulation.kernels.lane_points import BULK, MAXWELL, NUMBERS, SHEAR, STIFFENING, VOID_FRACTION, VOLUME
from torchsoro.simulation.kernels.lane_threads import SYNC
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.kernels.variations import Case as Numbers
from torchsoro.simulation.ops.lanes import Lanes, lay_out
from torchsoro.simulation.ops.lattice import Lattice, Walls

real = np.float32


@lru_cache(maxsize=8)
def lanes_of(twin: Twin) -> Lanes:
    """The cells of a twin, and the walls of its chambers, for the kernels."""
    grid = twin.grid
    shape = tuple(a.cells for a in grid.axes)
    kind = np.full(shape, layout.ABSENT)
    kind[tuple(grid.cells.T)] = -1
    wide = np.broadcast_to(kind[:, None, :, None, :, None], (shape[0], 2, shape[1], 2, shape[2], 2))
    walls = _walls(grid.walls) if len(grid.walls[-1]) else None
    lattice = Lattice(axes=grid.axes, walls=walls)
    found = lay_out(lattice, torch.from_numpy(wide.reshape(-1).copy()), LANES, torch.float32)
    assert found.variations
    return found


def _walls(arrays: tuple[np.ndarray, ...]) -> Walls:
    nodes, values, places, axes, areas, chambers = map(torch.from_numpy, arrays)
    return Walls(nodes=nodes, values=values, places=places, axes=axes, areas=areas, chambers=chambers)


def _nodal(lanes: Lanes, values: np.ndarray) -> np.ndarray:
    """Numbers of nodes [K, n] or [K, n, 16] in the kernels' order [K, component]."""
    wide = np.broadcast_to(values[..., None], (*values.shape, LANES)) if values.ndim == 2 else values
    found = np.zeros((len(values), lanes.mesh.component), real)
    at = (lanes.nodes.numpy()[:, None] + np.arange(LANES)).reshape(-1)
    found[:, at] = wide.reshape(len(values), len(at))
    return found


def case_of(twin: Twin, lanes: Lanes, n: Numbers) -> Case:
    """The numbers of sixteen variations in the kernels' order."""
    mesh, blocks = lanes.mesh, len(lanes.mesh.block_at)
    own = n.own.reshape(blocks, 8, 3, LANES)
    numbers = np.zeros((blocks, 8, NUMBERS, LANES), real)
    numbers[:, :, VOLUME] = 1  # moduli are those of the whole point
    numbers[:, :, SHEAR], numbers[:, :, BULK] = own[:, :, 0], own[:, :, 1]
    numbers[:, :, STIFFENING : STIFFENING + 2] = n.law.reshape(4, LANES)[:2]
    numbers[:, :, VOID_FRACTION] = own[:, :, 1] == 0  # a point without matter has no collapse
    elements = len(n.series) // (4 * LANES)
    g, gb, a, fade = n.series.reshape(elements, 4, LANES).swapaxes(0, 1)
    b = np.divide(gb, g, out=np.ones_like(g), where=g != 0)
    maxwell = np.stack([g, b, a, fade], 1) if elements else np.zeros((0, MAXWELL, LANES), real)
    held = np.asarray(twin.held | (twin.grid.collect(twin.grid.volumes) == 0))
    moves = np.where(held[:, None], 0.0, n.weight > 0)
    planes = len(n.stick)
    plane_numbers = np.zeros((planes, PLANE, LANES), real)
    plane_numbers[:, :3] = n.normals[:, :, None]
    for k, rows in enumerate((n.offset, n.friction, n.adhesion, n.reach)):
        plane_numbers[:, 3 + k] = rows
    rim = np.zeros((1, twin.grid.nodes), real)
    rim[:, twin.grid.rim] = 1
    pushes = len(n.push_begin) - 1
    share = np.zeros((pushes, twin.grid.nodes), real)
    for k in range(pushes):
        part = slice(n.push_begin[k], n.push_begin[k + 1])
        share[k, n.push_node[part]] = n.push_share[part]
    shares = _nodal(lanes, share)
    ties = np.zeros((len(n.springs), twin.grid.nodes, LANES), real)
    ties[n.spring_number, n.spring_node] = n.spring_share
    chambers = n.supply.shape[1]
    air = np.zeros((chambers, 2, LANES), real)
    air[:, 0], air[:, 1] = n.air, n.volume[:, None]
    quadratic = (twin.grid.front.T[:, :, None] * n.fluid).astype(real)
    softens = np.stack([n.law.reshape(4, LANES)[2], n.law.reshape(4, LANES)[3]])
    return Case(
        dt=n.dt,
        groups=1,
        elements=elements,
        history=6 * elements + int(n.softens),
        flags=(n.stiffens, n.softens, False, False, False),
        numbers=numbers.reshape(-1),
        attached=np.zeros(LANES, real),
        gas=np.zeros(LANES, real),
        maxwell=maxwell.astype(real).reshape(-1),
        softening=softens.astype(real).reshape(-1),
        inverse_mass=_nodal(lanes, n.weight[None]).reshape(-1),
        moves=_nodal(lanes, moves[None]).reshape(-1),
        drag_factor=_nodal(lanes, n.left[None]).reshape(-1),
        reach=np.zeros(3 * mesh.component, real),
        air=air.reshape(-1) if chambers else np.zeros(2 * LANES, real),
        pressure=n.supply.reshape(-1) if chambers else np.zeros(LANES, real),
        gravity=n.gravity.reshape(-1),
        share=shares,
        share_there=(shares.reshape(pushes, mesh.component // LANES, LANES) != 0).any(-1),
        force=n.push.reshape(-1) if pushes else np.zeros(LANES, real),
        force_start=np.maximum(n.push_start, 0).astype(np.int64),
        tie_share=_nodal(lanes, ties).reshape(-1),
        tie_stiffness=n.springs.reshape(-1),
        quadratic=_nodal(lanes, quadratic).reshape(-1) if n.fluid.any() else np.zeros(0, real),
        plane_numbers=plane_numbers.reshape(-1),
        plane_stick=n.stick,
        plane_elastic=np.ones(planes, bool),
        keeps=True,
        area=_nodal(lanes, n.area).reshape(-1) if planes else np.zeros(LANES, real),
        far=_nodal(lanes, np.ones_like(n.area)).reshape(-1) if planes else np.zeros(LANES, real),
        touches=_nodal(lanes, rim).reshape(-1),
        spacing=float(max(np.diff(a.planes).max() for a in twin.grid.axes)),
    )


def simulate(twin: Twin, n: Numbers, samples: int) -> np.ndarray:
    """Displacements and velocities of the nodes of sixteen variations, at the start and every ``n.every`` steps.

    Variations that diverge go on with what is not finite.

    Returns:
        [samples, 6, nodes, 16] m, m/s.
    """
    lanes = lanes_of(twin)
    mesh: Mesh = lanes.mesh
    case = case_of(twin, lanes, n)
    blocks, items = len(mesh.block_at), len(mesh.item_plane)
    states = np.zeros((2, 6, mesh.component), real)
    held = twin.held | (twin.grid.collect(twin.grid.volumes) == 0)
    free = ~np.asarray(held)[:, None, None]
    start = np.concatenate([(n.place * free).swapaxes(0, 1), (n.velocity * free).swapaxes(0, 1)])
    states[:] = _nodal(lanes, start)
    at = np.full(n.steps + 1, -1)
    at[n.every :: n.every] = np.arange(samples - 1)
    seen = np.zeros((samples, 6, mesh.component), real)
    seen[0] = states[0]
    work = Work(
        states=states.reshape(-1),
        histories=np.zeros(max(LANES, blocks * 8 * LANES * case.history), real),
        pushed=np.zeros(0, real),
        volumes=np.zeros(LANES * max(1, mesh.chambers), real),
        seen=seen[1:].reshape(-1) if samples > 1 else np.zeros(LANES, real),
        seen_at=at,
        forces=np.zeros(items * 9 * mesh.patch, real),
        areas=np.zeros(max(LANES, items * mesh.chambers * 9 * mesh.patch), real),
        swept=np.zeros(max(LANES, items * mesh.chambers * LANES), real),
        tension=np.zeros(3 * len(case.tie_stiffness), real),
        collapsed=np.full(8, NEVER),
        sync=np.zeros(SYNC, np.int64),
        scratch=np.zeros(SCRATCH, real),
    )
    march(mesh, case, work, 0, 1, n.steps, 2, 1, False)
    at = (lanes.nodes.numpy()[:, None] + np.arange(LANES)).reshape(-1)
    return seen[:, :, at].reshape(samples, 6, -1, LANES)
