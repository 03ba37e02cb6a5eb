"""Evidence: how probable recordings are under a model, its parameters and measurement errors integrated out.

    y = h(x) + d + e,     d ~ N(0, c^2 S_num + s^2 K(tau)),     e ~ noise, a share of which lasts

x are strengths, places, beliefs and measurement errors with their priors; S_num is the covariance that the twin's own
error is priced at, and c the share of it that there is; s is the size of what the model does not explain, as a share of
the motion, and tau its correlation time. Given s, tau and c, x is integrated out by Laplace's approximation
(:mod:`torchsoro.sim2real.inference.laplace`); they follow by maximum likelihood of the residual at the mode. Without c,
a model whose twin is priced a factor higher would lose the logarithm of that factor with each sample. No law of an
effect is nature's to the last digit: s is at least what does not matter, so that differences between candidates that do
not matter decide nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import minimize

from torchsoro.sim2real.inference.decision import COMMON
from torchsoro.sim2real.inference.laplace import Mode, ln_box, posterior
from torchsoro.sim2real.inference.noise import CORRELATION
from torchsoro.sim2real.inference.observed import Data, Motions, independent
from torchsoro.sim2real.inference.priors import Prior, bounds
from torchsoro.sim2real.inference.state_space import ROWS, ErrorModel, Gram, Process, integrated, tempered, total

NARROW = 0.05  # of ln s, ln tau and ln c: what they need not be known better than
FIRST, AGAIN = 0.5, 0.1  # steps in ln s, ln tau and ln c with which their search begins; and where it was before
APART = 0.15  # of ln s, ln tau and ln c, for second differences
LEAST_PRICE = 0.1  # of the price of the twin's error, that it has; the noise is above what is less
ALTERNATIONS = 3  # between the mode and the discrepancy that its residual tells

Map = Callable[..., Iterable]  # of a function and its arguments, as the builtin


@dataclass(frozen=True)
class Discrepancy:
    """What a model does not explain: a process in proportion to how far each marker moves along each axis.

    Attributes:
        share: Of the motion, standard deviation; 0 for none.
        time: Correlation time [s].
        twin: Share of its price that the twin's own error has beside it.
    """

    share: float = 0.0
    time: float = CORRELATION
    twin: float = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinError:
    """The twin's own error, once it is corrected by a finer one.

    Attributes:
        amplitude: Standard deviation by axis and marker [A, M] m.
        time: Correlation time [s].
        draws: Errors as they may be, as far as beliefs and measurement errors do not take them up.
        kinds: Of each draw a number: draws of one kind are of one distribution, and errors of all kinds add up. All are
            of one kind if empty.
        modes: Of each trial, in proportion to the draws, errors that move all markers together, each times an unknown
            of unit variance [T, M, A, R] m; none if empty.
    """

    amplitude: np.ndarray
    time: float = CORRELATION
    draws: tuple[Motions, ...] = ()
    kinds: tuple[int, ...] = ()
    modes: Motions = ()

    @property
    def size(self) -> float:
        """Root mean square over axes and markers [m]."""
        return math.sqrt(float((self.amplitude**2).mean()))

    @property
    def count(self) -> float:
        """Independent numbers that all samples amount to, with the most lasting of the draws.

        They are those of a trial, on average, since the error lasts from trial to trial: of three crawlers of another
        code it has one sign in all trials along 27 of 30 responses to effects (``recipes/validate/twin_error.py``).
        """
        return min((max(independent(draw) / len(draw), 1.0) for draw in self.draws), default=1.0)

    def without(self, draw: int) -> TwinError:
        """The same, of whose modes the one of a draw is not known."""
        if not self.modes:
            return self
        return dataclasses.replace(self, modes=tuple(np.delete(m, draw, -1) for m in self.modes))

    def divided(self, factor: float) -> TwinError:
        """That of a twin whose error is so many times smaller."""
        modes = tuple(m / factor for m in self.modes)
        return dataclasses.replace(self, amplitude=self.amplitude / factor, modes=modes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What may be missing, with the priors of all that is fitted.

    Attributes:
        effects: Names; none for the setup as stated.
        priors: Of the unknowns: beliefs, effects, measurement errors [K].
        own: Numbers of the unknowns that belong to the effects.
        simpler: Names of which this one is an extension, as a tether is of a mass, or a pair of its members.
        stated: Names of the first unknowns, which are beliefs over their tolerances.
        released: Numbers of the unknowns of effects that are beliefs without their tolerances.
        forms: Classes of the effects: a name may have several, whose numbers mean something else.
    """

    effects: tuple[str, ...]
    priors: tuple[Prior, ...]
    own: tuple[int, ...] = ()
    simpler: tuple[str, ...] = ()
    stated: tuple[str, ...] = ()
    released: tuple[int, ...] = ()
    forms: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Of the effects."""
        return " + ".join(sorted(self.effects)) or "nothing"

    @property
    def beliefs(self) -> int:
        """Number of the beliefs."""
        return len(self.stated)

    @property
    def simulated(self) -> list[int]:
        """Numbers of the unknowns that simulations depend on: beliefs, and those of the effects."""
        return [*range(self.beliefs), *self.own]


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

    def left(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """Residuals at another point [T, M, A] m."""
        return tuple(r - J @ (x - self.at) for r, J in zip(self.residuals, self.slopes, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    """A model after the recordings, near one mode, with a discrepancy that matters or with one that does not.

    Attributes:
        discrepancy: With which it is most probable.
        mode: Of its unknowns, with that.
        ln_occam: ln of the share of the prior range of s, tau and c that is left.
    """

    discrepancy: Discrepancy
    mode: Mode
    ln_occam: float

    @property
    def ln_evidence(self) -> float:
        """With s, tau and c integrated out."""
        return self.mode.ln_evidence + self.ln_occam


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """A model after the recordings, near one mode.

    Attributes:
        near: The model, and where it was linearised.
        some: With a discrepancy that matters, see :func:`least_that_matters`.
        none: With one that does not.
    """

    near: Linearised
    some: Branch
    none: Branch

    @property
    def ln_evidence(self) -> float:
        """With a discrepancy that matters as probable before as one that does not."""
        return float(np.logaddexp(self.some.ln_evidence, self.none.ln_evidence)) - math.log(2)

    @property
    def matters(self) -> bool:
        """Whether a discrepancy that matters is more probable."""
        return bool(self.some.ln_evidence > self.none.ln_evidence)

    @property
    def best(self) -> Branch:
        """The more probable of the two."""
        return self.some if self.matters else self.none

    @property
    def discrepancy(self) -> Discrepancy:
        """That is more probable."""
        return self.best.discrepancy

    @property
    def mode(self) -> Mode:
        """Of the unknowns, with that discrepancy."""
        return self.best.mode

    @cached_property
    def left(self) -> Motions:
        """Residuals at the mode [T, M, A] m."""
        return self.near.left(self.mode.at)


def errors(data: Data, numerics: TwinError, discrepancy: Discrepancy) -> list[ErrorModel]:
    """All that separates predictions from recordings, of each trial.

    Args:
        data: With the noise and the motion.
        numerics: The twin's own error.
        discrepancy: What the model does not explain.
    """
    white, lasting, twin, unexplained = _unscaled(data, numerics)
    known = (
        Process(time=CORRELATION, loading=lasting),
        Process(time=numerics.time, loading=twin, scale=discrepancy.twin),
    )
    return [
        ErrorModel(
            white=white, processes=(*known, Process(time=discrepancy.time, loading=own, scale=discrepancy.share))
        )
        for own in unexplained
    ]


@lru_cache(maxsize=64)  # s, tau and c are searched for in some hundred steps
def _unscaled(data: Data, numerics: TwinError) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """White noise, and loadings of the noise that lasts, of the twin's error and of what is left of each trial."""
    one = np.full_like(numerics.amplitude, data.noise)
    lasting = _each(math.sqrt(data.lasting) * one)
    return math.sqrt(1 - data.lasting) * one, lasting, _moving(numerics.amplitude), tuple(map(_moving, data.amplitudes))


