"""The twin's own error: what another cell and another step change in what would be recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.experiment import Experiment, Setup, Trial
from torchsoro.sim2real.fit import Problem
from torchsoro.sim2real.recording import Recording
from torchsoro.sim2real.twin import SAMPLE, Twin

SPEED = 4e6  # particle steps in a second, two cores
FLOOR = 0.01  # of the motion, below which no twin is trusted


@dataclass(frozen=True, kw_only=True, eq=False)
class Numerics:
    """How far the twin is off by itself.

    Attributes:
        deviation: For each trial [M, A] m, once modulus, pressure and measurement errors are fitted.
        spacings: Of the twins that were compared [m], the one in use first.
        cells: Through the thinnest wall.
    """

    deviation: tuple[np.ndarray, ...]
    spacings: tuple[float, ...]
    cells: float


def thinnest(setup: Setup) -> float:
    """The thinnest wall of a body [m]: around its chambers, or its smallest edge."""
    walls = [min(setup.size)]
    for cavity in setup.cavities:
        low, high = cavity.box
        for axis in range(3):
            begin, end = setup.origin[axis], setup.origin[axis] + setup.size[axis]
            walls += [low[axis] - begin, end - high[axis]]
    return min(w for w in walls if w > 1e-9)


def fits(setup: Setup, spacing: float) -> float:
    """How far faces of the body and its chambers are off the lattice planes, in spacings."""
    off = [0.0]
    for axis in range(3):
        faces = [setup.size[axis]]
        for cavity in setup.cavities:
            faces += [cavity.box[0][axis] - setup.origin[axis], cavity.box[1][axis] - setup.origin[axis]]
        scale = [abs(f / spacing - round(f / spacing)) for f in faces]
        off.append(max(scale) if setup.cavities else 0.0)
    return max(off)


def choose_spacing(setup: Setup, trials: int, budget: float, simulations: int = 150) -> float:
    """The finest spacing with which an explanation takes about the budget.

    Args:
        setup: Of the experiment.
        trials: To simulate.
        budget: [s].
        simulations: That an explanation takes for each trial.

    Raises:
        ValueError: if a chamber's walls fall between the planes of every lattice that is cheap enough.
    """
    edge = min(setup.size)
    candidates = sorted({edge / n for n in range(6, 25)} | {thinnest(setup) / n for n in range(1, 9)})
    speed = math.sqrt(1.125 * setup.youngs_modulus / (1 - 2 * setup.poisson_ratio) / setup.density)
    best = None
    for spacing in candidates:
        if fits(setup, spacing) > 0.02 or edge / spacing < 5.9:
            continue
        particles = math.prod(s / spacing for s in setup.size)
        steps = setup.duration / min(0.9 * 2 * spacing / speed, SAMPLE)
        cost = particles * steps / SPEED * trials * simulations
        best = spacing
        if cost <= budget:
            return spacing
    if best is None:
        raise ValueError(
            "setup: no lattice has planes on all walls of the chambers, wanted walls of whole tenths of a mm"
        )
    return best


def measure(
    experiment: Experiment,
    twin: Twin,
    trials: Sequence[Trial],
    *,
    report: Callable[[str], None] = lambda line: None,
) -> Numerics:
    """Simulate what is believed with coarser twins, and see what measurement errors and beliefs cannot take up.

    Args:
        experiment: What is to be explained.
        twin: The twin in use.
        trials: Of it.
        report: Called with a line after each simulation.
    """
    setup = experiment.setup
    others = [
        twin.spacing * factor
        for factor in (1.2, 1.25, 4 / 3, 1.5, 2.0)
        if fits(setup, twin.spacing * factor) < 0.02 and min(setup.size) / (twin.spacing * factor) > 3.9
    ][:2]
    deviations = [np.zeros((len(setup.markers), len(setup.axes))) for _ in trials]
    here = Problem(experiment, twin, trials=trials, noise=1e-4, report=report)
    own = here.simulate((), np.zeros((1, len(here.common))))
    for spacing in others:
        there = Problem(experiment, Twin(setup, spacing=spacing), trials=trials, noise=1e-4, report=report)
        other = there.simulate((), np.zeros((1, len(there.common))))
        told = []
        for i, (trial, motion) in enumerate(zip(trials, other, strict=True)):
            assert trial.recording is not None
            place = there.camera.see(motion.alone(), i, np.zeros(len(there.camera.deviations)))[0]
            told.append(
                dataclasses.replace(trial, recording=Recording(time=trial.recording.time, place=place, axes=setup.axes))
            )
        fit = Problem(experiment, twin, trials=told, noise=1e-4, report=report).fit(rounds=1)
        # Errors fall with the square of the cell: the finer twin's is a share of the difference.
        share = 1 / ((spacing / twin.spacing) ** 2 - 1)
        for i, trial in enumerate(told):
            assert trial.recording is not None
            left = trial.recording.place - fit.seen[i]
            deviations[i] = np.maximum(deviations[i], share * np.sqrt((left**2).mean(0)))
    for i, motion in enumerate(own):
        seen = here.camera.see(motion.alone(), i, np.zeros(len(here.camera.deviations)))[0]
        # Error is shared: no marker is far better than the others.
        common = math.sqrt(float((deviations[i] ** 2).mean()))
        moved = math.sqrt(float(((seen - seen[:1]) ** 2).mean()))
        deviations[i] = np.maximum(deviations[i], np.maximum(common / 2, FLOOR * moved))
    cells = thinnest(setup) / (2 * twin.spacing)
    return Numerics(deviation=tuple(deviations), spacings=(twin.spacing, *others), cells=cells)
