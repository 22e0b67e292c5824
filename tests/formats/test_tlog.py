"""Telemetry logs from bytes that the tests encode: what goes in comes out, with its unit, sign and clock."""

import threading
from pathlib import Path

import numpy as np
import pytest

from tests.formats.tlog_bytes import LAYOUTS, Sender, crc, frame, record
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME, UNIX_EPOCH_NS
from uavkit.formats import tlog
from uavkit.formats.flight_logs import open_log
from uavkit.formats.mavlink_messages import FIELDS, dialect, payload_type

UNIX_US = 1_795_000_000_000_000
"""November 2026: GPS time is 18 s ahead of UTC."""
BOOT_MS = 50_000
LAG_US = 40_000
"""Of the link: messages come later by this."""


def gps_ns(unix_us: int) -> int:
    return unix_us * 1000 - UNIX_EPOCH_NS + 18_000_000_000


def at(seconds: float) -> tuple[int, int, int]:
    """Return Unix microseconds, boot milliseconds and stamp of an instant of the made flight."""
    us = round(seconds * 1e6)
    return UNIX_US + us, BOOT_MS + us // 1000, UNIX_US + us + LAG_US


def said(name: str, values: tuple[object, ...], seconds: float, sender: Sender | None = None) -> bytes:
    return record(at(seconds)[2], frame(name, values, sender))


def beats(seconds: float = 0.0, sender: Sender | None = None, autopilot: int = 3) -> bytes:
    return said("HEARTBEAT", (0, 2, autopilot, 81, 4, 3), seconds, sender)


def clock(count: int = 30, sender: Sender | None = None, first: float = 0.0) -> bytes:
    """Return SYSTEM_TIME once a second."""
    told = [at(first + k) for k in range(count)]
    return b"".join(record(s, frame("SYSTEM_TIME", (unix, boot), sender)) for unix, boot, s in told)


def feedback(time_us: int, number: int, seconds: float, captures: int = 0) -> bytes:
    values = (time_us, 358_000_924, 1_396_501_023, 20.06, 14.99, -9.31, -3.72, 25.74, 0.0, number, 0, 0, 0, captures)
    return said("CAMERA_FEEDBACK", values, seconds)


def captured(seconds: float, number: int, utc_us: int | None = None, result: int = 1) -> bytes:
    unix, boot, _ = at(seconds)
    half = float(np.sqrt(0.5))
    values = (unix if utc_us is None else utc_us, boot, 358_000_780, 1_396_500_953, 20_057, 15_305)
    return said("CAMERA_IMAGE_CAPTURED", (*values, half, 0.0, 0.0, half, number, 1, result, b"dcim/1.jpg"), seconds)


def read(tmp_path: Path, data: bytes, name: str = "made.tlog") -> FlightLog:
    path = tmp_path / name
    path.write_bytes(data)
    return tlog.read_log(path)


def test_checksum_is_the_one_of_the_definition() -> None:
    assert crc(b"123456789") == 0x6F91  # the check value of CRC-16/MCRF4XX


def test_dialect_has_the_definitions_that_the_tests_write_down() -> None:
    import struct

    known = dialect()
    for name, (number, extra, layout) in LAYOUTS.items():
        if name == "NEW_MESSAGE":
            assert number >= len(known.crc_extra) or known.crc_extra[number] == -1
            continue
        assert (known.name(number), known.crc_extra[number], known.longest[number]) == (
            name, extra, struct.calcsize(layout),
        )  # fmt: skip
        assert number not in FIELDS or payload_type(number).names == tuple(
            n for n in payload_type(number).names or () if n in FIELDS[number]
        )
        assert number not in FIELDS or set(payload_type(number).names or ()) == set(FIELDS[number])


