"""The command line: a command for each stage. It draws progress, words results, and turns errors into one line."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from uavkit import __version__
from uavkit.core.errors import UavkitError

if TYPE_CHECKING:
    from uavkit.core.block import Block
    from uavkit.core.progress import Progress
    from uavkit.core.result import OrientedBlock
    from uavkit.project import Project

EXIT_ERROR = 2
EXIT_DEFECT = 1
EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted; run the same command again to go on"
WIDTH_OF_FILES = 400
"""Columns of a table that does not go to a terminal: a reason is not broken into lines there."""
LINES_EVERY_S = 5.0
"""Progress that does not go to a terminal: a line at the start and end of each step, and this often in between."""


def _debug_wanted() -> bool:
    return os.environ.get("UAVKIT_DEBUG", "") not in ("", "0")


class _Commands(TyperGroup):
    """The commands; whatever goes wrong inside one ends as one line on stderr and an exit status."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _end(INTERRUPTED, EXIT_INTERRUPTED)
        except UavkitError as error:
            _end(str(error), EXIT_ERROR)
        except MemoryError:
            _end("the memory does not suffice: close other programs, or give fewer --workers", EXIT_ERROR)
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except Exception as error:
            if hasattr(error, "exit_code"):  # a usage error; typer words it and exits with status 2
                raise
            what = f"{type(error).__name__}: {error}"
            _end(f"unexpected error ({what}): this is a defect of uavkit; --debug shows where", EXIT_DEFECT)


def _end(message: str, status: int) -> None:
    """Leave with a line on stderr and an exit status, with a traceback before it where the user wants to see it."""
    if _debug_wanted():
        import traceback

        traceback.print_exc()
    typer.echo(f"uavkit: {' '.join(message.split())}", err=True)
    raise SystemExit(status) from None


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Photogrammetric surveys with low-cost drones. Try it: uavkit demo OUT. Usual order: plan, ingest, process, "
    "report; 'run' does whatever is out of date.",
)

Survey = Annotated[Path, typer.Argument(help="Folder of the survey.", show_default=False)]
Workers = Annotated[int, typer.Option(min=1, max=1024, help="Threads; the result does not depend on it.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.OPTION=VALUE",
        help="An option of the processing core; may be repeated. What is not given has its default.",
    ),
]
CORES = os.cpu_count() or 1


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"uavkit {__version__}")
        raise typer.Exit


@app.callback()
def common(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Tell it.")] = False,  # noqa: ARG001
) -> None:
    """Take the options that all commands have."""
    if debug:
        os.environ["UAVKIT_DEBUG"] = "1"


