"""Creep of a bar that is held bent: positions of the updated formulation part from its F; ``simulator.py`` prints it.

A square bar of 60 x 10 x 10 mm floats, its middle pushed up and both ends down by dead forces whose sum is zero; drag
brings it to rest. Neither a clamp nor a contact takes part. F follows C, the moment of the velocities around a particle
(Eq. S3), and comes to rest where its stress bears the load. Positions follow the interpolated velocity, whose gradient
C only approximates, and go on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from structures import EXACT, arguments, block
from tables import Row

from torchsoro import Body, Force, Simulator, Solid
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice

LONG, TALL = 0.06, 0.01  # m
DRAG = 60.0  # 1/s, of a particle's mass


def _curvature(stretch: torch.Tensor, height: torch.Tensor) -> float:
    """Slope across the bar of the stretch along it [K, 2 n, 2 n] in its middle half [1/m]; heights [2 n] m."""
    rows = len(stretch) // 4
    return float((stretch[rows:-rows].mean((0, 1)) * height).sum() / (height**2).sum())


def _gradient(form: str, bar: Body, cell: float, state: torch.Tensor) -> torch.Tensor:
    """F of all particles [N, 3, 3]."""
    if form != "total":
        return state[layout.DEFORMATION : layout.HISTORY].reshape(3, 3, -1).permute(2, 0, 1)
    lattice = Lattice.around(bar.position, cell)
    moved = state[: 3 * lattice.nodes].view(1, 3, lattice.nodes)
    return torch.eye(3, dtype=EXACT) + lattice.gradient(moved)[0].permute(2, 0, 1)


def held(form: str, cells: int, *, force: float, ends: Sequence[float], turn: float = 0.0) -> list[Row]:
    """Deflection, and curvature of the positions over that of F, at some times [s]; ``turn`` [rad] of bar and grid."""
    cell = TALL / cells
    h, across = cell / 2, 2 * cells
    along = round(LONG / h)
    body: Body = block((along, across, across), cell, (-LONG / 2, -TALL / 2, -TALL / 2), Solid(poisson_ratio=0.3))
    x = body.position
    c, s = math.cos(turn), math.sin(turn)
    turned = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=EXACT)
    up = turned[:, 2]
    middle, outer = (x[:, 0].abs() < TALL / 3), (x[:, 0].abs() > LONG / 2 - TALL / 3)
    ramp = torch.tensor([0.0, 0.05, 2 * ends[-1]], dtype=EXACT)
    loads = []
    for where, push in ((middle, force * up), (outer, -force * up)):
        value = torch.stack([0 * push, push, push])
        loads.append(Force(particles=where.nonzero().squeeze(1), value=value, time=ramp))
    solid = {name: getattr(body, name) for name in ("mass", "volume", "bulk", "shear", "chamber")}
    bar = Body(position=x @ turned.T, drag=DRAG * body.mass, **solid)
    simulator = Simulator(cell=cell, dt="auto", low=(-0.1,) * 3, high=(0.1,) * 3, **arguments(form))
    middles = (x[:, 0].abs() < 0.6 * h).nonzero().squeeze(1)
    tips = (x[:, 0].abs() > LONG / 2 - 0.6 * h).nonzero().squeeze(1)
    rows: list[Row] = []
    seen, before = None, 0.0
    for end in ends:
        with torch.no_grad():
            seen = simulator(
                bar,
                duration=end - before,
                gravity=(0.0, 0.0, 0.0),
                loads=loads,
                probes=torch.arange(len(x)),
                sample_every=end - before,
                start=seen,
            )
        before = end
        place = seen.position[-1] @ turned
        deflection = float(place[middles, 2].mean() - place[tips, 2].mean())
        heights = (torch.arange(across, dtype=EXACT) + 0.5) * h - TALL / 2
        gaps = place.reshape(along, across, across, 3).diff(dim=0).norm(dim=-1) / h
        stretch = (_gradient(form, bar, cell, seen.final[0]) @ turned[:, 0]).norm(dim=-1)
        stretch = stretch.reshape(along, across, across)
        rows.append({"form": form, "cells": cells, "turned [deg]": math.degrees(turn), "time [s]": end})
        rows[-1] |= {"deflection [mm]": 1e3 * deflection, "positions' curvature [1/m]": _curvature(gaps, heights)}
        rows[-1] |= {"that of F [1/m]": _curvature((stretch[1:] + stretch[:-1]) / 2, heights)}
    return rows


def creep(
    cases: Sequence[tuple[str, int, float]] = (
        ("total", 3, 0.0),
        ("apic", 3, 0.0),
        ("flip", 3, 0.0),
        ("apic", 5, 0.0),
        ("apic", 3, math.pi / 4),
    ),
    force: float = 0.25,
    ends: Sequence[float] = (0.1, 0.3, 1.2),
) -> list[Row]:
    """Bars that are held bent by a force [N], by form, cells across and turn of the bar against the grid [rad]."""
    return [row for form, cells, turn in cases for row in held(form, cells, force=force, ends=ends, turn=turn)]
