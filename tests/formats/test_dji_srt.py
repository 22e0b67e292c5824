"""DJI's video subtitles."""

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
from uavkit.core.flight_log import FixType, FlightLog
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import silent
from uavkit.formats import dji_srt

DATA = Path(__file__).resolve().parents[2] / "../shared/data/logs/dji_srt"


def read(tmp_path: Path, data: str | bytes) -> FlightLog:
    path = tmp_path / "DJI_0001.SRT"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return dji_srt.read_log(path, silent)


def subtitle(number: int, text: str) -> str:
    begin, end = (f"00:{n // 60:02d}:{n % 60:02d},250" for n in (number, number + 1))
    return f"{number}\n{begin} --> {end}\n{text}\n\n"


def newer(number: int, fields: str = "") -> str:
    return subtitle(
        number,
        f'<font size="28">FrameCnt: {number}, DiffTime: 33ms\n2024-05-21 14:30:{number % 60:02d}.123\n'
        f"[iso: 100] [shutter: 1/2000.0] [focal_len: 24.00] [latitude: {36.123456 + number * 1e-6:.6f}] "
        f"[longitude: {-123.456789 + number * 1e-6:.6f}] [rel_alt: {50 + number}.500 abs_alt: {100 + number}.750] "
        f"{fields}</font>",
    )


def test_newer_subtitles(tmp_path: Path) -> None:
    log = read(
        tmp_path, newer(1) + newer(62, "[rtk_flag: 50, rtk_std_lon: 0.03, rtk_std_lat: 0.01, rtk_std_hgt: 0.04]")
    )
    table = log.fix_table
    assert table.when.boot_ns.tolist() == [1_250_000_000, 62_250_000_000]
    assert table.when.gps_ns.tolist() == [NO_TIME] * 2
    assert table.latitude_deg.tolist() == [36.123457, 36.123518]
    assert table.longitude_deg.tolist() == [-123.456788, -123.456727]
    assert table.height_above_home_m.tolist() == [51.5, 112.5]
    assert table.height_geoid_m.tolist() == [101.75, 162.75]
    assert np.all(np.isnan(table.height_ellipsoid_m))
    assert table.fix_type.tolist() == [FixType.UNKNOWN, FixType.RTK_FIXED]
    np.testing.assert_allclose(table.sigma_horizontal_m, [np.nan, np.sqrt((0.03**2 + 0.01**2) / 2)])
    np.testing.assert_array_equal(table.sigma_vertical_m, [np.nan, 0.04])
    assert "2024-05-21T14:30:01 to 2024-05-21T14:30:02" in " ".join(log.notes)
    assert len(list(log.fixes())) == 2
    assert log.damage.lost_bytes == 0


def test_older_subtitles_with_attitude(tmp_path: Path) -> None:
    text = (
        "F/5.6, SS 400, ISO 100, EV 0, GPS (-58.851745, -34.237922, 15), HOME (-58.847509, -34.232707, -57.98m), "
        "D 698.70m, H 85.80m, H.S 0.00m/s, V.S 0.00m/s, F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)"
    )
    log = read(tmp_path, "\ufeff" + subtitle(1, text))
    table, attitude = log.fix_table, log.attitude_table
    assert (table.longitude_deg[0], table.latitude_deg[0], table.satellites[0]) == (-58.851745, -34.237922, 15)
    assert table.height_above_home_m[0] == 85.80
    assert np.isnan(table.height_geoid_m[0])
    angles = [attitude.pitch_rad[0], attitude.roll_rad[0], attitude.yaw_rad[0]]
    np.testing.assert_allclose(np.degrees(angles), [2.7, -7.0, 110.1])
    assert attitude.when.boot_ns.tolist() == table.when.boot_ns.tolist() == [1_250_000_000]


def test_heights_above_home(tmp_path: Path) -> None:
    text = "HOME(149.0251,-20.2532) 2017.8.5 14:11:51\nGPS(149.0251,-20.2533,16) {} Hs:9.9\nISO:100 TV:60"
    log = read(tmp_path, subtitle(1, text.format("Hb:1.9")) + subtitle(2, text.format("BAROMETER:-3.5")))
    assert log.fix_table.height_above_home_m.tolist() == [1.9, -3.5]
    assert log.fix_table.longitude_deg.tolist() == [149.0251] * 2


