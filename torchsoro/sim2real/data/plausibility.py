"""Mistakes in an experiment that show before anything is simulated, each with what is seen and what to do about it.

What can follow nothing but nonsense is refused where files are read (:mod:`torchsoro.sim2real.data.experiment`). Here
are those that can be put right without doubt, and hints.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Experiment, Setup, Trial, read_otherwise
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.data.samples import REPEATS, exchanges, put_back, repeated, spikes, stuck

FEW = 5  # repeated rows, that are not yet strange
COLLAPSE = 1.0  # weight of the body's longest edge over its modulus: what is softer cannot stand
AIR = (8.5e4, 1.1e5)  # Pa, of the atmosphere
STRONG = 0.2  # of the modulus: what begins under such a pressure is not undeformed
SLOW = 2.0  # periods of the body between two samples, from which on no swing is seen


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something in the data that is likely to be a mistake.

    Attributes:
        where: Trials, or the setup.
        what: That is seen, in words.
        evidence: Numbers that show it.
        remedy: What was done about it, or should be.
    """

    where: tuple[str, ...]
    what: str
    evidence: str
    remedy: str

    def __str__(self) -> str:
        """For people."""
        trials = [f"trial{'s' if len(self.where) > 1 else ''} {', '.join(self.where)}: "] if self.where else []
        return f"{''.join(trials)}{self.what} ({self.evidence}): {self.remedy}"


def merged(findings: Sequence[Finding]) -> list[Finding]:
    """One finding of each kind, for all trials that it is in; numbers are those of the first."""
    found: dict[tuple[str, str], Finding] = {}
    for one in findings:
        first = found.setdefault((one.what, one.remedy), one)
        where = tuple(dict.fromkeys((*first.where, *one.where)))
        found[one.what, one.remedy] = dataclasses.replace(first, where=where)
    return list(found.values())


def plausible(experiment: Experiment) -> tuple[Experiment, list[Finding]]:
    """The experiment with what is certain put right, and what was found.

    Put right are columns of markers that are exchanged, throughout or from a sample on; samples that are off for one
    row are lost.

    Args:
        experiment: As read.
    """
    findings = of_setup(experiment)
    groups = []
    for group in (experiment.trials, experiment.heldout):
        mended = []
        for trial in group:
            right, found = of_trial(trial)
            mended.append(right)
            findings += found
        groups.append(tuple(mended))
    findings += copies([*experiment.trials, *experiment.heldout])
    return dataclasses.replace(experiment, trials=groups[0], heldout=groups[1]), merged(findings)


def of_trial(trial: Trial) -> tuple[Trial, list[Finding]]:
    """A trial with what is certain put right, and what was found in it."""
    recording, found = trial.recording, []
    if recording is None:
        return trial, found
    names = [m.name for m in trial.setup.markers]

    def note(what: str, evidence: str, remedy: str) -> None:
        found.append(Finding(where=(trial.name,), what=what, evidence=evidence, remedy=remedy))

    away, readings = read_otherwise(recording, trial.setup)
    if readings:
        told = list(dict.fromkeys(r.says(names) for r in readings))
        seen = (
            f"markers begin {1e3 * away:.2g} mm from where setup.toml has them, "
            f"and {1e3 * readings[0].away:.2g} mm if so"
        )
        if readings[0].names_only:
            place = recording.position[:, np.argsort(readings[0].order)]
            recording = dataclasses.replace(recording, position=place)
            note("; or ".join(told), seen, "they were put right; check their names")
        elif readings[0].origin_only:
            note("; or ".join(told), seen, "give places in the frame of setup.toml")
    if swaps := exchanges(recording):
        when = ", ".join(f"{recording.time[e.start]:g}" for e in swaps[:5])
        moved = sorted({names[k] for e in swaps for k, j in enumerate(e.order) if k != j})
        recording = put_back(recording, swaps)
        note(f"{', '.join(moved)} change places", f"at {when} s", "they were put back")
    off = spikes(recording)
    if off.any():
        rows, markers = np.nonzero(off)
        parts = [f"{names[m]} at {recording.time[k]:g} s" for k, m in zip(rows[:3], markers[:3], strict=True)]
        more = f" and {len(rows) - 3} more" if len(rows) > 3 else ""
        recording = dataclasses.replace(recording, position=np.where(off[..., None], np.nan, recording.position))
        note("samples off the path for a single row", f"{', '.join(parts)}{more}", "they count as lost")
    found += _repeats(recording, trial.name, names)
    found += _sampling(recording, trial) + _absolute(trial)
    return dataclasses.replace(trial, recording=recording), found


