"""What process gives: an oriented block, with everything that a report or a product needs."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from uavkit.core.adjustment import AdjustmentResult, Datum
from uavkit.core.arrays import Array, Indices
from uavkit.core.block import Block
from uavkit.core.frames import LocalFrame
from uavkit.core.observations import Rays


class PointOrigin(IntEnum):
    """How an object point was found."""

    MARK = 0
    """Marked by hand: control and check points."""
    VIDEO = 1
    """Followed through the video from still to still."""
    FEATURES = 2
    """Feature matching between stills."""
    FILLING = 3
    """Chosen in the oriented block where no other point was."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointDifference:
    """A control or check point: what the block says minus what was surveyed, in the local frame (east, north, up)."""

    name: str
    difference_m: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    """Predicted for the difference: block and survey together."""
    rays: int
    gsd_m: float
    """Mean ground sampling distance of the images that see the point."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateCount:
    """How many candidates one way of finding points gave, and how many of them are in the adjusted block."""

    found: int
    survived: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CodePictures:
    """The pictures of one still that show how points are chosen and matched (for the report)."""

    still: str
    grey: NDArray[np.uint8]
    codes: NDArray[np.uint8]
    """Orientation codes 0 to 15, 16 where there is none."""
    richness: NDArray[np.float32]
    matches: Array
    """(n, 4): column, row in this still and in the next one, in pixels of these pictures."""
    next_still: str
    next_grey: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedBlock:
    """A block after adjustment. Images are rows of ``images``; points are rows of ``adjustment.points_m``."""

    block: Block
    images: tuple[str, ...]
    """Oriented stills, in the order of the rows of ``adjustment`` and of ``rays.image_index``."""
    unoriented: dict[str, str]
    """Each still that could not be oriented, with the reason."""
    adjustment: AdjustmentResult
    rays: Rays
    point_kinds: NDArray[np.int8]
    """(m,) PointKind."""
    point_origins: NDArray[np.int8]
    """(m,) PointOrigin."""
    point_colours: NDArray[np.uint8]
    """(m, 3) red, green, blue."""
    strips: Indices
    """(n,) number of the strip of each oriented still, from 0; -1 where none can be told."""
    control: tuple[PointDifference, ...]
    check: tuple[PointDifference, ...]
    check_covariance_m2: Array
    """(3 c, 3 c) joint covariance of all check-point differences, in the order of ``check``."""
    candidates: dict[str, CandidateCount]
    """By origin: "video", "features"."""
    video_share: float
    """Share of the used pass points that came through the video."""
    gsd_m: float
    """Mean ground sampling distance of the block."""
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    notes: tuple[str, ...] = ()
    """Degradations and decisions of process, in words."""
    pictures: CodePictures | None = None

    @property
    def frame(self) -> LocalFrame | None:
        """Return where on earth the result lies: the block's frame, None for a free network, which lies nowhere."""
        return None if self.adjustment.datum is Datum.FREE_NETWORK else self.block.frame
