"""Candidates: order and sigmas of their rays, choosing and joining."""

import numpy as np

from uavkit.core.result import PointOrigin
from uavkit.process.candidates import Candidates, empty, from_measurements, join
from uavkit.process.measurement import MeasuredRays, RayTasks, pairs_of


def _three_points() -> Candidates:
    """Point 0 from still 2 into 0 and 3; point 1 from still 0 without rays; point 2 from still 1 into 0."""
    return Candidates(
        reference_image=np.array([2, 0, 1]),
        reference_px=np.array([[20.0, 21.0], [5.0, 6.0], [30.0, 31.0]]),
        origin=np.array([PointOrigin.VIDEO, PointOrigin.VIDEO, PointOrigin.FEATURES], dtype=np.int8),
        ray_point=np.array([2, 0, 0]),
        ray_image=np.array([0, 3, 0]),
        ray_px=np.array([[7.0, 8.0], [11.0, 12.0], [13.0, 14.0]]),
        ray_sigma_px=np.array([[0.5, 0.6], [0.1, 0.2], [0.3, 0.6]]),
    )


def test_all_rays_are_ordered_and_the_reference_has_the_mean_sigma() -> None:
    point, image, xy, sigma = _three_points().all_rays()
    assert point.tolist() == [0, 0, 0, 2, 2]
    assert image.tolist() == [0, 2, 3, 0, 1]
    np.testing.assert_array_equal(xy, [[13, 14], [20, 21], [11, 12], [7, 8], [30, 31]])
    np.testing.assert_allclose(sigma, [[0.3, 0.6], [0.2, 0.4], [0.1, 0.2], [0.5, 0.6], [0.5, 0.6]])


def test_rays_of_no_points() -> None:
    point, image, xy, sigma = empty().all_rays()
    assert len(point) == len(image) == 0
    assert xy.shape == sigma.shape == (0, 2)
    assert len(join([])) == 0


def test_only_points_numbers_anew() -> None:
    chosen = _three_points().only_points(np.array([False, True, True]))
    assert len(chosen) == 2
    assert chosen.ray_point.tolist() == [1]
    np.testing.assert_array_equal(chosen.reference_px, [[5, 6], [30, 31]])
    np.testing.assert_array_equal(chosen.ray_px, [[7, 8]])


def test_with_rays_keeps_the_points() -> None:
    chosen = _three_points().with_rays(np.array([True, False, True]))
    assert len(chosen) == 3
    assert chosen.ray_image.tolist() == [0, 0]


def test_join_continues_the_numbers() -> None:
    one = _three_points()
    both = join([one, empty(), one.only_points(np.array([True, False, True]))])
    assert len(both) == 5
    assert both.ray_point.tolist() == [2, 0, 0, 4, 3, 3]
    assert both.origin.tolist() == [1, 1, 2, 1, 2]
    for ray, point in enumerate(both.ray_point.tolist()):  # each ray still belongs to the point of the same reference
        assert both.reference_px[point, 0] == (30.0 if both.ray_px[ray, 0] == 7.0 else 20.0)


def _tasks() -> RayTasks:
    return RayTasks(
        point=np.array([9, 4, 9, 6]),
        reference_image=np.array([1, 0, 1, 1]),
        reference_px=np.array([[1.0, 2.0], [3.0, 4.0], [1.0, 2.0], [7.0, 8.0]]),
        target_image=np.array([2, 1, 0, 2]),
        start_px=np.zeros((4, 2)),
        warps=np.tile(np.eye(2), (4, 1, 1)),
    )


def test_from_measurements_keeps_points_with_a_measured_ray() -> None:
    measured = MeasuredRays(
        ok=np.array([True, False, True, True]),
        target_px=np.arange(8.0).reshape(4, 2),
        warps=np.tile(np.eye(2), (4, 1, 1)),
        sigma_px=np.full((4, 2), 0.1),
        status=np.zeros(4, dtype=np.int64),
    )
    found = from_measurements(_tasks(), measured, PointOrigin.FEATURES)
    np.testing.assert_array_equal(found.reference_px, [[7, 8], [1, 2]])  # points 6 and 9
    assert found.ray_point.tolist() == [1, 1, 0]
    assert found.ray_image.tolist() == [2, 0, 2]
    np.testing.assert_array_equal(found.ray_px, [[0, 1], [4, 5], [6, 7]])


def test_pairs_of_groups_tasks_by_stills() -> None:
    pairs = [(reference, target, rows.tolist()) for reference, target, rows in pairs_of(_tasks())]
    assert pairs == [(0, 1, [1]), (1, 0, [2]), (1, 2, [0, 3])]
    assert pairs_of(_tasks().where(np.zeros(4, dtype=bool))) == []
