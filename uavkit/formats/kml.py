"""Positions in KML and KMZ: waypoints and tracks as planners and ground stations write them.

KML counts an ``absolute`` altitude from the EGM96 geoid; every other mode counts from the ground, and so does a
position without altitude. A document type declaration is refused, so that no entity can be expanded.
"""

import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.atomic import atomic_path

_LARGEST_KML_BYTES = 256 * 1024 * 1024


class KmlPositions:
    """Fills ``GnssReceiver`` from a KML or KMZ file, in the order of the document."""

    def __init__(self, path: Path, override: HeightDatum | None = None) -> None:
        """Read the file; ``override`` replaces the datum that the file's altitude mode states."""
        fixes = read_positions(path)
        self._fixes = fixes if override is None else tuple(replace(fix, height_datum=override) for fix in fixes)

    def fixes(self) -> Iterator[GnssFix]:
        """Yield the positions."""
        yield from self._fixes


def read_positions(path: Path) -> tuple[GnssFix, ...]:
    """Return the positions of a KML or KMZ file with their names, in the order of the document.

    Point placemarks if there are any, else tracks (gx:Track, with times), else the vertices of lines. Raises
    InputError where the file cannot be read or a coordinate is impossible.
    """
    root = _parse(path, _kml_bytes(path))
    marks = [element for element in root.iter() if _tag(element) == "Placemark"]
    for reader in (_points_of, _tracks_of, _lines_of):
        fixes = [fix for number, mark in enumerate(marks, start=1) for fix in reader(mark, _where(path, mark, number))]
        if fixes:
            return tuple(fixes)
    raise InputError(f"{path}: no point, track or line in {len(marks)} placemarks: export the waypoints as placemarks")


def write_positions(path: Path, title: str, fixes: Sequence[GnssFix]) -> None:
    """Write positions as point placemarks, whole or not at all; ellipsoidal heights become geoid heights (EGM96)."""
    import simplekml

    simplekml.Kml.resetidcounter()  # the same content gives the same file
    document = simplekml.Kml(name=title)
    for fix in fixes:
        height_m, mode = _altitude(fix)
        point = document.newpoint(name=fix.name, coords=[(fix.longitude_deg, fix.latitude_deg, height_m)])
        point.altitudemode = mode
    with atomic_path(path) as temporary:
        temporary.write_text(document.kml(), encoding="utf-8")


def _altitude(fix: GnssFix) -> tuple[float, str]:
    if fix.height_datum is HeightDatum.ELLIPSOID:
        undulation_m = geoid_undulation_m(np.array(fix.latitude_deg), np.array(fix.longitude_deg))
        return fix.height_m - float(undulation_m), "absolute"
    if fix.height_datum is HeightDatum.GEOID:
        return fix.height_m, "absolute"
    if fix.height_datum is HeightDatum.GROUND:
        return fix.height_m, "relativeToGround"
    return 0.0, "clampToGround"


def _kml_bytes(path: Path) -> bytes:
    try:
        if not zipfile.is_zipfile(path):
            return path.read_bytes()
        with zipfile.ZipFile(path) as archive:
            names = [info for info in archive.infolist() if info.filename.lower().endswith(".kml")]
            if not names:
                raise InputError(f"{path}: this KMZ holds no .kml file: export it again")
            main = next((info for info in names if info.filename.lower() == "doc.kml"), names[0])
            if main.file_size > _LARGEST_KML_BYTES:
                raise InputError(f"{path}: {main.filename} would unpack to {main.file_size} bytes: that is no flight")
            return archive.read(main)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: the KMZ is damaged ({error}): export it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _parse(path: Path, content: bytes) -> ElementTree.Element:
    """Return the root element; a first pass refuses a DTD before anything could be expanded."""

    def refuse(*_: object) -> None:
        raise InputError(f"{path}: a document type declaration (DTD) is not accepted in KML: remove the DOCTYPE line")

    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = refuse
    try:
        guard.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, LookupError, ValueError) as error:  # encodings too
        raise InputError(f"{path}: no valid KML ({error}): export it again") from error


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _child_text(element: ElementTree.Element, tag: str) -> str:
    return next((child.text or "" for child in element if _tag(child) == tag), "").strip()


def _where(path: Path, mark: ElementTree.Element, number: int) -> str:
    name = _child_text(mark, "name")
    return f"{path}: placemark {number}" + (f" ({name!r})" if name else "")


def _points_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    name, times = _child_text(mark, "name"), [child for child in mark if _tag(child) == "TimeStamp"]
    time_ns = _gps_time(_child_text(times[0], "when")) if times else None
    for point in (element for element in mark.iter() if _tag(element) == "Point"):
        tuples = _tuples(_child_text(point, "coordinates"))
        if len(tuples) != 1:
            raise InputError(f"{where}: a point needs one longitude,latitude,altitude, there are {len(tuples)}")
        yield _fix(tuples[0], point, where, name=name, time_ns=time_ns)


def _lines_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    for line in (element for element in mark.iter() if _tag(element) == "LineString"):
        for number, numbers in enumerate(_tuples(_child_text(line, "coordinates")), start=1):
            yield _fix(numbers, line, f"{where}, vertex {number}", name=str(number), time_ns=None)


def _tracks_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    for track in (element for element in mark.iter() if _tag(element) == "Track"):
        times = [(child.text or "").strip() for child in track if _tag(child) == "when"]
        coords = [(child.text or "").split() for child in track if _tag(child) == "coord"]
        if len(times) not in (0, len(coords)):
            raise InputError(f"{where}: the track has {len(times)} times for {len(coords)} positions: export it again")
        for number, numbers in enumerate(coords):
            time_ns = _gps_time(times[number]) if times else None
            yield _fix(numbers, track, f"{where}, position {number + 1}", name=str(number + 1), time_ns=time_ns)


def _tuples(text: str) -> list[list[str]]:
    return [part.split(",") for part in re.sub(r"\s*,\s*", ",", text).split()]


def _fix(numbers: list[str], geometry: ElementTree.Element, where: str, *, name: str, time_ns: int | None) -> GnssFix:
    """Check one position; raises InputError with a hint where latitude and longitude seem swapped."""
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if len(values) not in (2, 3) or not np.all(np.isfinite(values)):
        raise InputError(f"{where}: {','.join(numbers)!r} is not longitude,latitude,altitude in decimal degrees and m")
    longitude, latitude = values[:2]
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        swapped = abs(longitude) <= 90.0 and abs(latitude) <= 180.0
        hint = "longitude and latitude are swapped, KML wants longitude first" if swapped else "give decimal degrees"
        raise InputError(f"{where}: longitude {longitude:g}, latitude {latitude:g} is no place on earth: {hint}")
    absolute = _child_text(geometry, "altitudeMode") == "absolute"
    return GnssFix(
        gps_time_ns=time_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=values[2] if len(values) == 3 else 0.0,
        height_datum=HeightDatum.GEOID if absolute and len(values) == 3 else HeightDatum.GROUND,
        name=name,
    )


def _gps_time(text: str) -> int | None:
    """Return the GPS time of an ISO 8601 instant; None for dates alone and for local times of unknown zone."""
    try:
        moment = datetime.fromisoformat(text)
        return gps_time_ns_from_utc(moment.astimezone(UTC)) if moment.tzinfo else None
    except ValueError:
        return None
