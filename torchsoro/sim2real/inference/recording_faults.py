"""Faults of a recording that are found beside a fit: markers that slip."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchsoro.sim2real.data.experiment import Trial
from torchsoro.sim2real.inference.noise import NoiseModel
from torchsoro.sim2real.inference.observation import MarkerSlip


def find_slips(
    trials: Sequence[Trial], noise_models: Sequence[NoiseModel], left: Sequence[np.ndarray]
) -> list[MarkerSlip]:
    """The marker whose slip explains most of the residuals, if that is half of their excess over noise.

    Args:
        trials: With recordings.
        noise_models: Of each trial.
        left: Residuals of each trial [T, M, A] m, not whitened.
    """
    markers = left[0].shape[1]
    gains = np.zeros((len(trials), markers))
    starts = np.zeros((len(trials), markers))
    excess = 0.0
    for i, (trial, noise_model, r) in enumerate(zip(trials, noise_models, left, strict=True)):
        assert trial.recording is not None
        time = trial.recording.time
        tried = np.linspace(time[0], time[-1], 62)[1:-1]
        courses = np.stack([MarkerSlip(trial=trial.name, marker=0, start=t).course(time) for t in tried], -1)
        found = np.zeros((markers, len(tried)))
        for channel in noise_model.channels:
            rows = channel.rows
            steps = channel.whiten(courses[None, rows])[0]
            ones = channel.whiten(np.ones((1, len(rows), 1)))[0]
            # Apart from where the marker is from the start on.
            steps = steps - ones * (ones.T @ steps) / float((ones**2).sum())
            for m, a in channel.pairs:
                white = channel.whiten(r[None, rows, m, a, None])[0, :, 0]
                excess += float(white @ white) - len(rows)
                white = white - ones[:, 0] * float(ones[:, 0] @ white) / float((ones**2).sum())
                found[m] += (steps.T @ white) ** 2 / ((steps**2).sum(0) + 1e-9)
        gains[i], starts[i] = found.max(1), tried[found.argmax(1)]
    marker = int(gains.sum(0).argmax())
    if gains[:, marker].sum() < max(100.0, 0.5 * excess):
        return []
    return [
        MarkerSlip(trial=t.name, marker=marker, start=float(starts[i, marker]) - 0.005)
        for i, t in enumerate(trials)
        if gains[i, marker] > 30
    ]
