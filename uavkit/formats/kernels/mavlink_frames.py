"""MAVLink frames found in bytes, with or without the time stamps of a telemetry log before them.

Frames of both versions and their checksum (CRC-16/MCRF4XX over all but the first byte, then a byte that stands for the
message's definition) are those of the MAVLink developer guide, "Packet Serialization" and "Message Signing".
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.formats.kernels.jit import kernel

Bytes = NDArray[np.uint8]
Table = NDArray[np.int16]
Indices = NDArray[np.int64]

STAMP_BYTES = 8
"""Before each frame of a telemetry log: Unix time in microseconds, most significant byte first."""
SHORTEST_FRAME = 8
MARGIN_BYTES = 8192
"""More than a frame and all that is looked at behind it before it is accepted."""
SIGNATURE_BYTES = 13
COLUMNS = 8
"""Of a row for a frame: id, first byte of the payload, its length, stamp or -1, system, component, first byte, end."""
COUNTED, LISTED, UNDEFINED = 0, 1, 2
"""What is done with a message, by its id."""
NOT_A_MESSAGE, BAD_CHECKSUM, CUT_SHORT, BAD_STAMP = 0, 1, 2, 3

_V1, _V2 = 0xFE, 0xFD
_SIGNED = 1
_CHAIN = 16
"""Unknown messages in a row that are followed to one whose checksum can be verified."""
_LAST_YEAR = 0x0E
"""The second byte of a stamp until 2095."""


def _checksum_table() -> Indices:
    table = np.zeros(256, dtype=np.int64)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ 0x8408 if value & 1 else value >> 1
        table[byte] = value
    return table


_CRC = _checksum_table()
_BYTE_OF_HIGH = np.argsort(_CRC >> 8).astype(np.uint8)
"""The byte whose entry in the table has this high byte: the high bytes of the entries are all different."""


@kernel
def _checksum(block: Bytes, begin: int, end: int) -> int:
    crc = 0xFFFF
    for at in range(begin, end):
        crc = (crc >> 8) ^ _CRC[(crc ^ block[at]) & 0xFF]
    return crc


@kernel
def _frame_bytes(block: Bytes, at: int, size: int) -> int:
    """Return the length of the frame that would begin here, 0 where none can or where it does not end in the block."""
    if at < 0 or at + SHORTEST_FRAME > size:
        return 0
    if block[at] == _V1:
        length = 8 + block[at + 1]
    elif block[at] == _V2 and at + 12 <= size and block[at + 2] <= _SIGNED:
        length = 12 + block[at + 1] + SIGNATURE_BYTES * block[at + 2]
    else:
        return 0
    return length if at + length <= size else 0


@kernel
def _message_id(block: Bytes, at: int) -> int:
    if block[at] == _V1:
        number: int = 0 + block[at + 5]
    else:
        number = block[at + 7] + 256 * block[at + 8] + 65536 * block[at + 9]
    return number


@kernel
def _checksum_at(block: Bytes, at: int) -> int:
    header = 6 if block[at] == _V1 else 10
    place: int = at + header + block[at + 1]
    return place


@kernel
def known_frame(block: Bytes, at: int, size: int, extra: Table, longest: Table) -> int:
    """Return the end of the intact frame of a known message that begins here, 0 where there is none."""
    length = _frame_bytes(block, at, size)
    if length == 0:
        return 0
    number = _message_id(block, at)
    if number >= len(extra) or extra[number] < 0 or (block[at] == _V1 and block[at + 1] > longest[number]):
        return 0
    place = _checksum_at(block, at)
    crc = _checksum(block, at + 1, place)
    crc = (crc >> 8) ^ _CRC[(crc ^ extra[number]) & 0xFF]
    stated = block[place] + 256 * block[place + 1]
    return at + length if crc == stated else 0


@kernel
def _extra_needed(block: Bytes, at: int) -> int:
    """Return the byte for the definition that makes the checksum of the frame here right, -1 where none does.

    Only 256 of the 65536 checksums can come out, whatever that byte is.
    """
    place = _checksum_at(block, at)
    crc = _checksum(block, at + 1, place)
    needed = (crc >> 8) ^ (block[place] + 256 * block[place + 1])
    byte = 0 + _BYTE_OF_HIGH[needed >> 8]
    return byte ^ (crc & 0xFF) if _CRC[byte] == needed else -1


@kernel
def _unknown_frame(block: Bytes, at: int, size: int, use: Bytes) -> int:
    """Return the end of a frame of a message that no dialect defines, 0 where none begins here."""
    length = _frame_bytes(block, at, size)
    if length == 0:
        return 0
    number = _message_id(block, at)
    if (number < len(use) and use[number] != UNDEFINED) or _extra_needed(block, at) < 0:
        return 0
    return at + length


@kernel
def _stamp(block: Bytes, at: int) -> int:
    """Return the stamp that begins here, -1 where it is none that a computer's clock may show."""
    if at < 0 or block[at] != 0 or block[at + 1] > _LAST_YEAR:
        return -1
    value = 0
    for place in range(at + 1, at + STAMP_BYTES):
        value = 256 * value + block[place]
    return value if value > 0 else -1


@kernel
def _known_between(block: Bytes, first: int, last: int, size: int, extra: Table, longest: Table) -> bool:
    for at in range(first, last):
        if (block[at] == _V1 or block[at] == _V2) and known_frame(block, at, size, extra, longest) > 0:
            return True
    return False


