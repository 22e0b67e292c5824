"""The exposures that a mission takes, anyone's: its path followed item by item, straight from place to place.

Distance triggering is followed as ArduPilot and PX4 do it: an exposure where the vehicle is as far, across the ground
and in a straight line, from the place of the last one. Corners are not cut, speed changes at once.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.frames import LocalMap
from uavkit.core.mission import Mission, MissionCommand, MissionFrame, MissionItem

_HOLDS = {16: 0, 19: 0}
"""Commands of places at which the vehicle waits, with the parameter that tells how long."""
_PLACES = frozenset({16, 17, 18, 19, 21, 22, 31, 82, 84, 85})
"""Waypoint, the loiters, landing, take-off, spline waypoint, and those of VTOL vehicles."""
_DO_JUMP, _GIMBAL_PITCH_YAW, _TRIGGER_CONTROL = 177, 1000, 2003
_FIXED_WINGS = frozenset({1, 16, 17, 18, 28})
_PX4 = 12
_SAME_STRIP_DEG = 40.0
"""Consecutive exposures belong to one strip while their direction changes by less."""
_MOST_EXPOSURES = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedExposures:
    """Where a mission's items take pictures, one row each, in the order in which they are taken."""

    latitude_deg: Array
    longitude_deg: Array
    altitude_m: Array
    frame: MissionFrame
    """What the altitudes count from."""
    heading_deg: Array
    """Of the vehicle: its course where the mission commands nothing else."""
    camera_pitch_deg: Array
    """As the mission commands the gimbal, -90 is nadir; nan where it does not."""
    strip: NDArray[np.int64]
    """Counted from 0: ends where triggering stops or the direction changes."""
    item: NDArray[np.int64]
    """Index of the item that asked for it."""

    def __len__(self) -> int:
        return len(self.latitude_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    item: int
    x_m: float
    y_m: float
    altitude_m: float
    hold_s: float = 0.0


def exposures_of(mission: Mission, speed_m_s: float | None = None) -> ExpectedExposures:
    """Return the exposures that a mission's items take; ``speed_m_s`` is that of its start where it tells none.

    Raises InputError for what cannot be followed: jumps, mixed kinds of altitude, a time interval without a speed.
    """
    frame, altitudes = _common_frame(mission)
    located = [item for item in mission.items if _has_place(item)]
    if not located:
        raise InputError(f"{_where(mission)}the mission has no waypoint: there is no path to follow")
    local_map = LocalMap(
        latitude_deg=float(np.mean([item.latitude_deg for item in located])),
        longitude_deg=float(np.mean([item.longitude_deg for item in located])),
        height_ellipsoid_m=mission.home_height_geoid_m or 0.0,  # the scale of a map changes by 1e-5 in 64 m
    )
    follower = _Follower(mission=mission, local_map=local_map, speed_m_s=speed_m_s or _own_speed(mission))
    follower.start(frame, altitudes)
    for number, item in enumerate(mission.items):
        follower.run(number, item, altitudes[number])
    return follower.exposures(frame)


def _where(mission: Mission) -> str:
    return f"{mission.source}: " if mission.source else ""


def _own_speed(mission: Mission) -> float | None:
    return mission.cruise_speed_m_s if mission.vehicle_type in _FIXED_WINGS else mission.hover_speed_m_s


def _has_place(item: MissionItem) -> bool:
    """Tell whether an item goes to a place of its own; autopilots take latitude and longitude 0 for where they are."""
    place = (item.latitude_deg, item.longitude_deg)
    return item.command in _PLACES and place != (0.0, 0.0) and all(map(math.isfinite, place))


def _common_frame(mission: Mission) -> tuple[MissionFrame, list[float]]:
    """Return what all altitudes can count from, and the altitude of each item so."""
    frames = {item.frame for item in mission.items if item.command in _PLACES}
    if MissionFrame.COMMAND in frames or (MissionFrame.TERRAIN in frames and len(frames) > 1):
        kinds = ", ".join(sorted(frame.name.lower() for frame in frames))
        raise InputError(f"{_where(mission)}the altitudes count from {kinds}: let all count from the same")
    altitudes = [item.altitude_m for item in mission.items]
    if len(frames) <= 1:
        return (frames.pop() if frames else MissionFrame.TAKE_OFF), altitudes
    if mission.home_height_geoid_m is None:
        raise InputError(
            f"{_where(mission)}the altitudes count from take-off and from sea level, and the height of the take-off "
            f"point is not told: let all count from the same"
        )
    for number, item in enumerate(mission.items):
        if item.frame is MissionFrame.TAKE_OFF:
            altitudes[number] += mission.home_height_geoid_m
    return MissionFrame.GEOID, altitudes


@dataclass
class _Follower:
    """The vehicle and its camera's triggers as the items set them, and what was taken so far."""

    mission: Mission
    local_map: LocalMap
    speed_m_s: float | None
    home: _Place | None = None
    here: _Place | None = None
    heading_deg: float = 0.0
    commanded_deg: float = math.nan
    pitch_deg: float = math.nan
    distance_m: float = 0.0
    interval_s: float = 0.0
    wait_s: float = 0.0
    """Until the next exposure by time."""
    left: int = -1
    """Exposures by time still to take, -1: no end."""
    trigger_item: int = -1
    last_xy: tuple[float, float] = (0.0, 0.0)
    runs: int = 0
    rows: list[tuple[float, float, float, float, float, int, int]] = field(default_factory=list)
    """x, y, altitude, heading, pitch, run of the trigger, item."""

    def start(self, frame: MissionFrame, altitudes: list[float]) -> None:
        """Stand at home, or at the first place where the mission does not tell home."""
        first = next(number for number, item in enumerate(self.mission.items) if _has_place(item))
        mission = self.mission
        if mission.home_latitude_deg is None or mission.home_longitude_deg is None:
            self.here = self._place(first, mission.items[first], altitudes[first])
            return
        height_m = mission.home_height_geoid_m if frame is MissionFrame.GEOID else 0.0
        x, y = self._xy(mission.home_latitude_deg, mission.home_longitude_deg)
        altitude_m = altitudes[first] if height_m is None else height_m
        self.here = self.home = _Place(item=-1, x_m=x, y_m=y, altitude_m=altitude_m)

    def run(self, number: int, item: MissionItem, altitude_m: float) -> None:
        """Fly to an item's place, or do what it commands."""
        command, (p1, p2, _, p4) = item.command, item.parameters
        if command in _PLACES:
            if command == MissionCommand.WAYPOINT and self.mission.firmware == _PX4 and math.isfinite(p4):
                self.commanded_deg = p4
            self._fly(self._place(number, item, altitude_m))
        elif command == MissionCommand.RETURN_TO_LAUNCH and self.home is not None and self.here is not None:
            self._fly(replace(self.home, item=number, altitude_m=self.here.altitude_m))
        elif command == MissionCommand.DO_CHANGE_SPEED and p1 in (0.0, 1.0) and p2 > 0:
            self.speed_m_s = p2
        elif command == MissionCommand.CONDITION_YAW and p4 == 0.0:
            self.commanded_deg = p1
        elif command == _GIMBAL_PITCH_YAW or (command == MissionCommand.DO_MOUNT_CONTROL and item.altitude_m == 2.0):
            self.pitch_deg = p1
        elif command == _DO_JUMP:
            raise InputError(f"{_where(self.mission)}item {number} jumps to another item: write the repeats out")
        else:
            self._command_camera(number, item)

    def _command_camera(self, number: int, item: MissionItem) -> None:
        command, (p1, p2, p3, _) = item.command, item.parameters
        if command == MissionCommand.DO_SET_CAM_TRIGG_DIST:
            self._trigger_by_distance(number, p1, at_once=p3)
        elif command == MissionCommand.DO_SET_CAM_TRIGG_INTERVAL:
            self._trigger_by_time(number, p1 / 1000.0, -1)
        elif command == MissionCommand.IMAGE_START_CAPTURE and (p3 == 1.0 or (p2 == 0.0 and p3 == 0.0)):
            self._take(number)
        elif command == MissionCommand.IMAGE_START_CAPTURE:
            self._trigger_by_time(number, p2, int(p3) or -1)
        elif command == MissionCommand.IMAGE_STOP_CAPTURE:
            self.interval_s = 0.0
        elif command == MissionCommand.DO_DIGICAM_CONTROL and item.latitude_deg == 1.0:
            self._take(number)
        elif command == _TRIGGER_CONTROL and p1 == 0.0:
            self.interval_s = self.distance_m = 0.0

    def _trigger_by_distance(self, number: int, distance_m: float, at_once: float) -> None:
        assert self.here is not None
        self.distance_m, self.trigger_item, self.runs = max(distance_m, 0.0), number, self.runs + 1
        self.last_xy = (self.here.x_m, self.here.y_m)
        if at_once == 1.0 and distance_m > 0:
            self._take(number)

    def _trigger_by_time(self, number: int, interval_s: float, count: int) -> None:
        self.interval_s, self.trigger_item, self.runs = max(interval_s, 0.0), number, self.runs + 1
        self.wait_s, self.left = self.interval_s, count
        if interval_s > 0:
            self._take(number)
            self.left -= count > 0

    def _take(self, number: int, share: float = 0.0, goal: _Place | None = None) -> None:
        """Note an exposure, here or at a share of the leg to a goal."""
        here, end = self.here, goal or self.here
        assert here is not None
        assert end is not None
        x, y, altitude_m = (
            a + share * (b - a)
            for a, b in ((here.x_m, end.x_m), (here.y_m, end.y_m), (here.altitude_m, end.altitude_m))
        )
        if len(self.rows) >= _MOST_EXPOSURES:
            raise InputError(f"{_where(self.mission)}item {number} asks for more than {_MOST_EXPOSURES} exposures")
        self.last_xy = (x, y)
        self.rows.append((x, y, altitude_m, self.heading_deg, self.pitch_deg, self.runs, number))

    def _fly(self, goal: _Place) -> None:
        """Fly straight to a place and wait there, taking pictures on the way."""
        assert self.here is not None
        dx, dy = goal.x_m - self.here.x_m, goal.y_m - self.here.y_m
        if not math.isnan(self.commanded_deg):
            self.heading_deg = self.commanded_deg % 360.0
        elif math.hypot(dx, dy) > 0.01:
            self.heading_deg = self._true_direction_deg(dx, dy)
        self.commanded_deg = math.nan  # holds for one leg: ArduPilot's next waypoint takes the heading back
        if self.interval_s > 0:  # with both on, ArduPilot triggers by time alone
            length_m = max(math.hypot(dx, dy), abs(goal.altitude_m - self.here.altitude_m))  # speed is over ground
            self._take_by_time(goal, self._duration_s(length_m))
        elif self.distance_m > 0:
            self._take_by_distance(goal)
        self.here = goal
        if self.interval_s > 0:
            self._take_by_time(goal, goal.hold_s)

    def _duration_s(self, length_m: float) -> float:
        if length_m > 0 and not (self.speed_m_s and self.speed_m_s > 0):
            what = f"item {self.trigger_item} triggers by time and the mission tells no speed"
            raise InputError(f"{_where(self.mission)}{what}: give it")
        return length_m / self.speed_m_s if self.speed_m_s else 0.0

    def _take_by_time(self, goal: _Place, duration_s: float) -> None:
        passed_s = 0.0
        while self.left != 0 and passed_s + self.wait_s <= duration_s + 1e-9:
            passed_s += self.wait_s
            self.wait_s = self.interval_s
            self._take(self.trigger_item, min(passed_s / duration_s, 1.0) if duration_s else 0.0, goal)
            self.left -= self.left > 0
        self.wait_s -= duration_s - passed_s
        if self.left == 0:
            self.interval_s = 0.0

    def _take_by_distance(self, goal: _Place) -> None:
        """Take a picture wherever the leg leaves the circle about the place of the last one."""
        assert self.here is not None
        start = np.array([self.here.x_m, self.here.y_m])
        along = np.array([goal.x_m, goal.y_m]) - start
        length2 = float(along @ along)
        while length2 > 0:
            off = start - np.array(self.last_xy)
            half = float(off @ along) / length2
            root = half * half - (float(off @ off) - self.distance_m**2) / length2
            share = -half + math.sqrt(max(root, 0.0))
            if share > 1.0 + 1e-9:
                return
            self._take(self.trigger_item, min(max(share, 0.0), 1.0), goal)

    def _place(self, number: int, item: MissionItem, altitude_m: float) -> _Place:
        hold_s = item.parameters[_HOLDS[item.command]] if item.command in _HOLDS else 0.0
        if _has_place(item):
            x, y = self._xy(item.latitude_deg, item.longitude_deg)
        else:
            assert self.here is not None
            x, y = self.here.x_m, self.here.y_m
        height_m = altitude_m if math.isfinite(altitude_m) else getattr(self.here, "altitude_m", 0.0)
        return _Place(item=number, x_m=x, y_m=y, altitude_m=height_m, hold_s=max(hold_s, 0.0))

    def _xy(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        x, y = self.local_map.map_from_geographic(np.array([latitude_deg]), np.array([longitude_deg]))[0]
        return float(x), float(y)

    def _true_direction_deg(self, dx: float, dy: float) -> float:
        assert self.here is not None
        (latitude, longitude), *_ = self.local_map.geographic_from_map(np.array([[self.here.x_m, self.here.y_m]]))
        convergence = float(self.local_map.convergence_rad(np.array([latitude]), np.array([longitude]))[0])
        return math.degrees(math.atan2(dx, dy) + convergence) % 360.0

    def exposures(self, frame: MissionFrame) -> ExpectedExposures:
        """Return what was taken."""
        table = np.array(self.rows, dtype=np.float64).reshape(-1, 7)
        places = self.local_map.geographic_from_map(table[:, :2])
        return ExpectedExposures(
            latitude_deg=places[:, 0],
            longitude_deg=places[:, 1],
            altitude_m=table[:, 2],
            frame=frame,
            heading_deg=table[:, 3],
            camera_pitch_deg=table[:, 4],
            strip=_strips(table[:, :3], table[:, 5]),
            item=table[:, 6].astype(np.int64),
        )


def _strips(xyz_m: Array, runs: Array) -> NDArray[np.int64]:
    """Number the strips (n,) of exposures (n, 3): a strip goes on while trigger and direction stay the same."""
    strips = np.zeros(len(xyz_m), dtype=np.int64)
    number, direction = 0, None
    for row in range(1, len(xyz_m)):
        step = xyz_m[row] - xyz_m[row - 1]
        if runs[row] != runs[row - 1] or (direction is not None and _turn_deg(direction, step) > _SAME_STRIP_DEG):
            number, direction = number + 1, None
        elif np.any(step):
            direction = step
        strips[row] = number
    return strips


def _turn_deg(first: Array, second: Array) -> float:
    """Return the angle between two directions (3,), across the ground where both go far across it."""
    a, b = first, second
    if all(float(np.linalg.norm(d[:2])) > 0.3 * float(np.linalg.norm(d)) for d in (a, b)):
        a, b = a[:2], b[:2]
    cosine = float(a @ b) / max(float(np.linalg.norm(a)) * float(np.linalg.norm(b)), 1e-12)
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
