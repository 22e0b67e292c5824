"""Recorded flights: every exposure of the truth is found, and all that is read agrees with pymavlink."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uavkit.core.flight_log import ExposureKind, FlightLog
from uavkit.core.gpstime import NO_TIME, UNIX_EPOCH_NS
from uavkit.formats import tlog

SITL = Path(__file__).resolve().parents[2] / "../shared/data/sitl"


def gps_ns(unix_us: int) -> int:
    return unix_us * 1000 - UNIX_EPOCH_NS + 18_000_000_000


def recorded(name: str) -> Path:
    path = SITL / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    return path


def truth(name: str) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(recorded(f"{name}_truth.json").read_text())
    return loaded


@pytest.mark.parametrize("name", ["dist", "digicam"])
def test_every_camera_feedback_of_the_truth(name: str) -> None:
    true = truth(name)["camera_feedback"]
    log = tlog.read_log(recorded(f"{name}.tlog"))
    table = log.exposure_table
    assert log.damage.lost_bytes == 0
    assert table.sequence.tolist() == [t["img_idx"] for t in true]
    assert np.rint(table.latitude_deg * 1e7).astype(int).tolist() == [t["lat"] for t in true]
    assert np.rint(table.longitude_deg * 1e7).astype(int).tolist() == [t["lng"] for t in true]
    assert table.when.gps_ns.tolist() == [gps_ns(t["time_usec"]) for t in true]
    assert table.height_geoid_m.tolist() == [t["alt_msl"] for t in true]
    assert table.height_above_home_m.tolist() == [t["alt_rel"] for t in true]
    for column, field in ((table.roll_rad, "roll"), (table.pitch_rad, "pitch"), (table.yaw_rad, "yaw")):
        np.testing.assert_allclose(np.degrees(column), [t[field] for t in true], rtol=1e-12)
    assert set(table.kind.tolist()) == {ExposureKind.TRIGGER}  # no flash contact: CAM1_FEEDBAK_PIN is -1
    assert log.parameters["CAM1_FEEDBAK_PIN"] == -1.0
    assert log.vehicle == "ArduPilot quadrotor 4.6.3"


@pytest.mark.parametrize(("name", "lead_s"), [("dist", 1.35), ("digicam", 0.70)])
def test_clock_of_the_ground_leads(name: str, lead_s: float) -> None:
    log = tlog.read_log(recorded(f"{name}.tlog"))
    assert log.clock is not None
    assert abs(log.clock.drift_ppm) < 10
    assert log.clock.residual_s < 0.001
    told = next(note for note in log.notes if "leads the vehicle's UTC by" in note)
    assert float(told.split(" by ")[1].split(" s")[0]) == pytest.approx(lead_s, abs=0.02)
    exposures = log.exposure_table.when
    late_s = (exposures.host_ns - UNIX_EPOCH_NS + 18_000_000_000 - exposures.gps_ns) * 1e-9
    np.testing.assert_allclose(late_s, lead_s, atol=0.1)


def test_every_image_of_the_truth_of_px4() -> None:
    true = truth("px4_dist")["camera_image_captured"]
    log = tlog.read_log(recorded("px4_dist.tlog"))
    table = log.exposure_table
    assert log.damage.lost_bytes == 0
    assert table.sequence.tolist() == [t["image_index"] for t in true]
    assert np.rint(table.latitude_deg * 1e7).astype(int).tolist() == [t["lat"] for t in true]
    assert np.rint(table.longitude_deg * 1e7).astype(int).tolist() == [t["lon"] for t in true]
    assert np.rint(table.height_geoid_m * 1e3).astype(int).tolist() == [t["alt"] for t in true]
    assert table.when.gps_ns.tolist() == [gps_ns(t["time_utc"]) for t in true]
    assert table.when.boot_ns.tolist() == [t["time_boot_ms"] * 1_000_000 for t in true]
    assert set(table.kind.tolist()) == {ExposureKind.CAPTURED}
    assert log.vehicle == "PX4 quadrotor 1.15.2"
    assert any("no SYSTEM_TIME" in note for note in log.notes)
    assert {"UNKNOWN_8": 269, "UNKNOWN_380": 133, "UNKNOWN_410": 45, "UNKNOWN_411": 90}.items() <= dict(
        log.message_counts
    ).items()


def test_attitude_at_px4s_images_is_that_of_the_stream() -> None:
    log = tlog.read_log(recorded("px4_dist.tlog"))
    images, stream = log.exposure_table, log.attitude_table
    boot_s = stream.when.boot_ns * 1e-9
    for name in ("roll_rad", "pitch_rad"):
        there = np.interp(images.when.boot_ns * 1e-9, boot_s, getattr(stream, name))
        assert np.degrees(np.median(np.abs(there - getattr(images, name)))) < 0.5
    turns = np.interp(images.when.boot_ns * 1e-9, boot_s, np.unwrap(stream.yaw_rad)) - images.yaw_rad
    assert np.degrees(np.median(np.abs((turns + np.pi) % (2 * np.pi) - np.pi))) < 0.5


def test_px4s_clock_agrees_with_its_own_log() -> None:
    """The boot clock of this simulation drifts by 0.4 % and jumps: one line would be wrong by 40 ms."""
    pyulog = pytest.importorskip("pyulog")
    ulog = pyulog.ULog(str(recorded("px4_dist.ulg")), ["sensor_gps"])
    data = ulog.data_list[0].data
    boot_ns = data["timestamp"].astype(np.int64) * 1000
    gps = data["time_utc_usec"].astype(np.int64) * 1000 - UNIX_EPOCH_NS + 18_000_000_000
    log = tlog.read_log(recorded("px4_dist.tlog"))
    assert log.clock is not None
    in_flight = (boot_ns > 20e9) & (boot_ns < 190e9)
    off_s = (log.clock.gps_ns(boot_ns) - gps)[in_flight] * 1e-9
    assert np.median(np.abs(off_s)) < 0.005
    assert np.percentile(np.abs(off_s), 95) < 0.02


def test_fixes_of_ardupilot_bear_their_epochs() -> None:
    """GPS_RAW_INT against the GPS messages of the vehicle's own log, which bear week and time of week."""
    reader = pytest.importorskip("pymavlink.DFReader")
    dataflash = reader.DFReader_binary(str(recorded("dist.BIN")))
    epochs = {}
    while (message := dataflash.recv_match(type=["GPS"])) is not None:
        key = (round(message.Lat * 1e7), round(message.Lng * 1e7))
        epochs.setdefault(key, []).append((message.GWk * 604_800_000 + message.GMS) * 1_000_000)
    dataflash.filehandle.close()
    fixes = tlog.read_log(recorded("dist.tlog")).fix_table
    compared = 0
    for row in np.flatnonzero(np.isfinite(fixes.latitude_deg)).tolist():
        there = epochs.get((round(fixes.latitude_deg[row] * 1e7), round(fixes.longitude_deg[row] * 1e7)), [])
        if len(there) == 1 and fixes.when.gps_ns[row] != NO_TIME:
            compared += 1
            assert abs(int(fixes.when.gps_ns[row]) - there[0]) < 2_000_000
    assert compared > 500


