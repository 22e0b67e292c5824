"""Stills and exposure events: right pairs found, wrong ones never given unflagged, what is open said to be."""

import time
from dataclasses import dataclass, field

import numpy as np
import pytest
from exposure_cases import Case, by_index, by_nearest_time, draw_case, draw_law

from uavkit.core.exposures import StillState
from uavkit.core.gpstime import NO_TIME
from uavkit.ingest.exposure_matching import EventState, MatchOptions, match_exposures, offset_in_words
from uavkit.ingest.exposure_stamps import ExposureStamps, StillStamps

CASES = 60
"""Of each of three kinds in the ordinary run; of hover flights with whole seconds, which cost most, a third."""
MOST = 150
"""Exposures of a flight in the ordinary run; 1000 in the slow one."""
GPS0_NS = 1_400_000_000 * 10**9
NOISE_WIDTHS = 5.0
"""An event so many standard deviations of the noise from the still's true time tells its time: which one it is of two
that are no further apart cannot matter, and no one can know."""


def stamps_of(case: Case) -> tuple[StillStamps, ExposureStamps]:
    """Return a case as the matcher gets it; file numbers wrap."""
    n = len(case.still_s)
    resolution_ns = round(case.law.resolution_s * 1e9)
    cells = np.rint(case.still_s / case.law.resolution_s).astype(np.int64)
    stills = StillStamps(
        name=tuple(f"DSC{(9_990 + k) % 10_000:05d}.JPG" for k in range(n)),
        time_ns=GPS0_NS + cells * resolution_ns,
        resolution_ns=np.full(n, resolution_ns, dtype=np.int64),
    )
    return stills, exposure_stamps(case.event_s)


def exposure_stamps(times_s) -> ExposureStamps:
    count = len(times_s)
    gps_ns = GPS0_NS + np.rint(np.asarray(times_s) * 1e9).astype(np.int64)
    return ExposureStamps(
        gps_ns=gps_ns, sigma_s=np.full(count, np.nan), label=tuple(f"event {j}" for j in range(count))
    )


def still_stamps(times_s, resolution_s, names=None) -> StillStamps:
    count = len(times_s)
    cells = np.floor(np.asarray(times_s) / resolution_s + 1e-9).astype(np.int64)
    return StillStamps(
        name=tuple(names or (f"DSC{k + 1:05d}.JPG" for k in range(count))),
        time_ns=GPS0_NS + cells * round(resolution_s * 1e9),
        resolution_ns=np.full(count, round(resolution_s * 1e9), dtype=np.int64),
    )


@dataclass
class Tally:
    """Counts over many cases."""

    pairs: int = 0
    found: int = 0
    found_doubled: int = 0
    given: int = 0
    wrong: int = 0
    settled_cases: int = 0
    settled_pairs: int = 0
    wrong_cases: list[int] = field(default_factory=list)
    index: tuple[int, int, int] = (0, 0, 0)
    """Right, wrong, left out."""
    nearest: tuple[int, int, int] = (0, 0, 0)
    stated: list[np.ndarray] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)

    def line(self, name: str) -> str:
        return (
            f"{name}: {self.pairs} pairs, {self.settled_cases} cases settled; ours right {self.found} "
            f"(+{self.found_doubled} flagged as doubled), wrong {self.wrong}, left out "
            f"{self.pairs - self.found - self.found_doubled}; by index right, wrong, left out {self.index}; "
            f"by nearest time {self.nearest}"
        )


def is_wrong(case: Case, event, chosen) -> np.ndarray:
    """Return which of the chosen stills got an event that does not tell their time."""
    apart_s = np.abs(case.event_s[event] - case.taken_s)
    return chosen & (event != case.true_event()) & (apart_s > NOISE_WIDTHS * case.law.jitter_s)


def score(case: Case, event, tally: tuple[int, int, int]) -> tuple[int, int, int]:
    true, chosen = case.true_event(), event >= 0
    right = int(np.sum(chosen & ~is_wrong(case, event, chosen)))
    return tally[0] + right, tally[1] + int(np.sum(chosen)) - right, tally[2] + int(np.sum((true >= 0) & ~chosen))


def take(case: Case, tally: Tally, seed: int) -> None:
    """Match a case and count."""
    result = match_exposures(*stamps_of(case))
    true = case.true_event()
    matched = np.array([state is StillState.MATCHED for state in result.state])
    doubled = np.array([state is StillState.DOUBLED for state in result.state])
    right = (true >= 0) & (result.event == true)
    wrong = int(is_wrong(case, result.event, matched).sum())
    tally.pairs += int(np.sum(true >= 0))
    tally.found += int(np.sum(matched & right))
    tally.found_doubled += int(np.sum(doubled & right))
    tally.given += int(matched.sum())
    tally.wrong += wrong
    tally.wrong_cases += [seed] * bool(wrong)
    if result.settled:
        tally.settled_cases += 1
        tally.settled_pairs += int(np.sum(true >= 0))
    tally.index = score(case, by_index(case), tally.index)
    tally.nearest = score(case, by_nearest_time(case), tally.nearest)
    used = matched | doubled
    tally.stated.append(result.probability[used])
    tally.right.append(~is_wrong(case, result.event, used)[used])


