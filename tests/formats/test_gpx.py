"""GPX, and XML of unknown origin."""

import resource
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.log_damage import damaged
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FixType, FlightLog
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import gpx, xml_records
from uavkit.formats.log_bytes import DamageTally

NOON_NS = gps_time_ns_from_utc(datetime(2024, 5, 6, 12, tzinfo=UTC))


def document(body: str, version: str = "1.1") -> str:
    number = version.replace(".", "/")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="{version}" creator="t" '
        f'xmlns="http://www.topografix.com/GPX/{number}">{body}</gpx>\n'
    )


def track(body: str) -> str:
    return document(f"<trk><name>t</name><trkseg>{body}</trkseg></trk>")


def point(number: int) -> str:
    return (
        f'<trkpt lat="{35.8 + number * 1e-5:.7f}" lon="{139.65 - number * 1e-5:.7f}"><ele>{50 + number}.25</ele>'
        f"<time>2024-05-06T12:{number // 60:02d}:{number % 60:02d}.500Z</time><sat>14</sat></trkpt>\n"
    )


def read(tmp_path: Path, data: str | bytes) -> FlightLog:
    path = tmp_path / "flight.gpx"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return gpx.read_log(path, silent)


def test_every_field_of_a_track(tmp_path: Path) -> None:
    body = (
        '<trkpt lat="35.8" lon="-139.65"><ele>50.5</ele><time>2024-05-06T12:00:01.25Z</time><geoidheight>38.25'
        "</geoidheight><fix>dgps</fix><sat>17</sat><hdop>0.7</hdop><course>90</course><speed>4</speed></trkpt>"
        '<trkpt lat="-35.8" lon="139.65"/>'
        '<trkpt lat="35.9" lon="139.7"><time>2024-05-06T21:00:02+09:00</time><fix>none</fix></trkpt>'
        '<trkpt lat="35.9" lon="139.7"><time>2024-05-06T12:00:03</time><fix>3d</fix></trkpt>'
        '<trkpt lat="35.9" lon="139.7"><time>2024-05-06</time></trkpt>'
        '<trkpt lat="35.9" lon="139.7"><time>6024-05-06T12:00:03Z</time></trkpt>'
    )
    log = read(tmp_path, track(body))
    table = log.fix_table
    assert table.when.gps_ns.tolist() == [
        NOON_NS + 1_250_000_000, NO_TIME, NOON_NS + 2_000_000_000, NOON_NS + 3_000_000_000, NO_TIME, NO_TIME,
    ]  # fmt: skip
    assert (table.latitude_deg[:2].tolist(), table.longitude_deg[:2].tolist()) == ([35.8, -35.8], [-139.65, 139.65])
    np.testing.assert_array_equal(table.height_geoid_m[:2], [50.5, np.nan])
    np.testing.assert_array_equal(table.height_ellipsoid_m[:2], [88.75, np.nan])  # the geoid lies above the ellipsoid
    np.testing.assert_allclose(table.velocity_m_s[0], [4.0, 0.0, np.nan], atol=1e-9)  # eastwards
    assert np.all(np.isnan(table.sigma_horizontal_m))
    assert table.fix_type.tolist() == [
        FixType.DIFFERENTIAL, FixType.UNKNOWN, FixType.NO_FIX, FixType.THREE_DIMENSIONAL, FixType.UNKNOWN,
        FixType.UNKNOWN,
    ]  # fmt: skip
    assert table.satellites.tolist() == [17, 255, 255, 255, 255, 255]
    assert log.damage.lost_bytes == 0
    assert log.message_counts == {"trkpt": 6, "trkseg": 1}


