"""The design field: from the design variable phi to the density gamma of every particle.

``phi`` is averaged with its mirror images, smoothed by a filter, and pushed towards void or solid by a projection:

    phi  --mirror-->  --filter-->  phi~  --projection (Eq. 12)-->  gamma

Equation numbers are those of Kobayashi et al., "Computational synthesis of locomotive soft robots by topology
optimization".
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from torchsoro.design.domain import Domain
from torchsoro.design.limits import ROUNDING
from torchsoro.errors import refuse_gradients

_AXES = ("x", "y", "z")


class DesignField(nn.Module):
    """A density for every particle, described by one parameter that an optimizer may move.

    The parameter ``phi`` [nx, ny, nz] lives on the particle lattice, in [-1 (void), 1 (solid)], and starts at 0, which
    is a density of one half everywhere. Call :meth:`clamp_` after each optimizer step. Chamber walls have density
    exactly 1 and air exactly 0, whatever ``phi`` is, and ``phi`` has no gradient there.

    The filter is a weighted mean over the *design* particles within the radius R,

        phi~_i = sum_j w_ij phi_j / sum_j w_ij ,    w_ij = (1 - |X_i - X_j| / R)^3 ,

    with distances in the undeformed body. Where the design is eroded (``threshold`` above 0), void surrounds the body,
    with phi = -1, so that it wears off at the faces of its box, too. The filter is evaluated in double precision. The
    density and the gradient with respect to ``phi`` are mirror symmetric to the last bit about the mid planes of the
    axes in ``symmetry``.

    Args:
        domain: Body with its lattice and regions.
        radius: Filter radius R, m. One that is not above the particle spacing leaves phi unfiltered.
        beta: Sharpness of the projection, dimensionless.
        symmetry: Axes along which left and right are alike, any of "x", "y", "z".
        dtype: Type of ``phi`` and of the density, float32 or float64.

    Raises:
        ValueError: An argument is out of range, no particle is to be designed, or the regions of ``domain`` are not
            mirror images along an axis of ``symmetry``.

    Reference:
        Eq. 12 and the paragraph before it; the filter is that of the paper's reference 60.
    """

    def __init__(
        self,
        domain: Domain,
        *,
        radius: float,
        beta: float = 8.0,
        symmetry: Iterable[str] = ("y",),
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Lay out the filter and the symmetry for this domain."""
        refuse_gradients(radius=radius, beta=beta)
        longest = max(domain.size)
        if not (math.isfinite(radius) and 0.0 < radius <= longest):
            raise ValueError(f"radius: got {radius!r} m, want > 0 and at most the longest body edge ({longest} m)")
        if not (math.isfinite(beta) and beta > 0.0):
            raise ValueError(f"beta: got {beta!r}, want a finite number > 0")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype: got {dtype}, want torch.float32 or torch.float64")
        if not bool(domain.design.any()):
            raise ValueError("domain: got no design particle, want at least one outside the chambers")
        super().__init__()
        self.domain = domain
        self.radius = float(radius)
        self.beta = float(beta)
        self.symmetry = _checked_symmetry(symmetry, domain)
        self._mirrors = tuple(_AXES.index(axis) for axis in self.symmetry)

        self.phi = nn.Parameter(torch.zeros(domain.shape, dtype=dtype))

        # All of this follows from the settings, so that none of it belongs into a checkpoint.
        self._kernel: Tensor
        self._weight_sum: Tensor
        self._design: Tensor
        self._frozen: Tensor
        design = domain.lattice(domain.design)
        kernel = _filter_kernel(self.radius / domain.spacing)
        weight_sum = _Convolution.apply(design.double(), kernel)
        self.register_buffer("_kernel", kernel, persistent=False)
        self.register_buffer("_weight_sum", torch.where(design, weight_sum, 1.0), persistent=False)
        inside = _Convolution.apply(domain.lattice(~domain.outside).double(), kernel)
        beyond = kernel[0].sum() + 2 * kernel[1:].sum() - inside
        self._beyond: Tensor
        self.register_buffer("_beyond", torch.where(design, beyond, 0.0), persistent=False)
        self.register_buffer("_design", design, persistent=False)
        # What phi~ is outside the design particles: the projection turns -1 and 1 into exactly 0 and 1.
        frozen = torch.where(domain.lattice(domain.wall), 1.0, -1.0).double()
        self.register_buffer("_frozen", frozen, persistent=False)

    def forward(
        self, phi: Tensor | None = None, *, threshold: float = 0.0, shares: tuple[Tensor, Tensor] | None = None
    ) -> Tensor:
        """Return the density of every particle.

        Args:
            phi: Design variable to use in place of the parameter, [nx, ny, nz] in [-1, 1]: for example the output of a
                network of the particle positions.
            threshold: Value of phi~ between void and solid, in (-1, 1). Above 0 the design is eroded, below dilated;
                see :func:`torchsoro.design.features.threshold_of`.
            shares: Of each particle, what part is designed and what part is wall [N] each, instead of the domain's
                regions. The filter then weighs by the first, and the density is that of the design times the first,
                plus the second.

        Returns:
            Density gamma in [0, 1], [N], in the type of the design variable.

        Raises:
            ValueError: The design variable has the wrong shape or type, or leaves [-1, 1], as the threshold does.
        """
        if not -1.0 < threshold < 1.0:
            raise ValueError(f"threshold: got {threshold!r}, want a number between -1 and 1")
        phi = self._checked(phi)
        # What phi~ = -1 and 1 come to is mapped to 0 and 1.
        low, high = (math.tanh(self.beta * (1.0 + side * threshold)) for side in (1.0, -1.0))
        design, wall = (None, None) if shares is None else map(self._on_lattice, shares)
        smooth = self._smooth(phi, beyond=threshold > 0, design=design)
        pushed = torch.tanh(self.beta * (smooth - threshold)) + 0.5 * (low - high)
        gamma = 0.5 * (pushed / (0.5 * (low + high)) + 1.0)
        # Vectorised tanh may round two mirror images differently.
        gamma = _clip(self._mirror(gamma), 0.0, 1.0)
        if design is None or wall is None:
            gamma = torch.where(self._design, gamma, 0.5 * (self._frozen + 1.0))
        else:
            gamma = _clip(self._mirror(design * gamma + wall), 0.0, 1.0)
        return gamma.flatten().to(phi.dtype)

    def filtered(self, phi: Tensor | None = None) -> Tensor:
        """Return the filtered design variable phi~ in [-1, 1], [N]; 1 in walls and -1 in air.

        Args:
            phi: As in :meth:`forward`.
        """
        phi = self._checked(phi)
        return torch.where(self._design, self._smooth(phi), self._frozen).flatten().to(phi.dtype)

    @torch.no_grad()
    def clamp_(self) -> DesignField:
        """Bring ``phi`` back into [-1, 1] in place, as after each optimizer step, and return the field itself."""
        self.phi.clamp_(-1.0, 1.0)
        return self

    def extra_repr(self) -> str:
        """Settings for ``print(field)``."""
        return f"shape={self.domain.shape}, radius={self.radius} m, beta={self.beta}, symmetry={self.symmetry}"

    def _checked(self, phi: Tensor | None) -> Tensor:
        """The design variable to use, refused where it would be clipped in silence."""
        phi = self.phi if phi is None else phi
        if phi.shape != self.domain.shape or not phi.is_floating_point():
            raise ValueError(
                f"phi: got {phi.dtype} {tuple(phi.shape)}, want a floating-point tensor {self.domain.shape}"
            )
        largest = float(phi.detach().abs().max())
        if not largest <= 1.0:  # also catches NaN
            raise ValueError(
                f"phi: got a magnitude of {largest:.9g}, want at most 1: call clamp_() after each optimizer step"
            )
        return phi

    def _on_lattice(self, share: Tensor) -> Tensor:
        """A share of each particle as a volume, in the type and on the device of the kernel."""
        return self.domain.lattice(share).to(self._kernel)

    def _smooth(self, phi: Tensor, beyond: bool = False, design: Tensor | None = None) -> Tensor:
        """Mirror mean and filter on the lattice, with void beyond the body or not, in the type of the kernel.

        The filter weighs by the designed shares of the particles, ``design``, instead of the domain's region if given.
        """
        weight, total = self._design, self._weight_sum
        if design is not None:  # what is not designed at all has no density that counts
            weight, total = design, torch.where(design > 0, _Convolution.apply(design, self._kernel), 1.0)
        values = self._mirror(phi.to(self._kernel.dtype)) * weight
        void = self._beyond if beyond else 0.0
        smooth = (_Convolution.apply(values, self._kernel) - void) / (total + void)
        # The sums of the filter are rounded in an order that has no mirror symmetry; this mean has.
        return _clip(self._mirror(smooth), -1.0, 1.0)

    def _mirror(self, values: Tensor) -> Tensor:
        """Mean with the mirror images: exactly symmetric, because a sum of two numbers is commutative to the bit."""
        for axis in self._mirrors:
            values = 0.5 * (values + values.flip(axis))
        return values


