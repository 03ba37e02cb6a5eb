"""Effects around the body: supply, fluid, planes, gravity, start."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.hypotheses.hypothesis import LAW, Hypothesis, Quantity
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.loads import QuadraticDrag


class PressureGain(Hypothesis):
    """The chamber gets less, or more, than the supply's pressure."""

    name, affected_quantity, model_form_deviation = "pressure_loss", "chamber pressure", LAW
    quantities = (Quantity("ln_factor", "1", 0.05, -30.0, 12.0),)
    starts = ((-1.0,), (-4.0,), (-10.0,))

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """What is lost."""
        return {"fraction": (1 - math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """P exp(a)."""
        assert scenario.pressure is not None
        pressure = _chambers(scenario.pressure) * values[:, 0].exp()[:, None, None]
        return scenario.replace(pressure=dataclasses.replace(scenario.pressure, pressure=pressure))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


def _chambers(supply: Waveform) -> Tensor:
    """Pressure [..., chambers, S]."""
    return supply.pressure if supply.pressure.ndim > 1 else supply.pressure.unsqueeze(0)


def lagged(scenario: Scenario, tau: Tensor) -> Waveform:
    """The exact answer of a first-order lag [B] s to a piecewise linear supply."""
    supply = scenario.pressure
    assert supply is not None
    # Even, fine samples: the lag's own exponentials are not piecewise linear.
    time = torch.arange(0.0, scenario.duration + 4e-3, 2e-3, dtype=torch.float64)
    p = Waveform(time=supply.time.double(), pressure=_chambers(supply).double()).at(time)
    p = p.expand(len(tau), *p.shape[-2:])
    ratio = 2e-3 / tau.clamp(min=1e-9)[:, None]
    keep, early = torch.exp(-ratio), -torch.expm1(-ratio) / ratio
    # Exact for a supply that changes linearly in a sample.
    pushed = (early - keep).unsqueeze(-1) * p[..., :-1] + (1 - early).unsqueeze(-1) * p[..., 1:]
    found, kept = torch.cat([p[..., :1], pushed], -1).movedim(-1, 0).contiguous().numpy(), keep.numpy()
    for k in range(1, len(found)):
        found[k] += kept * found[k - 1]
    late = torch.where(tau[:, None, None] > 0, torch.from_numpy(found).movedim(0, -1), p)
    return Waveform(time=time, pressure=late)


class PressureLag(Hypothesis):
    """The line fills and empties with a lag: tau p' = p_supply - p."""

    name, affected_quantity, model_form_deviation = "pressure_lag", "chamber pressure", LAW
    quantities = (Quantity("time_constant_s", "s", 0.01, 0.0, 100.0),)
    starts = ((1.0,), (3.0,), (8.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Late."""
        return scenario.replace(pressure=lagged(scenario, values[:, 0]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AirStiffness(Hypothesis):
    """The chamber's pressure falls as it grows: p = p_supply - k (V/V0 - 1)."""

    name, affected_quantity, model_form_deviation = "air_stiffness", "chamber pressure by its volume", LAW
    quantities = (Quantity("air_stiffness_pa", "Pa", 2e4, 0.0, 50.0),)
    starts = ((1.0,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Added to what is believed."""
        return scenario.replace(air_stiffness=scenario.air_stiffness + values[:, :1])

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AirTwice(Hypothesis):
    """There is less air to compress than believed, as where the pressure was measured in the chamber itself."""

    name, affected_quantity = "air_stiffness", "chamber pressure by its volume"
    quantities = (Quantity("share", "1", 0.1, -10.0, 0.0),)
    starts = ((-3.0,), (-10.0,))

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """What is to be added."""
        return {"air_stiffness_pa": (float(values[0]) * float(scenario.air_stiffness.max()), "Pa")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A share of what is believed less."""
        return scenario.replace(air_stiffness=scenario.air_stiffness * (1 + values[:, :1]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber whose air is believed to be compressed."""
        return scenario.pressure is not None and bool((scenario.air_stiffness > 0).any())


class Leak(Hypothesis):
    """A part of the supply is lost behind a line that fills slowly: tau p' = (1 - a) p_supply - p."""

    name, affected_quantity, model_form_deviation = "leak", "chamber pressure", LAW
    quantities = (Quantity("fraction", "1", 0.05, 0.0, 19.0), Quantity("time_constant_s", "s", 0.01, 0.0, 100.0))
    starts = tuple((f, t) for f in (1.0, 5.0) for t in (1.0, 3.0))

    def simpler(self, values: np.ndarray) -> tuple[str, np.ndarray] | None:
        """With all of the pressure in the end, a lag; at once, a loss."""
        full, prompt = (v < 0.01 * q.scale for v, q in zip(values, self.quantities, strict=True))
        if full:
            return "pressure_lag", values[1:]
        return ("pressure_loss", np.log1p(-values[:1])) if prompt else None

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Less pressure, later."""
        assert scenario.pressure is not None
        less = _chambers(scenario.pressure) * (1 - values[:, 0])[:, None, None]
        scenario = scenario.replace(pressure=dataclasses.replace(scenario.pressure, pressure=less))
        return scenario.replace(pressure=lagged(scenario, values[:, 1]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class FluidDrag(Hypothesis):
    """The surrounding fluid slows the body, with the square of the velocity, on the area that moves through it."""

    name, affected_quantity, model_form_deviation = "drag", "drag of what surrounds the body", LAW
    # Water, and a plate across its motion: 1000 kg/m3 times 2.
    quantities = (Quantity("density_drag_kg_m3", "kg/m3", 20.0, 0.0, 125.0),)
    starts = ((1.0,), (5.0,), (25.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Force rho c_d / 2 A v |v| along each axis."""
        return scenario.plus(QuadraticDrag(coefficient=values[:, 0]))


class Sliding(Hypothesis):
    """Planes that were believed to stick let the body slide, with a Coulomb coefficient of 1/a."""

    name, affected_quantity = "friction", "friction of the planes"
    ratios = frozenset({"coefficient"})
    quantities = (Quantity("inverse_coefficient", "1", 1.0, 0.0, 50.0),)
    starts = ((1.0,), (2.0,), (4.0,), (8.0,))

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The coefficient."""
        return {"coefficient": (1 / max(float(values[0]), 1e-3), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A plane without slip has next to none at a coefficient of 1000."""
        if not bool(values.any()):
            return scenario
        most = 1 / values[:, 0].clamp(min=1e-3)
        return _planes(scenario, lambda g: {"friction": most if g.sticks else g.friction})

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane that sticks."""
        return any(g.sticks for g in scenario.planes)


class Friction(Hypothesis):
    """Planes are more or less slippery than believed."""

    name, affected_quantity = "friction", "friction of the planes"
    ratios = frozenset({"coefficient"})
    quantities = (Quantity("ln_factor", "1", 0.1, -40.0, 40.0),)
    starts = ((2.0,), (-2.0,), (6.0,), (-6.0,), (11.0,), (-15.0,))

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The coefficient."""
        believed = next(float(g.friction.reshape(-1)[0]) for g in scenario.planes if isinstance(g.friction, Tensor))
        return {"coefficient": (believed * math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Coefficient times exp(a)."""
        factor = values[:, 0].exp()
        return _planes(
            scenario, lambda g: {"friction": g.friction * factor if isinstance(g.friction, Tensor) else g.friction}
        )

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane that has a coefficient."""
        return any(not g.sticks for g in scenario.planes)


class Adhesion(Hypothesis):
    """Planes hold the body back as it lifts off, with the same traction as far as they reach (Dugdale)."""

    name, affected_quantity, model_form_deviation = "adhesion", "adhesion of the planes", LAW
    ratios, nonnegative = frozenset({"reach_m"}), frozenset({"energy_j_m2"})
    quantities = (Quantity("traction", "Pa", 50.0, 0.0, 1000.0), Quantity("ln_reach", "ln m", 1.0, -11.5, -5.0))
    starts = ((2.0, -8.5), (8.0, -8.5), (30.0, -8.5), (8.0, -7.0))

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """Traction, reach, and the energy that it takes to separate."""
        reach = math.exp(values[1])
        return {
            "traction": (float(values[0]), "Pa"),
            "reach_m": (reach, "m"),
            "energy_j_m2": (float(values[0]) * reach, "J/m2"),
        }

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Traction within reach."""
        reach = values[:, 1].exp()
        return _planes(scenario, lambda g: {"adhesion": g.adhesion + values[:, 0], "reach": reach})

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane."""
        return bool(scenario.planes)


class WallOffset(Hypothesis):
    """Planes are elsewhere, towards the body if positive."""

    name, affected_quantity = "wall_offset", "place of the planes"
    quantities = (Quantity("offset_m", "m", 5e-4, -40.0, 40.0),)
    starts = ((1.0,), (-1.0,), (4.0,), (-4.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Moved along the normal."""
        return _planes(scenario, lambda g: {"offset": g.offset + values[:, 0]})

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane."""
        return bool(scenario.planes)


def _planes(scenario: Scenario, change: Callable[[Plane], Mapping[str, Tensor | str | float]]) -> Scenario:
    """A scenario with other numbers for its planes."""
    return scenario.replace(planes=tuple(dataclasses.replace(g, **change(g)) for g in scenario.planes))


class GravityTilt(Hypothesis):
    """The body stands at an angle: gravity is turned about two axes."""

    name, affected_quantity, model_form_deviation = "gravity_tilt", "direction of gravity", 0.2
    nonnegative = frozenset({"angle_rad"})
    quantities = (Quantity("about_first", "rad", 0.03, -20.0, 20.0), Quantity("about_second", "rad", 0.03, -20.0, 20.0))
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """Both angles, and the whole."""
        return {**super().reported(values, scenario), "angle_rad": (float(np.hypot(*values)), "rad")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Turned about the two axes normal to gravity."""
        g = scenario.gravity
        axis = int(g.reshape(-1, 3)[0].abs().argmax())
        first, second = (a for a in range(3) if a != axis)
        turn = torch.zeros(len(values), 3, dtype=torch.float64)
        turn[:, first], turn[:, second] = values[:, 0], values[:, 1]
        return scenario.replace(gravity=turned(g, turn))


class InitialMotion(Hypothesis):
    """The body is not at rest, or moves otherwise, at the start."""

    name, affected_quantity, model_form_deviation = "initial_motion", "velocity at the start", LAW
    nonnegative = frozenset({"speed_m_s"})
    quantities = tuple(Quantity(f"velocity_{axis}", "m/s", 0.02, -50.0, 50.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The velocity, and its size."""
        return {**super().reported(values, scenario), "speed_m_s": (float(np.linalg.norm(values)), "m/s")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Of the whole body; for a clamped one, as of its farthest points, less near the clamp."""
        shape = torch.ones(twin.nodes, dtype=torch.float64)
        for axis, side in twin.faces:
            shape = shape * (twin.depth(twin.places, axis, side) / twin.setup.size[axis]).clamp(0, 1) ** 2
        return scenario.replace(velocity=scenario.velocity + values[:, None, :] * shape[:, None])


class InitialSpin(Hypothesis):
    """A free body turns at the start, or turns otherwise."""

    name, affected_quantity, model_form_deviation = "initial_motion", "angular velocity at the start", LAW
    quantities = tuple(Quantity(f"spin_{axis}", "rad/s", 0.5, -100.0, 100.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """About the body's centre."""
        arms = twin.places - torch.tensor(twin.setup.center, dtype=torch.float64)
        return scenario.replace(velocity=scenario.velocity + torch.linalg.cross(values[:, None], arms[None]))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body that nothing holds."""
        return not twin.held.any()


class InitialTilt(Hypothesis):
    """A free body is turned at the start."""

    name, affected_quantity = "initial_tilt", "direction of the body at the start"
    nonnegative = frozenset({"angle_rad"})
    quantities = tuple(Quantity(f"about_{axis}", "rad", 0.03, -20.0, 20.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The turn, and its size."""
        return {**super().reported(values, scenario), "angle_rad": (float(np.linalg.norm(values)), "rad")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Turned about its centre; what is behind a plane then is moved out."""
        arms = twin.places - torch.tensor(twin.setup.center, dtype=torch.float64)
        moved = turned(arms, values[:, None]) - arms
        return scenario.replace(displacement=scenario.displacement + moved)

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body that nothing holds."""
        return not twin.held.any()


def turned(v: Tensor, turn: Tensor) -> Tensor:
    """Vectors [..., 3] rotated by rotation vectors [..., 3] rad."""
    units = torch.eye(3, dtype=turn.dtype)
    transposed = torch.linalg.cross(turn.unsqueeze(-2).expand(*turn.shape[:-1], 3, 3), units.expand(*turn.shape, 3))
    return (v.unsqueeze(-2) @ torch.linalg.matrix_exp(transposed)).squeeze(-2)
