"""Camera profiles: what is known of a camera type before it flies, as TOML files in ``hardware/cameras``."""

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from pydantic import Field

from uavkit.core.camera import CameraProfile, InteriorOrientation, InteriorSigmas
from uavkit.core.errors import InputError
from uavkit.core.records import StillInfo
from uavkit.formats.options_file import StrictModel, read_toml
from uavkit.formats.profile_names import plain_name, profile_named

PACKAGE = Path(__file__).resolve().parents[1]
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


class _Interior(StrictModel):
    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    principal_distance_px: float = Field(gt=0)
    x0_px: float | None = None
    y0_px: float | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    b1: float = 0.0
    b2: float = 0.0

    def orientation(self) -> InteriorOrientation:
        values = self.model_dump()
        values["x0_px"] = (self.width_px - 1) / 2 if self.x0_px is None else self.x0_px
        values["y0_px"] = (self.height_px - 1) / 2 if self.y0_px is None else self.y0_px
        return InteriorOrientation(**values)


class _Sigmas(StrictModel):
    principal_distance_px: float = Field(ge=0)
    x0_px: float = Field(ge=0)
    y0_px: float = Field(ge=0)
    k1: float = Field(ge=0)
    k2: float = Field(ge=0)
    k3: float = Field(ge=0)
    p1: float = Field(ge=0)
    p2: float = Field(ge=0)
    b1: float = Field(default=0.0, ge=0)
    b2: float = Field(default=0.0, ge=0)


class _Profile(StrictModel):
    name: str = Field(min_length=1)
    maker: str
    models: list[str]
    sensor_width_mm: float = Field(gt=0)
    focal_length_mm: float = Field(gt=0)
    mass_g: float | None = Field(default=None, gt=0)
    least_interval_s: float | None = Field(default=None, gt=0)
    readout_s: float | None = Field(default=None, ge=0)
    source: str = Field(min_length=1)
    interior: _Interior
    sigmas: _Sigmas


def camera_folder() -> Path:
    """Return where the profiles lie: in a checkout ``hardware/cameras``, in an installed wheel beside the code."""
    checkout = PACKAGE.parent / "hardware" / "cameras"
    folder = checkout if (PACKAGE.parent / "pyproject.toml").is_file() else PACKAGE / "data" / "cameras"
    if not folder.is_dir():
        raise InputError(f"the camera profiles are missing at {folder}: install uavkit again")
    return folder


def read_camera(path: Path) -> CameraProfile:
    """Read one profile; raises InputError with file, key and nearest known key."""
    content = read_toml(path, _Profile)
    return CameraProfile(
        name=content.name,
        maker=content.maker,
        models=tuple(content.models),
        sensor_width_mm=content.sensor_width_mm,
        focal_length_mm=content.focal_length_mm,
        interior=content.interior.orientation(),
        interior_sigmas=InteriorSigmas(**content.sigmas.model_dump()),
        mass_g=content.mass_g,
        least_interval_s=content.least_interval_s,
        readout_s=content.readout_s,
        source=content.source,
    )


@lru_cache(maxsize=4)
def _profiles(folder: Path) -> dict[str, CameraProfile]:
    """Return all profiles by the names of their files."""
    return {path.stem: read_camera(path) for path in sorted(folder.glob("*.toml"))}


def list_cameras() -> tuple[str, ...]:
    """Return the names of all profiles."""
    return tuple(profile.name for profile in _profiles(camera_folder()).values())


def load_camera(name: str) -> CameraProfile:
    """Return the profile of a name, a model name of EXIF, or a path to a TOML file of one's own.

    Case, blanks, hyphens and underscores do not count. Raises InputError for an unknown name, with the nearest one.
    """
    if name.lower().endswith(".toml"):
        return read_camera(Path(name))
    profiles = _profiles(camera_folder())
    names = {key: (found.name, key, *found.models) for key, found in profiles.items()}
    return profiles[profile_named("camera", name, names)]


def camera_for_exif(maker: str, model: str) -> CameraProfile | None:
    """Return the profile of the camera that EXIF names, None where there is none: see ``camera_from_exif``."""
    wanted = {plain_name(model), plain_name(model.casefold().removeprefix(maker.casefold()))} - {""}
    for profile in _profiles(camera_folder()).values():
        maker_fits = not maker.strip() or plain_name(profile.maker)[:4] == plain_name(maker)[:4]
        if maker_fits and wanted & {plain_name(known) for known in profile.models}:
            return profile
    return None


def camera_from_exif(still: StillInfo) -> CameraProfile:
    """Return a rough profile from EXIF's equivalent focal length on 35 mm film, for a camera without a profile.

    CIPA DCG-001 counts the equivalent by the picture's diagonal; some makers count by its width, all round it to whole
    millimetres, and video crops keep the lens's figure: hence 5 % sigma of the principal distance. Raises InputError
    where EXIF does not tell it.
    """
    if still.focal_length_35mm is None:
        what = f"{still.maker} {still.model}".strip() or "an unknown camera"
        raise InputError(
            f"{still.name}: {what} has no profile here, and EXIF tells no focal length for 35 mm film: name one of the "
            f"cameras {', '.join(list_cameras())}, or write a profile (hardware/README.md)"
        )
    width, height = still.width_px, still.height_px
    principal_distance_px = still.focal_length_35mm / FILM_DIAGONAL_MM * math.hypot(width, height)
    focal_length_mm = still.focal_length_mm or still.focal_length_35mm
    return CameraProfile(
        name="exif",
        maker=still.maker,
        models=(still.model,),
        sensor_width_mm=focal_length_mm * width / principal_distance_px,
        focal_length_mm=focal_length_mm,
        interior=InteriorOrientation(
            width_px=width,
            height_px=height,
            principal_distance_px=principal_distance_px,
            x0_px=(width - 1) / 2,
            y0_px=(height - 1) / 2,
        ),
        interior_sigmas=InteriorSigmas(
            principal_distance_px=0.05 * principal_distance_px,
            x0_px=0.01 * width,
            y0_px=0.01 * width,
            k1=0.1,
            k2=0.1,
            k3=0.1,
            p1=0.002,
            p2=0.002,
        ),
        source=f"EXIF of {still.name}: {still.focal_length_35mm:g} mm on 35 mm film",
    )


def interior_for_size(profile: CameraProfile, width_px: int, height_px: int) -> CameraProfile:
    """Return the profile for stills of another size: resampled where the shape is the same, else cropped.

    Cameras crop about the middle and keep the width (4:3 to 16:9 or 3:2) or the height (3:2 to 4:3): where one of them
    is the profile's own the scale stays, else the larger of both ratios counts.
    """
    known = profile.interior
    ratios = (width_px / known.width_px, height_px / known.height_px)
    scale = 1.0 if 1.0 in ratios else max(ratios)
    cropped = replace(
        known,
        width_px=width_px,
        height_px=height_px,
        principal_distance_px=known.principal_distance_px * scale,
        x0_px=(known.x0_px + 0.5) * scale - 0.5 - (known.width_px * scale - width_px) / 2,
        y0_px=(known.y0_px + 0.5) * scale - 0.5 - (known.height_px * scale - height_px) / 2,
    )
    sigmas = profile.interior_sigmas
    return replace(
        profile,
        sensor_width_mm=profile.sensor_width_mm * width_px / (known.width_px * scale),
        interior=cropped,
        interior_sigmas=replace(
            sigmas,
            principal_distance_px=sigmas.principal_distance_px * scale,
            x0_px=sigmas.x0_px * scale,
            y0_px=sigmas.y0_px * scale,
        ),
    )
