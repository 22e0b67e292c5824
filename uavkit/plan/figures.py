"""The pictures of a plan: map of the flight, map of coverage, height profile, overlap of the images; and one sheet.

Loads matplotlib: import it where pictures are drawn.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, LightSource, ListedColormap
from matplotlib.figure import Figure

from uavkit.core.arrays import Array
from uavkit.core.flightplan import AreaKind
from uavkit.formats.drawing import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RED,
    STYLE,
    WIDTH_IN,
    Drawing,
    new_figure,
    plain_axes,
    round_number,
)
from uavkit.plan.figures_profile import draw_profile, height_profile, image_overlaps, shown_sorties
from uavkit.plan.patterns import corridor_band
from uavkit.plan.scene import Scene, turns_right

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SORTIE_COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, "#56B4E9")
MOST_FOOTPRINTS = 60
"""Above this only every k-th is drawn."""
SOME_FOOTPRINTS = 24
MOST_STATIONS = 1200
"""Above this the exposures are not drawn one by one."""
MOST_NUMBERED = 40
MOST_ARROWS = 80
BACKGROUND_CELLS = 60_000
ENOUGH_CLASSES = 7
"""Of cells seen by as many images as were asked for, or more."""
LEVELS = 7
"""Contours, about."""
FAR = 1.5
"""A take-off point farther from the flight than this, by the flight's size, is told in words."""


def draw_figures(scene: Scene) -> Iterator[Drawing]:
    """Yield the pictures of a plan in their order."""
    draws: tuple[Callable[[Scene], Drawing], ...] = (plan_map, coverage_picture, height_profile, image_overlaps)
    for draw in draws:
        with mpl.rc_context(STYLE):
            drawing = draw(scene)
        yield drawing


def plan_sheet(scene: Scene) -> Figure:
    """Return one sheet (A4, landscape) with the map of the flight, the coverage, and the profile of a sortie."""
    with mpl.rc_context(STYLE):
        figure = new_figure(8.27, 11.69)
        figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.1, wspace=0.03, hspace=0.03)
        grid = figure.add_gridspec(3, 2, height_ratios=[2.7, 0.8, 0.4])
        draw_plan(figure.add_subplot(grid[0, 0]), scene)
        coverage = figure.add_subplot(grid[0, 1])
        draw_coverage(coverage, scene)
        coverage.set_title("Images that see each place", pad=20.0 if scene.is_facade else 6.0)
        sortie = shown_sorties(scene, 1)[0]
        upper = figure.add_subplot(grid[1, :])
        draw_profile(upper, figure.add_subplot(grid[2, :], sharex=upper), scene, sortie)
        which = f" of sortie {sortie + 1} of {len(scene.plan.sorties)}" if len(scene.plan.sorties) > 1 else ""
        upper.set_title(f"Path{which} above the ground; dashed: least clearance asked for", loc="left")
        summary = scene.plan.summary
        figure.suptitle(
            f"{scene.plan.name}: {summary.images} images, {summary.strips} strips, {summary.length_m / 1e3:.1f} km, "
            f"{summary.duration_s / 60.0:.0f} min, GSD {1e3 * summary.gsd_m[1]:.1f} mm",
            fontsize=12,
        )
    return figure


# the map of the flight


def plan_map(scene: Scene) -> Drawing:
    """Draw areas, strips, exposures, footprints and the take-off point over the terrain."""
    west, east, south, north = _extent(scene)
    height = float(np.clip(WIDTH_IN * 0.86 * (north - south) / (east - west), 2.6, 6.4)) + 0.7
    figure = new_figure(height)
    drawn = draw_plan(figure.add_subplot(), scene)
    return Drawing(name="plan", title="Map", caption=_plan_caption(scene, drawn), figure=figure)


def draw_plan(axes: "Axes", scene: Scene) -> dict[str, bool]:
    """Draw the map of the flight, and tell what of it was drawn."""
    extent = _extent(scene)
    west, east, south, north = extent
    axes.set(xlim=(west, east), ylim=(south, north))
    axes.set_aspect("equal")
    drawn = {"terrain": _terrain(axes, scene, extent), "footprints": _footprints(axes, scene)}
    _areas(axes, scene)
    _sorties(axes, scene)
    drawn["stations"] = _stations(axes, scene)
    _views(axes, scene, extent)
    drawn["numbers"] = _numbers(axes, scene)
    drawn["far"] = not _take_off(axes, scene, extent)
    plain_axes(axes, "East [m]", "North [m]")
    axes.grid(False)
    _scale_bar(axes, extent)
    _north_arrow(axes)
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3, borderaxespad=0.2, handletextpad=0.5, columnspacing=1.2
    )
    return drawn


