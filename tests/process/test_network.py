"""From candidates and marks to the adjustment's rows: numbers of stills, held-back coordinates, single marks."""

from dataclasses import replace

import numpy as np
import pytest

from tests.process.made_blocks import (
    FULL,
    Ground,
    block_of,
    gnss_of,
    ground_points,
    observe,
    stations,
    still_names,
    surveyed,
)
from uavkit.core.adjustment import Datum
from uavkit.core.block import Block
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.errors import AdjustmentError
from uavkit.core.points import ControlPoint, ImageMark
from uavkit.process.absolute import fit_similarity
from uavkit.process.approximations import GrowingBlock
from uavkit.process.candidates import Candidates
from uavkit.process.network import (
    MarkedPoints,
    Network,
    adjust_network,
    adjust_what_holds,
    interior_sigmas,
    marked_points,
    network_of,
    updated,
    without_weak_stills,
)
from uavkit.process.options import AdjustmentSection

RNG = np.random.default_rng(11)
PLACES = stations(2, 4, RNG)
GROUND = Ground(3.0)
POINTS = ground_points(GROUND, PLACES, 220, RNG)
SEEN = observe(PLACES, POINTS, FULL, RNG, noise_px=0.2)
MARKS_AT = np.array([[3.0, 1.0], [19.0, 0.0], [11.0, 10.0], [6.0, 6.0], [15.0, 4.0]])
MARKS_AT = np.column_stack([MARKS_AT, GROUND.height_m(*MARKS_AT.T)])
CONTROL = tuple(surveyed(f"P{n}", at, PLACES, FULL, RNG, sigma_m=0.005) for n, at in enumerate(MARKS_AT[:3], start=1))
CHECK = tuple(
    surveyed(f"K{n}", at, PLACES, FULL, RNG, sigma_m=0.002, check=True) for n, at in enumerate(MARKS_AT[3:], start=1)
)
SIGMAS = InteriorSigmas(principal_distance_px=10.0, k1=0.01)


def _candidates() -> Candidates:
    """The first ray of each point is its reference."""
    first = np.unique(SEEN.point, return_index=True)[1]
    number = np.searchsorted(SEEN.point[first], SEEN.point)
    rest = np.setdiff1d(np.arange(len(SEEN.point)), first)
    return Candidates(
        reference_image=SEEN.image[first],
        reference_px=SEEN.xy_px[first],
        origin=np.full(len(first), 2, dtype=np.int8),
        ray_point=number[rest],
        ray_image=SEEN.image[rest],
        ray_px=SEEN.xy_px[rest],
        ray_sigma_px=np.full((len(rest), 2), 0.2),
    )


CANDIDATES = _candidates()


def _block(**changes: object) -> Block:
    block = block_of(len(PLACES), FULL, SIGMAS, control=CONTROL, check=CHECK, gnss=gnss_of(PLACES, RNG, 0.05))
    return replace(block, **changes)  # type: ignore[arg-type]


def _growing(missing: tuple[int, ...] = ()) -> GrowingBlock:
    centres = np.array([p.projection_centre_m for p in PLACES])
    rotations = np.array([p.R_object_from_image for p in PLACES])
    centres[list(missing)], rotations[list(missing)] = np.nan, np.nan
    return GrowingBlock(
        interior=FULL, centres=centres, rotations=rotations, points=np.full((len(CANDIDATES), 3), np.nan), reasons={}
    )


def _network(block: Block, missing: tuple[int, ...] = ()) -> tuple[Network, MarkedPoints]:
    marked = marked_points(block)
    return network_of(_growing(missing), CANDIDATES, marked), marked


