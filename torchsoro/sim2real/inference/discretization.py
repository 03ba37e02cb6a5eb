"""The twin's own error: what other cells change in what would be recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import Akima1DInterpolator

from torchsoro.sim2real.data.experiment import Experiment, Setup, Trial
from torchsoro.sim2real.inference.fit import Problem
from torchsoro.sim2real.inference.likelihood import BREAKS, added
from torchsoro.sim2real.inference.residual import Priors
from torchsoro.sim2real.twin.ensemble import Ensemble, safety
from torchsoro.sim2real.twin.twin import Motion, Twin

SPEED = 6e7  # points times variations times steps in a second of a thread
CORES = 2  # that a budget is meant for, wherever it is spent: the twin is the same everywhere
WALLS = 1  # cells through each wall, at least; each bends by itself
SIMULATIONS = 400  # that an explanation takes for each trial
SLOW = 64.0  # times as long an explanation may take that finds something, on a slow machine
DENTS = 24.0  # the same of a body that meets planes: where it slides, a fine twin is worth the time
SURE = 1.5  # times the differences that were seen
FINER = (2.0, 1.5)  # times as many cells along each axis, of the twin that corrects the one in use
GAP = 2e-5  # m
EXACT = Priors(clock=1e-9, rate=1e-9, scale=1e-9, metres=1e-9, rotation=1e-9, place=1e-9)
OWN = 1 / 3  # of what a simulation of one's own does otherwise, that may be different with an effect
FLOOR = 0.003  # of the motion, below which no twin is trusted


@dataclass(frozen=True, kw_only=True, eq=False)
class Numerics:
    """How far the twin is off by itself.

    Attributes:
        deviation: For each trial [M, A] m, once it is corrected, and modulus, pressure and measurement errors fitted.
        shift: Of ln of the modulus, and of the pressure, with which the twin moves as a finer one does.
        correction: By trial, what the finer twin then adds to the motion that is believed [S, M, ...].
        edges: Of the cells of the twins that were compared [m], the one in use first.
        walls: Cells through the thinnest wall, or edge, of each.
    """

    deviation: tuple[np.ndarray, ...]
    shift: tuple[float, ...]
    correction: dict[str, Motion]
    edges: tuple[float, ...]
    walls: tuple[int, ...]


def cost(twin: Twin, trials: int, simulations: float = SIMULATIONS) -> float:
    """Seconds that an explanation takes on two cores, about."""
    s = twin.setup
    speed = math.sqrt(s.youngs_modulus / (1 - 2 * s.poisson_ratio) / s.density)
    factor = math.sqrt(1 + sum(g for g, _ in s.prony) / 2)
    steep = math.sqrt(max(a.steep for a in twin.grid.axes))
    steps = s.duration * steep * speed * factor / (2 * safety(twin.grid))
    return twin.count * steps * trials * simulations / SPEED / CORES


def choose_twin(setup: Setup, trials: int, budget: float, *, walls: int = WALLS) -> Twin:
    """The finest twin with which an explanation takes about the budget.

    Args:
        setup: Of the experiment.
        trials: To simulate.
        budget: On two cores [s].
        walls: Cells through each wall, at least.

    Raises:
        ValueError: if the coarsest takes more than three times the budget.
    """
    thin, long = min(setup.size), max(setup.size)
    chambers = bool(setup.cavities)
    edges = [long / 12, long / 8] if chambers else [thin / 3, thin / 2]
    twins = [Twin(setup, edge=edge, walls=walls, across=n) for edge, n in zip(edges, (3, 2), strict=True)]
    for twin in twins:
        if cost(twin, trials) <= budget / (DENTS if setup.planes else SLOW):
            return twin
    needed = cost(twins[-1], trials)
    if needed > 3 * budget:
        raise ValueError(
            f"budget: {budget / 60:.3g} minutes, wanted {needed / 60:.3g} or more: a twin with {walls} cells "
            "through each wall takes as long; a coarser one would be further from the truth than what is to be found"
        )
    return twins[-1]


def finer(twin: Twin, trials: int, seconds: float) -> Twin:
    """A twin with smaller cells, that simulates trials once in about so long.

    Args:
        twin: The one in use.
        trials: To simulate.
        seconds: On one thread; the least fine of those thought of takes as long as it takes.
    """
    least = min(a.cells for a in twin.grid.axes)
    for share in FINER:
        walls, across = math.ceil(share * twin.walls), math.ceil(share * least)
        fine = Twin(twin.setup, edge=twin.edge / share, walls=walls, across=across)
        # A group of lanes takes as long with one trial as with sixteen.
        if cost(fine, trials, 16 / trials * CORES) <= seconds:
            break
    return fine


def measure(
    experiment: Experiment,
    ensemble: Ensemble,
    fine: Ensemble,
    *,
    report: Callable[[str], None] = lambda line: None,
) -> Numerics:
    """Simulate what is believed with a finer twin, and see what measurement errors and beliefs cannot take up.

    A trial that comes with a simulation of one's own has that in place of the finer twin's: asked is then what that
    simulation left out.

    Args:
        experiment: What is to be explained, with trials that are only predicted.
        ensemble: Of the twin in use.
        fine: Of another.
        report: Called with a line after each batch of simulations.
    """
    setup, twin = experiment.setup, ensemble.twin
    trials = [t for t in experiment.trials if t.recording is not None]
    everything = [*trials, *(t for t in experiment.heldout if t.recording is not None)]
    common = {"noise": 1e-4, "report": report}
    there = Problem(experiment, fine.twin, trials=everything, ensemble=fine, **common)
    other = [_as_simulated(motion, t) for motion, t in zip(_believed(there), everything, strict=True)]
    here = Problem(experiment, twin, trials=trials, ensemble=ensemble, priors=EXACT, **common)
    fit = here.only(_told(here, other)).fit([((), None)], rounds=4)[0]
    shift = np.zeros(len(here.common)) if fit is None else fit.belief
    own = _believed(Problem(experiment, twin, trials=everything, ensemble=ensemble, shift=tuple(shift), **common))
    correction = added(everything, own, other)
    here = Problem(experiment, twin, trials=trials, ensemble=ensemble, **common)
    # Of the difference to cells that are so much larger, the finer twin's own error, which falls with their square;
    # blows do not.
    ratio = max((fine.twin.count / twin.count) ** (1 / 3), 1.1)
    smooth = 1 / (ratio**2 - 1)
    shares = [OWN if t.simulated else 1.0 if s.grounds else smooth for t, s in zip(trials, here.scenarios, strict=True)]
    deviations = [_apart(here, other[: len(trials)], shares)]
    deviations += [_apart(here, touching, [0.5] * len(trials)) for touching in _touching(here)]
    found = []
    for i, motion in enumerate(own[: len(trials)]):
        left = SURE * np.sqrt(sum(d[i] ** 2 for d in deviations))
        seen = here.camera.see(motion, i, np.zeros(len(here.camera.deviations)))
        # Error is shared: no marker is far better than the others.
        shared = math.sqrt(float((left**2).mean()))
        moved = math.sqrt(float(((seen - seen[:1]) ** 2).mean()))
        found.append(np.maximum(left, max(shared / 2, FLOOR * moved)))
    thinnest = tuple(min(a.cells for a in t.grid.axes) if not setup.cavities else t.walls for t in (twin, fine.twin))
    return Numerics(
        deviation=tuple(found),
        shift=tuple(shift),
        correction=correction,
        edges=(twin.edge, fine.twin.edge),
        walls=thinnest,
    )


def _touching(here: Problem) -> list[list[Motion]]:
    """Motions with planes that are a little nearer or farther: where a body touches is not known better."""
    if not any(s.grounds for s in here.scenarios):
        return []
    moved = [
        s.replace(
            grounds=tuple(
                dataclasses.replace(g, offset=g.offset + GAP * torch.tensor([-1.0, 1.0], dtype=torch.float64))
                for g in s.grounds
            )
        )
        for s in here.scenarios
    ]
    motions = here.ensemble(moved)
    # A trial without planes moves in one way only.
    return [[m.alone(min(k, len(m.place) - 1)) for m in motions] for k in range(2)]


def _as_simulated(motion: Motion, trial: Trial) -> Motion:
    """A motion with the places of the trial's own simulation, where there is one; it goes on by itself after that."""
    own = trial.simulated
    if own is None:
        return motion
    course = Akima1DInterpolator(own.time, own.place)
    last = np.searchsorted(motion.time, own.time[-1], side="right") - 1
    at = np.minimum(np.arange(len(motion.time)), last)
    time = motion.time[at]
    return dataclasses.replace(
        motion,
        place=course(time) + (motion.place - motion.place[at]),
        velocity=course(time, 1) + (motion.velocity - motion.velocity[at]),
    )


