"""The laws as functions that Numba inlines, in float32 or float64."""

from __future__ import annotations

import ast
import functools
from pathlib import Path
from types import FunctionType, SimpleNamespace

import numpy as np
from numba import njit

from torchsoro.simulation import laws as text

_OPTIONS = {"fastmath": True, "boundscheck": False, "error_model": "numpy", "nogil": True, "_nrt": False}


class _Real(ast.NodeTransformer):
    """Gives every number of a text the type of the laws: beside a float32 Numba would compute in float64."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """``2`` becomes ``real(2)``."""
        if isinstance(node.value, bool) or not isinstance(node.value, int | float):
            return node
        return ast.copy_location(ast.Call(ast.Name("real", ast.Load()), [node], []), node)


@functools.cache
def real(dtype: type[np.floating]) -> SimpleNamespace:
    """The laws for numbers of a type; what is not an integer is to be of that type.

    A kernel names them as globals of its module (``laws = real(np.float32)``, ``response = laws.response``): Numba does
    not keep the code of a function on disk that has them from an outer function.

    Args:
        dtype: ``np.float32`` or ``np.float64``.
    """
    path = Path(str(text.__file__))
    tree = ast.fix_missing_locations(_Real().visit(ast.parse(path.read_text(encoding="utf-8"))))
    names = {"real": dtype, "__name__": f"{text.__name__}_{dtype.__name__}"}
    exec(compile(tree, path, "exec"), names)
    for name, value in names.items():
        if isinstance(value, FunctionType):
            names[name] = njit(**_OPTIONS, forceinline=True)(value)
    return SimpleNamespace(**{name: value for name, value in names.items() if not name.startswith("_")})
