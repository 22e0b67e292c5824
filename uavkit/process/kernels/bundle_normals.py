"""Normal equations of the bundle: points eliminated one by one (Schur complement), blocks of image pairs accumulated.

The reduced normal equations are kept as d x d blocks of those pairs of images (i >= j) that see a point in common, in
compressed rows, with a border of few columns (shared interior orientation, GNSS shifts); see
``process.normal_equations``. An image has d = 6 unknowns, and those of an interior orientation of its own.
Brown, D. C. (1958), RCA-MTP data reduction technical report 43; Kraus, Photogrammetry, vol. 1, sec. 5.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.bundle_geometry import LEAST_DEPTH_M, project
from uavkit.process.kernels.bundle_products import add_squares, subtract_product
from uavkit.process.kernels.jit import kernel, summing_kernel

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Places = NDArray[np.int32]
Flags = NDArray[np.bool_]

LEAST_DETERMINANT = 1e-13
"""Below this, det(N) / (trace(N) / 3)^3 of a point's normal equations, its rays do not determine it."""
BEHIND_CAMERA = 1e3
"""Misclosure, in sigma, that the cost counts for a ray whose point is behind its camera."""

NEARLY_PARALLEL = 1e-12
"""Below this of the same, a point is so far off that its distance shows no more; it is not moved farther."""


class RayTable(NamedTuple):
    """Rays in the order of their points: those of point p are rows start[p] to start[p + 1], images ascending."""

    start: Indices
    image: Indices
    xy_px: Array
    sigma_px: Array


class Unknowns(NamedTuple):
    """Values of the unknowns: centres (n, 3), rotations (n, 3, 3), points (m, 3), interior orientations (g, 10)."""

    interior: Array
    centres: Array
    rotations: Array
    points: Array
    camera: Indices
    """(n,) row of an image's interior orientation."""


class Free(NamedTuple):
    """Free parameters of the interior orientations."""

    own: Indices
    """Unknowns of each image, where every image has its own interior orientation; else empty."""
    shared: Indices
    """Unknowns of the border, for each interior orientation these."""


class Coordinates(NamedTuple):
    """Direct observations of the object points: normal matrices (m, 3, 3) and right-hand sides (m, 3), or none (0)."""

    normal: Array
    right: Array


class PairTable(NamedTuple):
    """Where the block of images i >= j is: place[base[i] + j], for images j from ``first[i]`` on."""

    base: Indices
    first: Indices
    place: Places


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
    """(n, d) diagonal before the points were eliminated: the measure of what is singular, and of damping."""
    diagonal_border: Array


class Equations(NamedTuple):
    """Scratch for the whitened observation equations of the rays of one point, and for what follows from them."""

    by_image: Array
    """(r, 2, d)."""
    by_border: Array
    """(r, 2, q)."""
    by_point: Array
    """(r, 2, 3)."""
    misclosure: Array
    """(r, 2)."""
    row: Indices
    """(r,) row of each ray."""
    by_interior: Array
    """(2, 10) of one ray."""
    inverse: Array
    """(3, 3) of the point's (damped) normal matrix."""
    root: Array
    """(3, 3) lower; inverse = root^T root."""
    gradient: Array
    """(3,) the point's right-hand side."""
    regularity: Array
    """(1,) det(N) / (trace(N) / 3)^3 of the point's normal matrix."""


@kernel
def empty_equations(rays: RayTable, unknowns: Unknowns, free: Free, first: int, last: int) -> Equations:
    """Return scratch for points first to last."""
    most, d, q = 1, 6 + len(free.own), len(free.shared) * len(unknowns.interior)
    for p in range(first, last):
        most = max(most, rays.start[p + 1] - rays.start[p])
    return Equations(
        np.zeros((most, 2, d)), np.zeros((most, 2, q)), np.zeros((most, 2, 3)), np.zeros((most, 2)),
        np.zeros(most, dtype=np.int64), np.zeros((2, 10)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3),
        np.zeros(1),
    )  # fmt: skip


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
def mark_first_partners(start: Indices, image: Indices, first: Indices) -> None:
    """Lower first (n,) to the first image with which each shares a point."""
    for p in range(len(start) - 1):
        if start[p + 1] > start[p]:
            lowest = image[start[p]]
            for ray in range(start[p], start[p + 1]):
                first[image[ray]] = min(first[image[ray]], lowest)


