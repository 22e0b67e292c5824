"""Matrix products of one thread: fronts of some hundred unknowns are too small to share.

OpenBLAS's threads wait for one another in a loop; where a processor has other work, too, that costs ten times what the
arithmetic does. And what one thread adds up has the same last bit on every machine.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy
import scipy

SUFFIXES = ("", "64_")


@cache
def _switches() -> tuple[tuple[Callable[[], int], Callable[[int], None]], ...]:
    """Return how to get and set the number of threads of each OpenBLAS that numpy and scipy have brought with them."""
    found = []
    for package in (numpy, scipy):
        folder = Path(str(package.__file__)).parents[1] / f"{package.__name__}.libs"
        for path in sorted(folder.glob("*openblas*")):
            library = ctypes.CDLL(str(path))
            for suffix in SUFFIXES:
                get = getattr(library, f"scipy_openblas_get_num_threads{suffix}", None)
                set_ = getattr(library, f"scipy_openblas_set_num_threads{suffix}", None)
                if get is not None and set_ is not None:
                    found.append((get, set_))
    return tuple(found)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let matrix products run in the calling thread; with a BLAS that is not known here, as it likes."""
    before = [get() for get, _ in _switches()]
    for _, set_threads in _switches():
        set_threads(1)
    try:
        yield
    finally:
        for (_, set_threads), number in zip(_switches(), before, strict=True):
            set_threads(number)
