"""From fits to evidence: each fit as a model near its end, corrected by finer twins, with its priors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from torchsoro.sim2real.hypotheses.outer_effects import Friction
from torchsoro.sim2real.inference.decision import FREEDOM, STRENGTH, TOLERANCE
from torchsoro.sim2real.inference.evidence import (
    Linearised,
    Model,
    Posterior,
    TwinError,
    infer,
)
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.laplace import Mode
from torchsoro.sim2real.inference.lasting import with_lasting_noise
from torchsoro.sim2real.inference.least_squares import closest
from torchsoro.sim2real.inference.likelihood import BREAKS, Effects, Likelihood, Request
from torchsoro.sim2real.inference.observed import Data, Motions, TrialData, size_of
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.remaining_error import by_richardson, by_spread, chance_in
from torchsoro.sim2real.inference.touching import GAPS, averaged, shifted
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.inference.weighing import Weighing
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

FAR = 10.0  # deviations of a measurement error, beyond which its slope at rest says nothing
# Of ln of a coefficient of friction, from trial to trial: with one, a soft block slides 0 to 5 % farther than
# a rigid one, as it sticks here and there, in cells of 6.5 to 2.6 mm and in another code.
SLIDING = 0.03
LEAST_RATIO = 1.1  # of the edges of two twins, that count as one finer than the other
RESOLVED = 2  # cells through the thinnest wall, from which on the error falls with their edge

Moved = Mapping[Fit, Sequence[Motions]]  # residuals by the finer twin with planes moved; none where one breaks down
_Others = tuple[Sequence[Motions], Sequence[Motions]]  # errors by what is as good, and by what would be better


def data_of(problem: Likelihood) -> Data:
    """The recordings that a problem is fitted to."""
    trials = [
        TrialData(name=t.name, time=t.recording.time, position=t.recording.position)
        for t in problem.trials
        if t.recording is not None
    ]
    return Data(trials=tuple(trials), noise=problem.noise, lasting=problem.lasting)


def model_of(problem: Likelihood, effects: Effects) -> Model:
    """A model with the priors of all unknowns that move.

    Strengths have Student's t distribution, cut where a quantity cannot be; the second quantity of an effect that may
    be negative, as the logarithm of a time, is a shape, uniform as a place is.
    """
    held = held_of(problem, effects)
    priors = [Prior(TOLERANCE) for _ in problem.common]
    low, high = problem.bounds(effects)
    released: list[int] = []
    for effect in effects:
        if any(isinstance(effect, type(one)) for one, _ in problem.common):
            released += range(len(priors), len(priors) + len(effect.quantities))
        for i, q in enumerate(effect.quantities):
            shape = i > 0 and q.least < 0 and not effect.joint
            width = math.inf if shape else STRENGTH
            priors.append(Prior(width, freedom=FREEDOM, low=q.least, high=q.most))
        for k in range(len(priors), len(priors) + 3 * effect.local):
            priors.append(Prior(math.inf, low=low[k], high=high[k]))
    moving = [p for p, h in zip(priors, held, strict=True) if not h]
    stated = tuple(one.name for (one, _), h in zip(problem.common, held, strict=False) if not h)
    faults = [Prior(d, freedom=FREEDOM, low=-FAR * d, high=FAR * d) for d in map(float, problem.observation.deviations)]
    return Model(
        effects=tuple(e.name for e in effects),
        priors=(*moving, *faults),
        own=tuple(range(len(stated), len(moving))),
        simpler=simpler_of(effects),
        stated=stated,
        released=tuple(k - (len(held) - len(moving)) for k in released),
        forms=tuple(sorted(type(e).__name__ for e in effects)),
    )


def held_of(problem: Likelihood, effects: Effects) -> np.ndarray:
    """Unknowns that stay as stated: a belief beside an effect that is the same number without its tolerance."""
    held = [any(isinstance(e, type(one)) for e in effects) for one, _ in problem.common]
    return np.array(held + [False] * (len(problem.scales(effects)) - len(held)))


def simpler_of(effects: Effects) -> tuple[str, ...]:
    """Names that effects are extensions of: of a pair its members, of one what is left without some of its numbers."""
    if len(effects) > 1:
        return tuple(e.name for e in effects)
    return tuple(s.name for e in effects for s in e.simpler(np.zeros(len(e.quantities) + 3 * e.local)))


def near(
    problem: FitProblem, fits: Sequence[Fit], *, closely: bool = False, moved: Moved | None = None
) -> list[Linearised | None]:
    """Fits as linearised models, with the error that finer twins leave; all simulated together.

    Without a finer twin, or with trials that come with a simulation of their own, models are those of the problem
    itself, with the error that it states.

    Args:
        problem: That was fitted.
        fits: Ends of searches.
        closely: Whether, of rough motions, planes are moved in the finer twin, which takes some times as long.
        moved: What was simulated of that before, see :func:`planes_moved`.

    Returns:
        A model of each; None where a simulation breaks down.
    """
    finer = problem.finer_twin
    bare = problem.discretization if finer is None else DiscretizationError(shift=tuple(problem.shift))
    coarse = problem.only(problem.trials, discretization=bare)
    steps = [problem.steps(f.effects, f.point, f.columns) for f in fits]
    asked = [
        (f.effects, np.concatenate([f.point[None], f.point + np.diag(h)])) for f, h in zip(fits, steps, strict=True)
    ]
    beside = averaged(coarse, asked, problem.looks)
    models: list[Linearised | None] = []
    for f, h, motions in zip(fits, steps, beside, strict=True):
        if not all(m.sound.all() for m in motions):
            models.append(None)
            continue
        moving = ~held_of(problem, f.effects)
        models.append(
            Linearised(
                model=model_of(problem, f.effects),
                at=np.concatenate([f.point[moving], f.errors]),
                residuals=_left(problem, [m.alone(0) for m in motions], f.errors),
                slopes=_slopes(problem, motions, h, moving, f.errors),
                numerics=TwinError(amplitude=_deviation(problem, bare)),
            )
        )
    if finer is None:
        return models
    others: list[_Others] = []
    for f, motions, m in zip(fits, beside, models, strict=True):
        at, known = [x.alone(0) for x in motions], problem.discretization
        alike = [] if m is None else [*_by_other_cells(problem, at, f, known.between), *_by_sliding(problem, f, m)]
        left = [] if m is None else _by_other_cells(problem, at, f, known.smaller, known.unsure)
        others.append((alike, left))
    return _corrected(problem, coarse, fits, models, others, finer, closely, moved or {})


def _corrected(
    problem: FitProblem,
    coarse: FitProblem,
    fits: Sequence[Fit],
    models: Sequence[Linearised | None],
    others: Sequence[_Others],
    fine: Twin,
    closely: bool,
    moved: Moved,
) -> list[Linearised | None]:
    """Models with the residuals by finer twins, and the error of these."""
    data = data_of(problem)
    by_fine = problem.by(fine)
    edges = problem.twin.edge / fine.edge
    # Of larger cells, one as wide as a wall is no measure.
    resolved = min(problem.discretization.walls, default=0) >= RESOLVED
    known = _deviation(problem, problem.discretization) if resolved else 0.0

    def spread(model: Linearised | None, variants: Sequence[Motions], own: _Others) -> Linearised | None:
        """A model by equally good twins; none where a simulation broke down."""
        if model is None or not variants:
            return None
        return by_spread(data, model, variants, GAPS, model.residuals, edges, *own, known)

    if problem.rough and closely:
        fresh = [f for f in fits if f not in moved]
        moved = {**moved, **dict(zip(fresh, _touching(problem, by_fine, fresh), strict=True))}
        return [spread(model, moved[f], own) for f, model, own in zip(fits, models, others, strict=True)]
    ask: list[Request] = [(f.effects, f.point[None]) for f in fits]
    motions = by_fine.simulate(ask)
    sharp = [_residuals(problem, f, m) for f, m in zip(fits, motions, strict=True)]
    if problem.many_valleys:
        # What a plane's place changes, by the twin in use: it is of that order in the finer one.
        found: list[Linearised | None] = []
        touching = _touching(problem, coarse, fits)
        for model, own, finer, variants in zip(models, others, sharp, touching, strict=True):
            finest = [_sum(finer[0], v, model.residuals) for v in variants] if model is not None and finer else []
            found.append(spread(model, finest, own))
        return found
    if problem.touches:
        # Chance is about the same at all points, as long as nothing is looked at closely: that at the setup as stated.
        touching = [
            _with_planes_moved(problem, f, m) if finer else [] for f, m, finer in zip(fits, motions, sharp, strict=True)
        ]
        return [spread(model, variants, own) for model, own, variants in zip(models, others, touching, strict=True)]
    # The coarser one moves as the finer one does, as far as a modulus and a pressure can make it.
    ratio = max((fine.count / problem.twin.count) ** (1 / 3), LEAST_RATIO)
    return [
        by_richardson(data, dataclasses.replace(model, residuals=finer[0]), model.residuals, ratio)
        if model is not None and finer
        else None
        for model, finer in zip(models, sharp, strict=True)
    ]


def _deviation(problem: Likelihood, error: DiscretizationError) -> np.ndarray:
    """Standard deviation of the twin's error that is stated, over the trials [A, M] m."""
    return np.asarray(np.sqrt(np.mean([error.of(t) ** 2 for t in problem.trials], 0)).T)


