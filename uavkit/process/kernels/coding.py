"""Orientation codes of a picture, its noise, and the richness of its codes: inner loops."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

Codes = NDArray[np.uint8]


@kernel
def second_difference_histogram(image: NDArray[np.uint8], row_step: int, bins: NDArray[np.int64]) -> None:
    """Count |I * [1 -2 1; -2 4 -2; 1 -2 1]| over every row_step-th row; blind to slopes and straight edges."""
    rows, columns = image.shape
    last = bins.shape[0] - 1
    for row in range(1, rows - 1, row_step):
        for column in range(1, columns - 1):
            corners = (
                np.int64(image[row - 1, column - 1])
                + image[row - 1, column + 1]
                + image[row + 1, column - 1]
                + image[row + 1, column + 1]
            )
            sides = (
                np.int64(image[row - 1, column])
                + image[row + 1, column]
                + image[row, column - 1]
                + image[row, column + 1]
            )
            bins[min(abs(corners - 2 * sides + 4 * np.int64(image[row, column])), last)] += 1


@kernel
def code_picture(
    image: NDArray[np.uint8],
    threshold: int,
    tangents: NDArray[np.int16],
    code_step: int,
    no_code: int,
    codes: Codes,
) -> None:
    """Write code * code_step, or no_code, for each pixel of codes (h, w) from Sobel gradients; the border is uncoded.

    tangents (q - 1, 2) holds numerator and denominator (both below 32, so that products with a Sobel gradient stay in
    16 bits) of the tangents of the sector limits inside one quadrant.
    """
    rows, columns = image.shape
    dx = np.zeros(columns, np.int16)
    dy = np.zeros(columns, np.int16)
    sector = np.zeros(columns, np.uint8)
    sums = np.zeros(columns, np.int16)
    differences = np.zeros(columns, np.int16)
    per_quadrant = tangents.shape[0] + 1
    codes[0, :] = no_code
    codes[rows - 1, :] = no_code
    for row in range(1, rows - 1):
        above, here, below = image[row - 1], image[row], image[row + 1]
        for column in range(columns):
            sums[column] = np.int16(above[column]) + 2 * np.int16(here[column]) + np.int16(below[column])
            differences[column] = np.int16(below[column]) - np.int16(above[column])
        for column in range(1, columns - 1):
            dx[column] = sums[column + 1] - sums[column - 1]
            dy[column] = differences[column - 1] + 2 * differences[column] + differences[column + 1]
        _quadrants(dx, dy, sector, per_quadrant)
        for limit in range(per_quadrant - 1):
            numerator, denominator = tangents[limit, 0], tangents[limit, 1]
            for column in range(columns):
                beyond = np.int16(dy[column] * denominator) >= np.int16(dx[column] * numerator)
                sector[column] += np.uint8(beyond)
        coded = codes[row]
        for column in range(columns):
            strength = np.int16(dx[column] + dy[column])
            coded[column] = np.uint8(sector[column] * code_step) if strength >= threshold else np.uint8(no_code)
        coded[0] = no_code
        coded[columns - 1] = no_code


@kernel
def _quadrants(dx: NDArray[np.int16], dy: NDArray[np.int16], sector: NDArray[np.uint8], per_quadrant: int) -> None:
    """Turn gradients by multiples of 90 degrees into dx > 0, dy >= 0; sector gets the first code of its quadrant."""
    for column in range(dx.shape[0]):
        x, y = dx[column], dy[column]
        lower = (y < 0) | ((y == 0) & (x < 0))
        x1 = np.int16(-x) if lower else x
        y1 = np.int16(-y) if lower else y
        left = x1 <= 0
        dx[column] = y1 if left else x1
        dy[column] = np.int16(-x1) if left else y1
        sector[column] = np.uint8(lower) * np.uint8(2 * per_quadrant) + np.uint8(left) * np.uint8(per_quadrant)


@kernel
def richness_picture(
    codes: Codes,
    code_count: int,
    window: int,
    limits: NDArray[np.float64],
    richness: NDArray[np.float32],
) -> None:
    """Entropy of the codes in a sliding window, scaled to 0..1; limits = (entropy floor, least share of coded pixels).

    Column histograms slide down, the window's histogram slides across. Pixels nearer to the border than half a window
    stay zero. sum P log P = (sum h log h) / coded - log coded, with h log h from a table.
    """
    rows, columns = codes.shape
    half = window // 2
    least = max(1.0, limits[1] * window * window)
    most_entropy = np.log2(code_count)
    floor = limits[0] * most_entropy
    table = np.zeros(window * window + 1, np.float32)
    for count in range(1, window * window + 1):
        table[count] = count * np.log2(count)
    column_counts = np.zeros((columns, code_count + 1), np.int16)
    for row in range(2 * half):
        for column in range(columns):
            column_counts[column, codes[row, column]] += 1
    for row in range(half, rows - half):
        for column in range(columns):
            column_counts[column, codes[row + half, column]] += 1
            if row > half:
                column_counts[column, codes[row - half - 1, column]] -= 1
        counts = np.zeros(code_count + 1, np.int16)
        for column in range(2 * half):
            for code in range(code_count):
                counts[code] += column_counts[column, code]
        for column in range(half, columns - half):
            coded = 0
            weighted = np.float32(0.0)
            for code in range(code_count):
                counts[code] += column_counts[column + half, code]
                if column > half:
                    counts[code] -= column_counts[column - half - 1, code]
                coded += counts[code]
                weighted += table[counts[code]]
            if coded >= least:
                entropy = np.log2(coded) - weighted / coded
                if entropy >= floor:
                    richness[row, column] = (entropy - floor) / (most_entropy - floor)
