"""The simulator: from a body, its loads and a duration to a trajectory, differentiable in all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Literal

import torch
from torch import Tensor, nn

from torchsoro.errors import refuse_gradients
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.assembly import (
    assemble,
    check_body,
    check_probes,
    check_start,
    check_weight,
    gravity_at,
    supply_at,
)
from torchsoro.simulation.attachment import held_still, on_nodes, refuse_shifted
from torchsoro.simulation.checkpoints import MEMORY, plan_checkpoints
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.formulation import Formulation, FormulationName, check_self_contact, formulation_of
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import Attached, Load, attach
from torchsoro.simulation.material import Body, Prony
from torchsoro.simulation.ops.markers import Markers
from torchsoro.simulation.ops.rollout import refuse_transforms, rollout
from torchsoro.simulation.ops.scene import Inputs, Scene
from torchsoro.simulation.stability import STABLE_COURANT, courant, stable_step
from torchsoro.simulation.tracing import uncompiled
from torchsoro.simulation.trajectory import Start, Trajectory


class Simulator(nn.Module):
    """Differentiable visco-hyperelastic material point method, in two formulations.

    - "updated": MLS-MPM, the paper's. The grid stays, particles move through it; bodies meet each other on the grid.
    - "total": total-Lagrangian. The grid is the body's own lattice and moves with it: no loss of energy, the same bits
      in every run, several times faster. Needs particles on a lattice of half a cell, chambers have one pressure each,
      and a body feels itself where it folds if ``self_contact`` is on (else see ``selfcontact``).

    A call simulates a body and returns a :class:`Trajectory`. Gradients flow to every tensor of the body, the Prony
    series, pressure, gravity, planes and loads that requires one.

    Args:
        cell: Grid cell dx [m].
        dt: Substep [s]; "auto" takes the largest that is stable for the body at hand and divides the sampling interval.
        low: Lower corner of the analysis box [m].
        high: Upper corner of the analysis box [m].
        transfer: Of the updated formulation by name. "apic" (the paper's; where None) takes a particle's velocity and
            its gradient C from the grid: angular momentum is kept to rounding, and vibrations that the grid does not
            resolve are damped at every substep. "flip" (affine FLIP) adds only what changed on the grid to the
            velocity, and takes C from the grid: vibrations are hardly damped, but angular momentum changes at every
            substep by sum m x (v - v_grid), by the part of the velocities that the grid does not resolve. A cube of
            0.44 MPa that turns freely at 60 rad/s with a substep of 0.1 ms loses in five turns, with apic, 0.02, 0.05
            and 0.11 % of its speed for edges of 2, 4 and 6 cells; with flip 25, 6.8 and 2.8 %.
        formulation: "updated" or "total", or one of the objects in :mod:`torchsoro.simulation.formulation`.
        memory_budget: Bytes that a rollout may keep for its gradient; if None 2 GiB on a CPU and 6 GiB on CUDA, or the
            least that it takes, if that is more.
        together: Simulations that a call may be a part of: what is kept is planned as for all of them, so that the
            gradient of each has the same bits in any part; those of the call if None.
        segment: Substeps between two kept states, instead of the plan from the budget; for tests.
        safety: Share of the largest stable step that dt = "auto" takes.
        self_contact: Whether parts of a body repel each other, without friction, where they come nearer than one and a
            half particle spacings although they were more than three apart in the undeformed body. Stiffness is
            Young's modulus times spacing, of the weaker of two particles; void has none. Of the total formulation; in
            the updated one parts of a body meet on the grid.

    Raises:
        ValueError: for numbers that are not finite and positive, an empty box, an unknown formulation or transfer, or
            self-contact of what has none.
    """

    def __init__(
        self,
        *,
        cell: float,
        dt: float | Literal["auto"],
        low: Sequence[float],
        high: Sequence[float],
        transfer: str | None = None,
        formulation: FormulationName | Formulation = "updated",
        memory_budget: int | None = None,
        together: int | None = None,
        segment: int | None = None,
        safety: float = 0.9,
        self_contact: bool = False,
    ) -> None:
        super().__init__()
        numbers = {"cell": cell, "dt": dt, "memory_budget": memory_budget, "segment": segment, "safety": safety}
        numbers |= {"together": together}
        refuse_gradients(**numbers, low=low, high=high)
        if dt == "auto":
            del numbers["dt"]
        for name, value in numbers.items():
            if isinstance(value, str) or (value is not None and not (math.isfinite(value) and value > 0)):
                raise ValueError(f"{name} = {value}: wanted finite and positive")
        if len(low) != 3 or len(high) != 3 or not all(b - a > 6 * cell for a, b in zip(low, high, strict=True)):
            raise ValueError(f"low, high = {tuple(low)}, {tuple(high)}: wanted three numbers each, over 6 cells apart")
        self.formulation = formulation_of(formulation, transfer)
        self.cell, self.safety = float(cell), safety
        self.dt: float | Literal["auto"] = "auto" if dt == "auto" else float(dt)
        self.low, self.high = _triple(low), _triple(high)
        self.memory_budget, self.together, self.segment = memory_budget, together, segment
        check_self_contact(self_contact, self.formulation)
        self.self_contact = self_contact

    def extra_repr(self) -> str:
        """For ``print``."""
        return f"cell={self.cell:g} m, dt={self.dt} s, {self.formulation}"

    @uncompiled
    def forward(
        self,
        body: Body,
        *,
        duration: float,
        prony: Prony | None = None,
        pressure: Waveform | None = None,
        gravity: Tensor | Sequence[float] | tuple[Tensor, Tensor] = (0.0, 0.0, -9.81),
        planes: Sequence[Plane] = (),
        loads: Sequence[Load] = (),
        sample_every: float | None = None,
        probes: Tensor | None = None,
        weight: Tensor | None = None,
        start: Trajectory | Tensor | Start | None = None,
        divergence: Literal["raise", "mark"] = "raise",
        record: Literal["all", "probes"] = "all",
        progress: Callable[[int, int], None] | None = None,
    ) -> Trajectory:
        """Simulate.

        Args:
            body: Particles; leading axes are a batch of independent simulations, as are those of the arguments below.
            duration: [s], a whole number of substeps.
            prony: Maxwell elements of the solids.
            pressure: Gauge pressure p_act of the chambers [..., chambers, S], or [S] for a single chamber; those of
                particles first, then hollow ones.
            gravity: [..., 3] m/s2; or a pair of times [S] and values [..., S, 3], interpolated linearly.
            planes: Ground and walls.
            loads: Forces, point masses, springs, drag and clamps.
            sample_every: Time between two samples [s], a whole number of substeps, of which the duration is a multiple
                where dt is "auto"; about a hundred samples if None.
            probes: Particles to record, int64 [P]; or places of the undeformed body, floating point [P, 3] m, which
                move with the nearest place of it (total formulation only); none if None.
            weight: Particle weights of the recorded centre of gravity [..., N]; the mass if None. In the total
                formulation a particle's weight lies where its mass does, at a point of quadrature, which is 0.08 of a
                spacing away along each axis.
            start: Trajectory to go on from, in state and time: pressure, gravity, forces and samples continue at its
                last time. Or a state alone (``Trajectory.final``), or a ``Start`` of the nodes, with which time begins
                at zero. The undeformed body at time zero if None.
            divergence: Whether a simulation that diverges raises, or is marked (``Trajectory.sound``) while the others
                of the batch go on as they would without it; of the total-Lagrangian form, without a gradient. Only
                what is recorded marks it, so that gas particles which collapse inside of a chamber, for which a run
                that raises ends, do not.
            record: "probes" leaves out centre of gravity, chamber volumes and pressures, which then have no numbers
                [..., S, 0]; with places as probes and simulations that are marked only.
            progress: Called between stretches of the simulation, up to a hundred without a gradient, with the substeps
                that are done and their number in all.

        Returns:
            The trajectory, sampled at its start, ``sample_every`` later, ... and at the end.

        Raises:
            ValueError: for bad input, before any work; also if dt is above the limit of the fastest wave.
            SimulationDiverged: if a particle leaves the box, collapses or is no longer finite.
        """
        refuse_transforms()
        x = body.position
        refuse_gradients(duration=duration, sample_every=sample_every)
        if self.dt != "auto":
            steps, every = _steps(duration, sample_every, self.dt)
        if divergence not in ("raise", "mark"):
            raise ValueError(f"divergence = {divergence!r}: wanted 'raise' or 'mark'")
        if divergence == "mark" and self.formulation.name != "total":
            raise ValueError("divergence = 'mark': wanted the total-Lagrangian formulation")
        if record not in ("all", "probes"):
            raise ValueError(f"record = {record!r}: wanted 'all' or 'probes'")
        if record == "probes" and (divergence != "mark" or probes is None or not probes.is_floating_point()):
            raise ValueError("record = 'probes': wanted places as probes, and divergence = 'mark'")
        if getattr(self.formulation, "device", None) is not None and record != "probes":
            raise ValueError("Total(device=...): a device of its own, wanted record = 'probes'")
        check_body(body)
        self.formulation.check_planes(planes)
        if start is None:
            self._check_inside(x)
        dt = self.step(body, prony, duration=duration, sample_every=sample_every, loads=loads)
        steps, every = _steps(duration, sample_every, dt)
        attached = attach(body, loads)
        self.formulation.check_loads(attached)
        body = attached.body

        began, times = self._clock(start, steps, dt, prony)
        times = times.to(x.device)
        maxwell = x.new_zeros(0, 3) if prony is None else prony.discrete(dt).to(x)
        mass = body.mass if weight is None else check_weight(weight, x.shape[-2]).to(x)
        where = x.new_zeros(0, dtype=torch.int64) if probes is None else probes.to(x.device)
        check_probes(where, x.shape[-2])
        constant = attached.forces and all(force.time is None for force in attached.forces)
        lead, whole, wide = assemble(
            attached,
            prony=maxwell,
            pressure=supply_at(body, self.formulation.hollow, pressure, times).to(x),
            gravity=gravity_at(gravity, times[:-1]).to(x),
            planes=planes,
            forces=[(f.value.unsqueeze(-2) if constant else f.at(times[:-1], dt)).to(x) for f in attached.forces],
            weight=mass,
            low=self.low,
            others=[(start.displacement, 2), (start.velocity, 2)] if isinstance(start, Start) else [],
        )
        scene = self._scene(attached, planes, where[:0, 0].long() if where.is_floating_point() else where, dt)
        scene = replace(scene, apart=divergence == "mark", only_markers=record == "probes")
        velocity = torch.zeros_like(x) if body.velocity is None else body.velocity
        x, velocity, weights = wide(x, 2), wide(velocity, 2), wide(mass, 1)
        scene, whole, x, velocity, weights = self.formulation.place(scene, whole, x, velocity, weights)
        if scene.lattice is not None:
            scene, whole = on_nodes(scene, whole, attached, wide)
            if scene.chain_steps and isinstance(start, Trajectory | Tensor):
                raise ValueError("start: a state beside a Chain, whose beads it does not tell, wanted None or a Start")
            refuse_shifted(scene, x, started=isinstance(start, Start))
        if where.is_floating_point():
            if scene.lattice is None:
                raise ValueError("probes: places, wanted particles in the updated formulation")
            scene = replace(scene, markers=Markers.at(scene.lattice, scene.kind, where))
        shape = self.formulation.state_shape(scene, whole)
        if start is None:
            state = self.formulation.initial(scene, whole, x, velocity, moving=body.velocity is not None)
        elif isinstance(start, Start):
            state = self.formulation.started(scene, wide(start.displacement, 2), wide(start.velocity, 2), shape).to(x)
        else:
            found = start.final if isinstance(start, Trajectory) else start
            state = check_start(found, whole, shape, self.formulation.name)
        state = held_still(scene, state, continued=isinstance(start, Trajectory | Tensor))
        if constant:
            firsts = tuple(force.first(dt) for force in attached.forces)
            scene, whole = self._forces(scene, whole, firsts, began, [state, weights])
        samples = sorted({*range(0, steps + 1, every), steps})
        observed, final = self._integrate(scene, whole, state, weights, samples, began, progress)
        shaped = [s.movedim(0, 1).reshape(*lead, *s.shape[:1], *s.shape[2:]) for s in observed]
        named = _named(shaped)
        return Trajectory(
            time=times[torch.tensor(samples)],
            **named,
            probes=where,
            sound=self._sound(named, len(lead)),
            final=final,
            dt=dt,
        )

    def _forces(
        self, scene: Scene, inputs: Inputs, firsts: tuple[int, ...], began: int, others: Sequence[Tensor]
    ) -> tuple[Scene, Inputs]:
        """Forces that are constant from a substep of the run on, with a row for each of this one if they need it."""
        tensors = [*others, *(getattr(inputs, f.name) for f in fields(inputs))]
        gradient = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        if not gradient and scene.lattice is not None:
            return replace(scene, force_start=firsts), inputs
        force, steps = inputs.force, began + torch.arange(len(inputs.gravity), device=inputs.force.device)
        rows = force.expand(len(steps), *force.shape[1:])
        if max(firsts) > began:
            acts = steps[:, None] >= torch.tensor(firsts, device=force.device)
            rows = rows * acts[:, None, :, None].to(force)
        return scene, replace(inputs, force=rows)

    def _sound(self, recorded: dict[str, Tensor], lead: int) -> Tensor:
        """Which simulations [...] recorded finite numbers only, and places inside of the box."""
        found = torch.stack([torch.isfinite(t.detach()).flatten(lead).all(lead) for t in recorded.values()]).all(0)
        for name in ("position", "center_of_gravity"):
            x = recorded[name].detach()
            if not x.shape[-1]:  # not recorded
                continue
            inside = (x > x.new_tensor(self.low)) & (x < x.new_tensor(self.high))
            found &= inside.flatten(lead).all(lead)
        return found

    def _scene(self, attached: Attached, planes: Sequence[Plane], probes: Tensor, dt: float) -> Scene:
        """Constant data of the run, by particle."""
        body = attached.body
        kind = body.chamber.to(device=probes.device, dtype=torch.int32)
        if body.air_share is not None:  # solids, of which a share may be air
            kind = torch.where(kind >= 0, layout.ENCLOSES - kind, kind)
        contact = [plane.integers() for plane in planes]
        return Scene(
            dt=dt,
            cell=self.cell,
            blend=self.formulation.blend,
            low=self.low,
            high=self.high,
            kind=kind,
            share=attached.share,
            plane_kind=kind.new_tensor(contact).reshape(-1, layout.PLANE_INTEGERS),
            springs=attached.spring is not None,
            drags=attached.drag is not None,
            viscous=_present(body, body.viscosity, body.volume_viscosity),
            stiffens=body.stiffening is not None and _present(body, *body.stiffening.unbind(-1)),
            probes=probes,
            self_contact=self.self_contact,
            steady=True,
        )

    def _integrate(
        self,
        scene: Scene,
        whole: Inputs,
        state: Tensor,
        weight: Tensor,
        samples: list[int],
        began: int,
        progress: Callable[[int, int], None] | None,
    ) -> tuple[list[Tensor], Tensor]:
        """Run the segments of the plan one after the other; ``began`` substeps went before."""
        steps = whole.gravity.shape[0]
        # The same tensors in every segment, which then share what follows from them alone.
        whole = Inputs(**{f.name: getattr(whole, f.name).contiguous() for f in fields(whole)})
        weight = weight.contiguous()
        differentiable = torch.is_grad_enabled() and any(
            t.requires_grad for t in (state, weight, *(getattr(whole, f.name) for f in fields(whole)))
        )
        # A chain knows its beads within a segment only.
        whole_run = progress is None or scene.chain_steps > 0
        segment, keep = steps if whole_run else max(64, math.ceil(steps / 100)), False
        if differentiable:
            plan = plan_checkpoints(
                steps=steps,
                state_bytes=state[0].numel() * state.element_size() * max(self.together or 0, len(state)),
                element_bytes=state.element_size(),
                budget=self.memory_budget or MEMORY[state.device.type],
                binding=self.memory_budget is not None,
                node_share=self.formulation.node_share(scene, state),
            )
            segment, keep = (plan.segment, plan.keep) if self.segment is None else (self.segment, False)
        parts: list[tuple[Tensor, ...]] = []
        for first in range(0, steps, segment):
            last = min(first + segment, steps)
            inside = tuple(k - first for k in samples if first < k <= last or k == first == 0)
            cut = replace(
                whole,
                pressure=whole.pressure[first : last + 1],
                gravity=whole.gravity[first:last],
                force=whole.force[first:last] if scene.force_start is None else whole.force,
            )
            state, *seen = rollout(scene, cut, state, weight, first=began + first, samples=inside, keep=keep)
            parts.append(tuple(seen))
            if progress is not None:
                progress(last, steps)
        return [torch.cat(each) for each in zip(*parts, strict=True)], state

    def _clock(
        self, start: Trajectory | Tensor | Start | None, steps: int, dt: float, prony: Prony | None
    ) -> tuple[int, Tensor]:
        """Substeps before the first, and the times at all substeps and after the last [steps + 1] s, float64."""
        count = torch.arange(steps + 1, dtype=torch.float64)
        if not isinstance(start, Trajectory):
            return 0, count * dt
        self.formulation.check_continued(start.dt, dt, prony)
        since = float(start.time[-1])
        began = round(since / dt)
        # A whole number of substeps later, the times are those of one run, bit for bit.
        if abs(since - began * dt) <= 1e-9 * since:
            return began, (began + count) * dt
        return began, since + count * dt

    def _check_inside(self, x: Tensor) -> None:
        low, high = (x.new_tensor(corner) for corner in (self.low, self.high))
        places = x.detach().reshape(-1, 3)
        outside = ((places <= low + self.cell) | (places >= high - self.cell)).any(-1)
        if bool(outside.any()):
            raise ValueError(
                f"body.position: a particle at {tuple(places[outside][0].tolist())} m, wanted inside the analysis box "
                f"from {self.low} to {self.high} m and a cell of {self.cell:g} m away from its faces"
            )

    def step(
        self,
        body: Body,
        prony: Prony | None,
        *,
        duration: float,
        sample_every: float | None = None,
        loads: Sequence[Load] = (),
    ) -> float:
        """The substep [s] of a call.

        Args:
            body: Particles.
            prony: Maxwell elements of the solids.
            duration: [s].
            sample_every: Time between two samples [s].
            loads: Forces, point masses, springs and drag.

        Raises:
            ValueError: if a given step is above the stability limit of the body with its loads; the
                message names the term that sets it.
        """
        if self.dt == "auto":
            limit = self.safety * stable_step(body, prony, cell=self.cell, formulation=self.formulation, loads=loads)
            each = duration / 100 if sample_every is None else sample_every
            _whole("duration", duration, each, "samples")
            return each / math.ceil(each / limit)
        found = courant(body, prony, dt=self.dt, cell=self.cell, formulation=self.formulation, loads=loads)
        most = self.formulation.limit or STABLE_COURANT
        if found.number > most:
            limit = self.dt * most / found.number
            raise ValueError(
                f"dt = {self.dt:g} s: above the limit of about {limit:.3g} s, set by {found.term} "
                f"(Courant number {found.number:.3g} in cells of {self.cell:g} m, wanted at most {most}); "
                'dt = "auto" takes one that is stable'
            )
        return self.dt


def _named(seen: list[Tensor]) -> dict[str, Tensor]:
    names = (
        "position",
        "velocity",
        "deformation",
        "center_of_gravity",
        "center_velocity",
        "chamber_volume",
        "chamber_pressure",
    )
    return dict(zip(names, seen, strict=True))


def _steps(duration: float, sample_every: float | None, dt: float) -> tuple[int, int]:
    """Substeps in all, and between two samples."""
    steps = _whole("duration", duration, dt)
    return steps, max(1, steps // 100) if sample_every is None else _whole("sample_every", sample_every, dt)


def _whole(name: str, value: float, dt: float, parts: str = "substeps") -> int:
    """A time as a number of substeps, or of other parts."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} = {value}: wanted finite and positive")
    steps = round(value / dt)
    if steps < 1 or abs(steps * dt - value) > 1e-6 * value:
        raise ValueError(f"{name} = {value:g} s: wanted a whole number of {parts} of {dt:g} s")
    return steps


def _present(body: Body, *coefficients: Tensor | None) -> bool:
    """Whether any of these coefficients [..., N] of the solid differs from zero or requires a gradient."""
    given = [v for v in coefficients if v is not None]
    return any(v.requires_grad or bool((v[..., ~body.gas] != 0).any()) for v in given)


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
