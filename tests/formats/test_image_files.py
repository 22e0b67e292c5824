"""Stills from files: headers, order, pixels, and files that cannot be read."""

import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.formats.media import dms, picture, write_jpeg
from uavkit.core.devices import StillSource
from uavkit.core.errors import InputError
from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.formats.exif import parse_drone_tags
from uavkit.formats.image_files import FileStillSource, natural_key

DATA = Path(__file__).resolve().parents[2] / "../shared/data/images/dji_park/images"
NOON_NS = gps_time_ns_from_utc(datetime(2024, 5, 6, 12, 0, 0, tzinfo=UTC))


def place(latitude: float, longitude: float, **more: object) -> dict[int, object]:
    gps: dict[int, object] = {
        1: "N" if latitude >= 0 else "S",
        2: dms(latitude),
        3: "E" if longitude >= 0 else "W",
        4: dms(longitude),
    }
    return gps | {int(key.removeprefix("tag")): value for key, value in more.items()}


def test_header_time_with_fraction_and_offset(tmp_path: Path) -> None:
    write_jpeg(
        tmp_path / "a.JPG",
        time="2024:05:06 21:00:00",
        detail={37521: "25", 36881: "+09:00", 37386: 5.1, 41989: 24},
        main={271: "RICOH\0\0", 272: "Caplio GX200  "},
    )
    (still,) = FileStillSource(tmp_path).stills()
    assert still.camera_time_ns == NOON_NS + 250_000_000
    assert still.camera_time_resolution_ns == 10_000_000
    assert (still.maker, still.model) == ("RICOH", "Caplio GX200")
    assert (still.focal_length_mm, still.focal_length_35mm) == (5.1, 24.0)
    assert (still.width_px, still.height_px, still.position) == (64, 48, None)


