"""What every reader of flight logs promises, whatever the kind."""

import json
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from tests.contracts.log_samples import EXPOSURES, SAMPLES
from uavkit.core.devices import ExposureSource, GnssReceiver
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.flight_logs import open_log
from uavkit.formats.log_bytes import MOST_SPANS, Blocks
from uavkit.formats.log_export import ExportKind, export_log
from uavkit.formats.log_summary import log_summary

FOLDER = Path(__file__).resolve().parents[2] / "sim_logs"
RECORDED = [path.relative_to(FOLDER).as_posix() for path in sorted(FOLDER.glob("*_trigger/flight.*"))]
BROKEN = [path.name for path in sorted((FOLDER / "broken_logs").iterdir()) if path.suffix not in (".toml", ".kmz")]
TEXT_KINDS = (LogKind.KML, LogKind.GPX, LogKind.DJI_SRT, LogKind.DJI_MRK, LogKind.CSV)
KINDS = pytest.mark.parametrize("kind", LogKind, ids=lambda kind: kind.name.lower())


def _written(kind: LogKind, folder: Path) -> Path:
    path = folder / "flight.log"
    path.write_bytes(SAMPLES[kind]())
    return path


def _contents(log: FlightLog) -> list[object]:
    """Return all that a log holds, so that NaN equals NaN."""
    tables = (log.fix_table, log.estimate_table, log.attitude_table, log.exposure_table)
    columns = [
        column.tobytes() if isinstance(column, np.ndarray) else column
        for table in tables
        for column in (getattr(table, name) for name in table.__dataclass_fields__ if name != "when")
    ]
    times = [times.tobytes() for table in tables for times in (table.when.gps_ns, table.when.boot_ns)]
    others = (log.kind, log.vehicle, log.clock, log.parameters, log.texts, log.damage, log.notes)
    return [*columns, *times, *others, dict(log.message_counts)]


@KINDS
def test_each_kind_is_read_as_what_it_is_and_fills_the_protocols(kind: LogKind, tmp_path: Path) -> None:
    path = _written(kind, tmp_path)
    log = open_log(path)
    assert log.kind is kind
    assert log.source == str(path)
    assert isinstance(log, GnssReceiver)
    assert isinstance(log, ExposureSource)
    assert len(list(log.exposures())) == len(log.exposure_table) == EXPOSURES[kind]
    assert len(list(log.fixes())) + EXPOSURES[kind] > 15
    assert log.damage.lost_bytes == 0
    assert all(type(count) is int and count >= 0 for count in log.message_counts.values())
    assert sum(log.message_counts.values()) > 0


@KINDS
def test_fixes_are_places_with_honest_times_and_sigmas_in_the_order_of_the_file(kind: LogKind, tmp_path: Path) -> None:
    log = open_log(_written(kind, tmp_path))
    fixes = list(log.fixes())
    for fix in fixes:
        _check_fix(fix)
    known = [fix.gps_time_ns for fix in fixes if fix.gps_time_ns is not None]
    assert all(later >= earlier for earlier, later in pairwise(known))  # intact logs are written as they fly
    rows = np.flatnonzero(log.fix_table.receiver == log.fix_table.receiver.min(initial=255))
    latitude = [value for value in log.fix_table.latitude_deg[rows].tolist() if np.isfinite(value)]
    assert [fix.latitude_deg for fix in fixes] == latitude


def _check_fix(fix: GnssFix) -> None:
    assert -90.0 <= fix.latitude_deg <= 90.0
    assert -180.0 <= fix.longitude_deg <= 180.0
    assert fix.gps_time_ns is None or (type(fix.gps_time_ns) is int and 0 < fix.gps_time_ns < 2**62)
    assert fix.sigma_horizontal_m is None or 0.0 < fix.sigma_horizontal_m < np.inf
    assert fix.sigma_vertical_m is None or 0.0 < fix.sigma_vertical_m < np.inf
    assert np.isfinite(fix.height_m) == (fix.height_datum is not HeightDatum.UNKNOWN)


