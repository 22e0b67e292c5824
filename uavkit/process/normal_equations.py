"""Reduced normal equations of a bundle: storage by blocks of image pairs, and their solution.

Whoever solves them gives a ``ReducedFactor``: it solves, and returns the inverse at the pattern of the blocks, which is
all that covariances of orientations and points and redundancy numbers need. ``factor_dense`` suits some hundred images;
a sparse factorisation with a selected inverse (Takahashi 1973) fits behind the same two functions.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import linalg

from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import AdjustmentError
from uavkit.process.kernels import bundle_factor
from uavkit.process.kernels.bundle_normals import Reduced
from uavkit.process.kernels.bundle_precision import Inverse

LEAST_EIGENVALUE = 2e-14
"""Of the normal matrix scaled to unit diagonal before points are eliminated; rounding leaves about 1e-15."""
SMALL = 500
"""Matrices of up to so many rows are factored without LAPACK, whose threads would only wait for one another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """Pairs of images i >= j with a block, in compressed rows; every (i, i) is there."""

    row_start: Indices
    """(n + 1,)."""
    column: Indices
    """(pairs,) ascending in each row."""

    @property
    def row(self) -> Indices:
        """Return the row i of each pair."""
        return np.repeat(np.arange(len(self.row_start) - 1), np.diff(self.row_start))

    @property
    def diagonal(self) -> Indices:
        """Return the place of each block (i, i): the last of its row."""
        return self.row_start[1:] - 1


def pattern_of_rays(image: Indices, point_start: Indices, images: int) -> Pattern:
    """Return the pairs of images that see a point in common; rays in the order of points, ``point_start`` (m + 1,)."""
    lengths = np.diff(point_start)
    keys = [np.arange(images, dtype=np.int64) * (images + 1)]
    for length in np.unique(lengths[lengths > 1]):
        rows = point_start[:-1][lengths == length]
        seen = image[rows[:, None] + np.arange(length)]
        first, second = (seen[:, index] for index in np.tril_indices(int(length), -1))
        keys.append(np.unique(np.maximum(first, second) * images + np.minimum(first, second)))
    pairs = np.unique(np.concatenate(keys))
    row_start = np.searchsorted(pairs, np.arange(images + 1, dtype=np.int64) * images)
    return Pattern(row_start=row_start.astype(np.int64), column=pairs % images)


def empty_reduced(pattern: Pattern, border: int) -> Reduced:
    """Return reduced normal equations of zeros with so many border unknowns."""
    n = len(pattern.row_start) - 1
    return Reduced(
        row_start=pattern.row_start,
        column=pattern.column,
        blocks=np.zeros((len(pattern.column), 6, 6)),
        border=np.zeros((n, 6, border)),
        corner=np.zeros((border, border)),
        right_images=np.zeros((n, 6)),
        right_border=np.zeros(border),
        diagonal_images=np.zeros((n, 6)),
        diagonal_border=np.zeros(border),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class InnerDatum:
    """Inner constraints E^T W x = 0 which give the free network of least trace(W Q), with E^T W E = 1.

    Koch (1999), Parameter estimation and hypothesis testing in linear models, sec. 3.3.
    """

    null_space: Array
    """E, (u, d): directions in which the block can move without changing an observation."""
    weight: Array
    """W, (u,) diagonal; 0 for unknowns that take no part in the datum."""


class ReducedFactor(Protocol):
    """Reduced normal equations, factored."""

    def solve(self, right: Array) -> Array:
        """Return the solution (u, ...) of a right-hand side (u, ...): six unknowns an image, then the border."""

    def inverse(self) -> Inverse:
        """Return the inverse at the pattern of the blocks."""


class Factoriser(Protocol):
    """Factors reduced normal equations."""

    def __call__(self, reduced: Reduced, damping: float, datum: "InnerDatum | None") -> ReducedFactor:
        """Factor with Levenberg damping, the datum defect, if any, fixed by inner constraints.

        Raises AdjustmentError where the equations are singular, saying which unknowns are not determined.
        """


def dense_matrix(reduced: Reduced) -> Array:
    """Return the reduced normal matrix (u, u)."""
    n, b = reduced.border.shape[0], reduced.border.shape[2]
    row = np.repeat(np.arange(n), np.diff(reduced.row_start))
    images = np.zeros((n, n, 6, 6))
    images[reduced.column, row] = reduced.blocks.transpose(0, 2, 1)
    images[row, reduced.column] = reduced.blocks
    matrix = np.empty((6 * n + b, 6 * n + b))
    matrix[: 6 * n, : 6 * n] = images.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n)
    matrix[: 6 * n, 6 * n :] = reduced.border.reshape(6 * n, b)
    matrix[6 * n :, : 6 * n] = reduced.border.reshape(6 * n, b).T
    matrix[6 * n :, 6 * n :] = reduced.corner
    return matrix


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseFactor:
    """Cholesky factor of the scaled, dense reduced normal matrix."""

    reduced: Reduced
    cholesky: Array
    scale: Array
    """(u,) unknown = scale times the factor's unknown."""
    null_space: Array
    """(u, d) directions whose variance, made by the constraints, is taken out of the inverse."""

    def solve(self, right: Array) -> Array:
        """Return the solution (u, ...)."""
        scale = self.scale.reshape(-1, *(1,) * (right.ndim - 1))
        solution = scale * solve_factored(self.cholesky, scale * right)
        return np.asarray(solution - self.null_space @ (self.null_space.T @ right))

    def inverse(self) -> Inverse:
        """Return the inverse at the pattern of the blocks."""
        reduced, n = self.reduced, len(self.reduced.border)
        full = invert_factored(self.cholesky)
        full *= self.scale * self.scale[:, None]
        full -= self.null_space @ self.null_space.T
        row = np.repeat(np.arange(n), np.diff(reduced.row_start))
        images = full[: 6 * n, : 6 * n].reshape(n, 6, n, 6).transpose(0, 2, 1, 3)
        return Inverse(
            row_start=reduced.row_start,
            column=reduced.column,
            blocks=np.ascontiguousarray(images[row, reduced.column]),
            border=np.ascontiguousarray(full[: 6 * n, 6 * n :].reshape(n, 6, -1)),
            corner=np.ascontiguousarray(full[6 * n :, 6 * n :]),
        )


