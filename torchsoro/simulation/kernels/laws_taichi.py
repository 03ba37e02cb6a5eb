"""The laws as functions that Taichi inlines."""

from __future__ import annotations

import math
from types import FunctionType, SimpleNamespace

import taichi as ti

from torchsoro.simulation import laws as text


def _compiled() -> SimpleNamespace:
    """Each law of the text as a ``ti.func``, which sees the others, and Taichi's functions for those of ``math``."""
    names = dict(vars(text))
    for name, value in vars(text).items():
        if isinstance(value, FunctionType):
            # Taichi finds a function's text by its code, and what it calls by its globals.
            names[name] = ti.func(FunctionType(value.__code__, names, name))
        elif getattr(math, name, None) is value:
            names[name] = getattr(ti, name)
    return SimpleNamespace(**{name: value for name, value in names.items() if not name.startswith("_")})


laws = _compiled()
