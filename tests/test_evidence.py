"""Evidence against exact integrals: covariances in state-space form, Laplace's approximation, discrepancies."""

from __future__ import annotations

import dataclasses
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from swings import AXES, EXACT, recorded

from torchsoro.sim2real.inference import evidence
from torchsoro.sim2real.inference.decision import MATTERS
from torchsoro.sim2real.inference.evidence import (
    Discrepancy,
    Model,
    adjusted,
    errors,
    grams,
    infer,
    leave_one_out,
)
from torchsoro.sim2real.inference.laplace import ln_box, posterior
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.state_space import ErrorModel, Gram, Process, integrated, total

# Covariances ---------------------------------------------------------------------------------------------------------


@st.composite
def recordings(draw):
    """Uneven times, columns with lost samples, and errors with processes that markers share or have alone."""
    seed = draw(st.integers(0, 2**32 - 1))
    count, markers, axes = draw(st.integers(1, 12)), draw(st.integers(1, 3)), draw(st.integers(1, 2))
    times = draw(st.lists(st.floats(1e-3, 10.0), max_size=3))
    rng = np.random.default_rng(seed)
    time = np.cumsum(10 ** rng.uniform(-4, 0, count))
    values = rng.normal(size=(count, markers, axes, 3))
    values[rng.random((count, markers, axes)) < 0.2, 0] = np.nan
    processes = []
    for tau in times:
        loading = rng.uniform(0, 1, (axes, markers, 1 + markers))
        loading[:, :, 1:] *= np.eye(markers)
        processes.append(Process(time=tau, loading=loading))
    return time, values, ErrorModel(white=rng.uniform(0.05, 1.0, (axes, markers)), processes=tuple(processes))


def dense(model, time, values):
    """Products of columns and ln det by the whole covariance."""
    product, ln_det, count = np.zeros((values.shape[-1],) * 2), 0.0, 0
    for axis in range(values.shape[2]):
        x = np.swapaxes(values[:, :, axis], 0, 1).reshape(-1, values.shape[-1])
        seen = np.isfinite(x[:, 0])
        covariance, x = model.dense(time, axis)[np.ix_(seen, seen)], x[seen]
        product += x.T @ np.linalg.solve(covariance, x) if len(x) else 0.0
        ln_det += float(np.linalg.slogdet(covariance)[1]) if len(x) else 0.0
        count += len(x)
    return product, ln_det, count


@given(recordings())
def test_state_space_form_equals_the_dense_covariance_to_1e_9(case):
    time, values, model = case
    gram = model.gram([(time, values)])
    product, ln_det, count = dense(model, time, values)
    assert gram.count == count
    assert gram.product == pytest.approx(product, rel=1e-9, abs=1e-9 * max(np.abs(product).max(), 1e-300))
    assert gram.ln_det == pytest.approx(ln_det, rel=1e-9, abs=1e-9)


