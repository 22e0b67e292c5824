# ruff: noqa: T201 (it prints what it removed)
"""Rows of benchmarks: measured once, kept in ``results/rows.jsonl``, and not measured again until removed.

A run that was stopped goes on where it stopped. Each row names the commit and the day on which it was measured.
``UAVKIT_BENCH_FRESH`` names benchmarks, separated by commas, whose rows are measured anew; ``all`` means all.
``python -m tests.benchmarks.rows BENCHMARK ...`` removes the rows of benchmarks, so that the next run measures them.
"""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "tests" / "benchmarks" / "results"
ROWS = RESULTS / "rows.jsonl"
WORK = Path(os.environ.get("UAVKIT_BENCH", ROOT / "bench"))
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
    if known is not None and not _fresh(benchmark):
        return known
    row = {"benchmark": benchmark, "case": case, **_circumstances(), **measure()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, ensure_ascii=False) + "\n")
    return row


def _fresh(benchmark: str) -> bool:
    """Tell whether the rows of a benchmark are to be measured anew."""
    named = {name.strip() for name in os.environ.get("UAVKIT_BENCH_FRESH", "").split(",")}
    return bool(named & {"all", "1", benchmark})


def forget(benchmarks: Sequence[str], path: Path = ROWS) -> int:
    """Remove the rows of benchmarks and return how many these were."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    kept = [line for line in lines if line.strip() and json.loads(line)["benchmark"] not in benchmarks]
    path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
    return len(lines) - len(kept)


def _circumstances() -> Row:
    """Return commit, day and machine of a measurement, with what else the machine had to do."""
    return {
        "commit": _commit(),
        "day": datetime.now(UTC).strftime("%Y-%m-%d"),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 1),
        "python": platform.python_version(),
    }


def _commit() -> str:
    """Return the commit of the checkout; "-dirty" where files other than the results differ from it."""
    commit = _git("rev-parse", "--short", "HEAD") or "unknown"
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", f":(exclude){RESULTS.relative_to(ROOT)}")
    return f"{commit}-dirty" if changed else commit


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


if __name__ == "__main__":
    print(f"removed {forget(sys.argv[1:])} rows")
