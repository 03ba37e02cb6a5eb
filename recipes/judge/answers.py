"""One answer beside its truth."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from experiment import Recording

SHORT = 0.01  # s, by which a prediction may begin later or end earlier than the trial: clocks differ by 8 ms
SETS = ("explained", "cannot_distinguish")
SILENT = ("nothing_missing", "cannot_tell")
VERDICTS = (*SETS, *SILENT, "unknown_physics")


@dataclass(frozen=True, kw_only=True)
class Scored:
    """What is needed of a case and its answer.

    Attributes:
        case: Name.
        specimen: Its body.
        kind: "effect", "null", "decoy", "pair" or "outside".
        strength: Of the effect over the noise.
        length: Of the body [m].
        truth: Names that were put in.
        verdict: Of the answer; "missing" without one, "failed" if it cannot be read or is none of those there are.
        names: That it commits to.
        set: Names that it cannot tell apart, those it commits to included.
        unknown: Whether it says that something is missing which it does not know.
        location_error: Distance of the place of the true effect [m].
        place_error: The same of the nearest place that is told, whatever it is a place of.
        parameter_errors: Relative errors of the numbers that truth and answer share.
        covered: Whether the interval of each holds the truth.
        likely: What the answer holds for most probable, "nothing" and "unknown" among it; empty without probabilities.
        probability: Of that.
        told_ratio: Held-out error after over before, as the answer states it.
        sealed_ratio: The same for the sealed trial, if the answer predicted it.
        priced_ratio: Error that the answer ascribes to its simulation over that of the sealed trial as predicted, where
            nothing is missing.
        noise_ratio: Standard deviation of the noise, as the answer has it, over the real one, where it was not stated.
        seconds: That the answer took.
    """

    case: str
    specimen: str
    kind: str
    strength: float
    length: float
    truth: tuple[str, ...]
    verdict: str
    names: tuple[str, ...] = ()
    set: tuple[str, ...] = ()
    unknown: bool = False
    location_error: float | None = None
    place_error: float | None = None
    parameter_errors: tuple[float, ...] = ()
    covered: tuple[bool, ...] = ()
    likely: str = ""
    probability: float = 0.0
    told_ratio: float | None = None
    sealed_ratio: float | None = None
    priced_ratio: float | None = None
    noise_ratio: float | None = None
    seconds: float = 0.0


def _rms(value: Any) -> float:
    """Root mean square of a number, or of all numbers in nested lists and tables."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        parts = [_rms(v) for v in value]
        parts = [p for p in parts if not math.isnan(p)]
        return math.sqrt(sum(p * p for p in parts) / len(parts)) if parts else math.nan
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _told(answer: Mapping[str, Any]) -> float | None:
    held = answer.get("heldout")
    rows = held if isinstance(held, list) else [held] if isinstance(held, Mapping) else []
    rows = [r for r in rows if isinstance(r, Mapping)]
    if rows and not any("before" in r for r in rows):
        rows = [v for r in rows for v in r.values() if isinstance(v, Mapping)]
    before, after = _rms([r.get("before") for r in rows]), _rms([r.get("after") for r in rows])
    return after / before if before > 0 and not math.isnan(after) else None


def _sealed(truth: Mapping[str, Any], folder: Path, batch: Path) -> float | None:
    """Root mean square distance of the sealed trial as it was predicted [m]; None if it was not, or not as a whole."""
    clean = Recording.read(batch / "sealed" / truth["case"] / "clean.csv")
    try:
        guess = Recording.read(folder / "predicted.csv")
    except (OSError, ValueError, IndexError):
        return None
    axes = truth.get("axes", guess.axes)  # batches up to the sixteenth do not say in which the belief was compared
    if not {*clean.names} <= {*guess.names} or not axes or not {*axes} <= {*guess.axes}:
        return None
    markers, columns = [guess.names.index(n) for n in clean.names], [guess.axes.index(a) for a in axes]
    place = guess.value[:, markers][..., columns].reshape(len(guess.time), -1)
    whole = guess.time[0] <= clean.time[0] + SHORT and guess.time[-1] >= clean.time[-1] - SHORT
    if not whole or not np.isfinite(place).all() or not (np.diff(guess.time) > 0).all():
        return None
    at = np.stack([np.interp(clean.time, guess.time, column) for column in place.T], 1)
    gap = at - clean.value[..., ["xyz".index(a) for a in axes]].reshape(len(at), -1)
    return float(np.sqrt(np.mean(gap**2)))


def parameter_error(name: str, value: float, truth: float) -> float:
    """Relative error; of a factor that is 1 where nothing is missing, that of its logarithm."""
    if name == "factor":
        return abs(math.log(max(value, 1e-9) / truth)) / max(abs(math.log(truth)), 1e-9)
    return abs(value - truth) / max(abs(truth), 1e-12)


