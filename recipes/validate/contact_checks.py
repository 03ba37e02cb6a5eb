"""Impact, rest and friction on a plane; ``simulator.py`` prints them."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Sequence

import numpy as np
import torch
from motion_checks import PAPER_CELL, PAPER_STEP
from structures import EXACT, SILICONE, arguments, block
from tables import Row

from torchsoro import Prony, Simulator, Solid, ground
from torchsoro.design.density import part

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
