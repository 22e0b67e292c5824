"""Options of the processing core: frozen sections, each option with its unit, range and default."""

from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import Any

from uavkit.core.errors import InputError, did_you_mean


class CandidateSource(Enum):
    """Where candidate pass points come from."""

    AUTO = "auto"
    """Through the video where there is one, by features where there is none or where the video has gaps."""
    VIDEO = "video"
    FEATURES = "features"
    BOTH = "both"


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise InputError(f"option {name} must be {least:g} to {most:g}, is {value:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateOptions:
    """How candidate points are found."""

    source: CandidateSource = CandidateSource.AUTO
    cells: int = 24
    """Cells of the grid along the longer side of a still; the best points of each cell are taken. 4 to 100."""
    per_cell: int = 2
    """Points for each cell, 1 to 20."""
    feature_width_px: int = 1400
    """Stills are reduced to at most this width for feature detection, 400 to 20000 px."""
    features: int = 6000
    """Most features for each still, 200 to 50000."""
    neighbours: int = 10
    """Stills with which each still is compared, nearest first, 1 to 100."""

    def __post_init__(self) -> None:
        _within("candidates.cells", self.cells, 4, 100)
        _within("candidates.per_cell", self.per_cell, 1, 20)
        _within("candidates.feature_width_px", self.feature_width_px, 400, 20_000)
        _within("candidates.features", self.features, 200, 50_000)
        _within("candidates.neighbours", self.neighbours, 1, 100)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasurementOptions:
    """How image points are measured by least squares matching."""

    window_px: int = 31
    """Side of the window, odd, 11 to 61 px."""
    most_return_miss_px: float = 0.25
    """Forward and backward matching may differ by this much, 0.02 to 2 px."""
    least_correlation: float = 0.75
    """Least correlation of the matched windows, 0.3 to 0.99."""
    coarse_levels: int = 1
    """How often a window that does not match is tried again in stills of half the size, 0 to 3."""
    most_search_px: int = 96
    """Largest radius of the search around a back-projected point, 4 to 400 px."""

    def __post_init__(self) -> None:
        _within("measurement.window_px", self.window_px, 11, 61)
        if self.window_px % 2 == 0:
            raise InputError(f"option measurement.window_px must be odd, is {self.window_px}")
        _within("measurement.most_return_miss_px", self.most_return_miss_px, 0.02, 2.0)
        _within("measurement.least_correlation", self.least_correlation, 0.3, 0.99)
        _within("measurement.coarse_levels", self.coarse_levels, 0, 3)
        _within("measurement.most_search_px", self.most_search_px, 4, 400)


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustmentSection:
    """How the block is adjusted."""

    tukey_c: float = 6.0
    """Constant C of Tukey's biweight, 5 to 9."""
    reject_above: float = 4.0
    """Normalised residual above which an observation is left out of the last pass, 2.5 to 10."""
    self_calibration: bool = True
    """Whether the interior orientation is adjusted with its a priori sigmas."""
    gnss: bool = True
    """Whether GNSS positions take part."""

    def __post_init__(self) -> None:
        _within("adjustment.tukey_c", self.tukey_c, 5.0, 9.0)
        _within("adjustment.reject_above", self.reject_above, 2.5, 10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessOptions:
    """All options of ``orient_block``."""

    candidates: CandidateOptions = field(default_factory=CandidateOptions)
    measurement: MeasurementOptions = field(default_factory=MeasurementOptions)
    adjustment: AdjustmentSection = field(default_factory=AdjustmentSection)


def with_settings(options: ProcessOptions, settings: list[str]) -> ProcessOptions:
    """Return options with ``section.option=value`` texts applied; raises InputError naming what is wrong."""
    for setting in settings:
        path, equals, text = setting.partition("=")
        section_name, dot, name = path.strip().partition(".")
        if not (equals and dot):
            raise InputError(f"--set {setting!r}: write section.option=value, like measurement.window_px=31")
        sections = [f.name for f in fields(options)]
        if section_name not in sections:
            raise InputError(f"--set {setting!r}: no section {section_name!r}{did_you_mean(section_name, sections)}")
        section = getattr(options, section_name)
        names = [f.name for f in fields(section)]
        if name not in names:
            raise InputError(f"--set {setting!r}: [{section_name}] has no option {name!r}{did_you_mean(name, names)}")
        value = _parse(setting, text.strip(), getattr(section, name))
        options = replace(options, **{section_name: replace(section, **{name: value})})
    return options


def _parse(setting: str, text: str, present: Any) -> Any:
    """Return a text as the type of the present value."""
    kind = type(present)
    try:
        if kind is bool:
            return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[text.lower()]
        return kind(text)
    except (ValueError, KeyError) as error:
        allowed = ", ".join(str(e.value) for e in kind) if issubclass(kind, Enum) else f"a value like {present}"
        allowed = "true or false" if kind is bool else allowed
        raise InputError(f"--set {setting!r}: {text!r} does not fit; give {allowed}") from error
