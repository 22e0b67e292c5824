"""Collinearity equations with all derivatives, one ray at a time (checked against ``core.collinearity``)."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

Array = NDArray[np.float64]

LEAST_DEPTH_M = 1e-6
"""A point nearer to the image plane through the projection centre than this is not in front of the camera."""


@kernel
def project(interior: Array, centre: Array, rotation: Array, point: Array, out: Array) -> bool:
    """Write (column, row) of a point to ``out``; False, and ``out`` untouched, where it is not before the camera."""
    dx, dy, dz = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    w = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if not w < -LEAST_DEPTH_M:
        return False
    x = -(rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz) / w
    y = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz) / w
    r2 = x * x + y * y
    radial = 1.0 + r2 * (interior[3] + r2 * (interior[4] + r2 * interior[5]))
    xd = x * radial + interior[6] * 2.0 * x * y + interior[7] * (r2 + 2.0 * x * x)
    yd = y * radial + interior[6] * (r2 + 2.0 * y * y) + interior[7] * 2.0 * x * y
    out[0] = interior[1] + interior[0] * ((1.0 + interior[8]) * xd + interior[9] * yd)
    out[1] = interior[2] + interior[0] * yd
    return True


@kernel
def differentiate(
    interior: Array, centre: Array, rotation: Array, point: Array, out: Array, by_point: Array, by_rotation: Array,
    by_interior: Array,
) -> bool:  # fmt: skip
    """Write (column, row) and its derivatives, (2, 3), (2, 3) and (2, 10), as in ``CollinearityDerivatives``.

    The derivative by the projection centre is minus that by the point. False where the point is not before the camera.
    """
    dx, dy, dz = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    u = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    v = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    w = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    if not w < -LEAST_DEPTH_M:
        return False
    c, b1, b2 = interior[0], interior[8], interior[9]
    k1, k2, k3, p1, p2 = interior[3], interior[4], interior[5], interior[6], interior[7]
    x, y = -u / w, v / w
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    xd = x * radial + p1 * 2.0 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * 2.0 * x * y
    out[0] = interior[1] + c * ((1.0 + b1) * xd + b2 * yd)
    out[1] = interior[2] + c * yd
    cross = x * y * slope + 2.0 * (p1 * x + p2 * y)
    xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    for row in range(2):
        if row == 0:
            by_x, by_y = c * ((1.0 + b1) * xx + b2 * cross), c * ((1.0 + b1) * cross + b2 * yy)
        else:
            by_x, by_y = c * cross, c * yy
        by_u, by_v, by_w = -by_x / w, by_y / w, (by_x * u - by_y * v) / (w * w)
        for axis in range(3):
            by_point[row, axis] = by_u * rotation[axis, 0] + by_v * rotation[axis, 1] + by_w * rotation[axis, 2]
        by_rotation[row, 0] = by_v * w - by_w * v
        by_rotation[row, 1] = by_w * u - by_u * w
        by_rotation[row, 2] = by_u * v - by_v * u
    _differentiate_by_interior(interior, x, y, by_interior)
    return True


@kernel
def _differentiate_by_interior(interior: Array, x: float, y: float, out: Array) -> None:
    """Write d(column, row) / d(interior parameters), (2, 10), at an ideal normalised image point."""
    c, b1, b2 = interior[0], interior[8], interior[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (interior[3] + r2 * (interior[4] + r2 * interior[5]))
    xd = x * radial + interior[6] * 2.0 * x * y + interior[7] * (r2 + 2.0 * x * x)
    yd = y * radial + interior[6] * (r2 + 2.0 * y * y) + interior[7] * 2.0 * x * y
    out[0, 0], out[1, 0] = (1.0 + b1) * xd + b2 * yd, yd
    out[0, 1], out[1, 1] = 1.0, 0.0
    out[0, 2], out[1, 2] = 0.0, 1.0
    power = c
    for order in range(3):
        power *= r2
        out[0, 3 + order] = power * ((1.0 + b1) * x + b2 * y)
        out[1, 3 + order] = power * y
    out[0, 6] = c * ((1.0 + b1) * 2.0 * x * y + b2 * (r2 + 2.0 * y * y))
    out[1, 6] = c * (r2 + 2.0 * y * y)
    out[0, 7] = c * ((1.0 + b1) * (r2 + 2.0 * x * x) + b2 * 2.0 * x * y)
    out[1, 7] = c * 2.0 * x * y
    out[0, 8], out[1, 8] = c * xd, 0.0
    out[0, 9], out[1, 9] = c * yd, 0.0


@kernel
def direction(interior: Array, rotation: Array, column: float, row: float, out: Array) -> bool:
    """Write the unit vector of a ray in object space; False where the distortion cannot be inverted there."""
    yd = (row - interior[2]) / interior[0]
    xd = ((column - interior[1]) / interior[0] - interior[9] * yd) / (1.0 + interior[8])
    k1, k2, k3, p1, p2 = interior[3], interior[4], interior[5], interior[6], interior[7]
    x, y = xd, yd
    found = False
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        ex = x * radial + p1 * 2.0 * x * y + p2 * (r2 + 2.0 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * 2.0 * x * y - yd
        if abs(ex) + abs(ey) < 1e-10:
            found = True
            break
        cross = x * y * slope + 2.0 * (p1 * x + p2 * y)
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        determinant = xx * yy - cross * cross
        if determinant < 0.05:
            break
        x -= (yy * ex - cross * ey) / determinant
        y -= (xx * ey - cross * ex) / determinant
    if not found:
        return False
    length = np.sqrt(1.0 + x * x + y * y)
    for axis in range(3):
        out[axis] = (rotation[axis, 0] * x - rotation[axis, 1] * y - rotation[axis, 2]) / length
    return True
