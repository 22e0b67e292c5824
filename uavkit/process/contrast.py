"""Pictures of faint ground, brought to the contrast that orientation codes need.

Where the ground hardly varies, the line's noise turns the gradients and most pixels stay without a code. Smoothing
takes more of the noise than of the ground, and the rest is stretched about its surroundings.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]

SMOOTHING_PX = 1.5
SURROUNDINGS_PX = 16.0
"""Standard deviations of the smoothing, and of that which is taken off."""
FAINT = 4.0
"""Standard deviation, grey values, of what is left of a picture of faint ground."""
STRETCHED_TO = 30.0
LEAST_CONTRAST = 0.5
"""Of a live picture, grey values; less is noise."""


def contrast(image: Grey) -> float:
    """Return the standard deviation of a picture's detail, grey values."""
    return float(_detail(image).std())


def _detail(image: Grey) -> NDArray[np.float32]:
    values = image.astype(np.float32)
    smooth, wide = (cv2.GaussianBlur(values, (0, 0), sigma) for sigma in (SMOOTHING_PX, SURROUNDINGS_PX))
    return np.asarray(smooth - wide, np.float32)


def stretched(image: Grey) -> Grey:
    """Return a picture's detail about grey 128, stretched; flat where it shows nothing."""
    detail = _detail(image)
    spread = float(detail.std())
    gain = STRETCHED_TO / spread if spread >= LEAST_CONTRAST else 0.0
    return np.asarray(np.clip(np.rint(128.0 + gain * detail), 0, 255), np.uint8)


def visible(still: Grey) -> Grey:
    """Return a still as it is, or stretched where it shows faint ground; judged at about the size of a video picture.

    Matching works on grey values of some contrast: what counts as texture is a number of grey values.
    """
    reduction = max(1, round(still.shape[1] / JUDGED_AT_PX))
    size = still.shape[1] // reduction, still.shape[0] // reduction
    small = np.asarray(cv2.resize(still, size, interpolation=cv2.INTER_AREA), np.uint8)
    return stretched(still) if min(size) > 64 and contrast(small) < FAINT else still


JUDGED_AT_PX = 640