@given(recordings(), st.integers(1, 11))
def test_a_recording_in_two_parts_has_the_products_of_the_whole(case, cut):
    time, values, model = case
    parts = [(time[:cut], values[:cut]), (time[cut:], values[cut:])]
    whole, pieces = model.gram([(time, values)]), model.gram(p for p in parts if len(p[0]))
    assert pieces.product == pytest.approx(whole.product, rel=1e-12, abs=1e-12)
    assert pieces.ln_det == pytest.approx(whole.ln_det, rel=1e-12, abs=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_errors_that_move_all_markers_are_those_of_the_dense_covariance_with_them(seed, modes):
    rng = np.random.default_rng(seed)
    root, X, D = (
        rng.normal(size=(9, 9)),
        rng.normal(size=(9, 3)),
        10 ** rng.uniform(-3, 3) * rng.normal(size=(9, modes)),
    )
    C, columns = root @ root.T + np.eye(9), np.concatenate([X, D], 1)
    gram = Gram(product=columns.T @ np.linalg.solve(C, columns), ln_det=float(np.linalg.slogdet(C)[1]), count=9)
    found, whole = integrated(gram, modes), C + D @ D.T
    assert found.product == pytest.approx(X.T @ np.linalg.solve(whole, X), rel=1e-6, abs=1e-7)
    assert found.ln_det == pytest.approx(float(np.linalg.slogdet(whole)[1]), rel=1e-9, abs=1e-9)
    assert integrated(gram, 0) is gram


def test_a_million_rows_are_whitened_within_20_megabytes():
    model = ErrorModel(white=np.array([[0.1]]), processes=(Process(time=0.03, loading=np.array([[[1.0]]])),))
    rows = 10_000

    def chunks():
        for k in range(100):
            time = 1e-3 * np.arange(k * rows, (k + 1) * rows)
            yield time, np.sin(time)[:, None, None, None] * np.ones(3)

    tracemalloc.start()
    try:
        gram = model.gram(chunks())
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert gram.count == 1_000_000
    # A slow sine under a stationary process: the mean of its power over the spectral density at its frequency.
    w, q = 1.0, 2 / 0.03
    density = 1e-3 * q / (w**2 + 0.03**-2) / 1e-3 + 0.01 * 1e-3
    assert gram.product[0, 0] == pytest.approx(0.5 * 1000.0 / density, rel=0.01)


# Laplace -------------------------------------------------------------------------------------------------------------

TIME = np.linspace(0.02, 1.0, 25)
NOISE = 0.1


def linear_gram(y, J):
    model = ErrorModel(white=np.array([[NOISE]]))
    return model.gram([(TIME, np.concatenate([y[:, None], J], 1)[:, None, None])])


def test_evidence_of_a_linear_model_with_normal_priors_is_exact():
    rng = np.random.default_rng(0)
    J, scales = np.stack([np.sin(3 * TIME), TIME, np.ones_like(TIME)], 1), np.array([0.5, 2.0, 0.1])
    y = J @ np.array([0.4, -1.0, 0.05]) + NOISE * rng.normal(size=len(TIME))
    at = np.array([1.0, -3.0, 0.2])
    found = posterior(linear_gram(y - J @ at, J), at, [Prior(s) for s in scales])
    covariance = NOISE**2 * np.eye(len(TIME)) + (J * scales**2) @ J.T
    assert found.ln_evidence == pytest.approx(stats.multivariate_normal(None, covariance).logpdf(y), rel=1e-10)


@pytest.mark.parametrize("strength", [-1.0, -0.1, 0.02, 2.0])
def test_evidence_of_a_strength_that_cannot_be_negative_agrees_with_quadrature(strength):
    rng = np.random.default_rng(1)
    J = np.stack([np.sin(3 * TIME), TIME], 1)
    y = J @ np.array([strength, 0.3]) + NOISE * rng.normal(size=len(TIME))
    priors = (Prior(1.0, low=0.0), Prior(1.0))
    found = posterior(linear_gram(y, J), np.zeros(2), priors)
    width = 9 * np.sqrt(np.diag(found.covariance))
    begin = np.maximum(found.at - width, [0.0, -np.inf])
    share = np.linspace(0, 1, 601)
    a = begin[0] + (found.at[0] + width[0] - begin[0]) * share**2  # at a bound the density falls steeply
    b = begin[1] + 2 * width[1] * share
    ln_prior = [np.array([p.ln_density(v) for v in x]) for p, x in zip(priors, (a, b), strict=True)]
    off = y - a[:, None, None] * J[:, 0] - b[:, None] * J[:, 1]
    ln_p = stats.norm.logpdf(off, scale=NOISE).sum(-1) + ln_prior[0][:, None] + ln_prior[1]
    whole = np.trapezoid(np.trapezoid(np.exp(ln_p - found.ln_evidence), b), a)
    assert whole == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("beyond", [0.0, 0.02, 0.5, 5.0])
def test_evidence_of_two_like_unknowns_pressed_against_their_bounds_agrees_with_quadrature(beyond):
    rng = np.random.default_rng(4)
    J = np.stack([np.sin(3 * TIME), np.sin(3.3 * TIME), TIME], 1)
    y = J @ np.array([1 + beyond, 1 + 2 * beyond, 0.3]) + NOISE * rng.normal(size=len(TIME))
    priors = (Prior(1.0, low=-1.0, high=1.0), Prior(1.0, low=-1.0, high=1.0), Prior(1.0))
    found = posterior(linear_gram(y, J), np.zeros(3), priors)
    # The third is integrated out exactly, the others by quadrature.
    covariance = NOISE**2 * np.eye(len(TIME)) + np.outer(J[:, 2], J[:, 2])
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    a = 1 - min(2.0, 9 * float(np.sqrt(np.diag(found.covariance)[:2]).max())) * np.linspace(1, 0, 901) ** 2
    w, J = whiten @ y, whiten @ J[:, :2]
    off = w - a[:, None, None] * J[:, 0] - a[:, None] * J[:, 1]
    ln_p = stats.norm.logpdf(off).sum(-1) + np.log(np.diag(whiten)).sum()
    ln_prior = np.array([priors[0].ln_density(v) for v in a])
    ln_p += ln_prior[:, None] + ln_prior
    whole = np.trapezoid(np.trapezoid(np.exp(ln_p - found.ln_evidence), a), a)
    assert whole == pytest.approx(1.0, abs=0.1)


def test_evidence_of_a_decay_rate_agrees_with_quadrature_within_0_05():
    rng = np.random.default_rng(2)
    y = np.exp(-2.5 * TIME) + NOISE * rng.normal(size=len(TIME))
    prior = Prior(3.0, freedom=4.0, low=0.0)

    def ln_joint(rate):
        return stats.norm.logpdf(y, np.exp(-rate * TIME), NOISE).sum() + prior.ln_density(rate)

    at = minimize_scalar(lambda rate: -ln_joint(rate), bounds=(0.0, 10.0), method="bounded").x
    residual, slope = y - np.exp(-at * TIME), -TIME * np.exp(-at * TIME)
    found = posterior(linear_gram(residual, slope[:, None]), np.array([at]), [prior])
    exact = math.log(quad(lambda r: math.exp(ln_joint(r) - found.ln_evidence), 0.0, 30.0, points=[at])[0])
    assert exact == pytest.approx(0.0, abs=0.05)


def test_an_unknown_that_data_do_not_tell_leaves_the_evidence_as_it_is():
    rng = np.random.default_rng(3)
    y = NOISE * rng.normal(size=len(TIME))
    none = posterior(linear_gram(y, np.zeros((len(TIME), 0))), np.zeros(0), [])
    for prior in (Prior(math.inf, low=-9.0, high=1.5), Prior(2.0, low=0.0)):
        blind = posterior(linear_gram(y, np.zeros((len(TIME), 1))), np.array([1.0]), [prior])
        assert blind.ln_evidence == pytest.approx(none.ln_evidence, abs=1e-2)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_probability_of_a_box_is_that_of_the_normal_distribution(seed, count):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, count)) + 2 * np.eye(count)
    mean, covariance, low = rng.normal(size=count), root @ root.T, rng.normal(size=count) - 1
    high = low + rng.uniform(1, 5, count)
    exact = stats.multivariate_normal(mean, covariance).cdf(high, lower_limit=low)
    assert ln_box(mean, covariance, low, high) == pytest.approx(math.log(exact), abs=0.15 if count > 1 else 1e-9)