Terrain = Annotated[
    Literal["embankment", "hills", "flat"], typer.Option(help="A crest of 10 m, rolling ground, or a plane.")
]
Texture = Annotated[
    Literal["mixed", "repetitive", "low_contrast"],
    typer.Option(help="Grass, gravel and soil in the sun; rows of like plants; raked sand without shadows."),
]
Outliers = Annotated[
    int | None,
    typer.Option(help="Positions that are off by 12 to 30 m; else one for every 11 stills up to 3, with RTK none."),
]


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="New folder for the simulated flight.", show_default=False)],
    flight: Annotated[
        Literal["constant", "trace"], typer.Option(help="One height, or following the ground.")
    ] = "constant",
    terrain: Terrain = "embankment",
    texture: Texture = "mixed",
    brightness_jump: Annotated[
        float, typer.Option(help="How much longer every second still is exposed, 0 to 0.6 (0.4: 40 %).")
    ] = 0.0,
    scale: Annotated[float, typer.Option(help="Size of the stills against 4000 x 3000, 0.1 to 1.")] = 1.0,
    strips: Annotated[int, typer.Option(help="Strips, 1 to 5.")] = 3,
    stations: Annotated[int, typer.Option(help="Stills in each strip, 2 to 13.")] = 11,
    video_standard: Annotated[
        Literal["ntsc", "pal", "none"], typer.Option(help="Television standard of the finder's video, or no video.")
    ] = "ntsc",
    field_order: Annotated[
        Literal["top", "bottom"], typer.Option(help="Field of a frame that comes first.")
    ] = "bottom",
    frames_between_stills: Annotated[
        float, typer.Option(help="Video frames from one still to the next, 30 to 300; fewer are a faster flight.")
    ] = 90.0,
    gnss_sigma: Annotated[
        float, typer.Option(help="Noise of the positions for each axis, m, 0 to 10; below 0.1 it is RTK.")
    ] = 1.0,
    gnss_outliers: Outliers = None,
    control_points: Annotated[int, typer.Option(help="Ground control points, 0 to 20.")] = 3,
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 1,
    workers: Workers = CORES,
) -> None:
    """Simulate a flight over a known site: stills, video, positions, control and check points, and the truth."""
    from uavkit import workflow

    usual = 0 if gnss_sigma < 0.1 else min(3, strips * stations // 11)
    outliers = usual if gnss_outliers is None else gnss_outliers
    with progress_shown() as progress:
        made = workflow.simulate(
            out,
            {
                "flight": flight,
                "terrain": terrain,
                "texture": texture,
                "brightness_jump": brightness_jump,
                "scale": scale,
                "strips": strips,
                "stations_per_strip": stations,
                "gnss_sigma_m": gnss_sigma,
                "gnss_outliers": outliers,
                "control_points": control_points,
                "video_standard": video_standard,
                "field_order": field_order,
                "frames_between_stills": frames_between_stills,
                "seed": seed,
                "workers": workers,
            },
            progress,
        )
    typer.echo(f"Simulated {strips} strips of {stations} stills: {out}")
    typer.echo(f"Go on with: {made}")


FlightLogs = Annotated[
    list[Path] | None,
    typer.Option(help="Flight log of any kind: the stills are matched with its exposures; may be repeated."),
]
ListedPositions = Annotated[
    list[Path] | None,
    typer.Option(help="KML, KMZ or CSV of the exposure positions; may be repeated, in the order of the flights."),
]
FlownPlan = Annotated[
    Path | None,
    typer.Option(help="Plan of the flight (.plan, .waypoints, its _exposures.csv): told against what was taken."),
]
HeightsFrom = Annotated[
    Literal["ellipsoid", "geoid", "unknown"] | None,
    typer.Option(help="What the heights of the positions count from; else as their file says."),
]
PixelsFrom = Annotated[
    Literal["centre", "corner"] | None,
    typer.Option(help="What (0, 0) is in the marks: centre or corner of the first pixel; else as the file says."),
]
LeverArm = Annotated[
    str, typer.Option(help="From the camera to the GNSS antenna: forward,right,down in m.", metavar="F,R,D")
]
GivenMatches = Annotated[
    Path | None, typer.Option(help="CSV that says which still belongs to which exposure, for what is ambiguous.")
]


@app.command()
def ingest(
    survey: Survey,
    images: Annotated[list[Path], typer.Option(help="Folder of the stills; may be repeated.", show_default=False)],
    camera: Annotated[
        str, typer.Option(help="As 'uavkit cameras' lists it, or a camera file; else as EXIF says.")
    ] = "",
    video: Annotated[Path | None, typer.Option(help="Video of the finder.")] = None,
    log: FlightLogs = None,
    positions: ListedPositions = None,
    plan: FlownPlan = None,
    match: GivenMatches = None,
    control_points: Annotated[Path | None, typer.Option(help="Ground control points with their marks.")] = None,
    check_points: Annotated[Path | None, typer.Option(help="Check points with their marks, held back.")] = None,
    height_datum: HeightsFrom = None,
    crs: Annotated[str, typer.Option(help="EPSG code of the results; else that of the control file, else UTM.")] = "",
    pixel_origin: PixelsFrom = None,
    lever_arm: LeverArm = "0,0,0",
    shutter_latency: Annotated[
        float, typer.Option(help="From an exposure event of a log to the exposure, s.", min=-10.0, max=10.0)
    ] = 0.0,
    latency_sigma: Annotated[
        float,
        typer.Option(
            help="How far that may be off, s: the adjustment estimates the rest; 0 holds it.", min=0.0, max=10.0
        ),
    ] = 0.1,
) -> None:
    """Bring stills, video, logs, positions and control together into a block. The originals stay where they are."""
    from uavkit import workflow
    from uavkit.project import IngestOptions, Project

    own_camera = Path(camera) if camera.lower().endswith(".toml") else None
    originals: dict[str, Path | list[Path] | None] = {
        "images": images[0] if len(images) == 1 else images,
        **{"video": video, "log": log, "positions": positions, "plan": plan, "match": match, "camera": own_camera},
        **{"control_points": control_points, "check_points": check_points},
    }
    options = IngestOptions(
        camera="" if own_camera else camera,
        height_datum=height_datum or "",
        crs=crs,
        pixel_origin=pixel_origin or "",
        lever_arm_m=_lever_arm(lever_arm),
        shutter_latency_s=shutter_latency,
        latency_sigma_s=latency_sigma,
    )
    project = Project(survey)
    with project.locked(), progress_shown() as progress:
        workflow.begin_survey(project, {role: path for role, path in originals.items() if path}, options)
        block = workflow.ingest(project, progress)
    _say(block_summary(block))
    typer.echo(f"Block: {project.block_file}\nNext: uavkit process {survey}")


def _lever_arm(text: str) -> tuple[float, float, float]:
    from uavkit.ingest.log_positions import LONGEST_ARM_M

    try:
        forward, right, down = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"--lever-arm {text!r}: give forward,right,down in metres, like 0.2,0,-0.3") from None
    if not all(abs(length) <= LONGEST_ARM_M for length in (forward, right, down)):
        raise typer.BadParameter(f"--lever-arm {text!r}: no antenna is that far from its camera: give metres")
    return forward, right, down


