"""The tables of a report, as texts with their units in the headings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uavkit.core.adjustment import Datum
from uavkit.core.angles import omega_phi_kappa_from_rotation
from uavkit.core.arrays import Array
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock, PointDifference, PointOrigin
from uavkit.formats.html_page import NOTHING, Table, number
from uavkit.report.measures import (
    Accuracy,
    LengthUnit,
    accuracy,
    determined_points,
    exterior_sigmas,
    gnss_rows,
    gnss_stations,
    interior_prior_sigmas,
    length_unit,
    point_sigmas_m,
    rays_of_images,
    rays_of_points,
    strip_ties,
    without_result,
)
from uavkit.report.relative import relative_precision

PUBLISHED_STILLS = 33
WITHIN_THE_BLOCK = "after the block is fitted to the GNSS positions by shift, rotation and scale"
UNDETERMINED = 0.9
"""An unknown whose sigma stays above this share of the one before is not determined."""
COLLAPSE_ABOVE = 40
"""Tables with more rows than this are folded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperComparison:
    """The flight of Anai et al. (2012) that a simulated survey repeats."""

    flight: Literal["constant", "trace"]
    scale: float = 1.0
    """Size of the simulated pictures beside the published ones, 0 to 1: 0.5 has half as many columns and rows."""
    stills: int = PUBLISHED_STILLS
    """Simulated; the published flight has 33."""

    @property
    def reduced(self) -> str:
        """Return in one sentence how much smaller this survey is; empty at full size."""
        parts = []
        if self.stills != PUBLISHED_STILLS:
            parts.append(f"{self.stills} of {PUBLISHED_STILLS} stills")
        if self.scale != 1.0:
            parts.append(
                f"pictures at {self.scale:g} of their size, so that one pixel covers {1 / self.scale:.3g} times"
            )
        if not parts:
            return ""
        tail = " as much ground in length" if self.scale != 1.0 else ""
        return f"Reduced: {', '.join(parts)}{tail}; its errors are not to be read as those of the whole flight."

    @property
    def described(self) -> str:
        """Return the flight in words."""
        return "constant altitude" if self.flight == "constant" else "topography trace"

    @property
    def values(self) -> tuple[int, float, float]:
        """Return the points found, RMSE XY and RMSE Z in metres as published (section 3)."""
        return (1029, 0.016, 0.022) if self.flight == "constant" else (1489, 0.020, 0.024)


def thousandths(value_m: float) -> str:
    """Return a length in millimetres (or thousandths of a model unit) with one decimal."""
    return number(1e3 * value_m, 1)


def length(value_m: float, unit: LengthUnit) -> str:
    """Return a length with its unit: in thousandths below one whole, with two decimals above it."""
    if not np.isfinite(value_m):
        return NOTHING
    if abs(value_m) >= 1.0:
        return f"{number(value_m, 2)} {unit.whole}"
    return f"{number(1e3 * value_m, 0 if abs(value_m) >= 0.1 else 1)} {unit.thousandth}"


def significant(value: float, digits: int = 2) -> str:
    """Return a positive number with so many significant digits, without an exponent."""
    if not np.isfinite(value) or value <= 0:
        return number(value, 0)
    return number(value, max(digits - 1 - int(np.floor(np.log10(value))), 0))


def _signed(value: float, decimals: int) -> str:
    if not np.isfinite(value):
        return NOTHING
    text = f"{value:+.{decimals}f}"
    return text[1:] if float(text) == 0.0 else text


def difference_table(
    title: str,
    points: Sequence[PointDifference],
    unit: str,
    *,
    note: str,
    missing: Sequence[str] = (),
    states: Sequence[str] | None = None,
) -> Table:
    """Return differences and predicted sigmas by point, then the points without coordinates in the block.

    ``states`` adds a last column.
    """
    axes = ("E", "N", "U")
    header = ("Point", *(f"d{a} [{unit}]" for a in axes), *(f"sigma {a} [{unit}]" for a in axes))
    header += (*(f"d{a} / sigma" for a in axes), "Rays")
    rows = [_difference_row(point) for point in points]
    rows += [(name, *(NOTHING,) * 9, "0") for name in missing]
    if states is not None:
        header += ("State",)
        rows = [(*row, state) for row, state in zip(rows, (*states, *("lost",) * len(missing)), strict=True)]
    return Table(title=title, header=header, rows=tuple(rows), note=note, folded=len(rows) > COLLAPSE_ABOVE)


