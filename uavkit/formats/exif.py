"""What a still's file says of itself: EXIF, and the XMP attributes that DJI's drones and Pix4D's cameras write.

Heights in EXIF are by common practice of unknown datum (barometric, geoid or ellipsoid, whatever the maker thought of),
although the standard's first editions say "sea level": they stay ``HeightDatum.UNKNOWN`` unless the file states more.
"""

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from uavkit.core.gpstime import gps_time_ns_from_utc
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix, StillInfo

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_MAKE, _MODEL, _DATE_TIME = 271, 272, 306
_FOCAL_MM, _FOCAL_35MM = 37386, 41989
_ORIGINAL, _ORIGINAL_SUBSEC, _ORIGINAL_OFFSET = 36867, 37521, 36881
_GPS_LAT_REF, _GPS_LAT, _GPS_LON_REF, _GPS_LON, _GPS_ALT_REF, _GPS_ALT = 1, 2, 3, 4, 5, 6
_GPS_TIME, _GPS_DATE, _GPS_ERROR_M = 7, 29, 31

_XMP_ATTRIBUTE = re.compile(r'drone-dji:(\w+)\s*=\s*(?:"([^"]*)"|\'([^\']*)\')')
_XMP_ELEMENT = re.compile(r"<drone-dji:(\w+)[^>/]*>([^<]*)</drone-dji:")
_CAMERA_ATTRIBUTE = re.compile(r'\bCamera:(\w+)\s*=\s*(?:"([^"]*)"|\'([^\']*)\')')
_CAMERA_ELEMENT = re.compile(r"<Camera:(\w+)[^<>/]*>([^<]*)</Camera:")
_VERTICAL_CRS = {"EPSG:5773": HeightDatum.GEOID, "ellipsoidal": HeightDatum.ELLIPSOID}
"""What Pix4D's Camera:VertCS says of EXIF's height; 5773 is EGM96, which ``geotag`` writes."""
_RTK_WITH_SIGMA = {"34", "50"}
"""DJI's RtkFlag: 50 is fixed, 34 is float; 16 is a single-point position, whose stated sigmas mean nothing."""
_LAST_NS = gps_time_ns_from_utc(datetime(2200, 1, 1, tzinfo=UTC))
"""A date behind it is none (and would soon have no place in 64 bits of nanoseconds)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DroneTags:
    """What a drone (DJI's mostly) writes beside EXIF; None where it does not."""

    absolute_altitude_m: float | None = None
    """Of the datum that ``altitude_type`` names; mostly barometric."""
    relative_altitude_m: float | None = None
    """Above the take-off point."""
    altitude_type: str = ""
    gimbal_roll_deg: float | None = None
    gimbal_pitch_deg: float | None = None
    """-90 looks down."""
    gimbal_yaw_deg: float | None = None
    rtk_flag: str = ""
    rtk_sigma_horizontal_m: float | None = None
    rtk_sigma_vertical_m: float | None = None
    camera_vertical_crs: str = ""
    """Pix4D's Camera:VertCS, of EXIF's height; cameras and geotagging programs write it, and the accuracies below."""
    camera_sigma_horizontal_m: float | None = None
    camera_sigma_vertical_m: float | None = None


def parse_drone_tags(xmp: bytes | str) -> DroneTags:
    """Return DJI's attributes of an XMP packet; broken XML is read as far as single attributes can be recognised."""
    text = xmp.decode("utf-8", errors="replace") if isinstance(xmp, bytes) else xmp
    found = {key: one or two for key, one, two in _XMP_ATTRIBUTE.findall(text)}
    found |= {key: value for key, value in _XMP_ELEMENT.findall(text) if key not in found}
    camera = {key: one or two for key, one, two in _CAMERA_ATTRIBUTE.findall(text)}
    camera |= {key: value for key, value in _CAMERA_ELEMENT.findall(text) if key not in camera}
    horizontal = [_number(found.get("RtkStdLon")), _number(found.get("RtkStdLat"))]
    told = [value for value in horizontal if value is not None]
    return DroneTags(
        absolute_altitude_m=_number(found.get("AbsoluteAltitude")),
        relative_altitude_m=_number(found.get("RelativeAltitude")),
        altitude_type=found.get("AltitudeType", "").strip(),
        gimbal_roll_deg=_number(found.get("GimbalRollDegree")),
        gimbal_pitch_deg=_number(found.get("GimbalPitchDegree")),
        gimbal_yaw_deg=_number(found.get("GimbalYawDegree")),
        rtk_flag=found.get("RtkFlag", "").strip(),
        rtk_sigma_horizontal_m=max(told) if told else None,
        rtk_sigma_vertical_m=_number(found.get("RtkStdHgt")),
        camera_vertical_crs=camera.get("VertCS", "").strip(),
        camera_sigma_horizontal_m=_number(camera.get("GPSXYAccuracy")),
        camera_sigma_vertical_m=_number(camera.get("GPSZAccuracy")),
    )


def read_header(path: Path) -> tuple[StillInfo, DroneTags]:
    """Read a still's header without its pixels; raises OSError, SyntaxError or ValueError where Pillow cannot."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns of odd EXIF and of large pictures: both are ordinary here
        with Image.open(path) as image:
            exif = image.getexif()
            main, detail, gps = dict(exif), dict(exif.get_ifd(_EXIF_IFD)), dict(exif.get_ifd(_GPS_IFD))
            size, packet = image.size, image.info.get("xmp", b"")
    tags = parse_drone_tags(packet if isinstance(packet, bytes | str) else b"")
    time_ns, resolution_ns = camera_time(main, detail)
    info = StillInfo(
        name=path.name,
        width_px=size[0],
        height_px=size[1],
        maker=_text(main.get(_MAKE)),
        model=_text(main.get(_MODEL)),
        focal_length_mm=_positive(detail.get(_FOCAL_MM)),
        focal_length_35mm=_positive(detail.get(_FOCAL_35MM)),
        camera_time_ns=time_ns,
        camera_time_resolution_ns=resolution_ns,
        position=gps_position(gps, tags, path.name),
    )
    return info, tags


def camera_time(main: Mapping[int, Any], detail: Mapping[int, Any]) -> tuple[int | None, int]:
    """Return the camera's clock, read as UTC where EXIF states no offset, as GPS time in ns, and its resolution."""
    second = 1_000_000_000
    text = _text(detail.get(_ORIGINAL)) or _text(main.get(_DATE_TIME))
    numbers = re.fullmatch(r"(\d{4})\D(\d\d)\D(\d\d)\D+(\d\d)\D(\d\d)\D(\d\d)", text)
    if numbers is None:
        return None, second
    try:
        moment = datetime(*(int(part) for part in numbers.groups()), tzinfo=UTC)  # type: ignore[misc,arg-type]
        whole = gps_time_ns_from_utc(moment.replace(tzinfo=_offset(detail.get(_ORIGINAL_OFFSET))).astimezone(UTC))
    except (ValueError, OverflowError):  # 0000:00:00 of a clock that was never set
        return None, second
    if whole > _LAST_NS:
        return None, second
    digits = _text(detail.get(_ORIGINAL_SUBSEC))
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 9):
        return whole, second
    return whole + int(digits) * 10 ** (9 - len(digits)), 10 ** (9 - len(digits))


