"""From measurements to a stable material: curves, superposition, spectrum, finite strain, what a step affords.

Each public name has one import path, its module: ``torchsoro.rheology.measured``, ``.superposition``, ``.spectrum``,
``.budget``; ``.finite``, ``.hyperelastic`` and ``.pointwise`` for tests at finite strain.
"""
