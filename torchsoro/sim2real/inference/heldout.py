"""How well a model predicts trials that were not used to find it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.likelihood import Request
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
    (motions,) = there.simulate([_as_believed(there) if believed else (fit.effects, fit.point[None])])
    return _predicted(problem, there, fit, motions)


def before_and_after(
    problem: FitProblem, fit: Fit, trials: Sequence[Trial]
) -> tuple[list[Prediction], list[Prediction]]:
    """:func:`predict` of what is believed and of a fit, simulated together."""
    there = _there(problem, trials)
    before, after = there.simulate([_as_believed(there), (fit.effects, fit.point[None])])
    return _predicted(problem, there, fit, before), _predicted(problem, there, fit, after)


def left_out(problem: FitProblem, fits: Sequence[Fit]) -> tuple[list[Prediction], list[Prediction]]:
    """The first trials, each as :func:`before_and_after` by a fit of all others, simulated together.

    Args:
        problem: The fits', with all trials.
        fits: One for each trial that is left out, with the measurement errors of the others.
    """
    trials = problem.trials[: len(fits)]
    there = _there(problem, trials)
    # Each fit in all trials, of which one counts: lanes that are filled take no longer than empty ones.
    believed, *found = there.simulate([_as_believed(there), *((f.effects, f.point[None]) for f in fits)])
    before: list[Prediction] = []
    after: list[Prediction] = []
    for i, (trial, fit) in enumerate(zip(trials, fits, strict=True)):
        others, one = problem.only([t for t in problem.trials if t is not trial]), there.only([trial])
        before += _predicted(others, one, fit, [believed[i]])
        after += _predicted(others, one, fit, [found[i][i]])
    return before, after


def _there(problem: FitProblem, trials: Sequence[Trial]) -> FitProblem:
    """The trials, by the finer twin where there is one."""
    there = problem.only(trials, slips=())
    if there.fine is not None and not there.stated:
        there = there.by(there.fine)
    return there


def _as_believed(there: FitProblem) -> Request:
    """The setup as stated."""
    return (), np.zeros((1, len(there.common)))


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


def _predicted(
    problem: FitProblem, there: FitProblem, fit: Fit, motions: Sequence[MarkerTrajectory]
) -> list[Prediction]:
    found: list[Prediction] = []
    if not all(m.sound.all() for m in motions):
        return found
    for i, (motion, trial) in enumerate(zip(motions, there.trials, strict=True)):
        assert trial.recording is not None
        one = motion.alone()
        errors = _errors(problem, there, fit)
        deviation = there.observation.deviations[i]
        weight, most = (problem.noise / deviation) ** 2, CLOCK_LIMIT * deviation
        clock, least, step = 0.0, math.inf, 0.0
        for _ in range(ROUNDS):
            seen, by = there.observation.linearise(one, i, errors)
            left, slope = trial.recording.position - seen, by[..., i]
            good = np.isfinite(left)
            now = float((left[good] ** 2).sum()) + weight * errors[i] ** 2
            if now < least:
                clock, least = float(errors[i]), now
                step = (float((left[good] * slope[good]).sum()) - weight * clock) / (
                    float((slope[good] ** 2).sum()) + weight
                )
            else:  # the step was too long
                step /= 4
            # The fit of a simulation that is far off would otherwise move the clock without limit.
            errors[i] = np.clip(clock + step, -most, most)
        errors[i] = clock
        seen = there.observation.observe(one, i, errors)
        square = (trial.recording.position - seen) ** 2
        error = np.sqrt(np.nanmean(square.reshape(len(square), square.shape[1], -1).sum(-1), axis=0))
        total = float(np.sqrt(np.nanmean(square.sum(-1))))
        found.append(Prediction(trial=trial.name, seen=seen, error=error, total=total, clock=clock, motion=one))
    return found