def match(truth: Mapping[str, Any], folder: Path, batch: Path, words: Mapping[str, Any]) -> Scored:
    """Read the answer to a case and compare.

    Args:
        truth: Of the case, from truth.sealed.
        folder: Of all answers.
        batch: That the case belongs to.
        words: Names that the answers use for ours: {"effects": {...}, "parameters": {effect: {...}}}.
    """
    put = tuple(e["name"] for e in truth["effects"])
    common: dict[str, Any] = {
        "case": truth["case"],
        "specimen": truth["specimen"],
        "kind": truth["kind"],
        "strength": truth["strength"],
        "length": truth["body_length_m"],
        "truth": put,
    }
    path = folder / truth["case"] / "explanation.json"
    if not path.exists():
        return Scored(**common, verdict="missing")
    try:
        return _read(truth, json.loads(path.read_text()), folder, batch, words, common)
    except (AttributeError, KeyError, TypeError, ValueError):  # of another form than was asked for
        return Scored(**common, verdict="failed")


def _read(
    truth: Mapping[str, Any],
    answer: Mapping[str, Any],
    folder: Path,
    batch: Path,
    words: Mapping[str, Any],
    common: Mapping[str, Any],
) -> Scored:
    """An answer of the form that was asked for; see :func:`match`."""
    effects = words.get("effects", {})
    put = common["truth"]

    def ours(name: str) -> list[str]:
        return [effects.get(part, part) for part in name.split(" + ")]

    word = answer.get("verdict")
    verdict = word if isinstance(word, str) and word in VERDICTS else "failed"
    named = {effects.get(e["name"], e["name"]): e for e in answer.get("effects") or []}
    told = [n if isinstance(n, str) else n["name"] for n in answer.get("set") or []]
    listed = [part for name in told for part in ours(name)]
    group: tuple[str, ...] = ()
    if verdict == "explained":
        group = tuple(dict.fromkeys([*named, *listed]))
    elif verdict == "cannot_distinguish":
        group = tuple(dict.fromkeys(listed or named))
    errors, covered, place = [], [], None
    places = [e["location_m"] for e in named.values() if e.get("location_m") is not None]
    sites = [e["location_m"] for e in truth["effects"] if e["location_m"] is not None]
    for effect in truth["effects"]:
        said = named.get(effect["name"])
        if said is None or verdict != "explained":
            continue
        if effect["location_m"] is not None and said.get("location_m") is not None:
            place = math.dist(effect["location_m"], said["location_m"])
        rename = words.get("parameters", {}).get(effect["name"], {})
        for name, number in (said.get("parameters") or {}).items():
            own = rename.get(name, name)
            if own in effect["parameters"]:
                real = effect["parameters"][own]
                value = number["value"] if isinstance(number, Mapping) else number
                errors.append(parameter_error(own, float(value), real))
                if isinstance(number, Mapping) and number.get("low") is not None and number.get("high") is not None:
                    covered.append(bool(number["low"] <= real <= number["high"]))
    cost = answer.get("cost") or {}
    probabilities = answer.get("probabilities") or {"": 0.0}
    likely = max(probabilities, key=lambda name: probabilities[name])
    sealed = _sealed(truth, folder / truth["case"], batch)
    errors_told = answer.get("noise") or {}
    priced, noise = errors_told.get("simulation_m"), errors_told.get("standard_deviation_m")
    camera = truth.get("measurement") or {}
    return Scored(
        **common,
        verdict=verdict,
        names=tuple(named) if verdict == "explained" else (),
        set=group,
        unknown=verdict == "unknown_physics" or any(n.startswith("unknown") for n in group),
        location_error=place,
        place_error=min((math.dist(p, s) for p in places for s in sites), default=None),
        parameter_errors=tuple(errors),
        covered=tuple(covered),
        likely=" + ".join(sorted(ours(likely))),
        probability=float(probabilities[likely]),
        told_ratio=_told(answer),
        sealed_ratio=None if sealed is None else 1e3 * sealed / truth["believed_heldout_rms_mm"],
        priced_ratio=priced / sealed if priced and sealed and not put else None,
        noise_ratio=noise / camera["noise"] if noise and camera.get("told") is False else None,
        seconds=float(answer.get("judge_seconds", cost.get("seconds", 0.0)) or 0.0),
    )


def truths(c: Scored) -> tuple[str, ...]:
    """Names of the truth in the words of probabilities."""
    if c.kind == "outside":
        return ("unknown",)
    return (" + ".join(sorted(c.truth)),) if c.truth else ("nothing",)


def check(batch: Path) -> dict[str, Any]:
    """The truth; ValueError if it or a recording is not as it was sealed."""
    text = (batch / "truth.sealed").read_text()
    stated = (batch / "truth.sha256").read_text().split()[0]
    if hashlib.sha256(text.encode()).hexdigest() != stated:
        raise ValueError(f"batch = {batch}: truth.sealed is not what was sealed (SHA-256), wanted it unchanged")
    truth = json.loads(text)
    for name, digest in truth["files"].items():
        if hashlib.sha256((batch / name).read_bytes()).hexdigest() != digest:
            raise ValueError(f"batch = {batch}: {name} is not what was sealed (SHA-256), wanted it unchanged")
    return truth


def calibration_error(told: Sequence[tuple[float, bool]]) -> float:
    """Mean distance of probabilities that are told from the share that is right, over fifths, by their cases.

    Args:
        told: Probability, and whether what it is told of is right, of each case; one or more.
    """
    fifths: dict[int, list[float]] = {}
    for p, right in told:
        fifths.setdefault(min(int(5 * p), 4), []).append(p - right)
    return sum(abs(sum(off)) for off in fifths.values()) / len(told)
