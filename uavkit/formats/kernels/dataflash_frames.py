"""Where messages begin in a dataflash log: the rule is stated in ``uavkit.formats.dataflash``."""

import numpy as np
from numpy.typing import NDArray

from uavkit.formats.kernels.jit import kernel

Bytes = NDArray[np.uint8]
Table = NDArray[np.int64]

MARGIN = 1100
"""A message is decided with so many bytes behind its beginning in sight: four of the longest messages."""
NEAR_US = 60_000_000
"""A message whose time is farther than this from that of the message before it does not count as sure by its time."""
NO_CLOCK, CLOCK_US, CLOCK_MS = 0, 1, 2
COUNT, GATHER, STOP_AFTER, STOP_BEFORE = 0, 1, 2, 3
"""What to do with messages of a type."""
DONE, FULL, DEFINITION, CONTESTED = 0, 1, 2, 3
"""Why a scan came to an end: the block is done with, an output is full, a message of a type with STOP_..."""
NO_HEADER, CUT_SHORT, FILE_ENDS, WRONG_TIME, UNDEFINED = 1, 2, 3, 4, 256
"""Why bytes are lost; a type without a definition is UNDEFINED plus its number."""
LAST_US, SYNCHRONISED, END = 0, 1, 2
"""Places in a scan's state: time of the last message (-1: none), whether it ended here, where the last one ended."""

_FMT = 0x80


@kernel
def frame_length(data: Bytes, q: int, lengths: Table) -> int:
    """Return the length of a message by its header at ``q``; 0 where none of a known type begins there."""
    if q + 3 > len(data) or data[q] != 0xA3 or data[q + 1] != 0x95:
        return 0
    return int(lengths[data[q + 2]])


@kernel
def time_us(data: Bytes, q: int, clocks: Table) -> int:
    """Return the boot time of the message at ``q``, -1 where its type has none in its first column."""
    clock = clocks[data[q + 2]]
    if clock == NO_CLOCK:
        return -1
    size = 8 if clock == CLOCK_US else 4
    time = np.uint64(0)
    for k in range(size):
        time |= np.uint64(data[q + 3 + k]) << np.uint64(8 * k)
    if time > np.uint64(1 << 60):
        return 1 << 60
    return int(time) if clock == CLOCK_US else int(time) * 1000


@kernel
def is_definition(data: Bytes, q: int, sizes: Table) -> bool:
    """Tell whether the FMT at ``q`` agrees with itself: its length is that of its format characters."""
    total = 3
    for k in range(16):
        character = data[q + 9 + k]
        if character == 0:
            break
        if sizes[character] == 0:
            return False
        total += sizes[character]
    return total == int(data[q + 4]) and total > 3 and 32 < data[q + 5] < 127


@kernel
def is_strong(data: Bytes, q: int, tables: Table, last_us: int) -> bool:
    """Tell whether a message at ``q`` is sure by what is in it: its time, or that it defines what can be."""
    length = frame_length(data, q, tables[0])
    if length == 0 or q + length > len(data):
        return False
    if data[q + 2] == _FMT:
        return is_definition(data, q, tables[2])
    time = time_us(data, q, tables[1])
    return time >= 0 and last_us >= 0 and abs(time - last_us) <= NEAR_US


@kernel
def is_sure(data: Bytes, q: int, tables: Table, last_us: int) -> bool:
    """Tell whether a message at ``q`` is sure by what is in it, or because another follows it."""
    if is_strong(data, q, tables, last_us):
        return True
    length = frame_length(data, q, tables[0])
    if length == 0 or q + length > len(data) or data[q + 2] == _FMT:
        return False
    after = q + length  # what follows may be of a type whose definition is lost
    return after == len(data) or (after + 1 < len(data) and data[after] == 0xA3 and data[after + 1] == 0x95)


@kernel
def holds_chain(data: Bytes, p: int, end: int, tables: Table, last_us: int) -> bool:
    """Tell whether messages inside the one from ``p`` to ``end`` lead to its very end: then it was cut short.

    One of them must be sure by what is in it, or there must be two: two chance bytes alone are no message.
    """
    for first in range(p + 3, end - 3):
        if data[first] != 0xA3 or data[first + 1] != 0x95:
            continue
        q, links, strong = first, 0, False
        while q < end:
            length = frame_length(data, q, tables[0])
            if length == 0:
                break
            strong = strong or is_strong(data, q, tables, last_us)
            links += 1
            q += length
        if q == end and (strong or links > 1):
            return True
    return False


