"""The report: one HTML file that needs nothing beside it, and its figures as PNG files."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from uavkit.core.adjustment import Datum
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import AdjustmentError
from uavkit.core.progress import Progress, silent
from uavkit.core.result import OrientedBlock
from uavkit.formats.atomic import atomic_path, write_text
from uavkit.formats.html_page import document, figure_html, number, section, table_html
from uavkit.report import exposure_tables, tables
from uavkit.report.coverage import ground_surface
from uavkit.report.measures import accuracy, length_unit
from uavkit.report.relative import relative_precision
from uavkit.report.tables import PaperComparison
from uavkit.report.verdict import Remark, Weight, provisional_sentence, remarks, sigma0_sentence

PAGE_NAME = "report.html"
DATUM_TEXTS = {
    Datum.CONTROL: "ground control points",
    Datum.GNSS: "GNSS positions",
    Datum.FREE_NETWORK: "free network",
}


def write_report(
    result: OrientedBlock,
    folder: Path,
    *,
    survey: str = "",
    date: str = "",
    comparison: PaperComparison | None = None,
    progress: Progress = silent,
) -> Path:
    """Write ``report.html`` and ``figures/*.png`` into a folder and return the path of the page.

    ``survey`` is the name in the headline and ``date`` is printed below it as it stands; without them the page depends
    on the result alone, byte for byte. Raises InputError where the folder cannot be written, AdjustmentError where no
    still is oriented.
    """
    if not result.images:
        raise AdjustmentError("no still of the block is oriented: there is nothing to report")
    pictures = _figures(result, folder, progress)
    title = survey or "Photogrammetric survey"
    body = [
        _headline(result, title, date),
        _verdict(remarks(result)),
        _comparison(result, comparison),
        _accuracy_section(result, pictures),
        _block_section(result, pictures),
        _image_section(result, pictures),
        _gnss_section(result, pictures),
        _exposure_section(result, pictures),
        _interior_section(result, pictures),
        _points_section(result, pictures),
        _process_section(result),
    ]
    path = folder / PAGE_NAME
    write_text(path, document(f"{title}: report", body))
    return path


def _figures(result: OrientedBlock, folder: Path, progress: Progress) -> dict[str, str]:
    """Draw the figures, write them, and return each one's HTML by its name."""
    from uavkit.formats.drawing import png_bytes
    from uavkit.report import figures  # matplotlib comes with it

    total = figures.COUNT
    shown: dict[str, str] = {}
    for done, drawing in enumerate(figures.draw_figures(result, ground_surface(result))):
        progress("figures", done, total)
        path = folder / "figures" / f"{drawing.name}.png"
        if drawing.figure is None:
            path.unlink(missing_ok=True)  # of an earlier report
            shown[drawing.name] = f"<h3>{escape(drawing.title)}</h3><p class='soft'>{escape(drawing.absent)}</p>"
            continue
        png = png_bytes(drawing.figure)
        with atomic_path(path) as temporary:
            temporary.write_bytes(png)
        shown[drawing.name] = figure_html(drawing.title, drawing.caption, png)
    progress("figures", total, total)
    return shown


def _headline(result: OrientedBlock, title: str, date: str) -> str:
    adjusted, unit = result.adjustment, length_unit(result)
    total = len(result.images) + len(result.unoriented)
    camera = result.block.camera
    about = [f"Camera {_camera_name(camera)}", _frame_text(result)]
    lines = [f"<h1>{escape(title)}</h1>", f"<p class='soft'>Report of the bundle block adjustment{_dated(date)}</p>"]
    keys = [
        ("Stills oriented", f"{len(result.images)} of {total}", _percent(len(result.images), total)),
        ("Datum", _sentence_case(DATUM_TEXTS[adjusted.datum]), _datum_text(result)),
        ("sigma0", number(adjusted.sigma0, 2), f"redundancy {adjusted.redundancy:.0f}"),
        ("Ground sampling distance", tables.length(result.gsd_m, unit), "mean of the block"),
        *_accuracy_keys(result),
    ]
    lines.append('<div class="keys">')
    lines += [
        f'<div class="key"><span>{escape(name)}</span><b>{escape(value)}</b><span>{escape(note)}</span></div>'
        for name, value, note in keys
    ]
    lines.append("</div>")
    if not adjusted.converged:
        lines.append(f"<p><b>{escape(provisional_sentence(adjusted.iterations).text)}</b></p>")
    lines.append(f"<p>{escape(sigma0_sentence(adjusted.sigma0, adjusted.redundancy).text)}</p>")
    lines.append(f"<p class='soft'>{escape('. '.join(about))}</p>")
    return "\n".join(lines)


def _camera_name(camera: CameraProfile) -> str:
    """Return maker and name; many names begin with the maker."""
    if camera.name.casefold().startswith(camera.maker.casefold()):
        return camera.name
    return f"{camera.maker} {camera.name}"


def _sentence_case(text: str) -> str:
    return text[:1].upper() + text[1:]


def _dated(date: str) -> str:
    return f", {escape(date)}" if date else ""


def _percent(part: int, whole: int) -> str:
    return f"{100.0 * part / whole:.0f} %" if whole else "no stills"


def _datum_text(result: OrientedBlock) -> str:
    control, gnss = int(result.adjustment.control_used.sum()), int(result.adjustment.gnss_used.sum())
    return f"{control} control points, {gnss} GNSS positions used"


def _accuracy_keys(result: OrientedBlock) -> list[tuple[str, str, str]]:
    measured, unit = accuracy(result.check), length_unit(result)
    if not measured.points:
        return _predicted_keys(result)
    note = f"at {measured.points} check point{'s' if measured.points > 1 else ''}"
    return [
        ("RMSE XY (both axes)", tables.length(measured.rmse_xy_m, unit), _in_gsd(measured.rmse_xy_gsd, note)),
        ("RMSE Z", tables.length(measured.rmse_z_m, unit), _in_gsd(measured.rmse_z_gsd, note)),
    ]


def _predicted_keys(result: OrientedBlock) -> list[tuple[str, str, str]]:
    unit = length_unit(result)
    xy, z = (tables.length(value, unit) for value in tables.point_sigma_medians_m(result))
    text = "no check points: predicted, not checked"
    inner = relative_precision(result)
    if inner is None:
        return [("Predicted sigma of points, median", f"XY {xy}, Z {z}", text)]
    xy_in, z_in = (tables.median_length(values, unit) for values in (inner.point_xy_m, inner.point_z_m))
    return [
        ("Predicted absolute sigma of points", f"XY {xy}, Z {z}", f"median, with the shift of the GNSS; {text}"),
        (
            "Predicted sigma within the block",
            f"XY {xy_in}, Z {z_in}",
            "median of the points, without shift, rotation and scale by the GNSS",
        ),
    ]


def _in_gsd(value: float, note: str) -> str:
    return f"{number(value, 2)} GSD, {note}"


def _frame_text(result: OrientedBlock) -> str:
    frame = result.frame
    if frame is None:
        return "Local coordinates; the place on earth is not known."
    return (
        f"Local east-north-up frame at latitude {frame.latitude_deg:.6f}, longitude {frame.longitude_deg:.6f} degrees, "
        f"ellipsoidal height {frame.height_ellipsoid_m:.2f} m; files in {frame.crs}, heights above the ellipsoid."
    )


WEIGHT_CLASSES = {Weight.LIMIT: "limits", Weight.WATCH: "watch", Weight.GOOD: "good", Weight.NOTE: "remark"}


def _verdict(found: Sequence[Remark]) -> str:
    items = "\n".join(
        f'<li><span class="weight {WEIGHT_CLASSES[remark.weight]}">{remark.weight.value.capitalize()}</span>'
        f"<span>{escape(remark.text)}</span></li>"
        for remark in found
    )
    return f'<section class="verdict"><h2>What limits this result, and what to watch</h2><ul>{items}</ul></section>'


def _comparison(result: OrientedBlock, comparison: PaperComparison | None) -> str:
    if comparison is None:
        return ""
    return section("Comparison", table_html(tables.comparison_table(result, comparison)))


def _accuracy_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    check = "" if result.check else "<p>No check points: accuracy is predicted, not checked.</p>"
    control = "" if result.control else "<p>No ground control points.</p>"
    return section(
        "Accuracy and precision",
        table_html(tables.accuracy_table(result)) if result.check or result.control else "",
        check or table_html(tables.check_table(result)),
        control or table_html(tables.control_table(result)),
        pictures["predicted_precision"],
        table_html(tables.precision_table(result)),
        pictures["doming"],
    )


def _block_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    unoriented = table_html(tables.unoriented_table(result)) if result.unoriented else ""
    strips = tables.strips_table(result)
    return section(
        "The block",
        pictures["plan"],
        pictures["oblique"],
        pictures["overlap"],
        unoriented,
        table_html(strips) if len(strips.rows) > 1 else "",
        table_html(tables.stills_table(result)),
    )


def _image_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    return section(
        "Image observations",
        table_html(tables.groups_table(result)),
        pictures["image_residuals"],
        pictures["radial_residuals"],
        pictures["ray_counts"],
    )


def _gnss_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    if not len(result.adjustment.gnss_used):
        return section("GNSS", "<p>No GNSS position takes part in the adjustment.</p>")
    rejected = tables.gnss_rejected_table(result)
    return section(
        "GNSS",
        table_html(tables.gnss_shift_table(result)),
        pictures["gnss_residuals"],
        table_html(rejected) if rejected.rows else "<p>No GNSS position was rejected.</p>",
    )


def _exposure_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    matches = result.block.exposures
    if matches is None:
        return ""
    clocks, unused = exposure_tables.clock_table(matches), exposure_tables.unused_table(matches)
    return section(
        "Stills and exposures",
        f"<p>{escape(exposure_tables.summary_sentence(matches))}</p>",
        table_html(clocks) if clocks.rows else "<p>Nothing settles the camera's clock.</p>",
        pictures["camera_clock"],
        table_html(unused) if unused.rows else "<p>Each exposure has its still.</p>",
        table_html(exposure_tables.exposures_table(matches)),
    )


def _interior_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    return section(
        "Interior orientation",
        table_html(tables.interior_table(result)),
        pictures["interior_correlation"],
        pictures["distortion"],
    )


def _points_section(result: OrientedBlock, pictures: dict[str, str]) -> str:
    parts = [table_html(tables.points_table(result))]
    if result.candidates:
        parts.append(table_html(tables.candidates_table(result)))
    if result.pictures is not None:
        parts += [pictures["orientation_codes"], pictures["richness"], pictures["matches"]]
    return section("How the points were found", *parts)


def _process_section(result: OrientedBlock) -> str:
    if not result.seconds:
        return ""
    return section("Computing", table_html(tables.seconds_table(result)))
