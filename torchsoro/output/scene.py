"""One view of a deformed body on its ground and between its walls: skinning, shading and sorting by depth.

Lengths are in mm from the lower corner of the body at rest, angles in degrees. The up axis z is always vertical on
the page.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Polygon
from scipy import ndimage, sparse

from torchsoro.output.fabricate import surface
from torchsoro.output.levelset import as_array

if TYPE_CHECKING:
    from torchsoro.design.domain import Domain

PlaneTuple = tuple[int, float, int]
"""Axis (0, 1, 2), position on it [m], and the side on which the robot is (+1 or -1); the ground is (2, 0.0, 1)."""

BODY = np.array([0.64, 0.73, 0.83])
WALL = np.array([0.95, 0.69, 0.38])
BODY_SECTION, WALL_SECTION = 0.8 * BODY, 0.84 * WALL
REST, FULL = "#3a6ea5", "#d1344b"
PRESSURE = LinearSegmentedColormap.from_list("pressure", [REST, "#9a6fa8", FULL])
INK, FAINT = "#27313d", "#8b96a3"
_LIGHT = np.array([-0.45, 0.72, 0.62]) / np.linalg.norm([-0.45, 0.72, 0.62])  # right, up, towards the viewer


class Skin:
    """Carries points along with the particles around them: a moving-least-squares fit, affine, of their displacements.

    Args:
        domain: the lattice.
        points: at rest [V, 3] in m.
        gamma: densities [N], by which the particles count; None lets all of them count the same.
    """

    def __init__(self, domain: Domain, points: np.ndarray, gamma: Any | None) -> None:
        counts = np.asarray(domain.particles)
        trust = np.ones(domain.count)
        if gamma is not None:
            # Void particles may be anywhere. Gas stays beside its wall: it tells how a single layer of wall leans.
            trust = np.maximum(as_array(gamma).astype(float), 1e-3) ** 2
            trust[as_array(domain.wall).astype(bool)] = 1.0
            trust[as_array(domain.gas).astype(bool)] = 0.1
        at = (points - np.asarray(domain.origin)) / float(domain.spacing) - 0.5
        base = np.clip(np.floor(at).astype(int), 0, np.maximum(counts - 2, 0))
        steps = np.array(list(itertools.product((-1, 0, 1, 2), repeat=3)))
        nodes = base[:, None] + steps
        valid = ((nodes >= 0) & (nodes < counts)).all(axis=2)
        nodes = np.clip(nodes, 0, counts - 1)
        index = (nodes[..., 0] * counts[1] + nodes[..., 1]) * counts[2] + nodes[..., 2]
        offset = nodes - at[:, None]
        weight = valid * trust[index] * np.clip(1 - (offset**2).sum(axis=2) / 2.3**2, 0, None) ** 2
        basis = np.concatenate([np.ones((*offset.shape[:2], 1)), offset], axis=2)
        moment = np.einsum("vk,vki,vkj->vij", weight, basis, basis)
        # Where the particles do not tell a slope, as beside a single layer of them, it is zero.
        ridge = 1e-4 if gamma is not None else 1e-9
        moment += ridge * weight.sum(axis=1)[:, None, None] * np.diag([0.0, 1.0, 1.0, 1.0])
        first = np.linalg.solve(moment, np.eye(4)[None, :, :1].repeat(len(moment), axis=0))[..., 0]
        value = weight * np.einsum("vki,vi->vk", basis, first)
        rows = np.repeat(np.arange(len(points)), len(steps))
        self.matrix = sparse.csr_matrix((value.ravel(), (rows, index.ravel())), shape=(len(points), domain.count))
        self.rest = points - self.matrix @ as_array(domain.positions)

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """The points [V, 3] in m when the particles are at ``frame`` [N, 3] in m."""
        return np.asarray(self.matrix @ frame) + self.rest


@dataclass(frozen=True)
class Camera:
    """Where an orthographic camera looks from; all angles in degrees, azimuth and elevation as in Matplotlib."""

    azimuth: float
    elevation: float
    tilt: float = 0.0
    """By which all is turned so that +x leads uphill: a slope whose ground was kept level. An arrow g points down."""

    @property
    def axes(self) -> np.ndarray:
        """Rows: right, up, towards the viewer."""
        a, e, t = math.radians(self.azimuth), math.radians(self.elevation), math.radians(self.tilt)
        view = np.array(
            [
                [-math.sin(a), math.cos(a), 0],
                [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)],
                [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)],
            ]
        )
        return view @ np.array([[math.cos(t), 0, -math.sin(t)], [0, 1, 0], [math.sin(t), 0, math.cos(t)]])


class Shape:
    """The surface at rest and everything needed to draw it in any frame; lengths in mm from the body's lower corner."""

    def __init__(self, domain: Domain, gamma: Any, level: float) -> None:
        rest, self.faces = surface(domain, gamma, level)
        self.origin = np.asarray(domain.origin, dtype=float)
        self.colors = np.where(shows_wall(domain, rest, self.faces)[:, None], WALL, BODY)
        self.skin = Skin(domain, rest, gamma)
        count = len(self.faces)
        self.around = sparse.csr_matrix(
            (np.ones(3 * count), (self.faces.ravel(), np.repeat(np.arange(count), 3))), shape=(len(rest), count)
        )
        boxes = [box_faces(np.asarray(c.center), np.asarray(c.size) - 2 * c.wall) for c in domain.chambers]
        self.cavity = Skin(domain, np.concatenate(boxes).reshape(-1, 3), gamma) if boxes else None

    def place(self, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Vertices [V, 3] and the cavities' quadrilaterals [Q, 4, 3] in a frame [mm]."""
        cavity = None if self.cavity is None else ((self.cavity(frame) - self.origin) * 1e3).reshape(-1, 4, 3)
        return (self.skin(frame) - self.origin) * 1e3, cavity

    def times(self, count: int) -> Shape:
        """So many copies as one shape, for bodies side by side whose vertices and cavities are strung together."""
        many = copy.copy(self)
        many.faces = np.concatenate([self.faces + i * len(self.skin.rest) for i in range(count)])
        many.around = sparse.csr_matrix(sparse.block_diag([self.around] * count))
        many.colors = np.tile(self.colors, (count, 1))
        return many


def shows_wall(domain: Domain, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles [F] of a surface at rest [V, 3] m show chamber wall: the particle just below them is wall."""
    corners = ((vertices - np.asarray(domain.origin)) / float(domain.spacing) - 0.5)[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    below = np.rint(corners.mean(axis=1) - 0.4 * normal).astype(int).clip(0, np.asarray(domain.particles) - 1)
    return as_array(domain.wall).astype(bool).reshape(domain.particles)[tuple(below.T)]


def box_faces(center: np.ndarray, size: np.ndarray, cuts: int = 5) -> np.ndarray:
    """The faces of a box as quadrilaterals [Q, 4, 3], counter-clockwise seen from outside."""
    ticks = np.linspace(-0.5, 0.5, cuts + 1)
    quads = []
    for axis, side in itertools.product(range(3), (-1, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for i, j in itertools.product(range(cuts), repeat=2):
            quad = np.zeros((4, 3))
            quad[:, axis] = 0.5 * side
            quad[:, u] = ticks[[i, i + 1, i + 1, i]]
            quad[:, v] = ticks[[j, j, j + 1, j + 1]]
            quads.append(quad[::side])
    return center + np.array(quads) * size


class Scene:
    """One view of the body on its planes; `show` moves the body."""

    def __init__(
        self,
        axes: Axes,
        shape: Shape,
        camera: Camera,
        planes: Sequence[PlaneTuple],
        bounds: np.ndarray,
        *,
        along: int = 0,
        start: float | None = None,
        ruler: bool = True,
    ) -> None:
        self.shape, self.view, self.axes = shape, camera.axes, axes
        self.planes = [(a, (o - shape.origin[a]) * 1e3, s) for a, o, s in planes]
        axes.set_axis_off()
        axes.set_aspect("equal")
        self.ground: float | None = None
        corners = [bounds[[i, j, k], range(3)] for i, j, k in itertools.product((0, 1), repeat=3)]
        for plane in self.planes:
            corners.extend(self._plane(plane, bounds, along, start, ruler))
        if self.ground is None:
            self.shadow = None
        else:
            gray = "#c9ced6"
            self.shadow = PolyCollection([], facecolor=gray, edgecolor=gray, lw=0.3, zorder=1.5)
            axes.add_collection(self.shadow)
            self.shadow.set_clip_path(self.floor)
        self.body = PolyCollection([], lw=0.35, zorder=5)
        self.cavity = PolyCollection([], lw=0.6, zorder=6)
        axes.add_collection(self.body)
        axes.add_collection(self.cavity)
        flat = np.array(corners) @ self.view[:2].T
        low, high = flat.min(axis=0), flat.max(axis=0)
        margin = 0.03 * (high - low).max()
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin - (3.0 if ruler else 0.0), high[1] + margin)
        self._window: np.ndarray | None = None
        if camera.tilt:
            arrow = {"arrowstyle": "-|>", "color": INK, "lw": 1.0}
            axes.annotate("", (0.06, 0.72), (0.06, 0.98), xycoords="axes fraction", arrowprops=arrow)
            axes.text(0.08, 0.85, "g", transform=axes.transAxes, va="center", fontsize=8, color=INK, style="italic")

    def frame(self, offsets: Iterable[np.ndarray]) -> None:
        """Fit the window to a body that moves about the place where the camera looks (see :meth:`look_at`).

        Args:
            offsets: Vertices [V, 3] mm relative to that place, for each picture.
        """
        flat = np.concatenate([points @ self.view[:2].T for points in offsets])
        low, high = flat.min(axis=0), flat.max(axis=0)
        place = self.axes.get_position(original=True)
        canvas = self.axes.get_figure(root=True)
        assert canvas is not None
        shape = canvas.get_size_inches() * [place.width, place.height]
        # More room below than above, for the ground and its numbers.
        half = 0.5 * shape * ([1.16, 1.3] * (high - low) / shape).max()
        middle = 0.5 * (low + high) - [0.0, 0.07 * (high - low)[1]]
        self._window = np.stack([middle - half, middle + half])

    def look_at(self, center: np.ndarray) -> None:
        """Move the window so that a place [3] mm is in its middle; after :meth:`frame`."""
        assert self._window is not None
        (left, low), (right, high) = self.view[:2] @ center + self._window
        self.axes.set_xlim(left, right)
        self.axes.set_ylim(low, high)

    def _plane(
        self, plane: PlaneTuple, bounds: np.ndarray, along: int, start: float | None, ruler: bool
    ) -> list[np.ndarray]:
        axis, position, side = plane
        first, second = (a for a in range(3) if a != axis)
        low, high = plane_extent(plane, self.planes, bounds)
        behind = self.view[2, axis] * side > 0

        def point(u: float, v: float) -> np.ndarray:
            p = np.zeros(3)
            p[axis], p[first], p[second] = position, u, v
            return p

        edge = [
            (low[first], low[second]),
            (high[first], low[second]),
            (high[first], high[second]),
            (low[first], high[second]),
        ]
        corners = [point(u, v) for u, v in edge]
        patch = Polygon(
            np.array(corners) @ self.view[:2].T,
            closed=True,
            facecolor=("#eef1f4" if axis == 2 else "#dde5ed") if behind else "#7fa3c7",
            edgecolor="#b7c0ca",
            lw=0.8,
            alpha=1.0 if axis == 2 else (0.55 if behind else 0.13),
            zorder=(1 if axis == 2 else 0.5) if behind else 7,
        )
        self.axes.add_patch(patch)
        if axis == 2 and behind:
            self.ground, self.floor = position, patch
        near = low[second] if self.view[2, second] <= 0 else high[second]
        lines, widths = [], []
        for a, b, other in ((first, second, False), (second, first, True)):
            for tick in np.arange(math.ceil(low[a] / 5) * 5, high[a] + 1e-9, 5.0):
                ends = [point(tick, e) if not other else point(e, tick) for e in (low[b], high[b])]
                lines.append(np.array(ends) @ self.view[:2].T)
                widths.append(0.9 if tick % 10 == 0 else 0.4)
        self.axes.add_collection(
            LineCollection(
                lines, colors="#cbd2da", linewidths=widths, zorder=1.6 if behind else 7.1, alpha=1.0 if behind else 0.6
            )
        )
        if start is not None and axis != along and behind:
            b = second if along == first else first
            ends = [point(start, e) if along == first else point(e, start) for e in (low[b], high[b])]
            flat = np.array(ends) @ self.view[:2].T
            self.axes.plot(*flat.T, color=FULL, lw=1.3, ls=(0, (4, 2)), zorder=1.8)
        if ruler and along in (first, second) and behind:
            at_edge = near if along == first else (low[first] if self.view[2, first] <= 0 else high[first])
            for tick in np.arange(math.ceil(low[along] / 10) * 10, high[along] + 1e-9, 10.0):
                p = (point(tick, at_edge) if along == first else point(at_edge, tick)) @ self.view[:2].T
                text = f"{tick:.0f} mm" if tick == 0 else f"{tick:.0f}"
                if along == 2:
                    left = p[0] < 0
                    self._tick(text, p, (-4.0 if left else 4.0, 0.0), "right" if left else "left", "center")
                else:
                    self._tick(text, p, (0.0, -4.0), "center", "top")
        return corners

    def _tick(self, text: str, at: np.ndarray, shift: tuple[float, float], across: str, up: str) -> None:
        self.axes.annotate(
            text,
            (float(at[0]), float(at[1])),
            shift,
            textcoords="offset points",
            ha=across,
            va=up,
            color=FAINT,
            fontsize=7,
            zorder=8,
        )

    def show(self, vertices: np.ndarray, cavity: np.ndarray | None, fill: float | None) -> None:
        """Draw the body; ``fill`` from 0 to 1 is the pressure, which colours the cavity seen through the body."""
        faces = self.shape.faces
        corners = vertices[faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat_normal = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
        smooth = np.asarray(self.shape.around @ area)
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
        normal = 0.35 * flat_normal + 0.65 * smooth[faces].mean(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        projected = corners @ self.view.T
        front = np.flatnonzero(flat_normal @ self.view[2] > 0)
        front = front[np.argsort(projected[front, :, 2].mean(axis=1))]
        seen = normal[front] @ self.view.T
        lit = np.clip(seen @ _LIGHT, 0, None)
        half = (_LIGHT + np.array([0, 0, 1])) / np.linalg.norm(_LIGHT + np.array([0, 0, 1]))
        gloss = 0.14 * np.clip(seen @ half, 0, None) ** 24
        sky = 0.5 + 0.5 * normal[front, 2]
        colors = np.clip(self.shape.colors[front] * (0.34 + 0.14 * sky + 0.62 * lit)[:, None] + gloss[:, None], 0, 1)
        self.body.set_verts(projected[front, :, :2])  # pyright: ignore[reportArgumentType]  # an array is its fast path
        self.body.set_facecolor(colors)
        self.body.set_edgecolor(colors)
        if self.shadow is not None and self.ground is not None:
            sun = _LIGHT @ self.view
            sun = np.array([sun[0], sun[1], max(sun[2], 1.0)])
            facing = flat_normal @ sun > 0
            fall = corners[facing] - (corners[facing][..., 2:] - self.ground) * (sun / sun[2])
            self.shadow.set_verts(fall @ self.view[:2].T)  # pyright: ignore[reportArgumentType]
        if cavity is not None:
            outward = np.cross(cavity[:, 2] - cavity[:, 0], cavity[:, 3] - cavity[:, 1])
            visible = cavity[outward @ self.view[2] > 0]
            red, green, blue, _ = PRESSURE(0.0 if fill is None else fill)
            self.cavity.set_verts(visible @ self.view[:2].T)  # pyright: ignore[reportArgumentType]
            self.cavity.set_facecolor((red, green, blue, 0.16 if fill is None else 0.16 + 0.24 * fill))
            self.cavity.set_edgecolor((red, green, blue, 0.22))


def camera_path(center: np.ndarray, direction: Sequence[float]) -> np.ndarray:
    """Where a camera looks that follows a robot [S, 3]: the mean place, moved on with the smoothed travel.

    Args:
        center: Centre of gravity in each picture [S, 3].
        direction: Unit vector of the travel.
    """
    travel = center @ np.asarray(direction, dtype=float)
    smooth = ndimage.gaussian_filter1d(travel, max(len(travel) / 8, 1.0), mode="nearest")
    return center.mean(axis=0) + (smooth - travel.mean())[:, None] * np.asarray(direction, dtype=float)


def plane_extent(plane: PlaneTuple, planes: Sequence[PlaneTuple], bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far a plane is drawn: lower and upper corner [3] mm of the box whose section it is.

    Args:
        plane: The plane, with its position in mm.
        planes: All planes; one ends where another stands.
        bounds: Corners [2, 3] mm of the box in which the body moves.
    """
    low, high = bounds[0] - 7.0, bounds[1] + 7.0
    if plane[0] != 2 and (floors := [o for a, o, s in planes if a == 2 and s > 0]):
        low[2] = floors[0]
    for a, o, s in planes:
        if a != plane[0] and a != 2:
            low[a], high[a] = (max(low[a], o), high[a]) if s > 0 else (low[a], min(high[a], o))
    return low, high


def bounds_of(placed: Iterable[np.ndarray]) -> np.ndarray:
    """Corners [2, 3] of the box around all of these points."""
    boxes = [np.stack([v.min(axis=0), v.max(axis=0)]) for v in placed if len(v)]
    if not boxes:  # nothing to see: an empty stage
        return np.array([[0.0, 0.0, 0.0], [30.0, 30.0, 30.0]])
    return np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
