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
from uavkit.simulate.terrain import SHAPE
from uavkit.simulate.world import World, along_across, enu_from_site

TRIANGLE = ((-0.82, -0.70), (0.80, -0.55), (0.05, 0.72))
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


def choose_points(world: World, stations_m: Array, views: Sequence[SimulatedView], options: SimulationOptions) -> Array:
    """Places of the signals, control first, shape (n, 3): a triangle, then spread evenly; on open, gentle ground.

    ``stations_m`` (n, 3) spans the flown area. Each place is chosen among several so that many views see it; further
    control points lie near the rim.
    """
    rng = np.random.default_rng([options.seed, 7])
    along, across = along_across(stations_m[:, 0], stations_m[:, 1])
    half = np.array([np.ptp(along) / 2 + 2.0, np.ptp(across) / 2 + 3.0])
    places: list[Array] = []
    for n in range(options.control_points + options.check_points):
        tries = rng.uniform(-0.95, 0.95, (40, 2))
        if n < 3:
            wanted = half * TRIANGLE[n]
        else:
            if n < options.control_points:
                tries *= 0.9 / np.abs(tries).max(axis=1, keepdims=True)
            gaps = np.linalg.norm((tries * half)[:, None] - np.array(places)[None], axis=2).min(axis=1)
            wanted = tries[np.argmax(gaps)] * half
        places.append(_best_place(rng, world, views, wanted, half))
    enu = np.column_stack([np.array(places).reshape(-1, 2), np.zeros(len(places))]) @ enu_from_site().T
    enu[:, 2] = world.height_m(enu[:, 0], enu[:, 1])
    return enu


def _best_place(
    rng: np.random.Generator, world: World, views: Sequence[SimulatedView], wanted_m: Array, half_m: Array
) -> Array:
    """A gentle place (along, across) near the wanted one that many views see; a view is worth 1.5 m of distance."""
    places = np.vstack([wanted_m[None], wanted_m + rng.normal(0.0, 1.0, (60, 2)) * [2.2, 1.8]])
    places = np.clip(places, -half_m, half_m)
    columns, rows = (((places[:, k] / CELL_M + 0.5 * (SHAPE[1 - k] - 1)) / COARSE).astype(int) for k in (0, 1))
    gentle = world.ground.bounds[rows, columns, 0] > 0.5
    enu = np.column_stack([places, np.zeros(len(places))]) @ enu_from_site().T
    enu[:, 2] = world.height_m(enu[:, 0], enu[:, 1])
    seen = sum(view.sees(world, enu, MARGIN_PX * view.camera.width_px / 4000).astype(int) for view in views)
    score = np.minimum(seen, 8) - np.linalg.norm(places - wanted_m, axis=1) / 1.5 - 100.0 * ~gentle
    return np.asarray(places[np.argmax(score)])


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
