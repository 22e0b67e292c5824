"""Stills from image files: the filling of ``StillSource`` that reads JPEG, TIFF and PNG.

The pixels are those of the file's raster as the sensor wrote it: EXIF's orientation flag is not applied, because the
interior orientation belongs to the sensor and not to the way in which a viewer would turn the picture.
"""

import hashlib
import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from uavkit.core.arrays import Image
from uavkit.core.errors import InputError, did_you_mean
from uavkit.core.records import StillInfo
from uavkit.formats.exif import DroneTags, read_header

SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""In coded data a marker is 0xFF followed by neither a stuffed zero nor a restart nor another fill byte."""


class FileStillSource:
    """The stills of folders, or of a list of files, in the order in which they were taken."""

    def __init__(self, files: Path | Iterable[Path]) -> None:
        """Take the stills of a folder, or the given files and the stills of the given folders.

        Raises InputError where there are none or names are doubled.
        """
        given = [files] if isinstance(files, Path) else [Path(path) for path in files]
        whole_folder = isinstance(files, Path)
        paths = [
            path
            for place in given
            for path in (_stills_of_folder(place) if whole_folder or place.is_dir() else [place])
        ]
        if not paths:
            raise InputError("no stills were given: name at least one JPEG, TIFF or PNG file")
        self._paths: dict[str, Path] = {}
        for path in sorted(paths, key=lambda path: natural_key(path.name)):
            other = self._paths.setdefault(path.name, path)
            if other is not path:
                raise InputError(f"{path} and {other} have the same name: rename one of them, images are told by name")
        self._stills: tuple[StillInfo, ...] | None = None
        self._tags: dict[str, DroneTags] = {}
        self._unreadable: dict[str, str] = {}
        self._notes: tuple[str, ...] = ()
        self._hashes: dict[str, tuple[int, int, str]] = {}

    def stills(self) -> tuple[StillInfo, ...]:
        """Return the readable stills in the order of the camera's clock, of their names where it does not tell."""
        if self._stills is None:
            infos = []
            for name, path in self._paths.items():
                try:
                    info, self._tags[name] = read_header(path)
                    _refuse_truncated(path)
                    infos.append(info)
                except InputError as error:
                    self._unreadable[name] = str(error).removeprefix(f"{path}: ")
                except (OSError, SyntaxError, ValueError) as error:
                    self._unreadable[name] = _cause(path, error)
            self._stills, self._notes = _in_order(tuple(infos))
        return self._stills

    def unreadable(self) -> dict[str, str]:
        """Return each file that is empty, truncated or no picture, with the reason; they are not among ``stills``."""
        self.stills()
        return dict(self._unreadable)

    def notes(self) -> tuple[str, ...]:
        """Return what is odd about the stills as a whole, in words."""
        self.stills()
        return self._notes

    def drone_tags(self, name: str) -> DroneTags:
        """Return what a DJI drone wrote beside EXIF; all None for other cameras."""
        self.stills()
        return self._tags.get(self.path(name).name, DroneTags())

    def grey(self, name: str) -> Image:
        """Return grey values (height, width); of JPEG the luminance as coded. Raises InputError if unreadable."""
        import cv2

        return self._decode(name, cv2.IMREAD_GRAYSCALE)

    def colour(self, name: str) -> Image:
        """Return red, green, blue (height, width, 3); raises InputError as ``grey`` does."""
        import cv2

        return np.ascontiguousarray(self._decode(name, cv2.IMREAD_COLOR)[:, :, ::-1])

    def fingerprint(self, name: str) -> str:
        """Return the SHA-256 of the file, computed again only where size or time of change differ."""
        path = self.path(name)
        try:
            status = path.stat()
            size, changed, known = self._hashes.get(name, (-1, -1, ""))
            if (size, changed) != (status.st_size, status.st_mtime_ns):
                with path.open("rb") as stream:
                    known = hashlib.file_digest(stream, "sha256").hexdigest()
                self._hashes[name] = (status.st_size, status.st_mtime_ns, known)
        except OSError as error:
            raise InputError(f"{path}: {_cause(path, error)}") from error
        return known

    def path(self, name: str) -> Path:
        """Return the file of a still; raises InputError for an unknown name."""
        if name not in self._paths:
            raise InputError(f"there is no still {name!r}{did_you_mean(name, self._paths)}")
        return self._paths[name]

    def _decode(self, name: str, mode: int) -> Image:
        import cv2

        path = self.path(name)
        _refuse_truncated(path)
        content = np.fromfile(path, dtype=np.uint8)
        try:
            pixels = cv2.imdecode(content, mode | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error as error:
            raise InputError(f"{path}: cannot be decoded ({error.err}): copy it again or leave it out") from error
        if pixels is None:
            raise InputError(f"{path}: cannot be decoded, it is damaged or no picture: copy it again or leave it out")
        return np.asarray(pixels, dtype=np.uint8)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sorting key by which IMG_9 precedes IMG_10; case counts only between otherwise equal names."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts) + ((2, 0, name),)


def _stills_of_folder(folder: Path) -> list[Path]:
    try:
        if not folder.is_dir():
            what = "is a file, not a folder" if folder.exists() else "does not exist"
            raise InputError(f"{folder}: {what}: give the folder of the stills")
        entries = list(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error})") from error
    found = [path for path in entries if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    for path in found:
        if not path.is_file():
            what = "a folder" if path.is_dir() else "a link to nothing" if path.is_symlink() else "a pipe or a device"
            raise InputError(f"{path}: is {what}, no still: move it elsewhere, or rename it")
    if found:
        return found
    below = sorted({path.parent for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES})
    hint = f": did you mean {below[0]}?" if below else f": it should hold files ending in {', '.join(SUFFIXES)}"
    raise InputError(f"{folder}: no stills in this folder{hint}")


def _in_order(stills: tuple[StillInfo, ...]) -> tuple[tuple[StillInfo, ...], tuple[str, ...]]:
    """Put stills, sorted by name, in the order of the camera's clock where every still tells it."""
    times = [still.camera_time_ns for still in stills if still.camera_time_ns is not None]
    if len(times) < len(stills):
        missing = len(stills) - len(times)
        note = f"{missing} of {len(stills)} stills tell no time: the order is that of their names"
        return stills, (note,) if times else ()
    if all(earlier <= later for earlier, later in pairwise(times)):
        return stills, ()
    by_clock = [still for _, still in sorted(zip(times, stills, strict=True), key=lambda pair: pair[0])]
    return tuple(by_clock), ("names and camera clock give different orders: the order is that of the clock",)


def _refuse_truncated(path: Path) -> None:
    """Raise InputError where a file is missing, empty or ends early; reads the whole file only if its end is odd."""
    try:
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path}: the file is empty (0 bytes): copy it again from the camera or leave it out")
        with path.open("rb") as stream:
            start = stream.read(16)
            stream.seek(max(0, size - 64))
            end = stream.read()
        if start.startswith(b"\xff\xd8"):
            complete = b"\xff\xd9" in end or _has_end_of_image(path.read_bytes())
        elif start.startswith(b"\x89PNG"):
            complete = b"IEND" in end or b"IEND" in path.read_bytes()
        else:
            complete = _tiff_strips_end(path) <= size
    except OSError as error:
        raise InputError(f"{path}: {_cause(path, error)}") from error
    if not complete:
        raise InputError(f"{path}: the file is truncated: copy it again from the camera or leave it out")


