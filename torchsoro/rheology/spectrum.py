"""Discrete relaxation spectra: moduli and relaxation times fitted to measurements, and how well the data know each.

A generalised Maxwell solid has the storage and loss modulus

    E'(w) = E_inf + sum_i E_i (w tau_i)^2 / (1 + (w tau_i)^2),    E''(w) = sum_i E_i w tau_i / (1 + (w tau_i)^2)

(Eqs. 17a, 17b) and relaxes as E(t) = E_inf + sum_i E_i exp(-t / tau_i), with no modulus negative. The same holds for a
shear modulus G.
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
PENALTIES = (0.0, 1e-2, 1e-1, 1.0, 10.0)  # tried where regularization = "auto"
# Free times may lie these factors beyond the data, lest terms within take over the part of those without. To a sweep a
# faster term is a dashpot, in time it is nothing; a much slower one would be a spring, like the equilibrium modulus.
_FASTER = {Sweep: 30.0, Relaxation: 3.0, Creep: 3.0}
_SLOWER = 3.0
_PERMANENT = 0.5  # least share of the lowest measured modulus that counts as an equilibrium modulus
_HELD = "with the relaxation times held: one element less fits as well within the correlated residuals"
_EDGE = 1.05  # a relaxation time within this factor of an end of the window lies on it


@dataclass(frozen=True, kw_only=True)
class Interval:
    """What the data say about one modulus.

    Attributes:
        low: Lower end [Pa].
        high: Upper end [Pa], inf if there is none.
        unknown: Why the modulus cannot be known, in words; empty if it can.
        condition: What the interval takes for known that was fitted, in words; empty for nothing.
    """

    low: float
    high: float
    unknown: str = ""
    condition: str = ""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One number of terms that was tried.

    Attributes:
        elements: Number of terms.
        regularization: Weight of the penalty.
        error: Sum of the squared relative residuals; e of Eq. 17c for a sweep.
        parameters: Effective number of parameters.
        bic: n ln(error / n) + parameters ln(n) over the n measured values; the smallest is chosen.
    """

    elements: int
    regularization: float
    error: float
    parameters: float
    bic: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum:
    """Equilibrium modulus and Maxwell terms, absolute, from the fastest to the slowest.

    Attributes:
        equilibrium: E_inf or G_inf [Pa]; after a fit it stands for everything that is slower than the data see.
        moduli: E_i or G_i [M] Pa.
        times: Relaxation times tau_i [M] s, not decreasing.
        deformation: What the moduli resist.
        temperature: [deg C], nan if unknown.
        window: Shortest and longest relaxation time [s] that the data see; None if not fitted.
        equilibrium_interval: Of ``equilibrium``; None if not fitted or held.
        intervals: Of every modulus; empty if not fitted.
        evidence: Every number of terms that was tried; empty if not fitted.
        error: Sum of the squared relative residuals (e of Eq. 17c), nan if not fitted.
        floor: The same for the best spectrum of any number of terms within the window. If it is far above the scatter
            of the data, then storage and loss do not belong to one linear viscoelastic material.
        inflation: How many times the residuals' serial correlation widens a variance; 1 if they are independent.

    Raises:
        ValueError: for shapes that differ, negative or infinite numbers, times that decrease or an unknown deformation.
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
        """Maxwell elements for the simulator, relative to the equilibrium modulus, the slowest first as in Table S1.

        Args:
            equilibrium: Equilibrium modulus [Pa] from elsewhere, in place of the fitted one.

        Raises:
            ValueError: if the equilibrium modulus is zero or not determined by the data, or for more than five terms.
        """
        relative = self.relative(equilibrium=equilibrium)
        if len(relative) > 5:
            raise ValueError(
                f"the spectrum has {len(relative)} terms, the simulator takes at most 5: "
                "choose some with torchsoro.rheology.budget.choose, or fit with elements=5"
            )
        return Prony(moduli=torch.from_numpy(relative[::-1].copy()), times=torch.from_numpy(self.times[::-1].copy()))

    def relative(self, *, equilibrium: float | None = None) -> np.ndarray:
        """Moduli over the equilibrium modulus [M], of any number of terms; arguments and errors as :meth:`prony`."""
        return self.moduli / self._permanent(equilibrium)

    def solid(self, poisson_ratio: float, density: float, *, equilibrium: float | None = None) -> Solid:
        """The simulator's solid, with a Young's modulus of E_inf or 2 (1 + nu) G_inf.

        The relative moduli of tension are used for shear as they are, as the paper does: exact for a constant Poisson
        ratio.

        Args:
            poisson_ratio: nu, 0 to below 0.5.
            density: [kg/m3].
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
        """One row for the equilibrium modulus and each term: time [s], modulus, interval [Pa], and a remark on it."""
        known = (self.equilibrium_interval, *(self.intervals or (None,) * len(self.moduli)))
        values = zip((math.inf, *self.times), (self.equilibrium, *self.moduli), known, strict=True)
        return [
            {"time [s]": float(time), "modulus [Pa]": float(modulus)}
            | ({} if i is None else {"low [Pa]": i.low, "high [Pa]": i.high, "remark": i.unknown or i.condition})
            for time, modulus, i in values
        ]


