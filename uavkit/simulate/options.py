"""What a simulated survey is asked to be."""

import os
from dataclasses import dataclass, field
from enum import Enum

from uavkit.core.errors import InputError
from uavkit.core.records import FieldOrder


class Terrain(Enum):
    """Shape of the site."""

    EMBANKMENT = "embankment"
    """A crest 10 m above its feet."""
    HILLS = "hills"
    """Rolling ground with 6 to 8 m between its highest and lowest place, no line in it straight."""
    FLAT = "flat"
    """Within 0.3 m of a plane: the camera and the heights of a single-height block hold on to little."""


class Texture(Enum):
    """What covers the site, and the light upon it."""

    MIXED = "mixed"
    """Grass, gravel and soil in patches, boulders and boxes, in the sun."""
    REPETITIVE = "repetitive"
    """Rows of crop, 0.51 m apart, the same plant every 0.25 m, under an overcast sky."""
    LOW_CONTRAST = "low_contrast"
    """Raked sand under an overcast sky: a few grey values of contrast."""


class FlightKind(Enum):
    """How the height of the exposure stations follows the ground."""

    CONSTANT = "constant"
    """One height for all: 10 m above the crest of the embankment, 20 m above its foot; elsewhere 15 m above the mean
    ground."""
    TRACE = "trace"
    """15 m above the ground below each station."""


class VideoStandard(Enum):
    """Television standard of the finder's signal."""

    NTSC = "ntsc"
    PAL = "pal"
    NONE = "none"
    """No video is made."""


class FrozenPicture(Enum):
    """What the finder shows between the black of the shutter and the next live picture."""

    LAST_FIELDS = "last"
    """The last two fields before the shutter."""
    REVIEW = "review"
    """The still itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """Options of ``simulate_survey``; raises InputError where a value lies outside its range."""

    seed: int = 1
    """Of everything that is random; the same seed gives the same files."""
    scale: float = 1.0
    """Size of the stills against 4000 x 3000, 0.1 to 1; the field of view stays."""
    terrain: Terrain = Terrain.EMBANKMENT
    texture: Texture = Texture.MIXED
    brightness_jump: float = 0.0
    """By how much every second still is exposed longer than the one before, and the video with it, 0 to 0.6."""
    flight: FlightKind = FlightKind.CONSTANT
    strips: int = 3
    """1 to 5; flown to and fro."""
    stations_per_strip: int = 11
    """2 to 13."""
    station_spacing_m: float = 7.0
    """Air base within a strip, 2 to 12 m."""
    strip_spacing_m: float = 9.0
    """4 to 15 m."""
    video_standard: VideoStandard = VideoStandard.NTSC
    field_order: FieldOrder = FieldOrder.BOTTOM_FIRST
    """Top or bottom first: analogue NTSC recorders write either."""
    frames_between_stills: float = 90.0
    """Mean over a strip, in NTSC frames (PAL takes the same time), 30 to 300."""
    frozen_picture: FrozenPicture = FrozenPicture.LAST_FIELDS
    gnss_sigma_m: float = 1.0
    """Noise of a waypoint's position for each axis, 0 to 10 m; below 0.1 m it is RTK, without a shift of metres."""
    gnss_outliers: int = 3
    """Waypoints that are off by 12 to 30 m."""
    control_points: int = 3
    """0 to 20; 0: no control file is written."""
    check_points: int = 11
    """0 to 60; 0: no check file is written."""
    control_sigma_m: float = 0.005
    """Noise of the control points' coordinates for each axis, 0.0001 to 1 m."""
    check_sigma_m: float = 0.002
    """The same for check points."""
    mark_sigma_px: float = 0.3
    """Noise of the image marks for each axis, 0.001 to 10 px."""
    jpeg_quality: int = 92
    """50 to 100."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Threads; the files do not depend on it."""

    def __post_init__(self) -> None:
        for name, least, most in _RANGES:
            value = getattr(self, name)
            if not least <= value <= most:
                raise InputError(f"simulation option {name} must be {least:g} to {most:g}, is {value}")
        if self.field_order is FieldOrder.PROGRESSIVE:
            raise InputError("simulation option field_order must be top or bottom: the finder's signal is interlaced")
        if self.gnss_outliers * 4 > self.strips * self.stations_per_strip + 4:
            raise InputError(f"simulation option gnss_outliers = {self.gnss_outliers}: that is over a quarter of all")


_RANGES: tuple[tuple[str, float, float], ...] = (
    ("seed", 0, 2**31 - 1),
    ("scale", 0.1, 1.0),
    ("brightness_jump", 0.0, 0.6),
    ("strips", 1, 5),
    ("stations_per_strip", 2, 13),
    ("station_spacing_m", 2.0, 12.0),
    ("strip_spacing_m", 4.0, 15.0),
    ("frames_between_stills", 30.0, 300.0),
    ("gnss_sigma_m", 0.0, 10.0),
    ("gnss_outliers", 0, 20),
    ("control_points", 0, 20),
    ("check_points", 0, 60),
    ("control_sigma_m", 1e-4, 1.0),
    ("check_sigma_m", 1e-4, 1.0),
    ("mark_sigma_px", 1e-3, 10.0),
    ("jpeg_quality", 50, 100),
    ("workers", 1, 1024),
)
