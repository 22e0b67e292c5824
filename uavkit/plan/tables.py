"""The figures of a plan in words and numbers: for the page, for the command line, and as JSON."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uavkit.core.flightplan import FlightPlan, PlanSummary, Trigger
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.surface import ElevationGrid
from uavkit.formats.atomic import write_text
from uavkit.formats.html_page import NOTHING, Table, number
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan.planner import Planned

FOLD_ABOVE = 30
"""Tables with more rows than this are folded."""
VERTICAL_DEG = 1e-6
"""The ends of a vertical strip lie less than this apart in latitude and longitude: a decimetre."""
JSON_FORMAT = "uavkit plan summary 1"
TRIGGERS = {
    Trigger.DISTANCE: "by distance",
    Trigger.TIME: "by time",
    Trigger.HOVER: "standing still at each station",
}


# texts of numbers


def percent(share: float) -> str:
    """Return a share as text; only what is whole is written as 100 %."""
    if not math.isfinite(share):
        return NOTHING
    return "100 %" if share >= 1.0 else f"{min(100.0 * share, 99.9):.1f} %"


def area_text(area_m2: float) -> str:
    """Return an area in the unit that fits."""
    if not math.isfinite(area_m2):
        return NOTHING
    if area_m2 < 1e4:
        return f"{area_m2:.0f} m²"
    return f"{1e-4 * area_m2:.2f} ha" if area_m2 < 1e6 else f"{1e-6 * area_m2:.2f} km²"


def length_text(length_m: float) -> str:
    """Return a length flown in metres or kilometres."""
    return f"{length_m:.0f} m" if length_m < 1000.0 else f"{1e-3 * length_m:.1f} km"


def duration_text(duration_s: float) -> str:
    """Return a duration in minutes, or hours and minutes."""
    minutes = round(duration_s / 60.0)
    if minutes < 90:
        return f"{duration_s / 60.0:.1f} min"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _millimetres(values_m: Sequence[float]) -> str:
    decimals = 1 if max(values_m) < 0.1 else 0
    return " / ".join(number(1e3 * value, decimals) for value in values_m)


def _percents(shares: Sequence[float]) -> str:
    return " / ".join(number(100.0 * share, 1) for share in shares)


# key figures


MISSED = "missed"
SHORT_BY = 0.01
"""A least overlap under the request by more than this is missed."""


def key_table(planned: Planned, request: PlanRequest) -> Table:
    """Return what the plan costs and gives, against what was asked."""
    summary = planned.plan.summary
    rows = [*_cost_rows(summary), *_image_rows(summary, request), *_limit_rows(summary, request)]
    header = ("", "Planned", "Asked", "Met")
    return Table(title="What it costs, and what it gives", header=header, rows=tuple(rows))


Row = tuple[str, str, str, str]


def _cost_rows(summary: PlanSummary) -> list[Row]:
    rows = (
        ("Area", area_text(summary.area_m2)),
        ("Images", str(summary.images)),
        ("Strips", str(summary.strips)),
        ("Sorties", str(summary.sorties)),
        ("Length flown", length_text(summary.length_m)),
        ("Time of flight", duration_text(summary.duration_s)),
    )
    return [(name, value, "", "") for name, value in rows]


def _image_rows(summary: PlanSummary, request: PlanRequest) -> list[Row]:
    imaging = request.imaging
    gsd = f"{imaging.gsd_mm:g}" if imaging.gsd_mm is not None else ""
    height = f"{imaging.height_above_ground_m:g}" if imaging.height_above_ground_m is not None else ""
    if request.pattern == "facade" and height:
        height += " from the facade"
    heights = " / ".join(number(value, 1) for value in summary.height_above_ground_m)
    return [
        ("GSD, least / mean / greatest [mm]", _millimetres(summary.gsd_m), gsd, ""),
        _overlap_row("Forward", summary.forward_overlap, imaging.forward_overlap),
        _overlap_row("Side", summary.side_overlap, imaging.side_overlap),
        ("Height above ground, least / mean / greatest [m]", heights, height, ""),
    ]


def _overlap_row(name: str, shares: tuple[float, float], asked: float) -> Row:
    known = math.isfinite(shares[0])
    wanted = f"{100.0 * asked:g}" if known else ""
    return f"{name} overlap, least / mean [%]", _percents(shares), wanted, _met(shares[0] - asked + SHORT_BY)


def _limit_rows(summary: PlanSummary, request: PlanRequest) -> list[Row]:
    imaging, flight, clearance = request.imaging, request.flight, request.terrain.least_clearance_m
    images = imaging.least_images
    rows = [
        (
            "Least clearance of the path [m]", number(summary.least_clearance_m, 1), f"{clearance:g} or more",
            _met(summary.least_clearance_m - clearance + 1e-6),
        ),
        (
            "Fewest images of a place of the area", str(summary.least_images), f"{images} or more",
            _met(summary.least_images - images),
        ),
        (
            f"Area seen by {images} images or more", percent(summary.covered_enough), "100 %",
            _met(summary.covered_enough - 1.0),
        ),
        ("Area seen by one image or more", percent(summary.covered), "100 %", _met(summary.covered - 1.0)),
    ]  # fmt: skip
    motions = (
        ("Motion blur [px]", summary.motion_blur_px, flight.most_motion_blur_px, 2),
        ("Motion between video frames [px]", summary.video_motion_px, flight.most_video_motion_px, 1),
    )
    rows += [
        (name, number(value, decimals), f"{most:g} or less", _met(most - value + 1e-6))
        for name, value, most, decimals in motions
        if math.isfinite(value)
    ]
    return rows


def _met(spare: float) -> str:
    """Return whether a figure with so much to spare meets the request; empty where there is no figure."""
    if not math.isfinite(spare):
        return ""
    return "yes" if spare >= 0.0 else MISSED


def summary_lines(planned: Planned, request: PlanRequest) -> list[str]:
    """Return the key figures and the notes as aligned lines of text, without line ends."""
    rows = key_table(planned, request).rows
    names = max(len(row[0]) for row in rows)
    values = max(len(row[1]) for row in rows)
    lines = [planned.plan.name]
    for name, value, asked, met in rows:
        line = f"  {name:<{names}}  {value:>{values}}"
        line += f"   (asked: {asked}{', ' + met if met == MISSED else ''})" if asked else ""
        lines.append(line)
    return [*lines, *(f"  note: {note}" for note in planned.plan.notes)]


# sorties and strips


def sorties_table(plan: FlightPlan, items: Sequence[int] = ()) -> Table:
    """Return the sorties; with the number of mission items of each where they are given."""
    header: tuple[str, ...] = ("Sortie", "Strips", "Images", "Waypoints", "Length [m]", "Duration [min]", "Climb [m]")
    rows: list[tuple[str, ...]] = []
    for at, sortie in enumerate(plan.sorties):
        last = sortie.first_exposure + sortie.exposures - 1
        strips = plan.exposures.strip[sortie.first_exposure] + 1, plan.exposures.strip[last] + 1
        row = (
            str(at + 1), f"{strips[0]}–{strips[1]}" if strips[0] != strips[1] else str(strips[0]),
            str(sortie.exposures), str(len(sortie.waypoints)), number(sortie.length_m, 0),
            number(sortie.duration_s / 60.0, 1), number(sortie.climb_m, 0),
        )  # fmt: skip
        rows.append((*row, str(items[at])) if items else row)
    if items:
        header += ("Mission items",)
    return Table(
        title="Sorties", header=header, rows=tuple(rows), note=_repeated_note(plan), folded=len(rows) > FOLD_ABOVE
    )


def _repeated_note(plan: FlightPlan) -> str:
    repeated = len(plan.exposures) - len(np.unique(plan.exposures.station))
    if not repeated:
        return ""
    return f"{repeated} exposures are taken twice, so that the sorties' images overlap."


def strips_table(plan: FlightPlan) -> Table:
    """Return the strips with what their images give."""
    header: tuple[str, ...] = ("Strip", "Area", "Direction [°]", "Base [m]", "Images", "Length [m]", "Sortie")
    header += ("Height above ground [m]", "Forward, least [%]", "Side, least [%]", "GSD, mean [mm]")
    exposures = plan.exposures
    rows = []
    for at, strip in enumerate(plan.strips):
        own = slice(strip.first_exposure, strip.first_exposure + strip.exposures)
        above = exposures.height_above_ground_m[own]
        rows.append(
            (
                str(at + 1), strip.area, _direction(plan, at), number(strip.base_m, 2), str(strip.exposures),
                number(strip.base_m * (strip.exposures - 1), 0), str(int(exposures.sortie[strip.first_exposure]) + 1),
                f"{above.min():.1f} to {above.max():.1f}", _least_percent(exposures.forward_overlap[own]),
                _least_percent(exposures.side_overlap[own]), number(1e3 * float(exposures.gsd_m[own, 1].mean()), 1),
            )
        )  # fmt: skip
    return Table(title="Strips", header=header, rows=tuple(rows), folded=len(rows) > FOLD_ABOVE)


def _direction(plan: FlightPlan, strip: int) -> str:
    """Return the direction of a strip; of a vertical one whether it goes up or down."""
    own = plan.strips[strip]
    first, last = own.first_exposure, own.first_exposure + own.exposures - 1
    exposures = plan.exposures
    north = exposures.latitude_deg[last] - exposures.latitude_deg[first]
    east = exposures.longitude_deg[last] - exposures.longitude_deg[first]
    up = float(exposures.height_ellipsoid_m[last] - exposures.height_ellipsoid_m[first])
    if abs(up) > 0.5 and max(abs(north), abs(east)) < VERTICAL_DEG:
        return "up" if up > 0.0 else "down"
    return number(own.direction_deg, 1)


def _least_percent(shares: "np.ndarray[Any, np.dtype[np.float64]]") -> str:
    known = shares[np.isfinite(shares)]
    return number(100.0 * float(known.min()), 1) if len(known) else NOTHING


# where things are taken from


def request_table(planned: Planned, request: PlanRequest) -> Table:
    """Return what was asked for."""
    imaging, flight, plan = request.imaging, request.flight, planned.plan
    asked = [
        ("Pattern", _pattern_text(request)),
        ("Areas", ", ".join(area.name for area in plan.areas)),
        ("Camera", f"{plan.camera}, longer side of the image {imaging.long_side} the flight"),
        ("Vehicle", plan.vehicle or "none named"),
        ("Forward and side overlap", f"{100 * imaging.forward_overlap:g} % and {100 * imaging.side_overlap:g} %"),
        ("Images of each place", f"{imaging.least_images} or more"),
        ("Heights", _heights_text(request, has_terrain=bool(plan.terrain))),
        (
            "Exposures",
            TRIGGERS[plan.trigger] + (f", {flight.hold_s:g} s each" if plan.trigger is Trigger.HOVER else ""),
        ),
        ("Greatest height above ground", f"{flight.greatest_height_above_ground_m:g} m"),
        ("Wind allowed for", f"{flight.wind_m_s:g} m/s"),
    ]
    if flight.shutter_s is not None:
        asked.append(("Exposure time", f"{flight.shutter_s:g} s"))
    if flight.video_frames_per_s is not None:
        asked.append(("Video", f"{flight.video_frames_per_s:g} frames/s, {flight.video_width_px} px wide"))
    if plan.vehicle:
        asked.append(("Reserve of the battery", f"{100 * request.sorties.reserve:g} %"))
    return Table(title="Request", header=("", "Asked for"), rows=tuple(asked))


def _pattern_text(request: PlanRequest) -> str:
    if request.pattern == "cross_grid":
        factor = request.cross_grid.height_factor
        return "cross grid" + (f", second height {factor:g} times the first" if factor != 1.0 else "")
    if request.pattern == "corridor" and request.corridor is not None:
        return f"corridor, {request.corridor.width_m:g} m wide"
    if request.pattern == "facade" and request.facade is not None:
        return f"facade, {request.facade.height_m:g} m high"
    if request.pattern == "orbit" and request.orbit is not None:
        rings = f"{request.orbit.rings} circle{'s' if request.orbit.rings > 1 else ''}"
        return f"orbit, {rings} of {request.orbit.radius_m:g} m radius"
    direction = request.imaging.direction_deg
    return "polygon strips, " + ("best direction" if direction == "best" else f"direction {direction:g}°")


def _heights_text(request: PlanRequest, *, has_terrain: bool) -> str:
    imaging = request.imaging
    if request.pattern == "orbit":
        return f"{imaging.height_above_ground_m:g} m above the ground in the middle, lowest circle"
    if imaging.height_above_ground_m is not None:
        wanted = f"{imaging.height_above_ground_m:g} m"
    else:
        wanted = f"for {imaging.gsd_mm:g} mm GSD"
    if request.pattern == "facade":
        return f"{wanted} from the facade"
    if request.terrain.follow:
        return f"{wanted} above the ground, followed within {100 * request.terrain.tolerance:g} %"
    if not has_terrain:
        return f"{wanted} above the ground, taken as level"
    return f"{wanted} above the {'highest' if imaging.keep_overlap else 'mean'} ground, one altitude"


def source_lines(planned: Planned, request: PlanRequest, elevation: ElevationGrid | None) -> list[str]:
    """Return sentences on the take-off point, on what altitudes count from, and on where the ground comes from."""
    start = planned.plan.take_off
    undulation = float(geoid_undulation_m(np.array(start.latitude_deg), np.array(start.longitude_deg)))
    chosen = "chosen by the planner" if start.chosen else "as requested"
    lines = [
        f"Take-off point, {chosen}: latitude {start.latitude_deg:.7f}, longitude {start.longitude_deg:.7f} degrees."
    ]
    if elevation is None:
        lines.append(
            "No terrain model: the ground is taken as level with the take-off point. Heights above ground, overlaps "
            "and clearances hold only where it is."
        )
    else:
        lines[0] += (
            f" Its ground is {start.height_ellipsoid_m:.1f} m above the ellipsoid of WGS 84, "
            f"{start.height_ellipsoid_m - undulation:.1f} m above sea level (EGM96)."
        )
        lines.append(
            f"The ground is taken from {elevation.source}, with a stated error of {elevation.sigma_m:g} m (1 sigma); "
            "clearances are given less twice this error. Trees, buildings and wires are in it only as far as the "
            "model contains them."
        )
    if request.flight.altitude_from == "take_off":
        lines.append("Altitudes of the mission count from the take-off point: start from there and nowhere else.")
    else:
        lines.append(
            "Altitudes of the mission count from sea level (EGM96): the autopilot's altitude must be right in itself."
        )
    return lines


# JSON


def write_summary_json(path: Path, planned: Planned, request: PlanRequest) -> None:
    """Write the key figures as JSON, units in the names, null for what does not exist.

    Raises InputError where the file cannot be written.
    """
    document = _plain(_summary_document(planned, request))
    write_text(path, json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def _summary_document(planned: Planned, request: PlanRequest) -> dict[str, Any]:
    plan, summary = planned.plan, planned.plan.summary
    imaging, start = request.imaging, plan.take_off
    return {
        "format": JSON_FORMAT,
        "name": plan.name,
        "pattern": request.pattern,
        "camera": plan.camera,
        "vehicle": plan.vehicle,
        "trigger": plan.trigger.value,
        "terrain": plan.terrain,
        "areas": [area.name for area in plan.areas],
        "area_m2": summary.area_m2,
        "images": summary.images,
        "strips": summary.strips,
        "length_m": summary.length_m,
        "duration_s": summary.duration_s,
        "gsd_m": _named(("least", "mean", "greatest"), summary.gsd_m),
        "forward_overlap": {"asked": imaging.forward_overlap, **_named(("least", "mean"), summary.forward_overlap)},
        "side_overlap": {"asked": imaging.side_overlap, **_named(("least", "mean"), summary.side_overlap)},
        "height_above_ground_m": _named(("least", "mean", "greatest"), summary.height_above_ground_m),
        "least_clearance_m": {"asked": request.terrain.least_clearance_m, "least": summary.least_clearance_m},
        "images_of_a_place": {"asked": imaging.least_images, "least": summary.least_images},
        "covered_by_one_image": summary.covered,
        "covered_by_as_many_as_asked": summary.covered_enough,
        "motion_blur_px": summary.motion_blur_px,
        "video_motion_px": summary.video_motion_px,
        "take_off": {
            "latitude_deg": start.latitude_deg,
            "longitude_deg": start.longitude_deg,
            "height_ellipsoid_m": start.height_ellipsoid_m if plan.terrain else float("nan"),
            "chosen_by_planner": start.chosen,
        },
        "altitude_from": request.flight.altitude_from,
        "sorties": [
            {
                "images": sortie.exposures,
                "waypoints": len(sortie.waypoints),
                "length_m": sortie.length_m,
                "duration_s": sortie.duration_s,
                "climb_m": sortie.climb_m,
            }
            for sortie in plan.sorties
        ],
        "notes": list(plan.notes),
    }


def _named(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def _plain(value: Any) -> Any:
    """Return a value for JSON: what is not finite becomes null, lengths keep 0.1 mm, shares 1e-6."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.10g}") if math.isfinite(value) else None
    return value
