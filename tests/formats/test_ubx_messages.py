"""Each field of each u-blox message that is decoded: known values in, the same values out."""

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.formats import receiver_bytes as made
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixType, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_week
from uavkit.core.progress import silent
from uavkit.formats import ubx
from uavkit.formats.ubx_epochs import JOINED
from uavkit.formats.ubx_messages import DECODED, NAMES, name_of_frame

SQRT2 = 2.0**0.5


def read(folder: Path, *messages: bytes) -> FlightLog:
    path = folder / "receiver.ubx"
    path.write_bytes(b"".join(messages))
    return ubx.read_log(path, silent)


def test_pvt_gives_every_column(tmp_path: Path) -> None:
    for short in (False, True):
        message = made.pvt(
            500, (2026, 1, 3, 23, 59, 42), nano=500_000_123, fix=(3, 0x03 | 0x80), lat=-356_123_456, lon=-1_397_654_321,
            heights=(-1_234, 35_678), accuracies=(1414, 2500), velocity=(-1500, 2500, -300), satellites=17, short=short,
        )  # fmt: skip
        log = read(tmp_path, message)
        table = log.fix_table
        assert log.kind is LogKind.UBX
        assert log.message_counts == {"NAV-PVT": 1}
        assert log.damage.lost_bytes == 0
        assert table.latitude_deg.tolist() == [-35.6123456]
        assert table.longitude_deg.tolist() == [-139.7654321]
        assert table.height_ellipsoid_m.tolist() == [-1.234]
        assert table.height_geoid_m.tolist() == [35.678]
        assert np.isnan(table.height_above_home_m).all()
        assert table.sigma_horizontal_m[0] == pytest.approx(1.414 / SQRT2)
        assert table.sigma_vertical_m[0] == pytest.approx(2.5)
        np.testing.assert_allclose(table.velocity_m_s, [[2.5, -1.5, 0.3]])
        assert table.fix_type.tolist() == [FixType.RTK_FIXED]
        assert table.satellites.tolist() == [17]
        assert table.when.gps_ns.tolist() == [gps_time_ns_from_week(made.WEEK, 500_000_123)]
        assert table.when.boot_ns.tolist() == [NO_TIME]


def test_hpposllh_adds_its_digits_and_wins(tmp_path: Path) -> None:
    whole, rest = (1_397_654_321, -356_123_456, 75_500, -1_250), (-45, 99, -7, 9)
    log = read(tmp_path, made.pvt(1000), made.hpposllh(1000, whole, rest, (141, 203)))
    table = log.fix_table
    assert len(table) == 1
    assert table.longitude_deg[0] == pytest.approx(139.7654321 - 45e-9, abs=1e-12)
    assert table.latitude_deg[0] == pytest.approx(-35.6123456 + 99e-9, abs=1e-12)
    assert table.height_ellipsoid_m[0] == pytest.approx(75.5 - 0.0007, abs=1e-9)
    assert table.height_geoid_m[0] == pytest.approx(-1.25 + 0.0009, abs=1e-9)
    assert table.sigma_horizontal_m[0] == pytest.approx(0.0141 / SQRT2)
    assert table.sigma_vertical_m[0] == pytest.approx(0.0203)
    assert table.satellites.tolist() == [12]


def test_old_receivers_epoch_is_joined_by_its_time_of_week(tmp_path: Path) -> None:
    """u-blox 5 and 6: position, solution, velocity, time in messages of their own; a row for each epoch."""
    messages = []
    for epoch, tow_ms in enumerate((604_799_800, 0, 200)):
        week = made.WEEK - 1 if epoch == 0 else made.WEEK
        messages += [
            made.posllh(tow_ms, 356_000_000 + epoch, 1_397_000_000 - epoch, (75_500 + epoch, 36_250), (2828, 4000)),
            made.sol(tow_ms, -259_829, week, 3, 0x0F if epoch else 0x0D, satellites=7 + epoch),
            made.velned(tow_ms, 150 + epoch, -250, 30),
        ]
    table = read(tmp_path, *messages).fix_table
    assert table.latitude_deg.tolist() == [35.6, 35.6000001, 35.6000002]
    assert table.longitude_deg.tolist() == [139.7, 139.6999999, 139.6999998]
    assert table.height_ellipsoid_m.tolist() == [75.5, 75.501, 75.502]
    assert table.sigma_horizontal_m == pytest.approx(2.828 / SQRT2)
    np.testing.assert_allclose(table.velocity_m_s, [[-2.5, 1.5, -0.3], [-2.5, 1.51, -0.3], [-2.5, 1.52, -0.3]])
    assert table.satellites.tolist() == [7, 8, 9]
    assert table.fix_type.tolist() == [FixType.THREE_DIMENSIONAL, FixType.DIFFERENTIAL, FixType.DIFFERENTIAL]
    begin = gps_time_ns_from_week(made.WEEK, 0)
    assert table.when.gps_ns.tolist() == [begin - 200_259_829, begin - 259_829, begin + 200_000_000 - 259_829]


