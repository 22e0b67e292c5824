"""Positions by image in a CSV: read, written, and refused with file and line."""

from pathlib import Path

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geographic_from_crs
from uavkit.core.heights import HeightDatum
from uavkit.formats.positions_file import ImagePositions, read_image_positions, write_image_positions

HEAD = "# vertical: ellipsoid\nimage,latitude_deg,longitude_deg,height_m,sigma_east_m,sigma_north_m,sigma_up_m\n"
ROW = "A.JPG,35.8,139.65,60.25,0.011,0.014,0.022\n"


def read(tmp_path: Path, text: str) -> ImagePositions:
    path = tmp_path / "positions.csv"
    path.write_text(text, encoding="utf-8")
    return read_image_positions(path)


def test_each_number_goes_where_it_belongs(tmp_path: Path) -> None:
    found = read(tmp_path, HEAD + ROW)
    (fix,) = found.fixes
    assert (fix.name, fix.latitude_deg, fix.longitude_deg, fix.height_m) == ("A.JPG", 35.8, 139.65, 60.25)
    assert fix.height_datum is HeightDatum.ELLIPSOID
    assert (fix.sigma_east_north_m, fix.sigma_vertical_m) == ((0.011, 0.014), 0.022)
    assert fix.sigma_horizontal_m == pytest.approx(np.sqrt((0.011**2 + 0.014**2) / 2))
    assert found.lines == (3,)
    assert found.shift_sigma_m is None


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    first = read(tmp_path, "# shift_sigma_m: 0.005 0.006 0.01\n" + HEAD + ROW + "B.JPG,35.9,139.7,61,0.02,0.03,0.04\n")
    assert first.shift_sigma_m == (0.005, 0.006, 0.01)
    write_image_positions(tmp_path / "again.csv", first)
    assert read_image_positions(tmp_path / "again.csv") == first


def test_one_shift_sigma_counts_for_all_axes(tmp_path: Path) -> None:
    assert read(tmp_path, "# shift_sigma_m: 0.01\n" + HEAD + ROW).shift_sigma_m == (0.01, 0.01, 0.01)


def test_projected_coordinates(tmp_path: Path) -> None:
    """Axes cannot be mistaken: 30 m east and 10 m north of the first point are found again in metres."""
    head = "# crs: EPSG:32654\n# vertical: geoid\nimage,easting_m,northing_m,height_m\n"
    found = read(tmp_path, head + "A.JPG,378000,3962500,20\nB.JPG,378030,3962510,21\n").fixes
    latitude, longitude, _ = geographic_from_crs(np.array([[378000.0, 3962500.0, 20.0]]), "EPSG:32654")[0]
    assert (found[0].latitude_deg, found[0].longitude_deg) == pytest.approx((latitude, longitude), abs=1e-12)
    frame = LocalFrame.at(float(latitude), float(longitude), 20.0, "EPSG:32654")
    place = np.array([[fix.latitude_deg, fix.longitude_deg, fix.height_m] for fix in found])
    apart = np.diff(frame.crs_from_enu(frame.enu_from_geographic(*place.T)), axis=0)[0]
    assert apart == pytest.approx([30.0, 10.0, 1.0], abs=1e-3)
    assert found[0].height_datum is HeightDatum.GEOID
    assert found[0].sigma_horizontal_m is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (HEAD, "holds no position"),
        (HEAD + ROW.replace("35.8,139.65", "139.65,35.8"), "line 3: .* swapped"),
        (HEAD + ROW.replace("0.014", "0"), "line 3: sigma_north_m must be > 0"),
        (HEAD + ROW.replace("0.022", "-1"), "line 3: sigma_up_m must be > 0"),
        (HEAD + ROW.replace("0.022", ""), "line 3: sigma_up_m is '', not a number"),
        (HEAD + ROW + ROW.lower(), "lines 3 and 4 both give a position of a.jpg"),
        (HEAD + ROW.replace("A.JPG", ""), "line 3: the position names no image"),
        (HEAD.replace(",sigma_up_m", "") + "A,35,139,1,1,1\n", "line 2: the header misses sigma_up_m"),
        (HEAD.replace("latitude_deg,", "") + ROW, "line 2: the header misses latitude_deg"),
        (HEAD.replace("latitude_deg", "lattitude_deg") + ROW, "did you mean 'latitude_deg'"),
        (HEAD.replace("height_m", "height_m,easting_m,northing_m") + ROW, "line 2: .*"),
        (HEAD + ROW.replace("60.25", "60,25"), "line 3 has 8 cells, the header 7: decimal commas"),
        (HEAD + ROW.replace("60.25", "nan"), "line 3: height_m is 'nan', not a number"),
        (HEAD.replace("ellipsoid", "elipsoid") + ROW, "line 1: 'elipsoid' is none of .* did you mean 'ellipsoid'"),
        ("# shift_sigma_m: 0.01 0.02\n" + HEAD + ROW, "line 1: shift_sigma_m needs one number > 0, or three"),
        ("# shift_sigma: 0.01\n" + HEAD + ROW, "line 1: unknown key 'shift_sigma'; did you mean 'shift_sigma_m'"),
        ("image,easting_m,northing_m,height_m\nA,378000,3962500,20\n", "need a CRS"),
        ("# crs: EPSG:4326\nimage,easting_m,northing_m,height_m\nA,35,139,20\n", "line 1: .* degrees"),
        ("# crs: EPSG:99999\nimage,easting_m,northing_m,height_m\nA,35,139,20\n", "line 1"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(tmp_path: Path, text: str, what: str) -> None:
    with pytest.raises(InputError, match=rf"positions\.csv: .*{what}|positions\.csv: {what}"):
        read(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
        read_image_positions(tmp_path / "none.csv")
