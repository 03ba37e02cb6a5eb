"""From a rheometer's or DMA's file to a material that the simulator runs stably, and a report of what was left out.

    python recipes/material.py sweeps.csv --out runs/resin                 # sweeps at several temperatures
    python recipes/material.py sweeps.csv --out runs/resin --reference 21.8 --band 0.8 50 --dt 1e-5
    python recipes/material.py relaxation.csv --out runs/resin --deformation tension
    python recipes/material.py creep.csv --out runs/resin --deformation shear
    python recipes/walker.py --material runs/resin/material.toml           # a robot of it

Sweeps at several temperatures are shifted to one (time-temperature superposition), the master curve is fitted by
Maxwell elements, and of these as many are kept as the step, the cell and the robot's frequencies ask for. Written are
``material.toml``, ``report.html`` (opens from disk) and ``master.csv``.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from matplotlib.figure import Figure

from torchsoro.command_line import plain_errors
from torchsoro.output.document import Document
from torchsoro.rheology.budget import Budget, budget, choose, substitutes
from torchsoro.rheology.measured import Creep, Relaxation, Sweep, read
from torchsoro.rheology.plot import draw_budget
from torchsoro.rheology.spectrum import Spectrum, fit
from torchsoro.rheology.superposition import Shift, arrhenius, master, superpose, wlf
from torchsoro.simulation.material_file import Material, write_material
from torchsoro.storage import atomic_write

Curve = Sweep | Relaxation | Creep
WORST = 5.0  # quality of an overlap above which two curves do not superpose


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to make a material of, and for which simulation."""

    file: tyro.conf.Positional[Path]
    """Table of frequency sweeps, relaxation or creep tests: text, .xls or .xlsx."""
    out: Path
    """Folder for the material and the report."""
    deformation: Literal["tension", "shear"] | None = None
    """What the moduli resist, where the file does not say."""
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    """Units that the file does not state, such as ``--units frequency Hz storage MPa loss MPa``."""
    columns: dict[str, str] = dataclasses.field(default_factory=dict)
    """Columns that the file does not name, such as ``--columns storage "E prime"``."""
    temperature: float | None = None
    """Of a file without a column of it [deg C]."""
    reference: float | None = None
    """Temperature of the robot [deg C], to which all is shifted; 20 if left out, or the nearest that was measured."""
    vertical: bool = False
    """Shift moduli, too, and not only frequencies."""
    moduli: Literal["both", "storage", "loss"] = "both"
    """Which of a sweep's moduli tell the shifts; an instrument's loss modulus is often off at high stiffness."""
    elements: int | Literal["auto"] = "auto"
    """Maxwell elements of the master curve; auto lets the data decide."""
    equilibrium: float | None = None
    """Equilibrium modulus from another test [Pa], where the data do not reach it."""
    horizon: float = 10.0
    """What takes longer than this to relax counts as permanent [s]."""
    poisson_ratio: float = 0.4
    """Poisson ratio of the simulated solid."""
    density: float = 1070.0
    """Density [kg/m3]."""
    cell: float = 1.75e-3
    """Grid cell of the simulation [m]."""
    dt: float | Literal["auto"] = "auto"
    """Step of the simulation [s]; auto takes half of what the elastic solid alone bears."""
    formulation: Literal["total", "updated"] = "total"
    """Form of the simulator."""
    band: tuple[float, float] = (1.0, 100.0)
    """Lowest and highest frequency that the robot sees [Hz]: from its cycle to its impacts."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """What became of a file."""

    curves: Any
    shift: Shift | None
    curve: Curve
    spectrum: Spectrum
    budget: Budget
    material: Material


def main(options: Options) -> Found:
    """Make the material and write it with its report.

    Raises:
        ValueError: for a file or an option that will not do; names it.
    """
    curves: Any = read(
        options.file,
        columns=options.columns,
        units=options.units,
        deformation=options.deformation,
        temperature=options.temperature,
    )
    shift = None
    curve: Any = curves[0]
    if len(curves) > 1:
        reference = options.reference
        if reference is None:
            measured = [c.temperature for c in curves]
            reference = min(max(20.0, min(measured)), max(measured))
        shift = superpose(curves, reference=reference, vertical=options.vertical, moduli=options.moduli)
        curve = master(curves, shift)
    spectrum, remark = permanent(curve, options)
    solid = spectrum.solid(options.poisson_ratio, options.density)
    band = (2 * math.pi * options.band[0], 2 * math.pi * options.band[1])

    def price(dt: float | Literal["auto"]) -> Budget:
        return budget(spectrum, solid, cell=options.cell, band=band, dt=dt, formulation=options.formulation)

    priced = price("auto")
    priced = price(priced.elements[0].step / 2 if options.dt == "auto" else options.dt)
    kept = choose(priced)
    material = Material(
        solid=solid,
        prony=kept.prony(),
        left_out=f"{doubts(shift) if shift else ''}{remark}{priced.sentence} {kept.sentence}",
        source={
            "file": options.file.name,
            "temperature_C": f"{curve.temperature:g}",
            "window_rad_per_s": f"{curve.omega[0]:.3g} to {curve.omega[-1]:.3g}" if isinstance(curve, Sweep) else "",
            "cell_m": f"{options.cell:g}",
            "step_s": f"{priced.dt:g}",
            "formulation": options.formulation,
            "band_Hz": f"{options.band[0]:g} to {options.band[1]:g}",
        },
    )
    found = Found(curves=curves, shift=shift, curve=curve, spectrum=spectrum, budget=priced, material=material)
    options.out.mkdir(parents=True, exist_ok=True)
    write_material(options.out / "material.toml", material)
    write_curve(options.out / "master.csv", curve)
    report(found, options).save(options.out / "report.html")
    return found


def permanent(measured: Curve, options: Options) -> tuple[Spectrum, str]:
    """Fit, and take for permanent what relaxes more slowly than the horizon, or than the data reach.

    Returns:
        The spectrum, with an equilibrium modulus that the simulator can take, and a remark on it.

    Raises:
        ValueError: if nothing is left of the modulus by then.
    """
    curve = measured
    if options.equilibrium is not None and isinstance(curve, Creep):
        raise ValueError(f"equilibrium: {options.equilibrium:g} with creep tests, wanted none: their fit finds it")
    if options.equilibrium is not None:
        return fit(curve, elements=options.elements, equilibrium=options.equilibrium), ""
    found = fit(curve, elements=options.elements)
    known = found.equilibrium_interval
    ended = found.equilibrium > 0 and (known is None or known.low > 0)
    reached = 1 / curve.omega[0] if isinstance(curve, Sweep) else curve.time[-1]
    longest = min(options.horizon, reached)
    slow = found.times > (0.3 * longest if longest == reached else longest)
    if ended and not slow.any():
        return found, ""
    modulus = found.equilibrium + float(found.moduli[slow].sum())
    if not modulus > 0:
        raise ValueError(
            f"file: {options.file} shows a material that flows, with no modulus left after {longest:.2g} s; wanted a "
            "solid, or its equilibrium modulus by --equilibrium"
        )
    if isinstance(curve, Sweep):
        seen = curve.omega >= 0.3 / longest
        curve = dataclasses.replace(curve, omega=curve.omega[seen], storage=curve.storage[seen], loss=curve.loss[seen])
    elif isinstance(curve, Relaxation):
        seen = curve.time <= 3 * longest
        curve = dataclasses.replace(curve, time=curve.time[seen], modulus=curve.modulus[seen])
    else:  # the relaxation that goes with the creep; it is not measured, and so there are no intervals
        time = np.geomspace(curve.time[0], 3 * longest, 100)
        about = {"temperature": curve.temperature, "deformation": curve.deformation}
        curve = Relaxation(time=time, modulus=found.relaxation(time), **about)
    known = not isinstance(measured, Creep)
    spectrum = fit(curve, elements=max(int((~slow).sum()), 1), equilibrium=modulus, intervals=known)
    return spectrum, f"What is left after {longest:.2g} s, {modulus / 1e6:.3g} MPa, counts as permanent. "


def report(found: Found, options: Options) -> Document:
    """The page: the answer on top, then the way to it."""
    s, spectrum = found.material.solid, found.spectrum
    lead = (
        f"{options.file.name} at {found.curve.temperature:.3g} C: equilibrium Young's modulus "
        f"{s.youngs_modulus / 1e6:.3g} MPa and {len(spectrum.moduli)} Maxwell elements, of which the simulator gets "
        f"{found.material.prony.elements}. {found.material.left_out}"
    )
    page = Document(f"Material from {options.file.name}", lead)
    page.code(f"python recipes/walker.py --material {options.out / 'material.toml'}")
    if found.shift is not None:
        page.section("Time-temperature superposition")
        page.figure(draw_shift(found.curves, found.shift, found.curve), "Measured, and shifted to one temperature.")
        page.table(shift_rows(found.shift), "Shift factors and their standard errors, in decades")
        page.text(doubts(found.shift) or "All neighbours superpose within their noise.")
        page.text(laws(found.shift) if enough(found.shift) else "Too few temperatures for a law of the shift factors.")
    page.section("Maxwell elements")
    page.figure(draw_spectrum(found.curve, spectrum), "The master curve and its Maxwell elements.")
    page.table(spectrum.rows(), "Moduli with their 95 % intervals")
    page.section("To the simulator")
    choices = substitutes(found.budget, match=found.budget.band[1])
    page.figure(draw_budget(found.budget, choices), "What may stand for all elements, and what it loses.")
    page.table(found.budget.rows(), "Each element: whether the step bears it, and what it costs and brings")
    page.table([m.row() for m in choices], "What may stand for all elements; the material written is the refitted one")
    return page


def shift_rows(shift: Shift) -> list[dict[str, float]]:
    """A row for each temperature."""
    columns = (shift.temperatures, shift.log_a, shift.log_a_error, shift.log_b)
    names = ("temperature [C]", "log10 a_T", "standard error", "log10 b_T")
    return [dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)]


def doubts(shift: Shift) -> str:
    """Where neighbouring curves do not superpose; empty if they all do."""
    bad = [o for o in shift.overlap if o.quality > WORST or o.common < 0]
    if not bad:
        return ""
    where = ", ".join(f"{o.cold:.3g} and {o.hot:.3g} C" for o in bad)
    return (
        f"Neighbours that do not superpose (they differ by more than {WORST:g} times their noise, or do not overlap): "
        f"{where}. See whether the storage modulus alone (--moduli storage) or vertical shifts (--vertical) do better. "
    )


def enough(shift: Shift) -> bool:
    """Whether there are temperatures for WLF's two numbers: three beside the reference."""
    return int((np.abs(shift.temperatures - shift.reference) > 1e-9).sum()) > 2


