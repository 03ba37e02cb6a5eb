"""What a report says, in sentences: the verdict first, then what it rests on."""

from __future__ import annotations

import math

from torchsoro.sim2real.inference.decision import MATTERS
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.next_experiment import advice
from torchsoro.sim2real.inference.verdict import Candidate
from torchsoro.sim2real.inference.weighing import NOTHING, UNKNOWN, UNSEEN
from torchsoro.sim2real.report import words
from torchsoro.sim2real.report.explanation import Explanation, effect_rows

REMEDIES = {
    "noise": "markers with {:g} times less noise",
    "twin": "a simulation with an own error {:g} times smaller",
    "trials": "{:g} times as many trials",
    "motion": "a motion {:g} times as large",
}
BELIEVED = 3.0  # prior standard deviations, beyond which the fitted value of a measurement error is not credible


def verdict_sentence(e: Explanation) -> str:
    """The answer."""
    v = e.verdict
    if v.kind == "nothing_missing":
        errors = "measurement errors, modulus, pressure and friction within their tolerances, and the error of the "
        errors += "simulation itself explain the difference"
        little = _little(e)
        if little is not None:
            return (
                f"Nothing that matters is missing from the setup: {errors}, but for {words.millimetres(little.size)}, "
                f"which are most probably {candidate_words(little, e.problem)}."
            )
        return f"Nothing is missing from the setup: {errors}."
    if v.kind == "unknown_physics":
        if len(v.conclusion.credible) == 1:
            return "Something is missing from the setup that is none of the known effects."
        names = (told(n) if n != NOTHING else "that nothing is missing" for n in v.conclusion.credible[1:])
        others = " or ".join(names)
        return f"Most probably something is missing that is none of the known effects; {others} is not excluded."
    if v.kind == "cannot_tell":
        return "It cannot be told from these recordings whether something is missing from the setup."
    how = "Most of the difference is" if v.conclusion.partly else "The difference is"
    parts = "; ".join(candidate_words(c, e.problem) for c in v.chosen)
    if v.kind == "cannot_distinguish" and len(v.chosen) == 1:
        return f"{how} explained by {parts}; or by none of the known effects: the recordings cannot tell."
    if v.kind == "cannot_distinguish":
        if UNKNOWN in v.conclusion.credible:
            parts += "; or none of the known effects"
        return f"{how} explained by one of these, and the recordings cannot tell by which: {parts}."
    return f"{how} explained by {parts}."


def evidence(e: Explanation) -> list[str]:
    """What the verdict rests on, and what remains open, a sentence each."""
    v = e.verdict
    found = [_departure(e), _probable(e), _visible(e), _small(e)]
    if v.heldout and e.improvement:
        trials = f"trial{'s' if len(v.heldout) > 1 else ''} {', '.join(v.heldout)}"
        how = "left out of the fit" if e.heldout else "each predicted from the others"
        found.append(
            f"On {trials}, {how}, the error of the prediction is {1e3 * e.improvement.explained:.2f} mm; "
            f"that of the setup as stated is {1e3 * e.improvement.believed:.2f} mm."
        )
    if v.chosen and v.conclusion.partly:
        best = v.chosen[0]
        found.append(
            f"Of a difference of {words.millimetres(v.conclusion.left)} it leaves {words.millimetres(best.left)} that "
            "are none of the known effects."
        )
    if v.kind == "unknown_physics":
        closest = min(v.ranking, key=lambda c: c.left, default=None)
        if closest is not None and closest.left < v.conclusion.left:
            left = f"it leaves {words.millimetres(closest.left)} unexplained"
            found.append(f"Closest of the known effects: {candidate_words(closest, e.problem)}; {left}.")
        if e.forces:
            found.append(str(e.forces))
    if v.kind == "cannot_distinguish":
        found.append(advice(e.following, "them" if len(v.chosen) == 2 else "the first two"))
    if v.chosen:
        found.append(_incredible_errors(e))
    return [sentence for sentence in found if sentence]


def lead(e: Explanation) -> str:
    """The verdict and what it rests on, as one paragraph."""
    return " ".join([verdict_sentence(e), *evidence(e)])


def told(name: str) -> str:
    """A candidate's name in words."""
    others = {NOTHING: "nothing", UNSEEN: "an effect too weak to be seen", UNKNOWN: "something else"}
    return others.get(name) or words.effect_words(name)


