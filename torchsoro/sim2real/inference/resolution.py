"""How fine a twin a budget allows: cells of the twin in use, and of the one that corrects it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from torchsoro.sim2real.data.experiment import Setup
from torchsoro.sim2real.twin.batch import safety
from torchsoro.sim2real.twin.twin import Twin

SPEED = 6e7  # points times variations times time steps that one thread simulates in a second, about
CORES = 2  # processor cores that a budget is stated for, wherever it is spent, so that the twin is the same everywhere
WALLS = 1  # cells through each wall, at least: a cell can bend by itself
SIMULATIONS = 400  # of each trial, that an explanation takes, about
SLOW = 64.0  # reserve of the budget for searches that go on for long, and for slow machines
SLOW_WITH_PLANES = 24.0  # the same of a body that meets planes, where sliding makes a fine twin worth the time
# Cells along an axis of the twin that corrects, over those of the twin in use: the first that its time allows.
FINER = (2.0, 1.5)
FINEST = 1.5  # of a third twin over the one that corrects, where bodies stick to planes


def cost(twin: Twin, trials: int, simulations: float = SIMULATIONS) -> float:
    """Seconds that an explanation takes on two cores, about."""
    s = twin.setup
    bulk, shear = s.youngs_modulus / (3 * (1 - 2 * s.poisson_ratio)), s.youngs_modulus / (2 * (1 + s.poisson_ratio))
    stiffened = 1 + sum(g for g, _ in s.prony) / 2
    square = bulk / s.density * float(twin.frequency.square(np.array(stiffened * shear / bulk)))
    steps = s.duration * math.sqrt(square) / (2 * safety(twin))
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
    chambers = bool(setup.chambers)
    # Where a body lands hangs on its cells more than how it bends.
    edges = [long / 12, long / 8] if chambers else [thin / n for n in ((4, 3, 2) if setup.planes else (3, 2))]
    twins = [Twin(setup, edge=edge, walls=walls, across=2 if edge is edges[-1] else 3) for edge in edges]
    for twin in twins:
        if cost(twin, trials) <= budget / (SLOW_WITH_PLANES if setup.planes else SLOW):
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
    for share in FINER:
        fine = _smaller(twin, share)
        if _once(fine, trials) <= seconds:
            break
    return fine


def finest(fine: Twin, trials: int, seconds: float) -> Twin | None:
    """A third twin, by which the error of the second one is told where bodies stick to planes.

    Args:
        fine: The second one.
        trials: To simulate.
        seconds: On one thread, that simulating them once may take; without a twin that takes so long, None.
    """
    found = _smaller(fine, FINEST)
    return found if _once(found, trials) <= seconds else None


def _once(twin: Twin, trials: int) -> float:
    """Seconds that simulating trials once takes on one thread, about: as long with one trial as with sixteen."""
    return cost(twin, trials, 16 / trials * CORES)


def _smaller(twin: Twin, share: float) -> Twin:
    """A twin with so many more cells along each axis."""
    walls, across = math.ceil(share * twin.walls), math.ceil(share * min(a.cells for a in twin.grid.axes))
    return dataclasses.replace(twin, edge=twin.edge / share, walls=walls, across=across)


def between(twin: Twin, fine: Twin) -> Twin:
    """A twin with cells between those of two others, as good as these where it is decided which node touches when.

    Args:
        twin: The one in use.
        fine: The finer one.
    """
    return _smaller(twin, (1 + twin.edge / fine.edge) / 2)
