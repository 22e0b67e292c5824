"""Copies of stills with their position in EXIF, and accuracy and camera orientation in XMP; pixels bit-exact.

EXIF 2.3 (CIPA DC-008), section 4.6.6, for the GPS tags: heights count from sea level there, as today's readers take
them (EXIF 3.0 has other codes for it, which they do not know). Pix4D's XMP tags for cameras for the rest: yaw, pitch,
roll turn the camera's forward-right-down into north-east-down and are zero for a camera that looks down with the top of
the image to the north; accuracies are standard deviations. What neither holds is in a namespace of uavkit's own.
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from uavkit.core.angles import omega_phi_kappa_from_rotation
from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import utc_from_gps_time_ns
from uavkit.core.heights import HeightDatum
from uavkit.formats import jpeg_segments as jpeg
from uavkit.formats import png_chunks as png
from uavkit.formats import xmp_packet
from uavkit.formats.atomic import atomic_path
from uavkit.formats.pieces import write_pieces
from uavkit.formats.tiff_tags import EMPTY_BLOCK, Field, TagBlock, block_of_resolution, without

PIX4D_CAMERA = "http://pix4d.com/camera/1.0/"
UAVKIT = "urn:uavkit:geotag:1.0/"
EGM96_HEIGHT = "EPSG:5773"
_PREFIXES = {PIX4D_CAMERA: "Camera", UAVKIT: "uavkit"}

_LEAST_TILT_DEG = 5.0
"""A camera nearer to the vertical looks down: the direction of what is left of its tilt says nothing of the view."""
_NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Also image space (x right, y up, z to the viewer) from forward, right, down of a camera that looks down."""

_VERSION, _LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = 0, 1, 2, 3, 4, 5, 6
_TIME, _DIRECTION_REF, _DIRECTION, _DATUM, _METHOD, _DATE, _ERROR_M = 7, 16, 17, 18, 27, 29, 31
_OF_THE_OLD_POSITION = {
    _VERSION,
    _LAT_REF,
    _LAT,
    _LON_REF,
    _LON,
    _ALT_REF,
    _ALT,
    8,
    9,
    10,
    11,
    _DATUM,
    27,
    30,
    _ERROR_M,
}
"""8 to 11: satellites, status, dimensions, DOP; 30: differential: true of that position only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeoTag:
    """Where a still was taken, and how the camera looked."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """NaN where unknown: then no height is written."""
    height_datum: HeightDatum
    """GEOID, ELLIPSOID, or UNKNOWN: then the height is written as it is, and nothing said of what it counts from."""
    gps_time_ns: int | None = None
    """Of the exposure; None leaves the still's own GPS time, if any, as it is."""
    sigma_horizontal_m: float | None = None
    """For each axis."""
    sigma_vertical_m: float | None = None
    R_enu_from_image: Array | None = None
    """(3, 3); east, north, up at the camera's own place."""
    probability: float | None = None
    """That the position belongs to this still."""

    def __post_init__(self) -> None:
        if not (-90.0 <= self.latitude_deg <= 90.0 and -180.0 <= self.longitude_deg <= 180.0):
            raise ValueError(f"no such place: latitude {self.latitude_deg}, longitude {self.longitude_deg} degrees")
        if np.isinf(self.height_m) or abs(self.height_m) > 1e6:
            raise ValueError(f"no such height: {self.height_m} m")
        if not np.isnan(self.height_m) and self.height_datum is HeightDatum.GROUND:
            raise ValueError(f"a {self.height_datum.value} height cannot be written as a height above sea level")
        if self.gps_time_ns is not None and self.gps_time_ns < 0:
            raise ValueError(f"GPS time {self.gps_time_ns} ns lies before 1980")
        for sigma in (self.sigma_horizontal_m, self.sigma_vertical_m):
            if sigma is not None and not 0.0 < sigma < np.inf:
                raise ValueError(f"a standard deviation is > 0 and finite, not {sigma}: None where it is unknown")
        if self.probability is not None and not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"a probability is 0 to 1, not {self.probability}")
        _check_rotation(self.R_enu_from_image)

    @property
    def heights_m(self) -> tuple[float, float]:
        """Return the height for EXIF (above the EGM96 geoid; of unknown datum as it is) and that above the ellipsoid.

        Metres; NaN where unknown.
        """
        if np.isnan(self.height_m) or self.height_datum is HeightDatum.UNKNOWN:
            return self.height_m, float("nan")
        undulation = float(geoid_undulation_m(np.array([self.latitude_deg]), np.array([self.longitude_deg]))[0])
        if self.height_datum is HeightDatum.GEOID:
            return self.height_m, self.height_m + undulation
        return self.height_m - undulation, self.height_m


