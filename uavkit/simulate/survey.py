"""Write a whole simulated survey: the files that a flight brings home, and the truth beside them."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.progress import Progress, silent
from uavkit.formats.atomic import atomic_path, write_text
from uavkit.formats.control_file import write_gcp_list, write_points_csv
from uavkit.formats.kml import write_positions
from uavkit.formats.positions_file import write_image_positions
from uavkit.simulate import truth
from uavkit.simulate.brightness import still_factors
from uavkit.simulate.camera import SimulatedCamera, SimulatedView, true_camera
from uavkit.simulate.control import TruePoint, choose_points, observe_points, surveyed
from uavkit.simulate.flight import Flight, make_flight
from uavkit.simulate.options import SimulationOptions, VideoStandard
from uavkit.simulate.positions import RTK_SIGMA_M, WaypointPositions, measure_waypoints
from uavkit.simulate.receiver_log import write_receiver_log
from uavkit.simulate.site import CAMERA_ZONE_HOURS, VIDEO_START_UTC
from uavkit.simulate.stills import StillSettings, render_still, write_still
from uavkit.simulate.video import Finder, make_finder, write_video
from uavkit.simulate.world import World, make_world


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedSurvey:
    """Where the files of a simulated survey lie."""

    folder: Path
    stills: Path
    """Folder of the stills."""
    video: Path | None
    """None where no video was asked for."""
    positions: Path
    """Waypoints, without sigmas."""
    image_positions: Path
    """The same positions by image, with their sigmas."""
    receiver_log: Path
    """What the receiver on board recorded: its fixes, and the marks of the shutter."""
    control_points: Path | None
    """None where there are no control points, as for the next two."""
    check_points: Path | None
    gcp_list: Path | None
    truth: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraClock:
    """The camera's own clock: off by minutes, and drifting."""

    offset_s: float
    drift_ppm: float

    def shown(self, video_time_s: float) -> datetime:
        """What the clock shows at an instant counted from the video's first field."""
        local = VIDEO_START_UTC.replace(tzinfo=None) + timedelta(hours=CAMERA_ZONE_HOURS)
        return local + timedelta(seconds=self.offset_s + video_time_s * (1 + self.drift_ppm * 1e-6))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A simulated survey in memory, before anything is rendered."""

    options: SimulationOptions
    world: World
    camera: SimulatedCamera
    flight: Flight
    names: tuple[str, ...]
    """File names of the stills."""
    gains: Array
    """Relative exposure of each still."""
    clock: CameraClock
    waypoints: WaypointPositions
    control: list[TruePoint]
    check: list[TruePoint]

    def view(self, index: int) -> SimulatedView:
        """The camera at one exposure."""
        return self.flight.view(self.camera, float(self.flight.exposure_s[index]))

    def still_settings(self, index: int) -> StillSettings:
        """Exposure and noise of one still."""
        return StillSettings(gain=float(self.gains[index]), seed=(self.options.seed, 10, index))

    def finder(self) -> Finder:
        """The finder of the flight."""
        return make_finder(self.world, self.camera, self.flight, self.options)


def make_scene(options: SimulationOptions) -> Scene:
    """Lay out world, camera, flight, points and errors of a survey; the same options give the same scene."""
    rng = np.random.default_rng([options.seed, 11])
    bare = make_world(options.seed, options.terrain, options.texture)
    camera, flight = true_camera(options.seed, options.scale), make_flight(bare, options)
    count = len(flight.exposure_s)
    names = tuple(f"R{10001 + n:07d}.JPG" for n in range(count))
    views = {name: flight.view(camera, float(t)) for name, t in zip(names, flight.exposure_s, strict=True)}
    places = choose_points(bare, flight.stations_m, tuple(views.values()), options)
    labels = [f"G{n + 1}" for n in range(options.control_points)] + [
        f"C{n + 1:02d}" for n in range(options.check_points)
    ]
    observed = observe_points(bare, labels, places, views)
    return Scene(
        options=options,
        world=bare.with_signals(places),
        camera=camera,
        flight=flight,
        names=names,
        gains=np.exp(rng.normal(0.0, 0.13, count)) * still_factors(count, options.brightness_jump),
        clock=CameraClock(offset_s=float(rng.uniform(60, 400) * rng.choice([-1, 1])), drift_ppm=20.0),
        waypoints=measure_waypoints(flight.positions_m(flight.exposure_s), options),
        control=observed[: options.control_points],
        check=observed[options.control_points :],
    )


def simulate_survey(out: Path, options: SimulationOptions, progress: Progress = silent) -> SimulatedSurvey:
    """Render and write a survey into the folder ``out`` (made where absent; the same survey's files are replaced).

    Raises InputError where the folder cannot be written or holds another survey.
    """
    scene = make_scene(options)
    paths = _paths(out, options)
    _refuse_another_survey(paths, scene.names)
    write_positions(paths.positions, "Waypoints", scene.waypoints.fixes())
    write_image_positions(paths.image_positions, scene.waypoints.of_images(scene.names, options.gnss_sigma_m))
    write_receiver_log(paths.receiver_log, scene.flight, scene.waypoints.shift_m, options)
    _write_points(paths, scene)
    truth.write_truth(paths.truth, truth_of(scene))
    _write_field_poses(out / "truth" / "field_poses.npz", scene.flight)
    write_text(out / "README.txt", _readme(scene))
    _write_stills(paths.stills, scene, progress)
    if paths.video is not None:
        with atomic_path(paths.video) as temporary:
            write_video(temporary, scene.finder(), progress)
    return paths


def _write_points(paths: SimulatedSurvey, scene: Scene) -> None:
    options = scene.options
    control = surveyed(scene.control, options.control_sigma_m, options, 1)
    if paths.control_points is not None:
        write_points_csv(paths.control_points, control)
    if paths.gcp_list is not None:
        write_gcp_list(paths.gcp_list, control)
    if paths.check_points is not None:
        write_points_csv(paths.check_points, surveyed(scene.check, options.check_sigma_m, options, 2))


def _refuse_another_survey(paths: SimulatedSurvey, names: tuple[str, ...]) -> None:
    """Stills, a video or points left from another survey would be taken for part of this one."""
    left = sorted({path.name for path in paths.stills.glob("*.JPG")} - set(names))
    ours = {paths.video, paths.control_points, paths.check_points, paths.gcp_list}
    for name in ("video.avi", "control_points.csv", "check_points.csv", "gcp_list.txt"):
        if paths.folder / name not in ours and (paths.folder / name).exists():
            left.append(name)
    if left:
        raise InputError(f"{paths.folder} holds another survey ({left[0]}): name a new folder, or empty this one")


def _paths(out: Path, options: SimulationOptions) -> SimulatedSurvey:
    return SimulatedSurvey(
        folder=out,
        stills=out / "stills",
        video=None if options.video_standard is VideoStandard.NONE else out / "video.avi",
        positions=out / "positions.kml",
        image_positions=out / "positions.csv",
        receiver_log=out / "gnss.ubx",
        control_points=out / "control_points.csv" if options.control_points else None,
        check_points=out / "check_points.csv" if options.check_points else None,
        gcp_list=out / "gcp_list.txt" if options.control_points else None,
        truth=out / "truth" / "truth.json",
    )


def _write_stills(folder: Path, scene: Scene, progress: Progress) -> None:
    """Render the stills, ``workers`` at a time."""
    lattice = scene.camera.lattice()

    def write(index: int) -> None:
        image = render_still(scene.world, scene.view(index), lattice, scene.still_settings(index))
        shown = scene.clock.shown(float(scene.flight.exposure_s[index]))
        with atomic_path(folder / scene.names[index]) as temporary:
            write_still(temporary, image, shown, float(scene.gains[index]), scene.options.jpeg_quality)

    _run(scene.options.workers, write, len(scene.names), progress)


def _run(workers: int, work: Callable[[int], None], count: int, progress: Progress) -> None:
    """Do ``work(0) ... work(count - 1)`` in threads; the first failure ends it."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: list[Future[None]] = [pool.submit(work, index) for index in range(count)]
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                future.result()
                progress("stills", done, count)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_field_poses(path: Path, flight: Flight) -> None:
    """Time since the first field, projection centre, rotation and state of every field."""
    times: Array = np.arange(len(flight.states.state), dtype=np.float64) * flight.field_interval_s
    with atomic_path(path) as temporary:
        np.savez_compressed(
            temporary,
            time_s=times,
            projection_centre_m=flight.positions_m(times),
            R_object_from_image=flight.rotations(times),
            state=flight.states.state,
            source_field=flight.states.source,
        )


def truth_of(scene: Scene) -> dict[str, Any]:
    """Everything true about a survey as plain values, see ``truth``."""
    finder = None if scene.options.video_standard is VideoStandard.NONE else scene.finder()
    return truth.survey_truth(scene, finder)


def ingest_arguments(paths: SimulatedSurvey, options: SimulationOptions) -> list[tuple[str, Path]]:
    """Return the options of ``uavkit ingest`` for a simulated survey with their files; RTK comes with its sigmas."""
    positions = paths.image_positions if options.gnss_sigma_m < RTK_SIGMA_M else paths.positions
    files = [
        ("--images", paths.stills),
        ("--video", paths.video),
        ("--positions", positions),
        ("--control-points", paths.control_points),
        ("--check-points", paths.check_points),
    ]
    return [(name, path) for name, path in files if path is not None]


def _readme(scene: Scene) -> str:
    """What lies where, and how to process it."""
    options = scene.options
    paths = _paths(Path(), options)
    quality = "RTK, good to centimetres" if options.gnss_sigma_m < RTK_SIGMA_M else "good to metres"
    control = f"{len(scene.control)} control points with their marks in the stills"
    files = [
        (paths.stills, f"{len(scene.names)} stills with the EXIF of the camera; its clock is off"),
        (paths.video, f"the finder's video, interlaced, {options.field_order.value} field first"),
        (paths.positions, f"positions of the waypoints, one for each still, from the receiver on board ({quality})"),
        (paths.image_positions, "the same by image, with the sigma of each"),
        (paths.receiver_log, "what that receiver recorded: five fixes a second, and a mark for each shutter"),
        (paths.control_points, f"{control}, sigma {1000 * options.control_sigma_m:g} mm"),
        (paths.check_points, f"{len(scene.check)} check points: held back, to judge the result"),
        (paths.gcp_list, "the control points in OpenDroneMap's form"),
        (paths.truth.parent, "what is true; no stage of the processing reads it"),
    ]
    folders = (paths.stills, paths.truth.parent)
    listed = [(f"{path}/" if path in folders else f"{path}", what) for path, what in files if path is not None]
    lines = "\n".join(f"{name:<20}{what}" for name, what in listed)
    arguments = [f"{name} {path}" for name, path in ingest_arguments(paths, options)]
    command = " \\\n        ".join(" ".join(arguments[n : n + 3]) for n in range(0, len(arguments), 3))
    site = f"terrain {options.terrain.value}, texture {options.texture.value}"
    return f"""A simulated survey (seed {options.seed}, scale {options.scale:g}, flight {options.flight.value}, {site}).

{lines}

Process it with

    uavkit ingest SURVEY {command}
    uavkit run SURVEY

or with --log {paths.receiver_log} instead of --positions: then the stills are matched with the marks of the shutter.
"""
