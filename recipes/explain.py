"""Why does a recording differ from its simulation? Names the missing physics, with its strength, or says it cannot.

    python recipes/explain.py my-experiment --out runs/explained
    python recipes/explain.py my-experiment --out runs/explained --budget 5      # minutes, on a coarser twin
    python recipes/explain.py --predict runs/explained/model.toml --trial trial.toml --out markers.csv

The experiment is a folder: setup.toml says what is believed, trials/<name>/markers.csv what was recorded. Trials in a
folder heldout/ are only predicted; without one, of three or more each of the first four from the others. Writes
report.html, explanation.json and model.toml, the setup with what was missing, which predicts a trial that nobody has
recorded yet.
"""

from __future__ import annotations

from torchsoro.command_line import program
from torchsoro.sim2real.options import Options


def main(options: Options) -> None:
    """Explain an experiment, or predict a trial."""
    from torchsoro.sim2real.pipeline import run  # takes seconds, which --help need not

    run(options)


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
