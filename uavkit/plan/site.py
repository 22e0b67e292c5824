"""A request brought into map coordinates: areas, ground, camera, height."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.frames import LocalMap
from uavkit.core.progress import Progress, silent
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleProfile
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan import checks
from uavkit.plan.ground import Ground, flat_ground, ground_from_grid
from uavkit.plan.imaging import Imaging
from uavkit.plan.patterns import (
    Region,
    corridor_band,
)

KINDS = {
    "polygon": (AreaKind.POLYGON,),
    "cross_grid": (AreaKind.POLYGON,),
    "corridor": (AreaKind.LINE,),
    "facade": (AreaKind.LINE, AreaKind.POLYGON),
    "orbit": (AreaKind.POINT, AreaKind.POLYGON),
}


@dataclass(frozen=True, kw_only=True)
class Site:
    """The request brought into map coordinates."""

    request: PlanRequest
    areas: tuple[SurveyArea, ...]
    regions: tuple[Region, ...]
    covered: tuple[Any, ...]
    """What is to be covered of each region, shapely's polygons on the map."""
    imaging: Imaging
    ground: Ground
    height_m: float
    lead_m: float
    home_xy: Array | None
    progress: Progress


def site_of(
    request: PlanRequest,
    areas: tuple[SurveyArea, ...],
    camera: CameraProfile,
    elevation: ElevationGrid | None,
    vehicle: VehicleProfile | None,
    progress: Progress = silent,
) -> Site:
    """Return a request in map coordinates; raises InputError where its parts do not fit one another."""
    wanted = KINDS[request.pattern]
    for area in areas:
        if area.kind not in wanted:
            raise InputError(
                f"{area.name}: the pattern {request.pattern} needs a {' or a '.join(kind.value for kind in wanted)}, "
                f"this is a {area.kind.value}"
            )
    imaging = Imaging(profile=camera, long_side_across=request.imaging.long_side == "across")
    height = _height(request, imaging)
    lead = checks.check_lead(vehicle, request)
    local_map = _local_map(areas, elevation)
    regions = tuple(Region(name=area.name, shape=shape_on_map(local_map, area)) for area in areas)
    covered = tuple(_covered(request, region) for region in regions)
    home = request.flight.take_off_deg
    home_xy = None if home is None else local_map.map_from_geographic(np.array([home[0]]), np.array([home[1]]))[0]
    if home_xy is not None and min(shape.distance(map_point(home_xy)) for shape in covered) > 20000.0:
        raise InputError(
            f"[flight] take_off_deg = {home!r}: this is more than 20 km from the area; latitude comes first"
        )
    reach = max(imaging.length_m(height), imaging.width_m(height)) + lead
    ground = _ground(local_map, elevation, covered, home_xy, reach)
    return Site(
        request=request,
        areas=areas,
        regions=regions,
        covered=covered,
        imaging=imaging,
        ground=ground,
        height_m=height,
        lead_m=lead,
        home_xy=home_xy,
        progress=progress,
    )


def _height(request: PlanRequest, imaging: Imaging) -> float:
    asked = request.imaging
    if asked.height_above_ground_m is not None:
        return asked.height_above_ground_m
    if request.pattern == "orbit":
        raise InputError("pattern = 'orbit': give [imaging] height_above_ground_m of the lowest circle, not gsd_mm")
    assert asked.gsd_mm is not None
    return imaging.height_m(1e-3 * asked.gsd_mm)


def _local_map(areas: Sequence[SurveyArea], elevation: ElevationGrid | None) -> LocalMap:
    vertices = np.concatenate([area.latitude_longitude_deg for area in areas])
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    height = 0.0 if elevation is None else float(np.nanmean(elevation.height_ellipsoid_m))
    return LocalMap(
        latitude_deg=float(middle[0]),
        longitude_deg=float(middle[1]),
        height_ellipsoid_m=height if np.isfinite(height) else 0.0,
    )


def shape_on_map(local_map: LocalMap, area: SurveyArea) -> Any:
    """Return the shape of an area on a map (shapely's)."""
    from shapely import LineString, Point, Polygon

    def on_map(ring: Array) -> Array:
        return local_map.map_from_geographic(ring[:, 0], ring[:, 1])

    outline = on_map(area.latitude_longitude_deg)
    if area.kind is AreaKind.POINT:
        return Point(outline[0])
    if area.kind is AreaKind.LINE:
        return LineString(outline)
    return Polygon(outline, [on_map(hole) for hole in area.holes_deg])


def map_point(xy: Array) -> Any:
    """Return a point of shapely's at map coordinates (2,)."""
    from shapely import Point

    return Point(xy)


def _covered(request: PlanRequest, region: Region) -> Any:
    if request.pattern == "corridor":
        assert request.corridor is not None
        return corridor_band(region.shape, request.corridor.width_m)
    if request.pattern == "orbit":
        assert request.orbit is not None
        return region.shape.centroid.buffer(0.5 * request.orbit.radius_m)
    if request.pattern == "facade" and request.facade is not None:
        return region.shape.buffer(1.0)
    return region.shape


def _ground(
    local_map: LocalMap, elevation: ElevationGrid | None, covered: Sequence[Any], home_xy: Array | None, reach_m: float
) -> Ground:
    if elevation is None:
        return flat_ground(local_map, 0.0)
    bounds = np.array([shape.bounds for shape in covered])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    if home_xy is not None:
        low, high = np.minimum(low, home_xy), np.maximum(high, home_xy)
    box = (*(low - 0.5 * reach_m), *(high + 0.5 * reach_m))
    ground = ground_from_grid(local_map, elevation, (float(box[0]), float(box[1]), float(box[2]), float(box[3])))
    for shape in covered:
        _refuse_voids_in(ground, shape)
    return ground


def _refuse_voids_in(ground: Ground, shape: Any) -> None:
    """Refuse an area with a void in it."""
    import shapely

    west, south, east, north = shape.bounds
    step = max(0.5 * ground.node_m, float(np.sqrt((east - west) * (north - south) / 1e6)), 1e-3)
    x, y = np.arange(west, east + step, step), np.arange(south, north + step, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    void = np.isnan(ground.heights_at(grid))
    if np.any(void):
        inside = grid[void][shapely.contains_xy(shape.buffer(ground.node_m), *grid[void].T)]
        if len(inside):
            ground.refuse_voids(inside, "the area has")
