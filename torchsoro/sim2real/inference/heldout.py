"""How well a model predicts trials that were not used to find it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.observation import CLOCK_LIMIT
from torchsoro.sim2real.twin.twin import MarkerTrajectory

ROUNDS = 10  # Gauss-Newton steps in which the clock of one trial is fitted


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """A trial as predicted.

    Attributes:
        trial: Its name.
        seen: Predicted recording [T, M, A] m.
        error: Root mean square of each marker [M] m, over all axes.
        total: The same over all markers [m].
        clock: Offset of the trial's clock with which it was predicted [s].
        motion: The simulated motion.
    """

    trial: str
    seen: np.ndarray
    error: np.ndarray
    total: float
    clock: float
    motion: MarkerTrajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """All trials, once it is decided what was left out.

    Attributes:
        before: As believed; of trials whose simulations do not break down.
        after: Of the same, with what was found.
        left_out: By trial that did not take part in the fit that predicts it, the errors as believed and with what was
            found [m]; none where one breaks down.
    """

    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]
    left_out: dict[str, tuple[float, float]]


def predict(problem: FitProblem, fit: Fit, trials: Sequence[Trial], *, believed: bool = False) -> list[Prediction]:
    """Predict trials with the parameters and measurement errors of a fit; only the clock of each trial is fitted.

    The finer twin predicts, where there is one and trials come without simulations of their own: its correction of the
    other, taken at other numbers, does not hold for motion that contact has led elsewhere.

    Args:
        problem: The fit's.
        fit: What was found.
        trials: With recordings; those of the problem or others.
        believed: Simulate the setup as it is stated, but with the measurement errors of the fit.

    Returns:
        A prediction of each trial; empty where the simulation of one breaks down.
    """
    there = _there(problem, trials)
    (motions,) = there.simulate([there.as_stated if believed else (fit.effects, fit.point[None])])
    found = [_predicted(problem, there.only([t]), fit, m) for t, m in zip(there.trials, motions, strict=True)]
    return [p for p in found if p] if all(found) else []


def predictions(problem: FitProblem, fit: Fit, heldout: Sequence[Trial], folds: Sequence[Fit] = ()) -> Predictions:
    """Predict the trials of a fit, those that were held out, and some of the former by fits without them, all at once.

    Args:
        problem: The fit's.
        fit: What was found.
        heldout: Trials with recordings that did not take part.
        folds: Fits, each without one of the first trials, in order, and with the measurement errors of the others.
    """
    there = _there(problem, [*problem.trials, *heldout])
    every = range(len(there.trials))
    requests = [there.as_stated, *((f.effects, f.point[None]) for f in (fit, *folds))]
    believed, found, *each = there.simulate(requests, of=[every, every, *([i] for i in range(len(folds)))])
    alone = [there.only([trial]) for trial in there.trials]
    shown = [_pair(problem, one, fit, *motions) for one, *motions in zip(alone, believed, found, strict=True)]
    asked = shown[len(problem.trials) :]
    for i, (own, (motion,)) in enumerate(zip(folds, each, strict=True)):
        others = problem.only([t for k, t in enumerate(problem.trials) if k != i])
        asked.append(_pair(others, alone[i], own, believed[i], motion))
    sound, left_out = ([pair for pair in pairs if pair] for pairs in (shown, asked))
    return Predictions(
        before=tuple(before for before, _ in sound),
        after=tuple(after for _, after in sound),
        left_out={b.trial: (b.total, a.total) for b, a in left_out} if len(left_out) == len(asked) else {},
    )


def _there(problem: FitProblem, trials: Sequence[Trial]) -> FitProblem:
    """The trials, by the finer twin where there is one."""
    there = problem.only(trials, slips=())
    if there.fine is not None and not there.stated:
        there = there.by(there.fine)
    return there


def at_clocks_of(
    problem: FitProblem, fit: Fit, trials: Sequence[Trial], predictions: Sequence[Prediction], of: Sequence[Prediction]
) -> list[np.ndarray]:
    """Predicted recordings [T, M, A] m of the same motions, with the clocks of other predictions.

    The clock of a motion that is far from the recording is fitted far from the truth, and such a motion would not be
    seen to begin where the body is at the start.
    """
    there = problem.only(trials, slips=())
    found = []
    for i, (prediction, other) in enumerate(zip(predictions, of, strict=True)):
        errors = _errors(problem, there, fit)
        errors[i] = other.clock
        found.append(there.observation.observe(prediction.motion, i, errors))
    return found


def _errors(problem: FitProblem, there: FitProblem, fit: Fit) -> np.ndarray:
    """Measurement errors of a fit for other trials, whose clocks are right."""
    count = len(there.trials)
    known = fit.errors[len(problem.trials) :][: len(there.observation.deviations) - count]
    return np.concatenate([np.zeros(count), known])


def _pair(
    problem: FitProblem, there: FitProblem, fit: Fit, believed: MarkerTrajectory, found: MarkerTrajectory
) -> tuple[Prediction, Prediction] | None:
    """One trial as believed and with what was found; none where a simulation broke down."""
    before, after = (_predicted(problem, there, fit, motion) for motion in (believed, found))
    return (before, after) if before and after else None


def _predicted(problem: FitProblem, there: FitProblem, fit: Fit, motion: MarkerTrajectory) -> Prediction | None:
    """One trial, which is the only one there; none where its simulation broke down."""
    if not motion.sound.all():
        return None
    (trial,), motion = there.trials, motion.alone()
    assert trial.recording is not None
    errors = _errors(problem, there, fit)
    deviation = there.observation.deviations[0]
    weight, most = (problem.noise / deviation) ** 2, CLOCK_LIMIT * deviation
    clock, least, step = 0.0, math.inf, 0.0
    for _ in range(ROUNDS):
        seen, by = there.observation.linearise(motion, 0, errors)
        left, slope = trial.recording.position - seen, by[..., 0]
        good = np.isfinite(left)
        now = float((left[good] ** 2).sum()) + weight * errors[0] ** 2
        if now < least:
            clock, least = float(errors[0]), now
            step = (float((left[good] * slope[good]).sum()) - weight * clock) / (
                float((slope[good] ** 2).sum()) + weight
            )
        else:  # the step was too long
            step /= 4
        # The fit of a simulation that is far off would otherwise move the clock without limit.
        errors[0] = np.clip(clock + step, -most, most)
    errors[0] = clock
    seen = there.observation.observe(motion, 0, errors)
    square = (trial.recording.position - seen) ** 2
    error = np.sqrt(np.nanmean(square.reshape(len(square), square.shape[1], -1).sum(-1), axis=0))
    total = float(np.sqrt(np.nanmean(square.sum(-1))))
    return Prediction(trial=trial.name, seen=seen, error=error, total=total, clock=clock, motion=motion)
