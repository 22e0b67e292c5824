"""Copies with positions: what is written is read back by uavkit and by exiftool, and nothing else has changed."""

import os
import random
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.formats.geotag_stills import (
    app1,
    bare_jpeg,
    exif_block,
    exiftool,
    old_gps,
    packet,
    tags_of,
    warnings_of,
    write_still,
)
from tests.formats.media import picture
from uavkit.core.angles import rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.gpstime import gps_time_ns_from_utc, utc_from_gps_time_ns
from uavkit.core.heights import HeightDatum
from uavkit.formats.exif import parse_drone_tags, read_header
from uavkit.formats.geotag import GeoTag, write_geotagged, yaw_pitch_roll_deg
from uavkit.formats.jpeg_segments import read_segments

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
PARK = DATA / "images/dji_park/images"
TIME_NS = 1_300_000_000_123_456_789
OBLIQUE = rotation_from_omega_phi_kappa(0.8, 0.1, 2.5)
CAMERA, UAVKIT = "XMP-Camera:", "XMP-uavkit:"


def tag(**changes: object) -> GeoTag:
    values: dict[str, object] = {
        "latitude_deg": -35.800_000_123,
        "longitude_deg": 139.650_000_456,
        "height_m": 55.4321,
        "height_datum": HeightDatum.GEOID,
    }
    return GeoTag(**{**values, **changes})  # type: ignore[arg-type]


def full_tag(**changes: object) -> GeoTag:
    extra = {"gps_time_ns": TIME_NS, "sigma_horizontal_m": 0.0142, "sigma_vertical_m": 0.03}
    return tag(**{**extra, "R_enu_from_image": OBLIQUE, "probability": 0.9987, **changes})


def geotagged(source: Path, given_tag: GeoTag, name: str = "") -> Path:
    target = source.parent / "out" / (name or source.name)
    write_geotagged(source, target, given_tag)
    return target


def position(path: Path) -> tuple[float, float, float]:
    fix = read_header(path)[0].position
    assert fix is not None
    return fix.latitude_deg, fix.longitude_deg, fix.height_m


