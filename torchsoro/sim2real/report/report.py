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
from torchsoro.sim2real.report.drawings import (
    draw_body,
    draw_cosines,
    draw_forces,
    draw_mismatch,
    draw_probabilities,
    draw_trial,
)
from torchsoro.sim2real.report.explanation import Explanation, as_json, effect_rows
from torchsoro.sim2real.report.sentences import candidate_words, evidence, told, verdict_sentence
from torchsoro.sim2real.report.words import (
    effect_words,
    error_number,
    error_words,
    interval,
    quantity_words,
    with_unit,
)
from torchsoro.storage import atomic_write


def write(e: Explanation, trials: Sequence[Trial], out: Path, settings: Mapping[str, Any]) -> None:
    """Write report.html and explanation.json.

    Args:
        e: What was found.
        trials: All, in the order of ``e.before``.
        out: Folder, which exists.
        settings: Of the command line.
    """
    data = as_json(e, settings)
    with atomic_write(out / "explanation.json") as file:
        file.write((json.dumps(data, indent=2) + "\n").encode())
    page = Document(e.problem.experiment.setup.title or "Explanation", verdict_sentence(e))
    page.points(evidence(e))
    if e.hints:
        page.section("Hints on the data")
        page.points(e.hints)
    _effects(page, e)
    _trials(page, e, trials)
    _mismatches(page, e, trials)
    if e.forces is not None:
        page.section("The force that would be needed")
        page.text(f"{e.forces} A force stands in for what is missing; it does not say what that is.")
        page.figure(
            draw_forces(e.forces, e.problem.experiment.setup),
            "Size of the force by place and time, and the components of the strongest, with standard deviations.",
        )
    _considered(page, e)
    if e.isolability is not None:
        page.section("What this experiment can tell")
        write_isolability(page, e.isolability)
    _accuracy(page, e, data)
    page.save(out / "report.html")


def _effects(page: Document, e: Explanation) -> None:
    """Quantities of the effects that were chosen."""
    rows = [
        {
            "effect": effect_words(row["name"]),
            "quantity": quantity_words(row["name"], name),
            "value": with_unit(p["value"], p["unit"], name),
            "90 % interval": interval(p["low"], p["high"], p["unit"], name),
        }
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        for name, p in row["parameters"].items()
    ]
    if rows:
        page.section("What explains the difference")
        page.table(rows)


