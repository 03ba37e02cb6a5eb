"""Phases of a trial, from what is believed, and where among them a recording and its simulation part."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.signal import savgol_filter

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.fit import Fit, FitProblem
from torchsoro.sim2real.inference.heldout import Prediction
from torchsoro.sim2real.twin.twin import MarkerTrajectory

SHORT = 0.02  # of a trial: no phase is shorter
SLOPE = 0.5  # of the range of a pressure in a trial's duration, above which it rises or falls
WIDE = 31  # thousandths of a trial, over which a pressure's slope is taken, as it may be noisy
CONTACT_DISTANCE = 0.03  # of the body's longest edge, within which a plane is touched
TURN = 0.05  # of the range of a swing, by which it has to come back to be over
SWINGS = 8  # that are told apart
DEPARTURE = 3.0  # times what noise and numerics explain, where recording and simulation part
CUTS = 30  # of a recording, up to which measurement errors are found
LASTING = 0.01  # s, for which they have to stay apart
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


@dataclass(frozen=True)
class Phase:
    """A part of a trial.

    Attributes:
        name: Such as "inflation", "hold", "deflation", "pause", "contact", "flight", "swing" or "inflation in contact",
            with its number where there are several.
        start: [s].
        end: [s].
    """

    name: str
    start: float
    end: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Mismatch:
    """How far a simulation is from a recording, in what noise and the simulation's own error explain.

    Attributes:
        trial: Its name.
        markers: Their names.
        phases: Of the trial.
        time: [T] s.
        before: As believed [T, M]; not a number where a sample was lost.
        after: As explained [T, M].
    """

    trial: str
    markers: tuple[str, ...]
    phases: tuple[Phase, ...]
    time: np.ndarray
    before: np.ndarray
    after: np.ndarray

    @property
    def start(self) -> float | None:
        """When they part as believed [s]; None if they do not."""
        return _parting(self.time, self.before)

    @property
    def phase(self) -> Phase | None:
        """In which they part."""
        if self.start is None:
            return None
        return next((p for p in self.phases if self.start < p.end), self.phases[-1])

    @property
    def marker(self) -> str:
        """Where they are apart most: in the phase in which they part, or else throughout."""
        phase = self.phase
        on = self.time >= 0 if phase is None else (self.time >= (self.start or 0.0)) & (self.time <= phase.end)
        return self.markers[int(np.nan_to_num(_mean(self.before[on], 0)).argmax())]

    @property
    def where(self) -> str:
        """Where and when they part, in words; empty if they do not."""
        if self.start is None or self.phase is None:
            return ""
        return f"at {float(f'{self.start:.3g}'):g} s, in the {self.phase.name}, most at marker {self.marker}"

    def by_phase(self, after: bool = False) -> np.ndarray:
        """Root mean square in each phase, by marker [phases, M]; not a number where nothing was recorded."""
        values = self.after if after else self.before
        return np.stack([_mean(values[(self.time >= p.start) & (self.time <= p.end)], 0) for p in self.phases])

    def __str__(self) -> str:
        """For people."""
        if not self.where:
            return f"Trial {self.trial}: recording and simulation agree throughout."
        worst = together(self.before)[self.time >= (self.start or 0.0)].max()
        return (
            f"Trial {self.trial}: the recording leaves the simulation {self.where}; from then on they are up to "
            f"{float(f'{worst:.2g}'):g} standard deviations of noise and of the simulation's own error apart."
        )


def _mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Root mean square of what is there."""
    there = np.isfinite(values)
    square = np.where(there, values, 0.0) ** 2
    count = there.sum(axis)
    return np.sqrt(np.where(count > 0, square.sum(axis) / np.maximum(count, 1), np.nan))


def together(values: np.ndarray) -> np.ndarray:
    """Root mean square over markers [T], zero where none was seen."""
    return np.nan_to_num(_mean(values, 1))


