"""Elevation models from GeoTIFF, .hgt and ESRI ASC."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rasterio.transform import Affine

from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geographic_from_crs, geoid_undulation_m
from uavkit.core.surface import ElevationGrid
from uavkit.formats import elevation_file
from uavkit.formats.elevation_file import SRTM_SIGMA_M, read_elevation, write_elevation

TERRAIN = Path(__file__).resolve().parents[2] / "../shared/data/terrain/N44W072.hgt"
UTM = "EPSG:32654"
FLOAT32_M = 2e-4
"""Rounding of a height below 2048 m to 24 bits, twice."""
LATTICE_ERROR_M = 0.028
"""The kinks of EGM96, 2.2e-4 at most, times the lattice's 250 m, by 4, along rows and columns."""


def north_up(west: float, north: float, step_x: float, step_y: float) -> Affine:
    """Return the transformation of pixel corners."""
    return Affine(step_x, 0.0, west, 0.0, -step_y, north)


def write_tiff(path: Path, heights: Any, crs: Any = UTM, **options: Any) -> Path:
    """Write a GeoTIFF of one band; its upper left corner is at 380000, 3900000, its cells are 10 m, unless told."""
    array = np.atleast_3d(np.asarray(heights)).transpose(2, 0, 1)
    settings_ = {"transform": north_up(380000.0, 3900000.0, 10.0, 10.0), "nodata": None, **options}
    tags, unit = settings_.pop("tags", {}), settings_.pop("unit", None)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=array.shape[1],
        width=array.shape[2],
        count=array.shape[0],
        dtype=array.dtype,
        crs=None if crs is None else rasterio.crs.CRS.from_user_input(crs),
        **settings_,
    ) as dataset:
        dataset.write(array)
        dataset.update_tags(**tags)
        if unit:
            dataset.units = (unit,)
    return path


def write_bare_tiff(path: Path, raster_type: int, tie: tuple[float, float]) -> Path:
    """Write, byte by byte, a GeoTIFF of 3 x 2 heights 1 ... 6 in EPSG:4326, 0.001 degrees apart, tied at raster (0, 0).

    ``raster_type``: 1 pixel is area, 2 pixel is point.
    """
    entries: list[tuple[int, int, int, Any]] = [
        (256, 3, 1, 3),
        (257, 3, 1, 2),
        (258, 3, 1, 32),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, 1, "strip"),
        (277, 3, 1, 1),
        (278, 3, 1, 2),
        (279, 4, 1, 24),
        (339, 3, 1, 3),
        (33550, 12, 3, struct.pack("<3d", 0.001, 0.001, 0.0)),
        (33922, 12, 6, struct.pack("<6d", 0.0, 0.0, 0.0, tie[0], tie[1], 0.0)),
        (34735, 3, 16, struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, raster_type, 2048, 0, 1, 4326)),
    ]
    begin = 8 + 2 + 12 * len(entries) + 4
    strip = struct.pack("<6f", 1, 2, 3, 4, 5, 6)
    directory, extra = b"", strip
    for tag, kind, count, value in entries:
        if isinstance(value, bytes):
            field, extra = struct.pack("<I", begin + len(extra)), extra + value
        elif value == "strip":
            field = struct.pack("<I", begin)
        else:
            field = struct.pack("<HH" if kind == 3 else "<I", *((value, 0) if kind == 3 else (value,)))
        directory += struct.pack("<HHI", tag, kind, count) + field
    path.write_bytes(b"II*\x00" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + extra)
    return path


def write_asc(path: Path, heights: Any, header: str, prj: str = "") -> Path:
    rows = "\n".join(" ".join(str(value) for value in row) for row in heights)
    path.write_text(f"ncols {len(heights[0])}\nnrows {len(heights)}\n{header}\n{rows}\n")
    if prj:
        path.with_suffix(".prj").write_text(prj)
    return path


def nodes(grid: ElevationGrid) -> tuple[np.ndarray, np.ndarray]:
    """Return easting and northing of the nodes, (rows, columns) each."""
    rows, columns = grid.height_ellipsoid_m.shape
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    xy = np.column_stack([column.ravel(), row.ravel(), np.ones(column.size)]) @ grid.crs_from_grid.T
    return xy[:, 0].reshape(rows, columns), xy[:, 1].reshape(rows, columns)


