"""A cube with two chambers side by side becomes a robot that turns, left or right by the phase of its chambers alone.

    python recipes/turner.py                             # coarse, on a laptop
    python recipes/turner.py --preset paper --out runs/paper    # the paper's size; chosen by itself on a GPU
    python recipes/turner.py --timing --phases 0 0.5 --out runs/given  # with given phases, for the body alone
    python recipes/turner.py --resume                    # go on after Ctrl-C or a kill
    tensorboard --logdir runs                            # watch it

The body is symmetric, and is designed to turn to the left; with the phases the other way round it turns to the right.
Every number of the settings can be overridden: --help lists them.
"""

from __future__ import annotations

from torchsoro.design.presets import TURNER
from torchsoro.design.reading import design_program
from torchsoro.design.settings import Settings

# What designs is imported when it is needed: --help and a wrong option answer at once.


def main(settings: Settings) -> dict[str, float]:
    """Design a turner.

    Args:
        settings: From ``TURNER["desk"]`` or ``TURNER["paper"]``.

    Returns:
        See :func:`torchsoro.output.delivery.design`.

    Raises:
        ValueError: for the settings of another robot.
    """
    if settings.robot != "turner":
        raise ValueError(f"robot = {settings.robot!r}: wanted 'turner'; recipes/{settings.robot}.py designs that")
    from torchsoro.design.robot import turner
    from torchsoro.output.delivery import design

    return design(turner(settings), "turner")


cli = design_program(main, TURNER, __doc__)

if __name__ == "__main__":
    cli()
