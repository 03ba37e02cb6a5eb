"""Scenarios of a design run: simulated in shares, judged together, and their gradients summed in a fixed order.

On a CPU a scenario's numbers do not depend on which others are simulated beside it: every share fills whole groups of
sixteen lanes, or none does where there are few scenarios; all shares take the same substep, and gradients are kept
apart until they are summed in the order of scenarios. So they are the same bits for any number of processes. On a GPU
they agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsoro.design.features import threshold_of
from torchsoro.design.objective import center_of_gravity, intermediate_density, total_mass
from torchsoro.design.outcome import Outcome
from torchsoro.design.placement import Membership
from torchsoro.design.processes import Processes
from torchsoro.design.risk import CVaR, parse_risk
from torchsoro.design.robot import LANES, Robot
from torchsoro.design.scenarios import ScenarioBatch
from torchsoro.errors import SimulationDiverged

JUDGED = ("travel", "feet", "soles", "inflated", "fall")  # what is gathered of every scenario,
TURNS = ("turn", "turn_inflated")  # and of a turner
# Share of the risk's gradient by scenarios that overflowed, or that fell, above which it says nothing.
MOST = 0.5
_END, _JUDGE, _PULL = 0.0, 1.0, 2.0  # what the other processes are told to do
VARIANTS = ("intermediate", "eroded", "dilated")  # of a design whose features have a least thickness
FALLEN = 0.1  # sinking beyond what is allowed, in heights of the body, from which a robot counts as fallen


def overall(robot: Robot, values: Tensor) -> Tensor:
    """What values count for: with scenarios [S] the risk of them, else the value itself."""
    return values if values.ndim == 0 else parse_risk(robot.settings.risk)(values)


def fallen(robot: Robot, outcome: Outcome) -> Tensor:
    """Whether the centre of gravity sank by more than a tenth of the height beyond what is allowed, bool [...]."""
    return outcome.fall.detach() > FALLEN * robot.settings.size[2]


def shares(robot: Robot, values: Tensor) -> Tensor:
    """What part of the risk's gradient is by each value [S], summing to 1."""
    leaf = values.detach().requires_grad_()
    with torch.enable_grad():
        (found,) = torch.autograd.grad(overall(robot, leaf), leaf)
    return found


