"""No two points closer than the window allows, the better one kept; repeated rays would make sigmas too small."""

import numpy as np
import pytest

from uavkit.process.candidates import Candidates, empty
from uavkit.process.thinning import points_apart


def _candidates(
    references: list[tuple[int, float, float]], rays: list[tuple[int, int, float, float, float]]
) -> Candidates:
    """Points (image, column, row of the reference) and rays (point, image, column, row, sigma)."""
    at, seen = np.array(references, dtype=np.float64).reshape(-1, 3), np.array(rays, dtype=np.float64).reshape(-1, 5)
    return Candidates(
        reference_image=at[:, 0].astype(np.int64),
        reference_px=at[:, 1:],
        origin=np.full(len(at), 2, dtype=np.int8),
        ray_point=seen[:, 0].astype(np.int64),
        ray_image=seen[:, 1].astype(np.int64),
        ray_px=seen[:, 2:4],
        ray_sigma_px=np.repeat(seen[:, 4:], 2, axis=1),
    )


def _random(points: int, rng: np.random.Generator) -> Candidates:
    """Points of 2 to 5 rays in 6 stills of 500 x 400 px, some of them found twice."""
    ground = rng.uniform(0, [500, 400], (points, 2))
    again = rng.random(points) < 0.3
    ground[again] = ground[rng.integers(0, points, int(again.sum()))] + rng.normal(0, 0.3, (int(again.sum()), 2))
    stills = [rng.choice(6, rng.integers(2, 6), replace=False).tolist() for _ in range(points)]
    references = [(images[0], *xy) for images, xy in zip(stills, ground.tolist(), strict=True)]
    rays = [
        (number, image, ground[number, 0] + 20.0 * image, ground[number, 1], rng.uniform(0.02, 0.05))
        for number, images in enumerate(stills)
        for image in images[1:]
    ]
    return _candidates([(i, x + 20.0 * i, y) for i, x, y in references], rays)


def _least_distance(candidates: Candidates, keep: np.ndarray) -> np.ndarray:
    """Distances (p, p) of the points of a set to those kept, the least over all stills that see both."""
    point, image, xy, _ = candidates.all_rays()
    m = len(candidates)
    least = np.full((m, m), np.inf)
    for number in range(6):
        rows = np.flatnonzero(image == number)
        apart = np.linalg.norm(xy[rows][:, None] - xy[rows][None], axis=2)
        block = np.ix_(point[rows], point[rows])
        least[block] = np.minimum(least[block], apart)
    np.fill_diagonal(least, np.inf)
    return least[:, keep]


def test_of_a_point_found_twice_the_one_with_more_rays_stays() -> None:
    references = [(0, 100.0, 100.0), (0, 100.2, 100.0), (0, 300.0, 100.0)]
    rays = [(0, 1, 50.0, 90.0, 0.02), (1, 1, 50.2, 90.0, 0.03), (1, 2, 10.0, 80.0, 0.03), (2, 1, 250.0, 90.0, 0.02)]
    np.testing.assert_array_equal(points_apart(_candidates(references, rays), 5.0), [False, True, True])


def test_with_equal_rays_the_smaller_sigma_stays() -> None:
    references = [(0, 100.0, 100.0), (0, 103.0, 100.0)]
    rays = [(0, 1, 50.0, 90.0, 0.04), (1, 1, 53.0, 90.0, 0.02)]
    np.testing.assert_array_equal(points_apart(_candidates(references, rays), 5.0), [False, True])
    np.testing.assert_array_equal(points_apart(_candidates(references, rays), 2.0), [True, True])


def test_points_of_different_references_conflict_where_a_still_sees_both() -> None:
    """A track that broke: the same ground with its reference in still 0, and again in still 1."""
    references = [(0, 100.0, 100.0), (1, 51.0, 90.0)]
    rays = [(0, 1, 50.0, 90.0, 0.02), (0, 2, 10.0, 80.0, 0.02), (1, 2, 300.0, 80.0, 0.02)]
    np.testing.assert_array_equal(points_apart(_candidates(references, rays), 5.0), [True, False])


@pytest.mark.parametrize("distance", [3.0, 15.0, 40.0])
def test_kept_points_are_apart_and_every_other_is_near_a_better_one(distance: float) -> None:
    candidates = _random(400, np.random.default_rng(8))
    keep = points_apart(candidates, distance)
    least = _least_distance(candidates, keep)
    assert least[keep].min() > distance
    count = np.bincount(candidates.ray_point, minlength=len(candidates))
    beaten = (least <= distance) & (count[keep][None, :] >= count[:, None])
    assert beaten[~keep].any(axis=1).all()
    assert 0 < keep.sum() < len(candidates)


def test_points_without_rays_and_empty_sets() -> None:
    lonely = _candidates([(0, 1.0, 1.0), (0, 200.0, 1.0)], [(1, 1, 5.0, 5.0, 0.02)])
    np.testing.assert_array_equal(points_apart(lonely, 5.0), [False, True])
    assert points_apart(empty(), 5.0).shape == (0,)


def test_repeated_rays_make_a_mean_look_better_than_it_is() -> None:
    """Why: z of a mean over rays, some measured twice, against that over the points kept; the latter is standard."""
    rng = np.random.default_rng(9)
    single = [(0, 30.0 * (n % 15), 30.0 * (n // 15)) for n in range(150)]
    twice = single + [(0, x + 0.3, y) for _, x, y in single[:75] for _ in range(2)]
    rays = [(number, 1, x + 7.0, y, 0.02) for number, (_, x, y) in enumerate(twice)]
    keep = points_apart(_candidates(twice, rays), 15.0)
    assert keep.sum() == 150
    errors = rng.normal(0, 0.02, (2000, 150))
    errors = np.concatenate([errors, np.repeat(errors[:, :75], 2, axis=1)], axis=1)
    z_all = errors.mean(axis=1) / (0.02 / np.sqrt(len(twice)))
    z_kept = errors[:, keep].mean(axis=1) / (0.02 / np.sqrt(keep.sum()))
    assert z_all.std() > 1.2
    assert z_kept.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * 2000))
