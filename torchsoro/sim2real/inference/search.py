"""From recordings to fits: look at all effects, begin searches where much is promised, lead the best to their end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.inference.discretization import cost
from torchsoro.sim2real.inference.fit import Fit, Problem
from torchsoro.sim2real.inference.likelihood import BREAKS
from torchsoro.sim2real.inference.ranking import BELIEVED, FAINT, correlation, varied
from torchsoro.sim2real.inference.residual import find_slips

KEPT = 6  # searches that are led to their end, of those that do best at first
STARTS = 3  # of each effect, from looks that differ
FAR = 3.0  # times what noise and numerics explain, above which searches begin with the beginning
EARLY = (0.12, 0.35)  # of the trials
PRICED = 1.5  # times what noise and numerics explain, above which what the best effect leaves counts as one of them
PAIRS = 0.002  # of the budget, that the simulation of all trials may take for pairs of effects to be tried
CLEAR = 1.5  # times what noise and numerics explain, above which what a finer twin adds depends on the effect
REFINED = 2  # times that the best are corrected by the finer twin
PARTLY = 4.0  # times as long as with all lanes filled a simulation takes in a search, that fills some
MOST = 10  # effects for which searches are begun
BEHIND = 0.1  # of what the best search has gained, by which others may be behind to be led on
TWICE = 0.25  # of what the best effect leaves, below which two must leave it to be believed
TRIED = 4  # rounds of searches before the best are chosen
ROUNDS = 12  # of a search

Task = tuple[tuple[Hypothesis, ...], np.ndarray | None]  # effects, and where to begin a search


def search(
    problem: Problem, effects: Sequence[Hypothesis], budget: float, report: Callable[[str], None]
) -> tuple[Problem, Fit, list[Fit]]:
    """The best fits.

    Args:
        problem: Recordings and twin.
        effects: To think of.
        budget: Time that this may take on two cores, about [s]; sets how many searches are begun.
        report: Called with a line for each effect.

    Returns:
        The problem with slips and corrections that were found, the fit without an effect, and those with, best first.
    """
    problem, nothing = _nothing(problem, [((), None)], report, rounds=3)
    # By count, not by the clock: what is searched must not depend on the machine.
    each = cost(problem.twin, len(problem.trials), PARTLY)
    most = int(np.clip(0.3 * budget / (10 * each), KEPT, MOST))
    carried: list[Task] = []
    if nothing.misfit > FAR * nothing.samples:
        # Nothing is linear here, but less is wrong at first, where a wrong frequency is not yet a wrong phase. What a
        # finer twin adds to the motion that is believed says little about one that is so different.
        problem = problem.only(problem.trials, correction=problem.stated)
        carried = _from_the_beginning(problem, effects, most)
        problem, nothing = _nothing(problem, [t for t in carried if not t[0]], report)
    else:
        problem = problem.corrected(nothing.point)
        problem, nothing = _nothing(problem, [((), nothing.point)], report)
    tasks = [t for t in carried if t[0]]
    if not tasks:
        looks = _looks(problem, nothing, effects)
        for effect in effects:
            mine = [misfit for misfit, e, _ in looks if e is effect]
            report(f"{effect.name}: would leave {min(mine):.0f}" if mine else f"{effect.name}: breaks down")
        tasks = _likely(looks, nothing, most)
    tried = []
    freed = _freed(problem, effects, nothing)
    if len(tasks) > KEPT:
        tried = [f for f in problem.fit(tasks, errors=nothing.errors, rounds=TRIED, settle=False) if f is not None]
        tried.sort(key=lambda fit: fit.misfit)
        behind = tried[0].misfit + BEHIND * max(nothing.misfit - tried[0].misfit, 0.0)
        led = [f for i, f in enumerate(tried[:KEPT]) if i < 3 or f.misfit < behind]
        # A modulus that is not believed may be that of a stiff side.
        led += [f for f in tried if freed and varied(f) > 0 and f not in led]
        tasks = [(f.effects, f.point) for f in led]
    tasks += freed
    best = _best([*problem.fit(tasks, errors=nothing.errors, rounds=ROUNDS), *tried])
    if best and nothing.misfit > CLEAR * nothing.samples:
        problem, nothing, best = _refined(problem, nothing, best, report)
    if best and best[0].misfit > FAR * best[0].samples and each < PAIRS * budget:
        left = best[0].misfit - best[0].samples
        pairs = [f for f in _pairs(problem, effects, best, report) if f.misfit - f.samples < TWICE * left]
        best = _best([*best, *pairs])
    return problem, nothing, _simpler(problem, effects, best)


def _refined(
    problem: Problem, nothing: Fit, best: list[Fit], report: Callable[[str], None]
) -> tuple[Problem, Fit, list[Fit]]:
    """The best fits again, each corrected by the finer twin where it is itself, until they are fits of that twin."""
    leading = [nothing, *best[:KEPT]]
    for _ in range(REFINED):
        problem = problem.corrected_each([(f.effects, f.point[None]) for f in leading])
        tasks: list[Task] = [(f.effects, f.point) for f in leading]
        leading = [f for f in problem.fit(tasks, errors=nothing.errors, rounds=ROUNDS) if f is not None]
        report("by the finer twin: " + ", ".join(f"{f.name} {f.misfit:.0f}" for f in leading))
    # Where all of them break down once they are corrected, they are told as they were.
    refined = _best(f for f in leading if f.effects) or best
    return problem, next((f for f in leading if not f.effects), nothing), refined


def _simpler(problem: Problem, effects: Sequence[Hypothesis], best: list[Fit]) -> list[Fit]:
    """Fits without those of the best that come to a simpler effect, which are fitted as that."""
    for fit in [f for f in best[:3] if len(f.effects) == 1]:
        told = fit.effects[0].simpler(fit.values[0])
        plain = [e for e in effects if told is not None and e.name == told[0]]
        if told is None or not plain:
            continue
        known = len(fit.belief)
        start = np.concatenate([fit.point[:known], told[1] / problem.scales((plain[0],))[known:]])
        (again,) = problem.fit([((plain[0],), start)], errors=fit.errors, rounds=ROUNDS)
        if again is not None and again.misfit < fit.misfit + 2 * FAINT * correlation(fit):
            best = _best([*(f for f in best if f is not fit), again])
    return best


def _freed(problem: Problem, effects: Sequence[Hypothesis], nothing: Fit) -> list[Task]:
    """Where a belief is strained: what sets it free, which every other effect must do better than."""
    found: list[Task] = []
    for i, (common, tolerance) in enumerate(problem.common):
        for effect in effects:
            if type(effect) is type(common) and abs(nothing.point[i]) > BELIEVED:
                rest = np.where(np.arange(len(nothing.point)) == i, 0.0, nothing.point)
                strength = nothing.point[i] * tolerance / effect.quantities[0].scale
                found.append(((effect,), np.append(rest, strength)))
    return found


def _looks(problem: Problem, nothing: Fit, effects: Sequence[Hypothesis]) -> list[tuple[float, Hypothesis, np.ndarray]]:
    """What each effect's looks would leave, and where to begin a search; from nothing, and from what is believed."""
    bases = [problem.base(nothing)]
    if nothing.misfit > FAR * nothing.samples:
        bases.append(problem.base())
    looks = []
    for base in bases:
        for effect, ranked in zip(effects, problem.look(effects, base), strict=True):
            looks += [(misfit, effect, start) for misfit, start in ranked]
    return looks


