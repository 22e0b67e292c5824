"""Inner loops of planning on bare arrays: heights of the ground, rays to it, images seen by other images.

A ground is three arrays: heights (rows, columns), the polynomial (2, 10) that gives column and row in it of map
coordinates, and (3,) the origin and scale of the polynomial's arguments. Outside the grid its rim goes on.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

RIM = 1e-9
"""A point this far outside, as a share of the image, is on its rim."""
Function = TypeVar("Function", bound=Callable[..., Any])
Floats = NDArray[np.float64]
Heights = NDArray[np.float32]


def kernel(function: Function) -> Function:
    """Compile an inner loop on bare arrays; it runs without the interpreter lock, so threads may share the work."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def inlined(function: Function) -> Function:
    """The same for a small function that disappears inside its caller."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function))


@inlined
def ground_height(heights: Heights, polynomial: Floats, origin: Floats, x: float, y: float) -> float:
    """Return the bilinear height at map coordinates; nan over a void."""
    a, b = (x - origin[0]) * origin[2], (y - origin[1]) * origin[2]
    aa, ab, bb = a * a, a * b, b * b
    c, r = polynomial[0, 0], polynomial[1, 0]
    c += polynomial[0, 1] * a + polynomial[0, 2] * b + polynomial[0, 3] * aa + polynomial[0, 4] * ab
    r += polynomial[1, 1] * a + polynomial[1, 2] * b + polynomial[1, 3] * aa + polynomial[1, 4] * ab
    c += polynomial[0, 5] * bb + a * (polynomial[0, 6] * aa + polynomial[0, 7] * ab)
    r += polynomial[1, 5] * bb + a * (polynomial[1, 6] * aa + polynomial[1, 7] * ab)
    c += b * (polynomial[0, 8] * ab + polynomial[0, 9] * bb)
    r += b * (polynomial[1, 8] * ab + polynomial[1, 9] * bb)
    if np.isnan(c + r):
        return np.nan
    rows, columns = heights.shape
    c, r = min(max(c, 0.0), columns - 1.0), min(max(r, 0.0), rows - 1.0)
    j, i = min(int(c), columns - 2), min(int(r), rows - 2)
    p, q = c - j, r - i
    upper = heights[i, j] * (1.0 - p) + heights[i, j + 1] * p
    lower = heights[i + 1, j] * (1.0 - p) + heights[i + 1, j + 1] * p
    return float(upper * (1.0 - q) + lower * q)


@kernel
def ground_heights(heights: Heights, polynomial: Floats, origin: Floats, xy: Floats, out: Floats) -> None:
    """Heights (n,) at map coordinates (n, 2)."""
    for k in range(len(xy)):
        out[k] = ground_height(heights, polynomial, origin, xy[k, 0], xy[k, 1])


@inlined
def _reach_on_gentle_ground(
    heights: Heights, polynomial: Floats, origin: Floats, centre: Floats, ray: tuple[float, float, float], guess: float
) -> float:
    """Return how far along a ray the ground is met, by secants from a guess of its height; -1 if they do not settle.

    Only where a single crossing is possible.
    """
    dx, dy, dz = ray
    near_enough = max(1e-3, 2e-5 * (centre[2] - guess))
    t = max((centre[2] - guess) / -dz, 0.0)
    gap = centre[2] + t * dz - ground_height(heights, polynomial, origin, centre[0] + t * dx, centre[1] + t * dy)
    after = t + gap / -dz
    for _ in range(8):
        if np.isnan(gap):
            return np.nan
        if abs(gap) < near_enough:
            return float(t)
        new = (
            centre[2]
            + after * dz
            - ground_height(heights, polynomial, origin, centre[0] + after * dx, centre[1] + after * dy)
        )
        if new == gap:
            break
        t, gap, after = after, new, after + new * (after - t) / (gap - new)
        if after < 0.0:
            break
    return float(t) if abs(gap) < near_enough else -1.0


@kernel
def _reach(
    heights: Heights,
    polynomial: Floats,
    origin: Floats,
    limits: Floats,
    centre: Floats,
    ray: tuple[float, float, float],
) -> float:
    """Return how far along a ray (dx, dy, dz), dz < 0, the ground is met; nan if it is not met, or over a void.

    limits: least and greatest height of the ground, greatest slope, step of the march, greatest horizontal distance.
    """
    dx, dy, dz = ray
    low, high, slope, step, farthest = limits[0], limits[1], limits[2], limits[3], limits[4]
    run = np.sqrt(dx * dx + dy * dy)
    if dz > -1e-3 * run:
        return np.nan
    near = max(0.0, (centre[2] - high) / -dz)
    far = (centre[2] - low) / -dz + 1e-9
    if run * near > farthest:
        return np.nan
    if slope * run > -0.95 * dz and run > 0.0:  # more than one crossing is possible: the first one counts
        t, stride = near, step / run
        while t < far and run * t < farthest:
            x, y = centre[0] + t * dx, centre[1] + t * dy
            if centre[2] + t * dz <= ground_height(heights, polynomial, origin, x, y):
                break
            t += stride
        near, far = max(near, t - stride), t
    above = centre[2] + near * dz
    above -= ground_height(heights, polynomial, origin, centre[0] + near * dx, centre[1] + near * dy)
    below = centre[2] + far * dz
    below -= ground_height(heights, polynomial, origin, centre[0] + far * dx, centre[1] + far * dy)
    if np.isnan(above) or np.isnan(below):
        return np.nan
    if above <= 0.0:
        return float(near)
    t = far
    for _ in range(60):
        t = near + (far - near) * above / (above - below)
        gap = centre[2] + t * dz - ground_height(heights, polynomial, origin, centre[0] + t * dx, centre[1] + t * dy)
        if np.isnan(gap) or abs(gap) < 1e-3 or far - near < 1e-9:
            break
        if gap > 0.0:
            near, above = t, gap
            below *= 0.5  # Illinois: the end that stays loses weight
        else:
            far, below = t, gap
            above *= 0.5
    if run * t > farthest:
        return np.nan
    return float(t)


@kernel
def ground_points(
    heights: Heights,
    polynomial: Floats,
    origin: Floats,
    limits: Floats,
    centres: Floats,
    rotations: Floats,
    directions: Floats,
    out: Floats,
) -> None:
    """Ground points (n, m, 3) of directions (m, 3) in image space of images at centres (n, 3), rotations (n, 3, 3)."""
    for i in range(len(centres)):
        centre = centres[i]
        guess = ground_height(heights, polynomial, origin, centre[0], centre[1])
        for k in range(len(directions)):
            u, v, w = directions[k, 0], directions[k, 1], directions[k, 2]
            dx = rotations[i, 0, 0] * u + rotations[i, 0, 1] * v + rotations[i, 0, 2] * w
            dy = rotations[i, 1, 0] * u + rotations[i, 1, 1] * v + rotations[i, 1, 2] * w
            dz = rotations[i, 2, 0] * u + rotations[i, 2, 1] * v + rotations[i, 2, 2] * w
            t = -1.0
            if limits[2] * np.sqrt(dx * dx + dy * dy) < -0.95 * dz and guess < centre[2]:
                t = _reach_on_gentle_ground(heights, polynomial, origin, centre, (dx, dy, dz), guess)
            if t == -1.0:
                t = _reach(heights, polynomial, origin, limits, centre, (dx, dy, dz))
            out[i, k, 0] = centre[0] + t * dx
            out[i, k, 1] = centre[1] + t * dy
            out[i, k, 2] = centre[2] + t * dz
            if not np.isnan(t):
                guess = out[i, k, 2]


@inlined
def _margins(camera: Floats, centre: Floats, rotation: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """Return how far inside an image a ground point lies, across columns and rows, as shares of its size; < 0 outside.

    camera: width, height, principal distance, x0, y0, k1, k2, k3, p1, p2, b1, b2, greatest radius (normalised).
    """
    dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
    u = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    v = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    w = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if not w < -1e-9:  # behind the camera, or no ground point at all
        return -10.0, -10.0
    a, b = u / -w, -v / -w
    r2 = a * a + b * b
    if r2 > camera[12] * camera[12]:
        # beyond the field of view the polynomial of the distortion may fold: measured without it
        column, row = camera[3] + camera[2] * a, camera[4] + camera[2] * b
    else:
        radial = 1.0 + r2 * (camera[5] + r2 * (camera[6] + r2 * camera[7]))
        ad = a * radial + 2.0 * camera[8] * a * b + camera[9] * (r2 + 2.0 * a * a)
        bd = b * radial + camera[8] * (r2 + 2.0 * b * b) + 2.0 * camera[9] * a * b
        column = camera[3] + camera[2] * ((1.0 + camera[10]) * ad + camera[11] * bd)
        row = camera[4] + camera[2] * bd
    across = min(column + 0.5, camera[0] - 0.5 - column) / camera[0]
    along = min(row + 0.5, camera[1] - 0.5 - row) / camera[1]
    return across + RIM, along + RIM


@inlined
def _clip(corners: Floats, count: int, by: int, out: Floats) -> int:
    """Cut a polygon (count, 4) of x, y and two values to where value ``by`` is not negative; return its new count."""
    found = 0
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        here, there = corners[k, by], corners[after, by]
        if here >= 0.0:
            for c in range(4):
                out[found, c] = corners[k, c]
            found += 1
        if (here >= 0.0) != (there >= 0.0):
            t = here / (here - there)
            for c in range(4):
                out[found, c] = corners[k, c] + t * (corners[after, c] - corners[k, c])
            found += 1
    return found


@kernel
def _triangle_share(work: Floats) -> float:
    """Return the share of a unit right triangle, work[0, :3] = x, y and two values at its corners, where both are >= 0.

    The values change linearly between the corners.
    """
    count = _clip(work[0], 3, 2, work[1])
    count = _clip(work[1], count, 3, work[2])
    double_area = 0.0
    for k in range(count):
        after = k + 1 if k + 1 < count else 0
        double_area += work[2, k, 0] * work[2, after, 1] - work[2, after, 0] * work[2, k, 1]
    return abs(double_area)


@inlined
def _share(margins: Floats, rows: int, columns: int, work: Floats) -> float:
    """Return the share of an image with both margins (rows * columns, 2) positive, on nodes from rim to rim."""
    total = 0.0
    for i in range(rows - 1):
        for j in range(columns - 1):
            k = i * columns + j
            low, high = np.inf, -np.inf
            low_b, high_b = np.inf, -np.inf
            for node in (k, k + 1, k + columns, k + columns + 1):
                low, high = min(low, margins[node, 0]), max(high, margins[node, 0])
                low_b, high_b = min(low_b, margins[node, 1]), max(high_b, margins[node, 1])
            if high < 0.0 or high_b < 0.0:
                continue
            if low >= 0.0 and low_b >= 0.0:
                total += 1.0
                continue
            for upper in range(2):
                nodes = (k, k + 1, k + columns) if upper else (k + columns + 1, k + columns, k + 1)
                for corner in range(3):
                    work[0, corner, 0] = 1.0 if corner == 1 else 0.0
                    work[0, corner, 1] = 1.0 if corner == 2 else 0.0
                    work[0, corner, 2] = margins[nodes[corner], 0]
                    work[0, corner, 3] = margins[nodes[corner], 1]
                total += 0.5 * _triangle_share(work)
    return total / ((rows - 1) * (columns - 1))


@kernel
def forward_shares(
    points: Floats, centres: Floats, rotations: Floats, camera: Floats, shape: tuple[int, int], out: Floats
) -> None:
    """Share (n,) of each image that the next one shows: ground points (n, m, 3) on (rows, columns) nodes; last nan."""
    rows, columns = shape
    margins, work = np.empty((rows * columns, 2)), np.empty((3, 8, 4))
    for i in range(len(centres) - 1):
        for k in range(rows * columns):
            x, y, z = points[i, k, 0], points[i, k, 1], points[i, k, 2]
            margins[k, 0], margins[k, 1] = _margins(camera, centres[i + 1], rotations[i + 1], x, y, z)
        out[i] = _share(margins, rows, columns, work)
    out[len(centres) - 1] = np.nan


@inlined
def _nearest(along: Floats, value: float) -> int:
    """Return the index of the nearest of ascending values."""
    low, high = 0, len(along)
    while low < high:
        middle = (low + high) // 2
        if along[middle] < value:
            low = middle + 1
        else:
            high = middle
    if low == len(along) or (low > 0 and value - along[low - 1] < along[low] - value):
        return low - 1
    return low


@kernel
def side_shares(
    points: Floats,
    direction: Floats,
    along: Floats,
    centres: Floats,
    rotations: Floats,
    camera: Floats,
    shape: tuple[int, int],
    reach: int,
    out: Floats,
) -> None:
    """Share (n,) of images, given by ground points (n, m, 3), that any image of the neighbouring line shows.

    along: ascending coordinates of the neighbour's images in the direction (2,). Of these the nearest to each ground
    point are tried, ``reach`` to each side, until one shows it well.
    """
    rows, columns = shape
    margins, work = np.empty((rows * columns, 2)), np.empty((3, 8, 4))
    count = len(along)
    for i in range(len(points)):
        for k in range(rows * columns):
            x, y, z = points[i, k, 0], points[i, k, 1], points[i, k, 2]
            best_a, best_b = -10.0, -10.0
            if not np.isnan(x):
                middle = _nearest(along, x * direction[0] + y * direction[1])
                for step in range(2 * reach + 1):
                    j = middle + ((step + 1) // 2 if step % 2 else -(step // 2))
                    if 0 <= j < count:
                        a, b = _margins(camera, centres[j], rotations[j], x, y, z)
                        if min(a, b) > min(best_a, best_b):
                            best_a, best_b = a, b
                        if step >= 2 and min(best_a, best_b) > 0.0:
                            break
            margins[k, 0], margins[k, 1] = best_a, best_b
        out[i] = _share(margins, rows, columns, work)


@kernel
def count_images(
    cells: Floats,
    first: Floats,
    cell_m: float,
    points: Floats,
    centres: Floats,
    rotations: Floats,
    camera: Floats,
    counts: NDArray[np.uint16],
) -> None:
    """Add to counts (rows, columns) the images that see each cell, of which cells gives the ground's height.

    points (n, m, 3): ground points of each image's rim, for the part of the map to look at.
    """
    rows, columns = cells.shape
    for i in range(len(centres)):
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for k in range(points.shape[1]):
            x, y = points[i, k, 0], points[i, k, 1]
            if not np.isnan(x):
                low_x, high_x = min(low_x, x), max(high_x, x)
                low_y, high_y = min(low_y, y), max(high_y, y)
        if not low_x <= high_x:
            continue
        first_column = max(0, int(np.ceil((low_x - first[0]) / cell_m)) - 1)
        last_column = min(columns - 1, int(np.floor((high_x - first[0]) / cell_m)) + 1)
        first_row = max(0, int(np.ceil((low_y - first[1]) / cell_m)) - 1)
        last_row = min(rows - 1, int(np.floor((high_y - first[1]) / cell_m)) + 1)
        for r in range(first_row, last_row + 1):
            y = first[1] + r * cell_m
            for c in range(first_column, last_column + 1):
                x = first[0] + c * cell_m
                a, b = _margins(camera, centres[i], rotations[i], x, y, cells[r, c])
                if min(a, b) >= 0.0:
                    counts[r, c] += 1


@kernel
def simplified(distance: Floats, height: Floats, kept: NDArray[np.bool_], tolerance: float) -> None:
    """Mark in ``kept`` (n,), beside those marked already, the nodes of a profile that keep it within a tolerance.

    Douglas and Peucker's method with vertical distances.
    """
    count = len(distance)
    stack = np.empty((count + 1, 2), np.int64)
    top, start = 0, 0
    for k in range(1, count):
        if kept[k]:
            stack[top, 0], stack[top, 1] = start, k
            top += 1
            start = k
    while top > 0:
        top -= 1
        a, b = stack[top, 0], stack[top, 1]
        if b - a < 2:
            continue
        slope = (height[b] - height[a]) / (distance[b] - distance[a])
        worst, at = -1.0, a
        for k in range(a + 1, b):
            off = abs(height[a] + slope * (distance[k] - distance[a]) - height[k])
            if off > worst:
                worst, at = off, k
        if worst > tolerance:
            kept[at] = True
            stack[top, 0], stack[top, 1] = a, at
            stack[top + 1, 0], stack[top + 1, 1] = at, b
            top += 2


@kernel
def path_clearance(
    heights: Heights, polynomial: Floats, origin: Floats, path: Floats, step_m: float, out: Floats
) -> None:
    """Least and greatest height above the ground on each leg of a path (k, 3), (k - 1, 2); nan over a void."""
    for leg in range(len(path) - 1):
        dx, dy, dz = path[leg + 1, 0] - path[leg, 0], path[leg + 1, 1] - path[leg, 1], path[leg + 1, 2] - path[leg, 2]
        steps = max(1, int(np.ceil(np.sqrt(dx * dx + dy * dy) / step_m)))
        low, high = np.inf, -np.inf
        for k in range(steps + 1):
            t = k / steps
            ground = ground_height(heights, polynomial, origin, path[leg, 0] + t * dx, path[leg, 1] + t * dy)
            above = path[leg, 2] + t * dz - ground
            if np.isnan(above):
                low = high = np.nan
                break
            low, high = min(low, above), max(high, above)
        out[leg, 0], out[leg, 1] = low, high
