"""Heights of different datums neither add nor compare."""

from itertools import permutations

import numpy as np
import pytest

from uavkit.core.errors import InputError
from uavkit.core.frames import ellipsoid_heights_m
from uavkit.core.heights import Height, HeightDatum

KNOWN = (HeightDatum.ELLIPSOID, HeightDatum.GEOID, HeightDatum.GROUND)


@pytest.mark.parametrize("datum", KNOWN)
def test_heights_of_one_datum_subtract(datum: HeightDatum) -> None:
    upper, lower = Height(value_m=15.5, datum=datum), Height(value_m=5.0, datum=datum)
    assert upper.minus(lower) == pytest.approx(10.5)


@pytest.mark.parametrize(("one", "other"), list(permutations(HeightDatum, 2)))
def test_heights_of_two_datums_do_not(one: HeightDatum, other: HeightDatum) -> None:
    with pytest.raises(ValueError, match=f"{other.value} height from a {one.value} height"):
        Height(value_m=1.0, datum=one).minus(Height(value_m=1.0, datum=other))


def test_unknown_heights_do_not_even_among_themselves() -> None:
    unknown = Height(value_m=1.0, datum=HeightDatum.UNKNOWN)
    with pytest.raises(ValueError, match="unknown"):
        unknown.minus(unknown)


def test_geoid_heights_become_ellipsoidal_by_the_undulation_and_others_stay() -> None:
    place = (np.array([0.0]), np.array([0.0]), np.array([100.0]))
    assert ellipsoid_heights_m(*place, HeightDatum.GEOID) == pytest.approx([117.16], abs=0.05)
    assert ellipsoid_heights_m(*place, HeightDatum.ELLIPSOID) == pytest.approx([100.0])
    assert ellipsoid_heights_m(*place, HeightDatum.UNKNOWN) == pytest.approx([100.0])


def test_heights_above_ground_are_refused_as_absolute_heights() -> None:
    with pytest.raises(InputError, match="ellipsoid or geoid"):
        ellipsoid_heights_m(np.array([0.0]), np.array([0.0]), np.array([15.0]), HeightDatum.GROUND)
