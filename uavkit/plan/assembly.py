"""Put a plan together: divide the lines into sorties, make waypoints, and tell what each image gives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightStrip, PlannedExposures, PlanSummary, Sortie, Waypoint
from uavkit.core.vehicle import VehicleProfile
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan import checks
from uavkit.plan.flight import (
    HOME,
    Airfield,
    LineTimes,
    Performance,
    SortieLimits,
    Vertex,
    away_times,
    cumulative_times,
    divide,
    line_times,
    parts_of,
    sortie_vertices,
    with_speeds,
)
from uavkit.plan.lines import StationLine
from uavkit.plan.measured import LineMeasures, are_beside, least_and_mean, stations_of
from uavkit.plan.overlap import points_on_ground
from uavkit.plan.patterns import LaidSet

MOST_ITEMS = 700
"""That ArduPilot holds on most boards."""
ITEMS_OF_A_SORTIE = 8
"""Beside waypoints and triggers: home, take-off, speed, gimbal, transit, return."""


def most_items(request: PlanRequest, vehicle: VehicleProfile | None) -> int:
    """Return how many mission items a sortie may have."""
    return request.sorties.most_items or (vehicle.most_mission_items if vehicle is not None else MOST_ITEMS)


@dataclass(frozen=True, kw_only=True)
class Assembled:
    """What a plan is made of."""

    strips: tuple[FlightStrip, ...]
    exposures: PlannedExposures
    sorties: tuple[Sortie, ...]
    summary: PlanSummary
    """Without what the area and its coverage tell."""
    footprints_deg: Array
    home_m: Array
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A line, or the part of it that a sortie flies, on the map."""

    member: int
    own: StationLine
    """In the axes of its set."""
    line: StationLine
    """On the map."""
    first_station: int
    sortie: int
    measures: LineMeasures


def assemble(
    request: PlanRequest,
    sets: Sequence[LaidSet],
    flown: Sequence[tuple[int, StationLine]],
    measures: Sequence[LineMeasures],
    field: Airfield,
    flies: Performance,
    flown_by: tuple[VehicleProfile | None, int],
    fences: checks.MapFences,
    first_station: int,
) -> Assembled:
    """Return the parts of a plan over lines in the order of flight, from a station on.

    flown_by: the vehicle, and about how many mission items a sortie may have where it may be divided by them.
    """
    vehicle, items = flown_by
    on_map = [(member, line.moved(sets[member].axes, sets[member].origin_m)) for member, line in flown]
    starts = stations_of([line for _, line in on_map])
    most_s = vehicle.endurance_s * (1.0 - request.sorties.reserve) if vehicle is not None else float("inf")
    aimed_s = most_s
    while True:  # the division goes by estimates of the way there and back
        spans = _spans(request, on_map, field, flies, (aimed_s, items), first_station)
        parts = _parts(sets, flown, measures, starts, spans)
        sorties, times = _sorties(parts, field, flies, fences)
        longest_s = max(sortie.record.duration_s for sortie in sorties)
        if longest_s <= most_s:
            break
        aimed_s -= max(longest_s - most_s, 1.0)
    clearance = [checks.check_heights(_path(sortie), field.ground, request, 0)[0] for sortie in sorties]
    exposures = _exposures(parts, times, field)
    footprints = _footprints(sets, parts, field)
    return Assembled(
        strips=_strips(parts),
        exposures=exposures,
        sorties=tuple(sortie.record for sortie in sorties),
        summary=_summary(request, sets, parts, sorties, exposures, flies, min(clearance)),
        footprints_deg=footprints,
        home_m=field.home_m,
        notes=tuple(_notes(sorties, vehicle, flies, request, field.clearance_m)),
    )


@dataclass(frozen=True, kw_only=True)
class _Flown:
    """A sortie and its path on the map."""

    record: Sortie
    vertices: tuple[Vertex, ...]


def _spans(
    request: PlanRequest,
    on_map: Sequence[tuple[int, StationLine]],
    field: Airfield,
    flies: Performance,
    limit: tuple[float, int],
    first_station: int,
) -> list[tuple[int, int]]:
    """Return first and last station of each sortie, which may take no longer than a time (s) and a number of items."""
    most_s, most = limit
    times = [line_times(line, flies) for _, line in on_map]
    stations = np.concatenate([line.centres_m for _, line in on_map])
    if not 0 <= first_station < len(stations):
        raise InputError(
            f"there is no exposure station {first_station} to resume at: the plan has 0 to {len(stations) - 1}"
        )
    asked = request.sorties
    items = _running_items(on_map, flies)
    limits = SortieLimits(
        duration_s=most_s,
        items=float(most - ITEMS_OF_A_SORTIE) if asked.split_at_items else float("inf"),
        overlap_stations=asked.overlap_images,
    )
    line_of = np.repeat(np.arange(len(on_map)), [len(line) for _, line in on_map])
    return divide(
        cumulative_times(on_map, times, flies),
        away_times(stations, field, flies),
        items,
        line_of,
        limits,
        max(0, first_station - asked.overlap_images) if first_station else 0,
    )


