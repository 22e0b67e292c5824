"""Dataflash logs, binary: known values in, the same values out; recorded flights against truth and pymavlink."""

import ast
import json
import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.dataflash_made import BOOT_US, MODERN, WEEK, WEEK_MS, MadeLog, fmt, gps_ns, small_flight
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME, WEEK_NS, gps_times_ns_from_unix_ns
from uavkit.formats import dataflash
from uavkit.formats.dataflash_fields import WANTED

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
SIM_LOGS = Path(__file__).resolve().parents[2] / "sim_logs"
DEG = np.pi / 180.0


def read(tmp_path: Path, log: "MadeLog | bytes") -> FlightLog:
    path = tmp_path / "made.BIN"
    path.write_bytes(log if isinstance(log, bytes) else bytes(log.data))
    assert dataflash.recognises(path.read_bytes()[:65536])
    return dataflash.read_log(path)


def test_every_field_of_a_fix(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.gps(BOOT_US, Lat=-358000916, Lng=-1396501063, Spd=2.0, GCrs=30.0, VZ=0.25)
    log.gps(BOOT_US + 200_000, number=1, Status=3, NSats=9)
    fixes = read(tmp_path, log).fix_table
    assert fixes.latitude_deg.tolist() == [-35.8000916, 35.8000916]
    assert fixes.longitude_deg.tolist() == [-139.6501063, 139.6501063]
    assert fixes.height_geoid_m.tolist() == [20.07, 20.07]
    assert fixes.height_ellipsoid_m.tolist() == [42.12, 42.12]
    assert np.isnan(fixes.height_above_home_m).all()
    np.testing.assert_allclose(fixes.velocity_m_s, [[1.0, np.sqrt(3.0), -0.25], [4.0, 0.0, 0.5]], atol=1e-12)
    assert fixes.sigma_horizontal_m.tolist() == [0.3, 0.3]
    assert fixes.sigma_vertical_m.tolist() == [0.45, 0.45]
    assert fixes.fix_type.tolist() == [FixType.RTK_FIXED, FixType.THREE_DIMENSIONAL]
    assert fixes.satellites.tolist() == [14, 9]
    assert fixes.receiver.tolist() == [0, 1]
    assert fixes.when.boot_ns.tolist() == [BOOT_US * 1000, (BOOT_US + 200_000) * 1000]
    assert fixes.when.gps_ns.tolist() == [gps_ns(BOOT_US), gps_ns(BOOT_US + 200_000)]


def test_what_a_receiver_does_not_know_is_nan(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.add("GPS", BOOT_US, 0, 1, 0, 0, 0, 9999, 0, 0, 1700, 0.0, 0.0, 0.0, 0.0, 1)
    log.add("GPA", BOOT_US, 0, 0, 0, 65535, 0, 0.0, 0, 0, 0, -(2**31), 0, 0)
    fixes = read(tmp_path, log).fix_table
    for column in (fixes.latitude_deg, fixes.height_ellipsoid_m, fixes.sigma_horizontal_m, fixes.sigma_vertical_m):
        assert np.isnan(column).all()
    assert np.isnan(fixes.velocity_m_s[0, 2])
    assert fixes.fix_type.tolist() == [FixType.NO_FIX]
    assert fixes.when.gps_ns.tolist() == [NO_TIME]


def test_undulation_is_the_height_of_the_ellipsoid_above_sea_level(tmp_path: Path) -> None:
    """AP_GPS fills it with height above sea level minus ellipsoidal height: -38.5 m in Japan, where N is +38.5 m."""
    kinds = dict(MODERN) | {
        "GPA": (95, "QBCCCCfBIHfHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und,RTCMFU,RTCMFD")
    }
    log = MadeLog(kinds=kinds).define_all()
    for k, undulation_m in enumerate((-38.5, 0.0)):
        log.add("GPS", BOOT_US + k, 0, 6, WEEK_MS, WEEK, 14, 121, 358000916, 1396501063, 2007, 4.0, 0.0, 0.0, 0.0, 1)
        log.add("GPA", BOOT_US + k, 0, 200, 30, 45, 7, 0.0, 1, BOOT_US // 1000, 200, undulation_m, 0, 0)
    np.testing.assert_allclose(read(tmp_path, log).fix_table.height_ellipsoid_m, [58.57, np.nan])


def test_every_field_of_attitude_estimate_and_exposure(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    for k in range(3):
        log.gps(BOOT_US + 200_000 * k)
    log.add("ATT", BOOT_US + 500_000, 1.0, -10.0, 2.0, 5.0, 3.0, 350.0, 3)
    log.add("POS", BOOT_US + 510_000, 358000001, -1396500002, 20.5, 15.25, 14.0)
    log.cam("CAM", BOOT_US + 543_210, 7)
    result = read(tmp_path, log)
    attitude, estimate, exposure = result.attitude_table, result.estimate_table, result.exposure_table
    assert [attitude.roll_rad[0], attitude.pitch_rad[0], attitude.yaw_rad[0]] == [-10 * DEG, 5 * DEG, 350 * DEG]
    assert attitude.when.boot_ns.tolist() == [(BOOT_US + 500_000) * 1000]
    assert attitude.when.gps_ns.tolist() == [gps_ns(BOOT_US + 500_000)]
    assert [estimate.latitude_deg[0], estimate.longitude_deg[0]] == [35.8000001, -139.6500002]
    assert [estimate.height_geoid_m[0], estimate.height_above_home_m[0]] == [20.5, 15.25]
    assert np.isnan(estimate.height_ellipsoid_m).all()
    assert exposure.when.boot_ns.tolist() == [(BOOT_US + 543_210) * 1000]
    assert exposure.when.gps_ns.tolist() == [gps_ns(BOOT_US + 543_210)], "not the time of the fix before it"
    assert [exposure.latitude_deg[0], exposure.longitude_deg[0]] == [35.8000924, 139.6501023]
    assert [exposure.height_geoid_m[0], exposure.height_above_home_m[0]] == [20.06, 14.99]
    np.testing.assert_allclose(
        [exposure.roll_rad[0], exposure.pitch_rad[0], exposure.yaw_rad[0]], [-9.31 * DEG, -3.72 * DEG, 359.74 * DEG]
    )
    assert exposure.sequence.tolist() == [7]
    assert exposure.kind.tolist() == [ExposureKind.TRIGGER]
    assert exposure.sigma_s.tolist() == [0.05]


def test_texts_parameters_and_vehicle(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.add("MSG", BOOT_US, b"Arming motors")
    log.add("MSG", BOOT_US, b"ArduCopter V4.6.3 (92b0cd78)")
    log.add("PARM", BOOT_US, b"WPNAV_SPEED", 500.0, 0.0)
    log.add("PARM", BOOT_US, b"WPNAV_SPEED", 400.0, 0.0)
    log.add("PARM", BOOT_US, b"ABCDEFGHIJKLMNOP", 0.5, 0.0)
    result = read(tmp_path, log)
    assert result.kind is LogKind.DATAFLASH
    assert result.vehicle == "ArduCopter V4.6.3 (92b0cd78)"
    assert result.texts == ("Arming motors", "ArduCopter V4.6.3 (92b0cd78)")
    assert result.parameters == {"WPNAV_SPEED": 400.0, "ABCDEFGHIJKLMNOP": 0.5}
    assert result.message_counts == {"FMT": 12, "MSG": 2, "PARM": 3}


def with_pin(pin: float) -> MadeLog:
    log = MadeLog().define_all()
    log.add("PARM", BOOT_US, b"CAM1_FEEDBAK_PIN", pin, 0.0)
    for k in range(3):
        log.gps(BOOT_US + 200_000 * k)
    return log


def test_with_a_pin_an_exposure_is_listed_once_and_an_unconfirmed_command_stays(tmp_path: Path) -> None:
    log = with_pin(54.0)
    for k in range(4):
        log.cam("TRIG", BOOT_US + 3_000_000 * k, k)
        if k != 2:
            log.cam("CAM", BOOT_US + 3_000_000 * k + 800, k)
    result = read(tmp_path, log)
    feedback, trigger = ExposureKind.FEEDBACK, ExposureKind.TRIGGER
    assert result.exposure_table.kind.tolist() == [feedback, feedback, trigger, feedback]
    assert ((result.exposure_table.when.boot_ns // 1000 - BOOT_US) % 3_000_000).tolist() == [800, 800, 0, 800]
    assert result.exposure_table.sigma_s.tolist() == [0.001, 0.001, 0.05, 0.001]
    assert any("1 commands" in note for note in result.notes)


def test_a_late_contact_is_of_its_own_command_and_a_contact_alone_is_an_exposure(tmp_path: Path) -> None:
    """A camera lags by 0.6 s and misses one; one more picture is taken by hand."""
    log = with_pin(54.0)
    for k in range(3):
        log.cam("TRIG", BOOT_US + 1_000_000 * k, k)
        if k != 1:
            log.cam("CAM", BOOT_US + 1_000_000 * k + 600_000, k)
    log.cam("CAM", BOOT_US + 9_000_000, 3)
    kinds = read(tmp_path, log).exposure_table.kind.tolist()
    assert kinds == [ExposureKind.FEEDBACK, ExposureKind.TRIGGER, ExposureKind.FEEDBACK, ExposureKind.FEEDBACK]


def test_a_confirmed_command_shows_a_pin_where_the_parameters_are_lost(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.cam("TRIG", BOOT_US, 0)
    log.cam("CAM", BOOT_US + 800, 0)
    assert read(tmp_path, log).exposure_table.kind.tolist() == [ExposureKind.FEEDBACK]


def test_the_pin_by_its_name_in_older_firmware(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.add("PARM", BOOT_US, b"CAM_FEEDBACK_PIN", 50.0, 0.0)
    log.cam("CAM", BOOT_US, 0)
    assert read(tmp_path, log).exposure_table.kind.tolist() == [ExposureKind.FEEDBACK]


@pytest.mark.parametrize("pin", [-1.0, 0.0])
def test_without_a_pin_an_exposure_is_a_command(tmp_path: Path, pin: float) -> None:
    log = with_pin(pin)
    log.cam("CAM", BOOT_US, 0)
    result = read(tmp_path, log)
    assert result.exposure_table.kind.tolist() == [ExposureKind.TRIGGER]
    assert any("no feedback pin" in note for note in result.notes)


def test_of_several_cameras_the_first_is_taken(tmp_path: Path) -> None:
    log = with_pin(54.0)
    for k in range(4):
        log.cam("CAM", BOOT_US + k, k, number=k % 2)
    result = read(tmp_path, log)
    assert result.exposure_table.sequence.tolist() == [0, 2]
    assert any("several cameras" in note and "not of 2" in note for note in result.notes)


OLD = {
    "PARM": (129, "Nf", "Name,Value"),
    "GPS": (130, "BIHBcLLeeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T"),
    "ATT": (131, "IccCCC", "TimeMS,Roll,Pitch,Yaw,ErrorRP,ErrorYaw"),
    "CAM": (132, "IHLLeccC", "GPSTime,GPSWeek,Lat,Lng,Alt,Roll,Pitch,Yaw"),
    "MSG": (133, "Z", "Message"),
}


def test_firmware_of_2013(tmp_path: Path) -> None:
    """Times in milliseconds, GPS time in TimeMS, boot time in T, exposures without a boot time."""
    log = MadeLog(kinds=dict(OLD)).define_all()
    log.add("MSG", b"ArduCopter V3.1.2")
    log.add("PARM", b"CAM_TRIGG_DIST", 12.5)
    for k in range(5):
        boot_ms = 60_000 + 200 * k
        log.add("ATT", boot_ms, 150, -250, 35_000, 0, 0)
        if k == 3:
            log.add("CAM", 130_040_400, 1769, -353547178, 1491696673, 5842, 150, -250, 9000)
        log.add("GPS", 3, 130_040_000 + 200 * k, 1769, 9, 150, -353547178, 1491696673, 1000, 58420, 150, 9000, 0.125,
                boot_ms + 50)  # fmt: skip
    result = read(tmp_path, log)
    assert result.vehicle == "ArduCopter V3.1.2"
    assert result.parameters == {"CAM_TRIGG_DIST": 12.5}
    fixes = result.fix_table
    assert fixes.when.gps_ns[0] == 1769 * WEEK_NS + 130_040_000 * 1_000_000
    assert fixes.when.boot_ns[0] == 60_050 * 1_000_000
    assert [fixes.height_geoid_m[0], fixes.height_above_home_m[0]] == [584.2, 10.0]
    np.testing.assert_allclose(fixes.velocity_m_s[0], [1.5, 0.0, -0.125], atol=1e-12)
    attitude = result.attitude_table
    np.testing.assert_allclose([attitude.roll_rad[0], attitude.pitch_rad[0]], [1.5 * DEG, -2.5 * DEG])
    np.testing.assert_allclose(attitude.yaw_rad[0], 350 * DEG)
    assert attitude.when.gps_ns[0] == 1769 * WEEK_NS + 130_039_950 * 1_000_000
    exposure = result.exposure_table
    assert exposure.when.boot_ns.tolist() == [60_625 * 1_000_000]
    np.testing.assert_allclose(exposure.sigma_s, np.hypot(0.05, 0.025 / np.sqrt(3.0)))
    assert np.isnan(exposure.height_geoid_m).all(), "above home or above the sea: nobody knows"
    assert exposure.latitude_deg.tolist() == [-35.3547178]


def test_a_receiver_that_counts_weeks_modulo_1024(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    for k in range(3):
        log.gps(BOOT_US + 200_000 * k, GWk=WEEK % 1024)
    result = read(tmp_path, log)
    assert result.fix_table.when.gps_ns[0] == gps_ns(BOOT_US)
    assert any("modulo 1024" in note for note in result.notes)


def test_a_time_that_is_not_yet_set_is_none(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.gps(BOOT_US - 400_000, GWk=0, GMS=0)
    log.gps(BOOT_US - 200_000, GWk=WEEK - 30, GMS=5)
    for k in range(30):
        log.gps(BOOT_US + 200_000 * k)
    result = read(tmp_path, log)
    assert result.fix_table.when.gps_ns[:2].tolist() == [gps_ns(BOOT_US - 400_000), gps_ns(BOOT_US - 200_000)]
    assert result.clock is not None
    assert result.clock.rejected == 1


def test_a_log_without_gps_has_a_note_and_no_rows(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.add("ATT", BOOT_US, 0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 3)
    log.cam("CAM", BOOT_US + 5, 0)
    result = read(tmp_path, log)
    assert (len(result.fix_table), len(result.attitude_table), len(result.exposure_table)) == (0, 1, 1)
    assert result.attitude_table.when.gps_ns.tolist() == [NO_TIME]
    assert result.clock is None
    assert any("no GPS messages" in note for note in result.notes)


def test_definitions_only(tmp_path: Path) -> None:
    result = read(tmp_path, MadeLog().define_all())
    assert result.message_counts == {"FMT": 12}
    assert list(result.fixes()) == list(result.exposures()) == []


def test_zeros_at_the_end_are_space_set_aside(tmp_path: Path) -> None:
    log = small_flight(np.random.default_rng(1), 1)
    result = read(tmp_path, bytes(log.data) + bytes(100_000))
    assert result.damage.lost_bytes == 100_000
    assert any("100000 zero bytes" in note for note in result.notes)
    assert result.message_counts["ATT"] == 25


def test_an_early_download_is_a_prefix(tmp_path: Path) -> None:
    log = small_flight(np.random.default_rng(1), 1)
    begin, end, _ = log.messages[-1]
    result = read(tmp_path, bytes(log.data[: end - 5]))
    assert result.damage.lost_bytes == end - 5 - begin
    assert [span.why for span in result.damage.spans] == ["a message cut short by the end of the file"]


def test_a_definition_is_good_for_what_stands_before_it(tmp_path: Path) -> None:
    """The log begins in the middle; the firmware wrote its definitions again later."""
    log = MadeLog()
    for k in range(10):
        log.add("ATT", BOOT_US + k, 0.0, float(k), 0.0, 2.0, 0.0, 3.0, 3)
    log.define_all()
    log.add("EV", BOOT_US + 11, 1)
    result = read(tmp_path, b"\x01\x02\x03" + bytes(log.data))
    np.testing.assert_allclose(result.attitude_table.roll_rad / DEG, range(10))
    assert result.damage.lost_bytes == 3


def test_messages_that_nothing_defines_are_named(tmp_path: Path) -> None:
    log = MadeLog()
    for name in MODERN:
        if name != "EV":
            log.define(name)
    for k in range(10):
        log.add("ATT", BOOT_US + 2 * k, 0.0, float(k), 0.0, 2.0, 0.0, 3.0, 3)
        log.add("EV", BOOT_US + 2 * k + 1, 1)
    result = read(tmp_path, log)
    assert result.message_counts == {"FMT": 10, "ATT": 10}
    assert result.damage.lost_bytes == 10 * log.length("EV")
    assert result.damage.span_count == 10
    assert any("type 112 begin at 10 places" in note for note in result.notes)


def test_a_message_without_time_between_undefined_ones_is_found(tmp_path: Path) -> None:
    log = MadeLog()
    log.define("FILE")
    for k in range(10):
        log.add("EV", BOOT_US + k, 1)
        log.add("FILE", b"@SYS/uarts.txt", k, 64, b"what")
    log.add("EV", BOOT_US, 1)
    result = read(tmp_path, log)
    assert result.message_counts == {"FMT": 1, "FILE": 10}
    assert result.damage.lost_bytes == 11 * log.length("EV")


def test_no_definitions_at_all(tmp_path: Path) -> None:
    log = MadeLog()
    for k in range(100):
        log.add("ATT", BOOT_US + k, 0.0, float(k), 0.0, 2.0, 0.0, 3.0, 3)
    with pytest.raises(InputError, match="no definitions"):
        read(tmp_path, log)


@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"hello\n" * 100])
def test_what_cannot_be_read_says_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.BIN"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"log\.BIN: holds no definitions"):
        dataflash.read_log(path)
    for nothing in (tmp_path, tmp_path / "none.BIN"):
        with pytest.raises(InputError, match="cannot be read"):
            dataflash.read_log(nothing)


def test_a_type_that_is_defined_anew(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.add("ATT", BOOT_US, 0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 3)
    log.kinds["ATT"] = (72, "Qccc", "TimeUS,Roll,Pitch,Yaw")
    log.define("ATT")
    for k in range(5):
        log.add("ATT", BOOT_US + 1 + k, 500, 600, 700)
    result = read(tmp_path, log)
    np.testing.assert_allclose(result.attitude_table.roll_rad / DEG, [1.0, 5.0, 5.0, 5.0, 5.0, 5.0])
    assert result.damage.lost_bytes == 0


def test_a_damaged_definition_of_another_type_is_left_out(tmp_path: Path) -> None:
    """A flipped bit makes the definition of one type that of another, whose messages do not fit it."""
    log = MadeLog().define_all()
    log.raw(fmt(72, "EV", "QB", "TimeUS,Id"))
    for k in range(5):
        log.add("ATT", BOOT_US + k, 0.0, float(k), 0.0, 2.0, 0.0, 3.0, 3)
    result = read(tmp_path, log)
    np.testing.assert_allclose(result.attitude_table.roll_rad / DEG, range(5))
    assert any("does not fit" in note for note in result.notes)


def test_a_kind_with_columns_of_the_future_is_counted(tmp_path: Path) -> None:
    kinds = {name: kind for name, kind in MODERN.items() if name != "ATT"}
    log = MadeLog(kinds=kinds).define_all()
    log.raw(fmt(72, "ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw", length=25).replace(b"Qfff", b"Qxff"))
    for k in range(3):
        log.raw(b"\xa3\x95\x48" + bytes([k]) + bytes(21))
    result = read(tmp_path, log)
    assert result.message_counts["ATT"] == 3
    assert len(result.attitude_table) == 0
    assert any("ATT has columns" in note for note in result.notes)


def test_columns_of_the_future_are_passed_over(tmp_path: Path) -> None:
    log = MadeLog().define_all()
    log.raw(
        fmt(200, "NEW", "", "TimeUS,What", length=21)[:9] + b"Qx".ljust(16, b"\0") + b"TimeUS,What".ljust(64, b"\0")
    )
    log.raw(b"\xa3\x95\xc8" + bytes(18))
    log.add("ATT", BOOT_US, 0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 3)
    result = read(tmp_path, log)
    assert result.message_counts["NEW"] == 1
    assert result.message_counts["ATT"] == 1
    assert result.damage.lost_bytes == 0


def test_two_logs_at_once(tmp_path: Path) -> None:
    logs = [small_flight(np.random.default_rng(k), 4 + k) for k in range(2)]
    alone = [dataflash.read_log(write(tmp_path / f"{k}.BIN", log)) for k, log in enumerate(logs)]
    together: dict[int, list[FlightLog]] = {0: [], 1: []}

    def work(k: int) -> None:
        for _ in range(10):
            together[k].append(dataflash.read_log(tmp_path / f"{k}.BIN"))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in range(2):
        assert len(together[k]) == 10
        for result in together[k]:
            assert result.message_counts == alone[k].message_counts
            np.testing.assert_array_equal(result.attitude_table.yaw_rad, alone[k].attitude_table.yaw_rad)


def write(path: Path, log: MadeLog) -> Path:
    path.write_bytes(bytes(log.data))
    return path


def test_what_is_no_dataflash_log_is_not_recognised() -> None:
    rng = np.random.default_rng(5)
    assert not dataflash.recognises(rng.integers(0, 256, 65536, dtype=np.uint8).tobytes())
    assert not dataflash.recognises(b"")
    assert not dataflash.recognises(b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n" * 50)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=40)), max_size=8), st.binary(max_size=300))
def test_no_bytes_whatever_end_in_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, bytes]], rest: bytes
) -> None:
    data = bytearray(FUZZED)
    for place, piece in changes:
        at = place % len(data)
        data[at : at + len(piece)] = piece
    path = tmp_path_factory.mktemp("fuzz") / "fuzz.BIN"
    for content in (bytes(data) + rest, rest, bytes(data[::-1])):
        path.write_bytes(content)
        try:
            result = dataflash.read_log(path)
        except InputError:
            continue
        assert 0 <= result.damage.lost_bytes <= len(content)
        list(result.fixes()), list(result.exposures()), list(result.attitudes())


FUZZED = bytes(small_flight(np.random.default_rng(9), 1).data)


@settings(max_examples=40, deadline=None)
@given(st.text(alphabet="abBhHiIfdgnNZcCeEfLMqQxX?", max_size=16), st.text(max_size=30), st.binary(max_size=400))
def test_no_definition_whatever_ends_in_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, characters: str, columns: str, rest: bytes
) -> None:
    sizes = {"a": 64, "b": 1, "B": 1, "M": 1, "h": 2, "H": 2, "c": 2, "C": 2, "g": 2, "n": 4, "N": 16, "Z": 64}
    length = 3 + sum(sizes.get(c, 8 if c in "dqQ" else 4) for c in characters)
    path = tmp_path_factory.mktemp("fuzz") / "fuzz.BIN"
    log = MadeLog().define_all()
    for name in ("GPS", "CAM", "PARM", "POS"):
        head = b"\xa3\x95\x80" + bytes([log.kinds[name][0], length % 256]) + name.encode().ljust(4, b"\0")
        log.raw(head + characters.encode().ljust(16, b"\0") + columns.encode()[:64].ljust(64, b"\0"))
        log.raw((b"\xa3\x95" + bytes([log.kinds[name][0]]) + rest)[: length % 256])
    path.write_bytes(bytes(log.data))
    dataflash.read_log(path)


FLIGHTS = [
    (SIM_LOGS / "sitl_distance_trigger" / "flight.BIN", SIM_LOGS / "sitl_distance_trigger" / "exposures.json"),
    (SIM_LOGS / "sitl_waypoint_trigger" / "flight.BIN", SIM_LOGS / "sitl_waypoint_trigger" / "exposures.json"),
    (DATA / "sitl" / "dist.BIN", DATA / "sitl" / "dist_truth.json"),
    (DATA / "sitl" / "digicam.BIN", DATA / "sitl" / "digicam_truth.json"),
]


def here(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


@pytest.mark.parametrize(("path", "truth"), FLIGHTS, ids=lambda value: f"{value.parent.name}-{value.name}")
def test_every_exposure_of_a_flight(path: Path, truth: Path) -> None:
    """Against what the vehicle sent while it flew: positions to the digit, heights and angles to the log's 0.01."""
    exposures = dataflash.read_log(here(path)).exposure_table
    sent = json.loads(truth.read_text())["camera_feedback"]
    assert len(exposures) == len(sent) > 30
    assert exposures.sequence.tolist() == [message["img_idx"] for message in sent]
    for column, key, unit in (
        (exposures.latitude_deg, "lat", 1e-7),
        (exposures.longitude_deg, "lng", 1e-7),
        (exposures.height_geoid_m, "alt_msl", 1.0),
        (exposures.height_above_home_m, "alt_rel", 1.0),
        (exposures.roll_rad, "roll", DEG),
        (exposures.pitch_rad, "pitch", DEG),
        (exposures.yaw_rad, "yaw", DEG),
    ):
        resolution = 1e-7 if unit == 1e-7 else 0.01 * unit
        assert np.abs(column - np.array([message[key] for message in sent]) * unit).max() < 0.51 * resolution
    assert set(exposures.kind.tolist()) == {ExposureKind.TRIGGER}
    sent_ns = gps_times_ns_from_unix_ns(np.array([message["time_usec"] for message in sent]) * 1000)
    assert np.abs(exposures.when.gps_ns - sent_ns).max() < 1_000_000, "the vehicle's own GPS time, in milliseconds"


@pytest.mark.parametrize("path", [FLIGHTS[0][0], FLIGHTS[2][0]], ids=["cut", "whole"])
def test_every_column_is_that_of_pymavlink(path: Path) -> None:
    from pymavlink import DFReader

    ours = dataflash.read_messages(here(path))
    with DFReader.DFReader_binary(str(path)) as reader:
        names = {known.name: kind for kind, known in reader.formats.items()}
        counts = {known.name: len(reader.offsets[kind]) for kind, known in reader.formats.items()}
        assert {name: count for name, count in counts.items() if count} == dict(ours.counts) | cut_short(ours, counts)
        theirs: dict[str, list[list[object]]] = {name: [] for name in WANTED}
        while (message := reader.recv_match(type=list(WANTED), strict=True)) is not None:
            theirs[message.get_type()].append([getattr(message, column) for column in message.get_fieldnames()])
        for name in WANTED & {known for known, kind in names.items() if reader.offsets[kind]}:
            rows = ours.of(name)
            assert len(rows) == len(theirs[name])
            for column, values in zip(rows.columns, zip(*theirs[name], strict=True), strict=True):
                if isinstance(values[0], str):
                    assert rows.texts(column) == values
                else:
                    np.testing.assert_array_equal(rows.number(column), np.array(values, dtype=np.float64))


def cut_short(ours: "dataflash.Messages", counts: dict[str, int]) -> dict[str, int]:
    """Return the count of the type of the last message: pymavlink counts it although it is cut short."""
    more = {name: count for name, count in counts.items() if count == ours.counts.get(name, 0) + 1}
    assert len(more) <= (1 if ours.damage.lost_bytes else 0)
    return more


def test_the_published_dump_of_a_log() -> None:
    """Line by line: all columns of the kinds that are decoded, and how many messages of each kind there are."""
    folder = here(DATA / "logs" / "dataflash_pymavlink")
    ours = dataflash.read_messages(folder / "tests_test.BIN")
    lines = (folder / "tests_test.BIN.py3.dumped").read_text(errors="replace").splitlines()
    found = [re.match(r"\d{4}-\d\d-\d\d [\d:.]+: (\w+) \{(.*)\}$", line) for line in lines]
    dumped: dict[str, list[str]] = {}
    for match in found:
        if match:
            dumped.setdefault(match.group(1), []).append(match.group(2))
    assert {name: len(rows) for name, rows in dumped.items()} == dict(ours.counts)
    for name in WANTED & dumped.keys():
        rows = ours.of(name)
        columns = {
            column: rows.texts(column) or () for column in rows.columns if rows.columns[column].dtype.kind == "S"
        }
        for k, line in enumerate(dumped[name]):
            values = dict(part.split(" : ", 1) for part in re.split(r", (?=\w+ : )", line))
            assert values.keys() == rows.columns.keys()
            for column, value in values.items():
                if column in columns:
                    assert columns[column][k] == value
                else:
                    np.testing.assert_allclose(rows.number(column)[k], ast.literal_eval(value), rtol=3e-16)
    assert len(dumped["PARM"]) == 809


def repeated(path: Path, size: int) -> Path:
    """Write a log of at least a size by repeating a recorded one."""
    data = here(FLIGHTS[0][0]).read_bytes()
    whole = here(FLIGHTS[2][0]).read_bytes()[:15_757_262] if size > 10**8 else data
    with path.open("wb") as stream:
        for _ in range(-(-size // len(whole))):
            stream.write(whole)
    return path


def time_both(path: Path) -> tuple[float, float, FlightLog]:
    """Return seconds of ours and of pymavlink's, the least of several runs in turn."""
    from pymavlink import DFReader

    ours, theirs = [], []
    for _ in range(2):
        begin = time.perf_counter()
        log = dataflash.read_log(path)
        ours.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        with DFReader.DFReader_binary(str(path)) as reader:
            while reader.recv_match(type=["CAM", "GPS", "ATT", "POS"], strict=True) is not None:
                pass
        theirs.append(time.perf_counter() - begin)
    return min(ours), min(theirs), log


def test_reading_is_faster_than_pymavlink(tmp_path: Path) -> None:
    """On 10 MB that are nearly all decoded; a message filter spares pymavlink what nobody wants."""
    path = repeated(tmp_path / "long.BIN", 10_000_000)
    dataflash.read_log(FLIGHTS[0][0])
    ours_s, theirs_s, log = time_both(path)
    assert len(log.exposure_table) == 31 * 50
    assert ours_s < theirs_s / 3.0


@pytest.mark.slow
def test_200_mb_in_two_seconds_with_little_memory(tmp_path: Path) -> None:
    import tracemalloc

    path = repeated(tmp_path / "long.BIN", 200_000_000)
    dataflash.read_log(FLIGHTS[0][0])
    ours_s, theirs_s, log = time_both(path)
    assert ours_s < 2.0, f"pymavlink: {theirs_s:.2f} s"
    assert len(log.attitude_table) == 13 * 2160
    tracemalloc.start()
    log = dataflash.read_log(path)
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2.0 * kept


def test_junk_and_zeros_are_passed_quickly(tmp_path: Path) -> None:
    log = small_flight(np.random.default_rng(1), 1)
    junk = np.random.default_rng(2).integers(0, 256, 20_000_000, dtype=np.uint8).tobytes()
    begin = time.perf_counter()
    result = read(tmp_path, bytes(log.data) + junk + bytes(50_000_000) + bytes(log.data))
    assert time.perf_counter() - begin < 5.0
    assert result.damage.lost_bytes == 70_000_000
    assert result.message_counts["ATT"] == 50
