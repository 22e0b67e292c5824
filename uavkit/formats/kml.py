"""Positions in KML and KMZ: waypoints and tracks as planners and ground stations write them.

KML counts an ``absolute`` altitude from the EGM96 geoid; every other mode counts from the ground, and so does a
position without altitude. A document type declaration is refused, so that no entity can be expanded.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.atomic import atomic_path
from uavkit.formats.kml_document import child_text, coordinate_tuples, local_name, read_kml


class KmlPositions:
    """Fills ``GnssReceiver`` from KML or KMZ files, one behind the other, each in the order of its document."""

    def __init__(self, *paths: Path, override: HeightDatum | None = None) -> None:
        """Read the files; ``override`` replaces the datum that a file's altitude mode states."""
        fixes = tuple(fix for path in paths for fix in read_positions(path))
        self._fixes = fixes if override is None else tuple(replace(fix, height_datum=override) for fix in fixes)

    def fixes(self) -> Iterator[GnssFix]:
        """Yield the positions."""
        yield from self._fixes


def read_positions(path: Path) -> tuple[GnssFix, ...]:
    """Return the positions of a KML or KMZ file with their names, in the order of the document.

    Point placemarks if there are any, else tracks (gx:Track, with times), else the vertices of lines. Raises
    InputError where the file cannot be read or a coordinate is impossible.
    """
    root = read_kml(path)
    marks = [element for element in root.iter() if local_name(element) == "Placemark"]
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


def _where(path: Path, mark: ElementTree.Element, number: int) -> str:
    name = child_text(mark, "name")
    return f"{path}: placemark {number}" + (f" ({name!r})" if name else "")


def _points_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    name, times = child_text(mark, "name"), [child for child in mark if local_name(child) == "TimeStamp"]
    time_ns = _gps_time(child_text(times[0], "when")) if times else None
    for point in (element for element in mark.iter() if local_name(element) == "Point"):
        tuples = coordinate_tuples(child_text(point, "coordinates"))
        if len(tuples) != 1:
            raise InputError(f"{where}: a point needs one longitude,latitude,altitude, there are {len(tuples)}")
        yield _fix(tuples[0], point, where, name=name, time_ns=time_ns)


def _lines_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    for line in (element for element in mark.iter() if local_name(element) == "LineString"):
        for number, numbers in enumerate(coordinate_tuples(child_text(line, "coordinates")), start=1):
            yield _fix(numbers, line, f"{where}, vertex {number}", name=str(number), time_ns=None)


def _tracks_of(mark: ElementTree.Element, where: str) -> Iterator[GnssFix]:
    for track in (element for element in mark.iter() if local_name(element) == "Track"):
        times = [(child.text or "").strip() for child in track if local_name(child) == "when"]
        coords = [(child.text or "").split() for child in track if local_name(child) == "coord"]
        if len(times) not in (0, len(coords)):
            raise InputError(f"{where}: the track has {len(times)} times for {len(coords)} positions: export it again")
        for number, numbers in enumerate(coords):
            time_ns = _gps_time(times[number]) if times else None
            yield _fix(numbers, track, f"{where}, position {number + 1}", name=str(number + 1), time_ns=time_ns)


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
    absolute = child_text(geometry, "altitudeMode") == "absolute"
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
