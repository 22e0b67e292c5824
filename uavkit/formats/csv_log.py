"""Tables of a flight as CSV: those that ``log_export`` writes, and any other whose columns are declared beside it.

The declaration is described in ``csv_mapping``. Lines before the header that begin with # or % are passed over.
Decimals have points. An empty cell is unknown. A line that cannot be understood is counted as lost.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path

import numpy as np

from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.flight_log import (
    AttitudeTable,
    ExposureKind,
    ExposureTable,
    FixTable,
    FlightLog,
    LogKind,
    no_attitudes,
    no_exposures,
    no_fixes,
)
from uavkit.core.gpstime import NO_TIME, WEEK_NS, gps_times_ns_from_unix_ns
from uavkit.core.progress import Progress
from uavkit.formats.csv_mapping import (
    CLOCKS,
    DEGREES,
    CsvMapping,
    cells_of,
    check_mapping,
    given_columns,
    header_of_table,
    mapping_to_write,
)
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.log_lines import (
    Columns,
    Line,
    gps_time_of,
    head_text,
    is_place,
    lines_of,
    nanoseconds,
    number,
    reported,
)
from uavkit.formats.log_tables import (
    CODES,
    MARK,
    NAMES,
    NUMBERS,
    TIMES,
    UNKNOWN_CODE,
    Role,
    Table,
    TableColumns,
    table_from,
    unescaped,
)
from uavkit.formats.options_file import read_toml

_MOST_LINES_BEFORE = 200
_UNKNOWN = ("", "nan", "null", "none", "n/a", "-")
_SCALES = {"gps_s": 9, "gps_time_ns": 0, "unix_s": 9, "unix_ms": 6, "boot_time_ns": 0, "host_time_ns": 0}
"""Digits of a nanosecond behind the point."""
_LARGEST_WEEK = 9999


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """How a line becomes a row."""

    role: Role
    separator: str
    cells: int
    """Of a line."""
    place: Mapping[str, int]
    """Of each field in the line."""
    escaped: bool
    """Whether names are written as ``log_export`` does."""
    kind: int

    def numbers(self) -> tuple[tuple[str, int], ...]:
        """Return the fields that are numbers, with their places."""
        fields = (*NUMBERS[self.role], *DEGREES)
        return tuple((name, self.place[name]) for name in fields if name in self.place)


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file are of a CSV: of ``log_export``, or names above numbers."""
    text = head_text(head)
    return text.startswith(MARK) or header_of_table(text) is not None


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a CSV of ``log_export``, or one with its declaration beside it, named like it with .toml behind.

    Raises InputError where there is none, with one to begin with.
    """
    with opened(path) as stream:
        head = head_text(stream.read(64 * 1024))
    beside = path.with_name(path.name + ".toml")
    if head.startswith(MARK):
        return _read(path, None, progress)
    if beside.is_file():
        return read_csv_log(path, beside, progress)
    raise InputError(mapping_to_write(path, beside, header_of_table(head)))


def read_csv_log(path: Path, mapping_path: Path, progress: Progress) -> FlightLog:
    """Read a CSV whose columns a TOML file declares; raises InputError naming what in either does not fit."""
    mapping = read_toml(mapping_path, CsvMapping)
    check_mapping(mapping, mapping_path)
    return _read(path, (mapping, mapping_path), progress)


def _read(path: Path, declared: tuple[CsvMapping, Path] | None, progress: Progress) -> FlightLog:
    tally, first_fault = DamageTally(), ""
    with opened(path) as stream:
        lines = lines_of(stream)
        comments, header = _header(path, lines)
        plan, notes = _own_plan(path, comments, header) if declared is None else _plan(path, *declared, header)
        rows = _Rows(plan)
        for line in reported(lines, path, progress):
            if line.text.strip() and (fault := rows.take(line.text)) is not None:
                tally.add(line.offset, line.length, fault)
                first_fault = first_fault or f": {fault}"
    if not len(rows.columns):
        raise InputError(f"{path}: no line below the header can be read{first_fault}")
    return _log(path, rows, tally, (_vehicle(comments), notes))


def _header(path: Path, lines: Iterator[Line]) -> tuple[list[str], str]:
    """Return the comments before the header, and the header."""
    comments: list[str] = []
    for line in lines:
        if line.text.strip(" ,;\t") and not line.text.startswith(("#", "%")):
            return comments, line.text
        comments.append(line.text)
        if len(comments) > _MOST_LINES_BEFORE:
            break
    raise InputError(f"{path}: no line with the names of columns in it: the file is empty, or no CSV")


def _vehicle(comments: Sequence[str]) -> str:
    return next((text[11:].strip() for text in comments if text.startswith("# vehicle: ")), "")


def _own_plan(path: Path, comments: Sequence[str], header: str) -> tuple[_Plan, tuple[str, ...]]:
    """Return how to read what ``log_export`` wrote; columns that it did not are passed over."""
    word = comments[0].removeprefix(MARK).strip() if comments else ""
    roles = {role.value: role for role in Role}
    if word not in roles:
        raise InputError(f"{path}: line 1: {word!r} is none of {', '.join(roles)}{did_you_mean(word, roles)}")
    role, names = roles[word], cells_of(header, ",")
    known = (*TIMES, *NUMBERS[role], *CODES[role], "name")
    place = {name: number for number, name in enumerate(names) if name in known}
    if not set(place) & {*NUMBERS[role], *TIMES} or len(place) < sum(name in known for name in names):
        raise InputError(f"{path}: the header {header[:80]!r} does not name the columns of {word}: export it again")
    others = [name for name in names if name not in known and name != "utc"]
    notes = (f"columns passed over: {', '.join(others)}",) if others else ()
    kind = int(ExposureKind.CAPTURED)
    return _Plan(role=role, separator=",", cells=len(names), place=place, escaped=True, kind=kind), notes


def _plan(path: Path, mapping: CsvMapping, where: Path, header: str) -> tuple[_Plan, tuple[str, ...]]:
    """Return how to read a declared CSV; raises InputError where it has not the columns that are declared."""
    names = cells_of(header, mapping.separator)
    given = given_columns(mapping)
    for field, column in given.items():
        if names.count(column) != 1:
            what = f"{names.count(column)} columns" if column in names else "no column"
            hint = did_you_mean(column, names) if column not in names else ": rename one of them"
            raise InputError(f"{where}: [columns] {field}: {path.name} has {what} {column!r}{hint}")
    plan = _Plan(
        role=Role(mapping.role),
        separator=mapping.separator,
        cells=len(names),
        place={field: names.index(column) for field, column in given.items()},
        escaped=False,
        kind=int(ExposureKind[mapping.exposure_kind.upper()]),
    )
    return plan, ()


class _FaultError(Exception):
    """What is wrong with a line."""


class _Rows:
    """The rows of a table, as they come."""

    def __init__(self, plan: _Plan) -> None:
        self.plan = plan
        self.columns = Columns(NUMBERS[plan.role], ("gps", "unix", "boot", "host", *CODES[plan.role]))
        self.names: list[str] = []
        self._numbers = plan.numbers()

    def take(self, text: str) -> str | None:
        """Add the row of a line, or return what is wrong with it."""
        cells = cells_of(text, self.plan.separator)
        if len(cells) != self.plan.cells:
            return f"{len(cells)} cells, not {self.plan.cells} as in the header"
        try:
            values = self._values(cells) | self._times(cells) | self._codes(cells)
        except _FaultError as fault:
            return str(fault)
        self.columns.add(**values)
        if "name" in self.plan.place:
            name = cells[self.plan.place["name"]]
            self.names.append(unescaped(name) if self.plan.escaped else name)
        return None

    def _values(self, cells: Sequence[str]) -> dict[str, float | None]:
        values: dict[str, float | None] = {}
        for field, place in self._numbers:
            text = cells[place]
            value = number(text)
            if math.isnan(value) and text.lower() not in _UNKNOWN:
                raise _FaultError(f"{field} is {text[:30]!r}, not a number with a decimal point")
            values[DEGREES.get(field, field)] = math.radians(value) if field in DEGREES else value
        latitude, longitude = (values.get(name, math.nan) or 0.0 for name in ("latitude_deg", "longitude_deg"))
        if math.isnan(latitude) != math.isnan(longitude):
            raise _FaultError("latitude without longitude, or longitude without latitude")
        if not math.isnan(latitude) and not is_place(latitude, longitude):
            raise _FaultError(f"latitude {latitude:g}, longitude {longitude:g} is no place on earth")
        return values

    def _times(self, cells: Sequence[str]) -> dict[str, float | None]:
        place = self.plan.place
        texts = {name: cells[place[name]] for name in (*CLOCKS, "boot_s", *TIMES) if name in place}
        times: dict[str, float | None] = {}
        for name, text in texts.items():
            if text.lower() in _UNKNOWN:
                continue
            value = gps_time_of(text, UTC) if name == "utc" else nanoseconds(text, _SCALES.get(name, 9))
            if value is None:
                raise _FaultError(f"{name} is {text[:40]!r}: no such time")
            times[_TARGETS[name]] = value
        return _with_week(times)

    def _codes(self, cells: Sequence[str]) -> dict[str, float | None]:
        codes: dict[str, float | None] = {}
        for name in CODES[self.plan.role]:
            text = cells[self.plan.place[name]].lower() if name in self.plan.place else ""
            if text in _UNKNOWN:
                codes[name] = self.plan.kind if name == "kind" else UNKNOWN_CODE.get(name, 0)
            else:
                codes[name] = _code(name, text)
        return codes

    def result(self) -> Table:
        """Return the table."""
        columns, role = self.columns, self.plan.role
        gps_ns, unix_ns = columns.integers("gps"), columns.integers("unix")
        gps_ns = np.where(gps_ns == NO_TIME, gps_times_ns_from_unix_ns(unix_ns), gps_ns)
        clocks = (gps_ns, columns.integers("boot"), columns.integers("host"))
        plain = TableColumns(
            times=dict(zip(TIMES, clocks, strict=True)),
            numbers={name: columns.numbers(name) for name in NUMBERS[role]},
            codes={name: columns.integers(name) for name in CODES[role]},
            names=tuple(self.names),
        )
        return table_from(plain, role)


_TARGETS = {
    "gps_week": "week", "gps_seconds_of_week": "tow", "gps_s": "gps", "gps_time_ns": "gps", "utc": "gps",
    "unix_s": "unix", "unix_ms": "unix", "boot_s": "boot", "boot_time_ns": "boot", "host_time_ns": "host",
}  # fmt: skip


def _with_week(times: dict[str, float | None]) -> dict[str, float | None]:
    """Return times with week and second of week as GPS time; raises _FaultError where they are none."""
    week_ns, tow_ns = times.pop("week", None), times.pop("tow", None)
    if (week_ns is None) != (tow_ns is None):
        raise _FaultError("a GPS week without its second, or a second without its week")
    if week_ns is not None and tow_ns is not None:
        week, part = divmod(int(week_ns), 1_000_000_000)
        if part or not 0 <= week <= _LARGEST_WEEK or not 0 <= tow_ns < WEEK_NS:
            raise _FaultError(f"GPS week {int(week_ns) * 1e-9:g}, second {tow_ns * 1e-9:g}: no such time")
        times["gps"] = week * WEEK_NS + int(tow_ns)
    return times


_MEMBERS = {
    name: {text: int(member) for member in members for text in (member.name.lower(), str(int(member)))}
    for name, members in NAMES.items()
}
_LARGEST = {"satellites": 255, "receiver": 255}


def _code(name: str, text: str) -> int:
    whole = int(text) if re.fullmatch(r"[0-9]{1,18}", text) else -1
    code = _MEMBERS[name].get(text, -1) if name in _MEMBERS else whole
    if not 0 <= code <= _LARGEST.get(name, 2**62):
        raise _FaultError(f"{name} is {text[:30]!r}: no such value")
    return code


def _log(path: Path, rows: _Rows, tally: DamageTally, about: tuple[str, tuple[str, ...]]) -> FlightLog:
    role, table = rows.plan.role, rows.result()
    vehicle, notes = about
    if "gps_week" in rows.plan.place and bool(np.any(rows.columns.integers("gps") < 1024 * WEEK_NS)):
        notes += ("GPS weeks below 1024 are taken as they are: of before August 1999",)
    return FlightLog(
        source=str(path),
        kind=LogKind.CSV,
        vehicle=vehicle,
        fix_table=table if role is Role.FIXES and isinstance(table, FixTable) else no_fixes(),
        estimate_table=table if role is Role.ESTIMATES and isinstance(table, FixTable) else no_fixes(),
        attitude_table=table if isinstance(table, AttitudeTable) else no_attitudes(),
        exposure_table=table if isinstance(table, ExposureTable) else no_exposures(),
        message_counts={role.value: len(table)},
        damage=tally.result(),
        notes=notes,
    )
