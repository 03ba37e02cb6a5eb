"""What the simulation of a robot says of its design."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchsoro.simulation.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What one simulation says of a design; with scenarios, all but C is of each [S].

    Attributes:
        travel: L, Eq. 13 [m].
        feet: The same of the feet (see :meth:`torchsoro.design.robot.Robot.feet`) [m]: a robot that leans moves its
            centre and not its feet.
        soles: The same with all soles, the less the farther off they are, which has a gradient by what touches [m].
        inflated: Travel of the centre of gravity after the first ``settings.duty`` of a cycle [m].
        turn: Angle by which the soles turned about z since the actuation starts, positive to the left [rad].
        turn_inflated: The same after the first ``settings.duty`` of a cycle [rad].
        intermediate: C, Eq. 15.
        mass: Of solid and chamber wall [kg].
        fall: What the centre of gravity sinks at most, beyond ``settings.sink`` times the height and what is free below
            the body at the start [m].
        center: Centre of gravity of the undeformed design domain [3] m, Eq. 14.
        trajectory: The motion.
        dt: Substep that it took [s]: the settings' or, where that broke down, a half or a quarter of it.
    """

    travel: Tensor
    feet: Tensor
    soles: Tensor
    inflated: Tensor
    turn: Tensor
    turn_inflated: Tensor
    intermediate: Tensor
    mass: Tensor
    fall: Tensor
    center: Tensor
    trajectory: Trajectory
    dt: float
