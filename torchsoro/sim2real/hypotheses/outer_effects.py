"""Effects around the body: fluid, planes, gravity, start."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.hypotheses.hypothesis import LAW, Hypothesis, Quantity
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import Twin
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.loads import QuadraticDrag


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
    quantities = (Quantity("inverse_coefficient", "1", 0.1, 0.0, 500.0),)
    # Closely spaced near the onset of sliding, where the motion depends steeply on the coefficient.
    starts = ((7.0,), (8.5,), (10.0,), (12.5,), (16.0,), (20.0,), (28.0,), (40.0,), (80.0,))

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
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

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
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

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
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

    name, affected_quantity, model_form_deviation = "gravity_tilt", "direction of gravity", 0.1
    nonnegative = frozenset({"angle_rad"})
    quantities = (Quantity("about_first", "rad", 0.03, -20.0, 20.0), Quantity("about_second", "rad", 0.03, -20.0, 20.0))
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """Both angles, and the whole."""
        return {**super().reported(values, scenario, twin), "angle_rad": (float(np.hypot(*values)), "rad")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Turned about the two axes normal to gravity."""
        g = scenario.gravity
        axis = int(g.reshape(-1, 3)[0].abs().argmax())
        first, second = (a for a in range(3) if a != axis)
        turn = torch.zeros(len(values), 3, dtype=torch.float64)
        turn[:, first], turn[:, second] = values[:, 0], values[:, 1]
        return scenario.replace(gravity=turned(g, turn))


class InitialMotion(Hypothesis):
    """A clamped body is not at rest, or moves otherwise, at the start."""

    name, affected_quantity, model_form_deviation = "initial_motion", "velocity at the start", LAW
    nonnegative = frozenset({"speed_m_s"})
    quantities = tuple(Quantity(f"velocity_{axis}", "m/s", 0.02, -50.0, 50.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """The velocity, and its size."""
        return {**super().reported(values, scenario, twin), "speed_m_s": (float(np.linalg.norm(values)), "m/s")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """As of its farthest points, less near the clamp."""
        shape = torch.ones(twin.nodes, dtype=torch.float64)
        for axis, side in twin.faces:
            shape = shape * (twin.depth(twin.places, axis, side) / twin.setup.size[axis]).clamp(0, 1) ** 2
        return scenario.replace(velocity=scenario.velocity + values[:, None, :] * shape[:, None])

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body that something holds."""
        return bool(twin.held.any())


class InitialRigidMotion(Hypothesis):
    """A free body is not at rest, or moves and turns otherwise, at the start."""

    name, affected_quantity, model_form_deviation = "initial_motion", "velocity at the start", LAW
    nonnegative = frozenset({"speed_m_s"})
    quantities = (
        *(Quantity(f"velocity_{axis}", "m/s", 0.02, -50.0, 50.0) for axis in "xyz"),
        *(Quantity(f"spin_{axis}", "rad/s", 0.5, -100.0, 100.0) for axis in "xyz"),
    )
    starts, joint = tuple(map(tuple, np.eye(6))), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """Velocity of the centre, rate of turn, and the largest speed that these are at a corner of the body's box."""
        corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * twin.setup.size
        speed = np.linalg.norm(values[:3] + np.cross(values[3:], corners), axis=1).max()
        return {**super().reported(values, scenario, twin), "speed_m_s": (float(speed), "m/s")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Of the body's centre, and about it."""
        arms = twin.places - torch.tensor(twin.setup.center, dtype=torch.float64)
        moved = values[:, None, :3] + torch.linalg.cross(values[:, None, 3:], arms[None])
        return scenario.replace(velocity=scenario.velocity + moved)

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body that nothing holds."""
        return not twin.held.any()


class InitialTilt(Hypothesis):
    """A free body is turned at the start."""

    name, affected_quantity = "initial_tilt", "direction of the body at the start"
    nonnegative = frozenset({"angle_rad"})
    quantities = tuple(Quantity(f"about_{axis}", "rad", 0.03, -20.0, 20.0) for axis in "xyz")
    starts, joint = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """The turn, and its size."""
        return {**super().reported(values, scenario, twin), "angle_rad": (float(np.linalg.norm(values)), "rad")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Turned about its centre; what is behind a plane then is moved out."""
        arms = twin.places - torch.tensor(twin.setup.center, dtype=torch.float64)
        moved = turned(arms, values[:, None]) - arms
        return scenario.replace(displacement=scenario.displacement + moved)

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body that nothing holds."""
        return not twin.held.any()


class InitialPose(Hypothesis):
    """A clamped body is let go from a bend, in which something has held its free end."""

    name, affected_quantity = "initial_pose", "shape of the body at the start"
    nonnegative = frozenset({"deflection_m"})
    quantities = tuple(Quantity(f"offset_{i}_m", "m", 0.002, -25.0, 25.0) for i in ("first", "second"))
    starts, joint = ((1.0, 0.0), (0.0, 1.0)), True

    def reported(self, values: np.ndarray, scenario: Scenario, twin: Twin) -> dict[str, tuple[float, str]]:
        """Both offsets, and the whole."""
        return {**super().reported(values, scenario, twin), "deflection_m": (float(np.hypot(*values)), "m")}

    def forward(self, scenario: Scenario, values: Tensor, twin: Twin) -> Scenario:
        """Of a slender cantilever under a force at its end, whose cross-sections stay plane and normal to it.

        At a share s of the length L from the clamp, w = a (3 s^2 - s^3) / 2 across, and -w' times the distance from
        the middle along the axis.
        """
        axis, side = twin.faces[0]
        places, size = twin.places, twin.setup.size
        length = size[axis]
        s = (twin.depth(places, axis, side) / length).clamp(0, 1)
        bend, slope = (3 * s**2 - s**3) / 2, (6 * s - 3 * s**2) / (2 * length)
        moved = torch.zeros(len(values), len(places), 3, dtype=torch.float64)
        for k, across in enumerate(a for a in range(3) if a != axis):
            off = values[:, k : k + 1]
            moved[..., across] += off * bend
            # Away from the clamp the axis points to the side that the clamp is not on.
            moved[..., axis] += side * off * slope * (places[:, across] - twin.setup.center[across])
        return scenario.replace(displacement=scenario.displacement + moved)

    def applies(self, scenario: Scenario, twin: Twin) -> bool:
        """With a body of which one face is clamped."""
        return len(twin.faces) == 1


def turned(v: Tensor, turn: Tensor) -> Tensor:
    """Vectors [..., 3] rotated by rotation vectors [..., 3] rad."""
    units = torch.eye(3, dtype=turn.dtype)
    transposed = torch.linalg.cross(turn.unsqueeze(-2).expand(*turn.shape[:-1], 3, 3), units.expand(*turn.shape, 3))
    return (v.unsqueeze(-2) @ torch.linalg.matrix_exp(transposed)).squeeze(-2)
