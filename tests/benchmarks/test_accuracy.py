"""Accuracy of simulated flights of known truth, with COLMAP beside it; the cases lie in ``cases.toml``.

Each case becomes a row of ``results/rows.jsonl``; nothing is judged here but that all is measured: the bars are printed
by ``tables.py``, over all rows together.
"""

import pytest

from tests.benchmarks.blocks import Case, cases, oriented
from tests.benchmarks.rows import measured

pytestmark = pytest.mark.slow

BENCHMARKS = (
    "accuracy full size",
    "accuracy full size by features",
    "accuracy half scale",
    "terrains half scale",
    "textures half scale",
    "textures half scale by features",
    "brightness half scale",
    "accuracy RTK",
)
CASES = [case for benchmark in BENCHMARKS for case in cases(benchmark)]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.benchmark}: {case.name}")
def test_block_is_oriented(case: Case) -> None:
    row = measured(case.benchmark, case.name, lambda: oriented(case))
    assert row["stills"] > 0
