"""From recordings to a verdict: look at all effects, fit the likely ones, and say what can be said."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchsoro.sim2real.body_effects import Modulus
from torchsoro.sim2real.experiment import Trial
from torchsoro.sim2real.fit import Fit, Problem
from torchsoro.sim2real.heldout import predict_all
from torchsoro.sim2real.hypothesis import Hypothesis
from torchsoro.sim2real.library import library
from torchsoro.sim2real.likelihood import BREAKS, EDGE
from torchsoro.sim2real.outer_effects import PressureGain
from torchsoro.sim2real.residual import find_slips

KEPT = 6  # searches that are led to their end, of those that do best at first
STARTS = 3  # of each effect, from looks that differ
FAR = 3.0  # times what noise and numerics explain, above which searches begin with the beginning
EARLY = (0.12, 0.35)  # of the trials
PRICED = 1.5  # times what noise and numerics explain, above which what the best effect leaves counts as one of them
PAIRS = 0.002  # of the budget, that the simulation of all trials may take for pairs of effects to be tried
FORM = 0.001  # of what an effect takes away, that may be due to its form: nature's is never just the hypothesis'
MOST = 10  # effects for which searches are begun
BEHIND = 0.1  # of what the best search has gained, by which others may be behind to be led on
BELIEVED = 1 + 3 * EDGE  # of its tolerance, that a believed number may be off
MISTRUST = 12.0  # of the score, that measurement errors beyond belief cost at most
LEANS = 20.0  # of the score, that an effect must do better than a free modulus if it needs that too
BENT = 3.0  # standard deviations of a measurement error, beyond which it tells against an effect
TWICE = 0.25  # of what the best effect leaves, below which two must leave it to be believed
FOLDS = 4  # trials that are left out, one after the other
TRIED = 4  # rounds of searches before the best are chosen
FAINT = 4.0  # of the score that a look promises, below which nothing is fitted
ROUNDS = 12  # of a search


Task = tuple[tuple[Hypothesis, ...], np.ndarray | None]  # effects, and where to begin a search


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What decides; from a batch of cases with known answers that was made for this.

    Attributes:
        alarm: Score and gain below which nothing is missing.
        margin: Of the score, within which two effects are not told apart: odds of twenty to one.
        quiet: Times what noise and numerics explain, without an effect, below which nothing is missing if none is
            believed.
        some: The same, above which an effect must take away ``part`` of it.
        part: The least share of the misfit.
        beyond: As ``quiet``, with the best effect, above which it leaves something.
        share: Of the misfit that the best effect takes away, below which what is left is of its own kind.
        lost: Largest error on trials left out, over that without an effect, at which an effect is believed.
        noisy: The same where noise and numerics explain most and the gain is above ``sure``.
        sure: Such a gain; without anything missing it has never been found.
        worse: Times the error on trials left out of the effect that predicts them best, at which another is.
    """

    alarm: float = 40.0
    margin: float = 3.0
    quiet: float = 1.7
    some: float = 1.3
    part: float = 0.5
    beyond: float = 2.0
    share: float = 0.9
    lost: float = 0.85
    noisy: float = 0.95
    sure: float = 150.0
    worse: float = 1.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """An effect and how well it does.

    Attributes:
        fit: The best of it.
        score: What it gains in ln of the likelihood over nothing, less what its parameters are worth. Residuals of a
            wrong model are neither white nor of the variance that was thought: the gain counts in units of what the
            best effect leaves, neighbouring samples that are alike count once, no difference counts that the form of
            an effect may make, and measurement errors far beyond belief tell against it.
        gain: The same over nothing with any modulus and pressure, without allowance for its form.
        explained: Share of the misfit beyond noise and numerics that it takes away.
        kept: Error on trials that were left out over that without an effect; not a number where none was.
    """

    fit: Fit
    score: float
    gain: float
    explained: float
    kept: float = math.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class Verdict:
    """What can be said.

    Attributes:
        kind: "explained", "nothing_missing", "unknown_physics" or "cannot_distinguish".
        problem: With the slips of markers that were found.
        nothing: The fit without any effect.
        ranking: The effects that were fitted, best first.
        chosen: The effects that explain the difference: one, or several that cannot be told apart.
        excess: What is left over what noise and numerics explain, for the best effect: 1 if nothing is left.
        heldout: Of trials that were left out, the error as believed and with the best effect [m].
    """

    kind: str
    problem: Problem
    nothing: Fit
    ranking: tuple[Candidate, ...]
    chosen: tuple[Candidate, ...] = field(default=())
    excess: float = 1.0
    heldout: dict[str, tuple[float, float]] = field(default_factory=dict)


