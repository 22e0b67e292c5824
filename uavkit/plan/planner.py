"""Plan a survey: lay the strips, fly them, measure what they give, and say so."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.flightplan import CoverageMap, FlightPlan, SurveyArea, TakeOff, Trigger
from uavkit.core.frames import LocalMap
from uavkit.core.progress import Progress, silent
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleProfile
from uavkit.formats.plan_request import PlanRequest, check_request
from uavkit.plan import checks
from uavkit.plan.assembly import Assembled, assemble, most_items
from uavkit.plan.flight import Airfield, Performance
from uavkit.plan.layout import Laid, coverage_of, laid_well, least_of, shortfall
from uavkit.plan.mission import item_counts
from uavkit.plan.patterns import (
    LaidSet,
)
from uavkit.plan.site import Site, map_point, shape_on_map, site_of


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
    progress: Progress = silent,
) -> Planned:
    """Return the plan of a survey of areas with a camera, over an elevation model or flat ground.

    first_station: exposure station (of the same plan made before) at which to resume. Raises InputError where the
    request cannot be met, with what to change.
    """
    check_request(request, "the request")
    site = site_of(request, areas, camera, elevation, vehicle, progress)
    note = checks.check_payload(camera, vehicle)
    laid = laid_well(site, workers or os.cpu_count() or 1)
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
        longest = max(item_counts(planned.plan, vehicle))
        if longest <= most:
            return planned
        if not request.sorties.split_at_items or aimed < 30:
            raise _too_many_items(planned.plan, longest, most)
        aimed = int(aimed * most / longest) - 1


def _performance(site: Site, laid: Laid, vehicle: VehicleProfile | None) -> Performance:
    bases = [line.base_m for _, line in laid.flown if len(line) > 1]
    least_gsd = _least_depth(laid)
    bounds = checks.speed_bounds(site.request, site.imaging, min(bases, default=0.0), least_gsd)
    speed = checks.chosen_speed(site.request.flight, vehicle, bounds)
    return checks.performance_of(site.request, vehicle, speed)


def _least_depth(laid: Laid) -> float:
    """Return the least distance of the ground from an image along its view, m."""
    imaging = laid.sets[0].mounting.imaging
    gsd = least_of([found.gsd_m[found.sees_area, 0] for found in laid.measures])
    return gsd * imaging.interior.principal_distance_px


def _airfield(site: Site, laid: Laid) -> Airfield:
    member, first = laid.flown[0]
    start = (first.path_m[0] @ laid.sets[member].axes.T + laid.sets[member].origin_m)[:2]
    home_xy = site.home_xy
    if home_xy is None and site.request.pattern in ("facade", "orbit"):
        home_xy = start
    if home_xy is None:
        from shapely.ops import nearest_points

        area = site.covered[0]
        home_xy = np.array(nearest_points(area, map_point(start))[0].coords[0])
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


def _top(site: Site, laid: LaidSet) -> float:
    """Return the height at which a vehicle passes over what a set surveys, -inf where that is the ground itself."""
    request, clear = site.request, site.request.terrain.least_clearance_m
    if request.facade is not None and request.pattern == "facade":
        return float(laid.origin_m[2]) + request.facade.height_m + clear
    if request.orbit is not None and laid.target_m is not None:
        return float(laid.target_m[2]) + 0.5 * request.orbit.object_height_m + clear
    return float("-inf")


def _map_fences(site: Site, fences: Fences, vehicle: VehicleProfile | None) -> checks.MapFences:
    import shapely

    def joined(areas: tuple[SurveyArea, ...]) -> Any:
        return shapely.union_all([shape_on_map(site.ground.local_map, area) for area in areas]) if areas else None

    return checks.MapFences(
        inside=joined(fences.inside),
        outside=joined(fences.outside),
        margin_m=vehicle.turn_radius_m if vehicle is not None else 0.0,
    )


def _planned(site: Site, laid: Laid, done: Assembled, vehicle: VehicleProfile | None, notes: Sequence[str]) -> Planned:
    request, local_map = site.request, site.ground.local_map
    least, covered, enough = coverage_of(site, laid)
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


def _covered_m2(site: Site, laid: Laid) -> float:
    """Return the size of what is to be covered: ground, or the faces themselves."""
    shapes = [found.area for found in laid.sets] if site.request.pattern == "facade" else site.covered
    return float(sum(shape.area for shape in shapes))


def _too_many_items(plan: FlightPlan, needed: int, most: int) -> InputError:
    other = "trigger by distance" if plan.trigger is Trigger.HOVER else "allow more tolerance in height"
    return InputError(
        f"the mission has {needed} items, the autopilot holds {most}: divide it ([sorties] split_at_items = true, or "
        f"--split), {other}, or plan a smaller area"
    )


def _short_notes(site: Site, laid: Laid) -> list[str]:
    """Say where the overlap stays under the request."""
    short = zip(("forward", "side"), shortfall(site, laid), strict=True)
    change = "bring strips closer (--keep-overlap)" if not site.request.imaging.keep_overlap else "fly higher or slower"
    return [
        f"the {which} overlap is up to {missing:.1%} of the image under the request in places: {change}"
        for which, missing in short
        if missing > 0.01
    ]


def _notes(request: PlanRequest, summary: Any, site: Site) -> list[str]:
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
    interval = request.flight.camera_interval_s or site.imaging.profile.least_interval_s
    if interval is None and request.flight.trigger != "hover":
        notes.append(
            f"how fast {site.imaging.profile.name} takes images is not known: look whether it can (camera_interval_s)"
        )
    if asked.side_overlap < 0.5 or asked.forward_overlap < 0.6:
        notes.append("with less than 60 % forward and 50 % side overlap many points are seen in two images only")
    single = request.pattern in ("polygon", "corridor") and not request.terrain.follow
    if single and summary.height_above_ground_m[2] < 1.1 * summary.height_above_ground_m[0]:
        notes.append(
            "one height, one direction, all images looking down: without control points well spread the heights may "
            "bend like a dome; a cross grid at a second height guards against it"
        )
    return notes
