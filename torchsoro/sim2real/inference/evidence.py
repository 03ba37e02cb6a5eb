"""Evidence: how probable recordings are under a model, its parameters and measurement errors integrated out.

    y = h(x) + d + e,     d ~ N(0, S_num + s^2 K(tau)),     e ~ noise, a share of which lasts

x are strengths, places, beliefs and measurement errors with their priors; S_num is the covariance of the twin's own
error, s that of what the model does not explain, as a share of the motion, and tau its correlation time. Given s and
tau, x is integrated out by Laplace's approximation (:mod:`torchsoro.sim2real.inference.laplace`); s and tau follow by
restricted maximum likelihood, within a prior that has s = 0 in it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from torchsoro.sim2real.inference.decision import COMMON, LASTING
from torchsoro.sim2real.inference.laplace import Mode, posterior
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.state_space import ROWS, ErrorModel, Gram, Process, total

NOISE_TIME = 0.03  # correlation time of the part of the noise that lasts [s]
SHARES = (1e-3, 1.0)  # of the motion: where the prior of a discrepancy is uniform in ln s
ALTERNATIONS = 3  # between the mode and the discrepancy that its residual tells
STILL = 0.1  # of the mean motion: least amplitude of a discrepancy along an axis without motion


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
    """A process by which motions differ, in proportion to how far each marker moves along each axis.

    Attributes:
        share: Of the motion, standard deviation; 0 for none.
        time: Correlation time [s].
    """

    share: float = 0.0
    time: float = NOISE_TIME


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What may be missing, with the priors of all that is fitted.

    Attributes:
        effects: Names; none for the setup as stated.
        priors: Of the unknowns of effects and beliefs, then of the measurement errors [K].
    """

    effects: tuple[str, ...]
    priors: tuple[Prior, ...]

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
    numerics: Discrepancy = Discrepancy()

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
        ln_evidence: With s and tau integrated out, s > 0.
        ln_exact: The same with s = 0.
    """

    near: Linearised
    discrepancy: Discrepancy
    mode: Mode
    ln_evidence: float
    ln_exact: float

    @property
    def ln_marginal(self) -> float:
        """With s = 0 and s > 0 equally probable before."""
        return float(np.logaddexp(self.ln_evidence, self.ln_exact)) - math.log(2)

    @cached_property
    def left(self) -> tuple[np.ndarray, ...]:
        """Residuals at the mode [T, M, A] m."""
        return self.near.left(self.mode.at)


def errors(data: Data, processes: Sequence[Discrepancy]) -> ErrorModel:
    """All that separates the prediction of a trial from its recording.

    Args:
        data: With the noise and the motion.
        processes: The twin's own error, and what the model does not explain.
    """
    lasting = np.full_like(data.amplitude, math.sqrt(LASTING) * data.noise)
    found = [Process(time=NOISE_TIME, loading=_each(lasting))]
    own = math.sqrt(1 - COMMON) * _each(data.amplitude)
    together = math.sqrt(COMMON) * data.amplitude[..., None]
    loading = np.concatenate([together, own], -1)
    found += [Process(time=p.time, loading=p.share * loading) for p in processes if p.share > 0]
    white = np.full_like(data.amplitude, math.sqrt(1 - LASTING) * data.noise)
    return ErrorModel(white=white, processes=tuple(found))


def _each(deviation: np.ndarray) -> np.ndarray:
    """Loadings of one process for each marker [A, M, M]."""
    return deviation[..., None] * np.eye(deviation.shape[-1])


def grams(data: Data, near: Linearised, discrepancy: Discrepancy) -> list[Gram]:
    """Products of residual and slopes under the errors of each trial."""
    model = errors(data, (near.numerics, discrepancy))
    return [model.gram(near.chunks(data, i)) for i in range(len(data.trials))]


def infer(data: Data, near: Linearised) -> Posterior:
    """Posterior of a model near a point.

    Args:
        data: Recordings.
        near: The model linearised at a point, which should be close to its mode.
    """

    def at(discrepancy: Discrepancy) -> Mode:
        return posterior(total(grams(data, near, discrepancy)), near.at, near.model.priors)

    exact = at(Discrepancy())
    low, high = _ranges(data)
    best: tuple[float, np.ndarray, Mode] | None = None
    # From little and from much: with much, the first mode is not bent by a wrong model.
    for share in (math.sqrt(SHARES[0] * SHARES[1]), SHARES[1] / 3):
        x = np.array([math.log(share), 0.5 * (low[1] + high[1])])
        for _ in range(ALTERNATIONS):
            mode = at(_discrepancy(x))
            before, x = x, _restricted(data, near, near.left(mode.at), x)
            if np.abs(x - before).max() < 0.05:
                break
        mode = at(_discrepancy(x))
        if best is None or mode.ln_evidence > best[0]:
            best = mode.ln_evidence, x, mode
    assert best is not None
    ln_evidence, x, mode = best
    ln_evidence += _ln_occam(data, near, near.left(mode.at), x)
    return Posterior(
        near=near, discrepancy=_discrepancy(x), mode=mode, ln_evidence=ln_evidence, ln_exact=exact.ln_evidence
    )


def _ranges(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Of ln s and ln tau: from the interval of samples to the longest trial."""
    shortest = min(float(np.median(np.diff(t.time))) for t in data.trials)
    longest = max(float(t.time[-1] - t.time[0]) for t in data.trials)
    return np.log([SHARES[0], shortest]), np.log([SHARES[1], longest])


def _discrepancy(x: np.ndarray) -> Discrepancy:
    return Discrepancy(share=math.exp(x[0]), time=math.exp(x[1]))


def _ln_likelihood(data: Data, near: Linearised, left: Sequence[np.ndarray], x: np.ndarray) -> float:
    """Of residuals, with a discrepancy."""
    value, model = 0.0, errors(data, (near.numerics, _discrepancy(x)))
    for trial, r in zip(data.trials, left, strict=True):
        gram = model.gram([(trial.time, r[..., None])])
        value -= 0.5 * (float(gram.product[0, 0]) + gram.ln_det)
    return value


def _restricted(data: Data, near: Linearised, left: Sequence[np.ndarray], x: np.ndarray) -> np.ndarray:
    """Ln s and ln tau with which residuals are most probable."""
    low, high = _ranges(data)
    found = minimize(
        lambda x: -_ln_likelihood(data, near, left, x),
        np.clip(x, low, high),
        method="Nelder-Mead",
        bounds=list(zip(low, high, strict=True)),
        options={"maxfev": 60, "xatol": 0.02, "fatol": 0.05},
    )
    return np.clip(found.x, low, high)


def _ln_occam(data: Data, near: Linearised, left: Sequence[np.ndarray], x: np.ndarray) -> float:
    """Ln of the share of the prior range of ln s and ln tau that residuals leave."""
    low, high = _ranges(data)
    found, h = 0.0, 0.15
    middle = _ln_likelihood(data, near, left, x)
    for i, reach in enumerate(high - low):
        inside = np.clip(x[i], low[i] + h, high[i] - h)
        ends = []
        for side in (-h, h):
            y = x.copy()
            y[i] = inside + side
            ends.append(_ln_likelihood(data, near, left, y))
        y = x.copy()
        y[i] = inside
        at = middle if inside == x[i] else _ln_likelihood(data, near, left, y)
        curvature = (2 * at - ends[0] - ends[1]) / h**2
        width = math.sqrt(2 * math.pi / curvature) if curvature > 0 else math.inf
        found += min(0.0, math.log(width / reach)) if math.isfinite(width) else 0.0
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