def undulation_m(grid: ElevationGrid) -> np.ndarray:
    east, north = nodes(grid)
    geographic = geographic_from_crs(np.column_stack([east.ravel(), north.ravel(), np.zeros(east.size)]), grid.crs)
    return geoid_undulation_m(geographic[:, 0], geographic[:, 1]).reshape(east.shape)


RAMP = np.arange(12, dtype=np.float32).reshape(3, 4)


# Where the nodes are


@pytest.mark.parametrize("raster_type, first", [(1, (139.0005, 34.9995)), (2, (139.0, 35.0))])
def test_the_first_node_is_the_middle_of_a_pixel_and_the_place_of_a_point(
    tmp_path: Path, raster_type: int, first: tuple[float, float]
) -> None:
    """GeoTIFF 1.1, section 7.1.1: the tie point is the corner of an area pixel, the place of a point pixel."""
    grid = read_elevation(write_bare_tiff(tmp_path / "a.tif", raster_type, (139.0, 35.0)), "ellipsoid")
    np.testing.assert_allclose(grid.crs_from_grid[:, 2], first, rtol=0, atol=1e-12)
    np.testing.assert_allclose(grid.crs_from_grid[:, :2], [[0.001, 0.0], [0.0, -0.001]], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(grid.height_ellipsoid_m, [[1, 2, 3], [4, 5, 6]])
    assert grid.crs == "EPSG:4326"


@pytest.mark.parametrize(
    "header, first",
    [
        ("xllcorner 380000\nyllcorner 3900000\ncellsize 10\nNODATA_value -9999", (380005.0, 3900025.0)),
        ("XLLCENTER 380000\nYLLCENTER 3900000\nCELLSIZE 10", (380000.0, 3900020.0)),
        ("xllcorner 380000\nyllcorner 3900000\ndx 10\ndy 20", (380005.0, 3900050.0)),
    ],
)
def test_asc_corner_and_centre(tmp_path: Path, header: str, first: tuple[float, float]) -> None:
    grid = read_elevation(write_asc(tmp_path / "a.asc", RAMP, header, "EPSG:32654"), "ellipsoid")
    np.testing.assert_allclose(grid.crs_from_grid[:, 2], first)
    np.testing.assert_array_equal(grid.height_ellipsoid_m, RAMP)
    assert grid.crs == UTM


def test_a_rotated_grid(tmp_path: Path) -> None:
    transform = Affine(8.66, 10.0, 380000.0, 5.0, -17.32, 3900000.0)  # 10 m by 20 m, turned by 30 degrees
    grid = read_elevation(write_tiff(tmp_path / "a.tif", RAMP, transform=transform), "ellipsoid")
    for column, row in ((0, 0), (3, 1)):
        corner = np.array(transform).reshape(3, 3)[:2]
        np.testing.assert_allclose(grid.crs_from_grid @ [column, row, 1.0], corner @ [column + 0.5, row + 0.5, 1.0])
    np.testing.assert_allclose(grid.grid_from_crs((corner @ [2.5, 1.5, 1.0])[None]), [[2.0, 1.0]], atol=1e-6)


# What the heights count from


@pytest.mark.parametrize(
    "crs, told, geoid, note",
    [
        (UTM, "ellipsoid", False, "ellipsoid heights"),
        (UTM, "geoid", True, "geoid heights"),
        ("EPSG:32654+5773", "", True, "EGM96"),
        ("EPSG:32654+5773", "geoid", True, "EGM96"),
        ("EPSG:32654+3855", "", True, "EGM2008 heights, taken as geoid"),
        ("EPSG:32654+5703", "geoid", True, "NAVD88 height heights, taken as geoid"),
    ],
)
@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_vertical_datums(tmp_path: Path, crs: str, told: str, geoid: bool, note: str, version: str) -> None:
    grid = read_elevation(write_tiff(tmp_path / "a.tif", RAMP + 100, crs, GEOTIFF_VERSION=version), told)
    expected = RAMP + 100 + (undulation_m(grid) if geoid else 0.0)
    np.testing.assert_allclose(grid.height_ellipsoid_m, expected, rtol=0, atol=FLOAT32_M)
    assert grid.crs == UTM
    assert grid.source.startswith("a.tif: ")
    assert note in grid.source


def test_ellipsoidal_heights_in_three_dimensions(tmp_path: Path) -> None:
    degrees = {"transform": north_up(139.0, 35.0, 1e-4, 1e-4)}
    grid = read_elevation(write_tiff(tmp_path / "a.tif", RAMP, "EPSG:4979", **degrees))
    np.testing.assert_allclose(grid.height_ellipsoid_m, RAMP, rtol=0, atol=FLOAT32_M)
    assert grid.crs == "EPSG:4326"


@pytest.mark.parametrize(
    "crs, told, words",
    [
        (UTM, "", "state height_datum, 'geoid'"),
        (UTM, "ground", "height_datum 'ground' is neither"),
        (UTM, "elipsoid", "did you mean 'ellipsoid'"),
        ("EPSG:32654+5773", "ellipsoid", "its heights count from the geoid by the file's own word"),
        ("EPSG:32654+5703", "", "'NAVD88 height' cannot be made ellipsoidal here: state height_datum"),
        ("EPSG:32654+6360", "geoid", "heights in '?US survey foot'?: convert them"),
        ("EPSG:2263", "geoid", "the grid is in US survey foot: transform it"),
        (None, "geoid", "does not say where it lies"),
        ("EPSG:4978", "geoid", "no CRS of the earth"),
        ("EPSG:31467", "geoid", r"a\.tif: (only a|no exact) transformation"),  # DHDN: its grid is not shipped
    ],
)
def test_what_the_file_must_say(tmp_path: Path, crs: str | None, told: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read_elevation(write_tiff(tmp_path / "a.tif", RAMP, crs), told)


def test_the_geoid_is_interpolated_well_enough(tmp_path: Path) -> None:
    """Over 45 km of Tenerife, where the slope of the geoid changes most; every seventh node against the geoid."""
    heights = np.zeros((450, 450), dtype=np.float32)
    transform = north_up(310000.0, 3150000.0, 100.0, 100.0)
    grid = read_elevation(write_tiff(tmp_path / "a.tif", heights, "EPSG:32628", transform=transform), "geoid")
    error = (grid.height_ellipsoid_m - undulation_m(grid))[::7, ::7]
    assert np.abs(error).max() < LATTICE_ERROR_M + FLOAT32_M
    assert np.ptp(grid.height_ellipsoid_m) > 1.0  # or a constant would do


# What the values mean


def test_voids_are_nan(tmp_path: Path) -> None:
    heights = RAMP.copy()
    heights[0, 1], heights[2, 3] = -9999.0, np.inf
    grid = read_elevation(write_tiff(tmp_path / "a.tif", heights, nodata=-9999.0), "geoid")
    assert np.argwhere(np.isnan(grid.height_ellipsoid_m)).tolist() == [[0, 1], [2, 3]]
    integers = RAMP.astype(np.int16)
    integers[1, 1] = -32768
    grid = read_elevation(write_tiff(tmp_path / "i.tif", integers, nodata=-32768), "ellipsoid")
    assert np.argwhere(np.isnan(grid.height_ellipsoid_m)).tolist() == [[1, 1]]
    rows = RAMP.tolist()
    rows[1][2], rows[0][0] = "-9999", "nan"
    header = "xllcorner 380000\nyllcorner 3900000\ncellsize 10\nNODATA_value -9999"
    grid = read_elevation(write_asc(tmp_path / "a.asc", rows, header, UTM), "ellipsoid")
    assert np.argwhere(np.isnan(grid.height_ellipsoid_m)).tolist() == [[0, 0], [1, 2]]


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 3.4e38, 20000.0])
def test_an_undeclared_void_is_named_with_its_place(tmp_path: Path, value: float) -> None:
    heights = RAMP.copy()
    heights[0, 0] = value
    degrees = {"transform": north_up(139.0, 35.0, 1e-3, 1e-3)}
    with pytest.raises(
        InputError, match=r"at latitude 34\.999500, longitude 139\.000500 is no height of ground: declare"
    ):
        read_elevation(write_tiff(tmp_path / "a.tif", heights, "EPSG:4326", **degrees), "geoid")


