"""The messages in a receiver's stream of bytes: u-blox frames, NMEA sentences and RTCM 3 frames, mixed.

Sources: u-blox 8 / M8 and ZED-F9P interface descriptions (frame structure, checksum), NMEA 0183 (sentence structure),
RTCM 10403 (transport layer, CRC-24Q).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavkit.formats.kernels.jit import kernel

UBX, NMEA, RTCM3 = 0, 1, 2
LONGEST_SENTENCE = 1024
"""NMEA allows 82 characters; makers' own sentences are longer."""
_MORE, _NOTHING = -1, 0


class Sums(NamedTuple):
    """What lets the checksum of any stretch of a block be told without a loop over it; n is the block's length.

    A false beginning of a frame then costs the same whatever length it claims.
    """

    plain: NDArray[np.uint8]
    """(n + 1,) sums of the bytes before each place, modulo 256."""
    weighted: NDArray[np.uint8]
    """(n + 1,) sums of the bytes times their place, modulo 256."""
    crc: NDArray[np.uint32]
    """(n + 1,) CRC-24Q of the bytes before each place, from some place on and up to ``crc_until``."""
    crc_until: NDArray[np.int64]
    """(1,) up to where ``crc`` is known."""
    table: NDArray[np.uint32]
    """(256,) of ``crc24q_table``."""
    powers: NDArray[np.uint32]
    """(11, 3, 256) of ``crc24q_powers``."""


class Found(NamedTuple):
    """The messages of a block, room for m of them."""

    kinds: NDArray[np.uint8]
    """(m,) UBX, NMEA or RTCM3."""
    places: NDArray[np.int64]
    """(m, 2) begin and length in the block."""
    codes: NDArray[np.int64]
    """(m,) class * 256 + number of a u-blox frame, the address of a sentence, the number of an RTCM message."""


def crc24q_table() -> NDArray[np.uint32]:
    """Return the table of CRC-24Q (polynomial 0x1864CFB) for single bytes, (256,)."""
    table = np.arange(256, dtype=np.uint32) << np.uint32(16)
    for _ in range(8):
        table = np.where(table & np.uint32(0x800000), (table << np.uint32(1)) ^ np.uint32(0x1864CFB), table << 1)
    return np.asarray(table & np.uint32(0xFFFFFF), dtype=np.uint32)


