"""Control points in the bundle: they fix the datum, and robust weights do not throw it away."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_blocks import Plan, SimulatedBlock, simulate, with_wrong_fixes

from uavkit.core.adjustment import AdjustmentInput
from uavkit.process.bundle import adjust_block

SMALL = Plan(strips=2, images=5, points=150, length_m=40.0, width_m=26.0)


def _with_wrong_control(block: SimulatedBlock, row: int, error_m: tuple[float, float, float]) -> AdjustmentInput:
    control = block.observations.control
    assert control is not None
    position = control.position_m.copy()
    position[row] += error_m
    return replace(block.observations, control=replace(control, position_m=position))


@pytest.mark.parametrize("row", [0, 2, 4])
def test_one_of_five_control_points_off_by_a_metre_is_rejected(row: int) -> None:
    block = simulate(np.random.default_rng(20 + row), replace(SMALL, control=5))
    result = adjust_block(_with_wrong_control(block, row, (0.6, -0.5, 0.6)))
    assert result.control_used.tolist() == [number != row for number in range(5)]
    assert result.group_sigma0["control"] < 2.0
    # Its rays are right: the point itself is found by them.
    assert np.mean(result.ray_used[block.observations.rays.point_index == row]) > 0.7
    assert np.linalg.norm(result.points_m[row] - block.points_m[row]) < 0.1


def test_two_of_six_wrong_control_points_go_one_by_one() -> None:
    block = simulate(np.random.default_rng(31), replace(SMALL, control=5))
    observations = _with_wrong_control(block, 1, (1.0, 0.0, 0.0))
    control = observations.control
    assert control is not None
    extra = block.check[3]
    wrong = block.points_m[extra] + [0.0, 0.7, -0.7]
    observations = replace(
        observations,
        control=replace(
            control,
            point_index=np.append(control.point_index, extra),
            position_m=np.vstack([control.position_m, wrong]),
            sigma_m=np.vstack([control.sigma_m, control.sigma_m[:1]]),
        ),
    )
    assert adjust_block(observations).control_used.tolist() == [True, False, True, True, True, False]


@pytest.mark.parametrize("gnss", [True, False], ids=["gnss of a metre", "no gnss"])
def test_three_control_points_stay_and_tell_that_one_is_wrong(gnss: bool) -> None:
    block = simulate(np.random.default_rng(40), SMALL)
    observations = _with_wrong_control(block, 1, (0.6, -0.5, 0.6))
    result = adjust_block(observations if gnss else replace(observations, gnss=None))
    assert result.control_used.all()
    assert result.group_sigma0["control"] > 8.0
    assert result.converged
    # Nor do the control points cast off their rays instead.
    rays = block.observations.rays.point_index
    assert all(np.count_nonzero(result.ray_used[rays == row]) >= 3 for row in range(3))


def _shifted_with_outliers(seed: int) -> AdjustmentInput:
    """Return a block of SBAS quality: three fixes of ten 10 to 30 m off, the shift of 3 m that all blocks have."""
    rng = np.random.default_rng(seed)
    return with_wrong_fixes(simulate(rng, SMALL).observations, rng, share=0.3)[0]


@pytest.mark.parametrize("seed", range(20))
def test_gnss_outliers_never_cost_control(seed: int) -> None:
    result = adjust_block(_shifted_with_outliers(seed))
    assert result.control_used.all()
    assert result.group_sigma0.get("control", 0.0) < 4.0


def test_two_control_points_beside_good_gnss_stay_and_tell() -> None:
    block = simulate(np.random.default_rng(5), replace(SMALL, control=2, gnss_sigma_m=0.05))
    right = adjust_block(block.observations)
    wrong = adjust_block(_with_wrong_control(block, 1, (0.6, -0.5, 0.6)))
    assert right.control_used.all()
    assert wrong.control_used.all()
    assert right.group_sigma0["control"] < 3.0
    assert wrong.group_sigma0["control"] > 8.0
