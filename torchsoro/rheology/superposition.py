"""Time-temperature superposition: shift factors with standard errors, master curve, WLF and Arrhenius laws.

Convention (Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 11): with horizontal shift factor a_T and vertical
shift factor b_T, E(a_T omega, T_ref) = b_T E(omega, T), and E(t / a_T, T_ref) = b_T E(t, T). So log10 a_T is positive
below the reference temperature.
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
    """Horizontal and vertical shift factors, ordered from the coldest to the hottest curve.

    Attributes:
        temperatures: Temperatures [T] deg C, not decreasing.
        log_a: log10 a_T [T] decades; 0 at the reference temperature, positive below it.
        reference: Reference temperature [deg C].
        log_a_error: Standard error of ``log_a`` relative to the reference temperature [T] decades; zeros if unknown.
        log_b: log10 b_T [T] decades, added to log10 of a modulus, subtracted from log10 of a compliance; default zeros.
        log_b_error: Standard error of ``log_b`` [T] decades.
        covariance: Covariance of ``log_a`` [T, T]; diagonal with the squares of ``log_a_error`` if None.
        overlap: Mismatch of each pair of neighbouring curves.
        noise: Noise standard deviation of each modulus (storage and loss, or the single one) [decades].
        misfit: Standard deviation of the discrepancy of a curve from the master curve, for each modulus [decades].

    Raises:
        ValueError: for numbers that are not finite, different lengths, or decreasing temperatures.
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
        """Whether at least three temperatures differ from the reference, which the two WLF constants require."""
        return int((np.abs(self.temperatures - self.reference) > 1e-9).sum()) > 2


