"""A judge of flight plans that shares nothing with the planner but the words of ``core``: slow, plain, obviously right.

Everything is computed on the curved earth: projection centres and ground points are geocentric, images look along
R_map_from_image turned by the axes east, north, up at their own exposure. The ground is the elevation model between
its nodes, or the surface of constant ellipsoidal height of the take-off point where there is none.
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import pyproj
import shapely

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import CameraProfile, image_directions
from uavkit.core.collinearity import image_coordinates
from uavkit.core.flightplan import (
    AreaKind,
    FlightPlan,
    PlannedExposures,
    Sortie,
    SurveyArea,
    Trigger,
    Waypoint,
    WaypointRole,
)
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleProfile
from uavkit.formats.plan_request import PlanRequest

PIXELS = 4181
"""Image points of an overlap (a grid of 60 x 45 has 2700)."""
PIXELS_TURN = 2584
"""The Fibonacci number before: see ``image_lattice``."""
STEP = 0.05
"""Of the march along a ray, as a share of the height above ground below the image."""
REACH = 12.0
"""How far a ray is followed, in heights above ground; beyond it counts as without ground."""
FARTHEST_M = 3000.0
BISECTIONS = 18
SIGHTS = 24
"""Places between a ground point and the camera at which the line of sight must be above the ground."""
MOST_TOLD_TOO_LOW = 0.25
"""Of a side overlap: a plan may look for ground points in the nearest images of the neighbouring strip only, which is
on the safe side; on slopes of 45 degrees with close exposures that was seen to miss 0.16."""
GEOD = pyproj.Geod(ellps="WGS84")


# ---------------------------------------------------------------------------------------------------------- the earth


@lru_cache(maxsize=1)
def _geocentric() -> pyproj.Transformer:
    return pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def geocentric(latitude_deg: Array, longitude_deg: Array, height_ellipsoid_m: Array) -> Array:
    """Return geocentric coordinates (n, 3) of WGS 84 positions, each (n,)."""
    return np.column_stack(
        _geocentric().transform(
            np.asarray(longitude_deg, float), np.asarray(latitude_deg, float), np.asarray(height_ellipsoid_m, float)
        )
    )


def geographic(xyz_m: Array) -> Array:
    """Return latitude, longitude (degrees) and ellipsoidal height (n, 3) of geocentric coordinates (n, 3)."""
    x, y, z = np.asarray(xyz_m, float).T
    longitude, latitude, height = _geocentric().transform(x, y, z, direction="INVERSE")
    return np.column_stack([latitude, longitude, height])


def R_geocentric_from_enu(latitude_deg: float, longitude_deg: float) -> Array:
    """Return the axes east, north, up (columns) at a place."""
    sb, cb = np.sin(np.radians(latitude_deg)), np.cos(np.radians(latitude_deg))
    sl, cl = np.sin(np.radians(longitude_deg)), np.cos(np.radians(longitude_deg))
    return np.array([[-sl, -sb * cl, cb * cl], [cl, -sb * sl, cb * sl], [0.0, cb, sb]])


def distance_m(latitude_deg: Array, longitude_deg: Array, to_latitude_deg: Array, to_longitude_deg: Array) -> Array:
    """Return horizontal distances on the ellipsoid; all inputs of one shape."""
    _, _, distance = GEOD.inv(longitude_deg, latitude_deg, to_longitude_deg, to_latitude_deg)
    return np.asarray(distance, float)


# --------------------------------------------------------------------------------------------------------- the ground


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The elevation model, or the surface of one height."""

    elevation: ElevationGrid | None
    level_m: float
    """Ellipsoidal height of flat ground."""

    @cached_property
    def _to_grid(self) -> pyproj.Transformer:
        assert self.elevation is not None
        return pyproj.Transformer.from_crs("EPSG:4326", self.elevation.crs, always_xy=True)

    @property
    def sigma_m(self) -> float:
        return 0.0 if self.elevation is None else self.elevation.sigma_m

    def columns_rows(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """Return places in the grid, (n, 2): its affine transformation solved for column and row."""
        assert self.elevation is not None
        easting, northing = self._to_grid.transform(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float))
        offset = np.column_stack([easting, northing]) - self.elevation.crs_from_grid[:, 2]
        return np.asarray(np.linalg.solve(self.elevation.crs_from_grid[:, :2], offset.T).T, float)

    def heights_at_nodes(self, columns_rows: Array) -> Array:
        """Interpolate bilinearly, (n,); nan outside the grid and beside voids."""
        assert self.elevation is not None
        grid = self.elevation.height_ellipsoid_m
        rows, columns = grid.shape
        x, y = columns_rows.T
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
        column = np.clip(np.where(inside, x, 0.0).astype(int), 0, columns - 2)
        row = np.clip(np.where(inside, y, 0.0).astype(int), 0, rows - 2)
        u, v = x - column, y - row
        upper = grid[row, column] * (1.0 - u) + grid[row, column + 1] * u
        lower = grid[row + 1, column] * (1.0 - u) + grid[row + 1, column + 1] * u
        return np.where(inside, upper * (1.0 - v) + lower * v, np.nan)

    def heights_m(self, latitude_deg: Array, longitude_deg: Array) -> Array:
        """Return ellipsoidal heights of the ground (n,)."""
        if self.elevation is None:
            return np.full(np.shape(latitude_deg), self.level_m)
        return self.heights_at_nodes(self.columns_rows(latitude_deg, longitude_deg))


