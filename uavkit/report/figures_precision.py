"""The figures of residuals, precision, interior orientation and GNSS."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.result import OrientedBlock, PointDifference
from uavkit.formats.drawing import (
    AXIS_COLOURS,
    AXIS_NAMES,
    BLUE,
    GREY,
    INK,
    PALE,
    RED,
    WIDTH_IN,
    Drawing,
    new_figure,
    plain_axes,
    reach,
    round_number,
    shortened,
)
from uavkit.report.measures import (
    block_centre_and_radius_m,
    check_point_doming,
    differences_m,
    gnss_rows,
    gnss_stations,
    image_radius_px,
    interior_correlation,
    length_unit,
    radial_profile,
    sigmas_m,
    surveyed_distances_m,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST_ARROW_PX = 0.0005
"""Residuals below this are not enlarged to fill the figure."""
LEAST_RAYS = 3
"""In a cell of the image, for its mean residual to be drawn."""


def residual_vectors(result: OrientedBlock) -> Drawing:
    """Draw the mean residual of all stills in cells of the image."""
    name, title = "image_residuals", "Mean residuals in the image"
    interior, used = result.adjustment.interior, result.adjustment.ray_used
    # As fine as leaves some 25 rays to a cell.
    cells = int(np.clip(np.sqrt(np.sum(used) / 25.0 * interior.width_px / interior.height_px), 4, 16))
    middle, mean, noise = _pooled(result, cells)
    if not len(middle):
        return Drawing(name=name, title=title, caption="", absent="No rays to show residuals of.")
    figure = new_figure(WIDTH_IN * 0.88 * interior.height_px / interior.width_px + 0.6)
    axes = figure.add_subplot()
    cell = interior.width_px / cells
    arrow_px = reach(np.hypot(*mean.T), 0.95, least=LEAST_ARROW_PX)
    scale = arrow_px / min(0.85 * cell, interior.width_px / 14)
    colours = np.where(np.hypot(*mean.T) > 3.5 * noise, RED, BLUE)
    arrows = axes.quiver(
        *middle.T, *mean.T, angles="xy", scale_units="xy", scale=scale, color=colours, width=0.003, clip_on=False
    )
    arrows.set_in_layout(False)  # arrows that leave the image must not push the labels out of the figure
    axes.plot(interior.x0_px, interior.y0_px, "+", color=INK, ms=9)
    key = round_number(arrow_px)
    axes.set_title(" ")  # keeps room for the key
    axes.quiverkey(arrows, 0.86, 1.022, key, f"{key:g} px", labelpos="E", coordinates="axes", color=INK)
    axes.set(xlim=(-0.5, interior.width_px - 0.5), ylim=(interior.height_px - 0.5, -0.5), aspect="equal")
    plain_axes(axes, "Column [px]", "Row [px]")
    residuals = result.adjustment.ray_residuals_px[used]
    rms = np.sqrt(np.nanmean(residuals**2, axis=0))
    caption = (
        f"Mean residuals (observed minus adjusted) of all stills in cells of the image, enlarged "
        f"{1 / scale:.0f} times; red where a mean exceeds 3.5 of its own sigma: a sign of distortion "
        f"that the interior orientation does not take up, or of rays whose errors are alike. Cross: principal point. "
        f"RMS of single residuals: {_digits(rms[0])} px in columns, {_digits(rms[1])} px in rows."
    )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _digits(value: float) -> str:
    """Return a number with two significant digits, without an exponent."""
    if not (np.isfinite(value) and value > 0):
        return "0"
    return f"{value:.{max(1 - int(np.floor(np.log10(value))), 0)}f}"


def _pooled(result: OrientedBlock, cells: int) -> tuple[Array, Array, Array]:
    """Return middles (c, 2) of cells, mean residuals (c, 2) and the expected size of a mean by chance (c,)."""
    interior, used = result.adjustment.interior, result.adjustment.ray_used
    good = used & np.all(np.isfinite(result.adjustment.ray_residuals_px), axis=1)
    xy, residual = result.rays.xy_px[good], result.adjustment.ray_residuals_px[good]
    size = interior.width_px / cells
    rows = max(int(np.ceil(interior.height_px / size)), 1)
    column = np.clip((xy[:, 0] / size).astype(np.int64), 0, cells - 1)
    index = np.clip((xy[:, 1] / size).astype(np.int64), 0, rows - 1) * cells + column
    count = np.bincount(index, minlength=cells * rows)
    safe = np.maximum(count, 1)
    mean = np.column_stack([np.bincount(index, residual[:, axis], cells * rows) / safe for axis in (0, 1)])
    square = np.bincount(index, np.sum(residual**2, axis=1), cells * rows) / safe
    keep = count >= LEAST_RAYS
    middle = np.column_stack([np.arange(cells * rows) % cells + 0.5, np.arange(cells * rows) // cells + 0.5]) * size
    return middle[keep], mean[keep], np.sqrt(0.5 * square[keep] / safe[keep])


def radial_residuals(result: OrientedBlock) -> Drawing:
    """Draw the mean radial residual by distance from the principal point."""
    name, title = "radial_residuals", "Radial residuals"
    profile = radial_profile(result)
    if not len(profile.radius_px):
        return Drawing(name=name, title=title, caption="", absent="Too few rays for a radial profile.")
    figure = new_figure(2.7)
    axes = figure.add_subplot()
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.errorbar(
        profile.radius_px, profile.mean_px, yerr=2.0 * profile.standard_error_px, fmt="o-", ms=4, lw=1.0, capsize=3,
        color=BLUE,
    )  # fmt: skip
    limit = 1.15 * reach(np.abs(profile.mean_px) + 2.0 * profile.standard_error_px, least=0.01)
    axes.set(xlim=(0.0, image_radius_px(result.adjustment.interior)), ylim=(-limit, limit))
    plain_axes(axes, "Distance from the principal point [px]", "Mean radial residual [px]")
    caption = (
        "Mean radial component of the residuals, outwards positive, with two standard errors. A bow here means radial "
        "distortion that is not taken up, and goes with doming of the block."
    )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def doming_figure(result: OrientedBlock) -> Drawing:
    """Draw height differences by distance from the block's centre."""
    name, title = "doming", "Test for doming"
    unit = length_unit(result)
    stations = _station_heights(result)
    surveyed = len(differences_m((*result.check, *result.control)))
    if not surveyed and not len(stations[0]):
        absent = "No check or control point and no GNSS position: a bow of the heights cannot be tested."
        return Drawing(name=name, title=title, caption="", absent=absent)
    panels = int(surveyed > 0) + int(len(stations[0]) > 0)
    figure = new_figure(2.9)
    axes = list(figure.subplots(1, panels, squeeze=False)[0])
    _, edge = block_centre_and_radius_m(result)
    if surveyed:
        _surveyed_heights(axes.pop(0), result)
    if len(stations[0]):
        axes[0].axhline(0.0, color=GREY, lw=0.8)
        axes[0].errorbar(*stations[:2], yerr=stations[2], fmt="s", ms=3, lw=0.6, color=RED, ecolor=PALE)
        plain_axes(axes[0], f"Distance from the centre of the block [{unit.whole}]", f"GNSS residual up [{unit.whole}]")
        axes[0].set_title("Stations (bars: stated sigma)", loc="left")
    test = check_point_doming(result)
    found = f" Bow from the centre to {edge:.0f} {unit.whole}: {1e3 * test.bow_m:+.1f} ± {1e3 * test.sigma_m:.1f} "
    found += f"{unit.thousandth} from {test.points} check points."
    caption = "Height differences by horizontal distance from the centre of the block; a domed block shows a bow."
    caption += found if np.isfinite(test.bow_m) else " Too few check points to fit a bow."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _station_heights(result: OrientedBlock) -> tuple[Array, Array, Array]:
    """Return distance from the block's centre, GNSS residual up and its stated sigma of the used positions."""
    adjusted, gnss, source = result.adjustment, result.block.gnss, gnss_rows(result)
    if gnss is None or not np.any(adjusted.gnss_used) or np.any(source < 0):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    used = adjusted.gnss_used
    centre, _ = block_centre_and_radius_m(result)
    distance = np.hypot(*(gnss.position_m[source[used]][:, :2] - centre).T)
    return distance, adjusted.gnss_residuals_m[used][:, 2], gnss.sigma_m[source[used]][:, 2]


