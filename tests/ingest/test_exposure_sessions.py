"""Several sorties, logs and settings of the camera's clock; stills without time; file numbers that wrap."""

import numpy as np
import pytest
from test_exposure_matching import GPS0_NS, exposure_stamps, flight, still_stamps

from uavkit.core.exposures import StillState
from uavkit.core.gpstime import NO_TIME
from uavkit.ingest.exposure_matching import match_exposures
from uavkit.ingest.exposure_stamps import (
    ExposureStamps,
    StillStamps,
    file_order,
    merge_exposures,
    resolution_seen_ns,
    sessions_of,
)


def joined(*parts: StillStamps) -> StillStamps:
    """Return the stills of several parts, renumbered through."""
    count = sum(len(part.name) for part in parts)
    return StillStamps(
        name=tuple(f"DSC{k + 1:05d}.JPG" for k in range(count)),
        time_ns=np.concatenate([part.time_ns for part in parts]),
        resolution_ns=np.concatenate([part.resolution_ns for part in parts]),
    )


def right(result, true) -> tuple[int, int]:
    """Return how many of the used stills have their true event, and how many not."""
    used = result.used()
    good = result.event[used] == np.asarray(true)[used]
    return int(good.sum()), int((~good).sum())


def test_file_numbers_wrap():
    names = ["DSC09998.JPG", "DSC00002.JPG", "DSC09999.JPG", "DSC00001.JPG"]
    assert [names[k] for k in file_order(names)] == ["DSC09998.JPG", "DSC09999.JPG", "DSC00001.JPG", "DSC00002.JPG"]


def test_folders_come_first_and_in_their_own_order():
    names = ["101MEDIA/DJI_0001.JPG", "100MEDIA/DJI_0999.JPG", "99MEDIA/DJI_0500.JPG", "100MEDIA/DJI_0998.JPG"]
    assert file_order(names).tolist() == [2, 3, 1, 0]


def test_numbers_that_do_not_reach_both_ends_do_not_wrap():
    assert file_order(["IMG_7000.JPG", "IMG_0005.JPG", "IMG_0004.JPG"]).tolist() == [2, 1, 0]


@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
def test_two_stills_in_a_second_keep_the_order_of_their_numbers_over_a_wrap(resolution_s):
    rng = np.random.default_rng(9)
    times = 500.0 + np.cumsum(rng.uniform(0.4, 2.5, 80))
    numbers = [9960 + k if 9960 + k <= 9999 else k - 39 for k in range(80)]
    names = [f"DSC{number:05d}.JPG" for number in numbers]
    order = rng.permutation(80)
    stills = still_stamps(times[order] + 5.0, resolution_s, [names[k] for k in order])
    result = match_exposures(stills, exposure_stamps(times))
    good, bad = right(result, order)
    assert bad == 0
    assert good >= (78 if resolution_s < 0.1 else 40)


def test_sorties_with_one_clock_are_matched_together():
    one, two = flight(40, 1), flight(15, 2) + 1200.0
    times = np.concatenate([one, two])
    result = match_exposures(still_stamps(times + 3600.0, 1.0), exposure_stamps(times))
    assert len(result.clocks) == 1
    good, bad = right(result, np.arange(55))
    assert bad == 0
    assert good >= 52


@pytest.mark.parametrize("resolution_s", [0.01, 1.0])
@pytest.mark.parametrize("jump_s", [-24 * 365 * 86_400.0, -3600.0, 7200.0])
def test_a_clock_set_anew_between_sorties_is_noticed(jump_s, resolution_s):
    one, two = flight(50, 1), flight(40, 2) + 1200.0
    stills = joined(still_stamps(one + 3600.0, resolution_s), still_stamps(two + 3600.0 + jump_s, resolution_s))
    result = match_exposures(stills, exposure_stamps(np.concatenate([one, two])))
    good, bad = right(result, np.arange(90))
    assert bad == 0
    assert good >= 84
    assert len(result.clocks) == 2
    assert any("set anew" in note for note in result.notes)


def test_a_short_second_day_is_matched_by_the_clock_of_the_first():
    one, two = flight(60, 1), flight(6, 2) + 86_400.0
    times = np.concatenate([one, two])
    result = match_exposures(still_stamps(times * (1 + 5e-6) + 32_400.0, 0.01), exposure_stamps(times))
    good, bad = right(result, np.arange(66))
    assert bad == 0
    assert good >= 63


