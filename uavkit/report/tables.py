"""The tables of a report, as texts with their units in the headings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uavkit.core.angles import omega_phi_kappa_from_rotation
from uavkit.core.arrays import Array
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock, PointDifference, PointOrigin
from uavkit.report.measures import (
    Accuracy,
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
)

NOTHING = "–"
COLLAPSE_ABOVE = 40
"""Tables with more rows than this are folded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of texts under a heading; the first column names the row."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False
    """Shown closed, with its title only, until it is opened."""

    def __post_init__(self) -> None:
        if any(len(row) != len(self.header) for row in self.rows):
            raise ValueError(f"table {self.title!r}: a row has not {len(self.header)} cells")


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperComparison:
    """The flight of Anai et al. (2012) that a simulated survey repeats."""

    flight: Literal["constant", "trace"]

    @property
    def described(self) -> str:
        """Return the flight in words."""
        return "constant altitude" if self.flight == "constant" else "topography trace"

    @property
    def values(self) -> tuple[int, float, float]:
        """Return the points found, RMSE XY and RMSE Z in metres as published (section 3)."""
        return (1029, 0.016, 0.022) if self.flight == "constant" else (1489, 0.020, 0.024)


def number(value: float, decimals: int = 1) -> str:
    """Return a number as text, a dash where there is none."""
    if not np.isfinite(value):
        return NOTHING
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and float(text) == 0.0 else text


def thousandths(value_m: float) -> str:
    """Return a length in millimetres (or thousandths of a model unit) with one decimal."""
    return number(1e3 * value_m, 1)


def _signed(value: float, decimals: int) -> str:
    return f"{value:+.{decimals}f}" if np.isfinite(value) else NOTHING


def difference_table(
    title: str, points: Sequence[PointDifference], unit: str, states: Sequence[str] | None = None
) -> Table:
    """Return differences and predicted sigmas by point; ``states`` adds a last column."""
    axes = ("E", "N", "U")
    header = ("Point", *(f"d{a} [{unit}]" for a in axes), *(f"sigma {a} [{unit}]" for a in axes))
    header += (*(f"d{a} / sigma" for a in axes), "Rays")
    rows = [_difference_row(point) for point in points]
    if states is not None:
        header += ("State",)
        rows = [(*row, state) for row, state in zip(rows, states, strict=True)]
    note = "Difference: block minus survey. Sigma: predicted for the difference, block and survey together."
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
    return difference_table("Check points", result.check, length_unit(result).thousandth)


def control_table(result: OrientedBlock) -> Table:
    """Return the control points, which take part in the adjustment, with their state."""
    used = result.adjustment.control_used
    states = [("used" if flag else "rejected") for flag in used] if len(used) == len(result.control) else None
    return difference_table("Ground control points", result.control, length_unit(result).thousandth, states)


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
    unit = length_unit(result).thousandth
    xy, z = point_sigmas_m(result)
    centres, angles = exterior_sigmas(result)
    mdeg = np.degrees(angles) * 1e3
    rows = [
        _range_row(f"Object points XY [{unit}]", 1e3 * xy),
        _range_row(f"Object points Z [{unit}]", 1e3 * z),
        _range_row(f"Projection centres XY [{unit}]", 1e3 * np.hypot(centres[:, 0], centres[:, 1])),
        _range_row(f"Projection centres Z [{unit}]", 1e3 * centres[:, 2]),
        *(_range_row(f"{name} [mdeg]", mdeg[:, axis]) for axis, name in enumerate(("omega", "phi", "kappa"))),
    ]
    return Table(
        title="Predicted precision",
        header=("Sigma of", "Number", "Least", "Median", "95 %", "Largest"),
        rows=tuple(rows),
        note="From the covariances of the adjustment, at the stated sigmas of the observations. 1000 mdeg = 1 degree.",
    )


def point_sigma_medians_m(result: OrientedBlock) -> tuple[float, float]:
    """Return the median predicted sigma of the object points in XY (both axes together) and Z."""
    xy, z = point_sigmas_m(result)
    return (float(np.median(xy)), float(np.median(z))) if len(xy) else (float("nan"), float("nan"))


