"""Approximate orientation of simulated blocks: complete, true up to a similarity, and honest about what is not tied."""

import numpy as np
import pytest

from tests.process.made_blocks import FULL, Ground, Observed, ground_points, observe, stations
from uavkit.core.angles import vector_from_rotation
from uavkit.core.arrays import Array
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates
from uavkit.core.errors import AdjustmentError
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.progress import silent
from uavkit.process.absolute import fit_similarity
from uavkit.process.approximations import (
    GrowingBlock,
    RayTable,
    common_points,
    intersect_linearly,
    orient_approximately,
    ray_table,
)

NOMINAL = InteriorOrientation(width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=1999.5, y0_px=1499.5)
SIGMAS = InteriorSigmas(principal_distance_px=40.0, x0_px=30.0, y0_px=30.0, k1=0.1, k2=0.1, k3=0.05, p1=2e-3, p2=2e-3)


def reprojection(block: GrowingBlock, rays: RayTable) -> Array:
    """Return observed minus projected image points (k, 2), NaN where still or point is not known."""
    residuals = np.full((len(rays.point), 2), np.nan)
    for image in np.flatnonzero(block.oriented).tolist():
        rows = np.flatnonzero(rays.image == image)
        exterior = ExteriorOrientation(
            projection_centre_m=block.centres[image], R_object_from_image=block.rotations[image]
        )
        residuals[rows] = rays.xy_px[rows] - image_coordinates(block.points[rays.point[rows]], exterior, block.interior)
    return residuals


def _oriented(seen: Observed, images: int, points: int) -> GrowingBlock:
    table = ray_table(seen.point, seen.image, seen.xy_px, NOMINAL)
    return orient_approximately(table, (images, points), NOMINAL, SIGMAS, silent)


def _differences(block: GrowingBlock, places: list[ExteriorOrientation], rows: list[int]) -> tuple[Array, Array]:
    """Errors of centres (n, 3) in metres and of rotations (n, 3) in radians, after the best similarity."""
    truth = np.array([places[row].projection_centre_m for row in rows])
    similarity = fit_similarity(block.centres[rows], truth)
    turns = [
        vector_from_rotation(places[row].R_object_from_image.T @ similarity.R_object_from_model @ block.rotations[row])
        for row in rows
    ]
    return similarity.apply(block.centres[rows]) - truth, np.array(turns)


def _check_block(block: GrowingBlock, places: list[ExteriorOrientation], points: Array, seen: Observed) -> None:
    assert block.oriented.all()
    assert block.reasons == {}
    centres, turns = _differences(block, places, list(range(len(places))))
    # 0.5 px on the ground is 3 mm; a free block of some hundred rays for each still with self-calibration holds its
    # stations to some centimetres, an uncalibrated k1 = -0.05 bends the block by decimetres.
    assert np.sqrt(np.mean(centres**2)) < 0.05
    assert np.abs(turns).max() < 0.01
    assert abs(block.interior.k1 - FULL.k1) < 0.01
    residuals = reprojection(block, ray_table(seen.point, seen.image, seen.xy_px, NOMINAL))
    good = np.isfinite(residuals[:, 0]) & ~seen.blunder
    assert good.sum() > 0.9 * (~seen.blunder).sum()
    assert np.median(np.abs(residuals[good])) < 1.0  # 0.34 px from the noise; points still hold some blunders
    known = block.known
    similarity = fit_similarity(block.centres, np.array([p.projection_centre_m for p in places]))
    error = np.linalg.norm(similarity.apply(block.points[known]) - points[known], axis=1)
    assert np.median(error) < 0.06
    assert np.quantile(error, 0.9) < 0.5


@pytest.mark.parametrize(
    "per_strip,count,blunders",
    [(5, 600, 0.05), pytest.param(11, 1800, 0.05, marks=pytest.mark.slow)],
    ids=["15 stills", "33 stills"],
)
def test_a_block_of_three_strips_flown_to_and_fro(per_strip: int, count: int, blunders: float) -> None:
    rng = np.random.default_rng(1)
    places = stations(3, per_strip, rng)
    points = ground_points(Ground(4.0), places, count, rng)
    seen = observe(places, points, FULL, rng, blunders=blunders)
    _check_block(_oriented(seen, len(places), len(points)), places, points, seen)


def _sees_only(seen: Observed, keep: Array) -> Observed:
    return Observed(seen.point[keep], seen.image[keep], seen.xy_px[keep], seen.blunder[keep])