def test_waypoints_are_listed_exposures(tmp_path: Path) -> None:
    way = '<wpt lat="1" lon="2"><ele>3</ele><name>WP &amp; 1</name></wpt><wpt lat="4" lon="5"/>'
    route = '<rte><rtept lat="7" lon="8"><name>R</name></rtept></rte>'
    log = read(tmp_path, document(way + route, "1.0"))
    table = log.exposure_table
    assert (table.latitude_deg.tolist(), table.longitude_deg.tolist()) == ([1, 4], [2, 5])
    assert (table.name, table.kind.tolist()) == (("WP & 1", ""), [ExposureKind.LISTED] * 2)
    np.testing.assert_array_equal(table.height_geoid_m, [3, np.nan])
    assert table.when.gps_ns.tolist() == [NO_TIME] * 2
    assert any("routes are left out" in note for note in log.notes)
    assert read(tmp_path, document(route)).exposure_table.name == ("R",)


def test_segments(tmp_path: Path) -> None:
    log = read(tmp_path, track(point(1) + "</trkseg><trkseg>" + point(2)))
    assert len(log.fix_table) == 2
    assert any("2 segments" in note for note in log.notes)


def test_points_that_are_no_place_are_lost_bytes(tmp_path: Path) -> None:
    bad = '<trkpt lat="95.0" lon="1"><ele>1</ele></trkpt>'
    closed = '<trkpt lat="x" lon="1" />'
    text = track(point(1) + bad + closed + point(2))
    log = read(tmp_path, text)
    assert len(log.fix_table) == 2
    assert log.damage.lost_bytes == len(bad) + len(closed)
    assert log.damage.spans[0].offset == text.index(bad)
    with pytest.raises(InputError, match=r"flight\.gpx: no point .* latitude '95\.0', longitude '1' is no place"):
        read(tmp_path, track(bad))


def test_a_cut_file_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    text = track("".join(point(n) for n in range(100)))
    for more in (3, 40, 60, 80):  # within the begin tag, and within what it holds
        cut = text[: text.index(point(70)) + more]
        log = read(tmp_path, cut)
        assert len(log.fix_table) == 70
        assert (log.damage.lost_bytes, log.damage.spans[0].offset) == (more, len(cut) - more)
        assert any("not well-formed" in note for note in log.notes)


def test_a_point_without_its_end_does_not_take_the_next_with_it(tmp_path: Path) -> None:
    text = track(point(1) + point(2).replace("</trkpt>", "") + point(3) + point(4))
    log = read(tmp_path, text)
    assert log.fix_table.latitude_deg.tolist() == [35.80001, 35.80003, 35.80004]
    begin, end = text.index(point(2).replace("</trkpt>", "")), text.index(point(3))
    first, after = log.damage.spans
    assert (first.offset, first.length) == (begin, end - begin)
    assert text[after.offset :].startswith("</trkseg>")  # which fits no longer


def check_damage(tmp_path: Path, seed: int) -> None:
    points = [point(n) for n in range(100)]
    intact = track("".join(points)).encode()
    harmed = damaged(intact, np.random.default_rng(seed))
    log = read(tmp_path, harmed.data)
    found = list(zip(log.fix_table.when.gps_ns.tolist(), log.fix_table.latitude_deg.tolist(), strict=True))
    begin = intact.index(points[0].encode())
    for n, text in enumerate(points):
        if harmed.moved(begin, begin + len(text)) is not None:
            row = (NOON_NS + n * 1_000_000_000 + 500_000_000, float(f"{35.8 + n * 1e-5:.7f}"))
            assert row in found, (seed, harmed.kind, n)
        begin += len(text)
    assert log.damage.lost_bytes == sum(span.length for span in log.damage.spans)
    for span in log.damage.spans:  # no whole point is among what is lost
        part = harmed.data[span.offset : span.offset + span.length]
        with suppress(InputError):
            assert len(read(tmp_path, track("@").encode().replace(b"@", part)).fix_table) == 0, (seed, part)


def test_damage_at_random_places(tmp_path: Path) -> None:
    for seed in range(200):
        check_damage(tmp_path, seed)


@pytest.mark.slow
def test_damage_at_a_thousand_places(tmp_path: Path) -> None:
    for seed in range(200, 1000):
        check_damage(tmp_path, seed)


