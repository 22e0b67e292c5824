"""Normal equations of the bundle: points eliminated one by one (Schur complement), blocks of image pairs accumulated.

The reduced normal equations are kept as 6 x 6 blocks of those pairs of images (i >= j) that see a point in common, in
compressed rows, with a border of few columns (interior orientation, GNSS shifts); see ``process.normal_equations``.
Brown, D. C. (1958), RCA-MTP data reduction technical report 43; Kraus, Photogrammetry, vol. 1, sec. 5.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.bundle_geometry import differentiate, project
from uavkit.process.kernels.jit import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

LEAST_DETERMINANT = 1e-13
"""Below this, det(N) / (trace(N) / 3)^3 of a point's normal equations, its rays do not determine it."""


class RayTable(NamedTuple):
    """Rays in the order of their points: those of point p are rows start[p] to start[p + 1]."""

    start: Indices
    image: Indices
    xy_px: Array
    sigma_px: Array


class Unknowns(NamedTuple):
    """Values of the unknowns: interior (10,), centres (n, 3), rotations (n, 3, 3), points (m, 3)."""

    interior: Array
    centres: Array
    rotations: Array
    points: Array


class Coordinates(NamedTuple):
    """Direct observations of the object points: normal matrices (m, 3, 3) and right-hand sides (m, 3)."""

    normal: Array
    right: Array


class Reduced(NamedTuple):
    """Reduced normal equations of n images and b border unknowns."""

    row_start: Indices
    column: Indices
    blocks: Array
    border: Array
    corner: Array
    right_images: Array
    right_border: Array
    diagonal_images: Array
    """(n, 6) diagonal before the points were eliminated: the measure of what is singular, and of damping."""
    diagonal_border: Array


@kernel
def pair_row(row_start: Indices, column: Indices, i: int, j: int) -> int:
    """Return the row of the block of images i >= j, or -1."""
    low, high = row_start[i], row_start[i + 1] - 1
    while low <= high:
        middle = (low + high) // 2
        if column[middle] == j:
            return int(middle)
        if column[middle] < j:
            low = middle + 1
        else:
            high = middle - 1
    return -1


@kernel
def invert_point(normal: Array, inverse: Array) -> bool:
    """Write the inverse of a symmetric (3, 3) matrix; False where it is singular."""
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 2]
    d, e, f = normal[1, 1], normal[1, 2], normal[2, 2]
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * i00 + b * i01 + c * i02
    third = (a + d + f) / 3.0
    if not determinant > LEAST_DETERMINANT * third * third * third:
        return False
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = i00, i01, i02
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = i01, a * f - c * c, b * c - a * e
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = i02, b * c - a * e, a * d - b * b
    for row in range(3):
        for col in range(3):
            inverse[row, col] /= determinant
    return True


@kernel
def residuals(rays: RayTable, unknowns: Unknowns, first: int, last: int, out: Array) -> None:
    """Write observed minus computed, (k, 2) pixels, of the rays of points first to last; NaN behind the camera."""
    computed = np.empty(2)
    for p in range(first, last):
        for ray in range(rays.start[p], rays.start[p + 1]):
            i = rays.image[ray]
            seen = project(unknowns.interior, unknowns.centres[i], unknowns.rotations[i], unknowns.points[p], computed)
            for axis in range(2):
                out[ray, axis] = rays.xy_px[ray, axis] - computed[axis] if seen else np.nan


