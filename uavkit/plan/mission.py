"""A sortie as the plain mission items that an autopilot flies, and back: the exposures that a mission's items take.

Autopilots run DO commands once the waypoint before them is reached; ArduPilot starts the first of them at once, the
others one after another while it already flies the next leg, and starts that leg in between. Hence the order after a
waypoint: the camera's command first, a heading last (ArduPilot waits until it is reached before it runs what follows).
"""

import math
from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.flightplan import FlightPlan, Sortie, Trigger, Waypoint, WaypointRole
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.mission import Mission, MissionCommand, MissionFrame, MissionItem
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.plan.mission_exposures import ExpectedExposures, exposures_of

__all__ = ["AUTOPILOTS", "ExpectedExposures", "exposures_of", "flown_with", "item_count", "item_counts", "mission_of"]

AUTOPILOTS = {"ardupilot": 3, "px4": 12, "dji": 0, "other": 0}
"""MAV_AUTOPILOT of each; 0 is a generic one."""

USUAL_AUTOPILOT = "ardupilot"
"""Without a vehicle."""
_SPEED_STEP_M_S = 0.05
"""Smaller changes of speed are no item."""
_HEADING_STEP_DEG = 5.0
"""A vehicle whose heading lies nearer to its course needs no command: it turns with the course by itself."""
_PITCH_STEP_DEG = 0.5
_SHORTEST_COURSE_M = 1.0
"""Legs that go less far across the ground have no course."""
_DEGREE_M = 111_000.0
_A_M, _E2 = 6378137.0, 0.00669437999014
"""Half axis and squared eccentricity of WGS 84."""
_SHORT_OF_A_CORNER = 1e-4
"""Where exposures are at the corners of a path: a vehicle that comes to a corner is not kept from triggering there."""


def mission_of(
    plan: FlightPlan,
    sortie: int,
    autopilot: str,
    altitude_from: str,
    kind: VehicleKind = VehicleKind.MULTIROTOR,
) -> Mission:
    """Return the mission of one sortie (counted from 0), altitudes from ``take_off`` or ``geoid`` (EGM96).

    Raises InputError for an unknown sortie, autopilot or origin of altitudes.
    """
    flight = _sortie(plan, sortie)
    if altitude_from not in ("take_off", "geoid"):
        raise InputError(f"altitudes count from 'take_off' or 'geoid', not from {altitude_from!r}")
    if altitude_from == "geoid" and not plan.terrain:
        raise InputError(
            f"{plan.name}: without a terrain model the height of the take-off point is not known: let altitudes count "
            f"from take_off, or give a terrain model"
        )
    frame = MissionFrame.TAKE_OFF if altitude_from == "take_off" else MissionFrame.GEOID
    start = plan.take_off
    undulation_m = float(geoid_undulation_m(np.array(start.latitude_deg), np.array(start.longitude_deg)))
    speed_m_s = next((w.speed_m_s for w in flight.waypoints if w.exposure >= 0 and w.speed_m_s > 0), None)
    return Mission(
        items=tuple(_items(plan, flight, autopilot, kind, frame)),
        home_latitude_deg=start.latitude_deg,
        home_longitude_deg=start.longitude_deg,
        home_height_geoid_m=start.height_ellipsoid_m - undulation_m if plan.terrain else None,
        cruise_speed_m_s=speed_m_s,
        hover_speed_m_s=speed_m_s,
        firmware=AUTOPILOTS[autopilot],
        vehicle_type=1 if kind is VehicleKind.FIXED_WING else 2,
    )


def item_count(plan: FlightPlan, sortie: int, autopilot: str, kind: VehicleKind = VehicleKind.MULTIROTOR) -> int:
    """Return how many items a sortie takes in the autopilot's memory; ArduPilot keeps home as one of them."""
    items = sum(1 for _ in _items(plan, _sortie(plan, sortie), autopilot, kind, MissionFrame.TAKE_OFF))
    return items + (1 if autopilot == "ardupilot" else 0)


