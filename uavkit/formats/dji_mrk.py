"""DJI's Timestamp.MRK: the exposures of a flight as the drone's RTK receiver marked them.

A line for each exposure, separated by tabs (user manuals of Zenmuse P1, Matrice 4 and Mavic 3 Multispectral, "Image
Log File")::

    1  400373.488877  [2264]  -40,N  0,E  86,V  44.42824637,Lat  1.26196331,Lon  359.494,Ellh  0.028, 0.031, 0.055  16,Q

number, GPS seconds of week, GPS week, compensation from the antenna's phase centre to the middle of the camera's
sensor (mm; north, east, and *down* positive), latitude and longitude "after compensation" in degrees, ellipsoidal
height, standard deviations north, east, vertical (m), and the state: 0 none, 16 single, 32 to 49 float, 50 fixed.

So the position is the camera's already, and nothing is added to it: it stands in the table of exposures. The table of
fixes holds the antenna's, with the compensation taken off, so that a lever arm which is applied to fixes holds here
too. The first firmwares wrote no week: then GPS time is unknown, and seconds of week stand as the boot clock.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    ExposureKind,
    FixType,
    FlightLog,
    LogKind,
    Stamps,
    exposure_table,
    fix_table,
    no_attitudes,
    no_fixes,
)
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.core.progress import Progress
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.log_lines import Columns, head_text, is_place, lines_of, nanoseconds, number, reported

_REAL = r"([+-]?\d{1,12}(?:\.\d{1,12})?)"
_LINE = re.compile(
    rf"\s*(\d{{1,9}})\s+(\d{{1,6}}(?:\.\d{{1,12}})?)\s+(?:\[\s*(\d{{1,4}})\s*\]\s+)?"
    rf"{_REAL},\s*N\s+{_REAL},\s*E\s+{_REAL},\s*V\s+{_REAL},\s*Lat\s+{_REAL},\s*Lon\s+{_REAL},\s*Ellh\s+"
    rf"{_REAL},\s*{_REAL},\s*{_REAL}\s+(\d{{1,3}}),\s*Q\s*"
)
_MARK = re.compile(r",\s*Lat\s+[^\n]{1,40},\s*Lon\s+[^\n]{1,40},\s*Ellh\b")
_NUMBERS = ("north_mm", "east_mm", "down_mm", "latitude", "longitude", "height", "sigma_n", "sigma_e", "sigma_v", "q")
_DEG_OF_MM = 180.0 / np.pi / 6_378_137_000.0
"""Latitude of a millimetre; that the earth's radius differs by 0.7 % counts for 2 mm on a lever arm of 0.3 m."""


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file are of an MRK."""
    return _MARK.search(head_text(head)) is not None


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read the exposures of an MRK; lines that are none are counted as damage, and an error where all are."""
    rows, tally = Columns(_NUMBERS, ("sequence", "tow_ns", "week")), DamageTally()
    with opened(path) as stream:
        for line in reported(lines_of(stream), path, progress):
            if not line.text.strip():
                continue
            if (fault := _take(line.text, rows)) is not None:
                tally.add(line.offset, line.length, fault)
    if not len(rows):
        raise InputError(f"{path}: no line of a DJI MRK in it: give the file whose name ends with _Timestamp.MRK")
    return _log(path, rows, tally)


def _take(text: str, rows: Columns) -> str | None:
    """Add the row of a line, or return why there is none."""
    found = _LINE.fullmatch(text)
    if found is None:
        return "no line of an MRK"
    values = dict(zip(_NUMBERS, map(number, found.groups()[3:]), strict=True))
    tow_ns = nanoseconds(found[2])
    if tow_ns is None or tow_ns >= WEEK_NS:
        return f"second {found[2]} of a week of 604800"
    if not is_place(values["latitude"], values["longitude"]):
        return "no place on earth"
    rows.add(sequence=int(found[1]), tow_ns=tow_ns, week=int(found[3]) if found[3] else None, **values)
    return None


def _log(path: Path, rows: Columns, tally: DamageTally) -> FlightLog:
    when, known = _stamps(rows), _positioned(rows)
    latitude, longitude, height = (
        np.where(known, rows.numbers(name), np.nan) for name in ("latitude", "longitude", "height")
    )
    exposures = exposure_table(
        when,
        ExposureKind.MARK,
        sequence=rows.integers("sequence"),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_ellipsoid_m=height,
    )
    sigma = {name: _sigma(np.where(known, rows.numbers(name), np.nan)) for name in ("sigma_n", "sigma_e", "sigma_v")}
    fixes = fix_table(
        when,
        latitude - rows.numbers("north_mm") * _DEG_OF_MM,
        longitude - rows.numbers("east_mm") * _DEG_OF_MM / np.maximum(np.cos(np.radians(latitude)), 1e-6),
        height_ellipsoid_m=height + rows.numbers("down_mm") * 1e-3,
        sigma_horizontal_m=np.sqrt((sigma["sigma_n"] ** 2 + sigma["sigma_e"] ** 2) / 2.0),
        sigma_vertical_m=sigma["sigma_v"],
        fix_type=_fix_types(rows.numbers("q")),
    )
    return FlightLog(
        source=str(path),
        kind=LogKind.DJI_MRK,
        vehicle="DJI",
        fix_table=fixes,
        estimate_table=no_fixes(),
        attitude_table=no_attitudes(),
        exposure_table=exposures,
        message_counts={"MRK": len(rows)},
        damage=tally.result(),
        notes=_notes(rows, known),
    )


def _stamps(rows: Columns) -> Stamps:
    """Return GPS times; of lines without a week the seconds of week, as a clock of its own."""
    week, tow_ns = rows.integers("week"), rows.integers("tow_ns")
    known = week >= 0
    gps_ns = np.where(known, np.where(known, week, 0) * WEEK_NS + tow_ns, NO_TIME)
    return Stamps.of(len(rows), gps_ns=gps_ns, boot_ns=np.where(known, NO_TIME, tow_ns))


def _positioned(rows: Columns) -> NDArray[np.bool_]:
    """Tell the rows with a position: without one DJI writes zeros, or the state 0."""
    zero = (rows.numbers("latitude") == 0.0) & (rows.numbers("longitude") == 0.0)
    return np.asarray(~zero & (rows.numbers("q") > 0), dtype=np.bool_)


def _sigma(stated_m: Array) -> Array:
    return np.where(stated_m > 0.0, stated_m, np.nan)


def _fix_types(q: Array) -> NDArray[np.uint8]:
    """Return FixType of DJI's states: 0 none, 16 single, 32 to 49 float, from 50 fixed."""
    types = np.full(len(q), FixType.THREE_DIMENSIONAL, dtype=np.uint8)
    types[q == 0] = FixType.NO_FIX
    types[(q >= 32) & (q < 50)] = FixType.RTK_FLOAT
    types[q >= 50] = FixType.RTK_FIXED
    return types


def _notes(rows: Columns, known: NDArray[np.bool_]) -> tuple[str, ...]:
    offsets = np.column_stack([rows.numbers(name) for name in ("north_mm", "east_mm", "down_mm")])
    longest_mm = float(np.sqrt((offsets**2).sum(axis=1)).max())
    notes = [
        f"positions of exposures are the camera's: DJI has added its compensation (up to {longest_mm:.0f} mm); fixes "
        "are the antenna's, without it"
    ]
    if np.any(rows.integers("week") < 0):
        notes.append("lines without a GPS week: their second of week stands as the boot clock, GPS time is unknown")
    if not np.all(known):
        notes.append(f"{int(np.sum(~known))} exposures without a position")
    return tuple(notes)
