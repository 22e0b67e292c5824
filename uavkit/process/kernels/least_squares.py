"""Least squares matching of one patch after another: inner loops.

Inverse compositional form. With u the offset from the reference point, R the reference and T the target, the target
warped by the current estimate is regressed on eight columns that depend on the reference alone:

    T(p + W u) = alpha + beta R(u) + beta grad R(u) . (s + A u)

so that the normal matrix is formed and factored once a point; each iteration resamples T and solves. The warp becomes
W <- W (1 + A)^-1, p <- p - W s. At convergence s = A = 0, and alpha, beta are the radiometric unknowns.

The columns are 1, R, Rx, Ry, Rx u, Rx v, Ry u, Ry v: every sum of least squares is a sum of products of 1, R, Rx, Ry
and T, weighted by w, w u, w v, w uu, w uv, w vv, which are tabled. The columns themselves are never formed.

The first iterations see every second pixel of every second row, bilinearly; only the last ones see all pixels,
bicubically. The former end within a few hundredths of a pixel, whence one of the latter mostly suffices.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel, summing_kernel

UNKNOWNS = 8
SHIFT_UNKNOWNS = 4
LANES = 16
"""Rows of a grid are padded, with weight zero, to a multiple of this: the width of the widest vector registers."""
_COARSE_STEP_PX = 0.2
"""The coarse iterations end with a step below this, which the first fine one must confirm."""
_MOST_EDGE_SHIFT_PX = 0.5
"""Largest deformation of a last step, at the middles of the window's sides."""
_SPARE_PX = 1.5
"""How far the window may move before another part of the picture is copied."""

OK, LEFT_IMAGE, DIVERGED, LOW_TEXTURE, LOW_CORRELATION, AFFINE_TOO_LARGE = 0, 1, 2, 3, 4, 5

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]


class Grid(NamedTuple):
    """Pixels of the window that take part, row by row, with the sums of least squares over them."""

    tables: Floats
    """(8, rows * stride): w, w u, w v, w uu, w uv, w vv, u, v with offsets u, v in half windows; padding has w = 0."""
    design: Floats
    """(3, rows * stride): the reference's grey value minus its mean, its derivatives along columns and rows."""
    patch: Floats
    """(rows * stride,) of the target, and some room."""
    normal: Doubles
    """(8, 8)."""
    root: Doubles
    """(8, 8) inverse of the lower Cholesky factor of the normal matrix."""


class Workspace(NamedTuple):
    """Arrays that one thread reuses for all of its points."""

    buffer: Floats
    """Part of a picture as floats; only its first rows and columns may be in use."""
    frame: NDArray[np.int64]
    """Left column, top row, columns and rows of that part, -1 if it is turned upside down or 1, first row of lines."""
    lines: Floats
    """Rows about the window, interpolated along the rows only."""
    slopes: Floats
    """Their derivatives along the rows."""
    fine: Grid
    coarse: Grid
    unit: Doubles
    """(2, 2) warp that changes nothing."""
    right: Doubles
    solution: Doubles
    lower: Doubles
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


