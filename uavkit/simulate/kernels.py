"""The simulator's inner loops: heights, rays, light and texture over bare arrays.

The ray code here is the simulator's own: nothing of it is shared with ``core.collinearity``, so that an error of sign
in either shows. Coordinates are those of the site (along, across, up), metres; rays are scaled to fall one metre in
height for one unit of their parameter, the ``depth`` below the projection centre.
"""

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.simulate.jit import inlined, kernel

Field = NDArray[np.float32]
Bytes = NDArray[np.uint8]

CELL_M = 0.025
"""Between the nodes of the height grid."""
COARSE = 8
"""Nodes of the height grid in a coarse cell (20 cm), over which steepness and the highest surface are bounded."""
STEEP = 0.95
"""Below this gradient a ray down to 46 degrees off nadir meets the surface once."""
MATERIAL_CELL_M = 0.2
TILE_CELL_M = 0.002
SIGNAL_RADIUS_M = 0.15
"""Painted signals: discs of two black and two white quarters."""


@kernel
def add_stones(field: Field, offsets: Field, brightness: Field, weight: np.float32) -> None:
    """Add a periodic pattern of cells around jittered centres (Worley 1996): own brightness, dark along the borders."""
    rows, columns = field.shape
    cells = offsets.shape[0]
    for r in range(rows):
        v = (r + 0.5) * cells / rows
        jv = int(v)
        for c in range(columns):
            u = (c + 0.5) * cells / columns
            ju = int(u)
            first, second, own = 9.0, 9.0, 0.0
            for dj in range(-1, 2):
                for di in range(-1, 2):
                    j, i = (jv + dj) % cells, (ju + di) % cells
                    d = (jv + dj + offsets[j, i, 0] - v) ** 2 + (ju + di + offsets[j, i, 1] - u) ** 2
                    if d < first:
                        first, second, own = d, first, brightness[j, i]
                    elif d < second:
                        second = d
            gap = np.sqrt(second) - np.sqrt(first)
            field[r, c] += weight * (own + (0.4 - 1.2 * np.sqrt(first)) - 1.6 * np.exp(-((gap / 0.12) ** 2)))


@kernel
def lay_blades(field: Field, blades: Field) -> None:
    """Paint blades (row, column, direction, half length, half width, brightness; cells) in order, periodic."""
    rows, columns = field.shape
    for n in range(blades.shape[0]):
        row, column, direction, half_length, half_width, brightness = blades[n]
        cosine, sine = np.cos(direction), np.sin(direction)
        reach = int(half_length) + 2
        for r in range(int(row) - reach, int(row) + reach + 1):
            for c in range(int(column) - reach, int(column) + reach + 1):
                along = (c - column) * cosine + (r - row) * sine
                across = abs((r - row) * cosine - (c - column) * sine)
                width = half_width * (1.0 - 0.5 * abs(along) / half_length)
                if abs(along) <= half_length and across <= width + 0.5:
                    cover = min(1.0, width + 0.5 - across)
                    old = field[r % rows, c % columns]
                    field[r % rows, c % columns] = old + cover * (brightness + 0.4 * along / half_length - old)


@inlined
def height_and_gradient(heights_m: Field, along_m: float, across_m: float) -> tuple[float, float, float]:
    """Bilinear height with its derivatives along and across; the border is continued level."""
    rows, columns = heights_m.shape
    u = along_m / CELL_M + 0.5 * (columns - 1)
    v = across_m / CELL_M + 0.5 * (rows - 1)
    if u < 0.0 or v < 0.0 or u >= columns - 1.001 or v >= rows - 1.001:
        u = min(max(u, 0.0), columns - 1.001)
        v = min(max(v, 0.0), rows - 1.001)
        i, j = int(u), int(v)
        return float(heights_m[j, i]), 0.0, 0.0
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    h00, h01 = float(heights_m[j, i]), float(heights_m[j, i + 1])
    h10, h11 = float(heights_m[j + 1, i]), float(heights_m[j + 1, i + 1])
    lower, upper = h00 + fu * (h01 - h00), h10 + fu * (h11 - h10)
    slope_along = ((h01 - h00) * (1.0 - fv) + (h11 - h10) * fv) / CELL_M
    return lower + fv * (upper - lower), slope_along, (upper - lower) / CELL_M


