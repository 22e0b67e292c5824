"""The pictures of a plan over the flight: height profiles of its sorties, and overlap and pixel size of its images."""

from typing import TYPE_CHECKING

import numpy as np

from uavkit.core.arrays import Array, Flags
from uavkit.formats.drawing import BLUE, GREY, INK, ORANGE, RED, Drawing, new_figure, plain_axes
from uavkit.plan.scene import Profile, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_PANELS = 4
"""Sorties whose profiles are drawn."""
DRAWN = 2400
"""Columns of a profile: more samples are drawn as the band that they fill."""
MOST_TICKED = 400
"""Exposures of a sortie that are marked one by one."""
MOST_BANDS = 60
"""Strips of a sortie that are shaded one by one."""
MOST_NUMBERED = 30
MOST_DOTS = 3000
"""Images that are drawn one by one; above this their distribution."""
EARTH, EARTH_RIM = "#DDD3C0", "#8A7A60"
SHORT_BY = 0.01
"""An overlap under the request by more than this is marked."""


def height_profile(scene: Scene) -> Drawing:
    """Draw terrain, path and clearance of the sorties over the distance flown."""
    sorties = shown_sorties(scene, MOST_PANELS)
    figure = new_figure(3.9 if len(sorties) == 1 else 2.0 * len(sorties) + 0.3)
    grid = figure.add_gridspec(2 * len(sorties), 1, height_ratios=[2.0, 1.0] * len(sorties))
    for row, sortie in enumerate(sorties):
        upper = figure.add_subplot(grid[2 * row])
        lower = figure.add_subplot(grid[2 * row + 1], sharex=upper)
        draw_profile(upper, lower, scene, sortie, named=row == len(sorties) - 1)
        if len(scene.plan.sorties) > 1:
            upper.set_title(f"Sortie {sortie + 1}", loc="left")
    return Drawing(
        name="profile", title="Heights along the path", caption=_profile_caption(scene, sorties), figure=figure
    )


def shown_sorties(scene: Scene, most: int) -> list[int]:
    """Return the sorties whose profiles are drawn: the first ones, and the one that comes nearest to the ground."""
    count = len(scene.plan.sorties)
    if count <= most:
        return list(range(count))
    worst = int(np.argmin([np.nanmin(scene.profile(n).above_ground_m) for n in range(count)]))
    return list(range(most)) if worst < most else [*range(most - 1), worst]


def _profile_caption(scene: Scene, sorties: list[int]) -> str:
    ground = "ground of the terrain model" if scene.elevation is not None else "ground (taken as level)"
    twice = f" and twice the model's error of {scene.sigma_m:g} m" if scene.sigma_m else ""
    marked = "The place of least clearance is marked" + (", less those two sigma" if scene.sigma_m else "")
    caption = (
        f"Path (blue) over the {ground}; dashed: the least clearance of "
        f"{scene.request.terrain.least_clearance_m:g} m{twice} above it. {marked}. "
        "Pale bands are the strips; dotted in the lower panel: the height asked for."
    )
    left = [n for n in range(len(scene.plan.sorties)) if n not in sorties]
    if not left:
        return caption
    lowest = [float(np.nanmin(scene.profile(n).above_ground_m)) - 2.0 * scene.sigma_m for n in left]
    one = "the other sortie" if len(left) == 1 else f"the other {len(left)} sorties"
    return f"{caption} Not drawn: {one}, with {min(lowest):.1f} m clearance at least."


def draw_profile(upper: "Axes", lower: "Axes", scene: Scene, sortie: int, *, named: bool = True) -> None:
    """Draw heights above the take-off point, and above the ground, over the distance flown."""
    profile = scene.profile(sortie)
    far = profile.distance_m[-1] > 5000.0
    scale = 1e-3 if far else 1.0
    for axes in (upper, lower):
        _strip_bands(axes, scene, sortie, scale)
    _strip_numbers(upper, scene, sortie, scale)
    _heights(upper, profile, scene, scale)
    _exposure_ticks(upper, scene, sortie, scale)
    _least_clearance(upper, profile, scene, scale)
    _above_ground(lower, profile, scene, scale)
    plain_axes(upper, "", "Above\ntake-off [m]")
    plain_axes(lower, f"Distance flown [{'km' if far else 'm'}]" if named else "", "Above\nground [m]")
    upper.tick_params(labelbottom=False)
    upper.set_xlim(0.0, max(scale * profile.distance_m[-1], 1e-6))
    lower.locator_params(axis="y", nbins=3)
    upper.figure.align_ylabels([upper, lower])


