"""Whether the predicted precision is true: errors of check points over many simulated adjustments, without pictures."""

from typing import Any

import numpy as np
import pytest

from tests.benchmarks.rows import measured
from tests.process.bundle_blocks import Plan, SimulatedBlock, simulate, with_wrong_rays
from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult
from uavkit.core.errors import AdjustmentError
from uavkit.process.bundle import adjust_block

pytestmark = pytest.mark.slow

BLOCKS = 200
FIRST_SEED = 5000
ROBUST = AdjustmentOptions()
"""As the chain adjusts its last network."""


def observations_of(block: SimulatedBlock, rng: np.random.Generator, wrong_share: float) -> AdjustmentInput:
    """Return the observations of a block with a share of rays replaced by others anywhere in the image."""
    return with_wrong_rays(block, rng, "uniform", wrong_share)[0] if wrong_share else block.observations


def point_squares(block: SimulatedBlock, result: AdjustmentResult) -> list[float]:
    """Return e' Q^-1 e of each check point: error against the truth, in its predicted covariance."""
    error, covariance = result.points_m - block.points_m, result.point_covariances_m2
    return [float(error[p] @ np.linalg.solve(covariance[p], error[p])) for p in block.check]


def honesty(wrong_share: float) -> dict[str, Any]:
    """Return the mean of e' Q^-1 e of a check point and of sigma0^2 over simulated blocks, with its standard error."""
    squares, variances, redundancies = [], [], []
    failed = 0
    for seed in range(FIRST_SEED, FIRST_SEED + BLOCKS):
        rng = np.random.default_rng(seed)
        block = simulate(rng, Plan())
        try:
            result = adjust_block(observations_of(block, rng, wrong_share), ROBUST)
        except AdjustmentError:
            failed += 1
            continue
        squares += [square for square in point_squares(block, result) if np.isfinite(square)]
        variances.append(result.sigma0**2)
        redundancies.append(result.redundancy)
    return {
        "blocks": BLOCKS,
        "failed_blocks": failed,
        "check_points": len(squares),
        "mean_chi_square_of_a_point": float(np.mean(squares)),
        "median_chi_square_of_a_point": float(np.median(squares)),
        "sigma0_squared": float(np.mean(variances)),
        "sigma0_squared_standard_error": float(np.sqrt(2.0 / np.sum(redundancies))),
        "sigma0_squared_deviation_sigmas": float((np.mean(variances) - 1.0) / np.sqrt(2.0 / np.sum(redundancies))),
    }


@pytest.mark.parametrize("wrong_share", [0.0, 0.05, 0.2])
def test_errors_are_as_predicted(wrong_share: float) -> None:
    case = f"{round(100 * wrong_share)} % wrong rays"
    row = measured("honesty", case, lambda: honesty(wrong_share))
    assert row["check_points"] > 0
