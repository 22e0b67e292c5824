"""Control and check points: signals on the ground, their surveyed coordinates, and their marks in the stills."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.heights import HeightDatum
from uavkit.formats.control_file import FileMark, FilePoint, PixelOrigin, SurveyedPoints
from uavkit.simulate.camera import SimulatedView
from uavkit.simulate.kernels import CELL_M, COARSE
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.site import CRS, site_frame
from uavkit.simulate.world import SHAPE, World, along_across, enu_from_site

TRIANGLE = ((-0.88, -0.80), (0.86, -0.62), (0.06, 0.85))
"""Of the first three control points, in half extents of the flown area."""
MARGIN_PX = 15.0
"""Distance of a mark from the border of a still of 4000 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TruePoint:
    """A signal with everything true about it."""

    name: str
    position_m: Array
    """East, north, up, shape (3,)."""
    images: tuple[str, ...]
    """Stills that show it."""
    pixels: Array
    """Its true image points there, shape (n, 2)."""


def choose_points(world: World, stations_m: Array, count: int, control: int, seed: int) -> Array:
    """Places of signals on open, gentle ground, shape (count, 3): a triangle first, then spread evenly.

    ``stations_m`` (n, 3) spans the flown area; the first ``control`` places beyond the triangle lie near its rim.
    """
    rng = np.random.default_rng([seed, 7])
    along, across = along_across(stations_m[:, 0], stations_m[:, 1])
    half = np.array([np.ptp(along) / 2 + 2.0, np.ptp(across) / 2 + 3.0])
    places = [_gentle_place(rng, world, half * TRIANGLE[n]) for n in range(3)]
    while len(places) < count:
        tries = rng.uniform(-0.95, 0.95, (40, 2))
        if len(places) < control:
            tries /= np.abs(tries).max(axis=1, keepdims=True)
        gaps = np.linalg.norm((tries * half)[:, None] - np.array(places)[None], axis=2).min(axis=1)
        places.append(_gentle_place(rng, world, tries[np.argmax(gaps)] * half))
    enu = np.column_stack([np.array(places), np.zeros(len(places))]) @ enu_from_site().T
    enu[:, 2] = world.height_m(enu[:, 0], enu[:, 1])
    return enu


def _gentle_place(rng: np.random.Generator, world: World, wanted_m: Array) -> Array:
    """The wanted place (along, across), moved as little as needed away from boulders and boxes."""
    clearance = world.ground.bounds[:, :, 0]
    for attempt in range(400):
        place = wanted_m + rng.normal(0.0, 0.02 * attempt, 2)
        column, row = (int((place[k] / CELL_M + 0.5 * (SHAPE[1 - k] - 1)) / COARSE) for k in (0, 1))
        inside = 0 <= row < clearance.shape[0] and 0 <= column < clearance.shape[1]
        if inside and clearance[row, column] > 0.5:
            return np.asarray(place)
    return np.asarray(wanted_m)


def observe_points(
    world: World, names: Sequence[str], places_m: Array, views: dict[str, SimulatedView]
) -> list[TruePoint]:
    """Each point with the stills in which it is really visible and its true marks there."""
    seen: list[list[tuple[str, Array]]] = [[] for _ in names]
    for image, view in views.items():
        pixels = view.project(places_m)
        visible = view.sees(world, places_m, MARGIN_PX * view.camera.width_px / 4000)
        for n in np.flatnonzero(visible):
            seen[n].append((image, pixels[n]))
    return [
        TruePoint(
            name=name,
            position_m=place,
            images=tuple(image for image, _ in marks),
            pixels=np.array([pixel for _, pixel in marks]).reshape(-1, 2),
        )
        for name, place, marks in zip(names, places_m, seen, strict=True)
    ]


def surveyed(points: Sequence[TruePoint], sigma_m: float, options: SimulationOptions, stream: int) -> SurveyedPoints:
    """The points as a surveyor gives them: with noise in coordinates and marks; ``stream`` separates random numbers."""
    rng = np.random.default_rng([options.seed, 8, stream])
    places = site_frame().crs_from_enu(np.array([point.position_m for point in points]).reshape(-1, 3))
    places = places + rng.normal(0.0, sigma_m, places.shape)
    return SurveyedPoints(
        crs=CRS,
        vertical=HeightDatum.ELLIPSOID,
        pixel_origin=PixelOrigin.CENTRE,
        points=tuple(
            FilePoint(
                name=point.name,
                coordinates=(round(e, 4), round(n, 4), round(h, 4)),
                sigma_m=(sigma_m, sigma_m, sigma_m),
                marks=_marks(rng, point, options.mark_sigma_px),
            )
            for point, (e, n, h) in zip(points, places.tolist(), strict=True)
        ),
    )


def _marks(rng: np.random.Generator, point: TruePoint, sigma_px: float) -> tuple[FileMark, ...]:
    noisy = point.pixels + rng.normal(0.0, sigma_px, point.pixels.shape)
    return tuple(
        FileMark(image=image, column_px=round(column, 3), row_px=round(row, 3), sigma_px=sigma_px)
        for image, (column, row) in zip(point.images, noisy.tolist(), strict=True)
    )
