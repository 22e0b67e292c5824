"""Covariances of object points and leverages of rays, from the inverse of the reduced normal equations."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.bundle_normals import (
    Coordinates,
    Equations,
    Free,
    PairTable,
    RayTable,
    Unknowns,
    eliminate_point,
    empty_equations,
    linearise_point,
)
from uavkit.process.kernels.bundle_products import add_left_product, add_right_product
from uavkit.process.kernels.jit import kernel, summing_kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Inverse(NamedTuple):
    """Blocks of the inverse of the reduced normal equations at the pattern of ``Reduced``."""

    row_start: Indices
    column: Indices
    blocks: Array
    border: Array
    corner: Array


@summing_kernel
def point_precision(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Free, coordinates: Coordinates, first: int, last: int,
    pairs: PairTable, inverse: Inverse, covariance: Array, leverage: Array,
) -> None:  # fmt: skip
    """Write covariances (m, 3, 3) of points first to last and leverages (k, 2) of all their rays.

    Leverage: variance of the adjusted image coordinate over the observation's a priori variance; also of rays of weight
    zero, which are predicted by the others. NaN where the point is not determined. The redundancy number of a ray of
    full weight is 1 - leverage (Foerstner 1987; Kraus, Photogrammetry, vol. 2, app. 4).
    With N^-1 = root^T root and Y = root (mixed part), the point's covariance is root^T (1 + Y Q Y^T) root, and that
    with the orientations -root^T Y Q.
    """
    every, used = empty_equations(rays, unknowns, free, first, last), empty_equations(rays, unknowns, free, first, last)
    most, d, q = used.by_image.shape[0], used.by_image.shape[2], used.by_border.shape[2]
    ones, of_every = np.ones(len(weight)), np.empty(most, dtype=np.int64)
    reducer, turned, reducer_border = np.empty((most, 3, d)), np.empty((most, d, 3)), np.empty((3, q))
    carried, carried_turned, carried_border = np.empty((most, 3, d)), np.empty((most, d, 3)), np.empty((3, q))
    other, other_turned, with_image, with_border = (
        np.empty((1, 3, d)), np.empty((1, d, 3)), np.empty((3, d)), np.empty((3, q)),
    )  # fmt: skip
    for p in range(first, last):
        for k in range(3):
            for m in range(3):
                covariance[p, k, m] = np.nan
        for ray in range(rays.start[p], rays.start[p + 1]):
            leverage[ray, 0], leverage[ray, 1] = np.nan, np.nan
        total = linearise_point(rays, unknowns, ones, free, p, every)
        count = _choose_used(every, total, weight, used, of_every)
        if not eliminate_point(coordinates, p, 0.0, count, used):
            continue
        _reduce(used, count, reducer, turned, reducer_border)
        for a in range(count):
            carried[a], carried_turned[a] = 0.0, 0.0
        for a in range(count):
            i = rays.image[used.row[a]]
            for b in range(a + 1):
                at = pairs.place[pairs.base[i] + rays.image[used.row[b]]]
                add_left_product(carried, b, turned, a, inverse.blocks, at)
                if b < a:
                    add_right_product(carried_turned, a, inverse.blocks, at, turned, b)
        carried_border[:] = 0.0
        for a in range(count):
            i = rays.image[used.row[a]]
            for r in range(3):
                for k in range(d):
                    carried[a, r, k] += carried_turned[a, k, r]
            _add_with_border(inverse, i, reducer[a], reducer_border, carried[a], carried_border)
        for r in range(3):
            for k in range(q):
                for m in range(q):
                    carried_border[r, m] += reducer_border[r, k] * inverse.corner[k, m]
        _write_covariance(used, count, carried, reducer, carried_border, reducer_border, covariance[p])
        _times_root(used.root, carried_border, with_border)
        for t in range(total):
            i = rays.image[every.row[t]]
            if of_every[t] >= 0:
                _times_root(used.root, carried[of_every[t]], with_image)
            else:
                _carry_to_other(
                    rays, pairs, inverse, used, count, i, turned, reducer_border, other, other_turned
                )  # fmt: skip
                _times_root(used.root, other[0], with_image)
            block = inverse.blocks[pairs.place[pairs.base[i] + i]]
            for axis in range(2):
                leverage[every.row[t], axis] = _variance(
                    every.by_point[t, axis], every.by_image[t, axis], every.by_border[t, axis], covariance[p],
                    with_image, with_border, block, inverse.border[i], inverse.corner,
                )  # fmt: skip


@summing_kernel
def fixed_leverage(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Free, coordinates: Coordinates, first: int, last: int,
    covariance: Array, leverage: Array,
) -> None:  # fmt: skip
    """Write what ``point_precision`` does, but for orientations known exactly: an inverse of nothing but zeros."""
    every, used = empty_equations(rays, unknowns, free, first, last), empty_equations(rays, unknowns, free, first, last)
    ones, of_every = np.ones(len(weight)), np.empty(len(used.row), dtype=np.int64)
    for p in range(first, last):
        for k in range(3):
            for m in range(3):
                covariance[p, k, m] = np.nan
        for ray in range(rays.start[p], rays.start[p + 1]):
            leverage[ray, 0], leverage[ray, 1] = np.nan, np.nan
        total = linearise_point(rays, unknowns, ones, free, p, every)
        count = _choose_used(every, total, weight, used, of_every)
        if not eliminate_point(coordinates, p, 0.0, count, used):
            continue
        covariance[p] = used.inverse
        for t in range(total):
            for axis in range(2):
                variance = 0.0
                for k in range(3):
                    for m in range(3):
                        variance += every.by_point[t, axis, k] * used.inverse[k, m] * every.by_point[t, axis, m]
                leverage[every.row[t], axis] = variance


@kernel
def _choose_used(every: Equations, total: int, weight: Array, used: Equations, of_every: Indices) -> int:
    """Write equations of weight above zero, weighted, to ``used``, and each's number there or -1; return how many."""
    count = 0
    for t in range(total):
        of_every[t] = -1
        if not weight[every.row[t]] > 0.0:
            continue
        root = np.sqrt(weight[every.row[t]])
        for axis in range(2):
            used.misclosure[count, axis] = root * every.misclosure[t, axis]
            for k in range(3):
                used.by_point[count, axis, k] = root * every.by_point[t, axis, k]
            for k in range(every.by_image.shape[2]):
                used.by_image[count, axis, k] = root * every.by_image[t, axis, k]
            for k in range(every.by_border.shape[2]):
                used.by_border[count, axis, k] = root * every.by_border[t, axis, k]
        used.row[count] = every.row[t]
        of_every[t] = count
        count += 1
    return count


