"""Check a plan that exists: what its images will show on the ground, and how near the path comes to it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan
from uavkit.core.frames import LocalMap, geoid_undulation_m
from uavkit.core.mission import Mission, MissionCommand, MissionFrame
from uavkit.core.surface import ElevationGrid
from uavkit.formats.elevation_file import read_elevation
from uavkit.formats.flightplan_file import read_flightplan
from uavkit.formats.plan_request import TerrainRequest
from uavkit.formats.qgc_plan import read_plan
from uavkit.formats.waypoints_file import read_waypoints
from uavkit.plan.ground import Ground, flat_ground, ground_from_grid
from uavkit.plan.imaging import Imaging, level_axes
from uavkit.plan.lines import HeightRule, Mounting, StationLine
from uavkit.plan.measured import LineMeasures, least_and_mean, measure_lines
from uavkit.plan.mission_exposures import ExpectedExposures, exposures_of
from uavkit.plan.patterns import LaidSet

PARALLEL_RAD = np.radians(12.0)
"""Strips whose directions differ by less run beside one another."""
LOOKING_DOWN = 0.7
"""Cosine of the mean angle from the nadir below which a camera looks down."""
LEAST_PITCH_DEG = -5.0
"""A camera that looks higher than this sees no ground to speak of."""


@dataclass(frozen=True, kw_only=True)
class CheckedPlan:
    """What a plan gives; shares are 0 to 1, nan where there is nothing to measure."""

    images: int
    strips: int
    gsd_m: tuple[float, float, float]
    """Least, mean, greatest."""
    forward_overlap: tuple[float, float]
    """Least, mean."""
    side_overlap: tuple[float, float]
    """Least, mean, towards the nearest parallel strips."""
    height_above_ground_m: tuple[float, float, float]
    """Least, mean, greatest at the exposures."""
    least_clearance_m: float
    """Of the path between the first and the last exposure, minus twice the terrain model's sigma."""
    worst_place_deg: tuple[float, float]
    """Latitude and longitude of the end of the leg with the least clearance."""
    least_base_m: float
    warnings: tuple[str, ...] = ()
    """What is wrong, or what the figures do not tell, in words."""


@dataclass(frozen=True, kw_only=True)
class _Stations:
    """Exposures of any plan."""

    latitude_deg: Array
    longitude_deg: Array
    height_m: Array
    """In what the ground counts from."""
    rotations: Array
    """(n, 3, 3): map axes from image."""
    heading_rad: Array
    strip: NDArray[np.int64]


def check_flightplan(plan: FlightPlan, camera: CameraProfile, elevation: ElevationGrid | None) -> CheckedPlan:
    """Return what a plan of our own gives with a camera on a terrain model (or on the flat ground it was made for)."""
    path = np.array(
        [
            (point.latitude_deg, point.longitude_deg, point.height_ellipsoid_m)
            for sortie in plan.sorties
            for point in sortie.waypoints
        ]
    )
    ground = _ground(path, elevation, plan.take_off.height_ellipsoid_m)
    exposures = plan.exposures
    stations = _Stations(
        latitude_deg=exposures.latitude_deg,
        longitude_deg=exposures.longitude_deg,
        height_m=exposures.height_ellipsoid_m,
        rotations=_on_map(ground, exposures.latitude_deg, exposures.longitude_deg, exposures.R_map_from_image),
        heading_rad=np.radians(exposures.heading_deg),
        strip=exposures.strip,
    )
    return _checked(stations, path, ground, Imaging(profile=camera, long_side_across=True))


def check_mission(
    mission: Mission,
    camera: CameraProfile,
    elevation: ElevationGrid | None,
    speed_m_s: float | None = None,
    long_side_across: bool = True,
) -> CheckedPlan:
    """Return what any mission gives with a camera: its exposures are those that its items ask for.

    Raises InputError for a mission without exposures, or whose heights cannot be compared with the ground.
    """
    expected = exposures_of(mission, speed_m_s)
    if len(expected) == 0:
        raise InputError(f"{mission.source}: the mission takes no picture: it has no trigger command")
    places = [item for item in mission.items if item.command == MissionCommand.WAYPOINT and item.latitude_deg]
    path = np.array([(item.latitude_deg, item.longitude_deg, item.altitude_m) for item in places])
    ground, raised = _ground_and_datum(mission, expected.frame, path, elevation)
    path[:, 2] += raised(path[:, 0], path[:, 1])
    heights = expected.altitude_m + raised(expected.latitude_deg, expected.longitude_deg)
    imaging = Imaging(profile=camera, long_side_across=long_side_across)
    headings = np.radians(expected.heading_deg)
    stations = _Stations(
        latitude_deg=expected.latitude_deg,
        longitude_deg=expected.longitude_deg,
        height_m=heights,
        rotations=_on_map(
            ground,
            expected.latitude_deg,
            expected.longitude_deg,
            np.array([_looking(imaging, *view) for view in zip(headings, _pitches(expected), strict=True)]),
        ),
        heading_rad=headings,
        strip=expected.strip,
    )
    return _checked(stations, path, ground, imaging)