def _repeats(recording: Recording, trial: str, names: Sequence[str]) -> list[Finding]:
    """Rows, values and columns that are there twice."""
    found = []
    again, moving = repeated(recording)
    if again >= FEW and again > REPEATS * moving:
        found.append(
            Finding(
                where=(trial,),
                what="rows repeat the row before while the body moves",
                evidence=f"{again} of {moving} rows",
                remedy="leave them out, as they were recorded at a lower rate",
            )
        )
    for m, (start, end) in stuck(recording).items():
        found.append(
            Finding(
                where=(trial,),
                what=f"marker {names[m]} keeps one value to the last digit while others move",
                evidence=f"{start:g} to {end:g} s",
                remedy="leave its cells empty where it was not followed",
            )
        )
    for one, other in itertools.combinations(range(len(names)), 2):
        if np.array_equal(recording.position[:, one], recording.position[:, other], equal_nan=True):
            found.append(
                Finding(
                    where=(trial,),
                    what=f"markers {names[one]} and {names[other]} have the same columns",
                    evidence=f"{len(recording.time)} rows",
                    remedy="give each its own, or leave one out of setup.toml",
                )
            )
    return found


def _sampling(recording: Recording, trial: Trial) -> list[Finding]:
    """Whether samples are so far apart that they show no motion of the body."""
    interval, period = float(np.median(np.diff(recording.time))), slowest_period(trial.setup)
    if not interval > SLOW * period:
        return []
    return [
        Finding(
            where=(trial.name,),
            what="samples are too far apart to show a motion of the body",
            evidence=f"{interval:g} s between two of them, and a period of about {period:.2g} s by size and modulus",
            remedy="are times and duration in seconds, and youngs_modulus in Pa?",
        )
    ]


def _absolute(trial: Trial) -> list[Finding]:
    """Whether pressures are absolute ones: never below that of the atmosphere."""
    if trial.pressure is None:
        return []
    least = float(trial.pressure.pressure.min())
    if not (AIR[0] < least < AIR[1] and least > STRONG * trial.setup.youngs_modulus):
        return []
    return [
        Finding(
            where=(trial.name,),
            what="the pressure is never below that of the atmosphere",
            evidence=f"{least / 1e3:.3g} kPa, and youngs_modulus is {trial.setup.youngs_modulus / 1e3:.3g} kPa",
            remedy="is it gauge pressure, 0 for a chamber that is open to the air?",
        )
    ]


def slowest_period(setup: Setup) -> float:
    """Period of the slowest swing [s] of a bar of the body's size that is clamped at one end."""
    thin, _, long = sorted(setup.size)
    return 2 * math.pi * long**2 / (3.516 * thin) * math.sqrt(12 * setup.density / setup.youngs_modulus)


def of_setup(experiment: Experiment) -> list[Finding]:
    """Units in setup.toml that do not go together."""
    s, found = experiment.setup, []
    weight = s.density * math.hypot(*s.gravity) * max(s.size)
    if weight > COLLAPSE * s.youngs_modulus:
        found.append(
            Finding(
                where=(),
                what="setup.toml: the body cannot bear its own weight",
                evidence=f"density, gravity and longest edge make {weight:.3g} Pa, youngs_modulus is "
                f"{s.youngs_modulus:.3g} Pa",
                remedy="is youngs_modulus in Pa, and the size in metres?",
            )
        )
    if s.clamps and all(_within(m.at, s) for m in s.markers):
        found.append(
            Finding(
                where=(),
                what="setup.toml: all markers are on clamped parts",
                evidence=f"{len(s.markers)} of {len(s.markers)}",
                remedy="nothing can be seen of a motion; is the clamp's box right?",
            )
        )
    return found


def _within(place: Sequence[float], setup: Setup) -> bool:
    return any(all(a <= x <= b for a, x, b in zip(low, place, high, strict=True)) for low, high in setup.clamps)


def copies(trials: Sequence[Trial]) -> list[Finding]:
    """Trials that hold the same recording."""
    found = []
    for one, other in itertools.combinations([t for t in trials if t.recording is not None], 2):
        a, b = one.recording, other.recording
        assert a is not None and b is not None
        if np.array_equal(a.position, b.position, equal_nan=True):
            found.append(
                Finding(
                    where=(one.name, other.name),
                    what="the same recording",
                    evidence=f"{len(a.time)} rows",
                    remedy="give each trial its own",
                )
            )
    return found
