"""A sortie as DJI's waypoint file (WPML 1.0.6): a KMZ with ``wpmz/template.kml`` and ``wpmz/waylines.wpml``.

Heights count from the point of take-off. The vehicle executes the waylines; its app shows and edits the template.
Elements and values are those of DJI's Cloud API documentation. It does not say whether an action by distance or by time
takes place at its first waypoint too, and no vehicle has flown this yet: look at the images of the first flight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan, Sortie, Trigger, Waypoint, WaypointRole
from uavkit.formats.archives import write_zip

KML, WPML = "http://www.opengis.net/kml/2.2", "http://www.dji.com/wpmz/1.0.6"

_AIRCRAFT = {"DJI Matrice 350 RTK": ("89", "0"), "DJI Mavic 3E": ("77", "0")}
"""droneEnumValue and droneSubEnumValue by the vehicle's profile."""
_PAYLOADS = {"DJI Mavic 3E": "66"}
"""payloadEnumValue by the camera's profile."""
_FASTEST_M_S = 15.0
_TAKE_OFF_HEIGHTS_M = (2.0, 1500.0)
_MOST_WAYPOINTS = 65535
_LENS = "wide"
_LONGEST_DAMPING_M = 2.0
"""How far before a waypoint a turn may begin."""
_NADIR_DEG = -80.0
"""Cameras that look further up than this make the vehicle's heading matter between waypoints too."""

_Element = ElementTree.Element


@dataclass(frozen=True, slots=True, kw_only=True)
class _Station:
    """A waypoint with what is done there."""

    waypoint: Waypoint
    leaving_speed_m_s: float
    pitch_deg: float
    damping_m: float
    """0: stop."""
    actions: tuple[_Element, ...]
    """Action groups."""


def write_wpml(path: Path, plan: FlightPlan, sortie: int) -> None:
    """Write a sortie (counted from 0), whole or not at all.

    Raises InputError for speeds or numbers of waypoints that the format does not know.
    """
    if not 0 <= sortie < len(plan.sorties):
        raise InputError(f"{plan.name}: there is no sortie {sortie + 1}, the plan has {len(plan.sorties)}")
    flight = plan.sorties[sortie]
    stations = _stations(path, plan, flight)
    members = {
        "wpmz/template.kml": _template(plan, flight, stations),
        "wpmz/waylines.wpml": _waylines(plan, flight, stations),
    }
    write_zip(path, members)


def _stations(path: Path, plan: FlightPlan, flight: Sortie) -> list[_Station]:
    waypoints = _distinct([w for w in flight.waypoints if w.role is not WaypointRole.TAKEOFF])
    if not 2 <= len(waypoints) <= _MOST_WAYPOINTS:
        raise InputError(
            f"{path}: the sortie has {len(waypoints)} waypoints, DJI's format takes 2 to {_MOST_WAYPOINTS}"
        )
    lengths = [_length_m(a, b) for a, b in pairwise(waypoints)]
    pitches = _pitches_deg(plan, waypoints)
    groups = _action_groups(plan, waypoints, pitches)
    stations = []
    for number, waypoint in enumerate(waypoints):
        leaving = waypoints[min(number + 1, len(waypoints) - 1)]
        _check_speed(path, leaving.speed_m_s)
        stops = plan.trigger is Trigger.HOVER and waypoint.exposure >= 0
        passes = not stops and 0 < number < len(waypoints) - 1
        shorter_m = min(lengths[max(number - 1, 0)], lengths[min(number, len(lengths) - 1)])
        stations.append(
            _Station(
                waypoint=waypoint,
                leaving_speed_m_s=leaving.speed_m_s,
                pitch_deg=pitches[number],
                damping_m=min(0.4 * shorter_m, _LONGEST_DAMPING_M) if passes else 0.0,
                actions=tuple(groups.get(number, ())),
            )
        )
    return stations


def _check_speed(path: Path, speed_m_s: float) -> None:
    if not 0.0 < speed_m_s <= _FASTEST_M_S * (1.0 + 1e-9):
        raise InputError(
            f"{path}: a leg is flown at {speed_m_s:g} m/s, DJI's format takes up to {_FASTEST_M_S:g} m/s: change "
            f"speed_m_s in [flight]"
        )


def _distinct(waypoints: Sequence[Waypoint]) -> list[Waypoint]:
    """Leave out waypoints at the place of the one before: DJI's format wants legs with a length."""
    kept: list[Waypoint] = []
    for waypoint in waypoints:
        if not kept or waypoint.exposure >= 0 or _length_m(kept[-1], waypoint) > 0.2:
            kept.append(waypoint)
    return kept