def _touching(problem: Likelihood, twin: Likelihood, fits: Sequence[Fit]) -> list[list[Motions]]:
    """Residuals with planes a little nearer and farther, of each fit; none where one breaks down."""
    moved = shifted(twin, [(f.effects, f.point[None]) for f in fits], GAPS)
    return [_residuals(problem, f, motions) for f, motions in zip(fits, moved, strict=True)]


def _with_planes_moved(problem: Likelihood, fit: Fit, motions: Sequence[MarkerTrajectory]) -> list[Motions]:
    """Residuals with planes a little nearer and farther, by what that adds to the setup as stated."""
    alone = [m.alone() for m in motions]
    moved = [
        [m.plus(by[t.name]) for m, t in zip(alone, problem.trials, strict=True)]
        for by in problem.discretization.touching
    ]
    return [_left(problem, variant, fit.errors) for variant in moved]


def _by_other_cells(
    problem: Likelihood,
    motions: Sequence[MarkerTrajectory],
    fit: Fit,
    known: Mapping[str, MarkerTrajectory],
    share: float = 1.0,
) -> list[Motions]:
    """What other cells change in residuals, by a share of what they are known to change in the setup as stated."""
    if not known:
        return []
    moved = [m.plus(known[t.name], share) for m, t in zip(motions, problem.trials, strict=True)]
    with_them, without = (_left(problem, m, fit.errors) for m in (moved, motions))
    return [tuple(a - b for a, b in zip(with_them, without, strict=True))]


