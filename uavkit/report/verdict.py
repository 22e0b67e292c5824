"""What limits a result and what to watch, in plain sentences."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from uavkit.core.adjustment import Datum
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.result import OrientedBlock
from uavkit.report.coverage import ground_surface, heights_above_ground_m
from uavkit.report.measures import (
    accuracy,
    check_point_doming,
    chi_square_bounds,
    determined_points,
    interior_correlation,
    interior_prior_sigmas,
    length_unit,
    predicted_bow_sigma_m,
    prediction_test,
    rays_of_points,
    strip_ties,
    view_tilts_deg,
    without_result,
)

PRACTICAL_TOLERANCE = 0.05
"""A sigma0 within 5 % of 1 agrees for all practical purposes, however significant the difference may be."""
FEW_TIES = 10
WEAK_BOW_GSD = 2.0
"""Predicted sigma of a bow from which the heights count as badly determined: points are good to about half a pixel."""
WEAK_PLACE_GSD = 5.0
"""Predicted sigma from which a block that hangs on control points counts as badly determined."""
FAR_FROM_PRIOR = 4.0
"""Sigmas between a parameter of the interior orientation and its a priori value."""


class Weight(Enum):
    """How much a remark matters."""

    LIMIT = "limits the result"
    WATCH = "to watch"
    GOOD = "in order"
    NOTE = "note"


@dataclass(frozen=True, slots=True, kw_only=True)
class Remark:
    """One sentence or two about the result."""

    weight: Weight
    text: str


def limit(text: str) -> Remark:
    """Return a remark on something that limits the result."""
    return Remark(weight=Weight.LIMIT, text=text)


def watch(text: str) -> Remark:
    """Return a remark on something to watch."""
    return Remark(weight=Weight.WATCH, text=text)


def good(text: str) -> Remark:
    """Return a remark on something that is in order."""
    return Remark(weight=Weight.GOOD, text=text)


def sigma0_sentence(sigma0: float, redundancy: float) -> Remark:
    """Judge sigma0 against 1 by the chi-square test at 95 % and by a practical tolerance."""
    if not (np.isfinite(sigma0) and redundancy >= 1):
        return limit("There are no redundant observations: nothing tests the stated precision of the observations.")
    bounds = np.sqrt(np.array(chi_square_bounds(redundancy)) / redundancy)
    low, high = min(bounds[0], 1 - PRACTICAL_TOLERANCE), max(bounds[1], 1 + PRACTICAL_TOLERANCE)
    if low <= sigma0 <= high:
        return good(f"sigma0 = {sigma0:.2f} agrees with the sigmas stated for the observations.")
    if sigma0 > high:
        return watch(
            f"sigma0 = {sigma0:.2f}: the residuals are {sigma0:.2f} times as large as the stated sigmas of the "
            f"observations suggest. All predicted sigmas below are too small by about this factor."
        )
    return watch(
        f"sigma0 = {sigma0:.2f}: the residuals are smaller than the stated sigmas of the observations suggest. "
        f"The observations are better than stated; the predicted sigmas below are cautious."
    )


def remarks(result: OrientedBlock) -> list[Remark]:
    """Return all remarks, the gravest first."""
    judges: tuple[Callable[[OrientedBlock], Iterator[Remark]], ...] = (
        _stills,
        _convergence,
        _datum,
        _place,
        _check_points,
        _interior,
        _doming,
        _gnss,
        _network,
        _notes,
    )
    found = [remark for judge in judges for remark in judge(result)]
    sigma0 = sigma0_sentence(result.adjustment.sigma0, result.adjustment.redundancy)
    if sigma0.weight is not Weight.GOOD:  # the headline says it in any case
        found.insert(0, sigma0)
    if not result.adjustment.converged:  # what is provisional is not in order, whatever the figures say
        found = [remark for remark in found if remark.weight is not Weight.GOOD]
    order = list(Weight)
    return sorted(found, key=lambda remark: order.index(remark.weight))


def _stills(result: OrientedBlock) -> Iterator[Remark]:
    lost, total = len(result.unoriented), len(result.unoriented) + len(result.images)
    if lost:
        yield limit(f"{lost} of {total} stills could not be oriented; reasons in the table of unoriented stills.")
    else:
        yield good(f"All {total} stills are oriented.")


def provisional_sentence(iterations: int) -> Remark:
    """Say what an adjustment that did not converge is worth."""
    return limit(
        f"The adjustment did not converge in {iterations} iterations: its results are provisional, do not use these "
        f"numbers."
    )


def _convergence(result: OrientedBlock) -> Iterator[Remark]:
    if not result.adjustment.converged:
        yield provisional_sentence(result.adjustment.iterations)
    lost = int(np.sum(~determined_points(result)))
    if lost:
        yield watch(f"{lost} object points lost too many rays and have no coordinates; they are left out everywhere.")


def _datum(result: OrientedBlock) -> Iterator[Remark]:
    if result.adjustment.datum is Datum.FREE_NETWORK:
        yield limit(
            "Free network: nothing fixes position, rotation and scale. Lengths are in model units, not metres, and "
            "precision is that of the shape alone."
        )
    used = int(np.sum(result.adjustment.control_used))
    if result.adjustment.datum is Datum.GNSS:
        yield limit(_gnss_datum_sentence(result, used))
    elif used and used < 3:
        yield limit(f"Only {used} ground control point(s): rotation and scale rest on the GNSS positions.")
    elif used == 3:
        yield watch("Three ground control points fix the datum with no spare: an error in one is hard to see.")
    rejected = len(result.adjustment.control_used) - used
    if rejected:
        yield limit(f"{rejected} ground control point(s) were rejected: compare their coordinates and marks.")


def _gnss_datum_sentence(result: OrientedBlock, control_points: int) -> str:
    gnss, unit = result.block.gnss, length_unit(result)
    stated = gnss.shift_sigma_m if gnss is not None else None
    sigma = "its default sigma" if stated is None else " / ".join(f"{value:g}" for value in stated) + f" {unit.whole}"
    if control_points:
        return f"The datum rests on GNSS with {control_points} control point(s) beside it; shift a priori 0 ± {sigma}."
    return (
        f"No ground control point: the absolute position rests on GNSS alone, whose common shift is taken as zero with "
        f"{sigma} (east / north / up). A shift within that sigma cannot be seen in this block."
    )


def _place(result: OrientedBlock) -> Iterator[Remark]:
    """Tell where control leaves the place of a block open, however well its shape is known."""
    good = determined_points(result)
    covariances = result.adjustment.point_covariances_m2
    if result.adjustment.datum is not Datum.CONTROL or not good.any() or len(covariances) != len(good):
        return
    variances = np.diagonal(covariances[good], axis1=1, axis2=2)
    squares = np.column_stack([variances[:, :2].sum(axis=1), variances[:, 2]])
    sigmas, unit = np.sqrt(np.nanpercentile(squares, 90.0, axis=0)), length_unit(result)
    if sigmas.max() > WEAK_PLACE_GSD * result.gsd_m:
        yield limit(
            f"The block is badly determined: one in ten of its points has a predicted sigma above "
            f"{1e3 * sigmas[0]:.0f} {unit.thousandth} in position or {1e3 * sigmas[1]:.0f} {unit.thousandth} in height "
            f"({sigmas.max() / result.gsd_m:.0f} GSD). Control points few or in a line let it turn about them; others "
            f"away from that line would fix it."
        )


def _check_points(result: OrientedBlock) -> Iterator[Remark]:
    lost = without_result(result.block.check_points, result.check)
    if lost and result.check:
        yield watch(
            f"{len(lost)} of {len(result.block.check_points)} check points ({_few(lost)}) have no coordinates in the "
            f"block: too few marks in oriented stills, or their marks were rejected. They are in no RMSE; look at them."
        )
    measured = accuracy(result.check)
    if not measured.points:
        yield limit("No check points: accuracy is predicted, not checked.")
        return
    if measured.points < 5:
        yield watch(f"Only {measured.points} check point(s): the RMSE is a rough indication.")
    if measured.left_out:
        yield watch(f"{measured.left_out} check point(s) were not determined and are left out of the RMSE.")
    test = prediction_test(result.check, result.check_covariance_m2)
    if not test.coordinates:
        return
    share = f"{test.factor:.2f} times the predicted sigmas (95 % range {test.low:.2f} to {test.high:.2f})"
    if test.factor > test.high:
        yield limit(f"The differences at the check points are {share}: the predicted precision is too optimistic.")
    elif test.factor < test.low:
        yield watch(f"The differences at the check points are {share}: the predicted precision is too cautious.")
    else:
        yield good(f"The differences at the check points are {share}: the predicted precision holds.")


def _few(names: tuple[str, ...], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _interior(result: OrientedBlock) -> Iterator[Remark]:
    lacking = result.adjustment.undetermined_interior
    if lacking:
        yield watch(
            f"The block does not determine {', '.join(lacking)} of the interior orientation: the prior value decides."
        )
    yield from _far_from_prior(result)
    names, correlation = interior_correlation(result)
    # k1, k2 and k3 describe one curve together: their mutual correlation is natural and harmless.
    radial = {"k1", "k2", "k3"}
    pairs = [
        f"{a} / {b} ({correlation[i, j]:+.2f})"
        for i, a in enumerate(names)
        for j, b in enumerate(names[:i])
        if abs(correlation[i, j]) > 0.95 and not {a, b} <= radial
    ]
    if pairs:
        yield watch(f"Strongly correlated interior parameters: {', '.join(pairs)}. Do not use them singly elsewhere.")


def _far_from_prior(result: OrientedBlock) -> Iterator[Remark]:
    prior, sigma = result.block.interior.parameters(), interior_prior_sigmas(result)
    change = result.adjustment.interior.parameters() - prior
    far = [
        f"{name} by {change[row] / sigma[row]:+.1f}"
        for row, name in enumerate(INTERIOR_PARAMETERS)
        if sigma[row] > 0 and abs(change[row]) > FAR_FROM_PRIOR * sigma[row]
    ]
    if far:
        yield watch(
            f"The adjusted interior orientation is far from the camera profile, in sigmas of the profile: "
            f"{', '.join(far)}. The profile does not describe these stills (other camera, crop or zoom), or the block "
            f"does not tell the interior orientation from the heights."
        )


def _doming(result: OrientedBlock) -> Iterator[Remark]:
    if not result.images:
        return
    test, unit = check_point_doming(result), length_unit(result)
    if np.isfinite(test.bow_m):
        text = (
            f"Bow of the heights from the centre of the block to its edge at {test.points} check points: "
            f"{1e3 * test.bow_m:+.1f} ± {1e3 * test.sigma_m:.1f} {unit.thousandth}"
        )
        if abs(test.bow_m) > 3.0 * test.sigma_m:
            yield limit(f"{text}: the block is domed.")
        elif test.sigma_m > WEAK_PLACE_GSD * result.gsd_m:
            yield watch(f"{text}: the check points cannot tell whether the block is domed.")
        else:
            yield good(f"{text}: no doming found.")
    yield from _curvature(result)


def _curvature(result: OrientedBlock) -> Iterator[Remark]:
    """Tell how well the observations determine the curvature of the block."""
    sigma, unit = predicted_bow_sigma_m(result), length_unit(result)
    size = f"{1e3 * sigma:.1f} {unit.thousandth} ({sigma / result.gsd_m:.1f} GSD)"
    remedy = "Control in the middle and at the edges, some oblique stills or a second height would fix it."
    if _invites_doming(result):
        weight = watch if np.any(result.adjustment.control_used) else limit
        model = f"only as far as the lens follows its model does the predicted sigma of such a bow, {size}, hold"
        yield weight(
            "The heights are badly determined: all stills look straight down from one height over flat ground, and "
            f"such a block invites doming{f'; {model}' if np.isfinite(sigma) else ''}. {remedy}"
        )
    elif sigma > WEAK_BOW_GSD * result.gsd_m:
        yield limit(
            f"The heights are badly determined: a bow from the centre of the block to its edge has a predicted sigma "
            f"of {size}, and no residual would show it. {remedy}"
        )
    elif np.isfinite(sigma):
        yield good(f"A bow of the block from its centre to its edge has a predicted sigma of {size}.")


def _invites_doming(result: OrientedBlock) -> bool:
    height = heights_above_ground_m(result, ground_surface(result, cells=40))
    points = result.adjustment.points_m[determined_points(result)]
    middle = float(np.median(height))
    if not len(points) or not middle > 0:
        return False
    relief = float(np.ptp(np.percentile(points[:, 2], [5.0, 95.0])))
    level = float(np.ptp(np.percentile(result.adjustment.projection_centres_m[:, 2], [5.0, 95.0])))
    nadir = float(np.percentile(view_tilts_deg(result), 95.0)) < 10.0
    return nadir and relief < 0.1 * middle and level < 0.1 * middle


def _gnss(result: OrientedBlock) -> Iterator[Remark]:
    used = result.adjustment.gnss_used
    if len(used) and not np.all(used):
        lost = int(np.sum(~used))
        text = f"Rejected GNSS positions: {lost} of {len(used)}; they are listed with their residuals."
        yield limit(text) if lost > 0.3 * len(used) else watch(text)
    if not len(used) and result.adjustment.datum is not Datum.FREE_NETWORK:
        yield watch("No GNSS position takes part: the datum rests on the control points alone.")


def _network(result: OrientedBlock) -> Iterator[Remark]:
    counts = rays_of_points(result)[determined_points(result)]
    share = float(np.mean(counts == 2)) if len(counts) else 0.0
    if share > 0.5:
        yield watch(
            f"{100 * share:.0f} % of the points have two rays only: an error along the epipolar line would not show."
        )
    numbers, ties = strip_ties(result)
    if len(numbers) > 1:
        others = ties - np.diag(np.diag(ties))
        weak = [int(number) + 1 for number, row in zip(numbers, others, strict=True) if row.max() < FEW_TIES]
        if weak:
            named = ", ".join(str(number) for number in weak[:20])
            yield limit(f"Strip(s) {named} share fewer than {FEW_TIES} points with any other strip.")


def _notes(result: OrientedBlock) -> Iterator[Remark]:
    for text in (*result.block.notes, *result.notes):
        sentence = text[:1].upper() + text[1:]
        yield Remark(weight=Weight.NOTE, text=sentence if sentence.endswith((".", "!", "?")) else f"{sentence}.")