def _pitches(expected: ExpectedExposures) -> Array:
    """Return the pitch of the camera (rad), straight down where the mission does not command it."""
    return np.radians(np.nan_to_num(expected.camera_pitch_deg, nan=-90.0))


def _looking(imaging: Imaging, heading_rad: float, pitch_rad: float) -> Array:
    """Return R (3, 3), east-north-up from image, of a camera that looks ahead and down, its upper side up or ahead."""
    if pitch_rad > np.radians(LEAST_PITCH_DEG):
        pitch_rad = np.radians(LEAST_PITCH_DEG)
    tilt = pitch_rad + 0.5 * np.pi
    c, s = np.cos(tilt), np.sin(tilt)
    raised = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return imaging.mounted(level_axes(heading_rad) @ raised)


def _on_map(ground: Ground, latitude_deg: Array, longitude_deg: Array, rotations: Array) -> Array:
    """Return rotations (n, 3, 3) in map axes of those in true east, north and up."""
    angle = ground.local_map.convergence_rad(latitude_deg, longitude_deg)
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    map_from_true = np.stack(
        [np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, zero + 1.0], -1)], axis=1
    )
    return np.asarray(map_from_true @ rotations)


def _ground(path: Array, elevation: ElevationGrid | None, flat_m: float) -> Ground:
    low, high = path[:, :2].min(axis=0), path[:, :2].max(axis=0)
    middle = 0.5 * (low + high)
    local_map = LocalMap(latitude_deg=float(middle[0]), longitude_deg=float(middle[1]), height_ellipsoid_m=flat_m)
    if elevation is None:
        return flat_ground(local_map, flat_m)
    xy = local_map.map_from_geographic(path[:, 0], path[:, 1])
    box = (*(xy.min(axis=0) - 1.0), *(xy.max(axis=0) + 1.0))
    return ground_from_grid(local_map, elevation, (float(box[0]), float(box[1]), float(box[2]), float(box[3])))


