"""Simulated nadir blocks of any size, quickly: strips of 80 % forward and 60 % side overlap, RTK positions."""

import numpy as np

from uavkit.core.adjustment import AdjustmentInput
from uavkit.core.angles import rotation_from_omega_phi_kappa, rotation_from_vector
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates, inside_image
from uavkit.core.observations import GnssObservations, Rays
from uavkit.core.orientation import ExteriorOrientation

CAMERA = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2004.0, y0_px=1494.0, k1=-0.02, k2=0.01,
    p1=1e-4, p2=-1e-4,
)  # fmt: skip
HEIGHT_M = 100.0
BASE_M = 0.2 * HEIGHT_M * 3000 / 2684
STRIP_M = 0.4 * HEIGHT_M * 4000 / 2684
RADIUS_M = 0.6 * HEIGHT_M * 5000 / 2684
"""Farther than this from its nadir an image sees nothing."""
FOUND = 0.4
"""Share of the images with a point in which it is found: 12 see it, 5 have it."""
SIGMA_PX = 0.3
GNSS_SIGMA_M = 0.03


def nadir_block(rng: np.random.Generator, strips: int, images: int, points: int) -> AdjustmentInput:
    """Return observations of so many strips of so many images; approximate values are 0.1 m and 2 mrad off."""
    centres, rotations = _orientations(rng, strips, images)
    ground = _ground(rng, strips, images, points)
    image, row, xy = _rays(rng, centres, rotations, ground)
    keep = np.bincount(row, minlength=points)[row] >= 2
    image, row, xy = image[keep], row[keep], xy[keep]
    seen, row = np.unique(row, return_inverse=True)
    n = len(centres)
    sigmas = InteriorSigmas(principal_distance_px=20.0, x0_px=10.0, y0_px=10.0, k1=0.02, k2=0.02, p1=2e-3, p2=2e-3)
    return AdjustmentInput(
        interior=CAMERA,
        interior_sigmas=sigmas,
        projection_centres_m=centres + rng.normal(0, 0.1, (n, 3)),
        R_object_from_image=rotations @ rotation_from_vector(rng.normal(0, 0.002, (n, 3))),
        points_m=ground[seen] + rng.normal(0, 0.1, (len(seen), 3)),
        rays=Rays(
            image_index=image, point_index=row, xy_px=xy + rng.normal(0, SIGMA_PX, xy.shape),
            sigma_px=np.full(xy.shape, SIGMA_PX),
        ),
        gnss=GnssObservations(
            image_index=np.arange(n), position_m=centres + rng.normal(0, GNSS_SIGMA_M, (n, 3)),
            sigma_m=np.full((n, 3), GNSS_SIGMA_M), flight=np.zeros(n, dtype=np.int64),
            shift_sigma_m=(0.02, 0.02, 0.03),
        ),
    )  # fmt: skip


def _orientations(rng: np.random.Generator, strips: int, images: int) -> tuple[np.ndarray, np.ndarray]:
    strip, along = np.divmod(np.arange(strips * images), images)
    along = np.where(strip % 2 == 0, along, images - 1 - along)
    centres = np.column_stack([strip * STRIP_M, along * BASE_M, np.full(len(strip), HEIGHT_M)])
    angles = rng.normal(0, 0.03, (len(strip), 3))
    angles[:, 2] += np.pi * (strip % 2)
    rotations = np.array([rotation_from_omega_phi_kappa(*row) for row in angles])
    return centres + rng.normal(0, 1.0, centres.shape), rotations


def _ground(rng: np.random.Generator, strips: int, images: int, points: int) -> np.ndarray:
    """Return points in the order in which the strips pass them, as matching would find them."""
    x = rng.uniform(-0.5 * STRIP_M, (strips - 0.5) * STRIP_M, points)
    y = rng.uniform(-2.0 * BASE_M, (images + 1.0) * BASE_M, points)
    ground = np.column_stack([x, y, 5.0 * np.sin(x / 70.0) + 4.0 * np.cos(y / 50.0)])
    return ground[np.lexsort((y, np.round(x / STRIP_M)))]


def _rays(
    rng: np.random.Generator, centres: np.ndarray, rotations: np.ndarray, ground: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    order = np.argsort(ground[:, 1], kind="stable")
    by_y = ground[order]
    bounds = np.searchsorted(by_y[:, 1], centres[:, 1, None] + np.array([-RADIUS_M, RADIUS_M]))
    images, rows, xys = [], [], []
    for i in range(len(centres)):
        near = np.arange(bounds[i, 0], bounds[i, 1])
        near = near[np.abs(by_y[near, 0] - centres[i, 0]) < RADIUS_M]
        exterior = ExteriorOrientation(projection_centre_m=centres[i], R_object_from_image=rotations[i])
        near = near[rng.random(len(near)) < FOUND]
        xy = image_coordinates(by_y[near], exterior, CAMERA)
        found = inside_image(xy, CAMERA)
        images.append(np.full(int(found.sum()), i))
        rows.append(order[near[found]])
        xys.append(xy[found])
    return np.concatenate(images), np.concatenate(rows), np.concatenate(xys)
