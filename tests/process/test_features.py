"""Candidates from features: which stills are compared, what counts as one point, how a patch is turned."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.process.made_blocks import SMALL, Ground, MadeStills, carpet, stations, still_of
from uavkit.core.angles import rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array, Indices
from uavkit.core.cache import NoCache
from uavkit.core.camera import InteriorOrientation, ideal_from_pixels
from uavkit.core.collinearity import image_coordinates, object_rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.progress import silent
from uavkit.process.features import (
    EPIPOLAR_TOLERANCE_PX,
    LOWE_RATIO,
    FeatureMatches,
    Features,
    detect_features,
    epipolar_geometry,
    feature_tasks,
    match_descriptors,
    match_features,
    match_guided,
    pairs_to_compare,
)
from uavkit.process.measurement import measure_rays
from uavkit.process.options import CandidateOptions, MeasurementOptions
from uavkit.process.pictures import PictureStore, PyramidStore

OPTIONS = CandidateOptions(feature_width_px=800, features=800)


def in_bytes(unit: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.minimum(np.rint(512.0 * unit), 255).astype(np.uint8)


def _features(xy: Array, rng: np.random.Generator, angle: float = 0.0, size: float = 4.0) -> Features:
    descriptors = np.abs(rng.normal(0, 1, (len(xy), 128))).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1)[:, None]
    return Features(
        xy_px=xy, size_px=np.full(len(xy), size), angle_rad=np.full(len(xy), angle), descriptors=in_bytes(descriptors)
    )


def test_without_positions_few_stills_are_all_compared() -> None:
    assert pairs_to_compare(5, None, 2) == [(i, j) for i in range(5) for j in range(i + 1, 5)]


def test_without_positions_many_stills_are_compared_in_sequence() -> None:
    pairs = pairs_to_compare(60, None, 4)
    assert max(j - i for i, j in pairs) == 4
    assert len(pairs) == 60 * 4 - (1 + 2 + 3 + 4)


def test_with_positions_the_nearest_are_compared() -> None:
    """Two strips flown to and fro: stations above one another are 5 m apart, in sequence up to 11 stills."""
    positions = np.array([[8.0 * n, 0, 15] for n in range(6)] + [[8.0 * n, 5.0, 15] for n in reversed(range(6))])
    pairs = pairs_to_compare(12, positions, 1)
    for n in range(6):
        assert (n, 11 - n) in pairs  # its nearest neighbour, on the other strip
    assert {(i, i + 1) for i in range(11)} <= set(pairs)
    assert (0, 5) not in pairs
    assert all(i < j for i, j in pairs)
    assert pairs == sorted(set(pairs))


def test_stills_of_one_position_are_compared_with_each_other_not_with_themselves() -> None:
    positions = np.array([[0.0, 0, 15], [50.0, 0, 15], [100.0, 0, 15], [150.0, 0, 15], [0.0, 0, 15]])
    pairs = pairs_to_compare(5, positions, 1)
    assert (0, 4) in pairs
    assert all(i < j for i, j in pairs)


def test_a_still_without_position_is_compared_with_all() -> None:
    positions = np.array([[100.0 * n, 0, 15] for n in range(8)])
    positions[3] = np.nan
    pairs = pairs_to_compare(8, positions, 1)
    assert {(min(3, n), max(3, n)) for n in range(8) if n != 3} <= set(pairs)
    assert (0, 7) not in pairs


def _matches(count: int, links: dict[tuple[int, int], list[tuple[int, int]]], features: int = 4) -> FeatureMatches:
    rng = np.random.default_rng(0)
    made = [_features(rng.uniform(0, 700, (features, 2)), rng) for _ in range(count)]
    return FeatureMatches(features=made, pairs=list(links), links=[np.array(rows) for rows in links.values()])


def test_links_are_chained_to_points() -> None:
    matches = _matches(3, {(0, 1): [(0, 1), (2, 2)], (1, 2): [(1, 3)]})
    tasks = feature_tasks(matches, SMALL)
    middle = np.array([399.5, 299.5])
    assert len(tasks) == 3  # one point of three stills, one of two
    for point, members in ((0, [(0, 0), (1, 1), (2, 3)]), (1, [(0, 2), (1, 2)])):
        rows = np.flatnonzero(tasks.point == point)
        where = {image: matches.features[image].xy_px[row] for image, row in members}
        reference = min(where, key=lambda image: float(np.linalg.norm(where[image] - middle)))
        assert set(tasks.reference_image[rows]) == {reference}
        assert set(tasks.target_image[rows]) == set(where) - {reference}
        for row in rows:
            np.testing.assert_array_equal(tasks.reference_px[row], where[reference])
            np.testing.assert_array_equal(tasks.start_px[row], where[int(tasks.target_image[row])])


def test_contradictory_points_are_left_out() -> None:
    """0-0 to 1-0, 1-0 to 2-0, but 2-0 to 0-1: two features of still 0 would be one point."""
    matches = _matches(3, {(0, 1): [(0, 0), (3, 3)], (1, 2): [(0, 0)], (0, 2): [(1, 0)]})
    tasks = feature_tasks(matches, SMALL)
    assert len(tasks) == 1
    np.testing.assert_array_equal(
        np.sort([tasks.reference_px[0, 0], tasks.start_px[0, 0]]),
        np.sort([matches.features[0].xy_px[3, 0], matches.features[1].xy_px[3, 0]]),
    )


def test_no_links_no_tasks() -> None:
    tasks = feature_tasks(FeatureMatches(features=_matches(2, {}).features, pairs=[], links=[]), SMALL)
    assert len(tasks) == 0
    assert tasks.warps.shape == (0, 2, 2)


def _brute_force(first: Features, second: Features, allowed: np.ndarray) -> set[tuple[int, int]]:
    """Mutually most alike among the allowed pairs, standing out from the second best from one side at least."""
    likeness = np.where(allowed, first.unit_descriptors @ second.unit_descriptors.T, -2.0)
    result = set()

    def ratio(values: np.ndarray) -> float:
        best = np.sort(values)[::-1]
        return float(np.sqrt((1 - best[0]) / (1 - best[1])))

    for i in range(likeness.shape[0]):
        j = int(np.argmax(likeness[i]))
        mutual = likeness[i, j] > -2.0 and int(np.argmax(likeness[:, j])) == i
        if mutual and min(ratio(likeness[i]), ratio(likeness[:, j])) < LOWE_RATIO:
            result.add((i, j))
    return result


def _pair_of_sets(rng: np.random.Generator, count: int) -> tuple[Features, Features, Indices, Array]:
    """Features of two stills 5 m apart over rough ground, with like descriptors, some of them confused."""
    here, there = (
        ExteriorOrientation(
            projection_centre_m=np.array([x, 0.0, 15.0]),
            R_object_from_image=rotation_from_omega_phi_kappa(0.02, a, 0.1),
        )
        for x, a in ((0.0, 0.01), (4.0, -0.03))
    )
    points = np.column_stack([rng.uniform(-4, 8, (count, 2)), rng.uniform(-1, 1, count)])
    first = _features(image_coordinates(points, here, SMALL), rng)
    noise = rng.normal(0, 0.02, (count, 128)).astype(np.float32)
    descriptors = np.abs(first.unit_descriptors + noise)
    descriptors[: count // 4] = descriptors[rng.permutation(count // 4)]
    descriptors /= np.linalg.norm(descriptors, axis=1)[:, None]
    second = Features(
        xy_px=image_coordinates(points, there, SMALL), size_px=first.size_px, angle_rad=first.angle_rad,
        descriptors=in_bytes(descriptors),
    )  # fmt: skip
    # x_there^T E x_here = 0 with E = [t]x R in vision axes (y down, z forward)
    flip = np.diag([1.0, -1.0, -1.0])
    R = flip @ there.R_object_from_image.T @ here.R_object_from_image @ flip
    t = flip @ there.R_object_from_image.T @ (here.projection_centre_m - there.projection_centre_m)
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ R
    links = np.column_stack([np.arange(count // 4, count), np.arange(count // 4, count)])
    return first, second, links, essential


@pytest.mark.parametrize("seed", range(3))
def test_guided_matching_is_what_brute_force_finds(seed: int) -> None:
    first, second, links, essential = _pair_of_sets(np.random.default_rng(seed), 60)
    found = match_guided(first, second, links, essential, SMALL)
    source = np.column_stack([first.xy_px[links[:, 0]], np.ones(len(links))])
    affine, *_ = np.linalg.lstsq(source, second.xy_px[links[:, 1]], rcond=None)
    miss = np.abs(source @ affine - second.xy_px[links[:, 1]])
    reach = 2.0 * np.quantile(miss, 0.95, axis=0) + 8.0
    predicted = np.column_stack([first.xy_px, np.ones(60)]) @ affine
    near = (np.abs(second.xy_px[None] - predicted[:, None]) <= reach).all(axis=2)
    ideal = [np.column_stack([ideal_from_pixels(f.xy_px, SMALL), np.ones(60)]) for f in (first, second)]
    lines = ideal[0] @ essential.T
    distance = np.abs(lines @ ideal[1].T) / np.hypot(lines[:, 0], lines[:, 1])[:, None]
    allowed = near & (distance <= EPIPOLAR_TOLERANCE_PX / 537.0)
    assert {tuple(row) for row in found.tolist()} == _brute_force(first, second, allowed)
    right = found[:, 0] == found[:, 1]
    assert right.sum() >= 40  # those whose descriptors are not confused


def test_free_matching_is_brute_force_without_geometry() -> None:
    first, second, _, _ = _pair_of_sets(np.random.default_rng(7), 80)
    found = match_descriptors(first, second)
    assert {tuple(row) for row in found.tolist()} == _brute_force(first, second, np.ones((80, 80), dtype=bool))
    assert match_descriptors(first.strongest(1), second).shape == (0, 2)


def test_epipolar_geometry_tells_right_from_wrong_matches() -> None:
    first, second, _, truth = _pair_of_sets(np.random.default_rng(8), 200)
    xy = second.xy_px.copy()
    xy[:40] += np.random.default_rng(9).uniform(30, 90, (40, 2)) * [[1, -1]]
    essential, agrees = epipolar_geometry(first.xy_px, xy, SMALL)
    assert agrees[40:].mean() > 0.98
    assert agrees[:40].mean() < 0.35
    a, b = essential / np.linalg.norm(essential), truth / np.linalg.norm(truth)
    assert min(np.abs(a - b).max(), np.abs(a + b).max()) < 0.05
    _, none = epipolar_geometry(first.xy_px[:7], xy[:7], SMALL)
    assert not none.any()


def _turned_stills(turn_rad: float, height_m: float) -> tuple[MadeStills, list[ExteriorOrientation]]:
    """Two stills over a plane: the second turned about its axis, and from another height."""
    rng = np.random.default_rng(21)
    ground = Ground(0.0)
    cover = carpet(rng, (-14.0, -14.0), (16.0, 14.0), 15.0 / 537.0)
    places = [
        ExteriorOrientation(projection_centre_m=np.array([0.0, 0, 15.0]), R_object_from_image=np.eye(3)),
        ExteriorOrientation(
            projection_centre_m=np.array([2.0, 0.5, height_m]),
            R_object_from_image=rotation_from_omega_phi_kappa(0.01, -0.02, turn_rad),
        ),
    ]
    return MadeStills({f"{n}": still_of(p, SMALL, ground, cover, rng) for n, p in enumerate(places)}), places


def _transferred(
    xy: Array, source: ExteriorOrientation, target: ExteriorOrientation, camera: InteriorOrientation
) -> Array:
    return image_coordinates(Ground(0.0).under(source, object_rays(xy, source, camera)), target, camera)


@pytest.mark.parametrize("turn_deg,height_m", [(40.0, 15.0), (-110.0, 12.5), (180.0, 15.0)])
def test_features_of_turned_stills_are_matched_and_measured(turn_deg: float, height_m: float) -> None:
    """A wrong sign of the turn or an inverted scale leaves least squares matching without a start."""
    stills, places = _turned_stills(np.radians(turn_deg), height_m)
    store = PictureStore(stills, ("0", "1"))
    matches = match_features(store, [(0, 1)], SMALL, OPTIONS, NoCache(), workers=1, progress=silent)
    tasks = feature_tasks(matches, SMALL)
    assert len(tasks) > 100
    truth = np.array(
        [
            _transferred(xy[None], places[i], places[j], SMALL)[0]
            for xy, i, j in zip(tasks.reference_px, tasks.reference_image, tasks.target_image, strict=True)
        ]
    )
    assert np.mean(np.linalg.norm(tasks.start_px - truth, axis=1) < 2.0) > 0.95
    step = 4.0
    for axis in (0, 1):
        moved = np.array(
            [
                _transferred(xy[None] + step * np.eye(2)[axis], places[i], places[j], SMALL)[0]
                for xy, i, j in zip(tasks.reference_px, tasks.reference_image, tasks.target_image, strict=True)
            ]
        )
        error = np.abs((moved - truth) / step - tasks.warps[:, :, axis])
        assert np.median(error) < 0.06  # a similarity for all, of single features' angles and sizes
    rays = measure_rays(
        PyramidStore(store), tasks, MeasurementOptions(window_px=21), workers=1, progress=silent, stage=""
    )
    assert rays.ok.mean() > 0.8
    error = np.linalg.norm(rays.target_px - truth, axis=1)[rays.ok]
    assert np.median(error) < 0.06
    z = (rays.target_px - truth)[rays.ok] / rays.sigma_px[rays.ok]
    assert 0.3 < 1.4826 * np.median(np.abs(z)) < 3.0  # the pair's error against one ray's sigma: root 2 if all is well


def test_features_lie_where_the_texture_is_whatever_the_reduction() -> None:
    """Blobs at known places: the same features are found at their places in the still's own pixels."""
    picture = np.full((960, 1280), 60.0)
    rng = np.random.default_rng(5)
    truth = np.array([[x, y] for x in range(60, 1260, 80) for y in range(60, 940, 80)]) + rng.uniform(-20, 20, (165, 2))
    row, column = np.indices(picture.shape)
    for x, y in truth:
        part = np.s_[int(y) - 30 : int(y) + 31, int(x) - 30 : int(x) + 31]
        picture[part] += 120 * np.exp(-((column[part] - x) ** 2 + (row[part] - y) ** 2) / (2 * 6.0**2))
    found = detect_features(picture.astype(np.uint8), CandidateOptions(feature_width_px=640, features=1000))
    distance = np.linalg.norm(truth[:, None] - found.xy_px[None], axis=2)
    nearest = found.xy_px[np.argmin(distance, axis=1)] - truth
    near = distance.min(axis=1) < 3.0
    assert near.mean() > 0.95
    # 165 blobs to some tenths of a pixel each: a forgotten half pixel of the reduction would show.
    assert np.abs(np.median(nearest[near], axis=0)).max() < 0.15


