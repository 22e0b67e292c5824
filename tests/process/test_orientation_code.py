"""Orientation codes against their definition, evaluated without tricks."""

from math import erf, sqrt

import numpy as np
import pytest

from tests.process.textures import picture, wave_texture
from uavkit.core.errors import InputError
from uavkit.process.kernels.code_matching import equal_slopes
from uavkit.process.orientation_code import (
    Dissimilarity,
    MatchPlan,
    code_costs,
    coding_threshold,
    gradient_noise,
    match_codes,
    match_codes_at,
    orientation_codes,
    packed_codes,
    richness,
    sector_tangents,
    select_points,
)


def textured(seed: int = 1, shape: tuple[int, int] = (160, 200), noise: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return picture(wave_texture(rng), shape, noise=noise, rng=rng)


def sobel(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    g = image.astype(np.int64)
    smooth_rows = g[:-2] + 2 * g[1:-1] + g[2:]
    smooth_columns = g[:, :-2] + 2 * g[:, 1:-1] + g[:, 2:]
    return smooth_rows[:, 2:] - smooth_rows[:, :-2], smooth_columns[2:] - smooth_columns[:-2]


@pytest.mark.parametrize("count", [4, 8, 16, 32])
def test_codes_follow_their_definition(count: int) -> None:
    image = textured()
    codes = orientation_codes(image, codes=count, threshold=40)
    dx, dy = sobel(image)
    sectors = np.arctan2(dy, dx) % (2 * np.pi) * count / (2 * np.pi)
    expected = np.where(np.abs(dx) + np.abs(dy) >= 40, np.floor(sectors).astype(int) % count, count)
    clear = np.abs(sectors - np.round(sectors)) > 0.01  # sector limits are small fractions: off by 0.06 degrees at most
    inner = codes[1:-1, 1:-1]
    assert np.array_equal(inner[clear], expected[clear])
    assert set(np.unique(inner)) == set(range(count + 1))
    assert (codes[0] == count).all()
    assert (codes[:, -1] == count).all()


@pytest.mark.parametrize("code", range(16))
def test_a_slope_has_the_code_of_its_direction(code: int) -> None:
    rows, columns = np.indices((40, 40), dtype=float)
    angle = (code + 0.5) * np.pi / 8
    slope = 128 + 3.0 * (np.cos(angle) * (columns - 20) + np.sin(angle) * (rows - 20))  # rows count downwards
    inner = orientation_codes(np.round(slope).astype(np.uint8), threshold=8)[2:-2, 2:-2]
    assert (inner == code).mean() > 0.9


def test_sector_limits_are_close_to_their_angles() -> None:
    for count in (8, 16, 32, 64):
        fractions = sector_tangents(count)
        angles = np.arctan2(fractions[:, 0], fractions[:, 1])
        assert np.abs(angles - 2 * np.pi * np.arange(1, count // 4) / count).max() < np.radians(0.1)
    with pytest.raises(InputError, match="power of two"):
        sector_tangents(12)


def test_codes_are_blind_to_gain_and_offset() -> None:
    texture = wave_texture(np.random.default_rng(4))
    dark = picture(texture, (160, 200), gain=20.0, offset=60.0)
    bright = picture(texture, (160, 200), gain=40.0, offset=130.0)
    a, b = orientation_codes(dark, threshold=25), orientation_codes(bright, threshold=50)
    both = (a < 16) & (b < 16)
    apart = np.minimum((a - b) % 16, (b - a) % 16)[both]
    assert both.mean() > 0.7
    assert (apart == 0).mean() > 0.85  # rounding to whole grey values turns weak gradients a little
    assert (apart <= 1).mean() > 0.995


@pytest.mark.parametrize("sigma", [1.0, 3.0, 6.0])
def test_noise_is_estimated_under_texture(sigma: float) -> None:
    rng = np.random.default_rng(2)
    texture = wave_texture(rng, shortest_px=12.0)
    noisy = picture(texture, (480, 640), gain=25.0, noise=sigma, rng=rng)
    # rounding adds 1/12 grey value squared; the mask lets a little of the texture through
    assert gradient_noise(noisy) == pytest.approx(np.hypot(sigma, 0.29), rel=0.12)
    assert coding_threshold(noisy) >= 8 * sigma * 0.9


def test_noise_of_a_flat_picture_is_zero() -> None:
    assert gradient_noise(np.full((50, 60), 77, np.uint8)) == 0.0


def test_the_threshold_stands_at_its_place_above_the_noise() -> None:
    noise = np.random.default_rng(5).normal(128, 4, (400, 400)).round().astype(np.uint8)
    # Sobel's gradients have noise sqrt(12) sigma; P(|x| + |y| > t) of two standard normal numbers is 1 - erf(t / 2)^2
    expected = 1 - erf(8 / sqrt(12) / 2) ** 2
    assert (orientation_codes(noise) < 16).mean() == pytest.approx(expected, abs=0.03)


def test_richness_is_the_entropy_of_the_window() -> None:
    codes = orientation_codes(textured(), threshold=60)
    window, floor, share = 15, 0.5, 0.3
    result = richness(codes, window, floor, share)
    rng = np.random.default_rng(0)
    checked_zero = checked_rich = 0
    for row, column in rng.integers(7, (160 - 7, 200 - 7), (300, 2)):
        patch = codes[row - 7 : row + 8, column - 7 : column + 8]
        counts = np.bincount(patch.ravel(), minlength=17)[:16]
        expected = 0.0
        if counts.sum() >= share * window**2:
            P = counts[counts > 0] / counts.sum()
            expected = max(0.0, (-(P * np.log2(P)).sum() - floor * 4) / (4 - floor * 4))
        assert result[row, column] == pytest.approx(expected, abs=1e-4)
        checked_zero += expected == 0
        checked_rich += expected > 0.5
    assert checked_rich > 20
    assert (result[:7] == 0).all()


def test_richness_prefers_corners_to_edges_and_noise_floor() -> None:
    image = np.full((80, 160), 60, np.uint8)
    image[:, 40:] = 180  # a straight edge
    image[20:60, 100:140] = 30  # a square: four corners
    result = richness(orientation_codes(image, threshold=30), 15, 0.2, 0.05)
    assert result[40, 40] == 0
    assert result[20, 100] > 0


def test_selected_points_are_spread_and_allowed() -> None:
    rich = richness(orientation_codes(textured(3, (240, 320))), 15, 0.4, 0.2)
    mask = np.ones(rich.shape, bool)
    mask[:, 160:200] = False
    points = select_points(rich, 40, 3, 20, mask)
    assert len(points) > 60
    columns, rows = points.astype(int).T
    assert columns.min() >= 20
    assert rows.max() < 220
    assert mask[rows, columns].all()
    cells = np.unique(np.column_stack([columns // 40, rows // 40]), axis=0, return_counts=True)[1]
    assert cells.max() <= 3
    distance = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(points))
    assert distance.min() > 10
    assert np.array_equal(points, select_points(rich, 40, 3, 20, mask))


def test_selected_points_are_the_richest_of_their_cell() -> None:
    rich = np.zeros((40, 40), np.float32)
    rich[12, 7], rich[25, 30], rich[13, 8] = 0.5, 0.9, 0.4
    assert select_points(rich, 40, 2, 5).tolist() == [[30, 25], [7, 12]]


def test_costs_are_those_of_the_paper() -> None:
    costs = code_costs(Dissimilarity.PAPER)
    assert (costs[0, 1], costs[0, 15], costs[0, 8], costs[3, 12]) == (1, 1, 8, 7)
    assert (costs[16, 3], costs[3, 16], costs[16, 16]) == (4, 4, 4)
    assert code_costs(Dissimilarity.BOTH_UNCODED_EQUAL)[16, 16] == 0


def test_flat_matches_flat_only_in_the_variant() -> None:
    flat = np.full((9, 9), 16, np.uint8)
    assert match_codes(flat, np.full((12, 12), 16, np.uint8)).dissimilarity == 4
    assert match_codes(flat, np.full((12, 12), 16, np.uint8), Dissimilarity.BOTH_UNCODED_EQUAL).dissimilarity == 0


@pytest.mark.parametrize("variant", list(Dissimilarity))
@pytest.mark.parametrize(("window", "radius"), [(9, 8), (15, 5), (21, 3), (25, 7), (31, 4)])
def test_fast_matching_equals_the_reference(variant: Dissimilarity, window: int, radius: int) -> None:
    reference, search = textured(7, noise=6.0), textured(8, noise=6.0)  # different textures: any placement may win
    rng = np.random.default_rng(0)
    points = rng.integers(40, (160, 120), (40, 2)).astype(float)
    half = window // 2
    points[:5, 0] = 199 - half - radius - 3  # the search ends with the picture
    plan = MatchPlan(
        reference_px=points,
        predicted_px=points + [3.0, -2.0],
        reference_from_target=np.tile(np.eye(2), (40, 1, 1)),
        radii_px=np.full(40, radius),
    )
    many = match_codes_at(reference, packed_codes(search, 60), plan, threshold=60, window_px=window, variant=variant)
    a, b = orientation_codes(reference, threshold=60), orientation_codes(search, threshold=60)
    for i, (column, row) in enumerate(points.astype(int)):
        template = a[row - half : row + half + 1, column - half : column + half + 1]
        left, top, side = column + 3 - radius - half, row - 2 - radius - half, window + 2 * radius
        one = match_codes(template, b[top : top + side, left : left + side], variant)
        assert many.dissimilarity[i] == pytest.approx(one.dissimilarity, abs=1e-9)
        assert many.points_px[i] - [left + half, top + half] == pytest.approx(one.column_row_px, abs=1e-9)
        assert many.ambiguity[i] == pytest.approx(one.dissimilarity / one.second_best, abs=1e-6)
        assert many.on_rim[i] == one.on_rim


@pytest.mark.parametrize("window", [20, 33])
def test_windows_that_the_kernel_cannot_hold_are_refused(window: int) -> None:
    plan = MatchPlan(
        reference_px=np.array([[80.0, 80.0]]),
        predicted_px=np.array([[80.0, 80.0]]),
        reference_from_target=np.eye(2)[None],
        radii_px=np.array([3]),
    )
    with pytest.raises(InputError, match="window_px must be odd and at most 31"):
        match_codes_at(textured(), packed_codes(textured()), plan, threshold=30, window_px=window)


def test_equal_slopes_find_the_point_of_a_v() -> None:
    for truth in np.linspace(-0.5, 0.5, 11):
        before, middle, after = (1.0 + 0.7 * abs(x - truth) for x in (-1, 0, 1))
        assert equal_slopes(before, middle, after) == pytest.approx(truth, abs=1e-12)


@pytest.mark.parametrize("turn_deg", [0.0, 25.0, 180.0])
def test_matching_is_sub_pixel_for_warped_templates(turn_deg: float) -> None:
    rng = np.random.default_rng(6)
    texture = wave_texture(rng)
    reference = picture(texture, (200, 200), noise=2.0, rng=rng)
    a = np.radians(turn_deg)
    L = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    middle, shift = np.array([99.5, 99.5]), np.array([1.37, -0.71])
    inverse = np.linalg.inv(L)
    target = picture(
        texture, (200, 200), np.column_stack([inverse, middle - inverse @ (middle + shift)]), noise=2.0, rng=rng
    )
    points = rng.uniform(60, 140, (100, 2))
    truth = (points - middle) @ L.T + middle + shift
    plan = MatchPlan(
        reference_px=points,
        predicted_px=truth + rng.uniform(-2, 2, points.shape),
        reference_from_target=np.tile(inverse, (100, 1, 1)),
        radii_px=np.full(100, 4),
    )
    found = match_codes_at(reference, packed_codes(target), plan, threshold=coding_threshold(reference))
    error = found.points_px - truth
    assert np.nanmax(np.abs(error)) < 0.6
    assert np.sqrt(np.nanmean(error**2)) < 0.15
    assert np.abs(np.nanmean(error, axis=0)).max() < 0.05


def test_points_without_room_are_not_matched() -> None:
    image = textured()
    points = np.array([[3.0, 50.0], [198.0, 50.0], [100.0, 80.0], [np.nan, 5.0]])
    plan = MatchPlan(
        reference_px=points,
        predicted_px=points,
        reference_from_target=np.tile(np.eye(2), (4, 1, 1)),
        radii_px=np.array([3, 3, 3, 3]),
    )
    found = match_codes_at(image, packed_codes(image), plan, threshold=30)
    assert np.isnan(found.points_px[[0, 1, 3]]).all()
    assert found.points_px[2] == pytest.approx([100.0, 80.0], abs=0.2)
    assert found.dissimilarity[2] < 0.5
