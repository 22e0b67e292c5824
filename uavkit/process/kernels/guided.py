"""Inner loop of guided feature matching: descriptors are compared only where the geometry allows."""

import numpy as np
from numpy.typing import NDArray

from uavkit.process.kernels.jit import kernel

UNLIKE = -2.0


@kernel
def best_allowed(
    descriptors: NDArray[np.float32],
    others: NDArray[np.float32],
    predicted: NDArray[np.float32],
    lines: NDArray[np.float32],
    xy: NDArray[np.float32],
    ideal: NDArray[np.float32],
    limits: NDArray[np.float32],
    forth: NDArray[np.float32],
    forth_index: NDArray[np.int64],
    back: NDArray[np.float32],
    back_index: NDArray[np.int64],
) -> None:
    """Find the two most alike allowed partners of each feature, both ways.

    A pair is allowed within limits[0], limits[1] of the predicted column and row, and within limits[2] of its epipolar
    line (a, b, c) in ideal coordinates. ``forth`` (n, 2) and ``back`` (m, 2) hold the best and second best likeness.
    """
    for i in range(descriptors.shape[0]):
        for j in range(others.shape[0]):
            if abs(xy[j, 0] - predicted[i, 0]) > limits[0] or abs(xy[j, 1] - predicted[i, 1]) > limits[1]:
                continue
            if abs(lines[i, 0] * ideal[j, 0] + lines[i, 1] * ideal[j, 1] + lines[i, 2]) > limits[2]:
                continue
            likeness = np.float32(0.0)
            for d in range(descriptors.shape[1]):
                likeness += descriptors[i, d] * others[j, d]
            if likeness > forth[i, 0]:
                forth[i, 1] = forth[i, 0]
                forth[i, 0] = likeness
                forth_index[i] = j
            elif likeness > forth[i, 1]:
                forth[i, 1] = likeness
            if likeness > back[j, 0]:
                back[j, 1] = back[j, 0]
                back[j, 0] = likeness
                back_index[j] = i
            elif likeness > back[j, 1]:
                back[j, 1] = likeness