def judge(
    problem: Problem,
    effects: Sequence[Hypothesis] | None = None,
    *,
    kept: Sequence[Trial] = (),
    thresholds: Thresholds | None = None,
    budget: float = 600.0,
    report: Callable[[str], None] = print,
) -> Verdict:
    """Find what was left out.

    Args:
        problem: Recordings and twin.
        effects: What is thought of; the library if None.
        kept: Trials that are only predicted. Without any, each of three or more is predicted from the others.
        thresholds: What decides.
        budget: Time that this may take, about [s]; sets how many searches are begun.
        report: Called with a line for each effect.
    """
    effects = problem.thought_of(library() if effects is None else effects)
    problem, nothing = _nothing(problem, [((), None)], report, rounds=3)
    begin = problem.tally
    each = begin.seconds / max(begin.simulations, 1) * len(problem.trials)
    most = int(np.clip(0.3 * budget / (10 * each), KEPT, MOST))
    carried: list[Task] = []
    if nothing.misfit > FAR * nothing.samples:
        # Nothing is linear here, but less is wrong at first, where a wrong frequency is not yet a wrong phase. What a
        # finer twin adds to the motion that is believed says little about one that is so different.
        problem = problem.only(problem.trials, correction={})
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
    if len(tasks) > KEPT:
        tried = [f for f in problem.fit(tasks, errors=nothing.errors, rounds=TRIED, settle=False) if f is not None]
        tried.sort(key=lambda fit: fit.misfit)
        behind = tried[0].misfit + BEHIND * max(nothing.misfit - tried[0].misfit, 0.0)
        tasks = [(f.effects, f.point) for i, f in enumerate(tried[:KEPT]) if i < 3 or f.misfit < behind]
    tasks += _freed(problem, effects, nothing)
    best = _best([*problem.fit(tasks, errors=nothing.errors, rounds=ROUNDS), *tried[KEPT:]])
    if best and best[0].misfit > FAR * best[0].samples and each < PAIRS * budget:
        left = best[0].misfit - best[0].samples
        pairs = [f for f in _pairs(problem, effects, best, report) if f.misfit - f.samples < TWICE * left]
        best = _best([*best, *pairs])
    believed = _within(problem, nothing)
    plain = rank(best, nothing, believed, problem.camera.deviations)
    start = nothing.misfit / nothing.samples
    excess = min((c.fit.misfit for c in plain), default=nothing.misfit) / nothing.samples
    own = problem
    problem, nothing, fits = _priced(problem, nothing, best, report)
    believed = believed if problem is own else _within(problem, nothing)
    # What is explained, and what is left, is told by noise and the twin's own error alone.
    explained = {c.fit.name: c.explained for c in plain}
    found = [
        dataclasses.replace(c, explained=explained.get(c.fit.name, 0.0))
        for c in rank(fits, nothing, believed, problem.camera.deviations)
    ]
    found, heldout = _proved(problem, nothing, found, kept)
    for c in found:
        report(f"{c.fit.name}: misfit {c.fit.misfit:.0f}, score {c.score:.1f}, kept {c.kept:.2f}, {tell(c.fit)}")
    verdict = decide(problem, nothing, found, excess, thresholds or Thresholds(), start=start)
    shown = verdict.chosen[0].fit.name if verdict.chosen else "nothing"
    return dataclasses.replace(verdict, heldout=heldout.get(shown, {}))


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