@kernel
def surface_heights(heights_m: Field, along_m: Array, across_m: Array) -> Array:
    """Heights of many places."""
    result = np.empty(along_m.size)
    for n in range(along_m.size):
        result[n] = height_and_gradient(heights_m, along_m[n], across_m[n])[0]
    return result


@kernel
def cast_shadows(heights: Field, clearance_m: Field, sun: Array, shadow: Field) -> None:
    """Light left at each node near steep places: 1 in the sun, 0 in full shadow, soft between."""
    rows, columns = heights.shape
    horizontal = np.hypot(sun[0], sun[1])
    step_u, step_v, rise = sun[0] / horizontal, sun[1] / horizontal, sun[2] / horizontal * CELL_M
    for r in range(rows):
        for c in range(columns):
            if clearance_m[r // COARSE, c // COARSE] > 2.0:
                continue
            light = 1.0
            for n in range(2, 90):
                i, j = int(c + n * step_u + 0.5), int(r + n * step_v + 0.5)
                if i < 0 or j < 0 or i >= columns or j >= rows:
                    break
                clear = heights[r, c] + n * rise - heights[j, i]
                light = min(light, 0.5 + clear / (0.02 * n * CELL_M + 0.01))
                if light <= 0.0:
                    light = 0.0
                    break
            shadow[r, c] = light


@inlined
def first_hit(
    heights_m: Field, bounds: Field, centre: Array, ray: tuple[float, float], start: float
) -> tuple[float, bool]:
    """Depth below the centre at which a ray (along and across for one metre down) first meets the surface.

    ``start`` is a near guess, or 0. Where the ground is gentle the ray meets it once and Newton's method finds it;
    where something steep is near enough to hide the ground, the ray is followed from above the highest surface around.
    Good to 0.01 mm. The flag says that the ground is gentle there. bounds: as in ``Ground``.
    """
    dx, dy = ray
    reach = np.sqrt(dx * dx + dy * dy)
    depth = start
    if depth <= 0.0:
        return _march(heights_m, bounds, centre, ray, centre[2] - np.float64(bounds[:, :, 1].max())), False
    settled = False
    x, y, h = centre[0], centre[1], 0.0
    for _ in range(12):
        x, y = centre[0] + depth * dx, centre[1] + depth * dy
        h, slope_along, slope_across = height_and_gradient(heights_m, x, y)
        gap = centre[2] - depth - h
        if abs(gap) < 1e-5:
            settled = True
            break
        depth += gap / max(1.0 + slope_along * dx + slope_across * dy, 0.3)
    j, i = _coarse_cell(heights_m, bounds, x, y)
    top = np.float64(bounds[j, i, 1])
    away = (top - h) * reach  # nothing farther than this can hide the place
    if settled and away < 1.0:
        top = np.float64(bounds[j, i, 2])
        away = (top - h) * reach
    if settled and bounds[j, i, 0] > away:
        return depth, True
    met = _march(heights_m, bounds, centre, ray, centre[2] - top)
    return met, settled and abs(met - depth) < 1e-3 and bounds[j, i, 3] < STEEP


@inlined
def _coarse_cell(heights_m: Field, bounds: Field, x: float, y: float) -> tuple[int, int]:
    """Row and column of the coarse cell at a place, the nearest one beyond the site."""
    rows, columns, _ = bounds.shape
    i = int((x / CELL_M + 0.5 * (heights_m.shape[1] - 1)) / COARSE)
    j = int((y / CELL_M + 0.5 * (heights_m.shape[0] - 1)) / COARSE)
    return min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)


