"""Least squares matching against textures whose every transformation is known exactly."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from tests.process.textures import picture, wave_texture
from uavkit.core.errors import InputError
from uavkit.process.least_squares_matching import (
    MatchingOptions,
    MatchingResult,
    MatchingStatus,
    RaySigmaOptions,
    match_forward_backward,
    match_least_squares,
    ray_sigma,
    texture_angle_classes,
)

SHAPE = (420, 520)
MIDDLE = np.array([259.5, 209.5])


@dataclass(frozen=True)
class Pair:
    reference: np.ndarray
    target: np.ndarray
    reference_px: np.ndarray
    truth_px: np.ndarray
    matrix: np.ndarray
    """target_from_reference."""


def jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)


def make_pair(
    seed: int = 3,
    *,
    matrix: np.ndarray | None = None,
    gain: float = 1.2,
    noise: float = 2.5,
    quality: int = 92,
    contrast: float = 40.0,
    points: int = 300,
    shift: tuple[float, float] = (1.63, -2.28),
    shortest_px: float = 4.0,
) -> Pair:
    rng = np.random.default_rng(seed)
    texture = wave_texture(rng, shortest_px=shortest_px)
    L = np.eye(2) if matrix is None else matrix
    inverse = np.linalg.inv(L)
    texture_from_target = np.column_stack([inverse, MIDDLE - inverse @ (MIDDLE + shift)])
    reference = picture(texture, SHAPE, gain=contrast, noise=noise, rng=rng)
    target = picture(texture, SHAPE, texture_from_target, gain=contrast * gain, offset=115, noise=noise, rng=rng)
    if quality:
        reference, target = jpeg(reference, quality), jpeg(target, quality)
    at = rng.uniform(80, np.array(SHAPE[::-1]) - 80, (points, 2))
    return Pair(reference, target, at, (at - MIDDLE) @ L.T + MIDDLE + shift, L)


def turned(angle_deg: float, scale: float = 1.0, shear: float = 0.0) -> np.ndarray:
    a = np.radians(angle_deg)
    return scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ np.array([[1, shear], [0, 1]])


def match(
    pair: Pair, start_error_px: float = 1.0, options: MatchingOptions | None = None, workers: int = 1
) -> MatchingResult:
    rng = np.random.default_rng(9)
    start = pair.truth_px + rng.uniform(-start_error_px, start_error_px, pair.truth_px.shape)
    warps = np.tile(pair.matrix @ np.array([[0.98, 0.02], [-0.02, 1.02]]), (len(start), 1, 1))
    return match_least_squares(pair.reference, pair.target, pair.reference_px, start, warps, options, workers=workers)


@pytest.mark.parametrize(
    "matrix",
    [
        turned(0),
        turned(5),  # resampled in two passes of wide vectors
        turned(12.5),  # of which the second does half of each vector again
        turned(20),  # pixel by pixel
        turned(10, 1.1, 0.1),
        turned(-10, 0.9),
        turned(180),
        turned(174),
        turned(93, 1.0, 0.25),
    ],
    ids=["shift", "turned", "more", "far", "rotated", "smaller", "upside down", "and turned", "quarter turn"],
)
def test_position_is_true_to_a_tenth_of_a_pixel(matrix: np.ndarray) -> None:
    pair = make_pair(matrix=matrix)
    result = match(pair)
    error = (result.target_px - pair.truth_px)[result.ok]
    assert result.ok.mean() > 0.97
    # noise 2.5 and JPEG: the formal precision is 0.012 px, some three times that is allowed for all together
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.035
    assert np.abs(error).max() < 0.1
    assert np.abs(result.warps[result.ok] - matrix).max() < 0.05
    assert np.median(result.gain[result.ok]) == pytest.approx(1.2, abs=0.03)
    assert np.median(result.offset[result.ok]) == pytest.approx(115, abs=6)


@pytest.mark.parametrize("shortest_px,most_px", [(4.0, 0.012), (6.5, 0.005)])
def test_interpolation_does_not_pull_to_whole_pixels(shortest_px: float, most_px: float) -> None:
    # The phase of Catmull and Rom's interpolation at a quarter of a pixel, weighted by the gradients of these waves, is
    # off by 0.011 px where they are as short as 4 px, and falls with the square of their frequency.
    biases = []
    for fraction in np.arange(0, 1, 0.125):
        pair = make_pair(noise=0.0, quality=0, gain=1.0, shift=(2 + fraction, 1 - fraction), shortest_px=shortest_px)
        whole = replace(pair, reference_px=np.round(pair.reference_px))
        whole = replace(whole, truth_px=whole.reference_px + [2 + fraction, 1 - fraction])
        result = match(whole)
        biases.append((result.target_px - whole.truth_px)[result.ok].mean(axis=0))
    assert np.abs(biases).max() < most_px


def test_further_iterations_would_hardly_move_a_point() -> None:
    pair = make_pair(matrix=turned(8), noise=4.0, contrast=25.0)
    soon, late = match(pair), match(pair, options=MatchingOptions(convergence_px=0.0005, most_iterations=40))
    both = soon.ok & late.ok
    assert both.mean() > 0.95
    # stated: what remains is below convergence_px; its rate is an estimate, so twice that for all but a few points
    moved = np.hypot(*(soon.target_px - late.target_px)[both].T)
    assert np.quantile(moved, 0.95) < 2 * MatchingOptions().convergence_px


@pytest.mark.parametrize("window_px", [7, 15, 21, 33, 49])
def test_windows_of_all_sizes_find_the_same_place(window_px: int) -> None:
    pair = make_pair(matrix=turned(6), noise=1.0, points=60)
    result = match(pair, 0.3, MatchingOptions(window_px=window_px))
    error = np.abs(result.target_px - pair.truth_px).max(axis=1)
    assert (result.ok & (error < 1.5 / window_px)).mean() > 0.9


def test_convergence_from_two_pixels_away() -> None:
    pair = make_pair(matrix=turned(5))
    result = match(pair, start_error_px=1.5)  # up to 2.1 px along the diagonal
    error = np.abs(result.target_px - pair.truth_px).max(axis=1)
    assert (result.ok & (error < 0.15)).mean() > 0.97
    assert (error[result.ok] < 0.15).mean() > 0.99


def test_formal_covariance_is_near_the_truth_for_white_noise() -> None:
    errors, formal = [], []
    for seed in range(4):
        pair = make_pair(seed, matrix=turned(7, 1.05), noise=4.0, quality=0)
        result = match(pair, 0.5)
        errors.append((result.target_px - pair.truth_px)[result.ok])
        formal.append(result.covariance_px2[result.ok])
    e, C = np.concatenate(errors), np.concatenate(formal)
    z2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e) / 2
    # interpolation smooths the noise that the residuals show: the formal sigma is somewhat too small
    assert 1.0 < np.sqrt(z2.mean()) < 1.6


def test_formal_covariance_grows_with_noise_and_knows_directions() -> None:
    calm, rough = match(make_pair(noise=1.0, quality=0)), match(make_pair(noise=4.0, quality=0))
    ratio = np.sqrt(np.trace(rough.covariance_px2, axis1=1, axis2=2) / np.trace(calm.covariance_px2, axis1=1, axis2=2))
    assert np.nanmedian(ratio) == pytest.approx(4.0, rel=0.25)
    rows, columns = np.indices((120, 120), dtype=float)
    rng = np.random.default_rng(1)
    stripes = 128 + 50 * np.cos(columns / 3) + 8 * np.cos(rows / 3) + rng.normal(0, 2, rows.shape)
    image = np.round(stripes).astype(np.uint8)
    at = np.array([[60.0, 60.0]])
    one = match_least_squares(image, image, at, at, np.eye(2)[None])
    again = match_least_squares(image.T.copy(), image.T.copy(), at, at, np.eye(2)[None])
    noisy = np.round(stripes + rng.normal(0, 2, rows.shape)).astype(np.uint8)
    pair = match_least_squares(image, noisy, at, at, np.eye(2)[None])
    assert one.ok[0]
    assert again.ok[0]
    assert pair.covariance_px2[0, 1, 1] > 10 * pair.covariance_px2[0, 0, 0]


def test_covariance_turns_with_the_target() -> None:
    upright, quarter = match(make_pair(gain=1.0)), match(make_pair(matrix=turned(90), gain=1.0))
    both = upright.ok & quarter.ok
    ratio = quarter.covariance_px2[both][:, 1, 1] / upright.covariance_px2[both][:, 0, 0]
    assert np.median(ratio) == pytest.approx(1.0, rel=0.15)
    correlated = np.corrcoef(quarter.covariance_px2[both][:, 0, 1], upright.covariance_px2[both][:, 0, 1])[0, 1]
    assert correlated < -0.9  # xy becomes -yx


def test_results_are_the_same_bits_with_any_number_of_workers() -> None:
    pair = make_pair(points=700)
    one, two, three = (match(pair, workers=workers) for workers in (1, 2, 3))
    for other in (two, three):
        assert np.array_equal(one.target_px, other.target_px, equal_nan=True)
        assert np.array_equal(one.covariance_px2, other.covariance_px2, equal_nan=True)
        assert np.array_equal(one.status, other.status)


def test_a_point_does_not_depend_on_its_company() -> None:
    pair = make_pair(points=40)
    together = match(pair)
    for row in (0, 17, 39):
        rng = np.random.default_rng(9)
        start = (pair.truth_px + rng.uniform(-1, 1, pair.truth_px.shape))[row : row + 1]
        warps = (pair.matrix @ np.array([[0.98, 0.02], [-0.02, 1.02]]))[None]
        alone = match_least_squares(pair.reference, pair.target, pair.reference_px[row : row + 1], start, warps)
        assert np.array_equal(alone.target_px[0], together.target_px[row])


def status_of(reference: np.ndarray, target: np.ndarray, at: tuple[float, float], start: tuple[float, float]) -> int:
    result = match_least_squares(reference, target, np.array([at]), np.array([start]), np.eye(2)[None])
    return int(result.status[0])


def test_failures_are_told_apart() -> None:
    pair = make_pair(matrix=turned(0), gain=1.0)
    flat = np.full(SHAPE, 90, np.uint8)
    other = make_pair(77).reference
    edge = np.repeat(np.clip((np.arange(SHAPE[1]) - 200.0) * 20, 20, 220).astype(np.uint8)[None], SHAPE[0], axis=0)
    assert status_of(pair.reference, pair.target, (5, 200), (50, 200)) == MatchingStatus.LEFT_IMAGE
    assert status_of(pair.reference, pair.target, (200, 200), (515, 200)) == MatchingStatus.LEFT_IMAGE
    assert status_of(pair.reference, pair.target, (200, 200), (-3000, 200)) == MatchingStatus.LEFT_IMAGE
    assert status_of(pair.reference, pair.target, (200, 200), (np.nan, 200)) == MatchingStatus.LEFT_IMAGE
    assert status_of(flat, pair.target, (200, 200), (200, 200)) == MatchingStatus.LOW_TEXTURE
    assert status_of(edge, edge, (205, 200), (205, 200)) == MatchingStatus.LOW_TEXTURE
    assert status_of(pair.reference, flat, (200, 200), (200, 200)) != MatchingStatus.OK
    wrong = match_least_squares(
        pair.reference, other, pair.reference_px, pair.reference_px, np.tile(np.eye(2), (300, 1, 1))
    )
    assert wrong.ok.mean() < 0.01
    assert {MatchingStatus.DIVERGED, MatchingStatus.LOW_CORRELATION} <= set(wrong.status)


def test_too_large_a_deformation_is_refused() -> None:
    pair = make_pair(matrix=turned(0, 1.15), gain=1.0)
    unit = np.tile(np.eye(2), (300, 1, 1))
    strict = MatchingOptions(most_affine_change=0.1)
    result = match_least_squares(pair.reference, pair.target, pair.reference_px, pair.truth_px, unit, strict)
    assert not result.ok.any()
    assert (result.status == MatchingStatus.AFFINE_TOO_LARGE).mean() > 0.5


def test_options_and_shapes_are_checked() -> None:
    with pytest.raises(InputError, match="odd"):
        MatchingOptions(window_px=30)
    image = np.zeros((50, 50), np.uint8)
    with pytest.raises(InputError, match="need points"):
        match_least_squares(image, image, np.zeros((3, 2)), np.zeros((2, 2)), np.zeros((3, 2, 2)))
    with pytest.raises(InputError, match="8-bit"):
        match_least_squares(image.astype(float), image, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2, 2)))  # type: ignore[arg-type]


def test_no_points_give_no_rows() -> None:
    image = np.zeros((50, 50), np.uint8)
    result = match_least_squares(image, image, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert result.target_px.shape == (0, 2)


def test_the_return_betrays_what_moved() -> None:
    pair = make_pair(matrix=turned(4), points=400)
    rng = np.random.default_rng(1)
    starts = pair.truth_px + rng.uniform(-1, 1, pair.truth_px.shape)
    warps = np.tile(pair.matrix, (400, 1, 1))
    both = match_forward_backward(pair.reference, pair.target, pair.reference_px, starts, warps)
    assert both.forward.ok.mean() > 0.97
    assert np.abs(both.return_miss_px[both.forward.ok]).max() <= 0.1
    # a start 8 px off ends, if it ends at all, somewhere else: such points must not come through
    astray = match_forward_backward(pair.reference, pair.target, pair.reference_px, starts + [8.0, 0.0], warps)
    wrong = np.hypot(*(astray.forward.target_px - pair.truth_px).T) > 1
    assert not (astray.forward.ok & wrong).any()
    strict = MatchingOptions(most_return_miss_px=0.002)
    refused = match_forward_backward(pair.reference, pair.target, pair.reference_px, starts, warps, strict)
    assert (refused.forward.status == MatchingStatus.NOT_RETURNED).mean() > 0.5


@pytest.mark.parametrize("noise,quality,contrast", [(1.0, 95, 40.0), (3.0, 92, 40.0), (3.0, 75, 15.0)])
def test_ray_sigma_covers_the_true_error(noise: float, quality: int, contrast: float) -> None:
    pair = make_pair(matrix=turned(10, 1.05), noise=noise, quality=quality, contrast=contrast)
    warps = np.tile(pair.matrix, (300, 1, 1))
    both = match_forward_backward(pair.reference, pair.target, pair.reference_px, pair.truth_px, warps)
    ok = both.forward.ok
    plane = RaySigmaOptions(surface_px=0.0)
    sigma_pair = ray_sigma(both.forward, both.return_miss_px, options=plane)[ok] * np.sqrt(2)
    z = (both.forward.target_px - pair.truth_px)[ok] / sigma_pair
    # JPEG of quality 75 correlates the noise of a weak texture, which formal sigmas take as white.
    assert 0.7 < np.sqrt((z**2).mean()) < (1.3 if quality > 90 else 1.5)
    assert np.isnan(ray_sigma(both.forward, both.return_miss_px)[~ok]).all()
    assert (ray_sigma(both.forward, both.return_miss_px)[ok] > RaySigmaOptions().surface_px / np.sqrt(2)).all()


def test_ray_sigma_takes_the_miss_of_its_class() -> None:
    pair = make_pair(points=200)
    result = match(pair)
    rng = np.random.default_rng(2)
    classes = np.where(result.ok, np.arange(200) % 2, -1)
    classes[:5] = 7  # too few to speak for themselves
    miss = rng.normal(0, np.where(classes == 1, 0.2, 0.02)[:, None], (200, 2))
    sigma = ray_sigma(result, miss, classes, RaySigmaOptions(surface_px=0.0, formal_scale=0.0, miss_scale=1.0))
    assert np.nanmedian(sigma[classes == 1]) == pytest.approx(0.2 / np.sqrt(2), rel=0.2)
    assert np.nanmedian(sigma[classes == 0]) == pytest.approx(0.02 / np.sqrt(2), rel=0.2)
    assert np.nanmedian(sigma[classes == 7]) == pytest.approx(0.015 / np.sqrt(2))


def test_classes_part_texture_and_deformation() -> None:
    upright, warped = match(make_pair()), match(make_pair(matrix=turned(20)))
    assert set(texture_angle_classes(upright)[upright.ok]) <= {0, 1, 2}
    assert set(texture_angle_classes(warped)[warped.ok]) == {3, 4, 5}
