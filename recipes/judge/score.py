"""Score answers against a sealed batch: the acceptance table, confusions, accuracy over strength.

    python recipes/judge/score.py runs/judge/test --answers tool=runs/judge/answers baseline=runs/judge/modulus_only

Every folder of answers (``<case>/explanation.json``) is a column. Intervals are Clopper and Pearson's, 95 %. Strength
is the root mean square of the effect over the noise that errors of measurement could not imitate; "strong" means at
least twice ``--threshold``, the strength at which an effect can just be seen.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from answers import SETS, SILENT, Scored, calibration_error, check, match, truths
from scipy.stats import beta

NAMED = ("explained",)
MUTE = ("failed", "missing")


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A share with its interval.

    Attributes:
        hits: How many.
        of: Of how many.
    """

    hits: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Clopper and Pearson, 95 %."""
        low = float(beta.ppf(0.025, self.hits, self.of - self.hits + 1)) if self.hits else 0.0
        high = float(beta.ppf(0.975, self.hits + 1, self.of - self.hits)) if self.hits < self.of else 1.0
        return low, high

    def __str__(self) -> str:
        """Share, interval, counts."""
        if not self.of:
            return "no case"
        low, high = self.interval
        return f"{100 * self.hits / self.of:.0f} % [{100 * low:.0f}, {100 * high:.0f}] {self.hits}/{self.of}"


def rate(cases: Sequence[Scored], holds: Callable[[Scored], bool]) -> Rate:
    """Share of cases for which it holds."""
    return Rate(hits=sum(map(holds, cases)), of=len(cases))


def _median(values: Sequence[float], unit: str = "", scale: float = 1.0) -> str:
    if not values:
        return "no case"
    low, middle, high = (scale * float(np.percentile(values, q)) for q in (25, 50, 75))
    return f"{middle:.3g}{unit} (quartiles {low:.3g}, {high:.3g}; {len(values)})"


def table(cases: Sequence[Scored], threshold: float) -> dict[str, str]:
    """Rows of the acceptance table and what goes with it."""
    quiet = [c for c in cases if c.kind in ("null", "decoy")]
    single = [c for c in cases if c.kind == "effect"]
    strong = [c for c in single if c.strength >= 2 * threshold]
    faint = [c for c in single if c.strength < threshold]
    pairs = [c for c in cases if c.kind == "pair"]
    outside = [c for c in cases if c.kind == "outside"]
    seen = [c for c in outside if c.strength >= 2 * threshold]
    committed = [c for c in strong if c.verdict in NAMED and len(c.names) == 1]
    spoke = [c for c in strong if c.verdict in SETS and c.set]
    right = [c for c in single if c.verdict in NAMED and c.truth[0] in c.names]
    local = [c.location_error / c.length for c in right if c.location_error is not None]
    anywhere = [c.place_error / c.length for c in strong if c.place_error is not None]
    errors = [e for c in right for e in c.parameter_errors]
    covered = [x for c in right for x in c.covered]
    told = [c.told_ratio for c in strong if c.verdict in SETS and c.told_ratio is not None]
    sealed = [c.sealed_ratio for c in strong if c.verdict in SETS and c.sealed_ratio is not None]
    sizes = [len(c.set) for c in spoke]
    sure = [c for c in cases if c.likely]
    certain = [c for c in sure if c.likely not in ("nothing", "unknown") and c.probability >= 0.8]

    def alarm(c: Scored) -> bool:
        return c.verdict not in SILENT

    return {
        "false alarms, nulls and decoys (<= 10 %)": str(rate(quiet, alarm)),
        "  nulls alone": str(rate([c for c in quiet if c.kind == "null"], alarm)),
        "  decoys alone": str(rate([c for c in quiet if c.kind == "decoy"], alarm)),
        "right name when it commits, strong (>= 80 %)": str(rate(committed, lambda c: c.names == c.truth)),
        "commits to one name, strong (>= 50 %)": str(Rate(hits=len(committed), of=len(strong))),
        "truth inside the reported set (>= 90 %)": str(rate(spoke, lambda c: c.truth[0] in c.set)),
        "  mean size of the set (<= 2.5)": f"{np.mean(sizes):.2f} ({len(sizes)})" if sizes else "no case",
        "  over all strong cases, silent ones too": str(rate(strong, lambda c: c.truth[0] in c.set)),
        "location, median over body length (<= 0.15)": _median(local),
        "  whatever it is called, strong": _median(anywhere),
        "parameter error, median (<= 25 %)": _median(errors, " %", 100),
        "  coverage of 90 % intervals (80-97 %)": str(Rate(hits=sum(covered), of=len(covered))),
        "held-out after / before, as the answer says (<= 0.6)": _median(told),
        "  improved in (>= 90 %)": str(Rate(hits=sum(r < 1 for r in told), of=len(told))),
        "held-out after / before, sealed trial": _median(sealed),
        "  improved in ": str(Rate(hits=sum(r < 1 for r in sealed), of=len(sealed))),
        "outside the library: unknown (>= 60 %)": str(rate(outside, lambda c: c.unknown)),
        "  wrong confident name (<= 20 %)": str(rate(outside, lambda c: c.verdict in NAMED)),
        "  unknown, strong": str(rate(seen, lambda c: c.unknown)),
        "  wrong confident name, strong": str(rate(seen, lambda c: c.verdict in NAMED)),
        "pairs: one name right": str(rate(pairs, lambda c: any(n in c.names for n in c.truth))),
        "  both right": str(rate(pairs, lambda c: set(c.truth) <= set(c.names))),
        "fainter than the threshold: nothing, or the truth": str(
            rate(faint, lambda c: c.verdict in SILENT or c.truth[0] in c.set)
        ),
        "cannot tell": str(rate(cases, lambda c: c.verdict == "cannot_tell")),
        "most probable, as told, is the truth": str(rate(sure, lambda c: c.likely in truths(c))),
        "  mean probability that is told of it": f"{np.mean([c.probability for c in sure]):.2f}" if sure else "no case",
        "names told with 0.8 to 1, right": str(rate(certain, lambda c: c.likely in truths(c))),
        "  expected calibration error of the most probable": _calibration(sure),
        "own error, as told / real, nothing missing": _median([c.priced_ratio for c in quiet if c.priced_ratio]),
        "noise, as told / real, where it is not stated": _median([c.noise_ratio for c in cases if c.noise_ratio]),
        "failed to answer": str(rate(cases, lambda c: c.verdict in MUTE)),
        "seconds for an answer": _median([c.seconds for c in cases if c.seconds]),
    }


def _calibration(cases: Sequence[Scored]) -> str:
    if not cases:
        return "no case"
    return f"{calibration_error([(c.probability, c.likely in truths(c)) for c in cases]):.2f} ({len(cases)})"


def over_strength(cases: Sequence[Scored]) -> list[str]:
    """Detected, named, in the set, for classes of strength."""
    single = [c for c in cases if c.kind == "effect"]
    edges = [0.0, 0.25, 0.5, 1, 2, 4, 8, 16, math.inf]
    lines = []
    for low, high in itertools.pairwise(edges):
        here = [c for c in single if low <= c.strength < high]
        if here:
            seen = rate(here, lambda c: c.verdict not in (*SILENT, *MUTE))
            named = rate(here, lambda c: c.verdict in NAMED and c.names == c.truth)
            inside = rate(here, lambda c: c.truth[0] in c.set)
            lines.append(f"{low:>5g} to {high:<5g} seen {seen}   named {named}   in the set {inside}")
    return lines


def half_seen(cases: Sequence[Scored]) -> float:
    """Strength at which half of the single effects are seen, from a logistic curve; not a number without enough."""
    single = [c for c in cases if c.kind == "effect" and c.strength > 0]
    y = np.array([c.verdict not in (*SILENT, *MUTE) for c in single], float)
    if len(y) < 10 or y.min() == y.max():
        return math.nan
    x = np.log([c.strength for c in single])
    slopes, middles = np.linspace(0.3, 6, 40), np.linspace(x.min(), x.max(), 80)
    p = 1 / (1 + np.exp(-slopes[:, None, None] * (x - middles[:, None])))
    p = np.clip(p, 0.02, 0.98)
    score = (y * np.log(p) + (1 - y) * np.log(1 - p)).sum(-1)
    return float(np.exp(middles[np.unravel_index(score.argmax(), score.shape)[1]]))


def confusion(cases: Sequence[Scored]) -> list[str]:
    """What was answered for each name that was put in."""
    rows: dict[str, dict[str, int]] = {}
    for c in cases:
        truth = " + ".join(c.truth) if c.truth else c.kind
        said = " + ".join(c.names) if c.verdict in NAMED else c.verdict
        if c.verdict == "cannot_distinguish":
            said = "set with it" if any(n in c.set for n in c.truth) else "set without it"
        rows.setdefault(truth, {}).setdefault(said, 0)
        rows[truth][said] += 1
    return [
        f"{truth:<32} " + ", ".join(f"{said} {n}" for said, n in sorted(found.items(), key=lambda i: -i[1]))
        for truth, found in sorted(rows.items())
    ]


def write_cases(path: Path, truth: Sequence[dict[str, Any]], cases: Sequence[Scored]) -> None:
    """Write each case with what was answered, as a CSV file; what there is not is empty."""
    head = "case specimen kind strength truth decoy verdict names set place_error_over_length parameter_errors "
    head += "intervals_hold sealed_after_over_before seconds"
    known = {t["case"]: t for t in truth}

    def told(*values: float | None) -> str:
        return " ".join("" if v is None else f"{v:.3g}" for v in values)

    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head.split())
        for c in cases:
            place = None if c.location_error is None else c.location_error / c.length
            holds = " ".join("yes" if held else "no" for held in c.covered)
            case = (c.case, known[c.case]["specimen"], c.kind, told(c.strength), " + ".join(c.truth))
            names = (known[c.case]["decoy"], c.verdict, " + ".join(c.names), " / ".join(c.set))
            numbers = (told(place), told(*c.parameter_errors), holds, told(c.sealed_ratio), told(c.seconds or None))
            rows.writerow((*case, *names, *numbers))


def score(
    batch: Path, /, *, answers: tuple[str, ...], threshold: float = 1.0, rename: Path | None = None,
    asked: bool = False, bodies: tuple[str, ...] = (), out: Path | None = None, cases: Path | None = None,
) -> dict[str, dict[str, str]]:  # fmt: skip
    """Print the tables.

    Args:
        batch: Folder that seal.py made.
        answers: Folders of answers, each as NAME=FOLDER or FOLDER.
        threshold: Strength at which an effect can just be seen.
        rename: JSON {"effects": {theirs: ours}, "parameters": {"effect": {theirs: ours}}} for other vocabularies.
        asked: Leave out what no answer was written for, as of a tool that was not asked for all.
        bodies: Kinds of body that count; all if none is given.
        out: JSON file for the tables and every case.
        cases: CSV file for every case of the first folder of answers.

    Returns:
        The acceptance table of each folder of answers.
    """
    truth = check(batch)
    words = json.loads(rename.read_text()) if rename else {}
    counted = [t for t in truth["cases"] if not bodies or t["specimen"] in bodies]
    if not counted:
        raise ValueError(f"bodies = {bodies}: no case of the batch, wanted names of specimens")
    found: dict[str, list[Scored]] = {}
    for item in answers:
        label, _, folder = item.rpartition("=")
        every = [match(t, Path(folder), batch, words) for t in counted]
        found[label or Path(folder).name] = [c for c in every if not asked or c.verdict != "missing"]
    tables = {label: table(every, threshold) for label, every in found.items()}
    rows = next(iter(tables.values()))
    width = max(map(len, rows))
    columns = [max(len(label), *(len(v) for v in rows.values())) for label, rows in tables.items()]
    print(f"{len(truth['cases'])} cases, batch {truth['batch']}, strong: at least {2 * threshold:g}")
    if asked:
        print("answered: " + ", ".join(f"{label} {len(every)}" for label, every in found.items()))
    print("  ".join(["".ljust(width), *(label.ljust(w) for label, w in zip(tables, columns, strict=True))]))
    for row in rows:
        cells = [t[row].ljust(w) for t, w in zip(tables.values(), columns, strict=True)]
        print("  ".join([row.ljust(width), *cells]))
    for label, every in found.items():
        print(f"\n{label}: over strength (half are seen at {half_seen(every):.2g})", *over_strength(every), sep="\n")
        print(f"\n{label}: what was answered", *confusion(every), sep="\n")
    if out is not None:
        whole = {label: [asdict(c) for c in every] for label, every in found.items()}
        out.write_text(json.dumps({"tables": tables, "cases": whole}, indent=1))
    if cases is not None:
        write_cases(cases, truth["cases"], next(iter(found.values())))
    return tables


if __name__ == "__main__":
    tyro.cli(score)
