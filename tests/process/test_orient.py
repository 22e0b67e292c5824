"""The whole chain on small rendered blocks of known truth."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.process.made_blocks import (
    SMALL,
    Ground,
    MadeStills,
    block_of,
    carpet,
    gnss_of,
    stations,
    still_names,
    still_of,
    surveyed,
)
from uavkit.core.adjustment import Datum
from uavkit.core.arrays import Array
from uavkit.core.block import Block
from uavkit.core.camera import InteriorSigmas
from uavkit.core.errors import AdjustmentError, InputError
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock
from uavkit.process.absolute import fit_similarity
from uavkit.process.options import CandidateOptions, CandidateSource, MeasurementOptions, ProcessOptions
from uavkit.process.orient import orient_block

OPTIONS = ProcessOptions(
    candidates=CandidateOptions(feature_width_px=800, features=700), measurement=MeasurementOptions(window_px=21)
)
SIGMAS = InteriorSigmas(principal_distance_px=3.0, x0_px=2.0, y0_px=2.0, k1=0.01)
GROUND = Ground(1.6)
GIVEN = replace(SMALL, principal_distance_px=538.5, x0_px=400.5, k1=0.0)
TRUE = replace(SMALL, k1=-0.01)
CONTROL_M = np.array([[-2.0, -2.0], [12.0, -1.0], [11.0, 8.0], [-1.0, 8.0]])
CHECK_M = np.array([[5.0, 3.0], [2.0, 6.0], [8.0, 1.0], [4.0, -2.0]])


@dataclass(frozen=True)
class Made:
    stills: MadeStills
    block: Block
    places: list[ExteriorOrientation]


def _on_ground(plan: Array) -> Array:
    return np.column_stack([plan, GROUND.height_m(*plan.T)])


@pytest.fixture(scope="module")
def made() -> Made:
    rng = np.random.default_rng(41)
    places = stations(2, 3, rng, base_m=5.0, apart_m=6.0, tilt_rad=0.03)
    cover = carpet(rng, (-14.0, -12.0), (25.0, 19.0), 15.0 / 537.0)
    pictures = {
        name: still_of(place, TRUE, GROUND, cover, rng) for name, place in zip(still_names(6), places, strict=True)
    }
    control = [
        surveyed(f"P{n}", at, places, TRUE, rng, sigma_m=0.005, sigma_px=0.1)
        for n, at in enumerate(_on_ground(CONTROL_M))
    ]
    check = [
        surveyed(f"K{n}", at, places, TRUE, rng, sigma_m=0.002, sigma_px=0.1, check=True)
        for n, at in enumerate(_on_ground(CHECK_M))
    ]
    block = block_of(6, GIVEN, SIGMAS, gnss=gnss_of(places, rng, 0.5), control=tuple(control), check=tuple(check))
    return Made(MadeStills(pictures), block, places)


@pytest.fixture(scope="module")
def oriented(made: Made) -> OrientedBlock:
    return orient_block(made.block, made.stills, None, OPTIONS, workers=1)


def test_a_small_block_is_true(made: Made, oriented: OrientedBlock) -> None:
    result = oriented.adjustment
    assert oriented.images == still_names(6)
    assert oriented.unoriented == {}
    assert result.datum is Datum.CONTROL
    assert result.converged
    assert oriented.strips.tolist() == [0, 0, 0, 1, 1, 1]
    # the rays' sigmas were calibrated on this block: sigma0 1 within what leaving out above 4 sigma and classes do
    assert 0.8 < result.sigma0 < 1.25
    sigma = np.sqrt(np.diagonal(result.exterior_covariances[:, :3, :3], axis1=1, axis2=2))
    error = result.projection_centres_m - np.array([p.projection_centre_m for p in made.places])
    assert sigma.max() < 0.1
    assert np.abs(error / sigma).max() < 4.0
    assert abs(result.interior.principal_distance_px - TRUE.principal_distance_px) < 4 * np.sqrt(
        result.interior_covariance[0, 0]
    )


def test_check_points_lie_within_their_predicted_sigmas(oriented: OrientedBlock) -> None:
    assert len(oriented.check) == 4
    differences = np.array([d.difference_m for d in oriented.check])
    sigmas = np.array([d.sigma_m for d in oriented.check])
    assert np.abs(differences / sigmas).max() < 3.5
    # 0.1 px marks in about 5 stills are 2 mm across, with base 5 to 10 m at 15 m some 4 mm in height
    assert sigmas[:, :2].max() < 0.008
    assert sigmas[:, 2].max() < 0.015


def test_object_points_lie_on_the_ground(oriented: OrientedBlock) -> None:
    result = oriented.adjustment
    good = np.isfinite(result.points_m[:, 0]) & (oriented.point_kinds < PointKind.CONTROL)
    east, north, up = result.points_m[good].T
    sigma = np.sqrt(result.point_covariances_m2[good][:, 2, 2])
    height_error = up - GROUND.height_m(east, north)
    assert good.sum() > 150
    assert 0.5 < 1.4826 * np.median(np.abs(height_error / sigma)) < 2.0
    rays = np.bincount(oriented.rays.point_index[result.ray_used], minlength=len(good))[good]
    # tie point matching finds points in all stills that see them; those at the border of the block are in two only
    assert np.mean(rays >= 3) > 0.5
    assert np.mean(oriented.point_kinds[good] == PointKind.TIE) > 0.5


def test_the_summary_counts_and_tells(oriented: OrientedBlock) -> None:
    assert oriented.candidates["features"].found >= oriented.candidates["features"].survived > 150
    assert oriented.video_share == 0.0
    assert {"features", "least squares matching", "approximate orientation", "tie points", "adjustment"} <= set(
        oriented.seconds
    )
    assert oriented.peak_memory_mb > 50
    assert any("calibrated" in note for note in oriented.notes)


def _same_bits(a: OrientedBlock, b: OrientedBlock) -> None:
    for name in ("points_m", "projection_centres_m", "R_object_from_image", "ray_residuals_px", "point_covariances_m2"):
        np.testing.assert_array_equal(getattr(a.adjustment, name), getattr(b.adjustment, name))
    np.testing.assert_array_equal(a.rays.xy_px, b.rays.xy_px)
    np.testing.assert_array_equal(a.point_colours, b.point_colours)
    assert a.adjustment.sigma0 == b.adjustment.sigma0


def test_two_workers_give_the_same_bits(made: Made, oriented: OrientedBlock) -> None:
    _same_bits(oriented, orient_block(made.block, made.stills, None, OPTIONS, workers=2))


def _first(made: Made, count: int) -> Made:
    """The first stills alone, without positions and control."""
    pictures = {name: made.stills.pictures[name] for name in still_names(count)}
    return Made(MadeStills(pictures), block_of(count, GIVEN, SIGMAS), made.places[:count])


def test_without_positions_and_control_the_network_is_free(made: Made) -> None:
    part = _first(made, 3)
    result = orient_block(part.block, part.stills, None, OPTIONS)
    assert result.adjustment.datum is Datum.FREE_NETWORK
    assert (result.control, result.check) == ((), ())
    truth = np.array([p.projection_centre_m for p in part.places])
    similarity = fit_similarity(result.adjustment.projection_centres_m, truth)
    assert np.abs(similarity.apply(result.adjustment.projection_centres_m) - truth).max() < 0.03


def test_positions_alone_orient_the_block(made: Made) -> None:
    part = _first(made, 4)
    gnss = gnss_of(part.places, np.random.default_rng(3), 0.02)
    result = orient_block(replace(part.block, gnss=gnss), part.stills, None, OPTIONS)
    assert result.adjustment.datum is Datum.GNSS
    truth = np.array([p.projection_centre_m for p in part.places])
    assert np.abs(result.adjustment.projection_centres_m - truth).max() < 0.08


def test_a_still_of_something_else_is_left_out_and_named(made: Made) -> None:
    part = _first(made, 3)
    rng = np.random.default_rng(77)
    other = carpet(rng, (-14.0, -12.0), (25.0, 19.0), 15.0 / 537.0)
    stills = MadeStills({**part.stills.pictures, "S003.JPG": still_of(made.places[3], TRUE, GROUND, other, rng)})
    result = orient_block(block_of(4, GIVEN, SIGMAS), stills, None, OPTIONS)
    assert result.images == still_names(3)
    assert list(result.unoriented) == ["S003.JPG"]
    assert "point" in result.unoriented["S003.JPG"]


def test_stills_that_do_not_overlap_are_refused(made: Made) -> None:
    rng = np.random.default_rng(78)
    covers = [carpet(np.random.default_rng(seed), (-14.0, -12.0), (16.0, 14.0), 15.0 / 537.0) for seed in (1, 2)]
    stills = MadeStills(
        {name: still_of(made.places[0], TRUE, GROUND, c, rng) for name, c in zip(still_names(2), covers, strict=True)}
    )
    with pytest.raises(AdjustmentError, match="no two stills"):
        orient_block(block_of(2, GIVEN, SIGMAS), stills, None, OPTIONS)


def test_what_cannot_be_done_is_refused_at_once(made: Made) -> None:
    one = _first(made, 1)
    with pytest.raises(InputError, match="at least 2 stills, there are 1"):
        orient_block(one.block, one.stills, None, OPTIONS)
    part = _first(made, 2)
    video_only = replace(OPTIONS, candidates=replace(OPTIONS.candidates, source=CandidateSource.VIDEO))
    with pytest.raises(InputError, match="no video"):
        orient_block(part.block, part.stills, None, video_only)