def test_a_naive_camera_clock_is_read_as_utc_in_whole_seconds(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", time="2024:05:06 12:00:00")
    (still,) = FileStillSource(tmp_path).stills()
    assert (still.camera_time_ns, still.camera_time_resolution_ns) == (NOON_NS, 1_000_000_000)


@pytest.mark.parametrize("time", ["0000:00:00 00:00:00", "", "yesterday", "1970:01:01 00:00:00", "9999:12:31 23:59:59"])
def test_a_clock_never_set_tells_no_time(tmp_path: Path, time: str) -> None:
    write_jpeg(tmp_path / "a.jpg", time=time)
    assert FileStillSource(tmp_path).stills()[0].camera_time_ns is None


@pytest.mark.parametrize(("time", "zone"), [("9999:12:31 23:59:59", "-09:00"), ("0001:01:01 00:00:00", "+09:00")])
def test_a_time_zone_beyond_the_calendar_tells_no_time(tmp_path: Path, time: str, zone: str) -> None:
    gps = place(35.8, 139.65, tag29="9998:01:01", tag7=(1.0, 2.0, 3.0))
    write_jpeg(tmp_path / "a.jpg", time=time, detail={36881: zone}, gps=gps)
    (still,) = FileStillSource(tmp_path).stills()
    assert still.camera_time_ns is None
    assert still.position is not None
    assert still.position.gps_time_ns is None


@pytest.mark.parametrize("latitude, longitude", [(35.8, 139.65), (-35.8, 139.65), (35.8, -139.65), (-0.5, -0.25)])
def test_gps_signs(tmp_path: Path, latitude: float, longitude: float) -> None:
    write_jpeg(tmp_path / "a.jpg", gps=place(latitude, longitude, tag6=Fr(1983, 10), tag31=Fr(3, 2)))
    position = FileStillSource(tmp_path).stills()[0].position
    assert position is not None
    assert position.latitude_deg == pytest.approx(latitude, abs=1e-8)
    assert position.longitude_deg == pytest.approx(longitude, abs=1e-8)
    assert (position.height_m, position.height_datum) == (198.3, HeightDatum.UNKNOWN)
    assert (position.sigma_horizontal_m, position.sigma_vertical_m) == (1.5, None)


def Fr(numerator: int, denominator: int) -> object:
    from PIL.TiffImagePlugin import IFDRational

    return IFDRational(numerator, denominator)


@pytest.mark.parametrize(
    "reference, height_m, datum",
    [
        (b"\0", 12.5, HeightDatum.UNKNOWN),
        (b"\1", -12.5, HeightDatum.UNKNOWN),
        (b"\2", 12.5, HeightDatum.GEOID),
        (b"\3", -12.5, HeightDatum.GEOID),
    ],
)
def test_altitude_reference(tmp_path: Path, reference: bytes, height_m: float, datum: HeightDatum) -> None:
    write_jpeg(tmp_path / "a.jpg", gps=place(35.0, 139.0, tag5=reference, tag6=Fr(25, 2)))
    position = FileStillSource(tmp_path).stills()[0].position
    assert position is not None
    assert (position.height_m, position.height_datum) == (height_m, datum)


def test_zero_zero_is_no_position(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", gps=place(0.0, 0.0, tag6=Fr(0, 1)))
    assert FileStillSource(tmp_path).stills()[0].position is None


def test_position_without_any_altitude_has_no_height(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", gps=place(35.0, 139.0))
    position = FileStillSource(tmp_path).stills()[0].position
    assert position is not None
    assert np.isnan(position.height_m)
    assert position.height_datum is HeightDatum.UNKNOWN


def test_rtk_tags_of_dji_give_sigma_and_datum(tmp_path: Path) -> None:
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description drone-dji:AltitudeType="RtkAlt"'
        ' drone-dji:AbsoluteAltitude="+61.20" drone-dji:RelativeAltitude="+40.10" drone-dji:GimbalPitchDegree="-89.90"'
        ' drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015" drone-dji:RtkStdHgt="0.03"/>'
        "</rdf:RDF></x:xmpmeta>"
    )
    write_jpeg(tmp_path / "a.jpg", gps=place(35.0, 139.0, tag6=Fr(612, 10)), xmp=xmp)
    source = FileStillSource(tmp_path)
    position = source.stills()[0].position
    assert position is not None
    assert position.height_datum is HeightDatum.ELLIPSOID
    assert (position.sigma_horizontal_m, position.sigma_vertical_m) == (0.015, 0.03)
    tags = source.drone_tags("a.jpg")
    assert (tags.relative_altitude_m, tags.gimbal_pitch_deg) == (40.1, -89.9)


def test_single_point_positions_have_no_trusted_sigma() -> None:
    tags = parse_drone_tags("<drone-dji:RtkFlag>16</drone-dji:RtkFlag><drone-dji:RtkStdHgt>0.01</drone-dji:RtkStdHgt>")
    assert (tags.rtk_flag, tags.rtk_sigma_vertical_m) == ("16", 0.01)


@settings(derandomize=True)
@given(st.binary(max_size=400))
def test_no_xmp_breaks_the_reader(packet: bytes) -> None:
    parse_drone_tags(b'drone-dji:RelativeAltitude="' + packet)


def test_order_is_natural_and_suffixes_know_no_case(tmp_path: Path) -> None:
    names = ["IMG_10.JPG", "IMG_9.jpeg", "img_2.Jpg"]
    for name in names:
        write_jpeg(tmp_path / name)
    Image.fromarray(picture()).save(tmp_path / "IMG_11.TIF")
    Image.fromarray(picture()).save(tmp_path / "IMG_12.png")
    (tmp_path / "._IMG_9.jpeg").write_bytes(b"Mac OS keeps such files")
    (tmp_path / "readme.txt").write_text("no still")
    source = FileStillSource(tmp_path)
    assert [s.name for s in source.stills()] == ["img_2.Jpg", "IMG_9.jpeg", "IMG_10.JPG", "IMG_11.TIF", "IMG_12.png"]
    assert isinstance(source, StillSource)
    assert source.unreadable() == {}


def test_clock_beats_names_where_the_counter_wrapped(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "DSC_0001.JPG", time="2024:05:06 12:00:09")
    write_jpeg(tmp_path / "DSC_9998.JPG", time="2024:05:06 12:00:03")
    write_jpeg(tmp_path / "DSC_9999.JPG", time="2024:05:06 12:00:06")
    source = FileStillSource(tmp_path)
    assert [still.name for still in source.stills()] == ["DSC_9998.JPG", "DSC_9999.JPG", "DSC_0001.JPG"]
    assert "clock" in source.notes()[0]


@settings(derandomize=True)
@given(st.lists(st.text(min_size=1, max_size=12)))
def test_natural_keys_compare_for_any_names(names: list[str]) -> None:
    assert sorted(sorted(names), key=natural_key) == sorted(sorted(names, reverse=True), key=natural_key)


def test_pixels_are_the_raster_whatever_the_orientation_flag_says(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "plain.jpg")
    write_jpeg(tmp_path / "turned.jpg", main={274: 6})
    source = FileStillSource(tmp_path)
    assert source.grey("turned.jpg").shape == (48, 64)
    assert np.array_equal(source.grey("turned.jpg"), source.grey("plain.jpg"))
    difference = source.colour("turned.jpg").astype(int) - picture()
    assert np.abs(difference).mean() < 4  # JPEG's loss; red and blue swapped give above 40
    assert (source.stills()[1].width_px, source.stills()[1].height_px) == (64, 48)


def test_png_and_tiff_are_read_exactly(tmp_path: Path) -> None:
    for name in ("a.png", "a.tif"):
        Image.fromarray(picture()).save(tmp_path / name)
        assert np.array_equal(FileStillSource(tmp_path).colour(name), picture())


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.97])
def test_a_truncated_still_does_not_hide_the_others(tmp_path: Path, suffix: str, share: float) -> None:
    write_jpeg(tmp_path / "good.jpg")
    bad = tmp_path / f"bad.{suffix}"
    Image.fromarray(picture(200, 150)).save(bad)
    content = bad.read_bytes()
    bad.write_bytes(content[: int(len(content) * share)])
    source = FileStillSource(tmp_path)
    assert [still.name for still in source.stills()] == ["good.jpg"]
    assert list(source.unreadable()) == [bad.name]
    with pytest.raises(InputError, match=rf"bad\.{suffix}: .*(empty|truncated|damaged)"):
        source.grey(bad.name)
    if share == 0.0:
        assert "empty" in source.unreadable()[bad.name]


