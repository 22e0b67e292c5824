"""The page of a plan: one HTML file that needs nothing beside it; and its pictures on one sheet."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from uavkit.core.surface import ElevationGrid
from uavkit.formats.atomic import atomic_path, write_text
from uavkit.formats.html_page import document, figure_html, number, section, table_html
from uavkit.formats.plan_request import PlanRequest
from uavkit.plan import tables
from uavkit.plan.planner import Planned
from uavkit.plan.scene import Scene


def write_plan_page(
    path: Path,
    planned: Planned,
    request: PlanRequest,
    elevation: ElevationGrid | None = None,
    items: Sequence[int] = (),
) -> None:
    """Write a plan as one HTML page with its pictures in it.

    items: number of mission items of each sortie, shown where given. The page depends on the plan alone, byte for
    byte. Raises InputError where the file cannot be written.
    """
    pictures = _pictures(Scene(planned=planned, request=request, elevation=elevation))
    plan = planned.plan
    sources = tables.source_lines(planned, request, elevation)
    body = [
        _headline(planned, request, elevation),
        _watch(planned, request),
        section("Figures", table_html(tables.key_table(planned, request))),
        section("The flight", pictures["plan"], *(_paragraph(line) for line in sources)),
        section("Coverage", pictures["coverage"]),
        section("What was asked", table_html(tables.request_table(planned, request))),
        section("Heights and overlap", pictures["profile"], pictures["overlaps"]),
        section(
            "Sorties and strips", table_html(tables.sorties_table(plan, items)), table_html(tables.strips_table(plan))
        ),
    ]
    write_text(path, document(f"{plan.name}: flight plan", body))


def write_plan_picture(
    path: Path, planned: Planned, request: PlanRequest, elevation: ElevationGrid | None = None
) -> None:
    """Write map, coverage and height profile of a plan on one sheet, a PNG file.

    Raises InputError where the file cannot be written.
    """
    from uavkit.formats.drawing import png_bytes
    from uavkit.plan.figures import plan_sheet

    png = png_bytes(plan_sheet(Scene(planned=planned, request=request, elevation=elevation)))
    with atomic_path(path) as temporary:
        temporary.write_bytes(png)


def _pictures(scene: Scene) -> dict[str, str]:
    """Draw the pictures and return each one's HTML by its name."""
    from uavkit.formats.drawing import png_bytes
    from uavkit.plan.figures import draw_figures

    shown = {}
    for drawing in draw_figures(scene):
        assert drawing.figure is not None
        shown[drawing.name] = figure_html(drawing.title, drawing.caption, png_bytes(drawing.figure))
    return shown


def _headline(planned: Planned, request: PlanRequest, elevation: ElevationGrid | None) -> str:
    summary = planned.plan.summary
    keys = [
        ("Images", str(summary.images), f"in {summary.strips} strip{_s(summary.strips)}"),
        ("Flight", tables.duration_text(summary.duration_s), _flight_text(planned)),
        ("Area", tables.area_text(summary.area_m2), _coverage_text(planned, request)),
        ("Ground sampling distance", f"{1e3 * summary.gsd_m[1]:.1f} mm", "mean of all images"),
        ("Least overlap", _overlap_text(planned), "forward, side"),
        ("Least clearance", f"{number(summary.least_clearance_m, 1)} m", _clearance_text(elevation)),
    ]
    cells = [
        f'<div class="key"><span>{escape(name)}</span><b>{escape(value)}</b><span>{escape(note)}</span></div>'
        for name, value, note in keys
    ]
    about = _paragraph(request.about) if request.about else ""
    subtitle = f"Flight plan, camera {planned.plan.camera}"
    subtitle += f", {planned.plan.vehicle}" if planned.plan.vehicle else ""
    return "\n".join(
        [
            f"<h1>{escape(planned.plan.name)}</h1>",
            f"<p class='soft'>{escape(subtitle)}</p>",
            about,
            '<div class="keys">',
            *cells,
            "</div>",
        ]
    )


def _flight_text(planned: Planned) -> str:
    summary = planned.plan.summary
    sorties = "one sortie" if summary.sorties == 1 else f"{summary.sorties} sorties"
    return f"{tables.length_text(summary.length_m)}, {sorties}"


def _coverage_text(planned: Planned, request: PlanRequest) -> str:
    share = tables.percent(planned.plan.summary.covered_enough)
    return f"{share} seen by {request.imaging.least_images} images or more"


def _overlap_text(planned: Planned) -> str:
    forward, side = planned.plan.summary.forward_overlap[0], planned.plan.summary.side_overlap[0]
    return f"{number(100.0 * forward, 1)} %, {number(100.0 * side, 1)} %"


def _clearance_text(elevation: ElevationGrid | None) -> str:
    if elevation is None:
        return "above ground taken as level"
    return f"above the terrain model, less {2.0 * elevation.sigma_m:g} m"


def _s(count: int) -> str:
    return "" if count == 1 else "s"


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _watch(planned: Planned, request: PlanRequest) -> str:
    """Return what the plan misses and what the planner has to say, set apart so that nobody overlooks it."""
    rows = tables.key_table(planned, request).rows
    items = [
        ("limits", "Missed", f"{name}: {value}, asked for: {asked}.")
        for name, value, asked, met in rows
        if met == tables.MISSED
    ]
    items += [("watch", "Note", _sentence(note)) for note in planned.plan.notes]
    if not items:
        return ""
    shown = "\n".join(
        f"<li><span class='weight {kind}'>{word}</span><span>{escape(text)}</span></li>" for kind, word, text in items
    )
    return f'<section class="verdict"><h2>What to watch</h2><ul>{shown}</ul></section>'


def _sentence(text: str) -> str:
    text = text[:1].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."
