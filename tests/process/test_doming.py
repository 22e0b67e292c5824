"""A block that looks straight down from one height over flat ground, without control: what decides its curvature."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.process.bundle_blocks import INTERIOR_SIGMAS, Plan, simulate
from uavkit.core.adjustment import AdjustmentOptions
from uavkit.core.camera import InteriorSigmas
from uavkit.process.bundle import adjust_block

FLAT = Plan(points=600, relief=0.0, tilt_rad=0.01, height_sigma_m=0.05, control=0)
CALIBRATED = InteriorSigmas(
    principal_distance_px=1.0, x0_px=0.5, y0_px=0.5, k1=2e-4, k2=3e-4, k3=3e-4, p1=2e-5, p2=2e-5
)
"""What a calibration in a test field leaves."""


@dataclass(frozen=True, kw_only=True)
class Bow:
    """Heights of the edge of the block against its middle: their error and its predicted sigma."""

    error_m: float
    sigma_m: float


def bow_of(plan: Plan, seed: int) -> Bow:
    block = simulate(np.random.default_rng(seed), plan, start_error=0.3)
    rows = np.arange(len(block.points_m))[:: len(block.points_m) // 40]
    result = adjust_block(block.observations, AdjustmentOptions(robust=False), joint_points=rows)
    place = block.points_m[rows, :2] - block.points_m[:, :2].mean(axis=0)
    edge = np.percentile(np.linalg.norm(place, axis=1), 95.0)
    design = np.column_stack([np.ones(len(rows)), place / edge, np.sum((place / edge) ** 2, axis=1)])
    functional = np.linalg.pinv(design)[3]
    error = functional @ (result.points_m[rows, 2] - block.points_m[rows, 2])
    covariance = result.joint_covariance_m2[2::3, 2::3]
    return Bow(error_m=float(error), sigma_m=float(np.sqrt(functional @ covariance @ functional)))


@pytest.mark.parametrize("sigmas", [INTERIOR_SIGMAS, CALIBRATED], ids=["profile", "calibrated"])
def test_the_edge_stays_within_what_is_predicted(sigmas: InteriorSigmas) -> None:
    """z of 30 blocks: its RMS has a standard deviation of 0.13 about 1; bounds at three of them."""
    bows = [bow_of(replace(FLAT, interior_sigmas=sigmas), seed) for seed in range(30)]
    z = np.array([bow.error_m / bow.sigma_m for bow in bows])
    assert 0.61 < np.sqrt(np.mean(z**2)) < 1.39
    assert np.abs(z).max() < 4.0


def test_a_prior_on_the_interior_orientation_holds_the_edge_down() -> None:
    loose = bow_of(replace(FLAT, interior_sigmas=INTERIOR_SIGMAS), 1)
    tight = bow_of(replace(FLAT, interior_sigmas=CALIBRATED), 1)
    assert tight.sigma_m < 0.25 * loose.sigma_m


def test_relief_and_tilts_determine_the_curvature() -> None:
    flat = bow_of(FLAT, 2).sigma_m
    assert bow_of(replace(FLAT, relief=1.0), 2).sigma_m < 0.5 * flat
    assert bow_of(replace(FLAT, tilt_rad=0.15), 2).sigma_m < 0.2 * flat