class _Convolution(torch.autograd.Function):
    """Sum of a volume over an even kernel, zero outside; its own adjoint.

    The kernel [r + 1, 1, 2 r + 1, 2 r + 1] holds the planes at distance 0 ... r along the first axis: plane ``k``
    serves both ``+k`` and ``-k``. Batched 2-D convolutions take a fraction of the time and memory of ``conv3d`` in
    double precision, and running the forward convolution in ``backward`` too keeps CUDA's non-deterministic gradient
    algorithms out.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, kernel: Tensor) -> Tensor:
        ctx.save_for_backward(kernel)
        reach = len(kernel) - 1
        planes = nn.functional.conv2d(values.unsqueeze(1), kernel, padding=reach)
        total = planes[:, 0].clone()
        for k in range(1, min(reach, len(values) - 1) + 1):
            total[k:] += planes[:-k, k]
            total[:-k] += planes[k:, k]
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (kernel,) = ctx.saved_tensors
        return _Convolution.apply(grads[0], kernel), None


def _filter_kernel(radius: float) -> Tensor:
    """Weights (1 - d/R)^3 for a radius in particle spacings, half of them: [r + 1, 1, 2 r + 1, 2 r + 1], float64."""
    reach = max(math.ceil(radius - ROUNDING) - 1, 0)  # neighbours at distance R itself have weight 0
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
    x, y, z = torch.meshgrid(offsets[reach:], offsets, offsets, indexing="ij")
    distance = (x.square() + y.square() + z.square()).sqrt()
    return (1.0 - distance / radius).clamp(min=0.0).pow(3).unsqueeze(1)


def _clip(values: Tensor, low: float, high: float) -> Tensor:
    """Remove rounding beyond [low, high]; unlike ``clamp``, keep the gradient at the ends, or phi would stick there."""
    return values + (values.clamp(low, high) - values).detach()


def _checked_symmetry(symmetry: Iterable[str], domain: Domain) -> tuple[str, ...]:
    """Check the axis names, and that the regions are symmetric about each."""
    axes = tuple(symmetry)
    if any(axis not in _AXES for axis in axes) or len(set(axes)) != len(axes):
        raise ValueError(f'symmetry: got {axes!r}, want each of "x", "y", "z" at most once')
    region = domain.lattice(domain.region)
    for axis in axes:
        if not torch.equal(region, region.flip(_AXES.index(axis))):
            raise ValueError(
                f"symmetry: got {axis!r}, but the chambers of the domain are not mirror images along {axis}, "
                f"want centred chambers or symmetry without {axis!r}"
            )
    return axes
