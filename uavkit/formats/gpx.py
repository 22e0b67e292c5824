"""GPX 1.0 and 1.1: tracks as positions, waypoints (else route points) as listed exposures.

Heights: the standard says of ``ele`` only "elevation in metres". It is taken as above the geoid, for ``geoidheight``
is defined beside it as NMEA's GGA does (height of the geoid above the ellipsoid); where a file gives both, the
ellipsoidal height is their sum. Some loggers write ellipsoidal heights into ``ele``; the file does not tell.
Times are UTC by the standard; one without a zone is UTC too, a date alone is no time. ``hdop`` is a dilution, no
sigma. ``speed`` and ``course`` (GPX 1.0, or an extension) give the horizontal velocity.
https://www.topografix.com/GPX/1/1/
"""

import math
from datetime import UTC
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    ExposureKind,
    ExposureTable,
    FixTable,
    FixType,
    FlightLog,
    LogKind,
    Stamps,
    exposure_table,
    fix_table,
    no_attitudes,
    no_exposures,
    no_fixes,
)
from uavkit.core.progress import Progress
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.log_lines import Columns, gps_time_of, head_text, is_place, number, reported
from uavkit.formats.xml_records import XmlKind, XmlReader, is_xml_of, local

KIND = XmlKind(name="GPX", records=frozenset({"trkpt", "wpt", "rtept"}), resume=b"<gpx><trk><trkseg>")
_NUMBERS = ("latitude", "longitude", "elevation", "geoid", "speed", "course", "fix", "satellites")
_FIX_TYPES = {
    "none": FixType.NO_FIX,
    "2d": FixType.TWO_DIMENSIONAL,
    "3d": FixType.THREE_DIMENSIONAL,
    "dgps": FixType.DIFFERENTIAL,
    "pps": FixType.THREE_DIMENSIONAL,
}


class _Points:
    """Points of one sort."""

    def __init__(self) -> None:
        self.columns, self.names = Columns(_NUMBERS, ("gps_ns",)), list[str]()


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file are of GPX."""
    return is_xml_of(head_text(head), "gpx", "(?:trkpt|wpt|rtept)")


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a GPX file; broken points are counted as damage, and an error where none is whole."""
    tally, points = DamageTally(), {name: _Points() for name in ("trkpt", "wpt", "rtept")}
    reader = XmlReader(str(path), KIND, tally)
    first_fault = ""
    with opened(path) as stream:
        for record in reported(reader.records(stream), path, progress):
            fault = _take(record.element, points[record.element.tag])
            if fault is not None:
                tally.add(record.offset, record.length, fault)
                first_fault = first_fault or f": {fault}"
    if not any(len(sort.columns) for sort in points.values()):
        raise InputError(f"{path}: no point of a GPX track, route or waypoint in it{first_fault or _because(reader)}")
    return _log(path, points, reader, tally)


def _because(reader: XmlReader) -> str:
    return f" ({reader.fault})" if reader.fault else ""


def _take(point: ElementTree.Element, points: _Points) -> str | None:
    """Add a point's row, or return what is wrong with it."""
    latitude, longitude = number(point.get("lat", "")), number(point.get("lon", ""))
    if math.isnan(latitude) or math.isnan(longitude) or not is_place(latitude, longitude):
        return f"latitude {point.get('lat', '')[:30]!r}, longitude {point.get('lon', '')[:30]!r} is no place on earth"
    texts = {local(child.tag): (child.text or "").strip() for child in point.iter() if child is not point}
    satellites = number(texts.get("sat", ""))
    points.columns.add(
        latitude=latitude,
        longitude=longitude,
        elevation=number(texts.get("ele", "")),
        geoid=number(texts.get("geoidheight", "")),
        speed=number(texts.get("speed", "")),
        course=number(texts.get("course", "")),
        fix=_FIX_TYPES.get(texts.get("fix", "").lower(), FixType.UNKNOWN),
        satellites=satellites if 0 <= satellites < 255 else 255.0,
        gps_ns=gps_time_of(texts.get("time", ""), UTC),
    )
    points.names.append(texts.get("name", "")[:200])
    return None


def _log(path: Path, points: dict[str, _Points], reader: XmlReader, tally: DamageTally) -> FlightLog:
    listed = points["wpt"] if len(points["wpt"].columns) else points["rtept"]
    track = points["trkpt"].columns
    counts = {name: len(sort.columns) for name, sort in points.items()} | {"trkseg": reader.counts["trkseg"]}
    notes = ["GPX states no datum of its elevations: taken as above the geoid"]
    if listed is points["wpt"] and len(points["rtept"].columns):
        notes.append(f"{len(points['rtept'].columns)} points of routes are left out: the waypoints are listed")
    if reader.counts["trkseg"] > 1:
        notes.append(f"{reader.counts['trkseg']} segments of tracks: there are gaps between them")
    if reader.fault:
        notes.append(f"the XML is {reader.fault}")
    return FlightLog(
        source=str(path),
        kind=LogKind.GPX,
        fix_table=_fixes(track) if len(track) else no_fixes(),
        estimate_table=no_fixes(),
        attitude_table=no_attitudes(),
        exposure_table=_exposures(listed) if len(listed.columns) else no_exposures(),
        message_counts={name: count for name, count in counts.items() if count},
        damage=tally.result(),
        notes=tuple(notes),
    )


def _fixes(columns: Columns) -> FixTable:
    course_rad = np.radians(columns.numbers("course"))
    speed = columns.numbers("speed")
    return fix_table(
        Stamps.of(len(columns), gps_ns=columns.integers("gps_ns")),
        columns.numbers("latitude"),
        columns.numbers("longitude"),
        height_geoid_m=columns.numbers("elevation"),
        height_ellipsoid_m=_ellipsoid_m(columns),
        velocity_m_s=np.column_stack(
            [speed * np.sin(course_rad), speed * np.cos(course_rad), np.full(len(speed), np.nan)]
        ),
        fix_type=columns.numbers("fix").astype(np.uint8),
        satellites=columns.numbers("satellites").astype(np.uint8),
    )


def _exposures(points: _Points) -> ExposureTable:
    columns = points.columns
    return exposure_table(
        Stamps.of(len(columns), gps_ns=columns.integers("gps_ns")),
        ExposureKind.LISTED,
        latitude_deg=columns.numbers("latitude"),
        longitude_deg=columns.numbers("longitude"),
        height_geoid_m=columns.numbers("elevation"),
        height_ellipsoid_m=_ellipsoid_m(columns),
        name=tuple(points.names),
    )


def _ellipsoid_m(columns: Columns) -> Array:
    return np.asarray(columns.numbers("elevation") + columns.numbers("geoid"), dtype=np.float64)
