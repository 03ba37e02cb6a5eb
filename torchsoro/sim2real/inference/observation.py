"""What a motion leaves in a recording: the observation model, with its measurement errors as parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.twin.twin import MarkerMotion

CLOCK_LIMIT = 3.0  # standard deviations of a clock offset, beyond which it is not looked for


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
class MarkerSlip:
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


class ObservationModel:
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
        self, setup: Setup, trials: Sequence[Trial], priors: Priors | None = None, slips: Sequence[MarkerSlip] = ()
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
        return max(trial.setup.duration, (last + CLOCK_LIMIT * clock) * (1 + CLOCK_LIMIT * rate))

    def observe(self, motion: MarkerMotion, number: int, errors: np.ndarray) -> np.ndarray:
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

    def linearise(self, motion: MarkerMotion, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    def _view(self, motion: MarkerMotion, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _at(motion: MarkerMotion, time: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
