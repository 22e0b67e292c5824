"""Pictures of plans: the geometry that they draw, and that they can be drawn of every pattern and size."""

import io
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.plan.made_planned import made_coverage, made_ground, made_planned, made_request
from tests.plan.made_plans import made_plan
from uavkit.core.arrays import Array
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.core.frames import LocalMap
from uavkit.formats.camera_profiles import load_camera
from uavkit.formats.drawing import DPI, png_bytes
from uavkit.formats.plan_request import FacadeRequest, FlightRequest, ImagingRequest, OrbitRequest, PlanRequest
from uavkit.plan.figures import _classes, draw_figures, plan_map, plan_sheet
from uavkit.plan.figures_profile import MOST_PANELS, _exposure_distances_m, height_profile, shown_sorties
from uavkit.plan.planner import plan_survey
from uavkit.plan.scene import Scene

TOO_FEW = (240, 160, 48)
UNSEEN = (90, 26, 0)
NAMES = ["plan", "coverage", "profile", "overlaps"]


def picture(png: bytes) -> Array:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def coloured(png: bytes, colour: tuple[int, int, int]) -> int:
    return int(np.sum(np.all(picture(png) == colour, axis=2)))


def drawn(scene: Scene) -> dict[str, bytes]:
    return {drawing.name: png_bytes(drawing.figure) for drawing in draw_figures(scene) if drawing.figure is not None}


def wall(*xy: tuple[float, float]) -> SurveyArea:
    local_map = LocalMap(latitude_deg=47.0, longitude_deg=8.0)
    return SurveyArea(
        name="wall", kind=AreaKind.LINE, latitude_longitude_deg=local_map.geographic_from_map(np.array(xy))
    )


def test_all_pictures_are_drawn_and_the_same_twice() -> None:
    scene = Scene(planned=made_planned(), request=made_request(), elevation=None)
    first = drawn(scene)
    assert list(first) == NAMES
    assert drawn(Scene(planned=made_planned(), request=made_request(), elevation=None)) == first
    for png in first.values():
        assert picture(png).std() > 5.0


@pytest.mark.parametrize("sorties", [1, 2, 3])
def test_sheet_has_the_size_of_a4(sorties: int) -> None:
    scene = Scene(planned=made_planned(made_plan(sorties=sorties)), request=made_request(), elevation=None)
    assert picture(png_bytes(plan_sheet(scene))).shape == (round(8.27 * DPI), round(11.69 * DPI), 3)


def test_ground_is_that_of_the_terrain_model() -> None:
    planned = made_planned()
    scene = Scene(planned=planned, request=made_request(), elevation=made_ground(planned.plan, 0.2, -0.1))
    xy = np.random.default_rng(1).uniform(-390.0, 390.0, (200, 2))
    heights, beyond = scene.ground_m(xy)
    assert np.max(np.abs(heights - xy @ [0.2, -0.1])) < 1e-4  # float32 nodes of 100 m
    assert not np.any(beyond)
    heights, beyond = scene.ground_m(np.array([[600.0, 0.0], [0.0, 0.0]]))
    assert beyond.tolist() == [True, False]
    assert heights[0] == pytest.approx(0.2 * 400.0, abs=1e-4)  # the rim's height goes on