def _surveyed_heights(axes: "Axes", result: OrientedBlock) -> None:
    unit = length_unit(result)
    axes.axhline(0.0, color=GREY, lw=0.8)
    kinds = ((result.check, "o", BLUE, "check"), (result.control, "^", INK, "control"))
    for points, marker, colour, label in kinds:
        if points:
            z, sigma = 1e3 * differences_m(points)[:, 2], 1e3 * sigmas_m(points)[:, 2]
            distance = surveyed_distances_m(result, points)
            axes.errorbar(
                distance, z, yerr=np.nan_to_num(sigma), fmt=marker, ms=5, lw=0.9, capsize=2, color=colour, label=label
            )
    plain_axes(axes, f"Distance from the centre of the block [{unit.whole}]", f"Height difference [{unit.thousandth}]")
    axes.set_title("Surveyed points (bars: predicted sigma)", loc="left")
    axes.margins(y=0.2)
    axes.legend(loc="best", ncols=2)


def predicted_and_actual(result: OrientedBlock) -> Drawing:
    """Draw the check points' differences against their predicted sigmas, and divided by them."""
    name, title = "predicted_precision", "Predicted and actual precision at the check points"
    d, s = differences_m(result.check), sigmas_m(result.check)
    good = np.all(np.isfinite(d) & np.isfinite(s) & (s > 0), axis=1)
    if not np.any(good):
        absent = "No check points: the predicted precision cannot be compared with anything."
        return Drawing(name=name, title=title, caption="", absent=absent)
    figure = new_figure(3.5)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.35])
    _differences_by_sigma(left, 1e3 * np.abs(d[good]), 1e3 * s[good], length_unit(result).thousandth)
    points = [point for point, use in zip(result.check, good, strict=True) if use]
    _normalised(right, points, d[good] / s[good])
    share = float(np.mean(np.abs(d[good] / s[good]) > 2.0))
    caption = (
        f"Left: size of each difference against its predicted sigma, with lines at 1, 2 and 3 sigma. Right: "
        f"differences divided by sigma; {100 * share:.0f} % lie beyond 2 sigma (about 5 % are expected)."
    )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _differences_by_sigma(axes: "Axes", size: Array, sigma: Array, unit: str) -> None:
    right = 1.15 * float(sigma.max())
    top = 1.08 * max(float(size.max()), 3.0 * float(np.median(sigma)))
    for factor, style in ((1, "-"), (2, "--"), (3, ":")):
        axes.plot([0, right], [0, factor * right], color=GREY, lw=0.9, ls=style)
        x = min(right, top / factor)
        axes.annotate(f"{factor} σ", (x, factor * x), (3, 1), textcoords="offset points", fontsize=8, color=GREY)
    for axis, (label, colour, marker) in enumerate(zip(AXIS_NAMES, AXIS_COLOURS, "os^", strict=True)):
        axes.scatter(sigma[:, axis], size[:, axis], color=colour, marker=marker, s=22, lw=0, label=label, clip_on=False)
    axes.set(xlim=(0, right), ylim=(0, top))
    plain_axes(axes, f"Predicted sigma [{unit}]", f"|Difference| [{unit}]")
    axes.legend(loc="upper left", handletextpad=0.1, borderaxespad=0.1)