def crc24q_powers(table: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return what 1, 2, 4, ... 1024 zero bytes make of a CRC, (11, 3, 256): by each of its bytes, the lowest first."""
    values = np.arange(256, dtype=np.uint32)
    one = [((values << np.uint32(8 * b + 8)) & 0xFFFFFF) ^ (table if b == 2 else np.uint32(0)) for b in range(3)]
    powers = [np.array(one, dtype=np.uint32)]
    for _ in range(10):
        last = powers[-1]
        powers.append(last[0][last & 255] ^ last[1][last >> 8 & 255] ^ last[2][last >> 16])
    return np.array(powers, dtype=np.uint32)


@kernel
def running_sums(block: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return sums modulo 256 of the bytes before each place and of the bytes times their place, (n + 1,) each."""
    n = len(block)
    plain, weighted = np.zeros(n + 1, dtype=np.uint8), np.zeros(n + 1, dtype=np.uint8)
    a, b = 0, 0
    for i in range(n):
        a = (a + block[i]) & 255
        b = (b + block[i] * (i & 255)) & 255
        plain[i + 1] = a
        weighted[i + 1] = b
    return plain, weighted


@kernel
def _ubx_length(block: NDArray[np.uint8], i: int, final: bool, sums: Sums) -> int:
    """Return the length of the frame that begins at i, 0 where none does, -1 where more bytes must be seen.

    Fletcher's second sum over bytes s to e is the sum of (e - place) * byte.
    """
    n = len(block)
    if i + 1 < n and block[i + 1] != 0x62:
        return _NOTHING
    if i + 6 > n:
        return _NOTHING if final else _MORE
    end = i + 6 + block[i + 4] + 256 * block[i + 5]
    if end + 2 > n:
        return _NOTHING if final else _MORE
    a = (int(sums.plain[end]) - int(sums.plain[i + 2])) & 255
    b = ((end & 255) * a - (int(sums.weighted[end]) - int(sums.weighted[i + 2]))) & 255
    return end + 2 - i if a == block[end] and b == block[end + 1] else _NOTHING


@kernel
def _crc(block: NDArray[np.uint8], begin: int, end: int, sums: Sums) -> int:
    """Return CRC-24Q of bytes begin to end, at most 2047, from those of all bytes before each."""
    if begin > sums.crc_until[0]:
        sums.crc_until[0], sums.crc[begin] = begin, 0
    for j in range(sums.crc_until[0], end):
        crc = int(sums.crc[j])
        sums.crc[j + 1] = ((crc << 8) & 0xFFFFFF) ^ int(sums.table[(crc >> 16) ^ block[j]])
    sums.crc_until[0] = max(int(sums.crc_until[0]), end)
    before, length, power = int(sums.crc[begin]), end - begin, 0
    while length:
        if length & 1:
            t = sums.powers[power]
            before = int(t[0, before & 255]) ^ int(t[1, (before >> 8) & 255]) ^ int(t[2, before >> 16])
        length >>= 1
        power += 1
    return int(sums.crc[end]) ^ before


@kernel
def _rtcm_length(block: NDArray[np.uint8], i: int, final: bool, sums: Sums) -> int:
    """Return the length of the RTCM 3 frame that begins at i, 0 where none does, -1 where more must be seen."""
    n = len(block)
    if i + 1 < n and block[i + 1] > 3:
        return _NOTHING
    if i + 3 > n:
        return _NOTHING if final else _MORE
    end = i + 3 + (block[i + 1] & 3) * 256 + block[i + 2]
    if end + 3 > n:
        return _NOTHING if final else _MORE
    told = block[end] * 65536 + block[end + 1] * 256 + block[end + 2]
    return end + 3 - i if _crc(block, i, end, sums) == told else _NOTHING


@kernel
def _hex(byte: int) -> int:
    """Return the value of a hexadecimal digit, a number above 255 for another character."""
    if 48 <= byte <= 57:
        return byte - 48
    if 65 <= byte <= 70:
        return byte - 55
    if 97 <= byte <= 102:
        return byte - 87
    return 4096


@kernel
def _with_line_end(block: NDArray[np.uint8], i: int, end: int, final: bool) -> int:
    """Return the length from i to behind the line ends (at most four characters) at ``end``."""
    n = len(block)
    stop = end
    while stop < n and stop < end + 4 and (block[stop] == 13 or block[stop] == 10):
        stop += 1
    if stop == n and stop < end + 4 and not final:
        return _MORE
    return stop - i


@kernel
def _nmea_length(block: NDArray[np.uint8], i: int, final: bool, unchecked: bool) -> int:
    """Return the length of the sentence that begins at i with its line end, 0 for none, -1 where more must be seen.

    ``unchecked`` tells that sentences without a checksum count too; they must end in CR LF.
    """
    n = len(block)
    j, total, address = i + 1, 0, 0
    while j < n and j < i + LONGEST_SENTENCE:
        byte = int(block[j])
        if byte == 42:
            break
        if byte < 32 or byte > 126 or byte == 36:
            if not unchecked or byte != 13 or address < 3:
                return _NOTHING
            if j + 1 >= n:
                return _NOTHING if final else _MORE
            return _with_line_end(block, i, j, final) if block[j + 1] == 10 else _NOTHING
        if byte == 44 and address == 0:
            address = j - i - 1
        if address == 0 and not (65 <= byte <= 90 or 48 <= byte <= 57):
            return _NOTHING
        total ^= byte
        j += 1
    if j >= i + LONGEST_SENTENCE:
        return _NOTHING
    if j + 2 >= n:
        return _NOTHING if final else _MORE
    if j - i < 4 or _hex(block[j + 1]) * 16 + _hex(block[j + 2]) != total:
        return _NOTHING
    return _with_line_end(block, i, j + 3, final)


@kernel
def _address(block: NDArray[np.uint8], i: int) -> int:
    """Return up to seven characters of a sentence's address, the first in the lowest byte."""
    code, j = 0, i + 1
    while j < i + 8 and block[j] != 44 and block[j] != 42 and block[j] != 13:
        code |= int(block[j]) << (8 * (j - i - 1))
        j += 1
    return code


@kernel
def _code(block: NDArray[np.uint8], i: int, kind: int, length: int) -> int:
    """Return the code of the message at i."""
    if kind == UBX:
        return int(block[i + 2]) * 256 + int(block[i + 3])
    if kind == NMEA:
        return _address(block, i)
    return (int(block[i + 3]) << 4 | int(block[i + 4]) >> 4) if length >= 8 else 0


@kernel
def scan(
    block: NDArray[np.uint8], begin: int, final: bool, unchecked: bool, sums: Sums, found: Found
) -> tuple[int, int, bool]:
    """Find the intact messages of a block from ``begin`` on, as many as ``found`` has room for.

    What fails is tried again one byte later. Returns how far the block is decided, how many messages there are, and
    whether more bytes are needed; with ``final`` there are none. ``unchecked`` as in ``_nmea_length``.
    """
    i, n, count = begin, len(block), 0
    while i < n and count < len(found.kinds):
        byte = block[i]
        if byte == 0xB5:
            kind, length = UBX, _ubx_length(block, i, final, sums)
        elif byte == 36:
            kind, length = NMEA, _nmea_length(block, i, final, unchecked)
        elif byte == 0xD3:
            kind, length = RTCM3, _rtcm_length(block, i, final, sums)
        else:
            i += 1
            continue
        if length == _MORE:
            return i, count, True
        if length == _NOTHING:
            i += 1
            continue
        found.kinds[count] = kind
        found.places[count, 0], found.places[count, 1] = i, length
        found.codes[count] = _code(block, i, kind, length)
        count += 1
        i += length
    return i, count, False
