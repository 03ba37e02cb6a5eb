"""The largest stable step of a body."""

from __future__ import annotations

from collections.abc import Sequence

from torchsoro.simulation.courant import STABLE_COURANT, Courant
from torchsoro.simulation.formulation import Formulation, FormulationName, formulation_of
from torchsoro.simulation.loads import Load, attach
from torchsoro.simulation.material import Body, Prony


def courant(
    body: Body,
    prony: Prony | None,
    *,
    dt: float,
    cell: float,
    formulation: FormulationName | Formulation = "updated",
    loads: Sequence[Load] = (),
) -> Courant:
    """Courant number of a step, which is stable below one.

    - Updated form: dt / dx [(1.4 K)^2 + (1.25 mu_dt)^2]^(1/4) / sqrt(rho). The two factors are fitted to the limits of
      quadratic B-splines on a grid.
    - Total-Lagrangian form: dt / dx sqrt(9/8 max(3 K, 2 mu_dt) / rho). Near rest no body is unstable below one,
      whatever its densities, since no particle by itself is. Surfaces set the limit, where nodes have little mass: a
      lone particle reaches it, five projected random designs were stable up to 1.01 to 1.65, full cubes up to 1.4 to
      1.8, and the interior alone would be up to 1.7 to 3.0. A chamber counts with its fictitious shear
      modulus, not with its air, whose pressure is uniform.

    A Maxwell element counts in mu_dt with what the fastest oscillation, that changes sign at every step, feels of it:
    g b 2 / (1 + a), not g. In the total-Lagrangian form a viscosity eta counts likewise, with 2 eta / dt.

    Springs of stiffness k on particles of mass m add dt^2 k / (4 m) to the square of the number, for no motion of the
    nodes stretches a particle's spring by more than the nodes around it move. Drag c, which the updated form takes
    explicitly, adds dt c / (2 m); the total-Lagrangian form takes it implicitly, at any step. Contact and adhesion only
    take speed away and set no limit.

    All of this is near rest, where stiffening (``Body.stiffening``) has no part: it raises the stiffness at stretch
    only, to more than mu (1 + a x + b x^2) along the stretch. A body that is pulled far needs a smaller step, and more
    so if it stiffens: free blocks flung to a stretch of 2.5 to 2.8 in the total-Lagrangian form diverged at 0.95 and
    not at 0.6 of the limit without stiffening, at 0.4 and not at 0.25 with a = 0.1, b = 0.02.

    Args:
        body: Particles.
        prony: Maxwell elements of the solids.
        dt: Step [s].
        cell: Grid cell [m].
        formulation: Which form of the simulator.
        loads: What is attached; point masses make particles slower.

    Raises:
        ValueError: if there is no such formulation, or for bad loads.
    """
    return formulation_of(formulation).courant(attach(body, loads), prony, dt, cell)


def stable_step(
    body: Body,
    prony: Prony | None,
    *,
    cell: float,
    formulation: FormulationName | Formulation = "updated",
    loads: Sequence[Load] = (),
) -> float:
    """Largest stable step [s] of a body with its loads, by bisection (see :func:`courant`).

    Raises:
        ValueError: see :func:`courant`.
    """
    form, attached = formulation_of(formulation), attach(body, loads)
    low, high = 0.0, 1.0
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        ok = form.courant(attached, prony, middle, cell).number <= (form.limit or STABLE_COURANT)
        low, high = (middle, high) if ok else (low, middle)
    return low
