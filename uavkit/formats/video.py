"""Videos from files: the filling of ``VideoSource`` that decodes with PyAV (FFmpeg).

The luminance is the coded Y plane, byte for byte: no conversion to RGB and back, limited range (16 to 235) stays
limited and full range full. A rotation flag is ignored as the interior orientation belongs to the sensor's raster.
A damaged file gives what can be decoded; ``damage`` says what was lost.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uavkit.core.arrays import Image
from uavkit.core.errors import InputError
from uavkit.core.records import FieldOrder, VideoFrame, VideoInfo

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.stream import VideoStream

_DISPLAYED_FIRST = {
    1: FieldOrder.PROGRESSIVE,
    2: FieldOrder.TOP_FIRST,
    3: FieldOrder.BOTTOM_FIRST,
    4: FieldOrder.BOTTOM_FIRST,
    5: FieldOrder.TOP_FIRST,
}
"""FFmpeg's AVFieldOrder: progressive, TT, BB, TB, BT; the second letter is the field that is displayed first."""
_NO_VIDEO_FORMATS = ("_pipe", "image2", "tty", "webp")
"""FFmpeg opens single pictures and even plain texts as videos by these."""
_PACKED_LUMINANCE = {"yuyv422": 0, "yvyu422": 0, "uyvy422": 1}
"""Place of the first Y among the bytes of packed formats with two bytes a pixel."""


@dataclass(frozen=True, slots=True)
class _PacketIndex:
    """Presentation times of a video's packets."""

    count: int
    pts: tuple[int, ...]
    """In the order of display; empty where packets tell none or not one each."""
    key_pts: tuple[int, ...]
    pts_at: dict[int, int]
    """Presentation time by place in the file, as reading from the start tells it."""
    dropped: int
    """Packets without content, by which AVI records that a frame was dropped."""


