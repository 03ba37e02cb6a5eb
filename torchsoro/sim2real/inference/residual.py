"""What is recorded of a motion, measurement errors included, and how far it may be off before that means anything."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import linear_sum_assignment

from torchsoro.sim2real.data.experiment import Experiment, Setup, Trial
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.twin.twin import Motion

CORRELATION = 0.03  # s over which the twin's own error lasts, and a part of the noise
LASTING = 0.25  # of the variance of the noise
LATE = 3.0  # standard deviations that a clock may be behind


@dataclass(frozen=True, kw_only=True)
class Priors:
    """Standard deviations of measurement errors, which are fitted always and are not physics.

    Attributes:
        clock: Offset of each trial's clock [s].
        rate: Relative error of the clock.
        scale: Relative error of a video's scale.
        metres: The same where the recording is in metres.
        rotation: Of the recording's frame about each axis [rad].
        place: Of a marker, along each axis [m].
        slip: Of a marker that has slipped, along each axis [m].
    """

    clock: float = 0.01
    rate: float = 0.002
    scale: float = 0.02
    metres: float = 0.005
    rotation: float = 0.01
    place: float = 0.0007
    slip: float = 0.003


@dataclass(frozen=True, kw_only=True)
class Slip:
    """A marker that moves on the body during a recording.

    Attributes:
        trial: Its name.
        marker: Number of the marker.
        start: When [s], by the recording's clock; it is over 10 ms later.
    """

    trial: str
    marker: int
    start: float

    def course(self, time: np.ndarray) -> np.ndarray:
        """Share of the way [T]."""
        return np.clip((time - self.start) / 0.01, 0.0, 1.0)


class Camera:
    """From motions of all trials to what would have been recorded, and its derivatives by the measurement errors.

    The errors are one vector: a clock offset for each trial; clock rate, ln of the scale, rotation about x, y, z; then
    the displacement of each marker in the undeformed body; then of each slip, as recorded.

    Args:
        setup: Of the experiment.
        trials: With recordings.
        priors: Of the errors.
        slips: Markers that have slipped.
    """

    def __init__(
        self, setup: Setup, trials: Sequence[Trial], priors: Priors | None = None, slips: Sequence[Slip] = ()
    ) -> None:
        priors = priors or Priors()
        self.setup, self.trials, self.slips = setup, tuple(trials), tuple(slips)
        self.markers = len(setup.markers)
        scale = priors.scale if setup.kind == "video" else priors.metres
        common = [priors.rate, scale, *[priors.rotation] * 3, *[priors.place] * (3 * self.markers)]
        common += [priors.slip] * (3 * len(slips))
        self.deviations = np.array([priors.clock] * len(trials) + common)
        self.names = [f"clock_{t.name}_s" for t in trials]
        self.names += ["clock_rate", "ln_scale", *(f"rotation_{a}_rad" for a in "xyz")]
        self.names += [f"{m.name}_{a}_m" for m in setup.markers for a in "xyz"]
        self.names += [f"slip_{s.trial}_{setup.markers[s.marker].name}_{a}_m" for s in slips for a in "xyz"]

    def until(self, number: int) -> float:
        """When trial ``number`` may have ended by the body's clock at the latest [s]: its clock may be behind."""
        trial, clock, rate = self.trials[number], self.deviations[number], self.deviations[len(self.trials)]
        assert trial.recording is not None
        last = float(trial.recording.time[-1])
        return max(trial.setup.duration, (last + LATE * clock) * (1 + LATE * rate))

    def see(self, motion: Motion, number: int, errors: np.ndarray) -> np.ndarray:
        """What trial ``number`` would have recorded.

        Args:
            motion: Of that trial, without a batch.
            number: Of the trial.
            errors: Measurement errors [K].

        Returns:
            Places [T, M, A] m.
        """
        own, place, frame = self._view(motion, number, errors)
        return self._recorded(_at(motion, own, place)[0] @ frame.T, number, errors)

    def linearise(self, motion: Motion, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`see`, and the derivatives of the places by the errors [T, M, A, K]."""
        count, rate = len(self.trials), errors[len(self.trials)]
        own, place, frame = self._view(motion, number, errors)
        body, velocity, gradient = _at(motion, own, place)
        seen = body @ frame.T
        # The clock does nothing before the motion begins and after it ends.
        turned = (velocity * ((own > 0) & (own < float(motion.time[-1])))[:, None, None]) @ frame.T
        by = np.zeros((*seen.shape, len(errors)))
        by[..., number] = -turned / (1 + rate)
        by[..., count] = -turned * own[:, None, None] / (1 + rate)
        by[..., count + 1] = seen
        for axis, unit in enumerate(np.eye(3)):
            by[..., count + 2 + axis] = np.cross(unit, seen)
        moved = np.einsum("ia,tmaj->tmij", frame, gradient)
        for m in range(self.markers):
            by[:, m, :, count + 5 + 3 * m : count + 8 + 3 * m] = moved[:, m]
        for marker, first, course in self._slipping(number):
            for axis in range(3):
                by[:, marker, axis, first + axis] = course
        return self._recorded(seen, number, errors), by[:, :, list(self.setup.axes)]

    def _view(self, motion: Motion, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times by the body's clock [T] s, places of markers [M, 3] m, and scale times rotation [3, 3]."""
        recording, count = self.trials[number].recording, len(self.trials)
        assert recording is not None
        rate, ln_scale = errors[count : count + 2]
        own = np.clip((recording.time - errors[number]) / (1 + rate), 0.0, float(motion.time[-1]))
        place = errors[count + 5 : count + 5 + 3 * self.markers].reshape(self.markers, 3)
        return own, place, math.exp(ln_scale) * _rotation(errors[count + 2 : count + 5])

    def _slipping(self, number: int) -> list[tuple[int, int, np.ndarray]]:
        """Markers that slip in a trial: which, where its errors begin, and share of the way [T]."""
        trial, first = self.trials[number], len(self.trials) + 5 + 3 * self.markers
        assert trial.recording is not None
        return [
            (slip.marker, first + 3 * k, slip.course(trial.recording.time))
            for k, slip in enumerate(self.slips)
            if slip.trial == trial.name
        ]

    def _recorded(self, seen: np.ndarray, number: int, errors: np.ndarray) -> np.ndarray:
        """Places [T, M, 3] m with what slips, along the axes that are recorded."""
        seen = seen.copy()
        for marker, first, course in self._slipping(number):
            seen[:, marker] += course[:, None] * errors[first : first + 3]
        return seen[:, :, list(self.setup.axes)]


def _at(motion: Motion, time: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and velocities at times, by Hermite's cubic between samples, and deformation gradients.

    The places are of points that lie so far [M, 3] m from the motion's own in the undeformed body.
    """
    t = motion.time
    at = np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 2)
    h = (t[at + 1] - t[at])[:, None, None]
    s = (time - t[at])[:, None, None] / h
    begin, end = motion.place[at], motion.place[at + 1]
    chord = (end - begin) / h
    first, last = motion.velocity[at] - chord, motion.velocity[at + 1] - chord
    place = begin + s * (end - begin) + h * s * (1 - s) * ((1 - s) * first - s * last)
    velocity = chord + (1 - s) * (1 - 3 * s) * first + s * (3 * s - 2) * last
    s = s[..., None]
    gradient = (1 - s) * motion.gradient[at] + s * motion.gradient[at + 1]
    return place + np.einsum("tmij,mj->tmi", gradient, beside), velocity, gradient


def _rotation(turn: np.ndarray) -> np.ndarray:
    """Rotation by a vector [rad]."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    return np.eye(3) + math.sin(angle) / angle * cross + (1 - math.cos(angle)) / angle**2 * cross @ cross


class Band:
    """How far residuals may be off: noise, and what the twin's numerics get wrong; both may last for a while.

    Args:
        recording: Of the trial.
        noise: Standard deviation of the noise [m].
        numerics: That of the twin's error, by marker and axis [M, A] m.
        lasting: Share of the noise's variance that lasts from sample to sample.
    """

    def __init__(self, recording: Recording, noise: float, numerics: np.ndarray, lasting: float = LASTING) -> None:
        lag = np.abs(recording.time[:, None] - recording.time[None, :])
        alike = np.exp(-lag / CORRELATION)
        self.channels: list[tuple[np.ndarray, list[tuple[int, int]], np.ndarray]] = []
        known: dict[tuple[bytes, float], int] = {}
        for m, a in np.ndindex(*numerics.shape):
            rows = np.flatnonzero(recording.seen[:, m, a])
            if not len(rows):
                continue
            key = rows.tobytes(), float(numerics[m, a])
            if key in known:
                self.channels[known[key]][1].append((m, a))
                continue
            known[key] = len(self.channels)
            slow = lasting * noise**2 + numerics[m, a] ** 2
            covariance = (1 - lasting) * noise**2 * np.eye(len(rows)) + slow * alike[np.ix_(rows, rows)]
            root = np.linalg.cholesky(covariance)
            self.channels.append((rows, [(m, a)], solve_triangular(root, np.eye(len(rows)), lower=True)))
        self.count = sum(len(rows) * len(pairs) for rows, pairs, _ in self.channels)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Divide by what may be: [T, M, A, ...] to [samples, ...], of variance 1 if nothing is wrong."""
        parts = []
        for rows, pairs, inverse in self.channels:
            v = np.stack([values[rows, m, a] for m, a in pairs])
            flat = inverse @ v.reshape(len(pairs), len(rows), -1)
            parts.append(flat.reshape(-1, *values.shape[3:]))
        return np.concatenate(parts)


def find_slips(trials: Sequence[Trial], bands: Sequence[Band], left: Sequence[np.ndarray]) -> list[Slip]:
    """The marker whose slipping would explain most of what is left, if that is half of it all.

    Args:
        trials: With recordings.
        bands: How far residuals may be off, of each trial.
        left: Residuals of each trial [T, M, A] m, not whitened.
    """
    markers = left[0].shape[1]
    gains = np.zeros((len(trials), markers))
    starts = np.zeros((len(trials), markers))
    excess = 0.0
    for i, (trial, band, r) in enumerate(zip(trials, bands, left, strict=True)):
        assert trial.recording is not None
        time = trial.recording.time
        tried = np.linspace(time[0], time[-1], 62)[1:-1]
        courses = np.stack([Slip(trial=trial.name, marker=0, start=t).course(time) for t in tried], -1)
        found = np.zeros((markers, len(tried)))
        for rows, pairs, inverse in band.channels:
            steps = inverse @ courses[rows]
            ones = (inverse @ np.ones(len(rows)))[:, None]
            # Apart from where the marker is from the start on.
            steps = steps - ones * (ones.T @ steps) / float((ones**2).sum())
            for m, a in pairs:
                white = inverse @ r[rows, m, a]
                excess += float(white @ white) - len(rows)
                white = white - ones[:, 0] * float(ones[:, 0] @ white) / float((ones**2).sum())
                found[m] += (steps.T @ white) ** 2 / ((steps**2).sum(0) + 1e-9)
        gains[i], starts[i] = found.max(1), tried[found.argmax(1)]
    marker = int(gains.sum(0).argmax())
    if gains[:, marker].sum() < max(100.0, 0.5 * excess):
        return []
    return [
        Slip(trial=t.name, marker=marker, start=float(starts[i, marker]) - 0.005)
        for i, t in enumerate(trials)
        if gains[i, marker] > 30
    ]


def reordered(experiment: Experiment) -> tuple[Experiment, str]:
    """The experiment with the columns of markers that were confused put right, and what was, in words.

    Only where recordings begin with the body as it is stated, and the stated order is far off.
    """
    setup = experiment.setup
    recordings = [t.recording for t in experiment.trials if t.recording is not None]
    stated = np.array([m.at for m in setup.markers])[:, list(setup.axes)]
    first = [np.nanmean(r.place[:5], axis=0) for r in recordings if np.isfinite(r.place[:5]).any(0).all()]
    if not first:
        return experiment, ""
    away = np.linalg.norm(stated[:, None] - np.mean(first, axis=0)[None], axis=-1)
    _, order = linear_sum_assignment(away)
    moved = np.flatnonzero(order != np.arange(len(order)))
    if not len(moved) or away[moved, order[moved]].sum() > 0.4 * away[moved, moved].sum():
        return experiment, ""

    def right(trial: Trial) -> Trial:
        if trial.recording is None:
            return trial
        return dataclasses.replace(
            trial, recording=dataclasses.replace(trial.recording, place=trial.recording.place[:, order])
        )

    names = ", ".join(setup.markers[i].name for i in moved)
    put = dataclasses.replace(
        experiment, trials=tuple(map(right, experiment.trials)), heldout=tuple(map(right, experiment.heldout))
    )
    return put, f"columns of {names} were confused"


def estimate_noise(recordings: Sequence[Recording]) -> float:
    """Standard deviation of the noise [m], from third differences of the quieter half of the samples.

    Motion that is smooth over four samples drops out of a third difference, noise does not: its variance is 20 times
    that of a sample.
    """
    found = []
    for r in recordings:
        third = np.diff(r.place, 3, axis=0)
        third = third[np.isfinite(third)]
        if len(third):
            found.append(np.abs(third))
    pooled = np.sort(np.concatenate(found))
    # Where a normal distribution has its lower quartile of absolute values; motion fills the upper part.
    return float(np.quantile(pooled, 0.25)) / 0.3186 / math.sqrt(20.0)
