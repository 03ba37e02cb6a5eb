"""Chambers whose place and size are designed: shares of the particles, bounds, gradients through rollouts, rounding."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from tiny import TINY, tiny

from torchsoro import Chamber, DesignField, Domain, Gas, Prony, Simulator, Solid, fill, ground, square_wave
from torchsoro.design.blending import fill_blended
from torchsoro.design.placement import DESIGNED, Placement
from torchsoro.design.robot import climber, turner, walker

H = 0.0025  # spacing, m


def body(*chambers: tuple[tuple[float, float, float], tuple[float, float, float]], wall: float = H) -> Domain:
    """Ten by eight by eight particles with chambers of these centres and edges, in spacings."""
    made = tuple(
        Chamber(
            name=str(k),
            center=tuple(H * c for c in center),  # pyright: ignore[reportArgumentType]
            size=tuple(H * s for s in size),  # pyright: ignore[reportArgumentType]
            wall=wall,
        )
        for k, (center, size) in enumerate(chambers)
    )
    return Domain(size=(10 * H, 8 * H, 8 * H), particles=(10, 8, 8), chambers=made)


ONE = body(((5, 4, 4), (6, 4, 4)))
TWO = body(((3, 4, 4), (4, 4, 4)), ((7, 4, 4), (4, 4, 6)))
PAIR = body(((5, 2, 4), (4, 4, 4)), ((5, 6, 4), (4, 4, 4)))


def moved(domain: Domain, seed: int, far: float = 0.6, **how) -> Placement:
    """A placement off the lattice planes, within its bounds: by at most so many spacings."""
    placement, generator = Placement(domain, **how), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for one in placement.designed():
            one.add_(far * H * (2 * torch.rand(one.shape, generator=generator, dtype=torch.float64) - 1))
    return placement.clamp_()


# Shares ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("domain", "axis"), [(ONE, "x"), (TWO, "x"), (PAIR, "y")], ids=["one", "two", "pair"])
@pytest.mark.parametrize("transition", [1e-6, 0.3, 0.99])
def test_on_lattice_planes_narrow_transitions_give_the_regions(domain, axis, transition):
    found = Placement(domain, axis=axis, transition=transition)()
    for name, region in (("air", domain.gas), ("wall", domain.wall), ("design", domain.design)):
        assert torch.equal(getattr(found, name), region.double()), name
    assert torch.equal(found.chamber, domain.chamber)


@pytest.mark.parametrize("wall", [H, 2 * H])
@pytest.mark.parametrize("seed", range(4))
def test_shares_sum_to_one_and_a_wall_lies_between_air_and_design(seed, wall):
    domain = body(((5, 4, 4), (8, 6, 6)), wall=wall)
    placement = moved(domain, seed, far=0.9)
    with torch.no_grad():
        found = placement()
    shares = torch.stack([found.air, found.wall, found.design])
    assert bool(((shares >= 0) & (shares <= 1)).all())
    torch.testing.assert_close(shares.sum(0), torch.ones(domain.count, dtype=torch.float64), rtol=0, atol=1e-15)
    assert not bool((found.air * found.design).any())
    assert torch.equal(found.chamber >= 0, found.air > 0)
    # On the way from the middle to each face of the body there is a wall of its thickness, to a fraction of a spacing.
    center = placement.boxes()[0].detach()
    middle = [round(float(c) / H - 0.5) for c in center[0]]
    for axis in range(3):
        at = [slice(None) if a == axis else middle[a] for a in range(3)]
        air, thick, design = (domain.lattice(one)[tuple(at)] for one in (found.air, found.wall, found.design))
        assert float(thick.sum()) * H == pytest.approx(2 * wall, abs=0.25 * H)
        first, last = (air > 0).nonzero()[[0, -1], 0].tolist()
        assert not bool(design[first : last + 1].any())
        assert float(thick[: first + 1].sum()) > 0.9 * wall / H - 0.25


def test_the_volume_is_that_of_the_cavities_and_nearly_that_of_the_shares():
    domain = body(((5, 4, 4), (8, 6, 6)))
    placement = moved(domain, 3)
    size = placement.size.detach()
    assert float(placement.volume().detach()) == pytest.approx(float((size - 2 * H).prod()), rel=1e-12)
    assert float(placement().air.detach().sum()) * H**3 == pytest.approx(float(placement.volume().detach()), rel=0.06)
    (gradient,) = torch.autograd.grad(placement.volume().sum(), placement.size)
    cavity = size[0] - 2 * H
    torch.testing.assert_close(gradient[0], cavity.prod() / cavity)


def test_the_filter_and_the_material_are_those_of_the_regions_where_shares_are_none_or_all():
    generator = torch.Generator().manual_seed(0)
    field = DesignField(ONE, radius=2.2 * H, symmetry=("y",), dtype=torch.float64)
    with torch.no_grad():
        field.phi.copy_(2 * torch.rand(ONE.shape, generator=generator, dtype=torch.float64) - 1)
    with torch.no_grad():
        found = Placement(ONE, transition=0.5)()
        gamma = field(shares=(found.design, found.wall))
        assert torch.equal(gamma, field())
    how = {"solid": Solid(), "gas": Gas(density=3.0, viscosity=0.0), "void_range": (0.1, 0.3)}
    one, other = fill_blended(ONE, gamma, found, **how), fill(ONE, gamma, **how)
    for name in ("position", "mass", "volume", "shear", "chamber", "drag"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-14, atol=0, msg=name)
    assert torch.equal(one.bulk[~ONE.gas], other.bulk[~ONE.gas])
    assert float(found.intermediate(gamma)) == pytest.approx(float((gamma * (1 - gamma))[ONE.design].mean()), rel=1e-12)
    simulator = Simulator(cell=ONE.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    pressure = square_wave(amplitude=2e4, frequency=100, rise=5e-4, fall=5e-4, end=2e-3)
    seen = [simulator(b, duration=5e-4, prony=Prony.paper(1), pressure=pressure) for b in (one, other)]
    torch.testing.assert_close(seen[0].final, seen[1].final, rtol=0, atol=1e-13)


# Gradients ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("domain", "fixed"), [(ONE, False), (ONE, True), (TWO, False)], ids=["one", "volume", "two"])
def test_gradients_of_a_motion_by_center_and_edges_are_the_central_differences(domain, fixed):
    placement = moved(domain, 1, far=0.4, fixed_volume=fixed)
    field = DesignField(domain, radius=2.2 * H, symmetry=(), dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        field.phi.copy_(0.8 * torch.rand(domain.shape, generator=generator, dtype=torch.float64) - 0.2)
    simulator = Simulator(cell=domain.cell, dt=1e-5, low=(-0.1,) * 3, high=(0.1,) * 3, formulation="total")
    pressure = square_wave(amplitude=2e4, frequency=100, rise=5e-4, fall=5e-4, end=2e-3)
    if len(domain.chambers) == 2:
        pressure = dataclasses.replace(pressure, pressure=torch.stack([pressure.pressure, 0.6 * pressure.pressure]))
    way = torch.rand(3, generator=generator, dtype=torch.float64)
    how = {"solid": Solid(), "gas": Gas(density=3.0), "void_range": (0.1, 0.3)}

    def judged() -> torch.Tensor:
        member = placement()
        gamma = field(shares=(member.design, member.wall))
        filled = fill_blended(domain, gamma, member, **how)
        seen = simulator(
            filled, duration=6e-4, prony=Prony.paper(2), pressure=pressure, planes=[ground(-1e-3, friction=0.3)]
        )
        travel = 1e4 * (seen.center_of_gravity[-1] - seen.center_of_gravity[0]) @ way
        swept = (seen.chamber_volume[-1] / seen.chamber_volume[0]).sum() + 1e-5 * seen.chamber_pressure[-1].sum()
        return travel + swept + member.intermediate(gamma) + 1e6 * placement.volume().sum()

    gradients = torch.autograd.grad(judged(), placement.designed())
    for one, gradient in zip(placement.designed(), gradients, strict=True):
        for k in range(one.numel()):
            found = []
            for step in (1e-4 * H, -1e-4 * H):
                with torch.no_grad():
                    one.view(-1)[k].add_(step)
                    found.append(float(judged().detach()))
                    one.view(-1)[k].sub_(step)
            difference = (found[0] - found[1]) / (2e-4 * H)
            assert float(gradient.view(-1)[k]) == pytest.approx(
                difference, rel=1e-6, abs=1e-6 * float(gradient.abs().max())
            )
    assert all(bool((gradient.abs() > 1e-3).all()) for gradient in gradients)


# Bounds ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("domain", "axis"), [(ONE, "x"), (TWO, "x"), (PAIR, "y")], ids=["one", "two", "pair"])
def test_however_far_a_step_goes_chambers_stay_in_the_body_and_apart(domain, axis, seed, fixed):
    placement = moved(domain, seed, far=8, symmetry=("y",), axis=axis, fixed_volume=fixed)
    center, size = (one.detach() for one in placement.boxes())
    slack = 1e-9 * H
    assert bool((size >= 3 * H - slack).all())
    assert bool((center - size / 2 >= -slack).all()) and bool((center + size / 2 <= placement.high + slack).all())
    a = "xyz".index(axis)
    assert bool(((center + size / 2)[:-1, a] <= (center - size / 2)[1:, a] + slack).all())
    mirrored = center.flip(0) if domain is PAIR else center
    torch.testing.assert_close(center[:, 1] + mirrored[:, 1], torch.full_like(center[:, 1], 8 * H), rtol=1e-14, atol=0)
    if fixed:
        assert float(placement.volume().detach().sum()) == pytest.approx(placement.volume_wanted, rel=1e-12)
    before = [one.detach().clone() for one in (placement.center, placement.size)]
    placement.clamp_()  # what is within the bounds stays
    for one, other in zip((placement.center, placement.size), before, strict=True):
        torch.testing.assert_close(one.detach(), other, rtol=0, atol=slack)
    # Rounded, they make a domain, symmetric as before.
    DesignField(dataclasses.replace(domain, chambers=placement.rounded()), radius=2 * H, symmetry=("y",))


def test_only_what_is_designed_moves_and_edges_keep_their_bounds():
    placed = moved(ONE, 0, far=3, designed=("place",))
    assert not torch.equal(placed.center[0], torch.tensor([5, 4, 4]) * H)
    assert torch.equal(placed.size[0], torch.tensor([6.0, 4.0, 4.0], dtype=torch.float64) * H)
    sized = moved(ONE, 0, far=9, designed=("size",), edges=(4 * H, 6.5 * H))
    assert bool(((sized.size >= 4 * H) & (sized.size <= 6.5 * H)).all())
    with torch.no_grad():
        sized.size.fill_(1.0)
    assert sized.clamp_().size.tolist() == [[6.5 * H] * 3]
    sized.blend_({"center": sized.center.detach(), "size": torch.full((1, 3), 4.5 * H)}, 0.5)
    assert sized.size.tolist()[0] == pytest.approx([5.5 * H] * 3)


def test_faces_are_rounded_to_the_nearest_planes_and_half_way_inward():
    placement = Placement(ONE)
    with torch.no_grad():
        placement.center.copy_(torch.tensor([[5.2, 4.0, 4.4]]) * H)
        placement.size.copy_(torch.tensor([[6.2, 5.0, 4.0]]) * H)
    (found,) = placement.rounded()
    assert [c / H for c in found.center] == pytest.approx([5.0, 4.0, 4.0])
    assert [s / H for s in found.size] == pytest.approx([6.0, 4.0, 4.0])


def test_rounding_keeps_a_volume_that_is_fixed_as_nearly_as_planes_allow():
    domain = body(((5, 4, 4), (6, 6, 6)))
    placement = Placement(domain, symmetry=("y",), fixed_volume=True)
    with torch.no_grad():
        placement.center[0, 0] = 4.9 * H
        placement.size.copy_(torch.tensor([[6.65, 5.75, 5.67]]) * H)
    placement.clamp_()
    (found,) = placement.rounded()
    assert [s / H for s in found.size] == pytest.approx([6.0, 6.0, 6.0])  # the nearest planes would be 7, 6, 6
    assert found.center[1] == pytest.approx(4 * H)
    pair = moved(PAIR, 4, far=1.5, symmetry=("y",), axis="y", fixed_volume=True)
    one, other = pair.rounded()
    assert one.size == pytest.approx(other.size) and one.center[1] + other.center[1] == pytest.approx(8 * H)


def test_what_a_placement_cannot_do_is_refused():
    with pytest.raises(ValueError, match=r"designed: got form, want some of place, size"):
        Placement(ONE, designed=("form",))
    with pytest.raises(ValueError, match=r"domain: got no chamber"):
        Placement(body())
    with pytest.raises(ValueError, match=r"transition: got 0.0 spacings"):
        Placement(ONE, transition=0.0)
    with pytest.raises(ValueError, match=r"edges: got \(0.006, None\) m, want at least two walls and 1 particle"):
        Placement(ONE, edges=(0.006, None))
    with pytest.raises(ValueError, match=r"edges: got \(None, 0.012\) m with chambers of \[\[0.015"):
        Placement(ONE, edges=(None, 0.012))
    with pytest.raises(ValueError, match=r"axis: got 'z', want one along which the chambers follow each other"):
        Placement(TWO, axis="z")
    with pytest.raises(ValueError, match=r"symmetry: got 'x', want chambers that are mirror images along it"):
        Placement(TWO, symmetry=("x",))


def test_a_least_cavity_is_kept_when_faces_are_rounded():
    h = ONE.spacing
    made = Placement(ONE, cavity=1.4 * h)
    with torch.no_grad():
        edge = 2 * ONE.chambers[0].wall + 1.4 * h  # 1.4 spacings of air, with one face on a plane
        made.size.fill_(edge)
        made.center.copy_(torch.tensor(ONE.origin) + 4 * h + edge / 2)
    assert all(edge - 2 * one.wall >= 1.4 * h for one in made.rounded() for edge in one.size)


def test_a_step_back_takes_back_centers_that_growing_chambers_have_pushed():
    made = Placement(TWO, designed=("size",), axis="x")
    before = {name: one.detach().clone() for name, one in made.named_parameters()}
    with torch.no_grad():
        made.size += 3 * TWO.spacing
    made.clamp_()
    assert not torch.equal(made.center, before["center"])
    made.blend_(before, 1.0)
    for name, one in made.named_parameters():
        torch.testing.assert_close(one.detach(), before[name], rtol=0, atol=1e-12)


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"feature": 0.004, "scenarios": 3}, r"chamber_design = \('place',\) with feature = 0.004: wanted one of them"),
        ({"body_mesh": "body.stl"}, r"with body_mesh = body.stl: wanted"),
        ({"chamber_mesh": "air.stl"}, r"with chamber_mesh = air.stl: wanted"),
        ({"chamber_mesh": "a.stl", "chamber_sizes": ((0.01,) * 3,)}, r"chamber_sizes = .* with chamber_mesh = a.stl"),
        ({"formulation": "updated"}, r"with formulation = 'updated': wanted 'total'"),
        ({"chamber_edges": (0.02, 0.016)}, r"edges: got \(0.02, 0.016\) m, want at least"),
        ({"chamber_centers": ((0.0,) * 3,) * 2}, r"chamber_centers = .*: wanted one for each of the 1 chambers"),
        ({"chamber_sizes": ((0.0,) * 3,)}, r"chamber_sizes\[0\]\[0\] = 0.0: wanted"),
    ],
)
def test_settings_that_do_not_fit_a_designed_chamber_are_refused(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        walker(tiny(tmp_path, chamber_design=("place",), **changes))


def test_an_air_port_fits_the_smallest_of_the_chambers(tmp_path):
    h = TINY.size[0] / TINY.particles[0]
    low = TINY.size[2] / 2
    centers = ((-1.5 * h, 0.0, low), (1.5 * h, 0.0, low + h / 2))
    sizes = ((3 * h, 4 * h, 4 * h), (3 * h, 4 * h, 3 * h))
    made = walker(tiny(tmp_path, chambers=2, chamber_centers=centers, chamber_sizes=sizes, wall=h))
    assert made.port.diameter == pytest.approx(0.4 * h)


def test_a_port_may_change_on_resume_only_where_it_changes_no_number(tmp_path):
    assert "port" in tiny(tmp_path).free
    assert "port" not in tiny(tmp_path, chamber_design=("size",)).free
    assert "port" not in tiny(tmp_path, feature=0.004, scenarios=3).free


def test_bounds_are_checked_before_any_work(tmp_path):
    with pytest.raises(ValueError, match=r"edges: got \(0.005, None\) m, want at least two walls"):
        walker(tiny(tmp_path, chamber_design=("size",), chamber_edges=(0.005, 0.0)))
    with pytest.raises(ValueError, match=r"leaves the body"):
        walker(tiny(tmp_path, chamber_design=("place",), chamber_centers=((0.0175, 0.0, 0.0175),)))


def test_given_centers_and_sizes_are_where_chambers_lie(tmp_path):
    h = 0.035 / 8
    robot = walker(tiny(tmp_path, chamber_centers=((h, 0.0, 4 * h),), chamber_sizes=((4 * h, 6 * h, 4 * h),)))
    (chamber,) = robot.domain.chambers
    assert chamber.center == (h, 0.0, 4 * h) and chamber.size == (4 * h, 6 * h, 4 * h)


def test_a_robot_whose_chambers_are_given_is_as_it_was(tmp_path):
    robot = walker(tiny(tmp_path))
    assert robot.placement is None and robot.rounded_domain is robot.domain
    gamma = robot.density()
    assert torch.equal(gamma, robot.field())
    s = robot.settings
    how = {"solid": robot.solid, "gas": robot.gas, "epsilon": s.epsilon, "power": s.power, "void_range": s.void_range}
    made, wanted = robot.filled(gamma), fill(robot.domain, gamma, **how)
    for part in dataclasses.fields(made):
        one, other = getattr(made, part.name), getattr(wanted, part.name)
        assert one is other is None or torch.equal(one, other), part.name
    assert made.air_share is None


@pytest.mark.parametrize("kind", [walker, climber, turner])
def test_designed_chambers_on_planes_move_each_robot_as_given_ones(kind, tmp_path):
    how = {"robot": kind.__name__, "upright": 1.0}
    if kind is turner:
        how |= {"chambers": 2, "chamber_axis": "y", "phases": (0.0, 0.25)}
    given, designed = (kind(tiny(tmp_path, chamber_design=d, **how)) for d in ((), DESIGNED))
    designed.placement.width = 0.5 * designed.domain.spacing
    with torch.no_grad():
        one, other = given(given.density()), designed(designed.density())
    for name in ("travel", "soles", "turn", "fall"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=1e-8)
    assert float(one.mass) == pytest.approx(float(other.mass), rel=1e-6)
    assert float(one.intermediate) == pytest.approx(float(other.intermediate), rel=1e-6)
    assert not math.isnan(float(one.travel))