def _by_sliding(problem: Likelihood, fit: Fit, model: Linearised) -> list[Motions]:
    """What a coefficient of friction that differs from trial to trial changes, in each trial by itself."""
    everything = [*(e for e, _ in problem.common), *fit.effects]
    known = [e for e in everything if isinstance(e, Friction)]
    if not known:
        return []
    # Where friction is an effect the belief is held, so that it is the last of its kind that moves.
    starts = np.cumsum([0, *(1 for _ in problem.common), *(len(e.quantities) + 3 * e.local for e in fit.effects)])
    at = int(starts[everything.index(known[-1])])
    column = int((~held_of(problem, fit.effects))[:at].sum())
    size = SLIDING / float(problem.scales(fit.effects)[at])
    return [
        tuple(size * (i == k) * slopes[..., column] for i, slopes in enumerate(model.slopes))
        for k in range(len(model.slopes))
    ]


def _residuals(problem: Likelihood, fit: Fit, motions: Sequence[MarkerTrajectory]) -> list[Motions]:
    """Residuals by each variation of motions, with the measurement errors of a fit; none where one breaks down."""
    if not all(m.sound.all() for m in motions):
        return []
    return [_left(problem, [m.alone(k) for m in motions], fit.errors) for k in range(len(motions[0].position))]


def _sum(one: Motions, more: Motions, less: Motions) -> Motions:
    """One and what is more than less of it, in each trial."""
    return tuple(a + b - c for a, b, c in zip(one, more, less, strict=True))


def _left(problem: Likelihood, motions: Sequence[MarkerTrajectory], errors: np.ndarray) -> Motions:
    """Residuals of each trial."""
    return tuple(
        t.recording.position - problem.observation.observe(m, i, errors)
        for i, (t, m) in enumerate(zip(problem.trials, motions, strict=True))
        if t.recording is not None
    )


def _slopes(
    problem: Likelihood, motions: Sequence[MarkerTrajectory], steps: np.ndarray, moving: np.ndarray, errors: np.ndarray
) -> Motions:
    """Derivatives by the unknowns that move, and by the measurement errors."""
    found = []
    for i, motion in enumerate(motions):
        seen, by = problem.observation.linearise(motion.alone(0), i, errors)
        columns = [
            (problem.observation.observe(motion.alone(k + 1), i, errors) - seen) / steps[k]
            for k in (int(k) for k in np.flatnonzero(moving))
        ]
        found.append(np.concatenate([np.stack(columns, -1), by], -1) if columns else by)
    return tuple(found)


