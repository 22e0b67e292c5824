"""Tables of flight logs as columns of plain values, for writing them and reading them back exactly.

The columns' names are the fields' with their units; times are integer ns: ``gps_time_ns`` GPS time, ``boot_time_ns``
since the vehicle's start, ``host_time_ns`` Unix time of the computer on the ground.
"""

import re
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Indices
from uavkit.core.flight_log import AttitudeTable, ExposureKind, ExposureTable, FixTable, FixType, FlightLog, Stamps
from uavkit.core.gpstime import NO_TIME, UNIX_EPOCH_NS, leap_seconds_at

Table = FixTable | AttitudeTable | ExposureTable


class Role(Enum):
    """Which table of a log."""

    FIXES = "fixes"
    ESTIMATES = "estimates"
    """The autopilot's own positions."""
    ATTITUDES = "attitudes"
    EXPOSURES = "exposures"


TIMES = ("gps_time_ns", "boot_time_ns", "host_time_ns")
HEIGHTS = ("height_ellipsoid_m", "height_geoid_m", "height_above_home_m")
PLACE = ("latitude_deg", "longitude_deg", *HEIGHTS)
VELOCITY = ("velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s")
ANGLES = ("roll_rad", "pitch_rad", "yaw_rad")
NUMBERS = {
    Role.FIXES: (*PLACE, *VELOCITY, "sigma_horizontal_m", "sigma_vertical_m"),
    Role.ESTIMATES: (*PLACE, *VELOCITY, "sigma_horizontal_m", "sigma_vertical_m"),
    Role.ATTITUDES: ANGLES,
    Role.EXPOSURES: ("sigma_s", *PLACE, *ANGLES),
}
"""float64; NaN is unknown."""
CODES: dict[Role, tuple[str, ...]] = {
    Role.FIXES: ("fix_type", "satellites", "receiver"),
    Role.ESTIMATES: ("fix_type", "satellites", "receiver"),
    Role.ATTITUDES: (),
    Role.EXPOSURES: ("kind", "sequence"),
}
"""Integers."""
UNKNOWN_CODE = {"fix_type": int(FixType.UNKNOWN), "satellites": 255, "sequence": -1}
NAMES: dict[str, type[IntEnum]] = {"fix_type": FixType, "kind": ExposureKind}
"""Codes that are written as names, in small letters."""
MARK = "# uavkit flight log: "
"""Begins the first line of a table as CSV; the role follows."""
_LATEST_GPS_NS = 2**62


@dataclass(frozen=True, slots=True, kw_only=True)
class TableColumns:
    """A table's columns by name."""

    times: dict[str, Indices]
    numbers: dict[str, Array]
    codes: dict[str, Indices]
    names: tuple[str, ...] | None
    """None for tables without names."""

    def __len__(self) -> int:
        return len(self.times[TIMES[0]])


def table_of(log: FlightLog, role: Role) -> Table:
    """Return the table of a role."""
    tables: dict[Role, Table] = {
        Role.FIXES: log.fix_table,
        Role.ESTIMATES: log.estimate_table,
        Role.ATTITUDES: log.attitude_table,
        Role.EXPOSURES: log.exposure_table,
    }
    return tables[role]


def columns_of(table: Table, role: Role) -> TableColumns:
    """Return a table's columns."""
    when = table.when
    numbers = {name: _number_column(table, name) for name in NUMBERS[role]}
    return TableColumns(
        times=dict(zip(TIMES, (when.gps_ns, when.boot_ns, when.host_ns), strict=True)),
        numbers=numbers,
        codes={name: np.asarray(getattr(table, name), dtype=np.int64) for name in CODES[role]},
        names=None if isinstance(table, AttitudeTable) else table.name,
    )


def _number_column(table: Table, name: str) -> Array:
    if name in VELOCITY and isinstance(table, FixTable):
        return np.asarray(table.velocity_m_s[:, VELOCITY.index(name)], dtype=np.float64)
    return np.asarray(getattr(table, name), dtype=np.float64)


def table_from(columns: TableColumns, role: Role) -> Table:
    """Return the table of columns."""
    when = Stamps(**{_STAMPS[name]: column for name, column in columns.times.items()})
    numbers = dict(columns.numbers)
    if role is Role.ATTITUDES:
        return AttitudeTable(when=when, **numbers)
    if role is Role.EXPOSURES:
        kind = columns.codes["kind"].astype(np.uint8)
        return ExposureTable(
            when=when, kind=kind, sequence=columns.codes["sequence"], name=columns.names or (), **numbers
        )
    velocity = np.column_stack([numbers.pop(name) for name in VELOCITY])
    codes = {name: column.astype(np.uint8) for name, column in columns.codes.items()}
    return FixTable(
        when=when,
        velocity_m_s=velocity,
        fix_type=codes["fix_type"],
        satellites=codes["satellites"],
        receiver=codes["receiver"],
        name=columns.names or (),
        **numbers,
    )


_STAMPS = {"gps_time_ns": "gps_ns", "boot_time_ns": "boot_ns", "host_time_ns": "host_ns"}


def unix_ns_of(gps_ns: Indices) -> Indices:
    """Return Unix times of GPS times, (n,) ns; NO_TIME stays, and so becomes what lies beyond the year 2126."""
    gps = np.asarray(gps_ns, dtype=np.int64)
    known = (gps > -UNIX_EPOCH_NS) & (gps < _LATEST_GPS_NS)
    if not np.any(known):
        return np.full(len(gps), NO_TIME, dtype=np.int64)
    leap = (leap_seconds_at(int(gps[known].min())), leap_seconds_at(int(gps[known].max())))
    seconds: NDArray[np.int64] | int = leap[0]
    if leap[0] != leap[1]:
        seconds = np.array([leap_seconds_at(int(time)) for time in np.where(known, gps, 0)], dtype=np.int64)
    moved = np.where(known, gps, 0) + UNIX_EPOCH_NS - np.asarray(seconds) * 1_000_000_000
    return np.asarray(np.where(known, moved, NO_TIME), dtype=np.int64)


def utc_texts(gps_ns: Indices, unit: Literal["ns", "us"] = "ns") -> list[str]:
    """Return UTC of GPS times as ISO 8601 with a Z, (n,); empty where unknown."""
    unix = unix_ns_of(gps_ns)
    known = unix != NO_TIME
    stamps: NDArray[np.datetime64] = np.where(known, unix, 0).astype("datetime64[ns]")
    texts = np.datetime_as_string(stamps, unit=unit).tolist()
    return [f"{text}Z" if told else "" for text, told in zip(texts, known.tolist(), strict=True)]


def escaped(name: str) -> str:
    """Return a name without backslashes, line ends, zero bytes and blanks at its ends: each as \\uXXXXXX."""
    return re.sub(r"[\\\0-\x1f\x7f\x85\u2028\u2029]|^\s+|\s+$", _codes_of, name)


def _codes_of(found: "re.Match[str]") -> str:
    return "".join(f"\\u{ord(sign):06x}" for sign in found[0])


def unescaped(name: str) -> str:
    """Return a name as it was before ``escaped``."""
    return re.sub(r"\\u([0-9a-f]{6})", lambda found: chr(min(int(found[1], 16), 0x10FFFF)), name)
