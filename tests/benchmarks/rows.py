"""Rows of benchmarks: measured once, kept in ``results/rows.jsonl``, and not measured again until removed.

A run that was stopped goes on where it stopped. Each row names the commit and the day on which it was measured;
``UAVKIT_BENCH_FRESH=1`` measures all rows anew.
"""

import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
ROWS = RESULTS / "rows.jsonl"
WORK = Path(os.environ.get("UAVKIT_BENCH", Path(__file__).parents[2] / "bench"))
"""Where simulated surveys and other large files lie; not kept with the project."""

Row = dict[str, Any]


def kept_rows(path: Path = ROWS) -> dict[tuple[str, str], Row]:
    """Return the rows that were measured, by benchmark and case; the last one of a case counts."""
    if not path.is_file():
        return {}
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    return {(row["benchmark"], row["case"]): row for row in rows}


def measured(benchmark: str, case: str, measure: Callable[[], Mapping[str, Any]], path: Path = ROWS) -> Row:
    """Return the row of a case: the kept one, or a new one, appended as soon as it is measured.

    The measured values are plain numbers, texts and lists, with the unit in each name.
    """
    known = kept_rows(path).get((benchmark, case))
    if known is not None and not os.environ.get("UAVKIT_BENCH_FRESH"):
        return known
    row = {"benchmark": benchmark, "case": case, **_circumstances(), **measure()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, ensure_ascii=False) + "\n")
    return row


def _circumstances() -> Row:
    """Return commit, day and machine of a measurement, with what else the machine had to do."""
    root = Path(__file__).parents[2]
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True, check=False
    )
    return {
        "commit": described.stdout.strip() or "unknown",
        "day": datetime.now(UTC).strftime("%Y-%m-%d"),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
    }
