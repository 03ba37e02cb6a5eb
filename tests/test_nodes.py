"""What acts on nodes of a given lattice, what is recorded at places, and simulations that diverge apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import DT, H, block, simulator, vector
from torch import Tensor

from torchsoro import Body, Drag, Force, PointMass, Simulator, Spring, Waveform, ground
from torchsoro.sim2real.twin.grid import Grid
from torchsoro.simulation.axis import Axis
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.loads import Clamp, QuadraticDrag
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.trajectory import Start

SIZE = (0.03, 0.02, 0.02)
HOLE = ((0.01, 0.005, 0.005), (0.02, 0.015, 0.015))
DENSITY = 1000.0
STEP = 1e-4
FREE = (0.0, 0.0, 0.0)


def bar(hollow: bool = False) -> tuple[Lattice, Body]:
    """Uneven cells with nodes on the faces of a bar, with a hollow chamber if asked, and its particles."""
    across = np.array([0.0, 0.005, 0.015, 0.02])
    planes = [np.array([0.0, 0.01, 0.02, 0.03]), across, across]
    x, y, z = (Axis(p, [low, high] if hollow else []) for p, low, high in zip(planes, *HOLE, strict=True))
    grid = Grid((x, y, z), [HOLE] if hollow else [])
    volume = torch.from_numpy(grid.volumes)
    ones = torch.ones_like(volume)
    body = Body(
        position=grid.lattice.particles,
        mass=DENSITY * volume,
        volume=volume,
        bulk=1e5 * ones,
        shear=4e4 * ones,
        chamber=torch.full((len(ones),), -1, dtype=torch.int32),
    )
    return grid.lattice, body


def run(lattice: Lattice, body: Body, steps: int = 100, engine: dict | None = None, **settings):
    """Motion of a bar without gravity, sampled at every step."""
    form = Total(lattice=lattice, limit=1.5, **(engine or {}))
    simulate = Simulator(cell=lattice.cell, dt=STEP, low=(-1.0,) * 3, high=(1.0,) * 3, formulation=form)
    return simulate(body, **{"duration": steps * STEP, "gravity": FREE, "sample_every": STEP, **settings})


def rigid(lattice: Lattice, body: Body) -> Tensor:
    """Shares of the nodes of what acts on all of a body as its weight does [nodes]."""
    mass = lattice.nodal_mass(lattice.spread(body.mass).unsqueeze(0))[0]
    return mass / mass.sum()


def whole(lattice: Lattice, *, displacement: tuple = FREE, velocity: tuple = FREE) -> Start:
    """A body that is moved, and moves, as a whole."""
    moved, moves = (vector(*v).expand(lattice.nodes, 3) for v in (displacement, velocity))
    return Start(displacement=moved, velocity=moves)


# Loads ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("differentiable", [False, True])
def test_a_force_on_nodes_acts_since_its_start(differentiable):
    lattice, body = bar()
    force = Force(share=rigid(lattice, body), value=vector(0.02, 0.0, -0.01), start=39.7 * STEP)
    value = force.value.requires_grad_() if differentiable else force.value
    found = run(lattice, body, loads=[replace(force, value=value)])
    steps = (torch.arange(101) - 40).clamp(min=0).unsqueeze(1)
    expected = steps * STEP * vector(0.02, 0.0, -0.01) / body.mass.sum()
    # Matched masses are found to 1e-8 or so, and what is spread by them with another sum is not quite rigid.
    torch.testing.assert_close(found.center_velocity, expected, rtol=1e-6, atol=1e-14)
    if differentiable:
        (by,) = torch.autograd.grad(found.center_velocity[-1].sum(), value)
        torch.testing.assert_close(by, (60 * STEP / body.mass.sum()).expand(3), rtol=1e-6, atol=0)


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_a_force_on_particles_acts_since_its_start(formulation):
    body = block()[1]
    force = Force(particles=torch.arange(64), value=vector(0.0, 0.01, 0.0), start=30 * DT)
    found = simulator(formulation=formulation)(body, duration=80 * DT, gravity=FREE, loads=[force], sample_every=DT)
    expected = 50 * DT * 0.01 / float(body.mass.sum())
    assert float(found.center_velocity[-1, 1]) == pytest.approx(expected, rel=1e-9)
    assert float(found.center_velocity[30, 1].abs()) < 1e-30


def test_a_force_goes_on_where_a_run_is_continued():
    lattice, body = bar()
    loads = [Force(share=rigid(lattice, body), value=vector(0.02, 0.0, 0.0), start=60 * STEP)]
    all_of_it = run(lattice, body, 100, loads=loads)
    half = run(lattice, body, 50, loads=loads)
    torch.testing.assert_close(run(lattice, body, 50, loads=loads, start=half).final, all_of_it.final, rtol=0, atol=0)


def test_mass_and_drag_on_nodes_count_with_the_bodys():
    lattice, body = bar()
    share, own = rigid(lattice, body), float(body.mass.sum())
    loads = [
        PointMass(share=share, mass=2 * own),
        Drag(share=share, coefficient=torch.tensor([0.0, 0.3], dtype=torch.float64)),
        Force(share=share, value=vector(0.0, 0.0, 0.05)),
    ]
    found = run(lattice, body, loads=loads).center_velocity[:, -1, 2]
    left = 3 * own / (3 * own + STEP * 0.3)
    expected = [100 * STEP * 0.05 / (3 * own), STEP * 0.05 / (3 * own) * sum(left ** (k + 1) for k in range(100))]
    assert found.tolist() == pytest.approx(expected, rel=1e-6)


def test_a_spring_to_the_mean_place_swings_a_free_body_at_its_frequency():
    lattice, body = bar()
    spring = Spring(share=rigid(lattice, body), stiffness=20.0, mean=True)
    found = run(lattice, body, 200, loads=[spring], start=whole(lattice, displacement=(1e-3, 0.0, 0.0)))
    omega = math.sqrt(20.0 / float(body.mass.sum()))
    # Half a step late, and a little fast, as symplectic steps are.
    rate = 2 * math.asin(omega * STEP / 2) / STEP
    swing = 1e-3 * torch.cos(rate * (found.time + STEP / 2)) / math.cos(rate * STEP / 2)
    middle = found.center_of_gravity[:, 0] - 0.015
    torch.testing.assert_close(middle, swing, rtol=0, atol=1e-9)
    assert float(found.position.numel()) == 0


def test_a_spring_to_a_mean_place_lets_particles_turn_about_it():
    """One on each particle by itself does not."""
    body = block(velocity=None)[1]
    x = body.position - body.position.mean(0)
    spin = replace(body, velocity=torch.linalg.cross(vector(0.0, 0.0, 5.0).expand_as(x), x))
    turned = []
    for mean in (True, False):
        spring = Spring(particles=torch.arange(64), stiffness=500.0, mean=mean)
        found = simulator(formulation="total")(
            spin, duration=400 * DT, gravity=FREE, loads=[spring], sample_every=400 * DT, probes=torch.tensor([0])
        )
        turned.append(float((found.position[-1] - found.position[0]).norm()))
    assert turned[0] == pytest.approx(float(x[0, :2].norm()) * 5.0 * 400 * DT, rel=0.01) and turned[1] < 0.7 * turned[0]


def test_quadratic_drag_stops_a_body_as_in_closed_form():
    lattice, body = bar()
    found = run(lattice, body, 100, loads=[QuadraticDrag(1500.0)], start=whole(lattice, velocity=(0.5, 0.0, 0.0)))
    rate = 1500.0 * SIZE[1] * SIZE[2] / (2 * float(body.mass.sum()))
    assert float(found.center_velocity[-1, 0]) == pytest.approx(0.5 / (1 + rate * 0.5 * 100 * STEP), rel=2e-3)


def test_a_clamped_bar_hangs_on_its_end():
    lattice, body = bar()
    clamp = Clamp((-1e-3, -1.0, -1.0), (0.0, 1.0, 1.0))
    start = whole(lattice, displacement=(0.0, 0.0, 1e-3), velocity=(0.0, 1.0, 0.0))
    found = run(lattice, body, 50, gravity=(0.0, 0.0, -9.81), loads=[clamp], start=start)
    motion = found.final[0, : 6 * lattice.nodes].view(6, -1)
    on = lattice.node_places[:, 0] == 0
    assert bool((motion[:, on] == 0).all()) and bool((motion[:, ~on] != 0).all())


def test_softening_leaves_less_of_the_stress_below_the_largest_stretch():
    """A bar that is let go from a stretch swings back more slowly, the deeper it softens."""
    lattice, body = bar()
    wide = torch.zeros(lattice.nodes, 3, dtype=torch.float64)
    wide[:, 0] = 0.2 * (lattice.node_places[:, 0] - 0.015)
    start, ends = Start(displacement=wide, velocity=torch.zeros_like(wide)), []
    for depth in (0.0, 0.5):
        soft = replace(body, softening=vector(depth, 1e-3))
        found = run(lattice, soft, 60, start=start, probes=vector(0.03, 0.01, 0.01).unsqueeze(0))
        ends.append(int(found.position[:, 0, 0].argmin()))
    assert ends[1] > ends[0] > 10


# Chambers ---------------------------------------------------------------------------------------------------------


def test_volume_and_pressure_of_a_hollow_chamber_follow_its_walls():
    lattice, body = bar(hollow=True)
    wide = 1.1 * torch.ones(3, dtype=torch.float64)
    start = Start(
        displacement=(wide - 1) * (lattice.node_places - vector(0.015, 0.01, 0.01)),
        velocity=torch.zeros(lattice.nodes, 3, dtype=torch.float64),
    )
    supply = Waveform(time=vector(0.0, 1.0), pressure=vector(500.0, 500.0))
    sealed = replace(body, air_stiffness=vector(1e3))
    found = run(lattice, sealed, 2, pressure=supply, start=start)
    assert float(found.chamber_volume[0, 0]) == pytest.approx(1.1**3 * 1e-6, rel=1e-12)
    assert float(found.chamber_pressure[0, 0]) == pytest.approx(500.0 - 1e3 * (1.1**3 - 1), rel=1e-12)


def test_pressure_in_a_hollow_chamber_moves_no_free_body_and_widens_it():
    lattice, body = bar(hollow=True)
    found = run(lattice, body, pressure=Waveform(time=vector(0.0, 1.0), pressure=vector(2e3, 2e3)))
    assert float(found.center_velocity.abs().max()) < 1e-12
    assert float(found.chamber_volume[-1, 0] - found.chamber_volume[0, 0]) > 1e-9


# What is recorded -------------------------------------------------------------------------------------------------


def test_places_and_their_gradients_are_exact_in_an_affine_motion():
    lattice, body = bar()
    A = torch.tensor([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]], dtype=torch.float64)
    start = Start(displacement=lattice.node_places @ (A.T - torch.eye(3)), velocity=lattice.node_places @ A.T)
    # One of them is outside of the body.
    places = torch.tensor([[0.013, 0.007, 0.011], [0.03, 0.02, 0.02], [0.031, 0.01, 0.025]], dtype=torch.float64)
    found = run(lattice, body, 1, start=start, probes=places)
    torch.testing.assert_close(found.position[0], places @ A.T, rtol=0, atol=1e-14)
    torch.testing.assert_close(found.velocity[0], places @ A.T, rtol=0, atol=1e-14)
    torch.testing.assert_close(found.deformation[0], A.expand(3, 3, 3), rtol=0, atol=1e-11)


def test_a_place_of_a_particle_moves_as_the_particle():
    lattice, body = bar()
    push = Force(particles=torch.tensor([3]), value=vector(0.0, 0.01, 0.0))
    one, other = (run(lattice, body, loads=[push], probes=p) for p in (torch.tensor([5]), lattice.particles[5:6]))
    torch.testing.assert_close(one.position, other.position, rtol=0, atol=1e-15)
    torch.testing.assert_close(one.velocity, other.velocity, rtol=0, atol=1e-13)
    assert one.deformation.shape[1:] == (0, 3, 3)


def test_gradients_by_a_force_of_places_and_deformations_are_those_of_differences():
    lattice, body = bar()
    share, weight = rigid(lattice, body) * (1 + lattice.node_places[:, 0] / 0.015), vector(0.3, -0.5, 0.8)
    share = share / share.sum()
    places = torch.tensor([[0.013, 0.007, 0.011], [0.03, 0.02, 0.02]], dtype=torch.float64)

    def loss(value: Tensor) -> Tensor:
        clamp = Clamp((-1e-3, -1.0, -1.0), (0.0, 1.0, 1.0))
        found = run(lattice, body, 20, loads=[clamp, Force(share=share, value=value)], probes=places)
        seen = found.deformation[10:] @ weight + 30 * found.position[10:] + found.velocity[10:]
        return (seen * torch.arange(seen.numel()).view_as(seen).cos()).sum()

    value = vector(0.02, 0.01, -0.03).requires_grad_()
    (by,) = torch.autograd.grad(loss(value), value)
    step = 1e-5
    for k, unit in enumerate(torch.eye(3, dtype=torch.float64)):
        difference = (loss(value.detach() + step * unit) - loss(value.detach() - step * unit)) / (2 * step)
        assert float(by[k]) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.parametrize("name", ["softening", "air_stiffness", "drag", "stiffness"])
def test_gradients_by_what_acts_on_nodes_are_those_of_differences(name):
    lattice, body = bar(hollow=True)
    held = torch.nonzero(lattice.particles[:, 0] > 0.02).squeeze(-1)
    supply = Waveform(time=vector(0.0, 1.0), pressure=vector(2e3, 2e3))
    wide = torch.zeros(lattice.nodes, 3, dtype=torch.float64)
    wide[:, 0] = 0.2 * (lattice.node_places[:, 0] - 0.015)
    start = Start(displacement=wide, velocity=torch.full_like(wide, 0.5))
    places = torch.tensor([[0.013, 0.003, 0.011], [0.03, 0.02, 0.02]], dtype=torch.float64)
    numbers = {
        "softening": vector(0.5, 0.02),
        "air_stiffness": vector(3e4),
        "drag": vector(1500.0),
        "stiffness": vector(300.0),
    }

    def loss(value: Tensor) -> Tensor:
        now = {**numbers, name: value}
        loads = [QuadraticDrag(now["drag"][0]), Spring(particles=held, stiffness=now["stiffness"][0], mean=True)]
        soft = replace(body, softening=now["softening"], air_stiffness=now["air_stiffness"])
        found = run(lattice, soft, 30, loads=loads, start=start, pressure=supply, probes=places)
        seen = torch.cat([found.position.flatten() / 1e-3, found.velocity.flatten() / 0.1])
        return (seen * torch.arange(len(seen)).cos()).sum()

    value = numbers[name].clone().requires_grad_()
    (by,) = torch.autograd.grad(loss(value), value)
    for k, unit in enumerate(torch.eye(len(value), dtype=torch.float64)):
        step = 1e-4 * float(numbers[name][k])
        parts = [w * float(loss(numbers[name] + n * step * unit)) for n, w in ((-2, 1), (-1, -8), (1, 8), (2, -1))]
        assert float(by[k]) == pytest.approx(sum(parts) / (12 * step), rel=1e-6)


@pytest.mark.parametrize("engine", [{}, {"lanes": False}, pytest.param({"device": "cpu"}, marks=pytest.mark.slow)])
def test_a_simulation_that_diverges_is_marked_and_leaves_the_others_as_they_are(engine):
    lattice, body = bar()
    wild = torch.stack([vector(0.1, 0.0, 0.0), vector(0.1, 0.0, 3e4)]).unsqueeze(1).expand(2, lattice.nodes, 3).clone()
    wild[1, ::2] *= -1
    start = Start(displacement=torch.zeros_like(wild), velocity=wild)
    places = vector(0.03, 0.02, 0.02).unsqueeze(0)
    how = {"divergence": "mark", "record": "probes", "engine": engine}
    found = run(lattice, body, start=start, probes=places, **how)
    assert found.sound.tolist() == [True, False]
    assert found.center_of_gravity.shape == found.chamber_volume.shape == (2, 101, 0)
    alone = run(lattice, body, start=Start(displacement=start.displacement[:1], velocity=wild[:1]), probes=places)
    for name in ("position", "velocity", "deformation"):
        torch.testing.assert_close(getattr(found, name)[0], getattr(alone, name)[0], rtol=1e-9, atol=1e-11)
    assert alone.sound.tolist() == [True]


@pytest.mark.parametrize(
    ("settings", "engine", "message"),
    [
        ({"record": "markers"}, {}, "record = 'markers'"),
        ({"record": "probes"}, {}, "divergence = 'mark'"),
        ({"record": "probes", "divergence": "mark", "probes": torch.arange(2)}, {}, "wanted places"),
        ({"divergence": "mark"}, {"device": "cuda"}, "record = 'probes'"),
    ],
)
def test_a_record_that_is_not_kept_is_refused(settings, engine, message):
    lattice, body = bar()
    with pytest.raises(ValueError, match=message):
        run(lattice, body, engine=engine, **{"probes": vector(0.03, 0.02, 0.02).unsqueeze(0), **settings})


# Lattices ---------------------------------------------------------------------------------------------------------


def test_a_lattice_that_is_given_moves_as_the_one_that_is_found():
    body, push = block()[1], [Force(particles=torch.tensor([3]), value=vector(0.0, 0.01, 0.0))]
    forms = "total", Total(lattice=Lattice.around(body.position, 2 * H))
    one, other = (
        simulator(formulation=form)(body, duration=50 * DT, planes=[ground(-1e-3)], loads=push).final for form in forms
    )
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"loads": [Force(share=torch.full((2,), 0.5), value=vector(0, 0, 1))]},
            r"share of a Force: .* wanted \[..., ",
        ),
        ({"loads": [Clamp((1.0, 1.0, 1.0), (2.0, 2.0, 2.0))]}, "wanted one that holds a node"),
        ({"divergence": "ignore"}, "divergence = 'ignore': wanted 'raise' or 'mark'"),
        ({"probes": torch.zeros(2)}, r"probes: places of shape \(2,\), wanted finite places \[P, 3\] m"),
    ],
)
def test_what_does_not_fit_the_lattice_is_refused(settings, message):
    lattice, body = bar()
    with pytest.raises(ValueError, match=message):
        run(lattice, body, **settings)


def test_particles_beside_the_places_of_the_lattice_are_refused():
    lattice, body = bar()
    moved = body.position.clone()
    moved[7, 1] += 1e-3
    with pytest.raises(ValueError, match=r"body.position: particle 7 at .*, wanted its place in the lattice"):
        run(lattice, replace(body, position=moved))


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"loads": [Clamp((-1.0,) * 3, (0.001, 1.0, 1.0))]}, "a Clamp"),
        ({"loads": [Spring(particles=torch.arange(64), stiffness=5.0, mean=True)]}, "a Spring of nodes"),
        ({"start": Start(displacement=torch.zeros(64, 3), velocity=torch.zeros(64, 3))}, "a Start of nodes"),
    ],
)
def test_bodies_beside_their_lattice_are_refused_where_nodes_have_places_of_their_own(settings, what):
    body = block()[1]
    apart = torch.stack([body.position, body.position + vector(5e-3, 0.0, 0.0)])
    with pytest.raises(ValueError, match=f"body.position: 5 mm beside the lattice, wanted on it where there is {what}"):
        simulator(formulation="total")(replace(body, position=apart), duration=10 * DT, **settings)


def test_a_box_that_ends_on_nodes_holds_them_in_either_precision():
    for dtype in (torch.float64, torch.float32):
        x = (block(origin=(0.0, 0.0, 0.3))[1].position).to(dtype)
        lattice = Lattice.around(x, 2 * H)
        top = 0.3 + 3 * H  # where the third layer of nodes lies, the first half a cell below the body
        assert int(lattice.inside((-1.0, -1.0, 0.0), (1.0, 1.0, top)).sum()) == 3 * lattice.shape[0] * lattice.shape[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"loads": [Clamp((0.0,) * 3, (1.0,) * 3)]}, "loads: Clamp on nodes or means"),
        ({"loads": [QuadraticDrag(1.0)]}, "loads: QuadraticDrag on nodes or means"),
        ({"loads": [Spring(particles=torch.tensor([0]), stiffness=1.0, mean=True)]}, "loads: Spring on nodes or means"),
        ({"probes": torch.zeros(1, 3)}, "probes: places"),
        ({"start": Start(displacement=torch.zeros(1, 3), velocity=torch.zeros(1, 3))}, "start: a Start of nodes"),
        ({"divergence": "mark"}, "divergence = 'mark': wanted the total-Lagrangian formulation"),
    ],
)
def test_the_updated_form_refuses_what_it_does_not_have(settings, message):
    body = block()[1]
    with pytest.raises(ValueError, match=message):
        simulator(formulation="updated")(body, duration=10 * DT, **settings)


def test_loads_on_nodes_of_a_lattice_that_nobody_gave_are_refused():
    with pytest.raises(ValueError, match=r"a Drag on nodes, wanted Total\(lattice=...\), or particles"):
        simulator(formulation="total")(block()[1], duration=10 * DT, loads=[Drag(share=torch.ones(1), coefficient=1.0)])


def test_a_gradient_through_simulations_that_diverge_apart_is_refused():
    lattice, body = bar()
    with pytest.raises(ValueError, match="diverge apart: no gradient"):
        run(lattice, replace(body, mass=body.mass.requires_grad_()), 2, divergence="mark")
