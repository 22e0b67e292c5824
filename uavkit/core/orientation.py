"""Exterior orientation of an image."""

from dataclasses import dataclass

import numpy as np

from uavkit.core.angles import omega_phi_kappa_from_rotation, rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ExteriorOrientation:
    """Projection centre and rotation of an image in object space."""

    projection_centre_m: Array
    """Shape (3,)."""
    R_object_from_image: Array
    """Shape (3, 3), orthonormal, determinant +1."""

    def __post_init__(self) -> None:
        if self.projection_centre_m.shape != (3,) or self.R_object_from_image.shape != (3, 3):
            raise ValueError("a projection centre has shape (3,) and a rotation (3, 3)")
        if not np.allclose(self.R_object_from_image @ self.R_object_from_image.T, np.eye(3), atol=1e-6):
            raise ValueError("R_object_from_image is not orthonormal")
        if np.linalg.det(self.R_object_from_image) < 0:
            raise ValueError("R_object_from_image is a reflection, not a rotation")

    @classmethod
    def from_omega_phi_kappa(
        cls, projection_centre_m: Array, omega: float, phi: float, kappa: float
    ) -> "ExteriorOrientation":
        """Return an orientation from its centre (3,) in metres and its angles in radians."""
        return cls(
            projection_centre_m=np.asarray(projection_centre_m, dtype=np.float64),
            R_object_from_image=rotation_from_omega_phi_kappa(omega, phi, kappa),
        )

    @property
    def omega_phi_kappa(self) -> tuple[float, float, float]:
        """Return omega, phi, kappa in radians."""
        return omega_phi_kappa_from_rotation(self.R_object_from_image)


def image_space_coordinates(points_m: Array, exterior: ExteriorOrientation) -> Array:
    """Return object points (n, 3) in image space (x right, y up, z to the viewer), metres, shape (n, 3)."""
    return (points_m - exterior.projection_centre_m) @ exterior.R_object_from_image