def test_marks_become_rays_with_control_first() -> None:
    block = _block()
    stray = replace(
        CONTROL[0], marks=(*CONTROL[0].marks, ImageMark(image="other.JPG", column_px=1, row_px=2, sigma_px=1))
    )
    marked = marked_points(replace(block, control_points=(stray, *CONTROL[1:])))
    assert [p.name for p in marked.points] == ["P1", "P2", "P3", "K1", "K2"]
    assert marked.control == 3
    marks = [mark for point in (*CONTROL, *CHECK) for mark in point.marks]
    assert len(marked.point) == len(marks)  # the mark in a still that is not in the block is skipped
    np.testing.assert_array_equal(marked.xy_px, [[m.column_px, m.row_px] for m in marks])
    assert [still_names(8)[i] for i in marked.image] == [m.image for m in marks]
    np.testing.assert_array_equal(marked.sigma_px, 0.3)


def test_no_marks_at_all() -> None:
    marked = marked_points(_block(control_points=(), check_points=()))
    assert marked.xy_px.shape == (0, 2)
    network = network_of(_growing(), CANDIDATES, marked)
    assert network.marks_from == len(CANDIDATES) == len(network.points)


def test_network_intersects_points_and_marks_near_the_truth() -> None:
    network, _ = _network(_block())
    assert network.marks_from == len(CANDIDATES)
    truth = np.vstack([POINTS[np.unique(SEEN.point)], MARKS_AT])
    rays = np.bincount(network.point, minlength=len(network.points))
    known = np.isfinite(network.points[:, 0])
    assert known[rays >= 2].all()
    assert not known[rays < 2].any()
    error = np.linalg.norm(network.points - truth, axis=1)[known]
    assert np.median(error) < 0.01  # 0.2 px: 1.1 mm across, a few mm in height
    assert error.max() < 0.3


def test_a_blunder_is_left_out_of_the_intersection() -> None:
    rows = np.flatnonzero(np.bincount(CANDIDATES.ray_point)[CANDIDATES.ray_point] >= 4)
    point = CANDIDATES.ray_point[rows[0]]
    xy = CANDIDATES.ray_px.copy()
    xy[rows[0]] += [300.0, 200.0]
    network = network_of(_growing(), replace(CANDIDATES, ray_px=xy), marked_points(_block()))
    truth = POINTS[np.unique(SEEN.point)][point]
    assert np.linalg.norm(network.points[point] - truth) < 0.03


def test_positions_go_to_the_stills_that_are_oriented() -> None:
    """With stills 1 and 4 missing, each position must land on its own still: wrongly mapped ones are off by metres."""
    block = _block()
    network, marked = _network(block, missing=(1, 4))
    adjusted = adjust_network(network, block, marked, AdjustmentSection(), None)
    assert adjusted.images.tolist() == [0, 2, 3, 5, 6, 7]
    assert adjusted.result.gnss_used.shape == (6,)
    assert np.abs(adjusted.result.gnss_residuals_m).max() < 5 * 0.05
    truth = np.array([PLACES[i].projection_centre_m for i in adjusted.images])
    assert np.abs(adjusted.result.projection_centres_m - truth).max() < 0.05
    assert adjusted.rays.image_index.max() == 5
    np.testing.assert_array_equal(adjusted.images[adjusted.rays.image_index], network.image[adjusted.ray_rows])
    np.testing.assert_array_equal(adjusted.points[adjusted.rays.point_index], network.point[adjusted.ray_rows])


def test_without_positions_of_oriented_stills_gnss_takes_no_part() -> None:
    block = _block(gnss=gnss_of(PLACES, RNG, 0.05, rows=np.array([1, 4])))
    network, marked = _network(block, missing=(1, 4))
    adjusted = adjust_network(network, block, marked, AdjustmentSection(), None)
    assert adjusted.result.gnss_used.shape == (0,)
    assert adjusted.result.datum is Datum.CONTROL


def test_gnss_can_be_switched_off() -> None:
    block = _block()
    network, marked = _network(block)
    adjusted = adjust_network(network, block, marked, AdjustmentSection(gnss=False), None)
    assert adjusted.result.gnss_used.shape == (0,)


