"""COLMAP on the stills of a simulated flight, judged by the same marks and surveyed points as uavkit.

``python -m tests.benchmarks.colmap_peer FLIGHT WORK RESULT.json`` runs it in a process of its own, so that its memory
can be told. SIFT, exhaustive matching and incremental mapping with one OPENCV camera of which everything is refined.
COLMAP takes neither control nor GNSS into its adjustment: its model is brought to the ground by a similarity
transformation on the control points.
"""

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from tests.benchmarks.evaluation import MarkedPlaces, errors_to_truth, root_mean_squares
from tests.benchmarks.subprocesses import THREADS
from uavkit.core.arrays import Array
from uavkit.formats.control_file import SurveyedPoints, read_surveyed_points
from uavkit.process.absolute import fit_similarity
from uavkit.simulate.site import site_frame
from uavkit.simulate.truth import read_truth

CENTRE_FROM_CORNER_PX = 0.5
"""COLMAP counts pixels from the corner of the first one, uavkit from its centre."""
WIDEST_IMAGE_PX = 3200


def reconstruct(stills: Path, work: Path) -> tuple[pycolmap.Reconstruction, dict[str, float]]:
    """Return COLMAP's largest model of a folder of stills, and the seconds of each step."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    database, seconds = work / "database.db", {}
    seconds["features"] = _seconds(lambda: _extract(database, stills))
    seconds["matching"] = _seconds(lambda: _match(database))
    models: dict[int, pycolmap.Reconstruction] = {}
    seconds["mapping"] = _seconds(lambda: models.update(_map(database, stills, work / "models")))
    return max(models.values(), key=lambda model: model.num_reg_images()), seconds


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _extract(database: Path, stills: Path) -> None:
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = "OPENCV"
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, THREADS, WIDEST_IMAGE_PX
    pycolmap.extract_features(
        database,
        stills,
        image_names=sorted(path.name for path in stills.glob("*.JPG")),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def _match(database: Path) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, THREADS
    pycolmap.match_exhaustive(database, matching_options=options, device=pycolmap.Device.cpu)


def _map(database: Path, stills: Path, out: Path) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_principal_point, options.num_threads = True, THREADS
    return dict(pycolmap.incremental_mapping(database, stills, out, options=options))


def intersected(model: pycolmap.Reconstruction, surveyed: SurveyedPoints) -> tuple[list[str], Array, Array]:
    """Return marked points by name, intersected in the model and as surveyed in the site's local frame, each (n, 3).

    Points that fewer than two oriented stills show are left out.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    names, places, ground = [], [], []
    for point in surveyed.points:
        marks = [(images[m.image], np.array([m.column_px, m.row_px])) for m in point.marks if m.image in images]
        if len(marks) >= 2:
            names.append(point.name)
            places.append(_intersected(model, marks))
            ground.append(point.coordinates)
    frame = site_frame()
    return names, np.array(places).reshape(-1, 3), frame.enu_from_crs(np.array(ground).reshape(-1, 3), surveyed.crs)


def _intersected(model: pycolmap.Reconstruction, marks: Iterable[tuple[Any, Array]]) -> Array:
    """Return the place (3,) whose images lie nearest to its marks, from the least squares intersection of the rays."""
    from scipy.optimize import least_squares

    rays = [(image, model.cameras[image.camera_id], mark + CENTRE_FROM_CORNER_PX) for image, mark in marks]
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for image, camera, pixel in rays:
        R_camera_from_world = image.cam_from_world().rotation.matrix()
        direction = R_camera_from_world.T @ np.append(camera.cam_from_img(pixel), 1.0)
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ image.projection_center()

    def misses(place: Array) -> Array:
        return np.concatenate([_projected(image, camera, place) - pixel for image, camera, pixel in rays])

    return np.asarray(least_squares(misses, np.linalg.solve(normal, right), x_scale="jac", xtol=1e-14).x)


def _projected(image: Any, camera: Any, place: Array) -> Array:
    return np.asarray(camera.img_from_cam(image.cam_from_world() * place, False)).ravel()


def judged(model: pycolmap.Reconstruction, flight: Path) -> dict[str, Any]:
    """Return the errors of the check points, and what else tells the quality."""
    places = _places(model, flight)
    return {
        "stills_oriented": model.num_reg_images(),
        "points": model.num_points3D(),
        "reprojection_px": model.compute_mean_reprojection_error(),
        "check_points": len(places.check_m),
        **root_mean_squares("rmse", (places.check_m - places.check_surveyed_m) ** 2),
        **errors_to_truth(places),
        "camera": [float(value) for value in next(iter(model.cameras.values())).params],
    }


def _places(model: pycolmap.Reconstruction, flight: Path) -> MarkedPlaces:
    """Return where the model puts the check points once its control points are brought to their surveyed places."""
    truth = read_truth(flight / "truth" / "truth.json")
    true = {p["name"]: np.array(p["position_m"]) for p in (*truth["control_points"], *truth["check_points"])}
    used, model_m, control_m = intersected(model, read_surveyed_points(flight / "control_points.csv"))
    names, check_m, surveyed_m = intersected(model, read_surveyed_points(flight / "check_points.csv"))
    return MarkedPlaces(
        check_m=fit_similarity(model_m, control_m).apply(check_m),
        check_surveyed_m=surveyed_m,
        check_true_m=np.array([true[name] for name in names]),
        control_surveyed_m=control_m,
        control_true_m=np.array([true[name] for name in used]),
    )


def shape_errors(model: pycolmap.Reconstruction, truth: Mapping[str, Any]) -> dict[str, float]:
    """Return what is wrong with the shape of a model, in mm: places of all signals, intersected from their exact marks.

    A similarity transformation to the truth takes out the datum; neither survey nor marks have noise here, so that what
    remains is the error of the orientations alone.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    found, true = [], []
    for point in (*truth["control_points"], *truth["check_points"]):
        marks = [(images[name], np.array(pixel)) for name, pixel in point["marks"].items() if name in images]
        if len(marks) >= 2:
            found.append(_intersected(model, marks))
            true.append(point["position_m"])
    places, wanted = np.array(found), np.array(true)
    return root_mean_squares("shape", (fit_similarity(places, wanted).apply(places) - wanted) ** 2)


def largest_model(folder: Path) -> pycolmap.Reconstruction:
    """Return the largest of the models that COLMAP wrote into a folder."""
    models = [pycolmap.Reconstruction(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    return max(models, key=lambda model: model.num_reg_images())


def main(flight: Path, work: Path, result: Path) -> None:
    """Run COLMAP on a flight and write what was found."""
    begin = time.perf_counter()
    model, seconds = reconstruct(flight / "stills", work)
    total = time.perf_counter() - begin
    values = {f"{step}_s": value for step, value in seconds.items()} | {"total_s": total}
    result.write_text(json.dumps(values | judged(model, flight)), encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