def mismatches(
    problem: FitProblem, null_model: Fit, trials: Sequence[Trial], after: Sequence[Prediction]
) -> list[Mismatch]:
    """Where and when recordings and simulations part.

    Measurement errors, modulus and pressure are those of the time before, within what is believed: fitted to the whole
    recording they would be bent to hide where it begins.

    Args:
        problem: With what noise and numerics explain.
        null_model: The fit without any effect.
        trials: With recordings.
        after: Each as explained.
    """
    there, n = problem.only(trials), len(problem.common)
    point = np.clip(null_model.point[:n], -1, 1)
    (motions,) = there.simulate([((), point + np.concatenate([np.zeros((1, n)), there.step * np.eye(n)]))])
    found = []
    for i, (trial, motion, other) in enumerate(zip(trials, motions, after, strict=True)):
        recording = trial.recording
        assert recording is not None
        found.append(
            Mismatch(
                trial=trial.name,
                markers=tuple(m.name for m in trial.setup.markers),
                phases=tuple(phases(trial, motion.alone())),
                time=recording.time,
                before=_before(there, i, motion, point),
                after=_mean(
                    (recording.position - other.seen) / np.hypot(there.noise, there.discretization.of(trial)), 2
                ),
            )
        )
    return found


def _before(there: FitProblem, i: int, motion: MarkerTrajectory, point: np.ndarray) -> np.ndarray:
    """Mismatch of trial ``i`` [T, M] with what is fitted along found from more and more of it, until they part."""
    recording, n = there.trials[i].recording, len(point)
    assert recording is not None
    time, prior = recording.time, np.concatenate([np.ones(n), 1 / there.observation.deviations])
    wide = np.hypot(there.noise, there.discretization.of(there.trials[i]))
    x, good = np.zeros(len(prior)), None

    def off(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen, by = there.observation.linearise(motion.alone(0), i, x[n:])
        rise = [(there.observation.observe(motion.alone(k + 1), i, x[n:]) - seen) / there.step for k in range(n)]
        slopes = np.concatenate([np.stack(rise, -1), by], -1) / wide[..., None]
        return (recording.position - seen) / wide - slopes[..., :n] @ x[:n], slopes

    for cut in np.linspace(time[0], time[-1], CUTS + 1)[1:]:
        for _ in range(2):
            r, slopes = off(x)
            rows = np.isfinite(r) & (time <= cut)[:, None, None]
            J, held = slopes[rows], prior**2 * (x + np.append(point, np.zeros(len(x) - n)))
            x = x + np.linalg.solve(J.T @ J + np.diag(prior**2), J.T @ r[rows] - held)
        values = _mean(off(x)[0], 2)
        if good is not None and _parting(time[time <= cut], values[time <= cut]) is not None:
            break
        good = values
    assert good is not None
    return good


def _parting(time: np.ndarray, values: np.ndarray) -> float | None:
    """When values [T, M] are first beyond what is explained, for a while [s]."""
    count = max(3, int(np.searchsorted(time, time[0] + LASTING)))
    if len(time) < count:
        return None
    run = np.convolve(together(values) > DEPARTURE, np.ones(count), "valid") > count - 0.5
    return float(time[int(run.argmax())]) if run.any() else None


def phases(trial: Trial, motion: MarkerTrajectory) -> list[Phase]:
    """Phases of a trial: of its pressure, of contact with planes, of loads; of swings where there are none.

    Args:
        trial: As it is believed.
        motion: As it is simulated, without a batch.
    """
    duration = trial.setup.duration
    time = np.linspace(0, duration, 1001)  # thousandths
    names = [" and ".join(parts) for parts in zip(*_pressures(trial, time), strict=True)] or [""] * len(time)
    for one, more in zip((" in ", " in the "), (_contacts(trial, motion, time), _loads(trial, time)), strict=True):
        if more:
            names = [f"{name}{one}{label}" if name else label for name, label in zip(names, more, strict=True)]
    parts = _runs(names, time)
    if len(parts) == 1:
        parts = _runs(_swings(motion, time), time)
    counts = {name: sum(p.name == name for p in parts) for name in {p.name for p in parts}}
    known: dict[str, int] = {}
    found = []
    for p in parts:
        k = known[p.name] = known.get(p.name, 0) + 1
        ordinal = ORDINALS[k - 1] if k <= len(ORDINALS) else f"{k}th"
        found.append(Phase(f"{ordinal} {p.name}" if counts[p.name] > 1 else p.name, p.start, p.end))
    return found


def _runs(names: Sequence[str], time: np.ndarray) -> list[Phase]:
    """Equal names together; what is too short belongs to what is before it."""
    merged: list[tuple[str, int]] = []
    for name, group in itertools.groupby(names):
        count = len(list(group))
        if merged and (count < SHORT * len(time) or merged[-1][0] == name):
            merged[-1] = merged[-1][0], merged[-1][1] + count
        elif merged and merged[-1][1] < SHORT * len(time):  # only the first can be
            merged[-1] = name, merged[-1][1] + count
        else:
            merged.append((name, count))
    ends = np.cumsum([count for _, count in merged])
    edges = np.append(0.0, time[np.minimum(ends, len(time) - 1)])
    return [Phase(name, float(a), float(b)) for (name, _), a, b in zip(merged, edges[:-1], edges[1:], strict=True)]


def _pressures(trial: Trial, time: np.ndarray) -> list[list[str]]:
    """Of each chamber: whether its pressure rises, falls or stays."""
    if trial.pressure is None:
        return []
    course = trial.pressure.at(torch.from_numpy(time).to(trial.pressure.time)).numpy().reshape(-1, len(time))
    found = []
    for chamber, p in zip(trial.setup.chambers, course, strict=True):
        reach, most = float(np.ptp(p)), float(np.abs(p).max())
        slope = np.asarray(savgol_filter(p, WIDE, 1, deriv=1, delta=float(time[1]), mode="nearest"))
        steep = SLOPE * reach / float(time[-1])
        of = f" of {chamber.name}" if len(course) > 1 else ""
        names = []
        for s, value in zip(slope, p, strict=True):
            if abs(s) > steep > 0:
                names.append(("inflation" if s > 0 else "deflation") + of)
            else:
                names.append(("hold" if abs(value) > TURN * most else "pause") + of)
        found.append(names)
    return found


def _contacts(trial: Trial, motion: MarkerTrajectory, time: np.ndarray) -> list[str]:
    """Whether a corner of the body, which moves as the marker nearest to it does, is at a plane."""
    s = trial.setup
    if not s.planes:
        return []
    corners = np.array(s.origin) + np.array(list(itertools.product((0, 1), repeat=3))) * np.array(s.size)
    at = np.array([m.at for m in s.markers])
    near = np.linalg.norm(corners[:, None] - at, axis=-1).argmin(1)
    moved = motion.position[:, near] + np.einsum("scij,cj->sci", motion.deformation[:, near], corners - at[near])
    above = np.full(len(motion.time), np.inf)
    for plane in s.planes:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        above = np.minimum(above, ((moved - np.array(plane.point)) @ normal).min(1))
    touched, now = np.zeros(len(above), bool), False
    for k, height in enumerate(above / (CONTACT_DISTANCE * max(s.size))):
        now = bool(height < (2 if now else 1))  # left only when it is well off
        touched[k] = now
    on = touched[np.clip(np.searchsorted(motion.time, time), 0, len(touched) - 1)]
    away = "free motion" if s.clamps else "flight"
    return ["contact" if t else away for t in on]


def _loads(trial: Trial, time: np.ndarray) -> list[str]:
    """Which of the loads that begin later has begun, and whether all have ended that do."""
    loads = trial.setup.forces
    starts = sorted({load.start for load in loads if 0 < load.start < time[-1]})
    ends = [load.end for load in loads if load.end < time[-1]]
    if not starts and not ends:
        return []
    count = np.searchsorted(starts, time, side="right")
    of = [f"load {k + 1}" if len(starts) > 1 else "the load" for k in range(len(starts))]
    first = f"time before {of[0]}" if starts else "time under the load"
    names = [first if k == 0 else f"time under {of[k - 1]}" for k in count]
    return ["time after the load" if ends and t >= max(ends) else name for t, name in zip(time, names, strict=True)]


def _swings(motion: MarkerTrajectory, time: np.ndarray) -> list[str]:
    """From one turning point to the next, of the marker that moves most, along which it does."""
    moved = motion.position - motion.position.mean(0)
    most = int((moved**2).sum((0, 2)).argmax())
    _, _, axes = np.linalg.svd(moved[:, most], full_matrices=False)
    x = np.interp(time, motion.time, moved[:, most] @ axes[0])
    enough = TURN * float(np.ptp(x))
    if enough < 1e-9:
        return ["rest"] * len(time)
    turns, extreme, way = [], 0, 0
    for k, value in enumerate(x):
        if way == 0:
            way = int(np.sign(value - x[0])) if abs(value - x[0]) > enough else 0
            extreme = k
        elif way * (value - x[extreme]) > 0:
            extreme = k
        elif way * (x[extreme] - value) > enough:
            turns.append(extreme)
            extreme, way = k, -way
    number = np.searchsorted(turns, np.arange(len(time)), side="right")
    return ["later swings" if n >= SWINGS else f"{ORDINALS[n]} swing" for n in number]
