"""Points through the video: a plane with texture under a camera, stills and video of known truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import pytest

from tests.process.made_blocks import MadeStills
from tests.process.video_of_truth import MARGIN, OVER, SHAPE, Pose, Scene, make_scene, render, straight
from uavkit.core.arrays import Array, Image
from uavkit.core.block import StillInVideo, VideoSync
from uavkit.core.progress import silent
from uavkit.core.records import FieldOrder, VideoFrame, VideoInfo
from uavkit.core.result import PointOrigin
from uavkit.core.video import AffineTransformation
from uavkit.process.options import CandidateOptions, MeasurementOptions
from uavkit.process.pictures import PictureStore, PyramidStore
from uavkit.process.video_points import (
    LEAST_THROUGH_VIDEO,
    VideoInput,
    candidates_through_video,
    extend_motion,
    still_as_video,
    track_between_stills,
)

INTERVAL_NS = 33_366_667
STILL_FROM_VIDEO = AffineTransformation(matrix=2.0 * np.eye(2), shift=np.array([60.5, 40.5]))
STILL_SHAPE = (1040, 1400)
EXPOSURES = (2, 24, 46)
"""Frames in which the stills are taken; that frame and the next are black."""
POSE = straight((150.0, -60.0), 48 * INTERVAL_NS * 1e-9, turn_deg=14.0, scale=1.06, sway_px=2.0)


def _grey(picture: np.ndarray, rng: np.random.Generator) -> Image:
    return np.clip(np.round(picture + rng.normal(0, 2.0, picture.shape)), 0, 255).astype(np.uint8)


def _still(scene: Scene, pose: tuple[Array, Array], rng: np.random.Generator) -> Image:
    """The same scene in the still's finer and wider picture: one resampling of the raster."""
    A, _ = pose
    still_from_raster = STILL_FROM_VIDEO.matrix @ A[:, :2] / OVER
    shift = STILL_FROM_VIDEO.apply((A[:, :2] @ np.array([-MARGIN, -MARGIN]) + A[:, 2])[None])[0]
    matrix = np.column_stack([still_from_raster, shift])
    grey = cv2.warpAffine(scene.grey, matrix, STILL_SHAPE[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return _grey(grey, rng)


@dataclass
class MadeVideo:
    """A VideoSource in memory; frames are rendered when they are first asked for."""

    scene: Scene
    pose: Pose
    order: FieldOrder
    black: frozenset[int]
    kept: dict[int, Image] = field(default_factory=dict)

    def info(self) -> VideoInfo:
        return VideoInfo(
            name="made", width_px=SHAPE[1], height_px=SHAPE[0], frame_interval_ns=INTERVAL_NS, field_order=self.order,
            frame_count=50,
        )  # fmt: skip

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[VideoFrame]:
        for index in range(first, 50 if last is None else last + 1):
            if index not in self.kept:
                self.kept[index] = self._luminance(index)
            yield VideoFrame(index=index, time_ns=index * INTERVAL_NS, luminance=self.kept[index])

    def _luminance(self, index: int) -> Image:
        rng = np.random.default_rng(1000 + index)
        if index in self.black:
            return _grey(np.full(SHAPE, 12.0), rng)
        time_s = index * INTERVAL_NS * 1e-9
        frame = render(self.scene, self.pose(time_s))
        if self.order is not FieldOrder.PROGRESSIVE:
            second = 1 if self.order is FieldOrder.TOP_FIRST else 0
            frame = frame.copy()
            frame[second::2] = render(self.scene, self.pose(time_s + INTERVAL_NS * 0.5e-9))[second::2]
        return _grey(frame, rng)

    def damage(self) -> tuple[str, ...]:
        return ()

    def fingerprint(self) -> str:
        return f"made {self.order} {sorted(self.black)}"


def _given(
    scene: Scene, order: FieldOrder, stills: int, *, black: tuple[int, ...] = (), shown: Scene | None = None
) -> VideoInput:
    exposures = EXPOSURES[:stills]
    rng = np.random.default_rng(5)
    pictures = {f"S{n}": _still(scene, POSE(f * INTERVAL_NS * 1e-9), rng) for n, f in enumerate(exposures)}
    shutter = {f + step for f in exposures for step in (0, 1)}
    places = tuple(
        StillInVideo(
            still=f"S{n}", last_frame=f - 1, first_frame=f + 2, exposure_time_ns=f * INTERVAL_NS, kind="black",
            confidence=1.0,
        )
        for n, f in enumerate(exposures)
    )  # fmt: skip
    store = PictureStore(MadeStills(pictures), tuple(pictures))
    return VideoInput(
        video=MadeVideo(shown or scene, POSE, order, frozenset({*shutter, *black})),
        sync=VideoSync(
            places=places, still_from_video=STILL_FROM_VIDEO, residual_px=0.0, field_order=order,
            frame_interval_ns=INTERVAL_NS,
        ),
        store=store, pyramids=PyramidStore(store), candidates=CandidateOptions(cells=10, per_cell=2),
        measurement=MeasurementOptions(window_px=21),
    )  # fmt: skip


def _truth(xy: Array, here: int, there: int) -> Array:
    """Where points (n, 2) of one still lie in another."""
    A, B = (POSE(EXPOSURES[n] * INTERVAL_NS * 1e-9)[0] for n in (here, there))
    ground = (STILL_FROM_VIDEO.inverse().apply(xy) - A[:, 2]) @ np.linalg.inv(A[:, :2]).T
    return STILL_FROM_VIDEO.apply(ground @ B[:, :2].T + B[:, 2])


def _places(given: VideoInput) -> tuple[StillInVideo, StillInVideo]:
    return given.sync.places[0], given.sync.places[1]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(np.random.default_rng(8))


@pytest.fixture(scope="module")
def other_scene() -> Scene:
    return make_scene(np.random.default_rng(9))


def _grid() -> Array:
    column, row = np.meshgrid(np.arange(260.0, 1160.0, 75.0), np.arange(240.0, 840.0, 75.0))
    return np.column_stack([column.ravel(), row.ravel()])


@pytest.mark.parametrize("order", list(FieldOrder), ids=lambda order: order.value)
def test_points_are_followed_from_still_to_still(scene: Scene, order: FieldOrder) -> None:
    given = _given(scene, order, 2)
    xy, alive, warps = track_between_stills(given, _places(given), _grid())
    truth = _truth(_grid(), 0, 1)
    assert alive.mean() > 0.8
    error = np.linalg.norm(xy - truth, axis=1)[alive] / 2.0  # still pixels to video pixels
    assert np.median(error) < 0.5
    assert np.quantile(error, 0.95) < 1.0
    A, B = (POSE(EXPOSURES[n] * INTERVAL_NS * 1e-9)[0][:, :2] for n in (0, 1))
    np.testing.assert_allclose(np.median(warps[alive], axis=0), B @ np.linalg.inv(A), atol=0.02)


def test_a_black_gap_is_bridged(scene: Scene) -> None:
    given = _given(scene, FieldOrder.BOTTOM_FIRST, 2, black=(11, 12, 13))
    xy, alive, _ = track_between_stills(given, _places(given), _grid())
    assert alive.mean() > 0.7
    error = np.linalg.norm(xy - _truth(_grid(), 0, 1), axis=1)[alive] / 2.0
    assert np.median(error) < 0.5


def test_points_outside_the_finders_crop_are_not_followed(scene: Scene) -> None:
    given = _given(scene, FieldOrder.PROGRESSIVE, 2)
    rim = np.array([[10.0, 20.0], [1395.0, 500.0], [700.0, 1035.0]])
    _, alive, _ = track_between_stills(given, _places(given), np.vstack([_grid(), rim]))
    assert not alive[-3:].any()
    xy, alive, _ = track_between_stills(given, _places(given), rim)
    assert not alive.any()
    np.testing.assert_array_equal(xy, rim)


def test_a_still_as_the_video_shows_it(scene: Scene) -> None:
    """The reduced still must lie on the video's own picture: half a video pixel off would show in the difference."""
    pose = POSE(EXPOSURES[0] * INTERVAL_NS * 1e-9)
    rng = np.random.default_rng(0)
    still = _still(scene, pose, rng)
    inside = np.s_[20:-20, 20:-20]
    shown = cv2.GaussianBlur(render(scene, pose).astype(np.float32), (0, 0), 0.5)[inside]

    def difference(shift: tuple[float, float]) -> float:
        moved = replace(STILL_FROM_VIDEO, shift=STILL_FROM_VIDEO.shift + 2.0 * np.array(shift))
        return float(np.std(still_as_video(still, moved, SHAPE).astype(float)[inside] - shown))

    here = difference((0.0, 0.0))
    assert all(here < 0.8 * difference(shift) for shift in ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)))


