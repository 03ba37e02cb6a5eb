"""Exclusion of functions from ``torch.compile``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")


def uncompiled(function: Callable[P, T]) -> Callable[P, T]:
    """A function that ``torch.compile`` does not trace, at the price of graph breaks.

    As ``torch.compiler.disable``, but that imports ``torch._dynamo`` (1.5 to 3 s) also where nothing is compiled.
    """
    disabled: list[Any] = []

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if not torch.compiler.is_compiling():
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function, reason="the simulator checks values before it runs"))
        return disabled[0](*args, **kwargs)

    return call
