"""Figures of shifted curves, of a relaxation spectrum, and of the reduced Prony series for the simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchsoro.rheology.budget import Budget, Material
from torchsoro.rheology.measured import Creep, Relaxation, Sweep
from torchsoro.rheology.spectrum import Spectrum
from torchsoro.rheology.stability import moduli_over
from torchsoro.rheology.superposition import Shift, wlf

Curve = Sweep | Relaxation | Creep


def draw_budget(budget: Budget, materials: Sequence[Material]) -> Figure:
    """Storage and loss modulus of the full and the reduced Prony series, the band of the robot shaded.

    Marks at the foot are one over the elements' relaxation times, as far as they lie within five decades of the band.
    """
    low, high = budget.band
    rates = 1 / budget.times[(budget.times < 1e5 / low) & (budget.times > 1e-5 / high)]
    ends = min(low / 10, 0.3 * rates.min(initial=math.inf)), max(high * 10, 3 * rates.max(initial=0.0))
    omega = np.geomspace(*ends, 400)
    unit = budget.solid.youngs_modulus / 1e6
    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    axes = figure.subplots(1, 2)
    full = unit * moduli_over(budget.moduli, budget.times, omega)
    for i, (axis, name) in enumerate(zip(axes, ("storage", "loss"), strict=True)):
        axis.axvspan(low, high, color="0.9", zorder=0, label="the robot's band")
        axis.loglog(omega, full[i], color="k", lw=1.6, label=f"all {len(budget.moduli)} elements")
        for k, material in enumerate(materials):
            value = unit * moduli_over(
                material.moduli, material.times, omega, material.viscosity / float(budget.solid.shear)
            )
            off = (material.storage_error, material.loss_error)[i]
            label = f"{material.name}: off by {100 * off:.2g} %"
            axis.loglog(omega, value[i], "--", color=f"C{k}", lw=1.4, label=label)
        for stable, fill in ((True, "k"), (False, "none")):
            at = [1 / e.time for e in budget.elements[1:] if e.stable == stable and 1 / e.time in rates]
            label = f"1 / relaxation time, {'' if stable else 'not '}stable at {1e6 * budget.dt:.3g} us" if at else None
            style = {"mec": "k", "mfc": fill, "ms": 5, "transform": axis.get_xaxis_transform(), "label": label}
            axis.plot(at, [0.02] * len(at), "^", **style)
        axis.set(xlabel="angular frequency [rad/s]", ylabel=f"{name} modulus in tension [MPa]")
        axis.set(xlim=(omega[0], omega[-1]), ylim=(0.5 * full[i].min(), 2 * full[i].max()))
        axis.legend(fontsize="x-small", loc="upper left")
    return figure


def draw_shift(curves: Any, shift: Shift, curve: Any) -> Figure:
    """Measured curves and master curve, coloured by temperature, and shift factors with the WLF law."""
    figure = Figure(figsize=(11, 3.9), layout="constrained")
    raw, reduced, factors = figure.subplots(1, 3)
    low, high = min(c.temperature for c in curves), max(c.temperature for c in curves)
    creep = isinstance(curve, Creep)
    for c, log_a, log_b in zip(curves, shift.log_a, shift.log_b, strict=True):
        color = _color((c.temperature - low) / max(high - low, 1e-9))
        for x, y, style in _series(c):
            raw.loglog(x, y, style, color=color, ms=3)
            factor = 10 ** (log_a if isinstance(c, Sweep) else -log_a)
            reduced.loglog(x * factor, y * 10 ** (-log_b if creep else log_b), style, color=color, ms=3)
    name = "angular frequency [rad/s]" if isinstance(curve, Sweep) else "time [s]"
    title = "measured (dots: storage, crosses: loss)" if isinstance(curve, Sweep) else "measured"
    raw.set(xlabel=name, ylabel="compliance [1/Pa]" if creep else "modulus [Pa]", title=title)
    reduced.set(xlabel=f"{name}, reduced", title=f"at {shift.reference:.4g} C")
    factors.errorbar(shift.temperatures, shift.log_a, 2 * shift.log_a_error, fmt="o", ms=4, label="2 standard errors")
    if shift.determines_wlf:
        fine = np.linspace(low, high, 200)
        factors.plot(fine, wlf(shift).log_a(fine), "-", lw=1.2, label="WLF")
    factors.set(xlabel="temperature [C]", ylabel="log10 a_T")
    factors.legend(fontsize="small")
    for axis in (raw, reduced, factors):
        axis.grid(alpha=0.3)
        axis.title.set_fontsize(10)
    return figure


def draw_spectrum(curve: Curve, spectrum: Spectrum) -> Figure:
    """Data and fitted Prony series; below, the relative residuals."""
    figure = Figure(figsize=(8.5, 4.8), layout="constrained")
    axis, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    if isinstance(curve, Sweep):
        parts = [
            (curve.omega, measured, model, name)
            for measured, model, name in zip(
                (curve.storage, curve.loss), spectrum.storage_loss(curve.omega), ("storage", "loss"), strict=True
            )
        ]
    elif isinstance(curve, Relaxation):
        parts = [(curve.time, curve.modulus, spectrum.relaxation(curve.time), "relaxation")]
    else:
        parts = [(curve.time, curve.compliance, spectrum.creep(curve.time), "creep")]
    for k, (x, measured, model, name) in enumerate(parts):
        axis.loglog(x, measured, "o", ms=3, color=f"C{k}", alpha=0.5, label=f"{name}, measured")
        axis.loglog(x, model, "-", lw=1.3, color=f"C{k}", label=f"{name}, {len(spectrum.moduli)} elements")
        below.semilogx(x, 100 * (model / measured - 1), ".", ms=4, color=f"C{k}")
    axis.set(ylabel="compliance [1/Pa]" if isinstance(curve, Creep) else "modulus [Pa]")
    axis.legend(fontsize="small")
    below.set(xlabel="angular frequency [rad/s]" if isinstance(curve, Sweep) else "time [s]", ylabel="error [%]")
    for one in (axis, below):
        one.grid(alpha=0.3)
    return figure


def _series(curve: Curve) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Abscissa, modulus and marker of each plotted quantity of a curve."""
    if isinstance(curve, Sweep):
        return [(curve.omega, curve.storage, "."), (curve.omega, curve.loss, "x")]
    return [(curve.time, curve.modulus if isinstance(curve, Relaxation) else curve.compliance, ".")]


def _color(share: float) -> tuple[float, float, float]:
    """From blue for the coldest to red for the warmest."""
    return (0.15 + 0.7 * share, 0.35 - 0.2 * abs(2 * share - 1), 0.85 - 0.7 * share)
