"""Heights that carry their datum: mixing an ellipsoidal with a geoid height is an error, not a 40 m surprise."""

from dataclasses import dataclass
from enum import Enum


class HeightDatum(Enum):
    """What a height counts from."""

    ELLIPSOID = "ellipsoid"
    GEOID = "geoid"
    """EGM96, the geoid that uavkit ships."""
    GROUND = "ground"
    """Above the take-off point or the terrain: says nothing of the absolute height."""
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Height:
    """A height in metres with its datum; heights of different datums neither add nor compare."""

    value_m: float
    datum: HeightDatum

    def minus(self, other: "Height") -> float:
        """Return the difference in metres; raises ValueError where the datums differ or are unknown."""
        if self.datum is not other.datum or self.datum is HeightDatum.UNKNOWN:
            raise ValueError(f"cannot subtract a {other.datum.value} height from a {self.datum.value} height")
        return self.value_m - other.value_m
