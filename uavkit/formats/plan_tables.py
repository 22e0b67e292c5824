"""A flight plan as tables: its exposures as CSV (and back), all of it as GeoJSON, a sortie for Litchi.

The exposures' CSV::

    # uavkit exposures
    # vertical: ellipsoid     (take-off, where the plan had no terrain model: heights above the take-off point)
    exposure,strip,station,sortie,time_s,latitude_deg,longitude_deg,height_m,height_above_ground_m,heading_deg,...

Rotations are omega, phi, kappa of R_map_from_image in axes east, north, up at the exposure; exposures, strips and
sorties count from 1, stations from 0. An empty cell is a value that does not exist.
"""

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.angles import omega_phi_kappa_from_rotation, rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array
from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.flightplan import AreaKind, FlightPlan, PlannedExposures, SurveyArea, Trigger, Waypoint, WaypointRole
from uavkit.formats.atomic import write_text
from uavkit.formats.commented_csv import comment_keys, rows_of_cells, text_lines

_COUNTS = ("exposure", "strip", "station", "sortie")
_MEASURES = {
    "time_s": 3,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "height_m": 4,
    "height_above_ground_m": 4,
    "heading_deg": 6,
    "omega_deg": 8,
    "phi_deg": 8,
    "kappa_deg": 8,
    "forward_overlap": 6,
    "side_overlap": 6,
    "gsd_least_m": 7,
    "gsd_mean_m": 7,
    "gsd_greatest_m": 7,
}
"""Columns of numbers, with their digits behind the point."""
_COLUMNS = (*_COUNTS, *_MEASURES, "sees_area")
_MAY_LACK = ("forward_overlap", "side_overlap", "gsd_least_m", "gsd_mean_m", "gsd_greatest_m")
_ACTIONS = 15
_LITCHI_WAYPOINTS = 99
_STAY, _PHOTO = 0, 1
_LITCHI_COLUMNS = (
    *("latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)", "rotationdir", "gimbalmode"),
    "gimbalpitchangle",
    *(f"{word}{number}" for number in range(1, _ACTIONS + 1) for word in ("actiontype", "actionparam")),
    *("altitudemode", "speed(m/s)", "poi_latitude", "poi_longitude", "poi_altitude(m)", "poi_altitudemode"),
    *("photo_timeinterval", "photo_distinterval"),
)