def flown_with(vehicle: VehicleProfile | None) -> tuple[str, VehicleKind]:
    """Return autopilot and kind of a vehicle, the usual ones where none is named."""
    return (USUAL_AUTOPILOT, VehicleKind.MULTIROTOR) if vehicle is None else (vehicle.autopilot, vehicle.kind)


def item_counts(plan: FlightPlan, vehicle: VehicleProfile | None) -> list[int]:
    """Return how many items each sortie takes in the autopilot's memory."""
    return [item_count(plan, sortie, *flown_with(vehicle)) for sortie in range(len(plan.sorties))]


def _sortie(plan: FlightPlan, sortie: int) -> Sortie:
    if not 0 <= sortie < len(plan.sorties):
        raise InputError(f"{plan.name}: there is no sortie {sortie + 1}, the plan has {len(plan.sorties)}")
    return plan.sorties[sortie]


def _items(
    plan: FlightPlan, flight: Sortie, autopilot: str, kind: VehicleKind, frame: MissionFrame
) -> Iterator[MissionItem]:
    """Yield the items of a sortie; what must be set on the leg to a waypoint comes before that waypoint."""
    if autopilot not in AUTOPILOTS:
        raise InputError(f"unknown autopilot {autopilot!r}{did_you_mean(autopilot, AUTOPILOTS)}")
    waypoints = flight.waypoints
    altitudes_m = _altitudes_m(waypoints, frame)
    headings, pitches = _commanded_headings_deg(waypoints, kind), _camera_pitches_deg(plan, waypoints)
    cameras = _camera_commands(plan, waypoints, autopilot)
    speed_m_s, pitch_deg = math.nan, math.nan
    for number, waypoint in enumerate(waypoints):
        if number > 0 and waypoint.speed_m_s > 0 and not abs(waypoint.speed_m_s - speed_m_s) <= _SPEED_STEP_M_S:
            speed_m_s = waypoint.speed_m_s
            yield _change_speed(speed_m_s, kind)
        if number > 0 and not math.isnan(pitches[number]) and not abs(pitches[number] - pitch_deg) <= _PITCH_STEP_DEG:
            pitch_deg = float(pitches[number])
            yield _command(MissionCommand.DO_MOUNT_CONTROL, pitch_deg, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0)
        if not math.isnan(headings[number]) and autopilot != "px4":  # PX4 refuses missions with this command
            yield _command(MissionCommand.CONDITION_YAW, float(headings[number]), 0.0, 0.0, 0.0)
        if number == 0 or not _same_place(waypoints[number - 1], waypoint):
            yaw_deg = float(headings[number]) if autopilot == "px4" else math.nan
            yield _navigate(waypoint, float(altitudes_m[number]), frame, _yaw_parameter(yaw_deg, autopilot), kind)
        yield from cameras.get(number, ())
    yield _command(MissionCommand.RETURN_TO_LAUNCH)


def _command(command: MissionCommand, *parameters: float) -> MissionItem:
    """Return an item without a position: up to seven parameters."""
    p1, p2, p3, p4, p5, p6, p7 = (*parameters, *([0.0] * (7 - len(parameters))))
    return MissionItem(
        command=int(command),
        frame=MissionFrame.COMMAND,
        parameters=(p1, p2, p3, p4),
        latitude_deg=p5,
        longitude_deg=p6,
        altitude_m=p7,
    )


def _change_speed(speed_m_s: float, kind: VehicleKind) -> MissionItem:
    """Return the command; for aeroplanes airspeed: ArduPlane takes a ground speed as a lower limit only."""
    speed_type = 0.0 if kind is VehicleKind.FIXED_WING else 1.0
    return _command(MissionCommand.DO_CHANGE_SPEED, speed_type, speed_m_s, -1.0, 0.0)


def _yaw_parameter(yaw_deg: float, autopilot: str) -> float:
    """Return parameter 4 of a waypoint: a nan is PX4's; ArduPilot ignores it, and not all programs read a nan."""
    return yaw_deg if autopilot == "px4" else 0.0


