"""The recipe ``benchmark.py`` on small settings."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch

RECIPES = Path(__file__).parents[1] / "recipes"


@pytest.fixture(scope="module")
def benchmark() -> Iterator[ModuleType]:
    sys.path.insert(0, str(RECIPES))
    try:
        yield importlib.import_module("benchmark")
    finally:
        sys.path.remove(str(RECIPES))


@pytest.mark.parametrize("count", [512, 2000, 4096, 8000, 64_000])
def test_body_has_about_the_particles_asked_for_and_a_chamber(benchmark, count):
    domain = benchmark.walker(count)
    assert domain.count == pytest.approx(count, rel=0.05)
    assert domain.gas.any() and domain.wall.any() and domain.design.any()


def test_paper_size_is_the_papers_walker(benchmark):
    domain = benchmark.walker(64_000)
    assert domain.cell == pytest.approx(1.75e-3)
    assert (int(domain.gas.sum()), int(domain.wall.sum())) == (4096, 3904)


def test_measures_every_case(benchmark):
    row = benchmark.measure(512, device=torch.device("cpu"), steps=4, repeats=1)
    assert row["particles"] == 512
    for name in ("forward", "kept", "recomputed"):
        assert row[f"{name} [us/step]"] * row[f"{name} [M/s]"] == pytest.approx(512)


def test_prints_a_line_for_each_size(benchmark, capsys):
    benchmark.main(particles=(512,), device="cpu", steps=4, repeats=1)
    out = capsys.readouterr().out.splitlines()
    assert "CPU threads" in out[0]
    assert out[2].split()[0] == "512"
