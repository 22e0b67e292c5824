"""The chain, on one screen: load, call, save. The only module that knows all stages."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavkit.core.block import Block
from uavkit.core.camera import CameraProfile
from uavkit.core.errors import InputError
from uavkit.core.heights import HeightDatum
from uavkit.core.progress import Progress, silent
from uavkit.core.result import OrientedBlock
from uavkit.formats.adjustment_file import read_oriented_block, write_adjustment, write_oriented_block
from uavkit.formats.atomic import write_text
from uavkit.formats.block_file import read_block, write_block
from uavkit.formats.camera_profiles import camera_folder, load_camera, read_camera
from uavkit.formats.control_file import ControlFileOptions, PixelOrigin, SurveyedPoints, read_surveyed_points
from uavkit.formats.image_files import FileStillSource
from uavkit.formats.kml import KmlPositions
from uavkit.formats.match_file import read_matches, write_matches
from uavkit.formats.positions_file import ImagePositions, joined_image_positions, read_image_positions
from uavkit.formats.video import FileVideoSource
from uavkit.project import IngestOptions, Manifest, Original, Project, Stage, Standing

if TYPE_CHECKING:
    from uavkit.core.flight_log import FlightLog
    from uavkit.core.vehicle import VehicleProfile
    from uavkit.formats.plan_request import PlanRequest, TerrainRequest
    from uavkit.products.geotags import StillTags

SIMULATION_LABEL = "simulation.json"
"""Beside simulated stills: which flight they repeat. It holds no truth."""
MATCHES = "exposures.csv"
"""In the folder of ingest: which still has which exposure; a copy of it, edited, is what --match takes."""
AS_IN_THE_PAPER: Mapping[str, Any] = {
    "terrain": "embankment",
    "texture": "mixed",
    "brightness_jump": 0.0,
    "gnss_sigma_m": 1.0,
    "control_points": 3,
}
"""Options of a simulated flight that is like one of the paper's."""


@dataclass(frozen=True, kw_only=True)
class PlanMade:
    """What to tell of a plan."""

    lines: list[str]
    page: Path


DEMO: Mapping[str, Any] = {
    "flight": "trace",
    "scale": 0.25,
    "strips": 2,
    "stations_per_strip": 6,
    "frames_between_stills": 45.0,
    "gnss_outliers": 1,
    "check_points": 8,
}


def simulate(out: Path, values: Mapping[str, Any], progress: Progress = silent) -> str:
    """Simulate a flight with options by name, and return the command that ingests it."""
    from uavkit.simulate.survey import ingest_arguments, simulate_survey

    options = _simulation_options(values)
    made = simulate_survey(out, options, progress)
    label = {name: values.get(name) for name in ("flight", "scale", "strips", "stations_per_strip")}
    if any(values.get(name, usual) != usual for name, usual in AS_IN_THE_PAPER.items()):
        label["flight"] = None  # another site or other positions: the paper has no such flight
    write_text(made.stills / SIMULATION_LABEL, json.dumps(label) + "\n")
    return " ".join(["uavkit ingest SURVEY", *(f"{name} {path}" for name, path in ingest_arguments(made, options))])


def plan(
    source: "PlanRequest", beside: Path, out: Path, first_station: int = 0, progress: Progress = silent
) -> "PlanMade":
    """Plan a flight by a request whose paths count from a folder, and write its files to a folder."""
    from uavkit.plan.inputs import read_inputs, self_contained
    from uavkit.plan.outputs import refuse_other_contents, write_outputs
    from uavkit.plan.planner import plan_survey
    from uavkit.plan.tables import summary_lines

    refuse_other_contents(out)
    found = read_inputs(source, beside)
    planned = plan_survey(
        source,
        found.areas,
        found.camera,
        found.elevation,
        found.vehicle,
        found.fences,
        first_station=first_station,
        progress=progress,
    )
    kept = self_contained(source, beside, found)
    left_out = write_outputs(out, planned, kept, found.elevation, found.vehicle, progress)
    return PlanMade(
        lines=[*summary_lines(planned, source), *(f"  note: {text}" for text in (*found.notes, *left_out))],
        page=out / f"{planned.plan.name}.html",
    )


