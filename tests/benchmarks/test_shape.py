"""Error of the shape of a block against COLMAP's, of the same stills: without the noise of survey and marks.

With three control points of 5 mm the check points show their noise and little else, for any program. The orientations
themselves are told apart by exact marks and a similarity transformation to the truth.
"""

from pathlib import Path
from typing import Any

import pycolmap
import pytest

from tests.benchmarks.blocks import Case, cases, ingest, process
from tests.benchmarks.colmap_peer import largest_model, shape_errors
from tests.benchmarks.rows import WORK, measured
from uavkit.formats.adjustment_file import read_oriented_block
from uavkit.formats.colmap_files import write_colmap_model
from uavkit.project import Project
from uavkit.simulate.truth import read_truth

pytestmark = pytest.mark.slow

BENCHMARK = "shape"


def shapes(case: Case, exported: Path) -> dict[str, Any]:
    """Return the errors of both programs, of the last survey of a case and of COLMAP's kept model."""
    result_file = Project(case.survey).result_file
    if not result_file.is_file():
        ingest(case)
        process(case)
    write_colmap_model(exported, read_oriented_block(result_file))
    truth = read_truth(case.flight / "truth" / "truth.json")
    models = {
        "ours": pycolmap.Reconstruction(exported),
        "colmap": largest_model(WORK / "colmap" / case.name / "models"),
    }
    errors = {name: shape_errors(model, truth) for name, model in models.items()}
    return {f"{name}_{value}": error for name, values in errors.items() for value, error in values.items()}


@pytest.mark.parametrize("case", cases("accuracy full size"), ids=lambda case: case.name)
def test_shape_against_colmap(case: Case, tmp_path: Path) -> None:
    if not (WORK / "colmap" / case.name / "models").is_dir():
        pytest.skip(f"COLMAP has not done {case.name} yet: run test_process_speed.py first")
    row = measured(BENCHMARK, case.name, lambda: shapes(case, tmp_path))
    assert row["ours_shape_xy_mm"] > 0