def _apart(here: Problem, other: Sequence[Motion], shares: Sequence[float]) -> list[np.ndarray]:
    """Shares of how far other motions are off, once modulus, pressure and measurement errors are fitted.

    Returns:
        For each trial [M, A] m.
    """
    told = _told(here, other)
    fit = here.only(told).fit([((), None)], rounds=2)[0]
    if fit is None:
        return [np.zeros(n.shape) for n in here.numerics]
    return [
        share * np.sqrt(((t.recording.place - seen) ** 2).mean(0))
        for t, seen, share in zip(told, fit.seen, shares, strict=True)
        if t.recording is not None
    ]


def _told(here: Problem, motions: Sequence[Motion]) -> list[Trial]:
    """Trials that recorded just these motions."""
    told = []
    for i, (trial, motion) in enumerate(zip(here.trials, motions, strict=False)):
        assert trial.recording is not None
        place = here.camera.see(motion.alone(), i, np.zeros(len(here.camera.deviations)))
        recording = dataclasses.replace(trial.recording, place=place)
        told.append(dataclasses.replace(trial, recording=recording))
    return told


def _believed(problem: Problem) -> list[Motion]:
    """What is believed, for each trial.

    Raises:
        ValueError: if it breaks down.
    """
    motions = problem.simulate([((), np.zeros((1, len(problem.common))))])[0]
    if not all(m.sound.all() for m in motions):
        raise ValueError(BREAKS)
    return [m.alone() for m in motions]
