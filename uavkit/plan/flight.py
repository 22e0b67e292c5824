"""From lines to flights: the path between them, its times, and its division into sorties."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import WaypointRole
from uavkit.plan.ground import Ground
from uavkit.plan.lines import HeightRule, StationLine, straight_profile

HOME = -1
"""Line number of what belongs to no line."""


@dataclass(frozen=True, kw_only=True)
class Performance:
    """How the vehicle flies this plan."""

    speed_m_s: float
    transit_m_s: float
    """Between take-off point and strips; already less where the wind asks for it."""
    climb_m_s: float
    descent_m_s: float
    acceleration_m_s2: float
    turn_radius_m: float
    hold_s: float
    stops: bool
    even_speed: bool
    """The whole strip at the speed of its slowest leg: pictures come by time."""


def transit_path(ground: Ground, rule: HeightRule, clearance_m: float, ends: tuple[Array, Array]) -> Array:
    """Return a path (k, 3) from one place to another, both included, clear of the ground.

    Where the ground is followed it is followed here too; else the path is level, at the greater height of both ends or
    higher where the ground between them asks for it, and its ends are vertical.
    """
    start, end = ends
    if rule.altitude_m is None and not ground.is_flat:
        distance, height = straight_profile(ground, rule, start[:2], end[:2])
        share = distance / max(float(distance[-1]), 1e-9)
        between = np.column_stack([start[:2] + share[:, None] * (end[:2] - start[:2]), height])
    else:
        level = np.array([[*start[:2], max(start[2], end[2])], [*end[:2], max(start[2], end[2])]])
        short = clearance_m - float(np.min(ground.clearances(level)))
        level[:, 2] += max(0.0, short)
        between = level
    path = np.concatenate([start[None], between, end[None]])
    keep = np.concatenate([[True], np.linalg.norm(np.diff(path, axis=0), axis=1) > 0.05])
    keep[-1] = True
    if len(path) > 2 and np.linalg.norm(path[-1] - path[-2]) <= 0.05:
        keep[-2] = False
    keep[0] = True
    return np.asarray(path[keep])


def leg_speeds(path_m: Array, speed_m_s: float, flies: Performance) -> tuple[Array, Array]:
    """Return speed over ground and duration of each leg of a path (k, 3), both (k - 1,), as climb and descent allow."""
    steps = np.diff(path_m, axis=0)
    horizontal = np.hypot(steps[:, 0], steps[:, 1])
    vertical = np.where(steps[:, 2] > 0.0, steps[:, 2] / flies.climb_m_s, -steps[:, 2] / flies.descent_m_s)
    duration = np.maximum(horizontal / speed_m_s, vertical)
    speeds = np.where(horizontal > 0.01, horizontal / np.maximum(duration, 1e-9), speed_m_s)
    return speeds, duration


@dataclass(frozen=True, kw_only=True)
class LineTimes:
    """What a line takes to fly."""

    station_s: Array
    """(n,) from the beginning of the line to each exposure."""
    total_s: float
    speeds_m_s: Array
    """(k,): over ground, on the leg that ends at each vertex of the path."""


def line_times(line: StationLine, flies: Performance) -> LineTimes:
    """Return the times of a line; where the vehicle stops at stations, with braking, holding and starting."""
    if len(line.path_m) == 1:
        return LineTimes(
            station_s=np.array([flies.hold_s]), total_s=flies.hold_s, speeds_m_s=np.array([flies.speed_m_s])
        )
    speeds, duration = leg_speeds(line.path_m, flies.speed_m_s, flies)
    if flies.even_speed:
        slowest = float(np.min(speeds))
        speeds, duration = leg_speeds(line.path_m, slowest, flies)
    arrives = np.concatenate([[0.0], np.cumsum(duration)])
    stops = np.zeros(len(line.path_m))
    if flies.stops:
        stops[line.station_vertex] = flies.hold_s + flies.speed_m_s / flies.acceleration_m_s2
    waited = np.cumsum(stops)
    return LineTimes(
        station_s=(arrives + waited)[line.station_vertex],
        total_s=float(arrives[-1] + waited[-1]),
        speeds_m_s=np.concatenate([speeds[:1], speeds]),
    )


@dataclass(frozen=True, kw_only=True)
class Airfield:
    """Take-off point and the rule of transits."""

    home_m: Array
    """(3,): the take-off point on the ground."""
    ground: Ground
    rules: tuple[HeightRule, ...]
    """Of each set."""
    clearance_m: float
    tops_m: tuple[float, ...] = ()
    """Of each set: the height above which nothing stands that the terrain model does not show, like a facade."""

    def between(self, ends: tuple[Array, Array], set_number: int) -> Array:
        """Return a path from one place to another, by the rule of a set."""
        return transit_path(self.ground, self.rules[set_number], self.clearance_m, ends)

    def over(self, ends: tuple[Array, Array], set_number: int) -> Array:
        """Return a path from one place to another that also passes over what stands there."""
        path = self.between(ends, set_number)
        top = self.tops_m[set_number] if self.tops_m else -np.inf
        lifted = path.copy()
        lifted[1:-1, 2] = np.maximum(path[1:-1, 2], top)
        if top > ends[1][2] and len(path) > 1:
            lifted = np.concatenate([lifted[:-1], [[*ends[1][:2], top]], lifted[-1:]])
        if top > ends[0][2] and (len(path) < 3 or not np.array_equal(path[1, :2], ends[0][:2])):
            lifted = np.concatenate([lifted[:1], [[*ends[0][:2], top]], lifted[1:]])
        return np.asarray(lifted[np.concatenate([[True], np.linalg.norm(np.diff(lifted, axis=0), axis=1) > 0.0])])


def home_legs(field: Airfield, place: Array, set_number: int) -> Array:
    """Return the path (k, 3) from the take-off point on the ground to a place, by at least one place in between.

    That is where the take-off ends, also where the place lies right above the take-off point.
    """
    path = field.over((field.home_m, place), set_number)
    return path if len(path) > 2 else np.stack([field.home_m, place, place])


def cumulative_times(lines: Sequence[tuple[int, StationLine]], times: Sequence[LineTimes], flies: Performance) -> Array:
    """Return when each station would be reached if all lines were flown without landing, (all stations,)."""
    now, result = 0.0, []
    for number, ((_, line), taken) in enumerate(zip(lines, times, strict=True)):
        if number:
            before = lines[number - 1][1]
            now += turn_time(before.path_m[-1], line.path_m[0], flies)
        result.append(now + taken.station_s)
        now += taken.total_s
    return np.concatenate(result)


def turn_time(start: Array, end: Array, flies: Performance) -> float:
    """Return about how long it takes from the end of a line to the beginning of the next."""
    step = end - start
    level = float(np.hypot(step[0], step[1])) / flies.transit_m_s
    vertical = abs(float(step[2])) / (flies.climb_m_s if step[2] > 0 else flies.descent_m_s)
    return max(level, vertical) + turn_penalty(flies)


def turn_penalty(flies: Performance) -> float:
    """Return the time that a turn costs beyond its length: braking and starting, or half a circle."""
    return flies.speed_m_s / flies.acceleration_m_s2 + np.pi * flies.turn_radius_m / flies.speed_m_s


def away_times(stations_m: Array, field: Airfield, flies: Performance) -> Array:
    """Return about how long it takes from the take-off point to each station (n, 3), and back, (n, 2)."""
    level = np.hypot(*(stations_m - field.home_m)[:, :2].T) / flies.transit_m_s
    rise = np.abs(stations_m[:, 2] - field.home_m[2])
    return np.column_stack([level + rise / flies.climb_m_s, level + rise / flies.descent_m_s]) + turn_penalty(flies)


@dataclass(frozen=True, kw_only=True)
class SortieLimits:
    """What one flight may take."""

    duration_s: float
    items: float
    overlap_stations: int


def divide(
    stations_s: Array, away_s: Array, items: Array, line_of: NDArray[np.int64], limits: SortieLimits, first: int = 0
) -> list[tuple[int, int]]:
    """Return first and last station of each sortie, from station ``first`` on.

    stations_s (n,): time of each station in one long flight; away_s (n, 2): way there and back; items (n,): running
    number of mission items. A sortie ends with a line where that costs little. Raises InputError where the limits do
    not even allow a few stations.
    """
    sorties, begin = [], first
    while begin < len(stations_s):
        taken = away_s[begin, 0] + (stations_s - stations_s[begin]) + away_s[:, 1]
        fits = (taken <= limits.duration_s) & (items - items[begin] <= limits.items)
        fits[:begin] = False
        short = np.flatnonzero(~fits[begin:])
        end = begin + int(short[0]) - 1 if len(short) else len(stations_s) - 1
        if end < min(begin + limits.overlap_stations + 1, len(stations_s) - 1):
            raise _too_short(limits, float(away_s[begin].sum()), len(short) > 0 and end < begin)
        if end < len(stations_s) - 1:
            start_of_line = int(np.searchsorted(line_of, line_of[end + 1]))
            if start_of_line - begin > 0.8 * (end - begin):
                end = start_of_line - 1
        sorties.append((begin, end))
        if end == len(stations_s) - 1:
            break
        begin = max(end + 1 - limits.overlap_stations, begin + 1)
    return sorties


def _too_short(limits: SortieLimits, away_s: float, not_even_one: bool) -> InputError:
    what = "not even one image" if not_even_one else f"no more than the {limits.overlap_stations} repeated images"
    held = [] if np.isinf(limits.duration_s) else [f"{limits.duration_s / 60.0:.1f} min (endurance minus reserve)"]
    held += [] if np.isinf(limits.items) else [f"{limits.items:g} mission items"]
    return InputError(
        f"a sortie of {' and '.join(held)} has room for {what}, since the way to the area and back takes "
        f"{away_s / 60.0:.1f} min: take off nearer to it, fly faster, reduce the reserve, or take another vehicle"
    )


def parts_of(
    lines: Sequence[tuple[int, StationLine]], starts: NDArray[np.int64], span: tuple[int, int]
) -> list[tuple[int, StationLine, int]]:
    """Return (set, line or part of it, number of its first station) for the stations first to last of a sortie."""
    result = []
    for number, (member, line) in enumerate(lines):
        first = max(span[0], int(starts[number])) - int(starts[number])
        last = min(span[1], int(starts[number]) + len(line) - 1) - int(starts[number])
        if first <= last:
            whole = first == 0 and last == len(line) - 1
            result.append((member, line if whole else line.part(first, last), int(starts[number]) + first))
    return result


@dataclass(frozen=True, kw_only=True)
class Vertex:
    """A vertex of a sortie's path with its meaning."""

    xyz_m: Array
    role: WaypointRole
    speed_m_s: float
    line: int = HOME
    """Number of the line within the plan."""
    station: int = -1
    """Number of the station within that line."""
    near_station: int = 0
    """The same, or of the station before, for vertices between stations: by it the vehicle's heading goes."""
    stops: bool = False


