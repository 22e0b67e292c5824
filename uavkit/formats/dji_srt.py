"""DJI's video subtitles: position, heights and attitude beside the pictures of a video.

The maker publishes no format; what stands here was learnt from files of many models (the collection of the project
DJI_SRT_Parser, MIT). A subtitle is a number, a line of times in the video, and text of one of these forms::

    HOME(149.0251,-20.2532) 2017.8.5 14:11:51                 older: one a second
    GPS(149.0251,-20.2533,16) BAROMETER:1.9                   longitude, latitude, satellites; Hb, or "H 85.80m"
    ... F.PRY (2.7°, -7.0°, 110.1°), G.PRY (...)              aircraft (pitch, roll, yaw) and gimbal
    GPS(36.6146,-6.1120,0.0M)                                 with an M: latitude, longitude, height
    [latitude: 41.424724] [longitude: 2.234156] [rel_alt: 1.3 abs_alt: 65.4]      newer: one a frame
    [latitude : -20.2533] [longtitude : 149.0251]             (sic); some have no line of times

What the fields become: ``rel_alt``, BAROMETER, Hb, H are heights above home; ``abs_alt`` is the barometer's height
added to the take-off point's height above sea level, so a geoid height of some metres; ``altitude`` and the M height
are of no stated datum and are left out; ``rtk_flag`` and ``rtk_std_*`` are type of fix and sigma.

Time: dates are of the aircraft's local clock, whose zone is nowhere written. So no GPS time is claimed: the boot clock
is the time in the video (of the subtitle's begin), and the local dates are told in the notes.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Indices
from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    AttitudeTable,
    FixTable,
    FixType,
    FlightLog,
    LogKind,
    Stamps,
    attitude_table,
    fix_table,
    no_exposures,
    no_fixes,
)
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import Progress
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.log_lines import Columns, Line, head_text, is_place, lines_of, number, reported

MOST_LINES = 30
"""Of a subtitle; what is longer is none of DJI's."""
_TIMES = re.compile(r"\s*(\d{1,3}):([0-5]\d):([0-5]\d)[,.](\d{3})\s*-->\s*\d{1,3}:[0-5]\d:[0-5]\d[,.]\d{3}\s*")
_COUNT = re.compile(r"\s*\d{1,9}\s*")
_DATE = re.compile(
    r"\b(\d{4})[-.](\d{1,2})[-.](\d{1,2}) (\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d{3})(?:[.,]?(\d{3}))?)?(?!\d)"
)
_BRACKETS = re.compile(r"\[([^\[\]]{1,400})\]")
_PAIR = re.compile(r"([A-Za-z_][\w.]{0,40})\s{0,4}:\s{0,4}([^\s,\]]{1,40})")
_BARE = re.compile(r"\b(BAROMETER|Hb|ISO)\s?:?\s?([-+]?\d[\d.]{0,20})")
_GPS = re.compile(r"\bGPS\s?\(([^()]{0,80})\)", re.IGNORECASE)
_HEIGHT = re.compile(r"\bH (-?\d{1,6}(?:\.\d{1,6})?)m")
_ATTITUDE = re.compile(r"\bF\.PRY \(([^()]{0,80})\)")
_PLACED = re.compile(r"\bGPS\s?\(|\blatitude\s?:|\blongt?itude\s?:", re.IGNORECASE)
_OF_DJI = re.compile(
    r"\bGPS\s?\([-\d]|\[\s?latitude\s?:|\[\s?iso\s?:|\bHOME\s?\(|\b(?:Srt|Frame)Cnt\s?:|\bISO\s?:\s?\d"
)
_NO_VALUE = ("n/a", "na", "nan", "-", "null")
_ABOVE_HOME = ("rel_alt", "barometer", "hb")


@dataclass(slots=True)
class _Subtitle:
    """The lines of one, and what of it is known while they come."""

    lines: list[Line] = field(default_factory=list)
    timed: bool = False
    ended: bool = False
    """By an empty line."""


