"""The figures of the block as a whole: plan, oblique view, overlap, and the network of rays."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap

from uavkit.core.arrays import Array, Indices
from uavkit.core.result import OrientedBlock
from uavkit.formats.drawing import (
    BLUE,
    GREY,
    HEIGHT_COLOURS,
    INK,
    RED,
    STYLE,
    WIDTH_IN,
    Drawing,
    new_figure,
    plain_axes,
    shortened,
)
from uavkit.report import figures_exposures, figures_pictures, figures_precision
from uavkit.report.coverage import Ground, extent_m, exteriors, footprint_m, ground_surface, overlap_counts
from uavkit.report.measures import determined_points, length_unit, rays_of_points, view_tilts_deg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_FOOTPRINTS = 60
"""Above this, outlines of footprints would hide the ground."""
MOST_NAMES = 30
MOST_BARS = 40
STEEPEST_MEDIAN_TILT_DEG = 60.0
"""Against the vertical; beyond this (facades) footprints on the ground tell nothing."""
MOST_OVERLAP_WORK = 4_000_000
"""Projections (cells times stills) that the overlap map may cost."""


def draw_figures(result: OrientedBlock, ground: Ground) -> Iterator[Drawing]:
    """Yield all figures of a report in their order."""
    for draw_on_ground in ON_GROUND:
        with mpl.rc_context(STYLE):
            drawing = draw_on_ground(result, ground)
        yield drawing
    for draw in OTHERS:
        with mpl.rc_context(STYLE):
            drawing = draw(result)
        yield drawing


def plan_view(result: OrientedBlock, ground: Ground) -> Drawing:
    """Draw stations, strips, footprints and points from above."""
    west, east, south, north = extent_m(result)
    unit = length_unit(result).whole
    figure = new_figure(float(np.clip(WIDTH_IN * 0.84 * (north - south) / (east - west), 2.4, 8.0)) + 0.65)
    axes = figure.add_subplot()
    _footprints(axes, result, ground)
    points = _drawn_points(result)
    low, high = _height_limits(points)
    dots = axes.scatter(
        points[:, 0],
        points[:, 1],
        c=points[:, 2],
        s=_dot_size(len(points)),
        cmap=HEIGHT_COLOURS,
        vmin=low,
        vmax=high,
        lw=0,
    )
    figure.colorbar(dots, ax=axes, label=f"Up [{unit}]", shrink=0.8, pad=0.02, aspect=30)
    for line in _strip_lines(result):
        axes.plot(line[:, 0], line[:, 1], color=INK, lw=0.9, zorder=3)
    stations = result.adjustment.projection_centres_m
    side = 18 if len(stations) <= 100 else 7
    axes.scatter(
        stations[:, 0], stations[:, 1], marker="s", s=side, color=RED, ec="white", lw=0.5, zorder=4, label="station"
    )
    _surveyed(axes, result)
    axes.set_aspect("equal")
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    plain_axes(axes, f"East [{unit}]", f"North [{unit}]")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2, handletextpad=0.3)
    drawn = len(result.images) <= MOST_FOOTPRINTS and not _looks_sideways(result)
    outlines = ", outlines of the stills on the ground" if drawn else ""
    strips = ", strips (lines)" if np.any(result.strips >= 0) else ""
    caption = f"Stations (squares){strips}{outlines}, and object points coloured by height in the local frame."
    return Drawing(name="plan", title="Stations and points from above", caption=caption, figure=figure)


def _drawn_points(result: OrientedBlock, most: int = 30_000) -> Array:
    points = result.adjustment.points_m[determined_points(result)]
    return np.asarray(points[:: max(len(points) // most, 1)])


def _height_limits(points_m: Array) -> tuple[float, float]:
    if not len(points_m):
        return 0.0, 1.0
    low, high = np.percentile(points_m[:, 2], [1.0, 99.0])
    return float(low), float(high if high > low else low + 1e-3)


def _dot_size(count: int) -> float:
    return float(np.clip(9000.0 / max(count, 1), 1.0, 10.0))


def _strip_lines(result: OrientedBlock) -> Iterator[Array]:
    for strip in np.unique(result.strips[result.strips >= 0]):
        yield result.adjustment.projection_centres_m[result.strips == strip]


def _footprints(axes: "Axes", result: OrientedBlock, ground: Ground) -> None:
    if len(result.images) > MOST_FOOTPRINTS or _looks_sideways(result):
        return
    for exterior in exteriors(result):
        try:
            outline = footprint_m(exterior, result.adjustment.interior, ground)
        except ValueError:  # the distortion cannot be inverted at the border of the image
            return
        axes.plot(outline[:, 0], outline[:, 1], color=GREY, lw=0.5, alpha=0.55, zorder=1)


def _surveyed(axes: "Axes", result: OrientedBlock) -> None:
    kinds = ((result.block.control_points, "^", "control point"), (result.block.check_points, "o", "check point"))
    named = len(result.block.control_points) + len(result.block.check_points) <= MOST_NAMES
    for points, marker, label in kinds:
        if not points:
            continue
        xy = np.array([point.position_m[:2] for point in points])
        fill = INK if marker == "^" else "white"
        axes.scatter(xy[:, 0], xy[:, 1], marker=marker, s=42, fc=fill, ec=INK, lw=1.2, zorder=5, label=label)
        for point in points if named else ():
            text = axes.annotate(shortened(point.name, 12), point.position_m[:2], (5, 4), textcoords="offset points")
            text.set(fontsize=8, zorder=6, bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 0.6})


def oblique_view(result: OrientedBlock, ground: Ground) -> Drawing:
    """Draw stations, strips and points obliquely from the south-west."""
    unit = length_unit(result).whole
    figure = new_figure(4.1)
    figure.set_layout_engine("none")  # it leaves much room empty around three-dimensional axes
    axes: Any = figure.add_axes((0.0, -0.04, 0.94, 1.1), projection="3d", computed_zorder=False)
    west, east, south, north = extent_m(result)
    points = _drawn_points(result, 8000)
    low, high = _height_limits(points)
    inside = (points[:, 0] >= west) & (points[:, 0] <= east) & (points[:, 1] >= south) & (points[:, 1] <= north)
    points = points[inside & (points[:, 2] >= low - (high - low)) & (points[:, 2] <= high + (high - low))]
    size = 0.6 * _dot_size(len(points))
    axes.scatter(
        *points.T, c=points[:, 2], s=size, cmap=HEIGHT_COLOURS, vmin=low, vmax=high, lw=0, zorder=1, depthshade=False
    )
    for line in _strip_lines(result):
        axes.plot(*line.T, color=INK, lw=0.9, zorder=3)
    stations = result.adjustment.projection_centres_m
    axes.scatter(
        *stations.T, marker="s", s=14 if len(stations) <= 100 else 4, color=RED, lw=0, zorder=4, depthshade=False
    )
    if len(stations) <= MOST_FOOTPRINTS:
        foot = ground.height_at_m(stations[:, :2])
        for station, height in zip(stations, foot, strict=True):
            axes.plot(*zip(station, (*station[:2], height), strict=True), color=GREY, lw=0.4, zorder=2)
    top = float(stations[:, 2].max()) if len(stations) else high
    bottom = min(low, top)
    axes.set(xlim=(west, east), ylim=(south, north), zlim=(bottom, max(top, high)))
    sides = (east - west, north - south, max(top, high) - bottom)
    axes.set_box_aspect(sides, zoom=1.22 if sides[2] < 0.35 * max(sides) else 1.0)
    axes.view_init(elev=28.0, azim=-62.0)
    axes.locator_params(axis="z", nbins=4)
    axes.locator_params(axis="y", nbins=5)
    axes.set(xlabel=f"East [{unit}]", ylabel=f"North [{unit}]", zlabel=f"Up [{unit}]")
    caption = "The same block seen obliquely from the south-west; heights are not exaggerated."
    return Drawing(name="oblique", title="Stations and points, oblique view", caption=caption, figure=figure)


def overlap_map(result: OrientedBlock, ground: Ground) -> Drawing:
    """Draw how many stills see each place of the ground."""
    name, title = "overlap", "Overlap"
    if _looks_sideways(result):
        absent = "The stills look too much sideways for a map of overlap from above."
        return Drawing(name=name, title=title, caption="", absent=absent)
    unit = length_unit(result).whole
    cells = ground.height_m.size
    most = MOST_OVERLAP_WORK / max(len(result.images), 1)
    shown = ground if cells <= most else ground_surface(result, cells=max(int(100 * np.sqrt(most / cells)), 20))
    counts = overlap_counts(result, shown)
    west, east, south, north = extent_m(result)
    figure = new_figure(float(np.clip(WIDTH_IN * 0.79 * (north - south) / (east - west), 2.4, 8.0)) + 0.45)
    axes = figure.add_subplot()
    bounds = _overlap_bounds(counts)
    blues = mpl.colormaps["Blues"](np.linspace(0.25, 1.0, len(bounds) - 4))
    colours = ListedColormap(["#FFFFFF", RED, "#F0B26B", *blues])
    picture = axes.imshow(
        counts, origin="lower", extent=(west, east, south, north), cmap=colours, norm=BoundaryNorm(bounds, colours.N)
    )
    bar = figure.colorbar(picture, ax=axes, label="Number of stills", shrink=0.8, pad=0.02, aspect=30)
    bar.set_ticks([(a + b - 1) / 2 + 0.5 for a, b in pairwise(bounds)])
    bar.set_ticklabels(_class_names(bounds))
    bar.ax.tick_params(length=0)
    stations = result.adjustment.projection_centres_m
    axes.scatter(stations[:, 0], stations[:, 1], marker="s", s=6, color=INK, lw=0)
    plain_axes(axes, f"East [{unit}]", f"North [{unit}]")
    axes.grid(False)
    covered = counts[counts > 0]
    share = 100.0 * float(np.mean(covered >= 3)) if covered.size else 0.0
    caption = (
        f"Stills that see each place of the ground (hidden places are not looked for). {share:.0f} % of the ground "
        f"seen at all is seen by three stills or more. Beyond the points their nearest heights are taken."
    )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _looks_sideways(result: OrientedBlock) -> bool:
    return float(np.median(view_tilts_deg(result))) > STEEPEST_MEDIAN_TILT_DEG


def _overlap_bounds(counts: Indices) -> list[int]:
    top = int(counts.max()) if counts.size else 0
    bounds = [0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100, 200, 500]
    shown = [bound for bound in bounds if bound <= max(top, 5)]
    return [*shown, max(top, 5) + 1]


def _class_names(bounds: list[int]) -> list[str]:
    return [str(low) if high - low == 1 else f"{low} to {high - 1}" for low, high in pairwise(bounds)]


def ray_count_histogram(result: OrientedBlock) -> Drawing:
    """Draw how many points have how many rays."""
    name, title = "ray_counts", "Rays of the object points"
    rays = rays_of_points(result)[determined_points(result)]
    if not len(rays):
        return Drawing(name=name, title=title, caption="", absent="No object point is determined.")
    top = max(int(np.percentile(rays, 99.5)), 4)
    first = int(rays.min())
    width = -(-(top - first + 1) // MOST_BARS)
    edges = np.arange(first, top + width + 1, width)
    counts, _ = np.histogram(np.minimum(rays, edges[-1] - 1), edges - 0.5)
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    bars = axes.bar(edges[:-1] + 0.5 * (width - 1), counts, color=BLUE, width=0.8 * width)
    if len(counts) <= 16:
        axes.bar_label(bars, fontsize=7.5, padding=1.5, color=INK)
    plain_axes(axes, "Rays used", "Points")
    axes.grid(False, axis="x")
    axes.set_xlim(first - 0.8 * width, edges[-1] - 0.2 * width)
    axes.locator_params(axis="x", integer=True)
    if np.any(rays >= edges[-1]):
        axes.set_xlabel(f"Rays used (last bar: {edges[-2]} and more)")
    caption = f"Number of used rays of each of the {len(rays)} determined points; mean {rays.mean():.1f}."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


ON_GROUND: tuple[Callable[[OrientedBlock, Ground], Drawing], ...] = (plan_view, oblique_view, overlap_map)
OTHERS: tuple[Callable[[OrientedBlock], Drawing], ...] = (
    ray_count_histogram,
    *figures_precision.ALL,
    *figures_pictures.ALL,
    figures_exposures.camera_clock,
)
COUNT = len(ON_GROUND) + len(OTHERS)
