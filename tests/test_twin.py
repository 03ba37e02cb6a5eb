"""The twin of an experiment: its body, markers, loads, and what hypotheses change of them."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import curve_fit
from test_experiment import experiment

from torchsoro.loads import PointMass, attach
from torchsoro.sim2real.experiment import Boundary, Cavity, Load, read_experiment
from torchsoro.sim2real.library import library
from torchsoro.sim2real.scenario import together
from torchsoro.sim2real.twin import Twin

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))


@pytest.fixture
def trial(tmp_path):
    return read_experiment(experiment(tmp_path)).trials[0]


def changed(trial, **changes):
    return dataclasses.replace(trial, setup=dataclasses.replace(trial.setup, **changes))


@pytest.mark.parametrize("size", [(0.04, 0.02, 0.02), (0.041, 0.0187, 0.0213), (0.0395, 0.02, 0.0175)])
@pytest.mark.parametrize("spacing", [0.0025, 0.003])
def test_the_body_has_its_mass_and_centre(trial, size, spacing):
    t = changed(trial, size=size, clamps=())
    twin = Twin(t.setup, spacing=spacing)
    mass = twin.body(twin.scenario(t)).mass.double()
    assert float(mass.sum()) == pytest.approx(1000 * math.prod(size), rel=1e-5)
    center = (mass[:, None] * twin.positions).sum(0) / mass.sum()
    # A cut particle's mass is at its middle, at most half a spacing beside its own.
    assert (center - torch.tensor(t.setup.center)).abs().max() < 1e-5 + 0.01 * spacing


def test_a_clamped_body_goes_on_behind_the_clamp(trial):
    twin = Twin(trial.setup, spacing=0.0025)
    assert float(twin.positions[:, 0].min()) == pytest.approx(-0.01 + 0.00125)
    mass = twin.body(twin.scenario(trial)).mass.double()
    assert float(mass[twin.inside].sum()) == pytest.approx(1000 * 0.04 * 0.02 * 0.02, rel=1e-5)


def test_markers_follow_an_affine_motion(trial):
    markers = [dataclasses.replace(trial.setup.markers[0], name=f"m{i}", at=at) for i, at in enumerate(
        [(0.04, 0.01, 0.02), (0.04, 0.0, 0.0), (0.021, 0.013, 0.026), (0.013, 0.007, 0.011)]
    )]  # fmt: skip
    twin = Twin(dataclasses.replace(trial.setup, markers=tuple(markers)), spacing=0.0025)
    A = torch.tensor([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]], dtype=torch.float64)
    moved = twin.positions @ A.T
    at = torch.tensor([m.at for m in markers], dtype=torch.float64)
    torch.testing.assert_close(torch.einsum("mkc,mk->mc", moved[twin.probes], twin.weights), at @ A.T)
    gradient = torch.einsum("mkc,mkd->mcd", moved[twin.probes], twin.slopes)
    torch.testing.assert_close(gradient, A.expand(4, 3, 3))


@pytest.mark.parametrize("place", [(0.03, 0.01, 0.01), (0.04, 0.02, 0.02), (0.0391, 0.0012, 0.0197)])
def test_what_is_attached_is_centred_on_its_place(trial, place):
    twin = Twin(trial.setup, spacing=0.0025)
    middle = torch.tensor(place, dtype=torch.float64)
    group, share = twin.around(middle)
    assert float(share.sum()) == pytest.approx(1.0) and bool((share >= 0).all())
    # Particles lie within the body: half a spacing short of its faces.
    off = (share @ twin.positions[group] - middle).abs().max()
    assert off <= 0.5001 * 0.0025


def test_a_load_acts_in_the_middle_of_its_box(trial):
    box = ((0.03, 0.006, 0.012), (0.04, 0.013, 0.02))
    t = changed(trial, loads=(Load(box=box, force=(0.0, 0.0, -0.1)),))
    twin = Twin(t.setup, spacing=0.0025)
    force = twin.scenario(t).loads[0]
    center = force.share @ twin.positions[force.particles]
    torch.testing.assert_close(center, torch.tensor([0.035, 0.0095, 0.016], dtype=torch.float64), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clamps": (((-0.001, 0.005, -0.001), (0.0001, 0.021, 0.021)),)}, "wanted one that holds a whole face"),
        ({"planes": (Boundary(point=(0, 0, 0), normal=(0, 1, 1)),)}, "wanted one along x, y or z"),
        ({"mesh": Path("body.stl")}, "wanted a box"),
        (
            {"cavities": (Cavity(name="c", box=((0.01, 0.01, 0.01), (0.011, 0.011, 0.011))),)},
            "narrower than a particle",
        ),
    ],
)
def test_what_the_twin_cannot_do_is_refused(trial, changes, message):
    t = changed(trial, **changes)
    with pytest.raises(ValueError, match=message):
        Twin(t.setup, spacing=0.0025).scenario(t)


@pytest.mark.parametrize("effect", library(), ids=lambda e: e.name)
def test_effects_are_nothing_at_zero(trial, effect):
    t = changed(
        trial,
        loads=(Load(box=((0.03, 0.0, 0.0), (0.04, 0.02, 0.02)), force=(0.0, 0.0, -0.1)),),
        planes=(Boundary(point=(0.0, 0.0, -0.01), normal=(0.0, 0.0, 1.0), friction=0.4),),
    )
    twin = Twin(t.setup, spacing=0.005)
    scenario = twin.scenario(t)
    if not effect.applies(scenario, twin):
        pytest.skip("needs a chamber")
    values = torch.zeros(1, len(effect.quantities), dtype=torch.float64)
    if effect.local:
        values = torch.cat([values, torch.tensor([[0.02, 0.01, 0.01]], dtype=torch.float64)], 1)
    same = effect(scenario, values, twin)
    assert len(effect.quantities) <= 3
    for name in ("stiffness", "density", "poisson_ratio", "viscosity", "gravity", "velocity"):
        one, other = getattr(same, name), getattr(scenario, name)
        assert torch.equal(one.broadcast_to(torch.broadcast_shapes(one.shape, other.shape)), other.expand_as(one)), name
    assert same.duration == scenario.duration
    weight = twin.body(scenario).mass
    for load in same.loads[len(scenario.loads) :]:
        assert not isinstance(load, PointMass)
        attached = attach(twin.body(scenario), [load])
        assert torch.equal(attached.body.mass, weight)
        for added in (attached.spring, attached.drag):
            assert added is None or not bool(added.any())


def test_trials_in_a_batch_move_as_alone(trial):
    twin = Twin(trial.setup, spacing=0.005)
    loaded = changed(trial, loads=(Load(box=((0.03, 0.0, 0.0), (0.04, 0.02, 0.02)), force=(0.0, 0.0, -0.05)),))
    scenarios = [twin.scenario(trial), twin.scenario(loaded)]
    tether = next(e for e in library() if e.name == "tether")
    values = torch.tensor([[0.0, 0.0, 0.04, 0.01, 0.02], [3.0, 0.1, 0.04, 0.01, 0.02]], dtype=torch.float64)
    varied = [tether(s, values, twin) for s in scenarios]
    whole = together(varied, 2)
    assert whole is not None
    for part, alone in zip(twin.simulate(whole).parts(2), map(twin.simulate, varied), strict=True):
        torch.testing.assert_close(part.place, alone.place, atol=1e-7, rtol=0)


@pytest.mark.parametrize("across", [3, 4])
def test_a_clamped_bar_has_the_frequency_of_its_length(trial, across):
    from structures import timoshenko

    from torchsoro import Solid

    length, width = 0.1, 0.025
    t = changed(
        trial,
        size=(length, width, width),
        clamps=(((-0.001, -0.001, -0.001), (0.0001, 0.026, 0.026)),),
        markers=(dataclasses.replace(trial.setup.markers[0], at=(length, width / 2, width / 2)),),
        poisson_ratio=0.0,
        prony=(),
        gravity=(0.0, 0.0, -1.0),
        duration=0.5,
    )
    motion = Twin(t.setup, spacing=width / across / 2)
    motion = motion.simulate(motion.scenario(t))
    z, time = (motion.place[:, 0, 2] - motion.place[0, 0, 2]).numpy(), motion.time.numpy()
    exact = timoshenko(length, width, Solid(youngs_modulus=1e5, poisson_ratio=0.0, density=1000.0))
    fitted, _ = curve_fit(
        lambda t, c, a, w, p: c + a * np.cos(w * t + p),
        time,
        z / abs(z).max(),
        p0=(-0.5, 0.5, 2 * math.pi * exact, 0.0),
    )
    assert abs(fitted[2]) / (2 * math.pi) == pytest.approx(exact, rel=0.006)