@dataclass(slots=True)
class _Found:
    """What is collected over a file."""

    rows: Columns = field(
        default_factory=lambda: Columns(
            (
                "first",
                "second",
                "latitude",
                "longitude",
                "home_m",
                "geoid_m",
                "sigma_h",
                "sigma_v",
                "satellites",
                "fix",
            ),
            ("video_ns", "local_ns"),
        )
    )
    attitudes: Columns = field(default_factory=lambda: Columns(("roll", "pitch", "yaw"), ("video_ns", "local_ns")))
    tally: DamageTally = field(default_factory=DamageTally)
    without_datum: bool = False
    timed: bool = False


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file are of DJI's subtitles."""
    lines = head_text(head).splitlines()
    timed = any(_TIMES.fullmatch(line) or (_DATE.match(line) and len(line) < 60) for line in lines)
    return timed and any(_OF_DJI.search(line) for line in lines)


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read DJI's subtitles; those that are damaged, or not DJI's, are counted, and an error where all are."""
    found, current = _Found(), _Subtitle()
    with opened(path) as stream:
        for line in reported(lines_of(stream), path, progress):
            if "\0" in line.text:
                current = _close(current, found)
                found.tally.add(line.offset, line.length, "zero bytes")
                continue
            if _begins_another(line.text, current):
                current = _close(current, found)
            _append(line, current)
    _close(current, found)
    if not len(found.rows):
        raise InputError(f"{path}: no subtitle of a DJI video in it: give the .SRT beside the video, undamaged")
    return _log(path, found)


def _begins_another(text: str, current: _Subtitle) -> bool:
    """Tell whether a line begins another subtitle: after an empty line, with a number, or with times of its own."""
    if not current.lines or not text.strip():
        return False
    if current.ended or len(current.lines) >= MOST_LINES or _COUNT.fullmatch(text):
        return True
    return current.timed and _TIMES.fullmatch(text) is not None


def _append(line: Line, current: _Subtitle) -> None:
    if line.text.strip():
        current.lines.append(line)
        current.timed |= _TIMES.fullmatch(line.text) is not None
    else:
        current.ended = bool(current.lines)


def _close(current: _Subtitle, found: _Found) -> _Subtitle:
    """Take a subtitle's row, or count its bytes as lost; return a new one."""
    if current.lines and (fault := _take("\n".join(line.text for line in current.lines), found)) is not None:
        for line in current.lines:
            found.tally.add(line.offset, line.length, fault)
    return _Subtitle()


def _take(text: str, found: _Found) -> str | None:
    """Add the rows of a subtitle's text, or return why there is none."""
    video_ns, local_ns = _video_ns(text), _local_ns(text)
    if video_ns is None and (local_ns is None or found.timed):
        return "a subtitle without its times"
    values = _fields(text)
    place = _place(text, values)
    if isinstance(place, str):
        return place
    if place is None and "iso" not in values:
        return "a subtitle without position and camera settings"
    found.timed |= video_ns is not None
    found.without_datum |= "altitude" in values or "m_height" in (place or {})
    std = {name[-3:]: value for name, value in values.items() if "rtk_std" in name}
    found.rows.add(
        video_ns=video_ns,
        local_ns=local_ns,
        home_m=next((values[name] for name in _ABOVE_HOME if name in values), None),
        geoid_m=values.get("abs_alt"),
        sigma_h=_positive(math.hypot(std.get("lat", math.nan), std.get("lon", math.nan)) / math.sqrt(2.0)),
        sigma_v=_positive(std.get("hgt", math.nan)),
        fix=_fix_type(values, place),
        **{name: value for name, value in (place or {}).items() if name != "m_height"},
    )
    _take_attitude(text, found, video_ns, local_ns)
    return None


