"""What every plan of strips promises, judged by code that shares nothing with the planner (independent.py)."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from independent import Ground, Images, Judgement, PlaneArea, broken_promises, geocentric, judge, path_legs
from made_ground import hilly_ground, simple_polygon

from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.frames import LocalMap
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.plan_request import (
    FlightRequest,
    ImagingRequest,
    InlineArea,
    PlanRequest,
    SortiesRequest,
    TerrainRequest,
)

planner = pytest.importorskip("uavkit.plan.planner", reason="the planner is not there")

CAMERAS = ("Ricoh GX200", "Sony RX1R II", "DJI FC6310", "DJI L1D-20c", "DJI Mavic 3E")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A request in few numbers: its text makes it again."""

    shape: int
    kind: str = "star"
    vertices: int = 4
    size_m: float = 100.0
    hole: bool = False
    latitude_deg: float = 46.0
    longitude_deg: float = 7.0
    direction_deg: float | str = "best"
    long_side: str = "across"
    forward: float = 0.8
    side: float = 0.6
    height_m: float = 60.0
    camera: str = "DJI FC6310"
    trigger: str = "distance"
    pattern: str = "polygon"
    hills: int = -1
    """Seed of the hills, -1 for flat ground."""
    steepest_deg: float = 20.0
    crs: str = "utm"
    follow: bool = False
    climb_m_s: float = 3.0
    descent_m_s: float = 2.0
    speed_m_s: float | None = None
    lead_in_m: float | None = None
    entry: str = "nearest"
    most_images: int = 150

    def image_m(self) -> tuple[float, float]:
        """Return base and spacing over flat ground."""
        interior = load_camera(self.camera).interior
        scale = self.height_m / interior.principal_distance_px
        across, along = interior.width_px * scale, interior.height_px * scale
        if self.long_side == "along":
            across, along = along, across
        return along * (1.0 - self.forward), across * (1.0 - self.side)

    def limited_size_m(self) -> float:
        """Return the size, less where the plan would hold too many images for a test."""
        base_m, spacing_m = self.image_m()
        # lead-ins and rims make small areas dearer than their own size
        most_m = math.sqrt(self.most_images * base_m * spacing_m)
        return max(30.0, min(self.size_m, most_m))

    def place(self) -> LocalMap:
        return LocalMap(latitude_deg=self.latitude_deg, longitude_deg=self.longitude_deg, height_ellipsoid_m=300.0)

    def area(self) -> SurveyArea:
        size_m = self.limited_size_m()
        ring, hole = simple_polygon(self.shape, self.kind, self.vertices, size_m, 0.04 * size_m**2)
        holes = (self.place().geographic_from_map(hole),) if self.hole and hole is not None else ()
        return SurveyArea(
            name="area",
            kind=AreaKind.POLYGON,
            latitude_longitude_deg=self.place().geographic_from_map(ring),
            holes_deg=holes,
        )

    def ground(self) -> ElevationGrid | None:
        if self.hills < 0:
            return None
        # hills of 60 to 600 m at 45 degrees differ by some 150 m: so much higher a constant altitude may be
        half_m = self.limited_size_m() + 3.0 * self.height_m + 400.0
        cell_m = max(2.0, half_m / 150.0)
        return hilly_ground(self.place(), self.hills, half_m, cell_m, self.steepest_deg, self.crs)

    def request(self) -> PlanRequest:
        area = self.area()
        return PlanRequest(
            name="case",
            pattern=self.pattern,
            areas=[InlineArea(latitude_longitude_deg=[(float(a), float(b)) for a, b in area.latitude_longitude_deg])],
            camera=self.camera,
            imaging=ImagingRequest(
                height_above_ground_m=self.height_m,
                forward_overlap=self.forward,
                side_overlap=self.side,
                direction_deg=self.direction_deg,
                long_side=self.long_side,
            ),
            terrain=TerrainRequest(file="made" if self.hills >= 0 else "", follow=self.follow),
            flight=FlightRequest(
                trigger=self.trigger,
                climb_m_s=self.climb_m_s,
                descent_m_s=self.descent_m_s,
                speed_m_s=self.speed_m_s,
                lead_in_m=self.lead_in_m,
                entry=self.entry,
                greatest_height_above_ground_m=10000.0,
            ),
            # whether the autopilot holds the plan is another promise
            sorties=SortiesRequest(most_items=100000),
        )


