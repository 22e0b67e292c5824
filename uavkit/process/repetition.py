"""Ground that repeats itself: whether a picture shows such, at which shifts, and motion told by what does not repeat.

Rows of plants look alike at every period, and a correlation of pictures then has a peak at each. What lies over the
rows, tone of wide extent, does not repeat: pictures smoothed until the rows are gone show it, and are registered by
the enhanced correlation coefficient (Evangelidis and Psarakis 2008), coarse to fine.
"""

from functools import lru_cache
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array

Grey = NDArray[np.uint8]
Small = NDArray[np.float32]
Tone = NDArray[np.float32]
"""A picture without what repeats itself."""

WINDOW_PX = 128
"""Side of the windows that are looked at by themselves: perspective and relief make the period vary over a picture."""
WIDE_TONE_PX = 12.0
"""Standard deviation of the smoothing that is taken off: tone wider than this is no repetition."""
LEAST_REPETITION = 0.6
"""Correlation of a window with itself at a shift, from which it repeats itself; in random texture some 0.15."""
NEARLY = 0.9
"""Share of the highest peak's height from which a shorter shift counts as well."""
LEAST_SHIFT_PX = 4
MOST_SHIFT_PX = 40
LEAST_WINDOWS = 0.5
"""Share of the windows that repeat themselves for the picture to be so."""
REDUCTION = 4
REACH_PX = 80
"""Longest shift of the whole picture, along columns and rows."""
RIM_PX = 24
"""Left out: smoothing falsifies it."""
STAGES = (
    (16.0, 60.0, cv2.MOTION_TRANSLATION),
    (10.0, 40.0, cv2.MOTION_EUCLIDEAN),
    (8.0, 40.0, cv2.MOTION_AFFINE),
)
"""Smoothing and width of the tone taken off, standard deviations in px, and what is free."""
TONE_SMOOTHING_PX = 4.0
TONE_STEPS_PX = np.arange(-30.0, 31.0, 10.0)
"""Places about a point where its tone is read, along columns and rows."""


def repeat_shifts(image: Grey) -> Array:
    """Return shifts (k, 2), in columns and rows, at which a picture repeats itself; none for ordinary ground.

    Of each window that repeats itself, the shift of the highest peak of its autocorrelation off the middle, and of the
    shortest that is nearly as high: the highest may be a multiple.
    """
    fine = image.astype(np.float32)
    fine -= cv2.GaussianBlur(fine, (0, 0), WIDE_TONE_PX)
    rows, columns = (range(0, size - WINDOW_PX + 1, WINDOW_PX) for size in image.shape)
    count, shifts, without = len(rows) * len(columns), list[tuple[int, int]](), 0
    for row, column in product(rows, columns):
        pair, value = _repetition(fine[row : row + WINDOW_PX, column : column + WINDOW_PX])
        if value >= LEAST_REPETITION:
            shifts += pair
        else:
            without += 1
        if count - without < max(1.0, LEAST_WINDOWS * count):  # ordinary ground shows it soon
            return np.zeros((0, 2))
    if count == 0:
        return np.zeros((0, 2))
    return np.unique(np.array(shifts, dtype=np.float64), axis=0)


def _repetition(window: Small) -> tuple[list[tuple[int, int]], float]:
    """Return the shifts of two peaks off the middle of a window's autocorrelation, and the height of the first.

    The first is the highest (1: exact), the second the shortest that is nearly as high.
    """
    tapered = (window - window.mean()) * np.outer(*(np.hanning(size) for size in window.shape))
    raw, least = _autocorrelation(tapered), _autocorrelation_of_taper(window.shape)
    reach = np.arange(-MOST_SHIFT_PX, MOST_SHIFT_PX + 1)
    part = raw[np.ix_(reach, reach)] / np.maximum(least[np.ix_(reach, reach)], 1e-3 * least[0, 0])
    if part[MOST_SHIFT_PX, MOST_SHIFT_PX] <= 0.25:
        return [], 0.0
    part = part / part[MOST_SHIFT_PX, MOST_SHIFT_PX]
    around = cv2.dilate(part, np.ones((3, 3)))
    length = np.hypot(*np.meshgrid(reach, reach))
    peak = (part >= around) & (length >= LEAST_SHIFT_PX)
    peak[:MOST_SHIFT_PX] = False
    if not peak.any():
        return [], 0.0
    highest = int(np.argmax(np.where(peak, part, -1.0)))
    nearly = peak & (part >= NEARLY * part.flat[highest])
    places = [divmod(at, len(reach)) for at in (highest, int(np.argmin(np.where(nearly, length, np.inf))))]
    return [(int(reach[column]), int(reach[row])) for row, column in places], float(part.flat[highest])


def _autocorrelation(window: Array) -> Array:
    padded = tuple(2 * size for size in window.shape)
    return np.asarray(np.fft.irfft2(np.abs(np.fft.rfft2(window, padded)) ** 2, padded))


@lru_cache(maxsize=4)
def _autocorrelation_of_taper(shape: tuple[int, int]) -> Array:
    return _autocorrelation(np.outer(*(np.hanning(size) for size in shape)))


