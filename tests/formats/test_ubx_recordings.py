"""Recordings of real receivers, read here and by pyubx2."""

import re
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uavkit.core.flight_log import FixType, LogKind
from uavkit.core.gpstime import WEEK_NS, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import nmea, ubx
from uavkit.formats.ubx_messages import name_of_frame

LOGS = Path(__file__).resolve().parents[2] / "../shared/data/logs"
CAR_TRIP = LOGS / "ubx_cartrip.log"
FIXTURES = sorted((LOGS / "ubx_pyubx2").glob("*")) if LOGS.exists() else []
NOT_READ_BY_PEER = "tests_pygpsdata-MIXED3BADCK.log"
"""pyubx2 raises UnicodeDecodeError on it."""

needs_data = pytest.mark.skipif(not FIXTURES or not CAR_TRIP.exists(), reason="no recordings in ../shared/data/logs")


def peer_messages(path: Path) -> list[Any]:
    """Return the intact messages of a receiver as pyubx2 decodes them."""
    pyubx2 = pytest.importorskip("pyubx2", reason="pyubx2 is not installed")
    with path.open("rb") as stream:
        reader = pyubx2.UBXReader(stream, protfilter=2, quitonerror=0)
        return [message for _, message in reader if message is not None]


def peer_frames(path: Path) -> list[bytes]:
    """Return the u-blox frames that pyubx2 finds and calls intact, whichever way they went."""
    pyubx2 = pytest.importorskip("pyubx2", reason="pyubx2 is not installed")
    with path.open("rb") as stream:
        frames = [frame for frame, _ in pyubx2.UBXReader(stream, protfilter=2, quitonerror=0, parsing=False)]
    return [frame for frame in frames if frame is not None and pyubx2.isvalid_checksum(frame)]


@needs_data
def test_car_trip_equals_the_peer() -> None:
    log = ubx.read_log(CAR_TRIP, silent)
    peer = peer_messages(CAR_TRIP)
    assert log.kind is LogKind.UBX
    assert log.damage.lost_bytes == 0
    assert Counter(message.identity for message in peer) == log.message_counts
    table = log.fix_table
    assert len(table) == log.message_counts["NAV-POSLLH"]
    tows_ns = table.when.gps_ns % WEEK_NS
    rows = 0
    for message in peer:
        if message.identity not in ("NAV-PVT", "NAV-SOL", "NAV-POSLLH", "NAV-VELNED"):
            continue
        row, rows = int(np.argmin(np.abs(tows_ns - tow_ns_of(message)))), rows + 1
        assert abs(int(tows_ns[row]) - tow_ns_of(message)) <= 500_001
        if message.identity == "NAV-SOL":
            expected = message.week * WEEK_NS + tow_ns_of(message) + message.fTOW
            assert abs(int(table.when.gps_ns[row]) - expected) <= 1
        elif message.identity == "NAV-VELNED":
            np.testing.assert_allclose(
                table.velocity_m_s[row] * 100, [message.velE, message.velN, -message.velD], atol=0.51
            )
        else:
            if message.identity == "NAV-PVT":
                assert abs(int(table.when.gps_ns[row]) - utc_gps_ns_of(message)) <= 1
            assert table.latitude_deg[row] == pytest.approx(message.lat, abs=1e-9)
            assert table.longitude_deg[row] == pytest.approx(message.lon, abs=1e-9)
            assert table.height_ellipsoid_m[row] * 1000 == pytest.approx(message.height)
            assert table.height_geoid_m[row] * 1000 == pytest.approx(message.hMSL)
            assert table.sigma_horizontal_m[row] * 2**0.5 * 1000 == pytest.approx(message.hAcc)
    assert rows > 3400
    assert set(table.fix_type.tolist()) == {FixType.THREE_DIMENSIONAL, FixType.DIFFERENTIAL}


def tow_ns_of(message: Any) -> int:
    """Return the time of week, which pyubx2 shows as a UTC time of day on some day: from the raw bytes."""
    return int.from_bytes(message.payload[:4], "little") * 1_000_000


