"""GPS time of u-blox epochs: weeks, leap seconds, dates that have rolled over, times not known."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.formats import receiver_bytes as made
from uavkit.core.flight_log import FlightLog
from uavkit.core.gpstime import NO_TIME, WEEK_NS, gps_time_ns_from_utc, gps_time_ns_from_week, utc_from_gps_time_ns
from uavkit.core.progress import silent
from uavkit.formats import ubx
from uavkit.formats.receiver_times import EARLIEST_NS, dates, gps_from_utc_fields, unrolled

Fields = tuple[int, int, int, int, int, int]


def read(folder: Path, *messages: bytes) -> FlightLog:
    path = folder / "receiver.ubx"
    path.write_bytes(b"".join(messages))
    return ubx.read_log(path, silent)


def fields_of(utc: datetime) -> Fields:
    return (utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second)


def pvt_at(utc: datetime, leap: int | None = None, **columns: Any) -> bytes:
    """Return a PVT of an instant as a receiver with a count of leap seconds of its own shows it."""
    gps_ns = gps_time_ns_from_utc(utc)
    told = utc
    if leap is not None:
        told = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(microseconds=gps_ns // 1000) - timedelta(seconds=leap)
    return made.pvt(gps_ns % WEEK_NS // 1_000_000, fields_of(told), nano=told.microsecond * 1000, **columns)


def test_weeks_end_between_epochs(tmp_path: Path) -> None:
    begin = gps_time_ns_from_week(made.WEEK, 0)
    times = begin + np.arange(-3, 4) * 200_000_000
    messages = [pvt_at(utc_from_gps_time_ns(int(time))) for time in times]
    assert read(tmp_path, *messages).fix_table.when.gps_ns.tolist() == times.tolist()


def test_fraction_of_a_millisecond_and_seconds_rounded_up(tmp_path: Path) -> None:
    """UTC's fields are rounded to 1/100 s and ``nano`` may be negative."""
    table = read(
        tmp_path,
        made.pvt(0, (2026, 1, 3, 23, 59, 42), nano=-259_828),
        made.pvt(200, (2026, 1, 3, 23, 59, 42), nano=200_000_417),
    ).fix_table
    begin = gps_time_ns_from_week(made.WEEK, 0)
    assert table.when.gps_ns.tolist() == [begin - 259_828, begin + 200_000_417]


@pytest.mark.parametrize("leap", [0, 15, 16, 17, 20])
def test_wrong_count_of_leap_seconds_does_no_harm(tmp_path: Path, leap: int) -> None:
    utc = datetime(2026, 1, 7, 3, 4, 5, 200_000, tzinfo=UTC)
    for instant in (utc, datetime(2026, 1, 10, 23, 59, 41, 800_000, tzinfo=UTC)):
        for valid in (3, 7):
            log = read(tmp_path, pvt_at(instant, leap, valid=valid))
            assert log.fix_table.when.gps_ns.tolist() == [gps_time_ns_from_utc(instant)]
            assert any(f"of {leap} leap seconds" in note for note in log.notes) == (valid == 7)


