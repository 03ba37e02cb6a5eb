"""Baselines: names that are known in advance, forces that were planted, and the files that they write."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def baselines() -> ModuleType:
    return importlib.import_module("baselines")


def test_sequential_thresholding_keeps_the_two_terms_of_six_that_made_the_data(baselines):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(400, 6)) * np.array([1.0, 100.0, 1.0, 0.01, 1.0, 1.0])
    y = 3.0 * A[:, 0] - 200.0 * A[:, 3] + 0.1 * rng.normal(size=400)
    x = baselines.sequential_thresholding(A, y)
    assert np.flatnonzero(x).tolist() == [0, 3]
    assert x[[0, 3]] == pytest.approx([3.0, -200.0], rel=0.02)


def test_second_derivative_of_a_sine_with_lost_samples_within_0_3(baselines):
    time = np.linspace(0.0, 1.0, 201)
    track = np.sin(5 * time)
    track[[7, 50, 51, 120]] = np.nan
    found = baselines.smooth_derivative(time, track, 2)
    assert found[10:-10] == pytest.approx(-25 * np.sin(5 * baselines.even_times(time))[10:-10], abs=0.3)


def test_force_network_correlates_with_a_force_against_the_velocity_above_0_9(baselines):
    rng = np.random.default_rng(1)
    x = torch.from_numpy(rng.uniform(-1, 1, size=(3, 4, 10, 7)))
    force = -0.02 * x[..., 4:7].numpy()
    G = rng.normal(size=(200, *force.shape))
    d = np.einsum("rtpwa,tpwa->r", G, force)
    lines = SimpleNamespace(histories=SimpleNamespace(G=G, d=d))
    found = baselines.train(lines, x)(x).detach().numpy()
    assert np.corrcoef(found.ravel(), force.ravel())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("method", "verdict", "named"),
    [
        pytest.param("modulus-and-damping", "explained", {"modulus"}, marks=pytest.mark.slow),  # all that it knows
        pytest.param("all-parameters", "cannot_distinguish", {"density"}, marks=pytest.mark.slow),
        pytest.param("force-network", "unknown_physics", set(), marks=pytest.mark.slow),  # a network has no names
        ("sparse-regression", None, set()),
        pytest.param("one-trial", "explained", {"density"}, marks=pytest.mark.slow),
        pytest.param("force-map", "unknown_physics", set(), marks=pytest.mark.slow),  # no names either, but a place
    ],
)
def test_baselines_answer_in_the_words_of_explain_on_a_body_of_another_density(
    baselines, tmp_path, method, verdict, named
):
    case = ROOT / "tests" / "judged" / "cases" / "case-111"
    baselines.main(baselines.Options(experiment=case, out=tmp_path, method=method, budget=0.5))
    report = json.loads((tmp_path / "explanation.json").read_text())
    assert verdict is None or report["verdict"] == verdict
    assert named <= set(report["set"])
    assert (tmp_path / "model.toml").exists() == (method not in ("force-network", "sparse-regression"))
    assert any(e["location_m"] for e in report["effects"]) == (method == "force-map")
    assert all(row["before"] > 0 and row["after"] > 0 for row in report["heldout"])
