"""Laws of contact, drag, softening and links as functions of numbers: one text, for Taichi, lanes and plain Python.

``kernels.laws_taichi`` and ``kernels.laws_lanes`` compile it. So that all three read it alike, and lanes of a vector
register go through it together, a law

- takes numbers and returns a number or a tuple of them, once, at its end; vectors are taken apart;
- calls other laws, ``abs``, ``min``, ``max`` and the functions of ``math`` imported here, and nothing else;
- has ``if`` and ``else`` but no loop, and divides by nothing that is zero in the branch taken;
- begins a variable with a value of the type that it keeps, ``x * 0`` rather than 0: Taichi takes it from there;
- has no number that float32 does not hold exactly, ``x / 3`` rather than ``0.333 * x``: Taichi rounds it.
"""

from math import sqrt

# One over the slope below which a point that arrives is taken to graze the plane: what it loses along the plane may be
# much more than its normal speed, and its place, so the gradient, would depend on the gap without bound.
STEEPEST = 5
# Stiffness of an elastic plane for a node, in the node's mass over the square of the step.
PUSH = 0.5
# How far in front of a plane a node is looked at, and within what distance it touches, in cells.
LOOK = 2
TOUCH = 1 / 1024
# Argument from which on the error function is constant: one to 2e-6.
FAR = 4


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


def plane_approach(v, gap, dt, push):
    """A node's way along the normal of a plane in a step, and what the plane gives to its velocity.

    A node that would end behind the plane ends on it and at rest. So where it comes to rest is a continuous function of
    where it came from, and has a gradient; to stop it only once it arrives would multiply that gradient at every
    landing. It loses its share of a blow's energy. With ``push`` above 0 it meets a spring behind the plane instead,
    which keeps energy.

    Args:
        v: Velocity along the normal before contact [m/s].
        gap: Distance from the plane, negative behind it [m].
        dt: Step [s].
        push: Stiffness of the spring behind the plane, in the node's mass over the square of the step; 0 for none.

    Returns:
        The way over dt [m/s], the gain in velocity [m/s], and 1 if the node lands inelastically in this step.
    """
    ahead = max(gap, gap * 0)
    way, gain, lands = v, v * 0, v * 0
    if push > 0:
        gain = push * max(-gap, gap * 0) / dt
        way = v + gain
    elif v * dt + ahead < 0:
        way, gain, lands = -ahead / dt, -v, lands + 1
    return way, gain, lands


def plane_approach_adjoint(v, gap, dt, push, way_bar, gain_bar):
    """Adjoint of :func:`plane_approach`: gradients by velocity and gap."""
    ahead = max(gap, gap * 0)
    v_bar, gap_bar = way_bar, gap * 0
    if push > 0:
        if gap < 0:
            gap_bar = -push * (way_bar + gain_bar) / dt
    elif v * dt + ahead < 0:
        v_bar = -gain_bar
        if gap > 0:
            gap_bar = -way_bar / dt
    return v_bar, gap_bar


def grip(friction, more, slow, speed):
    """Coulomb coefficient at a speed along the plane: ``more`` is added at rest, half of it at a speed of ``slow``."""
    fast = speed / slow
    return friction + more / (1 + fast * fast)


def plane_pressure(u0, u1, u2, n0, n1, n2, gap, dt, stick, friction, more, slow, hold, reach, touch, push):
    """What presses a node on a plane in a step, and what that leaves of its sliding; see :func:`plane_contact`.

    Returns:
        Velocity along the normal before; velocity along the plane, three numbers; the normal velocity with what
        adhesion pulls from afar, and with the plane's push; the way over dt; by how much adhesion holds the node, and
        holds it back; what presses it; its speed along the plane; the coefficient at that speed; the share of its
        speed that it keeps; 1 if it slides; 1 if it lands.
    """
    along = u0 * n0 + u1 * n1 + u2 * n2
    t0, t1, t2 = u0 - along * n0, u1 - along * n1, u2 - along * n2
    v, held = along, hold * 0
    if gap < touch:
        held = hold
    elif gap < reach:
        v = along - hold
    way, gain, lands = plane_approach(v, gap, dt, push)
    if push <= 0 and lands <= 0 and v <= 0:
        held = held * 0
    after = v + gain
    back = min(max(after, after * 0), held)
    pressed = gain + held - back
    speed = sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    coefficient = grip(friction, more, slow, speed)
    rest, slides = v * 0 + 1, v * 0
    if pressed > 0:
        rest = v * 0
        if stick == 0 and speed > coefficient * pressed:
            rest = 1 - coefficient * pressed / speed
            slides = v * 0 + 1
    return along, t0, t1, t2, v, after, way, held, back, pressed, speed, coefficient, rest, slides, lands


