"""Many trials of one body at once: the marches of ``march.py``, advanced together on a GPU.

One thread per quadrature point, then one per node, which sums what its elements and walls press on it in a fixed order:
the same trials give the same numbers again. A body that walks takes 50,000 to 80,000 steps, in which one trial would
leave a GPU idle; hundreds take hardly longer than one.
"""

# What looks like a number in a kernel may be a vector, and annotations are values.
# pyright: reportOptionalOperand=false, reportOptionalMemberAccess=false, reportOptionalCall=false
# pyright: reportIndexIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import taichi as ti
from lobatto import Floats, Ints
from march import March
from numpy.typing import NDArray
from world import ATMOSPHERE, World

MOST = 384  # trials at once: 30 fields of 20,000 points in float64 take 2 GB
TOGETHER = 200  # steps between two looks at which trials go on
_real = ti.f64


def start(*, gpu: bool) -> None:
    """Prepare Taichi, once in a process.

    Raises:
        ValueError: for a GPU where there is none.
    """
    options = {"device_memory_GB": 4} if gpu else {"cpu_max_num_threads": 1}
    ti.init(arch=ti.cuda if gpu else ti.cpu, default_fp=_real, log_level=ti.ERROR, **options)
    if gpu and ti.cfg.arch != ti.cuda:
        raise ValueError("gpu = True: there is no CUDA device, wanted one, or processes alone")


def able(world: World) -> bool:
    """Whether a world has only what is computed here: no stiffening, softening, drag, wind, magnet, or liquid."""
    other = world.gent or world.softening or world.drag or world.gust is not None or world.magnet is not None
    return not other and len(world.chains) < 2 and not any(lump.frequency for lump in world.lumps)


def _by_node(nodes: Ints, count: int) -> tuple[Ints, Ints]:
    """Where in ``nodes`` each node stands: positions, and the first of each node [count + 1]."""
    flat = nodes.ravel()
    return np.argsort(flat, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=count))])


@ti.func
def _slope(i, k):
    """Slope at node i of three of the quadratic that is 1 at node k: (-3, 4, -1), (-1, 0, 1), (1, -4, 3), over 2 h."""
    return ti.cast(ti.select(k == 1, 4 - 4 * i, 2 * i - 3 + k), _real)


