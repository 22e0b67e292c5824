"""Patterns other than a polygon's strips, and what the planner refuses."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from tests.plan.made_requests import CAMERA, MAP, SQUARE, area, hills, request, vehicle
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, FlightPlan, WaypointRole
from uavkit.core.mission import MissionCommand
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleKind
from uavkit.plan.mission import mission_of
from uavkit.plan.planner import Fences, plan_survey

RIVER = [(-200.0, -40.0), (-60.0, 10.0), (60.0, -60.0), (200.0, 30.0)]


def views(plan: FlightPlan) -> Any:
    """Viewing directions (n, 3) and positions (n, 3) on the map."""
    table = plan.exposures
    xy = MAP.map_from_geographic(table.latitude_deg, table.longitude_deg)
    return -table.R_map_from_image[:, :, 2], np.column_stack([xy, table.height_ellipsoid_m])


def test_cross_grid_has_two_directions_and_two_heights() -> None:
    asked = request(pattern="cross_grid", cross_grid={"height_factor": 1.2}, imaging={"direction_deg": 30.0})
    plan = plan_survey(asked, (area(SQUARE),), CAMERA).plan
    first = [strip for strip in plan.strips if strip.set_number == 0]
    second = [strip for strip in plan.strips if strip.set_number == 1]
    assert {round(strip.direction_deg % 180.0) for strip in first} == {30}
    assert {round(strip.direction_deg % 180.0) for strip in second} == {120}
    heights = plan.exposures.height_above_ground_m
    assert heights[plan.exposures.strip == 0] == pytest.approx(50.0)
    assert heights[plan.exposures.strip == len(plan.strips) - 1] == pytest.approx(60.0)
    assert plan.summary.covered == 1.0


@pytest.mark.parametrize("follow", [False, True])
def test_corridor_covers_its_band(follow: bool) -> None:
    asked = request(
        pattern="corridor", corridor={"width_m": 50.0}, terrain={"file": "x" if follow else "", "follow": follow}
    )
    made = plan_survey(asked, (area(RIVER, AreaKind.LINE),), CAMERA, hills() if follow else None)
    summary = made.plan.summary
    assert summary.covered == 1.0
    assert summary.covered_enough == 1.0
    assert summary.forward_overlap[0] >= 0.79
    assert summary.side_overlap[0] >= 0.59
    length = float(np.sum(np.hypot(*np.diff(np.array(RIVER), axis=0).T)))
    assert summary.area_m2 == pytest.approx(50.0 * length, rel=0.02)


def test_facade_is_seen_from_its_right_at_the_distance() -> None:
    asked = request(
        pattern="facade",
        facade={"height_m": 20.0},
        imaging={"height_above_ground_m": 12.0},
        flight={"trigger": "hover"},
    )
    plan = plan_survey(asked, (area([(0.0, 0.0), (0.0, 40.0)], AreaKind.LINE),), CAMERA).plan
    looks, places = views(plan)
    assert np.allclose(looks, [-1.0, 0.0, 0.0], atol=1e-4)  # a line to the north has its right-hand side in the east
    assert places[:, 0] == pytest.approx(12.0, abs=0.01)
    assert places[:, 2].min() >= asked.terrain.least_clearance_m - 1e-6
    assert np.allclose(plan.exposures.R_map_from_image[:, 2, 1], 1.0)  # the images stand upright, up and down alike
    assert plan.summary.covered == 1.0
    assert np.allclose(plan.exposures.heading_deg, 270.0, atol=0.01)


def test_facades_of_a_house_look_at_it_from_outside() -> None:
    asked = request(
        pattern="facade",
        facade={"height_m": 8.0},
        imaging={"height_above_ground_m": 10.0},
        terrain={"least_clearance_m": 2.0},
        flight={"trigger": "hover"},
        sorties={"split_at_items": True},
    )
    for outline in (SQUARE, SQUARE[::-1]):
        plan = plan_survey(asked, (area(outline),), CAMERA).plan
        looks, places = views(plan)
        towards = np.array([75.0, 60.0]) - places[:, :2]
        assert np.all(np.einsum("ij,ij->i", looks[:, :2], towards) > 0.0)


def test_way_home_from_a_facade_passes_over_it() -> None:
    """Of a face with a bend inwards the chord from one end to the other goes through the rock: only above its top."""
    bent = [(0.0, 0.0), (60.0, 0.0), (110.0, 40.0)]
    asked = request(
        pattern="facade",
        facade={"height_m": 25.0},
        imaging={"height_above_ground_m": 12.0},
        terrain={"least_clearance_m": 3.0},
        flight={"trigger": "hover"},
        sorties={"split_at_items": True, "most_items": 200},
    )
    plan = plan_survey(asked, (area(bent, AreaKind.LINE),), CAMERA).plan
    assert len(plan.sorties) > 1
    face = shapely.LineString(bent).buffer(2.0)
    for sortie in plan.sorties:
        places = MAP.map_from_geographic(
            np.array([point.latitude_deg for point in sortie.waypoints]),
            np.array([point.longitude_deg for point in sortie.waypoints]),
        )
        heights = [point.height_above_takeoff_m for point in sortie.waypoints]
        for begin, end, z in zip(places, places[1:], pairwise([*heights]), strict=False):
            if np.hypot(*(end - begin)) > 0.1 and face.intersects(shapely.LineString([begin, end])):
                assert min(z) >= 28.0 - 1e-6


def test_orbit_looks_at_the_object_from_all_around() -> None:
    asked = request(
        pattern="orbit",
        orbit={"radius_m": 30.0, "object_height_m": 10.0, "rings": 2, "ring_height_m": 8.0},
        imaging={"height_above_ground_m": 15.0},
    )
    plan = plan_survey(asked, (area([(20.0, 10.0)], AreaKind.POINT),), CAMERA).plan
    looks, places = views(plan)
    target = np.array([20.0, 10.0, 5.0])
    wanted = (target - places) / np.linalg.norm(target - places, axis=1)[:, None]
    assert np.allclose(looks, wanted, atol=1e-4)
    assert np.hypot(*(places[:, :2] - target[:2]).T) == pytest.approx(30.0, abs=0.01)
    assert sorted(set(np.round(places[:, 2], 3))) == [15.0, 23.0]
    assert plan.summary.forward_overlap[0] > 0.75


@pytest.mark.parametrize("trigger", ["hover", "distance"])
def test_flight_that_begins_above_its_take_off_point_takes_off_first(trigger: str) -> None:
    asked = request(
        pattern="orbit",
        orbit={"radius_m": 30.0, "object_height_m": 10.0},
        imaging={"height_above_ground_m": 15.0},
        flight={"trigger": trigger},
    )
    plan = plan_survey(asked, (area([(20.0, 10.0)], AreaKind.POINT),), CAMERA).plan
    roles = [point.role for point in plan.sorties[0].waypoints]
    assert roles[0] is WaypointRole.TAKEOFF
    assert roles[-1] is WaypointRole.RETURN
    commands = [item.command for item in mission_of(plan, 0, "ardupilot", "take_off").items]
    assert commands[0] == MissionCommand.TAKEOFF
    first_picture = commands.index(
        MissionCommand.DO_DIGICAM_CONTROL if trigger == "hover" else MissionCommand.DO_SET_CAM_TRIGG_DIST
    )
    assert commands.index(MissionCommand.DO_MOUNT_CONTROL) < first_picture


@pytest.mark.parametrize("trigger", ["hover", "distance"])
def test_steep_ground_brings_strips_and_exposures_closer(trigger: str) -> None:
    """Where the ground falls away to the side the next strip shows less of an image than over level ground."""
    asked = request(terrain={"file": "x", "follow": True}, flight={"trigger": trigger}, imaging={"direction_deg": 30.0})
    level = plan_survey(asked.model_copy(update={"terrain": request().terrain}), (area(SQUARE),), CAMERA).plan
    steep = plan_survey(asked, (area(SQUARE),), CAMERA, hills(height_m=22.0)).plan
    assert steep.summary.side_overlap[0] >= 0.59
    assert steep.summary.forward_overlap[0] >= 0.79
    assert len(steep.strips) > len(level.strips)


def test_several_areas_are_one_plan() -> None:
    other = area([(400.0, 0.0), (480.0, 0.0), (480.0, 90.0), (400.0, 90.0)], name="second")
    plan = plan_survey(request(), (area(SQUARE), other), CAMERA).plan
    assert {strip.area for strip in plan.strips} == {"field", "second"}
    assert plan.summary.covered == 1.0
    assert plan.summary.area_m2 == pytest.approx(150.0 * 120.0 + 80.0 * 90.0, rel=1e-4)


def with_void() -> ElevationGrid:
    grid = hills()
    heights = grid.height_ellipsoid_m.copy()
    heights[95:100, 105:112] = np.nan
    return replace(grid, height_ellipsoid_m=heights)


@pytest.mark.parametrize(
    "tables, extra, words",
    [
        ({"flight": {"speed_m_s": 4.0, "camera_interval_s": 5.0}}, {}, "needs 5 s between images.*at most"),
        ({"flight": {"speed_m_s": 5.0, "shutter_s": 0.02}}, {}, "blur.*a shorter exposure"),
        ({"flight": {"speed_m_s": 9.0, "video_frames_per_s": 5.0}}, {}, "tracking follows"),
        ({}, {"vehicle": vehicle(payload_g=100.0)}, "weighs .* carries 100 g: take a lighter"),
        ({"flight": {"wind_m_s": 11.0}}, {"vehicle": vehicle()}, "stands 10 m/s at most"),
        ({"flight": {"speed_m_s": 20.0}}, {"vehicle": vehicle()}, "flies 12 m/s at most"),
        ({"flight": {"trigger": "hover"}}, {"vehicle": vehicle(kind=VehicleKind.FIXED_WING)}, "cannot stop in the air"),
        ({}, {"vehicle": vehicle(endurance_s=60.0)}, "take off nearer"),
        ({"sorties": {"most_items": 20}}, {}, "items, the autopilot holds 20: divide it"),
        ({"terrain": {"file": "x"}}, {"elevation": with_void()}, "void of the terrain model at latitude 47.0"),
        (
            {"terrain": {"file": "x"}, "flight": {"greatest_height_above_ground_m": 45.0}},
            {},
            "the law .* allows 45 m: fly lower",
        ),
        ({"terrain": {"file": "x", "least_clearance_m": 60.0}}, {}, "under the clearance of 60 m: fly higher"),
        ({"flight": {"take_off_deg": (8.0, 47.0)}}, {}, "latitude comes first"),
        ({"pattern": "corridor", "corridor": {"width_m": 9.0}}, {}, "the pattern corridor needs a line"),
        ({"imaging": {"height_above_ground_m": 0.05}}, {}, "would take .* images: fly higher"),
        (
            {"pattern": "facade", "facade": {"height_m": 9.0}, "flight": {"trigger": "distance"}},
            {},
            "trigger = 'hover' or 'time'",
        ),
    ],
)
def test_what_cannot_be_flown_is_refused_with_what_to_change(
    tables: dict[str, Any], extra: dict[str, Any], words: str
) -> None:
    elevation = extra.get("elevation", hills() if "terrain" in tables else None)
    camera = replace(CAMERA, mass_g=240.0)
    with pytest.raises(InputError, match=words):
        plan_survey(request(**tables), (area(SQUARE),), camera, elevation, extra.get("vehicle"))


def test_area_outside_the_terrain_model_is_refused() -> None:
    far = area([(x + 700.0, y) for x, y in SQUARE])
    with pytest.raises(InputError, match="the terrain model ends before latitude"):
        plan_survey(request(terrain={"file": "x"}), (far,), CAMERA, hills())


def test_fences_hold_the_whole_path() -> None:
    wide = area([(-80.0, -80.0), (230.0, -80.0), (230.0, 200.0), (-80.0, 200.0)])
    inside = Fences(inside=(wide,))
    plan_survey(request(), (area(SQUARE),), CAMERA, fences=inside)
    with pytest.raises(InputError, match="leaves the fence near latitude"):
        plan_survey(request(), (area(SQUARE),), CAMERA, fences=Fences(inside=(area(SQUARE),)))
    wing = vehicle(kind=VehicleKind.FIXED_WING, turn_radius_m=60.0, speed_m_s=9.0)
    with pytest.raises(InputError, match="fence"):
        plan_survey(request(), (area(SQUARE),), CAMERA, vehicle=wing, fences=inside)
    tower = area([(70.0, 50.0), (80.0, 50.0), (80.0, 60.0), (70.0, 60.0)])
    with pytest.raises(InputError, match="crosses a place to keep out of"):
        plan_survey(request(), (area(SQUARE),), CAMERA, fences=Fences(outside=(tower,)))