def test_the_thumbnails_end_marker_does_not_pass_for_the_pictures(tmp_path: Path) -> None:
    thumbnail = write_jpeg(tmp_path / "thumb.jpg").read_bytes()
    exif_like = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = write_jpeg(tmp_path / "whole.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[:2] + exif_like + whole[2:-2] + b"\x55" * 100)
    (tmp_path / "padded.jpg").write_bytes(whole[:2] + exif_like + whole[2:] + b"\0" * 100)
    source = FileStillSource(tmp_path)
    assert list(source.unreadable()) == ["cut.jpg"]
    assert np.array_equal(source.grey("padded.jpg"), source.grey("whole.jpg"))


def test_a_file_that_is_no_picture_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8" + b"no picture at all \xff\xd9")
    source = FileStillSource(tmp_path)
    assert source.stills() == ()
    assert list(source.unreadable()) == ["a.jpg"]
    with pytest.raises(InputError, match=r"a\.jpg"):
        source.grey("a.jpg")


def test_fingerprint_follows_the_content(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", seed=1)
    source = FileStillSource(tmp_path)
    before = source.fingerprint("a.jpg")
    assert source.fingerprint("a.jpg") == before
    write_jpeg(tmp_path / "a.jpg", seed=2)
    os.utime(tmp_path / "a.jpg", ns=(1, 1))
    assert source.fingerprint("a.jpg") != before


def test_errors_name_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "100MEDIA").mkdir()
    write_jpeg(tmp_path / "100MEDIA" / "DJI_0001.JPG")
    with pytest.raises(InputError, match=r"did you mean .*100MEDIA"):
        FileStillSource(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        FileStillSource(tmp_path / "absent")
    with pytest.raises(InputError, match=r"did you mean 'DJI_0001\.JPG'"):
        FileStillSource(tmp_path / "100MEDIA").grey("DJI_001.JPG")
    (tmp_path / "101MEDIA").mkdir()
    write_jpeg(tmp_path / "101MEDIA" / "DJI_0001.JPG")
    with pytest.raises(InputError, match="same name"):
        FileStillSource(sorted(tmp_path.rglob("*.JPG")))


@pytest.mark.skipif(not DATA.is_dir(), reason="the test stills are not here")
def test_a_real_flight() -> None:
    source = FileStillSource(DATA)
    stills = source.stills()
    assert len(stills) == 18
    assert source.unreadable() == {}
    first = stills[0]
    assert (first.name, first.maker, first.model) == ("DJI_0018.JPG", "DJI", "FC300S")
    assert (first.focal_length_mm, first.focal_length_35mm) == (3.61, 20.0)
    assert first.position is not None
    assert first.position.latitude_deg == pytest.approx(46 + 50 / 60 + 33.3855 / 3600, abs=1e-9)
    assert first.position.longitude_deg == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600), abs=1e-9)
    assert first.position.height_datum is HeightDatum.UNKNOWN
    assert source.drone_tags(first.name).relative_altitude_m == 39.8
    assert source.grey(first.name).shape == (2250, 4000)