def _offset(value: object) -> timezone:
    parts = re.fullmatch(r"([+-])(\d\d):(\d\d)", _text(value))
    if parts is None:
        return UTC
    span = timedelta(hours=int(parts[2]), minutes=int(parts[3]))
    return timezone(-span if parts[1] == "-" else span)


def gps_position(gps: Mapping[int, Any], tags: DroneTags, name: str) -> GnssFix | None:
    """Return the position in EXIF's GPS part, or None where there is none (a file of zeros counts as none).

    Where no absolute altitude is given the height is DJI's relative one (``HeightDatum.GROUND``), else NaN.
    """
    latitude = _degrees(gps.get(_GPS_LAT), _text(gps.get(_GPS_LAT_REF)).upper() == "S")
    longitude = _degrees(gps.get(_GPS_LON), _text(gps.get(_GPS_LON_REF)).upper() == "W")
    if latitude is None or longitude is None or (latitude == 0.0 and longitude == 0.0):
        return None
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return None
    height_m, datum = _height(gps, tags)
    horizontal = _positive(tags.camera_sigma_horizontal_m) or _positive(gps.get(_GPS_ERROR_M))
    vertical = _positive(tags.camera_sigma_vertical_m)
    if tags.rtk_flag in _RTK_WITH_SIGMA and tags.camera_vertical_crs not in _VERTICAL_CRS:
        horizontal = _positive(tags.rtk_sigma_horizontal_m) or horizontal
        vertical = _positive(tags.rtk_sigma_vertical_m)
    return GnssFix(
        gps_time_ns=_gps_time(gps),
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height_m,
        height_datum=datum,
        sigma_horizontal_m=horizontal,
        sigma_vertical_m=vertical,
        name=name,
    )


