"""The bundle block adjustment: its input, its options and its result."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import InteriorOrientation, InteriorSigmas
from uavkit.core.observations import ControlObservations, GnssObservations, Rays


class Datum(Enum):
    """What fixes position, rotation and scale of the block."""

    CONTROL = "control"
    GNSS = "gnss"
    FREE_NETWORK = "free network"


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentInput:
    """Observations and approximate values of a block; images and points are rows of arrays.

    Check points are ordinary object points here: their surveyed coordinates are held back by the caller.
    """

    interior: InteriorOrientation
    interior_sigmas: InteriorSigmas
    """A priori; a parameter of sigma 0 stays fixed. The a priori value is ``interior_prior``'s, or ``interior``'s."""
    interior_prior: InteriorOrientation | None = None
    """Values that the a priori sigmas belong to, where ``interior`` is already a better approximation."""
    interiors: tuple[InteriorOrientation, ...] = ()
    """Where not all images have the same interior orientation: approximate, and a priori, values of each."""
    interior_index: Indices | None = None
    """(n,) row in ``interiors`` of each image; None: ``interior`` holds for all. Where no two images share one, its
    free parameters count among the unknowns of the image, else they are few and count for the block."""
    projection_centres_m: Array
    """(n, 3) approximate."""
    R_object_from_image: Array
    """(n, 3, 3) approximate."""
    points_m: Array
    """(m, 3) approximate."""
    rays: Rays
    gnss: GnssObservations | None = None
    control: ControlObservations | None = None

    def __post_init__(self) -> None:
        index = self.interior_index
        if (index is None) != (len(self.interiors) == 0):
            raise ValueError("interiors and interior_index belong together")
        if index is not None and not np.array_equal(np.unique(index), np.arange(len(self.interiors))):
            raise ValueError(f"interior_index must name each of {len(self.interiors)} interiors, and no other")


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentOptions:
    """How a block is adjusted."""

    datum: Datum | None = None
    """None: control with at least 3 control points (or 1 beside GNSS), else GNSS with at least 3 fixes, else free."""
    tukey_c: float = 6.0
    """Constant C of Tukey's biweight, 5 to 9."""
    reject_above: float = 4.0
    """In the last pass, observations with |z| above this are left out."""
    robust: bool = True
    """False: plain least squares of all observations at their stated sigmas."""
    default_shift_sigma_m: tuple[float, float, float] = (2.0, 2.0, 3.0)
    """A priori sigma of each flight's GNSS shift where no control fixes the datum and the observations state none."""
    most_iterations: int = 50
    convergence: float = 1e-3
    """Largest change of an unknown, in its own sigma, at which the iteration ends."""
    point_covariances: bool = True

    def __post_init__(self) -> None:
        if not 3.0 <= self.tukey_c <= 20.0:
            raise ValueError(f"tukey_c must be 3 to 20 (5 to 9 are usual), is {self.tukey_c}")
        if not self.reject_above >= 2.5:
            raise ValueError(f"reject_above must be >= 2.5, is {self.reject_above}")


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentResult:
    """An adjusted block with its precision; covariances belong to the stated a priori sigmas, unscaled."""

    interior: InteriorOrientation
    interior_covariance: Array
    """(10, 10); rows of fixed parameters are zero."""
    undetermined_interior: tuple[str, ...]
    """Parameters whose a posteriori sigma stays above 0.9 of the a priori one: the block does not determine them."""
    projection_centres_m: Array
    """(n, 3)."""
    R_object_from_image: Array
    """(n, 3, 3)."""
    exterior_covariances: Array
    """(n, 6, 6) of centre (m) and rotation vector in image space (rad), R <- R exp(skew(vector))."""
    points_m: Array
    """(m, 3); NaN where a point lost too many rays to be determined."""
    point_covariances_m2: Array
    """(m, 3, 3); NaN likewise."""
    ray_used: Flags
    """(k,) False where rejected."""
    ray_residuals_px: Array
    """(k, 2) observed minus adjusted."""
    ray_redundancy: Array
    """(k, 2) redundancy numbers, 0 to 1; of rejected rays NaN."""
    gnss_used: Flags
    """(g,)."""
    gnss_residuals_m: Array
    """(g, 3) observed minus adjusted, after shift and latency."""
    gnss_shift_m: Array
    """(flights, 3)."""
    gnss_shift_covariance_m2: Array
    """(flights, 3, 3)."""
    gnss_latency_s: Array = field(default_factory=lambda: np.zeros(0))
    """(flights,) see ``GnssObservations``; empty where no latency was estimated."""
    gnss_latency_sigma_s: Array = field(default_factory=lambda: np.zeros(0))
    """(flights,)."""
    control_used: Flags
    """(c,)."""
    control_residuals_m: Array
    """(c, 3) observed minus adjusted."""
    sigma0: float
    """Square root of the weighted sum of squared residuals over the redundancy, at the sigmas stated beforehand."""
    redundancy: float
    group_sigma0: dict[str, float] = field(default_factory=dict)
    """sigma0 of each group of observations: "rays", "gnss", "control", "interior"."""
    datum: Datum = Datum.CONTROL
    iterations: int = 0
    converged: bool = True
    joint_points: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Rows of the points for which a joint covariance was asked for."""
    joint_covariance_m2: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(3 j, 3 j) covariance of all joint points together."""
    interiors: tuple[InteriorOrientation, ...] = ()
    """Each interior orientation of the input; ``interior`` is the first."""
    interior_covariances: Array = field(default_factory=lambda: np.zeros((0, 10, 10)))
    """(g, 10, 10)."""
    notes: tuple[str, ...] = ()
    """In words: doubtful points left out, an iteration that did not end."""
