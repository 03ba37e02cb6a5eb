"""Launching a Taichi kernel many times with the same arguments.

A plain call of a kernel with torch tensors costs over a hundred microseconds, most of it spent on looking at its
arguments again. Here they are fixed once and the launch repeated from there, at a few microseconds each; kernels read
what changes (the number of the substep) from a buffer that they count up themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import taichi as ti
from taichi.lang import impl
from torch import Tensor


def capture(kernel, *arguments) -> Callable[[int], None]:
    """Fix a kernel's arguments: templates, contiguous tensors on Taichi's device, and integers.

    This does by hand, once, what ``Kernel.launch_kernel`` of Taichi 1.7 does on every call.

    Args:
        kernel: A ``ti.kernel``.
        *arguments: Its arguments; the tensors are kept alive by the returned function.

    Returns:
        A function that launches the kernel so many times.
    """
    primal = kernel._primal
    compiled = primal.compiled_kernels[primal.ensure_compiled(*arguments)]
    context = compiled.make_launch_context()
    slot = 0
    for argument, value in zip(primal.arguments, arguments, strict=True):
        if isinstance(argument.annotation, ti.template) or argument.annotation is ti.template:
            continue
        if isinstance(value, Tensor):
            size = value.element_size() * value.nelement()
            context.set_arg_external_array_with_shape((slot,), value.data_ptr(), size, list(value.shape), 0)
        else:
            context.set_arg_int((slot,), value)
        slot += 1
    program: Any = impl.get_runtime().prog
    data = program.compile_kernel(program.config(), program.get_device_caps(), compiled)

    def launch(times: int, alive: tuple = arguments) -> None:
        for _ in range(times):
            program.launch_kernel(data, context)

    return launch
