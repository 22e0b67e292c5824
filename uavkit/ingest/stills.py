"""Checks of the stills as a whole: one camera, one size, an interior orientation that fits, pictures that overlap."""

from collections import defaultdict
from collections.abc import Sequence

from uavkit.core.camera import CameraProfile
from uavkit.core.devices import VideoSource
from uavkit.core.errors import InputError
from uavkit.core.records import StillInfo
from uavkit.ingest.still_matching import PreparedStill, share_content

LARGEST_ASPECT_DIFFERENCE = 0.005
NEIGHBOURS = 2
"""Stills before and after that should show some of the same."""


def check_one_camera(infos: Sequence[StillInfo]) -> None:
    """Raise InputError where stills of several cameras or sizes are mixed, naming the groups."""
    groups: dict[tuple[str, str, int, int], list[str]] = defaultdict(list)
    for info in infos:
        groups[info.maker.strip(), info.model.strip(), info.width_px, info.height_px].append(info.name)
    if len(groups) > 1:
        texts = [
            f"{len(names)} stills {width} x {height} px of {f'{maker} {model}'.strip() or 'an unnamed camera'} "
            f"({names[0]}{', ...' if len(names) > 1 else ''})"
            for (maker, model, width, height), names in sorted(groups.items(), key=lambda item: -len(item[1]))
        ]
        raise InputError(
            f"two cameras or sizes are mixed: {'; '.join(texts)}. Give the stills of one camera and one size, and "
            "process the others apart"
        )


def camera_of_stills(infos: Sequence[StillInfo], camera: CameraProfile | None) -> tuple[CameraProfile, tuple[str, ...]]:
    """Return the camera for the size of the stills, and notes.

    A given profile must have the stills' shape; without one EXIF names a known camera, or tells a rough one. Raises
    InputError for another shape, and where nothing tells the principal distance.
    """
    from uavkit.formats.camera_profiles import camera_for_exif, camera_from_exif, interior_for_size

    first = infos[0]
    if camera is not None:
        known = camera.interior
        aspect, wanted = first.width_px / first.height_px, known.width_px / known.height_px
        if abs(aspect / wanted - 1.0) > LARGEST_ASPECT_DIFFERENCE:
            raise InputError(
                f"camera {camera.name}: its interior orientation is for {known.width_px} x {known.height_px} px, the "
                f"stills are {first.width_px} x {first.height_px} px: another shape. Are they cropped or turned, or is "
                "it another camera? Give the profile of these pictures"
            )
        notes = (
            []
            if _is_of(first, camera)
            else [f"the stills say they are of {first.maker} {first.model}, the camera given is {camera.name}"]
        )
        return interior_for_size(camera, first.width_px, first.height_px), tuple(notes)
    found = camera_for_exif(first.maker, first.model)
    if found is None:
        rough = camera_from_exif(first)
        return rough, (f"no profile of {first.maker} {first.model}: interior orientation roughly from EXIF",)
    fitted = interior_for_size(found, first.width_px, first.height_px)
    shape = found.interior.width_px * first.height_px, found.interior.height_px * first.width_px
    notes = [f"camera {found.name}, recognised by EXIF"]
    if abs(shape[0] / shape[1] - 1.0) > LARGEST_ASPECT_DIFFERENCE:
        notes.append(
            f"the stills have another shape than the profile of {found.name}: taken as cropped about the middle"
        )
    return fitted, tuple(notes)


def _is_of(still: StillInfo, camera: CameraProfile) -> bool:
    model = still.model.strip().casefold()
    known = [name.casefold() for name in camera.models]
    return not model or not known or any(name in model or model in name for name in known)


def check_overlap(
    infos: Sequence[StillInfo], pictures: dict[str, PreparedStill], video: VideoSource | None = None
) -> tuple[str, ...]:
    """Return a note that names stills which share no content with their neighbours in time.

    Raises InputError where no still shares content with any other, unless a video can tell.
    """
    names = [info.name for info in infos]
    if len(names) < 2:
        raise InputError(f"{len(names)} still is no block: give at least two stills that overlap")
    linked: set[str] = set()
    for i, one in enumerate(names):
        for two in names[i + 1 : i + 1 + NEIGHBOURS]:
            if not (one in linked and two in linked) and share_content(pictures[one].features, pictures[two].features):
                linked |= {one, two}
    if not linked and not _any_shared(names, pictures):
        if video is not None:
            return (f"the {len(names)} stills show too little detail to tell that they overlap: the video must",)
        raise InputError(
            f"no two of the {len(names)} stills show the same ground: they do not overlap, or belong to different "
            "places. A block needs at least 60 % forward overlap"
        )
    alone = [name for name in names if name not in linked]
    if not alone:
        return ()
    return (f"{len(alone)} stills show nothing that their neighbours in time show: {', '.join(alone)}",)


def _any_shared(names: Sequence[str], pictures: dict[str, PreparedStill]) -> bool:
    pairs = ((a, b) for i, a in enumerate(names) for b in names[i + 1 :])
    return any(share_content(pictures[a].features, pictures[b].features) for a, b in pairs)
