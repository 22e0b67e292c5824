"""Automatic exposure that jumps: from still to still, and in the finder shortly before each of them."""

import numpy as np

from uavkit.core.arrays import Array

LEAD_S = 0.35
"""From the middle of the finder's jump to the exposure: the camera meters before it exposes."""
RAMP_S = 0.1
"""How long the jump takes."""


def still_factors(count: int, jump: float) -> Array:
    """Factors (count,) of the stills' exposures: neighbours differ by the factor 1 + jump, their mean stays."""
    return np.asarray((1.0 + jump) ** (np.arange(count) % 2 - 0.5) if jump else np.ones(count))


def finder_factor(time_s: float, exposure_s: Array, jump: float) -> float:
    """Factor of the finder's gain at a time: that of the next still from just before its exposure on."""
    factors = still_factors(len(exposure_s), jump)
    knots_s = (exposure_s[1:, None] - LEAD_S + np.array([-0.5, 0.5]) * RAMP_S).ravel()
    values = np.log(np.column_stack([factors[:-1], factors[1:]]).ravel())
    return float(np.exp(np.interp(time_s, knots_s, values))) if len(exposure_s) > 1 else float(factors[0])
