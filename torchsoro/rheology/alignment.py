"""Likelihood of time-temperature shift factors: a Gaussian process of the master curve of each modulus.

With x = log10 of frequency and y = log10 of a modulus, curve k is

    y_k(x) = f(x + log10 a_k) - log10 b_k + d_k(x) + noise

where a_k and b_k are the horizontal and vertical shift factors, f is the master curve (Matern 5/2 kernel, standard
deviation 2 decades, length scale estimated), d_k is the discrepancy of curve k from the master curve (squared
exponential kernel, length scale 1 decade, standard deviation, called misfit, estimated), and the noise is white
(standard deviation estimated). Shifts and the three hyperparameters of each modulus maximise the likelihood; no
smoothing parameter is set by hand. Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, Eqs. 2.30 and
5.9.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from torchsoro.rheology.measured import Creep, Relaxation, Sweep

HEIGHT = 2.0  # prior standard deviation of the master curve [decades of modulus]
MISFIT_LENGTH = 1.0  # length scale of the discrepancy from the master curve [decades of frequency]
FLOOR = 3e-4  # lower bound of the noise standard deviation: resolution of a rheometer [decades]
START = np.log([3e-3, 5.0, 0.01])  # initial noise [decades], length scale [decades of frequency], misfit [decades]
BOUNDS = [(np.log(1e-5), np.log(0.3)), (0.0, np.log(100.0)), (np.log(1e-6), np.log(0.3))]
OUTLIER = 2.5  # leave-one-out residual in standard deviations above which the weight of a point is reduced
GAP = 0.5  # largest gap in frequency between neighbouring shifted curves [decades]
MOST = 40  # largest number of points of a curve; curves with more are averaged in bins
SAME = 1.0  # temperature difference below which log10 a_T is not required to fall with temperature [K]
GRID = 0.05  # spacing of the grid of initial horizontal steps [decades]
VERTICAL = 0.3  # largest vertical step [decades]
ROUNDS = 12  # largest number of alternations between shifts and hyperparameters
_NONE = np.log(1e-7)


@dataclass(frozen=True, kw_only=True, eq=False)
class Channel:
    """Values of one modulus (storage, loss, relaxation) or of the compliance on all curves.

    Attributes:
        x: log10 of frequency, as measured [n].
        y: log10 of the modulus minus its mean over all points [n].
        curve: Index of the curve of each point [n].
        weight: Noise variance of each point over the common noise variance [n].
        hyper: Natural logarithms of noise, length scale and misfit [3].
    """

    x: np.ndarray
    y: np.ndarray
    curve: np.ndarray
    weight: np.ndarray
    hyper: np.ndarray = field(default_factory=START.copy)

    def part(self, *curves: int) -> Channel:
        """Points of the given curves."""
        keep = np.isin(self.curve, curves)
        return replace(self, x=self.x[keep], y=self.y[keep], curve=self.curve[keep], weight=self.weight[keep])

    def departure(self) -> np.ndarray:
        """Correlation matrix of the discrepancy from the master curve [n, n]."""
        near = np.exp(-0.5 * ((self.x[:, None] - self.x) / MISFIT_LENGTH) ** 2)
        return np.where(self.curve[:, None] == self.curve, near, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Gaussian process of one modulus at given shifts: n points with covariance K and values y.

    Attributes:
        value: Negative log likelihood up to a constant.
        inverse: K^-1 [n, n].
        pull: K^-1 y [n], the derivative of ``value`` with respect to y.
        by_x: Derivative of ``value`` with respect to log10 of the shifted frequency of each point [n].
        slope: Posterior mean slope d log10 modulus / d log10 frequency of the master curve at each point [n].
        parts: Derivatives of K with respect to the logarithms of noise, length scale and misfit [3, n, n].
    """

    value: float
    inverse: np.ndarray
    pull: np.ndarray
    by_x: np.ndarray
    slope: np.ndarray
    parts: tuple[np.ndarray, np.ndarray, np.ndarray]

    def by_hyper(self, by_covariance: np.ndarray | None = None) -> np.ndarray:
        """Derivative with respect to the hyperparameters [3] by the chain rule.

        Args:
            by_covariance: Derivative of a scalar with respect to K [n, n]; that of ``value`` if None.
        """
        if by_covariance is None:
            by_covariance = 0.5 * (self.inverse - np.outer(self.pull, self.pull))
        return np.array([(by_covariance * part).sum() for part in self.parts])


