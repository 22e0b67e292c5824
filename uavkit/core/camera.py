"""Interior orientation with Brown's distortion, and camera profiles."""

from dataclasses import dataclass, fields, replace

import numpy as np

from uavkit.core.arrays import Array

INTERIOR_PARAMETERS = ("principal_distance_px", "x0_px", "y0_px", "k1", "k2", "k3", "p1", "p2", "b1", "b2")


@dataclass(frozen=True, slots=True, kw_only=True)
class InteriorOrientation:
    """Principal distance, principal point and distortion of a camera, for images of one size.

    column = x0 + c ((1 + b1) xd + b2 yd),  row = y0 + c yd, with (xd, yd) the distorted normalised coordinates, y down.
    """

    width_px: int
    height_px: int
    principal_distance_px: float
    x0_px: float
    """Column of the principal point; (0, 0) is the centre of the upper left pixel."""
    y0_px: float
    """Row of the principal point."""
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    """Affinity: scale of columns against rows, minus one."""
    b2: float = 0.0
    """Shear of columns by rows."""

    def __post_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"image size must be > 0, is {self.width_px} x {self.height_px} px")
        if not self.principal_distance_px > 0:
            raise ValueError(f"principal_distance_px must be > 0, is {self.principal_distance_px}")

    def parameters(self) -> Array:
        """Return the ten parameters in the order of INTERIOR_PARAMETERS, shape (10,)."""
        return np.array([getattr(self, name) for name in INTERIOR_PARAMETERS], dtype=np.float64)

    def with_parameters(self, values: Array) -> "InteriorOrientation":
        """Return the same camera with other values, shape (10,), in the order of INTERIOR_PARAMETERS."""
        c, x0, y0, k1, k2, k3, p1, p2, b1, b2 = (float(value) for value in values)
        return replace(
            self, principal_distance_px=c, x0_px=x0, y0_px=y0, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2, b1=b1, b2=b2
        )

    def scaled(self, width_px: int, height_px: int) -> "InteriorOrientation":
        """Return the interior orientation of the same picture resampled to another size (pixel centres at integers)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            principal_distance_px=self.principal_distance_px * sy,
            x0_px=(self.x0_px + 0.5) * sx - 0.5,
            y0_px=(self.y0_px + 0.5) * sy - 0.5,
            b1=(1.0 + self.b1) * sx / sy - 1.0,
            b2=self.b2 * sx / sy,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class InteriorSigmas:
    """A priori standard deviation of each parameter of an interior orientation; 0 keeps the parameter fixed."""

    principal_distance_px: float = 0.0
    x0_px: float = 0.0
    y0_px: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) >= 0.0:
                raise ValueError(f"sigma of {field.name} must be >= 0, is {getattr(self, field.name)}")

    def values(self) -> Array:
        """Return the sigmas in the order of INTERIOR_PARAMETERS, shape (10,)."""
        return np.array([getattr(self, name) for name in INTERIOR_PARAMETERS], dtype=np.float64)

    def scaled(self, factor: float) -> "InteriorSigmas":
        """Return the sigmas for pictures enlarged by a factor: those in pixels grow with it."""
        return replace(
            self,
            principal_distance_px=self.principal_distance_px * factor,
            x0_px=self.x0_px * factor,
            y0_px=self.y0_px * factor,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraProfile:
    """What is known of a camera type before it flies."""

    name: str
    maker: str
    models: tuple[str, ...]
    """EXIF model names by which its pictures are recognised."""
    sensor_width_mm: float
    focal_length_mm: float
    interior: InteriorOrientation
    interior_sigmas: InteriorSigmas
    mass_g: float | None = None
    least_interval_s: float | None = None
    readout_s: float | None = None
    """Time from the first to the last row; 0 for a global shutter, None where it is not known."""
    source: str = ""

    @property
    def pixel_size_mm(self) -> float:
        """Return the side of a pixel on the sensor."""
        return self.sensor_width_mm / self.interior.width_px


def distort(ideal: Array, interior: InteriorOrientation) -> Array:
    """Return distorted normalised coordinates (n, 2) of ideal ones (n, 2), y down (Brown 1971, OpenCV's form)."""
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (interior.k1 + r2 * (interior.k2 + r2 * interior.k3))
    xy2 = 2.0 * x * y
    xd = x * radial + interior.p1 * xy2 + interior.p2 * (r2 + 2.0 * x * x)
    yd = y * radial + interior.p1 * (r2 + 2.0 * y * y) + interior.p2 * xy2
    return np.column_stack([xd, yd])


def undistort(distorted: Array, interior: InteriorOrientation) -> Array:
    """Return the ideal normalised coordinates (n, 2) of distorted ones (n, 2), by Newton's method to 1e-13.

    Raises ValueError where the distortion polynomial cannot be inverted (it folds over outside its valid radius).
    """
    ideal = np.array(distorted, dtype=np.float64)
    for _ in range(30):
        residual = distort(ideal, interior) - distorted
        jacobian = distortion_jacobian(ideal, interior)
        determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        if np.any(determinant <= 0.05):
            break
        ideal[:, 0] -= (jacobian[:, 1, 1] * residual[:, 0] - jacobian[:, 0, 1] * residual[:, 1]) / determinant
        ideal[:, 1] -= (jacobian[:, 0, 0] * residual[:, 1] - jacobian[:, 1, 0] * residual[:, 0]) / determinant
        if residual.size == 0 or float(np.max(np.abs(residual))) < 1e-13:
            return ideal
    if np.all(np.abs(distort(ideal, interior) - distorted) < 1e-9):
        return ideal
    raise ValueError("the distortion cannot be inverted over the whole image: its radial polynomial folds over")


def distortion_jacobian(ideal: Array, interior: InteriorOrientation) -> Array:
    """Return d(distorted) / d(ideal) at ideal normalised coordinates (n, 2), shape (n, 2, 2)."""
    x, y = ideal[:, 0], ideal[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (interior.k1 + r2 * (interior.k2 + r2 * interior.k3))
    slope = 2.0 * (interior.k1 + r2 * (2.0 * interior.k2 + r2 * 3.0 * interior.k3))
    p1, p2 = interior.p1, interior.p2
    cross = x * y * slope + 2.0 * (p1 * x + p2 * y)
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return np.stack([np.stack([xx, cross], axis=-1), np.stack([cross, yy], axis=-1)], axis=-2)


def pixels_from_ideal(ideal: Array, interior: InteriorOrientation) -> Array:
    """Return image points (n, 2) in pixels (column, row) of ideal normalised coordinates (n, 2), y down."""
    xd, yd = distort(ideal, interior).T
    c = interior.principal_distance_px
    column = interior.x0_px + c * ((1.0 + interior.b1) * xd + interior.b2 * yd)
    return np.column_stack([column, interior.y0_px + c * yd])


def ideal_from_pixels(xy_px: Array, interior: InteriorOrientation) -> Array:
    """Return ideal normalised coordinates (n, 2), y down, of image points (n, 2) in pixels."""
    xy = np.atleast_2d(np.asarray(xy_px, dtype=np.float64))
    yd = (xy[:, 1] - interior.y0_px) / interior.principal_distance_px
    xd = ((xy[:, 0] - interior.x0_px) / interior.principal_distance_px - interior.b2 * yd) / (1.0 + interior.b1)
    return undistort(np.column_stack([xd, yd]), interior)


def image_directions(xy_px: Array, interior: InteriorOrientation) -> Array:
    """Return directions (n, 3) in image space (x right, y up, z = -1) of image points (n, 2) in pixels."""
    x, y_down = ideal_from_pixels(xy_px, interior).T
    return np.column_stack([x, -y_down, -np.ones_like(x)])
