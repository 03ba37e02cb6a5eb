"""Simulations of one body in many variations: groups of sixteen, one group to a thread."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchsoro.sim2real.twin.grid import Grid
from torchsoro.sim2real.twin.scenario import Scenario
from torchsoro.sim2real.twin.twin import MarkerTrajectory, Twin
from torchsoro.sim2real.twin.variations import simulate
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.kernels.compiled import remove_stale_code
from torchsoro.simulation.kernels.lanes import LANES
from torchsoro.simulation.kernels.variations import Case
from torchsoro.simulation.material import Prony
from torchsoro.simulation.ops.inertia import Matching

SAMPLE = 2.5e-3  # s between two samples of a motion, which is interpolated by cubics
SAFETY = 1.4  # times the bound of a stable step near rest; free blocks and bars were stable up to 1.6
CUT = 1.0  # the same where cells are filled in part, whose nodes may have little mass
SHORTEST = 1e-9  # s, a step; shorter ones are lost to rounding
THREADS = os.cpu_count() or 1

Lane = tuple[int, int]  # number of the scenario, and of its variation


def safety(grid: Grid) -> float:
    """Step in use over the bound of a stable step near rest."""
    return CUT if grid.cut else SAFETY


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Simulates variations of scenarios of one body.

    Attributes:
        twin: The body.
        threads: Number of threads.
        safety: Step over the bound of a stable one near rest; chosen by the body's cells if None.
        even: Whether all variations of a call take the same time step, so that its error cancels in their differences.
    """

    twin: Twin
    threads: int = THREADS
    safety: float | None = None
    even: bool = False

    def __post_init__(self) -> None:
        """Make sure that no code of another version is run."""
        remove_stale_code()

    @property
    def room(self) -> int:
        """Number of variations that take as long as one."""
        return LANES * self.threads

    @cached_property
    def spreads(self) -> Tensor:
        """By how much lumped masses exceed second moments, by node and axis [n, 3] m2."""
        each = (a.spreads for a in self.twin.grid.axes)
        return torch.from_numpy(np.stack(np.meshgrid(*each, indexing="ij"), -1).reshape(-1, 3))

    @cached_property
    def chamber_volume(self) -> np.ndarray:
        """Of the undeformed chambers [chambers] m3."""
        _, _, places, axes, areas, chambers = self.twin.grid.walls
        found = np.zeros(len(self.twin.setup.chambers))
        np.add.at(found, chambers, areas * places[np.arange(len(axes)), axes] / 3)
        return found

    def __call__(self, scenarios: Sequence[Scenario]) -> list[MarkerTrajectory]:
        """Simulate.

        Args:
            scenarios: Each with a batch of variations [B], or none.

        Returns:
            For each scenario, its motions [B, ...]; diverged ones are not ``sound``.

        Raises:
            ValueError: if one is so stiff that no step is short enough.
        """
        lanes = [(i, b) for i, s in enumerate(scenarios) for b in range(s.batch)]
        steps = [self.stable(s) for s in scenarios]
        if self.even:
            least = min(float(dt.min()) for dt in steps)
            steps = [np.full_like(dt, least) for dt in steps]
        if not (shortest := min(float(dt.min()) for dt in steps)) > SHORTEST:
            raise ValueError(
                f"stiffness: a step of {shortest:g} s is needed, wanted a body with at least {SHORTEST:g} s"
            )
        alike: dict[object, list[Lane]] = {}
        for lane in lanes:
            alike.setdefault(_common(scenarios[lane[0]]), []).append(lane)
        kinds = []
        for members in alike.values():
            members.sort(key=lambda lane: steps[lane[0]][lane[1]])
            kinds.append([members[k : k + LANES] for k in range(0, len(members), LANES)])
        markers = len(self.twin.setup.markers)
        nodes, values = self.twin.marks()
        longest = max(s.until for s in scenarios)
        samples = math.ceil(longest / SAMPLE - 1e-9) + 1
        seen = [np.zeros((s.batch, samples, markers, 5, 3)) for s in scenarios]

        def run(group: list[Lane]) -> float:
            dt = min(steps[i][b] for i, b in group)
            every = math.ceil(SAMPLE / dt)
            case = self.case(scenarios, group, SAMPLE / every, every, samples)
            found = looked_at(simulate(self.twin, case, samples), nodes, values)
            for k, (i, b) in enumerate(group):
                seen[i][b] = found[..., k]
            return case.dt

        with ThreadPoolExecutor(self.threads) as pool:
            largest = max(pool.map(run, itertools.chain(*kinds)))
        at = np.array([m.at for m in self.twin.setup.markers], float)
        time = np.arange(samples) * SAMPLE
        return [
            MarkerTrajectory(
                time=time,
                position=at + x[:, :, :, 0],
                velocity=x[:, :, :, 1],
                gradient=np.eye(3) + np.swapaxes(x[:, :, :, 2:], -1, -2),
                dt=largest,
            )
            for x in seen
        ]

    def stable(self, s: Scenario) -> np.ndarray:
        """Largest stable step of each variation [B] s; a Maxwell element counts by its stiffness within one step."""
        nu = s.poisson_ratio.unsqueeze(-1)
        bulk, shear = s.youngs_modulus / (3 * (1 - 2 * nu)), s.youngs_modulus / (2 * (1 + nu))
        bulk, shear = (torch.sqrt((m / s.density).amax(-1)).expand(s.batch).numpy() for m in (bulk, shear))
        dt, share = np.full(s.batch, 1.0), self.safety or safety(self.twin.grid)
        steep = max(a.steep for a in self.twin.grid.axes)
        for _ in range(40):
            factor = np.ones(s.batch)
            if s.prony is not None:
                tau, g = (t.expand(s.batch, s.prony.elements).numpy() for t in (s.prony.times, s.prony.moduli))
                ratio = dt[:, None] / tau
                a, b = np.exp(-ratio), -np.expm1(-ratio) / ratio
                factor = 1 + (g * b * 2 / (1 + a)).sum(-1)
            speed = np.maximum(math.sqrt(3) * bulk, np.sqrt(2 * factor) * shear)
            dt = np.sqrt(dt * share * 2 / (speed * math.sqrt(steep)))
        return np.minimum(dt, SAMPLE)

    def case(self, scenarios: Sequence[Scenario], group: list[Lane], dt: float, every: int, samples: int) -> Case:
        """Numbers of up to sixteen variations; empty lanes repeat the first."""
        full = [*group, *[group[0]] * (LANES - len(group))]
        varied = [scenarios[i] for i, _ in full]

        def lanes(get, rank: int) -> np.ndarray:
            rows = []
            for (_, b), s in zip(full, varied, strict=True):
                t = torch.as_tensor(get(s), dtype=torch.float64)
                rows.append(t[b if t.shape[0] > 1 else 0] if t.ndim > rank else t)
            return np.ascontiguousarray(torch.stack(rows, -1).numpy(), dtype=np.float32)

        steps = every * (samples - 1)
        volume = self.twin.volumes

        def modulus(s: Scenario, kind: str) -> Tensor:
            nu = s.poisson_ratio.unsqueeze(-1)
            return volume * s.youngs_modulus / (3 * (1 - 2 * nu) if kind == "bulk" else 2 * (1 + nu))

        known: dict[int, Tensor] = {}

        def mass(s: Scenario) -> Tensor:
            if id(s) not in known:
                own = torch.atleast_2d(self.twin.nodal(s.density * volume))
                known[id(s)] = Matching.of(own, self.twin.places, self.spreads).matched + s.point_mass
            return known[id(s)]

        weight = lanes(lambda s: torch.where(mass(s) > 0, 1 / mass(s).clamp(min=1e-30), 0.0), 1)
        left = lanes(lambda s: mass(s) / (mass(s) + dt * s.drag).clamp(min=1e-30), 1)
        first = varied[0]
        elements = 0 if first.prony is None else first.prony.elements
        maxwell = np.zeros((elements, 4, LANES), np.float32)
        for e in range(elements):
            maxwell[e] = lanes(lambda s, e=e: _series(s.prony, dt, e), 1)
        chambers = len(self.twin.setup.chambers)
        supply = np.zeros((steps if chambers else 1, chambers, LANES), np.float32)
        if chambers:
            times = torch.arange(steps, dtype=torch.float64) * dt
            for k, ((_, b), s) in enumerate(zip(full, varied, strict=True)):
                supply[:, :, k] = _pressure(s.pressure, b).at(times).T.numpy()
        forces = _forces(full, varied, dt)
        springs = [lanes(lambda s, i=i: s.springs[i].share, 1) for i in range(len(first.springs))]
        where = [np.flatnonzero(share.any(-1)) for share in springs]
        empty = np.zeros(0, np.int64)
        planes = range(len(first.planes))
        law = lanes(lambda s: torch.cat(torch.broadcast_tensors(s.stiffening, s.softening), -1), 1)
        moduli = np.stack([lanes(lambda s, k=k: modulus(s, k), 1) for k in ("shear", "bulk")], 1)
        normals = np.array([g.normal.numpy() for g in first.planes]).reshape(-1, 3)
        return Case(
            dt=dt,
            steps=steps,
            every=every,
            own=np.concatenate([moduli, np.zeros_like(moduli[:, :1])], 1).reshape(-1),
            series=maxwell.reshape(-1),
            law=law.reshape(-1),
            stiffens=bool(law[:2].any()),
            softens=bool(law[2].any()),
            weight=weight,
            left=left,
            gravity=lanes(lambda s: s.gravity, 1),
            fluid=lanes(lambda s: s.quadratic_drag / 2, 0),
            place=lanes(lambda s: s.displacement, 2),
            velocity=lanes(lambda s: s.velocity, 2),
            supply=supply,
            air=lanes(lambda s: s.air_stiffness, 1),
            volume=self.chamber_volume.astype(np.float32),
            **forces,
            spring_node=np.concatenate([empty, *where]),
            spring_share=np.concatenate(
                [np.zeros((0, LANES), np.float32), *(w[n] for w, n in zip(springs, where, strict=True))]
            ),
            spring_number=np.concatenate([empty, *(np.full(len(n), i) for i, n in enumerate(where))]),
            springs=np.stack(
                [
                    np.zeros(LANES, np.float32),
                    *(lanes(lambda s, i=i: s.springs[i].stiffness, 0) for i in range(len(springs))),
                ]
            )[1:],
            normals=normals.astype(np.float32),
            stick=np.array([g.sticks for g in first.planes], bool),
            offset=_rows(lanes, planes, "offset"),
            friction=_rows(lanes, planes, "friction"),
            adhesion=_rows(lanes, planes, "adhesion"),
            reach=_rows(lanes, planes, "reach"),
            area=np.array([self.twin.grid.facing(n) for n in normals], np.float32).reshape(
                len(normals), self.twin.grid.nodes
            ),
        )


