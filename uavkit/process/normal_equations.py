"""Reduced normal equations of a bundle: storage by blocks of image pairs, and their solution.

Whoever solves them gives a ``ReducedFactor``: it solves, and returns the inverse at the pattern of the blocks, which is
all that covariances of orientations and points and redundancy numbers need. ``factor_dense`` suits some hundred images;
``process.sparse_factor`` has the one for more.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import linalg

from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import AdjustmentError
from uavkit.process.blas_threads import one_blas_thread
from uavkit.process.kernels import bundle_factor
from uavkit.process.kernels import bundle_normals as kernels
from uavkit.process.kernels.bundle_normals import PairTable, Reduced
from uavkit.process.kernels.bundle_precision import Inverse

LEAST_EIGENVALUE = 2e-14
"""Of the normal matrix scaled to unit diagonal before points are eliminated; rounding leaves about 1e-15."""
SMALL = 64
"""Matrices of up to so many rows are factored without LAPACK."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """Pairs of images i >= j with a block, in compressed rows; every (i, i) is there."""

    row_start: Indices
    """(n + 1,)."""
    column: Indices
    """(pairs,) ascending in each row."""
    pairs: PairTable
    """Where the block of two images is."""

    @property
    def row(self) -> Indices:
        """Return the row i of each pair."""
        return np.repeat(np.arange(len(self.row_start) - 1), np.diff(self.row_start))

    @property
    def diagonal(self) -> Indices:
        """Return the place of each block (i, i): the last of its row."""
        return self.row_start[1:] - 1


def pattern_of_rays(image: Indices, point_start: Indices, images: int) -> Pattern:
    """Return the pairs of images that see a point in common.

    Rays in the order of points, ``point_start`` (m + 1,), the images of a point ascending.
    """
    first = np.arange(images, dtype=np.int64)
    kernels.mark_first_partners(point_start, image, first)
    widths = np.arange(images, dtype=np.int64) - first + 1
    base = np.cumsum(widths) - widths - first
    pairs = PairTable(base, first, np.zeros(int(np.sum(widths)), dtype=np.int32))
    kernels.mark_pairs(point_start, image, base, pairs.place)
    row_start = np.zeros(images + 1, dtype=np.int64)
    column = np.empty(kernels.number_pairs(pairs, row_start), dtype=np.int64)
    kernels.list_columns(pairs, column)
    return Pattern(row_start=row_start, column=column, pairs=pairs)


def empty_reduced(pattern: Pattern, border: int, image_unknowns: int = 6) -> Reduced:
    """Return reduced normal equations of zeros with so many unknowns of the border and of each image."""
    n, d = len(pattern.row_start) - 1, image_unknowns
    return Reduced(
        row_start=pattern.row_start,
        column=pattern.column,
        blocks=np.zeros((len(pattern.column), d, d)),
        border=np.zeros((n, d, border)),
        corner=np.zeros((border, border)),
        right_images=np.zeros((n, d)),
        right_border=np.zeros(border),
        diagonal_images=np.zeros((n, d)),
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
    n, d, b = reduced.border.shape
    row = np.repeat(np.arange(n), np.diff(reduced.row_start))
    images = np.zeros((n, n, d, d))
    images[reduced.column, row] = reduced.blocks.transpose(0, 2, 1)
    images[row, reduced.column] = reduced.blocks
    matrix, u = np.empty((d * n + b, d * n + b)), d * n
    matrix[:u, :u] = images.transpose(0, 2, 1, 3).reshape(u, u)
    matrix[:u, u:] = reduced.border.reshape(u, b)
    matrix[u:, :u] = reduced.border.reshape(u, b).T
    matrix[u:, u:] = reduced.corner
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
        reduced, (n, d, _) = self.reduced, self.reduced.border.shape
        full = invert_factored(self.cholesky)
        full *= self.scale * self.scale[:, None]
        full -= self.null_space @ self.null_space.T
        row = np.repeat(np.arange(n), np.diff(reduced.row_start))
        images = full[: d * n, : d * n].reshape(n, d, n, d).transpose(0, 2, 1, 3)
        return Inverse(
            row_start=reduced.row_start,
            column=reduced.column,
            blocks=np.ascontiguousarray(images[row, reduced.column]),
            border=np.ascontiguousarray(full[: d * n, d * n :].reshape(n, d, -1)),
            corner=np.ascontiguousarray(full[d * n :, d * n :]),
        )


@one_blas_thread()
def factor_dense(reduced: Reduced, damping: float, datum: "InnerDatum | None") -> ReducedFactor:
    """Factor the whole matrix by Cholesky's method (LAPACK); a ``Factoriser``."""
    diagonal = check_observed(reduced)
    matrix = dense_matrix(reduced)
    matrix[np.diag_indices_from(matrix)] += damping * diagonal
    free = np.zeros((len(matrix), 0))
    if datum is not None:
        # N + s W E E^T W, where E^T W E = 1, has the inverse N^+ + E E^T / s; s makes the added term as large as N.
        held = datum.weight > 0.0
        strength = float(np.median(diagonal[held] / datum.weight[held]))
        constraint = np.sqrt(strength) * datum.weight[:, None] * datum.null_space
        matrix += constraint @ constraint.T
        free = datum.null_space / np.sqrt(strength)
    scale = 1.0 / np.sqrt(diagonal)
    matrix *= scale * scale[:, None]
    cholesky, regular = cholesky_factor(matrix)
    if not regular or least_eigenvalue(cholesky) < LEAST_EIGENVALUE:
        raise AdjustmentError(describe_defect(reduced, matrix))
    return DenseFactor(reduced=reduced, cholesky=cholesky, scale=scale, null_space=free)