def _band(distance_m: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return distance, least and greatest value (columns,) of samples (n,); nan where there is none."""
    if len(distance_m) <= DRAWN:
        return distance_m, values, values
    edges = np.linspace(0, len(distance_m), DRAWN + 1).astype(np.int64)[:-1]
    return distance_m[edges], np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges)


def _heights(axes: "Axes", profile: Profile, scene: Scene, scale: float) -> None:
    at, low, high = _band(profile.distance_m, profile.ground_m)
    _, path_low, path_high = _band(profile.distance_m, profile.height_m)
    at = scale * at
    span = max(float(np.nanmax(path_high)) - float(np.nanmin(low)), 1.0)
    bottom = float(np.nanmin(low)) - 0.12 * span
    axes.fill_between(at, bottom, high, color=EARTH, lw=0, zorder=1)
    axes.plot(at, high, color=EARTH_RIM, lw=0.9, zorder=2)
    axes.plot(at, high + scene.limit_above_ground_m, color=RED, lw=0.9, ls=(0, (4, 2)), zorder=2)
    axes.fill_between(at, path_low, path_high, color=BLUE, lw=1.1, zorder=3)
    axes.set_ylim(bottom, float(np.nanmax(path_high)) + 0.16 * span)


def _strip_bands(axes: "Axes", scene: Scene, sortie: int, scale: float) -> None:
    """Shade the strips."""
    reached = scale * scene.waypoint_distances_m(sortie)
    strips = np.array([point.strip for point in scene.plan.sorties[sortie].waypoints])
    numbers = np.unique(strips[strips >= 0])
    if len(numbers) > MOST_BANDS:
        return
    for strip in numbers:
        own = reached[strips == strip]
        axes.axvspan(own[0], own[-1], color="#EEF3F7", lw=0, zorder=0)


def _strip_numbers(axes: "Axes", scene: Scene, sortie: int, scale: float) -> None:
    """Write the numbers of the strips above them where there is room."""
    reached = scale * scene.waypoint_distances_m(sortie)
    strips = np.array([point.strip for point in scene.plan.sorties[sortie].waypoints])
    numbers = np.unique(strips[strips >= 0])
    for strip in numbers if len(numbers) <= MOST_NUMBERED else ():
        own = reached[strips == strip]
        axes.annotate(
            str(strip + 1), (0.5 * (own[0] + own[-1]), 1.0), (0, -2), xycoords=("data", "axes fraction"),
            textcoords="offset points", ha="center", va="top", fontsize=6.5, color=GREY,
        )  # fmt: skip


def _exposure_ticks(axes: "Axes", scene: Scene, sortie: int, scale: float) -> None:
    """Mark the exposures on the path: by their shares of the way between the waypoints of their strip."""
    flight = scene.plan.sorties[sortie]
    if flight.exposures > MOST_TICKED:
        return
    rows = np.arange(flight.first_exposure, flight.first_exposure + flight.exposures)
    at = _exposure_distances_m(scene, sortie)
    heights = scene.plan.exposures.height_ellipsoid_m[rows] - scene.plan.take_off.height_ellipsoid_m
    size = float(np.clip(400.0 / flight.exposures, 1.2, 2.6))
    axes.plot(scale * at, heights, ls="", marker="o", ms=size, mfc=INK, mec="none", zorder=4)


def _exposure_distances_m(scene: Scene, sortie: int) -> Array:
    """Return the distance flown (n,) at the exposures of a sortie."""
    flight = scene.plan.sorties[sortie]
    path, reached = scene.paths_m[sortie], scene.waypoint_distances_m(sortie)
    strips = np.array([point.strip for point in flight.waypoints])
    exposures = scene.plan.exposures
    result = np.full(flight.exposures, np.nan)
    for strip in np.unique(strips[strips >= 0]):
        own = np.flatnonzero(strips == strip)
        of_strip = np.flatnonzero(exposures.strip == strip)
        places = np.column_stack(
            [
                scene.stations_m[of_strip],
                exposures.height_ellipsoid_m[of_strip] - scene.plan.take_off.height_ellipsoid_m,
            ]
        )
        result[of_strip - flight.first_exposure] = _distances_on(path[own], reached[own], places)
    return result


def _distances_on(path_m: Array, reached_m: Array, places_m: Array) -> Array:
    """Return the distance (n,) at which a path (k, 3) is nearest to places (n, 3); reached (k,) at its vertices."""
    if len(path_m) == 1:
        return np.full(len(places_m), reached_m[0])
    legs = np.diff(path_m, axis=0)
    lengths = np.maximum(np.linalg.norm(legs, axis=1), 1e-9)
    along = np.einsum("nki,ki->nk", places_m[:, None] - path_m[None, :-1], legs / lengths[:, None])
    along = np.clip(along, 0.0, lengths)
    feet = path_m[None, :-1] + along[:, :, None] * (legs / lengths[:, None])[None]
    nearest = np.argmin(np.linalg.norm(places_m[:, None] - feet, axis=2), axis=1)
    rows = np.arange(len(places_m))
    return np.asarray(reached_m[nearest] + along[rows, nearest])


def _least_clearance(axes: "Axes", profile: Profile, scene: Scene, scale: float) -> None:
    above = profile.above_ground_m
    worst = int(np.nanargmin(above))
    x, top, foot = scale * profile.distance_m[worst], profile.height_m[worst], profile.ground_m[worst]
    axes.plot([x, x], [foot, top], color=RED, lw=1.3, zorder=5)
    axes.plot([x], [top], marker="v", ms=6, color=RED, zorder=5, clip_on=False)
    right = profile.distance_m[worst] > 0.75 * profile.distance_m[-1]
    text = axes.annotate(
        f"{above[worst] - 2.0 * scene.sigma_m:.1f} m", (x, 0.5 * (foot + top)), (-5 if right else 5, 0),
        textcoords="offset points", va="center", ha="right" if right else "left", fontsize=8, color="#A33B00",
    )  # fmt: skip
    text.set(zorder=6, bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1.0})


def _above_ground(axes: "Axes", profile: Profile, scene: Scene, scale: float) -> None:
    at, low, high = _band(profile.distance_m, profile.above_ground_m)
    asked, most = scene.request.imaging.height_above_ground_m, scene.request.flight.greatest_height_above_ground_m
    axes.fill_between(scale * at, low, high, color=BLUE, lw=1.1, zorder=3)
    top = float(np.nanmax(high))
    if asked is not None and not scene.is_facade and scene.request.pattern != "orbit":
        axes.axhline(asked, color=INK, lw=0.8, ls=":", zorder=2)
        top = max(top, asked)
    if top > 0.8 * most:
        axes.axhline(most, color=RED, lw=0.9, zorder=2)
        top = max(top, most)
    bottom = float(np.nanmin(low))
    spare = 0.25 * (top - bottom) + 2.0
    axes.set_ylim(max(0.0, bottom - spare), top + spare)


# the images


def image_overlaps(scene: Scene) -> Drawing:
    """Draw forward and side overlap and the ground distance of a pixel of each image, against the request."""
    exposures, asked = scene.plan.exposures, scene.request.imaging
    figure = new_figure(5.2)
    by_number = len(exposures) <= MOST_DOTS
    panels = figure.subplots(3, 1, sharex=True) if by_number else figure.subplots(1, 3)
    if not by_number:
        figure.set_size_inches(figure.get_figwidth(), 2.7)
    shares = (
        ("Forward overlap", exposures.forward_overlap, asked.forward_overlap),
        ("Side overlap", exposures.side_overlap, asked.side_overlap),
    )
    for axes, (name, values, wanted) in zip(panels, shares, strict=False):
        if by_number:
            _share_dots(axes, name, (values, exposures.sees_area), wanted)
        else:
            _histogram(axes, f"{name} [%]", 100.0 * values[exposures.sees_area], 100.0 * wanted)
    gsd = 1e3 * exposures.gsd_m
    if by_number:
        _gsd_bars(panels[2], gsd, asked.gsd_mm)
        _sortie_borders(panels, scene)
        panels[2].set_xlabel("Exposure")
        panels[2].set_xlim(0.0, len(exposures) + 1.0)
    else:
        _histogram(panels[2], "Mean GSD [mm]", gsd[exposures.sees_area, 1], asked.gsd_mm)
        panels[0].set_ylabel("Images")
    figure.align_ylabels()
    return Drawing(
        name="overlaps", title="Overlap and pixel size", caption=_images_caption(scene, by_number), figure=figure
    )


def _images_caption(scene: Scene, by_number: bool) -> str:
    how = "of each image" if by_number else "of all images that see the area"
    text = (
        f"Overlap {how} with the next one and with the neighbouring strips, and the ground sampling distance (GSD). "
        "Dashed: the request."
    )
    if by_number:
        text += (
            " Images under it are marked by triangles; grey ones do not see the area. The bars of the GSD reach from "
            "the least to the greatest within an image."
        )
    if scene.request.pattern == "orbit":
        text += " Measured on the plane across each view through the middle of the object."
    return text


def _share_dots(axes: "Axes", name: str, values: tuple[Array, Flags], wanted: float) -> None:
    shares, sees = values
    number = np.arange(1, len(shares) + 1)
    short = sees & (shares < wanted - SHORT_BY)
    size = float(np.clip(2500.0 / max(len(shares), 1), 2.0, 12.0))
    for rows, colour, marker in ((~sees, "#BBBBBB", "o"), (sees & ~short, BLUE, "o"), (short, RED, "v")):
        axes.scatter(number[rows], 100.0 * shares[rows], s=size * (2.2 if marker == "v" else 1.0), c=colour,
                     marker=marker, lw=0, zorder=3)  # fmt: skip
    plain_axes(axes, "", f"{name} [%]")
    if not np.any(np.isfinite(shares)):
        axes.text(
            0.5,
            0.5,
            "no strips side by side to compare",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=GREY,
        )
        axes.set_yticks([])
        return
    axes.axhline(100.0 * wanted, color=INK, lw=0.9, ls=(0, (4, 2)), zorder=2)
    low = min(float(np.nanmin(shares)), wanted)
    axes.set_ylim(max(0.0, 100.0 * low - 6.0), min(101.0, 100.0 * max(float(np.nanmax(shares)), wanted) + 4.0))


def _gsd_bars(axes: "Axes", gsd_mm: Array, wanted_mm: float | None) -> None:
    number = np.arange(1, len(gsd_mm) + 1)
    axes.vlines(number, gsd_mm[:, 0], gsd_mm[:, 2], color=ORANGE, lw=float(np.clip(300.0 / len(gsd_mm), 0.4, 2.0)))
    axes.scatter(number, gsd_mm[:, 1], s=float(np.clip(2500.0 / len(gsd_mm), 2.0, 9.0)), c=INK, lw=0, zorder=3)
    if wanted_mm is not None:
        axes.axhline(wanted_mm, color=INK, lw=0.9, ls=(0, (4, 2)), zorder=2)
    plain_axes(axes, "", "GSD [mm]")
    top = max(float(np.nanquantile(gsd_mm[:, 2], 0.98)), wanted_mm or 0.0)
    axes.set_ylim(0.0, 1.15 * top)


def _sortie_borders(panels: "list[Axes]", scene: Scene) -> None:
    for flight in scene.plan.sorties[1:]:
        for axes in panels:
            axes.axvline(flight.first_exposure + 0.5, color=GREY, lw=0.6, zorder=1)


def _histogram(axes: "Axes", label: str, values: Array, wanted: float | None) -> None:
    known = values[np.isfinite(values)]
    plain_axes(axes, label, "")
    axes.grid(False, axis="x")
    if not len(known):
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", va="center", color=GREY)
        return
    low, high = np.quantile(known, [0.0, 0.999])
    axes.hist(np.minimum(known, high), bins=40, range=(float(low), float(max(high, low + 1e-6))), color=BLUE)
    if wanted is not None:
        axes.axvline(wanted, color=INK, lw=0.9, ls=(0, (4, 2)))