@app.command()
def process(survey: Survey, workers: Workers = CORES, settings: Settings = None) -> None:
    """Orient the stills: pass points, tie points, bundle block adjustment with its precision."""
    from uavkit import workflow
    from uavkit.project import Project

    project = Project(survey)
    with project.locked(), progress_shown() as progress:
        workflow.choose_settings(project, settings or [])
        oriented = workflow.process(project, workers, progress)
    _say(oriented_summary(oriented))
    typer.echo(f"Result: {project.result_file}\nNext: uavkit report {survey}")


@app.command()
def report(survey: Survey) -> None:
    """Write the report: one HTML file that needs nothing beside it."""
    from uavkit import workflow
    from uavkit.project import Project

    project = Project(survey)
    with project.locked(), progress_shown() as progress:
        page = workflow.report(project, progress)
    typer.echo(f"Report: {page}")


@app.command()
def run(survey: Survey, workers: Workers = CORES) -> None:
    """Do all stages that are out of date, with the options that the survey has."""
    from uavkit import workflow
    from uavkit.project import Project

    project = Project(survey)
    with project.locked(), progress_shown() as progress:
        done = workflow.run(project, workers, progress)
    _finish(project, done)


def _finish(project: "Project", done: list[str]) -> None:
    from uavkit import workflow

    typer.echo(f"Done: {', '.join(done)}" if done else "Nothing was out of date.")
    _say(oriented_summary(workflow.oriented_block(project)))
    typer.echo(f"Report: {workflow.report_page(project)}")


@app.command()
def status(survey: Survey) -> None:
    """Tell where a survey stands."""
    from rich.console import Console
    from rich.table import Table

    from uavkit.project import Project

    table = Table(box=None, pad_edge=False)
    for heading in ("stage", "standing", "why"):
        table.add_column(heading)
    for entry in Project(survey).status():
        table.add_row(entry.stage.value, entry.standing.value, entry.why)
    Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH_OF_FILES).print(table)


