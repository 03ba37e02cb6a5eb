"""Compiled code of Numba on disk."""

from __future__ import annotations

import contextlib
import functools
from pathlib import Path


@functools.cache
def remove_stale_code() -> None:
    """Remove compiled code that is older than a source, once in a process, before the first kernel is called.

    Numba by itself compares the file of the outermost function only.
    """
    here = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in (here.parent / "laws.py", *here.glob("*.py")))
    for index in here.glob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):
            if index.stat().st_mtime < newest:
                index.unlink()
