"""What may have been left out of the body: stiffness, viscosity, mass, and what hangs on it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from torchsoro.loads import Drag, Force, Spring
from torchsoro.material import Prony
from torchsoro.sim2real.hypothesis import Hypothesis, Quantity
from torchsoro.sim2real.scenario import Scenario
from torchsoro.sim2real.twin import Twin


def solid_factor(twin: Twin, factor: Tensor) -> Tensor:
    """A factor [B] or [B, N] for particles of the solid, 1 for air."""
    wide = factor if factor.shape[-1:] == (twin.count,) else factor.unsqueeze(-1)
    return torch.where(twin.air, 1.0, wide)


class Modulus(Hypothesis):
    """The solid is stiffer or softer than believed."""

    name, seam = "modulus", "Young's modulus"
    quantities = (Quantity("ln_factor", "1", 0.1, -12.0, 12.0),)
    starts = ((1.0,), (-1.0,), (2.5,), (-2.5,), (5.0,), (-5.0,))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The factor."""
        return {"factor": (math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """E exp(a)."""
        return scenario.replace(stiffness=scenario.stiffness * solid_factor(twin, values[:, 0].exp()))


class Viscoelastic(Hypothesis):
    """A Maxwell element is missing."""

    name, seam = "viscoelastic", "Prony series"
    quantities = (
        Quantity("modulus_over_equilibrium", "1", 0.2, 0.0, 100.0),
        Quantity("ln_time", "ln s", 1.0, -9.0, 1.5),
    )
    starts = tuple((g, tau) for g in (1.0, 4.0) for tau in (-6.5, -5.0, -3.5, -1.5))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The element, and its viscosity."""
        g, tau = float(values[0]), math.exp(values[1])
        nu = float(scenario.poisson_ratio.reshape(-1)[0])
        mu = float(scenario.stiffness.max()) / (2 * (1 + nu))
        return {"modulus_over_equilibrium": (g, "1"), "time_s": (tau, "s"), "viscosity_pa_s": (mu * g * tau, "Pa s")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """One more element."""
        g, tau = values[:, :1], values[:, 1:2].exp()
        known = scenario.prony
        if known is not None:
            lead = (len(values),)
            g = torch.cat([known.moduli.expand(*lead, known.elements), g], -1)
            tau = torch.cat([known.times.expand(*lead, known.elements), tau], -1)
        return scenario.replace(prony=Prony(moduli=g, times=tau))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """As long as there is room for one."""
        return scenario.prony is None or scenario.prony.elements < 5


class Density(Hypothesis):
    """The solid is heavier or lighter than believed."""

    name, seam = "density", "density"
    quantities = (Quantity("ln_factor", "1", 0.1, -7.0, 10.0),)
    starts = ((1.0,), (-1.0,), (3.0,), (-3.0,))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The factor."""
        return {"factor": (math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Density times exp(a)."""
        return scenario.replace(density=scenario.density * solid_factor(twin, values[:, 0].exp()))


class PoissonRatio(Hypothesis):
    """The solid is more or less compressible than believed."""

    name, seam = "poisson_ratio", "Poisson ratio"
    quantities = (Quantity("change", "1", 0.03, -6.0, 3.0),)
    starts = ((1.0,), (-2.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Nu + a."""
        return scenario.replace(poisson_ratio=(scenario.poisson_ratio + values[:, 0]).clamp(0.0, 0.49))


class SoftSide(Hypothesis):
    """Young's modulus grows evenly across the body, along x, y and z."""

    name, seam = "soft_side", "Young's modulus over the body"
    quantities = tuple(Quantity(f"slope_{axis}", "1 over the body", 0.2, -5.0, 5.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The slopes, and what of the modulus is lost from the stiffest to the softest corner of the steepest axis."""
        lost = 1 - math.exp(-float(np.abs(values).max()))
        return {**super().told(values, scenario), "fraction": (lost, "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """E exp(a . xi), xi from -1/2 to 1/2 over the body's box."""
        low, size = (torch.tensor(v, dtype=torch.float64) for v in (twin.setup.origin, twin.setup.size))
        xi = ((twin.positions - low) / size - 0.5).clamp(-0.5, 0.5)
        return scenario.replace(stiffness=scenario.stiffness * solid_factor(twin, (values @ xi.T).exp()))


class AttachedMass(Hypothesis):
    """A point mass, with its weight, somewhere on the body."""

    name, seam, local = "attached_mass", "mass of the particles at a place", True
    quantities = (Quantity("mass_kg", "kg", 0.002, 0.0, 1000.0),)
    starts = ((0.5,), (1.5,), (4.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Mass spread around the place."""
        share = shares(values[:, 1:], twin)
        return scenario.replace(density=scenario.density + values[:, :1] * share / twin.spacing**3)


class LoadInertia(Hypothesis):
    """A load that was taken for a dead force is a mass: it has inertia, too."""

    name, seam = "load_inertia", "mass of the particles under a load"
    quantities = (Quantity("share", "1", 0.2, 0.0, 7.5),)
    starts = ((1.0,), (2.5,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A share of the force becomes the weight of a mass."""
        density, loads = scenario.density, []
        size = scenario.gravity.norm(dim=-1).amax()
        for load in scenario.loads:
            if isinstance(load, Force) and load.share is not None:
                weight = torch.zeros(twin.count, dtype=torch.float64)
                weight[load.particles] = load.share
                mass = values[:, :1] * load.value.norm(dim=-1).amax() / size
                density = density + mass * weight / twin.spacing**3
                rest = (1 - values[:, 0]).reshape(-1, *[1] * load.value.ndim)
                load = dataclasses.replace(load, value=load.value * rest)
            loads.append(load)
        return scenario.replace(density=density, loads=tuple(loads))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a load."""
        return any(isinstance(load, Force) for load in scenario.loads)


class Tether(Hypothesis):
    """A spring and a dashpot hold a place of the body, as a tube does."""

    name, seam, local = "tether", "spring and drag at a place", True
    quantities = (
        Quantity("stiffness_n_m", "N/m", 2.0, 0.0, 1000.0),
        Quantity("damping_n_s_m", "N s/m", 0.05, 0.0, 1000.0),
    )
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Attached at the place in the undeformed body."""
        share, everyone = shares(values[:, 2:], twin), torch.arange(twin.count)
        spring = Spring(particles=everyone, stiffness=values[:, 0], share=share)
        dashpot = Drag(particles=everyone, coefficient=values[:, 1], share=share)
        return scenario.replace(loads=(*scenario.loads, spring, dashpot))


def shares(places: Tensor, twin: Twin) -> Tensor:
    """What is at places [B, 3] m, over the particles [B, N], sums of 1."""
    found = torch.zeros(len(places), twin.count, dtype=torch.float64)
    for row, place in enumerate(places.detach().double()):
        group, share = twin.around(place)
        found[row, group] = share
    return found
