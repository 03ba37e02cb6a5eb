"""An explanation on disk: ``report.html`` for people, ``explanation.json`` for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchsoro.output.document import Document
from torchsoro.output.slider import Moving, packed
from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.cosines import SCORE
from torchsoro.sim2real.inference.isolability import SAME, Isolability
from torchsoro.sim2real.report.drawings import (
    EXPLAINED,
    NOMINAL,
    RECORDED,
    SURROUNDINGS,
    draw_body,
    draw_cosines,
    draw_forces,
    draw_mismatch,
    draw_trial,
    draw_worst,
    side_view,
)
from torchsoro.sim2real.report.explanation import Explanation, as_json, effect_rows
from torchsoro.sim2real.report.sentences import candidate_words, evidence, told, verdict_sentence
from torchsoro.sim2real.report.words import (
    digits,
    effect_words,
    error_number,
    error_words,
    interval,
    millimetres,
    probability,
    quantity_words,
    with_unit,
)
from torchsoro.storage import write_json

BARS = 8  # on the first screen, at most
LEAST_BARS, FAINT = 3, 0.01  # shown always; of the others, those that are at least as probable
FAR = 0.03  # of the body's longest edge, from which on its motion is shown
MARKERS = 6  # up to which the error of each is in the table of trials
TRIALS = 6  # whose markers are all drawn, those that are the furthest off


def write(e: Explanation, trials: Sequence[Trial], out: Path, settings: Mapping[str, Any]) -> None:
    """Write report.html and explanation.json.

    Args:
        e: What was found.
        trials: All, in the order of ``e.before``.
        out: Folder, which exists.
        settings: Of the command line.
    """
    data = as_json(e, settings)
    write_json(out / "explanation.json", data)
    page = Document(e.problem.experiment.setup.title or "Explanation", verdict_sentence(e))
    _at_first(page, e, trials)
    page.points(evidence(e))
    if e.hints:
        page.section("Hints on the data")
        page.points(e.hints)
    _effects(page, e)
    _body(page, e, trials)
    _mismatches(page, e, trials)
    _trials(page, e, trials)
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


def _said(e: Explanation) -> str:
    """What the second simulation is."""
    return "explained" if e.verdict.chosen else "fitted without an effect"


def _at_first(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """The first screen: three errors, probabilities, trials that were left out, and the worst marker over time."""
    found, said = e.improvement, _said(e)
    if found is not None:
        kind = "in the trials of the fit"
        if found.heldout:
            kind = "in held-out trials" if e.heldout else "in trials predicted from the others"
        # Of several that cannot be told apart, one is drawn.
        of = f" by {effect_words(e.verdict.chosen[0].name)}" if len(e.verdict.chosen) > 1 else ""
        page.numbers(
            [
                (millimetres(found.believed), f"error as believed, {kind}"),
                (millimetres(found.explained), f"error as {said}{of}, {kind}"),
                (millimetres(found.floor), "expected of noise and the simulation's own error, as corrected"),
            ]
        )
    leading = sorted(e.verdict.conclusion.calibrated.items(), key=lambda item: -item[1])
    shown = [(told(name), p) for k, (name, p) in enumerate(leading) if k < LEAST_BARS or p > FAINT][:BARS]
    page.bars(
        [(name, p, probability(p), 1) for name, p in shown],
        "Probability of what is missing, whether it matters or not",
        longest=1.0,
    )
    if found is not None:
        worst = sorted(found.trials.items(), key=lambda item: -item[1][0])[:BARS]
        rows = []
        for name, (before, after) in worst:
            rows += [
                (f"trial {name}", before, f"{millimetres(before)} believed", 0),
                ("", after, f"{millimetres(after)} {said.split()[0]}", 1),
            ]
        rows.append(("expected of noise and the simulation's own error", found.floor, millimetres(found.floor), 2))
        page.bars(rows, f"Error {kind}, root mean square over markers and time")
    if e.worst is not None:
        w = e.worst
        trial, believed, explained = trials[w.trial], e.drawn[w.trial], e.after[w.trial].seen
        page.figure(
            draw_worst(trial, believed, explained, w, said),
            f"Marker {trial.setup.markers[w.marker].name} in trial {trial.name}{_heldout(e, trial)}. Recording and "
            f"belief are the furthest apart at {with_unit(w.time, 's')} (dashed): by {millimetres(w.believed)}; as "
            f"{said}, they are {millimetres(w.explained)} apart.",
        )


def _heldout(e: Explanation, trial: Trial) -> str:
    return ", not used for the fit" if trial.name in e.heldout else ""


def _body(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """The whole body at the worst moment, and over time where it moves far."""
    body, said = e.body, _said(e)
    if body is None or e.worst is None:
        return
    page.section("The body")
    setup = trials[e.worst.trial].setup
    places = [
        (effect_words(row["name"]), np.array(row["location_m"]))
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        if row["location_m"] is not None
    ]
    page.figure(
        draw_body(body, setup, places, e.forces, said),
        f"The body where recording and belief are the furthest apart, to scale: as believed, and as {said}. Lines join "
        "each recorded marker, by the scale and the rotation that were fitted, to where the simulations have it.",
    )
    if body.travel > FAR * max(setup.size):
        one, other = side_view(body, setup)
        azimuth = {(0, 2): -90.0, (1, 2): 0.0}.get((one, other), -60.0)
        surfaces = (("believed", NOMINAL, body.believed), (said, EXPLAINED, body.explained))
        moving = [Moving(name=name, color=color, places=places, faces=body.faces) for name, color, places in surfaces]
        moving.append(Moving(name="recorded markers", color=RECORDED, places=body.recorded))
        if (planes := body.planes(setup)).size:
            faces = np.arange(planes.shape[1]).reshape(-1, 4)
            moving.append(Moving(name="planes", color=SURROUNDINGS, places=planes, faces=faces))
        page.slider(
            packed(body.time, moving, begin=body.worst, azimuth=azimuth),
            f"Trial {body.trial}{_heldout(e, trials[e.worst.trial])}, over time; drag to turn.",
        )


def _effects(page: Document, e: Explanation) -> None:
    """Quantities of the effects that were chosen."""
    rows = [
        {
            "effect": effect_words(row["name"]),
            "quantity": quantity_words(row["name"], name),
            "value": with_unit(p["value"], p["unit"], name),
            "90 % interval": interval(p["value"], p["low"], p["high"], p["unit"], name),
        }
        for c in e.verdict.chosen
        for row in effect_rows(c.fit, 0.0, e.problem)
        for name, p in row["parameters"].items()
    ]
    if rows:
        page.section("What explains the difference")
        page.table(rows)


def _trials(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """All markers over time, of the trials that are the furthest off, and the errors of all."""
    said, markers = _said(e), e.problem.experiment.setup.markers
    each = len(markers) <= MARKERS
    page.section("All markers")
    page.text(
        "Believed is the simulation of the setup as stated; "
        + (
            f"explained is the same with {effect_words(e.best.name)}, "
            if e.verdict.chosen
            else "the other is the same, "
        )
        + "with modulus, pressure and measurement errors fitted."
    )
    page.table(
        [
            {
                "trial": b.trial,
                "as believed [mm]": float(digits(1e3 * b.total)),
                f"as {said} [mm]": float(digits(1e3 * a.total)),
                "used for the fit": b.trial not in e.heldout,
                **{
                    f"{m.name} [mm]": f"{digits(1e3 * one)} → {digits(1e3 * other)}"
                    for m, one, other in zip(markers if each else (), b.error, a.error, strict=each)
                },
            }
            for b, a in zip(e.before, e.after, strict=True)
        ],
        "Distance between recording and simulation, root mean square over time and all markers"
        + (f", and of each marker: believed → {said}." if each else "."),
    )
    off = sorted(range(len(trials)), key=lambda k: -e.before[k].total)
    for k in sorted(off[:TRIALS]):
        believed = e.drawn[k] if e.drawn else e.before[k].seen
        name = f"Trial {trials[k].name}{_heldout(e, trials[k])}"
        picture = draw_trial(trials[k], believed, e.after[k].seen, said)
        page.figure(picture, f"{name}: coordinates of the markers.", folded=name)


def _mismatches(page: Document, e: Explanation, trials: Sequence[Trial]) -> None:
    """Where and when recordings leave the simulation."""
    page.section("Where and when")
    page.points([str(m) for m in e.mismatches])
    off = {p.trial: p.total for p in e.before}
    shown = sorted(range(len(trials)), key=lambda k: -off[trials[k].name])[:TRIALS]
    page.figure(
        draw_mismatch([e.mismatches[k] for k in sorted(shown)], [trials[k] for k in sorted(shown)], _said(e)),
        "Distance between recording and simulation over time, in standard deviations of noise and of the simulation's "
        "own error, as corrected, over the phases of each trial. Dotted: three standard deviations. Grey: supplied "
        "pressure.",
    )


def _considered(page: Document, e: Explanation) -> None:
    """All that was weighed."""
    rows = [
        {
            "effect": candidate_words(x, e.problem),
            "probability": probability(x.probability),
            "ln evidence": f"{x.posterior.ln_evidence - e.verdict.ranking[0].posterior.ln_evidence:.1f}",
            "changes the motion by [mm]": float(digits(1e3 * x.size)),
            "leaves [mm]": float(digits(1e3 * x.left)),
        }
        for x in e.verdict.ranking
    ]
    if rows:
        page.section("What was considered")
        page.table(
            rows,
            "Ln evidence: of the recordings under each, over that of the first row. Leaves: root mean square of the "
            "least that it leaves of the difference beyond noise and the simulation's own error. The probability of an "
            "effect that leaves more than a fifth of it, and more than the noise, is given to none of the known ones, "
            "and that of an effect that holds a simpler one, and moves the body no otherwise by more than matters, to "
            "the simpler one. Of effects that change the motion by less than the simulation may err, nothing is told "
            "apart by more than an error of that size allows. Of the probability of each effect, as much goes to "
            "something else as former blind answers were wrong in that left as much.",
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
                "may be mistaken for": ", ".join(dict.fromkeys(effect_words(b) for a, b in confused if a == name != b)),
            }
            for name, (quantity, unit), value in zip(found.effects, found.quantities, found.detectable, strict=True)
        ],
        f"By times, markers and noise alone: the strength at which an effect is detectable (gain in chi-squared of "
        f"{SCORE:g}) beside measurement errors, modulus, pressure and friction, and the effects that can imitate "
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
        f"Standard deviations along an axis: of the recordings' noise {millimetres(noise['standard_deviation_m'])}; of "
        f"the simulation's own error {millimetres(noise['simulation_m'])}, which is what its correction by finer cells "
        f"leaves. Cells of {edges} mm, {' and '.join(map(str, cells.walls))} of them through the thinnest wall."
    )
    tolerances = [tolerance for _, tolerance in e.problem.common]
    deviations = dict(zip(e.best.ln_factors, tolerances, strict=True))
    deviations |= dict(zip(e.problem.observation.names, e.problem.observation.deviations, strict=True))
    rows = []
    for name, value in data["nuisance"].items():
        words, unit = error_words(name)
        prior = error_number(deviations[name], unit) if name in deviations else None
        rows.append({"fitted always": words, "value": error_number(value, unit), "prior ±": prior})
    page.table(
        rows,
        "Measurement errors, and what the setup's modulus, pressure and friction are off, with their priors.",
        folded="Measurement errors",
    )
    page.text(f"{e.problem.tally.simulations} simulations, {e.seconds:.0f} s, torchsoro {data['version']}.")
