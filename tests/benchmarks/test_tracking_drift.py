"""Drift of tracking through simulated video from still to still, with chained Lucas-Kanade beside it.

The flights are those of "accuracy full size", which need not be rendered twice.
"""

import pytest

from tests.benchmarks.blocks import Case, ingest
from tests.benchmarks.drift import drift
from tests.benchmarks.rows import measured

pytestmark = pytest.mark.slow

CASES = [
    Case(
        benchmark="tracking drift",
        name=f"{flight}, seed {seed}",
        simulate={"flight": flight, "seed": seed},
    )
    for flight in ("trace", "constant")
    for seed in (1, 2)
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_tracking_drift(case: Case) -> None:
    def values() -> dict[str, object]:
        ingest(case)
        return drift(case.survey, case.flight)

    row = measured("tracking drift", case.name, values)
    assert row["ours_held"] > 0.5 * row["points"]
