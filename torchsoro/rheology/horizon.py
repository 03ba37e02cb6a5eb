"""Equilibrium modulus for the simulator from a spectrum without one: terms slower than a horizon become permanent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from torchsoro.rheology.measured import Creep, Relaxation, Sweep
from torchsoro.rheology.spectrum import Spectrum, fit
from torchsoro.rheology.terminal import Flow, terminal_flow

SEEN = 0.3  # longest relaxation time distinguishable from the equilibrium modulus, over the longest time of the data


@dataclass(frozen=True, kw_only=True, eq=False)
class Solidified:
    """Relaxation spectrum with a positive equilibrium modulus.

    Attributes:
        spectrum: Fitted spectrum, in which the equilibrium modulus includes the terms slower than the horizon.
        remark: Modulus treated as permanent and the neglected loss modulus, in words; empty if none.
        flow: Terminal flow of the curve, None if there is none.
    """

    spectrum: Spectrum
    remark: str
    flow: Flow | None


def solidified(
    curve: Sweep | Relaxation | Creep,
    *,
    horizon: float,
    lowest: float,
    elements: int | Literal["auto"] = "auto",
    equilibrium: float | None = None,
) -> Solidified:
    """Fit a spectrum and add elements slower than the horizon, or than the data reach, to the equilibrium modulus.

    A curve that ends in flow is fitted without an equilibrium modulus. Elements within the horizon are kept as fitted,
    with their intervals.

    Args:
        curve: Measured curve or master curve.
        horizon: Longest simulated time [s].
        lowest: Lowest angular frequency of the simulated motions [rad/s], for the remark.
        elements: As for :func:`torchsoro.rheology.spectrum.fit`.
        equilibrium: Fixed equilibrium modulus from another test [Pa]; not for creep.

    Raises:
        ValueError: if the modulus at the horizon is zero, and as for ``fit``.
    """
    flow = terminal_flow(curve)
    told = flow.sentence if flow else ""
    if equilibrium is not None:
        if isinstance(curve, Creep):
            raise ValueError(f"equilibrium = {equilibrium:g}: wanted none with creep tests, whose fit finds it")
        spectrum = fit(curve, elements=elements, equilibrium=equilibrium)
        held = f"The equilibrium modulus of {equilibrium / 1e6:.3g} MPa is the one given. " if flow else ""
        return Solidified(spectrum=spectrum, remark=told + held, flow=flow)
    found = fit(curve, elements=elements, equilibrium=flow is None)
    known = found.equilibrium_interval
    ended = found.equilibrium > 0 and (known is None or known.low > 0)
    reached = 1 / curve.omega[0] if isinstance(curve, Sweep) else curve.time[-1]
    longest = min(horizon, reached)
    slow = found.times > (SEEN * longest if longest == reached else longest)
    if ended and not slow.any():
        return Solidified(spectrum=found, remark="", flow=None)
    modulus = found.equilibrium + float(found.moduli[slow].sum())
    if not modulus > 0:
        raise ValueError(
            f"the material flows, with no modulus left after {longest:.2g} s; wanted a solid, its equilibrium "
            f"modulus by --equilibrium, or a --horizon below the longest relaxation time, "
            f"{found.times[-1]:.2g} s. {told}".rstrip()
        )
    spectrum = replace(
        found,
        equilibrium=modulus,
        moduli=found.moduli[~slow],
        times=found.times[~slow],
        equilibrium_interval=None,
        intervals=tuple(i for i, late in zip(found.intervals, slow, strict=bool(found.intervals)) if not late),
    )
    remark = f"{told}The modulus left after {longest:.2g} s, {modulus / 1e6:.3g} MPa, counts as permanent. "
    if flow:
        remark += (
            f"Motions of up to {longest:.2g} s are simulated as measured; under a lasting load the simulated body "
            "comes to rest where the real one flows. "
        )
    full, kept = (float(s.storage_loss(np.array(lowest))[1]) for s in (found, spectrum))
    if full - kept > 0.01 * full:
        remark += (
            f"At {lowest:.3g} rad/s, the lowest frequency asked for, that neglects {1 - kept / full:.0%} of the loss "
            "modulus: a longer --horizon keeps it. "
        )
    return Solidified(spectrum=spectrum, remark=remark, flow=flow)
