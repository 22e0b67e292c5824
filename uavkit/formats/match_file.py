"""Which image belongs to which exposure, as a CSV that the tool writes and the user may edit.

::

    # uavkit match
    image,event,gps_time,state,probability,reason
    DSC00001.JPG,flight.BIN 12,1412345678.123456789,matched,0.99993,

``image`` and ``event`` are needed, the rest is for the reader. ``event`` is an event's label, its number among all
(from 1), a GPS time in seconds since 1980-01-06 (with a decimal point), or ``none``; a row that is empty there leaves
the tool's own decision.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uavkit.core.errors import InputError, did_you_mean
from uavkit.formats.atomic import write_text
from uavkit.formats.commented_csv import comment_keys, rows_of_cells, text_lines

COLUMNS = ("image", "event", "gps_time", "state", "probability", "reason")
NONE = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchRow:
    """One image and what the file says of it."""

    image: str
    event: str
    """Label, number, GPS time or "none"; empty where the file leaves it open."""
    gps_time: str = ""
    """Seconds since 1980-01-06, for the reader."""
    state: str = ""
    probability: str = ""
    reason: str = ""
    line: int = 0
    """In the file, 0 if of none."""


def read_matches(path: Path) -> tuple[MatchRow, ...]:
    """Read the rows; raises InputError naming file and line for whatever cannot be understood."""
    lines = text_lines(path)
    comment_keys(path, lines, ())
    rows = [
        MatchRow(**{name: cells.get(name, "") for name in COLUMNS}, line=number)
        for number, cells in rows_of_cells(path, lines, _check_header)
    ]
    if not rows:
        raise InputError(f"{path}: the file holds no row below its header {','.join(COLUMNS[:2])}")
    first: dict[str, int] = {}
    for row in rows:
        if not row.image:
            raise InputError(f"{path}: line {row.line} names no image")
        if first.setdefault(row.image.casefold(), row.line) != row.line:
            before = first[row.image.casefold()]
            raise InputError(f"{path}: lines {before} and {row.line} both tell of {row.image}: remove one of them")
    return tuple(rows)


def write_matches(path: Path, rows: Sequence[MatchRow], remarks: Sequence[str] = ()) -> None:
    """Write the CSV, whole or not at all; remarks stand at its end as comments, which are not read."""
    stream = io.StringIO()
    stream.write("# uavkit match\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([getattr(row, name) for name in COLUMNS])
    stream.writelines(f"# {' '.join(remark.split())}\n" for remark in remarks)
    write_text(path, stream.getvalue())


def _check_header(where: str, header: list[str]) -> None:
    """Refuse a header with unknown, doubled or missing columns."""
    for name in header:
        if name not in COLUMNS:
            raise InputError(f"{where}: unknown column {name!r}{did_you_mean(name, COLUMNS)}")
    if len(set(header)) != len(header):
        raise InputError(f"{where}: a column stands there twice")
    missing = [name for name in COLUMNS[:2] if name not in header]
    if missing:
        raise InputError(f"{where}: the header misses {' and '.join(missing)}; it needs {','.join(COLUMNS[:2])}")