def factor_dense(reduced: Reduced, damping: float, datum: "InnerDatum | None") -> ReducedFactor:
    """Factor the whole matrix by Cholesky's method (LAPACK); a ``Factoriser``."""
    diagonal = np.concatenate([reduced.diagonal_images.ravel(), reduced.diagonal_border])
    if np.any(diagonal <= 0.0):
        raise AdjustmentError(f"{name_unknown(reduced, int(np.argmin(diagonal)))} has no observation")
    matrix = dense_matrix(reduced)
    matrix[np.diag_indices_from(matrix)] += damping * diagonal
    free = np.zeros((len(matrix), 0))
    if datum is not None:
        # N + s W E E^T W, where E^T W E = 1, has the inverse N^+ + E E^T / s; s makes the added term as large as N.
        strength = float(np.median(diagonal[: 6 * len(reduced.border)] / datum.weight[: 6 * len(reduced.border)]))
        constraint = np.sqrt(strength) * datum.weight[:, None] * datum.null_space
        matrix += constraint @ constraint.T
        free = datum.null_space / np.sqrt(strength)
    scale = 1.0 / np.sqrt(diagonal)
    matrix *= scale * scale[:, None]
    cholesky, regular = cholesky_factor(matrix)
    if not regular or least_eigenvalue(cholesky) < LEAST_EIGENVALUE:
        raise AdjustmentError(describe_defect(reduced, matrix))
    return DenseFactor(reduced=reduced, cholesky=cholesky, scale=scale, null_space=free)


def cholesky_factor(matrix: Array) -> tuple[Array, bool]:
    """Return the lower Cholesky factor (u, u), and whether the matrix is positive definite."""
    if len(matrix) <= SMALL:
        factor = np.empty_like(matrix)
        return factor, bundle_factor.cholesky(matrix, factor)
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    return factor, info == 0


def solve_factored(cholesky: Array, right: Array) -> Array:
    """Return the solution (u, ...) of a right-hand side (u, ...)."""
    if len(cholesky) > SMALL or right.ndim > 1:
        return np.asarray(linalg.cho_solve((cholesky, True), right, check_finite=False))
    solution = right.copy()
    bundle_factor.solve(cholesky, solution)
    return solution


def invert_factored(cholesky: Array) -> Array:
    """Return the inverse (u, u) of the matrix that was factored."""
    if len(cholesky) <= SMALL:
        inverse = np.empty_like(cholesky)
        bundle_factor.invert(cholesky, inverse)
        return inverse
    lower, info = linalg.lapack.dpotri(cholesky, lower=1)
    if info != 0:
        raise AdjustmentError("the normal equations cannot be inverted")
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def least_eigenvalue(cholesky: Array) -> float:
    """Return an estimate, rather too large, of the least eigenvalue, by inverse iteration with a Cholesky factor.

    The factor's own diagonal would not show it: a defect may be spread over all pivots.
    """
    vector = np.cos(np.arange(1.0, len(cholesky) + 1.0))
    eigenvalue = np.inf
    for _ in range(4):
        vector /= np.linalg.norm(vector)
        vector = solve_factored(cholesky, vector)
        eigenvalue = 1.0 / max(float(np.linalg.norm(vector)), 1e-300)
    return eigenvalue


def name_unknown(reduced: Reduced, index: int) -> str:
    """Return the name of the unknown in a row of the reduced normal equations."""
    images = len(reduced.border)
    if index >= 6 * images:
        return f"border unknown {index - 6 * images} (free interior orientation, then GNSS shifts)"
    return f"image {index // 6} ({'projection centre' if index % 6 < 3 else 'rotation'})"


def describe_defect(reduced: Reduced, scaled_matrix: Array) -> str:
    """Say which unknowns singular normal equations (scaled to unit diagonal) leave open."""
    if not np.all(np.isfinite(scaled_matrix)):
        return "the normal equations are not finite: an approximate value is far from the truth"
    values, vectors = np.linalg.eigh(scaled_matrix)
    open_ = vectors[:, values < 1e-11]
    defect = max(open_.shape[1], 1)
    share = np.sum(open_**2, axis=1) if open_.size else vectors[:, 0] ** 2
    worst = np.argsort(share)[::-1][:3]
    names = ", ".join(dict.fromkeys(name_unknown(reduced, int(index)) for index in worst))
    return (
        f"the observations leave {defect} direction(s) of the unknowns undetermined, mostly {names}: "
        "give control points, GNSS positions or more tie points, or choose a free network"
    )
