"""The lattice, its regions, and everything that must not fit on it."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoro.design.domain import Chamber, Domain, Region

torch.set_num_threads(1)

H = 0.001  # spacing of the small domains, m


def box(particles, *, chambers=(), origin=(0.0, 0.0, 0.0)):
    """A domain of 1 mm spacing."""
    return Domain(size=tuple(n * H for n in particles), particles=particles, chambers=chambers, origin=origin)


def air(center, size, *, wall=1, name="air", origin=(0.0, 0.0, 0.0)):
    """A chamber given in spacings from the lower corner of the body."""
    return Chamber(
        name=name,
        center=tuple(o + c * H for o, c in zip(origin, center, strict=True)),
        size=tuple(s * H for s in size),
        wall=wall * H,
    )


def paper(height, layers):
    chamber = Chamber(name="air", center=(0.0175, 0.0175, height / 2), size=(0.0175, 0.0175, 0.0175), wall=0.00175)
    return Domain(size=(0.035, 0.035, height), particles=(40, 40, layers), chambers=(chamber,))


@pytest.mark.parametrize(("height", "layers", "designed"), [(0.035, 40, 56_000), (0.0455, 52, 75_200)])
def test_the_papers_robots_have_its_particle_counts(height, layers, designed):
    domain = paper(height, layers)
    assert domain.count == 40 * 40 * layers
    assert (int(domain.gas.sum()), int(domain.wall.sum()), int(domain.design.sum())) == (4096, 3904, designed)
    assert domain.cell == pytest.approx(1.75e-3, rel=1e-12)
    # "The air mass in the chamber was one-tenth that of the chamber wall."
    assert 100.0 * 4096 / (1070.0 * 3904) == pytest.approx(0.098, abs=5e-4)


@settings(max_examples=25, deadline=None)
@given(
    particles=st.tuples(*[st.integers(1, 6)] * 3),
    origin=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)
def test_positions_are_cell_centred_and_numbered_with_z_fastest(particles, origin):
    domain = box(particles, origin=origin)
    nx, ny, nz = particles
    for ix, iy, iz in [(0, 0, 0), (nx - 1, ny // 2, nz - 1), (nx // 2, ny - 1, 0)]:
        expected = torch.tensor(
            [o + (i + 0.5) * H for o, i in zip(origin, (ix, iy, iz), strict=True)], dtype=torch.float64
        )
        torch.testing.assert_close(domain.positions[(ix * ny + iy) * nz + iz], expected, rtol=0, atol=1e-12)
    centre = torch.tensor(origin, dtype=torch.float64) + 0.5 * torch.tensor(domain.size, dtype=torch.float64)
    torch.testing.assert_close(domain.positions.mean(dim=0), centre, rtol=0, atol=1e-12)
    assert domain.volume * domain.count == pytest.approx(nx * ny * nz * H**3, rel=1e-9)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_every_particle_is_in_the_region_that_its_position_says(data):
    particles = data.draw(st.tuples(*[st.integers(4, 9)] * 3))
    origin = data.draw(st.tuples(*[st.floats(-0.1, 0.1)] * 3))
    wall = data.draw(st.integers(1, 1 + (min(particles) > 6)))
    low = [data.draw(st.integers(0, n - 2 * wall - 1)) for n in particles]
    high = [data.draw(st.integers(a + 2 * wall + 1, n)) for a, n in zip(low, particles, strict=True)]
    center = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    size = [b - a for a, b in zip(low, high, strict=True)]
    chamber = air(center, size, wall=wall, origin=origin)
    domain = box(particles, chambers=(chamber,), origin=origin)

    away = (domain.positions - torch.tensor(chamber.center, dtype=torch.float64)).abs()
    half = 0.5 * torch.tensor(chamber.size, dtype=torch.float64)
    shell = (away < half).all(dim=1)
    cavity = (away < half - chamber.wall).all(dim=1)
    assert torch.equal(domain.gas, cavity)
    assert torch.equal(domain.wall, shell & ~cavity)
    assert torch.equal(domain.design, ~shell)
    assert torch.equal(domain.chamber, torch.where(cavity, 0, -1).to(torch.int32))
    assert torch.equal(domain.region == int(Region.GAS), cavity)


def test_two_chambers_are_told_apart_and_may_touch():
    left = air((2, 2, 2), (4, 4, 4), name="left")
    right = air((6, 2, 2), (4, 4, 4), name="right")
    domain = box((8, 4, 4), chambers=(left, right))
    chamber = domain.lattice(domain.chamber)
    assert (chamber[1:3, 1:3, 1:3] == 0).all()
    assert (chamber[5:7, 1:3, 1:3] == 1).all()
    assert int((chamber >= 0).sum()) == 16
    assert not domain.design.any()


def test_lattice_inverts_the_numbering_and_keeps_leading_axes():
    domain = box((2, 3, 4))
    values = torch.arange(2 * 24).reshape(2, 24)
    volume = domain.lattice(values)
    assert volume.shape == (2, 2, 3, 4)
    assert volume[1, 1, 2, 3] == values[1, (1 * 3 + 2) * 4 + 3]
    assert torch.equal(volume.flatten(-3), values)
    with pytest.raises(ValueError, match=r"values: got shape \(2, 23\), want \[..., 24\]"):
        domain.lattice(values[:, :23])


@settings(max_examples=25, deadline=None)
@given(points=st.lists(st.tuples(*[st.floats(-0.002, 0.006)] * 3), min_size=1, max_size=5), seed=st.integers(0, 99))
def test_nearest_is_nearest(points, seed):
    domain = box((3, 4, 2))
    among = torch.rand(domain.count, generator=torch.Generator().manual_seed(seed)) < 0.5
    among[seed % domain.count] = True
    wanted = torch.tensor(points, dtype=torch.float64)
    distance = (wanted[:, None] - domain.positions).norm(dim=-1)
    for mask in (None, among):
        found = domain.nearest(wanted, mask)
        allowed = distance if mask is None else distance.masked_fill(~mask, torch.inf)
        assert mask is None or mask[found].all()
        torch.testing.assert_close(
            distance.gather(1, found[:, None])[:, 0], allowed.min(dim=1).values, rtol=1e-6, atol=1e-9
        )


def test_nearest_breaks_ties_by_order_whatever_the_last_bit():
    domain = box((2, 2, 2))
    for shift in (-1e-16, 0.0, 1e-16):
        assert domain.nearest(torch.full((1, 3), H + shift, dtype=torch.float64)).tolist() == [0]


def test_nearest_refuses_what_it_cannot_answer():
    domain = box((2, 2, 2))
    with pytest.raises(ValueError, match=r"points: .*\(3,\), want a floating-point tensor \[P, 3\]"):
        domain.nearest(torch.zeros(3))
    with pytest.raises(ValueError, match=r"points: .*int64"):
        domain.nearest(torch.zeros(1, 3, dtype=torch.int64))
    with pytest.raises(ValueError, match="points: got a position that is not finite"):
        domain.nearest(torch.full((1, 3), torch.nan))
    with pytest.raises(ValueError, match="among: got no particle"):
        domain.nearest(torch.zeros(1, 3), torch.zeros(8, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"among: got torch.bool \(7,\), want a bool tensor \[8\]"):
        domain.nearest(torch.zeros(1, 3), torch.ones(7, dtype=torch.bool))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": (0.004, 0.004, 0.0)}, r"size: got .*, want three finite lengths > 0"),
        ({"size": (0.004, float("nan"), 0.004)}, "size: got .*nan"),
        ({"size": (0.004, 0.004)}, "size: got"),
        ({"size": ("a", 1.0, 1.0)}, "size: got"),
        ({"origin": (0.0, 0.0, float("inf"))}, "origin: got .*inf"),
        ({"particles": (4, 4, 0)}, "particles: got .*0.*want three whole numbers >= 1"),
        ({"particles": (4, 4, 4.0)}, "particles: got"),
        ({"particles": (4, 4)}, "particles: got"),
        ({"particles": (4, 4, 5)}, r"particles: got \(4, 4, 5\).*0.0008.*want the same spacing"),
        ({"chambers": ("air",)}, "chambers: got 'air', want Chamber"),
    ],
)
def test_bad_bodies_are_refused(changes, message):
    good = {"size": (0.004, 0.004, 0.004), "particles": (4, 4, 4)}
    Domain(**good)
    with pytest.raises(ValueError, match=message):
        Domain(**(good | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wall": 0.0}, r"'air': wall: got 0.0 m: a chamber without wall"),
        ({"wall": -1.0}, "a chamber without wall"),
        ({"wall": float("nan")}, "a chamber without wall"),
        ({"wall": 0.002}, "room for air"),
        ({"size": (0.004, -0.004, 0.004)}, "'air': size: got"),
        ({"center": (0.0, 0.0, float("inf"))}, "'air': center: got"),
        ({"name": ""}, "name: got ''"),
    ],
)
def test_bad_chambers_are_refused(changes, message):
    good = {"name": "air", "center": (0.003, 0.003, 0.003), "size": (0.004, 0.004, 0.004), "wall": 0.001}
    Chamber(**good)
    with pytest.raises(ValueError, match=message):
        Chamber(**(good | changes))


@pytest.mark.parametrize(
    ("chambers", "message"),
    [
        ([air((1, 3, 3), (4, 4, 4))], r"'air' with center .* leaves the body, want it inside"),
        ([air((3, 3, 5), (4, 4, 4))], "leaves the body"),
        ([air((3.5, 3, 3), (4, 4, 4))], r"outer face at x = 0.0015 m, 1.5 spacings.*want a whole number"),
        ([air((3, 3, 3), (4, 4, 4), wall=1.2)], "wall face at x"),
        ([air((3, 3, 3), (4, 4, 4), wall=1e-7)], "want at least one spacing"),
        ([air((3, 3, 3), (4, 4, 4), wall=2 - 1e-7)], "want at least one layer of air"),
        ([air((3, 3, 3), (4, 4, 4), name="a"), air((3, 3, 3), (6, 6, 6), name="b")], "'a' overlapping 'b'"),
        ([air((1.5, 3, 3), (3, 4, 4)), air((4.5, 3, 3), (3, 4, 4))], "two named 'air'"),
    ],
)
def test_chambers_that_do_not_fit_are_refused(chambers, message):
    with pytest.raises(ValueError, match=message):
        box((6, 6, 6), chambers=chambers)


def test_settings_are_frozen_and_comparable():
    domain = box((4, 4, 4), chambers=[air((2, 2, 2), (4, 4, 4))])
    assert domain == box((4, 4, 4), chambers=(air((2, 2, 2), (4, 4, 4)),))
    assert hash(domain) == hash(dataclasses.replace(domain))
    assert domain.positions is domain.positions
    with pytest.raises(dataclasses.FrozenInstanceError):
        domain.size = (1.0, 1.0, 1.0)
