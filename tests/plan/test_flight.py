"""Paths, times and sorties."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.plan.made_requests import MAP, SQUARE, area, hills, request, vehicle
from uavkit.core.errors import InputError
from uavkit.core.flightplan import WaypointRole
from uavkit.formats.camera_profiles import load_camera
from uavkit.plan.flight import Performance, SortieLimits, divide, leg_speeds, transit_path
from uavkit.plan.ground import ground_from_grid
from uavkit.plan.lines import HeightRule
from uavkit.plan.planner import Planned, plan_survey

FLIES = Performance(
    speed_m_s=5.0,
    transit_m_s=8.0,
    climb_m_s=3.0,
    descent_m_s=2.0,
    acceleration_m_s2=2.0,
    turn_radius_m=0.0,
    hold_s=0.0,
    stops=False,
    even_speed=False,
)


def planned(**tables: object) -> Planned:
    sizes = tables.pop("vehicle_of", None)
    ground = hills() if "terrain" in tables else None
    return plan_survey(request(**tables), (area(SQUARE),), load_camera("Ricoh GX200"), ground, sizes)  # type: ignore[arg-type]


def test_climb_and_descent_slow_a_leg_down() -> None:
    path = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 60.0], [100.0, 0.0, 0.0], [150.0, 0.0, 0.0], [150.0, 0.0, 30.0]])
    speeds, duration = leg_speeds(path, 5.0, FLIES)
    assert duration == pytest.approx([20.0, 30.0, 10.0, 10.0])
    assert speeds == pytest.approx([2.5, 50.0 / 30.0, 5.0, 5.0])


@pytest.mark.parametrize("follow", [False, True])
def test_transit_keeps_clear_of_a_hill(follow: bool) -> None:
    ground = ground_from_grid(MAP, hills(height_m=30.0), (-400.0, -400.0, 400.0, 400.0))
    rule = HeightRule(above_ground_m=20.0, altitude_m=None if follow else 405.0, tolerance_m=2.0)
    ends = np.array([[-300.0, -200.0, 0.0], [300.0, 200.0, 0.0]])
    ends[:, 2] = ground.heights_at(ends[:, :2]) + 20.0
    path = transit_path(ground, rule, 15.0, (ends[0], ends[1]))
    assert np.array_equal(path[[0, -1]], ends)
    assert float(ground.clearances(path).min()) >= 15.0 - 1e-6


@given(
    lengths=st.lists(st.integers(2, 40), min_size=1, max_size=15),
    step_s=st.floats(1.0, 8.0),
    budget_s=st.floats(150.0, 900.0),
    overlap=st.integers(0, 4),
)
@settings(max_examples=150, deadline=None)
def test_sorties_take_every_station_and_overlap(
    lengths: list[int], step_s: float, budget_s: float, overlap: int
) -> None:
    count = sum(lengths)
    times = step_s * np.arange(count)
    away = np.full((count, 2), 30.0)
    line_of = np.repeat(np.arange(len(lengths)), lengths)
    limits = SortieLimits(duration_s=budget_s, items=float("inf"), overlap_stations=overlap)
    sorties = divide(times, away, np.zeros(count), line_of, limits)
    assert sorties[0][0] == 0
    assert sorties[-1][1] == count - 1
    for (_, end), (begin, after) in itertools.pairwise(sorties):
        assert end + 1 - overlap <= begin <= end + 1
        assert after > end
    assert all(60.0 + times[end] - times[begin] <= budget_s for begin, end in sorties)


def test_sortie_that_leads_nowhere_is_refused() -> None:
    with pytest.raises(InputError, match="take off nearer"):
        divide(
            10.0 * np.arange(50),
            np.full((50, 2), 200.0),
            np.zeros(50),
            np.zeros(50, np.int64),
            SortieLimits(duration_s=410.0, items=float("inf"), overlap_stations=3),
        )


@pytest.mark.parametrize("trigger", ["distance", "hover", "time"])
def test_sorties_keep_the_endurance(trigger: str) -> None:
    small = vehicle(endurance_s=320.0)
    made = planned(flight={"trigger": trigger}, terrain={"file": "x", "follow": True}, vehicle_of=small).plan
    assert len(made.sorties) > 1
    assert all(sortie.duration_s <= 0.8 * 320.0 for sortie in made.sorties)
    stations = made.exposures.station
    assert set(stations) == set(range(int(stations.max()) + 1))
    for before, after in zip(made.sorties, made.sorties[1:], strict=False):
        last = stations[before.first_exposure + before.exposures - 1]
        assert stations[after.first_exposure] == last + 1 - 3


def test_waypoints_tell_the_exposures() -> None:
    for trigger in ("distance", "hover"):
        plan = planned(flight={"trigger": trigger}).plan
        taken = [point for sortie in plan.sorties for point in sortie.waypoints if point.exposure >= 0]
        for point in taken:
            assert point.role is WaypointRole.EXPOSURE
            assert point.latitude_deg == pytest.approx(plan.exposures.latitude_deg[point.exposure], abs=1e-10)
            assert point.height_ellipsoid_m == pytest.approx(plan.exposures.height_ellipsoid_m[point.exposure])
        firsts = {strip.first_exposure for strip in plan.strips}
        lasts = {strip.first_exposure + strip.exposures - 1 for strip in plan.strips}
        assert {point.exposure for point in taken} >= firsts | lasts
        assert np.all(np.diff(plan.exposures.time_s) > 0.0)


def test_resumed_plan_takes_the_rest() -> None:
    asked = request()
    whole = plan_survey(asked, (area(SQUARE),), load_camera("Ricoh GX200")).plan
    rest = plan_survey(asked, (area(SQUARE),), load_camera("Ricoh GX200"), first_station=40).plan
    assert rest.exposures.station[0] == 40 - asked.sorties.overlap_images
    kept = whole.exposures.station >= 37
    assert np.array_equal(rest.exposures.station, whole.exposures.station[kept])
    assert np.allclose(rest.exposures.latitude_deg, whole.exposures.latitude_deg[kept], atol=1e-12)
    with pytest.raises(InputError, match="no exposure station"):
        plan_survey(asked, (area(SQUARE),), load_camera("Ricoh GX200"), first_station=100000)