def check_plan(path: Path, camera: str, terrain: "TerrainRequest", speed_m_s: float | None = None) -> list[str]:
    """Tell in lines what a plan of ours, a .plan or a .waypoints gives with a camera."""
    from uavkit.plan.checking import checked_lines

    return checked_lines(path, load_camera(camera), terrain, speed_m_s)


def vehicles() -> list["VehicleProfile"]:
    """Return the profiles of all vehicles."""
    from uavkit.formats.vehicle_profiles import list_vehicles, load_vehicle

    return [load_vehicle(name) for name in list_vehicles()]


def flight_log(path: Path, progress: Progress = silent) -> "FlightLog":
    """Return what a flight log of any kind holds."""
    from uavkit.formats.flight_logs import open_log

    return open_log(path, progress)


def export_log(path: Path, target: str, folder: Path, progress: Progress = silent) -> list[Path]:
    """Write the contents of a flight log into a folder for other programs, and return the files."""
    from uavkit.formats.flight_logs import open_log
    from uavkit.formats.log_export import ExportKind
    from uavkit.formats.log_export import export_log as write_log

    return list(write_log(open_log(path, progress), folder, ExportKind(target)))


def begin_survey(project: Project, originals: Mapping[str, Path | Sequence[Path]], options: IngestOptions) -> None:
    """Write the manifest of a survey, new or again; settings of process that it has are kept."""
    found: dict[Any, Original | tuple[Original, ...]] = {
        role: project.original(given) if isinstance(given, Path) else tuple(map(project.original, given))
        for role, given in originals.items()
    }
    known = project.manifest.process if (project.folder / "manifest.json").is_file() else ()
    images = originals["images"]
    label = _simulation_label(images if isinstance(images, Path) else images[0])
    project.save_manifest(Manifest(originals=found, ingest=options, process=known, **label))


def choose_settings(project: Project, settings: Sequence[str]) -> None:
    """Note the settings ``section.option=value`` of process; raises InputError for one that does not exist."""
    from uavkit.process.options import ProcessOptions, with_settings

    with_settings(ProcessOptions(), list(settings))
    project.save_manifest(project.manifest.model_copy(update={"process": tuple(settings)}))


def ingest(project: Project, progress: Progress = silent) -> Block:
    """Make the block of a survey and keep it."""
    from uavkit.ingest.logged_stills import rows_of_matches

    with project.running(Stage.INGEST):
        block = _built_block(project, progress)
        (project.stage_folder(Stage.INGEST) / MATCHES).unlink(missing_ok=True)
        if block.exposures is not None:
            unused = [f"not used {event.source} - {event.reason}" for event in block.exposures.unused]
            write_matches(project.stage_folder(Stage.INGEST) / MATCHES, rows_of_matches(block.exposures), unused)
        write_block(project.block_file, block)
    return block


def _built_block(project: Project, progress: Progress) -> Block:
    from uavkit.ingest.build_block import IngestOptions, Sources, build_block
    from uavkit.ingest.log_positions import LogOptions
    from uavkit.ingest.logged_stills import GivenMatches
    from uavkit.plan.expected import expected_positions

    told, camera = project.manifest.ingest, project.original_path("camera")
    plan_file, match = project.original_path("plan"), project.original_path("match")
    sources = Sources(
        stills=_stills(project),
        video=_video(project),
        logs=tuple(flight_log(path, progress) for path in project.original_paths("log")),
        positions=_listed_positions(project.original_paths("positions")),
        given=GivenMatches(rows=read_matches(match), source=str(match)) if match else GivenMatches(),
        planned=expected_positions(plan_file) if plan_file else (),
        control=_surveyed(project, "control_points"),
        check=_surveyed(project, "check_points"),
    )
    profile = read_camera(camera) if camera else load_camera(told.camera) if told.camera else None
    options = IngestOptions(
        crs=told.crs,
        height_datum=HeightDatum(told.height_datum) if told.height_datum else None,
        logs=LogOptions(lever_arm_m=told.lever_arm_m, shutter_latency_s=told.shutter_latency_s),
        latency_sigma_s=told.latency_sigma_s,
    )
    return build_block(sources, profile, options, progress)