def _plan_caption(scene: Scene, drawn: dict[str, bool]) -> str:
    plan = scene.plan
    parts = ["Strips with their numbers and the direction of flight" if drawn["numbers"] else "Strips"]
    parts[0] += ", exposures (dots)" if drawn["stations"] else ""
    parts[0] += ", and between them the path (dashed)."
    if drawn["footprints"]:
        every = _every(len(plan.exposures))
        parts.append("Outlines of the images on the ground" + (f", one of {every}." if every > 1 else "."))
    if drawn["terrain"]:
        parts.append("Contours in metres above the take-off point.")
    if scene.request.pattern == "corridor":
        parts.append("Dotted: the band to be covered.")
    if scene.looks_sideways:
        parts.append("Short orange lines: where the cameras look.")
    if scene.is_facade:
        parts.append("The strips before the facade are vertical: from above each is a point.")
    if len(plan.sorties) > len(SORTIE_COLOURS):
        parts.append(f"{len(plan.sorties)} sorties: their colours repeat.")
    if drawn["far"]:
        parts.append(f"The take-off point lies outside of the map, {_where(scene)}.")
    place = scene.planned.local_map
    parts.append(
        f"Coordinates in metres from latitude {place.latitude_deg:.6f}, longitude {place.longitude_deg:.6f} degrees."
    )
    return " ".join(parts)


def _where(scene: Scene) -> str:
    west, east, south, north = _extent(scene)
    step = scene.take_off_m - 0.5 * np.array([west + east, south + north])
    winds = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
    wind = winds[round(float(np.degrees(np.arctan2(step[0], step[1]))) / 45.0) % 8]
    return f"{1e-3 * float(np.hypot(*step)):.1f} km {wind} of its middle"


def _flown_m(scene: Scene) -> Array:
    """Return what the map must show, (n, 2): areas, exposures and the path, without a way from afar."""
    rings = [ring for outline in scene.outlines for ring in outline.rings_m]
    strips = [
        path[[point.strip >= 0 for point in sortie.waypoints], :2]
        for path, sortie in zip(scene.paths_m, scene.plan.sorties, strict=True)
    ]
    return np.concatenate([scene.stations_m, *rings, *strips])


def _is_near(scene: Scene) -> bool:
    flown = _flown_m(scene)
    low, high = flown.min(axis=0), flown.max(axis=0)
    size = max(float(np.max(high - low)), 1.0)
    return bool(np.all(scene.take_off_m > low - FAR * size) and np.all(scene.take_off_m < high + FAR * size))


def _extent(scene: Scene) -> tuple[float, float, float, float]:
    """Return west, east, south, north of the map."""
    shown = _flown_m(scene)
    if _is_near(scene):
        shown = np.concatenate([shown, scene.take_off_m[None]])
    low, high = shown.min(axis=0), shown.max(axis=0)
    size = max(float(np.max(high - low)), 1.0)
    rows = np.arange(0, len(scene.plan.exposures), _every(len(scene.plan.exposures)))
    rims = scene.footprints_m(rows).reshape(-1, 2)
    rims = rims[~np.isnan(rims).any(axis=1)]
    if len(rims) and not scene.looks_sideways:
        low = np.maximum(np.minimum(low, rims.min(axis=0)), low - 0.2 * size)
        high = np.minimum(np.maximum(high, rims.max(axis=0)), high + 0.2 * size)
    margin = (0.08 if scene.looks_sideways else 0.03) * max(float(np.max(high - low)), 1.0)
    low, high = low - margin, high + margin
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    half = np.maximum(half, [0.3 * half.max(), 0.22 * half.max()])  # no map narrower than its labels
    (west, south), (east, north) = middle - half, middle + half
    return float(west), float(east), float(south), float(north)


