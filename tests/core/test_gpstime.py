"""GPS time: leap seconds at their dates, weeks that roll over, and nothing lost on the way to UTC and back."""

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavkit.core.gpstime import (
    LEAP_SECOND_DATES,
    WEEK_NS,
    gps_time_ns_from_utc,
    gps_time_ns_from_week,
    leap_seconds,
    utc_from_gps_time_ns,
)

SECOND_NS = 1_000_000_000
NEAR_A_LEAP = st.builds(
    lambda date, microseconds: date + timedelta(microseconds=microseconds),
    st.sampled_from(LEAP_SECOND_DATES),
    st.integers(-3_000_000, 3_000_000),
)
ANY_TIME = st.datetimes(datetime(1980, 1, 6), datetime(2040, 1, 1)).map(lambda naive: naive.replace(tzinfo=UTC))


@pytest.mark.parametrize(
    ("utc", "seconds"),
    [
        ("1980-01-06T00:00:00", 0),
        ("1981-06-30T23:59:59", 0),
        ("1981-07-01T00:00:00", 1),
        ("1999-01-01T00:00:00", 13),
        ("2005-12-31T23:59:59.999999", 13),
        ("2012-06-30T23:59:59", 15),
        ("2012-07-01T00:00:00", 16),
        ("2016-12-31T23:59:59", 17),
        ("2017-01-01T00:00:00", 18),
        ("2026-08-01T12:00:00", 18),
    ],
)
def test_gps_minus_utc_at_known_dates(utc: str, seconds: int) -> None:
    assert leap_seconds(datetime.fromisoformat(utc + "+00:00")) == seconds


def test_known_instants() -> None:
    assert gps_time_ns_from_utc(datetime(1980, 1, 6, tzinfo=UTC)) == 0
    # 2017-01-01 is 13 510 days after the epoch; 18 leap seconds.
    assert gps_time_ns_from_utc(datetime(2017, 1, 1, tzinfo=UTC)) == (13_510 * 86_400 + 18) * SECOND_NS


@given(st.one_of(NEAR_A_LEAP, ANY_TIME))
def test_utc_goes_to_gps_time_and_back(utc: datetime) -> None:
    assert utc_from_gps_time_ns(gps_time_ns_from_utc(utc)) == utc


@given(NEAR_A_LEAP, st.integers(0, 4_000_000))
def test_across_a_leap_second_gps_time_runs_on_by_one_second_more(utc: datetime, microseconds: int) -> None:
    later = utc + timedelta(microseconds=microseconds)
    crossed = leap_seconds(later) - leap_seconds(utc)
    passed = gps_time_ns_from_utc(later) - gps_time_ns_from_utc(utc)
    assert passed == microseconds * 1000 + crossed * SECOND_NS


@pytest.mark.parametrize("date", LEAP_SECOND_DATES)
def test_inside_a_leap_second_the_following_second_is_returned(date: datetime) -> None:
    after = gps_time_ns_from_utc(date)
    assert utc_from_gps_time_ns(after - SECOND_NS // 2) == date + timedelta(seconds=0.5)
    assert utc_from_gps_time_ns(after - SECOND_NS) == date
    assert utc_from_gps_time_ns(after - SECOND_NS - 1000) == date - timedelta(microseconds=1)
    assert utc_from_gps_time_ns(after) == date


@given(st.integers(0, 3000), st.integers(0, WEEK_NS - 1))
def test_week_and_time_of_week(week: int, time_of_week_ns: int) -> None:
    assert divmod(gps_time_ns_from_week(week, time_of_week_ns), WEEK_NS) == (week, time_of_week_ns)


@pytest.mark.parametrize(("week", "utc"), [(1024, "1999-08-21T23:59:47+00:00"), (2048, "2019-04-06T23:59:42+00:00")])
def test_weeks_at_which_the_ten_bit_counter_rolled_over(week: int, utc: str) -> None:
    assert utc_from_gps_time_ns(gps_time_ns_from_week(week, 0)) == datetime.fromisoformat(utc)
    last = gps_time_ns_from_week(week - 1, WEEK_NS - 1)
    assert gps_time_ns_from_week(week, 0) - last == 1


def test_nanoseconds_are_kept_in_gps_time_and_rounded_down_in_utc() -> None:
    time_ns = gps_time_ns_from_week(2400, 123_456_789)
    assert time_ns % 1000 == 789
    assert utc_from_gps_time_ns(time_ns).microsecond == 123_456


def test_local_time_must_say_so() -> None:
    tokyo = timezone(timedelta(hours=9))
    assert gps_time_ns_from_utc(datetime(2017, 1, 1, 9, tzinfo=tokyo)) == gps_time_ns_from_utc(
        datetime(2017, 1, 1, tzinfo=UTC)
    )
    with pytest.raises(ValueError, match="no time zone"):
        gps_time_ns_from_utc(datetime(2017, 1, 1))
    with pytest.raises(ValueError, match="before the GPS epoch"):
        gps_time_ns_from_utc(datetime(1979, 12, 31, tzinfo=UTC))