@st.composite
def cases(draw: st.DrawFn, hilly: bool = True, most_images: int = 150) -> Case:
    """Draw any case; figures are rounded so that a failure can be told in one line."""

    def number(low: float, high: float, digits: int) -> float:
        return round(draw(st.floats(low, high)), digits)

    return Case(
        shape=draw(st.integers(0, 9999)),
        kind=draw(st.sampled_from(["star", "untangled"])),
        vertices=draw(st.integers(3, 12)),
        size_m=number(30.0, 600.0, 0),
        hole=draw(st.booleans()),
        latitude_deg=number(-75.0, 75.0, 2),
        longitude_deg=number(-179.0, 179.0, 2),
        direction_deg=draw(st.one_of(st.just("best"), st.integers(0, 359).map(float))),
        long_side=draw(st.sampled_from(["across", "along"])),
        forward=number(0.55, 0.9, 2),
        side=number(0.3, 0.8, 2),
        height_m=number(15.0, 120.0, 0),
        camera=draw(st.sampled_from(CAMERAS)),
        trigger=draw(st.sampled_from(["distance", "hover", "time"])),
        pattern=draw(st.sampled_from(["polygon", "polygon", "polygon", "cross_grid"])),
        hills=draw(st.integers(0, 9999)) if hilly else -1,
        steepest_deg=number(2.0, 45.0, 0),
        crs=draw(st.sampled_from(["utm", "degrees", "turned"])),
        follow=draw(st.booleans()) if hilly else False,
        climb_m_s=number(0.5, 5.0, 1),
        descent_m_s=number(0.5, 5.0, 1),
        speed_m_s=draw(st.sampled_from([None, 3.0, 8.0])),
        lead_in_m=draw(st.sampled_from([None, None, 0.0, 12.0])),
        entry=draw(st.sampled_from(["nearest", "NE", "SE", "SW", "NW"])),
        most_images=most_images,
    )


def truly_impossible(case: Case, message: str) -> bool:
    """Tell whether a refusal names something that no plan could give.

    Nothing of the kind is asked for here: flat or hilly ground without voids that reaches far beyond the area, no law,
    fence, vehicle or interval of the camera, and the speed may fall where the ground is steep.
    """
    return False


def judged(case: Case, most_images: int | None) -> tuple[list[str], Judgement | None]:
    """Plan a case and return what is broken."""
    request, area, camera, elevation = case.request(), case.area(), load_camera(case.camera), case.ground()
    try:
        planned = planner.plan_survey(request, (area,), camera, elevation)
    except InputError as error:
        if truly_impossible(case, str(error)):
            return [], None
        return [f"refused: {error}"], None
    found = judge(planned.plan, request, camera, elevation, most_images)
    return broken_promises(found, request), found


def check(case: Case, most_images: int | None) -> None:
    broken, found = judged(case, most_images)
    assert not broken, f"{case}\n" + "\n".join(broken) + f"\n{found}"


ORDINARY = settings(
    max_examples=4, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None
)
LARGE = settings(ORDINARY, max_examples=200)


@given(case=cases(hilly=False, most_images=80))
@ORDINARY
def test_any_plan_over_flat_ground(case: Case) -> None:
    check(case, 24)


@given(case=cases(most_images=60))
@ORDINARY
def test_any_plan_over_hills(case: Case) -> None:
    check(case, 24)


@pytest.mark.slow
@given(case=cases(hilly=False, most_images=250))
@LARGE
def test_many_plans_over_flat_ground(case: Case) -> None:
    check(case, 120)


@pytest.mark.slow
@given(case=cases(most_images=200))
@LARGE
def test_many_plans_over_hills(case: Case) -> None:
    check(case, 120)


@pytest.mark.parametrize("shape", [7, 11, 24, 40, 45])
def test_flat_ground_takes_no_more_images_than_its_strips_need(shape: int) -> None:
    """Over flat ground a strip holds its overlap with the base asked for: no need to bring exposures closer."""
    case = Case(
        shape=shape, kind="untangled", vertices=9, size_m=400.0, forward=0.7, side=0.6, height_m=40.0, most_images=400
    )
    base_m, _ = case.image_m()
    plan = planner.plan_survey(case.request(), (case.area(),), load_camera(case.camera)).plan
    needed = [math.ceil((strip.exposures - 1) * strip.base_m / base_m - 1e-6) + 1 for strip in plan.strips]
    assert sum(strip.exposures for strip in plan.strips) <= 1.02 * sum(needed)