def test_a_log_of_part_of_the_flight_matches_that_part():
    times = flight(90)
    result = match_exposures(still_stamps(times + 60.0, 1.0), exposure_stamps(times[35:70]))
    true = np.where((np.arange(90) >= 35) & (np.arange(90) < 70), np.arange(90) - 35, -1)
    good, bad = right(result, true)
    assert bad == 0
    assert good >= 32
    assert sum(state is StillState.NO_EVENT for state in result.state) >= 52


def test_stills_without_time_are_placed_by_their_numbers():
    times = flight(60)
    stills = still_stamps(times + 60.0, 0.01)
    time_ns = stills.time_ns.copy()
    time_ns[[20, 40, 59]] = NO_TIME
    stills = StillStamps(name=stills.name, time_ns=time_ns, resolution_ns=stills.resolution_ns)
    result = match_exposures(stills, exposure_stamps(times))
    good, bad = right(result, np.arange(60))
    assert bad == 0
    assert good >= 56
    assert result.event[20] == 20  # the only event between its neighbours', given or named as possible
    assert result.state[59] is StillState.NO_TIME  # after the last: by number alone no one can tell


def test_runs_of_one_clock_setting():
    times = flight(20)
    stills = joined(still_stamps(times + 5000.0, 1.0), still_stamps(times, 1.0))
    runs = sessions_of(stills, 10_800.0)
    assert [len(run.rows) for run in runs] == [20, 20]
    assert runs[1].rows.tolist() == list(range(20, 40))


def test_numbers_that_contradict_all_times_are_not_believed():
    times = flight(40)
    names = [f"IMG_{number:04d}.JPG" for number in np.random.default_rng(1).permutation(40) + 100]
    stills = still_stamps(times, 1.0, names)
    (run,) = sessions_of(stills, 10_800.0)
    assert run.rows.tolist() == list(range(40))


def test_the_coarsest_unit_that_all_stamps_keep():
    stills = still_stamps(flight(20), 1.0)
    fine = StillStamps(name=stills.name, time_ns=stills.time_ns, resolution_ns=np.full(20, 10**6, dtype=np.int64))
    assert set(resolution_seen_ns(fine)) == {10**9}
    few = StillStamps(name=fine.name[:3], time_ns=fine.time_ns[:3], resolution_ns=fine.resolution_ns[:3])
    assert set(resolution_seen_ns(few)) == {10**6}


def labelled(times_s, name: str, sigma_s: float) -> ExposureStamps:
    stamps = exposure_stamps(times_s)
    count = len(stamps.label)
    return ExposureStamps(
        gps_ns=stamps.gps_ns, sigma_s=np.full(count, sigma_s), label=tuple(f"{name} {k}" for k in range(count))
    )


def test_the_same_exposures_told_by_two_logs_are_one():
    times = flight(30)
    rng = np.random.default_rng(2)
    late = labelled(np.delete(times, 4) + 0.18 + rng.normal(0, 0.01, 29), "b.tlog", 0.2)
    merged = merge_exposures([labelled(np.delete(times, 9), "a.BIN", 0.001), late], ["a.BIN", "b.tlog"])
    assert len(merged.stamps.label) == 30
    assert np.all(np.diff(merged.stamps.gps_ns) > 0)
    assert merged.log.tolist() == [0] * 9 + [1] + [0] * 20
    assert merged.row[9] == 8  # the exposure that a.BIN lacks; b.tlog lacks the fifth
    assert merged.stamps.label[9] == "b.tlog 8"
    assert merged.stamps.sigma_s[9] == 0.2
    assert any("28 of 29" in note and "+0.1" in note for note in merged.notes)


def test_an_exposure_that_only_a_lagging_log_tells_is_moved_by_the_lag():
    times = flight(30)
    late = labelled(times + 0.3, "b.tlog", 0.2)
    merged = merge_exposures([labelled(np.delete(times, 9), "a.BIN", 0.001), late], ["a.BIN", "b.tlog"])
    assert merged.stamps.gps_ns[9] == pytest.approx(GPS0_NS + times[9] * 1e9, abs=1e6)


def test_logs_of_different_flights_are_kept_both():
    one, two = flight(20, 1), flight(25, 2) + 600.0
    merged = merge_exposures([labelled(one, "a", 0.01), labelled(two, "b", 0.01)], ["a", "b"])
    assert len(merged.stamps.label) == 45
    assert merged.notes == ()


def test_events_without_time_are_not_merged():
    stamps = labelled(flight(5), "a", 0.01)
    lost = ExposureStamps(gps_ns=np.full(5, NO_TIME), sigma_s=stamps.sigma_s, label=stamps.label)
    assert len(merge_exposures([lost, stamps], ["a", "b"]).stamps.label) == 5
    assert len(merge_exposures([], []).stamps.label) == 0