class _Raised:
    """Adds to altitudes of a mission what the ground's heights count more."""

    def __init__(self, constant_m: float, geoid: bool) -> None:
        self.constant_m, self.geoid = constant_m, geoid

    def __call__(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        undulation = geoid_undulation_m(latitude_deg, longitude_deg) if self.geoid else 0.0
        return np.asarray(self.constant_m + undulation + np.zeros(len(latitude_deg)))


def _ground_and_datum(
    mission: Mission, frame: MissionFrame, path: Array, elevation: ElevationGrid | None
) -> tuple[Ground, _Raised]:
    """Return the ground, and what brings the mission's altitudes to its heights.

    Without a terrain model the ground is flat at the take-off point's height, 0 where altitudes count from there.
    """
    if elevation is None:
        if frame is MissionFrame.GEOID:
            if mission.home_height_geoid_m is None:
                raise InputError(
                    f"{mission.source}: its altitudes count from sea level, and it does not tell the height of the "
                    f"take-off point: give --terrain"
                )
            return _ground(path, None, mission.home_height_geoid_m), _Raised(0.0, False)
        return _ground(path, None, 0.0), _Raised(0.0, False)
    if frame is MissionFrame.TERRAIN:
        raise InputError(
            f"{mission.source}: its altitudes count from the autopilot's own terrain data: check it without"
        )
    ground = _ground(path, elevation, 0.0)
    if frame is MissionFrame.GEOID:
        return ground, _Raised(0.0, True)
    home = (mission.home_latitude_deg, mission.home_longitude_deg)
    latitude, longitude = path[0, :2] if home[0] is None or home[1] is None else (home[0], home[1])
    xy = ground.local_map.map_from_geographic(np.array([latitude]), np.array([longitude]))
    height = float(ground.heights_at(xy)[0])
    if np.isnan(height):
        ground.refuse_voids(xy, "the take-off point lies on")
    return ground, _Raised(height, False)


def _checked(stations: _Stations, path: Array, ground: Ground, imaging: Imaging) -> CheckedPlan:
    lines = _lines(stations, ground)
    laid = LaidSet(
        mounting=Mounting(
            imaging=imaging,
            ground=ground,
            rule=HeightRule(above_ground_m=1.0, altitude_m=None, tolerance_m=1.0),
            lead_m=0.0,
            stops=False,
        ),
        lines=tuple(lines),
        axes=np.eye(3),
        origin_m=np.zeros(3),
        half_turn=np.eye(3),
        sets_of_flight=0,
    )
    measures: list[LineMeasures] = []
    for number in sorted({line.set_number for line in lines}):
        measures += measure_lines(laid, [line for line in lines if line.set_number == number], 2)
    xy = ground.local_map.map_from_geographic(path[:, 0], path[:, 1])
    whole = np.column_stack([xy, path[:, 2]])
    first, last = _between_exposures(whole, lines)
    legs = ground.clearances(whole[first : last + 1])
    clearance = legs[:, 0] - 2.0 * ground.sigma_m if len(legs) else np.array([np.nan])
    worst = first + (int(np.argmin(clearance)) if len(legs) else 0)
    centres = np.concatenate([line.centres_m for line in lines])
    above = centres[:, 2] - ground.heights_at(centres[:, :2])
    gsd = np.concatenate([found.gsd_m for found in measures])
    bases = [float(np.min(np.hypot(*np.diff(line.centres_m[:, :2], axis=0).T))) for line in lines if len(line) > 1]
    return CheckedPlan(
        images=len(centres),
        strips=len(lines),
        gsd_m=(float(np.nanmin(gsd[:, 0])), float(np.nanmean(gsd[:, 1])), float(np.nanmax(gsd[:, 2]))),
        forward_overlap=least_and_mean(np.concatenate([found.forward for found in measures])),
        side_overlap=least_and_mean(np.concatenate([found.side for found in measures])),
        height_above_ground_m=(float(above.min()), float(above.mean()), float(above.max())),
        least_clearance_m=float(np.min(clearance)),
        worst_place_deg=(float(path[worst, 0]), float(path[worst, 1])),
        least_base_m=min(bases, default=float("nan")),
        warnings=_warnings(float(np.min(clearance)), np.concatenate([line.rotations for line in lines])),
    )


def _warnings(clearance_m: float, rotations: Array) -> tuple[str, ...]:
    found = ["the path runs into the ground"] if clearance_m < 0.0 else []
    if float(np.mean(rotations[:, 2, 2])) < LOOKING_DOWN:
        found.append("the camera looks ahead more than down: all figures are of the ground, not of a facade or object")
    return tuple(found)


def _between_exposures(path_m: Array, lines: list[StationLine]) -> tuple[int, int]:
    """Return the vertices of the path nearest to the first and to the last exposure: what is flown between them."""
    ends = np.array([lines[0].centres_m[0], lines[-1].centres_m[-1]])
    near = np.linalg.norm(path_m[:, None, :] - ends[None], axis=2).argmin(axis=0)
    return int(near.min()), int(near.max())


def _lines(stations: _Stations, ground: Ground) -> list[StationLine]:
    """Return the strips as lines, those of one direction numbered across it so that neighbours are known."""
    xy = ground.local_map.map_from_geographic(stations.latitude_deg, stations.longitude_deg)
    centres = np.column_stack([xy, stations.height_m])
    rows = [np.flatnonzero(stations.strip == number) for number in np.unique(stations.strip)]
    directions = [_direction(centres[row], stations.heading_rad[row[0]]) for row in rows]
    sets = _parallel_sets(directions)
    result = []
    for number, row in enumerate(rows):
        base = np.hypot(*np.diff(centres[row, :2], axis=0).T) if len(row) > 1 else np.zeros(1)
        result.append(
            StationLine(
                area="",
                set_number=sets[number],
                row=0,
                centres_m=np.ascontiguousarray(centres[row]),
                rotations=np.ascontiguousarray(stations.rotations[row]),
                base_m=float(np.mean(base)),
                path_m=centres[row],
                bends=np.ones(len(row), np.bool_),
                station_vertex=np.arange(len(row), dtype=np.int64),
                exit_vertex=len(row) - 1,
                back_exit_vertex=0,
            )
        )
    return _numbered(result, directions)


def _direction(centres_m: Array, heading_rad: float) -> float:
    """Return the direction of a strip, 0 to pi."""
    step = centres_m[-1] - centres_m[0]
    angle = float(np.arctan2(step[0], step[1])) if len(centres_m) > 1 else heading_rad
    return float(angle % np.pi)


def _parallel_sets(directions: list[float]) -> list[int]:
    sets: list[float] = []
    result = []
    for angle in directions:
        off = [abs((angle - known + 0.5 * np.pi) % np.pi - 0.5 * np.pi) for known in sets]
        if not off or min(off) > PARALLEL_RAD:
            sets.append(angle)
            off.append(0.0)
        result.append(int(np.argmin(off)))
    return result


def _numbered(lines: list[StationLine], directions: list[float]) -> list[StationLine]:
    """Return the lines with their rows: lines of a set that lie on one another share a row."""
    result = list(lines)
    for number in {line.set_number for line in lines}:
        members = [k for k, line in enumerate(lines) if line.set_number == number]
        angle = directions[members[0]]
        across = np.array(
            [float(np.mean(lines[k].centres_m[:, :2] @ [np.cos(angle), -np.sin(angle)])) for k in members]
        )
        order = np.argsort(across)
        widest = float(np.median(np.diff(across[order]))) if len(order) > 1 else 0.0
        row = 0
        for place, k in enumerate(order):
            if place and across[k] - across[order[place - 1]] > 0.2 * max(widest, 1e-3):
                row += 1
            result[members[k]] = replace(lines[members[k]], row=row)
    return result


def checked_lines(
    path: Path, camera: CameraProfile, terrain: TerrainRequest, speed_m_s: float | None = None
) -> list[str]:
    """Return what a plan gives, in lines; raises InputError where the file is no plan or cannot be compared."""
    name = path.name.lower()
    if name.endswith(".flightplan.json"):
        plan = read_flightplan(path)
        found = check_flightplan(plan, camera, _elevation(terrain, plan.areas[0].latitude_longitude_deg))
    elif name.endswith((".plan", ".waypoints", ".txt")):
        mission = read_plan(path) if name.endswith(".plan") else read_waypoints(path)
        places = [(item.latitude_deg, item.longitude_deg) for item in mission.items if item.latitude_deg]
        elevation = _elevation(terrain, np.array(places)) if places else None
        found = check_mission(mission, camera, elevation, speed_m_s)
    else:
        raise InputError(f"{path}: is no plan that can be checked: give a .plan, .waypoints or .flightplan.json file")
    return _told(found, terrain)


def _elevation(terrain: TerrainRequest, places_deg: Array) -> ElevationGrid | None:
    if not terrain.file:
        return None
    low, high = places_deg.min(axis=0) - 0.02, places_deg.max(axis=0) + 0.02
    window = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return read_elevation(Path(terrain.file), terrain.height_datum, terrain.sigma_m, window)


def _told(found: CheckedPlan, terrain: TerrainRequest) -> list[str]:
    gsd, above = found.gsd_m, found.height_above_ground_m
    rows = [
        ("images", _count(found)),
        (
            "ground distance of a pixel",
            f"{1e3 * gsd[0]:.1f} / {1e3 * gsd[1]:.1f} / {1e3 * gsd[2]:.1f} mm (least, mean, most)",
        ),
        ("forward overlap", _shares(found.forward_overlap)),
        ("side overlap", _shares(found.side_overlap)),
        ("height above ground", f"{above[0]:.1f} / {above[1]:.1f} / {above[2]:.1f} m (least, mean, most)"),
        ("least clearance of the path", _clearance(found, terrain)),
    ]
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {text}" for name, text in rows]
    if not terrain.file:
        lines.append("note: without a terrain model the ground is taken as flat at the take-off point")
    lines.append("note: side overlap is that of all images, those at the rim of the area too")
    return lines + [f"warning: {text}" for text in found.warnings]


def _count(found: CheckedPlan) -> str:
    base = "" if np.isnan(found.least_base_m) else f", least base {found.least_base_m:.2f} m"
    return f"{found.images} in {found.strips} strips{base}"


def _shares(shares: tuple[float, float]) -> str:
    return "none" if np.isnan(shares[0]) else f"{shares[0]:.1%} at least, {shares[1]:.1%} in the mean"


def _clearance(found: CheckedPlan, terrain: TerrainRequest) -> str:
    if np.isnan(found.least_clearance_m):
        return "none: no path between exposures"
    latitude, longitude = found.worst_place_deg
    less = " less twice the terrain model's error" if terrain.file else ""
    return f"{found.least_clearance_m:.1f} m{less}, near latitude {latitude:.6f}, longitude {longitude:.6f}"
