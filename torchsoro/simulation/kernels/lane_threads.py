"""A barrier for threads that march through a simulation together, meeting every few microseconds."""

from __future__ import annotations

import sys
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from torchsoro.simulation.kernels.lanes import part

PATIENCE = 4000  # looks at the clock of a barrier, a few microseconds, before a thread lets others run
COUNT, GENERATION, SYNC = 0, 8, 16  # places in an int64 buffer, on cache lines of their own
_YIELD = "SwitchToThread" if sys.platform == "win32" else "sched_yield"


def _place(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [at])


@intrinsic
def arrive(typingctx: Any, a: Any, at: Any, number: Any) -> Any:
    """Add to a number that threads share; what it was."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.atomic_rmw("add", _place(context, builder, sig.args[0], args[0], args[1]), args[2], "seq_cst")

    return types.int64(a, types.intp, types.int64), lower


@intrinsic
def look(typingctx: Any, a: Any, at: Any) -> Any:
    """Read a number that threads share."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load_atomic(_place(context, builder, sig.args[0], args[0], args[1]), "seq_cst", 8)

    return types.int64(a, types.intp), lower


@intrinsic
def let_others(typingctx: Any) -> Any:
    """Let another thread run."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(ir.IntType(32), []), _YIELD)
        builder.call(function, [])
        return context.get_dummy_value()

    return types.void(), lower


@part
def meet(sync, threads):
    """Wait until all threads have come here."""
    if threads > 1:
        generation = look(sync, GENERATION)
        if arrive(sync, COUNT, 1) == threads - 1:
            arrive(sync, COUNT, -threads)
            arrive(sync, GENERATION, 1)
        else:
            waited = 0
            while look(sync, GENERATION) == generation:
                waited += 1
                if waited > PATIENCE:
                    let_others()
