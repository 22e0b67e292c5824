"""What all figures have in common: style, colours, and the bytes of a picture. Imports matplotlib."""

import io
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from uavkit.core.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours (2008), told apart by all kinds of colour vision.
BLUE, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
INK, GREY, PALE = "#222222", "#777777", "#D9D9D9"
AXIS_COLOURS = (BLUE, ORANGE, GREEN)
AXIS_NAMES = ("East", "North", "Up")
HEIGHT_COLOURS = "viridis"

WIDTH_IN = 7.4
DPI = 160
STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "axes.titlesize": 9.5,
    "axes.titley": 1.0,
    "axes.labelsize": 9.0,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "text.parse_math": False,  # names of stills and points may hold a dollar sign
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """A figure with its caption; ``absent`` says why there is none."""

    name: str
    """Of the file, without suffix."""
    title: str
    caption: str
    figure: Figure | None = None
    absent: str = ""


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Return an empty figure of the report's width."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with warnings.catch_warnings(), mpl.rc_context(STYLE):
        # A name in a script that the font lacks is drawn with boxes; the tables have it in full.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()


def shortened(name: str, length: int = 16) -> str:
    """Return a name that fits a figure: its end tells more than its beginning."""
    return name if len(name) <= length else "…" + name[-(length - 1) :]


def plain_axes(axes: "Axes", xlabel: str, ylabel: str) -> None:
    """Label the axes and draw a faint grid."""
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.grid(True)


def reach(values: Array, share: float = 1.0, least: float = 1e-9) -> float:
    """Return the size that ``share`` of the finite absolute values does not exceed, at least ``least``."""
    finite = np.abs(values[np.isfinite(values)])
    return max(float(np.quantile(finite, share)), least) if finite.size else least


def round_number(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-12)) * power)
