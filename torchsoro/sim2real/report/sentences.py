"""What a report says, in sentences."""

from __future__ import annotations

import math
import re

from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.next_experiment import advice
from torchsoro.sim2real.inference.ranking import Candidate
from torchsoro.sim2real.inference.verdict import number
from torchsoro.sim2real.report.explanation import Explanation, effect_rows

BELIEVED = 3.0  # standard deviations of a measurement error that are believed


def lead(e: Explanation) -> str:
    """The answer in plain words."""
    v = e.verdict
    held = list(v.heldout.values())
    gain = ""
    if held:
        before, after = (math.sqrt(sum(x * x for x in column) / len(held)) for column in zip(*held, strict=True))
        gain = (
            f" On trials that were left out ({', '.join(v.heldout)}) the error is {1e3 * after:.2f} mm instead of "
            f"{1e3 * before:.2f} mm."
        )
    if v.kind == "nothing_missing":
        return (
            "Nothing is missing: clock, scale, marker places, modulus and pressure within their beliefs, and the error "
            f"of the simulation itself explain the difference.{gain}"
        )
    if v.kind == "unknown_physics":
        best = v.ranking[0] if v.ranking else None
        tried = (
            f" The best of what is known, {_plain(best.fit.name)}, takes away {100 * best.explained:.0f} % of it."
            if best
            else ""
        )
        force = f" {e.forces}" if e.forces else ""
        return f"{_parting(e)}Something is missing that is none of the known effects.{tried}{gain}{force}"
    parts = "; ".join(_said(c, e.problem) for c in v.chosen)
    if v.kind == "cannot_distinguish":
        following = f" {advice(e.following)}".rstrip()
        which = f"One of these is missing, and this recording cannot tell which: {parts}."
        return f"{_parting(e)}{which}{following}{gain}{_beyond(e)}"
    second = next((c for c in v.ranking if c is not v.chosen[0]), None)
    lost = ""
    if second is not None:
        lost = (
            f" Next best is {_plain(second.fit.name)}, which takes away {100 * max(second.explained, 0):.0f} % of the "
            f"difference against {100 * v.chosen[0].explained:.0f} %, and leaves "
            f"{second.fit.chi2 / v.chosen[0].fit.chi2:.3g} times the misfit."
        )
    return f"{_parting(e)}Missing is {parts}.{gain}{lost}{_beyond(e)}"


def _plain(name: str, unit: str = "") -> str:
    """A name without its unit and underscores."""
    suffix = re.sub(r"[ /]", "_", unit).lower()
    return name.removesuffix(f"_{suffix}").replace("_", " ")


def _parting(e: Explanation) -> str:
    """Where and when, in the trial in which it is first."""
    apart = [m for m in e.mismatches if m.where]
    if not apart:
        return ""
    first = min(apart, key=lambda m: m.start or 0.0)
    return f"Simulation and recording part in trial {first.trial} {first.where}. "


def _beyond(e: Explanation) -> str:
    """Measurement errors that are larger than can be believed: something else is hidden in them."""
    observation = e.problem.observation
    large = []
    for name, value, deviation in zip(observation.names, e.best.errors, observation.deviations, strict=True):
        if abs(value) > BELIEVED * deviation:
            unit = next((u for u in ("rad", "m", "s") if name.endswith(f"_{u}")), "1")
            large.append(f"{_plain(name, unit)} {number(value, unit)} (believed within {deviation:.2g})")
    if not large:
        return ""
    told = (
        " But the fit bends measurement errors further than can be believed, so that more is missing than this: "
        f"{', '.join(large)}."
    )
    if e.verdict.excess > 1:
        told += (
            f" What is left over is {e.verdict.excess:.2g} times what noise and the simulation's own error explain; "
            "where and when is drawn below."
        )
    return told


def _said(candidate: Candidate, problem: FitProblem) -> str:
    parts = []
    for row in effect_rows(candidate.fit, 0.0, problem):
        numbers = ", ".join(
            f"{_plain(name, p['unit'])} {number(p['value'], p['unit'])} (90 %: {p['low']:.3g} to {p['high']:.3g})"
            for name, p in row["parameters"].items()
        )
        place = ""
        if row["location_m"] is not None:
            within = [f" ± {1e3 * w:.0f}" for w in row["location_within_m"] or []] or [""] * 3
            at = [f"{1e3 * x:.0f}{w}" for x, w in zip(row["location_m"], within, strict=True)]
            place = f" at ({', '.join(at)}) mm"
        parts.append(f"{_plain(row['name'])}{place}: {numbers}")
    return " and ".join(parts)
