"""Exact interconversion of the retardation and relaxation spectra of a linear viscoelastic solid or liquid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchsoro.rheology.leastsquares import Found, Problem


@dataclass(frozen=True, kw_only=True, eq=False)
class Relaxing:
    """Relaxation spectrum: equilibrium modulus and moduli [1 + M] Pa, relaxation times [M] s, ascending."""

    values: np.ndarray
    times: np.ndarray


def interconverted(instantaneous: float, fluidity: float, compliances: np.ndarray, times: np.ndarray) -> Relaxing:
    """Relaxation spectrum of the creep compliance J(t) = J_0 + t / eta + sum_k J_k (1 - exp(-t / lambda_k)).

    In the Laplace domain s J(s) s E(s) = 1 (Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 3). The relaxation
    rates are the zeros of s J(s), one above each retardation rate (with flow, also one above rate zero), and the moduli
    are the residues there.

    Args:
        instantaneous: J_0 [1/Pa], positive.
        fluidity: 1 / eta [1/(Pa s)]; 0 for a solid.
        compliances: J_k [K] 1/Pa, positive.
        times: Retardation times lambda_k [K] s.
    """
    rates, weights = 1 / times, compliances / times / instantaneous
    if fluidity > 0:
        rates, weights = np.append(rates, 0.0), np.append(weights, fluidity / instantaneous)
    rates, same = np.unique(rates, return_inverse=True)
    weights = np.bincount(same, weights)
    # Zeros of 1 - sum_j w_j / (rho - r_j), one in each gap; solved for the distance from the lower end of the gap to
    # avoid cancellation.
    gaps = np.append(np.diff(rates), weights.sum())
    low, high = np.log(gaps) - 80.0, np.log(gaps)
    behind = rates[:, None] - rates
    for _ in range(80):
        middle = (low + high) / 2
        above = (weights / (behind + np.exp(middle)[:, None])).sum(1) < 1
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    distance = np.exp((low + high) / 2)
    found = rates + distance
    moduli = 1 / (instantaneous * found * (weights / (behind + distance[:, None]) ** 2).sum(1))
    equilibrium = 0.0 if fluidity > 0 else 1 / (instantaneous + compliances.sum())
    return Relaxing(values=np.append(equilibrium, moduli[::-1]), times=1 / found[::-1])


def compliance(equilibrium: float, moduli: np.ndarray, times: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Creep compliance [n] 1/Pa of a relaxation spectrum at times [n] s after a step of unit stress.

    The viscous strains obey v_i' = (e - v_i) / tau_i with the total strain
    e = (1 + sum_i E_i v_i) / (E_inf + sum_i E_i). Scaled by sqrt(E_i tau_i) the system is symmetric; its eigenmodes
    decay, except one of rate zero in a liquid.

    Args:
        equilibrium: Equilibrium modulus E_inf [Pa].
        moduli: Moduli E_i [M] Pa.
        times: Relaxation times tau_i [M] s.
        time: Times since the step [n] s.
    """
    used = moduli > 0
    stiff, tau = moduli[used], times[used]
    total = equilibrium + stiff.sum()
    root = np.sqrt(stiff / tau)
    rates, modes = np.linalg.eigh(np.diag(1 / tau) - np.outer(root, root) / total)
    if equilibrium == 0 and len(tau):
        # The mode of steady flow is known: rounding would leave it a rate of about 1e-16 times the largest.
        flow = np.sqrt(stiff * tau)
        rates[0], modes[:, 0] = 0.0, flow / np.linalg.norm(flow)
    share = modes.T @ root
    decay = np.maximum(rates, 0.0) * np.asarray(time, dtype=float)[..., None]
    grown = np.where(decay > 1e-12, -np.expm1(-decay) / np.maximum(decay, 1e-300), 1.0) * np.asarray(time)[..., None]
    return (1 + grown @ share**2 / total) / total


def relaxing(problem: Problem, found: Found, *, optimised: bool) -> tuple[Relaxing, np.ndarray]:
    """Relaxation spectrum of a fitted retardation spectrum, with standard errors.

    If the fitted instantaneous compliance is zero, the compliance of the fastest term replaces it. Terms of zero
    compliance are omitted.

    Args:
        problem: Creep problem: columns of the instantaneous compliance, of the flow without an equilibrium modulus, and
            of the terms.
        found: Fitted compliances and retardation times.
        optimised: Whether the retardation times were fitted.

    Returns:
        The spectrum, and the standard errors of the logarithms of its values [1 + M] for residuals of unit variance
        (Laplace approximation; 0 for a zero equilibrium modulus).
    """
    constant, times, first = found.values[: problem.first], found.times, problem.first
    used = np.flatnonzero(found.values[first:] > 0)
    if constant[0] == 0:
        constant = np.append(found.values[first + used[0]], constant[1:])
        used = used[1:]
    matrix, slope = problem.matrix(times)
    there = np.flatnonzero(constant > 0)
    values = np.concatenate([constant[there], found.values[first + used]])
    columns = [matrix[:, there] * values[: len(there)], matrix[:, first + used] * values[len(there) :]]
    if optimised:
        columns.append(slope[:, used] * found.values[first + used])
    jacobian = np.column_stack(columns)  # with respect to the logarithms of compliances and times

    def spectrum(logs: np.ndarray) -> Relaxing:
        spread = np.exp(logs[: len(values)]) * values
        fixed = np.zeros(2)
        fixed[there] = spread[: len(there)]
        moved = times[used] * np.exp(logs[len(values) :]) if optimised else times[used]
        return interconverted(fixed[0], fixed[1], spread[len(there) :], moved)

    step = 1e-5
    turn = [
        (_logs(spectrum(step * unit)) - _logs(spectrum(-step * unit))) / (2 * step)
        for unit in np.eye(jacobian.shape[1])
    ]
    covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14)
    errors = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", turn, covariance, turn), 0))
    return spectrum(np.zeros(jacobian.shape[1])), errors


def _logs(spectrum: Relaxing) -> np.ndarray:
    return np.log(np.where(spectrum.values > 0, spectrum.values, 1.0))