def _terrain(axes: "Axes", scene: Scene, extent: tuple[float, float, float, float]) -> bool:
    """Draw hillshade and contours where there is a terrain model."""
    if scene.elevation is None:
        return False
    west, east, south, north = extent
    cell = np.sqrt((east - west) * (north - south) / BACKGROUND_CELLS)
    x, y = np.arange(west + 0.5 * cell, east, cell), np.arange(south + 0.5 * cell, north, cell)
    heights, beyond = scene.ground_m(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    heights = np.where(beyond, np.nan, heights).reshape(len(y), len(x))
    if not np.any(np.isfinite(heights)):
        return False
    shade = LightSource(azdeg=315.0, altdeg=45.0).hillshade(heights[::-1], dx=cell, dy=cell)[::-1]
    axes.imshow(
        np.clip(shade, 0.0, 1.0), origin="lower", extent=extent, cmap="gray", vmin=-1.6, vmax=1.0, zorder=0, alpha=0.75
    )
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    if high - low > 0.5:
        step = max(round_number((high - low) / LEVELS), 0.5)
        levels = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
        lines = axes.contour(x, y, np.ma.masked_invalid(heights), levels=levels, colors="#8A7A60", linewidths=0.5)
        lines.set_zorder(0.5)
        axes.clabel(lines, fontsize=6.5, fmt=lambda value: f"{value:g}", colors="#6B5D45")
    return True


def _every(images: int) -> int:
    """Return of how many images one is drawn with its footprint."""
    return 1 if images <= MOST_FOOTPRINTS else -(-images // SOME_FOOTPRINTS)


def _footprints(axes: "Axes", scene: Scene) -> bool:
    if scene.looks_sideways:
        return False
    rims = scene.footprints_m(np.arange(0, len(scene.plan.exposures), _every(len(scene.plan.exposures))))
    rims = rims[~np.isnan(rims).any(axis=(1, 2))]
    closed = np.concatenate([rims, rims[:, :1]], axis=1)
    axes.add_collection(LineCollection(list(closed), colors=GREY, linewidths=0.5, alpha=0.55, zorder=1.5))
    return len(rims) > 0


def _areas(axes: "Axes", scene: Scene, *, fill: bool = True) -> None:
    from matplotlib.path import Path as Curve

    for number, outline in enumerate(scene.outlines):
        label = "area" if number == 0 else None
        first = outline.rings_m[0]
        if outline.kind is AreaKind.POINT:
            axes.plot(*first.T, marker="x", ms=8, mew=1.8, color=INK, lw=0, zorder=4, label="middle" if label else None)
            continue
        if outline.kind is AreaKind.LINE:
            axes.plot(*first.T, color=INK, lw=1.6, zorder=2.2, label="line" if label else None)
            _band_of_corridor(axes, scene, first)
            continue
        turned = [ring[::-1] if turns_right(ring) == (at == 0) else ring for at, ring in enumerate(outline.rings_m)]
        curve = Curve.make_compound_path(*(Curve(ring, closed=True) for ring in turned))
        if fill:
            axes.add_patch(mpl.patches.PathPatch(curve, fc=ORANGE, ec="none", alpha=0.10, zorder=1))
        for ring in outline.rings_m:
            axes.plot(*ring.T, color=INK, lw=1.4, zorder=2.2, label=label)
            label = None


def _band_of_corridor(axes: "Axes", scene: Scene, line_m: Array) -> None:
    """Draw the rims of the band that is to be covered."""
    if scene.request.pattern != "corridor" or scene.request.corridor is None:
        return
    from shapely import LineString

    band = corridor_band(LineString(line_m), scene.request.corridor.width_m)
    for part in getattr(band, "geoms", [band]):
        for ring in (part.exterior, *part.interiors):
            axes.plot(*np.array(ring.coords).T, color=INK, lw=0.9, ls=(0, (1, 1.5)), zorder=2.2)


def _sorties(axes: "Axes", scene: Scene) -> None:
    """Draw the path of each sortie, its strips, and their directions."""
    colours = [SORTIE_COLOURS[n % len(SORTIE_COLOURS)] for n in range(len(scene.plan.sorties))]
    for number, path in enumerate(scene.paths_m):
        axes.plot(*path[:, :2].T, color=colours[number], lw=0.7, ls=(0, (4, 2)), alpha=0.8, zorder=2.5)
    of_sortie = scene.plan.exposures.sortie
    lines = [scene.strip_line(strip) for strip in range(len(scene.plan.strips))]
    owners = [int(of_sortie[strip.first_exposure]) for strip in scene.plan.strips]
    width = 1.5 if len(lines) <= MOST_ARROWS else 0.7
    axes.add_collection(LineCollection(lines, colors=[colours[owner] for owner in owners], linewidths=width, zorder=3))
    for number in range(min(len(colours), len(SORTIE_COLOURS))):
        label = "strips" if len(colours) == 1 else f"sortie {number + 1}"
        axes.plot([], [], color=colours[number], lw=1.8, label=label)
    if len(lines) > MOST_ARROWS or scene.is_facade:
        return
    for line, owner in zip(lines, owners, strict=True):
        _arrow(axes, line, colours[owner])


def _arrow(axes: "Axes", line: Array, colour: str) -> None:
    """Draw the direction of flight where a third of a strip is flown."""
    at = (len(line) - 1) // 3
    if len(line) < 2 or np.hypot(*(line[at + 1] - line[at])) < 1e-6:
        return
    axes.annotate(
        "",
        line[at + 1],
        line[at],
        arrowprops={"arrowstyle": "-|>,head_width=0.28,head_length=0.55", "color": colour, "lw": 1.2},
        zorder=3.5,
    )


def _stations(axes: "Axes", scene: Scene) -> bool:
    if len(scene.stations_m) > MOST_STATIONS:
        return False
    size = float(np.clip(1500.0 / len(scene.stations_m), 2.0, 9.0))
    colours = [SORTIE_COLOURS[n % len(SORTIE_COLOURS)] for n in scene.plan.exposures.sortie]
    x, y = scene.stations_m.T
    axes.scatter(x, y, s=size, c=colours, lw=0, zorder=3.2)
    return True


def _views(axes: "Axes", scene: Scene, extent: tuple[float, float, float, float]) -> None:
    """Draw where cameras look that do not look down."""
    if not scene.looks_sideways:
        return
    length = 0.05 * (extent[1] - extent[0])
    ends = scene.stations_m + length * scene.views
    axes.add_collection(
        LineCollection(list(np.stack([scene.stations_m, ends], axis=1)), colors=ORANGE, linewidths=0.8, zorder=2.8)
    )
    axes.plot([], [], color=ORANGE, lw=1.0, label="view")


def _numbers(axes: "Axes", scene: Scene) -> bool:
    """Write the number of each strip before its first exposure."""
    strips = scene.plan.strips
    if len(strips) > MOST_NUMBERED:
        return False
    middle = scene.stations_m.mean(axis=0)
    for number in range(len(strips)):
        line = scene.strip_line(number)
        ahead = line[0] - (line[1] if len(line) > 1 else middle)
        if np.hypot(*ahead) < 1e-6 or scene.request.pattern == "orbit":
            ahead = line[0] - middle
        ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
        text = axes.annotate(
            str(number + 1),
            line[0],
            _apart(scene, number) * ahead,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=7,
        )
        text.set(zorder=5, bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 0.4, "boxstyle": "round"})
    return True


def _apart(scene: Scene, number: int) -> float:
    """Return how far a number stands before its strip, in points: those of circles one beyond the other."""
    return 8.0 + (9.0 * number if scene.request.pattern == "orbit" else 0.0)


def _take_off(axes: "Axes", scene: Scene, extent: tuple[float, float, float, float]) -> bool:
    west, east, south, north = extent
    x, y = scene.take_off_m
    if not (west <= x <= east and south <= y <= north):
        return False
    axes.plot(x, y, marker="^", ms=9, mfc="white", mec=INK, mew=1.6, lw=0, zorder=6, label="take-off")
    return True


def _scale_bar(axes: "Axes", extent: tuple[float, float, float, float]) -> None:
    """Draw a bar of a round length above the right end of the axes."""
    west, east, _, _ = extent
    length = round_number(0.2 * (east - west))
    right = east - 0.06 * (east - west)
    place = axes.get_xaxis_transform() + _up_by(axes, 9.0)
    axes.plot(
        [right - length, right], [1.0, 1.0], transform=place, color=INK, lw=2.5, clip_on=False, solid_capstyle="butt"
    )
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    axes.text(
        right - 0.5 * length, 1.0, text, transform=axes.get_xaxis_transform() + _up_by(axes, 12.0), ha="center",
        va="bottom", fontsize=8,
    )  # fmt: skip


def _up_by(axes: "Axes", points: float) -> Any:
    from matplotlib.transforms import ScaledTranslation

    figure: Any = axes.figure
    return ScaledTranslation(0.0, points / 72.0, figure.dpi_scale_trans)


def _north_arrow(axes: "Axes") -> None:
    """Draw an arrow to the map's north above the right corner of the axes."""
    arrow = axes.plot(
        [0.985], [1.0], transform=axes.transAxes + _up_by(axes, 9.0), marker=[(-4, -6), (0, 6), (4, -6), (0, -3)],
        ms=13, mfc=INK, mec="none", ls="", clip_on=False,
    )  # fmt: skip
    arrow[0].set_markeredgewidth(0.0)
    axes.text(
        0.985, 1.0, "N", transform=axes.transAxes + _up_by(axes, 17.0), ha="center", va="bottom", fontsize=9,
        fontweight="bold",
    )  # fmt: skip


# coverage


def coverage_picture(scene: Scene) -> Drawing:
    """Draw how many images see each cell of the area."""
    coverage = scene.planned.coverage
    rows, columns = coverage.images.shape
    height = float(np.clip(WIDTH_IN * 0.8 * rows / columns, 2.2, 6.2)) + 0.5
    figure = new_figure(height)
    draw_coverage(figure.add_subplot(), scene)
    return Drawing(name="coverage", title="Images that see each place", caption=_coverage_caption(scene), figure=figure)


def _coverage_caption(scene: Scene) -> str:
    summary, wanted = scene.plan.summary, scene.request.imaging.least_images
    enough, covered = _share(summary.covered_enough), _share(summary.covered)
    what = "the facade's longest side, seen from before it" if scene.is_facade else "the area"
    if scene.request.pattern == "orbit":
        what = "the ground within half the radius of the circles"
    caption = (
        f"Number of images that see each cell of {what}. {enough} of it is seen by {wanted} images or more, as asked; "
        f"{covered} by one at least; the fewest are {summary.least_images}."
    )
    if summary.covered_enough < 1.0:
        caption += " Cells with fewer than asked are orange, unseen ones dark."
    if not scene.is_facade and _is_near(scene):
        caption += " Triangle: take-off point."
    return caption


def _share(value: float) -> str:
    """Return a share as text; only what is whole is written as 100 %."""
    return f"{min(100.0 * value, 99.9):.1f} %" if value < 1.0 else "100 %"


def draw_coverage(axes: "Axes", scene: Scene) -> None:
    """Draw the map of coverage; for a facade in its plane."""
    coverage, wanted = scene.planned.coverage, scene.request.imaging.least_images
    counts = np.ma.masked_array(coverage.images, ~coverage.in_area)
    rows, columns = counts.shape
    left, bottom = (first - 0.5 * coverage.cell_m for first in coverage.first_xy_m)
    right, top = left + columns * coverage.cell_m, bottom + rows * coverage.cell_m
    counts = np.ma.minimum(counts, _most_shown(counts))
    bounds, colours = _classes(int(counts.max()) if counts.count() else 0, wanted)
    picture = axes.imshow(
        counts, origin="lower", extent=(left, right, bottom, top), cmap=colours,
        norm=BoundaryNorm(bounds, colours.N), interpolation="nearest", zorder=1,
    )  # fmt: skip
    figure: Any = axes.figure
    bar = figure.colorbar(
        picture, ax=axes, label=f"Number of images (asked: {wanted})", shrink=0.85, pad=0.02, aspect=28
    )
    bar.set_ticks([0.5 * (a + b) for a, b in pairwise(bounds)])
    names = [_class_name(a, b) for a, b in pairwise(bounds)]
    bar.set_ticklabels([*names[:-1], f"{bounds[-2]} or more"] if bounds[-2] >= wanted else names)
    bar.ax.tick_params(length=0)
    margin = 0.03 * max(right - left, top - bottom)
    axes.set_aspect("equal")
    if scene.is_facade:
        _facade_stations(axes, scene)
        plain_axes(axes, "Along the facade [m]", "Above its foot [m]")
    else:
        _areas(axes, scene, fill=False)
        axes.set(xlim=(left - margin, right + margin), ylim=(bottom - margin, top + margin))
        _take_off(axes, scene, (left - margin, right + margin, bottom - margin, top + margin))
        plain_axes(axes, "East [m]", "North [m]")
    axes.grid(False)


def _most_shown(counts: "np.ma.MaskedArray[Any, Any]") -> int:
    """Return the count above which cells are not told apart: few cells reach it."""
    known = counts.compressed()
    return int(np.quantile(known, 0.995)) if known.size else 0


def _facade_stations(axes: "Axes", scene: Scene) -> None:
    view = scene.facade_view
    axes.scatter(view.xy_m[:, 0], view.xy_m[:, 1], s=9, c=INK, lw=0, zorder=3, clip_on=False, label="exposure")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), borderaxespad=0.2, handletextpad=0.2)


def _classes(most: int, wanted: int) -> tuple[list[int], ListedColormap]:
    """Return the bounds of the classes and their colours: dark unseen, orange too few, blue enough."""
    few = [0, 1] if wanted > 1 else [0]
    step = max(1, -(-(most - wanted + 1) // ENOUGH_CLASSES))
    enough = list(range(wanted, max(most, wanted) + step, step))
    bounds = [*few, *enough, enough[-1] + step] if enough[-1] <= max(most, wanted) else [*few, *enough]
    short = ["#5A1A00", "#F0A030"][: len(few)]
    shades = mpl.colormaps["GnBu"](np.linspace(0.25, 1.0, len(bounds) - 1 - len(few)))
    return bounds, ListedColormap([*short, *[tuple(shade) for shade in shades]])


def _class_name(low: int, high: int) -> str:
    return str(low) if high - low == 1 else f"{low} to {high - 1}"
