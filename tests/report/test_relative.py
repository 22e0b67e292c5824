"""The precision within a block, against the joint covariance of all points of a small adjusted block."""

from dataclasses import replace

import numpy as np
import pytest

from tests.process.bundle_blocks import Plan, simulate
from uavkit.core.observations import GnssObservations
from uavkit.core.result import OrientedBlock
from uavkit.process.bundle import adjust_block
from uavkit.report.measures import gnss_rows, gnss_stations
from uavkit.report.relative import relative_precision


def adjusted_block(
    result: OrientedBlock,
    gnss_sigma_m: float,
    shift_sigma_m: tuple[float, float, float],
    latency_sigma_s: float | None = None,
) -> OrientedBlock:
    """Return a result whose adjustment is a real one, of 33 stills and GNSS alone, flown to and fro at 10 m/s."""
    block = simulate(np.random.default_rng(3), Plan(points=200, control=0, gnss_sigma_m=0.5))
    assert block.observations.gnss is not None
    sigma = np.full_like(block.observations.gnss.sigma_m, gnss_sigma_m)
    velocity = -10.0 * block.rotations[:, :, 1]
    gnss = replace(
        block.observations.gnss,
        sigma_m=sigma,
        shift_sigma_m=shift_sigma_m,
        velocity_m_s=velocity,
        latency_sigma_s=latency_sigma_s,
    )
    given = replace(block.observations, gnss=gnss)
    adjustment = adjust_block(given, joint_points=np.arange(len(block.points_m)))
    names = tuple(f"{row}.JPG" for row in range(33))
    stills = tuple(replace(result.block.stills[0], name=name) for name in names)
    return replace(
        result,
        adjustment=adjustment,
        images=names,
        unoriented={},
        rays=given.rays,
        block=replace(result.block, gnss=gnss, stills=stills, control_points=(), check_points=()),
        control=(),
        check=(),
    )


@pytest.fixture(scope="module")
def fine(result: OrientedBlock) -> OrientedBlock:
    return adjusted_block(result, 0.5, (2.0, 2.0, 3.0))


def trace_without_similarity_m2(block: OrientedBlock) -> float:
    """Return the trace of the points' joint covariance, freed of shift, rotation and scale of all points."""
    points = block.adjustment.points_m
    arm = points - points.mean(axis=0)
    turns = [np.cross(axis, arm).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(points)) for axis in np.eye(3)]
    g = np.column_stack([*shifts, *turns, arm.ravel()])
    projector = np.eye(len(g)) - g @ np.linalg.pinv(g)
    return float(np.trace(projector @ block.adjustment.joint_covariance_m2 @ projector))


def test_the_shape_does_not_depend_on_the_gnss(result: OrientedBlock, fine: OrientedBlock) -> None:
    # Positions four times and a shift twice as uncertain change the whole precision as much, and the shape not.
    # Five per cent: what positions of 0.5 m add to the shape that rays of 0.3 px determine.
    coarse = adjusted_block(result, 2.0, (4.0, 4.0, 6.0))
    a, b = relative_precision(fine), relative_precision(coarse)
    assert a is not None
    assert b is not None
    for name in ("point_xy_m", "point_z_m", "centre_xy_m", "centre_z_m"):
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=0.05)
    whole = [np.trace(block.adjustment.joint_covariance_m2) for block in (fine, coarse)]
    assert whole[1] > 3.9 * whole[0]


def test_the_shape_does_not_depend_on_the_latency(result: OrientedBlock, fine: OrientedBlock) -> None:
    late = adjusted_block(result, 0.5, (2.0, 2.0, 3.0), 0.5)
    a, b = relative_precision(fine), relative_precision(late)
    assert a is not None
    assert b is not None
    # Eight per cent: what a free latency gives away to the shape; without it, it would be trebled.
    np.testing.assert_allclose(b.centre_xy_m, a.centre_xy_m, rtol=0.08)
    np.testing.assert_allclose(b.point_xy_m, a.point_xy_m, rtol=0.08)


def test_the_shape_is_bounded_by_the_joint_covariance(fine: OrientedBlock) -> None:
    # Freed of the similarity of all points themselves, the trace is the least possible; the fit to the stations adds.
    found = relative_precision(fine)
    assert found is not None
    ours = float(np.sum(found.point_xy_m**2) + np.sum(found.point_z_m**2))
    assert trace_without_similarity_m2(fine) < ours < 0.01 * np.trace(fine.adjustment.joint_covariance_m2)


def test_nothing_is_stated_with_control_or_in_a_line(result: OrientedBlock, fine: OrientedBlock) -> None:
    assert relative_precision(result) is None
    line = fine.adjustment.projection_centres_m * [1.0, 0.0, 0.0]
    level = replace(fine.block.gnss, lever_arm_m=(0.0, 0.0, 0.0)) if fine.block.gnss else None
    flat = replace(
        fine,
        block=replace(fine.block, gnss=level),
        adjustment=replace(fine.adjustment, projection_centres_m=line),
    )
    assert relative_precision(flat) is None


def test_gnss_rows_are_those_of_the_oriented_stills(result: OrientedBlock) -> None:
    # The third of nine stills is not oriented; the sixth has no position. Rows of the adjustment skip both.
    names = ("a", "b", "lost", "c", "d", "without", "e", "f", "g")
    oriented = tuple(name for name in names if name != "lost")
    image = np.array([0, 1, 2, 3, 4, 6, 7, 8])
    gnss = GnssObservations(
        image_index=image, position_m=np.zeros((8, 3)), sigma_m=np.ones((8, 3)), flight=np.zeros(8, dtype=np.int64)
    )
    stills = tuple(replace(result.block.stills[0], name=name) for name in names)
    adjustment = replace(result.adjustment, gnss_used=np.ones(7, dtype=bool), gnss_residuals_m=np.zeros((7, 3)))
    lost = replace(
        result,
        images=oriented,
        unoriented={"lost": "too few points"},
        adjustment=adjustment,
        block=replace(result.block, stills=stills, gnss=gnss),
    )
    assert gnss_rows(lost).tolist() == [0, 1, 3, 4, 5, 6, 7]
    assert gnss_stations(lost) == ("a", "b", "c", "d", "e", "f", "g")
    # As many residuals as positions, though one still is lost: the rows cannot be told, and are not guessed.
    odd = replace(lost, adjustment=replace(adjustment, gnss_used=np.ones(8, bool), gnss_residuals_m=np.zeros((8, 3))))
    assert gnss_rows(odd).tolist() == [-1] * 8
