"""The finder's video: fields at their own times, through an analogue line, recorded as MPEG-4 in AVI."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from uavkit.core.arrays import Array, Image
from uavkit.core.progress import Progress
from uavkit.core.records import FieldOrder
from uavkit.simulate.brightness import finder_factor
from uavkit.simulate.camera import SimulatedCamera
from uavkit.simulate.flight import FieldState, Flight, Wobble, make_wobble
from uavkit.simulate.kernels import Field, finder_signal, render_rows
from uavkit.simulate.options import FrozenPicture, SimulationOptions, VideoStandard
from uavkit.simulate.stills import gaussian_taps, view_table
from uavkit.simulate.world import World

WIDTH_PX = 640
HEIGHT_PX = 480
LATTICE_PX = 4
BIT_RATE = 4_000_000
BANDWIDTH_SIGMA_PX = 0.62
"""Along a line: half response at 0.30 cycles per pixel, or some 380 television lines."""
NOISE_GREY = 3.0
"""Before the band limit, 2 after it."""
FRAME_RATE = {VideoStandard.NTSC: Fraction(30000, 1001), VideoStandard.PAL: Fraction(25, 1)}


@dataclass(frozen=True, slots=True, kw_only=True)
class FinderGeometry:
    """Where the finder's picture lies in the still: still = matrix @ video + shift, pixels (column, row)."""

    matrix: Array
    shift_px: Array

    @property
    def still_px_per_video_px(self) -> float:
        """The scale."""
        return float(np.sqrt(np.linalg.det(self.matrix)))

    def still_from_video(self, pixels: Array) -> Array:
        """Still pixels (..., 2) of video pixels (..., 2)."""
        return np.asarray(pixels @ self.matrix.T + self.shift_px)


