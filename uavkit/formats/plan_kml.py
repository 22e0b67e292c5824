"""A flight plan as KML or KMZ, to look at in Google Earth: area, strips, exposures, footprints and the paths flown.

Heights are absolute: above the EGM96 geoid, as KML counts them; those of a plan without a terrain model count from the
ground.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, FlightPlan, SurveyArea
from uavkit.core.frames import geoid_undulation_m
from uavkit.formats.archives import write_zip
from uavkit.formats.atomic import write_text

_ICONS = "http://maps.google.com/mapfiles/kml/shapes/"
# Colours as KML writes them: opacity, blue, green, red.
_AREA, _AREA_FILL = "ff00aaff", "2800aaff"
_STRIPS = ("ffffffff", "ff99ddff")
_FOOTPRINT, _FOOTPRINT_FILL = "a0ffaa55", "12ffaa55"
_EXPOSURE, _TAKE_OFF = "ff4dff4d", "ff0000ff"
_PATHS = ("ff00d7ff", "ffff9900", "ffcc66ff", "ff66ff66", "ff6666ff")
_MOST_SHOWN_FOOTPRINTS = 300
"""More are there, but not switched on: they hide one another, and Google Earth becomes slow."""


def write_plan_kml(path: Path, plan: FlightPlan, footprints_deg: Array | Sequence[Array]) -> None:
    """Write a plan, whole or not at all: as KMZ where the path ends so, else as KML.

    ``footprints_deg`` are the images' outlines on the ground, (n, k, 2) latitude, longitude, in the order of the
    exposures; none at all is allowed. Raises InputError where their number is another one.
    """
    if len(footprints_deg) not in (0, len(plan.exposures)):
        raise InputError(f"{path}: {len(footprints_deg)} footprints for {len(plan.exposures)} exposures")
    text = _document(plan, footprints_deg)
    if path.suffix.lower() == ".kmz":
        write_zip(path, {"doc.kml": text})
    else:
        write_text(path, text)


def _document(plan: FlightPlan, footprints_deg: Array | Sequence[Array]) -> str:
    import simplekml

    simplekml.Kml.resetidcounter()  # the same content gives the same file
    document = simplekml.Kml(name=plan.name, open=1)
    document.document.description = _description(plan)
    _add_areas(document.newfolder(name="Area"), plan.areas)
    _add_take_off(document, plan)
    for number in range(len(plan.sorties)):
        _add_path(document, plan, number)
    heights_m = _heights_m(
        plan, plan.exposures.latitude_deg, plan.exposures.longitude_deg, plan.exposures.height_ellipsoid_m
    )
    _add_strips(document.newfolder(name="Strips"), plan, heights_m)
    _add_exposures(document.newfolder(name="Exposures"), plan, heights_m)
    if len(footprints_deg):
        _add_footprints(document.newfolder(name="Footprints"), footprints_deg)
    return str(document.kml())


def _description(plan: FlightPlan) -> str:
    summary = plan.summary
    facts = [
        f"camera {plan.camera}" + (f", vehicle {plan.vehicle}" if plan.vehicle else ""),
        f"{summary.images} images in {summary.strips} strips, {summary.sorties} sorties",
        f"path {summary.length_m:.0f} m, {summary.duration_s / 60.0:.1f} minutes",
        f"a pixel on the ground {summary.gsd_m[0] * 1e3:.1f} to {summary.gsd_m[2] * 1e3:.1f} mm",
        *plan.notes,
    ]
    return "\n".join(facts)


def _heights_m(plan: FlightPlan, latitude_deg: Array, longitude_deg: Array, height_ellipsoid_m: Array) -> Array:
    """Return heights as the document counts them: from the geoid, or from flat ground."""
    if not plan.terrain:
        return height_ellipsoid_m
    return np.asarray(height_ellipsoid_m - geoid_undulation_m(latitude_deg, longitude_deg))


def _mode(plan: FlightPlan) -> str:
    return "absolute" if plan.terrain else "relativeToGround"


def _add_areas(folder: Any, areas: Sequence[SurveyArea]) -> None:
    for area in areas:
        ring = _ring(area.latitude_longitude_deg)
        if area.kind is AreaKind.POINT:
            folder.newpoint(name=area.name, coords=ring)
            continue
        if area.kind is AreaKind.LINE:
            shape = folder.newlinestring(name=area.name, coords=ring, tessellate=1)
        else:
            holes = [_closed(_ring(hole)) for hole in area.holes_deg]
            shape = folder.newpolygon(
                name=area.name, outerboundaryis=_closed(ring), innerboundaryis=holes, tessellate=1
            )
            shape.style.polystyle.color = _AREA_FILL
        shape.style.linestyle.color, shape.style.linestyle.width = _AREA, 3


def _ring(latitude_longitude_deg: Array) -> list[tuple[float, float]]:
    """Return longitude, latitude, as KML wants it."""
    return [(round(float(longitude), 9), round(float(latitude), 9)) for latitude, longitude in latitude_longitude_deg]


def _closed(ring: list[tuple[float, float]]) -> list[tuple[float, float]]:
    return [*ring, ring[0]]


def _places(latitude_deg: Array, longitude_deg: Array, height_m: Array) -> list[tuple[float, float, float]]:
    rows = zip(longitude_deg, latitude_deg, height_m, strict=True)
    return [(round(float(x), 9), round(float(y), 9), round(float(z), 3)) for x, y, z in rows]


def _add_take_off(document: Any, plan: FlightPlan) -> None:
    start = plan.take_off
    point = document.newpoint(name="Take-off", coords=[(start.longitude_deg, start.latitude_deg)])
    height = f"{start.height_ellipsoid_m:.1f} m above the ellipsoid" if plan.terrain else "height not known"
    point.description = height + ("; chosen by the planner" if start.chosen else "")
    point.style.iconstyle.icon.href = f"{_ICONS}heliport.png"
    point.style.iconstyle.color, point.style.iconstyle.scale = _TAKE_OFF, 1.1


def _add_path(document: Any, plan: FlightPlan, number: int) -> None:
    """Add what a sortie flies, with a curtain down to the ground."""
    waypoints = plan.sorties[number].waypoints
    columns = [
        np.array([getattr(waypoint, name) for waypoint in waypoints], dtype=np.float64)
        for name in ("latitude_deg", "longitude_deg", "height_ellipsoid_m")
    ]
    path = document.newlinestring(name=f"Sortie {number + 1}", altitudemode=_mode(plan), extrude=1)
    path.coords = _places(columns[0], columns[1], _heights_m(plan, *columns)) if waypoints else []
    flight, colour = plan.sorties[number], _PATHS[number % len(_PATHS)]
    path.description = f"{flight.exposures} exposures, {flight.length_m:.0f} m, {flight.duration_s / 60.0:.1f} minutes"
    path.style.linestyle.color, path.style.linestyle.width = colour, 2
    path.style.polystyle.color = "20" + colour[2:]


def _add_strips(folder: Any, plan: FlightPlan, heights_m: Array) -> None:
    table = plan.exposures
    for number, strip in enumerate(plan.strips):
        rows = np.flatnonzero(table.strip == number)
        if len(rows) == 0:
            continue
        line = folder.newlinestring(name=f"Strip {number + 1}", altitudemode=_mode(plan))
        line.coords = _places(table.latitude_deg[rows], table.longitude_deg[rows], heights_m[rows])
        line.description = f"{len(rows)} exposures, base {strip.base_m:.1f} m, direction {strip.direction_deg:.1f} deg"
        line.style.linestyle.color, line.style.linestyle.width = _STRIPS[strip.set_number % 2], 4


def _add_exposures(folder: Any, plan: FlightPlan, heights_m: Array) -> None:
    """Add the exposures, in a folder for each strip; they share one style."""
    import simplekml

    style = simplekml.Style()
    style.iconstyle.icon.href = f"{_ICONS}placemark_circle.png"
    style.iconstyle.color, style.iconstyle.scale, style.labelstyle.scale = _EXPOSURE, 0.4, 0.0
    table = plan.exposures
    places = _places(table.latitude_deg, table.longitude_deg, heights_m)
    folders: dict[int, Any] = {}
    for row, (place, strip) in enumerate(zip(places, table.strip.tolist(), strict=True)):
        if strip not in folders:
            folders[strip] = folder.newfolder(name=f"Strip {strip + 1}")
        point = folders[strip].newpoint(name=f"{row + 1}", coords=[place], altitudemode=_mode(plan))
        point.description = (
            f"sortie {table.sortie[row] + 1}, {table.time_s[row]:.1f} s, "
            f"{table.height_above_ground_m[row]:.1f} m above ground, heading {table.heading_deg[row]:.1f} deg"
        )
        point.style = style


def _add_footprints(folder: Any, footprints_deg: Array | Sequence[Array]) -> None:
    import simplekml

    style = simplekml.Style()
    style.linestyle.color, style.linestyle.width, style.polystyle.color = _FOOTPRINT, 1, _FOOTPRINT_FILL
    shown = int(len(footprints_deg) <= _MOST_SHOWN_FOOTPRINTS)
    folder.visibility = shown
    for row, footprint in enumerate(footprints_deg):
        corners = np.asarray(footprint, dtype=np.float64)
        corners = corners[np.all(np.isfinite(corners), axis=1)]  # rays beside the ground end nowhere
        if len(corners) < 3:
            continue
        polygon = folder.newpolygon(name=f"{row + 1}", outerboundaryis=_closed(_ring(corners)), tessellate=1)
        polygon.visibility, polygon.style = shown, style