def test_scale_offset_and_unit(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", RAMP.astype(np.int16), unit="metre")
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.5,), (100.0,)
    np.testing.assert_array_equal(read_elevation(path, "ellipsoid").height_ellipsoid_m, 100.0 + 0.5 * RAMP)


@pytest.mark.parametrize(
    "heights, options, words",
    [
        (np.dstack([RAMP, RAMP]), {}, "2 bands, an elevation model has one"),
        (RAMP.astype(np.complex64), {}, "complex64 are no heights"),
        (RAMP, {"unit": "ft"}, "heights in 'ft': convert"),
        (RAMP[:1], {}, "needs 2 x 2 nodes, this has 1 x 4"),
    ],
)
def test_rasters_that_are_no_elevation_model(tmp_path: Path, heights: Any, options: Any, words: str) -> None:
    with pytest.raises(InputError, match=rf"a\.tif: .*{words}"):
        read_elevation(write_tiff(tmp_path / "a.tif", heights, **options), "geoid")


def test_sigma_by_default_and_as_told(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", RAMP)
    assert read_elevation(path, "geoid").sigma_m == 5.0  # half of 10 m
    assert read_elevation(path, "geoid", sigma_m=0.3).sigma_m == 0.3
    for cell_m, sigma_m in ((0.05, 0.1), (1.0, 0.5), (30.0, 5.0)):
        fine = write_tiff(tmp_path / "b.tif", RAMP, transform=north_up(380000.0, 3900000.0, cell_m, cell_m))
        assert read_elevation(fine, "geoid").sigma_m == pytest.approx(sigma_m)
    degrees = write_tiff(tmp_path / "c.tif", RAMP, "EPSG:4326", transform=north_up(10.0, 60.0, 1e-5, 1e-5))
    assert read_elevation(degrees, "geoid").sigma_m == pytest.approx(0.5 * 1.1132 * 0.5**0.5, rel=1e-3)
    with pytest.raises(InputError, match="sigma_m of an elevation model"):
        read_elevation(path, "geoid", sigma_m=float("nan"))


# Windows


def geographic_box(east: tuple[float, float], north: tuple[float, float]) -> tuple[float, float, float, float]:
    corners = np.array([[x, y, 0.0] for x in east for y in north])
    geographic = geographic_from_crs(corners, UTM)
    return (
        float(geographic[:, 0].min()),
        float(geographic[:, 1].min()),
        float(geographic[:, 0].max()),
        float(geographic[:, 1].max()),
    )


@pytest.mark.parametrize("kind", ["tif", "asc"])
def test_a_window_is_the_same_part_of_the_whole(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(5)
    heights = np.round(rng.uniform(0, 500, (120, 100)), 2).astype(np.float32)
    header = "xllcorner 380000\nyllcorner 3898800\ncellsize 10"
    path = (
        write_tiff(tmp_path / "a.tif", heights)
        if kind == "tif"
        else write_asc(tmp_path / "a.asc", heights.tolist(), header, UTM)
    )
    whole = read_elevation(path, "ellipsoid")
    np.testing.assert_array_equal(whole.height_ellipsoid_m, heights)
    around = geographic_box((380305.0, 380405.0), (3899495.0, 3899695.0))  # nodes 30 to 40, rows 30 to 50
    part = read_elevation(path, "ellipsoid", around=around)
    column, row = np.round(whole.grid_from_crs(part.crs_from_grid[None, :, 2])[0], 6)
    rows, columns = part.height_ellipsoid_m.shape
    # The box in degrees is wider than the one in metres by the meridian convergence of 0.75 degrees, less than a node.
    assert (column, row, columns, rows) == (27, 27, 17, 27)  # from node 29 to 41 and 29 to 51, and two more
    np.testing.assert_array_equal(part.height_ellipsoid_m, heights[27:54, 27:44])


def test_a_window_partly_outside_keeps_what_is_there(tmp_path: Path) -> None:
    heights = np.arange(120 * 100, dtype=np.float32).reshape(120, 100) / 10
    path = write_tiff(tmp_path / "a.tif", heights)
    part = read_elevation(path, "ellipsoid", around=geographic_box((379000.0, 380055.0), (3899945.0, 3901000.0)))
    rows, columns = part.height_ellipsoid_m.shape
    np.testing.assert_array_equal(part.height_ellipsoid_m, heights[:rows, :columns])
    np.testing.assert_allclose(part.crs_from_grid[:, 2], [380005.0, 3899995.0])
    # node 5 and two more; the convergence widens the box of 1055 m by 14 m, at most two nodes
    assert 8 <= rows <= 10
    assert 8 <= columns <= 10


def test_a_window_outside_names_both_places(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", RAMP, "EPSG:4326", transform=north_up(139.0, 35.0, 0.01, 0.01))
    words = r"covers latitude 34\.97.* to 34\.99.*, longitude 139\.0.* lies outside, at latitude {}.*: {}"
    with pytest.raises(InputError, match=words.format(r"34\.000000, longitude 139", "give a model")):
        read_elevation(path, "geoid", around=(33.9, 138.9, 34.1, 139.1))
    with pytest.raises(InputError, match="latitude and longitude swapped"):
        read_elevation(
            write_tiff(tmp_path / "b.tif", RAMP, "EPSG:4326", transform=north_up(20.0, 35.0, 0.01, 0.01)),
            "geoid",
            around=(20.01, 34.98, 20.02, 34.99),
        )
    for around in ((35.0, 139.0, 34.0, 140.0), (float("nan"), 139.0, 35.0, 140.0), (100.0, 0.0, 101.0, 1.0)):
        with pytest.raises(InputError, match=r"a\.tif: the window to read is south, west, north, east"):
            read_elevation(path, "geoid", around=around)


def test_a_model_across_the_antimeridian(tmp_path: Path) -> None:
    """UTM zone 1 reaches over longitude 180; a window on either side is found."""
    heights = np.tile(np.arange(100, dtype=np.float32), (50, 1))
    frame = LocalFrame.at(-17.0, 179.999, 0.0, "EPSG:32701")
    corner = frame.crs_from_enu(np.array([[-5000.0, 2500.0, 0.0]]))[0]
    path = write_tiff(tmp_path / "a.tif", heights, "EPSG:32701", transform=north_up(corner[0], corner[1], 100, 100))
    for east_m, west in ((-3000.0, True), (3000.0, False)):
        latitude, longitude, _ = frame.geographic_from_enu(np.array([[east_m, 0.0, 0.0]]))[0]
        assert (longitude > 0) == west
        part = read_elevation(path, "ellipsoid", around=(latitude, longitude, latitude, longitude))
        middle = float(np.mean(part.height_ellipsoid_m))
        assert middle == pytest.approx((east_m + 5000.0) / 100.0 - 0.5, abs=2.0)


def test_too_large_a_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elevation_file, "MOST_NODES", 11)
    path = write_tiff(tmp_path / "a.tif", RAMP)
    with pytest.raises(InputError, match=r"a\.tif: 4 x 3 nodes .* cut the file to the area"):
        read_elevation(path, "geoid")


def test_a_huge_file_is_refused_unread_and_read_in_a_window(tmp_path: Path) -> None:
    path = tmp_path / "huge.tif"
    profile = {"width": 40000, "height": 40000, "count": 1, "dtype": "float32", "crs": UTM, "sparse_ok": True}
    transform = north_up(300000.0, 3900000.0, 1.0, 1.0)
    with rasterio.open(path, "w", driver="GTiff", transform=transform, tiled=True, **profile):
        pass
    with pytest.raises(InputError, match=r"40000 x 40000 nodes \(1600 million\) are more than 100 million"):
        read_elevation(path, "geoid")
    part = read_elevation(path, "ellipsoid", around=geographic_box((320000.0, 320100.0), (3880000.0, 3880100.0)))
    assert max(part.height_ellipsoid_m.shape) < 120


# Files that are damaged or strange


@pytest.mark.parametrize(
    "content, words",
    [
        (b"", "the file is empty"),
        (b"hello", "neither GeoTIFF nor ESRI ASC"),
        (b"II*\x00" + bytes(100), "no GeoTIFF that can be read"),
        (b"ncols 4\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1,5\n", "'cellsize 1,5': cellsize needs a number"),
        (b"ncols 4\nnrows 3\nxllcorner 0\nyllcorner 0\n1 2 3", "the header needs ncols"),
        (b"ncols 4\nnrows 3\nxllcorner 0\nyllcorner 0\ncell_size 1\n", "did you mean 'cellsize'"),
        (b"ncols 4.5\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2", "must be whole numbers"),
        (b"ncols 3\nnrows 9\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 4", "the file is shorter than 9 x 3"),
        (b"ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 40000", "end in row 2, at 1 of 3"),
        (b"ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n4 5,5 6", "row 2 of the heights holds"),
        (b"ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n4 x 6", "row 2 of the heights holds"),
        (b"ncols 9999999\nnrows 9999999\nxllcorner 0\nyllcorner 0\ncellsize 1\n1", "more than 100 million"),
    ],
)
def test_damaged_files(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "a.dem"
    path.write_bytes(content)
    path.with_suffix(".prj").write_text(UTM)
    with pytest.raises(InputError, match=rf"a\.dem: .*{words}"):
        read_elevation(path, "geoid")


def test_asc_lines_may_be_broken_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_bytes(
        b"\xef\xbb\xbfNROWS 2\r\nNCOLS 3\r\nXLLCORNER 380000\r\nYLLCORNER 3900000\r\nCELLSIZE 1\r\n1 2\r\n3 4 5\r\n6"
    )
    path.with_suffix(".prj").write_text(UTM)
    np.testing.assert_array_equal(read_elevation(path, "ellipsoid").height_ellipsoid_m, [[1, 2, 3], [4, 5, 6]])


def test_asc_needs_its_system(tmp_path: Path) -> None:
    header = "xllcorner 380000\nyllcorner 3900000\ncellsize 10"
    path = write_asc(tmp_path / "a.asc", RAMP, header)
    with pytest.raises(InputError, match=r"a\.asc: .*write a\.prj beside it"):
        read_elevation(path, "geoid")
    path.with_suffix(".prj").write_text("sideways")
    with pytest.raises(InputError, match=r"a\.prj: 'sideways' is no coordinate reference system"):
        read_elevation(path, "geoid")


def test_missing_files_and_folders(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.tif", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_elevation(path)


def test_pixels_without_area_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.tif: its pixels have no area"):
        read_elevation(write_tiff(tmp_path / "a.tif", RAMP, transform=Affine(1.0, 2.0, 0.0, 2.0, 4.0, 0.0)), "geoid")


@settings(max_examples=150, suppress_health_check=list(HealthCheck), deadline=None, derandomize=True)
@given(st.data())
def test_damaged_models_are_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.dem"
    header = "xllcorner 380000\nyllcorner 3900000\ncellsize 10\nNODATA_value -9999"
    seeds = [
        write_tiff(tmp_path / "seed.tif", RAMP, compress="deflate").read_bytes(),
        write_asc(tmp_path / "seed.asc", RAMP, header).read_bytes(),
    ]
    content = bytearray(data.draw(st.sampled_from(seeds)))
    for _ in range(data.draw(st.integers(1, 4))):
        first = data.draw(st.integers(0, len(content) - 1))
        content[first : first + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    path.write_bytes(bytes(content))
    path.with_suffix(".prj").write_text(UTM)
    try:
        grid = read_elevation(path, "geoid")
    except InputError as error:
        assert "a.dem" in str(error)  # noqa: PT017 - both ends are good ones
    else:
        assert not np.any(np.isinf(grid.height_ellipsoid_m))


# SRTM


def write_hgt(path: Path, heights: np.ndarray) -> Path:
    path.write_bytes(heights.astype(">i2").tobytes())
    return path


@pytest.mark.parametrize("name, south, west", [("S34E151.hgt", -34, 151), ("n44w072.SRTMGL1.HGT", 44, -72)])
@pytest.mark.parametrize("side", [1201, 3601])
def test_srtm_tiles(tmp_path: Path, name: str, south: int, west: int, side: int) -> None:
    heights = np.full((side, side), 100, dtype=np.int16)
    heights[0, 0], heights[-1, -1], heights[5, 7] = 200, 300, -32768
    path = write_hgt(tmp_path / name, heights)
    around = (south, west, south + 0.001, west + 1.0)
    grid = read_elevation(path, around=around)
    np.testing.assert_allclose(grid.crs_from_grid @ [side - 1, len(grid.height_ellipsoid_m) - 1, 1], [west + 1, south])
    undulation = geoid_undulation_m(np.array(float(south)), np.array(west + 1.0))
    assert grid.height_ellipsoid_m[-1, -1] == pytest.approx(300.0 + undulation, abs=FLOAT32_M)
    assert grid.sigma_m == SRTM_SIGMA_M
    assert grid.crs == "EPSG:4326"
    assert "EGM96" in grid.source
    top = read_elevation(path, "geoid", around=(south + 0.99, west, south + 1.0, west + 0.01), sigma_m=9.7)
    np.testing.assert_allclose(top.crs_from_grid[:, 2], [west, south + 1])
    assert np.argwhere(np.isnan(top.height_ellipsoid_m)).tolist() == [[5, 7]]
    assert top.sigma_m == 9.7


def test_srtm_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"200 bytes are no SRTM tile"):
        read_elevation(write_hgt(tmp_path / "N44W072.hgt", np.zeros((10, 10))))
    with pytest.raises(InputError, match=r"an SRTM tile named like N44W072\.hgt"):
        read_elevation(write_hgt(tmp_path / "mountain.hgt", np.zeros((10, 10))))
    tile = write_hgt(tmp_path / "N44W073.hgt", np.zeros((1201, 1201)))
    with pytest.raises(InputError, match="count from the geoid by the file's own word"):
        read_elevation(tile, "ellipsoid")


@pytest.mark.skipif(not TERRAIN.is_file(), reason="needs ../shared/data/terrain/N44W072.hgt")
def test_the_presidential_range() -> None:
    """The tile has 115 to 1908 m above the geoid; Mount Washington's summit is the highest, at 44.2706 N 71.3033 W."""
    grid = read_elevation(TERRAIN)
    undulation = undulation_m(grid)
    heights = grid.height_ellipsoid_m - undulation
    assert np.nanmin(heights) == pytest.approx(115.0, abs=LATTICE_ERROR_M + FLOAT32_M)
    assert np.nanmax(heights) == pytest.approx(1908.0, abs=LATTICE_ERROR_M + FLOAT32_M)
    assert -30.0 < undulation.mean() < -25.0
    row, column = np.unravel_index(int(np.nanargmax(heights)), heights.shape)
    longitude, latitude = grid.crs_from_grid @ [column, row, 1.0]
    assert (latitude, longitude) == pytest.approx((44.2706, -71.3033), abs=0.001)
    part = read_elevation(TERRAIN, around=(44.26, -71.32, 44.28, -71.29))
    assert part.height_ellipsoid_m.shape == (24 + 7, 36 + 7)  # a node more for rounding, two more for interpolation
    assert np.nanmax(part.height_ellipsoid_m) == pytest.approx(np.nanmax(grid.height_ellipsoid_m), abs=LATTICE_ERROR_M)


# Round trip


@pytest.mark.parametrize("crs", [UTM, "EPSG:4326", "+proj=tmerc +lat_0=35 +lon_0=139 +datum=WGS84 +units=m +type=crs"])
def test_round_trip(tmp_path: Path, crs: str) -> None:
    heights = RAMP.copy()
    heights[1, 1] = np.nan
    step = 1e-4 if crs == "EPSG:4326" else 5.0
    origin = {UTM: (380000.0, 3900000.0), "EPSG:4326": (139.0, 35.0)}.get(crs, (10.0, 20.0))
    grid = ElevationGrid(
        height_ellipsoid_m=heights,
        crs=crs,
        crs_from_grid=np.array([[step, 0.1 * step, origin[0]], [0.2 * step, -step, origin[1]]]),
        sigma_m=0.37,
        source="made here",
    )
    write_elevation(tmp_path / "out.tif", grid)
    back = read_elevation(tmp_path / "out.tif")
    np.testing.assert_array_equal(back.height_ellipsoid_m, heights)
    np.testing.assert_allclose(back.crs_from_grid, grid.crs_from_grid, rtol=0, atol=1e-8 * step)
    assert (back.sigma_m, back.source) == (0.37, "out.tif: made here")
    there = [[origin[0], origin[1], 0.0]]
    np.testing.assert_allclose(
        geographic_from_crs(np.array(there), back.crs), geographic_from_crs(np.array(there), crs), rtol=0, atol=1e-10
    )
    assert [p.name for p in tmp_path.iterdir()] == ["out.tif"]
    with pytest.raises(InputError, match="count from the ellipsoid by the file's own word"):
        read_elevation(tmp_path / "out.tif", "geoid")
