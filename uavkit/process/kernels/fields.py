"""Square pixels from the lines of a field, and what tells whether a picture can be used: inner loops."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel


@kernel
def square_lines(lines: NDArray[np.uint8], parity: int, result: NDArray[np.uint8]) -> None:
    """Write the k lines (k, w) into every other row of result (2 k, w), from row parity on, and fill in between.

    The rows between are the cubic (-1 9 9 -1) / 16 of the four nearest lines; beyond the outermost that is repeated.
    """
    count, width = lines.shape
    for row in range(count):
        for column in range(width):
            result[2 * row + parity, column] = lines[row, column]
    for row in range(count):
        lower = row + 1 if parity == 0 else row
        first, second = lines[min(max(lower - 2, 0), count - 1)], lines[min(max(lower - 1, 0), count - 1)]
        third, fourth = lines[min(lower, count - 1)], lines[min(lower + 1, count - 1)]
        target = result[2 * row + 1 - parity]
        for column in range(width):
            inner = np.int16(9 * np.int16(np.int16(second[column]) + np.int16(third[column])))
            outer = np.int16(np.int16(first[column]) + np.int16(fourth[column]))
            value = np.int16(np.int16(inner - outer + 8) >> 4)
            target[column] = np.uint8(min(max(value, np.int16(0)), np.int16(255)))


@kernel
def brightness(image: NDArray[np.uint8], limit: int, sums: NDArray[np.int64]) -> None:
    """Sums over a picture: sums = (grey values, their squares, pixels brighter than limit)."""
    sums[:] = 0
    for row in range(image.shape[0]):
        total = squares = np.int32(0)
        bright = np.int32(0)
        for column in range(image.shape[1]):
            value = np.int32(image[row, column])
            total += value
            squares += value * value
            bright += np.int32(value > limit)
        sums[0] += total
        sums[1] += squares
        sums[2] += bright