@kernel
def _march(heights_m: Field, bounds: Field, centre: Array, ray: tuple[float, float], depth: float) -> float:
    """Follow a ray down from above the surface, then close in (Illinois method).

    A step reaches one coarse cell at most, as far as the highest surface or the steepest gradient of the cells around
    leave the ray free, and half a node at least.
    """
    dx, dy = ray
    reach = np.sqrt(dx * dx + dy * dy)
    least, most = 0.5 * CELL_M / max(reach, 0.05), CELL_M * (COARSE - 1) / max(reach, 0.001)
    x, y = centre[0] + depth * dx, centre[1] + depth * dy
    gap = centre[2] - depth - height_and_gradient(heights_m, x, y)[0]
    above, gap_above = depth, max(gap, 0.0)
    for _ in range(100_000):
        if gap < 0.0:
            break
        above, gap_above = depth, gap
        j, i = _coarse_cell(heights_m, bounds, x, y)
        free = max(gap / (1.0 + bounds[j, i, 3] * reach), centre[2] - depth - bounds[j, i, 4])
        depth += max(min(free, most), least)
        x, y = centre[0] + depth * dx, centre[1] + depth * dy
        gap = centre[2] - depth - height_and_gradient(heights_m, x, y)[0]
    below, gap_below = depth, gap
    for _ in range(60):
        if gap_above - gap_below <= 0.0:
            break
        depth = above + (below - above) * gap_above / (gap_above - gap_below)
        gap = centre[2] - depth - height_and_gradient(heights_m, centre[0] + depth * dx, centre[1] + depth * dy)[0]
        if abs(gap) < 1e-5:
            break
        if gap > 0.0:
            above, gap_above, gap_below = depth, gap, 0.5 * gap_below
        else:
            below, gap_below, gap_above = depth, gap, 0.5 * gap_above
    return depth


@kernel
def hits(heights_m: Field, bounds: Field, centre: Array, rays: Array) -> Array:
    """Depths of the first hits of rays (n, 2) from one centre."""
    depths = np.empty(rays.shape[0])
    above = centre[2] - np.float64(bounds[:, :, 1].max())
    for n in range(rays.shape[0]):
        depths[n] = _march(heights_m, bounds, centre, (rays[n, 0], rays[n, 1]), above)
    return depths


@inlined
def _bilinear_map(flat: Field, levels: NDArray[np.int64], level: int, x: float, y: float) -> float:
    """Value of one mip level of the map of the site at a place."""
    offset, rows, columns = levels[level, 0], levels[level, 1], levels[level, 2]
    scale = 1 << level
    u = (x / CELL_M + 0.5 * (levels[0, 2] - 1) + 0.5) / scale - 0.5
    v = (y / CELL_M + 0.5 * (levels[0, 1] - 1) + 0.5) / scale - 0.5
    u = min(max(u, 0.0), columns - 1.001)
    v = min(max(v, 0.0), rows - 1.001)
    i, j = int(u), int(v)
    fu, fv = np.float32(u - i), np.float32(v - j)
    at = offset + j * columns + i
    lower = flat[at] + fu * (flat[at + 1] - flat[at])
    upper = flat[at + columns] + fu * (flat[at + columns + 1] - flat[at + columns])
    return float(lower + fv * (upper - lower))


@inlined
def _map_value(flat: Field, levels: NDArray[np.int64], lod: float, x: float, y: float) -> float:
    """Value of the map of the site, filtered to a level of detail (0: full)."""
    if lod <= 0.0:
        return _bilinear_map(flat, levels, 0, x, y)
    lod = min(lod, levels.shape[0] - 1.001)
    level = int(lod)
    fine = _bilinear_map(flat, levels, level, x, y)
    return fine + (lod - level) * (_bilinear_map(flat, levels, level + 1, x, y) - fine)


@inlined
def _bilinear_tile(tiles: Bytes, m: int, level: int, x: float, y: float) -> np.float32:
    """Value of one mip level of a periodic tile of 2048 cells; x, y in cells of level 0."""
    size = 2048 >> level
    offset = (2048 * 2048 * 4 - size * size * 4) // 3  # sum of the sizes of the levels before
    u, v = x / (1 << level) - 0.5, y / (1 << level) - 0.5
    fi, fj = np.floor(u), np.floor(v)
    i, j = int(fi) & (size - 1), int(fj) & (size - 1)
    i1, j1 = (i + 1) & (size - 1), (j + 1) & (size - 1)
    fu, fv = np.float32(u - fi), np.float32(v - fj)
    row, row1 = offset + j * size, offset + j1 * size
    lower = tiles[m, row + i] + fu * (np.float32(tiles[m, row + i1]) - np.float32(tiles[m, row + i]))
    upper = tiles[m, row1 + i] + fu * (np.float32(tiles[m, row1 + i1]) - np.float32(tiles[m, row1 + i]))
    return np.float32(lower + fv * (upper - lower))