def _difference_row(point: PointDifference) -> tuple[str, ...]:
    ratios = [
        d / s if np.isfinite(s) and s > 0 else float("nan")
        for d, s in zip(point.difference_m, point.sigma_m, strict=True)
    ]
    return (
        point.name,
        *(_signed(1e3 * d, 1) for d in point.difference_m),
        *(thousandths(s) for s in point.sigma_m),
        *(_signed(ratio, 1) for ratio in ratios),
        str(point.rays),
    )


def check_table(result: OrientedBlock) -> Table:
    """Return the check points."""
    missing = without_result(result.block.check_points, result.check)
    note = "Difference: block minus survey. Sigma: predicted for the difference, block and survey together."
    if missing:
        note += f" Without coordinates in the block, and in no RMSE: {', '.join(missing)}."
    unit = length_unit(result).thousandth
    return difference_table("Check points", result.check, unit, note=note, missing=missing)


def control_table(result: OrientedBlock) -> Table:
    """Return the control points, which take part in the adjustment, with their state."""
    used = result.adjustment.control_used
    states = [("used" if flag else "rejected") for flag in used] if len(used) == len(result.control) else None
    missing = without_result(result.block.control_points, result.control)
    note = (
        "Difference: adjusted minus surveyed. Sigma: predicted for this residual, far below that of the survey where "
        "the point itself decides."
    )
    unit = length_unit(result).thousandth
    return difference_table("Ground control points", result.control, unit, note=note, missing=missing, states=states)


def accuracy_table(result: OrientedBlock) -> Table:
    """Return the RMSE of check and control points."""
    unit = length_unit(result).thousandth
    rows = [_accuracy_row("Check points (held back)", accuracy(result.check))]
    rows.append(_accuracy_row("Control points (used: no measure of accuracy)", accuracy(result.control)))
    return Table(
        title="Root mean square differences",
        header=("Points", "Number", f"XY [{unit}]", f"Z [{unit}]", "XY [GSD]", "Z [GSD]", f"GSD [{unit}]"),
        rows=tuple(rows),
        note="XY: both axes together, the root of the mean of dE² + dN².",
    )


def _accuracy_row(name: str, a: Accuracy) -> tuple[str, ...]:
    measures = (thousandths(a.rmse_xy_m), thousandths(a.rmse_z_m), number(a.rmse_xy_gsd, 2), number(a.rmse_z_gsd, 2))
    return (name, str(a.points), *measures, thousandths(a.gsd_m))


def precision_table(result: OrientedBlock) -> Table:
    """Return the predicted precision of points and stations as median, 95 % and largest value."""
    unit = length_unit(result)
    xy, z = point_sigmas_m(result)
    centres, angles = exterior_sigmas(result)
    lengths = [("Object points XY", xy), ("Object points Z", z)]
    lengths += [
        ("Projection centres XY", np.hypot(centres[:, 0], centres[:, 1])),
        ("Projection centres Z", centres[:, 2]),
    ]
    inner = relative_precision(result)
    note = "From the covariances of the adjustment, at the stated sigmas of the observations."
    if inner is not None:
        lengths += [("Object points XY, within the block", inner.point_xy_m)]
        lengths += [("Object points Z, within the block", inner.point_z_m)]
        lengths += [("Projection centres XY, within the block", inner.centre_xy_m)]
        lengths += [("Projection centres Z, within the block", inner.centre_z_m)]
        note += f" Within the block: {WITHIN_THE_BLOCK}. A dash: lost in rounding beside the common shift."
    elif result.adjustment.datum is Datum.GNSS:
        note += " They hold the common shift of the GNSS positions; the precision within the block is not known."
    names = ("omega", "phi", "kappa")
    rows = [_range_row(name, values, (unit.whole, unit.thousandth)) for name, values in lengths]
    rows += [_range_row(name, np.degrees(angles[:, axis]), ("deg", "mdeg")) for axis, name in enumerate(names)]
    note += " 1000 mdeg = 1 degree."
    header = ("Sigma of", "Number", "Least", "Median", "95 %", "Largest")
    return Table(title="Predicted precision", header=header, rows=tuple(rows), note=note)