def test_order_of_latitude_and_longitude(tmp_path: Path) -> None:
    log = read(tmp_path, subtitle(1, "GPS(36.6146,-6.1120,0.0M) BAROMETER:1.0"))
    assert (log.fix_table.latitude_deg[0], log.fix_table.longitude_deg[0]) == (36.6146, -6.1120)
    assert any("datum" in note for note in log.notes)
    log = read(tmp_path, subtitle(1, "GPS(-20.2,49.0,16)") + subtitle(2, "GPS(-20.2,149.0,16)"))  # latitude first
    assert log.fix_table.latitude_deg.tolist() == [-20.2, -20.2]
    assert log.fix_table.longitude_deg.tolist() == [49.0, 149.0]
    assert any("latitude first" in note for note in log.notes)


def test_no_fix_yet(tmp_path: Path) -> None:
    texts = (
        "[iso: 100] [latitude: 0.000000] [longitude: 0.000000] [rel_alt: 1.0 abs_alt: 2.0]",
        "GPS(0,0,0) BAROMETER:0.1",
        "GPS(n/a,n/a,0) BAROMETER:0.1",
        "ISO:100 Shutter:60",
        "[iso: 100] [latitude: 1.5] [longitude: 2.5]",
    )
    log = read(tmp_path, "".join(subtitle(n, text) for n, text in enumerate(texts)))
    assert np.isnan(log.fix_table.latitude_deg).tolist() == [True] * 4 + [False]
    assert log.fix_table.fix_type.tolist() == [FixType.NO_FIX] * 4 + [FixType.UNKNOWN]
    assert [fix.latitude_deg for fix in log.fixes()] == [1.5]
    assert log.message_counts == {"subtitle": 5, "subtitle without position": 4}


def test_damaged_subtitles_are_lost_bytes(tmp_path: Path) -> None:
    short = subtitle(2, "[iso: 100] [latitude: 36.123457] [longitude: -123.4")
    beyond = subtitle(4, "[iso: 100] [latitude: 136.123457] [longitude: -123.4]")
    film = subtitle(6, "Once upon a time")
    log = read(tmp_path, newer(1) + short + newer(3) + beyond + newer(5) + film)
    assert log.fix_table.when.boot_ns.tolist() == [1_250_000_000, 3_250_000_000, 5_250_000_000]
    assert log.damage.lost_bytes == sum(len(text) - 1 for text in (short, beyond, film))  # without the empty lines
    assert log.damage.spans[0].offset == len(newer(1))
    assert [span.why for span in log.damage.spans] == [
        "a position cut short", "no place on earth", "a subtitle without position and camera settings",
    ]  # fmt: skip


def test_only_its_own_kind_is_recognised() -> None:
    assert dji_srt.recognises(newer(1).encode())
    assert dji_srt.recognises(b"\0\0 1:2\n" + newer(1).encode())
    for other in (b"", subtitle(1, "Once upon a time").encode(), b"lat,lon\n1,2\n", b"<gpx>", b"GPS(1,2,3)", bytes(99)):
        assert not dji_srt.recognises(other)


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    for data in (b"", subtitle(1, "Once upon a time").encode(), bytes(100_000)):
        with pytest.raises(InputError, match=r"DJI_0001\.SRT: no subtitle of a DJI video"):
            read(tmp_path, data)
    with pytest.raises(InputError, match="cannot be read"):
        dji_srt.read_log(tmp_path / "none.SRT", silent)


real = pytest.mark.skipif(not DATA.is_dir(), reason="the collection of subtitles is not here")


