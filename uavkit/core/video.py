"""Interlaced frames are two pictures: fields, their times, and square pixels."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Image
from uavkit.core.records import FieldOrder, VideoFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoField:
    """The lines of one field (or of a progressive frame) with their own time."""

    frame_index: int
    time_ns: int
    first_row: int
    """Row of the frame that the first line is: 0 for the top field, 1 for the bottom field."""
    row_step: int
    """2 for a field, 1 for a progressive frame."""
    lines: Image
    """(lines, width)."""


def fields_of_frame(frame: VideoFrame, order: FieldOrder, frame_interval_ns: int) -> tuple[VideoField, ...]:
    """Return the one or two pictures of a frame in the order of their times; the second is half a frame later."""
    if order is FieldOrder.PROGRESSIVE:
        return (
            VideoField(frame_index=frame.index, time_ns=frame.time_ns, first_row=0, row_step=1, lines=frame.luminance),
        )
    rows = (0, 1) if order is FieldOrder.TOP_FIRST else (1, 0)
    return tuple(
        VideoField(
            frame_index=frame.index,
            time_ns=frame.time_ns + half * (frame_interval_ns // 2),
            first_row=row,
            row_step=2,
            lines=np.ascontiguousarray(frame.luminance[row::2]),
        )
        for half, row in enumerate(rows)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AffineTransformation:
    """target = matrix @ source + shift, for points in the plane."""

    matrix: Array
    """(2, 2)."""
    shift: Array
    """(2,)."""

    def apply(self, xy: Array) -> Array:
        """Transform points (n, 2)."""
        return np.asarray(xy @ self.matrix.T + self.shift)

    def inverse(self) -> "AffineTransformation":
        """Return source from target."""
        matrix = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        return AffineTransformation(matrix=matrix, shift=-matrix @ self.shift)
