"""Risk functionals over scenarios: closed forms, gradients, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch

from torchsoro.design.risk import CVaR, Mean, Worst, parse_risk

VALUES = torch.tensor([3.0, -1.0, 4.0, 1.5, -5.0, 9.0, 2.0, 6.0], dtype=torch.float64)


def test_cvar_is_the_largest_of_its_dual_form():
    # Rockafellar and Uryasev, of returns: max over t of t - mean(relu(t - values)) / level, attained at a value.
    for level in (0.05, 0.125, 0.3, 0.5, 0.77, 1.0):
        dual = max(float(t - torch.relu(t - VALUES).mean() / level) for t in VALUES)
        assert float(CVaR(level)(VALUES)) == pytest.approx(dual, rel=1e-12)


def test_cvar_counts_the_scenario_at_the_border_in_part():
    assert float(CVaR(0.3)(VALUES)) == pytest.approx((-5.0 - 1.0 + 0.4 * 1.5) / 2.4, rel=1e-14)
    assert float(CVaR(0.25)(VALUES)) == -3.0


def test_cvar_of_evenly_spread_values_is_half_its_level():
    values = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 10_000
    assert float(CVaR(0.3)(values.flip(0))) == pytest.approx(0.15, rel=1e-9)


def test_the_ends_of_cvar_are_mean_and_worst():
    assert float(CVaR(1)(VALUES)) == pytest.approx(float(Mean()(VALUES)), rel=1e-15)
    for level in (1e-9, 0.125):
        assert float(CVaR(level)(VALUES)) == float(Worst()(VALUES)) == -5.0


@pytest.mark.parametrize("risk", [Mean(), Worst(), CVaR(0.3)])
def test_gradients_are_central_differences_and_sum_to_one(risk):
    values = VALUES.clone().requires_grad_()
    assert torch.autograd.gradcheck(risk, values)
    (gradient,) = torch.autograd.grad(risk(values), values)
    assert float(gradient.sum()) == pytest.approx(1, rel=1e-14)
    assert (gradient >= 0).all()


def test_a_risk_is_named_by_a_text():
    assert isinstance(parse_risk("mean"), Mean) and isinstance(parse_risk("worst"), Worst)
    found = parse_risk("cvar:0.3")
    assert isinstance(found, CVaR) and found.level == 0.3


@pytest.mark.parametrize("text", ["", "cvar", "cvar:", "cvar:x", "Mean", "worst:0.1", "median"])
def test_another_text_is_refused(text):
    with pytest.raises(ValueError, match=r"risk = '.*': wanted 'mean', 'worst' or 'cvar:'"):
        parse_risk(text)


@pytest.mark.parametrize("level", [0.0, -0.1, 1.0001, math.nan, math.inf])
def test_a_level_outside_0_to_1_is_refused(level):
    with pytest.raises(ValueError, match=r"risk = 'cvar:.*': wanted a level of more than 0 and at most 1"):
        parse_risk(f"cvar:{level}")
    with pytest.raises(ValueError, match=r"level = .*: wanted a fraction of the scenarios, more than 0 and at most 1"):
        CVaR(level)


def test_values_of_another_shape_are_refused():
    for values in (torch.zeros(()), torch.zeros(2, 3), torch.zeros(0)):
        with pytest.raises(ValueError, match=r"values: shape .*, wanted \[S\]"):
            CVaR(0.5)(values)
