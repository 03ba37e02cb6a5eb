"""The highest frequency of a grid, which sets the largest stable time step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy.sparse.linalg
import torch
from torch import Tensor

from torchsoro.sim2real.twin.grid import Grid

_scipy: Any = scipy.sparse.linalg  # whose arguments are not as it states them

EXACT = 1e-2  # relative error of an eigenvalue, at most


@dataclass(frozen=True, eq=False)
class Frequency:
    """Eigenvalues of the stiffness of a linear elastic solid over the mass of its nodes, of a density of 1 kg/m3.

    Attributes:
        grid: Of the body.
    """

    grid: Grid

    def square(self, ratio: np.ndarray) -> np.ndarray:
        """Highest squared angular frequency [...] 1/m2 for a bulk modulus of 1 Pa, never less than it is.

        The largest eigenvalue is convex in the shear modulus, so that chords between two moduli bound it from above.

        Args:
            ratio: Shear over bulk modulus [...].
        """
        power = np.floor(np.log2(ratio)).astype(int)
        low, high = (np.vectorize(self._of_power, otypes=[float])(power + k) for k in range(2))
        return low + (ratio / 2.0**power - 1) * (high - low)

    @cached_property
    def _of_power(self) -> Callable[[int], float]:
        """The same for a shear modulus that is a power of two, found once."""
        return cache(lambda power: self._largest(2.0**power))

    @cached_property
    def _volumes(self) -> Tensor:
        """Of the points [points] m3, zero where the body has none."""
        lattice = self.grid.lattice
        return lattice.spread(torch.from_numpy(self.grid.volumes[self.grid.solid]))

    @cached_property
    def _roots(self) -> Tensor:
        """One over the square root of the mass of the nodes [nodes] kg^-1/2, zero where there is none."""
        mass = self.grid.lattice.nodal_mass(self._volumes.unsqueeze(0))[0]
        return torch.where(mass > 0, mass, torch.inf) ** -0.5

    def _largest(self, shear: float) -> float:
        """The largest eigenvalue for a bulk modulus of 1 Pa."""
        lattice, roots = self.grid.lattice, self._roots
        size = 3 * lattice.nodes

        def act(way: np.ndarray) -> np.ndarray:
            d = torch.from_numpy(np.ascontiguousarray(way)).view(3, -1) * roots
            G = torch.stack([lattice.to_points(d, along=(axis, "slope")) for axis in range(3)], 1)
            trace = G.diagonal().sum(-1)
            stress = shear * (G + G.transpose(0, 1))
            for axis in range(3):
                stress[axis, axis] += (1 - 2 * shear / 3) * trace
            stress *= self._volumes
            f = sum(lattice.to_nodes(stress[:, axis], along=(axis, "slope")) for axis in range(3))
            return (f * roots).reshape(-1).numpy()

        # Begun with what alternates along all axes, as the fastest motion does.
        begin = np.cos(math.pi * np.arange(size) * math.sqrt(3))
        operator = _scipy.LinearOperator((size, size), matvec=act, dtype=np.float64)
        return float(_scipy.eigsh(operator, k=1, which="LA", v0=begin, tol=EXACT, return_eigenvectors=False)[0])
