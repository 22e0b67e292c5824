"""Exterior orientations in the axes of the CRS, and the interior orientation as TOML."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.formats.blocks import FRAME, INTERIOR, oriented_block
from uavkit.core.adjustment import Datum
from uavkit.core.angles import rotation_from_vector
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.collinearity import image_coordinates
from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame
from uavkit.core.orientation import ExteriorOrientation
from uavkit.formats.adjustment_file import write_adjustment
from uavkit.formats.orientation_files import (
    FileOrientation,
    exterior_orientations,
    read_exterior_orientations,
    write_exterior_orientations,
    write_interior_orientation,
)
from uavkit.formats.point_files import point_table, write_ply


def as_exterior(item: FileOrientation) -> ExteriorOrientation:
    return ExteriorOrientation.from_omega_phi_kappa(
        np.array(item.coordinates), *np.radians(item.omega_phi_kappa_deg).tolist()
    )


@pytest.mark.parametrize("crs", ["EPSG:32654", "EPSG:6677", "EPSG:4326"])
def test_points_of_the_crs_project_as_in_the_local_frame(tmp_path: Path, crs: str) -> None:
    frame = replace(FRAME, crs=crs)
    oriented = oriented_block(frame)
    write_exterior_orientations(tmp_path / "eo.csv", oriented)
    contents = read_exterior_orientations(tmp_path / "eo.csv")
    assert contents.crs == ("EPSG:32654" if crs == "EPSG:4326" else crs)
    in_crs = replace(FRAME, crs=contents.crs or "")
    points = oriented.adjustment.points_m[:11]
    for row, item in enumerate(contents.orientations):
        # the map's scale is not 1: shrink distances in plan to true ones about the projection centre
        place = np.array(item.coordinates)
        offsets = in_crs.crs_from_enu(points) - place
        offsets[:, :2] /= scale_of_map(in_crs)
        turned = image_coordinates(place + offsets, as_exterior(item), INTERIOR)
        expected = oriented.rays.xy_px[oriented.rays.image_index == row][:11]
        assert np.abs(turned - expected).max() < 0.02


def scale_of_map(frame: LocalFrame) -> float:
    ends = frame.crs_from_enu(np.array([[-50.0, 0, 0], [50.0, 0, 0]]))
    return float(np.linalg.norm(ends[1, :2] - ends[0, :2]) / 100.0)


def test_convergence_of_the_meridian_is_in_kappa() -> None:
    local, projected = (exterior_orientations(oriented_block(frame)) for frame in (None, FRAME))
    turn = np.degrees(np.arctan2(*FRAME.R_crs_from_enu(np.zeros(3))[:2, 0][::-1]))
    assert abs(turn) > 0.5  # west of the central meridian of zone 54
    for one, two in zip(local.orientations, projected.orientations, strict=True):
        difference = (two.omega_phi_kappa_deg[2] - one.omega_phi_kappa_deg[2] + 180) % 360 - 180
        assert difference == pytest.approx(turn, abs=0.05)


def test_sigmas_are_those_of_simulated_scatter() -> None:
    """Draw orientations from the block's own covariance; the scatter of the file's values is the file's sigma."""
    oriented = oriented_block()
    result, rng, count = oriented.adjustment, np.random.default_rng(1), 800
    stated = exterior_orientations(oriented).orientations[1]
    draws = rng.multivariate_normal(np.zeros(6), result.exterior_covariances[1] * 0.01, count)
    centres = result.projection_centres_m[1] + draws[:, :3]
    rotations = result.R_object_from_image[1] @ rotation_from_vector(draws[:, 3:])
    many = replace(
        oriented,
        images=tuple(f"d{i}" for i in range(count)),
        adjustment=replace(
            result,
            projection_centres_m=centres,
            R_object_from_image=rotations,
            exterior_covariances=np.broadcast_to(result.exterior_covariances[1], (count, 6, 6)),
        ),
    )
    drawn = exterior_orientations(many).orientations
    scatter_m = np.std([item.coordinates for item in drawn], axis=0) * 10
    scatter_deg = np.std([item.omega_phi_kappa_deg for item in drawn], axis=0) * 10
    # a standard deviation of 800 draws is known to 2.5 %; 11 % is 4.4 sigma
    assert np.allclose(scatter_m / stated.sigma_m, 1.0, atol=0.11)
    assert np.allclose(scatter_deg / stated.sigma_deg, 1.0, atol=0.11)


