"""A block between two walls becomes a climber: four arms and two legs in the paper, from nothing but the gradient.

    python recipes/climber.py                            # coarse, on a laptop
    python recipes/climber.py --preset paper --out runs/paper    # the paper's size; chosen by itself on a GPU
    python recipes/climber.py --gravity-steps 0 --out runs/whole # without the continuation in gravity
    python recipes/climber.py --resume                   # go on after Ctrl-C or a kill
    tensorboard --logdir runs                            # watch it

Every number of the settings can be overridden: --help lists them. The loop is ``torchsoro.design.loop.optimize``.
"""

from __future__ import annotations

from torchsoro.design.presets import CLIMBER
from torchsoro.design.reading import design_program
from torchsoro.design.settings import Settings

# What designs is imported when it is needed: --help and a wrong option answer at once.


def main(settings: Settings) -> dict[str, float]:
    """Design a climber.

    Args:
        settings: From ``CLIMBER["desk"]`` or ``CLIMBER["paper"]``.

    Returns:
        See :func:`torchsoro.output.delivery.design`.

    Raises:
        ValueError: for the settings of another robot.
    """
    if settings.robot != "climber":
        raise ValueError(f"robot = {settings.robot!r}: wanted 'climber'; recipes/{settings.robot}.py designs that")
    from torchsoro.design.robot import climber
    from torchsoro.output.delivery import design

    return design(climber(settings), "climber")


cli = design_program(main, CLIMBER, __doc__)

if __name__ == "__main__":
    cli()
