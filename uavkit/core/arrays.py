"""Names for the arrays that travel through the project, and the hash that identifies their contents."""

import hashlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]


def content_hash(parts: Iterable[bytes | str | NDArray[np.generic]]) -> str:
    """Return a hexadecimal SHA-256 over bytes, texts and arrays (values, dtype and shape), in their order."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(part.encode() if isinstance(part, str) else part)
        digest.update(b"\0")
    return digest.hexdigest()