def test_file_and_head(tmp_path: Path) -> None:
    oriented = oriented_block()
    write_exterior_orientations(tmp_path / "eo.csv", oriented)
    lines = (tmp_path / "eo.csv").read_text().splitlines()
    assert lines[:3] == [
        "# uavkit exterior orientation",
        "# crs: EPSG:32654",
        "# heights: above the ellipsoid of WGS 84, in metres",
    ]
    assert lines[7] == (
        "image,easting,northing,height_ellipsoid_m,omega_deg,phi_deg,kappa_deg,"
        "sigma_easting_m,sigma_northing_m,sigma_height_m,sigma_omega_deg,sigma_phi_deg,sigma_kappa_deg"
    )
    exact, back = exterior_orientations(oriented), read_exterior_orientations(tmp_path / "eo.csv")
    for one, two in zip(exact.orientations, back.orientations, strict=True):
        assert one.image == two.image
        assert np.allclose(one.coordinates, two.coordinates, rtol=0, atol=6e-6)
        assert np.allclose(one.omega_phi_kappa_deg, two.omega_phi_kappa_deg, rtol=0, atol=6e-9)
        assert np.allclose(one.sigma_m, two.sigma_m, rtol=0, atol=6e-6)
        assert np.allclose(one.sigma_deg, two.sigma_deg, rtol=0, atol=6e-8)


def test_a_free_network_says_that_it_is_local(tmp_path: Path) -> None:
    write_exterior_orientations(tmp_path / "eo.csv", oriented_block(None))
    text = (tmp_path / "eo.csv").read_text()
    assert "# crs: none (local" in text
    assert "image,east_m,north_m,up_m" in text
    contents = read_exterior_orientations(tmp_path / "eo.csv")
    assert contents.crs is None
    assert np.allclose(contents.orientations[1].coordinates, (12.0, 1.0, 61.0))


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("# crs: EPSG:32654", "#", "states no '# crs:'"),
        ("image,easting,", "image,east,", "header"),
        ("s2.jpg,", "s2.jpg,x", "line 10: could not convert"),
        ("s2.jpg,", "s2.jpg,1,", "line 10: 14 cells"),
    ],
)
def test_files_that_do_not_fit(tmp_path: Path, old: str, new: str, words: str) -> None:
    write_exterior_orientations(tmp_path / "eo.csv", oriented_block())
    text = (tmp_path / "eo.csv").read_text()
    assert old in text
    (tmp_path / "eo.csv").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"eo\.csv: .*{words}"):
        read_exterior_orientations(tmp_path / "eo.csv")


def test_interior_orientation_as_toml(tmp_path: Path) -> None:
    oriented = oriented_block()
    write_interior_orientation(tmp_path / "io.toml", oriented)
    content = tomllib.loads((tmp_path / "io.toml").read_text())
    covariance = oriented.adjustment.interior_covariance
    assert [content["interior"][name] for name in INTERIOR_PARAMETERS] == INTERIOR.parameters().tolist()
    assert content["interior"]["width_px"] == 1000
    assert content["sigmas"]["x0_px"] == np.sqrt(covariance[1, 1])
    assert content["sigmas"]["b2"] == 0.0
    expected = covariance[1, 6] / np.sqrt(covariance[1, 1] * covariance[6, 6])
    assert content["correlations"]["x0_px"]["p1"] == pytest.approx(expected, abs=6e-5)
    assert content["undetermined"] == ["k3"]
    assert content["camera"] == "test"


def test_a_free_network_of_a_block_with_a_frame_claims_no_place(tmp_path: Path) -> None:
    """Two control points give the block a frame, but the result has arbitrary position and scale."""
    georeferenced = oriented_block()
    assert exterior_orientations(georeferenced).crs == FRAME.crs
    free = replace(georeferenced, adjustment=replace(georeferenced.adjustment, datum=Datum.FREE_NETWORK))
    assert exterior_orientations(free).crs is None
    assert point_table(free).crs is None
    write_adjustment(tmp_path / "adjustment.json", free)
    assert json.loads((tmp_path / "adjustment.json").read_text())["crs"] is None
    write_ply(tmp_path / "points.ply", free)
    assert b"of arbitrary position, direction and scale" in (tmp_path / "points.ply").read_bytes()
