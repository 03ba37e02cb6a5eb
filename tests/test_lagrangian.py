"""The gated augmented Lagrangian: each rule of its schedule, a constrained optimum in closed form, and resuming."""

import io
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoro.design.lagrangian import AugmentedLagrangian, Plateau

torch.set_num_threads(1)

# A small convex problem: maximise 1 - |x - a|^2 / 2 subject to b.x <= c. Its optimum is the projection of a on the
# plane, its multiplier the distance of a from the plane over |b|.
A = torch.tensor([2.0, 1.0, -1.0], dtype=torch.float64)
B = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
C = 1.0
MULTIPLIER = float((A @ B - C) / (B @ B))
OPTIMUM = A - MULTIPLIER * B


def objective(x):
    return 1.0 - 0.5 * (x - A).square().sum()


def violation(x):
    return B @ x - C


def new_problem(**changes):
    return AugmentedLagrangian(**({"previous": 2.0, "penalty": 1e-3} | changes))


def at_plateau(problem, loss=1.0, violation=1.0):
    """Feed a constant until the schedule acts; returns the number of iterations it took and what it did."""
    for iteration in range(1, 100):
        event = problem.update(loss, violation)
        if event is not None:
            return iteration, event
    raise AssertionError("no event in 99 iterations")


# Plateaus -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("window", [1, 3, 4])
def test_a_plateau_needs_more_than_two_windows(window):
    plateau = Plateau(window=window, tolerance=1e-3)
    for _ in range(2):
        assert [plateau.update(1.0) for _ in range(2 * window + 2)] == [False] * (2 * window) + [True, True]
        plateau.reset()


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=25),
    window=st.integers(1, 4),
    tolerance=st.floats(1e-3, 0.5),
)
def test_a_plateau_compares_the_last_two_windows(values, window, tolerance):
    plateau = Plateau(window=window, tolerance=tolerance)
    for count, value in enumerate(values, start=1):
        seen = plateau.update(value)
        if count <= 2 * window:
            assert not seen
            continue
        before = math.fsum(values[count - 2 * window : count - window]) / window
        last = math.fsum(values[count - window : count]) / window
        change, allowed = abs(last - before), tolerance * abs(before)
        if abs(change - allowed) > 1e-12:  # otherwise rounding decides
            assert seen == (change < allowed)


def test_plateau_edges():
    # The change is a share of the magnitude of the earlier mean, whatever its sign, and all zeros are level.
    for last, level in ((-1.0009, True), (-1.0011, False), (-0.9991, True), (-0.9989, False)):
        plateau = Plateau(window=2, tolerance=1e-3)
        assert [plateau.update(v) for v in (5.0, -1.0, -1.0, last, last)] == [False] * 4 + [level]
    plateau = Plateau(window=1)
    assert [plateau.update(0.0) for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_plateau_refuses_what_is_not_finite(value):
    with pytest.raises(ValueError, match="value: got"):
        Plateau().update(value)


# The loss -------------------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    gain=st.floats(-5.0, 5.0),
    excess=st.floats(-1.0, 1.0),
    multiplier=st.floats(0.0, 10.0),
    penalty=st.floats(1e-3, 10.0),
)
def test_loss_is_the_formula(gain, excess, multiplier, penalty):
    problem = new_problem(penalty=penalty)
    problem.multiplier.fill_(multiplier)
    g = torch.tensor(excess, dtype=torch.float64, requires_grad=True)
    loss = problem(torch.tensor(gain, dtype=torch.float64), g)
    k = max(excess, 0.0)
    assert loss.item() == pytest.approx(-gain + multiplier * k + 0.5 * penalty * k**2, rel=1e-12, abs=1e-12)
    loss.backward()
    expected = multiplier + penalty * k if excess > 0.0 else 0.0
    assert g.grad is not None and g.grad.item() == pytest.approx(expected, rel=1e-12)


def test_loss_keeps_the_type_of_the_objective():
    problem = new_problem()
    assert problem(torch.tensor(1.0), torch.tensor(0.5)).dtype == torch.float32
    assert problem(torch.tensor(1.0).double(), torch.tensor(0.5)).dtype == torch.float64


def test_backward_after_update_sees_the_loss_that_was_taken():
    problem = new_problem(penalty=2.0)
    g = torch.tensor(0.25, dtype=torch.float64, requires_grad=True)
    loss = problem(torch.tensor(0.0, dtype=torch.float64), g)
    at_plateau(problem, violation=0.25)  # raises the multiplier in place
    loss.backward()
    assert g.grad is not None and g.grad.item() == 0.5
    assert problem.multiplier.item() == 0.5


# The schedule ---------------------------------------------------------------------------------------------------------


