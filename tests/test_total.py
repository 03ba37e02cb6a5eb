"""What is particular to the total-Lagrangian form: what it conserves, where it lands, chambers, gaps in the lattice."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from problems import DT, H, block, constant, momenta, simulator, vector
from torch import Tensor

from torchsoro import Body, Domain, Force, Gas, Plane, Prony, Solid, Spring, fill, ground
from torchsoro.simulation.ops.lattice import Lattice

FREE, G = (0.0, 0.0, 0.0), 9.81
CELL = 2 * H


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def total(**settings):
    return simulator(formulation="total", **settings)


def viscous(body: Body, eta: float) -> Body:
    """The body with a viscosity that takes a bounce out of it."""
    return replace(body, viscosity=torch.where(body.chamber < 0, eta, 0.0).to(body.mass))


# ---------------------------------------------------------------------------------------------------- what is conserved


def test_momentum_and_angular_momentum_are_conserved():
    # With all that is inside of a body: a pressurised chamber, Maxwell elements, viscosity, void.
    _, body = block((4, 4, 6), air=True)
    void_fraction = torch.rand(96, generator=torch.Generator().manual_seed(4)).double() * 0.5
    body = viscous(replace(body, velocity=0.3 * noise(96, 3), void_fraction=void_fraction), 1.0)
    finals = [
        total()(body, duration=k * DT, gravity=FREE, prony=Prony.paper(2), pressure=constant(500.0)).final
        for k in (1, 200)
    ]
    (p, L), (later_p, later_L) = (momenta(body, final, CELL) for final in finals)
    scale = float((body.mass * body.velocity.norm(dim=1)).sum())  # type: ignore[union-attr]
    reach = float(body.position.norm(dim=1).mean())
    assert float(p.norm()) > 1e-3 * scale
    assert float(L.norm()) > 1e-3 * scale * reach
    assert float((later_p - p).abs().max()) < 1e-13 * scale
    assert float((later_L - L).abs().max()) < 1e-13 * scale * reach
    # It does deform meanwhile.
    assert float((finals[1] - finals[0])[0, :100].std()) > 1e-6


def test_a_spinning_body_turns_as_a_whole():
    _, body = block((4, 4, 6))
    arms, rate = body.position - body.position.mean(0), 20.0
    spin = rate * torch.linalg.cross(vector(0.0, 0.0, 1.0).expand_as(arms), arms)
    steps = round(math.pi / rate / DT)
    run = total()(
        replace(body, velocity=spin), duration=steps * DT, gravity=FREE, prony=Prony.paper(3), probes=torch.arange(96)
    )
    angle = torch.tensor(rate * steps * DT)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]).double()
    assert float((run.position[-1] - body.position.mean(0) - arms @ turn.T).abs().max()) < 1e-3 * H


def strain_energy(body: Body, displacement: Tensor) -> Tensor:
    """Eqs. 6-7 at the points of quadrature [J]."""
    lattice = Lattice.around(body.position, CELL)
    F = lattice.gradient(displacement.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3).double()
    J = torch.linalg.det(F)
    trace = J ** (-2 / 3) * (F * F).sum((1, 2))
    energy = body.shear / 2 * (trace - 3) + body.bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2)
    return (body.volume * energy).sum()


def test_a_free_vibrating_block_keeps_its_energy():
    _, body = block((6, 6, 12))
    stretch = vector(-8.0, -8.0, 15.0).diag()
    body = replace(body, velocity=(body.position - body.position.mean(0)) @ stretch)
    lattice, sim = Lattice.around(body.position, CELL), total(dt=DT / 2)
    mass, found, final = lattice.nodal_mass(body.mass.unsqueeze(0))[0], [], None
    for _ in range(30):
        before = sim(body, duration=49 * DT / 2, gravity=FREE, start=final).final
        final = sim(body, duration=DT / 2, gravity=FREE, start=before).final
        # Of symplectic Euler, velocities are those of half a step before; so is the place in the middle.
        d = (before + final)[0, : 3 * lattice.nodes].view(3, -1) / 2
        v = final[0, 3 * lattice.nodes : 6 * lattice.nodes].view(3, -1)
        found.append(torch.stack([strain_energy(body, d), (mass * v * v).sum() / 2]))
    energy = torch.stack(found).sum(1)
    elastic = torch.stack(found)[:, 0] / energy
    assert float(elastic.min()) < 0.2
    assert float(elastic.max()) > 0.7
    print(f"energy over 1,500 steps: within {float((energy / energy.mean() - 1).abs().max()):.1e}")
    assert float((energy / energy.mean() - 1).abs().max()) < 1e-3


@pytest.mark.parametrize("axes", [(1, 0, 2), (2, 1, 0), (1, 2, 0)])
def test_a_run_in_another_frame_is_the_same_run(axes):
    # Everything turned by right angles: body, velocity, gravity and ground.
    turn = torch.eye(3).double()[list(axes)]
    turn[0] *= torch.linalg.det(turn)
    _, body = block((4, 6, 8), air=True)
    body = replace(body, velocity=0.1 * noise(192, 3))
    floor = turn @ vector(0.0, 0.0, 1.0)
    axis, side = int(floor.abs().argmax()), int(floor.sum())
    runs = [
        total()(
            replace(body, position=body.position @ R.T, velocity=body.velocity @ R.T),  # type: ignore[union-attr]
            duration=400 * DT,
            prony=Prony.paper(2),
            pressure=constant(1e3),
            gravity=R @ vector(1.0, 2.0, -9.0),
            planes=[plane],
            sample_every=100 * DT,
            probes=torch.arange(192),
        )
        for R, plane in (
            (torch.eye(3).double(), Plane(axis=2, offset=-0.4e-3, friction=0.4)),
            (turn, Plane(axis=axis, side=side, offset=-0.4e-3 * side, friction=0.4)),
        )
    ]
    torch.testing.assert_close(runs[1].position @ turn, runs[0].position, rtol=0, atol=1e-14)
    torch.testing.assert_close(runs[1].chamber_volume, runs[0].chamber_volume, rtol=1e-12, atol=0)
    assert float((runs[0].position[-1] - runs[0].position[0]).std()) > 1e-4


def test_an_affine_initial_velocity_is_that_of_the_particles():
    _, body = block((4, 6, 8), air=True)
    velocity = body.position @ noise(3, 3).T * 30 + noise(3, seed=1)
    run = total()(replace(body, velocity=velocity), duration=DT, gravity=FREE, probes=torch.arange(192))
    torch.testing.assert_close(run.velocity[0], velocity, rtol=0, atol=1e-13)
    torch.testing.assert_close(run.center_velocity[0], (body.mass @ velocity) / body.mass.sum(), rtol=0, atol=1e-13)


# -------------------------------------------------------------------------------------------------------------- contact


@pytest.mark.parametrize("height", [0.0, 0.31, 1.7, -2.5])
def test_a_block_comes_to_rest_on_the_ground_wherever_that_is(height):
    # In particle spacings; no grid needs to lie on the plane.
    _, body = block(origin=(0.0, 0.0, height * H + 1e-3))
    run = total()(
        viscous(body, 20.0),
        duration=2000 * DT,
        prony=Prony.paper(3),
        planes=[ground(height * H)],
        probes=torch.arange(64),
    )
    lowest = float(run.position[-1, :, 2].min()) - height * H - H / 2
    assert abs(lowest) < 2e-3 * CELL
    assert float(run.center_velocity[-1].norm()) < 1e-4


def test_the_rest_height_does_not_depend_on_the_drop_height_in_the_gradient():
    # A velocity that is cut where a node is found behind the plane leaves it there: then this is 1.
    _, body = block()
    lift = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    body = viscous(replace(body, position=body.position + lift * vector(0.0, 0.0, 1.0)), 20.0)
    run = total()(body, duration=3000 * DT, prony=Prony.paper(3), planes=[ground()], sample_every=300 * DT)
    (by,) = torch.autograd.grad(run.center_of_gravity[-1, 2], lift, retain_graph=True)
    (early,) = torch.autograd.grad(run.center_of_gravity[0, 2], lift)
    assert float(early) == pytest.approx(1.0)
    assert abs(float(by)) < 0.1


@pytest.mark.parametrize(("mu", "speed"), [(0.2, 0.1), (0.5, 0.2)])
def test_a_block_slides_as_far_as_coulomb_says(mu, speed):
    v = torch.tensor(speed, dtype=torch.float64, requires_grad=True)
    _, body = block()
    body = replace(viscous(body, 5.0), velocity=(v * vector(1.0, 0.0, 0.0)).expand(64, 3))
    steps = 10 * math.ceil(0.15 * speed / (mu * G) / DT)
    run = total()(
        body, duration=steps * DT, prony=Prony.paper(3), planes=[ground(friction=mu)], sample_every=steps * DT
    )
    slid = run.center_of_gravity[-1, 0] - run.center_of_gravity[0, 0]
    assert float(slid.detach()) == pytest.approx(speed**2 / (2 * mu * G), rel=0.03)
    (by,) = torch.autograd.grad(slid, v)
    assert float(by) == pytest.approx(speed / (mu * G), rel=0.03)


@pytest.mark.parametrize("room", [0.37e-3, 2.1e-3])
def test_two_walls_hold_a_block_between_them_at_any_distance(room):
    _, body = block(velocity=vector(0.05, 0.0, 0.2))
    walls = [ground(friction=0.2), Plane(axis=2, side=-1, offset=4 * H + room, friction=0.2)]
    run = total()(
        body,
        duration=2000 * DT,
        gravity=FREE,
        prony=Prony.paper(3),
        planes=walls,
        sample_every=5 * DT,
        probes=torch.arange(64),
    )
    z = run.position[..., 2]
    assert float(z.min()) > H / 2 - 0.1 * CELL
    assert float(z.max()) < 4 * H + room - H / 2 + 0.1 * CELL
    # It did fly from one to the other.
    center = run.center_of_gravity[:, 2] - 2 * H
    assert float(center.min()) < 0.01 * CELL
    assert float(center.max()) > room - 0.01 * CELL


@pytest.mark.parametrize("layers", [2, 4])
def test_a_body_does_not_stand_on_its_void(layers):
    domain = Domain(size=(4 * H, 4 * H, 8 * H), particles=(4, 4, 8))
    solid = domain.positions[:, 2] > layers * H
    body = fill(domain, solid.double(), solid=Solid(), void_range=(0.1, 0.3))
    run = total()(body, duration=3600 * DT, prony=Prony.paper(3), planes=[ground()], probes=solid.nonzero().squeeze(1))
    lowest = run.position[..., 2].amin(1)
    assert float(lowest[0]) == pytest.approx((layers + 0.5) * H)
    assert float(lowest[-1]) == pytest.approx(H / 2, abs=0.1 * CELL)


# ------------------------------------------------------------------------------------------------------------- chambers


def test_sealed_air_resists_by_its_stiffness():
    # Walls that yield by c to a pressure balance p = p_act - k c p.
    found = {}
    for stiffness in (0.0, 1e5, 1e6):
        _, body = block((8, 8, 8), air=True, gas=Gas(stiffness=stiffness))
        body = replace(body, drag=1000 * body.mass)
        run = total()(body, duration=800 * DT, gravity=FREE, pressure=constant(500.0), sample_every=200 * DT)
        growth = run.chamber_volume[:, 0] / body.volume[body.chamber == 0].sum() - 1
        torch.testing.assert_close(run.chamber_pressure[:, 0], 500 - stiffness * growth, rtol=1e-10, atol=1e-9)
        found[stiffness] = float(growth[-1])
    compliance = found[0.0] / 500
    for stiffness in (1e5, 1e6):
        assert found[stiffness] == pytest.approx(found[0.0] / (1 + stiffness * compliance), rel=0.01)


def test_a_chamber_presses_evenly_whatever_its_shape_in_the_body():
    # The forces of a pressure on a closed surface add up to none, and turn nothing.
    _, body = block((6, 6, 6), air=True)
    keep = torch.ones(216, dtype=torch.bool)
    keep[-5:] = False  # a corner is missing
    body = some(body, keep.nonzero().squeeze(1))
    swollen = total()(body, duration=200 * DT, gravity=FREE, pressure=constant(2e3)).final
    momentum, angular = momenta(body, swollen, CELL)
    scale = 2e3 * (4 * H) ** 2 * 200 * DT
    assert float(momentum.abs().max()) < 1e-14 * scale
    assert float(angular.abs().max()) < 1e-14 * scale * 6 * H


# -------------------------------------------------------------------------------------------------- gaps in the lattice


def some(body: Body, index: Tensor) -> Body:
    """Particles of a body, in the order given."""
    tensors = {name: value[index] for name, value in vars(body).items() if value is not None}
    return replace(body, **tensors)


def test_the_order_of_the_particles_does_not_matter():
    _, whole = block((4, 4, 6), air=True)
    whole = replace(whole, velocity=0.1 * noise(96, 3))
    index = torch.arange(96)[whole.position[:, 0] + whole.position[:, 2] < 8.1 * H]
    shuffled = index[torch.randperm(len(index), generator=torch.Generator().manual_seed(2))]
    found = []
    for order in (index, shuffled):
        body = some(whole, order)
        shear = body.shear.clone().requires_grad_()
        place = torch.empty(96, dtype=torch.int64)
        place[order] = torch.arange(len(order))
        run = total()(
            replace(body, shear=shear),
            duration=100 * DT,
            prony=Prony.paper(2),
            pressure=constant(500.0),
            planes=[ground(friction=0.3)],
            loads=[
                Force(particles=place[index[:5]], value=vector(1e-3, 2e-3, 0.0)),
                Spring(particles=place[index[-4:]], stiffness=2.0, shift=vector(0.0, 1e-3, 0.0)),
            ],
            probes=place[index],
            weight=body.volume,
        )
        (by,) = torch.autograd.grad(run.position[-1].square().sum() + run.center_of_gravity[-1].sum(), shear)
        found.append((run.position, run.center_of_gravity, run.chamber_volume, run.final, by[place[index]]))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-12, atol=1e-15)
    assert float(found[0][4].abs().max()) > 0


def test_a_body_with_gaps_falls_freely():
    _, whole = block((4, 4, 6))
    keep = noise(96, seed=5) > -0.5
    keep[[0, 95]] = True
    body = some(whole, keep.nonzero().squeeze(1))
    count = int(keep.sum())
    assert count < 80
    run = total()(body, duration=100 * DT, prony=Prony.paper(3), probes=torch.arange(count), sample_every=100 * DT)
    fall = -G * DT * DT * 100 * 101 / 2
    torch.testing.assert_close(run.position[-1], body.position + vector(0.0, 0.0, fall), rtol=0, atol=1e-13)


def test_bodies_of_a_batch_may_lie_apart():
    _, body = block()
    shift = torch.stack([vector(0.0, 0.0, 0.0), vector(1e-3, 2e-3, 0.7e-3)]).requires_grad_()
    both = replace(body, position=body.position + shift.unsqueeze(1))
    arguments = {"duration": 300 * DT, "prony": Prony.paper(2), "planes": [ground(friction=0.4)], "gravity": (1, 0, -9)}
    together = total()(both, **arguments)
    alone = total()(replace(body, position=both.position[1].detach()), **arguments)
    torch.testing.assert_close(together.center_of_gravity[1], alone.center_of_gravity, rtol=0, atol=1e-13)
    # What falls a way first ends elsewhere; along the ground a shift is a shift.
    (by,) = torch.autograd.grad(together.center_of_gravity[:, -1, :2].sum(), shift)
    torch.testing.assert_close(by[:, :2], torch.ones(2, 2).double(), rtol=0, atol=1e-9)
