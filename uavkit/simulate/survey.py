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
from uavkit.simulate import truth
from uavkit.simulate.brightness import still_factors
from uavkit.simulate.camera import SimulatedCamera, SimulatedView, true_camera
from uavkit.simulate.control import TruePoint, choose_points, observe_points, surveyed
from uavkit.simulate.flight import Flight, make_flight
from uavkit.simulate.options import SimulationOptions, VideoStandard
from uavkit.simulate.positions import WaypointPositions, measure_waypoints
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
    control_points: Path
    check_points: Path
    gcp_list: Path
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
    control = surveyed(scene.control, options.control_sigma_m, options, 1)
    write_points_csv(paths.control_points, control)
    write_gcp_list(paths.gcp_list, control)
    write_points_csv(paths.check_points, surveyed(scene.check, options.check_sigma_m, options, 2))
    truth.write_truth(paths.truth, truth_of(scene))
    _write_field_poses(out / "truth" / "field_poses.npz", scene.flight)
    write_text(out / "README.txt", _readme(scene))
    _write_stills(paths.stills, scene, progress)
    if paths.video is not None:
        with atomic_path(paths.video) as temporary:
            write_video(temporary, scene.finder(), progress)
    return paths


def _refuse_another_survey(paths: SimulatedSurvey, names: tuple[str, ...]) -> None:
    """Stills or a video left from another survey would be taken for part of this one."""
    left = sorted({path.name for path in paths.stills.glob("*.JPG")} - set(names))
    if paths.video is None and (paths.folder / "video.avi").exists():
        left.append("video.avi")
    if left:
        raise InputError(f"{paths.folder} holds another survey ({left[0]}): name a new folder, or empty this one")


def _paths(out: Path, options: SimulationOptions) -> SimulatedSurvey:
    return SimulatedSurvey(
        folder=out,
        stills=out / "stills",
        video=None if options.video_standard is VideoStandard.NONE else out / "video.avi",
        positions=out / "positions.kml",
        control_points=out / "control_points.csv",
        check_points=out / "check_points.csv",
        gcp_list=out / "gcp_list.txt",
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


def _readme(scene: Scene) -> str:
    """What lies where, and how to process it."""
    sigma_mm = 1000 * scene.options.control_sigma_m
    order = scene.options.field_order.value
    video, argument = f"video.avi           the finder's video, interlaced, {order} field first\n", " --video video.avi"
    if scene.options.video_standard is VideoStandard.NONE:
        video, argument = "", ""
    options = scene.options
    seed, scale, flight = options.seed, options.scale, options.flight.value
    site = f"terrain {options.terrain.value}, texture {options.texture.value}"
    return f"""A simulated survey (seed {seed}, scale {scale:g}, flight {flight}, {site}).

stills/             {len(scene.names)} stills with the EXIF of the camera; its clock is off
{video}positions.kml       positions of the waypoints, one for each still, from the receiver on board (good to metres)
control_points.csv  {len(scene.control)} control points with their marks in the stills, sigma {sigma_mm:g} mm
check_points.csv    {len(scene.check)} check points: held back, to judge the result
gcp_list.txt        the control points in OpenDroneMap's form
truth/              what is true; no stage of the processing reads it

Process it with

    uavkit ingest SURVEY --images stills{argument} --positions positions.kml \\
        --control-points control_points.csv --check-points check_points.csv
    uavkit run SURVEY
"""
