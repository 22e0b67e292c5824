"""What a flight is asked to do, and the plan that does it."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array


class AreaKind(Enum):
    """Shape of what is to be surveyed."""

    POLYGON = "polygon"
    LINE = "line"
    POINT = "point"


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyArea:
    """A polygon with holes, a line (corridor, foot of a facade), or a point (middle of an orbit), on WGS 84."""

    name: str
    kind: AreaKind
    latitude_longitude_deg: Array
    """Vertices (n, 2); a polygon's first vertex is not repeated at its end."""
    holes_deg: tuple[Array, ...] = ()
    """Vertices (n, 2) of each hole of a polygon."""

    def __post_init__(self) -> None:
        least = {AreaKind.POLYGON: 3, AreaKind.LINE: 2, AreaKind.POINT: 1}[self.kind]
        for ring in (self.latitude_longitude_deg, *self.holes_deg):
            if ring.ndim != 2 or ring.shape[1] != 2 or not np.all(np.isfinite(ring)):
                raise ValueError(f"{self.name}: vertices are (n, 2) latitude, longitude, got {ring.shape}")
        if len(self.latitude_longitude_deg) < least or any(len(hole) < 3 for hole in self.holes_deg):
            raise ValueError(f"{self.name}: a {self.kind.value} needs {least} vertices, a hole 3")


class Trigger(Enum):
    """What takes the pictures."""

    DISTANCE = "distance"
    TIME = "time"
    HOVER = "hover"
    """The vehicle stops at each exposure station."""


class WaypointRole(Enum):
    """What a waypoint is for."""

    TAKEOFF = "take-off"
    TRANSIT = "transit"
    ENTRY = "entry"
    """Before the first exposure of a strip."""
    EXPOSURE = "exposure"
    """Station of an exposure (hover), or the place where triggering begins or ends."""
    PATH = "path"
    """Bend of the path within a strip, for the height above ground."""
    EXIT = "exit"
    """After the last exposure of a strip."""
    TURN = "turn"
    """Between two strips."""
    RETURN = "return"


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A vertex of the path; the vehicle flies straight, also in height, from one to the next."""

    role: WaypointRole
    latitude_deg: float
    longitude_deg: float
    height_ellipsoid_m: float
    height_above_takeoff_m: float
    height_above_ground_m: float
    speed_m_s: float
    """Over ground, on the leg that ends here."""
    heading_deg: float
    """Of the vehicle, from north, clockwise."""
    hold_s: float = 0.0
    strip: int = -1
    """Index of the strip that it belongs to, -1 outside the strips."""
    exposure: int = -1
    """Index of the exposure taken here by command, or at which triggering begins or ends; -1 for none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightStrip:
    """A line of exposures."""

    area: str
    direction_deg: float
    """From north, clockwise, as flown."""
    base_m: float
    """Horizontal distance of its exposures."""
    first_exposure: int
    exposures: int
    neighbours: tuple[int, ...]
    """Indices of the strips beside it."""
    set_number: int = 0
    """Strips of one set are parallel: 1 is the second direction of a cross grid, one for each leg of a corridor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedExposures:
    """The exposures in the order in which they are taken, one row each."""

    latitude_deg: Array
    longitude_deg: Array
    height_ellipsoid_m: Array
    height_above_ground_m: Array
    """Of the projection centre, vertically above the terrain model (or above flat ground)."""
    R_map_from_image: Array
    """(n, 3, 3); map axes: east, north, up at the exposure."""
    heading_deg: Array
    station: NDArray[np.int64]
    """Number of the exposure station; exposures that two sorties take have the same."""
    strip: NDArray[np.int64]
    sortie: NDArray[np.int64]
    time_s: Array
    """Since the sortie's take-off."""
    forward_overlap: Array
    """Share of the image that the next one of its strip shows, 0 to 1; nan for the last of a strip."""
    side_overlap: Array
    """Share that the strips beside show: on the lesser side where the middle of the image lies in the area, on the
    greater one where only its rim does; nan where there is no strip beside, or the area is not seen."""
    gsd_m: Array
    """(n, 3): least, mean and greatest ground distance of a pixel."""
    sees_area: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.latitude_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sortie:
    """One flight, from take-off to landing."""

    waypoints: tuple[Waypoint, ...] = field(repr=False)
    first_exposure: int
    """Exposures that sorties share are taken by both: this counts among all exposures taken."""
    exposures: int
    length_m: float
    duration_s: float
    climb_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeOff:
    """Where the vehicle starts and lands."""

    latitude_deg: float
    longitude_deg: float
    height_ellipsoid_m: float
    chosen: bool = False
    """True where the planner chose it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanSummary:
    """What a plan costs and what it gives; shares are 0 to 1, nan where there is nothing to measure."""

    area_m2: float
    images: int
    strips: int
    sorties: int
    length_m: float
    duration_s: float
    gsd_m: tuple[float, float, float]
    """Least, mean, greatest over all images of the area."""
    forward_overlap: tuple[float, float]
    """Least, mean."""
    side_overlap: tuple[float, float]
    """Least, mean."""
    height_above_ground_m: tuple[float, float, float]
    """Least, mean, greatest at the exposures."""
    least_clearance_m: float
    """Of the whole path above the terrain model, minus twice that model's sigma."""
    least_images: int
    """Fewest images that see a point of the area."""
    covered: float
    """Share of the area seen by one image at least."""
    covered_enough: float
    """Share of the area seen by as many images as were asked for."""
    motion_blur_px: float
    """Motion during the exposure, in pixels, in the worst image; nan without a shutter time."""
    video_motion_px: float
    """Motion from a video frame to the next, in video pixels, in the worst image; nan without a video."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Everything that was planned: strips, exposures as expected, and the flights that take them."""

    name: str
    camera: str
    vehicle: str
    """Name of the vehicle's profile; empty for none."""
    trigger: Trigger
    areas: tuple[SurveyArea, ...]
    take_off: TakeOff
    strips: tuple[FlightStrip, ...]
    exposures: PlannedExposures
    sorties: tuple[Sortie, ...]
    summary: PlanSummary
    terrain: str
    """What the ground was taken from; empty for flat ground: then all ellipsoidal heights of the plan only count from
    the take-off point, which has 0."""
    images_in_turns: bool = False
    """Triggering goes on between strips; the exposures of turns are not listed."""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageMap:
    """How many images see each cell of the ground."""

    images: NDArray[np.uint16]
    """(rows, columns); row 0 is the southernmost."""
    in_area: NDArray[np.bool_]
    """(rows, columns)."""
    first_xy_m: tuple[float, float]
    """Map coordinates of the middle of cell (0, 0)."""
    cell_m: float
