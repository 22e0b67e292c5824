"""Ground control points, check points, their marks in images, and the kinds of object points."""

from dataclasses import dataclass
from enum import IntEnum


class PointKind(IntEnum):
    """What an object point is to the block."""

    PASS = 0
    """Links images along a strip."""
    TIE = 1
    """Links strips."""
    CONTROL = 2
    CHECK = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMark:
    """A measured image of a control or check point; pixel (0, 0) is the centre of the upper left pixel."""

    image: str
    column_px: float
    row_px: float
    sigma_px: float

    def __post_init__(self) -> None:
        if not self.sigma_px > 0:
            raise ValueError(f"mark in {self.image}: sigma_px must be > 0, is {self.sigma_px}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyedPoint:
    """A point of known position in the block's local frame, with its marks: control if used, check if held back."""

    name: str
    position_m: tuple[float, float, float]
    """East, north, up in the local frame."""
    sigma_m: tuple[float, float, float]
    marks: tuple[ImageMark, ...]

    def __post_init__(self) -> None:
        if not all(sigma > 0 for sigma in self.sigma_m):
            raise ValueError(f"{self.name}: sigma_m must be > 0, is {self.sigma_m}")


class ControlPoint(SurveyedPoint):
    """A surveyed point that takes part in the adjustment."""

    __slots__ = ()


class CheckPoint(SurveyedPoint):
    """A surveyed point whose coordinates are held back, to judge the result."""

    __slots__ = ()
