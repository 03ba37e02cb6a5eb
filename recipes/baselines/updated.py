"""Simulate the setups of experiments by the updated formulation, as simulated.csv for explain.py.

    python recipes/baselines/updated.py my-experiment another-experiment
    python recipes/explain.py my-experiment --out runs/explained     # what is missing from *that* simulation

Writes ``simulated.csv`` into each folder of ``trials``. explain.py then compares the recordings with this simulation,
its discretization error included, instead of its own twin: a test of how much the formulation matters.
For boxes without chambers, clamped at whole faces, and planes along the axes. Trials that are believed to be the same
are simulated once, in however many experiments they are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from scipy.spatial import KDTree

from torchsoro import Body, Domain, Force, Plane, Prony, Simulator, Solid, fill
from torchsoro.command_line import plain_errors
from torchsoro.sim2real.data.experiment import Setup, read_experiment
from torchsoro.sim2real.data.recording import write_table
from torchsoro.sim2real.data.schema import ForceTable
from torchsoro.sim2real.twin.twin import Twin

FINE = 1e-3  # s, between samples
BEHIND = 2  # cells of body behind a clamped face, whose nodes adhesive planes hold
HELD = 1e12  # Pa, adhesion of those planes: more than any traction
AROUND = 27  # particles, from whose motion a marker's is interpolated
SWITCH = 1e-6  # s, duration of a jump of a force
MOST = 80  # particles across the shortest edge


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What to simulate, and how."""

    experiments: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders."""
    cells: int = 3
    """Across the shortest edge, at least; as many more as a lattice needs that fits all edges."""
    transfer: Literal["apic", "flip"] = "apic"
    """The paper's, or the one that hardly damps."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute."""


def lattice(setup: Setup, cells: int) -> float:
    """Spacing of particles [m] that divides all edges.

    Raises:
        ValueError: if there is none.
    """
    for count in range(2 * cells, MOST + 1):
        spacing = min(setup.size) / count
        if all(abs(edge / spacing - round(edge / spacing)) < 1e-6 for edge in setup.size):
            return spacing
    raise ValueError(f"[body]: size = {setup.size}, wanted edges that a lattice of at most {MOST} particles divides")


def body_of(setup: Setup, spacing: float, faces: Sequence[tuple[int, int]], device: str) -> tuple[Domain, Body]:
    """Particles, also behind clamped faces, and their lattice."""
    before, after = ([float(BEHIND * 2 * ((a, side) in faces)) for a in range(3)] for side in (-1, 1))
    counts = [round(n / spacing + b + c) for n, b, c in zip(setup.size, before, after, strict=True)]
    x, y, z = (spacing * n for n in counts)
    low = [o - spacing * b for o, b in zip(setup.origin, before, strict=True)]
    domain = Domain(size=(x, y, z), particles=(counts[0], counts[1], counts[2]), origin=(low[0], low[1], low[2]))
    solid = Solid(youngs_modulus=setup.youngs_modulus, poisson_ratio=setup.poisson_ratio, density=setup.density)
    body = fill(domain, torch.ones(domain.count, device=device), solid=solid)
    center, velocity, spin = (
        body.position.new_tensor(v) for v in (setup.center, setup.velocity, setup.angular_velocity)
    )
    velocity = velocity + torch.linalg.cross(spin.expand_as(body.position), body.position - center)
    return domain, dataclasses.replace(body, velocity=velocity)


def force_of(load: ForceTable, x: torch.Tensor, spacing: float, lasts: float) -> Force:
    """A dead force on the particles of its box, or next to it.

    Raises:
        ValueError: if there are none.
    """
    low, high = (torch.tensor(corner, dtype=x.dtype) for corner in load.box)
    on = torch.nonzero(((x > low - spacing / 2) & (x < high + spacing / 2)).all(-1)).squeeze(-1)
    if not len(on):
        raise ValueError(f"[[load]]: box = {load.box}, wanted one that holds a part of the body")
    grown = load.start + max(load.ramp, SWITCH)
    end = min(load.end, grown + lasts)  # that of most is at infinity
    knots = (load.start, grown, end, end + SWITCH)
    time = sorted({0.0, *knots})
    share = torch.from_numpy(np.interp(time, knots, (0.0, 1.0, 1.0, 0.0)))
    value = share[:, None] * torch.tensor(load.force, dtype=torch.float64)
    return Force(particles=on, value=value, time=torch.tensor(time, dtype=torch.float64))


