"""Parts of a body that lie in one another, against a search over all pairs."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.simulation.selfcontact import NEAR, overlapping

H = 0.875e-3  # m


def cube(*shape, spacing=H, dtype=torch.float64):
    axes = [torch.arange(n, dtype=dtype) * spacing for n in shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def all_pairs(position, reference, solid, *, spacing, apart=3.0):
    def squares(x):
        return (x[..., :, None, :] - x[..., None, :, :]).square().sum(-1)

    meets = (squares(position) < (NEAR * spacing) ** 2) & (squares(reference) > (apart * spacing) ** 2)
    return (meets & solid & solid[:, None]).any(-1)


def folded(shape, at):
    """A slab, the far part of which lies on the near one, reflected and shifted by ``at`` (in spacings)."""
    X = cube(*shape)
    far = X[:, 0] > X[:, 0].mean()
    x = X.clone()
    x[far, 0] = X[:, 0].max() - X[far, 0]
    x[far] += H * torch.as_tensor(at, dtype=X.dtype)
    return x, X


# ---------------------------------------------------------------------------------------------------- all pairs agree


@given(
    seed=st.integers(0, 10**6),
    batch=st.sampled_from([(), (1,), (3,), (2, 2)]),
    count=st.integers(0, 60),
    width=st.floats(0.05, 12.0),
    apart=st.floats(1.0, 6.0),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    shift=st.sampled_from([0.0, -1e3, 1e6]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_it_finds_what_a_search_over_all_pairs_finds(seed, batch, count, width, apart, share, shift, dtype):
    g = torch.Generator().manual_seed(seed)
    x = (H * (width * torch.rand(*batch, count, 3, generator=g, dtype=torch.float64) + shift)).to(dtype)
    X = (H * 8 * torch.rand(count, 3, generator=g, dtype=torch.float64)).to(dtype)
    solid = torch.rand(count, generator=g) < share
    found = overlapping(x, X, solid, spacing=H, apart=apart)
    assert found.dtype == torch.bool
    assert found.shape == (*batch, count)
    assert torch.equal(found, all_pairs(x, X, solid, spacing=H, apart=apart))


@given(seed=st.integers(0, 10**6), places=st.integers(1, 4))
def test_particles_on_cell_faces_and_on_one_another(seed, places):
    # Whole multiples of the distance itself, at which rounding may go either way.
    g = torch.Generator().manual_seed(seed)
    X = cube(5, 4, 3)
    x = NEAR * H * torch.randint(-places, places, X.shape, generator=g).double()
    solid = torch.ones(len(X), dtype=torch.bool)
    assert torch.equal(overlapping(x, X, solid, spacing=H), all_pairs(x, X, solid, spacing=H))


def test_places_far_away_do_no_harm():
    x, X = folded((16, 3, 3), (0.0, 0.0, 0.3))
    solid = torch.ones(len(X), dtype=torch.bool)
    x[0] = torch.tensor([1e30, -1e30, 1e15])
    assert torch.equal(overlapping(x, X, solid, spacing=H), all_pairs(x, X, solid, spacing=H))


# ---------------------------------------------------------------------------------------------------- what it is for


@given(
    stretch=st.tuples(*[st.floats(0.3, 3.0)] * 3),
    shear=st.floats(-0.2, 0.2),
    seed=st.integers(0, 1000),
)
def test_compression_alone_is_no_overlap(stretch, shear, seed):
    X = cube(9, 8, 7)
    F = torch.diag(torch.tensor(stretch, dtype=torch.float64))
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    F[0, 1] = shear * stretch[1]
    # A length shrinks by the smallest singular value at most.
    least = float(torch.linalg.svdvals(F)[-1])
    F = F * max(1.0, 1.0001 * NEAR / 3 / least)
    assert not overlapping(X @ (q @ F).T, X, torch.ones(len(X), dtype=torch.bool), spacing=H).any()


def test_a_folded_slab_is_found_where_it_lies_in_itself():
    # Both parts have four layers; shifted by four spacings the faces touch, by less they share some layers.
    for shift, layers in ((5.0, 0), (4.0, 0), (3.5, 1), (2.5, 2), (0.5, 4)):
        x, X = folded((24, 6, 4), (0.5, 0.0, shift))
        found = overlapping(x, X, torch.ones(len(X), dtype=torch.bool), spacing=H)
        # Seen from the crease, where both parts were less than three spacings apart at first.
        clear = (X[:, 0] - X[:, 0].mean()).abs() > 2 * H
        upper = X[:, 0] > X[:, 0].mean()
        height = (X[:, 2] / H).round()
        inside = torch.where(upper, height < layers, height >= 4 - layers)
        assert torch.equal(found & clear, inside & clear & (x[:, 0] < x[~upper, 0].max() + 0.6 * H)), (shift, layers)
        assert bool(found.any()) == (layers > 0)


@given(offset=st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_two_lattices_in_one_another_cannot_hide(offset):
    lower = cube(5, 5, 5)
    X = torch.cat([lower, lower + torch.tensor([20 * H, 0, 0], dtype=torch.float64)])
    x = torch.cat([lower, lower + H * torch.tensor(offset, dtype=torch.float64)])
    found = overlapping(x, X, torch.ones(len(X), dtype=torch.bool), spacing=H)
    hole = math.hypot(*offset)
    if abs(hole - NEAR) > 1e-6:
        assert bool(found.any()) == (hole < NEAR)
    assert math.sqrt(3) / 2 < 0.87


def test_void_does_not_count():
    x, X = folded((24, 4, 4), (0.0, 0.0, 0.4))
    solid = X[:, 0] < X[:, 0].mean()
    assert bool(overlapping(x, X, torch.ones_like(solid), spacing=H).any())
    assert not overlapping(x, X, solid, spacing=H).any()
    assert not overlapping(x, X, ~solid, spacing=H).any()
    found = overlapping(x, X, X[:, 1] < 1.5 * H, spacing=H)
    assert bool(found.any())
    assert not found[X[:, 1] > 1.5 * H].any()


def test_simulations_of_a_batch_do_not_meet():
    x, X = folded((16, 3, 3), (0.0, 0.0, 0.3))
    solid = torch.ones(len(X), dtype=torch.bool)
    both = overlapping(torch.stack([x, X, x]).requires_grad_(), X, solid, spacing=H)
    assert not both.requires_grad
    assert torch.equal(both[0], overlapping(x, X, solid, spacing=H))
    assert torch.equal(both[2], both[0])
    assert bool(both[0].any())
    assert not both[1].any()


def test_layers_of_64000_particles_that_lie_in_one_another_are_marked():
    X = cube(40, 40, 40, dtype=torch.float32)
    x, solid = X.clone(), torch.ones(len(X), dtype=torch.bool)
    x[X[:, 0] > 30.5 * H, 0] -= 20.3 * H
    assert int(overlapping(x, X, solid, spacing=H).sum()) == (9 + 10) * 1600  # nine layers between ten others


def test_on_cuda_as_on_the_cpu(cuda):
    x, X = folded((40, 20, 20), (0.2, 0.1, 0.3))
    x = torch.stack([x, X]).float()
    solid = torch.ones(len(X), dtype=torch.bool)
    found = overlapping(x.to(cuda), X.float(), solid, spacing=H)
    assert found.device.type == "cuda"
    assert torch.equal(found.cpu(), overlapping(x, X.float(), solid, spacing=H))


# ----------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"position": torch.zeros(4, 2)}, r"position: got torch\.float32 \(4, 2\), want a floating-point tensor"),
        ({"position": torch.zeros(3)}, r"position: got torch\.float32 \(3,\), want"),
        ({"position": torch.zeros(4, 3).long()}, r"position: got torch\.int64 \(4, 3\), want"),
        ({"position": torch.full((4, 3), math.nan)}, r"position: got a solid particle at a place that is not finite"),
        ({"position": torch.full((2, 4, 3), math.inf)}, r"position: got a solid particle at a place that is not fin"),
        ({"reference": torch.zeros(5, 3)}, r"reference: got torch\.float32 \(5, 3\), want .* \[4, 3\]"),
        ({"reference": torch.zeros(2, 4, 3)}, r"reference: got torch\.float32 \(2, 4, 3\), want"),
        ({"solid": torch.ones(4)}, r"solid: got torch\.float32 \(4,\), want a bool tensor \[4\]"),
        ({"solid": torch.ones(3, dtype=torch.bool)}, r"solid: got torch\.bool \(3,\), want a bool tensor \[4\]"),
        ({"spacing": 0.0}, r"spacing: got 0\.0 m, want a finite length > 0"),
        ({"spacing": math.nan}, r"spacing: got nan m, want"),
        ({"apart": 0.9}, r"apart: got 0\.9 spacings, want a finite number >= 1"),
        ({"apart": math.inf}, r"apart: got inf spacings, want"),
    ],
)
def test_bad_input_is_refused(changed, message):
    arguments = {
        "position": torch.zeros(4, 3),
        "reference": torch.zeros(4, 3),
        "solid": torch.ones(4, dtype=torch.bool),
        "spacing": H,
    }
    with pytest.raises(ValueError, match="^" + message):
        overlapping(**{**arguments, **changed})


def test_a_void_that_has_run_away_is_none_of_its_business():
    position = torch.tensor([[0.0, 0.0, 0.0], [math.nan, math.inf, 0.0]])
    assert not overlapping(position, torch.zeros(2, 3), torch.tensor([True, False]), spacing=H).any()
