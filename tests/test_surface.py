"""Bodies of a mesh: what lies inside, mass and motion as of a box or in closed form, what is refused."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from setups import marker, material

from torchsoro.design.mesh import Surface, read_surface
from torchsoro.sim2real.data.experiment import read_experiment
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.model import predict_trial, read_model, write_model
from torchsoro.sim2real.twin.batch import MESHED, simulate
from torchsoro.sim2real.twin.twin import Twin

SETUP = f"""
title = "bar"
gravity = [0.0, 0.0, -1.0]
duration = {{duration}}
{{body}}
{material(poisson_ratio=0.3, prony="")}
[[clamp]]
box = [[-0.001, -1.0, -1.0], [0.0001, 1.0, 1.0]]

{marker("tip", 0.08, 0.01, 0.01)}
[recording]
noise = 5e-5
{{more}}
"""
BOX = "[body]\nsize = [0.08, 0.02, 0.02]\n"
MESH = '[body]\nshape = "mesh"\nfile = "body.stl"\nscale = 1e-3\n'
CORNERS = ((0, 0), (80, 0), (80, 8), (30, 8), (30, 20), (0, 20))  # of an L, mm


def prism(outline, low, high):
    """A prism along y of an outline that its first and fourth corner see whole, in mm."""
    n = len(outline)
    vertices = [(x, y, z) for y in (low, high) for x, z in outline]
    cap = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)] if n == 6 else [(0, 1, 2), (0, 2, 3)]
    faces = [*cap, *((c + n, b + n, a + n) for a, b, c in cap)]
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, i + n, j + n), (i, j + n, j)]
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight
    return mesh


def folder(path: Path, mesh, body=MESH, duration=0.1, more=""):
    """An experiment with a trial in which nothing moved."""
    path.mkdir(parents=True, exist_ok=True)
    (path / "setup.toml").write_text(SETUP.format(body=body, duration=duration, more=more))
    if mesh is not None:
        mesh.export(path / "body.stl")
    trial = path / "trials" / "a"
    trial.mkdir(parents=True)
    rows = "\n".join(f"{0.01 * k},0.08,0.01,0.01" for k in range(9))
    (trial / "markers.csv").write_text(f"time_s,tip_x_m,tip_y_m,tip_z_m\n{rows}\n")
    if "[[chamber]]" in more:
        (trial / "pressure.csv").write_text("time_s,c_pa\n0,0\n1,1000\n")
    return read_experiment(path)


def test_points_lie_inside_of_a_ball():
    ball = Surface(mesh=trimesh.creation.icosphere(subdivisions=4, radius=0.02))
    rng = np.random.default_rng(0)
    x, y, z = (np.sort(rng.uniform(-0.021, 0.021, 24)) for _ in range(3))
    radius = np.sqrt(x[:, None, None] ** 2 + y[:, None] ** 2 + z**2)
    found = ball.filled(x, y, z)
    assert found[radius < 0.0198].all() and not found[radius > 0.0201].any()
    assert ball.faces == ([], [], [])


def test_flat_faces_are_found():
    surface = Surface(mesh=prism(CORNERS, 0, 20))
    assert surface.faces == ([pytest.approx(30.0)], [], [pytest.approx(8.0)])


def test_a_box_of_triangles_moves_as_a_box(tmp_path):
    box = folder(tmp_path / "box", None, BOX)
    mesh = folder(tmp_path / "mesh", prism([(0, 0), (80, 0), (80, 20), (0, 20)], 0, 20))
    one, other = (Twin(e.setup, edge=0.01, across=2) for e in (box, mesh))
    assert one.setup.size == pytest.approx(other.setup.size)
    # In the same steps, of which a mesh takes shorter ones by itself.
    moved, same = (simulate(t, [t.scenario(e.trials[0])], safe=MESHED)[0] for t, e in ((one, box), (other, mesh)))
    assert np.abs(moved.position[-1] - np.array([0.08, 0.01, 0.01])).max() > 1e-4
    np.testing.assert_allclose(moved.position, same.position, atol=1e-7)


def test_a_box_of_triangles_lands_as_a_box(tmp_path):
    """On a plane just below it, held at one end."""
    plane = "[[plane]]\npoint = [0, 0, -0.0005]\nnormal = [0, 0, 1]\nfriction = 0.3\n"
    box = folder(tmp_path / "box", None, BOX, more=plane)
    mesh = folder(tmp_path / "mesh", prism([(0, 0), (80, 0), (80, 20), (0, 20)], 0, 20), more=plane)
    moved, same = (
        simulate(t, [t.scenario(dataclasses.replace(e.trials[0], setup=s))], safe=MESHED)[0]
        for e in (box, mesh)
        for s in (dataclasses.replace(e.setup, gravity=(0.0, 0.0, -9.81)),)
        for t in (Twin(s, edge=0.01, across=2),)
    )
    assert moved.position[0, -1, 0, 2] < 0.0099
    np.testing.assert_allclose(moved.position, same.position, atol=2e-6)


def test_a_plane_faces_what_there_is_of_a_body(tmp_path):
    twin = Twin(folder(tmp_path, prism(CORNERS, 0, 20)).setup, edge=0.01, across=2)
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    below, above = twin.grid.lattice.faces.facing(normals).sum(-1).tolist()
    assert (below, above) == (pytest.approx(0.08 * 0.02), pytest.approx(0.03 * 0.02))


def test_an_l_has_its_mass_centre_and_front(tmp_path):
    body = prism(CORNERS, 0, 20)
    found = folder(tmp_path, body)
    twin = Twin(found.setup, edge=0.01, across=2)
    assert float(twin.volumes.sum()) == pytest.approx(body.volume * 1e-9)
    centre = (twin.volumes.unsqueeze(-1) * twin.positions).sum(0) / twin.volumes.sum()
    np.testing.assert_allclose(centre, body.center_mass * 1e-3, atol=1e-9)
    # Both sides of it, halved: along z the whole length, along x both ends.
    front = twin.grid.lattice.faces.front.sum(0).tolist()
    assert front == pytest.approx([0.02 * 0.02, 0.08 * 0.008 + 0.03 * 0.012, 0.08 * 0.02])
    # A marker over the step sits on it.
    at, _ = twin.grid.nearest(np.array([[0.06, 0.01, 0.011]]))
    np.testing.assert_allclose(at[0], [0.06, 0.01, 0.008])


def test_a_face_beside_that_of_a_chamber_makes_no_sliver(tmp_path):
    chamber = '[[chamber]]\nname = "c"\nbox = [[0.01, 0.005, 0.002], [0.0299, 0.015, 0.006]]\n'
    found = folder(tmp_path, prism(CORNERS, 0, 20), more=chamber)
    twin = Twin(found.setup, edge=0.01, walls=1)
    assert min(np.diff(axis.planes).min() for axis in twin.grid.axes) > 1e-3
    # One that is farther off is kept.
    assert 0.008 in twin.grid.axes[2].planes.round(9)


@pytest.mark.parametrize(("edge", "within"), [(0.008, 0.2), pytest.param(0.004, 0.1, marks=pytest.mark.slow)])
def test_a_round_bar_has_the_frequency_of_its_radius(tmp_path, edge, within):
    """Cells that are cut by the surface count as far as they are filled."""
    radius, length, young, density = 10.0, 80.0, 1e5, 1000.0
    bar = trimesh.creation.cylinder(radius=radius, height=length, sections=48)
    bar.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0]))
    found = folder(tmp_path, bar, f"{MESH}origin = [0.0, 0.0, 0.0]\n", duration=0.4)
    stiffness, mass = young * math.pi * (1e-3 * radius) ** 4 / 4, density * math.pi * (1e-3 * radius) ** 2
    sag = mass * 1.0 * (1e-3 * length) ** 4 / (8 * stiffness)  # Euler and Bernoulli; shear adds 4 % or so
    twin = Twin(found.setup, edge=edge, across=round(0.02 / edge))
    motion = simulate(twin, [twin.scenario(found.trials[0])])[0].alone()
    height = motion.position[:, 0, 2] - 0.01
    assert abs(-height.mean() / sag / 1.04 - 1) < within


def test_a_round_bar_that_is_thrown_bears_it(tmp_path):
    """Nodes beside cells that are hardly body have next to no mass."""
    bar = trimesh.creation.cylinder(radius=10, height=80, sections=48)
    bar.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0]))
    bar.apply_translation([40, 10, 10])
    found = folder(tmp_path, bar)
    thrown = dataclasses.replace(found.setup, velocity=(0.0, 0.0, 3.0))
    twin = Twin(thrown, edge=0.006, across=2)
    scenario = twin.scenario(dataclasses.replace(found.trials[0], setup=thrown))
    assert twin.grid.cut and simulate(twin, [scenario])[0].sound.all()
    assert not simulate(twin, [scenario], safe=1.1)[0].sound.all()


def test_a_model_takes_its_mesh_along(tmp_path):
    found = folder(tmp_path / "experiment", prism(CORNERS, 0, 20))
    twin = Twin(found.setup, edge=0.01, across=2)
    (fit,) = FitProblem(found, twin).fit([((), None)], rounds=1)
    assert fit is not None
    out = tmp_path / "out"
    out.mkdir()
    write_model(out / "model.toml", tmp_path / "experiment" / "setup.toml", fit, twin)
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "trial.toml").write_text("gravity = [0.0, 0.0, 1.0]\n")
    told = predict_trial(read_model(out / "model.toml"), tmp_path / "new" / "trial.toml", out / "model.toml")
    assert told["tip_z_m"].max() > 0.0101


@pytest.mark.parametrize(
    ("change", "more", "message"),
    [
        ("none", "", "no such file"),
        ("open", "", "the surface is open"),
        ("text", "", "wanted"),
        ("large", "", "is the unit right"),
        ("", '[[chamber]]\nname = "c"\nbox = [[0.04, 0.005, 0.004], [0.06, 0.015, 0.016]]\n', "opens to the outside"),
    ],
)  # fmt: skip
def test_what_is_no_body_is_refused(tmp_path, change, more, message):
    mesh = prism(CORNERS, 0, 20)
    if change == "open":
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    body = MESH.replace("scale = 1e-3\n", "") if change == "large" else MESH
    with pytest.raises(ValueError, match=message):
        if change == "text":
            (tmp_path / "body.stl").write_text("no surface")
        found = folder(tmp_path, None if change in ("none", "text") else mesh, body, more=more)
        Twin(found.setup, edge=0.01)


def test_an_empty_file_is_no_surface(tmp_path):
    (tmp_path / "a.obj").write_text("# nothing\n")
    with pytest.raises(ValueError, match="wanted"):
        read_surface(tmp_path / "a.obj")
