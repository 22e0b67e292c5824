"""Stills: rendered, exposed, and written as a camera writes them."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from uavkit.core.arrays import Array, Image
from uavkit.simulate.camera import FOCAL_LENGTH_MM, LATTICE_PX, SimulatedCamera, SimulatedView
from uavkit.simulate.kernels import Field, expose, render_rows, soften
from uavkit.simulate.world import World, enu_from_site

BAND_ROWS = 128
"""Rows rendered at a time; the noise belongs to the band, so that memory and result do not depend on the workers."""

OPTICS_SIGMA_PX = 0.45
"""Of the lens; the pixel's own area adds 0.29 px, so that the picture's point spread is 0.53 px."""

LINEAR_GAIN = 1.0
"""Brings the mean ground to a grey value of about 115."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillSettings:
    """How one still was exposed."""

    gain: float
    """Relative to the mean exposure."""
    seed: tuple[int, ...]
    """Of its noise."""


def gaussian_taps(sigma: float, half: int) -> Field:
    """2 * half + 1 weights that sum to 1."""
    taps = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    return np.asarray(taps / taps.sum(), dtype=np.float32)


def view_table(view: SimulatedView) -> Array:
    """The (5, 3) table of ``render_rows``: R_site_from_image, projection centre in the site, principal distance."""
    to_site = enu_from_site().T
    distance = [[view.camera.principal_distance_px, 0.0, 0.0]]
    return np.vstack([to_site @ view.R_object_from_image, (to_site @ view.centre_m)[None], distance])


def render_still(world: World, view: SimulatedView, lattice: Array, settings: StillSettings) -> Image:
    """One still, shape (height, width, 3): all rows at one instant (a global shutter), no motion blur."""
    camera = view.camera
    image = np.empty((camera.height_px, camera.width_px, 3), dtype=np.uint8)
    table, taps = view_table(view), gaussian_taps(OPTICS_SIGMA_PX, 2)
    levels = _levels(camera, settings.gain)
    for first in range(0, camera.height_px, BAND_ROWS):
        rows = min(BAND_ROWS, camera.height_px - first)
        band = np.empty((rows + 4, camera.width_px, 3), dtype=np.float32)
        render_rows(world.ground, lattice, table, np.array([first - 2.0, 1.0, 1.0, 2.0, 2.0, LATTICE_PX]), band)
        softened = np.empty((rows, camera.width_px, 3), dtype=np.float32)
        soften(band, taps, softened)
        rng = np.random.default_rng([*settings.seed, first])
        noise = rng.standard_normal((rows, camera.width_px, 4), dtype=np.float32)
        expose(softened, noise, levels, first, image[first : first + rows])
    return image


def _levels(camera: SimulatedCamera, gain: float) -> Array:
    corner = float(np.hypot(camera.width_px, camera.height_px)) / 2
    return np.array([LINEAR_GAIN * gain, camera.x0_px, camera.y0_px, corner, 1.4, 0.006])


def write_still(path: Path, image: Image, camera_time: datetime, gain: float, quality: int) -> None:
    """Write a JPEG with the EXIF of a compact camera: whole seconds of its own clock, no position."""
    from PIL import Image as Pillow
    from PIL.ExifTags import IFD, Base

    exif = Pillow.Exif()
    stamp = camera_time.strftime("%Y:%m:%d %H:%M:%S")
    exif[Base.Make], exif[Base.Model], exif[Base.Orientation] = "RICOH", "GX200", 1
    exif[Base.DateTime] = stamp
    exif[Base.XResolution] = exif[Base.YResolution] = 72.0
    details = exif.get_ifd(IFD.Exif)
    details[Base.DateTimeOriginal] = details[Base.DateTimeDigitized] = stamp
    details[Base.FocalLength], details[Base.FocalLengthIn35mmFilm] = FOCAL_LENGTH_MM, 24
    details[Base.FNumber], details[Base.ISOSpeedRatings] = 3.5, 100
    details[Base.ExposureTime] = round(gain / 760, 6)
    details[Base.ExifImageWidth], details[Base.ExifImageHeight] = image.shape[1], image.shape[0]
    Pillow.fromarray(image).save(path, "JPEG", quality=quality, subsampling="4:2:2", exif=exif)
