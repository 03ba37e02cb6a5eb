"""What a simulation records, and what it may start from."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Recorded motion; with a leading batch if any argument of the simulation had one.

    Attributes:
        time: [S] s, from the start of the first of the runs that went on from each other.
        position: Probes [..., S, P, 3] m; float64 if the probes are places.
        velocity: Probes [..., S, P, 3] m/s.
        deformation: Deformation gradient at the probes [..., S, P, 3, 3] if these are places, else [..., S, 0, 3, 3].
        center_of_gravity: [..., S, 3] m, weighted by ``weight`` of the call.
        center_velocity: [..., S, 3] m/s.
        chamber_volume: Volume of each chamber [..., S, chambers] m3.
        chamber_pressure: Mean gas pressure (Eq. 10) of each chamber [..., S, chambers] Pa.
        probes: int64 [P] particle indices, or [P, 3] places.
        sound: Which simulations did not diverge, bool [...]: all that is recorded is finite, inside of the box.
        final: Last state, in the layout of the formulation. A later run goes on from the trajectory (``start``).
        dt: Substep [s].
    """

    time: Tensor
    position: Tensor
    velocity: Tensor
    deformation: Tensor
    center_of_gravity: Tensor
    center_velocity: Tensor
    chamber_volume: Tensor
    chamber_pressure: Tensor
    probes: Tensor
    sound: Tensor
    final: Tensor
    dt: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """How the nodes of the lattice move at the start, of the total-Lagrangian form; clamped ones do not.

    Values at the nodes are coefficients of splines: those of a linear field are its values at ``Lattice.node_places``.

    Attributes:
        displacement: [..., nodes, 3] m.
        velocity: [..., nodes, 3] m/s.
    """

    displacement: Tensor
    velocity: Tensor
