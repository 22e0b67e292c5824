"""The figure of the camera's clock: what the stills' stamps say against their exposures."""

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.exposures import CameraClock, ExposureMatches
from uavkit.core.result import OrientedBlock
from uavkit.formats.drawing import BLUE, GREY, ORANGE, PALE, Drawing, new_figure, plain_axes


def camera_clock(result: OrientedBlock) -> Drawing:
    """Draw the stills' stamps against the times of their exposures, offset and drift of the clock taken off."""
    name, title = "camera_clock", "Time stamps of the stills against their exposures"
    matches = result.block.exposures
    if matches is None or not matches.clocks or all(still.event_gps_time_ns is None for still in matches.stills):
        return Drawing(name=name, title=title, caption="", absent="Nothing settles the camera's clock.")
    figure = new_figure(2.7)
    axes = figure.add_subplot()
    plain_axes(axes, "Time since the first exposure [min]", "Stamp minus exposure [s]")
    residuals = [_residuals(result, matches, clock) for clock in matches.clocks]
    widest = max(still.camera_time_resolution_ns for still in result.block.stills) * 1e-9
    axes.axhspan(-0.5 * widest, 0.5 * widest, color=PALE, alpha=0.5, label=f"resolution of the stamps, {widest:g} s")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for table, colour in zip(residuals, (BLUE, ORANGE) * len(residuals), strict=False):
        axes.plot(table[:, 0] / 60.0, table[:, 1], "o", color=colour, markersize=3.5)
    axes.legend(loc="upper right")
    caption = (
        "Each dot is a still. A camera cuts its stamps down to its resolution, so that dots fill the band evenly; "
        "dots outside it would belong to other exposures."
    )
    return Drawing(name=name, title=title, caption=caption, figure=figure)


def _residuals(result: OrientedBlock, matches: ExposureMatches, clock: CameraClock) -> Array:
    """Return time since the first exposure and the residual of the stamp's middle, both in s, (k, 2)."""
    known = [entry.event_gps_time_ns for entry in matches.stills if entry.event_gps_time_ns is not None]
    first_ns = min(known, default=0)
    stills = {still.name: still for still in result.block.stills}
    wanted, rows = set(clock.stills), []
    for entry in matches.stills:
        still = stills.get(entry.still)
        if (
            entry.still not in wanted
            or entry.event_gps_time_ns is None
            or still is None
            or still.camera_time_ns is None
        ):
            continue
        since_s = (entry.event_gps_time_ns - clock.reference_gps_ns) * 1e-9
        shown_s = (still.camera_time_ns - clock.reference_gps_ns) * 1e-9 + 0.5e-9 * still.camera_time_resolution_ns
        since_first_s = (entry.event_gps_time_ns - first_ns) * 1e-9
        rows.append((since_first_s, shown_s - since_s * (1.0 + clock.drift_ppm * 1e-6) - clock.offset_s))
    return np.array(rows, dtype=np.float64).reshape(-1, 2)