def test_probability_of_a_box_far_in_the_tail_keeps_its_digits():
    found = ln_box(np.array([-20.0]), np.eye(1), np.zeros(1), np.array([np.inf]))
    assert found == pytest.approx(stats.norm.logsf(20.0), rel=1e-12)


@given(st.floats(-1e4, 1e4), st.floats(-9.0, 3.0), st.floats(-0.9, 0.9))
def test_probability_of_a_narrow_box_far_out_is_that_of_its_edge(mean, ln_width, correlation):
    # In units of deviations; exact where the density falls by a constant rate through the box.
    width = 10**ln_width
    alone = ln_box(np.array([mean]), np.eye(1), np.zeros(1), np.array([width]))
    assert math.isfinite(alone)
    if width < 1e-3:
        fall = abs(mean) * width
        exact = stats.norm.logpdf(min(abs(mean), abs(mean - width))) + math.log(
            -math.expm1(-fall) / fall * width if fall > 1e-9 else width
        )
        assert alone == pytest.approx(exact, abs=1e-6 * (1 + abs(mean)))
    # Beside another that is as narrow, whatever they have in common.
    K = np.array([[1.0, correlation], [correlation, 1.0]])
    assert math.isfinite(ln_box(np.array([mean, 0.5]), K, np.zeros(2), np.array([width, 1e-7])))