def process(channel: Channel, x: np.ndarray, y: np.ndarray, hyper: np.ndarray, departure: np.ndarray) -> State:
    """Evaluate the Gaussian process of one modulus and its derivatives.

    Args:
        channel: Points.
        x: log10 of the shifted frequencies [n].
        y: log10 of the shifted moduli [n].
        hyper: Natural logarithms of noise, length scale and misfit [3].
        departure: ``channel.departure()``.
    """
    noise, length, misfit = np.exp(hyper)
    h = (x[:, None] - x) / length
    r = np.sqrt(5.0) * np.abs(h)
    decay = HEIGHT**2 * np.exp(-r)
    bend = 5 / 3 * (1 + r) * decay * h
    covariance = (1 + r + r * r / 3) * decay + misfit**2 * departure
    covariance += 10 * HEIGHT**2  # wide prior of the mean level
    covariance[np.diag_indices(len(x))] += (noise**2 + FLOOR**2) * channel.weight
    factor = cho_factor(covariance, lower=True)
    inverse = cho_solve(factor, np.eye(len(x)))
    pull = inverse @ y
    rise = -bend / length  # derivative of K with respect to x of its row
    return State(
        value=float(0.5 * y @ pull + np.log(np.diag(factor[0])).sum()),
        inverse=inverse,
        pull=pull,
        by_x=(inverse * rise).sum(1) - pull * (rise @ pull),
        slope=rise @ pull,
        parts=(np.diag(2 * noise**2 * channel.weight), bend * h, 2 * misfit**2 * departure),
    )


def abscissa(curve: Sweep | Relaxation | Creep) -> np.ndarray:
    """log10 of the frequency, or of one over the time [n]."""
    return np.log10(curve.omega) if isinstance(curve, Sweep) else -np.log10(curve.time)


def channels_of(curves: Sequence[Sweep | Relaxation | Creep], moduli: str) -> list[Channel]:
    """log10 of each modulus of all curves, binned by :func:`_thin`; points of zero loss modulus are omitted.

    Raises:
        ValueError: for an unknown ``moduli``, or fewer than three positive values on a curve.
    """
    if moduli not in ("both", "storage", "loss"):
        raise ValueError(f'moduli = {moduli!r}: wanted "both", "storage" or "loss"')
    if moduli != "both" and not isinstance(curves[0], Sweep):
        raise ValueError(f'moduli = {moduli!r}: wanted "both", since {type(curves[0]).__name__} has a single one')
    channels = []
    for name in curves[0].ordinates if moduli == "both" else (moduli,):
        x, y, number = [], [], []
        for k, curve in enumerate(curves):
            positive = getattr(curve, name) > 0
            if positive.sum() < 3:
                at = f"curve at {curve.temperature:.4g} deg C"
                raise ValueError(f"{at}: {positive.sum()} positive values of {name}, wanted at least 3")
            along, value = _thin(abscissa(curve)[positive], np.log10(getattr(curve, name)[positive]))
            x.append(along)
            y.append(value)
            number.append(np.full(len(along), k))
        together = np.concatenate(y)
        channels.append(
            Channel(
                x=np.concatenate(x),
                y=together - together.mean(),
                curve=np.concatenate(number),
                weight=np.ones(len(together)),
            )
        )
    return channels


