"""A material on disk: the same numbers back, what is refused, and a robot made of it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from tiny import TINY

from torchsoro.design.robot import walker
from torchsoro.simulation.material import Prony, Solid
from torchsoro.simulation.material_file import Material, read_material, write_material

EXACT = torch.float64
RUBBER = Material(
    solid=Solid(youngs_modulus=123456.789, poisson_ratio=0.49, density=987.6),
    prony=Prony(moduli=torch.tensor([0.1, 2 / 3], dtype=EXACT), times=torch.tensor([1e-3, 0.3], dtype=EXACT)),
    left_out='Two "fast" terms.\nTheir loss at 100 Hz is 12 %.',
    source={"file": "C:\\data\\süß.csv", "reference temperature": "21.8 C"},
)


def test_a_material_comes_back_with_the_same_numbers_slowest_element_first(tmp_path):
    found = read_material(write_material(tmp_path / "material.toml", RUBBER))
    assert found.solid == RUBBER.solid
    assert found.prony.times.tolist() == [0.3, 1e-3]
    assert found.prony.moduli.tolist() == [2 / 3, 0.1]
    assert (found.left_out, dict(found.source)) == (RUBBER.left_out, dict(RUBBER.source))


def test_a_solid_without_elements_is_elastic(tmp_path):
    write_material(tmp_path / "elastic.toml", dataclasses.replace(RUBBER, prony=Prony.paper(0)))
    assert read_material(tmp_path / "elastic.toml").prony.elements == 0


def test_a_solid_that_stiffens_comes_back(tmp_path):
    yeoh = dataclasses.replace(RUBBER.solid, linear_stiffening=0.2, quadratic_stiffening=0.1)
    path = write_material(tmp_path / "material.toml", dataclasses.replace(RUBBER, solid=yeoh))
    assert read_material(path).solid == yeoh
    path.write_text(path.read_text().replace("quadratic_stiffening = 0.1\n", ""))
    with pytest.raises(ValueError, match=r"\[solid\]: no quadratic_stiffening; wanted .*linear_stiffening"):
        read_material(path)


def test_a_robot_is_made_of_it(tmp_path):
    path = write_material(tmp_path / "material.toml", RUBBER)
    robot = walker(dataclasses.replace(TINY, material=path, dt="auto"))
    assert robot.solid == RUBBER.solid
    assert robot.prony.times.tolist() == [0.3, 1e-3]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("youngs_modulus_Pa", "youngs_modulus", r"\[solid\]: unknown youngs_modulus, no youngs_modulus_Pa; wanted"),
        ("density_kg_per_m3 = 987.6", "density_kg_per_m3 = 1.07", "density_kg_per_m3 = 1.07, .*: is the unit right"),
        ("poisson_ratio = 0.49", "poisson_ratio = 0.5", "poisson_ratio = 0.5: wanted at least 0 and less than 0.5"),
        ("time_s = 0.3", 'time_s = "slow"', r"\[\[maxwell\]\] number 1: time_s = 'slow', wanted a number"),
        ("time_s = 0.3", "time_s = -0.3", "times = .*wanted finite and positive"),
        ("[source]", "[sauce]", "has sauce, wanted left_out, solid, maxwell and source"),
        ("[solid]", "[solid", "holds no material"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path, old, new, message):
    path = write_material(tmp_path / "material.toml", RUBBER)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_material(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.toml holds no material"):
        read_material(tmp_path / "nowhere.toml")
