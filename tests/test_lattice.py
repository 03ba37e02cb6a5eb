"""The reference lattice of the total-Lagrangian form: its weights, its nodes, and which bodies fit it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import DT, H, block, problem, rotations, simulator

from torchsoro.simulation.axis import Axis
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.arena import Arena
from torchsoro.simulation.ops.axis_sums import PARTICLES, QUADRATURE
from torchsoro.simulation.ops.lattice import Lattice, numbers
from torchsoro.simulation.ops.scene import Inputs
from torchsoro.simulation.ops.total import TotalSegmentIntegrator

SHAPES = st.tuples(*[st.sampled_from([2, 4, 6, 8])] * 3)
CELLS = st.floats(1e-3, 10.0)


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def lattice(points, cell=1.0):
    return Lattice.uniform(points, (0.3, -1.0, 2.0), cell)


def uneven():
    """Open knots and cells of any width along x, a crease along z; ghost nodes along y: [m]."""
    x = Axis(np.array([0.3, 0.7, 1.0, 1.9]))
    z = Axis(np.array([2.0, 2.5, 3.2, 3.9, 4.2, 4.9]), creases=[3.2])
    return Lattice(axes=(x, Axis.uniform(-1.0, 0.5, 2), z))


def affine(where, seed, scale=1.0):
    """An affine vector field at places [..., 3]: [..., 3], and its gradient."""
    A, b = draw(3, 3, seed=seed) / scale, draw(3, seed=seed + 1)
    return where @ A.T + b, A


def quadrature(lat):
    """Places of the points of quadrature [points, 3] m."""
    points = [torch.from_numpy(axis.points.reshape(-1)) for axis in lat.axes]
    return torch.stack(torch.meshgrid(*points, indexing="ij"), -1).reshape(-1, 3)


# ------------------------------------------------------------------------------------------------------------- weights


@given(cells=st.sampled_from([1, 2, 5]), place=st.floats(0.01, 0.49), low=st.floats(-1e3, 1e3), cell=CELLS)
def test_weights_of_a_uniform_axis_are_those_of_the_quadratic_spline_wherever_it_begins(cells, place, low, cell):
    axis = Axis.uniform(low, cell, cells)
    weight, slope = axis.tabulate(place)
    for odd, sign in enumerate((-1, 1)):
        f = 1 + sign * place
        numbers = (0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2)
        assert weight[:, odd] == pytest.approx(np.tile(numbers, (cells, 1)), abs=1e-14)
        assert slope[:, odd] * cell == pytest.approx(np.tile((f - 1.5, -2 * (f - 1), f - 0.5), (cells, 1)), abs=1e-14)
    assert axis.nodes == cells + 2
    assert axis.places == pytest.approx(low + cell * (np.arange(cells + 2) - 0.5), rel=1e-12)
    assert not np.abs(axis.centers).max() > 1e-9 * max(abs(low), cell)
    assert axis.spans == pytest.approx(np.full(cells + 2, cell), rel=1e-6)


@given(
    widths=st.lists(st.floats(0.2, 5.0), min_size=1, max_size=6), creased=st.integers(0, 5), place=st.floats(0.0, 0.49)
)
def test_weights_of_an_axis_with_open_knots_are_a_partition_of_unity_and_reproduce_places(widths, creased, place):
    planes = np.cumsum([0.7, *widths])
    axis = Axis(planes, creases=planes[creased : creased + 1])
    weight, slope = axis.tabulate(place)
    nodes = axis.first[:, None, None] + np.arange(3)
    assert (weight >= 0).all()
    assert weight.sum(-1) == pytest.approx(np.ones((axis.cells, 2)), abs=1e-13)
    assert slope.sum(-1) == pytest.approx(np.zeros((axis.cells, 2)), abs=1e-12)
    assert (weight * axis.places[nodes]).sum(-1) == pytest.approx(axis.inside(place), abs=1e-12)
    assert (slope * axis.places[nodes]).sum(-1) == pytest.approx(np.ones((axis.cells, 2)), abs=1e-11)
    assert axis.places[[0, -1]] == pytest.approx(planes[[0, -1]])
    inner = len(widths) > 1 and 0 < creased < len(widths)
    assert axis.nodes == axis.cells + 2 + inner == nodes.max() + 1


@pytest.mark.parametrize("planes", [[0.0], [0.0, 1.0, 1.0], [1.0, 0.0]])
def test_planes_that_do_not_increase_are_refused(planes):
    with pytest.raises(ValueError, match=r"^planes = .*: wanted two coordinates or more, each larger"):
        Axis(np.array(planes))


def test_the_quadrature_is_that_of_gauss():
    # Two points integrate cubics over a cell exactly.
    for power, wanted in ((0, 1.0), (1, 0.0), (2, 1 / 12), (3, 0.0)):
        assert sum((s * QUADRATURE) ** power / 2 for s in (-1, 1)) == pytest.approx(wanted, abs=1e-15)


def test_linear_fields_and_their_gradients_are_exact_on_uneven_axes():
    lat = uneven()
    field, A = affine(lat.node_places, 3)
    for kind, where in (("weight", quadrature(lat)), ("mark", lat.places)):
        torch.testing.assert_close(lat.to_points(field.T, kind).T, affine(where, 3)[0], rtol=0, atol=1e-12)
    gradient = lat.gradient(field.T.unsqueeze(0))
    torch.testing.assert_close(gradient, A.view(1, 3, 3, 1).expand_as(gradient), rtol=0, atol=1e-11)
    at, weights, slopes = lat.stencil(torch.arange(lat.count), place=QUADRATURE)
    torch.testing.assert_close((field.T[:, at] * weights).sum(-1), lat.to_points(field.T), rtol=0, atol=1e-12)
    by_slopes = torch.einsum("cpn,pan->cap", field.T[:, at], slopes)
    torch.testing.assert_close(by_slopes, gradient[0], rtol=0, atol=1e-11)


def test_nodes_on_the_faces_of_a_full_body_with_open_knots_reach_nowhere():
    lat = uneven()
    size = torch.from_numpy(np.prod(np.meshgrid(*(np.repeat(a.widths, 2) for a in lat.axes), indexing="ij"), axis=0))
    nodal = lat.nodal(size.reshape(1, -1), torch.zeros(1, lat.count).double(), 0.01)[0]
    assert not nodal[layout.NODAL_REACH].any()
    assert not nodal[layout.NODAL_REACH + 2].any()
    assert bool(nodal[layout.NODAL_REACH + 1].any())  # ghost nodes


@given(points=SHAPES, cell=CELLS, seed=st.integers(0, 999))
def test_linear_fields_and_their_gradients_are_exact(points, cell, seed):
    lat = lattice(points, cell)
    field, A = affine(lat.node_places, seed, cell)
    for kind, where in (("weight", quadrature(lat)), ("mark", lat.places)):
        found = lat.to_points(field.T, kind).T
        torch.testing.assert_close(found, affine(where, seed, cell)[0], rtol=1e-12, atol=1e-11)
    gradient = lat.gradient(field.T.unsqueeze(0))
    wanted = A.view(1, 3, 3, 1).expand_as(gradient)
    torch.testing.assert_close(gradient, wanted, rtol=0, atol=1e-10 / cell)


@given(points=SHAPES, seed=st.integers(0, 999), kind=st.sampled_from(["weight", "slope", "mark", "moment"]))
def test_sums_over_points_are_the_transposes_of_sums_over_nodes(points, seed, kind):
    lat = lattice(points)
    a, b = draw(2, lat.count, seed=seed), draw(2, lat.nodes, seed=seed + 1)
    for along in (None, (0, "slope"), (2, "moment")):
        there, back = (lat.to_nodes(a, kind, along) * b).sum(), (a * lat.to_points(b, kind, along)).sum()
        torch.testing.assert_close(there, back, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("place", "kind"), [(QUADRATURE, "weight"), (PARTICLES, "mark")])
def test_a_stencil_gathers_what_the_sums_do(place, kind):
    lat = lattice((4, 2, 6), cell=0.7)
    field, some = draw(2, 3, lat.nodes), torch.tensor([0, 17, 47, 5])
    at, weights, slopes = lat.stencil(some, place=place)
    torch.testing.assert_close((field[..., at] * weights).sum(-1), lat.to_points(field, kind)[..., some])
    if kind == "weight":
        gradient = torch.einsum("bcpn,pan->bcap", field[..., at], slopes)
        torch.testing.assert_close(gradient, lat.gradient(field)[..., some])


# --------------------------------------------------------------------------------------------------------------- nodes


@given(points=SHAPES, seed=st.integers(0, 999), drag=st.floats(0.0, 100.0))
def test_nodal_masses_sum_to_the_mass_and_balance_about_its_centre(points, seed, drag):
    lat = lattice(points, cell=0.5)
    mass = draw(2, lat.count, seed=seed).abs() + 0.1
    mass[:, torch.rand(lat.count, generator=torch.Generator().manual_seed(seed)) < 0.3] = 0
    nodal = lat.nodal(mass, drag * mass, 0.01)
    total = nodal[:, layout.NODAL_MASS]
    assert bool((total >= 0).all())
    torch.testing.assert_close(total.sum(1), mass.sum(1), rtol=1e-13, atol=0)
    torch.testing.assert_close(total @ lat.node_places, mass @ quadrature(lat), rtol=1e-12, atol=1e-12)
    # Drag takes its share of a step, implicitly; a node without mass keeps its velocity.
    factor = nodal[:, layout.NODAL_DRAG_FACTOR]
    there = total > 0
    torch.testing.assert_close(factor[there], torch.full_like(factor[there], 1 / (1 + 0.01 * drag)), rtol=1e-12, atol=0)
    assert bool((factor[~there] == 1).all())


def test_nodes_outside_of_a_face_reach_half_a_cell_to_it():
    lat = lattice((4, 6, 4), cell=0.5)
    nodal = lat.nodal(torch.ones(1, lat.count).double(), torch.zeros(1, lat.count).double(), 0.01)[0]
    for axis in range(3):
        ways = nodal[layout.NODAL_REACH + axis].view(lat.shape).movedim(axis, 0)
        torch.testing.assert_close(ways[0], torch.full_like(ways[0], 0.5), rtol=0, atol=1e-5)
        torch.testing.assert_close(ways[-1], torch.full_like(ways[0], -0.5), rtol=0, atol=1e-5)
        assert not ways[1:-1].any()


@settings(max_examples=15)
@given(points=SHAPES, seed=st.integers(0, 999), share=st.floats(0.0, 0.8))
def test_an_affine_field_known_at_the_particles_is_found_at_the_nodes(points, seed, share):
    lat = lattice(points, cell=0.5)
    present = torch.rand(lat.count, generator=torch.Generator().manual_seed(seed)) >= share
    present[: 1 + lat.points[2]] = True
    present[lat.points[1] * lat.points[2]] = True  # not all in a plane
    values = affine(lat.places, seed)[0].expand(2, -1, 3).clone()
    values[:, ~present] = 99.0  # counts for nothing
    found = lat.project(values, present)
    torch.testing.assert_close(
        found.transpose(1, 2), affine(lat.node_places, seed)[0].expand(2, -1, 3), rtol=0, atol=1e-10
    )


# --------------------------------------------------------------------------------------------- a lattice for a body


@given(points=SHAPES, seed=st.integers(0, 999), cell=st.floats(1e-4, 10.0))
def test_the_lattice_of_a_body_in_any_order_and_with_gaps(points, seed, cell):
    g = torch.Generator().manual_seed(seed)
    whole = lattice(points, cell)
    chosen = torch.randperm(whole.count, generator=g)[: max(1, whole.count - whole.count // 3)]
    corners = torch.tensor([0, whole.count - 1])
    chosen = torch.cat([chosen[~torch.isin(chosen, corners)], corners])
    x = whole.places[chosen] + 1e-5 * cell * (torch.rand(len(chosen), 3, generator=g).double() - 0.5)
    lat = Lattice.around(x.to(torch.float32) if seed % 2 else x, cell)
    assert lat.points == points
    assert lat.index is not None
    assert torch.equal(lat.index, chosen)
    torch.testing.assert_close(lat.places[lat.index], x, rtol=0, atol=1e-4 * cell)
    spread = lat.spread(torch.arange(1.0, len(chosen) + 1), empty=-1.0)
    assert spread[chosen].tolist() == list(range(1, len(chosen) + 1))
    assert int((spread == -1).sum()) == whole.count - len(chosen)


def test_a_full_lattice_in_order_needs_no_index_and_an_odd_number_of_layers_one_more():
    _, body = block((4, 6, 4))
    lat = Lattice.around(body.position, 2 * H)
    assert lat.index is None
    assert lat.points == (4, 6, 4)
    assert lat.shape == (4, 5, 4)
    assert lat.spread(body.mass) is body.mass
    odd = Lattice.around(body.position[body.position[:, 1] < 3 * H], 2 * H)
    assert odd.points == (4, 4, 4)
    assert odd.index is not None


def moved(**change):
    _, body = block()
    return replace(body, **{name: make(body.position) for name, make in change.items()})


def one_off(x):
    x = x.clone()
    x[5, 0] += 0.1 * H
    return x


def doubled(x):
    x = x.clone()
    x[5] = x[6]
    return x


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (one_off, r"particle 5 at \(0\.0015, .*\) m is 0\.09.* spacings off its place, wanted an undeformed lattice"),
        (lambda x: x @ rotations(1)[0].T, r"particle \d+ at .* spacings off its place, wanted .* parallel to the axes"),
        (lambda x: 1.01 * x, r"particle \d+ at .* off its place, wanted an undeformed lattice of spacing 0\.0025 m"),
        (doubled, r"two particles share a lattice place, wanted one particle for each"),
        (lambda x: torch.stack([x, 1.01 * x]), r"simulations of a batch whose bodies differ by more than a shift"),
    ],
    ids=["off", "turned", "stretched", "doubled", "batch"],
)
def test_a_body_that_fits_no_lattice_is_refused(place, message):
    body = moved(position=place)
    with pytest.raises(ValueError, match=r"^body\.position: " + message):
        simulator(formulation="total")(body, duration=DT)
    assert len(simulator()(body, duration=DT).time) == 2  # the other form takes it


def test_a_lattice_that_is_not_half_a_cell_is_refused():
    with pytest.raises(ValueError, match=r"^body\.position: .* spacings off .* spacing 0\.005 m \(half a cell\)"):
        simulator(formulation="total", cell=4 * H)(block()[1], duration=DT)


# -------------------------------------------------------------------------------------------------------------- layout


# Where a quantity of ``layout.BUFFERS`` begins is told by the constant of its name, or by this one.
RENAMED = {
    "fixed": {
        **{"coefficients": "COEFFICIENT", "prony": "ELEMENT", "nodal": "NODES", "chamber": "CHAMBER_NUMBERS"},
        **{"areas": "AREA", "ties": "TIE_STIFFNESS", "walls": "WALL_NUMBERS"},
    },
    "sums": {
        **{"coefficients_bar": "COEFFICIENT_BAR", "prony_bar": "ELEMENT_BAR", "plane_numbers_bar": "PLANE_BAR"},
        "nodal_bar": "NODES_BAR",
    },
}


def test_the_constants_of_the_layout_agree_with_its_names():
    assert (layout.COLLAPSED, layout.ARRIVED) == (0, 1)
    place = 2
    for name in layout.SIZES:
        assert getattr(layout, name.upper()) == place, name
        place += 1
    for buffer, quantities in layout.BUFFERS.items():
        for name in quantities:
            constant = RENAMED.get(buffer, {}).get(name, name.upper())
            assert getattr(layout, constant) == place, (buffer, name)
            place += 1
    assert place == layout.HEAD


def test_a_buffer_of_more_numbers_than_kernels_can_index_is_refused():
    shapes = (layout.LARGEST - 1,), (0,), (0,)
    assert Arena.over("kept", torch.empty(layout.LARGEST, device="meta"), *shapes).offsets == [0, *[shapes[0][0]] * 2]
    with pytest.raises(ValueError, match=r"kept: 2.147e\+09 numbers in a buffer, wanted at most 2.147e\+09"):
        Arena.over("kept", torch.empty(layout.LARGEST + 1, device="meta"), *shapes)


def test_a_segment_lays_its_quantities_where_the_constants_say():
    p = problem(formulation="total", batch=2)
    t = {name: value for name, value in p.tensors.items() if name not in ("state", "weight")}
    integrator = TotalSegmentIntegrator(p.scene, Inputs(**t), first=0, samples=())
    ints = integrator._ints([integrator.fixed, integrator.supply, integrator.kept, integrator.scratch])
    lat = integrator.lattice
    sizes = {
        **{"BATCH": 2, "NX": 4, "NY": 4, "NZ": 4, "ELEMENTS": 2, "CHAMBERS": 2, "GROUPS": 2, "PLANES": 3},
        **{"SPRINGS": 1, "VISCOUS": 1, "STEPS": 6},
    }
    for name, value in sizes.items():
        assert int(ints[getattr(layout, name)]) == value, name
    laid = {
        (ints, layout.KIND): p.scene.kind,
        (ints, layout.PLANE_KIND): p.scene.plane_kind,
        (integrator.fixed.buffer, layout.NUMBERS): numbers(lat, p.scene.dt, p.scene.cell),
        (integrator.fixed.buffer, layout.COEFFICIENT): t["coefficients"],
        (integrator.fixed.buffer, layout.ELEMENT): t["prony"],
        (integrator.fixed.buffer, layout.PLANE_NUMBERS): t["planes"],
        (integrator.fixed.buffer, layout.NODES): integrator.nodal,
        (integrator.fixed.buffer, layout.CHAMBER_NUMBERS): integrator.chamber,
        (integrator.fixed.buffer, layout.SHARE): p.scene.share,
        (integrator.supply.buffer, layout.PRESSURE): t["pressure"],
        (integrator.supply.buffer, layout.GRAVITY): t["gravity"],
        (integrator.supply.buffer, layout.FORCE): t["force"],
    }
    for (buffer, constant), wanted in laid.items():
        start = int(ints[constant])
        assert torch.equal(buffer[start : start + wanted.numel()], wanted.detach().reshape(-1)), constant
    table = integrator.fixed.buffer
    assert float(table[layout.STEP_SIZE]) == p.scene.dt
    assert float(table[layout.EDGE]) == p.scene.cell
    start = layout.AXES
    for axis in lat.axes:
        weight, slope = (torch.from_numpy(t.reshape(-1, 3)) for t in axis.table)
        size = 2 * axis.cells * layout.AXIS
        rows = table[start : start + size].view(-1, layout.AXIS)
        assert torch.equal(rows, torch.cat([weight, slope], 1))
        start += size + 2 * axis.cells + axis.nodes
        assert torch.equal(table[start - axis.nodes : start], torch.from_numpy(axis.places))