class LocalGround:
    """The ground about one place, for many look-ups: column, row and ellipsoidal height as quadratic polynomials of
    east, north, up, fitted to what pyproj says. That they hold to a centimetre is checked each time."""

    def __init__(self, ground: Ground, place: Array, reach_m: float) -> None:
        """Place: latitude, longitude, ellipsoidal height."""
        self.ground, self.reach_m = ground, reach_m
        self.xyz_m = geocentric(*place[:, None])[0]
        self.axes = R_geocentric_from_enu(place[0], place[1])
        side = reach_m * np.linspace(-1.0, 1.0, 5)
        enu = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
        latitude, longitude, height = geographic(self.xyz_m + enu @ self.axes.T).T
        wanted = height[:, None]
        if ground.elevation is not None:
            wanted = np.column_stack([height, ground.columns_rows(latitude, longitude)])
        # the constant and linear terms are large: taking the middle off first keeps the digits
        self.middle = wanted[len(wanted) // 2]
        self.coefficients = np.linalg.lstsq(self._terms(enu), wanted - self.middle, rcond=None)[0]
        error = np.abs(self._terms(enu) @ self.coefficients + self.middle - wanted).max(axis=0)
        nodes_per_m = np.ptp(wanted, axis=0)[1:] / (2.0 * reach_m)
        assert error[0] < 0.02, f"height in a local frame is wrong by {error[0]} m"
        assert np.all(error[1:] < 0.02 * nodes_per_m), f"place in the grid is wrong by {error[1:]} nodes"

    def _terms(self, enu_m: Array) -> Array:
        x, y, z = (enu_m / self.reach_m).T
        return np.column_stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])

    def above_ground_m(self, enu_m: Array) -> Array:
        """Return heights above ground of points (n, 3) in axes east, north, up about the place."""
        values = self._terms(enu_m) @ self.coefficients + self.middle
        if self.ground.elevation is None:
            return np.asarray(values[:, 0] - self.ground.level_m)
        return np.asarray(values[:, 0] - self.ground.heights_at_nodes(values[:, 1:]))


# --------------------------------------------------------------------------------------------------------- the images


def image_lattice(camera: CameraProfile) -> Array:
    """Return image points (n, 2) spread evenly over the image: a Fibonacci lattice.

    A grid of m rows moves in steps of 1 / m where the border of the next image lies along a row: 2 % with 45 rows,
    more than the promise to be tested. All rows and columns of the lattice's points differ.
    """
    i = np.arange(PIXELS)
    u, v = (i + 0.5) / PIXELS, ((i * PIXELS_TURN) % PIXELS + 0.5) / PIXELS
    interior = camera.interior
    return np.column_stack([u * interior.width_px - 0.5, v * interior.height_px - 0.5])