@kernel
def mark_pairs(start: Indices, image: Indices, base: Indices, place: Places) -> None:
    """Set place[base[i] + j] to 1 for images i >= j which share a point, and for i = j."""
    for i in range(len(base)):
        place[base[i] + i] = 1
    for p in range(len(start) - 1):
        for a in range(start[p], start[p + 1]):
            row = base[image[a]]
            for b in range(start[p], a):
                place[row + image[b]] = 1


@kernel
def number_pairs(pairs: PairTable, row_start: Indices) -> int:
    """Number the marked places row by row, the others get -1; write row_start (n + 1,) and return their number."""
    count = 0
    for i in range(len(pairs.base)):
        row_start[i] = count
        for j in range(pairs.first[i], i + 1):
            at = pairs.base[i] + j
            if pairs.place[at] > 0:
                pairs.place[at] = count
                count += 1
            else:
                pairs.place[at] = -1
    row_start[len(pairs.base)] = count
    return count


@kernel
def list_columns(pairs: PairTable, column: Indices) -> None:
    """Write the column of each pair."""
    for i in range(len(pairs.base)):
        for j in range(pairs.first[i], i + 1):
            number = pairs.place[pairs.base[i] + j]
            if number >= 0:
                column[number] = j


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
            interior = unknowns.interior[unknowns.camera[i]]
            seen = project(interior, unknowns.centres[i], unknowns.rotations[i], unknowns.points[p], computed)
            for axis in range(2):
                out[ray, axis] = rays.xy_px[ray, axis] - computed[axis] if seen else np.nan


@summing_kernel
def weighted_squares(
    rays: RayTable, unknowns: Unknowns, weight: Array, determined: Flags, first: int, last: int
) -> float:
    """Return the weighted sum of squared misclosures of the rays of determined points first to last."""
    centres, rotations, points = unknowns.centres, unknowns.rotations, unknowns.points
    total = 0.0
    for p in range(first, last):
        if not determined[p]:
            continue
        x0, x1, x2 = points[p, 0], points[p, 1], points[p, 2]
        for ray in range(rays.start[p], rays.start[p + 1]):
            if not weight[ray] > 0.0:
                continue
            i = rays.image[ray]
            interior, camera = unknowns.interior, unknowns.camera[i]
            dx, dy, dz = x0 - centres[i, 0], x1 - centres[i, 1], x2 - centres[i, 2]
            w = rotations[i, 0, 2] * dx + rotations[i, 1, 2] * dy + rotations[i, 2, 2] * dz
            if not w < -LEAST_DEPTH_M:
                total += 2.0 * weight[ray] * BEHIND_CAMERA * BEHIND_CAMERA
                continue
            by_depth = 1.0 / w
            x = -(rotations[i, 0, 0] * dx + rotations[i, 1, 0] * dy + rotations[i, 2, 0] * dz) * by_depth
            y = (rotations[i, 0, 1] * dx + rotations[i, 1, 1] * dy + rotations[i, 2, 1] * dz) * by_depth
            c, k1, k2, k3 = interior[camera, 0], interior[camera, 3], interior[camera, 4], interior[camera, 5]
            p1, p2 = interior[camera, 6], interior[camera, 7]
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            xd = x * radial + p1 * 2.0 * x * y + p2 * (r2 + 2.0 * x * x)
            yd = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * 2.0 * x * y
            column = interior[camera, 1] + c * ((1.0 + interior[camera, 8]) * xd + interior[camera, 9] * yd)
            row = interior[camera, 2] + c * yd
            e0, e1 = (
                (rays.xy_px[ray, 0] - column) / rays.sigma_px[ray, 0],
                (rays.xy_px[ray, 1] - row) / rays.sigma_px[ray, 1],
            )
            total += weight[ray] * (e0 * e0 + e1 * e1)
    return total


