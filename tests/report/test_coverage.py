"""Footprints and overlap against plane geometry."""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.camera import InteriorOrientation
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.result import OrientedBlock
from uavkit.report.coverage import Ground, footprint_m, ground_surface, heights_above_ground_m, overlap_counts

PLAIN = InteriorOrientation(width_px=401, height_px=301, principal_distance_px=500.0, x0_px=200.0, y0_px=150.0)


def flat(height: float) -> Ground:
    axis = np.linspace(-30.0, 30.0, 61)
    return Ground(east_m=axis, north_m=axis, height_m=np.full((61, 61), height))


def test_footprint_of_a_nadir_still() -> None:
    exterior = ExteriorOrientation.from_omega_phi_kappa(np.array([3.0, -2.0, 60.0]), 0.0, 0.0, 0.0)
    outline = footprint_m(exterior, PLAIN, flat(10.0))
    # 50 m above ground: half sides 200 / 500 and 150 / 500 of it.
    np.testing.assert_allclose(outline.min(axis=0), [3.0 - 20.0, -2.0 - 15.0])
    np.testing.assert_allclose(outline.max(axis=0), [3.0 + 20.0, -2.0 + 15.0])
    np.testing.assert_allclose(outline[0], [3.0 - 20.0, -2.0 + 15.0])  # upper left pixel: north-west


def test_no_footprint_above_the_horizon() -> None:
    exterior = ExteriorOrientation.from_omega_phi_kappa(np.array([0.0, 0.0, 60.0]), np.radians(90.0), 0.0, 0.0)
    outline = footprint_m(exterior, PLAIN, flat(0.0))
    assert np.any(np.isnan(outline))
    assert np.any(np.isfinite(outline))


def test_overlap_counts_the_cells_that_two_stills_see(result: OrientedBlock) -> None:
    adjusted = replace(
        result.adjustment,
        interior=PLAIN,
        projection_centres_m=np.array([[0.0, 0.0, 50.0], [10.0, 0.0, 50.0]]),
        R_object_from_image=np.tile(np.eye(3), (2, 1, 1)),
    )
    counts = overlap_counts(replace(result, adjustment=adjusted), flat(0.0))
    # East: -20..20 and -10..30; north: -15..15; the grid has a cell each metre.
    assert np.sum(counts == 2) == 31 * 31
    assert np.sum(counts == 1) == 31 * 20
    row, column = 30, 61 - 1 - 0
    assert counts[row, column] == 1
    assert counts[row, 0] == 0


def test_a_folding_distortion_adds_no_ground(result: OrientedBlock) -> None:
    folding = replace(PLAIN, k1=-0.3)  # r (1 - 0.3 r^2) comes back through zero at r = 1.8
    adjusted = replace(
        result.adjustment,
        interior=folding,
        projection_centres_m=np.array([[0.0, 0.0, 15.0]]),
        R_object_from_image=np.eye(3)[None],
    )
    counts = overlap_counts(replace(result, adjustment=adjusted), flat(0.0))
    seen_north, seen_east = np.nonzero(counts)
    assert np.abs(seen_east - 30).max() <= 8  # 0.43 of 15 m is 6.5 m
    assert np.abs(seen_north - 30).max() <= 8
    assert counts[30, 30] == 1


def test_ground_surface_follows_the_points(result: OrientedBlock) -> None:
    ground = ground_surface(result)
    points = result.adjustment.points_m
    error = ground.height_at_m(points[:, :2]) - points[:, 2]
    assert np.median(np.abs(error)) < 0.3  # a cell is 0.9 m wide on a slope of at most 0.83
    height = heights_above_ground_m(result, ground)
    assert height.min() > 11.0
    assert height.max() < 23.0


@pytest.mark.parametrize("count", [0, 1, 3])
def test_ground_of_hardly_any_point(result: OrientedBlock, count: int) -> None:
    points = np.full_like(result.adjustment.points_m, np.nan)
    points[:count] = [[1.0, 2.0, 5.0]]
    ground = ground_surface(replace(result, adjustment=replace(result.adjustment, points_m=points)))
    assert np.all(ground.height_m == (5.0 if count else 0.0))


def test_ground_of_points_on_one_line(result: OrientedBlock) -> None:
    points = np.full_like(result.adjustment.points_m, np.nan)
    points[:20] = np.linspace([0.0, 0.0, 1.0], [40.0, 20.0, 3.0], 20)
    ground = ground_surface(replace(result, adjustment=replace(result.adjustment, points_m=points)))
    assert ground.height_m.min() >= 1.0
    assert ground.height_m.max() <= 3.0


def test_one_bad_point_does_not_move_the_ground(result: OrientedBlock) -> None:
    points = result.adjustment.points_m.copy()
    sound = ground_surface(result).height_m
    points[150, 2] += 500.0
    spoilt = ground_surface(replace(result, adjustment=replace(result.adjustment, points_m=points))).height_m
    assert np.abs(spoilt - sound).max() < 8.0  # the neighbours' heights, on a bank of 10 m