@pytest.mark.parametrize("follow", [False, True], ids=["constant", "followed"])
def test_the_coverage_map_counts_images(follow: bool) -> None:
    """At the middles of some of its cells: in as many images as found here, but for points on the very rim of one."""
    case = Case(shape=7, kind="untangled", vertices=8, hole=True, hills=5, steepest_deg=30.0, follow=follow)
    camera, elevation = load_camera(case.camera), case.ground()
    planned = planner.plan_survey(case.request(), (case.area(),), camera, elevation)
    coverage = planned.coverage
    rows, columns = (index[:: max(1, len(index) // 1000)] for index in np.nonzero(coverage.in_area))
    xy_m = np.column_stack([columns, rows]) * coverage.cell_m + np.array(coverage.first_xy_m)
    latitude, longitude = planned.local_map.geographic_from_map(xy_m).T
    ground = Ground(elevation=elevation, level_m=np.nan)
    images = Images(planned.plan, camera, ground)
    lying, _ = images.seen_by(geocentric(latitude, longitude, ground.heights_m(latitude, longitude)))
    differences = np.abs(coverage.images[rows, columns].astype(int) - lying)
    assert differences.max() <= 1
    assert np.mean(differences > 0) < 0.02
    assert PlaneArea(case.area(), ground).contains(latitude, longitude).mean() > 0.99
    assert planned.plan.summary.least_images <= lying.min()


def short_of_breath() -> VehicleProfile:
    """A multirotor whose battery is soon empty."""
    return VehicleProfile(
        name="short of breath",
        maker="none",
        kind=VehicleKind.MULTIROTOR,
        endurance_s=300.0,
        payload_g=900.0,
        speed_m_s=5.0,
        greatest_speed_m_s=12.0,
        climb_m_s=2.5,
        descent_m_s=2.0,
        acceleration_m_s2=2.0,
        turn_radius_m=0.0,
        greatest_wind_m_s=None,
        most_mission_items=100000,
        autopilot="ardupilot",
        source="made",
    )


@pytest.mark.parametrize("trigger", ["hover", "distance", "time"])
def test_a_flight_divided_into_sorties_keeps_its_promises(trigger: str) -> None:
    case = Case(
        shape=2,
        vertices=5,
        size_m=400.0,
        hills=3,
        follow=True,
        height_m=50.0,
        steepest_deg=15.0,
        trigger=trigger,
        most_images=250,
    )
    asked = case.request()
    request = asked.model_copy(
        update={"flight": asked.flight.model_copy(update={"climb_m_s": None, "descent_m_s": None})}
    )
    vehicle = short_of_breath()
    plan = planner.plan_survey(request, (case.area(),), load_camera(case.camera), case.ground(), vehicle).plan
    assert len(plan.sorties) > 2
    for sortie in plan.sorties:
        legs = path_legs(sortie, Ground(elevation=None, level_m=0.0), 1e9)
        least_s = sum(leg.length_m / leg.end.speed_m_s + leg.end.hold_s for leg in legs)
        assert least_s <= sortie.duration_s <= vehicle.endurance_s * (1.0 - request.sorties.reserve) + 0.1
    for before, after in pairwise(range(len(plan.sorties))):
        stations = [set(plan.exposures.station[plan.exposures.sortie == number].tolist()) for number in (before, after)]
        assert len(stations[0] & stations[1]) == request.sorties.overlap_images
    broken = broken_promises(judge(plan, request, load_camera(case.camera), case.ground(), 20), request, vehicle)
    assert not broken


def test_the_path_stays_in_the_fence() -> None:
    """The fence is a little larger than the area, and convex: where all waypoints lie inside, the legs do."""
    case = Case(shape=4, vertices=4, size_m=150.0, height_m=50.0)
    place, area = case.place(), case.area()
    outline = place.map_from_geographic(*area.latitude_longitude_deg.T)
    low, high = outline.min(axis=0) - 60.0, outline.max(axis=0) + 60.0
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    fence = SurveyArea(name="fence", kind=AreaKind.POLYGON, latitude_longitude_deg=place.geographic_from_map(corners))
    fences = planner.Fences(inside=(fence,))
    plan = planner.plan_survey(case.request(), (area,), load_camera(case.camera), fences=fences).plan
    inside = PlaneArea(fence, Ground(elevation=None, level_m=0.0))
    for waypoint in plan.sorties[0].waypoints:
        assert inside.contains(np.array([waypoint.latitude_deg]), np.array([waypoint.longitude_deg])).all()
