"""The twin's own error, by comparison with a finer twin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from torchsoro.sim2real.data.experiment import Experiment, Trial
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.likelihood import BREAKS, WITHIN, added
from torchsoro.sim2real.inference.observation import Priors
from torchsoro.sim2real.inference.observed import Motions
from torchsoro.sim2real.inference.remaining_error import ORDER, TOUCHING, chance_in
from torchsoro.sim2real.inference.resolution import FINEST, between
from torchsoro.sim2real.inference.touching import GAPS, averaged, shifted
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.batch import THREADS
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin

SAFETY = 1.5  # standard deviation of the twin's error over the difference to the finer twin
SHIFTS = 5  # of planes, over whose mean the finer twin and a third one are compared: a group of lanes with three trials
NEARER = 2e-5 * np.array([-1.0, 1.0])  # shifts of planes by which the twin in use may be off [m]
# Of recordings without measurement errors.
EXACT = Priors(clock=1e-9, rate=1e-9, scale=1e-9, metres=1e-9, rotation=1e-9, place=1e-9)
OWN = 1 / 3  # share of the difference to a supplied simulation that may change with an effect
FLOOR = 0.003  # least error of a twin over the size of the motion


def measure(
    experiment: Experiment,
    twin: Twin,
    fine: Twin,
    *,
    finest: Twin | None = None,
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
        finest: A third, with still smaller cells, for bodies that stick to planes.
        threads: That simulate.
        report: Called with a line after each batch of simulations.
    """
    setup = experiment.setup
    trials = tuple(t for t in experiment.trials if t.recording is not None)
    everything = (*trials, *(t for t in experiment.heldout if t.recording is not None))
    common = {"noise": 1e-4, "report": report, "threads": threads}
    there = FitProblem(experiment, fine, trials=everything, **common)
    touching: tuple[Mapping[str, MarkerTrajectory], ...] = ()
    cells: Mapping[str, MarkerTrajectory] = {}
    smaller: Mapping[str, MarkerTrajectory] = {}
    unsure = 0.0
    chance = in_use = math.inf
    if there.touches and not any(t.simulated for t in trials):
        believed, touching, chance = _chance(there, len(trials))
        _, _, in_use = _chance(FitProblem(experiment, twin, trials=trials, **common), len(trials))
        middle = _believed(FitProblem(experiment, between(twin, fine), trials=trials, **common))
        cells = added(trials, believed[: len(trials)], middle)
        if finest is not None:
            (own,), (sharp,) = (
                averaged(p, [there.as_stated], SHIFTS) for p in (there, there.only(everything, twin=finest))
            )
            smaller, unsure = added(everything, own, sharp), 1 / (FINEST**TOUCHING - 1)
            if not FitProblem(experiment, fine, trials=trials, discretization=DiscretizationError(chance=chance)).rough:
                # Of a calm motion also what cells without size would add; of another, that would multiply chance.
                beyond = 1 / (FINEST**ORDER - 1)
                smaller = {name: change.plus(change, beyond) for name, change in smaller.items()}
                unsure = beyond / (1 + beyond)
            believed = [
                m.plus(smaller[t.name]) if t.name in smaller else m for m, t in zip(believed, everything, strict=True)
            ]
    else:
        believed = _believed(there)
    other = [as_simulated(motion, t) for motion, t in zip(believed, everything, strict=True)]
    rough = DiscretizationError(chance=chance, chance_in_use=in_use)
    here = FitProblem(experiment, twin, trials=trials, discretization=rough, priors=EXACT, **common)
    fit = here.only(_recordings_of(here, other)).fit([((), None)], rounds=4)[0]
    shift = (0.0,) * len(here.common) if fit is None else tuple(fit.ln_factors.values())
    known = rough.replace(shift=shift)
    own = _believed(FitProblem(experiment, twin, trials=everything, discretization=known, **common))
    correction = added(everything, own, other)
    here = FitProblem(experiment, twin, trials=trials, discretization=known, **common)
    # The error falls with the square of the cell size, which gives that of the finer twin from the difference of the
    # two; impacts on planes do not converge at that order, so that there the whole difference counts.
    ratio = max((fine.count / twin.count) ** (1 / 3), 1.1)
    smooth = 1 / (ratio**2 - 1)
    shares = [OWN if t.simulated else 1.0 if s.planes else smooth for t, s in zip(trials, here.scenarios, strict=True)]
    deviations = _apart(here, [(other[: len(trials)], shares), *((m, [0.5] * len(trials)) for m in _touching(here))])
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
        touching=touching,
        between=cells,
        smaller=smaller if all(t.name in smaller for t in trials) else {},
        unsure=unsure,
        chance=chance,
        chance_in_use=in_use,
        edges=(twin.edge, fine.edge),
        walls=thinnest,
    )


