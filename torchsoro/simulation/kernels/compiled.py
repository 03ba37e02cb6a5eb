"""Compiled code of Numba on disk."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from pathlib import Path

from numba import config

from torchsoro.simulation import laws
from torchsoro.storage import atomic_write


@functools.cache
def remove_stale_code() -> None:
    """Remove compiled code of other sources than today's, once in a process, before the first kernel is called.

    Numba by itself compares the file of the outermost function only, not what that is compiled with.
    """
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for source in [*sorted(here.glob("*.py")), Path(str(laws.__file__))]:
        digest.update(source.read_bytes())
    folders = [here / "__pycache__"]
    if config.CACHE_DIR:  # Numba names folders there by that of the source
        folders += Path(config.CACHE_DIR).glob(f"{here.name}_*")
    # A folder that cannot be written has no compiled code either: Numba then keeps it elsewhere, by the user.
    for folder in folders:
        with contextlib.suppress(OSError):
            stamp = folder / "sources.sha256"
            if not stamp.exists() or stamp.read_text() != digest.hexdigest():
                for index in folder.glob("*.nbi"):
                    index.unlink()
                with atomic_write(stamp) as file:
                    file.write(digest.hexdigest().encode())
