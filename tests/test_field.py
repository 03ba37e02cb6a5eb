"""The design field: exact symmetry, the filter's weights, the projection, and the gradient through all of it."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchsoro.design.domain import Chamber, Domain
from torchsoro.design.field import DesignField

torch.set_num_threads(1)

H = 0.001  # particle spacing, m


def domain_of(particles, shell=None, wall=1, center=None):
    """A body of 1 mm spacing with a chamber of ``shell`` particles, centred unless told otherwise."""
    chambers = ()
    if shell is not None:
        center = tuple(n / 2 for n in particles) if center is None else center
        chambers = (
            Chamber(name="air", center=tuple(c * H for c in center), size=tuple(s * H for s in shell), wall=wall * H),
        )
    return Domain(size=tuple(n * H for n in particles), particles=particles, chambers=chambers)


CHAMBERED = domain_of((9, 7, 8), (5, 3, 4))


def randomise(field, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        field.phi.copy_(scale * (2.0 * torch.rand(field.phi.shape, generator=generator, dtype=field.phi.dtype) - 1.0))
    return field


def reference_filter(domain, radius, phi):
    """The filter as written in the paper: a double loop over particles, as one dense matrix."""
    distance = (domain.positions[:, None] - domain.positions).norm(dim=-1)
    weight = (1.0 - distance / radius).clamp(min=0.0) ** 3 * domain.design
    return (weight @ phi.flatten().double()) / weight.sum(dim=1)


@pytest.mark.parametrize("radius", [0.0005, 0.001, 0.0015, 0.00275, 0.004, 0.009])
@pytest.mark.parametrize("domain", [CHAMBERED, domain_of((2, 9, 3))], ids=["chamber", "thin"])
def test_filter_is_the_weighted_mean_over_design_neighbours(domain, radius):
    field = randomise(DesignField(domain, radius=radius, symmetry=(), dtype=torch.float64))
    design = domain.design
    torch.testing.assert_close(
        field.filtered()[design], reference_filter(domain, radius, field.phi.detach())[design], rtol=0, atol=1e-13
    )


@settings(max_examples=20, deadline=None)
@given(radius=st.floats(0.0002, 0.009), value=st.floats(-1.0, 1.0), dtype=st.sampled_from(["float32", "float64"]))
def test_filter_weights_are_a_partition_of_unity(radius, value, dtype):
    field = DesignField(CHAMBERED, radius=radius, symmetry=("x", "y", "z"), dtype=getattr(torch, dtype))
    with torch.no_grad():
        field.phi.fill_(value)
    constant = torch.full_like(field.filtered(), value)
    torch.testing.assert_close(
        field.filtered()[CHAMBERED.design],
        constant[CHAMBERED.design],
        rtol=0,
        atol=4 * torch.finfo(field.phi.dtype).eps,
    )


@settings(max_examples=30, deadline=None)
@given(
    axes=st.sets(st.sampled_from("xyz"), min_size=1),
    particles=st.tuples(*[st.integers(1, 4)] * 3),
    shell=st.booleans(),
    radius=st.floats(0.0005, 0.006),
    beta=st.floats(0.5, 20.0),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
)
def test_density_and_gradient_are_mirror_symmetric_to_the_bit(axes, particles, shell, radius, beta, dtype, seed):
    particles = tuple(n + 4 for n in particles)
    chamber = tuple(n - 2 for n in particles) if shell else None
    domain = domain_of(particles, chamber)
    field = randomise(
        DesignField(domain, radius=min(radius, max(domain.size)), beta=beta, symmetry=sorted(axes), dtype=dtype), seed
    )
    gamma = field()
    generator = torch.Generator().manual_seed(seed + 1)
    gamma.backward(torch.randn(domain.count, generator=generator, dtype=dtype))
    for name in axes:
        axis = "xyz".index(name)
        for volume in (domain.lattice(gamma), domain.lattice(field.filtered()), field.phi.grad):
            assert torch.equal(volume, volume.flip(axis))


def test_symmetry_of_the_papers_walker_is_exact():
    domain = domain_of((40, 40, 40), (20, 20, 20), wall=2)
    field = randomise(DesignField(domain, radius=6 * H))
    gamma = field()
    gamma.square().sum().backward()
    assert torch.equal(domain.lattice(gamma), domain.lattice(gamma).flip(1))
    assert torch.equal(field.phi.grad, field.phi.grad.flip(1))
    assert not torch.equal(domain.lattice(gamma), domain.lattice(gamma).flip(0))


def test_gradient_is_the_left_right_average_of_the_gradient_without_symmetry():
    plain = randomise(DesignField(CHAMBERED, radius=2.5 * H, symmetry=(), dtype=torch.float64))
    with torch.no_grad():
        plain.phi.copy_(0.5 * (plain.phi + plain.phi.flip(1)))
    mirrored = DesignField(CHAMBERED, radius=2.5 * H, symmetry=("y",), dtype=torch.float64)
    mirrored.load_state_dict(plain.state_dict())
    weights = torch.randn(CHAMBERED.count, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    for field in (plain, mirrored):
        (field() * weights).sum().backward()
    average = 0.5 * (plain.phi.grad + plain.phi.grad.flip(1))
    assert not torch.allclose(plain.phi.grad, average)
    torch.testing.assert_close(mirrored.phi.grad, average, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("symmetry", [("y",), *(pytest.param(s, marks=pytest.mark.slow) for s in ((), ("x", "z")))])
def test_gradcheck(symmetry):
    domain = domain_of((5, 4, 3), (3, 4, 3), center=(2.5, 2, 1.5))
    field = DesignField(domain, radius=2.2 * H, beta=3.0, symmetry=symmetry, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    phi = 0.9 * (2.0 * torch.rand(domain.shape, generator=generator, dtype=torch.float64) - 1.0)
    assert torch.autograd.gradcheck(field, phi.requires_grad_())
    assert torch.autograd.gradcheck(field.filtered, phi)
    assert torch.autograd.gradgradcheck(field, phi)


def test_starts_at_one_half_and_keeps_walls_and_air():
    field = DesignField(CHAMBERED, radius=2 * H)
    gamma = field()
    assert gamma.dtype == torch.float32
    assert gamma.shape == (CHAMBERED.count,)
    assert (gamma[CHAMBERED.design] == 0.5).all()
    randomise(field)
    for values, air in ((field(), 0.0), (field.filtered(), -1.0)):
        assert (values[CHAMBERED.wall] == 1.0).all()
        assert (values[CHAMBERED.gas] == air).all()


def test_walls_and_air_neither_feel_nor_spread_phi():
    field = randomise(DesignField(CHAMBERED, radius=2.5 * H, dtype=torch.float64))
    before = field().detach()
    frozen = CHAMBERED.lattice(~CHAMBERED.design)
    with torch.no_grad():
        field.phi[frozen] = 1.0
    gamma = field()
    assert torch.equal(gamma, before)
    gamma.sum().backward()
    assert (field.phi.grad[frozen] == 0.0).all()
    assert (field.phi.grad[~frozen] > 0.0).all()


@settings(max_examples=20, deadline=None)
@given(beta=st.floats(0.1, 50.0), value=st.floats(-1.0, 1.0))
def test_projection_is_equation_12(beta, value):
    field = DesignField(domain_of((2, 2, 2)), radius=H, beta=beta, dtype=torch.float64)
    with torch.no_grad():
        field.phi.fill_(value)
    expected = 0.5 * (math.tanh(beta * value) / math.tanh(beta) + 1.0)
    torch.testing.assert_close(field(), torch.full((8,), expected, dtype=torch.float64), rtol=0, atol=1e-14)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), dtype=st.sampled_from([torch.float32, torch.float64]), beta=st.floats(0.1, 30.0))
def test_density_never_leaves_zero_to_one(seed, dtype, beta):
    field = randomise(DesignField(CHAMBERED, radius=3 * H, beta=beta, dtype=dtype), seed)
    with torch.no_grad():
        field.phi.sign_()  # whole neighbourhoods of pure void and solid
        field.phi[:5] = 1.0
        field.phi[5:] = -1.0 if seed % 2 else 1.0
    gamma = field().detach()
    assert 0.0 <= float(gamma.min()) and float(gamma.max()) <= 1.0
    assert float(field.filtered().detach().abs().max()) <= 1.0


@pytest.mark.parametrize("rounding", [0.0, 1e-12])
def test_a_solid_design_still_has_the_gradient_that_leads_back(rounding):
    # With a small beta the projection is not flat at the bound; clipping there must not hide the slope.
    field = DesignField(CHAMBERED, radius=2.5 * H, beta=1.0, symmetry=(), dtype=torch.float64)
    # Another device adds the weights up in another order, and the mean of ones then ends beyond one.
    field._weight_sum *= 1.0 - rounding
    with torch.no_grad():
        field.phi.fill_(1.0)
    gamma = field()
    assert (gamma[CHAMBERED.design] == 1.0).all()
    assert (field.filtered()[CHAMBERED.design] == 1.0).all()
    gamma.sum().backward()
    slope = 0.5 * (1.0 - math.tanh(1.0) ** 2) / math.tanh(1.0)
    total = float(field.phi.grad.sum())
    assert total == pytest.approx(slope * int(CHAMBERED.design.sum()), rel=1e-9)


def test_accepts_a_design_variable_from_another_module():
    torch.manual_seed(0)
    domain = domain_of((4, 4, 4))
    field = DesignField(domain, radius=1.5 * H, dtype=torch.float64)
    network = torch.nn.Sequential(
        torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1), torch.nn.Tanh()
    ).double()
    phi = domain.lattice(network(domain.positions / H)[:, 0])
    gamma = field(phi)
    gamma.sum().backward()
    assert field.phi.grad is None
    assert all(float(weight.grad.abs().max()) > 0.0 for weight in network.parameters())
    with torch.no_grad():
        field.phi.copy_(phi)
    assert torch.equal(field(), gamma)


def test_an_optimizer_step_needs_the_clamp():
    field = DesignField(domain_of((3, 3, 3)), radius=H)
    optimizer = torch.optim.Adam(field.parameters(), lr=1.5)
    (-field().sum()).backward()
    optimizer.step()
    with pytest.raises(ValueError, match=r"phi: got a magnitude of 1.49999988.*clamp_\(\)"):
        field()
    assert field.clamp_() is field
    assert float(field.phi.detach().max()) == 1.0
    assert (field() == 1.0).all()


def test_only_the_parameter_is_in_the_checkpoint():
    field = randomise(DesignField(CHAMBERED, radius=2 * H))
    assert list(field.state_dict()) == ["phi"]
    assert [name for name, _ in field.named_parameters()] == ["phi"]
    other = DesignField(CHAMBERED, radius=2 * H)
    other.load_state_dict(field.state_dict())
    assert torch.equal(other(), field())
    assert "radius=0.002 m" in repr(field)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": 0.0}, "radius: got 0.0 m, want > 0"),
        ({"radius": float("nan")}, "radius: got nan"),
        ({"radius": 5.25}, "radius: got 5.25 m.*at most the longest body edge"),
        ({"beta": 0.0}, "beta: got 0.0"),
        ({"beta": float("inf")}, "beta: got inf"),
        ({"symmetry": ("w",)}, "symmetry: got .*'w'"),
        ({"symmetry": ("y", "y")}, "symmetry: got .*at most once"),
        ({"dtype": torch.float16}, "dtype: got torch.float16"),
    ],
)
def test_bad_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        DesignField(CHAMBERED, **({"radius": 2 * H} | changes))


def test_symmetry_about_an_off_centre_chamber_is_refused():
    domain = domain_of((9, 8, 8), (3, 4, 4), center=(4.5, 3, 4))
    DesignField(domain, radius=H, symmetry=("x", "z"))
    with pytest.raises(ValueError, match="symmetry: got 'y', but the chambers"):
        DesignField(domain, radius=H, symmetry=("x", "y"))


def test_nothing_to_design_is_refused():
    with pytest.raises(ValueError, match="domain: got no design particle"):
        DesignField(domain_of((4, 4, 4), (4, 4, 4)), radius=H)


@pytest.mark.parametrize(
    "phi",
    [torch.zeros(9, 7, 7), torch.zeros(9, 7, 8, dtype=torch.int64), torch.full((9, 7, 8), torch.nan)],
    ids=["shape", "dtype", "nan"],
)
def test_bad_design_variables_are_refused(phi):
    with pytest.raises(ValueError, match="phi: got"):
        DesignField(CHAMBERED, radius=2 * H)(phi)
