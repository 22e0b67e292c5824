"""The figures of one still: orientation codes, their richness, and matches with the next still."""

import colorsys
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import ConnectionPatch

from uavkit.core.arrays import Array, Image
from uavkit.core.result import OrientedBlock
from uavkit.formats.drawing import GREY, INK, ORANGE, WIDTH_IN, Drawing, new_figure, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CODES = 16
MOST_LINES = 60
NO_PICTURES = "The pictures of orientation codes were not kept for this survey."


def code_colours() -> Array:
    """Return the colours of codes 0 to 15 and of "no code", shape (17, 3), 0 to 1.

    Lightness goes round with the hue, so that opposite directions differ in grey as well.
    """
    colours = []
    for code in range(CODES):
        lightness = 0.55 + 0.2 * np.sin(2.0 * np.pi * code / CODES)
        colours.append(colorsys.hls_to_rgb(code / CODES, lightness, 0.85))
    return np.array([*colours, (0.0, 0.0, 0.0)])


def code_picture(result: OrientedBlock) -> Drawing:
    """Draw a still in grey and its orientation codes in colour."""
    name, title = "orientation_codes", "Orientation codes"
    pictures = result.pictures
    if pictures is None:
        return Drawing(name=name, title=title, caption="", absent=NO_PICTURES)
    coded = np.asarray(code_colours()[np.minimum(pictures.codes, CODES)] * 255.0, dtype=np.uint8)
    figure = new_figure(0.5 * WIDTH_IN * pictures.grey.shape[0] / pictures.grey.shape[1] + 0.25)
    left, right = figure.subplots(1, 2)
    left.imshow(pictures.grey, cmap="gray", vmin=0, vmax=255)
    right.imshow(coded, interpolation="nearest")
    left.set_title(f"Grey values of {shortened(pictures.still, 24)}", loc="left")
    right.set_title("Orientation codes", loc="left")
    for axes in (left, right):
        axes.set_axis_off()
    wheel = right.inset_axes((0.79, 0.70, 0.2, 0.28), projection="polar")
    angles = 2.0 * np.pi * (np.arange(CODES) + 0.5) / CODES
    wheel.bar(angles, 1.0, width=2.0 * np.pi / CODES, bottom=0.55, color=code_colours()[:CODES])
    wheel.set_axis_off()
    # Rows run downwards, and so do the angles of gradients.
    wheel.set_theta_direction(-1)
    wheel.patch.set_alpha(0.0)
    caption = "Each of the 16 codes is a direction of the grey value gradient (wheel: its colour); black: no code."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def richness_picture(result: OrientedBlock) -> Drawing:
    """Draw the richness of the orientation codes."""
    name, title = "richness", "Richness of orientation codes"
    pictures = result.pictures
    if pictures is None:
        return Drawing(name=name, title=title, caption="", absent=NO_PICTURES)
    figure = new_figure(
        0.62 * WIDTH_IN * pictures.richness.shape[0] / pictures.richness.shape[1] + 0.2, 0.72 * WIDTH_IN
    )
    axes = figure.add_subplot()
    shown = axes.imshow(pictures.richness, cmap="gray", vmin=0.0, vmax=max(float(np.nanmax(pictures.richness)), 1e-6))
    axes.set_axis_off()
    figure.colorbar(shown, ax=axes, label="Richness", shrink=0.8, pad=0.02)
    caption = f"Richness (entropy) of the codes in {pictures.still}; candidate points are chosen where it is bright."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def matches_picture(result: OrientedBlock) -> Drawing:
    """Draw the matches of a still with the next one."""
    name, title = "matches", "Matches with the next still"
    pictures = result.pictures
    if pictures is None:
        return Drawing(name=name, title=title, caption="", absent=NO_PICTURES)
    figure = new_figure(0.5 * WIDTH_IN * pictures.grey.shape[0] / pictures.grey.shape[1] + 0.25)
    left, right = figure.subplots(1, 2)
    _still_with_points(left, pictures.grey, pictures.matches[:, :2], pictures.still)
    _still_with_points(right, pictures.next_grey, pictures.matches[:, 2:], pictures.next_still)
    # A regular choice of lines over the rows of the picture; all at once would hide it.
    order = np.argsort(pictures.matches[:, 1], kind="stable")
    drawn = order[:: -(-len(order) // MOST_LINES) or 1]
    for row in drawn:
        a_column, a_row, b_column, b_row = pictures.matches[row].tolist()
        a, b = (a_column, a_row), (b_column, b_row)
        line = ConnectionPatch(a, b, "data", "data", axesA=left, axesB=right, color=ORANGE, lw=0.5, alpha=0.8)
        line.set_in_layout(False)
        figure.add_artist(line)
    count = len(pictures.matches)
    caption = f"{count} points matched between {pictures.still} and {pictures.next_still}"
    caption += f"; lines for {len(drawn)} of them." if count > len(drawn) else "."
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _still_with_points(axes: "Axes", grey: Image, xy: Array, name: str) -> None:
    axes.imshow(grey, cmap="gray", vmin=0, vmax=255)
    axes.scatter(xy[:, 0], xy[:, 1], s=7, fc=ORANGE, ec=INK, lw=0.3)
    axes.set(xlim=(-0.5, grey.shape[1] - 0.5), ylim=(grey.shape[0] - 0.5, -0.5))
    axes.set_axis_off()
    axes.set_title(shortened(name, 32), loc="left", color=GREY)


ALL: tuple[Callable[[OrientedBlock], Drawing], ...] = (code_picture, richness_picture, matches_picture)
