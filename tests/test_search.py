"""Which searches go on: valleys of pairs on more and more of the trials, and where the finer twin begins."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchsoro.sim2real.inference import search
from torchsoro.sim2real.inference.gauss_newton import GaussNewton, Point
from torchsoro.sim2real.inference.search import ENDS_PAIR, FINER_ROUNDS, PROMISING, alone


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect with one number, probed at 1 to 5."""

    name: str

    def probe_points(self, twin: object) -> list[tuple[np.ndarray, float]]:
        return [(np.array([float(k)]), 1.0) for k in range(1, 6)]


def fit(effects: tuple[Any, ...], point: np.ndarray, chi2: float) -> Any:
    return SimpleNamespace(
        effects=effects,
        name=" and ".join(e.name for e in effects),
        point=point,
        chi2=chi2,
        samples=100,
        errors=np.zeros(2),
    )


class Pairs:
    """A problem whose searches stay where they begin; part of the trials prefers low numbers, all of them high ones."""

    common = (("modulus", 0.1),)
    twin = None

    def __init__(self) -> None:
        self.whole: list[Any] = []

    def early(self, share: float) -> Any:
        return SimpleNamespace(fit=lambda tasks, **_: [fit(e, x, float(x[1:].sum())) for e, x in tasks])

    def fit(self, tasks: list[Any], **_: Any) -> list[Any]:
        self.whole += tasks
        return [fit(e, x, 100 - float(x[1:].sum())) for e, x in tasks]


def test_several_valleys_of_a_pair_go_on_to_all_of_the_trials():
    effects: Any = [Effect("lag"), Effect("drag")]
    problem: Any = Pairs()
    (found,) = search._pairs(problem, effects, [fit((effects[0],), np.array([0.0, 3.0]), 50.0)], lambda line: None)
    kept = [float(x[1:].sum()) for _, x in problem.whole]
    assert len({x.tobytes() for _, x in problem.whole}) == len(kept) == ENDS_PAIR
    # The first part of the trials prefers another valley than all of them do.
    assert found.chi2 == 100 - max(kept) < 100 - min(kept)


def test_the_finer_twin_begins_where_chi_squared_is_least_of_responses_ends_and_spread_points(monkeypatch):
    effects: Any = [Effect("lag"), Effect("drag"), Effect("mass")]
    a, b, c = effects
    begun: list[Any] = []
    completed: list[Any] = []

    class Fine:
        trials = ("first", "second")
        observation = SimpleNamespace(deviations=np.ones(2))

        def only(self, trials: Any) -> Any:
            assert trials == ("first",)
            return self

        def base(self, _: Any) -> str:
            return "base"

        def probe(self, effects: Any, base: str) -> list[list[tuple[float, np.ndarray]]]:
            # The third start of each is the best, but only so many are simulated.
            return [[(float(k), np.array([0.0, 10.0 + k])) for k in range(4)] for _ in effects]

        def fit(self, tasks: Any, *, rounds: int, **_: Any) -> list[Any]:
            """Ends that are better after more rounds, unless they break down."""
            (begun if rounds == FINER_ROUNDS else completed).append(tasks)
            less = 0.0 if rounds == FINER_ROUNDS else 5.0
            return [fit(e, np.zeros(1) if x is None else x, 10.0 - less) if not less or c not in e else None
                    for e, x in tasks]  # fmt: skip

    nothing = fit((), np.zeros(1), 500.0)
    nothing.errors = np.zeros(2)
    monkeypatch.setattr(search.dataclasses, "replace", lambda one, **_: one)
    monkeypatch.setattr(search, "null_starts", lambda problem: [])
    spread = [(9.0, a, 2.0), (5.0, a, 1.0), (6.0, a, 1.5), (50.0, b, 1.0)]
    monkeypatch.setattr(search, "screened", lambda *_: [(chi2, e, np.array([0.0, x])) for chi2, e, x in spread])
    looked: list[Any] = []

    def look(problem: Any, started: Any) -> list[Any]:
        looked.extend(started)
        return [(abs(float(x[1]) - 11.0) + 2 * (e is c), e, x) for e, x in started]

    monkeypatch.setattr(search, "looked_at", look)
    problem: Any = SimpleNamespace(finely=Fine)
    ends = [fit((c,), np.array([0.0, 11.0]), 20.0), fit((a, b), np.zeros(3), 1.0)]
    none, found = search._by_finer(problem, effects, nothing, ends, lambda line: None)
    # A few starts by responses of each effect, the best of spread points, and where single effects have ended before.
    assert [x[1] for e, x in looked if e is a] == [*(10.0 + k for k in range(PROMISING)), 1.0, 1.5]
    assert [x[1] for e, x in looked if e is c] == [10.0, 11.0, 11.0]
    starts = {effects[0]: float(point[1]) for effects, point in begun[1]}
    assert starts == {a: 11.0, b: 11.0, c: 11.0}
    # Of a, neither a spread point nor the first start, which leaves 1.
    assert [e.name for (e,), _ in begun[1]] == ["lag", "drag", "mass"]
    # The best are completed; what breaks down then stays as it was.
    assert [[e for e, _ in tasks] for tasks in completed] == [[()], [(a,), (b,), (c,)]]
    assert [f.chi2 for f in none] == [5.0]
    assert [(f.name, f.chi2) for f in found] == [("lag", 5.0), ("drag", 5.0), ("mass", 10.0)]


