"""Evidence: how probable recordings are under a model, its parameters and measurement errors integrated out.

    y = h(x) + d + e,     d ~ N(0, S_num + s^2 K(tau)),     e ~ noise, a share of which lasts

x are strengths, places, beliefs and measurement errors with their priors; S_num is the covariance of the twin's own
error, s that of what the model does not explain, as a share of the motion, and tau its correlation time. Given s and
tau, x is integrated out by Laplace's approximation (:mod:`torchsoro.sim2real.inference.laplace`); s and tau follow by
restricted maximum likelihood. No law of an effect is nature's to the last digit: s is at least what does not matter,
so that differences between candidates that do not matter decide nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from torchsoro.sim2real.inference.decision import COMMON, LASTING, MATTERS
from torchsoro.sim2real.inference.laplace import Mode, posterior
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.state_space import ROWS, ErrorModel, Gram, Process, total

NOISE_TIME = 0.03  # correlation time of the part of the noise that lasts [s]
SHARES = (MATTERS, 1.0)  # of the motion: where the prior of a discrepancy that matters is uniform in ln s
NARROW = 0.05  # of ln s and ln tau: what they need not be known better than
APART = 0.15  # of ln s and ln tau, for second differences
ALTERNATIONS = 3  # between the mode and the discrepancy that its residual tells
STILL = 0.1  # of the mean motion: least amplitude of a discrepancy along an axis without motion

Motions = tuple[np.ndarray, ...]  # of each trial, as recorded [T, M, A] m


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialData:
    """One recorded trial; nothing in it changes.

    Attributes:
        name: Of the trial.
        time: [T] s.
        position: [T, M, A] m; not a number where a sample was lost.
    """

    name: str
    time: np.ndarray
    position: np.ndarray

    def __post_init__(self) -> None:
        """Keep copies that cannot be written to."""
        if self.position.ndim != 3 or self.time.shape != self.position.shape[:1]:
            raise ValueError(
                f"trial {self.name}: time and position of shapes {self.time.shape} and {self.position.shape}, "
                "wanted [T] and [T, M, A]"
            )
        for name in ("time", "position"):
            value = np.array(getattr(self, name), dtype=np.float64)
            value.flags.writeable = False
            object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """The trials that decide. Trials that are only predicted are in a :class:`HeldOut`, which no decision takes.

    Attributes:
        trials: Recordings.
        noise: Standard deviation of a sample's noise [m].
    """

    trials: tuple[TrialData, ...]
    noise: float

    @cached_property
    def motion(self) -> np.ndarray:
        """Root mean square of the motion about its mean, over all trials [A, M] m."""
        squares = [np.nanmean((t.position - np.nanmean(t.position, 0)) ** 2, 0).T for t in self.trials]
        return np.sqrt(np.mean(squares, 0))

    @cached_property
    def amplitude(self) -> np.ndarray:
        """Of a discrepancy with s = 1 [A, M] m: the motion, and a little of its mean where there is none."""
        return np.hypot(self.motion, STILL * self.size)

    @cached_property
    def size(self) -> float:
        """Root mean square of the motion over markers and axes [m]."""
        return float(np.sqrt(np.mean(self.motion**2)))


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """Trials that are only predicted.

    Attributes:
        trials: Recordings.
    """

    trials: tuple[TrialData, ...]


@dataclass(frozen=True)
class Discrepancy:
    """What a model does not explain: a process in proportion to how far each marker moves along each axis.

    Attributes:
        share: Of the motion, standard deviation; 0 for none.
        time: Correlation time [s].
    """

    share: float = 0.0
    time: float = NOISE_TIME


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinError:
    """The twin's own error, once it is corrected by a finer one.

    Attributes:
        amplitude: Standard deviation by axis and marker [A, M] m.
        time: Correlation time [s].
        draws: Errors as they may be, as far as beliefs and measurement errors do not take them up.
    """

    amplitude: np.ndarray
    time: float = NOISE_TIME
    draws: tuple[Motions, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What may be missing, with the priors of all that is fitted.

    Attributes:
        effects: Names; none for the setup as stated.
        priors: Of the unknowns: beliefs, effects, measurement errors [K].
        own: Numbers of the unknowns that belong to the effects.
        simpler: Names of which this one is an extension, as a tether is of a mass, or a pair of its members.
    """

    effects: tuple[str, ...]
    priors: tuple[Prior, ...]
    own: tuple[int, ...] = ()
    simpler: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of the effects."""
        return " + ".join(sorted(self.effects)) or "nothing"


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """A model near a point.

    Attributes:
        model: Which.
        at: The point [K].
        residuals: Recording less prediction there, of each trial [T, M, A] m.
        slopes: Derivatives of the prediction [T, M, A, K].
        numerics: The twin's own error that is left there.
    """

    model: Model
    at: np.ndarray
    residuals: tuple[np.ndarray, ...]
    slopes: tuple[np.ndarray, ...]
    numerics: TwinError

    def chunks(self, data: Data, trial: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Times, and columns of residual and slopes, of a trial in parts."""
        time = data.trials[trial].time
        for k in range(0, len(time), ROWS):
            part = slice(k, k + ROWS)
            yield time[part], np.concatenate([self.residuals[trial][part, ..., None], self.slopes[trial][part]], -1)

    def left(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Residuals at another point [T, M, A] m."""
        return tuple(r - J @ (x - self.at) for r, J in zip(self.residuals, self.slopes, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """A model after the recordings, near one mode.

    Attributes:
        near: The model, and where it was linearised.
        discrepancy: With which it is most probable.
        mode: Of its unknowns, with that.
        ln_some: ln evidence with s and tau integrated out, s being large enough to matter.
        ln_none: The same with s as large as what does not matter.
    """

    near: Linearised
    discrepancy: Discrepancy
    mode: Mode
    ln_some: float
    ln_none: float

    @property
    def ln_evidence(self) -> float:
        """With a discrepancy that matters as probable before as one that does not."""
        return float(np.logaddexp(self.ln_some, self.ln_none)) - math.log(2)

    @property
    def matters(self) -> bool:
        """Whether a discrepancy that matters is more probable."""
        return self.ln_some > self.ln_none

    @cached_property
    def left(self) -> tuple[np.ndarray, ...]:
        """Residuals at the mode [T, M, A] m."""
        return self.near.left(self.mode.at)


def errors(data: Data, numerics: TwinError, discrepancy: Discrepancy) -> ErrorModel:
    """All that separates the prediction of a trial from its recording.

    Args:
        data: With the noise and the motion.
        numerics: The twin's own error.
        discrepancy: What the model does not explain.
    """
    lasting = np.full_like(data.amplitude, math.sqrt(LASTING) * data.noise)
    found = [
        Process(time=NOISE_TIME, loading=_each(lasting)),
        Process(time=numerics.time, loading=_moving(numerics.amplitude)),
        Process(time=discrepancy.time, loading=_moving(discrepancy.share * data.amplitude)),
    ]
    white = np.full_like(data.amplitude, math.sqrt(1 - LASTING) * data.noise)
    return ErrorModel(white=white, processes=tuple(found))


def _moving(deviation: np.ndarray) -> np.ndarray:
    """Loadings of processes of standard deviation [A, M]: one that all markers share, and one of each [A, M, 1 + M]."""
    return np.concatenate([math.sqrt(COMMON) * deviation[..., None], math.sqrt(1 - COMMON) * _each(deviation)], -1)


def _each(deviation: np.ndarray) -> np.ndarray:
    """Loadings of one process for each marker [A, M, M]."""
    return deviation[..., None] * np.eye(deviation.shape[-1])


def grams(data: Data, near: Linearised, discrepancy: Discrepancy) -> list[Gram]:
    """Products of residual and slopes under the errors of each trial."""
    model = errors(data, near.numerics, discrepancy)
    return [model.gram(near.chunks(data, i)) for i in range(len(data.trials))]


def infer(data: Data, near: Linearised) -> Posterior:
    """Posterior of a model near a point.

    Args:
        data: Recordings.
        near: The model linearised at a point, which should be close to its mode.
    """

    def settled(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray, Mode]:
        """The mode, and the ln s and ln tau that its residual tells, within bounds."""
        x = start
        for _ in range(ALTERNATIONS):
            mode = _mode(data, near, x)
            before, x = x, _restricted(data, near, near.left(mode.at), x, low, high)
            if np.abs(x - before).max() < NARROW:
                break
        mode = _mode(data, near, x)
        return mode.ln_evidence, x, mode

    low, high = _ranges(data)
    middle = 0.5 * (low + high)
    least = np.array([low[0], high[1]])
    # From little and from much: with much, the first mode is not bent by a wrong model.
    some = max(
        (settled(np.array([ln_s, middle[1]]), low, high) for ln_s in (middle[0], high[0])), key=lambda found: found[0]
    )
    none = settled(np.array([low[0], middle[1]]), low, least)
    ln_some = some[0] + _ln_occam(data, near, near.left(some[2].at), some[1], low, high)
    ln_none = none[0] + _ln_occam(data, near, near.left(none[2].at), none[1], low, least)
    _, x, mode = some if ln_some > ln_none else none
    return Posterior(near=near, discrepancy=_discrepancy(x), mode=mode, ln_some=ln_some, ln_none=ln_none)


def _mode(data: Data, near: Linearised, x: np.ndarray) -> Mode:
    """With ln s and ln tau."""
    return posterior(total(grams(data, near, _discrepancy(x))), near.at, near.model.priors)


def time_range(data: Data) -> tuple[float, float]:
    """Of ln tau: from the interval of samples to the longest trial."""
    shortest = min(float(np.median(np.diff(t.time))) for t in data.trials)
    longest = max(float(t.time[-1] - t.time[0]) for t in data.trials)
    return math.log(shortest), math.log(longest)


def _ranges(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Of ln s and ln tau."""
    low, high = time_range(data)
    return np.array([math.log(SHARES[0]), low]), np.array([math.log(SHARES[1]), high])


def _discrepancy(x: np.ndarray) -> Discrepancy:
    return Discrepancy(share=math.exp(x[0]), time=math.exp(x[1]))


def _ln_likelihood(data: Data, near: Linearised, left: Sequence[np.ndarray], x: np.ndarray) -> float:
    """Of residuals, with a discrepancy."""
    value, model = 0.0, errors(data, near.numerics, _discrepancy(x))
    for trial, r in zip(data.trials, left, strict=True):
        gram = model.gram([(trial.time, r[..., None])])
        value -= 0.5 * (float(gram.product[0, 0]) + gram.ln_det)
    return value


def _restricted(
    data: Data, near: Linearised, left: Motions, x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Ln s and ln tau with which residuals are most probable, within bounds."""
    moving = np.flatnonzero(high > low)

    def at(free: np.ndarray) -> np.ndarray:
        full = low.copy()
        full[moving] = free
        return full

    found = minimize(
        lambda free: -_ln_likelihood(data, near, left, at(free)),
        np.clip(x, low, high)[moving],
        method="Nelder-Mead",
        bounds=[(low[k], high[k]) for k in moving],
        options={"maxfev": 30 * len(moving), "xatol": 0.5 * NARROW, "fatol": 0.05},
    )
    return np.clip(at(found.x), low, high)


def _ln_occam(data: Data, near: Linearised, left: Motions, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Ln of the share of the prior range of ln s and ln tau that residuals leave, by second differences."""
    found = 0.0
    for k in np.flatnonzero(high > low):
        middle = float(np.clip(x[k], low[k] + APART, high[k] - APART))
        values = []
        for off in (-APART, 0.0, APART):
            y = x.copy()
            y[k] = middle + off
            values.append(_ln_likelihood(data, near, left, y))
        curvature = (2 * values[1] - values[0] - values[2]) / APART**2
        if curvature > 0:
            found += min(0.0, 0.5 * math.log(2 * math.pi / curvature) - math.log(high[k] - low[k]))
    return found


def leave_one_out(data: Data, found: Posterior) -> np.ndarray:
    """Ln of the predictive density of each trial, given the others [trials].

    ln p(y_i | y_-i) = ln Z(y) - ln Z(y_-i), with s and tau of all trials.
    """
    parts = grams(data, found.near, found.discrepancy)
    near = found.near
    whole = posterior(total(parts), near.at, near.model.priors).ln_evidence
    if len(parts) == 1:
        return np.array([whole])
    rest = [total([g for j, g in enumerate(parts) if j != i]) for i in range(len(parts))]
    return np.array([whole - posterior(g, near.at, near.model.priors).ln_evidence for g in rest])


def without(data: Data, trial: str) -> Data:
    """The data without one of its trials."""
    return dataclasses.replace(data, trials=tuple(t for t in data.trials if t.name != trial))
