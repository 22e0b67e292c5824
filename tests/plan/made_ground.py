"""Ground and areas that tests make: smooth hills in several coordinate systems, and polygons of any simple shape."""

import numpy as np
import pyproj
import shapely

from uavkit.core.arrays import Array
from uavkit.core.frames import LocalMap, utm_crs
from uavkit.core.surface import ElevationGrid

WAVES = 7


def hills_m(rng: np.random.Generator, xy_m: Array, shortest_m: float, longest_m: float, steepest: float) -> Array:
    """Return heights (n,) of smooth hills at places (n, 2): cosine waves, at the steepest of the places of a slope."""
    length = np.exp(rng.uniform(np.log(shortest_m), np.log(longest_m), WAVES))
    azimuth, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES))
    slope = rng.uniform(0.2, 1.0, WAVES)
    normal = np.stack([np.sin(azimuth), np.cos(azimuth)])
    angle = xy_m @ normal * (2.0 * np.pi / length) + phase
    gradient = (slope * np.sin(angle)) @ normal.T
    scale = steepest / np.linalg.norm(gradient, axis=1).max()
    return np.asarray(scale * (np.cos(angle) @ (slope * length / (2.0 * np.pi))))


def hilly_ground(
    place: LocalMap,
    seed: int,
    half_m: float,
    cell_m: float,
    steepest_deg: float,
    crs: str = "utm",
    sigma_m: float = 0.5,
    waves_m: tuple[float, float] = (60.0, 600.0),
    level_m: float = 300.0,
) -> ElevationGrid:
    """Return hills about a place in a grid that covers at least +-half_m, in "utm", "degrees" or "turned" (UTM whose
    rows run askew)."""
    name = "EPSG:4326" if crs == "degrees" else utm_crs(place.latitude_deg, place.longitude_deg)
    matrix = np.diag([cell_m, -cell_m])
    count = int(np.ceil(2.0 * half_m / cell_m)) + 1
    if crs == "turned":
        turn = np.radians(25.0)
        matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ matrix
        count = int(np.ceil(count * 1.4))
    elif crs == "utm":
        count += int(np.ceil(count * 0.15))  # meridian convergence turns the grid against the map
    if crs == "degrees":
        matrix = matrix / 111000.0 / np.diag([np.cos(np.radians(place.latitude_deg)), 1.0]).clip(1e-9)
        matrix = np.diag(np.diag(matrix))
    to_crs = pyproj.Transformer.from_crs("EPSG:4326", name, always_xy=True)
    middle = np.array(to_crs.transform(place.longitude_deg, place.latitude_deg))
    first = middle - matrix @ np.full(2, (count - 1) / 2)
    columns, rows = np.meshgrid(np.arange(count), np.arange(count))
    nodes = np.column_stack([columns.ravel(), rows.ravel()]) @ matrix.T + first
    longitude, latitude = to_crs.transform(nodes[:, 0], nodes[:, 1], direction="INVERSE")
    xy_m = place.map_from_geographic(latitude, longitude)
    heights = hills_m(np.random.default_rng(seed), xy_m, *waves_m, np.tan(np.radians(steepest_deg)))
    return ElevationGrid(
        height_ellipsoid_m=(level_m + heights).reshape(count, count).astype(np.float32),
        crs=name,
        crs_from_grid=np.column_stack([matrix, first]),
        sigma_m=sigma_m,
        source=f"hills {seed}",
    )


def star(rng: np.random.Generator, vertices: int) -> Array:
    """Return a polygon (n, 2) about the origin within radius 1, each vertex seen from there."""
    gaps = rng.uniform(0.3, 1.0, vertices)
    azimuth = np.cumsum(gaps) / gaps.sum() * 2.0 * np.pi
    radius = rng.uniform(0.25, 1.0, vertices)
    return np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth)])


def untangled(rng: np.random.Generator, vertices: int) -> Array:
    """Return a polygon (n, 2) through random points in the unit square: crossing sides are exchanged until none is."""
    points = rng.uniform(-0.7, 0.7, (vertices, 2))
    changed = True
    while changed:
        changed = False
        for i in range(vertices):
            for j in range(i + 2, vertices - (i == 0)):
                a, b, c, d = points[i], points[i + 1], points[j], points[(j + 1) % vertices]
                if shapely.LineString([a, b]).crosses(shapely.LineString([c, d])):
                    points[i + 1 : j + 1] = points[i + 1 : j + 1][::-1]
                    changed = True
    return points


def simple_polygon(seed: int, kind: str, vertices: int, size_m: float, least_m2: float) -> tuple[Array, Array | None]:
    """Return outline (n, 2) of a star or an untangled polygon, its bounding box's longer side size_m, and a triangular
    hole well inside it where there is room."""
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        ring = {"star": star, "untangled": untangled}[kind](rng, vertices)
        ring = ring * (size_m / np.ptp(ring, axis=0).max())
        polygon = shapely.Polygon(ring)
        if polygon.is_valid and polygon.area > least_m2:
            break
    else:
        raise AssertionError("no polygon found")
    middle = shapely.maximum_inscribed_circle(polygon, tolerance=size_m / 100.0)
    (x, y), radius = shapely.get_coordinates(middle)[0], middle.length
    if radius < 0.08 * size_m:
        return ring, None
    angles = rng.uniform(0.0, 2.0) + np.array([0.0, 2.0, 4.2])
    return ring, np.array([x, y]) + 0.6 * radius * np.column_stack([np.cos(angles), np.sin(angles)])
