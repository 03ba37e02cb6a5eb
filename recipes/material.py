"""From a rheometer's or DMA's file to a material that the simulator runs stably, and a report of what was left out.

    python recipes/material.py sweeps.csv --out runs/resin                 # sweeps at several temperatures
    python recipes/material.py sweeps.csv --out runs/resin --reference 21.8 --band 0.8 50 --dt 1e-5
    python recipes/material.py relaxation.csv --out runs/resin --deformation tension
    python recipes/material.py creep.csv --out runs/resin --deformation shear
    python recipes/walker.py --material runs/resin/material.toml --dt auto --out runs/mine     # a robot of it

Sweeps at several temperatures are shifted to one (time-temperature superposition), the master curve is fitted by
Maxwell elements, and of these as many are kept as the step, the cell and the robot's frequencies ask for. Written are
``material.toml``, ``report.html`` (opens from disk) and ``master.csv``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchsoro.command_line import program
from torchsoro.rheology.options import Options

if TYPE_CHECKING:
    from torchsoro.output.material_page import Found


def main(options: Options) -> Found:
    """Make the material, write it with its report, and print what was left out.

    Raises:
        ValueError: for a file or an option that will not do; names it.
    """
    from torchsoro.output.material_page import RESULTS, make  # here, so that --help is there at once

    found = make(options)
    print(f"{found.material.left_out}\nwritten to {options.out}: {', '.join(RESULTS)}")
    return found


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
