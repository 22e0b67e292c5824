"""Where the shutter's black and frozen pictures end, on ground of ordinary and of faint contrast."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from uavkit.core.records import FieldOrder
from uavkit.ingest.shutter_events import CELLS, VideoScan, find_shutter_events

FRAME_NS = 33_366_667
EVERY, BLACK = 90, 9
"""Frames from event to event, and frames of black in each."""


def _scan(spread: float, frozen: int, events: int = 6) -> VideoScan:
    """Cells of a camera that moves evenly over ground of a spread, with noise of 0.4; black, then frozen frames."""
    rng = np.random.default_rng(8)
    frames = EVERY * (events + 1)
    wide = gaussian_filter(rng.normal(size=(CELLS[1], CELLS[0] + frames + 10)), (2.0, 4.0))
    wide *= spread / wide.std()
    cells = np.empty((frames, 2, CELLS[1], CELLS[0]), dtype=np.uint8)
    for frame in range(frames):
        since = (frame - EVERY) % EVERY if frame >= EVERY - 1 else frames
        for row in (0, 1):
            at = (frame - since - 0.5 if BLACK <= since < BLACK + frozen else frame + 0.5 * row) * 0.5
            left = int(at)
            part = (1 - at + left) * wide[:, left : left + CELLS[0]] + (at - left) * wide[:, left + 1 :][:, : CELLS[0]]
            level = 16.0 + 0.0 * part if since < BLACK else 150.0 + part
            noisy = level + rng.normal(0.0, 0.4, level.shape)
            cells[frame, row] = np.clip(np.rint(noisy), 0, 255)
    values = cells.reshape(frames, 2, -1).astype(np.float64)
    return VideoScan(
        frame_index=np.arange(frames),
        time_ns=np.arange(frames) * FRAME_NS,
        mean=values.mean(axis=2),
        spread=values.std(axis=2),
        cells=cells,
        order_votes=np.zeros(0),
    )


@pytest.mark.parametrize("spread", [12.0, 2.4])
@pytest.mark.parametrize("frozen", [0, 8])
def test_pictures_are_live_again_after_black_and_frozen_ones(spread: float, frozen: int) -> None:
    events = find_shutter_events(_scan(spread, frozen), FieldOrder.TOP_FIRST, FRAME_NS)
    assert [event.kind for event in events] == ["black"] * 6
    begin = EVERY * np.arange(1, 7)
    assert [event.last_frame for event in events] == (begin - 1).tolist()
    late = np.array([event.first_frame for event in events]) - (begin + BLACK + frozen)
    assert np.abs(late).max() <= 1
