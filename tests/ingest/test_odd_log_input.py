"""Odd logs and decisions by hand: logs of like names are told apart, and what cannot be meant is refused."""

import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    ExposureKind,
    FlightLog,
    LogKind,
    Stamps,
    exposure_table,
    no_attitudes,
    no_exposures,
    no_fixes,
)
from uavkit.core.progress import silent
from uavkit.core.records import StillInfo
from uavkit.formats.flight_logs import open_log
from uavkit.formats.match_file import MatchRow
from uavkit.ingest import exposure_clocks
from uavkit.ingest.log_positions import LogOptions, positions_of_events, prepare_flights
from uavkit.ingest.logged_stills import GivenMatches, short_names, stills_in_logs

RECORDED = Path(__file__).resolve().parents[2] / "sim_logs"


def stills_of(log: FlightLog, count: int) -> list[StillInfo]:
    times = log.exposure_table.when.gps_ns[:count].tolist()
    return [
        StillInfo(
            name=f"R{row:04d}.JPG",
            width_px=400,
            height_px=300,
            camera_time_ns=time_ns // 10**7 * 10**7,
            camera_time_resolution_ns=10**7,
        )
        for row, time_ns in enumerate(times)
    ]


@pytest.mark.parametrize(
    ("sources", "names"),
    [
        (["/a/x.BIN"], ["x.BIN"]),
        (["/a/x.BIN", "/a/y.BIN"], ["x.BIN", "y.BIN"]),
        (["/a/b/x.BIN", "/a/c/x.BIN", "/a/b/z.BIN"], ["b/x.BIN", "c/x.BIN", "b/z.BIN"]),
        (["/a/s/x.BIN", "/b/s/x.BIN"], ["a/s/x.BIN", "b/s/x.BIN"]),
        (["/a/x.BIN", "/a/x.BIN"], ["x.BIN", "x.BIN"]),
        (["x.BIN", "a/x.BIN"], ["x.BIN", "a/x.BIN"]),
        ([], []),
    ],
)
def test_logs_of_like_names_are_told_apart_by_their_folders(sources: list[str], names: list[str]) -> None:
    assert short_names(sources) == names


def test_an_exposure_of_the_first_of_two_logs_of_like_names_can_be_given_by_its_label() -> None:
    """Both logs are called flight.BIN: "flight.BIN 5" would be of both."""
    logs = [open_log(RECORDED / folder / "flight.BIN") for folder in ("sitl_distance_trigger", "sitl_waypoint_trigger")]
    stills = stills_of(logs[0], 31)
    row = MatchRow(image=stills[0].name, event="sitl_distance_trigger/flight.BIN 5", line=2)
    given = GivenMatches(rows=(row,), source="match.csv")
    result = stills_in_logs(stills, logs, given, LogOptions(), silent)
    assert result.matches is not None
    assert result.matches.stills[0].event == 5
    labels = [entry.source for entry in result.matches.unused] + [entry.label for entry in result.matches.stills]
    assert len({label for label in labels if label}) == 64


@pytest.mark.parametrize(
    ("days", "doubtful"), [(0.0, False), (0.6, False), (-0.6, False), (728.0, True), (-30.0, True)]
)
def test_a_log_of_another_day_is_matched_by_its_intervals_but_called_doubtful(days: float, doubtful: bool) -> None:
    """A camera that lost its date has the intervals of the flight all the same; so has a flight repeated exactly."""
    log = open_log(RECORDED / "sitl_distance_trigger/flight.BIN")
    stills = [
        replace(still, camera_time_ns=still.camera_time_ns + round(days * 86_400e9))
        for still in stills_of(log, 31)
        if still.camera_time_ns is not None
    ]
    result = stills_in_logs(stills, [log], GivenMatches(), LogOptions(), silent)
    assert result.joined.count > 28
    told = [note for note in result.notes if "another flight of the same pattern" in note]
    assert len(told) == doubtful
    assert not doubtful or f"are {abs(days):.0f} days from" in told[0]


