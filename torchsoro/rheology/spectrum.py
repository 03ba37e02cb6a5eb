"""Discrete relaxation spectra (Prony series) fitted to measurements, with confidence intervals of the moduli.

A generalised Maxwell solid has the storage and loss modulus

    E'(w) = E_inf + sum_i E_i (w tau_i)^2 / (1 + (w tau_i)^2),    E''(w) = sum_i E_i w tau_i / (1 + (w tau_i)^2)

(Eqs. 17a, 17b) and the relaxation modulus E(t) = E_inf + sum_i E_i exp(-t / tau_i), with non-negative moduli. The same
holds for a shear modulus G.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from scipy.stats import f as fisher

from torchsoro.rheology.creep import compliance, relaxing
from torchsoro.rheology.leastsquares import Found, Problem, fixed, floor, free, inflation, profiles
from torchsoro.rheology.measured import Creep, Deformation, Relaxation, Sweep
from torchsoro.rheology.residuals import relative_residuals
from torchsoro.simulation.material import Prony, Solid

LEVEL = 0.95  # confidence of the intervals
PENALTIES = (0.0, 1e-2, 1e-1, 1.0, 10.0)  # candidate weights for regularization = "auto"
# Optimised relaxation times may lie outside the data window by these factors, so that unobserved relaxation does not
# bias terms inside it. Below the window a term acts as a dashpot in a sweep and vanishes in the time domain; far above
# it a term is indistinguishable from the equilibrium modulus.
_FASTER = {Sweep: 30.0, Relaxation: 3.0, Creep: 3.0}
_SLOWER = 3.0
_PERMANENT = 0.5  # smallest ratio of a determined equilibrium modulus to the modulus at the slow end of the data
_HELD = "with the relaxation times held: one element fewer fits equally well within the correlated residuals"
_EDGE = 1.05  # a relaxation time within this factor of an end of the window lies on it


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Confidence interval of one modulus, at ``LEVEL``.

    Attributes:
        low: Lower bound [Pa].
        high: Upper bound [Pa], inf if there is none.
        unknown: Reason why the data do not determine the modulus; empty if they do.
        condition: Fitted quantities on which the interval is conditional; empty if there are none.
    """

    low: float
    high: float
    unknown: str = ""
    condition: str = ""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One fit of the model selection.

    Attributes:
        elements: Number of terms.
        regularization: Weight of the second-difference penalty.
        error: Sum of the squared relative residuals; e of Eq. 17c for a sweep.
        parameters: Effective number of parameters.
        bic: n ln(error / n) + parameters ln(n) over the n measured values; the smallest is selected.
    """

    elements: int
    regularization: float
    error: float
    parameters: float
    bic: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum:
    """Relaxation spectrum: equilibrium modulus and Maxwell terms in absolute units, relaxation times ascending.

    Attributes:
        equilibrium: E_inf or G_inf [Pa]; after a fit it includes all relaxation slower than the data window.
        moduli: Moduli E_i or G_i [M] Pa.
        times: Relaxation times tau_i [M] s, not decreasing.
        deformation: "tension" for Young's moduli, "shear" for shear moduli.
        temperature: Temperature [deg C], nan if unknown.
        window: Shortest and longest relaxation time covered by the data [s]; None if not fitted.
        equilibrium_interval: Interval of ``equilibrium``; None if not fitted or given.
        intervals: Interval of each modulus; empty if not fitted.
        evidence: All fits of the model selection; empty if not fitted.
        error: Sum of the squared relative residuals (e of Eq. 17c), nan if not fitted.
        floor: Least ``error`` of any non-negative spectrum within the window. If it is far above the scatter of the
            data, storage and loss modulus are inconsistent with one linear viscoelastic material.
        inflation: Variance inflation by serial correlation of the residuals; 1 if they are independent.

    Raises:
        ValueError: for different shapes, negative or infinite numbers, decreasing times or an unknown deformation.
    """

    equilibrium: float
    moduli: np.ndarray
    times: np.ndarray
    deformation: Deformation
    temperature: float = math.nan
    window: tuple[float, float] | None = None
    equilibrium_interval: Interval | None = None
    intervals: tuple[Interval, ...] = ()
    evidence: tuple[Candidate, ...] = ()
    error: float = math.nan
    floor: float = math.nan
    inflation: float = 1.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        moduli, times = np.asarray(self.moduli, dtype=float), np.asarray(self.times, dtype=float)
        if moduli.ndim != 1 or moduli.shape != times.shape:
            raise ValueError(f"moduli, times: shapes {moduli.shape} and {times.shape}, wanted the same [M]")
        if not (np.isfinite(moduli).all() and (moduli >= 0).all()):
            raise ValueError(f"moduli = {moduli.tolist()}: wanted finite and at least 0")
        if not (np.isfinite(times).all() and (times > 0).all() and (np.diff(times) >= 0).all()):
            raise ValueError(f"times = {times.tolist()}: wanted positive, the shortest first")
        if not (math.isfinite(self.equilibrium) and self.equilibrium >= 0):
            raise ValueError(f"equilibrium = {self.equilibrium}: wanted finite and at least 0")
        if self.deformation not in ("tension", "shear"):
            raise ValueError(f'deformation = {self.deformation!r}: wanted "tension" or "shear"')
        object.__setattr__(self, "moduli", moduli)
        object.__setattr__(self, "times", times)

    def storage_loss(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Storage and loss modulus [Pa] at angular frequencies [rad/s] (Eqs. 17a, 17b)."""
        wt = np.asarray(omega, dtype=float)[..., None] * self.times
        part = self.moduli * wt / (1 + wt * wt)
        return self.equilibrium + (part * wt).sum(-1), part.sum(-1)

    def relaxation(self, time: np.ndarray) -> np.ndarray:
        """Relaxation modulus [Pa] at times [s] after a step of strain."""
        return self.equilibrium + np.exp(-np.asarray(time, dtype=float)[..., None] / self.times) @ self.moduli

    def creep(self, time: np.ndarray) -> np.ndarray:
        """Creep compliance [1/Pa] at times [s] after a step of stress."""
        return compliance(self.equilibrium, self.moduli, self.times, time)

    def prony(self, *, equilibrium: float | None = None) -> Prony:
        """Prony series for the simulator: moduli over the equilibrium modulus, relaxation times descending.

        Args:
            equilibrium: Equilibrium modulus from another test [Pa], which replaces the fitted one.

        Raises:
            ValueError: if the equilibrium modulus is zero or undetermined, or for more than five terms.
        """
        relative = self.relative(equilibrium=equilibrium)
        if len(relative) > 5:
            raise ValueError(
                f"the spectrum has {len(relative)} terms, the simulator takes at most 5: "
                "choose some with torchsoro.rheology.budget.choose, or fit with elements=5"
            )
        return Prony(moduli=torch.from_numpy(relative[::-1].copy()), times=torch.from_numpy(self.times[::-1].copy()))

    def relative(self, *, equilibrium: float | None = None) -> np.ndarray:
        """Moduli over the equilibrium modulus [M] for any number of terms; arguments and errors as :meth:`prony`."""
        return self.moduli / self._permanent(equilibrium)

    def solid(self, poisson_ratio: float, density: float, *, equilibrium: float | None = None) -> Solid:
        """Solid for the simulator, with Young's modulus E_inf or 2 (1 + nu) G_inf.

        Relative moduli measured in tension are used for shear, as in the paper: exact for a constant Poisson ratio.

        Args:
            poisson_ratio: Poisson ratio nu, 0 to below 0.5.
            density: Density [kg/m3].
            equilibrium: As in :meth:`prony`.

        Raises:
            ValueError: as :meth:`prony`, and as Solid.
        """
        factor = 1.0 if self.deformation == "tension" else 2 * (1 + poisson_ratio)
        modulus = factor * self._permanent(equilibrium)
        return Solid(youngs_modulus=modulus, poisson_ratio=poisson_ratio, density=density)

    def _permanent(self, given: float | None) -> float:
        if given is not None:
            if not (math.isfinite(given) and given > 0):
                raise ValueError(f"equilibrium = {given}: wanted finite and positive")
            return given
        known = self.equilibrium_interval
        if self.equilibrium > 0 and (known is None or known.low > 0):
            return self.equilibrium
        bound = "" if known is None else f" (0 to {known.high:.3g} Pa)"
        raise ValueError(
            f"the equilibrium modulus is {'zero' if self.equilibrium == 0 else 'not determined'}{bound}, as of a melt; "
            "the simulator's moduli are relative to it: measure slower or warmer, or give equilibrium=... in Pa, for "
            "example from a slow tensile test"
        )

    def rows(self) -> list[dict[str, float | str]]:
        """One row for the equilibrium modulus and each term: time [s], modulus and interval [Pa], remark."""
        known = (self.equilibrium_interval, *(self.intervals or (None,) * len(self.moduli)))
        values = zip((math.inf, *self.times), (self.equilibrium, *self.moduli), known, strict=True)
        return [
            {"time [s]": float(time), "modulus [Pa]": float(modulus)}
            | ({} if i is None else {"low [Pa]": i.low, "high [Pa]": i.high, "remark": i.unknown or i.condition})
            for time, modulus, i in values
        ]


