"""Covariances of object points and leverages of rays, from the inverse of the reduced normal equations."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.bundle_geometry import differentiate
from uavkit.process.kernels.bundle_normals import (
    Coordinates,
    RayTable,
    Unknowns,
    eliminate_point,
    linearise_point,
    pair_row,
)
from uavkit.process.kernels.jit import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Inverse(NamedTuple):
    """Blocks of the inverse of the reduced normal equations at the pattern of ``Reduced``."""

    row_start: Indices
    column: Indices
    blocks: Array
    border: Array
    corner: Array


@kernel
def point_precision(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Indices, coordinates: Coordinates, first: int, last: int,
    inverse: Inverse, covariance: Array, leverage: Array,
) -> None:  # fmt: skip
    """Write covariances (m, 3, 3) of points first to last and leverages (k, 2) of all their rays.

    Leverage: variance of the adjusted image coordinate over the observation's a priori variance; also of rays of weight
    zero, which are predicted by the others. NaN where the point is not determined. The redundancy number of a ray of
    full weight is 1 - leverage (Foerstner 1987; Kraus, Photogrammetry, vol. 2, app. 4).
    """
    most, q = 1, len(free)
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    by_image, by_border, by_point = np.empty((most, 2, 6)), np.empty((most, 2, q)), np.empty((most, 2, 3))
    misclosure, row = np.empty((most, 2)), np.empty(most, dtype=np.int64)
    own, gradient = np.empty((3, 3)), np.empty(3)
    mixed, mixed_border = np.empty((most, 6, 3)), np.empty((q, 3))
    with_image, with_border, other_image = np.empty((most, 3, 6)), np.empty((3, q)), np.empty((3, 6))
    total, reduced, sums, line = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, max(q, 6))), np.empty(9 + q)
    computed, bp, br, bi = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 10))
    variance = np.empty(2)
    for p in range(first, last):
        covariance[p] = np.nan
        for ray in range(rays.start[p], rays.start[p + 1]):
            leverage[ray] = np.nan
        count = linearise_point(
            rays, unknowns, weight, free, p, by_image, by_border, by_point, misclosure, row
        )  # fmt: skip
        if not eliminate_point(coordinates, p, 0.0, count, by_point, misclosure, own, gradient):
            continue
        mixed_border[:] = 0.0
        for a in range(count):
            for m in range(3):
                for k in range(6):
                    mixed[a, k, m] = by_image[a, 0, k] * by_point[a, 0, m] + by_image[a, 1, k] * by_point[a, 1, m]
                for k in range(q):
                    mixed_border[k, m] += (
                        by_border[a, 0, k] * by_point[a, 0, m] + by_border[a, 1, k] * by_point[a, 1, m]
                    )
        total[:] = own
        _covariance_with_border(rays, inverse, row, count, mixed, mixed_border, own, sums, with_border)
        _subtract_carried(with_border, mixed_border, own, reduced, total)
        for a in range(count):
            _covariance_with_image(
                rays, inverse, row, count, mixed, mixed_border, own, rays.image[row[a]], sums, with_image[a]
            )  # fmt: skip
            _subtract_carried(with_image[a], mixed[a], own, reduced, total)
        for k in range(3):
            for m in range(3):
                covariance[p, k, m] = 0.5 * (total[k, m] + total[m, k])
        used = 0
        for ray in range(rays.start[p], rays.start[p + 1]):
            i = rays.image[ray]
            if not differentiate(
                unknowns.interior, unknowns.centres[i], unknowns.rotations[i], unknowns.points[p], computed, bp, br, bi
            ):
                continue
            if used < count and row[used] == ray:
                _predict(bp, br, bi, free, covariance[p], with_image[used], with_border, inverse, i, line, variance)
                used += 1
            else:
                _covariance_with_image(
                    rays, inverse, row, count, mixed, mixed_border, own, i, sums, other_image
                )  # fmt: skip
                _predict(bp, br, bi, free, covariance[p], other_image, with_border, inverse, i, line, variance)
            for axis in range(2):
                leverage[ray, axis] = variance[axis] / rays.sigma_px[ray, axis] ** 2


@kernel
def fixed_leverage(
    rays: RayTable, unknowns: Unknowns, weight: Array, coordinates: Coordinates, first: int, last: int,
    covariance: Array, leverage: Array,
) -> None:  # fmt: skip
    """Write what ``point_precision`` does, but for orientations known exactly: an inverse of nothing but zeros."""
    most = 1
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    by_image, by_border, by_point = np.empty((most, 2, 6)), np.empty((most, 2, 0)), np.empty((most, 2, 3))
    misclosure, row, none = np.empty((most, 2)), np.empty(most, dtype=np.int64), np.empty(0, dtype=np.int64)
    own, gradient = np.empty((3, 3)), np.empty(3)
    computed, bp, br, bi = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 10))
    for p in range(first, last):
        covariance[p] = np.nan
        for ray in range(rays.start[p], rays.start[p + 1]):
            leverage[ray] = np.nan
        count = linearise_point(rays, unknowns, weight, none, p, by_image, by_border, by_point, misclosure, row)
        if not eliminate_point(coordinates, p, 0.0, count, by_point, misclosure, own, gradient):
            continue
        covariance[p] = own
        for ray in range(rays.start[p], rays.start[p + 1]):
            i = rays.image[ray]
            if not differentiate(
                unknowns.interior, unknowns.centres[i], unknowns.rotations[i], unknowns.points[p], computed, bp, br, bi
            ):
                continue
            for axis in range(2):
                variance = 0.0
                for k in range(3):
                    for m in range(3):
                        variance += bp[axis, k] * own[k, m] * bp[axis, m]
                leverage[ray, axis] = variance / rays.sigma_px[ray, axis] ** 2


@kernel
def _subtract_carried(with_other: Array, mixed: Array, own: Array, carried: Array, total: Array) -> None:
    """Subtract with_other (3, u) mixed (u, 3) own (3, 3) from total; carried (3, 3) is for scratch."""
    for k in range(3):
        for m in range(3):
            value = 0.0
            for s in range(len(mixed)):
                value += with_other[k, s] * mixed[s, m]
            carried[k, m] = value
    for k in range(3):
        for m in range(3):
            total[k, m] -= carried[k, 0] * own[0, m] + carried[k, 1] * own[1, m] + carried[k, 2] * own[2, m]


@kernel
def _covariance_with_image(
    rays: RayTable, inverse: Inverse, row: Indices, count: int, mixed: Array, mixed_border: Array, own: Array,
    image: int, sums: Array, out: Array,
) -> None:  # fmt: skip
    """Write the covariance (3, 6) between a point and the orientation of an image; sums (3, 6 or more) is scratch."""
    q = len(mixed_border)
    for s in range(6):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for k in range(q):
            value = inverse.border[image, s, k]
            s0 += mixed_border[k, 0] * value
            s1 += mixed_border[k, 1] * value
            s2 += mixed_border[k, 2] * value
        sums[0, s], sums[1, s], sums[2, s] = s0, s1, s2
    for a in range(count):
        j = rays.image[row[a]]
        pair = pair_row(inverse.row_start, inverse.column, max(j, image), min(j, image))
        for s in range(6):
            s0, s1, s2 = sums[0, s], sums[1, s], sums[2, s]
            for k in range(6):
                value = inverse.blocks[pair, k, s] if j >= image else inverse.blocks[pair, s, k]
                s0 += mixed[a, k, 0] * value
                s1 += mixed[a, k, 1] * value
                s2 += mixed[a, k, 2] * value
            sums[0, s], sums[1, s], sums[2, s] = s0, s1, s2
    for m in range(3):
        for s in range(6):
            out[m, s] = -(own[m, 0] * sums[0, s] + own[m, 1] * sums[1, s] + own[m, 2] * sums[2, s])


@kernel
def _covariance_with_border(
    rays: RayTable,
    inverse: Inverse,
    row: Indices,
    count: int,
    mixed: Array,
    mixed_border: Array,
    own: Array,
    sums: Array,
    out: Array,
) -> None:
    """Write the covariance (3, q) between a point and the free interior orientation; sums (3, q or more) is scratch."""
    q = len(mixed_border)
    sums[:, :q] = 0.0
    for a in range(count):
        j = rays.image[row[a]]
        for m in range(3):
            for k in range(6):
                for s in range(q):
                    sums[m, s] += mixed[a, k, m] * inverse.border[j, k, s]
    for k in range(q):
        for m in range(3):
            for s in range(q):
                sums[m, s] += mixed_border[k, m] * inverse.corner[k, s]
    for m in range(3):
        for s in range(q):
            out[m, s] = -(own[m, 0] * sums[0, s] + own[m, 1] * sums[1, s] + own[m, 2] * sums[2, s])


@kernel
def _predict(
    by_point: Array, by_rotation: Array, by_interior: Array, free: Indices, covariance: Array, with_image: Array,
    with_border: Array, inverse: Inverse, image: int, row: Array, out: Array,
) -> None:  # fmt: skip
    """Write the variances (2,) of a computed image point, in square pixels; row (9 + q,) is scratch."""
    q, pair = len(free), inverse.row_start[image + 1] - 1
    for axis in range(2):
        for k in range(3):
            row[k] = by_point[axis, k]
            row[3 + k] = -by_point[axis, k]
            row[6 + k] = by_rotation[axis, k]
        for k in range(q):
            row[9 + k] = by_interior[axis, free[k]]
        total = 0.0
        for k in range(3):
            for m in range(3):
                total += row[k] * covariance[k, m] * row[m]
            for m in range(6):
                total += 2.0 * row[k] * with_image[k, m] * row[3 + m]
            for m in range(q):
                total += 2.0 * row[k] * with_border[k, m] * row[9 + m]
        for k in range(6):
            for m in range(6):
                total += row[3 + k] * inverse.blocks[pair, k, m] * row[3 + m]
            for m in range(q):
                total += 2.0 * row[3 + k] * inverse.border[image, k, m] * row[9 + m]
        for k in range(q):
            for m in range(q):
                total += row[9 + k] * inverse.corner[k, m] * row[9 + m]
        out[axis] = total
