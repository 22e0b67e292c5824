"""Object points as PLY and LAZ, and the block as a COLMAP model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.formats.blocks import FRAME, INTERIOR, oriented_block
from uavkit.core.collinearity import image_coordinates
from uavkit.core.errors import InputError
from uavkit.core.orientation import ExteriorOrientation
from uavkit.formats.colmap_files import write_colmap_model
from uavkit.formats.point_files import point_table, write_las, write_ply


def test_table_has_determined_points_in_the_crs() -> None:
    oriented = oriented_block()
    table = point_table(oriented)
    assert len(table.coordinates) == 11
    assert np.allclose(FRAME.enu_from_crs(table.coordinates), oriented.adjustment.points_m[:11], atol=1e-5)
    assert table.rays.tolist() == [3, 3, 3, 3, 3, 2, 3, 3, 3, 3, 3]
    # the axes differ by a turn in plan of less than a degree: heights keep their sigma
    sigma_up = np.sqrt(oriented.adjustment.point_covariances_m2[:11, 2, 2])
    assert np.allclose(table.sigma_m[:, 2], sigma_up, rtol=1e-3)


def test_ply_holds_the_table(tmp_path: Path) -> None:
    oriented = oriented_block()
    write_ply(tmp_path / "points.ply", oriented)
    table = point_table(oriented)
    head, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "comment crs EPSG:32654, heights above the ellipsoid; metres" in lines
    assert "element vertex 11" in lines
    codes = {"double": "<f8", "float": "<f4", "uchar": "u1", "ushort": "<u2"}
    kind = np.dtype([(line.split()[2], codes[line.split()[1]]) for line in lines if line.startswith("property")])
    records = np.frombuffer(body, dtype=kind)
    assert np.array_equal(np.column_stack([records["x"], records["y"], records["z"]]), table.coordinates)
    assert np.array_equal(np.column_stack([records["red"], records["green"], records["blue"]]), table.colours)
    assert np.array_equal(records["rays"], table.rays)
    assert np.allclose(records["sigma_z"], table.sigma_m[:, 2])


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_holds_the_table(tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    path = tmp_path / f"points.{suffix}"
    write_las(path, oriented_block())
    table = point_table(oriented_block())
    las = laspy.read(path)
    assert np.allclose(np.column_stack([las.x, las.y, las.z]), table.coordinates, rtol=0, atol=0.00051)
    assert np.array_equal(np.column_stack([las.red, las.green, las.blue]) // 257, table.colours)
    assert np.allclose(las["sigma_x"], table.sigma_m[:, 0])
    assert np.array_equal(las["kind"], table.kinds)
    assert las.header.parse_crs().to_epsg() == 32654
    write_las(tmp_path / f"again.{suffix}", oriented_block())
    assert (tmp_path / f"again.{suffix}").read_bytes() == path.read_bytes()


def test_local_points_have_no_crs(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    oriented = oriented_block(None)
    write_las(tmp_path / "points.laz", oriented)
    las = laspy.read(tmp_path / "points.laz")
    assert las.header.parse_crs() is None
    assert np.allclose(np.column_stack([las.x, las.y, las.z]), oriented.adjustment.points_m[:11], atol=0.00051)
    write_ply(tmp_path / "points.ply", oriented)
    assert b"comment local coordinates" in (tmp_path / "points.ply").read_bytes()


def test_no_points_are_an_input_error(tmp_path: Path) -> None:
    oriented = oriented_block()
    empty = replace(oriented.adjustment, points_m=np.full((12, 3), np.nan))
    with pytest.raises(InputError, match="no object point"):
        write_las(tmp_path / "points.laz", replace(oriented, adjustment=empty))


def test_colmap_projects_as_uavkit_does(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    oriented = oriented_block()
    write_colmap_model(tmp_path, oriented)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (len(model.images), len(model.points3D)) == (3, 11)
    result = oriented.adjustment
    seen = 0
    for image in model.images.values():
        row = oriented.images.index(image.name)
        exterior = ExteriorOrientation(
            projection_centre_m=result.projection_centres_m[row], R_object_from_image=result.R_object_from_image[row]
        )
        for mark in image.points2D:
            point = model.points3D[mark.point3D_id]
            expected = image_coordinates(point.xyz[None], exterior, INTERIOR)[0]
            projected = np.asarray(image.project_point(point.xyz))
            assert np.abs(projected - 0.5 - expected).max() < 0.01
            assert np.abs(mark.xy - projected).max() < 0.01
            seen += 1
        assert np.allclose(image.projection_center(), exterior.projection_centre_m)
    assert seen == 33 - 1  # one ray is rejected
    track = model.points3D[1].track
    assert sorted(element.image_id for element in track.elements) == [1, 2, 3]


def test_colmap_refuses_what_it_cannot_hold(tmp_path: Path) -> None:
    oriented = oriented_block()
    with pytest.raises(InputError, match=r"'s 0\.jpg'"):
        write_colmap_model(tmp_path, replace(oriented, images=("s 0.jpg", "s2.jpg", "s3.jpg")))
    sheared = replace(oriented.adjustment, interior=replace(INTERIOR, b2=1e-4))
    with pytest.raises(InputError, match="shear"):
        write_colmap_model(tmp_path, replace(oriented, adjustment=sheared))
    assert list(tmp_path.iterdir()) == []
