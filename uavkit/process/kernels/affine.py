"""Affine motion of many points: least median of squares, and local fits to neighbours; inner loops."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel


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
    most = neighbours.shape[1]
    xs, ys = np.empty(most), np.empty(most)
    for row in range(residuals.shape[0]):
        number = 0
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                xs[number], ys[number] = residuals[other, 0], residuals[other, 1]
                number += 1
        votes[row] = number
        medians[row, :] = 0.0
        spread[row] = 0.0
        if number > 0:
            medians[row, 0], medians[row, 1] = np.median(xs[:number]), np.median(ys[:number])
            for i in range(number):
                xs[i] = max(abs(xs[i] - medians[row, 0]), abs(ys[i] - medians[row, 1]))
            spread[row] = 1.4826 * np.median(xs[:number])


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
    normal = np.zeros((2, 2))
    mixed = np.zeros((2, 2))
    for row in range(start.shape[0]):
        number = 0
        mean_s, mean_c = np.zeros(2), np.zeros(2)
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                number += 1
                mean_s += start[other]
                mean_c += current[other]
        warps[row] = general
        if number < 4:
            continue
        mean_s /= number
        mean_c /= number
        normal[:] = 0.0
        mixed[:] = 0.0
        for other in neighbours[row]:
            if other >= 0 and counted[other]:
                for i in range(2):
                    si = start[other, i] - mean_s[i]
                    for j in range(2):
                        sj = start[other, j] - mean_s[j]
                        normal[i, j] += si * sj
                        rest = current[other, j] - mean_c[j]
                        for k in range(2):
                            rest -= general[j, k] * (start[other, k] - mean_s[k])
                        mixed[j, i] += rest * si
        prior = limits[0] * (normal[0, 0] + normal[1, 1]) + 1e-9
        a, b, d = normal[0, 0] + prior, normal[0, 1], normal[1, 1] + prior
        determinant = a * d - b * b
        for j in range(2):
            u = (mixed[j, 0] * d - mixed[j, 1] * b) / determinant
            v = (mixed[j, 1] * a - mixed[j, 0] * b) / determinant
            warps[row, j, 0] += min(max(u, -limits[1]), limits[1])
            warps[row, j, 1] += min(max(v, -limits[1]), limits[1])
            from_mean = warps[row, j, 0] * (start[row, 0] - mean_s[0]) + warps[row, j, 1] * (start[row, 1] - mean_s[1])
            expected[row, j] = mean_c[j] + from_mean
