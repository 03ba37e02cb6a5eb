"""The density of a design as far as material connects it with a chamber, as it is printed.

On a lattice, parts less than two cells apart move each other through the nodes that they share, though no material
connects them: a design would walk on loose feet, which nobody can print. So a particle counts with the least density on
that way to a chamber's wall on which this is largest,

    gamma'_i = max over ways from i to a wall of  min over particles j on the way of  gamma_j ,

with ways through the faces of particles: a morphological reconstruction by dilation (Vincent 1993) from the walls.
Where density falls all the way from a chamber, nothing changes. A piece behind a gap counts as much as what fills the
gap, which gives all the piece's gradient to that.

Through an empty gap that gradient is small, so that a gap is better closed before it is one. What gamma' lacks of gamma
has a price from the first iteration on. And a grey design finds its limbs before they are connected: what is simulated
goes over from gamma to gamma' as the projection sharpens.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from torch import Tensor


def connected(gamma: Tensor, wall: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Density of particles as far as they are connected with walls of chambers, with a gradient [N].

    Args:
        gamma: Density of each particle of a lattice [N].
        wall: Which are walls of chambers, bool [N].
        shape: Of the lattice.
    """
    thinnest = bottlenecks(gamma.detach().cpu().double().numpy(), wall.cpu().numpy(), shape)
    # On a CPU, as its sums of gradients always have the same order.
    return gamma.cpu()[torch.from_numpy(thinnest)].to(gamma.device)


def bottlenecks(gamma: np.ndarray, wall: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Number of the particle of least density on each one's best way to a wall, its own where that is the one [N].

    On the spanning tree of the largest densities every way is the best one. Without walls, nothing is connected with
    one, and each counts as it is.

    Args:
        gamma: Density of each particle of a lattice [N].
        wall: Which are walls of chambers [N].
        shape: Of the lattice.
    """
    number = np.arange(len(gamma)).reshape(shape)
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    walls, root = np.flatnonzero(wall), len(gamma)  # all walls hang on a root
    one = np.concatenate([*(a.reshape(-1) for a, _ in pairs), np.full(len(walls), root)])
    other = np.concatenate([*(b.reshape(-1) for _, b in pairs), walls])
    full = np.append(gamma, np.inf)
    cost = 2.0 - np.minimum(full[one], full[other])  # above 0, which would be no edge
    tree = minimum_spanning_tree(coo_array((cost, (one, other)), shape=(root + 1, root + 1)).tocsr())
    order, before = breadth_first_order(tree, root, directed=False)
    found = np.arange(root + 1)
    for i in order[1:]:
        thinnest = found[before[i]]
        if full[thinnest] < full[i]:
            found[i] = thinnest
    return found[:root]
