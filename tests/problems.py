"""Small problems, and what is known of their solutions, for the tests of the operator and the simulator."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsoro import Body, Chamber, Domain, Gas, Simulator, Solid, Waveform, fill
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Faces, Lattice, Walls
from torchsoro.simulation.ops.rollout import rollout
from torchsoro.simulation.ops.scene import Inputs, Scene
from torchsoro.simulation.ops.state import updated_state

H = 2.5e-3  # particle spacing of the small bodies, m; a cell is twice that
DT = 5e-5  # a stable step for the paper's resin with three Maxwell elements in such cells, s
WAYS = {"apic": {"transfer": "apic"}, "flip": {"transfer": "flip"}, "total": {"formulation": "total"}}
MORE = ("softening", "fluid", "ties", "air", "attached")  # tensors of the total-Lagrangian form that may be left out
TENSORS = ("coefficients", "prony", "pressure", "gravity", "force", "planes", "origin", "state", "weight")


def block(
    particles: tuple[int, int, int] = (4, 4, 4),
    *,
    air: bool = False,
    gamma: Tensor | None = None,
    gas: Gas | None = None,
    solid: Solid | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
) -> tuple[Domain, Body]:
    """A box body of the paper's resin; if asked, all but its outermost layer is air."""
    size = tuple(n * H for n in particles)
    middle = tuple(o + s / 2 for o, s in zip(origin, size, strict=True))
    chambers = (Chamber(name="air", center=middle, size=size, wall=H),) if air else ()
    domain = Domain(size=size, particles=particles, origin=origin, chambers=chambers)
    gamma = torch.ones(domain.count, dtype=dtype) if gamma is None else gamma
    body = fill(domain, gamma, solid=solid or Solid(), gas=gas)
    return domain, body if velocity is None else replace(body, velocity=velocity.to(dtype).expand_as(body.position))


def simulator(*, dt: float = DT, reach: float = 0.1, **settings) -> Simulator:
    """A simulator for :func:`block`, whose box reaches so far (m) on every side."""
    return Simulator(**{"cell": 2 * H, "dt": dt, "low": (-reach,) * 3, "high": (reach,) * 3, **settings})


def without_normals(planes: Tensor) -> Tensor:
    """Numbers of planes without the normals, which are constants of planes with an axis."""
    first = layout.PLANE_NORMAL
    return torch.cat([planes[..., :first], planes[..., first + 3 :]], -1)


def ways(*names: str, slow: Sequence[str] = ()):
    """Parametrise a test by ``way``: what :func:`simulator` takes for each of these names; some run with ``--slow``."""
    marked = [pytest.param(WAYS[n], id=n, marks=[pytest.mark.slow] if n in slow else []) for n in names]
    return pytest.mark.parametrize("way", marked)


def vector(*values: float) -> Tensor:
    """A float64 vector."""
    return torch.tensor(values, dtype=torch.float64)


def constant(*pascals: float) -> Waveform:
    """Constant pressures, one for each chamber."""
    values = torch.tensor(pascals, dtype=torch.float64)
    return Waveform(time=vector(0.0, 1.0), pressure=values.unsqueeze(-1).expand(len(pascals), 2))


def falling(x: Tensor, v: Tensor, g: Tensor, *, dt: float, steps: Tensor) -> tuple[Tensor, Tensor]:
    """Position and velocity after some steps of symplectic Euler with constant acceleration, in closed form."""
    n = steps.to(x).unsqueeze(-1)
    return x + n * dt * v + dt * dt * g * n * (n + 1) / 2, v + n * dt * g


def momenta(body: Body, state: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """Linear and angular momentum of a final state of one simulation: of particles with what C carries, or of nodes."""
    if state.ndim == 2:
        lattice = Lattice.around(body.position, cell)
        d, v = state[0, : 6 * lattice.nodes].view(2, 3, -1).transpose(1, 2)
        m = lattice.nodal_mass(lattice.spread(body.mass).unsqueeze(0))[0].unsqueeze(-1)
        return (m * v).sum(0), (m * torch.linalg.cross(lattice.node_places + d, v)).sum(0)
    s = state[0]
    x, v = s[:3].T, s[3:6].T
    C = s[layout.AFFINE : layout.DEFORMATION].reshape(3, 3, -1).permute(2, 0, 1)
    m = body.mass.unsqueeze(-1)
    spin = torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], -1)
    return (m * v).sum(0), (m * torch.linalg.cross(x, v) + m * spin * cell * cell / 4).sum(0)


