"""An explanation on disk: ``report.html`` for people, ``explanation.json`` for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchsoro.output.document import Document
from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.cosines import SCORE
from torchsoro.sim2real.inference.isolability import SAME, Isolability
from torchsoro.sim2real.report.drawings import draw_alike, draw_body, draw_forces, draw_mismatch, draw_trial
from torchsoro.sim2real.report.explanation import Explanation, as_json, effect_rows
from torchsoro.sim2real.report.sentences import _said, lead
from torchsoro.storage import atomic_write


def write(e: Explanation, trials: Sequence[Trial], out: Path, settings: Mapping[str, Any]) -> None:
    """Write report.html and explanation.json.

    Args:
        e: What was found.
        trials: All, in the order of ``e.before``.
        out: Folder, which exists.
        settings: How it was asked for.
    """
    data = as_json(e, settings)
    with atomic_write(out / "explanation.json") as file:
        file.write((json.dumps(data, indent=2) + "\n").encode())
    page = Document(e.problem.experiment.setup.title or "Explanation", lead(e))
    page.section("Recorded, believed, explained")
    for trial, before, after in zip(trials, e.before, e.after, strict=True):
        kept = ", not used for the fit" if trial.name in e.heldout else ""
        caption = f"Trial {trial.name}{kept}: markers as recorded, as believed, and as explained."
        page.figure(draw_trial(trial, before, after), caption)
    page.section("Where and when")
    page.text(" ".join(map(str, e.mismatches)))
    after = "after" if e.verdict.chosen else "fitted without an effect"
    page.figure(
        draw_mismatch(e.mismatches, trials, after),
        "Mismatch over time before and after, in what noise and the simulation's own error explain, with the phases of "
        "each trial; where a pressure is supplied it is grey.",
    )
    places = [
        (row["name"], np.array(row["location_m"]))
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        if row["location_m"] is not None
    ]
    page.figure(
        draw_body(e.problem.experiment.setup, e.before, e.after, places, e.forces, after),
        "Mismatch on the body by marker, root mean square over all trials.",
    )
    if e.forces is not None:
        page.section("The force that would be needed")
        page.text(f"{e.forces} A force stands in for what is missing; it does not say what that is.")
        page.figure(
            draw_forces(e.forces, e.problem.experiment.setup),
            "Size of the force by place and time, and the components of the strongest, with standard deviations.",
        )
    page.section("What was considered")
    considered = [
        {
            "effect": c.fit.name,
            "changes": " and ".join(effect.affected_quantity for effect in c.fit.effects),
            "score": c.score,
            "of the difference [%]": 100 * c.explained,
            "misfit / samples": c.fit.chi2 / c.fit.samples,
            "left out, after / before": "breaks down" if math.isinf(c.heldout_ratio) else c.heldout_ratio,
            "parameters": _said(c, e.problem),
        }
        for c in e.verdict.ranking
    ]
    if considered:
        page.table(
            considered,
            "Score: gain in ln of the likelihood, studentised, less what the parameters are worth. The highest is not "
            "believed if it predicts trials that were left out hardly better than no effect does, or much worse than "
            "another.",
        )
    if e.isolability is not None:
        page.section("What this experiment can tell")
        write_isolability(page, e.isolability)
    page.section("Errors")
    page.table(
        [
            {
                "trial": b.trial,
                "before [mm]": 1e3 * b.total,
                "after [mm]": 1e3 * a.total,
                "used": b.trial not in e.heldout,
            }
            for b, a in zip(e.before, e.after, strict=True)
        ],
        "Root mean square over markers, in space.",
    )
    page.section("What is not physics")
    noise = data["noise"]
    page.text(
        f"Noise {1e3 * noise['standard_deviation_m']:.3f} mm. The simulation's own error, from twins with cells of "
        f"{', '.join(f'{1e3 * s:.2f}' for s in e.discretization.edges)} mm: "
        + ", ".join(f"{1e3 * value:.3f} mm in trial {name}" for name, value in noise["numerics_m"].items())
        + f". {e.discretization.walls[0]} cells through the thinnest wall, corrected by a twin with "
        f"{e.discretization.walls[1]}."
    )
    deviations = dict(zip(e.problem.observation.names, e.problem.observation.deviations, strict=True))
    page.table(
        [
            {"measurement error": name, "fitted": value, "believed within": deviations.get(name)}
            for name, value in data["nuisance"].items()
        ]
    )
    page.text(f"{e.problem.tally.simulations} simulations, {e.seconds:.0f} s, torchsoro {data['version']}.")
    page.save(out / "report.html")


def write_isolability(page: Document, found: Isolability) -> None:
    """What would be seen, and what looks alike."""
    alike = found.confused()
    page.table(
        [
            {
                "effect": name,
                "quantity": quantity,
                "seen from": value if math.isfinite(value) else None,
                "unit": unit,
                "may pass for it": ", ".join(b for a, b in alike if a == name),
            }
            for name, (quantity, unit), value in zip(found.effects, found.quantities, found.detectable, strict=True)
        ],
        f"By times, markers and noise alone: the strength from which on an effect stands out (score {SCORE:g}), beside "
        f"measurement errors, modulus and pressure; and what else can make {100 * SAME:.0f} % of its change.",
    )
    caption = "How much of the change that the effect of a row makes, that of a column can imitate."
    page.figure(draw_alike(found), caption)