def _moving(deviation: np.ndarray) -> np.ndarray:
    """Loadings of processes of standard deviation [A, M]: one that all markers share, and one of each [A, M, 1 + M]."""
    return np.concatenate([math.sqrt(COMMON) * deviation[..., None], math.sqrt(1 - COMMON) * _each(deviation)], -1)


def _each(deviation: np.ndarray) -> np.ndarray:
    """Loadings of one process for each marker [A, M, M]."""
    return deviation[..., None] * np.eye(deviation.shape[-1])


def grams(data: Data, near: Linearised, discrepancy: Discrepancy) -> list[Gram]:
    """Products of residual and slopes under the errors of each trial."""
    columns = [np.concatenate([r[..., None], J], -1) for r, J in zip(near.residuals, near.slopes, strict=True)]
    return products(data, near.numerics, discrepancy, columns)


def products(data: Data, numerics: TwinError, discrepancy: Discrepancy, columns: Sequence[np.ndarray]) -> list[Gram]:
    """Products of columns of each trial [T, M, A, C] under its errors, which the first column has where it is lost."""
    found = []
    for i, (trial, model, X) in enumerate(zip(data.trials, errors(data, numerics, discrepancy), columns, strict=True)):
        modes = numerics.modes[i] if numerics.modes else X[..., :0]
        parts = (slice(k, k + ROWS) for k in range(0, len(trial.time), ROWS))
        chunks = ((trial.time[part], np.concatenate([X[part], modes[part]], -1)) for part in parts)
        found.append(integrated(model.gram(chunks), modes.shape[-1]))
    return found


