"""Moving-least-squares transfers between particles and grid, and their adjoints; no material law stands here."""

import taichi as ti

from torchsoro.simulation.kernels.layout import (
    ADJOINT_FLIP,
    ADJOINT_MOVED,
    ADJOINT_NEW,
    BEFORE,
    NODE,
    NODE_MASS,
    NODE_MOVED,
    NODE_NEW,
    NODE_TRANSFER,
    NODE_VELOCITY,
)
from torchsoro.simulation.kernels.spline import slopes, weights
from torchsoro.simulation.kernels.tensor import load_vector
from torchsoro.simulation.kernels.warp import add_runs, find_runs, lay


@ti.func
def particle_to_grid(
    gpu: ti.template(),
    pool: ti.template(),
    marks: ti.template(),
    slot,
    grid: ti.template(),
    grid_at,
    before: ti.template(),
    before_at,
    both,
    node0,
    row,
    plane,
    f,
    mass,
    q,
    A,
    q_before,
    A_before,
):
    """Scatter mass and momentum: w (q + A (o - f)) with o the node's offset and f the particle's place, in cells.

    If ``both``, also the momentum before forces, to a grid of its own. ``pool``, ``marks`` and ``slot`` are for the
    sums of a warp, see ``warp``; there ``node0`` is -1 for none.
    """
    w = weights(f)
    start = q - A @ f
    start_before = q_before - A_before @ f
    runs = 0
    if ti.static(gpu):
        runs = find_runs(marks, slot, node0)
    for i in range(3):
        for j in range(3):
            wij = w[i, 0] * w[j, 1]
            line = start
            line_before = start_before
            for c in ti.static(range(3)):
                line[c] += i * A[c, 0] + j * A[c, 1]
                line_before[c] += i * A_before[c, 0] + j * A_before[c, 1]
            shift = i * plane + j * row
            at = grid_at + (node0 + shift) * NODE
            for k in ti.static(range(3)):
                weight = wij * w[k, 2]
                lay(gpu, pool, slot, k * NODE + NODE_MASS, grid, at + k * NODE + NODE_MASS, weight * mass)
                for c in ti.static(range(3)):
                    value = weight * (line[c] + k * A[c, 2])
                    lay(gpu, pool, slot, k * NODE + NODE_VELOCITY + c, grid, at + k * NODE + NODE_VELOCITY + c, value)
            if ti.static(gpu):
                add_runs(pool, marks, slot, runs, NODE, NODE, grid, grid_at + shift * NODE)
            if both:
                at = before_at + (node0 + shift) * BEFORE
                for k in ti.static(range(3)):
                    for c in ti.static(range(3)):
                        value = wij * w[k, 2] * (line_before[c] + k * A_before[c, 2])
                        lay(gpu, pool, slot, k * BEFORE + c, before, at + k * BEFORE + c, value)
                if ti.static(gpu):
                    add_runs(pool, marks, slot, runs, BEFORE, BEFORE, before, before_at + shift * BEFORE)


@ti.func
def particle_to_grid_adjoint(
    bar: ti.template(), bar_at, size: ti.template(), offset: ti.template(), node0, row, plane, f, mass, q, A
):
    """Adjoint of scattering (mass and) momentum: gradients by mass, q, A and the place f (in cells).

    ``bar`` holds ``size`` numbers for each node, its momentum's gradient at ``offset`` and, if that is 1, its mass's
    gradient before it.
    """
    w = weights(f)
    dw = slopes(f)
    zero = mass * 0
    mass_bar = zero
    q_bar = ti.Vector([zero, zero, zero])
    A_bar = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    f_bar = ti.Vector([zero, zero, zero])
    start = q - A @ f
    for i in range(3):
        for j in range(3):
            line = start
            for c in ti.static(range(3)):
                line[c] += i * A[c, 0] + j * A[c, 1]
            at = bar_at + (node0 + i * plane + j * row) * size
            along = ti.Vector([zero, zero, zero])
            along_k = ti.Vector([zero, zero, zero])
            density = zero
            flat = zero
            slope = zero
            for k in ti.static(range(3)):
                p_i = load_vector(bar, at + k * size + offset, 1)
                value = zero
                if ti.static(offset == 1):
                    m_i = bar[at + k * size + NODE_MASS]
                    value = m_i * mass
                    density += w[k, 2] * m_i
                for c in ti.static(range(3)):
                    value += p_i[c] * (line[c] + k * A[c, 2])
                along += w[k, 2] * p_i
                if ti.static(k > 0):
                    along_k += (w[k, 2] * k) * p_i
                flat += w[k, 2] * value
                slope += dw[k, 2] * value
            wij = w[i, 0] * w[j, 1]
            mass_bar += wij * density
            q_bar += wij * along
            for c in ti.static(range(3)):
                A_bar[c, 0] += i * wij * along[c]
                A_bar[c, 1] += j * wij * along[c]
                A_bar[c, 2] += wij * along_k[c]
            f_bar[0] += dw[i, 0] * w[j, 1] * flat
            f_bar[1] += w[i, 0] * dw[j, 1] * flat
            f_bar[2] += wij * slope
    A_bar -= q_bar.outer_product(f)
    f_bar -= A.transpose() @ q_bar
    return mass_bar, q_bar, A_bar, f_bar


