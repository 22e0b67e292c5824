"""The bundle block adjustment against simulated truth."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from bundle_blocks import (
    INTERIOR_SIGMAS,
    Plan,
    SimulatedBlock,
    simulate,
    with_wrong_fixes,
    with_wrong_rays,
)

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.angles import vector_from_rotation
from uavkit.core.errors import AdjustmentError
from uavkit.process import bundle_system
from uavkit.process.bundle import adjust_block

SMALL = Plan(strips=2, images=5, points=150, length_m=40.0, width_m=26.0)
# Without control the block hangs on its GNSS alone: 1 m over 28 m x 12 m would tilt it beyond what is linear.
SMALL_GNSS = replace(SMALL, control=0, gnss_sigma_m=0.03)
PLAIN = AdjustmentOptions(robust=False)
ROBUST = AdjustmentOptions()


def _runs(plan: Plan, options: AdjustmentOptions, number: int) -> Iterator[tuple[SimulatedBlock, AdjustmentResult]]:
    for seed in range(number):
        block = simulate(np.random.default_rng(1000 + seed), plan)
        yield block, adjust_block(block.observations, options, joint_points=block.check)


def _square(error: np.ndarray, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _squares(block: SimulatedBlock, result: AdjustmentResult) -> dict[str, float]:
    """Return e' Q^-1 e of each kind of result, over its degrees of freedom."""
    free = INTERIOR_SIGMAS.values() > 0
    interior = (result.interior.parameters() - block.interior.parameters())[free]
    points = result.points_m - block.points_m
    exterior = [
        np.concatenate([
            result.projection_centres_m[i] - block.centres_m[i],
            vector_from_rotation(block.rotations[i].T @ result.R_object_from_image[i]),
        ])
        for i in range(len(block.centres_m))
    ]  # fmt: skip
    return {
        "point": float(np.mean([_square(points[p], result.point_covariances_m2[p]) for p in block.check])) / 3.0,
        "joint": _square(points[block.check].ravel(), result.joint_covariance_m2) / (3.0 * len(block.check)),
        "interior": _square(interior, result.interior_covariance[np.ix_(free, free)]) / np.sum(free),
        "exterior": float(np.mean([_square(e, q) for e, q in zip(exterior, result.exterior_covariances, strict=True)]))
        / 6.0,
        "shift": _square((result.gnss_shift_m - block.shift_m)[0], result.gnss_shift_covariance_m2[0]) / 3.0,
    }


def _check_statistics(plan: Plan, options: AdjustmentOptions, number: int) -> None:
    squares: dict[str, list[float]] = {}
    variances, redundancies = [], []
    for block, result in _runs(plan, options, number):
        for name, value in _squares(block, result).items():
            squares.setdefault(name, []).append(value)
        variances.append(result.sigma0**2)
        redundancies.append(result.redundancy)
    # The mean over so many blocks of a chi-square value over its f degrees of freedom scatters by sqrt(2 / (f number));
    # points and orientations of one block hang together: they are counted as if there were one of each.
    freedom = {"point": 3, "joint": 24, "interior": 8, "exterior": 6, "shift": 3}
    for name, values in squares.items():
        assert abs(np.mean(values) - 1.0) < 3.5 * np.sqrt(2.0 / (freedom[name] * number)), (name, np.mean(values))
    assert abs(np.mean(variances) - 1.0) < 3.5 * np.sqrt(2.0 / (np.mean(redundancies) * number))


@pytest.mark.parametrize("plan", [SMALL, SMALL_GNSS], ids=["control", "gnss"])
@pytest.mark.parametrize("options", [PLAIN, ROBUST], ids=["plain", "robust"])
def test_errors_follow_the_predicted_precision(plan: Plan, options: AdjustmentOptions) -> None:
    _check_statistics(plan, options, 24)


@pytest.mark.slow
@pytest.mark.parametrize("plan", [SMALL, SMALL_GNSS], ids=["control", "gnss"])
def test_errors_follow_the_predicted_precision_over_many_blocks(plan: Plan) -> None:
    _check_statistics(plan, PLAIN, 250)


def _free_network(block: SimulatedBlock) -> AdjustmentInput:
    return replace(block.observations, gnss=None, control=None)


def test_free_network_is_unmoved_and_its_inner_precision_true() -> None:
    """Errors after a similarity transformation to the truth follow the covariance of the free network."""
    chi, plan = [], replace(SMALL, self_calibration=False)
    for seed in range(12):
        block = simulate(np.random.default_rng(seed), plan, start_error=0.02)
        observations = replace(_free_network(block), interior=block.interior)
        result = adjust_block(observations, PLAIN, joint_points=block.check)
        assert result.datum is Datum.FREE_NETWORK
        covariance = result.joint_covariance_m2
        error = (result.points_m - block.points_m)[block.check].ravel()
        # What a similarity transformation can move is not told by a free network: take it out of error and covariance.
        local = block.points_m[block.check] - block.points_m[block.check].mean(axis=0)
        moves = np.zeros((len(error), 7))
        for axis in range(3):
            moves[axis::3, axis] = 1.0
            moves[:, 3 + axis] = np.cross(np.eye(3)[axis], local).ravel()
        moves[:, 6] = local.ravel()
        inner = np.linalg.svd(moves)[0][:, 7:]
        chi.append(_square(inner.T @ error, inner.T @ covariance @ inner) / inner.shape[1])
    assert abs(np.mean(chi) - 1.0) < 3.5 * np.sqrt(2.0 / (17 * 12))


