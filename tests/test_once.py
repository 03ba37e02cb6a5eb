"""What the segments of a run have in common is computed once, and again where a tensor has changed."""

from __future__ import annotations

import weakref
from dataclasses import replace

import pytest
import torch
from problems import problem

from torchsoro.simulation.ops.once import once
from torchsoro.simulation.ops.scene import Inputs
from torchsoro.simulation.ops.total import TotalSegmentIntegrator


@pytest.fixture
def scene():
    return replace(problem(formulation="total", steps=1, samples=()).scene, steady=True)


def test_a_steady_scene_computes_once_for_the_same_tensor(scene):
    x, calls = torch.ones(3), []
    found = [once(scene, "sum", [part], lambda: calls.append(0) or object()) for part in (x, x.detach(), x.view(3))]
    assert len(calls) == 1
    assert found[0] is found[1] is found[2]


@pytest.mark.parametrize("change", [lambda x: x.add_(1), torch.clone, lambda x: x[:2], lambda x: x.view(3, 1)])
def test_another_tensor_or_a_change_in_place_is_computed_again(scene, change):
    x = torch.ones(3)
    assert once(scene, "sum", [x], lambda: 1) == 1
    assert once(scene, "sum", [change(x)], lambda: 2) == 2


def test_other_scenes_and_tensors_without_a_version_are_computed_every_time(scene):
    x = torch.ones(3)
    for given, name in ((x, "other"), (torch.inference_mode()(torch.ones)(3), "inference")):
        on = replace(scene, steady=False) if name == "other" else scene
        assert [once(on, name, [given], lambda k=k: k) for k in range(2)] == [0, 1]


def test_what_is_kept_goes_with_its_scene(scene):
    last = replace(scene)
    gone = weakref.ref(once(last, "kept", [torch.ones(3)], lambda: torch.zeros(2)))
    assert gone() is not None
    del last
    assert gone() is None


def test_integrators_of_a_run_share_constants_until_the_coefficients_change():
    p = problem(formulation="total", batch=2)
    inputs = Inputs(**{name: t for name, t in p.tensors.items() if name not in ("state", "weight")})
    steady = replace(p.scene, steady=True)
    first, second = (TotalSegmentIntegrator(steady, inputs, first=0, samples=()) for _ in range(2))
    assert first.fixed is second.fixed
    inputs.coefficients.mul_(1.01)
    third = TotalSegmentIntegrator(steady, inputs, first=0, samples=())
    fresh = TotalSegmentIntegrator(p.scene, inputs, first=0, samples=())
    assert not torch.equal(third.fixed.buffer, first.fixed.buffer)
    assert torch.equal(third.fixed.buffer, fresh.fixed.buffer)