@summing_kernel
def _reduce(used: Equations, count: int, reducer: Array, turned: Array, reducer_border: Array) -> None:
    """Write root (mixed part) of each image (3, d), turned (d, 3), and of the border (3, q)."""
    reducer_border[:] = 0.0
    for a in range(count):
        for r in range(3):
            s0, s1 = 0.0, 0.0
            for k in range(r + 1):
                s0 += used.root[r, k] * used.by_point[a, 0, k]
                s1 += used.root[r, k] * used.by_point[a, 1, k]
            for k in range(reducer.shape[2]):
                value = s0 * used.by_image[a, 0, k] + s1 * used.by_image[a, 1, k]
                reducer[a, r, k] = value
                turned[a, k, r] = value
            for k in range(reducer_border.shape[1]):
                reducer_border[r, k] += s0 * used.by_border[a, 0, k] + s1 * used.by_border[a, 1, k]


@summing_kernel
def _add_with_border(
    inverse: Inverse, image: int, reducer: Array, reducer_border: Array, carried: Array, carried_border: Array
) -> None:
    """Add the border's part to Y Q of an image (3, d), and the image's part to Y Q of the border (3, q)."""
    border = inverse.border[image]
    for r in range(3):
        for k in range(reducer.shape[1]):
            total, factor = 0.0, reducer[r, k]
            for m in range(reducer_border.shape[1]):
                total += reducer_border[r, m] * border[k, m]
                carried_border[r, m] += factor * border[k, m]
            carried[r, k] += total


