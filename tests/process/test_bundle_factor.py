"""Cholesky's factor of small matrices, against numpy."""

import numpy as np

from uavkit.process.kernels.bundle_factor import cholesky, invert, solve


def _matrix(size: int) -> np.ndarray:
    root = np.random.default_rng(size).normal(size=(size, size + 3))
    return root @ root.T


def test_factor_solution_and_inverse() -> None:
    for size in (1, 2, 7, 60):
        matrix, factor, inverse = _matrix(size), np.full((size, size), np.nan), np.empty((size, size))
        assert cholesky(matrix, factor)
        np.testing.assert_allclose(factor, np.linalg.cholesky(matrix), rtol=1e-9, atol=1e-12)
        x = np.arange(1.0, size + 1.0)
        solve(factor, x)
        np.testing.assert_allclose(matrix @ x, np.arange(1.0, size + 1.0), rtol=1e-8)
        invert(factor, inverse)
        np.testing.assert_allclose(inverse @ matrix, np.eye(size), atol=1e-7)
        np.testing.assert_array_equal(inverse, inverse.T)


def test_matrix_that_is_not_positive_definite_is_refused() -> None:
    for matrix in (np.diag([1.0, -1.0]), np.full((2, 2), np.nan), np.ones((2, 2))):
        assert not cholesky(matrix, np.empty((2, 2)))