@kernel
def holds_message(data: Bytes, p: int, end: int, tables: Table, last_us: int) -> bool:
    """Tell whether a sure message begins inside the one from ``p`` to ``end``."""
    for q in range(p + 3, min(end, len(data) - 1)):
        if data[q] == 0xA3 and data[q + 1] == 0x95 and is_sure(data, q, tables, last_us):
            return True
    return False


@kernel
def holds_head(data: Bytes, p: int, end: int) -> bool:
    """Tell whether the two bytes of a head stand anywhere inside: quick, for nearly all messages have none."""
    found = 0
    for q in range(p + 3, end - 3):
        found |= (data[q] == 0xA3) & (data[q + 1] == 0x95)
    return found != 0


@kernel
def refusal(data: Bytes, p: int, tables: Table, state: Table) -> int:
    """Return 0 where a message is accepted at ``p``, else why not."""
    last_us = state[LAST_US]
    length = frame_length(data, p, tables[0])
    if length == 0:
        undefined = p + 3 <= len(data) and data[p] == 0xA3 and data[p + 1] == 0x95 and state[SYNCHRONISED] == 1
        return UNDEFINED + int(data[p + 2]) if undefined else NO_HEADER
    end = p + length
    if end > len(data):
        return FILE_ENDS
    if state[SYNCHRONISED] == 0 and not is_sure(data, p, tables, last_us):
        return NO_HEADER
    if end == len(data) or frame_length(data, end, tables[0]) > 0:
        return CUT_SHORT if holds_head(data, p, end) and holds_chain(data, p, end, tables, last_us) else 0
    time = time_us(data, p, tables[1])
    if time >= 0 and last_us >= 0 and abs(time - last_us) > NEAR_US:
        return WRONG_TIME
    return CUT_SHORT if holds_message(data, p, end, tables, last_us) else 0


@kernel
def scan(
    data: Bytes, final: bool, p: int, tables: Table, state: Table, places: Table, spans: Table
) -> tuple[int, int, int, int]:
    """Find the messages of a block from ``p``.

    ``tables`` (5, 256) holds by type: length (0 not defined), clock in the first column, size by format character,
    what to do, and the count of messages found, which is added to. ``state`` (3,) is carried on. ``places`` (m,)
    takes the beginnings of messages to gather, ``spans`` (k, 3) begin, length and reason of lost bytes.
    Returns where it stopped, the numbers of places and spans, and why it stopped.
    """
    stop = len(data) if final else len(data) - MARGIN
    found, lost, begin, why = 0, 0, -1, 0
    reason = DONE
    while p < stop:
        if found == len(places) or lost >= len(spans) - 1:
            reason = FULL
            break
        if state[SYNCHRONISED] == 1 and frame_length(data, p, tables[0]) > 0 and tables[3, data[p + 2]] == STOP_BEFORE:
            reason = CONTESTED
            break
        refused = refusal(data, p, tables, state)
        if refused != 0:
            if begin < 0:
                begin, why = p, refused
            state[SYNCHRONISED] = 0
            p += 1
            while p < stop and data[p] != 0xA3:
                p += 1
            continue
        kind = data[p + 2]
        todo = tables[3, kind]
        if begin >= 0:
            spans[lost, 0], spans[lost, 1], spans[lost, 2] = begin, p - begin, why
            lost += 1
            begin = -1
        tables[4, kind] += 1
        if todo != COUNT:
            places[found] = p
            found += 1
        time = time_us(data, p, tables[1])
        if time >= 0:
            state[LAST_US] = time
        p += tables[0, kind]
        state[SYNCHRONISED] = 1
        state[END] = p
        if todo == STOP_AFTER:
            reason = DEFINITION
            break
    if begin >= 0:
        spans[lost, 0], spans[lost, 1], spans[lost, 2] = begin, p - begin, why
        lost += 1
    return p, found, lost, reason
