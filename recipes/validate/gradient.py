"""The gradient of a walker's travel against central differences, along smooth random directions.

    python recipes/validate/gradient.py                       # coarse, on a laptop
    python recipes/validate/gradient.py --preset paper --after 10  # 64,000 particles, a partly optimised design

The body is inflated from rest on the ground. A central difference requires a motion smooth over the perturbation. With
sticking contact L jumps where a foot sticks or slips a substep earlier; therefore feet slide (``--friction``) and air
enters slowly (``--rise``). Small perturbations are limited by float32 rounding, so the table covers a range of sizes.
"spread" is the deviation of L at the centre from the line through both ends, over the difference of the ends: large for
a motion that is not smooth. "mean" is the mean gradient over the perturbation by Simpson's rule, which a central
difference also equals for curved L.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

from torchsoro.design.presets import WALKER
from torchsoro.design.robot import Robot, walker
from torchsoro.design.settings import Settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Compare the gradient of a walker's travel with central differences along smooth random directions."""

    preset: Literal["desk", "paper"] = "desk"
    """Size of the walker."""
    formulation: Literal["total", "updated"] = "total"
    """Formulation of the simulator."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device; auto selects CUDA if available."""
    friction: Literal["stick"] | float = 0.5
    """Coulomb coefficient of the ground; with "stick" travel jumps where a foot sticks or slips a substep earlier."""
    settle: float = 0.05
    """Time at rest [s]."""
    duration: float = 0.1
    """Time of actuation [s]."""
    rise: float = 0.06
    """Time constant of filling [s]; short values cause contact chatter."""
    after: int = 0
    """Preceding design iterations, with travel as the only objective."""
    directions: int = 3
    """Number of random directions."""
    sizes: tuple[float, ...] = (0.1, 0.03, 0.01, 0.003, 0.001)
    """Amplitudes of the perturbation of the design field."""


def smooth(robot: Robot, seed: int) -> Tensor:
    """Random direction of the design field with wavelengths of the body size and amplitude at most 1."""
    g = torch.Generator().manual_seed(seed)
    x = robot.domain.positions / robot.domain.size[0]
    waves = [
        math.sin(phase) + torch.sin(2 * math.pi * (x @ k) + phase)
        for k, phase in (
            (torch.randn(3, generator=g, dtype=torch.float64), float(6.28 * torch.rand(1, generator=g)))
            for _ in range(4)
        )
    ]
    direction = torch.stack(waves).sum(0)
    phi = robot.field.phi
    return robot.domain.lattice(direction / direction.abs().max()).to(phi)


def rows(settings: Settings, options: Options) -> list[dict[str, Any]]:
    """Rows of the table, one for each direction and size."""
    robot = walker(settings)
    phi = robot.field.phi
    with torch.no_grad():
        phi.copy_(0.5 * smooth(robot, 100) + 0.2)
    adam = torch.optim.Adam([phi], lr=settings.learning_rate)
    for _ in range(options.after):
        adam.zero_grad()
        (-robot(robot.field()).travel / robot.domain.cell).backward()
        adam.step()
        robot.field.clamp_()
    phi.grad = None
    start = phi.detach().clone()

    def travel(step: Tensor) -> tuple[float, Tensor]:
        with torch.no_grad():
            phi.copy_(start + step)
        found = robot(robot.field()).travel
        (by_phi,) = torch.autograd.grad(found, phi)
        return float(found), by_phi

    middle, gradient = travel(torch.zeros_like(start))
    table = []
    for seed in range(options.directions):
        direction = smooth(robot, seed)
        exact = float((gradient * direction).sum())
        for size in options.sizes:
            (up, by_up), (down, by_down) = travel(size * direction), travel(-size * direction)
            found = (up - down) / (2 * size)
            mean = float(((by_up + 4 * gradient + by_down) / 6 * direction).sum())
            table.append(
                {
                    "direction": seed,
                    "size": size,
                    "central difference [mm]": 1e3 * found,
                    "gradient [mm]": 1e3 * exact,
                    "error [%]": 100 * (exact / found - 1),
                    "mean [mm]": 1e3 * mean,
                    "its error [%]": 100 * (mean / found - 1),
                    "spread": abs(up + down - 2 * middle) / abs(up - down),
                }
            )
    return table


def main(options: Options) -> list[dict[str, Any]]:
    """Print the table; returns it."""
    preset = WALKER[options.preset]
    settings = dataclasses.replace(
        preset,
        out=Path("runs/gradient"),
        device=options.device,
        formulation=options.formulation,
        friction=options.friction,
        settle=options.settle,
        duration=options.duration,
        rise=options.rise,
    )
    table = rows(settings, options)
    print("  ".join(table[0]))
    for row in table:
        print("  ".join(f"{value:{len(name)}.4g}" for name, value in row.items()), flush=True)
    return table


if __name__ == "__main__":
    main(tyro.cli(Options))
