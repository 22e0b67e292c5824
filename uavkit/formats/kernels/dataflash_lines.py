"""Lines of dataflash logs as text, and the numbers in them."""

import numpy as np
from numpy.typing import NDArray

from uavkit.formats.kernels.jit import kernel

Bytes = NDArray[np.uint8]
Table = NDArray[np.int64]

BLANK, PLAIN, WIDE, BROKEN = 0, 1, 2, 3
"""What a line is: nothing but blanks, ASCII, with bytes above 127, or with control bytes or no name in front."""
BEGIN, END, NAME, COMMAS, WHAT = 0, 1, 2, 3, 4
"""Columns of the table of lines."""

_COMMA, _NEWLINE, _RETURN, _TAB, _SPACE = 44, 10, 13, 9, 32
_LONGEST_NAME = 7
_GREATEST_MANTISSA = 10**17


@kernel
def lines(data: Bytes, final: bool, p: int, out: Table) -> tuple[int, int]:
    """Mark the lines of a block from ``p``: ``out`` (m, 5) takes begin, end, name, commas and kind of each.

    A name is its bytes, the first the lowest. Returns where it stopped and the number of lines.
    """
    found, begin = 0, p
    name, letters, named, commas, what = 0, 0, False, 0, BLANK
    q = p
    while q < len(data) and found < len(out):
        byte = int(data[q])
        q += 1
        if byte == _NEWLINE or (final and q == len(data)):
            if byte != _NEWLINE and byte > _SPACE:
                what = max(what, WIDE if byte > 127 else PLAIN)
                commas += byte == _COMMA
            elif byte != _NEWLINE and byte not in (_SPACE, _TAB, _RETURN):
                what = BROKEN
            if what in (PLAIN, WIDE) and (commas == 0 or letters == 0):
                what = BROKEN
            out[found, BEGIN], out[found, END], out[found, NAME] = begin, q, name
            out[found, COMMAS], out[found, WHAT] = commas, what
            found += 1
            begin, name, letters, named, commas, what = q, 0, 0, False, 0, BLANK
            continue
        if byte == _COMMA:
            commas += 1
            named = True
        if byte > _SPACE and byte != 127:
            what = max(what, WIDE if byte > 127 else PLAIN)
        elif byte not in (_SPACE, _TAB, _RETURN):
            what = BROKEN
        if not named:
            letter = 48 <= byte <= 57 or 65 <= byte <= 90 or byte == 95 or 97 <= byte <= 122
            if letter and letters < _LONGEST_NAME:
                name |= byte << (8 * letters)
                letters += 1
            elif byte > _SPACE:
                what = BROKEN
    return begin, found


@kernel
def number(data: Bytes, a: int, b: int) -> tuple[bool, float]:
    """Return whether the text from ``a`` to ``b`` is a number, and its value; within two units of the last place."""
    while a < b and data[a] <= _SPACE:
        a += 1
    while b > a and data[b - 1] <= _SPACE:
        b -= 1
    sign = 1.0
    if a < b and (data[a] == 45 or data[a] == 43):
        sign = -1.0 if data[a] == 45 else 1.0
        a += 1
    if b - a in (3, 4) and is_word(data, b - 3, (110, 97, 110)):
        return True, np.nan
    if b - a in (3, 8) and is_word(data, a, (105, 110, 102)):
        return True, sign * np.inf
    q, mantissa, scale = digits(data, a, b)
    if q < 0:
        return False, np.nan
    if q < b:
        good, power = exponent(data, q, b)
        if not good:
            return False, np.nan
        scale += power
    if -22 <= scale < 0:
        return True, sign * (float(mantissa) / 10.0**-scale)
    return True, sign * (float(mantissa) * 10.0**scale)


@kernel
def is_word(data: Bytes, q: int, letters: tuple[int, int, int]) -> bool:
    """Tell whether three letters, of either case, stand at ``q``."""
    return bool((data[q] | 32) == letters[0] and (data[q + 1] | 32) == letters[1] and (data[q + 2] | 32) == letters[2])


@kernel
def digits(data: Bytes, q: int, b: int) -> tuple[int, int, int]:
    """Read digits with a point among them; returns where they end (-1: none are there), mantissa, and power of 10."""
    mantissa, count, scale, point = 0, 0, 0, False
    while q < b:
        byte = int(data[q])
        if byte == 46 and not point:
            point = True
        elif 48 <= byte <= 57:
            count += 1
            if mantissa < _GREATEST_MANTISSA:
                mantissa = mantissa * 10 + byte - 48
                scale -= 1 if point else 0
            else:
                scale += 0 if point else 1
        else:
            break
        q += 1
    return (q if count else -1), mantissa, scale


@kernel
def exponent(data: Bytes, q: int, b: int) -> tuple[bool, int]:
    """Return whether ``q`` to ``b`` is the exponent of a number, and its value."""
    if data[q] | 32 != 101:
        return False, 0
    q += 1
    negative = q < b and data[q] == 45
    if q < b and (data[q] == 45 or data[q] == 43):
        q += 1
    if q == b or b - q > 4:
        return False, 0
    power = 0
    while q < b:
        if data[q] < 48 or data[q] > 57:
            return False, 0
        power = power * 10 + int(data[q]) - 48
        q += 1
    return True, -power if negative else power


@kernel
def fields(
    data: Bytes, table: Table, is_text: NDArray[np.bool_], values: NDArray[np.float64], bounds: Table
) -> NDArray[np.bool_]:
    """Read the columns behind the name of lines (n, 5), k of them each; returns which lines could be read, (n,).

    ``values`` (n, k) takes numbers, ``bounds`` (n, k, 2) where each column's text lies; a text at the end of the line
    may hold commas.
    """
    count = len(is_text)
    good = np.ones(len(table), dtype=np.bool_)
    for row in range(len(table)):
        q, end = table[row, BEGIN], table[row, END]
        while data[q] != _COMMA:
            q += 1
        for column in range(count):
            a = q + 1
            q = a
            rest = column == count - 1
            while q < end and (rest or data[q] != _COMMA):
                q += 1
            bounds[row, column, 0], bounds[row, column, 1] = a, q
            if not is_text[column]:
                known, value = number(data, a, q)
                good[row] &= known
                values[row, column] = value
    return good
