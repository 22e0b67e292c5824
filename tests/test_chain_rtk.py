"""The chain without a control point: RTK positions alone fix the block, as well as the adjustment says."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uavkit import workflow
from uavkit.core.adjustment import Datum
from uavkit.project import IngestOptions, Project

RTK: Mapping[str, Any] = {
    "scale": 0.2,
    "strips": 2,
    "stations_per_strip": 4,
    "video_standard": "none",
    "gnss_sigma_m": 0.02,
    "gnss_outliers": 0,
    "control_points": 0,
    "check_points": 8,
    "workers": 2,
}


def test_rtk_positions_fix_a_block_as_well_as_predicted(tmp_path: Path) -> None:
    """Chi-square of all coordinates of the check points with their joint covariance, 0.1 % each side; centimetres."""
    flight, project = tmp_path / "flight", Project(tmp_path / "survey")
    command = workflow.simulate(flight, RTK)
    assert "positions.csv" in command
    assert "control" not in command
    originals = {
        "images": flight / "stills",
        "positions": flight / "positions.csv",
        "check_points": flight / "check_points.csv",
    }
    workflow.begin_survey(project, originals, IngestOptions())
    workflow.ingest(project)
    result = workflow.process(project, workers=2)
    assert result.unoriented == {}
    assert result.adjustment.datum is Datum.GNSS
    difference = np.array([point.difference_m for point in result.check])
    predicted = np.array([point.sigma_m for point in result.check])
    assert len(difference) >= 6
    chi_square = difference.ravel() @ np.linalg.solve(result.check_covariance_m2, difference.ravel())
    assert abs(chi_square - difference.size) < 3.1 * np.sqrt(2.0 * difference.size)
    assert np.median(predicted) < 0.05  # the default shift of 2 m would show here