@summing_kernel
def _by_interior(
    line: Array,
    factor: tuple[float, float],
    interior: Array,
    ideal: tuple[float, float],
    distorted: tuple[float, float],
) -> None:
    """Write the whitened derivatives (2, 10) of an image point by its interior orientation."""
    f0, f1 = factor
    x, y = ideal
    xd, yd = distorted
    c, b1, b2 = interior[0], interior[8], interior[9]
    r2 = x * x + y * y
    f0c, f1c = f0 * c, f1 * c
    line[0, 0], line[1, 0] = f0 * ((1.0 + b1) * xd + b2 * yd), f1 * yd
    line[0, 1], line[1, 1], line[0, 2], line[1, 2] = f0, 0.0, 0.0, f1
    column, row, power = f0c * ((1.0 + b1) * x + b2 * y), f1c * y, r2
    line[0, 3], line[1, 3] = power * column, power * row
    power *= r2
    line[0, 4], line[1, 4] = power * column, power * row
    power *= r2
    line[0, 5], line[1, 5] = power * column, power * row
    line[0, 6], line[1, 6] = (
        f0c * ((1.0 + b1) * 2.0 * x * y + b2 * (r2 + 2.0 * y * y)), f1c * (r2 + 2.0 * y * y)
    )  # fmt: skip
    line[0, 7], line[1, 7] = (
        f0c * ((1.0 + b1) * (r2 + 2.0 * x * x) + b2 * 2.0 * x * y), f1c * 2.0 * x * y
    )  # fmt: skip
    line[0, 8], line[1, 8], line[0, 9], line[1, 9] = f0c * xd, 0.0, f0c * yd, 0.0


@summing_kernel
def linearise_point(rays: RayTable, unknowns: Unknowns, weight: Array, free: Free, p: int, out: Equations) -> int:
    """Write the whitened observation equations of a point's rays of weight above zero; return how many there are.

    The derivatives are those of ``bundle_geometry.differentiate``, with no more than is needed, and nothing in arrays
    that need not be.
    """
    centres, rotations, points, interior = unknowns.centres, unknowns.rotations, unknowns.points, unknowns.interior
    own, shared, groups = len(free.own), len(free.shared), len(interior)
    x0, x1, x2 = points[p, 0], points[p, 1], points[p, 2]
    line = out.by_interior
    count = 0
    for ray in range(rays.start[p], rays.start[p + 1]):
        if not weight[ray] > 0.0:
            continue
        i = rays.image[ray]
        g = unknowns.camera[i]
        r00, r01, r02 = rotations[i, 0, 0], rotations[i, 0, 1], rotations[i, 0, 2]
        r10, r11, r12 = rotations[i, 1, 0], rotations[i, 1, 1], rotations[i, 1, 2]
        r20, r21, r22 = rotations[i, 2, 0], rotations[i, 2, 1], rotations[i, 2, 2]
        dx, dy, dz = x0 - centres[i, 0], x1 - centres[i, 1], x2 - centres[i, 2]
        w = r02 * dx + r12 * dy + r22 * dz
        if not w < -LEAST_DEPTH_M:
            continue
        u, v = r00 * dx + r10 * dy + r20 * dz, r01 * dx + r11 * dy + r21 * dz
        c, b1, b2 = interior[g, 0], interior[g, 8], interior[g, 9]
        k1, k2, k3, p1, p2 = interior[g, 3], interior[g, 4], interior[g, 5], interior[g, 6], interior[g, 7]
        by_depth = 1.0 / w
        x, y = -u * by_depth, v * by_depth
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        xd = x * radial + p1 * 2.0 * x * y + p2 * (r2 + 2.0 * x * x)
        yd = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * 2.0 * x * y
        cross = x * y * slope + 2.0 * (p1 * x + p2 * y)
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        root = np.sqrt(weight[ray])
        f0, f1 = root / rays.sigma_px[ray, 0], root / rays.sigma_px[ray, 1]
        column, row = interior[g, 1] + c * ((1.0 + b1) * xd + b2 * yd), interior[g, 2] + c * yd
        out.misclosure[count, 0] = f0 * (rays.xy_px[ray, 0] - column)
        out.misclosure[count, 1] = f1 * (rays.xy_px[ray, 1] - row)
        for axis in range(2):
            by_x, by_y = f1 * c * cross, f1 * c * yy
            if axis == 0:
                by_x, by_y = f0 * c * ((1.0 + b1) * xx + b2 * cross), f0 * c * ((1.0 + b1) * cross + b2 * yy)
            by_u, by_v, by_w = -by_x * by_depth, by_y * by_depth, -(by_x * x + by_y * y) * by_depth
            bp0, bp1 = by_u * r00 + by_v * r01 + by_w * r02, by_u * r10 + by_v * r11 + by_w * r12
            bp2 = by_u * r20 + by_v * r21 + by_w * r22
            out.by_point[count, axis, 0], out.by_point[count, axis, 1], out.by_point[count, axis, 2] = bp0, bp1, bp2
            line_image = out.by_image[count, axis]
            line_image[0], line_image[1], line_image[2] = -bp0, -bp1, -bp2
            line_image[3], line_image[4], line_image[5] = by_v * w - by_w * v, by_w * u - by_u * w, by_u * v - by_v * u
        if own + shared > 0:
            _by_interior(line, (f0, f1), interior[g], (x, y), (xd, yd))
            if groups > 1:
                out.by_border[count] = 0.0
            for axis in range(2):
                for k in range(own):
                    out.by_image[count, axis, 6 + k] = line[axis, free.own[k]]
                for k in range(shared):
                    out.by_border[count, axis, g * shared + k] = line[axis, free.shared[k]]
        out.row[count] = ray
        count += 1
    return count