@pytest.mark.parametrize("sender", [Sender(version=1), Sender(), Sender(signed=True)], ids=["v1", "v2", "signed"])
def test_every_field_of_positions_and_attitudes(tmp_path: Path, sender: Sender) -> None:
    _, boot, stamp = at(5.0)
    fix = (
        (boot - 200) * 1000, 358_000_001, -1_396_500_002, 20_123, 121, 200, 321, 9_000, 6, 17,
        *((57_456, 310, 520, 40, 0, 0) if sender.version == 2 else ()),
    )  # fmt: skip
    second = (
        at(4.9)[0], -358_000_003, 1_396_500_004, -1_500, 0, 90, 95, 65_535, 65_535, 3, 255, 0,
        *((0, 35_000) if sender.version == 2 else ()),
    )  # fmt: skip
    data = beats(sender=sender) + clock(sender=sender)
    data += record(stamp, frame("GPS_RAW_INT", fix, sender, 9)) + record(stamp, frame("GPS2_RAW", second, sender, 10))
    position = (boot, 357_000_005, 1_395_000_006, 20_070, 15_004, -333, 12, -50, 17_939)
    data += record(stamp, frame("GLOBAL_POSITION_INT", position, sender, 11))
    data += record(stamp, frame("ATTITUDE", (boot, 0.1, -0.2, -3.1, 0.0, 0.0, 0.0), sender, 12))
    log = read(tmp_path, data)

    assert log.kind is LogKind.TLOG
    assert log.damage.lost_bytes == 0
    assert log.message_counts == {"HEARTBEAT": 1, "SYSTEM_TIME": 30, "GPS_RAW_INT": 1, "ATTITUDE": 1,
                                  "GLOBAL_POSITION_INT": 1, "GPS2_RAW": 1}  # fmt: skip
    fixes = log.fix_table
    assert fixes.receiver.tolist() == [0, 1]
    np.testing.assert_array_equal(np.rint(fixes.latitude_deg * 1e7), [358_000_001, -358_000_003])
    np.testing.assert_array_equal(np.rint(fixes.longitude_deg * 1e7), [-1_396_500_002, 1_396_500_004])
    np.testing.assert_allclose(fixes.height_geoid_m, [20.123, -1.5])
    assert np.isnan(fixes.height_above_home_m).all()
    np.testing.assert_allclose(fixes.velocity_m_s[0], [3.21, 0.0, np.nan], atol=1e-12)  # course 90 degrees: east
    assert np.isnan(fixes.velocity_m_s[1]).all()
    assert fixes.fix_type.tolist() == [FixType.RTK_FIXED, FixType.THREE_DIMENSIONAL]
    assert fixes.satellites.tolist() == [17, 255]
    extended = sender.version == 2
    np.testing.assert_allclose(fixes.height_ellipsoid_m, [57.456, 35.0] if extended else [np.nan] * 2)
    np.testing.assert_allclose(fixes.sigma_horizontal_m, [0.31 if extended else np.nan, np.nan])
    np.testing.assert_allclose(fixes.sigma_vertical_m, [0.52 if extended else np.nan, np.nan])
    assert fixes.when.boot_ns.tolist() == [(boot - 200) * 1_000_000, NO_TIME]
    np.testing.assert_allclose(fixes.when.gps_ns, [gps_ns(at(4.8)[0]), gps_ns(at(4.9)[0])], atol=1000)
    assert fixes.when.host_ns.tolist() == [stamp * 1000] * 2

    estimate = log.estimate_table
    assert estimate.latitude_deg[0] == pytest.approx(35.7000005)
    assert estimate.height_geoid_m[0] == pytest.approx(20.07)
    assert estimate.height_above_home_m[0] == pytest.approx(15.004)
    assert np.isnan(estimate.height_ellipsoid_m[0])
    np.testing.assert_allclose(estimate.velocity_m_s[0], [0.12, -3.33, 0.5])  # east, north, up
    assert estimate.when.boot_ns[0] == boot * 1_000_000
    attitude = log.attitude_table
    np.testing.assert_allclose([attitude.roll_rad[0], attitude.pitch_rad[0], attitude.yaw_rad[0]], [0.1, -0.2, -3.1],
                               rtol=1e-7)  # fmt: skip
    assert attitude.when.gps_ns[0] == pytest.approx(gps_ns(at(5.0)[0]), abs=1000)


def test_no_fix_is_no_position(tmp_path: Path) -> None:
    data = beats() + said("GPS_RAW_INT", (0, 0, 0, 0, 65_535, 65_535, 0, 0, 1, 0), 1.0)
    data += said("GLOBAL_POSITION_INT", (at(1)[1], 0, 0, 120, 120, 0, 0, 0, 0), 1.0)
    log = read(tmp_path, data)
    assert np.isnan(log.fix_table.latitude_deg).all()
    assert np.isnan(log.fix_table.height_geoid_m).all()
    assert np.isnan(log.fix_table.velocity_m_s).all()
    assert log.fix_table.when.boot_ns.tolist() == [NO_TIME]
    assert np.isnan(log.estimate_table.latitude_deg).all()
    assert list(log.fixes()) == []


