"""Contact of a body with itself in the total-Lagrangian form: points of its surface, their stiffness, pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsoro.simulation.kernels import layout
from torchsoro.simulation.kernels.pairs import find_pairs, sort_points
from torchsoro.simulation.ops.axis_sums import PARTICLES
from torchsoro.simulation.ops.scene import Scene

# In spacings of the particles. Parts that just touch have their outermost particles one spacing apart, where a pressure
# of a third of Young's modulus acts (``laws.repulsion``). It begins at REACH, so that particles of one surface do not
# slip between those of another, whose squares have diagonals of 1.41. Nearer than APART in the undeformed body,
# particles belong to one part, as in ``simulation.selfcontact``: compressed to half they do not meet.
REACH, APART = 1.5, 3.0
# Pairs are listed up to so many spacings beyond the reach, and again as soon as a node has gone half of that. The time
# for listing goes with (REACH + SKIN)^3 / SKIN, which is least at 0.75, and not a tenth more from 0.5 to 1.1.
SKIN = 0.5
# Weight below which the way of a node counts in proportion to its largest weight in any point: nodes that carry a
# corner of the matter (3e-5 to 6e-3) swing by a spacing at a hundred times the speed of the body, and hardly move a
# point. All may go less far for it, by what is found point by point: two thirds of SKIN / 2 in the archived walker.
LIGHT = 0.05
_ROUNDING = 0.99  # of the way that nodes may go, so that no pair is missed by a rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Points of the body's surface, walls of slots and chambers included.

    Attributes:
        points: int64 [P], of the lattice.
        nodes: int64 [P, 27], that move each.
        weights: [P, 27] of these, float64.
        places: [P, 3] m in the undeformed body, float64.
    """

    points: Tensor
    nodes: Tensor
    weights: Tensor
    places: Tensor

    @classmethod
    def of(cls, scene: Scene, coefficients: Tensor) -> Surface:
        """The points of a batch: matter, all but what lies in the middle of 27 points that are solid everywhere.

        Matter is what follows the solid's law at least in part (``VOID_FRACTION`` below 1), in any simulation.
        """
        lattice = scene.lattice
        assert lattice is not None
        void_fraction = coefficients[:, layout.VOID_FRACTION].detach()
        solid = (scene.kind == -1) | (scene.kind <= layout.ENCLOSES)
        matter = solid & (void_fraction < 1).any(0)
        whole = (solid & (void_fraction == 0).all(0)).view(1, 1, *lattice.points)
        partly = torch.nn.functional.pad((~whole).to(torch.float32), (1,) * 6, value=1.0)
        buried = torch.nn.functional.max_pool3d(partly, 3, stride=1).reshape(-1) == 0
        points = (matter & ~buried).nonzero().squeeze(1).cpu()
        nodes, weights, _ = lattice.stencil(points, place=PARTICLES)
        return cls(points=points, nodes=nodes, weights=weights, places=lattice.places[points])

    def stiffness(self, coefficients: Tensor, spacing: float) -> Tensor:
        """Of each point [B, P] N/m: Young's modulus times spacing, times the share that follows the solid's law."""
        bulk, shear, solid = self._moduli(coefficients)
        return spacing * solid * 9 * bulk * shear / _positive(3 * bulk + shear)

    def stiffness_adjoint(self, coefficients: Tensor, spacing: float, bar: Tensor) -> Tensor:
        """Gradient by the coefficients, from that by :meth:`stiffness`."""
        bulk, shear, solid = self._moduli(coefficients)
        whole = _positive(3 * bulk + shear)
        found = torch.zeros_like(coefficients)
        at = self.points.to(coefficients.device)
        found[:, layout.BULK, at] = spacing * solid * 9 * (shear / whole) ** 2 * bar
        found[:, layout.SHEAR, at] = spacing * solid * 27 * (bulk / whole) ** 2 * bar
        found[:, layout.VOID_FRACTION, at] = -spacing * 9 * bulk * shear / whole * bar
        return found

    def watched(self, spacing: float) -> tuple[np.ndarray, float]:
        """By what share the way of each node counts for listing pairs anew, and the way that calls for it [m]."""
        node, weight = self.nodes.numpy(), self.weights.numpy()
        most = np.zeros(int(node.max(initial=-1)) + 1)
        np.maximum.at(most, node, weight)
        shares = most / np.maximum(most, LIGHT)
        reserve = (weight / shares[node]).sum(1).max(initial=1.0)
        return shares, _ROUNDING * SKIN / 2 / float(reserve) * spacing

    def pairs(self, places: np.ndarray, solid: np.ndarray, spacing: float) -> np.ndarray:
        """Which points are near each other in one simulation though they were apart in the undeformed body.

        Args:
            places: Of the points [P, 3] m.
            solid: Which are not void, bool [P].
            spacing: Of the particles [m].

        Returns:
            int64 [pairs], first point times P plus second point; in any order, some perhaps twice.
        """
        count, width = len(solid), (REACH + SKIN) * spacing
        size = 2 ** math.ceil(math.log2(2 * count))
        begin, order, of = (np.empty(n, np.int64) for n in (size + 1, count, count))
        here, keys = np.empty(3 * count, places.dtype), np.empty(count, np.int64)
        sort_points(places.reshape(-1), solid, width, begin, order, of, here)
        flat, apart = self.places.numpy().reshape(-1), (APART * spacing) ** 2
        while (found := find_pairs(flat, width, apart, begin, order, here, keys)) > len(keys):
            keys = np.empty(found, np.int64)
        return keys[:found]

    def _moduli(self, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows = coefficients.detach()[:, :, self.points.to(coefficients.device)]
        return rows[:, layout.BULK], rows[:, layout.SHEAR], 1 - rows[:, layout.VOID_FRACTION]


def _positive(x: Tensor) -> Tensor:
    """Where it is zero, one: of a point without moduli."""
    return torch.where(x > 0, x, torch.ones_like(x))
