"""A dataflash log of several starts: every exposure has the time of its own start, and what cannot have one is said."""

from pathlib import Path

import numpy as np
import pytest

from tests.sim_logs.recorded_pieces import Piece, dataflash, joined, overwritten
from uavkit.core.flight_log import FlightLog
from uavkit.core.gpstime import NO_TIME
from uavkit.formats.flight_logs import open_log

FIRST, SECOND = "sitl_distance_trigger", "sitl_waypoint_trigger"


def read(pieces: list[Piece], path: Path) -> FlightLog:
    path.write_bytes(joined(pieces))
    return open_log(path)


def untimed(pieces: list[Piece]) -> list[Piece]:
    return [overwritten(piece, 13, "IH", 0, 0) if piece.name == "GPS" else piece for piece in pieces]


def times(log: FlightLog) -> list[np.ndarray]:
    tables = (log.exposure_table, log.fix_table, log.attitude_table, log.estimate_table)
    return [table.when.gps_ns for table in tables]


@pytest.mark.parametrize("order", [(FIRST, SECOND), (SECOND, FIRST), (FIRST, SECOND, FIRST)])
def test_each_start_keeps_its_own_times(order: tuple[str, ...], tmp_path: Path) -> None:
    """Boot times of both flights overlap (55 to 182 s); alone each fits its clock to a millisecond."""
    parts = [dataflash(folder) for folder in order]
    both = read([piece for part in parts for piece in part], tmp_path / "both.BIN")
    alone = [times(read(part, tmp_path / "one.BIN")) for part in parts]
    for kind, found in enumerate(times(both)):
        wanted = np.concatenate([each[kind] for each in alone])
        assert len(found) == len(wanted)
        assert np.abs(found - wanted).max() < 2_000_000
    assert any("started" in note for note in both.notes)
    assert not any("contradicts" in note for note in both.notes)
    assert both.clock is not None
    assert both.clock.rejected == 0


def test_a_start_without_time_is_left_out_and_said(tmp_path: Path) -> None:
    first, second = untimed(dataflash(FIRST)), dataflash(SECOND)
    both = read([*first, *second], tmp_path / "both.BIN")
    alone = read(second, tmp_path / "one.BIN")
    for found, wanted in zip(times(both), times(alone), strict=True):
        assert np.array_equal(found, wanted)
    assert any("of 1 starts nothing tells the time" in note for note in both.notes)


def test_without_any_time_nothing_is_moved(tmp_path: Path) -> None:
    both = read(untimed(dataflash(FIRST)) + untimed(dataflash(SECOND)), tmp_path / "both.BIN")
    assert len(both.exposure_table) == 64
    assert both.clock is None
    assert not any("started" in note for note in both.notes)


@pytest.mark.parametrize("early", [False, True], ids=["timed", "before the first fix"])
def test_a_block_that_comes_again_is_no_start(early: bool, tmp_path: Path) -> None:
    pieces = dataflash(FIRST)
    half = len(pieces) // 2
    if early:
        pieces = untimed(pieces[:half]) + pieces[half:]
    again = [*pieces[: half // 2 + 80], *pieces[half // 2 - 80 :]]
    log = read(again, tmp_path / "again.BIN")
    assert not any("started" in note for note in log.notes)
    whole = read(pieces, tmp_path / "whole.BIN")
    found, wanted = log.exposure_table.when.gps_ns, whole.exposure_table.when.gps_ns
    assert NO_TIME not in found
    assert np.abs(found[:, None] - wanted).min(axis=1).max() < 2_000_000
    assert np.abs(found[:, None] - wanted).min(axis=0).max() < 2_000_000


def test_a_wrong_boot_time_is_no_start(tmp_path: Path) -> None:
    pieces = dataflash(FIRST)
    where = [row for row, piece in enumerate(pieces) if piece.name == "GPS"][60]
    pieces[where] = overwritten(pieces[where], 3, "Q", 195_000_000)
    log = read(pieces, tmp_path / "spike.BIN")
    whole = read(dataflash(FIRST), tmp_path / "whole.BIN")
    assert not any("started" in note for note in log.notes)
    assert np.abs(log.exposure_table.when.gps_ns - whole.exposure_table.when.gps_ns).max() < 1_000_000