def _running_items(on_map: Sequence[tuple[int, StationLine]], flies: Performance) -> Array:
    """Return the number of mission items up to each station, (all stations,)."""
    now, result = 0.0, []
    for _, line in on_map:
        needed = np.where(line.bends, 1.0, 0.0)
        needed[line.station_vertex] = 2.0 if flies.stops else needed[line.station_vertex]
        result.append(now + np.cumsum(needed)[line.station_vertex])
        speeds = line_times(line, flies).speeds_m_s[np.flatnonzero(needed)]
        now += float(needed.sum()) + (0.0 if flies.stops else 4.0) + 2.0
        now += float(np.sum(np.abs(np.diff(speeds)) > 0.05))
    return np.concatenate(result)


def _parts(
    sets: Sequence[LaidSet],
    flown: Sequence[tuple[int, StationLine]],
    measures: Sequence[LineMeasures],
    starts: NDArray[np.int64],
    spans: Sequence[tuple[int, int]],
) -> list[_Part]:
    result = []
    for sortie, span in enumerate(spans):
        for member, own, first in parts_of(flown, starts, span):
            number = int(np.searchsorted(starts, first, side="right")) - 1
            here = slice(first - int(starts[number]), first - int(starts[number]) + len(own))
            found = measures[number]
            forward = found.forward[here].copy()
            forward[-1] = np.nan
            result.append(
                _Part(
                    member=member,
                    own=own,
                    line=own.moved(sets[member].axes, sets[member].origin_m),
                    first_station=first,
                    sortie=sortie,
                    measures=LineMeasures(
                        forward=forward,
                        side=found.side[here],
                        gsd_m=found.gsd_m[here],
                        sees_area=found.sees_area[here],
                        middle_in_area=found.middle_in_area[here],
                    ),
                )
            )
    return result


def _sorties(
    parts: Sequence[_Part], field: Airfield, flies: Performance, fences: checks.MapFences
) -> tuple[list[_Flown], Array]:
    """Return the sorties, and the time of every exposure since take-off, (exposures,)."""
    sorties, times = [], []
    exposures = 0
    for number in range(parts[-1].sortie + 1):
        rows = [row for row, part in enumerate(parts) if part.sortie == number]
        own = [(parts[row].member, parts[row].line) for row in rows]
        vertices, reached = with_speeds(sortie_vertices(own, rows[0], field, flies), flies)
        checks.check_fences(vertices, field.ground, fences)
        counts = [len(line) for _, line in own]
        firsts = exposures + np.concatenate([[0], np.cumsum(counts)[:-1]])
        waypoints = _waypoints(vertices, parts, dict(zip(rows, firsts.tolist(), strict=True)), field, flies)
        path = np.array([vertex.xyz_m for vertex in vertices])
        steps = np.diff(path, axis=0)
        landing = (path[-1, 2] - field.home_m[2]) / flies.descent_m_s
        climbing = (path[0, 2] - field.home_m[2]) / flies.climb_m_s
        record = Sortie(
            waypoints=waypoints,
            first_exposure=exposures,
            exposures=int(sum(counts)),
            length_m=float(np.sum(np.linalg.norm(steps, axis=1))),
            duration_s=float(reached[-1] + landing + climbing),
            climb_m=float(np.sum(np.maximum(steps[:, 2], 0.0)) + path[0, 2] - field.home_m[2]),
        )
        times.append(climbing + _exposure_times([parts[row] for row in rows], rows[0], vertices, reached, flies))
        sorties.append(_Flown(record=record, vertices=tuple(vertices)))
        exposures += int(sum(counts))
    return sorties, np.concatenate(times)


def _exposure_times(
    parts: Sequence[_Part], first_line: int, vertices: Sequence[Vertex], reached: Array, flies: Performance
) -> Array:
    """Return when each exposure of a sortie is taken: from the beginning of its line on."""
    begins: dict[int, float] = {}
    for vertex, time in zip(vertices, reached, strict=True):
        if vertex.line != HOME:
            begins.setdefault(vertex.line, float(time))
    found: list[Array] = []
    for number, part in enumerate(parts):
        taken: LineTimes = line_times(part.line, flies)
        found.append(begins[first_line + number] + taken.station_s)
    return np.concatenate(found)


