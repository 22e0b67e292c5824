"""Several interior orientations in one block: each image its own, or cameras that share the images."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_blocks import INTERIOR_SIGMAS, TRUE_INTERIOR, Plan, SimulatedBlock, simulate

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates
from uavkit.core.orientation import ExteriorOrientation
from uavkit.process.bundle import adjust_block

PLAN = Plan(strips=2, images=6, points=300, length_m=40.0, width_m=26.0)
PLAIN = AdjustmentOptions(robust=False)
OTHER = replace(TRUE_INTERIOR, principal_distance_px=2500.0, x0_px=1990.0, k1=0.01)


def _retaken(block: SimulatedBlock, cameras: tuple[InteriorOrientation, ...], index: np.ndarray) -> AdjustmentInput:
    """Return the block as if each image had been taken with a camera of its own, noise of 0.3 px."""
    given, rng = block.observations, np.random.default_rng(9)
    xy = np.empty_like(given.rays.xy_px)
    for i, (centre, rotation) in enumerate(zip(block.centres_m, block.rotations, strict=True)):
        rows = given.rays.image_index == i
        exterior = ExteriorOrientation(projection_centre_m=centre, R_object_from_image=rotation)
        points = block.points_m[given.rays.point_index[rows]]
        xy[rows] = image_coordinates(points, exterior, cameras[index[i]])
    return replace(given, rays=replace(given.rays, xy_px=xy + rng.normal(0, 0.3, xy.shape)))


def _with(given: AdjustmentInput, interiors: tuple[InteriorOrientation, ...], index: np.ndarray) -> AdjustmentInput:
    return replace(given, interior=interiors[0], interiors=interiors, interior_index=index)


def _errors(result: AdjustmentResult, truth: tuple[InteriorOrientation, ...]) -> list[float]:
    """Return e' Q^-1 e over its degrees of freedom of each interior orientation."""
    free = np.flatnonzero(np.diag(result.interior_covariances[0]) > 0)
    values = []
    for interior, covariance, true in zip(result.interiors, result.interior_covariances, truth, strict=True):
        error = (interior.parameters() - true.parameters())[free]
        values.append(float(error @ np.linalg.solve(covariance[np.ix_(free, free)], error)) / len(free))
    return values


def test_one_interior_orientation_may_be_given_either_way() -> None:
    block = simulate(np.random.default_rng(1), PLAN)
    one = adjust_block(replace(block.observations, interior_prior=None), PLAIN)
    listed = _with(block.observations, (block.observations.interior,), np.zeros(12, dtype=np.int64))
    other = adjust_block(listed, PLAIN)
    np.testing.assert_array_equal(one.points_m, other.points_m)
    np.testing.assert_array_equal(one.interior_covariance, other.interior_covariances[0])


def test_two_cameras_in_one_block() -> None:
    block, index = simulate(np.random.default_rng(2), PLAN), np.arange(12) % 2
    truth = (TRUE_INTERIOR, OTHER)
    given = _with(_retaken(block, truth, index), (TRUE_INTERIOR, replace(OTHER, principal_distance_px=2510.0)), index)
    result = adjust_block(replace(given, interior_sigmas=replace(INTERIOR_SIGMAS, k3=0.0)), PLAIN)
    assert result.sigma0 == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * result.redundancy))
    assert max(_errors(result, truth)) < 3.0  # chi-square over 7 degrees of freedom
    assert abs(result.interiors[1].principal_distance_px - 2500.0) < 5.0


def test_each_image_its_own_interior_orientation() -> None:
    block, index = simulate(np.random.default_rng(3), PLAN), np.arange(12)
    rng = np.random.default_rng(4)
    truth = tuple(
        replace(TRUE_INTERIOR, principal_distance_px=2684.0 + change) for change in rng.normal(0.0, 10.0, len(index))
    )
    sigmas = InteriorSigmas(principal_distance_px=10.0)
    given = _with(_retaken(block, truth, index), (TRUE_INTERIOR,) * 12, index)
    result = adjust_block(replace(given, interior_sigmas=sigmas), PLAIN)
    assert result.sigma0 == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * result.redundancy))
    assert 0.2 < np.mean(_errors(result, truth)) < 2.3  # chi-square over 12 degrees of freedom
    assert np.all(result.interior_covariances[:, 0, 0] < 0.5 * 10.0**2)


def test_shared_in_an_order_of_its_own() -> None:
    """Image i may have interior orientation 11 - i: nothing depends on the order but the names."""
    block, index = simulate(np.random.default_rng(5), PLAN), np.arange(12)
    interiors = tuple(replace(TRUE_INTERIOR, principal_distance_px=2684.0 + 3.0 * k) for k in range(12))
    sigmas = InteriorSigmas(principal_distance_px=10.0)
    given = replace(_retaken(block, interiors, index), interior_sigmas=sigmas)
    straight = adjust_block(_with(given, interiors, index), PLAIN)
    turned = adjust_block(_with(given, interiors[::-1], index[::-1].copy()), PLAIN)
    np.testing.assert_allclose(turned.points_m, straight.points_m, atol=1e-9)
    np.testing.assert_allclose(turned.interior_covariances[::-1], straight.interior_covariances, rtol=1e-9)


def test_an_index_without_interiors_is_refused() -> None:
    block = simulate(np.random.default_rng(1), PLAN)
    with pytest.raises(ValueError, match="belong together"):
        replace(block.observations, interior_index=np.zeros(12, dtype=np.int64))
    with pytest.raises(ValueError, match="each of 2"):
        _with(block.observations, (TRUE_INTERIOR, OTHER), np.zeros(12, dtype=np.int64))