def test_a_large_violation_raises_the_penalty():
    problem = new_problem(previous=2.0, growth=7.0)
    iteration, event = at_plateau(problem, violation=0.5)  # not below 2 / 4
    assert iteration == 2 * 4 + 1
    assert (event.kind, event.stop, event.reset_optimizer) == ("penalty", False, True)
    assert (event.multiplier, event.penalty) == (0.0, pytest.approx(7e-3))
    assert problem.penalty.item() == event.penalty
    assert problem.previous.item() == 2.0
    # The next event needs a full wait again.
    assert at_plateau(problem, violation=0.5)[0] == 9
    assert problem.penalty.item() == pytest.approx(49e-3)


def test_a_small_violation_raises_the_multiplier_and_becomes_the_reference():
    problem = new_problem(previous=2.0, penalty=0.1)
    _, event = at_plateau(problem, violation=0.4)
    assert (event.kind, event.stop, event.reset_optimizer) == ("multiplier", False, True)
    assert (event.multiplier, event.penalty) == (pytest.approx(0.04), 0.1)
    assert problem.previous.item() == 0.4
    assert at_plateau(problem, violation=0.2)[1].kind == "penalty"  # 0.2 is not below 0.4 / 4
    assert at_plateau(problem, violation=0.09)[1].multiplier == pytest.approx(0.04 + 1.0 * 0.09)


@pytest.mark.parametrize("margin", [0.0, -0.01])
def test_a_held_constraint_at_a_plateau_stops(margin):
    problem = new_problem()
    _, event = at_plateau(problem, violation=margin)
    assert (event.kind, event.stop, event.reset_optimizer) == ("stop", True, False)
    assert (problem.multiplier.item(), problem.penalty.item()) == (0.0, 1e-3)


def test_nothing_happens_while_the_loss_still_changes():
    problem = new_problem()
    for k in range(60):
        assert problem.update(-(1.01**k), 1.0 if k % 2 else -1.0) is None
    assert (problem.multiplier.item(), problem.penalty.item()) == (0.0, 1e-3)


def events_of(problem, iterations, violation):
    """Feed a loss that is never level; returns the iterations, from 1, at which something happened, and what."""
    seen = ((k, problem.update(-(1.01**k), violation)) for k in range(1, iterations + 1))
    return [(k, event.kind) for k, event in seen if event is not None]


def test_patience_raises_the_penalty_without_a_plateau_and_counts_anew():
    problem = new_problem(patience=6)
    assert events_of(problem, 20, violation=1.0) == [(6, "penalty"), (12, "penalty"), (18, "penalty")]
    assert problem.penalty.item() == pytest.approx(1.0)
    assert events_of(new_problem(patience=6), 6, violation=0.4) == [(6, "multiplier")]
    assert events_of(new_problem(patience=1), 3, violation=1.0) == [(k, "penalty") for k in (1, 2, 3)]


def test_a_plateau_comes_before_patience_ends_and_restarts_it():
    problem = new_problem(patience=20)
    assert at_plateau(problem)[0] == 9
    assert events_of(problem, 21, violation=1.0) == [(20, "penalty")]


@pytest.mark.parametrize("margin", [0.0, -0.1])
def test_patience_neither_acts_nor_stops_while_the_constraint_holds(margin):
    problem = new_problem(patience=6)
    assert events_of(problem, 40, violation=margin) == []
    assert problem.penalty.item() == 1e-3
    assert at_plateau(problem, violation=margin)[1].kind == "stop"  # which only a plateau brings


def test_patience_goes_on_from_a_checkpoint():
    first, second = new_problem(patience=6), new_problem(patience=6)
    assert events_of(first, 4, violation=1.0) == []
    second.load_state_dict(first.state_dict())
    assert events_of(second, 3, violation=1.0) == [(2, "penalty")]


# Convergence ----------------------------------------------------------------------------------------------------------


def test_schedule_converges_to_the_closed_form_optimum_and_multiplier():
    # With exact inner minimisation the method of multipliers contracts by 1 / (1 + sigma |b|^2) at every step.
    problem = new_problem(previous=float(violation(A)), penalty=1e-3)
    bb = float(B @ B)
    kinds, x = [], A
    for _ in range(25):
        multiplier, penalty = problem.multiplier.item(), problem.penalty.item()
        # Stationarity of the loss where b.x > c: x = a - (lambda + sigma K) b, with K = b.x - c.
        excess = (float(A @ B) - C - multiplier * bb) / (1.0 + penalty * bb)
        x = A - (multiplier + penalty * excess) * B
        y = x.clone().requires_grad_()
        loss = problem(objective(y), violation(y))
        loss.backward()
        assert y.grad is not None
        torch.testing.assert_close(y.grad, torch.zeros_like(y), rtol=0, atol=1e-9)
        _, event = at_plateau(problem, loss.item(), excess)
        kinds.append(event.kind)
        if event.kind == "multiplier":
            gap, new_gap = MULTIPLIER - multiplier, MULTIPLIER - problem.multiplier.item()
            assert new_gap == pytest.approx(gap / (1.0 + penalty * bb), rel=1e-6, abs=1e-12)
        if excess < 1e-12:
            break
    assert {"penalty", "multiplier"} <= set(kinds)
    assert problem.multiplier.item() == pytest.approx(MULTIPLIER, rel=1e-9)
    torch.testing.assert_close(x, OPTIMUM, rtol=0, atol=1e-9)