def _check_rotation(R: Array | None) -> None:
    if R is None:
        return
    if np.shape(R) != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0:
        raise ValueError("R_enu_from_image is no rotation of shape (3, 3)")


def write_geotagged(source: Path, target: Path, tag: GeoTag) -> None:
    """Write a copy of a JPEG, TIFF or PNG with the position; the source is only read, the copy gets its time of change.

    In a JPEG the EXIF and XMP segments change (and what MPF says of their size), all else is the same byte for byte. If
    the XMP packet has padding enough the file keeps its size, so that whatever points behind the picture still
    fits. In a TIFF the new parts are appended, in a PNG the two chunks change. Other tags, maker notes and thumbnails
    stay where they are. XMP of others that repeats the old position (DJI's, Adobe's exif:) is left as it is.

    Raises InputError where source and target are the same file, the source is of another kind or damaged, the position
    does not fit into a JPEG's segments, or the copy cannot be written.
    """
    _refuse_same_file(source, target)
    try:
        with source.open("rb") as stream:
            write = _writer(stream.read(8), source)
            stream.seek(0)
            with atomic_path(target) as temporary:
                with temporary.open("wb") as copy:
                    write(stream, copy, tag, str(source))
                times = os.fstat(stream.fileno())
                os.utime(temporary, ns=(times.st_atime_ns, times.st_mtime_ns))
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror or error})") from error


def _refuse_same_file(source: Path, target: Path) -> None:
    try:
        same = source.resolve() == target.resolve() or (target.exists() and target.samefile(source))
    except (OSError, RuntimeError) as error:
        raise InputError(f"{target}: cannot be written beside {source} ({error})") from error
    if same:
        raise InputError(f"{target}: is the original itself: originals are never changed, give another folder")


def _writer(head: bytes, source: Path) -> Callable[[BinaryIO, BinaryIO, GeoTag, str], None]:
    if head[:2] == b"\xff\xd8":
        return _write_jpeg
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _write_tiff
    if head == png.SIGNATURE:
        return _write_png
    kind = "neither JPEG, TIFF nor PNG" if head else "empty"
    raise InputError(f"{source}: is {kind}: positions are written into such stills only")


def _write_jpeg(source: BinaryIO, copy: BinaryIO, tag: GeoTag, name: str) -> None:
    segments = jpeg.read_segments(source, name)
    old_exif, old_xmp = _payload(segments, jpeg.EXIF_HEADER), _payload(segments, jpeg.XMP_HEADER)
    exif = _with_gps(old_exif or block_of_resolution(*jpeg.resolution(segments)), tag, name)
    packet = xmp_packet.merged(old_xmp, xmp_properties(tag), _PREFIXES, name)
    packet = _fitted(packet, _growth(old_exif, exif, jpeg.EXIF_HEADER) + _growth(old_xmp, packet, jpeg.XMP_HEADER))
    changed, added = {}, []
    first = next((i for i, segment in enumerate(segments) if segment.marker != jpeg.APP0), len(segments))
    for header, payload in ((jpeg.EXIF_HEADER, exif), (jpeg.XMP_HEADER, packet)):
        place = _place(segments, header)
        if place is not None:
            changed[place] = jpeg.encode_segment(jpeg.APP1, header + payload, name)
            first = max(first, place + 1) if header == jpeg.EXIF_HEADER else first
        elif payload:
            added.append((first, jpeg.encode_segment(jpeg.APP1, header + payload, name)))
    write_pieces(source, jpeg.rebuilt(segments, changed, added), copy)


def _with_gps(exif: bytes, tag: GeoTag, name: str) -> bytes:
    block = TagBlock.of_bytes(exif, name)
    return block.with_fields(gps_fields(tag, block), None).applied(exif)