def _waypoints(
    vertices: Sequence[Vertex], parts: Sequence[_Part], firsts: dict[int, int], field: Airfield, flies: Performance
) -> tuple[Waypoint, ...]:
    path = np.array([vertex.xyz_m for vertex in vertices])
    places = field.ground.local_map.geographic_from_map(path[:, :2])
    above = path[:, 2] - field.ground.heights_at(path[:, :2])
    headings = _headings(vertices, path, parts, field)
    return tuple(
        Waypoint(
            role=vertex.role,
            latitude_deg=float(places[k, 0]),
            longitude_deg=float(places[k, 1]),
            height_ellipsoid_m=float(path[k, 2]),
            height_above_takeoff_m=float(path[k, 2] - field.home_m[2]),
            height_above_ground_m=float(above[k]),
            speed_m_s=vertex.speed_m_s,
            heading_deg=float(headings[k]),
            hold_s=flies.hold_s if vertex.stops else 0.0,
            strip=vertex.line,
            exposure=firsts[vertex.line] + vertex.station if vertex.station >= 0 else -1,
        )
        for k, vertex in enumerate(vertices)
    )


def _headings(vertices: Sequence[Vertex], path: Array, parts: Sequence[_Part], field: Airfield) -> Array:
    """Return the vehicle's heading at each vertex, degrees from north: that of the leg, or of the line's camera."""
    steps = np.diff(path[:, :2], axis=0)
    result = np.zeros(len(path))
    last = 0.0
    for k, vertex in enumerate(vertices):
        if vertex.line != HOME and len(parts[vertex.line].line) > 0:
            part = parts[vertex.line]
            last = _camera_heading(part.line.rotations[vertex.near_station], part.line.path_m)
        elif k < len(steps) and np.hypot(*steps[k]) > 0.05:
            last = float(np.arctan2(steps[k, 0], steps[k, 1]))
        result[k] = last
    places = field.ground.local_map.geographic_from_map(path[:, :2])
    convergence = field.ground.local_map.convergence_rad(places[:, 0], places[:, 1])
    return np.asarray(np.degrees(result + convergence) % 360.0)


def _camera_heading(rotation: Array, path_m: Array) -> float:
    """Return where a vehicle points (rad) that flies a line: along it, or where its camera looks, if not down."""
    view = -rotation[:, 2]
    if np.hypot(view[0], view[1]) > 0.2:
        return float(np.arctan2(view[0], view[1]))
    step = path_m[-1] - path_m[0]
    return float(np.arctan2(step[0], step[1]))


def _path(sortie: _Flown) -> Array:
    return np.array([vertex.xyz_m for vertex in sortie.vertices])


def _exposures(parts: Sequence[_Part], times: Array, field: Airfield) -> PlannedExposures:
    centres = np.concatenate([part.line.centres_m for part in parts])
    counts = [len(part.line) for part in parts]
    places = field.ground.local_map.geographic_from_map(centres[:, :2])
    convergence = field.ground.local_map.convergence_rad(places[:, 0], places[:, 1])
    headings = np.concatenate(
        [[_camera_heading(rotation, part.line.path_m) for rotation in part.line.rotations] for part in parts]
    )
    c, s, zero = np.cos(convergence), np.sin(convergence), np.zeros(len(centres))
    # map axes into true east and north: a map azimuth is smaller by the convergence
    true_from_map = np.stack(
        [np.stack([c, s, zero], -1), np.stack([-s, c, zero], -1), np.stack([zero, zero, zero + 1.0], -1)], axis=1
    )
    return PlannedExposures(
        latitude_deg=np.ascontiguousarray(places[:, 0]),
        longitude_deg=np.ascontiguousarray(places[:, 1]),
        height_ellipsoid_m=np.ascontiguousarray(centres[:, 2]),
        height_above_ground_m=centres[:, 2] - field.ground.heights_at(centres[:, :2]),
        R_map_from_image=true_from_map @ np.concatenate([part.line.rotations for part in parts]),
        heading_deg=np.degrees(headings + convergence) % 360.0,
        station=np.concatenate([part.first_station + np.arange(len(part.line)) for part in parts]),
        strip=np.repeat(np.arange(len(parts)), counts),
        sortie=np.repeat([part.sortie for part in parts], counts),
        time_s=times,
        forward_overlap=np.concatenate([part.measures.forward for part in parts]),
        side_overlap=np.concatenate([part.measures.side for part in parts]),
        gsd_m=np.concatenate([part.measures.gsd_m for part in parts]),
        sees_area=np.concatenate([part.measures.sees_area for part in parts]),
    )