def priced(
    problem: Problem, nothing: Fit, fits: list[Fit], report: Callable[[str], None]
) -> tuple[Problem, Fit, list[Fit]]:
    """Where even the best effect leaves much, that is a part of what may be off, and all is fitted again.

    Otherwise a clock or a scale would be bent, far beyond belief, to take up what the model lacks.
    """
    fits = fits[:KEPT]
    own = problem.numerics
    for _ in range(4):
        if not fits or fits[0].misfit < PRICED * fits[0].samples:
            break
        left = []
        for trial, seen, numerics in zip(problem.trials, fits[0].seen, own, strict=True):
            assert trial.recording is not None
            off = np.sqrt(np.nanmean((trial.recording.place - seen) ** 2))
            left.append(np.sqrt(numerics**2 + (1.2 * off) ** 2))
        report(f"what the best leaves is priced: {', '.join(f'{1e3 * float(n.mean()):.2f} mm' for n in left)}")
        problem = problem.only(problem.trials, numerics=left)
        tasks: list[Task] = [((), nothing.point), *((f.effects, f.point) for f in fits)]
        again, *rest = problem.fit(tasks, rounds=ROUNDS)
        nothing = again or nothing
        fits = _best(rest)
    return problem, nothing, fits


def _from_the_beginning(problem: Problem, effects: Sequence[Hypothesis], most: int) -> list[Task]:
    """Where searches end that see more and more of the trials: that for nothing, and the best for each effect."""
    carried: list[Task] = [((), None)]
    for share in EARLY:
        early = problem.early(share)
        if early is None:
            continue
        still = [f for f in early.fit([t for t in carried if not t[0]], rounds=8) if f is not None]
        if not still:
            continue
        nothing = still[0]
        tasks = [*(t for t in carried if t[0]), *_likely(_looks(early, nothing, effects), nothing, most)]
        ends = _best(early.fit(tasks, errors=nothing.errors, rounds=6, settle=False))
        carried = [((), nothing.point), *((f.effects, f.point) for f in ends)]
    return carried


