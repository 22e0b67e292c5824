"""Videos from files: exact luminance, indexes and times, field orders, and damage."""

from pathlib import Path

import numpy as np
import pytest

from tests.formats.media import counter_luminance, index_of, write_jpeg, write_video
from uavkit.core.devices import VideoSource
from uavkit.core.errors import InputError
from uavkit.core.records import FieldOrder
from uavkit.formats.video import FileVideoSource

DATA = Path(__file__).resolve().parents[2] / "../shared/data/video"
INTERVAL_NS = 33_366_667


@pytest.fixture(scope="module")
def avi(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "flight.avi", 40)


@pytest.mark.parametrize("name", ["flight.avi", "flight.mkv", "flight.mp4"])
def test_each_frame_comes_once_in_order_with_its_time(tmp_path: Path, name: str) -> None:
    source = FileVideoSource(write_video(tmp_path / name, 40))
    frames = list(source.frames())
    assert isinstance(source, VideoSource)
    assert [frame.index for frame in frames] == list(range(40))
    assert [index_of(frame.luminance) for frame in frames] == list(range(40))
    # Matroska counts whole milliseconds; the other two are exact
    tolerance = 1_000_000 if name.endswith("mkv") else 1
    assert np.allclose([f.time_ns for f in frames], np.arange(40) * 1001e9 / 30000, rtol=0, atol=tolerance)
    info = source.info()
    assert (info.width_px, info.height_px, info.frame_interval_ns, info.frame_count) == (96, 64, INTERVAL_NS, 40)
    assert source.damage() == ()


@pytest.mark.parametrize("options", [{}, {"bf": "2"}])
@pytest.mark.parametrize("name", ["flight.avi", "flight.mkv"])
def test_seeking_gives_the_very_frames_of_reading_from_the_start(
    tmp_path: Path, name: str, options: dict[str, str]
) -> None:
    source = FileVideoSource(write_video(tmp_path / name, 40, options=options))
    whole = {frame.index: frame for frame in source.frames()}
    for first, last in [(1, 3), (11, 13), (12, 12), (13, 30), (37, None)]:
        part = list(source.frames(first, last))
        assert [frame.index for frame in part] == list(range(first, (last or 39) + 1))
        for frame in part:
            assert frame.time_ns == whole[frame.index].time_ns
            assert np.array_equal(frame.luminance, whole[frame.index].luminance)


def test_luminance_is_the_coded_y_without_stretching_its_range(tmp_path: Path) -> None:
    source = FileVideoSource(write_video(tmp_path / "flight.avi", 3))
    for frame in source.frames():
        difference = frame.luminance.astype(int) - counter_luminance(frame.index)
        assert np.abs(difference[:, :40]).mean() < 1.5  # the coder's own loss; stretching 16..235 would change 20 to 5


def test_a_lossless_video_is_read_byte_for_byte(tmp_path: Path) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (5, 64, 96), dtype=np.uint8)
    source = FileVideoSource(write_video(tmp_path / "noise.mkv", 5, codec="ffv1", luminance=lambda i: noise[i]))
    assert np.array_equal(np.array([frame.luminance for frame in source.frames()]), noise)


