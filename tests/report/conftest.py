"""Simulated results of an adjustment: self-consistent numbers, without an adjustment."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from uavkit.core.adjustment import AdjustmentResult, Datum
from uavkit.core.angles import rotation_from_omega_phi_kappa
from uavkit.core.arrays import Array
from uavkit.core.block import Block
from uavkit.core.camera import CameraProfile, InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates, inside_image
from uavkit.core.frames import LocalFrame
from uavkit.core.observations import GnssObservations, Rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.points import CheckPoint, ControlPoint, PointKind
from uavkit.core.records import StillInfo
from uavkit.core.result import CandidateCount, CodePictures, OrientedBlock, PointDifference, PointOrigin

INTERIOR = InteriorOrientation(
    width_px=4000, height_px=3000, principal_distance_px=2684.0, x0_px=2010.0, y0_px=1490.0, k1=-0.05, k2=0.01
)
SIGMAS = InteriorSigmas(principal_distance_px=30.0, x0_px=20.0, y0_px=20.0, k1=0.05, k2=0.05, k3=0.05)
CAMERA = CameraProfile(
    name="GX200",
    maker="Ricoh",
    models=("GX200",),
    sensor_width_mm=7.6,
    focal_length_mm=5.1,
    interior=INTERIOR,
    interior_sigmas=SIGMAS,
)
GSD_M = 0.0056

MakeResult = Callable[..., OrientedBlock]


def embankment_m(xy: Array) -> Array:
    """Return the height of a bank 10 m high that runs from west to east."""
    return np.asarray(10.0 / (1.0 + np.exp(-(xy[:, 1] - 20.0) / 3.0)))


def stations(strips: int, images_per_strip: int) -> tuple[Array, Array]:
    """Return centres (n, 3) and rotations (n, 3, 3) of strips flown to and fro."""
    centres, rotations = [], []
    for strip in range(strips):
        heading = np.pi * (strip % 2)
        for place in np.linspace(5.0, 75.0, images_per_strip)[:: 1 if strip % 2 == 0 else -1]:
            wobble = 0.02 * np.array([np.sin(7.0 * place + strip), np.cos(5.0 * place)])
            centres.append([place, 40.0 * (strip + 0.5) / strips, 22.0 + 0.2 * np.sin(place)])
            rotations.append(rotation_from_omega_phi_kappa(*wobble, heading))
    return np.array(centres), np.array(rotations)


def observe(points: Array, centres: Array, rotations: Array, rng: np.random.Generator) -> tuple[Rays, Array]:
    """Return the rays of points in all stills, and their errors in pixels."""
    image, point, xy = [], [], []
    for row, (centre, rotation) in enumerate(zip(centres, rotations, strict=True)):
        exterior = ExteriorOrientation(projection_centre_m=centre, R_object_from_image=rotation)
        seen = image_coordinates(points, exterior, INTERIOR)
        inside = np.flatnonzero(inside_image(seen, INTERIOR))
        image.append(np.full(len(inside), row))
        point.append(inside)
        xy.append(seen[inside])
    exact = np.vstack(xy)
    error = rng.normal(0.0, 0.3, exact.shape)
    rays = Rays(
        image_index=np.concatenate(image).astype(np.int64),
        point_index=np.concatenate(point).astype(np.int64),
        xy_px=exact + error,
        sigma_px=np.full(exact.shape, 0.3),
    )
    return rays, error


def diagonal(sigmas: tuple[float, ...], count: int) -> Array:
    """Return ``count`` diagonal covariances of some sigmas."""
    return np.tile(np.diag(np.square(sigmas)), (count, 1, 1))


def surveyed(kind: type, prefix: str, places: Array) -> tuple[ControlPoint | CheckPoint, ...]:
    """Return surveyed points at places (n, 3)."""
    return tuple(
        kind(name=f"{prefix}{row + 1}", position_m=tuple(place), sigma_m=(0.01, 0.01, 0.015), marks=())
        for row, place in enumerate(places)
    )


def compared(points: tuple[ControlPoint | CheckPoint, ...], rng: np.random.Generator) -> tuple[PointDifference, ...]:
    """Return differences drawn from their own sigmas."""
    sigma = (0.012, 0.012, 0.02)
    return tuple(
        PointDifference(
            name=point.name,
            difference_m=tuple(float(value) for value in rng.normal(0.0, sigma)),
            sigma_m=sigma,
            rays=6 + row,
            gsd_m=GSD_M,
        )
        for row, point in enumerate(points)
    )


def code_pictures(rng: np.random.Generator) -> CodePictures:
    """Return pictures of one still made of smooth noise."""
    y, x = np.mgrid[0:150, 0:200]
    waves = sum(np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-0.4, 0.4, (8, 3)) * [1, 1, 8])
    grey = np.clip(128 + 25 * waves, 0, 255).astype(np.uint8)
    dy, dx = np.gradient(grey.astype(float))
    codes = (np.floor(np.arctan2(dy, dx) * 16 / (2 * np.pi)).astype(int) % 16).astype(np.uint8)
    codes[np.abs(dx) + np.abs(dy) < 2.0] = 16
    here = np.column_stack([rng.uniform(40, 195, 90), rng.uniform(5, 145, 90)])
    matches = np.column_stack([here, here - [35.0, 0.0] + rng.normal(0, 1, here.shape)])
    return CodePictures(
        still="S01.JPG",
        grey=grey,
        codes=codes,
        richness=np.hypot(dx, dy).astype(np.float32) / 20.0,
        matches=matches,
        next_still="S02.JPG",
        next_grey=np.roll(grey, -35, axis=1),
    )


def make_result_(strips: int = 3, images_per_strip: int = 11, points: int = 900, seed: int = 1) -> OrientedBlock:
    """Return the result of a block over an embankment of 80 m x 40 m."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([0.0, 0.0], [80.0, 40.0], (points, 2))
    points_m = np.column_stack([xy, embankment_m(xy)])
    centres, rotations = stations(strips, images_per_strip)
    n = len(centres)
    rays, error = observe(points_m, centres, rotations, rng)
    names = tuple(f"S{row + 1:02d}.JPG" for row in range(n))
    control = surveyed(ControlPoint, "G", points_m[[0, 1, 2]])
    check = surveyed(CheckPoint, "C", points_m[3:14])
    gnss = GnssObservations(
        image_index=np.arange(n),
        position_m=centres + rng.normal(0, 1.0, (n, 3)),
        sigma_m=np.full((n, 3), 1.5),
        flight=np.zeros(n, dtype=np.int64),
    )
    gnss_residuals = rng.normal(0, 1.0, (n, 3))
    gnss_used = np.ones(n, dtype=bool)
    gnss_used[4], gnss_residuals[4] = False, [31.5, -8.25, 12.0]
    kinds = np.where(np.arange(points) % 3 == 0, PointKind.TIE, PointKind.PASS).astype(np.int8)
    kinds[:3], kinds[3:14] = PointKind.CONTROL, PointKind.CHECK
    interior_sigma = np.array([0.8, 1.1, 1.3, 2e-4, 5e-4, 0.048, 0, 0, 0, 0])
    block = Block(
        camera=CAMERA,
        interior=INTERIOR,
        stills=tuple(StillInfo(name=name, width_px=4000, height_px=3000) for name in (*names, "X99.JPG")),
        frame=LocalFrame.at(35.7, 139.6, 40.0),
        gnss=gnss,
        control_points=control,
        check_points=check,
        notes=("the video has no sound of the shutter",),
    )
    adjustment = AdjustmentResult(
        interior=replace(INTERIOR, principal_distance_px=2691.25, k1=-0.0513),
        interior_covariance=_correlated(interior_sigma),
        undetermined_interior=("k3",),
        projection_centres_m=centres,
        R_object_from_image=rotations,
        exterior_covariances=diagonal((0.01, 0.01, 0.008, 4e-4, 4e-4, 1e-4), n),
        points_m=points_m,
        point_covariances_m2=diagonal((0.006, 0.008, 0.012), points),
        ray_used=rng.random(len(rays)) > 0.02,
        ray_residuals_px=error,
        ray_redundancy=np.full((len(rays), 2), 0.7),
        gnss_used=gnss_used,
        gnss_residuals_m=gnss_residuals,
        gnss_shift_m=np.array([[1.25, -0.75, 3.5]]),
        gnss_shift_covariance_m2=diagonal((0.25, 0.25, 0.3), 1),
        control_used=np.ones(3, dtype=bool),
        control_residuals_m=np.zeros((3, 3)),
        sigma0=1.013,
        redundancy=1.4 * len(rays),
        group_sigma0={"rays": 1.012, "gnss": 0.95, "control": 1.1, "interior": 0.6},
        datum=Datum.CONTROL,
        iterations=7,
    )
    return OrientedBlock(
        block=block,
        images=names,
        unoriented={"X99.JPG": "fewer than 8 points in common with any other still"},
        adjustment=adjustment,
        rays=rays,
        point_kinds=kinds,
        point_origins=np.full(points, PointOrigin.VIDEO, dtype=np.int8),
        point_colours=np.full((points, 3), 128, dtype=np.uint8),
        strips=np.repeat(np.arange(strips), images_per_strip),
        control=compared(control, rng),
        check=compared(check, rng),
        check_covariance_m2=np.diag(np.tile(np.square([0.012, 0.012, 0.02]), 11)),
        candidates={"video": CandidateCount(found=2000, survived=880), "features": CandidateCount(found=0, survived=0)},
        video_share=0.81,
        gsd_m=GSD_M,
        seconds={"tracking": 41.5, "adjustment": 3.25},
        peak_memory_mb=812.0,
        notes=("two frames of the video were damaged",),
        pictures=code_pictures(rng),
    )


def _correlated(sigma: Array) -> Array:
    covariance = np.diag(sigma**2)
    covariance[3, 4] = covariance[4, 3] = -0.9 * sigma[3] * sigma[4]
    return covariance


@pytest.fixture(scope="session")
def make_result() -> MakeResult:
    """Return the maker of results, for tests that change their size."""
    return make_result_


@pytest.fixture(scope="session")
def result() -> OrientedBlock:
    """Return one small result."""
    return make_result_(strips=2, images_per_strip=4, points=300)
