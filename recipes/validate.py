"""The simulator against closed forms, one table per check.

    python recipes/validate.py damping       # what the method adds to a cantilever: each transfer, step and cell
    python recipes/validate.py bar           # frequency of a cantilever and its order, against a Timoshenko beam
    python recipes/validate.py sphere        # pressurised thick sphere against Lame's solution
    python recipes/validate.py rheology      # Maxwell elements against Eq. 17, and in the kernel against a shear ramp
    python recipes/validate.py restitution   # rebound of a dropped block with 0, 3 and 5 Maxwell elements
    python recipes/validate.py stability     # the time step at which noise grows or an impact fails, by bisection
    python recipes/validate.py fall          # free flight: path, momentum, angular momentum
    python recipes/validate.py all --out runs/validation    # everything, with figures; about 15 minutes on two cores

The functions return their rows, so that tests call them on smaller settings.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import tyro
from structures import EXACT, Row, bar, block, damping, sphere

from torchsoro import Body, Prony, SimulationDiverged, Simulator, Solid, ground
from torchsoro.kernels import layout

PAPER_CELL, PAPER_STEP = 1.75e-3, 1e-5
Curve = tuple[int, float, np.ndarray, np.ndarray, np.ndarray]


class Unchecked(Simulator):
    """A simulator that takes any time step."""

    def check_step(self, body: Body, prony: Prony | None) -> None:
        """Refuse nothing."""


def rheology(
    cases: Sequence[tuple[int, float]] = ((3, PAPER_STEP), (5, PAPER_STEP), (5, 0.8 * PAPER_STEP)),
    omegas: Sequence[float] = (1, 1e1, 1e2, 1e3, 1e4),
) -> list[Row]:
    """Storage and loss modulus of H <- a H + b dS, over the equilibrium modulus, against Eq. 17.

    The recursion answers exp(i omega t) by sum_i g_i b_i (1 - 1/z) / (1 - a_i / z) in the end, z = exp(i omega dt).
    Elements faster than a step are viscous dampers that lag by half a step, which shows first in the storage modulus.
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
    """State to start from, whose particles know the velocity gradient [3, 3]; by itself a body starts with none."""
    state = torch.zeros(1, layout.state_components(elements), body.position.shape[0], dtype=EXACT)
    state[0, layout.POSITION : layout.VELOCITY] = body.position.T
    state[0, layout.VELOCITY : layout.AFFINE] = gradient @ (body.position - body.position.mean(0)).T
    state[0, layout.AFFINE : layout.DEFORMATION] = gradient.reshape(9, 1)
    state[0, layout.DEFORMATION : layout.HISTORY] = torch.eye(3, dtype=EXACT).reshape(9, 1)
    return state


def ramp(elements: int = 5, steps: int = 30_000, dt: float = PAPER_STEP) -> list[Row]:
    """The kernel's history in steady simple shear: H_xy = rate tau (1 - exp(-t / tau)).

    The block is too heavy to mind its stress, so that it moves as it started.
    """
    rate, prony = torch.zeros(3, 3, dtype=EXACT), Prony.paper(elements)
    rate[0, 1] = 1e-3
    body = block((4, 4, 4), PAPER_CELL, (0, 0, 0), Solid(density=1e20))
    simulator = Simulator(cell=PAPER_CELL, dt=dt, low=(-0.02,) * 3, high=(0.03,) * 3)
    start = moving(body, rate, elements)
    with torch.no_grad():
        seen = simulator(body, duration=steps * dt, prony=prony, gravity=(0.0, 0.0, 0.0), start=start)
    history = seen.final[0, layout.HISTORY :].reshape(elements, 6, -1)[:, 3]
    rows = []
    for tau, found in zip(prony.times.tolist(), history, strict=True):
        exact = float(rate[0, 1]) * tau * -math.expm1(-steps * dt / tau)
        rows.append({"tau [s]": tau, "H_xy": float(found.mean()), "exact": exact})
        rows[-1]["error [%]"] = 100 * float((found / exact - 1).abs().max())
    return rows


def restitution(
    elements: Sequence[int] = (0, 3, 5), sizes: Sequence[int] = (4, 10), *, transfer: str = "apic", speed: float = 4.0
) -> tuple[list[Row], list[Curve]]:
    """Rebound of a cube dropped flat on a ground that sticks; cells and step are the paper's.

    Returns:
        Rows, and for each the elements, edge [mm], time [ms], height of the centre [mm] and its velocity [m/s].
    """
    rows, curves = [], []
    for size in sizes:
        for count in elements:
            begin = time.perf_counter()
            body = block((2 * size,) * 3, PAPER_CELL, (0, 0, PAPER_CELL / 2), Solid())
            down = torch.tensor([0.0, 0.0, -speed], dtype=EXACT).expand_as(body.position)
            room = 4 * size * PAPER_CELL
            simulator = Simulator(
                cell=PAPER_CELL, dt=PAPER_STEP, low=(-room,) * 3, high=(2 * room,) * 3, transfer=transfer
            )
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
                    "transfer": transfer,
                    "edge [mm]": edge,
                    "elements": count,
                    "restitution": float(velocity[-1] / speed),
                    "least height [%]": 100 * float(height.min() / height[0]),
                    "seconds": time.perf_counter() - begin,
                }
            )
            curves.append((count, edge, seen.time.numpy() * 1e3, height * 1e3, velocity))
    return rows, curves


