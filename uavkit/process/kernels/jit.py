"""The one way in which inner loops are compiled."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile an inner loop on bare arrays; it runs without the interpreter lock, so threads may share the work."""
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return cast(Function, compiled)


def summing_kernel(function: Function) -> Function:
    """Like kernel, for loops that only add up: the compiler may choose the order of the sum (once and for all)."""
    flags = {"reassoc", "nsz", "contract"}
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=flags)(function)
    return cast(Function, compiled)