def test_position_wins_by_kind_not_by_order(tmp_path: Path) -> None:
    other = made.posllh(1000, 1, 2, (3, 4), (5, 6))
    for messages in ((other, made.pvt(1000)), (made.pvt(1000), other)):
        table = read(tmp_path, *messages).fix_table
        assert table.latitude_deg.tolist() == [35.6]
        assert table.sigma_vertical_m.tolist() == [2.5]


@pytest.mark.parametrize(
    "fix, expected",
    [
        ((0, 0x00), FixType.NO_FIX),
        ((3, 0x00), FixType.NO_FIX),
        ((1, 0x01), FixType.NO_FIX),
        ((2, 0x01), FixType.TWO_DIMENSIONAL),
        ((3, 0x01), FixType.THREE_DIMENSIONAL),
        ((4, 0x01), FixType.THREE_DIMENSIONAL),
        ((5, 0x01), FixType.NO_FIX),
        ((3, 0x03), FixType.DIFFERENTIAL),
        ((3, 0x43), FixType.RTK_FLOAT),
        ((3, 0x83), FixType.RTK_FIXED),
    ],
)
def test_fix_types(tmp_path: Path, fix: tuple[int, int], expected: FixType) -> None:
    log = read(tmp_path, made.pvt(1000, fix=fix))
    assert log.fix_table.fix_type.tolist() == [expected]
    assert len(list(log.fixes())) == (expected >= FixType.TWO_DIMENSIONAL)


def test_status_tells_the_fix_where_neither_pvt_nor_sol_does(tmp_path: Path) -> None:
    position = made.posllh(1000, 1, 2, (3, 4), (5, 6))
    for message, expected in (
        (made.status(1000, 3, 0x01), FixType.THREE_DIMENSIONAL),
        (made.status(1000, 3, 0x00), FixType.NO_FIX),
        (made.status(1000, 3, 0x03, 0x40), FixType.RTK_FLOAT),
        (made.status(1000, 3, 0x03, 0x80), FixType.RTK_FIXED),
        (b"", FixType.UNKNOWN),
    ):
        assert read(tmp_path, position, message).fix_table.fix_type.tolist() == [expected]


def test_what_the_receiver_calls_invalid_is_unknown(tmp_path: Path) -> None:
    table = read(tmp_path, made.pvt(0, flags3=1), made.pvt(200, flags3=1, short=True)).fix_table
    assert np.isnan(table.latitude_deg).tolist() == [True, False]
    assert np.isnan(table.height_ellipsoid_m).tolist() == [True, False]
    table = read(tmp_path, made.hpposllh(0, (1, 2, 3, 4), (0, 0, 0, 0), (0, 2**32 - 1), flags=1)).fix_table
    assert np.isnan(table.longitude_deg).all()
    assert np.isnan(table.sigma_horizontal_m).all()
    assert np.isnan(table.sigma_vertical_m).all()


def test_zeros_without_a_fix_are_no_position(tmp_path: Path) -> None:
    message = made.pvt(0, fix=(0, 0), lat=0, lon=0, heights=(0, -17_000), accuracies=(2**32 - 1, 2**32 - 1))
    table = read(tmp_path, message, made.pvt(200, lat=0, lon=0)).fix_table
    assert np.isnan(table.latitude_deg).tolist() == [True, False]
    assert np.isnan(table.height_geoid_m).tolist() == [True, False]
    assert np.isnan(table.sigma_horizontal_m).tolist() == [True, False]


def test_version_and_texts(tmp_path: Path) -> None:
    def padded(text: str, size: int) -> bytes:
        return text.encode("ascii").ljust(size, b"\0")

    version = padded("EXT CORE 1.00", 30) + padded("00190000", 10)
    version += padded("FWVER=HPG 1.32", 30) + padded("PROTVER=27.31", 30) + padded("MOD=ZED-F9P", 30)
    log = read(tmp_path, made.ubx(0x0A, 0x04, version), made.ubx(0x04, 0x02, b"ANTSTATUS=OK"))
    assert log.vehicle == "u-blox ZED-F9P hardware 00190000 firmware HPG 1.32"
    assert log.texts == ("ANTSTATUS=OK",)
    assert "there are no positions in it" in log.notes
    old = padded("7.03 (45969)", 30) + padded("00040007", 10)
    assert read(tmp_path, made.ubx(0x0A, 0x04, old)).vehicle == "u-blox hardware 00040007 firmware 7.03 (45969)"


