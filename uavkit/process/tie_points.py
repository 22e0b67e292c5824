"""Tie point matching by back-projection (Anai et al. 2012, figure 8).

Every object point is projected into every still where it should be seen; there the patch of its reference still,
warped by the known geometry, is searched within what the predicted covariance allows, and measured by least squares
matching.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array, Flags, Indices
from uavkit.core.camera import InteriorOrientation
from uavkit.core.collinearity import collinearity_derivatives, image_coordinates, inside_image, object_rays
from uavkit.core.orientation import ExteriorOrientation
from uavkit.core.progress import Progress
from uavkit.process.approximations import GrowingBlock
from uavkit.process.candidates import Candidates
from uavkit.process.measurement import RayTasks, measure_rays, pairs_of
from uavkit.process.network import AdjustedNetwork
from uavkit.process.options import MeasurementOptions
from uavkit.process.pictures import PyramidStore
from uavkit.process.pyramid import PyramidOptions, refine_through_pyramid

_PROBE_PX = 8.0
_MOST_OBLIQUE = np.cos(np.radians(72.0))
_MOST_TURN = np.cos(np.radians(60.0))
_DEPTH_ANGLE = np.cos(np.radians(8.0))
"""Cosine of the angle between two rays from which on they fix a point's depth."""
_DIRECT_RADIUS_PX = 2.0
"""Least squares matching pulls in from here without help."""
_RADII_PX = (8.0, 16.0, 32.0, 64.0, 128.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectGeometry:
    """An oriented block as tie point matching needs it; rows of all stills, NaN where not oriented."""

    interior: InteriorOrientation
    centres: Array
    rotations: Array
    exterior_covariances: Array
    """(n, 6, 6)."""
    points: Array
    """(m, 3)."""
    point_covariances: Array
    """(m, 3, 3)."""
    normals: Array
    """(m, 3) unit normals of the surface, towards the cameras."""

    def exterior(self, image: int) -> ExteriorOrientation:
        """Return the orientation of a still."""
        return ExteriorOrientation(projection_centre_m=self.centres[image], R_object_from_image=self.rotations[image])

    def only_points(self, keep: Flags) -> "ObjectGeometry":
        """Return the geometry of the points that a mask (m,) chooses."""
        return replace(
            self,
            points=self.points[keep],
            point_covariances=self.point_covariances[keep],
            normals=self.normals[keep],
        )


def surface_normals(points: Array, view: Array, neighbours: int = 12) -> Array:
    """Return unit normals (m, 3) of the surface through points (m, 3), turned towards ``view`` (m, 3) directions.

    Plane through the nearest points (smallest principal axis); where they do not form a plane, the mean view.
    """
    from scipy.spatial import cKDTree

    mean_view = view / np.linalg.norm(view, axis=1)[:, None]
    normals: Array = mean_view.copy()
    known = np.flatnonzero(np.isfinite(points[:, 0]))
    if len(known) <= neighbours:
        return normals
    _, near = cKDTree(points[known]).query(points[known], k=neighbours)
    local = points[known][near]
    local = local - np.median(local, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    axis = vectors[:, :, 0]
    axis *= np.sign(np.sum(axis * mean_view[known], axis=1))[:, None]
    flat = (values[:, 0] < 0.25 * values[:, 1]) & (np.sum(axis * mean_view[known], axis=1) > 0.35)
    normals[known[flat]] = axis[flat]
    return normals


def visible_tasks(
    geometry: ObjectGeometry, reference_image: Indices, reference_px: Array, margin_px: float
) -> tuple[RayTasks, Array]:
    """Return a task for every point in every still but its reference where it should be seen, and the search radii.

    Radii (k,) in pixels are three times the predicted sigma of where the point will be found.
    """
    parts: list[RayTasks] = []
    radii: list[Array] = []
    usable = np.isfinite(geometry.points[:, 0]) & np.isfinite(geometry.centres[reference_image][:, 0])
    for image in np.flatnonzero(np.isfinite(geometry.centres[:, 0])).tolist():
        rows = np.flatnonzero(usable & (reference_image != image))
        xy = image_coordinates(geometry.points[rows], geometry.exterior(image), geometry.interior)
        rows = rows[inside_image(xy, geometry.interior, margin_px)]
        rows = rows[_well_seen(geometry, rows, reference_image[rows], image)]
        if len(rows) == 0:
            continue
        tasks = _tasks_into(geometry, rows, reference_image[rows], reference_px[rows], image)
        good = np.isfinite(tasks.warps).all(axis=(1, 2)) & inside_image(tasks.start_px, geometry.interior, margin_px)
        parts.append(tasks.where(good))
        radii.append(_search_radii(geometry, rows[good], image))
    return _joined(parts), np.concatenate(radii) if radii else np.zeros(0)


def _joined(parts: list[RayTasks]) -> RayTasks:
    def column(name: str, shape: tuple[int, ...], kind: type) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts]) if parts else np.zeros(shape, kind)

    return RayTasks(
        point=column("point", (0,), np.int64),
        reference_image=column("reference_image", (0,), np.int64),
        reference_px=column("reference_px", (0, 2), np.float64),
        target_image=column("target_image", (0,), np.int64),
        start_px=column("start_px", (0, 2), np.float64),
        warps=column("warps", (0, 2, 2), np.float64),
    )


