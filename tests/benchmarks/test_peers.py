# ruff: noqa: T201 (its purpose is to print)
"""Speed and accuracy of the inner loops against OpenCV, as ratios measured in one run; ``make bench`` prints them.

Nothing here is judged but that both do their work: the machines are noisy, and what a ratio should be is no test.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from tests.process.textures import picture, wave_texture
from uavkit.process.orientation_code import orientation_codes
from uavkit.process.tracking import TimedPicture, advance, start

pytestmark = pytest.mark.slow

RUNS = 7


def best_s(work: Callable[[], object]) -> float:
    """Return the shortest of some runs, after one that warms up."""
    work()
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def tell(what: str, ours_s: float, peer_s: float, unit: float, name: str) -> None:
    print(f"\n{what}: {ours_s / unit:.2f} {name}, OpenCV {peer_s / unit:.2f} {name}, ratio {ours_s / peer_s:.2f}")


def test_tracking_step_against_lucas_kanade() -> None:
    """1000 points in 640 x 480, moved by 3 px: OC image included; OpenCV's default criteria, 21 px, 3 levels."""
    rng = np.random.default_rng(1)
    texture = wave_texture(rng)
    before = picture(texture, (480, 640), noise=2.0, rng=rng)
    after = picture(texture, (480, 640), np.array([[1.0, 0.0, 2.4], [0.0, 1.0, -1.8]]), noise=2.0, rng=rng)
    points = rng.uniform(40, [600, 440], (1000, 2))
    truth = points - [2.4, -1.8]
    state = start(TimedPicture(image=before, time_s=0.0), points)
    ours = advance(state, TimedPicture(image=after, time_s=0.04), np.random.default_rng(0))
    given = points.astype(np.float32)
    found, _, _ = cv2.calcOpticalFlowPyrLK(before, after, given, None, winSize=(21, 21), maxLevel=3)
    assert np.median(np.linalg.norm(ours.points_px - truth, axis=1)) < 0.5
    assert np.median(np.linalg.norm(found - truth, axis=1)) < 0.5
    ours_s = best_s(lambda: advance(state, TimedPicture(image=after, time_s=0.04), np.random.default_rng(0)))
    peer_s = best_s(lambda: cv2.calcOpticalFlowPyrLK(before, after, given, None, winSize=(21, 21), maxLevel=3))
    tell("tracking step, 1000 points", ours_s, peer_s, 1e-3, "ms")
    print(f"  of which the orientation code image: {best_s(lambda: orientation_codes(before)) * 1e3:.2f} ms")