def _range_row(name: str, values: Array) -> tuple[str, ...]:
    v = values[np.isfinite(values)]
    marks = np.percentile(v, [0.0, 50.0, 95.0, 100.0]) if len(v) else np.full(4, np.nan)
    return (name, str(len(v)), *(number(mark, 1) for mark in marks))


def stills_table(result: OrientedBlock) -> Table:
    """Return the exterior orientation of each still."""
    unit, adjusted = length_unit(result), result.adjustment
    centres, angles = exterior_sigmas(result)
    mdeg, rays = np.degrees(angles) * 1e3, rays_of_images(result)
    header = ("Still", "Strip", *(f"{axis} [{unit.whole}]" for axis in ("East", "North", "Up")))
    header += ("omega [deg]", "phi [deg]", "kappa [deg]", *(f"s{a} [{unit.thousandth}]" for a in ("E", "N", "U")))
    header += ("s omega [mdeg]", "s phi [mdeg]", "s kappa [mdeg]", "Rays")
    rows = []
    for row, name in enumerate(result.images):
        opk = np.degrees(omega_phi_kappa_from_rotation(adjusted.R_object_from_image[row]))
        strip = str(result.strips[row] + 1) if result.strips[row] >= 0 else NOTHING
        place = (number(value, 3) for value in adjusted.projection_centres_m[row])
        sigmas = (*(thousandths(s) for s in centres[row]), *(number(s, 1) for s in mdeg[row]))
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
    return number(value, decimals) if value > 0 else NOTHING


def _parameter_label(name: str) -> str:
    known = {"principal_distance_px": "principal distance c [px]", "x0_px": "x0 [px]", "y0_px": "y0 [px]"}
    return known.get(name, name)


def gnss_shift_table(result: OrientedBlock) -> Table:
    """Return shift and residuals of the GNSS positions of each flight."""
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
    return Table(title="GNSS positions by flight", header=header, rows=tuple(rows), note=note)


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
        share = f"{100.0 * (total - used) / total:.1f} %" if total else NOTHING
        sigma0 = number(adjusted.group_sigma0.get(name, float("nan")), 3)
        rows.append((labels.get(name, name), str(total), str(used), share, sigma0))
    rows.append(("All", NOTHING, NOTHING, NOTHING, number(adjusted.sigma0, 3)))
    return Table(
        title="Observations",
        header=("Group", "Coordinates", "Used", "Rejected", "sigma0"),
        rows=tuple(rows),
        note=f"Redundancy {adjusted.redundancy:.1f}; {adjusted.iterations} iterations.",
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
        mean = float(np.mean(rays[mine])) if np.any(mine) else float("nan")
        origins = [int(np.sum(mine & (result.point_origins == origin))) for origin in PointOrigin]
        rows.append((label, str(int(mine.sum())), *(str(count) for count in origins), number(mean, 1)))
    header = ("Kind", "Points", "Marked by hand", "From the video", "From features", "Mean rays")
    return Table(title="Object points", header=header, rows=tuple(rows))


def candidates_table(result: OrientedBlock) -> Table:
    """Return how many candidates each way of finding points gave and how many are left."""
    labels = {"video": "Followed through the video", "features": "Feature matching"}
    rows = []
    for name, count in result.candidates.items():
        share = f"{100.0 * count.survived / count.found:.0f} %" if count.found else NOTHING
        rows.append((labels.get(name, name), str(count.found), str(count.survived), share))
    share = f"{100.0 * result.video_share:.0f} %" if np.isfinite(result.video_share) else NOTHING
    note = f"Share of the used pass points that came through the video: {share}."
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
        ("Stills", "33", str(len(result.images))),
        ("Ground control points", "3", str(control)),
        ("Check points", "11", str(ours.points)),
        ("Pass and tie points found", str(found), str(points)),
        ("RMSE XY at check points [mm]", number(1e3 * xy, 0), thousandths(ours.rmse_xy_m)),
        ("RMSE Z at check points [mm]", number(1e3 * z, 0), thousandths(ours.rmse_z_m)),
    )
    note = (
        "Published: Anai et al., Automatic exterior orientation procedure for low-cost UAV photogrammetry, ISPRS "
        "Archives XXXIX-B7, 2012. This survey repeats that flight in a simulated world; it is not the same ground."
    )
    header = (f"Flight: {comparison.described}", "Published", "This survey")
    return Table(title="Beside the published result", header=header, rows=rows, note=note)