def weigh(
    problem: FitProblem, fits: Sequence[Fit], *, closely: bool = False, moved: Moved | None = None
) -> list[tuple[Fit, Posterior]]:
    """Posteriors near fits, each with the fit; without those that break down.

    Args:
        problem: That was fitted.
        fits: Ends of searches.
        closely: See :func:`near`.
        moved: The same.
    """
    return inferred(problem, fits, near(problem, fits, closely=closely, moved=moved))


def inferred(
    problem: FitProblem, fits: Sequence[Fit], models: Sequence[Linearised | None]
) -> list[tuple[Fit, Posterior]]:
    """Posteriors of models near fits, see :func:`near`, each with the fit; without those that broke down."""
    data = data_of(problem)
    sound = [(fit, model) for fit, model in zip(fits, models, strict=True) if model is not None]
    # Two pools, as a thread that waits for others of its own pool may wait for ever.
    with ThreadPoolExecutor(problem.threads) as pool, ThreadPoolExecutor(problem.threads) as inner:
        after = pool.map(lambda m: infer(data, m[1], side_by_side=inner.map), sound)
        return list(zip((f for f, _ in sound), after, strict=True))


def with_noise_left(problem: FitProblem, models: Sequence[Linearised | None]) -> FitProblem:
    """The problem with the lasting noise, and its size if that is not stated, that the best of some models leaves."""
    data = data_of(problem)
    sound = [model for model in models if model is not None]
    if not sound:
        return problem
    best = min(sound, key=lambda model: size_of(model.left(closest(data, model).at)))
    stated = problem.experiment.setup.noise is not None
    data = with_lasting_noise(data, infer(data, best), stated=stated)
    return problem.only(problem.trials, noise=data.noise, lasting=data.lasting)


def planes_moved(problem: FitProblem, fit: Fit) -> Moved:
    """Residuals of a fit by the finer twin with planes a little nearer and farther; nothing without such a twin."""
    if problem.finer_twin is None:
        return {}
    return {fit: _touching(problem, problem.by(problem.finer_twin), [fit])[0]}


def with_chance_of(problem: FitProblem, moved: Moved) -> FitProblem:
    """The problem with chance in touching as large as it is at a fit, where that is more than as stated."""
    found, known = (chance_in(v, GAPS) if v else math.inf for v in moved.values()), problem.discretization
    return problem.only(problem.trials, discretization=known.replace(chance=max(known.chance, *found, 0.0)))


def weighing_of(problem: Likelihood, found: Sequence[Posterior], names: int) -> Weighing:
    """Posteriors beside each other.

    Args:
        problem: That was fitted.
        found: Of ends of searches, one or more without an effect among them.
        names: Number of single effects that can be named.

    Raises:
        ValueError: if there is no model without an effect.
    """
    nothing = tuple(p for p in found if not p.near.model.effects)
    if not nothing:
        raise ValueError(BREAKS)
    effects = tuple(p for p in found if p.near.model.effects)
    return Weighing(data=data_of(problem), nothing=nothing, effects=effects, names=names, rough=problem.rough)


def at_mode(problem: Likelihood, fit: Fit, mode: Mode) -> Fit:
    """A fit with its numbers where the posterior has its mode, and with the covariance there.

    Args:
        problem: That was fitted.
        fit: Near which the model was linearised.
        mode: Of its unknowns.
    """
    moving = np.flatnonzero(~held_of(problem, fit.effects))
    count, known = len(moving), len(problem.common)
    point = np.zeros_like(fit.point)
    point[moving] = mode.at[:count]
    scales = problem.scales(fit.effects)
    covariance = np.zeros((len(point), len(point)))
    covariance[np.ix_(moving, moving)] = mode.covariance[:count, :count]
    covariance *= np.outer(scales, scales)
    values, covariances, k = [], [], known
    for effect in fit.effects:
        own = slice(k, k + len(effect.quantities) + 3 * effect.local)
        values.append((point * scales)[own])
        covariances.append(covariance[own, own])
        k = own.stop
    return dataclasses.replace(
        fit,
        values=tuple(values),
        covariances=tuple(covariances),
        ln_factors=problem.ln_factors(point),
        errors=mode.at[count:],
        point=point,
    )
