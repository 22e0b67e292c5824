"""Time marks of u-blox receivers (TIM-TM2) as exposures."""

from pathlib import Path

import numpy as np
import pytest

from tests.formats import receiver_bytes as made
from uavkit.core.flight_log import ExposureKind, FlightLog
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_week
from uavkit.core.progress import silent
from uavkit.formats import ubx

RISING, VALID, UTC_KNOWN, FALLING = 0x80, 0x40, 0x20, 0x04
RECEIVER, GNSS, UTC = 0x00, 0x08, 0x10


def read(folder: Path, *messages: bytes) -> FlightLog:
    path = folder / "receiver.ubx"
    path.write_bytes(b"".join(messages))
    return ubx.read_log(path, silent)


def at(tow_ms: int, rest_ns: int = 0, week: int = made.WEEK) -> int:
    return gps_time_ns_from_week(week, tow_ms * 1_000_000 + rest_ns)


def test_mark_gives_time_sigma_and_count(tmp_path: Path) -> None:
    log = read(tmp_path, made.tm2(41, (made.WEEK, 5012, 345_678), (made.WEEK, 5017, 1), accuracy_ns=42))
    table = log.exposure_table
    assert table.when.gps_ns.tolist() == [at(5012, 345_678)]
    assert table.when.boot_ns.tolist() == [NO_TIME]
    assert table.sigma_s == pytest.approx([42e-9])
    assert table.sequence.tolist() == [41]
    assert table.kind.tolist() == [ExposureKind.MARK]
    assert np.isnan(table.latitude_deg).all()
    assert [event.gps_time_ns for event in log.exposures()] == [at(5012, 345_678)]


def test_across_the_end_of_a_week(tmp_path: Path) -> None:
    log = read(tmp_path, made.tm2(1, (made.WEEK - 1, 604_799_999, 999_999)), made.tm2(2, (made.WEEK, 0, 1)))
    assert np.diff(log.exposure_table.when.gps_ns).tolist() == [2]


def test_one_exposure_for_each_step_of_the_count(tmp_path: Path) -> None:
    """The message repeats the last edge: with the falling edge in a later epoch, and where it is sent on and on."""
    first, second = (made.WEEK, 1000, 0), (made.WEEK, 3000, 0)
    falling = made.tm2(65_535, first, (made.WEEK, 1300, 0), flags=FALLING | VALID | GNSS)
    quiet = made.tm2(65_535, first, (made.WEEK, 1300, 0), flags=VALID | GNSS)
    log = read(tmp_path, *[made.tm2(65_535, first)] * 2, falling, quiet, made.tm2(0, second))
    assert log.exposure_table.sequence.tolist() == [65_535, 0]
    assert log.exposure_table.when.gps_ns.tolist() == [at(1000), at(3000)]
    assert log.notes == ("there are no positions in it",)


def test_edge_whose_message_is_lost_comes_from_the_next(tmp_path: Path) -> None:
    falling = made.tm2(2, (made.WEEK, 3000, 0), (made.WEEK, 3300, 0), flags=FALLING | VALID | GNSS)
    log = read(tmp_path, made.tm2(1, (made.WEEK, 1000, 0)), falling, made.tm2(3, (made.WEEK, 5000, 0)))
    assert log.exposure_table.sequence.tolist() == [1, 2, 3]
    assert log.exposure_table.when.gps_ns.tolist() == [at(1000), at(3000), at(5000)]
    assert not any("missing" in note for note in log.notes)


def test_missed_marks_are_told(tmp_path: Path) -> None:
    counts = (65_533, 65_534, 1, 2, 5, 40_000)
    log = read(tmp_path, *(made.tm2(count, (made.WEEK, 1000 * n, 0)) for n, count in enumerate(counts)))
    assert log.exposure_table.sequence.tolist() == list(counts)
    assert any(note.startswith("4 time marks are missing") for note in log.notes), "2 and 2; the last is a new start"