def error_norm(spectrum: Spectrum, sweep: Sweep) -> float:
    """Error norm e of Eq. 17c: the sum over the points of the squared relative errors of storage and loss modulus.

    Raises:
        ValueError: if one is of tension and the other of shear.
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
    """Fit a spectrum to the relative residuals of storage and loss modulus (Eq. 17c), or of relaxation or creep.

    Moduli are at least zero. The number of terms is that of the best Bayesian information criterion, which takes the
    scatter for independent: on a curve with systematic errors it errs towards more terms, up to what the curve can
    bear at all (``Spectrum.floor``).

    The intervals are profile likelihoods at 95 %: all else is fitted anew at each value of a modulus, relaxation times
    too where they are free, each up to the geometric mean with its neighbours, lest terms exchange places. Where the
    others can still take a term's part, within serially correlated residuals, the interval holds for the relaxation
    times as fitted, and says so. The noise is estimated from the residuals. Serially correlated residuals widen them.
    Times that are given or on the logarithmic grid count as known, and a penalty as true. A modulus cannot be known
    when zero will do, when nothing bounds it from above, and when its time is at or beyond an end of the data's window,
    where the term stands for all that is faster or slower. An equilibrium modulus cannot be known when it is less than
    half of the modulus at the slow end of the data.

    To creep a spectrum of compliances and retardation times is fitted, and turned into that of relaxation. Then
    ``elements``, ``times``, ``window`` and ``evidence`` are of the former, and intervals are Laplace's approximation.

    Args:
        data: Sweep or master curve, relaxation, or creep.
        elements: Number of terms, or "auto".
        times: "free" for optimised relaxation times; "log" for equal spaces in log time over the window, the paper's
            choice; or the times themselves [s].
        equilibrium: Whether there is a permanent modulus; or its value [Pa], which is then held.
        regularization: Weight of the second differences of the moduli, each times the norm of its column of relative
            residuals. Not for free times. "auto" takes the best criterion, with the effective number of parameters.
        window: Shortest and longest relaxation time [s] of free and of equally spaced times. If None, equal spaces fill
            the data's, from one over the highest to one over the lowest frequency, and free times may lie up to 30
            times below it (3 times for relaxation and creep) and 3 times above.
        intervals: Whether to find the intervals, which takes longer than the fit.

    Returns:
        The spectrum with intervals and evidence.

    Raises:
        ValueError: for too few points, for values that are not positive, or arguments outside their range.
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
    """Inflation and the intervals."""
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
            why = f"stands for all that is {side}er than the data see: measure at {more}"
            known.append(Interval(low=0.0, high=math.inf, unknown=why.replace("at for", "for")))
        elif time is not None and low == 0 < fixed_times[0]:
            known.append(Interval(low=fixed_times[0], high=fixed_times[1], condition=_HELD))
        else:
            known.append(Interval(low=low, high=high, unknown="" if low > 0 else "the data agree with zero"))
    if problem.constant is not None:
        known[0] = _settled(known[0], float(best.values[0] * problem.constant.max()))
    return {
        "inflation": grown,
        "equilibrium_interval": known[0] if problem.first else None,
        "intervals": tuple(known[problem.first :]),
    }


def _from_creep(problem: Problem, best: Found, spare: float, optimised: bool, intervals: bool) -> dict[str, Any]:
    """The relaxation spectrum of a retardation spectrum, with Laplace's intervals."""
    grown = inflation(problem, best)
    terms, errors = relaxing(problem, best, optimised=optimised)
    terms = {"equilibrium": float(terms.values[0]), "moduli": terms.values[1:], "times": terms.times}
    if not intervals:
        return terms
    reach = math.sqrt(best.error * grown * float(fisher.ppf(LEVEL, 1, spare)) / spare)
    known = []
    for value, error in zip((terms["equilibrium"], *terms["moduli"].tolist()), errors.tolist(), strict=True):
        factor = math.exp(min(reach * error, 700.0))
        why = "" if factor < 10 else "known to no better than a factor of ten"
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
    """An equilibrium modulus is not known where it is a small share of the modulus at the slow end of the data."""
    if share >= _PERMANENT:
        return known
    why = f"only {share:.0%} of the modulus at the slow end of the data is permanent: it is still falling there"
    return replace(known, low=0.0, unknown=known.unknown or why)