def _length_m(a: Waypoint, b: Waypoint) -> float:
    north_m = 111_000.0 * (b.latitude_deg - a.latitude_deg)
    east_m = 111_000.0 * math.cos(math.radians(a.latitude_deg)) * (b.longitude_deg - a.longitude_deg)
    return math.hypot(north_m, east_m, b.height_ellipsoid_m - a.height_ellipsoid_m)


def _pitches_deg(plan: FlightPlan, waypoints: Sequence[Waypoint]) -> list[float]:
    """Return the camera's pitch at each waypoint: of the next exposure, else of the last; -90 is nadir."""
    pitches = []
    for number in range(len(waypoints)):
        order = (*waypoints[number:], *reversed(waypoints[:number]))
        exposure = next((waypoint.exposure for waypoint in order if waypoint.exposure >= 0), -1)
        up = -float(plan.exposures.R_map_from_image[exposure, 2, 2]) if exposure >= 0 else -1.0
        pitches.append(round(math.degrees(math.asin(min(max(up, -1.0), 1.0))), 1) + 0.0)
    return pitches


def _action_groups(
    plan: FlightPlan, waypoints: Sequence[Waypoint], pitches: Sequence[float]
) -> dict[int, list[_Element]]:
    """Return the action groups by the waypoint that carries them, numbered through."""
    groups: dict[int, list[_Element]] = {}
    count = 0

    def add(first: int, last: int, trigger: tuple[str, float | None], actions: Sequence[_Element]) -> None:
        nonlocal count
        groups.setdefault(first, []).append(_group(count, (first, last), trigger, actions))
        count += 1

    for number, waypoint in enumerate(waypoints):
        actions = [_rotate_gimbal(pitches[number])] if number == 0 or pitches[number] != pitches[number - 1] else []
        if plan.trigger is Trigger.HOVER and waypoint.exposure >= 0:
            waits = [_hover(waypoint.hold_s)] if waypoint.hold_s > 0 else []
            actions += [_rotate_vehicle(waypoint.heading_deg), *waits, _take_photo(waypoint.strip)]
        if actions:
            add(number, number, ("reachPoint", None), actions)
        run = _triggered_run(plan, waypoints, number)
        if run is not None:
            base_m, last = plan.strips[waypoint.strip].base_m, run
            by_time = plan.trigger is Trigger.TIME
            speed_m_s = waypoints[number + 1].speed_m_s
            trigger = ("multipleTiming", base_m / speed_m_s) if by_time else ("multipleDistance", base_m)
            add(number, last, trigger, [_take_photo(waypoint.strip)])
    return groups


def _triggered_run(plan: FlightPlan, waypoints: Sequence[Waypoint], number: int) -> int | None:
    """Return the waypoint at which triggering ends that begins at this one, None where none begins."""
    this = waypoints[number]
    begins = (
        number == 0 or waypoints[number - 1].strip != this.strip or waypoints[number - 1].role is WaypointRole.ENTRY
    )
    if plan.trigger is Trigger.HOVER or this.strip < 0 or this.exposure < 0 or not begins:
        return None
    last = number
    while last + 1 < len(waypoints) and waypoints[last + 1].strip == this.strip:
        last += 1
    return last if last > number and plan.strips[this.strip].base_m > 0 else None


def _add(parent: _Element, tag: str, text: str | float | None = None) -> _Element:
    """Add an element of DJI's namespace."""
    child = ElementTree.SubElement(parent, f"{{{WPML}}}{tag}")
    if text is not None:
        child.text = text if isinstance(text, str) else _number(text)
    return child


def _number(value: float) -> str:
    return f"{value:.9f}".rstrip("0").rstrip(".") if value % 1.0 else f"{value:.0f}"


def _group(
    number: int, span: tuple[int, int], trigger: tuple[str, float | None], actions: Sequence[_Element]
) -> _Element:
    group = ElementTree.Element(f"{{{WPML}}}actionGroup")
    _add(group, "actionGroupId", number)
    _add(group, "actionGroupStartIndex", span[0])
    _add(group, "actionGroupEndIndex", span[1])
    _add(group, "actionGroupMode", "sequence")
    cause = _add(group, "actionTrigger")
    _add(cause, "actionTriggerType", trigger[0])
    if trigger[1] is not None:
        _add(cause, "actionTriggerParam", round(trigger[1], 3))
    for index, action in enumerate(actions):
        action.insert(0, action.makeelement(f"{{{WPML}}}actionId", {}))
        action[0].text = str(index)
        group.append(action)
    return group