@pytest.mark.parametrize("years", [-40, 100])
def test_an_exposure_with_a_damaged_time_takes_neither_time_nor_memory(years: int) -> None:
    """The differences of times then span decades: cells of 2 s over these would fill gigabytes."""
    log = open_log(RECORDED / "sitl_distance_trigger/flight.BIN")
    stills = stills_of(log, 31)
    table = log.exposure_table
    gps_ns = table.when.gps_ns.copy()
    gps_ns[10] += years * 365 * 86_400 * 10**9
    damaged = replace(table, when=replace(table.when, gps_ns=gps_ns))
    tracemalloc.start()
    begin = time.process_time()
    result = stills_in_logs(stills, [replace(log, exposure_table=damaged)], GivenMatches(), LogOptions(), silent)
    assert time.process_time() - begin < 10.0
    assert tracemalloc.get_traced_memory()[1] < 200_000_000
    tracemalloc.stop()
    assert result.matches is not None
    used = [entry for entry in result.matches.stills if entry.gps_time_ns is not None]
    by_name = {still.name: int(table.when.gps_ns[row]) for row, still in enumerate(stills)}
    assert all(abs(entry.gps_time_ns - by_name[entry.still]) < 10**9 for entry in used if entry.gps_time_ns)


def test_offsets_counted_in_scattered_cells_give_the_same_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    log = open_log(RECORDED / "sitl_distance_trigger/flight.BIN")
    stills = stills_of(log, 31)[3:]
    dense = stills_in_logs(stills, [log], GivenMatches(), LogOptions(), silent)
    monkeypatch.setattr(exposure_clocks, "MOST_CELLS", 0)
    scattered = stills_in_logs(stills, [log], GivenMatches(), LogOptions(), silent)
    assert dense.matches is not None
    assert scattered.matches is not None
    assert [entry.event for entry in scattered.matches.stills] == [entry.event for entry in dense.matches.stills]
    assert sum(entry.event is not None for entry in dense.matches.stills) > 25


def test_what_is_given_by_hand_needs_exposures_to_be_given() -> None:
    log = replace(open_log(RECORDED / "sitl_distance_trigger/flight.BIN"), exposure_table=no_exposures())
    stills = [StillInfo(name="a.jpg", width_px=4, height_px=3), StillInfo(name="b.jpg", width_px=4, height_px=3)]
    given = GivenMatches(rows=(MatchRow(image="a.jpg", event="1", line=2),), source="match.csv")
    for logs in ((), (log,)):
        with pytest.raises(InputError, match=r"match\.csv: no log tells of exposures with times"):
            stills_in_logs(stills, logs, given, LogOptions(), silent)


def test_a_long_list_of_timed_waypoints_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions that the log itself tells are taken from one pass over it, however many stills want one."""
    count = 1000
    when = Stamps.of(count, gps_ns=1_450_000_000_000_000_000 + np.arange(count) * 3_000_000_000)
    places = {"latitude_deg": np.linspace(35.8, 35.9, count), "longitude_deg": np.full(count, 139.65)}
    log = FlightLog(
        source="list.kml",
        kind=LogKind.KML,
        fix_table=no_fixes(),
        estimate_table=no_fixes(),
        attitude_table=no_attitudes(),
        exposure_table=exposure_table(when, ExposureKind.LISTED, **places),
    )
    flights = prepare_flights([log])
    passes, original = [], FlightLog.exposures

    def counted(self: FlightLog) -> object:
        passes.append(1)
        return original(self)

    monkeypatch.setattr(FlightLog, "exposures", counted)
    events = [(0, row, int(when.gps_ns[row])) for row in range(count)]
    found = positions_of_events(flights, events, LogOptions())
    assert [place.fix.latitude_deg for place in found if place.fix] == places["latitude_deg"].tolist()
    assert len(passes) == 1
