"""The simulator against closed forms, and its two formulations against each other, one table per check.

    python recipes/validate/simulator.py damping      # numerical damping of a cantilever by formulation, step and cell
    python recipes/validate/simulator.py bar          # frequency of a cantilever against a Timoshenko beam
    python recipes/validate/simulator.py creep        # a bar that is held bent: positions part from F
    python recipes/validate/simulator.py sphere       # pressurised thick sphere against Lame's solution
    python recipes/validate/simulator.py rheology     # Maxwell elements against Eq. 17 and a shear ramp
    python recipes/validate/simulator.py restitution  # rebound of a dropped block with 0, 3 and 5 Maxwell elements
    python recipes/validate/simulator.py ball         # the paper's ball drop (Fig. S9) with 0 to 5 Maxwell elements
    python recipes/validate/simulator.py contact      # a block at rest, and sliding, against Coulomb's law
    python recipes/validate/simulator.py stability    # the step at which noise grows or an impact fails
    python recipes/validate/simulator.py fall         # free flight: path, momentum, angular momentum
    python recipes/validate/simulator.py walking      # one walker in both formulations as the cell shrinks
    python recipes/validate/simulator.py all --out runs/validation    # everything, with figures; 15 minutes

Forms are "apic" and "flip", the two transfers of the updated formulation, and "total", the total-Lagrangian one. The
functions return their rows, so that tests call them on smaller settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
import tyro
from contact_checks import Curve, ball_drop, couple, first_blow, restitution, sliding, standing
from creep import creep
from motion_checks import PAPER_STEP, fall, ramp, rheology, stability
from structures import EXACT, FORMS, bar, damping, shifted, sphere
from tables import Row, show
from walking_checks import orders, walking

from torchsoro import Prony


def _figure(path: Path, panels: Sequence[tuple[str, str]]) -> tuple[Any, list[Any]]:
    figure, axes = plt.subplots(1, len(panels), figsize=(4.6 * len(panels), 3.6), layout="constrained", squeeze=False)
    for axis, (x, y) in zip(axes[0], panels, strict=True):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    return lambda: (figure.savefig(path, dpi=150), plt.close(figure), print(f"wrote {path}")), list(axes[0])


def draw_restitution(path: Path, curves: Sequence[Curve]) -> None:
    """Velocity of the centre of gravity; one panel for each size of cube."""
    edges = sorted({c[2] for c in curves})
    save, axes = _figure(path, [("time [ms]", "velocity of the centre of gravity [m/s]")] * len(edges))
    styles = dict(zip(dict.fromkeys(c[0] for c in curves), ("-", "--", ":"), strict=False))
    colors = {count: f"C{i}" for i, count in enumerate(sorted({c[1] for c in curves}))}
    for axis, edge in zip(axes, edges, strict=True):
        for form, count, _, t, _, velocity in (c for c in curves if c[2] == edge):
            label = f"{form}, {count} elements: {-velocity[-1] / velocity[0]:.2f}"
            axis.plot(t, velocity, styles[form], color=colors[count], label=label)
        axis.axhline(0, color="k", lw=0.6)
        axis.legend(title=f"{edge:.3g} mm cube, restitution", loc="lower right", fontsize="small")
    save()


def draw_ball(path: Path, curves: Sequence[Curve]) -> None:
    """Height of the ball's centre over time, a panel for each form."""
    forms = sorted({c[0] for c in curves}, reverse=True)
    save, axes = _figure(path, [("time [s]", "height of the centre [mm]")] * len(forms))
    for form, count, _, instants, height, _ in curves:
        axis = axes[forms.index(form)]
        axis.plot(instants / 1e3, height, label=f"{count} elements" if count else "elastic")
        axis.set_title({"total": "total-Lagrangian", "apic": "updated, 10 us"}.get(form, form), fontsize=10)
    axes[0].legend(fontsize="small")
    save()


def draw_rheology(path: Path) -> None:
    """Storage and loss modulus of the recursion (dots) and of Eq. 17 (lines)."""
    save, axes = _figure(
        path, [("omega [rad/s]", "storage modulus / equilibrium"), ("omega [rad/s]", "loss modulus / equilibrium")]
    )
    omega = torch.logspace(0, 4, 200, dtype=EXACT)
    for i, count in enumerate((3, 5)):
        rows = rheology([(count, PAPER_STEP)], torch.logspace(0, 4, 17).tolist())
        for axis, line, column in zip(axes, Prony.paper(count).storage_loss(omega), ("G'", 'G"'), strict=True):
            axis.loglog(omega, line, color=f"C{i}", lw=1, label=f"Eq. 17, {count} elements")
            axis.plot(
                [r["omega [rad/s]"] for r in rows],
                [r[column] for r in rows],
                "o",
                ms=4,
                color=f"C{i}",
                label="recursion, dt = 10 us",
            )
            axis.legend(fontsize="small")
    save()