def test_a_flat_still_has_no_features() -> None:
    found = detect_features(np.full((600, 800), 90, dtype=np.uint8), OPTIONS)
    assert found.xy_px.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)


def test_detection_is_kept_and_pairs_without_agreement_fall_out() -> None:
    rng = np.random.default_rng(31)
    ground, places = Ground(0.0), stations(1, 2, rng, base_m=4.0, height_m=15.0)
    cover = carpet(rng, (-14.0, -14.0), (20.0, 14.0), 15.0 / 537.0)
    other = carpet(np.random.default_rng(32), (-14.0, -14.0), (20.0, 14.0), 15.0 / 537.0)
    stills = MadeStills({f"{n}": still_of(p, SMALL, ground, cover, rng) for n, p in enumerate(places)})
    stills.pictures["2"] = still_of(places[0], SMALL, ground, other, rng)

    class Kept(NoCache):
        kept: dict[str, dict[str, np.ndarray]] = {}  # noqa: RUF012
        computed = 0

        def arrays(self, step, key, compute):  # type: ignore[no-untyped-def]
            if key not in self.kept:
                Kept.computed += 1
                self.kept[key] = compute()
            return self.kept[key]

    results = []
    for workers in (1, 2):
        store = PictureStore(stills, ("0", "1", "2"))
        results.append(
            match_features(store, [(0, 1), (1, 2)], SMALL, OPTIONS, Kept(), workers=workers, progress=silent)
        )
    assert Kept.computed == 3
    assert [r.pairs for r in results] == [[(0, 1)], [(0, 1)]]
    np.testing.assert_array_equal(results[0].links[0], results[1].links[0])
