"""Small stills and videos that the tests of the readers make for themselves."""

import io
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin

NTSC = Fraction(30000, 1001)


def picture(width: int = 64, height: int = 48, seed: int = 1) -> NDArray[np.uint8]:
    """Return a smooth colour picture (height, width, 3) that JPEG keeps well."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(30, 220, (6, 8, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC))


def dms(degrees: float) -> tuple[Fraction, ...]:
    """Return degrees, minutes, seconds as EXIF's rationals."""
    seconds = Fraction(round(abs(degrees) * 36_000_000), 10_000)
    return Fraction(seconds // 3600), Fraction(seconds % 3600 // 60), seconds % 60


def write_jpeg(
    path: Path,
    *,
    time: str = "",
    detail: dict[int, object] | None = None,
    gps: dict[int, object] | None = None,
    main: dict[int, object] | None = None,
    xmp: str = "",
    seed: int = 1,
) -> Path:
    """Write a JPEG with EXIF (and XMP) parts."""
    exif = Image.Exif()
    exif.update(main or {})
    if time or detail:
        exif.get_ifd(0x8769).update({**({36867: time} if time else {}), **(detail or {})})
    if gps:
        rational = {
            key: tuple(TiffImagePlugin.IFDRational(part) for part in value) if isinstance(value, tuple) else value
            for key, value in gps.items()
        }
        exif.get_ifd(0x8825).update(rational)
    buffer = io.BytesIO()
    Image.fromarray(picture(seed=seed)).save(buffer, "JPEG", quality=92, exif=exif, xmp=xmp.encode() or None)
    path.write_bytes(buffer.getvalue())
    return path


def counter_luminance(index: int, width: int = 96, height: int = 64) -> NDArray[np.uint8]:
    """Return a frame whose left half's brightness tells its index (to 60), with changing texture on the right."""
    frame = np.full((height, width), 20 + 3 * index, dtype=np.uint8)
    frame[:, width // 2 :] = np.random.default_rng(index).integers(60, 180, (height, width // 2), dtype=np.uint8)
    return frame


def index_of(luminance: NDArray[np.uint8]) -> int:
    """Return the index that ``counter_luminance`` wrote."""
    return round((float(np.mean(luminance[:, 4 : luminance.shape[1] // 2 - 8])) - 20) / 3)


def write_video(
    path: Path,
    count: int,
    *,
    codec: str = "mpeg4",
    luminance: Callable[[int], NDArray[np.uint8]] = counter_luminance,
    options: dict[str, str] | None = None,
    flags: int = 0,
) -> Path:
    """Encode luminance frames with one of FFmpeg's own encoders, a key frame every 12."""
    import av

    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    first = luminance(0)
    height, width = first.shape
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=NTSC, options=options or {})
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.codec_context.gop_size, stream.bit_rate = 12, 8_000_000
        stream.codec_context.flags |= flags
        for index in range(count):
            chroma = np.full((height // 2, width), 128, dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(np.vstack([luminance(index), chroma]), format=pixels)
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
