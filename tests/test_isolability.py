"""What an experiment can tell: a chain of masses in closed form, and a bar."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from ringing import effect
from scipy.integrate import solve_ivp

from torchsoro.sim2real.hypotheses.body_effects import Density, Modulus
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis, Quantity
from torchsoro.sim2real.inference.cosines import Response, cleared, compare, first_seen, imitation, settle
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.isolability import isolability
from torchsoro.sim2real.inference.likelihood import Tolerances
from torchsoro.sim2real.inference.next_experiment import REPEAT, Proposal, advice, next_experiment
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inference.verdict import weighed
from torchsoro.sim2real.report.drawings import draw_cosines
from torchsoro.sim2real.report.explanation import Explanation, as_json
from torchsoro.sim2real.report.sentences import evidence
from torchsoro.sim2real.twin.scenario import Scenario

# A chain: four masses between springs, from a wall on; two of them are seen. ----------------------------------------

MASS, SPRING, LOSS, NOISE = 0.05, 40.0, 0.02, 1e-4
NODES, SEEN = 4, (1, 3)
TIME = np.linspace(0.0, 1.5, 61)
K = SPRING * (2 * np.eye(NODES) - np.eye(NODES, k=1) - np.eye(NODES, k=-1))
K[-1, -1] = SPRING
RATES, MODES = np.linalg.eigh(K / MASS)  # squared natural frequencies


def answer(node: int) -> np.ndarray:
    """Places of the masses that are seen [61, 2] under a unit step force, by modes: m q'' + c q' + k q = phi."""
    decay = LOSS / (2 * MASS)
    w = np.sqrt(RATES - decay**2)
    t = TIME[:, None]
    q = (1 - np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t))) * MODES[node] / (MASS * RATES)
    return (q @ MODES.T)[:, SEEN]


def simulated(force: np.ndarray) -> np.ndarray:
    """The same by integration."""

    def rate(_, y):
        x, v = np.split(y, 2)
        return np.concatenate([v, (force - LOSS * v - K @ x) / MASS])

    found = solve_ivp(rate, (0, TIME[-1]), np.zeros(2 * NODES), t_eval=TIME, rtol=1e-9, atol=1e-12)
    return found.y[:NODES].T[:, SEEN]


def columns() -> np.ndarray:
    """Whitened change by a unit force at each node [122, 4]."""
    return np.stack([answer(k).ravel() for k in range(NODES)], -1) / NOISE


OFFSETS = np.tile(np.eye(2), (len(TIME), 1)) / NOISE  # whitened change by where each sensor is [122, 2]
PRIOR = np.full(2, 1 / 1e-3)  # each is known to 1 mm


def test_modes_are_what_the_chain_does():
    np.testing.assert_allclose(simulated(np.array([0.0, 0.3, 0.0, 0.0])), 0.3 * answer(1), atol=1e-8)


def test_projection_off_nuisances_gives_the_generalised_least_squares_chi2():
    left = cleared(columns(), OFFSETS, PRIOR)
    # Marginal covariance of the samples once the offsets have their priors.
    covariance = np.eye(len(OFFSETS)) + OFFSETS @ np.diag(PRIOR**-2) @ OFFSETS.T
    gram = columns().T @ np.linalg.solve(covariance, columns())
    np.testing.assert_allclose(left.T @ left, gram, rtol=1e-8)
    cosine = gram[0, 1] / math.sqrt(gram[0, 0] * gram[1, 1])
    assert imitation(left[:, 0], left[:, 1:2], np.array([False])) == pytest.approx(cosine, rel=1e-6)
    rest = gram[1:, 1:]
    most = gram[0, 1:] @ np.linalg.solve(rest, gram[1:, 0]) / gram[0, 0]
    assert imitation(left[:, 0], left[:, 1:], np.full(3, True)) == pytest.approx(math.sqrt(most), rel=1e-6)


def test_cosine_with_a_one_sided_effect_of_opposite_sign_is_zero():
    v = columns()[:, 0]
    assert imitation(v, -v[:, None], np.array([False])) == pytest.approx(0.0, abs=1e-6)
    assert imitation(v, -v[:, None], np.array([True])) == pytest.approx(1.0)
    assert imitation(v, 0 * v[:, None], np.array([True])) == imitation(0 * v, v[:, None], np.array([True])) == 0.0