def infer(data: Data, near: Linearised, *, side_by_side: Map = map) -> Posterior:
    """Posterior of a model near a point.

    Args:
        data: Recordings.
        near: The model linearised at a point, which should be close to its mode.
        side_by_side: ``map``, or one that calls in several threads.
    """
    low, high = ranges(data, near.numerics)
    line = least_that_matters(data, near.numerics)
    above, below = np.array([line, *low[1:]]), np.array([line, *high[1:]])
    middle = 0.5 * (above + high)
    # From little and from much: with much, the first mode is not bent by a wrong model.
    some = [(np.array([ln_s, middle[1], high[2]]), above, high) for ln_s in (middle[0], high[0])]
    none = np.array([low[0], middle[1], high[2]]), low, below
    *with_some, without = side_by_side(lambda case: _settled(data, near, *case), [*some, none])
    return Posterior(near=near, some=max(with_some, key=lambda branch: branch.ln_evidence), none=without)


def _settled(data: Data, near: Linearised, start: np.ndarray, low: np.ndarray, high: np.ndarray) -> Branch:
    """The mode, and the ln s, ln tau and ln c that its residual tells, within bounds."""
    x = start
    for k in range(ALTERNATIONS):
        left = near.left(mode_of(data, near, _discrepancy(x)).at)
        before, x = x, restricted(data, near, left, x, low, high, AGAIN if k else FIRST)
        if np.abs(x - before).max() < NARROW:
            break
    mode = mode_of(data, near, _discrepancy(x))
    ln_occam = _ln_occam(data, near, near.left(mode.at), x, low, high)
    return Branch(discrepancy=_discrepancy(x), mode=mode, ln_occam=ln_occam)


