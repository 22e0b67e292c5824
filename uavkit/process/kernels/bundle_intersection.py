"""Space intersection of many points, robust against rays that do not belong to them."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.bundle_geometry import differentiate, direction, project
from uavkit.process.kernels.bundle_normals import RayTable, Unknowns, invert_point
from uavkit.process.kernels.jit import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

MOST_PAIRS = 120
"""Pairs of rays tried for a point; of more, evenly chosen ones."""
BEHIND = 1e6
"""Squared misclosure, in sigma, of a ray whose point is behind its camera."""


@kernel
def squared_misclosures(rays: RayTable, unknowns: Unknowns, first: int, last: int, point: Array, out: Array) -> None:
    """Write |v / sigma|^2 of the rays first to last for a trial position of their point."""
    computed = np.empty(2)
    for ray in range(first, last):
        i = rays.image[ray]
        out[ray - first] = BEHIND
        if project(unknowns.interior[unknowns.camera[i]], unknowns.centres[i], unknowns.rotations[i], point, computed):
            x = (rays.xy_px[ray, 0] - computed[0]) / rays.sigma_px[ray, 0]
            y = (rays.xy_px[ray, 1] - computed[1]) / rays.sigma_px[ray, 1]
            out[ray - first] = x * x + y * y


@kernel
def cauchy_cost(squared: Array, count: int, scale: float) -> float:
    """Return sum log(1 + z^2 / scale^2), which gross errors cannot outweigh (Holland and Welsch 1977)."""
    total = 0.0
    for a in range(count):
        total += np.log(1.0 + squared[a] / (scale * scale))
    return total


@kernel
def meet(c1: Array, d1: Array, c2: Array, d2: Array, out: Array) -> bool:
    """Write the point midway between two rays where they are nearest; False where parallel or behind a camera."""
    bx, by, bz = c2[0] - c1[0], c2[1] - c1[1], c2[2] - c1[2]
    cosine = d1[0] * d2[0] + d1[1] * d2[1] + d1[2] * d2[2]
    determinant = 1.0 - cosine * cosine
    if determinant < 1e-10:
        return False
    p1, p2 = bx * d1[0] + by * d1[1] + bz * d1[2], bx * d2[0] + by * d2[1] + bz * d2[2]
    t1, t2 = (p1 - cosine * p2) / determinant, (cosine * p1 - p2) / determinant
    if t1 <= 0.0 or t2 <= 0.0:
        return False
    for axis in range(3):
        out[axis] = 0.5 * (c1[axis] + t1 * d1[axis] + c2[axis] + t2 * d2[axis])
    return True


@kernel
def refine(
    rays: RayTable, unknowns: Unknowns, first: int, last: int, scale: float, point: Array, squared: Array
) -> float:
    """Improve a point by iteratively re-weighted least squares with Cauchy's weights; return its cost."""
    computed, bp, br, bi = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 10))
    normal, inverse, right, trial = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    count = last - first
    squared_misclosures(rays, unknowns, first, last, point, squared)
    best = cauchy_cost(squared, count, scale)
    for _ in range(10):
        normal[:], right[:] = 0.0, 0.0
        for ray in range(first, last):
            i = rays.image[ray]
            if not differentiate(
                unknowns.interior[unknowns.camera[i]],
                unknowns.centres[i],
                unknowns.rotations[i],
                point,
                computed,
                bp,
                br,
                bi,
            ):
                continue
            weight = 1.0 / (1.0 + squared[ray - first] / (scale * scale))
            for axis in range(2):
                factor = weight / rays.sigma_px[ray, axis] ** 2
                misclosure = rays.xy_px[ray, axis] - computed[axis]
                for k in range(3):
                    right[k] += factor * bp[axis, k] * misclosure
                    for m in range(3):
                        normal[k, m] += factor * bp[axis, k] * bp[axis, m]
        if not invert_point(normal, inverse):
            break
        trial[:] = point + inverse @ right
        squared_misclosures(rays, unknowns, first, last, trial, squared)
        found = cauchy_cost(squared, count, scale)
        if not found < best - 1e-9:
            if found < best:
                point[:] = trial
            break
        best = found
        point[:] = trial
    squared_misclosures(rays, unknowns, first, last, point, squared)
    return cauchy_cost(squared, count, scale)