@pytest.mark.parametrize("node", range(NODES))
def test_screening_finds_the_node_where_a_force_was_planted(node):
    rng, strength = np.random.default_rng(node), 0.2
    force = strength * np.eye(NODES)[node]
    offset = 1e-3 * rng.normal(size=2)
    recorded = simulated(force) + offset + NOISE * rng.normal(size=(len(TIME), 2))
    left = cleared(np.column_stack([recorded.ravel() / NOISE, columns()]), OFFSETS, PRIOR)
    r, candidates = left[:, 0], left[:, 1:]
    lengths = np.linalg.norm(candidates, axis=0)
    strengths = candidates.T @ r / lengths**2
    chi2s = r @ r - strengths**2 * lengths**2
    assert chi2s.argmin() == node
    deviation = 1 / lengths[node]
    assert abs(strengths[node] - strength) < 4 * deviation
    assert chi2s[node] == pytest.approx(2 * len(TIME), rel=0.4)
    # How far another node stays behind: what of the planted change it cannot imitate.
    for k in set(range(NODES)) - {node}:
        alike = imitation(candidates[:, node], candidates[:, k : k + 1], np.array([True]))
        expected = (strength * lengths[node]) ** 2 * (1 - alike**2)
        assert chi2s[k] - chi2s[node] == pytest.approx(expected, rel=0.15)


def test_detectable_forces_and_cosines_on_a_chain_match_closed_form():
    changes = columns()
    none = np.zeros((len(changes), 0))
    responses = [
        Response(paths=((np.ones(1), c[:, None]),), cones=((c[:, None], np.array([False])),), either=True)
        for c in (*changes.T, changes[:, 0], 0 * changes[:, 0])
    ]
    seen, alike = compare(responses, none, lambda x: x)
    lengths = np.linalg.norm(changes, axis=0)
    np.testing.assert_allclose(seen[:NODES], math.sqrt(40.0) / lengths, rtol=2e-3)
    cosines = np.abs(changes.T @ changes) / np.outer(lengths, lengths)
    np.testing.assert_allclose(alike[:NODES, :NODES], cosines, atol=1e-6)
    assert alike[0, NODES] == alike[NODES, 0] == pytest.approx(1.0)
    assert math.isinf(seen[-1]) and not alike[-1, :-1].any() and not alike[:-1, -1].any()


def test_a_common_unknown_takes_up_what_its_belief_allows():
    """The effect is the unknown itself: it stands out where its value is hard to believe."""
    change = columns()[:, :1]

    def prior_residual(x):
        return np.hypot(0.3 * x, np.maximum(np.abs(x) - 1, 0) / 0.15)

    length, slopes = settle(0.5 * change[:, 0], change, prior_residual)
    assert length == pytest.approx(0.15, rel=1e-3) and slopes == pytest.approx(0.3, rel=1e-3)
    found, _ = first_seen(np.ones(1), change, change, prior_residual, 40.0)
    assert float(prior_residual(np.array([found]))[0]) == pytest.approx(math.sqrt(40.0), rel=0.01)


def test_detectable_strength_of_an_effect_with_a_threshold():
    v = columns()[:, 0] / np.linalg.norm(columns()[:, 0])
    changes = np.stack([0 * v, 20 * v], -1)
    found, change = first_seen(np.array([1.0, 3.0]), changes, np.zeros((len(v), 0)), lambda x: x, 40.0)
    assert found == pytest.approx(1 + 2 * math.sqrt(40) / 20, rel=2e-3)
    assert change @ v == pytest.approx(math.sqrt(40), rel=2e-3)


# A bar ------------------------------------------------------------------------------------------------------------


class Twice(Density):
    """Density again, under another name."""

    name = "twice"


class Idle(Hypothesis):
    """Changes nothing."""

    name, affected_quantity = "idle", "nothing"
    quantities = (Quantity("amount", "1", 1.0, 0.0, 10.0),)
    starts = ((1.0,),)

    def forward(self, scenario: Scenario, values: torch.Tensor, twin) -> Scenario:
        return scenario


class Broken(Idle):
    """Breaks down."""

    name = "broken"

    def forward(self, scenario: Scenario, values: torch.Tensor, twin) -> Scenario:
        return scenario.replace(displacement=scenario.displacement + math.nan * values[:, :, None])


@pytest.fixture(scope="module")
def problem(made):
    """From rest, under its own weight, believed to be springy: no time but that of density and modulus."""
    twin, record = made
    recorded = record(None)
    return FitProblem(recorded, twin, trials=recorded.trials[:1])


@pytest.fixture(scope="module")
def screened(problem):
    names = ("modulus", "density", "attached_mass", "drag", "gravity_tilt")
    return isolability(problem, [*map(effect, names), Twice(), Idle(), Broken()])