def _well_seen(geometry: ObjectGeometry, rows: Indices, reference: Indices, image: int) -> Flags:
    """Tell which points turn their surface to a still, seen from a direction not too far from the reference's."""
    to_image = _unit(geometry.centres[image] - geometry.points[rows])
    to_reference = _unit(geometry.centres[reference] - geometry.points[rows])
    facing = np.sum(to_image * geometry.normals[rows], axis=1) > _MOST_OBLIQUE
    return np.asarray(facing & (np.sum(to_image * to_reference, axis=1) > _MOST_TURN))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])


def _tasks_into(
    geometry: ObjectGeometry, rows: Indices, reference: Indices, reference_px: Array, image: int
) -> RayTasks:
    """Transfer the reference points and their surroundings into a still over the tangent planes of the surface."""
    probes = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]) * _PROBE_PX
    ground = np.full((len(rows), 5, 3), np.nan)
    for source in np.unique(reference).tolist():
        at = np.flatnonzero(reference == source)
        exterior = geometry.exterior(source)
        for number, probe in enumerate(probes):
            rays = object_rays(reference_px[at] + probe, exterior, geometry.interior)
            ground[at, number] = _on_plane(
                exterior.projection_centre_m, rays, geometry.points[rows[at]], geometry.normals[rows[at]]
            )
    xy = image_coordinates(ground.reshape(-1, 3), geometry.exterior(image), geometry.interior).reshape(-1, 5, 2)
    warps = np.stack([xy[:, 1] - xy[:, 2], xy[:, 3] - xy[:, 4]], axis=-1) / (2.0 * _PROBE_PX)
    determinant = np.abs(np.linalg.det(warps))
    with np.errstate(invalid="ignore"):
        warps[~((determinant > 0.15) & (determinant < 7.0))] = np.nan
    return RayTasks(
        point=rows,
        reference_image=reference,
        reference_px=reference_px,
        target_image=np.full(len(rows), image),
        start_px=xy[:, 0],
        warps=warps,
    )


