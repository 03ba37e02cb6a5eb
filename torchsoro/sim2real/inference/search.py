"""From recordings to fits: probe all effects, begin searches where much is promised, and complete the best."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.likelihood import BREAKS
from torchsoro.sim2real.inference.recording_faults import find_slips
from torchsoro.sim2real.inference.resolution import cost
from torchsoro.sim2real.inference.starts import (
    EARLY_ABOVE,
    STARTS,
    Task,
    even_points,
    likely,
    looked_at,
    null_starts,
    probe_points,
    screened,
    unconstrained,
    within_tolerances,
)

COMPLETED = 6  # searches that are completed, of those that are best after a few rounds
EARLY = (0.12, 0.35)  # first parts of the trials, one after the other
MOST_RUGGED = 40  # searches of a rugged effect that are begun, at most
LOOKS = 20  # points at which it is simulated, for each of them
PAIRS = 0.002  # share of the budget for one simulation of all trials, below which pairs of effects are tried
CORRECTED = 1.5  # chi-squared per sample of the null model, above which the finer twin corrects each effect by itself
REFINED = 2  # rounds in which the best are corrected by the finer twin
PARTLY = 4.0  # duration of a simulation in a search, which fills some lanes only, over that with all lanes filled
MOST = 10  # searches that are begun, at most
MOST_VALLEYS = 24  # the same where most end in valleys nearby
FINER = 8  # effects that are then searched for by the finer twin
FINER_ROUNDS = 3  # of these, before the best are completed
PROMISING = 2  # of an effect's starts by its responses, and of spread points, that are simulated by the finer twin
BEHIND = 0.1  # share of the best search's gain, by which another may be behind and still be completed
TWICE = 0.25  # excess of chi-squared of a pair over that of the best single effect, below which the pair is kept
TRIED = 4  # rounds of a search before the best are chosen
ROUNDS = 12  # of a search that is completed
RUGGED = ((TRIED, 10), (10, 3), (40, 1))  # rounds of searches of a rugged effect, and how many go on after them
ENDS = 10  # that are weighed, at most
ENDS_FINER = 16  # the same where a finer twin is searched, too
ENDS_PAIR = 3  # of each pair, that more of the trials decide between
AHEAD = 3  # ends of searches that are always in the running
FARTHER = 4.0  # times the least chi-squared: an end that leaves more is far out of it
APART = 0.3  # of an unknown, or of its scale, below which two ends are one


def search(
    problem: FitProblem, effects: Sequence[Hypothesis], budget: float, report: Callable[[str], None]
) -> tuple[FitProblem, Fit, list[Fit]]:
    """The best fits.

    Args:
        problem: Recordings and twin.
        effects: To think of.
        budget: Time that this may take on two cores, about [s]; sets how many searches are begun.
        report: Called with a line for each effect.

    Returns:
        The problem with slips and corrections that were found, the fit without an effect, and distinct ends of
        searches that are in the running: others without an effect, where there are many valleys, then those with
        effects.
    """
    rugged, effects = [e for e in effects if e.rugged], [e for e in effects if not e.rugged]
    problem, null_model = _fit_null_model(problem, [((), None)], report, rounds=3)
    # By count, not by the clock: what is searched must not depend on the machine.
    each = cost(problem.twin, len(problem.trials), PARTLY)
    begun = MOST_VALLEYS if problem.many_valleys and not problem.searched_finely else MOST
    most = int(np.clip(0.3 * budget / (10 * each), COMPLETED, begun))
    carried: list[Task] = []
    if null_model.chi2 > EARLY_ABOVE * null_model.samples:
        # Responses are not linear so far off, but at first a wrong frequency is not yet a wrong phase. The correction
        # by the finer twin at the setup as stated does not hold for a motion that is so different.
        stated = problem.discretization.replace(correction=problem.stated)
        problem = problem.only(problem.trials, discretization=stated)
        carried = _from_the_beginning(problem, effects, most)
        problem, null_model = _fit_null_model(problem, [t for t in carried if not t[0]], report)
    else:
        problem = problem.corrected(null_model.point)
        problem, null_model = _fit_null_model(problem, [((), null_model.point)], report)
    tasks = [t for t in carried if t[0]]
    if not tasks:
        looks = probe_points(problem, null_model, effects)
        for effect in effects:
            mine = [chi2 for chi2, e, _ in looks if e is effect]
            report(
                f"{effect.name}: chi-squared {min(mine):.0f} by its linear response"
                if mine
                else f"{effect.name}: breaks down"
            )
        tasks = likely(looks, null_model, most)
    if problem.many_valleys and not problem.searched_finely:
        tasks = [*likely(screened(problem, null_model, effects), null_model, most), *tasks]
    tried = []
    released = unconstrained(problem, effects, null_model)
    if len(tasks) > COMPLETED:
        tried = [f for f in problem.fit(tasks, errors=null_model.errors, rounds=TRIED, settle=False) if f is not None]
        tried.sort(key=lambda fit: fit.chi2)
        least = tried[0].chi2 if tried else null_model.chi2
        behind = least + BEHIND * max(null_model.chi2 - least, 0.0)
        led = [f for i, f in enumerate(tried[:COMPLETED]) if i < 3 or f.chi2 < behind]
        # A modulus beyond its tolerance may be that of a stiff side.
        led += [f for f in tried if released and varied(f) > 0 and f not in led]
        tasks = [(f.effects, f.point) for f in led]
    tasks += released
    completed = [f for f in problem.fit(tasks, errors=null_model.errors, rounds=ROUNDS) if f is not None]
    best = _best([*completed, *tried])
    if best and null_model.chi2 > CORRECTED * null_model.samples:
        problem, null_model, best = _refined(problem, null_model, best, report)

    def unexplained() -> bool:
        """Whether the best leaves far more than noise, where searches take little and chance hides little."""
        much = not best or best[0].chi2 > EARLY_ABOVE * best[0].samples
        return much and not problem.rough and each < PAIRS * budget

    if unexplained():
        most = int(np.clip(0.3 * budget / (10 * each), COMPLETED, MOST_RUGGED))
        best = _best([*best, *(f for effect in rugged for f in _from_many(problem, effect, null_model, most, report))])
    # A second effect would take up what chance in touching leaves.
    if best and unexplained():
        left = best[0].chi2 - best[0].samples
        singles = alone(running(problem, best), effects)
        pairs = _pairs(problem, effects, singles, report) if singles else []
        best = _best([*best, *(f for f in pairs if f.chi2 - f.samples < TWICE * left)])
    ends = distinct([*best, *sorted(completed, key=lambda f: f.chi2)], ENDS)
    ends = running(problem, ends)
    valleys = _other_valleys(problem, null_model, ends)
    if not problem.searched_finely:
        return problem, null_model, [*valleys, *ends]
    # What two searches find in turn, so that neither crowds out the other.
    nothing, finer = _by_finer(problem, effects, null_model, ends, report)
    mixed = [f for pair in itertools.zip_longest(finer, ends) for f in pair if f is not None]
    return problem, null_model, [*valleys, *nothing, *distinct(mixed, ENDS_FINER)]


def _from_many(
    problem: FitProblem, effect: Hypothesis, null_model: Fit, most: int, report: Callable[[str], None]
) -> list[Fit]:
    """Fits of a rugged effect: simulated at many points, and searched from those that leave the least."""
    points = effect.spread(problem.twin, even_points(LOOKS * most, len(effect.quantities) + 3 * effect.local))
    stated = np.tile(null_model.point[: len(problem.common)], (len(points), 1))
    started = [(effect, point) for point in np.concatenate([stated, points], 1)]
    looks = looked_at(problem, started, errors=null_model.errors)
    tasks: list[Task] = [((effect,), point) for _, _, point in sorted(looks, key=lambda look: look[0])[:most]]
    found: list[Fit] = []
    for rounds, kept in RUGGED:
        ends = [f for f in problem.fit(tasks, errors=null_model.errors, rounds=rounds, settle=False) if f is not None]
        found = sorted([*ends, *found], key=lambda fit: fit.chi2)
        tasks = [(f.effects, f.point) for f in distinct(found, kept)]
    report(f"{effect.name}, from {len(points)} points: {', '.join(f'{f.chi2:.0f}' for f in found[:4])}")
    return found


def distinct(fits: Iterable[Fit], most: int) -> list[Fit]:
    """The first of fits that differ, by effects or in where they ended; so many at most."""
    found: list[Fit] = []
    for fit in fits:
        if fit.effects and not any(_beside(fit, other) for other in found):
            found.append(fit)
    return found[:most]


def _beside(one: Fit, other: Fit) -> bool:
    """Whether fits of the same effects, in the same forms, end at one place."""
    if [type(e) for e in one.effects] != [type(e) for e in other.effects]:
        return False
    return bool((np.abs(one.point - other.point) < APART * np.maximum(np.abs(one.point), 1)).all())


def _by_finer(
    problem: FitProblem,
    effects: Sequence[Hypothesis],
    null_model: Fit,
    ends: Sequence[Fit],
    report: Callable[[str], None],
) -> tuple[list[Fit], list[Fit]]:
    """Fits by the finer twin, without an effect and with one, of bodies that touch planes.

    What the finer twin adds to the motion as stated holds as long as nodes touch when they do there, so that no
    correction makes up for cells that are off by as much as effects are. Searches begin where chi-squared itself is
    least, of the starts and evenly spread points of which responses promise most, and of where the search before ended.
    """
    fine = problem.finely()
    one = fine.only(fine.trials[:1])  # the others are as good, and take as long
    begin = [((), null_model.point), *null_starts(one)]
    nothing = [f for f in fine.fit(begin, errors=null_model.errors, rounds=FINER_ROUNDS) if f is not None]
    if not nothing:
        return [], []
    least = min(nothing, key=lambda fit: fit.chi2)
    (best,) = _completed(fine, [least], least.errors)
    nothing = [best if f is least else f for f in nothing]
    base = one.base(dataclasses.replace(best, errors=np.zeros(len(one.observation.deviations))))
    started = [
        (effect, start)
        for effect, own in zip(effects, one.probe(effects, base), strict=True)
        for _, start in own[:PROMISING]
    ]
    spread: dict[Hypothesis, list[np.ndarray]] = {}
    for _, effect, point in sorted(screened(one, best, effects, base), key=lambda look: look[0]):
        spread.setdefault(effect, []).append(point)
    started += [(effect, point) for effect, own in spread.items() for point in own[:PROMISING]]
    started += [(f.effects[0], f.point) for f in ends if len(f.effects) == 1]
    first: dict[Hypothesis, Task] = {}  # of a name, each form by itself
    for _, effect, point in sorted(looked_at(one, started), key=lambda look: look[0]):
        first.setdefault(effect, ((effect,), point))
    tasks = list(first.values())[:FINER]
    found = _best(fine.fit(tasks, errors=best.errors, rounds=FINER_ROUNDS, settle=False))
    # Names that are alike differ by less than the rounds before gain.
    found = _best([*found, *_completed(fine, found[:AHEAD], best.errors)])
    report(f"by the finer twin: nothing {best.chi2:.0f}, " + ", ".join(f"{f.name} {f.chi2:.0f}" for f in found))
    return nothing, found


def _completed(problem: FitProblem, fits: Sequence[Fit], errors: np.ndarray) -> list[Fit]:
    """Searches that ended for want of rounds, gone on with; what breaks down stays as it was."""
    again = problem.fit([(f.effects, f.point) for f in fits], errors=errors, rounds=ROUNDS, settle=False)
    return [before if after is None else after for before, after in zip(fits, again, strict=True)]


def _refined(
    problem: FitProblem, null_model: Fit, best: list[Fit], report: Callable[[str], None]
) -> tuple[FitProblem, Fit, list[Fit]]:
    """The best fits again, each corrected by the finer twin where it is itself, until they are fits of that twin.

    A fit that ends where it was corrected is one of the finer twin already; one that leaves far more than the best once
    both are corrected is out of the running, chance in touching or not. Neither is corrected again.
    """
    leading, ends = [null_model, *running(problem, best)[:COMPLETED]], {}
    for _ in range(REFINED):
        problem = problem.corrected_each([(f.effects, f.point[None]) for f in leading])
        tasks: list[Task] = [(f.effects, f.point) for f in leading]
        again: list[Fit] = [f for f in problem.fit(tasks, errors=null_model.errors, rounds=ROUNDS) if f is not None]
        report("by the finer twin: " + ", ".join(f"{f.name} {f.chi2:.0f}" for f in again))
        ends |= {f.effects: f for f in again}
        corrected_at = {f.effects: f for f in leading}
        first = min(again, key=lambda fit: fit.chi2, default=null_model)
        leading = [f for f in again if near_best(f, first) and not _beside(f, corrected_at[f.effects])]
        if not leading:
            break
    # Where all of them break down once they are corrected, they are told as they were.
    return problem, ends.get((), null_model), _best(f for f in ends.values() if f.effects) or best


def running(problem: FitProblem, ends: Iterable[Fit]) -> list[Fit]:
    """Ends of searches with an effect that may be the most probable, best first."""
    order = sorted((f for f in ends if f.effects), key=lambda fit: fit.chi2)
    return [f for k, f in enumerate(order) if k < AHEAD or near_best(f, order[0], problem.chance)]


def alone(fits: Iterable[Fit], effects: Sequence[Hypothesis]) -> list[Fit]:
    """Fits of one of the effects by itself, beside which a second one may be, unlike beside a modulus and a side."""
    return [f for f in fits if len(f.effects) == 1 and f.effects[0] in effects]


def near_best(fit: Fit, best: Fit, chance: float = 0.0) -> bool:
    """Whether a fit leaves no more than some times what the best does, or what noise and chance in touching leave.

    Args:
        fit: That may be in the running.
        best: That leaves the least.
        chance: In touching, over the noise.
    """
    return fit.chi2 < FARTHER * max(best.chi2, (1 + chance**2) * fit.samples)


def _other_valleys(problem: FitProblem, null_model: Fit, ends: Sequence[Fit]) -> list[Fit]:
    """Where fits have many valleys, the null model all over its tolerances, if it is in the running.

    The finer twin has other valleys than the twin in which effects are searched. An effect whose numbers happen to lead
    it into a deep one must not be told where what is stated, a little different, does so, too.
    """
    best = min(ends, key=lambda fit: fit.chi2, default=null_model)
    if problem.finer_twin is None or not problem.many_valleys or not near_best(null_model, best, problem.chance):
        return []
    tasks: list[Task] = [((), point) for point in within_tolerances(problem)]
    return [f for f in problem.fit(tasks, errors=null_model.errors, rounds=0, settle=False) if f is not None]


def _from_the_beginning(problem: FitProblem, effects: Sequence[Hypothesis], most: int) -> list[Task]:
    """Where searches end that see more and more of the trials: that for nothing, and the best for each effect."""
    carried: list[Task] = [((), None)]
    for share in EARLY:
        early = problem.early(share)
        if early is None:
            continue
        still = [f for f in early.fit([t for t in carried if not t[0]], rounds=8) if f is not None]
        if not still:
            continue
        null_model = still[0]
        tasks = [*(t for t in carried if t[0]), *likely(probe_points(early, null_model, effects), null_model, most)]
        ends = _best(early.fit(tasks, errors=null_model.errors, rounds=6, settle=False))
        carried = [((), null_model.point), *((f.effects, f.point) for f in ends)]
    return carried


def _pairs(
    problem: FitProblem, effects: Sequence[Hypothesis], singles: Sequence[Fit], report: Callable[[str], None]
) -> list[Fit]:
    """Two effects together: each in the running with every other, and all pairs, on more and more of the trials.

    Not the best ones alone: which of several that do badly by themselves does best hangs on rounding. Nor from where
    these have ended alone, and in one place: an effect that had to stand for two is far from where it is one of them,
    and a response far off says little of where to begin.
    """
    count = len(problem.common)
    first = {effect: effect.probe_points(problem.twin)[0][0] for effect in effects}
    begun: list[tuple[np.ndarray, dict[Hypothesis, np.ndarray]]] = []
    for k, one in enumerate(singles):
        known = {one.name, *(s.name for s in singles[:k])}
        for other in (e for e in effects if e.name not in known):
            points = other.probe_points(problem.twin)
            for at in sorted({round(i * (len(points) - 1) / (STARTS - 1)) for i in range(STARTS)}):
                begun.append((one.point[:count], {one.effects[0]: one.point[count:], other: points[at][0]}))
                begun.append((np.zeros(count), {one.effects[0]: first[one.effects[0]], other: points[at][0]}))
    for one, other in itertools.combinations(effects, 2):
        if one.name != other.name:
            begun.append((np.zeros(count), {one: first[one], other: first[other]}))
    # Of a leading effect by itself at first, one start is that of its pair: each is simulated once.
    distinct_tasks: dict[tuple[tuple[Hypothesis, ...], bytes], Task] = {}
    for stated, own in begun:
        both = tuple(effect for effect in effects if effect in own)
        point = np.concatenate([stated, *(own[effect] for effect in both)])
        distinct_tasks.setdefault((both, point.tobytes()), (both, point))
    tasks = list(distinct_tasks.values())
    chosen: list[Fit] = []
    for share, most in zip((*EARLY, 1.0), (12, 6, 3), strict=True):
        whole = share == 1
        early = None if whole else problem.early(share)
        where = early or problem
        ends = where.fit(tasks, errors=singles[0].errors, rounds=ROUNDS if whole else 6, settle=whole)
        order = sorted((f for f in ends if f is not None), key=lambda fit: fit.chi2)
        chosen = _best(order)
        leading = ", ".join(f"{fit.name} {fit.chi2:.0f}" for fit in chosen[:4])
        report(f"pairs, {f'first {100 * share:.0f} %' if early else 'all'} of the trials: {leading}")
        # Which of a pair's valleys is the deepest one may show on more of the trials only.
        tasks = [
            (f.effects, f.point)
            for pair in chosen[:most]
            for f in distinct((f for f in order if f.name == pair.name), ENDS_PAIR)
        ]
    return chosen


def _best(fits: Iterable[Fit | None]) -> list[Fit]:
    """The best fit of each effect, or pair of them, best first; without those that broke down."""
    found: dict[str, Fit] = {}
    for fit in sorted((f for f in fits if f is not None), key=lambda fit: fit.chi2):
        found.setdefault(fit.name, fit)
    return list(found.values())


def _fit_null_model(
    problem: FitProblem, tasks: Sequence[Task], report: Callable[[str], None], rounds: int = 8
) -> tuple[FitProblem, Fit]:
    """The fit without effects, and the problem with slips of markers where they explain most of what is left.

    Where there are many valleys, an effect that is searched from more places than the null model would be told for
    having found the better one.
    """
    if problem.many_valleys:
        tasks = [*tasks, *null_starts(problem)]
    while True:
        # What did well on the beginning of the trials may break down later.
        ends = [f for f in problem.fit(tasks, rounds=rounds) if f is not None]
        ends = ends or [f for f in problem.fit([((), None)], rounds=rounds) if f is not None]
        if not ends:
            raise ValueError(BREAKS)
        null_model = min(ends, key=lambda fit: fit.chi2)
        report(f"without an effect: chi-squared {null_model.chi2:.0f} of {null_model.samples} samples")
        left = [
            t.recording.position - seen for t, seen in zip(problem.trials, null_model.seen, strict=True) if t.recording
        ]
        slips = [] if problem.slips else find_slips(problem.trials, problem.noise_models, left)
        if not slips:
            return problem, null_model
        name = problem.experiment.setup.markers[slips[0].marker].name
        report(f"marker {name} slips in trials {', '.join(s.trial for s in slips)}")
        problem = problem.only(problem.trials, slips=tuple(slips))


def varied(fit: Fit) -> float:
    """Excess of ln of the modulus on a stiff side over its mean, by all effects of a fit."""
    return sum(e.varies(v) for e, v in zip(fit.effects, fit.values, strict=True))
