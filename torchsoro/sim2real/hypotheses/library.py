"""All effects that can be named."""

from __future__ import annotations

from torchsoro.sim2real.hypotheses.body_effects import (
    AttachedMass,
    Density,
    HangingTether,
    LoadInertia,
    Modulus,
    PrintOffset,
    Softening,
    SoftPart,
    SoftSide,
    Stiffening,
    TautTether,
    Tether,
    Viscoelastic,
)
from torchsoro.sim2real.hypotheses.hypothesis import Hypothesis
from torchsoro.sim2real.hypotheses.outer_effects import (
    Adhesion,
    FluidDrag,
    Friction,
    GravityTilt,
    InitialMotion,
    InitialPose,
    InitialRigidMotion,
    InitialTilt,
    Sliding,
    WallOffset,
)
from torchsoro.sim2real.hypotheses.supply_effects import (
    AirStiffness,
    AirTwice,
    Leak,
    OrificeLeak,
    PressureGain,
    PressureLag,
    ThrottledLoss,
)


def library() -> tuple[Hypothesis, ...]:
    """All effects that can be named."""
    kinds = (
        *(Viscoelastic, Modulus, Stiffening, Softening, SoftSide, SoftPart, PrintOffset, Density),
        *(AttachedMass, Tether, TautTether, HangingTether, LoadInertia, FluidDrag),
        *(PressureLag, PressureGain, ThrottledLoss, Leak, OrificeLeak, AirStiffness, AirTwice),
        *(
            Sliding,
            Friction,
            Adhesion,
            WallOffset,
            GravityTilt,
            InitialMotion,
            InitialRigidMotion,
            InitialTilt,
            InitialPose,
        ),
    )
    return tuple(kind() for kind in kinds)