def rotations(count: int, *, seed: int = 0) -> Tensor:
    """Random rotation matrices [count, 3, 3]."""
    g = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))
    q = q * r.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)
    return q * torch.linalg.det(q).sign()[:, None, None]


@dataclass(kw_only=True)
class Problem:
    """A segment for the operator with everything in it: two chambers, Maxwell elements, planes, forces, springs."""

    scene: Scene
    tensors: dict[str, Tensor]
    samples: tuple[int, ...]

    def run(self, tensors: dict[str, Tensor] | None = None, *, keep: bool = True) -> tuple[Tensor, ...]:
        """The operator's outputs, with some of the tensors replaced."""
        named = {**self.tensors, **(tensors or {})}
        state, weight = named.pop("state"), named.pop("weight")
        return rollout(self.scene, Inputs(**named), state, weight, samples=self.samples, keep=keep)

    def leaves(self) -> dict[str, Tensor]:
        """Copies of the tensors that require gradients."""
        return {name: t.clone().requires_grad_() for name, t in self.tensors.items()}

    def smooth(self, name: str, t: Tensor) -> Tensor:
        """A tensor in place of that name, but unchanged where a step to either side makes another problem.

        Those are coefficients of zero, as of places without a particle, void fractions of one, and normals of axes.
        """
        if name == "planes":
            free = torch.ones_like(t, dtype=torch.bool)
            free[..., layout.PLANE_NORMAL : layout.PLANE_NORMAL + 3] = (
                self.scene.plane_kind[:, layout.PLANE_AXIS] < 0
            ).unsqueeze(-1)
            return torch.where(free, t, self.tensors[name])
        if name != "coefficients":
            return t
        given = self.tensors[name]
        free = given != 0
        free[:, layout.VOID_FRACTION] &= given[:, layout.VOID_FRACTION] < 1
        return torch.where(free, t, given)


