"""Bars and spheres against closed forms; ``simulator.py`` prints them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq, curve_fit
from tables import Row

from torchsoro import Body, Domain, Drag, Plane, Simulator, Solid, Waveform, fill

EXACT = torch.float64
FORMS = ("apic", "flip", "total")
SILICONE = Solid(youngs_modulus=264e3, poisson_ratio=0.4, density=1070.0)


def block(counts: Sequence[int], cell: float, origin: Sequence[float], solid: Solid) -> Body:
    """A solid block of particles, eight in a cell."""
    x, y, z = (n * cell / 2 for n in counts)
    a, b, c = origin
    domain = Domain(size=(x, y, z), particles=(counts[0], counts[1], counts[2]), origin=(a, b, c))
    return fill(domain, torch.ones(domain.count, dtype=EXACT), solid=solid)


def arguments(name: str) -> dict[str, Any]:
    """Arguments of the simulator for "apic" and "flip" (both of the updated formulation), or "total"."""
    return {"formulation": "total"} if name == "total" else {"transfer": name}


def fast_wave(solid: Solid) -> float:
    """Speed of pressure waves [m/s]."""
    return math.sqrt((solid.bulk + 4 / 3 * solid.shear) / solid.density)


# Effective position of a clamp of fixed nodes, in cells. With quadratic splines, a steady load that causes the strain s
# gives s (1 - q^i) at the i-th cell boundary, q = sqrt(3) - 2, from the 1:4:1 coupling of neighbours. The effective
# length is therefore -q / (1 - q) cells shorter, counted from the last fixed node; half a cell in front of the face of
# the clamp, 1 / (2 sqrt(3)) remains. The same holds for stretching, shear and rotation.
HELD_LENGTH = 0.5 / math.sqrt(3.0)


def cantilever(
    cells: int,
    *,
    length: float,
    width: float,
    solid: Solid,
    dt: float,
    form: str,
    gravity: float,
    duration: float,
    shift: float = 0.0,
) -> Row:
    """Release a square bar clamped at x = 0 under gravity, and fit a damped oscillation to the motion of the tip.

    The bar extends two cells behind the clamp, where planes with unlimited adhesion fix every node. In the total
    formulation nodes lie half a cell beside the face of the clamp, and the first node in front of it is fixed as well:
    the bar is equivalent to one ``HELD_LENGTH`` cells shorter and is compared with a beam of that length. ``shift``
    offsets the bar from the grid of the updated formulation along y and z, in cells.
    """
    begin = time.perf_counter()
    cell = width / cells
    counts = (round(2 * length / cell) + 4, 2 * cells, 2 * cells)
    body = block(counts, cell, (-2 * cell, shift * cell, shift * cell), solid)
    far = math.ceil(1.5 * length / cell) * cell
    simulator = Simulator(cell=cell, dt=dt, low=(-far,) * 3, high=(far,) * 3, **arguments(form))
    front, lost = (0.51 * cell, HELD_LENGTH * cell) if form == "total" else (0.0, 0.0)
    middle = width / 2 + shift * cell
    off = ((body.position - torch.tensor([length, middle, middle])) ** 2).sum(-1)
    tip = off.round(decimals=9).argmin().reshape(1)  # of several that are as near, always the same
    steps = round(duration / dt)
    with torch.no_grad():
        seen = simulator(
            body,
            duration=steps * dt,
            gravity=(0.0, 0.0, -gravity),
            planes=[Plane(axis=0, offset=front - i * cell, adhesion=1e12) for i in range(3)],
            sample_every=dt * max(1, int(2e-3 / dt)),
            probes=tip,
        )
    t, z = seen.time.numpy(), (seen.position[:, 0, 2] - seen.position[0, 0, 2]).numpy()
    scale = np.abs(z).max()
    exact = timoshenko(length - lost, width, solid)
    omega = 2 * math.pi * exact
    fitted, _ = curve_fit(
        lambda t, c, a, d, w, p: c + a * np.exp(-d * t) * np.cos(w * t + p),
        t,
        z / scale,
        p0=(-0.5, 0.5, 0.01 * omega, omega, 0.0),
        maxfev=20_000,
    )
    omega = abs(fitted[3])
    return {
        "form": form,
        "cells": cells,
        "dt [us]": dt * 1e6,
        "steps": steps,
        "free length [mm]": (length - lost) * 1e3,
        "f [Hz]": omega / (2 * math.pi),
        "Timoshenko [Hz]": exact,
        "damping": fitted[2] / omega,
        "sag [mm]": -fitted[0] * scale * 1e3,
        "seconds": time.perf_counter() - begin,
    }


def timoshenko(length: float, width: float, solid: Solid) -> float:
    """First natural frequency [Hz] of a square Timoshenko cantilever.

    Deflection w and rotation r in exp(i omega t), with kappa = 10 (1 + nu) / (12 + 11 nu) (Cowper 1966):

        kappa G (w'' - r') + rho omega^2 w = 0,    E I r'' + kappa G A (w' - r) + rho I omega^2 r = 0,
        w = r = 0 at the clamp,    r' = w' - r = 0 at the tip.

    Solutions are cosh, sinh (a x) and cos, sin (b x); omega is the first root of the 4 x 4 determinant of the ends.
    """
    E, nu, rho = (float(n) for n in (solid.youngs_modulus, solid.poisson_ratio, solid.density))
    kG = 10 * (1 + nu) / (12 + 11 * nu) * float(solid.shear)
    gyration = width**2 / 12  # I / A

    def determinant(omega: float) -> float:
        q, half = rho * omega**2 / kG, rho * omega**2 * (1 / E + 1 / kG) / 2
        root = math.sqrt(half**2 - rho * omega**2 * (rho * omega**2 / (E * kG) - 1 / (E * gyration)))
        a, b = math.sqrt(root - half), math.sqrt(root + half)
        r, s = a + q / a, b - q / b
        ch, sh, c, n = math.cosh(a * length), math.sinh(a * length), math.cos(b * length), math.sin(b * length)
        return float(
            np.linalg.det(
                [
                    [1, 0, 1, 0],
                    [0, r, 0, s],
                    [r * a * ch, r * a * sh, -s * b * c, -s * b * n],
                    [(a - r) * sh, (a - r) * ch, (s - b) * n, (b - s) * c],
                ]
            )
        )

    slender = 1.8751041**2 / length**2 * math.sqrt(E * gyration / rho)
    return float(brentq(determinant, 0.3 * slender, slender)) / (2 * math.pi)  # type: ignore[arg-type]


def damping(
    cases: Sequence[tuple[int, float]] = ((3, 131e-6), (3, 22e-6), (6, 65e-6), (6, 22e-6)),
    forms: Sequence[str] = FORMS,
    duration: float = 0.5,
) -> list[Row]:
    """Damping ratio of a purely elastic bar, 100 x 30 x 30 mm, let go under gravity; the true one is zero."""
    setting: Row = {"length": 0.1, "width": 0.03, "solid": SILICONE, "gravity": 9.81, "duration": duration}
    return [cantilever(cells, dt=dt, form=form, **setting) for form in forms for cells, dt in cases]


def shifted(
    shifts: Sequence[float] = (0.0, 0.25, 0.5), forms: Sequence[str] = FORMS, duration: float = 0.5
) -> list[Row]:
    """The bar of :func:`damping`, coarse, moved across the grid by parts of a cell; the total form's moves with it."""
    setting: Row = {"length": 0.1, "width": 0.03, "solid": SILICONE, "gravity": 9.81, "duration": duration}
    rows = []
    for form, shift in itertools.product(forms, shifts):
        found = cantilever(3, dt=131e-6, form=form, shift=shift, **setting)
        names = ("f [Hz]", "Timoshenko [Hz]", "damping", "sag [mm]", "seconds")
        rows.append({"form": form, "shift [cells]": shift, **{name: found[name] for name in names}})
    return rows


