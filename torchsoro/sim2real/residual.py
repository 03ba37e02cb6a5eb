"""What is recorded of a motion, measurement errors included, and how far it may be off before that means anything."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import solve_triangular

from torchsoro.sim2real.experiment import Setup, Trial
from torchsoro.sim2real.recording import Recording
from torchsoro.sim2real.twin import Motion

CORRELATION = 0.03  # s over which the twin's own error lasts


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
    """

    clock: float = 0.01
    rate: float = 0.002
    scale: float = 0.02
    metres: float = 0.002
    rotation: float = 0.01
    place: float = 0.0007


class Camera:
    """From motions of all trials to what would have been recorded, and its derivatives by the measurement errors.

    The errors are one vector: a clock offset for each trial; clock rate, ln of the scale, rotation about x, y, z; then
    the displacement of each marker in the undeformed body.

    Args:
        setup: Of the experiment.
        trials: With recordings.
        priors: Of the errors.
    """

    def __init__(self, setup: Setup, trials: Sequence[Trial], priors: Priors | None = None) -> None:
        priors = priors or Priors()
        self.setup, self.trials = setup, tuple(trials)
        self.markers = len(setup.markers)
        scale = priors.scale if setup.kind == "video" else priors.metres
        common = [priors.rate, scale, *[priors.rotation] * 3, *[priors.place] * (3 * self.markers)]
        self.deviations = np.array([priors.clock] * len(trials) + common)
        self.names = [f"clock_{t.name}_s" for t in trials]
        self.names += ["clock_rate", "ln_scale", *(f"rotation_{a}_rad" for a in "xyz")]
        self.names += [f"{m.name}_{a}_m" for m in setup.markers for a in "xyz"]

    def see(self, motion: Motion, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What trial ``number`` would have recorded.

        Args:
            motion: Of that trial, without a batch.
            number: Of the trial.
            errors: Measurement errors [K].

        Returns:
            Places [T, M, A] m, and their derivatives by the errors [T, M, A, K].
        """
        recording = self.trials[number].recording
        assert recording is not None
        count = len(self.trials)
        rate, ln_scale = errors[count : count + 2]
        turn, place = errors[count + 2 : count + 5], errors[count + 5 :].reshape(self.markers, 3)
        clock = recording.time - errors[number]
        own = np.clip(clock / (1 + rate), 0.0, float(motion.time[-1]))
        x, v, gradient = _at(motion, own)
        v = v * ((clock > 0) & (clock < float(motion.time[-1])))[:, None, None]
        body = x + np.einsum("tmij,mj->tmi", gradient, place)
        scale, R = math.exp(ln_scale), _rotation(turn)
        seen = scale * body @ R.T
        by = np.zeros((*seen.shape, len(errors)))
        turned = scale * v @ R.T
        by[..., number] = -turned / (1 + rate)
        by[..., count] = -turned * own[:, None, None] / (1 + rate)
        by[..., count + 1] = seen
        for axis in range(3):
            unit = np.zeros(3)
            unit[axis] = 1.0
            by[..., count + 2 + axis] = np.cross(unit, seen)
        moved = scale * np.einsum("ia,tmaj->tmij", R, gradient)
        for m in range(self.markers):
            by[:, m, :, count + 5 + 3 * m : count + 8 + 3 * m] = moved[:, m]
        axes = list(self.setup.axes)
        return seen[:, :, axes], by[:, :, axes]


def _at(motion: Motion, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, velocities and deformation gradients at times."""
    t = motion.time.numpy()
    spline = CubicHermiteSpline(t, motion.place.numpy(), motion.velocity.numpy())
    at = np.clip(np.searchsorted(t, time, side="right") - 1, 0, len(t) - 2)
    share = ((time - t[at]) / (t[at + 1] - t[at]))[:, None, None, None]
    gradient = motion.gradient.numpy()
    return spline(time), spline(time, 1), (1 - share) * gradient[at] + share * gradient[at + 1]


def _rotation(turn: np.ndarray) -> np.ndarray:
    """Rotation by a vector [rad]."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    return np.eye(3) + math.sin(angle) / angle * cross + (1 - math.cos(angle)) / angle**2 * cross @ cross


class Band:
    """How far residuals may be off: white noise, and what the twin's numerics get wrong, which lasts for a while.

    Args:
        recording: Of the trial.
        noise: Standard deviation of the noise [m].
        numerics: That of the twin's error, by marker and axis [M, A] m.
    """

    def __init__(self, recording: Recording, noise: float, numerics: np.ndarray) -> None:
        self.channels = []
        lag = np.abs(recording.time[:, None] - recording.time[None, :])
        alike = np.exp(-lag / CORRELATION)
        for m, a in np.ndindex(*numerics.shape):
            rows = np.flatnonzero(recording.seen[:, m, a])
            covariance = noise**2 * np.eye(len(rows)) + numerics[m, a] ** 2 * alike[np.ix_(rows, rows)]
            self.channels.append((m, a, rows, np.linalg.cholesky(covariance)))
        self.count = sum(len(rows) for _, _, rows, _ in self.channels)

    def whiten(self, values: np.ndarray) -> np.ndarray:
        """Divide by what may be: [T, M, A, ...] to [samples, ...], of variance 1 if nothing is wrong."""
        parts = []
        for m, a, rows, root in self.channels:
            v = values[rows, m, a]
            parts.append(solve_triangular(root, v.reshape(len(rows), -1), lower=True).reshape(v.shape))
        return np.concatenate(parts)

    @property
    def logarithm(self) -> float:
        """Ln of the determinant of the covariance."""
        return 2 * sum(float(np.log(np.diag(root)).sum()) for *_, root in self.channels)


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
