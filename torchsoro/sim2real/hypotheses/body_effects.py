"""Effects of the body: stiffness, viscosity, mass, and what hangs on it."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.hypotheses.hypothesis import LAW, Hypothesis, Quantity, Simpler
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.hanging import pull_at_rest
from torchsoro.simulation.loads import Chain, Drag, Force, Load, PointMass, Spring
from torchsoro.simulation.material import Prony

TUBE = 3000.0  # 1/s2, stiffness of a taut tube over its mass: waves of 5 m/s in one of 0.1 m
MOVED = 4e-3  # m, to both sides, over which the stiffness of a hanging tube is told
LOSS = 0.5  # of critical damping, in a link of a tube
HALF_WIDTH = 0.1  # half the width of what lies between two parts of a body that was cast in two, over its size


class Modulus(Hypothesis):
    """The solid is stiffer or softer than believed."""

    name, affected_quantity = "modulus", "Young's modulus"
    ratios = frozenset({"factor"})
    quantities = (Quantity("ln_factor", "1", 0.1, -12.0, 12.0),)
    starts = ((1.0,), (-1.0,), (2.5,), (-2.5,), (5.0,), (-5.0,))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """The factor."""
        return {"factor": (math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """E exp(a)."""
        return scenario.replace(youngs_modulus=scenario.youngs_modulus * values[:, :1].exp())


class Viscoelastic(Hypothesis):
    """A Maxwell element is missing."""

    name, affected_quantity, model_form_deviation = "viscoelastic", "Prony series", LAW
    ratios, nonnegative = frozenset({"time_s"}), frozenset({"viscosity_pa_s"})
    quantities = (
        Quantity("modulus_over_equilibrium", "1", 0.2, 0.0, 100.0),
        Quantity("ln_time", "ln s", 1.0, -9.0, 1.5),
    )
    starts = tuple((g, tau) for g in (1.0, 4.0) for tau in (-6.5, -5.0, -3.5, -1.5))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """The element, and its viscosity."""
        g, tau = float(values[0]), math.exp(values[1])
        nu = float(scenario.poisson_ratio.reshape(-1)[0])
        mu = float(scenario.youngs_modulus.max()) / (2 * (1 + nu))
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


class Stiffening(Hypothesis):
    """The solid stiffens with stretch: mu (1 + a x + a^2 x^2), x = I1b - 3, the first terms of Gent's 1 / (1 - a x)."""

    name, affected_quantity, model_form_deviation = "stiffening", "stress at large strain", LAW
    quantities = (Quantity("coefficient", "1", 0.3, 0.0, 30.0),)
    starts = ((1.0,), (3.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """With both terms."""
        return scenario.replace(stiffening=scenario.stiffening + torch.cat([values, values**2], -1))


class Softening(Hypothesis):
    """Stress is lower below the largest stretch so far (Mullins), by the law of Ogden and Roxburgh (1999)."""

    name, affected_quantity, model_form_deviation = "softening", "stress below the largest stretch so far", LAW
    quantities = (Quantity("depth", "1", 0.1, 0.0, 9.0), Quantity("ln_range", "ln of I1b - 3", 1.0, -8.0, 1.0))
    starts = tuple((d, r) for d in (1.0, 3.0) for r in (-7.0, -5.0, -3.0))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Depth and range."""
        return scenario.replace(softening=torch.stack([values[:, 0], values[:, 1].exp()], -1))


class Density(Hypothesis):
    """The solid is heavier or lighter than believed."""

    name, affected_quantity, model_form_deviation = "density", "density", 0.1
    ratios = frozenset({"factor"})
    quantities = (Quantity("ln_factor", "1", 0.1, -7.0, 10.0),)
    starts = ((1.0,), (-1.0,), (3.0,), (-3.0,))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """The factor."""
        return {"factor": (math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Density times exp(a)."""
        return scenario.replace(density=scenario.density * values[:, :1].exp())


class SoftSide(Hypothesis):
    """Young's modulus grows evenly across the body, along x, y and z."""

    name, affected_quantity, model_form_deviation = "soft_side", "Young's modulus over the body", LAW
    nonnegative = frozenset({"fraction"})
    quantities = tuple(Quantity(f"slope_{axis}", "over the body", 0.2, -10.0, 10.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True
    contrast = 2 / 3  # of ln E over the body, that a soft half lacks which moves nearly the same

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """What ln E gains over the body, and the fraction of E that the soft part lacks, or one that moves it alike."""
        lost = 1 - math.exp(-self.contrast * float(np.abs(values[:3]).max()))
        return {**super().reported(values, scenario, twin), "fraction": (lost, "1")}

    def place(self, values: np.ndarray, twin: Twin) -> np.ndarray | None:
        """Middle of the soft half."""
        most = int(np.abs(values[:3]).argmax())
        middle = np.array(twin.setup.center)
        middle[most] -= self.middle_off(float(np.sign(values[most])), values) * twin.setup.size[most]
        return middle

    def middle_off(self, side: float, values: np.ndarray) -> float:
        """How far the middle of the soft half lies off the body's, over its size, towards its side, -1 or 1."""
        return 0.27 * side

    def varies(self, values: np.ndarray) -> float:
        """At the stiffest corner."""
        return 0.5 * float(np.abs(values[:3]).sum())

    def profile(self, xi: Tensor, values: Tensor) -> Tensor:
        """What ln E gains by each component [..., N, 3], from -1/2 to 1/2, where xi [N, 3] does so over the body."""
        return xi

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """E exp(a . profile(xi)), a the first three quantities."""
        low, size = (torch.tensor(v, dtype=torch.float64) for v in (twin.setup.origin, twin.setup.size))
        gained = (self.profile((twin.positions - low) / size - 0.5, values) * values[:, None, :3]).sum(-1)
        return scenario.replace(youngs_modulus=scenario.youngs_modulus * gained.exp())


class SoftPart(SoftSide):
    """Young's modulus is lower in one part of the body, up to a plane across x, y or z."""

    quantities = (
        *(Quantity(f"contrast_{axis}", "between parts", 0.2, -10.0, 10.0) for axis in "xyz"),
        Quantity("boundary", "of the body", 0.05, -8.0, 8.0),  # off the middle
    )
    starts = tuple((*direction, 0.0) for direction in SoftSide.starts)
    contrast = 1.0

    def middle_off(self, side: float, values: np.ndarray) -> float:
        """Halfway between the boundary and the end."""
        return 0.25 * side - float(values[3]) / 2

    def profile(self, xi: Tensor, values: Tensor) -> Tensor:
        """A smooth step at the boundary."""
        return torch.tanh((xi - values[:, 3, None, None]) / HALF_WIDTH) / 2


class PrintOffset(Hypothesis):
    """The chamber lies off its place across the body: walls on one side are thicker, on the other thinner."""

    name, affected_quantity = "print_offset", "thickness of the walls"
    quantities = tuple(Quantity(f"offset_{i}_m", "m", 3e-4, -10.0, 10.0) for i in ("first", "second"))
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Stiffness and mass of walls grow with their thickness, the shape stays."""
        s, x = twin.setup, twin.positions
        longest = int(np.argmax(s.size))
        factor = torch.ones(len(values), twin.count, dtype=torch.float64)
        for k, axis in enumerate(a for a in range(3) if a != longest):
            low = min(c.box[0][axis] for c in s.chambers)
            high = max(c.box[1][axis] for c in s.chambers)
            begin, end = low - s.origin[axis], s.origin[axis] + s.size[axis] - high
            shift = values[:, k : k + 1]
            below, above = (x[:, axis] < low).double(), (x[:, axis] > high).double()
            factor = factor * (1 + below * shift / begin - above * shift / end).clamp(min=0.1)
        return scenario.replace(youngs_modulus=scenario.youngs_modulus * factor, density=scenario.density * factor)

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AttachedMass(Hypothesis):
    """A point mass, with its weight, somewhere on the body."""

    name, affected_quantity, local, mass = "attached_mass", "mass at a place", True, 0
    quantities = (Quantity("mass_kg", "kg", 0.002, 0.0, 1000.0),)
    starts = ((2.0,), (6.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Mass at the place."""
        return scenario.plus(PointMass(share=twin.at(values[:, 1:]), mass=values[:, 0]))


class LoadInertia(Hypothesis):
    """A load that was taken for a dead force is a mass: it has inertia, too."""

    name, affected_quantity = "load_inertia", "mass under a load"
    quantities = (Quantity("share", "1", 0.2, 0.0, 7.5),)
    starts = ((1.0,), (2.5,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A share of the force becomes the weight of a mass."""
        size = scenario.gravity.norm(dim=-1).amax()
        masses, loads = [], []
        for load in scenario.loads:
            if not _stated(load):
                loads.append(load)
                continue
            mass = values[:, 0] * load.value.norm(dim=-1) / size
            masses.append(PointMass(share=load.share, mass=mass))
            loads.append(dataclasses.replace(load, value=load.value * (1 - values)))
        return scenario.replace(loads=(*loads, *masses))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With loads that are there from the start and point down, as weights do."""
        g = scenario.gravity.reshape(-1, 3)[0]
        stated = [load for load in scenario.loads if _stated(load)]
        down = [float(p.value @ g) > 0.99 * float(p.value.norm() * g.norm()) for p in stated]
        return bool(down) and all(down) and all(p.start == 0 for p in stated)


def _stated(load: Load) -> TypeGuard[Force]:
    """Whether it is a dead force of a setup: one of another effect has a value for each variation."""
    return isinstance(load, Force) and load.value.ndim == 1


class Tether(Hypothesis):
    """A spring, a dashpot and a mass at a place of the body, as a tube is."""

    name, affected_quantity, local, mass, model_form_deviation = (
        "tether",
        "spring, drag and mass at a place",
        True,
        2,
        LAW,
    )
    quantities = (
        Quantity("stiffness_n_m", "N/m", 2.0, 0.0, 1000.0),
        Quantity("damping_n_s_m", "N s/m", 0.05, 0.0, 1000.0),
        Quantity("mass_kg", "kg", 0.002, 0.0, 1000.0),
    )
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """Without spring and dashpot, a mass."""
        return [Simpler("attached_mass", values[2:])]

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """The spring is at rest in the undeformed body."""
        share = twin.at(values[:, 3:])
        return scenario.plus(
            Spring(share=share, stiffness=values[:, 0], mean=True),
            Drag(share=share, coefficient=values[:, 1]),
            PointMass(share=share, mass=values[:, 2]),
        )


class TautTether(Hypothesis):
    """A taut tube pulls at a place, with a force that hardly changes as the body moves.

    Spread over the body, the force would be that of a tilt.
    """

    name, affected_quantity, local, model_form_deviation = "tether", "force at a place", True, LAW
    nonnegative = frozenset({"pull_n"})
    quantities = tuple(Quantity(f"pull_{axis}", "N", 0.02, -1000.0, 1000.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """Its size as well."""
        return {**super().reported(values, scenario, twin), "pull_n": (float(np.linalg.norm(values[:3])), "N")}

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """Without a place, a tilt: none, as its size hangs on the weight of the body."""
        return [Simpler("gravity_tilt", np.zeros(2))]

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """One force for each place, on the variations whose place it is."""
        places, which = torch.unique(values[:, 3:], dim=0, return_inverse=True)
        shares = twin.at(places)
        own = (which == torch.arange(len(places))[:, None]).to(values)
        return scenario.plus(
            *(Force(share=s, value=values[:, :3] * w[:, None]) for s, w in zip(shares, own, strict=True))
        )


class HangingTether(Hypothesis):
    """A tube that hangs from a support to a place of the body: it swings, it pulls when taut, and it never pushes.

    Its stiffness is that of its material, so in proportion to its mass; its links lose half of what critical damping
    takes.
    """

    name, affected_quantity, local, model_form_deviation = "tether", "a tube that hangs on a place", True, LAW
    ratios = frozenset({"stiffness_n_m"})
    quantities = (
        Quantity("mass_kg", "kg", 0.002, 0.0, 1000.0),
        *(Quantity(f"support_{axis}_m", "m", 0.02, -50.0, 50.0) for axis in "xyz"),
        Quantity("slack", "1", 0.02, -10.0, 50.0),
        Quantity("ln_stiffness", "1", 1.0, -5.0, 5.0),
    )
    starts, rugged = ((1.0, 3.0, 0.0, 0.0, 0.5, 0.0),), True

    def spread(self, twin: Twin, u: np.ndarray) -> np.ndarray:
        """Tubes of half a percent to 30 % of the body's mass, 40 to 120 mm long, hardly taut to slack, to any side."""
        setup = twin.setup
        size, origin = np.array(setup.size), np.array(setup.origin)
        mass = setup.density * float(twin.volumes.sum()) * np.exp(np.interp(u[:, 0], [0, 1], np.log([0.005, 0.3])))
        up, turn, span = 2 * u[:, 1] - 1, 2 * np.pi * u[:, 2], 0.04 * 3 ** u[:, 3]
        around = np.sqrt(1 - up**2)
        support = span * np.stack([around * np.cos(turn), around * np.sin(turn), up])
        slack, ln_stiffness = np.interp(u[:, 4], [0, 1], [-0.02, 0.04]), 2 * u[:, 5] - 1
        scales = np.array([q.scale for q in self.quantities])
        values = np.stack([mass, *support, slack, ln_stiffness], 1) / scales
        return np.concatenate([values, 10 * (origin / size + u[:, 6:])], 1)

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """What it hangs on the body at rest, how much harder it pulls when that moves away, its own mass and length."""
        gravity = scenario.gravity.reshape(-1, 3)[:1].double()
        given = torch.from_numpy(values).double()
        mass, support, span = given[:1], given[None, 1:4], given[1:4].norm()
        length, stiffness = (span * (1 + given[4]))[None], mass * TUBE * given[5].exp()
        away = support / span
        moved = torch.cat([support, support + MOVED * away, support - MOVED * away])
        three = (t.expand(3, *t.shape[1:]) for t in (length, mass, stiffness, gravity))
        pull = pull_at_rest(moved, *three)
        down = gravity[0] / gravity.norm().clamp(min=1e-12)
        return {
            "mass_kg": (float(pull[0] @ down / gravity.norm().clamp(min=1e-12)), "kg"),
            "stiffness_n_m": (float((pull[1] - pull[2]) @ away[0]) / (2 * MOVED), "N/m"),
            "tube_mass_kg": (float(mass), "kg"),
            "tube_length_m": (float(length), "m"),
        }

    def simpler(self, values: np.ndarray) -> list[Simpler]:
        """Half of its mass, at the same place."""
        return [Simpler("attached_mass", np.append(values[0] / 2, values[6:]))]

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A chain."""
        mass, support = values[:, 0], values[:, 1:4]
        span = support.norm(dim=1)
        stiffness = mass * TUBE * values[:, 5].exp()
        return scenario.plus(
            Chain(
                share=twin.at(values[:, 6:]),
                support=support,
                length=span * (1 + values[:, 4]),
                mass=mass,
                stiffness=stiffness,
                damping=torch.full_like(mass, LOSS),
            )
        )
