"""The twin's own error: what other cells change in what would be recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchsoro.sim2real.ensemble import SAFETY, THREADS, Ensemble
from torchsoro.sim2real.experiment import Experiment, Setup, Trial
from torchsoro.sim2real.fit import Problem
from torchsoro.sim2real.twin import Motion, Twin

SPEED = 6e7  # points times variations times steps in a second of a thread
WALLS = 3  # cells through each wall, at least
SIMULATIONS = 300  # that an explanation takes for each trial
SURE = 1.5  # times the differences that were seen
GAP = 5e-5  # m
FLOOR = 0.003  # of the motion, below which no twin is trusted


@dataclass(frozen=True, kw_only=True, eq=False)
class Numerics:
    """How far the twin is off by itself.

    Attributes:
        deviation: For each trial [M, A] m, once modulus, pressure and measurement errors are fitted.
        edges: Of the cells of the twins that were compared [m], the one in use first.
        walls: Cells through the thinnest wall, or edge.
    """

    deviation: tuple[np.ndarray, ...]
    edges: tuple[float, ...]
    walls: int


def cost(twin: Twin, trials: int, simulations: int = SIMULATIONS) -> float:
    """Seconds that an explanation takes, about."""
    s = twin.setup
    speed = math.sqrt(s.youngs_modulus / (1 - 2 * s.poisson_ratio) / s.density)
    factor = math.sqrt(1 + sum(g for g, _ in s.prony) / 2)
    steep = math.sqrt(max(a.steep for a in twin.grid.axes))
    steps = s.duration * steep * speed * factor / (2 * SAFETY)
    return twin.count * steps * trials * simulations / SPEED / THREADS


def choose_twin(setup: Setup, trials: int, budget: float, *, walls: int = WALLS) -> Twin:
    """The finest twin with which an explanation takes about the budget.

    Args:
        setup: Of the experiment.
        trials: To simulate.
        budget: [s].
        walls: Cells through each wall, at least.

    Raises:
        ValueError: if so many cells through each wall take more than three times the budget.
    """
    thin = min(setup.size)
    chambers = bool(setup.cavities)
    edges = [max(setup.size) / n for n in (16, 12, 8)] if chambers else [thin / n for n in (3, 2)]
    twins = [Twin(setup, edge=edge, walls=walls) for edge in edges]
    for twin in twins:
        if cost(twin, trials) <= budget:
            return twin
    needed = cost(twins[-1], trials)
    if needed > 3 * budget:
        raise ValueError(
            f"budget: {budget / 60:.3g} minutes, wanted {needed / 60:.3g} or more: a twin with {walls} cells "
            "through each wall takes as long; a coarser one would be further from the truth than what is to be found"
        )
    return twins[-1]


def measure(
    experiment: Experiment,
    ensemble: Ensemble,
    trials: Sequence[Trial],
    *,
    report: Callable[[str], None] = lambda line: None,
) -> Numerics:
    """Simulate what is believed with a coarser twin, and see what measurement errors and beliefs cannot take up.

    Args:
        experiment: What is to be explained.
        ensemble: Of the twin in use.
        trials: Of it.
        report: Called with a line after each batch of simulations.
    """
    setup, twin = experiment.setup, ensemble.twin
    walls = min(a.cells for a in twin.grid.axes)
    # Cells are whole: another count through each wall, or across the body.
    fewer = max(twin.walls - 1, 1)
    coarse = Twin(setup, edge=1.4 * twin.edge, walls=fewer, across=max(walls - 1, 2))
    here = Problem(experiment, twin, trials=trials, noise=1e-4, ensemble=ensemble, report=report)
    other_ensemble = Ensemble(coarse, ensemble.threads)
    there = Problem(experiment, coarse, trials=trials, noise=1e-4, ensemble=other_ensemble, report=report)
    own = here.simulate([((), np.zeros((1, len(here.common))))])[0]
    deviations = []
    for other in [there.simulate([((), np.zeros((1, len(there.common))))])[0], *_touching(here)]:
        deviations.append(_apart(here, other, _ratio(coarse, twin) if not deviations else math.inf))
    found = []
    for i, motion in enumerate(own):
        left = SURE * np.sqrt(sum(d[i] ** 2 for d in deviations))
        seen = here.camera.see(motion.alone(), i, np.zeros(len(here.camera.deviations)))[0]
        # Error is shared: no marker is far better than the others.
        common = math.sqrt(float((left**2).mean()))
        moved = math.sqrt(float(((seen - seen[:1]) ** 2).mean()))
        found.append(np.maximum(left, max(common / 2, FLOOR * moved)))
    return Numerics(deviation=tuple(found), edges=(twin.edge, coarse.edge), walls=walls)


def _touching(here: Problem) -> list[list[Motion]]:
    """Motions with planes that are a little nearer or farther: where a body touches is not known better."""
    if not here.scenarios[0].grounds:
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
    return [[m.alone(k) for m in motions] for k in range(2)]


def _apart(here: Problem, other: Sequence[Motion], ratio: float) -> list[np.ndarray]:
    """How far other motions are off, once modulus, pressure and measurement errors are fitted [M, A] m for each trial.

    Errors fall with the square of the cell: of the difference to cells that are ``ratio`` times larger, the finer
    twin's own error is a share.
    """
    told = []
    for i, (trial, motion) in enumerate(zip(here.trials, other, strict=True)):
        assert trial.recording is not None
        place = here.camera.see(motion.alone(), i, np.zeros(len(here.camera.deviations)))[0]
        recording = dataclasses.replace(trial.recording, place=place)
        told.append(dataclasses.replace(trial, recording=recording))
    fit = here.only(told).fit([((), None)], rounds=2)[0]
    if fit is None:
        return [np.zeros(n.shape) for n in here.numerics]
    share = 1 / (ratio**2 - 1) if math.isfinite(ratio) else 0.5
    return [
        share * np.sqrt(((t.recording.place - seen) ** 2).mean(0))
        for t, seen in zip(told, fit.seen, strict=True)
        if t.recording is not None
    ]


def _ratio(coarse: Twin, fine: Twin) -> float:
    """How much larger the cells of a twin are."""
    return max((fine.count / coarse.count) ** (1 / 3), 1.1)
