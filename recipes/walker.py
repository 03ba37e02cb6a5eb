"""A cube with an air chamber becomes a walker, by gradient through the simulator.

    python recipes/walker.py                                  # coarse, on a laptop
    python recipes/walker.py --preset paper --out runs/paper  # the paper's size; chosen by itself on a GPU
    python recipes/walker.py --slope 0.3 --out runs/uphill    # uphill, in a folder of its own
    python recipes/walker.py --chambers 2 --timing phase duty --out runs/two    # two chambers, timing designed, too
    python recipes/walker.py --resume                         # go on after Ctrl-C or a kill
    python recipes/walker.py --resume --amend --learning-rate 0.01    # go on with another setting, which is noted
    tensorboard --logdir runs                                 # watch it

Every number of the settings can be overridden: --help lists them. The loop is ``torchsoro.design.loop.optimize``.
"""

from __future__ import annotations

from torchsoro.design.presets import WALKER
from torchsoro.design.reading import design_program
from torchsoro.design.settings import Settings

# What designs is imported when it is needed: --help and a wrong option answer at once.


def main(settings: Settings) -> dict[str, float]:
    """Design a walker.

    Args:
        settings: From ``WALKER["desk"]`` or ``WALKER["paper"]``.

    Returns:
        See :func:`torchsoro.output.delivery.design`.

    Raises:
        ValueError: for the settings of another robot.
    """
    if settings.robot != "walker":
        raise ValueError(f"robot = {settings.robot!r}: wanted 'walker'; recipes/{settings.robot}.py designs that")
    from torchsoro.design.robot import walker
    from torchsoro.output.delivery import design

    return design(walker(settings), "walker")


cli = design_program(main, WALKER, __doc__)

if __name__ == "__main__":
    cli()
