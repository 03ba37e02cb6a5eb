"""A block between two walls becomes a climber: four arms and two legs in the paper, from nothing but the gradient.

    python recipes/climber.py                            # coarse, on a laptop
    python recipes/climber.py --preset paper             # the paper's size; chosen by itself on a GPU
    python recipes/climber.py --gravity-steps 0          # without the continuation in gravity
    python recipes/climber.py --resume                   # go on after Ctrl-C or a kill
    tensorboard --logdir runs                            # watch it

The design loop is the walker's: see ``optimize`` in walker.py.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from walker import DESK as WALKER_DESK
from walker import PAPER as WALKER_PAPER
from walker import optimize, report

from torchsoro.robot import climber
from torchsoro.settings import Settings, from_command_line, plain_errors

# The paper's text says 40.25 mm; 83,200 particles and its step times fit 45.5 mm.
PAPER = dataclasses.replace(
    WALKER_PAPER,
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
DESK = dataclasses.replace(
    WALKER_DESK,
    robot="climber",
    out=Path("runs/climber"),
    size=(0.035, 0.035, 0.035 / 12 * 16),
    particles=(12, 12, 16),
    settle=0.0,
    iterations=40,
    learning_rate=0.05,
    penalty=1.0,
    tolerance=0.03,
    upright=0.0,
    # On so coarse a lattice the total form's body, which touches both walls from the first, does not learn to let go.
    formulation="updated",
    counted="body",
    gravity_steps=5,
    gravity_every=4,
)


def main(settings: Settings) -> dict[str, float]:
    """Design a climber."""
    return optimize(climber(dataclasses.replace(settings, robot="climber")), "climber")


if __name__ == "__main__":
    chosen = from_command_line({"desk": DESK, "paper": PAPER}, description=__doc__)
    with plain_errors():
        result = main(chosen)
    print(report(result, chosen))
