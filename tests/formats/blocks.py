"""A small oriented block of known geometry for the tests of the writers."""

from dataclasses import replace

import numpy as np

from uavkit.core.adjustment import AdjustmentResult, Datum
from uavkit.core.arrays import Array
from uavkit.core.block import Block, StillInVideo, VideoSync
from uavkit.core.camera import CameraProfile, InteriorOrientation, InteriorSigmas
from uavkit.core.collinearity import image_coordinates
from uavkit.core.frames import LocalFrame
from uavkit.core.heights import HeightDatum
from uavkit.core.observations import GnssObservations, Rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.points import CheckPoint, ControlPoint, ImageMark, PointKind
from uavkit.core.records import FieldOrder, GnssFix, StillInfo
from uavkit.core.result import CandidateCount, CodePictures, OrientedBlock, PointDifference, PointOrigin
from uavkit.core.video import AffineTransformation

FRAME = LocalFrame(latitude_deg=35.8, longitude_deg=139.65, height_ellipsoid_m=40.0, crs="EPSG:32654")
INTERIOR = InteriorOrientation(
    width_px=1000, height_px=750, principal_distance_px=900.0, x0_px=503.0, y0_px=371.0,
    k1=-0.08, k2=0.03, k3=-0.01, p1=0.001, p2=-0.002,
)  # fmt: skip
CAMERA = CameraProfile(
    name="test", maker="T", models=("T1",), sensor_width_mm=6.0, focal_length_mm=5.4, interior=INTERIOR,
    interior_sigmas=InteriorSigmas(principal_distance_px=9.0, x0_px=5.0, y0_px=5.0, k1=0.1, k2=0.1, k3=0.1),
)  # fmt: skip


def random_covariance(rng: np.random.Generator, size: int, scale: float = 1.0) -> Array:
    """Return a full, positive definite covariance matrix."""
    root = rng.normal(size=(size, size + 2)) * scale
    return np.asarray(root @ root.T / size)


def small_block(frame: LocalFrame | None = FRAME) -> Block:
    """Return a block of four stills with everything that a block can have."""
    rng = np.random.default_rng(5)
    fix = GnssFix(
        gps_time_ns=1_400_000_000_123_456_789, latitude_deg=35.8, longitude_deg=139.65, height_m=float("nan"),
        height_datum=HeightDatum.UNKNOWN, name="s0.jpg",
    )  # fmt: skip
    stills = tuple(
        StillInfo(name=f"s{i}.jpg", width_px=1000, height_px=750, focal_length_mm=5.4, camera_time_ns=i, position=fix)
        for i in range(4)
    )
    mark = ImageMark(image="s0.jpg", column_px=1 / 3, row_px=2.5, sigma_px=0.5)
    control = ControlPoint(name="C1", position_m=(0.1, 0.2, 1 / 3), sigma_m=(0.01, 0.01, 0.02), marks=(mark,))
    place = StillInVideo(
        still="s1.jpg", last_frame=10, first_frame=20, exposure_time_ns=5, kind="black", confidence=0.9
    )
    return Block(
        camera=CAMERA,
        interior=INTERIOR,
        stills=stills,
        frame=frame,
        gnss=GnssObservations(
            image_index=np.arange(4), position_m=rng.normal(size=(4, 3)), sigma_m=np.full((4, 3), 0.5),
            flight=np.zeros(4, dtype=np.int64), shift_sigma_m=(1.0, 1.0, 2.0),
        ),
        control_points=(control,),
        check_points=(CheckPoint(name="K1", position_m=(1.0, 2.0, 3.0), sigma_m=(0.01, 0.01, 0.02), marks=()),),
        video=VideoSync(
            places=(place,),
            still_from_video=AffineTransformation(matrix=rng.normal(size=(2, 2)), shift=rng.normal(size=2)),
            residual_px=0.7, field_order=FieldOrder.TOP_FIRST, frame_interval_ns=33_366_667, events_without_still=(7,),
        ),
        notes=("a note ü",),
    )  # fmt: skip


