"""A finished design on another lattice: its density, the design variable fitted to it, runs and checks that use it."""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch
from tiny import TINY, tiny

from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.objective import intermediate_density
from torchsoro.design.resampling import fit_, resampled
from torchsoro.design.robot import walker
from torchsoro.output.archive import DESIGNS, load_design, load_resampled
from torchsoro.output.robustness import compare_scenarios

# From the archived walker, on the tiny lattice.
FROM = {"start_from": "walker", "dt": "auto"}


def cube(particles: int, wall: float = 0.0035) -> Domain:
    air = Chamber(name="air", center=(0.0175,) * 3, size=(0.0175,) * 3, wall=wall)
    return Domain(size=(0.035,) * 3, particles=(particles,) * 3, chambers=(air,))


def wave(domain: Domain) -> torch.Tensor:
    """A density whose argument of the projection is linear in place, with walls and air."""
    place = domain.positions / 0.035
    density = 0.5 * (torch.tanh(6 * place[:, 0] - 4 * place[:, 1] + place[:, 2] - 1) + 1)
    return torch.where(domain.design, density, domain.wall.double())


@pytest.mark.parametrize("particles", [(20, 40), (40, 20)])
def test_a_density_is_the_same_function_of_place_on_another_lattice(particles):
    source, target = map(cube, particles)
    found = resampled(wave(source), source, target)
    # Away from faces and walls, from which the last half spacing is continued evenly.
    away = (target.positions - 0.0175).abs().amax(1)
    inside = (away < 0.0155) & (away > 0.0115)
    assert inside.sum() > 500
    torch.testing.assert_close(found[inside], wave(target)[inside], rtol=0, atol=1e-9)
    assert (found - wave(target)).abs().max() < 0.06
    assert found[target.wall].eq(1).all() and found[target.gas].eq(0).all()


def test_on_its_own_lattice_a_density_is_what_it_was_and_beside_a_thinner_wall_it_is_solid():
    source = cube(20)
    gamma = wave(source)
    assert resampled(gamma, source, cube(20)) is gamma
    thin = cube(20, wall=0.00175)
    assert torch.equal(resampled(gamma, source, thin)[thin.design], gamma[thin.design])
    with pytest.raises(ValueError, match="source: a design of a body of"):
        resampled(gamma, source, dataclasses.replace(source, size=(0.07,) * 3, chambers=()))


def test_a_field_meets_a_density_of_its_own_and_the_archived_walker_on_a_coarse_lattice():
    field = walker(TINY).field
    generator = torch.Generator().manual_seed(0)
    phi = 2 * torch.rand(field.phi.shape, generator=generator) - 1
    wanted = field(phi).detach()
    assert fit_(field, wanted) < 0.02  # of white noise, which the filter nearly takes away
    assert float((field() - wanted).detach().abs().max()) < 0.1
    assert field.phi.grad is None and float(field.phi.detach().abs().max()) <= 1
    robot = walker(dataclasses.replace(TINY, particles=(24,) * 3, wall=0.035 / 24, filter_radius=0.00525, dt="auto"))
    gamma = load_resampled(DESIGNS / "walker", robot.domain)
    assert fit_(robot.field, gamma) < 2e-3
    found = robot.field().detach()
    # As grey as at 40 particles along the edge, of which 0.0124 is allowed, and as heavy.
    assert float(intermediate_density(found, robot.design)) == pytest.approx(0.0124, abs=1e-3)
    assert float(found[robot.design].mean()) == pytest.approx(0.509, abs=2e-3)


@pytest.mark.slow
def test_a_run_begins_with_an_archived_design_and_is_resumed_without_it(recipes, tmp_path, monkeypatch):
    result = recipes["walker"].main(tiny(tmp_path / "run", **FROM, scenarios=2, shape_every=1, seconds=1e-9))
    robot = walker(tiny(tmp_path))
    first = load_design(tmp_path / "run" / "shapes" / "00000.npz", robot.domain)
    wanted = load_resampled(DESIGNS / "walker", robot.domain)
    assert float((first - wanted)[robot.design].square().mean().sqrt()) < 0.1
    # After the time that was given the best of the iterations so far is delivered, here of one.
    assert result["iterations"] == 1 and result["iteration"] == 0
    assert np.array_equal(np.load(tmp_path / "run" / "design.npz")["gamma"], first.numpy())
    monkeypatch.setattr("torchsoro.output.delivery.begin_with", None)
    again = recipes["walker"].main(tiny(tmp_path / "run", **FROM, scenarios=2, shape_every=1, resume=True))
    assert again["iterations"] == 3


def test_what_cannot_be_started_from_is_refused_before_a_folder_is_made(recipes, tmp_path):
    for name, changes, message in (
        ("none", {"start_from": "nobody"}, "robot = 'nobody': wanted .*walker"),
        ("size", {"start_from": "climber"}, r"a design of a body of .*0\.0455"),
        ("few", {"slopes": (0.0, 0.1), "scenarios": 1}, "slopes = .*wanted at least as many scenarios, not 1"),
        ("steep", {"slopes": (0.0,), "scenarios": 2, "slope": 0.2}, "slopes = .* none .* beside a slope of 0.2"),
    ):
        with pytest.raises(ValueError, match=message):
            recipes["walker"].main(tiny(tmp_path / name, **changes))
        assert not (tmp_path / name).exists()


@pytest.mark.slow
def test_results_are_there_where_no_movie_can_be_made(recipes, tmp_path, monkeypatch, capsys):
    def none() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", none)
    path = tmp_path / "run"
    result = recipes["walker"].main(tiny(path, iterations=1))
    assert json.loads((path / "result.json").read_text())["L"] == result["L"]
    written = {"design.npz", "shape.stl", "shape.3mf", "shape.json", "motion.npz", "motion.html", "summary.png"}
    assert written <= {file.name for file in path.iterdir()} and not (path / "walker.mp4").exists()
    assert "walker.mp4 is left out: No ffmpeg exe" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    recipes["walker"].main(tiny(path, iterations=1, resume=True))
    assert "walker.mp4 is left out: import of imageio_ffmpeg halted" in capsys.readouterr().err


@pytest.mark.slow
def test_a_finished_robot_is_compared_on_another_lattice(tmp_path, recipes):
    recipes["walker"].main(tiny(tmp_path / "run", iterations=1))
    how = {"count": 2, "device": "cpu", "particles": (16, 16, 16), "void": False}
    found = compare_scenarios(str(tmp_path / "run"), tmp_path / "fine", **how, wall=0.035 / 16)
    assert (found["particles"], found["wall"], found["diverged"]) == ([16, 16, 16], 0.035 / 16, 0)
    with pytest.raises(ValueError, match=r"wall face at .* want a whole number of spacings"):
        compare_scenarios(str(tmp_path / "run"), tmp_path / "other", **how, wall=0.003)
    with pytest.raises(ValueError, match=r"^wall: wanted with --scenarios only"):
        recipes["compare"].main(recipes["compare"].Options(robot="walker", out=tmp_path, wall=0.003))
