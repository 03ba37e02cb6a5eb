"""The engine: bodies, what acts on them, and their motion, differentiable in all of it."""

import inspect
import os

# Each of Taichi's decorators asks for the source of what imports the module, which is frozen. That it has none, inspect
# finds out by looking through all modules, each time anew: 1 of the 4.4 s in which this package is imported.
getattr(inspect, "modulesbyfile", {}).setdefault("<frozen importlib._bootstrap>", "importlib._bootstrap")
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # before any module of this folder imports Taichi