@inlined
def _tile_value(tiles: Bytes, m: int, lod: float, x: float, y: float) -> float:
    """Value of a tile about its mean, in standard deviations, filtered to a level of detail."""
    if lod <= 0.0:
        return float(_bilinear_tile(tiles, m, 0, x, y) - 128.0) / 36.0
    if lod >= 7.0:
        return 0.0
    level = int(lod)
    fine = _bilinear_tile(tiles, m, level, x, y)
    return float(fine + (lod - level) * (_bilinear_tile(tiles, m, level + 1, x, y) - fine) - 128.0) / 36.0


@inlined
def _detail(tiles: Bytes, layers: Array, shares: Array, lod: float, place: tuple[float, float]) -> float:
    """Fine detail of the ground, a relative brightness: two layers of each material's tile, turned by 37 degrees."""
    value = 0.0
    fade = min((3.6 - lod) / 0.6, 1.0)  # the map of the site holds what is left beyond
    if fade <= 0.0:
        return value
    u, v = place[0] / TILE_CELL_M, place[1] / TILE_CELL_M
    p, q = (0.7986 * u - 0.6018 * v) / 1.31 + 431.0, (0.6018 * u + 0.7986 * v) / 1.31 + 977.0
    for m in range(3):
        if shares[m] > 0.06:
            straight, turned = _tile_value(tiles, m, lod, u, v), _tile_value(tiles, m, lod - 0.39, p, q)
            value += shares[m] * (layers[m, 0] * straight + layers[m, 1] * turned)
    return fade * value


@inlined
def _shares(weights: Bytes, x: float, y: float, shares: Array) -> None:
    """Shares of the three materials (times the strength of their detail) and the local contrast, bilinear."""
    rows, columns, _ = weights.shape
    u = min(max(x / MATERIAL_CELL_M + 0.5 * (columns - 1), 0.0), columns - 1.001)
    v = min(max(y / MATERIAL_CELL_M + 0.5 * (rows - 1), 0.0), rows - 1.001)
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    for k in range(4):
        lower = weights[j, i, k] * (1.0 - fu) + weights[j, i + 1, k] * fu
        upper = weights[j + 1, i, k] * (1.0 - fu) + weights[j + 1, i + 1, k] * fu
        shares[k] = (lower * (1.0 - fv) + upper * fv) / 255.0


@inlined
def _signal(signal_index: NDArray[np.int16], signals_m: Array, x: float, y: float) -> int:
    """0: no signal here; 1: black quarter; 2: white quarter."""
    rows, columns = signal_index.shape
    i = int((x / CELL_M + 0.5 * (columns * COARSE - 1)) / COARSE)
    j = int((y / CELL_M + 0.5 * (rows * COARSE - 1)) / COARSE)
    if i < 0 or j < 0 or i >= columns or j >= rows or signal_index[j, i] < 0:
        return 0
    n = signal_index[j, i]
    dx, dy = x - signals_m[n, 0], y - signals_m[n, 1]
    if dx * dx + dy * dy > SIGNAL_RADIUS_M**2:
        return 0
    return 1 if dx * dy > 0.0 else 2


