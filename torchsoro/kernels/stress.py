"""Stress laws of the particles and their adjoints: neo-Hookean solid with Maxwell elements, gas, Newtonian viscosity.

All stresses are Kirchhoff stresses ``tau = J sigma``. Equation numbers are those of Kobayashi et al.,
"Computational synthesis of locomotive soft robots by topology optimization".
"""

import taichi as ti

from torchsoro.kernels.tensor import cofactor, contract, deviator, plus_identity


@ti.func
def isochoric(F, J):
    """Isochoric part of the deformation gradient, J^(-1/3) F."""
    return F * ti.exp(-ti.log(J) / 3)


@ti.func
def pull_back(F):
    """Pull-back S of the deviatoric neo-Hookean stress over mu: (I - tr(Cb)/3 Cb^-1) / J (inside Eq. 8)."""
    J = F.determinant()
    Fb = isochoric(F, J)
    Cb = Fb.transpose() @ Fb
    return plus_identity(cofactor(Cb) * (-Cb.trace() / 3), 1) / J


@ti.func
def pull_back_adjoint(F, S_bar):
    """Adjoint of :func:`pull_back`: the gradient by F for the symmetric gradient S_bar by S."""
    J = F.determinant()
    Fb = isochoric(F, J)
    Cb = Fb.transpose() @ Fb
    inverse = cofactor(Cb)  # det Cb = 1
    trace = Cb.trace()
    S = plus_identity(inverse * (-trace / 3), 1) / J
    Cb_bar = plus_identity(inverse @ S_bar @ inverse * (trace / (3 * J)), -contract(S_bar, inverse) / (3 * J))
    J_bar = -contract(S_bar, S) / J
    return isochoric_adjoint(F, J, Fb, 2 * Fb @ Cb_bar, J_bar)


@ti.func
def isochoric_adjoint(F, J, Fb, Fb_bar, J_bar):
    """Gradient by F of a function of (Fb, J), where Fb = J^(-1/3) F and J = det F."""
    by_J = J_bar - contract(Fb_bar, Fb) / (3 * J)
    return Fb_bar * ti.exp(-ti.log(J) / 3) + cofactor(F) * by_J


@ti.func
def solid_stress(F, Q, bulk, shear):
    """Eqs. 3-8: K/2 [(J-1) + ln J / J] J I + mu dev(Bb) + mu J dev(Fb Q Fb^T), with Q = sum_i g_i H_i."""
    J = F.determinant()
    Fb = isochoric(F, J)
    shape = Fb @ Fb.transpose() + J * (Fb @ Q @ Fb.transpose())
    return plus_identity(shear * deviator(shape), bulk / 2 * (J * (J - 1) + ti.log(J)))


@ti.func
def solid_stress_adjoint(F, Q, bulk, shear, tau_bar):
    """Adjoint of :func:`solid_stress`: gradients by F, Q, bulk and shear modulus."""
    J = F.determinant()
    Fb = isochoric(F, J)
    pushed = Fb @ Q @ Fb.transpose()
    dev_bar = deviator(tau_bar)
    trace_bar = tau_bar.trace()
    shear_bar = contract(dev_bar, Fb @ Fb.transpose() + J * pushed)
    bulk_bar = trace_bar * (J * (J - 1) + ti.log(J)) / 2
    J_bar = bulk * trace_bar * (J - 0.5 + 0.5 / J) + shear * contract(dev_bar, pushed)
    both = shear * (dev_bar + dev_bar.transpose())
    Fb_bar = both @ (Fb + J * (Fb @ Q))
    Q_bar = Fb.transpose() @ both @ Fb * (J / 2)
    return isochoric_adjoint(F, J, Fb, Fb_bar, J_bar), Q_bar, bulk_bar, shear_bar


@ti.func
def gas_pressure(J, stiffness, actuation):
    """Eq. 10: p = k (1 - J) + p_act, positive in compression."""
    return stiffness * (1 - J) + actuation


@ti.func
def viscous_stress(J, gradient, viscosity, volume_viscosity):
    """Viscous part of Eq. 9: J [mu_v (L + L^T) + (zeta - 2/3 mu_v) tr L I]."""
    spread = (volume_viscosity - 2 * viscosity / 3) * gradient.trace()
    return J * plus_identity(viscosity * (gradient + gradient.transpose()), spread)


@ti.func
def viscous_stress_adjoint(J, gradient, viscosity, volume_viscosity, tau_bar):
    """Adjoint of :func:`viscous_stress`: gradients by J, L, viscosity and volume viscosity."""
    trace_bar = tau_bar.trace()
    bulk_viscosity = volume_viscosity - 2 * viscosity / 3
    both = tau_bar + tau_bar.transpose()
    gradient_bar = J * plus_identity(viscosity * both, bulk_viscosity * trace_bar)
    volume_bar = trace_bar * gradient.trace()
    viscosity_bar = contract(both, gradient) - 2 * volume_bar / 3
    J_bar = viscosity * contract(both, gradient) + bulk_viscosity * volume_bar
    return J_bar, gradient_bar, J * viscosity_bar, J * volume_bar