@KINDS
def test_a_height_is_told_with_the_datum_of_its_column(kind: LogKind, tmp_path: Path) -> None:
    log = open_log(_written(kind, tmp_path))
    table = log.exposure_table
    columns = {
        HeightDatum.ELLIPSOID: table.height_ellipsoid_m,
        HeightDatum.GEOID: table.height_geoid_m,
        HeightDatum.GROUND: table.height_above_home_m,
    }
    for row, event in enumerate(log.exposures()):
        assert event.gps_time_ns is None or type(event.gps_time_ns) is int
        assert event.sequence is None or event.sequence >= 0
        assert event.source == ExposureKind(int(table.kind[row])).name.lower()
        assert (event.position is None) == bool(np.isnan(table.latitude_deg[row]))
        if event.position is not None and event.position.height_datum is not HeightDatum.UNKNOWN:
            _check_fix(event.position)
            assert event.position.height_m == columns[event.position.height_datum][row]


@KINDS
def test_an_unknown_time_is_nowhere_told_as_a_number(kind: LogKind, tmp_path: Path) -> None:
    log = open_log(_written(kind, tmp_path))
    told = json.dumps(log_summary(log), allow_nan=False)
    written = "".join(path.read_text(encoding="utf-8") for path in export_log(log, tmp_path / "out", ExportKind.CSV))
    for text in (told, written):
        assert str(NO_TIME) not in text
        assert str(NO_TIME)[:8] not in text
    times = [fix.gps_time_ns for fix in log.fixes()] + [event.gps_time_ns for event in log.exposures()]
    assert NO_TIME not in times
    assert all(sample.gps_time_ns != NO_TIME for sample in log.attitudes())


@pytest.mark.parametrize("name", [*RECORDED, *(f"broken_logs/{name}" for name in BROKEN)])
def test_damage_lies_in_the_file_and_nothing_is_printed(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = FOLDER / name
    with suppress(InputError):
        log = open_log(path)
        _check_damage(log, path.stat().st_size)
        for fix in log.fixes():
            _check_fix(fix)
    assert capfd.readouterr() == ("", "")


def _check_damage(log: FlightLog, size: int) -> None:
    damage = log.damage
    assert 0 <= damage.lost_bytes <= size
    assert len(damage.spans) == min(damage.span_count, MOST_SPANS)
    ends = [span.offset + span.length for span in damage.spans]
    assert all(end < span.offset for end, span in zip(ends, damage.spans[1:], strict=False))
    assert all(span.length > 0 and span.why for span in damage.spans)
    assert max(ends, default=0) <= size
    if damage.span_count <= MOST_SPANS:
        assert sum(span.length for span in damage.spans) == damage.lost_bytes


@KINDS
def test_two_readings_are_equal(kind: LogKind, tmp_path: Path) -> None:
    path = _written(kind, tmp_path)
    assert _contents(open_log(path)) == _contents(open_log(path))


@KINDS
def test_the_size_of_blocks_does_not_matter(kind: LogKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines and XML are read by other means, whose pieces are the same for all."""
    path = _written(kind, tmp_path)
    whole = _contents(open_log(path))
    used, original = [], Blocks.__init__

    def small(self: Blocks, stream: BinaryIO, _: int = 0) -> None:
        used.append(stream)
        original(self, stream, 333)

    monkeypatch.setattr(Blocks, "__init__", small)
    assert _contents(open_log(path)) == whole
    assert bool(used) or kind in TEXT_KINDS


@KINDS
def test_an_early_download_holds_the_first_exposures(kind: LogKind, tmp_path: Path) -> None:
    """Of the last one the confirmation may still be missing; times differ as clocks are tied by fewer fixes."""
    data, path = SAMPLES[kind](), tmp_path / "early.log"
    whole = _exposures(open_log(_written(kind, tmp_path)))
    for share in (0.4, 0.7, 0.95):
        path.write_bytes(data[: int(share * len(data))])
        early = _exposures(open_log(path))[:-1]
        assert [row[1:] for row in early] == [row[1:] for row in whole[: len(early)]]
        for (time, *_), (known, *_) in zip(early, whole, strict=False):
            assert (time is None) == (known is None)
            assert time is None or known is None or abs(time - known) < 20_000_000
        assert len(early) >= share * len(whole) - 12


def _exposures(log: FlightLog) -> list[tuple[Any, ...]]:
    return [
        (event.gps_time_ns, event.sequence, event.source, event.position and event.position.latitude_deg)
        for event in log.exposures()
    ]
