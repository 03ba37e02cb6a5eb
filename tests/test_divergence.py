"""Runs that go wrong: at which step and particle, in which way, and what helps."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from problems import DT, WAYS, H, block, simulator, vector, ways
from torch import Tensor

from torchsoro import Body, Force, Prony, SimulationDiverged

FREE = (0.0, 0.0, 0.0)
COUNT = 64


@pytest.mark.parametrize("differentiable", [False, True])
@ways("apic", "total")
def test_leaving_the_box_is_reported_at_its_step(differentiable, way):
    velocity = vector(0.0, 3.0, 0.0)
    _, body = block(velocity=velocity)
    if differentiable:
        body = replace(body, mass=body.mass.clone().requires_grad_())
    sim = simulator(reach=0.05, **way)
    # The first particle that leaves, or whose nodes would leave: at 4 H - H / 2, after so many steps.
    edge = 0.05 if way == WAYS["total"] else 0.05 - sim.cell
    steps = math.floor((edge - 3.5 * H) / (3.0 * DT)) + 1
    with pytest.raises(SimulationDiverged) as told:
        sim(body, duration=1000 * DT, gravity=FREE, sample_every=10 * DT)
    error = told.value
    # The total-Lagrangian form looks now and then, at least at every sample.
    late = error.step - steps
    assert 0 <= late < (10 if way == WAYS["total"] else 1)
    assert error.time == pytest.approx(error.step * DT)
    assert error.particle is not None
    assert float(body.position[error.particle, 1]) == pytest.approx(3.5 * H)
    assert error.quantity.startswith("about to leave the analysis box")
    assert "larger analysis box" in error.remedy
    assert str(error).startswith(f"step {error.step} (t = ")
    # What was running before goes on running.
    assert len(sim(body, duration=10 * DT, gravity=FREE).time) == 11


@ways("apic", "total")
def test_leaving_names_the_simulation_of_a_batch(way):
    _, body = block()
    velocity = torch.zeros(3, COUNT, 3).double()
    velocity[1, :, 0] = -3.0
    with pytest.raises(SimulationDiverged, match=r"of simulation 1: about to leave") as told:
        simulator(**way)(replace(body, velocity=velocity), duration=2000 * DT, gravity=FREE)
    assert told.value.batch == 1


@pytest.mark.parametrize("air", [False, True])
@pytest.mark.parametrize("segment", [None, 3])
@ways("apic", "total")
def test_collapse_is_reported(air, segment, way):
    _, body = block((4, 4, 4), air=air)
    # A field of converging velocity that turns every particle inside out in one step.
    rate = 2.0 / DT
    center = body.position.mean(0)
    body = replace(body, velocity=-rate * (body.position - center), mass=body.mass.clone().requires_grad_())
    with pytest.raises(SimulationDiverged, match=r"the volume ratio is not positive \(J = -?\d") as told:
        simulator(segment=segment, **way)(body, duration=20 * DT, gravity=FREE)
    assert told.value.step == 1
    assert told.value.particle is not None
    assert "smaller time step" in told.value.remedy


@ways("apic", "total")
def test_a_number_that_is_not_finite_is_reported(way):
    _, body = block(dtype=torch.float32)
    push = Force(particles=torch.tensor([7]), value=torch.tensor([0.0, 0.0, 1e38]))
    with pytest.raises(SimulationDiverged, match=r"the state is not finite") as told:
        simulator(**way)(body, duration=20 * DT, gravity=FREE, loads=[push])
    assert told.value.step == 1
    assert told.value.particle is not None


@ways("apic", "total")
def test_a_later_segment_counts_from_the_start_of_the_run(way):
    velocity = vector(0.0, 3.0, 0.0)
    _, body = block(velocity=velocity)
    body = replace(body, mass=body.mass.clone().requires_grad_())
    found = []
    for segment in (None, 35):
        with pytest.raises(SimulationDiverged) as told:
            simulator(reach=0.05, segment=segment, **way)(body, duration=1050 * DT, gravity=FREE, sample_every=35 * DT)
        found.append((told.value.step, told.value.particle))
    assert found[0] == found[1]
    assert found[0][0] > 35


@pytest.mark.parametrize("segment", [None, 3])
def test_a_chamber_that_is_turned_inside_out_is_reported_but_void_is_not(segment):
    _, body = block((4, 4, 4), air=True)
    body = replace(body, velocity=-2.0 / DT * (body.position - body.position.mean(0)))
    void = replace(body, void_fraction=torch.ones_like(body.mass), mass=body.mass.clone().requires_grad_())
    sim = simulator(segment=segment, formulation="total")
    with pytest.raises(SimulationDiverged, match=r"the chamber is tangled inside \(J = -1\)") as told:
        sim(void, duration=20 * DT, gravity=FREE)
    assert told.value.step == 1
    assert told.value.particle is not None
    assert int(body.chamber[told.value.particle]) == 0
    assert "a larger fictitious shear modulus in the chamber" in told.value.remedy
    void = replace(void, chamber=torch.full_like(void.chamber, -1))
    run = sim(void, duration=20 * DT, gravity=FREE, sample_every=DT, probes=torch.arange(COUNT))
    torch.testing.assert_close(run.position[1] + run.position[0], 2 * run.center_of_gravity[0].expand(COUNT, 3))
    (by_mass,) = torch.autograd.grad(run.position.square().sum(), void.mass)
    assert bool(torch.isfinite(by_mass).all())
    assert bool(by_mass.any())


def test_what_is_partly_void_may_be_turned_inside_out_but_a_solid_may_not():
    _, body = block()
    body = replace(body, velocity=-0.3 / DT * (body.position - body.position.mean(0)))
    grey = replace(body, void_fraction=torch.full_like(body.mass, 0.3))
    weight = torch.rand(21, COUNT, 3, generator=torch.Generator().manual_seed(1)).double()
    change = body.mass * torch.rand(COUNT, generator=torch.Generator().manual_seed(2)).double()

    def run(body: Body) -> Tensor:
        settings = {"duration": 20 * DT, "gravity": FREE, "prony": Prony.paper(1), "sample_every": DT}
        return simulator(formulation="total")(body, probes=torch.arange(COUNT), **settings).position

    for void_fraction in (None, torch.zeros_like(body.mass)):
        with pytest.raises(SimulationDiverged, match=r"the volume ratio is not positive \(J = -"):
            run(replace(body, void_fraction=void_fraction))
    mass = body.mass.clone().requires_grad_()
    position = run(replace(grey, mass=mass))
    corner = (position[:, 0] - position.mean(1)) @ (body.position[0] - body.position.mean(0))
    assert bool((corner < 0).any())  # on the other side: all of the body was inside out
    (by_mass,) = torch.autograd.grad((weight * position).sum(), mass)
    with torch.no_grad():
        ends = [(weight * run(replace(grey, mass=body.mass + e * change))).sum() for e in (1e-5, -1e-5)]
    torch.testing.assert_close(by_mass @ change, (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=0)
