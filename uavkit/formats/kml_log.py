"""KML and KMZ as flight logs: tracks as positions, point placemarks and vertices of lines as listed exposures.

* gx:Track: positions with times; its gx:angles (heading, tilt, roll) are attitudes. By the standard each turns
  clockwise as heading does, seen from the end of its axis (x to the right, y ahead, z up): so tilt lowers the nose and
  roll lowers the left wing, both against aviation's signs.
* Point placemarks: exposures, as the lists of waypoints in which each placemark is one (Falcon 8); with their names,
  and the time where there is a TimeStamp. Vertices of lines likewise, where there are neither points nor tracks.
* Heights: ``absolute`` counts from the EGM96 geoid. ``relativeToGround`` counts from the terrain by the standard, but
  programs for drones write heights above the take-off point so: it becomes the height above home, with a note; on level
  ground both are the same. An altitude clamped to the ground says nothing.
* A time without a zone, or a date alone, is no time.

https://developers.google.com/kml/documentation/kmlreference
"""

import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, cast
from xml.etree import ElementTree

import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    AttitudeTable,
    ExposureKind,
    ExposureTable,
    FixTable,
    FlightLog,
    LogKind,
    Stamps,
    attitude_table,
    exposure_table,
    fix_table,
    no_exposures,
    no_fixes,
)
from uavkit.core.progress import Progress
from uavkit.formats.kml_document import child_text, local_name, main_document
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.log_lines import Columns, gps_time_of, head_text, is_place, number, reported
from uavkit.formats.xml_records import XmlKind, XmlReader, is_xml_of

KIND = XmlKind(name="KML", records=frozenset({"Placemark"}), resume=b"<kml><Document>")
_ZIP = b"PK\x03\x04"
_NUMBERS = ("latitude", "longitude", "geoid_m", "home_m")
_LONGEST_NAME = 200


def _positions() -> Columns:
    return Columns(_NUMBERS, ("gps_ns",))


@dataclass(slots=True)
class _Found:
    """What is collected over a document."""

    points: Columns = field(default_factory=_positions)
    vertices: Columns = field(default_factory=_positions)
    fixes: Columns = field(default_factory=_positions)
    attitudes: Columns = field(default_factory=lambda: Columns(("heading", "tilt", "roll"), ("gps_ns",)))
    point_names: list[str] = field(default_factory=list)
    vertex_names: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    no_place: int = 0
    first_fault: str = ""
    notes: list[str] = field(default_factory=list)


def recognises(head: bytes) -> bool:
    """Tell whether the first bytes of a file are of KML, or of a zip archive with a .kml among its first files."""
    if head.startswith(_ZIP):
        return b".kml" in head.lower()
    return is_xml_of(head_text(head), "kml", "(?:Placemark|gx:coord)")


def read_log(path: Path, progress: Progress) -> FlightLog:
    """Read a KML or KMZ file; broken placemarks are counted as damage, and an error where none is whole.

    Offsets and lost bytes of a KMZ are those of its unpacked document.
    """
    tally, found = DamageTally(), _Found()
    reader = XmlReader(str(path), KIND, tally)
    try:
        with _document(path) as stream:
            for record in reported(reader.records(stream), path, progress):
                fault = _take(record.element, found)
                if fault:
                    tally.add(record.offset, record.length, fault)
                    found.first_fault = found.first_fault or fault
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        if not _anything(found):
            raise InputError(f"{path}: the KMZ is damaged ({error}): export it again") from error
        found.notes.append(f"the KMZ is damaged ({error}): what could be unpacked was read")
    if not _anything(found):
        why = found.first_fault or reader.fault
        raise InputError(
            f"{path}: no point, track or line in its placemarks{f' ({why})' if why else ''}: export the waypoints as "
            "placemarks"
        )
    return _log(path, found, reader, tally)


@contextmanager
def _document(path: Path) -> Iterator[BinaryIO]:
    """Open the document, unpacked."""
    with opened(path) as stream:
        if stream.read(4) != _ZIP:
            stream.seek(0)
            yield stream
            return
        with zipfile.ZipFile(stream) as archive, archive.open(main_document(path, archive)) as unpacked:
            yield cast(BinaryIO, unpacked)


def _anything(found: _Found) -> bool:
    return bool(len(found.points) or len(found.vertices) or len(found.fixes))


def _take(mark: ElementTree.Element, found: _Found) -> str:
    """Add the rows of a placemark; return what is wrong with one that has geometry but no good position."""
    before, no_place = _count(found), found.no_place
    for element in mark.iter():
        kind = local_name(element)
        if kind == "Point":
            _take_point(mark, element, found)
        elif kind == "Track":
            _take_track(element, found)
        elif kind == "LineString":
            _take_line(element, found)
        else:
            continue
        found.counts[kind] += 1
    if _count(found) > before or found.no_place == no_place:
        return ""
    return f"placemark {child_text(mark, 'name')[:_LONGEST_NAME]!r}: no longitude,latitude in degrees that is a place"


def _count(found: _Found) -> int:
    return len(found.points) + len(found.vertices) + len(found.fixes)


def _take_point(mark: ElementTree.Element, point: ElementTree.Element, found: _Found) -> None:
    tuples = list(_tuples(child_text(point, "coordinates")))
    stamp = next((child for child in mark if local_name(child) == "TimeStamp"), None)
    gps_ns = gps_time_of(child_text(stamp, "when"), None) if stamp is not None else None
    if len(tuples) != 1 or not _add(found.points, tuples[0], _mode(point), gps_ns):
        found.no_place += 1
        return
    found.point_names.append(child_text(mark, "name")[:_LONGEST_NAME])


