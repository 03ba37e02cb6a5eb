"""Impact, rest and friction on a plane; ``simulator.py`` prints them."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from motion_checks import PAPER_CELL, PAPER_STEP
from structures import EXACT, SILICONE, arguments, block
from tables import Row

from torchsoro import Force, Prony, Simulator, Solid, ground, stable_step
from torchsoro.design.density import part
from torchsoro.simulation.ops.axis_sums import QUADRATURE
from torchsoro.simulation.ops.lattice import Lattice

Landing = Literal["inelastic", "elastic"]
Curve = tuple[str, int, float, np.ndarray, np.ndarray, np.ndarray]
GRAVITY = 9.81
VISCOSITY = 50.0  # [Pa s], brings a block to rest within about 0.1 s


def restitution(
    elements: Sequence[int] = (0, 3, 5),
    sizes: Sequence[int] = (4, 10),
    forms: Sequence[str] = ("apic", "total"),
    *,
    speed: float = 4.0,
) -> tuple[list[Row], list[Curve]]:
    """Coefficient of restitution of a cube dropped flat on sticking ground, with the paper's cell and step.

    In the total formulation with five Maxwell elements the step is reduced to the stability bound.

    Returns:
        Rows, and a curve for each: formulation, elements, edge [mm], time [ms], height of the centre [mm] and its
        velocity [m/s].
    """
    rows, curves = [], []
    for form, size, count in itertools.product(forms, sizes, elements):
        begin = time.perf_counter()
        body = block((2 * size,) * 3, PAPER_CELL, (0, 0, PAPER_CELL / 2), Solid())
        down = torch.tensor([0.0, 0.0, -speed], dtype=EXACT).expand_as(body.position)
        room = 4 * size * PAPER_CELL
        dt = "auto" if form == "total" else PAPER_STEP
        simulator = Simulator(cell=PAPER_CELL, dt=dt, low=(-room,) * 3, high=(2 * room,) * 3, **arguments(form))
        with torch.no_grad():
            seen = simulator(
                dataclasses.replace(body, velocity=down),
                duration=60 * size * PAPER_STEP,
                prony=Prony.paper(count) if count else None,
                gravity=(0.0, 0.0, 0.0),
                planes=[ground()],
                sample_every=PAPER_STEP * max(1, size // 4),
            )
        height, velocity = seen.center_of_gravity[:, 2].numpy(), seen.center_velocity[:, 2].numpy()
        edge = size * PAPER_CELL * 1e3
        rows.append(
            {
                "form": form,
                "edge [mm]": edge,
                "elements": count,
                "dt [us]": seen.dt * 1e6,
                "restitution": float(velocity[-1] / speed),
                "least height [%]": 100 * float(height.min() / height[0]),
                "seconds": time.perf_counter() - begin,
            }
        )
        curves.append((form, count, edge, seen.time.numpy() * 1e3, height * 1e3, velocity))
    return rows, curves


def ball_drop(
    elements: Sequence[int] = (0, 1, 2, 3, 4, 5),
    forms: Sequence[str] = ("total",),
    *,
    diameter: float = 0.015,
    across: int = 8,
    gap: float = 0.05,
    duration: float = 0.3,
) -> tuple[list[Row], list[Curve]]:
    """Coefficient of restitution of a ball of the paper's resin on sticking ground (Fig. S9 of the paper).

    The updated formulation uses the paper's step, the total one the largest stable step.

    Args:
        elements: Numbers of Maxwell elements of Table S1.
        forms: Formulations of the simulator.
        diameter: Diameter of the ball [m].
        across: Number of cells across the diameter.
        gap: Initial distance of the ball from the ground [m].
        duration: Duration of the simulation [s]; must include the first rebound and the following fall.

    Returns:
        Rows with the restitution (speed after over speed before the first impact), and curves as for
        :func:`restitution` with the diameter as edge.
    """
    rows, curves = [], []
    cell = diameter / across
    solid = block((2 * across,) * 3, cell, (0, 0, gap), Solid())
    center = torch.tensor([0, 0, gap], dtype=EXACT) + diameter / 2
    center[:2] = solid.position.mean(0)[:2]
    ball = part(solid, (solid.position - center).norm(dim=1) <= diameter / 2)
    for form, count in itertools.product(forms, elements):
        begin = time.perf_counter()
        dt = "auto" if form == "total" else PAPER_STEP
        room = gap + 4 * diameter
        simulator = Simulator(cell=cell, dt=dt, low=(-room,) * 3, high=(2 * room,) * 3, **arguments(form))
        with torch.no_grad():
            seen = simulator(
                ball,
                duration=duration,
                prony=Prony.paper(count) if count else None,
                gravity=(0.0, 0.0, -GRAVITY),
                planes=[ground()],
                sample_every=0.0005,
            )
        height, velocity = seen.center_of_gravity[:, 2].numpy(), seen.center_velocity[:, 2].numpy()
        down = int(velocity[: len(velocity) * 2 // 3].argmin())
        up = down + int(velocity[down:].argmax())
        rows.append(
            {
                "form": form,
                "elements": count,
                "dt [us]": seen.dt * 1e6,
                "impact [m/s]": float(-velocity[down]),
                "restitution": float(-velocity[up] / velocity[down]),
                "rebound [mm]": 1e3 * float(height[up:].max() - height[0] + gap),
                "seconds": time.perf_counter() - begin,
            }
        )
        curves.append((form, count, 1e3 * diameter, seen.time.numpy() * 1e3, height * 1e3, velocity))
    return rows, curves


def standing(
    cells: Sequence[int] = (4, 6, 8),
    shifts: Sequence[float] = (0.0, 0.25, 0.5, 0.75),
    forms: Sequence[str] = ("apic", "total"),
    *,
    edge: float = 0.03,
    duration: float = 0.15,
) -> list[Row]:
    """Height of a block at rest on smooth ground: H/2 - rho g H^2 / (3 E) for the centre of gravity.

    The block is released a fraction of a cell above the ground ("shift"), with the same offset from the grid along x
    and y. Viscosity brings it to rest. In the updated formulation it does not fall, since contact acts on particles
    within one cell of the ground.
    """
    rows = []
    for form, n, shift in itertools.product(forms, cells, shifts):
        begin = time.perf_counter()
        cell, solid = edge / n, SILICONE
        off = shift * cell
        body = block((2 * n,) * 3, cell, (off, off, off), solid)
        body = dataclasses.replace(body, viscosity=torch.full_like(body.mass, VISCOSITY))
        simulator = Simulator(cell=cell, dt="auto", low=(-2 * edge,) * 3, high=(3 * edge,) * 3, **arguments(form))
        with torch.no_grad():
            seen = simulator(body, duration=duration, gravity=(0, 0, -GRAVITY), planes=[ground(friction=0.0)])
        height = edge / 2 - solid.density * GRAVITY * edge**2 / (3 * solid.youngs_modulus)
        rows.append(
            {
                "form": form,
                "cell [mm]": cell * 1e3,
                "shift [cells]": shift,
                "height [mm]": float(seen.center_of_gravity[-1, 2]) * 1e3,
                "error [cells]": float(seen.center_of_gravity[-1, 2] - height) / cell,
                "speed [mm/s]": float(seen.center_velocity[-1].norm()) * 1e3,
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows


def sliding(
    cells: Sequence[int] = (4, 6, 8),
    frictions: Sequence[float] = (0.3, 0.6),
    shifts: Sequence[float] = (0.0,),
    forms: Sequence[str] = ("apic", "total"),
    *,
    elements: int = 3,
    edge: float = 0.03,
    speed: float = 1.0,
) -> list[Row]:
    """Sliding distance of a block on ground with Coulomb friction: v^2 / (2 mu g).

    The block starts at its equilibrium height: on the ground, in the updated formulation by "shift" above it (see
    :func:`standing`), with the same offset from the grid along x and y. Falling onto the ground at mu = 0.6 it would
    tip over.

    The block has the Maxwell elements of the paper's resin. Without them (``elements`` = 0) friction excites
    vibrations, which the lossless total formulation does not damp: nodes of the lower face, of a sixth of the mass of
    inner nodes, oscillate at up to the sliding speed and stick intermittently, where friction is below mu N. The
    distance is then too long.
    """
    rows = []
    for form, n, shift, friction in itertools.product(forms, cells, shifts, frictions):
        begin = time.perf_counter()
        cell, way = edge / n, speed**2 / (2 * friction * GRAVITY)
        off = shift * cell
        body = block((2 * n,) * 3, cell, (off, off, 0.0 if form == "total" else off), SILICONE)
        ahead = torch.tensor([speed, 0.0, 0.0], dtype=EXACT).expand_as(body.position)
        simulator = Simulator(
            cell=cell, dt="auto", low=(-edge,) * 3, high=(3 * edge + 1.2 * way, 3 * edge, 3 * edge), **arguments(form)
        )
        with torch.no_grad():
            seen = simulator(
                dataclasses.replace(body, velocity=ahead),
                duration=1.2 * speed / (friction * GRAVITY),
                prony=Prony.paper(elements) if elements else None,
                gravity=(0, 0, -GRAVITY),
                planes=[ground(friction=friction)],
            )
        found = float(seen.center_of_gravity[-1, 0] - seen.center_of_gravity[0, 0])
        rows.append(
            {
                "form": form,
                "elements": elements,
                "cell [mm]": cell * 1e3,
                "shift [cells]": shift,
                "mu": friction,
                "distance [mm]": found * 1e3,
                "v^2/(2 mu g) [mm]": way * 1e3,
                "error [%]": 100 * (found / way - 1),
                "speed at the end [mm/s]": float(seen.center_velocity[-1].norm()) * 1e3,
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows


def first_blow(
    cells: Sequence[int] = (3, 4, 6, 8),
    landings: Sequence[Landing] = ("inelastic", "elastic"),
    frictions: Sequence[str | float] = (0.0, "stick"),
    *,
    edge: float = 0.03,
    speed: float = 1.0,
) -> list[Row]:
    """Energy that an elastic cube loses at its first blow on the ground, at the largest stable step; total form.

    The loss is that of kinetic and strain energy together; "vibration" is the share of the energy that is strain at the
    end, and "restitution" that of the centre of gravity.
    """
    rows = []
    for landing, friction, n in itertools.product(landings, frictions, cells):
        begin = time.perf_counter()
        cell = edge / n
        body = block((2 * n,) * 3, cell, (0, 0, 0.1 * cell), SILICONE)
        down = torch.tensor([0.0, 0.0, -speed], dtype=EXACT).expand_as(body.position)
        body = dataclasses.replace(body, velocity=down)
        dt = stable_step(body, None, cell=cell, formulation="total")
        simulator = Simulator(cell=cell, dt=dt, low=(-4 * edge,) * 3, high=(4 * edge,) * 3, formulation="total")
        rule: Row = {"gravity": (0.0, 0.0, 0.0), "planes": [ground(friction=friction, landing=landing)]}
        lattice = Lattice.around(body.position, cell)
        mass, nodes, energies = lattice.nodal_mass(body.mass.unsqueeze(0))[0], lattice.nodes, []
        with torch.no_grad():
            before = simulator(body, duration=round(0.03 / dt) * dt, **rule).final
            for _ in range(20):
                seen = simulator(body, duration=dt, start=before, **rule)
                # Of symplectic Euler, velocities are those of half a step before; so is the place in the middle.
                d = (before + seen.final)[0, : 3 * nodes].view(3, -1) / 2
                v = seen.final[0, 3 * nodes : 6 * nodes].view(3, -1)
                F = lattice.gradient(d.unsqueeze(0))[0].permute(2, 0, 1) + torch.eye(3, dtype=EXACT)
                J = torch.linalg.det(F)
                strain = body.shear / 2 * (J ** (-2 / 3) * (F * F).sum((1, 2)) - 3)
                strain = (body.volume * (strain + body.bulk / 4 * ((J - 1) ** 2 + torch.log(J) ** 2))).sum()
                energies.append((float(strain), float((mass * v * v).sum() / 2)))
                before = seen.final
        whole = float(body.mass.sum()) * speed**2 / 2
        elastic, kinetic = np.mean(energies, 0).tolist()
        rows.append(
            {
                "landing": landing,
                "friction": friction,
                "cells": n,
                "lost [%]": 100 * (1 - (elastic + kinetic) / whole),
                "vibration [%]": 100 * elastic / whole,
                "restitution": float(seen.center_velocity[-1, 2]) / speed,
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows


def couple(cells: Sequence[int] = (2, 3, 4, 6, 8), *, width: float = 0.02, force: float = 1e-4) -> list[Row]:
    """Rotation of a free bar, twice as long as wide, by a couple at its ends; that of a rigid body is 1; total form."""
    rows = []
    for n in cells:
        begin = time.perf_counter()
        cell = width / n
        body = block((2 * n, 2 * n, 4 * n), cell, (0, 0, 0), SILICONE)
        x = body.position - body.position.mean(0)
        ends = [(x[:, 2] * side > width - 0.6 * cell).nonzero()[:, 0] for side in (1, -1)]
        pulls = [torch.tensor([side * force, 0.0, 0.0], dtype=EXACT) for side in (1, -1)]
        dt = stable_step(body, None, cell=cell, formulation="total")
        steps = round(0.1 / dt)
        with torch.no_grad():
            seen = Simulator(cell=cell, dt=dt, low=(-width,) * 3, high=(4 * width,) * 3, formulation="total")(
                body,
                duration=steps * dt,
                gravity=(0.0, 0.0, 0.0),
                loads=[Force(particles=end, value=pull) for end, pull in zip(ends, pulls, strict=True)],
                sample_every=max(1, steps // 50) * dt,
                probes=torch.arange(len(x)),
            )
        u, t = seen.position - seen.position[0], seen.time
        angle = (x[:, 2] * u[..., 0] - x[:, 0] * u[..., 2]).sum(1) / (x[:, 2] ** 2 + x[:, 0] ** 2).sum()
        # It also bends, around a shape that stays.
        curve = torch.stack([t * t / 2, torch.ones_like(t)], 1)
        acceleration = float(torch.linalg.lstsq(curve, angle.unsqueeze(1)).solution[0])
        inertia = float(body.mass.sum()) * 5 * width**2 / 12
        # Forces on particles act at the points of quadrature of their cells.
        arm = 2 * width - cell * (1 - 2 * QUADRATURE)
        rows.append(
            {
                "cells across": n,
                "rotation/exact": acceleration * inertia / (force * arm),
                "seconds": time.perf_counter() - begin,
            }
        )
    return rows
