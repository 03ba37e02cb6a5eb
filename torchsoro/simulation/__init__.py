"""The engine: bodies, what acts on them, and their motion, differentiable in all of it."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # before any module of this folder imports Taichi