def test_falling_edges_where_there_is_no_rising_one(tmp_path: Path) -> None:
    flags = FALLING | VALID | GNSS
    edges = [made.tm2(0, (0, 0, 0), (made.WEEK, 1000 * n, 17), flags=flags) for n in (1, 1, 2)]
    log = read(tmp_path, *edges)
    assert log.exposure_table.when.gps_ns.tolist() == [at(1000, 17), at(2000, 17)]
    assert any("falling" in note for note in log.notes)
    log = read(tmp_path, *edges, made.tm2(1, (made.WEEK, 9000, 0)))
    assert log.exposure_table.when.gps_ns.tolist() == [at(9000)]


def test_time_bases(tmp_path: Path) -> None:
    edge = (made.WEEK, 1000, 0)
    log = read(tmp_path, made.tm2(1, edge, flags=RISING | VALID | RECEIVER, accuracy_ns=0))
    assert log.exposure_table.when.gps_ns.tolist() == [at(1000)]
    assert np.isnan(log.exposure_table.sigma_s).all(), "0 ns is not an accuracy"
    assert any("receiver time" in note for note in log.notes)
    log = read(tmp_path, made.tm2(1, edge, flags=RISING | VALID | RECEIVER))
    assert log.exposure_table.sigma_s[0] == pytest.approx(1e-3 / 12**0.5, rel=1e-6)
    log = read(tmp_path, made.tm2(1, edge, flags=RISING | VALID | UTC_KNOWN | UTC))
    assert log.exposure_table.when.gps_ns.tolist() == [at(19_000)]
    log = read(tmp_path, made.tm2(1, edge, flags=RISING | VALID | UTC))
    assert log.exposure_table.when.gps_ns.tolist() == [NO_TIME]
    assert any("no valid time" in note for note in log.notes)


def test_mark_in_utc_of_a_wrong_count_of_leap_seconds(tmp_path: Path) -> None:
    """The receiver's UTC runs 2 s ahead: its marks in UTC do too."""
    position = made.pvt(5000, (2026, 1, 3, 23, 59, 49))
    log = read(tmp_path, position, made.tm2(1, (made.WEEK - 1, 604_788_000, 0), flags=RISING | VALID | UTC_KNOWN | UTC))
    assert log.exposure_table.when.gps_ns.tolist() == [at(4000)]


def test_marks_without_a_valid_time(tmp_path: Path) -> None:
    messages = (made.tm2(1, (made.WEEK, 1000, 0), flags=RISING | GNSS), made.tm2(2, (0, 1000, 0)))
    log = read(tmp_path, *messages, made.tm2(3, (65_535, 1000, 0)))
    assert log.exposure_table.when.gps_ns.tolist() == [NO_TIME] * 3
    assert log.exposure_table.sequence.tolist() == [1, 2, 3]


def test_week_of_marks_rolls_over_with_the_positions(tmp_path: Path) -> None:
    position = made.pvt(1000, (2006, 5, 20, 23, 59, 43))
    log = read(tmp_path, position, made.tm2(1, (made.WEEK - 1024, 1500, 0)))
    assert log.fix_table.when.gps_ns.tolist() == [at(1000)]
    assert log.exposure_table.when.gps_ns.tolist() == [at(1500)]


def test_channels_count_by_themselves(tmp_path: Path) -> None:
    messages = [made.tm2(n // 2 + 1, (made.WEEK, 1000 * n, 0), channel=n % 2) for n in range(6)]
    log = read(tmp_path, *messages)
    assert len(log.exposure_table) == 6
    assert any("2 channels" in note for note in log.notes)
    assert not any("missing" in note for note in log.notes)


def test_marks_far_from_all_positions_are_told(tmp_path: Path) -> None:
    beidou = made.tm2(1, (made.WEEK - 1356, 5000 - 14_000 + 604_800_000, 0))
    log = read(tmp_path, made.pvt(5000, (2026, 1, 3, 23, 59, 47)), made.tm2(0, (made.WEEK, 5100, 0)), beidou)
    assert any("1 time marks are more than a minute" in note for note in log.notes)


def test_no_new_edge_at_all(tmp_path: Path) -> None:
    log = read(tmp_path, made.tm2(7, (made.WEEK, 1000, 0), flags=VALID | GNSS))
    assert len(log.exposure_table) == 0
    assert any("new edge" in note for note in log.notes)