def _touching(here: FitProblem) -> list[list[MarkerTrajectory]]:
    """Motions with planes a little nearer and farther, as the twin's place of contact is known no better."""
    if not here.touches:
        return []
    (motions,) = shifted(here, [here.as_stated], NEARER)
    return [[m.alone(k) for m in motions] for k in range(len(NEARER))]


def _chance(
    problem: FitProblem, count: int
) -> tuple[list[MarkerTrajectory], tuple[Mapping[str, MarkerTrajectory], ...], float]:
    """The motion as stated; what moved planes add to it in the first trials, by shift; how much is chance [m]."""
    (motions,) = shifted(problem, [problem.as_stated], GAPS)
    middle = [m.alone(len(GAPS) // 2) for m in motions]
    if not all(m.sound.all() for m in middle):
        raise ValueError(BREAKS)
    kept = motions[:count]
    if not all(m.sound.all() for m in kept):
        return middle, (), math.inf
    moved = [[m.alone(k) for m in kept] for k in range(len(GAPS))]
    none = np.zeros(len(problem.observation.deviations))
    seen: list[Motions] = [
        tuple(problem.observation.observe(m, i, none) for i, m in enumerate(variant)) for variant in moved
    ]
    touching = tuple(added(problem.trials[:count], middle[:count], variant) for variant in moved)
    return middle, touching, chance_in(seen, GAPS)


def as_simulated(motion: MarkerTrajectory, trial: Trial) -> MarkerTrajectory:
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


def _apart(
    here: FitProblem, others: Sequence[tuple[Sequence[MarkerTrajectory], Sequence[float]]]
) -> list[list[np.ndarray]]:
    """Shares of how far other motions are off, once modulus, pressure and measurement errors are fitted to them.

    They are near, so that the response to these is linear.

    Args:
        here: By whose twin.
        others: Motions of all trials, and the share of each.

    Returns:
        For each of the others and each trial [M, A] m.
    """
    none, count, step = np.zeros(len(here.observation.deviations)), len(here.common), here.step
    asked = np.concatenate([np.zeros((1, count)), step * np.eye(count)])
    (motions,) = averaged(here, [((), asked)], here.looks)
    seen, columns = [], []
    for i, motion in enumerate(motions):
        own, by = here.observation.linearise(motion.alone(0), i, none)
        beside = [here.observation.observe(motion.alone(1 + k), i, none) for k in range(count)]
        seen.append(own)
        columns.append(np.concatenate([*((x - own)[..., None] / step for x in beside), by], -1))
    X = np.concatenate([c.reshape(-1, c.shape[-1]) for c in columns]) / here.noise
    H = X.T @ X + np.diag(np.concatenate([np.full(count, WITHIN), 1 / here.observation.deviations]) ** 2)
    found = []
    for other, shares in others:
        off = [here.observation.observe(m, i, none) - x for i, (m, x) in enumerate(zip(other, seen, strict=True))]
        at = np.linalg.solve(H, X.T @ np.concatenate([x.ravel() for x in off]) / here.noise)
        left = (x - c @ at for x, c in zip(off, columns, strict=True))
        found.append([share * np.sqrt((x**2).mean(0)) for x, share in zip(left, shares, strict=True)])
    return found


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
    motions = problem.simulate([problem.as_stated])[0]
    if not all(m.sound.all() for m in motions):
        raise ValueError(BREAKS)
    return [m.alone() for m in motions]