def oriented_block(frame: LocalFrame | None = FRAME) -> OrientedBlock:
    """Return three oriented images of twelve points, seen exactly where they are, with full covariances."""
    rng = np.random.default_rng(6)
    centres = np.array([[0.0, 0.0, 60.0], [12.0, 1.0, 61.0], [25.0, -1.0, 59.0]])
    exteriors = [
        ExteriorOrientation.from_omega_phi_kappa(centre, *rng.normal(0.0, 0.08, 2), kappa)
        for centre, kappa in zip(centres, (0.1, 1.9, -2.8), strict=True)
    ]
    points = np.column_stack([rng.uniform(0, 25, 12), rng.uniform(-12, 12, 12), rng.uniform(-3, 3, 12)])
    xy = np.vstack([image_coordinates(points, exterior, INTERIOR) for exterior in exteriors])
    k = len(xy)
    used = np.ones(k, dtype=np.bool_)
    used[5] = False
    redundancy = np.full((k, 2), 0.5)
    redundancy[5] = np.nan
    points[11] = np.nan
    interior_covariance = np.zeros((10, 10))
    interior_covariance[:8, :8] = random_covariance(rng, 8)
    result = AdjustmentResult(
        interior=INTERIOR, interior_covariance=interior_covariance, undetermined_interior=("k3",),
        projection_centres_m=centres, R_object_from_image=np.array([e.R_object_from_image for e in exteriors]),
        exterior_covariances=np.array([random_covariance(rng, 6, 0.01) for _ in range(3)]), points_m=points,
        point_covariances_m2=np.array([random_covariance(rng, 3, 0.02) for _ in range(12)]),
        ray_used=used, ray_residuals_px=rng.normal(0, 0.3, (k, 2)), ray_redundancy=redundancy,
        gnss_used=np.array([True, False, True]), gnss_residuals_m=rng.normal(size=(3, 3)),
        gnss_shift_m=np.array([[0.5, -0.2, 1.5]]), gnss_shift_covariance_m2=random_covariance(rng, 3)[None],
        control_used=np.array([True]), control_residuals_m=np.array([[0.001, 0.002, 0.003]]), sigma0=0.97,
        redundancy=80.5, group_sigma0={"rays": 0.96, "gnss": 1.1}, datum=Datum.CONTROL, iterations=5,
    )  # fmt: skip
    kinds = np.array([PointKind.CONTROL, PointKind.CHECK, *[PointKind.PASS] * 6, *[PointKind.TIE] * 4], dtype=np.int8)
    return OrientedBlock(
        block=small_block(frame), images=("s0.jpg", "s2.jpg", "s3.jpg"), unoriented={"s1.jpg": "too few points"},
        adjustment=result,
        rays=Rays(
            image_index=np.repeat(np.arange(3), 12), point_index=np.tile(np.arange(12), 3), xy_px=xy,
            sigma_px=np.full((k, 2), 0.3),
        ),
        point_kinds=kinds, point_origins=np.full(12, PointOrigin.VIDEO, dtype=np.int8),
        point_colours=rng.integers(0, 256, (12, 3), dtype=np.uint8), strips=np.array([0, 0, 1]),
        control=(difference("C1", (0.001, -0.002, 0.003)),),
        check=(difference("K1", (0.03, 0.04, -0.01)), difference("K2", (0.0, 0.05, 0.07))),
        check_covariance_m2=random_covariance(rng, 6), candidates={"video": CandidateCount(found=40, survived=10)},
        video_share=0.8, gsd_m=0.066, seconds={"match": 1.5}, peak_memory_mb=99.5, notes=("another",),
        pictures=CodePictures(
            still="s0.jpg", grey=rng.integers(0, 256, (6, 8), dtype=np.uint8), codes=np.full((6, 8), 16, np.uint8),
            richness=rng.random((6, 8), dtype=np.float32), matches=rng.normal(size=(2, 4)), next_still="s2.jpg",
            next_grey=rng.integers(0, 256, (6, 8), dtype=np.uint8),
        ),
    )  # fmt: skip


def difference(name: str, difference_m: tuple[float, float, float]) -> PointDifference:
    """Return a difference at a point."""
    return PointDifference(name=name, difference_m=difference_m, sigma_m=(0.02, 0.02, 0.05), rays=5, gsd_m=0.066)


def without_check_points(oriented: OrientedBlock) -> OrientedBlock:
    """Return the block as if no check point had been given."""
    return replace(oriented, check=(), check_covariance_m2=np.zeros((0, 0)))
