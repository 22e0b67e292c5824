"""Files of surveyed points: what they may look like, and what they may not."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geoid_undulation_m
from uavkit.core.heights import HeightDatum
from uavkit.core.points import CheckPoint, ControlPoint
from uavkit.formats.control_file import (
    UNKNOWN_HEIGHT_SIGMA_M,
    ControlFileOptions,
    FileMark,
    FilePoint,
    PixelOrigin,
    SurveyedPoints,
    read_surveyed_points,
    to_local,
    write_gcp_list,
    write_points_csv,
)

FRAME = LocalFrame(latitude_deg=35.8, longitude_deg=139.65, height_ellipsoid_m=40.0, crs="EPSG:32654")
ORIGIN = tuple(float(value) for value in FRAME.crs_from_enu(np.zeros((1, 3)))[0])
CSV_HEAD = (
    "name,easting_m,northing_m,height_m,sigma_easting_m,sigma_northing_m,sigma_height_m,image,column_px,row_px,sigma_px"
)


def write(tmp_path: Path, text: str, name: str = "gcp_list.txt") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("crs", ["EPSG:32654", "WGS84 UTM 54N", "+proj=utm +zone=54 +datum=WGS84 +units=m +no_defs"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("start", ["", "\ufeff"])
def test_gcp_list_in_its_many_shapes(tmp_path: Path, crs: str, end: str, start: str) -> None:
    rows = [
        crs,
        "# a comment",
        "",
        "376000.5 3962000.25 40.5 100.5 200 DJI_0001.JPG P1 extra columns",
        "376000.5\t3962000.25\t40.5\t110\t210\tDJI 0002.JPG\tP1",
        "  376010   3962010\t41   1 2   DJI_0001.JPG",
        "376010 3962010 41 3 4 DJI_0003.JPG",
        "376020 3962020 NaN 3 4 DJI_0003.JPG P3",
    ]
    surveyed = read_surveyed_points(write(tmp_path, start + end.join(rows)))
    assert [point.name for point in surveyed.points] == ["P1", "point-1", "P3"]
    assert surveyed.points[0].coordinates == (376000.5, 3962000.25, 40.5)
    marks = surveyed.points[0].marks
    assert [(m.image, m.column_px, m.row_px, m.line) for m in marks] == [
        ("DJI_0001.JPG", 100.5, 200, 4),
        ("DJI 0002.JPG", 110, 210, 5),
    ]
    assert [mark.image for mark in surveyed.points[1].marks] == ["DJI_0001.JPG", "DJI_0003.JPG"]
    assert math.isnan(surveyed.points[2].coordinates[2])
    assert surveyed.points[0].sigma_m == (0.01, 0.01, 0.02)
    assert surveyed.vertical is HeightDatum.UNKNOWN


@pytest.mark.parametrize(
    "text, words",
    [
        ("376000 3962000 40 1 2 a.jpg\n", "line 1: the first line must name the CRS"),
        ("EPSG:99999\n1 2 3 4 5 a.jpg\n", "line 1: .*no coordinate reference system"),
        ("EPSG:32654\n376000,5 3962000 40 1 2 a.jpg\n", "line 2: X is '376000,5': decimal commas"),
        ("EPSG:32654\n376000,3962000,40,1,2,a.jpg\n", "line 2 has 1 fields of 6.*blanks or tabs"),
        ("EPSG:32654\n376000 3962000 40 1 2\n", "line 2 has 5 fields of 6"),
        ("EPSG:32654\nNaN 3962000 40 1 2 a.jpg\n", "line 2: X is 'NaN'"),
        ("EPSG:32654\n376000 3962000 abc 1 2 a.jpg\n", "line 2: Z is 'abc'"),
        ("EPSG:32654\n376000 3962000 40 -7 2 a.jpg\n", "line 2: the mark .* outside"),
        ("EPSG:32654\n\n1 2 3 4 5 a.jpg P\n1 2 3.5 4 5 b.jpg P\n", "lines 3 and 4 give 'P' different coordinates"),
        ("EPSG:32654\n1 2 3 4 5 a.jpg P\n1 2 3 4 6 a.jpg P\n", "lines 2 and 3 mark 'P' twice in a.jpg"),
        ("EPSG:32654\n# nothing\n", "no surveyed point"),
        ("\n# nothing\n", "no surveyed point"),
    ],
)
def test_gcp_list_errors_name_the_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=rf"gcp_list\.txt: .*{words}"):
        read_surveyed_points(write(tmp_path, text))


def test_other_encodings_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "latin.txt").write_bytes("EPSG:32654\n1 2 3 4 5 a.jpg Höhe\n".encode("latin-1"))
    for name in ("latin.txt", "absent.txt"):
        with pytest.raises(InputError, match=name):
            read_surveyed_points(tmp_path / name)


@pytest.mark.parametrize("datum", [HeightDatum.GEOID, HeightDatum.ELLIPSOID, HeightDatum.UNKNOWN])
def test_local_coordinates_and_heights(tmp_path: Path, datum: HeightDatum) -> None:
    enu = np.array([[10.0, 20.0, 3.0], [-40.0, 5.0, -1.0]])
    coordinates = FRAME.crs_from_enu(enu)
    undulation_m = float(geoid_undulation_m(np.array(35.8), np.array(139.65)))
    assert undulation_m > 30  # the test would not see a sign error on a geoid at zero
    if datum is HeightDatum.GEOID:
        coordinates[:, 2] -= undulation_m
    rows = [f"{x!r} {y!r} {z!r} 5 6 a.jpg P{i}" for i, (x, y, z) in enumerate(coordinates.tolist())]
    surveyed = read_surveyed_points(write(tmp_path, "EPSG:32654\n" + "\n".join(rows)))
    points = to_local(surveyed, FRAME, ControlPoint, datum)
    assert all(isinstance(point, ControlPoint) for point in points)
    # the undulation changes by millimetres over the 50 m between the points
    assert np.allclose([point.position_m for point in points], enu, atol=5e-3)
    assert (points[0].marks[0].column_px, points[0].marks[0].row_px) == (5.0, 6.0)


def test_geographic_list_is_longitude_latitude(tmp_path: Path) -> None:
    surveyed = read_surveyed_points(write(tmp_path, "EPSG:4326\n139.65 35.8 40.0 5 6 a.jpg P\n"))
    (point,) = to_local(surveyed, FRAME, CheckPoint)
    assert isinstance(point, CheckPoint)
    assert np.allclose(point.position_m, 0.0, atol=1e-6)
    with pytest.raises(InputError, match=r"line 2: .*X is longitude"):
        read_surveyed_points(write(tmp_path, "EPSG:4326\n35.8 139.65 40.0 5 6 a.jpg P\n"))


def test_corner_pixels_are_shifted(tmp_path: Path) -> None:
    path = write(tmp_path, f"EPSG:32654\n{ORIGIN[0]!r} {ORIGIN[1]!r} 40 5 6 a.jpg P\n")
    surveyed = read_surveyed_points(path, ControlFileOptions(pixel_origin=PixelOrigin.CORNER))
    (point,) = to_local(surveyed, FRAME, ControlPoint)
    assert (point.marks[0].column_px, point.marks[0].row_px) == (4.5, 5.5)


def test_a_point_without_height_controls_its_position_only(tmp_path: Path) -> None:
    surveyed = read_surveyed_points(write(tmp_path, f"EPSG:32654\n{ORIGIN[0]!r} {ORIGIN[1]!r} - 5 6 a.jpg P\n"))
    (point,) = to_local(surveyed, FRAME, ControlPoint)
    assert point.sigma_m == (0.01, 0.01, UNKNOWN_HEIGHT_SIGMA_M)
    assert np.allclose(point.position_m, 0.0, atol=1e-4)
    with pytest.raises(InputError, match="line 2: check point 'P' has no height"):
        to_local(surveyed, FRAME, CheckPoint)


def test_csv_of_uavkit(tmp_path: Path) -> None:
    text = (
        "# uavkit points\n# crs: EPSG:32654\n# vertical: geoid\n# pixel: corner\n# surveyed on Tuesday: static\n"
        f"{CSV_HEAD}\n"
        "P1,376000,3962000,5.5,0.011,0.012,0.013,a.jpg,10,20,0.3\n"
        "P1,376000,3962000,5.5,0.011,0.012,0.013,b.jpg,11,21,\n"
        "P2,376001,3962001,5.5,,,,,,,\n"
    )
    surveyed = read_surveyed_points(write(tmp_path, text, "points.csv"))
    assert (surveyed.vertical, surveyed.pixel_origin) == (HeightDatum.GEOID, PixelOrigin.CORNER)
    one, two = surveyed.points
    assert (one.sigma_m, [m.sigma_px for m in one.marks]) == ((0.011, 0.012, 0.013), [0.3, 1.0])
    assert (two.sigma_m, two.marks) == ((0.01, 0.01, 0.02), ())
    assert [point.name for point in surveyed.only(["P2"]).points] == ["P2"]
    with pytest.raises(InputError, match=r"points\.csv: there is no point 'P3'; did you mean"):
        surveyed.only(["P3"])


@pytest.mark.parametrize(
    "head, rows, words",
    [
        ("", "P,1,2,3", "states no CRS"),
        ("# crs: EPSG:4326", "P,1,2,3", "degrees"),
        ("# crs: EPSG:32654\n# verticl: geoid", "P,1,2,3", "line 2: unknown key 'verticl'; did you mean 'vertical'"),
        ("# crs: EPSG:32654\n# vertical: msl", "P,1,2,3", "line 2: 'msl' is none of ellipsoid, geoid"),
        ("# crs: EPSG:32654", "P,1,2,3,4", "line 3 has 5 cells, the header 4: decimal commas"),
        ("# crs: EPSG:32654", "P,1,x,3", "line 3: northing_m is 'x'"),
        ("# crs: EPSG:32654", ",1,2,3", "line 3: the point has no name"),
        ("# crs: EPSG:32654", "P,1,2,3\nP,1,2,4", "lines 3 and 4"),
    ],
)
def test_csv_errors(tmp_path: Path, head: str, rows: str, words: str) -> None:
    path = write(tmp_path, f"{head}\nname,easting_m,northing_m,height_m\n{rows}\n", "points.csv")
    with pytest.raises(InputError, match=rf"points\.csv: .*{words}"):
        read_surveyed_points(path)


@pytest.mark.parametrize("header", ["name,easting,northing_m,height_m", "name,easting_m,height_m"])
def test_csv_header_errors(tmp_path: Path, header: str) -> None:
    with pytest.raises(InputError, match=r"line 2: .*easting_m"):
        read_surveyed_points(write(tmp_path, f"# crs: EPSG:32654\n{header}\nP,1,2,3\n", "points.csv"))


NAMES = st.text(
    st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp", "Zs", "Cn", "Co", "Cf")), min_size=1
)
POSITIVE = st.floats(1e-6, 1e3)


@st.composite
def surveyed_points(draw: st.DrawFn, least_marks: int) -> SurveyedPoints:
    names = draw(st.lists(NAMES.filter(lambda name: name[0] != "#"), min_size=1, max_size=4, unique=True))
    points = []
    for name in names:
        images = draw(st.lists(NAMES, min_size=least_marks, max_size=3, unique=True))
        place = (draw(st.floats(1e5, 9e5)), draw(st.floats(0, 9e6)), draw(st.floats(-400, 9000)))
        marks = [
            FileMark(
                image=i,
                column_px=draw(st.floats(-0.5, 9e3)),
                row_px=draw(st.floats(-0.5, 9e3)),
                sigma_px=draw(POSITIVE),
            )
            for i in images
        ]
        sigma = (draw(POSITIVE), draw(POSITIVE), draw(POSITIVE))
        points.append(FilePoint(name=name, coordinates=place, sigma_m=sigma, marks=tuple(marks)))
    return SurveyedPoints(
        crs="EPSG:32654",
        vertical=draw(st.sampled_from([HeightDatum.GEOID, HeightDatum.ELLIPSOID, HeightDatum.UNKNOWN])),
        pixel_origin=draw(st.sampled_from(PixelOrigin)),
        points=tuple(points),
    )


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, derandomize=True)
@given(surveyed_points(0))
def test_csv_round_trip_is_exact(tmp_path: Path, surveyed: SurveyedPoints) -> None:
    write_points_csv(tmp_path / "points.csv", surveyed)
    assert read_surveyed_points(tmp_path / "points.csv") == surveyed


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, derandomize=True)
@given(surveyed_points(1))
def test_gcp_list_round_trip_is_exact_but_for_sigmas(tmp_path: Path, surveyed: SurveyedPoints) -> None:
    write_gcp_list(tmp_path / "gcp_list.txt", surveyed)
    back = read_surveyed_points(
        tmp_path / "gcp_list.txt",
        ControlFileOptions(vertical=surveyed.vertical, pixel_origin=surveyed.pixel_origin),
    )
    for one, two in zip(surveyed.points, back.points, strict=True):
        assert (one.name, one.coordinates) == (two.name, two.coordinates)
        assert [(m.image, m.column_px, m.row_px) for m in one.marks] == [
            (m.image, m.column_px, m.row_px) for m in two.marks
        ]


def test_what_a_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    point = FilePoint(name="P", coordinates=(1.0, 2.0, 3.0), sigma_m=(1.0, 1.0, 1.0), marks=())
    surveyed = SurveyedPoints(
        crs="EPSG:4326", vertical=HeightDatum.GEOID, pixel_origin=PixelOrigin.CENTRE, points=(point,)
    )
    with pytest.raises(InputError, match="degrees"):
        write_points_csv(tmp_path / "points.csv", surveyed)
    with pytest.raises(InputError, match="no marks"):
        write_gcp_list(tmp_path / "gcp_list.txt", surveyed)
    assert list(tmp_path.iterdir()) == []
