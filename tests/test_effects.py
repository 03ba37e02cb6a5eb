"""Forms of effects against closed forms: air through an orifice, and the bend that a body is let go from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.sim2real.hypotheses.body_effects import LOSS, TUBE, HangingTether, LoadInertia, TautTether
from torchsoro.sim2real.hypotheses.outer_effects import InitialPose
from torchsoro.sim2real.hypotheses.supply_effects import OrificeLeak, PressureLag, ThrottledLoss
from torchsoro.sim2real.report.explanation import _limits
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.loads import Chain, Force


@pytest.fixture(scope="module")
def bar(made):
    """A twin and its scenario of the first trial."""
    twin, record = made
    return twin, twin.scenario(record(None).trials[0])


def supplied(bar, pressure):
    """A scenario whose supply is linear between pressures [S] Pa over its duration."""
    twin, scenario = bar
    time = torch.linspace(0.0, scenario.duration, len(pressure), dtype=torch.float64)
    return twin, scenario.replace(pressure=Waveform(time=time, pressure=torch.tensor(pressure, dtype=torch.float64)))


@given(share=st.floats(0.0, 0.9), pressure=st.floats(100.0, 1e5), sign=st.sampled_from((1.0, -1.0)))
def test_an_orifice_takes_its_share_of_the_highest_steady_pressure_and_less_of_a_lower_one(bar, share, pressure, sign):
    twin, scenario = supplied(bar, [sign * 0.25 * pressure, sign * pressure, sign * pressure])
    found = OrificeLeak()(scenario, torch.tensor([[share, 0.0]], dtype=torch.float64), twin).pressure.pressure[0, 0]
    assert float(found[-1]) == pytest.approx(sign * pressure * (1 - share), rel=1e-9)
    # q^2 + b q = 1/4 with b = a / sqrt(1 - a), q^2 being the pressure over the highest.
    b = share / np.sqrt(1 - share)
    q = (np.sqrt(b**2 + 1) - b) / 2
    assert float(found[0]) == pytest.approx(sign * pressure * q**2, rel=1e-9)
    assert q**2 / 0.25 <= 1 - share + 1e-12


@given(
    share=st.floats(0.0, 0.9),
    evenness=st.floats(-1.0, 1.0),
    part=st.floats(0.01, 1.0),
    sign=st.sampled_from((1.0, -1.0)),
)
def test_a_throttle_takes_its_share_of_the_highest_pressure_and_less_of_a_lower_one(bar, share, evenness, part, sign):
    highest = 1e4
    twin, scenario = supplied(bar, [sign * part * highest, sign * highest, 0.0])
    values = torch.tensor([[share, evenness], [0.0, evenness]], dtype=torch.float64)
    found = ThrottledLoss()(scenario, values, twin).pressure.pressure[:, 0]
    assert float(found[0, 1]) == pytest.approx(sign * highest * (1 - share), rel=1e-9)
    # What is missing beside an even share is what air that seeps away in proportion to p loses in the throttle.
    p, even = abs(float(found[0, 0])), share * (1 + evenness) / 2
    throttle = (share - even) / (1 - share) ** 2
    assert p + throttle * p**2 / highest == pytest.approx((1 - even) * part * highest, rel=1e-9)
    assert (1 - share) * (1 - 1e-12) <= p / (part * highest) <= (1 - even) * (1 + 1e-12)
    assert float(found[0, 2]) == 0.0
    assert torch.equal(found[1], scenario.pressure.pressure)


@pytest.mark.slow
@given(part=st.floats(0.05, 1.0), share=st.floats(0.05, 0.8))
def test_a_throttle_and_a_hole_are_the_same_in_a_trial_at_a_lower_pressure(bar, part, share):
    highest = 2e4
    twin, scenario = supplied(bar, [part * highest] * 3)
    twin = dataclasses.replace(twin, highest=highest)
    values = torch.tensor([[share, -1.0]], dtype=torch.float64)
    p = float(ThrottledLoss()(scenario, values, twin).pressure.pressure[0, 0, -1])
    assert p + share / (1 - share) ** 2 * p**2 / highest == pytest.approx(part * highest, rel=1e-9)
    assert p >= (1 - share) * part * highest * (1 - 1e-12)  # less is lost, and by a hole more
    values = torch.tensor([[share, 0.0]], dtype=torch.float64)
    p = float(OrificeLeak()(scenario, values, twin).pressure.pressure[0, 0, -1])
    assert p + share / np.sqrt(1 - share) * np.sqrt(highest * p) == pytest.approx(part * highest, rel=1e-9)
    assert p <= (1 - share) * part * highest * (1 + 1e-12)


def test_an_orifice_without_a_hole_is_a_lag(bar):
    twin, scenario = supplied(bar, [0.0, 1e4, 1e4, 1e4])
    values = torch.tensor([[0.0, 0.02]], dtype=torch.float64)
    leak, lag = OrificeLeak()(scenario, values, twin), PressureLag()(scenario, values[:, 1:], twin)
    # Implicit steps of half a millisecond are late by half of that: 1.25 % of the time constant.
    assert float((leak.pressure.pressure - lag.pressure.pressure).abs().max()) < 0.0125 * 1e4
    (simple,) = OrificeLeak().simpler(np.array([0.0, 0.02]))
    assert simple.name == "pressure_lag" and simple.values == [0.02] and not simple.ln_pressure


def test_a_bend_deflects_the_free_end_and_keeps_cross_sections_plane_and_normal(bar):
    twin, scenario = bar
    (axis, side), s = twin.faces[0], twin.setup
    first, second = (a for a in range(3) if a != axis)
    off = 1e-3
    moved = InitialPose()(scenario, torch.tensor([[off, 0.0]], dtype=torch.float64), twin).displacement[0]
    depth = twin.depth(twin.places, axis, side) / s.size[axis]
    held, free = depth == 0, depth == 1
    assert float(moved[held].abs().max()) == 0.0
    assert moved[free, first].numpy() == pytest.approx(off)
    assert float(moved[:, second].abs().max()) == 0.0
    # At the end of a cantilever under a force, w' = 3 w / (2 L): sections turn towards the clamp on the inside.
    arm = twin.places[free, first] - s.center[first]
    assert moved[free, axis].numpy() == pytest.approx((side * arm * 1.5 * off / s.size[axis]).numpy(), abs=1e-15)


def test_only_a_body_that_is_clamped_at_one_face_is_let_go_from_a_bend(made):
    twin, record = made
    setup = record(None).setup
    scenario = twin.scenario(record(None).trials[0])
    assert InitialPose().applies(scenario, twin)
    free = Twin(dataclasses.replace(setup, clamps=()), edge=twin.edge)
    assert not InitialPose().applies(scenario, free)


def test_a_taut_tube_pulls_each_variation_at_its_own_place(bar):
    twin, scenario = bar
    places = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]) * torch.tensor(twin.setup.size)
    places = places.double() + torch.tensor(twin.setup.origin, dtype=torch.float64)
    pulls = torch.tensor([[0.0, 0.03, 0.04], [0.02, 0.0, 0.0], [0.0, 0.0, -0.01]], dtype=torch.float64)
    forces = TautTether()(scenario, torch.cat([pulls, places], -1), twin).loads
    assert len(forces) == 2  # two places
    on_nodes = sum(f.value[:, None] * f.share[:, None] for f in forces)
    assert torch.allclose(on_nodes.sum(1), pulls, rtol=1e-12, atol=0)
    shares = on_nodes.norm(dim=-1) / pulls.norm(dim=-1)[:, None]
    assert torch.allclose(shares[0], shares[2]) and not torch.allclose(shares[0], shares[1])
    assert TautTether().reported(np.array([0.0, 0.03, 0.04]), scenario, twin)["pull_n"] == (pytest.approx(0.05), "N")


def test_a_load_turns_into_a_mass_beside_a_taut_tube(bar):
    twin, scenario = bar
    assert not LoadInertia().applies(scenario, twin)
    weight = Force(share=torch.eye(twin.nodes, dtype=torch.float64)[0], value=0.1 * scenario.gravity)
    pulled = TautTether()(scenario.plus(weight), torch.tensor([[0.01, 0.02, 0.0, 0.0, 0.0, 0.0]] * 2).double(), twin)
    assert LoadInertia().applies(pulled, twin)
    values = torch.tensor([[0.25], [1.0]], dtype=torch.float64)
    left, pull, mass = LoadInertia()(pulled, values, twin).loads
    assert pull is pulled.loads[1]
    assert torch.allclose(left.value, 0.1 * scenario.gravity * (1 - values))
    assert torch.allclose(mass.mass, 0.1 * values[:, 0])


@pytest.mark.parametrize("effect", [ThrottledLoss(), OrificeLeak()])
def test_a_share_of_the_pressure_that_is_lost_lies_between_nothing_and_all_of_it(effect, bar):
    twin, scenario = supplied(bar, [0.0, 1e4])
    assert _limits(effect, "fraction", scenario, twin) == (0.0, 1.0)


def test_a_tube_between_level_ends_hangs_half_its_weight_on_the_body_and_a_taut_one_is_as_stiff_as_it_is(bar):
    twin, scenario = bar
    down = scenario.gravity.reshape(-1, 3)[0]
    level = np.cross(down.numpy() / down.norm().item(), [1.0, 0.3, 0.2])
    level *= 0.08 / np.linalg.norm(level)
    tether = HangingTether()
    slack = tether.reported(np.array([0.005, *level, 0.1, 0.0]), scenario, twin)
    assert slack["mass_kg"][0] == pytest.approx(0.0025, rel=1e-4)
    assert slack["tube_length_m"][0] == pytest.approx(0.088)
    taut = tether.reported(np.array([0.005, *level, -0.2, 1.0]), scenario, twin)
    assert taut["stiffness_n_m"][0] == pytest.approx(0.005 * TUBE * np.e, rel=0.01)
    values = torch.tensor([[0.005, *level, 0.1, 1.0, *twin.setup.origin]], dtype=torch.float64)
    (chain,) = [load for load in tether(scenario, values, twin).loads if isinstance(load, Chain)]
    assert float(chain.length) == pytest.approx(0.088)
    assert float(chain.stiffness) == pytest.approx(0.005 * TUBE * np.e)
    assert float(chain.damping) == LOSS


def test_tubes_are_thought_of_on_all_sides_and_places_of_the_body(made):
    twin, _ = made
    u = np.random.default_rng(3).uniform(size=(2000, 9))
    points = HangingTether().spread(twin, u)
    scales = np.array([q.scale for q in HangingTether().quantities])
    mass, support = points[:, 0] * scales[0], points[:, 1:4] * scales[1:4]
    own = twin.setup.density * float(twin.volumes.sum())
    assert 0.005 * own <= mass.min() < 0.006 * own
    assert 0.28 * own < mass.max() <= 0.3 * own
    span = np.linalg.norm(support, axis=1)
    assert 0.04 <= span.min() < span.max() <= 0.12
    np.testing.assert_allclose((support / span[:, None]).mean(0), 0, atol=0.05)
    place = points[:, 6:] * np.array(twin.setup.size) / 10
    low, high = np.array(twin.setup.origin), np.array(twin.setup.origin) + np.array(twin.setup.size)
    assert bool(((place >= low - 1e-12) & (place <= high + 1e-12)).all())
