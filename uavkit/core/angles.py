"""Rotations: omega, phi, kappa and small rotation vectors."""

import numpy as np

from uavkit.core.arrays import Array


def rotation_from_omega_phi_kappa(omega: float, phi: float, kappa: float) -> Array:
    """Return R_object_from_image = Rx(omega) Ry(phi) Rz(kappa), shape (3, 3); angles in radians.

    Kraus, Photogrammetry, vol. 1, sec. 2.1.2.
    """
    so, co, sp, cp, sk, ck = np.sin(omega), np.cos(omega), np.sin(phi), np.cos(phi), np.sin(kappa), np.cos(kappa)
    return np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )


def omega_phi_kappa_from_rotation(rotation: Array) -> tuple[float, float, float]:
    """Return (omega, phi, kappa) in radians of R_object_from_image; at phi = +-90 degrees omega is set to zero."""
    r = np.asarray(rotation, dtype=np.float64)
    cos_phi = float(np.hypot(r[0, 0], r[0, 1]))
    phi = float(np.arctan2(r[0, 2], cos_phi))
    omega = 0.0 if cos_phi < 1e-12 else float(np.arctan2(-r[1, 2], r[2, 2]))
    # Near +-90 degrees omega is uncertain; kappa from Rx(omega)^T R, not from the first row, makes up for its error.
    second_row = np.cos(omega) * r[1] + np.sin(omega) * r[2]
    return omega, phi, float(np.arctan2(second_row[0], second_row[1]))


def skew(vector: Array) -> Array:
    """Return the matrix S with S @ x = vector x x (cross product), shape (..., 3, 3)."""
    v = np.asarray(vector, dtype=np.float64)
    zero = np.zeros(v.shape[:-1])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    rows = [np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, axis=-2)


def rotation_from_vector(vector: Array) -> Array:
    """Return exp(skew(vector)), shape (..., 3, 3), of rotation vectors (..., 3) in radians (Rodrigues)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    s = skew(v)
    safe = np.where(angle < 1e-8, 1.0, angle)
    first = np.where(angle < 1e-8, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    second = np.where(angle < 1e-8, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + first * s + second * (s @ s))


def vector_from_rotation(rotation: Array) -> Array:
    """Return the rotation vector (3,) in radians, angle 0 to pi, of a rotation matrix (3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    axis_sin = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine, cosine = float(np.linalg.norm(axis_sin)), 0.5 * (float(np.trace(r)) - 1.0)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-6:
        return np.asarray(axis_sin * (angle / sine))
    if cosine > 0.0:
        return axis_sin
    values, vectors = np.linalg.eigh(0.5 * (r + r.T))
    axis = vectors[:, int(np.argmax(values))]
    return np.asarray(axis * (angle if axis @ axis_sin >= 0.0 else -angle))


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation matrix nearest to a (3, 3) matrix in the Frobenius norm, by singular values."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt)


def omega_phi_kappa_jacobian(rotation: Array) -> Array:
    """Return d(omega, phi, kappa) / d(rotation vector), (3, 3), for R <- R exp(skew(vector)): propagates covariances.

    Derived from R^-1 dR = skew(J_body d(opk)); columns of J_body are the body-frame axes of the three rotations.
    """
    _, phi, kappa = omega_phi_kappa_from_rotation(rotation)
    sk, ck, sp, cp = np.sin(kappa), np.cos(kappa), np.sin(phi), np.cos(phi)
    body = np.array([[cp * ck, sk, 0.0], [-cp * sk, ck, 0.0], [sp, 0.0, 1.0]])
    return np.asarray(np.linalg.pinv(body))
