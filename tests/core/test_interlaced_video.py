"""An interlaced frame is two pictures: their lines, their order, their times."""

import numpy as np
import pytest

from uavkit.core.records import FieldOrder, VideoFrame
from uavkit.core.video import AffineTransformation, fields_of_frame

NTSC_INTERVAL_NS = 33_366_667


def woven(height: int = 6) -> VideoFrame:
    """Return a frame whose rows are numbered by their grey values."""
    rows = np.repeat(np.arange(height, dtype=np.uint8)[:, None], 4, axis=1)
    return VideoFrame(index=7, time_ns=1_000_000_000, luminance=rows)


@pytest.mark.parametrize(("order", "first_rows"), [(FieldOrder.TOP_FIRST, (0, 1)), (FieldOrder.BOTTOM_FIRST, (1, 0))])
def test_fields_come_in_the_order_of_their_times(order: FieldOrder, first_rows: tuple[int, int]) -> None:
    fields = fields_of_frame(woven(), order, NTSC_INTERVAL_NS)
    assert tuple(field.first_row for field in fields) == first_rows
    for field in fields:
        assert field.row_step == 2
        assert list(field.lines[:, 0]) == [field.first_row, field.first_row + 2, field.first_row + 4]
        assert field.frame_index == 7
    assert fields[0].time_ns == 1_000_000_000
    assert fields[1].time_ns - fields[0].time_ns == NTSC_INTERVAL_NS // 2


def test_a_progressive_frame_is_one_picture() -> None:
    (picture,) = fields_of_frame(woven(), FieldOrder.PROGRESSIVE, NTSC_INTERVAL_NS)
    assert (picture.first_row, picture.row_step) == (0, 1)
    assert np.array_equal(picture.lines, woven().luminance)


def test_an_odd_number_of_rows_loses_none() -> None:
    fields = fields_of_frame(woven(5), FieldOrder.TOP_FIRST, NTSC_INTERVAL_NS)
    assert [len(field.lines) for field in fields] == [3, 2]


def test_affine_transformation_there_and_back() -> None:
    transformation = AffineTransformation(matrix=np.array([[6.2, 0.1], [-0.2, 6.3]]), shift=np.array([12.0, -5.0]))
    assert transformation.apply(np.array([[1.0, 2.0]]))[0] == pytest.approx([18.4, 7.4])
    xy = np.random.default_rng(1).uniform(0.0, 640.0, (10, 2))
    assert transformation.inverse().apply(transformation.apply(xy)) == pytest.approx(xy)