def _action(function: str, parameters: Sequence[tuple[str, str | float]]) -> _Element:
    action = ElementTree.Element(f"{{{WPML}}}action")
    _add(action, "actionActuatorFunc", function)
    holder = _add(action, "actionActuatorFuncParam")
    for tag, value in parameters:
        _add(holder, tag, value)
    return action


def _take_photo(strip: int) -> _Element:
    return _action(
        "takePhoto",
        [
            ("payloadPositionIndex", 0),
            ("fileSuffix", f"strip{strip + 1}"),
            ("payloadLensIndex", _LENS),
            ("useGlobalPayloadLensIndex", 0),
        ],
    )


def _hover(hold_s: float) -> _Element:
    return _action("hover", [("hoverTime", hold_s)])


def _rotate_vehicle(heading_deg: float) -> _Element:
    angle = ("aircraftHeading", _signed_deg(heading_deg))
    return _action("rotateYaw", [angle, ("aircraftPathMode", "clockwise")])


def _rotate_gimbal(pitch_deg: float) -> _Element:
    return _action(
        "gimbalRotate",
        [
            ("gimbalHeadingYawBase", "north"),
            ("gimbalRotateMode", "absoluteAngle"),
            ("gimbalPitchRotateEnable", 1),
            ("gimbalPitchRotateAngle", pitch_deg),
            ("gimbalRollRotateEnable", 0),
            ("gimbalRollRotateAngle", 0),
            ("gimbalYawRotateEnable", 0),
            ("gimbalYawRotateAngle", 0),
            ("gimbalRotateTimeEnable", 0),
            ("gimbalRotateTime", 0),
            ("payloadPositionIndex", 0),
        ],
    )


def _signed_deg(heading_deg: float) -> float:
    """Return a heading between -180 and 180 degrees, in tenths."""
    return round((heading_deg + 180.0) % 360.0 - 180.0, 1) + 0.0


def _document() -> tuple[_Element, _Element]:
    root = ElementTree.Element(f"{{{KML}}}kml")
    return root, ElementTree.SubElement(root, f"{{{KML}}}Document")


def _text(root: _Element) -> str:
    ElementTree.register_namespace("wpml", WPML)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode", default_namespace=KML)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'


def _add_mission_config(document: _Element, plan: FlightPlan, flight: Sortie, stations: Sequence[_Station]) -> None:
    config = _add(document, "missionConfig")
    _add(config, "flyToWaylineMode", "safely")
    _add(config, "finishAction", "goHome")
    _add(config, "exitOnRCLost", "executeLostAction")
    _add(config, "executeRCLostAction", "goBack")
    lowest_m, highest_m = _TAKE_OFF_HEIGHTS_M
    height_m = flight.waypoints[0].height_above_takeoff_m
    _add(config, "takeOffSecurityHeight", round(min(max(height_m, lowest_m), highest_m), 2))
    transit_m_s = stations[0].waypoint.speed_m_s or stations[0].leaving_speed_m_s
    _add(config, "globalTransitionalSpeed", round(min(transit_m_s, _FASTEST_M_S), 2))
    returns_m = max(waypoint.height_above_takeoff_m for waypoint in flight.waypoints)
    _add(config, "globalRTHHeight", round(max(returns_m, lowest_m), 2))
    if plan.vehicle in _AIRCRAFT:
        drone = _add(config, "droneInfo")
        _add(drone, "droneEnumValue", _AIRCRAFT[plan.vehicle][0])
        _add(drone, "droneSubEnumValue", _AIRCRAFT[plan.vehicle][1])
    if plan.camera in _PAYLOADS:
        payload = _add(config, "payloadInfo")
        _add(payload, "payloadEnumValue", _PAYLOADS[plan.camera])
        _add(payload, "payloadPositionIndex", 0)