def _footprints(sets: Sequence[LaidSet], parts: Sequence[_Part], field: Airfield) -> Array:
    """Return latitude, longitude of the rim of each image on the ground, (exposures, n, 2); nan beyond the horizon."""
    result = []
    for part in parts:
        laid = sets[part.member]
        imaging = laid.mounting.imaging
        rims = points_on_ground(imaging, laid.mounting.ground, part.own, imaging.rim_directions)
        on_map = rims @ laid.axes.T + laid.origin_m
        flat = on_map.reshape(-1, 3)[:, :2]
        known = ~np.isnan(flat[:, 0])
        places = np.full((len(flat), 2), np.nan)
        places[known] = field.ground.local_map.geographic_from_map(flat[known])
        result.append(places.reshape(len(part.own), -1, 2))
    return np.concatenate(result)


def _strips(parts: Sequence[_Part]) -> tuple[FlightStrip, ...]:
    firsts = stations_of([part.line for part in parts])
    by_row: dict[tuple[int, int], list[int]] = {}
    for number, part in enumerate(parts):
        by_row.setdefault((part.member, part.own.row), []).append(number)
    result = []
    for number, part in enumerate(parts):
        beside = [
            other
            for step in (-1, 1)
            for other in by_row.get((part.member, part.own.row + step), [])
            if are_beside(part.own, parts[other].own)
        ]
        step = part.line.path_m[-1] - part.line.path_m[0]
        result.append(
            FlightStrip(
                area=part.line.area,
                direction_deg=float(np.degrees(np.arctan2(step[0], step[1])) % 360.0),
                base_m=part.line.base_m,
                first_exposure=int(firsts[number]),
                exposures=len(part.line),
                neighbours=tuple(beside),
                set_number=part.line.set_number,
            )
        )
    return tuple(result)


def _summary(
    request: PlanRequest,
    sets: Sequence[LaidSet],
    parts: Sequence[_Part],
    sorties: Sequence[_Flown],
    exposures: PlannedExposures,
    flies: Performance,
    clearance_m: float,
) -> PlanSummary:
    imaging = sets[0].mounting.imaging
    sees = exposures.sees_area
    gsd = exposures.gsd_m[sees] if np.any(sees) else exposures.gsd_m
    least = float(np.min(gsd[:, 0]))
    shutter, frames = request.flight.shutter_s, request.flight.video_frames_per_s
    moving = 0.0 if flies.stops else flies.speed_m_s
    depth = least * imaging.interior.principal_distance_px
    video = checks.video_pixel_m(request, imaging, depth)
    above = exposures.height_above_ground_m
    return PlanSummary(
        area_m2=float("nan"),
        images=len(exposures),
        strips=len(parts),
        sorties=len(sorties),
        length_m=float(sum(sortie.record.length_m for sortie in sorties)),
        duration_s=float(sum(sortie.record.duration_s for sortie in sorties)),
        gsd_m=(least, float(np.mean(gsd[:, 1])), float(np.max(gsd[:, 2]))),
        forward_overlap=least_and_mean(exposures.forward_overlap[sees]),
        side_overlap=least_and_mean(exposures.side_overlap[sees]),
        height_above_ground_m=(float(above.min()), float(above.mean()), float(above.max())),
        least_clearance_m=clearance_m,
        least_images=0,
        covered=float("nan"),
        covered_enough=float("nan"),
        motion_blur_px=moving * shutter / least if shutter is not None else float("nan"),
        video_motion_px=flies.speed_m_s / frames / video if frames is not None else float("nan"),
    )


def _notes(
    sorties: Sequence[_Flown],
    vehicle: VehicleProfile | None,
    flies: Performance,
    request: PlanRequest,
    clearance_m: float,
) -> list[str]:
    notes = []
    if vehicle is None:
        notes.append("no vehicle was named: endurance and wind are not checked")
    asked = request.flight.speed_m_s
    if asked is None:
        notes.append(f"speed on the strips: {flies.speed_m_s:.1f} m/s")
    points = [point for sortie in sorties for point in sortie.record.waypoints]
    level = max(point.height_above_takeoff_m - point.height_above_ground_m for point in points) + clearance_m
    if level > 1.0:
        notes.append(
            f"set the autopilot's return height to {max(level, 15.0):.0f} m above the take-off point at least: it "
            f"decides itself how high it flies home, also when a link is lost"
        )
    return notes
