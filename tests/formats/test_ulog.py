"""PX4 logs: values that tests encode, recorded flights against their truth, and pyulog as a second reader."""

import json
import struct
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import pyulog

from tests.formats.ulog_made import Made, flight, messages
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME, gps_times_ns_from_unix_ns
from uavkit.core.progress import silent
from uavkit.formats.ulog import read_log, recognises
from uavkit.formats.ulog_file import read_ulog

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
FLIGHT = DATA / "sitl/px4_dist.ulg"
LOGS = (
    DATA / "logs/ulg/test_sample_appended_multiple.ulg",
    DATA / "logs/ulg/test_sample_log_small.ulg",
    DATA / "logs/ulg/test_sample_unordered.ulg",
    FLIGHT,
)
UTC_US = 1_700_000_000_000_000
NEW_GPS = (
    "uint64_t timestamp", "uint64_t timestamp_sample", "double latitude_deg", "double longitude_deg",
    "double altitude_msl_m", "double altitude_ellipsoid_m", "uint64_t time_utc_usec", "float eph", "float epv",
    "float vel_n_m_s", "float vel_e_m_s", "float vel_d_m_s", "int32_t timestamp_time_relative", "uint8_t fix_type",
    "bool vel_ned_valid", "uint8_t satellites_used",
)  # fmt: skip
OLD_GPS = (
    "uint64_t timestamp", "uint64_t time_utc_usec", "int32_t lat", "int32_t lon", "int32_t alt",
    "int32_t alt_ellipsoid", "float eph", "float epv", "uint8_t fix_type", "uint8_t satellites_used",
)  # fmt: skip
CAPTURE = (
    "uint64_t timestamp", "uint64_t timestamp_utc", "double lat", "double lon", "uint32_t seq", "float alt",
    "float ground_distance", "float[4] q", "int8_t result",
)  # fmt: skip
TRIGGER = ("uint64_t timestamp", "uint64_t timestamp_utc", "uint32_t seq", "bool feedback")
CAPTURE_KINDS = "uint64_t uint64_t double double uint32_t float float float float float float int8_t"
TRIGGER_KINDS = "uint64_t uint64_t uint32_t bool"


def kinds_of(fields: tuple[str, ...]) -> str:
    return " ".join(field.split()[0] for field in fields)


def read(log: Made, folder: Path) -> FlightLog:
    path = folder / "log.ulg"
    path.write_bytes(bytes(log.data))
    return read_log(path, silent)


def new_gps(log: Made, number: int, time_us: int, *, utc_us: int | None = None, sample: int = 0, eph: float = 0.5,
            fix: int = 3, valid: bool = True, relative: int = 0, north: float = 1.5) -> None:  # fmt: skip
    utc = UTC_US + time_us if utc_us is None else utc_us
    log.row(number, kinds_of(NEW_GPS), time_us, sample, 35.123456789, -139.5, 120.25, 160.75, utc, eph, 0.75,
            north, -2.5, 3.5, relative, fix, valid, 17)  # fmt: skip


def gps_ns(time_us: int) -> int:
    return int(gps_times_ns_from_unix_ns(np.array([(UTC_US + time_us) * 1000]))[0])


def test_receivers_of_newer_logs(tmp_path: Path) -> None:
    log = Made().flags().format("sensor_gps", *NEW_GPS).subscribe(4, "sensor_gps").subscribe(5, "sensor_gps", 1)
    new_gps(log, 5, 9_990_000, eph=0.0, fix=8)
    new_gps(log, 4, 10_050_000, sample=10_000_000, utc_us=UTC_US + 10_000_000)
    new_gps(log, 4, 10_250_000, sample=10_200_000, utc_us=UTC_US + 10_200_000, valid=False, fix=6)
    table = read(log, tmp_path).fix_table
    assert table.receiver.tolist() == [1, 0, 0]
    assert table.fix_type.tolist() == [FixType.NO_FIX, FixType.THREE_DIMENSIONAL, FixType.RTK_FIXED]
    assert table.when.boot_ns.tolist() == [9_990_000_000, 10_000_000_000, 10_200_000_000]
    assert table.when.gps_ns.tolist() == [gps_ns(9_990_000), gps_ns(10_000_000), gps_ns(10_200_000)]
    assert table.latitude_deg.tolist() == [35.123456789] * 3
    assert table.longitude_deg.tolist() == [-139.5] * 3
    assert table.height_geoid_m.tolist() == [120.25] * 3
    assert table.height_ellipsoid_m.tolist() == [160.75] * 3
    assert np.isnan(table.height_above_home_m).all()
    assert table.velocity_m_s[1].tolist() == [-2.5, 1.5, -3.5]
    assert np.isnan(table.velocity_m_s[2]).all()
    assert np.isnan(table.sigma_horizontal_m[0])
    assert table.sigma_horizontal_m[1] == 0.5
    assert table.sigma_vertical_m.tolist() == [0.75] * 3
    assert table.satellites.tolist() == [17] * 3