def test_counts_all_kinds_of_messages(tmp_path: Path) -> None:
    position = struct.pack(">H", 1005 << 4) + bytes(17)
    log = read(
        tmp_path, made.pvt(0), made.pvt(200), made.ubx(0x01, 0x5F, b""), made.ubx(0x41, 0x02, bytes(40)),
        made.nmea("GNGGA,,,,,,0,00,99.99,,,,,,"), made.rtcm(position), made.rtcm(b""), made.ubx(0x01, 0x07, bytes(20)),
    )  # fmt: skip
    expected = {"NAV-PVT": 3, "NAV-0x5F": 1, "UBX-0x4102": 1, "GNGGA": 1, "RTCM 1005": 1, "RTCM": 1}
    assert log.message_counts == expected
    assert log.damage.lost_bytes == 0
    assert len(log.fix_table) == 2, "a frame too short to be decoded is counted only"


def test_nmea_positions_only_where_there_is_no_other(tmp_path: Path) -> None:
    sentences = made.nmea("GPRMC,120000.00,A,4717.5,N,00833.9,E,0.0,,050126,,,A")
    assert read(tmp_path, made.pvt(0), sentences).fix_table.latitude_deg.tolist() == [35.6]
    log = read(tmp_path, made.status(0, 3, 0x0D), sentences)
    assert log.kind is LogKind.UBX
    assert log.fix_table.latitude_deg == pytest.approx(47 + 17.5 / 60)


def test_raw_measurements_are_handed_on_whole(tmp_path: Path) -> None:
    rawx, sfrbx, raw = made.ubx(2, 0x15, bytes(48)), made.ubx(2, 0x13, bytes(16)), made.ubx(2, 0x10, bytes(32))
    path = tmp_path / "raw.ubx"
    path.write_bytes(rawx + made.pvt(0) + sfrbx + rawx[:-1] + made.nmea("GPTXT,01,01,02,x") + raw)
    assert list(ubx.raw_measurements(path)) == [rawx, sfrbx, raw]
    log = ubx.read_log(path, silent)
    assert {name: log.message_counts[name] for name in ("RXM-RAWX", "RXM-SFRBX", "RXM-RAW")} == dict.fromkeys(
        ("RXM-RAWX", "RXM-SFRBX", "RXM-RAW"), 1
    )
    assert any("raw measurements" in note for note in log.notes)


def test_names_agree_with_what_is_decoded() -> None:
    assert set(JOINED) <= {NAMES[code] for code in DECODED}
    assert [name_of_frame(code) for code in (0x0107, 0x0D03, 0x0215)] == ["NAV-PVT", "TIM-TM2", "RXM-RAWX"]


def test_file_without_a_message_is_an_error(tmp_path: Path) -> None:
    for data in (b"", b"not a receiver's stream", bytes(100_000), made.pvt(0)[:-1]):
        with pytest.raises(InputError, match="receiver"):
            read(tmp_path, data)
    with pytest.raises(InputError, match="cannot be read"):
        ubx.read_log(tmp_path / "none.ubx", silent)


def test_solution_alone_gives_its_geocentric_position(tmp_path: Path) -> None:
    import pyproj

    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    for latitude, longitude, height_m in ((53.36, -2.31, 112.7), (-35.6, 139.7, 4000.0), (0.0, 180.0, -30.0)):
        ecef = np.round(np.array(to_ecef.transform(longitude, latitude, height_m)) * 100).astype(int).tolist()
        payload = struct.pack("<IihBB3iI3iIHBBI", 5000, 0, made.WEEK, 3, 0x0D, *ecef, 300, 0, 0, 0, 50, 150, 0, 9, 0)
        table = read(tmp_path, made.ubx(0x01, 0x06, payload)).fix_table
        assert table.latitude_deg == pytest.approx(latitude, abs=1e-7)
        assert abs(table.longitude_deg[0]) == pytest.approx(abs(longitude), abs=1e-7)
        assert table.height_ellipsoid_m == pytest.approx(height_m, abs=0.01)
        assert np.isnan(table.height_geoid_m).all()
        assert table.sigma_horizontal_m == pytest.approx(3.0 / 3**0.5)
        assert table.sigma_vertical_m == pytest.approx(3.0 / 3**0.5)
    table = read(tmp_path, made.sol(5000, 0, made.WEEK, 0, 0)).fix_table
    assert np.isnan(table.latitude_deg).all()


def test_invalid_precise_position_gives_way_to_the_other(tmp_path: Path) -> None:
    table = read(tmp_path, made.pvt(0), made.hpposllh(0, (0, 0, 0, 0), (0, 0, 0, 0), (0, 0), flags=1)).fix_table
    assert table.latitude_deg.tolist() == [35.6]
    assert table.sigma_vertical_m.tolist() == [2.5]


def test_progress_ends_with_the_file(tmp_path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    path = tmp_path / "receiver.ubx"
    path.write_bytes(made.pvt(0) * 3 + b"rest")
    ubx.read_log(path, lambda *call: calls.append(call))
    total = path.stat().st_size
    assert calls[-1] == ("reading", total, total)
    assert all(done <= total for _, done, _ in calls)
