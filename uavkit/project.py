"""A survey folder: where the files of each stage lie, what is out of date, and who is working in it.

``manifest.json`` names the originals, which stay where they are and are never changed, and the options of each stage.
A stage that has finished leaves ``state.json`` in its folder: its options, and size, time and hash of every file that
it read and wrote. It is out of date as soon as one of these is no longer so.
"""

import hashlib
import json
import os
import socket
import stat
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import IO, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from uavkit import __version__
from uavkit.core.arrays import content_hash
from uavkit.core.cache import Arrays
from uavkit.core.errors import InputError, did_you_mean
from uavkit.formats.atomic import atomic_path, write_text
from uavkit.formats.image_files import SUFFIXES

MANIFEST = "manifest.json"
LOCK = ".lock"
STATE = "state.json"
CACHE = "cache"


class Stage(Enum):
    """The stages of a survey, in their order; the value is the name of the folder."""

    INGEST = "ingest"
    PROCESS = "process"
    REPORT = "report"


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Original(_Strict):
    """Where a file or folder of the user lies: absolute, and as seen from the survey, if both move together."""

    absolute: str
    relative: str


class IngestOptions(_Strict):
    """What the user says of the originals."""

    camera: str = ""
    """Name of a profile; empty: what EXIF tells. A file of one's own is an original."""
    height_datum: Literal["", "ellipsoid", "geoid", "unknown"] = ""
    """Of the heights in the positions file and in EXIF; empty: what these say themselves."""
    crs: str = ""
    """Horizontal system of the control file and of the results; empty: that of the control file, else UTM."""
    pixel_origin: Literal["", "centre", "corner"] = ""
    """Which point of the upper left pixel is (0, 0) in marks; empty: what the control file says."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the camera to the GNSS antenna in the vehicle's axes: forward, right, down."""
    shutter_latency_s: float = 0.0
    """From an exposure event of a log to the exposure."""
    latency_sigma_s: float = 0.1
    """How far the latency may be off; the adjustment estimates the rest. 0 holds it."""


Role = Literal["images", "video", "positions", "log", "plan", "match", "control_points", "check_points", "camera"]
"""What an original is to a survey."""


class Manifest(_Strict):
    """What a survey is made of."""

    uavkit_survey: Literal[1] = 1
    """Version of this file's format."""
    originals: dict[Role, Original | tuple[Original, ...]]
    """Several files of one role in the order in which they were given."""
    ingest: IngestOptions
    process: tuple[str, ...] = ()
    """Settings ``section.option=value`` that differ from the defaults."""
    simulated: Literal["", "constant", "trace"] = ""
    """Flight whose conditions a simulated survey repeats, for the comparison in the report."""
    simulated_scale: float = 1.0
    """Size of the simulated stills against the published ones."""


class FileStamp(_Strict):
    """What a file was when a stage read or wrote it."""

    size: int
    mtime_ns: int
    sha256: str


class StageState(_Strict):
    """What a finished stage leaves."""

    uavkit: str
    options: dict[str, str]
    inputs: dict[str, FileStamp]
    outputs: dict[str, FileStamp]


class Standing(Enum):
    """Where a stage stands."""

    DONE = "done"
    OUT_OF_DATE = "out of date"
    RUNNING = "running"
    MISSING = "missing"


@dataclass(frozen=True, slots=True, kw_only=True)
class StageStatus:
    """Where a stage stands, and why."""

    stage: Stage
    standing: Standing
    why: str = ""


Model = TypeVar("Model", bound=_Strict)