def test_receiver_of_older_logs(tmp_path: Path) -> None:
    log = Made().format("vehicle_gps_position", *OLD_GPS).subscribe(0, "vehicle_gps_position")
    log.row(
        0, kinds_of(OLD_GPS), 5_000_000, UTC_US + 5_000_000, 351234567, -1395000001, 120_250, 160_750, 2.5, 4.5, 2, 9
    )
    log.row(0, kinds_of(OLD_GPS), 5_200_000, 0, 0, 0, 0, 0, 4294967.5, 4294967.5, 0, 0)
    read_back = read(log, tmp_path)
    table = read_back.fix_table
    assert table.latitude_deg[0] == pytest.approx(35.1234567, abs=1e-12)
    assert table.longitude_deg[0] == pytest.approx(-139.5000001, abs=1e-12)
    assert (table.height_geoid_m[0], table.height_ellipsoid_m[0]) == (120.25, 160.75)
    assert np.isnan([table.latitude_deg[1], table.height_ellipsoid_m[1], table.sigma_horizontal_m[1]]).all()
    assert table.when.gps_ns.tolist() == [gps_ns(5_000_000), gps_ns(5_200_000)]
    assert len(list(read_back.fixes())) == 1


def test_denser_topic_of_the_receivers_is_taken(tmp_path: Path) -> None:
    """PX4 by default writes sensor_gps once in a second."""
    log = Made().format("sensor_gps", *NEW_GPS).format("vehicle_gps_position", *NEW_GPS)
    log.subscribe(0, "sensor_gps").subscribe(1, "vehicle_gps_position")
    for k in range(20):
        new_gps(log, 1, 10_000_000 + 100_000 * k)
        if k % 10 == 0:
            new_gps(log, 0, 10_000_000 + 100_000 * k)
    told = read(log, tmp_path)
    assert len(told.fix_table) == 20
    assert any("vehicle_gps_position" in note for note in told.notes)


def test_time_of_a_receiver_that_did_not_know_it_yet(tmp_path: Path) -> None:
    log = Made().format("sensor_gps", *NEW_GPS).subscribe(0, "sensor_gps")
    for k in range(60):
        wrong = {0: 0, 1: 315_964_800_000_000, 2: UTC_US + 200_000 * k + 3_000_000}
        new_gps(log, 0, 200_000 * (k + 1), utc_us=wrong.get(k))
    told = read(log, tmp_path)
    assert told.clock is not None
    assert told.clock.rejected == 1
    assert np.abs(told.fix_table.when.gps_ns - [gps_ns(200_000 * (k + 1)) for k in range(60)]).max() < 1000
    assert any("1 times of the receiver" in note for note in told.notes)


def test_time_that_is_told_for_another_instant(tmp_path: Path) -> None:
    """UTC is that of timestamp plus timestamp_time_relative."""
    log = Made().format("sensor_gps", *NEW_GPS).subscribe(0, "sensor_gps")
    for k in range(30):
        new_gps(log, 0, 200_000 * (k + 1), utc_us=UTC_US + 200_000 * (k + 1) - 70_000, relative=-70_000)
    told = read(log, tmp_path)
    assert told.fix_table.when.gps_ns.tolist() == [gps_ns(200_000 * (k + 1)) for k in range(30)]
    assert told.clock is not None
    assert abs(int(told.clock.gps_ns(np.array([3_000_000_000]))[0]) - gps_ns(3_000_000)) < 1000


