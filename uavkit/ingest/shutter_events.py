"""Find in a video where the shutter of the still camera showed: black, frozen or flashed pictures.

One pass over the video keeps, of each field, its mean, its spread and a picture of 80 x 60 cells; everything else works
on these. A frame of progressive video counts as two fields at one time.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Image, Indices
from uavkit.core.devices import VideoSource
from uavkit.core.progress import Progress
from uavkit.core.records import FieldOrder, VideoFrame

CELLS = (80, 60)
NEIGHBOURHOOD_FIELDS = 401
"""Over which a field is compared with its neighbours; shutters must take less than half of it."""
SHORTEST_BLACK_FIELDS = 2
SHORTEST_FROZEN_FIELDS = 8
"""A recorder doubles one or two frames now and then: that is no shutter."""
LONGEST_FROZEN_FIELDS = 160
LONGEST_FLASH_FIELDS = 6
ENOUGH_EVENTS = 3
"""A finder that turns black at the shutter does so each time: then pictures that stand still are those of a hover."""
VOTE_EVERY = (4, 40)
"""Frames between two measurements of the field order: until there are ``ENOUGH_VOTES``, and afterwards."""
ENOUGH_VOTES = 12
FAINT_SPREAD = 4.0
"""Spread of cells below which ground is faint, grey values; ordinary ground has 8 and more."""
FAINT_JUMP = 0.35
"""Grey values by which the end of a frozen picture shows there."""
STILL_FIELDS = 12
"""Distance of two fields that show whether a picture stands still: far enough for a hovering camera to move."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutterEvent:
    """A place in the video where a shutter showed."""

    last_frame: int
    """Last frame before it of which both fields can be used."""
    first_frame: int
    """First frame after it of which both fields are live again."""
    last_field_frame: int
    last_field_row: int
    """Frame and first row (0 top, 1 bottom) of the last live field: it may lie in the frame after ``last_frame``."""
    last_field_ns: int
    exposure_time_ns: int
    """Half a field after the last live field's time."""
    kind: str
    """black, frozen or flash."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoScan:
    """What one pass over a video keeps; f frames, of each the top and the bottom field."""

    frame_index: Indices
    """(f,)."""
    time_ns: Indices
    """(f,)."""
    mean: Array
    """(f, 2)."""
    spread: Array
    """(f, 2) standard deviation over the cells."""
    cells: NDArray[np.uint8] = field(repr=False)
    """(f, 2, 60, 80)."""
    order_votes: Array
    """(v,) motion from top to bottom field of a frame over the motion to the next frame: 1/2 top first, 0 progressive,
    -1/2 bottom first."""

    def __len__(self) -> int:
        return len(self.frame_index)


def scan_video(video: VideoSource, progress: Progress) -> VideoScan:
    """Read a video once; damaged frames are left out."""
    import cv2

    total = video.info().frame_count or 0
    indexes, times, means, spreads, cells = [], [], [], [], []
    votes: list[float] = []
    previous: VideoFrame | None = None
    for frame in video.frames():
        if frame.damaged:
            previous = None
            continue
        small = [cv2.resize(frame.luminance[row::2], CELLS, interpolation=cv2.INTER_AREA) for row in (0, 1)]
        indexes.append(frame.index)
        times.append(frame.time_ns)
        cells.append(np.stack(small))
        means.append([float(part.mean()) for part in small])
        spreads.append([float(part.std()) for part in small])
        every = VOTE_EVERY[len(votes) >= ENOUGH_VOTES]
        if frame.index % every == 1 and previous is not None and previous.index == frame.index - 1:
            votes += _order_vote(previous.luminance, frame.luminance)
        previous = frame
        if frame.index % 100 == 0:
            progress("read video", frame.index, max(total, frame.index))
    shape = (0, 2, CELLS[1], CELLS[0])
    return VideoScan(
        frame_index=np.array(indexes, dtype=np.int64),
        time_ns=np.array(times, dtype=np.int64),
        mean=np.array(means, dtype=np.float64).reshape(-1, 2),
        spread=np.array(spreads, dtype=np.float64).reshape(-1, 2),
        cells=np.stack(cells) if cells else np.zeros(shape, dtype=np.uint8),
        order_votes=np.array(votes, dtype=np.float64),
    )


def _order_vote(one: Image, two: Image) -> list[float]:
    """Return at most one vote: where the motion between two frames is 1 to 60 px."""
    if min(one.std(), two.std()) < 5.0:
        return []
    whole = displacement(one[0::2], two[0::2]) * [1.0, 2.0]
    half = displacement(one[0::2], one[1::2]) * [1.0, 2.0] + [0.0, 1.0]
    length = float(whole @ whole)
    return [float(half @ whole) / length] if 1.0 < length < 3600.0 else []


def displacement(one: Image, two: Image) -> Array:
    """Return by how many columns and rows the content of one moved to be in two, by phase correlation, shape (2,)."""
    import cv2

    window = cv2.createHanningWindow((one.shape[1], one.shape[0]), cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(one.astype(np.float32), two.astype(np.float32), window)
    return np.array(shift, dtype=np.float64)


def estimated_field_order(scan: VideoScan) -> FieldOrder | None:
    """Return the field order in which motion is smooth; None where too little moves to tell."""
    near = [scan.order_votes[np.abs(scan.order_votes - centre) < 0.25] for centre in (0.5, 0.0, -0.5)]
    counts = [len(votes) for votes in near]
    best = int(np.argmax(counts))
    if counts[best] < 4 or counts[best] < 2 * (sum(counts) - counts[best]):
        return None
    return (FieldOrder.TOP_FIRST, FieldOrder.PROGRESSIVE, FieldOrder.BOTTOM_FIRST)[best]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fields:
    """The fields of a scan in the order of their times; s of them."""

    frame: Indices
    row: Indices
    time_ns: Indices
    mean: Array
    spread: Array
    cells: NDArray[np.float32]


def _fields_in_time(scan: VideoScan, order: FieldOrder, frame_interval_ns: int) -> _Fields:
    rows = np.array([1, 0] if order is FieldOrder.BOTTOM_FIRST else [0, 1])
    later = 0 if order is FieldOrder.PROGRESSIVE else frame_interval_ns // 2
    return _Fields(
        frame=np.repeat(scan.frame_index, 2),
        row=np.tile(rows, len(scan)),
        time_ns=(scan.time_ns[:, None] + np.array([0, later])).ravel(),
        mean=scan.mean[:, rows].ravel(),
        spread=scan.spread[:, rows].ravel(),
        cells=scan.cells[:, rows].reshape(-1, CELLS[1], CELLS[0]).astype(np.float32),
    )


def find_shutter_events(scan: VideoScan, order: FieldOrder, frame_interval_ns: int) -> tuple[ShutterEvent, ...]:
    """Return the shutter events of a scanned video in the order of time.

    Black or frozen pictures with which the video begins or ends are no events: what lies beyond is not known.
    """
    if len(scan) < 10:
        return ()
    fields = _fields_in_time(scan, order, frame_interval_ns)
    level = _running(fields.mean, 50.0)
    black = (fields.mean < 0.5 * level) & (fields.spread < 0.5 * _running(fields.spread, 50.0))
    flash = (fields.mean > 1.35 * level) & (fields.mean > level + 25.0)
    spans = [(a, b, "black") for a, b in _runs(black, SHORTEST_BLACK_FIELDS)]
    spans += [(a, b, "flash") for a, b in _runs(flash, 1) if b - a <= LONGEST_FLASH_FIELDS]
    spans = [(a, _end_of_frozen(fields, b), kind) for a, b, kind in sorted(spans)]
    taken = np.zeros(len(fields.mean), dtype=np.bool_)
    for a, b, _ in spans:
        taken[max(a - 2, 0) : b + 2] = True
    if len(spans) < ENOUGH_EVENTS:
        spans += [(a, b, "frozen") for a, b in _frozen_runs(fields, taken)]
    events = (_event(fields, span, frame_interval_ns) for span in sorted(spans))
    return tuple(event for event in events if event is not None)


def _running(values: Array, percentile: float) -> Array:
    from scipy.ndimage import percentile_filter

    size = min(NEIGHBOURHOOD_FIELDS, 2 * (len(values) // 2) - 1)
    return np.asarray(percentile_filter(values, percentile, size=size, mode="nearest"), dtype=np.float64)


def _runs(flags: Flags, shortest: int) -> list[tuple[int, int]]:
    """Return (begin, end) of runs of flags, a single gap bridged, no shorter than ``shortest``."""
    bridged = flags.copy()
    bridged[1:-1] |= flags[:-2] & flags[2:]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bridged, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= shortest]


def _difference(fields: _Fields, one: Indices, two: Indices) -> Array:
    """Return mean absolute differences of the cells of fields (k,) and (k,), without a difference of brightness."""
    change = fields.cells[one] - fields.cells[two]
    change -= change.mean(axis=(1, 2), keepdims=True)
    return np.asarray(np.abs(change).mean(axis=(1, 2)), dtype=np.float64)


def _end_of_frozen(fields: _Fields, begin: int) -> int:
    """Return the first field that no longer shows what the first ones after ``begin`` show.

    A frozen picture ends with a jump, for the camera went on meanwhile; the line's noise creeps into it slowly through
    the codec. Pictures that move away from the first without a jump were live.
    """
    end = min(begin + LONGEST_FROZEN_FIELDS, len(fields.mean))
    if end - begin < 8:
        return begin
    places = np.arange(begin + 2, end)
    first = np.where(fields.row[places] == fields.row[begin], begin, begin + 1)
    away = _difference(fields, places, first)
    step = _difference(fields, places, places - 2)
    usual = np.array([np.median(step[: max(k, 2)]) for k in range(len(step))])
    if float(np.median(fields.spread[places])) < FAINT_SPREAD:
        return _end_of_faint_frozen(places, away, step > 2.0 * usual + 0.15)
    jumps = np.flatnonzero(step > 3.0 * usual + 0.5)
    left = np.flatnonzero(away > 1.2 + 2.0 * float(step[:2].mean()))
    gone = int(left[0]) if len(left) else len(places)
    if len(jumps) and 4 <= jumps[0] <= gone:
        return int(places[jumps[0]])
    return begin if gone < 10 or not len(left) else int(places[gone])


def _end_of_faint_frozen(places: Indices, away: Array, jumped: Flags) -> int:
    """Return the first live field on faint ground: a jump, (k,), farther from the first field than any before it, (k,).

    There a jump is little larger than the noise, and motion alone takes long to show.
    """
    ends = np.flatnonzero(jumped[1:] & (away[1:] > np.maximum.accumulate(away)[:-1] + FAINT_JUMP)) + 1
    return int(places[ends[0]]) if len(ends) and ends[0] >= 4 else int(places[0]) - 2


def _frozen_runs(fields: _Fields, taken: Flags) -> list[tuple[int, int]]:
    """Return (begin, end) of frozen pictures apart from ``taken``, and moved on afterwards.

    Noise of the line makes frozen pictures differ too; what tells them from live ones is that fields far apart differ
    little more than neighbours.
    """
    count = len(fields.mean)
    places = np.arange(count - STILL_FIELDS)
    if len(places) < 2 * STILL_FIELDS:
        return []
    far = _difference(fields, places, places + STILL_FIELDS)
    near = _difference(fields, places, places + 2)
    free = ~(taken[places] | taken[places + STILL_FIELDS // 2] | taken[places + STILL_FIELDS])
    still = free & (far < 2.0 * near + 0.15) & (far < 0.4 * _running(np.where(free, far, far.max()), 40.0))
    found = []
    for a, b in _runs(still, SHORTEST_FROZEN_FIELDS - 6):
        begin, end = _extent(fields, (a + b + STILL_FIELDS) // 2, float(np.median(far[a:b])))
        if end - begin >= SHORTEST_FROZEN_FIELDS and not taken[max(begin, 0) : end].any():
            found.append((begin, end))
    return found


def _extent(fields: _Fields, middle: int, noise: float) -> tuple[int, int]:
    """Return the first repeated field and the first live one after it, around a field of a frozen picture."""
    low, high = max(middle - LONGEST_FROZEN_FIELDS, 0), min(middle + LONGEST_FROZEN_FIELDS, len(fields.mean))
    places = np.arange(low, high)
    reference = np.where(fields.row[places] == fields.row[middle], middle, min(middle + 1, high - 1))
    moved = _difference(fields, places, reference) > 1.3 * noise + 0.15
    before, after = np.flatnonzero(moved[: middle - low]), np.flatnonzero(moved[middle - low :])
    start = low + int(before[-1]) + 1 if len(before) else low
    end = middle + int(after[0]) if len(after) else high
    return start + 2, end  # the first two of the same fields are the live ones that are repeated


def _event(fields: _Fields, span: tuple[int, int, str], frame_interval_ns: int) -> ShutterEvent | None:
    """Return the event between two fields, or None where the video holds nothing before or after it."""
    begin, end, kind = span
    if begin < 2 or end >= len(fields.mean) - 1:
        return None
    last, first = begin - 1, end
    last_whole = last if last % 2 == 1 else last - 1
    first_whole = first if first % 2 == 0 else first + 1
    if last_whole < 1 or first_whole >= len(fields.mean):
        return None
    return ShutterEvent(
        last_frame=int(fields.frame[last_whole]),
        first_frame=int(fields.frame[first_whole]),
        last_field_frame=int(fields.frame[last]),
        last_field_row=int(fields.row[last]),
        last_field_ns=int(fields.time_ns[last]),
        exposure_time_ns=int(fields.time_ns[last]) + frame_interval_ns // 4,
        kind=kind,
    )