class Swallowed(GaussNewton):
    """A search whose steps are lost in rounding, while each look at a point is a little better than the last."""

    held = places = np.zeros(1, bool)
    weight = np.ones(1)

    def step(self, point: Point, damping: float) -> np.ndarray:
        return np.full(1, 1e-17)

    def linearise(self, at: np.ndarray, errors: np.ndarray, moving: np.ndarray) -> Any:
        chi2 = yield at
        columns = np.ones((3, 1)) if len(moving) else np.zeros((3, 1))
        return Point(chi2=chi2, at=at, errors=errors, r=np.ones(3), J=columns, columns=columns, motions=[]), False


def test_a_step_that_rounding_swallows_ends_a_search_with_its_derivatives():
    looks = Swallowed(SimpleNamespace(bounds=lambda effects: (np.zeros(1), np.full(1, 9.0))), ()).search(
        np.ones(1), np.zeros(1), 8, settle=False
    )
    asked, found = [next(looks)], None
    for chi2 in (100.0, 90.0, 80.0):
        try:
            asked.append(looks.send(chi2))
        except StopIteration as end:
            found = end.value
            break
    assert found is not None and np.isfinite(found.columns).all() and found.columns.any()
    assert len(asked) == 1


class Curved(GaussNewton):
    """A search of residuals that bend with its unknowns by a share ``bent``, with numbers in place of simulations."""

    bent = 0.0
    eager = True
    held = places = np.zeros(2, bool)
    weight = np.array([0.5, 2.0, 1.0])
    A, B, noise = (np.random.default_rng(3).normal(size=n) for n in ((40, 2), (40, 3), 40))

    def linearise(
        self, at: np.ndarray, errors: np.ndarray, moving: np.ndarray, before: Any = None, known: Any = None
    ) -> Any:
        yield at, len(moving), known
        r = self.A @ (np.array([1.5, -1.0]) - at - self.bent * at**2) + 0.5 * self.noise
        errors = np.linalg.solve(self.B.T @ self.B + np.diag(self.weight**2), self.B.T @ r)
        r, prior = r - self.B @ errors, self.weight * errors
        chi2 = float(r @ r + prior @ prior + 0.01 * at @ at)
        columns = self.A * (1 + 2 * self.bent * at) if len(moving) else np.zeros((40, 2))
        return Point(chi2=chi2, at=at, errors=errors, r=r, J=self.B, columns=columns, motions=[at]), self.eager


def searched(step: float = 0.05, **settings: Any) -> Curved:
    likelihood: Any = SimpleNamespace(
        bounds=lambda effects: (np.full(2, -9.0), np.full(2, 9.0)),
        prior_residual=lambda at, held: (0.1 * at, np.full(2, 0.1)),
        step=step,
    )
    search = Curved(likelihood, ())
    for name, value in settings.items():
        object.__setattr__(search, name, value)
    return search


def led(asking: Any) -> tuple[list[Any], Any]:
    """What is asked for, and what comes of it."""
    asked = []
    try:
        asked.append(next(asking))
        while True:
            asked.append(asking.send(None))
    except StopIteration as end:
        return asked, end.value


def test_a_step_gains_what_linear_residuals_promise():
    search, at, step = searched(), np.array([1.0, -2.0]), np.array([0.7, 1.3])
    (_, (begin, _)), (_, (end, _)) = (led(search.linearise(x, np.zeros(3), np.arange(2))) for x in (at, at + step))
    assert begin.chi2 - end.chi2 > 10
    assert search.promised(begin, step) == pytest.approx(begin.chi2 - end.chi2, rel=1e-9)


def test_a_search_ends_where_no_step_promises_anything_without_simulating_it():
    asked, found = led(searched().search(np.zeros(2), np.zeros(3), 8, settle=True))
    assert len(asked) == 2, "the start, and one step"
    assert np.abs(searched().step(found, 0.0)).max() < 0.05 < np.abs(found.at).min()


