"""Recordings of NMEA 0183 sentences."""

from pathlib import Path

import numpy as np

from uavkit.core.flight_log import FlightLog
from uavkit.core.progress import Progress
from uavkit.formats.receiver_log import read_receiver_log
from uavkit.formats.receiver_stream import NMEA, UBX, messages_of

_LEAST_SHARE = 0.05


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file hold NMEA sentences, with or without checksums, and no u-blox frame."""
    for unchecked in (False, True):
        found = messages_of(head, unchecked)
        if np.any(found.kinds == UBX):
            return False
        sentences = found.places[found.kinds == NMEA]
        if len(sentences) and int(found.places[:, 1].sum()) >= _LEAST_SHARE * len(head):
            return True
    return False


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a recording: positions with the times, heights and sigmas that its sentences tell.

    Raises InputError where the file cannot be read or holds no intact message.
    """
    return read_receiver_log(path, progress)
