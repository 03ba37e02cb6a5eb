"""What a motion leaves in a recording: the observation model, with its measurement errors as parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchsoro.sim2real.data.experiment import Setup, Trial
from torchsoro.sim2real.twin.twin import MarkerTrajectory

# Of a rotation about x, y, z: the change of a place is this matrix times the place.
SPINS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)
CLOCK_LIMIT = 3.0  # standard deviations of a clock offset, beyond which it is not looked for


@dataclass(frozen=True, kw_only=True)
class Priors:
    """Standard deviations of the Gaussian priors of measurement errors, which are fitted always and are no effect.

    Attributes:
        clock: Offset of each trial's clock [s].
        rate: Relative error of the clock's rate.
        scale: Relative error of the lengths in a video.
        metres: The same of a recording in metres.
        rotation: Of the recording's frame about each axis [rad].
        place: Error of a marker's stated place along each axis [m].
        slip: Shift of a marker that slips along each axis [m].
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
    """A marker that is shifted on the body within 10 ms of a recording.

    Attributes:
        trial: Name of the trial.
        marker: Number of the marker.
        start: Beginning of the shift by the recording's clock [s].
    """

    trial: str
    marker: int
    start: float

    def course(self, time: np.ndarray) -> np.ndarray:
        """Share of the shift that has happened at times [T] s."""
        return np.clip((time - self.start) / 0.01, 0.0, 1.0)


class ObservationModel:
    """Maps motions of the markers to recordings, with derivatives by the measurement errors.

    The measurement errors are one vector [K]: the clock offset of each trial [s]; error of the clock's rate, ln of the
    scale, rotation about x, y and z [rad]; displacement of each marker in the undeformed body [m]; shift of each slip
    in the frame of the recording [m].

    Args:
        setup: Of the experiment.
        trials: With recordings.
        priors: Of the errors.
        slips: Markers that slip.

    Attributes:
        names: Of the measurement errors.
        deviations: Their prior standard deviations [K].
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
        """Time to simulate trial ``number`` to [s]: a clock may be late, and its last sample lie after the end."""
        trial, clock, rate = self.trials[number], self.deviations[number], self.deviations[len(self.trials)]
        assert trial.recording is not None
        last = float(trial.recording.time[-1])
        return max(trial.setup.duration, (last + CLOCK_LIMIT * clock) * (1 + CLOCK_LIMIT * rate))

    def observe(self, motion: MarkerTrajectory, number: int, errors: np.ndarray) -> np.ndarray:
        """The recording of trial ``number``.

        Args:
            motion: Of that trial, with or without a batch.
            number: Of the trial.
            errors: Measurement errors [K].

        Returns:
            Coordinates at the times of the recording [..., T, M, A] m.
        """
        own, place, frame = self._view(motion, number, errors)
        return self._recorded(_at(motion, own, place)[0] @ frame.T, number, errors)

    def linearise(self, motion: MarkerTrajectory, number: int, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`observe`, without a batch, and the derivatives of the places by the errors [T, M, A, K]."""
        count, rate = len(self.trials), errors[len(self.trials)]
        own, place, frame = self._view(motion, number, errors)
        body, velocity, gradient = _at(motion, own, place)
        seen = body @ frame.T
        # Before the simulated motion begins and after it ends it is constant, whatever the clock.
        turned = (velocity * ((own > 0) & (own < float(motion.time[-1])))[:, None, None]) @ frame.T
        by = np.zeros((*seen.shape, len(errors)))
        by[..., number] = -turned / (1 + rate)
        by[..., count] = -turned * own[:, None, None] / (1 + rate)
        by[..., count + 1] = seen
        by[..., count + 2 : count + 5] = np.einsum("aij,tmj->tmia", SPINS, seen)
        moved = np.einsum("ia,tmaj->tmij", frame, gradient)
        for m in range(self.markers):
            by[:, m, :, count + 5 + 3 * m : count + 8 + 3 * m] = moved[:, m]
        for marker, first, course in self._slipping(number):
            for axis in range(3):
                by[:, marker, axis, first + axis] = course
        return self._recorded(seen, number, errors), by[:, :, list(self.setup.axes)]

    def _view(
        self, motion: MarkerTrajectory, number: int, errors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times by the body's clock [T] s, places of markers [M, 3] m, and scale times rotation [3, 3]."""
        recording, count = self.trials[number].recording, len(self.trials)
        assert recording is not None
        rate, ln_scale = errors[count : count + 2]
        own = np.clip((recording.time - errors[number]) / (1 + rate), 0.0, float(motion.time[-1]))
        place = errors[count + 5 : count + 5 + 3 * self.markers].reshape(self.markers, 3)
        return own, place, math.exp(ln_scale) * Rotation.from_rotvec(errors[count + 2 : count + 5]).as_matrix()

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
        """Places [..., T, M, 3] m with what slips, along the axes that are recorded."""
        seen = seen.copy()
        for marker, first, course in self._slipping(number):
            seen[..., marker, :] += course[:, None] * errors[first : first + 3]
        return seen[..., list(self.setup.axes)]


def _at(motion: MarkerTrajectory, time: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [..., T, M, 3] m and velocities [..., T, M, 3] m/s at times, and deformation gradients [..., T, M, 3, 3].

    The places are of points at a distance ``beside`` [M, 3] m from the motion's own in the undeformed body. Between two
    samples they move along the cubic that has the places and velocities of both; the gradients change linearly.
    """
    last = np.clip(np.searchsorted(motion.time, time, side="right") - 1, 0, len(motion.time) - 2)
    step = motion.time[last + 1] - motion.time[last]
    s, step = ((time - motion.time[last]) / step)[:, None, None], step[:, None, None]
    begin, end = motion.position[..., last, :, :], motion.position[..., last + 1, :, :]
    first, second = step * motion.velocity[..., last, :, :], step * motion.velocity[..., last + 1, :, :]
    way = end - begin
    bend, twist = 3 * way - 2 * first - second, first + second - 2 * way
    place = begin + s * (first + s * (bend + s * twist))
    velocity = (first + s * (2 * bend + s * (3 * twist))) / step
    s = s[..., None]
    gradient = (1 - s) * motion.deformation[..., last, :, :, :] + s * motion.deformation[..., last + 1, :, :, :]
    return place + np.einsum("...mij,mj->...mi", gradient, beside), velocity, gradient
