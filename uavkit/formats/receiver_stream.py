"""The stream of a GNSS receiver, in blocks: which messages are in it, and what is lost between them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.formats.kernels.ubx_frames import (
    NMEA,
    RTCM3,
    UBX,
    Found,
    Sums,
    crc24q_powers,
    crc24q_table,
    running_sums,
    scan,
)
from uavkit.formats.log_bytes import Blocks, DamageTally

BLOCK_BYTES = 1024 * 1024
MOST_AT_ONCE = 65_536
"""Messages of one batch."""
HEAD_BYTES = 64 * 1024
"""From which it is decided whether sentences without a checksum are usual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Some of the messages of a stream, in its order."""

    block: NDArray[np.uint8]
    offset: int
    """Of the block in the stream."""
    kinds: NDArray[np.uint8]
    """(n,) UBX, NMEA or RTCM3."""
    places: NDArray[np.int64]
    """(n, 2) begin and length in the block."""
    codes: NDArray[np.int64]
    """(n,) as ``uavkit.formats.kernels.ubx_frames.scan`` gives them."""

    def frames(self, code: int, least_payload: int) -> tuple[NDArray[np.uint8], Indices, Indices]:
        """Return payloads of the u-blox frames of a code, (m, least_payload), their payload lengths and offsets, (m,).

        Frames with a shorter payload are left out, longer ones are cut.
        """
        chosen = (self.kinds == UBX) & (self.codes == code) & (self.places[:, 1] >= least_payload + 8)
        places = self.places[chosen]
        rows = self.block[places[:, :1] + 6 + np.arange(least_payload)]
        return rows, places[:, 1] - 8, places[:, 0] + self.offset

    def named(self) -> Iterator[tuple[int, int, int]]:
        """Yield kind, code and count of the messages that are in it."""
        keys, counts = np.unique(self.codes * 4 + self.kinds, return_counts=True)
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            yield key & 3, key >> 2, count


def batches(stream: BinaryIO, tally: DamageTally, block_bytes: int = BLOCK_BYTES) -> Iterator[Batch]:
    """Yield the intact messages of a stream that stands at its beginning, and count what lies between them as lost.

    Sentences without a checksum count only in a stream whose head has none with one: elsewhere they are cut ones.
    """
    unchecked = not has_checked_sentences(stream.read(HEAD_BYTES))
    stream.seek(0)
    blocks, consumed, lost_from = Blocks(stream, block_bytes), 0, 0
    tables = _crc_tables()
    while (block := blocks.next(consumed)) is not None:
        sums = _sums(block, tables)
        consumed, more = 0, False
        while consumed < len(block) and not more:
            found = _room(min(MOST_AT_ONCE, (len(block) - consumed) // 6 + 1))
            consumed, count, more = scan(block, consumed, blocks.final, unchecked, sums, found)
            batch = _batch(block, blocks.offset, found, count)
            lost_from = _count_gaps(batch, lost_from, blocks.offset + consumed, tally)
            if count:
                yield batch


Tables = tuple[NDArray[np.uint32], NDArray[np.uint32]]


def _crc_tables() -> Tables:
    table = crc24q_table()
    return table, crc24q_powers(table)


def _sums(block: NDArray[np.uint8], tables: Tables) -> Sums:
    plain, weighted = running_sums(block)
    crc, until = np.empty(len(block) + 1, dtype=np.uint32), np.full(1, -1, dtype=np.int64)
    return Sums(plain=plain, weighted=weighted, crc=crc, crc_until=until, table=tables[0], powers=tables[1])


def _room(count: int) -> Found:
    return Found(
        kinds=np.empty(count, dtype=np.uint8),
        places=np.empty((count, 2), dtype=np.int64),
        codes=np.empty(count, dtype=np.int64),
    )


def _batch(block: NDArray[np.uint8], offset: int, found: Found, count: int) -> Batch:
    return Batch(
        block=block,
        offset=offset,
        kinds=found.kinds[:count],
        places=found.places[:count],
        codes=found.codes[:count],
    )


def _count_gaps(batch: Batch, lost_from: int, decided: int, tally: DamageTally) -> int:
    """Count what lies before, between and behind the messages of a batch; return where the next gap would begin."""
    begins = np.append(batch.places[:, 0] + batch.offset, decided)
    ends = np.append(lost_from, batch.places.sum(axis=1) + batch.offset)
    for row in np.flatnonzero(begins > ends).tolist():
        begin, end = int(ends[row]), int(begins[row])
        head = batch.block[begin - batch.offset : begin - batch.offset + 4].tobytes()
        tally.add(begin, end - begin, _why(head))
    return decided


def _why(head: bytes) -> str:
    if head.startswith(b"\xb5b"):
        return "u-blox frame cut short or with a wrong checksum"
    if head.startswith(b"$"):
        return "NMEA sentence cut short or with a wrong checksum"
    if head.startswith(b"\xd3"):
        return "RTCM frame cut short or with a wrong checksum"
    return "zeros" if not head.strip(b"\0") else "no beginning of a message"


def messages_of(head: bytes, unchecked: bool = False) -> Batch:
    """Return the intact messages of the first bytes of a stream; ``unchecked`` as in ``scan``."""
    block = np.frombuffer(head, dtype=np.uint8)
    found = _room(len(block) // 6 + 1)
    _, count, _ = scan(block, 0, True, unchecked, _sums(block, _crc_tables()), found)
    return _batch(block, 0, found, count)


def has_checked_sentences(head: bytes) -> bool:
    """Tell whether there is an NMEA sentence with a right checksum."""
    return bool(np.any(messages_of(head).kinds == NMEA))


def name_of_sentence(code: int) -> str:
    """Return the address of a sentence."""
    return int(code).to_bytes(8, "little").rstrip(b"\0").decode("ascii", "replace")


def name_of_rtcm(code: int) -> str:
    """Return the name of an RTCM 3 message."""
    return f"RTCM {code}" if code else "RTCM"


__all__ = [
    "NMEA",
    "RTCM3",
    "UBX",
    "Batch",
    "batches",
    "has_checked_sentences",
    "messages_of",
    "name_of_rtcm",
    "name_of_sentence",
]
