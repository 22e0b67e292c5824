"""The result as handed on: strips, kinds, differences with their signs and sigmas, counts, pictures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.process import test_network as small
from tests.process.made_blocks import FULL, MadeStills, block_of, stations, still_names
from uavkit.core.adjustment import Datum
from uavkit.core.arrays import Array
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock, PointOrigin
from uavkit.process.candidates import Candidates
from uavkit.process.network import adjust_network, marked_points, network_of
from uavkit.process.options import AdjustmentSection
from uavkit.process.pictures import PictureStore, PyramidStore
from uavkit.process.summary import Findings, strips_of, summarise


def _centres(strips: int, per_strip: int, base_m: float, apart_m: float) -> Array:
    rng = np.random.default_rng(strips + per_strip)
    return np.array([s.projection_centre_m for s in stations(strips, per_strip, rng, base_m=base_m, apart_m=apart_m)])


@pytest.mark.parametrize("strips,per_strip,base,apart", [(3, 11, 7.0, 9.0), (3, 6, 8.0, 4.0), (2, 3, 6.0, 6.0)])
@pytest.mark.parametrize("turn_deg", [0.0, 57.0])
def test_strips_flown_to_and_fro(strips: int, per_strip: int, base: float, apart: float, turn_deg: float) -> None:
    a = np.radians(turn_deg)
    centres = _centres(strips, per_strip, base, apart) @ np.array(
        [[np.cos(a), np.sin(a), 0.0], [-np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]]
    )
    assert strips_of(centres).tolist() == np.repeat(np.arange(strips), per_strip).tolist()


def test_strips_with_stills_in_between_on_the_cross_legs() -> None:
    """East along the first strip, one still half way over, back along the second.

    The leg across may be a strip of its own; its ends then count to either of the strips that meet there.
    """
    first = [[7.0 * n, 0.0, 15.0] for n in range(6)]
    back = [[7.0 * n, 16.0, 15.0] for n in reversed(range(6))]
    found = strips_of(np.array([*first, [38.0, 8.0, 15.0], *back])).tolist()
    assert found[:6] == [0] * 6
    assert len(set(found[8:])) == 1
    assert found[8] > found[5]
    assert set(found[6:8]) <= set(range(found[5], found[8] + 1))


def test_one_strip_and_few_stills() -> None:
    assert strips_of(_centres(1, 9, 7.0, 0.0)).tolist() == [0] * 9
    assert strips_of(_centres(1, 2, 7.0, 0.0)).tolist() == [0, 0]
    assert strips_of(np.zeros((1, 3))).tolist() == [0]
    assert strips_of(np.zeros((0, 3))).tolist() == []


def _stills() -> MadeStills:
    rng = np.random.default_rng(0)
    pictures = {}
    for name in still_names(len(small.PLACES)):
        coarse = rng.integers(20, 230, (30, 40), dtype=np.uint8)
        pictures[name] = np.kron(coarse, np.ones((100, 100), dtype=np.uint8))
    return MadeStills(pictures)


def _summarised(
    missing: tuple[int, ...] = (), candidates: Candidates = small.CANDIDATES, datum: Datum | None = None
) -> tuple[OrientedBlock, Findings]:
    rng = np.random.default_rng(12)
    block = replace(
        block_of(len(small.PLACES), FULL, small.SIGMAS, control=small.CONTROL, check=small.CHECK),
        gnss=small.gnss_of(small.PLACES, rng, 0.05),
    )
    marked = marked_points(block)
    network = network_of(small._growing(missing), candidates, marked)
    adjusted = adjust_network(network, block, marked, AdjustmentSection(), datum)
    found = Findings(
        block=block, reasons={row: "blurred" for row in missing}, candidates=candidates, tied=candidates,
        network=network, marked=marked, adjusted=adjusted,
    )  # fmt: skip
    stills = _stills()
    return summarise(found, stills, PyramidStore(PictureStore(stills, still_names(len(small.PLACES))))), found


@pytest.fixture(scope="module")
def whole() -> tuple[OrientedBlock, Findings]:
    return _summarised()


def test_kinds_of_points(whole: tuple[OrientedBlock, Findings]) -> None:
    result, found = whole
    assert result.strips.tolist() == [0] * 4 + [1] * 4
    marks = found.adjusted.points >= found.network.marks_from
    assert result.point_kinds[marks].tolist() == [PointKind.CONTROL] * 3 + [PointKind.CHECK] * 2
    rays = result.rays
    for row in np.flatnonzero(~marks & np.isfinite(result.adjustment.points_m[:, 0])).tolist():
        images = rays.image_index[(rays.point_index == row) & result.adjustment.ray_used]
        both = bool((images < 4).any() and (images >= 4).any())
        assert result.point_kinds[row] == (PointKind.TIE if both else PointKind.PASS)
    assert {PointKind.TIE, PointKind.PASS} <= set(result.point_kinds.tolist())


def test_differences_are_block_minus_survey(whole: tuple[OrientedBlock, Findings]) -> None:
    result, _ = whole
    for kind, differences, surveyed in (
        (PointKind.CONTROL, result.control, small.CONTROL),
        (PointKind.CHECK, result.check, small.CHECK),
    ):
        assert [d.name for d in differences] == [p.name for p in surveyed]
        points = result.adjustment.points_m[result.point_kinds == kind]
        for difference, point, position in zip(differences, surveyed, points, strict=True):
            np.testing.assert_allclose(difference.difference_m, position - point.position_m, atol=1e-12)
            assert difference.rays == len(point.marks)
            assert np.all(np.abs(difference.difference_m) < 4.5 * np.array(difference.sigma_m) + 1e-4)
    # the differences of control are the adjustment's residuals with the other sign
    np.testing.assert_allclose(
        [d.difference_m for d in result.control], -result.adjustment.control_residuals_m, atol=1e-9
    )


def test_predicted_sigmas_of_differences(whole: tuple[OrientedBlock, Findings]) -> None:
    """Check: block plus survey. Control: survey minus block, for the adjusted point has seen the survey."""
    result, _ = whole
    adjustment = result.adjustment
    covariances = adjustment.point_covariances_m2
    for difference, own in zip(result.check, covariances[result.point_kinds == PointKind.CHECK], strict=True):
        np.testing.assert_allclose(difference.sigma_m, np.sqrt(np.diag(own) + 0.002**2), rtol=1e-6)
    for difference, own in zip(result.control, covariances[result.point_kinds == PointKind.CONTROL], strict=True):
        np.testing.assert_allclose(
            difference.sigma_m, np.sqrt(np.maximum(0.005**2 - np.diag(own), 0.0)), rtol=1e-6, atol=1e-9
        )
    joint = result.check_covariance_m2
    assert joint.shape == (6, 6)
    np.testing.assert_allclose(joint, joint.T, atol=1e-12)
    assert np.all(result.point_kinds[adjustment.joint_points[-2:]] == PointKind.CHECK)
    np.testing.assert_allclose(joint - adjustment.joint_covariance_m2[-6:, -6:], 0.002**2 * np.eye(6), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(joint) > 0)
    np.testing.assert_allclose(np.sqrt(np.diag(joint)).reshape(2, 3), [d.sigma_m for d in result.check])


def test_ground_sampling_distance_is_depth_over_principal_distance(whole: tuple[OrientedBlock, Findings]) -> None:
    result, _ = whole
    assert result.gsd_m == pytest.approx(15.0 / 2684.0, rel=0.1)
    for difference, at in zip(result.check, small.MARKS_AT[3:], strict=True):
        depths = [
            -((at - p.projection_centre_m) @ p.R_object_from_image)[2]
            for name, p in zip(still_names(8), small.PLACES, strict=True)
            if name in {m.image for m in small.CHECK[result.check.index(difference)].marks}
        ]
        assert difference.gsd_m == pytest.approx(np.mean(depths) / 2684.0, rel=0.01)


def test_counts_shares_and_colours(whole: tuple[OrientedBlock, Findings]) -> None:
    result, found = whole
    used = np.isfinite(result.adjustment.points_m[:, 0]) & (found.adjusted.points < found.network.marks_from)
    with_rays = len(np.unique(small.CANDIDATES.ray_point))
    assert result.candidates["features"].found == with_rays
    assert result.candidates["features"].survived == used.sum() <= with_rays
    assert (result.candidates["video"].found, result.candidates["video"].survived) == (0, 0)
    assert result.video_share == 0.0
    origins = np.where(result.point_kinds >= PointKind.CONTROL, PointOrigin.MARK, PointOrigin.FEATURES)
    np.testing.assert_array_equal(result.point_origins, origins)
    stills = _stills()
    for row in range(0, len(result.point_colours), 17):
        first = np.flatnonzero(result.rays.point_index == row)[0]
        column, line = np.rint(result.rays.xy_px[first]).astype(int)
        colour = stills.colour(result.images[result.rays.image_index[first]])[line, column]
        np.testing.assert_array_equal(result.point_colours[row], colour)


def test_video_points_have_their_share() -> None:
    origin = small.CANDIDATES.origin.copy()
    origin[::2] = PointOrigin.VIDEO
    result, _ = _summarised(candidates=replace(small.CANDIDATES, origin=origin))
    passes = (result.point_kinds < PointKind.CONTROL) & np.isfinite(result.adjustment.points_m[:, 0])
    video = result.point_origins == PointOrigin.VIDEO
    assert result.video_share == pytest.approx((video & passes).sum() / passes.sum())
    assert result.candidates["video"].survived == (video & passes).sum()
    assert 0.3 < result.video_share < 0.7


def test_pictures_of_codes_and_matches(whole: tuple[OrientedBlock, Findings]) -> None:
    result, _ = whole
    pictures = result.pictures
    assert pictures is not None
    assert (pictures.still, pictures.next_still) == (still_names(8)[4], still_names(8)[5])
    assert pictures.grey.shape == (750, 1000) == pictures.codes.shape == pictures.richness.shape
    assert pictures.next_grey.shape == (750, 1000)
    rays, used = result.rays, result.adjustment.ray_used
    here, there = (set(rays.point_index[(rays.image_index == i) & used].tolist()) for i in (4, 5))
    assert len(pictures.matches) == len(here & there) > 10
    full = 4.0 * pictures.matches + 1.5  # two halvings: x_full = 4 x + 3/2
    for row in full[::7]:
        at = [
            rays.point_index[(rays.image_index == i) & (np.abs(rays.xy_px - xy).max(axis=1) < 1e-6)]
            for i, xy in ((4, row[:2]), (5, row[2:]))
        ]
        assert at[0].tolist() == at[1].tolist() != []


def test_unoriented_stills_are_named_with_their_reasons() -> None:
    result, _ = _summarised(missing=(1, 6))
    assert result.unoriented == {"S001.JPG": "blurred", "S006.JPG": "blurred"}
    assert result.images == tuple(n for n in still_names(8) if n not in result.unoriented)
    assert len(result.strips) == 6


def test_a_free_network_is_not_compared_with_a_survey() -> None:
    """Its axes and scale are the model's own: differences of coordinates would mean nothing."""
    result, _ = _summarised(datum=Datum.FREE_NETWORK)
    assert (result.control, result.check) == ((), ())
    assert result.check_covariance_m2.shape == (0, 0)
    assert PointKind.CHECK in result.point_kinds