class Ensemble:
    """Simulates a robot, whose timing and chambers may be designed, too, in its scenarios, by one process or several.

    With a least thickness of features, scenarios meet three variants of the design in turn: itself, eroded, dilated.
    Their thresholds grow once the projection is sharp, over as many iterations as that took: eroded grey is void.

    Args:
        robot: The robot.
        processes: Those of the run.

    Attributes:
        thresholds: Of the projection in the end, for each variant.
    """

    def __init__(self, robot: Robot, processes: Processes | None = None) -> None:
        self.robot = robot
        self.processes = processes or Processes()
        self.count = robot.settings.scenarios
        self.parts = self.processes.deal(self.count)
        self.own = self.parts[self.processes.rank]
        spare = robot.carried(len(self.own), self.count) - len(self.own)
        self._places = [*self.own, *[self.own[-1]] * spare]
        self.judged = JUDGED + (TURNS if robot.settings.robot == "turner" else ())
        self._timing = {name: one for name, one in robot.supply.named_parameters() if one.requires_grad}
        feature = robot.settings.feature
        eroded = threshold_of(robot.settings.filter_radius, feature) if feature else 0.0
        self.thresholds = (0.0, eroded, -eroded) if feature else (0.0,)
        self._variants: list[Tensor] = []  # densities, with their gradient by the design variable
        self._shares = torch.empty(0)  # of designed chambers in each particle [3, N], with their gradient
        # Density, those shares and what is designed of the timing, of each place.
        self._inputs: tuple[Tensor, ...] = ()
        self._values = self._all = torch.empty(0)
        self.lost = 0

    def sample(self, iteration: int) -> ScenarioBatch:
        """The scenarios of an iteration, which a run that is resumed draws again."""
        s = self.robot.settings
        return s.distribution.sample(self.count, s.scenario_seed + (iteration if s.fresh else 0))

    def grown(self, iteration: int) -> float:
        """What part of their thresholds the variants have in an iteration, 0 to 1; 1 where there are none."""
        first, last = self.robot.settings.sharpen
        if len(self.thresholds) == 1 or not last:
            return 1.0
        return self.robot.settings.sharpened(iteration - (last - first))

    def judge(self, gamma: Tensor, iteration: int, gravity_scale: float) -> Outcome:
        """Simulate a design in the scenarios of an iteration.

        Args:
            gamma: Density [N], of the robot's field.
            iteration: Counted from 0.
            gravity_scale: Share of gravity.

        Returns:
            Travel, that of feet and soles, what is inflated, falls and a turner's angles of each scenario [S] (those of
            others have no numbers); the rest of the design itself. Their gradient is that of :meth:`gradient`.

        Raises:
            SimulationDiverged: if a scenario breaks down even with the smallest step; ``batch`` is its index.
        """
        robot, s = self.robot, self.robot.settings
        batch = self.sample(iteration)
        dt = robot.step(gamma, batch)
        grown = self.grown(iteration)
        self._variants = [gamma, *(robot.density(grown * one) for one in self.thresholds[1:])]
        for halving in range(s.halvings + 1):
            step = dt / 2**halving
            _tell(self.processes, _JUDGE, iteration, gravity_scale, step)
            variants = self._share(torch.stack(self._variants).detach())
            outcome = self._simulated(variants, batch, gravity_scale, step)
            error = self.processes.first_error(outcome if isinstance(outcome, SimulationDiverged) else None)
            if error is None:
                break
            if halving == s.halvings:
                raise error
        assert isinstance(outcome, Outcome)
        self._all = self.processes.gather(self._values.detach(), self.parts).requires_grad_()
        member = robot.membership(gamma)
        if member is not None:
            self._shares = _stacked(member)
            member = _unstacked(self._shares, member)
        body = robot.filled(gamma, member)
        solid, weight = robot.weights(body, gamma, member)
        none = self._all.new_full((self.count,), math.nan)
        found = {**dict.fromkeys(TURNS, none), **dict(zip(self.judged, self._all.unbind(1), strict=True))}
        return replace(
            outcome,
            **found,
            intermediate=intermediate_density(gamma, robot.design) if member is None else member.intermediate(gamma),
            mass=total_mass(solid),
            center=center_of_gravity(body.position, weight),
        )

    def gradient(self, gamma: Tensor, aims: Tensor) -> list[Tensor]:
        """Gradient of minus the risk by all that is designed, as of the last :meth:`judge`.

        That of each scenario is limited in norm to its part of ``settings.clip``, by field, timing and chambers each: a
        tumble, whose norm is hundreds of times that of a walk, would be all that is left of the sum. Those that
        overflow are left out and counted in ``lost``; where they are more than half of the risk, the gradient is not
        finite.

        Args:
            gamma: Density [N], of the robot's field.
            aims: What is maximised, of each scenario [S], made of that outcome.

        Returns:
            By ``phi``, and by each parameter of ``robot.supply.designed()`` and of ``robot.placement.designed()``.
        """
        robot, clip = self.robot, self.robot.settings.clip
        phi, placing = robot.field.phi, robot.placement.designed() if robot.placement is not None else []
        part = shares(robot, aims)
        common = [gamma, self._shares] if placing else [gamma]  # what the mass, the same in all scenarios, hangs on
        by_motion, *by_mass = torch.autograd.grad(
            -(part * aims).sum(), (self._all, *common), retain_graph=True, allow_unused=True
        )
        _tell(self.processes, _PULL)
        self.processes.broadcast(by_motion)
        by_gamma, *others = (self.processes.gather(rows, self.parts) for rows in self._pulled(by_motion))
        by_shares, by_timing = (others[0], others[1:]) if placing else (None, others)
        units = [1.0, 1.0, robot.domain.spacing]  # chambers count by spacings, as in the loop
        totals = [torch.zeros_like(one) for one in (phi, *self._timing.values(), *placing)]
        self.lost, missing = 0, 0.0
        for k, weight in enumerate(part.tolist()):
            if weight == 0:
                continue
            made = [self._variants[k % len(self.thresholds)], *common[1:]]
            bars = [by_gamma[k]] if by_shares is None else [by_gamma[k], by_shares[k]]
            for one, bar in zip(common, by_mass, strict=True):
                if bar is not None:
                    made, bars = [*made, one], [*bars, weight * bar]
            by_phi, *by_chambers = torch.autograd.grad(made, (phi, *placing), bars, retain_graph=True)
            groups = [[by_phi], [rows[k] for rows in by_timing], by_chambers]
            norms = [
                unit * float(torch.cat([one.flatten() for one in group]).norm()) if group else 0.0
                for unit, group in zip(units, groups, strict=True)
            ]
            if not all(map(math.isfinite, norms)):
                self.lost, missing = self.lost + 1, missing + weight
                continue
            limits = [min(1.0, clip * weight / (norm + 1e-6)) if clip else 1.0 for norm in norms]
            scaled = [one * limit for group, limit in zip(groups, limits, strict=True) for one in group]
            for total, one in zip(totals, scaled, strict=True):
                total += one
        return totals if missing <= MOST else [torch.full_like(total, math.nan) for total in totals]

    def serve(self) -> None:
        """Simulate what process 0 asks for, until it has no more; of the other processes."""
        like = self.robot.field.phi
        if like.device.type == "cpu":
            torch.set_num_threads(1)  # as process 0: the threads of the kernels do the work
        while True:
            task, iteration, gravity_scale, step = self.processes.broadcast(
                torch.zeros(4, dtype=torch.float64)
            ).tolist()
            if task == _END:
                return
            if task == _PULL:
                bars = self.processes.broadcast(like.new_empty(self.count, len(self.judged)))
                for rows in self._pulled(bars):
                    self.processes.gather(rows, self.parts)
                continue
            variants = self._share(like.new_empty(len(self.thresholds), self.robot.domain.count))
            outcome = self._simulated(variants, self.sample(int(iteration)), gravity_scale, step)
            error = self.processes.first_error(outcome if isinstance(outcome, SimulationDiverged) else None)
            if error is None:
                self.processes.gather(self._values.detach(), self.parts)

    @torch.no_grad()
    def _share(self, variants: Tensor) -> Tensor:
        """The design of process 0: densities of its variants [V, N]; timing and chambers are put into the robot."""
        for one in self._timing.values():
            one.copy_(self.processes.broadcast(one.detach()))
        if (placement := self.robot.placement) is not None:
            state = placement.state_dict().items()
            placement.load_state_dict({name: self.processes.broadcast(one.double()) for name, one in state})
        return self.processes.broadcast(variants)

    @torch.enable_grad()
    def _simulated(
        self, variants: Tensor, batch: ScenarioBatch, gravity_scale: float, dt: float
    ) -> Outcome | SimulationDiverged:
        """Simulate this process's share; keeps what :meth:`_pulled` goes back through."""
        met = variants[[k % len(variants) for k in self._places]]
        timed = [one.detach().expand(len(self._places), -1).clone() for one in self._timing.values()]
        how: dict[str, Any] = {"gravity_scale": gravity_scale, "dt": dt}
        member, placement = self.robot.membership(variants), self.robot.placement
        placed: list[Tensor] = []
        if member is not None and placement is not None and placement.designed():
            placed = [_stacked(member).detach().expand(len(self._places), -1, -1).clone()]
        self._inputs = tuple(value.requires_grad_() for value in (met, *placed, *timed))
        if member is not None and placed:
            how["membership"] = _unstacked(placed[0], member)
        if timed:
            how["pressure"] = self.robot.supply.each(dict(zip(self._timing, timed, strict=True)))
        try:
            outcome = self.robot(met, scenarios=batch.part(self._places), **how)
        except SimulationDiverged as error:
            found = {name: getattr(error, name) for name in ("step", "time", "particle", "quantity", "remedy")}
            return SimulationDiverged(**found, batch=self._places[error.batch])
        self._values = torch.stack([getattr(outcome, name) for name in self.judged], 1)[: len(self.own)]
        return outcome

    def _pulled(self, bars: Tensor) -> list[Tensor]:
        """By density, chambers' shares and timing of this process's scenarios [own, ...].

        Args:
            bars: Gradient by what is judged [S, n].
        """
        mine = bars[self.own.start : self.own.stop]
        found = torch.autograd.grad(self._values, self._inputs, mine)
        self._values = self._values.detach()
        return [one[: len(self.own)] for one in found]


