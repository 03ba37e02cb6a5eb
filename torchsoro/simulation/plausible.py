"""Ranges that hold every soft solid in SI units; what lies outside is in another unit."""

MODULUS = (1e2, 1e10)  # Pa
DENSITY = (10.0, 3e4)  # kg/m3
