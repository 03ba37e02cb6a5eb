"""Fits of a neo-Hookean or Yeoh solid with Maxwell elements to finite-strain tests.

The model is the discrete material of the simulator (``rheology.pointwise``). Residuals are relative to the root mean
square stress of each test, and tests have equal weight, independent of their number of samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import t as student
from torch import Tensor

from torchsoro.rheology.finite import Experiment
from torchsoro.rheology.pointwise import Law, equibiaxial, simple_shear, uniaxial
from torchsoro.simulation.material import SOFTEST, Prony, Solid

LEVEL = 0.90  # of the intervals
_STEP = 1e-30  # of the complex step
_LARGEST = {"shear": 0.1, "uniaxial": 0.02, "equibiaxial": 0.02}  # change of the deformation in a step


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Fitted constant with its confidence interval at ``LEVEL``."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A fitted law.

    Attributes:
        shear: Equilibrium shear modulus at rest, mu [Pa].
        stiffening: a and b; mu grows to mu (1 + a x + b x^2) at x = I1b - 3.
        moduli: Moduli of the Maxwell elements over mu [M].
        times: Relaxation times [M] s, descending.
        poisson_ratio: Assumed Poisson ratio, which stress data alone do not determine.
        order: Number of fitted stiffening terms: 0 for neo-Hooke, 1 or 2 for Yeoh.
        intervals: Intervals of "shear" [Pa], "a", "b", "C20", "C30" [Pa], "g1", "tau1" [s] and so on, if fitted.
        error: Relative root mean square error over all tests, as of :meth:`error_of`.
        bic: Bayesian information criterion; lower is better, for the same tests. It assumes independent residuals:
            systematic residuals favour more constants, so that held-out tests are the better criterion.
        inflation: Inflation of the variances by serial correlation of the residuals.
        largest: Largest I1 - 3 in the tests; beyond it the law is extrapolated.
        factors: Stress factor of each test if fitted (``specimens``), else 1.
        unknowns: Final values of the unknowns, to start another fit from.
    """

    shear: float
    stiffening: tuple[float, float]
    moduli: tuple[float, ...]
    times: tuple[float, ...]
    poisson_ratio: float
    order: int
    intervals: dict[str, Interval]
    error: float
    bic: float
    inflation: float
    largest: float
    factors: tuple[float, ...]
    unknowns: np.ndarray

    @property
    def law(self) -> Law:
        """Law for :mod:`torchsoro.rheology.pointwise`."""
        values = np.array([self.shear, *self.stiffening, *self.moduli, *self.times])
        return _law(torch.from_numpy(values), self.poisson_ratio, len(self.moduli))

    def solid(self, density: float) -> Solid:
        """Solid for the simulator.

        Args:
            density: Density [kg/m3].

        Raises:
            ValueError: as for ``Solid``, including a stress that decreases with stretch, which ``stable`` excludes.
        """
        a, b = self.stiffening
        return Solid(
            youngs_modulus=2 * (1 + self.poisson_ratio) * self.shear,
            poisson_ratio=self.poisson_ratio,
            density=density,
            linear_stiffening=a,
            quadratic_stiffening=b,
        )

    def prony(self) -> Prony:
        """The Maxwell elements for the simulator."""
        moduli, times = (torch.tensor(t, dtype=torch.float64) for t in (self.moduli, self.times))
        return Prony(moduli=moduli, times=times)

    def predict(self, experiment: Experiment) -> np.ndarray:
        """Nominal stress at the samples of a test [n] Pa."""
        return _Model([experiment]).stress(self.law).numpy()

    def error_of(self, experiments: Sequence[Experiment], *, specimens: bool = False) -> float:
        """Root mean square error of the stress over the root mean square stress, with equal weight of each test.

        Args:
            experiments: Tests, fitted or held out.
            specimens: Whether each prediction is scaled by its best factor, so that only the shape is compared.
        """
        squares = []
        for e in experiments:
            found = self.predict(e)
            factor = float(found @ e.stress) / float(found @ found) if specimens else 1.0
            squares.append(float(((factor * found - e.stress) ** 2).mean()) / e.rms() ** 2)
        return math.sqrt(sum(squares) / len(squares))


