"""Plan a survey: lay the strips, fly them, measure what they give, and say so."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, CoverageMap, FlightPlan, SurveyArea, TakeOff, Trigger
from uavkit.core.frames import LocalMap
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.plan_request import PlanRequest, check_request
from uavkit.plan import checks
from uavkit.plan.assembly import Assembled, assemble, most_items
from uavkit.plan.flight import Airfield, Performance
from uavkit.plan.ground import Ground, flat_ground, ground_from_grid
from uavkit.plan.imaging import Imaging
from uavkit.plan.lines import HeightRule, Mounting, StationLine
from uavkit.plan.measured import LineMeasures, coverage_map, covered_shares, measure_lines
from uavkit.plan.mission import USUAL_AUTOPILOT, item_count
from uavkit.plan.patterns import (
    Circles,
    Face,
    LaidSet,
    Region,
    corridor_band,
    corridor_sets,
    facade_sets,
    flown_order,
    heading_of,
    orbit_set,
    polygon_set,
)
from uavkit.plan.strips import StripRequest

KINDS = {
    "polygon": (AreaKind.POLYGON,),
    "cross_grid": (AreaKind.POLYGON,),
    "corridor": (AreaKind.LINE,),
    "facade": (AreaKind.LINE, AreaKind.POLYGON),
    "orbit": (AreaKind.POINT, AreaKind.POLYGON),
}
ATTEMPTS = 4
"""At a layout that covers the area with the requested overlap; each asks for a little more than the one before."""
MISSED = 0.006
"""An overlap this much under the request is laid out again."""


@dataclass(frozen=True, kw_only=True)
class Fences:
    """Where the path must lie, and where it must not."""

    inside: tuple[SurveyArea, ...] = ()
    outside: tuple[SurveyArea, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A plan, how its images cover the area, and the map in which both lie."""

    plan: FlightPlan
    coverage: CoverageMap
    local_map: LocalMap
    footprints_deg: Array
    """(images, n, 2): latitude, longitude around the rim of each image on the ground."""


def plan_survey(
    request: PlanRequest,
    areas: tuple[SurveyArea, ...],
    camera: CameraProfile,
    elevation: ElevationGrid | None = None,
    vehicle: VehicleProfile | None = None,
    fences: Fences = Fences(),
    first_station: int = 0,
    workers: int = 0,
) -> Planned:
    """Return the plan of a survey of areas with a camera, over an elevation model or flat ground.

    first_station: exposure station (of the same plan made before) at which to resume. Raises InputError where the
    request cannot be met, with what to change.
    """
    check_request(request, "the request")
    site = _site(request, areas, camera, elevation, vehicle)
    note = checks.check_payload(camera, vehicle)
    laid = _laid_well(site, workers or os.cpu_count() or 1)
    performance = _performance(site, laid, vehicle)
    most = most_items(request, vehicle)
    aimed = most
    while True:  # the division goes by estimates of the number of items
        done = assemble(
            site.request,
            laid.sets,
            laid.flown,
            laid.measures,
            _airfield(site, laid),
            performance,
            (vehicle, aimed),
            _map_fences(site, fences, vehicle),
            first_station,
        )
        planned = _planned(site, laid, done, vehicle, [note] if note else [])
        longest = _longest_mission(planned.plan, vehicle)
        if longest <= most:
            return planned
        if not request.sorties.split_at_items or aimed < 30:
            raise _too_many_items(planned.plan, longest, most)
        aimed = int(aimed * most / longest) - 1


@dataclass(frozen=True, kw_only=True)
class _Site:
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

    @property
    def footprint_m(self) -> float:
        """Return the longer side of what an image shows on flat ground."""
        return max(self.imaging.length_m(self.height_m), self.imaging.width_m(self.height_m))


