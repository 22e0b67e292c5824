"""The delay between a receiver's fixes and the vehicle's clock, simulated and on recorded flights."""

import json
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog, Stamps, fix_table
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.ingest.gnss_delay import ESTIMATE_LAG_SIGMA_S, GnssDelay, estimate_gnss_delay
from uavkit.ingest.trajectory import Trajectory, build_trajectory

FRAME = LocalFrame.at(35.8, 139.65, 20.0)
START_NS = 1_479_354_600_000_000_000
SITL = Path(__file__).resolve().parents[2] / "../shared/data/sitl"


def lawn(seconds: np.ndarray, speed_m_s: float = 4.0) -> np.ndarray:
    """Strips to and fro of 20 s, 10 m apart, with round turns: a smooth path of period 48 s."""
    phase = np.asarray(seconds) / 24.0 * np.pi
    east = 20.0 * speed_m_s / 2.0 * np.sin(phase) * 24.0 / (10.0 * np.pi)
    north = 10.0 * np.asarray(seconds) / 24.0
    return np.column_stack([east, north, np.full(len(east), 15.0)])


def trajectory_of(stamped: np.ndarray, true: np.ndarray, path=lawn, error_m: np.ndarray | float = 0.0) -> Trajectory:
    """Positions of the moments ``true`` with the stamps ``stamped``, in seconds."""
    latitude, longitude, height = FRAME.geographic_from_enu(path(true) + error_m).T
    when = Stamps.of(len(stamped), gps_ns=START_NS + np.rint(stamped * 1e9).astype(np.int64))
    return build_trajectory(fix_table(when, latitude, longitude, height_geoid_m=height))


def measured(
    rng: np.random.Generator, delay_s: float, path=lawn, correlation: float = 0.0, wrong: int = 0
) -> GnssDelay:
    """Fixes of 5 Hz; estimates of 10 Hz whose stamps are too early by the delay, 0.2 m off, with noise of 2 cm."""
    t = np.arange(0.0, 150.0, 0.2)
    noise = rng.normal(0, 0.02, (len(t), 3))
    for row in range(1, len(t)):
        noise[row] = correlation * noise[row - 1] + np.sqrt(1.0 - correlation**2) * noise[row]
    noise[rng.permutation(len(t))[:wrong]] += [8.0, -2.0, 0.0]
    boot = np.arange(0.03, 149.5, 0.1)
    estimates = trajectory_of(boot - delay_s, boot, path, error_m=np.array([0.2, -0.1, 0.5]))
    return estimate_gnss_delay(estimates, trajectory_of(t, t, path, error_m=noise))


@pytest.mark.parametrize("delay_s", [0.12, -0.05, 0.6])
def test_the_delay_is_added_to_the_boot_clock(delay_s: float) -> None:
    """Stamps of the estimate come too early by the delay: adding it gives their true time."""
    found = measured(np.random.default_rng(1), delay_s)
    assert found.delay_s == pytest.approx(delay_s, abs=4.0 * found.scatter_s)
    assert found.scatter_s < 0.002
    assert found.offset_m == pytest.approx((0.2, -0.1), abs=0.01)
    assert 0.015 < found.residual_m < 0.025
    assert found.sigma_s == pytest.approx(np.hypot(found.scatter_s, ESTIMATE_LAG_SIGMA_S))


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_errors_of_the_delay_are_standard_normal(correlation: float) -> None:
    z = []
    for seed in range(20):
        found = measured(np.random.default_rng(seed), 0.12, correlation=correlation)
        z.append((found.delay_s - 0.12) / found.scatter_s)
    assert abs(np.mean(np.square(z)) - 1.0) < 3.5 * np.sqrt(2.0 / len(z))


def test_wrong_fixes_hardly_count() -> None:
    """Errors of 8 m of a twentieth of the fixes would move least squares by some 20 ms, and one in 12 velocities."""
    moves = []
    for seed in range(5):
        clean, spoilt = (measured(np.random.default_rng(seed), 0.12, wrong=wrong) for wrong in (0, 40))
        moves.append(spoilt.delay_s - clean.delay_s)
        assert spoilt.scatter_s < 0.02
    assert np.sqrt(np.mean(np.square(moves))) < 0.004


