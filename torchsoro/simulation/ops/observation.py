"""Observations of a state of either form, and their adjoints, written out since operators run below autograd.

The observations are seven tensors: positions and velocities of the probes [B, P, 3] (m, m/s), deformation gradients
there [B, P, 3, 3] if the probes are markers (else of none), position and velocity of the centre of gravity [B, 3],
volume of each chamber [B, chambers] in m3, mean gas pressure in each (Eq. 10) in Pa. An adjoint takes the gradients by
them and returns those by the arguments; in place of that by the weights what it follows from linearly, so that samples
are added up before :func:`weight_adjoint` is called once.

In the total-Lagrangian form states and pressures may be those of several samples, with one more leading axis, which the
observations then have, too. Where only markers are observed, the state is the motion of the nodes near them, and what
is not observed has no numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.ops.axis_sums import PARTICLES, QUADRATURE
from torchsoro.simulation.ops.chambers import chamber_air, chamber_air_adjoint
from torchsoro.simulation.ops.inertia import Matching
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.markers import Markers
from torchsoro.simulation.ops.once import once
from torchsoro.simulation.ops.scene import Scene
from torchsoro.simulation.sums import pairwise_sum

Arguments = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""State [B, S, N], or [B, L] of the total-Lagrangian form; particle weights of the centre of gravity [B, N];
coefficients [B, COEFFICIENTS, N]; supply pressure of each chamber now [B, chambers] in Pa; ``Inputs.air``."""


def observe(arguments: Arguments, scene: Scene) -> tuple[Tensor, ...]:
    """The observations."""
    form = _observe if scene.lattice is None else _total_observe
    return form(*arguments, scene)