def adjusted(data: Data, found: Posterior, kappa: float) -> Posterior:
    """The posterior with the likelihood of effects to the power of 1 / kappa, and the priors as they are.

    Beliefs and measurement errors are integrated out first, with the likelihood as it is: where markers sit is told by
    samples that no effect moves. So ln Z = ln L + ln O, L the likelihood of the effects' own numbers at their mode and
    O the share of their prior that is left there, becomes ln L / kappa + ln O with the covariance of now. L without the
    prior of beliefs and measurement errors where they are, which counts in full: however uncertain sums over samples
    are, a marker that sits off by ten tolerances is as improbable as before.

    Args:
        data: Recordings.
        found: With the likelihood as it is.
        kappa: How much more uncertain sums over samples are than the covariance of the errors says.
    """

    def again(branch: Branch) -> Branch:
        mode, model = branch.mode, found.near.model
        before, after = (_ln_own_occam(model, mode, k) for k in (1.0, kappa))
        strained = ln_strained(model, mode.at, (k for k in range(len(model.priors)) if k not in model.own))
        ln_evidence = (mode.ln_evidence - before - strained) / kappa + after + strained
        wider = mode_of(data, found.near, branch.discrepancy, kappa)
        return dataclasses.replace(branch, mode=dataclasses.replace(wider, ln_evidence=ln_evidence))

    if kappa == 1.0:
        return found
    return dataclasses.replace(found, some=again(found.some), none=again(found.none))


def ln_strained(model: Model, at: np.ndarray, unknowns: Iterable[int]) -> float:
    """Ln of the prior density of some unknowns at a point [K], over that at their most probable values."""
    return sum(model.priors[k].ln_density(float(at[k])) - model.priors[k].ln_density(0.0) for k in unknowns)


def _ln_own_occam(model: Model, mode: Mode, kappa: float) -> float:
    """Ln of the share of the effects' prior that a likelihood to the power of 1 / kappa leaves near a mode."""
    own = list(model.own)
    if not own:
        return 0.0
    priors, at = tuple(model.priors[k] for k in own), mode.at[own]
    weight = np.diag([p.weight(x) for p, x in zip(priors, at, strict=True)])
    precision = (np.linalg.inv(mode.covariance[np.ix_(own, own)]) - weight) / kappa + weight
    ln_prior = sum(p.ln_density(x) for p, x in zip(priors, at, strict=True))
    volume = 0.5 * (len(own) * math.log(2 * math.pi) - float(np.linalg.slogdet(precision)[1]))
    # A number that the likelihood does not tell has its whole range, and no more, which would make up for others.
    return min(0.0, ln_prior + volume + ln_box(at, np.linalg.inv(precision), *bounds(priors)))


def mode_of(data: Data, near: Linearised, discrepancy: Discrepancy, kappa: float = 1.0) -> Mode:
    """Of the unknowns, with a discrepancy."""
    return posterior(tempered(total(grams(data, near, discrepancy)), kappa), near.at, near.model.priors)


def time_range(data: Data) -> tuple[float, float]:
    """Of ln tau: from the interval of samples to the longest trial."""
    shortest = min(float(np.median(np.diff(t.time))) for t in data.trials)
    longest = max(float(t.time[-1] - t.time[0]) for t in data.trials)
    return math.log(shortest), math.log(longest)


