"""A square kilometre of mountains, followed at 60 m above ground, judged by code independent of the planner."""

from pathlib import Path

import numpy as np
import pytest
from independent import Judgement, broken_promises, judge

from uavkit.core.flightplan import AreaKind, FlightPlan, SurveyArea
from uavkit.core.frames import LocalMap
from uavkit.core.surface import ElevationGrid
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
elevation_file = pytest.importorskip("uavkit.formats.elevation_file", reason="elevation models are not read yet")

TILE = Path(__file__).resolve().parents[2] / "../shared/data/terrain/N44W072.hgt"
MIDDLE = (44.274, -71.3167)
"""North of Mount Washington: the Great Gulf and its headwall."""
SIDE_M = 1000.0
SMALL_SIDE_M = 300.0
HEIGHT_M = 60.0
STEEPEST_DEG = 45.0
CAMERA = "DJI FC6310"

pytestmark = pytest.mark.skipif(not TILE.is_file(), reason=f"{TILE.name} is not in ../shared/data/terrain")


@pytest.fixture(scope="module")
def mountains() -> ElevationGrid:
    latitude, longitude = MIDDLE
    around = (latitude - 0.02, longitude - 0.03, latitude + 0.02, longitude + 0.03)
    grid: ElevationGrid = elevation_file.read_elevation(TILE, around=around)
    return grid


def square(side_m: float = SIDE_M) -> SurveyArea:
    place = LocalMap(latitude_deg=MIDDLE[0], longitude_deg=MIDDLE[1], height_ellipsoid_m=1400.0)
    corners = side_m / 2 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return SurveyArea(
        name="Great Gulf", kind=AreaKind.POLYGON, latitude_longitude_deg=place.geographic_from_map(corners)
    )


def asked(side_m: float = SIDE_M) -> PlanRequest:
    corners = [(float(a), float(b)) for a, b in square(side_m).latitude_longitude_deg]
    return PlanRequest(
        name="mountains",
        areas=[InlineArea(name="Great Gulf", latitude_longitude_deg=corners)],
        camera=CAMERA,
        imaging=ImagingRequest(height_above_ground_m=HEIGHT_M, forward_overlap=0.8, side_overlap=0.6),
        terrain=TerrainRequest(file=TILE.name, follow=True),
        flight=FlightRequest(climb_m_s=3.0, descent_m_s=2.0, greatest_height_above_ground_m=1000.0),
        sorties=SortiesRequest(most_items=100000),
    )


def followed(mountains: ElevationGrid, side_m: float) -> FlightPlan:
    plan: FlightPlan = planner.plan_survey(asked(side_m), (square(side_m),), load_camera(CAMERA), mountains).plan
    return plan


def steepest_deg(grid: ElevationGrid, area: SurveyArea) -> float:
    """Return the greatest slope at the corners of the grid's cells that have a node in the area's bounding box."""
    (west, south), (east, north) = (
        grid.grid_from_crs(corner[::-1][None])[0]
        for corner in (area.latitude_longitude_deg.min(axis=0), area.latitude_longitude_deg.max(axis=0))
    )
    rows = slice(int(min(south, north)), int(np.ceil(max(south, north))) + 1)
    columns = slice(int(west), int(np.ceil(east)) + 1)
    height = grid.height_ellipsoid_m[rows, columns].astype(float)
    metres_per_deg = 111130.0
    by_column = np.diff(height, axis=1) / (
        grid.crs_from_grid[0, 0] * metres_per_deg * np.cos(np.radians(MIDDLE[0])) * 1.0034
    )
    by_row = np.diff(height, axis=0) / (grid.crs_from_grid[1, 1] * metres_per_deg)
    corners = [np.hypot(a, b) for a in (by_column[:-1], by_column[1:]) for b in (by_row[:, :-1], by_row[:, 1:])]
    return float(np.degrees(np.arctan(np.max(corners))))


def check(found: Judgement) -> None:
    print(found)  # noqa: T201 - figures of the run
    assert broken_promises(found, asked()) == [], found


def test_the_square_is_as_steep_as_it_should_be(mountains: ElevationGrid) -> None:
    assert 0.95 * STEEPEST_DEG < steepest_deg(mountains, square()) <= STEEPEST_DEG


def test_a_part_of_the_mountains_is_followed(mountains: ElevationGrid) -> None:
    plan = followed(mountains, SMALL_SIDE_M)
    check(judge(plan, asked(SMALL_SIDE_M), load_camera(CAMERA), mountains, most_images=50))


@pytest.mark.slow
def test_a_square_kilometre_of_mountains_is_followed(mountains: ElevationGrid) -> None:
    """All images are judged."""
    check(judge(followed(mountains, SIDE_M), asked(), load_camera(CAMERA), mountains))
