"""Results in the coordinates that a surveyor's files use: those of the CRS where there is one, else the local ones."""

from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.frames import LocalFrame, parse_crs, utm_crs


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyAxes:
    """Where results are written: easting, northing, ellipsoidal height of a projected CRS, or east, north, up."""

    frame: LocalFrame | None

    @property
    def crs(self) -> str | None:
        """Return the CRS, None for local coordinates."""
        return self.frame.crs if self.frame else None

    @property
    def columns(self) -> tuple[str, str, str]:
        """Return the names of the coordinates."""
        return ("easting", "northing", "height_ellipsoid_m") if self.frame else ("east_m", "north_m", "up_m")

    def coordinates(self, enu_m: Array) -> Array:
        """Return the file's coordinates (n, 3) of local ones (n, 3)."""
        return self.frame.crs_from_enu(enu_m) if self.frame else np.asarray(enu_m, dtype=np.float64)

    def R_axes_from_enu(self, enu_m: Array) -> Array:
        """Return the rotation (3, 3) from local axes to the file's axes at a point (3,)."""
        return self.frame.R_crs_from_enu(enu_m) if self.frame else np.eye(3)


def survey_axes(frame: LocalFrame | None) -> SurveyAxes:
    """Return the axes for a block's frame; for a geographic CRS its UTM zone, as rotations have no axes in degrees."""
    if frame is not None and parse_crs(frame.crs).is_geographic:
        frame = replace(frame, crs=utm_crs(frame.latitude_deg, frame.longitude_deg))
    return SurveyAxes(frame=frame)
