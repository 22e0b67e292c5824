"""NMEA sentences: known fields in, the same values out; sentences of one time joined; dates carried on."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats import receiver_bytes as made
from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixType, FlightLog, LogKind
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import nmea

KNOT_M_S = 1852.0 / 3600.0


def read(folder: Path, *sentences: str | bytes) -> FlightLog:
    path = folder / "receiver.nmea"
    path.write_bytes(b"".join(made.nmea(text) if isinstance(text, str) else text for text in sentences))
    return nmea.read_log(path, silent)


def gps(*utc: int, micro: int = 0) -> int:
    year, month, day, hour, minute, second = utc
    return gps_time_ns_from_utc(datetime(year, month, day, hour, minute, second, micro, tzinfo=UTC))


def test_every_field_of_an_epoch(tmp_path: Path) -> None:
    log = read(
        tmp_path,
        "GNRMC,031415.20,A,3536.1234567,S,13942.7654321,W,12.5,210.0,050126,,,R,V",
        "GNVTG,99.0,T,,M,1.0,N,1.852,K,A",
        "GNGGA,031415.20,3536.1234567,S,13942.7654321,W,4,17,0.61,36.25,M,-39.5,M,1.0,0123",
        "GNGSA,A,3,01,02,03,,,,,,,,,,1.2,0.6,1.0,1",
        "GNGST,031415.20,1.0,0.03,0.02,45.0,0.012,0.016,0.025",
        "GNZDA,031415.20,05,01,2026,00,00",
        "GPGSV,1,1,01,05,45,120,40",
    )
    table = log.fix_table
    assert log.kind is LogKind.NMEA
    assert len(table) == 1
    assert table.latitude_deg == pytest.approx(-(35 + 36.1234567 / 60), abs=1e-12)
    assert table.longitude_deg == pytest.approx(-(139 + 42.7654321 / 60), abs=1e-12)
    assert table.height_geoid_m.tolist() == [36.25]
    assert table.height_ellipsoid_m.tolist() == [36.25 - 39.5]
    assert np.isnan(table.height_above_home_m).all()
    speed = 12.5 * KNOT_M_S
    expected = [speed * np.sin(np.radians(210.0)), speed * np.cos(np.radians(210.0)), np.nan]
    np.testing.assert_allclose(table.velocity_m_s, [expected])
    assert table.sigma_horizontal_m == pytest.approx(np.sqrt((0.012**2 + 0.016**2) / 2))
    assert table.sigma_vertical_m.tolist() == [0.025]
    assert table.fix_type.tolist() == [FixType.RTK_FIXED]
    assert table.satellites.tolist() == [17]
    assert table.when.gps_ns.tolist() == [gps(2026, 1, 5, 3, 14, 15, micro=200_000)]
    assert log.message_counts == dict.fromkeys(("GNGGA", "GNGSA", "GNGST", "GNRMC", "GNVTG", "GNZDA", "GPGSV"), 1)
    assert log.damage.lost_bytes == 0
    assert log.notes == ()


def test_empty_fields_are_unknown(tmp_path: Path) -> None:
    log = read(
        tmp_path, "GNRMC,120000.00,A,,,,,,,050126,,,A", "GNGGA,120000.00,,,,,1,,,,M,,M,,", "GNGST,120000.00,,,,,,,"
    )
    table = log.fix_table
    columns = ("latitude_deg", "longitude_deg", "height_geoid_m", "height_ellipsoid_m", "sigma_horizontal_m")
    for name in (*columns, "sigma_vertical_m"):
        assert np.isnan(getattr(table, name)).all(), name
    assert np.isnan(table.velocity_m_s).all()
    assert table.satellites.tolist() == [255]
    assert list(log.fixes()) == []
    assert any("no valid position" in note for note in log.notes)


def test_geoid_height_alone_and_sigma_zero(tmp_path: Path) -> None:
    log = read(tmp_path, "GPGGA,120000,3536.0,N,13942.0,E,1,08,0.9,36.2,M,,M,,", "GPGST,120000,1,,,,0.0,0.0,0.0")
    table = log.fix_table
    assert table.height_geoid_m.tolist() == [36.2]
    assert np.isnan(table.height_ellipsoid_m).all()
    assert np.isnan(table.sigma_horizontal_m).all()
    assert np.isnan(table.sigma_vertical_m).all()


@pytest.mark.parametrize(
    "quality, gsa, expected",
    [
        ("0", "", FixType.NO_FIX), ("", "", FixType.NO_FIX), ("1", "", FixType.THREE_DIMENSIONAL),
        ("1", "2", FixType.TWO_DIMENSIONAL), ("1", "3", FixType.THREE_DIMENSIONAL), ("2", "2", FixType.DIFFERENTIAL),
        ("3", "", FixType.THREE_DIMENSIONAL), ("4", "3", FixType.RTK_FIXED), ("5", "3", FixType.RTK_FLOAT),
        ("6", "", FixType.NO_FIX), ("7", "", FixType.UNKNOWN), ("8", "", FixType.UNKNOWN),
    ],
)  # fmt: skip
def test_quality_of_gga(tmp_path: Path, quality: str, gsa: str, expected: FixType) -> None:
    sentences = [f"GPGGA,120000,3536.0,N,13942.0,E,{quality},08,0.9,36.2,M,39.3,M,,"]
    sentences += [f"GPGSA,A,{gsa},01,02"] if gsa else []
    assert read(tmp_path, *sentences).fix_table.fix_type.tolist() == [expected]


@pytest.mark.parametrize(
    "sentence, expected",
    [
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,", FixType.UNKNOWN),
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,,A", FixType.UNKNOWN),
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,,D", FixType.DIFFERENTIAL),
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,,F", FixType.RTK_FLOAT),
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,,R", FixType.RTK_FIXED),
        ("GPRMC,120000,V,3536.0,N,13942.0,E,0,,050126,,,N", FixType.NO_FIX),
        ("GPRMC,120000,A,3536.0,N,13942.0,E,0,,050126,,,E", FixType.NO_FIX),
        ("GPGLL,3536.0,N,13942.0,E,120000,A", FixType.UNKNOWN),
        ("GPGLL,3536.0,N,13942.0,E,120000,V,N", FixType.NO_FIX),
        ("GNGNS,120000,3536.0,N,13942.0,E,NNNN,08,0.9,36.2,39.3,,", FixType.NO_FIX),
        ("GNGNS,120000,3536.0,N,13942.0,E,AN,08,0.9,36.2,39.3,,", FixType.THREE_DIMENSIONAL),
        ("GNGNS,120000,3536.0,N,13942.0,E,NDA,08,0.9,36.2,39.3,,", FixType.DIFFERENTIAL),
        ("GNGNS,120000,3536.0,N,13942.0,E,FFFN,08,0.9,36.2,39.3,,", FixType.RTK_FLOAT),
        ("GNGNS,120000,3536.0,N,13942.0,E,ARRN,08,0.9,36.2,39.3,,", FixType.RTK_FIXED),
        ("GNGNS,120000,3536.0,N,13942.0,E,S,08,0.9,36.2,39.3,,", FixType.UNKNOWN),
    ],
)
def test_fix_and_place_of_the_other_sentences(tmp_path: Path, sentence: str, expected: FixType) -> None:
    table = read(tmp_path, sentence).fix_table
    assert table.fix_type.tolist() == [expected]
    assert table.latitude_deg.tolist() == [35.6]
    assert table.longitude_deg.tolist() == [139.7]
    if "GNS" in sentence:
        assert table.height_ellipsoid_m.tolist() == [36.2 + 39.3]
        assert table.satellites.tolist() == [8]


def test_places_that_are_none(tmp_path: Path) -> None:
    for place in (
        "3560.0,N,13942.0,E",
        "9100.0,N,13942.0,E",
        "-3536.0,N,13942.0,E",
        "3536.0,X,13942.0,E",
        "35x6,N,1,E",
    ):
        log = read(tmp_path, f"GPGGA,120000,{place},1,08,0.9,36.2,M,39.3,M,,")
        assert np.isnan(log.fix_table.latitude_deg).all(), place
    for place in ("3536.0,N,18100.0,E", "3536.0,N,13942.0,N", "3536.0,N,,E"):
        log = read(tmp_path, f"GPGGA,120000,{place},1,08,0.9,36.2,M,39.3,M,,")
        assert np.isnan(log.fix_table.longitude_deg).all(), place


def test_velocity_of_vtg_and_at_rest(tmp_path: Path) -> None:
    gga = "GPGGA,120000,3536.0,N,13942.0,E,1,08,0.9,36.2,M,39.3,M,,"
    for vtg in ("GPVTG,90.0,T,,M,10.0,N,18.52,K,A", "GPVTG,90.0,T,,M,,N,18.52,K,A"):
        velocity = read(tmp_path, gga, vtg).fix_table.velocity_m_s
        np.testing.assert_allclose(velocity, [[18.52 / 3.6, 0.0, np.nan]], atol=1e-12)
    velocity = read(tmp_path, gga, "GPVTG,,T,,M,0.0,N,0.0,K,A").fix_table.velocity_m_s
    np.testing.assert_allclose(velocity, [[0.0, 0.0, np.nan]])
    velocity = read(tmp_path, gga, "GPVTG,,T,,M,0.1,N,0.2,K,A").fix_table.velocity_m_s
    assert np.isnan(velocity).all(), "the direction is not known"


def gga(time: str, quality: int = 1) -> str:
    return f"GPGGA,{time},3536.0,N,13942.0,E,{quality},08,0.9,36.2,M,39.3,M,,"


def rmc(time: str, date: str, status: str = "A") -> str:
    return f"GPRMC,{time},{status},3536.0,N,13942.0,E,0.0,,{date},,,{'A' if status == 'A' else 'N'}"


def test_date_is_carried_over_midnight(tmp_path: Path) -> None:
    log = read(tmp_path, gga("235958"), rmc("235959", "311225"), gga("000000.5"), gga("000001"))
    table = log.fix_table
    assert table.when.gps_ns.tolist() == [
        gps(2025, 12, 31, 23, 59, 58), gps(2025, 12, 31, 23, 59, 59),
        gps(2026, 1, 1, 0, 0, 0, micro=500_000), gps(2026, 1, 1, 0, 0, 1),
    ]  # fmt: skip


def test_date_after_midnight_reaches_back(tmp_path: Path) -> None:
    table = read(tmp_path, gga("235959"), gga("000000"), rmc("000001", "010126"), gga("000002")).fix_table
    assert table.when.gps_ns.tolist() == [gps(2026, 1, 1, 0, 0, 0) + n * 10**9 for n in range(-1, 3)]


def test_without_a_date_there_is_no_time(tmp_path: Path) -> None:
    log = read(tmp_path, gga("120000"), gga("120001"))
    assert log.fix_table.when.gps_ns.tolist() == [NO_TIME, NO_TIME]
    assert any("tell the date" in note for note in log.notes)


def test_date_without_a_fix_is_the_receivers_own(tmp_path: Path) -> None:
    log = read(
        tmp_path, rmc("000007", "060180", "V"), rmc("000008", "060180", "V"), rmc("120000", "050126"),
        rmc("120001", "050126", "V"),
    )  # fmt: skip
    now = gps(2026, 1, 5, 12, 0, 0)
    assert log.fix_table.when.gps_ns.tolist() == [NO_TIME, NO_TIME, now, now + 10**9]


def test_zda_tells_the_date_with_four_digits(tmp_path: Path) -> None:
    table = read(tmp_path, gga("120000"), "GPZDA,120000,05,01,2026,00,00").fix_table
    assert table.when.gps_ns.tolist() == [gps(2026, 1, 5, 12, 0, 0)]


def test_years_of_two_digits_and_roll_over(tmp_path: Path) -> None:
    """2019-04-07 and later are 1999-08-22 and later to firmware of that era; the tens of the year tell the century."""
    log = read(tmp_path, rmc("120000", "220899"))
    assert log.fix_table.when.gps_ns.tolist() == [gps(2019, 4, 7, 12, 0, 0) - 5 * 10**9]
    assert any("1024 weeks" in note for note in log.notes)
    log = read(tmp_path, rmc("120000", "080879"))
    assert log.fix_table.when.gps_ns.tolist() == [gps(2079, 8, 8, 12, 0, 0)]
    assert log.notes == ()


def test_leap_second(tmp_path: Path) -> None:
    table = read(tmp_path, rmc("235959", "311216"), rmc("235960", "311216"), rmc("000000", "010117")).fix_table
    assert np.diff(table.when.gps_ns).tolist() == [10**9, 10**9]
    assert table.when.gps_ns[2] == gps(2017, 1, 1, 0, 0, 0)


def test_sentence_without_a_time_changes_nothing(tmp_path: Path) -> None:
    table = read(tmp_path, rmc("120000", "050126"), "GNGGA,,,,,,0,00,99.99,,,,,,", "GNRMC,,V,,,,,,,,,,N").fix_table
    assert table.fix_type.tolist() == [FixType.UNKNOWN]
    assert table.latitude_deg.tolist() == [35.6]


def test_sentences_without_checksum_and_unix_line_ends(tmp_path: Path) -> None:
    bare = f"${rmc('120000', '050126')}\r\n${gga('120000')}\r\n".encode()
    log = read(tmp_path, bare)
    assert log.damage.lost_bytes == 0
    assert log.fix_table.when.gps_ns.tolist() == [gps(2026, 1, 5, 12, 0, 0)]
    unix = b"".join(made.nmea(text).replace(b"\r\n", b"\n") for text in (rmc("120000", "050126"), gga("120000")))
    log = read(tmp_path, unix)
    assert log.damage.lost_bytes == 0
    assert log.fix_table.height_geoid_m.tolist() == [36.2]


def test_wrong_checksum_is_lost(tmp_path: Path) -> None:
    good, bad = made.nmea(gga("120000")), made.nmea(gga("120001")).replace(b"36.2", b"36.3")
    log = read(tmp_path, good, bad, made.nmea(gga("120002")))
    assert len(log.fix_table) == 2
    assert log.damage.lost_bytes == len(bad)
    assert log.damage.spans[0].offset == len(good)
    assert "NMEA" in log.damage.spans[0].why


def test_proprietary_sentences_are_counted_only(tmp_path: Path) -> None:
    log = read(tmp_path, "PUBX,00,103607.00,5327.03942,N,00214.42462,W,104.461,G3,29,31", "PGGA,1,2,3", "GPGGA,1")
    assert log.message_counts == {"GPGGA": 1, "PGGA": 1, "PUBX": 1}
    assert len(log.fix_table) == 0
    assert "there are no positions in it" in log.notes


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    for data in (b"", b"$GPGGA,1*00\r\n", b"only text\r\n" * 50):
        with pytest.raises(InputError, match="receiver"):
            read(tmp_path, data)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.sampled_from(["GGA", "RMC", "GLL", "GNS", "ZDA", "GST", "VTG", "GSA"]), min_size=1), st.data())
def test_any_fields_are_read(tmp_path_factory: pytest.TempPathFactory, kinds: list[str], data: st.DataObject) -> None:
    """Intact sentences that tell nonsense."""
    field = st.sampled_from(
        ["", "A", "N", "E", "0", "1", "120000", "235960.99", "311299", "-1", "1e5", "999999999", "."]
    )
    path = tmp_path_factory.getbasetemp() / "nonsense.nmea"
    sentences = [",".join(["GP" + kind, *data.draw(st.lists(field, max_size=22))]) for kind in kinds]
    path.write_bytes(b"".join(made.nmea(text) for text in sentences))
    log = nmea.read_log(path, silent)
    assert log.damage.lost_bytes == 0
    list(log.fixes())
