"""Any log is known by its content; whatever is none ends in one clear error, within seconds and in little memory."""

import resource
import struct
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.core.flight_log import LogKind
from uavkit.formats.flight_logs import open_log
from uavkit.formats.log_summary import log_summary, summary_lines

RECORDED = Path(__file__).resolve().parents[2] / "sim_logs"
KINDS = {
    "sitl_distance_trigger/flight.BIN": (LogKind.DATAFLASH, 31),
    "sitl_distance_trigger/flight.tlog": (LogKind.TLOG, 31),
    "sitl_waypoint_trigger/flight.BIN": (LogKind.DATAFLASH, 33),
    "sitl_waypoint_trigger/flight.tlog": (LogKind.TLOG, 33),
    "px4_distance_trigger/flight.ulg": (LogKind.ULOG, 31),
    "px4_distance_trigger/flight.tlog": (LogKind.TLOG, 31),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_log_is_known_by_its_content_under_any_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / "renamed.jpg"
    path.write_bytes((RECORDED / name).read_bytes())
    log = open_log(path)
    assert (log.kind, len(log.exposure_table)) == KINDS[name]
    assert log.damage.lost_bytes == 0
    assert len(log.fix_table) > 300
    assert len(log.attitude_table) > 300


@pytest.mark.parametrize("name", KINDS)
def test_all_logs_of_a_flight_tell_the_same_exposures(name: str) -> None:
    """Of each flight there are two recordings; exposures agree in place and, to the clocks' residuals, in time."""
    folder = (RECORDED / name).parent
    one, two = (open_log(path) for path in sorted(folder.glob("flight.*")))
    assert np.abs(one.exposure_table.latitude_deg - two.exposure_table.latitude_deg).max() <= 1.01e-7
    assert np.abs(one.exposure_table.longitude_deg - two.exposure_table.longitude_deg).max() <= 1.01e-7
    apart_s = (one.exposure_table.when.gps_ns - two.exposure_table.when.gps_ns) * 1e-9
    assert np.abs(apart_s).max() < 0.015


def test_two_logs_read_at_once_are_read_as_alone() -> None:
    names = list(KINDS) * 2
    alone = [log_summary(open_log(RECORDED / name)) for name in names]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda name: log_summary(open_log(RECORDED / name)), names))
    assert together == alone


def test_two_gigabytes_of_zeros_are_refused_within_seconds_and_in_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "flight.BIN"
    with path.open("wb") as stream:
        stream.truncate(2 * 1024**3)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    with pytest.raises(InputError, match="nothing but zeros"):
        open_log(path)
    assert time.process_time() - begin < 5.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 100_000


def test_zeros_before_a_log_are_passed_over_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "flight.BIN"
    content = (RECORDED / "sitl_distance_trigger/flight.BIN").read_bytes()
    path.write_bytes(bytes(10_000_000) + content)
    log = open_log(path)
    assert len(log.exposure_table) == 31
    assert log.damage.lost_bytes == 10_000_000


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty"),
        (b"Take-off at noon, landing at one.\n" * 100, "this is text, no flight log"),
        (b"\xff\xd8\xff\xe0" + bytes(range(256)) * 20, "this is a JPEG picture"),
        (bytes(range(7, 250)) * 100, "bytes of an unknown kind"),
    ],
)
def test_what_is_no_log_is_named_for_what_it_is(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.BIN"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as error:
        open_log(path)
    assert str(path) in str(error.value)


def test_a_folder_and_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        open_log(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        open_log(tmp_path / "none.BIN")


def test_bombs_are_refused_in_little_memory(tmp_path: Path) -> None:
    """A KMZ that unpacks to a gigabyte and tells a small size; a KML whose entities would fill the memory."""
    bomb = tmp_path / "bomb.kmz"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("doc.kml", "w") as stream:
        stream.write(b'<?xml version="1.0"?><kml><Document><name>')
        for _ in range(1024):
            stream.write(bytes(1024 * 1024))
    told = bytearray(bomb.read_bytes())
    directory = told.rindex(b"PK\x01\x02")
    struct.pack_into("<I", told, directory + 24, 1000)
    lying = tmp_path / "lying.kmz"
    lying.write_bytes(told)
    entities = tmp_path / "entities.kml"
    lines = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 12))
    entities.write_text(
        f'<?xml version="1.0"?><!DOCTYPE kml [<!ENTITY e0 "aaaaaaaaaa">{lines}]>'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>&e11;</name></Placemark></kml>'
    )
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    for path in (bomb, lying, entities):
        with pytest.raises(InputError, match=str(path)):
            open_log(path)
    assert time.process_time() - begin < 10.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 600_000


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(sorted(KINDS)))
def test_mutilated_logs_end_in_tables_or_in_one_error(seed: int, name: str, tmp_path: Path) -> None:
    """Bytes of recorded flights, cut, shuffled, overwritten: never anything but a log or an InputError."""
    rng = np.random.default_rng(seed)
    content = bytearray((RECORDED / name).read_bytes())
    begin = int(rng.integers(len(content)))
    piece = content[begin : begin + int(rng.integers(1, 20_000))]
    for place in rng.integers(0, len(piece), int(rng.integers(0, 40))):
        piece[place] = int(rng.integers(256))
    if rng.random() < 0.3:
        piece = bytearray(rng.bytes(int(rng.integers(1, 2000)))) + piece
    path = tmp_path / "mutilated"
    path.write_bytes(piece)
    try:
        log = open_log(path)
    except InputError:
        return
    assert summary_lines(log)
    assert log.damage.lost_bytes <= len(piece)


def test_the_summary_tells_what_is_in_a_log() -> None:
    log = open_log(RECORDED / "sitl_distance_trigger/flight.BIN")
    told = log_summary(log)
    assert told["kind"] == "ArduPilot dataflash"
    assert told["begin_utc"].startswith("2026-11-22T03:50:28")
    assert told["exposures"]["count"] == 31
    assert told["fixes"]["interval_s"] == pytest.approx(0.2)
    assert told["fixes"]["sigma_horizontal_m"] == pytest.approx(0.3)
    assert told["messages"]["CAM"] == 31
    lines = "\n".join(summary_lines(log))
    assert "ArduCopter V4.6.3" in lines
    assert "exposures 31 (31 trigger)" in lines
    assert "damage    none" in lines