@kernel
def intersect_robustly(
    rays: RayTable, unknowns: Unknowns, chosen: Flags, scales: Array, first: int, last: int, points: Array
) -> None:
    """Write better positions of the chosen points first to last: the best pair of rays.

    Of all pairs that one is best which most other rays support. The scales, (m,), are of normalised misclosures at
    the present orientations. A point keeps its position where no pair of rays gives a smaller cost.
    """
    most = 1
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    directions, valid, squared = np.empty((most, 3)), np.empty(most, dtype=np.bool_), np.empty(most)
    trial, best_point = np.empty(3), np.empty(3)
    for p in range(first, last):
        begin, end = rays.start[p], rays.start[p + 1]
        count, scale = end - begin, scales[p]
        if not chosen[p] or count < 2:
            continue
        for a in range(count):
            i = rays.image[begin + a]
            valid[a] = direction(
                unknowns.interior[unknowns.camera[i]],
                unknowns.rotations[i],
                rays.xy_px[begin + a, 0],
                rays.xy_px[begin + a, 1],
                directions[a],
            )
        best = np.inf
        if np.isfinite(points[p, 0]):
            best_point[:] = points[p]
            best = refine(rays, unknowns, begin, end, scale, best_point, squared)
        stride = 1 + (count * (count - 1) // 2) // MOST_PAIRS
        number = 0
        pair_best = np.inf
        pair_point = np.empty(3)
        for a in range(count):
            for b in range(a):
                number += 1
                if number % stride != 0 or not (valid[a] and valid[b]):
                    continue
                i, j = rays.image[begin + a], rays.image[begin + b]
                if not meet(unknowns.centres[i], directions[a], unknowns.centres[j], directions[b], trial):
                    continue
                squared_misclosures(rays, unknowns, begin, end, trial, squared)
                found = cauchy_cost(squared, count, scale)
                if found < pair_best:
                    pair_best = found
                    pair_point[:] = trial
        if np.isfinite(pair_best):
            pair_best = refine(rays, unknowns, begin, end, scale, pair_point, squared)
            if pair_best < best:
                best_point[:] = pair_point
                best = pair_best
        if np.isfinite(best):
            points[p] = best_point


@kernel
def adjust_points(
    rays: RayTable, unknowns: Unknowns, used: Flags, first: int, last: int, points: Array, covariances: Array,
    leverage: Array,
) -> None:  # fmt: skip
    """Adjust points first to last by Gauss-Newton from their used rays; write covariances and leverages of all rays.

    All NaN where fewer than two used rays, or nearly parallel ones, do not determine a point or its iteration fails.
    """
    computed, bp, br, bi = np.empty(2), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 10))
    normal, inverse, right, step = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for p in range(first, last):
        converged = False
        for _ in range(20):
            normal[:], right[:] = 0.0, 0.0
            for ray in range(rays.start[p], rays.start[p + 1]):
                i = rays.image[ray]
                if not used[ray] or not differentiate(
                    unknowns.interior[unknowns.camera[i]],
                    unknowns.centres[i],
                    unknowns.rotations[i],
                    points[p],
                    computed,
                    bp,
                    br,
                    bi,
                ):
                    continue
                for axis in range(2):
                    factor = 1.0 / rays.sigma_px[ray, axis] ** 2
                    misclosure = rays.xy_px[ray, axis] - computed[axis]
                    for k in range(3):
                        right[k] += factor * bp[axis, k] * misclosure
                        for m in range(3):
                            normal[k, m] += factor * bp[axis, k] * bp[axis, m]
            if not invert_point(normal, inverse):
                break
            step[:] = inverse @ right
            points[p] += step
            if np.dot(step, normal @ step) < 1e-8:
                converged = True
                break
        if not converged:
            points[p] = np.nan
            covariances[p] = np.nan
            for ray in range(rays.start[p], rays.start[p + 1]):
                leverage[ray] = np.nan
            continue
        covariances[p] = inverse
        for ray in range(rays.start[p], rays.start[p + 1]):
            i = rays.image[ray]
            leverage[ray] = np.nan
            if differentiate(
                unknowns.interior[unknowns.camera[i]],
                unknowns.centres[i],
                unknowns.rotations[i],
                points[p],
                computed,
                bp,
                br,
                bi,
            ):
                for axis in range(2):
                    leverage[ray, axis] = np.dot(bp[axis], inverse @ bp[axis]) / rays.sigma_px[ray, axis] ** 2
