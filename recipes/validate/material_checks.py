"""Validation of superposition and Prony fits against published measurements and against a known material.

    python recipes/validate/material_checks.py RECORDINGS            # all data sets in the folder
    python recipes/validate/material_checks.py RECORDINGS adhesive   # shift factors, fit, comparison with pyvisco
    python recipes/validate/material_checks.py RECORDINGS polyisoprene  # shift factors, published WLF law
    python recipes/validate/material_checks.py RECORDINGS polystyrene   # shift factors of creep, published WLF law
    python recipes/validate/material_checks.py RECORDINGS shaker     # resonance of a mass on rubber
    python recipes/validate/material_checks.py RECORDINGS resin      # Table S1 with noise; no recordings

RECORDINGS is a folder with dma-nrel-polymer (github.com/NREL/pyvisco), rheology-polyisoprene-tts
(github.com/jorge-ramirez-upm/RepTate), creep-polystyrene-plazek (github.com/krlennon/mastercurves) and
dma-shaker-rubber (github.com/MarcusNi96/dma-prony-validation). pyvisco comes with ``pip install -e '.[pyvisco]'``: 117
packages, 700 MB.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from pyvisco_fits import pyvisco_fits
from shaker import closed_form, read_sine, simulated
from tables import Row, show

from torchsoro.command_line import plain_errors
from torchsoro.rheology.alignment import channels_of
from torchsoro.rheology.budget import budget, choose
from torchsoro.rheology.measured import Sweep, read
from torchsoro.rheology.overlap import distance
from torchsoro.rheology.spectrum import Interval, Spectrum, error_norm, fit
from torchsoro.rheology.superposition import Shift, Wlf, master, read_shift, superpose, wlf
from torchsoro.simulation.material import Prony

KNOWN = 0.15  # largest standard error of log10 a_T of compared shift factors [decades]
ROOM = 21.0  # temperature of the shaker test [deg C]
RUBBER = {
    "poisson_ratio": 0.4,
    "density": 1260.0,
}  # published: 0.494, which does not affect shear but reduces the stable step
MASSES = (0.1178, 0.573, 1.196)  # [kg]
WITHIN = 0.05  # largest relative error of a recovered modulus


# -------------------------------------------------------------------------------------------------------- shift factors
def compared(name: str, curves: Sequence[Any], theirs: Shift, *, limit: float, **how: Any) -> tuple[Row, Shift]:
    """Compare estimated and published shift factors, after removing the offset due to the reference temperature.

    Args:
        name: Label in the table.
        curves: Isothermal curves, as for :func:`torchsoro.rheology.superposition.superpose`.
        theirs: Published shift factors at the same temperatures.
        limit: Required root-mean-square difference of log10 a_T [decades], over standard errors below ``KNOWN``.
        how: Arguments of ``superpose``.

    Returns:
        A row and the estimated shift factors. "apart" is the root-mean-square mismatch of log10 storage modulus (or
        compliance) between neighbouring shifted curves over their common range.
    """
    begin = time.perf_counter()
    shift = superpose(curves, **how)
    seconds = time.perf_counter() - begin
    off = shift.log_a - theirs.log_a
    known = shift.log_a_error < KNOWN
    law = wlf(shift)
    row = {
        "curves": name,
        "temperatures": len(off),
        "known": int(known.sum()),
        "rms, known [decades]": float(off[known].std()),
        "rms, all": float(off.std()),
        "limit": limit,
        "met": "yes" if off[known].std() <= limit else "no",
        "apart, theirs": apart(curves, theirs),
        "apart, ours": apart(curves, shift),
        "C1": f"{law.C1:.2f} +- {law.C1_error:.2f}",
        "C2 [K]": f"{law.C2:.1f} +- {law.C2_error:.1f}",
        "at [C]": law.reference,
        "seconds": seconds,
    }
    return row, shift


def apart(curves: Sequence[Any], shift: Shift) -> float:
    """Root-mean-square mismatch of log10 storage modulus (or compliance) of neighbouring shifted curves [decades]."""
    channel = channels_of(curves, "both")[0]
    x, y = channel.x + shift.log_a[channel.curve], channel.y + shift.log_b[channel.curve]
    noise = np.array([1e-3])  # affects only the quality, which is not used
    pairs = [distance([(x, y, channel.curve)], noise, i)[1] for i in range(len(curves) - 1)]
    return float(np.sqrt(np.nanmean(np.square(pairs))))


def taken_apart(whole: Sweep, published: Shift) -> list[Sweep]:
    """Separate a published master curve into its sweeps of 0.1 to 100 Hz by the published shift factors."""
    measured = np.log10(2 * np.pi * np.geomspace(0.1, 100, 10))
    off = np.abs(np.log10(whole.omega)[:, None, None] - measured[:, None] - published.log_a)
    nearest = off.reshape(len(whole.omega), -1)
    label = np.where(nearest.min(1) < 1e-3, nearest.argmin(1) % len(published.log_a), -1)
    return [
        Sweep(
            omega=whole.omega[label == k] / 10 ** published.log_a[k],
            storage=whole.storage[label == k],
            loss=whole.loss[label == k],
            temperature=float(temperature),
            deformation=whole.deformation,
        )
        for k, temperature in enumerate(published.temperatures)
    ]


def fitted(name: str, curve: Any, **how: Any) -> tuple[Row, Spectrum]:
    """Row of the fit of a curve, with the number of terms of least BIC, and the spectrum with intervals."""
    begin = time.perf_counter()
    found = fit(curve, **how)
    seconds = time.perf_counter() - begin
    axis = getattr(curve, curve.axis)
    known = found.equilibrium_interval
    row = {
        "curve": name,
        "points": len(axis),
        "decades": math.log10(axis[-1] / axis[0]),
        "terms": len(found.moduli),
        "e (Eq. 17c)": found.error,
        "e, any number of terms": found.floor,
        "rms [%]": 100 * math.sqrt(found.error / (len(axis) * len(curve.ordinates))),
        "moduli known": sum(not i.unknown for i in found.intervals),
        "equilibrium [MPa]": found.equilibrium / 1e6,
        "known": "held at 0" if known is None else f"{known.low / 1e6:.3g} to {known.high / 1e6:.3g}",
        "seconds": seconds,
    }
    return row, found


def adhesive(folder: Path) -> list[Row]:
    """Stiff adhesive in tension: shift factors and fits of the instrument's, the published and the raw sweeps.

    Returns:
        Rows of the comparison of shift factors, the last one of the raw sweeps.
    """
    how: dict[str, Any] = {"limit": 0.15, "moduli": "storage", "misfit": 0.0}
    rows, masters = [], {}
    if importlib.util.find_spec("python_calamine"):
        book = folder / "freq_Eplexor_master.xls"
        listed = read_shift(book, columns={"temperature": "Temp.", "log_a": "Shift"}, units={"temperature": "C"})
        whole: Any = read(book)[0]
        rows.append(compared("instrument's master", taken_apart(whole, listed), listed, reference=25.0, **how)[0])
    else:
        print("The instrument's master curve is a workbook: skipped; pip install python-calamine")
    listed = read_shift(folder / "freq_user_master__shift_factors.csv")
    whole = read(folder / "freq_user_master.csv", temperature=listed.reference)[0]
    masters["published master"] = whole
    rows.append(compared("published master", taken_apart(whole, listed), listed, reference=-5.0, **how)[0])
    curves: Any = read(folder / "freq_user_raw.csv")
    listed = read_shift(folder / "freq_Eplexor_raw__shift_factors.csv")
    row, shift = compared("raw sweeps", curves, listed, reference=25.0, **how)
    masters["raw sweeps, our shifts"] = master(curves, shift)
    rows.append(row)
    show("Adhesive: estimated and published shift factors, where the standard error is below 0.15 decades", rows)
    if row["met"] == "no":
        print(
            "The shift factors published with the raw sweeps do not superpose them: storage moduli of neighbouring "
            f"curves differ by {row['apart, theirs']:.4f} decades with these, by {row['apart, ours']:.4f} with ours."
        )
    fits = {name: fitted(name, curve) for name, curve in masters.items()}
    show("Adhesive: Maxwell elements of its master curves", [row for row, _ in fits.values()])
    if importlib.util.find_spec("pyvisco") is None:
        print("pyvisco is not installed: comparison skipped; pip install -e '.[pyvisco]' brings it (117 packages)")
        return rows
    for name, curve in masters.items():
        show(f"Adhesive, {name}: beside pyvisco", beside_pyvisco(curve, fits[name][1]))
    return rows


def beside_pyvisco(curve: Sweep, ours: Spectrum) -> list[Row]:
    """Error e of Eq. 17c, number of terms and time of the fits by pyvisco and by torchsoro without intervals.

    Fits by torchsoro have the number of terms of each fit by pyvisco, the least number that reaches the smallest error
    of pyvisco, and the number of least BIC.
    """

    def row(who: str, found: Spectrum, seconds: float) -> Row:
        terms = int((found.moduli > 0).sum())
        return {"fit": who, "terms": terms, "e (Eq. 17c)": error_norm(found, curve), "seconds": seconds}

    theirs = [row(f"pyvisco, {how}", found, seconds) for how, found, seconds in pyvisco_fits(curve)]
    best = min(r["e (Eq. 17c)"] for r in theirs)
    few = min((c.elements for c in ours.evidence if c.error <= best), default=None)
    counts = {r["terms"]: "ours, as many" for r in theirs}
    if few is not None:
        counts[few] = "ours, the fewest as good as pyvisco's best"
    counts[len(ours.moduli)] = "ours, as many as the data ask for"
    mine = []
    for count, who in sorted(counts.items(), reverse=True):
        begin = time.perf_counter()
        found = fit(curve, elements=count, intervals=False)
        mine.append(row(who, found, time.perf_counter() - begin))
    return [*theirs, *mine]


def polyisoprene(folder: Path) -> None:
    """Two polyisoprene melts in shear: comparison with the published laws of a_T and b_T."""
    rows, fits = [], []
    for file, molar_mass in (("PI_226k_sweeps.csv", 225.9), ("PI_635k_sweeps.csv", 634.5)):
        curves: Any = read(folder / file)
        constants = header(folder / "master_curves_reference" / f"PI_{molar_mass}k_T-35.tts")
        t = np.array([curve.temperature for curve in curves])
        above = t - constants["T"] + constants["CTg"] / molar_mass
        log_a = -constants["C1"] * above / (constants["C2"] + constants["T"] + above)
        log_b = -np.log10((constants["Rho0"] - 1e-3 * constants["C3"] * t) * (t + 273.15))
        theirs = Shift(temperatures=t, log_a=log_a, log_b=log_b - log_b[0], reference=constants["T"])
        row, shift = compared(file, curves, theirs, limit=0.1, reference=-30.0, vertical=True)
        off = shift.log_b - theirs.log_b
        rows.append(row | {"b_T, rms [decades]": float(off.std())})
        if not fits:
            fits.append(fitted(file, master(curves, shift), equilibrium=False)[0])
    show("Polyisoprene: our shift factors (horizontal and vertical) and the authors' WLF law", rows)
    show("Polyisoprene: Maxwell elements of a melt", fits)


def header(path: Path) -> dict[str, float]:
    """Numbers in the first line of a master curve: C1=8.77;C2=114.03;..."""
    first = path.read_text(encoding="utf-8").splitlines()[0]
    pairs = (part.split("=") for part in first.strip(";").split(";"))
    return {name: float(value) for name, value in pairs if name in ("C1", "C2", "Rho0", "C3", "T", "CTg")}


def polystyrene(folder: Path) -> None:
    """Polystyrene creep in shear at ten temperatures (Plazek 1965): comparison with the published WLF law."""
    curves: Any = read(folder / "plazek_long.csv", deformation="shear")
    t = np.array([curve.temperature for curve in curves])
    law = Wlf(C1=10.7, C2=29.9, reference=100.0)
    theirs = Shift(temperatures=t, log_a=law.log_a(t), reference=100.0)
    row, _ = compared("creep, shear", curves, theirs, limit=0.1, reference=100.0)
    show("Polystyrene: our shift factors and the published WLF law", [row])


# --------------------------------------------------------------------------------------------------------- the shaker
def shaker(folder: Path, across: Sequence[int] = (2,)) -> list[Row]:
    """Peak of transmissibility of three masses on rubber discs: predicted from DMA of the rubber, and measured.

    "elastic" uses the storage modulus at 1 Hz without loss, as from a quasi-static test, so that the peak is infinite.
    "fitted" uses all Maxwell elements, "for the simulator" at most five, both in closed form; "simulated" uses the
    latter in a simulation of the pair of discs.

    Args:
        folder: Folder with ``dma`` and ``shaker``.
        across: Numbers of cells through the thickness of a disc, one simulation each.
    """
    curves: Any = read(folder / "dma" / "tf_015p.csv")
    spectrum = fit(master(curves, superpose(curves, reference=ROOM, vertical=True)), intervals=False)
    solid = spectrum.solid(**RUBBER)
    cell = 0.006 / min(across, default=2)
    few = choose(budget(spectrum, solid, cell=cell, band=(100 * math.pi, 2000 * math.pi), formulation="total")).prony()
    five = Spectrum(
        equilibrium=spectrum.equilibrium,
        moduli=spectrum.equilibrium * few.moduli.numpy()[::-1],
        times=few.times.numpy()[::-1],
        deformation="shear",
    )
    fine = np.linspace(50, 900, 1701)  # the pulse of the simulation has nothing at 1 kHz
    simulations = {n: simulated(solid, few, fine, MASSES, across=n, width=0.018, duration=0.03) for n in across}
    still = float(spectrum.storage_loss(np.array([2 * math.pi]))[0][0])
    rows = []
    for i, mass in enumerate(MASSES):
        sine = read_sine(folder / "shaker" / f"1g_{1e3 * mass:.0f}g.csv")
        f, omega = sine.frequency, 2 * math.pi * sine.frequency
        elastic = closed_form(np.full(len(f), still), np.zeros(len(f)), f, mass)
        answers = {
            "measured": (f, sine.transmissibility),
            "elastic": (f, np.where(elastic == elastic.max(), math.inf, elastic)),
            f"fitted, {len(spectrum.moduli)} elements": (f, closed_form(*spectrum.storage_loss(omega), f, mass)),
            f"for the simulator, {few.elements}": (f, closed_form(*five.storage_loss(omega), f, mass)),
        } | {f"simulated, {n} cells": (fine, answer[i]) for n, answer in simulations.items()}
        peaks = {name: (float(x[y.argmax()]), float(y.max())) for name, (x, y) in answers.items()}
        true = peaks["measured"]
        rows += [
            {
                "mass [kg]": mass,
                "material": name,
                "peak [Hz]": peak,
                "over measured": peak / true[0],
                "height": height,
                "height over measured": height / true[1],
            }
            for name, (peak, height) in peaks.items()
        ]
    return rows


# ---------------------------------------------------------------------------------------------------------- the resin
def resin(noises: Sequence[float] = (0.01, 0.02, 0.03, 0.05), seeds: int = 20) -> list[Row]:
    """Recovery of the moduli of Table S1 from noisy master curves of 126 frequencies, 0.01 to 1e7 rad/s.

    A modulus counts as recovered within 5 % of the true value, or if its interval is wider than that or marks it as
    undetermined.

    Args:
        noises: Relative standard deviations of the normal, independent noise of storage and loss modulus.
        seeds: Number of master curves for each noise.
    """
    rows = []
    for noise in noises:
        begin = time.perf_counter()
        found = [table_s1(noise, seed) for seed in range(seeds)]
        five = [f for f in found if len(f) == 6]
        within = [abs(value / true - 1) <= WITHIN for f in five for value, true, _ in f]
        said = [wide(value, known) for f in five for value, _, known in f]
        held = [known.low <= true <= known.high for f in five for _, true, known in f]
        off = np.array([[abs(value / true - 1) for value, true, _ in f] for f in five])
        rows.append(
            {
                "noise [%]": 100 * noise,
                "curves": seeds,
                "with five elements": len(five),
                "moduli": len(within),
                "within 5 %": sum(within),
                "or said": sum(a or b for a, b in zip(within, said, strict=True)),
                "in their interval": sum(held),
                **{f"E_{k or 'inf'} off [%]": 100 * float(off[:, k].max(initial=0.0)) for k in range(6)},
                "seconds a curve": (time.perf_counter() - begin) / seeds,
            }
        )
    return rows


def table_s1(noise: float, seed: int) -> list[tuple[float, float, Interval]]:
    """Fitted modulus, true modulus [Pa] and interval: equilibrium, then slowest first; empty unless of five terms."""
    truth = Prony.paper(5)
    true = 0.44e6 * np.append(1.0, truth.moduli.numpy())
    spectrum = Spectrum(
        equilibrium=true[0], moduli=true[:0:-1], times=truth.times.numpy()[::-1].copy(), deformation="tension"
    )
    omega = np.geomspace(1e-2, 1e7, 126)
    grain = 1 + noise * np.random.default_rng(seed).standard_normal((2, len(omega)))
    storage, loss = spectrum.storage_loss(omega) * grain
    found = fit(Sweep(omega=omega, storage=storage, loss=loss, temperature=21.8, deformation="tension"))
    if len(found.moduli) != 5:
        return []
    assert found.equilibrium_interval is not None
    values = np.append(found.equilibrium, found.moduli[::-1])
    return list(zip(values.tolist(), true.tolist(), (found.equilibrium_interval, *found.intervals[::-1]), strict=True))


def wide(value: float, known: Interval) -> bool:
    """Whether the half width of an interval exceeds 5 % of the modulus, or the modulus is undetermined."""
    return bool(known.unknown) or (known.high - known.low) / 2 > WITHIN * value


Check = Literal["adhesive", "polyisoprene", "polystyrene", "shaker", "resin", "all"]
FOLDERS = {
    "adhesive": "dma-nrel-polymer",
    "polyisoprene": "rheology-polyisoprene-tts",
    "polystyrene": "creep-polystyrene-plazek",
    "shaker": "dma-shaker-rubber",
}


def main(
    recordings: tyro.conf.Positional[Path],
    check: tyro.conf.Positional[Check] = "all",
    seeds: int = 20,
    across: tuple[int, ...] = (2,),
) -> None:
    """Validate superposition and Prony fits against published measurements and a known material.

    Args:
        recordings: Folder with a folder of each published data set.
        check: Check to be run.
        seeds: Number of noisy master curves of Table S1 for each noise.
        across: Numbers of cells through the thickness of a rubber disc, one simulation each.
    """
    for name, folder in FOLDERS.items():
        if check not in (name, "all"):
            continue
        if not (recordings / folder).is_dir():
            print(f"\n{name}: skipped, there is no {recordings / folder}")
            continue
        begin = time.perf_counter()
        if name == "shaker":
            rows = shaker(recordings / folder / "material_a", across)
            show("A mass on two rubber discs: peak of its transmissibility, from DMA alone", rows)
        else:
            {"adhesive": adhesive, "polyisoprene": polyisoprene, "polystyrene": polystyrene}[name](recordings / folder)
        print(f"{time.perf_counter() - begin:.0f} s")
    if check in ("resin", "all"):
        show("Table S1 found again in a noisy master curve of it: worst error of each modulus", resin(seeds=seeds))


if __name__ == "__main__":
    with plain_errors():
        tyro.cli(main)
