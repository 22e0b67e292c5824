"""Alignment of time sequences: never a shifted pair, whatever is missing or extra."""

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.ingest.sequence_alignment import AlignmentOptions, align_by_order, align_sequences


def flight(rng, *, resolution_s, exposures=33, lost=0.03, false=0.03, regular=False):
    """Times by both clocks and, for each entry, the exposure it truly is (-1 for a false one)."""
    gaps = np.full(exposures - 1, 3.0) if regular else rng.integers(70, 111, exposures - 1) * 1001 / 30000
    true = np.concatenate([[0.0], np.cumsum(gaps)]) + rng.uniform(5, 50)
    first, second = [(t, k) for k, t in enumerate(true) if rng.random() > lost], []
    for k, t in enumerate(true):
        if rng.random() > lost:
            second.append((t + rng.normal(0, 0.012), k))
        if rng.random() < false:
            second.append((t + rng.uniform(0.5, 2.0), -1))
    offset, drift = rng.uniform(-1e5, 1e5), rng.uniform(-100e-6, 100e-6)
    stamps = np.array([t * (1 + drift) + offset for t, _ in first])
    stamps = np.floor(stamps / resolution_s) * resolution_s
    second.sort()
    return stamps, np.array([k for _, k in first]), np.array([t for t, _ in second]), np.array([k for _, k in second])


def count_wrong(resolution_s, cases, seed, **kinds):
    rng = np.random.default_rng(seed)
    wrong = right = 0
    for _ in range(cases):
        a, true_a, b, true_b = flight(rng, resolution_s=resolution_s, **kinds)
        result = align_sequences(a, b, AlignmentOptions(first_resolution_s=resolution_s))
        good = true_a[result.pairs[:, 0]] == true_b[result.pairs[:, 1]]
        wrong, right = wrong + int((~good).sum()), right + int(good.sum())
    return wrong, right


def test_no_wrong_pair_with_stamps_of_10_ms():
    wrong, right = count_wrong(0.01, 150, 1)
    assert wrong == 0
    assert right > 150 * 33 * 0.97**2 * 0.97  # nearly all that exist on both sides are found


def test_hardly_a_wrong_pair_with_stamps_of_one_second():
    wrong, right = count_wrong(1.0, 150, 2)
    assert wrong <= 0.001 * right
    assert right > 150 * 33 * 0.97**2 * 0.9


def test_no_wrong_pair_when_many_are_lost_on_both_sides():
    wrong, right = count_wrong(0.01, 60, 3, lost=0.2, false=0.1)
    assert wrong <= 0.001 * right
    assert right > 60 * 33 * 0.8**2 * 0.9


def test_short_sequences_are_left_open_rather_than_guessed():
    wrong, right = count_wrong(1.0, 150, 4, exposures=4, lost=0.1, false=0.1)
    assert wrong <= 0.01 * max(right, 100)


@pytest.mark.parametrize("lost", [0, 15, 32])
@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
def test_regular_intervals_are_never_shifted(lost, resolution_s):
    stamps = 100.0 + 3.0 * np.arange(33)
    events = np.delete(stamps - 77.3, lost)
    result = align_sequences(stamps, events, AlignmentOptions(first_resolution_s=resolution_s))
    true = np.delete(np.arange(33), lost)
    assert all(true[j] == i for i, j in result.pairs)
    if lost in (0, 32):  # which end is missing cannot be told by time
        assert len(result.pairs) == 0
        assert len(result.first_ambiguous) >= 32


def test_equal_counts_at_regular_intervals_stay_open():
    result = align_sequences(3.0 * np.arange(20), 3.0 * np.arange(20) + 9.0, AlignmentOptions())
    assert len(result.pairs) == 0
    assert len(result.first_ambiguous) == 20


def test_content_settles_regular_intervals():
    evidence = np.full((20, 20), -6.0)
    evidence[np.arange(18), np.arange(18) + 2] = 6.0
    result = align_sequences(3.0 * np.arange(20), 3.0 * np.arange(20) + 9.0, AlignmentOptions(), evidence)
    assert [tuple(p) for p in result.pairs] == [(i, i + 2) for i in range(18)]
    assert result.first_unpaired == (18, 19)
    assert result.second_unpaired == (0, 1)


def test_offset_and_drift_are_estimated():
    rng = np.random.default_rng(5)
    b = np.cumsum(rng.uniform(2.3, 3.7, 200))
    a = b * (1 + 80e-6) + 1234.5
    result = align_sequences(np.floor(a * 100) / 100, b, AlignmentOptions(first_resolution_s=0.01))
    assert len(result.pairs) == 200
    assert result.clock.drift_ppm == pytest.approx(80, abs=5)
    assert result.clock.offset_s == pytest.approx(1234.5, abs=0.005)


def test_a_doubled_event_is_not_guessed_at_whole_seconds_but_told_at_10_ms():
    rng = np.random.default_rng(6)
    b = np.cumsum(rng.uniform(2.3, 3.7, 33))
    doubled = np.sort(np.append(b, b[10] + 0.15))
    fine = align_sequences(np.floor((b + 7.77) * 100) / 100, doubled, AlignmentOptions(first_resolution_s=0.01))
    assert fine.second_unpaired == (11,)
    assert len(fine.pairs) == 33


def test_backward_time_and_empty_sequences():
    with pytest.raises(InputError, match="backwards at entry 2"):
        align_sequences(np.array([0.0, 2.0, 1.0]), np.array([0.0]), AlignmentOptions())
    nothing = align_sequences(np.array([]), np.array([1.0, 2.0]), AlignmentOptions())
    assert nothing.second_unpaired == (0, 1)
    assert nothing.pairs.shape == (0, 2)


def test_alignment_by_order_alone():
    equal = align_by_order(np.zeros((5, 5)), AlignmentOptions())
    assert len(equal.pairs) == 0  # without evidence nothing is settled
    strong = align_by_order(np.where(np.eye(5) > 0, 6.0, -6.0), AlignmentOptions())
    assert [tuple(p) for p in strong.pairs] == [(i, i) for i in range(5)]
