"""Missions of flight plans, and the exposures that a mission takes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.plan.made_plans import GROUND_M, level, made_plan
from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, FlightPlan, SurveyArea, Trigger, WaypointRole
from uavkit.core.frames import LocalMap, geoid_undulation_m
from uavkit.core.mission import Mission, MissionCommand, MissionFrame, MissionItem
from uavkit.core.vehicle import VehicleKind
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.plan_request import PlanRequest
from uavkit.formats.vehicle_profiles import load_vehicle
from uavkit.formats.waypoints_file import read_waypoints
from uavkit.plan.mission import ExpectedExposures, exposures_of, item_count, mission_of
from uavkit.plan.planner import plan_survey

SITL = Path(__file__).resolve().parents[2] / "../shared/data/sitl"
METRES = np.array([111_000.0, 90_000.0])
AUTOPILOTS = ["ardupilot", "px4", "other"]


def distances_m(plan: FlightPlan, taken: ExpectedExposures) -> Array:
    ours = np.column_stack([plan.exposures.latitude_deg, plan.exposures.longitude_deg])
    theirs = np.column_stack([taken.latitude_deg, taken.longitude_deg])
    return np.asarray(np.linalg.norm((ours - theirs) * METRES, axis=1))


def angle_deg(a: Array, b: Array) -> Array:
    return np.asarray(np.abs((a - b + 180.0) % 360.0 - 180.0))


def commands(mission: Mission, command: MissionCommand) -> list[MissionItem]:
    return [item for item in mission.items if item.command == command]


def place(
    command: MissionCommand, north_m: float, east_m: float, up_m: float = 20.0, hold_s: float = 0.0
) -> MissionItem:
    """Return an item at the equator, where a degree is known by heart."""
    return MissionItem(
        command=int(command), frame=MissionFrame.TAKE_OFF, parameters=(hold_s, 0.0, 0.0, 0.0),
        latitude_deg=1.0 + north_m / 110_575.6, longitude_deg=1.0 + east_m / 111_302.6, altitude_m=up_m,
    )  # fmt: skip


def do(command: int, *parameters: float) -> MissionItem:
    p = [*parameters, *[0.0] * (7 - len(parameters))]
    return MissionItem(
        command=command, frame=MissionFrame.COMMAND, parameters=(p[0], p[1], p[2], p[3]),
        latitude_deg=p[4], longitude_deg=p[5], altitude_m=p[6],
    )  # fmt: skip


def path_m(taken: ExpectedExposures) -> Array:
    """Return north and east of exposures of a mission made with ``place``."""
    return np.column_stack([(taken.latitude_deg - 1.0) * 110_575.6, (taken.longitude_deg - 1.0) * 111_302.6])


def circle_plan(trigger: Trigger, exposures: int, radius_m: float) -> FlightPlan:
    """Return a plan of one round about a point, looking at it, with a waypoint at each exposure."""
    plan = made_plan(trigger, strips=1, exposures=exposures)
    local_map = LocalMap(latitude_deg=35.8, longitude_deg=139.65, height_ellipsoid_m=GROUND_M)
    angles = np.radians(np.append(np.arange(exposures), exposures - 0.6) * 360.0 / exposures)
    places = local_map.geographic_from_map(radius_m * np.column_stack([np.sin(angles), np.cos(angles)]))
    headings = (np.degrees(angles) + 180.0) % 360.0
    first = next(w for w in plan.sorties[0].waypoints if w.role is WaypointRole.EXPOSURE)
    roles = [WaypointRole.EXPOSURE, *[WaypointRole.PATH] * (exposures - 2), WaypointRole.EXPOSURE, WaypointRole.EXIT]
    ring = [
        replace(
            first, role=role, latitude_deg=float(latitude), longitude_deg=float(longitude), heading_deg=float(heading),
            exposure=number if role is WaypointRole.EXPOSURE else -1,
        )
        for number, (role, (latitude, longitude), heading) in enumerate(zip(roles, places, headings, strict=True))
    ]  # fmt: skip
    start, transit, *_, home = plan.sorties[0].waypoints
    strip = replace(plan.strips[0], base_m=2.0 * math.pi * radius_m / exposures)
    table = replace(
        plan.exposures, latitude_deg=places[:-1, 0], longitude_deg=places[:-1, 1], heading_deg=headings[:-1],
        R_map_from_image=np.stack([level(heading) for heading in headings[:-1]]),
    )  # fmt: skip
    flight = replace(plan.sorties[0], waypoints=(start, transit, *ring, home))
    return replace(plan, exposures=table, sorties=(flight,), strips=(strip,))


WAYPOINT, DISTANCE = MissionCommand.WAYPOINT, MissionCommand.DO_SET_CAM_TRIGG_DIST


@pytest.mark.parametrize("autopilot", AUTOPILOTS)
@pytest.mark.parametrize("trigger", list(Trigger))
@pytest.mark.parametrize("pattern", ["strips", "facade"])
def test_a_mission_takes_the_exposures_of_its_plan(pattern: str, trigger: Trigger, autopilot: str) -> None:
    plan = made_plan(trigger, pattern=pattern)
    taken = exposures_of(mission_of(plan, 0, autopilot, "take_off"))
    assert len(taken) == len(plan.exposures)
    assert distances_m(plan, taken).max() < 0.01
    assert np.allclose(taken.altitude_m, plan.exposures.height_ellipsoid_m - GROUND_M, atol=1e-3)
    assert angle_deg(taken.heading_deg, plan.exposures.heading_deg).max() < 0.01
    assert np.allclose(taken.camera_pitch_deg, 0.0 if pattern == "facade" else -90.0, atol=0.01)
    assert np.array_equal(taken.strip, plan.exposures.strip)


@given(
    trigger=st.sampled_from([Trigger.DISTANCE, Trigger.HOVER]),
    strips=st.integers(1, 4),
    exposures=st.integers(2, 7),
    base_m=st.floats(2.0, 60.0),
    direction_deg=st.floats(0.0, 360.0, exclude_max=True),
    lead_in_m=st.sampled_from([0.0, 10.0]),
    latitude_deg=st.floats(-75.0, 75.0),
    longitude_deg=st.floats(-179.0, 179.0),
    autopilot=st.sampled_from(AUTOPILOTS),
)
@settings(max_examples=40, deadline=None)
def test_anywhere_in_any_direction(
    trigger: Trigger, strips: int, exposures: int, base_m: float, direction_deg: float, lead_in_m: float,
    latitude_deg: float, longitude_deg: float, autopilot: str,
) -> None:  # fmt: skip
    assume(max(abs(latitude_deg), abs(longitude_deg)) > 1e-3)  # 0, 0 means to autopilots: where you are
    plan = made_plan(
        trigger, strips=strips, exposures=exposures, base_m=base_m, direction_deg=direction_deg, lead_in_m=lead_in_m,
        latitude_deg=latitude_deg, longitude_deg=longitude_deg, bends=True,
    )  # fmt: skip
    taken = exposures_of(mission_of(plan, 0, autopilot, "geoid"))
    assert len(taken) == len(plan.exposures)
    assert distances_m(plan, taken).max() < 0.01
    # without a lead-in the vehicle comes to the first exposure of a strip from aside: its heading is commanded
    assert angle_deg(taken.heading_deg, plan.exposures.heading_deg).max() < 0.01
    undulation_m = geoid_undulation_m(plan.exposures.latitude_deg, plan.exposures.longitude_deg)
    assert taken.frame is MissionFrame.GEOID
    # altitudes are straight between waypoints, the geoid is not quite
    assert np.allclose(taken.altitude_m, plan.exposures.height_ellipsoid_m - undulation_m, atol=0.02)


def test_each_sortie_takes_its_own_exposures() -> None:
    plan = made_plan(strips=4, sorties=2)
    for number, flight in enumerate(plan.sorties):
        taken = exposures_of(mission_of(plan, number, "ardupilot", "take_off"))
        rows = slice(flight.first_exposure, flight.first_exposure + flight.exposures)
        assert np.allclose(taken.latitude_deg, plan.exposures.latitude_deg[rows], atol=1e-7)
        assert np.allclose(taken.longitude_deg, plan.exposures.longitude_deg[rows], atol=1e-7)


def test_order_of_items_about_a_strip() -> None:
    """The trigger starts right after its waypoint and stops after the exit; a speed is set before its leg."""
    mission = mission_of(made_plan(strips=1), 0, "ardupilot", "take_off")
    assert [item.command for item in mission.items] == [22, 178, 16, 205, 16, 178, 16, 206, 16, 16, 206, 178, 16, 20]
    start, stop = commands(mission, DISTANCE)
    assert start.parameters == (12.0, 0.0, 1.0, 0.0)
    assert stop.parameters == (0.0, 0.0, 0.0, 0.0)
    assert [item.parameters[1] for item in commands(mission, MissionCommand.DO_CHANGE_SPEED)] == [6.0, 4.0, 6.0]
    (mount,) = commands(mission, MissionCommand.DO_MOUNT_CONTROL)
    assert (*mount.parameters, mount.altitude_m) == (-90.0, 0.0, 0.0, 0.0, 2.0)


def test_time_interval_is_base_by_speed() -> None:
    mission = mission_of(made_plan(Trigger.TIME, base_m=12.0, speed_m_s=5.0), 0, "px4", "take_off")
    starts = commands(mission, MissionCommand.IMAGE_START_CAPTURE)
    assert [item.parameters[:3] for item in starts] == [(0.0, 2.4, 0.0)] * 3
    assert len(commands(mission, MissionCommand.IMAGE_STOP_CAPTURE)) == 3


def test_strips_that_climb_are_triggered_by_their_speed_over_ground() -> None:
    plan = made_plan(Trigger.TIME, bends=True)
    taken = exposures_of(mission_of(plan, 0, "px4", "take_off"))
    assert len(taken) == len(plan.exposures)
    assert distances_m(plan, taken).max() < 0.01


@pytest.mark.parametrize("trigger", [Trigger.DISTANCE, Trigger.TIME])
def test_on_a_circle_the_chord_counts(trigger: Trigger) -> None:
    """Twelve exposures at 30 degrees of a circle of 20 m: the base is 10.47 m of arc, the vehicle measures 10.35 m."""
    plan = circle_plan(trigger, exposures=12, radius_m=20.0)
    mission = mission_of(plan, 0, "ardupilot", "take_off")
    taken = exposures_of(mission)
    assert len(taken) == 12
    assert distances_m(plan, taken).max() < 0.05
    assert angle_deg(taken.heading_deg, plan.exposures.heading_deg).max() < 30.1
    if trigger is Trigger.DISTANCE:
        assert commands(mission, DISTANCE)[0].parameters[0] == pytest.approx(
            40.0 * math.sin(math.radians(15.0)), rel=1e-3
        )


def test_distance_triggers_cannot_go_straight_up() -> None:
    plan = made_plan(strips=1)
    table = replace(
        plan.exposures,
        latitude_deg=np.full(5, 35.8),
        longitude_deg=np.full(5, 139.65),
        height_ellipsoid_m=50.0 + 12.0 * np.arange(5),
    )
    with pytest.raises(InputError, match="strip 1 goes up and down"):
        mission_of(replace(plan, exposures=table), 0, "px4", "take_off")


@pytest.mark.parametrize(
    "autopilot, command", [("ardupilot", 203), ("other", 203), ("px4", 2000)], ids=["ardupilot", "other", "px4"]
)
def test_hover_takes_one_at_each_station(autopilot: str, command: int) -> None:
    plan = made_plan(Trigger.HOVER)
    items = mission_of(plan, 0, autopilot, "take_off").items
    shots = [number for number, item in enumerate(items) if item.command == command]
    assert len(shots) == len(plan.exposures)
    assert all(items[number - 1].command == WAYPOINT and items[number - 1].parameters[0] == 2.0 for number in shots)
    if command == 203:
        assert all(items[number].latitude_deg == 1.0 for number in shots)
    else:
        assert all(items[number].parameters[:3] == (0.0, 0.0, 1.0) for number in shots)


def test_headings_as_each_autopilot_takes_them() -> None:
    plan = made_plan(Trigger.HOVER, pattern="facade", direction_deg=10.0)
    ours = mission_of(plan, 0, "ardupilot", "take_off")
    theirs = mission_of(plan, 0, "px4", "take_off")
    assert {item.parameters[0] for item in commands(ours, MissionCommand.CONDITION_YAW)} == {100.0}
    assert all(item.parameters[3] == 0.0 for item in commands(ours, WAYPOINT))
    assert not commands(theirs, MissionCommand.CONDITION_YAW)
    yaws = [item.parameters[3] for item in commands(theirs, WAYPOINT)]
    assert yaws.count(100.0) == len(plan.exposures)
    assert sum(map(math.isnan, yaws)) == len(yaws) - len(plan.exposures)


def test_an_aeroplane_flies_by_airspeed_and_needs_no_heading() -> None:
    plan = made_plan(pattern="facade")
    mission = mission_of(plan, 0, "ardupilot", "take_off", VehicleKind.FIXED_WING)
    assert mission.vehicle_type == 1
    assert not commands(mission, MissionCommand.CONDITION_YAW)
    assert {item.parameters[0] for item in commands(mission, MissionCommand.DO_CHANGE_SPEED)} == {0.0}


def test_small_changes_of_speed_are_no_items() -> None:
    plan = made_plan(strips=1)
    flight = plan.sorties[0]
    wobbling = tuple(
        replace(waypoint, speed_m_s=5.0 + 0.02 * (-1) ** number) for number, waypoint in enumerate(flight.waypoints)
    )
    plan = replace(plan, sorties=(replace(flight, waypoints=wobbling),))
    assert len(commands(mission_of(plan, 0, "px4", "take_off"), MissionCommand.DO_CHANGE_SPEED)) == 1


def test_altitudes_and_home_above_the_geoid() -> None:
    plan = made_plan(height_m=30.0)
    undulation_m = float(geoid_undulation_m(np.array(35.8), np.array(139.65)))
    mission = mission_of(plan, 0, "ardupilot", "geoid")
    assert mission.home_height_geoid_m == pytest.approx(GROUND_M - undulation_m)
    places = [item for item in mission.items if item.frame is not MissionFrame.COMMAND]
    assert {item.frame for item in places} == {MissionFrame.GEOID}
    assert all(item.altitude_m == pytest.approx(GROUND_M + 30.0 - undulation_m, abs=0.01) for item in places)


@pytest.mark.parametrize("trigger", list(Trigger))
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_item_count_counts_home_on_ardupilot(autopilot: str, trigger: Trigger) -> None:
    plan = made_plan(trigger, pattern="facade")
    expected = len(mission_of(plan, 0, autopilot, "geoid").items) + (autopilot == "ardupilot")
    assert item_count(plan, 0, autopilot) == expected


def test_the_exit_of_a_hover_strip_is_no_item_of_its_own() -> None:
    plan = made_plan(Trigger.HOVER, strips=1, exposures=3)
    exits = [waypoint for waypoint in plan.sorties[0].waypoints if waypoint.role is WaypointRole.EXIT]
    assert len(exits) == 1
    assert len(commands(mission_of(plan, 0, "ardupilot", "take_off"), WAYPOINT)) == len(plan.sorties[0].waypoints) - 2


@pytest.mark.parametrize(
    "sortie, autopilot, altitude_from, words",
    [(1, "px4", "geoid", "no sortie 2"), (0, "px", "geoid", "px4"), (0, "px4", "sea", "take_off")],
)
def test_what_is_refused(sortie: int, autopilot: str, altitude_from: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        mission_of(made_plan(), sortie, autopilot, altitude_from)


@pytest.mark.parametrize("at_once, first_m", [(1.0, 0.0), (0.0, 10.0)])
def test_distance_trigger_along_a_bent_path(at_once: float, first_m: float) -> None:
    """25 m north, then east: the fourth exposure is where the straight way from the third, at 20 m north, is 10 m."""
    mission = Mission(items=(place(WAYPOINT, 0, 0), do(206, 10.0, 0.0, at_once), place(WAYPOINT, 25, 0, 70.0),
                             place(WAYPOINT, 25, 12), do(206, 0.0), place(WAYPOINT, 25, 90)))  # fmt: skip
    expected = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [25.0, math.sqrt(75.0)]])
    taken = exposures_of(mission)
    assert np.allclose(path_m(taken), expected[int(first_m / 10.0) :], atol=0.01)
    assert taken.altitude_m[-2] == pytest.approx(60.0, abs=0.01)  # 20 of the 25 m on the way from 20 to 70 m
    assert taken.heading_deg[-2:] == pytest.approx([0.0, 90.0], abs=0.1)
    assert taken.strip[-2] == 0
    assert np.all(taken.item == 1)


def test_time_trigger_waits_at_a_waypoint_and_ends_after_its_number() -> None:
    """At 5 m/s every 3 s: the vehicle waits at 40 m from 8 s to 15 s."""
    path = (place(WAYPOINT, 0, 0), do(2000, 0.0, 3.0, 7.0), place(WAYPOINT, 40, 0, hold_s=7.0), place(WAYPOINT, 200, 0))
    taken = exposures_of(Mission(items=(do(178, 1.0, 5.0), *path)))
    assert path_m(taken)[:, 0] == pytest.approx([0.0, 15.0, 30.0, 40.0, 40.0, 40.0, 55.0], abs=0.01)


def test_time_trigger_without_a_speed_asks_for_it() -> None:
    mission = Mission(items=(place(WAYPOINT, 0, 0), do(214, 2000.0), place(WAYPOINT, 41, 0)), source="x.plan")
    with pytest.raises(InputError, match=r"x\.plan: item 1 .* no speed"):
        exposures_of(mission)
    assert path_m(exposures_of(mission, speed_m_s=10.0))[:, 0] == pytest.approx([0.0, 20.0, 40.0], abs=0.01)
    assert len(exposures_of(replace(mission, hover_speed_m_s=5.0))) == 5


def test_headings_and_gimbal_as_commanded() -> None:
    first = (place(WAYPOINT, 0, 0), do(205, -45.0, 0, 0, 0, 0, 0, 2.0), do(115, 250.0), place(WAYPOINT, 0, 30))
    path = (*first, do(2000, 0, 0, 1), do(1000, -60.0), place(WAYPOINT, 0, 60), do(203, 0, 0, 0, 0, 1.0))
    taken = exposures_of(Mission(items=path))
    assert taken.heading_deg == pytest.approx([250.0, 90.0], abs=0.1)
    assert taken.camera_pitch_deg.tolist() == [-45.0, -60.0]
    assert taken.item.tolist() == [4, 7]


def test_headings_count_from_true_north() -> None:
    """Along meridians 22 km apart the map's north is 0.17 degrees off on either side."""
    shot = do(203, 0, 0, 0, 0, 1.0)
    corners = [(60.0, 10.0), (60.01, 10.0), (60.01, 10.4), (60.0, 10.4)]
    legs = [replace(place(WAYPOINT, 0, 0), latitude_deg=lat, longitude_deg=lon) for lat, lon in corners]
    items = (legs[0], legs[1], shot, legs[2], legs[3], shot)
    assert angle_deg(exposures_of(Mission(items=items)).heading_deg, np.array([0.0, 180.0])).max() < 0.01


