"""All effects that can be named."""

from __future__ import annotations

from torchsoro.sim2real.body_effects import (
    AttachedMass,
    Density,
    LoadInertia,
    Modulus,
    PoissonRatio,
    SoftSide,
    Tether,
    Viscoelastic,
)
from torchsoro.sim2real.hypothesis import Hypothesis
from torchsoro.sim2real.outer_effects import (
    Adhesion,
    AirStiffness,
    FluidDrag,
    Friction,
    GravityTilt,
    InitialMotion,
    PressureGain,
    PressureLag,
    Slip,
    WallOffset,
)


def library() -> tuple[Hypothesis, ...]:
    """All effects that can be named."""
    kinds = (
        *(Viscoelastic, Modulus, SoftSide, Density, PoissonRatio, AttachedMass, Tether, LoadInertia, FluidDrag),
        *(PressureLag, PressureGain, AirStiffness, Slip, Friction, Adhesion, WallOffset, GravityTilt, InitialMotion),
    )
    return tuple(kind() for kind in kinds)