def test_the_end_of_a_truncated_avi_is_named_and_the_rest_decoded(avi: Path, tmp_path: Path) -> None:
    content = avi.read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(content[: len(content) * 6 // 10])
    source = FileVideoSource(cut)
    frames = list(source.frames())
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert 15 < len(frames) < 30
    assert [index_of(frame.luminance) for frame in frames] == list(range(len(frames)))
    words = " ".join(source.damage())
    assert "promises 40 frames" in words
    assert "cut off" in words


def test_a_missing_index_costs_no_frame(avi: Path, tmp_path: Path) -> None:
    content = avi.read_bytes()
    cut = tmp_path / "noindex.avi"
    cut.write_bytes(content[: content.rindex(b"idx1")])
    source = FileVideoSource(cut)
    assert [index_of(frame.luminance) for frame in source.frames()] == list(range(40))
    assert "index is missing" in " ".join(source.damage())


@pytest.mark.parametrize("start", [0.3, 0.55, 0.8])
def test_seeking_beyond_a_hole_gives_the_same_frames(avi: Path, tmp_path: Path, start: float) -> None:
    content = bytearray(avi.read_bytes())
    place = int(len(content) * start)
    content[place : place + 6000] = bytes(6000)
    hole = tmp_path / "hole.avi"
    hole.write_bytes(content)
    source = FileVideoSource(hole)
    whole = {frame.index: frame for frame in source.frames()}
    part = list(source.frames(30, 35))
    assert len(whole) < 40
    assert part
    for frame in part:
        assert np.array_equal(frame.luminance, whole[frame.index].luminance)
        assert frame.time_ns == whole[frame.index].time_ns
    assert source.damage()


def test_a_destroyed_frame_leaves_the_other_indexes_right(tmp_path: Path) -> None:
    path = write_video(tmp_path / "flight.avi", 40, codec="mjpeg")
    content = bytearray(path.read_bytes())
    place = content.index(b"movi")
    for _ in range(11):
        place = content.index(b"00dc", place + 1)
    size = int.from_bytes(content[place + 4 : place + 8], "little")
    content[place + 8 : place + 8 + size] = bytes(size)
    path.write_bytes(content)
    source = FileVideoSource(path)
    frames = list(source.frames())
    assert [frame.index for frame in frames] == [index for index in range(40) if index != 10]
    assert all(index_of(frame.luminance) == frame.index for frame in frames)
    assert source.damage()


@pytest.mark.parametrize("keep", [0, 200, 3000])
def test_too_little_of_a_video_is_an_input_error(avi: Path, tmp_path: Path, keep: int) -> None:
    cut = tmp_path / "cut.avi"
    cut.write_bytes(avi.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"cut\.avi"):
        FileVideoSource(cut)


def test_other_files_are_no_videos(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("flown on Tuesday\n" * 100)
    write_jpeg(tmp_path / "still.jpg")
    for name in ("notes.txt", "still.jpg", "absent.avi"):
        with pytest.raises(InputError, match=name):
            FileVideoSource(tmp_path / name)


def _woven(first_row: int) -> "np.typing.NDArray[np.uint8]":
    frame = np.full((64, 96), 60, dtype=np.uint8)
    frame[first_row::2] = 180
    return frame


def test_an_unflagged_video_tells_no_field_order(avi: Path) -> None:
    assert FileVideoSource(avi).info().field_order is None


@pytest.mark.parametrize("top, order", [("1", FieldOrder.TOP_FIRST), ("0", FieldOrder.BOTTOM_FIRST)])
def test_field_order_of_flagged_mpeg4_frames(tmp_path: Path, top: str, order: FieldOrder) -> None:
    interlaced_dct = 1 << 18
    filtered = f"setfield={'tff' if top == '1' else 'bff'}"
    path = write_interlaced(tmp_path / "woven.avi", filtered, interlaced_dct)
    assert FileVideoSource(path).info().field_order is order


def write_interlaced(path: Path, filtered: str, flags: int) -> Path:
    """Encode frames whose flags a filter sets, as PyAV cannot."""
    import av
    from av.filter import Graph

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30, options={"qscale": "2"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.codec_context.flags |= flags
        graph = Graph()
        nodes = [
            graph.add_buffer(width=96, height=64, format=av.VideoFormat("yuv420p"), time_base=stream.time_base or 1),
            graph.add(*filtered.split("=")),
            graph.add("buffersink"),
        ]
        nodes[0].link_to(nodes[1])
        nodes[1].link_to(nodes[2])
        graph.configure()
        for index in range(6):
            plane = np.vstack([_woven(0), np.full((32, 96), 128, dtype=np.uint8)])
            frame = av.VideoFrame.from_ndarray(plane, format="yuv420p")
            frame.pts = index
            graph.push(frame)
            container.mux(stream.encode(graph.pull()))
        container.mux(stream.encode(None))
    return path


@pytest.mark.skipif(not DATA.is_dir(), reason="the test videos are not here")
@pytest.mark.parametrize("name, order", [("tff", FieldOrder.TOP_FIRST), ("bff", FieldOrder.BOTTOM_FIRST)])
def test_field_order_of_real_ntsc_videos(name: str, order: FieldOrder) -> None:
    source = FileVideoSource(DATA / f"bt601-525_480_interlaced_{name}.mkv")
    assert source.info().field_order is order
    assert source.info().frame_count == 300
    assert source.info().frame_interval_ns == INTERVAL_NS
    assert source.damage() == ()
    part = list(source.frames(100, 102))
    assert [frame.index for frame in part] == [100, 101, 102]
    assert part[0].luminance.std() > 10