def point_sigma_medians_m(result: OrientedBlock) -> tuple[float, float]:
    """Return the median predicted sigma of the object points in XY (both axes together) and Z."""
    xy, z = point_sigmas_m(result)
    return (float(np.median(xy)), float(np.median(z))) if len(xy) else (float("nan"), float("nan"))


def median_length(values_m: Array, unit: LengthUnit) -> str:
    """Return the median of lengths with its unit, "not known" where there is none."""
    return length(float(np.median(values_m)), unit) if len(values_m) else "not known"


def _range_row(name: str, values: Array, units: tuple[str, str]) -> tuple[str, ...]:
    """Return a row in the whole unit where the median reaches one of it, in thousandths of it below."""
    v = values[np.isfinite(values)]
    marks = np.percentile(v, [0.0, 50.0, 95.0, 100.0]) if len(v) else np.full(4, np.nan)
    if marks[1] >= 1.0:
        return (f"{name} [{units[0]}]", str(len(v)), *(number(mark, 3) for mark in marks))
    return (f"{name} [{units[1]}]", str(len(v)), *(number(1e3 * mark, 1) for mark in marks))


def stills_table(result: OrientedBlock) -> Table:
    """Return the exterior orientation of each still."""
    unit, adjusted = length_unit(result), result.adjustment
    centres, angles = exterior_sigmas(result)
    mdeg, rays = np.degrees(angles) * 1e3, rays_of_images(result)
    large = len(centres) > 0 and float(np.median(centres[:, 2])) >= 1.0
    short, factor = (unit.whole, 1.0) if large else (unit.thousandth, 1e3)
    header = ("Still", "Strip", *(f"{axis} [{unit.whole}]" for axis in ("East", "North", "Up")))
    header += ("omega [deg]", "phi [deg]", "kappa [deg]", *(f"s{a} [{short}]" for a in ("E", "N", "U")))
    header += ("s omega [mdeg]", "s phi [mdeg]", "s kappa [mdeg]", "Rays")
    rows = []
    for row, name in enumerate(result.images):
        opk = np.degrees(omega_phi_kappa_from_rotation(adjusted.R_object_from_image[row]))
        strip = str(result.strips[row] + 1) if result.strips[row] >= 0 else NOTHING
        place = (number(value, 3) for value in adjusted.projection_centres_m[row])
        sigmas = (*(number(factor * s, 2 if large else 1) for s in centres[row]), *(number(s, 1) for s in mdeg[row]))
        rows.append((name, strip, *place, *(number(a, 4) for a in opk), *sigmas, str(rays[row])))
    note = "Projection centre in the local east-north-up frame; R = Rx(omega) Ry(phi) Rz(kappa) from image to object."
    return Table(title="Exterior orientation of each still", header=header, rows=tuple(rows), note=note, folded=True)


def unoriented_table(result: OrientedBlock) -> Table:
    """Return the stills that could not be oriented, with the reasons."""
    rows = tuple(sorted(result.unoriented.items()))
    folded = len(rows) > COLLAPSE_ABOVE
    return Table(title="Unoriented stills", header=("Still", "Reason"), rows=rows, folded=folded)