def test_estimates_with_velocities(tmp_path: Path) -> None:
    log = Made()
    log.format("vehicle_global_position", "uint64_t timestamp", "double lat", "double lon", "float alt",
               "float alt_ellipsoid", "float eph", "float epv", "bool alt_valid")  # fmt: skip
    log.format("vehicle_local_position", "uint64_t timestamp", "float vx", "float vy", "float vz", "bool v_xy_valid",
               "bool v_z_valid")  # fmt: skip
    log.subscribe(0, "vehicle_global_position").subscribe(1, "vehicle_local_position")
    local = "uint64_t float float float bool bool"
    log.row(1, local, 1_000_000, 1.5, 2.5, 3.5, True, True).row(1, local, 1_100_000, 4.0, 5.0, 6.0, True, False)
    world = "uint64_t double double float float float float bool"
    log.row(0, world, 1_040_000, 35.5, 139.25, 100.5, 140.5, 0.25, 0.5, True)
    log.row(0, world, 1_080_000, 35.5, 139.25, 100.5, 140.5, 0.25, 0.5, False)
    log.row(0, world, 9_000_000, 95.0, 139.25, 100.5, 0.0, 0.0, float("nan"), True)
    table = read(log, tmp_path).estimate_table
    assert table.velocity_m_s[0].tolist() == [2.5, 1.5, -3.5]
    assert table.velocity_m_s[1, :2].tolist() == [5.0, 4.0]
    assert np.isnan([table.velocity_m_s[1, 2], *table.velocity_m_s[2]]).all()
    assert (table.latitude_deg[0], table.longitude_deg[0]) == (35.5, 139.25)
    assert (table.height_geoid_m[0], table.height_ellipsoid_m[0]) == (100.5, 140.5)
    assert np.isnan([table.height_geoid_m[1], table.latitude_deg[2], table.height_ellipsoid_m[2]]).all()
    assert (table.sigma_horizontal_m[0], table.sigma_vertical_m[0]) == (0.25, 0.5)
    assert np.isnan([table.sigma_horizontal_m[2], table.sigma_vertical_m[2]]).all()
    assert (table.when.gps_ns == NO_TIME).all()


@pytest.mark.parametrize(
    ("axis", "name"), [(0, "roll_rad"), (1, "pitch_rad"), (2, "yaw_rad")], ids=["right wing down", "nose up", "to east"]
)
def test_attitudes(axis: int, name: str, tmp_path: Path) -> None:
    """A turn by +30 degrees about forward, right, down: right wing down, nose up, clockwise from north."""
    q = [np.cos(np.radians(15.0)), 0.0, 0.0, 0.0]
    q[axis + 1] = np.sin(np.radians(15.0))
    log = Made().format("vehicle_attitude", "uint64_t timestamp", "uint64_t timestamp_sample", "float[4] q")
    log.subscribe(0, "vehicle_attitude")
    log.row(0, "uint64_t uint64_t float float float float", 2_000_000, 1_990_000, *q)
    log.row(0, "uint64_t uint64_t float float float float", 2_020_000, 0, 0.0, 0.0, 0.0, 0.0)
    table = read(log, tmp_path).attitude_table
    for column in ("roll_rad", "pitch_rad", "yaw_rad"):
        expected = np.radians(30.0) if column == name else 0.0
        assert getattr(table, column)[0] == pytest.approx(expected, abs=1e-7)
        assert np.isnan(getattr(table, column)[1])
    assert table.when.boot_ns.tolist() == [1_990_000_000, 2_020_000_000]


