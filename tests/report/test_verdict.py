"""What the report says of a result, for results whose weakness is known."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from uavkit.core.adjustment import Datum
from uavkit.core.result import OrientedBlock
from uavkit.report.measures import sigmas_m
from uavkit.report.verdict import Weight, remarks, sigma0_sentence

MakeResult = Callable[..., OrientedBlock]


def said(result: OrientedBlock, weight: Weight | None = None) -> str:
    return " | ".join(remark.text for remark in remarks(result) if weight in (None, remark.weight))


def adjusted(result: OrientedBlock, **changes: Any) -> OrientedBlock:
    return replace(result, adjustment=replace(result.adjustment, **changes))


@pytest.mark.parametrize(
    ("sigma0", "redundancy", "weight", "words"),
    [
        (1.00, 50_000.0, Weight.GOOD, "agrees"),
        (1.04, 50_000.0, Weight.GOOD, "agrees"),  # significant, but of no practical weight
        (1.30, 50_000.0, Weight.WATCH, "1.30 times as large"),
        (0.70, 50_000.0, Weight.WATCH, "better than stated"),
        (1.30, 8.0, Weight.GOOD, "agrees"),  # 8 degrees: 95 % lie between 0.52 and 1.48
        (1.60, 8.0, Weight.WATCH, "1.60 times as large"),
        (1.00, 0.0, Weight.LIMIT, "no redundant observations"),
        (float("nan"), 10.0, Weight.LIMIT, "no redundant observations"),
    ],
)
def test_sigma0_is_judged_with_its_redundancy(sigma0: float, redundancy: float, weight: Weight, words: str) -> None:
    remark = sigma0_sentence(sigma0, redundancy)
    assert remark.weight is weight
    assert words in remark.text


def test_the_gravest_comes_first(result: OrientedBlock) -> None:
    order = [list(Weight).index(remark.weight) for remark in remarks(result)]
    assert order == sorted(order)
    assert "1 of 9 stills could not be oriented" in said(result, Weight.LIMIT)


def test_no_control_states_the_shift(result: OrientedBlock) -> None:
    gnss = replace(result.block.gnss, shift_sigma_m=(0.5, 0.5, 1.0)) if result.block.gnss else None
    bare = replace(result, control=(), block=replace(result.block, gnss=gnss, control_points=()))
    bare = adjusted(bare, datum=Datum.GNSS, control_used=np.zeros(0, dtype=bool))
    assert "taken as zero with 0.5 / 0.5 / 1 m" in said(bare, Weight.LIMIT)
    assert "taken as zero" not in said(result)


def test_few_and_rejected_control_points(result: OrientedBlock) -> None:
    assert "Three ground control points" in said(result, Weight.WATCH)
    few = adjusted(result, control_used=np.array([True, True, False]))
    assert "Only 2 ground control point(s)" in said(few, Weight.LIMIT)
    assert "1 ground control point(s) were rejected" in said(few, Weight.LIMIT)


def test_optimistic_and_cautious_predictions(result: OrientedBlock) -> None:
    assert "the predicted precision holds" in said(result, Weight.GOOD)
    optimistic = replace(result, check_covariance_m2=result.check_covariance_m2 / 9.0)
    assert "too optimistic" in said(optimistic, Weight.LIMIT)
    cautious = replace(result, check_covariance_m2=result.check_covariance_m2 * 9.0)
    assert "too cautious" in said(cautious, Weight.WATCH)


def test_a_domed_block_is_called_domed(result: OrientedBlock) -> None:
    places = {point.name: np.array(point.position_m) for point in result.block.check_points}
    centre = np.median(result.adjustment.points_m[:, :2], axis=0)
    sigma = sigmas_m(result.check)[:, 2]
    bent = tuple(
        replace(
            point, difference_m=(0.0, 0.0, 10.0 * s * float(np.sum((places[point.name][:2] - centre) ** 2)) / 900.0)
        )
        for point, s in zip(result.check, sigma, strict=True)
    )
    assert "the block is domed" in said(replace(result, check=bent), Weight.LIMIT)
    assert "no doming found" in said(result, Weight.GOOD)


def test_nadir_stills_over_flat_ground_invite_doming(result: OrientedBlock) -> None:
    words = "invites doming"
    assert words not in said(result)  # 10 m of relief under 12 to 22 m
    points = result.adjustment.points_m * [1.0, 1.0, 0.01]
    flat = adjusted(result, points_m=points)
    assert words in said(flat, Weight.WATCH)
    uncontrolled = adjusted(flat, control_used=np.zeros_like(flat.adjustment.control_used))
    assert "badly determined" in said(uncontrolled, Weight.LIMIT)
    two_heights = result.adjustment.projection_centres_m + np.array([0.0, 0.0, 6.0]) * (np.arange(8) % 2)[:, None]
    assert words not in said(adjusted(flat, projection_centres_m=two_heights))


def test_a_bow_that_the_observations_leave_open_is_told(result: OrientedBlock) -> None:
    """The joint covariance of a bow of known sigma: that sigma is said, in ground pixels, as a limit from two on."""
    rows = np.arange(0, len(result.adjustment.points_m), 30)
    points = result.adjustment.points_m[rows]
    axes = np.linalg.svd(result.adjustment.R_object_from_image[:, :, 2].mean(axis=0)[None])[2]
    place = points @ axes[1:].T
    place -= np.median(place, axis=0)
    edge = np.percentile(np.linalg.norm(place, axis=1), 95.0)
    shape = (np.sum((place / edge) ** 2, axis=1)[:, None] * axes[0]).ravel()
    for pixels, weight, words in ((4.0, Weight.LIMIT, "badly determined"), (0.5, Weight.GOOD, "centre to its edge")):
        sigma_m = pixels * result.gsd_m
        bent = adjusted(result, joint_points=rows, joint_covariance_m2=sigma_m**2 * np.outer(shape, shape))
        assert words in said(bent, weight)
        assert f"({pixels:.1f} GSD)" in said(bent, weight)


def test_strips_that_hang_by_few_points(make_result: MakeResult) -> None:
    result = make_result(strips=3, images_per_strip=6, points=900)
    words = "share fewer than 10 points"
    assert words not in said(result)
    strip, point = result.strips[result.rays.image_index], result.rays.point_index
    common = set(point[strip == 2]) & set(point[strip < 2])
    lost = np.isin(point, sorted(common)[5:]) & (strip == 2)
    cut = adjusted(result, ray_used=result.adjustment.ray_used & ~lost)
    assert f"Strip(s) 3 {words}" in said(cut, Weight.LIMIT)


def test_an_adjustment_that_did_not_converge(result: OrientedBlock) -> None:
    provisional = adjusted(result, converged=False)
    assert "did not converge in 7 iterations: its results are provisional" in said(provisional, Weight.LIMIT)
    assert said(result, Weight.GOOD)
    assert not said(provisional, Weight.GOOD)


def test_a_block_that_may_turn_about_its_control_is_badly_determined(result: OrientedBlock) -> None:
    """A tilt of known sigma about a line is added to all points: known in shape, not in place."""
    words = "The block is badly determined"
    assert words not in said(result)
    east = result.adjustment.points_m[:, 0]
    off = np.abs(east - np.nanmedian(east))
    for pixels, expected in ((1.0, False), (20.0, True)):
        heights = (pixels * result.gsd_m * off / np.nanpercentile(off, 90.0)) ** 2
        more = result.adjustment.point_covariances_m2 + heights[:, None, None] * np.diag([0.0, 0.0, 1.0])
        tilted = adjusted(result, point_covariances_m2=more)
        assert (words in said(tilted, Weight.LIMIT)) == expected
        assert ("20 GSD" in said(tilted, Weight.LIMIT)) == expected
    assert words not in said(adjusted(tilted, datum=Datum.GNSS))  # there the datum's own sentence says it


def test_check_points_too_uncertain_to_show_a_bow_say_so(result: OrientedBlock) -> None:
    vague = replace(result, check_covariance_m2=result.check_covariance_m2 * 1e6)
    vague = replace(vague, check=tuple(replace(p, sigma_m=tuple(1e3 * s for s in p.sigma_m)) for p in vague.check))
    assert "cannot tell whether the block is domed" in said(vague, Weight.WATCH)
    assert "no doming found" not in said(vague)


def test_strong_correlation_is_named_but_not_that_of_k1_to_k3(result: OrientedBlock) -> None:
    covariance = result.adjustment.interior_covariance.copy()
    sigma = np.sqrt(np.diag(covariance))
    covariance[3, 4] = covariance[4, 3] = -0.98 * sigma[3] * sigma[4]
    assert "Strongly correlated" not in said(adjusted(result, interior_covariance=covariance))
    covariance[0, 2] = covariance[2, 0] = 0.97 * sigma[0] * sigma[2]
    text = said(adjusted(result, interior_covariance=covariance), Weight.WATCH)
    assert "y0_px / principal_distance_px (+0.97)" in text


def test_many_rejected_positions_limit_the_result(result: OrientedBlock) -> None:
    assert "Rejected GNSS positions: 1 of 8" in said(result, Weight.WATCH)
    many = adjusted(result, gnss_used=np.arange(8) < 4)
    assert "Rejected GNSS positions: 4 of 8" in said(many, Weight.LIMIT)


def test_a_profile_that_does_not_fit_is_named(result: OrientedBlock) -> None:
    assert "far from the camera profile" not in said(result)
    interior = replace(result.adjustment.interior, principal_distance_px=2684.0 + 10.5 * 30.0)
    assert "principal_distance_px by +10.5" in said(adjusted(result, interior=interior), Weight.WATCH)


def test_lost_check_points_are_named(result: OrientedBlock) -> None:
    assert "no coordinates in the block" not in said(result)
    assert "1 of 11 check points (C11)" in said(replace(result, check=result.check[:-1]), Weight.WATCH)