def test_surveyed_check_coordinates_are_held_back() -> None:
    block = _block()
    network, marked = _network(block)
    first = adjust_network(network, block, marked, AdjustmentSection(), None)
    moved = tuple(replace(p, position_m=(p.position_m[0] + 5.0, p.position_m[1], p.position_m[2] - 9.0)) for p in CHECK)
    other = replace(block, check_points=moved)
    network, marked = _network(other)
    second = adjust_network(network, other, marked, AdjustmentSection(), None)
    np.testing.assert_array_equal(first.result.points_m, second.result.points_m)
    np.testing.assert_array_equal(first.result.projection_centres_m, second.result.projection_centres_m)
    assert first.result.sigma0 == second.result.sigma0
    joint = first.points[first.result.joint_points]
    assert joint[joint >= network.marks_from].tolist() == [network.marks_from + 3, network.marks_from + 4]


def test_joint_covariance_is_asked_for_points_all_over_the_block() -> None:
    block = _block()
    network, marked = _network(block)
    for datum in (None, Datum.FREE_NETWORK):
        adjusted = adjust_network(network, block, marked, AdjustmentSection(), datum)
        rows = adjusted.result.joint_points
        spread = adjusted.result.points_m[rows[adjusted.points[rows] < network.marks_from]]
        every = adjusted.result.points_m[adjusted.points < network.marks_from]
        assert 8 <= len(spread) <= 25
        assert np.all(np.ptp(spread[:, :2], axis=0) > 0.6 * np.ptp(every[:, :2], axis=0))


def test_surveyed_control_coordinates_are_used() -> None:
    block = _block(gnss=None)
    raised = tuple(replace(p, position_m=(p.position_m[0], p.position_m[1], p.position_m[2] + 2.0)) for p in CONTROL)
    other = replace(block, control_points=raised)
    heights = []
    for each in (block, other):
        network, marked = _network(each)
        adjusted = adjust_network(network, each, marked, AdjustmentSection(), None)
        heights.append(adjusted.result.projection_centres_m[:, 2])
    np.testing.assert_allclose(heights[1] - heights[0], 2.0, atol=1e-3)


def _one_mark(point: ControlPoint) -> ControlPoint:
    return replace(point, marks=point.marks[:1])


def test_control_with_one_mark_takes_part_where_coordinates_are_used() -> None:
    extra = _one_mark(surveyed("P9", np.array([9.0, 3.0, GROUND.height_m(9.0, 3.0)]), PLACES, FULL, RNG))
    block = _block(control_points=(*CONTROL, extra))
    network, marked = _network(block)
    row = network.marks_from + 3
    assert np.isnan(network.points[row]).all()  # one ray meets nothing
    network.points[row] = extra.position_m
    adjusted = adjust_network(network, block, marked, AdjustmentSection(), None)
    assert row in adjusted.points
    assert adjusted.result.control_residuals_m.shape == (4, 3)
    free = adjust_network(network, block, marked, AdjustmentSection(), Datum.FREE_NETWORK)
    assert row not in free.points
    assert free.result.control_residuals_m.shape == (0, 3)
    assert free.result.gnss_used.shape == (0,)


def test_self_calibration_is_an_option_and_sigmas_fit_the_size_of_the_stills() -> None:
    block = _block()
    network, marked = _network(block)
    fixed = adjust_network(network, block, marked, AdjustmentSection(self_calibration=False), None)
    assert fixed.result.interior == network.interior
    free = adjust_network(network, block, marked, AdjustmentSection(), None)
    assert free.result.interior.k1 != network.interior.k1
    assert free.result.interior.k2 == network.interior.k2  # its sigma is 0
    half = replace(block, interior=FULL.scaled(2000, 1500))
    assert interior_sigmas(half).principal_distance_px == pytest.approx(5.0)
    assert interior_sigmas(half).k1 == 0.01