@ti.func
def grid_to_particle(new: ti.template(), new_at, node0, row, plane, f, both):
    """Gather the velocity, its moment about the particle in cells, and the transferred velocity (if ``both``)."""
    w = weights(f)
    zero = f[0] * 0
    velocity = ti.Vector([zero, zero, zero])
    transferred = ti.Vector([zero, zero, zero])
    moment = ti.Matrix([[zero, zero, zero], [zero, zero, zero], [zero, zero, zero]])
    for i in range(3):
        for j in range(3):
            at = new_at + (node0 + i * plane + j * row) * NODE_NEW
            along = ti.Vector([zero, zero, zero])
            along_k = ti.Vector([zero, zero, zero])
            other = ti.Vector([zero, zero, zero])
            for k in ti.static(range(3)):
                u = w[k, 2] * load_vector(new, at + k * NODE_NEW + NODE_MOVED, 1)
                along += u
                if ti.static(k > 0):
                    along_k += k * u
            if both:
                for k in ti.static(range(3)):
                    other += w[k, 2] * load_vector(new, at + k * NODE_NEW + NODE_TRANSFER, 1)
            wij = w[i, 0] * w[j, 1]
            velocity += wij * along
            transferred += wij * other
            for c in ti.static(range(3)):
                moment[c, 0] += i * wij * along[c]
                moment[c, 1] += j * wij * along[c]
                moment[c, 2] += wij * along_k[c]
    if not both:
        transferred = velocity
    return velocity, moment - velocity.outer_product(f), transferred


@ti.func
def grid_to_particle_adjoint(
    gpu: ti.template(),
    pool: ti.template(),
    marks: ti.template(),
    slot,
    new: ti.template(),
    new_at,
    grid: ti.template(),
    grid_at,
    node0,
    row,
    plane,
    f,
    blend,
    velocity_bar,
    moment_bar,
    transferred_bar,
):
    """Adjoint of :func:`grid_to_particle`: scatter to the nodes' adjoint, and return the gradient by the place f."""
    w = weights(f)
    dw = slopes(f)
    zero = f[0] * 0
    f_bar = ti.Vector([zero, zero, zero])
    velocity = ti.Vector([zero, zero, zero])
    start = velocity_bar - moment_bar @ f
    moved_start = start + transferred_bar
    if blend == 0:
        start = moved_start
    runs = 0
    there = node0
    if ti.static(gpu):
        runs = find_runs(marks, slot, node0)
        there = ti.max(node0, 0)
    for i in range(3):
        for j in range(3):
            wij = w[i, 0] * w[j, 1]
            line = start
            moved_line = moved_start
            for c in ti.static(range(3)):
                tilt = i * moment_bar[c, 0] + j * moment_bar[c, 1]
                line[c] += tilt
                moved_line[c] += tilt
            shift = i * plane + j * row
            at = grid_at + (node0 + shift) * ADJOINT_NEW
            new_line = new_at + (there + shift) * NODE_NEW
            flat = zero
            slope = zero
            for k in ti.static(range(3)):
                weight = wij * w[k, 2]
                value = zero
                u = load_vector(new, new_line + k * NODE_NEW + NODE_MOVED, 1)
                velocity += weight * u
                for c in ti.static(range(3)):
                    tilt = k * moment_bar[c, 2]
                    share = weight * (moved_line[c] + tilt)
                    lay(gpu, pool, slot, 3 * k + c, grid, at + k * ADJOINT_NEW + ADJOINT_MOVED + c, share)
                    value += (line[c] + tilt) * u[c]
                if blend > 0:
                    for c in ti.static(range(3)):
                        value += transferred_bar[c] * new[new_line + k * NODE_NEW + NODE_TRANSFER + c]
                flat += w[k, 2] * value
                slope += dw[k, 2] * value
            if ti.static(gpu):
                add_runs(pool, marks, slot, runs, 3, ADJOINT_NEW, grid, grid_at + shift * ADJOINT_NEW + ADJOINT_MOVED)
            if blend > 0:
                for k in ti.static(range(3)):
                    for c in ti.static(range(3)):
                        share = wij * w[k, 2] * blend * transferred_bar[c]
                        lay(gpu, pool, slot, 3 * k + c, grid, at + k * ADJOINT_NEW + ADJOINT_FLIP + c, share)
                if ti.static(gpu):
                    add_runs(
                        pool, marks, slot, runs, 3, ADJOINT_NEW, grid, grid_at + shift * ADJOINT_NEW + ADJOINT_FLIP
                    )
            f_bar[0] += dw[i, 0] * w[j, 1] * flat
            f_bar[1] += w[i, 0] * dw[j, 1] * flat
            f_bar[2] += wij * slope
    # The moment is taken about the particle: d(moment)/df = -velocity (x) I.
    return f_bar - moment_bar.transpose() @ velocity
