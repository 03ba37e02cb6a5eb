"""What the segments of a run have in common, computed by the first of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from torch import Tensor

from torchsoro.simulation.ops.scene import Scene

T = TypeVar("T")

# Of each scene what is kept under a name: the tensors it was computed from, their versions, and the outcome.
_known: WeakKeyDictionary[Scene, dict[str, tuple[list[Tensor], list[int], Any]]] = WeakKeyDictionary()


def once(scene: Scene, name: str, tensors: list[Tensor], compute: Callable[[], T]) -> T:
    """What ``compute`` returns; of each steady scene and name the last outcome is kept for calls with the same tensors.

    Tensors are the same if they share memory, shape and version, which operations in place raise unless they go by
    ``data``: hence of steady scenes only. What is kept must not refer to the scene, with which it goes, and nobody may
    write to it.

    Args:
        scene: Constant data.
        name: Of what is computed.
        tensors: That it depends on; if none, it is kept of any scene.
        compute: Called without arguments where nothing is kept for these tensors.
    """
    given = [t.detach() for t in tensors]
    if (given and not scene.steady) or any(t.is_inference() for t in given):  # these have no version
        return compute()
    kept = _known.setdefault(scene, {})
    versions = [t._version for t in given]
    if name in kept:
        before, at, found = kept[name]
        if at == versions and all(map(_same, before, given)):
            return found
    found = compute()
    kept[name] = given, versions, found
    return found


def _same(a: Tensor, b: Tensor) -> bool:
    def address(t: Tensor) -> tuple:
        return t.data_ptr(), t.shape, t.stride(), t.dtype, t.device

    return address(a) == address(b)
