"""Time and memory that reading a telemetry log takes, beside pymavlink."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from uavkit.formats import tlog

SITL = Path(__file__).resolve().parents[2] / "../shared/data/sitl"

MEMORY = """
import sys
from pathlib import Path
from uavkit.formats import tlog
import dataclasses
import numpy as np

def grown():
    # Not getrusage: its peak is that of the parent process until the child's own is greater.
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024

tlog.read_log(Path(sys.argv[1]))
before = grown()
log = tlog.read_log(Path(sys.argv[2]))
tables = (log.fix_table, log.estimate_table, log.attitude_table, log.exposure_table)

def size(table):
    columns = [getattr(table, field.name) for field in dataclasses.fields(table)]
    when = table.when
    arrays = [c for c in columns if isinstance(c, np.ndarray)] + [when.gps_ns, when.boot_ns, when.host_ns]
    return sum(a.nbytes for a in arrays)

print(grown() - before, sum(size(table) for table in tables))
"""


def repeated(path: Path, name: str, megabytes: float) -> Path:
    """Make a log of that size of a recorded flight, over and over."""
    if not (SITL / name).exists():
        pytest.skip(f"{SITL / name} is not there")
    data = (SITL / name).read_bytes()
    with path.open("wb") as stream:
        for _ in range(round(megabytes * 1e6 / len(data)) or 1):
            stream.write(data)
    return path


def seconds_by_pymavlink(path: Path) -> tuple[float, int]:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    begin = time.perf_counter()
    reader = mavutil.mavlogfile(str(path))
    count = 0
    while reader.recv_match(type=["ATTITUDE", "GPS_RAW_INT", "CAMERA_FEEDBACK", "GLOBAL_POSITION_INT"]) is not None:
        count += 1
    reader.close()
    return time.perf_counter() - begin, count


def seconds_by_us(path: Path) -> tuple[float, int]:
    begin = time.perf_counter()
    log = tlog.read_log(path)
    counts = log.message_counts
    names = ("ATTITUDE", "GPS_RAW_INT", "CAMERA_FEEDBACK", "GLOBAL_POSITION_INT")
    return time.perf_counter() - begin, sum(counts.get(name, 0) for name in names)


def test_faster_than_pymavlink(tmp_path: Path) -> None:
    path = repeated(tmp_path / "part.tlog", "digicam.tlog", 1.3)
    seconds_by_us(path)  # compiles
    ours, count = min(seconds_by_us(path) for _ in range(3))
    theirs, their_count = seconds_by_pymavlink(path)
    assert count == their_count
    assert theirs / ours > 8.0  # 21 s for 50 MB against the 5 s allowed, and more to spare on so small a log


@pytest.mark.slow
@pytest.mark.parametrize("name", ["digicam.tlog", "px4_dist.tlog"])
def test_fifty_megabytes(tmp_path: Path, name: str) -> None:
    seconds_by_us(repeated(tmp_path / "small.tlog", name, 1.3))
    path = repeated(tmp_path / "long.tlog", name, 50.0)
    ours, count = seconds_by_us(path)
    theirs, their_count = seconds_by_pymavlink(path)
    print(f"{name}: 50 MB in {ours:.2f} s, pymavlink {theirs:.1f} s")  # noqa: T201
    assert count == their_count
    assert ours < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["digicam.tlog", "px4_dist.tlog"])
def test_memory_of_fifty_megabytes(tmp_path: Path, name: str) -> None:
    if not Path("/proc/self/status").exists():
        pytest.skip("the peak of a process is read from /proc")
    small, path = repeated(tmp_path / "small.tlog", name, 1.3), repeated(tmp_path / "long.tlog", name, 50.0)
    command = [sys.executable, "-c", MEMORY, str(small), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    grown, extracted = (int(word) for word in done.stdout.split())
    print(f"{name}: {grown / 1e6:.1f} MB more for {extracted / 1e6:.1f} MB of tables")  # noqa: T201
    assert 0.3 * extracted < grown < 3 * extracted
