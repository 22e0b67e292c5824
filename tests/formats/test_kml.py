"""Positions in KML and KMZ."""

import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uavkit.core.devices import GnssReceiver
from uavkit.core.errors import InputError
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.kml import KmlPositions, read_positions, write_positions

NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1)


def kml(body: str, namespace: str = 'xmlns="http://www.opengis.net/kml/2.2"') -> str:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<kml {namespace} xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"<Document>{body}</Document></kml>"
    )


def point(name: str, coordinates: str, mode: str = "") -> str:
    altitude = f"<altitudeMode>{mode}</altitudeMode>" if mode else ""
    place = f"<Point>{altitude}<coordinates>{coordinates}</coordinates></Point>"
    return f"<Placemark><name>{name}</name>{place}</Placemark>"


def write(tmp_path: Path, text: str, name: str = "way.kml") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "namespace",
    ['xmlns="http://www.opengis.net/kml/2.2"', 'xmlns="http://earth.google.com/kml/2.1"', ""],
)
def test_points_of_nested_folders_in_document_order(tmp_path: Path, namespace: str) -> None:
    body = (
        "<Folder><Folder>"
        + point("B", "139.65,35.8,120", "absolute")
        + "</Folder>"
        + point("A", " 139.66 , 35.81 , 50.5 ", "relativeToGround")
        + "</Folder>"
        + point("C", "139.67,35.82")
        + "<Placemark><LineString><coordinates>1,2,3 4,5,6</coordinates></LineString></Placemark>"
    )
    fixes = read_positions(write(tmp_path, kml(body, namespace)))
    assert [(f.name, f.longitude_deg, f.latitude_deg, f.height_m, f.height_datum) for f in fixes] == [
        ("B", 139.65, 35.8, 120.0, HeightDatum.GEOID),
        ("A", 139.66, 35.81, 50.5, HeightDatum.GROUND),
        ("C", 139.67, 35.82, 0.0, HeightDatum.GROUND),
    ]
    assert all(fix.gps_time_ns is None for fix in fixes)


def test_line_and_track(tmp_path: Path) -> None:
    line = "<altitudeMode>absolute</altitudeMode><coordinates>\n 1,2,3\n 4,5,6\n</coordinates>"
    fixes = read_positions(write(tmp_path, kml(f"<Placemark><LineString>{line}</LineString></Placemark>")))
    assert [(f.latitude_deg, f.longitude_deg, f.height_m) for f in fixes] == [(2, 1, 3), (5, 4, 6)]
    track = (
        "<altitudeMode>absolute</altitudeMode><when>2024-05-06T12:00:00Z</when><when>2024-05-06T21:00:01+09:00</when>"
        "<gx:coord>139 35 100</gx:coord><gx:coord>139.1 35.1 101</gx:coord>"
    )
    fixes = read_positions(write(tmp_path, kml(f"<Placemark><gx:Track>{track}</gx:Track></Placemark>")))
    noon_ns = gps_time_ns_from_utc(datetime(2024, 5, 6, 12, tzinfo=UTC))
    assert [f.gps_time_ns for f in fixes] == [noon_ns, noon_ns + 1_000_000_000]
    assert [f.height_datum for f in fixes] == [HeightDatum.GEOID] * 2


def test_kmz_and_override(tmp_path: Path) -> None:
    path = tmp_path / "way.kmz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("doc.kml", kml(point("A", "139,35,77", "absolute")))
    source = KmlPositions(path, override=HeightDatum.ELLIPSOID)
    assert isinstance(source, GnssReceiver)
    assert [(f.height_m, f.height_datum) for f in source.fixes()] == [(77.0, HeightDatum.ELLIPSOID)]
    assert [f.height_datum for f in KmlPositions(path).fixes()] == [HeightDatum.GEOID]


@pytest.mark.parametrize(
    "text, words",
    [
        (kml(point("W7", "35.8,139.65,10")), r"placemark 1 \('W7'\).*swapped"),
        (kml(point("W7", "1396500,358000,10")), "no place on earth"),
        (kml(point("W7", "139.65")), "not longitude,latitude,altitude"),
        (kml(point("W7", "139.65,nan,3")), "not longitude,latitude,altitude"),
        (kml(point("W7", "")), "there are 0"),
        (kml(""), "no point, track or line"),
        (kml("")[:-8], "no valid KML .*line 2"),
        ("", "no valid KML"),
        ('<!DOCTYPE kml [<!ENTITY a "aaaa">]><kml>&a;</kml>', "DTD"),
    ],
)
def test_errors_say_where(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=rf"way\.kml: .*{words}"):
        read_positions(write(tmp_path, text))


def test_damaged_kmz_and_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "way.kmz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("doc.kml", kml(point("A", "139,35,77")) * 20)
    content = bytearray(path.read_bytes())
    content[60:90] = bytes(30)
    path.write_bytes(content)
    packed = tmp_path / "packed.kmz"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml(point("A", "139,35,77")) * 20)
    content = bytearray(packed.read_bytes())
    content[60:90] = b"\xff" * 30
    packed.write_bytes(content)
    for bad in (path, packed, tmp_path / "absent.kml"):
        with pytest.raises(InputError, match=bad.name):
            read_positions(bad)


def test_an_unknown_encoding_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"way\.kml: no valid KML"):
        read_positions(write(tmp_path, kml(point("A", "139,35")).replace("UTF-8", "UTF-1")))


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, derandomize=True)
@given(
    st.lists(
        st.builds(
            GnssFix,
            gps_time_ns=st.none(),
            latitude_deg=st.floats(-89, 89),
            longitude_deg=st.floats(-179, 179),
            height_m=st.floats(-400, 9000),
            height_datum=st.sampled_from([HeightDatum.GEOID, HeightDatum.GROUND, HeightDatum.ELLIPSOID]),
            name=NAMES,
        ),
        min_size=1,
        max_size=5,
    )
)
def test_round_trip(tmp_path: Path, fixes: list[GnssFix]) -> None:
    write_positions(tmp_path / "out.kml", "stations", fixes)
    back = read_positions(tmp_path / "out.kml")
    assert [f.name for f in back] == [f.name for f in fixes]
    for one, two in zip(fixes, back, strict=True):
        assert two.latitude_deg == pytest.approx(one.latitude_deg, abs=1e-12)
        assert two.longitude_deg == pytest.approx(one.longitude_deg, abs=1e-12)
        if one.height_datum is HeightDatum.ELLIPSOID:
            undulation_m = float(geoid_undulation_m(np.array(one.latitude_deg), np.array(one.longitude_deg)))
            assert two.height_datum is HeightDatum.GEOID
            assert two.height_m == pytest.approx(one.height_m - undulation_m, abs=1e-6)
        else:
            assert two.height_datum is one.height_datum
            assert two.height_m == pytest.approx(one.height_m, abs=1e-9)
