"""Speed and hits of one tracking step against OpenCV's pyramidal Lucas-Kanade, alternating in one run.

1000 points of a picture of 640 x 480, moved by 3 px; both have two threads. Lucas-Kanade: 21 px, three levels above the
picture, default criteria. The picture of orientation codes is made within the step.
"""

import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest

from tests.benchmarks.rows import measured
from tests.process.textures import WaveTexture, picture, wave_texture
from uavkit.core.arrays import Array
from uavkit.process.tracking import TimedPicture, TrackState, advance, start

pytestmark = pytest.mark.slow

RUNS = 25
THREADS = 2
MOVE_PX = np.array([2.4, -1.8])
SHAPE = (480, 640)
CASES = {"step": 1.0, "first step": 1.0, "gain 1.4": 1.4, "gain 0.6": 0.6}
"""Gain of the second picture over the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Two pictures, the points of the first, and what is known when the second comes."""

    state: TrackState
    picture: TimedPicture
    points_px: Array
    truth_px: Array

    def ours(self, pool: Executor | None) -> Array:
        """Return where the tracker finds the points; nan where it does not."""
        after = advance(self.state, self.picture, np.random.default_rng(0), pool)
        return np.where((after.misses == 0)[:, None], after.points_px, np.nan)

    def lucas_kanade(self) -> Array:
        """Return where OpenCV finds the points; nan where it says it does not."""
        given = self.points_px.astype(np.float32)
        before = self.state.last_image
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            before, self.picture.image, given, None, winSize=(21, 21), maxLevel=3
        )
        return np.where(status == 1, found.astype(float), np.nan)

    def right(self, found_px: Array) -> int:
        """Return how many points lie within a pixel of the truth."""
        return int((np.linalg.norm(found_px - self.truth_px, axis=1) <= 1.0).sum())


def seen(texture: WaveTexture, step: int, gain: float, rng: np.random.Generator) -> TimedPicture:
    """Return the picture after some steps; the gain acts on all of its brightness, so that it saturates as a camera."""
    moved = np.column_stack([np.eye(2), step * MOVE_PX])
    image = picture(texture, SHAPE, moved, gain=40.0 * gain, offset=125.0 * gain, noise=2.0, rng=rng)
    return TimedPicture(image=image, time_s=0.04 * step)


def made(case: str) -> Step:
    """Return the step of a case: the motion is known from the one before, but not in a first step."""
    rng = np.random.default_rng(1)
    texture = wave_texture(rng)
    pictures = [seen(texture, n, 1.0 if n < 2 else CASES[case], rng) for n in range(3)]
    points = rng.uniform(40, [600, 440], (1000, 2))
    if case == "first step":
        return Step(state=start(pictures[0], points), picture=pictures[1], points_px=points, truth_px=points - MOVE_PX)
    state = advance(start(pictures[0], points), pictures[1], np.random.default_rng(0))
    here = points - MOVE_PX
    return Step(state=state, picture=pictures[2], points_px=here, truth_px=here - MOVE_PX)


def alternating_s(works: dict[str, Callable[[], object]]) -> dict[str, Array]:
    """Return the times of all runs of each of several works, taken in turn, after one that warms up."""
    for work in works.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(RUNS):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - begin)
    return {name: np.array(values) for name, values in times.items()}


def compared(case: str) -> dict[str, Any]:
    """Return times and hits of a case."""
    cv2.setNumThreads(THREADS)
    step, steady = made(case), made("step")
    with ThreadPoolExecutor(THREADS) as pool:
        assert np.array_equal(step.ours(pool), step.ours(None), equal_nan=True)
        times = alternating_s(
            {"ours": lambda: step.ours(pool), "lk": step.lucas_kanade, "ours_one_thread": lambda: step.ours(None)}
        )
    return {
        **{f"{name}_ms": 1e3 * float(np.median(values)) for name, values in times.items()},
        **{f"{name}_least_ms": 1e3 * float(values.min()) for name, values in times.items()},
        "ratio": float(np.median(times["ours"]) / np.median(times["lk"])),
        "ratio_of_least": float(times["ours"].min() / times["lk"].min()),
        "ratio_one_thread": float(np.median(times["ours_one_thread"]) / np.median(times["lk"])),
        "points": len(step.points_px),
        "ours_right": step.right(step.ours(None)),
        "lk_right": step.right(step.lucas_kanade()),
        "lk_right_without_change": steady.right(steady.lucas_kanade()),
    }


@pytest.mark.parametrize("case", CASES)
def test_tracking_speed(case: str) -> None:
    row = measured("tracking speed", case, lambda: compared(case))
    assert row["ours_right"] > 0.9 * row["points"]