def test_start_and_return_are_legs_too() -> None:
    """Triggering that nobody stops goes on from home and back to it, at the altitude of the last waypoint."""
    home = {"home_latitude_deg": 1.0, "home_longitude_deg": 1.0, "home_height_geoid_m": 5.0}
    mission = Mission(items=(do(206, 30.0, 0.0, 1.0), place(WAYPOINT, 61, 0, 61.0), do(20)), **home)  # type: ignore[arg-type]
    taken = exposures_of(mission)
    assert path_m(taken)[:, 0] == pytest.approx([0.0, 30.0, 60.0, 30.0, 0.0], abs=0.01)
    assert taken.altitude_m == pytest.approx([0.0, 30.0, 60.0, 61.0, 61.0], abs=0.01)


def test_mixed_altitudes_need_the_height_of_home() -> None:
    above_sea = replace(place(WAYPOINT, 50, 0, 130.0), frame=MissionFrame.GEOID)
    mission = Mission(items=(place(WAYPOINT, 0, 0, 20.0), do(206, 50.0, 0.0, 1.0), above_sea))
    with pytest.raises(InputError, match="height of the take-off point"):
        exposures_of(mission)
    known = replace(mission, home_latitude_deg=1.0, home_longitude_deg=1.0, home_height_geoid_m=100.0)
    assert exposures_of(known).altitude_m == pytest.approx([120.0, 130.0], abs=1e-3)
    terrain = replace(above_sea, frame=MissionFrame.TERRAIN)
    with pytest.raises(InputError, match="terrain"):
        exposures_of(replace(known, items=(*known.items, terrain)))