def sortie_vertices(
    parts: Sequence[tuple[int, StationLine]], first_line: int, field: Airfield, flies: Performance
) -> list[Vertex]:
    """Return all vertices of a sortie over parts of lines, from take-off to above the take-off point again."""
    vertices: list[Vertex] = []
    way = home_legs(field, parts[0][1].path_m[0], parts[0][0])
    roles = [WaypointRole.TAKEOFF] + [WaypointRole.TRANSIT] * (len(way) - 3)
    vertices += _bare(way[1:-1], roles, flies)
    for number, (member, line) in enumerate(parts):
        if number:
            ends, elsewhere = (parts[number - 1][1].path_m[-1], line.path_m[0]), parts[number - 1][1].area != line.area
            path = field.over(ends, member) if elsewhere else field.between(ends, member)
            vertices += _bare(path[1:-1], [WaypointRole.TURN] * len(path), flies)
        vertices += _line_vertices(line, first_line + number, flies)
    back = home_legs(field, parts[-1][1].path_m[-1], parts[-1][0])[::-1]
    vertices += _bare(back[1:-1], [WaypointRole.TRANSIT] * (len(back) - 3) + [WaypointRole.RETURN], flies)
    return vertices


def _bare(path_m: Array, roles: Sequence[WaypointRole], flies: Performance) -> list[Vertex]:
    return [Vertex(xyz_m=xyz, role=role, speed_m_s=flies.transit_m_s) for xyz, role in zip(path_m, roles, strict=False)]