def grows(count: int, dt: float, *, transfer: str, solid: Solid, speed: float = 0.0, steps: int = 2000) -> bool:
    """Whether the noise (1 mm/s) of a cube of 5 cells grows, or its impact on the ground ends the run."""
    corner = (0.0, 0.0, 0.5 * PAPER_CELL) if speed else tuple(c * PAPER_CELL for c in (0.11, 0.27, 0.41))
    body = block((10, 10, 10), PAPER_CELL, corner, solid)
    velocity = 1e-3 * torch.randn(body.position.shape, generator=torch.Generator().manual_seed(0), dtype=EXACT)
    velocity[:, 2] -= speed
    simulator = Unchecked(cell=PAPER_CELL, dt=dt, low=(-0.03,) * 3, high=(0.06,) * 3, transfer=transfer)
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
    return not bool((seen.velocity[-1] ** 2).sum() < (seen.velocity[0] ** 2).sum())


def stability(
    cases: Sequence[tuple[int, float]] = ((0, 0.4), (3, 0.4), (4, 0.4), (5, 0.4), (0, 0.0), (5, 0.0), (0, 0.49)),
    transfers: Sequence[str] = ("apic", "flip"),
    *,
    steps: int = 2000,
) -> list[Row]:
    """Largest step at which noise does not grow, and at which a cube survives 4 m/s, in the paper's cell.

    Two Courant numbers at the limit: that of pressure waves with the stiffness mu (1 + sum g_i b_i) of one step; and
    "fitted", dt / dx [(1.4 K)^2 + (1.25 mu_z)^2]^(1/4) / sqrt(rho) with mu_z = mu (1 + sum g_i b_i 2 / (1 + a_i)), the
    stiffness at the highest frequency that a step resolves (z = -1), where instability sets in: it is 1 throughout.
    """
    rows = []
    for transfer in transfers:
        for count, nu in cases:
            solid = Solid(poisson_ratio=nu)
            limits = []
            for speed in (0.0, 4.0):
                low, high = 2e-6, 2e-4
                while high > 1.01 * low:
                    middle = math.sqrt(low * high)
                    bad = grows(count, middle, transfer=transfer, solid=solid, speed=speed, steps=steps)
                    low, high = (low, middle) if bad else (middle, high)
                limits.append(low)
            a, b, g = Prony.paper(count).discrete(limits[0]).unbind(-1)
            one_step, nyquist = (solid.shear * (1 + float(f.sum())) for f in (g * b, g * b * 2 / (1 + a)))
            pressure_wave = math.sqrt((solid.bulk + 4 / 3 * one_step) / solid.density)
            fitted = math.sqrt(math.hypot(1.4 * solid.bulk, 1.25 * nyquist) / solid.density)
            rows.append(
                {
                    "transfer": transfer,
                    "elements": count,
                    "nu": nu,
                    "limit [us]": limits[0] * 1e6,
                    "Courant": pressure_wave * limits[0] / PAPER_CELL,
                    "fitted": fitted * limits[0] / PAPER_CELL,
                    "limit at 4 m/s [us]": limits[1] * 1e6,
                }
            )
    return rows


