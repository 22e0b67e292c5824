"""Matching of orientation codes and warping of grey-value patches: inner loops.

Codes are packed into bytes: code * (256 / N), so that the circular difference is the plain difference of signed bytes,
which wraps by itself; an uncoded pixel is 1 (no packed code is odd). For a search, template and search window are
copied into rows of LANES bytes each: a row is a vector register, and the sums of all columns stay in bytes, as no
column of MOST_WINDOW codes sums up to more than 255.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.coding import code_picture
from uavkit.process.kernels.jit import kernel

LANES = 32
MOST_WINDOW = 31
"""Side of the largest template."""
UNCODED = 1
_ROWS_AT_ONCE = 7
"""Rows of a template added up between two stores: the usual 21 is a multiple."""
_APART = 2
"""Placements beyond which another minimum counts as the second best."""
_QUARTER = 4
"""Cost of an uncoded pixel: a quarter of the circle of 16 codes."""


@kernel
def _sources(line: NDArray[np.int32], columns: int, fours: NDArray[np.uint32]) -> None:
    """Index of the upper left one of the four pixels about each place on a line = (u, v, du, dv) in 1/65536 px."""
    width = np.int32(columns)
    u0, v0, du, dv = line[0], line[1], line[2], line[3]
    for column in range(fours.shape[0]):
        u = np.int32(u0 + np.int32(np.int32(column) * du))
        v = np.int32(v0 + np.int32(np.int32(column) * dv))
        fours[column] = np.uint32(np.int32(np.int32(v >> 16) * width) + np.int32(u >> 16))


@kernel
def _bilinear(
    line: NDArray[np.int32], fours: NDArray[np.uint32], strip: NDArray[np.uint8], row: int, begin: int
) -> None:
    """Grey values between four pixels (a byte each: left, right, lower left, lower right), both rows in one product."""
    u0, v0, du, dv = line[0], line[1], line[2], line[3]
    even, whole = np.uint32(0xFF00FF), np.uint32(256)
    first = np.uint64(begin)
    for column in range(fours.shape[0]):
        u = np.int32(u0 + np.int32(np.int32(column) * du))
        v = np.int32(v0 + np.int32(np.int32(column) * dv))
        fu = np.uint32(np.uint32(u >> 8) & np.uint32(255))
        fv = np.uint32(np.uint32(v >> 8) & np.uint32(255))
        left = np.uint32(fours[column] & even)
        right = np.uint32(np.uint32(fours[column] >> np.uint32(8)) & even)
        both = np.uint32(np.uint32(left * np.uint32(whole - fu)) + np.uint32(right * fu))
        upper = np.uint32(np.uint32(both & np.uint32(0xFFFF)) * np.uint32(whole - fv))
        lower = np.uint32(np.uint32(both >> np.uint32(16)) * fv)
        grey = np.uint32(np.uint32(upper + lower) + np.uint32(32768)) >> np.uint32(16)
        strip[np.uint64(row), first + np.uint64(column)] = np.uint8(grey)


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

    The patch lies in strip (m, ...) from column begin on. Returns False where it would reach beyond the image. Places,
    the four pixels about each, and grey values are three loops: the first and the last are vector instructions.
    """
    rows, columns = image.shape
    size = strip.shape[0]
    half = size // 2
    a, b = source_from_patch[0, 0], source_from_patch[0, 1]
    c, d = source_from_patch[1, 0], source_from_patch[1, 1]
    reach_x = (abs(a) + abs(b)) * (half + 1.0) + 1.0
    reach_y = (abs(c) + abs(d)) * (half + 1.0) + 1.0
    if not (reach_x <= centre[0] < columns - 1 - reach_x and reach_y <= centre[1] < rows - 1 - reach_y):
        return False
    flat = image.ravel()
    right, down = np.uint64(1), np.uint64(columns)  # unsigned, or every index is tested for being negative
    one = 65536.0
    line, fours = np.empty(4, np.int32), np.empty(size, np.uint32)
    line[2], line[3] = np.int32(np.round(a * one)), np.int32(np.round(c * one))
    for row in range(size):
        x, y = -half - shift[0], row - half - shift[1]
        line[0] = np.int32(np.floor((centre[0] + a * x + b * y) * one + 0.5))
        line[1] = np.int32(np.floor((centre[1] + c * x + d * y) * one + 0.5))
        _sources(line, columns, fours)
        for column in range(size):
            i = np.uint64(fours[column])
            upper = np.uint32(flat[i]) | (np.uint32(flat[i + right]) << np.uint32(8))
            lower = np.uint32(flat[i + down]) | (np.uint32(flat[i + down + right]) << np.uint32(8))
            fours[column] = np.uint32(upper | np.uint32(lower << np.uint32(16)))
        _bilinear(line, fours, strip, row, begin)
    return True