def _priced(
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
        if min(len(t.recording.time) for t in early.trials if t.recording) < 8:
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
        where, whole = (problem.early(share), False) if share < 1 else (problem, True)
        chosen = _best(where.fit(tasks, errors=singles[0].errors, rounds=ROUNDS if whole else 6, settle=whole))
        leading = ", ".join(f"{fit.name} {fit.misfit:.0f}" for fit in chosen[:4])
        report(f"pairs, first {100 * share:.0f} % of the trials: {leading}")
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


def tell(fit: Fit) -> str:
    """Parameters in one line."""
    parts = []
    for effect, values in zip(fit.effects, fit.values, strict=True):
        parts += [f"{q.name} = {v:.3g} {q.unit}" for q, v in zip(effect.quantities, values, strict=False)]
        if effect.local:
            parts.append("at " + ", ".join(f"{1e3 * v:.1f}" for v in values[len(effect.quantities) :]) + " mm")
    return ", ".join(parts)


def _within(problem: Problem, nothing: Fit) -> float:
    """The misfit without an effect, with modulus and pressure no further off than one believes."""
    point = np.clip(nothing.point, -BELIEVED, BELIEVED)
    if (point == nothing.point).all():
        return nothing.misfit
    motions = problem.simulate([((), point[None])])[0]
    misfit = problem.measure([m.alone() for m in motions], nothing.errors)[0]
    return max(misfit, nothing.misfit) if math.isfinite(misfit) else nothing.misfit


def rank(fits: Sequence[Fit], nothing: Fit, believed: float, deviations: np.ndarray) -> list[Candidate]:
    """Score fits that are better than nothing, best first.

    Args:
        fits: Of effects.
        nothing: The fit without any.
        believed: Its misfit within beliefs.
        deviations: That measurement errors are believed to have.
    """
    fits = [fit for fit in fits if fit.misfit < nothing.misfit]
    if not fits:
        return []
    best = min(fits, key=lambda fit: fit.misfit)
    alike = correlation(best)
    gained = believed - best.misfit
    bare = 2 * max(1.0, best.misfit / best.samples) * alike
    unit = max(bare, 2 * FORM * gained)
    worth = 0.5 * math.log(min(best.samples / alike, 1 / FORM))
    freed = [f for f in fits if f.effects and all(isinstance(e, Modulus | PressureGain) for e in f.effects)]
    if freed:
        # Others lean on a modulus, or a pressure, that is not believed: they must do more than what sets it free.
        enough = min(f.misfit for f in freed) - LEANS * unit
        fits = [
            f for f in fits if f in freed or f.misfit <= enough or np.abs(f.point[: len(f.belief)]).max() <= BELIEVED
        ]
    found = [
        Candidate(
            fit=fit,
            score=(believed - fit.misfit) / unit - fit.unknowns * worth - _bent(fit, deviations),
            # What sets a modulus free gains over one that is believed.
            gain=((believed if fit in freed else nothing.misfit) - fit.misfit) / bare - fit.unknowns * worth,
            explained=min((believed - fit.misfit) / max(believed - fit.samples, 1.0), 1.0),
        )
        for fit in fits
    ]
    return sorted(found, key=lambda c: -c.score)


def _bent(fit: Fit, deviations: np.ndarray) -> float:
    """What it costs that measurement errors are far beyond belief: something, as beliefs may be wrong."""
    return min(0.5 * float((np.maximum(np.abs(fit.errors / deviations) - BENT, 0.0) ** 2).sum()), MISTRUST)


def correlation(fit: Fit) -> float:
    """How many neighbouring samples of the whitened residual say the same."""
    above = below = 0.0
    for r in fit.whitened:
        above += float(r[1:] @ r[:-1])
        below += float(r @ r)
    rho = min(max(above / max(below, 1e-300), 0.0), 0.98)
    return (1 + rho) / (1 - rho)


def _proved(
    problem: Problem, nothing: Fit, found: list[Candidate], kept: Sequence[Trial]
) -> tuple[list[Candidate], dict[str, dict[str, tuple[float, float]]]]:
    """The candidates near the best with their error on trials left out; and by name, errors as believed and with it."""
    near = [c for c in found if c.gain > FAINT and c.score > 0.5 * found[0].score][:3]
    fits = [nothing, *(c.fit for c in near)]
    if kept:
        folds = [(problem, fits, list(kept))]
    elif len(problem.trials) < 3 or not near:
        return found, {}
    else:
        folds = []
        for i, trial in enumerate(problem.trials[:FOLDS]):
            where = problem.only([t for t in problem.trials if t is not trial])
            folds.append((where, [problem.without(fit, i) for fit in fits], [trial]))
    squares = np.zeros(len(fits))
    heldout: dict[str, dict[str, tuple[float, float]]] = {fit.name: {} for fit in fits}
    for where, (still, *others), trials in folds:
        # Nothing is what is within beliefs.
        mine = [dataclasses.replace(still, point=np.clip(still.point, -BELIEVED, BELIEVED)), *others]
        told = predict_all(where, mine, trials)
        believed = predict_all(where, mine[:1], trials, believed=True)[0]
        if not told[0] or not believed:
            return found, {}
        for k, (fit, row) in enumerate(zip(mine, told, strict=True)):
            squares[k] += sum(p.total**2 for p in row) if row else math.inf
            heldout[fit.name] |= {b.trial: (b.total, p.total) for b, p in zip(believed, row, strict=False)}
    ratios = np.sqrt(squares / squares[0])
    proved = {id(c): float(ratio) for c, ratio in zip(near, ratios[1:], strict=True)}
    return [dataclasses.replace(c, kept=proved.get(id(c), math.nan)) for c in found], heldout


def decide(
    problem: Problem, nothing: Fit, found: Sequence[Candidate], excess: float, t: Thresholds, *, start: float
) -> Verdict:
    """The verdict on a ranking.

    Args:
        problem: That was fitted.
        nothing: Without an effect.
        found: Effects, best first.
        excess: Times what noise and numerics explain that the best leaves.
        t: What decides.
        start: As ``excess``, without an effect.
    """
    believed = [c for c in found if c.gain > t.alarm]
    if any(math.isfinite(c.kept) for c in found):
        least = min((c.kept for c in believed if math.isfinite(c.kept)), default=math.nan)
        # Where most of an error is noise, even the truth takes little of it away.
        most = [t.noisy if start < t.some and c.gain > t.sure else t.lost for c in believed]
        believed = [c for c, lost in zip(believed, most, strict=True) if c.kept <= min(lost, t.worse * least)]
    best = believed[0] if believed else None
    common = {"problem": problem, "nothing": nothing, "ranking": tuple(found), "excess": excess}
    little = best is not None and start > t.some and best.explained < t.part
    if best is None or best.score < t.alarm or little:
        return Verdict(kind="nothing_missing" if start < t.quiet else "unknown_physics", **common)
    if excess > t.beyond and best.explained < t.share:
        return Verdict(kind="unknown_physics", **common)
    close = tuple(c for c in believed if c.score > best.score - t.margin)
    kind = "explained" if len(close) == 1 else "cannot_distinguish"
    return Verdict(kind=kind, chosen=close, **common)
