"""Time and memory of ``uavkit process`` against COLMAP on the same stills, one right after the other."""

import json
from dataclasses import replace
from typing import Any

import pytest

from tests.benchmarks.blocks import Case, cases, ingest, process, render
from tests.benchmarks.rows import WORK, measured
from tests.benchmarks.subprocesses import run_measured

pytestmark = pytest.mark.slow

CASES = [replace(case, benchmark="process speed") for case in cases("accuracy full size")]


def colmap(case: Case) -> dict[str, Any]:
    """Run COLMAP on the stills of a case and return its row; its models are kept, its database is not."""
    work = WORK / "colmap" / case.name
    result = work.with_suffix(".json")
    arguments = ["tests.benchmarks.colmap_peer", str(render(case)), str(work), str(result)]
    finished = run_measured(arguments, WORK / "logs" / f"COLMAP {case.name}.log")
    (work / "database.db").unlink()
    return {
        "processor_s": finished.processor_s,
        "peak_mb": finished.peak_mb,
        **json.loads(result.read_text(encoding="utf-8")),
    }


def compared(case: Case) -> dict[str, Any]:
    """Process a case and let COLMAP do the same stills; keep what COLMAP found as a row of its own.

    The ratio of processor times hangs less on what else the machine does than that of the times a user waits.
    """
    ingest(case)
    ours = process(case)
    peer = measured("COLMAP full size", case.name, lambda: colmap(case))
    return {
        "ours_s": ours.wall_s,
        "colmap_s": peer["total_s"],
        "ratio": ours.wall_s / peer["total_s"],
        "ours_processor_s": ours.processor_s,
        "colmap_processor_s": peer["processor_s"],
        "ratio_of_processor_times": ours.processor_s / peer["processor_s"],
        "ours_peak_mb": ours.peak_mb,
        "colmap_peak_mb": peer["peak_mb"],
    }


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_process_against_colmap(case: Case) -> None:
    row = measured(case.benchmark, case.name, lambda: compared(case))
    assert row["ours_s"] > 0
