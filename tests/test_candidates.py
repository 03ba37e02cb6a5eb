"""Fits of a small bar weighed by evidence."""

from __future__ import annotations

import dataclasses
import math

import pytest
from ringing import bar, effect

from torchsoro.sim2real.inference.candidates import data_of, model_of, responses, weigh
from torchsoro.sim2real.inference.conclusion import conclude
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.visible import limit
from torchsoro.sim2real.twin.twin import Twin

NAMES = ("density",)


@pytest.fixture(scope="module")
def weighed(tmp_path_factory):
    """A bar that is a half heavier than believed, and one that is as believed."""
    twin, record = bar(tmp_path_factory.mktemp("bar"))
    middle, fine = (Twin(twin.setup, edge=e, across=n) for e, n in ((0.0075, 3), (0.006, 4)))
    found = {}
    for name, values in (("density", (math.log(1.5),)), (None, ())):
        problem = FitProblem(record(name, values, by=fine), twin)
        tasks = [((), None), *(((effect(n),), None) for n in NAMES)]
        fits = [f for f in problem.fit(tasks, rounds=5) if f is not None]
        found[name] = problem, fits, weigh(problem, fits, middle, fine, names=20)
    return found


def test_a_heavier_bar_is_explained_by_its_density(weighed):
    _, _, weighing = weighed["density"]
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("explained", ("density",))
    own = found.candidates[0].best
    # A bar that swings by itself tells the ratio of density and modulus only.
    ln_modulus, ln_density = 0.1 * own.mode.at[:2]
    assert ln_density - ln_modulus == pytest.approx(math.log(1.5), abs=0.02)
    assert ln_modulus == pytest.approx(0.0, abs=0.15)


def test_nothing_is_named_in_a_bar_that_is_as_believed(weighed):
    problem, fits, weighing = weighed[None]
    seen = limit(weighing.data, weighing.null, responses(problem, [effect(n) for n in NAMES], fits[0]), 1.0, 20)
    assert 0.0 < seen < 0.1 * weighing.data.size
    found = conclude(weighing, limit=0.0)
    assert (found.kind, found.chosen) == ("nothing_missing", ())
    assert found.probabilities["nothing"] > 0.95


def test_trials_that_are_only_predicted_change_no_evidence(weighed):
    problem, _, weighing = weighed["density"]
    trial = dataclasses.replace(problem.trials[0], name="other")
    other = FitProblem(dataclasses.replace(problem.experiment, heldout=(trial,)), problem.twin)
    assert [t.name for t in data_of(other).trials] == [t.name for t in weighing.data.trials]


def test_priors_are_those_of_quantities(weighed):
    problem = weighed[None][0]
    mass = model_of(problem, (effect("attached_mass"),))
    assert [p.low for p in mass.priors[1:5]] == [0.0, 0.0, 0.0, 0.0]
    assert [p.high for p in mass.priors[2:5]] == [10.0, 10.0, 10.0]
    assert mass.own == (1, 2, 3, 4)
    assert model_of(problem, (effect("tether"),)).simpler == ("attached_mass",)
    assert model_of(problem, (effect("modulus"),)).own == (0,)  # the belief is held
    shape = model_of(problem, (effect("viscoelastic"),)).priors[2]
    assert math.isinf(shape.scale)
    assert (shape.low, shape.high) == (-9.0, 1.5)
