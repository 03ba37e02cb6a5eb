"""Price of the twin's own error that is left once a finer twin corrects it, at a candidate's own parameters.

Smooth motion: the error falls with a power of the edge of the cells, so that two twins of edges h1 > h2 tell that of
the finer one (Richardson 1911),

    e = (y2 - y1) / ((h1 / h2)^p - 1).

The cells alone would give p = 2. Where a clamp or a wall ends, stress grows as r^(lambda - 1) with the distance r from
that edge, lambda = 0.7 where a clamped face meets a free one at a right angle (Williams 1952), and p = 2 lambda.

Contact: which node touches when is decided by distances far below a cell, and motion after that differs by more than
what finer cells change. Twins whose planes are shifted below a cell are equally good: R of them are draws of one
distribution, and so is nature. What grows in proportion to the shift g is no chance, but what a plane elsewhere does;
where planes are is stated. Beside that line, their mean at no shift predicts best, and its error has the covariance

    S = (1 + 1/R) 1/(R - 2) sum_r d_r d_r',    d_r = y_r - mean - g_r sum_q g_q y_q / sum_q g_q^2,    sum_q g_q = 0,

to which that of other cells is added, which are as good. Where a third twin has smaller cells of edge h3, what these
change is added to motions, and what is left of it at order one, h3 / (h2 - h3) of it, is one more direction. Where
touching is calm, motions are those of cells without size, as extrapolated from these at the order p below, and what
that adds is the direction. The whole difference to larger cells, the error of the finer ones at order one, is another
in which these may be off. Errors of unlike kinds add. Where walls have two cells or more, the standard deviation by
which searches are weighted counts beside them; it is no measure of how far where one cell is as wide as a wall.

In all but that by smaller cells, only that counts which beliefs and measurement errors cannot take up.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from torchsoro.sim2real.inference.evidence import (
    Discrepancy,
    Linearised,
    Model,
    TwinError,
    errors,
    grams,
    time_range,
)
from torchsoro.sim2real.inference.laplace import posterior
from torchsoro.sim2real.inference.observed import Data, Motions, size_of
from torchsoro.sim2real.inference.state_space import total

# Of convergence with the edge of the cells, of smooth motion: two bars and two posts show 0.7 to 1.3. So extrapolated,
# a pad's error falls from 35 to 20 um (lifted) and rises from 9 to 11 um (pushed).
ORDER = 1.4
TOUCHING = 1  # the same of bodies that meet planes: where nodes touch is known to a cell
FAINT = 1e-3  # of the differences' size: white noise with which their correlation time is found


def by_richardson(data: Data, near: Linearised, coarser: Motions, ratio: float) -> Linearised:
    """The finer of two twins, with the error that this one has.

    Args:
        data: Recordings.
        near: Residuals by the finer twin.
        coarser: Residuals by the other.
        ratio: Edge of its cells over that of the finer one.

    Raises:
        ValueError: for a ratio that is not above one.
    """
    if not ratio > 1:
        raise ValueError(f"ratio = {ratio:g}, wanted one above 1: the other twin has larger cells")
    share = 1 / (ratio**ORDER - 1)
    error = cleared(data, near, tuple(share * (b - a) for a, b in zip(near.residuals, coarser, strict=True)))
    return dataclasses.replace(near, numerics=_process(data, (error,), (error,)))


def by_spread(
    data: Data,
    near: Linearised,
    variants: Sequence[Motions],
    shifts: np.ndarray,
    coarser: Motions | None = None,
    ratio: float = math.inf,
    others: Sequence[Motions] = (),
    beyond: Sequence[Motions] = (),
    known: np.ndarray | float = 0.0,
) -> Linearised:
    """The mean of equally good twins, with the error that this has, in each trial by itself.

    Errors of contact move a body as a whole, much as effects do: a variance of each marker would not know, and take an
    effect that moves the body alike for the better explanation. So the covariance of the variants is kept as it is,
    beside a process of the same size for what they do not show.

    Args:
        data: Recordings.
        near: Of which residuals do not count.
        variants: Residuals by each of R twins.
        shifts: Of their planes [R], which sum to zero.
        coarser: Residuals by a twin with larger cells.
        ratio: Edge of its cells over that of the variants'.
        others: Errors of other kinds: what other cells that are as good, or another coefficient of friction, change.
        beyond: What cells without size would change, as known from smaller ones.
        known: Standard deviation of an error that is known by its size alone [A, M] m.

    Raises:
        ValueError: for fewer than three variants, shifts that are not theirs or do not sum to zero, or a ratio that is
            not above one.
    """
    count = len(variants)
    if count < 3:
        raise ValueError(f"variants: {count}, wanted three or more twins, as two are always on a line")
    if len(shifts) != count or abs(shifts.sum()) > 1e-9 * np.abs(shifts).max():
        raise ValueError(f"shifts = {shifts}, wanted {count} that sum to zero")
    if not ratio > 1:
        raise ValueError(f"ratio = {ratio:g}, wanted one above 1: the other twin has larger cells")
    mean, chance = beside_line(variants, shifts)
    factor = math.sqrt(1 + 1 / count)
    draws = [cleared(data, near, tuple(factor * d for d in one)) for one in chance]
    modes = [tuple(d / math.sqrt(count) for d in draw) for draw in draws]
    whole = []
    if coarser is not None:
        share = 1 / (ratio**TOUCHING - 1)
        whole = [cleared(data, near, tuple(share * (b - m) for b, m in zip(coarser, mean, strict=True)))]
    apart = [cleared(data, near, other) for other in (*others, *beyond)]
    process = _process(data, [*draws, *apart], [*modes, *apart])
    # Cells that are too soft in all trials strain what is believed of the modulus, so that this part is in the mode.
    together = tuple(np.stack(same, -1) for same in zip(*modes, *whole, *apart[: len(others)], *beyond, strict=True))
    beside = [*whole, *apart]
    numerics = dataclasses.replace(
        process,
        amplitude=np.hypot(process.amplitude, known),
        draws=(*draws, *beside),
        kinds=(*[0] * count, *range(1, 1 + len(beside))),
        modes=together,
    )
    return dataclasses.replace(near, residuals=mean, numerics=numerics)


def beside_line(variants: Sequence[Motions], shifts: np.ndarray) -> tuple[Motions, list[Motions]]:
    """The mean of motions with planes that are shifted, and draws of what is not in proportion to the shift.

    Args:
        variants: Motions or residuals with each of R shifts.
        shifts: Of the planes [R], which sum to zero.
    """
    count = len(variants)
    mean = tuple(np.mean(same, 0) for same in zip(*variants, strict=True))
    line = tuple(np.tensordot(shifts / (shifts @ shifts), np.stack(same), 1) for same in zip(*variants, strict=True))
    factor = math.sqrt(count / (count - 2))
    draws = [
        tuple(factor * (r - m - g * b) for r, m, b in zip(one, mean, line, strict=True))
        for one, g in zip(variants, shifts, strict=True)
    ]
    return mean, draws


def chance_in(variants: Sequence[Motions], shifts: np.ndarray) -> float:
    """Root mean square of what is not in proportion to the shift, see :func:`beside_line` [m]."""
    _, draws = beside_line(variants, shifts)
    return math.sqrt(sum(size_of(d) ** 2 for d in draws) / len(draws))


def cleared(data: Data, near: Linearised, difference: Motions) -> Motions:
    """What is left of differences between motions once beliefs and measurement errors are fitted to them."""
    # A modulus takes up the same whether it is a belief or an effect.
    kept = set(near.model.own) - set(near.model.released)
    free = [k for k in range(len(near.at)) if k not in kept]
    model = Model(effects=(), priors=tuple(near.model.priors[k] for k in free))
    still = Linearised(
        model=model,
        at=np.zeros(len(free)),
        residuals=difference,
        slopes=tuple(J[..., free] for J in near.slopes),
        numerics=TwinError(amplitude=np.zeros_like(data.amplitudes[0])),
    )
    return still.left(posterior(total(grams(data, still, Discrepancy())), still.at, model.priors).at)


def _process(data: Data, draws: Sequence[Motions], modes: Sequence[Motions]) -> TwinError:
    """The process that errors are draws of: its correlation time, and its size by axis and marker, of all modes."""
    amplitude = _amplitude(draws)
    if not amplitude.any():
        return TwinError(amplitude=amplitude, draws=tuple(draws))
    quiet = dataclasses.replace(data, noise=FAINT * float(amplitude.mean()))
    columns = [np.stack(same, -1) for same in zip(*draws, strict=True)]

    def lost(x: np.ndarray) -> float:
        models = errors(quiet, TwinError(amplitude=math.exp(x[0]) * amplitude, time=math.exp(x[1])), Discrepancy())
        grams = (model.gram([(t.time, d)]) for t, model, d in zip(data.trials, models, columns, strict=True))
        return 0.5 * sum(float(np.trace(g.product)) + len(draws) * g.ln_det for g in grams)

    low, high = time_range(data)
    found = minimize(
        lost,
        [0.0, 0.5 * (low + high)],
        method="Nelder-Mead",
        bounds=[(-1.0, 1.0), (low, high)],
        options={"maxfev": 60, "xatol": 0.02, "fatol": 0.1},
    )
    # The size is that of the differences: of smooth ones, likelihood by itself would make it up.
    size = math.sqrt(len(modes)) * _amplitude(modes)
    return TwinError(amplitude=size, time=math.exp(float(found.x[1])), draws=tuple(draws))


def _amplitude(draws: Sequence[Motions]) -> np.ndarray:
    """Root mean square of some draws, by axis and marker [A, M] m."""
    own = np.mean([np.nanmean(d**2, 0).T for draw in draws for d in draw], 0)
    # A few draws tell an average better than each of its parts.
    return np.asarray(np.sqrt((own + own.mean()) / 2))