def test_profile_of_a_path_over_a_slope() -> None:
    plan = made_plan(strips=4, exposures=8)
    slope = np.array([0.08, 0.05])
    scene = Scene(planned=made_planned(plan), request=made_request(), elevation=made_ground(plan, *slope))
    profile = scene.profile(0)
    path = scene.paths_m[0]
    assert profile.distance_m[-1] == pytest.approx(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    assert np.all(np.diff(profile.distance_m) >= 0.0)
    over_plane = path[:, 2] - path[:, :2] @ slope  # a plane: the extremes are at waypoints
    assert profile.above_ground_m.min() == pytest.approx(over_plane.min(), abs=1e-3)
    assert profile.above_ground_m.max() == pytest.approx(over_plane.max(), abs=1e-3)


def test_exposures_lie_on_the_path_where_they_are_taken() -> None:
    plan = made_plan(strips=3, exposures=6, base_m=12.0, lead_in_m=8.0, bends=True)
    scene = Scene(planned=made_planned(plan), request=made_request(), elevation=None)
    at = _exposure_distances_m(scene, 0)
    assert np.all(np.diff(at) > 0.0)
    path, reached = scene.paths_m[0], scene.waypoint_distances_m(0)
    x, y, up = (np.interp(at, reached, path[:, axis]) for axis in range(3))
    assert np.max(np.hypot(*(np.column_stack([x, y]) - scene.stations_m).T)) < 1e-3
    heights = plan.exposures.height_ellipsoid_m - plan.take_off.height_ellipsoid_m
    assert np.max(np.abs(up - heights)) < 1e-6


def test_shown_sorties_hold_the_one_nearest_to_the_ground() -> None:
    plan = made_plan(strips=12, exposures=4, sorties=6, spacing_m=30.0)
    # the strips go to the right of the direction of 30 degrees: uphill, so that the last sortie is the lowest
    scene = Scene(planned=made_planned(plan), request=made_request(), elevation=made_ground(plan, 0.06, -0.03))
    assert shown_sorties(scene, MOST_PANELS) == [0, 1, 2, 5]
    figure = height_profile(scene).figure
    assert figure is not None
    assert len(figure.axes) == 2 * MOST_PANELS
    assert "Not drawn: the other 2 sorties" in height_profile(scene).caption


@given(st.integers(0, 400), st.integers(1, 12))
@settings(deadline=None, derandomize=True)
def test_classes_of_coverage(most: int, wanted: int) -> None:
    bounds, colours = _classes(most, wanted)
    assert bounds[0] == 0
    assert wanted in bounds
    assert bounds[-1] > max(most, wanted)
    assert np.all(np.diff(bounds) > 0)
    assert len(bounds) - 1 == colours.N


def test_cells_seen_too_little_stand_out() -> None:
    full = np.full((40, 60), 6)
    few, unseen = full.copy(), full.copy()
    few[10:20, 10:30] = 3
    unseen[10:20, 10:30] = 0
    pictures = [
        drawn(Scene(planned=made_planned(coverage=made_coverage(c)), request=made_request(), elevation=None))[
            "coverage"
        ]
        for c in (full, few, unseen)
    ]
    key, in_few, in_unseen = (coloured(png, TOO_FEW) for png in pictures)
    share = 200.0 / 2400.0
    blue = int(np.sum(np.all(picture(pictures[0]) != 255, axis=2)))
    assert in_few - key > 0.5 * share * blue  # beside the patch of the colour bar
    assert in_unseen == key
    rows, columns = np.nonzero(np.all(picture(pictures[1]) == TOO_FEW, axis=2))
    on_map = columns < 0.8 * picture(pictures[1]).shape[1]  # right of it is the colour bar
    middle = 0.5 * np.array(picture(pictures[1]).shape[:2])
    assert rows[on_map].mean() > middle[0]  # row 0 of the map is the southernmost
    assert columns[on_map].mean() < middle[1]
    assert coloured(pictures[2], UNSEEN) - coloured(pictures[0], UNSEEN) > 0.5 * share * blue


def test_facade_is_seen_in_its_own_plane() -> None:
    request = PlanRequest(
        camera="Ricoh GX200",
        pattern="facade",
        imaging=ImagingRequest(height_above_ground_m=20.0, least_images=2),
        facade=FacadeRequest(height_m=35.0),
        flight=FlightRequest(trigger="hover"),
    )
    ends = np.array([[30.0, 0.0], [120.0, 40.0]])
    planned = plan_survey(request, (wall((0.0, 0.0), *map(tuple, ends)),), load_camera("Ricoh GX200"))
    scene = Scene(planned=planned, request=request, elevation=None)
    view = scene.facade_view
    # independent: where the images of the longer side look, from their footprints on the wall
    rows = np.flatnonzero(
        np.array([strip.set_number for strip in planned.plan.strips])[planned.plan.exposures.strip] == 1
    )
    middles = scene.footprints_m(rows).mean(axis=1)
    begin, end = scene.outlines[0].rings_m[0][1:]
    along = (end - begin) / np.hypot(*(end - begin))
    assert np.max(np.abs(view.xy_m[:, 0] - (middles - begin) @ along)) < 0.5  # distortion moves the rims' mean a little
    assert view.xy_m[:, 1] == pytest.approx(planned.plan.exposures.height_above_ground_m[rows])
    assert planned.coverage.images.shape[1] * planned.coverage.cell_m == pytest.approx(
        np.hypot(*(end - begin)), rel=0.02
    )
    assert list(drawn(scene)) == NAMES
    assert "vertical" in plan_map(scene).caption


def test_orbit_is_drawn() -> None:
    request = PlanRequest(
        camera="Ricoh GX200",
        pattern="orbit",
        imaging=ImagingRequest(height_above_ground_m=15.0),
        orbit=OrbitRequest(radius_m=30.0, rings=2, object_height_m=20.0),
    )
    tower = SurveyArea(name="tower", kind=AreaKind.POINT, latitude_longitude_deg=np.array([[47.0, 8.0]]))
    planned = plan_survey(request, (tower,), load_camera("Ricoh GX200"))
    scene = Scene(planned=planned, request=request, elevation=None)
    inwards = -scene.stations_m / np.linalg.norm(scene.stations_m, axis=1)[:, None]
    cosines = np.sum(scene.views * inwards, axis=1) / np.linalg.norm(scene.views, axis=1)
    assert cosines.min() > 0.999
    assert list(drawn(scene)) == NAMES


def test_a_take_off_point_far_away_is_told_in_words() -> None:
    plan = made_plan()
    start = replace(plan.take_off, latitude_deg=plan.take_off.latitude_deg - 0.02)
    planned = made_planned()
    scene = Scene(planned=replace(planned, plan=replace(plan, take_off=start)), request=made_request(), elevation=None)
    caption = plan_map(scene).caption
    assert "2.2 km south" in caption or "2.3 km south" in caption  # 0.02 degrees, and half the area


def test_many_images_are_drawn_in_time() -> None:
    plan = made_plan(strips=130, exposures=200, base_m=5.0, spacing_m=8.0, sorties=5)
    planned = made_planned(plan, made_coverage(np.full((500, 600), 9)))
    scene = Scene(planned=planned, request=made_request(), elevation=made_ground(plan, 0.01, 0.0))
    begin = time.process_time()
    pictures = drawn(scene)
    assert time.process_time() - begin < 10.0
    assert sum(len(png) for png in pictures.values()) < 3e6
