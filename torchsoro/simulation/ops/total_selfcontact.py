"""Contact of a body with itself where Taichi simulates: what its kernels take, and their launches."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import total_selfcontact as kernels
from torchsoro.simulation.ops.launch import capture
from torchsoro.simulation.ops.scene import Scene
from torchsoro.simulation.ops.selfcontact import REACH, Surface


class TotalSelfContact:
    """Of one segment and direction; pairs are listed on the host, as soon as a node has gone too far.

    Args:
        scene: Constant data.
        coefficients: [B, COEFFICIENTS, points].
        states: Of the segment [ring, B, L].
        scratch: Buffer of that name.
        offset: Where the vectors of the nodes begin there.
        back: Buffer whose name is "backward", of the adjoint; None forward.
    """

    def __init__(
        self, scene: Scene, coefficients: Tensor, states: Tensor, scratch: Tensor, offset: int, back: Tensor | None
    ) -> None:
        assert scene.lattice is not None
        self.spacing, self.states, self.coefficients = scene.cell / 2, states, coefficients
        surface = self.surface = Surface.of(scene, coefficients)
        batch, nodes, length = states.shape[1], scene.lattice.nodes, states.shape[2]
        points, node = len(surface.points), surface.nodes.reshape(-1)
        shares, way = surface.watched(self.spacing)
        watched = torch.zeros(nodes, dtype=torch.float64)
        watched[: len(shares)] = torch.from_numpy(shares)
        bounds = torch.tensor([(REACH * self.spacing) ** 2, way**2], dtype=torch.float64)
        self.sizes = batch, nodes, length, points
        where = node.argsort(stable=True)
        begin = torch.searchsorted(node[where].contiguous(), torch.arange(nodes + 1))

        def integers(t: Tensor) -> Tensor:
            return t.to(device=states.device, dtype=torch.int32).contiguous()

        self.tables = [integers(t) for t in (node, begin, where)]
        stiffness = surface.stiffness(coefficients, self.spacing)
        flat = (surface.weights, surface.places, bounds, stiffness)
        self.numbers = [t.reshape(-1).to(states) for t in flat]
        self.solid = (stiffness > 0).cpu().numpy()
        self.first = integers(torch.zeros(batch * points + 1))
        self.watched, self.listed = watched.to(states), states.new_zeros(batch * 3 * nodes)
        self.places, self.pushes, self.pulled = (states.new_zeros(3 * batch * points + 3) for _ in range(3))
        self.stiffness_bar = states.new_zeros(batch * points)
        self.strayed = integers(torch.zeros(1))
        self.scratch, self.offset, self.back = scratch, offset, back
        self.pairs, self.capacity, self.known = 0, 0, False
        self._check = capture(
            *(kernels.stray, 0, batch, nodes, length, self.strayed),
            *(self.numbers[2], self.watched, self.listed, self.states.view(-1)),
        )

    def act(self, t: int) -> None:
        """Forces at the state after t substeps, or gradients by its places, left in ``scratch``."""
        if not self.sizes[3]:
            return
        slot = t % len(self.states)
        if self.known:
            self._check(1, slot)
        if not self.known or int(self.strayed):  # for which the host waits
            self._list(self.states[slot])
        if self.pairs:
            self._launch(1, slot)

    def _list(self, state: Tensor) -> None:
        """List the pairs of a state [B, L]."""
        batch, nodes, _, _ = self.sizes
        d = state[:, : 3 * nodes]
        self.listed.copy_(d.reshape(-1))
        self.strayed.zero_()
        if self.pairs or not self.known:
            self.scratch[self.offset : self.offset + 3 * batch * nodes] = 0
        first, other = self._pairs(d.reshape(batch, 3, nodes).cpu())
        self.pairs, self.known = len(other), True
        self.first.copy_(torch.from_numpy(first))
        if self.pairs > self.capacity:
            self.capacity = 2 * self.pairs
            self.other = torch.zeros(self.capacity, dtype=torch.int32, device=state.device)
            self._launch = self._captured()
        if self.pairs:
            self.other[: self.pairs] = torch.from_numpy(other.astype(np.int32)).to(state.device)

    def _pairs(self, d: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Where the pairs of each point of each body begin, and their other points, each pair from both sides."""
        surface, points = self.surface, self.sizes[3]
        first, others = [np.zeros(1, np.int64)], []
        for b, field in enumerate(d):
            moved = torch.einsum("cpk,pk->pc", field[:, surface.nodes].double(), surface.weights)
            places = (surface.places + moved).numpy()
            keys = np.unique(surface.pairs(places, self.solid[b], self.spacing))
            one, two = np.divmod(keys, points)
            keys = np.sort(np.concatenate([keys, two * points + one]))
            one, two = np.divmod(keys, points)
            first.append(first[-1][-1] + np.searchsorted(one, np.arange(1, points + 1)))
            others.append(two)
        return np.concatenate(first), np.concatenate(others)

    def _captured(self) -> Callable[..., None]:
        batch, nodes, length, points = self.sizes
        kernel = kernels.contact_forces if self.back is None else kernels.contact_adjoint
        more = [] if self.back is None else [self.pulled, self.stiffness_bar, self.back]
        return capture(
            *(kernel, 0, self.offset, batch, nodes, length, points, *self.tables, self.first, self.other),
            *(*self.numbers, self.states.view(-1), self.places, self.pushes, self.scratch, *more),
        )

    def coefficients_bar(self) -> Tensor:
        """Gradient by the coefficients."""
        bar = self.stiffness_bar.view(self.sizes[0], -1)
        return self.surface.stiffness_adjoint(self.coefficients, self.spacing, bar)