def interior_table(result: OrientedBlock) -> Table:
    """Return the interior orientation: a priori, adjusted, and whether the block determines it."""
    adjusted = result.adjustment
    prior, value = result.block.interior.parameters(), adjusted.interior.parameters()
    prior_sigma = interior_prior_sigmas(result)
    sigma = np.sqrt(np.maximum(np.diag(adjusted.interior_covariance), 0.0))
    rows = []
    for row, name in enumerate(INTERIOR_PARAMETERS):
        decimals = 3 if name.endswith("_px") else 6
        free = sigma[row] > 0
        state = "undetermined" if name in adjusted.undetermined_interior else "determined" if free else "fixed"
        texts = (number(value[row], decimals), number(prior[row], decimals))
        sigmas = (_sigma(prior_sigma[row], decimals), _sigma(sigma[row], decimals))
        rows.append((_parameter_label(name), *texts, *sigmas, state))
    camera, size = result.block.camera, adjusted.interior
    title = f"Interior orientation: {camera.name}, {size.width_px} x {size.height_px} px"
    note = (
        "Undetermined: the sigma after the adjustment is more than 0.9 of the sigma before; the prior value decides. "
        f"Principal distance {size.principal_distance_px * camera.pixel_size_mm * _binning(result):.4f} mm "
        f"at {camera.pixel_size_mm * _binning(result) * 1e3:.3f} µm pixels."
    )
    header = ("Parameter", "Adjusted", "A priori", "Sigma a priori", "Sigma adjusted", "State")
    return Table(title=title, header=header, rows=tuple(rows), note=note)


def _binning(result: OrientedBlock) -> float:
    """Return how many pixels of the camera profile one pixel of the stills is wide."""
    return result.block.camera.interior.width_px / result.adjustment.interior.width_px


def _sigma(value: float, decimals: int) -> str:
    """Return a sigma with so many decimals, or more where it would show fewer than two digits."""
    if not value > 0:
        return NOTHING
    return number(value, decimals) if value >= 9.5 * 10.0**-decimals else significant(value)


def _parameter_label(name: str) -> str:
    known = {"principal_distance_px": "principal distance c [px]", "x0_px": "x0 [px]", "y0_px": "y0 [px]"}
    return known.get(name, name)


def gnss_shift_table(result: OrientedBlock) -> Table:
    """Return shift and residuals of the GNSS positions of each flight, and the latency where it was estimated."""
    adjusted, unit, gnss = result.adjustment, length_unit(result).whole, result.block.gnss
    names, used = gnss_stations(result), adjusted.gnss_used
    flights = _flight_of_fix(result)
    rows = []
    for flight, (shift, covariance) in enumerate(
        zip(adjusted.gnss_shift_m, adjusted.gnss_shift_covariance_m2, strict=True)
    ):
        mine = flights == flight
        kept = adjusted.gnss_residuals_m[mine & used]
        rms = np.sqrt(np.mean(kept**2, axis=0)) if len(kept) else np.full(3, np.nan)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        pairs = (f"{_signed(a, 3)} ± {number(b, 3)}" for a, b in zip(shift, sigma, strict=True))
        rows.append((str(flight + 1), f"{len(kept)} of {int(mine.sum())}", *pairs, *(number(r, 3) for r in rms)))
    header = ("Flight", "Fixes used", *(f"Shift {a} [{unit}]" for a in ("E", "N", "U")))
    header += tuple(f"RMS residual {a} [{unit}]" for a in ("E", "N", "U"))
    note = "" if gnss is None or len(names) else "No position takes part in the adjustment."
    if len(adjusted.gnss_latency_s):
        header += ("Shutter latency [ms]",)
        rows = [(*row, text) for row, text in zip(rows, _latencies(result), strict=True)]
        note += " Shutter latency: exposure after event, stated and found together; --shutter-latency takes it."
    return Table(title="GNSS positions by flight", header=header, rows=tuple(rows), note=note.strip())


