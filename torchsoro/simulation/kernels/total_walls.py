"""Pressure of chambers, walls of hollow ones, and springs to mean displacements, in the total-Lagrangian form.

A hollow chamber is known by points of its walls: pressure follows them, p dA = p t1 x t2 with the two tangents, and the
volume is one third of the sum of x . dA. A block of threads takes 256 points of one chamber; nodes then add up what
their points hand them.
"""

import taichi as ti

from torchsoro.simulation.kernels.fold import TOTALS, fold
from torchsoro.simulation.kernels.lattice import nodes_per_axis, product, state_length
from torchsoro.simulation.kernels.layout import (
    BATCH,
    CHAIN_STEPS,
    CHAMBER,
    CHAMBER_NUMBERS,
    CHAMBER_STIFFNESS,
    CHAMBER_VOLUME,
    CHAMBERS,
    FORCES,
    NORMALS,
    PRESSURE,
    RING,
    SWEPT,
    TENSION,
    TIE_SHARE,
    TIE_STIFFNESS,
    TIES,
    TIES_BAR,
    TILE,
    VOLUMES,
    WALL_CHUNK,
    WALL_CHUNKS,
    WALL_COUNT,
    WALL_ENTRY,
    WALL_KIND,
    WALL_NUMBERS,
    WALL_ROW,
    WALL_ROWS,
    WALL_VECTORS,
    WALL_WEIGHTS,
)
from torchsoro.simulation.kernels.tensor import add, load_vector, store_vector
from torchsoro.simulation.kernels.tile import chamber_slots, sync, thread
from torchsoro.simulation.kernels.total_chains import chain_pass

AT_HAND = 2 * TILE  # of the pad: where what wall points hand over begins


@ti.func
def chamber_pressure(block: ti.template(), t, volume, one):
    """p_act - k (V/V0 - 1) in chamber number ``one`` of all simulations, in substep t."""
    at = block.head[CHAMBER_NUMBERS] + one * CHAMBER
    p_act = block.supply[block.head[PRESSURE] + t * block.head[BATCH] * block.head[CHAMBERS] + one]
    return p_act - block.fixed[at + CHAMBER_STIFFNESS] * (volume / block.fixed[at + CHAMBER_VOLUME] - 1)


@ti.func
def chamber_volume_bar(block: ti.template(), p_bar, one):
    """Gradient by a chamber's volume, from that by its pressure."""
    at = block.head[CHAMBER_NUMBERS] + one * CHAMBER
    return -p_bar * block.fixed[at + CHAMBER_STIFFNESS] / block.fixed[at + CHAMBER_VOLUME]


# --------------------------------------------------------------------------------------- springs to mean displacements


@ti.func
def mean_of(block: ti.template(), a: ti.template(), at, tie, first):
    """Mean of a nodal vector field over the nodes of a spring: at TOTALS of the pad, from number ``first`` on."""
    nodes = product(nodes_per_axis(block.head))
    shares = block.head[TIE_SHARE] + tie * nodes
    for c in range(3):
        for each in range(block.q0, block.q1):
            q = thread(block, each)
            total = a[at] * 0
            i = q
            while i < nodes:
                total += block.fixed[shares + i] * a[at + c * nodes + i]
                i += TILE
            block.pad[block.base + q] = total
        fold(block, first + c, TILE)


