"""What may have been left out around the body: supply, fluid, planes, gravity, start."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from torchsoro.actuation import Waveform
from torchsoro.loads import Drag
from torchsoro.sim2real.hypothesis import Hypothesis, Quantity
from torchsoro.sim2real.scenario import Scenario
from torchsoro.sim2real.twin import Twin


class PressureGain(Hypothesis):
    """The chamber gets less, or more, than the supply's pressure."""

    name, seam = "pressure_loss", "chamber pressure"
    quantities = (Quantity("ln_factor", "1", 0.05, -30.0, 12.0),)
    starts = ((-1.0,), (-4.0,), (-10.0,))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
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


class PressureLag(Hypothesis):
    """The line fills and empties with a lag: tau p' = p_supply - p."""

    name, seam = "pressure_lag", "chamber pressure"
    quantities = (Quantity("time_constant_s", "s", 0.01, 0.0, 100.0),)
    starts = ((1.0,), (3.0,), (8.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """The exact answer of a first-order lag to the piecewise linear supply."""
        supply = scenario.pressure
        assert supply is not None
        # Even, fine samples: the lag's own exponentials are not piecewise linear.
        time = torch.arange(0.0, scenario.duration + 4e-3, 2e-3, dtype=torch.float64)
        p = Waveform(time=supply.time.double(), pressure=_chambers(supply).double()).at(time)
        tau = values[:, 0].clamp(min=1e-9)[:, None]
        ratio = 2e-3 / tau
        keep = torch.exp(-ratio)
        early = -torch.expm1(-ratio) / ratio
        p = p.expand(len(values), *p.shape[-2:])
        found = [p[..., 0]]
        for k in range(1, len(time)):
            # Exact for a supply that changes linearly in a sample.
            found.append(keep * found[-1] + (early - keep) * p[..., k - 1] + (1 - early) * p[..., k])
        lagging = torch.stack(found, -1)
        pressure = torch.where(values[:, 0, None, None] > 0, lagging, p)
        return scenario.replace(pressure=Waveform(time=time, pressure=pressure))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class AirStiffness(Hypothesis):
    """The chamber's pressure falls as it grows: p = p_supply - k (V/V0 - 1)."""

    name, seam = "air_stiffness", "chamber pressure by its volume"
    quantities = (Quantity("air_stiffness_pa", "Pa", 2e4, 0.0, 50.0),)
    starts = ((1.0,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Added to what is believed."""
        return scenario.replace(air_stiffness=scenario.air_stiffness + values[:, :1])

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a chamber."""
        return scenario.pressure is not None


class FluidDrag(Hypothesis):
    """The surrounding fluid slows the whole body, in proportion to its velocity."""

    name, seam = "drag", "drag of the whole body"
    quantities = (Quantity("rate", "1/s", 0.5, 0.0, 200.0),)
    starts = ((1.0,), (4.0,), (12.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Force -rate m v, evenly over the mass."""
        mass = torch.where(twin.inside, twin.share, 0.0) * scenario.density.reshape(-1, twin.count)[0] * twin.spacing**3
        drag = Drag(particles=torch.arange(twin.count), coefficient=values[:, 0] * mass.sum(), share=mass / mass.sum())
        return scenario.replace(loads=(*scenario.loads, drag))


class Slip(Hypothesis):
    """Planes that were believed to stick let the body slide, with a Coulomb coefficient of 1/a."""

    name, seam = "friction", "friction of the planes"
    quantities = (Quantity("inverse_coefficient", "1", 1.0, 0.0, 50.0),)
    starts = ((1.0,), (2.0,), (4.0,), (8.0,))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The coefficient."""
        return {"coefficient": (1 / max(float(values[0]), 1e-3), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """A plane without slip has next to none at a coefficient of 1000."""
        if not bool(values.any()):
            return scenario
        most = 1 / values[:, 0].clamp(min=1e-3)
        return scenario.replace(
            planes=tuple(dataclasses.replace(p, friction=most) if p.sticks else p for p in scenario.planes)
        )

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane that sticks."""
        return any(p.sticks for p in scenario.planes)


class Friction(Hypothesis):
    """Planes are more or less slippery than believed."""

    name, seam = "friction", "friction of the planes"
    quantities = (Quantity("ln_factor", "1", 0.1, -40.0, 40.0),)
    starts = ((2.0,), (-2.0,), (6.0,), (-6.0,), (-15.0,))

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The coefficient."""
        believed = next(float(torch.as_tensor(p.friction).reshape(-1)[0]) for p in scenario.planes if not p.sticks)  # pyright: ignore[reportArgumentType]
        return {"coefficient": (believed * math.exp(values[0]), "1")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Coefficient times exp(a)."""
        factor = values[:, 0].exp()
        return scenario.replace(
            planes=tuple(
                p if p.sticks else dataclasses.replace(p, friction=p.friction * factor) for p in scenario.planes
            )  # pyright: ignore[reportOperatorIssue]
        )

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane that has a coefficient."""
        return any(not p.sticks for p in scenario.planes)


class Adhesion(Hypothesis):
    """Planes hold the body back as it lifts off."""

    name, seam = "adhesion", "adhesion of the planes"
    quantities = (Quantity("traction", "Pa", 200.0, 0.0, 1000.0),)
    starts = ((1.0,), (5.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Traction to overcome."""
        return scenario.replace(planes=tuple(dataclasses.replace(p, adhesion=values[:, 0]) for p in scenario.planes))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane."""
        return bool(scenario.planes)


class WallOffset(Hypothesis):
    """Planes are elsewhere, towards the body if positive."""

    name, seam = "wall_offset", "place of the planes"
    quantities = (Quantity("offset_m", "m", 5e-4, -40.0, 40.0),)
    starts = ((1.0,), (-1.0,), (4.0,), (-4.0,))

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Moved along the normal."""
        planes = [dataclasses.replace(p, offset=p.offset + p.side * values[:, 0]) for p in scenario.planes]
        return scenario.replace(planes=tuple(planes))

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a plane."""
        return bool(scenario.planes)


class GravityTilt(Hypothesis):
    """The body stands at an angle: gravity is turned about two axes."""

    name, seam = "gravity_tilt", "direction of gravity"
    quantities = (Quantity("about_first", "rad", 0.03, -20.0, 20.0), Quantity("about_second", "rad", 0.03, -20.0, 20.0))
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """Both angles, and the whole."""
        return {**super().told(values, scenario), "angle_rad": (float(np.hypot(*values)), "rad")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Turned about the two axes normal to gravity."""
        g = scenario.gravity
        axis = int(g.reshape(-1, 3)[0].abs().argmax())
        first, second = (a for a in range(3) if a != axis)
        turn = torch.zeros(len(values), 3, dtype=torch.float64)
        turn[:, first], turn[:, second] = values[:, 0], values[:, 1]
        angle = turn.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        k = turn / angle
        g = g.expand(len(values), 3)
        turned = (
            g * angle.cos()
            + torch.cross(k, g, dim=-1) * angle.sin()
            + k * (k * g).sum(-1, keepdim=True) * (1 - angle.cos())
        )
        return scenario.replace(gravity=turned)


class InitialMotion(Hypothesis):
    """The body is not at rest, or moves otherwise, at the start."""

    name, seam = "initial_motion", "velocity at the start"
    quantities = tuple(Quantity(f"velocity_{axis}", "m/s", 0.02, -50.0, 50.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def told(self, values: np.ndarray, scenario: Scenario) -> dict[str, tuple[float, str]]:
        """The velocity, and its size."""
        return {**super().told(values, scenario), "speed_m_s": (float(np.linalg.norm(values)), "m/s")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Of the whole body; for a clamped one, as of its farthest points, less near the clamp."""
        velocity = scenario.velocity
        shape = torch.ones(twin.count, dtype=torch.float64)
        for axis, side in twin.faces:
            shape = shape * (twin.depth(axis, side) / twin.setup.size[axis]).clamp(0, 1) ** 2
        return scenario.replace(velocity=velocity + values[:, None, :] * shape[:, None])
