"""Peak memory of ``uavkit process`` with few and many full-size stills: it must not grow with their number."""

from typing import Any

import pytest

from tests.benchmarks.blocks import Case, cases, ingest, process
from tests.benchmarks.rows import measured
from uavkit.formats.adjustment_file import read_oriented_block
from uavkit.project import Project

pytestmark = pytest.mark.slow


def memory(case: Case) -> dict[str, Any]:
    """Process the stills of a case and return the largest resident memory of the program."""
    ingest(case)
    done = process(case)
    result = read_oriented_block(Project(case.survey).result_file)
    return {
        "stills": len(result.block.stills),
        "stills_oriented": len(result.images),
        "points": len(result.adjustment.points_m),
        "process_s": done.wall_s,
        "peak_mb": done.peak_mb,
    }


@pytest.mark.parametrize("case", cases("memory"), ids=lambda case: case.name)
def test_memory_of_process(case: Case) -> None:
    row = measured("memory", case.name, lambda: memory(case))
    assert row["stills_oriented"] > 0
