"""Faint ground is brought to the contrast that matching needs; other pictures stay as they are."""

import numpy as np

from tests.process.textures import picture, wave_texture
from uavkit.process.contrast import FAINT, contrast, stretched, visible
from uavkit.process.orientation_code import orientation_codes

SHAPE = (480, 640)


def seen(gain: float, noise: float = 1.0, seed: int = 0) -> np.ndarray:
    """The same ground at a contrast, with noise of its own."""
    texture = wave_texture(np.random.default_rng(7), shortest_px=6.0, longest_px=40.0)
    return picture(texture, SHAPE, gain=gain, noise=noise, rng=np.random.default_rng(seed))


def test_ordinary_stills_stay_as_they_are():
    still = seen(30.0)
    assert contrast(still) > FAINT
    assert visible(still) is still


def test_faint_ground_gets_codes_that_agree():
    one, two = seen(2.0, seed=1), seen(2.0, seed=2)
    assert contrast(one) < FAINT
    codes = [orientation_codes(visible(image)).astype(int) for image in (one, two)]
    both = (codes[0] < 16) & (codes[1] < 16)
    apart = np.abs(codes[0] - codes[1])[both]
    assert both.mean() > 0.6
    assert np.mean(np.minimum(apart, 16 - apart) <= 1) > 0.7  # 3 of 16 codes by chance


def test_a_picture_of_nothing_stays_flat():
    assert np.ptp(stretched(np.full(SHAPE, 16, np.uint8))) == 0
