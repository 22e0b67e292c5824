"""Ground that repeats itself: it is recognised, and tracked over several periods right or not at all."""

import cv2
import numpy as np
import pytest

from tests.process.video_of_truth import FIELD_S, MARGIN, OVER, SHAPE, Scene, fields, make_scene, positions, straight
from uavkit.process.orientation_code import (
    PointMatches,
    orientation_codes,
    packed_codes,
    richness,
    select_points,
)
from uavkit.process.repetition import repeat_shifts, tone_costs, tone_of, wide_motion
from uavkit.process.tracking import (
    TimedPicture,
    TrackingResult,
    _Alignment,
    _by_region,
    _climbed,
    _Found,
    _Judge,
    square_field,
    start,
    track,
)

PLANTS_PX, ROWS_PX = 10.0, 18.0
SECONDS = 2.5
FIRST_AFTER = 36
"""Field after the shutter's black: 0.6 s."""


def rows_of_plants(rng: np.random.Generator, tone: float) -> Scene:
    """Plants 10 px apart in rows 18 px apart, and tone that does not repeat; flat."""
    height, width = ((size + 2 * MARGIN) * OVER for size in SHAPE)
    y, x = (values / OVER for values in np.indices((height, width), dtype=np.float32))
    plants = np.cos(2 * np.pi * x / PLANTS_PX) + np.cos(4 * np.pi * x / PLANTS_PX + 1.0)
    periodic = (1 + np.cos(2 * np.pi * y / ROWS_PX)) * plants + 0.8 * np.cos(4 * np.pi * y / ROWS_PX + 0.5)
    grey = 120 + 30 * periodic / periodic.std()
    for sigma_px in (4.0, 20.0):
        layer = cv2.GaussianBlur(rng.normal(0, 1, (height, width)).astype(np.float32), (0, 0), sigma_px * OVER)
        grey += tone * layer / layer.std()
    return Scene(grey.astype(np.float32), np.zeros((height // OVER, width // OVER), np.float32))


def followed(scene: Scene, shift_px: tuple[float, float]) -> tuple[TrackingResult, np.ndarray]:
    """Track over the black and half a second further; the result and the errors of all points."""
    pose = straight(shift_px, SECONDS, sway_px=1.0)
    pictures = [
        TimedPicture(image=square_field(lines, parity), time_s=t)
        for number, (parity, lines, t) in enumerate(fields(scene, pose, FIRST_AFTER + 30, np.random.default_rng(3)))
        if number == 0 or number >= FIRST_AFTER
    ]
    points = select_points(richness(orientation_codes(pictures[0].image), 25, 0.5), 32, 1, 40)
    result = track(pictures, points, rng=np.random.default_rng(0))
    return result, np.hypot(*(result.points_px - positions(scene, points, pose(result.time_s))).T)


def picture_of(scene: Scene) -> np.ndarray:
    """The first field, of square pixels."""
    parity, lines, _ = next(fields(scene, straight((0.0, 0.0), 1.0), 1, np.random.default_rng(0)))
    return square_field(lines, parity)


def test_rows_of_plants_repeat_themselves_and_ordinary_ground_does_not():
    shifts = repeat_shifts(picture_of(rows_of_plants(np.random.default_rng(1), 4.0)))
    assert len(shifts) > 0
    off = np.abs(shifts / [PLANTS_PX, ROWS_PX] - np.rint(shifts / [PLANTS_PX, ROWS_PX]))
    assert off.max() <= 1.0 / PLANTS_PX  # whole periods, to a pixel
    assert len(repeat_shifts(picture_of(make_scene(np.random.default_rng(1))))) == 0


@pytest.mark.parametrize("shift_px", [(130.0, 30.0), (-160.0, 60.0)])
def test_a_jump_of_several_periods_is_tracked_right(shift_px):
    jump_px = np.array(shift_px) * FIRST_AFTER * FIELD_S / SECONDS
    assert np.abs(jump_px).max() > 3 * PLANTS_PX
    result, error_px = followed(rows_of_plants(np.random.default_rng(2), 4.0), shift_px)
    assert result.alive.mean() > 0.4
    assert np.mean(error_px[result.alive] < 2.0) > 0.95


def test_without_anything_that_does_not_repeat_nothing_is_found():
    result, error_px = followed(rows_of_plants(np.random.default_rng(2), 0.0), (130.0, 30.0))
    assert not np.any(result.alive & (error_px > 2.0))


def test_wide_motion_tells_the_period():
    scene, pose = rows_of_plants(np.random.default_rng(4), 4.0), straight((36.0, -22.0), 1.0, sway_px=0.0)
    two = [
        square_field(lines, parity) for parity, lines, _ in fields(scene, pose, 61, np.random.default_rng(0), every=60)
    ]
    motion, likeness = wide_motion(two[0], two[1])
    assert likeness > 0.5
    truth = np.array([36.0, -22.0]) * 60 * FIELD_S
    middle = motion[:, :2] @ [319.5, 239.5] + motion[:, 2] - [319.5, 239.5]
    assert np.abs(middle - truth).max() < PLANTS_PX / 2


def test_tone_costs_nothing_at_the_same_place_and_much_elsewhere():
    tone = tone_of(picture_of(rows_of_plants(np.random.default_rng(5), 8.0)))
    places = np.array([[200.0, 200.0], [400.0, 240.0], [320.0, 300.0]])
    unit = np.tile(np.eye(2), (3, 1, 1))
    assert np.all(tone_costs(tone, tone, places, places, unit) < 1e-6)
    assert np.all(tone_costs(tone, tone, places, places + [3 * PLANTS_PX, 2 * ROWS_PX], unit) > 0.2)
    assert np.isnan(tone_costs(tone, tone, places[:1] * 0, places[:1], unit[:1])).all()


def test_a_side_that_slipped_a_period_is_put_right():
    """From a motion whose one side is a period off, all between adapted to it, the right one is found."""
    scene, pose = rows_of_plants(np.random.default_rng(2), 4.0), straight((60.0, 20.0), SECONDS, sway_px=0.0)
    (_, first, _), (parity, lines, time_s) = fields(scene, pose, 31, np.random.default_rng(3), every=30)
    before, after = square_field(first, 0), square_field(lines, parity)
    points = select_points(richness(orientation_codes(before), 25, 0.5), 32, 1, 40)
    state = start(TimedPicture(image=before, time_s=0.0), points)
    judge = _Judge(packed_codes(after), tone_of(after), None)
    slipped = np.array([[1.0 + PLANTS_PX / 640, 0.0, 60.0 * time_s / SECONDS], [0.0, 1.0, 20.0 * time_s / SECONDS]])
    ways = _climbed(state, judge, [slipped], np.random.default_rng(0))
    truth = positions(scene, points, pose(time_s))
    assert np.mean(np.hypot(*(ways[0].found.points_px - truth).T) < 2.0) > 0.95


def test_each_region_goes_the_way_that_is_cheapest_there():
    """Two alignments, each right on one side of the picture, make one that is right everywhere."""
    points = np.stack(np.meshgrid(np.arange(40.0, 600.0, 20.0), np.arange(40.0, 440.0, 20.0)), axis=-1).reshape(-1, 2)
    state = start(TimedPicture(image=picture_of(rows_of_plants(np.random.default_rng(1), 4.0)), time_s=0.0), points)
    rng, left = np.random.default_rng(4), points[:, 0] < 320
    unit, right_px = np.eye(2, 3), points + [3.0, 1.0]
    ways = []
    for side in (left, ~left):
        found_px = np.where(side[:, None], right_px, right_px + [PLANTS_PX, 0.0])
        everything = np.ones(len(points))
        matches = PointMatches(
            points_px=found_px,
            dissimilarity=everything,
            ambiguity=everything,
            on_rim=everything < 0,
            coded_share=everything,
        )
        found = _Found(
            matches=matches, good=everything > 0, points_px=found_px, step=unit, residuals_px=found_px - points
        )
        ways.append(_Alignment(unit, rng.normal(np.where(side, 1.4, 1.6), 0.5), found))
    (whole,) = _by_region(state, ways, rng)
    wrong = np.hypot(*(whole.found.points_px - right_px).T) > 1.0
    assert np.mean(wrong) < 0.1
    assert not wrong[np.abs(points[:, 0] - 320) > 100].any()
