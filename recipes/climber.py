"""A block between two walls becomes a climber: four arms and two legs in the paper, from nothing but the gradient.

    python recipes/climber.py                            # coarse, on a laptop
    python recipes/climber.py --preset paper             # the paper's size; chosen by itself on a GPU
    python recipes/climber.py --gravity-steps 0          # without the continuation in gravity
    python recipes/climber.py --resume                   # go on after Ctrl-C or a kill
    tensorboard --logdir runs                            # watch it

Every number of the settings can be overridden: --help lists them. The loop is ``torchsoro.design.loop.optimize``.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchsoro.command_line import plain_errors
from torchsoro.design.presets import CLIMBER
from torchsoro.design.reading import from_command_line
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
        raise ValueError(f"robot = {settings.robot!r}: wanted 'climber'; recipes/walker.py designs a walker")
    from torchsoro.design.robot import climber
    from torchsoro.output.delivery import design

    return design(climber(settings), "climber")


def cli(arguments: Sequence[str] | None = None) -> None:
    """Design a climber as the command line says, and print what came out of it.

    Args:
        arguments: Instead of the process's own.
    """
    with plain_errors():
        settings = from_command_line(CLIMBER, description=__doc__, arguments=arguments)
        result = main(settings)
        from torchsoro.output.delivery import report

        print(report(result, settings))


if __name__ == "__main__":
    cli()
