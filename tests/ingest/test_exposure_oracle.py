"""The matcher against an exhaustive search that knows the true law of each case."""

from dataclasses import dataclass

import numpy as np
import pytest
from exposure_cases import draw_case, draw_law
from exposure_oracle import SETTLED, probability_of_true_shift
from test_exposure_matching import is_wrong, stamps_of

from uavkit.core.exposures import StillState
from uavkit.ingest.exposure_matching import match_exposures


@dataclass
class Comparison:
    """Counts over cases of one kind."""

    cases: int = 0
    settled: int = 0
    """By the oracle."""
    pairs: int = 0
    """True ones in these."""
    found: int = 0
    """Of these, those told to have been doubled among them."""
    given: int = 0
    wrong: int = 0
    wrong_where_open: int = 0
    """Wrong pairs without a flag in cases that the oracle leaves open."""

    def line(self, name: str) -> str:
        share = self.found / max(self.pairs, 1)
        return (
            f"{name}: oracle settles {self.settled} of {self.cases} cases; of their {self.pairs} true pairs found "
            f"{share:.4f}; unflagged pairs in all {self.given}, wrong {self.wrong} ({self.wrong_where_open} where open)"
        )


def compare(cases: int, *, hover: bool, resolution_s: float, most: int, seed: int) -> Comparison:
    result = Comparison(cases=cases)
    for number in range(cases):
        rng = np.random.default_rng([seed, number, hover, round(1000 * resolution_s)])
        law = draw_law(rng, hover=hover, resolution_s=resolution_s)
        case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(most)))))
        settled = probability_of_true_shift(case) >= SETTLED
        found = match_exposures(*stamps_of(case))
        true = case.true_event()
        matched = np.array([state is StillState.MATCHED for state in found.state])
        given = matched | np.array([state is StillState.DOUBLED for state in found.state])
        wrong = int(is_wrong(case, found.event, matched).sum())
        result.given += int(matched.sum())
        result.wrong += wrong
        if settled:
            result.settled += 1
            result.pairs += int(np.sum(true >= 0))
            result.found += int(np.sum(given & (true >= 0) & ~is_wrong(case, found.event, given)))
        else:
            result.wrong_where_open += wrong
    return result


KINDS = [(False, 0.01), (True, 0.01), (False, 1.0), (True, 1.0)]
NAMES = ["distance 10 ms", "hover 10 ms", "distance 1 s", "hover 1 s"]


@pytest.mark.parametrize("hover, resolution_s", KINDS[:3], ids=NAMES[:3])
def test_what_can_be_known_is_found(hover, resolution_s):
    result = compare(4, hover=hover, resolution_s=resolution_s, most=60, seed=21)
    assert result.settled >= 2
    assert result.found >= 0.95 * result.pairs
    assert result.wrong <= 1


@pytest.mark.slow
@pytest.mark.parametrize("hover, resolution_s", KINDS, ids=NAMES)
def test_what_can_be_known_is_found_in_many_cases(hover, resolution_s):
    result = compare(100, hover=hover, resolution_s=resolution_s, most=150, seed=22)
    print(result.line(NAMES[KINDS.index((hover, resolution_s))]))  # noqa: T201 - shown with -s
    bar = 0.995 if resolution_s < 0.1 else 0.97
    if hover:  # the law of the intervals, which the oracle knows, settles what the matcher rightly leaves open
        bar = 0.6 if resolution_s < 0.1 else 0.0
    assert result.found >= bar * result.pairs
    assert result.wrong <= (0 if resolution_s < 0.1 else 0.001 * result.given)
