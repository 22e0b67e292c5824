"""Records and tables are checked at birth: shapes, sigmas, names, places."""

from typing import Any

import numpy as np
import pytest

from uavkit.core.arrays import content_hash
from uavkit.core.errors import did_you_mean
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import ControlObservations, GnssObservations, Rays
from uavkit.core.points import CheckPoint, ControlPoint, ImageMark
from uavkit.core.records import GnssFix

ROWS = np.arange(3)


def rays() -> Rays:
    return Rays(image_index=ROWS, point_index=ROWS, xy_px=np.arange(6.0).reshape(3, 2), sigma_px=np.ones((3, 2)))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"point_index": ROWS[:2]}, "Rays.point_index"),
        ({"xy_px": np.zeros((2, 3))}, "Rays.xy_px"),
        ({"sigma_px": np.ones(3)}, "Rays.sigma_px"),
        ({"sigma_px": np.zeros((3, 2))}, "sigma_px > 0"),
        ({"sigma_px": np.full((3, 2), np.nan)}, "sigma_px > 0"),
    ],
)
def test_rays_of_unequal_length_or_without_sigma_are_refused(changed: dict[str, Any], named: str) -> None:
    columns = {name: getattr(rays(), name) for name in ("image_index", "point_index", "xy_px", "sigma_px")}
    with pytest.raises(ValueError, match=named):
        Rays(**{**columns, **changed})


def test_rays_are_chosen_by_mask_or_row() -> None:
    chosen = rays().where(np.array([True, False, True]))
    assert len(chosen) == 2
    assert chosen.xy_px[1] == pytest.approx([4.0, 5.0])
    assert list(rays().where(np.array([2, 0])).point_index) == [2, 0]


def test_gnss_and_control_observations_are_checked() -> None:
    positions = np.zeros((3, 3))
    with pytest.raises(ValueError, match=r"GnssObservations\.flight"):
        GnssObservations(image_index=ROWS, position_m=positions, sigma_m=np.ones((3, 3)), flight=ROWS[:1])
    with pytest.raises(ValueError, match="sigma_m > 0"):
        GnssObservations(image_index=ROWS, position_m=positions, sigma_m=positions, flight=ROWS)
    with pytest.raises(ValueError, match=r"ControlObservations\.position_m"):
        ControlObservations(point_index=ROWS, position_m=positions.ravel(), sigma_m=np.ones((3, 3)))
    with pytest.raises(ValueError, match="sigma_m > 0"):
        ControlObservations(point_index=ROWS, position_m=positions, sigma_m=-np.ones((3, 3)))
    nothing = np.zeros(0, dtype=np.int64)
    assert len(ControlObservations(point_index=nothing, position_m=np.zeros((0, 3)), sigma_m=np.zeros((0, 3)))) == 0


@pytest.mark.parametrize("sigma_m", [(0.01, 0.0, 0.01), (0.01, 0.01, -1.0), (0.01, float("nan"), 0.01)])
def test_a_surveyed_point_needs_sigmas(sigma_m: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="P7: sigma_m"):
        ControlPoint(name="P7", position_m=(0.0, 0.0, 0.0), sigma_m=sigma_m, marks=())


def test_control_and_check_points_are_not_the_same_thing() -> None:
    values: dict[str, Any] = {"name": "P7", "position_m": (1.0, 2.0, 3.0), "sigma_m": (0.01, 0.01, 0.02), "marks": ()}
    control: object = ControlPoint(**values)
    assert control != CheckPoint(**values)


@pytest.mark.parametrize("sigma_px", [0.0, -0.5, float("nan")])
def test_a_mark_needs_a_sigma(sigma_px: float) -> None:
    with pytest.raises(ValueError, match=r"mark in a\.jpg"):
        ImageMark(image="a.jpg", column_px=1.0, row_px=2.0, sigma_px=sigma_px)


@pytest.mark.parametrize("place", [(91.0, 0.0), (0.0, 181.0), (float("nan"), 0.0)])
def test_a_fix_lies_on_earth(place: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="no such place"):
        GnssFix(
            gps_time_ns=None, latitude_deg=place[0], longitude_deg=place[1], height_m=0.0,
            height_datum=HeightDatum.ELLIPSOID,
        )  # fmt: skip


def test_content_hash_tells_values_types_shapes_and_borders_apart() -> None:
    row = np.arange(6.0)
    hashes = {
        content_hash([row]),
        content_hash([row.reshape(2, 3)]),
        content_hash([row.astype(np.float32)]),
        content_hash([np.arange(6)]),
        content_hash(["ab", "c"]),
        content_hash(["a", "bc"]),
        content_hash(["abc"]),
        content_hash([]),
    }
    assert len(hashes) == 8
    assert content_hash([np.arange(12.0)[::2]]) == content_hash([np.arange(12.0)[::2].copy()])
    assert content_hash([b"ab"]) == content_hash(["ab"])


def test_advice_names_the_nearest_word_or_says_nothing() -> None:
    assert did_you_mean("side_overlp", ["forward_overlap", "side_overlap"]) == "; did you mean 'side_overlap'?"
    assert did_you_mean("zzz", ["forward_overlap"]) == ""
