"""Launching a Taichi kernel many times with the same arguments.

A plain call of a kernel with torch tensors costs over a hundred microseconds, most of it spent on checking its
arguments. Here they are fixed once and the launch is repeated, at a few microseconds each; kernels read the number of
the substep from a buffer and increment it themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import taichi as ti
from taichi.lang import impl
from torch import Tensor

# Compiled kernels, as a lookup in Taichi takes milliseconds. The key is an address, so that kernel and program are kept
# alive.
_compiled: dict[tuple[int, int], tuple[Any, Any, Any]] = {}


def capture(kernel, *arguments) -> Callable[..., None]:
    """Fix a kernel's arguments: templates, contiguous tensors on Taichi's device, and integers.

    This does by hand, once, what ``Kernel.launch_kernel`` of Taichi 1.7 does on every call.

    Args:
        kernel: A ``ti.kernel``.
        *arguments: Its arguments; the tensors are kept alive by the returned function.

    Returns:
        A function that launches the kernel so many times, with other integers in place of the first ones if it is given
        some.
    """
    primal = kernel._primal
    compiled = primal.compiled_kernels[primal.ensure_compiled(*arguments)]
    program: Any = impl.get_runtime().prog
    if (id(program), id(compiled)) not in _compiled:
        data = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
        _compiled[id(program), id(compiled)] = program, compiled, data
    data = _compiled[id(program), id(compiled)][2]
    values = [
        value
        for argument, value in zip(primal.arguments, arguments, strict=True)
        if not (isinstance(argument.annotation, ti.template) or argument.annotation is ti.template)
    ]
    tensors = [
        ((slot,), value.data_ptr(), value.element_size() * value.nelement(), list(value.shape), 0)
        for slot, value in enumerate(values)
        if isinstance(value, Tensor)
    ]
    integers = [((slot,), value) for slot, value in enumerate(values) if not isinstance(value, Tensor)]

    def prepare() -> Any:
        context = compiled.make_launch_context()
        for each in tensors:
            context.set_arg_external_array_with_shape(*each)
        for each in integers:
            context.set_arg_int(*each)
        return context

    # A launch on CUDA moves the arguments to the device and leaves the context unusable.
    lasting = None if any(value.is_cuda for value in values if isinstance(value, Tensor)) else prepare()

    def launch(times: int, *others: int, alive: tuple = arguments) -> None:
        for _ in range(times):
            context = lasting or prepare()
            for (slot, _), value in zip(integers, others, strict=False):
                context.set_arg_int(slot, value)
            program.launch_kernel(data, context)

    return launch
