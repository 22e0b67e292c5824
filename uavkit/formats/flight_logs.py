"""Flight logs of any kind, recognised by their content."""

from pathlib import Path
from typing import Protocol

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog, LogKind
from uavkit.core.progress import Progress, silent
from uavkit.formats.log_bytes import check_is_file, opened

HEAD_BYTES = 64 * 1024
"""What a reader sees to recognise its kind; zeros at the beginning of a file are left out."""
_BLOCK_BYTES = 4 * 1024 * 1024


class LogReader(Protocol):
    """What each module that reads a kind of log offers."""

    def recognises(self, head: bytes) -> bool:
        """Tell whether the first bytes of a file are of this kind; damaged ones may stand before intact ones."""

    def read_log(self, path: Path, progress: Progress) -> FlightLog:
        """Read a file; damage is counted, and InputError raised where nothing of use is in it."""


def open_log(path: Path, progress: Progress = silent) -> FlightLog:
    """Read a flight log of whatever kind; its name does not matter.

    Raises InputError where the file cannot be read, is empty, or is of no kind that is known.
    """
    head = _head(path)
    reader = next((reader for reader in _readers() if reader.recognises(head)), None)
    if reader is None:
        kinds = ", ".join(kind.value for kind in LogKind)
        raise InputError(f"{path}: {_what_it_is(head)}, no flight log of a known kind ({kinds})")
    return reader.read_log(path, progress)


def _readers() -> tuple[LogReader, ...]:
    """Return the readers, those whose marks are surest first."""
    from uavkit.formats import csv_log, dataflash, dataflash_text, dji_mrk, dji_srt, gpx, kml_log, nmea, tlog, ubx, ulog

    return (ulog, dataflash, tlog, ubx, kml_log, gpx, dji_srt, dji_mrk, dataflash_text, nmea, csv_log)


def _head(path: Path) -> bytes:
    """Return the first bytes from the first that is not zero."""
    check_is_file(path, "a folder: give the log file in it")
    zeros = bytes(_BLOCK_BYTES)
    with opened(path) as stream:
        while block := stream.read(_BLOCK_BYTES):
            if block != zeros[: len(block)]:
                rest = block.lstrip(b"\0")[:HEAD_BYTES]
                return rest + stream.read(HEAD_BYTES - len(rest))
        if stream.tell() == 0:
            raise InputError(f"{path}: the file is empty: download it again")
    raise InputError(f"{path}: the file holds nothing but zeros: download it again")


def _what_it_is(head: bytes) -> str:
    known = {
        b"\xff\xd8\xff": "this is a JPEG picture",
        b"II*\0": "this is a TIFF picture",
        b"MM\0*": "this is a TIFF picture",
        b"\x89PNG": "this is a PNG picture",
        b"PK\x03\x04": "this is a zip archive",
        b"\x1f\x8b": "this is a gzip archive",
        b"%PDF": "this is a PDF document",
        b"RIFF": "this is a video or sound file",
    }
    named = next((what for mark, what in known.items() if head.startswith(mark)), "")
    if named:
        return named
    text = sum(32 <= byte < 127 or byte in (9, 10, 13) for byte in head)
    return "this is text" if text > 0.95 * len(head) else "these are bytes of an unknown kind"