@inlined
def _site_ray(lattice: Array, spacing: float, view: Array, column: float, row: float) -> tuple[float, float, float]:
    """The ray of a pixel in the site: along and across for one metre down, and metres down at unit distance."""
    u, v = column / spacing + 1.0, row / spacing + 1.0
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    x = (lattice[j, i, 0] * (1 - fu) + lattice[j, i + 1, 0] * fu) * (1 - fv) + (
        lattice[j + 1, i, 0] * (1 - fu) + lattice[j + 1, i + 1, 0] * fu
    ) * fv
    y = (lattice[j, i, 1] * (1 - fu) + lattice[j, i + 1, 1] * fu) * (1 - fv) + (
        lattice[j + 1, i, 1] * (1 - fu) + lattice[j + 1, i + 1, 1] * fu
    ) * fv
    fall = -(view[2, 0] * x - view[2, 1] * y - view[2, 2])
    dx = (view[0, 0] * x - view[0, 1] * y - view[0, 2]) / fall
    dy = (view[1, 0] * x - view[1, 1] * y - view[1, 2]) / fall
    return dx, dy, fall


@kernel
def render_rows(ground: "Ground", lattice: Array, view: Array, sampling: Array, picture: Field) -> None:  # type: ignore[name-defined] # noqa: F821
    """Fill a picture (rows, columns, 3) with linear red, green, blue of the ground as the camera sees it.

    lattice: (rows, columns, 2) rays in image space (x right, y down, for z = 1) at the nodes of a lattice over the
    image, its node (1, 1) at pixel (0, 0). view: (5, 3): R_site_from_image, projection centre, and (principal distance
    in px, 0, 0). sampling: (first row, row step, height of a line, samples a line, samples a column, lattice spacing),
    pixels.
    """
    rows, columns, _ = picture.shape
    first_row, row_step, line_height, spacing = sampling[0], sampling[1], sampling[2], sampling[5]
    down, right = int(sampling[3]), int(sampling[4])
    centre = view[3].copy()
    heights_m, bounds = ground.heights_m, ground.bounds
    radiance, levels, weights, tiles = ground.radiance, ground.levels, ground.weights, ground.tiles
    tints, layers = ground.tints, ground.layers
    signal_index, signals_m = ground.signal_index, ground.signals_m
    shares = np.empty(4)
    weight = 1.0 / (down * right)
    row_start = 0.0
    for r in range(rows):
        middle = first_row + r * row_step
        plane, slope_along, slope_across = row_start, 0.0, 0.0
        for c in range(columns):
            dx, dy, fall = _site_ray(lattice, spacing, view, float(c), middle)
            depth = plane / max(1.0 + slope_along * dx + slope_across * dy, 0.3)  # on the last pixel's tangent plane
            depth, gentle = first_hit(heights_m, bounds, centre, (dx, dy), depth)
            along, across = centre[0] + depth * dx, centre[1] + depth * dy
            if c == 0:
                row_start = depth
            height, slope_along, slope_across = height_and_gradient(heights_m, along, across)
            plane = centre[2] - height + slope_along * (along - centre[0]) + slope_across * (across - centre[1])
            _shares(weights, along, across, shares)
            step_m = depth / fall / view[4, 0] / right
            map_lod = np.log2(step_m / CELL_M)
            tile_lod = np.log2(step_m / TILE_CELL_M)
            total, white = 0.0, 0.0
            for sample_row in range(down):
                row = middle + ((sample_row + 0.5) / down - 0.5) * line_height
                for sample_column in range(right):
                    column = c + (sample_column + 0.5) / right - 0.5
                    dx, dy, _ = _site_ray(lattice, spacing, view, column, row)
                    if gentle:
                        below = plane / (1.0 + slope_along * dx + slope_across * dy)
                    else:
                        below, _ = first_hit(heights_m, bounds, centre, (dx, dy), depth)
                    along, across = centre[0] + below * dx, centre[1] + below * dy
                    mark = _signal(signal_index, signals_m, along, across)
                    if mark:
                        white += weight * (0.55 if mark == 2 else 0.02)
                    else:
                        base = _map_value(radiance, levels, map_lod, along, across)
                        fine = 0.36 * shares[3] * _detail(tiles, layers, shares, tile_lod, (along, across))
                        total += weight * base * max(1.0 + fine, 0.08)
            for k in range(3):
                tint = shares[0] * tints[0, k] + shares[1] * tints[1, k] + shares[2] * tints[2, k]
                picture[r, c, k] = total * tint + white


