"""A flat synthetic scene in memory: stills and interlaced finder video of one flight, with their truth.

Unlike ``uavkit.simulate`` it renders by shifting one textured plane, in seconds, and any defect can be put in.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.records import FieldOrder, StillInfo, VideoFrame, VideoInfo

INTERVAL_NS = 33_366_667
WIDTH, HEIGHT = 640, 480
START_NS = 1_000_000_000_000_000_000


class MemoryStills:
    """A StillSource of arrays; names in ``broken`` cannot be decoded."""

    def __init__(self, infos, pictures, broken=()):
        self.infos, self.pictures, self.broken = tuple(infos), pictures, set(broken)

    def stills(self):
        return self.infos

    def grey(self, name):
        if name in self.broken:
            raise InputError(f"{name}: cannot be decoded")
        return self.pictures[name]

    def colour(self, name):
        return np.repeat(self.grey(name)[:, :, None], 3, axis=2)

    def fingerprint(self, name):
        return name


class MemoryVideo:
    """A VideoSource of arrays."""

    def __init__(self, frames, order=None, damage=()):
        self.pictures, self.order, self._damage = frames, order, tuple(damage)

    def info(self):
        return VideoInfo(
            name="video.avi", width_px=WIDTH, height_px=HEIGHT, frame_interval_ns=INTERVAL_NS,
            field_order=self.order, frame_count=len(self.pictures),
        )  # fmt: skip

    def frames(self, first=0, last=None):
        for index, picture in enumerate(self.pictures):
            if index >= first and (last is None or index <= last):
                yield VideoFrame(index=index, time_ns=index * INTERVAL_NS, luminance=picture)

    def damage(self):
        return self._damage

    def fingerprint(self):
        return "video"


@dataclass(frozen=True, kw_only=True)
class Flight:
    """What was made, and what is true of it."""

    stills: MemoryStills
    frames: list = field(repr=False)
    last_frame: list
    """True last usable frame of each still."""
    first_frame: list
    exposure_ns: list
    matrix: np.ndarray
    shift: np.ndarray
    centre: Callable
    """Place of the middle of the video over the ground at a time in ns, in video pixels."""
    live_frame: Callable
    """Frame n as it would be without a shutter."""

    def video(self, **kind):
        return MemoryVideo(self.frames, **kind)

    def without_event(self, k):
        """The same with live pictures in place of the black and frozen ones of event k."""
        frames = list(self.frames)
        for n in range(self.last_frame[k] + 1, self.first_frame[k]):
            frames[n] = self.live_frame(n)
        return replace(self, frames=frames)

    def with_false_event(self, frame, length=12):
        frames = list(self.frames)
        for n in range(frame, frame + length):
            frames[n] = np.full((HEIGHT, WIDTH), 16, dtype=np.uint8)
        return replace(self, frames=frames)

    def without_still(self, k):
        keep = [info for n, info in enumerate(self.stills.infos) if n != k]
        cut = lambda values: [v for n, v in enumerate(values) if n != k]  # noqa: E731
        return replace(
            self, stills=MemoryStills(keep, self.stills.pictures), last_frame=cut(self.last_frame),
            first_frame=cut(self.first_frame), exposure_ns=cut(self.exposure_ns),
        )  # fmt: skip


def texture(rng, shape):
    total = np.zeros(shape, dtype=np.float32)
    for size in (3, 7, 17, 45, 120):
        coarse = rng.normal(size=(shape[0] // size + 3, shape[1] // size + 3)).astype(np.float32)
        total += cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC) * size**0.35
    return np.clip(110 + 25 * total / total.std(), 18, 235).astype(np.uint8)


def make_flight(
    seed=1,
    stations=7,
    order=FieldOrder.BOTTOM_FIRST,
    gap=(36, 56),
    step_px=270.0,
    frozen=(8, 12),
    black=(6, 10),
    resolution_s=1.0,
    clock_offset_s=0.0,
    scale=2.4,
    noise=2.0,
    still_size=(1600, 1200),
):
    """Fly to and fro over a plane; gap in frames between stills."""
    rng = np.random.default_rng(seed)
    ground = texture(rng, (1500, int(step_px * stations) + 1300))
    lead, field_ns = 24, INTERVAL_NS / 2
    gaps = rng.integers(gap[0], gap[1] + 1, stations - 1) * 2 + rng.integers(0, 2, stations - 1)
    last_field = 2 * lead + np.concatenate([[0], np.cumsum(gaps)])
    exposure_ns = (last_field + 0.3) * field_ns
    angle = np.radians(rng.uniform(-0.15, 0.15))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = scale * turn
    middle_video = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    middle_still = (np.array(still_size) - 1) / 2 + rng.uniform(-8, 8, 2)
    shift = middle_still - matrix @ middle_video
    knots_ns = np.concatenate([[-1e12], exposure_ns, [1e12]])

    def centre(time_ns):
        n = int(np.clip(np.searchsorted(knots_ns, time_ns) - 1, 0, stations))
        u = np.clip((time_ns - knots_ns[n]) / (knots_ns[n + 1] - knots_ns[n]), 0, 1) if 0 < n < stations else 0.0
        smooth = u**3 * (10 - 15 * u + 6 * u * u)
        along = (np.clip(n - 1, 0, stations - 1) + (smooth if 0 < n < stations else 0)) * step_px + 640
        t = time_ns * 1e-9
        return np.array([along + 6 * np.sin(2.1 * t), 750 + 9 * np.sin(1.3 * t + 1) + 3 * np.sin(3.3 * t)])

    def look(time_ns, row):
        start = centre(time_ns) + np.array([0.0, row]) - middle_video
        table = np.array([[1.0, 0.0, start[0]], [0.0, 2.0, start[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(ground, table, (WIDTH, HEIGHT // 2), flags=flags).astype(np.float32)

    fields = int(last_field[-1]) + 2 * lead + 40
    fields += fields % 2
    live, source = np.zeros(fields, dtype=int), np.arange(fields)  # 0 live, 1 black, 2 frozen
    for last in last_field:
        b = last + 1 + int(rng.integers(2 * black[0], 2 * black[1] + 1)) if black else last + 1
        f = b + int(rng.integers(2 * frozen[0], 2 * frozen[1] + 1)) if frozen else b
        live[last + 1 : b], live[b:f] = 1, 2
        for n in range(b, f):
            source[n] = last - (n - last) % 2
    first_row = 1 if order is FieldOrder.BOTTOM_FIRST else 0

    def frame(k, live, source):
        woven = np.empty((HEIGHT, WIDTH), dtype=np.uint8)
        for half in (0, 1):
            n = 2 * k + half
            row = first_row if half == 0 else 1 - first_row
            gain = 1 + 0.08 * np.sin(n / 300)
            when = 2 * k if order is FieldOrder.PROGRESSIVE else source[n]
            picture = look(when * field_ns, row) * gain if live[n] != 1 else np.full((HEIGHT // 2, WIDTH), 16.0)
            woven[row::2] = np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255)
        return woven

    frames = [frame(k, live, source) for k in range(fields // 2)]
    infos, pictures = [], {}
    inverse = np.linalg.inv(matrix)
    for k, time_ns in enumerate(exposure_ns):
        start = centre(time_ns) - middle_video - inverse @ shift
        table = np.column_stack([inverse, start])
        name = f"R{k:03d}.jpg"
        pictures[name] = cv2.warpAffine(ground, table, still_size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        resolution = int(resolution_s * 1e9)
        stamp = (START_NS + int(time_ns) + int(clock_offset_s * 1e9)) // resolution * resolution
        infos.append(
            StillInfo(
                name=name, width_px=still_size[0], height_px=still_size[1], maker="Ricoh", model="GX200",
                camera_time_ns=stamp, camera_time_resolution_ns=resolution,
            )
        )  # fmt: skip
    dark = [np.flatnonzero(live[last + 1 :] == 0)[0] + last + 1 for last in last_field]
    return Flight(
        stills=MemoryStills(infos, pictures), frames=frames, matrix=matrix, shift=shift, centre=centre,
        live_frame=lambda n: frame(n, np.zeros(fields, dtype=int), np.arange(fields)),
        last_frame=[int(last) // 2 if last % 2 else int(last) // 2 - 1 for last in last_field],
        first_frame=[int(n + 1) // 2 for n in dark], exposure_ns=[float(t) for t in exposure_ns],
    )  # fmt: skip
