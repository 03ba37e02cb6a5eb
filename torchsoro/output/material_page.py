"""From a rheometer's file to ``material.toml``, with the page that tells the way to it."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from torchsoro.output.document import Document
from torchsoro.rheology.budget import Budget, budget, choose, substitutes
from torchsoro.rheology.horizon import Solidified, solidified
from torchsoro.rheology.measured import Creep, Relaxation, Sweep, read
from torchsoro.rheology.options import Options
from torchsoro.rheology.plausibility import check_curves, poor
from torchsoro.rheology.plot import draw_budget, draw_shift, draw_spectrum
from torchsoro.rheology.superposition import SAME, Shift, arrhenius, master, superpose, wlf
from torchsoro.simulation.material_file import Material, write_material
from torchsoro.storage import atomic_write, check_folder

Curve = Sweep | Relaxation | Creep
WORST = 5.0  # quality of an overlap above which two curves do not superpose
RESULTS = ("material.toml", "report.html", "master.csv")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """What became of a file."""

    curves: Any
    shift: Shift | None
    curve: Curve
    solidified: Solidified
    budget: Budget
    material: Material


def make(options: Options) -> Found:
    """Make a material of a file, and write it with its report: ``RESULTS`` in the folder ``options.out``.

    Raises:
        ValueError: for a file or an option that will not do; names it.
    """
    check_folder("out", options.out, RESULTS)
    curves = curves_of(options)
    shift, curve = None, curves[0]
    if len(curves) > 1:
        shift = shifted(curves, options)
        curve = master(curves, shift)
    print(f"fitting Maxwell elements to {len(getattr(curve, curve.axis))} points", flush=True)
    band = (2 * math.pi * options.band[0], 2 * math.pi * options.band[1])
    try:
        solid_like = solidified(
            curve,
            horizon=options.horizon,
            lowest=band[0],
            elements=options.elements,
            equilibrium=options.equilibrium,
        )
    except ValueError as error:
        raise ValueError(f"{options.file}: {error}") from error
    spectrum = solid_like.spectrum
    solid = spectrum.solid(options.poisson_ratio, options.density)

    def afford(dt: float | Literal["auto"]) -> Budget:
        return budget(spectrum, solid, cell=options.cell, band=band, dt=dt, formulation=options.formulation)

    affordable = afford("auto")
    affordable = afford(affordable.elements[0].step / 2 if options.dt == "auto" else options.dt)
    kept = choose(affordable)
    remarks = (
        doubts(shift, options) if shift else "",
        poor(spectrum.error, len(curve.ordinates) * len(getattr(curve, curve.axis))),
        solid_like.remark,
        beyond(curve, band),
        f"{affordable.sentence} {kept.sentence}",
    )
    material = Material(
        solid=solid,
        prony=kept.prony(),
        left_out="".join(remarks),
        source={
            "file": options.file.name,
            "temperature_C": f"{curve.temperature:g}",
            "window_rad_per_s": f"{curve.omega[0]:.3g} to {curve.omega[-1]:.3g}" if isinstance(curve, Sweep) else "",
            "cell_m": f"{options.cell:g}",
            "step_s": f"{affordable.dt:g}",
            "formulation": options.formulation,
            "band_Hz": f"{options.band[0]:g} to {options.band[1]:g}",
        },
    )
    found = Found(curves=curves, shift=shift, curve=curve, solidified=solid_like, budget=affordable, material=material)
    page = report(found, options)
    options.out.mkdir(parents=True, exist_ok=True)
    write_curve(options.out / "master.csv", curve)
    page.save(options.out / "report.html")
    write_material(options.out / "material.toml", material)
    return found


def curves_of(options: Options) -> Any:
    """The file's isothermal curves, the coldest first.

    Raises:
        ValueError: for a file that cannot be read, that holds no measurement of a linear viscoelastic material, or that
            has no curve at the reference temperature.
    """
    try:
        curves = read(
            options.file,
            columns={name: int(column) if column.isdigit() else column for name, column in options.columns.items()},
            units=options.units,
            deformation=options.deformation,
            temperature=options.temperature,
        )
    except (OSError, ImportError) as error:
        raise ValueError(f"file: {error}") from error
    check_curves(f"file: {options.file}", curves)
    only = curves[0].temperature
    if options.reference is not None and len(curves) == 1:
        if abs(only - options.reference) > SAME:  # not so if the file does not say its temperature
            raise ValueError(
                f"reference = {options.reference:g}: {options.file} was measured at {only:.4g} deg C only; wanted "
                "that, or a file with several temperatures to shift"
            )
        return [dataclasses.replace(curves[0], temperature=options.reference)]
    return curves


def shifted(curves: Any, options: Options) -> Shift:
    """Shift factors of the curves, with a bar while they are sought.

    Raises:
        ValueError: for curves or a reference that do not allow it.
    """
    reference = options.reference
    if reference is None:
        measured = [c.temperature for c in curves]
        reference = min(max(20.0, min(measured)), max(measured))
    form = "{desc} {percentage:3.0f} % |{bar}| {elapsed}, at most {remaining} left"
    with tqdm(total=1.0, desc=f"superposing {len(curves)} curves", bar_format=form, delay=3.0) as bar:
        return superpose(
            curves, reference=reference, vertical=options.vertical, moduli=options.moduli, progress=bar.update
        )


def report(found: Found, options: Options) -> Document:
    """The page: the answer on top, then the way to it."""
    s, spectrum = found.material.solid, found.solidified.spectrum
    kind = "equilibrium Young's modulus" if not found.solidified.remark else "Young's modulus taken as permanent"
    lead = (
        f"{options.file.name} at {found.curve.temperature:.3g} C: {kind} {s.youngs_modulus / 1e6:.3g} MPa and "
        f"{len(spectrum.moduli)} Maxwell elements, of which the simulator gets {found.material.prony.elements}. "
        f"{found.material.left_out}"
    )
    page = Document(f"Material from {options.file.name}", lead)
    page.code(f"python recipes/walker.py --material {options.out / 'material.toml'}")
    if found.shift is not None:
        page.section("Time-temperature superposition")
        page.figure(draw_shift(found.curves, found.shift, found.curve), "Measured, and shifted to one temperature.")
        page.table(shift_rows(found.shift), "Shift factors and their standard errors, in decades")
        page.text(doubts(found.shift, options) or "All neighbouring curves superpose within their noise.")
        few = "Too few temperatures for the WLF and Arrhenius laws."
        page.text(laws(found.shift) if found.shift.determines_wlf else few)
    page.section("Relaxation spectrum")
    if found.solidified.flow is not None:
        page.text(found.solidified.flow.sentence)
    page.figure(draw_spectrum(found.curve, spectrum), "Measured or master curve, and its Maxwell elements.")
    page.table(spectrum.rows(), "Moduli with their 95 % intervals")
    page.text(
        "An interval is that of the modulus of one element while all others, and all relaxation times within their own "
        "part of the time axis, are fitted anew. Elements at the ends of the data stand for all that is faster or "
        "slower and have no interval."
    )
    page.section("Elements for the simulator")
    choices = substitutes(found.budget, match=found.budget.band[1])
    page.figure(draw_budget(found.budget, choices), "Substitutes for the whole series, and what each neglects.")
    page.table(found.budget.rows(), "Each element: whether the step is stable with it, its cost and its share")
    page.table([m.row() for m in choices], "Substitutes for the whole series; the refitted one is written")
    return page


def shift_rows(shift: Shift) -> list[dict[str, float]]:
    """A row for each temperature."""
    columns = (shift.temperatures, shift.log_a, shift.log_a_error, shift.log_b)
    names = ("temperature [C]", "log10 a_T", "standard error", "log10 b_T")
    return [dict(zip(names, map(float, row), strict=True)) for row in zip(*columns, strict=True)]


def doubts(shift: Shift, options: Options) -> str:
    """Where neighbouring curves do not superpose; empty if they all do."""
    bad = [o for o in shift.overlap if o.quality > WORST or o.common < 0]
    if not bad:
        return ""
    where = ", ".join(f"{round(o.cold, 1) + 0:g} and {round(o.hot, 1) + 0:g} C" for o in bad)
    most = max((o.mismatch for o in bad if o.common > 0), default=0.0)
    other = [
        *["the storage modulus alone (--moduli storage)"] * (options.moduli == "both" and len(shift.noise) > 1),
        *["vertical shifts (--vertical)"] * (not options.vertical),
    ]
    advice = f"Compare with {' and with '.join(other)}. " if other else ""
    return (
        f"Neighbouring curves that do not superpose (apart by more than {WORST:g} times their noise and by up to "
        f"{10**most - 1:.0%}, or without overlap): {where}. {advice}"
    )


def beyond(curve: Curve, band: tuple[float, float]) -> str:
    """A remark on the part of the band [rad/s] that was not measured; empty if there is none."""
    low, high = (
        (curve.omega[0], curve.omega[-1]) if isinstance(curve, Sweep) else (1 / curve.time[-1], 1 / curve.time[0])
    )
    if low <= band[0] and band[1] <= high:
        return ""
    return (
        f"The data cover {low:.3g} to {high:.3g} rad/s: in the rest of {band[0]:.3g} to {band[1]:.3g} rad/s the moduli "
        "are extrapolated. "
    )


def laws(shift: Shift) -> str:
    """The two laws of shift factors, in words."""
    one, other = wlf(shift), arrhenius(shift)
    return (
        f"WLF: C1 = {one.C1:.3g} +- {one.C1_error:.2g}, C2 = {one.C2:.3g} +- {one.C2_error:.2g} K at "
        f"{one.reference:.4g} C, {one.residual:.2g} decades from the shifts. Arrhenius: "
        f"{other.activation_energy / 1e3:.3g} +- {other.activation_energy_error / 1e3:.2g} kJ/mol, "
        f"{other.residual:.2g} decades."
    )


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
