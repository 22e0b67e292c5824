"""Grey values of the stills in use, a few at a time: memory does not grow with the number of stills."""

import ctypes
from collections import OrderedDict
from functools import cache, lru_cache
from threading import Lock

from uavkit.core.arrays import Image
from uavkit.core.devices import StillSource
from uavkit.core.errors import InputError
from uavkit.process.contrast import visible
from uavkit.process.pyramid import ImagePyramid, build_pyramid

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of glibc's malloc.h
_LARGE_BYTES = 4 * 2**20


@cache
def return_freed_memory() -> None:
    """Let the C library give large blocks back to the system as soon as they are freed, where it is glibc.

    By itself it keeps them once some were freed, in heaps of each thread that picture after picture breaks up: 80
    stills of 12 megapixels then took 4.0 GB instead of 1.6 GB, and each further one 44 MB more.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_ARENA_MAX, 2)


class PictureStore:
    """Decoded stills, the least recently used forgotten first; safe to use from several threads."""

    def __init__(self, source: StillSource, names: tuple[str, ...], capacity_mb: float = 600.0) -> None:
        self._source = source
        self._capacity_bytes = capacity_mb * 1e6
        self._kept: OrderedDict[int, Image] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()
        self.names = names

    def __len__(self) -> int:
        return len(self.names)

    def grey(self, index: int) -> Image:
        """Return the grey values (height, width) of a still by its row; raises InputError where it is unreadable."""
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
        picture = self._source.grey(self.names[index])
        if picture.ndim != 2:
            raise InputError(f"{self.names[index]}: grey values must be (height, width), are {picture.shape}")
        with self._lock:
            if index not in self._kept:
                self._kept[index] = picture
                self._bytes += picture.nbytes
            while self._bytes > self._capacity_bytes and len(self._kept) > 2:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return picture

    def fingerprint(self, index: int) -> str:
        """Return the hash of a still's content."""
        return self._source.fingerprint(self.names[index])


class PyramidStore:
    """Image pyramids of the stills in use, a few at a time; stills of faint ground are stretched."""

    def __init__(self, store: PictureStore, capacity: int = 16, levels: int = 4) -> None:
        self._build = lru_cache(maxsize=capacity)(lambda index: build_pyramid(visible(store.grey(index)), levels))

    def get(self, index: int) -> ImagePyramid:
        """Return the pyramid of a still by its row."""
        return self._build(index)