def observe_adjoint(
    arguments: Arguments, bars: Sequence[Tensor], scene: Scene, *, chambers: bool
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Gradients by all arguments of :func:`observe` but the weights, and of these what :func:`weight_adjoint` takes.

    Without ``chambers`` nothing depends on what is observed of these.
    """
    form = _observe_adjoint if scene.lattice is None else _total_observe_adjoint
    return form(*arguments, bars, scene, chambers)


def weight_adjoint(weight: Tensor, sums: Sequence[Tensor], scene: Scene) -> Tensor:
    """Gradient by the weights [B, N], from what :func:`observe_adjoint` gives for it, added up over samples."""
    share, lattice = _shares(weight), scene.lattice
    if lattice is None:
        (share_bar,) = sums
    else:
        nodal_bar, center_bar = sums
        masses, _, _ = once(scene, "center", [weight], lambda: _center(lattice, share))
        places = lattice.on("places", weight).T
        share_bar = lattice.nodal_mass_adjoint(masses, nodal_bar) + pairwise_sum((center_bar.unsqueeze(-1) * places).mT)
    return (share_bar - _whole(share * share_bar)) / _whole(weight)


def _observe(state: Tensor, weight: Tensor, coefficients: Tensor, pressure: Tensor, air: Tensor, scene: Scene):
    x, v = state[:, : layout.VELOCITY], state[:, layout.VELOCITY : layout.AFFINE]
    share = _shares(weight).unsqueeze(1)
    volumes, means = [state.new_zeros(state.shape[0], 0)], [state.new_zeros(state.shape[0], 0)]
    for c in range(pressure.shape[1]):
        gas = scene.gas(c)
        J = state[:, layout.DEFORMATION, gas]
        parts = coefficients[:, layout.VOLUME, gas] * J
        local = coefficients[:, layout.BULK, gas] * (1 - J) + pressure[:, c : c + 1]
        volumes.append(_whole(parts))
        means.append(_whole(parts * local) / volumes[-1])
    return (
        x[:, :, scene.probes].transpose(1, 2),
        v[:, :, scene.probes].transpose(1, 2),
        x.new_zeros(len(x), 0, 3, 3),
        pairwise_sum(share * x),
        pairwise_sum(share * v),
        torch.cat(volumes, -1),
        torch.cat(means, -1),
    )


def _observe_adjoint(state, weight, coefficients, pressure, air, bars: Sequence[Tensor], scene: Scene, chambers: bool):
    x_bar, v_bar, _, center_bar, drift_bar, volume_bar, mean_bar = bars
    found = torch.zeros_like(state), *_zeros(coefficients, pressure)
    state_bar, coefficients_bar, pressure_bar = found
    share = _shares(weight)
    share_bar = torch.zeros_like(weight)
    for first, at_probes, at_center in ((0, x_bar, center_bar), (layout.VELOCITY, v_bar, drift_bar)):
        rows = slice(first, first + 3)
        state_bar[:, rows] += share.unsqueeze(1) * at_center.unsqueeze(-1)
        share_bar += (state[:, rows] * at_center.unsqueeze(-1)).sum(1)
        _add_at(state_bar[:, rows], scene.probes, at_probes.transpose(1, 2))
    for c in range(pressure.shape[1] if chambers else 0):
        gas = scene.gas(c)
        J, V, K = state[:, layout.DEFORMATION, gas], *coefficients[:, (layout.VOLUME, layout.BULK)][..., gas].unbind(1)
        parts, local = V * J, K * (1 - J) + pressure[:, c : c + 1]
        whole = _whole(parts)
        mean = _whole(parts * local) / whole
        by_mean = mean_bar[:, c : c + 1]
        parts_bar = volume_bar[:, c : c + 1] + by_mean * (local - mean) / whole
        local_bar = by_mean * parts / whole
        state_bar[:, layout.DEFORMATION, gas] += parts_bar * V - local_bar * K
        coefficients_bar[:, layout.VOLUME, gas] += parts_bar * J
        coefficients_bar[:, layout.BULK, gas] += local_bar * (1 - J)
        pressure_bar[:, c] += pairwise_sum(local_bar)
    return (state_bar, coefficients_bar, pressure_bar, torch.zeros_like(air)), (share_bar,)


def _total_observe(state: Tensor, weight: Tensor, coefficients: Tensor, pressure: Tensor, air: Tensor, scene: Scene):
    lattice = scene.lattice
    assert lattice is not None
    if scene.only_markers:
        assert scene.markers is not None
        none = state.new_zeros(*state.shape[:-1], 0)
        return *_at_markers(scene.markers, state.unflatten(-1, (6, -1))), none, none, none, none
    d, v = _motion(state, lattice.nodes)
    motion = state[..., : 6 * lattice.nodes].unflatten(-1, (6, lattice.nodes))
    if scene.markers is not None:
        place, drift, gradient = _at_markers(scene.markers, motion[..., scene.markers.near])
    else:
        at, how, _ = _stencil(scene, "probes", lambda: scene.probes, PARTICLES, state)
        place = lattice.on("places", state)[scene.probes] + (d[..., at] * how).sum(-1).transpose(-1, -2)
        drift = (v[..., at] * how).sum(-1).transpose(-1, -2)
        gradient = state.new_zeros(*state.shape[:-1], 0, 3, 3)
    share = _shares(weight)
    # Weighted by the nodes' masses, so that momentum balances the impulse of the forces.
    _, nodal, center = once(scene, "center", [weight], lambda: _center(lattice, share))
    whole = pairwise_sum(motion * nodal.unsqueeze(1))
    volumes, means = [pressure[..., :0]], [pressure[..., :0]]
    for c in range(scene.gas_chambers):
        *_, F = _chamber(d, c, scene)
        J, (V, K) = torch.linalg.det(F), chamber_air(scene, coefficients, c)
        full = pairwise_sum(V)
        k = pairwise_sum(V * K) / full
        volumes.append(_whole(V * J))
        means.append((pressure[..., c] - k * (volumes[-1][..., 0] / full - 1)).unsqueeze(-1))
    if lattice.walls is not None:
        volumes.append(lattice.walls.enclosed(d))
        growth = volumes[-1] / lattice.walls.volume.to(d) - 1
        means.append(pressure[..., scene.gas_chambers :] - air * growth)
    return (
        place,
        drift,
        gradient,
        center + whole[..., :3],
        whole[..., 3:],
        torch.cat(volumes, -1),
        torch.cat(means, -1),
    )


def _at_markers(markers: Markers, near: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Places, velocities and deformation gradients of markers, from the motion of the nodes near them [..., 6, U]."""
    moved, drift, gradient = markers.observe(near)
    return markers.places.to(moved.device) + moved, drift, gradient + torch.eye(3).to(near)


def _center(lattice: Lattice, share: Tensor) -> tuple[Matching, Tensor, Tensor]:
    """What nodes add to the centre of gravity, as it is found and [B, nodes], and its place in the undeformed body."""
    masses = lattice.matching(share)
    return masses, masses.matched.to(share), pairwise_sum(share.unsqueeze(1) * lattice.on("places", share).T)


def _total_observe_adjoint(
    state, weight, coefficients, pressure, air, bars: Sequence[Tensor], scene: Scene, chambers: bool
):
    lattice = scene.lattice
    assert lattice is not None
    x_bar, v_bar, gradient_bar, center_bar, drift_bar, volume_bar, mean_bar = bars
    state_bar, coefficients_bar, pressure_bar = torch.zeros_like(state), *_zeros(coefficients, pressure)
    motion, motion_bar = _motion(state, lattice.nodes), _motion(state_bar, lattice.nodes)
    at, how, _ = _stencil(scene, "probes", lambda: scene.probes, PARTICLES, state)
    if (m := scene.markers) is not None:
        at, how = m.nodes, m.weights.to(state)
    share = _shares(weight)
    _, nodal, _ = once(scene, "center", [weight], lambda: _center(lattice, share))
    nodal_bar = torch.zeros_like(nodal)
    for field, field_bar, at_probes, at_center in zip(
        motion, motion_bar, (x_bar, v_bar), (center_bar, drift_bar), strict=True
    ):
        field_bar += nodal.unsqueeze(1) * at_center.unsqueeze(-1)
        nodal_bar += (field * at_center.unsqueeze(-1)).sum(1)
        _add_at(field_bar, at, at_probes.to(how).transpose(1, 2).unsqueeze(-1) * how)
    if m is not None:
        _add_at(motion_bar[0], at, torch.einsum("bpca,pan->bcpn", gradient_bar, m.slopes.to(state)))
    for c in range(scene.gas_chambers if chambers else 0):
        at, slopes, F = _chamber(motion[0], c, scene)
        V, K = chamber_air(scene, coefficients, c)
        whole = _whole(V)
        a, b, e = F.unbind(-2)
        cofactor = torch.stack([torch.linalg.cross(b, e), torch.linalg.cross(e, a), torch.linalg.cross(a, b)], -2)
        J = (a * cofactor[..., 0, :]).sum(-1)
        k, growth = _whole(V * K) / whole, _whole(V * J) / whole - 1
        by_mean = mean_bar[:, c : c + 1]
        swept_bar, k_bar = volume_bar[:, c : c + 1] - by_mean * k / whole, -by_mean * growth
        V_bar = swept_bar * J + (k_bar * (K - k) + by_mean * k * (growth + 1)) / whole
        chamber_air_adjoint(scene, coefficients, c, V_bar, k_bar * V / whole, coefficients_bar)
        pressure_bar[:, c] += by_mean[:, 0]
        by_nodes = torch.einsum("bpca,pan->bcpn", (swept_bar * V)[..., None, None] * cofactor, slopes)
        _add_at(motion_bar[0], at, by_nodes)
    air_bar = torch.zeros_like(air)
    if lattice.walls is not None and chambers:
        by_mean, whole = mean_bar[:, scene.gas_chambers :], lattice.walls.volume.to(state)
        pressure_bar[:, scene.gas_chambers :] += by_mean
        air_bar -= by_mean * (lattice.walls.enclosed(motion[0]) / whole - 1)
        swept_bar = volume_bar[:, scene.gas_chambers :] - by_mean * air / whole
        _add_at(motion_bar[0], lattice.walls.nodes, lattice.walls.enclosed_adjoint(motion[0], swept_bar))
    return (state_bar, coefficients_bar, pressure_bar, air_bar), (nodal_bar, center_bar)


def _zeros(*tensors: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.zeros_like(t) for t in tensors)


def _whole(values: Tensor) -> Tensor:
    """Sum over the last axis, which stays."""
    return pairwise_sum(values).unsqueeze(-1)


def _shares(weight: Tensor) -> Tensor:
    return weight / _whole(weight)


def _add_at(target: Tensor, at: Tensor, values: Tensor) -> None:
    """Add values [B, 3, *at] to a target [B, 3, n]; an order of the sums that CUDA keeps, unlike ``index_add_``."""
    moved = values.flatten(2).permute(2, 0, 1)
    target.permute(2, 0, 1).index_put_((at.flatten(),), moved, accumulate=True)


def _motion(state: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """Displacements and velocities of the nodes [B, 3, nodes] m, m/s, as parts of a state."""
    d, v = state[..., : 6 * nodes].unflatten(-1, (2, 3, nodes)).unbind(-3)
    return d, v


def _chamber(d: Tensor, c: int, scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Nodes of the points of a chamber, slopes there, and deformation gradients [B, points, 3, 3]."""
    gas = scene.gas(c)
    at, _, slopes = _stencil(scene, f"chamber {c}", lambda: gas, QUADRATURE, d)
    F = torch.einsum("...cpn,pan->...pca", d[..., at], slopes) + torch.eye(3).to(d)
    return at, slopes, F


# Stencils of the probes and chambers, computed once per scene.
_stencils: WeakKeyDictionary[Scene, dict[str, tuple[Tensor, ...]]] = WeakKeyDictionary()


def _stencil(scene: Scene, name: str, points: Callable[[], Tensor], place: float, like: Tensor) -> tuple[Tensor, ...]:
    """``Lattice.stencil``, computed once per scene."""
    assert scene.lattice is not None
    known = _stencils.setdefault(scene, {})
    if name not in known:
        at, weights, slopes = scene.lattice.stencil(points(), place=place)
        known[name] = at.to(like.device), weights.to(like), slopes.to(like)
    return known[name]