def bar(
    cells: Sequence[int] = (2, 3, 4, 6),
    poisson: Sequence[float] = (0.0, 0.4),
    forms: Sequence[str] = ("flip", "total"),
    duration: float = 0.6,
) -> tuple[list[Row], dict[str, float]]:
    """First natural frequency of a bar of 100 x 20 x 20 mm at small deflection, and order of the error in the cell.

    Unlike the clamp of a beam, that of a solid prevents lateral contraction for nu > 0. At nu = 0.4 both formulations
    converge to a frequency of a solid about 1.7 % stiffer than the beam; the order is therefore given at nu = 0 only.

    Returns:
        Rows, and the order at nu = 0 for each formulation.
    """
    rows, orders = [], {}
    for form, nu in itertools.product(forms, poisson):
        solid = dataclasses.replace(SILICONE, poisson_ratio=nu)
        errors = []
        for n in cells:
            dt = 0.5 * 0.02 / n / fast_wave(solid)
            found = cantilever(
                n, length=0.1, width=0.02, solid=solid, dt=dt, form=form, gravity=0.02, duration=duration
            )
            errors.append(found["f [Hz]"] / found["Timoshenko [Hz]"] - 1)
            names = ("form", "cells", "free length [mm]", "f [Hz]", "Timoshenko [Hz]", "seconds")
            rows.append({"nu": nu, **{name: found[name] for name in names}, "error [%]": 100 * errors[-1]})
        if nu == 0 and len(cells) > 1:
            orders[form] = -float(np.polyfit(np.log(cells), np.log(np.abs(errors)), 1)[0])
    return rows, orders


