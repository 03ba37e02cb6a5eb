"""The total-Lagrangian kernels on lattices of any axes: forces, pressure, gradients, and how cells go into tiles."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import MORE, completed, problem, without_normals
from test_ops import TENSORS, check, combined, gradients

import torchsoro
from torchsoro.simulation.axis import Axis
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.tile import KEPT
from torchsoro.simulation.ops import total
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs
from torchsoro.simulation.ops.tiles import LIMIT, tables, tiles_along, tiles_of


def axis(*widths: float, creases: tuple[int, ...] = ()) -> Axis:
    planes = 5 + np.cumsum([0.0, *widths])
    return Axis(planes, creases=planes[list(creases)])


def uneven() -> Lattice:
    """Three cells by two by four, with creases; faces on the outermost nodes."""
    return Lattice(axes=(axis(1.3, 0.7, 1.1), axis(0.9, 1.2, creases=(1,)), axis(1.3, 0.8, 1.0, 1.2, creases=(2,))))


def hollow() -> Lattice:
    """Three cells along each axis, one of them in the middle."""
    return Lattice(axes=(axis(1.3, 0.7, 1.1, creases=(1,)), axis(0.9, 1.2, 1.0), axis(1.3, 0.8, 1.0, creases=(1, 2))))


def wide() -> Lattice:
    """So many cells that there are several tiles along each axis."""
    return Lattice(
        axes=(
            axis(1.2, 0.8, 1.0, 0.9, 1.1, creases=(1,)),
            Axis.uniform(5.0, 0.9, 6),
            axis(*(0.8 + 0.1 * (i % 4) for i in range(9)), creases=(3, 4)),
        )
    )


def filled(shape: layout.Shape) -> Lattice:
    """A tile of that shape with all its cells and nodes."""
    more = (n - c - 2 for c, n in zip(shape.cells, shape.nodes, strict=True))
    return Lattice(
        axes=tuple(
            axis(*np.linspace(0.9, 1.1, c), creases=tuple(range(1, 1 + k)))
            for c, k in zip(shape.cells, more, strict=True)
        )
    )


# Below both engines are compared to 1e-12: where one is right, the other is.
one_at_once = pytest.mark.parametrize(
    "lanes", [pytest.param(True, id="lanes"), pytest.param(False, id="taichi", marks=pytest.mark.slow)]
)


@one_at_once
def test_gradcheck_by_every_tensor_with_open_knots_and_creases(lanes):
    assert check(problem(formulation="total", lattice=uneven(), batch=2, lanes=lanes), *TENSORS)


@one_at_once
def test_gradcheck_with_all_that_a_body_may_have(lanes):
    assert check(completed(problem(formulation="total", lattice=hollow(), batch=2, lanes=lanes)), *TENSORS, *MORE)


def test_slopes_with_all_that_a_body_may_have_agree_with_central_differences_to_1e6():
    p = completed(problem(formulation="total", lattice=hollow(), batch=2))
    found, g = gradients(p), torch.Generator().manual_seed(3)
    for name, by in found.items():
        at = p.tensors[name]
        way = p.smooth(name, at + torch.randn(at.shape, generator=g, dtype=torch.float64)) - at
        with torch.no_grad():
            up, down = (combined(p.run({name: at + step * way})) for step in (1e-5, -1e-5))
        assert float((by * way).sum()) == pytest.approx(float(up - down) / 2e-5, rel=1e-6), name


@pytest.mark.slow
def test_forces_that_begin_later_are_the_same_in_both_engines_and_few_rows_on_a_gpu():
    p = completed(problem(formulation="total", lattice=hollow(), batch=2, lanes=False), starts=True)
    inputs = Inputs(**{f.name: p.tensors[f.name] for f in fields(Inputs) if f.name in p.tensors})
    integrator = total.TotalSegmentIntegrator(p.scene, inputs, first=1, samples=())
    rows = integrator.supply.views[2]
    acts = torch.tensor([[1 + t >= start for start in (0, 2, 3)] for t in range(integrator.steps)])
    assert len(rows) == 3  # from substeps 1, 2 and 3 of the run on
    assert torch.equal(rows[integrator.force_row.long()], inputs.force * acts[:, None, :, None])
    other = completed(problem(formulation="total", lattice=hollow(), batch=2, lanes=True), starts=True)
    one, other = (each.run(keep=False)[0][:, : 6 * integrator.nodes] for each in (p, other))
    assert float((one - other).norm()) < 1e-12 * float(other.norm())


@pytest.mark.parametrize("batch", [3, 14])
def test_gradcheck_with_all_that_a_body_may_have_where_lanes_are_cells_or_bodies(batch):
    p = completed(problem(formulation="total", lattice=hollow(), batch=batch), starts=True)
    assert check(p, "state", "coefficients", "pressure", "force", *MORE)


@pytest.mark.slow
@pytest.mark.parametrize("stick", [False, True])
def test_gradcheck_by_every_tensor_of_the_kernels_of_a_gpu(stick):
    assert check(problem(formulation="total", stick=stick, batch=2, lanes=False), *TENSORS)


@pytest.mark.slow
@pytest.mark.parametrize("elements", [0, 1, 5])
def test_gradcheck_of_the_kernels_of_a_gpu_with_other_numbers_of_maxwell_elements(elements):
    p = problem(formulation="total", elements=elements, lanes=False)
    assert check(p, "state", "coefficients", *(["prony"] if elements else []))


@one_at_once
def test_gradcheck_over_several_tiles(lanes):
    p = problem(formulation="total", lattice=wide(), steps=3, samples=(0, 3), lanes=lanes)
    assert check(p, "state", "coefficients", "pressure", "gravity")


def compared(lattice: Lattice | None, dtype: torch.dtype, *, lanes: bool, whole: bool, bits: int = 0):
    """Outputs by name, and gradients of a weighted sum of them, of a problem in an engine.

    Gravity is disturbed by so many last bits of single precision.
    """
    p = problem(formulation="total", lattice=lattice, batch=2, steps=12, samples=(0, 5, 12), lanes=lanes)
    if whole:
        p = completed(p)
    # Void and gas have no history.
    nodes, void = p.scene.lattice.nodes, p.tensors["coefficients"][:, layout.VOID_FRACTION] == 1  # type: ignore[union-attr]
    history = p.tensors["state"][:, 6 * nodes :].view(2, -1, void.shape[1])
    history.masked_fill_((void | (p.scene.kind != -1)).unsqueeze(1), 0)
    p.tensors["gravity"] = p.tensors["gravity"] * (1 + bits * 2.0**-23)
    p.tensors = {name: t.to(dtype) for name, t in p.tensors.items()}
    leaves = p.leaves()
    outputs = p.run(leaves)
    weights = [torch.linspace(0.5, 1.5, o.numel(), dtype=dtype).view_as(o) for o in outputs]
    loss = torch.stack([(w * o).sum() for w, o in zip(weights, outputs, strict=True)]).sum()
    by = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
    by["planes"] = without_normals(by["planes"])
    by["state"] = by["state"][:, : 6 * nodes]
    found = {f"output {k}": o.detach() for k, o in enumerate(outputs)}
    found["output 0"] = found["output 0"][:, : 6 * nodes]
    return {name: t.double() for name, t in (found | by).items()}


LATTICES = {
    **{"uniform": (None, False), "uneven": (uneven(), False), "wide": (wide(), False), "whole": (hollow(), True)},
    **{"x".join(map(str, shape.nodes)): (filled(shape), False) for shape in layout.SHAPES},
}
# Each takes 12 s to compile, on a core that does nothing else.
AT_ONCE = {("whole", torch.float64)}


@pytest.mark.parametrize(
    ("lattice", "whole", "dtype", "within"),
    [
        pytest.param(
            *case, dtype, within, id=f"{name}-{dtype}", marks=[] if (name, dtype) in AT_ONCE else pytest.mark.slow
        )
        for name, case in LATTICES.items()
        for dtype, within in ((torch.float64, 1e-12), (torch.float32, 1e-5))
    ],
)
def test_both_engines_give_the_same_motion_and_gradients(lattice, whole, dtype, within):
    one, other = (compared(lattice, dtype, lanes=lanes, whole=whole) for lanes in (True, False))
    off = {name: float((one[name] - t).norm() / t.norm()) for name, t in other.items() if t.any() or one[name].any()}
    beyond = {name: value for name, value in off.items() if value > within}
    if dtype == torch.float64 or not beyond:
        assert not beyond
        return
    # Where sums cancel, the last bits of an input change what one engine finds in single precision by as much.
    others = [compared(lattice, dtype, lanes=True, whole=whole, bits=k) for k in (-3, -2, 2, 3)]
    for name, value in beyond.items():
        assert value <= 2 * max(float((one[name] - o[name]).norm() / one[name].norm()) for o in others), name


@pytest.mark.slow
@pytest.mark.parametrize("lattice", [uneven(), hollow()], ids=["uneven", "whole"])
def test_kernels_for_any_load_move_a_body_like_its_own(lattice, monkeypatch):
    p = problem(formulation="total", lattice=lattice, steps=5, samples=(), lanes=False)
    own = p.run()[0]
    monkeypatch.setattr(total, "_features", lambda scene, of=total._features: of(scene) | layout.ANY_LOAD)
    assert float((p.run()[0] - own).abs().max()) <= 1e-14 * float(own.abs().max())


@pytest.mark.slow
def test_both_engines_agree_on_walls_of_more_points_than_a_tile_has_room_for():
    axes = (Axis.uniform(5.0, 1.0, 3), Axis.uniform(3.0, 0.5, 18), Axis.uniform(3.0, 0.5, 18))
    states = []
    for lanes in (True, False):
        lattice = Lattice(axes=axes)
        p = completed(problem(formulation="total", lattice=lattice, steps=3, samples=(), lanes=lanes), end=(2, 17, 17))
        walls = p.scene.lattice.walls  # type: ignore[union-attr]
        assert 3 * len(walls.places) > max(t.pad for t in layout.SHAPES) - 2 * layout.TILE  # type: ignore[union-attr]
        states.append(p.run()[0][0, : 6 * lattice.nodes])
    assert float((states[0] - states[1]).norm()) < 1e-12 * float(states[0].norm())


def on(device, p):
    """Outputs of the kernels of a GPU on a device, and gradients of their sum."""
    torchsoro.init(device)
    s = p.scene
    moved = {f.name: t.to(device) for f in fields(s) if isinstance(t := getattr(s, f.name), torch.Tensor)}
    leaves = {name: t.detach().to(device).requires_grad_() for name, t in p.tensors.items()}
    outputs = replace(p, scene=replace(s, **moved)).run(leaves)
    gradients = torch.autograd.grad(torch.stack([o.sum() for o in outputs]).sum(), list(leaves.values()))
    return [t.detach().cpu() for t in (*outputs, *gradients)]


@pytest.mark.parametrize(
    ("lattice", "whole"),
    [(None, False), (uneven(), False), (wide(), False), (hollow(), True)],
    ids=["uniform", "uneven", "wide", "whole"],
)
def test_cuda_agrees_with_the_same_kernels_on_a_cpu_and_with_itself_bit_by_bit(cuda, lattice, whole):
    p = problem(formulation="total", lattice=lattice, batch=2, steps=12, samples=(0, 5, 12), lanes=False)
    if whole:
        p = completed(p)
    wanted, found, again = on("cpu", p), on(str(cuda), p), on(str(cuda), p)
    torchsoro.init("cpu")
    for a, b, c in zip(wanted, found, again, strict=True):
        assert torch.equal(b, c)
        assert float((a - b).norm()) <= 1e-12 * float(a.norm())


@one_at_once
def test_forces_and_pressure_are_those_of_the_energy_and_the_volume_of_the_chamber(lanes):
    # One substep from a random state against the derivatives, by torch, of what is summed over all points at once.
    p = problem(formulation="total", lattice=wide(), steps=1, samples=(), elements=0, lanes=lanes)
    lat, c = wide(), p.tensors["coefficients"]
    kind = torch.full(lat.points, -1, dtype=torch.int32)
    kind[2:7, 3:9, 4:15] = 0
    kind = kind.reshape(-1)
    kind[p.scene.kind == layout.ABSENT] = layout.ABSENT
    p.scene = replace(
        p.scene,
        **{"kind": kind, "springs": False, "drags": False, "viscous": False, "stiffens": False},
        **{"share": p.scene.share[:0], "plane_kind": p.scene.plane_kind[:0]},
    )
    p.tensors |= {"force": p.tensors["force"][:, :, :0], "planes": p.tensors["planes"][:, :0]}
    p.tensors["pressure"] = p.tensors["pressure"][..., :1]
    c[:, (layout.VOID_FRACTION, layout.DRAG)] = 0
    d, v = p.tensors["state"].view(2, 3, lat.nodes)
    d = (0.3 * d).requires_grad_()
    p.tensors["state"] = torch.stack([d.detach(), v]).view(1, -1)

    F = lat.gradient(d.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3).double()
    J, trace = torch.linalg.det(F), (F * F).sum((1, 2))
    volume, bulk, shear = (c[0, row] for row in (layout.VOLUME, layout.BULK, layout.SHEAR))
    solid = shear / 2 * (J ** (-2 / 3) * trace - 3) + bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2)
    below = (J - 1) - (J - 1) ** 2 / 2
    void = shear / 2 * (trace - 3) - shear * torch.where(J > 1, torch.log(J), below)
    gas = kind == 0
    energy = (volume * torch.where(gas, void, solid)).sum()
    V, V0 = (volume * J)[gas].sum(), volume[gas].sum()
    stiffness = (volume * bulk)[gas].sum() / V0
    pressure = p.tensors["pressure"][0, 0, 0] - stiffness * (V / V0 - 1)
    (by_energy,) = torch.autograd.grad(energy, d, retain_graph=True)
    (area,) = torch.autograd.grad(V, d)
    mass = lat.nodal_mass(c[:, layout.MASS])[0]
    there = mass > 0
    wanted = v + p.scene.dt * (p.tensors["gravity"][0, 0][:, None] - (by_energy - pressure.detach() * area) / mass)

    found = p.run()[0][0, 3 * lat.nodes :].view(3, -1)
    assert float((wanted - v)[:, there].abs().max()) > 1e-2
    torch.testing.assert_close(found[:, there], wanted.detach()[:, there], rtol=0, atol=1e-12)


# --------------------------------------------------------------------------------------------------------------- tiles


@given(
    cells=st.integers(1, 13),
    creased=st.sets(st.integers(1, 12)),
    most=st.sampled_from(layout.SHAPES),
    way=st.integers(0, 2),
)
def test_tiles_cover_an_axis_and_no_node_belongs_to_more_than_two(cells, creased, most, way):
    a = axis(*np.ones(cells), creases=tuple(c for c in creased if c < cells))
    tiles = tiles_along(a, most.cells[way], most.nodes[way])
    assert [c for cell, count, _ in tiles for c in range(cell, cell + count)] == list(range(cells))
    assert [first for _, _, first in tiles] == [a.first[cell] for cell, _, _ in tiles]
    nodes = [np.arange(first, a.first[cell + count - 1] + 3) for cell, count, first in tiles]
    assert all(len(n) <= most.nodes[way] for n in nodes)
    count = np.bincount(np.concatenate(nodes), minlength=a.nodes)
    assert 1 <= count.min() <= count.max() <= 2


def test_a_tile_with_room_for_more_nodes_goes_on_beyond_creases():
    creased = axis(1, 1, 1, 1, creases=(1, 3))
    assert tiles_along(creased, 4, 8).tolist() == [[0, 4, 0]]
    assert tiles_along(creased, 4, 7).tolist() == [[0, 3, 0], [3, 1, 5]]
    assert tiles_along(creased, 4, 6).tolist() == [[0, 1, 0], [1, 2, 2], [3, 1, 5]]


@pytest.mark.parametrize("shape", layout.SHAPES)
def test_a_tile_has_a_thread_for_each_of_its_points_lines_sheets_and_nodes(shape):
    points = 8 * np.prod(shape.cells)
    assert max(points, shape.lines, shape.sheets, shape.count) <= layout.TILE
    assert 4 * KEPT + 4 * shape.pad <= LIMIT


@pytest.mark.parametrize("shape", layout.SHAPES)
def test_a_body_that_fills_a_tile_gets_it(shape):
    found = tiles_of(filled(shape), torch.zeros(0))
    assert (found.of, found.count) == (shape, 1)


def test_a_lattice_takes_the_shape_of_which_it_needs_least():
    across = axis(1, 1, 1, 1, creases=(1, 3))
    finger = Lattice(axes=(axis(*np.ones(8)), across, across))
    found = tiles_of(finger, torch.zeros(0))
    assert (found.of.nodes, found.counts) == ((4, 8, 8), (4, 1, 1))
    bar = Lattice(axes=(axis(*np.ones(8)), axis(1, 1), axis(1, 1)))
    assert tiles_of(bar, torch.zeros(0)).counts == (1, 1, 1)


def test_every_share_of_a_tile_goes_to_the_node_that_it_is_of():
    # Tiles hand over 1 for each node of theirs: a node gets as many as there are tiles that have it.
    lat = wide()
    kind = torch.full((lat.count,), -1, dtype=torch.int32)
    kind[: lat.count // 3], kind[-9:] = 0, layout.ABSENT
    tiles = tiles_of(lat, torch.zeros(0))
    _, _, chamber_start, slot_start, slots, sources, near, *_ = tables(lat, tiles, kind, 2)
    many = len(slot_start) - 1 + len(slots)
    at = np.sort(sources[sources >= 0])
    assert len(np.unique(at)) == len(at)
    assert at.max() < many * tiles.of.slot
    counts = [
        np.bincount(np.concatenate([np.arange(first, a.first[cell + n - 1] + 3) for cell, n, first in t]))
        for a, t in zip(lat.axes, tiles.along, strict=True)
    ]
    wanted = counts[0][:, None, None] * counts[1][None, :, None] * counts[2][None, None, :]
    assert (sources[0] >= 0).sum(0).tolist() == wanted.reshape(-1).tolist()
    assert chamber_start.tolist() == [0, len(slots), len(slots)]
    assert sorted(slots[:, 1].tolist()) == list(range(len(slots)))
    assert near[0].any()
    assert not near[1].any()
