"""The files of a plan: one folder, whole or not at all."""

import shutil
from collections.abc import Callable
from pathlib import Path

from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan
from uavkit.core.progress import Progress, silent
from uavkit.core.surface import ElevationGrid
from uavkit.core.vehicle import VehicleKind, VehicleProfile
from uavkit.formats.atomic import write_text
from uavkit.formats.flightplan_file import write_flightplan
from uavkit.formats.plan_kml import write_plan_kml
from uavkit.formats.plan_request import PlanRequest, request_text
from uavkit.formats.plan_tables import write_exposures_csv, write_litchi_csv, write_plan_geojson
from uavkit.formats.qgc_plan import write_plan
from uavkit.formats.waypoints_file import write_waypoints
from uavkit.formats.wpml import write_wpml
from uavkit.plan.mission import flown_with, item_counts, mission_of
from uavkit.plan.page import write_plan_page, write_plan_picture
from uavkit.plan.planner import Planned
from uavkit.plan.tables import write_summary_json

SUFFIX = ".flightplan.json"
"""Of the file that holds the whole plan; by it a folder is known to hold a plan."""


def write_outputs(
    folder: Path,
    planned: Planned,
    request: PlanRequest,
    elevation: ElevationGrid | None,
    vehicle: VehicleProfile | None,
    progress: Progress = silent,
) -> list[str]:
    """Write all files of a plan into a folder, in place of those of an earlier plan, and return what was left out.

    Raises InputError where the folder holds anything else.
    """
    refuse_other_contents(folder)
    fresh = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        notes = _write_all(fresh, planned, request, elevation, (vehicle, progress))
        old = folder.with_name(folder.name + ".old")
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            folder.rename(old)
        fresh.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{folder}: the plan cannot be written ({error.strerror or error})") from error
    return notes


def refuse_other_contents(folder: Path) -> None:
    """Raise an InputError where a folder exists and holds something else than a plan."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file: name a folder for the plan")
    if any(folder.iterdir()) and not any(folder.glob(f"*{SUFFIX}")):
        raise InputError(f"{folder}: holds other files than a plan: name a new folder (--out)")


def _write_all(
    folder: Path,
    planned: Planned,
    request: PlanRequest,
    elevation: ElevationGrid | None,
    how: tuple[VehicleProfile | None, Progress],
) -> list[str]:
    vehicle, progress = how
    plan, name = planned.plan, planned.plan.name
    writers: tuple[Callable[[], object], ...] = (
        lambda: write_text(folder / f"{name}.toml", request_text(request)),
        lambda: write_flightplan(folder / f"{name}{SUFFIX}", plan),
        lambda: write_plan_kml(folder / f"{name}.kml", plan, planned.footprints_deg),
        lambda: write_plan_geojson(folder / f"{name}.geojson", plan, planned.footprints_deg),
        lambda: write_exposures_csv(folder / f"{name}_exposures.csv", plan),
        lambda: write_summary_json(folder / f"{name}_summary.json", planned, request),
        lambda: write_plan_picture(folder / f"{name}.png", planned, request, elevation),
        lambda: write_plan_page(folder / f"{name}.html", planned, request, elevation, item_counts(plan, vehicle)),
    )
    for number, write in enumerate(writers, start=1):
        write()
        progress("write the plan's files", number, len(writers))
    if len(plan.sorties) > 1 or plan.exposures.station[0] > 0:
        write_text(folder / f"{name}_resume.toml", _resume_text(plan))
    notes: list[str] = []
    for sortie in range(len(plan.sorties)):
        stem = name if len(plan.sorties) == 1 else f"{name}_{sortie + 1}"
        notes += _write_sortie(folder, stem, plan, sortie, request, vehicle)
    return list(dict.fromkeys(notes))


def _write_sortie(
    folder: Path, stem: str, plan: FlightPlan, sortie: int, request: PlanRequest, vehicle: VehicleProfile | None
) -> list[str]:
    autopilot, kind = flown_with(vehicle)
    mission = mission_of(plan, sortie, autopilot, request.flight.altitude_from, kind)
    write_plan(folder / f"{stem}.plan", mission)
    write_waypoints(folder / f"{stem}.waypoints", mission)
    notes = []
    if kind is VehicleKind.MULTIROTOR:
        for what, write, suffix in (("DJI", write_wpml, "_dji.kmz"), ("Litchi", write_litchi_csv, "_litchi.csv")):
            try:
                write(folder / f"{stem}{suffix}", plan, sortie)
            except InputError as error:
                (folder / f"{stem}{suffix}").unlink(missing_ok=True)
                notes.append(f"no file for {what}: {str(error).replace(str(folder) + '/', '')}")
    return notes


def _resume_text(plan: FlightPlan) -> str:
    """Return which exposure stations each sortie takes, and how to go on from any of them."""
    lines = [
        "# Sorties and the exposure stations that they take. After a flight that ended early plan the rest:",
        f"#   uavkit plan {plan.name}.toml --resume-after STATION --out NAME",
        "# with the number of the last station that was taken (see the table of exposures, column station).",
        "",
    ]
    for number, sortie in enumerate(plan.sorties, start=1):
        stations = plan.exposures.station[sortie.first_exposure : sortie.first_exposure + sortie.exposures]
        lines += [
            "[[sorties]]",
            f"sortie = {number}",
            f"first_station = {int(stations[0])}",
            f"last_station = {int(stations[-1])}",
            f"images = {sortie.exposures}",
            f"duration_s = {sortie.duration_s:.0f}",
            "",
        ]
    return "\n".join(lines)