@kernel
def _chain_holds(block: Bytes, end: int, size: int, stamp_bytes: int, extra: Table, longest: Table, use: Bytes) -> bool:
    """Tell whether the file ends here, or a known message comes next, at most some unknown ones between."""
    for _ in range(_CHAIN):
        if end == size:
            return True
        at = end + stamp_bytes
        if stamp_bytes > 0 and (at > size or _stamp(block, end) < 0):
            return False
        if known_frame(block, at, size, extra, longest) > 0:
            return True
        end = _unknown_frame(block, at, size, use)
        if end == 0:
            return False
    return False


@kernel
def _accepted_end(
    block: Bytes, at: int, size: int, stamp_bytes: int, sure: int, expected: int, extra: Table, longest: Table,
    use: Bytes,
) -> int:  # fmt: skip
    """Return the end of the message that begins here, 0 where none does.

    ``sure``: a right stamp stands before it. ``expected``: the last message ends where this one (or its stamp) begins.
    """
    end = known_frame(block, at, size, extra, longest)
    if end == 0:
        end = _unknown_frame(block, at, size, use)
        supported = sure == 1 if stamp_bytes > 0 else expected == 1
        return end if end > 0 and supported and _chain_holds(block, end, size, stamp_bytes, extra, longest, use) else 0
    if block[at] == _V2 and block[at + 2] == _SIGNED:
        # A checksum leaves the signature out: where that was cut short, its length reaches into the next message.
        if end == size or known_frame(block, end + stamp_bytes, size, extra, longest) > 0:
            return end
        first, last = end - SIGNATURE_BYTES + stamp_bytes, end + stamp_bytes
        return 0 if _known_between(block, first, min(last, size), size, extra, longest) else end
    if sure == 1 or expected == 1 or end == size:
        return end
    if known_frame(block, end + stamp_bytes, size, extra, longest) > 0:
        return end
    # One in 65536 checksums is right by chance: what has nothing else to say for it must not hide another message.
    return 0 if _known_between(block, at + 1, end, size, extra, longest) else end


@kernel
def _why(block: Bytes, at: int, size: int) -> int:
    if at + SHORTEST_FRAME > size:
        return CUT_SHORT
    if block[at] != _V1 and block[at] != _V2:
        return NOT_A_MESSAGE
    return BAD_CHECKSUM if _frame_bytes(block, at, size) > 0 else CUT_SHORT


@kernel
def scan_frames(
    block: Bytes, final: int, synchronised: int, stamp_bytes: int, extra: Table, longest: Table, use: Bytes,
    rows: Indices, id_counts: Indices, system_counts: Indices, lost: Indices,
) -> tuple[int, int, int, int]:  # fmt: skip
    """Find the messages of a block.

    ``synchronised``: the block begins where a message ended. ``extra`` and ``longest`` (ids,): the byte for the
    checksum and the longest payload; -1 and 255 where the id is not known, until that byte is learned from the
    messages. ``use`` (ids,): COUNTED, LISTED or UNDEFINED; messages to be listed, and those of greater ids, go to
    ``rows`` (k, 8). ``id_counts`` (ids,) and ``system_counts`` (256,) are added to; ``lost``
    (k, 3) takes begin, end and reason of spans that belong to no message. Returns the bytes that are decided,
    whether the last of them end a message, and the numbers of rows and of spans.
    """
    size = len(block)
    limit = size if final == 1 else max(0, size - MARGIN_BYTES)
    end_of_last, row_count, lost_count, at = 0, 0, 0, stamp_bytes if synchronised == 1 else 0
    while at < limit:
        if block[at] != _V1 and block[at] != _V2:
            at = end_of_last if synchronised == 1 and stamp_bytes > 0 else at + 1
            synchronised = 0
            continue
        before = at - stamp_bytes
        stamp = _stamp(block, before) if stamp_bytes > 0 and before >= end_of_last else -1
        sure = 1 if stamp >= 0 else 0
        end = _accepted_end(block, at, size, stamp_bytes, sure, synchronised, extra, longest, use)
        if end == 0:
            at = end_of_last if synchronised == 1 and stamp_bytes > 0 else at + 1
            synchronised = 0
            continue
        begin = before if sure == 1 else at
        if begin > end_of_last:
            lost[lost_count, 0], lost[lost_count, 1] = end_of_last, begin
            lost[lost_count, 2] = BAD_STAMP if synchronised == 1 else _why(block, end_of_last + stamp_bytes, size)
            lost_count += 1
        number = _message_id(block, at)
        if number < len(use):
            id_counts[number] += 1
            if extra[number] < 0:
                extra[number] = _extra_needed(block, at)
        system = block[at + (3 if block[at] == _V1 else 5)]
        system_counts[system] += 1
        if number >= len(use) or use[number] == LISTED:
            payload = at + (6 if block[at] == _V1 else 10)
            row = rows[row_count]
            row[0], row[1], row[2], row[3] = number, payload, block[at + 1], stamp
            row[4], row[5], row[6], row[7] = system, block[payload - (2 if block[at] == _V1 else 4)], at, end
            row_count += 1
        end_of_last, at, synchronised = end, end + stamp_bytes, 1
    if final == 1:
        decided = size
    elif synchronised == 1:
        return end_of_last, 1, row_count, lost_count
    else:
        decided = max(end_of_last, at - stamp_bytes)
    if decided > end_of_last:
        lost[lost_count, 0], lost[lost_count, 1] = end_of_last, decided
        lost[lost_count, 2] = _why(block, end_of_last + stamp_bytes, size)
        lost_count += 1
    return decided, 1 if decided == end_of_last else 0, row_count, lost_count


@kernel
def gather_payloads(block: Bytes, begins: Indices, lengths: Indices, payloads: Bytes) -> None:
    """Copy payloads into the rows of an array of zeros (n, width), as far as they reach."""
    width = payloads.shape[1]
    for row in range(len(begins)):
        for column in range(min(lengths[row], width)):
            payloads[row, column] = block[begins[row] + column]
