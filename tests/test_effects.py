"""Forms of effects against closed forms: air through an orifice, and the bend that a body is let go from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.sim2real.hypotheses.outer_effects import InitialPose
from torchsoro.sim2real.hypotheses.supply_effects import OrificeLeak, PressureLag
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform


def supplied(made, pressure):
    """A scenario whose supply is linear between pressures [S] Pa over its duration."""
    twin, record = made
    scenario = twin.scenario(record(None).trials[0])
    time = torch.linspace(0.0, scenario.duration, len(pressure), dtype=torch.float64)
    return twin, scenario.replace(pressure=Waveform(time=time, pressure=torch.tensor(pressure, dtype=torch.float64)))


@given(share=st.floats(0.0, 0.9), pressure=st.floats(100.0, 1e5), sign=st.sampled_from((1.0, -1.0)))
def test_an_orifice_takes_its_share_of_the_highest_steady_pressure_and_less_of_a_lower_one(made, share, pressure, sign):
    twin, scenario = supplied(made, [sign * 0.25 * pressure, sign * pressure, sign * pressure])
    found = OrificeLeak()(scenario, torch.tensor([[share, 0.0]], dtype=torch.float64), twin).pressure.pressure[0, 0]
    assert float(found[-1]) == pytest.approx(sign * pressure * (1 - share), rel=1e-9)
    # q^2 + b q = 1/4 with b = a / sqrt(1 - a), q^2 being the pressure over the highest.
    b = share / np.sqrt(1 - share)
    q = (np.sqrt(b**2 + 1) - b) / 2
    assert float(found[0]) == pytest.approx(sign * pressure * q**2, rel=1e-9)
    assert q**2 / 0.25 <= 1 - share + 1e-12


def test_an_orifice_without_a_hole_is_a_lag(made):
    twin, scenario = supplied(made, [0.0, 1e4, 1e4, 1e4])
    values = torch.tensor([[0.0, 0.02]], dtype=torch.float64)
    leak, lag = OrificeLeak()(scenario, values, twin), PressureLag()(scenario, values[:, 1:], twin)
    # Implicit steps of half a millisecond are late by half of that: 1.25 % of the time constant.
    assert float((leak.pressure.pressure - lag.pressure.pressure).abs().max()) < 0.0125 * 1e4
    (simple,) = OrificeLeak().simpler(np.array([0.0, 0.02]))
    assert simple.name == "pressure_lag" and simple.values == [0.02] and not simple.ln_pressure


def test_a_bend_deflects_the_free_end_and_keeps_cross_sections_plane_and_normal(made):
    twin, record = made
    scenario = twin.scenario(record(None).trials[0])
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