def utc_gps_ns_of(message: Any) -> int:
    """Return the GPS time of PVT's UTC as pyubx2 decodes it."""
    fields = (message.year, message.month, message.day, message.hour, message.min, message.second)
    return gps_time_ns_from_utc(datetime(*fields, tzinfo=UTC)) + int(message.nano)


@needs_data
@pytest.mark.parametrize("path", FIXTURES, ids=lambda path: path.name)
def test_fixtures_are_read_and_counts_equal_the_peers(path: Path) -> None:
    log = ubx.read_log(path, silent)
    assert log.damage.lost_bytes == sum(span.length for span in log.damage.spans)
    assert log.damage.lost_bytes < path.stat().st_size
    if path.name == NOT_READ_BY_PEER:
        assert log.message_counts == {"GPGGA": 2, "GPGSA": 1, "NAV-PVT": 2}
        return
    names = Counter(name_of_frame(frame[2] * 256 + frame[3]) for frame in peer_frames(path))
    ours = {name: count for name, count in log.message_counts.items() if "-" in name}
    assert names == ours
    list(log.fixes())


@needs_data
def test_fixtures_are_recognised() -> None:
    for path in (*FIXTURES, CAR_TRIP):
        head = path.read_bytes()[:65_536]
        assert ubx.recognises(head) != nmea.recognises(head), path.name
        assert nmea.recognises(head) == ("-NMEA" in path.name), path.name


@needs_data
def test_damaged_fixtures_lose_what_is_damaged() -> None:
    """Frames with a wrong checksum, cut off ends, wrong headers: known places."""
    folder = LOGS / "ubx_pyubx2"
    for name, spans in (
        ("tests_pygpsdata-BADCK.log", [(100, 658)]),
        ("tests_pygpsdata-BADEOF1.log", [(452, 5)]),
        ("tests_pygpsdata-BADEOF2.log", [(160, 9)]),
        ("tests_pygpsdata-BADHDR.log", [(452, 20)]),
        ("tests_pygpsdata-NMEABADEND.log", [(1084, 32)]),
        ("tests_pygpsdata-MIXED-RTCM3BADCRC.log", [(52, 25)]),
        ("tests_pygpsdata-MIXED-RTCM3.log", []),
    ):
        damage = ubx.read_log(folder / name, silent).damage
        assert [(span.offset, span.length) for span in damage.spans] == spans, name


@needs_data
def test_sentences_equal_the_peers(tmp_path: Path) -> None:
    """The NMEA sentences of all recordings, each read by itself; pynmeagps rounds degrees to 1e-10."""
    pynmeagps = pytest.importorskip("pynmeagps", reason="pynmeagps is not installed")
    path, places, found = tmp_path / "sentence.nmea", 0, 0
    for source in FIXTURES:
        for match in re.finditer(rb"\$..(GGA|RMC|GLL|GNS),[ -#%-~]*\*[0-9A-F]{2}\r\n", source.read_bytes()):
            peer = pynmeagps.NMEAReader.parse(match.group())
            path.write_bytes(match.group())
            table, found = nmea.read_log(path, silent).fix_table, found + 1
            if peer.lat == "" or not peer.time:
                assert not np.isfinite(table.latitude_deg).any()
                continue
            places += 1
            assert table.latitude_deg == pytest.approx(peer.lat, abs=1e-9)
            assert table.longitude_deg == pytest.approx(peer.lon, abs=1e-9)
            if hasattr(peer, "alt"):
                assert table.height_geoid_m == pytest.approx(peer.alt)
                assert table.height_ellipsoid_m == pytest.approx(peer.alt + peer.sep)
                assert table.satellites.tolist() == [peer.numSV]
    assert found > 200
    assert places > 5


@needs_data
@pytest.mark.slow
def test_50_mb_in_less_than_3_s(tmp_path: Path) -> None:
    mixed = LOGS / "ubx_pyubx2" / "examples_2023-4-17_82912_serial-COM3.ubx"
    for source in (CAR_TRIP, mixed):
        data = source.read_bytes()
        path = tmp_path / "long.ubx"
        path.write_bytes(data * (50_000_000 // len(data) + 1))
        ubx.read_log(source, silent)
        begin = time.perf_counter()
        log = ubx.read_log(path, silent)
        assert time.perf_counter() - begin < 3.0
        assert log.damage.lost_bytes == 0