def read_shift(
    path: str | Path,
    *,
    reference: float | None = None,
    columns: Mapping[str, str | int] | None = None,
    units: Mapping[str, str] | None = None,
    sheet: str | None = None,
) -> Shift:
    """Read a table of horizontal shift factors, with columns such as ``T`` and ``log_aT`` and the unit of temperature.

    Args:
        path: File, as for :func:`torchsoro.rheology.measured.read`.
        reference: Reference temperature [deg C]; interpolated where log10 a_T crosses 0 if None.
        columns: Column of "temperature" or "log_a", where the header does not name it.
        units: Unit of "temperature"; overrides the file.
        sheet: Sheet of a workbook.

    Raises:
        ValueError: for a missing column, or without ``reference`` for a log10 a_T that does not cross 0.
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
    """Estimate the shift factors that superpose isothermal curves into a smooth master curve.

    All shift factors maximise one likelihood, see :mod:`torchsoro.rheology.alignment`; initial values come from pairs
    of neighbours. log10 a_T does not increase with temperature, and the gap between neighbouring shifted curves is at
    most half a decade. Standard errors grow with the distance from the reference temperature, and where curves are
    flat, overlap little or do not superpose; that of an undetermined step is about a decade. Storage and loss modulus
    are weighted by their noise and discrepancy, which are estimated from the curves.

    Args:
        curves: Frequency sweeps, relaxation or creep tests in any order, at least two, of at least three points each.
        reference: Reference temperature [deg C], within the measured range; shifts are interpolated between curves.
        vertical: Whether vertical shift factors are estimated, common to storage and loss modulus.
        moduli: Moduli of a sweep to be used. For a stiff specimen the measured loss modulus often contains that of the
            instrument.
        misfit: Standard deviation of the discrepancy of a curve from the master curve [decades]; estimated if None.
            With 0 all differences are attributed to shift factors, as in manual superposition: standard errors are
            smaller, and shifts biased where curves are flat and differ by a vertical error.
        progress: Called with the fraction of the work done since the previous call; the fractions add up to 1.

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
    """Master curve at the reference temperature of the shift factors.

    Args:
        curves: As for :func:`superpose`.
        shift: Shift factors, estimated or published, one temperature for each curve.

    Returns:
        A curve of the same kind; points of equal shifted frequency or time are averaged.

    Raises:
        ValueError: if temperatures of ``curves`` and ``shift`` differ by more than 1 K.
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
        C1: First constant [decades].
        C2: Second constant [K].
        reference: Reference temperature Tr [deg C].
        C1_error: Standard error of C1 [decades].
        C2_error: Standard error of C2 [K].
        correlation: Correlation coefficient of the two errors.
        residual: Root mean square of measured minus fitted log10 a_T [decades].
        quality: Square root of chi squared over the degrees of freedom: about 1 if the law holds within the standard
            errors of the shifts; nan if those are unknown. Values above 1 are included in the errors of C1 and C2.
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
            ValueError: at or below Tr - C2, the pole of the law.
        """
        above = np.asarray(temperature, dtype=np.float64) - self.reference
        if (above <= -self.C2).any():
            raise ValueError(f"temperature = {temperature}: wanted above {self.reference - self.C2:.4g} deg C, Tr - C2")
        return -self.C1 * above / (self.C2 + above)

    def at(self, reference: float) -> Wlf:
        """The law at another reference temperature [deg C]: C2' = C2 + Tr' - Tr, C1' = C1 C2 / C2'.

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
        activation_energy: Activation energy E [J/mol].
        reference: Reference temperature Tr [deg C].
        activation_energy_error: Standard error of E [J/mol].
        residual: Root mean square of measured minus fitted log10 a_T [decades].
        quality: As for :class:`Wlf`.
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
    """Fit the WLF law to log10 a_T by generalised least squares; with equal weights if the covariance is unknown.

    Raises:
        ValueError: for fewer than three temperatures besides the reference, or log10 a_T that does not decrease with
            temperature.
    """
    T, reference = shift.temperatures, shift.reference
    whiten = _whitening(shift, 2)
    if np.polyfit(T, shift.log_a, 1)[0] >= 0:
        raise ValueError(f"log_a = {shift.log_a}: wanted falling with temperature")
    low = float(min(T.min(), reference))
    # log10 a_T = B / (T - V) + constant with the pole V = Tr - C2 below all temperatures and B = C1 C2; unknowns are
    # the logarithms of B and of the distance to the pole, which keeps both positive.

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
    """Fit the Arrhenius law to log10 a_T, weighted as in :func:`wlf`.

    Raises:
        ValueError: for fewer than two temperatures besides the reference.
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
    """Whitening matrix of the shifts [k, T]: eigenvectors of their covariance over the standard deviations."""
    covariance = np.asarray(shift.covariance)
    away = np.abs(shift.temperatures - shift.reference) > 1e-9
    if away.sum() <= parameters:
        raise ValueError(f"temperatures = {shift.temperatures}: wanted more than {parameters} besides the reference")
    if not covariance.any():
        return np.eye(len(away))
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-10 * values.max()  # log10 a_T is exactly 0 at the reference
    return vectors[:, keep].T / np.sqrt(values[keep])[:, None]


def _scale(residuals: np.ndarray, parameters: int, shift: Shift) -> tuple[float, float]:
    """Factor of the covariance of a fit, at least 1 if errors are known, and the quality of the fit."""
    away = np.abs(shift.temperatures - shift.reference) > 1e-9
    reduced = float(residuals @ residuals) / (int(away.sum()) - parameters)
    return (max(1.0, reduced), float(np.sqrt(reduced))) if np.asarray(shift.covariance).any() else (reduced, np.nan)


def _errors(covariance: np.ndarray) -> dict[str, float]:
    """Standard errors and correlation of C1 and C2."""
    first, second = np.sqrt(np.diag(covariance)).tolist()
    correlation = float(covariance[0, 1]) / (first * second) if first * second > 0 else 0.0
    return {"C1_error": first, "C2_error": second, "correlation": correlation}


def _ordered(curves: Sequence[C], least: int = 2) -> list[C]:
    """Validated curves, ordered by temperature."""
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
    """Lagrange weights [T] that interpolate shifts to the reference temperature, at most cubic in 1 / T."""
    if not temperatures[0] - 1e-6 <= reference <= temperatures[-1] + 1e-6:
        raise ValueError(
            f"reference = {reference}: wanted from {temperatures[0]:.4g} to {temperatures[-1]:.4g} deg C, the "
            "measured range; convert to a reference outside it with wlf(shift).at(reference)"
        )
    place = np.cumsum(np.diff(temperatures, prepend=temperatures[0]) > SAME / 2)  # repeated temperatures share a node
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
