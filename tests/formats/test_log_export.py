"""Flight logs written for other programs."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.formats.made_logs import BEGIN_NS, made_log, same_table, same_tables
from uavkit.core.errors import InputError
from uavkit.core.flight_log import (
    FixType,
    FlightLog,
    Stamps,
    fix_table,
    no_attitudes,
    no_exposures,
    no_fixes,
)
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import csv_log, gpx, kml_log
from uavkit.formats.log_export import ExportKind, export_log
from uavkit.formats.log_tables import Role, escaped, table_of, unescaped, unix_ns_of, utc_texts


def nothing(log: FlightLog) -> FlightLog:
    return replace(
        log,
        fix_table=no_fixes(),
        estimate_table=no_fixes(),
        attitude_table=no_attitudes(),
        exposure_table=no_exposures(),
    )


@pytest.mark.parametrize("seed", range(5))
def test_csv_comes_back_to_the_last_bit(tmp_path: Path, seed: int) -> None:
    log = made_log(seed)
    files = export_log(log, tmp_path, ExportKind.CSV)
    assert [file.name for file in files] == [f"00000001_{role.value}.csv" for role in Role]
    back = nothing(log)
    for file, role in zip(files, Role, strict=True):
        assert csv_log.recognises(file.read_bytes())
        read = csv_log.read_log(file, silent)
        assert (read.vehicle, read.damage.lost_bytes, read.notes) == ("ArduCopter V4.6.3", 0, ())
        same_table(table_of(read, role), table_of(log, role))
        field = {Role.FIXES: "fix", Role.ESTIMATES: "estimate", Role.ATTITUDES: "attitude", Role.EXPOSURES: "exposure"}
        back = replace(back, **{f"{field[role]}_table": table_of(read, role)})
    same_tables(back, log)


def test_unknown_is_an_empty_cell(tmp_path: Path) -> None:
    table = fix_table(Stamps.of(2, gps_ns=np.array([BEGIN_NS, NO_TIME])), np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    (file,) = export_log(replace(nothing(made_log(0)), fix_table=table), tmp_path / "one.csv", ExportKind.CSV)
    assert file.name == "one_fixes.csv"
    first, second = (line.split(",") for line in file.read_text().splitlines()[-2:])
    assert first[:6] == ["2016-12-31T23:59:43.000000000Z", str(BEGIN_NS), "", "", "1.0", "3.0"]
    assert second[:6] == ["", "", "", "", "2.0", "4.0"]
    assert set(first[6:-1]) == {""}  # neither nan nor 0
    assert "nan" not in file.read_text()


def test_utc_across_a_leap_second() -> None:
    gps_ns = BEGIN_NS + np.array([0, 16, 17, 18, 100]) * 1_000_000_000
    assert [text[11:19] for text in utc_texts(gps_ns)] == ["23:59:43", "23:59:59", "00:00:00", "00:00:00", "00:01:22"]
    rng = np.random.default_rng(0)
    for days in rng.integers(0, 17_000, 50).tolist():
        utc = datetime(1980, 1, 6, 0, 0, 30, tzinfo=UTC) + timedelta(days=days)
        times = np.array([gps_time_ns_from_utc(utc), NO_TIME])
        assert utc_texts(times) == [utc.strftime("%Y-%m-%dT%H:%M:%S.000000000Z"), ""]
        assert unix_ns_of(times).tolist() == [round(utc.timestamp()) * 1_000_000_000, NO_TIME]
    assert utc_texts(np.array([2**63 - 1, -(2**63) + 1])) == ["", ""]


def test_names_come_back_from_one_line() -> None:
    rng = np.random.default_rng(1)
    signs = ["\\", "u", "0", "a", "\n", "\r", " ", "\0", "\u2028", "\U0001f681", "\x85", "\t", ","]
    for _ in range(500):
        name = "".join(rng.choice(signs, int(rng.integers(0, 12))).tolist())
        text = escaped(name)
        assert unescaped(text) == name
        assert text == text.strip()
        assert len(text.splitlines()) <= 1


def positions(log: FlightLog) -> list[tuple[float, float]]:
    return [(fix.latitude_deg, fix.longitude_deg) for fix in log.fixes()]


def geoid_m(log: FlightLog) -> np.ndarray:
    table = log.fix_table
    undulation_m = geoid_undulation_m(table.latitude_deg, table.longitude_deg)
    return np.where(np.isfinite(table.height_geoid_m), table.height_geoid_m, table.height_ellipsoid_m - undulation_m)


def test_gpx_is_read_back(tmp_path: Path) -> None:
    log = made_log(3)
    (file,) = export_log(log, tmp_path / "flight.gpx", ExportKind.GPX)
    assert gpx.recognises(file.read_bytes())
    root = ElementTree.parse(file).getroot()
    assert root.tag == "{http://www.topografix.com/GPX/1/1}gpx"
    back = gpx.read_log(file, silent)
    assert back.damage.lost_bytes == 0
    assert positions(back) == positions(log)
    rows = np.flatnonzero((log.fix_table.fix_type >= 2) & (log.fix_table.receiver == 0))
    np.testing.assert_allclose(back.fix_table.height_geoid_m, geoid_m(log)[rows], atol=1e-4)
    gps = log.fix_table.when.gps_ns[rows]
    np.testing.assert_array_equal(back.fix_table.when.gps_ns, np.where(gps == NO_TIME, NO_TIME, gps // 1000 * 1000))
    np.testing.assert_array_equal(back.fix_table.satellites, log.fix_table.satellites[rows])
    both = np.isfinite(log.fix_table.height_geoid_m[rows])
    expected = np.where(both, log.fix_table.height_ellipsoid_m[rows], np.nan)
    np.testing.assert_allclose(back.fix_table.height_ellipsoid_m, expected, atol=2e-4)
    placed = np.isfinite(log.exposure_table.latitude_deg)
    assert back.exposure_table.latitude_deg.tolist() == log.exposure_table.latitude_deg[placed].tolist()
    assert "0" not in [point.findtext("{*}sat") for point in root.iter() if "255" in (point.findtext("{*}sat") or "")]


def test_kml_is_read_back(tmp_path: Path) -> None:
    log = made_log(4)
    (file,) = export_log(log, tmp_path / "flight.kml", ExportKind.KML)
    back = kml_log.read_log(file, silent)
    assert back.damage.lost_bytes == 0
    rows = np.flatnonzero((log.fix_table.fix_type >= 2) & (log.fix_table.receiver == 0))
    timed = rows[log.fix_table.when.gps_ns[rows] != NO_TIME]
    assert sorted(positions(back)) == sorted(
        zip(log.fix_table.latitude_deg[timed].tolist(), log.fix_table.longitude_deg[timed].tolist(), strict=True)
    )
    order = np.argsort(back.fix_table.latitude_deg)
    sought = timed[np.argsort(log.fix_table.latitude_deg[timed])]
    np.testing.assert_allclose(back.fix_table.height_geoid_m[order], geoid_m(log)[sought], atol=1e-4)
    home = np.where(np.isnan(geoid_m(log)), log.fix_table.height_above_home_m, np.nan)[sought]
    np.testing.assert_allclose(back.fix_table.height_above_home_m[order], home, atol=1e-4)
    gps = log.fix_table.when.gps_ns[sought]
    np.testing.assert_array_equal(back.fix_table.when.gps_ns[order], gps // 1000 * 1000)
    placed = np.isfinite(log.exposure_table.latitude_deg)
    assert len(back.exposure_table) == int(np.sum(placed))
    assert "DSC 0001.JPG" in back.exposure_table.name
    assert ElementTree.parse(file).getroot().tag == "{http://www.opengis.net/kml/2.2}kml"
    assert any("positions without time" in line for line in file.read_text().splitlines())


def test_parquet_holds_all_columns(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = made_log(5)
    files = export_log(log, tmp_path, ExportKind.PARQUET)
    assert [file.name for file in files] == [f"00000001_{role.value}.parquet" for role in Role]
    whole = parquet.read_table(files[0])
    assert str(whole.schema.field("utc").type) == "timestamp[ns, tz=UTC]"
    utc_ns = whole["utc"].cast("int64").to_pylist()
    assert utc_ns == [None if time == NO_TIME else time for time in unix_ns_of(log.fix_table.when.gps_ns).tolist()]
    table = whole.drop(["utc"]).to_pydict()
    fixes = log.fix_table
    assert table["gps_time_ns"] == [None if time == NO_TIME else time for time in fixes.when.gps_ns.tolist()]
    assert table["latitude_deg"] == fixes.latitude_deg.tolist()
    assert table["height_geoid_m"] == [None if np.isnan(h) else h for h in fixes.height_geoid_m.tolist()]
    assert table["fix_type"] == [
        None if kind == FixType.UNKNOWN else FixType(kind).name.lower() for kind in fixes.fix_type.tolist()
    ]
    assert table["satellites"] == [None if count == 255 else count for count in fixes.satellites.tolist()]
    names = parquet.read_table(files[3])["name"].to_pylist()
    assert names == list(log.exposure_table.name)


def test_parquet_without_pyarrow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'uavkit\[parquet\]'"):
        export_log(made_log(0), tmp_path, ExportKind.PARQUET)
    assert list(tmp_path.iterdir()) == []


def test_logs_are_read_at_once(tmp_path: Path) -> None:
    readers = {"gpx": gpx.read_log, "kml": kml_log.read_log, "csv": csv_log.read_log}
    files = [
        file
        for seed, kind in enumerate((ExportKind.GPX, ExportKind.KML, ExportKind.CSV) * 3)
        for file in export_log(made_log(seed), tmp_path / f"{seed}.{kind.value}", kind)
    ]
    alone = [readers[file.suffix[1:]](file, silent) for file in files]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda file: readers[file.suffix[1:]](file, silent), files))
    for one, other in zip(alone, together, strict=True):
        same_tables(one, other)


def test_nothing_to_write_is_an_error(tmp_path: Path) -> None:
    for kind in ExportKind:
        with pytest.raises(InputError, match="no position"):
            export_log(nothing(made_log(0)), tmp_path, kind)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        export_log(made_log(0), tmp_path / "file" / "flight.gpx", ExportKind.GPX)