@summing_kernel
def eliminate_point(coordinates: Coordinates, p: int, damping: float, count: int, out: Equations) -> bool:
    """Write inverse, its root and the right-hand side of a point's (damped) normals; False where undetermined."""
    a, b, c, d, e, f, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if len(coordinates.normal) > 0:
        normal = coordinates.normal[p]
        a, b, c, d, e, f = normal[0, 0], normal[0, 1], normal[0, 2], normal[1, 1], normal[1, 2], normal[2, 2]
        g0, g1, g2 = coordinates.right[p, 0], coordinates.right[p, 1], coordinates.right[p, 2]
    for ray in range(count):
        for axis in range(2):
            x, y, z = out.by_point[ray, axis, 0], out.by_point[ray, axis, 1], out.by_point[ray, axis, 2]
            v = out.misclosure[ray, axis]
            a, b, c, d, e, f = a + x * x, b + x * y, c + x * z, d + y * y, e + y * z, f + z * z
            g0, g1, g2 = g0 + x * v, g1 + y * v, g2 + z * v
    out.gradient[0], out.gradient[1], out.gradient[2] = g0, g1, g2
    third = (a + d + f) / 3.0
    determinant = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
    out.regularity[0] = determinant / (third * third * third)
    if not out.regularity[0] > LEAST_DETERMINANT:
        return False
    a, d, f = a * (1.0 + damping), d * (1.0 + damping), f * (1.0 + damping)
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    by = 1.0 / (a * i00 + b * i01 + c * i02)
    out.inverse[0, 0], out.inverse[0, 1], out.inverse[0, 2] = by * i00, by * i01, by * i02
    out.inverse[1, 0], out.inverse[1, 1], out.inverse[1, 2] = by * i01, by * i11, by * i12
    out.inverse[2, 0], out.inverse[2, 1], out.inverse[2, 2] = by * i02, by * i12, by * i22
    l00 = np.sqrt(a)
    l10, l20 = b / l00, c / l00
    l11 = np.sqrt(d - l10 * l10)
    l21 = (e - l20 * l10) / l11
    # From the determinant: the difference of nearly equal numbers would lose what a weakly determined point has left.
    r22 = l00 * l11 * np.sqrt(by)
    out.root[0, 0], out.root[0, 1], out.root[0, 2] = 1.0 / l00, 0.0, 0.0
    out.root[1, 0], out.root[1, 1], out.root[1, 2] = -l10 / (l00 * l11), 1.0 / l11, 0.0
    out.root[2, 0], out.root[2, 1], out.root[2, 2] = (l10 * l21 - l20 * l11) / (l00 * l11) * r22, -l21 / l11 * r22, r22
    return bool(r22 == r22)