def test_entity_bombs_and_deep_nesting_are_refused(tmp_path: Path) -> None:
    lol = '<!DOCTYPE lolz [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;">]>'
    with pytest.raises(InputError, match=r"flight\.gpx: a document type declaration"):
        read(tmp_path, lol + track(point(1)))
    with pytest.raises(InputError, match="nested more than"):
        read(tmp_path, track("<a>" * 100_000))
    with pytest.raises(InputError, match="a tag of more than"):
        read(tmp_path, f'<gpx a="{"x" * 3_000_000}"/>')


class _Endless:
    """Much of the same, without holding it."""

    def __init__(self, begin: bytes, piece: bytes, count: int) -> None:
        self._next, self._piece, self._count = begin, piece, count

    def read(self, size: int) -> bytes:
        while len(self._next) < size and self._count:
            self._next, self._count = self._next + self._piece, self._count - 1
        part, self._next = self._next[:size], self._next[size:]
        return part


@pytest.mark.parametrize(
    ("begin", "piece", "message"),
    [
        (b"<gpx><trkpt><a>", b"x" * 100_000, "too large|more than"),
        (b"<gpx><wpt>", b"<a/>" * 10_000, "too large"),
        (b"<gpx>", b"y" * 1_000_000, "more than 256 MB"),
        (b"", bytes(1_000_000), "more than 256 MB"),
        (b"<gpx>", b"<trkpt" * 10_000, "more than 256 MB"),
        (b"<gpx>", b"<trkpt <" * 10_000, "more than 256 MB"),
    ],
)
def test_endless_documents_end_soon(begin: bytes, piece: bytes, message: str) -> None:
    reader = xml_records.XmlReader("big", gpx.KIND, DamageTally())
    began, before_kb = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=message):
        for _ in reader.records(_Endless(begin, piece, 400_000_000 // len(piece))):  # type: ignore[arg-type]
            pass
    assert time.monotonic() - began < 20
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 400_000


def test_only_its_own_kind_is_recognised() -> None:
    assert gpx.recognises(track(point(1)).encode())
    assert gpx.recognises(b"damage" + point(1).encode() * 3)
    assert gpx.recognises(track("").encode("utf-16"))
    for other in (
        b"",
        b"<kml><Placemark/></kml>",
        b"<html>gpx</html>",
        b"# reads <gpx> and <trkpt>\n",
        b"lat,lon\n1,2\n",
        bytes(99),
    ):
        assert not gpx.recognises(other)


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    for data in (b"", b"<gpx/>", b"hello", bytes(10_000)):
        with pytest.raises(InputError, match=r"flight\.gpx: no point"):
            read(tmp_path, data)


@settings(max_examples=150, deadline=None)
@given(
    data=st.one_of(
        st.binary(max_size=300),
        st.lists(
            st.sampled_from(
                ["<trkpt", "<wpt>", "</trkpt>", "<gpx>", "</gpx>", ' lat="1"', ' lon="2"', ">", "/>", "<", "&", "&amp;"]
                + ["<ele>", "</ele>", "<!--", "-->", "<![CDATA[", "]]>", "1e999", "<?xml encoding='ebcdic'?>", "é"]
                + ["<time>", "</time>", "9999-12-31T23:59:59-23:00", "0001-01-01T00:00:00Z"]
            ),
            max_size=40,
        ).map("".join),
    )
)
def test_no_bytes_give_anything_but_input_errors(tmp_path_factory: pytest.TempPathFactory, data: bytes | str) -> None:
    folder = tmp_path_factory.mktemp("gpx")
    text = data if isinstance(data, bytes) else data.encode()
    for content in (text, track(point(1)).encode() + text, track(point(1)).encode().replace(b"<ele>", text)):
        gpx.recognises(content)
        with suppress(InputError):
            log = read(folder, content)
            assert len(list(log.fixes())) <= len(log.fix_table)