def test_free_network_has_the_least_trace_and_seven_defects() -> None:
    block = simulate(np.random.default_rng(3), replace(SMALL, self_calibration=False), start_error=0.02)
    free = adjust_block(replace(_free_network(block), interior=block.interior), PLAIN)
    tied = adjust_block(replace(block.observations, gnss=None, interior=block.interior), PLAIN)
    trace = np.einsum("nkk->nk", free.exterior_covariances)[:, :3].sum()
    assert trace < np.einsum("nkk->nk", tied.exterior_covariances)[:, :3].sum()
    rays, points = len(block.observations.rays), len(block.points_m)
    assert free.redundancy == 2 * rays - 3 * points - 6 * len(block.centres_m) + 7


def _datum_survives(block: SimulatedBlock, wrong: np.ndarray) -> bool:
    """Tell whether more than half of the rays of each control point are right: the datum hangs on these few."""
    rays = block.observations.rays.point_index
    return all(np.mean(wrong[rays == p]) < 0.5 for p in range(3))


def _moves(kind: str, seeds: range) -> tuple[np.ndarray, list[float]]:
    """Return moves of check points by wrong observations over their sigmas, and the share of wrong rays found."""
    moves, found = [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        block = simulate(rng)
        observations, wrong = with_wrong_rays(block, rng, kind)
        observations, wrong_fixes = with_wrong_fixes(observations, rng)
        result = adjust_block(observations)
        assert not np.any(result.gnss_used[wrong_fixes])
        assert np.mean(result.gnss_used[~wrong_fixes]) > 0.9
        assert result.control_used.all()
        assert 0.85 < result.sigma0 < 1.15
        error = np.linalg.norm(observations.rays.xy_px - block.observations.rays.xy_px, axis=1)
        found.append(float(np.mean(~result.ray_used[wrong & (error > 5.0 * 0.3)])))
        if _datum_survives(block, wrong):
            clean = adjust_block(block.observations, PLAIN)
            sigma = np.sqrt(np.einsum("maa->ma", clean.point_covariances_m2[block.check]))
            moves.append((result.points_m - clean.points_m)[block.check] / sigma)
        # Of points of two rays none is believed where small errors are many; gross ones show in them, too.
        assert bool(result.notes) == (kind == "one-sided")
    return np.concatenate(moves), found


@pytest.mark.parametrize("kind", ["uniform", "one-sided"])
def test_a_fifth_of_wrong_rays_and_a_tenth_of_wrong_fixes(kind: str) -> None:
    """RMS over the check points: that of the information lost with the wrong rays is about 0.3 already."""
    moves, found = _moves(kind, range(3))
    assert np.sqrt(np.nanmean(moves**2)) <= 0.7
    assert np.mean(found) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uniform", "one-sided"])
def test_wrong_observations_over_many_seeds(kind: str) -> None:
    moves, found = _moves(kind, range(20))
    assert np.sqrt(np.nanmean(moves**2)) <= 0.7
    assert np.mean(found) > 0.99


def test_control_point_with_one_right_ray_keeps_its_place() -> None:
    """Three of its four rays are wrong at random: the fourth and the survey agree, and the block must not bend."""
    rng = np.random.default_rng(7)
    block = simulate(rng)
    observations, wrong = with_wrong_rays(block, rng, "uniform")
    of_control = block.observations.rays.point_index == 1
    assert np.count_nonzero(of_control & ~wrong) == 1
    result = adjust_block(observations)
    assert np.linalg.norm(result.points_m[1] - block.points_m[1]) < 0.05
    assert result.control_used.all()
    assert not np.any(result.ray_used[of_control & wrong])


def test_image_keeps_its_points_of_two_rays_where_it_has_no_others() -> None:
    """Amid many small errors points of two rays are left out, but not to the point that an image hangs in the air."""
    rng = np.random.default_rng(3)
    block = simulate(rng, replace(SMALL, points=400))
    rays = block.observations.rays
    # Image 0 keeps those rays whose point only one other image sees.
    alone = np.bincount(rays.point_index)[rays.point_index] == 2
    keep = np.flatnonzero((rays.image_index != 0) | alone)
    assert np.count_nonzero(rays.image_index[keep] == 0) > 10
    thin = replace(block, observations=replace(block.observations, rays=rays.where(keep)))
    observations, _ = with_wrong_rays(thin, rng, "one-sided")
    result = adjust_block(observations)
    assert result.notes
    assert np.count_nonzero(result.ray_used[observations.rays.image_index == 0]) > 5


def test_clean_block_loses_next_to_nothing() -> None:
    block = simulate(np.random.default_rng(1))
    result = adjust_block(block.observations)
    assert np.mean(result.ray_used) > 0.995
    plain = adjust_block(block.observations, PLAIN)
    assert result.sigma0 == pytest.approx(plain.sigma0, abs=0.01)


def test_wrong_control_point_is_found() -> None:
    block = simulate(np.random.default_rng(4), replace(Plan(), control=5, gnss_sigma_m=0.05))
    control = block.observations.control
    assert control is not None
    position = control.position_m.copy()
    position[2] += [0.0, 0.3, 0.2]
    result = adjust_block(replace(block.observations, control=replace(control, position_m=position)))
    assert result.control_used.tolist() == [True, True, False, True, True]


def test_redundancy_numbers_add_up() -> None:
    block = simulate(np.random.default_rng(5), replace(SMALL, self_calibration=False, gnss_sigma_m=50.0))
    result = adjust_block(replace(block.observations, gnss=None), PLAIN)
    control = result.redundancy - np.sum(result.ray_redundancy)
    # What is left belongs to the nine control coordinates; seven unknowns of the datum hang on them.
    assert 0.0 < control < 2.0 + 1e-6
    assert np.all((result.ray_redundancy > -1e-9) & (result.ray_redundancy < 1.0))


def test_undetermined_interior_is_reported() -> None:
    plan = replace(SMALL, strips=1, width_m=16.0, margin_m=(6.0, 8.0), control=0, gnss_sigma_m=1.0)
    block = simulate(np.random.default_rng(6), plan, start_error=0.1)
    sigmas = replace(INTERIOR_SIGMAS, principal_distance_px=0.5)
    observations = replace(block.observations, interior_sigmas=sigmas, interior=block.interior)
    result = adjust_block(observations, PLAIN)
    assert "principal_distance_px" in result.undetermined_interior
    assert "k1" not in result.undetermined_interior


def test_image_without_rays_is_named() -> None:
    block = simulate(np.random.default_rng(7), SMALL)
    rays = block.observations.rays
    observations = replace(block.observations, rays=rays.where(rays.image_index != 4))
    with pytest.raises(AdjustmentError, match=r"image 4 \(0\)"):
        adjust_block(observations)


def test_two_control_points_without_gnss_leave_a_defect() -> None:
    block = simulate(np.random.default_rng(8), replace(SMALL, control=2))
    with pytest.raises(AdjustmentError, match="1 direction"):
        adjust_block(replace(block.observations, gnss=None), AdjustmentOptions(robust=False, datum=Datum.CONTROL))


def test_datum_is_chosen() -> None:
    block = simulate(np.random.default_rng(9), SMALL)
    given = block.observations
    assert adjust_block(given, PLAIN).datum is Datum.CONTROL
    without_control = adjust_block(replace(given, control=None), PLAIN)
    assert without_control.datum is Datum.GNSS
    # Without control the shift is zero with its stated sigma, and the block says no more of it.
    np.testing.assert_allclose(
        np.sqrt(np.diag(without_control.gnss_shift_covariance_m2[0])), (2.0, 2.0, 3.0), rtol=0.02
    )
    assert adjust_block(replace(given, control=None, gnss=None), PLAIN).datum is Datum.FREE_NETWORK


def test_result_is_the_same_bit_by_bit() -> None:
    block = simulate(np.random.default_rng(10))
    first, second = adjust_block(block.observations), adjust_block(block.observations)
    np.testing.assert_array_equal(first.points_m, second.points_m)
    np.testing.assert_array_equal(first.exterior_covariances, second.exterior_covariances)
    assert first.sigma0 == second.sigma0


def test_result_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    block = simulate(np.random.default_rng(10))
    results = []
    for threads in (1, 3):
        with ThreadPoolExecutor(threads) as pool:
            monkeypatch.setattr(bundle_system, "_pool", lambda process, pool=pool: pool)
            results.append(adjust_block(block.observations))
    np.testing.assert_array_equal(results[0].points_m, results[1].points_m)
    np.testing.assert_array_equal(results[0].ray_redundancy, results[1].ray_redundancy)
    assert results[0].sigma0 == results[1].sigma0


def test_iteration_that_did_not_end_is_told() -> None:
    block = simulate(np.random.default_rng(12), SMALL)
    result = adjust_block(block.observations, AdjustmentOptions(robust=False, most_iterations=1))
    assert not result.converged
    assert "not converged after 1 steps" in result.notes[0]
    done = adjust_block(block.observations, PLAIN)
    assert done.converged
    assert done.notes == ()


def test_two_ray_point_with_a_wrong_ray_is_dropped() -> None:
    block = simulate(np.random.default_rng(11))
    rays = block.observations.rays
    count = np.bincount(rays.point_index)
    point = int(np.flatnonzero(count == 2)[0])
    xy = rays.xy_px.copy()
    # Both axes: one of them at least crosses the epipolar line.
    xy[np.flatnonzero(rays.point_index == point)[0]] += 30.0
    result = adjust_block(replace(block.observations, rays=replace(rays, xy_px=xy)))
    assert not np.any(result.ray_used[rays.point_index == point])
    assert np.all(np.isnan(result.points_m[point]))
    assert np.all(np.isnan(result.point_covariances_m2[point]))