def _latencies(result: OrientedBlock) -> list[str]:
    """Return the shutter's latency of each flight, what was stated included; said not to be known where it is not."""
    adjusted, gnss, matches = result.adjustment, result.block.gnss, result.block.exposures
    stated_s = matches.shutter_latency_s if matches is not None else 0.0
    prior_s = gnss.latency_sigma_s if gnss is not None else None
    texts = []
    for found_s, sigma_s in zip(adjusted.gnss_latency_s, adjusted.gnss_latency_sigma_s, strict=True):
        if prior_s is not None and sigma_s > UNDETERMINED * prior_s:
            texts.append("not determined")
        else:
            texts.append(f"{_signed(1e3 * (stated_s - found_s), 1)} ± {number(1e3 * sigma_s, 1)}")
    return texts


def _flight_of_fix(result: OrientedBlock) -> Array:
    rows, gnss = gnss_rows(result), result.block.gnss
    if gnss is None or np.any(rows < 0):
        return np.zeros(len(rows))
    return np.asarray(gnss.flight[rows], dtype=np.float64)


def gnss_rejected_table(result: OrientedBlock) -> Table:
    """Return the rejected GNSS positions with their residuals."""
    adjusted, unit, gnss = result.adjustment, length_unit(result).whole, result.block.gnss
    names, source = gnss_stations(result), gnss_rows(result)
    rows = []
    for row in np.flatnonzero(~adjusted.gnss_used):
        residual = adjusted.gnss_residuals_m[row]
        reason = "does not fit the block"
        if gnss is not None and source[row] >= 0:
            ratio = float(np.max(np.abs(residual) / gnss.sigma_m[source[row]]))
            reason = f"residual of {ratio:.1f} times its stated sigma"
        rows.append((names[row], *(_signed(value, 3) for value in residual), reason))
    header = ("Still", *(f"Residual {a} [{unit}]" for a in ("E", "N", "U")), "Reason")
    folded = len(rows) > COLLAPSE_ABOVE
    return Table(title="Rejected GNSS positions", header=header, rows=tuple(rows), folded=folded)


def groups_table(result: OrientedBlock) -> Table:
    """Return observations, rejections and sigma0 of each group of observations."""
    adjusted = result.adjustment
    free = int(np.sum((np.diag(adjusted.interior_covariance) > 0) & (interior_prior_sigmas(result) > 0)))
    counts = {
        "rays": (2 * len(adjusted.ray_used), 2 * int(adjusted.ray_used.sum())),
        "gnss": (3 * len(adjusted.gnss_used), 3 * int(adjusted.gnss_used.sum())),
        "control": (3 * len(adjusted.control_used), 3 * int(adjusted.control_used.sum())),
        "interior": (free, free),
    }
    labels = {"rays": "Image coordinates", "gnss": "GNSS positions", "control": "Control coordinates"}
    labels["interior"] = "A priori interior orientation"
    names = [*counts, *(name for name in adjusted.group_sigma0 if name not in counts)]
    rows = []
    for name in names:
        total, used = counts.get(name, (0, 0))
        if not total and name not in adjusted.group_sigma0:
            continue
        share = f"{100.0 * (total - used) / total:.1f} %" if total else NOTHING
        sigma0 = number(adjusted.group_sigma0.get(name, float("nan")), 3)
        rows.append((labels.get(name, name), str(total), str(used), share, sigma0))
    rows.append(("All", NOTHING, NOTHING, NOTHING, number(adjusted.sigma0, 3)))
    return Table(
        title="Observations",
        header=("Group", "Coordinates", "Used", "Rejected", "sigma0"),
        rows=tuple(rows),
        note=f"Redundancy {adjusted.redundancy:.0f}; {adjusted.iterations} iterations.",
    )


def points_table(result: OrientedBlock) -> Table:
    """Return the determined object points by kind."""
    good, rays = determined_points(result), rays_of_points(result)
    labels = {
        PointKind.PASS: "Pass points (along a strip)",
        PointKind.TIE: "Tie points (between strips)",
        PointKind.CONTROL: "Control points",
        PointKind.CHECK: "Check points",
    }
    rows = []
    for kind, label in labels.items():
        mine = good & (result.point_kinds == kind)
        if kind in (PointKind.CONTROL, PointKind.CHECK) and not np.any(mine):
            continue
        mean = float(np.mean(rays[mine])) if np.any(mine) else float("nan")
        origins = [int(np.sum(mine & (result.point_origins == origin))) for origin in PointOrigin]
        rows.append((label, str(int(mine.sum())), *(str(count) for count in origins), number(mean, 1)))
    header = ("Kind", "Points", "Marked by hand", "From the video", "From features", "Filled in", "Mean rays")
    return Table(title="Object points", header=header, rows=tuple(rows))