def _listed_positions(paths: Sequence[Path]) -> KmlPositions | ImagePositions | None:
    """Return the positions of one or several files of a kind, one behind the other."""
    if not paths:
        return None
    kml = [path for path in paths if path.suffix.lower() in (".kml", ".kmz")]
    if kml and len(kml) < len(paths):
        raise InputError(f"{paths[0]} and {paths[-1]}: give KML files or CSV files as positions, not both")
    return KmlPositions(*kml) if kml else joined_image_positions([read_image_positions(path) for path in paths])


def _surveyed(project: Project, role: str) -> SurveyedPoints | None:
    path, origin = project.original_path(role), project.manifest.ingest.pixel_origin
    if path is None:
        return None
    return read_surveyed_points(path, ControlFileOptions(pixel_origin=PixelOrigin(origin)) if origin else None)


def process(project: Project, workers: int = 1, progress: Progress = silent) -> OrientedBlock:
    """Orient the block of a survey and keep the result; finished steps of a killed run are found again."""
    from uavkit.process.options import ProcessOptions, with_settings
    from uavkit.process.orient import orient_block

    _require(project, Stage.INGEST)
    options = with_settings(ProcessOptions(), list(project.manifest.process))
    stills, video, cache = _stills(project), _video(project), project.cache(Stage.PROCESS)
    with project.running(Stage.PROCESS):
        block = read_block(project.block_file)
        result = orient_block(block, stills, video, options, cache=cache, workers=workers, progress=progress)
        _write_result(project, result)
        cache.forget_unused()
    return result


def _write_result(project: Project, result: OrientedBlock) -> None:
    from uavkit.formats.orientation_files import write_exterior_orientations, write_interior_orientation
    from uavkit.formats.point_files import write_las, write_ply

    folder = project.stage_folder(Stage.PROCESS)
    write_oriented_block(project.result_file, result)
    write_adjustment(folder / "adjustment.json", result)
    write_exterior_orientations(folder / "exterior_orientation.csv", result)
    write_interior_orientation(folder / "interior_orientation.toml", result)
    write_ply(folder / "points.ply", result)
    write_las(folder / "points.laz", result)


def report(project: Project, progress: Progress = silent) -> Path:
    """Write the report of a survey and return its page."""
    from uavkit.report.page import write_report
    from uavkit.report.tables import PaperComparison

    _require(project, Stage.PROCESS)
    manifest = project.manifest
    with project.running(Stage.REPORT):
        result, folder = oriented_block(project), project.stage_folder(Stage.REPORT)
        comparison = (
            PaperComparison(flight=manifest.simulated, scale=manifest.simulated_scale, stills=len(result.block.stills))
            if manifest.simulated
            else None
        )
        return write_report(result, folder, survey=project.folder.name, comparison=comparison, progress=progress)


def run(project: Project, workers: int = 1, progress: Progress = silent) -> list[str]:
    """Do every stage that is out of date, in order, and return their names."""
    done = []
    for stage in Stage:
        if next(entry for entry in project.status() if entry.stage is stage).standing is Standing.DONE:
            continue
        if stage is Stage.INGEST:
            ingest(project, progress)
        elif stage is Stage.PROCESS:
            process(project, workers, progress)
        else:
            report(project, progress)
        done.append(stage.value)
    return done


def demo(out: Path, workers: int = 1, progress: Progress = silent) -> tuple[Project, list[str]]:
    """Simulate a small survey and take it through the whole chain; what is already there and complete is kept."""
    flight, project = out / "flight", Project(out / "survey")
    if not (flight / "stills" / SIMULATION_LABEL).is_file():
        simulate(flight, {**DEMO, "workers": workers}, progress)
    originals = {
        "images": flight / "stills",
        "video": flight / "video.avi",
        "positions": flight / "positions.kml",
        "control_points": flight / "control_points.csv",
        "check_points": flight / "check_points.csv",
    }
    with project.locked():
        begin_survey(project, originals, IngestOptions())
        return project, run(project, workers, progress)


