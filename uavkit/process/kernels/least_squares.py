"""Least squares matching of one patch after another: inner loops.

Inverse compositional form. With u the offset from the reference point, R the reference and T the target, the target
warped by the current estimate is regressed on eight columns that depend on the reference alone:

    T(p + W u) = alpha + beta R(u) + beta grad R(u) . (s + A u)

so that the normal matrix is formed and factored once a point; each iteration resamples T and solves. The warp becomes
W <- W (1 + A)^-1, p <- p - W s. At convergence s = A = 0, and alpha, beta are the radiometric unknowns.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

UNKNOWNS = 8
SHIFT_UNKNOWNS = 4

OK, LEFT_IMAGE, DIVERGED, LOW_TEXTURE, LOW_CORRELATION, AFFINE_TOO_LARGE = 0, 1, 2, 3, 4, 5


@kernel
def _cubic_weights(t: float, weights: NDArray[np.float32]) -> None:
    """Catmull-Rom (Keys, a = -1/2) weights of the four neighbours of a point at fraction t."""
    weights[0] = ((2.0 - t) * t - 1.0) * t * 0.5
    weights[1] = ((3.0 * t - 5.0) * t * t + 2.0) * 0.5
    weights[2] = ((4.0 - 3.0 * t) * t + 1.0) * t * 0.5
    weights[3] = (t - 1.0) * t * t * 0.5


@kernel
def resample_cubic(
    image: NDArray[np.uint8],
    centre: NDArray[np.float64],
    matrix: NDArray[np.float64],
    table: NDArray[np.float32],
    patch: NDArray[np.float32],
) -> bool:
    """Bicubic grey values at centre + matrix @ (offset from the patch's middle); False if outside the image.

    table (k + 1, 4) holds the weights at k fractions; positions are rounded to the k-th part of a pixel (error below
    1 / (4 k) px on average and of both signs).
    """
    rows, columns = image.shape
    size = patch.shape[0]
    half = size // 2
    reach_x = (abs(matrix[0, 0]) + abs(matrix[0, 1])) * half + 3.0
    reach_y = (abs(matrix[1, 0]) + abs(matrix[1, 1])) * half + 3.0
    if not (reach_x <= centre[0] <= columns - 1 - reach_x and reach_y <= centre[1] <= rows - 1 - reach_y):
        return False
    steps = table.shape[0] - 1
    flat = image.ravel()
    # the fraction is taken from a fixed-point number, 16 bits behind the point
    bits = 65536 // steps
    step_x = np.int64(np.round(matrix[0, 0] * 65536.0))
    step_y = np.int64(np.round(matrix[1, 0] * 65536.0))
    for row in range(size):
        start_x = centre[0] + matrix[0, 1] * (row - half) - matrix[0, 0] * half
        start_y = centre[1] + matrix[1, 1] * (row - half) - matrix[1, 0] * half
        x = np.int64(start_x * 65536.0) + bits // 2
        y = np.int64(start_y * 65536.0) + bits // 2
        for column in range(size):
            at = ((y >> 16) - 1) * columns + (x >> 16) - 1
            fx = (x & 65535) // bits
            fy = (y & 65535) // bits
            total = np.float32(0.0)
            for line in range(4):
                begin = at + line * columns
                total += table[fy, line] * (
                    (table[fx, 0] * flat[begin] + table[fx, 1] * flat[begin + 1])
                    + (table[fx, 2] * flat[begin + 2] + table[fx, 3] * flat[begin + 3])
                )
            patch[row, column] = total
            x += step_x
            y += step_y
    return True


@kernel
def _columns_of_reference(
    patch: NDArray[np.float32], weights: NDArray[np.float32], columns: NDArray[np.float32]
) -> None:
    """The eight design columns (8, m * m) of the inner pixels of patch (m + 2, m + 2); offsets in half windows."""
    size = weights.shape[0]
    half = size // 2
    scale = np.float32(1.0 / half)
    mean = np.float32(patch[1 : size + 1, 1 : size + 1].mean())
    for row in range(size):
        v = np.float32(row - half) * scale
        for column in range(size):
            at = row * size + column
            u = np.float32(column - half) * scale
            gx = (patch[row + 1, column + 2] - patch[row + 1, column]) * np.float32(0.5)
            gy = (patch[row + 2, column + 1] - patch[row, column + 1]) * np.float32(0.5)
            columns[0, at] = np.float32(1.0)
            columns[1, at] = patch[row + 1, column + 1] - mean
            columns[2, at] = gx
            columns[3, at] = gy
            columns[4, at] = gx * u
            columns[5, at] = gx * v
            columns[6, at] = gy * u
            columns[7, at] = gy * v


@kernel
def _weighted_dot(first: NDArray[np.float32], second: NDArray[np.float32], lanes: NDArray[np.float32]) -> float:
    """Sum of products in 16 partial sums, which the compiler may keep in vector registers."""
    lanes[:] = np.float32(0.0)
    count = first.shape[0]
    blocks = count // 16
    for block in range(blocks):
        begin = block * 16
        for lane in range(16):
            lanes[lane] += first[begin + lane] * second[begin + lane]
    total = 0.0
    for lane in range(16):
        total += lanes[lane]
    for rest in range(blocks * 16, count):
        total += first[rest] * second[rest]
    return total


@kernel
def _factor(normal: NDArray[np.float64], lower: NDArray[np.float64]) -> bool:
    """Cholesky factor of a small matrix; False if it is not positive definite."""
    size = normal.shape[0]
    for i in range(size):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if total <= 1e-9 * normal[i, i] or not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True


@kernel
def _solve(lower: NDArray[np.float64], right: NDArray[np.float64], size: int, solution: NDArray[np.float64]) -> None:
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
def _update(
    solution: NDArray[np.float64], half: float, position: NDArray[np.float64], warp: NDArray[np.float64]
) -> float:
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
def _inverse_block(
    lower: NDArray[np.float64], middle: NDArray[np.float64], inverse_rows: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Elements xx, xy, yy of N^-1 M N^-1 for the two shifts (unknowns 2 and 3)."""
    size = lower.shape[0]
    unit = np.zeros(size)
    for i in range(2):
        unit[:] = 0.0
        unit[2 + i] = 1.0
        _solve(lower, unit, size, inverse_rows[i])
    xx = xy = yy = 0.0
    for i in range(size):
        for j in range(size):
            xx += inverse_rows[0, i] * middle[i, j] * inverse_rows[0, j]
            xy += inverse_rows[0, i] * middle[i, j] * inverse_rows[1, j]
            yy += inverse_rows[1, i] * middle[i, j] * inverse_rows[1, j]
    return xx, xy, yy


@kernel
def match_patches(
    reference: NDArray[np.uint8],
    target: NDArray[np.uint8],
    reference_px: NDArray[np.float64],
    weights: NDArray[np.float32],
    table: NDArray[np.float32],
    limits: NDArray[np.float64],
    positions: NDArray[np.float64],
    warps: NDArray[np.float64],
    results: NDArray[np.float64],
    status: NDArray[np.int64],
) -> None:
    """Match every row; positions (n, 2) and warps (n, 2, 2) hold the start and get the result.

    limits = (most iterations, iterations with shift only, convergence px, most drift px, least gradient,
    least correlation, most affine change). results (n, 8) = (gain, offset, sigma grey, correlation, cxx, cxy, cyy,
    iterations).
    """
    size = weights.shape[0]
    half = size / 2.0 - 0.5
    pixels = size * size
    large = np.empty((size + 2, size + 2), np.float32)
    patch = np.empty((size, size), np.float32)
    flat = patch.reshape(pixels)
    columns = np.empty((UNKNOWNS, pixels), np.float32)
    weighted = np.empty((UNKNOWNS, pixels), np.float32)
    lanes = np.empty(16, np.float32)
    normal = np.zeros((UNKNOWNS, UNKNOWNS))
    middle = np.zeros((UNKNOWNS, UNKNOWNS))
    lower = np.zeros((UNKNOWNS, UNKNOWNS))
    right = np.zeros(UNKNOWNS)
    solution = np.zeros(UNKNOWNS)
    inverse_rows = np.zeros((2, UNKNOWNS))
    identity = np.eye(2)
    flat_weights = weights.reshape(pixels)
    weight_sum = flat_weights.sum()
    start = np.zeros(2)
    start_warp = np.zeros((2, 2))
    for point in range(reference_px.shape[0]):
        results[point, :] = np.nan
        position, warp = positions[point], warps[point]
        start[:] = position
        start_warp[:] = warp
        if not resample_cubic(reference, reference_px[point], identity, table, large):
            status[point] = LEFT_IMAGE
            continue
        _columns_of_reference(large, weights, columns)
        for i in range(UNKNOWNS):
            for at in range(pixels):
                weighted[i, at] = columns[i, at] * flat_weights[at]
        for i in range(UNKNOWNS):
            for j in range(i + 1):
                normal[i, j] = normal[j, i] = _weighted_dot(weighted[i], columns[j], lanes)
                middle[i, j] = middle[j, i] = _weighted_dot(weighted[i], weighted[j], lanes)
        sxx, sxy, syy = normal[2, 2] / weight_sum, normal[2, 3] / weight_sum, normal[3, 3] / weight_sum
        weakest = 0.5 * (sxx + syy) - np.sqrt(0.25 * (sxx - syy) ** 2 + sxy * sxy)
        if not weakest > limits[4] ** 2 or not _factor(normal, lower):
            status[point] = LOW_TEXTURE
            continue
        code = DIVERGED
        done = 0
        for iteration in range(int(limits[0])):
            if not resample_cubic(target, position, warp, table, patch):
                code = LEFT_IMAGE
                break
            for i in range(UNKNOWNS):
                right[i] = _weighted_dot(weighted[i], flat, lanes)
            shift_only = iteration < limits[1]
            solution[:] = 0.0
            _solve(lower, right, SHIFT_UNKNOWNS if shift_only else UNKNOWNS, solution)
            moved = _update(solution, half, position, warp)
            done = iteration + 1
            drift = np.sqrt((position[0] - start[0]) ** 2 + (position[1] - start[1]) ** 2)
            if not moved < np.inf or drift > limits[3]:
                break
            if moved < limits[2] and not shift_only:
                code = OK
                break
        results[point, 7] = done
        if code != OK:
            status[point] = code
            continue
        status[point] = _judge(columns, flat_weights, flat, solution, limits, results[point])
        change = 0.0
        for i in range(2):
            for j in range(2):
                change = max(change, abs(warp[i, j] - start_warp[i, j]))
        if change > limits[6] * np.sqrt(abs(start_warp[0, 0] * start_warp[1, 1] - start_warp[0, 1] * start_warp[1, 0])):
            status[point] = AFFINE_TOO_LARGE
        xx, xy, yy = _inverse_block(lower, middle, inverse_rows)
        factor = (results[point, 2] / solution[1]) ** 2
        a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
        results[point, 4] = factor * (a * a * xx + 2 * a * b * xy + b * b * yy)
        results[point, 5] = factor * (a * c * xx + (a * d + b * c) * xy + b * d * yy)
        results[point, 6] = factor * (c * c * xx + 2 * c * d * xy + d * d * yy)


@kernel
def _judge(
    columns: NDArray[np.float32],
    weights: NDArray[np.float32],
    grey: NDArray[np.float32],
    solution: NDArray[np.float64],
    limits: NDArray[np.float64],
    result: NDArray[np.float64],
) -> int:
    """Radiometry, residual noise and weighted correlation of the last resampling; returns the status."""
    alpha, beta = solution[0], solution[1]
    squares = weight_sum = mean = reference_mean = 0.0
    pixels = grey.shape[0]
    for at in range(pixels):
        weight_sum += weights[at]
        mean += weights[at] * grey[at]
        reference_mean += weights[at] * columns[1, at]
    mean /= weight_sum
    reference_mean /= weight_sum
    tt = rr = tr = 0.0
    for at in range(pixels):
        weight = weights[at]
        predicted = alpha
        for i in range(1, UNKNOWNS):
            predicted += solution[i] * columns[i, at]
        residual = grey[at] - predicted
        squares += weight * residual * residual
        t, r = grey[at] - mean, columns[1, at] - reference_mean
        tt += weight * t * t
        rr += weight * r * r
        tr += weight * t * r
    result[0], result[1] = beta, alpha
    result[2] = np.sqrt(squares / weight_sum * pixels / (pixels - UNKNOWNS))
    result[3] = tr / np.sqrt(max(tt * rr, 1e-12))
    return OK if result[3] >= limits[5] else LOW_CORRELATION
