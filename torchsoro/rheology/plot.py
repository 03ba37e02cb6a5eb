"""Pictures of a material and of what the simulator is given in its place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from torchsoro.rheology.budget import Budget, Material
from torchsoro.rheology.stability import moduli_over


def draw_budget(budget: Budget, materials: Sequence[Material]) -> Figure:
    """Storage and loss modulus of the full series and of what stands for it, the robot's band shaded.

    Marks at the foot are one over the elements' relaxation times, as far as they lie within five decades of the band.
    """
    low, high = budget.band
    rates = 1 / budget.times[(budget.times < 1e5 / low) & (budget.times > 1e-5 / high)]
    ends = min(low / 10, 0.3 * rates.min(initial=math.inf)), max(high * 10, 3 * rates.max(initial=0.0))
    omega = np.geomspace(*ends, 400)
    unit = budget.solid.youngs_modulus / 1e6
    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    axes = figure.subplots(1, 2)
    full = unit * moduli_over(budget.moduli, budget.times, omega)
    for i, (axis, name) in enumerate(zip(axes, ("storage", "loss"), strict=True)):
        axis.axvspan(low, high, color="0.9", zorder=0, label="the robot's band")
        axis.loglog(omega, full[i], color="k", lw=1.6, label=f"all {len(budget.moduli)} elements")
        for k, material in enumerate(materials):
            value = unit * moduli_over(material.moduli, material.times, omega, material.viscosity / budget.solid.shear)
            off = (material.storage_error, material.loss_error)[i]
            label = f"{material.name}: off by {100 * off:.2g} %"
            axis.loglog(omega, value[i], "--", color=f"C{k}", lw=1.4, label=label)
        for stable, fill in ((True, "k"), (False, "none")):
            at = [1 / e.time for e in budget.elements[1:] if e.stable == stable and 1 / e.time in rates]
            label = f"1 / relaxation time, {'' if stable else 'not '}stable at {1e6 * budget.dt:.3g} us" if at else None
            style = {"mec": "k", "mfc": fill, "ms": 5, "transform": axis.get_xaxis_transform(), "label": label}
            axis.plot(at, [0.02] * len(at), "^", **style)
        axis.set(xlabel="angular frequency [rad/s]", ylabel=f"{name} modulus in tension [MPa]")
        axis.set(xlim=(omega[0], omega[-1]), ylim=(0.5 * full[i].min(), 2 * full[i].max()))
        axis.legend(fontsize="x-small", loc="upper left")
    return figure
