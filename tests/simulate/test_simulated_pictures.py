"""Pictures at full resolution: natural statistics, detail down to the pixel all over, noise as stated.

Two exposures of one view differ in noise alone: what they have in common is the picture, the rest is noise.
"""

from dataclasses import replace

import numpy as np
import pytest

from uavkit.simulate.camera import SimulatedView, true_camera
from uavkit.simulate.flight import make_flight
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.stills import StillSettings, render_still
from uavkit.simulate.world import make_world

SIZE = 1024


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    """Green of the same 1024 x 1024 px in the middle of a full-size still, exposed twice."""
    world, options = make_world(1), SimulationOptions()
    flight, camera = make_flight(world, options), true_camera(1, 1.0)
    cut = replace(camera, width_px=SIZE, height_px=SIZE, x0_px=camera.x0_px - 1500, y0_px=camera.y0_px - 1000)
    whole = flight.view(camera, float(flight.exposure_s[18]))
    view = SimulatedView(camera=cut, centre_m=whole.centre_m, R_object_from_image=whole.R_object_from_image)
    one, two = (render_still(world, view, cut.lattice(), StillSettings(gain=1.0, seed=(n,))) for n in (1, 2))
    return one[:, :, 1].astype(float), two[:, :, 1].astype(float)


def test_noise_is_that_of_a_small_sensor(pair: tuple[np.ndarray, np.ndarray]) -> None:
    noise = (pair[0] - pair[1]).std() / np.sqrt(2)
    assert 1.5 < noise < 3.0


def test_amplitudes_fall_with_frequency_as_in_nature(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """Amplitude about 1 / f from 100 px down to 5 px; beyond, lens and pixel damp it but do not cut it."""
    window = np.outer(np.hanning(SIZE), np.hanning(SIZE))
    spectra = [np.fft.fft2((picture - picture.mean()) * window) for picture in pair]
    common = (spectra[0] * spectra[1].conj()).real
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.fftfreq(SIZE)[None, :])
    centres = np.array([0.01, 0.02, 0.04, 0.08, 0.16, 0.2])
    power = [common[(frequency > f * 0.9) & (frequency < f * 1.1)].mean() for f in centres]
    slope = np.polyfit(np.log(centres), 0.5 * np.log(power), 1)[0]
    assert -1.6 < slope < -0.8
    fine = common[(frequency > 0.3) & (frequency < 0.4)].mean()
    noise = 0.5 * (np.abs(spectra[0] - spectra[1]) ** 2)[(frequency > 0.3) & (frequency < 0.4)].mean()
    assert fine > 0.5 * noise
    nyquist = common[frequency > 0.6].mean()  # the corners, beyond what a lens passes
    assert nyquist < 0.2 * fine


def test_there_is_texture_to_match_everywhere(pair: tuple[np.ndarray, np.ndarray]) -> None:
    """In every window of 32 px the picture varies by more than its noise, in most of them by several times as much."""
    blocks = [p.reshape(SIZE // 32, 32, SIZE // 32, 32).transpose(0, 2, 1, 3).reshape(-1, 1024) for p in pair]
    centred = [b - b.mean(axis=1, keepdims=True) for b in blocks]
    signal = np.sqrt(np.maximum((centred[0] * centred[1]).mean(axis=1), 0.0))
    noise = (pair[0] - pair[1]).std() / np.sqrt(2)
    assert np.percentile(signal, 1) > 0.8 * noise
    assert np.median(signal) > 3.0 * noise
    assert np.percentile(signal, 95) > 1.5 * np.percentile(signal, 10)  # weak and strong regions
