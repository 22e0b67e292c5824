# ruff: noqa: T201 (it prints what it measures)
"""One bundle adjustment in a process of its own, by uavkit or by Ceres: ``python -m tests.benchmarks.bundle_runs``.

Arguments: "ours" or "ceres", and the problem: "bal-49", or "block-20x50-500000" (strips x images, points; a free
network, self-calibrating). Prints one line of JSON: seconds of each run, cost (half the sum of squared residuals,
pixels), and by how much the memory of the first run exceeds that of the process with everything loaded and warmed up.
"""

import gc
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.bal import observations, read_bal
from tests.benchmarks.nadir_blocks import nadir_block
from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.process.bundle import adjust_block

TOLERANCE = 1e-6
"""Ceres ends where a step lowers the cost by less than this share of it: its default."""
OPTIONS = AdjustmentOptions(datum=Datum.FREE_NETWORK, robust=False, convergence=0.1)
"""Ours ends where no unknown changes by more than this many of its own sigmas."""
RUNS = {"bal": 3, "block": 1}
IMAGE_FROM_OBJECT_SIGNS = np.array([[1.0], [-1.0], [-1.0]])


def problem(name: str) -> AdjustmentInput:
    """Return the observations of a case."""
    kind, *rest = name.split("-")
    if kind == "bal":
        return observations(read_bal(int(rest[0])))
    strips, images = (int(number) for number in rest[0].split("x"))
    return free_block(strips, images, int(rest[1]))


def free_block(strips: int, images: int, points: int) -> AdjustmentInput:
    """Return a nadir block without positions, its camera of five parameters (COLMAP's RADIAL) free."""
    block = nadir_block(np.random.default_rng(1), strips, images, points)
    camera = replace(block.interior, p1=0.0, p2=0.0)
    free = InteriorSigmas(principal_distance_px=np.inf, x0_px=np.inf, y0_px=np.inf, k1=np.inf, k2=np.inf)
    return replace(block, interior=camera, interior_sigmas=free, gnss=None)


def cost_px2(result: AdjustmentResult) -> float:
    """Return half the sum of squared residuals."""
    if not np.all(result.ray_used):
        raise ValueError(f"{np.count_nonzero(~result.ray_used)} rays do not take part")
    return 0.5 * float(np.sum(result.ray_residuals_px**2))


def ours(given: AdjustmentInput) -> Callable[[], tuple[float, float, int]]:
    """Return a run: the whole of ``adjust_block``, covariances of all orientations and points included."""

    def run() -> tuple[float, float, int]:
        begin = time.perf_counter()
        result = adjust_block(given, OPTIONS)
        return time.perf_counter() - begin, cost_px2(result), result.iterations

    return run


def reconstruction(given: AdjustmentInput) -> Any:
    """Return the problem as a COLMAP model."""
    import pycolmap

    interiors = given.interiors or (given.interior,)
    n, index = len(given.projection_centres_m), given.interior_index
    of_image = np.zeros(n, dtype=np.int64) if index is None else index
    model = pycolmap.Reconstruction()
    for number, interior in enumerate(interiors):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="RADIAL", width=interior.width_px, height=interior.height_px, camera_id=number + 1,
                params=_radial(interior),
            )
        )  # fmt: skip
    order = np.lexsort((given.rays.point_index, given.rays.image_index))
    bounds = np.searchsorted(given.rays.image_index[order], np.arange(n + 1))
    place = np.empty(len(order), dtype=np.int64)
    for i in range(n):
        rows = order[bounds[i] : bounds[i + 1]]
        place[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=f"{i:05d}", camera_id=int(of_image[i]) + 1, image_id=i + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in given.rays.xy_px[rows]])
        rotation = IMAGE_FROM_OBJECT_SIGNS * given.R_object_from_image[i].T
        shift = -rotation @ given.projection_centres_m[i]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift))
    _add_points(model, given, place)
    return model


def _radial(interior: InteriorOrientation) -> list[float]:
    return [interior.principal_distance_px, interior.x0_px, interior.y0_px, interior.k1, interior.k2]


def _add_points(model: Any, given: AdjustmentInput, place: np.ndarray) -> None:
    import pycolmap

    order = np.argsort(given.rays.point_index, kind="stable")
    bounds = np.searchsorted(given.rays.point_index[order], np.arange(len(given.points_m) + 1))
    images, places = (given.rays.image_index[order] + 1).tolist(), place[order].tolist()
    for p, position in enumerate(given.points_m):
        track = pycolmap.Track()
        for row in range(bounds[p], bounds[p + 1]):
            track.add_element(images[row], places[row])
        model.add_point3D(position, track, np.zeros(3, dtype=np.uint8))


def ceres(given: AdjustmentInput, model: Any | None = None) -> Callable[[], tuple[float, float, int]]:
    """Return a run: Ceres' own time for the problem that COLMAP states, without stating it; sparse Schur, 2 threads."""
    import pyceres
    import pycolmap

    models = [model or reconstruction(given)]
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.refine_principal_point = given.interior_sigmas.x0_px > 0.0
    options.refine_focal_length = options.refine_extra_params = True
    options.print_summary = False
    for image in models[0].images:
        config.add_image(image)
    solver = pyceres.SolverOptions()
    solver.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 2, 300, TOLERANCE
    solver.logging_type = pyceres.LoggingType.SILENT

    def run() -> tuple[float, float, int]:
        start = models.pop() if models else reconstruction(given)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, start)
        summary = pyceres.SolverSummary()
        pyceres.solve(solver, adjuster.problem, summary)
        return summary.total_time_in_seconds, summary.final_cost, summary.num_successful_steps

    return run


def peak_mb() -> float:
    """Return the highest memory of this process since ``forget_peak``."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024.0


def forget_peak() -> float:
    """Let the highest memory begin anew from what is in use, and return that."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


def main() -> None:
    """Run the case named in the arguments."""
    program, case = sys.argv[1:3]
    make = {"ours": ours, "ceres": ceres}[program]
    make(free_block(3, 5, 600))()
    run = make(problem(case))
    before = forget_peak()
    runs = [run()]
    peak = peak_mb() - before
    runs += [run() for _ in range(RUNS[case.split("-")[0]] - 1)]
    seconds, costs, iterations = zip(*runs, strict=True)
    print(json.dumps({"seconds": seconds, "cost": costs[-1], "iterations": iterations[-1], "peak_mb": round(peak, 1)}))


if __name__ == "__main__":
    main()