def test_a_part_that_does_not_hang_together_is_named() -> None:
    """The larger part is oriented, though a pair of the smaller one has more points in common."""
    rng = np.random.default_rng(2)
    places = stations(1, 6, rng)
    points = ground_points(Ground(4.0), places, 500, rng)
    seen = observe(places, points, FULL, rng)
    apart = (seen.point % 2 == 0) == (seen.image < 4)  # stills 4 and 5 see other points than 0 to 3
    few = (seen.image == 4) & np.isin(seen.point, np.flatnonzero(np.arange(500) % 2 == 0))
    shared = np.unique(seen.point[few & np.isin(seen.point, seen.point[(seen.image == 2)])])[:9]
    seen = _sees_only(seen, apart | (few & np.isin(seen.point, shared)))
    block = _oriented(seen, 7, 500)
    assert np.flatnonzero(block.oriented).tolist() == [0, 1, 2, 3]
    assert "only 9 of its points" in block.reasons[4]
    assert "12 needed" in block.reasons[4]
    assert "only 0 of its points" in block.reasons[5]
    assert "no point of it" in block.reasons[6]
    assert sorted(block.reasons) == [4, 5, 6]


def test_a_still_with_wrong_points_is_named() -> None:
    rng = np.random.default_rng(3)
    places = stations(1, 4, rng)
    points = ground_points(Ground(4.0), places, 400, rng)
    seen = observe(places, points, FULL, rng)
    wrong = seen.image == 3
    xy = seen.xy_px.copy()
    xy[wrong] = rng.permutation(xy[wrong])
    block = _oriented(Observed(seen.point, seen.image, xy, seen.blunder), 4, 400)
    assert np.flatnonzero(block.oriented).tolist() == [0, 1, 2]
    assert "do not agree on one orientation" in block.reasons[3]
    centres, _ = _differences(block, places, [0, 1, 2])
    assert np.abs(centres).max() < 0.3


def test_two_stills_without_overlap_are_refused() -> None:
    rng = np.random.default_rng(4)
    places = stations(1, 2, rng, base_m=60.0)
    points = ground_points(Ground(2.0), places, 600, rng)
    with pytest.raises(AdjustmentError, match="do not overlap"):
        _oriented(observe(places, points, FULL, rng), 2, 600)


def test_stills_from_one_place_are_refused() -> None:
    rng = np.random.default_rng(5)
    place = stations(1, 1, rng)[0]
    points = ground_points(Ground(4.0), [place], 300, rng)
    with pytest.raises(AdjustmentError, match="taken from one place"):
        _oriented(observe([place, place, place], points, FULL, rng, noise_px=0.2), 3, 300)


def test_linear_intersection_of_exact_rays_is_exact() -> None:
    rng = np.random.default_rng(6)
    truth = rng.uniform(-10, 10, (5, 3))
    origins = rng.uniform(-10, 10, (20, 3)) + [0, 0, 40.0]
    point = np.repeat(np.arange(5), 4)
    directions = truth[point] - origins
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    directions[::3] *= -1.0  # the sense of a ray does not matter to the nearest point
    found, angle = intersect_linearly(point, origins, directions, 7)
    np.testing.assert_allclose(found[:5], truth, atol=1e-8)
    assert np.isnan(found[5:]).all()
    assert (angle[:5] > 0.05).all()


@pytest.mark.parametrize("degrees", [0.5, 2.0, 8.0])
def test_the_angle_of_two_rays_is_told(degrees: float) -> None:
    half = np.radians(degrees) / 2
    directions = np.array([[np.sin(half), 0, -np.cos(half)], [-np.sin(half), 0, -np.cos(half)]])
    _, angle = intersect_linearly(np.zeros(2, np.int64), -10 * directions, directions, 1)
    # The mean projector of two unit vectors an angle a apart has the eigenvalue sin^2(a / 2): twice its root is a.
    assert angle[0] == pytest.approx(np.radians(degrees), rel=0.01)


def test_parallel_rays_do_not_meet() -> None:
    down = np.tile([0.0, 0.0, -1.0], (2, 1))
    points, _ = intersect_linearly(np.zeros(2, np.int64), np.array([[0, 0, 1.0], [1.0, 0, 1.0]]), down, 1)
    assert np.isnan(points).all()


def test_common_points_of_pairs() -> None:
    table = ray_table(np.array([0, 0, 1, 1, 1, 2]), np.array([0, 1, 0, 1, 3, 3]), np.full((6, 2), 1500.0), NOMINAL)
    counts = common_points(table, 5)
    assert counts.shape == (5, 5)
    assert (counts[0, 1], counts[1, 0], counts[0, 3], counts[1, 3], counts[2, 3]) == (2, 2, 1, 1, 0)
    assert np.trace(counts) == 0
    nothing = ray_table(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), NOMINAL)
    np.testing.assert_array_equal(common_points(nothing, 3), np.zeros((3, 3)))


def test_directions_look_along_minus_z_with_y_up() -> None:
    table = ray_table(
        np.zeros(1, np.int64), np.zeros(1, np.int64), np.array([[1999.5 + 268.4, 1499.5 + 268.4]]), NOMINAL
    )
    np.testing.assert_allclose(table.directions[0], np.array([0.1, -0.1, -1.0]) / np.sqrt(1.02), atol=1e-12)