def draw_bar(path: Path, rows: Sequence[Row]) -> None:
    """Frequency over the number of cells."""
    save, (axis,) = _figure(path, [("cells across", "frequency / Timoshenko")])
    for i, (form, nu) in enumerate(sorted({(r["form"], r["nu"]) for r in rows})):
        mine = [r for r in rows if (r["form"], r["nu"]) == (form, nu)]
        ratios = [1 + r["error [%]"] / 100 for r in mine]
        axis.plot([r["cells"] for r in mine], ratios, "o-", color=f"C{i}", label=f"{form}, nu = {nu}")
    axis.axhspan(0.97, 1.03, color="k", alpha=0.07, label="3 %")
    axis.set_xticks(sorted({r["cells"] for r in rows}))
    axis.legend(fontsize="small")
    save()


def draw_walking(path: Path, rows: Sequence[Row], courses: Mapping[tuple[int, str], Row]) -> None:
    """Trajectory of the centre of gravity, and differences over the cell."""
    axes: list[Any]
    panels = [(f"time [ms], {n} particles along the edge", "forward (-), up (--) [mm]") for n, _ in courses]
    save, axes = _figure(path, [*dict.fromkeys(panels), ("cell [mm]", "largest difference of the c.o.g. [mm]")])
    for axis, n in zip(axes, dict.fromkeys(n for n, _ in courses), strict=False):
        for i, form in enumerate(f for m, f in courses if m == n):
            course = courses[n, form]
            way = 1e3 * (course["center"] - course["center"][0])
            t = 1e3 * (course["time"] - course["settle"])
            axis.plot(t, way[:, 0], color=f"C{i}", label=form)
            axis.plot(t, way[:, 2], "--", color=f"C{i}")
        axis.legend(fontsize="small")
    for what in dict.fromkeys(r["what"] for r in rows):
        mine = [r for r in rows if r["what"] == what]
        axes[-1].loglog([r["cell [mm]"] for r in mine], [r["c.o.g. [mm]"] for r in mine], "o-", label=what)
    axes[-1].legend(fontsize="small")
    save()


# fmt: off
Check = Literal[
    "damping", "bar", "creep", "sphere", "rheology", "restitution",
    "ball", "contact", "stability", "fall", "walking", "all",
]
# fmt: on


def main(check: tyro.conf.Positional[Check], out: Path | None = None) -> None:
    """Validate the simulator against closed forms, and its formulations against each other.

    Args:
        check: What to validate.
        out: Folder for figures; none are drawn without it.
    """
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)

    def wanted(name: str) -> bool:
        return check in (name, "all")

    if wanted("fall"):
        show("Free flight of a spinning cube, 40 ms: relative errors", fall())
    if wanted("rheology"):
        show("Moduli of the discrete Maxwell elements, over the equilibrium modulus, against Eq. 17", rheology())
        show("History in the kernel after 0.3 s of steady shear", ramp())
        if out is not None:
            draw_rheology(out / "rheology.png")
    if wanted("sphere"):
        show("Thick sphere, 200 Pa, against Lame", [row for form in ("flip", "total") for row in sphere(form=form)])
    if wanted("restitution"):
        rows, curves = restitution()
        show("Cube dropped at 4 m/s, cell 1.75 mm, dt = 10 us", rows)
        if out is not None:
            draw_restitution(out / "restitution.png", curves)
    if wanted("ball"):
        drops = [ball_drop(), ball_drop((0, 3, 5), ("apic",))]
        show("Ball of 15 mm dropped from 50 mm", [row for rows, _ in drops for row in rows])
        if out is not None:
            draw_ball(out / "ball.png", [curve for _, curves in drops for curve in curves])
    if wanted("contact"):
        show("Energy that an elastic 30 mm cube loses at its first blow on the ground", first_blow())
        show("Rotation of a free bar by a couple at its ends, total form", couple())
        show("Centre of a viscous 30 mm block at rest on smooth ground, against H/2 - rho g H^2 / (3 E)", standing())
        show("30 mm block, three Maxwell elements, slides to rest from 1 m/s, against v^2 / (2 mu g)", sliding())
        show("The same on a shifted grid", sliding((6,), shifts=(0.25, 0.5, 0.75)))
        show("The same, elastic: friction excites it", sliding((6,), forms=FORMS, elements=0))
    if wanted("bar"):
        rows, found = bar()
        show("Cantilever 100 x 20 x 20 mm, against a Timoshenko beam of its free length", rows)
        print("\n".join(f"order of the error at nu = 0, {form}: {order:.2f}" for form, order in found.items()))
        if out is not None:
            draw_bar(out / "bar.png", rows)
    if wanted("creep"):
        show("Bar of 60 x 10 x 10 mm held bent by 0.25 N", creep())
    if wanted("walking"):
        rows, apart, courses = walking()
        show("One cycle of a walker", rows)
        show("Largest difference over the cycle, in percent of the longest way of a followed point", apart)
        print("\n".join(f"order in the cell of the c.o.g., {what}: {o:.2f}" for what, o in orders(apart).items()))
        if out is not None:
            draw_walking(out / "walking.png", apart, courses)
    if wanted("stability"):
        show("Largest stable step, cell 1.75 mm", stability())
    if wanted("damping"):
        show("Damping ratio of an elastic cantilever 100 x 30 x 30 mm, 264 kPa (true: 0)", damping())
        show("The same on grids that are shifted across the bar, 3 cells, 131 us", shifted())


if __name__ == "__main__":
    tyro.cli(main)