class FileVideoSource:
    """A video file, frame by frame; frame n has the n-th presentation time of the file."""

    def __init__(self, path: Path) -> None:
        """Open a video and read its packets' times; raises InputError where it is none or holds no frame."""
        self._path = Path(path)
        self._damage: list[str] = []
        with self._open() as container:
            stream = _video_stream(container, self._path)
            promised = int(stream.frames)
            self._index = self._read_index(container, stream)
        if self._index.count == 0:
            raise InputError(
                f"{self._path}: the video holds no frame that can be read: copy it again from the recorder"
            )
        cut = _avi_damage(self._path)
        for note in cut:
            self._note(note)
        if promised > self._index.count + self._index.dropped:
            where = "some before the end, later frames seem earlier than they were"
            where = "those at the end" if cut or self._path.suffix.lower() != ".avi" else where
            self._note(f"the header promises {promised} frames, the file holds {self._index.count}; missing: {where}")
        self._info = self._read_info()

    def info(self) -> VideoInfo:
        """Return size, rate and field order; the field order is None where the coding does not tell it."""
        return self._info

    def damage(self) -> tuple[str, ...]:
        """Return what was found damaged so far, in words; decoding errors appear when the frames have been read."""
        return tuple(self._damage)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the file."""
        return self._sha256

    @cached_property
    def _sha256(self) -> str:
        with self._path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[VideoFrame]:
        """Yield the frames with first <= index <= last; a frame that cannot be decoded leaves a gap in the indexes.

        Decoding begins at the key frame before ``first``, which is verified by presentation times; where these do not
        tell, it begins at the start of the file.
        """
        for index, frame in self._decoded_from(first):
            if last is not None and index > last:
                return
            if index < first:
                continue
            if (frame.width, frame.height) != (self._info.width_px, self._info.height_px):
                self._note(f"frame {index} has another size, {frame.width} x {frame.height}, and is left out")
                continue
            if frame.is_corrupt:
                self._note(f"frame {index} is damaged")
            yield VideoFrame(
                index=index,
                time_ns=self._time_ns(index),
                luminance=luminance(frame),
                damaged=bool(frame.is_corrupt),
            )

    def _decoded_from(self, first: int) -> Iterator[tuple[int, "av.VideoFrame"]]:
        """Yield (index, frame) from the key frame before ``first``, or from the start where seeking does not hit it."""
        key = self._key_before(first)
        if key is not None:
            seeking = self._decode(seek_pts=key)
            head = next(seeking, None)
            while head is not None and head[0] < 0:  # frames before the key frame's that lack their references
                head = next(seeking, None)
            if head is not None and head[0] <= first:
                yield head
                yield from seeking
                return
        yield from self._decode(seek_pts=None)

    def _key_before(self, first: int) -> int | None:
        if not self._index.pts or first <= 0 or first >= len(self._index.pts):
            return None
        keys = [pts for pts in self._index.key_pts if pts <= self._index.pts[first]]
        return keys[-1] if len(keys) > 1 else None

    def _decode(self, seek_pts: int | None) -> Iterator[tuple[int, "av.VideoFrame"]]:
        """Yield (index, frame); frames of unknown time after a seek have index -1."""
        lookup = {pts: index for index, pts in enumerate(self._index.pts)}
        counter = -1
        with self._open() as container:
            stream = _video_stream(container, self._path)
            if seek_pts is not None:
                container.seek(seek_pts, stream=stream, backward=True)
            for pts, frame in self._frames_of(container, stream):
                if seek_pts is not None:
                    index = lookup.get(pts, -1) if pts is not None and pts >= seek_pts else -1
                else:
                    told = counter + 1 if pts is None else lookup.get(pts, counter + 1)
                    counter = index = max(told, counter + 1)
                yield index, frame

    def _frames_of(
        self, container: "InputContainer", stream: "VideoStream"
    ) -> Iterator[tuple[int | None, "av.VideoFrame"]]:
        """Yield (presentation time, frame) of what can be decoded.

        Where an AVI has lost chunks, times after a seek (from its index) differ from those of reading from the start
        (which counts chunks): the place of each packet in the file ties the former to the latter.
        """
        from av.error import FFmpegError

        shift = 0
        try:
            for packet in container.demux(stream):
                if packet.size == 0 and packet.pts is not None:
                    continue  # a dropped frame of AVI: an empty packet would end the decoder
                if packet.pts is not None and packet.pos is not None:
                    shift = self._index.pts_at.get(packet.pos, packet.pts + shift) - packet.pts
                try:
                    for frame in packet.decode():
                        yield (None if frame.pts is None else frame.pts + shift), frame
                except FFmpegError:
                    self._note(f"a frame cannot be decoded: {self._moment(packet)}")
        except FFmpegError as error:
            self._note(f"reading ends early: {error.strerror or error}")

    def _moment(self, packet: Any) -> str:
        if packet.pts is None or packet.time_base is None:
            return "nothing tells which one"
        return f"the one at {float(packet.pts * packet.time_base):.2f} s"

    def _time_ns(self, index: int) -> int:
        if index >= len(self._index.pts):
            return index * self._info.frame_interval_ns
        ticks = self._index.pts[index] - self._index.pts[0]
        return round(ticks * self._time_base.numerator * 1_000_000_000 / self._time_base.denominator)

    def _read_index(self, container: "InputContainer", stream: "VideoStream") -> _PacketIndex:
        """Read all packets without decoding them."""
        from av.error import FFmpegError

        if stream.time_base is None:
            raise InputError(f"{self._path}: the video has no time base: convert it to AVI, MKV or MP4 anew")
        self._time_base = stream.time_base
        count, dropped, times, keys, places = 0, 0, [], [], {}
        try:
            for packet in container.demux(stream):
                if packet.size == 0:
                    dropped += packet.pts is not None
                    continue
                count += 1
                if packet.pts is not None:
                    times.append(packet.pts)
                    places.update({packet.pos: packet.pts} if packet.pos is not None else {})
                    keys += [packet.pts] if packet.is_keyframe else []
        except FFmpegError as error:
            self._note(f"reading ends after packet {count}: {error.strerror or error}")
        if len(set(times)) != count:
            times, keys, places = [], [], {}
        return _PacketIndex(count, tuple(sorted(times)), tuple(sorted(keys)), places, dropped)

    def _read_info(self) -> VideoInfo:
        head = next((frame for _, frame in self._decode(seek_pts=None)), None)
        if head is None:
            raise InputError(f"{self._path}: no frame of the video can be decoded: copy it again from the recorder")
        with self._open() as container:
            stream = _video_stream(container, self._path)
            rate = stream.average_rate or stream.guessed_rate
            coded = _DISPLAYED_FIRST.get(int(getattr(stream.codec_context, "field_order", 0) or 0))
        steps = np.diff(self._index.pts)
        if rate:
            interval_ns = round(1_000_000_000 / rate)
        elif len(steps):
            interval_ns = round(float(np.median(steps)) * float(self._time_base) * 1e9)
        else:
            raise InputError(
                f"{self._path}: the video does not tell its frame rate: convert it to AVI, MKV or MP4 anew"
            )
        return VideoInfo(
            name=self._path.name,
            width_px=head.width,
            height_px=head.height,
            frame_interval_ns=interval_ns,
            field_order=coded or _flagged_order(head),
            frame_count=self._index.count,
        )

    def _open(self) -> "InputContainer":
        import av
        from av.error import FFmpegError

        if not self._path.is_file():
            raise InputError(f"{self._path}: there is no such video file")
        if self._path.stat().st_size == 0:
            raise InputError(f"{self._path}: the file is empty (0 bytes): copy it again from the recorder")
        try:
            container = av.open(str(self._path), metadata_errors="ignore")
        except FFmpegError as error:
            raise InputError(
                f"{self._path}: no video that can be read ({error.strerror or error}): give an AVI, MKV or MP4 file"
            ) from error
        if any(container.format.name.endswith(name) for name in _NO_VIDEO_FORMATS):
            container.close()
            raise InputError(f"{self._path}: this is no video: give an AVI, MKV, MP4 or MOV file")
        return container

    def _note(self, text: str) -> None:
        if text not in self._damage:
            self._damage.append(text)


def luminance(frame: "av.VideoFrame") -> Image:
    """Return the coded luminance (height, width) of a frame; RGB and formats of more than 8 bits are converted."""
    name, width, height = frame.format.name, frame.width, frame.height
    plane = frame.planes[0]
    rows = np.frombuffer(memoryview(plane), dtype=np.uint8).reshape(-1, plane.line_size)[:height]
    if name in _PACKED_LUMINANCE:
        return np.ascontiguousarray(rows[:, _PACKED_LUMINANCE[name] : 2 * width : 2])
    planar = name.startswith(("yuv", "nv", "gray")) and frame.format.components[0].bits == 8
    if planar and (len(frame.planes) > 1 or name == "gray"):
        return np.array(rows[:, :width])
    return np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)


def _video_stream(container: "InputContainer", path: Path) -> "VideoStream":
    if not container.streams.video:
        raise InputError(
            f"{path}: the file holds no video, only {', '.join(s.type for s in container.streams) or 'data'}"
        )
    return container.streams.video[0]


def _flagged_order(frame: "av.VideoFrame") -> FieldOrder | None:
    """Return the field order that a frame's own flags state, None where they do not say "interlaced".

    PyAV shows no flag for the first field, but FFmpeg's ``separatefields`` obeys it: its first output is that field.
    """
    if not frame.interlaced_frame:
        return None  # coders of capture devices flag woven fields as progressive: that is not knowledge
    from av.error import FFmpegError
    from av.filter import Graph

    graph = Graph()
    source = graph.add_buffer(
        width=frame.width,
        height=frame.height,
        format=frame.format,
        time_base=frame.time_base,
    )
    fields = graph.add("separatefields")
    sink = graph.add("buffersink")
    source.link_to(fields)
    fields.link_to(sink)
    try:
        graph.configure()
        graph.push(frame)
        first = luminance(graph.vpull())
    except FFmpegError:
        return None
    whole = luminance(frame)
    top, bottom = whole[0::2][: len(first)], whole[1::2][: len(first)]
    if np.array_equal(top, bottom):
        return None
    return FieldOrder.TOP_FIRST if np.array_equal(first[: len(top)], top) else FieldOrder.BOTTOM_FIRST


def _avi_damage(path: Path) -> list[str]:
    """Return what an AVI's chunks tell of a recording that was cut off; nothing for other formats."""
    size = path.stat().st_size
    notes, chunks = [], set()
    with path.open("rb") as stream:
        if stream.read(4) != b"RIFF":
            return []
        riff_size = int.from_bytes(stream.read(4), "little")
        if stream.read(4) != b"AVI ":
            return []
        place = 12
        while place + 8 <= size:
            stream.seek(place)
            kind, length = stream.read(4), int.from_bytes(stream.read(4), "little")
            chunks.add(kind)
            if kind == b"LIST" and stream.read(4) == b"movi" and (length == 0 or place + 8 + length > size):
                notes.append("the recording was cut off: the part with the frames ends early")
                break
            place += 8 + length + length % 2
    if b"idx1" not in chunks and riff_size + 8 != size:
        notes.append("the AVI's index is missing, as after a recording that was cut off")
    elif b"idx1" not in chunks and not _has_opendml_index(path):
        notes.append("the AVI's index is missing")
    return notes


def _has_opendml_index(path: Path) -> bool:
    with path.open("rb") as stream:
        return b"indx" in stream.read(65_536)
