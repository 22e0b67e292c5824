"""Calibrated sigmas reach the rays of points, not the marks; rays that took no part get the middle factor."""

from dataclasses import replace

import numpy as np
import pytest

from tests.process.test_network import _block, _network
from uavkit.core.adjustment import Datum
from uavkit.process.calibration import angles_to_mean, calibrated
from uavkit.process.network import adjust_network, updated
from uavkit.process.options import AdjustmentSection

STATED_PX = 0.5
TRUE_PX = 0.2


def test_sigmas_stated_wrongly_are_put_right_and_marks_keep_theirs() -> None:
    block = _block()
    network, marked = _network(block)
    of_points = network.point < network.marks_from
    sigma = network.sigma_px.copy()
    sigma[of_points] = STATED_PX
    adjusted = adjust_network(replace(network, sigma_px=sigma), block, marked, AdjustmentSection(), Datum.FREE_NETWORK)
    better, calibration = calibrated(updated(replace(network, sigma_px=sigma), adjusted), adjusted)
    freedom = float(np.nansum(adjusted.result.ray_redundancy))
    np.testing.assert_allclose(calibration.factor, TRUE_PX / STATED_PX, rtol=4 / np.sqrt(2 * freedom / 9) + 0.02)
    assert np.median(better.sigma_px[of_points]) == pytest.approx(TRUE_PX, rel=0.1)
    np.testing.assert_array_equal(better.sigma_px[~of_points], network.sigma_px[~of_points])


def test_angles_are_those_to_the_mean_ray() -> None:
    network, _ = _network(_block())
    rows = np.isin(np.arange(len(network.point)), np.arange(4))
    two = replace(
        network,
        points=np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]),
        centres=np.array([[10.0, 0.0, 10.0], [-10.0, 0.0, 10.0]]),
        rotations=network.rotations[:2],
        point=np.array([0, 0, 1, 1]),
        image=np.array([0, 1, 0, 1]),
        xy_px=network.xy_px[rows],
        sigma_px=network.sigma_px[rows],
        marks_from=2,
    )
    np.testing.assert_allclose(angles_to_mean(two), [np.pi / 4, np.pi / 4, 0.0, 0.0], atol=1e-12)
