"""Planes: what they hold, what slides, what is torn off."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from problems import DT, WAYS, H, block, simulator, ways

from torchsoro import Plane, Prony, ground
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.ops.lattice import Lattice

G = 9.81


def run(*, gravity, planes, duration=0.05, velocity=None, particles=(4, 4, 4), **settings):
    _, body = block(particles, velocity=velocity)
    return body, simulator(**settings)(
        body, duration=duration, prony=Prony.paper(3), gravity=gravity, planes=planes, sample_every=duration / 10
    )


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


@ways("apic", "flip", "total", slow=["apic"])
def test_the_ground_holds_a_block(way):
    _, rest = run(gravity=(0.0, 0.0, -G), planes=[ground()], **way)
    sag = rest.center_of_gravity[..., 2] - rest.center_of_gravity[0, 2]
    # Under its own weight a 10 mm block of 0.44 MPa sags by a few micrometres.
    assert -2e-5 < float(sag.min()) < -1e-7
    assert float(rest.center_of_gravity[:, :2].sub(2 * H).abs().max()) < 1e-12


@ways("apic", "total")
def test_stick_holds_on_a_slope(way):
    _, stuck = run(gravity=(3.0, 0.0, -5.0), planes=[ground()], **way)
    assert float(stuck.center_of_gravity[-1, 0] - 2 * H) < 2e-5
    # Without friction it slides freely.
    _, free = run(gravity=(3.0, 0.0, -5.0), planes=[ground(friction=0.0)], **way)
    assert float(free.center_velocity[-1, 0]) == pytest.approx(3.0 * 0.05, rel=1e-9)


@ways("apic", "total")
@pytest.mark.parametrize("mu", [0.2, 0.5])
def test_a_coulomb_block_decelerates_by_mu(mu, way):
    _, sliding = run(gravity=(1.0, 0.0, -G), planes=[ground(friction=mu)], velocity=vector(1.0, 0.0, 0.0), **way)
    # Friction is mu times the normal impulse, which also accounts for what the block bounces.
    t = sliding.time
    expected = 1.0 + t * 1.0 - mu * (G * t + sliding.center_velocity[:, 2])
    torch.testing.assert_close(sliding.center_velocity[:, 0], expected, rtol=0, atol=2e-3)
    assert float(sliding.center_velocity[-1, 0]) == pytest.approx(1.0 + 0.05 * (1.0 - mu * G), abs=5e-3)


@ways("apic", "total")
def test_coulomb_friction_holds_below_its_angle(way):
    _, held = run(gravity=(0.3 * G, 0.0, -G), planes=[ground(friction=0.6)], **way)
    assert abs(float(held.center_of_gravity[-1, 0] - 2 * H)) < 2e-5
    _, sliding = run(gravity=(0.3 * G, 0.0, -G), planes=[ground(friction=0.1)], **way)
    assert float(sliding.center_velocity[-1, 0]) == pytest.approx(0.2 * G * 0.05, rel=0.05)


@ways("apic", "total")
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [1, -1])
def test_every_axis_and_side_stops_a_block(axis, side, way):
    gravity = [0.0, 0.0, 0.0]
    gravity[axis] = -side * G
    offset = 0.0 if side == 1 else 4 * H
    _, rest = run(gravity=gravity, planes=[Plane(axis=axis, side=side, offset=offset)], **way)
    assert float((rest.center_of_gravity - 2 * H).abs().max()) < 2e-5


@ways("apic", "total")
def test_the_grid_is_laid_on_the_plane(way):
    # A plane between the nodes of a grid that starts at zero holds as well as one on a node, and in the same way.
    shift = 0.37e-3
    _, body = block()
    _, moved = block(origin=(0.0, 0.0, shift))
    prony = Prony.paper(3)
    runs = [
        simulator(**way)(b, duration=0.01, prony=prony, planes=[ground(height=z)])
        for b, z in ((body, 0.0), (moved, shift))
    ]
    down = [r.center_of_gravity[:, 2] for r in runs]
    torch.testing.assert_close(down[1] - shift, down[0], rtol=0, atol=1e-12)


def hanging(adhesion, friction="stick", **way):
    """How far a block hung from a ceiling has come down after 50 ms."""
    ceiling = Plane(axis=2, side=-1, offset=4 * H, adhesion=adhesion, friction=friction)
    _, hung = run(gravity=(0.0, 0.0, -G), planes=[ceiling], **way)
    return float(2 * H - hung.center_of_gravity[-1, 2])


@ways("apic", "total")
@pytest.mark.parametrize("friction", ["stick", 0.5])
def test_adhesion_holds_up_to_its_traction(friction, way):
    # The suddenly loaded block pulls with up to twice its weight over its area, about 100 Pa.
    weight = 1070 * G * 4 * H
    fall = G * 0.05**2 / 2
    assert hanging(4 * weight, friction, **way) < 5e-5
    # A node of the updated form's grid holds with the area of a whole cell, also at the rim of a small block.
    assert hanging(0.02 * weight, friction, **way) > 0.5 * fall
    assert hanging(0.0, friction, **way) == pytest.approx(fall, rel=2e-3)


@ways("apic", "total")
def test_adhesion_resists_a_pull_that_just_exceeds_it(way):
    # Nodes of a grid hold with the area of a cell each, sixteen of them; those of the body with its area, of four.
    share = 4 if way == WAYS["total"] else 1
    falls = [hanging(share * traction, **way) for traction in (0.0, 20.0, 40.0, 1000.0)]
    assert falls == sorted(falls, reverse=True)
    # In the total-Lagrangian form it reaches a thousandth of a cell, else to the next layer of nodes.
    factor = 1.015 if way == WAYS["total"] else 1.05
    assert falls[0] > factor * falls[1] > factor**2 * falls[2] > falls[3]


@ways("apic", "total", slow=["apic"])
def test_tensor_planes_have_a_batch_and_gradients(way):
    mu = torch.tensor([0.2, 0.4], dtype=torch.float64, requires_grad=True)
    _, sliding = run(
        gravity=(0.0, 0.0, -G), planes=[ground(friction=mu)], velocity=vector(1.0, 0.0, 0.0), duration=0.01, **way
    )
    assert sliding.center_velocity.shape == (2, 11, 3)
    end = sliding.center_velocity[:, -1]
    (by,) = torch.autograd.grad(end[:, 0].sum(), mu)
    torch.testing.assert_close(by, -(G * 0.01 + end[:, 2]).detach(), rtol=0.02, atol=0)


@ways("apic", "total")
def test_shifting_ground_and_body_together_changes_nothing(way):
    # The gradient by the ground's height is that of shifting the grid: with the body's it adds up to a rigid shift.
    z = torch.zeros((), dtype=torch.float64, requires_grad=True)
    _, body = block()
    x = body.position + z * vector(0.0, 0.0, 1.0)
    end = simulator(**way)(
        replace(body, position=x), duration=200 * DT, prony=Prony.paper(3), planes=[ground(height=z)]
    ).center_of_gravity[-1, 2]
    (by,) = torch.autograd.grad(end, z)
    assert float(by) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("landing", ["inelastic", "elastic"])
def test_a_plane_with_the_normal_of_an_axis_is_the_plane_of_that_axis(landing):
    _, body = block(velocity=vector(0.5, 0.2, -0.5))
    given = {"offset": -2e-4, "friction": 0.3, "adhesion": 20.0, "landing": landing}
    planes = Plane(axis=2, **given), Plane(normal=(0, 0, 3.0), **given)
    ends = [
        simulator(formulation="total")(body, duration=100 * DT, gravity=(0.0, 0.0, -G), planes=[plane]).final
        for plane in planes
    ]
    torch.testing.assert_close(*ends, rtol=1e-9, atol=1e-12)


def test_a_block_slides_down_an_oblique_plane_with_the_gravity_along_it():
    # A body of the same lattice on a plane of slope 0.2: what is not held by friction accelerates it.
    slope, mu = 0.2, 0.1
    n = vector(-slope, 0.0, 1.0) / math.sqrt(1 + slope**2)
    down = vector(1.0, 0.0, slope) / math.sqrt(1 + slope**2)
    _, body = block((12, 12, 4))
    plane = Plane.through((0.0, 0.0, 0.0), normal=n, friction=mu)
    # Rotated gravity keeps the block, whose face is not parallel to the plane, from tipping before it lies on it.
    run = simulator(formulation="total")(
        body, duration=0.08, gravity=tuple((-G * n - 3.0 * down).tolist()), planes=[plane], prony=Prony.paper(3),
        sample_every=0.02,
    )  # fmt: skip
    along, off = run.center_velocity @ down, run.center_velocity @ n
    # Friction is mu times the normal impulse, which also accounts for what the block bounces.
    expected = -3.0 * run.time + mu * (G * run.time + off)
    torch.testing.assert_close(along, expected, rtol=0, atol=0.01)
    assert float(along[-1]) < -0.1


@pytest.mark.parametrize("friction", [0.0, "stick"])
def test_a_bouncing_cube_of_6_cells_keeps_99_5_percent_of_its_energy_at_its_first_blow_if_elastic(friction):
    lost = {landing: energy_lost(6, landing, friction) for landing in ("inelastic", "elastic")}
    print({landing: f"{100 * share:.2f} %" for landing, share in lost.items()})
    assert abs(lost["elastic"]) < 0.005
    assert lost["inelastic"] > 0.02


def energy_lost(cells, landing, friction):
    """Share of the energy of an elastic cube of ``cells`` across that its first blow on the ground takes."""
    _, body = block((2 * cells,) * 3, origin=(0.0, 0.0, 0.2 * H), velocity=vector(0.0, 0.0, -0.5))
    sim = simulator(formulation="total", dt=1e-4)
    rule = {"gravity": (0.0, 0.0, 0.0), "planes": [ground(friction=friction, landing=landing)]}
    lattice = Lattice.around(body.position, 2 * H)
    mass, nodes = lattice.nodal_mass(body.mass.unsqueeze(0))[0], lattice.nodes
    # Until it is off the ground, then the mean over ten substeps.
    before, found = sim(body, duration=60 * cells * 1e-4, **rule).final, []
    for _ in range(10):
        after = sim(body, duration=1e-4, start=before, **rule).final
        # Of symplectic Euler, velocities are those of half a step before; so is the place in the middle.
        d, v = (before + after)[0, : 3 * nodes].view(3, -1) / 2, after[0, 3 * nodes : 6 * nodes].view(3, -1)
        F = lattice.gradient(d.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3).double()
        J = torch.linalg.det(F)
        elastic = body.shear / 2 * (J ** (-2 / 3) * (F * F).sum((1, 2)) - 3)
        elastic = elastic + body.bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2)
        found.append(float((body.volume * elastic).sum() + (mass * v * v).sum() / 2))
        before = after
    return 1 - sum(found) / 10 / float(body.mass.sum() * 0.5**2 / 2)


def test_adhesion_pulls_a_block_from_within_its_reach_only():
    _, body = block(origin=(0.0, 0.0, 1e-3))
    found = []
    for reach in (0.9e-3, 1.1e-3):
        plane = Plane(axis=2, adhesion=50.0, reach=reach)
        run = simulator(formulation="total")(body, duration=4 * DT, gravity=(0.0, 0.0, 0.0), planes=[plane])
        found.append(-float(run.center_velocity[-1, 2]))
    assert abs(found[0]) < 1e-15
    force = 50.0 * (4 * H) ** 2
    assert found[1] == pytest.approx(force * 4 * DT / float(body.mass.sum()), rel=1e-6)


def test_a_normal_has_a_gradient():
    def run(slope):
        _, body = block(velocity=vector(0.0, 0.0, -0.4))
        normal = torch.stack([slope, torch.zeros_like(slope), torch.ones_like(slope)])
        plane = Plane.through((0.0, 0.0, -3e-4), normal=normal, friction=0.3)
        return simulator(formulation="total")(
            body, duration=60 * DT, gravity=(0.0, 0.0, -G), planes=[plane], prony=Prony.paper(1)
        ).center_of_gravity[-1] @ vector(1.0, 0.3, 0.2)

    slope = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    (by,) = torch.autograd.grad(run(slope), slope)
    with torch.no_grad():
        difference = (run(slope + 1e-7) - run(slope - 1e-7)) / 2e-7
    assert float(by) == pytest.approx(float(difference), rel=1e-5)


def test_a_block_slides_by_the_stribeck_curve_and_holds_below_its_static_friction():
    def slide(start, pull):
        floor = ground(friction=0.2, static_friction=0.6, stribeck_speed=0.2)
        gravity = (pull * G, 0.0, -G)
        return run(gravity=gravity, planes=[floor], velocity=vector(start, 0.0, 0.0), formulation="total")[1]

    sliding = slide(0.5, 0.0)
    v, dt, vz = 0.5, 1e-5, sliding.center_velocity[:, 2]
    found = [v]
    for _ in range(10):  # the law itself, of a point; in the mean the plane bears the weight
        for _ in range(500):
            v -= dt * G * (0.2 + 0.4 / (1 + (v / 0.2) ** 2))
        found.append(v)
    assert float(vz.abs().max()) < 2e-3
    torch.testing.assert_close(sliding.center_velocity[:, 0], vector(*found), rtol=0, atol=4e-3)
    assert abs(float(slide(0.0, 0.4).center_of_gravity[-1, 0] - 2 * H)) < 2e-5  # between both coefficients: at rest
    assert float(slide(0.5, 0.4).center_velocity[-1, 0]) > 0.5  # and on the move


@pytest.mark.parametrize("lanes", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_static_friction_and_stribeck_speed_have_gradients(lanes):
    def end(numbers):
        _, body = block(velocity=vector(0.1, 0.05, -0.2))
        plane = Plane(axis=2, friction=numbers[0], static_friction=numbers[1], stribeck_speed=numbers[2])
        return simulator(formulation=Total(lanes=lanes))(
            body, duration=60 * DT, gravity=(0.0, 0.0, -G), planes=[plane], prony=Prony.paper(1)
        ).center_of_gravity[-1] @ vector(1.0, 0.3, 0.2)

    numbers = vector(0.2, 0.5, 0.08).requires_grad_()
    (by,) = torch.autograd.grad(end(numbers), numbers)
    assert bool((by != 0).all())
    for k in range(3):
        move = 1e-6 * torch.eye(3, dtype=torch.float64)[k]
        with torch.no_grad():
            difference = (end(numbers + move) - end(numbers - move)) / 2e-6
        assert float(by[k]) == pytest.approx(float(difference), rel=1e-5)


@ways("apic", "flip")
@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"normal": (1.0, 0.0, 1.0)}, "normal"),
        ({"axis": 2, "landing": "elastic"}, "landing"),
        ({"axis": 2, "reach": 1e-3}, "reach"),
        ({"axis": 2, "friction": 0.2, "static_friction": 0.3}, "static_friction"),
    ],
)
def test_the_updated_form_refuses_planes_that_it_has_not(settings, name, way):
    with pytest.raises(ValueError, match=rf"^planes: plane 0 has {name} = .*, which the updated formulation has not"):
        run(gravity=(0.0, 0.0, -G), planes=[Plane(**settings)], **way)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"axis": 3}, r"axis = 3: wanted 0 \(x\), 1 \(y\) or 2 \(z\), or a normal"),
        ({"axis": None}, r"axis = None: wanted 0"),
        ({"normal": (0.0, 0.0, 1.0)}, r"axis = 2, side = 1: wanted neither beside a normal"),
        ({"axis": None, "normal": (0.0, 0.0, 0.0)}, r"normal = .*: wanted \[..., 3\], finite and not zero"),
        ({"axis": None, "normal": (0.0, 1.0)}, r"normal = .*: wanted \[..., 3\]"),
        ({"landing": "bouncy"}, r"landing = 'bouncy': wanted 'inelastic' or 'elastic'"),
        ({"reach": -1.0}, r"reach = -1\.0: wanted finite and at least 0"),
        ({"reach": torch.tensor(1e-3, requires_grad=True)}, r"reach: requires a gradient"),
        ({"axis": "z"}, r"axis = 'z': wanted 0"),
        ({"side": 0}, r"side = 0: wanted \+1 or -1"),
        ({"friction": "glue"}, r"friction = 'glue': wanted 'stick' or a coefficient of at least 0"),
        ({"friction": -0.1}, r"friction = -0\.1: wanted finite and at least 0"),
        ({"friction": math.nan}, r"friction = nan: wanted finite and at least 0"),
        ({"friction": torch.tensor([0.1, -0.1])}, r"friction = .*: wanted finite and at least 0"),
        ({"static_friction": 0.3}, r"static_friction = 0\.3: of a plane that sticks, wanted a coefficient"),
        (
            {"friction": 0.3, "static_friction": 0.2},
            r"static_friction = 0\.2: wanted finite and at least friction = 0\.3",
        ),
        ({"friction": 0.3, "stribeck_speed": 0.0}, r"stribeck_speed = 0\.0: wanted finite and positive, in m/s"),
        ({"adhesion": -1.0}, r"adhesion = -1\.0: wanted finite and at least 0"),
        ({"adhesion": math.inf}, r"adhesion = inf: wanted finite and at least 0"),
        ({"offset": math.nan}, r"offset = nan: wanted finite"),
    ],
)
def test_bad_planes_are_refused(settings, message):
    with pytest.raises(ValueError, match="^" + message):
        Plane(**{"axis": 2, **settings})