@ti.data_oriented
class Fleet:
    """Trials of one body, which are advanced together."""

    def __init__(self, marches: Sequence[March], instants: Sequence[Floats], points: Sequence[tuple[Ints, Floats]]):
        """Copy what the trials are.

        Args:
            marches: Trials, none of them begun, all of the same mesh.
            instants: Of each trial [T] s, increasing.
            points: Nodes and shape functions [P, 27] of what is recorded of each trial.
        """
        mesh = marches[0].case.mesh
        self.count, self.times = len(marches), [len(t) for t in instants]
        self.links = max(len(m.elements) for m in marches)
        self.chamber = bool(mesh.chambers) and bool(marches[0].case.pressure[0].size)
        self.builder = ti.FieldsBuilder()
        self.filled: list[tuple[ti.Field, NDArray[Any]]] = []
        self._mesh(marches)
        self._law(marches)
        self._ground(marches)
        self._air(marches, [float(t[-1]) for t in instants])
        self._pulled(marches)
        self._recorded(instants, points)
        self._state(marches)
        self.tree = self.builder.finalize()
        for field, value in self.filled:
            field.from_numpy(np.ascontiguousarray(value))
        self.filled.clear()

    def _field(self, given: Any) -> ti.Field:
        """A field of these numbers."""
        value = np.asarray(given)
        whole = value.dtype.kind in "iub"
        field = ti.field(ti.i32 if whole else _real)
        self.builder.dense(ti.axes(*range(value.ndim)), value.shape).place(field)
        self.filled.append((field, value.astype(np.int32 if whole else np.float64)))
        return field

    def _empty(self, *shape: int) -> ti.Field:
        field = ti.field(_real)
        self.builder.dense(ti.axes(*range(len(shape))), shape).place(field)
        return field

    def _mesh(self, marches: Sequence[March]) -> None:
        mesh = marches[0].case.mesh
        self.nodes, self.points = len(mesh.nodes), mesh.cells.size
        self.rest, self.cells = self._field(mesh.nodes.T), self._field(mesh.cells.ravel())
        self.scale, self.weight = self._field(mesh.size.T), self._field(mesh.weight.ravel())
        places, first = _by_node(mesh.cells, self.nodes)
        self.places, self.first = self._field(places), self._field(first)
        self.mass = self._field([m.mass for m in marches])
        self.held = self._field([m.case.held for m in marches])
        self.gravity = self._field([m.gravity for m in marches])

    def _law(self, marches: Sequence[March]) -> None:
        flat = [np.broadcast_to(m.shear, m.case.mesh.weight.shape).ravel() / m.case.shear for m in marches]
        self.factor = self._field(flat)
        self.shear = self._field([m.case.shear for m in marches])
        self.bulk = self._field([m.case.bulk for m in marches])
        discrete = np.zeros((self.count, max(self.links, 1), 3))
        for s, m in enumerate(marches):
            discrete[s, : len(m.discrete)] = m.discrete
        self.discrete = self._field(discrete)
        heat = [(m.world.heat, m.case.started, m.case.lasting) for m in marches]
        self.heat = self._field(heat)
        self.stress = self._empty(9, self.count, self.points)
        self.old = self._empty(6, self.count, self.points)
        self.history = self._empty(max(self.links, 1), 6, self.count, self.points)

    def _ground(self, marches: Sequence[March]) -> None:
        self.ground = self._field([m.ground for m in marches])
        self.plane = self._field([m.plane for m in marches])
        self.coulomb = self._field([m.coulomb for m in marches])
        self.area = self._field([m.area for m in marches])

    def _air(self, marches: Sequence[March], last: Sequence[float]) -> None:
        """Walls of the chamber, and the pressure that the supply sends."""
        sides = marches[0].case.mesh.chambers[0] if self.chamber else marches[0].case.mesh.outside
        self.sides = len(sides.nodes)
        self.wall, self.sign = self._field(sides.nodes.ravel()), self._field(sides.sign)
        places, first = _by_node(sides.nodes, self.nodes)
        self.walls, self.first_wall = self._field(places), self._field(first)
        self.vectors = self._empty(3, self.count, self.sides * 9)
        self.enclosed = self._empty(self.sides, self.count)
        arriving = np.zeros((self.count, 1))
        if self.chamber:
            t = np.arange(max(int(end / m.dt) for m, end in zip(marches, last, strict=True)) + 2)
            arriving = np.stack([m.world.line.arriving(np.interp(t * m.dt, *m.case.pressure), m.dt) for m in marches])
        self.arriving = self._field(arriving)
        self.closed = self._field([(m.world.line.closed, m.case.air) for m in marches])
        self.volume = self._field([m.first_volume if self.chamber else 1.0 for m in marches])
        self.inside = self._field(np.zeros(self.count))

    def _pulled(self, marches: Sequence[March]) -> None:
        """Dead loads, and the tube, which is the last of what pulls."""
        self.loads = max(len(m.case.loads) for m in marches)
        self.pulls = self.loads + 1
        share = np.zeros((self.pulls, self.count, self.nodes))
        pull, begin = np.zeros((self.pulls, self.count, 3)), np.full((self.pulls, self.count), math.inf)
        self.beads = max((len(c[2]) for m in marches for c in m.chains), default=1)
        numbers, support = np.zeros((self.count, 4)), np.zeros((self.count, 3))
        tube, held = np.zeros((self.count, 8), int), np.zeros((self.count, 8))
        bead = np.zeros((2, self.count, self.beads, 3))
        for s, m in enumerate(marches):
            for k, (nodes, weights, force, at) in enumerate(m.case.loads):
                share[k, s, nodes], pull[k, s], begin[k, s] = weights, force, at
            for nodes, weights, beads, _, end, given in m.chains:
                share[-1, s, nodes], numbers[s], support[s], bead[0, s] = weights, given, end, beads
                tube[s, : len(nodes)], held[s, : len(nodes)] = nodes, weights
        self.share, self.pull, self.begin = self._field(share), self._field(pull), self._field(begin)
        self.force = self._field(np.zeros_like(pull))
        self.numbers, self.support, self.bead = self._field(numbers), self._field(support), self._field(bead)
        self.tube, self.tube_share = self._field(tube), self._field(held)
        self.link = self._empty(self.count, self.beads + 1, 3)

    def _recorded(self, instants: Sequence[Floats], points: Sequence[tuple[Ints, Floats]]) -> None:
        longest, width = max(self.times), max(len(nodes) for nodes, _ in points)
        when = np.full((self.count, longest), math.inf)
        nodes, shapes = np.zeros((self.count, width, 27), int), np.zeros((self.count, width, 27))
        for s, (t, (at, shape)) in enumerate(zip(instants, points, strict=True)):
            when[s, : len(t)], nodes[s, : len(at)], shapes[s, : len(at)] = t, at, shape
        self.widths = [len(at) for at, _ in points]
        self.when, self.many = self._field(when), self._field(self.times)
        self.seen, self.shapes = self._field(nodes), self._field(shapes)
        self.out = self._empty(self.count, longest, width, 3)
        self.done = self._field(np.zeros(self.count, int))

    def _state(self, marches: Sequence[March]) -> None:
        self.u = self._empty(3, self.count, self.nodes)
        self.v = self._field(np.stack([m.v.T for m in marches], 1))
        self.dt, self.t = self._field([m.dt for m in marches]), self._field(np.zeros(self.count))
        self.number, self.live = self._field(np.zeros(self.count, int)), self._field(np.ones(self.count, int))
        self.broken = self._field(np.zeros(self.count, int))

    def run(self) -> list[Floats]:
        """Recorded points of each trial [T, P, 3] m; an empty array where an element turned inside out."""
        while self.live.to_numpy().any():
            for _ in range(TOGETHER):
                self._step()
        out, broken = self.out.to_numpy(), self.broken.to_numpy()
        self.tree.destroy()
        wanted = enumerate(zip(self.times, self.widths, strict=True))
        return [np.zeros(0) if broken[s] else out[s, :t, :width].copy() for s, (t, width) in wanted]

    @ti.kernel
    def _step(self):
        for s, p in ti.ndrange(self.count, self.points):
            if self.live[s]:
                self._material(s, p)
        for s, b in ti.ndrange(self.count, self.sides if ti.static(self.chamber) else 0):
            if self.live[s]:
                self._side(s, b)
        for s in range(self.count):
            if self.live[s]:
                self._pressure(s)
                self._pull(s)
        for s, n in ti.ndrange(self.count, self.nodes):
            if self.live[s] and not self.held[s, n]:
                self._advance(s, n)
        for s, m in ti.ndrange(self.count, self.seen.shape[1]):
            if self.live[s]:
                self._record(s, m)
        for s in range(self.count):
            if self.live[s]:
                self.t[s] += self.dt[s]
                self.number[s] += 1
                while self.done[s] < self.many[s] and self.when[s, self.done[s]] < self.t[s]:
                    self.done[s] += 1
                if self.broken[s] or self.done[s] == self.many[s]:
                    self.live[s] = 0

    @ti.func
    def _material(self, s, p):
        """P of a point times its volume, from displacements of the seven nodes on its lines."""
        e, q = p // 27, p % 27
        f = ti.Matrix.identity(_real, 3)
        for b in ti.static(range(3)):
            place = q // ti.static(3**b) % 3
            line = p - place * ti.static(3**b)
            for m in ti.static(range(3)):
                d = _slope(place, m) / self.scale[b, e]
                n = self.cells[line + ti.static(m * 3**b)]
                for a in ti.static(range(3)):
                    f[a, b] += d * self.u[a, s, n]
        j = f.determinant()
        if not j > 0.2:
            self.broken[s] = 1
            j = 1.0
        cofactor = f.inverse().transpose() * f.determinant()
        two = ti.exp(-2.0 / 3.0 * ti.log(j))
        cb = two * (f.transpose() @ f)
        trace = cb.trace()
        pulled = (ti.Matrix.identity(_real, 3) - trace / 3 * cb.inverse()) / j
        t = 1.0 * pulled  # a copy
        for c in ti.static(range(6)):
            row, col = ti.static(((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))[c])
            change = pulled[row, col] - self.old[c, s, p]
            for m in ti.static(range(self.links)):
                if self.discrete[s, m, 2] > 0:
                    h = self.discrete[s, m, 0] * self.history[m, c, s, p] + self.discrete[s, m, 1] * change
                    self.history[m, c, s, p] = h
                    t[row, col] += self.discrete[s, m, 2] * h
                    if ti.static(row != col):
                        t[col, row] += self.discrete[s, m, 2] * h
            self.old[c, s, p] = pulled[row, col]
        cooling = 1 - self.heat[s, 0] * (self.heat[s, 1] + self.t[s]) / self.heat[s, 2]
        factor = self.weight[p] * self.factor[s, p] * cooling
        mu, k = self.shear[s] * factor, self.bulk[s] * factor
        mean = (t @ cb).trace() / 3
        iso = k / 2 * (j * (j - 1) + ti.log(j)) / j - mu * mean
        stress = mu * j * two * (f @ t) + iso * cofactor
        for a, b in ti.static(ti.ndrange(3, 3)):
            self.stress[3 * a + b, s, p] = stress[a, b]

    @ti.func
    def _place(self, s, n):
        return ti.Vector([self.rest[a, n] + self.u[a, s, n] for a in ti.static(range(3))])

    @ti.func
    def _side(self, s, b):
        """Area vectors of a side's nine nodes, and the volume that it encloses with the origin."""
        volume = ti.cast(0.0, _real)
        for q in range(9):
            i, j = q % 3, q // 3
            g, h = ti.Vector.zero(_real, 3), ti.Vector.zero(_real, 3)
            for m in ti.static(range(3)):
                g += 0.5 * _slope(i, m) * self._place(s, self.wall[9 * b + m + 3 * j])
                h += 0.5 * _slope(j, m) * self._place(s, self.wall[9 * b + i + 3 * m])
            share = self.sign[b] / 9 * (4.0 if i == 1 else 1.0) * (4.0 if j == 1 else 1.0)
            area = share * g.cross(h)
            volume += self._place(s, self.wall[9 * b + q]).dot(area) / 3
            for a in ti.static(range(3)):
                self.vectors[a, s, 9 * b + q] = area[a]
        self.enclosed[b, s] = volume

    @ti.func
    def _pressure(self, s):
        if ti.static(self.chamber):
            volume = ti.cast(0.0, _real)
            for b in range(self.sides):
                volume -= self.enclosed[b, s]
            ratio = volume / self.volume[s]
            arriving = self.arriving[s, self.number[s]]
            grown = 1 + self.closed[s, 0] * (ratio - 1)
            inside = (arriving + ATMOSPHERE) / grown - ATMOSPHERE
            self.inside[s] = inside - self.closed[s, 1] * (ratio - 1)

    @ti.func
    def _pull(self, s):
        """Forces of dead loads and of the tube, whose beads move on by a step."""
        for k in range(self.loads):
            for a in ti.static(range(3)):
                self.force[k, s, a] = self.pull[k, s, a] if self.t[s] >= self.begin[k, s] else 0.0
        each, rest, stiff, damping = [self.numbers[s, c] for c in ti.static(range(4))]
        if each > 0:
            end, speed = ti.Vector.zero(_real, 3), ti.Vector.zero(_real, 3)
            for c in range(8):
                n = self.tube[s, c]
                end += self.tube_share[s, c] * self._place(s, n)
                speed += self.tube_share[s, c] * ti.Vector([self.v[a, s, n] for a in ti.static(range(3))])
            for i in range(self.beads + 1):
                other, other_speed = ti.Vector.zero(_real, 3), ti.Vector.zero(_real, 3)
                for a in ti.static(range(3)):
                    other[a] = self.support[s, a] if i == self.beads else self.bead[0, s, i, a]
                    other_speed[a] = 0.0 if i == self.beads else self.bead[1, s, i, a]
                reach = other - end
                length = reach.norm() + 1e-12
                tension = stiff * (length - rest) + damping * (other_speed - speed).dot(reach) / length
                if not (length > rest and tension > 0):
                    tension = 0.0
                for a in ti.static(range(3)):
                    self.link[s, i, a] = tension * reach[a] / length
                end, speed = other, other_speed
            for a in ti.static(range(3)):
                self.force[self.loads, s, a] = self.link[s, 0, a]
                for i in range(self.beads):
                    pull = (self.link[s, i + 1, a] - self.link[s, i, a]) / each
                    self.bead[1, s, i, a] += self.dt[s] * (self.gravity[s, a] + pull)
                    self.bead[0, s, i, a] += self.dt[s] * self.bead[1, s, i, a]

    @ti.func
    def _force(self, s, n):
        force = self.mass[s, n] * ti.Vector([self.gravity[s, a] for a in ti.static(range(3))])
        for c in range(self.first[n], self.first[n + 1]):
            p = self.places[c]
            e, q = p // 27, p % 27
            for b in ti.static(range(3)):
                place = q // ti.static(3**b) % 3
                line = p - place * ti.static(3**b)
                for m in ti.static(range(3)):
                    d = _slope(m, place) / self.scale[b, e]
                    for a in ti.static(range(3)):
                        force[a] -= d * self.stress[3 * a + b, s, line + ti.static(m * 3**b)]
        if ti.static(self.chamber):
            for c in range(self.first_wall[n], self.first_wall[n + 1]):
                for a in ti.static(range(3)):
                    force[a] -= self.inside[s] * self.vectors[a, s, self.walls[c]]
        for k in range(self.pulls):
            for a in ti.static(range(3)):
                force[a] += self.share[k, s, n] * self.force[k, s, a]
        return force

    @ti.func
    def _advance(self, s, n):
        """A step of central differences with at most one plane, as ``kernels.advance``."""
        dt, mass = self.dt[s], self.mass[s, n]
        kick = 0.5 if self.number[s] == 0 else 1.0  # velocities start half a step behind
        v = ti.Vector([self.v[a, s, n] for a in ti.static(range(3))]) + kick * dt / mass * self._force(s, n)
        normal = ti.Vector([self.plane[s, 3 + a] for a in ti.static(range(3))])
        area = self.area[s, n]
        if normal.norm_sqr() > 0 and area > 0:
            gap = (self._place(s, n) - ti.Vector([self.plane[s, a] for a in ti.static(range(3))])).dot(normal)
            down = v.dot(normal)
            press, pull = ti.cast(0.0, _real), ti.cast(0.0, _real)
            if gap < 0:
                rate = dt * area / mass
                after = (down - rate * self.ground[s, 0] * gap) / (1 + rate * self.ground[s, 1])
                press = ti.max((after - down) * mass / dt, 0.0)
            elif self.ground[s, 2] > 0:
                reach = self.ground[s, 3]
                pull = self.ground[s, 2] * area * gap / reach * ti.exp(1 - gap / reach)
            v += dt * (press - pull) / mass * normal
            if press > 0:
                down = v.dot(normal)
                along = v - down * normal
                speed = along.norm()
                if speed > 0:
                    low, high = self.coulomb[s, 0], self.coulomb[s, 1]
                    mu = low + (high - low) * ti.exp(-speed / self.coulomb[s, 2])
                    v = down * normal + ti.max(1 - mu * dt * press / mass / speed, 0.0) * along
        for a in ti.static(range(3)):
            self.v[a, s, n] = v[a]
            self.u[a, s, n] += dt * v[a]

    @ti.func
    def _record(self, s, m):
        """Where a recorded point was at each instant that the step has passed."""
        k, last = self.done[s], self.t[s]
        if k < self.many[s] and self.when[s, k] < last + self.dt[s]:
            after, speed = ti.Vector.zero(_real, 3), ti.Vector.zero(_real, 3)
            for c in range(27):
                n, shape = self.seen[s, m, c], self.shapes[s, m, c]
                after += shape * self._place(s, n)
                speed += shape * ti.Vector([self.v[a, s, n] for a in ti.static(range(3))])
            while k < self.many[s] and self.when[s, k] < last + self.dt[s]:
                for a in ti.static(range(3)):
                    self.out[s, k, m, a] = after[a] - (last + self.dt[s] - self.when[s, k]) * speed[a]
                k += 1
