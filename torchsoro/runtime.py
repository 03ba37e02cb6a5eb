"""The one place that starts Taichi, on the device that the tensors live on."""

from __future__ import annotations

import os
from typing import Any

import torch

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

import taichi as ti

_started: str | None = None


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
    kind = torch.device(device).type
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device = {str(device)!r}: wanted 'cpu' or 'cuda'")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError("device = 'cuda': this machine has no CUDA device that torch can use; wanted 'cpu'")
    if _started == kind and threads is None:
        return
    options: dict[str, Any] = {} if threads is None else {"cpu_max_num_threads": threads}
    # On a CPU, LLVM's own passes do as well in a tenth of the time that Taichi's take on the large adjoint kernels.
    options["advanced_optimization"] = kind == "cuda"
    # Memory comes from torch; Taichi needs next to none on the GPU.
    if kind == "cuda":
        options["device_memory_GB"] = 0.3
        # Taichi would start thousands of blocks for every loop, most of them empty.
        options["saturating_grid_dim"] = 4 * torch.cuda.get_device_properties(0).multi_processor_count
    ti.init(arch=ti.cuda if kind == "cuda" else ti.cpu, offline_cache=True, log_level=ti.WARN, **options)
    _started = kind