def test_cosine_of_identical_effects_is_one(screened):
    at = {name: i for i, name in enumerate(screened.effects)}
    density, twice = at["density"], at["twice"]
    assert screened.cosines[density, twice] == pytest.approx(1.0, abs=1e-6)
    assert screened.cosines[twice, density] == pytest.approx(1.0, abs=1e-6)
    assert ("density", "twice") in screened.confused()
    np.testing.assert_array_equal(np.diag(screened.cosines), 1.0)
    assert (screened.cosines >= 0).all() and (screened.cosines <= 1 + 1e-9).all()


def test_from_rest_density_is_modulus_and_a_mass_at_the_tip_is_more_like_it_than_like_drag(problem):
    """With a modulus that is known well: within a wide belief, it takes up most of what a mass does."""
    trial, names = problem.trials[0], ("modulus", "density", "attached_mass", "drag")
    sure = FitProblem(problem.experiment, problem.twin, trials=(trial,), tolerances=Tolerances(modulus=1e-3))
    modulus, density, mass, drag = range(4)
    found = isolability(sure, [effect(name) for name in names])
    assert found.cosines[density, modulus] > 0.97 and found.cosines[modulus, density] > 0.97
    assert ("density", "modulus") in found.confused()
    assert found.cosines[mass, density] > found.cosines[mass, drag] + 0.05
    assert found.cosines[mass, drag] < 0.97


def test_effect_without_response_or_whose_simulation_breaks_down_is_never_detectable(screened):
    idle, broken = screened.effects.index("idle"), screened.effects.index("broken")
    assert np.isinf(screened.detectable[[idle, broken]]).all()
    assert np.isfinite(np.delete(screened.detectable, [idle, broken])).all()
    for k in (idle, broken):
        assert not np.delete(screened.cosines[k], k).any() and not np.delete(screened.cosines[:, k], k).any()
    answer = json.loads(json.dumps(screened.as_json()))
    assert answer["detectable"][idle]["value"] is None and answer["effects"][idle] == "idle"
    draw_cosines(screened)


def test_recorded_places_do_not_count(problem, screened):
    trial = problem.trials[0]
    place = trial.recording.position + 0.1 * np.random.default_rng(0).normal(size=trial.recording.position.shape)
    other = dataclasses.replace(trial, recording=dataclasses.replace(trial.recording, position=place))
    again = isolability(problem.only([other]), [effect("drag"), effect("density")])
    drag = screened.effects.index("drag")
    assert again.detectable[0] == pytest.approx(screened.detectable[drag], rel=0.02)


def test_a_known_pull_tells_density_from_modulus(problem):
    """Motion under the own weight knows modulus over density only; Maxwell elements' times are in neither."""
    before = problem.tally.simulations
    heavy, soft = ((Density(),), np.array([0.0, 3.0])), ((Modulus(),), np.array([0.0, -3.0]))
    proposals = next_experiment(problem, heavy, soft)
    assert problem.tally.simulations - before < 64
    same = next(p for p in proposals if p.words == REPEAT)
    best = proposals[0]
    assert same.cosine > 0.97 and same.distance < 10
    assert "pull" in best.words and best.cosine < 0.9 and best.distance > 100
    assert advice(proposals).startswith("To tell them apart, record next: the same with a pull of")
    assert advice([Proposal(words=REPEAT, cosine=1.0, distance=0.0)]).startswith("None of the trials")
    assert not advice([])


def test_the_lead_names_the_next_experiment_where_effects_are_not_told_apart(problem, screened):
    density, null_model = problem.fit([((effect("density"),), None), ((), None)], rounds=1)
    verdict = weighed(problem, [effect("density")], null_model, [density], report=lambda line: None)
    verdict = dataclasses.replace(verdict, kind="cannot_distinguish", chosen=verdict.ranking * 2)
    found = Explanation(
        problem=problem,
        discretization=DiscretizationError(edges=(0.01,), walls=(2,)),
        verdict=verdict,
        before=(),
        after=(),
        heldout=(),
        seconds=1.0,
        isolability=screened,
        following=(
            Proposal(words="the same for 9 s", cosine=0.5, distance=900.0),
            Proposal(words=REPEAT, cosine=1.0, distance=0.0),
        ),
    )
    assert any(s.startswith("To tell them apart, record next: the same for 9 s;") for s in evidence(found))
    assert as_json(found, {})["next"][0] == {"record": "the same for 9 s", "alike": 0.5, "distance": 900.0}
    explained = dataclasses.replace(found, verdict=dataclasses.replace(verdict, kind="explained"))
    assert not any("record next" in s for s in evidence(explained))
