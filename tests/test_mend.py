"""Thin walls that are mended: on shapes of known walls, around cavities and ports, on a robot and in its files."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny import TINY, tiny

import torchsoro.output.printable
from torchsoro.design import loop
from torchsoro.design.density import thickened
from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.port import AirPort
from torchsoro.design.robot import Robot, walker
from torchsoro.errors import SimulationDiverged
from torchsoro.output.archive import load_design
from torchsoro.output.delivery import deliver
from torchsoro.output.fabricate import fabricate
from torchsoro.output.mend import clearance
from torchsoro.output.part import Part
from torchsoro.output.printable import farthest, mending_line, print_part

torch.set_num_threads(1)
H = 1e-3  # particle spacing, m


def made(domain: Domain, solid: torch.Tensor, min_wall: float, port: AirPort | None = None) -> tuple[Part, Part]:
    """The part as it is and with its walls mended, on the same grid of four points to a spacing."""
    how = {"density": 1000.0, "refine": 4, "port": port}
    plain, mended = (fabricate(domain, solid.double().flatten(), min_wall=w, **how) for w in (0.0, min_wall))
    assert plain.report.mended is None and not plain.added.any()
    report = mended.report
    assert report.manifold and report.bodies == 1 and report.mended is not None
    assert report.mended.thinnest_wall_before_mm == plain.report.thinnest_wall_mm
    assert report.mended.volume_mm3 == pytest.approx(report.volume_mm3 - plain.report.volume_mm3, abs=1e-9)
    # What is added lies in the box of the body, and its cells hold what the surface says, to the voxels it cuts.
    np.testing.assert_array_less(mended.mesh.bounds[1], 1e3 * np.array(domain.size) + 0.5 * report.voxel_mm)
    np.testing.assert_array_less(-0.5 * report.voxel_mm, mended.mesh.bounds[0])
    cells = 1e9 * domain.volume * mended.added.sum()
    assert cells == pytest.approx(report.mended.volume_mm3, rel=0.15, abs=1.0)
    return plain, mended


@pytest.mark.slow
def test_a_thin_plate_gets_the_wanted_thickness():
    domain = Domain(size=(14 * H,) * 3, particles=(14,) * 3)
    solid = torch.zeros(14, 14, 14)
    solid[:, :, 6:8] = 1.0
    solid[:4], solid[-4:] = 1.0, 1.0  # between two blocks
    plain, mended = made(domain, solid, 3 * H)
    half = 0.5 * mended.report.voxel_mm
    assert plain.report.thinnest_wall_mm == pytest.approx(2.0, abs=half)
    assert 3.0 - 0.02 * half <= mended.report.thinnest_wall_mm <= 3.0 + half
    assert mended.report.mended is not None and mended.report.mended.met
    # A plate of 14 x 6 mm, 1 mm thicker.
    assert mended.report.mended.volume_mm3 == pytest.approx(84, rel=0.2)


@pytest.mark.slow
def test_a_plate_on_the_face_of_the_box_grows_into_the_box():
    domain = Domain(size=(14 * H,) * 3, particles=(14,) * 3)
    solid = torch.zeros(14, 14, 14)
    solid[:, :, :1] = 1.0
    solid[:4], solid[-4:] = 1.0, 1.0
    _, mended = made(domain, solid, 2 * H)
    assert 2.0 - 0.01 <= mended.report.thinnest_wall_mm <= 2.0 + 0.5 * mended.report.voxel_mm
    added = mended.added.reshape(14, 14, 14)
    assert (added[5:9, 2:-2, 1] > 0.8).all() and not added[5:9, 2:-2, 3:].any()


def shell() -> tuple[Domain, torch.Tensor]:
    """A chamber whose wall is one layer thick, with a block in front of it."""
    air = Chamber(name="air", center=(7 * H,) * 3, size=(8 * H,) * 3, wall=H)
    domain = Domain(size=(14 * H,) * 3, particles=(14,) * 3, chambers=(air,))
    solid = torch.zeros(14, 14, 14)
    solid[11:] = 1.0
    return domain, solid


@pytest.mark.parametrize("port", [pytest.param(None, marks=pytest.mark.slow), AirPort(diameter=3 * H)])
def test_a_thin_shell_grows_outwards_and_keeps_its_cavity_and_its_port(port):
    domain, solid = shell()
    plain, mended = made(domain, solid, 2 * H, port)
    half = 0.5 * mended.report.voxel_mm
    assert plain.report.thinnest_wall_mm == pytest.approx(1.0, abs=half)
    assert 2.0 - 0.01 <= mended.report.thinnest_wall_mm <= 2.0 + half
    assert mended.report.port_open == (port is not None)
    assert mended.report.cavity_volume_mm3 == plain.report.cavity_volume_mm3
    if port is None:
        hollow = [part.mesh.split() for part in (plain, mended)]
        inner = [sorted(float(one.volume) for one in shells)[0] for shells in hollow]
        assert inner[0] < 0 and inner[0] == pytest.approx(inner[1], rel=1e-9)
    assert not mended.added[domain.gas.numpy()].any()
    if port is not None:  # a ray along the port's axis meets the wall before and behind it, and nothing else
        for part in (plain, mended):
            origin = [[-1.0, 7.0 + 1.3, 7.0]]
            hits = part.mesh.ray.intersects_location(origin, [[1.0, 0.0, 0.0]])[0]
            assert hits[:, 0].min() == pytest.approx(10.0, abs=half)


@pytest.mark.slow
def test_a_neck_between_two_blocks_becomes_a_rod_of_the_wanted_diameter():
    domain = Domain(size=(20 * H, 12 * H, 12 * H), particles=(20, 12, 12))
    solid = torch.ones(20, 12, 12)
    solid[7:13] = 0.0
    solid[7:13, 5:7, 5:7] = 1.0
    plain, mended = made(domain, solid, 3 * H)
    assert plain.report.thinnest_wall_mm < 2.1
    assert 3.0 - 0.01 <= mended.report.thinnest_wall_mm <= 3.0 + 0.5 * mended.report.voxel_mm
    assert mended.report.thinnest_gap_mm == pytest.approx(plain.report.thinnest_gap_mm, abs=0.1)


@pytest.mark.slow
def test_what_is_thick_enough_is_returned_unchanged():
    domain, _ = shell()
    plain, mended = made(domain, torch.ones(14, 14, 14), 2.9 * H)  # walls of 3 or 4 mm
    assert np.array_equal(plain.mesh.vertices, mended.mesh.vertices)
    assert np.array_equal(plain.mesh.faces, mended.mesh.faces)
    assert not mended.added.any()
    assert dataclasses.replace(mended.report, mended=None) == plain.report


def test_clearance_is_the_distance_to_cells_and_to_the_box():
    taken = np.zeros((9, 9, 9), dtype=bool)
    taken[4, 4, 4] = True
    found = clearance(taken, np.full(3, -0.5), np.full(3, 8.5), np.zeros(3), 1.0)
    assert found[4, 4, :].tolist() == [0.5, 1.5, 1.5, 0.5, -0.5, 0.5, 1.5, 1.5, 0.5]


@pytest.mark.slow
def test_where_there_is_no_room_the_wall_stays_and_the_report_says_so():
    """A wall of one layer between the cavity and the face of the box."""
    air = Chamber(name="air", center=(4 * H, 6 * H, 6 * H), size=(8 * H, 6 * H, 6 * H), wall=H)
    domain = Domain(size=(12 * H,) * 3, particles=(12,) * 3, chambers=(air,))
    _, mended = made(domain, torch.ones(12, 12, 12), 2 * H)
    assert mended.report.thinnest_wall_mm == pytest.approx(1.0, abs=0.02)
    assert mended.report.mended is not None and not mended.report.mended.met
    assert "NOT MET" in str(mended.report)


def test_density_of_what_is_added_has_its_mass():
    gamma, added = torch.tensor([0.0, 0.5, 0.9, 1.0, 0.3]), torch.tensor([0.2, 0.5, 0.7, 0.1, 0.0])
    found = thickened(gamma, added, 3.0)
    torch.testing.assert_close(found**3, torch.tensor([0.2, 0.625, 1.0, 1.0, 0.027]))
    assert found[4] == gamma[4]


@pytest.fixture(scope="module")
def delivered(tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """A tiny walker with legs of one layer, mended to one and a half."""
    path = tmp_path_factory.mktemp("mended")
    robot = walker(tiny(path, min_wall=1.5 * 0.035 / 8))
    gamma = torch.ones(8, 8, 8)
    gamma[2:6, :, :1] = 0.0
    gamma[1, :, :2] = gamma[-2, :, :2] = 0.0
    history = {name: [0.01, 0.02] for name in ("iteration", "objective/L", "constraint/C")}
    found = deliver(path, robot, gamma.flatten(), history, name="walker")
    return path, found


@pytest.mark.slow
def test_a_delivered_run_holds_both_densities_and_tells_both_travels(delivered):
    path, found = delivered
    settings = tiny(path, min_wall=1.5 * 0.035 / 8)
    robot = walker(settings)
    plain = load_design(path / "design.npz", robot.domain, mended=False)
    mended = load_design(path / "design.npz", robot.domain)
    assert float((mended - plain).min()) == 0.0 and float((mended - plain).max()) > 0.3
    with torch.no_grad():
        assert found["L"] == pytest.approx(float(robot(mended).travel), abs=1e-9)
        assert found["L_before"] == pytest.approx(float(robot(plain).travel), abs=1e-9)
    assert found["L"] != found["L_before"]
    stored = json.loads((path / "shape.json").read_text())
    assert stored["mended"]["volume_mm3"] == pytest.approx(1e9 * found["mended_volume"])
    assert stored["mended"]["share"] == found["mended_share"] > 0
    assert found["thinnest_wall"] > found["thinnest_wall_before"]
    assert f"travel {1e3 * found['L_before']:.2f} mm before, {1e3 * found['L']:.2f} mm now" in mending_line(found)
    added = torch.from_numpy(print_part(robot, plain.numpy()).added).to(plain)
    assert torch.equal(mended, thickened(plain, added, 3.0))


@pytest.mark.parametrize(
    ("worths", "thick", "chosen"),
    [
        ((3, 2, 1), (True, True, True), 7),
        ((1, 2, 3), (True, True, True), 5),
        ((1, 2, 3), (True, True, False), 4),
        ((1, math.inf, 2), (True, True, True), 5),
        ((3, 2, 1), (False, False, False), 7),
    ],
)
def test_of_the_last_designs_the_one_whose_part_goes_farthest_is_delivered(
    tmp_path, monkeypatch, worths, thick, chosen
):
    robot = walker(tiny(tmp_path, min_wall=1.5 * 0.035 / 8))
    designs = []
    for k, everywhere in zip((7, 4, 5, 6), (0.9, 0.8, 0.7, 0.0), strict=True):  # the last is grey
        with torch.no_grad():
            robot.field.phi.fill_(everywhere)
        designs.append({"iteration": k, **loop.design_of(robot)})
    loop.take_(robot, designs[0])
    best = robot.density().detach()
    told = {"iteration": 7, "worth": 1.0, "violation": -0.001, "metrics": {}, "lately": [*designs[1:], designs[0]]}
    values, reports = iter(worths), iter([SimpleNamespace(mended=SimpleNamespace(met=met)) for met in thick])

    def worth(one: Robot, delivered: torch.Tensor) -> float:
        if math.isinf(value := next(values)):
            raise SimulationDiverged(step=1, time=0.1, particle=2, quantity="J <= 0", remedy="a smaller step")
        return value

    monkeypatch.setattr(torchsoro.output.printable, "_worth", worth)
    monkeypatch.setattr(
        torchsoro.output.printable, "mended", lambda one, gamma: (SimpleNamespace(report=next(reports)), gamma)
    )
    gamma, iteration, part = farthest(robot, loop.Optimized(gamma=best, **told))
    wanted = next(one for one in designs if one["iteration"] == chosen)
    assert iteration == chosen and part is not None
    assert torch.equal(robot.field.phi, wanted["phi"]) and torch.equal(robot.density(), gamma)


@pytest.mark.slow
def test_a_replay_mends_as_its_run_did_or_as_it_is_told(recipes, delivered, tmp_path, capsys):
    path, found = delivered
    (path / "settings.json").write_text(json.dumps(_settings(path)))
    replay = recipes["replay"]
    how = {"robot": str(path), "void": True, "frames": 2, "settle": 0.01}
    again = replay.main(replay.Options(**how, out=tmp_path / "again"))
    assert again["L"] == pytest.approx(found["L"], rel=1e-6)
    assert again["L_before"] == pytest.approx(found["L_before"], rel=1e-6)
    assert "walls mended to 6.56 mm" in capsys.readouterr().out
    off = replay.main(replay.Options(**how, out=tmp_path / "off", min_wall=0.0))
    assert off["L"] == pytest.approx(found["L_before"], rel=1e-6) and "min_wall" not in off


def _settings(path: Path) -> dict[str, object]:
    from torchsoro.storage import plain_settings

    return plain_settings(dataclasses.asdict(tiny(path, min_wall=1.5 * 0.035 / 8)))


def test_a_wall_that_no_grid_resolves_or_no_body_holds_is_refused():
    with pytest.raises(ValueError, match=r"min_wall = 0.0003 m: wanted 0, or at least 0.000438 m"):
        dataclasses.replace(TINY, min_wall=3e-4)
    with pytest.raises(ValueError, match=r"min_wall = 0.01 m: wanted at most a quarter of the body, 0.00875 m"):
        dataclasses.replace(TINY, min_wall=1e-2)
    domain, solid = shell()
    with pytest.raises(ValueError, match="min_wall: got -1"):
        fabricate(domain, solid.flatten(), density=1000.0, min_wall=-1.0)