@kernel
def soften(picture: Field, taps: Field, result: Field) -> None:
    """Separable smoothing by odd taps; result has 2 * half fewer rows, the columns' ends are repeated."""
    rows, columns, channels = picture.shape
    half = taps.size // 2
    line = np.empty((columns, channels), dtype=np.float32)
    for r in range(rows - 2 * half):
        line[:] = 0.0
        for k in range(taps.size):
            line += taps[k] * picture[r + k]
        for c in range(columns):
            for ch in range(channels):
                total = np.float32(0.0)
                for k in range(taps.size):
                    total += taps[k] * line[min(max(c + k - half, 0), columns - 1), ch]
                result[r, c, ch] = total


@kernel
def expose(picture: Field, noise: Field, levels: Array, first_row: int, image: Bytes) -> None:
    """Grey values of linear colours: vignetting, gain, gamma, noise.

    noise: (rows, columns, 4) standard normal: one common to the colours, three of their own. levels: (gain, centre
    column, centre row, radius of the corner in px, noise at black, noise per grey value).
    """
    rows, columns, _ = picture.shape
    for r in range(rows):
        for c in range(columns):
            radius2 = ((c - levels[1]) ** 2 + (first_row + r - levels[2]) ** 2) / levels[3] ** 2
            light = levels[0] * (1.0 - 0.34 * radius2 - 0.08 * radius2 * radius2)
            for k in range(3):
                grey = 255.0 * (max(light * picture[r, c, k], 0.0)) ** (1.0 / 2.2)
                sigma = levels[4] + levels[5] * grey
                grey += sigma * (0.8 * noise[r, c, 0] + 0.6 * noise[r, c, 1 + k])
                image[r, c, k] = np.uint8(min(max(grey + 0.5, 0.0), 255.0))


@kernel
def finder_signal(picture: Field, noise: Field, gain: float, taps: Field, luminance: Bytes, chrominance: Bytes) -> None:
    """Grey values of one field as a finder's analogue signal: soft along the lines, noisy, 16 to 235.

    picture: (lines, columns, 3) linear; noise: (lines, columns) in grey values; luminance: (lines, columns);
    chrominance: (2, lines / 2, columns / 2), blue and red difference (BT.601), softened over seven columns.
    """
    lines, columns, _ = picture.shape
    half = taps.size // 2
    grey = np.empty((2, columns), dtype=np.float32)
    blue = np.empty((2, columns), dtype=np.float32)
    red = np.empty((2, columns), dtype=np.float32)
    for pair in range(lines // 2):
        for k in range(2):
            for c in range(columns):
                r = max(gain * picture[2 * pair + k, c, 0], 0.0) ** (1.0 / 2.2)
                g = max(gain * picture[2 * pair + k, c, 1], 0.0) ** (1.0 / 2.2)
                b = max(gain * picture[2 * pair + k, c, 2], 0.0) ** (1.0 / 2.2)
                y = 0.299 * r + 0.587 * g + 0.114 * b
                grey[k, c] = 16.0 + 219.0 * min(y, 1.0) + noise[2 * pair + k, c]
                blue[k, c], red[k, c] = 126.4 * (b - y), 159.7 * (r - y)
            for c in range(columns):
                total = np.float32(0.5)
                for t in range(taps.size):
                    total += taps[t] * grey[k, min(max(c + t - half, 0), columns - 1)]
                luminance[2 * pair + k, c] = np.uint8(min(max(total, np.float32(1.0)), np.float32(254.0)))
        for c in range(columns // 2):
            first, last = max(2 * c - 3, 0), min(2 * c + 5, columns)
            cb, cr = np.float32(0.0), np.float32(0.0)
            for t in range(first, last):
                cb += blue[0, t] + blue[1, t]
                cr += red[0, t] + red[1, t]
            share = 0.5 / (last - first)
            chrominance[0, pair, c] = np.uint8(min(max(128.5 + share * cb, 1.0), 254.0))
            chrominance[1, pair, c] = np.uint8(min(max(128.5 + share * cr, 1.0), 254.0))