def _on_plane(centre: Array, rays: Array, points: Array, normals: Array) -> Array:
    """Return where rays (n, 3) from a centre (3,) meet the planes through points (n, 3) with normals (n, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.sum((points - centre) * normals, axis=1) / np.sum(rays * normals, axis=1)
    reach[~(reach > 0)] = np.nan
    return np.asarray(centre + reach[:, None] * rays)


def _search_radii(geometry: ObjectGeometry, rows: Indices, image: int) -> Array:
    """Return 3 sigma of the predicted position, from the covariances of point and still (correlations left out)."""
    derivatives = collinearity_derivatives(geometry.points[rows], geometry.exterior(image), geometry.interior)
    by_exterior = np.concatenate([derivatives.by_centre, derivatives.by_rotation], axis=2)
    covariance = derivatives.by_point @ geometry.point_covariances[rows] @ derivatives.by_point.transpose(0, 2, 1)
    covariance = covariance + by_exterior @ geometry.exterior_covariances[image] @ by_exterior.transpose(0, 2, 1)
    covariance = np.where(np.isfinite(covariance), covariance, 1e4)
    return np.asarray(3.0 * np.sqrt(np.linalg.eigvalsh(covariance)[:, 1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class TiePointMatching:
    """Finds candidates in all stills that should see them."""

    pyramids: PyramidStore
    options: MeasurementOptions
    workers: int
    progress: Progress

    @property
    def margin_px(self) -> float:
        """Return how far from the border of a still points can be measured."""
        return self.options.window_px / 2 + 3

    def match(self, candidates: Candidates, geometry: ObjectGeometry, known: Candidates | None) -> Candidates:
        """Return the candidates with all rays that could be measured; rays of ``known`` are kept as they are."""
        tasks, radii = self._tasks(candidates, geometry)
        if known is not None:
            todo = ~np.isin(_ray_keys(tasks.point, tasks.target_image), _ray_keys(known.ray_point, known.ray_image))
            tasks, radii = tasks.where(todo), radii[todo]
        return self._measured(candidates, tasks, radii, known)

    def match_in_one(self, candidates: Candidates, geometry: ObjectGeometry) -> Candidates:
        """Return the candidates with a ray, where it could be measured, in the one other still that suits each best."""
        tasks, radii = self._tasks(candidates, geometry)
        best = _best_view(geometry, tasks)
        return self._measured(candidates, tasks.where(best), radii[best], None)

    def _tasks(self, candidates: Candidates, geometry: ObjectGeometry) -> tuple[RayTasks, Array]:
        return visible_tasks(geometry, candidates.reference_image, candidates.reference_px, self.margin_px)

    def _measured(
        self, candidates: Candidates, tasks: RayTasks, radii_px: Array, known: Candidates | None
    ) -> Candidates:
        """Return the candidates with the rays that searching and measuring gives, besides those of ``known``."""
        tasks, found = self._search(tasks, radii_px)
        tasks = tasks.where(found)
        rays = measure_rays(
            self.pyramids, tasks, self.options, workers=self.workers, progress=self.progress, stage="tie points"
        )
        near = np.linalg.norm(rays.target_px - tasks.start_px, axis=1) < 4.0
        ok = rays.ok & near
        parts = [(tasks.point[ok], tasks.target_image[ok], rays.target_px[ok], rays.sigma_px[ok])]
        if known is not None:
            parts.append((known.ray_point, known.ray_image, known.ray_px, known.ray_sigma_px))
        point, image, xy, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.lexsort((image, point))
        return replace(
            candidates,
            ray_point=point[order],
            ray_image=image[order],
            ray_px=xy[order],
            ray_sigma_px=sigma[order],
        )

    def _search(self, tasks: RayTasks, radii_px: Array) -> tuple[RayTasks, Flags]:
        """Refine by OCM in image pyramids the starts of tasks that least squares matching does not reach.

        Returns the tasks with better starts, and which of them may be measured.
        """
        starts, found = tasks.start_px.copy(), radii_px <= _DIRECT_RADIUS_PX
        far = np.flatnonzero(~found)
        jobs = pairs_of(tasks.where(far))

        def search(job: tuple[int, int, Indices]) -> None:
            reference, target, chosen = job
            rows = far[chosen]
            step = np.searchsorted(_RADII_PX, np.minimum(radii_px[rows], self.options.most_search_px))
            step = np.minimum(step, len(_RADII_PX) - 1)
            for number in np.unique(step).tolist():
                part = rows[step == number]
                refined = refine_through_pyramid(
                    self.pyramids.get(reference),
                    self.pyramids.get(target),
                    tasks.reference_px[part],
                    tasks.start_px[part],
                    tasks.warps[part],
                    PyramidOptions(start_radius_px=_RADII_PX[number]),
                )
                starts[part[refined.ok]] = refined.target_px[refined.ok]
                found[part] = refined.ok

        with ThreadPoolExecutor(max(1, self.workers)) as pool:
            for done, _ in enumerate(pool.map(search, jobs), start=1):
                self.progress("tie point search", done, len(jobs))
        return replace(tasks, start_px=starts), np.asarray(found)


def _best_view(geometry: ObjectGeometry, tasks: RayTasks) -> Indices:
    """Return the row of one task of each point: the least angle between its rays that still fixes its depth."""
    to_image = _unit(geometry.centres[tasks.target_image] - geometry.points[tasks.point])
    to_reference = _unit(geometry.centres[tasks.reference_image] - geometry.points[tasks.point])
    cosine = np.sum(to_image * to_reference, axis=1)
    order = np.lexsort((np.where(cosine < _DEPTH_ANGLE, -cosine, 2.0 + cosine), tasks.point))
    _, first = np.unique(tasks.point[order], return_index=True)
    return np.asarray(order[first])


def _ray_keys(point: Indices, image: Indices) -> Indices:
    return np.asarray(point * 1_000_000 + image)


def object_geometry(
    growing: GrowingBlock, adjusted: AdjustedNetwork, count: int, reference_image: Indices
) -> ObjectGeometry:
    """Return the geometry of an adjusted block in rows of all stills and of ``count`` candidates."""
    n = len(growing.centres)
    exterior_covariances, point_covariances = np.full((n, 6, 6), np.nan), np.full((count, 3, 3), np.nan)
    exterior_covariances[adjusted.images] = adjusted.result.exterior_covariances
    rows = adjusted.points < count
    point_covariances[adjusted.points[rows]] = adjusted.result.point_covariances_m2[rows]
    view = growing.centres[reference_image] - growing.points
    return ObjectGeometry(
        interior=growing.interior,
        centres=growing.centres,
        rotations=growing.rotations,
        exterior_covariances=exterior_covariances,
        points=growing.points,
        point_covariances=point_covariances,
        normals=surface_normals(growing.points, np.where(np.isfinite(view), view, 1.0)),
    )