def fall(steps: int = 2000, dt: float = 2e-5) -> list[Row]:
    """Free flight of a spinning cube: errors of path and momentum and drift of angular momentum, over their size."""
    rows, spin = [], torch.tensor([[0.0, -8.0, -5.0], [8.0, 0.0, -3.0], [5.0, 3.0, 0.0]], dtype=EXACT)
    throw, pull = torch.tensor([[0.1, 0.0, 0.3], [0.0, 0.0, -9.81]], dtype=EXACT)
    for transfer in ("apic", "flip"):
        body = block((8, 8, 8), PAPER_CELL, (0, 0, 0), Solid())
        simulator = Simulator(cell=PAPER_CELL, dt=dt, low=(-0.05,) * 3, high=(0.06,) * 3, transfer=transfer)
        start = moving(body, spin)
        start[0, layout.VELOCITY : layout.AFFINE] += throw.unsqueeze(-1)
        with torch.no_grad():
            seen = simulator(body, duration=steps * dt, gravity=pull, start=start)
        t, way = seen.time.unsqueeze(-1), seen.center_of_gravity - seen.center_of_gravity[0]
        path = throw * t + pull * t * (t + dt) / 2  # the parabola of the semi-implicit step
        before, after = _angular_momentum(start[0]), _angular_momentum(seen.final[0])
        rows.append(
            {
                "transfer": transfer,
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


def show(title: str, rows: Sequence[Row]) -> None:
    """Print rows as a table."""
    cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    names = list(rows[0])
    widths = [max(map(len, column)) for column in zip(names, *cells, strict=True)]
    print(f"\n{title}")
    for line in (names, ["-" * w for w in widths], *cells):
        print("  ".join(text.rjust(w) for text, w in zip(line, widths, strict=True)), flush=True)


def _figure(path: Path, panels: Sequence[tuple[str, str]]) -> tuple[Any, list[Any]]:
    figure, axes = plt.subplots(1, len(panels), figsize=(4.6 * len(panels), 3.6), layout="constrained", squeeze=False)
    for axis, (x, y) in zip(axes[0], panels, strict=True):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    return lambda: (figure.savefig(path, dpi=150), plt.close(figure), print(f"wrote {path}")), list(axes[0])


def draw_restitution(path: Path, curves: Sequence[Curve]) -> None:
    """Velocity of the centre of gravity; one panel for each size of cube."""
    edges = sorted({c[1] for c in curves})
    save, axes = _figure(path, [("time [ms]", "velocity of the centre of gravity [m/s]")] * len(edges))
    for axis, edge in zip(axes, edges, strict=True):
        for count, _, t, _, velocity in (c for c in curves if c[1] == edge):
            axis.plot(t, velocity, label=f"{count} elements: {-velocity[-1] / velocity[0]:.2f}")
        axis.axhline(0, color="k", lw=0.6)
        axis.legend(title=f"{edge:.3g} mm cube, restitution", loc="lower right")
    save()


def draw_rheology(path: Path) -> None:
    """Moduli of the recursion (dots) on Eq. 17 (lines)."""
    save, axes = _figure(
        path, [("omega [rad/s]", "storage modulus / equilibrium"), ("omega [rad/s]", "loss modulus / equilibrium")]
    )
    omega = torch.logspace(0, 4, 200, dtype=EXACT)
    for i, count in enumerate((3, 5)):
        rows = rheology([(count, PAPER_STEP)], torch.logspace(0, 4, 17).tolist())
        for axis, line, column in zip(axes, Prony.paper(count).storage_loss(omega), ("G'", 'G"'), strict=True):
            axis.loglog(omega, line, color=f"C{i}", lw=1, label=f"Eq. 17, {count} elements")
            axis.plot(
                [r["omega [rad/s]"] for r in rows],
                [r[column] for r in rows],
                "o",
                ms=4,
                color=f"C{i}",
                label="recursion, dt = 10 us",
            )
            axis.legend(fontsize="small")
    save()


def draw_bar(path: Path, rows: Sequence[Row]) -> None:
    """Frequency over the number of cells."""
    save, (axis,) = _figure(path, [("cells across", "frequency / Timoshenko")])
    for i, nu in enumerate(sorted({r["nu"] for r in rows})):
        mine = [r for r in rows if r["nu"] == nu]
        axis.plot(
            [r["cells"] for r in mine],
            [1 + r["error [%]"] / 100 for r in mine],
            "o-",
            color=f"C{i}",
            label=f"nu = {nu}",
        )
    axis.axhspan(0.97, 1.03, color="k", alpha=0.07, label="3 %")
    axis.set_xticks(sorted({r["cells"] for r in rows}))
    axis.legend(fontsize="small")
    save()


Check = Literal["damping", "bar", "sphere", "rheology", "restitution", "stability", "fall", "all"]


def main(check: tyro.conf.Positional[Check], out: Path | None = None) -> None:
    """Validate the simulator against closed forms.

    Args:
        check: What to validate.
        out: Folder for figures; none are drawn without it.
    """
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)

    def wanted(name: str) -> bool:
        return check in (name, "all")

    if wanted("fall"):
        show("Free flight of a spinning cube, 40 ms: relative errors", fall())
    if wanted("rheology"):
        show("Moduli of the discrete Maxwell elements, over the equilibrium modulus, against Eq. 17", rheology())
        show("History in the kernel after 0.3 s of steady shear", ramp())
        if out is not None:
            draw_rheology(out / "rheology.png")
    if wanted("sphere"):
        show("Thick sphere, 200 Pa, against Lame", sphere())
    if wanted("restitution"):
        rows, curves = restitution()
        show("Cube dropped at 4 m/s, cell 1.75 mm, dt = 10 us", rows)
        if out is not None:
            draw_restitution(out / "restitution.png", curves)
    if wanted("bar"):
        rows, orders = bar()
        show("Cantilever 100 x 20 x 20 mm, flip, against a Timoshenko beam", rows)
        print("\n".join(f"order of the error for nu = {nu:g}: {order:.2f}" for nu, order in orders.items()))
        if out is not None:
            draw_bar(out / "bar.png", rows)
    if wanted("stability"):
        show("Largest stable step, cell 1.75 mm", stability())
    if wanted("damping"):
        show("Damping ratio of an elastic cantilever 100 x 30 x 30 mm, 264 kPa (true: 0)", damping())


if __name__ == "__main__":
    tyro.cli(main)