class Images:
    """The images of a plan, and what they see of the ground."""

    def __init__(self, plan: FlightPlan, camera: CameraProfile, ground: Ground) -> None:
        self.plan, self.camera, self.ground = plan, camera, ground
        table = plan.exposures
        self.places = np.column_stack([table.latitude_deg, table.longitude_deg, table.height_ellipsoid_m])
        self.xyz_m = geocentric(*self.places.T)
        self.lattice_px = image_lattice(camera)
        self.directions = image_directions(self.lattice_px, camera.interior)
        self._latest: tuple[int, Array] = (-1, np.zeros((0, 3)))
        self._radius_m: dict[int, float] = {}
        self._local: dict[int, LocalGround] = {}

    def exterior(self, image: int) -> ExteriorOrientation:
        """Return the orientation of an image in geocentric axes."""
        latitude, longitude, _ = self.places[image]
        axes = R_geocentric_from_enu(latitude, longitude)
        return ExteriorOrientation(
            projection_centre_m=self.xyz_m[image],
            R_object_from_image=axes @ self.plan.exposures.R_map_from_image[image],
        )

    def height_above_ground_m(self, image: int) -> float:
        """Return the height of the projection centre vertically above the ground."""
        latitude, longitude, height = self.places[image]
        return float(height - self.ground.heights_m(np.array([latitude]), np.array([longitude]))[0])

    def local(self, image: int) -> LocalGround:
        """Return the ground about an image."""
        if image not in self._local:
            reach_m = min(REACH * max(self.height_above_ground_m(image), 1.0), FARTHEST_M)
            self._local[image] = LocalGround(self.ground, self.places[image], reach_m)
        return self._local[image]

    def ground_points_m(self, image: int) -> Array:
        """Return geocentric ground points (n, 3) of the lattice; nan where a ray finds no ground."""
        if self._latest[0] != image:
            local = self.local(image)
            rays = self.directions @ self.plan.exposures.R_map_from_image[image].T
            rays = rays / np.linalg.norm(rays, axis=1)[:, None]
            enu = rays * ray_lengths_m(local, rays, STEP * self.height_above_ground_m(image))[:, None]
            self._latest = (image, local.xyz_m + enu @ local.axes.T)
            self._radius_m[image] = float(np.nanmax(np.linalg.norm(enu, axis=1), initial=0.0))
        return self._latest[1]

    def inside(self, image: int, xyz_m: Array) -> Flags:
        """Tell which geocentric points (n, 3) lie in an image, whatever is between."""
        interior = self.camera.interior
        column, row = image_coordinates(xyz_m, self.exterior(image), interior).T
        with np.errstate(invalid="ignore"):
            beside = np.abs(column - (interior.width_px - 1) / 2) <= interior.width_px / 2
            above = np.abs(row - (interior.height_px - 1) / 2) <= interior.height_px / 2
        return np.asarray(beside & above)

    def visible(self, image: int, xyz_m: Array) -> Flags:
        """Tell from which geocentric points (n, 3) on the ground the projection centre can be seen over the ground."""
        if self.ground.elevation is None or not len(xyz_m):
            return np.ones(len(xyz_m), bool)
        local = self.local(image)
        enu = (xyz_m - local.xyz_m) @ local.axes
        shares = np.linspace(0.03, 0.99, SIGHTS)
        above = local.above_ground_m((shares[:, None, None] * enu).reshape(-1, 3)).reshape(SIGHTS, -1)
        return np.asarray(np.min(above, axis=0) > -0.05)

    def forward_overlap(self, image: int) -> float:
        """Return the share of the image whose ground points lie in the next image."""
        return float(np.mean(self.inside(image + 1, self.ground_points_m(image))))

    def strip_images(self, strip: int) -> range:
        """Return the numbers of a strip's images."""
        first = self.plan.strips[strip].first_exposure
        return range(first, first + self.plan.strips[strip].exposures)

    def side_overlap(self, image: int, strips: tuple[int, ...]) -> float:
        """Return the share of the image whose ground points lie in any image of some strips."""
        points = self.ground_points_m(image)
        left = np.flatnonzero(np.isfinite(points[:, 0]))
        others = np.concatenate([np.array(self.strip_images(strip)) for strip in strips])
        near_first = others[np.argsort(np.linalg.norm(self.xyz_m[others] - self.xyz_m[image], axis=1))]
        radius_m = self.radius_m(image)
        for other in near_first:
            if np.linalg.norm(self.xyz_m[other] - self.xyz_m[image]) > radius_m + self.radius_m(int(other)):
                break
            left = left[~self.inside(int(other), points[left])]
        return 1.0 - (len(left) + float(np.sum(~np.isfinite(points[:, 0])))) / len(points)

    def radius_m(self, image: int) -> float:
        """Return a distance beyond which an image surely shows no ground: for those that were not computed, REACH."""
        return self._radius_m.get(image, self.local(image).reach_m)

    def seen_by(self, xyz_m: Array) -> tuple[Indices, Indices]:
        """Return, for geocentric ground points (n, 3), the number of images in which they lie, and of those to which
        no ground is in the way."""
        lying, seen = np.zeros(len(xyz_m), np.int64), np.zeros(len(xyz_m), np.int64)
        for image in range(len(self.places)):
            near = np.flatnonzero(np.linalg.norm(xyz_m - self.xyz_m[image], axis=1) < self.local(image).reach_m)
            hit = near[self.inside(image, xyz_m[near])]
            lying[hit] += 1
            seen[hit] += self.visible(image, xyz_m[hit])
        return lying, seen

    def footprint_meets(self, image: int, area: "PlaneArea") -> bool:
        """Tell whether any ground point of the lattice lies in an area, or any point of its border in the image."""
        points = self.ground_points_m(image)
        places = geographic(points[np.isfinite(points[:, 0])])
        if np.any(area.contains(places[:, 0], places[:, 1])):
            return True
        return bool(np.any(self.inside(image, area.boundary_xyz_m)))


def ray_lengths_m(local: LocalGround, rays: Array, step_m: float) -> Array:
    """Return how far unit rays (n, 3) from the middle of a local frame go to the ground (n,); nan: never within reach.

    They march in equal steps until they are below ground, then the last step is halved again and again.
    """
    low, high = np.full(len(rays), np.nan), np.full(len(rays), np.nan)
    going = np.arange(len(rays))
    for length_m in np.arange(step_m, local.reach_m, step_m):
        above = local.above_ground_m(rays[going] * length_m)
        below = above <= 0.0
        low[going[below]], high[going[below]] = length_m - step_m, length_m
        going = going[above > 0.0]
        if not len(going):
            break
    found = np.flatnonzero(np.isfinite(low))
    for _ in range(BISECTIONS):
        middle = (low[found] + high[found]) / 2.0
        below = local.above_ground_m(rays[found] * middle[:, None]) <= 0.0
        high[found[below]], low[found[~below]] = middle[below], middle[~below]
    return np.asarray((low + high) / 2.0)


# ---------------------------------------------------------------------------------------------------------- the areas


