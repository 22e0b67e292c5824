"""The delay between a receiver's fixes and the vehicle's clock, from the vehicle's own estimate of its position.

A vehicle's boot clock is tied to GPS time by when the receiver's messages arrive, which is later than the epochs that
they tell: the same delay is in each pair of times, and no fit of a clock can see it. Whatever is then timed by the boot
clock (the estimate, attitudes, exposures) gets a GPS time that is too early by the delay. The estimate's positions
show it: at the fix's epoch they are those of a later moment, ahead along the track by speed times delay, whatever the
direction of flight, whereas a constant difference of place is that of antenna and estimate. A receiver that stamps its
positions too late shows in the same way, and the same correction brings exposures and fixes together.

What cannot be told is by how much the estimate itself lags behind the vehicle: that is as if the delay were shorter.
Against the truth of a simulated ArduCopter 4.6 they lagged by 0.024 s: a delay of 0.083 s came out as 0.059 s.
``ESTIMATE_LAG_SIGMA_S`` stands for it, and a latency as an unknown of the bundle adjustment
(``GnssObservations.latency_sigma_s``) finds the rest.
"""

from dataclasses import dataclass

import numpy as np

from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import InputError
from uavkit.ingest.trajectory import Positions, Trajectory

LEAST_SAMPLES = 10
LEAST_SPEED_M_S = 1.0
"""Slower than this, velocities are as much noise as motion, and would make the delay look shorter than it is."""
ESTIMATE_LAG_SIGMA_S = 0.03
"""Of the time by which estimates lag behind the vehicle."""
_DELAY_STEPS = 8
_ROBUST_STEPS = 10
_HUBER_K = 1.345
_STILL_S = 1e-5
_MOST_CORRELATION = 0.99


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssDelay:
    """How late a receiver's messages reach the vehicle."""

    delay_s: float
    """To be added to GPS times that come from the boot clock before a fix's position is looked up for them."""
    sigma_s: float
    """Of the scatter, and of what the estimate may lag behind."""
    scatter_s: float
    """Sigma from the differences alone, their correlation considered: large where the vehicle flew in one direction at
    one speed, for then delay and offset are hard to tell apart."""
    offset_m: tuple[float, float]
    """Estimate minus fix, east and north: what the delay does not explain."""
    residual_m: float
    """Spread of single differences, of one axis: 1.48 times the median of their absolute values."""
    samples: int


def estimate_gnss_delay(estimates: Trajectory, fixes: Trajectory) -> GnssDelay:
    """Return the delay from an autopilot's estimate (timed by the boot clock) and a receiver's fixes (by epoch).

    Robust least squares (Huber's weights) of estimate - fix = offset + velocity * delay in east and north, while
    the vehicle moves. Raises InputError where both have hardly such a moment in common.
    """
    fix_m, delay_s = _in_frame(fixes, estimates), 0.0
    for _ in range(_DELAY_STEPS):
        found = estimates.at(fixes.gps_ns - round(delay_s * 1e9))
        # The estimate's own velocities: it is smooth, whereas a wrong fix spoils those of its neighbours.
        velocity = found.velocity_m_s[:, :2]
        good = _in_motion(found, velocity)
        value, scatter_s, spread_m = _fit(velocity[good], found.position_m[good, :2] - fix_m[good])
        delay_s += float(value[2])
        if abs(value[2]) < _STILL_S:
            break
    return GnssDelay(
        delay_s=delay_s,
        sigma_s=float(np.hypot(scatter_s, ESTIMATE_LAG_SIGMA_S)),
        scatter_s=scatter_s,
        offset_m=(float(value[0]), float(value[1])),
        residual_m=spread_m,
        samples=int(np.sum(good)),
    )


def _in_frame(fixes: Trajectory, estimates: Trajectory) -> Array:
    """Return the fixes' positions, east and north (n, 2), in the frame of the estimates."""
    place = fixes.frame.geographic_from_enu(fixes.position_m)
    return estimates.frame.enu_from_geographic(*place.T)[:, :2]


def _in_motion(found: Positions, velocity: Array) -> Flags:
    good = found.known & (np.hypot(velocity[:, 0], velocity[:, 1]) > LEAST_SPEED_M_S)
    if np.sum(good) < LEAST_SAMPLES:
        raise InputError(
            f"the vehicle's estimate and the receiver's fixes have {int(np.sum(good))} moments in motion in common: "
            f"the delay between them needs {LEAST_SAMPLES}"
        )
    return np.asarray(good, dtype=np.bool_)


def _fit(velocity: Array, difference: Array) -> tuple[Array, float, float]:
    """Return offsets east and north and the delay (3,), the delay's sigma and the spread of residuals, of (n, 2) each.

    Neighbouring residuals hang together, by a share c from one to the next: so many equal ones count as many by
    (1 + c) / (1 - c) fewer (first-order autoregression).
    """
    n = len(velocity)
    design = np.zeros((n, 2, 3))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, :, 2] = velocity
    weight, value = np.ones((n, 2)), np.zeros(3)
    for _ in range(_ROBUST_STEPS):
        normal = np.einsum("nai,na,naj->ij", design, weight, design)
        value = np.linalg.lstsq(normal, np.einsum("nai,na,na->i", design, weight, difference), rcond=1e-12)[0]
        residual = difference - design @ value
        spread_m = max(1.48 * float(np.median(np.abs(residual))), 1e-6)
        weight = np.minimum(1.0, _HUBER_K * spread_m / np.maximum(np.abs(residual), 1e-12))
    held = weight * residual
    # What is left for the delay once the offsets have taken their share: next to none for a constant velocity.
    information = normal[2, 2] - normal[2, :2] @ np.linalg.solve(normal[:2, :2], normal[:2, 2])
    variance = float(np.sum(held * residual)) / (2 * n - 3)
    together = float(np.sum(held[1:] * held[:-1])) / max(float(np.sum(held**2)), 1e-300)
    together = min(max(together, 0.0), _MOST_CORRELATION)
    inflated = variance * (1.0 + together) / (1.0 - together)
    sigma_s = float(np.sqrt(inflated / information)) if information > 1e-9 * n else float("inf")
    return np.asarray(value, dtype=np.float64), sigma_s, spread_m
