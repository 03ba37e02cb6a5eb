"""Mistakes that only the motion shows: what is believed is simulated once and compared with recordings.

A recording that begins where it should may still be mirrored where its markers lie in a plane, have a clock that does
not begin at release or runs in another unit, or go with a pressure in another unit. Each of these predicts a motion. A
mistake is told if the motion as it is believed explains less than half of what was recorded, and with that mistake it
explains nearly all; physics that is missing from a setup does neither.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchsoro.sim2real.data.experiment import CLOCK, PLACE, Setup, Trial
from torchsoro.sim2real.data.misreading import directions
from torchsoro.sim2real.data.plausibility import Finding, merged
from torchsoro.sim2real.twin.batch import simulate
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.simulation.actuation import Waveform

RESEMBLES = 0.5  # of the recorded motion, that is explained unless something is wrong
NEARLY = 0.9  # of the recorded motion, that a mistake has to explain
LAGS = 100  # moments of release, that are tried
LATE = 5.0  # tolerances of a clock, from which on it does not begin at release
OVERLAP = 0.5  # of the samples, that have to be of the motion
RATES = (2.0, 3.0, 4.0, 5.0, 8.0, 10.0, 20.0, 30.0, 60.0, 1000.0)  # of clocks in other units, or of films slowed down
WEAK = 1e-2  # of the modulus, below which a pressure hardly moves a body, and may be in another unit
PRESSURES = {1e2: "mbar", 1e3: "kPa", 6894.76: "psi", 1e5: "bar", 1e6: "MPa"}


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """What may be wrong with a trial.

    Attributes:
        what: In words.
        remedy: What to do about it.
        axes: That the recorded axes hold.
        signs: Of them.
        lag: Time of the release by the recording's clock [s].
        rate: Of that clock, over seconds.
        supply: By how much the pressure is larger than it says.
    """

    what: str
    remedy: str
    axes: tuple[int, ...]
    signs: tuple[int, ...]
    lag: float = 0.0
    rate: float = 1.0
    supply: float = 1.0


def against_belief(twin: Twin, trials: Sequence[Trial], threads: int) -> list[Finding]:
    """What one simulation of each trial tells about mistakes in the data.

    Args:
        twin: Of what is believed.
        trials: With recordings.
        threads: That simulate.
    """
    weak = max((float(t.pressure.pressure.abs().max()) for t in trials if t.pressure is not None), default=0.0)
    supplies = [1.0, *(PRESSURES if 0 < weak < WEAK * twin.setup.youngs_modulus else ())]
    scenarios = []
    for trial in trials:
        scenario = twin.scenario(trial)
        for factor in supplies:
            p = scenario.pressure
            more = p if p is None else Waveform(time=p.time, pressure=factor * p.pressure)
            scenarios.append(scenario.replace(pressure=more))
    try:
        motions = [m.alone() for m in simulate(twin, scenarios, threads=threads)]
    except ValueError:  # it is told where the twin is corrected
        return []
    found = []
    for k, trial in enumerate(trials):
        own = dict(zip(supplies, motions[k * len(supplies) :], strict=False))
        if (one := mistaken(trial, own)) is not None:
            found.append(one)
    return merged(found)


def mistaken(trial: Trial, motions: dict[float, MarkerTrajectory]) -> Finding | None:
    """The mistake that explains a recording, if what is believed does not.

    Args:
        trial: With a recording.
        motions: As believed, by the factor on the pressure; 1 among them.
    """
    axes = trial.setup.axes
    plain = Mistake(what="", remedy="", axes=axes, signs=(1,) * len(axes))
    if not motions[1.0].sound.all():
        return None
    asis = explained(trial, motions[1.0], plain)
    if asis > RESEMBLES:
        return None
    tried = mistakes(trial, plain, [f for f in motions if f != 1 and motions[f].sound.all()])
    shares = [explained(trial, motions[m.supply], m) for m in tried]
    if not shares or max(shares) < NEARLY:
        return None
    best = tried[int(np.argmax(shares))]
    return Finding(
        where=(trial.name,),
        what=best.what,
        evidence=f"a first simulation then explains {100 * max(shares):.0f} % of the motion, and "
        f"{100 * max(asis, 0.0):.0f} % as it stands",
        remedy=best.remedy,
    )


def mistakes(trial: Trial, plain: Mistake, supplies: Sequence[float]) -> list[Mistake]:
    """All that are looked for in a trial."""
    s, recording = trial.setup, trial.recording
    assert recording is not None
    found = [
        replace(
            plain,
            what=f"the motion is that with {directions(s.axes, axes, signs)}",
            remedy="give places in the frame of setup.toml, and gravity as it is there",
            axes=axes,
            signs=signs,
        )
        for axes, signs in untold(s)
    ]
    span = float(np.ptp(recording.time))
    for lag in np.linspace(0.0, OVERLAP * span, LAGS + 1):
        if lag > LATE * CLOCK:
            what = f"the body rests until {lag:.2g} s"
            found.append(replace(plain, what=what, remedy="time_s = 0 has to be the release", lag=float(lag)))
    for rate in RATES:
        for r in (rate, 1 / rate):
            times = f"{rate:g} times {'larger' if r > 1 else 'smaller'} than seconds"
            found.append(replace(plain, what=f"times are {times}", remedy="is time_s in seconds?", rate=r))
    for factor in supplies:
        what = f"the pressure is in {PRESSURES[factor]}"
        found.append(replace(plain, what=what, remedy="give it in Pa in pressure.csv", supply=factor))
    return found


def untold(s: Setup) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Axes and signs under which the stated markers lie as they do, so that the beginning does not tell them apart.

    None for a body that meets planes: its way along them may be the opposite of what is believed.
    """
    if s.planes:
        return []
    places = np.array([m.at for m in s.markers])
    places = places - places.mean(0)
    found = []
    for axes in itertools.permutations(range(3), len(s.axes)):
        for signs in itertools.product((1, -1), repeat=len(axes)):
            off = places[:, axes] * np.array(signs) - places[:, s.axes]
            if (axes, signs) != (s.axes, (1,) * len(axes)) and np.abs(off).max() < 2 * PLACE:
                found.append((axes, signs))
    return found


def explained(trial: Trial, motion: MarkerTrajectory, mistake: Mistake) -> float:
    """Share of the recorded motion's mean square that a motion explains, with a mistake; negative if it adds to it.

    Places of markers are compared about their mean over time, so that it does not matter where they are stated.
    """
    recording = trial.recording
    assert recording is not None
    own = recording.time / mistake.rate - mistake.lag
    inside = own <= float(motion.time[-1])
    if inside.mean() < OVERLAP:
        return -np.inf
    seen = np.stack(
        [
            sign * np.interp(own[inside], motion.time, motion.position[:, m, axis])
            for m in range(motion.position.shape[1])
            for axis, sign in zip(mistake.axes, mistake.signs, strict=True)
        ],
        -1,
    )
    place = recording.position[inside].reshape(len(seen), -1)
    there = np.isfinite(place)
    count = np.maximum(there.sum(0), 1)

    def about(values: np.ndarray) -> np.ndarray:
        values = np.where(there, values, 0.0)
        return np.where(there, values - values.sum(0) / count, 0.0)

    moved = about(place)
    return 1 - float(((moved - about(seen)) ** 2).sum()) / max(float((moved**2).sum()), 1e-300)
