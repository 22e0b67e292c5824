"""Tables of flights as CSV with declared columns."""

from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.log_damage import damaged
from tests.formats.made_logs import made_log
from tests.formats.text_damage import check_lost_bytes
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog
from uavkit.core.gpstime import NO_TIME, WEEK_NS, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import csv_log
from uavkit.formats.log_export import ExportKind, export_log

NOON = datetime(2024, 5, 6, 12, tzinfo=UTC)
NOON_NS = gps_time_ns_from_utc(NOON)


def read(tmp_path: Path, text: str | bytes, mapping: str | None = None) -> FlightLog:
    path = tmp_path / "flight.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    if mapping is not None:
        (tmp_path / "flight.csv.toml").write_text(mapping)
    return csv_log.read_log(path, silent)


def test_exposures_with_every_unit(tmp_path: Path) -> None:
    mapping = (
        'role = "exposures"\nseparator = ";"\nexposure_kind = "feedback"\n[columns]\ngps_week = "Week"\n'
        'gps_seconds_of_week = "TOW"\nlatitude_deg = "Lat"\nlongitude_deg = "Lon"\nheight_ellipsoid_m = "Alt"\n'
        'roll_deg = "R"\npitch_rad = "P"\nyaw_deg = "Y"\nsequence = "No"\nname = "Image"\nboot_s = "T"\nsigma_s = "S"\n'
    )
    text = (
        "# a receiver\n\nNo;Week;TOW;Lat;Lon;Alt;R;P;Y;Image;T;S;Extra\n"
        '7;2264;400373.488877;-35.5;139.25;-12.75;90;0.5;-180;"A; 1.JPG";12.000000001;0.002;x\n'
        ";;;;;;;;;;;;\n"
    )
    log = read(tmp_path, text, mapping)
    table = log.exposure_table
    assert table.when.gps_ns.tolist() == [2264 * WEEK_NS + 400_373_488_877_000, NO_TIME]
    assert table.when.boot_ns.tolist() == [12_000_000_001, NO_TIME]
    assert (table.latitude_deg[0], table.longitude_deg[0], table.height_ellipsoid_m[0]) == (-35.5, 139.25, -12.75)
    np.testing.assert_allclose([table.roll_rad[0], table.pitch_rad[0], table.yaw_rad[0]], [np.pi / 2, 0.5, -np.pi])
    assert (table.name, table.sequence.tolist()) == (("A; 1.JPG", ""), [7, -1])
    assert table.kind.tolist() == [ExposureKind.FEEDBACK] * 2
    assert table.sigma_s[0] == 0.002
    assert np.all(np.isnan(table.height_geoid_m))
    assert np.isnan(table.latitude_deg[1])
    assert log.damage.lost_bytes == 0


@pytest.mark.parametrize(
    ("field", "cell"),
    [
        ("utc", "2024-05-06T12:00:00Z"),
        ("utc", "2024-05-06 21:00:00+09:00"),
        ("utc", "2024-05-06 12:00:00"),
        ("unix_s", "1714996800"),
        ("unix_ms", "1714996800000.0"),
        ("gps_s", f"{NOON_NS // 10**9}.000"),
        ("gps_time_ns", f"{NOON_NS}"),
    ],
)
def test_ways_to_tell_the_time(tmp_path: Path, field: str, cell: str) -> None:
    mapping = f'role = "fixes"\n[columns]\n{field} = "t"\nlatitude_deg = "a"\nlongitude_deg = "o"\n'
    log = read(tmp_path, f"t,a,o\n{cell},1.5,2.5\n,1.5,2.5\n", mapping)
    assert NOON.timestamp() == 1714996800
    assert log.fix_table.when.gps_ns.tolist() == [NOON_NS, NO_TIME]


