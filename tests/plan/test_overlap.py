"""Overlap on the ground: against closed formulas for level ground and for planes that slope."""

from dataclasses import replace

import numpy as np
import pytest

from tests.plan.made_requests import CAMERA, MAP
from uavkit.plan.ground import Ground, flat_ground
from uavkit.plan.imaging import Imaging
from uavkit.plan.lines import HeightRule, Mounting, StationLine, straight_line
from uavkit.plan.overlap import Neighbours, forward_overlaps, points_on_ground, side_overlaps

IMAGING = Imaging(profile=CAMERA, long_side_across=True)


def sloping(east_slope: float, north_slope: float) -> Ground:
    """A plane through height 0 at the origin of the map, on nodes 100 m apart."""
    steps = 100.0 * np.arange(-10, 11)
    heights = east_slope * steps[None, :] + north_slope * steps[:, None]
    polynomial = np.zeros((2, 10))
    polynomial[0, :2], polynomial[1, 0], polynomial[1, 2] = (10.0, 0.01), 10.0, 0.01
    return Ground(
        local_map=MAP,
        heights=heights.astype(np.float32),
        grid_from_map=polynomial,
        origin=np.array([0.0, 0.0, 1.0]),
        node_m=100.0,
        sigma_m=0.0,
        source="plane",
    )


def line(
    ground: Ground, along: list[float], height_m: float = 60.0, east_m: float = 0.0, level: bool = True
) -> StationLine:
    rule = HeightRule(above_ground_m=height_m, altitude_m=height_m if level else None, tolerance_m=0.1)
    mounting = Mounting(imaging=IMAGING, ground=ground, rule=rule, lead_m=0.0, stops=True)
    return straight_line(
        mounting,
        place=("a", 0, 0),
        start_xy=np.array([east_m, 0.0]),
        direction=np.array([0.0, 1.0]),
        along_m=np.array(along),
    )


@pytest.mark.parametrize("share", [0.05, 0.33, 0.6, 0.8, 0.97])
def test_forward_overlap_over_level_ground(share: float) -> None:
    ground = flat_ground(MAP, 0.0)
    strip = line(ground, [0.0, (1.0 - share) * IMAGING.length_m(60.0)])
    found = forward_overlaps(IMAGING, strip, points_on_ground(IMAGING, ground, strip))
    assert found[0] == pytest.approx(share, abs=1e-6)
    assert np.isnan(found[1])


@pytest.mark.parametrize("share", [0.05, 0.4, 0.6, 0.9])
def test_side_overlap_over_level_ground(share: float) -> None:
    ground = flat_ground(MAP, 0.0)
    along = [10.0 * k for k in range(-8, 9)]
    ours = line(ground, [0.0])
    beside = line(ground, along, east_m=(1.0 - share) * IMAGING.width_m(60.0))
    neighbours = Neighbours.of(np.array([0.0, 1.0]), [beside])
    found = side_overlaps(IMAGING, points_on_ground(IMAGING, ground, ours), neighbours)
    assert found[0] == pytest.approx(share, abs=1e-6)


def test_next_image_lower_by_a_tenth_sees_less_on_all_sides() -> None:
    """The second image is vertically below the first: its footprint is smaller in both directions."""
    ground = flat_ground(MAP, 0.0)
    strip = line(ground, [0.0, 1e-9])
    lowered = strip.centres_m.copy()
    lowered[1, 2] *= 0.9
    strip = replace(strip, centres_m=lowered)
    found = forward_overlaps(IMAGING, strip, points_on_ground(IMAGING, ground, strip))
    assert found[0] == pytest.approx(0.81, abs=1e-6)


@pytest.mark.parametrize("slope", [-0.8, -0.3, 0.3, 0.8])
def test_forward_overlap_up_and_down_a_slope(slope: float) -> None:
    """Level flight over a plane z = s y at height h above its middle. An image looks at y = h t / (1 + s t) for the
    tangent t; seen from a base b further on, the same ground has the tangent (y - b) / (h - s y)."""
    height, base = 60.0, 15.0
    ground = sloping(0.0, slope)
    strip = line(ground, [0.0, base])
    found = forward_overlaps(IMAGING, strip, points_on_ground(IMAGING, ground, strip))
    behind, ahead, left, _ = IMAGING.field
    t = np.linspace(-behind, ahead, 4001)
    y = height * t / (1.0 + slope * t)
    depth = height - slope * y
    along_inside = ((y - base) / depth >= -behind) & ((y - base) / depth <= ahead)
    # across nothing changes: the depth of a ground point is the same in both images
    assert left > 0.0
    assert found[0] == pytest.approx(float(np.mean(along_inside)), abs=1e-3)


def test_ground_points_lie_on_the_ground() -> None:
    ground = sloping(0.5, -0.7)
    strip = line(ground, [-50.0, 0.0, 80.0], height_m=120.0)
    points = points_on_ground(IMAGING, ground, strip).reshape(-1, 3)
    assert np.allclose(points[:, 2], 0.5 * points[:, 0] - 0.7 * points[:, 1], atol=2e-3)


def test_ray_meets_the_near_side_of_a_hill() -> None:
    """Behind a wall-like hill the ground is hidden: the ray ends on the hill, not on the plain behind it."""
    steps = np.arange(-50, 51) * 2.0
    heights = np.where(np.abs(steps - 30.0) <= 4.0, 40.0, 0.0)[None, :] * np.ones((101, 1))
    polynomial = np.zeros((2, 10))
    polynomial[0, :2], polynomial[1, 0], polynomial[1, 2] = (50.0, 0.5), 50.0, 0.5
    ground = Ground(
        local_map=MAP,
        heights=heights.astype(np.float32),
        grid_from_map=polynomial,
        origin=np.array([0.0, 0.0, 1.0]),
        node_m=2.0,
        sigma_m=0.0,
        source="wall",
    )
    strip = line(ground, [0.0], height_m=50.0)
    found = points_on_ground(IMAGING, ground, strip, np.array([[1.2, 0.0, -1.0]]))[0, 0]
    assert 20.0 < found[0] < 27.0
    assert found[2] == pytest.approx(50.0 - found[0] / 1.2, abs=2e-3)
