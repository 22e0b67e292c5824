"""Recordings of u-blox receivers, generations 5 to 9: UBX frames, with NMEA and RTCM in between."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from uavkit.core.flight_log import FlightLog
from uavkit.core.progress import Progress
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.receiver_log import read_receiver_log
from uavkit.formats.receiver_stream import UBX, batches, messages_of
from uavkit.formats.ubx_messages import RAW_MEASUREMENTS

_LEAST_SHARE = 0.05
"""Of the head that intact messages fill: other logs hold single frames as data."""


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file hold u-blox frames and are a receiver's stream."""
    found = messages_of(head)
    return bool(np.any(found.kinds == UBX)) and int(found.places[:, 1].sum()) >= _LEAST_SHARE * len(head)


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a recording: positions, time marks as exposures, counts of all messages.

    NMEA's positions are used only where no UBX message has one. Raises InputError where the file cannot be read or
    holds no intact message.
    """
    return read_receiver_log(path, progress)


def raw_measurements(path: Path) -> Iterator[bytes]:
    """Yield the whole frames of raw measurements and broadcast subframes (RXM-RAW, RAWX, MEASX, SFRB, SFRBX).

    Written one after another to a file they are a UBX stream that RINEX converters read. Raises InputError where the
    file cannot be read.
    """
    with opened(path) as stream:
        for batch in batches(stream, DamageTally()):
            chosen = (batch.kinds == UBX) & np.isin(batch.codes, RAW_MEASUREMENTS)
            for begin, length in batch.places[chosen].tolist():
                yield batch.block[begin : begin + length].tobytes()
