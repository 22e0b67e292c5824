"""Blocks of known truth: stations as of a survey's flight, ground with relief, observations with stated errors."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from uavkit.core.angles import rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array, Flags, Image, Indices, content_hash
from uavkit.core.block import Block, VideoSync
from uavkit.core.camera import CameraProfile, InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates, inside_image, object_rays
from uavkit.core.observations import GnssObservations
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.points import CheckPoint, ControlPoint, ImageMark
from uavkit.core.records import StillInfo

FULL = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2010.0, y0_px=1490.0,
    k1=-0.05, k2=0.01, p1=3e-4, p2=-2e-4,
)  # fmt: skip
SMALL = InteriorOrientation(width_px=800, height_px=600, principal_distance_px=537.0, x0_px=402.0, y0_px=298.0)


@dataclass(frozen=True)
class Ground:
    """A surface of smooth waves: height above the plane up = 0."""

    relief_m: float = 0.0

    def height_m(self, east: Array, north: Array) -> Array:
        return self.relief_m * (np.sin(east / 6.0 + 0.4) + np.cos(north / 5.0 - 0.7) + np.sin((east + north) / 9.0)) / 3

    def under(self, exterior: ExteriorOrientation, rays: Array) -> Array:
        """Where rays (n, 3) from a station meet the surface: relief is gentle, so the fixed point converges."""
        centre = exterior.projection_centre_m
        height = np.zeros(len(rays))
        for _ in range(40):
            points = centre + ((height - centre[2]) / rays[:, 2])[:, None] * rays
            if self.relief_m == 0.0:
                return points
            before, height = height, self.height_m(points[:, 0], points[:, 1])
            if np.abs(height - before).max() < 1e-6:
                break
        return centre + ((height - centre[2]) / rays[:, 2])[:, None] * rays


def stations(
    strips: int, per_strip: int, rng: np.random.Generator, *, base_m: float = 7.0, apart_m: float = 9.0,
    height_m: float = 15.0, tilt_rad: float = 0.05,
) -> list[ExteriorOrientation]:  # fmt: skip
    """Flown to and fro, the heading turned by 180 degrees from strip to strip, with tilts and small errors of place."""
    result = []
    for strip in range(strips):
        for number in range(per_strip):
            along = number if strip % 2 == 0 else per_strip - 1 - number
            centre = np.array([base_m * along, apart_m * strip, height_m]) + rng.normal(0, 0.3, 3)
            kappa = np.pi * (strip % 2) + rng.normal(0, 0.05)
            rotation = rotation_from_omega_phi_kappa(*rng.normal(0, tilt_rad, 2), kappa)
            result.append(ExteriorOrientation(projection_centre_m=centre, R_object_from_image=rotation))
    return result


def ground_points(ground: Ground, places: list[ExteriorOrientation], count: int, rng: np.random.Generator) -> Array:
    """Points (count, 3) on the ground under the stations."""
    centres = np.array([place.projection_centre_m[:2] for place in places])
    east, north = rng.uniform(centres.min(axis=0) - 8.0, centres.max(axis=0) + 8.0, (count, 2)).T
    return np.column_stack([east, north, ground.height_m(east, north)])


@dataclass(frozen=True)
class Observed:
    """Rays with their truth."""

    point: Indices
    image: Indices
    xy_px: Array
    blunder: Flags


def observe(
    places: list[ExteriorOrientation], points: Array, interior: InteriorOrientation, rng: np.random.Generator,
    *, noise_px: float = 0.5, blunders: float = 0.0, margin_px: float = 10.0,
) -> Observed:  # fmt: skip
    """Every point in every still that contains it, with noise; a share of the rays lies anywhere within 400 px."""
    rows = []
    for image, place in enumerate(places):
        xy = image_coordinates(points, place, interior)
        seen = np.flatnonzero(inside_image(xy, interior, margin_px))
        rows.append(np.column_stack([seen, np.full(len(seen), image), xy[seen]]))
    table = np.vstack(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    xy = table[:, 2:] + rng.normal(0, noise_px, (len(table), 2))
    blunder = rng.random(len(table)) < blunders
    xy[blunder] += rng.uniform(-400.0, 400.0, (int(blunder.sum()), 2))
    xy = np.clip(xy, 0, [interior.width_px - 1, interior.height_px - 1])
    return Observed(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), xy, blunder)


def profile(interior: InteriorOrientation, sigmas: InteriorSigmas | None = None) -> CameraProfile:
    """A camera profile with these values."""
    return CameraProfile(
        name="made", maker="made", models=("made",), sensor_width_mm=7.6,
        focal_length_mm=interior.principal_distance_px * 7.6 / interior.width_px, interior=interior,
        interior_sigmas=sigmas or InteriorSigmas(),
    )  # fmt: skip


def still_names(count: int) -> tuple[str, ...]:
    return tuple(f"S{number:03d}.JPG" for number in range(count))


def surveyed(
    name: str, position_m: Array, places: list[ExteriorOrientation], interior: InteriorOrientation,
    rng: np.random.Generator, *, sigma_m: float = 0.01, sigma_px: float = 0.3, check: bool = False,
) -> ControlPoint | CheckPoint:  # fmt: skip
    """A point as surveyed (with noise) and marked (with noise) in every still that contains it."""
    marks = []
    for image, place in zip(still_names(len(places)), places, strict=True):
        xy = image_coordinates(position_m[None], place, interior)
        if inside_image(xy, interior, 5.0)[0]:
            column, row = (xy[0] + rng.normal(0, sigma_px, 2)).tolist()
            marks.append(ImageMark(image=image, column_px=column, row_px=row, sigma_px=sigma_px))
    east, north, up = (position_m + rng.normal(0, sigma_m, 3)).tolist()
    kind = CheckPoint if check else ControlPoint
    return kind(name=name, position_m=(east, north, up), sigma_m=(sigma_m, sigma_m, sigma_m), marks=tuple(marks))


def gnss_of(
    places: list[ExteriorOrientation], rng: np.random.Generator, sigma_m: float, rows: Indices | None = None
) -> GnssObservations:
    """Positions of all stations, or of some, with noise."""
    chosen = np.arange(len(places)) if rows is None else rows
    centres = np.array([places[row].projection_centre_m for row in chosen.tolist()])
    return GnssObservations(
        image_index=chosen,
        position_m=centres + rng.normal(0, sigma_m, centres.shape),
        sigma_m=np.full(centres.shape, sigma_m),
        flight=np.zeros(len(chosen), dtype=np.int64),
    )


def block_of(
    count: int, interior: InteriorOrientation, sigmas: InteriorSigmas | None = None, *,
    gnss: GnssObservations | None = None, control: tuple[ControlPoint, ...] = (), check: tuple[CheckPoint, ...] = (),
    video: VideoSync | None = None,
) -> Block:  # fmt: skip
    """A block of so many stills."""
    return Block(
        camera=profile(interior, sigmas), interior=interior, frame=None, gnss=gnss, control_points=control,
        check_points=check, video=video,
        stills=tuple(
            StillInfo(name=name, width_px=interior.width_px, height_px=interior.height_px)
            for name in still_names(count)
        ),
    )  # fmt: skip


@dataclass(frozen=True)
class Carpet:
    """Texture on the ground: a raster over the plan, finer than the pictures' pixels."""

    grey: np.ndarray
    first_m: Array
    cell_m: float

    def at(self, east: Array, north: Array) -> Array:
        column = ((east - self.first_m[0]) / self.cell_m).astype(np.float32)
        row = ((north - self.first_m[1]) / self.cell_m).astype(np.float32)
        return cv2.remap(self.grey, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def carpet(rng: np.random.Generator, first_m: tuple[float, float], last_m: tuple[float, float], gsd_m: float) -> Carpet:
    """Noise of four scales, the finest a bit coarser than a pixel of the given ground sampling distance."""
    cell = gsd_m / 2.0
    size = tuple(int((last - first) / cell) + 1 for first, last in zip(first_m[::-1], last_m[::-1], strict=True))
    grey = np.zeros(size, np.float32)
    for sigma_px, weight in ((0.9, 0.8), (2.2, 1.0), (6.0, 1.0), (18.0, 0.7)):
        coarse = max(1, int(sigma_px / 1.5))
        shape = (size[1] // coarse + 2, size[0] // coarse + 2)
        layer = cv2.GaussianBlur(rng.normal(0, 1, shape[::-1]).astype(np.float32), (0, 0), 2.0 * sigma_px / coarse)
        layer = cv2.resize(layer, size[::-1], interpolation=cv2.INTER_CUBIC)
        grey += weight * layer / layer.std()
    return Carpet(125 + 38 * grey / grey.std(), np.array(first_m), cell)


def still_of(
    place: ExteriorOrientation, interior: InteriorOrientation, ground: Ground, cover: Carpet,
    rng: np.random.Generator, noise: float = 1.5,
) -> Image:  # fmt: skip
    """The picture that a station takes of the ground: each pixel's own ray meets the surface."""
    row, column = np.indices((interior.height_px, interior.width_px), dtype=np.float64)
    rays = object_rays(np.column_stack([column.ravel(), row.ravel()]), place, interior)
    met = ground.under(place, rays).reshape(interior.height_px, interior.width_px, 3)
    grey = cover.at(met[..., 0], met[..., 1]) + rng.normal(0, noise, row.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


@dataclass
class MadeStills:
    """A StillSource in memory; counts what is read."""

    pictures: dict[str, Image]
    reads: dict[str, int] = field(default_factory=dict)

    def stills(self) -> tuple[StillInfo, ...]:
        return tuple(StillInfo(name=n, width_px=p.shape[1], height_px=p.shape[0]) for n, p in self.pictures.items())

    def grey(self, name: str) -> Image:
        self.reads[name] = self.reads.get(name, 0) + 1
        return self.pictures[name]

    def colour(self, name: str) -> Image:
        grey = self.pictures[name]
        return np.dstack([grey, 255 - grey, grey // 2])

    def fingerprint(self, name: str) -> str:
        return content_hash([self.pictures[name]])