def error_norm(spectrum: Spectrum, sweep: Sweep) -> float:
    """Error norm e of Eq. 17c: sum of the squared relative residuals of storage and loss modulus.

    Raises:
        ValueError: if spectrum and sweep differ in ``deformation``.
    """
    if spectrum.deformation != sweep.deformation:
        raise ValueError(f"sweep.deformation = {sweep.deformation!r}: wanted {spectrum.deformation!r}, the spectrum's")
    storage, loss = spectrum.storage_loss(sweep.omega)
    return float(((storage / sweep.storage - 1) ** 2 + (loss / sweep.loss - 1) ** 2).sum())


def fit(
    data: Sweep | Relaxation | Creep,
    *,
    elements: int | Literal["auto"] = "auto",
    times: Literal["free", "log"] | Sequence[float] | np.ndarray = "free",
    equilibrium: bool | float = True,
    regularization: float | Literal["auto"] = "auto",
    window: tuple[float, float] | None = None,
    intervals: bool = True,
) -> Spectrum:
    """Fit a Prony series to storage and loss modulus (Eq. 17c), stress relaxation or creep by relative residuals.

    Moduli are non-negative. The number of terms minimises the Bayesian information criterion, which assumes independent
    residuals: systematic errors of a curve favour more terms, down to the least possible error (``Spectrum.floor``).

    Intervals are profile likelihoods at 95 %. At each value of a modulus all other moduli are refitted, and optimised
    relaxation times too, each bounded by the geometric means with its neighbours, so that terms do not exchange roles.
    If with serially correlated residuals the other terms can still replace a term, its interval is conditional on the
    fitted relaxation times (``Interval.condition``). The noise variance is estimated from the residuals and inflated by
    their serial correlation. Given and logarithmically spaced relaxation times and the penalty are treated as exact.
    A modulus is undetermined if its interval includes zero or has no upper bound, or if its relaxation time lies at or
    beyond an end of the data window, where the term represents all faster or slower relaxation. The equilibrium modulus
    is undetermined if it is less than half of the modulus at the slow end of the data.

    For creep a retardation spectrum is fitted and converted to the relaxation spectrum; ``elements``, ``times``,
    ``window`` and ``evidence`` then refer to the retardation spectrum, and intervals are Laplace approximations.

    Args:
        data: Frequency sweep or master curve, stress relaxation, or creep.
        elements: Number of terms, or "auto".
        times: "free" for optimised relaxation times; "log" for logarithmic spacing over the window, as in the paper; or
            the relaxation times [s].
        equilibrium: Whether an equilibrium modulus is fitted, or its fixed value [Pa].
        regularization: Weight of the penalty on second differences of the moduli, each scaled by the norm of its column
            of relative residuals; not for optimised times. "auto" minimises the criterion with the effective number of
            parameters.
        window: Shortest and longest relaxation time [s] of optimised or logarithmically spaced times. If None,
            logarithmic spacing covers the data, from one over the highest to one over the lowest frequency; optimised
            times may be up to 30 times shorter (3 times for relaxation and creep) and 3 times longer.
        intervals: Whether intervals are computed, which takes longer than the fit.

    Returns:
        The spectrum with intervals and evidence.

    Raises:
        ValueError: for too few points, values that are not positive, or arguments outside their range.
    """
    if elements != "auto" and not (isinstance(elements, int) and elements >= 1):
        raise ValueError(f'elements = {elements!r}: wanted a number of at least 1 or "auto"')
    if regularization != "auto" and not (math.isfinite(regularization) and regularization >= 0):
        raise ValueError(f'regularization = {regularization!r}: wanted at least 0 or "auto"')
    if window is not None and not 0 < window[0] < window[1] < math.inf:
        raise ValueError(f"window = {window}: wanted a shorter and a longer relaxation time in s")
    optimised = isinstance(times, str) and times == "free"
    problem = relative_residuals(data, equilibrium, window)
    seen = relative_residuals(data, equilibrium).window
    if optimised and window is None:
        problem = replace(problem, window=(seen[0] / _FASTER[type(data)], seen[1] * _SLOWER))
    count = None if elements == "auto" else int(elements)
    if optimised:
        if regularization not in ("auto", 0):
            raise ValueError(f'regularization = {regularization}: wanted 0 or "auto" where the times are free')
        tried = free(problem, count)
    else:
        weights = PENALTIES if regularization == "auto" else (float(regularization),)
        tried = [found for grid in _grids(problem, times, count) for found in fixed(problem, grid, weights)]
    best = min(tried if count is None else [f for f in tried if len(f.times) == count], key=lambda f: f.bic)
    spare = len(problem.target) - best.parameters
    if spare < 1:
        raise ValueError(f"data: {len(problem.target)} values for {len(best.values)} moduli, wanted more points")
    if isinstance(data, Creep):
        terms = _from_creep(problem, best, spare, optimised, intervals)
    else:
        terms = {
            "equilibrium": float(best.values[0]) if problem.first else float(equilibrium),
            "moduli": best.values[problem.first :],
            "times": best.times,
        } | (_known(problem, best, seen, spare, optimised) if intervals else {})
    return Spectrum(
        deformation=data.deformation,
        temperature=data.temperature,
        window=seen,
        evidence=tuple(
            Candidate(elements=len(f.times), regularization=f.weight, error=f.error, parameters=f.parameters, bic=f.bic)
            for f in tried
        ),
        error=best.error,
        floor=min(floor(problem).error, best.error) if intervals else math.nan,
        **terms,
    )


