"""Settings that each robot starts from: coarse for a laptop ("desk"), and at the paper's size ("paper")."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from torchsoro.design.settings import Settings

_WALKER_PAPER = Settings(
    preset="paper",
    out=Path("runs/walker"),
    # Travel is so rough that it never levels off to the paper's 0.1 % while C is too high: without patience the penalty
    # would stay at its first value for ever.
    penalty=1.0,
    patience=20,
    # Half a second is short: a robot that falls on its nose from high up gets as far as one that walks.
    upright=4.0,
    sink=0.05,
    # Grey limbs between the ground and a pressurised chamber are crushed: most that may happen to void may to them.
    void_range=(0.1, 0.5),
    halvings=1,
)
_WALKER_DESK = dataclasses.replace(
    _WALKER_PAPER,
    preset="desk",
    particles=(12, 12, 12),
    wall=0.035 / 12,
    elements=2,
    dt=1e-4,
    settle=0.05,
    duration=0.2,
    sample_every=0.0025,
    iterations=100,
    # On so coarse a lattice loose pieces move each other. In one piece, some starts lean, and some hardly walk.
    connected=True,
    starts=4,
    filter_radius=0.007,
    void_range=(0.1, 0.3),
    halvings=2,
    # In a single cycle, falling on the nose would be the longest stride, and leaning the next.
    upright=8.0,
    sink=0.01,
    feet=1.0,
    inflated=0.6,
    # Feet that slide have gradients where feet that stick know only jumps.
    friction=0.8,
    # What does not help is left out: most designs that stall are heavy ones. With more, too little is left to stand on.
    lightness=0.1,
    learning_rate=0.03,
    # Smaller than any norm: gradients count by their direction, as their norms grow a hundredfold within a few steps.
    clip=0.03,
    penalty=0.5,
    sharpen=(25, 67),
    frames=40,
    picture_every=20,
)

# The paper's text says 40.25 mm; 83,200 particles and its step times fit 45.5 mm.
_CLIMBER_PAPER = dataclasses.replace(
    _WALKER_PAPER,
    robot="climber",
    out=Path("runs/climber"),
    size=(0.035, 0.035, 0.0455),
    particles=(40, 40, 52),
    settle=0.0,
    filter_radius=0.004375,
    upright=0.0,
    # Otherwise a plate that has come off the chamber and is pushed up by it counts as climbing.
    counted="body",
    gravity_steps=10,
    gravity_every=8,
)
_CLIMBER_DESK = dataclasses.replace(
    _WALKER_DESK,
    robot="climber",
    out=Path("runs/climber"),
    size=(0.035, 0.035, 0.035 / 12 * 16),
    particles=(12, 12, 16),
    settle=0.0,
    upright=0.0,
    sink=0.008,
    # Without, some slide down with the mass ahead of the feet.
    feet=0.1,
    inflated=0.0,
    lightness=0.0,
    # Between walls, Coulomb friction holds only who presses on them: the first bodies slide down.
    friction="stick",
    # Thinner limbs lose their hold in some designs and not in others.
    filter_radius=0.0085,
    iterations=100,
    penalty=0.8,
    sharpen=(12, 46),
    counted="body",
    gravity_steps=5,
    gravity_every=4,
)

# Turns to the left with the phases that are designed and to the right with those the other way round.
_TURNING = {
    "robot": "turner",
    "out": Path("runs/turner"),
    "chambers": 2,
    "chamber_axis": "y",
    "timing": ("phase",),
    # A quarter of a cycle apart: alike, both sides would push a symmetric body straight on, with no gradient to a side.
    "phases": (0.0, 0.25),
}
_TURNER_PAPER = dataclasses.replace(_WALKER_PAPER, **_TURNING)
_TURNER_DESK = dataclasses.replace(_WALKER_DESK, **_TURNING)

WALKER = {"desk": _WALKER_DESK, "paper": _WALKER_PAPER}
CLIMBER = {"desk": _CLIMBER_DESK, "paper": _CLIMBER_PAPER}
TURNER = {"desk": _TURNER_DESK, "paper": _TURNER_PAPER}