def run(cases: int, *, hover: bool, resolution_s: float, most: int = 1000, seed: int = 0) -> Tally:
    """Match so many random cases of 30 to ``most`` exposures."""
    tally = Tally()
    for number in range(cases):
        rng = np.random.default_rng([seed, number, hover, round(1000 * resolution_s)])
        law = draw_law(rng, hover=hover, resolution_s=resolution_s)
        take(draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(most))))), tally, number)
    return tally


@pytest.mark.parametrize("hover", [False, True], ids=["distance", "hover"])
def test_no_wrong_pair_with_stamps_of_10_ms(hover):
    tally = run(CASES, hover=hover, resolution_s=0.01, most=MOST)
    print(tally.line(f"10 ms, {'hover' if hover else 'distance'}"))  # noqa: T201 - shown with -s
    assert tally.wrong == 0, tally.wrong_cases
    assert tally.settled_cases >= (CASES // 2 if hover else CASES)
    assert tally.found + tally.found_doubled >= 0.98 * tally.settled_pairs


@pytest.mark.parametrize("hover", [False, True], ids=["distance", "hover"])
def test_hardly_a_wrong_pair_with_stamps_of_1_s(hover):
    tally = run(CASES // 3 if hover else CASES, hover=hover, resolution_s=1.0, most=500 if hover else MOST)
    print(tally.line(f"1 s, {'hover' if hover else 'distance'}"))  # noqa: T201 - shown with -s
    assert tally.wrong <= max(0.001 * tally.given, 3.0), tally.wrong_cases
    assert tally.settled_cases >= (2 if hover else CASES - 4)
    # some pairs no one can tell (two stills within the second of one event): against what can be known at all, see
    # the comparison with the exhaustive search
    assert tally.found + tally.found_doubled >= 0.95 * tally.settled_pairs


def test_probabilities_are_calibrated():
    """Of the pairs stated at p, no more than 1 - p are wrong, within the scatter of their number."""
    tally = run(40, hover=False, resolution_s=1.0, most=200, seed=1)
    stated, right = np.concatenate(tally.stated), np.concatenate(tally.right)
    expected = float(np.sum(1.0 - stated))
    assert int(np.sum(~right)) <= expected + 3.0 * np.sqrt(expected) + 1.0


@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
@pytest.mark.parametrize("hover", [False, True], ids=["distance", "hover"])
def test_events_of_another_flight_are_not_matched(hover, resolution_s):
    for number in range(12):
        rng = np.random.default_rng([11, number])
        law = draw_law(rng, hover=hover, resolution_s=resolution_s)
        one, other = draw_case(rng, law, 80), draw_case(rng, law, 90)
        result = match_exposures(stamps_of(one)[0], stamps_of(other)[1])
        assert not result.settled
        assert len(result.used()) == 0
        assert StillState.MATCHED not in result.state


def test_a_regular_hover_is_open_and_said_to_be():
    times = 100.0 + 2.0 * np.arange(33)
    result = match_exposures(still_stamps(times + 3.0, 0.01), exposure_stamps(times))
    assert not result.settled
    assert set(result.state) == {StillState.AMBIGUOUS}
    assert any("not matched" in note for note in result.notes)


def flight(count=60, seed=3):
    rng = np.random.default_rng(seed)
    return 500.0 + np.cumsum(rng.uniform(2.0, 5.0, count))


@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
@pytest.mark.parametrize("offset_s", [0.0, 32_402.3, -7200.0, 400 * 86_400.0, -26 * 365 * 86_400.0])
def test_any_offset_of_the_clock_is_found(offset_s, resolution_s):
    times = flight()
    result = match_exposures(still_stamps(times * (1 + 80e-6) + offset_s, resolution_s), exposure_stamps(times))
    assert result.settled
    assert np.mean(result.event[1:-1] == np.arange(60)[1:-1]) > 0.95
    assert all(result.event[row] == row for row in result.used())
    (clock,) = result.clocks
    since_s = (clock.reference_gps_ns - GPS0_NS) * 1e-9
    assert abs(clock.offset_s - offset_s - 80e-6 * since_s) < 4.0 * clock.sigma_offset_s
    assert abs(clock.drift_ppm - 80.0) < 4.0 * clock.sigma_drift_ppm
    assert clock.sigma_offset_s < (0.01 if resolution_s < 0.1 else 0.1)


def test_the_clock_tells_gps_times_of_camera_times():
    times = flight()
    stills = still_stamps(times + 3600.0, 0.01)
    (clock,) = match_exposures(stills, exposure_stamps(times)).clocks
    apart_s = (clock.gps_ns(stills.time_ns) - GPS0_NS) * 1e-9 - times
    assert np.all(np.abs(apart_s + 0.005) < 0.02)  # stamps are cut down: on average half of 10 ms early
    assert clock.residual_s < 0.01


def test_a_strong_drift_over_a_long_flight():
    """150 ppm over half an hour: half a pair's noise at the wrong sign would be 0.3 s at either end."""
    times = flight(500, seed=8)
    stills = still_stamps(times * (1.0 - 150e-6) + 3600.0, 0.01)
    result = match_exposures(stills, exposure_stamps(times))
    assert len(result.used()) >= 498
    assert np.array_equal(result.event[result.used()], result.used())
    (clock,) = result.clocks
    assert abs(clock.drift_ppm + 150.0) < 4.0 * clock.sigma_drift_ppm
    apart_s = (clock.gps_ns(stills.time_ns) - GPS0_NS) * 1e-9 - times
    assert np.all(np.abs(apart_s + 0.005) < 0.012)


def test_a_run_in_which_nearly_nothing_fits_is_left_open():
    """Most stills without event and most events without still: rates stay rates."""
    rng = np.random.default_rng([20007, 3, 1, 1000])
    law = draw_law(rng, hover=True, resolution_s=1.0)
    case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(1000)))))
    result = match_exposures(*stamps_of(case))
    assert np.all((result.probability >= 0.0) & (result.probability <= 1.0 + 1e-9))