def padded(size: int) -> int:
    """Size rounded up to whole vectors."""
    return -(-size // LANES) * LANES


def grid_tables(size: int, weight_sigma: float, step: int) -> Floats:
    """Tables of a Grid of every step-th pixel of a window; Gaussian weights of weight_sigma half windows."""
    half = size // 2
    v = np.arange(-half, half + 1, step) / half
    u = np.zeros(padded(len(v)))
    u[: len(v)] = v
    inside = np.arange(len(u)) < len(v)
    along, down = np.meshgrid(u, v)
    w = np.exp(-0.5 * (along**2 + down**2) / weight_sigma**2) * inside
    tables = [w, w * along, w * down, w * along**2, w * along * down, w * down**2, along, down]
    return np.stack([table.ravel() for table in tables]).astype(np.float32)


def workspace(size: int, buffer_side: int, fine: Floats, coarse: Floats) -> Workspace:
    """Arrays for windows of size x size and parts of pictures of up to buffer_side x buffer_side."""
    side = max(buffer_side, padded(size) + 24)
    return Workspace(
        buffer=np.zeros((side, side), np.float32),
        frame=np.zeros(6, np.int64),
        lines=np.zeros((side + 8, padded(size)), np.float32),
        slopes=np.zeros((size + 5, padded(size)), np.float32),
        fine=_grid(fine),
        coarse=_grid(coarse),
        unit=np.eye(2),
        right=np.zeros(UNKNOWNS),
        solution=np.zeros(UNKNOWNS),
        lower=np.zeros((UNKNOWNS, UNKNOWNS)),
        rows_of_inverse=np.zeros((2, UNKNOWNS)),
    )


def _grid(tables: Floats) -> Grid:
    pixels = tables.shape[1]
    return Grid(
        tables=tables,
        design=np.zeros((3, pixels), np.float32),
        patch=np.zeros(pixels + LANES, np.float32),
        normal=np.zeros((UNKNOWNS, UNKNOWNS)),
        root=np.zeros((UNKNOWNS, UNKNOWNS)),
    )


@kernel
def reach_of_window(warp: Doubles, size: int, axis: int) -> float:
    """Half extent of a warped window along an axis of the picture, with the margin of the interpolation."""
    return float((abs(warp[axis, 0]) + abs(warp[axis, 1])) * (size // 2) + 3.0)


@kernel
def _take_part(image: Bytes, centre: Doubles, reach_x: float, reach_y: float, sign: int, work: Workspace) -> bool:
    """Copy the part of the image within reach of a centre, turned by half a turn if sign is -1.

    False if the centre is outside or the buffer too small.
    """
    rows, columns = image.shape
    if not (0.0 <= centre[0] < columns and 0.0 <= centre[1] < rows):
        return False
    left, right = max(0, int(centre[0] - reach_x)), min(columns, int(centre[0] + reach_x) + 2)
    top, bottom = max(0, int(centre[1] - reach_y)), min(rows, int(centre[1] + reach_y) + 2)
    right = min(columns, left + -(-(right - left) // LANES) * LANES)
    if right - left > work.buffer.shape[1] or bottom - top > work.buffer.shape[0]:
        return False
    frame = work.frame
    frame[0], frame[1], frame[2], frame[3], frame[4] = left, top, right - left, bottom - top, sign
    if sign > 0:
        for row in range(bottom - top):
            line, source = work.buffer[row, : right - left], image[top + row, left:right]
            for column in range(right - left):
                line[column] = np.float32(source[column])
    else:
        for row in range(bottom - top):
            line, source = work.buffer[row, : right - left], image[bottom - 1 - row, left:right]
            for column in range(right - left):
                line[right - left - 1 - column] = np.float32(source[column])
    return True


@kernel
def _inside(position: Doubles, warp: Doubles, size: int, frame: NDArray[np.int64]) -> bool:
    """True if the warped window lies in a part of the picture (left, top, columns, rows)."""
    x, y = position[0] - frame[0], position[1] - frame[1]
    reach_x, reach_y = reach_of_window(warp, size, 0), reach_of_window(warp, size, 1)
    return bool(reach_x <= x <= frame[2] - 1 - reach_x and reach_y <= y <= frame[3] - 1 - reach_y)


@kernel
def _cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Weights of Catmull and Rom for the four neighbours of a fraction of a pixel."""
    return (
        ((2.0 - t) * t - 1.0) * t * 0.5,
        ((3.0 * t - 5.0) * t * t + 2.0) * 0.5,
        ((4.0 - 3.0 * t) * t + 1.0) * t * 0.5,
        (t - 1.0) * t * t * 0.5,
    )


@kernel
def _in_part(
    frame: NDArray[np.int64], centre: Doubles, warp: Doubles
) -> tuple[float, float, float, float, float, float]:
    """Column and row of a centre in the copied part, and the warp's elements there."""
    x, y = centre[0] - frame[0], centre[1] - frame[1]
    if frame[4] < 0:
        x, y = frame[2] - 1 - x, frame[3] - 1 - y
    return x, y, frame[4] * warp[0, 0], frame[4] * warp[0, 1], frame[4] * warp[1, 0], frame[4] * warp[1, 1]


@kernel
def _resample(work: Workspace, centre: Doubles, warp: Doubles, size: int) -> None:
    """Bicubic (Catmull-Rom) grey values at centre + warp @ (offset from the window's middle)."""
    x, y, a, b, c, d = _in_part(work.frame, centre, warp)
    # so that fractions of a pixel stay between -1 and 2 over the lanes of a vector
    if d > 0.5 and abs(b) < 0.25 * d and abs(a - b * c / d - 1.0) < 2.0 / LANES and abs(c) < 4.0 / LANES:
        _resample_along_rows(work, (x, y), (a, b, c, d), size)
        _resample_along_columns(work, y, (c, d), size)
    else:
        _resample_pixels(work, (x, y), (a, b, c, d), size)


@summing_kernel
def _interpolate(source: Floats, begin: int, tap: int, fraction: float, step: float, line: Floats, at: int) -> None:
    """Cubic interpolation of a vector of pixels whose fraction of a pixel grows by step from each to the next.

    The fraction may run from -1 to 2, for which six taps serve, begin + lane + k tap, instead of four. So all lanes
    do the same, and there are no branches.
    """
    first, step_of_tap, out = np.uint64(begin), np.uint64(tap), np.uint64(at)
    start, growth = np.float32(fraction), np.float32(step)
    zero, half, one, two = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three, four, five = np.float32(3.0), np.float32(4.0), np.float32(5.0)
    for lane in range(LANES):
        here = first + np.uint64(lane)
        s0 = source[here]
        here += step_of_tap
        s1 = source[here]
        here += step_of_tap
        s2 = source[here]
        here += step_of_tap
        s3 = source[here]
        here += step_of_tap
        s4 = source[here]
        here += step_of_tap
        s5 = source[here]
        t = start + growth * np.float32(lane)
        low, high = t < zero, t >= one
        a = s0 if low else (s2 if high else s1)
        b = s1 if low else (s3 if high else s2)
        c = s2 if low else (s4 if high else s3)
        d = s3 if low else (s5 if high else s4)
        f = t + one if low else (t - one if high else t)
        bent = two * a - five * b + four * c - d + f * (three * (b - c) + d - a)
        line[out + np.uint64(lane)] = b + half * f * (c - a + f * bent)


@kernel
def _resample_along_rows(
    work: Workspace, centre: tuple[float, float], warp: tuple[float, float, float, float], size: int
) -> None:
    """First of two passes: each row of the part at the columns where the window's columns cross it."""
    (x, y), (a, b, c, d) = centre, warp
    half, flat, side = size // 2, work.buffer.ravel(), work.buffer.shape[1]
    lines, width = work.lines.ravel(), work.lines.shape[1]
    reach = (abs(c) + d) * half
    top, bottom = max(0, int(y - reach) - 2), min(work.frame[3], int(y + reach) + 5)
    slant, scale = b / d, a - b * c / d
    middle = LANES // 2
    work.frame[5] = top
    for row in range(top, bottom):
        for block in range(0, width, LANES):
            at = x + slant * (row - y) + scale * (block + middle - half)
            whole = int(np.floor(at))
            begin = max(0, row * side + whole - middle - 2)
            first = at - whole - (scale - 1.0) * middle
            _interpolate(flat, begin, 1, first, scale - 1.0, lines, (row - top) * width + block)


@kernel
def _resample_along_columns(work: Workspace, y: float, warp: tuple[float, float], size: int) -> None:
    """Second pass: each column of the result of the first at the rows where the window's rows cross it."""
    c, d = warp
    half, lines, width, patch = size // 2, work.lines.ravel(), work.lines.shape[1], work.fine.patch
    # of wide vectors whose fractions would leave -1 to 2 the latter halves are done again by the next ones
    lanes = LANES if abs(c) < 2.0 / LANES else LANES // 2
    middle = lanes // 2
    for row in range(size):
        for block in range(0, width, lanes):
            at = y - work.frame[5] + d * (row - half) + c * (block + middle - half)
            whole = int(np.floor(at))
            begin = max(0, (whole - 2) * width + block)
            _interpolate(lines, begin, width, at - whole - c * middle, c, patch, row * width + block)


@kernel
def _resample_pixels(
    work: Workspace, centre: tuple[float, float], warp: tuple[float, float, float, float], size: int
) -> None:
    """The same for any warp, pixel by pixel: four times as slow."""
    half, flat, columns, patch = size // 2, work.buffer.ravel(), work.buffer.shape[1], work.fine.patch
    down, one, two, three = np.uint64(columns), np.uint64(1), np.uint64(2), np.uint64(3)
    width = work.lines.shape[1]
    for row in range(size):
        for column in range(size):
            x = centre[0] + warp[0] * (column - half) + warp[1] * (row - half)
            y = centre[1] + warp[2] * (column - half) + warp[3] * (row - half)
            left, top = int(x), int(y)
            h0, h1, h2, h3 = _cubic_weights(x - left)
            total, at = 0.0, np.uint64((top - 1) * columns + left - 1)
            for weight in _cubic_weights(y - top):
                total += weight * (h0 * flat[at] + h1 * flat[at + one] + h2 * flat[at + two] + h3 * flat[at + three])
                at += down
            patch[row * width + column] = total


@summing_kernel
def _differentiate_along_rows(work: Workspace, centre: Doubles, size: int) -> None:
    """Rows about the reference window at its columns: grey values, and half their differences two pixels apart."""
    x, y = centre[0] - work.frame[0], centre[1] - work.frame[1]
    w0, w1, w2, w3 = _cubic_weights(x - int(x))
    h0, h1, h2, h3 = np.float32(w0), np.float32(w1), np.float32(w2), np.float32(w3)
    d0, d1 = np.float32((w0 - w2) * 0.5), np.float32((w1 - w3) * 0.5)
    a, b, c, d = np.float32(w0 * 0.5), np.float32(w1 * 0.5), np.float32(w2 * 0.5), np.float32(w3 * 0.5)
    left, top, width = int(x) - size // 2 - 2, int(y) - size // 2 - 2, work.lines.shape[1]
    for row in range(size + 5):
        source = work.buffer[top + row, left : left + width + 5]
        line, slope = work.lines[row], work.slopes[row]
        for column in range(width):
            s1, s2, s3, s4 = source[column + 1], source[column + 2], source[column + 3], source[column + 4]
            line[column] = h0 * s1 + h1 * s2 + h2 * s3 + h3 * s4
            inner = d0 * s2 + d1 * s3 - b * s1 + c * s4
            slope[column] = inner - a * source[column] + d * source[column + 5]


@summing_kernel
def _differentiate_along_columns(work: Workspace, centre: Doubles, size: int) -> None:
    """Grey values, less that in the middle, and derivatives of the reference window from its rows."""
    y = centre[1] - work.frame[1]
    w0, w1, w2, w3 = _cubic_weights(y - int(y))
    v0, v1, v2, v3 = np.float32(w0), np.float32(w1), np.float32(w2), np.float32(w3)
    d0, d1 = np.float32((w0 - w2) * 0.5), np.float32((w1 - w3) * 0.5)
    a, b, c, d = np.float32(w0 * 0.5), np.float32(w1 * 0.5), np.float32(w2 * 0.5), np.float32(w3 * 0.5)
    lines, slopes, design, width = work.lines, work.slopes, work.fine.design, work.lines.shape[1]
    level = lines[size // 2 + 2, size // 2]
    for row in range(size):
        l0, l1, l2, l3 = lines[row], lines[row + 1], lines[row + 2], lines[row + 3]
        l4, l5 = lines[row + 4], lines[row + 5]
        s1, s2, s3, s4 = slopes[row + 1], slopes[row + 2], slopes[row + 3], slopes[row + 4]
        begin = row * width
        grey, along, down = design[0, begin:], design[1, begin:], design[2, begin:]
        for column in range(width):
            p1, p2, p3, p4 = l1[column], l2[column], l3[column], l4[column]
            grey[column] = v0 * p1 + v1 * p2 + v2 * p3 + v3 * p4 - level
            inner = d0 * p2 + d1 * p3 - b * p1 + c * p4
            down[column] = inner - a * l0[column] + d * l5[column]
            along[column] = v0 * s1[column] + v1 * s2[column] + v2 * s3[column] + v3 * s4[column]


@kernel
def _resample_coarse(work: Workspace, centre: Doubles, warp: Doubles, size: int) -> None:
    """Bilinear grey values of every second pixel of every second row."""
    x, y, a, b, c, d = _in_part(work.frame, centre, warp)
    half, count = size // 2, size // 2 + 1
    flat, columns, patch = work.buffer.ravel(), work.buffer.shape[1], work.coarse.patch
    stride, down, one = work.coarse.design.shape[1] // count, np.uint64(columns), np.uint64(1)
    unit, step_x, step_y = np.float32(1.0 / 65536.0), int(np.round(a * 131072.0)), int(np.round(c * 131072.0))
    for row in range(count):
        at_x = int((x + b * (2 * row - half) - a * half) * 65536.0)
        at_y = int((y + d * (2 * row - half) - c * half) * 65536.0)
        line = patch[row * stride : row * stride + count]
        for column in range(count):
            # unsigned, or every index is tested for being negative
            upper_left = np.uint64((at_y >> 16) * columns + (at_x >> 16))
            lower_left = upper_left + down
            fx, fy = np.float32(at_x & 65535) * unit, np.float32(at_y & 65535) * unit
            upper = flat[upper_left] + fx * (flat[upper_left + one] - flat[upper_left])
            lower = flat[lower_left] + fx * (flat[lower_left + one] - flat[lower_left])
            line[column] = upper + fy * (lower - upper)
            at_x += step_x
            at_y += step_y


@kernel
def _fill_coarse(work: Workspace, size: int) -> None:
    """Copy the design of every second pixel of every second row into the coarse grid."""
    count, stride = size // 2 + 1, work.lines.shape[1]
    coarse_stride = work.coarse.design.shape[1] // count
    for kind in range(3):
        fine, coarse = work.fine.design[kind], work.coarse.design[kind]
        for row in range(count):
            source = fine[2 * row * stride : (2 * row + 1) * stride]
            line = coarse[row * coarse_stride : row * coarse_stride + count]
            for column in range(line.shape[0]):
                line[column] = source[2 * column]


@summing_kernel
def _lower_sums(tables: Floats, design: Floats, normal: Doubles) -> None:
    """The two first rows of the normal matrix: all products with 1 and with the grey value."""
    w, wu, wv = tables[0], tables[1], tables[2]
    grey, along, down = design[0], design[1], design[2]
    zero = np.float32(0.0)
    n00 = n01 = n02 = n03 = n04 = n05 = n06 = n07 = zero
    n11 = n12 = n13 = n14 = n15 = n16 = n17 = zero
    for at in range(w.shape[0]):
        r, x, y = grey[at], along[at], down[at]
        weight, weight_u, weight_v = w[at], wu[at], wv[at]
        n00 += weight
        n01 += weight * r
        n02 += weight * x
        n03 += weight * y
        n04 += weight_u * x
        n05 += weight_v * x
        n06 += weight_u * y
        n07 += weight_v * y
        rx, ry = r * x, r * y
        n11 += weight * r * r
        n12 += weight * rx
        n13 += weight * ry
        n14 += weight_u * rx
        n15 += weight_v * rx
        n16 += weight_u * ry
        n17 += weight_v * ry
    normal[0, 0], normal[1, 0], normal[1, 1] = n00, n01, n11
    normal[2, 0], normal[3, 0], normal[4, 0] = n02, n03, n04
    normal[5, 0], normal[6, 0], normal[7, 0] = n05, n06, n07
    normal[2, 1], normal[3, 1], normal[4, 1] = n12, n13, n14
    normal[5, 1], normal[6, 1], normal[7, 1] = n15, n16, n17


@summing_kernel
def _upper_sums(tables: Floats, design: Floats, normal: Doubles) -> None:
    """The other rows of the normal matrix's lower triangle: products of two derivatives, with all tables."""
    w, wu, wv, wuu, wuv, wvv = tables[0], tables[1], tables[2], tables[3], tables[4], tables[5]
    along, down = design[1], design[2]
    x0 = x1 = x2 = x3 = x4 = x5 = np.float32(0.0)
    y0 = y1 = y2 = y3 = y4 = y5 = np.float32(0.0)
    z0 = z1 = z2 = z3 = z4 = z5 = np.float32(0.0)
    for at in range(w.shape[0]):
        xx, xy, yy = along[at] * along[at], along[at] * down[at], down[at] * down[at]
        weight, weight_u, weight_v = w[at], wu[at], wv[at]
        x0 += weight * xx
        y0 += weight * xy
        z0 += weight * yy
        x1 += weight_u * xx
        y1 += weight_u * xy
        z1 += weight_u * yy
        x2 += weight_v * xx
        y2 += weight_v * xy
        z2 += weight_v * yy
        weight, weight_u, weight_v = wuu[at], wuv[at], wvv[at]
        x3 += weight * xx
        y3 += weight * xy
        z3 += weight * yy
        x4 += weight_u * xx
        y4 += weight_u * xy
        z4 += weight_u * yy
        x5 += weight_v * xx
        y5 += weight_v * xy
        z5 += weight_v * yy
    normal[2, 2], normal[4, 2], normal[5, 2], normal[4, 4], normal[5, 4], normal[5, 5] = x0, x1, x2, x3, x4, x5
    normal[3, 2], normal[4, 3], normal[5, 3], normal[6, 2], normal[7, 2] = y0, y1, y2, y1, y2
    normal[6, 4], normal[6, 5], normal[7, 4], normal[7, 5] = y3, y4, y4, y5
    normal[3, 3], normal[6, 3], normal[7, 3], normal[6, 6], normal[7, 6], normal[7, 7] = z0, z1, z2, z3, z4, z5


@kernel
def _factor(normal: Doubles, lower: Doubles, root: Doubles) -> bool:
    """Lower Cholesky factor of a small matrix, and its inverse; False if the matrix is not positive definite.

    The leading block of the inverse is the inverse of the leading block.
    """
    for i in range(UNKNOWNS):
        total = normal[i, i]
        for k in range(i):
            total -= lower[i, k] * lower[i, k]
        if total <= 1e-6 * normal[i, i] or not total > 0.0:
            return False
        scale = 1.0 / np.sqrt(total)
        for j in range(i + 1, UNKNOWNS):
            element = normal[j, i]
            for k in range(i):
                element -= lower[j, k] * lower[i, k]
            lower[j, i] = element * scale
        for j in range(UNKNOWNS):
            root[i, j] = 0.0
        root[i, i] = scale
        for k in range(i):
            element = -lower[i, k] * scale
            for j in range(UNKNOWNS):
                root[i, j] += element * root[k, j]
    return True


@kernel
def _solve(root: Doubles, right: Doubles, size: int, solution: Doubles) -> None:
    """Solve for the first size unknowns; the others are zero."""
    solution[:] = 0.0
    for i in range(size):
        total = 0.0
        for k in range(i + 1):
            total += root[i, k] * right[k]
        for k in range(UNKNOWNS):
            solution[k] += total * root[i, k]


@summing_kernel
def _right_sides(grid: Grid, right: Doubles) -> None:
    """Sums of the target's grey values times each of the eight weighted columns."""
    tables, design, patch = grid.tables, grid.design, grid.patch
    w, wu, wv = tables[0], tables[1], tables[2]
    grey, along, down = design[0], design[1], design[2]
    zero = np.float32(0.0)
    b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = zero
    for at in range(w.shape[0]):
        t, x, y = patch[at], along[at], down[at]
        weight, weight_u, weight_v = t * w[at], t * wu[at], t * wv[at]
        b0 += weight
        b1 += weight * grey[at]
        b2 += weight * x
        b3 += weight * y
        b4 += weight_u * x
        b5 += weight_v * x
        b6 += weight_u * y
        b7 += weight_v * y
    right[0], right[1], right[2], right[3] = b0, b1, b2, b3
    right[4], right[5], right[6], right[7] = b4, b5, b6, b7


@kernel
def _prepare_reference(reference: Bytes, centre: Doubles, size: int, least_gradient: float, work: Workspace) -> int:
    """Derivatives and factored normal matrices of one reference window; returns the status."""
    reach = reach_of_window(work.unit, size + 2, 0)
    if not _take_part(reference, centre, reach, reach, 1, work):
        return LEFT_IMAGE
    if not _inside(centre, work.unit, size + 2, work.frame):
        return LEFT_IMAGE
    _differentiate_along_rows(work, centre, size)
    _differentiate_along_columns(work, centre, size)
    _fill_coarse(work, size)
    for grid in (work.fine, work.coarse):
        _lower_sums(grid.tables, grid.design, grid.normal)
        _upper_sums(grid.tables, grid.design, grid.normal)
    if not _weakest(work.fine.normal) > least_gradient**2 or not _factor(work.fine.normal, work.lower, work.fine.root):
        return LOW_TEXTURE
    return OK if _factor(work.coarse.normal, work.lower, work.coarse.root) else LOW_TEXTURE


@kernel
def _weakest(normal: Doubles) -> float:
    """Mean square gradient in the direction where it is least."""
    xx, xy, yy = normal[2, 2] / normal[0, 0], normal[3, 2] / normal[0, 0], normal[3, 3] / normal[0, 0]
    return float(0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy))


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
def _edge_shift(solution: Doubles) -> float:
    """Largest change that a step's deformation makes at the middles of the window's sides, pixels of the reference."""
    largest = max(abs(solution[4]), abs(solution[5]), abs(solution[6]), abs(solution[7]))
    return float(largest / abs(solution[1]))


@summing_kernel
def _final_sums(
    grid: Grid, solution: Doubles, mean: float, first: Doubles, second: Doubles
) -> tuple[float, float, float, float, float, float]:
    """Sums over the window: w v^2 of the residuals v; w (T - mean)^2; w (T - mean) R; w^2 p p, p q, q q.

    p and q are rows of the inverse of the normal matrix times the columns: how a pixel's noise moves the position.
    """
    w, u, v = grid.tables[0], grid.tables[6], grid.tables[7]
    grey, along, down, patch = grid.design[0], grid.design[1], grid.design[2], grid.patch
    zero, level = np.float32(0.0), np.float32(mean)
    s0, s1, s2, s3 = np.float32(solution[0]), np.float32(solution[1]), np.float32(solution[2]), np.float32(solution[3])
    s4, s5, s6, s7 = np.float32(solution[4]), np.float32(solution[5]), np.float32(solution[6]), np.float32(solution[7])
    p0, p1, p2, p3 = np.float32(first[0]), np.float32(first[1]), np.float32(first[2]), np.float32(first[3])
    p4, p5, p6, p7 = np.float32(first[4]), np.float32(first[5]), np.float32(first[6]), np.float32(first[7])
    q0, q1, q2, q3 = np.float32(second[0]), np.float32(second[1]), np.float32(second[2]), np.float32(second[3])
    q4, q5, q6, q7 = np.float32(second[4]), np.float32(second[5]), np.float32(second[6]), np.float32(second[7])
    vv, tt, tr, pp, pq, qq = zero, zero, zero, zero, zero, zero
    for at in range(w.shape[0]):
        r, x, y, weight, a, b = grey[at], along[at], down[at], w[at], u[at], v[at]
        t = patch[at] - level
        residual = patch[at] - s0 - s1 * r - x * (s2 + s4 * a + s5 * b) - y * (s3 + s6 * a + s7 * b)
        p = weight * (p0 + p1 * r + x * (p2 + p4 * a + p5 * b) + y * (p3 + p6 * a + p7 * b))
        q = weight * (q0 + q1 * r + x * (q2 + q4 * a + q5 * b) + y * (q3 + q6 * a + q7 * b))
        vv += weight * residual * residual
        tt += weight * t * t
        tr += weight * t * r
        pp += p * p
        pq += p * q
        qq += q * q
    return float(vv), float(tt), float(tr), float(pp), float(pq), float(qq)


@kernel
def _judge(warp: Doubles, size: int, work: Workspace, result: Doubles) -> None:
    """Gain, offset, noise, weighted correlation and covariance of the position, from the last resampling.

    Covariance: sigma^2 / beta^2 N^-1 A'W^2 A N^-1, its shift block turned into the target.
    """
    grid, solution, total = work.fine, work.solution, work.fine.normal[0, 0]
    for i in range(2):
        work.rows_of_inverse[i, :] = 0.0
        for k in range(2 + i, UNKNOWNS):
            for j in range(UNKNOWNS):
                work.rows_of_inverse[i, j] += grid.root[k, 2 + i] * grid.root[k, j]
    vv, tt, tr, xx, xy, yy = _final_sums(
        grid, solution, work.right[0] / total, work.rows_of_inverse[0], work.rows_of_inverse[1]
    )
    mean = grid.normal[1, 0] / total
    rr = grid.normal[1, 1] - total * mean * mean
    pixels = size * size
    result[0], result[1] = solution[1], solution[0] + solution[1] * mean
    result[2] = np.sqrt(vv / total * pixels / (pixels - UNKNOWNS))
    result[3] = tr / np.sqrt(max(tt * rr, 1e-12))
    factor = (result[2] / solution[1]) ** 2
    a, b, c, d = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    result[4] = factor * (a * a * xx + 2 * a * b * xy + b * b * yy)
    result[5] = factor * (a * c * xx + (a * d + b * c) * xy + b * d * yy)
    result[6] = factor * (c * c * xx + 2 * c * d * xy + d * d * yy)


@kernel
def _rate(normal: Doubles, result: Doubles) -> float:
    """How much of an error of position an iteration leaves.

    Noise of the reference makes its gradients look larger than they are, so that steps are too short: by the share
    of noise in their mean square. Half of the residuals' variance is of the reference, half of that in its differences.
    """
    share = (result[2] / result[0]) ** 2 / (4.0 * _weakest(normal))
    return float(min(max(share, 0.02), 0.5))


@kernel
def _cover(target: Bytes, position: Doubles, warp: Doubles, size: int, work: Workspace) -> bool:
    """See to it that the copied part has the warped window; False if the picture has not."""
    if _inside(position, warp, size, work.frame):
        return True
    sign = -1 if warp[1, 1] < 0.0 else 1
    reach_x, reach_y = reach_of_window(warp, size, 0) + _SPARE_PX, reach_of_window(warp, size, 1) + _SPARE_PX
    return _take_part(target, position, reach_x, reach_y, sign, work) and _inside(position, warp, size, work.frame)


@kernel
def _iterate(
    target: Bytes, position: Doubles, warp: Doubles, size: int, criteria: Criteria, work: Workspace, result: Doubles
) -> tuple[int, int]:
    """Move and deform the window until it fits, and judge it; returns the status and the number of iterations."""
    x, y, fine = position[0], position[1], False
    work.frame[2] = 0
    for iteration in range(criteria.most_iterations):
        if not _cover(target, position, warp, size, work):
            return LEFT_IMAGE, iteration
        unknowns = SHIFT_UNKNOWNS if iteration < criteria.shift_iterations else UNKNOWNS
        if fine:
            _resample(work, position, warp, size)
            _right_sides(work.fine, work.right)
            _solve(work.fine.root, work.right, unknowns, work.solution)
        else:
            _resample_coarse(work, position, warp, size)
            _right_sides(work.coarse, work.right)
            _solve(work.coarse.root, work.right, unknowns, work.solution)
        moved = _update(work.solution, float(size // 2), position, warp)
        if not moved < np.inf or np.hypot(position[0] - x, position[1] - y) > criteria.most_drift_px:
            return DIVERGED, iteration + 1
        settled = unknowns == UNKNOWNS and _edge_shift(work.solution) < _MOST_EDGE_SHIFT_PX
        if fine and settled and moved < _COARSE_STEP_PX:
            _judge(warp, size, work, result)
            if moved * _rate(work.fine.normal, result) < criteria.convergence_px:
                return OK, iteration + 1
        fine = fine or (settled and moved < _COARSE_STEP_PX)
    return DIVERGED, criteria.most_iterations


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
    reference: Bytes,
    target: Bytes,
    reference_px: Doubles,
    size: int,
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
        code = _prepare_reference(reference, reference_px[point], size, criteria.least_gradient, work)
        if code == OK:
            start[:] = warps[point]
            code, done = _iterate(target, positions[point], warps[point], size, criteria, work, result)
            result[7] = done
        if code == OK:
            if not result[3] >= criteria.least_correlation:
                code = LOW_CORRELATION
            elif _change(warps[point], start) > criteria.most_affine_change:
                code = AFFINE_TOO_LARGE
        status[point] = code