def test_update_takes_over_what_was_adjusted_and_forgets_other_points() -> None:
    block = _block()
    network, marked = _network(block, missing=(1,))
    adjusted = adjust_network(network, block, marked, AdjustmentSection(), None)
    after = updated(network, adjusted)
    assert np.isnan(after.centres[1]).all()
    np.testing.assert_array_equal(after.centres[adjusted.images], adjusted.result.projection_centres_m)
    np.testing.assert_array_equal(after.points[adjusted.points], adjusted.result.points_m)
    others = np.setdiff1d(np.arange(len(after.points)), adjusted.points)
    assert np.isnan(after.points[others]).all()
    assert after.interior == adjusted.result.interior


def test_a_still_of_too_few_shared_points_is_left_out_and_named() -> None:
    """Still 2 shares seven points with the others, one less than an adjustment needs: it goes, the others stay."""
    points, stills = 20, 3
    ray_point = np.concatenate([np.arange(points), np.arange(7)])
    ray_image = np.concatenate([np.full(points, 1), np.full(7, 2)])
    candidates = Candidates(
        reference_image=np.zeros(points, dtype=np.int64),
        reference_px=np.zeros((points, 2)),
        origin=np.ones(points, dtype=np.int8),
        ray_point=ray_point,
        ray_image=ray_image,
        ray_px=np.zeros((len(ray_point), 2)),
        ray_sigma_px=np.full((len(ray_point), 2), 0.1),
    )
    growing = GrowingBlock(
        interior=InteriorOrientation(width_px=100, height_px=100, principal_distance_px=100.0, x0_px=49.5, y0_px=49.5),
        centres=np.zeros((stills, 3)),
        rotations=np.tile(np.eye(3), (stills, 1, 1)),
        points=np.zeros((points, 3)),
        reasons={},
    )
    none = np.zeros(0, dtype=np.int64)
    marked = MarkedPoints(
        points=(), control=0, point=none, image=none, xy_px=np.zeros((0, 2)), sigma_px=np.zeros((0, 2))
    )
    left = without_weak_stills(growing, candidates, marked)
    assert left.oriented.tolist() == [True, True, False]
    assert left.reasons == {2: "only 7 of its points were found in other stills too (8 needed)"}


def _spoilt(network: Network, stills: tuple[int, ...], rng: np.random.Generator) -> Network:
    """The network with gross errors, 20 to 200 px in any direction, in all rays of some stills."""
    xy = network.xy_px.copy()
    rows = np.flatnonzero(np.isin(network.image, stills))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(rows))
    xy[rows] += rng.uniform(20.0, 200.0, len(rows))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return replace(network, xy_px=xy)


def test_stills_whose_rays_are_wrong_are_left_out_and_the_others_adjusted() -> None:
    """All rays of the last two stills are wrong: nothing holds these, and the error they were is no more."""
    block = _block()
    network, marked = _network(block)
    network = _spoilt(network, (6, 7), np.random.default_rng(5))
    with pytest.raises(AdjustmentError):
        adjust_network(network, block, marked, AdjustmentSection(), Datum.FREE_NETWORK)
    held = adjust_what_holds(network, block, marked, AdjustmentSection(), Datum.FREE_NETWORK)
    assert held.adjusted.images.tolist() == [0, 1, 2, 3, 4, 5]
    assert sorted(held.reasons) == [6, 7]
    assert all("too few of its points agree" in reason for reason in held.reasons.values())
    truth = np.array([p.projection_centre_m for p in PLACES])[:6]
    centres = held.adjusted.result.projection_centres_m
    assert np.abs(fit_similarity(centres, truth).apply(centres) - truth).max() < 0.03
    assert np.isnan(updated(held.network, held.adjusted).centres[6:]).all()


def test_rays_that_determine_nothing_are_an_error() -> None:
    block = _block()
    network, marked = _network(block)
    network = _spoilt(network, tuple(range(8)), np.random.default_rng(6))
    with pytest.raises(AdjustmentError):
        adjust_what_holds(network, block, marked, AdjustmentSection(), Datum.FREE_NETWORK)
