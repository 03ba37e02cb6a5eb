"""Explain experiments several times with recordings disturbed by a millionth, and print whether the answer stays.

    python recipes/validate/disturbed.py runs/beam --times 10
    python recipes/validate/disturbed.py EXPERIMENT OTHER ... --out runs/disturbed    # finished ones are printed

That is far below any camera's noise, but searches multiply it, as they do what another processor rounds otherwise. Each
time all coordinates are disturbed anew, the first time not at all. Printed are the sets that were told, with
their count, and the held-out error over that of the setup as stated: median and range.
"""

from __future__ import annotations

import collections
import csv
import json
import math
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np
import tyro

from torchsoro.command_line import Count, options, program

CHANGE = 1e-6  # of the largest coordinate of a file, standard deviation of each


@options
class Options:
    """Which experiments, and how often."""

    experiments: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of experiments."""
    times: Count = 10
    """Explanations of each."""
    threads: int = 0
    """Of an explanation; 0 for as many as there are processors."""
    out: Path = Path("runs/disturbed")
    """Folder of the explanations; one that is cut off goes on."""


def disturb(experiment: Path, copy: Path, seed: int) -> None:
    """Copy an experiment with all recorded coordinates disturbed; with seed 0 as it is."""
    shutil.copytree(experiment, copy)
    rng = np.random.default_rng(seed)
    for path in sorted(copy.rglob("markers.csv")):
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *rows = csv.reader(file)
        seen = [(row, k) for row in rows for k, t in enumerate(row) if k and t and math.isfinite(float(t))]
        largest = max(abs(float(row[k])) for row, k in seen)
        for row, k in seen if seed else ():
            row[k] = repr(float(row[k]) + CHANGE * largest * float(rng.normal()))
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([head, *rows])


def explained(experiment: Path, seed: int, asked: Options) -> dict:
    """The answer to a disturbed copy."""
    out = asked.out / f"{experiment.resolve().name}-{seed}"
    answer = out / "explanation.json"
    if not answer.exists():
        copy = out / "experiment"
        shutil.rmtree(copy, ignore_errors=True)
        disturb(experiment, copy, seed)
        command = [sys.executable, str(Path(__file__).parents[1] / "explain.py"), str(copy), "--out", str(out)]
        with (out / "log.txt").open("w") as log:
            subprocess.run([*command, "--threads", str(asked.threads)], check=True, stdout=log, stderr=log)
    return json.loads(answer.read_text())


def ratio(answer: dict) -> float:
    """Held-out error as explained over that as stated, root mean square over trials; not a number without any."""
    if not answer["heldout"]:
        return math.nan
    before, after = (math.hypot(*(trial[k] for trial in answer["heldout"])) for k in ("before", "after"))
    return after / before


def main(asked: Options) -> None:
    """Explain, and print."""
    for experiment in asked.experiments:
        answers = []
        for seed in range(asked.times):
            answer = explained(experiment, seed, asked)
            answers.append(answer)
            told = " / ".join(sorted(answer["set"])) or "-"
            print(f"{experiment.name} {seed}: {answer['verdict']}: {told}, held out {ratio(answer):.3f}", flush=True)
        counts = collections.Counter((a["verdict"], " / ".join(sorted(a["set"])) or "-") for a in answers)
        (verdict, names), most = counts.most_common(1)[0]
        ratios = [ratio(a) for a in answers]
        print(
            f"{experiment.name}: {verdict}: {names} in {most} of {len(answers)}; held-out error after / before "
            f"{statistics.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})"
        )


cli = program(main, Options, __doc__)

if __name__ == "__main__":
    cli()
