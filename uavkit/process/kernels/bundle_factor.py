"""Cholesky's factor, solution and inverse of small, dense symmetric matrices.

For a block of some ten images LAPACK's threads wait for one another a hundred times longer than they calculate.
Golub and Van Loan, Matrix computations, sec. 4.2.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel, summing_kernel

Array = NDArray[np.float64]


@summing_kernel
def scalar_product(a: Array, b: Array, first: int, last: int) -> float:
    """Return the sum of a[i] b[i] for i from first up to, not including, last."""
    total = 0.0
    for i in range(first, last):
        total += a[i] * b[i]
    return total


@kernel
def cholesky(matrix: Array, factor: Array) -> bool:
    """Write the lower factor L (u, u), L L^T = matrix, zeros above; False where the matrix is not positive definite."""
    for i in range(len(matrix)):
        for j in range(i):
            factor[i, j] = (matrix[i, j] - scalar_product(factor[i], factor[j], 0, j)) / factor[j, j]
            factor[j, i] = 0.0
        pivot = matrix[i, i] - scalar_product(factor[i], factor[i], 0, i)
        if not pivot > 0.0:
            return False
        factor[i, i] = np.sqrt(pivot)
    return True


@kernel
def solve(factor: Array, x: Array) -> None:
    """Overwrite the right-hand side x (u,) with the solution of L L^T x = right."""
    n = len(factor)
    for i in range(n):
        x[i] = (x[i] - scalar_product(factor[i], x, 0, i)) / factor[i, i]
    for i in range(n - 1, -1, -1):
        x[i] /= factor[i, i]
        for j in range(i):
            x[j] -= factor[i, j] * x[i]


@kernel
def invert(factor: Array, inverse: Array) -> None:
    """Write (L L^T)^-1 (u, u)."""
    n = len(factor)
    columns = np.zeros((n, n))
    for j in range(n):
        columns[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            columns[j, i] = -scalar_product(factor[i], columns[j], j, i) / factor[i, i]
    for i in range(n):
        for j in range(i + 1):
            value = scalar_product(columns[i], columns[j], i, n)
            inverse[i, j], inverse[j, i] = value, value