def _height(gps: Mapping[int, Any], tags: DroneTags) -> tuple[float, HeightDatum]:
    altitude, reference = _number(gps.get(_GPS_ALT)), gps.get(_GPS_ALT_REF, 0)
    code = reference[0] if isinstance(reference, bytes) and reference else reference
    code = code if isinstance(code, int) else 0
    if altitude is None:
        if tags.absolute_altitude_m is not None:
            return tags.absolute_altitude_m, _datum(code, tags)
        if tags.relative_altitude_m is not None:
            return tags.relative_altitude_m, HeightDatum.GROUND
        return math.nan, HeightDatum.UNKNOWN
    return (-altitude if code in (1, 3) else altitude), _datum(code, tags)


def _datum(code: int, tags: DroneTags) -> HeightDatum:
    """Camera:VertCS, EXIF 3's codes 2 and 3 (sea level) and DJI's RtkAlt say what they mean; 0 and 1 were both before.

    Camera:VertCS comes first: in a copy that was given another position DJI's words of the first one still stand.
    """
    if tags.camera_vertical_crs in _VERTICAL_CRS:
        return _VERTICAL_CRS[tags.camera_vertical_crs]
    if tags.altitude_type == "RtkAlt":
        return HeightDatum.ELLIPSOID
    return HeightDatum.GEOID if code in (2, 3) else HeightDatum.UNKNOWN


def _gps_time(gps: Mapping[int, Any]) -> int | None:
    date = re.fullmatch(r"(\d{4})\D(\d\d)\D(\d\d)", _text(gps.get(_GPS_DATE)))
    clock = gps.get(_GPS_TIME)
    if date is None or not isinstance(clock, tuple | list) or len(clock) != 3:
        return None
    hours, minutes, seconds = (_number(part) for part in clock)
    if hours is None or minutes is None or seconds is None:
        return None
    try:
        midnight = datetime(int(date[1]), int(date[2]), int(date[3]), tzinfo=UTC)
        time_ns = gps_time_ns_from_utc(midnight + timedelta(hours=hours, minutes=minutes, seconds=seconds))
    except (ValueError, OverflowError):
        return None
    return time_ns if time_ns <= _LAST_NS else None


def _degrees(parts: object, negative: bool) -> float | None:
    if not isinstance(parts, tuple | list) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    degrees = sum(number / 60.0**power for power, number in enumerate(numbers) if number is not None)
    return -degrees if negative else degrees


def _text(value: object) -> str:
    text = value.decode("latin-1") if isinstance(value, bytes) else value
    return text.split("\0")[0].strip() if isinstance(text, str) else ""


def _number(value: Any) -> float | None:
    """Return a finite number, or None: rationals over zero and DJI's signed texts ("+198.31") are common."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: object) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None
