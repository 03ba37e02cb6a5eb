"""Contact of grid nodes with axis-aligned planes, stick or Coulomb friction with adhesion, and its adjoint."""

import taichi as ti

from torchsoro.simulation.kernels.laws_taichi import laws
from torchsoro.simulation.kernels.layout import (
    PLANE,
    PLANE_ADHESION,
    PLANE_AXIS,
    PLANE_FRICTION,
    PLANE_OFFSET,
    PLANE_SIGN,
    PLANE_STICK,
)

# Slope below which a point that arrives is taken to graze the plane.
GRAZING = 0.2


@ti.func
def plane_distance(planes: ti.template(), plane_kind: ti.template(), at, k, x, cell):
    """Signed distance of a node in front of plane k, in cells."""
    axis, sign = plane_kind[3 * k + PLANE_AXIS], plane_kind[3 * k + PLANE_SIGN]
    along = x[0]
    if axis == 1:
        along = x[1]
    elif axis == 2:
        along = x[2]
    return (along - planes[at + PLANE * k + PLANE_OFFSET]) * sign / cell


@ti.func
def axis_normal(axis, sign, like):
    """Unit vector along an axis, of the given sign."""
    n = like * 0
    for i in ti.static(range(3)):
        if axis == i:
            n[i] = sign
    return n


@ti.func
def normal_of(plane_kind: ti.template(), k, like):
    """Unit normal of plane k, pointing to the free side."""
    return axis_normal(plane_kind[3 * k + PLANE_AXIS], plane_kind[3 * k + PLANE_SIGN], like)


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
            r = response(r, n, plane_kind[3 * k + PLANE_STICK], planes[at + PLANE * k + PLANE_FRICTION], hold)
    return r


@ti.func
def arrives(u, n, gap, dt):
    """Whether a step of dt would end behind a plane that is ``gap`` away."""
    return u.dot(n) * dt + ti.max(gap, gap * 0) < 0


@ti.func
def carry(u, r, n, gap, dt):
    """Velocity that carries a point which arrives onto the plane: its way until it arrives, in place of that after it.

    Where it grazes the plane, what it loses along the plane may be much more than its normal speed, and its place, so
    the gradient, would depend on ``gap`` without bound. There it counts as arriving at a slope of GRAZING.
    """
    lost = u - r - u.dot(n) * n
    speed = ti.max(-u.dot(n), GRAZING * lost.norm())
    return ti.max(gap, gap * 0) / dt * (lost / speed - n)


@ti.func
def carry_adjoint(u, r, n, gap, dt, onto_bar):
    """Adjoint of :func:`carry`: gradients by u, r and gap."""
    u_bar = u * 0
    r_bar = u * 0
    gap_bar = gap * 0
    if gap > 0:
        lost = u - r - u.dot(n) * n
        along = onto_bar - onto_bar.dot(n) * n
        size, normal = lost.norm(), -u.dot(n)
        speed = ti.max(normal, GRAZING * size)
        gap_bar = (lost / speed - n).dot(onto_bar) / dt
        lost_bar = gap / (dt * speed) * along
        speed_bar = -lost_bar.dot(lost) / speed
        if normal >= GRAZING * size:
            u_bar -= speed_bar * n
        else:
            lost_bar += speed_bar * GRAZING / size * lost
        u_bar += lost_bar
        r_bar -= lost_bar
    return u_bar, r_bar, gap_bar


@ti.func
def gap_response(u, n, gap, dt, stick, friction, hold):
    """Velocity after a step of dt towards or off a plane that is ``gap`` away, and what carries it onto the plane.

    A point that would end behind the plane ends on it: the second result, which is gone afterwards as the impact takes
    the velocity, moves it there. So where a body comes to rest, along the plane too, is a continuous function of where
    it came from, and has a gradient. To stop the velocity as well only when it arrives would multiply that gradient at
    every landing. Once there, this is :func:`response`. ``hold`` is negative where adhesion does not reach.
    """
    r = u
    onto = u * 0
    if arrives(u, n, gap, dt):
        r = response(u, n, stick, friction, ti.max(hold, hold * 0))
        onto = carry(u, r, n, gap, dt)
    elif u.dot(n) > 0 and hold >= 0:
        r = response(u, n, stick, friction, hold)
    return r, onto


@ti.func
def gap_response_adjoint(u, n, gap, dt, stick, friction, hold, r_bar, onto_bar):
    """Adjoint of :func:`gap_response`: gradients by u, gap, friction and hold."""
    u_bar = r_bar
    gap_bar = gap * 0
    friction_bar = gap * 0
    hold_bar = gap * 0
    if arrives(u, n, gap, dt):
        pull = ti.max(hold, hold * 0)
        r = response(u, n, stick, friction, pull)
        carried, by_r, by_gap = carry_adjoint(u, r, n, gap, dt, onto_bar)
        by_u, by_friction, by_hold = response_adjoint(u, n, stick, friction, pull, r_bar + by_r)
        u_bar, gap_bar, friction_bar, hold_bar = by_u + carried, by_gap, by_friction, by_hold
    elif u.dot(n) > 0 and hold >= 0:
        by_u, by_friction, by_hold = response_adjoint(u, n, stick, friction, hold, r_bar)
        u_bar, friction_bar, hold_bar = by_u, by_friction, by_hold
    return u_bar, gap_bar, friction_bar, hold_bar