def _trials(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """Markers over time; the trial that is the furthest off is open."""
    page.section("Recorded, believed, explained")
    page.text(
        "Believed is the simulation of the setup as stated; explained is the same with "
        + ("the effect above." if e.verdict.chosen else "modulus, pressure and measurement errors fitted.")
    )
    worst = max(e.before, key=lambda p: p.total).trial
    drawn = e.drawn or tuple(p.seen for p in e.before)
    for trial, before, after in zip(trials, drawn, e.after, strict=True):
        heldout = ", not used for the fit" if trial.name in e.heldout else ""
        caption = f"Trial {trial.name}{heldout}: coordinates of the markers."
        folded = "" if trial.name == worst else f"Trial {trial.name}{heldout}"
        page.figure(draw_trial(trial, before, after.seen), caption, folded=folded)
    page.table(
        [
            {
                "trial": b.trial,
                "as believed [mm]": 1e3 * b.total,
                "as explained [mm]": 1e3 * a.total,
                "used for the fit": b.trial not in e.heldout,
            }
            for b, a in zip(e.before, e.after, strict=True)
        ],
        "Distance between recording and simulation, root mean square over markers and time.",
    )


def _mismatches(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """Where and when recordings leave the simulation."""
    page.section("Where and when")
    page.points([str(m) for m in e.mismatches])
    after = "explained" if e.verdict.chosen else "fitted without an effect"
    page.figure(
        draw_mismatch(e.mismatches, trials, after),
        "Distance between recording and simulation over time, in standard deviations of noise and of the simulation's "
        "own error, over the phases of each trial. Dotted: three standard deviations. Grey: supplied pressure.",
    )
    places = [
        (effect_words(row["name"]), np.array(row["location_m"]))
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        if row["location_m"] is not None
    ]
    page.figure(
        draw_body(e.problem.experiment.setup, e.before, e.after, places, e.forces, after),
        "Distance between recording and simulation at each marker, root mean square over all trials.",
    )


def _considered(page: Document, e: Explanation) -> None:
    """Posterior probabilities, and all that was weighed."""
    c = e.verdict.conclusion
    page.section("What was considered")
    page.figure(
        draw_probabilities({told(name): p for name, p in c.probabilities.items()}),
        "Posterior probability of what is missing: of nothing, of what is none of the known effects, and of each "
        "effect that was weighed.",
    )
    rows = [
        {
            "effect": effect_words(x.name),
            "changes": " and ".join(effect.affected_quantity for effect in x.fit.effects),
            "probability [%]": 100 * x.probability,
            "ln evidence": round(x.posterior.ln_evidence - e.verdict.ranking[0].posterior.ln_evidence, 1),
            "changes the motion by [mm]": 1e3 * x.size,
            "leaves [mm]": 1e3 * x.posterior.unexplained * c.motion,
            "fitted": candidate_words(x, e.problem, every=True).partition(": ")[2],
        }
        for x in e.verdict.ranking
    ]
    if rows:
        page.table(
            rows,
            "Ln evidence: of the recordings under each, over the most probable. Leaves: root mean square of the motion "
            "beyond noise and the simulation's own error; an effect that leaves more than its law may be wrong by is "
            "counted as none of the known ones, and one that changes the motion by less than matters as nothing.",
        )


def write_isolability(page: Document, found: Isolability) -> None:
    """Which effects would be detected, and which could be mistaken for which."""
    confused = found.confused()
    page.table(
        [
            {
                "effect": effect_words(name),
                "quantity": quantity_words(name, quantity),
                "detectable from": with_unit(value, unit, quantity) if math.isfinite(value) else None,
                "may be mistaken for": ", ".join(effect_words(b) for a, b in confused if a == name),
            }
            for name, (quantity, unit), value in zip(found.effects, found.quantities, found.detectable, strict=True)
        ],
        f"By times, markers and noise alone: the strength at which an effect is detectable (gain in chi-squared of "
        f"{SCORE:g}) beside measurement errors, modulus and pressure, and the effects that can imitate "
        f"{100 * SAME:.0f} % of its change.",
        folded="Which effects this experiment can detect, and which it cannot tell apart",
    )
    caption = "Cosine: how much of the change that the effect of a row makes, that of a column can imitate."
    page.figure(draw_cosines(found), caption, folded="How much of each effect the others can imitate")


def _accuracy(page: Document, e: Explanation, data: Mapping[str, Any]) -> None:
    """Noise, the simulation's own error, and measurement errors."""
    page.section("Accuracy")
    noise, cells = data["noise"], e.discretization
    edges = " and ".join(f"{1e3 * edge:.2f}" for edge in cells.edges)
    page.text(
        f"Noise of the recordings: {1e3 * noise['standard_deviation_m']:.3f} mm (standard deviation). Error of the "
        f"simulation itself: {1e3 * noise['simulation_m']:.3f} mm, from cells of {edges} mm, "
        f"{' and '.join(map(str, cells.walls))} of them through the thinnest wall."
    )
    names, common = e.problem.observation.names, [tolerance for _, tolerance in e.problem.common]
    deviations = dict(zip(["ln_modulus", "ln_pressure"], common, strict=False))
    deviations |= dict(zip(names, e.problem.observation.deviations, strict=True))
    rows = []
    for name, value in data["nuisance"].items():
        words, unit = error_words(name)
        prior = error_number(deviations[name], unit) if name in deviations else None
        rows.append({"fitted always": words, "value": error_number(value, unit), "prior ±": prior})
    page.table(
        rows,
        "Measurement errors, and what the setup's modulus and pressure are off, with their priors.",
        folded="Measurement errors",
    )
    page.text(f"{e.problem.tally.simulations} simulations, {e.seconds:.0f} s, torchsoro {data['version']}.")
