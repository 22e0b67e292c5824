"""Absolute orientation: the similarity transformation from a model to object space, robust against blunders."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from uavkit.core.angles import nearest_rotation
from uavkit.core.arrays import Array, Flags
from uavkit.core.errors import AdjustmentError

_MOST_SAMPLES = 3000


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """object = scale R model + shift."""

    scale: float
    R_object_from_model: Array
    shift_m: Array

    def apply(self, points: Array) -> Array:
        """Transform points (n, 3)."""
        return np.asarray(self.scale * points @ self.R_object_from_model.T + self.shift_m)


def fit_similarity(model: Array, target: Array) -> Similarity:
    """Return the least squares similarity of points (n, 3) to points (n, 3), n >= 3 (Umeyama 1991).

    Raises AdjustmentError where the points lie in one place.
    """
    middle_model, middle_target = model.mean(axis=0), target.mean(axis=0)
    centred_model, centred_target = model - middle_model, target - middle_target
    spread = float(np.sum(centred_model**2))
    if spread <= 0.0:
        raise AdjustmentError("all points of the absolute orientation lie in one place")
    covariance = centred_target.T @ centred_model
    rotation = nearest_rotation(covariance)
    scale = float(np.trace(rotation.T @ covariance)) / spread
    return Similarity(
        scale=scale, R_object_from_model=rotation, shift_m=middle_target - scale * rotation @ middle_model
    )


def robust_similarity(
    model: Array, target: Array, sigma_m: Array, up_in_model: Array, rng: np.random.Generator
) -> tuple[Similarity, Flags]:
    """Return the similarity of points (n, 3) to fixes (n, 3) with sigmas (n, 3), and which fixes agree with it.

    Least median of squares over triples (Rousseeuw 1984), then least squares of what agrees within 3 robust sigmas.
    ``up_in_model`` (3,) is where the images, looking down, have their up: it fixes the rotation about a single
    straight strip, which the positions cannot. Raises AdjustmentError for less than 3 fixes.
    """
    n = len(model)
    if n < 3:
        raise AdjustmentError(f"absolute orientation needs at least 3 positions, there are {n}")
    best, best_median = None, np.inf
    for triple in _triples(n, rng):
        candidate = _with_up(model[triple], target[triple], sigma_m[triple], up_in_model)
        if candidate is None:
            continue
        squares = _normalised_squares(candidate, model, target, sigma_m)
        median = float(np.partition(squares, n // 2)[n // 2]) if n > 3 else float(squares.sum())
        if median < best_median:
            best, best_median = candidate, median
    if best is None:
        raise AdjustmentError("the positions of the stills coincide: no scale and no direction follow from them")
    scale = max(1.0, float(np.sqrt(best_median / 2.366)))  # 2.366: median of chi-square with 3 degrees of freedom
    agrees = _normalised_squares(best, model, target, sigma_m) < (3.4 * scale) ** 2
    for _ in range(5):
        if agrees.sum() < 3:
            break
        refined = _with_up(model[agrees], target[agrees], sigma_m[agrees], up_in_model)
        if refined is None:
            break
        best, before = refined, agrees
        agrees = _normalised_squares(best, model, target, sigma_m) < (3.4 * scale) ** 2
        if np.array_equal(agrees, before):
            break
    return best, np.asarray(agrees)


def _triples(n: int, rng: np.random.Generator) -> Array:
    """Return all triples of n rows, or a sample of them, shape (t, 3)."""
    if n * (n - 1) * (n - 2) // 6 <= _MOST_SAMPLES:
        return np.array(list(combinations(range(n), 3)))
    return np.array([rng.choice(n, 3, replace=False) for _ in range(_MOST_SAMPLES)])


def _normalised_squares(similarity: Similarity, model: Array, target: Array, sigma_m: Array) -> Array:
    return np.asarray(np.sum(((target - similarity.apply(model)) / sigma_m) ** 2, axis=1))


def _with_up(model: Array, target: Array, sigma_m: Array, up_in_model: Array) -> Similarity | None:
    """Fit a similarity; positions nearly in a line get the direction up as a further observation."""
    length = float(np.sqrt(np.sum((target - target.mean(axis=0)) ** 2)))
    length_model = float(np.sqrt(np.sum((model - model.mean(axis=0)) ** 2)))
    if length_model <= 0.0 or length < 3.0 * float(sigma_m.max()) / np.sqrt(len(model)):
        return None
    # The model tells the width: that of the positions themselves grows with their noise and their number.
    width = length / length_model * float(np.linalg.svd(model - model.mean(axis=0), compute_uv=False)[1])
    if width > 5.0 * float(sigma_m.max()):  # the rotation about the strip is then good to 1 / 5 rad
        return fit_similarity(model, target)
    # Two more points above the middle: their weight is that of the direction up, good to some degrees.
    ratio = length / length_model
    top_model = model.mean(axis=0) + 0.3 * length_model * up_in_model
    top_target = target.mean(axis=0) + 0.3 * length_model * ratio * np.array([0.0, 0.0, 1.0])
    return fit_similarity(np.vstack([model, top_model]), np.vstack([target, top_target]))
