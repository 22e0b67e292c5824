"""The block: what ingest hands to process."""

from dataclasses import dataclass
from enum import Enum

from uavkit.core.arrays import Array, Flags
from uavkit.core.camera import CameraProfile, InteriorOrientation
from uavkit.core.errors import InputError
from uavkit.core.exposures import ExposureMatches
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import GnssObservations
from uavkit.core.points import CheckPoint, ControlPoint
from uavkit.core.records import FieldOrder, StillInfo
from uavkit.core.video import AffineTransformation


@dataclass(frozen=True, slots=True, kw_only=True)
class StillInVideo:
    """Where in the video a still was taken."""

    still: str
    last_frame: int
    """Last frame before the shutter whose picture can be used."""
    first_frame: int
    """First frame after the shutter whose picture moves again."""
    exposure_time_ns: int
    """Estimated time of the exposure since the first frame."""
    kind: str
    """How the shutter showed: "black", "frozen", "flash", or "content" where only the content tells."""
    confidence: float
    """Probability, 0 to 1, that this is the still's place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoSync:
    """Stills synchronised with the video."""

    places: tuple[StillInVideo, ...]
    """In the order of time; stills without a place are not in it."""
    still_from_video: AffineTransformation
    """From frame coordinates (column, row of the woven frame) to the still's pixels."""
    residual_px: float
    """RMS residual of still_from_video, in still pixels."""
    field_order: FieldOrder
    frame_interval_ns: int
    stills_without_event: tuple[str, ...] = ()
    events_without_still: tuple[int, ...] = ()
    """First frames of shutter events that belong to no still."""


class PositionSource(Enum):
    """Where the positions of the stills come from."""

    LISTED = "a list of positions"
    LOG = "flight logs"
    EXIF = "the stills' own files"


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionFacts:
    """What is known of all positions of a block together."""

    source: PositionSource
    height_datum: HeightDatum
    """As given; the block itself counts all heights from the ellipsoid."""
    probability: Array
    """(g,) that the position belongs to its still; 1 where names or the files themselves tell."""
    sigma_stated: Flags
    """(g,) whether the source states the accuracy; else a usual one is taken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Stills of one camera with everything observed of them but their contents."""

    camera: CameraProfile
    interior: InteriorOrientation
    """A priori, for the size of these stills."""
    stills: tuple[StillInfo, ...]
    frame: LocalFrame | None
    """None where nothing tells where on earth the block lies."""
    gnss: GnssObservations | None = None
    positions: PositionFacts | None = None
    """Of ``gnss``; None without it."""
    control_points: tuple[ControlPoint, ...] = ()
    check_points: tuple[CheckPoint, ...] = ()
    video: VideoSync | None = None
    exposures: ExposureMatches | None = None
    """None where no log tells of exposures."""
    notes: tuple[str, ...] = ()
    """Degradations and decisions of ingest, in words, for the report."""

    def __post_init__(self) -> None:
        names = [still.name for still in self.stills]
        if len(set(names)) != len(names):
            raise InputError("two stills of the block have the same name: rename one of them")

    def image_index(self, name: str) -> int:
        """Return the row of a still; raises KeyError for an unknown name."""
        for index, still in enumerate(self.stills):
            if still.name == name:
                return index
        raise KeyError(name)