def _probable(e: Explanation) -> str:
    """Posterior probabilities of the set."""
    c = e.verdict.conclusion
    leading = sorted(c.calibrated.items(), key=lambda item: -item[1])[: max(2, len(c.credible))]
    shares = ", ".join(f"{told(name)} {words.probability(p)}" for name, p in leading)
    return f"Probabilities of what is missing: {shares}."


def _little(e: Explanation) -> Candidate | None:
    """What does not matter, but is more probable than that nothing is missing; None where nothing is."""
    first, p = next(iter(e.verdict.ranking), None), e.verdict.conclusion.calibrated  # the most probable one
    return first if first and first.probability > p[NOTHING] + p[UNSEEN] else None


def _visible(e: Explanation) -> str:
    """Which changes would have been seen, where nothing is named; and what would make smaller ones visible."""
    v, c = e.verdict, e.verdict.conclusion
    if v.kind not in ("nothing_missing", "cannot_tell"):
        return ""
    if v.kind == "cannot_tell" and c.chosen:
        names = " or ".join(told(name) for name in c.chosen)
        if NOTHING in c.credible:
            return f"It may be {names}, but that nothing is missing is not excluded."
        return f"It may be {names}, but trials that are left out are predicted no better with it."
    limit, matters = words.millimetres(c.limit), words.millimetres(c.matters)
    if c.limit <= c.matters:
        return f"An effect that changes the motion by {limit} would have been seen; {matters} matter."
    if not math.isfinite(c.limit):
        return "No effect would have been seen, however large."
    sentence = f"An effect would have been seen only if it changed the motion by {limit}, while {matters} matter."
    if c.remedies:
        ways = " or ".join(REMEDIES[name].format(factor) for name, factor in c.remedies.items())
        sentence += f" It could be told with {ways}."
    return sentence


def _small(e: Explanation) -> str:
    """How much the motion changes by what is named, where that does not matter."""
    v = e.verdict
    size = max((c.size for c in v.chosen), default=math.inf)
    if size >= MATTERS * v.conclusion.motion:
        return ""
    who = "It changes the motion by" if len(v.chosen) == 1 else "Each changes the motion by at most"
    share = 100 * size / v.conclusion.motion
    return f"{who} {words.millimetres(size)}, {share:.2g} % of it, which is too little to matter."


def _departure(e: Explanation) -> str:
    """Where and when the recording leaves the simulation, in the trial in which that is first."""
    apart = [m for m in e.mismatches if m.where]
    if not apart:
        return ""
    first = min(apart, key=lambda m: m.start or 0.0)
    return f"The recording leaves the simulation of the setup as stated first in trial {first.trial}, {first.where}."


def _incredible_errors(e: Explanation) -> str:
    """Measurement errors that are fitted beyond their priors, which hides something else in them."""
    observation = e.problem.observation
    large = []
    for name, value, deviation in zip(observation.names, e.best.errors, observation.deviations, strict=True):
        if abs(value) > BELIEVED * deviation:
            name_of_error, unit = words.error_words(name)
            large.append(
                f"{name_of_error} {words.error_number(value, unit)} (prior ±{words.error_number(deviation, unit)})"
            )
    if not large:
        return ""
    return f"More is missing than this, since measurement errors are fitted beyond belief: {', '.join(large)}."


def candidate_words(candidate: Candidate, problem: FitProblem) -> str:
    """An effect with its place and its main quantities."""
    parts = []
    for row in effect_rows(candidate.fit, 0.0, problem):
        main = words.MAIN.get(row["name"], ())
        numbers = [
            f"{words.quantity_words(row['name'], name)} {words.with_unit(p['value'], p['unit'], name)} "
            f"(90 %: {words.interval(p['value'], p['low'], p['high'], p['unit'], name)})"
            for name, p in row["parameters"].items()
            if not main or name in main
        ]
        parts.append(f"{words.effect_words(row['name'])}{_place(row)}: {', '.join(numbers)}")
    return " and ".join(parts)


def _place(row: dict) -> str:
    if row["location_m"] is None:
        return ""
    within = [f" ± {1e3 * w:.0f}" for w in row["location_within_m"] or []] or [""] * 3
    return f" at ({', '.join(f'{1e3 * x:.0f}{w}' for x, w in zip(row['location_m'], within, strict=True))}) mm" + (
        " (± 90 %)" if row["location_within_m"] else ""
    )