@kernel
def _copy_rows(
    codes: NDArray[np.uint8], place: tuple[int, int, int], limit: NDArray[np.uint8], copies: NDArray[np.uint8]
) -> None:
    """Copy packed codes into rows of LANES bytes, copies (2, rows * LANES): codes, and limit (LANES,) where coded.

    place = (top, left, rows). Columns beyond the picture stay as they are: templates have no pixel there.
    """
    top, left, rows = place
    width = min(LANES, codes.shape[1] - left)
    for row in range(rows):
        down, at = np.uint64(top + row), np.uint64(row * LANES)
        for column in range(width):
            copies[0, at + np.uint64(column)] = codes[down, np.uint64(left) + np.uint64(column)]
        for column in range(width):
            code = codes[down, np.uint64(left) + np.uint64(column)]
            copies[1, at + np.uint64(column)] = np.uint8(0) if code == UNCODED else limit[column]


@kernel
def _cost(template: NDArray[np.uint8], copies: NDArray[np.uint8], i: np.uint64, j: np.uint64) -> np.uint8:
    """Difference in codes of one pixel of the template, 0 where that is uncoded."""
    apart = np.uint8(np.uint8(abs(np.int8(template[0, i] - copies[0, j]))) >> np.uint8(4))
    coded = copies[1, j]
    cost = np.uint8(np.uint8(apart & coded) | np.uint8(np.uint8(~coded) & np.uint8(_QUARTER)))
    return np.uint8(cost & template[1, i])


@kernel
def _placement(template: NDArray[np.uint8], copies: NDArray[np.uint8], offset: int, sums: NDArray[np.uint8]) -> None:
    """Sum the differences of each column where the template's coded pixels lie offset bytes into the copied window."""
    for top in range(0, template.shape[1], _ROWS_AT_ONCE * LANES):
        first, other = np.uint64(top), np.uint64(top + offset)
        for column in range(LANES):
            i, j = first + np.uint64(column), other + np.uint64(column)
            total = sums[column] if top > 0 else np.uint8(0)
            for row in range(_ROWS_AT_ONCE):
                down = np.uint64(row * LANES)
                total = np.uint8(total + _cost(template, copies, i + down, j + down))
            sums[column] = total


@kernel
def _sum_of_bytes(words: NDArray[np.uint64]) -> np.int64:
    """Sum of the bytes of a few words: of every other byte in fields of 16 bits, and those by one product."""
    every_other = np.uint64(0x00FF00FF00FF00FF)
    fields = np.uint64(0)
    for word in words:
        fields += np.uint64(word & every_other) + np.uint64(np.uint64(word >> np.uint64(8)) & every_other)
    return np.int64(np.uint64(fields * np.uint64(0x0001000100010001)) >> np.uint64(48))


@kernel
def _both_uncoded(template: NDArray[np.uint8], copies: NDArray[np.uint8], size: int, offset: int) -> int:
    """Number of pixels that are uncoded in template and search."""
    number = 0
    for row in range(size):
        for column in range(size):
            at = row * LANES + column
            number += 1 if template[1, at] == 0 and copies[1, at + offset] == 0 else 0
    return number


@kernel
def _search(
    template: NDArray[np.uint8],
    uncoded: int,
    search: NDArray[np.uint8],
    window: NDArray[np.int64],
    copies: NDArray[np.uint8],
    totals: NDArray[np.int64],
) -> None:
    """Fill totals (2 r + 1, 2 r + 1) with summed differences; window = (top, left, radius, size, free if both uncoded).

    A copied window holds a few placements side by side; a wide search needs several copies.
    """
    radius, size, free = window[2], window[3], window[4]
    across = 2 * radius + 1
    at_once = LANES + 1 - size
    sums = np.zeros(LANES, np.uint8)
    words = sums.view(np.uint64)
    whole = np.full(LANES, 255, np.uint8)
    for begin in range(0, across, at_once):
        place = window[0] - radius, window[1] - radius + begin, size + 2 * radius
        _copy_rows(search, place, whole, copies)
        for down in range(across):
            for right in range(begin, min(begin + at_once, across)):
                offset = down * LANES + right - begin
                _placement(template, copies, offset, sums)
                total = _sum_of_bytes(words) + _QUARTER * uncoded
                if free:
                    total -= _QUARTER * _both_uncoded(template, copies, size, offset)
                totals[down, right] = total


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
def _match_one(
    template: NDArray[np.uint8],
    uncoded: int,
    search: NDArray[np.uint8],
    window: NDArray[np.int64],
    copies: NDArray[np.uint8],
    totals: NDArray[np.int64],
    result: NDArray[np.float64],
) -> None:
    """Search for one template; result = (x, y from the middle of the search, best, second best, 1 if on the rim)."""
    radius, size = window[2], window[3]
    best = np.zeros(4, np.int64)
    _search(template, uncoded, search, window, copies, totals)
    _best_two(totals, 2 * radius + 1, _APART, best)
    down, right = best[0], best[1]
    on_rim = down == 0 or right == 0 or down == 2 * radius or right == 2 * radius
    dx = dy = 0.0
    if not on_rim:
        dx = equal_slopes(totals[down, right - 1], totals[down, right], totals[down, right + 1])
        dy = equal_slopes(totals[down - 1, right], totals[down, right], totals[down + 1, right])
    result[0] = right - radius + dx
    result[1] = down - radius + dy
    result[2] = best[2] / (size * size)
    result[3] = best[3] / (size * size) if best[3] >= 0 else np.nan
    result[4] = 1.0 if on_rim else 0.0


