"""The differentiable operator: a segment of many substeps as one ``torch.autograd.Function``."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.segment import Inputs, March, Scene
from torchsoro.simulation.ops.total import TotalMarch, total_observe

_INPUTS = tuple(f.name for f in fields(Inputs))
_OBSERVED = 6


def initial_state(x: Tensor, v: Tensor, elements: int, affine: Tensor | None = None) -> Tensor:
    """State of undeformed particles without history (a gas keeps J = 1 where a solid keeps F[0, 0] = 1).

    Args:
        x: Positions [B, N, 3] in m.
        v: Velocities [B, N, 3] in m/s.
        elements: Number of Maxwell elements.
        affine: Velocity gradient [B, N, 3, 3] in 1/s; zero if None.

    Returns:
        State [B, S, N], differentiable by x, v and affine.
    """
    batch, count, _ = x.shape
    F = torch.eye(3, dtype=x.dtype, device=x.device).reshape(1, 9, 1).expand(batch, 9, count)
    C = x.new_zeros(batch, 9, count) if affine is None else affine.flatten(-2).transpose(1, 2)
    H = x.new_zeros(batch, 6 * elements, count)
    return torch.cat([x.transpose(1, 2), v.transpose(1, 2), C, F, H], dim=1)


def observe(state: Tensor, weight: Tensor, coefficients: Tensor, pressure: Tensor, scene: Scene) -> tuple[Tensor, ...]:
    """What is recorded of a state; plain torch operations, so that torch differentiates it.

    Args:
        state: [B, S, N], or [B, L] of the total-Lagrangian form.
        weight: Particle weights of the centre of gravity [B, N].
        coefficients: [B, COEFFICIENTS, N].
        pressure: Supply pressure of each chamber now [B, chambers] in Pa.
        scene: For the chambers and the probes.

    Returns:
        Positions and velocities of the probes [B, P, 3] (m, m/s), position and velocity of the centre of gravity
        [B, 3], volume of each chamber [B, chambers] in m3, mean gas pressure in each (Eq. 10) in Pa.
    """
    if scene.lattice is not None:
        return total_observe(state, weight, coefficients, pressure, scene)
    x, v = state[:, : layout.VELOCITY], state[:, layout.VELOCITY : layout.AFFINE]
    share = (weight / weight.sum(-1, keepdim=True)).unsqueeze(1)
    volumes, means = [state.new_zeros(state.shape[0], 0)], [state.new_zeros(state.shape[0], 0)]
    for c in range(pressure.shape[1]):
        gas = (scene.kind == c).nonzero().squeeze(1)
        J = state[:, layout.DEFORMATION, gas]
        parts = coefficients[:, layout.VOLUME, gas] * J
        local = coefficients[:, layout.BULK, gas] * (1 - J) + pressure[:, c : c + 1]
        volumes.append(parts.sum(-1, keepdim=True))
        means.append((parts * local).sum(-1, keepdim=True) / volumes[-1])
    return (
        x[:, :, scene.probes].transpose(1, 2),
        v[:, :, scene.probes].transpose(1, 2),
        (share * x).sum(-1),
        (share * v).sum(-1),
        torch.cat(volumes, -1),
        torch.cat(means, -1),
    )


def _march(scene: Scene, inputs: Inputs, first: int, samples: tuple[int, ...]) -> March | TotalMarch:
    kind = March if scene.lattice is None else TotalMarch
    return kind(scene, inputs, first=first, samples=samples)


class _Rollout(torch.autograd.Function):
    @staticmethod
    def forward(ctx, scene: Scene, first: int, samples: tuple[int, ...], keep: bool, state, weight, *inputs):
        named = Inputs(**dict(zip(_INPUTS, inputs, strict=True)))
        seen: list[tuple[Tensor, ...]] = []
        march = _march(scene, named, first, samples)
        states = march.forward(
            state,
            keep=keep,
            look=lambda k, s: seen.append(observe(s, weight, named.coefficients, named.pressure[k], scene)),
        )
        ctx.scene, ctx.first, ctx.samples = scene, first, samples
        ctx.march, ctx.states = (march, states) if keep else (None, None)
        ctx.save_for_backward(state, weight, *inputs)
        ctx.set_materialize_grads(False)
        end = states[march.steps % states.shape[0]].clone()
        if not seen:
            empty = observe(state, weight, named.coefficients, named.pressure[0], scene)
            return end, *(e.new_zeros(0, *e.shape) for e in empty)
        return end, *(torch.stack(each) for each in zip(*seen, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx, end_bar, *seen_bar):
        state, weight, *inputs = ctx.saved_tensors
        named = Inputs(**dict(zip(_INPUTS, inputs, strict=True)))
        march, states = ctx.march, ctx.states
        if march is None:
            march = _march(ctx.scene, named, ctx.first, ())
            states = march.forward(state, keep=True, look=lambda k, s: None)
            march.samples = ctx.samples
        bar = torch.zeros_like(state) if end_bar is None else end_bar.clone(memory_format=torch.contiguous_format)
        weight_bar, coefficients_bar = torch.zeros_like(weight), torch.zeros_like(named.coefficients)
        pressure_bar = torch.zeros_like(named.pressure)

        def add(k: int, bar: Tensor) -> None:
            wanted = [None if g is None else g[ctx.samples.index(k)] for g in seen_bar]
            leaves = [t.detach().requires_grad_() for t in (states[k], weight, named.coefficients, named.pressure[k])]
            with torch.enable_grad():
                seen = observe(leaves[0], leaves[1], leaves[2], leaves[3], ctx.scene)
            pairs = [(s, g) for s, g in zip(seen, wanted, strict=True) if g is not None and s.requires_grad]
            if pairs:
                outputs, gradients = zip(*pairs, strict=True)
                by_state, by_weight, by_coefficients, by_pressure = torch.autograd.grad(
                    outputs, leaves, gradients, allow_unused=True
                )
                for total, part in (
                    (bar, by_state),
                    (weight_bar, by_weight),
                    (coefficients_bar, by_coefficients),
                    (pressure_bar[k], by_pressure),
                ):
                    if part is not None:
                        total += part

        wanted = frozenset(n for n, needed in zip(_INPUTS, ctx.needs_input_grad[6:], strict=True) if needed)
        sums = march.backward(states, bar, add, wanted=wanted)
        ctx.march, ctx.states = None, None
        sums["coefficients"] += coefficients_bar
        sums["pressure"] += pressure_bar
        return None, None, None, None, bar, weight_bar, *(sums[name] for name in _INPUTS)


def rollout(
    scene: Scene,
    inputs: Inputs,
    state: Tensor,
    weight: Tensor,
    *,
    first: int = 0,
    samples: tuple[int, ...] = (),
    keep: bool = True,
) -> tuple[Tensor, ...]:
    """Advance a state over a segment of T substeps; differentiable by state, weight and every tensor of ``inputs``.

    Args:
        scene: What stays the same: grid, particle kinds, planes, probes.
        inputs: Coefficients and what acts over time.
        state: [B, S, N], see :func:`initial_state`; or [B, L], see ``total.total_state``, if the scene has a lattice,
            whose points then stand for the particles everywhere.
        weight: Particle weights of the centre of gravity [B, N].
        first: Number of the segment's first substep in the whole run, for messages.
        samples: Substeps to observe, increasing, from 0 (before the first) to T.
        keep: Keep all states for the gradient; otherwise backward computes the segment once more.

    Returns:
        The last state, and the outcomes of :func:`observe` stacked over the samples.

    Raises:
        ValueError: for a wrong shape, dtype, device or layout of any tensor.
        SimulationDiverged: if a particle leaves the analysis box, collapses or is no longer finite.
    """
    tensors = {name: getattr(inputs, name) for name in _INPUTS}
    batch, _, count = inputs.coefficients.shape
    elements, steps = inputs.prony.shape[1], inputs.gravity.shape[0]
    chambers, groups, planes = inputs.pressure.shape[-1], scene.share.shape[0], scene.plane_kind.shape[0]
    lattice = scene.lattice
    whole = (batch, layout.state_components(elements), count)
    if lattice is not None:
        whole = (batch, layout.lattice_components(lattice.nodes, count, elements))
    shapes = {
        "state": (state, whole),
        "weight": (weight, (batch, count)),
        "coefficients": (inputs.coefficients, (batch, layout.COEFFICIENTS, count)),
        "prony": (inputs.prony, (batch, elements, layout.PRONY)),
        "pressure": (inputs.pressure, (steps + 1, batch, chambers)),
        "gravity": (inputs.gravity, (steps, batch, 3)),
        "force": (inputs.force, (steps, batch, groups, 3)),
        "planes": (inputs.planes, (batch, planes, layout.PLANE)),
        "origin": (inputs.origin, (batch, 3)),
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name}: shape {tuple(tensor.shape)}, wanted {shape}")
        if tensor.dtype != state.dtype or tensor.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name}: dtype {tensor.dtype}, wanted {state.dtype} (float32 or float64)")
        if tensor.device != state.device:
            raise ValueError(f"{name}: on {tensor.device}, wanted {state.device}, where the state is")
    if int(scene.kind.max()) >= chambers:
        raise ValueError(f"kind: chamber {int(scene.kind.max())}, wanted less than the {chambers} of pressure")
    if list(samples) != sorted(set(samples)) or (samples and not 0 <= samples[0] <= samples[-1] <= steps):
        raise ValueError(f"samples = {samples}: wanted increasing substeps from 0 to {steps}")
    values = [tensors[name].contiguous() for name in _INPUTS]
    return _Rollout.apply(scene, first, samples, keep, state.contiguous(), weight.contiguous(), *values)