def test_across_the_leap_second_of_2017(tmp_path: Path) -> None:
    first = gps_time_ns_from_utc(datetime(2016, 12, 31, 23, 59, 58, tzinfo=UTC))
    shown: list[Fields] = [(2016, 12, 31, 23, 59, 58), (2016, 12, 31, 23, 59, 59), (2016, 12, 31, 23, 59, 60)]
    shown += [(2017, 1, 1, 0, 0, 0), (2017, 1, 1, 0, 0, 1)]
    times = [first + count * 10**9 for count in range(5)]
    messages = [made.pvt(time % WEEK_NS // 10**6, utc) for time, utc in zip(times, shown, strict=True)]
    log = read(tmp_path, *messages)
    assert log.fix_table.when.gps_ns.tolist() == times
    assert log.notes == ()
    late = [made.pvt(time % WEEK_NS // 10**6, utc, nano=-300) for time, utc in zip(times[2:4], shown[3:], strict=True)]
    log = read(tmp_path, *messages[:2], *late, pvt_at(datetime(2017, 1, 1, 0, 5, tzinfo=UTC), leap=17))
    expected = [*times[:2], times[2] - 300, times[3] - 300, times[3] + 300 * 10**9]
    assert log.fix_table.when.gps_ns.tolist() == expected
    assert len(log.notes) == 1
    assert "of 17 leap seconds in 1 of 5 epochs, the dated table has 18" in log.notes[0]


def test_week_from_sol_or_timegps_needs_no_utc(tmp_path: Path) -> None:
    position = made.posllh(5000, 1, 2, (3, 4), (5, 6))
    for message in (made.sol(5000, 321, made.WEEK, 3, 0x0D), made.timegps(5000, 321, made.WEEK, 18)):
        table = read(tmp_path, position, message).fix_table
        assert table.when.gps_ns.tolist() == [gps_time_ns_from_week(made.WEEK, 5_000_000_321)]


def test_date_from_timeutc_of_the_same_epoch(tmp_path: Path) -> None:
    utc = (2026, 1, 3, 23, 59, 47)
    for message in (made.timeutc(5000, utc, -1234), made.timeutc(5000, utc, -1234, valid=3)):
        position = made.posllh(5000, 1, 2, (3, 4), (5, 6))
        table = read(tmp_path, position, made.status(5000, 3, 0x0D), message).fix_table
        assert table.when.gps_ns.tolist() == [gps_time_ns_from_week(made.WEEK, 5_000_000_000 - 1234)]


@pytest.mark.parametrize(
    "message",
    [
        made.pvt(5000, valid=0),
        made.pvt(5000, valid=1),
        made.pvt(5000, valid=2),
        made.pvt(5000, valid=3, fix=(0, 0)),
        made.pvt(5000, (1980, 1, 6, 0, 0, 5), valid=0),
        made.pvt(5000, (2026, 13, 6, 0, 0, 5)),
        made.pvt(5000, (2026, 2, 30, 0, 0, 5)),
        made.pvt(5000, (2026, 1, 4, 24, 0, 5)),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.sol(5000, 0, made.WEEK, 3, 0x01),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.sol(5000, 0, made.WEEK, 3, 0x09),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.sol(5000, 0, 0, 3, 0x0D),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.sol(5000, 0, 32_000, 3, 0x0D),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.timegps(5000, 0, made.WEEK, 18, valid=1),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)) + made.timeutc(5000, (2026, 1, 4, 0, 0, 0), 0, valid=1),
        made.posllh(5000, 1, 2, (3, 4), (5, 6)),
    ],
)
def test_times_not_known_are_no_times(tmp_path: Path, message: bytes) -> None:
    assert read(tmp_path, message).fix_table.when.gps_ns.tolist() == [NO_TIME]


def test_epochs_that_say_nothing_of_the_week_take_the_nearest(tmp_path: Path) -> None:
    silent_ones = [made.posllh(tow_ms, 1, 2, (3, 4), (5, 6)) for tow_ms in (604_799_000, 1000, 3000)]
    known = made.timegps(2000, 0, made.WEEK, 18)
    denied = made.posllh(4000, 1, 2, (3, 4), (5, 6)) + made.timegps(4000, 0, 0, 0, valid=0)
    log = read(tmp_path, *silent_ones[:2], known, silent_ones[2], denied)
    begin = gps_time_ns_from_week(made.WEEK, 0)
    expected = [begin - 10**9, begin + 10**9, begin + 3 * 10**9, NO_TIME]
    assert log.fix_table.when.gps_ns.tolist() == expected
    assert any("no GPS time" in note for note in log.notes)


def test_date_before_the_receiver_existed_has_rolled_over(tmp_path: Path) -> None:
    truth = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)
    shown = truth - timedelta(weeks=1024)
    gps_ns = gps_time_ns_from_utc(truth)
    log = read(tmp_path, made.pvt(gps_ns % WEEK_NS // 10**6, fields_of(shown)))
    assert log.fix_table.when.gps_ns.tolist() == [gps_ns]
    assert any("1024 weeks" in note for note in log.notes)
    position = made.posllh(7000, 1, 2, (3, 4), (5, 6))
    for week, era in ((2310, 1), (2310, 2), (made.WEEK, 0)):
        log = read(tmp_path, position, made.sol(7000, 0, week - 1024 * era, 3, 0x0D))
        assert log.fix_table.when.gps_ns.tolist() == [gps_time_ns_from_week(week, 7_000_000_000)]


def test_leap_seconds_of_another_era_tell_a_roll_over(tmp_path: Path) -> None:
    """Without PVT a date of 2006 may be right; 18 leap seconds in 2006 are not."""
    truth = gps_time_ns_from_week(made.WEEK, 7_000_000_000)
    position = made.posllh(7000, 1, 2, (3, 4), (5, 6)) + made.sol(7000, 0, made.WEEK - 1024, 3, 0x0D)
    for leap, source, expected in ((18, 2, truth), (18, 0, truth - 1024 * WEEK_NS), (14, 2, truth - 1024 * WEEK_NS)):
        log = read(tmp_path, position, made.timels(7000, source, leap))
        assert log.fix_table.when.gps_ns.tolist() == [expected]
    log = read(tmp_path, position, made.timegps(7000, 0, made.WEEK - 1024, 18))
    assert log.fix_table.when.gps_ns.tolist() == [truth]
    log = read(tmp_path, position, made.timeutc(7000, (2006, 5, 20, 23, 59, 49), 0))
    assert log.fix_table.when.gps_ns.tolist() == [truth]


def test_right_date_is_left_alone_whatever_the_receiver_counts(tmp_path: Path) -> None:
    """A count that is too high by one (a leap second not in the table) is no roll-over."""
    utc = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)
    for leap in (0, 15, 17, 19):
        log = read(tmp_path, pvt_at(utc, leap), made.timels(5000, 2, leap))
        assert log.fix_table.when.gps_ns.tolist() == [gps_time_ns_from_utc(utc)]


def test_told_count_that_differs_is_told_on(tmp_path: Path) -> None:
    utc = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)
    for leap, valid in ((0, 0), (16, 1), (18, 1)):
        log = read(tmp_path, pvt_at(utc), made.timels(5000, 0, leap, valid))
        assert any("receiver tells" in note for note in log.notes) == (leap != 18)
        log = read(tmp_path, pvt_at(utc), made.timegps(5000, 0, made.WEEK, leap, 3))
        assert any("receiver tells" in note for note in log.notes) == (leap != 18)


def test_utc_fields_against_the_calendar() -> None:
    rng = np.random.default_rng(1)
    for second in rng.integers(315_964_800, 4_000_000_000, 200).tolist():
        utc = datetime.fromtimestamp(second, UTC)
        year, month, day = (np.array([part]) for part in (utc.year, utc.month, utc.day))
        of_day = np.array([utc.hour * 3600 + utc.minute * 60 + utc.second])
        found = gps_from_utc_fields(dates(year, month, day), of_day, np.array([7]))
        assert found.tolist() == [gps_time_ns_from_utc(utc) + 7]


def test_unrolled_leaves_unknown_times_and_good_ones() -> None:
    good = EARLIEST_NS + 1
    times = np.array([NO_TIME, good, EARLIEST_NS - 1, EARLIEST_NS - 1024 * WEEK_NS - 1])
    moved, count = unrolled(times, EARLIEST_NS)
    assert moved.tolist() == [NO_TIME, good, EARLIEST_NS - 1 + 1024 * WEEK_NS, EARLIEST_NS - 1 + 1024 * WEEK_NS]
    assert count == 2
