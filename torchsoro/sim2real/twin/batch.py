"""Simulations of a twin in many variations: those of a kind, sixteen at a time, one group to a thread."""

from __future__ import annotations

import contextlib
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.formulation import Total
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.kernels.layout import LARGEST, lattice_components
from torchsoro.simulation.loads import Chain, Clamp, Drag, Force, Load, PointMass, QuadraticDrag, Spring
from torchsoro.simulation.material import Body, Prony
from torchsoro.simulation.simulator import Simulator
from torchsoro.simulation.threads import threads_here
from torchsoro.simulation.trajectory import Start, Trajectory

SAMPLE = 2.5e-3  # s between two samples of a motion, which is interpolated by cubics
STEP = 0.85  # of the largest stable step near rest; free blocks and bars are stable up to 0.98
CHAMBERED = 0.75  # the same of a body with chambers, whose corners stretch much; up to 0.77, and not at 0.85
MESHED = 0.55  # the same of a mesh; robots on legs as well as with shorter steps up to 0.54, and hardly less so at 0.59
SHORTEST = 1e-9  # s, a step; shorter ones are lost to rounding
SOFTENED = 0.6  # of the steepest slope below the largest stretch, that counts: it falls at once; a finger bears 0.6
SHORTER = 4  # times that a step is shortened, to half of it at most, until a solid that softens is stable
HALVINGS = 30  # of the error of ln dt, where the stiffness depends on the step
THREADS = os.cpu_count() or 1
TOGETHER = 8  # threads that simulate one group, at most: they wait for each other twice a step
MARCHING = 0.75  # of ln of the number of threads that simulate one group, by which it takes less time, in ln
ALIKE = 1.6  # steps over the shortest, that a GPU takes in one batch
MOST_AT_ONCE = 1024  # variations on a GPU
FAR = 1e3  # m, half the edge of the box that a motion that has not diverged stays in

Lane = tuple[int, int]  # number of the scenario, and of its variation
Amounts = Callable[[Scenario], Tensor]


def safety(twin: Twin) -> float:
    """Step in use over the largest stable step near rest."""
    if twin.setup.surface is not None:
        return MESHED
    return CHAMBERED if twin.setup.chambers else STEP


