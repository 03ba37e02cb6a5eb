"""From fits to evidence: each fit as a model near its end, corrected by finer twins, with its priors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.outer_effects import WallOffset
from torchsoro.sim2real.inference.conclusion import Weighing
from torchsoro.sim2real.inference.decision import FREEDOM, STRENGTH, TOLERANCE
from torchsoro.sim2real.inference.evidence import Data, Linearised, Model, Motions, TrialData, TwinError, infer
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.gauss_newton import STEP
from torchsoro.sim2real.inference.likelihood import Effects, Likelihood
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.remaining_error import by_richardson, by_spread
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

GAPS = 1e-5 * np.array([-10.0, -5.0, -2.0, 0.0, 2.0, 5.0, 10.0])  # of planes, far below a cell [m]
WEAK = 0.1  # strength of a response, over that of the weakest probe point: it is linear there


def data_of(problem: Likelihood) -> Data:
    """The recordings that a problem is fitted to."""
    trials = [
        TrialData(name=t.name, time=t.recording.time, position=t.recording.position)
        for t in problem.trials
        if t.recording is not None
    ]
    return Data(trials=tuple(trials), noise=problem.noise)


def model_of(problem: Likelihood, effects: Effects) -> Model:
    """A model with the priors of all unknowns that move.

    Strengths have Student's t distribution, cut where a quantity cannot be; the second quantity of an effect that may
    be negative, as the logarithm of a time, is a shape, uniform as a place is.
    """
    held = held_of(problem, effects)
    priors = [Prior(TOLERANCE) for _ in problem.common]
    low, high = problem.bounds(effects)
    for effect in effects:
        for i, q in enumerate(effect.quantities):
            shape = i > 0 and q.least < 0 and not effect.joint
            width = math.inf if shape else STRENGTH
            priors.append(Prior(width, freedom=FREEDOM, low=q.least, high=q.most))
        for k in range(len(priors), len(priors) + 3 * effect.local):
            priors.append(Prior(math.inf, low=low[k], high=high[k]))
    moving = [p for p, h in zip(priors, held, strict=True) if not h]
    beliefs = int((~held[: len(problem.common)]).sum())
    faults = [Prior(float(d), freedom=FREEDOM) for d in problem.observation.deviations]
    return Model(
        effects=tuple(e.name for e in effects),
        priors=(*moving, *faults),
        own=tuple(range(beliefs, len(moving))),
        simpler=simpler_of(problem, effects),
        beliefs=beliefs,
    )


def held_of(problem: Likelihood, effects: Effects) -> np.ndarray:
    """Unknowns that stay as stated: a belief beside an effect that is the same number without its tolerance."""
    held = [any(isinstance(e, type(one)) for e in effects) for one, _ in problem.common]
    return np.array(held + [False] * (len(problem.scales(effects)) - len(held)))


def simpler_of(problem: Likelihood, effects: Effects) -> tuple[str, ...]:
    """Names that effects are extensions of: of a pair its members, of one what it comes to at zero."""
    if len(effects) > 1:
        return tuple(e.name for e in effects)
    found = set()
    for effect in effects:
        # At zero in all quantities but one, an effect with several says what it is by itself.
        for row in np.eye(len(effect.quantities)):
            values = row * [q.scale for q in effect.quantities]
            plain = effect.simpler(np.concatenate([values, problem.twin.setup.center] if effect.local else [values]))
            found |= {plain[0]} if plain else set()
    return tuple(sorted(found))


def near(problem: FitProblem, fits: Sequence[Fit], middle: Twin, fine: Twin) -> list[Linearised | None]:
    """Fits as linearised models, with the error that finer twins leave; all simulated together.

    Args:
        problem: That was fitted.
        fits: Ends of searches.
        middle: A twin with cells between those of the twin in use and of the finest.
        fine: The finest twin.

    Returns:
        A model of each; None where a simulation breaks down.
    """
    data, bare = data_of(problem), DiscretizationError(shift=tuple(problem.shift))
    coarse = problem.only(problem.trials, discretization=bare)
    finer, between = (
        problem.only(problem.trials, twin=e, discretization=DiscretizationError()) for e in (fine, middle)
    )
    planes = any(s.planes for s in problem.scenarios)
    steps = [np.where(f.point + STEP > coarse.bounds(f.effects)[1], -STEP, STEP) for f in fits]
    beside = coarse.simulate(
        [(f.effects, np.concatenate([f.point[None], f.point + np.diag(h)])) for f, h in zip(fits, steps, strict=True)]
    )
    if planes:
        wall = WallOffset()
        gaps = GAPS[:, None] / wall.quantities[0].scale
        ask = [((*f.effects, wall), np.concatenate([np.tile(f.point, (len(gaps), 1)), gaps], 1)) for f in fits]
    else:
        ask = [(f.effects, f.point[None]) for f in fits]
    best = finer.simulate(ask)
    rest = between.simulate([(f.effects, f.point[None]) for f in fits])
    ratio = middle.edge / fine.edge
    found: list[Linearised | None] = []
    for f, h, motions, sharp, dull in zip(fits, steps, beside, best, rest, strict=True):
        if not all(m.sound.all() for m in (*motions, *sharp, *dull)):
            found.append(None)
            continue
        moving = ~held_of(problem, f.effects)
        variants = [_left(problem, [m.alone(k) for m in sharp], f.errors) for k in range(len(sharp[0].position))]
        coarser = _left(problem, [m.alone() for m in dull], f.errors)
        model = Linearised(
            model=model_of(problem, f.effects),
            at=np.concatenate([f.point[moving], f.errors]),
            residuals=variants[0],
            slopes=_slopes(problem, motions, h, moving, f.errors),
            numerics=TwinError(amplitude=np.zeros_like(data.amplitude)),
        )
        model = by_spread(data, model, [*variants, coarser]) if planes else by_richardson(data, model, coarser, ratio)
        found.append(model)
    return found


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


def weigh(problem: FitProblem, fits: Sequence[Fit], middle: Twin, fine: Twin, names: int) -> Weighing:
    """Posterior of all fits.

    Args:
        problem: That was fitted.
        fits: Ends of searches, one or more without an effect among them.
        middle: See :func:`near`.
        fine: See :func:`near`.
        names: Number of single effects that can be named.

    Raises:
        ValueError: if there is no fit without an effect whose simulation by finer twins is sound.
    """
    data = data_of(problem)
    found = [infer(data, one) for one in near(problem, fits, middle, fine) if one is not None]
    nothing = tuple(p for p in found if not p.near.model.effects)
    if not nothing:
        raise ValueError("fits: none without an effect that finer twins can simulate, wanted one")
    return Weighing(data=data, nothing=nothing, effects=tuple(p for p in found if p.near.model.effects), names=names)


def responses(problem: FitProblem, effects: Sequence[Hypothesis], still: Fit) -> Motions:
    """Changes of the motion by weak effects, of each trial [T, M, A, E]; without what breaks down or moves nothing.

    Args:
        problem: That was fitted.
        effects: To think of.
        still: The fit without an effect.
    """
    coarse = problem.only(problem.trials, discretization=DiscretizationError(shift=tuple(problem.shift)))
    weak = [np.concatenate(e.weak_probe_points(problem.twin, WEAK)) for e in effects]
    base, *changed = coarse.simulate(
        [
            ((), still.point[None]),
            *(
                ((e,), np.concatenate([np.tile(still.point, (len(d), 1)), d], 1))
                for e, d in zip(effects, weak, strict=True)
            ),
        ]
    )
    before = _left(problem, [m.alone() for m in base], still.errors)
    columns: list[Motions] = []
    for motions in changed:
        sound = np.all([m.sound for m in motions], axis=0)
        for k in (int(k) for k in np.flatnonzero(sound)):
            after = _left(problem, [m.alone(k) for m in motions], still.errors)
            change = tuple(np.nan_to_num(a - b) for a, b in zip(before, after, strict=True))
            if any(c.any() for c in change):
                columns.append(change)
    return tuple(np.stack([c[i] for c in columns], -1) for i in range(len(before)))