def wide_motion(before: Grey, after: Grey) -> tuple[Array, float]:
    """Return after_from_before (2, 3), affine, in pixels, by tone of wide extent alone, and the tone's correlation.

    Good to some pixels: it tells which period is meant. A stage that does not converge is left out. The correlation
    is 0 where there is no tone.
    """
    one, two = _reduced(before), _reduced(after)
    motion = _wide_shift(*(_band(image, *STAGES[0][:2]) for image in (one, two)))
    for smoothing_px, wide_px, free in STAGES:
        bands = _band(one, smoothing_px, wide_px), _band(two, smoothing_px, wide_px)
        motion = _registered(*bands, motion, (smoothing_px, free))
    likeness = _likeness(*bands, motion)
    half = 0.5 * (REDUCTION - 1)
    shift = REDUCTION * motion[:, 2] + half - motion[:, :2] @ np.full(2, half)
    return np.column_stack([motion[:, :2], shift]), likeness


def _likeness(before: Small, after: Small, motion: Array) -> float:
    """Return the correlation of what both small pictures show; 0 where one shows nothing."""
    rim = RIM_PX // REDUCTION
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = before.shape[::-1]
    moved = cv2.warpAffine(after, motion, size, flags=flags, borderValue=float("nan"))[rim:-rim, rim:-rim]
    both = np.isfinite(moved)
    one, two = before[rim:-rim, rim:-rim][both], moved[both]
    if both.mean() < LEAST_COMMON or min(one.std(), two.std()) < LEAST_TONE:
        return 0.0
    return float(np.corrcoef(one, two)[0, 1])


LEAST_COMMON = 0.25
"""Share of a picture that the other must show."""
LEAST_TONE = 0.3
"""Standard deviation of tone, grey values; less is noise."""


def _wide_shift(before: Small, after: Small) -> Array:
    """Return after_from_before (2, 3), a shift of small pictures, by the highest correlation within ``REACH_PX``."""
    reach, rim = REACH_PX // REDUCTION, RIM_PX // REDUCTION
    inner = before[rim + reach : -rim - reach, rim + reach : -rim - reach]
    likeness = cv2.matchTemplate(after[rim:-rim, rim:-rim], inner, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    return np.array([[1.0, 0.0, column - reach], [0.0, 1.0, row - reach]])


def _reduced(image: Grey) -> Small:
    size = image.shape[1] // REDUCTION, image.shape[0] // REDUCTION
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


def _band(image: Small, smoothing_px: float, wide_px: float) -> Small:
    smooth = cv2.GaussianBlur(image, (0, 0), smoothing_px / REDUCTION)
    return np.asarray(smooth - cv2.GaussianBlur(image, (0, 0), wide_px / REDUCTION), np.float32)


def _registered(before: Small, after: Small, start: Array, stage: tuple[float, int]) -> Array:
    """Return after_from_before (2, 3) of small pictures; the rim, which smoothing falsifies, is left out."""
    smoothing_px, free = stage
    rim = int(1.5 * smoothing_px / REDUCTION)
    mask = np.zeros(before.shape, np.uint8)
    mask[rim : before.shape[0] - rim, rim : before.shape[1] - rim] = 255
    end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    try:
        _, found = cv2.findTransformECC(before, after, start.astype(np.float32), free, end, mask, 5)
    except cv2.error:  # it did not converge
        return start
    return np.asarray(found, dtype=np.float64)


def tone_of(image: Grey) -> Tone:
    """Return a picture smoothed until rows of plants are nearly gone."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), TONE_SMOOTHING_PX), np.float32)


def tone_costs(before: Tone, after: Tone, before_px: Array, after_px: Array, after_from_before: Array) -> Array:
    """Return 1 minus the correlation of tone about points, (n,), 0 to 2; nan where a picture ends.

    Points (n, 2) of both pictures, and the local transformation (n, 2, 2) about each.
    """
    offsets = np.stack(np.meshgrid(TONE_STEPS_PX, TONE_STEPS_PX), axis=-1).reshape(-1, 2)
    places = (
        before_px[:, None] + np.einsum("nij,kj->nki", np.linalg.inv(after_from_before), offsets),
        after_px[:, None] + offsets,
    )
    read = [_read(tone, at) for tone, at in zip((before, after), places, strict=True)]
    one, two = (values - values.mean(axis=1, keepdims=True) for values in read)
    power = (one**2).sum(axis=1) * (two**2).sum(axis=1)
    return np.asarray(1.0 - (one * two).sum(axis=1) / np.sqrt(power + 1e-6))


def _read(tone: Tone, places_px: Array) -> Array:
    """Return values (n, k) at places (n, k, 2), nan outside."""
    x, y = (places_px[..., axis].astype(np.float32) for axis in (0, 1))
    rows, columns = tone.shape
    values = cv2.remap(tone, x, y, cv2.INTER_LINEAR).astype(np.float64)
    values[(x < 0) | (y < 0) | (x > columns - 1) | (y > rows - 1)] = np.nan
    return np.asarray(values)