def _pairs(
    problem: Problem, effects: Sequence[Hypothesis], singles: Sequence[Fit], report: Callable[[str], None]
) -> list[Fit]:
    """Two effects together: each of the three that do best with every other, on more and more of the trials."""
    singles = singles[:3]
    tasks: list[Task] = []
    for k, one in enumerate(singles):
        known = {one.name, *(s.name for s in singles[:k])}
        for other in effects:
            if other.name not in known:
                tasks.append(((*one.effects, other), np.concatenate([one.point, other.looks(problem.twin)[-1][0]])))
    chosen: list[Fit] = []
    for share, most in zip((*EARLY, 1.0), (12, 6, 3), strict=True):
        whole = share == 1
        early = None if whole else problem.early(share)
        where = early or problem
        chosen = _best(where.fit(tasks, errors=singles[0].errors, rounds=ROUNDS if whole else 6, settle=whole))
        leading = ", ".join(f"{fit.name} {fit.misfit:.0f}" for fit in chosen[:4])
        report(f"pairs, {f'first {100 * share:.0f} %' if early else 'all'} of the trials: {leading}")
        tasks = [(f.effects, f.point) for f in chosen[:most]]
    return chosen


def _best(fits: Iterable[Fit | None]) -> list[Fit]:
    """The best fit of each effect, or pair of them, best first; without those that broke down."""
    found: dict[str, Fit] = {}
    for fit in sorted((f for f in fits if f is not None), key=lambda fit: fit.misfit):
        found.setdefault(fit.name, fit)
    return list(found.values())


def _nothing(
    problem: Problem, tasks: Sequence[Task], report: Callable[[str], None], rounds: int = 8
) -> tuple[Problem, Fit]:
    """The fit without effects, and the problem with slips of markers where they explain most of what is left."""
    while True:
        # What did well on the beginning of the trials may break down later.
        ends = [f for f in problem.fit(tasks, rounds=rounds) if f is not None]
        ends = ends or [f for f in problem.fit([((), None)], rounds=rounds) if f is not None]
        if not ends:
            raise ValueError(BREAKS)
        nothing = min(ends, key=lambda fit: fit.misfit)
        report(f"nothing: misfit {nothing.misfit:.0f} of {nothing.samples} samples")
        left = [t.recording.place - seen for t, seen in zip(problem.trials, nothing.seen, strict=True) if t.recording]
        slips = [] if problem.slips else find_slips(problem.trials, problem.bands, left)
        if not slips:
            return problem, nothing
        name = problem.experiment.setup.markers[slips[0].marker].name
        report(f"marker {name} slips in trials {', '.join(s.trial for s in slips)}")
        problem = problem.only(problem.trials, slips=slips)


def _likely(looks: Sequence[tuple[float, Hypothesis, np.ndarray]], nothing: Fit, most: int) -> list[Task]:
    """Where to begin searches: each effect that promises something at its best look, then at others that differ."""
    unit = max(1.0, nothing.misfit / nothing.samples) * correlation(nothing)
    strained = np.abs(nothing.point).max(initial=0.0) > 1  # so that much is taken up that it should not be
    first: list[Task] = []
    more: list[Task] = []
    known: dict[str, list[np.ndarray]] = {}
    for misfit, effect, start in sorted(looks, key=lambda look: look[0]):
        faint = nothing.misfit - misfit < 2 * FAINT * unit
        if faint and nothing.misfit < 2 * nothing.samples and not strained:
            continue
        mine = known.setdefault(effect.name, [])
        if not mine:
            first.append(((effect,), start))
        elif len(mine) < STARTS:
            scale = np.where(np.abs(start) > 1, np.abs(start), 1.0)
            if not all((np.abs(start - k) / scale).max() > 0.4 for k in mine):
                continue
            more.append(((effect,), start))
        else:
            continue
        mine.append(start)
    return [*first, *more][:most]


def within(problem: Problem, nothing: Fit) -> float:
    """The misfit without an effect, with modulus and pressure no further off than one believes."""
    point = np.clip(nothing.point, -BELIEVED, BELIEVED)
    if (point == nothing.point).all():
        return nothing.misfit
    motions = problem.simulate([((), point[None])])[0]
    misfit = problem.measure([m.alone() for m in motions], nothing.errors)[0]
    return max(misfit, nothing.misfit) if math.isfinite(misfit) else nothing.misfit
