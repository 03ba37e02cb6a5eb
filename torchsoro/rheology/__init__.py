"""From the rheometer to a stable material: measured curves, superposition, relaxation spectrum, what a step affords.

Each public name has one import path, its module: ``torchsoro.rheology.measured``, ``.superposition``, ``.spectrum``,
``.budget``.
"""
