"""The recipe ``simulator.py`` on small settings: what it prints must agree with the closed forms."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import ModuleType

import pytest

from torchsoro import Solid

RECIPES = Path(__file__).parents[1] / "recipes"


@pytest.fixture(scope="module")
def recipes() -> tuple[ModuleType, ModuleType]:
    return importlib.import_module("simulator"), importlib.import_module("structures")


def test_timoshenko_tends_to_euler_and_bernoulli_for_a_slender_bar(recipes):
    _, structures = recipes
    solid = Solid()
    slender = [
        1.8751041**2 / (2 * math.pi) * w * math.sqrt(solid.youngs_modulus / (12 * solid.density)) for w in (0.01, 0.3)
    ]
    ratios = [structures.timoshenko(1.0, w, solid) / f for w, f in zip((0.01, 0.3), slender, strict=True)]
    assert ratios[0] == pytest.approx(1, abs=1e-3)
    assert 0.9 < ratios[1] < 0.95


@pytest.mark.slow
def test_bar_frequency_is_within_three_percent_of_timoshenko(recipes):
    _, structures = recipes
    rows, _ = structures.bar(cells=(3,), poisson=(0.4,), duration=0.4)
    assert abs(rows[0]["error [%]"]) < 3


@pytest.mark.slow
def test_bar_frequency_converges_with_the_cell(recipes):
    _, structures = recipes
    rows, orders = structures.bar(cells=(2, 3), poisson=(0.0,), forms=("flip",), duration=0.4)
    assert abs(rows[1]["error [%]"]) < abs(rows[0]["error [%]"]) < 8
    assert next(iter(orders.values())) > 1


@pytest.mark.slow
def test_flip_hardly_damps_a_bar_and_the_total_form_not_at_all(recipes):
    _, structures = recipes
    rows = {row["form"]: row for row in structures.damping(cases=((3, 131e-6),), duration=0.6)}
    apic, flip, total = rows["apic"], rows["flip"], rows["total"]
    assert abs(total["damping"]) <= 0.001
    assert 0 < flip["damping"] <= 0.007
    assert apic["damping"] > 2 * flip["damping"]


@pytest.mark.slow
def test_held_bent_positions_of_the_updated_form_leave_f_behind_and_those_of_the_total_do_not(recipes):
    creep = importlib.import_module("creep").creep
    rows = creep(cases=(("total", 3, 0.0), ("apic", 3, 0.0)), ends=(0.1, 0.3))
    ratio = {
        form: [r["positions' curvature [1/m]"] / r["that of F [1/m]"] for r in rows if r["form"] == form]
        for form in ("total", "apic")
    }
    assert ratio["total"][1] == pytest.approx(ratio["total"][0], rel=1e-3)
    assert ratio["apic"][1] > 1.02 * ratio["apic"][0]
    assert ratio["apic"][1] > 1.07 * ratio["total"][1]


def test_pressurised_sphere_follows_lame(recipes):
    _, structures = recipes
    for row in structures.sphere(cells=(4, 6)):
        assert row["displacement/Lame"] == pytest.approx(1, abs=0.05)
        assert row["cavity/Lame"] == pytest.approx(1, abs=0.05)


def test_discrete_moduli_are_within_one_percent_of_eq_17(recipes):
    validate, _ = recipes
    for row in validate.rheology(cases=((3, 1e-5), (5, 8e-6))):
        assert abs(row["G' error [%]"]) < 1
        assert abs(row['G" error [%]']) < 1


def test_kernel_history_follows_a_shear_ramp(recipes):
    validate, _ = recipes
    rows = validate.ramp(elements=5, steps=500)
    assert {row["form"] for row in rows} == {"apic", "total"}
    assert len(rows) == 10
    assert max(row["error [%]"] for row in rows) < 1e-3


def test_more_maxwell_elements_take_more_of_the_rebound(recipes):
    validate, _ = recipes
    rows, curves = validate.restitution(sizes=(4,))
    for form in {row["form"] for row in rows}:
        found = [row["restitution"] for row in rows if row["form"] == form]
        assert found == sorted(found, reverse=True), form
        assert len(found) == 3
    assert curves


def test_five_elements_are_stable_at_the_papers_step_and_not_far_above(recipes):
    grows = importlib.import_module("motion_checks").grows
    assert not grows(5, 1.0e-5, form="apic", solid=Solid(), steps=500)
    assert grows(5, 1.2e-5, form="apic", solid=Solid(), steps=500)


def test_free_flight_conserves_momentum(recipes):
    validate, _ = recipes
    for row in validate.fall(steps=500):
        assert max(row["path"], row["momentum"]) < 1e-12
        assert row["angular momentum"] < (1e-12 if row["form"] == "apic" else 1e-3)


def test_tables_and_figures(recipes, tmp_path, capsys):
    validate, _ = recipes
    rows, curves = validate.restitution(elements=(0,), sizes=(2,))
    validate.draw_restitution(tmp_path / "restitution.png", curves)
    validate.draw_rheology(tmp_path / "rheology.png")
    validate.draw_bar(tmp_path / "bar.png", [{"form": "total", "nu": 0.4, "cells": 3, "error [%]": -1.0}])
    assert all((tmp_path / f"{name}.png").stat().st_size > 5000 for name in ("restitution", "rheology", "bar"))
    validate.show("Title", rows)
    lines = capsys.readouterr().out.split("\n")
    assert "Title" in lines
    header = next(line for line in lines if "restitution" in line and "edge" in line)
    assert len(lines[lines.index(header) + 1]) == len(header)