def simulate(
    twin: Twin,
    scenarios: Sequence[Scenario],
    *,
    threads: int = THREADS,
    even: bool = False,
    safe: float | None = None,
    watch: Callable[[float], None] = lambda share: None,
) -> list[MarkerTrajectory]:
    """Simulate variations of scenarios of one body.

    Args:
        twin: The body.
        scenarios: Each with a batch of variations [B], or none.
        threads: Number of threads.
        even: Whether all variations take the same time step, so that its error cancels in their differences.
        safe: Step over the largest stable one near rest; :func:`safety` if None.
        watch: Called with the share of the simulated time that is done, group by group.

    Returns:
        For each scenario, its motions [B, ...]; diverged ones are not ``sound``. Of no scenario, none.

    Raises:
        ValueError: if one is so stiff that no step is short enough.
    """
    if not scenarios:
        return []
    share = safe or safety(twin)
    steps = [stable(twin, s, share) for s in scenarios]
    if even:
        least = min(float(dt.min()) for dt in steps)
        steps = [np.full_like(dt, least) for dt in steps]
    if not (shortest := min(float(dt.min()) for dt in steps)) > SHORTEST:
        raise ValueError(f"stiffness: a step of {shortest:g} s is needed, wanted a body with at least {SHORTEST:g} s")
    samples = math.ceil(max(s.until for s in scenarios) / SAMPLE - 1e-9) + 1
    markers = torch.tensor([m.at for m in twin.setup.markers], dtype=torch.float64).reshape(-1, 3)
    shape = samples, len(markers)
    position, velocity = ([np.zeros((s.batch, *shape, 3)) for s in scenarios] for _ in range(2))
    deformation = [np.zeros((s.batch, *shape, 3, 3)) for s in scenarios]
    sound = [np.zeros(s.batch, bool) for s in scenarios]

    def run(group: list[Lane], share_of_threads: int) -> tuple[float, list[float]]:
        """Simulate; returns the step, and the largest stretch of what softens."""
        every = math.ceil(SAMPLE / min(steps[i][b] for i, b in group))
        with threads_here(share_of_threads), torch.no_grad():
            own = _Group(twin, scenarios, group)
            found = own.simulate(SAMPLE / every, samples - 1, markers)
        seen = (position, found.position), (velocity, found.velocity), (deformation, found.deformation)
        for kept, values in (*seen, (sound, found.sound)):
            for (i, b), one in zip(group, values.numpy(), strict=True):
                kept[i][b] = one
        return found.dt, own.stretched(found)

    def simulated(groups: list[list[Lane]]) -> Iterator[tuple[list[Lane], tuple[float, list[float]]]]:
        """Each group with what :func:`run` returns of it."""
        plan, first = waves(len(groups), threads) if twin.device == "cpu" else (1,) * len(groups), 0
        for width, count in sorted(Counter(plan).items(), reverse=True):
            part = groups[first : first + width * count]
            each = [min(threads // width, TOGETHER)] * len(part)
            with ThreadPoolExecutor(width) if width > 1 else contextlib.nullcontext() as pool:
                yield from zip(part, (pool.map if pool else map)(run, part, each), strict=True)
            first += len(part)

    largest, lanes = 0.0, [(i, b) for i, s in enumerate(scenarios) for b in range(s.batch)]
    whole = sum(s.until * s.batch for s in scenarios)
    reached, used = ([np.zeros(s.batch) for s in scenarios] for _ in range(2))
    for k in range(1 + SHORTER):
        done = 0.0
        for group, (dt, stretches) in simulated(_grouped(twin, scenarios, lanes, steps, samples)):
            largest, done = max(largest, dt), done + sum(scenarios[i].until for i, _ in group)
            for (i, b), stretch in zip(group, stretches, strict=True):
                reached[i][b], used[i][b] = stretch, dt
            if not k:
                watch(done / whole)
        softer = {i for i, b in lanes if reached[i][b]}
        bounds = {i: stable(twin, scenarios[i], share, reached[i]) for i in softer}
        late = [(i, b) for i, b in lanes if reached[i][b] and bounds[i][b] < used[i][b]]
        if not late:
            break
        # What was not stable has stretched too far: others tell how far it should, or half of the step is next.
        borne = max((reached[i][b] for i, b in set(lanes) - set(late)), default=0.0)
        shorter = {i: stable(twin, scenarios[i], share, borne) for i, _ in late}
        for i, b in late:
            steps[i][b] = shorter[i][b] if borne and shorter[i][b] < used[i][b] else used[i][b] / 2
        lanes = late
    time = np.arange(samples) * SAMPLE
    return [
        MarkerTrajectory(time=time, position=x, velocity=v, deformation=F, sound=ok, dt=largest)
        for x, v, F, ok in zip(position, velocity, deformation, sound, strict=True)
    ]


def _countable(twin: Twin, samples: int, elements: int) -> int:
    """Variations at most of which a GPU can index what is recorded, and the two states that it goes between."""
    lattice = twin.grid.lattice
    seen = samples * 6 * 27 * max(1, len(twin.setup.markers))  # way and velocity of the nodes around each marker
    states = 2 * lattice_components(lattice.nodes, lattice.count, elements, softens=True)
    return max(1, LARGEST // max(seen, states))


def _at_once(members: list[Lane], steps: list[float], most: int = MOST_AT_ONCE) -> list[list[Lane]]:
    """Batches for a GPU, which takes hardly longer for more: so many at most, with steps that are alike."""
    order = sorted(zip(steps, members, strict=True))
    batches: list[list[Lane]] = []
    shortest = 0.0
    for step, lane in order:
        if not batches or step > ALIKE * shortest or len(batches[-1]) == most:
            batches.append([])
            shortest = step
        batches[-1].append(lane)
    return batches


def _grouped(
    twin: Twin, scenarios: Sequence[Scenario], lanes: Sequence[Lane], steps: Sequence[np.ndarray], samples: int
) -> list[list[Lane]]:
    """What is alike goes together: all of a group take the time of the most elements, and the shortest step."""
    alike: dict[object, list[Lane]] = {}
    for i, b in lanes:
        alike.setdefault(_kind(scenarios[i]), []).append((i, b))
    groups: list[list[Lane]] = []
    for members in alike.values():
        members.sort(key=lambda lane: (*_extras(scenarios[lane[0]]), steps[lane[0]][lane[1]]))
        if twin.device == "cpu":
            groups += [members[k : k + LANES] for k in range(0, len(members), LANES)]
        else:
            elements = max(_extras(scenarios[i])[0] for i, _ in members)
            most = min(MOST_AT_ONCE, _countable(twin, samples, elements))
            groups += _at_once(members, [steps[i][b] for i, b in members], most)
    return groups


@cache
def waves(groups: int, threads: int) -> tuple[int, ...]:
    """How many groups to simulate side by side, wave after wave, in the least time; those of a wave share the threads.

    Args:
        groups: That are left; each takes a time of 1 on a thread, and less on several, though not in proportion.
        threads: That there are.
    """
    if groups == 0:
        return ()
    if (full := groups // threads - 1) > 0:  # waves of one thread each, without a search
        return (threads,) * full + waves(groups - full * threads, threads)
    plans = [(width, *waves(groups - width, threads)) for width in range(1, min(groups, threads) + 1)]
    return min(plans, key=lambda plan: sum(min(threads // width, TOGETHER) ** -MARCHING for width in plan))


def stable(twin: Twin, s: Scenario, share: float, stretch: np.ndarray | float = 0.0) -> np.ndarray:
    """Step of each variation [B] s, ``share`` of the largest that is stable near rest: 2 over the highest frequency.

    Below its largest stretch x = I1b - 3 so far, a solid that softens by d over a span r is steeper: the slope of its
    factor 1 - d erf(u / r), 2 d / (sqrt(pi) r) at most, adds up to 4 d x / (sqrt(pi) r) to its relative stiffness.
    (From the law, with b' the deviatoric part of the isochoric left Cauchy-Green tensor and b':b' = 2 x near rest.)

    Args:
        twin: The body.
        s: The scenario.
        share: Of the largest stable step.
        stretch: Largest x, of each variation [B] or of all.
    """
    nu = s.poisson_ratio.unsqueeze(-1)
    moduli = s.youngs_modulus / (3 * (1 - 2 * nu)), s.youngs_modulus / (2 * (1 + nu))
    bulk, shear = ((m / s.density).amax(-1).expand(s.batch).numpy() for m in moduli)
    dt = np.ones(s.batch)
    depth, span = (s.softening[..., k].expand(s.batch).numpy() for k in range(2))
    steeper = 1 + SOFTENED * 4 / math.sqrt(math.pi) * depth * stretch / span
    for _ in range(1 if s.prony is None else HALVINGS):
        factor = steeper if s.prony is None else steeper + _step_moduli(s.prony, dt)
        bound = share * 2 / np.sqrt(bulk * twin.frequency.square(factor * shear / bulk))
        dt = bound if s.prony is None else np.sqrt(dt * bound)
    return np.minimum(dt, SAMPLE)


def _step_moduli(prony: Prony, dt: np.ndarray) -> np.ndarray:
    """The sum of ``Prony.step_moduli`` for a step of each variation [B], a hundred times a generation."""
    ratio = dt[:, None] / prony.times.numpy()
    return (prony.moduli.numpy() * -2 * np.expm1(-ratio) / (ratio * (1 + np.exp(-ratio)))).sum(-1)


def _kind(s: Scenario) -> object:
    """What the variations of a group must have in common: planes."""
    return tuple((tuple(torch.as_tensor(g.normal).tolist()), g.sticks) for g in s.planes)


def _extras(s: Scenario) -> tuple[int, int]:
    """Numbers of Maxwell elements and of springs; in a group, those that a variation has not are of no strength."""
    elements = 0 if s.prony is None else s.prony.elements
    return elements, sum(isinstance(load, Spring) for load in s.loads)


@dataclass(frozen=True, eq=False)
class _Group:
    """Up to sixteen variations of a kind, as one batch of the simulator.

    Attributes:
        twin: The body.
        scenarios: All.
        lanes: The variations.
    """

    twin: Twin
    scenarios: Sequence[Scenario]
    lanes: Sequence[Lane]

    def simulate(self, dt: float, samples: int, markers: Tensor) -> Trajectory:
        """Motions [K, ...] of the markers, sampled so many times after the start."""
        lattice, first = self.twin.grid.lattice, self.scenarios[self.lanes[0][0]]
        simulator = Simulator(
            cell=lattice.cell,
            dt=dt,
            low=(-FAR,) * 3,
            high=(FAR,) * 3,
            formulation=Total(
                lattice=lattice,
                limit=math.inf,  # the step is chosen by a sharper bound
                device=None if self.twin.device == "cpu" else self.twin.device,
            ),
        )
        return simulator(
            self.body(),
            duration=samples * SAMPLE,
            prony=self.prony(),
            pressure=self.pressure(dt, samples),
            gravity=self.rows(lambda s: s.gravity, 1),
            planes=[self.plane(k, plane) for k, plane in enumerate(first.planes)],
            loads=[*(Clamp(low, high) for low, high in self.twin.setup.clamps), *self.forces(), *self.other_loads()],
            sample_every=SAMPLE,
            probes=markers,
            start=Start(
                displacement=self.rows(lambda s: s.displacement, 2), velocity=self.rows(lambda s: s.velocity, 2)
            ),
            divergence="mark",
            record="probes",
        )

    def stretched(self, found: Trajectory) -> list[float]:
        """Largest stretch of each variation that softens, I1b - 3; that of one that diverged is out of all bounds."""
        softens = self.rows(lambda s: s.softening, 1)[:, 0] > 0
        if not bool(softens.any()):
            return [0.0] * len(self.lanes)
        largest = found.final[..., -self.twin.grid.lattice.count :].amax(-1).cpu()
        return torch.where(softens, torch.where(found.sound, largest, FAR), 0.0).tolist()

    def rows(self, get: Amounts, rank: int) -> Tensor:
        """A quantity of each variation [K, ...] float32, of as many axes as it has without a batch."""
        given = {i: get(self.scenarios[i]) for i in {i for i, _ in self.lanes}}
        found = [t[b if len(t) > 1 else 0] if (t := given[i]).ndim > rank else t for i, b in self.lanes]
        return torch.stack(found).float()

    def body(self) -> Body:
        """Particles with their coefficients [K, P]."""
        grid = self.twin.grid
        solid, volume = torch.from_numpy(grid.solid), self.twin.volumes.float()
        young, density = (self.rows(get, 1)[:, solid] for get in (lambda s: s.youngs_modulus, lambda s: s.density))
        nu, volume = self.rows(lambda s: s.poisson_ratio, 0).unsqueeze(-1), volume[solid]
        stiffening, softening = (self.rows(get, 1) for get in (lambda s: s.stiffening, lambda s: s.softening))
        air = self.rows(lambda s: s.air_stiffness, 1)  # what takes all of it away may round to less
        return Body(
            position=grid.lattice.particles.float(),
            mass=density * volume,
            volume=volume,
            bulk=young / (3 * (1 - 2 * nu)),
            shear=young / (2 * (1 + nu)),
            chamber=torch.full_like(volume, -1, dtype=torch.int32),
            stiffening=stiffening.unsqueeze(1).expand(-1, len(volume), 2) if bool(stiffening.any()) else None,
            softening=softening if bool(softening[:, 0].any()) else None,
            air_stiffness=air.clamp(min=0) if self.twin.setup.chambers else None,
        )

    def prony(self) -> Prony | None:
        """Maxwell elements [K, E]."""
        most = max(_extras(self.scenarios[i])[0] for i, _ in self.lanes)
        if not most:
            return None

        def padded(name: str, value: float) -> Tensor:
            def of(s: Scenario) -> Tensor:
                own = torch.zeros(0, dtype=torch.float64) if s.prony is None else getattr(s.prony, name)
                return torch.nn.functional.pad(own, (0, most - own.shape[-1]), value=value)

            return self.rows(of, 1).double()

        return Prony(moduli=padded("moduli", 0.0), times=padded("times", 1.0))

    def pressure(self, dt: float, samples: int) -> Waveform | None:
        """Supply [K, chambers, steps + 1], or what is the same for all."""
        supplies = {i: self.scenarios[i].pressure for i, _ in self.lanes}
        first = supplies[self.lanes[0][0]]
        if first is None:
            return None
        if all(p is first for p in supplies.values()):
            own = first.pressure
            which = [b if len(own) > 1 else 0 for _, b in self.lanes]
            return first if own.ndim < 3 else Waveform(time=first.time, pressure=own[which])
        time = torch.arange(round(samples * SAMPLE / dt) + 1, dtype=torch.float64) * dt
        seen = {i: torch.atleast_2d(p.at(time.to(p.time))) for i, p in supplies.items() if p is not None}
        rows = [seen[i][b if len(seen[i]) > 1 else 0] if seen[i].ndim > 2 else seen[i] for i, b in self.lanes]
        return Waveform(time=time, pressure=torch.stack(rows))

    def plane(self, number: int, like: Plane) -> Plane:
        """One of the planes, with the numbers of each variation [K]."""

        def numbers(name: str) -> Tensor:
            return self.rows(lambda s: torch.as_tensor(getattr(s.planes[number], name)), 0)

        return Plane(
            normal=like.normal,
            offset=numbers("offset"),
            friction="stick" if like.sticks else numbers("friction"),
            adhesion=numbers("adhesion"),
            reach=numbers("reach"),
            landing=like.landing,
        )

    def forces(self) -> list[Force]:
        """Forces of all; those on the same nodes from the same time on are one, zero where a scenario has none."""
        values: dict[tuple[bytes, float], Tensor] = {}
        shares: dict[bytes, Tensor] = {}
        keys: dict[int, bytes] = {}  # of shares: those of different trials are tensors of their own
        for k, (i, b) in enumerate(self.lanes):
            for force in self.scenarios[i].loads:
                if isinstance(force, Force):
                    assert force.share is not None
                    value = force.value if force.value.ndim == 1 else force.value[b if len(force.value) > 1 else 0]
                    if not bool(value.any()):
                        continue  # as of a force whose place is that of other variations
                    if id(force.share) not in keys:
                        keys[id(force.share)] = force.share.numpy().tobytes()
                    key = keys[id(force.share)]
                    shares[key] = force.share
                    whole = values.setdefault((key, force.start), torch.zeros(len(self.lanes), 3))
                    whole[k] += value.float()
        return [Force(share=shares[key], value=value, start=start) for (key, start), value in values.items()]

    def other_loads(self) -> list[Load]:
        """Point masses, springs, drag, chains: the first ones of each scenario together, then the second ones, ..."""
        found: list[Load] = [*self._alike(PointMass, "mass"), *self._alike(Spring, "stiffness", mean=True)]
        found += [*self._alike(Drag, "coefficient"), *self._alike(QuadraticDrag, "coefficient")]
        return [*found, *self._alike(Chain, "length", "mass", "stiffness", "damping")]

    def _alike(self, kind: type, *names: str, **settings) -> list[Load]:
        known = {i: [x for x in self.scenarios[i].loads if isinstance(x, kind)] for i in {i for i, _ in self.lanes}}
        loads = []
        for number in range(max(map(len, known.values()))):
            there = [own[number] for own in known.values() if number < len(own)]

            def of(i: int, b: int, field: str, rank: int, number: int = number, there: list = there) -> Tensor:
                own = known[i]
                t = torch.as_tensor(getattr(own[number] if number < len(own) else there[0], field))
                t = t[b if b < len(t) else 0] if t.ndim > rank else t
                return t if number < len(own) or field == "share" else torch.zeros_like(t)

            given = {name: torch.stack([of(i, b, name, 0) for i, b in self.lanes]).float() for name in names}
            if kind is Chain:
                given["support"] = torch.stack([of(i, b, "support", 1) for i, b in self.lanes]).float()
            if kind is not QuadraticDrag:
                given["share"] = torch.stack([of(i, b, "share", 1) for i, b in self.lanes]).float()
            loads.append(kind(**given, **settings))
        return loads