def _take_line(line: ElementTree.Element, found: _Found) -> None:
    mode = _mode(line)
    for vertex, numbers in enumerate(_tuples(child_text(line, "coordinates")), start=1):
        if _add(found.vertices, numbers, mode, None):
            found.vertex_names.append(str(vertex))
        else:
            found.no_place += 1


def _take_track(track: ElementTree.Element, found: _Found) -> None:
    """Add a track's positions and attitudes; what belongs together has the same place in the order of its kind."""
    parts = {name: [child.text or "" for child in track if local_name(child) == name] for name in _TRACK}
    times = [gps_time_of(text, None) for text in parts["when"]]
    count, mode = len(parts["coord"]), _mode(track)
    if len(times) != count:
        found.notes.append(f"a track has {len(times)} times for {count} positions: its times are left out")
        times = [None] * count
    for text, gps_ns in zip(parts["coord"], times, strict=True):
        if text.strip() and not _add(found.fixes, text.split(), mode, gps_ns):  # an empty one is a gap
            found.no_place += 1
    for text, gps_ns in zip(parts["angles"], times, strict=False):
        angles = [number(part) for part in text.split()]
        if len(parts["angles"]) == count and len(angles) == 3 and not any(map(math.isnan, angles)):
            found.attitudes.add(heading=angles[0], tilt=angles[1], roll=angles[2], gps_ns=gps_ns)


_TRACK = ("when", "coord", "angles")


def _tuples(text: str) -> Iterator[list[str]]:
    """Yield the numbers, as text, of each tuple of ``coordinates``; blanks about the commas are forgiven."""
    for part in re.finditer(r"[^\s,]+(?:\s{0,20},\s{0,20}[^\s,]+)*", text):
        yield part[0].split(",")


def _mode(geometry: ElementTree.Element) -> str:
    return child_text(geometry, "altitudeMode")


def _add(columns: Columns, numbers: list[str], mode: str, gps_ns: int | None) -> bool:
    """Add a position; tell whether it is one."""
    values = [number(text) for text in numbers]
    if len(values) not in (2, 3) or any(map(math.isnan, values)) or not is_place(values[1], values[0]):
        return False
    height_m = values[2] if len(values) == 3 else None
    columns.add(
        longitude=values[0],
        latitude=values[1],
        geoid_m=height_m if mode == "absolute" else None,
        home_m=height_m if mode == "relativeToGround" else None,
        gps_ns=gps_ns,
    )
    return True


def _log(path: Path, found: _Found, reader: XmlReader, tally: DamageTally) -> FlightLog:
    lines_serve = not len(found.points) and not len(found.fixes)
    listed, names = (found.vertices, found.vertex_names) if lines_serve else (found.points, found.point_names)
    return FlightLog(
        source=str(path),
        kind=LogKind.KML,
        fix_table=_fixes(found.fixes) if len(found.fixes) else no_fixes(),
        estimate_table=no_fixes(),
        attitude_table=_attitudes(found.attitudes),
        exposure_table=_exposures(listed, names) if len(listed) else no_exposures(),
        message_counts=dict(found.counts),
        damage=tally.result(),
        notes=_notes(found, reader, lines_serve),
    )


def _notes(found: _Found, reader: XmlReader, lines_serve: bool) -> tuple[str, ...]:
    notes = list(dict.fromkeys(found.notes))
    if any(np.any(np.isfinite(rows.numbers("home_m"))) for rows in (found.points, found.vertices, found.fixes)):
        notes.append("heights relative to the ground are taken as above the take-off point: level ground is assumed")
    if np.any(found.attitudes.numbers("tilt") != 0.0) or np.any(found.attitudes.numbers("roll") != 0.0):
        notes.append("tilt and roll of gx:angles are read by the standard's sense of rotation: some programs differ")
    if len(found.vertices) and not lines_serve:
        notes.append(f"{len(found.vertices)} vertices of lines are left out")
    if found.no_place:
        notes.append(f"{found.no_place} positions are no place on earth: KML wants longitude first, in degrees")
    if reader.fault:
        notes.append(f"the XML is {reader.fault}")
    return tuple(notes)


def _stamps(columns: Columns) -> Stamps:
    return Stamps.of(len(columns), gps_ns=columns.integers("gps_ns"))


def _fixes(columns: Columns) -> FixTable:
    return fix_table(
        _stamps(columns),
        columns.numbers("latitude"),
        columns.numbers("longitude"),
        height_geoid_m=columns.numbers("geoid_m"),
        height_above_home_m=columns.numbers("home_m"),
    )


def _exposures(columns: Columns, names: list[str]) -> ExposureTable:
    return exposure_table(
        _stamps(columns),
        ExposureKind.LISTED,
        latitude_deg=columns.numbers("latitude"),
        longitude_deg=columns.numbers("longitude"),
        height_geoid_m=columns.numbers("geoid_m"),
        height_above_home_m=columns.numbers("home_m"),
        name=tuple(names),
    )


def _attitudes(columns: Columns) -> AttitudeTable:
    """Return roll, pitch, yaw of heading, tilt, roll: see the module for the signs."""
    heading, tilt, roll = (np.radians(columns.numbers(name)) for name in ("heading", "tilt", "roll"))
    return attitude_table(_stamps(columns), -roll, -tilt, heading)
