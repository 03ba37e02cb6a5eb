"""Lumped masses of nodes with the moments of inertia of the body.

A lumped mass m_i = int N_i dm keeps a body's mass and centre, but not its moments of inertia: where values at the nodes
of a linear field are its coefficients, sum_i N_i x_i^2 = x^2 + dx^2 / 4 for quadratic B-splines, so that the lattice
resists a rotation as if each axis had M dx^2 / 4 more. With n cells across, that is 3 / n^2 of what it should be.

Here nodes hand mass on to each other, such that the mass and all first moments stay, and second moments lose what is
too much. Of all such changes c_i it is the one with the least sum of (c_i / m_i)^2, which leaves light nodes almost
alone, as they set the stable step: c_i = m_i^2 q(x_i), with a polynomial q of second degree.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsoro.simulation.sums import one_by_one, pairwise_sum

# Largest share of its mass that a node may lose, as a norm over all nodes: the largest itself has no slope where a
# symmetric body has several. Cubes of three cells ask for 0.59; beyond the first number the change fades, and is none
# from the second: cubes of two cells get a quarter of it, of one cell almost nothing.
_MOST, _NONE = 0.65, 1.1
_NORM = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Matching:
    """Masses of nodes whose second moments are those of the body, and what their adjoint needs.

    Attributes:
        mass: As lumped [B, n] kg, float64.
        terms: Of the polynomial at the nodes [n, 10].
        excess: What each kilogram at a node adds too much to the second moments, in the units of ``terms`` [n, 3].
        normal: Sums of m^2 over products of terms [B, 10, 10].
        q: The polynomial at the nodes [B, n].
        loss: Share that each node would lose [B, n], and their norm [B, 1].
        strength: Share of the change that is made [B, 1].
    """

    mass: Tensor
    terms: Tensor
    excess: Tensor
    normal: Tensor
    q: Tensor
    loss: tuple[Tensor, Tensor]
    strength: Tensor

    @classmethod
    def of(cls, mass: Tensor, places: Tensor, spread: Tensor) -> Matching:
        """Find the change.

        Args:
            mass: Lumped [B, n] kg.
            places: Of the nodes in the undeformed body [n, 3] m.
            spread: What sum_i N_i x_i^2 has more than x^2, by node and axis [n, 3] m2: the square of half the distance
                between a node's two inner knots, dx^2 / 4 in a uniform lattice.
        """
        m = mass.detach().double()
        x = places.to(m)
        half = (x.amax(0) - x.amin(0)) / 2
        x, y, z = ((x - x.amin(0)) / half - 1).unbind(1)
        terms = torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], 1)
        normal = one_by_one(lambda body: (body.square() * terms.T) @ terms, m)
        safe = normal + 1e-13 * torch.diag_embed(normal.diagonal(dim1=1, dim2=2))
        excess = spread.to(m) / half.square()
        wanted = torch.nn.functional.pad(-one_by_one(lambda body: body @ excess, m), (4, 3))
        weights = _solve(safe, wanted)
        weights = weights + _solve(safe, wanted - pairwise_sum(normal * weights.unsqueeze(1)))
        q = _combined(weights, terms)
        loss = (-m * q).relu()
        largest = loss.amax(1, keepdim=True)
        norm = largest * pairwise_sum((loss / largest).pow(_NORM)).unsqueeze(1).pow(1 / _NORM)
        strength = ((_NONE - norm) / (_NONE - _MOST)).clamp(0, 1)
        return cls(mass=m, terms=terms, excess=excess, normal=safe, q=q, loss=(loss, norm), strength=strength)

    @property
    def matched(self) -> Tensor:
        """The masses [B, n] kg."""
        return self.mass * (1 + self.strength * self.mass * self.q)

    def adjoint(self, bar: Tensor) -> Tensor:
        """Gradient by the lumped masses, from that by the matched ones [B, n]."""
        m, q, (loss, norm) = self.mass, self.q, self.loss
        bar = bar.to(m)
        change = self.strength * bar
        fades = (norm > _MOST) & (norm < _NONE)
        strength_bar = pairwise_sum(bar * m.square() * q).unsqueeze(1)
        # By the share that each node gains.
        by_norm = torch.where(fades, strength_bar / (_NONE - _MOST), torch.zeros_like(norm))
        by_gain = by_norm * (loss / norm).pow(_NORM - 1)
        pulled = one_by_one(lambda body: body @ self.terms, m.square() * change + m * by_gain)
        by_wanted = _solve(self.normal, pulled)
        by_square = -_combined(by_wanted, self.terms) * q
        return bar + 2 * m * (q * change + by_square) + q * by_gain - _combined(by_wanted[:, 4:7], self.excess)


def _combined(weights: Tensor, columns: Tensor) -> Tensor:
    """Sum of columns [n, K] with weights of each body [B, K], term by term [B, n]."""
    parts = (w.unsqueeze(1) * column for w, column in zip(weights.unbind(1), columns.unbind(1), strict=True))
    return functools.reduce(operator.add, parts)


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution [B, K] of positive definite systems [B, K, K] by Gauss and Jordan, of all bodies at once.

    Element by element: solvers for batches choose their order by their size, and wait for the device.
    """
    wide = torch.cat([matrix, right.unsqueeze(2)], 2)
    for k in range(wide.shape[1]):
        pivot = wide[:, k] / wide[:, k, k, None]
        wide = wide - wide[:, :, k, None] * pivot.unsqueeze(1)
        wide[:, k] = pivot
    return wide[..., -1]