def _waylines(plan: FlightPlan, flight: Sortie, stations: Sequence[_Station]) -> str:
    root, document = _document()
    _add_mission_config(document, plan, flight, stations)
    folder = ElementTree.SubElement(document, f"{{{KML}}}Folder")
    _add(folder, "templateId", 0)
    _add(folder, "executeHeightMode", "relativeToStartPoint")
    _add(folder, "waylineId", 0)
    _add(folder, "distance", round(flight.length_m, 1))
    _add(folder, "duration", round(flight.duration_s, 1))
    _add(folder, "autoFlightSpeed", round(_usual_speed_m_s(stations), 2))
    facing = _faces_aside(stations)
    for number, station in enumerate(stations):
        mark = _placemark(folder, number, station)
        _add(mark, "executeHeight", round(station.waypoint.height_above_takeoff_m, 3))
        _add(mark, "waypointSpeed", round(station.leaving_speed_m_s, 2))
        _add_heading_and_turn(mark, station, facing)
        mark.extend(station.actions)
    return _text(root)


def _template(plan: FlightPlan, flight: Sortie, stations: Sequence[_Station]) -> str:
    root, document = _document()
    _add(document, "author", "uavkit")
    _add_mission_config(document, plan, flight, stations)
    folder = ElementTree.SubElement(document, f"{{{KML}}}Folder")
    _add(folder, "templateType", "waypoint")
    _add(folder, "templateId", 0)
    system = _add(folder, "waylineCoordinateSysParam")
    _add(system, "coordinateMode", "WGS84")
    _add(system, "heightMode", "relativeToStartPoint")
    _add(folder, "autoFlightSpeed", round(_usual_speed_m_s(stations), 2))
    _add(folder, "globalHeight", round(stations[0].waypoint.height_above_takeoff_m, 3))
    _add(folder, "gimbalPitchMode", "usePointSetting")
    payload = _add(folder, "payloadParam")
    _add(payload, "payloadPositionIndex", 0)
    _add(payload, "imageFormat", _LENS)
    facing = _faces_aside(stations)
    usual = _add(folder, "globalWaypointHeadingParam")
    _add(usual, "waypointHeadingMode", "followWayline")
    _add(usual, "waypointHeadingPathMode", "followBadArc")
    _add(folder, "globalWaypointTurnMode", "toPointAndStopWithDiscontinuityCurvature")
    _add(folder, "globalUseStraightLine", 1)
    for number, station in enumerate(stations):
        mark = _placemark(folder, number, station)
        _add(mark, "ellipsoidHeight", round(station.waypoint.height_above_takeoff_m, 3))
        _add(mark, "height", round(station.waypoint.height_above_takeoff_m, 3))
        for tag in ("useGlobalHeight", "useGlobalSpeed", "useGlobalHeadingParam", "useGlobalTurnParam"):
            _add(mark, tag, 0)
        _add(mark, "waypointSpeed", round(station.leaving_speed_m_s, 2))
        _add_heading_and_turn(mark, station, facing)
        _add(mark, "gimbalPitchAngle", station.pitch_deg)
        mark.extend(station.actions)
    return _text(root)


def _usual_speed_m_s(stations: Sequence[_Station]) -> float:
    """Return the speed on the strips."""
    taken = (station.waypoint.speed_m_s for station in stations if station.waypoint.exposure >= 0)
    return next((speed for speed in taken if speed > 0), stations[0].leaving_speed_m_s)


def _faces_aside(stations: Sequence[_Station]) -> bool:
    return any(station.pitch_deg > _NADIR_DEG for station in stations)


def _placemark(folder: _Element, number: int, station: _Station) -> _Element:
    mark = ElementTree.SubElement(folder, f"{{{KML}}}Placemark")
    point = ElementTree.SubElement(mark, f"{{{KML}}}Point")
    place = ElementTree.SubElement(point, f"{{{KML}}}coordinates")
    place.text = f"{station.waypoint.longitude_deg:.9f},{station.waypoint.latitude_deg:.9f}"
    _add(mark, "index", number)
    return mark


def _add_heading_and_turn(mark: _Element, station: _Station, facing: bool) -> None:
    heading = _add(mark, "waypointHeadingParam")
    _add(heading, "waypointHeadingMode", "smoothTransition" if facing else "followWayline")
    if facing:
        _add(heading, "waypointHeadingAngle", f"{round(_signed_deg(station.waypoint.heading_deg))}")
    _add(heading, "waypointHeadingPathMode", "followBadArc")
    turn = _add(mark, "waypointTurnParam")
    passes = station.damping_m > 0
    stop = "toPointAndStopWithDiscontinuityCurvature"
    _add(turn, "waypointTurnMode", "toPointAndPassWithContinuityCurvature" if passes else stop)
    _add(turn, "waypointTurnDampingDist", round(station.damping_m, 2))
    _add(mark, "useStraightLine", 1)