def _video_ns(text: str) -> int | None:
    times = next((found for line in text.split("\n", 3)[:3] if (found := _TIMES.fullmatch(line))), None)
    if times is None:
        return None
    hours, minutes, seconds, milliseconds = map(int, times.groups())
    return (((hours * 60 + minutes) * 60 + seconds) * 1000 + milliseconds) * 1_000_000


def _local_ns(text: str) -> int | None:
    """Return the local date as if it were UTC, since 1970; thousandths and millionths follow commas or points."""
    found = _DATE.search(text)
    if found is None:
        return None
    try:
        moment = datetime(*map(int, found.groups()[:6]))  # type: ignore[arg-type]
    except ValueError:
        return None
    if not 1970 <= moment.year < 2200:
        return None
    seconds = round((moment - datetime(1970, 1, 1)).total_seconds())
    return (seconds * 1_000_000 + int(found[7] or 0) * 1000 + int(found[8] or 0)) * 1000


def _fields(text: str) -> dict[str, float]:
    """Return the numbers by name in small letters; in brackets, which must be closed, or after the known bare names."""
    values: dict[str, float] = {}
    for brackets in _BRACKETS.finditer(text):
        values |= {pair[1].lower(): number(pair[2].removesuffix("m")) for pair in _PAIR.finditer(brackets[1])}
    bare = _BRACKETS.sub(" ", text)
    values |= {pair[1].lower(): number(pair[2]) for pair in _BARE.finditer(bare)}
    if height := _HEIGHT.search(bare):
        values["hb"] = number(height[1])
    return values


def _place(text: str, values: Mapping[str, float]) -> dict[str, float] | str | None:
    """Return what a subtitle says of its place, None where it has no such field, or what is wrong with it."""
    if gps := _GPS.search(text):
        return _place_of_tuple(gps[1])
    longitude = values.get("longitude", values.get("longtitude"))
    if "latitude" in values and longitude is not None:
        latitude = values["latitude"]
        if math.isnan(latitude) or math.isnan(longitude) or latitude == longitude == 0.0:
            return {}
        return {"latitude": latitude, "longitude": longitude} if is_place(latitude, longitude) else "no place on earth"
    return "a position cut short" if _PLACED.search(text) else None


def _place_of_tuple(text: str) -> dict[str, float] | str:
    parts = [part.strip() for part in text.split(",")]
    if any(part.lower() in _NO_VALUE for part in parts[:2]):
        return {}
    first, second = (number(part) for part in (parts + [""])[:2])
    if math.isnan(first) or math.isnan(second) or len(parts) > 3:
        return "a position that is no numbers"
    if first == second == 0.0:
        return {}
    third = parts[2] if len(parts) == 3 else ""
    if third[-1:] in "mM" and third:
        if not is_place(first, second):
            return "no place on earth"
        return {"latitude": first, "longitude": second, "m_height": number(third[:-1])}
    if not is_place(second, first) and not is_place(first, second):
        return "no place on earth"
    return {"first": first, "second": second, "satellites": number(third)}


def _positive(value: float) -> float:
    return value if value > 0.0 else math.nan


def _fix_type(values: Mapping[str, float], place: Mapping[str, float] | None) -> int:
    """Return FixType; DJI's flag is 0 none, 16 single, 32 to 49 float, 50 fixed."""
    if not place:
        return FixType.NO_FIX
    flag = values.get("rtk_flag", math.nan)
    if math.isnan(flag):
        return FixType.UNKNOWN
    steps = ((50, FixType.RTK_FIXED), (32, FixType.RTK_FLOAT), (1, FixType.THREE_DIMENSIONAL))
    return next((kind for least, kind in steps if flag >= least), FixType.NO_FIX)


def _take_attitude(text: str, found: _Found, video_ns: int | None, local_ns: int | None) -> None:
    attitude = _ATTITUDE.search(text)
    if attitude is None:
        return
    angles = [math.radians(number(part.strip().rstrip("°\ufffd"))) for part in attitude[1].split(",")]
    if len(angles) == 3 and not any(map(math.isnan, angles)):
        pitch, roll, yaw = angles
        found.attitudes.add(pitch=pitch, roll=roll, yaw=yaw, video_ns=video_ns, local_ns=local_ns)