def test_attitudes_and_fixes(tmp_path: Path) -> None:
    mapping = (
        'role = "attitudes"\nseparator = " "\n[columns]\nboot_s = "t"\nroll_deg = "r"\npitch_deg = "p"\nyaw_deg = "y"\n'
    )
    log = read(tmp_path, "% made by hand\n t   r p y\n0.5  1 2   3\n1.5 4 5 nan\n", mapping)
    np.testing.assert_allclose(np.degrees(log.attitude_table.yaw_rad), [3, np.nan])
    assert log.attitude_table.when.boot_ns.tolist() == [500_000_000, 1_500_000_000]
    mapping = (
        'role = "estimates"\n[columns]\nlatitude_deg = "a"\nlongitude_deg = "o"\nfix_type = "f"\nsatellites = "s"\n'
        'velocity_up_m_s = "vu"\nheight_above_home_m = "h"\nsigma_vertical_m = "sv"\n'
    )
    log = read(tmp_path, "a,o,f,s,vu,h,sv\n1,2,rtk_fixed,17,-0.5,30,0.25\n1,2,3,,,,\n", mapping)
    table = log.estimate_table
    assert table.fix_type.tolist() == [FixType.RTK_FIXED, FixType.THREE_DIMENSIONAL]
    assert table.satellites.tolist() == [17, 255]
    np.testing.assert_array_equal(table.velocity_m_s[0], [np.nan, np.nan, -0.5])
    assert (table.height_above_home_m[0], table.sigma_vertical_m[0]) == (30, 0.25)
    assert len(log.fix_table) == 0


BASE = 'role = "fixes"\n[columns]\nlatitude_deg = "a"\nlongitude_deg = "o"\nutc = "t"\n'


def test_lines_that_cannot_be_understood_are_lost(tmp_path: Path) -> None:
    bad = ["x,2,\n", "1,5;2,5,\n", "91,2,\n", "1,,\n", "1,2,yesterday\n", "1,2,3,4\n", '1,"2,\n', "1e400,2,\n"]
    good = "1.5,2.5,\n"
    log = read(tmp_path, "a,o,t\n" + "".join(good + line for line in bad), BASE)
    assert log.fix_table.latitude_deg.tolist() == [1.5] * len(bad)
    assert log.damage.lost_bytes == sum(map(len, bad))
    assert log.damage.span_count == len(bad)
    assert "not a number" in log.damage.spans[0].why
    with pytest.raises(InputError, match=r"flight\.csv: no line below the header can be read: 5 cells, not 3"):
        read(tmp_path, "a,o,t\n1,5,2,5,2024\n")


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (BASE.replace("latitude_deg", "lattitude_deg"), r"no option 'lattitude_deg'; did you mean 'latitude_deg'"),
        (BASE.replace('"o"', '"lon"'), r"longitude_deg: flight.csv has no column 'lon'; did you mean 'long'"),
        (BASE + 'unix_s = "t"\n', "time is told twice, by unix_s and utc"),
        (BASE.replace("utc", "gps_week"), "need one another"),
        (BASE.replace('longitude_deg = "o"\n', ""), "need one another"),
        (BASE + 'kind = "t"\n', "kind is nothing that fixes have"),
        (BASE.replace("fixes", "attitudes"), "latitude_deg is nothing that attitudes have"),
        ('role = "attitudes"\n[columns]\nroll_deg = "a"\n', "attitudes need roll, pitch and yaw"),
        ('role = "exposures"\n[columns]\nname = "a"\n', "exposures need a time or a position"),
        ('role = "exposures"\n[columns]\nutc = "t"\nroll_deg = "a"\nroll_rad = "o"\n', "are the same"),
        (BASE.replace("fixes", "pictures"), "role"),
        (BASE.replace('"a"', '"d"'), "has 2 columns 'd': rename"),
        (BASE + 'separator = "|"\n', "separator"),
    ],
)
def test_wrong_declarations_say_what_is_wrong(tmp_path: Path, mapping: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, "a,o,t,long,d,d\n1,2,,,,\n" if "lon" in mapping else "a,o,t\n1,2,\n", mapping)


def test_without_a_declaration_one_is_shown(tmp_path: Path) -> None:
    text = "Image name;Lat (deg);Longitude;Alt;UTC time;Week\nA.JPG;1.5;2.5;3;2024-05-06T12:00:00Z;7\n"
    assert csv_log.recognises(text.encode())
    with pytest.raises(InputError, match=r"write a file flight\.csv\.toml") as caught:
        read(tmp_path, text)
    shown = str(caught.value).split("\n", 1)[1]
    for line in (
        'role = "exposures"',
        'separator = ";"',
        'latitude_deg = "Lat (deg)"',
        'name = "Image name"',
        "# not used",
    ):
        assert line in shown
    log = read(tmp_path, text, shown.replace('gps_week = "Week"\n', ""))  # as it is shown, but for what it cannot know
    assert log.exposure_table.name == ("A.JPG",)
    assert log.exposure_table.when.gps_ns[0] == NOON_NS


