"""The operators and PyTorch's machinery: registration, compilation, transforms, second derivatives."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from problems import DT, Problem, block, constant, problem, simulator, ways
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchsoro import Prony, ground
from torchsoro.simulation.ops.scene import Inputs, scene_of

FORMS = {"apic": {"blend": 0.0}, "flip": {"blend": 1.0}, "total": {"formulation": "total"}}


def formed(*quick: str) -> pytest.MarkDecorator:
    """Parametrise a test by ``form``; all but these run with ``--slow``."""
    marks = {name: [] if name in quick else [pytest.mark.slow] for name in FORMS}
    return pytest.mark.parametrize("form", [pytest.param(FORMS[n], id=n, marks=marks[n]) for n in FORMS])


forms = formed("apic", "total")
NAMES = ("state", "weight", *(f.name for f in fields(Inputs)))


def arguments(p: Problem, keep: bool) -> tuple:
    """Arguments of ``torch.ops.torchsoro.rollout`` for a problem, whose tensors require gradients."""
    leaves = p.leaves()
    state, weight = leaves.pop("state"), leaves.pop("weight")
    inputs = Inputs(**leaves)
    return state, weight, *(getattr(inputs, name) for name in NAMES[2:]), p.scene.handle, 0, list(p.samples), keep


# ------------------------------------------------------------------------------------------------------- registration


@pytest.mark.parametrize("keep", [True, pytest.param(False, marks=pytest.mark.slow)])
@formed("total")
def test_opcheck_of_the_rollout(form, keep):
    p = problem(particles=(4, 4, 4), steps=3, samples=(0, 2), **form)
    result = torch.library.opcheck(torch.ops.torchsoro.rollout.default, arguments(p, keep))
    assert set(result.values()) == {"SUCCESS"}


@pytest.mark.parametrize("keep", [True, pytest.param(False, marks=pytest.mark.slow)])
@forms
def test_opcheck_of_the_adjoint(form, keep):
    p = problem(particles=(4, 4, 4), steps=3, samples=(0, 2), **form)
    given = [a.detach() if isinstance(a, Tensor) else a for a in arguments(p, keep)]
    results = torch.ops.torchsoro.rollout(*given)
    bars, record = [torch.ones_like(r) for r in results[:8]], results[8:]
    call = (*given[: len(NAMES)], *record, *bars, *given[len(NAMES) :], [True] * len(NAMES))
    result = torch.library.opcheck(torch.ops.torchsoro.rollout_backward.default, call)
    assert set(result.values()) == {"SUCCESS"}


def test_a_discarded_scene_is_released():
    p = problem(steps=1, samples=())
    handle = p.scene.handle
    loss = p.run(p.leaves())[0].sum()
    del p
    loss.backward()  # the graph keeps the scene
    del loss
    with pytest.raises(KeyError):
        scene_of(handle)


# -------------------------------------------------------------------------------------------------- second derivatives


def travel(scale: Tensor, way: dict) -> Tensor:
    """Sum of the centre of gravity's last position after a short fall, with moduli times the square of ``scale``."""
    _, body = block()
    soft = replace(body, shear=body.shear * scale**2)
    run = simulator(**way)(soft, duration=20 * DT, prony=Prony.paper(1), planes=[ground()])
    return 1e3 * run.center_of_gravity[-1].sum()


@pytest.mark.parametrize("outer", [lambda t: t, torch.square], ids=["linear", "square"])
@ways("apic", "total")
def test_second_derivative_raises(way, outer):
    s = torch.tensor(1.1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(outer(travel(s, way)), s, create_graph=True)
    assert bool(torch.isfinite(slope))
    with pytest.raises(RuntimeError, match=r"^second derivative through the simulator"):
        torch.autograd.grad(slope, s)


@ways("apic", "total")
def test_second_derivative_by_another_tensor_raises(way):
    # The first derivative depends on the moduli by the states alone.
    _, body = block()
    s, g = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (1.1, -9.81))
    zero = torch.zeros_like(g)
    pull = torch.stack([zero, zero, g])
    run = simulator(**way)(replace(body, shear=body.shear * s), duration=5 * DT, gravity=pull)
    (slope,) = torch.autograd.grad(run.center_of_gravity[-1].sum(), g, create_graph=True)
    with pytest.raises(RuntimeError, match=r"^second derivative through the simulator"):
        slope.backward()


# --------------------------------------------------------------------------------------------------------- transforms


warns = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # by torch itself


@warns
@pytest.mark.parametrize(
    ("transform", "name"),
    [
        (lambda f, s: torch.func.grad(f)(s), "grad"),
        (lambda f, s: torch.func.vmap(f)(s.expand(2)), "vmap"),
        (lambda f, s: torch.func.jvp(f, (s,), (torch.ones_like(s),)), "jvp"),
        (lambda f, s: torch.func.hessian(f)(s), "(grad|jvp|vmap)"),
    ],
)
@ways("apic", "total")
def test_transforms_of_torch_func_are_refused(way, transform, name):
    with pytest.raises(RuntimeError, match=rf"^torch\.func \({name}\) through the simulator: wanted torch\.autograd"):
        transform(lambda s: travel(s, way), torch.tensor(1.1, dtype=torch.float64))


@warns
@ways("apic", "total")
def test_forward_mode_is_refused(way):
    s = torch.tensor(1.1, dtype=torch.float64)
    with forward_ad.dual_level(), pytest.raises(RuntimeError, match=r"^forward-mode derivative through the simulator"):
        travel(forward_ad.make_dual(s, torch.ones_like(s)), way)


# -------------------------------------------------------------------------------------------------------- compilation


class Softened(nn.Module):
    """A network around the simulator: factor of the moduli in, deformation out."""

    def __init__(self, way: dict) -> None:
        super().__init__()
        self.body, self.pressure = block((4, 4, 6), air=True)[1], constant(300.0)
        self.simulator = simulator(**way)
        self.scale = nn.Parameter(torch.tensor(1.1, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        soft = replace(self.body, shear=self.body.shear * (self.scale * x).exp())
        run = self.simulator(soft, duration=10 * DT, pressure=self.pressure, probes=torch.tensor([0, 95]))
        return (run.position * 1e3).square().sum() + run.chamber_volume.sum()


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")  # by Dynamo itself
@pytest.mark.parametrize("backend", [pytest.param("eager", marks=pytest.mark.slow), "aot_eager"])
@ways("apic", "total")
def test_compiled_module_agrees_with_eager(way, backend):
    module, x = Softened(way), torch.tensor(0.5, dtype=torch.float64)
    wanted = module(x)
    (slope,) = torch.autograd.grad(wanted, module.scale)
    torch._dynamo.reset()
    compiled = torch.compile(module, backend=backend)
    loss = compiled(x)
    (compiled_slope,) = torch.autograd.grad(loss, module.scale)
    torch.testing.assert_close(loss, wanted, rtol=1e-14, atol=0)
    torch.testing.assert_close(compiled_slope, slope, rtol=1e-12, atol=0)
    # From the third call on nothing is compiled anew.
    compiled(x)
    frames = torch._dynamo.utils.counters["frames"]["total"]
    for _ in range(3):
        torch.testing.assert_close(compiled(x), wanted, rtol=1e-14, atol=0)
    assert torch._dynamo.utils.counters["frames"]["total"] == frames


def test_compilation_as_one_graph_is_refused_with_the_reason():
    torch._dynamo.reset()
    module = torch.compile(Softened({"formulation": "total"}), backend="eager", fullgraph=True)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="disable"):
        module(torch.tensor(0.5, dtype=torch.float64))
