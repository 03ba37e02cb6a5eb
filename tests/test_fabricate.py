"""Known shapes to the printer: volumes and thicknesses in closed form, holes that are open, refusals that say why."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.port import AirPort
from torchsoro.output.fabricate import fabricate, surface
from torchsoro.output.part import Part

DENSITY = 1070.0
PORT = AirPort(direction=(-1.0, 0.0, 0.0), diameter=0.003)


def walker(n: int = 12, *, layers: int = 1, origin: tuple[float, float, float] = (0.07, 0.02, 0.0)) -> Domain:
    """A 36 mm cube with a central chamber, outer 18 mm, wall of so many lattice layers."""
    center = (origin[0] + 0.018, origin[1] + 0.018, origin[2] + 0.018)
    chamber = Chamber(name="air", center=center, size=(0.018, 0.018, 0.018), wall=layers * 0.036 / n)
    return Domain(size=(0.036, 0.036, 0.036), particles=(n, n, n), origin=origin, chambers=(chamber,))


def ball(domain: Domain, radius: float) -> torch.Tensor:
    """A smooth ball of material around the middle."""
    middle = torch.tensor(domain.origin, dtype=torch.float64) + 0.5 * torch.tensor(domain.size, dtype=torch.float64)
    distance = (domain.positions - middle).norm(dim=1)
    return (0.5 + (radius - distance) / domain.spacing).clamp(0, 1)


def is_closed(part: Part) -> bool:
    """Every edge has exactly two triangles, once in each direction: checked without trimesh's own flags."""
    edges = np.concatenate([part.mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    forward = {tuple(e) for e in edges.tolist()}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


@pytest.mark.parametrize("n", [12, *(pytest.param(n, marks=pytest.mark.slow) for n in (16, 24))])
def test_solid_cube_with_cavity(n: int) -> None:
    """Volume, mass, outer size and the wall (one lattice layer on no design material is tested below)."""
    layers = {12: 1, 16: 2, 24: 1}[n]
    domain = walker(n, layers=layers)
    part = fabricate(domain, torch.ones(domain.count), density=DENSITY)
    cavity = (18.0 - 2 * layers * 36 / n) ** 3
    # The twelve edges of each box are chamfered by half a voxel: less than 0.2 % of the volume.
    assert part.report.volume_mm3 == pytest.approx(36**3 - cavity, rel=2e-3)
    assert part.report.mass_g == pytest.approx(part.report.volume_mm3 * DENSITY * 1e-6, rel=1e-12)
    assert part.report.cavity_volume_mm3 == pytest.approx(cavity, rel=1e-12)
    assert part.report.size_mm == pytest.approx((36, 36, 36), abs=1e-4)
    np.testing.assert_allclose(part.mesh.bounds[0], 1e3 * np.array(domain.origin), atol=1e-4)
    wall = 9 + layers * 36 / n
    assert part.report.thinnest_wall_mm == pytest.approx(wall, abs=0.02 * part.report.voxel_mm)
    assert not part.report.port_open and part.report.euler_number == 4 and part.report.bodies == 1
    assert part.report.islands_removed == () and part.report.enclosed_voids == ()
    assert is_closed(part)


@pytest.mark.parametrize("n", [12, *(pytest.param(n, marks=pytest.mark.slow) for n in (16, 40))])
def test_wall_one_layer_thick_survives(n: int) -> None:
    """A bare chamber on one thick leg: the wall keeps its thickness of one spacing, coarse or fine."""
    h, outer = 0.036 / n, 2 * round(n / 4) * 0.036 / n
    chamber = Chamber(name="air", center=(0.018, 0.018, 0.018), size=(outer, outer, outer), wall=h)
    domain = Domain(size=(0.036, 0.036, 0.036), particles=(n, n, n), chambers=(chamber,))
    x = domain.positions - 0.018
    gamma = ((x[:, 2] < 0) & (x[:, :2].abs() < outer / 2).all(1)).double()
    part = fabricate(domain, gamma, density=DENSITY, port=PORT)
    assert part.report.thinnest_wall_mm == pytest.approx(1e3 * h, rel=0.02)
    assert part.report.port_open and part.report.manifold and part.report.bodies == 1


def test_air_port_opens_the_cavity_at_the_rear() -> None:
    """The volume of the hole, a ray along it that meets nothing, and the topology of a bottle."""
    domain = walker(16, layers=2)
    closed = fabricate(domain, np.ones(domain.count), density=DENSITY)
    part = fabricate(domain, np.ones(domain.count), density=DENSITY, port=PORT)
    hole = closed.report.volume_mm3 - part.report.volume_mm3
    assert hole == pytest.approx(math.pi / 4 * 3.0**2 * 13.5, rel=0.05)
    assert part.report.port_open and part.report.euler_number == 2 and is_closed(part)
    crossings = _crossings(part.mesh, origin=np.array([60.0, 38.01, 18.02]))
    # From the rear, the ray passes the port and the cavity, then only the front wall: two surfaces.
    np.testing.assert_allclose(crossings, [70 + 18 + 9 - 4.5, 70 + 36], atol=1e-6)


def _crossings(mesh: trimesh.Trimesh, origin: np.ndarray) -> np.ndarray:
    """Where a ray in +x meets the mesh, by brute force."""
    a, b, c = (mesh.triangles[:, i] for i in range(3))
    p = origin[1:]

    def side(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (v[:, 1] - u[:, 1]) * (p[1] - u[:, 2]) - (v[:, 2] - u[:, 2]) * (p[0] - u[:, 1])

    weights = np.stack([side(b, c), side(c, a), side(a, b)], axis=1)
    hit = (weights > 0).all(1) | (weights < 0).all(1)
    share = weights[hit] / weights[hit].sum(1, keepdims=True)
    x = (share * np.stack([a, b, c], axis=1)[hit][:, :, 0]).sum(1)
    return np.sort(x[x > origin[0]])


def test_offset_grows_the_outside_only() -> None:
    """Outer size and, in closed form (Steiner), the volume of a cube grown by a ball."""
    domain, d = walker(12), 0.4375
    before = fabricate(domain, np.ones(domain.count), density=DENSITY)
    part = fabricate(domain, np.ones(domain.count), density=DENSITY, offset=d * 1e-3)
    assert part.report.size_mm == pytest.approx((36 + 2 * d,) * 3, abs=1e-4)
    assert part.report.cavity_volume_mm3 == before.report.cavity_volume_mm3
    steiner = 36**3 + 6 * 36**2 * d + 3 * math.pi * 36 * d**2 + 4 / 3 * math.pi * d**3
    assert part.report.volume_mm3 == pytest.approx(steiner - 12.0**3, rel=2e-3)
    assert part.report.thinnest_wall_mm == pytest.approx(12 + d, abs=0.05)
    assert is_closed(part)


@pytest.mark.slow
def test_offset_of_a_ball() -> None:
    """A curved surface moves by the offset as well."""
    domain = Domain(size=(0.036,) * 3, particles=(18,) * 3)
    gamma = ball(domain, 0.012)
    radius = [
        (3 * fabricate(domain, gamma, density=DENSITY, offset=d).report.volume_mm3 / (4 * math.pi)) ** (1 / 3)
        for d in (0.0, 0.0015)
    ]
    assert radius[0] == pytest.approx(12.0, rel=0.01)
    assert radius[1] - radius[0] == pytest.approx(1.5, rel=0.02)


def test_island_is_removed_and_reported() -> None:
    """A piece in the corner goes, with its volume; the offset does not bring it back."""
    domain = walker(12)
    gamma = ball(domain, 0.0145)
    whole = fabricate(domain, gamma, density=DENSITY)
    with_island = gamma.reshape(12, 12, 12).clone()
    with_island[:3, :3, :3] = 1.0
    with_island[3, :4, :4] = with_island[:4, 3, :4] = with_island[:4, :4, 3] = 0.0
    part = fabricate(domain, with_island.flatten(), density=DENSITY)
    assert len(part.report.islands_removed) == 1
    assert part.report.islands_removed[0] == pytest.approx(9.0**3, rel=0.05)
    assert part.report.volume_mm3 == pytest.approx(whole.report.volume_mm3, rel=0.02)
    assert part.report.bodies == 1


@pytest.mark.slow
def test_closed_hollow_is_reported() -> None:
    """A hollow without an opening would trap resin."""
    domain = walker(12)
    gamma = torch.ones(12, 12, 12)
    gamma[1, 5:7, 5:7] = 0.0
    report = fabricate(domain, gamma.flatten(), density=DENSITY, port=PORT).report
    assert report.enclosed_voids == () and report.port_open  # the port runs through it
    gamma = torch.ones(12, 12, 12)
    gamma[5:7, 5:7, 10] = 0.0
    report = fabricate(domain, gamma.flatten(), density=DENSITY, port=PORT).report
    # The B-spline rounds the corners of a hollow of 2 x 2 x 1 particles, so it keeps part of its 108 mm3.
    assert len(report.enclosed_voids) == 1 and 40 < report.enclosed_voids[0] < 110


@pytest.mark.slow
def test_rough_fields_give_closed_surfaces() -> None:
    """Noise is the hardest input for an iso-surface: still one closed body."""
    domain = walker(12)
    for seed in range(4):
        gamma = np.random.default_rng(seed).uniform(0, 1, domain.count)
        part = fabricate(domain, gamma, density=DENSITY, port=PORT, offset=1e-4 * (seed % 2), refine=3)
        assert is_closed(part) and part.report.bodies == 1 and part.report.port_open


def test_save_and_load(tmp_path) -> None:
    """The file holds the same closed body, with units in its header, and no temporary file stays behind."""
    domain = walker(12)
    part = fabricate(domain, ball(domain, 0.016), density=DENSITY, port=PORT)
    for name in ("shape.stl", "shape.ply", "shape.obj"):
        loaded = trimesh.load_mesh(part.save(tmp_path / name))
        assert loaded.is_watertight and loaded.is_winding_consistent
        assert loaded.volume == pytest.approx(part.report.volume_mm3, rel=1e-5)
    assert b"units mm" in (tmp_path / "shape.stl").read_bytes()[:80]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["shape.obj", "shape.ply", "shape.stl"]
    assert "z up" in str(part.report) and part.report.as_dict()["units"] == "mm"
    with pytest.raises(ValueError, match="suffix"):
        part.save(tmp_path / "shape.step")
    with pytest.raises(ValueError, match="folder that exists"):
        part.save(tmp_path / "nowhere" / "shape.stl")


def test_surface_for_pictures() -> None:
    """The quick surface is closed, in metres, in place, and also there for the uniform start at gamma = 0.5."""
    domain = walker(12)
    for gamma in (torch.ones(domain.count), torch.full((domain.count,), 0.5, requires_grad=True)):
        vertices, faces = surface(domain, gamma)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.is_watertight and mesh.volume == pytest.approx(0.036**3, rel=5e-3)
        np.testing.assert_allclose(vertices.min(0), domain.origin, atol=1e-9)
    empty = Domain(size=(0.036,) * 3, particles=(12,) * 3)
    vertices, faces = surface(empty, torch.zeros(empty.count))
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


def two_chambers(*, connected: bool) -> tuple[Domain, torch.Tensor]:
    """Two chambers in a row along x."""
    chambers = tuple(
        Chamber(name=name, center=(x, 0.009, 0.009), size=(0.012, 0.012, 0.012), wall=0.003)
        for name, x in (("rear", 0.009), ("front", 0.027))
    )
    domain = Domain(size=(0.036, 0.018, 0.018), particles=(12, 6, 6), chambers=chambers)
    gamma = torch.ones(12, 6, 6)
    if not connected:
        gamma[5:7] = 0.0
    return domain, gamma.flatten()


def test_refusals() -> None:
    """Each bad argument is named, with what was seen."""
    domain = walker(12)
    full = torch.ones(domain.count)
    bad = full.clone()
    bad[3] = math.nan
    for arguments, words in [
        ({"gamma": full[:-1]}, "gamma: got shape"),
        ({"gamma": bad}, "gamma: got 1 numbers that are not finite"),
        ({"gamma": 2 * full}, "gamma: got 2 to 2"),
        ({"density": -1.0}, "density: got -1.0"),
        ({"density": math.nan}, "density"),
        ({"level": 1.0}, "level: got 1.0"),
        ({"offset": -1e-4}, "offset: got -0.0001"),
        ({"refine": 1}, "refine: got 1"),
        ({"minimum_thickness": 0.0}, "minimum_thickness: got 0.0"),
        ({"minimum_thickness": 0.02}, "want at least 0.02 m; an offset of 0.008"),
        ({"port": AirPort(diameter=0.02)}, "port.diameter: got 0.02"),
        ({"port": AirPort(diameter=1e-4)}, "port.diameter: got 0.0001"),
        ({"gamma": 0.1 * full}, "no connected body: of 0 design particles"),
    ]:
        given = {"gamma": full, "density": DENSITY} | arguments
        with pytest.raises(ValueError, match=words):
            fabricate(domain, given.pop("gamma"), **given)
    with pytest.raises(ValueError, match=r"direction: got \(1.0, 1.0, 0.0\)"):
        AirPort(direction=(1.0, 1.0, 0.0), diameter=0.003)
    with pytest.raises(ValueError, match="diameter: got -1"):
        AirPort(diameter=-1)


def test_refuses_pieces_apart_from_the_chamber() -> None:
    """Material that floats, chambers that nothing connects, a port through another chamber or without one."""
    domain = walker(12)
    floating = torch.zeros(12, 12, 12)
    floating[:2, :2, :2] = 1.0
    with pytest.raises(ValueError, match=r"of 8 design particles at or above level 0\.5 none is connected"):
        fabricate(domain, floating.flatten(), density=DENSITY)
    domain, gamma = two_chambers(connected=False)
    with pytest.raises(ValueError, match="chamber walls on 2 bodies"):
        fabricate(domain, gamma, density=DENSITY)
    domain, gamma = two_chambers(connected=True)
    with pytest.raises(ValueError, match="'front' runs into chamber 'rear'"):
        fabricate(domain, gamma, density=DENSITY, port=PORT)
    part = fabricate(domain, gamma, density=DENSITY, port=AirPort(direction=(0.0, 0.0, 1.0), diameter=0.003))
    assert part.report.port_open and part.report.euler_number == 2
    with pytest.raises(ValueError, match="port: got one for a domain without a chamber"):
        empty = Domain(size=(0.036,) * 3, particles=(6,) * 3)
        fabricate(empty, torch.ones(empty.count), density=DENSITY, port=PORT)