def laws(shift: Shift) -> str:
    """The two laws of shift factors, in words."""
    one, other = wlf(shift), arrhenius(shift)
    return (
        f"WLF: C1 = {one.C1:.3g} +- {one.C1_error:.2g}, C2 = {one.C2:.3g} +- {one.C2_error:.2g} K at "
        f"{one.reference:.4g} C, {one.residual:.2g} decades from the shifts. Arrhenius: "
        f"{other.activation_energy / 1e3:.3g} +- {other.activation_energy_error / 1e3:.2g} kJ/mol, "
        f"{other.residual:.2g} decades."
    )


def draw_shift(curves: Any, shift: Shift, curve: Any) -> Figure:
    """Measured curves and the master curve, coloured by temperature; and the shift factors with WLF's law."""
    figure = Figure(figsize=(11, 3.9), layout="constrained")
    raw, reduced, factors = figure.subplots(1, 3)
    low, high = min(c.temperature for c in curves), max(c.temperature for c in curves)
    creep = isinstance(curve, Creep)
    for c, log_a, log_b in zip(curves, shift.log_a, shift.log_b, strict=True):
        color = figure_color((c.temperature - low) / max(high - low, 1e-9))
        for x, y, style in series(c):
            raw.loglog(x, y, style, color=color, ms=3)
            factor = 10 ** (log_a if isinstance(c, Sweep) else -log_a)
            reduced.loglog(x * factor, y * 10 ** (-log_b if creep else log_b), style, color=color, ms=3)
    name = "angular frequency [rad/s]" if isinstance(curve, Sweep) else "time [s]"
    title = "measured (dots: storage, crosses: loss)" if isinstance(curve, Sweep) else "measured"
    raw.set(xlabel=name, ylabel="compliance [1/Pa]" if creep else "modulus [Pa]", title=title)
    reduced.set(xlabel=f"{name}, reduced", title=f"at {shift.reference:.4g} C")
    factors.errorbar(shift.temperatures, shift.log_a, 2 * shift.log_a_error, fmt="o", ms=4, label="2 standard errors")
    if enough(shift):
        fine = np.linspace(low, high, 200)
        factors.plot(fine, wlf(shift).log_a(fine), "-", lw=1.2, label="WLF")
    factors.set(xlabel="temperature [C]", ylabel="log10 a_T")
    factors.legend(fontsize="small")
    for axis in (raw, reduced, factors):
        axis.grid(alpha=0.3)
        axis.title.set_fontsize(10)
    return figure


