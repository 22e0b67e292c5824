"""Positions that name their images: joined by name alone, weighed as stated, their shift held as tightly as RTK is."""

from dataclasses import replace

import numpy as np
import pytest

from tests.ingest.test_build_block import HERE, STATIONS, block_of, points, told
from uavkit.core.errors import InputError
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.positions_file import ImagePositions

NAMES = tuple(f"R{n:03d}.jpg" for n in range(4))


def positions(names: tuple[str, ...] = NAMES, sigma_m: float = 0.02, **more: object) -> ImagePositions:
    """The stations of the test flight, east 1.0, north 1.2 and up 1.5 times a sigma."""
    places = HERE.geographic_from_enu(STATIONS).tolist()
    fixes = tuple(
        GnssFix(
            gps_time_ns=None,
            latitude_deg=a,
            longitude_deg=b,
            height_m=c,
            height_datum=HeightDatum.ELLIPSOID,
            sigma_horizontal_m=1.1 * sigma_m,
            sigma_vertical_m=1.5 * sigma_m,
            sigma_east_north_m=(sigma_m, 1.2 * sigma_m),
            name=name,
        )
        for name, (a, b, c) in zip(names, places, strict=True)
    )
    return replace(ImagePositions(fixes=fixes, lines=tuple(range(2, 6)), source="p.csv"), **more)


def test_names_count_whatever_the_order() -> None:
    """Listed backwards, without ending and in other letters, each position finds its still."""
    listed = positions(tuple(name.removesuffix(".jpg").lower() for name in NAMES))
    backwards = replace(listed, fixes=listed.fixes[::-1])
    block = block_of(positions=backwards)
    expected = block.frame.enu_from_geographic(*HERE.geographic_from_enu(STATIONS).T)
    assert np.allclose(block.gnss.position_m, expected, atol=1e-6)
    assert np.allclose(block.gnss.sigma_m, [0.02, 0.024, 0.03])


def test_strange_names_are_told_and_never_joined_by_order() -> None:
    block = block_of(positions=positions(("R000.jpg", "X1.jpg", "R002.jpg", "X3.jpg")))
    assert block.gnss.image_index.tolist() == [0, 2]
    assert "p.csv: line 3: X1.jpg: no such still" in told(block)
    assert "2 stills without a position: R001.jpg, R003.jpg" in told(block)


def test_another_flights_positions_are_refused() -> None:
    with pytest.raises(InputError, match=r"p\.csv: no position bears the name of a still .*X0"):
        block_of(positions=positions(("X0", "X1", "X2", "X3")))


def test_two_positions_of_one_still_are_refused() -> None:
    with pytest.raises(InputError, match=r"p\.csv: lines 2 and 3 both give a position of R000\.jpg"):
        block_of(positions=positions(("R000.jpg", "R000", "R002.jpg", "R003.jpg")))


def test_the_shift_of_rtk_is_held_as_tightly_as_its_fixes() -> None:
    block = block_of(positions=positions())
    assert block.gnss.shift_sigma_m == pytest.approx((0.02, 0.024, 0.03))
    assert "held to zero within 0.03 m" in told(block)


def test_control_frees_the_shift_of_rtk_and_coarse_positions_keep_the_default() -> None:
    assert block_of(positions=positions(), control=points()).gnss.shift_sigma_m is None
    assert block_of(positions=positions(sigma_m=0.5)).gnss.shift_sigma_m is None


def test_a_stated_shift_counts() -> None:
    stated = (0.002, 0.003, 0.004)
    assert block_of(positions=positions(shift_sigma_m=stated)).gnss.shift_sigma_m == stated
    assert block_of(positions=positions(shift_sigma_m=stated), control=points()).gnss.shift_sigma_m == stated