def plane_contact(u0, u1, u2, n0, n1, n2, gap, dt, stick, friction, more, slow, hold, reach, touch, push):
    """Velocity of a node after a step towards, on or off a plane, and what else it moves by in this step.

    What presses the node on the plane, the plane's push and adhesion, makes it stick, or slows its sliding by at most
    the coefficient times that. The coefficient may depend on the speed (see :func:`grip`). Adhesion holds a node that
    touches until it is torn off, and pulls one that is within reach. What a node loses along the plane it loses from
    when it arrives.

    Args:
        u0: Velocity before, x [m/s].
        u1: Likewise y.
        u2: Likewise z.
        n0: Unit normal of the plane to its free side, x.
        n1: Likewise y.
        n2: Likewise z.
        gap: Distance from the plane, negative behind it [m].
        dt: Step [s].
        stick: 1 if nothing slides that is pressed on.
        friction: Coulomb coefficient of what slides fast.
        more: What is added to it at rest.
        slow: Speed at which half of that is left [m/s].
        hold: Largest pull-off speed that adhesion cancels in a step [m/s].
        reach: Distance within which adhesion pulls [m].
        touch: Distance within which it holds [m].
        push: See :func:`plane_approach`.

    Returns:
        The velocity after, and what is added to it for this step's motion only, three numbers each [m/s].
    """
    _, t0, t1, t2, v, after, way, _, back, _, speed, _, rest, _, lands = plane_pressure(
        u0, u1, u2, n0, n1, n2, gap, dt, stick, friction, more, slow, hold, reach, touch, push
    )
    early = v * 0
    if lands > 0 and gap > 0:
        early = gap / (dt * max(-v, speed * (1 - rest) / STEEPEST)) * (1 - rest)
    normal, extra = after - back, way - after
    return (
        rest * t0 + normal * n0,
        rest * t1 + normal * n1,
        rest * t2 + normal * n2,
        early * t0 + extra * n0,
        early * t1 + extra * n1,
        early * t2 + extra * n2,
    )


def plane_contact_adjoint(
    u0, u1, u2, n0, n1, n2, gap, dt, stick, friction, more, slow, hold, reach, touch, push,
    r0_bar, r1_bar, r2_bar, o0_bar, o1_bar, o2_bar,
):  # fmt: skip
    """Adjoint of :func:`plane_contact`.

    Gradients by velocity (three), normal (three), gap, friction, what is added at rest, the speed that halves it, hold.
    """
    along, t0, t1, t2, v, after, way, held, back, pressed, speed, coefficient, rest, slides, lands = plane_pressure(
        u0, u1, u2, n0, n1, n2, gap, dt, stick, friction, more, slow, hold, reach, touch, push
    )
    lost, pace, share = speed * (1 - rest), v * 0 + 1, v * 0
    if lands > 0 and gap > 0:
        pace = max(-v, lost / STEEPEST)
        share = gap / (dt * pace)
    early = share * (1 - rest)
    normal, extra = after - back, way - after

    normal_bar = r0_bar * n0 + r1_bar * n1 + r2_bar * n2
    extra_bar = o0_bar * n0 + o1_bar * n1 + o2_bar * n2
    early_bar = o0_bar * t0 + o1_bar * t1 + o2_bar * t2
    rest_bar = r0_bar * t0 + r1_bar * t1 + r2_bar * t2 - share * early_bar
    v_bar, gap_bar, speed_bar = v * 0, v * 0, v * 0
    if lands > 0 and gap > 0:
        share_bar = early_bar * (1 - rest)
        gap_bar = share_bar / (dt * pace)
        pace_bar = -share_bar * share / pace
        if -v >= lost / STEEPEST:
            v_bar = -pace_bar
        else:
            speed_bar = pace_bar * (1 - rest) / STEEPEST
            rest_bar -= pace_bar * speed / STEEPEST
    pressed_bar, friction_bar, more_bar, slow_bar = v * 0, v * 0, v * 0, v * 0
    if slides > 0:
        loss_bar = -rest_bar / speed
        pressed_bar = loss_bar * coefficient
        friction_bar = loss_bar * pressed
        fast = speed / slow
        left = 1 / (1 + fast * fast)
        more_bar = friction_bar * left
        fast_bar = -2 * more_bar * more * left * fast
        slow_bar = -fast_bar * fast / slow
        speed_bar += rest_bar * (1 - rest) / speed + fast_bar / slow
    after_bar, held_bar = normal_bar - extra_bar, pressed_bar
    back_bar = -normal_bar - pressed_bar
    if after > held:
        held_bar += back_bar
    elif after > 0:
        after_bar += back_bar
    by_v, by_gap = plane_approach_adjoint(v, gap, dt, push, extra_bar, pressed_bar + after_bar)
    v_bar += after_bar + by_v
    gap_bar += by_gap
    turned = v * 0
    if speed > 0:
        turned = speed_bar / speed
    t0_bar = rest * r0_bar + early * o0_bar + turned * t0
    t1_bar = rest * r1_bar + early * o1_bar + turned * t1
    t2_bar = rest * r2_bar + early * o2_bar + turned * t2
    along_bar = v_bar - (t0_bar * n0 + t1_bar * n1 + t2_bar * n2)
    hold_bar = v * 0
    if gap < touch and (push > 0 or lands > 0 or v > 0):
        hold_bar = held_bar
    elif gap >= touch and gap < reach:
        hold_bar = -v_bar
    return (
        t0_bar + along_bar * n0,
        t1_bar + along_bar * n1,
        t2_bar + along_bar * n2,
        along_bar * u0 - along * t0_bar + normal * r0_bar + extra * o0_bar,
        along_bar * u1 - along * t1_bar + normal * r1_bar + extra * o1_bar,
        along_bar * u2 - along * t2_bar + normal * r2_bar + extra * o2_bar,
        gap_bar,
        friction_bar,
        more_bar,
        slow_bar,
        hold_bar,
    )