def candidates_table(result: OrientedBlock) -> Table:
    """Return how many candidates each way of finding points gave and how many are left."""
    labels = {"video": "Followed through the video", "features": "Feature matching", "filling": "Filled in"}
    rows = []
    for name, count in result.candidates.items():
        if not count.found:
            continue
        share = f"{100.0 * count.survived / count.found:.0f} %" if count.found else NOTHING
        rows.append((labels.get(name, name), str(count.found), str(count.survived), share))
    share = f"{100.0 * result.video_share:.0f} %" if np.isfinite(result.video_share) else NOTHING
    video = result.candidates.get("video")
    note = f"Share of the used pass points that came through the video: {share}." if video and video.found else ""
    header = ("Candidates", "Found", "In the adjusted block", "Share")
    return Table(title="Candidate points by origin", header=header, rows=tuple(rows), note=note)


def strips_table(result: OrientedBlock) -> Table:
    """Return how many points each pair of strips shares."""
    numbers, ties = strip_ties(result)
    header = ("Strip", *(str(number + 1) for number in numbers))
    rows = tuple(
        (str(number + 1), *(str(count) for count in row)) for number, row in zip(numbers, ties.tolist(), strict=True)
    )
    note = "Points that two strips see in common; on the diagonal the points of the strip itself."
    return Table(title="Points shared between strips", header=header, rows=rows, note=note, folded=len(rows) > 12)


def seconds_table(result: OrientedBlock) -> Table:
    """Return the computing time of each step and the largest memory used."""
    rows = [(step, number(seconds, 1)) for step, seconds in result.seconds.items()]
    rows.append(("Total", number(float(sum(result.seconds.values())), 1)))
    memory = f"Largest memory: {result.peak_memory_mb:.0f} MB." if result.peak_memory_mb > 0 else ""
    return Table(title="Computing time", header=("Step", "Seconds"), rows=tuple(rows), note=memory)


def comparison_table(result: OrientedBlock, comparison: PaperComparison) -> Table:
    """Return the published result of the flight beside ours."""
    found, xy, z = comparison.values
    ours = accuracy(result.check)
    natural = (result.point_kinds == PointKind.PASS) | (result.point_kinds == PointKind.TIE)
    points = int(np.sum(natural & determined_points(result)))
    control = int(np.sum(result.adjustment.control_used))
    rows = (
        ("Stills", str(PUBLISHED_STILLS), str(len(result.images))),
        ("Ground control points", "3", str(control)),
        ("Check points", "11", str(ours.points)),
        ("Pass and tie points found", str(found), str(points)),
        ("RMSE XY at check points [mm]", number(1e3 * xy, 0), thousandths(ours.rmse_xy_m)),
        ("RMSE Z at check points [mm]", number(1e3 * z, 0), thousandths(ours.rmse_z_m)),
        (
            "RMSE XY / Z [GSD of the check points]",
            NOTHING,
            f"{number(ours.rmse_xy_gsd, 2)} / {number(ours.rmse_z_gsd, 2)}",
        ),
    )
    note = (
        "Published: Anai et al., Automatic exterior orientation procedure for low-cost UAV photogrammetry, ISPRS "
        "Archives XXXIX-B7, 2012. This survey repeats that flight in a simulated world; it is not the same ground."
    )
    note = f"{comparison.reduced} {note}".strip()
    header = (f"Flight: {comparison.described}", "Published", "This survey")
    return Table(title="Beside the published result", header=header, rows=rows, note=note)