@given(st.floats(0.01, 0.99), st.sampled_from([math.inf, 4.0]), st.floats(-2.0, 0.0), st.floats(0.5, 9.0))
def test_a_quantile_of_a_prior_has_its_share_of_the_mass_below(u, freedom, low, width):
    prior = Prior(1.5, freedom=freedom, low=low, high=low + width)
    at = float(prior.quantile(np.array([u]))[0])
    assert quad(lambda x: math.exp(prior.ln_density(x)), low, at)[0] == pytest.approx(u, abs=1e-6)


def test_a_quantile_of_a_uniform_prior_is_that_share_of_the_way():
    prior = Prior(math.inf, low=-1.0, high=3.0)
    assert prior.quantile(np.array([0.0, 0.25, 1.0])).tolist() == [-1.0, 0.0, 3.0]


@pytest.mark.parametrize("numbers", [{"scale": 0.0}, {"scale": math.inf}, {"scale": 1.0, "low": 2.0, "high": 1.0}])
def test_a_prior_that_is_no_density_is_refused(numbers):
    with pytest.raises(ValueError, match="wanted"):
        Prior(**numbers)


# Discrepancies -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_the_share_of_a_discrepancy_is_found_within_a_third(share):
    data, nothing, _ = recorded(share, 4)
    found = infer(data, nothing)
    assert found.discrepancy.share == pytest.approx(share, rel=0.33)
    assert found.some.ln_evidence > found.none.ln_evidence + 10


def test_without_a_discrepancy_none_is_more_probable():
    data, nothing, _ = recorded(0.0, 5)
    found = infer(data, nothing)
    assert found.none.ln_evidence > found.some.ln_evidence
    assert found.discrepancy.share == pytest.approx(MATTERS)


def test_evidence_with_s_and_tau_integrated_out_agrees_with_quadrature_within_1():
    data, nothing, _ = recorded(0.1, 6, trials=1)
    found = infer(data, nothing)
    low, high = np.log([MATTERS, data.trials[0].time[1]]), np.log([1.0, 1.0])
    grid = [np.linspace(a, b, 41) for a, b in zip(low, high, strict=True)]
    values = np.array(
        [[total(grams(data, nothing, Discrepancy(math.exp(a), math.exp(b)))) for b in grid[1]] for a in grid[0]],
        dtype=object,
    )
    ln_p = np.vectorize(lambda g: -0.5 * (g.product[0, 0] + g.ln_det + g.count * math.log(2 * math.pi)))(values)
    exact = ln_p.max() + math.log(np.exp(ln_p - ln_p.max()).mean())
    assert found.some.ln_evidence == pytest.approx(exact, abs=1.0)


def test_an_effect_that_is_there_has_more_evidence_than_a_discrepancy_alone():
    data, nothing, drag = recorded(0.02, 7, effect=0.3)
    one, other = infer(data, drag), infer(data, nothing)
    assert one.ln_evidence > other.ln_evidence + 20
    assert one.mode.at[0] == pytest.approx(0.3, abs=0.05)