def looked_at(motion: np.ndarray, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Markers in nodal motions [samples, 6, nodes, 16].

    Args:
        motion: Displacements and velocities.
        nodes: Of each marker [M, 27].
        values: Weights and slopes [M, 27, 4].

    Returns:
        Place, velocity, and derivatives of the displacement by x, y, z [samples, M, 5, 3, 16].
    """
    near = motion[:, :, nodes].astype(float)
    d, v = near[:, :3], near[:, 3:]
    moved = np.einsum("scmnl,mn->smcl", v, values[..., 0])
    parts = np.einsum("scmnl,mnk->smkcl", d, values)
    return np.concatenate([parts[:, :, :1], moved[:, :, None], parts[:, :, 1:]], 2)


def _common(s: Scenario) -> object:
    """What the variations of a group must have in common: numbers of elements, planes and springs."""
    elements = 0 if s.prony is None else s.prony.elements
    planes = tuple((tuple(g.normal.tolist()), g.sticks) for g in s.planes)
    return elements, planes, len(s.springs)


def _rows(lanes, planes: range, name: str) -> np.ndarray:
    """A number of each plane [A, 16]."""

    def get(s: Scenario, i: int):
        value = getattr(s.planes[i], name)
        return torch.zeros(()) if isinstance(value, str) else value  # a plane that sticks has no coefficient

    rows = [lanes(lambda s, i=i: get(s, i), 0) for i in planes]
    return np.array(rows, np.float32).reshape(len(rows), LANES)


def _series(prony: Prony | None, dt: float, element: int) -> Tensor:
    """Numbers of one element [..., 4]."""
    assert prony is not None
    a, b, g = prony.discrete(dt)[..., element, :].unbind(-1)
    return torch.stack([g, g * b, a, b * (1 - a)], -1)


def _pressure(supply: Waveform | None, number: int) -> Waveform:
    """Of one variation [chambers, S]."""
    assert supply is not None
    p = supply.pressure if supply.pressure.ndim > 1 else supply.pressure.unsqueeze(0)
    if p.ndim > 2:
        p = p[number if p.shape[0] > 1 else 0]
    return Waveform(time=supply.time.double(), pressure=p.double())


def _forces(full: Sequence[Lane], varied: Sequence[Scenario], dt: float) -> dict[str, np.ndarray]:
    """Forces of each scenario in its own lanes."""
    begin, nodes, shares, values, starts = [0], [], [], [], []
    for number in dict.fromkeys(i for i, _ in full):
        mine = [k for k, (i, _) in enumerate(full) if i == number]
        for force in varied[mine[0]].forces:
            on = np.flatnonzero(force.share.numpy())
            nodes.append(on)
            shares.append(force.share.numpy()[on])
            begin.append(begin[-1] + len(on))
            value, given = np.zeros((3, LANES), np.float32), force.value
            for k in mine:
                one = given[full[k][1] if given.shape[0] > 1 else 0] if given.ndim > 1 else given
                value[:, k] = one.numpy()
            values.append(value)
            # One that begins at a step does, however that is rounded.
            starts.append(math.ceil(force.start / dt - 1e-3))
    none = np.zeros(0)
    return {
        "push_begin": np.array(begin),
        "push_node": np.concatenate([none, *nodes]).astype(np.int64),
        "push_share": np.concatenate([none, *shares]).astype(np.float32),
        "push": np.array(values, np.float32).reshape(-1, 3, LANES),
        "push_start": np.array(starts, np.int64),
    }
