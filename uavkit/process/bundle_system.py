"""The observation equations of a block: its unknowns, one Gauss-Newton step, and the precision at a solution."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np

from uavkit.core.adjustment import AdjustmentInput, Datum
from uavkit.core.angles import rotation_from_vector, skew
from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.errors import AdjustmentError
from uavkit.process.kernels import bundle_normals as kernels
from uavkit.process.kernels.bundle_normals import Coordinates, Free, RayTable, Reduced, Unknowns
from uavkit.process.kernels.bundle_precision import Inverse, fixed_leverage, point_precision
from uavkit.process.normal_equations import (
    Factoriser,
    InnerDatum,
    Pattern,
    ReducedFactor,
    empty_reduced,
    factor_dense,
    pattern_of_rays,
)
from uavkit.process.sparse_factor import choose_factoriser

CHUNKS = 4
"""Parts into which points are shared among threads, whatever the number of processors: sums keep their order."""
SMALL = 2000
"""Blocks of fewer rays are not worth a thread."""
SINGULAR_DAMPING = 1e-5
"""Up to this, damping carries an iteration past a state of singular equations; at its end they must not be singular."""


class UndeterminedError(AdjustmentError):
    """The rays that robust weights left do not determine the unknowns."""

    def __init__(self, message: str, used: Flags) -> None:
        super().__init__(message)
        self.used = used
        """Which rays of the input had weight, (k,)."""


NONE_FREE = Free(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """Values of all unknowns."""

    interior: Array
    """(g, 10) of each interior orientation."""
    camera: Indices
    """(n,) row of each image's interior orientation."""
    centres: Array
    rotations: Array
    points: Array
    shifts: Array
    """(flights, 3) of GNSS positions."""
    latencies: Array
    """(flights,) of GNSS positions, in seconds; empty where none is unknown."""

    @property
    def unknowns(self) -> Unknowns:
        """Return the part that kernels know."""
        return Unknowns(self.interior, self.centres, self.rotations, self.points, self.camera)


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """Weights of rays (k,), GNSS fixes (g,) and control points (c,): robust weight, 0 to 1, over scale squared."""

    rays: Array
    gnss: Array
    control: Array
    scales: tuple[Array | float, float, float] = (1.0, 1.0, 1.0)
    """Factors to the stated sigmas that the weights contain: of rays (one, or (k,)), GNSS and control."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Misclosures:
    """Observed minus computed, in units of observation."""

    rays_px: Array
    gnss_m: Array
    control_m: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """Approximate orientations as observations: they hold a robust start while gross errors are still at large."""

    centres: Array
    rotations: Array
    sigma_m: float
    sigma_rad: float

    def misclosures(self, state: State) -> Array:
        """Return observed minus computed over sigma, (n, 6); rotations by the sine of their difference."""
        turn = state.rotations.transpose(0, 2, 1) @ self.rotations
        skewed = 0.5 * (turn - turn.transpose(0, 2, 1))
        vector = np.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], axis=1)
        return np.concatenate([(self.centres - state.centres) / self.sigma_m, vector / self.sigma_rad], axis=1)

    def information(self) -> Array:
        """Return the weights (6,) of an image's six unknowns."""
        return np.repeat([self.sigma_m**-2.0, self.sigma_rad**-2.0], 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleSystem:
    """Observations of a block, sorted for the kernels."""

    given: AdjustmentInput
    datum: Datum
    rays: RayTable
    order: Indices
    """(k,) row in the input of each sorted ray."""
    point_of_ray: Indices
    pattern: Pattern
    parameters: Indices
    """(q,) free parameters of each interior orientation."""
    interior: Array
    """(g, 10) approximate interior orientations."""
    camera: Indices
    """(n,) row of each image's interior orientation."""
    prior: Array
    """(g, q) a priori values of the free parameters."""
    prior_sigma: Array
    """(q,)."""
    shift_sigma_m: Array
    """(flights, 3) a priori sigma; infinite where free."""
    latency_sigma_s: Array
    """(flights,) a priori sigma; empty where there is no such unknown."""
    factorise: Factoriser = factor_dense
    anchor: Anchor | None = None

    @property
    def free(self) -> Free:
        """Return the free parameters: each image's own where no two share an interior orientation, else shared."""
        none = np.zeros(0, dtype=np.int64)
        own = 1 < len(self.interior) == len(self.camera)
        return Free(self.parameters, none) if own else Free(none, self.parameters)

    @property
    def image_unknowns(self) -> int:
        """Return the number d of unknowns of an image: its orientation, and its own interior orientation."""
        return 6 + len(self.free.own)

    @property
    def shared(self) -> int:
        """Return the number of border unknowns of interior orientations; GNSS shifts, then latencies follow."""
        return len(self.free.shared) * len(self.interior)

    @property
    def border(self) -> int:
        """Return the number of border unknowns."""
        return self.shared + self.shift_sigma_m.size + self.latency_sigma_s.size

    @property
    def first_latency(self) -> int:
        """Return the place of the first latency among the border unknowns."""
        return self.shared + self.shift_sigma_m.size

    @property
    def gnss_prior_sigma(self) -> Array:
        """Return the a priori sigmas of shifts, then latencies."""
        return np.concatenate([self.shift_sigma_m.ravel(), self.latency_sigma_s])

    @property
    def uses_gnss(self) -> bool:
        """Tell whether GNSS fixes take part."""
        return self.datum is not Datum.FREE_NETWORK and self.given.gnss is not None

    @property
    def uses_control(self) -> bool:
        """Tell whether control points take part."""
        return self.datum is not Datum.FREE_NETWORK and self.given.control is not None

    def start(self) -> State:
        """Return the approximate values."""
        given = self.given
        return State(
            interior=self.interior.copy(),
            camera=self.camera,
            centres=np.array(given.projection_centres_m, dtype=np.float64),
            rotations=np.array(given.R_object_from_image, dtype=np.float64),
            points=np.array(given.points_m, dtype=np.float64),
            shifts=np.zeros_like(self.shift_sigma_m),
            latencies=np.zeros_like(self.latency_sigma_s),
        )

    def full_weights(self) -> Weights:
        """Return weight 1 for every observation that takes part."""
        gnss = len(self.given.gnss) if self.given.gnss is not None else 0
        control = len(self.given.control) if self.given.control is not None else 0
        return Weights(
            rays=np.ones(len(self.order)),
            gnss=np.full(gnss, float(self.uses_gnss)),
            control=np.full(control, float(self.uses_control)),
        )


def build_system(
    given: AdjustmentInput, datum: Datum, default_shift_sigma_m: tuple[float, float, float]
) -> BundleSystem:
    """Sort the observations of a block by points and images."""
    rays, points, images = given.rays, len(given.points_m), len(given.projection_centres_m)
    order = np.lexsort((rays.image_index, rays.point_index)).astype(np.int64)
    point = rays.point_index[order].astype(np.int64)
    start = np.searchsorted(point, np.arange(points + 1)).astype(np.int64)
    image = rays.image_index[order].astype(np.int64)
    sigmas = given.interior_sigmas.values()
    parameters = np.flatnonzero(sigmas > 0.0).astype(np.int64)
    interior, prior = _interiors(given)
    camera = np.zeros(images, dtype=np.int64) if given.interior_index is None else given.interior_index
    pattern = pattern_of_rays(image, start, images)
    return BundleSystem(
        given=given,
        datum=datum,
        rays=RayTable(
            start,
            image,
            np.ascontiguousarray(rays.xy_px[order], dtype=np.float64),
            np.ascontiguousarray(rays.sigma_px[order], dtype=np.float64),
        ),
        order=order,
        point_of_ray=point,
        pattern=pattern,
        parameters=parameters,
        interior=interior,
        camera=np.asarray(camera, dtype=np.int64),
        prior=prior[:, parameters],
        prior_sigma=sigmas[parameters],
        shift_sigma_m=_shift_sigmas(given, datum, default_shift_sigma_m),
        latency_sigma_s=_latency_sigmas(given, datum),
        factorise=choose_factoriser(pattern, given.projection_centres_m),
    )


def _interiors(given: AdjustmentInput) -> tuple[Array, Array]:
    """Return approximate and a priori parameters (g, 10) of the interior orientations."""
    if given.interiors:
        values = np.array([interior.parameters() for interior in given.interiors])
        return values, values
    return given.interior.parameters()[None], (given.interior_prior or given.interior).parameters()[None]


def _shift_sigmas(given: AdjustmentInput, datum: Datum, default: tuple[float, float, float]) -> Array:
    """Return the a priori sigmas of the GNSS shifts, (flights, 3): infinite where control frees them."""
    if given.gnss is None or len(given.gnss) == 0 or datum is Datum.FREE_NETWORK:
        return np.zeros((0, 3))
    flights = int(np.max(given.gnss.flight)) + 1
    stated = given.gnss.shift_sigma_m
    if stated is None:
        stated = (np.inf,) * 3 if datum is Datum.CONTROL else default
    return np.tile(np.asarray(stated, dtype=np.float64), (flights, 1))


def _latency_sigmas(given: AdjustmentInput, datum: Datum) -> Array:
    """Return the a priori sigmas of the GNSS latencies, (flights,); empty where none is asked for."""
    gnss = given.gnss
    if gnss is None or len(gnss) == 0 or datum is Datum.FREE_NETWORK or gnss.latency_sigma_s is None:
        return np.zeros(0)
    return np.full(int(np.max(gnss.flight)) + 1, gnss.latency_sigma_s)


def in_chunks(system: BundleSystem, work: Callable[[int, int], T]) -> Iterable[T]:
    """Run work(first, last) over fixed ranges of points in threads; results come in the order of the points."""
    start = system.rays.start
    points, rays = len(start) - 1, int(start[-1])
    if rays < SMALL:
        return [work(0, points)]
    bounds = [0, *(int(np.searchsorted(start, rays * part // CHUNKS)) for part in range(1, CHUNKS)), points]
    return list(_pool(os.getpid()).map(work, bounds[:-1], bounds[1:]))


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process, made once (a fork has none of its parent's); they share out the chunks."""
    return ThreadPoolExecutor(min(CHUNKS, os.cpu_count() or 1), thread_name_prefix=f"bundle-{process}")


def misclosures(system: BundleSystem, state: State) -> Misclosures:
    """Return observed minus computed of all observations (rays in sorted order; NaN behind the camera)."""
    rays_px = np.empty_like(system.rays.xy_px)
    list(in_chunks(system, lambda a, b: kernels.residuals(system.rays, state.unknowns, a, b, rays_px)))
    return Misclosures(rays_px=rays_px, gnss_m=_gnss_misclosures(system, state), control_m=_control(system, state))


def _gnss_misclosures(system: BundleSystem, state: State) -> Array:
    gnss = system.given.gnss
    if gnss is None:
        return np.zeros((0, 3))
    i = gnss.image_index
    antenna = state.centres[i] + state.rotations[i] @ np.asarray(gnss.lever_arm_m)
    shift = state.shifts[gnss.flight] if len(state.shifts) else 0.0
    misclosure = np.asarray(gnss.position_m - antenna - shift)
    if len(state.latencies):
        misclosure -= _velocities(system) * state.latencies[gnss.flight][:, None]
    return misclosure


def _velocities(system: BundleSystem) -> Array:
    """Return the derivatives (g, 3) of antenna positions by their latency; none where it is no unknown."""
    gnss = system.given.gnss
    if gnss is None or gnss.velocity_m_s is None or len(system.latency_sigma_s) == 0:
        return np.zeros((0, 3))
    return gnss.velocity_m_s


def _control(system: BundleSystem, state: State) -> Array:
    control = system.given.control
    if control is None:
        return np.zeros((0, 3))
    return np.asarray(control.position_m - state.points[control.point_index])


def cost(system: BundleSystem, state: State, weights: Weights, determined: Flags) -> float:
    """Return the weighted sum of squared misclosures, the a priori ones included."""

    def work(first: int, last: int) -> float:
        return kernels.weighted_squares(system.rays, state.unknowns, weights.rays, determined, first, last)

    total = float(sum(in_chunks(system, work)))
    if system.given.gnss is not None:
        misclosure = _gnss_misclosures(system, state) / system.given.gnss.sigma_m
        total += float(np.sum(weights.gnss[:, None] * misclosure**2))
    if system.given.control is not None:
        misclosure = _control(system, state) / system.given.control.sigma_m
        total += float(np.sum(weights.control[:, None] * misclosure**2))
    total += float(np.sum(((state.interior[:, system.parameters] - system.prior) / system.prior_sigma) ** 2))
    if system.anchor is not None:
        total += float(np.sum(system.anchor.misclosures(state) ** 2))
    total += float(np.sum((state.latencies / system.latency_sigma_s) ** 2))
    return total + float(np.sum((state.shifts / system.shift_sigma_m) ** 2))


def control_coordinates(system: BundleSystem, state: State, weights: Weights) -> Coordinates:
    """Return the normal equations of control points as observed object points; none where none takes part."""
    if not system.uses_control:
        return Coordinates(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    normal, right = np.zeros((len(state.points), 3, 3)), np.zeros((len(state.points), 3))
    if system.given.control is not None:
        control = system.given.control
        p = weights.control[:, None] / control.sigma_m**2
        np.add.at(right, control.point_index, p * _control(system, state))
        np.add.at(normal, control.point_index, p[:, :, None] * np.eye(3))
    return Coordinates(normal, right)


def _add_gnss(system: BundleSystem, state: State, weights: Weights, reduced: Reduced) -> None:
    """Add GNSS positions to the reduced normal equations."""
    gnss = system.given.gnss
    if gnss is None or not system.uses_gnss:
        return
    i, by_image = gnss.image_index, gnss_design(system, state)
    p = weights.gnss[:, None] / gnss.sigma_m**2
    misclosure = _gnss_misclosures(system, state)
    weighted = by_image * p[:, :, None]
    normal = np.einsum("gak,gam->gkm", weighted, by_image)
    np.add.at(reduced.blocks[:, :6, :6], system.pattern.diagonal[i], normal)
    np.add.at(reduced.diagonal_images[:, :6], i, np.einsum("gkk->gk", normal))
    np.add.at(reduced.right_images[:, :6], i, np.einsum("gak,ga->gk", weighted, misclosure))
    by_flight = reduced.border[:, :6].transpose(0, 2, 1)
    for axis in range(3):
        column = system.shared + 3 * gnss.flight + axis
        np.add.at(by_flight, (i, column), weighted[:, axis])
        np.add.at(reduced.corner, (column, column), p[:, axis])
        np.add.at(reduced.diagonal_border, column, p[:, axis])
        np.add.at(reduced.right_border, column, p[:, axis] * misclosure[:, axis])
    if len(state.latencies):
        _add_latency(system, weighted, p, misclosure, reduced)


def _add_latency(system: BundleSystem, weighted: Array, p: Array, misclosure: Array, reduced: Reduced) -> None:
    """Add the part of the latencies; ``weighted`` (g, 3, 6) is the design by image times the weights p (g, 3)."""
    gnss = system.given.gnss
    assert gnss is not None
    velocity, column = _velocities(system), system.first_latency + gnss.flight
    weighted_velocity = p * velocity
    squares = np.sum(weighted_velocity * velocity, axis=1)
    by_flight = reduced.border[:, :6].transpose(0, 2, 1)
    np.add.at(by_flight, (gnss.image_index, column), np.einsum("gak,ga->gk", weighted, velocity))
    np.add.at(reduced.corner, (column, column), squares)
    np.add.at(reduced.diagonal_border, column, squares)
    np.add.at(reduced.right_border, column, np.sum(weighted_velocity * misclosure, axis=1))
    for axis in range(3):
        shift = system.shared + 3 * gnss.flight + axis
        np.add.at(reduced.corner, (shift, column), weighted_velocity[:, axis])
        np.add.at(reduced.corner, (column, shift), weighted_velocity[:, axis])


def gnss_design(system: BundleSystem, state: State) -> Array:
    """Return the derivatives (g, 3, 6) of antenna positions by centre and rotation: 1 and -R skew(lever arm)."""
    gnss = system.given.gnss
    assert gnss is not None
    by_rotation = -state.rotations[gnss.image_index] @ skew(np.asarray(gnss.lever_arm_m))
    return np.concatenate([np.broadcast_to(np.eye(3), by_rotation.shape), by_rotation], axis=2)


def _add_priors(system: BundleSystem, state: State, reduced: Reduced) -> None:
    """Add a priori observations of interior orientation, GNSS shifts and latencies."""
    information, value = border_priors(system, state)
    reduced.corner[np.diag_indices_from(reduced.corner)] += information
    reduced.diagonal_border[:] += information
    reduced.right_border[:] -= value * information
    if len(system.free.own):
        own = system.prior_sigma**-2.0
        reduced.blocks[system.pattern.diagonal, 6:, 6:] += np.diag(own)
        reduced.diagonal_images[:, 6:] += own
        reduced.right_images[:, 6:] -= own * (state.interior[:, system.parameters] - system.prior)[system.camera]
    if system.anchor is not None:
        information = system.anchor.information()
        reduced.blocks[system.pattern.diagonal, :6, :6] += np.diag(information)
        reduced.diagonal_images[:, :6] += information
        reduced.right_images[:, :6] += np.sqrt(information) * system.anchor.misclosures(state)


def border_priors(system: BundleSystem, state: State) -> tuple[Array, Array]:
    """Return a priori weights of the border unknowns and how far each is from its a priori value, (b,)."""
    shared = len(system.interior) if len(system.free.shared) else 0
    sigma = np.concatenate([np.tile(system.prior_sigma, shared), system.gnss_prior_sigma])
    value = (state.interior[:, system.parameters] - system.prior)[:shared].ravel()
    return sigma**-2.0, np.concatenate([value, state.shifts.ravel(), state.latencies])


def reduced_normals(system: BundleSystem, state: State, weights: Weights, damping: float) -> tuple[Reduced, Flags]:
    """Return the reduced normal equations at a state, and which points (m,) their observations determine."""
    coordinates = control_coordinates(system, state, weights)
    determined = np.zeros(len(state.points), dtype=np.bool_)
    q, d, pairs = system.shared, system.image_unknowns, system.pattern.pairs

    def work(first: int, last: int) -> Reduced:
        part = empty_reduced(system.pattern, q, d)
        kernels.accumulate(
            system.rays,
            state.unknowns,
            weights.rays,
            system.free,
            coordinates,
            damping,
            first,
            last,
            pairs,
            part,
            determined,
        )
        return part

    total = empty_reduced(system.pattern, system.border, d)
    for part in in_chunks(system, work):
        for name in ("blocks", "right_images", "diagonal_images"):
            getattr(total, name).__iadd__(getattr(part, name))
        total.border[:, :, :q] += part.border
        total.corner[:q, :q] += part.corner
        total.right_border[:q] += part.right_border
        total.diagonal_border[:q] += part.diagonal_border
    _add_gnss(system, state, weights, total)
    _add_priors(system, state, total)
    return total, determined


def inner_datum(system: BundleSystem, state: State) -> InnerDatum | None:
    """Return the seven inner constraints of a free network over the exterior orientations, or None where not needed.

    Shifts, rotations and scale about the mean centre; rotations count at the mean distance to the points, as lengths.
    """
    if system.datum is not Datum.FREE_NETWORK:
        return None
    n, d = len(state.centres), system.image_unknowns
    local = state.centres - np.mean(state.centres, axis=0)
    space = np.zeros((d * n + system.border, 7))
    images = space[: d * n].reshape(n, d, 7)
    images[:, :3, :3] = np.eye(3)
    images[:, :3, 3:6] = -skew(local)
    images[:, 3:6, 3:6] = state.rotations.transpose(0, 2, 1)
    images[:, :3, 6] = local
    distance_m = float(np.median(np.linalg.norm(state.points - np.mean(state.centres, axis=0), axis=1)))
    weight = np.zeros(len(space))
    weight[: d * n].reshape(n, d)[:, :6] = np.repeat([1.0, distance_m**2], 3)
    _, triangle = np.linalg.qr(np.sqrt(weight)[:, None] * space)
    return InnerDatum(null_space=np.asarray(np.linalg.solve(triangle.T, space.T).T), weight=weight)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A Gauss-Newton step."""

    state: State
    damping: float
    """For the next step."""
    size: float
    """sqrt(step . right-hand side): no unknown changes by more than this many of its own sigmas."""
    gain: float
    """By how much the weighted sum of squares fell, over what it would fall by if all were linear."""
    determined: Flags


def gauss_newton_step(system: BundleSystem, state: State, weights: Weights, damping: float) -> Step:
    """Return the state after one step that does not increase the weighted sum of squares.

    A step that does is halved (Armijo 1966); where that does not help, damping grows (Levenberg 1944).
    Raises UndeterminedError where the observations do not determine the unknowns.
    """
    datum = inner_datum(system, state)
    while damping < 1e6:
        reduced, determined = reduced_normals(system, state, weights, damping)
        before = cost(system, state, weights, determined)
        try:
            factor = _factored(system, weights, reduced, (damping, datum))
        except UndeterminedError:
            if damping > SINGULAR_DAMPING:
                raise
            damping = max(damping * 100.0, 1e-8)
            continue
        change = _solve(system, state, weights, damping, factor, reduced)
        for share in (1.0, 0.5, 0.25, 0.125):
            candidate = moved(system, state, change, share)
            after = cost(system, candidate, weights, determined)
            if after <= before * (1.0 + 1e-11) + 1e-9:
                product = max(change.product, 1e-300)
                return Step(
                    state=candidate,
                    damping=damping / 10.0 if damping > 1e-9 else 0.0,
                    size=float(np.sqrt(product)),
                    gain=(before - after) / product,
                    determined=determined,
                )
        damping = max(damping * 10.0, 1e-8)
    raise AdjustmentError("the adjustment does not converge: no step lessens the sum of squared residuals")


def _factored(
    system: BundleSystem, weights: Weights, reduced: Reduced, held: tuple[float, InnerDatum | None]
) -> ReducedFactor:
    """Factor normal equations with damping and datum; an error carries which rays had weight."""
    try:
        return system.factorise(reduced, *held)
    except AdjustmentError as error:
        used = np.empty(len(system.order), dtype=np.bool_)
        used[system.order] = weights.rays > 0.0
        raise UndeterminedError(str(error), used) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Changes of the unknowns, and their product with the right-hand side."""

    images: Array
    border: Array
    points: Array
    product: float


def _solve(
    system: BundleSystem, state: State, weights: Weights, damping: float, factor: ReducedFactor, reduced: Reduced
) -> Change:
    """Return the solution of the normal equations."""
    step = factor.solve(np.concatenate([reduced.right_images.ravel(), reduced.right_border]))
    n, d = len(state.centres), system.image_unknowns
    images, border = np.ascontiguousarray(step[: d * n].reshape(n, d)), np.ascontiguousarray(step[d * n :])
    coordinates, points = control_coordinates(system, state, weights), np.zeros_like(state.points)

    def work(first: int, last: int) -> float:
        return kernels.back_substitute(
            system.rays,
            state.unknowns,
            weights.rays,
            system.free,
            coordinates,
            damping,
            first,
            last,
            images,
            border,
            points,
        )

    product = float(sum(in_chunks(system, work))) + _direct_product(system, state, weights, images, border)
    return Change(images=images, border=border, points=points, product=product)


def moved(system: BundleSystem, state: State, change: Change, share: float) -> State:
    """Return a state moved by a share of a change."""
    q, last, interior = system.shared, system.first_latency, state.interior.copy()
    if q:
        interior[:, system.parameters] += share * change.border[:q].reshape(len(interior), -1)
    if len(system.free.own):
        interior[np.ix_(system.camera, system.parameters)] += share * change.images[:, 6:]
    return State(
        interior=interior,
        camera=state.camera,
        centres=state.centres + share * change.images[:, :3],
        rotations=state.rotations @ rotation_from_vector(share * change.images[:, 3:6]),
        points=state.points + share * change.points,
        shifts=state.shifts + share * change.border[q:last].reshape(-1, 3),
        latencies=state.latencies + share * change.border[last:],
    )


def _direct_product(system: BundleSystem, state: State, weights: Weights, images: Array, border: Array) -> float:
    """Return the part of step . right-hand side that GNSS and a priori observations make."""
    q = system.shared
    information, value = border_priors(system, state)
    total = -float(np.sum(border * value * information))
    if len(system.free.own):
        off = (state.interior[:, system.parameters] - system.prior)[system.camera]
        total -= float(np.sum(images[:, 6:] * off * system.prior_sigma**-2.0))
    if system.anchor is not None:
        total += float(np.sum(images[:, :6] * np.sqrt(system.anchor.information()) * system.anchor.misclosures(state)))
    if system.uses_gnss and system.given.gnss is not None:
        gnss = system.given.gnss
        moved = np.einsum("gak,gk->ga", gnss_design(system, state), images[gnss.image_index, :6])
        moved += border[q : system.first_latency].reshape(-1, 3)[gnss.flight]
        if len(state.latencies):
            moved += _velocities(system) * border[system.first_latency :][gnss.flight][:, None]
        p = weights.gnss[:, None] / gnss.sigma_m**2
        total += float(np.sum(p * moved * _gnss_misclosures(system, state)))
    return total


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """Covariances and leverages (variance of the adjusted observation over its a priori variance) at a solution."""

    factor: ReducedFactor
    inverse: Inverse
    determined: Flags
    point_covariances_m2: Array
    ray_leverage: Array
    """(k, 2), sorted order; also of rays of weight 0; NaN where the point is not determined."""
    gnss_leverage: Array
    control_leverage: Array


def precision_at(system: BundleSystem, state: State, weights: Weights) -> Precision:
    """Return the precision of all unknowns at a state, for the sigmas stated a priori."""
    reduced, determined = reduced_normals(system, state, weights, 0.0)
    factor = _factored(system, weights, reduced, (0.0, inner_datum(system, state)))
    inverse = factor.inverse()
    coordinates = control_coordinates(system, state, weights)
    covariances, leverage = np.empty((len(state.points), 3, 3)), np.empty((len(system.order), 2))
    pairs = system.pattern.pairs

    def work(first: int, last: int) -> None:
        point_precision(
            system.rays,
            state.unknowns,
            weights.rays,
            system.free,
            coordinates,
            first,
            last,
            pairs,
            inverse,
            covariances,
            leverage,
        )

    list(in_chunks(system, work))
    return Precision(
        factor=factor,
        inverse=inverse,
        determined=determined,
        point_covariances_m2=covariances,
        ray_leverage=leverage,
        gnss_leverage=_gnss_leverage(system, state, inverse),
        control_leverage=_control_leverage(system, covariances),
    )


def local_leverage(system: BundleSystem, state: State, weights: Weights) -> tuple[Array, Array, Array]:
    """Return leverages of rays, GNSS fixes and control points as if the orientations were known exactly."""
    coordinates = control_coordinates(system, state, weights)
    covariances, leverage = np.empty((len(state.points), 3, 3)), np.empty((len(system.order), 2))

    def work(first: int, last: int) -> None:
        fixed_leverage(
            system.rays, state.unknowns, weights.rays, NONE_FREE, coordinates, first, last, covariances, leverage
        )

    list(in_chunks(system, work))
    gnss = 0 if system.given.gnss is None else len(system.given.gnss)
    return leverage, np.zeros((gnss, 3)), np.nan_to_num(_control_leverage(system, covariances))


def _gnss_leverage(system: BundleSystem, state: State, inverse: Inverse) -> Array:
    gnss = system.given.gnss
    if gnss is None or not system.uses_gnss:
        return np.zeros((0 if gnss is None else len(gnss), 3))
    i, design = gnss.image_index, gnss_design(system, state)
    blocks = inverse.blocks[system.pattern.diagonal[i], :6, :6]
    variance = np.einsum("gak,gkm,gam->ga", design, blocks, design)
    for axis in range(3):
        column = system.shared + 3 * gnss.flight + axis
        variance[:, axis] += 2.0 * np.einsum("gk,gk->g", design[:, axis], inverse.border[i, :6, column])
        variance[:, axis] += inverse.corner[column, column]
    if len(state.latencies):
        variance += _latency_variance(system, design, inverse)
    return np.asarray(variance / gnss.sigma_m**2)


def _latency_variance(system: BundleSystem, design: Array, inverse: Inverse) -> Array:
    """Return the part (g, 3) of the variance of adjusted antenna positions that the latencies make."""
    gnss, velocity = system.given.gnss, _velocities(system)
    assert gnss is not None
    column = system.first_latency + gnss.flight
    with_image = np.einsum("gak,gk->ga", design, inverse.border[gnss.image_index, :6, column])
    shift = system.shared + 3 * gnss.flight[:, None] + np.arange(3)
    with_shift = inverse.corner[shift, column[:, None]]
    own = inverse.corner[column, column][:, None]
    return np.asarray(2.0 * velocity * (with_image + with_shift) + velocity**2 * own)


def _control_leverage(system: BundleSystem, covariances: Array) -> Array:
    control = system.given.control
    if control is None or not system.uses_control:
        return np.zeros((0 if control is None else len(control), 3))
    return np.asarray(np.einsum("caa->ca", covariances[control.point_index]) / control.sigma_m**2)


def joint_covariance(
    system: BundleSystem, state: State, weights: Weights, factor: ReducedFactor, points: Indices
) -> Array:
    """Return the (3 j, 3 j) covariance of object points together; NaN rows for points that are not determined.

    C_ab = delta_ab N_a^-1 + N_a^-1 W_a' Q W_b N_b^-1, with W the mixed part of image and border against the point.
    """
    size = system.image_unknowns * len(state.centres) + system.border
    coordinates, rows = control_coordinates(system, state, weights), size - system.border + system.shared
    mixed, own = np.zeros((size, 3 * len(points))), np.zeros((3 * len(points), 3 * len(points)))
    for k, p in enumerate(points):
        part, inverse = kernels_point_parts(system, state, weights, coordinates, int(p))
        mixed[:rows, 3 * k : 3 * k + 3] = part
        own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = inverse
    carried = mixed @ np.nan_to_num(own)
    result = own + carried.T @ factor.solve(carried)
    lost = np.isnan(np.diag(own))
    result[lost] = np.nan
    result[:, lost] = np.nan
    return np.asarray(0.5 * (result + result.T))


def kernels_point_parts(
    system: BundleSystem, state: State, weights: Weights, coordinates: Coordinates, point: int
) -> tuple[Array, Array]:
    """Return the mixed part (d n + q, 3) and inverse normal matrix (3, 3; NaN if undetermined) of one point."""
    n, d, q = len(state.centres), system.image_unknowns, system.shared
    mixed = np.zeros((d * n + q, 3))
    equations = kernels.empty_equations(system.rays, state.unknowns, system.free, point, point + 1)
    count = kernels.linearise_point(system.rays, state.unknowns, weights.rays, system.free, point, equations)
    if not kernels.eliminate_point(coordinates, point, 0.0, count, equations):
        return mixed, np.full((3, 3), np.nan)
    for a in range(count):
        i = d * int(system.rays.image[equations.row[a]])
        mixed[i : i + d] += equations.by_image[a].T @ equations.by_point[a]
        mixed[d * n :] += equations.by_border[a].T @ equations.by_point[a]
    return mixed, equations.inverse