def _grids(problem: Problem, times: str | Sequence[float] | np.ndarray, count: int | None) -> list[np.ndarray]:
    if isinstance(times, str):
        if times != "log":
            raise ValueError(f'times = {times!r}: wanted "free", "log" or the relaxation times in s')
        most = min(3 * math.ceil(math.log10(problem.window[1] / problem.window[0])), len(problem.target) - 2)
        return [problem.grid(m) for m in (range(1, most + 1) if count is None else (count,))]
    given = np.sort(np.asarray(times, dtype=float))
    if given.ndim != 1 or not len(given) or not (np.isfinite(given).all() and (given > 0).all()):
        raise ValueError(f"times = {times}: wanted positive relaxation times [M] in s")
    if count not in (None, len(given)):
        raise ValueError(f'elements = {count}: wanted {len(given)}, the number of given times, or "auto"')
    return [given]


def _known(problem: Problem, best: Found, seen: tuple[float, float], spare: float, optimised: bool) -> dict[str, Any]:
    """Variance inflation, and intervals of the equilibrium modulus and the moduli."""
    grown = inflation(problem, best)
    rise = best.error * grown * float(fisher.ppf(LEVEL, 1, spare)) / spare
    ends = list(profiles(problem, best, rise, optimised=optimised))
    held = list(profiles(problem, best, rise, optimised=False)) if optimised and grown > 1 else ends
    fast, slow = max(seen[0], problem.window[0]) * _EDGE, min(seen[1], problem.window[1]) / _EDGE
    known = []
    for i, ((low, high), fixed_times) in enumerate(zip(ends, held, strict=True)):
        time = None if i < problem.first else best.times[i - problem.first]
        if time is not None and not fast < time < slow:
            side, more = ("fast", "higher frequencies or colder") if time <= fast else ("slow", "for longer or warmer")
            why = f"stands for all relaxation {side}er than the data window: measure at {more}"
            known.append(Interval(low=0.0, high=math.inf, unknown=why.replace("at for", "for")))
        elif time is not None and low == 0 < fixed_times[0]:
            known.append(Interval(low=fixed_times[0], high=fixed_times[1], condition=_HELD))
        else:
            known.append(Interval(low=low, high=high, unknown="" if low > 0 else "the data are consistent with zero"))
    if problem.constant is not None:
        known[0] = _settled(known[0], float(best.values[0] * problem.constant.max()))
    return {
        "inflation": grown,
        "equilibrium_interval": known[0] if problem.first else None,
        "intervals": tuple(known[problem.first :]),
    }