class _Counting:
    """A cache in memory that counts what it has to compute."""

    def __init__(self) -> None:
        self.kept: dict[tuple[str, str], dict[str, Any]] = {}
        self.computed = 0

    def arrays(self, step: str, key: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        if (step, key) not in self.kept:
            self.computed += 1
            self.kept[(step, key)] = compute()
        return self.kept[(step, key)]


def test_candidates_of_three_stills_and_their_cache(scene: Scene) -> None:
    given, cache = _given(scene, FieldOrder.TOP_FIRST, 3), _Counting()
    found = candidates_through_video(given, cache, workers=1, progress=silent)
    points = found.candidates
    assert found.weak_pairs == []
    assert cache.computed == 2
    assert set(points.origin.tolist()) == {PointOrigin.VIDEO}
    assert points.ray_point.max() < len(points)
    truth = np.full_like(points.ray_px, np.nan)
    for here in (0, 1):
        for there in (1, 2):
            rows = (points.reference_image[points.ray_point] == here) & (points.ray_image == there)
            truth[rows] = _truth(points.reference_px[points.ray_point[rows]], here, there)
    error = np.linalg.norm(points.ray_px - truth, axis=1)
    assert len(error) > 150
    assert np.median(error) < 0.06  # least squares matching of smooth pictures with 2 grey values of noise
    assert np.mean(error < 0.5) > 0.98
    carried = np.bincount(points.ray_point, minlength=len(points))[points.reference_image == 0]
    assert (carried == 2).sum() > 40  # followed on into the third still, measured against the first
    rows = found.matches[0]
    assert np.median(np.linalg.norm(_truth(rows[:, :2], 0, 1) - rows[:, 2:], axis=1)) < 0.06
    again = candidates_through_video(given, cache, workers=2, progress=silent)
    assert cache.computed == 2
    fresh = candidates_through_video(given, _Counting(), workers=2, progress=silent)
    for other in (again, fresh):
        for name in ("reference_image", "reference_px", "ray_point", "ray_image", "ray_px", "ray_sigma_px"):
            np.testing.assert_array_equal(getattr(other.candidates, name), getattr(points, name))
    changed = replace(given, measurement=MeasurementOptions(window_px=23))
    candidates_through_video(changed, cache, workers=1, progress=silent)
    assert cache.computed > 2


def test_a_video_of_something_else_leads_nowhere(scene: Scene, other_scene: Scene) -> None:
    given = _given(scene, FieldOrder.PROGRESSIVE, 2)
    given = replace(
        given,
        store=PictureStore(
            MadeStills(
                {
                    "S0": given.store.grey(0),
                    "S1": _still(other_scene, POSE(EXPOSURES[1] * INTERVAL_NS * 1e-9), np.random.default_rng(1)),
                }
            ),
            ("S0", "S1"),
        ),
    )
    given = replace(given, pyramids=PyramidStore(given.store), video=replace(given.video, scene=other_scene))  # type: ignore[type-var]
    found = candidates_through_video(given, _Counting(), workers=1, progress=silent)
    assert found.weak_pairs == [(0, 1)]
    assert len(found.candidates.ray_point) < LEAST_THROUGH_VIDEO


def test_points_that_the_finder_crops_move_as_their_neighbours_do() -> None:
    """Under one affine motion the prediction is exact, turned and scaled too, and tracked points stay as they are."""
    rng = np.random.default_rng(5)
    here = rng.uniform(0, 1000, (80, 2))
    matrix, shift = np.array([[0.9, -0.3], [0.25, 1.1]]), np.array([40.0, -25.0])
    truth = here @ matrix.T + shift
    tracked = (here > 100).all(axis=1) & (here < 900).all(axis=1)
    assert 10 < (~tracked).sum() < 60
    there = np.where(tracked[:, None], truth, 0.0)
    given = np.where(tracked[:, None, None], matrix, np.eye(2))
    xy, extended, warps = extend_motion(here, there, tracked, given)
    assert np.array_equal(extended, ~tracked)
    assert np.abs(xy - truth).max() < 1e-6
    assert np.abs(warps - matrix).max() < 1e-9
    alone = np.arange(80) < 5
    assert not extend_motion(here, there, alone, given)[1].any()
