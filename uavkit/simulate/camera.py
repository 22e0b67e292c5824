"""The simulated camera with its own ray code: pixels to rays, rays to the ground, points to pixels."""

from dataclasses import asdict, dataclass

import numpy as np

from uavkit.core.arrays import Array
from uavkit.simulate.kernels import hits
from uavkit.simulate.world import World, enu_from_site

FULL_WIDTH_PX = 4000
FULL_HEIGHT_PX = 3000
PIXEL_MM = 0.0019
FOCAL_LENGTH_MM = 5.1
LATTICE_PX = 4
"""Distance of the nodes between which rays are interpolated; the error is below 0.001 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCamera:
    """True interior orientation. Distorted = ideal (1 + k1 r2 + k2 r4 + k3 r6) + decentring, as in Brown (1971)."""

    width_px: int
    height_px: int
    principal_distance_px: float
    x0_px: float
    y0_px: float
    k1: float
    k2: float
    k3: float
    p1: float
    p2: float

    def pixels_of(self, ideal: Array) -> Array:
        """Pixels (n, 2) of ideal image coordinates (n, 2), x right, y down, at unit distance."""
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x**2 + y**2
        stretch = 1.0 + self.k1 * r2 + self.k2 * r2**2 + self.k3 * r2**3
        xd = x * stretch + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2)
        yd = y * stretch + self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y
        return np.column_stack(
            [self.x0_px + self.principal_distance_px * xd, self.y0_px + self.principal_distance_px * yd]
        )

    def ideal_of(self, pixels: Array) -> Array:
        """Ideal image coordinates of pixels: the inverse of ``pixels_of`` by Newton's method."""
        centre = np.array([self.x0_px, self.y0_px])
        ideal = (pixels - centre) / self.principal_distance_px
        h = 1e-6
        for _ in range(8):
            gap = self.pixels_of(ideal) - pixels
            ex = (self.pixels_of(ideal + [h, 0.0]) - self.pixels_of(ideal - [h, 0.0])) / (2 * h)
            ey = (self.pixels_of(ideal + [0.0, h]) - self.pixels_of(ideal - [0.0, h])) / (2 * h)
            determinant = ex[:, 0] * ey[:, 1] - ey[:, 0] * ex[:, 1]
            ideal = ideal - np.column_stack(
                [
                    (ey[:, 1] * gap[:, 0] - ey[:, 0] * gap[:, 1]) / determinant,
                    (ex[:, 0] * gap[:, 1] - ex[:, 1] * gap[:, 0]) / determinant,
                ]
            )
        return np.asarray(ideal)

    def lattice(self) -> Array:
        """Ideal coordinates at the nodes of a lattice of ``LATTICE_PX`` over the image; node (1, 1) is pixel (0, 0)."""
        columns = (np.arange(self.width_px // LATTICE_PX + 4) - 1.0) * LATTICE_PX
        rows = (np.arange(self.height_px // LATTICE_PX + 4) - 1.0) * LATTICE_PX
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        return self.ideal_of(grid.reshape(-1, 2)).reshape(grid.shape)

    def as_dict(self) -> dict[str, float]:
        """The parameters by name."""
        return asdict(self)


def true_camera(seed: int, scale: float) -> SimulatedCamera:
    """The camera of a survey: near the type's nominal values, never on them."""
    rng = np.random.default_rng([seed, 2])
    width, height = round(FULL_WIDTH_PX * scale), round(FULL_HEIGHT_PX * scale)
    x0, y0 = 1999.5 + rng.uniform(-18, 18), 1499.5 + rng.uniform(-18, 18)
    return SimulatedCamera(
        width_px=width,
        height_px=height,
        principal_distance_px=(FOCAL_LENGTH_MM / PIXEL_MM + rng.uniform(-15, 15)) * scale,
        x0_px=(x0 + 0.5) * scale - 0.5,
        y0_px=(y0 + 0.5) * scale - 0.5,
        k1=-0.040 + rng.normal(0, 0.004),
        k2=0.018 + rng.normal(0, 0.002),
        k3=-0.004 + rng.normal(0, 0.0006),
        p1=rng.normal(0, 3e-4),
        p2=rng.normal(0, 3e-4),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedView:
    """A camera in its place."""

    camera: SimulatedCamera
    centre_m: Array
    """East, north, up of the projection centre."""
    R_object_from_image: Array

    def project(self, points_m: Array) -> Array:
        """True pixels (n, 2) of points (n, 3) in east, north, up."""
        in_image = (points_m - self.centre_m) @ self.R_object_from_image
        distance = -in_image[:, 2]
        return self.camera.pixels_of(np.column_stack([in_image[:, 0] / distance, -in_image[:, 1] / distance]))

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 3) in east, north, up of pixels (n, 2), not normalised."""
        x, y = self.camera.ideal_of(np.asarray(pixels, float)).T
        return np.asarray(np.column_stack([x, -y, -np.ones_like(x)]) @ self.R_object_from_image.T)

    def intersect(self, world: World, pixels: Array) -> Array:
        """Where the rays of pixels (n, 2) first meet the ground: east, north, up (n, 3)."""
        to_enu = enu_from_site()
        rays, centre = self.rays(pixels) @ to_enu, self.centre_m @ to_enu
        ground = world.ground
        falls = -rays[:, 2]
        depths = hits(
            ground.heights_m,
            ground.bounds,
            centre,
            np.ascontiguousarray(rays[:, :2] / falls[:, None]),
        )
        return np.asarray(self.centre_m + self.rays(pixels) * (depths / falls)[:, None])

    def sees(self, world: World, points_m: Array, margin_px: float) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        """Which points of the ground appear in the image, ``margin_px`` off its border and hidden by nothing."""
        pixels = self.project(points_m)
        size = np.array([self.camera.width_px, self.camera.height_px])
        inside = np.all((pixels >= margin_px) & (pixels <= size - 1 - margin_px), axis=1)
        result = np.zeros(len(points_m), dtype=np.bool_)
        if inside.any():
            met = self.intersect(world, pixels[inside])
            result[inside] = np.linalg.norm(met - points_m[inside], axis=1) < 0.02
        return result
