"""Areas from KML, KMZ, GeoJSON, shapefiles and WKT."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapefile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.core.flightplan import AreaKind, SurveyArea
from uavkit.formats.area_file import inline_areas, read_areas
from uavkit.formats.plan_request import InlineArea

SQUARE = [(139.0, 35.0), (139.01, 35.0), (139.01, 35.01), (139.0, 35.01)]
"""Longitude, latitude."""
HOLE = [(139.002, 35.002), (139.004, 35.002), (139.004, 35.004), (139.002, 35.004)]
OTHER_HOLE = [(139.006, 35.006), (139.008, 35.006), (139.008, 35.008), (139.006, 35.008)]
LINE = [(139.0, 35.0), (139.005, 35.002), (139.01, 35.0)]

Ring = list[tuple[float, float]]


def latitude_longitude(ring: Ring) -> np.ndarray:
    return np.array(ring)[:, ::-1]


def closed(ring: Ring) -> Ring:
    return [*ring, ring[0]]


def kml_ring(ring: Ring, kind: str) -> str:
    text = " ".join(f"{x!r},{y!r},12.5" for x, y in closed(ring))
    return f"<{kind}><LinearRing><coordinates>\n{text}\n</coordinates></LinearRing></{kind}>"


def kml_polygon(*rings: Ring) -> str:
    inner = "".join(kml_ring(ring, "innerBoundaryIs") for ring in rings[1:])
    return f"<Polygon>{kml_ring(rings[0], 'outerBoundaryIs')}{inner}</Polygon>"


def kml_line(kind: str, ring: Ring) -> str:
    return f"<{kind}><coordinates>{' '.join(f'{x!r},{y!r}' for x, y in ring)}</coordinates></{kind}>"


def kml(*placemarks: tuple[str, str]) -> str:
    marks = "".join(f"<Placemark><name>{name}</name>{geometry}</Placemark>" for name, geometry in placemarks)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>'
        f"<name>outer</name><Folder><name>inner</name>{marks}</Folder></Folder></Document></kml>"
    )


def wkt_polygon(*rings: Ring) -> str:
    return f"POLYGON ({', '.join(wkt_ring(closed(ring)) for ring in rings)})"


def wkt_ring(ring: Ring) -> str:
    return "(" + ", ".join(f"{x!r} {y!r}" for x, y in ring) + ")"


def geojson_polygon(*rings: Ring) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": [[[x, y, 7.0] for x, y in closed(ring)] for ring in rings]}


def feature(geometry: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def collection(*features: Any, **members: Any) -> str:
    return json.dumps({"type": "FeatureCollection", "features": features, **members})


def write(tmp_path: Path, content: str | bytes, name: str) -> Path:
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_shapefile(path: Path, polygons: list[tuple[str, list[Ring]]], crs: str = "", to_crs: Any = None) -> Path:
    """Write polygons whose first ring is the outline; rings are turned as the format demands."""
    with shapefile.Writer(str(path), shapeType=shapefile.POLYGON) as writer:
        writer.field("NAME", "C", 40)
        for name, rings in polygons:
            turned = [closed(rings[0])[::-1], *(closed(ring) for ring in rings[1:])]
            writer.poly([[to_crs(*v) if to_crs else v for v in ring] for ring in turned])
            writer.record(name)
    if crs:
        path.with_suffix(".prj").write_text(pyproj.CRS.from_user_input(crs).to_wkt("WKT1_ESRI"))
    return path


def assert_same(area: SurveyArea, ring: Ring, *holes: Ring, atol: float = 0.0) -> None:
    """Compare vertices in any sense of rotation and from any first vertex."""
    pairs = [(area.latitude_longitude_deg, ring), *zip(area.holes_deg, holes, strict=True)]
    for found, expected in pairs:
        assert found.shape == (len(expected), 2)
        turns = [
            np.roll(latitude_longitude(expected)[::sense], k, axis=0) for sense in (1, -1) for k in range(len(ring))
        ]
        assert min(float(np.abs(found - turn).max()) for turn in turns) <= atol


# What each format gives


def test_kml_polygons_with_holes_lines_and_points_in_nested_folders(tmp_path: Path) -> None:
    multi = f"<MultiGeometry>{kml_polygon(SQUARE)}<MultiGeometry>{kml_polygon(HOLE)}</MultiGeometry></MultiGeometry>"
    content = kml(
        ("field", kml_polygon(SQUARE, HOLE, OTHER_HOLE)),
        ("road", kml_line("LineString", LINE)),
        ("mast", kml_line("Point", LINE[:1])),
        ("two parts", multi),
    )
    field, road, mast, first, second = read_areas(write(tmp_path, content, "areas.kml"))
    assert [a.name for a in (field, road, mast)] == ["field", "road", "mast"]
    assert_same(field, SQUARE, HOLE, OTHER_HOLE)
    np.testing.assert_array_equal(field.latitude_longitude_deg, latitude_longitude(SQUARE))  # not turned either
    assert (road.kind, mast.kind) == (AreaKind.LINE, AreaKind.POINT)
    np.testing.assert_array_equal(road.latitude_longitude_deg, latitude_longitude(LINE))
    np.testing.assert_array_equal(mast.latitude_longitude_deg, [[35.0, 139.0]])
    assert (first.name, second.name) == ("two parts", "two parts (2)")
    assert_same(first, SQUARE)
    assert_same(second, HOLE)


def test_kmz_and_any_suffix(tmp_path: Path) -> None:
    path = tmp_path / "areas.bin"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml(("field", kml_polygon(SQUARE))))
    (area,) = read_areas(path)
    assert_same(area, SQUARE)


def test_geojson_of_every_kind(tmp_path: Path) -> None:
    polygon = geojson_polygon(SQUARE, HOLE)
    content = collection(
        feature(polygon, Name="field"),
        feature(None, name="nowhere"),
        feature({"type": "MultiPolygon", "coordinates": [polygon["coordinates"], polygon["coordinates"]]}),
        feature({"type": "LineString", "coordinates": LINE}, title="road"),
        feature({"type": "MultiPoint", "coordinates": LINE}, name=7),
        feature({"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [139.0, 35.0]}]}),
        crs={"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
    )
    areas = read_areas(write(tmp_path, content, "areas.geojson"))
    assert [a.name for a in areas] == ["field", "area 2", "area 3", "road", "7", "7 (2)", "7 (3)", "area 8"]
    for area in areas[:3]:
        assert_same(area, SQUARE, HOLE)
    np.testing.assert_array_equal(areas[5].latitude_longitude_deg, [[35.002, 139.005]])


def test_a_bare_geojson_geometry(tmp_path: Path) -> None:
    (area,) = read_areas(write(tmp_path, json.dumps(geojson_polygon(SQUARE)), "area.json"))
    assert area.name == "area 1"
    assert_same(area, SQUARE)


@pytest.mark.parametrize("crs", ["", "EPSG:4326"])
def test_a_shapefile_in_degrees(tmp_path: Path, crs: str) -> None:
    path = write_shapefile(tmp_path / "areas.shp", [("field", [SQUARE, HOLE, OTHER_HOLE]), ("", [HOLE])], crs)
    first, second = read_areas(path)
    assert (first.name, second.name) == ("field", "area 2")
    assert_same(first, SQUARE, HOLE, OTHER_HOLE)
    assert_same(second, HOLE)


def test_a_shapefile_in_another_system_is_transformed(tmp_path: Path) -> None:
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32654", always_xy=True).transform
    path = write_shapefile(tmp_path / "areas.shp", [("field", [SQUARE, HOLE])], "EPSG:32654", to_utm)
    (area,) = read_areas(path)
    assert_same(area, SQUARE, HOLE, atol=1e-9)
    path.with_suffix(".prj").unlink()
    with pytest.raises(InputError, match=r"areas\.shp: shape 1 \('field'\): .* is no longitude, latitude.*\.prj"):
        read_areas(path)
    path.with_suffix(".prj").write_text("NONSENSE")
    with pytest.raises(InputError, match=r"areas\.prj: 'NONSENSE' is no coordinate reference system"):
        read_areas(path)


def test_a_shapefile_with_two_outlines_puts_the_hole_where_it_belongs(tmp_path: Path) -> None:
    far = [(x + 1.0, y) for x, y in SQUARE]
    path = tmp_path / "multi.shp"
    with shapefile.Writer(str(path), shapeType=shapefile.POLYGON) as writer:
        writer.field("ID", "N")
        writer.poly([closed(far)[::-1], closed(SQUARE)[::-1], closed(HOLE)])
        writer.record(1)
    first, second = read_areas(path)
    assert_same(first, far)
    assert_same(second, SQUARE, HOLE)


@pytest.mark.parametrize(
    "cpg, codec", [("UTF-8", "utf-8"), ("ISO-8859-1", "latin-1"), ("1252", "cp1252"), ("", "utf-8")]
)
def test_names_in_the_encoding_that_the_shapefile_states(tmp_path: Path, cpg: str, codec: str) -> None:
    path = tmp_path / "a.shp"
    with shapefile.Writer(str(path), shapeType=shapefile.POINT, encoding=codec) as writer:
        writer.field("NAME", "C", 40)
        writer.point(139.0, 35.0)
        writer.record("Böschung")
    path.with_suffix(".cpg").write_text(cpg)
    assert read_areas(path)[0].name == "Böschung"


def test_shapefile_lines_points_and_heights(tmp_path: Path) -> None:
    with shapefile.Writer(str(tmp_path / "l.shp"), shapeType=shapefile.POLYLINEZ) as writer:
        writer.field("ID", "N")
        writer.linez([[(*vertex, 100.0) for vertex in LINE], [(*vertex, 5.0) for vertex in HOLE]])
        writer.record(1)
    one, two = read_areas(tmp_path / "l.shp")
    assert one.kind is two.kind is AreaKind.LINE
    np.testing.assert_array_equal(one.latitude_longitude_deg, latitude_longitude(LINE))
    with shapefile.Writer(str(tmp_path / "p.shp"), shapeType=shapefile.POINT) as writer:
        writer.field("ID", "N")
        writer.point(139.0, 35.0)
        writer.record(1)
        writer.null()
        writer.record(2)
    (mast,) = read_areas(tmp_path / "p.shp")
    np.testing.assert_array_equal(mast.latitude_longitude_deg, [[35.0, 139.0]])


def test_wkt_with_and_without_srid(tmp_path: Path) -> None:
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32654", always_xy=True).transform
    in_utm = wkt_polygon([to_utm(*v) for v in SQUARE], [to_utm(*v) for v in HOLE])
    content = (
        f"# two fields and a road\n{wkt_polygon(SQUARE, HOLE)}\nsrid=4326; polygon z ((139 35 1, 139.01 35 2, "
        f"139 35.01 3, 139 35 1))\nSRID=32654;{in_utm}\nMULTILINESTRING ({wkt_ring(LINE)}, {wkt_ring(HOLE)});"
        " POINT (139 35)\n"
    )
    areas = read_areas(write(tmp_path, content, "areas.wkt"))
    assert [a.name for a in areas] == [f"area {n}" for n in range(1, 7)]
    assert_same(areas[0], SQUARE, HOLE)
    assert_same(areas[1], [(139.0, 35.0), (139.01, 35.0), (139.0, 35.01)])
    assert_same(areas[2], SQUARE, HOLE, atol=1e-9)
    assert [a.kind for a in areas[3:]] == [AreaKind.LINE, AreaKind.LINE, AreaKind.POINT]


def test_every_area_has_a_name_of_its_own(tmp_path: Path) -> None:
    names = ["a", "a (2)", "a", "", "a", "area 4", "area 4"]
    features = [feature(geojson_polygon(SQUARE), name=name) for name in names]
    found = [area.name for area in read_areas(write(tmp_path, collection(*features), "a.json"))]
    assert found == ["a", "a (2)", "a (3)", "area 4", "a (4)", "area 4 (2)", "area 4 (3)"]


def test_repeated_vertices_are_dropped_the_outline_stays(tmp_path: Path) -> None:
    ring = [SQUARE[0], SQUARE[0], SQUARE[1], SQUARE[2], SQUARE[2], SQUARE[3], SQUARE[0]]
    (area,) = read_areas(write(tmp_path, wkt_polygon(ring), "a.wkt"))
    np.testing.assert_array_equal(area.latitude_longitude_deg, latitude_longitude(SQUARE))
    (line,) = read_areas(write(tmp_path, f"LINESTRING {wkt_ring([*LINE, LINE[-1]])}", "l.wkt"))
    np.testing.assert_array_equal(line.latitude_longitude_deg, latitude_longitude(LINE))


# What is refused, and how

BOW_TIE = [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]
LONG_POLE = [(10.0, 86.0), (10.5, 86.0), (10.0, 86.1)]


@pytest.mark.parametrize(
    "rings, words",
    [
        ([BOW_TIE], r"the outline crosses or touches itself at latitude 35\.005000, longitude 139\.005000: move"),
        (
            [SQUARE, [(x + 1.0, y) for x, y in HOLE]],
            r"hole 1 lies outside the outline at latitude 35\.003000, longitude 1",
        ),
        ([SQUARE, [(x + 0.007, y) for x, y in HOLE]], r"hole 1 lies outside .* longitude 139\.01"),
        (
            [SQUARE, HOLE, [(x + 0.001, y) for x, y in HOLE]],
            r"holes 1 and 2 overlap at latitude 35\.003000, longitude 139\.",
        ),
        ([SQUARE, HOLE, HOLE], r"holes 1 and 2 overlap"),
        ([SQUARE, BOW_TIE], r"hole 1 crosses or touches itself at latitude 35\.005"),
        ([SQUARE, [SQUARE[0], SQUARE[1], HOLE[2]]], r"the holes and the outline touch at latitude 35\.0000"),
        ([SQUARE[:2]], r"the outline has 2 different vertices"),
        ([SQUARE[:1]], r"the outline has 1 different vertices"),
        ([[SQUARE[0], SQUARE[1], SQUARE[0]]], r"the outline has 2 different vertices"),
        ([[(139.0, 35.0), (139.01, 35.01), (139.02, 35.02)]], r"no area: its vertices lie on a line, near latitude 35"),
        (
            [[(35.0, 139.0), (35.01, 139.0), (35.0, 139.01)]],
            r"vertex 1: .* no place on earth: latitude and longitude are sw",
        ),
        ([[(200.0, 35.0), (201.0, 35.0), (200.0, 36.0)]], r"no place on earth: .*antimeridian"),
        ([[(179.9, 5.0), (-179.9, 5.0), (-179.9, 5.1)]], r"across the antimeridian is not supported"),
        ([LONG_POLE], r"latitude 86\.000000, longitude 10\.000000 is too near to the pole"),
        ([[(float("nan"), 35.0), *SQUARE]], r"vertex 1: .* is not finite"),
        ([[(float("inf"), 35.0), *SQUARE]], r"vertex 1: .* is not finite"),
    ],
)
@pytest.mark.parametrize("name", ["a.kml", "a.json"])
def test_impossible_polygons(tmp_path: Path, rings: list[Ring], words: str, name: str) -> None:
    good, bad = [[(x, y - 1.0) for x, y in SQUARE]], rings
    text = (
        kml(("good", kml_polygon(*good)), ("bad one", kml_polygon(*bad)))
        if name == "a.kml"
        else collection(feature(geojson_polygon(*good), name="good"), feature(geojson_polygon(*bad), name="bad one"))
    )
    with pytest.raises(InputError, match=rf"a\.\w+: area 2 \('bad one'\).*{words}"):
        read_areas(write(tmp_path, text, name))


@pytest.mark.parametrize(
    "content, words",
    [
        ("", "the file is empty"),
        ("  \n", "the file is empty"),
        ("hello", "neither KML"),
        ("<kml></kml>", "no polygon, line or point"),
        ("<kml", "no valid KML"),
        ('<!DOCTYPE kml [<!ENTITY a "b">]><kml>&a;</kml>', "DTD"),
        (kml(("x", "<Polygon></Polygon>")), r"placemark 1 \('x'\): a polygon has one outer boundary, here are 0"),
        (kml(("x", kml_line("Point", []))), "a point has one position, here are 0"),
        (kml(("x", "<LineString><coordinates>139 35</coordinates></LineString>")), r"vertex 1: '139' is not longitude"),
        (kml(("x", kml_line("LineString", LINE[:1] * 2))), "a line needs 2 different vertices, at latitude 35"),
        ("{", "no valid GeoJSON"),
        ("[" * 100_000, "no valid GeoJSON"),
        ("[]", "GeoJSON is an object"),
        ('{"type": "Topology"}', "'Topology' is no geometry"),
        ('{"type": "FeatureCollection"}', "no list of features"),
        ('{"type": "Polygon", "coordinates": 3}', "'3' stands where a list"),
        ('{"type": "Point", "coordinates": [true, 1]}', "is not longitude, latitude"),
        ('{"type": "Point", "coordinates": [1' + 400 * "0" + ", 1]}", "is not longitude, latitude"),
        ('{"type": "Polygon", "coordinates": []}', "has 0 different vertices"),
        (collection(crs={"type": "name", "properties": {"name": "EPSG:32654"}}), "this one is in 'EPSG:32654'"),
        (collection(crs={"type": "link"}), "WGS 84"),
        ("POLYGON ((0 0, 1 1", "its brackets do not close"),
        ("POLYGON ((0 0, 1 x, 2 2, 0 0))", "geometry 1: no valid WKT"),
        ("POINT (1 2) nonsense", "'nonsense' is no WKT"),
        ("POLYGON EMPTY", "has 0 different vertices"),
        ("POINT (380000 3900000)", "write SRID=32654"),
        ("SRID=99999;POINT (1 2)", "SRID=99999: .* no coordinate reference system"),
        ("GEOMETRYCOLLECTION (" * 50_000, "its brackets do not close"),
        (b"POINT (1 2) \xff\xfe", "not UTF-8"),
        (b"\x00\x00\x27\x0a" + bytes(30), "the shapefile is damaged"),
        (b"PK\x03\x04" + bytes(40), "damaged|no valid KML"),
    ],
)
def test_what_is_no_area_is_refused(tmp_path: Path, content: str | bytes, words: str) -> None:
    with pytest.raises(InputError, match=rf"area\.any: .*({words})"):
        read_areas(write(tmp_path, content, "area.any"))


def test_missing_file_folder_and_companions(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.kml", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_areas(path)
    path = write_shapefile(tmp_path / "areas.shp", [("field", [SQUARE])])
    with pytest.raises(InputError, match=r"areas\.dbf: .* give areas\.shp"):
        read_areas(path.with_suffix(".dbf"))
    packed = tmp_path / "areas.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        archive.write(path, "areas.shp")
    with pytest.raises(InputError, match="packed shapefile: unpack it"):
        read_areas(packed)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.kmz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("doc.kml", "w") as member:
        for _ in range(257):
            member.write(bytes(1024 * 1024))
    with pytest.raises(InputError, match=r"bomb\.kmz: .*would unpack"):
        read_areas(path)


# Areas in the request


def test_inline_areas_are_checked_as_those_of_files() -> None:
    ring = [(y, x) for x, y in SQUARE]
    hole = [(y, x) for x, y in HOLE]
    given_areas = [
        InlineArea(latitude_longitude_deg=ring, holes_deg=[hole]),
        InlineArea(kind="line", latitude_longitude_deg=ring[:2]),
        InlineArea(name="mast", kind="point", latitude_longitude_deg=ring[:1]),
    ]
    field, road, mast = inline_areas(given_areas)
    assert (field.name, road.name, mast.name) == ("area", "area (2)", "mast")
    assert_same(field, SQUARE, HOLE)
    assert (road.kind, mast.kind) == (AreaKind.LINE, AreaKind.POINT)


@pytest.mark.parametrize(
    "area, words",
    [
        (InlineArea(kind="point", latitude_longitude_deg=[(35.0, 139.0), (35.0, 139.1)]), "a point has one position"),
        (InlineArea(kind="line", latitude_longitude_deg=[(35.0, 139.0)]), "a line needs 2 different vertices"),
        (InlineArea(latitude_longitude_deg=[(139.0, 35.0), (139.0, 35.1), (139.1, 35.0)]), "are swapped"),
        (
            InlineArea(kind="line", latitude_longitude_deg=[(1.0, 2.0), (3.0, 4.0)], holes_deg=[[(1.0, 2.0)]]),
            "a line has no holes",
        ),
    ],
)
def test_impossible_inline_areas(area: InlineArea, words: str) -> None:
    with pytest.raises(InputError, match=rf"the request: area 1 \('area'\).*{words}"):
        inline_areas([area])


# Damaged files


def _documents(folder: Path) -> list[bytes]:
    shape = write_shapefile(folder / "seed.shp", [("field", [SQUARE, HOLE])])
    packed = folder / "seed.kmz"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml(("field", kml_polygon(SQUARE, HOLE))))
    return [
        kml(("field", kml_polygon(SQUARE, HOLE)), ("road", kml_line("LineString", LINE))).encode(),
        collection(feature(geojson_polygon(SQUARE, HOLE), name="field")).encode(),
        f"SRID=32654;{wkt_polygon(SQUARE, HOLE)}\nMULTIPOINT (1 2, 3 4)".encode(),
        shape.read_bytes(),
        packed.read_bytes(),
    ]


def _areas_or_input_error(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    try:
        areas = read_areas(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 - both ends are good ones
    else:
        assert areas
        assert all(np.all(np.abs(area.latitude_longitude_deg) <= [85.0, 180.0]) for area in areas)


FUZZ = settings(max_examples=250, suppress_health_check=list(HealthCheck), deadline=None, derandomize=True)


@FUZZ
@given(st.binary(max_size=200), st.sampled_from([b"", b"<kml>", b"{", b"POINT (", b"\x00\x00\x27\x0a", b"PK\x03\x04"]))
def test_random_bytes_are_refused_as_input(tmp_path: Path, content: bytes, start: bytes) -> None:
    _areas_or_input_error(tmp_path / "fuzz.any", start + content)


@FUZZ
@given(st.data())
def test_damaged_documents_are_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    """Bytes replaced, cut out, doubled; numbers replaced by other numbers and words."""
    documents = _documents(tmp_path)
    content = documents[data.draw(st.integers(0, len(documents) - 1))]
    for _ in range(data.draw(st.integers(1, 4))):
        first = data.draw(st.integers(0, max(len(content) - 1, 0)))
        end = first + data.draw(st.integers(0, 40))
        new = data.draw(
            st.one_of(
                st.binary(max_size=8),
                st.sampled_from([b"nan", b"1e999", b"-", b"null", b"[]", b"(", b")", b"EMPTY", b"\xff\xff\xff\x7f"]),
                st.just(content[first:end] * 2),
            )
        )
        content = content[:first] + new + content[end:]
    _areas_or_input_error(tmp_path / "fuzz.any", content)