def _growth(old: bytes | None, new: bytes, header: bytes) -> int:
    if old is not None:
        return len(new) - len(old)
    return len(header) + 4 + len(new) if new else 0


def _fitted(packet: bytes, grown: int) -> bytes:
    """Return the packet with less padding: so that the file does not grow, or else so that a segment holds it."""
    too_long = len(jpeg.XMP_HEADER) + len(packet) - jpeg.LARGEST_PAYLOAD
    for by in (grown, too_long):
        if 0 < by <= xmp_packet.padding(packet):
            return xmp_packet.shortened(packet, by)
    return packet


def _place(segments: tuple[jpeg.Segment, ...], header: bytes) -> int | None:
    found = (i for i, segment in enumerate(segments) if segment.marker == jpeg.APP1 and segment.holds(header))
    return next(found, None)


def _payload(segments: tuple[jpeg.Segment, ...], header: bytes) -> bytes | None:
    place = _place(segments, header)
    return None if place is None else (segments[place].payload or b"")[len(header) :]


def _write_tiff(source: BinaryIO, copy: BinaryIO, tag: GeoTag, name: str) -> None:
    size = source.seek(0, os.SEEK_END)
    block = TagBlock(source, size, name)
    old = block.xmp()
    packet = xmp_packet.merged(old, xmp_properties(tag), _PREFIXES, name)
    edit = block.with_fields(gps_fields(tag, block), packet if packet != (old or b"") else None)
    source.seek(0)
    shutil.copyfileobj(source, copy, 1 << 20)
    copy.write(edit.appended)
    for offset, data in edit.overwritten.items():
        copy.seek(offset)
        copy.write(data)


def _write_png(source: BinaryIO, copy: BinaryIO, tag: GeoTag, name: str) -> None:
    chunks = png.read_chunks(source, name)
    old_exif, old_xmp = png.payload(chunks, png.EXIF, name), png.payload(chunks, png.XMP, name)
    new = {png.EXIF: _with_gps(old_exif or EMPTY_BLOCK, tag, name)}
    packet = xmp_packet.merged(old_xmp, xmp_properties(tag), _PREFIXES, name)
    if packet != (old_xmp or b""):
        new[png.XMP] = packet
    write_pieces(source, png.rebuilt(chunks, new), copy)


def gps_fields(tag: GeoTag, block: TagBlock) -> list[Field]:
    """Return the GPS directory's new fields: the tag's, and of the old ones those that do not speak of the position."""
    order = block.order
    fields = _position_fields(tag, order)
    replaced = set(_OF_THE_OLD_POSITION)
    if tag.gps_time_ns is not None:
        fields += _time_fields(tag.gps_time_ns, order)
        replaced |= {_TIME, _DATE}
    if tag.R_enu_from_image is not None:
        fields += _direction_fields(tag.R_enu_from_image, order)
        replaced |= {_DIRECTION_REF, _DIRECTION}
    return [*without(block.gps_fields(), replaced), *fields]


def _position_fields(tag: GeoTag, order: str) -> list[Field]:
    fields = [
        Field.of_bytes(_VERSION, bytes((2, 3, 0, 0))),
        Field.text(_LAT_REF, "S" if tag.latitude_deg < 0 else "N"),
        Field.rationals(_LAT, order, _degrees_minutes_seconds(tag.latitude_deg)),
        Field.text(_LON_REF, "W" if tag.longitude_deg < 0 else "E"),
        Field.rationals(_LON, order, _degrees_minutes_seconds(tag.longitude_deg)),
        Field.text(_DATUM, "WGS-84"),
        Field.undefined(_METHOD, b"ASCII\0\0\0GPS"),
    ]
    height_geoid_m, _ = tag.heights_m
    if not np.isnan(height_geoid_m):
        millimetres = round(height_geoid_m * 1000.0)
        fields.append(Field.of_bytes(_ALT_REF, bytes((int(millimetres < 0),))))
        fields.append(Field.rationals(_ALT, order, [(abs(millimetres), 1000)]))
    if tag.sigma_horizontal_m is not None:
        fields.append(Field.rationals(_ERROR_M, order, [_short_length(tag.sigma_horizontal_m)]))
    return fields


