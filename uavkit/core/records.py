"""Records of a flight as devices and logs give them."""

from dataclasses import dataclass
from enum import Enum

from uavkit.core.arrays import Image
from uavkit.core.heights import HeightDatum


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssFix:
    """One position of the GNSS antenna."""

    gps_time_ns: int | None
    """None where the source gives no time (waypoint lists)."""
    latitude_deg: float
    longitude_deg: float
    height_m: float
    """NaN where the source gives a position without any height."""
    height_datum: HeightDatum
    sigma_horizontal_m: float | None = None
    """For each axis; None where the source does not say."""
    sigma_vertical_m: float | None = None
    sigma_east_north_m: tuple[float, float] | None = None
    """Where the source tells the axes apart; then ``sigma_horizontal_m`` is their root mean square."""
    name: str = ""

    def __post_init__(self) -> None:
        if not (-90.0 <= self.latitude_deg <= 90.0 and -180.0 <= self.longitude_deg <= 180.0):
            raise ValueError(f"no such place: latitude {self.latitude_deg}, longitude {self.longitude_deg} degrees")


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeSample:
    """Attitude of the vehicle: roll, pitch, yaw in radians, aviation's convention (yaw from north, clockwise)."""

    gps_time_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureEvent:
    """An exposure as something other than the camera noticed it: trigger, feedback pin, shutter seen in the video."""

    gps_time_ns: int | None
    """None where the source knows no time (waypoint lists)."""
    sequence: int | None = None
    source: str = ""
    position: GnssFix | None = None
    """Where the source says it was; of the vehicle or the antenna, not of the camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillInfo:
    """What a still's file says of itself, without its pixels."""

    name: str
    width_px: int
    height_px: int
    maker: str = ""
    model: str = ""
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    """The focal length of the same field of view on 36 mm x 24 mm film; makers round it to whole millimetres."""
    camera_time_ns: int | None = None
    """The camera's own clock read as if it were UTC, as GPS time; off and drifting, often whole seconds only."""
    camera_time_resolution_ns: int = 1_000_000_000
    position: GnssFix | None = None


class FieldOrder(Enum):
    """Which field of an interlaced frame comes first in time."""

    PROGRESSIVE = "progressive"
    TOP_FIRST = "top"
    BOTTOM_FIRST = "bottom"


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """What a video source says of itself."""

    name: str
    width_px: int
    height_px: int
    frame_interval_ns: int
    field_order: FieldOrder | None
    """None where the source does not say: then it is found from the content."""
    frame_count: int | None
    """None for a live source or a damaged index."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFrame:
    """One frame's luminance with its time since the first frame of the video."""

    index: int
    time_ns: int
    luminance: Image
    """(height, width); woven if the video is interlaced."""
    damaged: bool = False
