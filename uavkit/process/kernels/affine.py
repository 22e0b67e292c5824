"""Affine motion of many points: least median of squares, and local fits to neighbours; inner loops."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

_TOGETHER = 32
"""Points whose neighbours are sorted at the same time: whole vector registers."""


@kernel
def _affine_of_triple(
    source: NDArray[np.float64], target: NDArray[np.float64], rows: NDArray[np.int64], affine: NDArray[np.float64]
) -> bool:
    """The affine transformation (2, 3) through three points; False if they are nearly on a line."""
    i, j, k = rows[0], rows[1], rows[2]
    ax, ay = source[j, 0] - source[i, 0], source[j, 1] - source[i, 1]
    bx, by = source[k, 0] - source[i, 0], source[k, 1] - source[i, 1]
    area = ax * by - ay * bx
    if abs(area) < 0.1 * (ax * ax + ay * ay + bx * bx + by * by) or area == 0.0:
        return False
    for axis in range(2):
        p, q = target[j, axis] - target[i, axis], target[k, axis] - target[i, axis]
        affine[axis, 0] = (p * by - q * ay) / area
        affine[axis, 1] = (q * ax - p * bx) / area
        affine[axis, 2] = target[i, axis] - affine[axis, 0] * source[i, 0] - affine[axis, 1] * source[i, 1]
    return True


@kernel
def least_median_affine(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    triples: NDArray[np.int64],
    best: NDArray[np.float64],
) -> float:
    """Affine (2, 3) of least median squared coordinate residual among those through triples (k, 3); returns the median.

    A triple is dropped as soon as more than half of its residuals exceed the best median so far.
    """
    count = source.shape[0]
    squares = np.empty(2 * count)
    affine = np.zeros((2, 3))
    least = np.inf
    for triple in range(triples.shape[0]):
        if not _affine_of_triple(source, target, triples[triple], affine):
            continue
        above = 0
        for row in range(count):
            x, y = source[row, 0], source[row, 1]
            rx = target[row, 0] - (affine[0, 0] * x + affine[0, 1] * y + affine[0, 2])
            ry = target[row, 1] - (affine[1, 0] * x + affine[1, 1] * y + affine[1, 2])
            squares[2 * row] = rx * rx
            squares[2 * row + 1] = ry * ry
            above += (rx * rx >= least) + (ry * ry >= least)
            if above > count:
                break
        if above > count:
            continue
        median = np.median(squares)
        if median < least:
            least = median
            best[:] = affine
    return least


@kernel
def _centres(
    source: NDArray[np.float64], target: NDArray[np.float64], counted: NDArray[np.bool_], centres: NDArray[np.float64]
) -> int:
    """Means of the counted points: centres = (source x, y, target x, y); returns their number."""
    number = 0
    centres[:] = 0.0
    for row in range(source.shape[0]):
        if counted[row]:
            number += 1
            centres[0] += source[row, 0]
            centres[1] += source[row, 1]
            centres[2] += target[row, 0]
            centres[3] += target[row, 1]
    for k in range(4):
        centres[k] /= max(number, 1)
    return number


@kernel
def least_squares_affine(
    source: NDArray[np.float64], target: NDArray[np.float64], counted: NDArray[np.bool_], affine: NDArray[np.float64]
) -> bool:
    """Least squares affine transformation (2, 3) of the counted points; False if they lie on a line (or are < 3)."""
    centres = np.empty(4)
    number = _centres(source, target, counted, centres)
    nxx = nxy = nyy = 0.0
    mixed = np.zeros((2, 2))
    for row in range(source.shape[0]):
        if counted[row]:
            x, y = source[row, 0] - centres[0], source[row, 1] - centres[1]
            u, v = target[row, 0] - centres[2], target[row, 1] - centres[3]
            nxx += x * x
            nxy += x * y
            nyy += y * y
            mixed[0, 0] += u * x
            mixed[0, 1] += u * y
            mixed[1, 0] += v * x
            mixed[1, 1] += v * y
    determinant = nxx * nyy - nxy * nxy
    if number < 3 or determinant <= 1e-12 * (nxx + nyy) ** 2:
        return False
    for j in range(2):
        affine[j, 0] = (mixed[j, 0] * nyy - mixed[j, 1] * nxy) / determinant
        affine[j, 1] = (mixed[j, 1] * nxx - mixed[j, 0] * nxy) / determinant
        affine[j, 2] = centres[2 + j] - affine[j, 0] * centres[0] - affine[j, 1] * centres[1]
    return True


@kernel
def affine_residuals(
    source: NDArray[np.float64], target: NDArray[np.float64], affine: NDArray[np.float64], largest: NDArray[np.float64]
) -> None:
    """Larger coordinate, without sign, of target - affine(source), (n,)."""
    for row in range(source.shape[0]):
        x, y = source[row, 0], source[row, 1]
        rx = target[row, 0] - (affine[0, 0] * x + affine[0, 1] * y + affine[0, 2])
        ry = target[row, 1] - (affine[1, 0] * x + affine[1, 1] * y + affine[1, 2])
        largest[row] = max(abs(rx), abs(ry))


@kernel
def _sort_columns(values: NDArray[np.float64], rows: int) -> None:
    """Sort each of the _TOGETHER columns of values (rows * _TOGETHER,) by exchanges of neighbours, all at once."""
    for phase in range(rows):
        for row in range(phase & 1, rows - 1, 2):
            upper, lower = np.uint64(row * _TOGETHER), np.uint64((row + 1) * _TOGETHER)
            for column in range(_TOGETHER):
                a, b = values[upper + np.uint64(column)], values[lower + np.uint64(column)]
                values[upper + np.uint64(column)] = a if a < b else b
                values[lower + np.uint64(column)] = b if a < b else a


@kernel
def _middle(values: NDArray[np.float64], column: int, number: int) -> float:
    """Median of the first few values of a sorted column."""
    upper, lower = (number - 1) // 2, number // 2
    return float(0.5 * (values[upper * _TOGETHER + column] + values[lower * _TOGETHER + column]))


@kernel
def _votes_of_some(
    residuals: NDArray[np.float64],
    counted: NDArray[np.bool_],
    neighbours: NDArray[np.int64],
    first: int,
    medians: NDArray[np.float64],
    spread: NDArray[np.float64],
    votes: NDArray[np.int64],
    work: NDArray[np.float64],
) -> None:
    """neighbour_votes for up to _TOGETHER rows from first on; work (3, k * _TOGETHER)."""
    most = neighbours.shape[1]
    some = min(_TOGETHER, residuals.shape[0] - first)
    work[:] = np.inf
    for column in range(some):
        number = 0
        for other in neighbours[first + column]:
            if other >= 0 and counted[other]:
                work[0, number * _TOGETHER + column] = residuals[other, 0]
                work[1, number * _TOGETHER + column] = residuals[other, 1]
                number += 1
        votes[first + column] = number
    _sort_columns(work[0], most)
    _sort_columns(work[1], most)
    for column in range(some):
        row = first + column
        medians[row, :] = 0.0
        if votes[row] == 0:
            continue
        mx, my = _middle(work[0], column, votes[row]), _middle(work[1], column, votes[row])
        medians[row, 0], medians[row, 1] = mx, my
        number = 0
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                away = max(abs(residuals[other, 0] - mx), abs(residuals[other, 1] - my))
                work[2, number * _TOGETHER + column] = away
                number += 1
    _sort_columns(work[2], most)
    for column in range(some):
        row = first + column
        spread[row] = 1.4826 * _middle(work[2], column, votes[row]) if votes[row] > 0 else 0.0


@kernel
def neighbour_votes(
    residuals: NDArray[np.float64],
    counted: NDArray[np.bool_],
    neighbours: NDArray[np.int64],
    medians: NDArray[np.float64],
    spread: NDArray[np.float64],
    votes: NDArray[np.int64],
) -> None:
    """Median (n, 2) of the counted neighbours' residuals, 1.4826 times their median distance from it, number.

    neighbours (n, k) holds row numbers, -1 where there are fewer.
    """
    work = np.empty((3, neighbours.shape[1] * _TOGETHER))
    for first in range(0, residuals.shape[0], _TOGETHER):
        _votes_of_some(residuals, counted, neighbours, first, medians, spread, votes, work)


@kernel
def local_warps(
    start: NDArray[np.float64],
    current: NDArray[np.float64],
    counted: NDArray[np.bool_],
    neighbours: NDArray[np.int64],
    general: NDArray[np.float64],
    limits: NDArray[np.float64],
    warps: NDArray[np.float64],
    expected: NDArray[np.float64],
) -> None:
    """current_from_start (n, 2, 2) about each point, fitted to its counted neighbours and drawn towards general (2, 2).

    limits = (weight of general as a share of the neighbours' scatter, largest departure from general). expected (n, 2)
    gets the position that the neighbours imply for the point; it is left as it is with fewer than four of them.
    """
    mixed = np.zeros((2, 2))
    for row in range(start.shape[0]):
        warps[row, :, :] = general
        number = 0
        sx = sy = cx = cy = 0.0
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                number += 1
                sx += start[other, 0]
                sy += start[other, 1]
                cx += current[other, 0]
                cy += current[other, 1]
        if number < 4:
            continue
        sx, sy, cx, cy = sx / number, sy / number, cx / number, cy / number
        nxx = nxy = nyy = 0.0
        mixed[:, :] = 0.0
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                x, y = start[other, 0] - sx, start[other, 1] - sy
                u = current[other, 0] - cx - general[0, 0] * x - general[0, 1] * y
                v = current[other, 1] - cy - general[1, 0] * x - general[1, 1] * y
                nxx += x * x
                nxy += x * y
                nyy += y * y
                mixed[0, 0] += u * x
                mixed[0, 1] += u * y
                mixed[1, 0] += v * x
                mixed[1, 1] += v * y
        prior = limits[0] * (nxx + nyy) + 1e-9
        a, b, d = nxx + prior, nxy, nyy + prior
        determinant = a * d - b * b
        x, y = start[row, 0] - sx, start[row, 1] - sy
        for j in range(2):
            u = (mixed[j, 0] * d - mixed[j, 1] * b) / determinant
            v = (mixed[j, 1] * a - mixed[j, 0] * b) / determinant
            warps[row, j, 0] += min(max(u, -limits[1]), limits[1])
            warps[row, j, 1] += min(max(v, -limits[1]), limits[1])
            expected[row, j] = (cx if j == 0 else cy) + warps[row, j, 0] * x + warps[row, j, 1] * y


@kernel
def over_inverse(left: NDArray[np.float64], right: NDArray[np.float64], result: NDArray[np.float64]) -> None:
    """left right^-1 for each of many (2, 2) matrices."""
    for row in range(left.shape[0]):
        a, b, c, d = right[row, 0, 0], right[row, 0, 1], right[row, 1, 0], right[row, 1, 1]
        determinant = a * d - b * c
        for i in range(2):
            p, q = left[row, i, 0], left[row, i, 1]
            result[row, i, 0] = (p * d - q * c) / determinant
            result[row, i, 1] = (q * a - p * b) / determinant