def test_jumps_and_missions_without_a_path_are_refused() -> None:
    with pytest.raises(InputError, match="jumps"):
        exposures_of(Mission(items=(place(WAYPOINT, 0, 0), do(177, 1, 2))))
    with pytest.raises(InputError, match="no waypoint"):
        exposures_of(Mission(items=(do(203, 0, 0, 0, 0, 1.0),)))


def test_absurdly_many_exposures_are_refused() -> None:
    with pytest.raises(InputError, match="more than"):
        exposures_of(Mission(items=(place(WAYPOINT, 0, 0), do(206, 1e-3), place(WAYPOINT, 5000, 0))))


@pytest.mark.parametrize("trigger", ["distance", "time", "hover"])
@pytest.mark.parametrize("pattern", ["polygon", "cross_grid"])
def test_missions_take_what_the_planner_planned(pattern: str, trigger: str) -> None:
    """From the request to the items: the exposures of all sorties, with those that two sorties share."""
    ring = [(35.8, 139.65), (35.8004, 139.6501), (35.8003, 139.6506), (35.8001, 139.6507)]
    request = PlanRequest.model_validate(
        {
            "name": "field", "pattern": pattern, "areas": [{"latitude_longitude_deg": ring}], "camera": "Ricoh GX200",
            "imaging": {"height_above_ground_m": 40.0, "forward_overlap": 0.6},
            "flight": {"trigger": trigger}, "sorties": {"reserve": 0.6},
        },
        strict=False,
    )  # fmt: skip
    area = SurveyArea(name="field", kind=AreaKind.POLYGON, latitude_longitude_deg=np.array(ring))
    vehicle = load_vehicle("Generic ArduCopter")
    plan = plan_survey(request, (area,), load_camera("Ricoh GX200"), vehicle=vehicle).plan
    table = plan.exposures
    for autopilot in ("ardupilot", "px4"):
        missions = [mission_of(plan, n, autopilot, "take_off", vehicle.kind) for n in range(len(plan.sorties))]
        taken = [exposures_of(mission) for mission in missions]
        assert [len(part) for part in taken] == [flight.exposures for flight in plan.sorties]
        latitude = np.concatenate([part.latitude_deg for part in taken])
        longitude = np.concatenate([part.longitude_deg for part in taken])
        off = np.column_stack([latitude - table.latitude_deg, longitude - table.longitude_deg])
        assert np.linalg.norm(off * METRES, axis=1).max() < 0.05
        headings = np.concatenate([part.heading_deg for part in taken])
        assert angle_deg(headings, table.heading_deg).max() < 0.5


@pytest.mark.parametrize(
    "flight, feedback, longitude, most_m",
    [
        ("dist", "camera_feedback", "lng", 1.5),
        ("digicam", "camera_feedback", "lng", 1.5),
        ("px4_dist", "camera_image_captured", "lon", 4.0),
    ],
)
def test_expected_exposures_are_where_a_flown_mission_took_them(
    flight: str, feedback: str, longitude: str, most_m: float
) -> None:
    """The vehicle passes a corner by some metres, in 3 m/s of wind, and triggers late by its control step."""
    if not (SITL / f"{flight}.waypoints").is_file():
        pytest.skip("the flights of ../shared/data/sitl are not here")
    taken = exposures_of(read_waypoints(SITL / f"{flight}.waypoints"))
    truth = json.loads((SITL / f"{flight}_truth.json").read_text())[feedback]
    assert len(taken) == len(truth)
    places = np.array([[row["lat"], row[longitude]] for row in truth]) * 1e-7
    off = (places - np.column_stack([taken.latitude_deg, taken.longitude_deg])) * METRES
    assert np.linalg.norm(off, axis=1).max() < most_m