def _log(path: Path, found: _Found) -> FlightLog:
    rows = found.rows
    swapped = _swapped(rows)
    counts = {"subtitle": len(rows), "subtitle without position": int(np.sum(rows.numbers("fix") == FixType.NO_FIX))}
    return FlightLog(
        source=str(path),
        kind=LogKind.DJI_SRT,
        vehicle="DJI",
        fix_table=_fixes(rows, found.timed, swapped),
        estimate_table=no_fixes(),
        attitude_table=_attitudes(found, rows),
        exposure_table=no_exposures(),
        message_counts={name: count for name, count in counts.items() if count},
        damage=found.tally.result(),
        notes=_notes(found, swapped),
    )


def _swapped(rows: Columns) -> bool:
    """Tell whether GPS(...) holds latitude first: only where it is no place on earth the other way."""
    return bool(np.any(np.abs(rows.numbers("second")) > 90.0))


def _fixes(rows: Columns, timed: bool, swapped: bool) -> FixTable:
    first, second = rows.numbers("first"), rows.numbers("second")
    longitude, latitude = (second, first) if swapped else (first, second)
    named = np.isfinite(rows.numbers("latitude"))
    satellites = rows.numbers("satellites")
    told = (satellites >= 0) & (satellites < 255)
    return fix_table(
        Stamps.of(len(rows), boot_ns=_boot_ns(rows, timed, rows)),
        np.where(named, rows.numbers("latitude"), latitude),
        np.where(named, rows.numbers("longitude"), longitude),
        height_geoid_m=rows.numbers("geoid_m"),
        height_above_home_m=rows.numbers("home_m"),
        sigma_horizontal_m=rows.numbers("sigma_h"),
        sigma_vertical_m=rows.numbers("sigma_v"),
        fix_type=_bytes(rows.numbers("fix") + 0.0),
        satellites=_bytes(np.where(told, satellites, 255.0)),
    )


def _bytes(values: "np.typing.ArrayLike") -> NDArray[np.uint8]:
    return np.asarray(values).astype(np.uint8)


def _attitudes(found: _Found, rows: Columns) -> AttitudeTable:
    columns = found.attitudes
    when = Stamps.of(len(columns), boot_ns=_boot_ns(columns, found.timed, rows))
    return attitude_table(when, columns.numbers("roll"), columns.numbers("pitch"), columns.numbers("yaw"))


def _boot_ns(columns: Columns, timed: bool, rows: Columns) -> Indices:
    """Return times in the video; where no subtitle has any, local times since the first one."""
    if timed:
        return columns.integers("video_ns")
    local_ns, first_ns = columns.integers("local_ns"), rows.integers("local_ns")[0]
    return np.asarray(local_ns - first_ns, dtype=np.int64)


def _notes(found: _Found, swapped: bool) -> tuple[str, ...]:
    local = found.rows.integers("local_ns")
    local = local[local != NO_TIME]
    notes = ["the boot clock is the time in the video; GPS time is not known"]
    if not found.timed:
        notes = ["no times of the video in it: the boot clock is the local time since the first subtitle"]
    if len(local):
        begin, end = (np.datetime_as_string(np.datetime64(int(t), "ns"), unit="s") for t in (local[0], local[-1]))
        notes.append(f"local time of the aircraft, of unknown zone: {begin} to {end}")
    if np.any(np.isfinite(found.rows.numbers("geoid_m"))):
        notes.append("heights above sea level (abs_alt) are the barometer's: metres off")
    if found.without_datum:
        notes.append("heights of no stated datum (altitude) are left out")
    if swapped:
        notes.append("GPS(...) with latitude first, against DJI's usual order")
    return tuple(notes)