@summing_kernel
def accumulate(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Free, coordinates: Coordinates, damping: float,
    first: int, last: int, pairs: PairTable, reduced: Reduced, determined: Flags,
) -> None:  # fmt: skip
    """Add points first to last to the reduced normal equations, and note which points their rays determine.

    With N^-1 = root^T root of a point and Y = root (mixed part), pair a, b of its images gets -Y_a^T Y_b.
    """
    eq = empty_equations(rays, unknowns, free, first, last)
    most, d, q = eq.by_image.shape[0], eq.by_image.shape[2], eq.by_border.shape[2]
    reducer, reducer_border, carried, root = np.zeros((most, 3, d)), np.zeros((3, q)), np.zeros(3), eq.root
    seen = np.empty(most, dtype=np.int64)
    base, place, blocks, border = pairs.base, pairs.place, reduced.blocks, reduced.border
    for p in range(first, last):
        count = linearise_point(rays, unknowns, weight, free, p, eq)
        determined[p] = eliminate_point(coordinates, p, damping, count, eq)
        if not determined[p] or count == 0:
            continue
        g0, g1, g2 = eq.gradient[0], eq.gradient[1], eq.gradient[2]
        carried[0], carried[1] = root[0, 0] * g0, root[1, 0] * g0 + root[1, 1] * g1
        carried[2] = root[2, 0] * g0 + root[2, 1] * g1 + root[2, 2] * g2
        reducer_border[:] = 0.0
        for a in range(count):
            seen[a] = rays.image[eq.row[a]]
            for r in range(3):
                s0, s1 = 0.0, 0.0
                for k in range(r + 1):
                    s0 += root[r, k] * eq.by_point[a, 0, k]
                    s1 += root[r, k] * eq.by_point[a, 1, k]
                for k in range(d):
                    reducer[a, r, k] = s0 * eq.by_image[a, 0, k] + s1 * eq.by_image[a, 1, k]
                for k in range(q):
                    reducer_border[r, k] += s0 * eq.by_border[a, 0, k] + s1 * eq.by_border[a, 1, k]
        for a in range(count):
            i = seen[a]
            e0, e1 = eq.misclosure[a, 0], eq.misclosure[a, 1]
            right, diagonal = reduced.right_images[i], reduced.diagonal_images[i]
            for k in range(d):
                j0, j1 = eq.by_image[a, 0, k], eq.by_image[a, 1, k]
                right[k] += (
                    j0 * e0 + j1 * e1 - reducer[a, 0, k] * carried[0] - reducer[a, 1, k] * carried[1]
                    - reducer[a, 2, k] * carried[2]
                )  # fmt: skip
                diagonal[k] += j0 * j0 + j1 * j1
            add_squares(blocks, place[base[i] + i], eq.by_image, a)
            if q > 0:
                for k in range(d):
                    j0, j1 = eq.by_image[a, 0, k], eq.by_image[a, 1, k]
                    y0, y1, y2 = reducer[a, 0, k], reducer[a, 1, k], reducer[a, 2, k]
                    for m in range(q):
                        border[i, k, m] += (
                            j0 * eq.by_border[a, 0, m] + j1 * eq.by_border[a, 1, m]
                            - y0 * reducer_border[0, m] - y1 * reducer_border[1, m] - y2 * reducer_border[2, m]
                        )  # fmt: skip
            for b in range(a + 1):
                j = seen[b]
                subtract_product(blocks, place[base[i] + j], reducer, a, b)
                if b < a and i == j:
                    subtract_product(blocks, place[base[i] + j], reducer, b, a)
        if q > 0:
            _add_border(reduced, eq, count, reducer_border, carried)


