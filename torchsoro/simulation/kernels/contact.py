"""Contact of grid nodes with axis-aligned planes, stick or Coulomb friction with adhesion, and its adjoint."""

import taichi as ti

from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    PLANE,
    PLANE_ADHESION,
    PLANE_AXIS,
    PLANE_FRICTION,
    PLANE_INTEGERS,
    PLANE_OFFSET,
    PLANE_SIGN,
    PLANE_STICK,
)


@ti.func
def plane_distance(planes: ti.template(), plane_kind: ti.template(), at, k, x, cell):
    """Signed distance of a node in front of plane k, in cells."""
    axis, sign = plane_kind[PLANE_INTEGERS * k + PLANE_AXIS], plane_kind[PLANE_INTEGERS * k + PLANE_SIGN]
    along = x[0]
    if axis == 1:
        along = x[1]
    elif axis == 2:
        along = x[2]
    return (along - planes[at + PLANE * k + PLANE_OFFSET]) * sign / cell


@ti.func
def normal_of(plane_kind: ti.template(), k, like):
    """Unit normal of plane k of the updated form, pointing to the free side."""
    n = like * 0
    for i in ti.static(range(3)):
        if plane_kind[PLANE_INTEGERS * k + PLANE_AXIS] == i:
            n[i] = plane_kind[PLANE_INTEGERS * k + PLANE_SIGN]
    return n


@ti.func
def response(u, n, stick, friction, hold):
    """``laws.response`` of vectors."""
    r0, r1, r2 = laws.response(u[0], u[1], u[2], n[0], n[1], n[2], stick, friction, hold)
    return ti.Vector([r0, r1, r2])


@ti.func
def response_adjoint(u, n, stick, friction, hold, r_bar):
    """``laws.response_adjoint`` of vectors: gradients by u, friction and hold."""
    u0_bar, u1_bar, u2_bar, friction_bar, hold_bar = laws.response_adjoint(
        u[0], u[1], u[2], n[0], n[1], n[2], stick, friction, hold, r_bar[0], r_bar[1], r_bar[2]
    )
    return ti.Vector([u0_bar, u1_bar, u2_bar]), friction_bar, hold_bar


@ti.func
def in_contact(distance):
    """Whether a node lies on a plane or behind it."""
    return distance < 1e-4


@ti.func
def adhesive_speed(planes: ti.template(), at, k, distance, mass, impulse):
    """Pull-off speed that adhesion cancels in a step, at the plane only: traction times area times dt over mass."""
    hold = mass * 0
    if distance > -0.5:
        hold = planes[at + PLANE * k + PLANE_ADHESION] * impulse / mass
    return hold


@ti.func
def contact(planes: ti.template(), plane_kind: ti.template(), at, count, x, mass, u, cell, dt):
    """Velocity of a node after the first ``count`` planes, one after the other."""
    r = u
    impulse = cell * cell * dt
    for k in range(count):
        distance = plane_distance(planes, plane_kind, at, k, x, cell)
        n = normal_of(plane_kind, k, u)
        hold = adhesive_speed(planes, at, k, distance, mass, impulse)
        if in_contact(distance):
            stick, friction = plane_kind[PLANE_INTEGERS * k + PLANE_STICK], planes[at + PLANE * k + PLANE_FRICTION]
            r = response(r, n, stick, friction, hold)
    return r


@ti.func
def plane_contact(u, n, gap, dt, stick, friction, more, slow, hold, reach, touch, push):
    """``laws.plane_contact`` of vectors."""
    r0, r1, r2, o0, o1, o2 = laws.plane_contact(
        u[0], u[1], u[2], n[0], n[1], n[2], gap, dt, stick, friction, more, slow, hold, reach, touch, push
    )
    return ti.Vector([r0, r1, r2]), ti.Vector([o0, o1, o2])


@ti.func
def plane_contact_adjoint(u, n, gap, dt, stick, friction, more, slow, hold, reach, touch, push, r_bar, onto_bar):
    """``laws.plane_contact_adjoint`` of vectors: gradients by u, n, gap, friction (three numbers of it) and hold."""
    u0_bar, u1_bar, u2_bar, n0_bar, n1_bar, n2_bar, gap_bar, friction_bar, more_bar, slow_bar, hold_bar = (
        laws.plane_contact_adjoint(
            *(u[0], u[1], u[2], n[0], n[1], n[2], gap, dt, stick, friction, more, slow, hold, reach, touch, push),
            *(r_bar[0], r_bar[1], r_bar[2], onto_bar[0], onto_bar[1], onto_bar[2]),
        )
    )
    by_u, by_n = ti.Vector([u0_bar, u1_bar, u2_bar]), ti.Vector([n0_bar, n1_bar, n2_bar])
    return by_u, by_n, gap_bar, ti.Vector([friction_bar, more_bar, slow_bar]), hold_bar