def test_doubled_false_and_lone_events_are_named_with_their_reasons():
    times = flight()
    events = np.sort(np.concatenate([times, [times[20] + 0.15], [0.5 * (times[40] + times[41])]]))
    stills = np.delete(times, 30)
    result = match_exposures(still_stamps(stills + 7.0, 0.01), exposure_stamps(events))
    assert result.event_state[21] is EventState.DOUBLED
    assert result.event_reason[21] == "doubled: 0.15 s after event 20"
    assert result.event_state[42] is EventState.NO_STILL
    assert "no still within" in result.event_reason[42]
    assert result.event_state[31] is EventState.NO_STILL
    unused = [j for j, state in enumerate(result.event_state) if state is not EventState.MATCHED]
    assert set(unused) >= {21, 42, 31}
    assert all(result.event_reason[j] for j in unused)
    assert all(result.event_reason[j] == "" for j in range(len(events)) if j not in unused)


def test_an_exposure_told_twice_is_flagged_where_the_stamp_cannot_tell():
    times = flight()
    row = 20 + int(np.argmin(np.abs(times[20:40] % 1.0 - 0.4)))  # both events within the same second
    events = np.sort(np.append(times, times[row] + 0.2))
    result = match_exposures(still_stamps(times + 7.0, 1.0), exposure_stamps(events))
    assert result.state[row] is StillState.DOUBLED
    assert result.event[row] == row
    assert result.spread_s[row] == pytest.approx(0.2)


def test_the_seeds_own_case():
    """33 waypoints, 33 stills, and of the video 31 shutter events with 2 false ones."""
    rng = np.random.default_rng(5)
    times = 60.0 + np.cumsum(rng.integers(70, 111, 33) * 1001 / 30000)
    found = np.sort(np.concatenate([np.delete(times, [7, 22]), [times[3] + 1.1, times[18] + 1.4]]))
    result = match_exposures(still_stamps(times + 5000.0, 1.0), exposure_stamps(found + rng.normal(0, 0.01, 33)))
    assert result.settled
    true = {row: int(np.argmin(np.abs(found - times[row]))) for row in range(33) if row not in (7, 22)}
    assert all(true[row] == result.event[row] for row in result.used().tolist())
    assert len(result.used()) >= 29


def test_a_stated_subsec_that_is_always_zero_is_not_believed():
    times = flight()
    coarse = still_stamps(times + 7.0, 1.0)
    lying = StillStamps(name=coarse.name, time_ns=coarse.time_ns, resolution_ns=np.full(60, 10_000_000, dtype=np.int64))
    result = match_exposures(lying, exposure_stamps(times))
    assert len(result.used()) > 55
    assert any("coarser than they state" in note for note in result.notes)