@kernel
def linearise_point(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Indices, p: int, by_image: Array, by_border: Array,
    by_point: Array, misclosure: Array, row: Indices,
) -> int:  # fmt: skip
    """Write the whitened observation equations of a point's rays of weight above zero; return how many there are.

    Shapes (r, 2, 6), (r, 2, q), (r, 2, 3), (r, 2) and the rays' rows (r,).
    """
    computed, by_rotation, by_interior = np.empty(2), np.empty((2, 3)), np.empty((2, 10))
    count = 0
    for ray in range(rays.start[p], rays.start[p + 1]):
        if not weight[ray] > 0.0:
            continue
        i = rays.image[ray]
        bp = by_point[count]
        if not differentiate(
            unknowns.interior, unknowns.centres[i], unknowns.rotations[i], unknowns.points[p], computed, bp,
            by_rotation, by_interior,
        ):  # fmt: skip
            continue
        root = np.sqrt(weight[ray])
        for axis in range(2):
            factor = root / rays.sigma_px[ray, axis]
            misclosure[count, axis] = factor * (rays.xy_px[ray, axis] - computed[axis])
            for k in range(3):
                bp[axis, k] *= factor
                by_image[count, axis, k] = -bp[axis, k]
                by_image[count, axis, 3 + k] = factor * by_rotation[axis, k]
            for k in range(len(free)):
                by_border[count, axis, k] = factor * by_interior[axis, free[k]]
        row[count] = ray
        count += 1
    return count


@kernel
def eliminate_point(
    coordinates: Coordinates, p: int, damping: float, count: int, by_point: Array, misclosure: Array, inverse: Array,
    gradient: Array,
) -> bool:  # fmt: skip
    """Write the inverse of a point's (damped) normal matrix and its right-hand side; False where undetermined."""
    normal = coordinates.normal[p].copy()
    for k in range(3):
        gradient[k] = coordinates.right[p, k]
    for a in range(count):
        for axis in range(2):
            for k in range(3):
                gradient[k] += by_point[a, axis, k] * misclosure[a, axis]
                for m in range(3):
                    normal[k, m] += by_point[a, axis, k] * by_point[a, axis, m]
    if not invert_point(normal, inverse):
        return False
    if damping > 0.0:
        for k in range(3):
            normal[k, k] *= 1.0 + damping
        invert_point(normal, inverse)
    return True


@kernel
def accumulate(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Indices, coordinates: Coordinates, damping: float,
    first: int, last: int, reduced: Reduced, determined: Flags,
) -> None:  # fmt: skip
    """Add points first to last to the reduced normal equations, and note which points their rays determine."""
    most, q = 1, len(free)
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    by_image, by_border, by_point = np.empty((most, 2, 6)), np.empty((most, 2, q)), np.empty((most, 2, 3))
    misclosure, row = np.empty((most, 2)), np.empty(most, dtype=np.int64)
    inverse, gradient = np.empty((3, 3)), np.empty(3)
    mixed, reducer, mixed_border, reducer_border = (
        np.empty((most, 6, 3)), np.empty((most, 6, 3)), np.empty((q, 3)), np.empty((q, 3)),
    )  # fmt: skip
    for p in range(first, last):
        count = linearise_point(
            rays, unknowns, weight, free, p, by_image, by_border, by_point, misclosure, row
        )  # fmt: skip
        determined[p] = eliminate_point(coordinates, p, damping, count, by_point, misclosure, inverse, gradient)
        if not determined[p] or count == 0:
            continue
        mixed_border[:] = 0.0
        for a in range(count):
            for k in range(6):
                for m in range(3):
                    mixed[a, k, m] = (
                        by_image[a, 0, k] * by_point[a, 0, m] + by_image[a, 1, k] * by_point[a, 1, m]
                    )  # fmt: skip
                for m in range(3):
                    reducer[a, k, m] = (
                        mixed[a, k, 0] * inverse[0, m] + mixed[a, k, 1] * inverse[1, m] + mixed[a, k, 2] * inverse[2, m]
                    )
            for k in range(q):
                for m in range(3):
                    mixed_border[k, m] += (
                        by_border[a, 0, k] * by_point[a, 0, m] + by_border[a, 1, k] * by_point[a, 1, m]
                    )
        for k in range(q):
            for m in range(3):
                reducer_border[k, m] = (
                    mixed_border[k, 0] * inverse[0, m] + mixed_border[k, 1] * inverse[1, m]
                    + mixed_border[k, 2] * inverse[2, m]
                )  # fmt: skip
        for k in range(q):
            reduced.right_border[k] -= (
                reducer_border[k, 0] * gradient[0] + reducer_border[k, 1] * gradient[1]
                + reducer_border[k, 2] * gradient[2]
            )  # fmt: skip
            for m in range(q):
                reduced.corner[k, m] -= (
                    reducer_border[k, 0] * mixed_border[m, 0] + reducer_border[k, 1] * mixed_border[m, 1]
                    + reducer_border[k, 2] * mixed_border[m, 2]
                )  # fmt: skip
        for a in range(count):
            i = rays.image[row[a]]
            _add_ray(reduced, i, by_image[a], by_border[a], misclosure[a])
            for k in range(6):
                y0, y1, y2 = reducer[a, k, 0], reducer[a, k, 1], reducer[a, k, 2]
                reduced.right_images[i, k] -= y0 * gradient[0] + y1 * gradient[1] + y2 * gradient[2]
                for m in range(q):
                    reduced.border[i, k, m] -= (
                        y0 * mixed_border[m, 0] + y1 * mixed_border[m, 1] + y2 * mixed_border[m, 2]
                    )
            for b in range(count):
                j = rays.image[row[b]]
                if j > i:
                    continue
                block = reduced.blocks[pair_row(reduced.row_start, reduced.column, i, j)]
                for k in range(6):
                    y0, y1, y2 = reducer[a, k, 0], reducer[a, k, 1], reducer[a, k, 2]
                    for m in range(6):
                        block[k, m] -= y0 * mixed[b, m, 0] + y1 * mixed[b, m, 1] + y2 * mixed[b, m, 2]


