"""Matching of orientation codes and warping of grey-value patches: inner loops.

Codes are packed into bytes: code * (256 / N), so that the circular difference is the plain difference of signed bytes,
which wraps by itself; an uncoded pixel is 1 (no packed code is odd). Templates lie side by side in a strip, each in a
multiple of PATCH_STRIDE columns: they are coded in long rows, and a row of one is a vector register or two.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.coding import code_picture
from uavkit.process.kernels.jit import kernel

PATCH_STRIDE = 32
UNCODED = 1


@kernel
def warp_patch(
    image: NDArray[np.uint8],
    centre: NDArray[np.float64],
    source_from_patch: NDArray[np.float64],
    shift: NDArray[np.float64],
    strip: NDArray[np.uint8],
    begin: int,
) -> bool:
    """Bilinear grey values of a patch (m, m): pixel p comes from centre + source_from_patch (p - m // 2 - shift).

    The patch lies in strip (m, ...) from column begin on. Returns False where it would reach beyond the image.
    """
    rows, columns = image.shape
    size = strip.shape[0]
    half = size // 2
    a, b = source_from_patch[0, 0], source_from_patch[0, 1]
    c, d = source_from_patch[1, 0], source_from_patch[1, 1]
    reach = half + 1.0
    reach_x = (abs(a) + abs(b)) * reach + 1.0
    reach_y = (abs(c) + abs(d)) * reach + 1.0
    if not (reach_x <= centre[0] < columns - 1 - reach_x and reach_y <= centre[1] < rows - 1 - reach_y):
        return False
    flat = image.ravel()
    stride, right = np.uint64(columns), np.uint64(1)
    one = 65536.0
    ax, cy = np.int64(np.round(a * one)), np.int64(np.round(c * one))
    for row in range(size):
        x = row - half - shift[1]
        start = -half - shift[0]
        u = np.int64(np.floor((centre[0] + a * start + b * x) * one + 0.5))
        v = np.int64(np.floor((centre[1] + c * start + d * x) * one + 0.5))
        line = strip[row, begin : begin + size]
        for column in range(size):
            # unsigned, or every index is tested for being negative
            at = np.uint64((v >> 16) * columns + (u >> 16))
            below = at + stride
            fu, fv = np.int32((u >> 8) & 255), np.int32((v >> 8) & 255)
            upper = (np.int32(flat[at]) << 8) + fu * (np.int32(flat[at + right]) - np.int32(flat[at]))
            lower = (np.int32(flat[below]) << 8) + fu * (np.int32(flat[below + right]) - np.int32(flat[below]))
            line[column] = np.uint8(((upper << 8) + fv * (lower - upper) + 32768) >> 16)
            u += ax
            v += cy
    return True


@kernel
def _dissimilarity(
    template: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    search: NDArray[np.uint8],
    top: int,
    left: int,
    uncoded: NDArray[np.uint8],
    sums: NDArray[np.uint16],
) -> int:
    """Sum of packed differences of one placement; uncoded = (difference if one, if both are uncoded)."""
    width = template.shape[1]
    for column in range(width):
        sums[column] = 0
    one, both = uncoded[0], uncoded[1]
    for row in range(template.shape[0]):
        t = template[row]
        s = search[top + row, left : left + width]
        for column in range(width):
            a, b = t[column], s[column]
            difference = np.int8(a - b)
            size = np.uint8(abs(difference))
            either = np.uint8((a | b) & np.uint8(1))
            all_two = np.uint8(a & b & np.uint8(1))
            size = one if either else size
            size = both if all_two else size
            sums[column] += np.uint16(size & mask[column])
    total = 0
    for column in range(width):
        total += sums[column]
    return total


@kernel
def _search(
    template: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    search: NDArray[np.uint8],
    window: NDArray[np.int64],
    uncoded: NDArray[np.uint8],
    totals: NDArray[np.int64],
) -> None:
    """Fill totals (2 r + 1, 2 r + 1) for placements about the upper left corner; window = (top, left, radius)."""
    radius = window[2]
    sums = np.zeros(template.shape[1], np.uint16)
    for down in range(2 * radius + 1):
        for right in range(2 * radius + 1):
            top, left = window[0] + down - radius, window[1] + right - radius
            totals[down, right] = _dissimilarity(template, mask, search, top, left, uncoded, sums)


@kernel
def equal_slopes(before: float, least: float, after: float) -> float:
    """Minimum of the V with two equal slopes through three neighbouring values; within +-0.5 of the middle."""
    steeper = max(before, after) - least
    if steeper <= 0.0:
        return 0.0
    return 0.5 * (before - after) / steeper


@kernel
def _best_two(totals: NDArray[np.int64], size: int, apart: int, best: NDArray[np.int64]) -> None:
    """best = (row, column, least, least well apart); apart in placements, -1 for the second if there is none."""
    best[2] = np.iinfo(np.int64).max
    for down in range(size):
        for right in range(size):
            if totals[down, right] < best[2]:
                best[0], best[1], best[2] = down, right, totals[down, right]
    best[3] = -1
    for down in range(size):
        for right in range(size):
            away = abs(down - best[0]) > apart or abs(right - best[1]) > apart
            if away and (best[3] < 0 or totals[down, right] < best[3]):
                best[3] = totals[down, right]


@kernel
def match_packed(
    strip: NDArray[np.uint8],
    search: NDArray[np.uint8],
    size: int,
    predicted: NDArray[np.float64],
    radii: NDArray[np.int64],
    uncoded: NDArray[np.uint8],
    apart: int,
    found: NDArray[np.float64],
    scores: NDArray[np.float64],
) -> None:
    """Match the templates of a strip, shifted by the fraction of predicted (n, 2), in packed codes search (h, w).

    found (n, 2) gets the sub-pixel position; scores (n, 3) the mean packed difference of the best placement, of the
    second best well apart (nan without one), and 1 where the best lies on the rim of the search. Nan where the search
    leaves the picture.
    """
    rows, columns = search.shape
    spacing = strip_spacing(size)
    stride = PATCH_STRIDE * ((size + PATCH_STRIDE - 1) // PATCH_STRIDE)
    half = size // 2
    largest = 1
    for point in range(radii.shape[0]):
        largest = max(largest, radii[point])
    totals = np.empty((2 * largest + 1, 2 * largest + 1), np.int64)
    template = np.empty((size, stride), np.uint8)
    mask = np.zeros(stride, np.uint8)
    mask[:size] = 255
    best = np.zeros(4, np.int64)
    window = np.zeros(3, np.int64)
    for point in range(predicted.shape[0]):
        radius = radii[point]
        found[point, :] = np.nan
        scores[point, :] = np.nan
        if radius < 1 or not (np.isfinite(predicted[point, 0]) and np.isfinite(predicted[point, 1])):
            continue
        column = np.int64(np.floor(predicted[point, 0] + 0.5))
        row = np.int64(np.floor(predicted[point, 1] + 0.5))
        window[0], window[1], window[2] = row - half, column - half, radius
        if window[0] < radius or window[1] < radius:
            continue
        if window[0] + radius + size > rows or window[1] + radius + stride > columns:
            continue
        template[:] = strip[1 : size + 1, point * spacing + 1 : point * spacing + 1 + stride]
        _search(template, mask, search, window, uncoded, totals)
        _best_two(totals, 2 * radius + 1, apart, best)
        down, right = best[0], best[1]
        on_rim = down == 0 or right == 0 or down == 2 * radius or right == 2 * radius
        dx = dy = 0.0
        if not on_rim:
            dx = equal_slopes(totals[down, right - 1], totals[down, right], totals[down, right + 1])
            dy = equal_slopes(totals[down - 1, right], totals[down, right], totals[down + 1, right])
        found[point, 0] = predicted[point, 0] + right - radius + dx
        found[point, 1] = predicted[point, 1] + down - radius + dy
        scores[point, 0] = best[2] / (size * size)
        scores[point, 1] = best[3] / (size * size) if best[3] >= 0 else np.nan
        scores[point, 2] = 1.0 if on_rim else 0.0


@kernel
def strip_spacing(size: int) -> int:
    """Columns of a strip from one template to the next: the window and a pixel on either side, in whole registers."""
    return PATCH_STRIDE * ((size + 2 + PATCH_STRIDE - 1) // PATCH_STRIDE)


@kernel
def code_templates(
    image: NDArray[np.uint8],
    centres: NDArray[np.float64],
    source_from_patch: NDArray[np.float64],
    predicted: NDArray[np.float64],
    threshold: int,
    tangents: NDArray[np.int16],
    grey: NDArray[np.uint8],
    strip: NDArray[np.uint8],
    coded_share: NDArray[np.float64],
) -> None:
    """Warp a grey patch for each point, side by side into grey (m + 2, ...), and code them all at once into strip.

    The window of point i is rows 1 to m and m columns from i * strip_spacing(m) + 1 on. coded_share (n,) is -1 where
    the patch would reach beyond its picture.
    """
    size = grey.shape[0] - 2
    spacing = strip_spacing(size)
    shift = np.zeros(2)
    for point in range(centres.shape[0]):
        coded_share[point] = -1.0
        if not (np.isfinite(predicted[point, 0]) and np.isfinite(predicted[point, 1])):
            continue
        shift[0] = predicted[point, 0] - np.floor(predicted[point, 0] + 0.5)
        shift[1] = predicted[point, 1] - np.floor(predicted[point, 1] + 0.5)
        if warp_patch(image, centres[point], source_from_patch[point], shift, grey, point * spacing):
            coded_share[point] = 0.0
    code_picture(grey, threshold, tangents, 256 // (4 * (tangents.shape[0] + 1)), UNCODED, strip)
    for point in range(centres.shape[0]):
        if coded_share[point] < 0.0:
            continue
        begin = point * spacing + 1
        coded = 0
        for row in range(1, size + 1):
            line = strip[row, begin : begin + size]
            for column in range(size):
                coded += 1 if line[column] != UNCODED else 0
        coded_share[point] = coded / (size * size)
