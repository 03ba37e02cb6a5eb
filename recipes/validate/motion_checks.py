"""Free flight, viscoelasticity and the largest stable step; ``simulator.py`` prints them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import torch
from structures import EXACT, FORMS, arguments, block
from tables import Row

from torchsoro import Body, Prony, SimulationDiverged, Simulator, Solid, ground
from torchsoro.simulation.formulation import formulation_of
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.state import total_state
from torchsoro.simulation.stability import courant, stable_step

PAPER_CELL, PAPER_STEP = 1.75e-3, 1e-5


class Unchecked(Simulator):
    """A simulator that takes any time step."""

    def step(self, body: Body, prony: Prony | None, **how: Any) -> float:
        """The step asked for."""
        assert self.dt != "auto"
        return self.dt


def rheology(
    cases: Sequence[tuple[int, float]] = ((3, PAPER_STEP), (5, PAPER_STEP), (5, 0.8 * PAPER_STEP)),
    omegas: Sequence[float] = (1, 1e1, 1e2, 1e3, 1e4),
) -> list[Row]:
    """Storage and loss modulus of H <- a H + b dS, over the equilibrium modulus, against Eq. 17.

    The steady response of the recursion to exp(i omega t) is sum_i g_i b_i (1 - 1/z) / (1 - a_i / z), z = exp(i omega
    dt). Elements faster than a step act as dashpots with a lag of half a step, which affects the storage modulus first.
    """
    rows = []
    for count, dt in cases:
        prony = Prony.paper(count)
        a, b, g = prony.discrete(dt).unbind(-1)
        for omega in omegas:
            back = torch.exp(torch.tensor(-1j * omega * dt, dtype=torch.complex128))
            found = complex(1 + (g * b * (1 - back) / (1 - a * back)).sum())
            storage, loss = (float(m) for m in prony.storage_loss(torch.tensor(float(omega), dtype=EXACT)))
            rows.append({"elements": count, "dt [us]": dt * 1e6, "omega [rad/s]": float(omega)})
            rows[-1] |= {"G'": found.real, "Eq. 17a": storage, "G' error [%]": 100 * (found.real / storage - 1)}
            rows[-1] |= {'G"': found.imag, "Eq. 17b": loss, 'G" error [%]': 100 * (found.imag / loss - 1)}
    return rows


def moving(body: Body, gradient: torch.Tensor, elements: int = 0) -> torch.Tensor:
    """Initial state of the updated formulation with a given velocity gradient [3, 3] of the particles."""
    state = torch.zeros(1, layout.state_components(elements), body.position.shape[0], dtype=EXACT)
    state[0, layout.POSITION : layout.VELOCITY] = body.position.T
    state[0, layout.VELOCITY : layout.AFFINE] = gradient @ (body.position - body.position.mean(0)).T
    state[0, layout.AFFINE : layout.DEFORMATION] = gradient.reshape(9, 1)
    state[0, layout.DEFORMATION : layout.HISTORY] = torch.eye(3, dtype=EXACT).reshape(9, 1)
    return state


def ramp(
    elements: int = 5,
    steps: int = 30_000,
    dt: float = PAPER_STEP,
    forms: Sequence[str] = ("apic", "total"),
) -> list[Row]:
    """The kernel's history in steady simple shear: H_xy = rate tau (1 - exp(-t / tau)).

    The density is large enough for the stress not to change the motion. The total formulation stores Z = H - b S.
    """
    rate, prony = torch.zeros(3, 3, dtype=EXACT), Prony.paper(elements)
    rate[0, 1] = 1e-3
    rows = []
    for form in forms:
        body = block((4, 4, 4), PAPER_CELL, (0, 0, 0), Solid(density=1e20))
        arm = body.position - body.position.mean(0)
        simulator = Simulator(cell=PAPER_CELL, dt=dt, low=(-0.02,) * 3, high=(0.03,) * 3, **arguments(form))
        with torch.no_grad():
            seen = simulator(
                dataclasses.replace(body, velocity=arm @ rate.T),
                duration=steps * dt,
                prony=prony,
                gravity=(0.0, 0.0, 0.0),
                start=None if form == "total" else moving(body, rate, elements),
            )
        if form == "total":
            sheared = float(rate[0, 1]) * steps * dt
            kept = seen.final[0, -6 * elements * len(arm) :].reshape(elements, 6, -1)[:, 3]
            history = kept + prony.discrete(dt)[:, 1:2] * sheared * (1 + sheared**2 / 3)
        else:
            history = seen.final[0, layout.HISTORY :].reshape(elements, 6, -1)[:, 3]
        for tau, found in zip(prony.times.tolist(), history, strict=True):
            exact = float(rate[0, 1]) * tau * -math.expm1(-steps * dt / tau)
            rows.append({"form": form, "tau [s]": tau, "H_xy": float(found.mean()), "exact": exact})
            rows[-1]["error [%]"] = 100 * float((found / exact - 1).abs().max())
    return rows


def grows(count: int, dt: float, *, form: str, solid: Solid, speed: float = 0.0, steps: int = 2000) -> bool:
    """Whether the energy of velocity noise (1 mm/s) in a cube of 5 cells grows tenfold, or its impact fails.

    Without losses, part of the noise that is initially resolved only by the nodes moves to the particles, so that
    growth below a factor of ten does not indicate instability.
    """
    corner = (0.0, 0.0, 0.5 * PAPER_CELL) if speed else tuple(c * PAPER_CELL for c in (0.11, 0.27, 0.41))
    body = block((10, 10, 10), PAPER_CELL, corner, solid)
    velocity = 1e-3 * torch.randn(body.position.shape, generator=torch.Generator().manual_seed(0), dtype=EXACT)
    velocity[:, 2] -= speed
    simulator = Unchecked(cell=PAPER_CELL, dt=dt, low=(-0.03,) * 3, high=(0.06,) * 3, **arguments(form))
    steps = min(steps, math.ceil(8e-3 / dt)) if speed else steps
    try:
        with torch.no_grad():
            seen = simulator(
                dataclasses.replace(body, velocity=velocity),
                duration=steps * dt,
                prony=Prony.paper(count) if count else None,
                gravity=(0.0, 0.0, 0.0),
                planes=[ground()] if speed else [],
                sample_every=steps * dt,
                probes=torch.arange(1000),
            )
    except SimulationDiverged:
        return True
    return not bool((seen.velocity[-1] ** 2).sum() < 10 * (seen.velocity[0] ** 2).sum())


def stability(
    cases: Sequence[tuple[int, float]] = ((0, 0.4), (3, 0.4), (4, 0.4), (5, 0.4), (0, 0.0), (5, 0.0), (0, 0.49)),
    forms: Sequence[str] = FORMS,
    *,
    steps: int = 1500,
) -> list[Row]:
    """Largest step without growth of noise, and largest step for an impact at 4 m/s, with the paper's cell.

    Two Courant numbers at the limit are given: that of pressure waves with the stiffness mu (1 + sum g_i b_i) of one
    step; and that of ``torchsoro.simulation.stability.courant``, with the stiffness of the elements at the highest
    resolved frequency, where instability starts. The latter is 1 in the updated formulation, and at least 1 in the
    total formulation, where it is a bound for any density distribution.
    """
    rows = []
    for form in forms:
        for count, nu in cases:
            solid, prony = Solid(poisson_ratio=nu), Prony.paper(count)
            body = block((2, 2, 2), PAPER_CELL, (0, 0, 0), solid)
            formulation = formulation_of(**{"formulation": "updated", **arguments(form)})
            expected = stable_step(body, prony, cell=PAPER_CELL, formulation=formulation)
            limits = []
            for speed in (0.0, 4.0):
                low, high = 0.25 * expected, 2.5 * expected
                while high > 1.01 * low:
                    middle = math.sqrt(low * high)
                    bad = grows(count, middle, form=form, solid=solid, speed=speed, steps=steps)
                    low, high = (low, middle) if bad else (middle, high)
                limits.append(low)
            _, b, g = prony.discrete(limits[0]).unbind(-1)
            pressure_wave = math.sqrt((solid.bulk + 4 / 3 * solid.shear * (1 + float((g * b).sum()))) / solid.density)
            found = courant(body, prony, dt=limits[0], cell=PAPER_CELL, formulation=formulation)
            rows.append(
                {
                    "form": form,
                    "elements": count,
                    "nu": nu,
                    "limit [us]": limits[0] * 1e6,
                    "Courant": pressure_wave * limits[0] / PAPER_CELL,
                    "package's": found.number,
                    "limit at 4 m/s [us]": limits[1] * 1e6,
                }
            )
    return rows


def fall(steps: int = 2000, dt: float = 2e-5, forms: Sequence[str] = FORMS) -> list[Row]:
    """Free flight of a spinning cube: errors of path and momentum and drift of angular momentum, over their size."""
    rows, spin = [], torch.tensor([[0.0, -8.0, -5.0], [8.0, 0.0, -3.0], [5.0, 3.0, 0.0]], dtype=EXACT)
    throw, pull = torch.tensor([[0.1, 0.0, 0.3], [0.0, 0.0, -9.81]], dtype=EXACT)
    for form in forms:
        body = block((8, 8, 8), PAPER_CELL, (0, 0, 0), Solid())
        lattice = Lattice.around(body.position, PAPER_CELL)
        if form == "total":
            velocity = (body.position - body.position.mean(0)) @ spin.T + throw
            everywhere = torch.ones(len(velocity), dtype=torch.bool)
            start = total_state(lattice, body.position[None], velocity[None], everywhere, 0)
        else:
            start = moving(body, spin)
            start[0, layout.VELOCITY : layout.AFFINE] += throw.unsqueeze(-1)
        simulator = Simulator(cell=PAPER_CELL, dt=dt, low=(-0.05,) * 3, high=(0.06,) * 3, **arguments(form))
        with torch.no_grad():
            seen = simulator(body, duration=steps * dt, gravity=pull, start=start)
        t, way = seen.time.unsqueeze(-1), seen.center_of_gravity - seen.center_of_gravity[0]
        path = throw * t + pull * t * (t + dt) / 2  # the parabola of the semi-implicit step
        if form == "total":
            before, after = (_nodal_angular_momentum(lattice, body.mass, state) for state in (start, seen.final))
        else:
            before, after = (_angular_momentum(state[0]) for state in (start, seen.final))
        rows.append(
            {
                "form": form,
                "path": float((way - path).abs().max() / path.abs().max()),
                "momentum": float((seen.center_velocity - throw - pull * t).abs().max() / throw.norm()),
                "angular momentum": float((after - before).norm() / before.norm()),
            }
        )
    return rows


def _angular_momentum(state: torch.Tensor) -> torch.Tensor:
    """About the mean position, for particles of mass 1: of their motion, and of their own spin (dx^2 / 4 skew C)."""
    x, v = state[layout.POSITION : layout.VELOCITY].T, state[layout.VELOCITY : layout.AFFINE].T
    C = state[layout.AFFINE : layout.DEFORMATION].reshape(3, 3, -1)
    own = torch.stack([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]], -1) * PAPER_CELL**2 / 4
    return (torch.linalg.cross(x - x.mean(0), v - v.mean(0)) + own).sum(0)


def _nodal_angular_momentum(lattice: Lattice, mass: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
    """About the centre of gravity, of the nodes of the total form."""
    moved, v = state[0, : 6 * lattice.nodes].view(2, 3, -1).transpose(1, 2)
    x, m = lattice.node_places + moved, lattice.nodal_mass(mass.unsqueeze(0))[0].unsqueeze(-1)
    return torch.linalg.cross(x - (m * x).sum(0) / m.sum(), m * v).sum(0)
