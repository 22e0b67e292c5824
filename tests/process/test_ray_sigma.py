"""Variance components find the factors by which the stated sigmas of classes of rays were made wrong."""

import numpy as np

from uavkit.process.ray_sigma import calibrate_sigmas

ANGLES = np.radians([6.0, 18.0, 40.0])
SIGMAS = np.array([0.05, 0.1, 0.2])


def _rays(rng: np.random.Generator, each: int, factors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Residuals of rays whose true sigma is factors[texture, angle] times the stated one, at known redundancy."""
    texture = np.repeat(np.arange(3), 3 * each)
    angle = np.tile(np.repeat(np.arange(3), each), 3)
    sigma = np.column_stack([SIGMAS[texture], SIGMAS[texture]]) * rng.uniform(0.9, 1.1, (9 * each, 1))
    redundancy = rng.uniform(0.3, 0.9, sigma.shape)
    true = sigma * factors[texture, angle][:, None]
    residuals = rng.normal(0, 1, sigma.shape) * true * np.sqrt(redundancy)
    return residuals, sigma, redundancy, ANGLES[angle], texture, angle


def test_factors_of_all_classes_are_recovered() -> None:
    rng = np.random.default_rng(4)
    truth = np.array([[1.0, 1.5, 3.0], [0.8, 1.2, 2.0], [0.5, 1.0, 4.0]])
    residuals, sigma, redundancy, angles, texture, angle = _rays(rng, 1000, truth)
    found = calibrate_sigmas(residuals, sigma, redundancy, angles, np.ones(len(sigma), dtype=bool))
    relative = found.factor / truth[texture, angle]
    # Redundancy of a class: 2000 x 0.6; relative sigma of a factor 1 / sqrt(2 x 1200) = 0.02. Here 4 of them.
    assert np.abs(relative - 1.0).max() < 0.08
    assert len(found.classes) == 9
    assert sum(count for _, count, _ in found.classes) == 9000
    by_name = {name: factor for name, _, factor in found.classes}
    assert by_name["strong texture, < 12 deg"] / truth[0, 0] < 1.08
    assert by_name["weak texture, > 25 deg"] > 3.6
    assert 2.7 < by_name["strong texture, > 25 deg"] < 3.3


def test_rejected_rays_do_not_count_but_get_a_factor() -> None:
    rng = np.random.default_rng(5)
    residuals, sigma, redundancy, angles, *_ = _rays(rng, 500, np.full((3, 3), 2.0))
    used = rng.random(len(sigma)) > 0.1
    residuals[~used] = 1e3
    redundancy[~used] = np.nan
    found = calibrate_sigmas(residuals, sigma, redundancy, angles, used)
    assert np.abs(found.factor / 2.0 - 1.0).max() < 0.12  # 4 / sqrt(2 x 540)
    assert len(found.factor) == len(sigma)


def test_small_classes_share_one_factor() -> None:
    rng = np.random.default_rng(6)
    residuals, sigma, redundancy, angles, *_ = _rays(rng, 100, np.full((3, 3), 1.7))
    found = calibrate_sigmas(residuals, sigma, redundancy, angles, np.ones(len(sigma), dtype=bool))
    assert len(np.unique(found.factor)) == 1
    assert abs(found.factor[0] / 1.7 - 1.0) < 4 / np.sqrt(2 * 1080)


def test_nothing_to_judge_by_leaves_the_sigmas_alone() -> None:
    found = calibrate_sigmas(
        np.zeros((3, 2)), np.full((3, 2), 0.1), np.full((3, 2), np.nan), np.zeros(3), np.zeros(3, dtype=bool)
    )
    np.testing.assert_array_equal(found.factor, 1.0)
    assert found.classes == ()