@pytest.mark.parametrize("meaning", ["boot", "Unix", "GPS"])
def test_time_of_camera_feedback_may_count_from_three_beginnings(tmp_path: Path, meaning: str) -> None:
    true = [at(10.0 + k) for k in range(5)]
    stated = {"boot": [b * 1000 for _, b, _ in true], "Unix": [u for u, _, _ in true],
              "GPS": [gps_ns(u) // 1000 for u, _, _ in true]}[meaning]  # fmt: skip
    shots = b"".join(feedback(t, k + 1, 10.3 + k) for k, t in enumerate(stated))
    log = read(tmp_path, beats() + clock() + shots)
    table = log.exposure_table
    np.testing.assert_allclose(table.when.gps_ns, [gps_ns(u) for u, _, _ in true], atol=1_000)
    by_pin = meaning == "boot"
    assert set(table.kind.tolist()) == {ExposureKind.FEEDBACK if by_pin else ExposureKind.TRIGGER}
    assert table.when.boot_ns.tolist() == ([b * 1_000_000 for _, b, _ in true] if by_pin else [NO_TIME] * 5)
    assert table.sequence.tolist() == [1, 2, 3, 4, 5]
    assert any("CAMERA_FEEDBACK.time_usec counts from" in note for note in log.notes)


@pytest.mark.parametrize("meaning", ["Unix", "GPS"])
def test_epoch_is_told_by_reception_where_no_vehicle_clock_is(tmp_path: Path, meaning: str) -> None:
    unix = at(10.0)[0]
    log = read(tmp_path, beats() + feedback(unix if meaning == "Unix" else gps_ns(unix) // 1000, 1, 10.2))
    assert log.exposure_table.when.gps_ns.tolist() == [gps_ns(unix)]


def test_fields_of_camera_feedback(tmp_path: Path) -> None:
    table = read(tmp_path, beats() + clock() + feedback(at(10)[0], 7, 10.1, captures=3)).exposure_table
    assert (round(table.latitude_deg[0] * 1e7), round(table.longitude_deg[0] * 1e7)) == (358_000_924, 1_396_501_023)
    assert table.height_geoid_m[0] == np.float32(20.06)
    assert table.height_above_home_m[0] == np.float32(14.99)
    assert np.isnan(table.height_ellipsoid_m[0])
    turned = np.degrees([table.roll_rad[0], table.pitch_rad[0], table.yaw_rad[0]])
    np.testing.assert_allclose(turned, [-9.31, -3.72, 25.74], rtol=1e-6)
    assert table.kind[0] == ExposureKind.FEEDBACK  # captures are counted where a flash contact is set up


@pytest.mark.parametrize(("pin", "kind"), [(-1.0, ExposureKind.TRIGGER), (54.0, ExposureKind.FEEDBACK)])
def test_parameter_tells_of_the_flash_contact(tmp_path: Path, pin: float, kind: ExposureKind) -> None:
    parameter = said("PARAM_VALUE", (pin, 900, 1, b"CAM1_FEEDBAK_PIN", 9), 1.0)
    log = read(tmp_path, beats() + clock() + parameter + feedback(at(10)[0], 7, 10.1))
    assert log.parameters == {"CAM1_FEEDBAK_PIN": pin}
    assert log.exposure_table.kind.tolist() == [kind]
    assert (log.exposure_table.sigma_s[0] > 0.01) == (kind is ExposureKind.TRIGGER)


def test_fields_of_image_captured(tmp_path: Path) -> None:
    for autopilot, above_home in ((3, 15.305), (12, np.nan)):
        log = read(tmp_path, beats(autopilot=autopilot) + clock() + captured(3.0, 0))
        table = log.exposure_table
        assert (round(table.latitude_deg[0] * 1e7), round(table.longitude_deg[0] * 1e7)) == (358_000_780, 1_396_500_953)
        np.testing.assert_allclose([table.height_geoid_m[0], table.height_above_home_m[0]], [20.057, above_home])
        turned = np.degrees([table.roll_rad[0], table.pitch_rad[0], table.yaw_rad[0]])
        np.testing.assert_allclose(turned, [0.0, 0.0, 90.0], atol=1e-5)
        assert table.kind.tolist() == [ExposureKind.CAPTURED]
        assert table.when.gps_ns.tolist() == [gps_ns(at(3.0)[0])]
        assert table.when.boot_ns.tolist() == [at(3.0)[1] * 1_000_000]
        assert table.sequence.tolist() == [0]


def shot_by(component: int, turned_deg: tuple[float, float, float], seconds: float, number: int) -> bytes:
    """Return CAMERA_IMAGE_CAPTURED with a quaternion of yaw, then pitch, then roll."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.radians(turned_deg) / 2), np.sin(np.radians(turned_deg) / 2)
    q = (cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
         cr * cp * sy - sr * sp * cy)  # fmt: skip
    unix, boot, _ = at(seconds)
    values = (unix, boot, 358_000_780, 1_396_500_953, 20_057, 15_305, *(float(x) for x in q), number, 0, 1, b"")
    return said("CAMERA_IMAGE_CAPTURED", values, seconds, Sender(component=component))


def test_quaternion_is_roll_pitch_yaw(tmp_path: Path) -> None:
    turned = (10.0, -20.0, 100.0)
    table = read(tmp_path, beats() + clock() + shot_by(1, turned, 3.0, 0)).exposure_table
    read_deg = np.degrees([table.roll_rad[0], table.pitch_rad[0], table.yaw_rad[0]])
    np.testing.assert_allclose(read_deg, turned, atol=1e-4)
    unknown = (at(3)[0], at(3)[1], 1, 1, 1, 1, 0.0, 0.0, 0.0, 0.0, 0, 1, 1)
    none = read(tmp_path, beats() + clock() + said("CAMERA_IMAGE_CAPTURED", unknown, 3.0)).exposure_table
    assert np.isnan(none.roll_rad[0])


def test_first_of_several_cameras(tmp_path: Path) -> None:
    level = (0.0, 0.0, 0.0)
    shots = b"".join(shot_by(100 + (k & 1), level, 3.0 + k, k) for k in range(6))
    log = read(tmp_path, beats() + clock() + shots)
    assert log.exposure_table.sequence.tolist() == [0, 2, 4]
    assert any("exposures of several cameras: 1 (3 reports), 2 (3 reports)" in note for note in log.notes)


def test_time_of_a_camera_with_its_own_boot_clock_is_not_believed(tmp_path: Path) -> None:
    shots = b"".join(feedback(7_000_000 + k * 1_000_000, k, 10.0 + k) for k in range(3))
    log = read(tmp_path, beats() + clock(first=100.0) + b"".join(clock(1, first=f) for f in range(131, 140)) + shots)
    table = log.exposure_table
    assert any("not the vehicle's" in note for note in log.notes)
    received = [gps_ns(at(10.0 + k)[2]) - LAG_US * 1000 for k in range(3)]  # the lead of the computer is taken off
    np.testing.assert_allclose(table.when.gps_ns, received, atol=1000)
    assert (table.sigma_s >= 0.5).all()
    assert table.when.boot_ns.tolist() == [NO_TIME] * 3


def test_equal_heights_above_ellipsoid_and_sea_are_told(tmp_path: Path) -> None:
    def fixes(undulation_mm: int) -> bytes:
        rows = (
            (at(k)[1] * 1000, 358_000_001, 1_396_500_002, 20_000, 1, 1, 1, 1, 3, 9, 20_000 + undulation_mm)
            for k in range(12)
        )
        return b"".join(said("GPS_RAW_INT", row, k) for k, row in enumerate(rows))

    for undulation_mm, told in ((0, True), (37_000, False)):
        notes = read(tmp_path, beats() + fixes(undulation_mm)).notes
        assert any("same heights" in note for note in notes) == told


def test_progress_is_told_and_the_log_is_opened_by_content(tmp_path: Path) -> None:
    path, calls = tmp_path / "renamed.BIN", list[tuple[int, int]]()
    path.write_bytes(beats() + clock(100))
    log = open_log(path, lambda _stage, done, total: calls.append((done, total)))
    assert log.kind is LogKind.TLOG
    assert calls[-1] == (path.stat().st_size, path.stat().st_size)


def test_captured_without_utc_goes_by_the_clock_and_failed_ones_are_none(tmp_path: Path) -> None:
    shots = captured(3.0, 0, utc_us=0) + captured(5.0, 1, result=0) + captured(7.0, 2, result=-1)
    log = read(tmp_path, beats(autopilot=12) + clock() + shots)
    assert log.exposure_table.sequence.tolist() == [0, 2]
    np.testing.assert_allclose(log.exposure_table.when.gps_ns, [gps_ns(at(t)[0]) for t in (3.0, 7.0)], atol=1000)
    assert log.exposure_table.kind.tolist() == [ExposureKind.CAPTURED, ExposureKind.TRIGGER]
    assert any("capture failed" in note for note in log.notes)


def test_trigger_and_capture_of_one_exposure_are_one(tmp_path: Path) -> None:
    trigger = b"".join(said("CAMERA_TRIGGER", (at(t)[1] * 1000, k), t) for k, t in enumerate((3.0, 5.0, 7.0, 9.0)))
    empty = said("CAMERA_TRIGGER", (0, 0), 1.0)
    log = read(tmp_path, beats(autopilot=12) + empty + clock() + trigger + captured(3.1, 0) + captured(7.8, 2))
    table = log.exposure_table
    kinds = dict(zip(table.sequence.tolist(), table.kind.tolist(), strict=True))
    assert kinds == {0: ExposureKind.CAPTURED, 1: ExposureKind.TRIGGER, 2: ExposureKind.CAPTURED,
                     3: ExposureKind.TRIGGER}  # fmt: skip
    triggers = table.when.gps_ns[table.kind == ExposureKind.TRIGGER]
    np.testing.assert_allclose(triggers, [gps_ns(at(5.0)[0]), gps_ns(at(9.0)[0])], atol=1000)


def test_repeated_messages_count_once(tmp_path: Path) -> None:
    shot = frame("CAMERA_FEEDBACK", (at(3)[0], 1, 2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 0, 0, 0, 0))
    fix = frame("GPS_RAW_INT", (at(3)[1] * 1000, 358_000_001, 1_396_500_002, 1, 1, 1, 1, 1, 3, 9))
    later = frame("GPS_RAW_INT", (at(4)[1] * 1000, 358_000_001, 1_396_500_002, 1, 1, 1, 1, 1, 3, 9))
    stamp = at(3.1)[2]
    data = beats() + clock() + b"".join(record(stamp + d, shot) for d in (0, 200, 5_000_000))
    data += record(stamp, fix) + record(stamp + 300_000, fix) + record(stamp + 1_000_000, later)
    log = read(tmp_path, data)
    assert len(log.exposure_table) == 1
    assert len(log.fix_table) == 2
    assert log.message_counts["CAMERA_FEEDBACK"] == 3
    assert "2 repeated CAMERA_FEEDBACK counted once" in log.notes


def test_clock_of_the_ground_leads_and_is_told(tmp_path: Path) -> None:
    told = [at(k) for k in range(30)]
    data = b"".join(record(s + 1_350_000 - LAG_US, frame("SYSTEM_TIME", (u, b))) for u, b, s in told)
    log = read(tmp_path, beats() + data)
    assert any("leads the vehicle's UTC by 1.350 s" in note for note in log.notes)
    assert log.clock is not None
    assert log.clock.gps_ns(np.array([at(10)[1] * 1_000_000]))[0] == pytest.approx(gps_ns(at(10)[0]), abs=1000)


def test_time_not_yet_known_is_no_time(tmp_path: Path) -> None:
    early = b"".join(record(at(k)[2], frame("SYSTEM_TIME", (unix, at(k)[1]))) for k, unix in enumerate((0, 0, 500_000)))
    log = read(tmp_path, beats() + early + clock(first=3.0))
    assert log.clock is not None
    assert log.clock.rejected == 0
    assert log.clock.segments[0].samples == 30


def test_without_vehicle_time_the_host_serves_and_is_said_to(tmp_path: Path) -> None:
    attitudes = b"".join(said("ATTITUDE", (at(k / 4)[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), k / 4) for k in range(100))
    log = read(tmp_path, beats() + attitudes + feedback(at(10)[1] * 1000, 1, 10.0))
    assert any("the vehicle tells no time" in note for note in log.notes)
    assert log.exposure_table.when.gps_ns[0] == pytest.approx(gps_ns(at(10)[0] + LAG_US), abs=1_000_000)
    assert log.exposure_table.sigma_s[0] >= 0.01


def test_each_session_has_its_own_clock(tmp_path: Path) -> None:
    first = beats() + clock(30)
    again = [(UNIX_US + 300_000_000 + k * 1_000_000, 4_000 + k * 1000) for k in range(60)]
    second = b"".join(record(u + LAG_US, frame("SYSTEM_TIME", (u, b))) for u, b in again)
    one = record(again[10][0] + LAG_US, frame("ATTITUDE", (again[10][1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    data = first + said("ATTITUDE", (at(7)[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 29.5) + second + one
    log = read(tmp_path, data)
    np.testing.assert_allclose(log.attitude_table.when.gps_ns, [gps_ns(at(7)[0]), gps_ns(again[10][0])], atol=1000)
    assert log.clock is not None
    assert log.clock.segments[0].samples == 60
    assert any("started 2 times" in note for note in log.notes)


def test_a_late_message_is_no_new_session(tmp_path: Path) -> None:
    late = said("ATTITUDE", (at(2)[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 12.0)
    log = read(tmp_path, beats() + clock(20) + late + clock(20, first=20.0))
    assert not any("started" in note for note in log.notes)
    assert log.attitude_table.when.gps_ns[0] == pytest.approx(gps_ns(at(2)[0]), abs=1000)


def test_vehicle_with_exposures_is_read_and_others_named(tmp_path: Path) -> None:
    other = Sender(system=2)
    fix = (at(3)[1] * 1000, 1, 2, 3, 1, 1, 1, 1, 3, 9)
    data = beats() + clock() + feedback(at(10)[0], 1, 10.1)
    data += beats(sender=other) + b"".join(said("GPS_RAW_INT", fix, k, other) for k in range(5))
    data += said("HEARTBEAT", (0, 6, 8, 0, 0, 3), 1.0, Sender(system=255, component=190))
    log = read(tmp_path, data)
    assert len(log.exposure_table) == 1
    assert len(log.fix_table) == 0
    assert any(note.startswith("vehicle 2 left out (6 messages, 0 about exposures, 5 fixes)") for note in log.notes)


def test_gimbal_of_the_vehicle_is_not_its_attitude(tmp_path: Path) -> None:
    gimbal = Sender(component=154)
    data = beats() + clock() + said("HEARTBEAT", (0, 26, 8, 0, 0, 3), 1.0, gimbal)
    data += said("ATTITUDE", (at(1)[1], 0.5, 0.0, 0.0, 0.0, 0.0, 0.0), 1.0, gimbal)
    data += said("ATTITUDE", (at(1)[1], 0.25, 0.0, 0.0, 0.0, 0.0, 0.0), 1.0)
    assert read(tmp_path, data).attitude_table.roll_rad.tolist() == [0.25]


def test_texts_and_vehicle(tmp_path: Path) -> None:
    text = b"a text that is longer than the fifty bytes of one message"
    data = beats() + said("AUTOPILOT_VERSION", (0, 0, 0x040603FF, 0, 0, 0, 0, 0, b"", b"", b"", b""), 0.5)
    data += said("STATUSTEXT", (6, text[:50], 3, 0), 1.0) + said("STATUSTEXT", (6, b"another", 0, 0), 1.1)
    data += said("STATUSTEXT", (6, text[50:], 3, 1), 1.2)
    log = read(tmp_path, data)
    assert log.texts == (text.decode(), "another")
    assert log.vehicle == "ArduPilot quadrotor 4.6.3"
    named = data + said("STATUSTEXT", (6, b"ArduCopter V4.6.3 (92b0cd78)", 0, 0), 2.0)
    assert read(tmp_path, named).vehicle == "ArduCopter V4.6.3"


def test_integers_in_the_bytes_of_a_float(tmp_path: Path) -> None:
    import struct

    value = struct.unpack("<f", struct.pack("<i", 1_310_988))[0]
    message = said("PARAM_VALUE", (value, 1, 0, b"CAL_ACC0_ID", 6), 1.0)
    assert read(tmp_path, beats(autopilot=12) + message).parameters == {"CAL_ACC0_ID": 1_310_988.0}
    assert read(tmp_path, beats() + message).parameters == {"CAL_ACC0_ID": pytest.approx(value)}


def test_messages_of_no_dialect_are_counted(tmp_path: Path) -> None:
    strange = said("NEW_MESSAGE", (7, 1.5, 3), 1.0)
    log = read(tmp_path, beats() + strange + strange + clock(3) + strange)
    assert log.message_counts["UNKNOWN_52345"] == 3
    assert log.damage.lost_bytes == 0


def test_raw_stream_without_stamps(tmp_path: Path) -> None:
    data = frame("HEARTBEAT", (0, 2, 3, 81, 4, 3)) + frame("NEW_MESSAGE", (7, 1.5, 3))
    data += b"".join(frame("SYSTEM_TIME", at(k)[:2]) for k in range(20))
    data += frame("ATTITUDE", (at(4)[1], 0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert tlog.recognises(data)
    log = read(tmp_path, data)
    assert log.damage.lost_bytes == 0
    assert log.message_counts["UNKNOWN_52345"] == 1
    assert log.attitude_table.when.host_ns.tolist() == [NO_TIME]
    assert log.attitude_table.when.gps_ns[0] == pytest.approx(gps_ns(at(4)[0]), abs=1000)
    assert "a raw stream without times of reception" in log.notes


def test_stamps_jump_and_link_numbers_do_no_harm(tmp_path: Path) -> None:
    told = [at(k) for k in range(40)]
    stamps = [s + (k & 3) - (7_200_000_000 if k >= 20 else 0) for k, (_, _, s) in enumerate(told)]
    stamps[30] += 10_000_000_000_000
    parts = [record(s, frame("SYSTEM_TIME", (u, b))) for s, (u, b, _) in zip(stamps, told, strict=True)]
    attitude = record(stamps[39], frame("ATTITUDE", (at(39)[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    log = read(tmp_path, beats() + b"".join(parts) + attitude)
    assert log.damage.lost_bytes == 0
    assert any("clock was set 1 times" in note for note in log.notes)
    assert log.attitude_table.when.gps_ns[0] == pytest.approx(gps_ns(at(39)[0]), abs=1000)


def test_recognised_by_content() -> None:
    data = beats() + clock(5)
    assert tlog.recognises(data)
    assert tlog.recognises(data[11:])
    assert tlog.recognises(beats())
    assert tlog.recognises(frame("HEARTBEAT", (0, 2, 3, 81, 4, 3)))
    rng = np.random.default_rng(4)
    assert not tlog.recognises(rng.integers(0, 256, 65_536, dtype=np.uint8).tobytes())
    assert not tlog.recognises(b"\xfe" * 65_536)
    assert not tlog.recognises(b"GPS, 1, 2, 3\n" * 1000)
    assert not tlog.recognises(b"")


@pytest.mark.parametrize("data", [b"", b"\xfd\x09", b"no log at all" * 100, bytes(100_000), b"\xfe" * 300_000])
def test_file_without_a_message_is_an_error_that_names_it(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(InputError, match=r"made\.tlog: no intact MAVLink message"):
        read(tmp_path, data)


def test_missing_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.tlog"):
        tlog.read_log(tmp_path / "none.tlog")


def test_log_of_a_ground_station_alone_is_empty(tmp_path: Path) -> None:
    log = read(tmp_path, said("HEARTBEAT", (0, 6, 8, 0, 0, 3), 1.0, Sender(system=255)) * 3)
    assert len(log.fix_table) == len(log.exposure_table) == len(log.attitude_table) == 0
    assert any("no vehicle" in note for note in log.notes)


def test_two_logs_at_once(tmp_path: Path) -> None:
    logs = {}
    paths = []
    for k in range(4):
        path = tmp_path / f"{k}.tlog"
        path.write_bytes(beats() + clock(200 + k) + feedback(at(10)[0], k, 10.1))
        paths.append(path)

    def work(path: Path) -> None:
        logs[path] = tlog.read_log(path)

    threads = [threading.Thread(target=work, args=(path,)) for path in paths]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, path in enumerate(paths):
        assert logs[path].message_counts["SYSTEM_TIME"] == 200 + k
        assert logs[path].exposure_table.sequence.tolist() == [k]