def by_pymavlink(path: Path) -> tuple[Counter[str], dict[str, list[Any]]]:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    reader = mavutil.mavlogfile(str(path))
    counts, kept = Counter[str](), dict[str, list[Any]]()
    while (message := reader.recv_msg()) is not None:
        counts[message.get_type()] += 1
        kept.setdefault(message.get_type(), []).append(message)
    reader.close()
    return counts, kept


def check_against_pymavlink(path: Path, log: FlightLog) -> None:
    counts, kept = by_pymavlink(path)
    counts.pop("BAD_DATA", None)
    assert dict(log.message_counts) == dict(counts)
    attitudes = kept["ATTITUDE"]
    assert log.attitude_table.roll_rad.tolist() == [m.roll for m in attitudes]
    assert log.attitude_table.yaw_rad.tolist() == [m.yaw for m in attitudes]
    assert (log.attitude_table.when.boot_ns // 1_000_000).tolist() == [m.time_boot_ms for m in attitudes]
    np.testing.assert_allclose(log.attitude_table.when.host_ns * 1e-9, [m._timestamp for m in attitudes], atol=1e-6)
    positions = kept["GLOBAL_POSITION_INT"]
    table = log.estimate_table
    there = [m.lat != 0 or m.lon != 0 for m in positions]
    assert np.isfinite(table.latitude_deg).tolist() == there
    assert np.rint(table.latitude_deg[there] * 1e7).tolist() == [m.lat for m in positions if m.lat]
    assert np.rint(table.height_above_home_m[there] * 1e3).tolist() == [m.relative_alt for m in positions if m.lat]
    np.testing.assert_allclose(table.velocity_m_s * 100, [[m.vy, m.vx, -m.vz] for m in positions])
    fixes = {(m.time_usec, m.lat, m.lon, m.alt, m.fix_type, m.h_acc) for m in kept["GPS_RAW_INT"] if m.time_usec}
    ours = log.fix_table
    timed = ours.when.boot_ns != NO_TIME
    read = zip(
        (ours.when.boot_ns[timed] // 1000).tolist(),
        np.rint(np.nan_to_num(ours.latitude_deg[timed]) * 1e7).astype(int).tolist(),
        np.rint(np.nan_to_num(ours.longitude_deg[timed]) * 1e7).astype(int).tolist(),
        np.rint(np.nan_to_num(ours.height_geoid_m[timed]) * 1e3).astype(int).tolist(),
        ours.fix_type[timed].tolist(),
        np.rint(np.nan_to_num(ours.sigma_horizontal_m[timed]) * 1e3).astype(int).tolist(),
        strict=True,
    )
    assert {(t, *rest) for t, *rest in read if rest[0]} == {fix for fix in fixes if fix[1]}
    assert {name.rstrip("\0") for name in log.parameters} == {m.param_id for m in kept.get("PARAM_VALUE", [])}


def test_pymavlink_agrees_on_the_first_part(tmp_path: Path) -> None:
    path = tmp_path / "part.tlog"
    path.write_bytes(recorded("digicam.tlog").read_bytes()[:200_000])
    log = tlog.read_log(path)
    check_against_pymavlink(path, log)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["digicam.tlog", "dist.tlog"])
def test_pymavlink_agrees_on_whole_flights(name: str) -> None:
    check_against_pymavlink(recorded(name), tlog.read_log(recorded(name)))


def test_pymavlinks_packer_is_read(tmp_path: Path) -> None:
    dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    for version_1 in (True, False):
        packer = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
        messages = [
            dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 5, 3),
            dialect.MAVLink_system_time_message(1_795_000_000_000_000, 60_000),
            dialect.MAVLink_attitude_message(60_000, 0.5, -0.25, 3.0, 0, 0, 0),
        ]
        data = b"".join(
            (1_795_000_000_100_000 + k).to_bytes(8, "big") + message.pack(packer, force_mavlink1=version_1)
            for k, message in enumerate(messages)
        )
        path = tmp_path / f"packed{version_1}.tlog"
        path.write_bytes(data)
        log = tlog.read_log(path)
        assert data[8] == (0xFE if version_1 else 0xFD)
        assert log.damage.lost_bytes == 0
        assert [log.attitude_table.roll_rad[0], log.attitude_table.pitch_rad[0]] == [0.5, -0.25]
        assert log.attitude_table.when.gps_ns[0] == gps_ns(1_795_000_000_000_000)
