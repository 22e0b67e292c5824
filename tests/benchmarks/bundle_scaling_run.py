# ruff: noqa: T201 (it prints what it measures)
"""One adjustment of a simulated nadir block in a process of its own: strips, images of a strip, points.

Prints one line of JSON. RTK positions, self-calibration, least squares of all rays, covariances of all orientations.
"""

import json
import sys
import time

import numpy as np

from tests.benchmarks.bundle_runs import forget_peak, peak_mb
from tests.benchmarks.nadir_blocks import nadir_block
from uavkit.core.adjustment import AdjustmentOptions
from uavkit.process.bundle import adjust_block

OPTIONS = AdjustmentOptions(robust=False)


def main() -> None:
    """Run the block named in the arguments."""
    strips, images, points = (int(argument) for argument in sys.argv[1:4])
    adjust_block(nadir_block(np.random.default_rng(0), 3, 5, 600), OPTIONS)
    adjust_block(nadir_block(np.random.default_rng(0), 6, 20, 4000), OPTIONS)
    given = nadir_block(np.random.default_rng(1), strips, images, points)
    loaded = forget_peak()
    begin, begin_cpu = time.perf_counter(), time.process_time()
    result = adjust_block(given, OPTIONS)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    sigmas = np.sqrt(np.einsum("nkk->nk", result.exterior_covariances))
    row = {
        "seconds": round(seconds, 3), "cpu_s": round(cpu, 3), "peak_mb": round(peak_mb(), 1),
        "loaded_mb": round(loaded, 1), "rays": len(given.rays), "points": len(given.points_m),
        "iterations": result.iterations, "sigma0": result.sigma0, "redundancy": result.redundancy,
        "covariances": int(np.count_nonzero(np.all(sigmas > 0.0, axis=1))),
        "median_sigma_height_mm": round(1e3 * float(np.median(sigmas[:, 2])), 2),
    }  # fmt: skip
    print(json.dumps(row))


if __name__ == "__main__":
    main()
