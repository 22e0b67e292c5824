"""DJI's Timestamp.MRK."""

from collections import Counter
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.log_damage import damaged
from tests.formats.text_damage import check_lost_bytes
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog
from uavkit.core.gpstime import NO_TIME, WEEK_NS
from uavkit.core.progress import silent
from uavkit.formats import dji_mrk

WEEK, TOW_S = 2264, 400373.488877


def line(number: int, *, week: str = f"[{WEEK}]", offset: str = "-40,N\t10,E\t86,V", q: int = 50) -> str:
    return (
        f"{number}\t{TOW_S + 2.5 * number:.6f}\t{week}\t{offset}\t{44.42824637 + number * 1e-5:.8f},Lat\t"
        f"{1.26196331 - number * 1e-5:.8f},Lon\t{359.494 + number:.3f},Ellh\t0.028, 0.031, 0.055\t{q},Q\n"
    )


def read(tmp_path: Path, data: str | bytes) -> FlightLog:
    path = tmp_path / "100_0004_Timestamp.MRK"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return dji_mrk.read_log(path, silent)


def test_every_field_with_unit_and_sign(tmp_path: Path) -> None:
    log = read(tmp_path, line(7))
    table = log.exposure_table
    assert table.when.gps_ns[0] == WEEK * WEEK_NS + 400_390_988_877_000  # 400373.488877 s + 17.5 s
    assert (table.sequence[0], table.kind[0]) == (7, ExposureKind.MARK)
    assert (table.latitude_deg[0], table.longitude_deg[0], table.height_ellipsoid_m[0]) == (
        44.42831637, 1.26189331, 366.494,
    )  # fmt: skip
    assert np.isnan(table.height_geoid_m[0])
    fixes = log.fix_table
    north_m = (table.latitude_deg[0] - fixes.latitude_deg[0]) * np.radians(1) * 6_378_137
    east_m = (table.longitude_deg[0] - fixes.longitude_deg[0]) * np.radians(1) * 6_378_137 * np.cos(np.radians(44.428))
    np.testing.assert_allclose([north_m, east_m], [-0.040, 0.010], atol=1e-4)  # from the antenna to the camera
    assert fixes.height_ellipsoid_m[0] == pytest.approx(366.494 + 0.086)  # the camera hangs below the antenna
    assert fixes.sigma_horizontal_m[0] == pytest.approx(np.hypot(0.028, 0.031) / np.sqrt(2))
    assert fixes.sigma_vertical_m[0] == 0.055
    assert log.damage.lost_bytes == 0
    assert any("camera's" in note and "95 mm" in note for note in log.notes)


def test_states_of_the_receiver(tmp_path: Path) -> None:
    log = read(tmp_path, "".join(line(n, q=q) for n, q in enumerate((0, 16, 34, 50, 52))))
    assert [FixType(t) for t in log.fix_table.fix_type] == [
        FixType.NO_FIX, FixType.THREE_DIMENSIONAL, FixType.RTK_FLOAT, FixType.RTK_FIXED, FixType.RTK_FIXED,
    ]  # fmt: skip
    assert np.isnan(log.exposure_table.latitude_deg).tolist() == [True, False, False, False, False]
    assert len(list(log.fixes())) == 4
    assert len(list(log.exposures())) == 5


def test_without_week_there_is_no_gps_time(tmp_path: Path) -> None:
    log = read(tmp_path, line(1, week="").replace("\t\t", "\t"))
    assert log.exposure_table.when.gps_ns[0] == NO_TIME
    assert log.exposure_table.when.boot_ns[0] == 400_375_988_877_000
    assert any("week" in note for note in log.notes)


def test_a_position_of_zeros_is_none(tmp_path: Path) -> None:
    zeros = "1\t400373.488877\t[2264]\t0,N\t0,E\t0,V\t0.00000000,Lat\t0.00000000,Lon\t0.000,Ellh\t0, 0, 0\t16,Q\n"
    log = read(tmp_path, zeros)
    assert np.isnan(log.exposure_table.latitude_deg[0])
    assert np.isnan(log.fix_table.sigma_horizontal_m[0])
    assert next(log.exposures()).position is None


def test_lines_that_are_none_are_lost_bytes(tmp_path: Path) -> None:
    bad = "3\t400373.488877\t[2264]\t-40,N\t0,E\n"
    beyond = line(4).replace("44.428", "94.428")
    log = read(tmp_path, line(1) + "\n" + bad + line(2) + beyond)
    assert log.exposure_table.sequence.tolist() == [1, 2]
    assert log.damage.lost_bytes == len(bad) + len(beyond)
    assert [span.offset for span in log.damage.spans] == [len(line(1)) + 1, len(line(1)) + 1 + len(bad) + len(line(2))]


def test_a_line_right_behind_zero_bytes_is_found(tmp_path: Path) -> None:
    log = read(tmp_path, line(1)[:-20] + "\0" * 50 + line(2))
    assert log.exposure_table.sequence.tolist() == [2]
    assert log.damage.lost_bytes == len(line(1)) - 20 + 50


def test_only_its_own_kind_is_recognised() -> None:
    assert dji_mrk.recognises(line(1).encode())
    for other in (
        b"",
        b"lat,lon,ellh\n1,2,3\n",
        b"<gpx>",
        b"1\n00:00:00,000 --> 00:00:01,000\nGPS(1,2,3)\n",
        bytes(99),
    ):
        assert not dji_mrk.recognises(other)


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Timestamp\.MRK: no line of a DJI MRK"):
        read(tmp_path, "hello\n")
    with pytest.raises(InputError, match="cannot be read"):
        dji_mrk.read_log(tmp_path / "none.MRK", silent)


def check_damage(tmp_path: Path, seed: int) -> None:
    lines = [line(n) for n in range(60)]
    data, rng = "".join(lines).encode(), np.random.default_rng(seed)
    harmed = damaged(data, rng)
    log = read(tmp_path, harmed.data)
    begins = np.cumsum([0, *(len(text) for text in lines)])
    whole = [n for n in range(60) if harmed.moved(max(begins[n] - 1, 0), begins[n + 1]) is not None]  # line ends too
    found = log.exposure_table.sequence.tolist()
    assert set(whole) <= set(found), (seed, harmed.kind)
    check_lost_bytes(harmed.data, log, partial(read, tmp_path))


def test_damage_at_random_places(tmp_path: Path) -> None:
    for seed in range(200):
        check_damage(tmp_path, seed)


@pytest.mark.slow
def test_damage_at_a_thousand_places(tmp_path: Path) -> None:
    for seed in range(200, 1000):
        check_damage(tmp_path, seed)


@settings(max_examples=150, deadline=None)
@given(data=st.one_of(st.binary(max_size=400), st.text(alphabet="0123456789.,[]\t NEVLatonhQ-\n", max_size=400)))
def test_no_bytes_give_anything_but_input_errors(tmp_path_factory: pytest.TempPathFactory, data: bytes | str) -> None:
    folder = tmp_path_factory.mktemp("mrk")
    text = data if isinstance(data, bytes) else data.encode()
    for content in (text, line(1).encode() + text + line(2).encode()):
        dji_mrk.recognises(content)
        with suppress(InputError):
            read(folder, content)


def test_counts(tmp_path: Path) -> None:
    assert Counter(read(tmp_path, line(1) + line(2)).message_counts) == {"MRK": 2}
