"""A plan in the coordinates of its pictures: stations, paths, outlines and ground on the local map."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags
from uavkit.core.flightplan import AreaKind, FlightPlan, SurveyArea
from uavkit.core.frames import WGS84, transformed
from uavkit.core.surface import ElevationGrid
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan.planner import Planned

MOST_SAMPLES = 400_000
"""Of the ground below the path of a sortie."""


@dataclass(frozen=True, kw_only=True)
class Outline:
    """An area on the map: rings (n, 2) of a polygon, the first one outside, all closed; or a line, or a point."""

    name: str
    kind: AreaKind
    rings_m: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True)
class Profile:
    """The path of a sortie and the ground below it, sampled, over the distance flown."""

    distance_m: Array
    height_m: Array
    ground_m: Array
    """Both above the take-off point, (n,)."""

    @property
    def above_ground_m(self) -> Array:
        """Return the height above the ground (n,)."""
        return self.height_m - self.ground_m


@dataclass(frozen=True, kw_only=True)
class FacadeView:
    """Where the exposures lie before the facade that the map of coverage shows."""

    xy_m: Array
    """(n, 2): along it to the right, up from its foot; as the coverage map's coordinates."""
    sortie: Array
    """(n,)."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A plan with what it was made from, brought to the local map."""

    planned: Planned
    request: PlanRequest
    elevation: ElevationGrid | None

    @property
    def plan(self) -> FlightPlan:
        """Return the plan."""
        return self.planned.plan

    @property
    def is_facade(self) -> bool:
        """Tell whether the map of coverage lies in the plane of a facade."""
        return self.request.pattern == "facade"

    @property
    def looks_sideways(self) -> bool:
        """Tell whether the cameras look at an upright object, not down."""
        return self.request.pattern in ("facade", "orbit")

    @property
    def sigma_m(self) -> float:
        """Return the stated error of the ground's heights."""
        return self.elevation.sigma_m if self.elevation is not None else 0.0

    @property
    def limit_above_ground_m(self) -> float:
        """Return the height above the terrain model that the path may not come under."""
        return self.request.terrain.least_clearance_m + 2.0 * self.sigma_m

    @cached_property
    def stations_m(self) -> Array:
        """Return x, y (n, 2) of the exposures."""
        exposures = self.plan.exposures
        return self.planned.local_map.map_from_geographic(exposures.latitude_deg, exposures.longitude_deg)

    @cached_property
    def views(self) -> Array:
        """Return the horizontal part (n, 2) of the direction in which each image looks: map axes, at most 1 long."""
        return np.negative(self.plan.exposures.R_map_from_image[:, :2, 2])

    @cached_property
    def take_off_m(self) -> Array:
        """Return x, y (2,) of the take-off point."""
        start = self.plan.take_off
        return np.asarray(self._on_map(np.array([[start.latitude_deg, start.longitude_deg]]))[0])

    @cached_property
    def outlines(self) -> tuple[Outline, ...]:
        """Return the areas."""
        return tuple(self._outline(area) for area in self.plan.areas)

    def _outline(self, area: SurveyArea) -> Outline:
        rings = [self._on_map(ring) for ring in (area.latitude_longitude_deg, *area.holes_deg)]
        if area.kind is AreaKind.POLYGON:
            rings = [np.concatenate([ring, ring[:1]]) for ring in rings]
        return Outline(name=area.name, kind=area.kind, rings_m=tuple(rings))

    @cached_property
    def paths_m(self) -> tuple[Array, ...]:
        """Return the path (k, 3) of each sortie: x, y and height above the take-off point."""
        result = []
        for sortie in self.plan.sorties:
            places = np.array([(point.latitude_deg, point.longitude_deg) for point in sortie.waypoints])
            heights = np.array([point.height_above_takeoff_m for point in sortie.waypoints])
            result.append(np.column_stack([self._on_map(places), heights]))
        return tuple(result)

    def footprints_m(self, rows: NDArray[np.int64]) -> Array:
        """Return the rims (n, m, 2) of the images of some rows on the ground; nan beyond the horizon."""
        rims = self.planned.footprints_deg[rows]
        flat = rims.reshape(-1, 2)
        known = ~np.isnan(flat).any(axis=1)
        result = np.full(flat.shape, np.nan)
        if np.any(known):
            result[known] = self._on_map(flat[known])
        return result.reshape(rims.shape)

    def strip_line(self, strip: int) -> Array:
        """Return x, y (n, 2) of the exposures of a strip in the order of flight."""
        first = self.plan.strips[strip].first_exposure
        return self.stations_m[first : first + self.plan.strips[strip].exposures]

    def _on_map(self, degrees: Array) -> Array:
        return self.planned.local_map.map_from_geographic(degrees[:, 0], degrees[:, 1])

    # the ground

    def ground_m(self, xy_m: Array) -> tuple[Array, Flags]:
        """Return heights (n,) of the ground above the take-off point, and where (n,) the terrain model has none.

        Beyond the rim of the model its last heights go on, as the planner takes them; voids are nan.
        """
        if self.elevation is None:
            return np.zeros(len(xy_m)), np.zeros(len(xy_m), np.bool_)
        heights = self.elevation.height_ellipsoid_m
        nodes = self._nodes(xy_m)
        last = np.array(heights.shape[::-1]) - 1.0
        inside = np.clip(nodes, 0.0, last)
        beyond = np.any(np.abs(inside - nodes) > 0.5, axis=1)
        low = np.minimum(inside.astype(np.int64), np.array(heights.shape[::-1]) - 2)
        (column, row), (u, v) = low.T, (inside - low).T
        upper = heights[row, column] * (1.0 - u) + heights[row, column + 1] * u
        lower = heights[row + 1, column] * (1.0 - u) + heights[row + 1, column + 1] * u
        return upper * (1.0 - v) + lower * v - self.plan.take_off.height_ellipsoid_m, beyond

    def _nodes(self, xy_m: Array) -> Array:
        """Return column, row (n, 2) in the terrain model of map coordinates (n, 2)."""
        assert self.elevation is not None
        places = self.planned.local_map.geographic_from_map(xy_m)
        longitude_latitude = np.column_stack([places[:, ::-1], np.zeros(len(xy_m))])
        return self.elevation.grid_from_crs(transformed(WGS84, self.elevation.crs, longitude_latitude)[:, :2])

    @cached_property
    def _step_m(self) -> float:
        """Return a quarter of the distance of the terrain model's nodes."""
        if self.elevation is None:
            return float("inf")
        here = self._nodes(self.take_off_m + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return 0.25 / max(float(np.max(np.hypot(*(here[1:] - here[0]).T))), 1e-9)

    def profile(self, sortie: int) -> Profile:
        """Return the path of a sortie, every waypoint among its samples, with the ground below."""
        path = self.paths_m[sortie]
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        reached = np.concatenate([[0.0], np.cumsum(lengths)])
        step = max(self._step_m, reached[-1] / MOST_SAMPLES, 1e-3)
        extra = [np.linspace(a, b, 2 + int((b - a) / step))[:-1] for a, b in pairwise(reached)]
        distance = np.concatenate([*extra, reached[-1:]])
        x, y, height = (np.interp(distance, reached, path[:, axis]) for axis in range(3))
        ground, _ = self.ground_m(np.column_stack([x, y]))
        return Profile(distance_m=distance, height_m=height, ground_m=ground)

    def waypoint_distances_m(self, sortie: int) -> Array:
        """Return the distance flown (k,) at which each waypoint of a sortie is reached."""
        lengths = np.linalg.norm(np.diff(self.paths_m[sortie], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(lengths)])

    # a facade

    @cached_property
    def facade_view(self) -> FacadeView:
        """Return the exposures before the longest side of a facade, in the coordinates of its coverage map."""
        facade = self.request.facade
        assert facade is not None
        begin, end, number = self._longest_side(facade.side == "left")
        along = (end - begin) / np.hypot(*(end - begin))
        feet, _ = self.ground_m(begin + np.linspace(0.0, 1.0, 21)[:, None] * (end - begin))
        foot = float(np.nanmin(feet)) + facade.base_m + self.plan.take_off.height_ellipsoid_m
        exposures = self.plan.exposures
        sets = np.array([strip.set_number for strip in self.plan.strips])[exposures.strip]
        rows = np.flatnonzero(sets == number)
        right = (self.stations_m[rows] - begin) @ along
        return FacadeView(
            xy_m=np.column_stack([right, exposures.height_ellipsoid_m[rows] - foot]),
            sortie=exposures.sortie[rows].astype(np.float64),
        )

    def _longest_side(self, reverse: bool) -> tuple[Array, Array, int]:
        """Return begin and end of the longest side of all facades in the planner's order, and its number."""
        sides: list[tuple[Array, Array]] = []
        for outline in self.outlines:
            ring = outline.rings_m[0]
            if outline.kind is AreaKind.POLYGON and turns_right(ring):
                ring = ring[::-1]
            ring = ring[::-1] if reverse else ring
            sides += list(pairwise(ring))
        lengths = [float(np.hypot(*(b - a))) for a, b in sides]
        number = int(np.argmax(lengths))
        return *sides[number], number


def turns_right(ring_m: Array) -> bool:
    """Tell whether a closed ring (n, 2) runs clockwise."""
    x, y = ring_m.T
    return bool(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) < 0.0)