def _from_creep(problem: Problem, best: Found, spare: float, optimised: bool, intervals: bool) -> dict[str, Any]:
    """Relaxation spectrum of a fitted retardation spectrum, with intervals by Laplace approximation."""
    grown = inflation(problem, best)
    terms, errors = relaxing(problem, best, optimised=optimised)
    terms = {"equilibrium": float(terms.values[0]), "moduli": terms.values[1:], "times": terms.times}
    if not intervals:
        return terms
    reach = math.sqrt(best.error * grown * float(fisher.ppf(LEVEL, 1, spare)) / spare)
    known = []
    for value, error in zip((terms["equilibrium"], *terms["moduli"].tolist()), errors.tolist(), strict=True):
        factor = math.exp(min(reach * error, 700.0))
        why = "" if factor < 10 else "the interval exceeds a factor of ten to either side"
        known.append(
            Interval(low=0.0 if why else value / factor, high=math.inf if why else value * factor, unknown=why)
        )
    assert problem.constant is not None
    ends = _settled(known[0], float(terms["equilibrium"] / problem.constant[:, 0].min()))
    return terms | {
        "inflation": grown,
        "equilibrium_interval": ends if problem.first == 1 else None,
        "intervals": tuple(known[1:]),
    }


def _settled(known: Interval, share: float) -> Interval:
    """Mark the equilibrium modulus as undetermined if below ``_PERMANENT`` of the modulus at the slow end."""
    if share >= _PERMANENT:
        return known
    why = f"only {share:.0%} of the modulus at the slow end of the data is permanent: it is still falling there"
    return replace(known, low=0.0, unknown=known.unknown or why)
