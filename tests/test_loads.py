"""Forces, point masses, springs and drag on groups of particles."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import DT, WAYS, H, block, momenta, simulator, ways
from torch import Tensor

from torchsoro import Drag, Force, PointMass, Prony, Spring
from torchsoro.simulation.loads import attach

MASS = 1070 * (4 * H) ** 3  # of the block, kg
EVERY = torch.arange(64)
FREE = (0.0, 0.0, 0.0)


def run(loads, *, steps=100, gravity=FREE, velocity=None, **settings):
    _, body = block(velocity=velocity)
    return simulator(**settings)(body, duration=steps * DT, gravity=gravity, loads=loads, sample_every=DT)


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


@ways("apic", "flip", "total")
def test_a_force_accelerates(way):
    push = vector(0.01, -0.02, 0.03)
    pushed = run([Force(particles=EVERY, value=push)], **way)
    torch.testing.assert_close(pushed.center_velocity, pushed.time.unsqueeze(1) * push / MASS, rtol=1e-9, atol=1e-12)


def test_a_force_over_time_may_stay_on_the_processor(cuda):
    force = Force(particles=EVERY, value=torch.stack([vector(0, 0, 0), vector(1, 2, 3)]), time=vector(0.0, 1.0))
    t = torch.linspace(0, 1, 5, dtype=torch.float64, device=cuda)
    torch.testing.assert_close(force.at(t), t.cpu()[:, None] * vector(1, 2, 3))


@ways("apic", "total")
def test_a_force_on_some_particles_moves_the_whole_by_its_impulse(way):
    pushed = run([Force(particles=torch.tensor([0, 5, 9]), value=vector(0.001, 0.0, 0.002))], **way)
    momentum, _ = momenta(block()[1], pushed.final, 2 * H)
    torch.testing.assert_close(momentum, 100 * DT * vector(0.001, 0.0, 0.002), rtol=1e-9, atol=1e-15)
    # What is recorded takes the body's mass to be at its particles, in the total-Lagrangian form a little beside.
    seen = MASS * pushed.center_velocity[-1]
    torch.testing.assert_close(seen, momentum, rtol=0, atol=2e-9 if way == WAYS["total"] else 1e-15)


@ways("apic", "total")
def test_a_force_over_time_is_interpolated(way):
    time, value = vector(0.0, 50 * DT, 100 * DT), torch.tensor([[0.0, 0, 0], [0, 0, 0.02], [0, 0, 0.02]]).double()
    pushed = run([Force(particles=EVERY, value=value, time=time)], **way)
    steps = torch.arange(100, dtype=torch.float64)
    impulse = (0.02 * (steps / 50).clamp(max=1)).cumsum(0) * DT
    torch.testing.assert_close(pushed.center_velocity[1:, 2], impulse / MASS, rtol=1e-6, atol=1e-12)


@ways("apic", "total")
def test_the_same_force_twice_is_twice_the_force(way):
    force = Force(particles=EVERY, value=vector(0.0, 0.0, 0.01))
    end = [run([force] * n, **way).center_velocity[-1, 2] for n in (1, 2)]
    assert float(end[1]) == pytest.approx(2 * float(end[0]), rel=1e-9)


def test_shares_weight_a_group():
    body = block()[1]
    share = torch.linspace(0, 1, 64, dtype=torch.float64)
    share = share / share.sum()
    mass = attach(body, [PointMass(particles=EVERY, mass=0.2, share=share)]).body.mass
    torch.testing.assert_close(mass - body.mass, 0.2 * share)
    both = torch.stack([share, share.flip(0)])
    springs = attach(body, [Spring(particles=EVERY, stiffness=torch.tensor([3.0, 5.0]), share=both)]).spring
    torch.testing.assert_close(springs, torch.tensor([[3.0], [5.0]], dtype=torch.float64) * both)


def test_kernels_deal_with_springs_only_where_there_are_any():
    dragged = replace(block()[1], drag=torch.full((64,), 0.1, dtype=torch.float64))
    spring, drag = Spring(particles=EVERY, stiffness=1.0), Drag(particles=EVERY, coefficient=0.1)
    for loads in ([], [drag], [spring]):
        found = attach(dragged, loads)
        assert found.drag is not None
        assert (found.spring is not None) == (found.anchor is not None) == (spring in loads)
    assert attach(block()[1], [spring]).drag is None


@ways("apic", "total", slow=["apic"])
def test_a_point_mass_has_inertia_and_weight(way):
    push, load = Force(particles=EVERY, value=vector(0.01, 0.0, 0.0)), PointMass(particles=EVERY, mass=3 * MASS)
    pushed = run([push, load], **way)
    assert float(pushed.center_velocity[-1, 0]) == pytest.approx(0.01 * 100 * DT / (4 * MASS), rel=1e-9)
    # Hung on a strong spring with drag, it settles where the spring carries all the weight.
    stiffness = 20.0
    spring = Spring(particles=EVERY, stiffness=stiffness)
    damp = Drag(particles=EVERY, coefficient=2 * math.sqrt(stiffness * 4 * MASS))
    hung = run([spring, damp, load], steps=3000, gravity=(0.0, 0.0, -9.81), **way)
    sag = float(hung.center_of_gravity[-1, 2]) - 2 * H
    assert sag == pytest.approx(-9.81 * 4 * MASS / stiffness, rel=1e-3)


@ways("apic", "flip", "total", slow=["flip"])
def test_a_spring_has_its_frequency(way):
    stiffness = 50.0
    shift = vector(0.0, 0.0, 1e-3)
    steps = 1200
    swing = run([Spring(particles=EVERY, stiffness=stiffness, shift=shift)], steps=steps, **way)
    z = swing.center_of_gravity[:, 2] - 2 * H - 1e-3
    omega = math.sqrt(stiffness / MASS)
    # Symplectic Euler is exact for a slightly shifted frequency; the amplitude stays.
    discrete = 2 / DT * math.asin(omega * DT / 2)
    assert discrete == pytest.approx(omega, rel=1e-3)
    phase = discrete * swing.time
    expected = -1e-3 * torch.cos(phase + discrete * DT / 2) / math.cos(discrete * DT / 2)
    assert omega * steps * DT > 4 * math.pi
    # Masses of the nodes of the total form are not in proportion to the springs, and the block vibrates a little.
    torch.testing.assert_close(z, expected, rtol=0, atol=1e-6 if way == WAYS["total"] else 2e-8)


@settings(max_examples=10)
@given(rate=st.floats(1.0, 500.0), g=st.floats(-10.0, 10.0), form=st.sampled_from(["apic", "total"]))
def test_drag_ends_in_a_terminal_speed(rate, g, form):
    drag = Drag(particles=EVERY, coefficient=rate * MASS)
    sinking = run([drag], gravity=(0.0, 0.0, g), **WAYS[form])
    k = torch.arange(101, dtype=torch.float64)
    # Explicit, and implicit.
    expected = g / rate * (1 - (1 / (1 + rate * DT) if form == "total" else 1 - rate * DT) ** k)
    torch.testing.assert_close(sinking.center_velocity[:, 2], expected, rtol=1e-9, atol=1e-12)


@ways("apic", "total")
def test_drag_reaches_its_terminal_speed(way):
    sinking = run([Drag(particles=EVERY, coefficient=2000 * MASS)], gravity=(0.0, 0.0, -9.81), steps=400, **way)
    assert float(sinking.center_velocity[-1, 2]) == pytest.approx(-9.81 / 2000, rel=1e-9)


@ways("apic", "total")
def test_loads_have_gradients_and_a_batch(way):
    value = torch.tensor([[0.0, 0.0, 0.01], [0.0, 0.0, 0.02]], dtype=torch.float64, requires_grad=True)
    mass = torch.tensor([0.0, MASS], dtype=torch.float64, requires_grad=True)
    pushed = run([Force(particles=EVERY, value=value), PointMass(particles=EVERY, mass=mass)], **way)
    assert pushed.center_velocity.shape == (2, 101, 3)
    end = pushed.center_velocity[:, -1, 2]
    total = MASS + mass.detach()
    torch.testing.assert_close(end, 100 * DT * value[:, 2] / total, rtol=1e-9, atol=0)
    by_value, by_mass = torch.autograd.grad(end.sum(), [value, mass])
    torch.testing.assert_close(by_value[:, 2], 100 * DT / total, rtol=1e-8, atol=0)
    torch.testing.assert_close(by_mass, -100 * DT * value.detach()[:, 2] / total**2, rtol=1e-8, atol=0)


@ways("apic", "total")
@pytest.mark.parametrize("name", ["stiffness", "shift", "coefficient", "position"])
def test_gradients_of_springs_and_drag_against_differences(name, way):
    group, other = torch.arange(8), torch.arange(30, 50)

    def travelled(x: Tensor) -> Tensor:
        _, body = block()
        number = {"stiffness": x, "shift": x, "coefficient": x}
        loads = [
            Spring(
                particles=group,
                stiffness=number["stiffness"] if name == "stiffness" else 3.0,
                shift=x if name == "shift" else vector(1e-3, 0.0, 2e-3),
            ),
            Spring(particles=other, stiffness=1.0, shift=vector(0.0, 1e-3, 0.0)),
            Drag(particles=other, coefficient=x if name == "coefficient" else 1e-3),
        ]
        if name == "position":
            body = replace(body, position=body.position + x)
        moved = simulator(**way)(body, duration=20 * DT, gravity=(0.0, 0.0, -1.0), loads=loads)
        return moved.center_of_gravity[-1].sum() * 1e3

    start = {"stiffness": vector(3.0)[0], "coefficient": vector(1e-3)[0], "shift": vector(1e-3, 2e-3, 3e-3)}
    x = start.get(name, vector(1e-4, 2e-4, 3e-4)).requires_grad_()
    (by,) = torch.autograd.grad(travelled(x), x)
    e = 1e-4 * x.detach()
    with torch.no_grad():
        slope = (travelled(x + e) - travelled(x - e)) / 2
    assert float((by * e).sum()) == pytest.approx(float(slope), rel=1e-5)


@ways("apic", "total")
@pytest.mark.parametrize("name", ["stiffness", "viscosity"])
def test_the_gradient_knows_of_what_is_not_there_yet(name, way):
    # A search for physics left out begins at zero.
    _, body = block()

    def travelled(x: Tensor) -> Tensor:
        loads = [Force(particles=torch.arange(8), value=vector(0.0, 0.0, 0.05))]
        if name == "stiffness":
            loads.append(Spring(particles=torch.arange(8), stiffness=x, shift=vector(1e-3, 0.0, 2e-3)))
        thick = replace(body, viscosity=x.expand_as(body.mass)) if name == "viscosity" else body
        moved = simulator(**way)(thick, duration=20 * DT, gravity=(0.0, 0.0, -1.0), loads=loads, probes=EVERY)
        return moved.velocity[-1, :8, 2].sum() + moved.position[-1].sum()

    x = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(travelled(x), x)
    e = torch.tensor(1e-5, dtype=torch.float64)
    with torch.no_grad():
        found = (4 * travelled(e) - travelled(2 * e) - 3 * travelled(0 * e)) / (2 * e)
    assert slope != 0
    assert float(slope) == pytest.approx(float(found), rel=1e-5)


@ways("apic", "total")
def test_a_tube_pulls_on_a_visco_elastic_body(way):
    # Everything at once, only to see that it runs and that what hangs on the body holds it back.
    _, body = block()
    group = torch.arange(4)
    loads = [
        Force(particles=EVERY, value=vector(0.002, 0.0, 0.0)),
        PointMass(particles=group, mass=MASS),
        Spring(particles=group, stiffness=0.5),
        Drag(particles=torch.arange(10, 20), coefficient=0.01),
    ]
    weight = torch.ones_like(body.mass)  # by default a point mass counts
    moved = [
        simulator(**way)(body, duration=500 * DT, prony=Prony.paper(3), gravity=FREE, loads=some, weight=weight)
        for some in (loads[:1], loads)
    ]
    free, held = (float(m.center_of_gravity[-1, 0] - m.center_of_gravity[0, 0]) for m in moved)
    assert 0 < held < 0.7 * free


@pytest.mark.parametrize(
    ("loads", "message"),
    [
        ([Force(particles=torch.tensor([], dtype=torch.int64), value=torch.zeros(3))], r"particles: an empty group"),
        ([Force(particles=torch.tensor([64]), value=torch.zeros(3))], r"particles: index 64 to 64, wanted 0 to 63"),
        ([PointMass(particles=torch.tensor([-1, 3]), mass=1.0)], r"particles: index -1 to 3, wanted 0 to 63"),
        ([Drag(particles=torch.tensor([0.5]), coefficient=1.0)], r"particles: torch\.float32, wanted int64"),
        ([Drag(particles=torch.ones(64) > 0, coefficient=1.0)], r"particles: torch\.bool, wanted int64"),
        ([PointMass(particles=EVERY, mass=-1.0)], r"mass = -1\.0: wanted finite and at least 0"),
        ([PointMass(particles=EVERY, mass=math.nan)], r"mass = nan: wanted finite and at least 0"),
        ([Drag(particles=EVERY, coefficient=-1.0)], r"drag coefficient = -1\.0: wanted finite and at least 0"),
        ([Spring(particles=EVERY, stiffness=-1.0)], r"stiffness = -1\.0: wanted finite and at least 0"),
        (
            [Spring(particles=EVERY, stiffness=1.0, shift=torch.zeros(2))],
            r"spring shift: shape \(2,\), wanted \[\.\.\., 3\]",
        ),
        ([Spring(particles=EVERY, stiffness=1.0, shift=vector(0, 0, math.nan))], r"spring shift = .*: wanted finite"),
        ([Spring(particles=EVERY, stiffness=1.0)] * 2, r"springs: two groups share a particle"),
        ([Force(particles=EVERY, value=torch.zeros(2))], r"force: shape \(2,\), wanted \[\.\.\., 3\]"),
        ([Force(particles=EVERY, value=vector(0, 0, math.inf))], r"force = .*: wanted finite"),
        ([PointMass(particles=EVERY, mass=1.0, share=torch.ones(64))], r"share: shape \(64,\), sums 64\.0, wanted"),
        (
            [Force(particles=EVERY, value=vector(0, 0, 1), share=torch.full((2, 64), 1 / 64))],
            r"share of a force: shape \(2,\) of a batch",
        ),
    ],
)
def test_bad_loads_are_refused(loads, message):
    _, body = block()
    with pytest.raises(ValueError, match="^" + message):
        attach(body, loads)