def test_only_tables_are_recognised() -> None:
    for other in (
        b"", b"hello\nworld\n", b"1,2,3\n4,5,6\n", b"<a,b>\n1,2\n", b"$GPGGA,1,2\n$GPGGA,3,4\n", bytes(100),
        b"FMT, 128, 89, FMT, BBnNZ, Type\nFMT, 129, 31, PARM, Nf, Name\n", b"a,a\n1,2\n",
        b"1\t400373.4\t[2264]\t-40,N\t0,E\t86,V\t44.4,Lat\t1.2,Lon\t359.4,Ellh\t0.028, 0.031, 0.055\t16,Q\n" * 2,
    ):  # fmt: skip
        assert not csv_log.recognises(other)


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no CSV with names"):
        read(tmp_path, "hello\n")
    for text, message in (
        ("", "no line with the names"),
        ("# a\n" * 300, "no line with the names"),
        ("a,o,t\n", "no line be"),
    ):
        with pytest.raises(InputError, match=message):
            read(tmp_path, text, BASE)
    for text, message in (
        ("# uavkit flight log: fixis\na,b\n", "'fixis' is none of .*; did you mean 'fixes'"),
        ("# uavkit flight log: fixes\na,b\n", "does not name the columns of fixes"),
        ("# uavkit flight log: fixes\n", "no line with the names"),
    ):
        with pytest.raises(InputError, match=message):
            read(tmp_path, text)


def exported(tmp_path: Path) -> dict[str, bytes]:
    files = export_log(made_log(11, count=25), tmp_path, ExportKind.CSV)
    return {file.name: file.read_bytes() for file in files}


def check_damage(tmp_path: Path, data: bytes, seed: int) -> None:
    head = b"".join(data.splitlines(keepends=True)[:3])
    lines = data[len(head) :].splitlines(keepends=True)
    harmed = damaged(data[len(head) :], np.random.default_rng(seed), longest=800)
    intact, log = read(tmp_path, data), read(tmp_path, head + harmed.data)
    rows = [intact.fix_table, log.fix_table] if len(intact.fix_table) else [intact.attitude_table, log.attitude_table]
    times = [np.stack([table.when.gps_ns, table.when.boot_ns, table.when.host_ns], axis=1).tolist() for table in rows]
    begin = 0
    for n, line in enumerate(lines):
        if harmed.moved(max(begin - 1, 0), begin + len(line)) is not None:
            assert times[0][n] in times[1], (seed, harmed.kind)
        begin += len(line)
    check_lost_bytes(head + harmed.data, log, partial(read, tmp_path), head + lines[0])


def test_damage_at_random_places(tmp_path: Path) -> None:
    files = exported(tmp_path)
    for seed in range(200):
        check_damage(tmp_path, files["00000001_attitudes.csv" if seed % 2 else "00000001_fixes.csv"], seed)


@pytest.mark.slow
def test_damage_at_a_thousand_places(tmp_path: Path) -> None:
    files = exported(tmp_path)
    for seed in range(200, 1000):
        check_damage(tmp_path, files["00000001_attitudes.csv" if seed % 2 else "00000001_fixes.csv"], seed)


@settings(max_examples=150, deadline=None)
@given(
    data=st.one_of(
        st.binary(max_size=300),
        st.text(alphabet='0123456789.,;"\n\r eE-+#%naotZ:T', max_size=300),
        st.lists(st.sampled_from(["1.5,", "9" * 30, "1e999,", "0001-01-01T00:00:00+23:00,", "\n", '"', ",", "2,"])).map(
            "".join
        ),
    )
)
def test_no_bytes_give_anything_but_input_errors(tmp_path_factory: pytest.TempPathFactory, data: bytes | str) -> None:
    folder = tmp_path_factory.mktemp("csv")
    text = data if isinstance(data, bytes) else data.encode()
    mark = b"# uavkit flight log: "
    head = b"gps_time_ns,latitude_deg,longitude_deg,name\n"
    for content in (
        text,
        mark + text,
        mark + b"fixes\n" + head + text,
        mark + b"exposures\n" + head + b"1,2,3,\n" + text,
    ):
        csv_log.recognises(content)
        with suppress(InputError):
            log = read(folder, content)
            assert len(list(log.fixes())) <= len(log.fix_table)
    with suppress(InputError):
        read(folder, b"a,o,t\n" + text, BASE)