def draw_spectrum(curve: Curve, spectrum: Spectrum) -> Figure:
    """The data and what the Maxwell elements make of them; below, the relative error."""
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


def series(curve: Curve) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """What to plot of a curve: abscissa, modulus, mark."""
    if isinstance(curve, Sweep):
        return [(curve.omega, curve.storage, "."), (curve.omega, curve.loss, "x")]
    return [(curve.time, curve.modulus if isinstance(curve, Relaxation) else curve.compliance, ".")]


def figure_color(share: float) -> tuple[float, float, float]:
    """From blue for the coldest to red for the warmest."""
    return (0.15 + 0.7 * share, 0.35 - 0.2 * abs(2 * share - 1), 0.85 - 0.7 * share)


def write_curve(path: Path, curve: Curve) -> None:
    """Write the master curve as a table that ``material.py`` can read again; of creep it asks for --deformation."""
    letter = "E" if curve.deformation == "tension" else "G"
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if isinstance(curve, Sweep):
        writer.writerow(["omega_rad_per_s", f"{letter}_storage_Pa", f"{letter}_loss_Pa"])
        writer.writerows(zip(curve.omega.tolist(), curve.storage.tolist(), curve.loss.tolist(), strict=True))
    elif isinstance(curve, Relaxation):
        writer.writerow(["time_s", f"{letter}_relax_Pa"])
        writer.writerows(zip(curve.time.tolist(), curve.modulus.tolist(), strict=True))
    else:
        writer.writerow(["time_s", "creep_compliance_1_per_Pa"])
        writer.writerows(zip(curve.time.tolist(), curve.compliance.tolist(), strict=True))
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


def cli(arguments: Sequence[str] | None = None) -> None:
    """Make a material as the command line says, and print what was left out.

    Args:
        arguments: Instead of the process's own.
    """
    with plain_errors():
        chosen = tyro.cli(Options, description=__doc__, args=arguments)
        result = main(chosen)
        print(f"{result.material.left_out}\nwritten to {chosen.out}: material.toml, report.html, master.csv")


if __name__ == "__main__":
    cli()
