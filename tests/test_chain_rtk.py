"""The chain without a control point: RTK positions alone fix the block, as well as the adjustment says."""

from pathlib import Path

import numpy as np

from uavkit import workflow
from uavkit.core.adjustment import Datum
from uavkit.project import IngestOptions, Project


def test_rtk_positions_fix_a_block_as_well_as_predicted(rtk_flight: Path, tmp_path: Path) -> None:
    """Chi-square of all coordinates of the check points with their joint covariance, 0.1 % each side; centimetres."""
    project = Project(tmp_path / "survey")
    originals = {
        "images": rtk_flight / "stills",
        "positions": rtk_flight / "positions.csv",
        "check_points": rtk_flight / "check_points.csv",
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