@ti.func
def tie_pass(block: ti.template(), tie, t):
    """Force that a spring takes, number ``tie`` of all simulations."""
    (head,) = ti.static((block.head,))
    mean_of(block, block.state, ((t % head[RING]) * head[BATCH] + tie // head[TIES]) * state_length(head), tie, 0)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        if q < 3:
            stiffness = block.fixed[head[TIE_STIFFNESS] + tie]
            block.scratch[head[TENSION] + 3 * tie + q] = stiffness * block.pad[block.base + TOTALS + q]
    sync(block.gpu)
    for each in range(block.q0, block.q1):
        if thread(block, each) == 0 and head[CHAIN_STEPS] > 0:
            chain_pass(block, tie, t)
    sync(block.gpu)


@ti.func
def tie_pass_adjoint(block: ti.template(), tie, t):
    """Adjoint of :func:`tie_pass`: the gradient by the mean displacement takes the place of the force."""
    (head,) = ti.static((block.head,))
    b, nodes = tie // head[TIES], product(nodes_per_axis(head))
    mean_of(block, block.back, head[FORCES] + b * 3 * nodes, tie, 0)
    mean_of(block, block.state, (t * head[BATCH] + b) * state_length(head), tie, 3)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        totals = block.base + TOTALS
        if q < 3:
            stiffness = block.fixed[head[TIE_STIFFNESS] + tie]
            block.scratch[head[TENSION] + 3 * tie + q] = -stiffness * block.pad[totals + q]
        if q == 0:
            work = load_vector(block.pad, totals, 1).dot(load_vector(block.pad, totals + 3, 1))
            add(False, block.sums, head[TIES_BAR] + tie, -work)
    sync(block.gpu)


@ti.func
def tied(block: ti.template(), b, i, nodes):
    """What the springs hand to node i: its shares of their forces, or of the gradients by their displacements."""
    (head,) = ti.static((block.head,))
    found = load_vector(block.fixed, 0, 1) * 0
    for k in range(head[TIES]):
        tie = b * head[TIES] + k
        share = block.fixed[head[TIE_SHARE] + tie * nodes + i]
        found += share * load_vector(block.scratch, head[TENSION] + 3 * tie, 1)
    return found


# ------------------------------------------------------------------------------------------- walls of hollow chambers


@ti.func
def wall_places(head: ti.template()):
    """Places of wall points in the chunks."""
    return head[WALL_CHUNKS] * TILE


@ti.func
def wall_point(block: ti.template(), w, at):
    """Place of a wall point, and its two tangents, from displacements that begin at a place of the states."""
    head, fixed = ti.static((block.head, block.fixed))
    m, places = nodes_per_axis(head), wall_places(head)
    number, kind = head[WALL_NUMBERS] + w, head[WALL_KIND] + w
    corner, axis = at + block.ints[kind], block.ints[kind + 2 * places]
    x = load_vector(fixed, number, places)
    one, two = x * 0, x * 0
    for row in range(9):
        for k in ti.static(range(3)):  # loads of three nodes at a time
            v = number + (4 + 3 * (3 * row + k)) * places
            d = load_vector(block.state, corner + (row // 3 * m[1] + row % 3) * m[2] + k, product(m))
            x += fixed[v] * d
            one += fixed[v + places] * d
            two += fixed[v + 2 * places] * d
    for c in ti.static(range(3)):
        if axis == (c + 2) % 3:
            one[c] += 1
        if axis == (c + 1) % 3:
            two[c] += 1
    return x, one, two


@ti.func
def wall_pull(block: ti.template(), b, w):
    """Gradient by the forces, at a wall point."""
    m, places = nodes_per_axis(block.head), wall_places(block.head)
    corner = block.head[FORCES] + b * 3 * product(m) + block.ints[block.head[WALL_KIND] + w]
    pull = load_vector(block.fixed, 0, 1) * 0
    for n in range(27):
        weight = block.fixed[block.head[WALL_NUMBERS] + (4 + 3 * n) * places + w]
        pull += weight * load_vector(block.back, corner + (n // 9 * m[1] + n // 3 % 3) * m[2] + n % 3, product(m))
    return pull


@ti.func
def wall_vectors(block: ti.template(), b, w):
    """Where what a wall point hands to its nodes lies: component by component, so many places apart."""
    return block.head[NORMALS] + b * WALL_VECTORS * wall_places(block.head) + w


@ti.func
def wall_total(block: ti.template(), b, chunk):
    """Sum what the points of a chunk have in the pad, for the chamber."""
    fold(block, 0, TILE)
    for each in range(block.q0, block.q1):
        if thread(block, each) == 0:
            place = block.ints[block.head[WALL_CHUNK] + chunk]
            swept = block.head[SWEPT] + b * chamber_slots(block.head, block.ints) + place
            block.scratch[swept] = block.pad[block.base + TOTALS]
    sync(block.gpu)


@ti.func
def wall_pass(block: ti.template(), item, t):
    """Area vectors and volumes of 256 wall points, number ``item`` of all simulations' chunks."""
    (head,) = ti.static((block.head,))
    b, chunk = item // head[WALL_CHUNKS], item % head[WALL_CHUNKS]
    at = ((t % head[RING]) * head[BATCH] + b) * state_length(head)
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        w = chunk * TILE + q
        x, one, two = wall_point(block, w, at)
        places = wall_places(head)
        n = block.fixed[head[WALL_NUMBERS] + 3 * places + w] * one.cross(two)
        store_vector(block.scratch, wall_vectors(block, b, w), places, n)
        block.pad[block.base + q] = x.dot(n) / 3
    wall_total(block, b, chunk)


@ti.func
def wall_pressed(block: ti.template(), t, b, w):
    """Pressure times area vector of a wall point, whose chamber's volume is at TOTALS of the pad."""
    head, ints = ti.static((block.head, block.ints))
    places = wall_places(head)
    k = ints[head[WALL_KIND] + places + w]
    p = chamber_pressure(block, t, block.pad[block.base + TOTALS + k], b * head[CHAMBERS] + k)
    return p * load_vector(block.scratch, wall_vectors(block, b, w), places)


@ti.func
def walls_at_hand(block: ti.template()):
    """Whether what wall points hand over has room in the pad, behind the volumes of the chambers."""
    room = ti.static(block.tile.pad - AT_HAND)
    return wall_places(block.head) * 3 <= room and block.head[CHAMBERS] <= ti.static(AT_HAND - TOTALS)


@ti.func
def stage_walls(block: ti.template(), t, b):
    """Copy what the wall points of a simulation hand over to the pad, if there is room."""
    if walls_at_hand(block):
        for each in range(block.q0, block.q1):
            w = thread(block, each)
            while w < wall_places(block.head):
                store_vector(block.pad, block.base + AT_HAND + 3 * w, 1, wall_pressed(block, t, b, w))
                w += TILE
        sync(block.gpu)


@ti.func
def wall_force(block: ti.template(), t, b, i):
    """Force of the pressure in hollow chambers on node i, against which it must be held."""
    head, ints = ti.static((block.head, block.ints))
    found = load_vector(block.fixed, 0, 1) * 0
    row, staged = ints[head[WALL_ROW] + i], walls_at_hand(block)
    if row >= 0:
        count = ints[head[WALL_COUNT] + row]
        for bundle in range((count + 3) // 4):
            for k in ti.static(range(4)):  # loads of four wall points at a time
                e = ti.min(4 * bundle + k, count - 1) * head[WALL_ROWS] + row
                w, weight = ints[head[WALL_ENTRY] + e] // 27, block.fixed[head[WALL_WEIGHTS] + e]
                weight = ti.select(4 * bundle + k < count, weight, weight * 0)
                if staged:
                    found -= weight * load_vector(block.pad, block.base + AT_HAND + 3 * w, 1)
                else:
                    found -= weight * wall_pressed(block, t, b, w)
    return found


@ti.func
def wall_pass_adjoint(block: ti.template(), item, t):
    """Adjoint of :func:`wall_pass` and :func:`wall_force`, at a pressure that is known."""
    (head,) = ti.static((block.head,))
    b, chunk = item // head[WALL_CHUNKS], item % head[WALL_CHUNKS]
    for each in range(block.q0, block.q1):
        q = thread(block, each)
        w, places = chunk * TILE + q, wall_places(head)
        one_chamber = b * head[CHAMBERS] + block.ints[head[WALL_KIND] + places + w]
        volume = block.kept[head[VOLUMES] + t * head[BATCH] * head[CHAMBERS] + one_chamber]
        p = chamber_pressure(block, t, volume, one_chamber)
        x, one, two = wall_point(block, w, (t * head[BATCH] + b) * state_length(head))
        pull = wall_pull(block, b, w)
        area = block.fixed[head[WALL_NUMBERS] + 3 * places + w]
        n = area * one.cross(two)
        out = wall_vectors(block, b, w)
        # By the volume: with weights, and with both slopes; by the force: with both slopes.
        store_vector(block.scratch, out, places, n / 3)
        store_vector(block.scratch, out + 3 * places, places, area / 3 * two.cross(x))
        store_vector(block.scratch, out + 6 * places, places, area / 3 * x.cross(one))
        store_vector(block.scratch, out + 9 * places, places, p * area * two.cross(pull))
        store_vector(block.scratch, out + 12 * places, places, p * area * pull.cross(one))
        block.pad[block.base + q] = pull.dot(n)
    wall_total(block, b, chunk)


@ti.func
def wall_spread(block: ti.template(), b, i):
    """What the wall points around node i add to the gradient by its place."""
    head, ints, scratch = ti.static((block.head, block.ints, block.scratch))
    found, places = load_vector(block.fixed, 0, 1) * 0, wall_places(head)
    row = ints[head[WALL_ROW] + i]
    if row >= 0:
        for k in range(ints[head[WALL_COUNT] + row]):
            e = ints[head[WALL_ENTRY] + k * head[WALL_ROWS] + row]
            w, n = e // 27, e % 27
            chamber = ints[head[WALL_KIND] + places + w]
            by_volume = chamber_volume_bar(
                block, block.pad[block.base + TOTALS + chamber], b * head[CHAMBERS] + chamber
            )
            values = load_vector(block.fixed, head[WALL_NUMBERS] + (4 + 3 * n) * places + w, places)
            at = wall_vectors(block, b, w)
            for c in ti.static(range(3)):
                found += by_volume * values[c] * load_vector(scratch, at + 3 * c * places, places)
            for c in ti.static(range(2)):
                found += values[1 + c] * load_vector(scratch, at + (9 + 3 * c) * places, places)
    return found
