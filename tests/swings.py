"""Markers that swing, as recorded and as linearised models of it, for tests of evidence."""

from __future__ import annotations

import dataclasses

import numpy as np

from torchsoro.sim2real.inference.evidence import (
    Discrepancy,
    Linearised,
    Model,
    TwinError,
    errors,
    infer,
)
from torchsoro.sim2real.inference.noise import LASTING
from torchsoro.sim2real.inference.observed import Data, TrialData
from torchsoro.sim2real.inference.priors import Prior
from torchsoro.sim2real.inference.weighing import Weighing

MARKERS, AXES = 3, 2
EXACT = TwinError(amplitude=np.zeros((AXES, MARKERS)))


def recorded(share, seed, trials=2, count=60, effect=0.0, lasting=LASTING):
    """Markers that swing, with a discrepancy of a share of the motion, noise, and an effect that slows the swing."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, count)
    shape = np.array([[0.2, 0.6, 1.0], [0.05, 0.3, 0.5]])
    swing = np.stack([np.sin(2 * np.pi * (1.5 + 0.5 * i) * time) for i in range(trials)])
    slope = np.stack([np.sin(2 * np.pi * (1.5 + 0.5 * i) * time) * time for i in range(trials)])
    believed = tuple(s[:, None, None] * shape.T for s in swing)
    slopes = tuple((s[:, None, None] * shape.T)[..., None] for s in slope)
    quiet = Data(
        trials=tuple(TrialData(name=str(i), time=time, position=b) for i, b in enumerate(believed)),
        noise=0.01,
        lasting=lasting,
    )
    model, *_ = errors(quiet, EXACT, Discrepancy(share, 0.1))
    position = []
    for b, J in zip(believed, slopes, strict=True):
        off = np.stack([np.linalg.cholesky(model.dense(time, a)) @ rng.normal(size=3 * count) for a in range(AXES)])
        position.append(b + effect * J[..., 0] + off.reshape(AXES, MARKERS, count).transpose(2, 1, 0))
    data = dataclasses.replace(
        quiet, trials=tuple(dataclasses.replace(t, position=p) for t, p in zip(quiet.trials, position, strict=True))
    )
    left = tuple(p - b for p, b in zip(position, believed, strict=True))
    effects = Linearised(
        model=Model(effects=("drag",), priors=(Prior(1.0),), own=(0,)),
        at=np.zeros(1),
        residuals=left,
        slopes=slopes,
        numerics=EXACT,
    )
    nothing = Linearised(
        model=Model(effects=(), priors=()),
        at=np.zeros(0),
        residuals=left,
        slopes=tuple(J[..., :0] for J in slopes),
        numerics=EXACT,
    )
    return data, nothing, effects


def draws(data, count, size, seed, time=0.1):
    """Motions that differ as contact makes them: by a process that all markers share."""
    rng = np.random.default_rng(seed)
    times = data.trials[0].time
    root = np.linalg.cholesky(np.exp(-np.abs(times[:, None] - times) / time) + 1e-9 * np.eye(len(times)))
    return [
        tuple(size * (root @ rng.normal(size=(len(times), 2)))[:, None] * np.ones((1, 3, 1)) for _ in data.trials)
        for _ in range(count)
    ]


def weighed(data, *models, names=10):
    """Posteriors of models beside each other."""
    found = [infer(data, m) for m in models]
    return Weighing(
        data=data,
        nothing=tuple(p for p in found if not p.near.model.effects),
        effects=tuple(p for p in found if p.near.model.effects),
        names=names,
    )
