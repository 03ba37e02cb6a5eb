"""Recordings with more rows than an explanation can bear keep every k-th, as far as that hides no motion."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.interpolate import CubicSpline

from torchsoro.sim2real.data.experiment import Experiment, Trial
from torchsoro.sim2real.data.recording import Recording
from torchsoro.sim2real.inference.noise import estimate_noise
from torchsoro.sim2real.twin.batch import SAMPLE

MEMORY = 4e9  # bytes, that the slopes of all samples by all unknowns of all models that are weighed may take
SLOPES = 1000  # of a sample: sixteen models of some sixty unknowns
ROWS = 4000  # of a recording, whose errors are filtered in seconds
WITHIN = 2  # samples for each of the twin's, with which a recording shows all that the twin does
HIDDEN = 1.0  # of the noise, that motion between the rows that are kept may be off a cubic through them
TRIED = 100_000  # rows that this is tried on, at most


def thinned(experiment: Experiment) -> tuple[Experiment, list[str]]:
    """The experiment with recordings that an explanation can bear.

    A recording with too many rows is left with a few for each sample of the twin, whose motions are cubics between
    samples. Where that are still too many, the rows in between must follow from those that are kept to within noise.

    Returns:
        The experiment, and a line for each recording that was thinned.

    Raises:
        ValueError: for too many rows of a motion that needs them.
    """
    channels = len(experiment.setup.markers) * len(experiment.setup.axes)
    trials = sum(t.recording is not None for t in (*experiment.trials, *experiment.heldout))
    most = min(ROWS, int(MEMORY / (8 * SLOPES * channels * max(trials, 1))))
    notes = []

    def thin(trial: Trial) -> Trial:
        recording, simulated = trial.recording, trial.simulated
        if simulated is not None and len(simulated.time) > most:
            trial = dataclasses.replace(trial, simulated=_ending(simulated, max(_enough(_interval(simulated)), 1)))
        if recording is None or len(recording.time) <= most:
            return trial
        rows, interval = len(recording.time), _interval(recording)
        step = _enough(interval)
        if step < 2 or rows / step > most:
            step = math.ceil(rows / most)
            hidden, noise = _hidden(recording, step, experiment.setup.noise)
            if step * interval > SAMPLE and not hidden <= HIDDEN * noise:
                raise ValueError(
                    f"{experiment.folder}: trial {trial.name}: markers.csv has {rows} rows from "
                    f"{recording.time[0]:g} to {recording.time[-1]:g} s, wanted at most {most}: of every {step} rows "
                    f"one cannot stand for the others, which are {1e3 * hidden:.2g} mm off a smooth curve through them "
                    f"(noise: {1e3 * noise:.2g} mm); give a shorter duration, or fewer rows"
                )
        notes.append(
            f"trial {trial.name}: of {rows} rows of markers.csv one in {step} is used, or one in "
            f"{1e3 * step * interval:.3g} ms; the simulation's own samples are {1e3 * SAMPLE:g} ms apart"
        )
        return dataclasses.replace(trial, recording=recording.every(step))

    trials_, heldout = (tuple(map(thin, group)) for group in (experiment.trials, experiment.heldout))
    return dataclasses.replace(experiment, trials=trials_, heldout=heldout), notes


def _enough(interval: float) -> int:
    """Rows of which one shows all that the twin does."""
    return int((1 + 1e-6) * SAMPLE / WITHIN / interval)


def _interval(recording: Recording) -> float:
    return float(np.median(np.diff(recording.time)))


def _ending(recording: Recording, step: int) -> Recording:
    """Every ``step``-th row, and the last."""
    rows = np.unique(np.append(np.arange(0, len(recording.time), step), len(recording.time) - 1))
    return dataclasses.replace(recording, time=recording.time[rows], position=recording.position[rows])


def _hidden(recording: Recording, step: int, noise: float | None) -> tuple[float, float]:
    """How far rows between every ``step``-th are off a cubic through those, beyond noise [m], and the noise [m]."""
    part = dataclasses.replace(recording, time=recording.time[:TRIED], position=recording.position[:TRIED])
    noise = estimate_noise([part]) if noise is None else noise
    squares, count = 0.0, 0
    for column in part.position.reshape(len(part.time), -1).T:
        kept = np.flatnonzero(np.isfinite(column[::step])) * step
        if len(kept) < 4:
            continue
        between = np.isfinite(column)
        between[kept] = False
        between[: kept[0]] = between[kept[-1] :] = False
        off = column[between] - CubicSpline(part.time[kept], column[kept])(part.time[between])
        squares += float(off @ off)
        count += len(off)
    # Both the row and the cubic have the noise of a sample, about.
    return math.sqrt(max(squares / max(count, 1) - 2 * noise**2, 0.0)), noise
