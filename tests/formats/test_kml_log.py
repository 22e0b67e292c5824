"""KML and KMZ as flight logs."""

import io
import struct
import time
import zipfile
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.formats.log_damage import damaged
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureKind, FlightLog
from uavkit.core.gpstime import NO_TIME, gps_time_ns_from_utc
from uavkit.core.progress import silent
from uavkit.formats import kml_document, kml_log
from uavkit.formats.kml import read_positions

NOON_NS = gps_time_ns_from_utc(datetime(2024, 5, 6, 12, tzinfo=UTC))


def kml(body: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2" '
        f'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>{body}</Document></kml>'
    )


def point(name: str, coordinates: str, mode: str = "absolute", more: str = "") -> str:
    place = f"<Point><altitudeMode>{mode}</altitudeMode><coordinates>{coordinates}</coordinates></Point>"
    return f"<Placemark><name>{name}</name>{more}{place}</Placemark>\n"


def read(tmp_path: Path, data: str | bytes, name: str = "way.kml") -> FlightLog:
    path = tmp_path / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return kml_log.read_log(path, silent)


def zipped(entries: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return stream.getvalue()


def test_waypoints_are_listed_exposures(tmp_path: Path) -> None:
    when = "<TimeStamp><when>2024-05-06T12:00:01Z</when></TimeStamp>"
    body = (
        "<Folder>"
        + point("WP &amp; 1", " 139.65 , 35.8 , 120.5 ", more=when)
        + "</Folder>"
        + point("2", "-139.66,-35.81,50", "relativeToGround")
        + point("3", "139.67,35.82", "clampToGround")
        + "<Placemark><LineString><coordinates>1,2,3 4,5,6</coordinates></LineString></Placemark>"
    )
    log = read(tmp_path, kml(body))
    table = log.exposure_table
    assert table.name == ("WP & 1", "2", "3")
    assert table.kind.tolist() == [ExposureKind.LISTED] * 3
    assert (table.latitude_deg.tolist(), table.longitude_deg.tolist()) == (
        [35.8, -35.81, 35.82],
        [139.65, -139.66, 139.67],
    )
    np.testing.assert_array_equal(table.height_geoid_m, [120.5, np.nan, np.nan])
    np.testing.assert_array_equal(table.height_above_home_m, [np.nan, 50.0, np.nan])
    assert np.all(np.isnan(table.height_ellipsoid_m))
    assert table.when.gps_ns.tolist() == [NOON_NS + 1_000_000_000, NO_TIME, NO_TIME]
    assert any("take-off" in note for note in log.notes)
    assert any("2 vertices of lines are left out" in note for note in log.notes)
    assert log.message_counts == {"Point": 3, "LineString": 1}
    assert len(log.fix_table) == 0


def test_track_with_times_and_angles(tmp_path: Path) -> None:
    track = (
        "<altitudeMode>absolute</altitudeMode><when>2024-05-06T12:00:00Z</when><when>2024-05-06T21:00:01+09:00</when>"
        "<when>2024-05-06T12:00:02.5Z</when><gx:coord>139 35 100</gx:coord><gx:coord>139.1 35.1 101</gx:coord>"
        "<gx:coord></gx:coord><gx:angles>90 10 -5</gx:angles><gx:angles></gx:angles><gx:angles>270 0 0</gx:angles>"
    )
    log = read(tmp_path, kml(f"<Placemark><gx:Track>{track}</gx:Track></Placemark>" + point("A", "1,2,3")))
    assert log.fix_table.when.gps_ns.tolist() == [NOON_NS, NOON_NS + 1_000_000_000]
    assert log.fix_table.longitude_deg.tolist() == [139, 139.1]
    assert log.fix_table.height_geoid_m.tolist() == [100, 101]
    attitude = log.attitude_table
    assert attitude.when.gps_ns.tolist() == [NOON_NS, NOON_NS + 2_500_000_000]
    np.testing.assert_allclose(np.degrees(attitude.yaw_rad), [90, 270])
    np.testing.assert_allclose(np.degrees(attitude.pitch_rad), [-10, 0])  # tilt lowers the nose
    np.testing.assert_allclose(np.degrees(attitude.roll_rad), [5, 0])
    assert log.exposure_table.name == ("A",)


def test_a_time_without_a_zone_is_none(tmp_path: Path) -> None:
    for text in ("2024-05-06T12:00:01", "2024-05-06", "2024", "soon", "6024-05-06T12:00:01Z"):
        log = read(tmp_path, kml(point("A", "1,2,3", more=f"<TimeStamp><when>{text}</when></TimeStamp>")))
        assert log.exposure_table.when.gps_ns.tolist() == [NO_TIME]


def test_a_track_whose_times_do_not_fit_has_none(tmp_path: Path) -> None:
    track = "<when>2024-05-06T12:00:00Z</when><gx:coord>139 35 100</gx:coord><gx:coord>139.1 35.1 101</gx:coord>"
    log = read(tmp_path, kml(f"<Placemark><gx:Track>{track}</gx:Track></Placemark>"))
    assert log.fix_table.when.gps_ns.tolist() == [NO_TIME] * 2
    assert any("1 times for 2 positions" in note for note in log.notes)


def test_vertices_of_a_line_alone(tmp_path: Path) -> None:
    line = "<altitudeMode>absolute</altitudeMode><coordinates>\n 1,2,3\n 4,5,6\n</coordinates>"
    log = read(tmp_path, kml(f"<Placemark><LineString>{line}</LineString></Placemark>"))
    assert (log.exposure_table.latitude_deg.tolist(), log.exposure_table.height_geoid_m.tolist()) == ([2, 5], [3, 6])
    assert log.exposure_table.name == ("1", "2")


def test_the_same_positions_as_the_reader_of_positions(tmp_path: Path) -> None:
    log = read(tmp_path, kml("".join(point(f"{n}", f"{139 + n / 7},{35 - n / 9},{n / 3}") for n in range(33))))
    others = read_positions(tmp_path / "way.kml")
    mine = [event.position for event in log.exposures()]
    assert [(p.latitude_deg, p.longitude_deg, p.height_m, p.height_datum, p.name) for p in mine if p] == [
        (p.latitude_deg, p.longitude_deg, p.height_m, p.height_datum, p.name) for p in others
    ]


def test_kmz(tmp_path: Path) -> None:
    document = kml(point("A", "1,2,3")).encode()
    data = zipped({"doc.kml": document, "files/other.kml": kml(point("B", "4,5,6")).encode()})
    assert kml_log.recognises(data)
    assert not kml_log.recognises(zipped({"a.docx": document}))
    assert read(tmp_path, data, "way.kmz").exposure_table.name == ("A",)
    with pytest.raises(InputError, match=r"way\.kmz: this KMZ holds no \.kml"):
        read(tmp_path, zipped({"a.txt": b""}), "way.kmz")
    for cut in (10, len(data) // 2, len(data) - 5):
        with pytest.raises(InputError, match=r"way\.kmz: the KMZ is damaged"):
            read(tmp_path, data[:cut], "way.kmz")


def test_zip_bombs_end_soon(tmp_path: Path) -> None:
    data = bytearray(zipped({"doc.kml": b"<kml>" + b" " * 270_000_000}))
    for told in (270_000_005, 1000):  # the second is a lie
        at = data.rindex(b"PK\x01\x02") + 24
        data[at : at + 4] = struct.pack("<I", told)
        began = time.monotonic()
        with pytest.raises(InputError, match=r"bomb\.kmz"):
            read(tmp_path, bytes(data), "bomb.kmz")
        with pytest.raises(InputError, match=r"bomb\.kmz"):
            read_positions(tmp_path / "bomb.kmz")
        assert time.monotonic() - began < 20


def test_no_more_is_unpacked_than_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    class Stream(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            sizes.append(-1 if size is None else size)
            return super().read(size)

    monkeypatch.setattr(kml_document, "_LARGEST_HELD_BYTES", 1000)
    with pytest.raises(InputError, match="more than 1000 bytes"):
        kml_document._bounded(tmp_path, Stream(bytes(2000)))
    assert sizes == [1001]


def test_entity_bombs_and_deep_nesting_are_refused(tmp_path: Path) -> None:
    for text, message in (
        ('<!DOCTYPE kml [<!ENTITY a "aaaa">]>' + kml(point("&a;", "1,2,3")), "DTD"),
        (kml("<Folder>" * 10_000), "nested more than"),
    ):
        with pytest.raises(InputError, match=message):
            read(tmp_path, text)
    with pytest.raises(InputError, match="deep"):
        read_positions(tmp_path / "way.kml")


def test_a_long_line_is_read_within_seconds(tmp_path: Path) -> None:
    began = time.monotonic()
    line = "139.1234567,35.1234567,100.12\n" * 300_000
    log = read(tmp_path, kml(f"<Placemark><LineString><coordinates>{line}</coordinates></LineString></Placemark>"))
    assert len(log.exposure_table) == 300_000
    assert time.monotonic() - began < 20


def test_placemarks_without_a_place_are_lost_bytes(tmp_path: Path) -> None:
    swapped = point("S", "35.8,139.65,1").rstrip()
    text = kml(point("A", "1,2,3") + swapped + point("B", "4,5,6"))
    log = read(tmp_path, text)
    assert log.exposure_table.name == ("A", "B")
    assert (log.damage.lost_bytes, log.damage.spans[0].offset) == (len(swapped), text.index(swapped))
    with pytest.raises(InputError, match=r"way\.kml: no point.*'S'.*longitude,latitude"):
        read(tmp_path, kml(swapped))


def check_damage(tmp_path: Path, seed: int) -> None:
    marks = [point(f"W{n}", f"{139 + n * 1e-4:.6f},{35 - n * 1e-4:.6f},{n}") for n in range(120)]
    intact = kml("".join(marks)).encode()
    harmed = damaged(intact, np.random.default_rng(seed))
    log = read(tmp_path, harmed.data)
    table = log.exposure_table
    found = set(zip(table.name, table.longitude_deg.tolist(), table.height_geoid_m.tolist(), strict=True))
    begin = intact.index(marks[0].encode())
    for n, text in enumerate(marks):
        if harmed.moved(begin, begin + len(text)) is not None:
            assert (f"W{n}", float(f"{139 + n * 1e-4:.6f}"), n) in found, (seed, harmed.kind, n)
        begin += len(text)
    assert log.damage.lost_bytes == sum(span.length for span in log.damage.spans)


def test_damage_at_random_places(tmp_path: Path) -> None:
    for seed in range(200):
        check_damage(tmp_path, seed)


@pytest.mark.slow
def test_damage_at_a_thousand_places(tmp_path: Path) -> None:
    for seed in range(200, 1000):
        check_damage(tmp_path, seed)


def test_only_its_own_kind_is_recognised() -> None:
    assert kml_log.recognises(kml("").encode())
    assert kml_log.recognises(kml("").encode("utf-16"))
    for other in (b"", b"<gpx><trkpt/></gpx>", b"<html>kml</html>", b"PK\x03\x04", b"a,b\n1,2\n", bytes(99)):
        assert not kml_log.recognises(other)


def test_nothing_of_use_is_an_error(tmp_path: Path) -> None:
    for data in (b"", b"<kml/>", b"hello", bytes(10_000), kml("<Placemark><Polygon/></Placemark>").encode()):
        with pytest.raises(InputError, match=r"way\.kml: no point, track or line"):
            read(tmp_path, data)


PIECES = (
    ["<Placemark>", "</Placemark>", "<Point>", "</Point>", "<coordinates>", "</coordinates>", "1,2,3", "1e999,", "&x;"]
    + ["<gx:Track>", "</gx:Track>", "<gx:coord>", "</gx:coord>", "<when>", "</when>", "<gx:angles>", "<", ">", "<!--"]
    + ["<LineString>", "</LineString>", "0001-01-01T00:00:00+23:00", "<altitudeMode>absolute</altitudeMode>", "é"]
)


@settings(max_examples=150, deadline=None)
@given(data=st.one_of(st.binary(max_size=300), st.lists(st.sampled_from(PIECES), max_size=40).map("".join)))
def test_no_bytes_give_anything_but_input_errors(tmp_path_factory: pytest.TempPathFactory, data: bytes | str) -> None:
    folder = tmp_path_factory.mktemp("kml")
    text = data if isinstance(data, bytes) else data.encode()
    archive = zipped({"doc.kml": kml(point("A", "1,2,3")).encode()})
    for content in (
        text,
        kml("@").encode().replace(b"@", text),
        b"PK\x03\x04" + text,
        archive[:40] + text + archive[60:],
    ):
        kml_log.recognises(content)
        with suppress(InputError):
            log = read(folder, content)
            assert len(list(log.exposures())) == len(log.exposure_table)