def _site(
    request: PlanRequest,
    areas: tuple[SurveyArea, ...],
    camera: CameraProfile,
    elevation: ElevationGrid | None,
    vehicle: VehicleProfile | None,
) -> _Site:
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
    regions = tuple(Region(name=area.name, shape=_shape(local_map, area)) for area in areas)
    covered = tuple(_covered(request, region) for region in regions)
    home = request.flight.take_off_deg
    home_xy = None if home is None else local_map.map_from_geographic(np.array([home[0]]), np.array([home[1]]))[0]
    if home_xy is not None and min(shape.distance(_point(home_xy)) for shape in covered) > 20000.0:
        raise InputError(
            f"[flight] take_off_deg = {home!r}: this is more than 20 km from the area; latitude comes first"
        )
    reach = max(imaging.length_m(height), imaging.width_m(height)) + lead
    ground = _ground(local_map, elevation, covered, home_xy, reach)
    return _Site(
        request=request,
        areas=areas,
        regions=regions,
        covered=covered,
        imaging=imaging,
        ground=ground,
        height_m=height,
        lead_m=lead,
        home_xy=home_xy,
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


def _shape(local_map: LocalMap, area: SurveyArea) -> Any:
    from shapely import LineString, Point, Polygon

    def on_map(ring: Array) -> Array:
        return local_map.map_from_geographic(ring[:, 0], ring[:, 1])

    outline = on_map(area.latitude_longitude_deg)
    if area.kind is AreaKind.POINT:
        return Point(outline[0])
    if area.kind is AreaKind.LINE:
        return LineString(outline)
    return Polygon(outline, [on_map(hole) for hole in area.holes_deg])


def _point(xy: Array) -> Any:
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


# laying out


@dataclass(frozen=True, kw_only=True)
class _Laid:
    sets: tuple[LaidSet, ...]
    flown: tuple[tuple[int, StationLine], ...]
    """(index of the set, line) in the order of flight, in the axes of the set."""
    measures: tuple[LineMeasures, ...]
    coverages: tuple[CoverageMap, ...]


def _laid_well(site: _Site, workers: int) -> _Laid:
    """Lay out the survey, and again with a little more where the ground asks for it."""
    ask = _strip_request(site.request)
    asked = site.request.imaging
    holding: _Laid | None = None
    for _ in range(ATTEMPTS):
        laid = _laid(site, ask, workers)
        _, covered, enough = _coverage(site, laid)
        short_forward, short_side = _shortfall(site, laid)
        if not asked.keep_overlap or site.request.pattern in ("facade", "orbit"):
            return laid
        if covered >= 1.0 and max(short_forward, short_side) <= MISSED:
            if enough >= 1.0:
                return laid
            if holding is not None:
                return holding  # more images at the rim did not help: the overlap itself gives no more
            holding = laid
        ask = replace(
            ask,
            forward_overlap=min(0.98, ask.forward_overlap + (short_forward + 0.002 if short_forward > MISSED else 0.0)),
            side_overlap=min(0.98, ask.side_overlap + (short_side + 0.002 if short_side > MISSED else 0.0)),
            extra_stations=ask.extra_stations + (1 if enough < 1.0 else 0),
            inset_share=ask.inset_share + (0.4 if enough < 1.0 else 0.0),
        )
    return holding if holding is not None else laid


def _shortfall(site: _Site, laid: _Laid) -> tuple[float, float]:
    """Return how far the least forward and side overlaps are under the request; negative where they are above."""
    asked = site.request.imaging
    forward = asked.forward_overlap - _least([found.forward[:-1] for found in laid.measures])
    return forward, asked.side_overlap - _least([found.side for found in laid.measures])


def _least(values: Sequence[Array]) -> float:
    """Return the least of all values, 1 where there is none."""
    found = np.concatenate([np.ravel(value) for value in values]) if values else np.zeros(0)
    found = found[~np.isnan(found)]
    return float(found.min()) if len(found) else 1.0


def _strip_request(request: PlanRequest) -> StripRequest:
    asked = request.imaging
    return StripRequest(
        forward_overlap=asked.forward_overlap,
        side_overlap=asked.side_overlap,
        least_images=asked.least_images,
        keep_overlap=asked.keep_overlap,
    )


def _laid(site: _Site, ask: StripRequest, workers: int) -> _Laid:
    sets: list[LaidSet] = []
    for region, covered in zip(site.regions, site.covered, strict=True):
        sets += _sets_of(site, region, covered, ask, len(sets))
    flown = flown_order(sets, _begin(site))
    measures: list[LineMeasures] = [None] * len(flown)  # type: ignore[list-item]
    for index, laid in enumerate(sets):
        places = [place for place, (member, _) in enumerate(flown) if member == index]
        for place, found in zip(places, measure_lines(laid, [flown[p][1] for p in places], workers), strict=True):
            measures[place] = found
    return _Laid(
        sets=tuple(sets),
        flown=tuple(flown),
        measures=tuple(measures),
        coverages=tuple(_coverage_maps(site, sets, flown)),
    )


def _sets_of(site: _Site, region: Region, covered: Any, ask: StripRequest, first: int) -> list[LaidSet]:
    request, mounting = site.request, _mounting(site, covered, 1.0)
    direction = request.imaging.direction_deg
    heading = None if direction == "best" else float(np.radians(direction)) - _convergence(site, covered)
    if request.pattern == "corridor":
        assert request.corridor is not None
        return corridor_sets(region, request.corridor.width_m, mounting, ask, first)
    if request.pattern == "facade":
        return facade_sets(region, _face(site), mounting, ask, first)
    if request.pattern == "orbit":
        assert request.orbit is not None
        circles = Circles(**request.orbit.model_dump())
        return [orbit_set(region, circles, mounting, ask, first)]
    sets = [polygon_set(region, heading, mounting, ask, first)]
    if request.pattern == "cross_grid":
        crossing = heading_of(sets[0]) + 0.5 * np.pi
        higher = _mounting(site, covered, request.cross_grid.height_factor)
        sets.append(polygon_set(region, crossing, higher, ask, first + 1))
    return sets


def _convergence(site: _Site, covered: Any) -> float:
    local_map = site.ground.local_map
    x, y = covered.centroid.coords[0]
    latitude, longitude = local_map.geographic_from_map(np.array([[x, y]]))[0]
    return float(local_map.convergence_rad(np.array([latitude]), np.array([longitude]))[0])


def _face(site: _Site) -> Face:
    facade = site.request.facade
    assert facade is not None
    return Face(
        height_m=facade.height_m,
        base_m=facade.base_m,
        flown_on_right=facade.side == "right",
        least_above_ground_m=site.request.terrain.least_clearance_m + 2.0 * site.ground.sigma_m,
    )


def _mounting(site: _Site, covered: Any, height_factor: float) -> Mounting:
    height = height_factor * site.height_m
    return Mounting(
        imaging=site.imaging,
        ground=site.ground,
        rule=HeightRule(
            above_ground_m=height,
            altitude_m=_altitude(site, covered, height),
            tolerance_m=site.request.terrain.tolerance * height,
        ),
        lead_m=site.lead_m,
        stops=site.request.flight.trigger == "hover",
    )


def _altitude(site: _Site, covered: Any, height_m: float) -> float | None:
    """Return the one altitude of a set: above its highest ground where overlap is kept, else above the mean ground."""
    if site.request.terrain.follow or site.ground.is_flat or site.request.pattern in ("facade", "orbit"):
        return None
    import shapely

    around = covered.buffer(0.5 * (1.0 - site.request.imaging.side_overlap) * site.imaging.width_m(height_m))
    west, south, east, north = around.bounds
    step = max(0.5 * site.ground.node_m, float(np.sqrt((east - west) * (north - south) / 4e6)))
    x, y = np.arange(west, east + step, step), np.arange(south, north + step, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    heights = site.ground.heights_at(grid[shapely.contains_xy(around, grid[:, 0], grid[:, 1])])
    chosen = np.nanmax(heights) if site.request.imaging.keep_overlap else np.nanmean(heights)
    return float(chosen) + height_m


def _begin(site: _Site) -> Array:
    """Return the corner of all areas, or the take-off point, from which the flight begins."""
    bounds = np.array([shape.bounds for shape in site.covered])
    (west, south), (east, north) = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    corners = {"NE": (east, north), "SE": (east, south), "SW": (west, south), "NW": (west, north)}
    entry = site.request.flight.entry
    if entry != "nearest":
        return np.array(corners[entry])
    return site.home_xy if site.home_xy is not None else np.array(corners["SW"])


def _coverage_maps(site: _Site, sets: Sequence[LaidSet], flown: Sequence[tuple[int, StationLine]]) -> list[CoverageMap]:
    """Return a map for each area; for a facade in the axes of its longest side."""
    result = []
    if site.request.pattern == "facade":
        index = max(range(len(sets)), key=lambda at: sets[at].area.area)
        lines = [(sets[index].mounting.imaging, line) for member, line in flown if member == index]
        return [coverage_map(sets[index].mounting.ground, sets[index].area, lines)]
    lines = [(sets[member].mounting.imaging, line) for member, line in flown]
    import shapely

    result.append(coverage_map(site.ground, shapely.union_all(list(site.covered)), lines))
    return result


def _coverage(site: _Site, laid: _Laid) -> tuple[int, float, float]:
    return covered_shares(laid.coverages[0], site.request.imaging.least_images)


# flying


def _performance(site: _Site, laid: _Laid, vehicle: VehicleProfile | None) -> Performance:
    bases = [line.base_m for _, line in laid.flown if len(line) > 1]
    least_gsd = _least_depth(laid)
    bounds = checks.speed_bounds(site.request, site.imaging, min(bases, default=0.0), least_gsd)
    speed = checks.chosen_speed(site.request.flight, vehicle, bounds)
    return checks.performance_of(site.request, vehicle, speed)


def _least_depth(laid: _Laid) -> float:
    """Return the least distance of the ground from an image along its view, m."""
    imaging = laid.sets[0].mounting.imaging
    gsd = _least([found.gsd_m[found.sees_area, 0] for found in laid.measures])
    return gsd * imaging.interior.principal_distance_px


def _airfield(site: _Site, laid: _Laid) -> Airfield:
    member, first = laid.flown[0]
    start = (first.path_m[0] @ laid.sets[member].axes.T + laid.sets[member].origin_m)[:2]
    home_xy = site.home_xy
    if home_xy is None and site.request.pattern in ("facade", "orbit"):
        home_xy = start
    if home_xy is None:
        from shapely.ops import nearest_points

        area = site.covered[0]
        home_xy = np.array(nearest_points(area, _point(start))[0].coords[0])
    height = float(site.ground.heights_at(home_xy[None])[0])
    if np.isnan(height):
        site.ground.refuse_voids(home_xy[None], "the take-off point lies on")
    rules = []
    for laid_set in laid.sets:
        level = site.request.pattern in ("facade", "orbit")
        rules.append(replace(laid_set.mounting.rule, altitude_m=0.0) if level else laid_set.mounting.rule)
    return Airfield(
        home_m=np.array([*home_xy, height]),
        ground=site.ground,
        rules=tuple(rules),
        clearance_m=site.request.terrain.least_clearance_m + 2.0 * site.ground.sigma_m,
        tops_m=tuple(_top(site, laid_set) for laid_set in laid.sets),
    )


def _top(site: _Site, laid: LaidSet) -> float:
    """Return the height at which a vehicle passes over what a set surveys, -inf where that is the ground itself."""
    request, clear = site.request, site.request.terrain.least_clearance_m
    if request.facade is not None and request.pattern == "facade":
        return float(laid.origin_m[2]) + request.facade.height_m + clear
    if request.orbit is not None and laid.target_m is not None:
        return float(laid.target_m[2]) + 0.5 * request.orbit.object_height_m + clear
    return float("-inf")


def _map_fences(site: _Site, fences: Fences, vehicle: VehicleProfile | None) -> checks.MapFences:
    import shapely

    def joined(areas: tuple[SurveyArea, ...]) -> Any:
        return shapely.union_all([_shape(site.ground.local_map, area) for area in areas]) if areas else None

    return checks.MapFences(
        inside=joined(fences.inside),
        outside=joined(fences.outside),
        margin_m=vehicle.turn_radius_m if vehicle is not None else 0.0,
    )


def _planned(
    site: _Site, laid: _Laid, done: Assembled, vehicle: VehicleProfile | None, notes: Sequence[str]
) -> Planned:
    request, local_map = site.request, site.ground.local_map
    least, covered, enough = _coverage(site, laid)
    summary = replace(
        done.summary,
        area_m2=_covered_m2(site, laid),
        least_images=least,
        covered=covered,
        covered_enough=enough,
    )
    home = done.home_m
    latitude, longitude = local_map.geographic_from_map(home[None, :2])[0]
    plan = FlightPlan(
        name=request.name or "plan",
        camera=site.imaging.profile.name,
        vehicle=vehicle.name if vehicle is not None else "",
        trigger=Trigger(request.flight.trigger),
        areas=site.areas,
        take_off=TakeOff(
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            height_ellipsoid_m=float(home[2]),
            chosen=site.home_xy is None,
        ),
        strips=done.strips,
        exposures=done.exposures,
        sorties=done.sorties,
        summary=summary,
        terrain=site.ground.source,
        images_in_turns=request.flight.images_in_turns,
        notes=tuple([*notes, *done.notes, *_short_notes(site, laid), *_notes(request, summary, site)]),
    )
    return Planned(plan=plan, coverage=laid.coverages[0], local_map=local_map, footprints_deg=done.footprints_deg)


def _covered_m2(site: _Site, laid: _Laid) -> float:
    """Return the size of what is to be covered: ground, or the faces themselves."""
    shapes = [found.area for found in laid.sets] if site.request.pattern == "facade" else site.covered
    return float(sum(shape.area for shape in shapes))


def _longest_mission(plan: FlightPlan, vehicle: VehicleProfile | None) -> int:
    """Return the number of mission items of the sortie that has most."""
    autopilot = vehicle.autopilot if vehicle is not None else USUAL_AUTOPILOT
    kind = vehicle.kind if vehicle is not None else VehicleKind.MULTIROTOR
    return max(item_count(plan, number, autopilot, kind) for number in range(len(plan.sorties)))


def _too_many_items(plan: FlightPlan, needed: int, most: int) -> InputError:
    other = "trigger by distance" if plan.trigger is Trigger.HOVER else "allow more tolerance in height"
    return InputError(
        f"the mission has {needed} items, the autopilot holds {most}: divide it ([sorties] split_at_items = true, or "
        f"--split), {other}, or plan a smaller area"
    )


def _short_notes(site: _Site, laid: _Laid) -> list[str]:
    """Say where the overlap stays under the request."""
    short = zip(("forward", "side"), _shortfall(site, laid), strict=True)
    change = "bring strips closer (--keep-overlap)" if not site.request.imaging.keep_overlap else "fly higher or slower"
    return [
        f"the {which} overlap is up to {missing:.1%} of the image under the request in places: {change}"
        for which, missing in short
        if missing > 0.01
    ]


def _notes(request: PlanRequest, summary: Any, site: _Site) -> list[str]:
    notes = []
    asked = request.imaging
    if summary.covered_enough < 1.0:
        low = request.pattern == "facade"
        change = "the vehicle keeps its clearance from the ground there" if low else "more overlap would change that"
        notes.append(
            f"{1.0 - summary.covered_enough:.1%} of the area are seen by fewer than {asked.least_images} images "
            f"(least: {summary.least_images}): {change}"
        )
    if site.ground.is_flat and request.pattern not in ("facade",):
        notes.append("no terrain model was given: the ground is taken as level with the take-off point")
    if asked.side_overlap < 0.5 or asked.forward_overlap < 0.6:
        notes.append("with less than 60 % forward and 50 % side overlap many points are seen in two images only")
    single = request.pattern in ("polygon", "corridor") and not request.terrain.follow
    if single and summary.height_above_ground_m[2] < 1.1 * summary.height_above_ground_m[0]:
        notes.append(
            "one height, one direction, all images looking down: without control points well spread the heights may "
            "bend like a dome; a cross grid at a second height guards against it"
        )
    return notes