def _degrees_minutes_seconds(degrees: float) -> list[tuple[int, int]]:
    """Return degrees, minutes and seconds as rationals, to 1e-7 seconds (3e-11 degrees)."""
    minutes, seconds_e7 = divmod(round(abs(degrees) * 36e9), 600_000_000)
    return [(minutes // 60, 1), (minutes % 60, 1), (seconds_e7, 10_000_000)]


def _short_length(metres: float) -> tuple[int, int]:
    """Return a rational that is never zero and never too large: 0.1 mm up to 100 km."""
    return min(max(round(metres * 10_000.0), 1), 1_000_000_000), 10_000


def _time_fields(gps_time_ns: int, order: str) -> list[Field]:
    utc = utc_from_gps_time_ns(gps_time_ns)
    seconds = (utc.second * 1_000_000 + utc.microsecond, 1_000_000)
    return [
        Field.rationals(_TIME, order, [(utc.hour, 1), (utc.minute, 1), seconds]),
        Field.text(_DATE, f"{utc.year:04d}:{utc.month:02d}:{utc.day:02d}"),
    ]


def _direction_fields(R_enu_from_image: Array, order: str) -> list[Field]:
    east, north, up = -R_enu_from_image[:, 2]
    tilt_deg = np.degrees(np.arccos(np.clip(-up, -1.0, 1.0)))
    if not _LEAST_TILT_DEG <= tilt_deg <= 180.0 - _LEAST_TILT_DEG:
        return []
    hundredths = round(float(np.degrees(np.arctan2(east, north))) * 100.0) % 36000
    return [Field.text(_DIRECTION_REF, "T"), Field.rationals(_DIRECTION, order, [(hundredths, 100)])]


def yaw_pitch_roll_deg(R_enu_from_image: Array) -> tuple[float, float, float]:
    """Return Pix4D's angles in degrees: yaw 0 to 360, pitch 0 down and 90 level, roll; R_ned_from_body = Rz Ry Rx.

    Where the camera looks level, yaw and roll turn about the same axis: roll is zero then.
    """
    R = _NED_FROM_ENU @ R_enu_from_image @ _NED_FROM_ENU
    cos_pitch = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(-R[2, 0], cos_pitch)
    if cos_pitch < 1e-9:
        yaw, roll = np.arctan2(-R[0, 1], R[1, 1]), 0.0
    else:
        yaw, roll = np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    return float(np.degrees(yaw)) % 360.0, float(np.degrees(pitch)), float(np.degrees(roll))


def xmp_properties(tag: GeoTag) -> dict[xmp_packet.Property, str | None]:
    """Return the properties to set, and with None those to take out: they speak of the old position."""
    _, height_ellipsoid_m = tag.heights_m
    has_height = not np.isnan(height_ellipsoid_m)
    camera = {
        "HorizCS": "EPSG:4326" if has_height else None,
        "VertCS": EGM96_HEIGHT if has_height else None,
        "GPSXYAccuracy": _decimal(tag.sigma_horizontal_m, 4),
        "GPSZAccuracy": _decimal(tag.sigma_vertical_m, 4),
    }
    own = {
        "HeightEllipsoid": _decimal(height_ellipsoid_m, 4) if has_height else None,
        "MatchProbability": _decimal(tag.probability, 6),
        "Omega": None,
        "Phi": None,
        "Kappa": None,
    }
    if tag.R_enu_from_image is not None:
        angles = yaw_pitch_roll_deg(tag.R_enu_from_image)
        camera |= {name: _decimal(angle, 6) for name, angle in zip(("Yaw", "Pitch", "Roll"), angles, strict=True)}
        radians = omega_phi_kappa_from_rotation(tag.R_enu_from_image)
        own |= {name: _decimal(np.degrees(a), 6) for name, a in zip(("Omega", "Phi", "Kappa"), radians, strict=True)}
    properties = {(PIX4D_CAMERA, name): value for name, value in camera.items()}
    return {**properties, **{(UAVKIT, name): value for name, value in own.items()}}


def _decimal(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value + 0.0:.{digits}f}"