@kernel
def match_packed(
    strip: NDArray[np.uint8],
    search: NDArray[np.uint8],
    size: int,
    coded_share: NDArray[np.float64],
    predicted: NDArray[np.float64],
    radii: NDArray[np.int64],
    free: int,
    found: NDArray[np.float64],
    scores: NDArray[np.float64],
) -> None:
    """Match the templates of a strip, shifted by the fraction of predicted (n, 2), in packed codes search (h, w).

    free is 1 if pixels uncoded in both cost nothing, 0 if they cost a quarter of the circle as those uncoded in one.
    found (n, 2) gets the sub-pixel position; scores (n, 3) the mean difference in codes of the best placement, of the
    second best well apart (nan without one), and 1 where the best lies on the rim of the search. Nan where the search
    leaves the picture.
    """
    rows, columns = search.shape
    spacing = strip_spacing(size)
    half = size // 2
    padded = _ROWS_AT_ONCE * ((size + _ROWS_AT_ONCE - 1) // _ROWS_AT_ONCE)
    largest = 1
    for point in range(radii.shape[0]):
        largest = max(largest, radii[point])
    totals = np.empty((2 * largest + 1, 2 * largest + 1), np.int64)
    template = np.zeros((2, padded * LANES), np.uint8)
    copies = np.zeros((2, (padded + 2 * largest + 1) * LANES), np.uint8)
    inside = np.zeros(LANES, np.uint8)
    inside[:size] = 255
    window = np.zeros(5, np.int64)
    result = np.zeros(5)
    for point in range(predicted.shape[0]):
        radius = radii[point]
        found[point, :] = np.nan
        scores[point, :] = np.nan
        if radius < 1 or not (np.isfinite(predicted[point, 0]) and np.isfinite(predicted[point, 1])):
            continue
        left = np.int64(np.floor(predicted[point, 0] + 0.5)) - half
        top = np.int64(np.floor(predicted[point, 1] + 0.5)) - half
        if top < radius or left < radius or top + radius + size > rows or left + radius + size > columns:
            continue
        window[0], window[1], window[2], window[3], window[4] = top, left, radius, size, free
        _copy_rows(strip, (1, point * spacing + 1, size), inside, template)
        uncoded = size * size - int(np.round(coded_share[point] * size * size))
        _match_one(template, uncoded, search, window, copies, totals, result)
        found[point, 0] = predicted[point, 0] + result[0]
        found[point, 1] = predicted[point, 1] + result[1]
        scores[point, 0], scores[point, 1], scores[point, 2] = result[2], result[3], result[4]


@kernel
def _count_coded(strip: NDArray[np.uint8], begin: int, size: int, counts: NDArray[np.uint8]) -> None:
    """Number of coded pixels in each column of a template; 0 beyond its last column."""
    counts[:] = 0
    for row in range(1, size + 1):
        for column in range(LANES):
            code = strip[np.uint64(row), np.uint64(begin) + np.uint64(column)]
            counts[column] = np.uint8(counts[column] + np.uint8(code != UNCODED))
    counts[size:] = 0


@kernel
def strip_spacing(size: int) -> int:
    """Columns of a strip from one template to the next: the window and a pixel on either side, in whole registers."""
    return LANES * ((size + 2 + LANES - 1) // LANES)


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
    sums = np.zeros(LANES, np.uint8)
    words = sums.view(np.uint64)
    for point in range(centres.shape[0]):
        if coded_share[point] == 0.0:
            _count_coded(strip, point * spacing + 1, size, sums)
            coded_share[point] = _sum_of_bytes(words) / (size * size)
