"""The operator: gradients by every tensor, reproducibility, refused arguments."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from problems import TENSORS, Problem, problem
from torch import Tensor

from torchsoro.simulation.kernels import backward, forward, layout, total, total_adjoint
from torchsoro.simulation.ops.rollout import rollout
from torchsoro.simulation.ops.scene import Inputs

HERE = Path(__file__).parent
FORMS = {"apic": {"blend": 0.0}, "mixed": {"blend": 0.7}, "flip": {"blend": 1.0}, "total": {"formulation": "total"}}


def forms(*names: str):
    """Parametrise a test by what :func:`problem` takes for each of these names."""
    return pytest.mark.parametrize("form", [FORMS[name] for name in names], ids=names)


def combined(outputs: tuple[Tensor, ...], seed: int = 5) -> Tensor:
    """One number to which every output contributes."""
    g = torch.Generator().manual_seed(seed)
    return sum(
        ((o * torch.randn(o.shape, generator=g, dtype=torch.float64).to(o)).sum() for o in outputs), torch.zeros(())
    )


def gradients(p: Problem, *, keep: bool = True) -> dict[str, Tensor]:
    leaves = p.leaves()
    grads = torch.autograd.grad(combined(p.run(leaves, keep=keep)), list(leaves.values()))
    found = dict(zip(leaves, grads, strict=True))
    if p.scene.lattice is not None:
        assert not found.pop("origin").any()  # the lattice moves with the body: there is no other grid
    return found


def check(p: Problem, *names: str, unused: bool = False) -> bool:
    """Gradients of each output by each of some tensors along a random direction.

    They are so strict that a single wrong entry is seen; which tensor it is of is told by its number in their order.
    With ``unused`` also those of each output where the others are not used, which takes as long again.
    """
    tensors = tuple(p.tensors[n].clone().requires_grad_() for n in names)

    def outputs(*t):
        replaced = {n: p.smooth(n, x) for n, x in zip(names, t, strict=True)}
        return [o for o in p.run(replaced) if o.numel()]

    return torch.autograd.gradcheck(outputs, tensors, fast_mode=True, rtol=1e-5, atol=1e-8, check_undefined_grad=unused)


def close(a: dict[str, Tensor], b: dict[str, Tensor], tolerance: float) -> None:
    for name in a:
        scale = float(b[name].abs().max())
        assert scale > 0, name
        worst = float((a[name] - b[name]).abs().max()) / scale
        assert worst <= tolerance, f"{name}: {worst}"


# ------------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("stick", [False, True])
@forms("apic", "flip", "mixed", "total")
def test_gradcheck_by_every_tensor(form, stick):
    # The whole of a body of 64 particles.
    assert check(problem(batch=2, stick=stick, **form), *TENSORS, unused=True)


@pytest.mark.parametrize("elastic", [0, 1])
def test_gradcheck_with_oblique_planes_that_pull_from_afar(elastic):
    p = problem(batch=2, formulation="total")
    g = torch.Generator().manual_seed(4)
    normal = p.tensors["planes"][..., layout.PLANE_NORMAL : layout.PLANE_NORMAL + 3]
    # What lies far behind a plane that keeps energy is thrown off.
    normal += (0.01 if elastic else 0.2) * torch.randn(normal.shape, generator=g, dtype=torch.float64)
    normal /= normal.norm(dim=-1, keepdim=True)
    p.tensors["planes"][..., layout.PLANE_REACH] = 0.3
    p.scene.plane_kind[:, layout.PLANE_AXIS] = -1
    p.scene.plane_kind[:, layout.PLANE_ELASTIC] = elastic
    assert check(p, "coefficients", "planes", "state")


@pytest.mark.slow
@forms("mixed", "total")
def test_gradcheck_of_every_entry(form):
    # The full Jacobian by all nine tensors, so that no error can hide in a sum.
    particles = (2, 2, 2) if form == FORMS["total"] else (2, 2, 3)
    p = problem(particles=particles, elements=1, steps=2, stick=True, samples=(0, 2), **form)
    leaves = p.leaves()

    def outputs(*tensors):
        return p.run({n: p.smooth(n, t) for n, t in zip(leaves, tensors, strict=True)})

    assert torch.autograd.gradcheck(outputs, tuple(leaves.values()), rtol=1e-4, atol=1e-6, check_undefined_grad=False)


@forms("apic", "total")
@pytest.mark.parametrize("elements", [0, 1, 5])
def test_gradcheck_with_other_numbers_of_maxwell_elements(elements, form):
    assert check(problem(elements=elements, **form), "state", "coefficients", *(["prony"] if elements else []))


@forms("apic", "mixed", "total")
def test_gradcheck_of_a_bare_body(form):
    # Without planes, forces, springs, viscosity and chambers the kernels get placeholders for empty tensors.
    p = problem(**form)
    p.scene = replace(
        p.scene,
        springs=False,
        drags=False,
        viscous=False,
        stiffens=False,
        share=p.scene.share[:0],
        plane_kind=p.scene.plane_kind[:0],
        kind=p.scene.kind.clamp(max=-1),
    )
    for row in (layout.SPRING, layout.VISCOSITY, layout.VOLUME_VISCOSITY, layout.STIFFENING, layout.STIFFENING + 1):
        p.tensors["coefficients"][:, row] = 0
    p.tensors["force"], p.tensors["planes"] = p.tensors["force"][:, :, :0], p.tensors["planes"][:, :0]
    p.tensors["pressure"] = p.tensors["pressure"][..., :0]
    assert check(p, "state", "coefficients", "gravity")


@forms("apic", "total")
def test_every_output_has_a_gradient_by_the_state(form):
    p = problem(**form)
    leaves = p.leaves()
    # There are no deformation gradients of particles.
    for k, output in enumerate(o for o in p.run(leaves) if o.numel()):
        grads = torch.autograd.grad(output.sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
        by_state = grads[list(leaves).index("state")]
        assert by_state is not None and bool(by_state.any()), k
        assert all(bool(torch.isfinite(g).all()) for g in grads if g is not None)


@forms("mixed", "total")
def test_backward_accumulates_once_each_time(form):
    p = problem(batch=2, **form)
    once = gradients(p)
    leaves = p.leaves()
    for _ in range(2):
        combined(p.run(leaves)).backward()
    for name in once:
        grad = leaves[name].grad
        assert grad is not None
        assert torch.equal(grad, 2 * once[name]), name
    # A graph that is kept can be gone back along again, although the kept states were freed.
    leaves = p.leaves()
    loss = combined(p.run(leaves))
    loss.backward(retain_graph=True)
    loss.backward()
    for name in once:
        grad = leaves[name].grad
        assert grad is not None
        assert torch.equal(grad, 2 * once[name]), name


@forms("apic", "total")
def test_gradient_reaches_the_leaves_behind_the_inputs(form):
    p = problem(**form)
    once = gradients(p)
    seeds = {name: (t / 2).requires_grad_() for name, t in p.tensors.items()}
    combined(p.run({name: 2 * t for name, t in seeds.items()})).backward()
    for name, grad in once.items():
        by_seed = seeds[name].grad
        assert by_seed is not None
        torch.testing.assert_close(by_seed, 2 * grad, rtol=1e-12, atol=1e-12)


@forms("apic", "total")
def test_inputs_are_not_modified(form):
    p = problem(**form)
    copies = {name: t.clone() for name, t in p.tensors.items()}
    gradients(p)
    assert all(torch.equal(copies[name], t) for name, t in p.tensors.items())


@forms("mixed", "total")
def test_gradient_by_one_tensor_equals_that_by_all(form):
    p = problem(**form)
    every = gradients(p)
    launched = (forward.substep, backward.substep_adjoint, total.total_substep, total_adjoint.total_substep_adjoint)
    kernels = [kernel._primal.compiled_kernels for kernel in launched]
    variants = [len(k) for k in kernels]
    for name in every:
        x = p.tensors[name].clone().requires_grad_()
        (alone,) = torch.autograd.grad(combined(p.run({name: x})), [x])
        torch.testing.assert_close(alone, every[name], rtol=1e-13, atol=1e-13)
    # Nor are kernels compiled anew, half a minute each, for every choice of tensors that require gradients.
    assert [len(k) for k in kernels] == variants


@forms("apic", "total")
def test_noncontiguous_inputs_give_the_same_bits(form):
    p = problem(batch=2, **form)
    turned = {name: t.transpose(0, -1).contiguous().transpose(0, -1) for name, t in p.tensors.items()}
    assert not turned["state"].is_contiguous()
    for a, b in zip(p.run(), p.run(turned), strict=True):
        assert torch.equal(a, b)


# ------------------------------------------------------------------------------------------------------ equivalence


@forms("apic", "mixed", "total")
def test_gradient_is_the_same_for_every_plan(form):
    p = problem(batch=2, steps=12, samples=(), **form)
    whole = {name: g for name, g in gradients(p).items() if name != "weight"}  # nothing is observed on the way
    again = gradients(p, keep=False)
    close({name: again[name] for name in whole}, whole, 1e-13)
    for cut in (1, 5):
        leaves = p.leaves()
        state = leaves["state"]
        for first in range(0, 12, cut):
            last = min(first + cut, 12)
            part = {name: leaves[name] for name in ("coefficients", "prony", "planes", "origin")}
            part["pressure"] = leaves["pressure"][first : last + 1]
            part |= {name: leaves[name][first:last] for name in ("gravity", "force")}
            state, *_ = rollout(p.scene, Inputs(**part), state, leaves["weight"], first=first, keep=False)
        grads = torch.autograd.grad(combined((state,)), [leaves[name] for name in whole])
        close(dict(zip(whole, grads, strict=True)), whole, 1e-12)


def test_gradcheck_over_several_active_boxes():
    # Fast particles leave the active box within a few substeps, so that a segment has several.
    p = problem(steps=30, blend=0.7, samples=(3, 17, 30))
    p.tensors["state"][:, 3:6] *= 8
    x = p.tensors["state"].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda t: p.run({"state": t}), (x,), fast_mode=True, rtol=1e-4, atol=1e-5)


@forms("apic", "mixed", "total")
def test_a_batch_of_two_equals_two_runs(form):
    p = problem(batch=2, **form)
    together, by = p.run(), gradients(p)
    for b in range(2):
        axis = {"pressure": 1, "gravity": 1, "force": 1}
        alone = replace(p, tensors={n: t.narrow(axis.get(n, 0), b, 1) for n, t in p.tensors.items()})
        for k, (one, two) in enumerate(zip(alone.run(), together, strict=True)):
            torch.testing.assert_close(one, two.narrow(0 if k == 0 else 1, b, 1), rtol=1e-12, atol=1e-12)
        leaves = alone.leaves()
        outputs = alone.run(leaves)
        g = torch.Generator().manual_seed(5)
        loss = torch.zeros(())
        for k, o in enumerate(outputs):
            factor = torch.randn(together[k].shape, generator=g, dtype=torch.float64)
            loss = loss + (o * factor.narrow(0 if k == 0 else 1, b, 1)).sum()
        names = list(by)
        for name, grad in zip(names, torch.autograd.grad(loss, [leaves[n] for n in names]), strict=True):
            torch.testing.assert_close(grad, by[name].narrow(axis.get(name, 0), b, 1), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    "form", [pytest.param(FORMS["mixed"], id="mixed", marks=pytest.mark.slow), pytest.param(FORMS["total"], id="total")]
)
def test_float32_agrees_with_float64(form):
    double, single = gradients(problem(**form)), gradients(problem(dtype=torch.float32, **form))
    assert all(g.dtype == torch.float32 for g in single.values())
    close({n: g.double() for n, g in single.items()}, double, 1e-3)


@forms("mixed", "total")
def test_two_runs_have_the_same_bits(form):
    p = problem(batch=2, steps=20, **form)
    first, again = gradients(p), gradients(p)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert all(torch.equal(a, b) for a, b in zip(p.run(), p.run(), strict=True))


def digests() -> list[str]:
    """Of outputs and gradients, one for each formulation."""
    found = []
    # Updated: far enough apart that nodes too are shared among threads.
    for form in ({"blend": 0.7, "spread": 6.0}, {"formulation": "total"}):
        p = problem(particles=(12, 12, 12), steps=20, samples=(20,), dtype=torch.float32, **form)
        leaves = p.leaves()
        outputs = p.run(leaves)
        outputs[0].square().sum().backward()
        digest = hashlib.sha256()
        for t in [*outputs, *(leaf.grad for leaf in leaves.values() if leaf.grad is not None)]:
            assert t.isfinite().all()
            digest.update(t.detach().numpy().tobytes())
        found.append(digest.hexdigest())
    return found


BESIDE = """
import sys
sys.path.insert(0, sys.argv[2])
import torchsoro
torchsoro.init(threads=int(sys.argv[1]))
from test_ops import digests
print(*digests())
"""


@pytest.mark.slow
def test_the_bits_do_not_depend_on_the_number_of_threads(tmp_path):
    threads = int(os.environ["TI_CPU_MAX_NUM_THREADS"]) + 2  # than here
    own = {name: value for name, value in os.environ.items() if name != "TI_CPU_MAX_NUM_THREADS"}
    own["TI_OFFLINE_CACHE_FILE_PATH"] = str(tmp_path)
    command = [sys.executable, "-W", "ignore", "-c", BESIDE, str(threads), str(HERE)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=own)
    # The updated form, forward and adjoint, that another process with as many threads need not compile.
    assert len(list(tmp_path.rglob("*.tic"))) == 2
    assert done.stdout.split()[-2:] == digests()


# --------------------------------------------------------------------------------------------------------- refusals


@forms("apic", "total")
@pytest.mark.parametrize("name", TENSORS)
def test_a_wrong_shape_is_refused(name, form):
    p = problem(**form)
    wrong = p.tensors[name]
    wrong = wrong[:, :-1] if name == "coefficients" else wrong[1:] if name == "pressure" else wrong[..., :-1]
    with pytest.raises(ValueError, match=rf"^{name}: shape \(.*\), wanted \("):
        p.run({name: wrong})


@forms("apic", "total")
@pytest.mark.parametrize("name", TENSORS)
def test_a_wrong_dtype_is_refused(name, form):
    p = problem(**form)
    wanted = "torch.float64" if name != "state" else "torch.float32"
    with pytest.raises(ValueError, match=r"dtype torch\.float\d\d, wanted " + wanted):
        p.run({name: p.tensors[name].float()})


@forms("apic", "total")
def test_half_precision_is_refused(form):
    p = problem(**form)
    with pytest.raises(ValueError, match=r"^state: dtype torch\.float16, wanted .*float32 or float64"):
        p.run({name: t.half() for name, t in p.tensors.items()})


@forms("apic", "total")
@pytest.mark.parametrize("name", [n for n in TENSORS if n != "state"])
def test_a_wrong_device_is_refused(name, form):
    p = problem(**form)
    with pytest.raises(ValueError, match=rf"^{name}: on meta, wanted cpu"):
        p.run({name: p.tensors[name].to("meta")})


@forms("apic", "total")
@pytest.mark.parametrize("samples", [(2, 1), (1, 1), (-1,), (7,)])
def test_samples_out_of_order_or_range_are_refused(samples, form):
    p = replace(problem(**form), samples=samples)
    with pytest.raises(ValueError, match=r"^samples = .*: wanted increasing substeps from 0 to 6"):
        p.run()


@forms("apic", "total")
def test_a_chamber_without_pressure_is_refused(form):
    p = problem(**form)
    with pytest.raises(ValueError, match=r"^kind: 2 chambers, wanted at most the 1 of pressure"):
        p.run({"pressure": p.tensors["pressure"][..., :1]})