def write_exposures_csv(path: Path, plan: FlightPlan) -> None:
    """Write the exposures of a plan, a row each, whole or not at all."""
    table = plan.exposures
    angles = np.degrees([omega_phi_kappa_from_rotation(rotation) for rotation in table.R_map_from_image]).reshape(-1, 3)
    measures = np.column_stack(
        [
            table.time_s, table.latitude_deg, table.longitude_deg, table.height_ellipsoid_m,
            table.height_above_ground_m, table.heading_deg, angles, table.forward_overlap, table.side_overlap,
            table.gsd_m,
        ]
    )  # fmt: skip
    counts = np.column_stack([np.arange(1, len(table) + 1), table.strip + 1, table.station, table.sortie + 1])
    stream = io.StringIO()
    stream.write(f"# uavkit exposures\n# plan: {_one_line(plan.name)}\n# camera: {_one_line(plan.camera)}\n")
    stream.write(f"# vertical: {'ellipsoid' if plan.terrain else 'take-off'}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for count, row, sees in zip(counts.tolist(), measures.tolist(), table.sees_area.tolist(), strict=True):
        cells = ["" if math.isnan(x) else f"{x:.{d}f}" for x, d in zip(row, _MEASURES.values(), strict=True)]
        writer.writerow([*count, *cells, int(sees)])
    write_text(path, stream.getvalue())


def _one_line(text: str) -> str:
    return " ".join(text.split())


def read_exposures_csv(path: Path) -> PlannedExposures:
    """Read the exposures; raises InputError naming file and line for whatever cannot be understood."""
    lines = text_lines(path)
    keys, rows = comment_keys(path, lines, ("plan", "camera", "vertical")), list(rows_of_cells(path, lines, _check))
    if not rows:
        raise InputError(f"{path}: the file holds no exposure below its header")
    if keys.get("vertical", (0, "ellipsoid"))[1] not in ("ellipsoid", "take-off"):
        number, value = keys["vertical"]
        raise InputError(
            f"{path}: line {number}: heights of exposures count from the ellipsoid or the take-off, not {value!r}"
        )
    counts = {name: np.array([_whole(path, row, name) for row in rows], dtype=np.int64) for name in _COUNTS}
    for number, (line, _) in enumerate(rows, start=1):
        if counts["exposure"][number - 1] != number:
            raise InputError(f"{path}: line {line} should be exposure {number}: a line is missing or out of order")
    values = {name: np.array([_measure(path, row, name) for row in rows]) for name in _MEASURES}
    sees = np.array([_whole(path, row, "sees_area") == 1 for row in rows], dtype=np.bool_)
    return _exposures(counts, values, sees)


def _exposures(
    counts: dict[str, NDArray[np.int64]], values: dict[str, Array], sees_area: NDArray[np.bool_]
) -> PlannedExposures:
    angles = np.radians(np.column_stack([values["omega_deg"], values["phi_deg"], values["kappa_deg"]]))
    return PlannedExposures(
        latitude_deg=values["latitude_deg"],
        longitude_deg=values["longitude_deg"],
        height_ellipsoid_m=values["height_m"],
        height_above_ground_m=values["height_above_ground_m"],
        R_map_from_image=np.stack([rotation_from_omega_phi_kappa(*row) for row in angles]),
        heading_deg=values["heading_deg"],
        station=counts["station"],
        strip=counts["strip"] - 1,
        sortie=counts["sortie"] - 1,
        time_s=values["time_s"],
        forward_overlap=values["forward_overlap"],
        side_overlap=values["side_overlap"],
        gsd_m=np.column_stack([values["gsd_least_m"], values["gsd_mean_m"], values["gsd_greatest_m"]]),
        sees_area=sees_area,
    )


def _check(where: str, header: list[str]) -> None:
    for name in header:
        if name not in _COLUMNS:
            raise InputError(f"{where}: unknown column {name!r}{did_you_mean(name, _COLUMNS)}")
    missing = [name for name in _COLUMNS if name not in header]
    if missing or len(header) != len(_COLUMNS):
        raise InputError(f"{where}: each column is needed once; missing: {', '.join(missing) or 'none'}")


def _whole(path: Path, row: tuple[int, dict[str, str]], name: str) -> int:
    line, cells = row
    if not (cells[name].isascii() and cells[name].isdigit() and len(cells[name]) < 10):
        raise InputError(f"{path}: line {line}: {name} is {cells[name]!r}, not a whole number")
    return int(cells[name])


def _measure(path: Path, row: tuple[int, dict[str, str]], name: str) -> float:
    line, cells = row
    if not cells[name] and name in _MAY_LACK:
        return math.nan
    try:
        number = float(cells[name])
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{path}: line {line}: {name} is {cells[name]!r}, not a number")
    if abs(number) > {"latitude_deg": 90.0, "longitude_deg": 180.0}.get(name, math.inf):
        raise InputError(f"{path}: line {line}: {name} {number:g} is no place on earth")
    return number


def write_plan_geojson(path: Path, plan: FlightPlan, footprints_deg: Array | Sequence[Array]) -> None:
    """Write a plan as GeoJSON (RFC 7946), whole or not at all: areas, take-off, paths, strips, exposures, footprints.

    Each feature's ``kind`` tells what it is; heights are above the ellipsoid. ``footprints_deg`` as in ``plan_kml``.
    """
    if len(footprints_deg) not in (0, len(plan.exposures)):
        raise InputError(f"{path}: {len(footprints_deg)} footprints for {len(plan.exposures)} exposures")
    features = [_area(area) for area in plan.areas]
    start = plan.take_off
    place = _position(start.latitude_deg, start.longitude_deg, start.height_ellipsoid_m)
    features.append(_feature("take-off", "Point", place))
    for number, sortie in enumerate(plan.sorties, start=1):
        line = [_position(w.latitude_deg, w.longitude_deg, w.height_ellipsoid_m) for w in sortie.waypoints]
        features.append(_feature("path", "LineString", line, sortie=number, length_m=round(sortie.length_m, 1)))
    features += _strips_and_exposures(plan)
    for number, footprint in enumerate(footprints_deg, start=1):
        ring = [_position(*corner) for corner in footprint if np.all(np.isfinite(corner))]
        if len(ring) >= 3:
            features.append(_feature("footprint", "Polygon", [_counter_clockwise(ring)], exposure=number))
    lines = ",\n".join(json.dumps(feature, ensure_ascii=False, allow_nan=False) for feature in features)
    name = json.dumps(plan.name, ensure_ascii=False)
    write_text(path, f'{{"type": "FeatureCollection", "name": {name}, "features": [\n{lines}\n]}}\n')


def _strips_and_exposures(plan: FlightPlan) -> list[dict[str, Any]]:
    table, features = plan.exposures, []
    places = [
        _position(*place)
        for place in zip(table.latitude_deg, table.longitude_deg, table.height_ellipsoid_m, strict=True)
    ]
    for number, strip in enumerate(plan.strips):
        line = [places[row] for row in np.flatnonzero(table.strip == number)]
        if line:
            facts: dict[str, Any] = {"strip": number + 1, "base_m": strip.base_m, "direction_deg": strip.direction_deg}
            shape = ("LineString", line) if len(line) > 1 else ("Point", line[0])
            features.append(_feature("strip", shape[0], shape[1], **facts))
    for row, place in enumerate(places):
        facts = {
            "exposure": row + 1, "strip": int(table.strip[row]) + 1, "sortie": int(table.sortie[row]) + 1,
            "time_s": round(float(table.time_s[row]), 3), "heading_deg": round(float(table.heading_deg[row]), 6),
            "height_above_ground_m": round(float(table.height_above_ground_m[row]), 3),
        }  # fmt: skip
        features.append(_feature("exposure", "Point", place, **facts))
    return features


def _feature(kind: str, shape: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    geometry = {"type": shape, "coordinates": coordinates}
    return {"type": "Feature", "properties": {"kind": kind, **properties}, "geometry": geometry}


def _position(latitude_deg: float, longitude_deg: float, height_m: float | None = None) -> list[float]:
    place = [round(float(longitude_deg), 9), round(float(latitude_deg), 9)]
    return place if height_m is None else [*place, round(float(height_m), 3)]


def _area(area: SurveyArea) -> dict[str, Any]:
    vertices = [_position(*vertex) for vertex in area.latitude_longitude_deg]
    if area.kind is AreaKind.POINT:
        return _feature("area", "Point", vertices[0], name=area.name)
    if area.kind is AreaKind.LINE:
        return _feature("area", "LineString", vertices, name=area.name)
    holes = [_counter_clockwise([_position(*vertex) for vertex in hole])[::-1] for hole in area.holes_deg]
    return _feature("area", "Polygon", [_counter_clockwise(vertices), *holes], name=area.name)


def _counter_clockwise(ring: list[list[float]]) -> list[list[float]]:
    """Return a closed ring, as RFC 7946 wants outlines turned."""
    x, y = np.array([place[:2] for place in ring]).T
    x, y = x - x[0], y - y[0]
    twice_area = float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    turned = ring if twice_area >= 0 else ring[::-1]
    return [*turned, turned[0]]


def write_litchi_csv(path: Path, plan: FlightPlan, sortie: int) -> None:
    """Write a sortie (counted from 0) for Litchi's mission hub, heights above take-off, whole or not at all.

    Raises InputError where it has more waypoints than Litchi takes.
    """
    if not 0 <= sortie < len(plan.sorties):
        raise InputError(f"{plan.name}: there is no sortie {sortie + 1}, the plan has {len(plan.sorties)}")
    waypoints = [w for w in plan.sorties[sortie].waypoints if w.role is not WaypointRole.TAKEOFF]
    if len(waypoints) > _LITCHI_WAYPOINTS:
        raise InputError(
            f"{path}: sortie {sortie + 1} has {len(waypoints)} waypoints, Litchi takes {_LITCHI_WAYPOINTS}: trigger by "
            f"distance, or give most_items in [sorties]"
        )
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_LITCHI_COLUMNS)
    for number, waypoint in enumerate(waypoints):
        writer.writerow(_litchi_row(plan, waypoints, number, waypoint))
    write_text(path, stream.getvalue())


def _litchi_row(plan: FlightPlan, waypoints: Sequence[Waypoint], number: int, waypoint: Waypoint) -> list[Any]:
    """Return the cells of a waypoint; Litchi's speed and photo interval hold on the leg that begins there."""
    following = waypoints[min(number + 1, len(waypoints) - 1)]
    actions: list[int] = []
    if plan.trigger is Trigger.HOVER and waypoint.exposure >= 0:
        actions = [_STAY, round(waypoint.hold_s * 1000), _PHOTO, 0]
    triggering = waypoint.strip >= 0 and waypoint.role in (WaypointRole.EXPOSURE, WaypointRole.PATH)
    base_m = plan.strips[waypoint.strip].base_m if triggering and plan.trigger is not Trigger.HOVER else -1.0
    every_s = base_m / following.speed_m_s if plan.trigger is Trigger.TIME and base_m > 0 else -1.0
    every_m = base_m if plan.trigger is Trigger.DISTANCE and base_m > 0 else -1.0
    place = [f"{waypoint.latitude_deg:.9f}", f"{waypoint.longitude_deg:.9f}", f"{waypoint.height_above_takeoff_m:.3f}"]
    gimbal = [2, f"{_pitch_deg(plan, waypoints, number):.1f}"]
    filled = [*actions, *([-1, 0] * (_ACTIONS - len(actions) // 2))]
    end = [0, f"{following.speed_m_s:.2f}", 0, 0, 0, 0, _interval(every_s), _interval(every_m)]
    return [*place, f"{waypoint.heading_deg:.1f}", 0, 0, *gimbal, *filled, *end]


def _interval(value: float) -> str:
    return f"{value:.2f}" if value > 0 else "-1"


def _pitch_deg(plan: FlightPlan, waypoints: Sequence[Waypoint], number: int) -> float:
    """Return the camera's pitch at a waypoint: of the next exposure, else of the last; -90 is nadir."""
    later = (w.exposure for w in (*waypoints[number:], *reversed(waypoints[:number])) if w.exposure >= 0)
    exposure = next(later, -1)
    if exposure < 0:
        return -90.0
    up = -float(plan.exposures.R_map_from_image[exposure, 2, 2])
    return math.degrees(math.asin(min(max(up, -1.0), 1.0))) + 0.0