def problem(
    *,
    formulation: str = "updated",
    particles: tuple[int, int, int] = (4, 4, 4),
    batch: int = 1,
    elements: int = 2,
    steps: int = 6,
    blend: float = 0.0,
    stick: bool = False,
    samples: tuple[int, ...] = (0, 2, 5, 6),
    spread: float = 1.0,
    dtype: torch.dtype = torch.float64,
    seed: int = 1,
    lattice: Lattice | None = None,
    lanes: bool = True,
) -> Problem:
    """A problem in units of the cell, all of whose numbers are of order one and random, so that every term counts.

    In the total-Lagrangian form a corner of the lattice is empty, and its nodes there have no mass. A lattice may be
    given; else it is uniform. Without ``lanes`` the kernels are those of a GPU, wherever they run.
    """
    g = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    total = formulation == "total"
    axes = [5 + spread * 0.5 * (torch.arange(n, dtype=torch.float64) + 0.5) for n in particles]
    x = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(1, -1, 3).repeat(batch, 1, 1)
    if lattice is not None:
        x = lattice.places.repeat(batch, 1, 1)
    count = x.shape[1]
    kind = torch.full((count,), -1, dtype=torch.int32)
    kind[count // 2 : count // 2 + 3], kind[count // 2 + 3 : count // 2 + 5] = 0, 1
    if total:
        absent = (x[0] > x[0].amax(0).clamp(min=6.75) - 0.6).all(1) & (kind < 0)
        kind[absent] = layout.ABSENT
    else:
        x = x + 0.05 * randn(*x.shape)
    coefficients = torch.nn.functional.pad(rand(batch, layout.AIR_SHARE, count) + 0.5, (0, 0, 0, 2))
    coefficients[:, layout.VISCOSITY] *= 0.05
    coefficients[:, layout.VOLUME_VISCOSITY] *= 0.05
    coefficients[:, layout.ANCHOR : layout.ANCHOR + 3] = x.transpose(1, 2) + 0.1
    void_fraction = rand(batch, count)
    void_fraction[:, ::4], void_fraction[:, 1::7] = 0, 1
    coefficients[:, layout.VOID_FRACTION] = void_fraction
    # The stretches here are small: numbers that they bring to bear.
    coefficients[:, layout.STIFFENING] *= 30
    coefficients[:, layout.STIFFENING + 1] *= 300
    coefficients[..., kind == layout.ABSENT] = 0
    gravity = 0.3 * randn(steps, batch, 3)
    gravity[..., 2] -= 1
    share = torch.zeros(2, count, dtype=torch.float64)
    share[0, :5], share[1, 3:9] = 0.2, 0.3
    share[:, kind == layout.ABSENT] = 0
    # The ground sticks or slides, and holds a little; a wall is adhesive and slides, another holds what is near it.
    planes = torch.tensor([[5.0, 0.3, 0.1 * total], [7.0, 0.4, 0.2], [5.0, 0.1, 0.5]], dtype=torch.float64)
    at_rest = torch.tensor([[0.1 * total, 0.2]] * 3)  # in the total form it slides the better the faster
    planes = torch.cat([planes, torch.zeros(3, 1), torch.eye(3)[[2, 0, 1]], at_rest], 1).double()
    tensors = {
        "coefficients": coefficients,
        "prony": rand(batch, elements, layout.PRONY),
        "pressure": rand(steps + 1, batch, 2),
        "gravity": gravity,
        "force": randn(steps, batch, 2, 3),
        "planes": planes.repeat(batch, 1, 1),
        "origin": torch.zeros(batch, 3, dtype=torch.float64),
        "weight": rand(batch, count) + 0.1,
    }
    if total:
        lattice = lattice or Lattice.uniform(particles, (5.0, 5.0, 5.0), 1.0)
        motion = torch.cat([0.02 * randn(batch, 3 * lattice.nodes), 0.3 * randn(batch, 3 * lattice.nodes)], 1)
        history = 0.1 * randn(batch, 6 * elements, count) * (kind != layout.ABSENT)
        tensors["state"] = torch.cat([motion, history.flatten(1)], 1)
    else:
        tensors["state"] = updated_state(x, 0.3 * randn(*x.shape), elements)
        affine = tensors["state"][:, layout.AFFINE :]
        affine += 0.1 * randn(*affine.shape)
    reach = 20.0 * spread
    scene = Scene(
        dt=0.02,
        cell=1.0,
        blend=blend,
        low=(0.0, 0.0, 0.0),
        high=(reach, reach, reach),
        kind=kind,
        share=share.to(dtype),
        plane_kind=torch.tensor([[2, 1, int(stick), 0], [0, -1, 0, 0], [1, 1, 0, 0]], dtype=torch.int32),
        springs=True,
        drags=True,
        viscous=True,
        stiffens=True,
        probes=torch.tensor([0, 7, int((kind == -1).nonzero()[-1])]),
        lattice=lattice,
        lanes=lanes,
    )
    return Problem(scene=scene, tensors={name: t.to(dtype) for name, t in tensors.items()}, samples=samples)


def with_shared_air(p: Problem) -> Problem:
    """A problem of the total-Lagrangian form whose chambers are shares of solids, one of them zero; changed."""
    g = torch.Generator().manual_seed(11)
    kind = p.scene.kind
    # The last of them has no air.
    air, coefficients = torch.cat([(kind >= 0).nonzero(), (kind == -1).nonzero()[-1:]])[:, 0], p.tensors["coefficients"]
    coefficients[:, layout.VOID_FRACTION, air[:3]] = torch.tensor([1.0, 0.4, 0.0]).to(coefficients)
    share = 0.2 + 0.8 * torch.rand(len(coefficients), len(air), generator=g, dtype=torch.float64)
    share[:, -1] = 0
    coefficients[:, layout.AIR_SHARE, air] = share.to(coefficients)
    coefficients[:, layout.AIR_STIFFNESS, air] = 1 - 0.5 * share.to(coefficients)
    p.scene = replace(p.scene, kind=kind.index_copy(0, air, layout.ENCLOSES - kind[air].clamp(min=0)))
    return p


def walls_around(lattice: Lattice, low: tuple[int, int, int], high: tuple[int, int, int]) -> Walls:
    """Four points on each face of the cells around a box of cells from ``low`` to before ``high``, a hollow chamber."""
    rows: list[tuple] = []
    for axis in range(3):
        across = [(axis + 1) % 3, (axis + 2) % 3]
        one, two = (lattice.axes[a] for a in across)
        for side, beside in ((1, low[axis] - 1), (-1, high[axis])):
            for i, j in itertools.product(*(range(low[a], high[a]) for a in across)):
                cell, area = [0, 0, 0], float(side * one.widths[i] * two.widths[j] / 4)
                cell[axis], cell[across[0]], cell[across[1]] = beside, i, j
                for a, b in itertools.product(range(2), range(2)):
                    place = [0.0, 0.0, 0.0]
                    place[axis] = lattice.axes[axis].planes[beside + (side > 0)]
                    place[across[0]], place[across[1]] = one.points[i, a], two.points[j, b]
                    rows.append((cell, place, axis, area))
    cells, places, axes, areas = (np.array(column) for column in zip(*rows, strict=True))
    along = [a.at(places[:, i], cells[:, i]) for i, a in enumerate(lattice.axes)]
    firsts = [a.first[cells[:, i]] for i, a in enumerate(lattice.axes)]
    index = [first[:, None] + np.arange(3) for first in firsts]
    nodes = np.ravel_multi_index(
        (index[0][:, :, None, None], index[1][:, None, :, None], index[2][:, None, None, :]), lattice.shape
    )

    def product(slope: np.ndarray) -> np.ndarray:
        """Weights, or slopes along an axis that each point has [W]."""
        x, y, z = (np.where((slope == a)[:, None], s, w) for a, (w, s) in enumerate(along))
        return np.einsum("wi,wj,wk->wijk", x, y, z).reshape(len(axes), 27)

    values = np.stack([product(axes * 0 - 1), product((axes + 1) % 3), product((axes + 2) % 3)], -1)
    return Walls(
        nodes=torch.from_numpy(nodes.reshape(len(axes), 27)),
        values=torch.from_numpy(values),
        places=torch.from_numpy(places),
        axes=torch.from_numpy(axes),
        areas=torch.from_numpy(areas),
        chambers=torch.zeros(len(axes), dtype=torch.int64),
    )


def completed(p: Problem, *, starts: bool = False, end: tuple[int, int, int] = (2, 2, 2)) -> Problem:
    """A problem of the total-Lagrangian form with all else in it that this form has.

    Softening, quadratic drag, a hollow chamber from the cell (1, 1, 1) to before ``end``, held nodes, forces on nodes,
    springs to mean displacements, and what is attached to nodes.

    Args:
        p: The problem; changed.
        starts: Whether forces are constant from a substep on.
        end: Of the chamber.
    """
    g = torch.Generator().manual_seed(7)
    lattice, batch = p.scene.lattice, len(p.tensors["state"])
    assert lattice is not None
    nodes = lattice.nodes

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    faces = Faces(touches=rand(nodes) > 0.3, ends=rand(3, 2, nodes), front=rand(nodes, 3))
    lattice = replace(lattice, faces=faces, walls=walls_around(lattice, (1, 1, 1), end))
    steps = p.tensors["gravity"].shape[0]
    p.scene = replace(
        p.scene,
        lattice=lattice,
        softens=True,
        immersed=True,
        held=rand(nodes) > 0.9,
        node_share=rand(1, nodes),
        force_start=(0, 2, 3) if starts else None,
        tie_share=rand(batch, 2, nodes) * (rand(batch, 2, nodes) > 0.8),
    )
    count, absent = lattice.count, p.scene.kind == layout.ABSENT
    more = {
        "state": torch.cat([p.tensors["state"], 0.1 * rand(batch, count).masked_fill(absent, 0)], 1),
        "pressure": torch.cat([p.tensors["pressure"], rand(steps + 1, batch, 1)], 2),
        "force": torch.randn(1 if starts else steps, batch, 3, 3, generator=g, dtype=torch.float64),
        "softening": rand(batch, 2) * 0.1 + torch.tensor([0.6, 0.01]),
        "fluid": 5 + rand(batch),
        "ties": rand(batch, 2),
        "air": rand(batch, 1),
        "attached": rand(batch, 2, nodes),
    }
    p.tensors |= {name: t.to(p.tensors["state"]) for name, t in more.items()}
    return p
