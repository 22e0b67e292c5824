"""Clock fits against simulated clocks."""

import numpy as np
import pytest

from uavkit.core.clock_fit import fit_clock
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc, gps_times_ns_from_unix_ns, leap_seconds_at

START_NS = 1_478_000_000 * 10**9


def _pairs(rng, seconds=600, rate=5, drift=0.0, delay_s=0.0, bend=None):
    boot_s = np.arange(seconds * rate) / rate + 12.3
    true_s = boot_s * (1.0 + drift)
    if bend is not None:
        true_s = true_s + np.where(boot_s > bend[0], (boot_s - bend[0]) * bend[1], 0.0)
    late_s = delay_s * rng.exponential(1.0, len(boot_s))
    return np.rint((boot_s + late_s) * 1e9).astype(np.int64), START_NS + np.rint(true_s * 1e9).astype(np.int64)


@pytest.mark.parametrize("drift", [0.0, 50e-6, -0.0039])
def test_offset_and_drift_are_found(drift):
    boot, gps = _pairs(np.random.default_rng(1), drift=drift, delay_s=0.003)
    fit = fit_clock(boot, gps)
    assert len(fit.segments) == 1
    assert fit.drift_ppm == pytest.approx(drift * 1e6, abs=1.0)
    error_s = (fit.gps_ns(boot) - gps) * 1e-9
    assert np.percentile(np.abs(error_s), 50) < 0.003  # the delays' own median


def test_late_messages_and_unset_clocks_do_not_count():
    rng = np.random.default_rng(2)
    boot, gps = _pairs(rng)
    boot[rng.choice(len(boot), 300, replace=False)] += rng.integers(10**8, 9 * 10**8, 300)
    gps[:40] = 0
    fit = fit_clock(boot, gps)
    assert fit.rejected == 40
    assert abs(fit.gps_ns(np.array([boot[1000]]))[0] - (START_NS + boot[1000])) < 10**6


def test_a_bend_is_followed_by_pieces():
    boot, gps = _pairs(np.random.default_rng(3), delay_s=0.002, bend=(300.0, 0.002))
    fit = fit_clock(boot, gps)
    assert len(fit.segments) >= 2
    assert np.abs((fit.gps_ns(boot) - gps) * 1e-9).max() < 0.05  # one line would be off by 0.15 s
    assert fit.segments[0].drift_ppm == pytest.approx(0.0, abs=100.0)


def test_a_step_is_found_where_it_is():
    boot, gps = _pairs(np.random.default_rng(4), delay_s=0.002)
    gps[2000:] += 400_000_000
    fit = fit_clock(boot, gps)
    assert len(fit.segments) == 2
    assert fit.segments[1].begin_boot_ns == boot[2000]


def test_few_pairs_none_and_unknown_times():
    assert fit_clock(np.array([NO_TIME]), np.array([5])) is None
    fit = fit_clock(np.array([10, NO_TIME]), np.array([START_NS, START_NS]))
    assert fit.gps_ns(np.array([10, 20, NO_TIME])).tolist() == [START_NS, START_NS + 10, NO_TIME]


def test_sigma_is_that_of_the_offset():
    errors, sigmas = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        boot_s = np.arange(100) * 0.2
        boot = np.rint((boot_s + rng.normal(0, 0.01, 100)) * 1e9).astype(np.int64)
        fit = fit_clock(boot, START_NS + np.rint(boot_s * 1e9).astype(np.int64))
        segment = fit.segments[0]
        errors.append((segment.offset_ns - START_NS) * 1e-9)
        sigmas.append(segment.sigma_s)
    assert 0.8 < np.std(errors) / np.mean(sigmas) < 1.25


def test_unix_times_cross_the_leap_second_of_2017():
    from datetime import UTC, datetime, timedelta

    moments = [datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC) + timedelta(seconds=s) for s in range(3)]
    unix = np.array([int(moment.timestamp()) * 10**9 for moment in moments] + [NO_TIME])
    expected = [gps_time_ns_from_utc(moment) for moment in moments] + [NO_TIME]
    assert gps_times_ns_from_unix_ns(unix).tolist() == expected
    assert [leap_seconds_at(time) for time in expected[:3]] == [17, 18, 18]
    assert gps_times_ns_from_unix_ns(np.array([315_964_800 * 10**9])).tolist() == [0]


def test_two_pairs_that_contradict_each_other() -> None:
    """The mean of both is near neither: one is kept."""
    boot = np.array([10, 20], dtype=np.int64) * 10**9
    clock = fit_clock(boot, boot + np.array([0, 500], dtype=np.int64) * 10**9)
    assert clock is not None
    assert clock.rejected == 1
