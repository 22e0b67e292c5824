"""Frames: exact there and back everywhere, known coordinates, and refusal where a transformation is not exact."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavkit.core.errors import InputError
from uavkit.core.frames import LocalFrame, geographic_from_crs, geoid_undulation_m, parse_crs, utm_crs

SITE = LocalFrame.at(35.8, 139.65, 45.0)


@settings(deadline=None)
@given(
    st.floats(-89.9, 89.9), st.floats(-180.0, 180.0), st.floats(-400.0, 3000.0),
    st.tuples(st.floats(-20_000.0, 20_000.0), st.floats(-20_000.0, 20_000.0), st.floats(-1000.0, 1000.0)),
)  # fmt: skip
def test_east_north_up_goes_to_geographic_and_back(
    latitude_deg: float, longitude_deg: float, height_m: float, enu: tuple[float, float, float]
) -> None:
    frame = LocalFrame.at(latitude_deg, longitude_deg, height_m, "EPSG:4326")
    enu_m = np.array([enu])
    assert frame.enu_from_geographic(*frame.geographic_from_enu(enu_m).T) == pytest.approx(enu_m, abs=1e-6)


def test_axes_of_the_local_frame() -> None:
    north_east_up = SITE.enu_from_geographic(
        np.array([35.8, 35.8001, 35.8, 35.8]),
        np.array([139.65, 139.65, 139.6501, 139.65]),
        np.array([45.0, 45.0, 45.0, 55.0]),
    )
    assert north_east_up[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-8)
    # One degree of latitude is 110 958 m there (meridian radius 6 357 418 m), one of longitude 90 394 m.
    assert north_east_up[1] == pytest.approx([0.0, 11.0958, 0.0], abs=2e-4)
    assert north_east_up[2] == pytest.approx([9.0394, 0.0, 0.0], abs=3e-4)
    assert north_east_up[3] == pytest.approx([0.0, 0.0, 10.0], abs=1e-8)


def test_the_earth_is_not_flat() -> None:
    (far,) = SITE.enu_from_geographic(np.array([35.9]), np.array([139.65]), np.array([45.0]))
    distance = far[1]
    assert far[2] == pytest.approx(-(distance**2) / (2.0 * 6_357_400.0), rel=1e-3)


def test_known_utm_values() -> None:
    """On the central meridian easting is 500 km and northing 0.9996 times the length of the meridian."""
    frame = LocalFrame.at(0.0, 141.0, 0.0)
    assert frame.crs == "EPSG:32654"
    assert frame.crs_from_enu(np.zeros((1, 3)))[0] == pytest.approx([500_000.0, 0.0, 0.0], abs=1e-6)
    middle = LocalFrame.at(45.0, 141.0, 0.0).crs_from_enu(np.zeros((1, 3)))[0]
    assert middle == pytest.approx([500_000.0, 0.9996 * 4_984_944.378, 0.0], abs=2e-3)  # arc to 45 degrees on WGS 84


def test_crs_goes_to_local_and_back() -> None:
    enu_m = np.array([[0.0, 0.0, 0.0], [120.0, -80.0, 15.0], [-3000.0, 2500.0, 300.0]])
    for crs in ("EPSG:32654", "EPSG:6677", "EPSG:4326", "WGS84 UTM 53N", "+proj=utm +zone=54 +datum=WGS84"):
        frame = LocalFrame.at(35.8, 139.65, 45.0, crs)
        assert frame.enu_from_crs(frame.crs_from_enu(enu_m)) == pytest.approx(enu_m, abs=1e-5)


def test_easting_comes_first_even_where_the_authority_puts_northing_first() -> None:
    """EPSG:6677 (Japan, zone IX, origin 36 N, 139 50 E) is defined with X = north: files here are easting, northing."""
    east, north, _ = LocalFrame.at(35.8, 139.65, 0.0, "EPSG:6677").crs_from_enu(np.zeros((1, 3)))[0]
    assert (east, north) == pytest.approx((-16_570.0, -22_170.0), abs=60.0)


@pytest.mark.parametrize("latitude_deg", [-60.0, -20.0, 10.0, 35.8, 60.0])
def test_meridian_convergence(latitude_deg: float) -> None:
    """East of the central meridian, north of the equator, grid north lies east of true north: sin(latitude) dlon.

    So an axis to true north points west of grid north (negative easting).
    """
    off_deg = 1.5
    frame = LocalFrame.at(latitude_deg, 141.0 + off_deg, 0.0, "EPSG:32654" if latitude_deg > 0 else "EPSG:32754")
    R_crs_from_enu = frame.R_crs_from_enu(np.zeros(3))
    convergence = np.arctan2(-R_crs_from_enu[0, 1], R_crs_from_enu[1, 1])
    assert convergence == pytest.approx(np.sin(np.radians(latitude_deg)) * np.radians(off_deg), rel=1e-3)
    assert np.abs(R_crs_from_enu @ R_crs_from_enu.T - np.eye(3)).max() < 1e-12


def test_axes_turn_with_the_curvature_of_the_earth() -> None:
    """Ten kilometres north of the origin the vertical leans north by distance / radius: its ENU has a north part."""
    frame = LocalFrame.at(35.8, 141.0, 0.0)
    local_up_in_enu = frame.R_crs_from_enu(np.array([0.0, 10_000.0, 0.0]))[2]
    assert local_up_in_enu == pytest.approx([0.0, 10_000.0 / 6_357_400.0, 1.0], abs=5e-6)


def test_geographic_coordinates_have_the_axes_of_the_local_frame() -> None:
    frame = LocalFrame.at(60.0, 10.0, 0.0, "EPSG:4326")
    assert frame.R_crs_from_enu(np.zeros(3)) == pytest.approx(np.eye(3), abs=1e-6)


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "undulation_m"),
    [
        (0.0, 0.0, 17.16),
        (90.0, 0.0, 13.61),
        (-90.0, 0.0, -29.53),
        (38.6281550, 269.7791550, -31.628),  # the test points that NGA published with EGM96
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ],
)
def test_undulation_of_egm96(latitude_deg: float, longitude_deg: float, undulation_m: float) -> None:
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    got = geoid_undulation_m(np.array([latitude_deg]), np.array([longitude]))
    assert got[0] == pytest.approx(undulation_m, abs=0.1)


def test_the_geoid_is_continuous_where_longitudes_meet() -> None:
    east, west = geoid_undulation_m(np.array([10.0, 10.0]), np.array([180.0, -180.0]))
    assert east == pytest.approx(west, abs=1e-6)


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:27700",  # British National Grid: its grid is not shipped, the rest is good to metres
        "EPSG:30169",  # Tokyo datum: 9 m without its grid
        "EPSG:31467",  # DHDN
        "EPSG:26918",  # NAD83 of 1986
        "EPSG:32654+5773",  # EGM96 heights by a grid that is not shipped with PROJ
        "EPSG:6697",  # JGD2011 with heights of Japan's own geoid
        "EPSG:7405",  # British National Grid with Newlyn heights
    ],
)
def test_an_inexact_transformation_is_refused(crs: str) -> None:
    inside = {
        "EPSG:27700": (400_000.0, 300_000.0),
        "EPSG:30169": (0.0, 0.0),
        "EPSG:31467": (3_500_000.0, 5_500_000.0),
        "EPSG:26918": (500_000.0, 4_500_000.0),
        "EPSG:32654+5773": (400_000.0, 3_960_000.0),
        "EPSG:6697": (139.7, 35.7),
        "EPSG:7405": (400_000.0, 300_000.0),
    }
    with pytest.raises(InputError, match="a grid is missing"):
        geographic_from_crs(np.array([[*inside[crs], 10.0]]), crs)


@pytest.mark.parametrize(
    ("crs", "easting_m", "northing_m"),
    [
        ("EPSG:2056", 2_600_000.0, 1_200_000.0),  # Switzerland, on Bessel's ellipsoid
        ("EPSG:25832", 500_000.0, 5_500_000.0),
        ("EPSG:7856", 500_000.0, 6_250_000.0),  # Australia 2020
        ("EPSG:6677", -10_000.0, -20_000.0),
    ],
)
def test_heights_are_those_of_wgs84_whatever_the_ellipsoid_of_the_plane_coordinates(
    crs: str, easting_m: float, northing_m: float
) -> None:
    given_m = np.array([[easting_m, northing_m, 520.0]])
    (place,) = geographic_from_crs(given_m, crs)
    assert place[2] == pytest.approx(520.0, abs=1e-4)
    frame = LocalFrame.at(place[0], place[1], place[2], crs)
    assert frame.crs_from_enu(np.zeros((1, 3))) == pytest.approx(given_m, abs=1e-4)


def test_bern_is_where_it_is() -> None:
    """The old observatory, fundamental point of Switzerland: E 2 600 000, N 1 200 000 is 46.951083 N, 7.438632 E."""
    (place,) = geographic_from_crs(np.array([[2_600_000.0, 1_200_000.0, 600.0]]), "EPSG:2056")
    assert place[:2] == pytest.approx([46.951083, 7.438632], abs=1e-5)


def test_what_does_not_fit_is_refused_and_named() -> None:
    with pytest.raises(InputError, match="do not fit EPSG:32654"):
        geographic_from_crs(np.array([[3.96e9, 4.0e9, 10.0]]), "EPSG:32654")
    with pytest.raises(InputError, match="no coordinate reference system"):
        LocalFrame.at(0.0, 0.0, 0.0, "EPSG:999999")
    with pytest.raises(InputError, match="1 to 60 followed by N or S"):
        parse_crs("WGS84 UTM 61N")


@pytest.mark.parametrize(
    ("text", "code"),
    [("32654", 32654), ("EPSG:32654", 32654), ("WGS84 UTM 54N", 32654), ("wgs84 / utm 21s", 32721)],
)
def test_names_of_reference_systems(text: str, code: int) -> None:
    assert parse_crs(text).to_epsg() == code


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "crs"),
    [
        (35.8, 139.65, "EPSG:32654"),
        (-35.8, 139.65, "EPSG:32754"),
        (0.0, -180.0, "EPSG:32601"),
        (0.0, 180.0, "EPSG:32601"),
        (0.0, 179.9, "EPSG:32660"),
        (10.0, -0.1, "EPSG:32630"),
    ],
)
def test_the_utm_zone_of_a_place(latitude_deg: float, longitude_deg: float, crs: str) -> None:
    assert utm_crs(latitude_deg, longitude_deg) == crs
