"""The result of process on disk: ``adjustment.json`` to read, and the whole oriented block without loss as npz.

In ``adjustment.json`` a value that does not exist (no check points, a point that is not determined) is null, never 0
and never NaN. Coordinates and differences are in the local frame: east, north, up.
"""

import json
import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.camera import INTERIOR_PARAMETERS
from uavkit.core.errors import InputError
from uavkit.core.points import PointKind
from uavkit.core.result import OrientedBlock, PointDifference
from uavkit.formats.atomic import atomic_path, write_text
from uavkit.formats.record_codec import NamedArrays, decode, encode, parse_json

FORMAT, VERSION = "uavkit oriented block", 1


def write_adjustment(path: Path, oriented: OrientedBlock) -> None:
    """Write ``adjustment.json``, whole or not at all."""
    text = json.dumps(_plain(adjustment_summary(oriented)), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def adjustment_summary(oriented: OrientedBlock) -> dict[str, Any]:
    """Return what ``adjustment.json`` holds."""
    result, block = oriented.adjustment, oriented.block
    residuals = result.ray_residuals_px[result.ray_used]
    return {
        "images_total": len(block.stills),
        "images_oriented": len(oriented.images),
        "unoriented": oriented.unoriented,
        "datum": result.datum.value,
        "crs": oriented.frame.crs if oriented.frame else None,
        "gsd_m": oriented.gsd_m,
        **_point_counts(oriented),
        "candidates": {
            origin: {"found": count.found, "survived": count.survived} for origin, count in oriented.candidates.items()
        },
        "video_share": oriented.video_share,
        "sigma0": result.sigma0,
        "group_sigma0": result.group_sigma0,
        "redundancy": result.redundancy,
        "iterations": result.iterations,
        "converged": result.converged,
        "rms_residual_px": _rms(residuals),
        "rms_residual_column_px": _rms(residuals[:, 0]),
        "rms_residual_row_px": _rms(residuals[:, 1]),
        **_check_rmse(oriented.check),
        "check_points": [_difference(item) for item in oriented.check],
        "control_points": [_difference(item) for item in oriented.control],
        **_gnss(oriented),
        "interior_orientation": interior_summary(oriented),
        "notes": [*block.notes, *oriented.notes],
        "seconds": oriented.seconds,
        "peak_memory_mb": oriented.peak_memory_mb,
    }


def interior_summary(oriented: OrientedBlock) -> dict[str, Any]:
    """Return values, sigmas and correlations of the adjusted interior orientation; null for what stayed fixed."""
    result = oriented.adjustment
    sigma = np.sqrt(np.diag(result.interior_covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = result.interior_covariance / np.outer(sigma, sigma)
    free = [number for number in range(len(sigma)) if sigma[number] > 0]
    return {
        "camera": oriented.block.camera.name,
        "width_px": result.interior.width_px,
        "height_px": result.interior.height_px,
        "values": dict(zip(INTERIOR_PARAMETERS, result.interior.parameters().tolist(), strict=True)),
        "sigmas": {
            name: float(sigma[number]) if number in free else None for number, name in enumerate(INTERIOR_PARAMETERS)
        },
        "correlations": {
            INTERIOR_PARAMETERS[row]: {INTERIOR_PARAMETERS[column]: float(correlation[row, column]) for column in free}
            for row in free
        },
        "undetermined": list(result.undetermined_interior),
    }


def write_oriented_block(path: Path, oriented: OrientedBlock) -> None:
    """Write the whole result of process as one npz file, whole or not at all."""
    store = NamedArrays({})
    content = {"format": FORMAT, "version": VERSION, "oriented_block": encode(oriented, store)}
    text = json.dumps(content, ensure_ascii=False, allow_nan=False).encode()
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, record=np.frombuffer(text, dtype=np.uint8), **store.arrays)  # type: ignore[arg-type]


def read_oriented_block(path: Path) -> OrientedBlock:
    """Read the whole result of process; raises InputError for another format or version, and for damage."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, EOFError, ValueError, KeyError, NotImplementedError, zlib.error, zipfile.BadZipFile) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged or of another format"
        raise InputError(f"{path}: cannot be read ({why}): run process again") from error
    record = arrays.pop("record", np.zeros(0, dtype=np.uint8))
    content = parse_json(path, record.tobytes())
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path}: this is no result of process: run process again")
    if content.get("version") != VERSION:
        raise InputError(
            f"{path}: the result has version {content.get('version')}, this uavkit reads {VERSION}: run process again"
        )
    return decode(OrientedBlock, content.get("oriented_block"), NamedArrays(arrays), f"{path}: oriented block")


def _point_counts(oriented: OrientedBlock) -> dict[str, Any]:
    """Count rays and points that are in the adjusted block: used rays, determined points."""
    result = oriented.adjustment
    determined = np.all(np.isfinite(result.points_m), axis=1)
    kinds = oriented.point_kinds[determined]
    return {
        "rays": int(np.count_nonzero(result.ray_used)),
        "rays_rejected": int(np.count_nonzero(~result.ray_used)),
        "object_points": int(np.count_nonzero(determined)),
        "pass_points": int(np.count_nonzero(kinds == PointKind.PASS)),
        "tie_points": int(np.count_nonzero(kinds == PointKind.TIE)),
        "points_undetermined": int(np.count_nonzero(~determined)),
    }


def _check_rmse(check: Sequence[PointDifference]) -> dict[str, float | None]:
    """Return the RMSE of the check points; in plan of both axes together, sqrt(mean(dx^2 + dy^2))."""
    d = np.array([item.difference_m for item in check], dtype=np.float64).reshape(-1, 3)
    d = d[np.all(np.isfinite(d), axis=1)]
    if len(d) == 0:
        return {"check_rmse_xy_m": None, "check_rmse_z_m": None}
    return {
        "check_rmse_xy_m": float(np.sqrt(np.mean(d[:, 0] ** 2 + d[:, 1] ** 2))),
        "check_rmse_z_m": float(np.sqrt(np.mean(d[:, 2] ** 2))),
    }


def _difference(item: PointDifference) -> dict[str, Any]:
    return {
        "name": item.name,
        "difference_m": list(item.difference_m),
        "sigma_m": list(item.sigma_m),
        "rays": item.rays,
        "gsd_m": item.gsd_m,
    }


def _gnss(oriented: OrientedBlock) -> dict[str, Any]:
    """Return the shift of each flight with its sigma, and the images whose positions were rejected."""
    result = oriented.adjustment
    sigma = np.sqrt(np.diagonal(result.gnss_shift_covariance_m2, axis1=1, axis2=2))
    return {
        "gnss_positions": len(result.gnss_used),
        "gnss_rejected": _rejected_images(oriented),
        "gnss_shift_m": result.gnss_shift_m.tolist(),
        "gnss_shift_sigma_m": sigma.tolist(),
        "gnss_latency_s": result.gnss_latency_s.tolist(),
        "gnss_latency_sigma_s": result.gnss_latency_sigma_s.tolist(),
    }


def _rejected_images(oriented: OrientedBlock) -> list[str]:
    """Name the rejected positions' images; the rows of ``gnss_used`` are the positions of oriented images, in order."""
    gnss, used = oriented.block.gnss, oriented.adjustment.gnss_used
    if gnss is None or len(used) == 0:
        return []
    names = [oriented.block.stills[index].name for index in gnss.image_index]
    if len(names) != len(used):
        names = [name for name in names if name in set(oriented.images)]
    if len(names) != len(used):
        raise ValueError(f"{len(used)} adjusted GNSS positions do not fit the block's {len(names)}")
    return [name for name, kept in zip(names, used, strict=True) if not kept]


def _rms(values: Array) -> float | None:
    """Return the root mean square of all numbers, None of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _plain(value: Any) -> Any:
    """Replace NaN and infinities, at any depth, by None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