def test_attitude_of_three_turns(tmp_path: Path) -> None:
    """First yaw, then pitch, then roll: the product of the three quaternions."""
    roll, pitch, yaw = np.radians([20.0, -35.0, 140.0])
    cr, sr, cp, sp, cy, sy = (f(angle / 2.0) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
    q = (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
         cr * cp * sy - sr * sp * cy)  # fmt: skip
    log = Made().format("vehicle_attitude", "uint64_t timestamp", "float[4] q").subscribe(0, "vehicle_attitude")
    table = read(log.row(0, "uint64_t float float float float", 2_000_000, *q), tmp_path).attitude_table
    assert (table.roll_rad[0], table.pitch_rad[0], table.yaw_rad[0]) == pytest.approx((roll, pitch, yaw), abs=1e-6)


def exposures_log() -> Made:
    log = Made().format("camera_capture", *CAPTURE).format("camera_trigger", *TRIGGER)
    return log.subscribe(0, "camera_capture").subscribe(1, "camera_trigger")


def capture(
    log: Made, time_us: int, sequence: int, result: int = 1, q: tuple[float, ...] = (0.8, 0.0, 0.6, 0.0)
) -> None:
    log.row(0, CAPTURE_KINDS, time_us, UTC_US + time_us, 35.25, 139.75, sequence, 80.5, 20.0, *q, result)


def trigger(log: Made, time_us: int, sequence: int, feedback: bool = False) -> None:
    log.row(1, TRIGGER_KINDS, time_us, UTC_US + time_us if time_us else 0, sequence, feedback)


def test_exposures_are_listed_once(tmp_path: Path) -> None:
    """The empty trigger at the beginning counts for nothing; one without a capture is listed, and said so."""
    log = exposures_log()
    trigger(log, 0, 0)
    for k in range(5):
        trigger(log, 1_000_000 * (k + 1), k)
        if k != 3:
            capture(log, 1_000_000 * (k + 1), k, result={1: 0, 2: -1}.get(k, 1))
    capture(log, 5_000_000, 4)
    told = read(log, tmp_path)
    table = told.exposure_table
    assert table.sequence.tolist() == [0, 2, 3, 4]
    assert table.kind.tolist() == [
        ExposureKind.CAPTURED, ExposureKind.TRIGGER, ExposureKind.TRIGGER, ExposureKind.CAPTURED,
    ]  # fmt: skip
    assert table.when.boot_ns.tolist() == [1_000_000_000, 3_000_000_000, 4_000_000_000, 5_000_000_000]
    assert table.latitude_deg[[0, 1, 3]].tolist() == [35.25] * 3
    assert table.longitude_deg[0] == 139.75
    assert table.height_geoid_m[0] == 80.5
    assert np.isnan([table.latitude_deg[2], table.height_ellipsoid_m[0], table.sigma_s[0]]).all()
    assert table.pitch_rad[0] == pytest.approx(2.0 * np.arctan2(0.6, 0.8), abs=1e-6)
    notes = " ".join(told.notes)
    assert "1 failed" in notes
    assert "1 without a time" in notes
    assert "1 repeated" in notes
    assert "1 without a picture" in notes
    assert [event.sequence for event in told.exposures()] == [0, 2, 3, 4]


def test_feedback_of_the_camera(tmp_path: Path) -> None:
    """The flash contact's time counts; the request before it is the same exposure; one the camera missed is listed."""
    log = exposures_log()
    for k in range(4):
        trigger(log, 3_000_000 * (k + 1), k)
        if k != 2:
            contact_us = 3_000_000 * (k + 1) + 80_000
            trigger(log, contact_us, k, feedback=True)
            capture(log, contact_us, k)
    table = read(log, tmp_path).exposure_table
    assert table.kind.tolist() == [
        ExposureKind.FEEDBACK, ExposureKind.FEEDBACK, ExposureKind.TRIGGER, ExposureKind.FEEDBACK,
    ]  # fmt: skip
    assert table.when.boot_ns.tolist() == [3_080_000_000, 6_080_000_000, 9_000_000_000, 12_080_000_000]


def test_calendar_serves_where_no_receiver_is_logged(tmp_path: Path) -> None:
    log = exposures_log()
    for k in range(6):
        capture(log, 1_000_000 * (k + 1), k)
    told = read(log, tmp_path)
    assert np.abs(told.exposure_table.when.gps_ns - [gps_ns(1_000_000 * (k + 1)) for k in range(6)]).max() < 1000
    assert any("calendar" in note for note in told.notes)


def test_attitudes_of_a_gimbal_are_not_the_vehicles(tmp_path: Path) -> None:
    for vehicle, expected in (((1.0, 0.0, 0.0, 0.0), True), ((0.8, 0.0, 0.6, 0.0), False)):
        log = (
            exposures_log()
            .format("vehicle_attitude", "uint64_t timestamp", "float[4] q")
            .subscribe(2, "vehicle_attitude")
        )
        for k in range(5):
            log.row(2, "uint64_t float float float float", 1_000_000 * (k + 1) - 5000, *vehicle)
            capture(log, 1_000_000 * (k + 1), k)
        told = read(log, tmp_path)
        assert np.isnan(told.exposure_table.pitch_rad).all() == expected
        assert any("gimbal" in note for note in told.notes) == expected


def test_what_a_log_says_of_itself(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(flight())
    told = read_log(path, silent)
    assert told.kind is LogKind.ULOG
    assert told.vehicle == "PX4 1.15.2 MADE_BOARD"
    assert told.parameters == {"SYS_AUTOSTART": 4001.0, "MPC_XY_CRUISE": 4.5, "CAM_CAP_FBACK": 0.0}
    assert told.texts == tuple(f"[navigator] waypoint {k}" for k in (29, 59, 89, 119))
    assert "4 dropouts of the logger: 296 ms, the longest 119 ms" in told.notes
    named = {"A": "subscription", "B": "flag bits", "F": "format", "I": "information", "L": "text", "O": "dropout",
             "M": "multiple information", "P": "parameter", "Q": "default parameter",
             "S": "synchronisation"}  # fmt: skip
    topics = {0: "vehicle_attitude", 1: "camera_capture", 2: "cpuload"}
    counts: dict[str, int] = {}
    for message in messages(flight()):
        name = topics[message.number] if message.letter == "D" else named[message.letter]
        counts[name] = counts.get(name, 0) + 1
    assert told.message_counts == counts


def test_nested_formats_defined_after_use(tmp_path: Path) -> None:
    log = Made().format("vehicle_attitude", "uint64_t timestamp", "pair[2] pairs", "float[4] q", "uint8_t[3] _padding0")
    log.subscribe(0, "vehicle_attitude").format("pair", "uint8_t a", "uint16_t b")
    kinds = "uint64_t uint8_t uint16_t uint8_t uint16_t float float float float"
    log.row(0, kinds, 1_000_000, 1, 2, 3, 4, 0.8, 0.6, 0.0, 0.0)
    log.row(0, kinds + " uint8_t uint8_t uint8_t", 1_100_000, 1, 2, 3, 4, 0.8, -0.6, 0.0, 0.0, 0, 0, 0)
    table = read(log, tmp_path).attitude_table
    assert table.roll_rad == pytest.approx([2.0 * np.arctan2(0.6, 0.8), -2.0 * np.arctan2(0.6, 0.8)], abs=1e-6)


def test_topic_that_is_logged_twice_is_taken_once(tmp_path: Path) -> None:
    log = Made().format("cpuload", "uint64_t timestamp", "float load").subscribe(3, "cpuload").subscribe(8, "cpuload")
    for k in range(6):
        log.row(3, "uint64_t float", 1_000_000 * k + 1, 0.5).row(8, "uint64_t float", 1_000_000 * k + 1, 0.5)
    path = tmp_path / "log.ulg"
    path.write_bytes(bytes(log.data))
    told = read_ulog(path, {"cpuload": ("timestamp",)}, silent)
    assert [len(topic.rows) for topic in told.topics] == [6]
    assert told.message_counts["cpuload"] == 12
    assert any("under two numbers" in note for note in told.notes)


def test_two_logs_in_one_file(tmp_path: Path) -> None:
    told = read(Made(data=bytearray(flight(20) + flight(30))), tmp_path)
    assert told.damage.lost_bytes == 0
    assert len(told.attitude_table) == 50
    assert told.message_counts["vehicle_attitude"] == 50
    assert any("another log" in note for note in told.notes)


def test_flags_that_are_not_known_are_told(tmp_path: Path) -> None:
    log = (
        Made().flags(incompatible=bytes([2, 0, 0, 0, 0, 0, 0, 0])).format("cpuload", "uint64_t timestamp", "float load")
    )
    log.subscribe(0, "cpuload").row(0, "uint64_t float", 1_000_000, 0.5)
    assert any("features" in note for note in read(log, tmp_path).notes)


def test_other_files_are_not_recognised() -> None:
    rng = np.random.default_rng(7)
    assert not recognises(b"")
    assert not recognises(rng.integers(0, 256, 65536, dtype=np.uint8).tobytes())
    assert not recognises(b"timestamp,lat,lon\n1,2,3\n" * 500)
    assert not recognises(bytes((0xA3, 0x95, 0x80)) * 5000)


@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_every_picture_of_the_recorded_flight() -> None:
    told = read_log(FLIGHT, silent)
    truth = json.loads((DATA / "sitl/px4_dist_truth.json").read_text())["camera_image_captured"]
    table = told.exposure_table
    assert len(table) == len(truth) == 31
    assert (table.kind == ExposureKind.CAPTURED).all()
    assert table.sequence.tolist() == [row["image_index"] for row in truth]
    assert np.abs(table.latitude_deg - [row["lat"] * 1e-7 for row in truth]).max() <= 1e-7
    assert np.abs(table.longitude_deg - [row["lon"] * 1e-7 for row in truth]).max() <= 1e-7
    assert np.abs(table.height_geoid_m - [row["alt"] * 1e-3 for row in truth]).max() <= 1e-3
    assert np.abs(table.when.boot_ns // 1_000_000 - [row["time_boot_ms"] for row in truth]).max() == 0
    w, x, y, z = np.array([row["q"] for row in truth]).T
    yaw, pitch, roll = (getattr(table, f"{name}_rad") for name in ("yaw", "pitch", "roll"))
    # the quaternion made of the angles again: R = Rz(yaw) Ry(pitch) Rx(roll)
    cr, sr, cp, sp, cy, sy = (f(a / 2.0) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    again = np.array([cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
                      cr * cp * sy - sr * sp * cy])  # fmt: skip
    assert np.abs(np.abs(np.sum(again * [w, x, y, z], axis=0)) - 1.0).max() < 1e-6
    assert np.abs(again * np.sign(again[0] * w) - [w, x, y, z]).max() < 1e-6
    assert any("1 without a time" in note for note in told.notes)


@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_clock_that_drifts() -> None:
    """The simulator's boot clock is wrong by 0.4 %: GPS times hold over the flight, one offset would not."""
    told = read_log(FLIGHT, silent)
    truth = json.loads((DATA / "sitl/px4_dist_truth.json").read_text())["camera_image_captured"]
    true_ns = gps_times_ns_from_unix_ns(np.array([row["time_utc"] for row in truth]) * 1000)
    assert told.clock is not None
    assert 0.0030 < told.clock.drift_ppm * 1e-6 < 0.0050
    error_s = (told.exposure_table.when.gps_ns - true_ns) * 1e-9
    assert np.sqrt(np.mean(error_s**2)) < 1.5 * told.clock.residual_s
    assert np.abs(error_s).max() < 4.0 * told.clock.residual_s < 0.03
    first = told.fix_table.when
    offset_error_s = (told.exposure_table.when.boot_ns - first.boot_ns[0] + first.gps_ns[0] - true_ns) * 1e-9
    assert np.abs(offset_error_s).max() > 0.5
    assert np.ptp((first.gps_ns - first.boot_ns) * 1e-9) > 0.8
    for table in (told.fix_table, told.estimate_table, told.attitude_table):
        assert (table.when.gps_ns != NO_TIME).all()


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_pyulog_reads_the_same(path: Path) -> None:
    if not path.exists():
        pytest.skip("no ../shared/data")
    peer = pyulog.ULog(str(path))
    basic = {"int8_t", "uint8_t", "int16_t", "uint16_t", "int32_t", "uint32_t", "int64_t", "uint64_t", "float",
             "double", "bool"}  # fmt: skip
    wanted = {
        name: tuple(label if n in (0, 1) else f"{label}[{n}]" for kind, n, label in one.fields if kind in basic)
        for name, one in peer.message_formats.items()
    }
    told = read_ulog(path, wanted, silent)
    assert told.damage.lost_bytes == 0
    assert {(t.name, t.instance) for t in told.topics} == {(d.name, d.multi_id) for d in peer.data_list}
    compared = expected = 0
    for data in peer.data_list:
        rows = next(t.rows for t in told.topics if (t.name, t.instance) == (data.name, data.multi_id))
        columns = {}
        for name in rows.dtype.names or ():
            column = rows[name]
            parts = column.T if column.ndim == 2 else [column]
            columns |= {f"{name}[{k}]" if column.ndim == 2 else name: part for k, part in enumerate(parts)}
        for name, column in columns.items():
            peers = data.data[name].view(column.dtype)
            assert np.array_equal(column, peers, equal_nan=column.dtype.kind == "f"), (data.name, name)
        compared += len(columns)
        expected += sum("." not in name and "_padding" not in name for name in data.data)  # with dots: nested ones
    assert compared == expected > 10
    rows_by_name: dict[str, int] = {}
    for data in peer.data_list:
        rows_by_name[data.name] = rows_by_name.get(data.name, 0) + len(data.data["timestamp"])
    assert {name: told.message_counts[name] for name in rows_by_name} == rows_by_name
    assert told.texts == tuple(line.message.strip() for line in peer.logged_messages)
    assert set(peer.initial_parameters) <= set(told.parameters)
    changed = {name: value for _, name, value in peer.changed_parameters}
    for name, value in (peer.initial_parameters | changed).items():
        assert told.parameters[name] == value
    spans = [line.duration for line in peer.dropouts]
    assert any(f"{sum(spans)} ms, the longest {max(spans)} ms" in note for note in told.notes) if spans else True


def repeated(folder: Path, byte_count: int) -> Path:
    """Write the recorded flight with its data repeated, each time later, up to a size."""
    data = FLIGHT.read_bytes()
    begin = next(m.begin for m in messages(data) if m.letter == "A")
    rest = bytearray(data[begin:])
    stamps = [m.begin - begin + 5 for m in messages(data) if m.letter == "D"]
    index = np.array(stamps)[:, None] + np.arange(8)
    path = folder / "long.ulg"
    with path.open("wb") as file:
        file.write(data[:begin])
        while file.tell() < byte_count:
            file.write(rest)
            view = np.frombuffer(rest, dtype=np.uint8)
            moved = view[index].copy().view("<u8")[:, 0] + 240_000_000
            view[index] = moved[:, None].view(np.uint8)
    return path


def table_bytes(told: FlightLog) -> int:
    tables = (told.fix_table, told.estimate_table, told.attitude_table, told.exposure_table)
    columns = [
        getattr(table, name) for table in tables for name in type(table).__slots__ if name not in ("when", "name")
    ]
    stamps = [getattr(table.when, name) for table in tables for name in ("gps_ns", "boot_ns", "host_ns")]
    return sum(column.nbytes for column in columns + stamps)


@pytest.mark.slow
@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_long_log_in_time_and_memory(tmp_path: Path) -> None:
    path = repeated(tmp_path, 50_000_000)
    read_log(FLIGHT, silent)
    begin = time.perf_counter()
    told = read_log(path, silent)
    assert time.perf_counter() - begin < 3.0
    assert len(told.attitude_table) >= 9 * 11373
    tracemalloc.start()
    told = read_log(path, silent)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * table_bytes(told)


@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_memory_is_tables_and_a_few_blocks(tmp_path: Path) -> None:
    path = repeated(tmp_path, 11_000_000)
    read_log(path, silent)
    tracemalloc.start()
    told = read_log(path, silent)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * table_bytes(told) + 12_000_000


@pytest.mark.skipif(not FLIGHT.exists(), reason="no ../shared/data/sitl")
def test_two_logs_at_once() -> None:
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda path: read_log(path, silent), [FLIGHT, LOGS[1]] * 2))
    for told, alone in zip(both, [read_log(FLIGHT, silent), read_log(LOGS[1], silent)] * 2, strict=True):
        assert told.message_counts == alone.message_counts
        assert np.array_equal(told.attitude_table.roll_rad, alone.attitude_table.roll_rad)


def test_nothing_is_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(flight()[:-30] + struct.pack("<HB", 40, ord("D")) + bytes(90))
    read_log(path, silent)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_recorded_logs_are_recognised_without_their_beginning(path: Path) -> None:
    if not path.exists():
        pytest.skip("no ../shared/data")
    with path.open("rb") as file:
        data = file.read(200_000)
    for gone in (0, 5, 16, 1000, 5000, 20_000):
        assert recognises(data[gone : gone + 65536])
