"""Time-temperature superposition: shift factors with their errors, the master curve, WLF and Arrhenius.

Convention, Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 11: at the reference temperature a modulus at the
frequency a_T omega, or the time t / a_T, is b_T times what it is at T and omega, or t. So log10 a_T is positive below
the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from scipy.optimize import least_squares

from torchsoro.rheology.alignment import FLOOR, SAME, Alignment, abscissa, channels_of, roughness, window
from torchsoro.rheology.measured import Creep, Relaxation, Sweep
from torchsoro.rheology.overlap import Overlap, distance
from torchsoro.rheology.readers import load

C = TypeVar("C", Sweep, Relaxation, Creep)
GAS_CONSTANT = 8.31446261815324  # [J/(mol K)]
KELVIN = 273.15


@dataclass(frozen=True, kw_only=True, eq=False)
class Shift:
    """Shift factors, the coldest first.

    Attributes:
        temperatures: [T] deg C, not decreasing.
        log_a: log10 a_T [T] decades, 0 at the reference, positive below it.
        reference: Reference temperature [deg C].
        log_a_error: Standard error of the difference to the reference [T]; zeros if unknown.
        log_b: log10 b_T [T] decades: what log10 of a modulus gains, and that of a compliance loses; zeros if None.
        log_b_error: Its standard error [T].
        covariance: Of log_a [T, T]; the squares of ``log_a_error`` on the diagonal if None.
        overlap: Each pair of neighbours.
        noise: Noise of each modulus (storage and loss, or the one there is) [decades].
        misfit: By how much the curves of each modulus are no pieces of one curve, as standard deviation [decades].

    Raises:
        ValueError: if the numbers are not finite, their counts differ, or the temperatures decrease.
    """

    temperatures: np.ndarray
    log_a: np.ndarray
    reference: float
    log_a_error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    log_b: np.ndarray = field(default_factory=lambda: np.zeros(0))
    log_b_error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    covariance: np.ndarray | None = None
    overlap: tuple[Overlap, ...] = ()
    noise: tuple[float, ...] = ()
    misfit: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the numbers and fill in zeros."""
        count = len(self.temperatures)
        for name in ("temperatures", "log_a", "log_a_error", "log_b", "log_b_error"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if not len(values) and name not in ("temperatures", "log_a"):
                values = np.zeros(count)
            if values.shape != (count,) or not np.isfinite(values).all():
                raise ValueError(f"{name} = {values}: wanted {count} finite numbers, one for each temperature")
            object.__setattr__(self, name, values)
        if count < 1 or (np.diff(self.temperatures) < 0).any():
            raise ValueError(f"temperatures = {self.temperatures}: wanted at least one, not decreasing")
        if not np.isfinite(self.reference):
            raise ValueError(f"reference = {self.reference}: wanted finite, in deg C")
        if self.covariance is None:
            object.__setattr__(self, "covariance", np.diag(self.log_a_error**2))
        elif self.covariance.shape != (count, count):
            raise ValueError(f"covariance: shape {self.covariance.shape}, wanted {(count, count)}")

    @property
    def determines_wlf(self) -> bool:
        """Whether there are temperatures for the two constants of WLF: three beside the reference."""
        return int((np.abs(self.temperatures - self.reference) > 1e-9).sum()) > 2


def read_shift(
    path: str | Path,
    *,
    reference: float | None = None,
    columns: Mapping[str, str | int] | None = None,
    units: Mapping[str, str] | None = None,
    sheet: str | None = None,
) -> Shift:
    """Read a list of shift factors, with columns such as ``T`` and ``log_aT`` and the unit of temperature.

    Args:
        path: File, as of :func:`torchsoro.rheology.measured.read`.
        reference: deg C; where log10 a_T crosses 0 if None.
        columns: Column of "temperature" or "log_a", where the header does not say.
        units: Unit of "temperature", before what the file says.
        sheet: Sheet of a workbook.

    Raises:
        ValueError: for what is missing, or a list that does not cross 0 and no reference.
        FileNotFoundError: if there is no such file.
        ModuleNotFoundError: for a workbook, without the package that reads it.
    """
    table = load(Path(path), columns or {}, units or {}, sheet)
    missing = {"temperature", "log_a"} - set(table.columns)
    if missing:
        raise ValueError(f"{path}, line {table.header}: no {min(missing)} among {table.names}; wanted T and log_aT")
    temperatures, log_a = table.numbers("temperature"), table.numbers("log_a")
    order = np.argsort(temperatures, kind="stable")
    temperatures, log_a = temperatures[order], log_a[order]
    if reference is None:
        if not log_a.min() <= 0 <= log_a.max():
            raise ValueError(f"{path}: log_a from {log_a.min()} to {log_a.max()}, wanted across 0, or a reference")
        falling = np.argsort(-log_a, kind="stable")
        reference = float(np.interp(0.0, -log_a[falling], temperatures[falling]))
    return Shift(temperatures=temperatures, log_a=log_a, reference=reference)


def superpose(
    curves: Sequence[C],
    *,
    reference: float,
    vertical: bool = False,
    moduli: Literal["both", "storage", "loss"] = "both",
    misfit: float | None = None,
    progress: Callable[[float], object] | None = None,
) -> Shift:
    """Find the shifts under which isothermal curves are most likely pieces of one smooth curve.

    All shifts are found together, see :mod:`torchsoro.rheology.alignment`; a first guess comes from pair after pair.
    log10 a_T may not grow with temperature, and neighbours may leave a gap of half a decade at most. Errors grow from
    the reference outwards, and are larger where curves are flat, overlap little or do not superpose; a step that the
    data do not tell has an error of some decade. Storage and loss count by their noise and misfit, which are estimated
    from the data's own roughness and from how well they superpose.

    Args:
        curves: Sweeps, relaxation or creep tests in any order, at least two, of at least three points each.
        reference: deg C, within the measured temperatures; between two of them the shift is interpolated.
        vertical: Find vertical shifts too, the same for storage and loss.
        moduli: Which of a sweep's moduli to use. The loss modulus of a stiff specimen often holds the instrument's.
        misfit: By how much a curve may depart from the master curve, as standard deviation [decades]: estimated if
            None. With 0 whatever differs is shift, as in a superposition by eye: more definite, and wrong where curves
            are flat and their heights are not comparable.
        progress: Is called with the share of the work done since its last call; the shares add up to 1.

    Raises:
        ValueError: naming the argument or the curve, the value seen and the value wanted.
    """
    ordered = _ordered(curves)
    temperatures = np.array([curve.temperature for curve in ordered])
    weights = _interpolation(temperatures, reference)
    if misfit is not None and not 0 <= misfit < 0.3:
        raise ValueError(f"misfit = {misfit}: wanted 0 to below 0.3 decades, or None")
    channels = [roughness(channel) for channel in channels_of(ordered, moduli)]
    windows = [window(channels, temperatures, i) for i in range(len(ordered) - 1)]
    sign = -1.0 if isinstance(ordered[0], Creep) else 1.0
    search = Alignment(channels=channels, windows=windows, vertical=vertical, misfit=misfit, sign=sign)
    found = search.solve(progress or (lambda share: None))
    m = len(windows)
    shifts = search.sums - weights @ search.sums  # of steps, relative to the reference
    log_a, of_a = shifts @ found.steps[:m], shifts @ found.covariance[:m, :m] @ shifts.T
    log_b, of_b = np.zeros(m + 1), np.zeros((m + 1, m + 1))
    if vertical:
        log_b, of_b = shifts @ found.steps[m:], shifts @ found.covariance[m:, m:] @ shifts.T
    noise = np.hypot(found.hypers[:, 0], FLOOR)
    shifted = [(c.x + log_a[c.curve], c.y + sign * log_b[c.curve], c.curve) for c in channels]
    overlaps = []
    for i, error in enumerate(np.sqrt(np.diag(found.covariance))[:m]):
        common, mismatch, quality = distance(shifted, noise, i)
        ends = {"cold": float(temperatures[i]), "hot": float(temperatures[i + 1])}
        step = {"step": float(found.steps[i]), "step_error": float(error)}
        overlaps.append(Overlap(**ends, **step, common=common, mismatch=mismatch, quality=quality))
    return Shift(
        temperatures=temperatures,
        log_a=log_a,
        reference=float(reference),
        log_a_error=np.sqrt(np.diag(of_a)),
        log_b=log_b,
        log_b_error=np.sqrt(np.diag(of_b)),
        covariance=of_a,
        overlap=tuple(overlaps),
        noise=tuple(noise.tolist()),
        misfit=tuple(found.hypers[:, 2].tolist()) if misfit is None else (float(misfit),) * len(channels),
    )


def master(curves: Sequence[C], shift: Shift) -> C:
    """The curves' points as one curve at the shift's reference.

    Args:
        curves: As given to :func:`superpose`.
        shift: From there, or published, with one temperature for each curve.

    Returns:
        A curve of the same kind; where points of several curves fall on one frequency or time, their mean.

    Raises:
        ValueError: if the temperatures of curves and shift differ by more than 1 K.
    """
    ordered = _ordered(curves, least=1)
    temperatures = np.array([curve.temperature for curve in ordered])
    if len(temperatures) != len(shift.temperatures) or np.abs(temperatures - shift.temperatures).max() > SAME:
        raise ValueError(f"shift: temperatures {shift.temperatures}, wanted those of the curves, {temperatures}")
    kind = type(ordered[0])
    sign = -1.0 if kind is Creep else 1.0
    frequency = np.concatenate([10 ** (abscissa(curve) + a) for curve, a in zip(ordered, shift.log_a, strict=True)])
    axis, place = np.unique(frequency if kind is Sweep else 1 / frequency, return_inverse=True)
    values = {}
    for name in kind.ordinates:
        parts = [getattr(curve, name) * 10 ** (sign * b) for curve, b in zip(ordered, shift.log_b, strict=True)]
        values[name] = np.bincount(place, np.concatenate(parts)) / np.bincount(place)
    return kind(**{kind.axis: axis}, **values, temperature=shift.reference, deformation=ordered[0].deformation)


@dataclass(frozen=True, kw_only=True)
class Wlf:
    """log10 a_T = -C1 (T - Tr) / (C2 + T - Tr), Williams, Landel and Ferry, J. Am. Chem. Soc. 77 (1955) 3701.

    Attributes:
        C1: Decades.
        C2: [K].
        reference: Tr [deg C].
        C1_error: Standard error [decades].
        C2_error: Standard error [K].
        correlation: Of the two errors.
        residual: Root mean square of measured less fitted shifts [decades].
        quality: Root of chi squared over the degrees of freedom: about 1 if the law holds within the errors of the
            shifts; nan if those are unknown. Above 1 the errors of C1 and C2 are already larger by it.
    """

    C1: float
    C2: float
    reference: float
    C1_error: float = 0.0
    C2_error: float = 0.0
    correlation: float = 0.0
    residual: float = 0.0
    quality: float = float("nan")

    def log_a(self, temperature: np.ndarray | float) -> np.ndarray:
        """log10 a_T at temperatures [deg C].

        Raises:
            ValueError: at or below Tr - C2, where the law has no meaning.
        """
        above = np.asarray(temperature, dtype=np.float64) - self.reference
        if (above <= -self.C2).any():
            raise ValueError(f"temperature = {temperature}: wanted above {self.reference - self.C2:.4g} deg C, Tr - C2")
        return -self.C1 * above / (self.C2 + above)

    def at(self, reference: float) -> Wlf:
        """The same law with another reference [deg C]: C2' = C2 + Tr' - Tr, C1' = C1 C2 / C2'.

        Raises:
            ValueError: at or below Tr - C2.
        """
        new = self.C2 + reference - self.reference
        if not new > 0:
            raise ValueError(f"reference = {reference}: wanted above {self.reference - self.C2:.4g} deg C, Tr - C2")
        first = self.C1 * self.C2 / new
        jacobian = np.array([[self.C2 / new, self.C1 / new - first / new], [0.0, 1.0]])
        both = self.correlation * self.C1_error * self.C2_error
        covariance = jacobian @ [[self.C1_error**2, both], [both, self.C2_error**2]] @ jacobian.T
        return replace(self, C1=first, C2=new, reference=float(reference), **_errors(covariance))


@dataclass(frozen=True, kw_only=True)
class Arrhenius:
    """log10 a_T = E / (R ln 10) (1 / T - 1 / Tr), temperatures in K.

    Attributes:
        activation_energy: E [J/mol].
        reference: Tr [deg C].
        activation_energy_error: Standard error [J/mol].
        residual: Root mean square of measured less fitted shifts [decades].
        quality: As of :class:`Wlf`.
    """

    activation_energy: float
    reference: float
    activation_energy_error: float = 0.0
    residual: float = 0.0
    quality: float = float("nan")

    def log_a(self, temperature: np.ndarray | float) -> np.ndarray:
        """log10 a_T at temperatures [deg C]."""
        inverse = 1 / (np.asarray(temperature, dtype=np.float64) + KELVIN) - 1 / (self.reference + KELVIN)
        return self.activation_energy / (GAS_CONSTANT * np.log(10)) * inverse


def wlf(shift: Shift) -> Wlf:
    """Fit the WLF law to shifts, by their covariance; with equal weights if their errors are unknown.

    Raises:
        ValueError: for less than three temperatures, apart from the reference, or shifts that do not fall with
            temperature.
    """
    T, reference = shift.temperatures, shift.reference
    whiten = _whitening(shift, 2)
    if np.polyfit(T, shift.log_a, 1)[0] >= 0:
        raise ValueError(f"log_a = {shift.log_a}: wanted falling with temperature")
    low = float(min(T.min(), reference))
    # B / (T - V) + constant, V = Tr - C2 the pole below all temperatures, B = C1 C2; both positive by their logarithms.

    def model(p: np.ndarray) -> np.ndarray:
        pole = low - np.exp(p[1])
        return np.exp(p[0]) * (1 / (T - pole) - 1 / (reference - pole))

    best = None
    for below in (10.0, 50.0, 250.0):
        p = np.array([0.0, np.log(below)])
        shape = model(p)
        p[0] = np.log(max(shape @ shift.log_a / (shape @ shape), 1e-3))
        bounds = ([-np.inf, np.log(0.1)], [np.inf, np.log(1e5)])
        found = least_squares(lambda p: whiten @ (model(p) - shift.log_a), p, bounds=bounds, x_scale="jac")
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    slope = float(np.exp(best.x[1]))  # C2 = Tr - low + exp(p1), C1 = exp(p0) / C2
    c2 = reference - low + slope
    c1 = float(np.exp(best.x[0])) / c2
    jacobian = np.array([[c1, -c1 / c2 * slope], [0.0, slope]])
    scale, quality = _scale(best.fun, 2, shift)
    covariance = scale * jacobian @ np.linalg.pinv(best.jac.T @ best.jac) @ jacobian.T
    residual = float(np.sqrt(np.mean((model(best.x) - shift.log_a) ** 2)))
    return Wlf(C1=c1, C2=c2, reference=reference, residual=residual, quality=quality, **_errors(covariance))


def arrhenius(shift: Shift) -> Arrhenius:
    """Fit the Arrhenius law to shifts, weighted as in :func:`wlf`.

    Raises:
        ValueError: for less than two temperatures, apart from the reference.
    """
    whiten = _whitening(shift, 1)
    unit = Arrhenius(activation_energy=1.0, reference=shift.reference).log_a(shift.temperatures)
    column, value = whiten @ unit, whiten @ shift.log_a
    energy = float(column @ value / (column @ column))
    scale, quality = _scale(energy * column - value, 1, shift)
    return Arrhenius(
        activation_energy=energy,
        reference=shift.reference,
        activation_energy_error=float(np.sqrt(scale / (column @ column))),
        residual=float(np.sqrt(np.mean((energy * unit - shift.log_a) ** 2))),
        quality=quality,
    )


def _whitening(shift: Shift, parameters: int) -> np.ndarray:
    """What makes the errors of the shifts independent and equal: V / s of their covariance V^T s^2 V [k, T]."""
    covariance = np.asarray(shift.covariance)
    away = np.abs(shift.temperatures - shift.reference) > 1e-9
    if away.sum() <= parameters:
        raise ValueError(f"temperatures = {shift.temperatures}: wanted over {parameters}, apart from the reference")
    if not covariance.any():
        return np.eye(len(away))
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-10 * values.max()  # the reference itself is known
    return vectors[:, keep].T / np.sqrt(values[keep])[:, None]


def _scale(residuals: np.ndarray, parameters: int, shift: Shift) -> tuple[float, float]:
    """By what the covariance of a fit is to be multiplied, and the quality of the fit."""
    away = np.abs(shift.temperatures - shift.reference) > 1e-9
    reduced = float(residuals @ residuals) / (int(away.sum()) - parameters)
    return (max(1.0, reduced), float(np.sqrt(reduced))) if np.asarray(shift.covariance).any() else (reduced, np.nan)


def _errors(covariance: np.ndarray) -> dict[str, float]:
    """Standard errors and correlation of C1 and C2."""
    first, second = np.sqrt(np.diag(covariance)).tolist()
    correlation = float(covariance[0, 1]) / (first * second) if first * second > 0 else 0.0
    return {"C1_error": first, "C2_error": second, "correlation": correlation}


def _ordered(curves: Sequence[C], least: int = 2) -> list[C]:
    """The curves, checked, the coldest first."""
    if len(curves) < least:
        raise ValueError(f"curves: {len(curves)}, wanted at least {least}")
    kinds = {(type(curve).__name__, curve.deformation) for curve in curves}
    if len(kinds) > 1:
        raise ValueError(f"curves: {sorted(kinds)}, wanted all of one kind and deformation")
    for i, curve in enumerate(curves):
        if not np.isfinite(curve.temperature):
            raise ValueError(f"curves[{i}]: temperature {curve.temperature}, wanted finite")
    return sorted(curves, key=lambda curve: curve.temperature)


def _interpolation(temperatures: np.ndarray, reference: float) -> np.ndarray:
    """Weights [T] with which the shifts at the temperatures make that at the reference: cubic in 1 / T at most."""
    if not temperatures[0] - 1e-6 <= reference <= temperatures[-1] + 1e-6:
        raise ValueError(
            f"reference = {reference}: wanted from {temperatures[0]:.4g} to {temperatures[-1]:.4g} deg C, which is "
            "measured; convert with wlf(shift).at(reference) for another"
        )
    place = np.cumsum(np.diff(temperatures, prepend=temperatures[0]) > SAME / 2)  # repeated temperatures are one
    counts = np.bincount(place)
    nodes = 1 / (np.bincount(place, temperatures) / counts + KELVIN)
    at = 1 / (reference + KELVIN)
    above = int(np.clip(np.searchsorted(-nodes, -at), 1, max(len(nodes) - 1, 1)))
    used = np.arange(max(above - 2, 0), min(above + 2, len(nodes)))
    share = np.zeros(len(nodes))
    for k in used:
        others = nodes[used[used != k]]
        share[k] = np.prod((at - others) / (nodes[k] - others))
    return share[place] / counts[place]