@real
@pytest.mark.parametrize(
    ("name", "count", "first", "last_s", "attitudes"),
    [
        ("air2s.srt", 17, (41.424724, 2.234156), 0.533, 0),
        ("mavic_2_style.SRT", 468, (-20.2533, 149.0251), 468.0, 0),
        ("mix_p4rtk_mavic2pro.srt", 12, (-34.650200, -59.409424), 910.242, 6),
        ("old_format.SRT", 468, (-20.2533, 149.0251), 468.0, 0),
        ("p4_rtk.SRT", 55, (-34.237922, -58.851745), 54.0, 55),
    ],
)
def test_real_subtitles(
    name: str, count: int, first: tuple[float, float], last_s: float, attitudes: int, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (DATA / name).read_bytes()
    log = dji_srt.read_log(DATA / name, silent)
    assert dji_srt.recognises(data[:65536])
    assert len(log.fix_table) == count
    assert (log.fix_table.latitude_deg[0], log.fix_table.longitude_deg[0]) == first
    assert log.fix_table.when.boot_ns[-1] == round(last_s * 1e9)
    assert len(log.attitude_table) == attitudes
    assert log.damage.lost_bytes == 0
    assert capsys.readouterr() == ("", "")


@real
def test_broken_subtitles() -> None:
    log = dji_srt.read_log(DATA / "broken_incomplete.SRT", silent)
    data = (DATA / "broken_incomplete.SRT").read_bytes()
    assert len(log.fix_table) == data.count(b"GPS(") == 19
    cut = data.index(b"20\n00:00:20,000")
    assert (log.damage.lost_bytes, log.damage.spans[0].offset) == (len(data) - cut, cut)
    with pytest.raises(InputError, match="no subtitle"):
        dji_srt.read_log(DATA / "broken_empty.SRT", silent)


TEXTS = [newer(n) for n in range(1, 20)]
OLDER = [
    subtitle(n, f"HOME(149.0251,-20.2532) 2017.8.5 14:11:{n:02d}\nGPS(149.{n:04d},-20.2533,16) Hb:1.9\nISO:100 TV:60")
    for n in range(1, 25)
]


def check_damage(tmp_path: Path, seed: int) -> None:
    texts = TEXTS if seed % 2 else OLDER
    data = "".join(texts).encode()
    intact = read(tmp_path, data).fix_table
    harmed = damaged(data, np.random.default_rng(seed))
    log = read(tmp_path, harmed.data)
    table = log.fix_table
    rows = np.column_stack([table.when.boot_ns, table.latitude_deg, table.longitude_deg]).tolist()
    begins = np.cumsum([0, *(len(text) for text in texts)])
    for n in range(len(texts)):
        if harmed.moved(max(begins[n] - 1, 0), begins[n + 1]) is not None:  # line ends too
            row = [intact.when.boot_ns[n], intact.latitude_deg[n], intact.longitude_deg[n]]
            assert row in rows, (seed, harmed.kind)
    check_lost_bytes(harmed.data, log, partial(read, tmp_path), head=newer(1).encode())


def test_damage_at_random_places(tmp_path: Path) -> None:
    for seed in range(200):
        check_damage(tmp_path, seed)


@pytest.mark.slow
def test_damage_at_a_thousand_places(tmp_path: Path) -> None:
    for seed in range(200, 1000):
        check_damage(tmp_path, seed)


@settings(max_examples=150, deadline=None)
@given(
    data=st.one_of(
        st.binary(max_size=400),
        st.text(alphabet="0123456789.,[]()->: \nlatiudelongGPSHOMEF.RYM°", max_size=400),
        st.lists(
            st.sampled_from(
                ["[latitude: ", "[longitude: ", "]", "1.5", "GPS(", ",", ")", "\n", "00:00:01,000 --> 00:00:02,000\n"]
                + ["2017.8.5 14:11:51,9", "F.PRY (", "°", "1e400", "-", "H 1m", "[iso: 1]", "9999-99-99 99:00:00"]
            )
        ).map("".join),
    )
)
def test_no_bytes_give_anything_but_input_errors(tmp_path_factory: pytest.TempPathFactory, data: bytes | str) -> None:
    folder = tmp_path_factory.mktemp("srt")
    text = data if isinstance(data, bytes) else data.encode()
    for content in (text, newer(1).encode() + text + newer(2).encode()):
        dji_srt.recognises(content)
        with suppress(InputError):
            log = read(folder, content)
            list(log.fixes())
