"""Number of CPU threads that a simulation takes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_asked: int | None = None
_here: ContextVar[int | None] = ContextVar("threads", default=None)


def set_threads(count: int) -> None:
    """Take so many threads from now on."""
    global _asked
    _asked = count


@contextmanager
def threads_here(count: int) -> Iterator[None]:
    """Take so many in what this thread of Python does meanwhile: where several simulate side by side."""
    token = _here.set(count)
    try:
        yield
    finally:
        _here.reset(token)


def thread_count() -> int:
    """As many as asked for by ``torchsoro.init``, or by ``TI_CPU_MAX_NUM_THREADS``, or as the process may use."""
    if (here := _here.get()) is not None:
        return here
    if _asked is not None:
        return _asked
    given = os.environ.get("TI_CPU_MAX_NUM_THREADS")
    if given is not None and given.isdigit() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
