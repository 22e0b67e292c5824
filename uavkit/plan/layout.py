"""Lay out a survey, and again with a little more where the ground asks for it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.flightplan import CoverageMap
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan.lines import HeightRule, Mounting, StationLine
from uavkit.plan.measured import LineMeasures, coverage_map, covered_shares, measure_lines
from uavkit.plan.patterns import (
    Circles,
    Face,
    LaidSet,
    Region,
    corridor_sets,
    facade_sets,
    flown_order,
    heading_of,
    orbit_set,
    polygon_set,
)
from uavkit.plan.site import Site
from uavkit.plan.strips import StripRequest

ATTEMPTS = 4
"""At a layout that covers the area with the requested overlap; each asks for a little more than the one before."""
MISSED = 0.006
"""An overlap this much under the request is laid out again."""


@dataclass(frozen=True, kw_only=True)
class Laid:
    """The lines of a survey in the order of flight, and what they give."""

    sets: tuple[LaidSet, ...]
    flown: tuple[tuple[int, StationLine], ...]
    """(index of the set, line) in the order of flight, in the axes of the set."""
    measures: tuple[LineMeasures, ...]
    coverages: tuple[CoverageMap, ...]


def laid_well(site: Site, workers: int) -> Laid:
    """Lay out the survey, and again with a little more where the ground asks for it."""
    ask = _strip_request(site.request)
    asked = site.request.imaging
    holding: Laid | None = None
    for _ in range(ATTEMPTS):
        laid = _laid(site, ask, workers)
        _, covered, enough = coverage_of(site, laid)
        short_forward, short_side = shortfall(site, laid)
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


def shortfall(site: Site, laid: Laid) -> tuple[float, float]:
    """Return how far the least forward and side overlaps are under the request; negative where they are above."""
    asked = site.request.imaging
    forward = asked.forward_overlap - least_of([found.forward[:-1] for found in laid.measures])
    return forward, asked.side_overlap - least_of([found.side for found in laid.measures])


def least_of(values: Sequence[Array]) -> float:
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


def _laid(site: Site, ask: StripRequest, workers: int) -> Laid:
    sets: list[LaidSet] = []
    for region, covered in zip(site.regions, site.covered, strict=True):
        sets += _sets_of(site, region, covered, ask, len(sets))
    flown = flown_order(sets, _begin(site))
    measures: list[LineMeasures] = [None] * len(flown)  # type: ignore[list-item]
    for index, laid in enumerate(sets):
        places = [place for place, (member, _) in enumerate(flown) if member == index]
        for place, found in zip(places, measure_lines(laid, [flown[p][1] for p in places], workers), strict=True):
            measures[place] = found
    return Laid(
        sets=tuple(sets),
        flown=tuple(flown),
        measures=tuple(measures),
        coverages=tuple(_coverage_maps(site, sets, flown)),
    )


def _sets_of(site: Site, region: Region, covered: Any, ask: StripRequest, first: int) -> list[LaidSet]:
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


def _convergence(site: Site, covered: Any) -> float:
    local_map = site.ground.local_map
    x, y = covered.centroid.coords[0]
    latitude, longitude = local_map.geographic_from_map(np.array([[x, y]]))[0]
    return float(local_map.convergence_rad(np.array([latitude]), np.array([longitude]))[0])


def _face(site: Site) -> Face:
    facade = site.request.facade
    assert facade is not None
    return Face(
        height_m=facade.height_m,
        base_m=facade.base_m,
        flown_on_right=facade.side == "right",
        least_above_ground_m=site.request.terrain.least_clearance_m + 2.0 * site.ground.sigma_m,
    )


def _mounting(site: Site, covered: Any, height_factor: float) -> Mounting:
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
        progress=site.progress,
    )


def _altitude(site: Site, covered: Any, height_m: float) -> float | None:
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


def _begin(site: Site) -> Array:
    """Return the corner of all areas, or the take-off point, from which the flight begins."""
    bounds = np.array([shape.bounds for shape in site.covered])
    (west, south), (east, north) = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    corners = {"NE": (east, north), "SE": (east, south), "SW": (west, south), "NW": (west, north)}
    entry = site.request.flight.entry
    if entry != "nearest":
        return np.array(corners[entry])
    return site.home_xy if site.home_xy is not None else np.array(corners["SW"])


def _coverage_maps(site: Site, sets: Sequence[LaidSet], flown: Sequence[tuple[int, StationLine]]) -> list[CoverageMap]:
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


def coverage_of(site: Site, laid: Laid) -> tuple[int, float, float]:
    """Return the fewest images of a place of the area, and the shares of it seen by one and by enough images."""
    return covered_shares(laid.coverages[0], site.request.imaging.least_images)