def _thin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over ``MOST`` bins of equal width in x, for curves of more than ``MOST`` points."""
    if len(x) <= MOST:
        return x, y
    part = np.minimum((x - x.min()) / np.ptp(x) * MOST, MOST - 1).astype(int)
    counts = np.bincount(part, minlength=MOST)
    full = counts > 0
    along, value = (np.bincount(part, v, MOST)[full] / counts[full] for v in (x, y))
    return along, value


def window(channels: list[Channel], temperatures: np.ndarray, i: int) -> tuple[float, float]:
    """Bounds of the horizontal step from curve i to curve i + 1 [decades].

    The gap between the shifted curves is at most ``GAP``; log10 a_T does not increase with temperature where the
    temperatures differ by at least ``SAME``.

    Raises:
        ValueError: if no step satisfies both.
    """
    cold, hot = (np.concatenate([c.x[c.curve == k] for c in channels]) for k in (i, i + 1))
    low, high = hot.min() - cold.max() - GAP, hot.max() - cold.min() + GAP
    if temperatures[i + 1] - temperatures[i] >= SAME:
        low = max(low, 0.0)
    if low >= high:
        raise ValueError(
            f"curves at {temperatures[i]:.4g} and {temperatures[i + 1]:.4g} deg C: overlap needs log10 a_T of the "
            f"colder minus that of the hotter <= {high:.3g} decades; wanted a shift factor that falls with temperature"
        )
    return float(low), float(high)


def roughness(channel: Channel) -> Channel:
    """Estimate noise and length scale from each curve separately, and increase the noise variance of outliers.

    Weights are iterated: a leave-one-out residual above ``OUTLIER`` standard deviations multiplies the variance of its
    point by the squared ratio.
    """
    curves = [channel.part(k) for k in np.unique(channel.curve)]
    none = [np.zeros((len(c.x), len(c.x))) for c in curves]

    def states(hyper: np.ndarray, weights: list[np.ndarray]) -> list[State]:
        full = np.append(hyper, _NONE)
        each = zip(curves, weights, none, strict=True)
        return [process(replace(c, weight=w), c.x, c.y - c.y.mean(), full, no) for c, w, no in each]

    def objective(hyper: np.ndarray, weights: list[np.ndarray]) -> tuple[float, np.ndarray]:
        found = states(hyper, weights)
        return sum(state.value for state in found), np.sum([state.by_hyper()[:2] for state in found], axis=0)

    hyper = START[:2]
    ones = [np.ones(len(c.x)) for c in curves]
    weights = ones
    for _ in range(5):
        hyper = minimize(objective, hyper, args=(weights,), jac=True, method="L-BFGS-B", bounds=BOUNDS[:2]).x
        weights = [
            np.maximum(1.0, state.pull**2 / np.diag(state.inverse) / OUTLIER**2) for state in states(hyper, ones)
        ]
    weight = np.ones(len(channel.x))
    for k, values in zip(np.unique(channel.curve), weights, strict=True):
        weight[channel.curve == k] = values
    return replace(channel, weight=weight, hyper=np.append(hyper, START[2]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Result of :meth:`Alignment.solve`.

    Attributes:
        steps: Horizontal, then vertical steps between neighbouring curves [count] decades.
        covariance: Covariance of the steps [count, count].
        hypers: Noise, length scale and misfit of each channel [c, 3].
    """

    steps: np.ndarray
    covariance: np.ndarray
    hypers: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """Maximum-likelihood steps of the shift factors from each curve to the next hotter one.

    The unknowns are the horizontal steps [m] between m + 1 curves, the vertical steps [m] if ``vertical``, and the
    hyperparameters of each channel. Steps of neighbours are used instead of shifts since their bounds are independent.
    Steps maximise the likelihood and hyperparameters the restricted likelihood, in alternation. The latter accounts for
    the fitted steps (Patterson and Thompson, Biometrika 58 (1971) 545); the plain likelihood underestimates the misfit,
    which shifts can absorb, and with it the standard errors.

    Attributes:
        channels: As from :func:`roughness`.
        windows: Bounds of each horizontal step [decades].
        vertical: Whether vertical steps are estimated.
        misfit: Standard deviation of the discrepancy [decades]; estimated if None.
        sign: 1 for moduli, which b_T multiplies; -1 for compliances, which b_T divides.
    """

    channels: list[Channel]
    windows: list[tuple[float, float]]
    vertical: bool
    misfit: float | None
    sign: float

    @property
    def sums(self) -> np.ndarray:
        """Matrix from steps to shifts relative to the coldest curve [m + 1, m]."""
        m = len(self.windows)
        return -np.tril(np.ones((m + 1, m)), -1)

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper bounds of all steps [count, 2] decades."""
        vertical = [(-VERTICAL, VERTICAL)] * (len(self.windows) if self.vertical else 0)
        return np.array([*self.windows, *vertical])

    def solve(self, progress: Callable[[float], object]) -> Solution:
        """Estimate steps, covariance and hyperparameters, starting from the best step of each pair of neighbours."""
        m = len(self.windows)
        hypers = np.array([channel.hyper for channel in self.channels])
        bounds = BOUNDS
        if self.misfit is not None:
            given = np.log(self.misfit) if self.misfit > 0 else _NONE
            bounds = [*BOUNDS[:2], (given, given)]
            hypers[:, 0] = np.log(np.hypot(np.exp(hypers[:, 0]), np.exp(START[2])))
            hypers[:, 2] = given
        steps = np.concatenate([[self._guess(i) for i in range(m)], np.zeros(len(self.bounds) - m)])
        departures = [channel.departure() for channel in self.channels]
        value = np.inf
        for done in range(ROUNDS):
            found = minimize(
                self._objective,
                steps,
                args=(hypers, departures),
                jac=True,
                method="L-BFGS-B",
                bounds=self.bounds,
                options={"maxiter": 500, "ftol": 1e-8},
            )
            steps = found.x
            effects = self._effects(steps, hypers, departures)
            better = minimize(
                self._restricted,
                hypers.ravel(),
                args=(steps, effects, departures),
                jac=True,
                method="L-BFGS-B",
                bounds=bounds * len(hypers),
            )
            hypers = better.x.reshape(-1, 3)
            if abs(better.fun - value) < 0.01:
                progress(1 - done / ROUNDS)
                break
            progress(1 / ROUNDS)
            value = better.fun
        information = self._information(self._states(steps, hypers, departures), effects)
        return Solution(steps=steps, hypers=np.exp(hypers), covariance=np.linalg.inv(information))

    def _shifted(self, steps: np.ndarray, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
        """log10 of the shifted frequencies and moduli of a channel."""
        m, k = len(self.windows), channel.curve
        y = channel.y + self.sign * (self.sums @ steps[m:])[k] if self.vertical else channel.y
        return channel.x + (self.sums @ steps[:m])[k], y

    def _states(self, steps: np.ndarray, hypers: np.ndarray, departures: list[np.ndarray]) -> list[State]:
        """Gaussian process of each channel."""
        each = zip(self.channels, hypers, departures, strict=True)
        return [process(c, *self._shifted(steps, c), hyper, departure) for c, hyper, departure in each]

    def _objective(
        self, steps: np.ndarray, hypers: np.ndarray, departures: list[np.ndarray]
    ) -> tuple[float, np.ndarray]:
        """Negative log likelihood, and its gradient with respect to the steps."""
        states = self._states(steps, hypers, departures)
        count = len(self.windows) + 1
        each = list(zip(self.channels, states, strict=True))
        by_a = sum(np.bincount(c.curve, state.by_x, count) for c, state in each) @ self.sums
        by_b = sum(np.bincount(c.curve, state.pull, count) for c, state in each) @ self.sums * self.sign
        gradient = np.concatenate([by_a, by_b]) if self.vertical else by_a
        return sum(state.value for state in states), gradient

    def _effects(self, steps: np.ndarray, hypers: np.ndarray, departures: list[np.ndarray]) -> list[np.ndarray]:
        """Derivative of the moduli of each channel with respect to the steps [n, count]; zero for steps at a bound."""
        free = np.abs(steps[:, None] - self.bounds).min(1) > 1e-6
        effects = []
        for channel, state in zip(self.channels, self._states(steps, hypers, departures), strict=True):
            total = self.sums[channel.curve]
            both = [total * state.slope[:, None], *([-self.sign * total] if self.vertical else [])]
            effects.append(np.concatenate(both, axis=1) * free)
        return effects

    def _information(self, states: list[State], effects: list[np.ndarray]) -> np.ndarray:
        """Inverse covariance of the steps; an undetermined step has the variance of a uniform one over its bounds."""
        window = np.diag(12 / np.ptp(self.bounds, axis=1) ** 2)
        return window + sum(effect.T @ state.inverse @ effect for state, effect in zip(states, effects, strict=True))

    def _restricted(
        self, hypers: np.ndarray, steps: np.ndarray, effects: list[np.ndarray], departures: list[np.ndarray]
    ) -> tuple[float, np.ndarray]:
        """Negative log restricted likelihood, and its gradient with respect to the hyperparameters."""
        states = self._states(steps, hypers.reshape(-1, 3), departures)
        information = self._information(states, effects)
        covariance = np.linalg.inv(information)
        value = sum(state.value for state in states) + 0.5 * np.linalg.slogdet(information)[1]
        gradient = []
        for state, effect in zip(states, effects, strict=True):
            seen = state.inverse @ effect
            gradient.append(state.by_hyper() - state.by_hyper(0.5 * seen @ covariance @ seen.T))
        return float(value), np.concatenate(gradient)

    def _guess(self, i: int) -> float:
        """Most likely horizontal step from curve i to curve i + 1 on a grid, from these two curves alone."""
        low, high = self.windows[i]
        grid = np.linspace(low, high, max(2, round((high - low) / GRID)))
        total = np.zeros(len(grid))
        for channel in self.channels:
            pair = channel.part(i, i + 1)
            y, departure = pair.y - pair.y.mean(), pair.departure()
            for j, step in enumerate(grid):
                total[j] += process(pair, pair.x + step * (pair.curve == i), y, channel.hyper, departure).value
        return float(grid[total.argmin()])