def _stacked(member: Membership) -> Tensor:
    """Shares of air, wall and design [..., 3, N]."""
    return torch.stack([member.air, member.wall, member.design], -2)


def _unstacked(shares: Tensor, member: Membership) -> Membership:
    """Those shares again, with the chambers of another membership."""
    air, wall, design = shares.unbind(-2)
    return Membership(air=air, wall=wall, design=design, chamber=member.chamber)


def _tell(processes: Processes, *numbers: float) -> None:
    """Say what the other processes are to do next."""
    told = torch.zeros(4, dtype=torch.float64)
    told[: len(numbers)] = torch.tensor(numbers, dtype=torch.float64)
    processes.broadcast(told)


def end(processes: Processes) -> None:
    """Let the other processes go."""
    _tell(processes, _END)


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What a design does in scenarios, in SI units, each [S]; NaN where the simulation broke down.

    Attributes:
        batch: The scenarios.
        travel: L [m].
        fall: See :class:`Outcome` [m].
        fell: Whether it fell, see :func:`fallen`.
        errors: Of the scenarios that broke down, by index.
    """

    batch: ScenarioBatch
    travel: np.ndarray
    fall: np.ndarray
    fell: np.ndarray
    errors: dict[int, str]

    def numbers(self) -> dict[str, float]:
        """Spread of the travel [m], mean of the lowest tenth included, and numbers of falls and of breakdowns.

        A scenario that broke down counts as one in which the robot stays where it is at best.
        """
        least = np.nan_to_num(self.travel, nan=min(0.0, np.nanmin(self.travel, initial=0.0)))
        tenth = CVaR(0.1)(torch.from_numpy(least))
        found = {"L_min": least.min(), "L_lowest_tenth": tenth, "L_mean": least.mean(), "L_max": least.max()}
        return {
            **{name: float(value) for name, value in found.items()},
            "falls": int(self.fell.sum()),
            "diverged": len(self.errors),
        }


@torch.no_grad()
def evaluate(
    robot: Robot,
    gamma: Tensor,
    batch: ScenarioBatch,
    *,
    void: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Simulate a design in scenarios, sixteen at a time; one that breaks down takes none with it.

    Args:
        robot: The robot.
        gamma: Its density [N].
        batch: The scenarios.
        void: Simulate void, too.
        progress: Called with the scenarios that are done and their number.
    """
    dt = robot.step(gamma, batch)
    travel, fall = np.full(batch.count, np.nan), np.full(batch.count, np.nan)
    fell, errors = np.zeros(batch.count, dtype=bool), {}
    waiting = [(list(range(k, min(k + LANES, batch.count))), dt) for k in range(0, batch.count, LANES)]
    done = 0
    while waiting:
        some, step = waiting.pop(0)
        try:
            outcome = robot(gamma, scenarios=batch.part(some), void=void, dt=step)
        except SimulationDiverged as error:
            if len(some) > 1:
                waiting = [([one], dt) for one in some] + waiting
                continue
            if step > 1.5 * dt / 2**robot.settings.halvings:
                waiting.insert(0, (some, step / 2))
                continue
            errors[some[0]] = str(error)
        else:
            travel[some], fall[some] = outcome.travel.cpu().numpy(), outcome.fall.cpu().numpy()
            fell[some] = fallen(robot, outcome).cpu().numpy()
        done += len(some)
        if progress is not None:
            progress(done, batch.count)
    return Evaluation(batch=batch, travel=travel, fall=fall, fell=fell, errors=errors)
