"""Where the simulated site lies on earth, and when the survey was flown."""

from datetime import UTC, datetime

from uavkit.core.frames import LocalFrame
from uavkit.core.gpstime import gps_time_ns_from_utc

CRS = "EPSG:32654"
LATITUDE_DEG = 35.8
LONGITUDE_DEG = 139.65
HEIGHT_ELLIPSOID_M = 45.0
"""Of the local system's zero height."""

VIDEO_START_UTC = datetime(2012, 3, 15, 1, 20, 7, 412_000, tzinfo=UTC)
"""First field of the video."""

CAMERA_ZONE_HOURS = 9
"""The camera's clock shows Japan's time."""


def site_frame() -> LocalFrame:
    """The local east-north-up system of the site."""
    return LocalFrame.at(LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_ELLIPSOID_M, CRS)


def gps_time_ns(video_time_s: float) -> int:
    """GPS time of an instant counted from the first field of the video."""
    return gps_time_ns_from_utc(VIDEO_START_UTC) + round(video_time_s * 1e9)