def run(problem, x, optimizer, iterations, lr=0.02):
    """Plain Adam loop, as a recipe has it; returns the optimizer, the history, and whether it stopped."""
    history = []
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = problem(objective(x), violation(x))
        loss.backward()
        event = problem.update(loss.item(), violation(x).item())
        history.append((loss.item(), None if event is None else event.kind))
        if event is not None and event.stop:
            return optimizer, history, True
        optimizer.step()
        if event is not None and event.reset_optimizer:
            optimizer = adam(x, lr)
    return optimizer, history, False


def adam(x, lr=0.02):
    return torch.optim.Adam([x], lr=lr)


def start():
    return torch.zeros(3, dtype=torch.float64, requires_grad=True)


def test_adam_with_the_schedule_stops_at_the_constrained_optimum():
    problem, x = new_problem(previous=float(violation(A))), start()
    _, history, stopped = run(problem, x, adam(x, lr=0.005), 3000, lr=0.005)
    kinds = [kind for _, kind in history if kind]
    assert stopped and kinds[-1] == "stop" and "multiplier" in kinds and "penalty" in kinds
    assert float(violation(x.detach())) <= 0.0
    torch.testing.assert_close(x.detach(), OPTIMUM, rtol=0, atol=0.05)
    assert 0.0 <= float(objective(OPTIMUM) - objective(x.detach())) < 0.01
    # Without the constraint the same loop would have gone to a, far on the wrong side.
    assert float(violation(A)) > 2.0


@pytest.mark.parametrize("cut", [1, 8, 9, 57, 123])
def test_resumed_equals_straight_run(cut):
    straight, x = new_problem(window=3, tolerance=0.01), start()
    _, expected, _ = run(straight, x, adam(x), 200)
    assert sum(kind is not None for _, kind in expected) >= 3

    first, y = new_problem(window=3, tolerance=0.01), start()
    optimizer, seen, _ = run(first, y, adam(y), cut)
    file = io.BytesIO()
    torch.save({"problem": first.state_dict(), "x": y.detach(), "optimizer": optimizer.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)

    second, z = new_problem(window=3, tolerance=0.01), saved["x"].clone().requires_grad_()
    second.load_state_dict(saved["problem"])
    optimizer = adam(z)
    optimizer.load_state_dict(saved["optimizer"])
    _, more, _ = run(second, z, optimizer, 200 - cut)
    assert seen + more == expected
    assert torch.equal(z.detach(), x.detach())
    for name, value in straight.state_dict().items():
        assert torch.equal(second.state_dict()[name].nan_to_num(), value.nan_to_num()), name


def test_everything_is_in_the_checkpoint_in_double_precision():
    state = new_problem(previous=0.2375).state_dict()
    assert set(state) == {"multiplier", "penalty", "previous", "plateau.recent", "plateau.count"}
    assert all(value.dtype == torch.float64 for name, value in state.items() if name != "plateau.count")
    assert "penalty=0.001" in repr(new_problem())


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"previous": 0.0}, "previous: got 0.0"),
        ({"penalty": -1.0}, "penalty: got -1.0"),
        ({"penalty": math.nan}, "penalty: got nan"),
        ({"growth": 1.0}, "growth: got 1.0"),
        ({"window": 0}, "window: got 0"),
        ({"window": 4.0}, "window: got 4.0"),
        ({"tolerance": 0.0}, "tolerance: got 0.0"),
        ({"patience": -1}, "patience: got -1"),
        ({"patience": 2.0}, "patience: got 2.0"),
        ({"patience": True}, "patience: got True"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        new_problem(**changes)


def test_bad_values_are_refused_and_leave_no_trace():
    problem = new_problem()
    with pytest.raises(ValueError, match=r"violation: got shape \(2,\), want a scalar"):
        problem(torch.tensor(0.0), torch.zeros(2))
    with pytest.raises(ValueError, match=r"objective: got shape \(1,\), want a scalar"):
        problem(torch.zeros(1), torch.tensor(0.0))
    with pytest.raises(ValueError, match="loss: got nan"):
        problem.update(math.nan, 0.0)
    with pytest.raises(ValueError, match="violation: got inf"):
        problem.update(0.0, math.inf)
    assert problem.plateau.count.item() == 0
