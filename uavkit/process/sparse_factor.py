"""Reduced normal equations of large blocks: multifrontal Cholesky factor, and the inverse at the pattern.

Duff and Reid (1983), ACM TOMS 9, for the factor; Takahashi, Fagan and Chin (1973) and Erisman and Tinney (1975) for
those elements of the inverse that lie in the pattern of the factor. All arithmetic is on dense fronts (LAPACK); the
border (shared unknowns) belongs to every front, and is eliminated last.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack

from uavkit.core.arrays import Array, Indices
from uavkit.core.errors import AdjustmentError
from uavkit.process.blas_threads import one_blas_thread
from uavkit.process.elimination import Elimination, dissect
from uavkit.process.kernels import bundle_fronts as kernels
from uavkit.process.kernels.bundle_normals import Reduced
from uavkit.process.kernels.bundle_precision import Inverse
from uavkit.process.normal_equations import (
    LEAST_EIGENVALUE,
    Factoriser,
    InnerDatum,
    Pattern,
    ReducedFactor,
    check_observed,
    factor_dense,
    name_defect,
)

FEWEST_IMAGES = 100
"""Blocks of fewer images are factored as a whole."""
OPEN_EIGENVALUE = 1e-11
"""Directions with eigenvalues below this (scaled to unit diagonal) are told as undetermined."""
TRIED_DIRECTIONS = 12
"""So many directions at most are looked for where the equations are singular."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontRows:
    """Unknowns of a front, and where they are in the front that takes them up."""

    own: Indices
    """(s,) unknowns eliminated here."""
    boundary: Indices
    """(b,) later unknowns tied to them; the border's last."""
    parent: int
    in_parent: Indices
    """(b,) rows of the boundary in the parent's front, own unknowns before boundary."""
    blocks: Indices
    """Blocks of image pairs first met here."""
    block_row: Indices
    """First row of each of these blocks in the front."""
    block_column: Indices
    """First column, not right of the row."""
    turned: Indices
    """1 where the front has the transposed block."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontFactor:
    """Cholesky factor of a front: own unknowns (s, s), lower, and rows of the boundary (b, s); columns contiguous."""

    own: Array
    boundary: Array


def choose_factoriser(pattern: Pattern, centres_m: Array) -> Factoriser:
    """Return the way to factor the equations of a block: as a whole where it is small, else front by front."""
    if len(centres_m) < FEWEST_IMAGES:
        return factor_dense
    return SparseFactoriser(dissect(pattern, centres_m))


class SparseFactoriser:
    """A ``Factoriser`` that eliminates images in a given order."""

    __slots__ = ("_rows", "elimination")

    def __init__(self, elimination: Elimination) -> None:
        self.elimination = elimination
        self._rows: dict[tuple[int, int], list[FrontRows]] = {}

    def __call__(self, reduced: Reduced, damping: float, datum: InnerDatum | None) -> ReducedFactor:
        """Factor; see ``Factoriser``."""
        diagonal = check_observed(reduced)
        _, d, border = reduced.border.shape
        if (d, border) not in self._rows:
            self._rows[d, border] = front_rows(self.elimination, reduced, d, border)
        rows = self._rows[d, border]
        held = None if datum is None else _root_datum(datum, rows, diagonal)
        scaled = _scaled(reduced, diagonal, damping)
        factors = _factor(rows, scaled, held)
        if factors is not None:
            result = SparseFactor(reduced, rows, factors, 1.0 / np.sqrt(diagonal), datum)
            if result.least_eigenvalue() >= LEAST_EIGENVALUE:
                return result
        raise AdjustmentError(_describe_defect(reduced, rows, scaled, held))


def front_rows(elimination: Elimination, reduced: Reduced, d: int, border: int) -> list[FrontRows]:
    """Return the unknowns of all fronts; the last one has the border, (border,) unknowns after d for each image."""
    fronts, images = elimination.fronts, len(elimination.rank)
    shared = d * images + np.arange(border)
    own = [*(_unknowns(front.own, d) for front in fronts), shared]
    boundary = [*(np.concatenate([_unknowns(front.boundary, d), shared]) for front in fronts), shared[:0]]
    parent = np.array([*(len(fronts) if front.parent < 0 else front.parent for front in fronts), -1])
    place = np.empty(d * images + border, dtype=np.int64)
    in_parent = [shared[:0]] * len(own)
    blocks = _blocks_of_fronts(elimination, reduced)
    result = []
    for number in range(len(own)):
        place[np.concatenate([own[number], boundary[number]])] = np.arange(len(own[number]) + len(boundary[number]))
        for child in np.flatnonzero(parent == number):
            in_parent[child] = place[boundary[child]]
        chosen, early, late, turned = blocks[number] if number < len(fronts) else (shared[:0],) * 4
        result.append((chosen, place[d * late], place[d * early], turned))
    return [
        FrontRows(
            own=own[number], boundary=boundary[number], parent=int(parent[number]), in_parent=in_parent[number],
            blocks=chosen, block_row=row, block_column=column, turned=turned,
        )
        for number, (chosen, row, column, turned) in enumerate(result)
    ]  # fmt: skip


def _unknowns(images: Indices, d: int) -> Indices:
    return (d * images[:, None] + np.arange(d)).ravel()


def _blocks_of_fronts(elimination: Elimination, reduced: Reduced) -> list[tuple[Indices, Indices, Indices, Indices]]:
    """Return for each front its blocks, their images in the order of elimination, and which blocks are turned by it."""
    i, j = np.repeat(np.arange(len(elimination.rank)), np.diff(reduced.row_start)), reduced.column
    swapped = elimination.rank[i] < elimination.rank[j]
    early, late = np.where(swapped, i, j), np.where(swapped, j, i)
    of_front = elimination.front_of_image[early]
    order = np.argsort(of_front, kind="stable")
    bounds = np.searchsorted(of_front[order], np.arange(len(elimination.fronts) + 1))
    chosen = [order[bounds[k] : bounds[k + 1]] for k in range(len(elimination.fronts))]
    return [(rows, early[rows], late[rows], swapped[rows].astype(np.int64)) for rows in chosen]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaledEquations:
    """Damped reduced normal equations, scaled to a diagonal of about one before points were eliminated."""

    blocks: Array
    border: Array
    """(u, b)."""
    corner: Array


def _scaled(reduced: Reduced, diagonal: Array, damping: float) -> ScaledEquations:
    n, d, b = reduced.border.shape
    scale = 1.0 / np.sqrt(diagonal)
    of_image, of_border = scale[: d * n].reshape(n, d), scale[d * n :]
    row = np.repeat(np.arange(n), np.diff(reduced.row_start))
    blocks = reduced.blocks * of_image[row][:, :, None]
    blocks *= of_image[reduced.column][:, None, :]
    last = reduced.row_start[1:] - 1
    blocks[last] += damping * np.eye(d)
    corner = reduced.corner * of_border * of_border[:, None] + damping * np.eye(b)
    return ScaledEquations(
        blocks=blocks, border=reduced.border.reshape(d * n, b) * scale[: d * n, None] * of_border, corner=corner
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _HeldFront:
    """A datum that one front alone fixes: constraints (s, 7) of its own unknowns, scaled, to add to the matrix."""

    number: int
    constraint: Array


def _root_datum(datum: InnerDatum, rows: Sequence[FrontRows], diagonal: Array) -> _HeldFront:
    """Return the inner constraints of the images eliminated last, as strong as their normal equations.

    The datum of all images would fill the matrix; that of one front does not, and S-transformations (Baarda 1973) turn
    the solution into that of all.
    """
    number = max(range(len(rows) - 1), key=lambda k: (rows[k].parent == len(rows) - 1, len(rows[k].own)))
    own = rows[number].own
    space, weight = datum.null_space[own], datum.weight[own]
    _, triangle = np.linalg.qr(np.sqrt(weight)[:, None] * space)
    constraint = weight[:, None] * np.linalg.solve(triangle.T, space.T).T
    held = weight > 0.0
    strength = float(np.median(diagonal[own][held] / weight[held]))
    return _HeldFront(number=number, constraint=np.sqrt(strength) * constraint / np.sqrt(diagonal[own])[:, None])


@one_blas_thread()
def _factor(rows: Sequence[FrontRows], equations: ScaledEquations, held: _HeldFront | None) -> list[FrontFactor] | None:
    """Return the factors of all fronts, or None where the matrix is not positive definite."""
    waiting: list[list[tuple[Indices, Array]]] = [[] for _ in rows]
    factors = []
    for number, front in enumerate(rows):
        s, size = len(front.own), len(front.own) + len(front.boundary)
        matrix = _assembled(front, equations, number == len(rows) - 1)
        for into, update in waiting[number]:
            kernels.add_part(matrix, into, update)
        waiting[number].clear()
        if held is not None and held.number == number:
            matrix[:s, :s] += held.constraint @ held.constraint.T
        own, info = lapack.dpotrf(matrix[:s, :s], lower=1, clean=1) if s else (matrix[:0, :0], 0)
        if info != 0 or not np.all(np.isfinite(np.diag(own))):
            return None
        below = blas.dtrsm(1.0, own, matrix[s:, :s], side=1, lower=1, trans_a=1) if s and size > s else matrix[s:, :s]
        factors.append(FrontFactor(own=own, boundary=below))
        if front.parent >= 0:
            update = matrix[s:, s:] - below @ below.T if s else matrix[s:, s:]
            waiting[front.parent].append((front.in_parent, update))
    return factors


def _assembled(front: FrontRows, equations: ScaledEquations, last: bool) -> Array:
    """Return the lower triangle of a front with the equations first met there, (s + b, s + b), columns contiguous."""
    size = len(front.own) + len(front.boundary)
    matrix = np.zeros((size, size), order="F")
    if last:
        matrix[:] = equations.corner
        return matrix
    kernels.add_blocks(matrix, equations.blocks, front.blocks, front.block_row, front.block_column, front.turned)
    if equations.border.shape[1]:
        matrix[-equations.border.shape[1] :, : len(front.own)] = equations.border[front.own].T
    return matrix


class SparseFactor:
    """The factor of all fronts; a ``ReducedFactor``."""

    def __init__(
        self,
        reduced: Reduced,
        rows: Sequence[FrontRows],
        factors: Sequence[FrontFactor],
        scale: Array,
        datum: InnerDatum | None,
    ) -> None:
        self._reduced, self._rows, self._factors = reduced, rows, factors
        self._scale, self._datum = scale, datum

    def solve(self, right: Array) -> Array:
        """Return the solution (u, ...)."""
        scale = self._scale.reshape(-1, *(1,) * (right.ndim - 1))
        if self._datum is None:
            return np.asarray(scale * _solve(self._rows, self._factors, scale * right))
        space, weighted = self._datum.null_space, self._weighted_space
        solution = scale * _solve(self._rows, self._factors, scale * (right - weighted @ (space.T @ right)))
        return np.asarray(solution - space @ (weighted.T @ solution))

    def least_eigenvalue(self) -> float:
        """Return an estimate, rather too large, of the least eigenvalue, by inverse iteration."""
        vector = np.cos(np.arange(1.0, len(self._scale) + 1.0))
        eigenvalue = np.inf
        for _ in range(4):
            vector /= np.linalg.norm(vector)
            vector = _solve(self._rows, self._factors, vector)
            eigenvalue = 1.0 / max(float(np.linalg.norm(vector)), 1e-300)
        return eigenvalue

    def inverse(self) -> Inverse:
        """Return the inverse at the pattern of the blocks."""
        reduced, (n, d, _) = self._reduced, self._reduced.border.shape
        found = _selected_inverse(self._rows, self._factors, reduced)
        scale, of_border = self._scale[: d * n].reshape(n, d), self._scale[d * n :]
        row = np.repeat(np.arange(n), np.diff(reduced.row_start))
        found.blocks[:] *= scale[row][:, :, None]
        found.blocks[:] *= scale[reduced.column][:, None, :]
        found.border[:] *= scale[:, :, None] * of_border
        found.corner[:] *= of_border * of_border[:, None]
        if self._datum is not None:
            self._transform(found, row)
        return found

    @cached_property
    def _weighted_space(self) -> Array:
        assert self._datum is not None
        return self._datum.weight[:, None] * self._datum.null_space

    def _transform(self, inverse: Inverse, row: Indices) -> None:
        """Turn covariances of the datum of one front into those of all images: (1 - E E^T W) Q (1 - W E E^T)."""
        assert self._datum is not None
        n, d, b = self._reduced.border.shape
        space, weighted, scale = self._datum.null_space, self._weighted_space, self._scale[:, None]
        carried = scale * _solve(self._rows, self._factors, scale * weighted)
        carried -= 0.5 * space @ (weighted.T @ carried)
        e, v = space[: d * n].reshape(n, d, -1), carried[: d * n].reshape(n, d, -1)
        inverse.blocks[:] -= e[row] @ v[inverse.column].transpose(0, 2, 1)
        inverse.blocks[:] -= v[row] @ e[inverse.column].transpose(0, 2, 1)
        if b:
            inverse.border[:] -= e @ carried[d * n :].T + v @ space[d * n :].T
            inverse.corner[:] -= space[d * n :] @ carried[d * n :].T + carried[d * n :] @ space[d * n :].T


@one_blas_thread()
def _solve(rows: Sequence[FrontRows], factors: Sequence[FrontFactor], right: Array) -> Array:
    """Return the solution (u, ...) of the scaled equations."""
    x = np.array(right.reshape(len(right), -1), order="F")
    for front, factor in zip(rows, factors, strict=True):
        if len(front.own):
            x[front.own] = blas.dtrsm(1.0, factor.own, x[front.own], lower=1)
            x[front.boundary] -= factor.boundary @ x[front.own]
    for front, factor in zip(reversed(rows), reversed(factors), strict=True):
        if len(front.own):
            own = x[front.own] - factor.boundary.T @ x[front.boundary]
            x[front.own] = blas.dtrsm(1.0, factor.own, own, lower=1, trans_a=1)
    return x.reshape(right.shape)


@one_blas_thread()
def _selected_inverse(rows: Sequence[FrontRows], factors: Sequence[FrontFactor], reduced: Reduced) -> Inverse:
    """Return the inverse of the scaled equations at the pattern: front by front, parents before children."""
    n, d, b = reduced.border.shape
    result = Inverse(
        reduced.row_start, reduced.column, np.empty_like(reduced.blocks), np.zeros((n, d, b)), np.zeros((b, b))
    )
    border = result.border.reshape(d * n, b)
    children = np.bincount([front.parent + 1 for front in rows], minlength=len(rows) + 1)[1:]
    known: dict[int, Array] = {}
    for number in range(len(rows) - 1, -1, -1):
        front, factor = rows[number], factors[number]
        s = len(front.own)
        matrix = np.empty((s + len(front.boundary),) * 2, order="F")
        if front.parent >= 0:
            kernels.take_part(known[front.parent], front.in_parent, matrix[s:, s:])
            children[front.parent] -= 1
            if children[front.parent] == 0:
                del known[front.parent]
        _invert_front(factor, matrix, s)
        if number == len(rows) - 1:
            result.corner[:] = matrix
        else:
            kernels.take_blocks(
                matrix, result.blocks, front.blocks, front.block_row, front.block_column, front.turned
            )  # fmt: skip
            border[front.own] = matrix[:s, matrix.shape[1] - b :]
        if children[number]:
            known[number] = matrix
    return result


def _invert_front(factor: FrontFactor, matrix: Array, s: int) -> None:
    """Fill the own part of a front's inverse, (s + b, s + b), whose boundary part is known."""
    if s == 0:
        return
    lower, _ = lapack.dtrtri(factor.own, lower=1)
    own = lower.T @ lower
    if matrix.shape[0] > s:
        across = factor.boundary @ lower
        mixed = matrix[s:, s:] @ across
        own += across.T @ mixed
        matrix[s:, :s], matrix[:s, s:] = -mixed, -mixed.T
    matrix[:s, :s] = 0.5 * (own + own.T)