def _has_end_of_image(content: bytes) -> bool:
    """Tell whether a JPEG's first picture is whole: walk its segments and scans to the end-of-image marker.

    The thumbnail inside EXIF has an end marker of its own and is stepped over by the length of its segment.
    """
    place = 2
    while place + 4 <= len(content):
        marker = _JPEG_MARKER.search(content, place)
        if marker is None:
            return False
        if content[marker.start() + 1] == 0xD9:
            return True
        place = marker.end() + int.from_bytes(content[marker.end() : marker.end() + 2], "big")
    return content[place : place + 2] == b"\xff\xd9"


def _tiff_strips_end(path: Path) -> int:
    """Return where the last strip or tile of a TIFF ends, 0 where the file is none."""
    from PIL import Image, TiffImagePlugin

    try:
        with Image.open(path) as image:
            if not isinstance(image, TiffImagePlugin.TiffImageFile):
                return 0
            tags = image.tag_v2
            offsets = tags.get(273) or tags.get(324) or ()
            lengths = tags.get(279) or tags.get(325) or ()
            return max((int(a) + int(b) for a, b in zip(offsets, lengths, strict=False)), default=0)
    except (SyntaxError, ValueError):
        return 0


def _cause(path: Path, error: Exception) -> str:
    """Say in plain words why a file cannot be read."""
    if not path.is_file():
        return "the file does not exist"
    if path.stat().st_size == 0:
        return "the file is empty (0 bytes)"
    if isinstance(error, OSError) and error.strerror:
        return f"the file cannot be read ({error.strerror})"
    return "the file is damaged or no picture: its header cannot be read"