def quadratic_drag(u, sink):
    """Component of a node's velocity after a step of drag that grows with its square, taken implicitly.

    Args:
        u: Velocity before [m/s].
        sink: Step times half the density of what surrounds the body, drag coefficient and area, over the mass [s/m].
    """
    return u / (1 + sink * abs(u))


def quadratic_drag_adjoint(u, sink, r_bar):
    """Adjoint of :func:`quadratic_drag`: gradients by velocity and sink."""
    left = 1 / (1 + sink * abs(u))
    u_bar = r_bar * left * left
    return u_bar, -u * abs(u) * u_bar


def error_function(x):
    """Of a number that is not negative, within 5e-4: equation 7.1.27 of Abramowitz and Stegun, in steps of 1/1024."""
    z = min(x, x * 0 + FAR)
    root = 1 + z * (0.2783203125 + z * (0.23046875 + z * (0.0009765625 + z * 0.078125)))
    return 1 - 1 / (root * root * root * root)


def error_function_adjoint(x, r_bar):
    """Adjoint of :func:`error_function`: the gradient by x."""
    z = min(x, x * 0 + FAR)
    root = 1 + z * (0.2783203125 + z * (0.23046875 + z * (0.0009765625 + z * 0.078125)))
    slope = 0.2783203125 + z * (0.4609375 + z * (0.0029296875 + z * 0.3125))
    x_bar = x * 0
    if x < FAR:
        x_bar = 4 * r_bar * slope / (root * root * root * root * root)
    return x_bar


def softening(x, largest, depth, span):
    """How a solid softens below its largest stretch so far (Mullins), after Ogden and Roxburgh (1999).

    With 1 / depth their r, and span / 2 times the shear modulus their m, energies are those of a neo-Hookean solid.

    Args:
        x: Stretch, I1b - 3.
        largest: Its largest value before.
        depth: Largest share of the shear modulus that is lost.
        span: By how much less than its largest the stretch is where erf(1) of that, 84 %, is lost; above 0.

    Returns:
        The share of the shear modulus that is left, and the largest stretch with this one.
    """
    below = max(largest - x, x * 0)
    return 1 - depth * error_function(below / span), x + below


def softening_adjoint(x, largest, depth, span, left_bar, largest_bar):
    """Adjoint of :func:`softening`: gradients by stretch, largest stretch before, depth and span."""
    below = max(largest - x, x * 0)
    ratio = below / span
    ratio_bar = error_function_adjoint(ratio, -left_bar * depth)
    below_bar = x * 0
    if below > 0:
        below_bar = largest_bar + ratio_bar / span
    return (
        largest_bar - below_bar,
        below_bar,
        -left_bar * error_function(ratio),
        -ratio_bar * ratio / span,
    )


def repulsion(square, reach, a, b):
    """Force between two points of a body that have come near each other, over the vector between them [N/m].

    Its stiffness is that of two springs in series, twice, so that the weaker point sets it; it vanishes with its slope
    at the reach. The energy is stiffness x reach x (1 - square / reach)^3 / 6.

    Args:
        square: Squared distance [m2].
        reach: Squared distance from which on nothing acts [m2].
        a: Stiffness of the one point [N/m].
        b: Likewise of the other.
    """
    push = square * 0
    if square < reach and a > 0 and b > 0:
        left = 1 - square / reach
        push = 2 * a * b / (a + b) * left * left
    return push


def repulsion_adjoint(square, reach, a, b, push_bar):
    """Adjoint of :func:`repulsion`: gradients by the squared distance and both stiffnesses."""
    square_bar, a_bar, b_bar = square * 0, square * 0, square * 0
    if square < reach and a > 0 and b > 0:
        left = 1 - square / reach
        whole = a + b
        square_bar = -4 * a * b / whole * left / reach * push_bar
        by_series = 2 * left * left * push_bar / (whole * whole)
        a_bar = by_series * b * b
        b_bar = by_series * a * a
    return square_bar, a_bar, b_bar


def link(d0, d1, d2, r0, r1, r2, rest, stiffness, damping):
    """Force of a link of a chain, which pulls where it is longer than at rest, and never pushes.

    Args:
        d0: From its one end to the other, x [m].
        d1: Likewise y.
        d2: Likewise z.
        r0: Rate of that, x [m/s].
        r1: Likewise y.
        r2: Likewise z.
        rest: Length at rest, above 0 where it is stiff [m].
        stiffness: [N/m].
        damping: [N s/m].

    Returns:
        Force on the one end [N].
    """
    span = sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    pull = span * 0
    if span > rest:
        rate = (d0 * r0 + d1 * r1 + d2 * r2) / span
        pull = max(stiffness * (span - rest) + damping * rate, span * 0) / span
    return pull * d0, pull * d1, pull * d2
