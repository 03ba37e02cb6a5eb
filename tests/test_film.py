"""The recipe that prepares the experiment of a robot that was designed."""

from __future__ import annotations

import importlib
import tomllib

import numpy as np
import pytest

from torchsoro.design.reading import read_settings
from torchsoro.design.robot import build
from torchsoro.output.archive import load_design
from torchsoro.sim2real.data.from_design import believed, far_apart, seen_from
from torchsoro.sim2real.data.recording import write_table
from torchsoro.sim2real.inputs import read_inputs
from torchsoro.sim2real.options import Options


@pytest.fixture(scope="module")
def filmed(recipes, straight, tmp_path_factory):
    """A tiny walker, and its experiment."""
    film = importlib.import_module("film")
    out = tmp_path_factory.mktemp("film") / "experiment"
    given = film.Options(robot=str(straight[0]), out=out, markers=5, duration=0.05, settle=0.01, pressures=(1.0, 0.5))
    film.main(given)
    return straight[0], out, given


def test_what_is_filmed_can_be_explained_once_markers_are_there(filmed, tmp_path):
    folder, out, _ = filmed
    with pytest.raises(ValueError, match=r"trials/a, trials/b: no markers\.csv, wanted one in each trial"):
        read_inputs(Options(experiment=out, out=tmp_path / "out"))
    rng, markers = np.random.default_rng(0), tomllib.loads((out / "setup.toml").read_text())["marker"]
    time = np.arange(0, 0.06, 0.002)
    for trial in ("a", "b"):
        table = {
            f"{m['name']}_{axis}_m": m["at"]["xyz".index(axis)] + 1e-4 * rng.normal(size=len(time))
            for m in markers for axis in "xz"
        }  # fmt: skip
        write_table(out / "trials" / trial / "markers.csv", {"time_s": time, **table})
    found = read_inputs(Options(experiment=out, out=tmp_path / "out")).experiment
    settings = read_settings(folder / "settings.json", device="cpu")
    assert found.setup.axes == (0, 2) and [t.name for t in found.heldout] == ["kept"]
    assert found.setup.youngs_modulus == settings.youngs_modulus and found.setup.duration == pytest.approx(0.06)
    full, half = (t.pressure.pressure.max() for t in found.trials)
    assert half == pytest.approx(full / 2) and full > 0.5 * settings.pressure
    assert (out / "markers.png").stat().st_size > 1000


@pytest.mark.slow
def test_markers_are_on_material_that_the_camera_sees(filmed):
    folder, out, _ = filmed
    robot = build(read_settings(folder / "settings.json", device="cpu"))
    gamma = load_design(folder / "design.npz", robot.domain)
    solid = robot.domain.positions[(gamma >= 0.5) & ~robot.domain.gas].numpy()
    at = np.array([m.at for m in read_inputs(Options(experiment=out, out=out.parent / "o")).experiment.setup.markers])
    apart = np.abs(at[:, None] - solid).max(-1)
    assert apart.min(1).max() < 1e-6
    for x in at:  # nothing of the body is before it, towards -y
        same = np.abs(solid[:, [0, 2]] - x[[0, 2]]).max(1) < 0.1 * robot.domain.spacing
        assert solid[same, 1].min() == pytest.approx(x[1], abs=1e-6)


@pytest.mark.parametrize(("axis", "side"), [(0, 1), (1, -1), (2, 1)])
def test_a_camera_sees_the_nearest_point_of_each_column(axis, side):
    grid = np.stack(np.meshgrid(*[np.arange(4) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = grid[np.random.default_rng(1).permutation(len(grid))[:40]]
    seen = places[seen_from(places, axis, side, 1.0)]
    columns = {tuple(p) for p in np.delete(places, axis, 1)}
    assert len(seen) == len(columns)
    for p in seen:
        same = (np.delete(places, axis, 1) == np.delete(p, axis)).all(1)
        assert side * p[axis] == (side * places[same, axis]).max()


def test_places_far_apart_are_the_corners_of_a_square():
    inside = np.random.default_rng(2).uniform(0.3, 0.7, (20, 3)) * [1, 1, 0]
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    places = np.concatenate([corners[:1], inside, corners[1:]])
    assert {tuple(places[i]) for i in far_apart(places, 4)} == {tuple(c) for c in corners}


def test_a_folder_with_an_experiment_and_a_chamber_from_a_mesh_are_refused(filmed):
    folder, _, given = filmed
    film = importlib.import_module("film")
    with pytest.raises(ValueError, match="holds an experiment already, wanted a new folder"):
        film.main(given)
    robot = build(read_settings(folder / "settings.json", device="cpu"))
    (chamber,) = robot.domain.chambers
    shaped = type("Chamber", (), {**vars(chamber), "shape": "a surface"})
    robot.domain = type("Domain", (), {"chambers": (shaped,)})
    with pytest.raises(ValueError, match="its chamber is a mesh, wanted chambers that are boxes"):
        believed(robot, title="x", duration=0.1, prony=[], air_stiffness=0.0)
