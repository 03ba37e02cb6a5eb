"""The twin's own error, by comparison with a finer twin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.interpolate import Akima1DInterpolator

from torchsoro.sim2real.data.experiment import Experiment, Trial
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import BREAKS, added
from torchsoro.sim2real.inference.observation import Priors
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.batch import THREADS, simulate
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

SAFETY = 1.5  # standard deviation of the twin's error over the difference to the finer twin
GAP = 2e-5  # distance by which planes are moved to see how much the moment of contact matters [m]
# Of recordings without measurement errors.
EXACT = Priors(clock=1e-9, rate=1e-9, scale=1e-9, metres=1e-9, rotation=1e-9, place=1e-9)
OWN = 1 / 3  # share of the difference to a supplied simulation that may change with an effect
FLOOR = 0.003  # least error of a twin over the size of the motion


def measure(
    experiment: Experiment,
    twin: Twin,
    fine: Twin,
    *,
    threads: int = THREADS,
    report: Callable[[str], None] = lambda line: None,
) -> DiscretizationError:
    """Compare twin and finer twin at the setup as stated, with measurement errors, modulus and pressure fitted.

    A trial that comes with a simulation of its own has that in place of the finer twin's; what is then explained is the
    difference to that simulation.

    Args:
        experiment: What is to be explained, with trials that are only predicted.
        twin: In use.
        fine: Another, with smaller cells.
        threads: That simulate.
        report: Called with a line after each batch of simulations.
    """
    setup = experiment.setup
    trials = tuple(t for t in experiment.trials if t.recording is not None)
    everything = (*trials, *(t for t in experiment.heldout if t.recording is not None))
    common = {"noise": 1e-4, "report": report, "threads": threads}
    there = FitProblem(experiment, fine, trials=everything, **common)
    other = [_as_simulated(motion, t) for motion, t in zip(_believed(there), everything, strict=True)]
    here = FitProblem(experiment, twin, trials=trials, priors=EXACT, **common)
    fit = here.only(_recordings_of(here, other)).fit([((), None)], rounds=4)[0]
    shift = (0.0,) * len(here.common) if fit is None else tuple(fit.ln_factors)
    shifted = DiscretizationError(shift=shift)
    own = _believed(FitProblem(experiment, twin, trials=everything, discretization=shifted, **common))
    correction = added(everything, own, other)
    here = FitProblem(experiment, twin, trials=trials, **common)
    # The error falls with the square of the cell size, which gives that of the finer twin from the difference of the
    # two; impacts on planes do not converge at that order, so that there the whole difference counts.
    ratio = max((fine.count / twin.count) ** (1 / 3), 1.1)
    smooth = 1 / (ratio**2 - 1)
    shares = [OWN if t.simulated else 1.0 if s.planes else smooth for t, s in zip(trials, here.scenarios, strict=True)]
    deviations = [_apart(here, other[: len(trials)], shares)]
    deviations += [_apart(here, touching, [0.5] * len(trials)) for touching in _touching(here)]
    found = {}
    for i, (trial, motion) in enumerate(zip(trials, own, strict=False)):
        left = SAFETY * np.sqrt(sum(d[i] ** 2 for d in deviations))
        seen = here.observation.observe(motion, i, np.zeros(len(here.observation.deviations)))
        # No marker is taken to be far better than the others.
        shared = math.sqrt(float((left**2).mean()))
        moved = math.sqrt(float(((seen - seen[:1]) ** 2).mean()))
        found[trial.name] = np.maximum(left, max(shared / 2, FLOOR * moved))
    thinnest = tuple(min(a.cells for a in t.grid.axes) if not setup.chambers else t.walls for t in (twin, fine))
    return DiscretizationError(
        deviation=found,
        shift=shift,
        correction=correction,
        edges=(twin.edge, fine.edge),
        walls=thinnest,
    )


def _touching(here: FitProblem) -> list[list[MarkerTrajectory]]:
    """Motions with planes a little nearer and farther, as the twin's place of contact is known no better."""
    if not here.rough:
        return []
    moved = [
        s.replace(
            planes=tuple(
                dataclasses.replace(g, offset=g.offset + GAP * torch.tensor([-1.0, 1.0], dtype=torch.float64))
                for g in s.planes
            )
        )
        for s in here.scenarios
    ]
    motions = simulate(here.twin, moved, threads=here.threads)
    # A trial without planes moves in one way only.
    return [[m.alone(min(k, len(m.position) - 1)) for m in motions] for k in range(2)]


def _as_simulated(motion: MarkerTrajectory, trial: Trial) -> MarkerTrajectory:
    """A motion with the places of the trial's own simulation, where there is one; it goes on by itself after that."""
    own = trial.simulated
    if own is None:
        return motion
    course = Akima1DInterpolator(own.time, own.position)
    last = np.searchsorted(motion.time, own.time[-1], side="right") - 1
    at = np.minimum(np.arange(len(motion.time)), last)
    time = motion.time[at]
    return dataclasses.replace(
        motion,
        position=course(time) + (motion.position - motion.position[at]),
        velocity=course(time, 1) + (motion.velocity - motion.velocity[at]),
    )


def _apart(here: FitProblem, other: Sequence[MarkerTrajectory], shares: Sequence[float]) -> list[np.ndarray]:
    """Shares of how far other motions are off, once modulus, pressure and measurement errors are fitted.

    Returns:
        For each trial [M, A] m.
    """
    recorded = _recordings_of(here, other)
    fit = here.only(recorded).fit([((), None)], rounds=2)[0]
    if fit is None:
        return [np.zeros_like(here.discretization.of(t)) for t in here.trials]
    return [
        share * np.sqrt(((t.recording.position - seen) ** 2).mean(0))
        for t, seen, share in zip(recorded, fit.seen, shares, strict=True)
        if t.recording is not None
    ]


def _recordings_of(here: FitProblem, motions: Sequence[MarkerTrajectory]) -> list[Trial]:
    """The trials with recordings of just these motions, free of errors."""
    recorded = []
    for i, (trial, motion) in enumerate(zip(here.trials, motions, strict=False)):
        assert trial.recording is not None
        place = here.observation.observe(motion.alone(), i, np.zeros(len(here.observation.deviations)))
        recording = dataclasses.replace(trial.recording, position=place)
        recorded.append(dataclasses.replace(trial, recording=recording))
    return recorded


def _believed(problem: FitProblem) -> list[MarkerTrajectory]:
    """Motion of the setup as stated, for each trial.

    Raises:
        ValueError: if it breaks down.
    """
    motions = problem.simulate([((), np.zeros((1, len(problem.common))))])[0]
    if not all(m.sound.all() for m in motions):
        raise ValueError(BREAKS)
    return [m.alone() for m in motions]