class Project:
    """A survey folder."""

    def __init__(self, folder: Path) -> None:
        """Take a folder as it is; nothing is read or written yet."""
        self.folder = Path(os.path.abspath(folder))  # noqa: PTH100  (resolve() would follow links)
        self._lock: IO[str] | None = None

    @property
    def manifest(self) -> Manifest:
        """Return the manifest; raises InputError where the folder is no survey or the file is damaged."""
        path = self.folder / MANIFEST
        if not path.is_file():
            raise InputError(f"{self.folder} is no survey (it has no {MANIFEST}): run 'uavkit ingest' on it first")
        return _read(path, Manifest)

    def save_manifest(self, manifest: Manifest) -> None:
        """Write the manifest."""
        write_text(self.folder / MANIFEST, manifest.model_dump_json(indent=2) + "\n")

    def original(self, path: Path) -> Original:
        """Return how the manifest refers to a file or folder; raises InputError where it is none."""
        absolute = Path(os.path.abspath(path))  # noqa: PTH100
        try:
            mode = absolute.stat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(f"{path} does not exist: check the path") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise InputError(f"{path}: is a device or a pipe: give a file or a folder")
        try:
            relative = os.path.relpath(absolute, self.folder)
        except ValueError:  # another drive
            relative = ""
        return Original(absolute=absolute.as_posix(), relative=Path(relative).as_posix() if relative else "")

    def original_path(self, role: str) -> Path | None:
        """Return where an original lies now, None where the survey has none of this role.

        Raises InputError where it is gone, or where the role has several.
        """
        paths = self.original_paths(role)
        if len(paths) > 1:
            raise InputError(f"{self.folder}: one file as {role.replace('_', ' ')}, not {len(paths)}")
        return paths[0] if paths else None

    def original_paths(self, role: str) -> tuple[Path, ...]:
        """Return where the originals of a role lie now, none where the survey has none.

        Raises InputError where one is neither at its old place nor at the same place as seen from the survey.
        """
        known = {str(name): value for name, value in self.manifest.originals.items()}.get(role, ())
        entries = (known,) if isinstance(known, Original) else known
        return tuple(self._place_of(entry, role) for entry in entries)

    def _place_of(self, entry: Original, role: str) -> Path:
        places = [Path(entry.absolute)] + ([self.folder / entry.relative] if entry.relative else [])
        for place in places:
            if place.exists():
                return place
        raise InputError(
            f"{entry.absolute} ({role.replace('_', ' ')}) is gone: put it back, or run 'uavkit ingest' again"
        )

    def stage_folder(self, stage: Stage) -> Path:
        """Return the folder of a stage's files."""
        return self.folder / stage.value

    @property
    def block_file(self) -> Path:
        """Return where ingest leaves the block."""
        return self.stage_folder(Stage.INGEST) / "block.json"

    @property
    def result_file(self) -> Path:
        """Return where process leaves the oriented block."""
        return self.stage_folder(Stage.PROCESS) / "oriented_block.npz"

    def cache(self, stage: Stage) -> "FolderCache":
        """Return the cache of a stage's steps."""
        return FolderCache(self.stage_folder(stage) / CACHE)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other run out of this survey; the lock of a run that died is no lock.

        Raises InputError where another run is at work here.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"{self.folder}: is a file: name a folder for the survey")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            stream = (self.folder / LOCK).open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        with stream:
            if not _take_lock(stream):
                raise InputError(
                    f"{self.folder}: {_holder(stream)} is at work in this survey: wait until it has finished"
                )
            self._lock = stream
            self._sign_lock("")
            try:
                yield
            finally:
                stream.truncate(0)
                self._lock = None

    def _sign_lock(self, stage: str) -> None:
        if self._lock is not None:
            content = json.dumps({"process": os.getpid(), "computer": socket.gethostname(), "stage": stage})
            self._lock.truncate(0)
            with suppress(OSError):  # a full disk: the lock holds without its text, and the stage says what is wrong
                os.write(self._lock.fileno(), content.encode())

    @contextmanager
    def running(self, stage: Stage) -> Iterator[None]:
        """Do a stage's work inside; when it ends well, what it read and wrote is noted and the stage is up to date."""
        folder = self.stage_folder(stage)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / STATE).unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror or error})") from error
        self._sign_lock(stage.value)
        inputs = _stamps(self._inputs(stage), self._known_stamps())
        yield
        outputs = _stamps({self._name(path): path for path in self._files_of(stage)}, {})
        state = StageState(uavkit=__version__, options=self._options(stage), inputs=inputs, outputs=outputs)
        write_text(folder / STATE, state.model_dump_json(indent=1) + "\n")

    def status(self) -> tuple[StageStatus, ...]:
        """Return where each stage stands, in their order; raises InputError where the folder is no survey."""
        _ = self.manifest
        active = self._active_stage()
        found: list[StageStatus] = []
        for stage in Stage:
            if active == stage.value:
                found.append(StageStatus(stage=stage, standing=Standing.RUNNING))
                continue
            stale = next((s for s in found if s.standing is not Standing.DONE), None)
            found.append(self._status_of(stage, stale))
        return tuple(found)

    def _status_of(self, stage: Stage, stale: StageStatus | None) -> StageStatus:
        path = self.stage_folder(stage) / STATE
        if not path.is_file():
            begun = (self.stage_folder(stage) / CACHE).is_dir()
            why = "not finished; the steps that were are kept" if begun else "not run yet"
            return StageStatus(stage=stage, standing=Standing.MISSING, why=why)
        if stale is not None:
            why = f"{stale.stage.value} is {stale.standing.value}"
        else:
            why = self._why_out_of_date(stage, path)
        return StageStatus(stage=stage, standing=Standing.OUT_OF_DATE if why else Standing.DONE, why=why)

    def _why_out_of_date(self, stage: Stage, state_file: Path) -> str:
        """Return in words why a finished stage has to run again, "" where it has not."""
        try:
            state = _read(state_file, StageState)
            inputs = self._inputs(stage)
        except InputError as error:
            return str(error)
        if state.uavkit != __version__:
            return f"made by uavkit {state.uavkit}"
        options = self._options(stage)
        changed = sorted(
            name for name in options.keys() | state.options.keys() if options.get(name) != state.options.get(name)
        )
        if changed:
            return f"option {', '.join(changed)} changed"
        outputs = {name: self.folder / name for name in state.outputs}
        return self._difference(state.inputs, inputs) or self._difference(state.outputs, outputs)

    def _difference(self, before: dict[str, FileStamp], now: dict[str, Path]) -> str:
        """Return in words how files differ from their stamps, "" where they do not."""
        gone = sorted(name for name in before if name not in now or not now[name].is_file())
        new = sorted(name for name in now if name not in before)
        changed = sorted(
            name for name, path in now.items() if name in before and name not in gone and not _same(path, before[name])
        )
        for names, verb in ((gone, "gone"), (new, "new"), (changed, "changed")):
            if names:
                others = (
                    f" and {len(names) - 1} other file{'s' if len(names) > 2 else ''} are" if len(names) > 1 else " is"
                )
                return f"{names[0]}{others} {verb}"
        return ""

    def _active_stage(self) -> str:
        """Return the stage that another process is working on, "" if none."""
        path = self.folder / LOCK
        if self._lock is not None or not path.is_file():
            return ""
        with path.open("r+", encoding="utf-8") as stream:
            if _take_lock(stream):
                return ""
            return str(_lock_content(stream).get("stage", ""))

    def _options(self, stage: Stage) -> dict[str, str]:
        manifest = self.manifest
        if stage is Stage.INGEST:
            return {name: str(value) for name, value in manifest.ingest.model_dump().items()}
        if stage is Stage.PROCESS:
            return dict(setting.partition("=")[::2] for setting in manifest.process)
        return {"simulated": manifest.simulated, "simulated_scale": str(manifest.simulated_scale)}

    def _inputs(self, stage: Stage) -> dict[str, Path]:
        """Return the files that a stage reads, by names that do not change when the survey is moved."""
        if stage is Stage.REPORT:
            return {self._name(path): path for path in self._files_of(Stage.PROCESS)}
        roles = [str(role) for role in self.manifest.originals]
        if stage is Stage.PROCESS:
            roles = [role for role in roles if role in ("images", "video")]
        files: dict[str, Path] = {}
        for role in roles:
            for place in self.original_paths(role):
                for path in _files(place):
                    name = f"{role}: {path.name}"
                    files[name if name not in files else f"{role}: {path.parent.name}/{path.name}"] = path
        if stage is Stage.PROCESS:
            files |= {self._name(path): path for path in self._files_of(Stage.INGEST)}
        return files

    def _files_of(self, stage: Stage) -> list[Path]:
        """Return the files of a stage's folder that count as its output."""
        folder = self.stage_folder(stage)
        if not folder.is_dir():
            return []
        files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
        own = (path for path in files if path.name != STATE and folder / CACHE not in path.parents)
        return sorted(own)

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _known_stamps(self) -> dict[str, FileStamp]:
        """Return the stamps that ingest noted, so that the same pictures need not be read again."""
        path = self.stage_folder(Stage.INGEST) / STATE
        return _read(path, StageState).inputs if path.is_file() else {}


