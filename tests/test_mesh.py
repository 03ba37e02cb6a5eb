"""Bodies and chambers from files of triangles and tetrahedra: volumes in closed form, the print, and refusals."""

from __future__ import annotations

import math
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch
import trimesh
from tiny import tiny

from torchsoro.design.density import fill
from torchsoro.design.domain import Chamber, Domain, Region
from torchsoro.design.field import DesignField
from torchsoro.design.mesh import UNITS, read_surface
from torchsoro.design.port import AirPort
from torchsoro.design.robot import walker
from torchsoro.output.fabricate import fabricate
from torchsoro.output.printable import print_part
from torchsoro.simulation.material import Solid

SIDE, RADIUS, BODY = 0.04, 0.008, 0.018  # m
MIDDLE = np.full(3, SIDE / 2)


def sphere(radius: float) -> trimesh.Trimesh:
    """A ball in the middle of the domain, in mm."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1e3 * radius)
    ball.apply_translation(1e3 * MIDDLE)
    return ball


def saved(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def domain(
    path: Path, n: int = 24, *, unit: str = "mm", wall: float = 2 * SIDE / 24, body: Path | None = None
) -> Domain:
    chamber = Chamber(name="air", shape=read_surface(path, UNITS[unit]), wall=wall)
    return Domain(
        size=(SIDE,) * 3,
        particles=(n,) * 3,
        chambers=(chamber,),
        body=None if body is None else read_surface(body, UNITS[unit]),
    )


@pytest.mark.parametrize("n", [16, 24, 40])
def test_volume_of_a_spherical_cavity_within_a_tenth_of_a_spacing_of_its_radius(tmp_path, n):
    made = domain(saved(sphere(RADIUS), tmp_path / "ball.stl"), n, wall=0.003)
    radius = (3 * float(made.gas.sum()) * made.volume / (4 * math.pi)) ** (1 / 3)
    assert radius == pytest.approx(RADIUS, abs=0.1 * made.spacing)
    distance = (made.positions - torch.from_numpy(MIDDLE)).norm(dim=1)
    assert bool((distance[made.gas] < RADIUS * 1.001).all())
    wall = distance[made.wall]
    assert wall.min() > RADIUS * 0.99 and bool(made.wall[(distance > RADIUS) & (distance < RADIUS + 0.003)].all())
    assert wall.max() < RADIUS + 0.003 + 2 * made.spacing
    assert made.chamber.unique().tolist() == [-1, 0]


@pytest.mark.parametrize("kind", ["triangle", "tetra"])
def test_a_mesh_of_gmsh_gives_the_same_cavity_as_the_stl(tmp_path, kind):
    ball = sphere(RADIUS)
    if kind == "triangle":
        written = meshio.Mesh(ball.vertices, [("triangle", ball.faces)])
    else:  # one tetrahedron to the middle for each triangle
        center = np.full((len(ball.faces), 1), len(ball.vertices))
        points = np.vstack([ball.vertices, ball.vertices.mean(0)])
        written = meshio.Mesh(points, [("tetra", np.hstack([ball.faces, center]))])
    meshio.write(tmp_path / "ball.msh", written, file_format="gmsh")
    stl, msh = (domain(path) for path in (saved(ball, tmp_path / "ball.stl"), tmp_path / "ball.msh"))
    assert torch.equal(stl.region, msh.region)


def test_a_round_body_is_void_outside_in_design_simulation_and_print(tmp_path):
    ball, hull = saved(sphere(RADIUS), tmp_path / "ball.stl"), saved(sphere(BODY), tmp_path / "hull.stl")
    made = domain(ball, body=hull)
    radius = (3 * float((made.region != Region.OUTSIDE).sum()) * made.volume / (4 * math.pi)) ** (1 / 3)
    assert radius == pytest.approx(BODY, abs=0.05 * made.spacing)
    field = DesignField(made, radius=0.004)
    gamma = field(torch.ones(made.shape))
    assert bool((gamma[made.outside] == 0).all()) and bool((gamma[made.design] > 0.9).all())
    ones = fill(made, torch.ones(made.count), solid=Solid(), epsilon=1e-5)
    assert bool((ones.shear[made.outside] < 1e-4 * ones.shear[made.wall].min()).all())
    port = AirPort(direction=(-1.0, 0.0, 0.0), diameter=0.004)
    part = fabricate(made, torch.ones(made.count), density=1070.0, port=port)
    assert part.report.manifold and part.report.bodies == 1 and part.report.port_open
    assert part.report.cavity_volume_mm3 == pytest.approx(4e9 / 3 * math.pi * RADIUS**3, rel=0.05)
    hole = math.pi / 4 * 4.0**2 * 1e3 * (BODY - RADIUS)
    shell = 4e9 / 3 * math.pi * (BODY**3 - RADIUS**3)
    assert part.report.volume_mm3 == pytest.approx(shell - hole, rel=0.03)


def test_a_cavity_and_its_wall_without_material_print_as_a_hollow_ball(tmp_path):
    made = domain(saved(sphere(RADIUS), tmp_path / "ball.stl"), n=32, wall=0.004)
    gamma = torch.where(made.positions[:, 2] < 0.004, 1.0, 0.0)
    gamma[(made.positions[:, :2] - SIDE / 2).norm(dim=1) < 0.004] = 1.0
    part = fabricate(made, gamma, density=1070.0)
    assert part.report.manifold and part.report.bodies == 1
    assert part.report.thinnest_wall_mm > 2.0


def leaking(path: Path) -> Path:
    ball = sphere(RADIUS)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    return saved(ball, path)


def moved(path: Path, by: float) -> Path:
    ball = sphere(RADIUS)
    ball.apply_translation((1e3 * by, 0, 0))
    return saved(ball, path)


def plate(path: Path) -> Path:
    box = trimesh.creation.box((20.0, 20.0, 0.5))
    box.apply_translation(1e3 * MIDDLE)
    return saved(box, path)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (leaking, {}, r"c\.stl: the surface is open, wanted a closed one"),
        (lambda p: p, {}, r"c\.stl: no such file"),
        (lambda p: moved(p, 0), {"unit": "m"}, r"16 x 16 x 16 m in a domain of 0\.04 x 0\.04 x 0\.04 m.*is the unit"),
        (
            lambda p: moved(p, 0),
            {"unit": "um"},
            r"1\.6e-05 .* wanted more than its spacing of 0\.001667 m: is the file's unit",
        ),
        (lambda p: moved(p, 0.015), {}, r"shape: from 0\.027 to 0\.043 m along x, wanted within 0 to 0\.04 m"),
        (lambda p: moved(p, 0.011), {}, r"wall of 0\.00333.* m that leaves the domain"),
        (plate, {}, r"thinner than the spacing of 0\.001667 m at \d\d% of its surface"),
        (lambda p: moved(p, 0), {"wall": 0.001}, r"wall: got 0\.001 m, want at least one spacing"),
    ],
)
def test_a_surface_that_does_not_fit_is_refused(tmp_path, make, options, message):
    path = make(tmp_path / "c.stl")
    with pytest.raises(ValueError, match=message):
        domain(path, **options)


def test_a_wall_that_leaves_a_body_and_chambers_that_overlap_are_refused(tmp_path):
    ball, hull = saved(sphere(RADIUS), tmp_path / "ball.stl"), saved(sphere(RADIUS + 0.001), tmp_path / "hull.stl")
    with pytest.raises(ValueError, match=r"got \d+ particles outside of the body, want none"):
        domain(ball, body=hull)
    shape = read_surface(ball, UNITS["mm"])
    two = (Chamber(name="a", shape=shape, wall=0.004), Chamber(name="b", shape=shape, wall=0.004))
    with pytest.raises(ValueError, match="got 'a' overlapping 'b', want them apart"):
        Domain(size=(SIDE,) * 3, particles=(24,) * 3, chambers=two)
    with pytest.raises(ValueError, match=r"center, size: got .* with a shape, want neither"):
        Chamber(name="a", shape=shape, wall=0.004, center=(0, 0, 0))


def test_robot_of_meshes_in_mm_simulates_without_what_is_outside_and_has_a_print(tmp_path):
    hull, ball = trimesh.creation.box((33.0, 25.0, 35.0)), trimesh.creation.icosphere(subdivisions=3, radius=9.0)
    for mesh in (hull, ball):
        mesh.apply_translation((0.0, 0.0, 17.5))
    files = {"body_mesh": saved(hull, tmp_path / "hull.stl"), "chamber_mesh": saved(ball, tmp_path / "ball.stl")}
    robot = walker(tiny(tmp_path, **files))
    assert int(robot.domain.outside.sum()) == 2 * 8 * 8  # a layer on both sides across y
    assert int(robot.domain.gas.sum()) > 0
    outcome = robot(robot.field().detach())
    assert math.isfinite(float(outcome.travel))
    part = print_part(robot, robot.field().detach().numpy())
    assert part.report.manifold and part.report.port_open
    with pytest.raises(ValueError, match=r"body: 33 x 25 x 35 m in a domain of 0\.035 x 0\.035 x 0\.035 m"):
        walker(tiny(tmp_path, mesh_unit="m", **files))
