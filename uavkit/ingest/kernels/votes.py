"""Counting of pairs that fit a setting of the camera's clock, on bare arrays."""

import numpy as np
from numpy.typing import NDArray

from uavkit.ingest.kernels.jit import kernel

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@kernel
def count_differences(still_s: Floats, event_s: Floats, low_s: float, cell_s: float, out: Integers) -> None:
    """Add to ``out`` (cells,) for each still and event one at the cell of their difference."""
    for i in range(len(still_s)):
        for j in range(len(event_s)):
            cell = int((still_s[i] - event_s[j] - low_s) / cell_s)
            if 0 <= cell < len(out):
                out[cell] += 1


@kernel
def count_fits(
    still_s: Floats, half_s: Floats, event_s: Floats, window: tuple[float, float, float], cells: Integers
) -> None:
    """Add to ``cells`` (k,) for each still the offsets at which an event fits it, each offset once a still.

    ``window``: the offset of the first cell, the cells' width, and the noise allowed for.
    """
    low, step, noise = window
    count = len(cells)
    begin = 0
    for i in range(len(still_s)):
        reach = half_s[i] + noise
        while begin < len(event_s) and still_s[i] - event_s[begin] > low + count * step + reach:
            begin += 1
        done = 0
        j = len(event_s) - 1
        k = begin
        while k < len(event_s) and still_s[i] - event_s[k] >= low - reach:
            k += 1
        j = k - 1
        while j >= begin:  # differences rise as events go back
            difference = still_s[i] - event_s[j]
            first = max(done, int(np.ceil((difference - reach - low) / step)))
            last = min(count - 1, int(np.floor((difference + reach - low) / step)))
            for cell in range(first, last + 1):
                cells[cell] += 1
            done = max(done, last + 1)
            j -= 1
