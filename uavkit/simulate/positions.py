"""What the receiver on board says of the waypoints: noise, a shift common to the flight, and a few outliers.

SBAS: a shift of 1 to 2.5 m. RTK (noise below 0.1 m): 1 to 2.5 mm, the error of the base station's coordinates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Indices
from uavkit.core.heights import HeightDatum
from uavkit.core.records import GnssFix
from uavkit.formats.positions_file import ImagePositions
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.site import site_frame

RTK_SIGMA_M = 0.1
"""Below this noise, positions are those of RTK."""
RTK_SHIFT = 1e-3
"""Common shift of RTK against that of SBAS."""
RTK_SHIFT_SIGMA_M = 0.002
"""Stated with RTK positions; the root mean square of the simulated shifts is 0.0018 m for each axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WaypointPositions:
    """Measured positions of the exposure stations with their true errors."""

    measured_m: Array
    """(n, 3) east, north, up. Antenna and projection centre are the same place: there is no lever arm."""
    shift_m: Array
    """(3,) common to all."""
    outliers: Indices
    """Rows of gross errors."""

    def fixes(self) -> tuple[GnssFix, ...]:
        """As positions of a flight log, ellipsoidal heights, without times."""
        return fixes_at(self.measured_m)

    def of_images(self, names: Sequence[str], sigma_m: float) -> ImagePositions:
        """As RTK and PPK software tells them, with the image and the sigma of each."""
        places = site_frame().geographic_from_enu(self.measured_m).tolist()
        stated_m = max(sigma_m, 1e-3)
        fixes = [
            GnssFix(
                gps_time_ns=None,
                latitude_deg=latitude,
                longitude_deg=longitude,
                height_m=height,
                height_datum=HeightDatum.ELLIPSOID,
                sigma_horizontal_m=stated_m,
                sigma_vertical_m=stated_m,
                name=name,
            )
            for name, (latitude, longitude, height) in zip(names, places, strict=True)
        ]
        shift = (RTK_SHIFT_SIGMA_M,) * 3 if sigma_m < RTK_SIGMA_M else None
        return ImagePositions(fixes=tuple(fixes), shift_sigma_m=shift)


def fixes_at(measured_m: Array) -> tuple[GnssFix, ...]:
    """Positions (n, 3) in east, north, up as fixes named WP001, WP002 ..."""
    return tuple(
        GnssFix(
            gps_time_ns=None,
            latitude_deg=round(latitude, 8),
            longitude_deg=round(longitude, 8),
            height_m=round(height, 3),
            height_datum=HeightDatum.ELLIPSOID,
            name=f"WP{n:03d}",
        )
        for n, (latitude, longitude, height) in enumerate(
            site_frame().geographic_from_enu(measured_m).tolist(), start=1
        )
    )


def measure_waypoints(centres_m: Array, options: SimulationOptions) -> WaypointPositions:
    """Measure the projection centres (n, 3) as the receiver does."""
    rng = np.random.default_rng([options.seed, 9])
    shift = rng.uniform(1.0, 2.5, 3) * rng.choice([-1.0, 1.0], 3)
    shift *= RTK_SHIFT if options.gnss_sigma_m < RTK_SIGMA_M else min(options.gnss_sigma_m, 1.0)
    measured = centres_m + shift + rng.normal(0.0, 1.0, centres_m.shape) * options.gnss_sigma_m
    outliers = np.sort(rng.choice(len(centres_m), options.gnss_outliers, replace=False)).astype(np.int64)
    for n in outliers:
        direction = rng.normal(0.0, 1.0, 3)
        measured[n] += direction / np.linalg.norm(direction) * rng.uniform(12.0, 30.0)
    return WaypointPositions(measured_m=measured, shift_m=shift, outliers=outliers)
