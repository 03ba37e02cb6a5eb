"""The likelihood that nested sampling integrates is that of Laplace's approximation, where both are simulated."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest
from ringing import bar, effect
from scipy.optimize import brentq

from torchsoro.sim2real.inference.candidates import data_of, near
from torchsoro.sim2real.inference.evidence import Discrepancy, grams, time_range
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.laplace import posterior
from torchsoro.sim2real.inference.state_space import total

nested = importlib.import_module("nested")


@pytest.fixture(scope="module")
def dragged(tmp_path_factory):
    """A problem with a bar in a fluid, the fit of drag, and the model near it."""
    twin, record = bar(tmp_path_factory.mktemp("bar"))
    problem = FitProblem(record("drag", (600.0,)), twin)
    (fit,) = problem.fit([((effect("drag"),), np.array([0.0, 20.0]))], rounds=6)
    (found,) = near(problem, [fit])
    return problem, fit, found


@pytest.mark.slow
def test_likelihood_at_the_best_point_is_that_of_the_linear_model(dragged):
    problem, fit, found = dragged
    data, count = data_of(problem), len(fit.point)
    place = [
        brentq(lambda u, p=p, x=x: float(p.quantile(np.array([u]))[0]) - x, 1e-9, 1 - 1e-9)
        for p, x in zip(found.model.priors[:count], found.at[:count], strict=True)
    ]
    low, high = time_range(data)
    cube = np.array([[*place, 0.25, 0.5, 1.0], [*place[:-1], 0.9 * place[-1], 0.25, 0.5, 1.0]])
    best, beside = nested.likelihood(problem, fit, found)(cube)
    faults = dataclasses.replace(
        found,
        model=dataclasses.replace(found.model, priors=found.model.priors[count:], own=(), stated=(), released=()),
        at=found.at[count:],
        slopes=tuple(J[..., count:] for J in found.slopes),
    )
    discrepancy = Discrepancy(data.shares[0], float(np.exp((low + high) / 2)))
    gram = total(grams(data, faults, discrepancy))
    assert best == pytest.approx(posterior(gram, faults.at, faults.model.priors).ln_evidence, abs=1e-3)
    assert beside < best - 10