def planes_of(setup: Setup, cell: float, faces: Sequence[tuple[int, int]]) -> list[Plane]:
    """Ground, walls, and what holds the nodes behind clamped faces.

    Raises:
        ValueError: for a plane that is not along an axis.
    """
    found = []
    for axis, side in faces:
        face = setup.origin[axis] + setup.size[axis] * (side > 0)
        held = [face + side * i * cell for i in range(BEHIND + 1)]
        found += [Plane(axis=axis, side=-side, offset=offset, adhesion=HELD) for offset in held]
    for plane in setup.planes:
        (axis, *others) = np.flatnonzero(plane.normal)
        if others:
            raise ValueError(f"[[plane]]: normal = {plane.normal}, wanted one along x, y or z")
        side = 1 if plane.normal[axis] > 0 else -1
        found.append(Plane(axis=int(axis), side=side, offset=plane.point[axis], friction=plane.friction))
    return found


def around(x: torch.Tensor, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Particles [M, AROUND] next to markers at [M, 3], and shares with which what is linear among them is exact."""
    near = torch.from_numpy(KDTree(x.numpy()).query(at.numpy(), k=AROUND)[1])
    away = x[near] - at[:, None]
    linear = torch.cat([torch.ones_like(away[..., :1]), away / away.abs().amax((1, 2), keepdim=True)], -1)
    return near, torch.linalg.pinv(linear)[:, 0]


def simulate(setup: Setup, options: Options) -> dict[str, np.ndarray]:
    """Columns of simulated.csv.

    Raises:
        ValueError: for a setup that this recipe is not made for.
        SimulationDiverged: if the simulation breaks down.
    """
    twin = Twin(setup, edge=min(setup.size) / 2, walls=1)
    if len(twin.faces) < len(setup.clamps):
        raise ValueError("[[clamp]]: wanted whole faces of the body")
    spacing = lattice(setup, options.cells)
    domain, body = body_of(setup, spacing, twin.faces, options.device)
    x = body.position.cpu().double()
    near, shares = around(x, torch.tensor([m.at for m in setup.markers], dtype=torch.float64))
    far = 2 * max(setup.size)
    simulator = Simulator(
        cell=domain.cell,
        dt="auto",
        low=[float(c - far) for c in setup.center],
        high=[float(c + far) for c in setup.center],
        transfer=options.transfer,
    )
    pairs = torch.tensor(setup.prony, dtype=torch.float64).reshape(-1, 2)
    with torch.no_grad():
        motion = simulator(
            body,
            duration=math.ceil(setup.duration / FINE) * FINE,
            prony=Prony(moduli=pairs[:, 0], times=pairs[:, 1]),
            gravity=setup.gravity,
            planes=planes_of(setup, domain.cell, twin.faces),
            loads=[force_of(load, x, spacing, setup.duration) for load in setup.forces],
            sample_every=FINE,
            probes=near.reshape(-1),
        )
    moved = motion.position.cpu().double().reshape(len(motion.time), *near.shape, 3)
    place = (shares[..., None] * moved).sum(2).numpy()
    columns = {f"{m.name}_{a}_m": place[:, i, k] for i, m in enumerate(setup.markers) for k, a in enumerate("xyz")}
    return {"time_s": motion.time.cpu().double().numpy(), **columns}


def main(options: Options) -> int:
    """Write simulated.csv of all trials.

    Returns:
        How many simulations that took.

    Raises:
        ValueError: for an experiment that cannot be read, or not be simulated so.
        SimulationDiverged: if a simulation breaks down.
    """
    asked: dict[Path, Setup] = {}
    for folder in options.experiments:
        for trial in read_experiment(folder).trials:
            if trial.setup.chambers or trial.setup.surface is not None:
                raise ValueError(f"{folder}: wanted a box without chambers")
            # How it was recorded does not matter.
            setup = dataclasses.replace(trial.setup, title="", kind="mocap", axes=(), noise=None)
            asked[folder / "trials" / trial.name / "simulated.csv"] = setup
    known: dict[Setup, dict[str, np.ndarray]] = {}
    for path, setup in asked.items():
        if setup not in known:
            known[setup] = simulate(setup, options)
            print(f"{path.parent}: {len(known[setup]['time_s'])} samples", flush=True)
    for path, setup in asked.items():
        write_table(path, known[setup])
    return len(known)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Options, description=__doc__))