def _describe_defect(
    reduced: Reduced, rows: Sequence[FrontRows], equations: ScaledEquations, held: _HeldFront | None
) -> str:
    """Say which unknowns singular equations leave open: eigenvectors by inverse iteration, a little damped."""
    size = sum(len(front.own) for front in rows)
    if not np.all(np.isfinite(equations.blocks)):
        return name_defect(reduced, np.full(size, np.nan), 1)
    last, factors, applied = reduced.row_start[1:] - 1, None, 0.0
    for shift in (1e-10, 1e-8, 1e-6):
        equations.blocks[last] += (shift - applied) * np.eye(equations.blocks.shape[1])
        equations.corner[np.diag_indices_from(equations.corner)] += shift - applied
        factors, applied = _factor(rows, equations, held), shift
        if factors is not None:
            break
    if factors is None:
        return name_defect(reduced, np.full(size, np.nan), 1)
    vectors = np.cos(np.outer(np.arange(1.0, size + 1.0), np.arange(1.0, 1.0 + min(TRIED_DIRECTIONS, size))))
    for _ in range(6):
        vectors = _solve(rows, factors, np.linalg.qr(vectors)[0])
    basis, triangle = np.linalg.qr(vectors)
    turn, stretch, _ = np.linalg.svd(triangle)
    open_ = (basis @ turn)[:, 1.0 / stretch - applied < max(OPEN_EIGENVALUE, 0.1 * applied)]
    share = np.sum(open_**2, axis=1) if open_.size else (basis @ turn)[:, 0] ** 2
    return name_defect(reduced, share, max(open_.shape[1], 1))