def sphere(
    cells: Sequence[int] = (4, 6, 8, 12), *, pressure: float = 200.0, form: str = "flip", fictitious: float = 100.0
) -> list[Row]:
    """Static displacement of a thick sphere, radii 10 and 20 mm, under constant internal pressure, relaxed by drag.

    Lame: u = p a^3 / (b^3 - a^3) [(1 - 2 nu) r / E + (1 + nu) b^3 / (2 E r^2)]. The surface of a lattice is stepped;
    a and b are the radii of spheres of equal volume. "displacement" is the least-squares ratio to Lame's solution over
    the shell, "cavity" the ratio of the volume changes of the cavity. ``fictitious`` is the shear modulus [Pa] of the
    chamber in the total formulation, which carries a small part of the pressure.
    """
    solid, outer, inner = Solid(), 0.02, 0.01
    rows = []
    for n in cells:
        begin = time.perf_counter()
        cell = outer / n
        line = (torch.arange(-2 * n, 2 * n, dtype=EXACT) + 0.5) * cell / 2
        x = torch.cartesian_prod(line, line, line)
        x = x[x.norm(dim=-1) < outer]
        r, volume = x.norm(dim=-1), torch.full((len(x),), (cell / 2) ** 3, dtype=EXACT)
        air = r < inner
        body = Body(
            position=x,
            mass=volume * torch.where(air, 100.0, solid.density),
            volume=volume,
            bulk=torch.where(air, 0.0, solid.bulk).to(EXACT),
            shear=torch.where(air, fictitious, solid.shear).to(EXACT),
            chamber=torch.where(air, 0, -1).int(),
        )
        critical = 2 * math.sqrt(4 * solid.shear / solid.density) / inner  # of the breathing mode [1/s]
        drag = [Drag(particles=p.nonzero()[:, 0], coefficient=critical * body.mass[p].sum()) for p in (air, ~air)]
        dt = 0.4 * cell / fast_wave(solid)
        steps = round(8 * math.pi / critical / dt)
        simulator = Simulator(cell=cell, dt=dt, low=(-2 * outer,) * 3, high=(2 * outer,) * 3, **arguments(form))
        supply = Waveform(time=torch.tensor([0.0, 1.0], dtype=EXACT), pressure=torch.full((2,), pressure, dtype=EXACT))
        with torch.no_grad():
            seen = simulator(
                body,
                duration=steps * dt,
                pressure=supply,
                gravity=(0.0, 0.0, 0.0),
                loads=drag,
                sample_every=steps * dt,
                probes=torch.arange(len(x)),
            )
        a, b = (float(3 * volume[p].sum() / (4 * math.pi)) ** (1 / 3) for p in (air, r < outer))

        def lame(r: Any, a: float = a, b: float = b) -> Any:
            plain, round_ = (1 - 2 * solid.poisson_ratio) * r, (1 + solid.poisson_ratio) * b**3 / (2 * r**2)
            return pressure * a**3 / (b**3 - a**3) / solid.youngs_modulus * (plain + round_)

        u = ((seen.position[-1] - x) * x).sum(-1)[~air] / r[~air]
        exact = lame(r[~air])
        gained = seen.chamber_volume[-1, 0] / seen.chamber_volume[0, 0] - 1
        rows.append(
            {
                "form": form,
                "cells in b": n,
                "particles": len(x),
                "a [mm]": a * 1e3,
                "b [mm]": b * 1e3,
                "u(a) Lame [um]": lame(a) * 1e6,
                "displacement/Lame": float((u * exact).sum() / (exact**2).sum()),
                "cavity/Lame": float(gained) / ((1 + lame(a) / a) ** 3 - 1),
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows
