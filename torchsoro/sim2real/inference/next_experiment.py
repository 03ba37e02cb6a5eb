"""Which trial to record next, so that two explanations that both fit are told apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchsoro.sim2real.data.experiment import ForceTable, Marker, Setup, Trial, Vector
from torchsoro.sim2real.inference.cosines import cleared, imitation, settle
from torchsoro.sim2real.inference.fit import FitProblem
from torchsoro.sim2real.inference.isolability import errors_of, moved_by, prior_residual_of, shortened, whitened
from torchsoro.sim2real.inference.likelihood import Effects
from torchsoro.sim2real.inference.noise import NoiseModel
from torchsoro.sim2real.inference.observation import ObservationModel
from torchsoro.sim2real.inference.twin_error import DiscretizationError
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.simulation.actuation import Waveform

LONGER = 1.5  # times as long; every simulation of the menu takes as long as its longest
END = 0.1  # of the body's length, that is pulled at its free end
CLEAR = 3.0  # standard deviations, by which explanations differ that a trial tells apart
REPEAT = "the same trial once more"
PULL = 0.5  # of the body's weight
SAGS = 9.81  # m/s2, of a body that is turned, where it weighs nothing as it is

Explained = tuple[Effects, np.ndarray]  # effects, and where a search for them ended, in scales, as tasks of a fit


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A trial that could be recorded next.

    Attributes:
        words: What to do.
        cosine: How much of the change by one explanation the other can imitate, 0 to 1.
        distance: Squared whitened length of the rest: gain in chi-squared by which the trial tells them apart.
    """

    words: str
    cosine: float
    distance: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """An entry of the menu.

    Attributes:
        words: What to do.
        trial: Its setup and its pressure.
        marker: Whether there is another marker.
    """

    words: str
    trial: Trial
    marker: bool = False


def next_experiment(problem: FitProblem, one: Explained, other: Explained) -> list[Proposal]:
    """Trials that tell two explanations apart, best first; the same trial once more is among them.

    Each explanation is simulated as it was fitted; the other may then change all its numbers, with modulus, pressure
    and measurement errors, to say the same. All is one batch of simulations.

    Args:
        problem: Recordings, of which only the times count, and twin.
        one: Effects and where their fit ended.
        other: The same of what is not told apart from it.
    """
    first, extra = problem.trials[0], far_marker(problem.twin)
    choices = menu(first, problem.twin, extra)
    marked = _marked(problem.twin.setup, extra)
    # Entries that differ in what is recorded only are one simulation.
    numbers: dict[int, int] = {}
    for choice in choices:
        numbers.setdefault(id(choice.trial), len(numbers))
    trials = list({id(c.trial): c.trial for c in choices}.values())
    wide = FitProblem(
        dataclasses.replace(problem.experiment, setup=marked),
        dataclasses.replace(problem.twin, setup=marked),
        threads=problem.threads,
        even=True,
        trials=tuple(_timed(dataclasses.replace(t, setup=_marked(t.setup, extra)), t) for t in trials),
        discretization=DiscretizationError(shift=problem.discretization.shift),
        tolerances=problem.tolerances,
        priors=problem.priors,
        noise=problem.noise,
        report=problem.report,
        tally=problem.tally,
    )
    n = len(problem.common)
    still = np.concatenate([np.zeros((1, n)), problem.step * np.eye(n)])
    around = [_around(problem, effects, at) for effects, at in (one, other)]
    asked = [((), still), *((effects, points) for (effects, _), points in zip((one, other), around, strict=True))]
    simulated = wide.simulate(asked)
    found = []
    for choice in choices:
        motions = [row[numbers[id(choice.trial)]] for row in simulated]
        if all(m.sound.all() for m in motions):
            found.append(_proposal(problem, choice, motions, extra))
    return sorted(found, key=lambda p: -p.distance)


def advice(proposals: Sequence[Proposal], which: str = "them") -> str:
    """The best of them in a sentence, or that none tells them apart; empty without any."""
    same = next((p for p in proposals if p.words == REPEAT), None)
    if same is None:
        return ""
    best = proposals[0]
    if best is same or best.distance < max(CLEAR**2, 2 * same.distance):
        return f"None of the trials that were thought of would tell {which} apart."
    return (
        f"To tell {which} apart, record next: {best.words}; there they differ by {best.distance**0.5:.0f} standard "
        f"deviations, in the same trial once more by {same.distance**0.5:.1f}."
    )


def menu(trial: Trial, twin: Twin, extra: Marker) -> list[Choice]:
    """What could be recorded next, as far as a setup and a pressure can say it.

    Args:
        trial: One that was recorded.
        twin: Its body.
        extra: Another marker.
    """
    s = trial.setup
    longest = int(np.argmax(s.size))
    found = [
        Choice(words=REPEAT, trial=trial),
        Choice(words=f"the same with another marker at {_mm(extra.at)}", trial=trial, marker=True),
    ]

    def add(words: str, *, pressure: Waveform | None = trial.pressure, **changed) -> None:
        setup: Setup = dataclasses.replace(s, **changed)
        name = f"next {len(found)}"
        found.append(Choice(words=words, trial=dataclasses.replace(trial, name=name, setup=setup, pressure=pressure)))

    add(f"the same for {LONGER * s.duration:.3g} s", duration=LONGER * s.duration)
    pull = np.array(s.gravity)
    weight = float(np.linalg.norm(pull)) or SAGS
    zero = (0.0, 0.0, 0.0)
    end = bool(extra.at[longest] > s.center[longest])
    if twin.held.any() and not s.planes:
        for axis in range(3):
            down = np.eye(3)[axis] * (1 if axis != longest or end else -1)
            if abs(down @ pull) < 0.9 * weight:
                side = f"{'+' if down[axis] > 0 else '-'}{'xyz'[axis]}"
                words = f"from rest, the setup turned so that {side} is down"
                add(words, gravity=_vector(weight * down), velocity=zero, angular_velocity=zero)
    low, high = np.array(s.origin), np.array(s.origin) + np.array(s.size)
    share = END * s.size[longest]
    low[longest], high[longest] = (
        (high[longest] - share, high[longest]) if end else (low[longest], low[longest] + share)
    )
    force = np.eye(3)[longest]
    if twin.held.any():
        force = pull / weight if pull.any() else np.eye(3)[int(np.argmin(s.size))]
    force = PULL * weight * s.density * float(twin.grid.volumes.sum()) * force
    start = round(s.duration / 3, 3)
    load = ForceTable(box=(_vector(low - 1e-6), _vector(high + 1e-6)), force=_vector(force), start=start)
    try:
        twin.grid.within(load.box)
    except ValueError:
        pass  # a body that tapers may have nothing there
    else:
        newtons = ", ".join(f"{f:.3g}" for f in force)
        add(f"the same with a pull of ({newtons}) N at the free end from {start:g} s on", forces=(*s.forces, load))
    if trial.pressure is not None:
        p = trial.pressure
        add("the same at 0.6 times the pressure", pressure=Waveform(time=p.time, pressure=0.6 * p.pressure))
        add("the same with pulses twice as fast", pressure=Waveform(time=p.time / 2, pressure=p.pressure))
    return found


def far_marker(twin: Twin) -> Marker:
    """A corner of the body's free end that is far from all markers."""
    s = twin.setup
    longest = int(np.argmax(s.size))
    held = {side for axis, side in twin.faces if axis == longest}
    corners = np.array(np.meshgrid(*zip((0, 0, 0), (1, 1, 1), strict=True))).reshape(3, -1).T
    corners = corners[[(1 if c[longest] else -1) not in held for c in corners]] if len(held) < 2 else corners
    places = np.array(s.origin) + corners * np.array(s.size)
    known = np.array([m.at for m in s.markers])
    away = np.linalg.norm(places[:, None] - known[None], axis=-1).min(1)
    return Marker(name="another", at=_vector(places[int(away.argmax())]))


def _around(problem: FitProblem, effects: Effects, at: np.ndarray) -> np.ndarray:
    """The point where a fit ended, and one for a step of each of its unknowns [1 + K, K']; beliefs as they are."""
    n = len(problem.common)
    middle = np.concatenate([np.zeros(n), at[n:]])
    steps = problem.steps(effects, middle)
    return np.concatenate([middle[None], middle + (np.eye(len(at)) * steps)[n:]])


def _proposal(problem: FitProblem, choice: Choice, motions: list[MarkerTrajectory], extra: Marker) -> Proposal:
    """What a trial would tell, from simulations of what is believed, and of both explanations with their steps."""
    trial = choice.trial
    if choice.marker:
        trial = dataclasses.replace(trial, setup=_marked(trial.setup, extra))
    else:
        motions = [_first(m, len(trial.setup.markers)) for m in motions]
    trial = _timed(trial, choice.trial)
    assert trial.recording is not None
    discretization = problem.discretization.mean
    discretization = (
        np.concatenate([discretization, discretization.mean(0, keepdims=True)]) if choice.marker else discretization
    )
    observation = ObservationModel(trial.setup, [trial], problem.priors)
    noise_models = [NoiseModel(trial.recording, problem.noise, discretization)]
    believed = [motions[0].alone(0)]
    blocks = [whitened(noise_models, moved_by(observation, believed, [m])) for m in motions]
    widths = np.cumsum([b.shape[1] for b in blocks])[:-1]
    still, *both = np.split(shortened(blocks, errors_of(observation, noise_models, believed), observation), widths, 1)
    common = still[:, 1:] / problem.step
    # What each makes, and how it may still change.
    cones = [np.concatenate([b[:, :1], b[:, 1:] - b[:, :1]], 1) for b in both]
    cosine, distance = 0.0, np.inf
    for mine, other in (cones, cones[::-1]):
        size, slopes = settle(mine[:, 0], common, prior_residual_of(problem))
        left = cleared(np.concatenate([mine[:, :1], other], 1), common, slopes)
        same = imitation(left[:, 0], left[:, 1:], np.ones(other.shape[1], bool))
        cosine, distance = max(cosine, same), min(distance, size**2 * (1 - same**2))
    return Proposal(words=choice.words, cosine=cosine, distance=distance)


def _timed(trial: Trial, of: Trial) -> Trial:
    """A trial with the times that a recording of another would have, up to its own end, and all places seen."""
    assert of.recording is not None
    time, setup = of.recording.time, trial.setup
    step = float(np.median(np.diff(time)))
    late = np.arange(time[-1] + step, setup.duration, step) if setup.duration > time[-1] + step else time[:0]
    time = np.concatenate([time, late]) if trial.name.startswith("next") else time
    place = np.zeros((len(time), len(setup.markers), len(setup.axes)))
    return dataclasses.replace(trial, recording=dataclasses.replace(of.recording, time=time, position=place))


def _marked(setup: Setup, extra: Marker) -> Setup:
    return dataclasses.replace(setup, markers=(*setup.markers, extra))


def _first(motion: MarkerTrajectory, markers: int) -> MarkerTrajectory:
    """A motion of the first markers only."""
    return dataclasses.replace(
        motion,
        position=motion.position[..., :markers, :],
        velocity=motion.velocity[..., :markers, :],
        deformation=motion.deformation[..., :markers, :, :],
    )


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _mm(place: Vector) -> str:
    return "(" + ", ".join(f"{1e3 * x:.0f}" for x in place) + ") mm"
