"""The one way in which the simulator compiles its inner loops.

``nogil`` lets several images be rendered at the same time in threads; ``parallel=True`` is never used, so that the
result does not depend on the number of workers.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function of bare arrays and numbers to machine code, kept in the cache beside the source."""
    compiled: F = njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def inlined(function: F) -> F:
    """The same for a small function that disappears inside its caller: passing arrays costs more than its work."""
    compiled: F = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)
    return compiled