class PlaneArea:
    """A polygon with holes in an azimuthal equidistant map about its first vertex."""

    def __init__(self, area: SurveyArea, ground: Ground) -> None:
        assert area.kind is AreaKind.POLYGON
        latitude, longitude = area.latitude_longitude_deg[0]
        self.map = pyproj.Proj(f"+proj=aeqd +lat_0={float(latitude)!r} +lon_0={float(longitude)!r} +ellps=WGS84")
        rings = [np.column_stack(self.map(ring[:, 1], ring[:, 0])) for ring in self._rings(area)]
        self.polygon = shapely.Polygon(rings[0], rings[1:])
        assert self.polygon.is_valid
        shapely.prepare(self.polygon)
        self.ground = ground

    @staticmethod
    def _rings(area: SurveyArea) -> list[Array]:
        return [area.latitude_longitude_deg, *area.holes_deg]

    def contains(self, latitude_deg: Array, longitude_deg: Array) -> Flags:
        """Tell which places (n,) lie in the area or on its border."""
        x, y = self.map(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float))
        return np.asarray(shapely.intersects_xy(self.polygon, x, y))

    def on_ground(self, xy_m: Array) -> Array:
        """Return geocentric points (n, 3) on the ground of the plane's (n, 2)."""
        longitude, latitude = self.map(xy_m[:, 0], xy_m[:, 1], inverse=True)
        return geocentric(latitude, longitude, self.ground.heights_m(latitude, longitude))

    def inner_xyz_m(self, count: int) -> Array:
        """Return at least a number of geocentric points on the ground of the area, evenly spread."""
        west, south, east, north = self.polygon.bounds
        total = int(count * (east - west) * (north - south) / self.polygon.area * 1.1) + 50
        i = np.arange(total)
        # an additive recurrence with two irrational steps fills the rectangle evenly
        x = west + (east - west) * np.modf(0.5 + i * 0.7548776662466927)[0]
        y = south + (north - south) * np.modf(0.5 + i * 0.5698402909980532)[0]
        inside = shapely.contains_xy(self.polygon, x, y)
        assert inside.sum() >= count
        return self.on_ground(np.column_stack([x[inside], y[inside]]))

    @cached_property
    def boundary_xyz_m(self) -> Array:
        """Geocentric points of the outline and the holes: all vertices, and some 400 between."""
        step = self.polygon.length / 400.0
        parts = [shapely.get_coordinates(shapely.segmentize(ring, step)) for ring in self._lines()]
        return self.on_ground(np.vstack(parts))

    def _lines(self) -> list[shapely.LinearRing]:
        return [self.polygon.exterior, *self.polygon.interiors]


# ----------------------------------------------------------------------------------------------------------- the path


@dataclass(frozen=True, kw_only=True)
class Leg:
    """The straight way from a waypoint to the next."""

    start: Waypoint
    end: Waypoint
    length_m: float
    """Horizontal."""
    along_m: Array
    """Places (n,) at which it was looked at, from its start."""
    above_ground_m: Array
    """There."""

    @property
    def climb_m_s(self) -> float:
        """Vertical speed, up positive; 0 where the vehicle goes straight up or down: its autopilot then sets it."""
        if self.length_m < 1.0:
            return 0.0
        rise_m = self.end.height_ellipsoid_m - self.start.height_ellipsoid_m
        return rise_m / (self.length_m / self.end.speed_m_s)


def path_legs(sortie: Sortie, ground: Ground, step_m: float) -> list[Leg]:
    """Return the legs of a sortie with heights above ground each step: along the geodesic, linear in height."""
    legs = []
    for start, end in zip(sortie.waypoints[:-1], sortie.waypoints[1:], strict=True):
        azimuth, _, length_m = GEOD.inv(start.longitude_deg, start.latitude_deg, end.longitude_deg, end.latitude_deg)
        shares = np.linspace(0.0, 1.0, max(2, int(np.ceil(length_m / step_m)) + 1))
        n = len(shares)
        longitude, latitude, _ = GEOD.fwd(
            np.full(n, start.longitude_deg), np.full(n, start.latitude_deg), np.full(n, azimuth), shares * length_m
        )
        height = start.height_ellipsoid_m + shares * (end.height_ellipsoid_m - start.height_ellipsoid_m)
        above = height - ground.heights_m(np.asarray(latitude), np.asarray(longitude))
        legs.append(Leg(start=start, end=end, length_m=length_m, along_m=shares * length_m, above_ground_m=above))
    return legs


def path_heights(sortie: Sortie, ground: Ground, step_m: float) -> Array:
    """Return heights above ground along a whole sortie (n,)."""
    return np.concatenate([leg.above_ground_m for leg in path_legs(sortie, ground, step_m)])


def strip_legs(legs: list[Leg]) -> list[list[Leg]]:
    """Return, for each pass along a strip, its legs from ENTRY (or the first EXPOSURE) to EXIT.

    A pass without EXIT ends before the first waypoint that is neither EXPOSURE nor PATH.
    """
    inner = (WaypointRole.EXPOSURE, WaypointRole.PATH, WaypointRole.EXIT)
    passes: list[list[Leg]] = []
    going = False
    for leg in legs:
        if not going and leg.start.role in (WaypointRole.ENTRY, WaypointRole.EXPOSURE):
            passes.append([])
            going = True
        going = going and leg.end.role in inner
        if going:
            passes[-1].append(leg)
            going = leg.end.role is not WaypointRole.EXIT
    return [passed for passed in passes if passed]