@kernel
def _add_ray(reduced: Reduced, i: int, by_image: Array, by_border: Array, misclosure: Array) -> None:
    """Add a ray's own part, before elimination of its point, to the normal equations of its image and the border."""
    q = by_border.shape[1]
    block = reduced.blocks[pair_row(reduced.row_start, reduced.column, i, i)]
    for axis in range(2):
        for k in range(6):
            value = by_image[axis, k]
            reduced.right_images[i, k] += value * misclosure[axis]
            reduced.diagonal_images[i, k] += value * value
            for m in range(6):
                block[k, m] += value * by_image[axis, m]
            for m in range(q):
                reduced.border[i, k, m] += value * by_border[axis, m]
        for k in range(q):
            value = by_border[axis, k]
            reduced.right_border[k] += value * misclosure[axis]
            reduced.diagonal_border[k] += value * value
            for m in range(q):
                reduced.corner[k, m] += value * by_border[axis, m]


@kernel
def back_substitute(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Indices, coordinates: Coordinates, damping: float,
    first: int, last: int, step_images: Array, step_border: Array, step_points: Array,
) -> float:  # fmt: skip
    """Write the steps of points first to last, (m, 3), and return their part of step . right-hand side."""
    most, q = 1, len(free)
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    by_image, by_border, by_point = np.empty((most, 2, 6)), np.empty((most, 2, q)), np.empty((most, 2, 3))
    misclosure, row = np.empty((most, 2)), np.empty(most, dtype=np.int64)
    inverse, gradient, right = np.empty((3, 3)), np.empty(3), np.empty(3)
    product = 0.0
    for p in range(first, last):
        step_points[p] = 0.0
        count = linearise_point(
            rays, unknowns, weight, free, p, by_image, by_border, by_point, misclosure, row
        )  # fmt: skip
        if not eliminate_point(coordinates, p, damping, count, by_point, misclosure, inverse, gradient):
            continue
        right[:] = gradient
        for a in range(count):
            i = rays.image[row[a]]
            for axis in range(2):
                moved = 0.0
                for k in range(6):
                    moved += by_image[a, axis, k] * step_images[i, k]
                for k in range(q):
                    moved += by_border[a, axis, k] * step_border[k]
                product += moved * misclosure[a, axis]
                for k in range(3):
                    right[k] -= by_point[a, axis, k] * moved
        for k in range(3):
            step_points[p, k] = inverse[k, 0] * right[0] + inverse[k, 1] * right[1] + inverse[k, 2] * right[2]
            product += step_points[p, k] * gradient[k]
    return product