def test_a_hovering_vehicle_tells_nothing() -> None:
    """Noise of the fixes looks like motion without a delay: it must not be taken for one."""
    with pytest.raises(InputError, match="0 moments in motion in common"):
        measured(np.random.default_rng(4), 0.12, path=lambda seconds: lawn(np.zeros(len(seconds))))


def test_one_direction_does_not_tell_delay_from_offset() -> None:
    def one_way(seconds: np.ndarray) -> np.ndarray:
        return np.column_stack([5.0 * np.asarray(seconds), 0.0 * seconds, 15.0 + 0.0 * seconds])

    there, both = (measured(np.random.default_rng(5), 0.12, path=path) for path in (one_way, lawn))
    assert there.scatter_s > 10.0 * both.scatter_s
    assert abs(there.delay_s) < 4.0 * there.scatter_s + 0.2


def test_nothing_in_common_is_an_error() -> None:
    t = np.arange(0.0, 20.0, 0.2)
    with pytest.raises(InputError, match="0 moments in motion in common"):
        estimate_gnss_delay(trajectory_of(t, t), trajectory_of(t + 500.0, t))


@pytest.mark.parametrize("name", ["dist", "digicam"])
def test_recorded_flights(name: str) -> None:
    """A simulated vehicle whose receiver lags by 0.1 s: exposures and fixes agree once the delay is added."""
    path = SITL / f"{name}.BIN"
    if not path.is_file():
        pytest.skip(f"{path} is not there: recorded flights are kept beside the project")
    from uavkit.core.progress import silent
    from uavkit.formats.dataflash import read_log

    log = read_log(path, silent)
    fixes, estimates = build_trajectory(log.fix_table), build_trajectory(log.estimate_table)
    found = estimate_gnss_delay(estimates, fixes)
    assert fixes.height_datum is estimates.height_datum is HeightDatum.GEOID  # the simulator has no undulation
    truth = _true_delay(path, log, fixes)
    assert truth.scatter_s < 1e-3
    assert abs(found.delay_s - truth.delay_s) < found.sigma_s
    assert found.scatter_s < 0.002
    # The exposures' own positions are the estimate's: late fixes are 0.05 s and more off, at 2.3 and 4 m/s.
    table = log.exposure_table
    assert len(table) == len(json.loads((SITL / f"{name}_truth.json").read_text())["camera_feedback"])
    own_m = fixes.frame.enu_from_geographic(table.latitude_deg, table.longitude_deg, table.height_geoid_m)
    before_m = fixes.at(table.when.gps_ns).position_m - own_m
    after_m = fixes.at(table.when.gps_ns + round(found.delay_s * 1e9)).position_m - own_m
    assert np.sqrt(np.mean(np.sum(before_m[:, :2] ** 2, axis=1))) > 0.1
    # Positions are written in steps of 1 cm; the estimate is smoother than the fixes.
    assert np.sqrt(np.mean(np.sum(after_m[:, :2] ** 2, axis=1))) < 0.025
    assert np.sqrt(np.mean(after_m[:, 2] ** 2)) < 0.03


def _true_delay(path: Path, log: FlightLog, fixes: Trajectory) -> GnssDelay:
    """Return the delay of the fixes against the simulator's own positions, which the log has in messages SIM."""
    from pymavlink import DFReader

    reader, rows = DFReader.DFReader_binary(str(path)), []
    while (message := reader.recv_match(type="SIM")) is not None:
        rows.append((message.TimeUS * 1000, message.Lat, message.Lng, message.Alt))
    reader.filehandle.close()
    boot, latitude, longitude, height = np.array(rows).T
    assert log.clock is not None
    when = Stamps.of(len(rows), gps_ns=log.clock.gps_ns(boot.astype(np.int64)))
    return estimate_gnss_delay(build_trajectory(fix_table(when, latitude, longitude, height_geoid_m=height)), fixes)