def fit(
    experiments: Sequence[Experiment],
    *,
    order: int = 2,
    elements: int = 0,
    poisson_ratio: float = 0.495,
    stable: bool = True,
    specimens: bool = False,
    start: Fit | None = None,
) -> Fit:
    """Fit a law to tests.

    Intervals follow from the linearised fit, with the variance estimated from the residuals and inflated by their
    serial correlation, as in :func:`torchsoro.rheology.spectrum.fit`.

    Args:
        experiments: Tests of one material, of any modes.
        order: Stiffening terms: 0 for neo-Hooke, 1 for a, 2 for a and b.
        elements: Number of Maxwell elements, 0 to 5.
        poisson_ratio: Poisson ratio of the law, 0 to below 0.5.
        stable: Whether the stress must increase with stretch, also beyond the tests, as ``Solid`` requires.
        specimens: Whether a stress factor of each specimen is fitted; their geometric mean is 1.
        start: Fit with one element fewer and otherwise equal settings to start from.

    Raises:
        ValueError: for no tests, tests without stress, or numbers outside their range.
    """
    if not experiments or not all(e.rms() > 0 for e in experiments):
        raise ValueError(f"experiments: {len(experiments)}, wanted at least one, all with some stress")
    if order not in (0, 1, 2) or elements not in range(6) or not 0 <= poisson_ratio < 0.5:
        raise ValueError(
            f"order, elements, poisson_ratio = {order}, {elements}, {poisson_ratio}: wanted 0 to 2, 0 to 5, and 0 to "
            "below 0.5"
        )
    problem = _Problem(experiments, order, elements, poisson_ratio, stable, specimens)
    found = [problem.solve(guess) for guess in problem.guesses(start)]
    return problem.report(min(found, key=lambda f: f.cost))


def ladder(experiments: Sequence[Experiment], *, most: int, **settings) -> list[Fit]:
    """Fits with 0, 1, ... up to ``most`` Maxwell elements, each begun from the one before."""
    fits: list[Fit] = []
    for elements in range(most + 1):
        fits.append(fit(experiments, elements=elements, start=fits[-1] if fits else None, **settings))
    return fits


def _law(values: Tensor, poisson_ratio: float, elements: int) -> Law:
    """From mu, a, b, moduli and times [..., 3 + 2 M]; an axis for the tests is put before the last."""
    shear, stiffening, moduli, times = values.unsqueeze(-2).split([1, 2, elements, elements], -1)
    shear = shear.squeeze(-1)
    bulk = shear * (2 * (1 + poisson_ratio) / (3 * (1 - 2 * poisson_ratio)))
    return Law(shear=shear, bulk=bulk, stiffening=stiffening, moduli=moduli, times=times)


class _Model:
    """Stress of a law at the samples of tests, all of one mode at once."""

    def __init__(self, experiments: Sequence[Experiment]) -> None:
        self.count = len(experiments)
        self.batches: list[tuple[str, list[int], list[np.ndarray], Tensor, Tensor]] = []
        for mode in dict.fromkeys(e.mode for e in experiments):
            tests = [i for i, e in enumerate(experiments) if e.mode == mode]
            paths = [experiments[i].path(_LARGEST[mode]) for i in tests]
            longest = max(len(way) for way, _, _ in paths)
            even = [[np.pad(p[k], (0, longest - len(p[k])), mode="edge") for p in paths] for k in (0, 1)]
            way, steps = (torch.from_numpy(np.stack(rows)) for rows in even)
            self.batches.append((mode, tests, [at for _, _, at in paths], way, steps))

    def stress(self, law: Law) -> Tensor:
        """Nominal stress, one test after the other [..., n] Pa."""
        parts: dict[int, Tensor] = {}
        for mode, tests, samples, way, steps in self.batches:
            if mode == "shear":
                found = simple_shear(way, steps, law)
            else:
                found = (uniaxial if mode == "uniaxial" else equibiaxial)(way, steps, law)[0]
            for row, (test, at) in enumerate(zip(tests, samples, strict=True)):
                parts[test] = found[..., row, torch.from_numpy(at)]
        return torch.cat([parts[i] for i in range(self.count)], -1)