def finder_geometry(camera: SimulatedCamera, seed: int) -> FinderGeometry:
    """The finder crops about 3.5 % at each side, is shifted by a few pixels and turned by a tenth of a degree."""
    rng = np.random.default_rng([seed, 4])
    scale = camera.width_px * (1 - 2 * rng.uniform(0.03, 0.04)) / WIDTH_PX
    angle = np.radians(rng.uniform(-0.15, 0.15))
    matrix = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([camera.width_px - 1, camera.height_px - 1]) / 2 + scale * rng.uniform(-3, 3, 2)
    return FinderGeometry(matrix=matrix, shift_px=centre - matrix @ [(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Finder:
    """Renders the fields of a flight's video on demand, each the same whenever it is asked for."""

    world: World
    camera: SimulatedCamera
    flight: Flight
    options: SimulationOptions
    geometry: FinderGeometry
    lattice: Array
    drift: Wobble
    """Of the automatic gain."""
    kept: dict[int, Field] = field(default_factory=dict)
    """Pictures that the finder shows frozen."""

    @property
    def frame_count(self) -> int:
        """Frames of the whole video."""
        return len(self.flight.states.state) // 2

    def row_of(self, index: int) -> int:
        """First row in the frame of a field: 0 (top) or 1 (bottom)."""
        return index % 2 if self.options.field_order is FieldOrder.TOP_FIRST else 1 - index % 2

    def frame(self, number: int) -> Image:
        """One woven frame as planar YUV 4:2:0, shape (720, 640)."""
        planes = np.empty((HEIGHT_PX * 3 // 2, WIDTH_PX), dtype=np.uint8)
        chrominance = planes[HEIGHT_PX:].reshape(2, HEIGHT_PX // 2, WIDTH_PX // 2)
        for index in (2 * number, 2 * number + 1):
            row = self.row_of(index)
            luminance, colours = self.signal(index)
            planes[row:HEIGHT_PX:2] = luminance
            chrominance[:, row::2] = colours
        return planes

    def signal(self, index: int) -> tuple[Image, Image]:
        """Luminance (240, 640) and colour differences (2, 120, 320) of one field."""
        picture = self._picture(index)
        rng = np.random.default_rng([self.options.seed, 5, index])
        noise = rng.standard_normal(picture.shape[:2], dtype=np.float32) * np.float32(NOISE_GREY)
        time_s = index * self.flight.field_interval_s
        gain = float(np.exp(self.drift.at(np.array([time_s]))[0, 0]))
        gain *= finder_factor(time_s, self.flight.exposure_s, self.options.brightness_jump)
        luminance = np.empty(picture.shape[:2], dtype=np.uint8)
        colours = np.empty((2, HEIGHT_PX // 4, WIDTH_PX // 2), dtype=np.uint8)
        finder_signal(picture, noise, gain, gaussian_taps(BANDWIDTH_SIGMA_PX, 3), luminance, colours)
        return luminance, colours

    def _picture(self, index: int) -> Field:
        """Linear colours of what a field shows."""
        states = self.flight.states
        state, source = FieldState(states.state[index]), int(states.source[index])
        if state is FieldState.BLACK:
            return np.zeros((HEIGHT_PX // 2, WIDTH_PX, 3), dtype=np.float32)
        if state is FieldState.LIVE:
            return self._render(index * self.flight.field_interval_s, self.row_of(index))
        if source not in self.kept:
            for old in [key for key in tuple(self.kept) if key < source - 40]:
                self.kept.pop(old, None)
            time_s = source * self.flight.field_interval_s
            if self.options.frozen_picture is FrozenPicture.REVIEW:
                time_s = float(self.flight.exposure_s[states.exposure[index]])
            self.kept[source] = self._render(time_s, self.row_of(index))
        return self.kept[source]

    def _render(self, time_s: float, row: int) -> Field:
        """A field: every second line of the frame, each the mean over two lines' height, at one instant."""
        picture = np.empty((HEIGHT_PX // 2, WIDTH_PX, 3), dtype=np.float32)
        table = view_table(self.flight.view(self.camera, time_s))
        table[4, 0] /= self.geometry.still_px_per_video_px
        sampling = np.array([float(row), 2.0, 2.0, 2.0, 1.0, LATTICE_PX])
        render_rows(self.world.ground, self.lattice, table, sampling, picture)
        return picture


def make_finder(world: World, camera: SimulatedCamera, flight: Flight, options: SimulationOptions) -> Finder:
    """The finder of a flight."""
    geometry = finder_geometry(camera, options.seed)
    columns = (np.arange(WIDTH_PX // LATTICE_PX + 4) - 1.0) * LATTICE_PX
    rows = (np.arange(HEIGHT_PX // LATTICE_PX + 4) - 1.0) * LATTICE_PX
    grid = geometry.still_from_video(np.stack(np.meshgrid(columns, rows), axis=-1))
    return Finder(
        world=world,
        camera=camera,
        flight=flight,
        options=options,
        geometry=geometry,
        lattice=camera.ideal_of(grid.reshape(-1, 2)).reshape(grid.shape),
        drift=make_wobble(np.random.default_rng([options.seed, 6]), (0.03, 0.3), (0.07,)),
    )


def write_video(path: Path, finder: Finder, progress: Progress) -> None:
    """Write a finder's whole video; one thread encodes, ``workers`` render."""
    write_frames(
        path, _counted(finder, progress), FRAME_RATE[finder.options.video_standard], finder.options.field_order
    )


def _counted(finder: Finder, progress: Progress) -> Iterator[Image]:
    for number, planes in enumerate(_frames(finder), start=1):
        yield planes
        progress("video", number, finder.frame_count)


def write_frames(path: Path, frames: Iterable[Image], rate: Fraction, order: FieldOrder) -> None:
    """Encode woven frames, planar YUV 4:2:0 (720, 640), as interlaced MPEG-4 in AVI (FFmpeg's own encoder)."""
    import av

    with av.open(str(path), "w", format="avi") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
        stream.bit_rate, stream.gop_size = BIT_RATE, 15
        stream.thread_count = 1  # the bytes must not depend on the machine
        stream.codec_context.options = {"flags": "+ildct+ilme"}
        marked = _field_marker(order, 1 / rate)
        for number, planes in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
            frame.pts, frame.time_base = number, 1 / rate
            marked.push(frame)
            container.mux(stream.encode(marked.pull()))
        container.mux(stream.encode(None))


def _field_marker(order: FieldOrder, time_base: Fraction) -> "av.filter.Graph":  # type: ignore[name-defined] # noqa: F821
    """A filter that only marks frames as interlaced, with the order of their fields."""
    import av.filter
    from av.video.format import VideoFormat

    graph = av.filter.Graph()
    pixels = VideoFormat("yuv420p", WIDTH_PX, HEIGHT_PX)
    source = graph.add_buffer(width=WIDTH_PX, height=HEIGHT_PX, format=pixels, time_base=time_base)
    marker = graph.add("setfield", "tff" if order is FieldOrder.TOP_FIRST else "bff")
    sink = graph.add("buffersink")
    source.link_to(marker)
    marker.link_to(sink)
    graph.configure()
    return graph


def _frames(finder: Finder) -> Iterator[Image]:
    """All frames in order, rendered a few ahead."""
    workers = finder.options.workers
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Image]] = deque()
        for number in range(finder.frame_count):
            waiting.append(pool.submit(finder.frame, number))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
