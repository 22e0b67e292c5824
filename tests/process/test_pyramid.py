"""Descent through the pyramid, on a texture whose transformation is known."""

import numpy as np
import pytest

from tests.process.textures import picture, wave_texture
from uavkit.core.errors import InputError
from uavkit.process.pyramid import (
    PyramidOptions,
    build_pyramid,
    full_from_level,
    level_from_full,
    refine_through_pyramid,
)

SHAPE = (700, 900)
MIDDLE = np.array([449.5, 349.5])


def test_levels_are_half_pixels_apart() -> None:
    assert level_from_full(np.array([[0.5, 2.5]]), 1) == pytest.approx(np.array([[0.0, 1.0]]))
    assert level_from_full(np.array([[3.5, 11.5]]), 3) == pytest.approx(np.array([[0.0, 1.0]]))
    points = np.random.default_rng(0).uniform(0, 500, (20, 2))
    assert full_from_level(level_from_full(points, 3), 3) == pytest.approx(points)


def test_the_pictures_obey_the_formula_of_the_levels() -> None:
    rows, columns = np.indices((256, 320), dtype=float)
    x0, y0 = 150.3, 121.8
    blob = 200 * np.exp(-((columns - x0) ** 2 + (rows - y0) ** 2) / (2 * 16.0**2))
    pyramid = build_pyramid(np.round(blob).astype(np.uint8))
    for level, grey in enumerate(pyramid.grey):
        r, c = np.indices(grey.shape)
        weight = grey.astype(float)
        centroid = np.array([[(c * weight).sum(), (r * weight).sum()]]) / weight.sum()
        assert full_from_level(centroid, level) == pytest.approx(np.array([[x0, y0]]), abs=0.1)


def scene(turn_deg: float, seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    texture = wave_texture(rng, shortest_px=4.0, longest_px=150.0)
    a = np.radians(turn_deg)
    L = 1.05 * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    inverse, shift = np.linalg.inv(L), np.array([23.4, -31.7])
    reference = picture(texture, SHAPE, noise=2.5, rng=rng)
    target = picture(
        texture, SHAPE, np.column_stack([inverse, MIDDLE - inverse @ (MIDDLE + shift)]), gain=28, noise=2.5, rng=rng
    )
    points = rng.uniform(200, np.array(SHAPE[::-1]) - 200, (250, 2))
    return reference, target, points, (points - MIDDLE) @ L.T + MIDDLE + shift, L


@pytest.mark.parametrize("turn_deg", [0.0, 12.0, 180.0])
def test_a_video_pixel_is_brought_down_to_a_still_pixel(turn_deg: float) -> None:
    reference, target, points, truth, L = scene(turn_deg)
    rng = np.random.default_rng(1)
    a, r = rng.uniform(0, 2 * np.pi, 250), rng.uniform(8, 14, 250)
    predicted = truth + np.column_stack([r * np.cos(a), r * np.sin(a)])
    warps = np.tile(L @ np.array([[0.97, 0.03], [-0.03, 1.03]]), (250, 1, 1))
    refined = refine_through_pyramid(build_pyramid(reference), build_pyramid(target), points, predicted, warps)
    error = np.hypot(*(refined.target_px - truth).T)[refined.ok]
    assert refined.ok.mean() > 0.9
    assert np.quantile(error, 0.95) < 0.5
    assert (error < 1.5).mean() > 0.99
    assert (refined.dissimilarity[refined.ok] < 2.9).all()


def test_an_unrelated_still_is_refused() -> None:
    reference, _, points, truth, L = scene(0.0)
    _, other, *_ = scene(0.0, seed=6)
    warps = np.tile(L, (250, 1, 1))
    refined = refine_through_pyramid(build_pyramid(reference), build_pyramid(other), points, truth, warps)
    assert refined.ok.mean() < 0.02


def test_a_wrong_warp_is_not_matched() -> None:
    reference, target, points, truth, L = scene(90.0)
    unit = np.tile(np.eye(2), (250, 1, 1))  # the patches are not turned
    refined = refine_through_pyramid(build_pyramid(reference), build_pyramid(target), points, truth, unit)
    assert refined.ok.mean() < 0.05
    assert L.shape == (2, 2)


def test_pyramids_must_fit_each_other() -> None:
    image = picture(wave_texture(np.random.default_rng(0)), (300, 300))
    points, warps = np.full((1, 2), 150.0), np.eye(2)[None]
    with pytest.raises(InputError, match="levels"):
        refine_through_pyramid(
            build_pyramid(image, 3), build_pyramid(image, 4), points, points, warps, PyramidOptions()
        )
    with pytest.raises(InputError, match="larger"):
        build_pyramid(image[:100, :100])
