"""Start of Taichi, on the device of the tensors."""

from __future__ import annotations

import atexit
import contextlib
import io
from typing import Any

import taichi as ti
import torch
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

from torchsoro.simulation.threads import set_threads

_started: str | None = None

# Taichi writes compiled kernels to its cache on disk when it is reset, which it does not always do at exit.
atexit.register(ti.reset)


def _remember_positions() -> None:
    """Cache the source positions of kernel nodes, which Taichi formats for messages at every inlining.

    This formatting takes a third to a half of the time in which Taichi parses the adjoint kernels, cached or not.
    """
    describe, known = ASTTransformerContext.get_pos_info, {}

    def remembered(self: ASTTransformerContext, node: Any) -> str:
        first, last = (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)
        at = self.file, self.lineno_offset, first, last, type(node)
        if at not in known:
            known[at] = describe(self, node)
        return known[at]

    ASTTransformerContext.get_pos_info = remembered


_remember_positions()


def init(device: str | torch.device = "cpu", *, threads: int | None = None) -> None:
    """Start Taichi for a device; called by the first simulation, so that importing torchsoro costs nothing.

    A process works on one kind of device at a time. Asking for another starts Taichi anew, which recompiles (from the
    cache on disk) but leaves every tensor as it is.

    Args:
        device: "cpu" or "cuda".
        threads: CPU threads; all cores if None.

    Raises:
        ValueError: if the device is neither, or CUDA is asked for where there is none.
    """
    global _started
    kind = str(device).partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device = {str(device)!r}: wanted 'cpu' or 'cuda'")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError("device = 'cuda': this machine has no CUDA device that torch can use; wanted 'cpu'")
    if threads is not None:
        set_threads(threads)
    if _started == kind and threads is None:
        return
    options: dict[str, Any] = {} if threads is None else {"cpu_max_num_threads": threads}
    # Code of LLVM's passes alone is as fast; Taichi's take ten times as long on the large adjoint kernels.
    options["advanced_optimization"] = False
    # Tensors are allocated by torch, so that Taichi needs little memory of its own on the GPU.
    if kind == "cuda":
        options["device_memory_GB"] = 0.3
        # Taichi would start thousands of blocks for every loop, most of them empty.
        options["saturating_grid_dim"] = 4 * torch.cuda.get_device_properties(0).multi_processor_count
    with contextlib.redirect_stdout(io.StringIO()):  # Taichi prints the device that it starts on
        ti.init(arch=ti.cuda if kind == "cuda" else ti.cpu, offline_cache=True, log_level=ti.WARN, **options)
    _started = kind
