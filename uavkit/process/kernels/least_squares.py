"""Least squares matching of one patch after another: inner loops.

Inverse compositional form. With u the offset from the reference point, R the reference and T the target, the target
warped by the current estimate is regressed on eight columns that depend on the reference alone:

    T(p + W u) = alpha + beta R(u) + beta grad R(u) . (s + A u)

so that the normal matrix is formed and factored once a point; each iteration resamples T and solves. The warp becomes
W <- W (1 + A)^-1, p <- p - W s. At convergence s = A = 0, and alpha, beta are the radiometric unknowns.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel, summing_kernel

UNKNOWNS = 8
SHIFT_UNKNOWNS = 4
FRACTION_BITS = 10
"""Weights of interpolation are tabled at 2^-10 px: rounding errors of position are below 0.0005 px and random."""

OK, LEFT_IMAGE, DIVERGED, LOW_TEXTURE, LOW_CORRELATION, AFFINE_TOO_LARGE = 0, 1, 2, 3, 4, 5

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class Workspace(NamedTuple):
    """Arrays that one thread reuses for all of its points."""

    buffer: Floats
    """Part of a picture as floats; only its first rows and columns may be in use."""
    frame: NDArray[np.int64]
    """Left column, top row, columns and rows of that part."""
    lines: Floats
    """Rows of the reference window, interpolated along the rows only."""
    large: Floats
    patch: Floats
    columns: Floats
    weighted: Floats
    normal: Doubles
    middle: Doubles
    lower: Doubles
    right: Doubles
    solution: Doubles
    rows_of_inverse: Doubles


class Criteria(NamedTuple):
    """When to stop and what to refuse; pixels and grey values."""

    most_iterations: int
    shift_iterations: int
    convergence_px: float
    most_drift_px: float
    least_gradient: float
    least_correlation: float
    most_affine_change: float


def workspace(size: int, buffer_side: int) -> Workspace:
    """Arrays for windows of size x size and parts of pictures of up to buffer_side x buffer_side."""
    return Workspace(
        buffer=np.zeros((buffer_side, buffer_side), np.float32),
        frame=np.zeros(4, np.int64),
        lines=np.zeros((size + 5, size + 2), np.float32),
        large=np.zeros((size + 2, size + 2), np.float32),
        patch=np.zeros((size, size), np.float32),
        columns=np.zeros((UNKNOWNS, size * size), np.float32),
        weighted=np.zeros((UNKNOWNS, size * size), np.float32),
        normal=np.zeros((UNKNOWNS, UNKNOWNS)),
        middle=np.zeros((UNKNOWNS, UNKNOWNS)),
        lower=np.zeros((UNKNOWNS, UNKNOWNS)),
        right=np.zeros(UNKNOWNS),
        solution=np.zeros(UNKNOWNS),
        rows_of_inverse=np.zeros((2, UNKNOWNS)),
    )


@kernel
def reach_of_window(warp: Doubles, size: int, axis: int) -> float:
    """Half extent of a warped window along an axis of the picture, with the margin of the interpolation."""
    return float((abs(warp[axis, 0]) + abs(warp[axis, 1])) * (size // 2) + 3.0)


@kernel
def _take_part(image: NDArray[np.uint8], centre: Doubles, reach_x: float, reach_y: float, work: Workspace) -> bool:
    """Copy the part of the image within reach of a centre; False if the centre is outside or the buffer too small."""
    rows, columns = image.shape
    if not (0.0 <= centre[0] < columns and 0.0 <= centre[1] < rows):
        return False
    left, right = max(0, int(centre[0] - reach_x)), min(columns, int(centre[0] + reach_x) + 2)
    top, bottom = max(0, int(centre[1] - reach_y)), min(rows, int(centre[1] + reach_y) + 2)
    if right - left > work.buffer.shape[1] or bottom - top > work.buffer.shape[0]:
        return False
    work.frame[0], work.frame[1], work.frame[2], work.frame[3] = left, top, right - left, bottom - top
    for row in range(bottom - top):
        line, source = work.buffer[row, : right - left], image[top + row, left:right]
        for column in range(right - left):
            line[column] = np.float32(source[column])
    return True


@kernel
def _inside(position: Doubles, warp: Doubles, size: int, frame: NDArray[np.int64]) -> bool:
    """True if the warped window lies in the copied part."""
    x, y = position[0] - frame[0], position[1] - frame[1]
    reach_x, reach_y = reach_of_window(warp, size, 0), reach_of_window(warp, size, 1)
    return bool(reach_x <= x <= frame[2] - 1 - reach_x and reach_y <= y <= frame[3] - 1 - reach_y)


@kernel
def _resample_cubic(
    buffer: Floats, frame: NDArray[np.int64], centre: Doubles, matrix: Doubles, table: Floats, patch: Floats
) -> None:
    """Bicubic (Catmull-Rom) grey values at centre + matrix @ (offset from the patch's middle)."""
    half = patch.shape[0] // 2
    flat, columns = buffer.ravel(), buffer.shape[1]
    stride, one, two, three = np.uint64(columns), np.uint64(1), np.uint64(2), np.uint64(3)
    step_x = np.int64(np.round(matrix[0, 0] * 65536.0))
    step_y = np.int64(np.round(matrix[1, 0] * 65536.0))
    bits = 16 - FRACTION_BITS
    for row in range(patch.shape[0]):
        start_x = centre[0] - frame[0] + matrix[0, 1] * (row - half) - matrix[0, 0] * half
        start_y = centre[1] - frame[1] + matrix[1, 1] * (row - half) - matrix[1, 0] * half
        x = np.int64(np.floor(start_x * 65536.0)) + (1 << (bits - 1))
        y = np.int64(np.floor(start_y * 65536.0)) + (1 << (bits - 1))
        for column in range(patch.shape[1]):
            # unsigned, or every index is tested for being negative
            a = np.uint64(((y >> 16) - 1) * columns + (x >> 16) - 1)
            b = a + stride
            c = b + stride
            d = c + stride
            v, h = table[np.uint64((y & 65535) >> bits)], table[np.uint64((x & 65535) >> bits)]
            first = (v[0] * flat[a] + v[1] * flat[b]) + (v[2] * flat[c] + v[3] * flat[d])
            second = (v[0] * flat[a + one] + v[1] * flat[b + one]) + (v[2] * flat[c + one] + v[3] * flat[d + one])
            third = (v[0] * flat[a + two] + v[1] * flat[b + two]) + (v[2] * flat[c + two] + v[3] * flat[d + two])
            last = (v[0] * flat[a + three] + v[1] * flat[b + three]) + (v[2] * flat[c + three] + v[3] * flat[d + three])
            patch[row, column] = (h[0] * first + h[1] * second) + (h[2] * third + h[3] * last)
            x += step_x
            y += step_y


@kernel
def _resample_shifted(
    buffer: Floats, frame: NDArray[np.int64], centre: Doubles, table: Floats, lines: Floats, patch: Floats
) -> None:
    """Bicubic grey values about a centre without any deformation: first along the rows, then along the columns."""
    rows, size = lines.shape
    half = size // 2
    bits = 16 - FRACTION_BITS
    x = np.int64(np.floor((centre[0] - frame[0]) * 65536.0)) + (1 << (bits - 1))
    y = np.int64(np.floor((centre[1] - frame[1]) * 65536.0)) + (1 << (bits - 1))
    at_x, at_y = (x & 65535) >> bits, (y & 65535) >> bits
    h0, h1, h2, h3 = table[at_x, 0], table[at_x, 1], table[at_x, 2], table[at_x, 3]
    v0, v1, v2, v3 = table[at_y, 0], table[at_y, 1], table[at_y, 2], table[at_y, 3]
    left, top = (x >> 16) - half - 1, (y >> 16) - half - 1
    for row in range(rows):
        source, line = buffer[top + row, left : left + size + 3], lines[row]
        for column in range(size):
            first = h0 * source[column] + h1 * source[column + 1]
            line[column] = first + (h2 * source[column + 2] + h3 * source[column + 3])
    for row in range(size):
        a, b, c, d = lines[row], lines[row + 1], lines[row + 2], lines[row + 3]
        line = patch[row]
        for column in range(size):
            line[column] = (v0 * a[column] + v1 * b[column]) + (v2 * c[column] + v3 * d[column])


@kernel
def _resample_linear(buffer: Floats, frame: NDArray[np.int64], centre: Doubles, matrix: Doubles, patch: Floats) -> None:
    """Bilinear grey values, for the first, rough iterations."""
    half = patch.shape[0] // 2
    flat, columns = buffer.ravel(), buffer.shape[1]
    stride, one, unit = np.uint64(columns), np.uint64(1), np.float32(1.0 / 65536.0)
    step_x = np.int64(np.round(matrix[0, 0] * 65536.0))
    step_y = np.int64(np.round(matrix[1, 0] * 65536.0))
    for row in range(patch.shape[0]):
        start_x = centre[0] - frame[0] + matrix[0, 1] * (row - half) - matrix[0, 0] * half
        start_y = centre[1] - frame[1] + matrix[1, 1] * (row - half) - matrix[1, 0] * half
        x, y = np.int64(np.floor(start_x * 65536.0)), np.int64(np.floor(start_y * 65536.0))
        for column in range(patch.shape[1]):
            a = np.uint64((y >> 16) * columns + (x >> 16))
            b = a + stride
            fx, fy = np.float32(x & 65535) * unit, np.float32(y & 65535) * unit
            upper = flat[a] + fx * (flat[a + one] - flat[a])
            lower = flat[b] + fx * (flat[b + one] - flat[b])
            patch[row, column] = upper + fy * (lower - upper)
            x += step_x
            y += step_y


@summing_kernel
def _dot(first: Floats, second: Floats) -> np.float32:
    total = np.float32(0.0)
    for at in range(first.shape[0]):
        total += first[at] * second[at]
    return total


@kernel
def _design(patch: Floats, weights: Floats, columns: Floats, weighted: Floats) -> None:
    """The eight columns (8, m * m), plain and weighted, of the inner pixels of patch (m + 2, m + 2).

    Order: 1, R - mean, Rx, Ry, Rx u, Rx v, Ry u, Ry v, with offsets u, v in half windows.
    """
    size = weights.shape[0]
    half = size // 2
    scale = np.float32(1.0 / half)
    mean = np.float32(patch[1 : size + 1, 1 : size + 1].mean())
    for row in range(size):
        v = np.float32(row - half) * scale
        above, here, below = patch[row], patch[row + 1], patch[row + 2]
        begin = row * size
        for column in range(size):
            at = begin + column
            u = np.float32(column - half) * scale
            gx = (here[column + 2] - here[column]) * np.float32(0.5)
            gy = (below[column + 1] - above[column + 1]) * np.float32(0.5)
            columns[0, at] = np.float32(1.0)
            columns[1, at] = here[column + 1] - mean
            columns[2, at] = gx
            columns[3, at] = gy
            columns[4, at] = gx * u
            columns[5, at] = gx * v
            columns[6, at] = gy * u
            columns[7, at] = gy * v
    flat = weights.ravel()
    for i in range(UNKNOWNS):
        for at in range(size * size):
            weighted[i, at] = columns[i, at] * flat[at]


@kernel
def _factor(normal: Doubles, lower: Doubles) -> bool:
    """Cholesky factor of a small matrix; False if it is not positive definite."""
    for i in range(normal.shape[0]):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = total / lower[j, j]
            elif total <= 1e-6 * normal[i, i] or not total > 0.0:
                return False
            else:
                lower[i, i] = np.sqrt(total)
    return True


@kernel
def _solve(lower: Doubles, right: Doubles, size: int, solution: Doubles) -> None:
    """Solve for the first size unknowns; the leading block of a Cholesky factor is the factor of the leading block."""
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * solution[k]
        solution[i] = total / lower[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= lower[k, i] * solution[k]
        solution[i] = total / lower[i, i]


@kernel
def _prepare_reference(
    reference: NDArray[np.uint8],
    centre: Doubles,
    weights: Floats,
    table: Floats,
    least_gradient: float,
    work: Workspace,
) -> int:
    """Design and factored normal matrix of one reference window; returns the status."""
    size = weights.shape[0]
    unit = np.eye(2)
    reach = reach_of_window(unit, size + 2, 0)
    if not _take_part(reference, centre, reach, reach, work) or not _inside(centre, unit, size + 2, work.frame):
        return LEFT_IMAGE
    _resample_shifted(work.buffer, work.frame, centre, table, work.lines, work.large)
    _design(work.large, weights, work.columns, work.weighted)
    normal = work.normal
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            normal[i, j] = normal[j, i] = _dot(work.weighted[i], work.columns[j])
    weight_sum = normal[0, 0]
    sxx, sxy, syy = normal[2, 2] / weight_sum, normal[2, 3] / weight_sum, normal[3, 3] / weight_sum
    weakest = 0.5 * (sxx + syy) - np.sqrt(0.25 * (sxx - syy) ** 2 + sxy * sxy)
    if not weakest > least_gradient**2 or not _factor(normal, work.lower):
        return LOW_TEXTURE
    return OK


@kernel
def _update(solution: Doubles, half: float, position: Doubles, warp: Doubles) -> float:
    """Compose the warp with the inverse of the increment; returns the shift in target pixels, inf if degenerate."""
    gain = solution[1]
    if not abs(gain) > 1e-3:
        return np.inf
    a, b = 1.0 + solution[4] / gain / half, solution[5] / gain / half
    c, d = solution[6] / gain / half, 1.0 + solution[7] / gain / half
    determinant = a * d - b * c
    if not 0.3 < determinant < 3.0:
        return np.inf
    w00 = (warp[0, 0] * d - warp[0, 1] * c) / determinant
    w01 = (warp[0, 1] * a - warp[0, 0] * b) / determinant
    w10 = (warp[1, 0] * d - warp[1, 1] * c) / determinant
    w11 = (warp[1, 1] * a - warp[1, 0] * b) / determinant
    warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1] = w00, w01, w10, w11
    dx = -(w00 * solution[2] + w01 * solution[3]) / gain
    dy = -(w10 * solution[2] + w11 * solution[3]) / gain
    position[0] += dx
    position[1] += dy
    return float(np.sqrt(dx * dx + dy * dy))


@kernel
def _iterate(
    target: NDArray[np.uint8], position: Doubles, warp: Doubles, table: Floats, criteria: Criteria, work: Workspace
) -> tuple[int, int]:
    """Move and deform the window until it fits; returns the status and the number of iterations."""
    size = work.patch.shape[0]
    spare = criteria.most_drift_px + criteria.most_affine_change * size
    reach_x, reach_y = reach_of_window(warp, size, 0), reach_of_window(warp, size, 1)
    if not _take_part(target, position, reach_x + spare, reach_y + spare, work):
        return LEFT_IMAGE, 0
    x, y = position[0], position[1]
    flat = work.patch.ravel()
    for iteration in range(criteria.most_iterations):
        if not _inside(position, warp, size, work.frame):
            return LEFT_IMAGE, iteration
        shift_only = iteration < criteria.shift_iterations
        if shift_only:
            _resample_linear(work.buffer, work.frame, position, warp, work.patch)
        else:
            _resample_cubic(work.buffer, work.frame, position, warp, table, work.patch)
        unknowns = SHIFT_UNKNOWNS if shift_only else UNKNOWNS
        for i in range(unknowns):
            work.right[i] = _dot(work.weighted[i], flat)
        work.solution[:] = 0.0
        _solve(work.lower, work.right, unknowns, work.solution)
        moved = _update(work.solution, float(size // 2), position, warp)
        if not moved < np.inf or np.hypot(position[0] - x, position[1] - y) > criteria.most_drift_px:
            return DIVERGED, iteration + 1
        if moved < criteria.convergence_px and not shift_only:
            return OK, iteration + 1
    return DIVERGED, criteria.most_iterations


@kernel
def _judge(weights: Floats, work: Workspace, result: Doubles) -> None:
    """Gain, offset, noise and weighted correlation of the last resampling, from the sums of least squares."""
    flat, ones = work.patch.ravel(), work.columns[0]
    solution, lower = work.solution, work.lower
    total = float(work.normal[0, 0])
    mean = work.right[0] / total
    tt = 0.0
    residual = work.large.ravel()[: flat.shape[0]]
    for at in range(flat.shape[0]):
        residual[at] = flat[at] - np.float32(solution[0])
    for i in range(1, lower.shape[0]):
        amount = np.float32(solution[i])
        column = work.columns[i]
        for at in range(flat.shape[0]):
            residual[at] -= amount * column[at]
    squares = float(_dot_three(residual, residual, weights.ravel()))
    for at in range(flat.shape[0]):
        residual[at] = flat[at] - np.float32(mean)
    tt = float(_dot_three(residual, residual, weights.ravel()))
    tr = float(_dot_three(residual, work.columns[1], weights.ravel()))
    reference_mean = work.normal[0, 1] / total
    rr = work.normal[1, 1] - total * reference_mean * reference_mean
    pixels = ones.shape[0]
    result[0], result[1] = solution[1], solution[0]
    result[2] = np.sqrt(squares / total * pixels / (pixels - UNKNOWNS))
    result[3] = tr / np.sqrt(max(tt * rr, 1e-12))


@summing_kernel
def _dot_three(first: Floats, second: Floats, third: Floats) -> np.float32:
    total = np.float32(0.0)
    for at in range(first.shape[0]):
        total += first[at] * second[at] * third[at]
    return total


@kernel
def _covariance(warp: Doubles, work: Workspace, result: Doubles) -> None:
    """Formal covariance of the position: sigma^2 / beta^2 N^-1 A'W^2 A N^-1, its shift block turned into the target."""
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            work.middle[i, j] = work.middle[j, i] = _dot(work.weighted[i], work.weighted[j])
    for i in range(2):
        work.right[:] = 0.0
        work.right[2 + i] = 1.0
        _solve(work.lower, work.right, UNKNOWNS, work.rows_of_inverse[i])
    xx = xy = yy = 0.0
    first, second = work.rows_of_inverse[0], work.rows_of_inverse[1]
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            xx += first[i] * work.middle[i, j] * first[j]
            xy += first[i] * work.middle[i, j] * second[j]
            yy += second[i] * work.middle[i, j] * second[j]
    factor = (result[2] / work.solution[1]) ** 2
    a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    result[4] = factor * (a * a * xx + 2 * a * b * xy + b * b * yy)
    result[5] = factor * (a * c * xx + (a * d + b * c) * xy + b * d * yy)
    result[6] = factor * (c * c * xx + 2 * c * d * xy + d * d * yy)


@kernel
def _change(warp: Doubles, start: Doubles) -> float:
    """Largest change of an element of the warp, in units of its scale."""
    largest = 0.0
    for i in range(2):
        for j in range(2):
            largest = max(largest, abs(warp[i, j] - start[i, j]))
    return float(largest / np.sqrt(abs(start[0, 0] * start[1, 1] - start[0, 1] * start[1, 0])))


@kernel
def match_patches(
    reference: NDArray[np.uint8],
    target: NDArray[np.uint8],
    reference_px: Doubles,
    weights: Floats,
    table: Floats,
    criteria: Criteria,
    positions: Doubles,
    warps: Doubles,
    results: Doubles,
    status: NDArray[np.int64],
    work: Workspace,
) -> None:
    """Match every row; positions (n, 2) and warps (n, 2, 2) hold the start and get the result.

    results (n, 8) = (gain, offset, sigma grey, correlation, cxx, cxy, cyy, iterations).
    """
    start = np.zeros((2, 2))
    for point in range(reference_px.shape[0]):
        result = results[point]
        result[:] = np.nan
        result[7] = 0
        code = _prepare_reference(reference, reference_px[point], weights, table, criteria.least_gradient, work)
        if code == OK:
            start[:] = warps[point]
            code, done = _iterate(target, positions[point], warps[point], table, criteria, work)
            result[7] = done
        if code == OK:
            _judge(weights, work, result)
            _covariance(warps[point], work, result)
            if not result[3] >= criteria.least_correlation:
                code = LOW_CORRELATION
            elif _change(warps[point], start) > criteria.most_affine_change:
                code = AFFINE_TOO_LARGE
        status[point] = code
