"""The bundle against a published adjustment: aerial block "sxb" of the Damped Bundle Adjustment Toolbox (Boerlin)."""

import re
from pathlib import Path

import numpy as np
import pytest

from uavkit.core.adjustment import AdjustmentInput, AdjustmentOptions, AdjustmentResult, Datum
from uavkit.core.angles import omega_phi_kappa_from_rotation, omega_phi_kappa_jacobian, rotation_from_omega_phi_kappa
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.observations import ControlObservations, Rays
from uavkit.process.bundle import adjust_block
from uavkit.process.intersection import Orientations, intersect_points

SXB = Path(__file__).resolve().parents[2] / "../shared/data/adjustment/dbat/sxb"
ORIGIN = np.array([1_000_000.0, 112_000.0, 0.0])
CHECK = (351, 410)

pytestmark = pytest.mark.skipif(not SXB.exists(), reason="the reference data are not beside the project")

# 53.148 mm x 77.976 mm at 6 um. The toolbox counts pixels from the corner of the picture, so the first centre is 0.5.
PIXEL_OF_FIRST_CENTRE = 0.5
INTERIOR = InteriorOrientation(
    width_px=8858, height_px=12996, principal_distance_px=123.9392 / 0.006,
    x0_px=26.5770 / 0.006 - PIXEL_OF_FIRST_CENTRE, y0_px=38.8110 / 0.006 - PIXEL_OF_FIRST_CENTRE,
)  # fmt: skip


def _table(path: Path) -> list[list[str]]:
    lines = [line.split("#")[0].strip() for line in path.read_text(encoding="utf-8").splitlines()]
    return [[cell.strip() for cell in line.split(",")] for line in lines if line]


def _report() -> tuple[np.ndarray, np.ndarray]:
    """Return omega, phi, kappa (degrees), centre of the five images and their deviations, (5, 6) each."""
    text = (SXB / "result/report.txt").read_text(encoding="latin-1")
    part = text[text.index("Photograph Standard Deviations") : text.index("Quality")]
    found = re.findall(r"(?:Omega|Phi|Kappa|Xc|Yc|Zc):\s+Value:\s+(\S+) \w+\s+Deviation: (\S+)", part)
    values = np.array(found, dtype=float).reshape(5, 6, 2)
    return values[:, :, 0], values[:, :, 1]


def _input() -> tuple[AdjustmentInput, list[int]]:
    marks = [(row, 0.5) for row in _table(SXB / "measurements/markpts.txt")]
    marks += [(row, 1.0) for row in _table(SXB / "measurements/smartpts.txt")]
    names = sorted({int(row[0]) for row, _ in marks})
    rays = Rays(
        image_index=np.array([int(row[1]) - 1 for row, _ in marks]),
        point_index=np.searchsorted(names, [int(row[0]) for row, _ in marks]),
        xy_px=np.array([[float(row[2]), float(row[3])] for row, _ in marks]) - PIXEL_OF_FIRST_CENTRE,
        sigma_px=np.array([[sigma, sigma] for _, sigma in marks]),
    )
    surveyed = [row for row in _table(SXB / "reference/sxb-control.txt") if int(row[0]) not in CHECK]
    control = ControlObservations(
        point_index=np.searchsorted(names, [int(row[0]) for row in surveyed]),
        position_m=np.array([row[2:5] for row in surveyed], dtype=float) - ORIGIN,
        sigma_m=np.array([row[5:8] for row in surveyed], dtype=float),
    )
    values, _ = _report()
    centres = values[:, 3:] - ORIGIN + np.array([5.0, -8.0, 6.0])
    rotations = np.array([rotation_from_omega_phi_kappa(*np.radians(row[:3] + [0.1, -0.1, 0.3])) for row in values])
    orientations = Orientations(interior=INTERIOR, projection_centres_m=centres, R_object_from_image=rotations)
    points = intersect_points(rays, orientations, len(names)).points_m
    points[control.point_index] = control.position_m
    return (
        AdjustmentInput(
            interior=INTERIOR, interior_sigmas=InteriorSigmas(), projection_centres_m=centres,
            R_object_from_image=rotations, points_m=points, rays=rays, control=control,
        ),
        names,
    )  # fmt: skip


@pytest.fixture(scope="module")
def adjusted() -> tuple[AdjustmentResult, list[int]]:
    observations, names = _input()
    return adjust_block(observations, AdjustmentOptions(robust=False)), names


def test_sigma0_and_redundancy(adjusted: tuple[AdjustmentResult, list[int]]) -> None:
    result, _ = adjusted
    assert result.datum is Datum.CONTROL
    assert result.redundancy == 1261
    assert result.sigma0 == pytest.approx(1.1786, abs=6e-5)


def test_orientations_to_the_digits_printed(adjusted: tuple[AdjustmentResult, list[int]]) -> None:
    result, _ = adjusted
    values, deviations = _report()
    for i in range(5):
        rotation = result.R_object_from_image[i]
        np.testing.assert_allclose(result.projection_centres_m[i] + ORIGIN, values[i, 3:], atol=2e-4)
        np.testing.assert_allclose(np.degrees(omega_phi_kappa_from_rotation(rotation)), values[i, :3], atol=2e-6)
        # The toolbox multiplies its deviations by sigma0.
        covariance = result.sigma0**2 * result.exterior_covariances[i]
        centre = np.sqrt(np.diag(covariance)[:3])
        jacobian = omega_phi_kappa_jacobian(rotation)
        angles = np.degrees(np.sqrt(np.diag(jacobian @ covariance[3:, 3:] @ jacobian.T)))
        np.testing.assert_allclose(centre, deviations[i, 3:], rtol=6e-3)
        np.testing.assert_allclose(angles, deviations[i, :3], rtol=6e-3)


@pytest.mark.parametrize(
    ("name", "position_m", "sigma_m"),
    [
        (351, (1000551.437, 112275.288, 139.401), (0.0551, 0.0347, 0.24)),
        (410, (999974.528, 112476.597, 139.856), (0.0345, 0.0356, 0.18)),
        (403, (999170.661, 112692.523, 139.636), (0.023, 0.0227, 0.0469)),
        (492, (999606.884, 112342.389, 139.140), (0.0204, 0.0196, 0.0451)),
    ],
)
def test_object_points(
    adjusted: tuple[AdjustmentResult, list[int]], name: int, position_m: tuple[float, ...], sigma_m: tuple[float, ...]
) -> None:
    result, names = adjusted
    row = names.index(name)
    np.testing.assert_allclose(result.points_m[row] + ORIGIN, position_m, atol=6e-4)
    sigma = result.sigma0 * np.sqrt(np.diag(result.point_covariances_m2[row]))
    np.testing.assert_allclose(sigma, sigma_m, rtol=2.5e-2)