def _line_vertices(line: StationLine, number: int, flies: Performance) -> list[Vertex]:
    """Return the vertices that a line needs: ends, bends, the exit, and every station where the vehicle stops."""
    speeds = line_times(line, flies).speeds_m_s
    station_at = {int(vertex): station for station, vertex in enumerate(line.station_vertex)}
    first, last = int(line.station_vertex[0]), int(line.station_vertex[-1])
    needed = line.bends.copy()
    needed[[first, last, line.exit_vertex]] = True
    if flies.stops:
        needed[line.station_vertex] = True
    result = []
    for k in np.flatnonzero(needed):
        station = station_at.get(int(k), -1)
        here = station if flies.stops or k in (first, last) else -1
        role = WaypointRole.EXPOSURE if here >= 0 else WaypointRole.PATH
        if here < 0 and k < first:
            role = WaypointRole.ENTRY if k == 0 else WaypointRole.PATH
        if here < 0 and k >= line.exit_vertex:
            role = WaypointRole.EXIT if k == line.exit_vertex else WaypointRole.TURN
        result.append(
            Vertex(
                xyz_m=line.path_m[k],
                role=role,
                speed_m_s=float(speeds[k]),
                line=number,
                station=here,
                near_station=int(np.clip(np.searchsorted(line.station_vertex, k, side="right") - 1, 0, len(line) - 1)),
                stops=flies.stops and here >= 0,
            )
        )
    return result


def with_speeds(vertices: list[Vertex], flies: Performance) -> tuple[list[Vertex], Array]:
    """Return the vertices with speeds that climb and descent allow, and the time (k,) at which each is reached, s."""
    path = np.array([vertex.xyz_m for vertex in vertices])
    result, times, now = [vertices[0]], [0.0], 0.0
    for k in range(1, len(vertices)):
        speeds, duration = leg_speeds(path[k - 1 : k + 1], vertices[k].speed_m_s, flies)
        now += float(duration[0])
        previous = vertices[k - 1]
        if previous.stops:
            now += flies.hold_s + flies.speed_m_s / flies.acceleration_m_s2
        elif previous.line != vertices[k].line and previous.line != HOME:
            now += turn_penalty(flies)
        result.append(replace(vertices[k], speed_m_s=float(speeds[0])))
        times.append(now)
    return result, np.array(times)
