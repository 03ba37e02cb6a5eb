"""Every law once, as functions of numbers, which Taichi, Numba and plain Python all run from this text.

``kernels.laws_taichi`` and ``kernels.laws_numba`` compile it. So that all three read it alike, and lanes of a vector
register go through it together, a law

- takes numbers and returns a number or a tuple of them, once, at its end; vectors are taken apart;
- calls other laws, ``abs``, ``min``, ``max`` and the functions of ``math`` imported here, and nothing else;
- has ``if`` and ``else`` but no loop, and divides by nothing that is zero in the branch taken;
- begins a variable with a value of the type that it keeps, ``x * 0`` rather than 0: Taichi takes it from there;
- has no number that float32 does not hold exactly, ``x / 3`` rather than ``0.333 * x``: Taichi rounds it.
"""

from math import sqrt

# One over the slope below which a point that arrives is taken to graze the plane.
STEEPEST = 5


def response(u0, u1, u2, n0, n1, n2, stick, friction, hold):
    """Velocity of a node after contact with a plane.

    A node that approaches (or is held back by adhesion) sticks: u = 0; or slides: its normal part vanishes and its
    tangential part shrinks by at most ``friction`` times what presses it on the plane, adhesion included. A node torn
    off keeps the rest of its speed.

    Args:
        u0: Velocity before, x [m/s].
        u1: Likewise y.
        u2: Likewise z.
        n0: Unit normal of the plane to its free side, x.
        n1: Likewise y.
        n2: Likewise z.
        stick: 1 if nothing slides.
        friction: Coulomb coefficient.
        hold: Largest pull-off speed that adhesion cancels in this step [m/s].

    Returns:
        The velocity after.
    """
    normal = u0 * n0 + u1 * n1 + u2 * n2
    r0, r1, r2 = u0, u1, u2
    if normal > hold:
        r0, r1, r2 = u0 - hold * n0, u1 - hold * n1, u2 - hold * n2
    elif normal < 0 or hold > 0:
        t0, t1, t2 = u0 - normal * n0, u1 - normal * n1, u2 - normal * n2
        speed = sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        loss = friction * (hold - normal)
        rest = speed * 0
        if stick == 0 and speed > loss:
            rest = 1 - loss / speed
        r0, r1, r2 = t0 * rest, t1 * rest, t2 * rest
    return r0, r1, r2


def response_adjoint(u0, u1, u2, n0, n1, n2, stick, friction, hold, r0_bar, r1_bar, r2_bar):
    """Adjoint of :func:`response`: gradients by the velocity (three), friction and hold."""
    normal = u0 * n0 + u1 * n1 + u2 * n2
    along = r0_bar * n0 + r1_bar * n1 + r2_bar * n2
    u0_bar, u1_bar, u2_bar = r0_bar, r1_bar, r2_bar
    friction_bar, hold_bar = normal * 0, normal * 0
    if normal > hold:
        hold_bar = -along
    elif normal < 0 or hold > 0:
        t0, t1, t2 = u0 - normal * n0, u1 - normal * n1, u2 - normal * n2
        speed = sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        loss = friction * (hold - normal)
        u0_bar, u1_bar, u2_bar = normal * 0, normal * 0, normal * 0
        if stick == 0 and speed > loss:
            e0, e1, e2 = t0 / speed, t1 / speed, t2 / speed
            loss_bar = -(e0 * r0_bar + e1 * r1_bar + e2 * r2_bar)
            rest = 1 - loss / speed
            # Across the direction of sliding the velocity shrinks, along it it does not; the normal part presses.
            turned = -loss_bar * (1 - rest)
            pressed = loss_bar * friction
            u0_bar = rest * (r0_bar - along * n0) + turned * e0 - pressed * n0
            u1_bar = rest * (r1_bar - along * n1) + turned * e1 - pressed * n1
            u2_bar = rest * (r2_bar - along * n2) + turned * e2 - pressed * n2
            friction_bar = loss_bar * (hold - normal)
            hold_bar = pressed
    return u0_bar, u1_bar, u2_bar, friction_bar, hold_bar
