"""Contact of grid nodes with axis-aligned planes, stick or Coulomb friction with adhesion, and its adjoint."""

import taichi as ti

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
    """Velocity of a node after one plane; ``hold`` is the largest pull-off speed that adhesion cancels in this step.

    A node that approaches (or is held back by adhesion) sticks: u = 0; or slides: its normal part vanishes and its
    tangential part shrinks by at most ``friction`` times what presses it on the plane, adhesion included. A node torn
    off keeps the rest of its speed.
    """
    r = u
    normal = u.dot(n)
    if normal > hold:
        r = u - hold * n
    elif normal < 0 or hold > 0:
        if stick == 1:
            r = u * 0
        else:
            tangential = u - normal * n
            speed = tangential.norm()
            loss = friction * (hold - normal)
            r = u * 0
            if speed > loss:
                r = tangential * (1 - loss / speed)
    return r


@ti.func
def response_adjoint(u, n, stick, friction, hold, r_bar):
    """Adjoint of :func:`response`: gradients by u, friction and hold."""
    u_bar = r_bar
    friction_bar = u[0] * 0
    hold_bar = u[0] * 0
    normal = u.dot(n)
    if normal > hold:
        hold_bar = -r_bar.dot(n)
    elif normal < 0 or hold > 0:
        u_bar = r_bar * 0
        if stick == 0:
            tangential = u - normal * n
            speed = tangential.norm()
            loss = friction * (hold - normal)
            if speed > loss:
                direction = tangential / speed
                loss_bar = -direction.dot(r_bar)
                flat = r_bar - r_bar.dot(n) * n
                u_bar = flat - loss / speed * (flat - direction.dot(flat) * direction)
                u_bar -= loss_bar * friction * n
                friction_bar = loss_bar * (hold - normal)
                hold_bar = loss_bar * friction
    return u_bar, friction_bar, hold_bar


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