@summing_kernel
def _add_border(reduced: Reduced, eq: Equations, count: int, reducer_border: Array, carried: Array) -> None:
    """Add a point's rays, less what its elimination takes, to the shared unknowns' part."""
    for k in range(reducer_border.shape[1]):
        y0, y1, y2 = reducer_border[0, k], reducer_border[1, k], reducer_border[2, k]
        reduced.right_border[k] -= y0 * carried[0] + y1 * carried[1] + y2 * carried[2]
        line = reduced.corner[k]
        for m in range(reducer_border.shape[1]):
            line[m] -= y0 * reducer_border[0, m] + y1 * reducer_border[1, m] + y2 * reducer_border[2, m]
        for a in range(count):
            b0, b1 = eq.by_border[a, 0, k], eq.by_border[a, 1, k]
            reduced.right_border[k] += b0 * eq.misclosure[a, 0] + b1 * eq.misclosure[a, 1]
            reduced.diagonal_border[k] += b0 * b0 + b1 * b1
            for m in range(reducer_border.shape[1]):
                line[m] += b0 * eq.by_border[a, 0, m] + b1 * eq.by_border[a, 1, m]


@summing_kernel
def back_substitute(
    rays: RayTable, unknowns: Unknowns, weight: Array, free: Free, coordinates: Coordinates, damping: float,
    first: int, last: int, step_images: Array, step_border: Array, step_points: Array,
) -> float:  # fmt: skip
    """Write the steps of points first to last, (m, 3), and return their part of step . right-hand side."""
    eq = empty_equations(rays, unknowns, free, first, last)
    d, q = eq.by_image.shape[2], eq.by_border.shape[2]
    product = 0.0
    for p in range(first, last):
        for k in range(3):
            step_points[p, k] = 0.0
        count = linearise_point(rays, unknowns, weight, free, p, eq)
        if not eliminate_point(coordinates, p, damping, count, eq):
            continue
        r0, r1, r2 = eq.gradient[0], eq.gradient[1], eq.gradient[2]
        for a in range(count):
            i = rays.image[eq.row[a]]
            for axis in range(2):
                moved = 0.0
                for k in range(d):
                    moved += eq.by_image[a, axis, k] * step_images[i, k]
                for k in range(q):
                    moved += eq.by_border[a, axis, k] * step_border[k]
                product += moved * eq.misclosure[a, axis]
                r0 -= eq.by_point[a, axis, 0] * moved
                r1 -= eq.by_point[a, axis, 1] * moved
                r2 -= eq.by_point[a, axis, 2] * moved
        for k in range(3):
            step_points[p, k] = eq.inverse[k, 0] * r0 + eq.inverse[k, 1] * r1 + eq.inverse[k, 2] * r2
        if count > 0:
            _hold_back(unknowns.points[p], unknowns.centres[rays.image[eq.row[0]]], eq.regularity[0], step_points[p])
        for k in range(3):
            product += step_points[p, k] * eq.gradient[k]
    return product


@kernel
def _hold_back(point: Array, centre: Array, regularity: float, step: Array) -> None:
    """Shorten the step of a point to its distance from a camera; where rays are all but parallel, keep the distance."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    squared = x * x + y * y + z * z
    outward = x * step[0] + y * step[1] + z * step[2]
    if regularity < NEARLY_PARALLEL and outward > 0.0:
        share = outward / squared
        step[0], step[1], step[2] = step[0] - share * x, step[1] - share * y, step[2] - share * z
    length = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    if length > squared:
        share = np.sqrt(squared / length)
        step[0], step[1], step[2] = share * step[0], share * step[1], share * step[2]