def others(path: Path) -> tuple[list[bytes], bytes]:
    """Return all segments but EXIF and XMP, and the bytes from the first scan on."""
    data = path.read_bytes()
    with path.open("rb") as stream:
        segments = read_segments(stream, path.name)
    ours = (b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0")
    kept = [data[s.start : s.end] for s in segments if not (s.payload or b"").startswith(ours)]
    return kept, data[segments[-1].end :]


def segment_of(path: Path, header: bytes) -> bytes:
    with path.open("rb") as stream:
        payloads = [s.payload or b"" for s in read_segments(stream, path.name)]
    return next(p[len(header) :] for p in payloads if p.startswith(header))


def exif_of(path: Path) -> bytes:
    return segment_of(path, b"Exif\0\0")


def xmp_of(path: Path) -> str:
    return segment_of(path, b"http://ns.adobe.com/xap/1.0/\0").decode()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("geotag")


@settings(derandomize=True, max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    latitude=st.floats(-90.0, 90.0),
    longitude=st.floats(-180.0, 180.0),
    height=st.floats(-11_000.0, 100_000.0),
    datum=st.sampled_from([HeightDatum.GEOID, HeightDatum.ELLIPSOID]),
    gps_time_ns=st.none() | st.integers(0, 2_000_000_000_000_000_000),
    order=st.sampled_from("<>"),
    parts=st.tuples(st.booleans(), st.booleans(), st.booleans(), st.booleans(), st.booleans()),
)
@example(90.0, 180.0, -0.0004, HeightDatum.GEOID, 0, "<", (True,) * 5)
@example(-90.0, -180.0, 0.0, HeightDatum.ELLIPSOID, None, ">", (True,) * 5)
@example(-1e-9, 1e-9, 1.0, HeightDatum.GEOID, None, ">", (True, False, False, False, False))
@example(59.999999999999, -59.9999999999, 1.0, HeightDatum.GEOID, None, "<", (False,) * 5)
def test_every_position_is_read_back_and_nothing_else_changes(
    folder: Path,
    latitude: float,
    longitude: float,
    height: float,
    datum: HeightDatum,
    gps_time_ns: int | None,
    order: str,
    parts: tuple[bool, ...],
) -> None:
    with_exif, with_gps, with_xmp, thumbnail, maker_note = parts
    gps = old_gps(order) if with_gps else None
    block = exif_block(order, gps=gps, thumbnail=thumbnail, maker_note=maker_note) if with_exif else None
    xmp = packet('<rdf:Description rdf:about="a" xmlns:q="urn:q" q:w="1"/>') if with_xmp else None
    source = write_still(folder / "a.jpg", exif=block, xmp=xmp, more=app1(b"http://ns.adobe.com/xmp/extension/\0x"))
    given_tag = GeoTag(
        latitude_deg=latitude, longitude_deg=longitude, height_m=height, height_datum=datum, gps_time_ns=gps_time_ns
    )
    copy = geotagged(source, given_tag)
    assert others(copy) == others(source)
    if block is not None:
        differing = [i for i, (a, b) in enumerate(zip(block, exif_of(copy), strict=False)) if a != b]
        assert all(b - a < 12 for a, b in pairwise(differing))
        assert not differing or differing[-1] - differing[0] < 12  # one pointer, nowhere near a maker note or thumbnail
    info = read_header(copy)[0]
    if abs(latitude) < 1e-10 and abs(longitude) < 1e-10:
        return  # zeros are read as "no position"
    assert info.position is not None
    assert info.maker == ("Maker" if with_exif else "")
    assert info.position.latitude_deg == pytest.approx(latitude, abs=2e-11)
    assert info.position.longitude_deg == pytest.approx(longitude, abs=2e-11)
    assert info.position.height_m == pytest.approx(given_tag.heights_m[0], abs=0.000_51)
    assert info.position.height_datum is HeightDatum.GEOID
    if gps_time_ns is not None:
        assert info.position.gps_time_ns == gps_time_ns_from_utc(utc_from_gps_time_ns(gps_time_ns))


def test_ellipsoidal_heights_become_heights_above_the_geoid(tmp_path: Path) -> None:
    """NGA publishes EGM96's undulation at a test point: -31.628 m; the grid of 15' is good to some cm."""
    source = write_still(tmp_path / "a.jpg")
    place = {"latitude_deg": 38.628_155, "longitude_deg": 269.779_155 - 360.0, "height_m": 100.0}
    above = geotagged(source, tag(**place, height_datum=HeightDatum.ELLIPSOID))
    assert position(above)[2] == pytest.approx(131.628, abs=0.1)
    assert 'uavkit:HeightEllipsoid="100.0000"' in xmp_of(above)
    given_above_sea = geotagged(source, tag(**place, height_datum=HeightDatum.GEOID), "b.jpg")
    assert position(given_above_sea)[2] == 100.0
    ellipsoidal = float(xmp_of(given_above_sea).split('HeightEllipsoid="')[1].split('"')[0])
    assert ellipsoidal == pytest.approx(68.372, abs=0.1)


def test_exiftool_reads_every_tag(tmp_path: Path) -> None:
    sources = [write_still(tmp_path / f"{order}.jpg", exif=exif_block(o)) for order, o in (("II", "<"), ("MM", ">"))]
    sources.append(write_still(tmp_path / "bare.jpg"))
    Image.fromarray(picture()).save(tmp_path / "a.tif")
    sources.append(tmp_path / "a.tif")
    Image.fromarray(picture()).save(tmp_path / "a.png")
    sources.append(tmp_path / "a.png")
    for found in tags_of(*(geotagged(source, full_tag()) for source in sources)):
        assert found["GPS:GPSVersionID"] == "2 3 0 0"
        assert (found["GPS:GPSLatitudeRef"], found["GPS:GPSLongitudeRef"]) == ("S", "E")
        assert found["GPS:GPSLatitude"] == pytest.approx(35.800_000_123, abs=1e-9)
        assert found["GPS:GPSLongitude"] == pytest.approx(139.650_000_456, abs=1e-9)
        assert (found["GPS:GPSAltitudeRef"], found["GPS:GPSAltitude"]) == (0, 55.432)
        assert (found["GPS:GPSDateStamp"], found["GPS:GPSTimeStamp"]) == ("2021:03:17", "07:06:22.123456")
        assert found["GPS:GPSHPositioningError"] == 0.0142
        assert (found["GPS:GPSImgDirectionRef"], found["GPS:GPSMapDatum"]) == ("T", "WGS-84")
        assert found["GPS:GPSProcessingMethod"] == "GPS"
        assert (found[CAMERA + "HorizCS"], found[CAMERA + "VertCS"]) == ("EPSG:4326", "EPSG:5773")
        assert (found[CAMERA + "GPSXYAccuracy"], found[CAMERA + "GPSZAccuracy"]) == (0.0142, 0.03)
        angles = [found[CAMERA + name] for name in ("Yaw", "Pitch", "Roll")]
        assert angles == pytest.approx(yaw_pitch_roll_deg(OBLIQUE), abs=1e-6)
        omega_phi_kappa = np.radians([found[UAVKIT + name] for name in ("Omega", "Phi", "Kappa")])
        assert omega_phi_kappa == pytest.approx([0.8, 0.1, 2.5], abs=1e-7)
        assert found[UAVKIT + "MatchProbability"] == 0.9987


def test_exiftool_reads_places_below_the_sea_at_the_pole_and_at_the_date_line(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg")
    places = [(90.0, 180.0, -430.5), (-90.0, -180.0, 8848.8), (-0.5, -0.25, -0.001), (12.345678912, 0.0, 0.0)]
    copies = [
        geotagged(source, tag(latitude_deg=a, longitude_deg=b, height_m=h), f"{i}.jpg")
        for i, (a, b, h) in enumerate(places)
    ]
    for path, (latitude, longitude, height) in zip(copies, places, strict=True):
        found = exiftool(
            "-n", "-s3", "-p", "$Composite:GPSLatitude $Composite:GPSLongitude $Composite:GPSAltitude", path
        )
        assert [float(n) for n in found.split()] == pytest.approx([latitude, longitude, height], abs=1e-9)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("gps", [True, False])
def test_exiftool_finds_no_new_fault(tmp_path: Path, order: str, gps: bool) -> None:
    xmp = packet('<rdf:Description rdf:about="" xmlns:dc="http://purl.org/dc/elements/1.1/" dc:format="image/jpeg"/>')
    source = write_still(tmp_path / "a.jpg", exif=exif_block(order, gps=old_gps(order) if gps else None), xmp=xmp)
    copy = geotagged(source, full_tag())
    assert set(warnings_of(copy)) <= set(warnings_of(source))
    before, after = tags_of(source, copy)
    ours = ("GPS:", CAMERA, UAVKIT)
    assert {k: v for k, v in after.items() if not k.startswith(ours)} == {
        k: v for k, v in before.items() if not k.startswith(ours)
    }
    bare = write_still(tmp_path / "bare.jpg")
    assert warnings_of(geotagged(bare, full_tag())) == warnings_of(bare) == []


@pytest.mark.skipif(not PARK.is_dir(), reason="the stills of ../shared/data/images/dji_park are not here")
def test_stills_of_a_drone_keep_all_their_other_tags(tmp_path: Path) -> None:
    """Their maker notes, thumbnails, MPF previews and XMP of DJI; the packets' padding takes up all that is new."""
    sources = sorted(PARK.glob("*.JPG"))
    assert len(sources) == 18
    copies = [tmp_path / source.name for source in sources]
    start = time.perf_counter()
    for source, copy in zip(sources, copies, strict=True):
        write_geotagged(source, copy, full_tag())
    assert time.perf_counter() - start < 3.0
    ours = ("GPS:", CAMERA, UAVKIT)
    for source, copy in zip(sources, copies, strict=True):
        assert others(copy) == others(source)
        assert copy.stat().st_size == source.stat().st_size
        assert copy.stat().st_mtime_ns == source.stat().st_mtime_ns
    for before, after in zip(tags_of(*sources), tags_of(*copies), strict=True):
        assert {k: v for k, v in after.items() if not k.startswith(ours)} == {
            k: v for k, v in before.items() if not k.startswith(ours)
        }
        assert {"DJI:CameraPitch", "IFD1:ThumbnailLength", "MPImage2:MPImageStart"} <= after.keys()
        assert after["GPS:GPSLatitude"] == pytest.approx(35.800_000_123, abs=1e-9)
    assert set(warnings_of(copies[0])) <= set(warnings_of(sources[0]))


def test_a_still_without_exif_keeps_its_resolution(tmp_path: Path) -> None:
    for name, options in {"a.jpg": {"dpi": (300, 300)}, "b.jpg": {}, "c.png": {"dpi": (300, 300)}}.items():
        Image.fromarray(picture()).save(tmp_path / name, **options)  # type: ignore[arg-type]
        with Image.open(tmp_path / name) as before, Image.open(geotagged(tmp_path / name, tag())) as after:
            assert after.info.get("dpi", (72, 72)) == before.info.get("dpi", (72, 72))
            assert after.getexif().get(0x11A) == {"a.jpg": 300, "b.jpg": 72}.get(name)


def test_old_tags_of_the_position_go_and_those_of_the_motion_stay(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block(">", gps=old_gps(">")))
    with Image.open(geotagged(source, tag())) as image:
        kept = image.getexif().get_ifd(0x8825)
    assert kept.keys() == {0, 1, 2, 3, 4, 5, 6, 7, 12, 13, 14, 15, 16, 17, 18, 27, 29}
    assert (kept[13], kept[15], kept[17], kept[16], kept[29]) == (18, 90, 45, "M", "2020:02:29")
    assert kept[7] == (1, 2, 3)
    down = rotation_from_omega_phi_kappa(0.02, 0.0, 1.0)
    with Image.open(geotagged(source, tag(R_enu_from_image=down, gps_time_ns=TIME_NS))) as image:
        kept = image.getexif().get_ifd(0x8825)
    assert not {16, 17} & kept.keys()
    assert kept[29] == "2021:03:17"


def test_without_a_height_none_is_written(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<", gps=old_gps("<")))
    copy = geotagged(source, tag(height_m=float("nan"), height_datum=HeightDatum.UNKNOWN))
    assert np.isnan(position(copy)[2])
    assert b"xap/1.0" not in copy.read_bytes()


@pytest.mark.parametrize(
    "looks, top, angles",
    [
        ((0, 0, -1), (0, 1, 0), (0, 0, 0)),
        ((0, 0, -1), (1, 0, 0), (90, 0, 0)),
        ((0, 0, -1), (-1, 0, 0), (270, 0, 0)),
        ((0, 1, 0), (0, 0, 1), (0, 90, 0)),
        ((1, 0, 0), (0, 0, 1), (90, 90, 0)),
        ((0, 1, -1), (0, 1, 1), (0, 45, 0)),
        ((-1, 0, -1), (0, 1, 0), (0, 0, 45)),
    ],
)
def test_yaw_pitch_roll_are_those_of_pix4d(
    looks: tuple[float, ...], top: tuple[float, ...], angles: tuple[float, ...]
) -> None:
    """The cases that its documentation gives, and one of roll: right side down, the camera looks to the left."""
    z, y = -np.array(looks) / np.linalg.norm(looks), np.array(top) / np.linalg.norm(top)
    R = np.column_stack([np.cross(y, z), y, z])
    assert yaw_pitch_roll_deg(R) == pytest.approx(angles, abs=1e-9)


def test_yaw_pitch_roll_make_the_rotation_again() -> None:
    def rotation(axis: int, degrees: float) -> Array:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        R, a = np.eye(3), np.radians(degrees)
        R[i, i], R[i, j], R[j, i], R[j, j] = np.cos(a), -np.sin(a), np.sin(a), np.cos(a)
        return R

    rng = np.random.default_rng(5)
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    body_axes_in_image = np.column_stack([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    for angles in rng.uniform(-np.pi, np.pi, (100, 3)):
        R = rotation_from_omega_phi_kappa(*angles)
        yaw, pitch, roll = yaw_pitch_roll_deg(R)
        assert 0.0 <= yaw <= 360.0
        again = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
        assert again == pytest.approx(ned @ R @ body_axes_in_image, abs=1e-12)


@pytest.mark.parametrize("azimuth, written", [(0.0, 0.0), (123.456, 123.46), (359.999, 0.0), (-90.0, 270.0)])
def test_the_direction_of_the_view_is_written_where_there_is_one(
    tmp_path: Path, azimuth: float, written: float
) -> None:
    source = write_still(tmp_path / "a.jpg")
    a, t = np.radians(azimuth), np.radians(30.0)
    z = -np.array([np.sin(a) * np.sin(t), np.cos(a) * np.sin(t), -np.cos(t)])
    x = np.array([np.cos(a), -np.sin(a), 0.0])
    copy = geotagged(source, tag(R_enu_from_image=np.column_stack([x, np.cross(z, x), z])))
    with Image.open(copy) as image:
        gps = image.getexif().get_ifd(0x8825)
    assert (gps[16], float(gps[17])) == ("T", pytest.approx(written, abs=1e-9))
    assert yaw_pitch_roll_deg(np.column_stack([x, np.cross(z, x), z])) == pytest.approx((azimuth % 360, 30, 0))


def test_a_camera_that_looks_down_has_no_direction(tmp_path: Path) -> None:
    copy = geotagged(write_still(tmp_path / "a.jpg"), tag(R_enu_from_image=np.eye(3)))
    with Image.open(copy) as image:
        assert not {16, 17} & image.getexif().get_ifd(0x8825).keys()
    assert 'Camera:Pitch="0.000000"' in xmp_of(copy)


def test_accuracy_and_datum_are_read_back_also_from_a_copy_of_an_rtk_still(tmp_path: Path) -> None:
    """DJI's own words of the first position stay in the packet: they must not be taken for the new one's."""
    xmp = packet(
        '<rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        ' drone-dji:AltitudeType="RtkAlt" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.5" drone-dji:RtkStdLat="0.5"'
        ' drone-dji:RtkStdHgt="0.9"/>'
    )
    copy = geotagged(write_still(tmp_path / "a.jpg", xmp=xmp), full_tag())
    fix = read_header(copy)[0].position
    assert fix is not None
    assert fix.height_datum is HeightDatum.GEOID
    assert (fix.sigma_horizontal_m, fix.sigma_vertical_m) == (0.0142, 0.03)
    assert 'rdf:about="DJI Meta Data" xmlns:Camera' in " ".join(xmp_of(copy).split())


def test_accuracies_of_other_programs_are_read_in_both_forms() -> None:
    elements = "<Camera:VertCS>ellipsoidal</Camera:VertCS><Camera:GPSXYAccuracy>1.2</Camera:GPSXYAccuracy>"
    for text in (
        elements,
        "Camera:VertCS=\"ellipsoidal\" Camera:GPSXYAccuracy = '1.2'",
        elements + '<Camera:VertCS x="',
    ):
        tags = parse_drone_tags(text)
        assert (tags.camera_vertical_crs, tags.camera_sigma_horizontal_m) == ("ellipsoidal", 1.2)
        assert tags.camera_sigma_vertical_m is None


def test_tagging_again_leaves_one_position(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<"), xmp=packet('<rdf:Description rdf:about=""/>'))
    first = geotagged(source, full_tag(), "1.jpg")
    second = geotagged(first, full_tag(latitude_deg=10.0), "2.jpg")
    third = geotagged(second, full_tag(), "3.jpg")
    assert position(second)[0] == 10.0
    assert xmp_of(third) == xmp_of(first)
    assert position(third) == position(first)


def test_padding_takes_up_what_is_new(tmp_path: Path) -> None:
    """So that whatever points behind the picture by its place in the file still fits."""
    xmp = packet('<rdf:Description rdf:about=""/>', padding=3000)
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<"), xmp=xmp)
    copy = geotagged(source, full_tag())
    assert copy.stat().st_size == source.stat().st_size
    assert xmp_of(copy).endswith('\n<?xpacket end="w"?>')
    source = write_still(tmp_path / "b.jpg", xmp=xmp)
    assert geotagged(source, full_tag()).stat().st_size == source.stat().st_size
    little = write_still(tmp_path / "c.jpg", exif=exif_block("<"), xmp=packet("", padding=40))
    assert "\n" * 40 + "<?xpacket" in xmp_of(geotagged(little, full_tag()))


def test_full_segments_lose_padding_or_are_refused(tmp_path: Path) -> None:
    body = f'<rdf:Description rdf:about=""><q:x xmlns:q="urn:q">{"x" * 60_000}</q:x></rdf:Description>'
    padding = 65_533 - 29 - len(packet(body))
    roomy = write_still(tmp_path / "a.jpg", xmp=packet(body, padding=padding))
    assert 'Camera:VertCS="EPSG:5773"' in xmp_of(geotagged(roomy, full_tag()))
    full = write_still(tmp_path / "b.jpg", xmp=packet(body.replace("x" * 60_000, "x" * (60_000 + padding))))
    with pytest.raises(InputError, match=r"b\.jpg: its XMP segment is so full"):
        geotagged(full, full_tag())
    block = exif_block("<", gps=None)
    crammed = write_still(tmp_path / "c.jpg", exif=block + bytes(65_527 - len(block)))
    with pytest.raises(InputError, match=r"c\.jpg: its EXIF segment is so full"):
        geotagged(crammed, full_tag())
    assert not (tmp_path / "out" / "c.jpg").exists()
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.jpg"]


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "tiff_adobe_deflate"])
@pytest.mark.parametrize("width", [63, 64])
def test_tiffs_grow_at_their_end_and_keep_their_strips(tmp_path: Path, compression: str, width: int) -> None:
    source = tmp_path / "a.tif"
    pages = [Image.fromarray(picture(width, seed=seed)) for seed in (1, 2)]
    pages[0].save(source, compression=compression, save_all=True, append_images=pages[1:])
    copy = geotagged(source, full_tag())
    old, new = source.read_bytes(), copy.read_bytes()
    assert old[:4] == new[:4]
    assert old[8:] == new[8 : len(old)]
    assert position(copy) == pytest.approx((-35.800_000_123, 139.650_000_456, 55.432), abs=1e-9)
    with Image.open(source) as before, Image.open(copy) as after:
        for page in (0, 1):
            before.seek(page)
            after.seek(page)
            assert np.array_equal(np.asarray(before), np.asarray(after))
    again = geotagged(copy, full_tag(latitude_deg=1.0), "again.tif")
    assert position(again)[0] == 1.0
    assert again.read_bytes().count(b"<?xpacket end") == 2  # the old packet lies dead in the file


def test_a_motorola_tiff_with_a_packet_keeps_what_it_says(tmp_path: Path) -> None:
    from PIL import TiffImagePlugin

    directory = TiffImagePlugin.ImageFileDirectory_v2(prefix=b"MM")
    directory[700] = packet('<rdf:Description rdf:about="" xmlns:q="urn:q/" q:w="kept"/>')
    directory[271] = "Maker of cameras"
    source = tmp_path / "a.tif"
    Image.fromarray(picture()).save(source, tiffinfo=directory)
    copy = geotagged(source, full_tag())
    with Image.open(copy) as image:
        found = image.getexif()
        assert found[271] == "Maker of cameras"
        assert b'q:w="kept"' in image.tag_v2[700]  # type: ignore[attr-defined]
        assert b"Camera:Yaw" in image.tag_v2[700]  # type: ignore[attr-defined]


@pytest.mark.parametrize("compressed", [True, False])
def test_pngs_change_in_two_chunks(tmp_path: Path, compressed: bool) -> None:
    from PIL import PngImagePlugin

    source = tmp_path / "a.png"
    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", packet('<rdf:Description xmlns:q="q" q:w="kept"/>').decode(), zip=compressed)
    info.add_text("Comment", "stays")
    Image.fromarray(picture()).save(source, pnginfo=info, exif=b"Exif\0\0" + exif_block(">", gps=old_gps(">")))
    copy = geotagged(source, full_tag())
    assert position(copy) == pytest.approx((-35.800_000_123, 139.650_000_456, 55.432), abs=1e-9)
    assert read_header(copy)[0].maker == "Maker"
    with Image.open(source) as before, Image.open(copy) as after:
        assert np.array_equal(np.asarray(before), np.asarray(after))
        assert after.info["Comment"] == "stays"
        assert b'q:w="kept"' in after.info["xmp"]
        assert b"Camera:Yaw" in after.info["xmp"]
    again = geotagged(copy, full_tag(latitude_deg=1.0), "again.png")
    assert position(again)[0] == 1.0
    first = copy.read_bytes()
    assert [again.read_bytes().count(kind) for kind in (b"eXIf", b"iTXt")] == [1, 1]
    pixels = first[first.index(b"IDAT") - 4 :]
    assert source.read_bytes().endswith(pixels)
    assert again.read_bytes().endswith(pixels)


def test_mutated_pngs_give_an_input_error_or_a_copy(tmp_path: Path) -> None:
    source = tmp_path / "a.png"
    stills, rng, copied = [], random.Random(4), 0
    for exif in ({}, {"exif": b"Exif\0\0" + exif_block("<", thumbnail=False)}):
        Image.fromarray(picture(8, 6)).save(source, **exif)  # type: ignore[arg-type]
        stills.append(source.read_bytes())
    for index in range(200):
        source.write_bytes(mutated(stills[index % 2], rng, most=1))
        try:
            copy = geotagged(source, full_tag())
        except InputError:
            continue
        copied += 1
        assert b"Camera:Yaw" in copy.read_bytes()
    assert copied > 20


def test_originals_are_neither_changed_nor_overwritten(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<"))
    before = source.read_bytes()
    os.utime(source, ns=(1_600_000_000_000_000_001, 1_500_000_000_123_456_789))
    source.chmod(0o444)
    copy = geotagged(source, full_tag())
    assert source.read_bytes() == before
    assert copy.stat().st_mtime_ns == 1_500_000_000_123_456_789
    (tmp_path / "link.jpg").symlink_to(source)
    (tmp_path / "hard.jpg").hardlink_to(source)
    for target in (source, tmp_path / "link.jpg", tmp_path / "hard.jpg", tmp_path / "out" / ".." / "a.jpg"):
        with pytest.raises(InputError, match="is the original itself"):
            write_geotagged(source, target, full_tag())
    assert source.read_bytes() == before
    write_geotagged(source, copy, full_tag(latitude_deg=5.0))
    assert position(copy)[0] == 5.0


@pytest.mark.parametrize(
    "content, what",
    [
        (b"", "is empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(4), "cut short"),
        (b"just some text", "neither JPEG, TIFF nor PNG"),
        (b"\xff\xd8\xff\xe1", "cut short"),
        (b"II+\0\x08\0\0\0" + bytes(20), "BigTIFF"),
        (b"II*\0\xff\xff\0\0", "damaged"),
        (b"MM\0*", "damaged"),
        (b"II*\0\x08\0\0\0\xff\xff", "damaged"),
    ],
)
def test_files_that_cannot_be_tagged_are_named(tmp_path: Path, content: bytes, what: str) -> None:
    (tmp_path / "odd.jpg").write_bytes(content)
    with pytest.raises(InputError, match=rf"odd\.jpg: .*{what}"):
        geotagged(tmp_path / "odd.jpg", tag())
    assert not list((tmp_path / "out").iterdir()) if (tmp_path / "out").exists() else True


@pytest.mark.parametrize("block", [b"XX*\0\x08\0\0\0", b"II*\0", b"II*\0\xff\0\0\0", b"II*\0\x08\0\0\0\x05\0"])
def test_damaged_exif_is_not_silently_replaced(tmp_path: Path, block: bytes) -> None:
    with pytest.raises(InputError, match=r"a\.jpg: its EXIF or TIFF header is damaged"):
        geotagged(write_still(tmp_path / "a.jpg", exif=block), tag())


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    for source in (tmp_path / "none.jpg", tmp_path):
        with pytest.raises(InputError, match=f"{source.name}: cannot be read"):
            write_geotagged(source, tmp_path / "out.jpg", tag())
    source = write_still(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="cannot be written"):
        write_geotagged(source, source / "b.jpg", tag())


def test_a_still_cut_short_within_its_pixels_is_copied_as_it_is(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<"))
    source.write_bytes(source.read_bytes()[:-200])
    copy = geotagged(source, tag())
    assert others(copy) == others(source)


@pytest.mark.parametrize(
    "wrong",
    [
        {"latitude_deg": 90.1},
        {"longitude_deg": float("nan")},
        {"height_m": float("inf")},
        {"height_datum": HeightDatum.GROUND},
        {"gps_time_ns": -1},
        {"sigma_horizontal_m": 0.0},
        {"sigma_vertical_m": float("nan")},
        {"R_enu_from_image": np.eye(3) * 2.0},
        {"R_enu_from_image": np.diag([1.0, 1.0, -1.0])},
        {"probability": 1.1},
    ],
)
def test_tags_are_checked_at_birth(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        full_tag(**wrong)


def mutated(data: bytes, rng: random.Random, most: int = 4) -> bytes:
    """Return the data with some bytes changed, cut or doubled."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, most)):
        at = rng.randrange(2, len(changed))
        kind = rng.randrange(3)
        if kind == 0:
            changed[at] = rng.choice([0, 1, 0xFF, rng.randrange(256)])
        elif kind == 1:
            del changed[at : at + rng.randint(1, 20)]
        else:
            changed[at:at] = changed[at : at + rng.randint(1, 20)]
    return bytes(changed)


def fuzz(folder: Path, rounds: int) -> int:
    """Return how many of the mutated heads were copied; every copy must hold the source's other segments and pixels."""
    xmp = packet(
        '<rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0" Camera:Yaw="3"/>', padding=50
    )
    rng, bare, copied = random.Random(3), len(bare_jpeg()), 0
    for index in range(rounds):
        order = "<>"[index % 2]
        parts = {"exif": exif_block(order, gps=old_gps(order)), "xmp": xmp}
        if index % 3:
            parts = {name: mutated(part, rng) if rng.random() < 0.6 else part for name, part in parts.items()}
        still = write_still(folder / "fuzz.jpg", **parts).read_bytes()
        head = len(still) - bare + 20
        if index % 3 == 0:
            (folder / "fuzz.jpg").write_bytes(mutated(still[:head], rng) + still[head:])
        try:
            copy = geotagged(folder / "fuzz.jpg", full_tag())
        except InputError:
            continue
        copied += 1
        assert others(copy) == others(folder / "fuzz.jpg")
        assert b"Camera:GPSXYAccuracy" in copy.read_bytes()
    return copied


def test_mutated_heads_give_an_input_error_or_a_copy(tmp_path: Path) -> None:
    assert 50 < fuzz(tmp_path, 300) < 300


@pytest.mark.slow
def test_many_mutated_heads_give_an_input_error_or_a_copy(tmp_path: Path) -> None:
    assert 1000 < fuzz(tmp_path, 6000) < 6000


def test_mutated_tiffs_give_an_input_error_or_a_copy(tmp_path: Path) -> None:
    source = tmp_path / "a.tif"
    Image.fromarray(picture(8, 6)).save(source)
    data, rng, copied = source.read_bytes(), random.Random(4), 0
    for _ in range(200):
        source.write_bytes(mutated(data, rng))
        try:
            copy = geotagged(source, full_tag())
        except InputError:
            continue
        copied += 1
        old = source.read_bytes()
        assert copy.stat().st_size > len(old)
        differing = [i for i, (a, b) in enumerate(zip(old, copy.read_bytes(), strict=False)) if a != b]
        assert not differing or differing[-1] - differing[0] < 36
    assert copied > 20


def test_eighteen_stills_of_5_megabytes_take_about_a_second(tmp_path: Path) -> None:
    source = write_still(tmp_path / "a.jpg", exif=exif_block("<"))
    source.write_bytes(source.read_bytes() + os.urandom(5_000_000))
    geotagged(source, full_tag())
    start = time.perf_counter()
    for index in range(18):
        geotagged(source, full_tag(), f"{index}.jpg")
    assert time.perf_counter() - start < 3.0
