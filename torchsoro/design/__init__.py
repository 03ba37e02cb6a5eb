"""Topology optimization: domain, density field, objective, constraint, robot, and the loop."""
