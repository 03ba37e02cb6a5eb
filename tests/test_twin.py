"""The twin of an experiment: its grid, body, markers, loads, motion, and what hypotheses change of them."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit
from test_experiment import experiment

from torchsoro import Body, Solid
from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.data.schema import ChamberTable, ForceTable, Marker, PlaneTable
from torchsoro.sim2real.hypotheses.library import library
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.grid import Axis, divide
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.markers import Markers
from torchsoro.simulation.simulator import Simulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))
EDGE = 0.008
CHAMBER = ((0.01, 0.006, 0.007), (0.03, 0.014, 0.012))


@pytest.fixture
def trial(tmp_path):
    return read_experiment(experiment(tmp_path)).trials[0]


def changed(trial, pressure=None, **changes):
    return dataclasses.replace(trial, pressure=pressure, setup=dataclasses.replace(trial.setup, **changes))


def hollow(trial, pascal=2e3, **changes):
    """With a chamber that is filled in 10 ms."""
    wave = Waveform(
        time=torch.tensor([0.0, 0.01, 1.0], dtype=torch.float64),
        pressure=torch.tensor([[0.0, pascal, pascal]], dtype=torch.float64),
    )
    return changed(trial, wave, chambers=(ChamberTable(name="c", box=CHAMBER),), **changes)


# The grid ---------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.floats(0.1, 1.0), min_size=1, max_size=4), st.lists(st.integers(1, 4), min_size=4, max_size=4),
    st.floats(0.05, 0.6), st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5),
)  # fmt: skip
def test_splines_on_uneven_cells_reproduce_parabolas(lengths, least, edge, shares):
    breaks = [0.0, *np.cumsum(lengths)]
    axis = Axis(divide(breaks, least, edge))
    assert set(np.round(breaks, 9)) <= set(np.round(axis.planes, 9))
    x = np.array(shares) * breaks[-1]
    weights, slopes = axis.at(x, axis.cell(x))
    np.testing.assert_allclose(weights.sum(-1), 1.0)
    nodes = axis.cell(x)[:, None] + np.arange(3)
    np.testing.assert_allclose((weights * axis.places[nodes]).sum(-1), x, atol=1e-9)
    np.testing.assert_allclose((slopes * axis.places[nodes]).sum(-1), 1.0, atol=1e-8)
    # Products of knots are the coefficients of x^2.
    square = axis.knots[1:-2] * axis.knots[2:-1]
    np.testing.assert_allclose((weights * square[nodes]).sum(-1), x**2, atol=1e-9)


def test_mass_centre_and_wall_areas_of_a_chambered_box_match_its_geometry(trial):
    t = hollow(trial)
    twin = Twin(t.setup, edge=EDGE, walls=2)
    solid = math.prod(t.setup.size) - 0.02 * 0.008 * 0.005
    assert float(twin.volumes.sum()) == pytest.approx(solid, rel=1e-12)
    mass = twin.nodal(1000.0 * twin.volumes)
    assert float(mass.sum()) == pytest.approx(1000 * solid)
    whole, hole = math.prod(t.setup.size), 0.02 * 0.008 * 0.005
    middle = (whole * np.array(t.setup.center) - hole * np.mean(CHAMBER, axis=0)) / solid
    np.testing.assert_allclose(((mass[:, None] * twin.places).sum(0) / mass.sum()).numpy(), middle)
    walls = twin.grid.lattice.walls
    assert float(walls.volume[0]) == pytest.approx(hole)
    for axis, area in enumerate((0.008 * 0.005, 0.02 * 0.005, 0.02 * 0.008)):
        across = walls.areas[walls.axes == axis]
        assert float(across.sum()) == pytest.approx(0.0, abs=1e-12)
        assert float(across.abs().sum()) == pytest.approx(2 * area)
    areas = twin.grid.lattice.faces.facing(torch.eye(3)).sum(-1).numpy()
    np.testing.assert_allclose(areas, [0.02 * 0.02, 0.04 * 0.02, 0.04 * 0.02])


def test_markers_and_their_gradients_are_exact_in_an_affine_motion(trial):
    markers = [Marker(name=f"m{i}", at=at) for i, at in enumerate(
        [(0.04, 0.01, 0.02), (0.04, 0.0, 0.0), (0.021, 0.013, 0.026), (0.013, 0.007, 0.011)]
    )]  # fmt: skip
    twin = Twin(dataclasses.replace(trial.setup, markers=tuple(markers)), edge=EDGE)
    A = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]])
    moved = twin.places.numpy() @ A.T
    lattice = twin.grid.lattice
    kind = lattice.spread(torch.full((len(lattice.index),), -1.0), layout.ABSENT)
    at = torch.tensor([m.at for m in markers], dtype=torch.float64)
    found = Markers.at(lattice, kind, at)
    near = moved[found.nodes.numpy()]
    # One of them is above the body and moves with its surface as if it were tied to it.
    np.testing.assert_allclose(np.einsum("mkc,mk->mc", near, found.weights), at.numpy() @ A.T, atol=1e-12)
    np.testing.assert_allclose(np.einsum("mkc,mak->mca", near, found.slopes), np.tile(A, (4, 1, 1)), atol=1e-9)


@pytest.mark.parametrize("place", [(0.03, 0.01, 0.01), (0.04, 0.02, 0.02), (0.0391, 0.0012, 0.0197)])
def test_shares_of_an_attached_mass_have_its_place_as_centroid(trial, place):
    twin = Twin(trial.setup, edge=EDGE)
    share = twin.at(torch.tensor([place], dtype=torch.float64))[0]
    assert bool((share >= 0).all())
    torch.testing.assert_close(share @ twin.places, torch.tensor(place, dtype=torch.float64))


def test_centroid_of_a_load_is_the_middle_of_its_box(trial):
    box = ((0.03, 0.006, 0.012), (0.04, 0.013, 0.02))
    t = changed(trial, forces=(ForceTable(box=box, force=(0.0, 0.0, -0.1)),))
    push = Twin(t.setup, edge=EDGE)
    push = push.scenario(t).loads[0].share @ push.places
    torch.testing.assert_close(push, torch.tensor([0.035, 0.0095, 0.016], dtype=torch.float64))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clamps": (((0.5, 0.5, 0.5), (0.6, 0.6, 0.6)),)}, "wanted one that holds a part of the body"),
        ({"chambers": (ChamberTable(name="c", box=((0.01, 0.0, 0.01), (0.02, 0.01, 0.015))),)}, "within the body"),
        ({"forces": (ForceTable(box=((0.1, 0, 0), (0.2, 0.1, 0.1)), force=(0, 0, 1)),)}, "wanted a box that meets it"),
    ],
)
def test_clamps_chambers_and_loads_that_miss_the_body_are_refused(trial, changes, message):
    t = changed(trial, **changes)
    with pytest.raises(ValueError, match=message):
        Twin(t.setup, edge=EDGE).scenario(t)


# Motion -----------------------------------------------------------------------------------------------------------


def run(t, edge=EDGE, walls=2, **changes):
    twin = Twin(t.setup, edge=edge, walls=walls)
    return simulate(twin, [twin.scenario(t).replace(**changes)])[0].alone()


def cantilever(trial, length, width, **changes):
    """A slender bar, its marker in the middle of its free end."""
    return changed(
        trial,
        size=(length, width, width),
        clamps=(((-0.001, -0.001, -0.001), (0.0001, 0.026, 0.026)),),
        markers=(Marker(name="tip", at=(length, width / 2, width / 2)),),
        poisson_ratio=0.0,
        prony=(),
        **changes,
    )


@pytest.mark.parametrize("across", [3, 4])
def test_cantilever_frequency_matches_beam_theory(trial, across):
    from structures import timoshenko

    length, width = 0.1, 0.025
    t = cantilever(
        trial,
        length,
        width,
        gravity=(0.0, 0.0, -1.0),
        duration=0.5,
    )
    motion = run(t, edge=width / across)
    z = motion.position[:, 0, 2] - motion.position[0, 0, 2]
    exact = timoshenko(length, width, Solid(youngs_modulus=1e5, poisson_ratio=0.0, density=1000.0))
    fitted, _ = curve_fit(
        lambda t, c, a, w, p: c + a * np.cos(w * t + p),
        motion.time,
        z / abs(z).max(),
        p0=(-0.5, 0.5, 2 * math.pi * exact, 0.0),
    )
    assert abs(fitted[2]) / (2 * math.pi) == pytest.approx(exact, rel=0.006)


def test_a_bar_rings_once_a_load_that_held_it_ends(trial):
    from structures import timoshenko

    length, width, force = 0.1, 0.025, 0.02
    solid = Solid(youngs_modulus=1e5, poisson_ratio=0.0, density=1000.0)
    exact = timoshenko(length, width, solid)
    pulled, let_go = 2 / exact, 2.25 / exact  # a force that grows for whole periods leaves no swing
    box = ((length - 0.005, 0.0, 0.0), (length, width, width))
    t = cantilever(
        trial,
        length,
        width,
        gravity=(0.0, 0.0, 0.0),
        forces=(ForceTable(box=box, force=(0.0, 0.0, -force), ramp=pulled, end=let_go),),
        duration=let_go + 1.5 / exact,
    )
    motion = run(t, edge=width / 3)
    z = motion.position[:, 0, 2] - motion.position[0, 0, 2]
    inertia = width**4 / 12
    # A cantilever with a force at its end, shear included.
    sag = force * ((length - 0.0025) ** 3 / (3 * 1e5 * inertia) + 1.2 * length / (0.5e5 * width**2))
    held = (motion.time > pulled) & (motion.time < let_go)
    assert z[held] == pytest.approx(-sag, rel=0.06)
    free = motion.time > let_go
    assert z[free].max() == pytest.approx(sag, rel=0.08) and z[free].min() == pytest.approx(-sag, rel=0.08)
    crossings = motion.time[free][1:][np.diff(np.sign(z[free])) != 0]
    assert np.diff(crossings).mean() == pytest.approx(0.5 / exact, rel=0.03)


@pytest.mark.parametrize("stiffening", [0.0, 4.0])
def test_motion_of_a_loaded_bar_matches_the_material_point_simulator(trial, stiffening):
    """Same laws, other shape functions: a viscoelastic bar that swings far."""
    t = changed(trial, prony=((0.5, 0.01), (0.2, 0.002)), duration=0.15, gravity=(0.0, 0.0, -20.0))
    law = torch.tensor([stiffening, stiffening / 2], dtype=torch.float64)
    motion = run(t, edge=0.005, stiffening=law)
    h, low, size = 0.00125, np.array(t.setup.origin), np.array(t.setup.size)
    axes = [a + h * (np.arange(round(s / h)) + 0.5) for a, s in zip(low, size, strict=True)]
    axes[0] = np.concatenate([low[0] - h * (np.arange(4)[::-1] + 0.5), axes[0]])
    x = torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)).float()
    ones = torch.ones(len(x))
    mu, bulk = t.setup.youngs_modulus / 2.6, t.setup.youngs_modulus / (3 * (1 - 2 * 0.3))
    body = Body(
        position=x, mass=1000 * h**3 * ones, volume=h**3 * ones, bulk=bulk * ones, shear=mu * ones,
        chamber=-ones.int(), stiffening=law.float().expand(len(x), 2),
    )  # fmt: skip
    tip = int((x - torch.tensor(t.setup.markers[0].at)).norm(dim=-1).argmin())
    twin = Twin(t.setup, edge=0.005)
    scenario = twin.scenario(t)
    with torch.no_grad():
        seen = Simulator(cell=2 * h, dt="auto", low=(-0.5,) * 3, high=(0.5,) * 3, formulation="total")(
            body,
            duration=0.15,
            prony=scenario.prony,
            gravity=t.setup.gravity,
            # Nodes half a cell in front of the clamp are held, too, as a node there is in the wall.
            planes=[Plane(axis=0, offset=(0.51 - i) * 2 * h, side=1, adhesion=1e12) for i in range(3)],
            sample_every=2.5e-3,
            probes=torch.tensor([tip]),
        )
    other = seen.position[:, 0, 2].numpy() - float(x[tip, 2])
    mine = motion.position[:, 0, 2] - motion.position[0, 0, 2]
    # Holding more of it makes the simulator's bar shorter by 0.29 cells of 40 mm / 2.5 mm.
    assert np.abs(mine - other).max() < 0.08 * np.abs(mine).max()
    assert np.abs(mine).max() > 0.003


def test_centre_and_spin_of_a_free_body_match_rigid_free_fall(trial):
    t = changed(trial, clamps=(), velocity=(0.3, 0.0, 0.5), angular_velocity=(0.0, 20.0, 0.0), duration=0.1)
    markers = tuple(
        Marker(name=str(i), at=tuple(t.setup.origin[a] + s * t.setup.size[a] for a, s in enumerate(c)))
        for i, c in enumerate(np.ndindex(2, 2, 2))
    )
    motion = run(changed(t, markers=markers))
    middle = motion.position.mean(1)
    fall = (
        np.array(t.setup.center)
        + motion.time[:, None] * [0.3, 0, 0.5]
        - 9.81 / 2 * motion.time[:, None] ** 2 * [0, 0, 1]
    )
    np.testing.assert_allclose(middle, fall, atol=3e-4)
    # It has turned by two rad, and stays as large as it was.
    edge = motion.position[:, 4] - motion.position[:, 0]
    assert math.atan2(-edge[-1, 2], edge[-1, 0]) == pytest.approx(2.0, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(edge, axis=-1), t.setup.size[0], rtol=0.01)


def test_velocity_of_a_free_body_in_a_fluid_matches_quadratic_drag(trial):
    t = changed(trial, clamps=(), forces=(), gravity=(0.0, 0.0, 0.0), velocity=(0.5, 0.0, 0.0), duration=0.1)
    twin, drag = Twin(t.setup, edge=EDGE), next(e for e in library() if e.name == "drag")
    through = drag(twin.scenario(t), torch.tensor([[1600.0]], dtype=torch.float64), twin)
    way = simulate(twin, [through])[0].position[0, -1, :, 0].mean() - np.mean([m.at[0] for m in t.setup.markers])
    # m dv/dt = - density drag A v^2 / 2, with the area of the front.
    length, *front = t.setup.size
    rate = 1600.0 * math.prod(front) / 2 / (t.setup.density * length * math.prod(front))
    assert way == pytest.approx(math.log1p(rate * 0.5 * 0.1) / rate, rel=5e-3)
    assert way < 0.049


def test_initial_motion_of_a_free_body_equals_a_velocity_and_spin_stated_in_the_setup(trial):
    t = changed(trial, clamps=(), velocity=(0.0, 0.0, 0.0), duration=0.05)
    effect = next(e for e in library() if type(e).__name__ == "InitialRigidMotion")
    twin = Twin(t.setup, edge=EDGE)
    given = np.array([0.1, -0.2, 0.0, 0.0, 20.0, 5.0])
    moved = effect(twin.scenario(t), torch.from_numpy(given)[None], twin)
    found = simulate(twin, [moved])[0].alone()
    stated = changed(t, velocity=tuple(given[:3]), angular_velocity=tuple(given[3:]))
    np.testing.assert_allclose(found.position, run(stated).position, atol=1e-6)


def test_speed_of_an_initial_motion_is_that_of_the_fastest_corner(trial):
    twin = Twin(changed(trial, clamps=()).setup, edge=EDGE)
    effect = next(e for e in library() if type(e).__name__ == "InitialRigidMotion")
    length, width, _ = trial.setup.size
    told = effect.reported(np.array([0.0, 0.0, 0.3, 0.0, 0.0, 2.0]), twin.scenario(trial), twin)
    # A turn about z and a velocity along it are at right angles.
    assert told["speed_m_s"][0] == pytest.approx(math.hypot(0.3, 2.0 * math.hypot(length, width) / 2))


@pytest.mark.parametrize("boundary", [-0.2, 0.0, 0.1])
def test_a_soft_part_lacks_the_fraction_that_is_told_up_to_its_boundary(trial, boundary):
    twin = Twin(trial.setup, edge=EDGE)
    effect, scenario = next(e for e in library() if type(e).__name__ == "SoftPart"), twin.scenario(trial)
    values = np.array([0.0, 0.5, 0.0, boundary])
    modulus = effect(scenario, torch.from_numpy(values)[None], twin).youngs_modulus[0].numpy()
    side = (twin.positions.numpy() - trial.setup.center)[:, 1] / trial.setup.size[1]
    gained = np.log(modulus / twin.scenario(trial).youngs_modulus[0].numpy())
    # A seventh of the body off the boundary, where the smooth step has nearly ended.
    assert gained[side < boundary - 0.15] == pytest.approx(-0.25, rel=0.1)
    assert gained[side > boundary + 0.15] == pytest.approx(0.25, rel=0.1)
    lost = effect.reported(values, scenario, twin)["fraction"][0]
    assert lost == pytest.approx(1 - np.exp(-0.5))
    middle = trial.setup.origin[1] + (0.5 + boundary) / 2 * trial.setup.size[1]
    assert effect.place(values, twin)[1] == pytest.approx(middle)
    # The stiffer side's name for the same: the soft part is the other one.
    other = trial.setup.origin[1] + (1.5 + boundary) / 2 * trial.setup.size[1]
    assert effect.place(values * [1, -1, 1, 1], twin)[1] == pytest.approx(other)


@pytest.mark.parametrize("tilt", [0.0, pytest.param(0.4, marks=pytest.mark.slow)])
def test_sliding_distance_on_a_slope_matches_coulomb_friction(trial, tilt):
    """On a plane, level or not, which is the same to the block if gravity is as steep to it."""
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    low = np.array(trial.setup.origin)
    t = changed(
        trial,
        clamps=(),
        gravity=(0.0, 0.0, -9.81),
        velocity=(0.5, 0.0, 0.0),
        youngs_modulus=1e6,
        prony=((1.0, 0.001),),
        planes=(PlaneTable(point=tuple(low), normal=(0.0, 0.0, 1.0), friction=0.3),),
        duration=0.3,
    )
    motion = run(t)
    way = motion.position[-1, 0, 0] - motion.position[0, 0, 0]
    assert way == pytest.approx(0.5**2 / (2 * 0.3 * 9.81), rel=0.05)
    if tilt:
        # A plane through the body's lowest edge that it is pushed on from above at an angle.
        normal = turn @ [0, 0, 1]
        steep = changed(
            t, planes=(PlaneTable(point=tuple(low), normal=tuple(normal), friction=0.3),), velocity=(0, 0, 0)
        )
        seen = run(steep).position
        offset = normal @ low
        assert (seen[:, 0] @ normal - offset).min() > -1e-4


@pytest.mark.parametrize(("gap", "speed", "expected"), [(0.0, 0.2, 0.03**0.5), (3e-4, 0.0, -0.05), (6e-4, 0.0, 0.0)])
def test_adhesion_acts_within_its_reach_only(trial, gap, speed, expected):
    """A block that is thrown off loses what it takes to separate; one within reach is drawn in, one beyond is not."""
    low = np.array(trial.setup.origin)
    t = changed(
        trial,
        clamps=(),
        gravity=(0.0, 0.0, 0.0),
        velocity=(0.0, 0.0, speed),
        youngs_modulus=1e6,
        planes=(PlaneTable(point=tuple(low - [0.0, 0.0, gap]), normal=(0.0, 0.0, 1.0), friction=0.3),),
        duration=0.01,
    )
    height, density = t.setup.size[2], t.setup.density
    traction, reach = 0.5 * density * height * 0.1**2 / 5e-4, 5e-4  # together the energy of 0.1 m/s
    twin = Twin(t.setup, edge=EDGE)
    effect = next(e for e in library() if e.name == "adhesion")
    values = torch.tensor([[traction, math.log(reach)]], dtype=torch.float64)
    assert effect.reported(values[0].numpy(), twin.scenario(t), twin)["energy_j_m2"][0] == pytest.approx(
        traction * reach
    )
    motion = simulate(twin, [effect(twin.scenario(t), values, twin)])[0].alone()
    last = 2 if expected < 0 else -1  # before it meets the plane
    assert motion.velocity[last, :, 2].mean() == pytest.approx(expected, rel=0.1, abs=2e-3)


def test_chamber_volume_grows_with_pressure_and_less_with_air_stiffness(trial):
    t = hollow(trial, duration=0.2, gravity=(0.0, 0.0, 0.0))
    grown = [run(t, air_stiffness=torch.tensor([k], dtype=torch.float64)).position for k in (0.0, 2e4)]
    moved = [np.abs(p[-1] - p[0]).max() for p in grown]
    assert moved[0] > 1.2 * moved[1] > 1e-5
    # Air that was believed to be there and is not.
    twin = Twin(t.setup, edge=EDGE)
    twice = next(e for e in library() if e.name == "air_stiffness" and e.quantities[0].name == "share")
    believed = twin.scenario(t).replace(air_stiffness=torch.tensor([2e4], dtype=torch.float64))
    assert twice.applies(believed, twin) and not twice.applies(twin.scenario(t), twin)
    without = twice(believed, torch.tensor([[-1.0]], dtype=torch.float64), twin)
    assert not without.air_stiffness.any()
    assert twice.reported(np.array([-1.0]), believed, twin)["air_stiffness_pa"][0] == -2e4
    # Pressure acts from inside: the forces on the whole body add up to nothing.
    free = run(changed(t, t.pressure, clamps=(), duration=0.05))
    assert abs((free.position[-1] - free.position[0]).mean(0)[0]) < 2e-4


def test_variations_in_a_batch_equal_single_simulations(trial):
    twin = Twin(trial.setup, edge=EDGE)
    loaded = changed(trial, forces=(ForceTable(box=((0.03, 0.0, 0.0), (0.04, 0.02, 0.02)), force=(0.0, 0.0, -0.05)),))
    tether = next(e for e in library() if e.name == "tether")
    rows = [[0.0, 0.0, 0.0, 0.04, 0.01, 0.02], [3.0, 0.1, 0.001, 0.04, 0.01, 0.02]]
    values = torch.tensor(rows * 10, dtype=torch.float64)  # more than one group of lanes
    varied = [tether(twin.scenario(t), values, twin) for t in (trial, loaded)]
    for part, scenario in zip(simulate(twin, varied), (trial, loaded), strict=True):
        for row in range(2):
            alone = simulate(twin, [tether(twin.scenario(scenario), values[row : row + 1], twin)])[0]
            np.testing.assert_allclose(part.position[row], alone.position[0], atol=2e-6)
            np.testing.assert_allclose(part.position[18 + row], part.position[row], atol=1e-6)


def test_pressures_of_many_variations_are_those_of_their_own_lanes(trial):
    """Stiffer ones take shorter steps, so that lanes are in another order than variations, and in two groups."""
    t = hollow(trial, duration=0.02)
    twin = Twin(t.setup, edge=EDGE)
    gain, modulus = (next(e for e in library() if e.name == name) for name in ("pressure_loss", "modulus"))
    values = torch.linspace(-0.5, 0.5, 18, dtype=torch.float64)[:, None]
    found = simulate(twin, [modulus(gain(twin.scenario(t), values, twin), values, twin)])[0]
    for k in (0, 9, 17):
        row = values[k : k + 1]
        alone = simulate(twin, [modulus(gain(twin.scenario(t), row, twin), row, twin)])[0]
        assert np.ptp(alone.position) > 1e-3
        np.testing.assert_allclose(found.position[k], alone.position[0], atol=2e-6)


def test_a_diverged_variation_is_not_sound_and_leaves_others_unchanged(trial):
    twin = Twin(trial.setup, edge=EDGE)
    s = twin.scenario(trial)
    wild = s.replace(velocity=s.velocity + torch.tensor([0.0, 1e5])[:, None, None] * torch.ones(1, twin.nodes, 3))
    assert simulate(twin, [wild])[0].sound.tolist() == [True, False]


# Hypotheses -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", library(), ids=lambda e: type(e).__name__)
def test_every_effect_is_neutral_at_zero_strength_and_changes_the_motion_otherwise(trial, effect):
    free = type(effect).__name__ in ("InitialTilt", "InitialRigidMotion")
    load = ForceTable(box=((0.03, 0.0, 0.0), (0.04, 0.02, 0.02)), force=(0.0, 0.0, -0.1))
    stick = "stick" if type(effect).__name__ == "Sliding" else 0.4
    t = hollow(
        trial,
        forces=(load,),
        planes=(PlaneTable(point=(0.0, 0.0, trial.setup.origin[2] - 1e-4), normal=(0.0, 0.0, 1.0), friction=stick),),
        duration=0.05,
        **({"clamps": ()} if free else {}),
    )
    twin = Twin(t.setup, edge=EDGE, walls=2)
    scenario = twin.scenario(t)
    if type(effect).__name__ == "AirTwice":
        scenario = scenario.replace(air_stiffness=torch.tensor([2e4], dtype=torch.float64))
    assert effect.applies(scenario, twin) and len(effect.quantities) <= 6
    count = len(effect.quantities)
    zero = torch.zeros(1, count, dtype=torch.float64)
    some = torch.tensor(effect.probe_points(twin)[-1][:1, :count]) * torch.tensor([q.scale for q in effect.quantities])
    if effect.local:
        place = torch.tensor([[0.035, 0.01, 0.015]], dtype=torch.float64)
        zero, some = torch.cat([zero, place], 1), torch.cat([some, place], 1)
    if effect.name == "softening":  # a range has no zero
        zero[:, 1] = -5.0
    still, same, other = (
        m.position for m in simulate(twin, [scenario, effect(scenario, zero, twin), effect(scenario, some, twin)])
    )
    np.testing.assert_allclose(same, still, atol=1e-8)
    if effect.name != "adhesion":  # nothing lifts off
        assert np.abs(other - still).max() > 6e-8
