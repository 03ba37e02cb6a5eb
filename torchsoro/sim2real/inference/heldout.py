"""How well a model predicts trials that were not used to find it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.observation import LATE
from torchsoro.sim2real.twin.twin import MarkerMotion

ROUNDS = 10  # in which a trial's clock is found


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """A trial as predicted.

    Attributes:
        trial: Its name.
        seen: Predicted recording [T, M, A] m.
        error: Root mean square of each marker [M] m, over all axes.
        total: The same over all markers [m].
    """

    trial: str
    seen: np.ndarray
    error: np.ndarray
    total: float


def predict(problem: FitProblem, fit: Fit, trials: Sequence[Trial], *, believed: bool = False) -> list[Prediction]:
    """Predict trials with the parameters and measurement errors of a fit; only each trial's clock is found anew.

    Args:
        problem: The fit's.
        fit: What was found.
        trials: With recordings; those of the problem or others.
        believed: Simulate the setup as it is believed, but see it with the fit's measurement errors.
    """
    return predict_all(problem, [fit], trials, believed=believed)[0]


def predict_all(
    problem: FitProblem, fits: Sequence[Fit], trials: Sequence[Trial], *, believed: bool = False
) -> list[list[Prediction]]:
    """:func:`predict` for several fits, simulated together; nothing is predicted where it breaks down."""
    there = problem.only(trials, slips=())
    still = np.zeros((1, len(there.common)))
    simulated = there.simulate([((), still) if believed else (fit.effects, fit.point[None]) for fit in fits])
    return [
        _seen(problem, there, fit, motions) if all(m.sound.all() for m in motions) else []
        for fit, motions in zip(fits, simulated, strict=True)
    ]


def _seen(problem: FitProblem, there: FitProblem, fit: Fit, motions: Sequence[MarkerMotion]) -> list[Prediction]:
    count = len(there.trials)
    known = fit.errors[len(problem.trials) :][: len(there.observation.deviations) - count]
    found = []
    for i, (motion, trial) in enumerate(zip(motions, there.trials, strict=True)):
        assert trial.recording is not None
        one = motion.alone()
        errors = np.concatenate([np.zeros(count), known])
        weight, most = (problem.noise / there.observation.deviations[i]) ** 2, LATE * there.observation.deviations[i]
        clock, least, step = 0.0, math.inf, 0.0
        for _ in range(ROUNDS):
            seen, by = there.observation.linearise(one, i, errors)
            left, slope = trial.recording.place - seen, by[..., i]
            good = np.isfinite(left)
            now = float((left[good] ** 2).sum()) + weight * errors[i] ** 2
            if now < least:
                clock, least = float(errors[i]), now
                step = (float((left[good] * slope[good]).sum()) - weight * clock) / (
                    float((slope[good] ** 2).sum()) + weight
                )
            else:  # too far
                step /= 4
            # A simulation that is far off would otherwise bend the clock without end.
            errors[i] = np.clip(clock + step, -most, most)
        errors[i] = clock
        seen = there.observation.observe(one, i, errors)
        square = (trial.recording.place - seen) ** 2
        error = np.sqrt(np.nanmean(square.reshape(len(square), square.shape[1], -1).sum(-1), axis=0))
        total = float(np.sqrt(np.nanmean(square.sum(-1))))
        found.append(Prediction(trial=trial.name, seen=seen, error=error, total=total))
    return found