def check_observed(reduced: Reduced) -> Array:
    """Return the diagonal (u,) before points were eliminated; raise AdjustmentError where an unknown has none."""
    diagonal = np.concatenate([reduced.diagonal_images.ravel(), reduced.diagonal_border])
    if np.any(diagonal <= 0.0):
        raise AdjustmentError(f"{name_unknown(reduced, int(np.argmin(diagonal)))} has no observation")
    return diagonal


@one_blas_thread()
def cholesky_factor(matrix: Array) -> tuple[Array, bool]:
    """Return the lower Cholesky factor (u, u), and whether the matrix is positive definite."""
    if len(matrix) <= SMALL:
        factor = np.empty_like(matrix)
        return factor, bundle_factor.cholesky(matrix, factor)
    factor, info = linalg.lapack.dpotrf(matrix, lower=1, clean=1)
    return factor, info == 0


@one_blas_thread()
def solve_factored(cholesky: Array, right: Array) -> Array:
    """Return the solution (u, ...) of a right-hand side (u, ...)."""
    if len(cholesky) > SMALL or right.ndim > 1:
        return np.asarray(linalg.cho_solve((cholesky, True), right, check_finite=False))
    solution = right.copy()
    bundle_factor.solve(cholesky, solution)
    return solution


@one_blas_thread()
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
    images, d, _ = reduced.border.shape
    if index >= d * images:
        return f"border unknown {index - d * images} (free interior orientation, then GNSS shifts, then latencies)"
    kind = ("projection centre", "rotation")[index % d // 3] if index % d < 6 else "interior orientation"
    return f"image {index // d} ({kind})"


def describe_defect(reduced: Reduced, scaled_matrix: Array) -> str:
    """Say which unknowns singular normal equations (scaled to unit diagonal) leave open."""
    if not np.all(np.isfinite(scaled_matrix)):
        return name_defect(reduced, np.full(len(scaled_matrix), np.nan), 1)
    values, vectors = np.linalg.eigh(scaled_matrix)
    open_ = vectors[:, values < 1e-11]
    share = np.sum(open_**2, axis=1) if open_.size else vectors[:, 0] ** 2
    return name_defect(reduced, share, max(open_.shape[1], 1))


def name_defect(reduced: Reduced, share: Array, defect: int) -> str:
    """Say which unknowns are open, by their share (u,) in the undetermined directions; NaN: nothing is finite."""
    if not np.all(np.isfinite(share)):
        return "the normal equations are not finite: an approximate value is far from the truth"
    worst = np.argsort(share)[::-1][:3]
    names = ", ".join(dict.fromkeys(name_unknown(reduced, int(index)) for index in worst))
    return (
        f"the observations leave {defect} direction(s) of the unknowns undetermined, mostly {names}: "
        "give control points, GNSS positions or more tie points, or choose a free network"
    )
