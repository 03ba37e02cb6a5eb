"""Tables of ``setup.toml`` that the experiments of the tests share."""

from __future__ import annotations

CLAMP = "[[clamp]]\nbox = [[-0.001, -0.001, -0.001], [0.0001, 0.021, 0.021]]\n"  # of a bar of 20 x 20 mm, at x = 0


def material(*, poisson_ratio: float = 0.4, prony: str = "[[0.5, 0.01]]") -> str:
    """A soft solid of 0.1 MPa, with Maxwell elements if any are given."""
    elements = f"prony = {prony}\n" if prony else ""
    return f"[material]\ndensity = 1000.0\nyoungs_modulus = 1e5\npoisson_ratio = {poisson_ratio}\n{elements}"


def marker(name: str, *at: float) -> str:
    """A marker at a place [m]."""
    return f'[[marker]]\nname = "{name}"\nat = {list(at)}\n'
