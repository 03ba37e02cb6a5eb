"""Quadratic B-splines along one axis: cells of any width, open or uniform knots, creases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

GAUSS = 0.5 / math.sqrt(3.0)  # of a cell's two points of quadrature, from its middle, in widths
MARK = 0.25  # likewise of the two particles of a cell, where motion is recorded


class Axis:
    """Quadratic B-splines along an axis: cells between planes, three nodes to a cell.

    The splines of ``Axis(planes)`` end with the body (open knots), and their outermost nodes lie on its faces. Those of
    :meth:`uniform` are all alike, and their outermost nodes lie half a cell in front of the faces.

    Args:
        planes: Of the cells [cells + 1] m, increasing.
        creases: Planes where slopes may jump (double knots), so that two walls do not share a node.

    Attributes:
        planes: As given.
        cells: Number of cells.
        nodes: Number of nodes.
        first: Lowest node of each cell [cells]; it has this and the next two.
        knots: Of the splines [nodes + 3] m.

    Raises:
        ValueError: for planes that do not increase.
    """

    def __init__(self, planes: np.ndarray, creases: Sequence[float] = ()) -> None:
        self.planes = np.asarray(planes, float)
        if self.planes.ndim != 1 or len(self.planes) < 2 or not (np.diff(self.planes) > 0).all():
            raise ValueError(f"planes = {planes}: wanted two coordinates or more, each larger than the one before")
        self.cells = len(planes) - 1
        twice = np.isin(self.planes[1:-1], creases)
        self.nodes = self.cells + 2 + int(twice.sum())
        self.first = np.arange(self.cells) + np.concatenate([[0], np.cumsum(twice)]).astype(int)
        inner = np.repeat(self.planes[1:-1], 1 + twice)
        self.knots = np.concatenate([[self.planes[0]] * 3, inner, [self.planes[-1]] * 3])
        self._low, self._unit, self._planes, self._knots = 0.0, 1.0, self.planes, self.knots

    @classmethod
    def uniform(cls, low: float, cell: float, cells: int) -> Axis:
        """Cells of one width [m] from ``low`` [m] on, with a node half a cell in front of either face.

        Raises:
            ValueError: for a cell that is not positive, or no cells.
        """
        if not (cell > 0 and cells > 0):
            raise ValueError(f"cell = {cell}, cells = {cells}: wanted positive numbers")
        axis = cls(np.arange(cells + 1.0))
        axis._knots = np.arange(cells + 5.0) - 2
        # Weights are found in cells from the lower face, so that they do not depend on where the body is.
        axis._low, axis._unit = low, cell
        axis.planes, axis.knots = low + cell * axis._planes, low + cell * axis._knots
        return axis

    @property
    def places(self) -> np.ndarray:
        """Of the nodes [nodes] m: values there of a linear field are its coefficients."""
        return (self.knots[1:-2] + self.knots[2:-1]) / 2

    @property
    def widths(self) -> np.ndarray:
        """Of the cells [cells] m."""
        return np.diff(self.planes)

    def cell(self, x: np.ndarray) -> np.ndarray:
        """Cell of each coordinate; the nearest if it is outside."""
        return np.clip(np.searchsorted(self.planes, x, side="right") - 1, 0, self.cells - 1)

    def at(self, x: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights [..., 3] of the nodes of a cell, lowest first, and their derivatives [1/m]."""
        return self._splines((x - self._low) / self._unit, cell)

    def _splines(self, x: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k1, k2, k3, k4 = (self._knots[self.first[cell] + i] for i in range(1, 5))
        one, two = (k3 - x) / (k3 - k2), (x - k2) / (k3 - k2)
        first, last = one * (k3 - x) / (k3 - k1), two * (x - k2) / (k4 - k2)
        down, up = -2 * one / (k3 - k1), 2 * two / (k4 - k2)
        slopes = np.stack([down, -down - up, up], -1) / self._unit
        return np.stack([first, 1 - first - last, last], -1), slopes

    def inside(self, place: float) -> np.ndarray:
        """Two coordinates in each cell, ``place`` widths from its middle [cells, 2] m."""
        return _inside(self.planes, place)

    @cached_property
    def points(self) -> np.ndarray:
        """The two points of quadrature of each cell [cells, 2] m."""
        return self.inside(GAUSS)

    @cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights and derivatives at the points of the cells, each [cells, 2, 3]."""
        return self.tabulate(GAUSS)

    def tabulate(self, place: float) -> tuple[np.ndarray, np.ndarray]:
        """Weights and derivatives [1/m] at :meth:`inside` of the cells, each [cells, 2, 3]."""
        return self._splines(_inside(self._planes, place), np.arange(self.cells)[:, None])

    @cached_property
    def steep(self) -> float:
        """The largest sum of N'^2 / N [1/m2] at a point, proportional to the square of the highest frequency."""
        weight, slope = self.table
        return float((slope**2 / weight).sum(-1).max())

    @cached_property
    def centers(self) -> np.ndarray:
        """How far the middle of a node's spline is from the node [nodes] m."""
        k = self.knots
        return (k[:-3] + k[3:] - k[1:-2] - k[2:-1]) / 4

    @cached_property
    def spreads(self) -> np.ndarray:
        """What sum_i N_i x_i^2 has more than x^2, by node [nodes] m2."""
        return ((self.knots[2:-1] - self.knots[1:-2]) / 2) ** 2

    @cached_property
    def lengths(self) -> np.ndarray:
        """Integrals of the splines over the cells [nodes] m: what of the axis is each node's own."""
        weight, _ = self.table
        found = np.zeros(self.nodes)
        np.add.at(found, self.first[:, None] + np.arange(3), weight.sum(1) * self.widths[:, None] / 2)
        return found

    @cached_property
    def spans(self) -> np.ndarray:
        """Mean width of the cells that a node's spline covers [nodes] m."""
        k = self.knots
        covered = sum((k[i + 1 : len(k) - 2 + i] > k[i : len(k) - 3 + i]).astype(int) for i in range(3))
        return (k[3:] - k[:-3]) / covered


def _inside(planes: np.ndarray, place: float) -> np.ndarray:
    middle, width = (planes[1:] + planes[:-1]) / 2, np.diff(planes)
    return middle[:, None] + width[:, None] * np.array([-place, place])
