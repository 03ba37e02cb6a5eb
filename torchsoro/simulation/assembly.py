"""From a body and its loads to the tensors of the operator, with the checks of every argument."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchsoro.errors import refuse_gradients
from torchsoro.simulation.actuation import Waveform
from torchsoro.simulation.attachment import load_tensors
from torchsoro.simulation.checkpoints import MEMORY
from torchsoro.simulation.contact import Plane
from torchsoro.simulation.kernels import layout
from torchsoro.simulation.loads import Attached, vectors_at
from torchsoro.simulation.material import Body
from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.ops.scene import Inputs, Scene

Wide = Callable[[Tensor, int], Tensor]
"""From a tensor and the number of its axes that are not a batch to the same tensor with one batch axis [B, ...]."""


def assemble(
    attached: Attached,
    *,
    prony: Tensor,
    pressure: Tensor,
    gravity: Tensor,
    planes: Sequence[Plane],
    forces: Sequence[Tensor],
    weight: Tensor,
    low: tuple[float, float, float],
    others: Sequence[tuple[Tensor, int]] = (),
) -> tuple[torch.Size, Inputs, Wide]:
    """Broadcast all arguments of a call to one batch.

    Args:
        attached: The body with its loads.
        prony: Maxwell elements [..., M, 3].
        pressure: [..., chambers, T + 1] Pa.
        gravity: [..., T, 3] m/s2.
        planes: Contact planes.
        forces: [..., T, 3] or [..., 1, 3] N each.
        weight: [..., N].
        low: Lower corner of the analysis box [m].
        others: Further tensors whose leading axes count, with the number of axes that are not a batch.

    Returns:
        The leading axes, the operator's inputs, and the function that broadcasts a tensor likewise.

    Raises:
        ValueError: if the leading axes do not broadcast against each other.
    """
    x = attached.body.position
    numbers = [[torch.as_tensor(n, dtype=x.dtype, device=x.device) for n in plane.numbers()] for plane in planes]
    ranks = [(x, 2), (prony, 2), (pressure, 2), (gravity, 2), (weight, 1), *((f, 2) for f in forces)]
    ranks += [(n, 0) for plane in numbers for n in plane]
    ranks += [*body_tensors(attached), *load_tensors(attached), *others]
    leads = [tuple(t.shape[: t.ndim - rank]) for t, rank in ranks]
    try:
        lead = torch.Size(np.broadcast_shapes(*leads))  # that of torch imports sympy first
    except ValueError:
        seen = ", ".join(map(str, sorted({axes for axes in leads if axes})))
        raise ValueError(f"leading axes {seen}: wanted batches that broadcast against each other") from None
    batch, steps = math.prod(lead), gravity.shape[-2]

    def wide(t: Tensor, rank: int) -> Tensor:
        tail = t.shape[t.ndim - rank :]
        return t.expand((*lead, *tail)).reshape((batch, *tail))

    plane_rows = [torch.stack([wide(n, 0) for n in plane], -1) for plane in numbers]
    all_planes = torch.stack(plane_rows, 1) if planes else x.new_zeros(batch, 0, layout.PLANE)
    all_forces = [wide(f, 2).transpose(0, 1) for f in forces]
    # A grid node of each simulation: on the first plane of each axis, else at the lower corner of the box.
    origin = []
    for axis in range(3):
        first = next((i for i, plane in enumerate(planes) if plane.axis == axis), None)
        origin.append(x.new_full((batch,), low[axis]) if first is None else all_planes[:, first, layout.PLANE_OFFSET])
    inputs = Inputs(
        coefficients=coefficients(attached, wide),
        prony=wide(prony, 2),
        pressure=wide(pressure, 2).permute(2, 0, 1),
        gravity=wide(gravity, 2).transpose(0, 1),
        force=torch.stack(all_forces, 2) if forces else x.new_zeros(steps, batch, 0, 3),
        planes=all_planes,
        origin=torch.stack(origin, -1),
    )
    return lead, inputs, wide


def on_lattice(
    scene: Scene, whole: Inputs, x: Tensor, velocity: Tensor, weight: Tensor, lattice: Lattice
) -> tuple[Scene, Inputs, Tensor, Tensor, Tensor]:
    """From particles to the points of their lattice, in all data by particle."""
    offset = (x - x[:1]).detach()
    if bool(((offset - offset[:, :1]).abs() > 1e-3 * scene.cell).any()):
        raise ValueError(
            "body.position: simulations of a batch whose bodies differ by more than a shift, wanted the same lattice "
            "for the total-Lagrangian formulation"
        )
    if lattice.index is None:
        return replace(scene, lattice=lattice), whole, x, velocity, weight

    def vectors(t: Tensor) -> Tensor:
        return lattice.spread(t.transpose(-1, -2)).transpose(-1, -2)

    absent = torch.full((lattice.count,), layout.ABSENT, dtype=torch.int32, device=x.device)
    index = lattice.index
    scene = replace(
        scene,
        lattice=lattice,
        kind=absent.index_copy(0, index, scene.kind),
        share=lattice.spread(scene.share),
        probes=index[scene.probes],
    )
    whole = replace(whole, coefficients=lattice.spread(whole.coefficients))
    return scene, whole, vectors(x), vectors(velocity), lattice.spread(weight)


def body_tensors(attached: Attached) -> list[tuple[Tensor, int]]:
    """Tensors of a body with loads, with the number of axes that are not a batch."""
    body = attached.body
    flat = (body.mass, body.volume, body.bulk, body.shear, body.viscosity, body.volume_viscosity, body.void_fraction)
    flat += (body.air_share, body.share_stiffness)
    pairs = [(t, 1) for t in (*flat, attached.spring, attached.drag) if t is not None]
    return pairs + [(t, 2) for t in (body.velocity, body.stiffening, attached.anchor) if t is not None]


def coefficients(attached: Attached, wide: Wide) -> Tensor:
    """Particle coefficients [B, COEFFICIENTS, N]; ``wide`` broadcasts a tensor over the batch."""
    body = attached.body
    zero = torch.zeros_like(body.volume)
    anchor = torch.zeros_like(body.position) if attached.anchor is None else attached.anchor
    stiffening = (zero, zero) if body.stiffening is None else body.stiffening.unbind(-1)
    rows: list[Tensor] = [torch.empty(0)] * layout.COEFFICIENTS
    for place, values in (
        (layout.MASS, body.mass),
        (layout.VOLUME, body.volume),
        (layout.BULK, body.bulk),
        (layout.SHEAR, body.shear),
        (layout.VISCOSITY, body.viscosity),
        (layout.VOLUME_VISCOSITY, body.volume_viscosity),
        (layout.SPRING, attached.spring),
        (layout.DRAG, attached.drag),
        (layout.VOID_FRACTION, body.void_fraction),
        (layout.STIFFENING, stiffening[0]),
        (layout.STIFFENING + 1, stiffening[1]),
        (layout.AIR_SHARE, body.air_share),
        (layout.AIR_STIFFNESS, body.share_stiffness),
    ):
        rows[place] = wide(zero if values is None else values, 1)
    for c in range(3):
        rows[layout.ANCHOR + c] = wide(anchor[..., c], 1)
    return torch.stack(rows, 1)


def supply_at(body: Body, hollow: int, pressure: Waveform | None, times: Tensor) -> Tensor:
    """Supply pressure [..., chambers, T + 1] of the chambers of particles, and of the hollow ones."""
    chambers = int(body.chamber.max()) + 1 + hollow
    if pressure is None:
        return times.new_zeros(chambers, len(times))
    values = pressure.at(times.to(pressure.time))
    if values.ndim == 1:
        values = values.unsqueeze(0)
    if values.shape[-2] != chambers:
        raise ValueError(f"pressure: {values.shape[-2]} chambers, wanted the body's {chambers}")
    return values


def gravity_at(gravity, times: Tensor) -> Tensor:
    """Gravity at each substep [..., T, 3]."""
    if isinstance(gravity, tuple) and len(gravity) == 2 and all(isinstance(g, Tensor) for g in gravity):
        values = vectors_at("gravity", *gravity, times)
    else:
        constant = gravity if isinstance(gravity, Tensor) else torch.as_tensor(gravity, dtype=times.dtype)
        if constant.shape[-1:] != (3,):
            raise ValueError(f"gravity: shape {tuple(constant.shape)}, wanted [..., 3]")
        values = constant.unsqueeze(-2).expand(*constant.shape[:-1], len(times), 3)
    if not bool(torch.isfinite(values.detach()).all()):
        raise ValueError(f"gravity = {gravity}: wanted finite numbers")
    return values


def check_body(body: Body) -> None:
    """Refuse a body of wrong shapes, precision, device or values."""
    x = body.position
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"body.position: dtype {x.dtype}, wanted float32 or float64")
    if x.device.type not in MEMORY or (x.is_cuda and x.dtype != torch.float32):
        raise ValueError(f"body.position: {x.dtype} on {x.device}, wanted float32 on cuda, or either precision on cpu")
    if x.ndim < 2:
        raise ValueError(f"body.position: shape {tuple(x.shape)}, wanted [..., N, 3]")
    count = x.shape[-2]
    if body.chamber.shape != (count,):
        raise ValueError(f"body.chamber: shape {tuple(body.chamber.shape)}, wanted [{count}]")
    numbers = torch.unique(body.chamber)
    given = numbers[numbers >= 0]
    if int(numbers[0]) < -1 or len(given) <= int(numbers[-1]):
        raise ValueError(
            f"body.chamber: numbers {numbers.tolist()}, wanted -1 for a solid, and of chambers 0 to one less "
            "than their count"
        )
    for name in (
        "position",
        "velocity",
        "mass",
        "volume",
        "bulk",
        "shear",
        "viscosity",
        "volume_viscosity",
        "void_fraction",
        "drag",
        "stiffening",
        "air_share",
        "share_stiffness",
    ):
        value = getattr(body, name)
        if value is None:
            continue
        if value.dtype != x.dtype or value.device != x.device:
            raise ValueError(f"body.{name}: {value.dtype} on {value.device}, wanted {x.dtype} on {x.device}")
        vector = name in ("position", "velocity", "stiffening")
        tail = (count, 2 if name == "stiffening" else 3) if vector else (count,)
        if tuple(value.shape[-len(tail) :]) != tail:
            raise ValueError(f"body.{name}: shape {tuple(value.shape)}, wanted [..., {', '.join(map(str, tail))}]")
        finite = torch.isfinite(value.detach())
        least = value.detach() > 0 if name in ("mass", "volume") else value.detach() >= 0
        if not bool((finite if vector else finite & least).all()):
            wanted = "finite" if vector else f"finite and {'positive' if name in ('mass', 'volume') else 'at least 0'}"
            bad = value.detach()[~(finite if vector else finite & least)][0]
            raise ValueError(f"body.{name}: value {float(bad)}, wanted {wanted}")
    for name, value, least in (("softening", body.softening, "depth"), ("air_stiffness", body.air_stiffness, "")):
        if value is None:
            continue
        if value.dtype != x.dtype or value.device != x.device or (least and value.shape[-1:] != (2,)):
            raise ValueError(
                f"body.{name}: {value.dtype} {tuple(value.shape)} on {value.device}, wanted {x.dtype} "
                f"[..., {'2' if least else 'hollow chambers'}] on {x.device}"
            )
        if not bool((torch.isfinite(value.detach()) & (value.detach() >= 0)).all()):
            raise ValueError(f"body.{name} = {value.tolist()}: wanted finite and at least 0")
    if body.softening is not None and not bool((body.softening.detach()[..., 1] > 0).all()):
        raise ValueError("body.softening: a range of 0, wanted positive ranges")
    if body.share_stiffness is not None and body.air_share is None:
        raise ValueError("body.share_stiffness: given without body.air_share, wanted both")
    if body.air_share is not None:
        share = body.air_share.detach()
        if bool((share > 1).any()) or bool((share[..., body.chamber < 0] > 0).any()):
            raise ValueError(
                f"body.air_share: up to {float(share.max())}, wanted 0 to 1, and 0 where body.chamber names no chamber"
            )
    void = body.void_fraction
    if void is not None and void.is_leaf and void.requires_grad and bool((void.detach()[..., ~body.gas] == 1).any()):
        raise ValueError(
            "body.void_fraction: exactly 1 with a gradient, which is not computed there, wanted less than 1"
        )


def check_weight(weight: Tensor, count: int) -> Tensor:
    """Refuse weights [..., N] that are not finite or all zero."""
    if weight.shape[-1:] != (count,):
        raise ValueError(f"weight: shape {tuple(weight.shape)}, wanted [..., {count}]")
    if not bool(torch.isfinite(weight.detach()).all() & (weight.detach().sum(-1) > 0).all()):
        raise ValueError("weight: not finite or all zero, wanted finite numbers with a positive sum")
    return weight


def check_start(start: object, inputs: Inputs, wanted: tuple[int, ...], formulation: str) -> Tensor:
    """Refuse a state to start from that is not one of this body and formulation, of the shape ``wanted``."""
    if not isinstance(start, Tensor):
        raise ValueError(f"start: {type(start).__name__}, wanted a Trajectory or its final state, or a Start")
    like, elements = inputs.coefficients, inputs.prony.shape[1]
    if tuple(start.shape) != wanted:
        raise ValueError(
            f"start: a state of shape {tuple(start.shape)}, wanted {wanted}, as for {wanted[0]} simulation(s) of this "
            f"body with {elements} Maxwell elements in the {formulation!r} formulation"
        )
    if start.dtype != like.dtype or start.device != like.device:
        raise ValueError(
            f"start: {start.dtype} on {start.device}, wanted {like.dtype} on {like.device} as body.position"
        )
    if not bool(torch.isfinite(start.detach()).all()):
        raise ValueError("start: a state with values that are not finite, wanted finite numbers")
    return start


def check_probes(probes: Tensor, count: int) -> None:
    """Refuse probes that are not indices of particles, nor places."""
    if probes.is_floating_point():
        if probes.ndim != 2 or probes.shape[1] != 3 or not bool(torch.isfinite(probes).all()):
            raise ValueError(f"probes: places of shape {tuple(probes.shape)}, wanted finite places [P, 3] m")
        refuse_gradients(probes=probes)
        return
    if probes.dtype != torch.int64 or probes.ndim != 1:
        raise ValueError(f"probes: {probes.dtype} of shape {tuple(probes.shape)}, wanted int64 [P]")
    if len(probes) and (int(probes.min()) < 0 or int(probes.max()) >= count):
        raise ValueError(f"probes: {int(probes.min())} to {int(probes.max())}, wanted 0 to {count - 1}")
