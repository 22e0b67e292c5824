"""Root mean square errors and tests, against numbers worked by hand and against simulated truth."""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.result import OrientedBlock, PointDifference
from uavkit.report.measures import (
    accuracy,
    chi_square_bounds,
    doming_test,
    gnss_stations,
    interior_correlation,
    prediction_test,
    radial_profile,
    rays_of_points,
    strip_ties,
)


def point(name: str, dx: float, dy: float, dz: float, gsd: float = 0.01) -> PointDifference:
    return PointDifference(name=name, difference_m=(dx, dy, dz), sigma_m=(0.01, 0.02, 0.03), rays=4, gsd_m=gsd)


def test_rmse_by_hand() -> None:
    # dx^2 + dy^2: 25 and 169 (mm^2), mean 97; dz^2: 4 and 196, mean 100.
    measured = accuracy([point("a", 0.003, 0.004, 0.002), point("b", -0.012, 0.005, -0.014)])
    assert measured.rmse_xy_m == pytest.approx(1e-3 * np.sqrt(97.0))
    assert measured.rmse_z_m == pytest.approx(0.010)
    assert measured.rmse_z_gsd == pytest.approx(1.0)
    assert measured.rmse_xy_gsd == pytest.approx(np.sqrt(97.0) / 10.0)
    assert (measured.points, measured.left_out) == (2, 0)


def test_undetermined_points_are_counted_not_used() -> None:
    measured = accuracy([point("a", 0.003, 0.004, 0.002), point("b", np.nan, np.nan, np.nan)])
    assert measured.rmse_xy_m == pytest.approx(0.005)
    assert (measured.points, measured.left_out) == (1, 1)


def test_no_points_give_nan() -> None:
    assert accuracy([]).points == 0
    assert np.isnan(accuracy([]).rmse_xy_m)


@pytest.mark.parametrize(
    ("degrees", "low", "high"), [(3, 0.216, 9.348), (10, 3.247, 20.483), (33, 19.047, 50.725), (100, 74.222, 129.561)]
)
def test_chi_square_bounds_equal_the_printed_table(degrees: int, low: float, high: float) -> None:
    found = chi_square_bounds(degrees)
    assert found[0] == pytest.approx(low, abs=0.04)  # the approximation's own error at 3 degrees
    assert found[1] == pytest.approx(high, abs=0.06)


def test_prediction_test_by_hand() -> None:
    # Normalised: 1, 1, 1 and -2, 0, 0: sum of squares 7 over 6 coordinates.
    points = [point("a", 0.01, 0.02, 0.03), point("b", -0.02, 0.0, 0.0)]
    covariance = np.diag(np.tile(np.square([0.01, 0.02, 0.03]), 2))
    assert prediction_test(points, covariance).factor == pytest.approx(np.sqrt(7.0 / 6.0))
    assert prediction_test(points, np.zeros((0, 0))).factor == pytest.approx(np.sqrt(7.0 / 6.0))


def test_prediction_test_uses_the_joint_covariance() -> None:
    # Two points shifted alike: improbable if independent, one single event if fully correlated.
    points = [point("a", 0.02, 0.0, 0.0), point("b", 0.02, 0.0, 0.0)]
    covariance = np.diag(np.tile(np.square([0.01, 0.02, 0.03]), 2))
    covariance[0, 3] = covariance[3, 0] = 0.9999 * 0.01**2
    assert prediction_test(points, covariance).factor == pytest.approx(np.sqrt(4.0 / 6.0), rel=1e-3)


def test_prediction_test_holds_at_the_stated_rate() -> None:
    rng = np.random.default_rng(5)
    mix = rng.normal(size=(9, 9))
    covariance = 1e-4 * (mix @ mix.T + np.eye(9))
    inside = 0
    for _ in range(400):
        d = rng.multivariate_normal(np.zeros(9), covariance).reshape(3, 3)
        test = prediction_test([point(str(row), *d[row]) for row in range(3)], covariance)
        inside += test.low <= test.factor <= test.high
    assert 0.95 * 400 - 3.5 * np.sqrt(400 * 0.95 * 0.05) < inside <= 0.95 * 400 + 3.5 * np.sqrt(400 * 0.95 * 0.05)


def test_doming_finds_a_bow_with_its_sigma() -> None:
    rng = np.random.default_rng(2)
    distance = np.linspace(0.0, 50.0, 12)
    normalised = []
    for _ in range(300):
        z = 0.1 - 0.03 * (distance / 40.0) ** 2 + rng.normal(0, 0.01, 12)
        test = doming_test(distance, z, np.full(12, 0.01), 40.0)
        normalised.append((test.bow_m + 0.03) / test.sigma_m)
    assert abs(np.mean(normalised)) < 3.5 / np.sqrt(300)
    assert np.std(normalised) == pytest.approx(1.0, abs=3.5 / np.sqrt(600))


def test_doming_is_not_claimed_from_three_points() -> None:
    test = doming_test(np.array([0.0, 20.0, 40.0]), np.zeros(3), np.ones(3), 40.0)
    assert np.isnan(test.bow_m)


def test_radial_profile_finds_a_distortion_and_its_sign(result: OrientedBlock) -> None:
    interior = result.adjustment.interior
    arm = result.rays.xy_px - [interior.x0_px, interior.y0_px]
    outwards = 2e-4 * arm  # grows to 0.5 px at a radius of 2500 px
    bent = replace(result, adjustment=replace(result.adjustment, ray_residuals_px=outwards))
    profile = radial_profile(bent)
    np.testing.assert_allclose(profile.mean_px, 2e-4 * profile.radius_px, rtol=1e-9)
    assert int(profile.rays.sum()) <= int(result.adjustment.ray_used.sum())


def test_rays_of_points_leave_out_the_rejected(result: OrientedBlock) -> None:
    rejected = np.flatnonzero(~result.adjustment.ray_used)[0]
    row = result.rays.point_index[rejected]
    mine = result.rays.point_index == row
    assert rays_of_points(result)[row] == np.sum(mine & result.adjustment.ray_used) < np.sum(mine)


def test_strip_ties_count_common_points(result: OrientedBlock) -> None:
    numbers, ties = strip_ties(result)
    used = result.adjustment.ray_used
    strip, points = result.strips[result.rays.image_index[used]], result.rays.point_index[used]
    common = set(points[strip == 0]) & set(points[strip == 1])
    assert numbers.tolist() == [0, 1]
    assert ties[0, 1] == ties[1, 0] == len(common)
    assert ties[0, 0] == len(set(points[strip == 0]))


def test_correlation_of_the_free_parameters(result: OrientedBlock) -> None:
    names, correlation = interior_correlation(result)
    assert names == ("principal_distance_px", "x0_px", "y0_px", "k1", "k2", "k3")
    assert correlation[3, 4] == pytest.approx(-0.9)
    np.testing.assert_allclose(np.diag(correlation), 1.0)


def test_gnss_rows_are_told_apart_only_where_they_fit(result: OrientedBlock) -> None:
    assert gnss_stations(result) == result.images
    fewer = replace(
        result.adjustment,
        gnss_used=result.adjustment.gnss_used[:3],
        gnss_residuals_m=result.adjustment.gnss_residuals_m[:3],
    )
    assert gnss_stations(replace(result, adjustment=fewer)) == ("fix 1", "fix 2", "fix 3")
