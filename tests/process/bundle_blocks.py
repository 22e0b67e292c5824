"""Simulated blocks of known truth for the tests of the bundle."""

from dataclasses import dataclass, replace

import numpy as np

from uavkit.core.adjustment import AdjustmentInput
from uavkit.core.angles import rotation_from_omega_phi_kappa, rotation_from_vector
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates, inside_image
from uavkit.core.observations import ControlObservations, GnssObservations, Rays
from uavkit.core.orientation import ExteriorOrientation

TRUE_INTERIOR = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2004.0, y0_px=1494.0, k1=-0.02, k2=0.01,
    p1=1e-4, p2=-1e-4,
)  # fmt: skip
INTERIOR_SIGMAS = InteriorSigmas(
    principal_distance_px=20.0, x0_px=10.0, y0_px=10.0, k1=0.02, k2=0.02, k3=0.01, p1=2e-3, p2=2e-3
)
SHIFT_SIGMA_M = (2.0, 2.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to simulate; the defaults are the block of the paper: 80 m x 40 m, 10 to 18 m above a relief of 7 m."""

    strips: int = 3
    images: int = 11
    """Of a strip."""
    points: int = 800
    length_m: float = 80.0
    width_m: float = 40.0
    height_m: float = 17.5
    margin_m: tuple[float, float] = (6.0, 7.0)
    sigma_px: float = 0.3
    gnss_sigma_m: float = 1.0
    control: int = 3
    self_calibration: bool = True
    lever_arm_m: tuple[float, float, float] = (0.1, -0.2, 0.3)
    relief: float = 1.0
    """Factor to the heights of the ground; 0 is flat."""
    tilt_rad: float = 0.05
    """Standard deviation of the nadir distance in each axis."""
    height_sigma_m: float = 0.5
    """Standard deviation of the flying height."""
    interior_sigmas: InteriorSigmas = INTERIOR_SIGMAS


@dataclass(frozen=True, kw_only=True)
class SimulatedBlock:
    """Observations and the truth behind them. Points: control first, then 8 check points, then the rest."""

    observations: AdjustmentInput
    interior: InteriorOrientation
    centres_m: np.ndarray
    rotations: np.ndarray
    points_m: np.ndarray
    shift_m: np.ndarray
    check: np.ndarray


def relief_m(x: np.ndarray, y: np.ndarray, plan: Plan) -> np.ndarray:
    """Return the height of the ground: an embankment along the block with a wave on it."""
    return plan.relief * (6.0 * np.exp(-(((y - plan.width_m / 2) / 8.0) ** 2)) + np.sin(x / 5.0))


def _orientations(rng: np.random.Generator, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    centres, rotations = [], []
    for strip in range(plan.strips):
        for image in range(plan.images):
            x = plan.margin_m[0] + (plan.length_m - 2 * plan.margin_m[0]) * image / max(plan.images - 1, 1)
            y = plan.margin_m[1] + (plan.width_m - 2 * plan.margin_m[1]) * strip / max(plan.strips - 1, 1)
            centres.append(np.array([x, y, plan.height_m]) + rng.normal(0, [0.3, 0.3, plan.height_sigma_m]))
            kappa = np.pi / 2 + (strip % 2) * np.pi + rng.normal(0, 0.05)
            rotations.append(rotation_from_omega_phi_kappa(*rng.normal(0, plan.tilt_rad, 2), kappa))
    return np.array(centres), np.array(rotations)


def _seen(points: np.ndarray, centres: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    images, rows, xy = [], [], []
    for i in range(len(centres)):
        exterior = ExteriorOrientation(projection_centre_m=centres[i], R_object_from_image=rotations[i])
        exact = image_coordinates(points, exterior, TRUE_INTERIOR)
        found = np.flatnonzero(inside_image(np.nan_to_num(exact, nan=-1e9), TRUE_INTERIOR))
        images.append(np.full(len(found), i))
        rows.append(found)
        xy.append(exact[found])
    image, row = np.concatenate(images), np.concatenate(rows)
    keep = np.bincount(row, minlength=len(points))[row] >= 2
    return image[keep], row[keep], np.concatenate(xy)[keep]


def _marked(points: np.ndarray, rays_of_point: np.ndarray, plan: Plan) -> np.ndarray:
    """Return rows of well-seen points near the corners and edges for control, and spread ones for check points."""
    w, h = plan.length_m, plan.width_m
    wanted = [(0.1 * w, 0.2 * h), (0.9 * w, 0.25 * h), (0.5 * w, 0.8 * h), (0.12 * w, 0.8 * h), (0.88 * w, 0.8 * h)]
    wanted = wanted[: plan.control] + [(w * a, h * b) for a in (0.1, 0.37, 0.63, 0.9) for b in (0.2, 0.8)]
    chosen: list[int] = []
    for x, y in wanted:
        distance = np.hypot(points[:, 0] - x, points[:, 1] - y) + 1e3 * (rays_of_point < 4)
        distance[chosen] = np.inf
        distance[rays_of_point < 2] = np.inf
        chosen.append(int(np.argmin(distance)))
    return np.array(chosen)


def simulate(rng: np.random.Generator, plan: Plan | None = None, start_error: float = 1.0) -> SimulatedBlock:
    """Return a block with normal errors of the stated sigmas; ``start_error`` 1: 0.3 m and 0.01 rad."""
    plan = plan or Plan()
    centres, rotations = _orientations(rng, plan)
    x, y = rng.uniform(0, plan.length_m, plan.points), rng.uniform(0, plan.width_m, plan.points)
    points = np.column_stack([x, y, relief_m(x, y, plan)])
    image, row, xy = _seen(points, centres, rotations)
    count = np.bincount(row, minlength=len(points))
    first = _marked(points, count, plan)
    order = np.concatenate([first, np.setdiff1d(np.flatnonzero(count), first)])
    new = np.full(len(points), -1)
    new[order] = np.arange(len(order))
    points, row, n = points[order], new[row], len(centres)
    shift = np.array([[1.5, -2.0, 3.0]]) if plan.control else rng.normal(0, SHIFT_SIGMA_M)[None]
    antenna = centres + rotations @ np.array(plan.lever_arm_m) + shift
    sigmas = plan.interior_sigmas if plan.self_calibration else InteriorSigmas()
    prior = TRUE_INTERIOR.with_parameters(TRUE_INTERIOR.parameters() + rng.normal(0, 1, 10) * sigmas.values())
    control = ControlObservations(
        point_index=np.arange(plan.control),
        position_m=points[: plan.control] + rng.normal(0, 0.01, (plan.control, 3)),
        sigma_m=np.full((plan.control, 3), 0.01),
    )
    observations = AdjustmentInput(
        interior=prior,
        interior_sigmas=sigmas,
        projection_centres_m=centres + rng.normal(0, 0.3 * start_error, (n, 3)),
        R_object_from_image=rotations @ rotation_from_vector(rng.normal(0, 0.01 * start_error, (n, 3))),
        points_m=points + rng.normal(0, 0.3 * start_error, points.shape),
        rays=Rays(
            image_index=image, point_index=row, xy_px=xy + rng.normal(0, plan.sigma_px, xy.shape),
            sigma_px=np.full(xy.shape, plan.sigma_px),
        ),
        gnss=GnssObservations(
            image_index=np.arange(n), position_m=antenna + rng.normal(0, plan.gnss_sigma_m, (n, 3)),
            sigma_m=np.full((n, 3), plan.gnss_sigma_m), flight=np.zeros(n, dtype=np.int64),
            lever_arm_m=plan.lever_arm_m,
        ),
        control=control if plan.control else None,
    )  # fmt: skip
    return SimulatedBlock(
        observations=observations, interior=TRUE_INTERIOR, centres_m=centres, rotations=rotations, points_m=points,
        shift_m=shift, check=np.arange(plan.control, plan.control + 8),
    )  # fmt: skip


def with_wrong_rays(
    block: SimulatedBlock, rng: np.random.Generator, kind: str, share: float = 0.2
) -> tuple[AdjustmentInput, np.ndarray]:
    """Return the observations with wrong rays, "uniform" over the image or "one-sided" by 3 to 10 px, and which."""
    rays = block.observations.rays
    wrong, xy = rng.random(len(rays)) < share, rays.xy_px.copy()
    if kind == "uniform":
        xy[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * [3999.0, 2999.0]
    else:
        xy[wrong, 0] += rng.uniform(3.0, 10.0, int(wrong.sum()))
    return replace(block.observations, rays=replace(rays, xy_px=xy)), wrong


def with_wrong_fixes(
    observations: AdjustmentInput, rng: np.random.Generator, share: float = 0.1
) -> tuple[AdjustmentInput, np.ndarray]:
    """Return the observations with GNSS fixes 10 to 30 m off, and which."""
    gnss = observations.gnss
    assert gnss is not None
    wrong = np.zeros(len(gnss), dtype=bool)
    wrong[rng.permutation(len(gnss))[: max(1, round(share * len(gnss)))]] = True
    direction = rng.normal(0, 1, (len(gnss), 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    moved = gnss.position_m + wrong[:, None] * direction * rng.uniform(10.0, 30.0, (len(gnss), 1))
    return replace(observations, gnss=replace(gnss, position_m=moved)), wrong
