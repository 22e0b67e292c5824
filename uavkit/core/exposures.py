"""Which still was taken at which exposure event, as ingest found it; part of the block."""

from dataclasses import dataclass
from enum import Enum

from uavkit.core.records import GnssFix


class StillState(Enum):
    """What is known of a still's exposure event."""

    MATCHED = "matched"
    DOUBLED = "doubled"
    """Several events tell its exposure, tenths of a second apart: one of them is taken, with a sigma that says so."""
    GIVEN = "given"
    """By the user's file."""
    AMBIGUOUS = "ambiguous"
    """Several events are possible, or an event and none: its position is not used."""
    NO_EVENT = "no event"
    NO_TIME = "no time"
    """The still's file tells no time, and its neighbours do not settle it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillExposure:
    """A still and its exposure event."""

    still: str
    state: StillState
    probability: float
    """Of the pair; of the best pair where it is ambiguous; 0 without an event."""
    event: int | None = None
    """Number of the event among those of all logs, from 1."""
    label: str = ""
    """What the user knows the event by: its log and its number there."""
    event_gps_time_ns: int | None = None
    gps_time_ns: int | None = None
    """Of the exposure: the event's, and the shutter's stated latency."""
    position: GnssFix | None = None
    """Of the antenna (or, where a lever arm was taken off, of the projection centre) at that time."""
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnusedEvent:
    """An exposure event that belongs to no still."""

    event: int
    """From 1."""
    gps_time_ns: int
    source: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraClock:
    """The camera's clock against GPS time, for a group of stills that one offset explains."""

    stills: tuple[str, ...]
    reference_gps_ns: int
    offset_s: float
    """What the camera's clock shows minus UTC, at the reference."""
    offset_sigma_s: float
    drift_ppm: float
    drift_sigma_ppm: float
    residual_s: float
    """RMS."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureMatches:
    """All stills and events of a flight."""

    sources: tuple[str, ...]
    """The logs."""
    stills: tuple[StillExposure, ...]
    unused: tuple[UnusedEvent, ...]
    events: int
    """Number of all events."""
    clocks: tuple[CameraClock, ...]
    shutter_latency_s: float = 0.0
    """From event to exposure, as the user stated it."""
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the camera to the antenna, forward, right, down, as the user stated it."""