@app.command()
def export(
    survey: Survey,
    to: Annotated[Literal["colmap", "ply", "las", "laz"], typer.Option(help="Format.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="Folder to write to; else 'export' in the survey.")] = None,
) -> None:
    """Write the oriented block for other programs: a COLMAP model, or a point cloud."""
    from uavkit import workflow
    from uavkit.project import Project

    project = Project(survey)
    for path in workflow.export(project, to, out or project.folder / "export"):
        typer.echo(str(path))


@app.command()
def geotag(
    survey: Survey,
    out: Annotated[Path, typer.Option(help="Folder for the copies.", show_default=False)],
    positions: Annotated[
        Literal["adjusted", "measured"] | None,
        typer.Option(help="Of the adjusted block, or as measured; else the adjusted ones where they are there."),
    ] = None,
) -> None:
    """Write copies of the stills that carry their positions; pixels and all other data stay as they are."""
    from uavkit import workflow
    from uavkit.project import Project

    project = Project(survey)
    with progress_shown() as progress:
        found = workflow.geotag(project, out, None if positions is None else positions == "measured", progress)
    _say([f"no position, no copy: {name}: {reason}" for name, reason in found.without.items()])
    _say([f"note: {note}" for note in found.notes])
    typer.echo(f"{len(found.tags)} stills with their positions: {out}")


log = typer.Typer(no_args_is_help=True, help="Flight logs: what is in one, and its contents for other programs.")
app.add_typer(log, name="log")


@log.command("info")
def log_info(
    file: Annotated[
        Path, typer.Argument(help="A flight log of any kind; its content tells which.", show_default=False)
    ],
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for programs.")] = False,
) -> None:
    """Tell what is in a log: kind, time span, clock, positions, exposures, messages, damage."""
    import json

    from uavkit import workflow
    from uavkit.formats.log_summary import log_summary, summary_lines

    with progress_shown() as progress:
        found = workflow.flight_log(file, progress)
    _say([json.dumps(log_summary(found), indent=2, allow_nan=False)] if as_json else summary_lines(found))


@log.command("export")
def log_export(
    file: Annotated[Path, typer.Argument(help="A flight log of any kind.", show_default=False)],
    to: Annotated[Literal["csv", "kml", "gpx", "parquet"], typer.Option(help="Format.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="Folder to write to; else NAME_export here, after the log.")] = None,
) -> None:
    """Write positions, attitudes and exposures of a log for other programs."""
    from uavkit import workflow

    with progress_shown() as progress:
        written = workflow.export_log(file, to, out or Path(f"{file.name}_export"), progress)
    _say([str(path) for path in written])


@app.command()
def cameras() -> None:
    """List the cameras that are known."""
    from uavkit import workflow

    for profile in workflow.cameras():
        size = f"{profile.interior.width_px} x {profile.interior.height_px} px"
        typer.echo(
            f"{profile.name:24} {profile.maker} {', '.join(profile.models)}; {size}, {profile.focal_length_mm:g} mm"
        )


def _share(text: str | None) -> float | None:
    """Return a share from "80%" or "0.8"."""
    if text is None:
        return None
    try:
        value = float(text.strip().removesuffix("%").strip()) * (0.01 if text.strip().endswith("%") else 1.0)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no share: write 80% or 0.8") from None
    if not 0.0 <= value < 1.0:
        raise typer.BadParameter(
            f"{text!r}: an overlap is at least 0 and less than 100 %; with more no image would move on"
        )
    return value


Overlap = Annotated[str | None, typer.Option(help="Share of an image that the next one (strip) shows, like 80%.")]


@app.command()
def plan(
    area: Annotated[
        Path, typer.Argument(help="Area (KML, KMZ, GeoJSON, SHP, WKT), or a request (TOML).", show_default=False)
    ],
    camera: Annotated[str | None, typer.Option(help="As 'uavkit cameras' lists it, or a camera file.")] = None,
    height_above_ground: Annotated[float | None, typer.Option(help="m; give this or --gsd-mm.")] = None,
    gsd_mm: Annotated[float | None, typer.Option(help="Ground distance of a pixel, mm.")] = None,
    forward_overlap: Overlap = None,
    side_overlap: Overlap = None,
    terrain: Annotated[Path | None, typer.Option(help="Elevation model: GeoTIFF, .hgt, ESRI ASC.")] = None,
    terrain_datum: Annotated[
        Literal["ellipsoid", "geoid"] | None, typer.Option(help="What its heights count from, where it does not tell.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Follow the ground instead of one altitude.")] = False,
    keep_overlap: Annotated[
        bool | None,
        typer.Option("--keep-overlap/--flat-overlap", help="Keep the overlap on slopes, or on flat ground only."),
    ] = None,
    direction: Annotated[str | None, typer.Option(help="Of the strips, degrees from north, or best.")] = None,
    trigger: Annotated[
        Literal["distance", "time", "hover"] | None, typer.Option(help="What takes the pictures.")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="On the strips, m/s.")] = None,
    take_off: Annotated[str | None, typer.Option(help="Take-off point: latitude,longitude.")] = None,
    vehicle: Annotated[str | None, typer.Option(help="As 'uavkit vehicles' lists it, or a vehicle file.")] = None,
    pattern: Annotated[
        Literal["polygon", "cross_grid"] | None, typer.Option(help="Others by a request: corridor, facade, orbit.")
    ] = None,
    split: Annotated[bool, typer.Option("--split", help="Divide where the autopilot holds no more items.")] = False,
    resume_after: Annotated[int | None, typer.Option(help="Last exposure station taken: plan the rest.", min=0)] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the plan; else its name.")] = None,
    survey: Annotated[Path | None, typer.Option(help="Survey in whose folder the plan is to lie.")] = None,
) -> None:
    """Plan a flight: strips whose overlap holds on the ground as it is, and the files that ground stations fly."""
    from uavkit import workflow
    from uavkit.formats.plan_request import request_of

    given = {
        "camera": camera,
        "vehicle": vehicle,
        "pattern": pattern,
        "imaging.height_above_ground_m": height_above_ground,
        "imaging.gsd_mm": gsd_mm,
        "imaging.forward_overlap": _share(forward_overlap),
        "imaging.side_overlap": _share(side_overlap),
        "imaging.keep_overlap": keep_overlap,
        "imaging.direction_deg": _direction(direction),
        "terrain.file": str(terrain.absolute()) if terrain else None,
        "terrain.height_datum": terrain_datum,
        "terrain.follow": follow or None,
        "flight.trigger": trigger,
        "flight.speed_m_s": speed,
        "flight.take_off_deg": _place(take_off),
        "sorties.split_at_items": split or None,
    }
    request = request_of(area, given)
    folder = _plan_folder(request.name, (out, survey), resume_after)
    with progress_shown() as progress:
        made = workflow.plan(request, area.parent, folder, 0 if resume_after is None else resume_after + 1, progress)
    _say(made.lines)
    typer.echo(f"Plan: {folder}\nPage: {made.page}")


def _plan_folder(name: str, given: tuple[Path | None, Path | None], resume_after: int | None) -> Path:
    """Return where a plan goes: the folder or the survey that was given, else a folder of the plan's name.

    The rest of a flight has a folder of its own, so that it does not take the place of the whole.
    """
    out, survey = given
    if out and survey:
        raise typer.BadParameter("give --out or --survey, one of them")
    rest = "" if resume_after is None else f"_after_{resume_after}"
    return out or (survey / f"plan{rest}" if survey else Path(f"{name}{rest}"))


def _direction(text: str | None) -> float | str | None:
    if text is None or text == "best":
        return text
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"--direction {text!r}: give degrees from north, or best") from None


def _place(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        latitude, longitude = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"--take-off {text!r}: give latitude,longitude in degrees") from None
    return latitude, longitude


@app.command()
def check_plan(
    file: Annotated[Path, typer.Argument(help=".plan, .waypoints or .flightplan.json.", show_default=False)],
    camera: Annotated[str, typer.Option(help="As 'uavkit cameras' lists it, or a camera file.", show_default=False)],
    terrain: Annotated[Path | None, typer.Option(help="Elevation model: GeoTIFF, .hgt, ESRI ASC.")] = None,
    terrain_datum: Annotated[
        Literal["ellipsoid", "geoid"] | None, typer.Option(help="What its heights count from, where it does not tell.")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="At the start, m/s, where the plan tells none.")] = None,
) -> None:
    """Tell what the images of a plan will show: overlaps, ground distances, clearance. Any ground station's plan."""
    from uavkit import workflow
    from uavkit.formats.plan_request import TerrainRequest

    ground = TerrainRequest(file=str(terrain) if terrain else "", height_datum=terrain_datum or "")
    _say(workflow.check_plan(file, camera, ground, speed))


@app.command()
def vehicles() -> None:
    """List the vehicles that are known."""
    from uavkit import workflow

    for profile in workflow.vehicles():
        typer.echo(
            f"{profile.name:28} {profile.kind.value}, {profile.endurance_s / 60.0:.0f} min, {profile.payload_g:g} g, "
            f"{profile.speed_m_s:g} m/s"
        )


@app.command()
def demo(
    out: Annotated[Path, typer.Argument(help="New folder for the demonstration.", show_default=False)],
    workers: Workers = CORES,
) -> None:
    """Simulate a small survey with video and take it through the whole chain to the report."""
    from uavkit import workflow

    with progress_shown() as progress:
        project, done = workflow.demo(out, workers, progress)
    _finish(project, done)


def _say(lines: list[str]) -> None:
    for line in lines:
        typer.echo(line)


def block_summary(block: "Block") -> list[str]:
    """Return what a surveyor wants to know of a block, in lines."""
    gnss = len(block.gnss) if block.gnss is not None else 0
    lines = [
        f"{len(block.stills)} stills of {block.camera.name}, {gnss} positions, "
        f"{len(block.control_points)} control points, {len(block.check_points)} check points"
    ]
    if block.video is not None:
        lines.append(f"video: {len(block.video.places)} of {len(block.stills)} stills found in it")
    return lines + [f"note: {note}" for note in block.notes]


def oriented_summary(result: "OrientedBlock") -> list[str]:
    """Return what a surveyor wants to know of an adjusted block, in lines."""
    from uavkit.report.measures import accuracy, length_unit

    adjustment, unit = result.adjustment, length_unit(result)
    total = len(result.images) + len(result.unoriented)
    lines = [
        f"{len(result.images)} of {total} stills oriented, {len(adjustment.points_m)} points, "
        f"datum: {adjustment.datum.value}, sigma0 {adjustment.sigma0:.2f}"
        + ("" if adjustment.converged else ", PROVISIONAL: the adjustment did not converge")
    ]
    for name, points in (("control", result.control), ("check", result.check)):
        found = accuracy(points)
        if found.points:
            lines.append(
                f"{found.points} {name} points: RMSE {1e3 * found.rmse_xy_m:.1f} {unit.thousandth} in position, "
                f"{1e3 * found.rmse_z_m:.1f} {unit.thousandth} in height"
            )
    lines += [f"not oriented: {name}: {reason}" for name, reason in result.unoriented.items()]
    return lines + [f"note: {note}" for note in (*result.block.notes, *result.notes)]


@contextmanager
def progress_shown() -> Iterator["Progress"]:
    """Give a callable that shows progress on stderr: bars on a terminal, plain lines elsewhere."""
    if not sys.stderr.isatty():
        yield PlainProgress()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show


class PlainProgress:
    """Progress as lines of text."""

    def __init__(self) -> None:
        """Begin with no stage."""
        self._stage = ""
        self._began_s = self._told_s = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Tell of a stage's begin and end, and now and then of its progress, with the time left."""
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._began_s, self._told_s = stage, now_s, float("-inf")
        if done < total and now_s - self._told_s < LINES_EVERY_S:
            return
        self._told_s = now_s
        left_s = (now_s - self._began_s) / done * (total - done) if done else 0.0
        left = f", about {_duration(left_s)} left" if 0 < done < total else ""
        typer.echo(f"{stage}: {done} of {total}{left}", err=True)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
