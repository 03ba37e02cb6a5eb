"""Selection of Maxwell elements for a time step: stability, cost, and error of storage and loss modulus.

Elements are numbered from the slowest, as in Table S1 of the paper. A fast element reduces the stable step. With the
exact-exponential update, the effective modulus of an element at the highest resolved frequency is
g 2 b / (1 + a) instead of g (see :meth:`torchsoro.simulation.material.Prony.step_moduli`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from torchsoro.rheology.leastsquares import Problem, free
from torchsoro.rheology.measured import Sweep
from torchsoro.rheology.residuals import relative_residuals
from torchsoro.rheology.spectrum import Spectrum
from torchsoro.rheology.stability import courant_number, felt_share, largest_step, moduli_over
from torchsoro.simulation.formulation import FormulationName
from torchsoro.simulation.material import Prony, Solid
from torchsoro.simulation.stability import STABLE_COURANT

MOST = 5  # largest number of elements in the simulator
_POINTS = 40  # frequencies per decade at which errors over the band are evaluated


@dataclass(frozen=True, kw_only=True)
class Element:
    """Series of Maxwell elements up to and including one; number 0 is the equilibrium spring alone.

    Attributes:
        number: Number of the fastest element of the series, counted from the slowest, as in Table S1.
        time: Relaxation time of that element [s].
        modulus: Its modulus over the equilibrium modulus.
        felt: Its effective modulus for an oscillation that changes sign at every step, g 2 b / (1 + a).
        courant: Courant number of the step with this element and all slower ones.
        stable: Whether ``courant`` is at most ``torchsoro.simulation.stability.STABLE_COURANT``.
        step: Largest stable step with this element and all slower ones [s].
        cost: Number of steps at ``step`` over that at the given step; 1 or less if stable.
        storage_lost: Largest relative loss of storage modulus over the band without this and all faster elements.
        loss_lost: Largest relative loss of loss modulus, likewise.
    """

    number: int
    time: float
    modulus: float
    felt: float
    courant: float
    stable: bool
    step: float
    cost: float
    storage_lost: float
    loss_lost: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """Reduced Prony series for the simulator, which replaces a longer or stiffer one.

    Attributes:
        name: Method of reduction.
        moduli: Moduli over the equilibrium modulus [M], the slowest element first.
        times: Relaxation times [M] s.
        viscosity: Additional shear viscosity [Pa s], for ``Body.viscosity``.
        step: Largest stable step [s].
        storage_error: Largest relative difference of the storage modulus from the full series over the band.
        loss_error: The same of the loss modulus.
        good: Lowest and highest angular frequency [rad/s] of the interval around the centre of the band in which both
            moduli are within 10 %; 0 and inf where no end lies within a factor of 1e6 of the band.
        sentence: Summary of these numbers.
    """

    name: str
    moduli: np.ndarray
    times: np.ndarray
    viscosity: float
    step: float
    storage_error: float
    loss_error: float
    good: tuple[float, float]
    sentence: str

    def prony(self) -> Prony:
        """Prony series for the simulator, without the viscosity.

        Raises:
            ValueError: for more than five elements.
        """
        return Prony(moduli=torch.from_numpy(self.moduli.copy()), times=torch.from_numpy(self.times.copy()))

    def row(self) -> dict[str, float | str]:
        """Row of a table: name, stable step, errors and valid frequencies."""
        return {
            "material": self.name,
            "elements": len(self.moduli),
            "viscosity [Pa s]": self.viscosity,
            "largest step [us]": self.step * 1e6,
            "storage off by [%]": 100 * self.storage_error,
            "loss off by [%]": 100 * self.loss_error,
            "within 10 % from [rad/s]": self.good[0],
            "to [rad/s]": self.good[1],
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Budget:
    """Stability and error of each Maxwell element at a given time step.

    Attributes:
        dt: Time step [s].
        cell: Edge of a grid cell [m].
        formulation: FormulationName of the simulator.
        band: Lowest and highest angular frequency of the robot's motion [rad/s].
        solid: Equilibrium solid.
        elements: The equilibrium spring, then the elements from the slowest.
        sentence: Unstable elements, their cost, and the error without them, in words.
    """

    dt: float
    cell: float
    formulation: FormulationName
    band: tuple[float, float]
    solid: Solid
    elements: tuple[Element, ...]
    sentence: str

    @property
    def stable(self) -> int:
        """Number of elements, counted from the slowest, that are stable at the step."""
        return sum(e.stable for e in self.elements[1:])

    @property
    def moduli(self) -> np.ndarray:
        """Moduli of all elements over the equilibrium modulus [M], the slowest first."""
        return np.array([e.modulus for e in self.elements[1:]])

    @property
    def times(self) -> np.ndarray:
        """Relaxation times of all elements [M] s, the slowest first."""
        return np.array([e.time for e in self.elements[1:]])

    def rows(self) -> list[dict[str, float | str]]:
        """One row for each element."""
        return [
            {
                "element": e.number,
                "time [s]": e.time,
                "g / g_inf": e.modulus,
                "felt": e.felt,
                "Courant": e.courant,
                "stable": "yes" if e.stable else "no",
                "largest step [us]": e.step * 1e6,
                "steps": e.cost,
                "storage lost without [%]": 100 * e.storage_lost,
                "loss lost without [%]": 100 * e.loss_lost,
            }
            for e in self.elements
        ]


def budget(
    material: Spectrum | Prony,
    solid: Solid,
    *,
    cell: float,
    band: tuple[float, float],
    dt: float | Literal["auto"] = "auto",
    formulation: FormulationName = "updated",
) -> Budget:
    """Evaluate stability, cost and modulus error of each Maxwell element at a time step.

    Only the solid is considered; chambers may need a smaller step (see ``torchsoro.simulation.stability.courant``).

    Args:
        material: Prony series of any number of elements.
        solid: Equilibrium solid, as from ``Spectrum.solid``.
        cell: Edge of a grid cell [m].
        band: Lowest and highest angular frequency of the robot's motion [rad/s].
        dt: Time step [s]; "auto" for the largest stable one with all elements.
        formulation: FormulationName of the simulator.

    Raises:
        ValueError: for a spectrum without equilibrium modulus, a batch of materials, or numbers outside their range.
    """
    moduli, times = _series(material)
    omega = _omega(band)
    _positive("cell", cell)
    steps = [
        largest_step(solid, moduli[:k], times[:k], cell=cell, formulation=formulation) for k in range(len(moduli) + 1)
    ]
    if dt == "auto":
        dt = steps[-1]
    _positive("dt", dt)
    felt = moduli * felt_share(times, dt)
    full = moduli_over(moduli, times, omega)
    rows = []
    for k, step in enumerate(steps):
        number = courant_number(solid, float(felt[:k].sum()), dt=dt, cell=cell, formulation=formulation)
        kept = slice(k - 1 if k else len(moduli))
        lost = 1 - _over(moduli_over(moduli[kept], times[kept], omega), full)
        rows.append(
            Element(
                number=k,
                time=times[k - 1] if k else math.inf,
                modulus=moduli[k - 1] if k else 1.0,
                felt=felt[k - 1] if k else 1.0,
                courant=number,
                stable=number <= STABLE_COURANT,
                step=step,
                cost=dt / step,
                storage_lost=float(lost[0].max()),
                loss_lost=float(lost[1].max()),
            )
        )
    return Budget(
        dt=dt,
        cell=cell,
        formulation=formulation,
        band=band,
        solid=solid,
        elements=tuple(rows),
        sentence=_sentence(rows, dt, cell, band),
    )


def substitutes(budget: Budget, *, match: float) -> list[Material]:
    """Reduced series that replace the elements unstable at the step, with the error of each.

    - "all elements": the full series at its own, smaller step.
    - "left out": the stable elements alone, as in the paper.
    - "lumped": the stable elements, the modulus of the fastest of them increased so that the loss modulus at ``match``
      equals that of the full series; omitted if no element is stable.
    - "viscosity": the stable elements and a Newtonian viscosity that restores the loss modulus at ``match``.
    - "refitted": as many elements as the series has, at most five, by :func:`choose`.

    Args:
        budget: As from :func:`budget`.
        match: Angular frequency at which the loss modulus is matched [rad/s].

    Returns:
        The materials. For a stable series only "all elements", and "refitted" if it has more than five elements.

    Raises:
        ValueError: if ``match`` is not positive.
    """
    _positive("match", match)
    moduli, times, n = budget.moduli, budget.times, budget.stable
    found = [_material("all elements", budget, moduli, times)]
    if n == len(moduli):
        return found if n <= MOST else [*found, choose(budget)]
    left = float((moduli[n:] * match * times[n:] / (1 + (match * times[n:]) ** 2)).sum())
    found.append(_material("left out", budget, moduli[:n], times[:n]))
    if n:
        wt = match * times[n - 1]
        lumped = moduli[:n].copy()
        lumped[-1] += left * (1 + wt * wt) / wt
        found.append(_material(f"lumped into element {n}", budget, lumped, times[:n]))
    found.append(
        _material("viscosity", budget, moduli[:n], times[:n], viscosity=float(budget.solid.shear) * left / match)
    )
    return [*found, choose(budget, elements=min(len(moduli), MOST))]


def choose(budget: Budget, *, elements: int = MOST) -> Material:
    """Refit few elements, stable at the step of the budget, with the least relative error over its band.

    The equilibrium modulus is kept. Relaxation times and moduli are fitted to storage and loss modulus of the full
    series over the band (Eq. 17c); if the result is unstable, with the stiffness constrained to the stability limit.

    Args:
        budget: As from :func:`budget`.
        elements: Largest number of elements, 1 to 5.

    Raises:
        ValueError: if ``elements`` is not 1 to 5, or the step is not stable with the equilibrium spring alone.
    """
    if elements not in range(1, MOST + 1):
        raise ValueError(f"elements = {elements}: wanted 1 to {MOST}")
    if not budget.elements[0].stable:
        step = budget.elements[0].step
        raise ValueError(f"dt = {budget.dt:.3g} s: wanted at most {step:.3g} s, without any element")
    if len(budget.moduli) <= elements and budget.stable == len(budget.moduli):
        return _material("refitted", budget, budget.moduli, budget.times)
    omega = _omega(budget.band)
    storage, loss = moduli_over(budget.moduli, budget.times, omega)
    sweep = Sweep(omega=omega, storage=storage, loss=loss, temperature=math.nan, deformation="shear")
    # An element a hundred times faster or slower than the band is equivalent to a dashpot or a spring.
    shortest = max(budget.times.min(), 1e-2 / budget.band[1])
    longest = max(min(budget.times.max(), 1e2 / budget.band[0]), 10 * shortest)
    problem = relative_residuals(sweep, 1.0, (shortest, longest))
    best = _refitted(budget, problem, elements)
    return best if best.step >= budget.dt else _refitted(budget, _as_stiff_as_can_be(budget, problem), elements)


def _refitted(budget: Budget, problem: Problem, elements: int) -> Material:
    found = free(problem, elements)[-1]
    used = found.values[::-1] > 0
    return _material("refitted", budget, found.values[::-1][used], found.times[::-1][used])


def _as_stiff_as_can_be(budget: Budget, problem: Problem) -> Problem:
    """The problem with one more residual of large weight, which sets the effective stiffness to the stability limit."""
    low, high = 0.0, 1e12
    at = {"dt": budget.dt, "cell": budget.cell, "formulation": budget.formulation}
    while high - low > 1e-6 * high:
        middle = (low + high) / 2
        ok = courant_number(budget.solid, middle, **at) <= STABLE_COURANT
        low, high = (middle, high) if ok else (low, middle)
    weight = 1e4 / low

    def columns(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = problem.columns(times)
        felt = felt_share(times, budget.dt)
        change = felt - np.cosh(np.minimum(budget.dt / (2 * times), 300)) ** -2  # derivative by ln(tau)
        return np.vstack([value, weight * felt]), np.vstack([slope, weight * change])

    return replace(problem, columns=columns, target=np.append(problem.target, weight * low * (1 - 1e-4)))


# ------------------------------------------------------------------------------------------------------------- numbers
def _series(material: Spectrum | Prony) -> tuple[np.ndarray, np.ndarray]:
    """Moduli over the equilibrium modulus, and relaxation times [s], the slowest first."""
    if isinstance(material, Spectrum):
        moduli, times = material.relative(), material.times
    else:
        moduli, times = (np.asarray(t.detach().cpu(), dtype=float) for t in (material.moduli, material.times))
        if moduli.ndim != 1:
            raise ValueError(f"material: moduli of shape {moduli.shape}, wanted one material [M]")
    order = np.argsort(-times, kind="stable")
    return moduli[order], times[order]


def _omega(band: tuple[float, float]) -> np.ndarray:
    if not 0 < band[0] < band[1] < math.inf:
        raise ValueError(f"band = {band}: wanted a lower and a higher angular frequency in rad/s")
    return np.geomspace(*band, max(2, math.ceil(_POINTS * math.log10(band[1] / band[0]))))


def _over(moduli: np.ndarray, full: np.ndarray) -> np.ndarray:
    """Ratio to the moduli of the full series; 1 where both are zero, as for the loss modulus without elements."""
    return np.divide(moduli, full, out=np.where(moduli > 0, np.inf, 1.0), where=full > 0)


def _material(name: str, budget: Budget, moduli: np.ndarray, times: np.ndarray, viscosity: float = 0.0) -> Material:
    low, high = budget.band
    below, above = _omega((1e-6 * low, low)), _omega((high, 1e6 * high))
    omega = np.concatenate([below[:-1], _omega(budget.band), above[1:]])
    full = moduli_over(budget.moduli, budget.times, omega)
    here = moduli_over(moduli, times, omega, viscosity / float(budget.solid.shear))
    off = np.abs(_over(here, full) - 1)
    storage, loss = (float(v) for v in off[:, (omega >= low) & (omega <= high)].max(axis=1))
    bad, middle = omega[(off > 0.1).any(axis=0)], math.sqrt(low * high)
    good = float(bad[bad <= middle].max(initial=0.0)), float(bad[bad >= middle].min(initial=math.inf))
    at = {"cell": budget.cell, "formulation": budget.formulation, "viscosity": viscosity}
    step = largest_step(budget.solid, moduli, times, **at)
    total = len(budget.moduli)
    words = f"{name}: {len(moduli)} element{'s' * (len(moduli) != 1)}" + f" and {viscosity:.3g} Pa s" * (viscosity > 0)
    words += f" in place of {total}" * (len(moduli) != total)
    words += f", more than the simulator's {MOST}" * (len(moduli) > MOST)
    words += f"; stable up to {1e6 * step:.3g} us"
    if step < budget.dt:
        words += f", {budget.dt / step:.3g} times as many steps as at {1e6 * budget.dt:.3g} us"
    words += f"; storage modulus off by at most {100 * storage:.2g} %, loss modulus by {100 * loss:.2g} %,"
    words += f" from {low:.3g} to {high:.3g} rad/s"
    if len(bad):
        words += f"; both within 10 % from {good[0]:.3g} to {good[1]:.3g} rad/s"
    return Material(
        name=name,
        moduli=moduli,
        times=times,
        viscosity=viscosity,
        step=step,
        storage_error=storage,
        loss_error=loss,
        good=good,
        sentence=words + ".",
    )


def _sentence(rows: Sequence[Element], dt: float, cell: float, band: tuple[float, float]) -> str:
    at = f"At a step of {1e6 * dt:.3g} us and cells of {1e3 * cell:.3g} mm"
    bad = [e for e in rows if not e.stable]
    if not bad:
        long = f" The simulator takes {MOST} of them: see choose." * (len(rows) - 1 > MOST)
        return f"{at} the body is stable with all {len(rows) - 1} elements: nothing is left out.{long}"
    if not rows[0].stable:
        return f"{at} even the equilibrium spring is not stable: it needs {1e6 * rows[0].step:.3g} us or less."
    first, last = bad[0], bad[-1]
    which = f"elements {first.number} to {last.number}" if len(bad) > 1 else f"element {first.number}"
    spans = " to ".join(dict.fromkeys(f"{1e6 * e.time:.3g} us" for e in (first, last)))
    return (
        f"{at} the body is not stable with {which} (relaxation times {spans}). With all elements the step is "
        f"{1e6 * last.step:.3g} us, {last.cost:.2g} times as many steps. Without {which} up to "
        f"{100 * first.storage_lost:.2g} % of the storage and {100 * first.loss_lost:.2g} % of the loss modulus are "
        f"lost from {band[0]:.3g} to {band[1]:.3g} rad/s."
    )


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} = {value}: wanted finite and positive")