def _navigate(
    waypoint: Waypoint, altitude_m: float, frame: MissionFrame, yaw_deg: float, kind: VehicleKind
) -> MissionItem:
    take_off = waypoint.role is WaypointRole.TAKEOFF
    pitch_deg = 15.0 if kind is VehicleKind.FIXED_WING else 0.0
    return MissionItem(
        command=int(MissionCommand.TAKEOFF if take_off else MissionCommand.WAYPOINT),
        frame=frame,
        parameters=(pitch_deg if take_off else waypoint.hold_s, 0.0, 0.0, yaw_deg),
        latitude_deg=waypoint.latitude_deg,
        longitude_deg=waypoint.longitude_deg,
        altitude_m=altitude_m,
    )


def _same_place(last: Waypoint, this: Waypoint) -> bool:
    """Tell whether a waypoint adds nothing: where the exit of a strip is its last exposure."""
    return (
        last.role is not WaypointRole.TAKEOFF
        and this.hold_s == 0.0
        and this.exposure < 0
        and last.latitude_deg == this.latitude_deg
        and last.longitude_deg == this.longitude_deg
        and abs(last.height_ellipsoid_m - this.height_ellipsoid_m) < 1e-3
    )


def _altitudes_m(waypoints: Sequence[Waypoint], frame: MissionFrame) -> Array:
    if frame is MissionFrame.TAKE_OFF:
        return np.array([waypoint.height_above_takeoff_m for waypoint in waypoints])
    latitude = np.array([waypoint.latitude_deg for waypoint in waypoints])
    longitude = np.array([waypoint.longitude_deg for waypoint in waypoints])
    heights = np.array([waypoint.height_ellipsoid_m for waypoint in waypoints])
    return np.asarray(heights - geoid_undulation_m(latitude, longitude))


def _commanded_headings_deg(waypoints: Sequence[Waypoint], kind: VehicleKind) -> Array:
    """Return the heading on the leg to each waypoint (n,), nan where the course gives it, or it does not matter."""
    headings = np.full(len(waypoints), np.nan)
    if kind is VehicleKind.FIXED_WING:
        return headings
    roles = (WaypointRole.EXPOSURE, WaypointRole.PATH, WaypointRole.EXIT)
    for number in range(1, len(waypoints)):
        last, this = waypoints[number - 1], waypoints[number]
        if this.role not in roles or _same_place(last, this):
            continue
        north_m = _DEGREE_M * (this.latitude_deg - last.latitude_deg)
        east_m = _DEGREE_M * math.cos(math.radians(this.latitude_deg)) * (this.longitude_deg - last.longitude_deg)
        off_deg = abs((this.heading_deg - math.degrees(math.atan2(east_m, north_m)) + 180.0) % 360.0 - 180.0)
        if math.hypot(north_m, east_m) < _SHORTEST_COURSE_M or off_deg > _HEADING_STEP_DEG:
            headings[number] = this.heading_deg % 360.0
    return headings


def _camera_pitches_deg(plan: FlightPlan, waypoints: Sequence[Waypoint]) -> Array:
    """Return the camera's pitch on the leg to each waypoint of a strip (n,), -90 is nadir; nan outside the strips.

    Waypoints without an exposure have the pitch of the next one of their strip, else of the last.
    """
    axes_up = -plan.exposures.R_map_from_image[:, 2, 2]
    pitch_deg = np.degrees(np.arcsin(np.clip(axes_up, -1.0, 1.0)))
    pitches = np.full(len(waypoints), np.nan)
    runs = _strip_runs(waypoints)
    for run in runs:
        taken = [number for number in run if waypoints[number].exposure >= 0]
        for number in run if taken else ():
            exposure = waypoints[next((other for other in taken if other >= number), taken[-1])].exposure
            pitches[number] = round(float(pitch_deg[exposure]), 2) + 0.0  # no -0.0
    return pitches


def _strip_runs(waypoints: Sequence[Waypoint]) -> list[list[int]]:
    """Return the indices of consecutive waypoints of the same strip."""
    runs = groupby(range(len(waypoints)), key=lambda number: waypoints[number].strip)
    return [list(numbers) for strip, numbers in runs if strip >= 0]


