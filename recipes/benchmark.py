"""Speed of the simulator on a walker-like body: solid with Maxwell elements, a gas chamber, ground contact; float32.

    python recipes/benchmark.py                                  # naive step, table of sizes, where the time goes
    python recipes/benchmark.py --only table --particles 4096    # one section, one size
    python recipes/benchmark.py --five --bits --auto-dt          # also these three
    python recipes/benchmark.py --compile                        # also seconds to compile, without and with the cache
    python recipes/benchmark.py --only engines --repeats 5       # a CPU's vector kernels against those of a GPU on it
    python recipes/benchmark.py --only host                      # does the device wait for the host? also 64 bodies
    python recipes/benchmark.py --preset paper --json paper.json # 64,000 particles, 75,000 steps, beside the required

All is measured in the same run, the best of some repeats after one that compiles and allocates; on CUDA by its events.
A step of the table is that of a whole call, what it sets up and checks included. M/s are million particle-steps per
second. "kept" holds all states for the gradient, in as many steps as fit; "recomputed" computes those of each segment
again, as long runs do; both count forward and backward together. GB is torch's peak on CUDA; Taichi takes up to 0.3 GB
beside it.

"floor" is what a forward step must at least move (state read and written, coefficients read, node arrays written and
read) over the bandwidth of a large copy on the same device. It supposes that nothing stays in a cache from one step to
the next: a state of a few tens of megabytes may stay in that of a large GPU, and a step then take less.
"""

from __future__ import annotations

from typing import Any

from torchsoro.benchmark.options import Options
from torchsoro.command_line import program


def main(options: Options) -> dict[str, Any]:
    """Measure, print and write; returns all numbers."""
    from torchsoro.benchmark.sections import run  # here, so that --help is there at once

    return run(options)


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
