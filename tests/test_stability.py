"""The largest stable step of a body with springs, drag and adhesion, in both formulations."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from problems import H, block, simulator, ways

from torchsoro import Drag, PointMass, Spring, ground, stable_step
from torchsoro.simulation.stability import STABLE_COURANT, courant

CELL = 2 * H
GROWTH = 20.0  # of the largest speed in 200 steps; beyond the limit by a twentieth it would be 1e50


def moving() -> Any:
    """A block whose particles have random velocities of about 0.1 m/s."""
    velocity = 0.1 * torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return replace(block()[1], velocity=velocity)


def speed(way: dict[str, Any], loads: tuple, dt: float | str, body: Any = None) -> float:
    """Largest speed of a particle over the first one, after 200 steps in free space."""
    body, every = body or moving(), torch.arange(64)
    if dt == "auto":
        dt = simulator(dt="auto", **way).step(body, None, duration=1.0, loads=loads)
    still = {"gravity": (0.0, 0.0, 0.0), "loads": loads, "probes": every}
    seen = simulator(dt=dt, **way)(body, duration=200 * dt, sample_every=200 * dt, **still).velocity.norm(dim=-1)
    return float(seen[-1].max() / seen[0].max())


@ways("apic", "total")
@pytest.mark.parametrize("stiffness", [1e3, 1e6, 1e9])  # N/m
def test_auto_step_is_stable_with_springs_of_any_stiffness(way, stiffness):
    loads = (Spring(particles=torch.arange(64), stiffness=stiffness),)
    assert speed(way, loads, "auto") < GROWTH


@ways("apic", "total")
@pytest.mark.parametrize("coefficient", [1.0, 1e3, 1e6])  # N s/m
def test_auto_step_is_stable_with_drag_of_any_size(way, coefficient):
    loads = (Drag(particles=torch.arange(16), coefficient=coefficient),)
    assert speed(way, loads, "auto") < GROWTH


@ways("apic", "flip", "total")
@pytest.mark.parametrize("viscosity", [1.0, 20.0, 50.0, 1e3])  # Pa s
def test_auto_step_is_stable_with_volume_viscosity_of_any_size(way, viscosity):
    thick = replace(moving(), volume_viscosity=torch.full((64,), viscosity, dtype=torch.float64))
    assert speed(way, (), "auto", thick) < GROWTH


def test_volume_viscosity_limits_the_step_of_the_updated_form():
    thick = replace(moving(), volume_viscosity=torch.full((64,), 1e3, dtype=torch.float64))
    limit = stable_step(thick, None, cell=CELL)
    assert courant(thick, None, dt=limit, cell=CELL).term == "volume viscosity"


@ways("apic", "total")
def test_limit_of_equal_stiff_springs_is_that_of_the_rigid_body_on_them(way):
    body = moving()
    form = way.get("formulation", "updated")
    loads = (Spring(particles=torch.arange(64), stiffness=1e9),)
    exact = 2 * math.sqrt(float(body.mass.sum()) / 1e9)  # symplectic Euler: omega dt = 2
    limit = stable_step(body, None, cell=CELL, formulation=form, loads=loads)
    assert limit == pytest.approx(STABLE_COURANT * exact, rel=1e-2)
    assert courant(body, None, dt=limit, cell=CELL, formulation=form, loads=loads).term == "springs"
    with pytest.raises(ValueError, match="set by springs"):
        speed(way, loads, 1.05 * limit)


@ways("apic", "total")
def test_point_mass_on_a_stiff_spring_allows_a_longer_step(way):
    form = way.get("formulation", "updated")
    spring = Spring(particles=torch.tensor([0]), stiffness=1e6)
    bare = stable_step(moving(), None, cell=CELL, formulation=form, loads=(spring,))
    mass = PointMass(particles=torch.tensor([0]), mass=1.0)
    assert stable_step(moving(), None, cell=CELL, formulation=form, loads=(spring, mass)) > 2 * bare


def test_drag_limits_the_step_of_the_updated_form_only():
    body, loads = moving(), (Drag(particles=torch.arange(64), coefficient=1e4),)
    free = {form: stable_step(body, None, cell=CELL, formulation=form) for form in ("updated", "total")}
    limit = {form: stable_step(body, None, cell=CELL, formulation=form, loads=loads) for form in ("updated", "total")}
    assert limit["total"] == free["total"]
    assert limit["updated"] == pytest.approx(STABLE_COURANT**2 * 2 * float(body.mass.sum()) / 1e4, rel=1e-2)
    assert courant(body, None, dt=limit["updated"], cell=CELL, loads=loads).term == "drag"


@ways("apic", "total")
def test_adhesion_of_any_size_leaves_the_auto_step_stable(way):
    body = replace(moving(), position=moving().position + torch.tensor([0.0, 0.0, 1e-4], dtype=torch.float64))
    plane = replace(ground(friction=0.5), adhesion=1e9)
    seen = simulator(dt="auto", **way)(body, duration=0.02, planes=[plane], probes=torch.arange(64))
    assert float(seen.velocity.norm(dim=-1).max()) < GROWTH * float(seen.velocity[0].norm(dim=-1).max())