def _normalised(axes: "Axes", points: list[PointDifference], ratio: Array) -> None:
    place = np.arange(len(points))
    axes.axhspan(-2, 2, color="#EFEFEF", lw=0, zorder=0)
    axes.axhline(0.0, color=GREY, lw=0.8)
    for axis, (colour, marker) in enumerate(zip(AXIS_COLOURS, "os^", strict=True)):
        axes.scatter(place + 0.2 * (axis - 1), ratio[:, axis], color=colour, marker=marker, s=20, lw=0)
    limit = max(3.3, 1.1 * float(np.max(np.abs(ratio))))
    axes.set(xlim=(-0.7, len(points) - 0.3), ylim=(-limit, limit))
    plain_axes(axes, "", "Difference / sigma")
    _name_ticks(axes, [point.name for point in points])


def _name_ticks(axes: "Axes", names: list[str], most: int = 36) -> None:
    step = max(-(-len(names) // most), 1)
    places = list(range(0, len(names), step))
    labels = [shortened(names[place]) for place in places]
    axes.set_xticks(places, labels, rotation=90, fontsize=7.5 if len(places) > 20 else 8.5)
    axes.grid(False, axis="x")


def gnss_residuals(result: OrientedBlock) -> Drawing:
    """Draw the GNSS residuals of each station; rejected positions are crosses."""
    name, title = "gnss_residuals", "GNSS residuals"
    residual, used = result.adjustment.gnss_residuals_m, result.adjustment.gnss_used
    if not len(used):
        return Drawing(name=name, title=title, caption="", absent="No GNSS position takes part in the adjustment.")
    figure = new_figure(5.0)
    panels = figure.subplots(3, 1, sharex=True)
    sigma = _stated_sigmas(result)
    for axis, axes in enumerate(panels):
        _gnss_panel(axes, residual[:, axis], sigma[:, axis], used, AXIS_COLOURS[axis])
        plain_axes(axes, "", f"{AXIS_NAMES[axis]} [{length_unit(result).whole}]")
    _name_ticks(panels[-1], list(gnss_stations(result)))
    panels[-1].set_xlim(-0.7, len(used) - 0.3)
    caption = (
        "Observed minus adjusted position of the antenna at each still, after the shift of its flight; grey band: one "
        "stated sigma."
    )
    if not np.all(used):
        caption += (
            f" Crosses: {int(np.sum(~used))} rejected positions, at the edge with their value where they lie outside."
        )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _stated_sigmas(result: OrientedBlock) -> Array:
    gnss, source = result.block.gnss, gnss_rows(result)
    if gnss is None or np.any(source < 0):
        return np.full((len(source), 3), np.nan)
    return np.asarray(gnss.sigma_m[source])


def _gnss_panel(axes: "Axes", residual: Array, sigma: Array, used: Flags, colour: str) -> None:
    place = np.arange(len(residual))
    shown = residual[used] if np.any(used) else residual
    limit = 1.3 * max(reach(shown), reach(sigma) if np.any(np.isfinite(sigma)) else 0.0)
    if np.all(np.isfinite(sigma)):
        axes.fill_between(place, -sigma, sigma, step="mid", color="#EBEBEB", lw=0)
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.vlines(place[used], 0.0, residual[used], color=colour, lw=0.8)
    axes.scatter(place[used], residual[used], color=colour, s=14, lw=0)
    axes.set_ylim(-limit, limit)
    rejected = np.flatnonzero(~used & np.isfinite(residual))
    crowd = 0.1 * len(residual)
    for row in rejected:
        value = residual[row]
        axes.plot(row, np.clip(value, -0.93 * limit, 0.93 * limit), "x", color=RED, ms=6, mew=1.5, zorder=4)
        if abs(value) > limit and int(np.sum(~used)) <= 15:
            follows = np.any((rejected > row) & (rejected < row + crowd))
            side = -1.0 if row > 0.85 * len(residual) or (follows and row > crowd / 2) else 1.0
            axes.annotate(
                f"{value:+.1f}", (row, np.sign(value) * 0.93 * limit), (side * 6, 0), textcoords="offset points",
                fontsize=7.5, color=RED, va="center", ha="left" if side > 0 else "right",
            )  # fmt: skip


def correlation_matrix(result: OrientedBlock) -> Drawing:
    """Draw the correlation of the interior orientation's free parameters."""
    name, title = "interior_correlation", "Correlation of the interior orientation"
    names, correlation = interior_correlation(result)
    if len(names) < 2:
        absent = "The interior orientation is fixed: nothing is estimated."
        return Drawing(name=name, title=title, caption="", absent=absent)
    figure = new_figure(4.0, 5.2)
    axes = figure.add_subplot()
    picture = axes.imshow(correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    labels = ["c" if label == INTERIOR_PARAMETERS[0] else label.removesuffix("_px") for label in names]
    axes.set_xticks(range(len(names)), labels)
    axes.set_yticks(range(len(names)), labels)
    axes.tick_params(length=0)
    for row in range(len(names)):
        for column in range(len(names)):
            value = correlation[row, column]
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=colour)
    axes.spines[:].set_visible(False)
    figure.colorbar(picture, ax=axes, shrink=0.8, label="Correlation", pad=0.02)
    caption = "Values near ±1 mean that the block cannot tell two parameters apart; k1, k2, k3 are always correlated."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def distortion_curve(result: OrientedBlock) -> Drawing:
    """Draw the radial distortion with its sigma."""
    name, title = "distortion", "Radial distortion"
    interior, covariance = result.adjustment.interior, result.adjustment.interior_covariance
    c = interior.principal_distance_px
    radius = np.linspace(0.0, image_radius_px(interior), 120)
    design = c * (radius[:, None] / c) ** np.array([3.0, 5.0, 7.0])
    rows: Indices = np.arange(3, 6)
    curve = design @ np.array([interior.k1, interior.k2, interior.k3])
    sigma = np.sqrt(np.maximum(np.sum((design @ covariance[np.ix_(rows, rows)]) * design, axis=1), 0.0))
    figure = new_figure(2.7)
    axes = figure.add_subplot()
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.fill_between(radius, curve - 3 * sigma, curve + 3 * sigma, color=PALE, lw=0, label="3 sigma")
    axes.plot(radius, curve, color=BLUE, lw=1.6, label="adjusted")
    prior = result.block.interior
    axes.plot(radius, design @ np.array([prior.k1, prior.k2, prior.k3]), color=INK, lw=1.0, ls="--", label="a priori")
    axes.set_xlim(0.0, radius[-1])
    plain_axes(axes, "Distance from the principal point, without distortion [px]", "Shift outwards [px]")
    axes.legend(loc="best", ncols=3)
    caption = f"Radial distortion by k1, k2, k3; the sigma at the corner of the image is {_digits(sigma[-1])} px."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


ALL: tuple[Callable[[OrientedBlock], Drawing], ...] = (
    predicted_and_actual,
    residual_vectors,
    radial_residuals,
    doming_figure,
    gnss_residuals,
    correlation_matrix,
    distortion_curve,
)