def export(project: Project, target: str, folder: Path) -> list[Path]:
    """Write the result of a survey for other programs into a folder, and return the files."""
    from uavkit.formats.colmap_files import write_colmap_model
    from uavkit.formats.point_files import write_las, write_ply

    _require(project, Stage.PROCESS)
    if target == "colmap":
        write_colmap_model(folder / "colmap", oriented_block(project))
        return sorted((folder / "colmap").glob("*.txt"))
    write, path = (write_ply if target == "ply" else write_las), folder / f"points.{target}"
    write(path, oriented_block(project))
    return [path]


def geotag(project: Project, out: Path, measured: bool | None, progress: Progress = silent) -> "StillTags":
    """Write copies of the stills with their positions, and return what was written and what not.

    ``measured`` chooses the positions as ingest has them, False the adjusted ones, None these where they are there.
    """
    from uavkit.formats.geotag import write_geotagged
    from uavkit.products.geotags import adjusted_tags, measured_tags

    _require(project, Stage.INGEST)
    stills = _stills(project)
    if out.resolve() in {folder.resolve() for folder in project.original_paths("images")}:
        raise InputError(f"{out}: the originals lie there, which are never changed: name another folder")
    adjusted = next(entry for entry in project.status() if entry.stage is Stage.PROCESS).standing is Standing.DONE
    if measured is False:
        _require(project, Stage.PROCESS)
    use_adjusted = adjusted if measured is None else not measured
    found = adjusted_tags(oriented_block(project)) if use_adjusted else measured_tags(read_block(project.block_file))
    left = [name for name in found.without if (out / name).exists()]
    if left:
        raise InputError(
            f"{out / left[0]}: this copy is from before, and the still has no position now: empty {out}, or name "
            "another folder"
        )
    for done, (name, tag) in enumerate(sorted(found.tags.items())):
        progress("geotag", done, len(found.tags))
        write_geotagged(stills.path(name), out / name, tag)
    progress("geotag", len(found.tags), len(found.tags))
    return found


def oriented_block(project: Project) -> OrientedBlock:
    """Return the result of process."""
    return read_oriented_block(project.result_file)


def report_page(project: Project) -> Path:
    """Return where the page of the report lies."""
    return project.stage_folder(Stage.REPORT) / "report.html"


def cameras() -> list[CameraProfile]:
    """Return the cameras that are known, in the order of their names."""
    return [read_camera(path) for path in sorted(camera_folder().glob("*.toml"))]


def _require(project: Project, stage: Stage) -> None:
    """Raise InputError where a stage that others build on is not up to date."""
    entry = next(entry for entry in project.status() if entry.stage is stage)
    if entry.standing is not Standing.DONE:
        why = f" ({entry.why})" if entry.why else ""
        raise InputError(
            f"{project.folder}: {stage.value} is {entry.standing.value}{why}: run 'uavkit {stage.value}' first, or "
            f"'uavkit run' for all"
        )


def _stills(project: Project) -> FileStillSource:
    folders = project.original_paths("images")
    if not folders:
        raise InputError(f"{project.folder}: the manifest names no images: run 'uavkit ingest' again")
    return FileStillSource(folders[0] if len(folders) == 1 else folders)


def _video(project: Project) -> FileVideoSource | None:
    path = project.original_path("video")
    return FileVideoSource(path) if path else None


def _simulation_options(values: Mapping[str, Any]) -> Any:
    """Return SimulationOptions of plain values; enums are given by their value."""
    from uavkit.simulate.options import SimulationOptions

    defaults = SimulationOptions()
    kinds = {name: type(getattr(defaults, name)) for name in values}
    typed = {name: kinds[name](value) if issubclass(kinds[name], Enum) else value for name, value in values.items()}
    return SimulationOptions(**typed)


def _simulation_label(images: Path) -> dict[str, Any]:
    """Return the flight of the paper that simulated stills repeat and their scale; empty for all others."""
    try:
        label = json.loads((images / SIMULATION_LABEL).read_text(encoding="utf-8"))
        flight, scale = label["flight"], float(label["scale"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {"simulated": flight, "simulated_scale": scale} if flight in ("constant", "trace") else {}