# ---------------------------------------------------------------------------------------------------------- the judge


@dataclass(kw_only=True)
class Judgement:
    """What a plan really gives."""

    images: int
    judged_images: int
    forward_overlap: float = np.nan
    """Least."""
    forward_at: int = -1
    """Image of the least."""
    side_overlap: float = np.nan
    """Least, by the definition of PlannedExposures."""
    side_at: int = -1
    strict_side_overlap: float = np.nan
    """Least, if every neighbour of every image that sees the area is asked for."""
    forward_report_error: float = 0.0
    """Greatest difference to what the plan says."""
    side_told_too_high: float = 0.0
    side_told_too_low: float = 0.0
    uncovered: float = np.nan
    """Share of points in the area and on its border that lie in no image."""
    hidden: float = np.nan
    """Share that no image sees over the ground."""
    least_images: int = 0
    strip_height_deviation: float = np.nan
    """Greatest along the strips, as a share of the height asked for."""
    clearance_m: float = np.nan
    """Least, minus the stated error of the elevation model."""
    clearance_told_m: float = np.nan
    highest_m: float = np.nan
    """Greatest height above ground on the path."""
    climb_m_s: float = 0.0
    descent_m_s: float = 0.0
    slowest_m_s: float = np.nan
    faults: list[str] = field(default_factory=list)
    """Of the lists of exposures, strips and waypoints."""


def height_asked_m(request: PlanRequest, camera: CameraProfile) -> float:
    """Return the height above ground that a request asks for."""
    imaging = request.imaging
    if imaging.height_above_ground_m is not None:
        return imaging.height_above_ground_m
    assert imaging.gsd_mm is not None
    return imaging.gsd_mm / 1000.0 * camera.interior.principal_distance_px


def judge(
    plan: FlightPlan,
    request: PlanRequest,
    camera: CameraProfile,
    elevation: ElevationGrid | None,
    most_images: int | None = None,
) -> Judgement:
    """Judge a plan of strips over polygons; with ``most_images`` the overlaps of that many, ends of strips first."""
    ground = Ground(elevation=elevation, level_m=plan.take_off.height_ellipsoid_m)
    images = Images(plan, camera, ground)
    areas = {area.name: PlaneArea(area, ground) for area in plan.areas}
    chosen = chosen_images(plan, most_images)
    result = Judgement(images=len(plan.exposures), judged_images=len(chosen))
    judge_lists(result, plan, request)
    judge_forward(result, images, chosen)
    judge_side(result, images, areas, chosen)
    judge_coverage(result, images, list(areas.values()))
    judge_path(result, plan, ground, height_asked_m(request, camera))
    judge_triggers(result, plan, camera)
    return result


