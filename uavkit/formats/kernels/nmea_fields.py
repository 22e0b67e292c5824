"""The fields of NMEA sentences as numbers and as short texts."""

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.formats.kernels.jit import kernel

FIELDS = 20


@kernel
def _number(block: NDArray[np.uint8], begin: int, end: int) -> float:
    """Return a decimal number, NaN where the field is empty, longer than 18 digits or anything else.

    Blanks around it do not count.
    """
    while begin < end and block[begin] == 32:
        begin += 1
    while begin < end and block[end - 1] == 32:
        end -= 1
    j, sign = begin, 1.0
    if j < end and (block[j] == 45 or block[j] == 43):
        sign = -1.0 if block[j] == 45 else 1.0
        j += 1
    digits, mantissa, scale, fraction = 0, 0, 1.0, False
    while j < end:
        byte = int(block[j])
        if byte == 46 and not fraction:
            fraction = True
        elif 48 <= byte <= 57 and digits < 18:
            mantissa = mantissa * 10 + byte - 48
            digits += 1
            if fraction:
                scale *= 10.0
        else:
            return np.nan
        j += 1
    return sign * mantissa / scale if digits > 0 else np.nan


@kernel
def split_fields(
    block: NDArray[np.uint8], places: NDArray[np.int64], numbers: Array, texts: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Write the fields of sentences at ``places`` (n, 2: begin, length) as numbers and texts, (n, FIELDS) each.

    Field 0 is the address. A text is its first seven characters, the first in the lowest byte; 0 and NaN are an empty
    field. Returns the count of fields of each sentence, (n,), the address included.
    """
    counts = np.zeros(len(places), dtype=np.int64)
    for row in range(len(places)):
        begin = places[row, 0] + 1
        stop = places[row, 0] + places[row, 1]
        for field in range(FIELDS):
            numbers[row, field], texts[row, field] = np.nan, 0
        j, field = begin, 0
        while True:
            ends = j >= stop or block[j] == 42 or block[j] < 32
            if ends or block[j] == 44:
                if field < FIELDS:
                    numbers[row, field] = _number(block, begin, j)
                    for k in range(begin, min(j, begin + 7)):
                        texts[row, field] |= np.int64(block[k]) << (8 * (k - begin))
                field += 1
                begin = j + 1
            if ends:
                break
            j += 1
        counts[row] = field
    return counts