@pytest.mark.parametrize("step", [0.05, 5.0])
def test_derivatives_of_an_earlier_point_are_kept_as_long_as_they_lead(step):
    every, best = led(searched(bent=0.1).search(np.zeros(2), np.zeros(3), 20, settle=True))
    asked, found = led(searched(bent=0.1, eager=False, step=step).search(np.zeros(2), np.zeros(3), 20, settle=True))
    np.testing.assert_allclose(found.at, best.at, atol=0.1)
    assert found.columns.any() and found.chi2 < best.chi2 + 0.5
    assert sum(bool(n) for _, n, _ in every) == len(every)
    assert sum(bool(n) for _, n, _ in asked) < len(asked) - 1
    # A point that has been simulated comes with its motions.
    assert all((known is not None) == bool(n) for _, n, known in asked[1:])
    assert all(known is None or known[0] is at for at, _, known in asked)


class Crude(Curved):
    """The same, whose derivatives bend the wrong way until a point nearby has told how long steps may be."""

    def linearise(
        self, at: np.ndarray, errors: np.ndarray, moving: np.ndarray, before: Any = None, known: Any = None
    ) -> Any:
        found, eager = yield from super().linearise(at, errors, moving, before, known)
        if before is not None:
            return found, eager
        return dataclasses.replace(found, columns=-found.columns, crude=True), eager


@pytest.mark.parametrize("eager", [False, True])
def test_a_search_does_not_end_by_derivatives_that_long_steps_spoilt(eager):
    likelihood = searched().likelihood
    best = led(searched(bent=0.1).search(np.zeros(2), np.zeros(3), 20, settle=True))[1]
    search = Crude(likelihood, ())
    for name, value in {"bent": 0.1, "eager": eager}.items():
        object.__setattr__(search, name, value)
    asked, found = led(search.search(np.zeros(2), np.zeros(3), 20, settle=True))
    np.testing.assert_allclose(found.at, best.at, atol=0.1)
    # It looks again where it began, and simulates nothing there twice.
    (start, _, _), _, (again, count, known), *_ = asked
    assert again is start and count and known is not None


def test_chance_in_a_short_step_does_not_change_derivatives():
    search, at = searched(step=0.05), np.array([1.0, -2.0])
    begin = led(search.linearise(at, np.zeros(3), np.arange(2)))[1][0]
    for step, alike in (np.array([0.01, 0.04]), True), (np.array([0.3, 0.1]), False):
        after = led(search.linearise(at + step, np.zeros(3), np.arange(0)))[1][0]
        by_chance = dataclasses.replace(after, r=after.r + 1.0)
        assert np.array_equal(search.columns(begin, by_chance), begin.columns) is alike
        np.testing.assert_allclose(search.columns(begin, after), begin.columns, atol=1e-9)


def test_a_rugged_effect_is_searched_from_the_best_of_many_points_and_gone_on_with_from_distinct_ends(monkeypatch):
    class Tube:
        name, quantities, local = "tube", ("length",), False

        def spread(self, twin: object, u: np.ndarray) -> np.ndarray:
            return 10 * u

    class Valleys:
        common = (("modulus", 0.1),)
        twin = None

        def fit(self, tasks: list[Any], *, rounds: int, **_: Any) -> list[Any]:
            """Each goes on by one, and is the better the nearer to seven; what begins below 5.9 breaks down."""
            seen.append((rounds, [float(x[1]) for _, x in tasks]))
            ends = [(e, np.array([x[0], x[1] + 1])) for e, x in tasks]
            return [None if x[1] < 6.9 else fit(e, x, abs(float(x[1]) - 7.5)) for e, x in ends]

    seen: list[tuple[int, list[float]]] = []
    looked: list[np.ndarray] = []

    def look(problem: Any, started: Any, errors: np.ndarray) -> list[Any]:
        looked.extend(x for _, x in started)
        return [(abs(float(x[1]) - 6.0), e, x) for e, x in started]

    monkeypatch.setattr(search, "looked_at", look)
    nothing = fit((), np.array([0.3]), 500.0)
    problem: Any = Valleys()
    tube: Any = Tube()
    found = search._from_many(problem, tube, nothing, 8, lambda line: None)
    assert len(looked) == 8 * search.LOOKS
    assert {float(x[0]) for x in looked} == {0.3}  # what is stated as nothing has it
    (first, begun), *later = seen
    assert first == search.TRIED
    assert max(abs(x - 6.0) for x in begun) <= sorted(abs(float(x[1]) - 6.0) for x in looked)[8]
    for (most, tasks), (_, kept) in zip(later, search.RUGGED, strict=False):
        assert most > first
        assert 0 < len(tasks) == len(set(tasks)) <= kept
    assert [f.chi2 for f in found] == sorted(f.chi2 for f in found)
    assert found[0].chi2 < 0.6


def test_a_second_effect_is_tried_beside_single_ones_only():
    modulus, side, tube = object(), object(), object()
    fits: list[Any] = [SimpleNamespace(effects=e) for e in ((modulus, side), (side,), (tube,))]
    known: list[Any] = [modulus, side]
    assert alone(fits, known) == fits[1:2]