@dataclass(frozen=True)
class _Problem:
    """Residuals of a fit as functions of its unknowns.

    These are ln mu; what a exceeds its least by and sqrt(b), or a and b themselves, in units of the tests; then ln of
    the elements' moduli [Pa] and ln of their times [s]; then ln of the factors of all specimens but the first.
    """

    experiments: Sequence[Experiment]
    order: int
    elements: int
    poisson_ratio: float
    stable: bool
    specimens: bool

    @cached_property
    def model(self) -> _Model:
        """Model of all tests."""
        return _Model(self.experiments)

    @cached_property
    def largest(self) -> float:
        """Largest I1 - 3 in the tests."""
        return max(float(e.invariant.max()) for e in self.experiments)

    @cached_property
    def scale(self) -> np.ndarray:
        """Divisor of the stresses [n] Pa, for equal weight of the tests and a sum of squares of n e^2."""
        count = sum(len(e.time) for e in self.experiments)
        even = [e.rms() * math.sqrt(len(e.time) * len(self.experiments) / count) for e in self.experiments]
        return np.repeat(even, [len(e.time) for e in self.experiments])

    @cached_property
    def measured(self) -> np.ndarray:
        """Scaled stress [n]."""
        return np.concatenate([e.stress for e in self.experiments]) / self.scale

    @cached_property
    def secant(self) -> float:
        """Scale of the modulus, for initial values [Pa]."""
        return max(float(np.abs(e.stress).max() / math.sqrt(e.invariant.max())) for e in self.experiments) / 2

    @cached_property
    def window(self) -> tuple[float, float]:
        """Logarithms of the shortest and longest relaxation time [s] covered by the tests."""
        steps = min(float(e.path(_LARGEST[e.mode])[1].min()) for e in self.experiments)
        return math.log(steps), math.log(10 * max(float(e.time[-1]) for e in self.experiments))

    def numbers(self, x: np.ndarray) -> np.ndarray:
        """From unknowns [..., K] to mu, a, b, relative moduli and times [..., 3 + 2 M]; complex for complex ones."""
        mu = np.exp(x[..., :1])
        a = b = 0 * mu
        if self.order == 1:
            a = x[..., 1:2] / self.largest
        elif self.order == 2 and self.stable:
            root = x[..., 2:3] / self.largest
            a, b = x[..., 1:2] / self.largest - SOFTEST * root, root * root
        elif self.order == 2:
            a, b = x[..., 1:2] / self.largest, x[..., 2:3] / self.largest**2
        rest = x[..., 1 + self.order : x.shape[-1] - self.others]
        log_moduli, log_times = rest[..., : self.elements], rest[..., self.elements :]
        return np.concatenate([mu, a, b, np.exp(log_moduli) / mu, np.exp(log_times)], -1)

    @property
    def others(self) -> int:
        """Number of specimens with a fitted stress factor."""
        return len(self.experiments) - 1 if self.specimens else 0

    def factors(self, x: np.ndarray) -> np.ndarray:
        """Stress factor of each test [..., tests]."""
        logs = x[..., x.shape[-1] - self.others :]
        if not self.specimens:
            return np.ones((*x.shape[:-1], len(self.experiments)))
        return np.exp(np.concatenate([-logs.sum(-1, keepdims=True), logs], -1))

    def stress(self, x: np.ndarray) -> np.ndarray:
        """Scaled stress [..., n]."""
        law = _law(torch.from_numpy(self.numbers(x)), self.poisson_ratio, self.elements)
        factors = np.repeat(self.factors(x), [len(e.time) for e in self.experiments], axis=-1)
        return self.model.stress(law).numpy() * factors / self.scale

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Derivatives of the scaled stress by the unknowns [n, K]."""
        return (np.imag(self.stress(x + 1j * _STEP * np.eye(len(x)))) / _STEP).T

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the unknowns."""
        middle, (fast, slow), m = math.log(self.secant), self.window, self.elements
        small, large = middle - math.log(1e4), middle + math.log(1e4)
        least = 0.0 if self.stable else -np.inf
        low = [small, *[least] * self.order, *[small] * m, *[fast] * m, *[-3.0] * self.others]
        high = [large, *[np.inf] * self.order, *[large] * m, *[slow] * m, *[3.0] * self.others]
        return np.array(low), np.array(high)

    def guesses(self, start: Fit | None) -> list[np.ndarray]:
        """Initial values of the unknowns."""
        middle, (fast, slow), m = math.log(self.secant), self.window, self.elements
        if start is not None and m == len(start.moduli) + 1:
            elastic, rest, factors = np.split(start.unknowns, [1 + self.order, 2 * m - 1 + self.order])
            places = np.linspace(fast, slow, 7)[1:-1]
            before = [*elastic, *rest[: m - 1], middle - 1, *rest[m - 1 :]]
            return [np.array([*before, place, *factors]) for place in places]
        elastic, factors = [middle, *[0.1] * self.order], [0.0] * self.others
        return [np.array([*elastic, *[middle - 1] * m, *np.linspace(slow, fast, m + 2)[1:-1], *factors])]

    def solve(self, guess: np.ndarray) -> OptimizeResult:
        """Least squares from initial values."""
        low, high = self.bounds
        room = 1e-6 * np.where(np.isfinite(high - low), high - low, 1.0)
        return least_squares(
            lambda x: self.stress(x) - self.measured,
            np.clip(guess, low + room, high - room),
            jac=self.jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            x_scale="jac",
            ftol=1e-8,
            xtol=1e-8,
            max_nfev=150,
        )

    def report(self, found: OptimizeResult) -> Fit:
        """The fit with its intervals."""
        x, n, count = found.x, len(self.measured), len(found.x)
        error, grown = 2 * float(found.cost), self._inflation(found.fun)
        # Intervals are computed in a and b, which are unbounded, and then limited to the stable range of the law.
        free, at = self._unbounded(x)
        low, high = self.bounds
        held = (x - low < 1e-5) | (high - x < 1e-5)
        held[1 : 1 + self.order] = False
        jacobian = free.jacobian(at)
        covariance = np.diag(1 / np.maximum((jacobian**2).sum(0), 1e-300))
        covariance[np.ix_(~held, ~held)] = np.linalg.pinv(jacobian[:, ~held].T @ jacobian[:, ~held])
        covariance *= error / max(n - count, 1) * grown
        order = np.argsort(-self.numbers(x)[3 + self.elements :])
        mu, a, b, *rest = self.numbers(x).tolist()
        moduli, times = np.array(rest[: self.elements])[order], np.array(rest[self.elements :])[order]
        wide = float(student.ppf((1 + LEVEL) / 2, max(n - count, 1)))
        return Fit(
            shear=mu,
            stiffening=(a, b),
            moduli=tuple(moduli.tolist()),
            times=tuple(times.tolist()),
            poisson_ratio=self.poisson_ratio,
            order=self.order,
            intervals=free._intervals(at, covariance, order, wide, self.stable),
            error=math.sqrt(error / n),
            bic=n * math.log(max(error, 1e-20 * n) / n) + count * math.log(n),
            inflation=grown,
            largest=self.largest,
            factors=tuple(self.factors(x).tolist()),
            unknowns=x,
        )

    def _unbounded(self, x: np.ndarray) -> tuple[_Problem, np.ndarray]:
        """The same problem with a and b as unknowns, and their values."""
        _, a, b = self.numbers(x)[:3]
        at = x.copy()
        at[1 : 1 + self.order] = [a * self.largest, b * self.largest**2][: self.order]
        return replace(self, stable=False), at

    def _intervals(
        self, x: np.ndarray, covariance: np.ndarray, order: np.ndarray, wide: float, stable: bool
    ) -> dict[str, Interval]:
        """Intervals of all constants by error propagation; logarithmic for positive constants."""
        numbers = self.numbers(x + 1j * _STEP * np.eye(len(x)))
        mu, a, b = numbers[:, 0], numbers[:, 1], numbers[:, 2]
        named = {"shear": mu}
        named |= {"a": a, "C20": a * mu / 4} if self.order > 0 else {}
        named |= {"b": b, "C30": b * mu / 6} if self.order > 1 else {}
        for row, at in enumerate(order, start=1):
            named |= {f"g{row}": numbers[:, 3 + at], f"tau{row}": numbers[:, 3 + self.elements + at]}
        found = {}
        for name, value in named.items():
            slope, middle = np.imag(value) / _STEP, float(np.real(value[0]))
            half = wide * math.sqrt(max(float(slope @ covariance @ slope), 0.0))
            if name in ("a", "C20", "b", "C30"):
                least = 0.0 if stable and (name in ("b", "C30") or self.order == 1) else -math.inf
                found[name] = Interval(value=middle, low=max(middle - half, least), high=middle + half)
            else:
                ratio = math.exp(min(half / middle, 300.0))
                found[name] = Interval(value=middle, low=middle / ratio, high=middle * ratio)
        return found

    def _inflation(self, residual: np.ndarray) -> float:
        """(1 + r) / (1 - r) for the serial correlation r within the tests, 1 if that is noise."""
        curves = np.split(residual, np.cumsum([len(e.time) for e in self.experiments])[:-1])
        total = float((residual**2).sum())
        r = sum(float(c[1:] @ c[:-1]) for c in curves) / total if total > 0 else 0.0
        return (1 + r) / (1 - min(r, 0.999)) if r > 2 / math.sqrt(len(residual)) else 1.0
