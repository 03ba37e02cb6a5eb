"""Sums in an order of their own: right, and the same bits for a body whatever it is simulated with."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchsoro.simulation.ops.lattice import Lattice
from torchsoro.simulation.sums import one_by_one, pairwise_sum


def draw(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@given(count=st.integers(0, 70), rows=st.integers(1, 5), seed=st.integers(0, 99))
def test_a_pairwise_sum_is_the_sum_and_the_same_for_a_row_alone(count, rows, seed):
    values = draw(rows, count, seed=seed)
    found = pairwise_sum(values)
    torch.testing.assert_close(found, values.double().sum(-1).float(), rtol=1e-5, atol=1e-5)
    for row in range(rows):
        assert torch.equal(pairwise_sum(values[row]), found[row])


def test_a_pairwise_sum_has_the_gradient_of_a_sum():
    values = draw(3, 7, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(pairwise_sum, values)


def test_a_function_of_each_body_is_stacked():
    one, other = draw(4, 3), draw(4, 3, 2)
    torch.testing.assert_close(one_by_one(torch.matmul, one, other), torch.einsum("bi,bij->bj", one, other))


@pytest.mark.parametrize("kind", ["weight", "slope", "back"])
def test_sums_over_a_lattice_have_the_bits_of_a_body_alone(kind):
    lattice = Lattice.uniform((8, 6, 10), (0.0, 0.0, 0.0), 1.0)
    points, nodes = draw(5, lattice.count), draw(5, lattice.nodes)
    for whole, summed in ((points, lattice.to_nodes), (nodes, lattice.to_points)):
        found = summed(whole, kind)
        for part in ([0, 1, 2], [4]):
            assert torch.equal(summed(whole[part], kind), found[part])