def test_nothing_to_match_is_told():
    none = ExposureStamps(gps_ns=np.zeros(0, dtype=np.int64), sigma_s=np.zeros(0), label=())
    stills = still_stamps(flight(5), 1.0)
    result = match_exposures(stills, none)
    assert not result.settled
    assert set(result.state) == {StillState.NO_EVENT}
    untimed = StillStamps(name=stills.name, time_ns=np.full(5, NO_TIME), resolution_ns=stills.resolution_ns)
    result = match_exposures(untimed, exposure_stamps(flight(5)))
    assert set(result.state) == {StillState.NO_TIME}
    empty = StillStamps(name=(), time_ns=np.zeros(0, dtype=np.int64), resolution_ns=np.zeros(0, dtype=np.int64))
    assert match_exposures(empty, none).clocks == ()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_stills_alone_are_never_matched(count):
    times = flight(count)
    for resolution_s in (0.01, 1.0):
        result = match_exposures(still_stamps(times, resolution_s), exposure_stamps(times))
        assert StillState.MATCHED not in result.state


def test_options_are_checked():
    with pytest.raises(ValueError):
        MatchOptions(jitter_s=0.0)
    with pytest.raises(ValueError):
        MatchOptions(wanted_probability=1.0)


@pytest.mark.parametrize(
    "offset_s, words",
    [
        (32_402.3, "9 h 0 min 2.3 s ahead of UTC: it runs on local time"),
        (-0.25, "0.2 s behind UTC"),
        (-90_000.0, "1 d 1 h 0 min 0.0 s behind UTC"),
    ],
)
def test_the_offset_in_words(offset_s, words):
    assert offset_in_words(offset_s) == words


@pytest.mark.slow
@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
@pytest.mark.parametrize("hover", [False, True], ids=["distance", "hover"])
def test_ten_thousand_cases(hover, resolution_s):
    """2500 of each kind, some two hours in all."""
    tally = run(2500, hover=hover, resolution_s=resolution_s, seed=7)
    print(tally.line(f"{resolution_s} s, {'hover' if hover else 'distance'}"))  # noqa: T201 - shown with -s
    assert tally.wrong <= (1e-5 if resolution_s < 0.1 else 1e-3) * tally.given, tally.wrong_cases


@pytest.mark.parametrize("resolution_s, most_s", [(0.01, 1.0), (1.0, 1.0)])
def test_a_thousand_stills_take_less_than_a_second(resolution_s, most_s):
    """The processor's time, the least of three: the machine may be busy with something else."""
    rng = np.random.default_rng(5)
    case = draw_case(rng, draw_law(rng, hover=False, resolution_s=resolution_s), 1000)
    stills, events = stamps_of(case)
    match_exposures(stills, events)
    used_s = []
    for _ in range(3):
        begin = time.process_time()
        match_exposures(stills, events)
        used_s.append(time.process_time() - begin)
    assert min(used_s) < most_s


def test_sums_too_small_to_be_told_are_no_sums():
    """A flight of which a long part has no events: what is left of it fits nowhere, and the sums underflow."""
    rng = np.random.default_rng([7001, 2, 0, 1000])
    law = draw_law(rng, hover=False, resolution_s=1.0)
    case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(1000)))))
    result = match_exposures(*stamps_of(case))
    assert np.all((result.probability >= 0.0) & (result.probability <= 1.0 + 1e-9))
    matched = np.array([state is StillState.MATCHED for state in result.state])
    assert int(is_wrong(case, result.event, matched).sum()) <= 1


def test_a_right_shift_that_no_vote_names_is_found():
    """A hover of 903 stills at intervals even to 5 ms: the votes began some twenty stations beside the truth."""
    rng = np.random.default_rng([30007, 19, 1, 10])
    law = draw_law(rng, hover=True, resolution_s=0.01)
    case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(1000)))))
    result = match_exposures(*stamps_of(case))
    matched = np.array([state is StillState.MATCHED for state in result.state])
    assert matched.sum() > 700
    assert not is_wrong(case, result.event, matched).any()


def test_a_nearly_constant_hover_is_not_settled_by_chance():
    """Intervals constant to 6 ms, noise of 24 ms: chance makes a wrong shift some thousand times likelier."""
    rng = np.random.default_rng([20017, 12, 1, 10])
    law = draw_law(rng, hover=True, resolution_s=0.01)
    case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(1000)))))
    result = match_exposures(*stamps_of(case))
    matched = np.array([state is StillState.MATCHED for state in result.state])
    assert int(is_wrong(case, result.event, matched).sum()) == 0


def test_a_long_hover_of_which_the_votes_name_only_wrong_shifts():
    """900 regular exposures and stamps of 1 s: the true shift is found from its neighbours, or all is left open."""
    rng = np.random.default_rng([9002, 13, 1, 1000])
    law = draw_law(rng, hover=True, resolution_s=1.0)
    case = draw_case(rng, law, int(np.exp(rng.uniform(np.log(30), np.log(1000)))))
    result = match_exposures(*stamps_of(case))
    matched = np.array([state is StillState.MATCHED for state in result.state])
    assert int(is_wrong(case, result.event, matched).sum()) <= 1