def chosen_images(plan: FlightPlan, most: int | None) -> list[int]:
    """Return which images are judged: all, or the first and last two of strips and the others spread evenly."""
    everything = list(range(len(plan.exposures)))
    if most is None or len(everything) <= most:
        return everything
    ends = set()
    for strip in plan.strips:
        first, last = strip.first_exposure, strip.first_exposure + strip.exposures - 1
        ends |= {first, min(first + 1, last), max(last - 1, first), last}
    chosen = sorted(ends)
    if len(chosen) > most // 2:
        chosen = [chosen[k] for k in np.unique(np.linspace(0, len(chosen) - 1, most // 2).astype(int))]
    spread = np.unique(np.linspace(0, len(everything) - 1, most - len(chosen)).astype(int))
    return sorted({*chosen, *(int(k) for k in spread)})


def judge_lists(result: Judgement, plan: FlightPlan, request: PlanRequest) -> None:
    """Check that strips and exposures belong together, and that strips side by side are each other's neighbours."""
    table = plan.exposures
    expected = 0
    for number, strip in enumerate(plan.strips):
        if strip.first_exposure != expected or strip.exposures < 1:
            result.faults.append(f"strip {number} begins at exposure {strip.first_exposure}, not at {expected}")
        rows = slice(strip.first_exposure, strip.first_exposure + strip.exposures)
        if np.any(table.strip[rows] != number):
            result.faults.append(f"exposures of strip {number} name another strip")
        if any(number not in plan.strips[other].neighbours for other in strip.neighbours):
            result.faults.append(f"strip {number} is not a neighbour of its neighbours {strip.neighbours}")
        expected = strip.first_exposure + strip.exposures
    if expected != len(table):
        result.faults.append(f"strips hold {expected} exposures, the table {len(table)}")
    finite = (table.latitude_deg, table.longitude_deg, table.height_ellipsoid_m, table.R_map_from_image, table.time_s)
    if not all(np.all(np.isfinite(values)) for values in finite):
        result.faults.append("exposures with nan")
    if np.any(table.height_ellipsoid_m < -1000.0):
        result.faults.append("exposures far below the ellipsoid")
    for pair in unlisted_neighbours(plan):
        result.faults.append(f"strips {pair[0]} and {pair[1]} lie side by side and are no neighbours")
    result.faults.extend(heading_faults(plan))
    if len(plan.sorties) == 0 or len(table) == 0:
        result.faults.append("nothing is flown")


def heading_faults(plan: FlightPlan) -> list[str]:
    """Compare headings with the azimuth to the next exposure of the strip, and images with headings, to 0.05 degrees;
    an image's sides lie along and across the flight."""
    table = plan.exposures
    faults = []
    inner = np.flatnonzero(table.strip[:-1] == table.strip[1:])
    azimuth, _, _ = GEOD.inv(
        table.longitude_deg[inner],
        table.latitude_deg[inner],
        table.longitude_deg[inner + 1],
        table.latitude_deg[inner + 1],
    )
    off = np.abs((np.asarray(azimuth) - table.heading_deg[inner] + 180.0) % 360.0 - 180.0)
    if np.any(off > 0.05):
        faults.append(f"image {inner[np.argmax(off)]} heads {off.max():.2f} degrees off its way")
    top_east, top_north = table.R_map_from_image[:, 0, 1], table.R_map_from_image[:, 1, 1]
    turned = (np.degrees(np.arctan2(top_east, top_north)) - table.heading_deg + 45.0) % 90.0 - 45.0
    if np.any(np.abs(turned) > 0.05):
        faults.append(f"images are turned by {np.abs(turned).max():.2f} degrees against their heading")
    return faults


def unlisted_neighbours(plan: FlightPlan) -> list[tuple[int, int]]:
    """Return pairs of strips of one set that lie side by side, with none between, and do not name each other.

    Side by side: more than half of the shorter lies beside the other, along their direction, not much farther away than
    lines of the set usually are: farther ones lie on both sides of a gap in the area.
    """
    table = plan.exposures
    spans = []
    for strip in plan.strips:
        rows = slice(strip.first_exposure, strip.first_exposure + strip.exposures)
        origin = table.latitude_deg[0], table.longitude_deg[0]
        azimuth, _, distance = GEOD.inv(
            np.full(strip.exposures, origin[1]),
            np.full(strip.exposures, origin[0]),
            table.longitude_deg[rows],
            table.latitude_deg[rows],
        )
        # strips flown to and fro count in one direction
        turned = np.radians(np.asarray(azimuth) - strip.direction_deg % 180.0)
        along, across = np.asarray(distance) * np.cos(turned), np.asarray(distance) * np.sin(turned)
        spans.append((float(along.min()), float(along.max()), float(across.mean())))

    def beside(a: int, b: int) -> bool:
        (a0, a1, _), (b0, b1, _) = spans[a], spans[b]
        return min(a1, b1) - max(a0, b0) > 0.5 * min(a1 - a0, b1 - b0) and min(a1 - a0, b1 - b0) > 0.0

    usual_m = {}
    for key in {(strip.area, strip.set_number) for strip in plan.strips}:
        lines = sorted(spans[k][2] for k, strip in enumerate(plan.strips) if (strip.area, strip.set_number) == key)
        apart = [gap for gap in np.diff(lines) if gap > 0.5]  # parts of one line differ a little by its curvature
        usual_m[key] = float(np.median(apart)) if apart else 0.0
    missing = []
    for a, one in enumerate(plan.strips):
        for b in range(a + 1, len(plan.strips)):
            other = plan.strips[b]
            if (one.area, one.set_number) != (other.area, other.set_number) or b in one.neighbours or not beside(a, b):
                continue
            low, high = sorted((spans[a][2], spans[b][2]))
            usual = usual_m[one.area, one.set_number]
            between = any(
                low + 0.2 * usual < spans[c][2] < high - 0.2 * usual and beside(a, c) and beside(b, c)
                for c, third in enumerate(plan.strips)
                if (third.area, third.set_number) == (one.area, one.set_number)
            )
            if 0.3 * usual < high - low < 1.6 * usual and not between:
                missing.append((a, b))
    return missing


def judge_forward(result: Judgement, images: Images, chosen: list[int]) -> None:
    """Find the least forward overlap, over all images that have a next one in their strip."""
    table = images.plan.exposures
    for image in chosen:
        if image + 1 >= len(table) or table.strip[image + 1] != table.strip[image]:
            if np.isfinite(table.forward_overlap[image]):
                result.faults.append(f"the last image of a strip, {image}, has a forward overlap")
            continue
        share = images.forward_overlap(image)
        if not share >= result.forward_overlap:
            result.forward_overlap, result.forward_at = share, image
        error = abs(share - table.forward_overlap[image])
        result.forward_report_error = max(result.forward_report_error, error if np.isfinite(error) else np.inf)


def sides(plan: FlightPlan, image: int) -> list[tuple[int, ...]]:
    """Return the neighbouring strips to the left and to the right of an image, sides without any left out."""
    table, strip = plan.exposures, plan.strips[plan.exposures.strip[image]]
    left_right: tuple[list[int], list[int]] = ([], [])
    for neighbour in strip.neighbours:
        first = plan.strips[neighbour].first_exposure
        azimuth, _, distance = GEOD.inv(
            table.longitude_deg[image], table.latitude_deg[image], table.longitude_deg[first], table.latitude_deg[first]
        )
        across = distance * np.sin(np.radians(azimuth - strip.direction_deg))
        left_right[int(across > 0.0)].append(neighbour)
    return [tuple(strips) for strips in left_right if strips]


def judge_side(result: Judgement, images: Images, areas: dict[str, PlaneArea], chosen: list[int]) -> None:
    """Find the least side overlap, over all images whose footprint meets the area.

    The strips of one side count together. Where the middle of an image lies in the area both sides must show enough of
    it, where only its rim meets the area one of them; ``strict_side_overlap`` asks for every single neighbour always.
    """
    plan = images.plan
    for image in chosen:
        area = areas[plan.strips[plan.exposures.strip[image]].area]
        both = sides(plan, image)
        if not both or not images.footprint_meets(image, area):
            continue
        single = [images.side_overlap(image, (strip,)) for side in both for strip in side]
        result.strict_side_overlap = float(np.fmin(result.strict_side_overlap, min(single)))
        shares = [images.side_overlap(image, side) for side in both]
        latitude, longitude, _ = images.places[image]
        share = min(shares) if area.contains(np.array([latitude]), np.array([longitude]))[0] else max(shares)
        if not share >= result.side_overlap:
            result.side_overlap, result.side_at = share, image
        told = plan.exposures.side_overlap[image]
        # of an image that sees a sliver of the area only the plan may say that it sees none of it: nan
        result.side_told_too_high = float(np.fmax(result.side_told_too_high, told - share))
        result.side_told_too_low = float(np.fmax(result.side_told_too_low, share - told))


def judge_coverage(result: Judgement, images: Images, areas: list[PlaneArea]) -> None:
    """Count in how many images points of the areas and of their borders lie."""
    points = np.vstack([np.vstack([area.inner_xyz_m(2000), area.boundary_xyz_m]) for area in areas])
    lying, seen = images.seen_by(points)
    result.uncovered = float(np.mean(lying == 0))
    result.hidden = float(np.mean(seen == 0))
    result.least_images = int(lying.min())


def judge_path(result: Judgement, plan: FlightPlan, ground: Ground, height_m: float) -> None:
    """Measure clearance, heights along the strips, climb and descent of all sorties."""
    result.clearance_told_m = plan.summary.least_clearance_m
    for sortie in plan.sorties:
        legs = path_legs(sortie, ground, step_m=1.0)
        above = np.concatenate([leg.above_ground_m for leg in legs])
        if not np.all(np.isfinite(above)):
            result.faults.append("the path leaves the elevation model")
        result.clearance_m = np.fmin(result.clearance_m, above.min() - ground.sigma_m)
        result.highest_m = np.fmax(result.highest_m, above.max())
        result.climb_m_s = max(result.climb_m_s, *(leg.climb_m_s for leg in legs))
        result.descent_m_s = max(result.descent_m_s, *(-leg.climb_m_s for leg in legs))
        slowest = min(leg.end.speed_m_s for leg in legs if leg.length_m > 0.0)
        result.slowest_m_s = float(np.fmin(result.slowest_m_s, slowest))
        for passed in strip_legs(legs):
            heights = np.concatenate([leg.above_ground_m for leg in passed])
            worst = float(np.max(np.abs(heights - height_m))) / height_m
            result.strip_height_deviation = float(np.fmax(result.strip_height_deviation, worst))


def judge_triggers(result: Judgement, plan: FlightPlan, camera: CameraProfile) -> None:
    """Release the shutter as the mission would, and compare with the list of exposures."""
    taken: set[int] = set()
    for number, sortie in enumerate(plan.sorties):
        legs = path_legs(sortie, Ground(elevation=None, level_m=0.0), step_m=1e9)
        for passed in strip_legs(legs):
            released = released_places(passed, plan)
            first = next((leg.start.exposure for leg in passed if leg.start.exposure >= 0), -1)
            ends = WaypointRole.EXPOSURE if plan.trigger is Trigger.HOVER else WaypointRole.EXIT
            if first < 0 or passed[-1].end.role not in (ends, WaypointRole.EXIT):
                result.faults.append(f"a pass of sortie {number} has no first exposure or no exit")
                continue
            last = max(waypoint.exposure for leg in passed for waypoint in (leg.start, leg.end))
            if len(released) != last - first + 1:
                result.faults.append(f"{len(released)} pictures are taken, {last - first + 1} listed from {first} on")
                continue
            faults = place_faults(released, plan.exposures, first)
            result.faults.extend(faults)
            taken |= set(range(first, last + 1))
            if plan.trigger is not Trigger.HOVER:
                result.faults.extend(interval_faults(passed, plan, camera))
    if taken != set(range(len(plan.exposures))):
        result.faults.append(f"{len(plan.exposures) - len(taken)} listed exposures are in no sortie")


def released_places(passed: list[Leg], plan: FlightPlan) -> Array:
    """Return latitude, longitude, ellipsoidal height (n, 3) where pictures are taken in a pass along a strip.

    Hover: at each waypoint EXPOSURE. Else at the first of them, and then each base on, measured horizontally along the
    path, until EXIT.
    """
    waypoints = [passed[0].start, *(leg.end for leg in passed)]
    if plan.trigger is Trigger.HOVER:
        stops = [w for w in waypoints if w.role is WaypointRole.EXPOSURE and w.hold_s > 0]
        return np.array([(w.latitude_deg, w.longitude_deg, w.height_ellipsoid_m) for w in stops]).reshape(-1, 3)
    begin = next(k for k, w in enumerate(waypoints) if w.role is WaypointRole.EXPOSURE)
    base_m = plan.strips[waypoints[begin].strip].base_m
    places, flown_m, next_m = [], 0.0, 0.0
    for leg in passed[begin:]:
        azimuth, _, _ = GEOD.inv(
            leg.start.longitude_deg, leg.start.latitude_deg, leg.end.longitude_deg, leg.end.latitude_deg
        )
        while next_m <= flown_m + leg.length_m + 1e-6:
            share = (next_m - flown_m) / leg.length_m if leg.length_m > 0 else 0.0
            longitude, latitude, _ = GEOD.fwd(
                leg.start.longitude_deg, leg.start.latitude_deg, azimuth, next_m - flown_m
            )
            rise = leg.end.height_ellipsoid_m - leg.start.height_ellipsoid_m
            places.append((latitude, longitude, leg.start.height_ellipsoid_m + share * rise))
            next_m += base_m
        flown_m += leg.length_m
    return np.array(places).reshape(-1, 3)


def place_faults(released: Array, table: PlannedExposures, first: int) -> list[str]:
    """Compare where pictures are taken with the list: they must lie within 2 % of the height above ground."""
    rows = slice(first, first + len(released))
    apart = distance_m(released[:, 0], released[:, 1], table.latitude_deg[rows], table.longitude_deg[rows])
    higher = np.abs(released[:, 2] - table.height_ellipsoid_m[rows])
    allowed = 0.02 * table.height_above_ground_m[rows]
    wrong = np.flatnonzero((apart > allowed) | (higher > allowed))
    return [
        f"exposure {first + k} is taken {apart[k]:.2f} m beside and {higher[k]:.2f} m above or below its place"
        for k in wrong[:2]
    ]


def interval_faults(passed: list[Leg], plan: FlightPlan, camera: CameraProfile) -> list[str]:
    """Check that the camera keeps up at the speed of the pass."""
    if camera.least_interval_s is None:
        return []
    base_m = plan.strips[passed[0].start.strip].base_m
    fastest = max(leg.end.speed_m_s for leg in passed)
    if base_m / fastest < camera.least_interval_s * 0.999:
        return [f"exposures each {base_m / fastest:.2f} s, the camera needs {camera.least_interval_s} s"]
    return []


def broken_promises(
    found: Judgement, request: PlanRequest, vehicle: VehicleProfile | None = None, margin: float = 0.01
) -> list[str]:
    """Return in words what a plan promises and does not keep; overlaps may miss the request by a margin."""
    imaging, terrain, flight = request.imaging, request.terrain, request.flight
    climb = flight.climb_m_s or (vehicle.climb_m_s if vehicle else np.inf)
    descent = flight.descent_m_s or (vehicle.descent_m_s if vehicle else np.inf)
    broken = list(found.faults)
    if found.forward_report_error > margin or found.side_told_too_high > margin:
        broken.append(
            f"forward overlap told wrong by {found.forward_report_error:.4f}, side overlap too high by "
            f"{found.side_told_too_high:.4f}"
        )
    if found.side_told_too_low > MOST_TOLD_TOO_LOW:
        broken.append(f"side overlap told too low by {found.side_told_too_low:.4f}")
    if found.forward_overlap < imaging.forward_overlap - margin:
        broken.append(f"forward overlap {found.forward_overlap:.4f} of image {found.forward_at}")
    if found.side_overlap < imaging.side_overlap - margin:
        broken.append(f"side overlap {found.side_overlap:.4f} of image {found.side_at}")
    if found.uncovered > 0.0:
        broken.append(f"{found.uncovered:.4%} of the area are in no image")
    if terrain.follow and found.strip_height_deviation > terrain.tolerance + 0.002:
        broken.append(f"height off by {found.strip_height_deviation:.3f} of it in a strip")
    if found.clearance_m < terrain.least_clearance_m - 0.02:
        broken.append(f"clearance {found.clearance_m:.2f} m")
    if found.clearance_told_m > found.clearance_m + 0.05:
        broken.append(f"clearance told {found.clearance_told_m:.2f} m, is {found.clearance_m:.2f} m")
    if found.highest_m > flight.greatest_height_above_ground_m + 0.02:
        broken.append(f"{found.highest_m:.2f} m above ground")
    if found.climb_m_s > climb * 1.01 or found.descent_m_s > descent * 1.01:
        broken.append(f"climbs {found.climb_m_s:.2f}, descends {found.descent_m_s:.2f} m/s")
    if not found.slowest_m_s > 0.0:
        broken.append(f"a leg at {found.slowest_m_s} m/s")
    return broken