def ranges(data: Data, numerics: TwinError) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of ln s, ln tau and ln c, between which their priors are uniform."""
    low, high = time_range(data)
    least, most = np.log(data.shares)
    price = math.log(LEAST_PRICE) if numerics.amplitude.any() else 0.0
    return np.array([least, low, price]), np.array([most, high, 0.0])


def least_that_matters(data: Data, numerics: TwinError) -> float:
    """Ln s of the least discrepancy that matters.

    Less than the twin's price may be its own error in another form. Less than the noise is seen in long recordings, but
    no twin of another's body is as good: where nothing was missing, up to two thirds of the noise were left.
    """
    least, most = data.shares
    return math.log(min(max(least, numerics.size / data.size, data.noise / data.size), 0.9 * most))


def _discrepancy(x: np.ndarray) -> Discrepancy:
    share, time, twin = map(math.exp, x)
    return Discrepancy(share=share, time=time, twin=twin)


def ln_likelihood(data: Data, near: Linearised, left: Motions, x: np.ndarray) -> float:
    """Of what a model leaves of each trial, with ln s, ln tau and ln c."""
    found = products(data, near.numerics, _discrepancy(x), [r[..., None] for r in left])
    return -0.5 * sum(float(gram.product[0, 0]) + gram.ln_det for gram in found)


def restricted(
    data: Data, near: Linearised, left: Motions, x: np.ndarray, low: np.ndarray, high: np.ndarray, step: float
) -> np.ndarray:
    """Ln s, ln tau and ln c with which what a model leaves is most probable, within bounds, near x."""
    moving = np.flatnonzero(high > low)

    def at(free: np.ndarray) -> np.ndarray:
        full = low.copy()
        full[moving] = free
        return full

    start = np.clip(x, low, high)[moving]
    away = np.where(start > 0.5 * (low + high)[moving], -step, step)
    found = minimize(
        lambda free: -ln_likelihood(data, near, left, at(free)),
        start,
        method="Nelder-Mead",
        bounds=[(low[k], high[k]) for k in moving],
        options={
            "maxfev": 30 * len(moving),
            "xatol": 0.5 * NARROW,
            "fatol": 0.05,
            "initial_simplex": start + np.concatenate([np.zeros((1, len(start))), np.diag(away)]),
        },
    )
    return np.clip(at(found.x), low, high)


def _ln_occam(data: Data, near: Linearised, left: Motions, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Ln of the share of the prior range of ln s, ln tau and ln c that residuals leave: by a parabola along each."""
    found, top = 0.0, ln_likelihood(data, near, left, x)
    for k in np.flatnonzero(high > low):
        middle = float(np.clip(x[k], low[k] + APART, high[k] - APART))
        values = []
        for off in (-APART, 0.0, APART):
            y = x.copy()
            y[k] = middle + off
            values.append(ln_likelihood(data, near, left, y))
        slope = (values[2] - values[0]) / (2 * APART)
        bend = min((values[2] + values[0] - 2 * values[1]) / APART**2, 0.0)
        # Finer steps where the parabola is narrow, so that its top is not missed.
        away = np.linspace(-1, 1, 2001) ** 3 * (high[k] - low[k]) + x[k] - middle
        away = away[(away >= low[k] - middle) & (away <= high[k] - middle)]
        height = np.minimum(values[1] - top + slope * away + 0.5 * bend * away**2, 0.0)
        # From its own top: a parabola from beside a steep bound may pass far below that of the residuals.
        mass = float(np.trapezoid(np.exp(height - height.max()), away))
        found += min(0.0, math.log(mass / (high[k] - low[k])))
    return found


def leave_one_out(data: Data, found: Posterior, kappa: float = 1.0) -> np.ndarray:
    """Ln of the predictive density of each trial, given the others [trials].

    ln p(y_i | y_-i) = ln Z(y) - ln Z(y_-i), with s, tau and c of all trials.

    Args:
        data: Recordings.
        found: A model after all of them.
        kappa: See :func:`adjusted`.
    """
    near = found.near
    parts = [tempered(g, kappa) for g in grams(data, near, found.discrepancy)]

    def ln_z(of: list[Gram]) -> float:
        return posterior(total(of), near.at, near.model.priors).ln_evidence if of else 0.0

    return np.array([ln_z(parts) - ln_z(parts[:i] + parts[i + 1 :]) for i in range(len(parts))])


def compared(data: Data, one: Posterior, other: Posterior, kappa: float) -> tuple[float, float]:
    """Gain in ln predictive density of trials left out, and its standard error over trials.

    By density even where sizes decide between names: what the other trials leave unknown widens it, while numbers that
    they do not tell would leave much of the trial by their size.

    Args:
        data: Recordings.
        one: The one that may be better.
        other: The other.
        kappa: Of whose inverse the likelihood is taken to the power.
    """
    gain = leave_one_out(data, one, kappa) - leave_one_out(data, other, kappa)
    n = len(gain)
    return float(gain.sum()), float(math.sqrt(n * gain.var(ddof=1))) if n > 1 else math.inf
