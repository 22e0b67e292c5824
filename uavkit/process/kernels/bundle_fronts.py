"""Parts of fronts: blocks of image pairs put in and taken out, and what one front passes to another.

Fronts have contiguous columns; of symmetric ones that are to be factored only the lower triangle is right.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@kernel
def add_part(matrix: Array, into: Indices, part: Array) -> None:
    """Add the lower triangle of a symmetric part (b, b) to the lower triangle of a front; its rows are ``into``."""
    for k in range(len(into)):
        for m in range(k, len(into)):
            if into[m] >= into[k]:
                matrix[into[m], into[k]] += part[m, k]
            else:
                matrix[into[k], into[m]] += part[m, k]


@kernel
def take_part(matrix: Array, rows: Indices, part: Array) -> None:
    """Write rows and columns of a front to a part (b, b)."""
    for k in range(len(rows)):
        for m in range(len(rows)):
            part[m, k] = matrix[rows[m], rows[k]]


@kernel
def add_blocks(matrix: Array, blocks: Array, chosen: Indices, row: Indices, column: Indices, turned: Indices) -> None:
    """Add blocks (d, d) to a front, each at its first row and column, some transposed."""
    d = blocks.shape[1]
    for number in range(len(chosen)):
        block, r, c = blocks[chosen[number]], row[number], column[number]
        for k in range(d):
            for m in range(d):
                matrix[r + k, c + m] += block[m, k] if turned[number] else block[k, m]


@kernel
def take_blocks(matrix: Array, blocks: Array, chosen: Indices, row: Indices, column: Indices, turned: Indices) -> None:
    """Write blocks (d, d) from a front, each from its first row and column, some transposed."""
    d = blocks.shape[1]
    for number in range(len(chosen)):
        block, r, c = blocks[chosen[number]], row[number], column[number]
        for k in range(d):
            for m in range(d):
                if turned[number]:
                    block[m, k] = matrix[r + k, c + m]
                else:
                    block[k, m] = matrix[r + k, c + m]