def test_an_effect_that_is_not_there_costs_evidence():
    data, nothing, drag = recorded(0.0, 8)
    assert infer(data, drag).ln_evidence < infer(data, nothing).ln_evidence


def test_predictive_densities_of_trials_left_out_are_those_of_the_joint_normal_distribution():
    data, _, drag = recorded(0.0, 9)
    whole = infer(data, drag)
    exact = dataclasses.replace(whole.none, discrepancy=Discrepancy())
    found = dataclasses.replace(whole, some=exact, none=exact)
    model, *_ = errors(data, EXACT, Discrepancy())
    parts = []
    for t, r, J in zip(data.trials, drag.residuals, drag.slopes, strict=True):
        for axis in range(AXES):
            x = r[:, :, axis].T.reshape(-1), J[:, :, axis, 0].T.reshape(-1)
            parts.append((t.name, *x, model.dense(t.time, axis)))

    def ln_joint(names):
        y, J = (np.concatenate([p[k] for p in parts if p[0] in names]) for k in (1, 2))
        size, at = len(y), 0
        covariance = np.outer(J, J)
        for p in parts:
            if p[0] in names:
                n = len(p[1])
                covariance[at : at + n, at : at + n] += p[3]
                at += n
        return stats.multivariate_normal(np.zeros(size), covariance, allow_singular=False).logpdf(y)

    both = ln_joint(("0", "1"))
    assert leave_one_out(data, found) == pytest.approx([both - ln_joint("1"), both - ln_joint("0")], rel=1e-8)


def test_recordings_cannot_be_changed():
    data, _, _ = recorded(0.0, 10)
    with pytest.raises(ValueError, match="read-only"):
        data.trials[0].position[0] = 0.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        data.noise = 1.0


def test_the_range_that_residuals_leave_next_to_a_steep_bound_has_a_probability(monkeypatch):
    # The log-likelihood falls so steeply that a parabola fitted beside the bound misses its top.
    monkeypatch.setattr(evidence, "ln_likelihood", lambda data, near, left, x: -1e6 * float(x[0]) ** 3)
    low, high = np.zeros(3), np.array([5.0, 0.0, 0.0])
    mass = quad(lambda x: math.exp(-1e6 * x**3), 0, 0.1)[0]
    found = evidence._ln_occam(None, None, None, np.zeros(3), low, high)
    assert found == pytest.approx(math.log(mass / 5.0), abs=3)


def test_a_measurement_error_far_off_costs_its_prior_however_little_the_samples_count():
    data, nothing, effects = recorded(0.0, 3, effect=0.5)
    prior = Prior(0.01, freedom=4.0)
    fault = dataclasses.replace(effects, model=Model(effects=(), priors=(prior,)))
    found, bare = infer(data, fault), infer(data, nothing)
    assert found.mode.at[0] == pytest.approx(0.5, abs=0.05)  # 50 deviations
    hardly, without = (adjusted(data, p, 1e9).none.mode.ln_evidence for p in (found, bare))
    lost = prior.ln_density(float(found.none.mode.at[0])) - prior.ln_density(0.0)
    assert lost < -15 and hardly - without == pytest.approx(lost, abs=1e-3)


@pytest.mark.parametrize("kappa", [1.0, 1.3, 3.0, 10.0])
def test_a_number_that_the_recording_does_not_tell_takes_nothing_from_evidence_and_adds_nothing(kappa):
    data, _, drag = recorded(0.0, 3, effect=0.3)
    model = Model(effects=("drag",), priors=(Prior(1.0), Prior(np.inf, low=0.0, high=10.0)), own=(0, 1))
    slopes = tuple(np.concatenate([J, np.zeros_like(J)], -1) for J in drag.slopes)
    placed = dataclasses.replace(drag, model=model, at=np.array([0.0, 5.0]), slopes=slopes)
    found, bare = (adjusted(data, infer(data, m), kappa).ln_evidence for m in (placed, drag))
    assert found == pytest.approx(bare, abs=0.02)