class FolderCache:
    """A ``StepCache`` that keeps each step's arrays in one file; a damaged file is computed anew.

    The files are the same, byte for byte, whenever the arrays are.
    """

    def __init__(self, folder: Path) -> None:
        """Keep the files in a folder, which is made when it is needed."""
        self._folder = folder
        self._used: set[Path] = set()

    def arrays(self, step: str, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """Return the arrays kept for (step, key), or compute, keep and return them.

        Raises InputError where the disk is full; what finished before is kept.
        """
        path = self._folder / f"{_file_name(step)}-{content_hash([step, key])[:32]}.npz"
        self._used.add(path)
        kept = _kept_arrays(path)
        if kept is not None:
            return kept
        arrays = compute()
        with atomic_path(path) as temporary:
            np.savez(temporary, **arrays)  # type: ignore[arg-type]  # numpy's stub takes allow_pickle for an array
        return arrays

    def forget_unused(self) -> None:
        """Remove what this object neither kept nor found: steps of earlier options and inputs."""
        if self._folder.is_dir():
            for path in sorted(self._folder.iterdir()):
                if path not in self._used:
                    path.unlink(missing_ok=True)


def _kept_arrays(path: Path) -> Arrays | None:
    """Return the arrays of a file, None where it is missing or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error):
        return None


def _stamps(files: dict[str, Path], known: dict[str, FileStamp]) -> dict[str, FileStamp]:
    """Return the stamps of files; a file is read only where its known stamp differs in size or time."""
    result = {}
    for name, path in files.items():
        size, mtime_ns = path.stat().st_size, path.stat().st_mtime_ns
        stamp = known.get(name)
        if stamp is None or (stamp.size, stamp.mtime_ns) != (size, mtime_ns):
            stamp = FileStamp(size=size, mtime_ns=mtime_ns, sha256=_sha256(path))
        result[name] = stamp
    return result


def _file_name(step: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in step)[:60]


def _files(place: Path) -> list[Path]:
    """Return a file itself, or the pictures of a folder."""
    if place.is_file():
        return [place]
    return sorted(path for path in place.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _same(path: Path, stamp: FileStamp) -> bool:
    """Tell whether a file is still what it was: by size and time, and where only the time differs by its hash."""
    status = path.stat()
    if status.st_size != stamp.size:
        return False
    return status.st_mtime_ns == stamp.mtime_ns or _sha256(path) == stamp.sha256


def _read(path: Path, model: type[Model]) -> Model:
    """Read and check a JSON file; raises InputError naming the place of the first fault."""
    try:
        return model.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValidationError as error:
        raise InputError(f"{path}: {_first_fault(error, model)}") from error


def _first_fault(error: ValidationError, model: type[_Strict]) -> str:
    fault = error.errors()[0]
    place = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"there is no {place!r}{did_you_mean(str(fault['loc'][-1]), _names(model))}"
    if place == "uavkit_survey":
        return "made by a newer uavkit: install that version"
    return f"{place}: {fault['msg']}" if place else f"damaged ({fault['msg']}): restore it from a copy, or ingest again"


def _names(model: type[_Strict]) -> Iterable[str]:
    yield from model.model_fields
    if model is Manifest:
        yield from IngestOptions.model_fields


def _take_lock(stream: IO[str]) -> bool:
    """Lock an open file for as long as it stays open; the system releases it when the process ends, however it ends."""
    try:
        if sys.platform == "win32":
            import msvcrt

            stream.seek(1 << 30)  # beyond the text, which others must be able to read
            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _lock_content(stream: IO[str]) -> dict[str, Any]:
    stream.seek(0)
    try:
        content = json.loads(stream.read())
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _holder(stream: IO[str]) -> str:
    content = _lock_content(stream)
    if not content:
        return "another run"
    return f"another run (process {content.get('process')} on {content.get('computer')})"