@summing_kernel
def _carry_to_other(
    rays: RayTable, pairs: PairTable, inverse: Inverse, used: Equations, count: int, image: int, turned: Array,
    reducer_border: Array, out: Array, out_turned: Array,
) -> None:  # fmt: skip
    """Write Y Q (3, d) of an image whose own ray of the point has no weight."""
    out[:], out_turned[:] = 0.0, 0.0
    for a in range(count):
        j = rays.image[used.row[a]]
        if j >= image:
            add_left_product(out, 0, turned, a, inverse.blocks, pairs.place[pairs.base[j] + image])
        else:
            add_right_product(out_turned, 0, inverse.blocks, pairs.place[pairs.base[image] + j], turned, a)
    for r in range(3):
        for k in range(out.shape[2]):
            total = out_turned[0, k, r]
            for m in range(reducer_border.shape[1]):
                total += reducer_border[r, m] * inverse.border[image, k, m]
            out[0, r, k] += total


@summing_kernel
def _write_covariance(
    used: Equations, count: int, carried: Array, reducer: Array, carried_border: Array, reducer_border: Array,
    out: Array,
) -> None:  # fmt: skip
    """Write root^T (1 + Y Q Y^T) root."""
    root, middle = used.root, np.empty((3, 3))
    for r in range(3):
        for s in range(3):
            total = 1.0 if r == s else 0.0
            for a in range(count):
                for k in range(reducer.shape[2]):
                    total += carried[a, r, k] * reducer[a, s, k]
            for k in range(reducer_border.shape[1]):
                total += carried_border[r, k] * reducer_border[s, k]
            middle[r, s] = total
    for k in range(3):
        for m in range(k + 1):
            total = 0.0
            for r in range(k, 3):
                for s in range(m, 3):
                    total += root[r, k] * 0.5 * (middle[r, s] + middle[s, r]) * root[s, m]
            out[k, m], out[m, k] = total, total


@summing_kernel
def _times_root(root: Array, carried: Array, out: Array) -> None:
    """Write -root^T carried, (3, u): the covariance of a point with other unknowns."""
    for k in range(carried.shape[1]):
        c0, c1, c2 = carried[0, k], carried[1, k], carried[2, k]
        out[0, k] = -(root[0, 0] * c0 + root[1, 0] * c1 + root[2, 0] * c2)
        out[1, k] = -(root[1, 1] * c1 + root[2, 1] * c2)
        out[2, k] = -root[2, 2] * c2


@summing_kernel
def _variance(
    by_point: Array, by_image: Array, by_border: Array, covariance: Array, with_image: Array, with_border: Array,
    block: Array, border: Array, corner: Array,
) -> float:  # fmt: skip
    """Return the variance of a computed image coordinate over that of the observed one."""
    d, q = len(by_image), len(by_border)
    total = 0.0
    for k in range(3):
        line = 0.0
        for m in range(3):
            line += covariance[k, m] * by_point[m]
        for m in range(d):
            line += 2.0 * with_image[k, m] * by_image[m]
        for m in range(q):
            line += 2.0 * with_border[k, m] * by_border[m]
        total += by_point[k] * line
    for k in range(d):
        line = 0.0
        for m in range(d):
            line += block[k, m] * by_image[m]
        for m in range(q):
            line += 2.0 * border[k, m] * by_border[m]
        total += by_image[k] * line
    for k in range(q):
        line = 0.0
        for m in range(q):
            line += corner[k, m] * by_border[m]
        total += by_border[k] * line
    return total