def _camera_commands(
    plan: FlightPlan, waypoints: Sequence[Waypoint], autopilot: str
) -> dict[int, tuple[MissionItem, ...]]:
    """Return the camera's commands by the waypoint at which they are run."""
    if plan.trigger is Trigger.HOVER:
        one = _take_one(autopilot)
        return {number: (one,) for number, waypoint in enumerate(waypoints) if waypoint.exposure >= 0}
    commands: dict[int, tuple[MissionItem, ...]] = {}
    runs = _strip_runs(waypoints)
    for run in runs:
        taken = [number for number in run if waypoints[number].exposure >= 0]
        if not taken:
            continue
        strip, last = waypoints[run[0]].strip, run[-1]
        if not plan.strips[strip].base_m > 0:
            commands[taken[0]] = (_take_one(autopilot),)
            continue
        start, stop = _start_and_stop(plan, strip, waypoints[taken[-1]].speed_m_s)
        leaving = next((number for number in run if waypoints[number].role is WaypointRole.EXIT), last)
        stops = (stop,) if run is runs[-1] or not plan.images_in_turns else ()
        commands[taken[0]] = (start,) if leaving != taken[0] else (start, *stops)
        commands.setdefault(leaving, stops)
    return commands


def _take_one(autopilot: str) -> MissionItem:
    if autopilot == "px4":
        return _command(MissionCommand.IMAGE_START_CAPTURE, 0.0, 0.0, 1.0)
    return _command(MissionCommand.DO_DIGICAM_CONTROL, 0.0, 0.0, 0.0, 0.0, 1.0)


def _start_and_stop(plan: FlightPlan, strip: int, speed_m_s: float) -> tuple[MissionItem, MissionItem]:
    across_m, up_m = _steps_m(plan, strip)
    if plan.trigger is Trigger.TIME:
        if not speed_m_s > 0:
            raise InputError("triggering by time needs the speed on the strips: give speed_m_s in [flight]")
        interval_s = max(across_m, up_m) / speed_m_s
        start = _command(MissionCommand.IMAGE_START_CAPTURE, 0.0, interval_s, 0.0)
        return start, _command(MissionCommand.IMAGE_STOP_CAPTURE)
    if across_m < 0.5 * plan.strips[strip].base_m:
        raise InputError(
            f"{plan.name}: strip {strip + 1} goes up and down, and autopilots measure the distance between exposures "
            f"across the ground: trigger by hover or time"
        )
    start = _command(MissionCommand.DO_SET_CAM_TRIGG_DIST, across_m, 0.0, 1.0)
    return start, _command(MissionCommand.DO_SET_CAM_TRIGG_DIST)


def _steps_m(plan: FlightPlan, strip: int) -> tuple[float, float]:
    """Return how far it is from an exposure of a strip to the next, straight across the ground and up or down.

    On a straight strip the first is its base; on a circle the vehicle measures the chord, which is shorter.
    """
    table, base_m = plan.exposures, plan.strips[strip].base_m
    rows = np.flatnonzero(table.strip == strip)
    rows = rows[:-1][(np.diff(rows) == 1) & (np.diff(table.sortie[rows]) == 0)] if len(rows) > 1 else rows[:0]
    if len(rows) == 0:
        return base_m, 0.0
    latitude = np.radians(table.latitude_deg[rows])
    w = np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    north_m = _A_M * (1.0 - _E2) / w**3 * np.radians(table.latitude_deg[rows + 1] - table.latitude_deg[rows])
    turned_deg = (table.longitude_deg[rows + 1] - table.longitude_deg[rows] + 180.0) % 360.0 - 180.0
    east_m = _A_M / w * np.cos(latitude) * np.radians(turned_deg)
    across_m = float(np.median(np.hypot(north_m, east_m)))
    up_m = float(np.median(np.abs(table.height_ellipsoid_m[rows + 1] - table.height_ellipsoid_m[rows])))
    straight = abs(across_m - base_m) < 1e-3 * base_m
    return (base_m if straight else across_m * (1.0 - _SHORT_OF_A_CORNER)), up_m
